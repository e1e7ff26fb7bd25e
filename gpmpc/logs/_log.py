"""Logs of a real or simulated system: runs of measured states, inputs and context at equal time steps, with their gaps.

What is wrong with a file is found, counted and named, and nothing is interpolated over a gap: a run consists of
pieces, and transitions, windows and episodes stay inside a piece. A velocity in other units than stated, a rate in
degrees or an attitude in another order makes every model wrong, and each is visible from the log alone: the signal is
compared with the other's finite differences by least squares.
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
from gpmpc.logs._kinematics import Array, StateSpace, quaternion_inverse, quaternion_product, rotate, rotation_vector
from gpmpc.logs._mapping import LogMapping

SPAN = 4  # rows on each side of a finite difference: above the noise of one row
SLOPES = (0.5, 2.0)  # of a signal over the derivative that it should be
FIT = 0.7  # correlation from which a slope says something
MOST_ROWS = 20_000
_RIGID_BODY = [("vector", 3), ("quaternion", 3), ("vector", 3), ("vector", 3)]
_HINTS = ((180 / np.pi, "degrees instead of radians"), (np.pi / 180, "radians instead of degrees"))


@dataclass(frozen=True)
class Finding:
    """What was noticed in a run, and what was done about it."""

    kind: str  # such as "gap", "repeated stamp", "at rest"
    run: str
    count: int  # rows, or gaps
    text: str


class Findings(list[Finding]):
    """What was noticed so far."""

    def note(self, kind: str, run: str, count: Any, text: str) -> None:
        """Adds a finding, unless there was none."""
        if count:
            self.append(Finding(kind, run, int(count), text))


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
        return np.concatenate([np.arange(begin + past, end - ahead, stride) for begin, end in self.pieces]).astype(int)

    def part(self, begin: int, end: int, name: str) -> "LogRun":
        """The rows from ``begin`` to before ``end`` as a run of its own."""
        rows, begins = slice(begin, end), (0, *(b - begin for b in self.begins if begin < b < end))
        arrays = self.time[rows], self.states[rows], self.inputs[rows], self.context[rows]
        return LogRun(f"{self.name}, {name}", *arrays, begins=begins)


@dataclass(frozen=True)
class Windows:
    """W windows of a log: the measured past and what came after; row k of ``states`` goes with row k of ``inputs``."""

    space: StateSpace  #: of the states
    time_step: float  #: [s]
    past: int  #: rows before the start of each; the start is row ``past``
    states: Array  #: (W, past + ahead + 1, n)
    inputs: Array  #: (W, past + ahead + 1, m)
    context: Array  #: at the start, held through a prediction (W, past + 1, c)
    runs: np.ndarray  #: number of the run that each is from (W,)
    times: Array  #: of the starts (W,) [s]

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, rows: Any) -> "Windows":
        parts = {name: getattr(self, name)[rows] for name in ("states", "inputs", "context", "runs", "times")}
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
        return self.mapping.entries("inputs")

    @property
    def context_names(self) -> tuple[str, ...]:
        """Names of the c entries of the context."""
        return self.mapping.entries("context")

    def split(self, held_out: Sequence[str]) -> tuple["Log", "Log"]:
        """Splits by run: a log of all others, and one of the named runs.

        Raises:
            SettingError: There is no such run, or one side would be empty.
        """
        names = [run.name for run in self.runs]
        for name in held_out:
            if name not in names:
                raise SettingError("held_out", f"no such run {name!r}; there are {', '.join(names)}")
        if not 0 < len(set(held_out)) < len(names):
            raise SettingError("held_out", f"must leave runs on both sides; got {len(set(held_out))} of {len(names)}")
        return self.select([n for n in names if n not in held_out]), self.select(held_out)

    def select(self, names: Sequence[str]) -> "Log":
        """A log of the named runs."""
        return replace(self, runs=tuple(run for run in self.runs if run.name in set(names)))

    def split_by_time(self, share: float) -> tuple["Log", "Log"]:
        """Splits every run: a log of the first ``share`` of its rows, and one of the others."""
        check_number("share", share, above=0)
        cuts = [(run, min(max(round(share * len(run)), 1), len(run) - 1)) for run in self.runs]
        first = tuple(run.part(0, cut, "first part") for run, cut in cuts)
        last = tuple(run.part(cut, len(run), "last part") for run, cut in cuts)
        return replace(self, runs=first), replace(self, runs=last)

    def transitions(self) -> Transitions:
        """All transitions from one row to the next inside a piece, as data of GPs."""
        cut = self.windows(1)
        return Transitions(cut.states[:, 0], cut.inputs[:, 0], cut.states[:, 1])

    def episodes(self) -> list[Recording]:
        """Every piece of two rows or more as a recording for ``gpmpc.calibration``."""
        return [
            Recording(torch.from_numpy(run.states[a:b].copy()), torch.from_numpy(run.inputs[a : b - 1].copy()))
            for run in self.runs
            for a, b in run.pieces
            if b - a > 1
        ]

    def windows(self, ahead: int, past: int = 0, stride: int = 1) -> Windows:
        """Cuts windows that lie inside a piece each: rows before and after the start, and from one start to the next.

        Raises:
            DataError: No piece is as long.
        """
        for key, value, least in (("ahead", ahead, 0), ("past", past, 0), ("stride", stride, 1)):
            check_number(key, value, least=least, whole=True)
        offsets, parts = np.arange(-past, ahead + 1), []
        for number, run in enumerate(self.runs):
            starts = run.starts(past, ahead, stride)
            rows = starts[:, None] + offsets
            before, numbers = run.context[rows[:, : past + 1]], np.full(len(rows), number)
            parts.append((run.states[rows], run.inputs[rows], before, numbers, run.time[starts]))
        states, *others = (np.concatenate(one) for one in zip(*parts, strict=True))
        if not len(states):
            longest = max(b - a for run in self.runs for a, b in run.pieces)
            raise DataError(f"windows of {past + ahead + 1} rows need a piece as long; the longest has {longest}")
        return Windows(self.space, self.time_step, past, states, *others)

    def __iter__(self) -> Iterator[LogRun]:
        return iter(self.runs)


def check_plausible(runs: Sequence[LogRun], step: float, mapping: LogMapping) -> None:
    """Raises ``DataError`` where a velocity or rate contradicts the mapping in unit or axes, or no input changes."""
    inputs = [run.inputs for run in runs]
    if inputs[0].shape[1] and all(np.ptp(u, axis=0).max() == 0 for u in inputs):
        rows = sum(len(run) for run in runs)
        raise DataError(f"no input changes in {rows} rows: the system is at rest, and nothing can be learned of it")
    if mapping.model != "rigid_body":
        return
    signals = mapping.of("states")
    if [(s.group.kind, s.group.error_dim) for s in signals] != _RIGID_BODY:
        raise DataError(
            "a rigid body's states are position (3), attitude (quaternion or Euler angles), velocity (3) and angular "
            f"rate (3), in this order; the mapping has {', '.join(s.name for s in signals)}"
        )
    before, now, after = (_rows(runs, shift) for shift in (-SPAN, 0, SPAN))
    if len(now) < 50:
        return
    at, time = mapping.space.columns, 2 * SPAN * step
    _, q, v, w = (now[:, columns] for columns in at)
    names, frames = zip(*((signal.name, signal.frame) for signal in signals), strict=True)
    speed = (after[:, at[0]] - before[:, at[0]]) / time
    _compare(v if frames[2] != "body" else rotate(q, v), speed, names[2], f"the derivative of {names[0]}")
    turn = quaternion_product(quaternion_inverse(before[:, at[1]]), after[:, at[1]])
    body = rotation_vector(turn) / time
    world = rotate(q, body)
    found, other = (world, body) if frames[3] == "world" else (body, world)
    _compare(w, found, names[3], f"the derivative of {names[1]}", other, frames[3] or "body")


def _rows(runs: Sequence[LogRun], shift: int) -> Array:
    states = np.concatenate([run.states[run.starts(SPAN, SPAN) + shift] for run in runs])
    return states[:: max(len(states) // MOST_ROWS, 1)]


def _compare(
    signal: Array, derivative: Array, name: str, what: str, elsewhere: Array | None = None, frame: str = ""
) -> None:
    slope, fit = _regression(signal, derivative)
    if elsewhere is not None:
        _, fit_elsewhere = _regression(signal, elsewhere)
        if fit_elsewhere > FIT and fit_elsewhere > fit + 0.1:
            other = "world" if frame == "body" else "body"
            raise DataError(f"{name} is {what} in {other} axes (correlation {fit_elsewhere:.2f}), not {frame} ones")
    if fit > FIT and not SLOPES[0] < slope < SLOPES[1]:
        hint = next((f": {text}?" for factor, text in _HINTS if abs(np.log(abs(slope) / factor)) < 0.2), "")
        hint = ": its sign is turned" if -SLOPES[1] < slope < -SLOPES[0] else hint
        raise DataError(f"{name} is {slope:.3g} times {what} (correlation {fit:.2f}); is its unit right?{hint}")


def _regression(signal: Array, derivative: Array) -> tuple[float, float]:
    """Slope of the signal over the derivative, and the absolute correlation of the two."""
    a, b = (x - x.mean(axis=0) for x in (signal, derivative))
    aa, bb, ab = float((a * a).sum()), float((b * b).sum()), float((a * b).sum())
    return (ab / bb, abs(ab) / np.sqrt(aa * bb)) if aa > 0 and bb > 0 else (1.0, 0.0)
