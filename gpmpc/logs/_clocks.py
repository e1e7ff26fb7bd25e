"""Brings the stamps of logged rows into order, cuts them at jumps, and resamples between.

Rows come late, clocks are set while they run, and a grid over a jump of ten days would
take all memory. So rows are sorted where that is certain, and what stands on both sides
of a jump are pieces of their own.
"""

from typing import NamedTuple

import numpy as np

from gpmpc._angles import wrap
from gpmpc.exceptions import DataError
from gpmpc.logs._kinematics import (
    Array,
    quaternion_inverse,
    quaternion_product,
    rotation_quaternion,
    rotation_vector,
)

# of the rows; beyond, the file does not hold one run in the order of time
MOST_OUT_OF_ORDER = 0.05
CLOSE = 0.6  # of the usual time step: a row that is closer to another mixes two clocks
MOST_FIT = 0.9  # of the rows out of order that have to fit, to be sorted
JUMP = 60.0  # [s] from which a step of time is a jump, if it is also
JUMP_STEPS = 100  # usual time steps: over neither is anything resampled
RESOLUTION = 1e-6  # [s] of stamps: float64 seconds since 1970 resolve a quarter of it
ORDER_ROWS = "name the column of the runs, or order the rows"
ORDER_TOPICS = "stamp: log takes the times of the log"


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
        order = np.argsort(stamps, kind="stable")
        is_new = np.r_[True, np.diff(stamps[order]) > 0]
        return Stamps(
            rows=order[is_new],
            time=stamps[order][is_new],
            after_reversal=np.zeros(int(is_new.sum()), dtype=bool),
            repeated=int((~is_new).sum()),
            backwards=0,
            disordered=int(is_late.sum()),
        )
    rises = np.r_[True, stamps[1:] > latest[:-1]]
    repeated = np.r_[False, stamps[1:] == stamps[:-1]] & ~rises
    backwards = ~rises & ~repeated
    if backwards.sum() > MOST_OUT_OF_ORDER * len(stamps):
        row = int(np.argmax(backwards))
        raise DataError(
            f"{where}: time runs backwards in row {row + 1} (from {stamps[row - 1]:g} to {stamps[row]:g} s), and "
            f"{int(backwards.sum())} rows come before the latest stamp: {hint}"
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
    """Whether late rows, where they are sorted in, are as far from others as usual.

    ``is_late`` (K,) marks rows with an earlier stamp than a row before them.
    """
    order = np.argsort(stamps, kind="stable")
    steps = np.diff(stamps[order])
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    nearest = np.minimum(np.r_[np.inf, steps], np.r_[steps, np.inf])
    fits = nearest[is_late[order]] >= CLOSE * usual
    return usual > 0 and float(fits.mean()) >= MOST_FIT


def find_jumps(time: Array, max_gap: float | None) -> np.ndarray:
    """Rows (J,) behind which time jumps: by more than any gap within a run."""
    steps = np.diff(time)
    if not len(steps):
        return np.empty(0, dtype=int)
    longest = max(JUMP, JUMP_STEPS * float(np.median(steps)), max_gap or 0.0)
    return np.flatnonzero(steps > longest)


def cut_pieces(time: Array, max_gap: float | None) -> Array:
    """Begins and ends (P, 2) [s] of the pieces between jumps."""
    jumps = find_jumps(time, max_gap)
    begins = time[np.r_[0, jumps + 1]]
    ends = time[np.r_[jumps, len(time) - 1]]
    return np.column_stack([begins, ends])


def intersect_pieces(pieces: Array, others: Array) -> Array:
    """What two lists of pieces (P, 2), in the order of time, have in common (C, 2)."""
    common = []
    i = 0
    j = 0
    while i < len(pieces) and j < len(others):
        begin = max(pieces[i, 0], others[j, 0])
        end = min(pieces[i, 1], others[j, 1])
        if begin < end:
            common.append((begin, end))
        if pieces[i, 1] < others[j, 1]:
            i += 1
        else:
            j += 1
    return np.array(common).reshape(-1, 2)


def count_rows_alone(time: Array, pieces: Array, common: Array) -> int:
    """How many rows of a topic stand in pieces (P, 2) of which nothing is in common."""
    # the first common piece that ends behind the begin of each
    candidates = np.searchsorted(common[:, 1], pieces[:, 0])
    nearest = common[np.minimum(candidates, len(common) - 1)]
    is_alone = (nearest[:, 1] < pieces[:, 0]) | (nearest[:, 0] > pieces[:, 1])
    ends = np.searchsorted(time, pieces[:, 1], side="right")
    rows = ends - np.searchsorted(time, pieces[:, 0])
    return int(rows[is_alone].sum())


def resample(
    time: Array,
    values: Array,
    grid: Array,
    rule: str,
    max_gap: float,
    angles: bool = False,
) -> Array:
    """Computes values (G, c) at the times of a grid (G,) [s] from samples (K, c) at increasing times (K,) [s].

    The rule "hold" takes the last sample, "linear" interpolates, "spherical" interpolates quaternions. Values are NaN
    beyond the samples and where two of them are farther apart than ``max_gap`` [s]; samples with a NaN are left out.
    Between two ``angles`` [rad] the rule "linear" goes the short way round.
    """
    present = np.isfinite(values).all(axis=1)
    time = time[present]
    values = values[present]
    if not len(time):
        return np.full((len(grid), values.shape[1]), np.nan)
    at = np.searchsorted(time, grid + RESOLUTION, side="right") - 1
    before = np.clip(at, 0, None)
    after = np.clip(at + 1, None, len(time) - 1)
    lag = grid - time[before]
    span = time[after] - time[before]
    if rule == "hold":
        usable = (at >= 0) & (lag <= max_gap)
        found = values[before]
    else:
        share = np.divide(lag, span, out=np.zeros_like(lag), where=span > 0)[:, None]
        one = values[before]
        other = values[after]
        if rule == "spherical":
            turn = rotation_vector(quaternion_product(quaternion_inverse(one), other))
            found = quaternion_product(one, rotation_quaternion(share * turn))
        else:
            change = wrap(other - one) if angles else other - one
            found = one + share * change
        usable = (at >= 0) & (
            (lag <= RESOLUTION) | ((at < len(time) - 1) & (span <= max_gap))
        )
    return np.where(usable[:, None], found, np.nan)
