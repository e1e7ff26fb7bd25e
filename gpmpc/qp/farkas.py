"""Is a claim of infeasibility true?

By Farkas' lemma ``lower <= C x <= upper`` has no solution if a ray y satisfies C'y = 0 and
sum(y+ upper) + sum(y- lower) < 0: summing the constraints with these weights gives 0 < 0. In floating point C'y is
not zero; what is left of it is moved onto the box where a variable has bounds, and must be rounding where it has
none.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 1e-9  # share of the sums' sizes that counts as rounding


def proves_infeasibility(ray: Array, G: Array, lower: Array, upper: Array) -> bool:
    """Whether ``ray`` (M,) is Farkas' proof that no x satisfies ``lower <= [x; Gx] <= upper``."""
    n = G.shape[1]
    rest = ray[:n] + ray[n:] @ G
    magnitude = np.abs(ray[:n]) + np.abs(ray[n:]) @ np.abs(G)
    repaired = ray.copy()
    repairable = np.where(rest > 0, np.isfinite(lower[:n]), np.isfinite(upper[:n]))
    unbounded = ~repairable & (np.abs(rest) > ROUNDING * np.maximum(magnitude, magnitude.max()))
    if unbounded.any():
        return False
    repaired[:n] -= np.where(repairable, rest, 0.0)
    bounds = np.where(repaired > 0, upper, lower)
    used = repaired != 0
    products = repaired[used] * bounds[used]
    if not np.isfinite(products).all():
        return False
    return bool(products.sum() < -ROUNDING * np.abs(products).sum())
