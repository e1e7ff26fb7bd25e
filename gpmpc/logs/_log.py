"""Logs of a real or simulated system: runs of measured states, inputs and context at equal time steps, with their gaps.

Nothing is interpolated over a gap: a run consists of pieces, and transitions, windows and episodes stay inside a piece.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from gpmpc.calibration import Recording
from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.gp import Transitions
from gpmpc.logs._kinematics import Array, StateSpace
from gpmpc.logs._mapping import LogMapping
from gpmpc.signals import Signals


@dataclass(frozen=True)
class Finding:
    """What was noticed in a run, and what was done about it."""

    kind: str  # such as "gap", "repeated stamp", "at rest"
    run: str
    count: int  # rows, or gaps
    text: str


@dataclass(frozen=True)
class LogRun:
    """One run: K rows in pieces without a gap."""

    name: str  #: of the run
    time: Array  #: [s] (K,)
    states: Array  #: (K, n)
    inputs: Array  #: (K, m), those applied from the row's time on
    context: Array  #: (K, c)
    begins: tuple[int, ...] = (0,)  #: first row of each piece; the first is 0

    def __len__(self) -> int:
        return len(self.time)

    @cached_property
    def pieces(self) -> list[tuple[int, int]]:
        """First row, and row after the last, of each piece."""
        return list(zip(self.begins, (*self.begins[1:], len(self)), strict=True))

    def starts(self, past: int, ahead: int, stride: int = 1) -> np.ndarray:
        """Lists the rows that have ``past`` rows before and ``ahead`` after them in their own piece."""
        return np.concatenate(
            [np.arange(begin + past, end - ahead, stride) for begin, end in self.pieces]
        ).astype(int)

    def part(self, begin: int, end: int, name: str) -> "LogRun":
        """The rows from ``begin`` to before ``end`` as a run of its own."""
        rows = slice(begin, end)
        begins = (0, *(b - begin for b in self.begins if begin < b < end))
        arrays = (
            self.time[rows],
            self.states[rows],
            self.inputs[rows],
            self.context[rows],
        )
        return LogRun(f"{self.name}, {name}", *arrays, begins=begins)


@dataclass(frozen=True)
class Windows:
    """W windows of a log: the measured past and what came after; row k of ``states`` goes with row k of ``inputs``."""

    space: StateSpace  #: of the states
    time_step: float  #: [s]
    past: int  #: rows before the start of each; the start is row ``past``
    stride: int  #: rows from one start to the next
    states: Array  #: (W, past + ahead + 1, n)
    inputs: Array  #: (W, past + ahead + 1, m)
    context: Array  #: at the start, held through a prediction (W, past + 1, c)
    runs: np.ndarray  #: number of the run that each is from (W,)
    times: Array  #: of the starts (W,) [s]

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, rows: Any) -> "Windows":
        parts = {
            name: getattr(self, name)[rows]
            for name in ("states", "inputs", "context", "runs", "times")
        }
        return replace(self, **parts)

    @property
    def ahead(self) -> int:
        """Rows after the start."""
        return self.states.shape[1] - self.past - 1


@dataclass(frozen=True)
class Log:
    """Runs of one system at one time step.

    Raises:
        DataError: There is no run.
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
        return f"Log({len(self)} rows, {len(self.runs)} runs, {pieces} pieces, {1 / self.time_step:g} Hz)"

    @property
    def space(self) -> StateSpace:
        """Of the states."""
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
    def signals(self) -> Signals:
        """Names of states and inputs, and time step; columns of two topics may share one."""
        states = self.space.names
        inputs = self.input_names
        return Signals(
            states if len(set(states)) == len(states) else (),
            inputs if len(set(inputs)) == len(inputs) else (),
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
        if not 0 < len(set(held_out)) < len(names):
            raise SettingError(
                "held_out",
                f"must leave runs on both sides; got {len(set(held_out))} of {len(names)}",
            )
        sides = (
            [run for run in self.runs if (run.name in held_out) == held]
            for held in (False, True)
        )
        first, last = (replace(self, runs=tuple(side)) for side in sides)
        return first, last

    def split_by_time(self, share: float) -> tuple["Log", "Log"]:
        """Splits every run: a log of the first ``share`` of its rows, and one of the others."""
        check_number("share", share, above=0)
        cuts = [
            (run, min(max(round(share * len(run)), 1), len(run) - 1))
            for run in self.runs
        ]
        first = tuple(run.part(0, cut, "first part") for run, cut in cuts)
        last = tuple(run.part(cut, len(run), "last part") for run, cut in cuts)
        return replace(self, runs=first), replace(self, runs=last)

    def transitions(self) -> Transitions:
        """All transitions from one row to the next inside a piece, as data of GPs."""
        cut = self.windows(1)
        now = cut.states[:, 0]
        after = cut.states[:, 1]
        return Transitions(now, cut.inputs[:, 0], after, self.signals)

    def episodes(self) -> list[Recording]:
        """Every piece of two rows or more as a recording for ``gpmpc.calibration``."""
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
        """Cuts windows that lie inside a piece each.

        Args:
            ahead: Rows after the start of each.
            past: Rows before it.
            stride: Rows from one start to the next.
            most: Windows, about; the stride follows from it.

        Raises:
            DataError: No piece is as long.
        """
        for key, value, least in (
            ("ahead", ahead, 0),
            ("past", past, 0),
            ("stride", stride, 1),
        ):
            check_number(key, value, least=least, whole=True)
        lengths = [b - a for run in self.runs for a, b in run.pieces]
        if most is not None:
            stride = max(
                -(-sum(max(length - ahead - past, 0) for length in lengths) // most), 1
            )
        offsets = np.arange(-past, ahead + 1)
        parts = []
        for number, run in enumerate(self.runs):
            starts = run.starts(past, ahead, stride)
            rows = starts[:, None] + offsets
            before = run.context[rows[:, : past + 1]]
            numbers = np.full(len(rows), number)
            parts.append(
                (run.states[rows], run.inputs[rows], before, numbers, run.time[starts])
            )
        arrays = [np.concatenate(one) for one in zip(*parts, strict=True)]
        if not len(arrays[0]):
            raise DataError(
                f"windows of {past + ahead + 1} rows need a piece as long; the longest has {max(lengths)}"
            )
        return Windows(self.space, self.time_step, past, stride, *arrays)

    def __iter__(self) -> Iterator[LogRun]:
        return iter(self.runs)
