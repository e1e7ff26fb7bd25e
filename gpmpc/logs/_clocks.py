"""Brings the stamps of logged rows into order, and finds where they jump.

Rows come late, and clocks are set while they run. So rows are sorted where that is
certain, and left out where it is not; what stands on both sides of a jump are pieces of
their own.
"""

from collections.abc import Sequence
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
RESTART_ROWS = 10  # that lie before what came, after a clock that began anew
# of the time that a clock had gone; one that began anew shows less
RESTART_SHARE = 0.1
ORDER_ROWS = "name the column of the runs, or give each of them a file"
ORDER_TOPICS = "write 'stamp: log' to take the times of logging"


class Stamps(NamedTuple):
    """Stamps (K,) [s] that only increase, with what was wrong with them."""

    rows: np.ndarray  # (K,) of the table, those that are used
    time: Array  # (K,) [s]
    #: (K,) whether time does not go on from the row before: it ran backwards, the
    #: clock began anew, a block of counted rows ended, or how much time passed is not
    #: known
    starts_piece: np.ndarray
    repeated: int
    backwards: int  # rows that are left out because a later stamp stood before
    disordered: int = 0  # rows that stood behind later ones, and are sorted
    restarts: int = 0  # of the clock: what follows one has got later stamps


def ordered_stamps(
    stamps: Array,
    where: str,
    hint: str = ORDER_ROWS,
    may_restart: bool = False,
    max_gap: float | None = None,
) -> Stamps:
    """Brings rows into the order of their stamps.

    Rows out of order are sorted if they fit between the others, as messages do that a
    file holds in another order, or parts on both sides of a clock that was set. Where
    sorting would mix rows, those whose stamp is not the latest are left out: a stamp is
    wrong, or a clock was set back. Where a clock began anew, what follows is a part of
    its own, and gets stamps behind the others.

    Args:
        stamps: Of the rows in the order of the file (K,) [s].
        where: Names the table, for errors.
        hint: Says what to do where too many rows run backwards.
        may_restart: Whether the clock may begin anew. Where other tables have times in
            common with this one, nobody knows which.
        max_gap: Over which values are carried [s], where it is stated.

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
    rising = _rising_rows(stamps)
    if rising.backwards <= MOST_OUT_OF_ORDER * len(stamps):
        return rising
    parts = np.split(stamps, find_restarts(stamps)) if may_restart else [stamps]
    risings = [_rising_rows(part) for part in parts]
    left_out = sum(part.backwards for part in risings)
    if left_out > MOST_OUT_OF_ORDER * len(stamps):
        row = int(np.argmax(is_late))
        raise DataError(
            f"{where}: time runs backwards in row {row + 1} (from {stamps[row - 1]:g} "
            f"to {stamps[row]:g} s), and {rising.backwards} rows come before the "
            f"latest stamp: {hint}"
        )
    return _in_turn(risings, max_gap)


def _sorted_rows(stamps: Array, disordered: int) -> Stamps:
    """Sorts rows by their stamps (K,) [s], one row for each stamp."""
    order = np.argsort(stamps, kind="stable")
    is_new = np.r_[True, np.diff(stamps[order]) > 0]
    return Stamps(
        rows=order[is_new],
        time=stamps[order][is_new],
        starts_piece=np.zeros(int(is_new.sum()), dtype=bool),
        repeated=int((~is_new).sum()),
        backwards=0,
        disordered=disordered,
    )


def _rising_rows(stamps: Array) -> Stamps:
    """Takes the rows whose stamps (K,) [s] are later than all before."""
    latest = np.maximum.accumulate(stamps)
    rises = np.r_[True, stamps[1:] > latest[:-1]]
    repeated = np.r_[False, stamps[1:] == stamps[:-1]] & ~rises
    backwards = ~rises & ~repeated
    rows = np.flatnonzero(rises)
    reversed_before = np.diff(np.cumsum(backwards)[rows], prepend=0) > 0
    return Stamps(
        rows=rows,
        time=stamps[rows],
        starts_piece=reversed_before,
        repeated=int(repeated.sum()),
        backwards=int(backwards.sum()),
    )


def find_restarts(stamps: Array) -> np.ndarray:
    """Finds the rows (R,) at which a clock began anew, as after a reboot.

    It falls back to about where it had begun, and the rows that follow lie before those
    that came: other than after a row that is late, or rows of two clocks in turn.
    """
    drops = np.flatnonzero(np.diff(stamps) < 0) + 1
    if len(drops) > MOST_DROPS * len(stamps):
        return np.empty(0, dtype=int)
    restarts = []
    first = stamps[0]  # of the part before
    latest = first
    for drop in drops:
        latest = max(latest, stamps[drop - 1])
        following = stamps[drop : drop + RESTART_ROWS]
        begins_anew = stamps[drop] <= first + RESTART_SHARE * (latest - first)
        if len(following) == RESTART_ROWS and following.max() < latest and begins_anew:
            restarts.append(drop)
            first = stamps[drop]
            latest = first
    return np.array(restarts, dtype=int)


def _in_turn(parts: Sequence[Stamps], max_gap: float | None) -> Stamps:
    """Puts the rows of parts behind each other, whose clocks have nothing in common.

    How long it took from one to the next is unknown: longer than any gap.
    """
    rows = []
    times: list[Array] = []
    breaks = []
    begin = 0
    end = parts[0].time[0]
    for part in parts:
        pause = 0.0
        if times:
            steps = np.diff(part.time)
            usual_step = float(np.median(steps)) if len(steps) else 0.0
            pause = 2 * max(JUMP, JUMP_STEPS * usual_step, max_gap or 0.0)
        rows.append(begin + part.rows)
        times.append(part.time - part.time[0] + end + pause)
        breaks.append(np.r_[bool(pause), part.starts_piece[1:]])
        begin += len(part.rows) + part.repeated + part.backwards
        end = times[-1][-1]
    return Stamps(
        rows=np.concatenate(rows),
        time=np.concatenate(times),
        starts_piece=np.concatenate(breaks),
        repeated=sum(part.repeated for part in parts),
        backwards=sum(part.backwards for part in parts),
        restarts=len(parts) - 1,
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
