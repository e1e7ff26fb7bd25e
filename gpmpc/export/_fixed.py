"""GPs in whole numbers: the tables of ``fixed.c``, which says what they mean."""

from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array, to_array
from gpmpc.export._text import Numbers, integers
from gpmpc.gp import GPPosterior

_LOG2_E = 1.0 / np.log(2.0)
# A square has 31 bits behind the point, and ``bits`` more by the scale of its sum. They
# are moved to the 40 of u, to the right by ``bits + 31 - 40``, which is never negative.
_LEAST_BITS = 40 - 31
_MOST_BITS = 60
# Of the magnitudes of weights: a smaller one is none, as of an output whose targets are
# all its prior mean. Its unit, and a whole number's part of that, would be infinite.
_LEAST_SUM = 2.0**64 * np.finfo(float).tiny
# Rounding of a mean and of a slope, as shares of the means' range over the points, and
# of that over the range of a feature. Beyond, an input may miss 1e-4 of its range: it
# did by 9e-4, under a light weight, with means of 2e-5 and slopes of 7e-4.
_MEAN_ERROR = 1e-4
_SLOPE_ERROR = 1e-4


class FixedPoint(NamedTuple):
    """GPs in whole numbers; see ``fixed.c``."""

    centre: Array  #: (d,)
    reach: Array  #: R (d,)
    points: Array  #: (d, N)
    scales: Array  #: (k, d)
    bits: Array  #: of the scales (k,)
    weights: Array  #: (k, N)
    remainders: Array  #: (k, N)
    weight_unit: Array  #: what beta is multiplied with (k,)


def fixed_point(gp: GPPosterior) -> FixedPoint | None:
    """Returns GPs in whole numbers; None where these are not exact enough."""
    x = to_array(gp.features)
    lengthscales = to_array(gp.lengthscales)
    beta = to_array(gp.weights)
    size = len(x)
    low = x.min(axis=0)
    high = x.max(axis=0)
    centre = (low + high) / 2
    reach = np.maximum(2 * (high - low), lengthscales.min(axis=0))
    squares = _LOG2_E / 2 * (reach / lengthscales) ** 2
    bits = np.floor(np.log2((2.0**32 - 1) / squares.sum(axis=1)))
    bits = np.minimum(bits, _MOST_BITS).astype(int)
    if (bits < _LEAST_BITS).any():
        return None
    if not _is_exact_enough(gp, reach):
        return None
    magnitudes = np.abs(beta).sum(axis=1)
    magnitudes = np.where(magnitudes > _LEAST_SUM, magnitudes, 1.0)
    weight_unit = (2.0**31 - 1 - 2 * size) / magnitudes
    scaled = beta * weight_unit[:, None]
    weights = np.floor(scaled)
    return FixedPoint(
        centre=centre,
        reach=reach,
        points=np.round((x - centre) / reach * 2.0**31).T,
        scales=np.floor(squares * 2.0 ** bits[:, None]),
        bits=bits,
        weights=weights,
        remainders=np.floor((scaled - weights) * (2.0**32 - 1)),
        weight_unit=weight_unit,
    )


def _is_exact_enough(gp: GPPosterior, reach: Array) -> bool:
    """Returns whether whole numbers round means and slopes finely enough.

    Terms that cancel to a millionth of them magnify what each rounds off: a square of
    31 bits, and for slopes a product beta k of which all have 31 bits.
    """
    x = to_array(gp.features)
    lengthscales = to_array(gp.lengthscales)
    weights = to_array(gp.weights) * to_array(gp.signal_variance)[:, None]
    feature_range = np.ptp(x, axis=0)
    for scales, beta in zip(lengthscales, weights, strict=True):
        z = x / scales
        squares = ((z[:, None] - z[None]) ** 2).sum(axis=2)
        kernel = np.exp(-squares / 2)
        output_range = max(np.ptp(kernel @ beta), np.finfo(float).tiny)
        exponent = 2.0**-31 * ((reach / scales) ** 2).sum() / 2
        mean_error = exponent * np.sqrt((kernel**2 @ beta**2).max())
        product_error = 2.0**-32 * np.sqrt(len(x)) * np.abs(beta).sum()
        slope_error = product_error * (reach / scales**2 * feature_range).max()
        if mean_error > _MEAN_ERROR * output_range:
            return False
        if slope_error > _SLOPE_ERROR * output_range:
            return False
    return True


def fixed_tables(gp: GPPosterior, prefix: str) -> str:
    """Returns the tables ``{prefix}_fixed`` as C."""
    fixed = fixed_point(gp)
    if fixed is None:
        return f"#define {prefix}_fixed (*(const gp_fixed_tables *)0)\n"
    table = Numbers("double").table
    signal = to_array(gp.signal_variance)
    mean_unit = signal / (fixed.weight_unit * 2.0**31)
    slope_units = mean_unit[:, None] * fixed.reach / to_array(gp.lengthscales) ** 2
    name = f"{prefix}_fixed"
    return "\n".join(
        [
            table(f"{name}_centre", fixed.centre, kind="double"),
            table(f"{name}_units", 2.0**31 / fixed.reach, kind="double"),
            integers(f"{name}_x", fixed.points.ravel(), kind="int32_t"),
            integers(f"{name}_scales", fixed.scales.ravel(), kind="uint32_t"),
            integers(f"{name}_shift", fixed.bits - _LEAST_BITS),
            integers(f"{name}_weights", fixed.weights.ravel(), kind="int32_t"),
            integers(f"{name}_remainders", fixed.remainders.ravel(), kind="uint32_t"),
            table(f"{name}_mean_unit", mean_unit, kind="double"),
            table(f"{name}_slope_units", slope_units, kind="double"),
            f"static const gp_fixed_tables {name} = {{\n"
            f"    {name}_centre, {name}_units, {name}_x, {name}_scales,\n"
            f"    {name}_shift, {name}_weights, {name}_remainders,\n"
            f"    {name}_mean_unit, {name}_slope_units}};\n",
        ]
    )
