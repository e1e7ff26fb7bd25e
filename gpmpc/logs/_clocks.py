"""Brings the stamps of logged rows into order, and finds where they jump.

Rows come late, and clocks are set while they run. So rows are sorted where that is
certain, and left out where it is not; what stands on both sides of a jump are pieces of
their own.
"""

from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError

# of the rows; beyond, the file does not hold one run in the order of time
MOST_OUT_OF_ORDER = 0.05
CLOSE = 0.6  # of the usual time step: a row that is closer to another mixes two clocks
MOST_FIT = 0.9  # of the rows out of order that have to fit, to be sorted
MOST_DROPS = 0.2  # of the rows; beyond, neighbours in the file are none in time
JUMP = 60.0  # [s] from which a step of time is a jump, if it is also
JUMP_STEPS = 100  # usual time steps: over neither is anything resampled
ORDER_ROWS = "name the column of the runs, or order the rows"
ORDER_TOPICS = "write 'stamp: log' to take the times of logging"


class Stamps(NamedTuple):
    """Stamps (K,) [s] that only increase, with what was wrong with them."""

    rows: np.ndarray  # (K,) of the table, those that are used
    time: Array  # (K,) [s]
    after_reversal: np.ndarray  # (K,) whether rows with earlier stamps stood before
    repeated: int
    backwards: int  # rows that are left out because a later stamp stood before
    disordered: int = 0  # rows that stood behind later ones, and are sorted


def ordered_stamps(stamps: Array, where: str, hint: str = ORDER_ROWS) -> Stamps:
    """Brings rows into the order of their stamps.

    Rows out of order are sorted if they fit between the others, as messages do that a
    file holds in another order, or parts on both sides of a clock that was set. Where
    sorting would mix rows, those whose stamp is not the latest are left out: a stamp is
    wrong, or a clock was set back.

    Args:
        stamps: Of the rows in the order of the file (K,) [s].
        where: Names the table, for errors.
        hint: Says what to do where too many rows run backwards.

    Raises:
        DataError: A stamp is not finite, or more than ``MOST_OUT_OF_ORDER`` of the rows
            run backwards.
    """
    if not np.isfinite(stamps).all():
        row = int(np.argmin(np.isfinite(stamps)))
        raise DataError(
            f"{where}: the time in row {row + 1} is {stamps[row]}; expected a number"
        )
    latest = np.maximum.accumulate(stamps)
    is_late = np.r_[False, stamps[1:] < latest[:-1]]
    if is_late.any() and _fit_between(stamps, is_late):
        return _sorted_rows(stamps, disordered=int(is_late.sum()))
    return _rising_rows(stamps, latest, where, hint)


def _sorted_rows(stamps: Array, disordered: int) -> Stamps:
    """Sorts rows by their stamps (K,) [s], one row for each stamp."""
    order = np.argsort(stamps, kind="stable")
    is_new = np.r_[True, np.diff(stamps[order]) > 0]
    return Stamps(
        rows=order[is_new],
        time=stamps[order][is_new],
        after_reversal=np.zeros(int(is_new.sum()), dtype=bool),
        repeated=int((~is_new).sum()),
        backwards=0,
        disordered=disordered,
    )


def _rising_rows(stamps: Array, latest: Array, where: str, hint: str) -> Stamps:
    """Takes the rows whose stamps (K,) [s] are later than all before.

    ``latest`` (K,) holds the latest stamp up to each row.
    """
    rises = np.r_[True, stamps[1:] > latest[:-1]]
    repeated = np.r_[False, stamps[1:] == stamps[:-1]] & ~rises
    backwards = ~rises & ~repeated
    if backwards.sum() > MOST_OUT_OF_ORDER * len(stamps):
        row = int(np.argmax(backwards))
        raise DataError(
            f"{where}: time runs backwards in row {row + 1} (from {stamps[row - 1]:g} "
            f"to {stamps[row]:g} s), and {int(backwards.sum())} rows come before the "
            f"latest stamp: {hint}"
        )
    rows = np.flatnonzero(rises)
    reversed_before = np.diff(np.cumsum(backwards)[rows], prepend=0) > 0
    return Stamps(
        rows=rows,
        time=stamps[rows],
        after_reversal=reversed_before,
        repeated=int(repeated.sum()),
        backwards=int(backwards.sum()),
    )


def _fit_between(stamps: Array, is_late: np.ndarray) -> bool:
    """Tells whether late rows, sorted in, are as far from others as is usual.

    True where late rows fill places that no other row has: a file holds them in another
    order. False where two runs or two clocks overlap in time.

    ``is_late`` (K,) marks rows with an earlier stamp than a row before them.
    """
    order = np.argsort(stamps, kind="stable")
    steps = np.diff(stamps[order])
    if not (steps > 0).any():
        return False
    usual = _usual_step(stamps, steps)
    nearest = np.minimum(np.r_[np.inf, steps], np.r_[steps, np.inf])
    fits = nearest[is_late[order]] >= CLOSE * usual
    return float(fits.mean()) >= MOST_FIT


def _usual_step(stamps: Array, sorted_steps: Array) -> float:
    """Returns the usual time step [s] of rows that are partly out of order.

    Two runs that overlap have half of it, once they are sorted. So steps are taken from
    neighbours in the file where most of these follow each other in time as well.

    Args:
        stamps: In the order of the file (K,) [s].
        sorted_steps: Between sorted stamps (K - 1,) [s], some of them positive.
    """
    steps = np.diff(stamps)
    if (steps < 0).sum() > MOST_DROPS * len(steps) or not (steps > 0).any():
        steps = sorted_steps
    return float(np.median(steps[steps > 0]))


def find_jumps(time: Array, max_gap: float | None) -> np.ndarray:
    """Finds the rows (J,) behind which time jumps by more than any gap within a run."""
    steps = np.diff(time)
    if not len(steps):
        return np.empty(0, dtype=int)
    longest = max(JUMP, JUMP_STEPS * float(np.median(steps)), max_gap or 0.0)
    return np.flatnonzero(steps > longest)
