"""Finds values of a log that no sensor measured, although they are numbers.

A logger writes a sentinel such as -9999 where it has no value, zeros while it has no
message, and the last value again while a sensor is silent. Each can be told from a
measurement by what stands around it.
"""

import numpy as np

from gpmpc._dynamics import Array

# What loggers write for "no value": round numbers, and the ends of integer types.
SENTINELS = np.array(
    [-999.0, 999.0, -9999.0, 9999.0, -99999.0, 99999.0, 999999.0, -999999.0]
    + [sign * 2.0**bits - (sign > 0) for bits in (15, 31, 63) for sign in (-1, 1)]
    + [2.0**bits - 1 for bits in (16, 32, 64)]
)
HUGE = 1e20  # no state, input or context has such values in any unit
SENTINEL_RANGES = (
    10.0  # ranges of the other values, from which on a sentinel is no measurement
)
JUMP_CHANGES = 3.0  # usual changes, from which on a change is a jump
FROZEN = 10  # rows
FROZEN_AT_END = 50  # rows, of a stretch that nothing ends
FEWEST_CHANGES = 10  # that tell how a sensor changes
MAJORITY = 0.5  # of rows
SMALL_QUANTILE = 0.1  # quantile of the changes that is a small one
VARIED = 0.3  # of the usual change: changes below it are of a sensor without steps


def sentinels(values: Array) -> np.ndarray:
    """Finds sentinels in a column.

    A known sentinel is one where it lies far beyond the range of all other values.
    Where those do not move, or there are none, only negative and huge ones are certain.

    Args:
        values: Of one column in the units of the file (K,).

    Returns:
        Whether each row holds one (K,).
    """
    finite = np.isfinite(values)
    candidates = finite & (np.isin(values, SENTINELS) | (np.abs(values) >= HUGE))
    measured = values[finite & ~candidates]
    if not candidates.any():
        return candidates
    if not len(measured) or measured.min() == measured.max():
        return candidates & ((values < 0) | (np.abs(values) >= HUGE))
    lowest = measured.min()
    highest = measured.max()
    margin = SENTINEL_RANGES * max(highest - lowest, abs(lowest), abs(highest))
    return candidates & ((values < lowest - margin) | (values > highest + margin))


def zero_dropouts(states: Array) -> np.ndarray:
    """Finds stretches in which all states are exactly zero, with a jump at an end.

    A simulation begins at zeros as well, and leaves them with the largest change that
    it has. So zeros in the first row are no measurement only where what ends them is a
    jump beside all other changes.

    Args:
        states: Columns that are logged together (K, n), two or more.

    Returns:
        Whether each row belongs to one (K,).
    """
    zero = (states == 0).all(axis=1)
    if states.shape[1] < 2 or not zero.any() or zero.all():
        return np.zeros(len(states), dtype=bool)
    changes = np.abs(np.diff(states, axis=0))
    between = zero[1:] | zero[:-1]
    measured_changes = changes[~between]
    usual = _usual_change(measured_changes)
    largest = np.nanmax(measured_changes, axis=0, initial=0.0)
    jumps = np.any(changes > JUMP_CHANGES * usual, axis=1)
    jumps_from_start = np.any(changes > JUMP_CHANGES * largest, axis=1)
    dropouts = np.zeros(len(states), dtype=bool)
    for begin, end in _stretches(zero):
        jumps_in = begin > 0 and jumps[begin - 1]
        out = jumps if begin > 0 else jumps_from_start
        jumps_out = end < len(states) and out[end - 1]
        dropouts[begin:end] = jumps_in or jumps_out
    return dropouts


def frozen_rows(column: Array, moving: np.ndarray) -> np.ndarray:
    """Finds rows that repeat a value for so long that its sensor was silent.

    A value with a coarse resolution repeats as well, and then moves on by one step of
    it; a sensor that was silent jumps. One that stays silent to the end of the run
    never does.

    Args:
        column: One state (K,).
        moving: Whether other states move in a row (K,).

    Returns:
        Whether each row repeats the one before, in such a stretch (K,).
    """
    changes = np.abs(np.diff(column))
    usual = _usual_change(changes[:, None])[0]
    repeats = np.concatenate([[False], changes == 0])
    frozen = np.zeros(len(column), dtype=bool)
    for begin, end in _stretches(repeats):
        at_end = end == len(column)
        long_enough = end - begin >= (FROZEN_AT_END if at_end else FROZEN)
        ends_as_silence = at_end or changes[end - 1] > JUMP_CHANGES * usual
        others_move = moving[begin:end].mean() > MAJORITY
        if long_enough and ends_as_silence and others_move:
            frozen[begin:end] = True
    return frozen


def changes_rarely(column: Array, moving: np.ndarray) -> bool:
    """Tells whether a state has a lower rate than its rows.

    It then repeats in most rows in which others move; other than a value with a coarse
    resolution, it changes by any amount.
    """
    changes = np.abs(np.diff(column))[moving[1:]]
    nonzero = changes[changes > 0]
    if len(nonzero) < FEWEST_CHANGES or len(nonzero) > MAJORITY * len(changes):
        return False
    small_change = float(np.quantile(nonzero, SMALL_QUANTILE))
    return small_change < VARIED * float(np.median(nonzero))


def _usual_change(changes: Array) -> Array:
    """Returns the median of each column's changes (K, n) but zeros (n,); 0 of none."""
    nonzero = np.where(changes > 0, changes, np.nan)
    usual = np.zeros(changes.shape[1])
    moves = (changes > 0).any(axis=0)
    usual[moves] = np.nanmedian(nonzero[:, moves], axis=0)
    return usual


def _stretches(rows: np.ndarray) -> list[tuple[int, int]]:
    """Lists the first row, and the one after the last, of each stretch of true ones."""
    edges = np.diff(np.concatenate([[False], rows, [False]]).astype(int))
    begins = np.flatnonzero(edges == 1)
    ends = np.flatnonzero(edges == -1)
    return [(int(begin), int(end)) for begin, end in zip(begins, ends, strict=True)]
