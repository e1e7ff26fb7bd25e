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
    tolerance = margin * (high - low) + 1e-12
    inside = (values >= low - tolerance) & (values <= high + tolerance)
    return inside.mean(axis=0)


def _rows(log: Log) -> Array:
    """Returns states and inputs of all rows (N, n + m)."""
    values = np.concatenate([np.hstack([run.states, run.inputs]) for run in log])
    for group, columns in zip(log.space.groups, log.space.columns, strict=True):
        if group.kind == "quaternion":  # x, y, z, w
            is_opposite = values[:, columns.stop - 1] < 0
            values[is_opposite, columns] *= -1
    return values
