"""Fits axes, signs, units and lags of measured vectors to those of a motion.

Vectors are compared axis by axis. The *misfit* of two axes is a quantile of their
difference over the same quantile of the larger one: 0 where they agree, about 1 where
they have nothing to do with each other, 2 where one is the negative of the other. The
smallest of five quantiles counts, so that neither glitches nor long rests decide.

A fit supposes mistakes of whoever wrote the mapping: axes that changed places or signs,
a wrong unit, a lag. The fit with the smallest score is the best one:

    score = log misfit + CHANGE * cost
    log misfit = sum over the axes of log(max(misfit, floor))
    cost = axes cost + unit cost + lag cost                  [number of mistakes]

    axes cost  fewest mistakes that make the change of the axes (``axis_changes``)
    unit cost  0; 1 where all axes, or one, have a wrong unit; NO_UNIT where all have a
               factor that no unit makes
    lag cost   0; 1 where the vectors come later
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._frames import FRD, NED

QUANTILES = (0.5, 0.75, 0.9, 0.97, 0.99)  # of absolute values
FEWEST = 50  # vectors that say something
SHORTEST_LAG = 0.05  # [s] that is a lag
NO_UNIT = 1.5  # mistakes that a factor costs which no unit makes
CHANGE = 0.7  # of the score, by one mistake that is supposed


class _AxisChanges(NamedTuple):
    """The 48 ways in which axes change places and signs, by the number of mistakes."""

    matrices: Array  # (48, 3, 3)
    sources: np.ndarray  # (48, 3) of which axis each axis is
    flips: np.ndarray  # (48, 3) 1 where it is the negative of it
    costs: Array  # (48,)


@cache
def axis_changes() -> _AxisChanges:
    """Lists the products of the mistakes that people make, the fewest first."""
    swaps = [np.eye(3)[list(order)] for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1))]
    cycles = [np.eye(3)[list(order)] for order in ((1, 2, 0), (2, 0, 1))]
    flips = [np.diag(signs) for signs in ([-1, 1, 1], [1, -1, 1], [1, 1, -1])]
    mistakes = [*flips, -np.eye(3), FRD, NED, *swaps, *cycles]
    costs = {_key(np.eye(3)): 0}
    matrices = [np.eye(3)]
    for matrix in matrices:  # grows while it is gone through
        for mistake in mistakes:
            product = mistake @ matrix
            if _key(product) not in costs:
                costs[_key(product)] = costs[_key(matrix)] + 1
                matrices.append(product)
    stacked = np.array(matrices)
    return _AxisChanges(
        matrices=stacked,
        sources=np.abs(stacked).argmax(axis=2),
        flips=(stacked.sum(axis=2) < 0).astype(int),
        costs=np.array([costs[_key(matrix)] for matrix in matrices], dtype=float),
    )


def _key(matrix: Array) -> tuple[int, ...]:
    """Returns a matrix of whole numbers as the key of a dictionary."""
    return tuple(np.rint(matrix).astype(int).ravel().tolist())


def count_mistakes(matrix: Array) -> float:
    """Counts the mistakes that make a change of the axes (3, 3)."""
    changes = axis_changes()
    matches = (changes.matrices == np.rint(matrix)).all(axis=(1, 2))
    return float(changes.costs[int(np.argmax(matches))])


@dataclass(frozen=True)
class AxisFit:
    """Measured vectors as those of a motion: factors * matrix @ vector, later.

    The module's text has the formula of its score.
    """

    misfits: Array  # of the axes (3,)
    floor: float  # misfits below it count as this one
    matrix: Array = field(default_factory=lambda: np.eye(3))
    factors: Array = field(default_factory=lambda: np.ones(3))  # of the measured axes
    lag: float = 0.0  # [s] by which the measured ones come later
    axes_cost: float = 0.0  # number of mistakes, likewise below
    unit_cost: float = 0.0
    lag_cost: float = 0.0

    @property
    def log_misfit(self) -> float:
        """The sum of the logarithms of the misfits."""
        return float(np.log(np.maximum(self.misfits, self.floor)).sum())

    @property
    def cost(self) -> float:
        """The number of mistakes."""
        return self.axes_cost + self.unit_cost + self.lag_cost

    @property
    def score(self) -> float:
        """The score of the fit; the smaller, the better."""
        return self.log_misfit + CHANGE * self.cost


def absolute_quantiles(values: Array) -> Array:
    """Returns the quantiles (Q, ...) of absolute values (N, ...)."""
    places = [int(share * (len(values) - 1)) for share in QUANTILES]
    return np.partition(np.abs(values), places, axis=0)[places]


def centred(values: Array) -> Array:
    """Subtracts the median of values (N, ...)."""
    return values - np.median(values, axis=0)


def misfits(measured: Array, derived: Array) -> Array:
    """Returns the misfits (...) of measured to derived values (N, ...); see above."""
    measured = centred(measured)
    derived = centred(derived)
    sizes = np.maximum(absolute_quantiles(measured), absolute_quantiles(derived))
    errors = absolute_quantiles(measured - derived)
    ratios = np.divide(errors, sizes, out=np.ones_like(errors), where=sizes > 0)
    return ratios.min(axis=0)


class _UnitOption(NamedTuple):
    """All changes of axes, where one unit is supposed to be wrong, or none."""

    log_misfits: Array  # of each change of axes (48,)
    unit_cost: float
    unit: int  # number of the unit; 0 is the right one
    axis: int | None  # that has it; None: all three

    @property
    def scores(self) -> Array:
        """The score of each change of axes (48,)."""
        return self.log_misfits + CHANGE * (axis_changes().costs + self.unit_cost)


def _fit_axes(
    measured: Array, derived: Array, factors: Sequence[float], floor: float
) -> AxisFit:
    """Fits the change of axes and units that explains measured vectors (N, 3) best.

    One unit may be wrong: that of all axes, or of one.

    Args:
        measured: Vectors (N, 3).
        derived: Those of the motion (N, 3).
        factors: That wrong units make.
        floor: Misfits below it count as this one.
    """
    measured = centred(measured)
    derived = centred(derived)
    units = [1.0, *_plausible(factors, measured, derived)]
    table = np.array([_misfit_table(measured, unit * derived) for unit in units])
    changes = axis_changes()
    # of each axis, by unit and change of axes (U, 48, 3)
    axis_misfits = table[:, np.arange(3), changes.sources, changes.flips]
    options = _unit_options(np.log(np.maximum(axis_misfits, floor)), units, factors)
    best = min(options, key=lambda option: option.scores.min())
    change = int(best.scores.argmin())
    axes = slice(None) if best.axis is None else best.axis
    scale = np.ones(3)
    scale[axes] = units[best.unit]
    misfits_of_best = axis_misfits[0, change].copy()
    misfits_of_best[axes] = axis_misfits[best.unit, change, axes]
    return AxisFit(
        misfits=misfits_of_best,
        floor=floor,
        matrix=changes.matrices[change],
        factors=scale,
        axes_cost=float(changes.costs[change]),
        unit_cost=best.unit_cost,
    )


def _unit_options(
    log_misfits: Array, units: Sequence[float], factors: Sequence[float]
) -> list[_UnitOption]:
    """Lists the units with which all axes, or one, may be wrong; the first is none.

    Args:
        log_misfits: By unit, change of axes and axis (U, 48, 3).
        units: The factor of each; the first is 1 (U,).
        factors: That wrong units make; another factor is no unit, and costs NO_UNIT.
    """
    sums = log_misfits.sum(axis=2)  # (U, 48)
    options = [_UnitOption(sums[0], unit_cost=0.0, unit=0, axis=None)]
    for unit in range(1, len(units)):
        is_unit = units[unit] in factors
        unit_cost = 1.0 if is_unit else NO_UNIT
        options.append(_UnitOption(sums[unit], unit_cost, unit, axis=None))
        if not is_unit:
            continue
        for axis in range(3):
            change_of_axis = log_misfits[unit, :, axis] - log_misfits[0, :, axis]
            options.append(_UnitOption(sums[0] + change_of_axis, unit_cost, unit, axis))
    return options


def _misfit_table(measured: Array, derived: Array) -> Array:
    """Returns misfits (3, 3, 2) of measured to derived axes and to their negatives."""
    own = absolute_quantiles(measured)[:, :, None, None]
    others = absolute_quantiles(derived)[:, None, :, None]
    differences = measured[:, :, None] - derived[:, None, :]
    sums = measured[:, :, None] + derived[:, None, :]
    errors = absolute_quantiles(np.stack([differences, sums], axis=-1))
    sizes = np.broadcast_to(np.maximum(own, others), errors.shape)
    ratios = np.divide(errors, sizes, out=np.ones_like(errors), where=sizes > 0)
    return ratios.min(axis=0)


def _plausible(
    factors: Sequence[float], measured: Array, derived: Array
) -> list[float]:
    """Returns the factors that the sizes allow, and their ratio where it is large."""
    large = QUANTILES.index(0.9)
    sizes = absolute_quantiles(measured)[large]
    derived_sizes = absolute_quantiles(derived)[large]
    ratios = sizes[:, None] / np.maximum(derived_sizes, 1e-300)
    units = [f for f in factors if ((ratios > 0.7 * f) & (ratios < 1.4 * f)).any()]
    total = float(np.square(sizes).sum())
    derived_total = float(np.square(derived_sizes).sum())
    if min(total, derived_total) <= 0:
        return units
    usual = float(np.sqrt(total / derived_total))
    is_large = not 0.5 < usual < 2
    if is_large and not any(abs(usual / unit - 1) < 0.05 for unit in units):
        units.append(usual)
    return units


def correlation(vectors: Array, references: Array) -> Array:
    """Returns the correlations (3,) of axes of vectors (N, 3), without glitches."""
    a = _without_glitches(vectors)
    b = _without_glitches(references)
    product = (a * b).sum(axis=0)
    scale = np.sqrt((a * a).sum(axis=0) * (b * b).sum(axis=0))
    return np.divide(product, scale, out=np.zeros(3), where=scale > 0)


def _without_glitches(vectors: Array) -> Array:
    """Centres vectors (N, 3), and cuts their largest hundredth off at either side."""
    low, high = np.quantile(vectors, [0.01, 0.99], axis=0)
    clipped = np.clip(vectors, low, high)
    return clipped - clipped.mean(axis=0)


class LaggedVectors(NamedTuple):
    """Measured vectors at all lags, ready to be correlated with others."""

    lags: Array  # (L,) [s]
    later: Array  # (L, N, 3); NaN beyond the piece
    clipped: Array  # likewise, centred and without glitches; 0 beyond the piece
    inside: np.ndarray  # (L, N)
    squares: Array  # sums of squares of the clipped ones (L, 3)


def lagged_vectors(lags: Array, later: Array) -> LaggedVectors:
    """Makes vectors (L, N, 3) at lags [s] (L,) ready to be correlated with others."""
    inside = np.isfinite(later[:, :, 0])
    now = later[len(lags) // 2]
    low, high = np.nanquantile(now, [0.01, 0.99], axis=0)
    clipped = np.clip(later, low, high) - np.nanmedian(now, axis=0)
    clipped[~inside] = 0.0
    squares = np.square(clipped).sum(axis=1)
    return LaggedVectors(lags, later, clipped, inside, squares)


def lagged_correlations(series: LaggedVectors, derived: Array) -> Array:
    """Returns correlations (L, 3, 3) of measured axes with derived ones, by lag."""
    low, high = np.quantile(derived, [0.01, 0.99], axis=0)
    derived = np.clip(derived, low, high) - np.median(derived, axis=0)
    products = np.swapaxes(series.clipped, 1, 2) @ derived
    own = series.squares[:, :, None]
    others = (series.inside.astype(float) @ np.square(derived))[:, None, :]
    scale = np.sqrt(own * others)
    correlations = np.divide(
        products, scale, out=np.zeros_like(products), where=scale > 0
    )
    enough = series.inside.sum(axis=1) >= max(FEWEST, 0.3 * len(derived))
    correlations[~enough] = 0.0
    return correlations


def agreements(series: LaggedVectors, derived: Array) -> Array:
    """Sums the correlations of the axes in their best order, at each lag (L,)."""
    correlations = np.abs(lagged_correlations(series, derived))
    axes = np.arange(3)
    orders = np.array(list(itertools.permutations(axes)))
    return correlations[:, axes, orders].sum(axis=2).max(axis=1)


def fit_axes_and_lag(
    series: LaggedVectors, derived: Array, factors: Sequence[float], floor: float
) -> AxisFit:
    """Fits a change of axes and units, now or at the lag that correlates most."""
    now = len(series.lags) // 2
    rows = series.inside[now]
    fit = _fit_axes(series.later[now][rows], derived[rows], factors, floor)
    sums = agreements(series, derived)
    lag = int(sums.argmax())
    if abs(series.lags[lag]) < SHORTEST_LAG or sums[lag] <= sums[now]:
        return fit
    rows = series.inside[lag]
    late = _fit_axes(series.later[lag][rows], derived[rows], factors, floor)
    late = replace(late, lag=float(series.lags[lag]), lag_cost=1.0)
    return late if late.score < fit.score else fit
