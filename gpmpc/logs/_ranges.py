"""Ranges of the states and inputs of a log.

An angle and the same angle a turn later are one direction, and a quaternion and its
opposite are one attitude: two runs may count turns otherwise, or begin at either sign.
So the range of an angle is the shortest arc that holds all of its values, and the real
part of a quaternion is not negative.
"""

import numpy as np

from gpmpc._angles import arc, whole_turns
from gpmpc._dynamics import Array
from gpmpc.logs._log import Log
from gpmpc.models._state_space import StateSpace

_ROUNDING = 1e-12  # of a value
_STEP = 1e-6  # of a width
_STEP_OF_SIZE = 1e-8  # of the largest value: less is lost in its rounding
_LARGEST_STEP = 1e-2  # of a width


def ranges_of(log: Log) -> Array:
    """Returns smallest and largest states and inputs (2, n + m) of all rows.

    Those of an angle begin in [-pi, pi], and may end beyond it.
    """
    values = _rows(log)
    ranges = np.stack([values.min(axis=0), values.max(axis=0)])
    for index in log.space.angles:
        ranges[:, index] = arc(values[:, index])
    return ranges


def shares_inside(log: Log, ranges: Array, margin: float) -> Array:
    """Computes the share of rows (n + m,) whose states and inputs lie inside ranges.

    Args:
        log: Whose rows they are.
        ranges: From ``ranges_of`` another log (2, n + m).
        margin: Share of a range by which it may be exceeded.
    """
    values = _rows(log)
    low, high = ranges
    middle = (low + high) / 2
    for index in log.space.angles:
        values[:, index] -= whole_turns(values[:, index] - middle[index])
    # Of what never moves, the round-off.
    rounding = _ROUNDING * np.maximum(np.abs(low), np.abs(high))
    tolerance = margin * (high - low) + rounding
    inside = (values >= low - tolerance) & (values <= high + tolerance)
    return inside.mean(axis=0)


def widths_of(values: Array) -> Array:
    """Returns the ranges (c,) of values (K, c): of still ones their size, or one."""
    ranges = np.ptp(values, axis=0)
    sizes = np.abs(values).max(axis=0)
    return np.where(ranges > 0, ranges, np.where(sizes > 0, sizes, 1.0))


def state_widths(space: StateSpace, states: Array) -> Array:
    """Returns the widths (e,) of the entries of states (K, n), as of ``widths_of``."""
    return widths_of(space.difference(states, space.origin))


def difference_steps(values: Array) -> Array:
    """Returns steps (c,) for differences of functions of values (K, c).

    They are a small share of the widths, and more than round-off of large values.
    """
    widths = widths_of(values)
    sizes = np.abs(values).max(axis=0)
    least = _STEP * widths
    return np.clip(_STEP_OF_SIZE * sizes, least, _LARGEST_STEP * widths)


def _rows(log: Log) -> Array:
    """Returns states and inputs of all rows (N, n + m)."""
    values = np.concatenate([np.hstack([run.states, run.inputs]) for run in log])
    for group, columns in zip(log.space.groups, log.space.columns, strict=True):
        if group.kind == "quaternion":  # x, y, z, w
            is_opposite = values[:, columns.stop - 1] < 0
            values[is_opposite, columns] *= -1
    return values
