"""Splits a log into folds: rows that models are fitted to, and rows held out.

A fold says something only where its training rows cover what its held-out rows do. A
transient and then rest, cut into two halves, asks each model to extrapolate to the
other half, and every model but the simplest is refused. So runs are dealt to two folds
where there are many; of few runs, blocks of rows take turns, with a gap between them in
the training rows, so that no held-out window overlaps what a model was fitted to.
"""

import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._log import Log, LogRun

_MANY_RUNS = 4  # from which on whole runs are dealt
_BLOCKS = (4, 8, 16)  # of a log of few runs
_DEALS = 60  # ways to deal runs that are compared
_BALANCED = 0.3  # least share of the rows in either fold
_NEARLY = 0.02  # of the coverage that decides nothing
_MARGIN = 0.02  # of a range by which it may be exceeded
_GAP_SHARE = 6  # a gap is no longer than a block divided by this


class Fold(NamedTuple):
    """A split of a log into runs that models are fitted to, and held-out runs."""

    train: Log
    held_out: Log


@dataclass(frozen=True)
class Folds:
    """Two folds of a log, each of which holds out what the other is fitted to."""

    pair: tuple[Fold, Fold]
    words: str  #: how the log was split
    #: share of held-out rows inside the range of the rows that models are fitted to,
    #: for the fold and the state or input that are covered worst
    coverage: float

    @property
    def sentence(self) -> str:
        """How the log was split and how well that covers it, in a line."""
        return (
            f"{self.words}; of every state and input at least {self.coverage:.0%} of "
            "the held-out values lie inside the range fitted to"
        )


def split_folds(log: Log, past: int, steps: int) -> Folds:
    """Splits a log into two folds.

    Args:
        log: All runs.
        past: Rows that a window has before its start.
        steps: Rows that it has after it.

    Raises:
        DataError: No piece of the log is long enough for windows in both folds.
    """
    splits: list[Folds] = []
    if len(log.runs) >= _MANY_RUNS:
        splits = _deals_of_runs(log, past, steps)
    best_deal = _best(splits)
    if best_deal is not None and best_deal.coverage >= 1 - 5 * _NEARLY:
        return best_deal
    for blocks in _BLOCKS:
        folds = _blocks(log, blocks, past, steps)
        if folds is not None:
            splits.append(folds)
    best = _best(splits)
    if best is None:
        return _halves(log)
    return best


def _best(splits: list[Folds]) -> Folds | None:
    """Returns the first split that covers nearly as much as any; None of none."""
    if not splits:
        return None
    most = max(split.coverage for split in splits)
    return next(split for split in splits if split.coverage >= most - _NEARLY)


def _deals_of_runs(log: Log, past: int, steps: int) -> list[Folds]:
    """Returns ways to deal whole runs to two folds, the best one alone."""
    runs = sorted(log.runs, key=len)
    count = len(runs)
    splits = []
    for deal in _deals(count):
        first = tuple(runs[i] for i in deal)
        second = tuple(runs[i] for i in range(count) if i not in deal)
        folds = _folds(
            log, (first, second), (first, second), f"{count} runs, dealt to two folds"
        )
        if _is_usable(folds, past, steps):
            splits.append(folds)
    return sorted(splits, key=lambda folds: -folds.coverage)[:1]


def _deals(count: int) -> list[tuple[int, ...]]:
    """Returns the first fold's runs of some deals, alternating ones first.

    The others are all deals, or of many some by chance: the first ones in any order
    would be alike. The first run is in the second fold, as every deal has a mirror
    image.
    """
    alternating = tuple(range(0, count, 2))
    size = count // 2
    if math.comb(count - 1, size) <= _DEALS:
        return [alternating, *itertools.combinations(range(1, count), size)]
    rng = np.random.default_rng(0)
    drawn = [1 + rng.permutation(count - 1)[:size] for _ in range(_DEALS)]
    return [alternating, *(tuple(sorted(deal.tolist())) for deal in drawn)]


def _blocks(log: Log, count: int, past: int, steps: int) -> Folds | None:
    """Returns folds of blocks that take turns; None where these are too short."""
    window = past + steps
    length = len(log) / count
    gap = min(window, int(length / _GAP_SHARE), (int(length) - window - 1) // 2)
    if gap < 0:
        return None
    held_out: tuple[list[LogRun], list[LogRun]] = ([], [])
    train: tuple[list[LogRun], list[LogRun]] = ([], [])
    number = 0
    for run in log:
        cuts = _cuts(run, length)
        for begin, end in itertools.pairwise(cuts):
            name = f"block {number + 1}"
            fold = number % 2
            held_out[fold].append(run.part(begin, end, name))
            first = begin + gap * (begin > 0)
            last = end - gap * (end < len(run))
            train[fold].append(run.part(first, last, name))
            number += 1
    if number < 2:
        return None
    words = (
        f"{number} blocks of {length * log.time_step:.3g} s that take turns, "
        f"{gap * log.time_step:.3g} s left out of the training rows at their ends"
    )
    folds = _folds(
        log,
        (tuple(held_out[0]), tuple(held_out[1])),
        (tuple(train[0]), tuple(train[1])),
        words,
    )
    return folds if _is_usable(folds, past, steps) else None


def _cuts(run: LogRun, length: float) -> list[int]:
    """Returns the rows at which a run is cut into blocks of about a length.

    A cut that is near the begin of a piece is there.
    """
    count = max(round(len(run) / length), 1)
    cuts = np.linspace(0, len(run), count + 1).round().astype(int)
    begins = np.array(run.begins)
    for i in range(1, count):
        nearest = int(begins[np.abs(begins - cuts[i]).argmin()])
        if abs(nearest - cuts[i]) < length / 4:
            cuts[i] = nearest
    return np.unique(cuts).tolist()


def _halves(log: Log) -> Folds:
    """Returns folds of the first and the second half of every run."""
    first, second = log.split_by_time(0.5)
    runs = (first.runs, second.runs)
    return _folds(log, runs, runs, "two halves by time: the log is too short for more")


def _folds(
    log: Log,
    held_out: tuple[tuple[LogRun, ...], tuple[LogRun, ...]],
    train: tuple[tuple[LogRun, ...], tuple[LogRun, ...]],
    words: str,
) -> Folds:
    """Returns the folds of two parts of a log, each fitted to where the other is not.

    Args:
        log: That the runs are of.
        held_out: Runs of both parts, when they are held out.
        train: Likewise, when models are fitted to them.
        words: How the log was split.
    """
    pair = (
        Fold(replace(log, runs=train[1]), replace(log, runs=held_out[0])),
        Fold(replace(log, runs=train[0]), replace(log, runs=held_out[1])),
    )
    return Folds(pair, words, min(_coverage(fold) for fold in pair))


def _is_usable(folds: Folds, past: int, steps: int) -> bool:
    """Returns whether both folds have windows, and neither has few rows."""
    rows = [len(fold.held_out) for fold in folds.pair]
    if min(rows) < _BALANCED * sum(rows):
        return False
    try:
        for fold in folds.pair:
            fold.train.windows(steps, past, most=1)
            fold.held_out.windows(steps, past, most=1)
    except DataError:
        return False
    return True


def _coverage(fold: Fold) -> float:
    """Returns the share of held-out rows inside the range of the training rows.

    It is that of the state or input that is covered worst.
    """
    train = _rows(fold.train)
    held_out = _rows(fold.held_out)
    low = train.min(axis=0)
    high = train.max(axis=0)
    margin = _MARGIN * (high - low) + 1e-12
    inside = (held_out >= low - margin) & (held_out <= high + margin)
    return float(inside.mean(axis=0).min())


def _rows(log: Log) -> Array:
    """Returns states and inputs of all rows (N, n + m)."""
    return np.concatenate([np.hstack([run.states, run.inputs]) for run in log])
