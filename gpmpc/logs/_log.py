"""Logs of a real or simulated system: runs at equal time steps, with their gaps.

A run has measured states, inputs and context. Nothing is interpolated over a gap: a run
consists of pieces, and transitions, windows and episodes stay inside a piece.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from gpmpc._dynamics import Array
from gpmpc.calibration import Recording
from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.gp import Transitions
from gpmpc.logs._findings import Finding
from gpmpc.logs._mapping import LogMapping
from gpmpc.models._state_space import StateSpace
from gpmpc.models._windows import Windows
from gpmpc.signals import Signals


class RunWindows(NamedTuple):
    """W windows of one run, as in ``Windows``."""

    states: Array  # (W, past + 1 + ahead, n)
    inputs: Array  # (W, past + 1 + ahead, m)
    context: Array  # (W, past + 1, c)
    times: Array  # of the starts (W,) [s]


@dataclass(frozen=True)
class LogRun:
    """One run: K rows in pieces without a gap."""

    name: str  #: of the run
    time: Array  #: [s] (K,)
    states: Array  #: (K, n)
    inputs: Array  #: (K, m), those applied from the row's time on
    context: Array  #: (K, c)
    begins: tuple[int, ...] = (0,)  #: first row of each piece; the first is 0
    origin: str = ""  #: name of the run that this is a part of; empty of a whole one

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def pieces(self) -> list[tuple[int, int]]:
        """The first row, and the row after the last, of each piece."""
        return list(zip(self.begins, (*self.begins[1:], len(self)), strict=True))

    def starts(
        self, past: int, ahead: int, stride: int = 1, longest: int = 0
    ) -> np.ndarray:
        """Lists rows with ``past`` rows before and ``ahead`` after in their piece.

        Starts in a piece of more than ``past + longest`` rows have ``longest`` rows
        after them as well, so that windows of several lengths begin in the same rows.
        """
        starts = []
        for begin, end in self.pieces:
            has_room = end - begin > past + longest
            last = end - max(ahead, longest) if has_room else end - ahead
            starts.append(np.arange(begin + past, last, stride))
        return np.concatenate(starts).astype(int)

    def windows(
        self, past: int, ahead: int, stride: int, longest: int = 0
    ) -> RunWindows:
        """Cuts windows around every ``stride``-th start; see ``Log.windows``."""
        starts = self.starts(past, ahead, stride, longest)
        rows = starts[:, None] + np.arange(-past, ahead + 1)
        return RunWindows(
            states=self.states[rows],
            inputs=self.inputs[rows],
            context=self.context[rows[:, : past + 1]],
            times=self.time[starts],
        )

    def part(self, begin: int, end: int, name: str) -> "LogRun":
        """Returns the rows from ``begin`` to before ``end`` as a run of its own.

        It keeps in ``origin`` of which run it is a part: by that, rows of folds and of
        both sides of a split are found again in the whole log.
        """
        rows = slice(begin, end)
        return LogRun(
            name=f"{self.name}, {name}",
            time=self.time[rows],
            states=self.states[rows],
            inputs=self.inputs[rows],
            context=self.context[rows],
            begins=(0, *(b - begin for b in self.begins if begin < b < end)),
            origin=self.origin or self.name,
        )


@dataclass(frozen=True)
class Log:
    """Runs of one system at one time step.

    Raises:
        DataError: There is no run.

    See Also:
        ``read_log``, which returns it.
    """

    mapping: LogMapping  #: what the columns mean
    time_step: float  #: [s]
    runs: tuple[LogRun, ...]  #: at least one
    findings: tuple[Finding, ...] = ()  #: what was noticed on the way

    def __post_init__(self) -> None:
        if not self.runs:
            raise DataError("a log needs at least one run with usable rows; got none")

    def __len__(self) -> int:
        return sum(len(run) for run in self.runs)

    def __repr__(self) -> str:
        pieces = sum(len(run.begins) for run in self.runs)
        rate = f"{1 / self.time_step:g} Hz"
        return f"Log({len(self)} rows, {len(self.runs)} runs, {pieces} pieces, {rate})"

    @property
    def space(self) -> StateSpace:
        """The space of the states."""
        return self.mapping.space

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the m inputs."""
        return tuple(
            entry
            for signal in self.mapping.of("inputs")
            for entry in signal.group.entries
        )

    @property
    def different_input_names(self) -> tuple[str, ...]:
        """Names of the m inputs, with that of their signal where two are equal."""
        names = self.input_names
        return tuple(
            f"{signal.name}.{entry}" if names.count(entry) > 1 else entry
            for signal in self.mapping.of("inputs")
            for entry in signal.group.entries
        )

    @property
    def signals(self) -> Signals:
        """Names of states and inputs, and time step.

        Names are left out where two are equal, such as columns of two topics.
        """
        return Signals(
            _unless_repeated(self.space.names),
            _unless_repeated(self.input_names),
            self.time_step,
        )

    def split(self, held_out: Sequence[str]) -> tuple["Log", "Log"]:
        """Splits by run: a log of all others, and one of the named runs.

        Raises:
            SettingError: There is no such run, or one side would be empty.
        """
        names = [run.name for run in self.runs]
        for name in held_out:
            if name not in names:
                raise SettingError(
                    "held_out", f"no such run {name!r}; there are {', '.join(names)}"
                )
        count = len(set(held_out))
        if not 0 < count < len(names):
            raise SettingError(
                "held_out",
                f"must leave runs on both sides; got {count} of {len(names)}",
            )
        others = [name for name in names if name not in held_out]
        return self._without(held_out), self._without(others)

    def _without(self, names: Sequence[str]) -> "Log":
        """Returns the log without some runs, and without what was noticed in them.

        What was noticed in a file as a whole, or in a run without usable rows, stays.
        """
        return replace(
            self,
            runs=tuple(run for run in self.runs if run.name not in names),
            findings=tuple(one for one in self.findings if one.run not in names),
        )

    def split_by_time(self, share: float) -> tuple["Log", "Log"]:
        """Splits every run: into its first ``share`` of rows, and the others.

        Raises:
            SettingError: The share is not between zero and one.
        """
        check_number("share", share, above=0)
        if share >= 1:
            raise SettingError("share", f"must be below 1; got {share:g}")
        first_parts = []
        last_parts = []
        for run in self.runs:
            cut = min(max(round(share * len(run)), 1), len(run) - 1)
            first_parts.append(run.part(0, cut, "first part"))
            last_parts.append(run.part(cut, len(run), "last part"))
        first = replace(self, runs=tuple(first_parts))
        return first, replace(self, runs=tuple(last_parts))

    def transitions(self) -> Transitions:
        """Returns all transitions between rows inside a piece, as data of GPs."""
        pairs = self.windows(1)
        return Transitions(
            pairs.states[:, 0], pairs.inputs[:, 0], pairs.states[:, 1], self.signals
        )

    def episodes(self) -> list[Recording]:
        """Returns every piece of two rows or more as a recording for calibration."""
        return [
            Recording(
                torch.from_numpy(run.states[a:b].copy()),
                torch.from_numpy(run.inputs[a : b - 1].copy()),
                self.signals,
            )
            for run in self.runs
            for a, b in run.pieces
            if b - a > 1
        ]

    def windows(
        self, ahead: int, past: int = 0, stride: int = 1, most: int | None = None
    ) -> Windows:
        """Cuts windows each of which lies inside a piece.

        Args:
            ahead: Rows after the start of each.
            past: Rows before it.
            stride: Rows from one start to the next.
            most: Number of windows, about; the stride follows from it. Several pieces
                may exceed it by less than one window each.

        Raises:
            DataError: No piece is as long.
        """
        check_number("ahead", ahead, least=0, whole=True)
        check_number("past", past, least=0, whole=True)
        check_number("stride", stride, least=1, whole=True)
        if most is not None:
            check_number("most", most, least=1, whole=True)
            stride = self._stride_for(most, rows=past + ahead)
        return self._windows(past, ahead, stride)

    def windows_by_step(
        self, steps: Sequence[int], past: int, most: int
    ) -> list[tuple[Windows, tuple[int, ...]]]:
        """Cuts windows for some numbers of steps ahead, also of short pieces.

        In a piece that has room for the most steps, windows of fewer start at the same
        rows. A piece that has not counts at those that it has room for.

        Args:
            steps: Increasing numbers of rows after the starts.
            past: Rows before them.
            most: Number of windows, about.

        Returns:
            Windows, each with the steps that they are for.

        Raises:
            DataError: No piece has room for the most steps.
        """
        longest = steps[-1]
        windows = self.windows(longest, past, most=most)
        lengths = np.array(self._lengths_of_pieces())
        is_short = (past + steps[0] < lengths) & (lengths <= past + longest)
        if not is_short.any():
            return [(windows, tuple(steps))]
        by_step: list[tuple[Windows, tuple[int, ...]]] = []
        for step in steps:
            rows = past + np.where(lengths > past + longest, longest, step)
            starts = np.maximum(lengths - rows, 0).sum()
            stride = max(-(-int(starts) // most), windows.stride)
            own = self._windows(past, step, stride, longest)
            every = max(len(own) // most, 1)  # many pieces have a window each
            own = replace(own[::every], stride=every * stride)
            by_step.append((own, (step,)))
        return by_step

    def share_in_pieces(self, rows: int) -> float:
        """Returns the share of rows in pieces of so many rows at least."""
        lengths = self._lengths_of_pieces()
        return sum(length for length in lengths if length >= rows) / len(self)

    def _windows(self, past: int, ahead: int, stride: int, longest: int = 0) -> Windows:
        """Cuts windows around every ``stride``-th start of each run."""
        windows = [run.windows(past, ahead, stride, longest) for run in self.runs]
        if not sum(len(own.times) for own in windows):
            raise DataError(
                f"windows of {past + ahead + 1} rows need a piece as long; the longest "
                f"has {self.longest_piece}"
            )
        runs = [np.full(len(own.times), number) for number, own in enumerate(windows)]
        return Windows(
            space=self.space,
            time_step=self.time_step,
            past=past,
            stride=stride,
            states=np.concatenate([own.states for own in windows]),
            inputs=np.concatenate([own.inputs for own in windows]),
            context=np.concatenate([own.context for own in windows]),
            runs=np.concatenate(runs),
            times=np.concatenate([own.times for own in windows]),
        )

    def _stride_for(self, most: int, rows: int) -> int:
        """Returns the stride that makes about ``most`` windows of ``rows`` + 1 rows."""
        starts = sum(max(length - rows, 0) for length in self._lengths_of_pieces())
        return max(-(-starts // most), 1)

    @property
    def longest_piece(self) -> int:
        """Number of rows of the longest piece without a gap."""
        return max(self._lengths_of_pieces())

    def _lengths_of_pieces(self) -> list[int]:
        return [end - begin for run in self.runs for begin, end in run.pieces]

    def __iter__(self) -> Iterator[LogRun]:
        return iter(self.runs)


def _unless_repeated(names: tuple[str, ...]) -> tuple[str, ...]:
    """Returns names; none where one comes twice."""
    return names if len(set(names)) == len(names) else ()
