"""Rows that may be violated at a price.

A row with a *quadratic* weight rho pays 1/2 rho v^2 for a violation v (its multiplier is rho v); one with a *linear*
weight w pays w |v|, the exact L1 penalty (Fletcher, Practical Methods of Optimization, 1987, section 14.3): it is met
exactly as long as its multiplier stays below w. In the dual both are simple: a quadratic weight adds 1/rho to the
diagonal of K, a linear one caps the multiplier. A row that is to pay both prices is written twice, once with each.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpmpc.exceptions import ProblemError
from gpmpc.qp.problem import as_float_array


@dataclass(frozen=True, eq=False)
class SoftRows:
    """Weights per row of G; infinity keeps a row hard.

    Args:
        quadratic: (m,) rho > 0, the price 1/2 rho v^2 of a violation v; infinite where omitted.
        linear: (m,) w > 0, the price w |v|; infinite where omitted.

    Raises:
        ProblemError: A weight that is not positive, or two finite weights on one row.
    """

    quadratic: NDArray[np.float64] | ArrayLike | None = None
    linear: NDArray[np.float64] | ArrayLike | None = None

    def __post_init__(self):
        given = self.quadratic if self.quadratic is not None else self.linear
        if given is None:
            raise ProblemError("soft rows need quadratic weights, linear weights, or both; got neither")
        for name in ("quadratic", "linear"):
            value = getattr(self, name)
            array = np.full(np.shape(given), np.inf) if value is None else value
            array = as_float_array(f"{name} weights", array, (np.size(given),))
            if not (array > 0.0).all():
                i = int(np.argmin(array > 0.0))
                raise ProblemError(f"{name} weight of row {i} must be positive; got {array[i]:.6g}")
            object.__setattr__(self, name, array)
        both = np.isfinite(self.quadratic) & np.isfinite(self.linear)
        if both.any():
            i = int(np.argmax(both))
            raise ProblemError(f"row {i} has a quadratic and a linear weight: write the row twice, once with each")

    def stacked(self, variables: int) -> NDArray[np.float64]:
        """(2, M): 1/rho and the cap of the multiplier for the stacked constraints ``[x; Gx]``."""
        box = np.zeros(variables)
        return np.ascontiguousarray(
            [np.concatenate([box, 1.0 / self.quadratic]), np.concatenate([box + np.inf, self.linear])]
        )


def stack_softness(soft: SoftRows | None, variables: int, rows: int) -> NDArray[np.float64]:
    """(2, M) softness and caps; zeros and infinities where nothing is soft."""
    if soft is None:
        return np.vstack([np.zeros(variables + rows), np.full(variables + rows, np.inf)])
    if len(soft.quadratic) != rows:
        raise ProblemError(f"soft weights must be given for every row of G; got {len(soft.quadratic)} for {rows} rows")
    return soft.stacked(variables)
