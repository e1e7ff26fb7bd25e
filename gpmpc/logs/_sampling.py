"""Time stamps and resampling: what is wrong with stamps is counted, and no value is carried over a gap."""

from typing import NamedTuple

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._state_space import Array, quaternion_inverse, quaternion_product, rotation_quaternion, rotation_vector

MOST_OUT_OF_ORDER = 0.05  # of the rows; beyond, the file does not hold one run in the order of time

RESOLUTION = 1e-6  # [s] of stamps: float64 seconds since 1970 resolve a quarter of it


class Stamps(NamedTuple):
    """Stamps (K,) [s] that only increase, with what was wrong with them."""

    rows: np.ndarray  # (K,) of the table, those that are used
    time: Array  # (K,) [s]
    after_reversal: np.ndarray  # (K,) whether rows with earlier stamps stood before this one
    repeated: int
    backwards: int


def ordered_stamps(stamps: Array, where: str) -> Stamps:
    """Leaves out rows whose stamp is not above all before it.

    Raises:
        DataError: A stamp is not finite, or time runs backwards for more than 5 % of the rows.
    """
    if not np.isfinite(stamps).all():
        row = int(np.argmin(np.isfinite(stamps)))
        raise DataError(f"{where}: the time in row {row + 1} is {stamps[row]}; expected a number")
    latest = np.maximum.accumulate(stamps)
    rises = np.r_[True, stamps[1:] > latest[:-1]]
    repeated = np.r_[False, stamps[1:] == stamps[:-1]] & ~rises
    backwards = ~rises & ~repeated
    if backwards.sum() > MOST_OUT_OF_ORDER * len(stamps):
        row = int(np.argmax(backwards))
        raise DataError(
            f"{where}: time runs backwards in row {row + 1} (from {stamps[row - 1]:g} to {stamps[row]:g} s), and "
            f"{int(backwards.sum())} rows come before the latest stamp: name the column of the runs, or order the rows"
        )
    rows = np.flatnonzero(rises)
    reversed_before = np.diff(np.cumsum(backwards)[rows], prepend=0) > 0
    return Stamps(rows, stamps[rows], reversed_before, int(repeated.sum()), int(backwards.sum()))


def resample(time: Array, values: Array, grid: Array, rule: str, max_gap: float) -> Array:
    """Computes values (G, c) at the times of a grid (G,) from samples (K, c) at times (K,); NaN in and beyond gaps.

    Args:
        time: Of the samples, increasing [s].
        values: (K, c); rows with a NaN are left out, so that a gap is one there.
        grid: [s]
        rule: "hold" takes the last sample, "linear" interpolates, "spherical" interpolates quaternions.
        max_gap: Longest time between two samples, and since the last one, that is bridged [s].
    """
    present = np.isfinite(values).all(axis=1)
    time, values = time[present], values[present]
    if len(time) == 0:
        return np.full((len(grid), values.shape[1]), np.nan)
    at = np.searchsorted(time, grid + RESOLUTION, side="right") - 1
    before, after = np.clip(at, 0, None), np.clip(at + 1, None, len(time) - 1)
    lag, span = grid - time[before], time[after] - time[before]
    exact = (at >= 0) & (lag <= RESOLUTION)
    if rule == "hold":
        usable = (at >= 0) & (lag <= max_gap)
        found = values[before]
    else:
        share = np.divide(lag, span, out=np.zeros_like(lag), where=span > 0)[:, None]
        one, other = values[before], values[after]
        if rule == "spherical":
            turn = rotation_vector(quaternion_product(quaternion_inverse(one), other))
            found = quaternion_product(one, rotation_quaternion(share * turn))
        else:
            found = one + share * (other - one)
        usable = exact | ((at >= 0) & (at < len(time) - 1) & (span <= max_gap))
    return np.where(usable[:, None], found, np.nan)
