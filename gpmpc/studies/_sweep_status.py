"""Counts how far the runs of a sweep are, as their folders tell, again and again.

    plans and folders -> runs -> state of each, by its files -> counts, rate, time left

What has ended stays so, unless its folder goes: at every look the ends are looked at
again, and nothing is opened but what has failed. This module loads nothing heavy.
"""

import json
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gpmpc.exceptions import DataError
from gpmpc.studies._run_folder import (
    CONFIG,
    ERROR,
    METRICS,
    PLAN_PREFIX,
    RunFolder,
    RunState,
    folder_name,
    is_locked,
)

_RATE_WINDOW = 600.0  # ends that tell how fast runs end now [s]
# Behind the last end, after which nobody works, where no run or plan is locked [s].
_STILL = 60.0
_SHOWN_REASONS = 3


@dataclass
class SweepStatus:
    """How far the runs of a tree are."""

    #: number of runs by state
    counts: dict[RunState, int]
    #: number of failed runs by reason, the most frequent one first; numbers in it are
    #: those of one of them
    failures: dict[str, int]
    #: runs that end in a second; None where none has ended lately
    rate: float | None
    #: whether anybody works on them
    active: bool

    @property
    def total(self) -> int:
        """Number of runs that were asked for, or are there."""
        return sum(self.counts.values())

    @property
    def left(self) -> int:
        """Number of runs that have not ended."""
        return (
            self.total - self.counts[RunState.FINISHED] - self.counts[RunState.FAILED]
        )

    @property
    def seconds_left(self) -> float | None:
        """How long it takes to the end [s]; None where that cannot be told."""
        if self.rate is None or not self.active:
            return None
        return self.left / self.rate

    def line(self, with_reasons: bool = True) -> str:
        """Returns all of it in one line, or all but why runs failed."""
        names = {
            RunState.FINISHED: "finished",
            RunState.FAILED: "failed",
            RunState.RUNNING: "running",
            RunState.ABANDONED: "abandoned",
            RunState.NOT_BEGUN: "to fly",
        }
        counts = [
            f"{self.counts[state]} {name}"
            for state, name in names.items()
            if self.counts[state] or state in (RunState.FINISHED, RunState.FAILED)
        ]
        text = f"{self.total} runs: {', '.join(counts)}"
        if self.left:
            text += f"; {self.speed()}"
        if not with_reasons:
            return text
        for reason, count in [*self.failures.items()][:_SHOWN_REASONS]:
            text += f"; {count} failed: {reason}"
        if len(self.failures) > _SHOWN_REASONS:
            text += f"; and {len(self.failures) - _SHOWN_REASONS} reasons more"
        return text

    def speed(self) -> str:
        """Returns how fast runs end and how long it takes, in words."""
        if not self.active:
            return "nobody works on them"
        if self.rate is None:
            return "no run has ended yet"
        seconds = round(self.seconds_left or 0)
        hours, minutes = divmod(seconds // 60, 60)
        time_left = f"{hours}:{minutes:02}:{seconds % 60:02} left"
        if self.rate >= 1:
            return f"{self.rate:.3g} a second, {time_left}"
        if self.rate >= 1 / 60:
            return f"{60 * self.rate:.3g} a minute, {time_left}"
        return f"{3600 * self.rate:.3g} an hour, {time_left}"


@dataclass
class SweepWatch:
    """Looks at the runs below a folder.

    Args:
        tree: A sweep's folder, or one with sweeps below it.
        has_jobs: Whether jobs of a sweep's folder wait or run in a queue; asked where
            nothing in the folder shows that anybody works on it.

    Raises:
        DataError: There is no such folder, or no sweep and no run in it.
    """

    tree: Path
    has_jobs: Callable[[Path], bool] = lambda _: False
    _reasons: dict[str, tuple[int, str]] = field(default_factory=dict)  # by path
    _plans: dict[str, tuple[int, set[str]]] = field(default_factory=dict)  # by path

    def look(self) -> SweepStatus:
        """Returns how far the runs are now."""
        if not self.tree.is_dir():
            raise DataError(f"{self.tree}: no such folder")
        counts = dict.fromkeys(RunState, 0)
        ends: list[float] = []
        failures: Counter[str] = Counter()
        examples: dict[str, str] = {}
        sweeps = [*self._sweeps()]
        for folder in sweeps:
            for path, state, ended in self._runs(folder):
                counts[state] += 1
                if ended is None:
                    continue
                ends.append(1e-9 * ended)
                if state is RunState.FAILED:
                    reason = self._reason(path, ended)
                    kind = without_numbers(reason)
                    failures[kind] += 1
                    examples[kind] = min(reason, examples.get(kind, reason))
        if not any(counts.values()):
            raise DataError(f"{self.tree}: holds no sweep, and no run")
        rate, last_end = _rate(ends)
        is_active = (
            counts[RunState.RUNNING] > 0
            or abs(time.time() - last_end) < _STILL
            or any(
                is_locked(Path(plan)) for folder in sweeps for plan in _plans(folder)
            )
            or any(self.has_jobs(Path(folder)) for folder in sweeps)
        )
        return SweepStatus(
            counts=counts,
            failures={examples[kind]: n for kind, n in failures.most_common()},
            rate=rate,
            active=is_active,
        )

    def _runs(self, folder: str) -> Iterator[tuple[str, RunState, int | None]]:
        """Yields path, state and end [ns] of every run that is a child of a folder."""
        planned = self._planned(folder)
        with os.scandir(folder) as entries:
            names = {entry.name for entry in entries if entry.is_dir()}
        for _ in planned - names:
            yield "", RunState.NOT_BEGUN, None
        for name in sorted(names):
            path = f"{folder}/{name}"
            for file, state in ((METRICS, RunState.FINISHED), (ERROR, RunState.FAILED)):
                ended = _written_at(f"{path}/{file}")
                if ended is not None:
                    yield path, state, ended
                    break
            else:
                if name in planned or os.path.exists(f"{path}/{CONFIG}"):
                    yield path, RunFolder(Path(path)).state, None

    def _sweeps(self) -> Iterator[str]:
        """Yields the folders that hold runs; one may be below another."""
        for folder, children, _ in os.walk(self.tree):
            planned = self._planned(folder)
            others = [name for name in children if name not in planned]
            no_runs = [name for name in others if not _is_run(f"{folder}/{name}")]
            children[:] = no_runs
            if planned or len(no_runs) < len(others):
                yield folder

    def _planned(self, folder: str) -> set[str]:
        """Returns the names of the runs that the plans in a folder ask for."""
        names: set[str] = set()
        for path in _plans(folder):
            written = _written_at(path) or 0
            if self._plans.get(path, (None,))[0] != written:
                self._plans[path] = written, _names_in_plan(path)
            names |= self._plans[path][1]
        return names

    def _reason(self, path: str, written: int) -> str:
        """Returns why a run failed; its file is read once."""
        if self._reasons.get(path, (None,))[0] != written:
            self._reasons[path] = written, RunFolder(Path(path)).error()
        return self._reasons[path][1]


def without_numbers(text: str) -> str:
    """Returns a text that is the same for texts that differ in numbers alone."""
    return re.sub(r"\d+", "0", text)


def _is_run(path: str) -> bool:
    return any(os.path.exists(f"{path}/{file}") for file in (METRICS, ERROR, CONFIG))


def _plans(folder: str) -> list[str]:
    with os.scandir(folder) as entries:
        return [
            entry.path
            for entry in entries
            if entry.name.startswith(PLAN_PREFIX) and entry.name.endswith(".json")
        ]


def _names_in_plan(path: str) -> set[str]:
    """Returns names of folders; none where the file is damaged."""
    names: set[str] = set()
    with suppress(OSError, ValueError, KeyError, TypeError):
        plan: Any = json.loads(Path(path).read_text(encoding="utf-8"))
        names = {folder_name(choices) for choices in plan["runs"]}
    return names


def _written_at(path: str) -> int | None:
    """Returns when a file was written [ns]; None where there is none."""
    try:
        return os.stat(path).st_mtime_ns
    except OSError:
        return None


def _rate(ends: list[float]) -> tuple[float | None, float]:
    """Returns how many runs end in a second now, and when the last one did [s].

    A node's clock may go before this machine's.
    """
    last_end = max(ends, default=0.0)
    now = max(time.time(), last_end)
    late = sorted(end for end in ends if now - end < _RATE_WINDOW)
    if len(late) < 2 or now <= late[0]:
        return None, last_end
    return (len(late) - 1) / (now - late[0]), last_end
