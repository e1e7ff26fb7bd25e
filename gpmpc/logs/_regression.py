"""Least squares on columns of any units.

A pressure of 1e5 Pa stands beside a valve's opening of 1e-3 m, and a place on a map is
a million metres from its origin. So columns are centred and divided by their
deviations before anything is solved: what a least squares takes for nothing is then a
matter of the rows, and not of a unit.
"""

from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.gp._data_checks import constant_columns

_COLLINEAR = 1e-8  # of the largest singular value: what is smaller says nothing


class Standardization(NamedTuple):
    """Means and standard deviations of columns.

    The deviation of a column that never moves is infinite: it is zero everywhere.
    """

    mean: Array  #: (d,)
    deviation: Array  #: (d,)

    @classmethod
    def of(cls, columns: Array) -> "Standardization":
        """Computes those of columns (N, d), which move where it is not round-off."""
        mean = columns.mean(axis=0)
        deviation = (columns - mean).std(axis=0)
        is_constant = constant_columns(columns, resolution=0.0)
        return cls(mean, np.where(is_constant, np.inf, deviation))

    def __call__(self, columns: Array) -> Array:
        """Returns columns (N, d) as multiples of their deviations from the means."""
        return (columns - self.mean) / self.deviation


def fit_affine(columns: Array, targets: Array) -> Array:
    """Fits targets (N, o) that are affine in columns (N, d).

    A column that never moves has the weight zero, since nobody knows its effect.

    Returns:
        The weights of the columns as they are, and the constant, last (d + 1, o).
    """
    scales = Standardization.of(columns)
    mean_target = targets.mean(axis=0)
    solution: Any = np.linalg.lstsq(
        scales(columns), targets - mean_target, rcond=_COLLINEAR
    )
    weights = solution[0] / scales.deviation[:, None]
    return np.vstack([weights, mean_target - scales.mean @ weights])
