"""Splits a log into folds: rows that models are fitted to, and rows held out.

A fold says something only where its training rows cover what its held-out rows do. A
transient and then rest, cut into two halves, asks each model to extrapolate to the
other half, and every model but the simplest is refused. So runs are dealt to folds
where there are many; of few runs, blocks of rows take turns, with a gap between them in
the training rows, so that no row to predict is near what a model was fitted to. What a
prediction begins with, the past, may be rows of the block before.

Half of many rows says what all of them say. Of a short log it does not, and structures
are chosen that suit half of its rows: there four folds hold out a quarter each.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._log import Log, LogRun
from gpmpc.logs._ranges import ranges_of, shares_inside

MANY_RUNS = 4  # from which on whole runs are dealt
_SHORT = 3000  # rows of a log, below which it has more folds
_FOLDS_OF_SHORT = 4
_BLOCKS = (4, 8, 16)  # of a log of few runs
_DEALS = 60  # ways to deal runs that are compared
_BALANCED = 0.6  # least rows of a fold, of their mean
_NEARLY = 0.02  # of the coverage that decides nothing
_MARGIN = 0.02  # of a range by which it may be exceeded
_ROLLOUTS = 2  # of the longest, one after the other, that a block is to have rows for
_GAP_SHARE = 6  # a gap is no longer than a block divided by this
_COUNTS = {2: "two", 4: "four"}


class Fold(NamedTuple):
    """A split of a log into runs that models are fitted to, and held-out runs.

    Held-out blocks begin with the past of their first prediction, which may be rows
    that models are fitted to.
    """

    train: Log
    held_out: Log


@dataclass(frozen=True)
class Folds:
    """Folds of a log, each of which is fitted to what the others hold out."""

    parts: tuple[Fold, ...]  #: two or more
    method: str  #: how the log was split, in words
    #: share of held-out rows inside the range of the rows that models are fitted to,
    #: or beyond it by 2 % of it at most, for the fold and the state or input that are
    #: covered worst
    coverage: float

    @property
    def sentence(self) -> str:
        """How the log was split and how well that covers it, in a line."""
        return (
            f"{self.method}; of every state and input at least {self.coverage:.0%} of "
            "the held-out values lie inside the range fitted to"
        )


def split_folds(log: Log, past: int, steps: int, most: int = _FOLDS_OF_SHORT) -> Folds:
    """Splits a log into two folds; into four where it is short.

    Args:
        log: All runs.
        past: Rows that a window has before its start.
        steps: Rows that it has after it.
        most: Folds, two or four: of structures with few parameters half of the rows
            tell enough.

    Raises:
        DataError: No piece of the log is long enough for windows in both folds.
    """
    if len(log) < _SHORT and most > 2:
        folds = _split(log, most, past, steps)
        if folds is not None:
            return folds
    folds = _split(log, 2, past, steps) or _halves(log, past)
    _check_windows(folds, past, steps)
    return folds


def _split(log: Log, count: int, past: int, steps: int) -> Folds | None:
    """Splits a log into folds; returns None where it is too short for so many."""
    splits: list[Folds] = []
    if len(log.runs) >= max(MANY_RUNS, count):
        splits = _deals_of_runs(log, count, past, steps)
    best_deal = _best(splits)
    if best_deal is not None and best_deal.coverage >= 1 - 5 * _NEARLY:
        return best_deal
    short: list[Folds] = []
    for blocks in _BLOCKS:
        folds = _blocks(log, count, blocks, past, steps)
        if folds is not None:
            if len(log) / blocks < _ROLLOUTS * steps:
                short.append(folds)
            else:
                splits.append(folds)
    return _best(splits or short)


def _best(splits: list[Folds]) -> Folds | None:
    """Returns the first split that covers nearly as much as any; None of none."""
    if not splits:
        return None
    most = max(split.coverage for split in splits)
    return next(split for split in splits if split.coverage >= most - _NEARLY)


def _deals_of_runs(log: Log, folds: int, past: int, steps: int) -> list[Folds]:
    """Returns ways to deal whole runs to folds, the best one alone."""
    runs = sorted(log.runs, key=len)
    count = len(runs)
    deals = [tuple(tuple(range(first, count, folds)) for first in range(folds))]
    if folds == 2:
        for first_fold in _deals(count):
            second_fold = tuple(i for i in range(count) if i not in first_fold)
            deals.append((first_fold, second_fold))
    splits = []
    for deal in deals:
        held_out = [tuple(runs[i] for i in own) for own in deal]
        train = [
            tuple(run for other in held_out if other is not own for run in other)
            for own in held_out
        ]
        method = f"{count} runs, dealt to {_COUNTS[folds]} folds"
        dealt = _folds(log, held_out, train, method)
        if _is_usable(dealt, past, steps):
            splits.append(dealt)
    return sorted(splits, key=lambda folds: -folds.coverage)[:1]


def _deals(count: int) -> list[tuple[int, ...]]:
    """Returns the first fold's runs of some deals to two folds.

    They are all deals, or of many some by chance: the first ones in any order would be
    alike. The first run is in the second fold, as every deal has a mirror image.
    """
    size = count // 2
    if math.comb(count - 1, size) <= _DEALS:
        return list(itertools.combinations(range(1, count), size))
    rng = np.random.default_rng(0)
    drawn = [1 + rng.permutation(count - 1)[:size] for _ in range(_DEALS)]
    return [tuple(sorted(deal.tolist())) for deal in drawn]


def _blocks(log: Log, folds: int, count: int, past: int, steps: int) -> Folds | None:
    """Returns folds of blocks that take turns; None where these are too short."""
    window = past + steps
    length = len(log) / count
    between = int((folds - 1) * length)  # rows between two blocks of a fold
    without_overlap = window  # no row of a held-out window is trained on
    # Of short blocks little would be left to train on: there the past of a held-out
    # window has training rows, and its end is near to them; that is accepted.
    affordable = int(length / _GAP_SHARE)
    leaves_a_window = (between - window - 1) // 2  # with a gap on both sides of it
    gap = min(without_overlap, affordable, leaves_a_window)
    if gap < 0:
        return None
    blocks = _blocks_of_runs(log, folds, length, past)
    if len(blocks) < folds:
        return None
    held_out: list[tuple[LogRun, ...]] = []
    train: list[tuple[LogRun, ...]] = []
    for fold in range(folds):
        own = [block for block in blocks if block.fold == fold]
        held_out.append(tuple(block.rows for block in own))
        train.append(tuple(_between(log, own, gap)))
    if not all(train):
        return None
    method = (
        f"{len(blocks)} blocks of {length * log.time_step:.3g} s that take turns in "
        f"{_COUNTS[folds]} folds, {gap * log.time_step:.3g} s left out of the training "
        "rows at their ends"
    )
    split = _folds(log, held_out, train, method)
    return split if _is_usable(split, past, steps) else None


class _Block(NamedTuple):
    """A part of a run that one fold holds out."""

    rows: LogRun
    run: int  # number of the run that it is of
    begin: int  # its first row there
    end: int  # the row after its last one
    fold: int


def _blocks_of_runs(log: Log, folds: int, length: float, past: int) -> list[_Block]:
    """Cuts runs into blocks of about a length, which take turns to be held out.

    Each has so many rows of the past before those that are to be predicted.
    """
    blocks: list[_Block] = []
    for number, run in enumerate(log):
        for begin, end in itertools.pairwise(_cuts(run, length)):
            rows = run.part(max(begin - past, 0), end, f"block {len(blocks) + 1}")
            blocks.append(_Block(rows, number, begin, end, len(blocks) % folds))
    return blocks


def _between(log: Log, held_out: list[_Block], gap: int) -> list[LogRun]:
    """Returns the rows of a log that are held out by no block, nor near to one."""
    between = []
    for number, run in enumerate(log):
        begin = 0
        for block in held_out:
            if block.run != number:
                continue
            if block.begin - gap > begin:
                between.append(run.part(begin, block.begin - gap, f"from {begin}"))
            begin = block.end + gap
        if begin < len(run):
            between.append(run.part(begin, len(run), f"from {begin}"))
    return between


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


def _halves(log: Log, past: int) -> Folds:
    """Returns folds of the first and the second half of every run.

    Held out, the second half has so many rows of the past before it.
    """
    first, second = log.split_by_time(0.5)
    with_past = []
    for run, half in zip(log, first, strict=True):
        begin = max(len(half) - past, 0)
        with_past.append(run.part(begin, len(run), "last part"))
    return _folds(
        log,
        held_out=[first.runs, tuple(with_past)],
        train=[second.runs, first.runs],
        method="two halves by time: the log is too short for more",
    )


def _folds(
    log: Log,
    held_out: Sequence[tuple[LogRun, ...]],
    train: Sequence[tuple[LogRun, ...]],
    method: str,
) -> Folds:
    """Returns folds of runs.

    Args:
        log: That the runs are of.
        held_out: Runs that each fold holds out.
        train: Runs that its models are fitted to, likewise.
        method: How the log was split, in words.
    """
    folds = tuple(
        Fold(
            train=replace(log, runs=train_runs),
            held_out=replace(log, runs=held_out_runs),
        )
        for held_out_runs, train_runs in zip(held_out, train, strict=True)
    )
    return Folds(folds, method, min(_coverage(fold) for fold in folds))


def _is_usable(folds: Folds, past: int, steps: int) -> bool:
    """Returns whether all folds have windows, and none has few rows."""
    rows = [len(fold.held_out) for fold in folds.parts]
    if min(rows) < _BALANCED * np.mean(rows):
        return False
    try:
        _check_windows(folds, past, steps)
    except DataError:
        return False
    return True


def _check_windows(folds: Folds, past: int, steps: int) -> None:
    """Raises ``DataError`` unless both sides of all folds have windows."""
    for fold in folds.parts:
        fold.train.windows(steps, past, most=1)
        fold.held_out.windows(steps, past, most=1)


def _coverage(fold: Fold) -> float:
    """Returns the share of held-out rows inside the range of the training rows.

    It is that of the state or input that is covered worst.
    """
    ranges = ranges_of(fold.train)
    return float(shares_inside(fold.held_out, ranges, _MARGIN).min())
