"""Is a claim of infeasibility true?

By Farkas' lemma ``lower <= C x <= upper`` has no solution if a ray y satisfies C'y = 0 and
sum(y+ upper) + sum(y- lower) < 0: summing the constraints with these weights gives 0 < 0. In floating point C'y is
not zero. Where a variable has a bound, what is left is moved onto it; where it has none, what is left must be the
rounding of its own sum, for else a large x may satisfy the constraints.
"""

import numpy as np
from numpy.typing import NDArray

from gpmpc.qp.problem import ABSENT

Array = NDArray[np.float64]

ROUNDING = 4e-15  # share of a sum's terms that counts as rounding


@np.errstate(all="ignore")  # what is not finite proves nothing
def proves_infeasibility(ray: Array, G: Array, lower: Array, upper: Array) -> bool:
    """Whether ``ray`` (M,) is Farkas' proof that no x satisfies ``lower <= [x; Gx] <= upper``."""
    n = G.shape[1]
    rest = ray[:n] + ray[n:] @ G
    rounding = ROUNDING * (np.abs(ray[:n]) + np.abs(ray[n:]) @ np.abs(G))
    repaired = ray.copy()
    repaired[:n] -= np.where(np.abs(rest) > rounding, rest, 0.0)
    bounds = np.where(repaired > 0, upper, lower)
    used = repaired != 0
    products = repaired[used] * bounds[used]
    if (np.abs(bounds[used]) >= ABSENT).any() or not np.isfinite(products).all():
        return False
    sizes = np.abs(products).sum() + np.abs(ray[n:])[~G.any(axis=1)].sum() * zero_row_size(G, lower, upper)
    return bool(products.sum() < -ROUNDING * sizes)


def zero_row_size(G: Array, lower: Array, upper: Array) -> float:
    """The size of the numbers that cancelled in a zero row, which does not say: that of other bounds, one at most."""
    others = np.append(np.ones(G.shape[1], dtype=bool), G.any(axis=1))
    sizes = np.abs(np.concatenate([lower[others], upper[others]]))
    return float(min(1.0, sizes[sizes < ABSENT].max(initial=0.0) or 1.0))
