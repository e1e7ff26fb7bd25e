"""Checks that the states of a rigid body are what the mapping says, by what holds of every rigid body.

Three relations hold in windows of a tenth of a second, whatever drives the body:

1. the mean velocity is the change of the position over the time;
2. the mean angular rate is the turn of the attitude over the time;
3. a vehicle that is carried along its own axis z (a multirotor, a boat, a banking
   aeroplane) accelerates to where it tilts: a_xy / (a_z + g) = t_xy / t_z, with t the
   body's axis z in world axes. Only gravity tells up from down.

A relation is judged axis by axis. Its *misfit* is a quantile of the difference of both
sides over the same quantile of the larger side: 0 where they agree, about 1 where they
have nothing to do with each other, 2 where one is the negative of the other. The smallest
of five quantiles counts, so that neither glitches nor long rests decide.

Where the claim of the mapping fits badly, other readings of the same columns are tried:
the order of a quaternion, its inverse, axes, signs, columns that changed places, units,
lags. The one that fits with the fewest changes is named. Where the third relation fits
no reading, such as that of a car, it says nothing.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gpmpc.exceptions import DataError
from gpmpc.logs._frames import (
    FRD,
    FRD_TURN,
    NAMES,
    NED,
    NED_TURN,
    attitudes_to_enu,
    axes_to_enu,
    rates_to_body,
    velocities_to_world,
)
from gpmpc.logs._kinematics import (
    GRAVITY,
    Array,
    quaternion_inverse,
    quaternion_product,
    rotate,
    rotation_vector,
)
from gpmpc.logs._log import Finding, LogRun
from gpmpc.logs._mapping import DEGREE, UNITS, LogMapping, Signal

_RIGID_BODY = [("vector", 3), ("quaternion", 3), ("vector", 3), ("vector", 3)]
HALF_WINDOW = 0.1  # [s] on each side of the middle of a window
HALF_SHORT = 0.03  # [s] likewise, of a body that turns fast
FAST = 1.5  # [rad] within a window that is turning fast
HALF_WIDE = 0.1  # [s] of the windows of accelerations, which are noisier
WINDOWS = 800  # of a run that are looked at
FEWEST = 50  # windows that say something
LEAST_AGREEMENT = 0.7  # likewise, of which another reading is worth while
AGREEMENT = 0.15  # in the sum of three correlations, which is more than chance
LONGEST_LAG = 0.8  # [s] that is sought
LAG_STEP = 0.02  # [s] from one lag to the next
QUANTILES = (0.5, 0.75, 0.9, 0.97, 0.99)  # of absolute values
FITS = 0.75  # misfit below which an axis may fit
HALF = 0.5  # of the claim's misfit, which a better reading has to stay below
DOUBTFUL = 0.2  # misfit from which another reading is looked for
BAD = 0.8  # misfit from which an axis fits badly
TILT_FITS = 0.6  # likewise of the third relation, which drag disturbs
TILT_MOVES = 0.3  # [m/s2] of the horizontal force from which it is looked at
CHANGE = 0.7  # that a change of the reading costs, in logarithms of misfits
RARE = 1.25  # mistakes that a rarer one counts for
NEAR = 0.25  # of the score within which two readings cannot be told apart
GAIN = 0.3  # least gain in logarithms, beyond that, for which a reading is believed
NAMED_LAG = 0.1  # [s] from which a lag is refused
NOTED_LAG = 0.05  # [s] from which it is a finding
MOVES = 0.3  # [m/s], [rad/s] from which an axis that nothing explains is refused
SMOOTH = 0.8  # correlation with the next window of what is no noise
UNRELATED = (
    0.5  # correlation below which two signals have nothing to do with each other
)
# Misfits below these are noise or smoothing, and no reason to prefer a reading.
_FLOOR_VELOCITY, _FLOOR_RATE, _FLOOR_TILT = 0.05, 0.1, 0.1
_LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "in": 0.0254}
_SPEEDS = {
    "m/s": 1.0,
    "mm/s": 1e-3,
    "cm/s": 1e-2,
    "km/h": 1 / 3.6,
    "ft/s": 0.3048,
    "kn": 1852 / 3600,
    "mph": 0.44704,
}
_ANGLES = {"rad": 1.0, "deg": DEGREE}
_RATES = {"rad/s": 1.0, "deg/s": DEGREE, "rpm": float(np.pi / 30)}


def read_rigid_bodies(
    runs: Sequence[LogRun], step: float, mapping: LogMapping
) -> tuple[list[LogRun], list[Finding]]:
    """Brings states to ENU and FLU axes, velocities to the world's, rates to the body's.

    Returns:
        The runs, and what was noticed.

    Raises:
        DataError: The states are not those of a rigid body, or contradict the mapping.
    """
    signals = mapping.of("states")
    kinds = [(signal.group.kind, signal.group.error_dim) for signal in signals]
    if kinds != _RIGID_BODY:
        names = ", ".join(signal.name for signal in signals)
        raise DataError(
            "a rigid body's states are position (3), attitude (quaternion or Euler "
            "angles), velocity (3) and angular rate (3), in this order; the mapping "
            f"has {names}"
        )
    claim = _Claim(mapping)
    findings = check_conventions(runs, step, claim)
    return [replace(run, states=claim.read(run.states)) for run in runs], findings


class _Claim:
    """What a mapping says of the states of a rigid body."""

    def __init__(self, mapping: LogMapping) -> None:
        self.position, self.attitude, self.velocity, self.rate = mapping.of("states")
        self.velocity_frame = self.velocity.frame or "world"
        self.rate_frame = self.rate.frame or "body"
        self.frame = mapping.frame or "enu"
        self.axes = {s.name: mapping.axes_of(s) for s in mapping.of("states")}

    def to_enu(self, signal: Signal, frame: str) -> Array:
        """The matrix (3, 3) that brings a vector of the file to ENU or FLU axes."""
        return axes_to_enu(self.axes[signal.name], frame)

    def turn_axes(self, states: Array) -> Array:
        """States (..., 13) in ENU and FLU axes, in the frames that the mapping says."""
        p, q, v, w = np.split(states, [3, 7, 10], axis=-1)
        parts = [
            p @ self.to_enu(self.position, "world"),
            attitudes_to_enu(q, self.axes[self.attitude.name]),
            v @ self.to_enu(self.velocity, self.velocity_frame),
            w @ self.to_enu(self.rate, self.rate_frame),
        ]
        return np.concatenate(parts, axis=-1)

    def read(self, states: Array) -> Array:
        """States (..., 13) as the package has them."""
        states = self.turn_axes(states)
        velocities = velocities_to_world(states, self.velocity_frame)
        rates = rates_to_body(states, self.rate_frame)
        return np.concatenate([states[..., :7], velocities, rates], axis=-1)


def check_conventions(
    runs: Sequence[LogRun], step: float, claim: _Claim
) -> list[Finding]:
    """Checks every run that is long enough, and all short ones together.

    Raises:
        DataError: The states contradict the mapping; the text says what fits.
    """
    findings: list[Finding] = []
    short: list[LogRun] = []
    for run in runs:
        if len(run) * step >= 4 * LONGEST_LAG and len(run) > 4 * FEWEST:
            where = f"run {run.name}: " if len(runs) > 1 else ""
            findings += _check([run], step, claim, where)
        else:
            short.append(run)
    if short:
        findings += _check(short, step, claim, "")
    return findings


class _Windows(NamedTuple):
    """N windows of a log in ENU and FLU axes, but for the attitudes: as in the file."""

    moves: Array  # change of the position over the time (N, 3)
    attitudes: Array  # at the first, middle and last row (3, N, 4)
    velocities: Array  # mean (N, 3)
    rates: Array  # mean (N, 3)
    duration: float  # [s]
    lags: Array  # (L,) [s]
    later_velocities: Array  # by each lag (L, N, 3); NaN beyond the piece
    later_rates: Array  # likewise
    wide_attitudes: Array  # at the rows of longer windows (3, N, 4)
    wide_positions: Array  # likewise (3, N, 3)
    wide_velocities: Array  # at their first and last row (2, N, 3)
    wide_duration: float  # [s]


def _cut_windows(runs: Sequence[LogRun], step: float, claim: _Claim) -> _Windows | None:
    """Windows that lie inside a piece each; None where there are too few."""
    half = max(round(HALF_WINDOW / step), 1)
    if _turns_fast(runs, half):
        half = max(round(HALF_SHORT / step), 1)
    wide = max(round(HALF_WIDE / step), half)
    starts = [run.starts(wide, wide) for run in runs]
    count = sum(len(rows) for rows in starts)
    if count < FEWEST:
        return None
    stride = -(-count // WINDOWS)
    stride_of_lags = max(round(LAG_STEP / step), 1)
    last_lag = int(LONGEST_LAG / step) // stride_of_lags
    lags = stride_of_lags * np.arange(-last_lag, last_lag + 1)
    parts = []
    for run, rows_of_run in zip(runs, starts, strict=True):
        rows = rows_of_run[::stride]
        raw = run.states[:, 3:7]
        states = claim.turn_axes(run.states)
        means = _moving_mean(states[:, 7:13], half)
        later = rows + lags[:, None]
        piece = np.searchsorted(run.begins, rows, side="right") - 1
        first = np.array(run.begins)[piece]
        end = np.array([*run.begins[1:], len(run)])[piece]
        inside = (later >= first + half) & (later < end - half)
        later_means = means[np.where(inside, later, 0)]
        later_means[~inside] = np.nan
        parts.append(
            (
                states[rows + half, 0:3] - states[rows - half, 0:3],
                np.stack([raw[rows + shift] for shift in (-half, 0, half)]),
                means[rows],
                later_means,
                np.stack([raw[rows + shift] for shift in (-wide, 0, wide)]),
                np.stack([states[rows + shift, 0:3] for shift in (-wide, 0, wide)]),
                np.stack([states[rows + shift, 7:10] for shift in (-wide, wide)]),
            )
        )
    (
        moves,
        attitudes,
        means,
        later_means,
        wide_attitudes,
        wide_positions,
        wide_velocities,
    ) = (np.concatenate(arrays, axis=-2) for arrays in zip(*parts, strict=True))
    duration = 2 * half * step
    return _Windows(
        moves=moves / duration,
        attitudes=attitudes,
        velocities=means[:, 0:3],
        rates=means[:, 3:6],
        duration=duration,
        lags=lags * step,
        later_velocities=later_means[..., 0:3],
        later_rates=later_means[..., 3:6],
        wide_attitudes=wide_attitudes,
        wide_positions=wide_positions,
        wide_velocities=wide_velocities,
        wide_duration=2 * wide * step,
    )


def _turns_fast(runs: Sequence[LogRun], half: int) -> bool:
    """Whether turns within windows come near to half a turn, and cannot be told."""
    angles = []
    for run in runs:
        rows = run.starts(half, half)
        ends = run.states[rows - half, 3:7], run.states[rows + half, 3:7]
        cosines = np.abs((ends[0] * ends[1]).sum(axis=1))
        angles.append(2 * np.arccos(np.minimum(cosines, 1.0)))
    return float(np.quantile(np.concatenate(angles), 0.99)) > FAST


def _moving_mean(values: Array, half: int) -> Array:
    """Means (K, c) of the rows from ``half`` before to ``half`` after, by trapezoids."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    means = np.zeros_like(values)
    if len(values) > 2 * half:
        whole = sums[2 * half + 1 :] - sums[: -2 * half - 1]
        ends = (values[: -2 * half] + values[2 * half :]) / 2
        means[half : len(values) - half] = (whole - ends) / (2 * half)
    return means


# --- Axes -----------------------------------------------------------------------------


class _AxisChanges(NamedTuple):
    """The 48 ways in which axes change places and signs, by the number of mistakes."""

    matrices: Array  # (48, 3, 3)
    sources: np.ndarray  # (48, 3) of which axis each axis is
    flips: np.ndarray  # (48, 3) 1 where it is the negative of it
    costs: Array  # (48,)


@cache
def _axis_changes() -> _AxisChanges:
    """Products of the mistakes that are made, the fewest first."""
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
    """A matrix of whole numbers as the key of a dictionary."""
    return tuple(np.rint(matrix).astype(int).ravel().tolist())


def _cost(matrix: Array) -> float:
    """The number of mistakes that make a change of the axes."""
    changes = _axis_changes()
    matches = (changes.matrices == np.rint(matrix)).all(axis=(1, 2))
    return float(changes.costs[int(np.argmax(matches))])


@dataclass(frozen=True)
class _Fit:
    """How measured vectors are those of the motion: factors * matrix @ vector, later."""

    matrix: Array = field(default_factory=lambda: np.eye(3))
    factors: Array = field(default_factory=lambda: np.ones(3))  # of the measured axes
    lag: float = 0.0  # [s] by which the measured ones come later
    misfits: Array = field(default_factory=lambda: np.ones(3))
    cost: float = 0.0  # number of mistakes
    score: float = 0.0  # sum of the misfits' logarithms, with the cost


def _quantiles(values: Array) -> Array:
    """Quantiles (Q, ...) of absolute values (N, ...)."""
    places = [int(share * (len(values) - 1)) for share in QUANTILES]
    return np.partition(np.abs(values), places, axis=0)[places]


def _centred(values: Array) -> Array:
    return values - np.median(values, axis=0)


def misfits(measured: Array, derived: Array) -> Array:
    """Misfits (...) of measured values to derived ones (N, ...), as this file says."""
    measured = _centred(measured)
    derived = _centred(derived)
    sizes = np.maximum(_quantiles(measured), _quantiles(derived))
    errors = _quantiles(measured - derived)
    ratios = np.divide(errors, sizes, out=np.ones_like(errors), where=sizes > 0)
    return ratios.min(axis=0)


def _fit_axes(
    measured: Array, derived: Array, factors: Sequence[float], floor: float
) -> _Fit:
    """The change of axes and units that explains measured vectors (N, 3) best.

    One unit may be wrong: that of all axes, or of one.
    """
    measured = _centred(measured)
    derived = _centred(derived)
    sizes = _quantiles(measured)[:, :, None]  # (Q, 3, 1)
    derived_sizes = _quantiles(derived)[:, None, :]  # (Q, 1, 3)
    units = [1.0, *_plausible(factors, sizes, derived_sizes)]
    tables = []
    for unit in units:
        scaled = unit * derived[:, None, :]
        both_signs = np.stack(
            [measured[:, :, None] - scaled, measured[:, :, None] + scaled], axis=-1
        )
        errors = _quantiles(both_signs)
        largest = np.maximum(sizes, unit * derived_sizes)[..., None]
        ratios = np.divide(
            errors,
            np.broadcast_to(largest, errors.shape),
            out=np.ones_like(errors),
            where=np.broadcast_to(largest > 0, errors.shape),
        )
        tables.append(ratios.min(axis=0))
    table = np.array(tables)  # (U, measured, derived, sign)
    changes = _axis_changes()
    axes = np.arange(3)
    each = table[:, axes, changes.sources, changes.flips]  # (U, 48, 3)
    logs = np.log(np.maximum(each, floor))
    plain = logs[0].sum(axis=1)
    costs = changes.costs
    options = [(plain + CHANGE * costs, 0, None)]
    for unit in range(1, len(units)):
        kind = 1 if units[unit] in factors else 1.5  # a factor that is no unit
        options.append(
            (logs[unit].sum(axis=1) + CHANGE * (costs + kind), unit, None),
        )
        if kind == 1:
            options += [
                (
                    plain
                    + logs[unit, :, axis]
                    - logs[0, :, axis]
                    + CHANGE * (costs + kind),
                    unit,
                    axis,
                )
                for axis in range(3)
            ]
    scores, unit, axis = min(options, key=lambda option: option[0].min())
    best = int(scores.argmin())
    scale = np.ones(3)
    chosen = each[0, best].copy()
    if unit and axis is None:
        scale[:] = units[unit]
        chosen = each[unit, best]
    elif unit:
        scale[axis] = units[unit]
        chosen[axis] = each[unit, best, axis]
    score = float(scores[best])
    cost = (score - float(np.log(np.maximum(chosen, floor)).sum())) / CHANGE
    return _Fit(changes.matrices[best], scale, 0.0, chosen, cost, score)


def _plausible(
    factors: Sequence[float], sizes: Array, derived_sizes: Array
) -> list[float]:
    """Factors that the sizes of both sides allow, and their own one where it is large."""
    large = QUANTILES.index(0.9)
    ratios = sizes[large] / np.maximum(derived_sizes[large], 1e-300)
    units = [f for f in factors if ((ratios > 0.7 * f) & (ratios < 1.4 * f)).any()]
    total = float(np.square(sizes[large]).sum())
    derived_total = float(np.square(derived_sizes[large]).sum())
    if min(total, derived_total) <= 0:
        return units
    usual = float(np.sqrt(total / derived_total))
    is_large = not 0.5 < usual < 2
    if is_large and not any(abs(usual / unit - 1) < 0.05 for unit in units):
        units.append(usual)
    return units


# --- Lags -----------------------------------------------------------------------------


class _Series(NamedTuple):
    """Measured vectors at all lags, as they are correlated with others."""

    lags: Array  # (L,) [s]
    later: Array  # (L, N, 3); NaN beyond the piece
    clipped: Array  # likewise, centred and without glitches; 0 beyond the piece
    inside: np.ndarray  # (L, N)
    squares: Array  # sums of squares of the clipped ones (L, 3)


def _series(lags: Array, later: Array) -> _Series:
    inside = np.isfinite(later[:, :, 0])
    now = later[len(lags) // 2]
    low, high = np.nanquantile(now, [0.01, 0.99], axis=0)
    clipped = np.clip(later, low, high) - np.nanmedian(now, axis=0)
    clipped[~inside] = 0.0
    squares = np.square(clipped).sum(axis=1)
    return _Series(lags, later, clipped, inside, squares)


def _correlations(series: _Series, derived: Array) -> Array:
    """Correlations (L, 3, 3) of measured axes, at each lag, with derived ones."""
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


def _agreements(series: _Series, derived: Array) -> Array:
    """At each lag (L,), the correlations of the axes in their best order, summed."""
    correlations = np.abs(_correlations(series, derived))
    axes = np.arange(3)
    orders = np.array(list(itertools.permutations(axes)))
    return correlations[:, axes, orders].sum(axis=2).max(axis=1)


def _fit_later(
    series: _Series, derived: Array, factors: Sequence[float], floor: float
) -> _Fit:
    """The change of axes and units, now or at the lag of the largest correlations."""
    now = len(series.lags) // 2
    rows = series.inside[now]
    fit = _fit_axes(series.later[now][rows], derived[rows], factors, floor)
    sums = _agreements(series, derived)
    lag = int(sums.argmax())
    if abs(series.lags[lag]) < NOTED_LAG or sums[lag] <= sums[now]:
        return fit
    rows = series.inside[lag]
    late = _fit_axes(series.later[lag][rows], derived[rows], factors, floor)
    late_score = late.score + CHANGE
    if late_score >= fit.score:
        return fit
    return replace(
        late, lag=float(series.lags[lag]), cost=late.cost + 1, score=late_score
    )


# --- Attitudes ------------------------------------------------------------------------


@dataclass(frozen=True)
class _AttitudeChange:
    """Another reading of the columns of an attitude."""

    advice: str  # what is so, and what to write into the mapping; empty: nothing else
    cost: float  # number of mistakes
    attitudes: Callable[[Array], Array]  # (..., 4) in ENU and FLU, of those in the file
    turns_axes: bool = False  # whether NED and ENU change places, and nothing else


def _attitude_changes(claim: _Claim) -> list[_AttitudeChange]:
    """All readings that are tried; the first is what the mapping says."""
    axes = claim.axes[claim.attitude.name]

    def to_enu(attitudes: Array) -> Array:
        return attitudes_to_enu(attitudes, axes)

    changes = [_AttitudeChange("", 0, to_enu)]
    columns = list(_column_changes(claim))
    turns = list(_turn_changes(claim))
    changes += [
        _AttitudeChange(change.advice, change.cost, _chain(change.attitudes, to_enu))
        for change in columns
    ]
    changes += [
        replace(turn, attitudes=_chain(to_enu, turn.attitudes)) for turn in turns
    ]
    changes += [
        _AttitudeChange(
            f"{change.advice}; and {turn.advice}",
            change.cost + turn.cost,
            _chain(change.attitudes, to_enu, turn.attitudes),
        )
        for change in columns[:2]
        for turn in turns
    ]
    first, second = columns[:2]
    changes.append(
        _AttitudeChange(
            f"{first.advice}; and {second.advice}",
            first.cost + second.cost,
            _chain(first.attitudes, second.attitudes, to_enu),
        )
    )
    return changes


def _chain(*functions: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The functions one after the other."""

    def chained(values: Array) -> Array:
        for function in functions:
            values = function(values)
        return values

    return chained


def _turn_changes(claim: _Claim) -> Iterator[_AttitudeChange]:
    """Other axes of the world or of the body."""
    name = claim.attitude.name
    axes = claim.axes[name]
    other = "ned" if axes == "enu" else "enu"
    (world, body), (other_world, other_body) = NAMES[axes], NAMES[other]

    def turn_world(q: Array) -> Array:
        return quaternion_product(NED_TURN, q)

    def turn_body(q: Array) -> Array:
        return quaternion_product(q, FRD_TURN)

    yield _AttitudeChange(
        f"{name} is that of a body in {other_body} axes in a world in {other_world} "
        f"axes, not {body} in {world}: write axes: {other} for {name}",
        1,
        _chain(turn_world, turn_body),
        turns_axes=True,
    )
    yield _AttitudeChange(
        f"{name} is that of a body in {other_body} axes, not {body}, in a world in "
        f"{world} axes: write {_body_turned(claim.attitude)}",
        1,
        turn_body,
    )
    yield _AttitudeChange(
        f"{name} is that of a body in {body} axes in a world in {other_world} axes, "
        f"not {world}: write {_body_turned(claim.attitude)}, and axes: {other} "
        f"for {name}",
        1,
        turn_world,
    )


def _column_changes(claim: _Claim) -> Iterator[_AttitudeChange]:
    """Other meanings of the columns; the first two are the commonest mistakes."""
    if claim.attitude.kind == "euler":
        yield from _euler_changes(claim.attitude)
    else:
        yield from _quaternion_changes(claim.attitude)


def _quaternion_changes(signal: Signal) -> Iterator[_AttitudeChange]:
    name = signal.name
    other = "wxyz" if signal.order == "xyzw" else "xyzw"
    shift = -1 if other == "wxyz" else 1
    yield _AttitudeChange(
        f"{name} is in the order {other}, not {signal.order}: write order: {other} "
        f"for {name}",
        1,
        lambda q: np.roll(q, shift, axis=-1),
    )
    yield _AttitudeChange(
        f"{name} turns vectors from world to body axes, the inverse of an attitude: "
        f"write {_quaternion_columns(signal, [0, 1, 2, 3], [-1, -1, -1, 1])}",
        1,
        quaternion_inverse,
    )
    for axes in ([0], [1], [2], [1, 2], [0, 1], [0, 2]):
        signs = np.ones(4)
        signs[axes] = -1
        letters = " and ".join("xyz"[axis] for axis in axes)
        several = len(axes) > 1
        yield _AttitudeChange(
            f"{letters} of {name} {'have' if several else 'has'} the opposite sign: "
            f"write {_quaternion_columns(signal, [0, 1, 2, 3], signs)}",
            RARE if axes in ([0], [1], [2], [1, 2]) else 2,
            lambda q, signs=signs: q * signs,
        )
    for order in ([1, 0, 2, 3], [2, 1, 0, 3], [0, 2, 1, 3]):
        swapped = [i for i in range(3) if order[i] != i]
        yield _AttitudeChange(
            f"{'xyz'[swapped[0]]} and {'xyz'[swapped[1]]} of {name} have changed "
            f"places: write {_quaternion_columns(signal, order, np.ones(4))}",
            RARE,
            lambda q, order=order: q[..., order],
        )


def _euler_changes(signal: Signal) -> Iterator[_AttitudeChange]:
    name = signal.name
    angles = ("roll", "pitch", "yaw")
    unit = "rad" if signal.unit == "deg" else "deg"
    ratio = 1 / DEGREE if signal.unit == "deg" else DEGREE

    def changed(order: Sequence[int], factors: Array) -> Callable[[Array], Array]:
        def attitudes(q: Array) -> Array:
            turns = Rotation.from_quat(q.reshape(-1, 4))
            values = turns.as_euler("ZYX")[:, ::-1]  # roll, pitch, yaw
            values = values[:, list(order)] * factors
            turned = Rotation.from_euler("ZYX", values[:, ::-1]).as_quat()
            return turned.reshape(q.shape)

        return attitudes

    same = (0, 1, 2)
    yield _AttitudeChange(
        f"{name} turns vectors from world to body axes, the inverse of an attitude: "
        f"write its quaternion with scale: [-1, -1, -1, 1]",
        1,
        quaternion_inverse,
    )
    for axes in ([1], [0], [2], [1, 2], [0, 1], [0, 2], [0, 1, 2]):
        signs = np.ones(3)
        signs[axes] = -1
        several = len(axes) > 1
        yield _AttitudeChange(
            f"{' and '.join(angles[i] for i in axes)} of {name} "
            f"{'have' if several else 'has'} the opposite sign: "
            f"write {_vector_columns(signal, same, signs)}",
            1 if axes in ([0], [1], [2], [1, 2]) else 2,
            changed(same, signs),
        )
    for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1)):
        swapped = [angles[i] for i in range(3) if order[i] != i]
        yield _AttitudeChange(
            f"{swapped[0]} and {swapped[1]} of {name} have changed places: "
            f"write {_vector_columns(signal, order, np.ones(3))}",
            1,
            changed(order, np.ones(3)),
        )
    for axes in ([0, 1, 2], [0], [1], [2]):
        factors = np.ones(3)
        factors[axes] = ratio
        words = name if len(axes) == 3 else f"{angles[axes[0]]} of {name}"
        advice = (
            f"unit: {unit}"
            if len(axes) == 3
            else _vector_columns(signal, same, factors)
        )
        yield _AttitudeChange(
            f"{words} is in {unit}, not {signal.unit}: write {advice}",
            1,
            changed(same, factors),
        )


def _body_turned(signal: Signal) -> str:
    """How a mapping turns the body's axes of an attitude by half a turn about x."""
    if signal.kind == "euler":
        return f"the quaternion of {signal.name}, with its body's axes turned"
    # q * i: (x, y, z, w) becomes (w, z, -y, -x).
    return _quaternion_columns(signal, [3, 2, 1, 0], [1, 1, -1, -1])


def _quaternion_columns(
    signal: Signal, order: Sequence[int], signs: Sequence[float] | Array
) -> str:
    """Columns and scale that read x, y, z, w as others, with signs, of the present."""
    places = [0, 1, 2, 3] if signal.order == "xyzw" else [1, 2, 3, 0]
    columns = list(signal.columns)
    scales = [1.0] * 4
    for entry in range(4):
        source = places[order[entry]]
        columns[places[entry]] = signal.columns[source]
        scales[places[entry]] = signs[entry] * _scales(signal)[source]
    return _columns_and_scale(signal, columns, scales)


def _vector_columns(
    signal: Signal, order: Sequence[int], scales: Sequence[float] | Array
) -> str:
    """Columns and scale that take each axis from another, times a number."""
    columns = [signal.columns[source] for source in order]
    own = _scales(signal)
    numbers = [scale * own[source] for scale, source in zip(scales, order, strict=True)]
    return _columns_and_scale(signal, columns, numbers)


def _scales(signal: Signal) -> tuple[float, ...]:
    if isinstance(signal.scale, tuple):
        return signal.scale
    return (signal.scale,) * len(signal.columns)


def _columns_and_scale(
    signal: Signal, columns: Sequence[str], scales: Sequence[float]
) -> str:
    words = []
    if list(columns) != list(signal.columns):
        words.append(f"columns: [{', '.join(columns)}]")
    if tuple(scales) != _scales(signal):
        equal = len(set(scales)) == 1
        numbers = ", ".join(f"{scale:.5g}" for scale in scales)
        words.append(f"scale: {scales[0]:.5g}" if equal else f"scale: [{numbers}]")
    return f"{' and '.join(words)} for {signal.name}"


# --- Readings -------------------------------------------------------------------------


class _Relation(NamedTuple):
    """A signal and the derivative that it should be, as the mapping claims them."""

    measured: Signal
    derived: Signal
    frame: str
    correlations: Array  # by axis (3,)
    moves: np.ndarray  # whether both do, by axis (3,)
    is_smooth: np.ndarray  # whether both are no noise, by axis (3,)


@dataclass(frozen=True)
class _Reading:
    """One reading of all columns, and how the three relations fit it."""

    attitude: _AttitudeChange
    position: Array  # how axes and unit of the true position are read (3, 3)
    velocity: _Fit  # to the changes of the position as it is read
    rate: _Fit
    velocity_frame: str
    rate_frame: str
    tilt: Array | None  # misfits of the third relation (2,); None without excitation
    lift: float  # [m/s2] median of the force along the body's z
    cost: float = 0.0
    score: float = 0.0


class _Search:
    """Readings of the windows of a log under what a mapping claims."""

    def __init__(self, windows: _Windows, claim: _Claim) -> None:
        self.windows = windows
        self.claim = claim
        self.rates = _series(windows.lags, windows.later_rates)
        self.velocities = _series(windows.lags, windows.later_velocities)
        self.attitudes = _attitude_changes(claim)
        self.speed_factors = _factors(claim.velocity, _SPEEDS, claim.position, _LENGTHS)
        self.rate_factors = _factors(claim.rate, _RATES, claim.attitude, _ANGLES)

    def claimed(self) -> _Reading:
        """What the mapping says."""
        attitude = self.attitudes[0]
        velocity = _Fit(misfits=misfits(*self._velocities(attitude, self._frames[0])))
        rate = _Fit(misfits=misfits(*self._rates(attitude, self._frames[1])))
        return self._reading(
            attitude=attitude,
            position=np.eye(3),
            velocity=replace(velocity, score=_score(velocity, _FLOOR_VELOCITY)),
            rate=replace(rate, score=_score(rate, _FLOOR_RATE)),
            velocity_frame=self._frames[0],
            rate_frame=self._frames[1],
        )

    @cached_property
    def relations(self) -> tuple[_Relation, _Relation]:
        """The first two relations, as the mapping claims them."""
        claim = self.claim
        attitude = self.attitudes[0]
        attitudes = attitude.attitudes(self.windows.wide_attitudes)
        turns = [
            rotation_vector(quaternion_product(quaternion_inverse(one), other))
            for one, other in itertools.pairwise(attitudes)
        ]
        if claim.rate_frame == "world":
            turns = [rotate(attitudes[1], turn) for turn in turns]
        moves = list(np.diff(self.windows.wide_positions, axis=0))
        if claim.velocity_frame == "body":
            to_body = quaternion_inverse(attitudes[1])
            moves = [rotate(to_body, move) for move in moves]
        velocities, speeds = self._velocities(attitude, claim.velocity_frame)
        rates, own_turns = self._rates(attitude, claim.rate_frame)
        return (
            _Relation(
                measured=claim.velocity,
                derived=claim.position,
                frame=claim.velocity_frame,
                correlations=_correlation(velocities, speeds),
                moves=_move(velocities) & _move(speeds),
                is_smooth=self._is_smooth(self.velocities, moves),
            ),
            _Relation(
                measured=claim.rate,
                derived=claim.attitude,
                frame=claim.rate_frame,
                correlations=_correlation(rates, own_turns),
                moves=_move(rates) & _move(own_turns),
                is_smooth=self._is_smooth(self.rates, turns),
            ),
        )

    def _is_smooth(self, series: _Series, neighbours: Sequence[Array]) -> np.ndarray:
        """Whether windows are like the next ones, of measured and of derived axes."""
        next_one = int(np.argmin(np.abs(series.lags - self.windows.duration)))
        pair = series.later[[len(series.lags) // 2, next_one]]
        inside = np.isfinite(pair).all(axis=(0, 2))
        measured = _correlation(pair[0, inside], pair[1, inside])
        derived = _correlation(neighbours[0], neighbours[1])
        return np.minimum(measured, derived) > SMOOTH

    def correlation_in(
        self, relation: _Relation, attitude: _AttitudeChange, frame: str
    ) -> float:
        """Mean correlation of a signal with its derivative in a frame."""
        is_rate = relation.measured == self.claim.rate
        vectors = self._rates if is_rate else self._velocities
        measured, derived = vectors(attitude, frame)
        return float(np.abs(_correlation(measured, derived)).mean())

    @property
    def _frames(self) -> tuple[str, str]:
        return self.claim.velocity_frame, self.claim.rate_frame

    def claimed_lags(self) -> tuple[float, float]:
        """Lags [s] of the velocity and the rate at which the claim correlates most."""
        attitude = self.attitudes[0]
        lags = []
        for series, (_, derived) in (
            (self.velocities, self._velocities(attitude, self._frames[0])),
            (self.rates, self._rates(attitude, self._frames[1])),
        ):
            sums = np.trace(_correlations(series, derived), axis1=1, axis2=2)
            lags.append(float(series.lags[int(sums.argmax())]))
        return lags[0], lags[1]

    def tilt_lag(self, claimed: _Reading) -> float:
        """The lag [s] of the accelerations after the tilt, where it is clear; else 0."""
        if self.claim.velocity_frame == "body" or claimed.tilt is None:
            return 0.0
        series = self.velocities
        reach = max(round(HALF_WIDE / (series.lags[1] - series.lags[0])), 1)
        span = series.lags[2 * reach] - series.lags[0]
        rises = (series.later[2 * reach :] - series.later[: -2 * reach]) / span
        lags = series.lags[reach:-reach]
        body_axis = self._body_axis(self.attitudes[0])
        accelerations = _series(lags, rises)
        leans = np.column_stack([body_axis[:, :2], np.zeros(len(body_axis))])
        sums = _correlations(accelerations, leans)[:, [0, 1], [0, 1]].sum(axis=1)
        lag = int(sums.argmax())
        rows = accelerations.inside[lag]
        if abs(lags[lag]) < NAMED_LAG or rows.sum() < FEWEST:
            return 0.0
        tilt = _tilt_misfits(rises[lag][rows], body_axis[rows])
        if tilt is None or not _fits_tilt(tilt):
            return 0.0
        is_better = (tilt < HALF * claimed.tilt).any()
        return float(lags[lag]) if is_better else 0.0

    def _velocities(
        self, attitude: _AttitudeChange, frame: str, position: Array | None = None
    ) -> tuple[Array, Array]:
        """Measured velocities, and those of the positions, in a frame (N, 3)."""
        moves = self.windows.moves
        if position is not None:
            moves = moves @ np.linalg.inv(position).T
        if frame == "body":
            middle = attitude.attitudes(self.windows.attitudes[1])
            moves = rotate(quaternion_inverse(middle), moves)
        return self.windows.velocities, moves

    def _rates(self, attitude: _AttitudeChange, frame: str) -> tuple[Array, Array]:
        """Measured rates, and those of the attitudes, in a frame (N, 3)."""
        before, middle, after = attitude.attitudes(self.windows.attitudes)
        turns = rotation_vector(quaternion_product(quaternion_inverse(before), after))
        turns = turns / self.windows.duration
        if frame == "world":
            turns = rotate(middle, turns)
        return self.windows.rates, turns

    def _accelerations(
        self, attitude: _AttitudeChange, position: Array, velocity: _Fit, frame: str
    ) -> Array:
        """Accelerations (N, 3) in world axes, after this reading."""
        velocities = self.windows.wide_velocities / velocity.factors
        if frame == "world":
            # The velocity is to the read position what that is to the true one.
            true_velocities = velocities @ np.linalg.inv(velocity.matrix @ position).T
        else:
            ends = attitude.attitudes(self.windows.wide_attitudes[[0, 2]])
            true_velocities = rotate(ends, velocities @ velocity.matrix)
        before, after = true_velocities
        return (after - before) / self.windows.wide_duration

    def _reading(
        self,
        attitude: _AttitudeChange,
        position: Array,
        velocity: _Fit,
        rate: _Fit,
        velocity_frame: str,
        rate_frame: str,
        body_axis: Array | None = None,
    ) -> _Reading:
        """A reading with the third relation, its cost and its score."""
        if body_axis is None:
            body_axis = self._body_axis(attitude)
        accelerations = self._accelerations(
            attitude, position, velocity, velocity_frame
        )
        force = accelerations - GRAVITY
        lift = float(np.median((force * body_axis).sum(axis=-1)))
        tilt = _tilt_misfits(accelerations, body_axis)
        reading = _Reading(
            attitude, position, velocity, rate, velocity_frame, rate_frame, tilt, lift
        )
        cost = self._cost(reading)
        fits = velocity.score + rate.score - CHANGE * (velocity.cost + rate.cost)
        score = fits + CHANGE * cost
        if _fits_tilt(tilt):
            score += float(np.nansum(np.log(np.maximum(tilt, _FLOOR_TILT))))
        if lift < 0:
            score += CHANGE  # a body that hangs from its own top is rare
        return replace(reading, cost=cost, score=score)

    def _body_axis(self, attitude: _AttitudeChange) -> Array:
        """The body's axis z in world axes (N, 3), on average over the wide windows."""
        attitudes = attitude.attitudes(self.windows.wide_attitudes)
        before, middle, after = rotate(
            attitudes, np.broadcast_to([0.0, 0.0, 1.0], (*attitudes.shape[:-1], 3))
        )
        return (before + 4 * middle + after) / 6

    def _cost(self, reading: _Reading) -> float:
        """The number of mistakes; one that several signals share counts once."""
        if self.is_other_frame(reading):
            return 0.5  # the commonest, and one that looks like others
        claim = self.claim
        cost = reading.attitude.cost + reading.rate.cost
        cost += reading.velocity_frame != claim.velocity_frame
        cost += reading.rate_frame != claim.rate_frame
        if reading.attitude.turns_axes and self._turns_rate(reading):
            cost -= 0.75  # both come from one source
        fit = reading.velocity
        unit, axes = _unit_and_axes(reading.position)
        if reading.velocity_frame == "body":
            return cost + _cost(axes) + (unit != 1) + fit.cost
        # What the velocity is to the read position, it is to the true one by both.
        is_shared = np.array_equal(fit.matrix, np.eye(3))
        if axes[2, 2] != 1 and not np.array_equal(axes, NED):
            cost += RARE - 1  # whether z points up, gravity hardly says
        cost += _cost(axes) + (0 if is_shared else _cost(fit.matrix @ axes))
        in_units = fit.cost - _cost(fit.matrix) - (fit.lag != 0)
        if in_units and np.allclose(fit.factors * unit, 1):
            in_units = 0.0  # the unit of the position is the only one that is wrong
        return cost + (unit != 1) + in_units + (fit.lag != 0)

    def _turns_rate(self, reading: _Reading) -> bool:
        """Whether NED and ENU, or FRD and FLU, change places in the rate."""
        turned = FRD if reading.rate_frame == "body" else NED
        return np.array_equal(reading.rate.matrix, turned)

    def is_other_frame(self, reading: _Reading) -> bool:
        """Whether all is in NED that is said to be in ENU, or the reverse."""
        in_world = reading.velocity_frame == "world"
        velocity = np.eye(3) if in_world else FRD
        fits = reading.velocity, reading.rate
        return (
            reading.attitude.turns_axes
            and np.array_equal(reading.position, NED)
            and np.array_equal(reading.velocity.matrix, velocity)
            and self._turns_rate(reading)
            and all(fit.lag == 0 and (fit.factors == 1).all() for fit in fits)
            and (reading.velocity_frame, reading.rate_frame) == self._frames
        )

    def readings(self) -> Iterator[_Reading]:
        """All readings that may be better than the claim."""
        claimed = self.claimed()
        best = claimed.score
        in_world = _fit_later(
            self.velocities,
            self.windows.moves,
            self.speed_factors,
            _FLOOR_VELOCITY,
        )
        positions = [*_position_changes()]
        explained = in_world.matrix * in_world.factors[:, None]
        if not np.array_equal(explained, np.eye(3)) and not in_world.lag:
            positions.append(np.linalg.inv(explained))
        # No reading can fit a velocity better than this.
        best_velocity = 3 * np.log(_FLOOR_VELOCITY)
        may_be_body = self._is_body_velocity(self.attitudes[0], claimed)
        if not may_be_body:
            best_velocity = in_world.score - CHANGE * in_world.cost
        best_tilt = 2 * np.log(_FLOOR_TILT)
        least_agreement = self._least_agreement(claimed)
        for attitude in self.attitudes:
            body_axis = self._body_axis(attitude)
            for rate_frame in ("body", "world"):
                _, derived = self._rates(attitude, rate_frame)
                agreements = _agreements(self.rates, derived)
                if attitude.cost and agreements.max() < least_agreement:
                    continue
                rate = _fit_later(self.rates, derived, self.rate_factors, _FLOOR_RATE)
                # A mistake that several signals share counts once.
                least_cost = attitude.cost + (rate_frame != self._frames[1]) - 2
                least = rate.score + CHANGE * max(least_cost, -rate.cost)
                if least + best_velocity + best_tilt > best:
                    continue
                frames = ["world"]
                if self._is_body_velocity(attitude, claimed):
                    frames.append("body")
                for frame, position in itertools.product(frames, positions):
                    is_likely = attitude.cost == 0 and _is_likely(position)
                    if (
                        frame == "body"
                        and not is_likely
                        and position is not positions[0]
                    ):
                        continue
                    velocity = in_world
                    if frame == "body":
                        velocity = self._fit_body_velocity(attitude, position)
                    reading = self._reading(
                        attitude=attitude,
                        position=position,
                        velocity=velocity,
                        rate=rate,
                        velocity_frame=frame,
                        rate_frame=rate_frame,
                        body_axis=body_axis,
                    )
                    best = min(best, reading.score)
                    yield reading

    def _least_agreement(self, claimed: _Reading) -> float:
        """Sum of the rate's correlations of which another attitude is worth while."""
        _, derived = self._rates(self.attitudes[0], self._frames[1])
        now = len(self.rates.lags) // 2
        agreement = float(np.trace(_correlations(self.rates, derived)[now]))
        is_velocity_doubtful = claimed.velocity.misfits.max() > DOUBTFUL
        is_in_question = is_velocity_doubtful and self._frames[0] == "body"
        if claimed.tilt is not None and not _fits_tilt(claimed.tilt):
            is_in_question = True
        chance = -AGREEMENT if is_in_question else AGREEMENT
        return max(agreement + chance, LEAST_AGREEMENT)

    def _is_body_velocity(self, attitude: _AttitudeChange, claimed: _Reading) -> bool:
        """Whether a velocity in body axes is worth while to be looked at."""
        if self._frames[0] == "body":
            return True
        if claimed.velocity.misfits.max() < DOUBTFUL:
            return False
        now = len(self.velocities.lags) // 2
        own = np.trace(_correlations(self.velocities, self.windows.moves)[now])
        _, derived = self._velocities(attitude, "body")
        agreement = _agreements(self.velocities, derived).max()
        return bool(agreement > max(own, LEAST_AGREEMENT))

    def _fit_body_velocity(self, attitude: _AttitudeChange, position: Array) -> _Fit:
        _, derived = self._velocities(attitude, "body", position)
        return _fit_later(self.velocities, derived, self.speed_factors, _FLOOR_VELOCITY)


def _correlation(one: Array, other: Array) -> Array:
    """Correlations (3,) of the axes of vectors (N, 3), without glitches."""
    one = _without_glitches(one)
    other = _without_glitches(other)
    product = (one * other).sum(axis=0)
    scale = np.sqrt((one * one).sum(axis=0) * (other * other).sum(axis=0))
    return np.divide(product, scale, out=np.zeros(3), where=scale > 0)


def _without_glitches(vectors: Array) -> Array:
    """Centred vectors (N, 3) whose largest hundredth is cut off at either side."""
    low, high = np.quantile(vectors, [0.01, 0.99], axis=0)
    clipped = np.clip(vectors, low, high)
    return clipped - clipped.mean(axis=0)


def _move(vectors: Array) -> np.ndarray:
    """Whether the axes of vectors (N, 3) are more than a hover's (3,)."""
    large = QUANTILES.index(0.9)
    return _quantiles(_centred(vectors))[large] > MOVES


def _other_frame(frame: str) -> str:
    return "world" if frame == "body" else "body"


def _score(fit: _Fit, floor: float) -> float:
    return float(np.log(np.maximum(fit.misfits, floor)).sum())


@cache
def _position_changes() -> list[Array]:
    """Axes and units of positions that are tried: the first is what is claimed."""
    changes = _axis_changes()
    single = [
        m for m, cost in zip(changes.matrices, changes.costs, strict=True) if cost < 2
    ]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turns = [quarter, quarter @ quarter, quarter.T]
    units = [unit for unit in _LENGTHS.values() if unit != 1]
    factors = sorted({*units, *(1 / unit for unit in units)})
    return [*single, *turns, *(factor * np.eye(3) for factor in factors)]


def _unit_and_axes(position: Array) -> tuple[float, Array]:
    """The factor and the change of axes (3, 3) that are in one change of a position."""
    unit = float(abs(np.linalg.det(position)) ** (1 / 3))
    if abs(unit - 1) < 1e-9:
        unit = 1.0
    return unit, np.rint(position / unit)


def _is_likely(position: Array) -> bool:
    """Whether one mistake in the axes makes a change of a position."""
    unit, axes = _unit_and_axes(position)
    return unit == 1 and _cost(axes) < 2


def _factors(
    measured: Signal,
    measured_units: dict[str, float],
    derived: Signal,
    derived_units: dict[str, float],
) -> tuple[float, ...]:
    """What a measured value is over the derived one where one unit is mistaken."""
    said = _unit_factor(measured)
    ratios = {said / unit for unit in measured_units.values()}
    said = _unit_factor(derived)
    ratios |= {unit / said for unit in derived_units.values()}
    return tuple(sorted(ratio for ratio in ratios if abs(ratio - 1) > 1e-9))


def _unit_factor(signal: Signal) -> float:
    return UNITS.get(signal.unit, ("", 1.0))[1]


def _tilt_misfits(accelerations: Array, body_axis: Array) -> Array | None:
    """Misfits (2,) of a_xy t_z to t_xy (a_z + g); NaN of an axis that does not move.

    None where neither does.
    """
    measured = accelerations[:, :2] * body_axis[:, 2:]
    derived = body_axis[:, :2] * (accelerations[:, 2:] - GRAVITY[2])
    large = QUANTILES.index(0.9)
    sizes = np.maximum(_quantiles(_centred(measured)), _quantiles(_centred(derived)))
    moves = sizes[large] > TILT_MOVES
    if not moves.any():
        return None
    return np.where(moves, misfits(measured, derived), np.nan)


def _fits_tilt(tilt: Array | None) -> bool:
    """Whether the body is carried along its axis z, as far as it moves."""
    return tilt is not None and not (tilt > TILT_FITS).any()


# --- Judgement ------------------------------------------------------------------------


def _check(
    runs: Sequence[LogRun], step: float, claim: _Claim, where: str
) -> list[Finding]:
    """Refuses what another reading explains, or what nothing explains."""
    windows = _cut_windows(runs, step, claim)
    if windows is None:
        return []
    search = _Search(windows, claim)
    claimed = search.claimed()
    name = runs[0].name
    if not _is_doubtful(search, claimed):
        return _noticed(search, claimed, name)
    readings = sorted(search.readings(), key=lambda reading: reading.score)
    best = readings[0] if readings else claimed
    if _is_better(best, claimed):
        text = "; and ".join(_sentences(best, search))
        if _is_short_lag(best):
            return [Finding("late", name, 1, text), *_noticed(search, claimed, name)]
        other = _near_reading(readings, search)
        raise DataError(f"{where}{text}{other} ({_numbers(search)})")
    unexplained = _unexplained(search, claimed)
    if unexplained:
        raise DataError(
            f"{where}{unexplained}, and contradicts the mapping: no single change of "
            f"order, axes, signs, units or lag explains it ({_numbers(search)})"
        )
    return _noticed(search, claimed, name)


def _is_short_lag(best: _Reading) -> bool:
    """Whether all that is wrong is a lag too short to refuse."""
    fits = best.velocity, best.rate
    is_short = all(abs(fit.lag) < NAMED_LAG for fit in fits)
    return is_short and best.cost == sum(fit.lag != 0 for fit in fits)


def _near_reading(readings: Sequence[_Reading], search: _Search) -> str:
    """Another reading that fits as well as the best, in words; mostly empty."""
    best = _sentences(readings[0], search)
    for reading in readings[1:]:
        if reading.score > readings[0].score + NEAR:
            break
        sentences = _sentences(reading, search)
        if sentences != best and len(sentences) <= len(best):
            return f"; or else: {'; and '.join(sentences)}"
    return ""


def _is_doubtful(search: _Search, claimed: _Reading) -> bool:
    """Whether it is worth while to look for another reading."""
    if max(claimed.velocity.misfits.max(), claimed.rate.misfits.max()) > DOUBTFUL:
        return True
    if claimed.tilt is not None and not _fits_tilt(claimed.tilt):
        return True
    return max(map(abs, search.claimed_lags())) >= NOTED_LAG


def _is_better(best: _Reading, claimed: _Reading) -> bool:
    """Whether a reading explains what the claim does not."""
    if claimed.score - best.score < GAIN:
        return False
    for fit, own in ((best.velocity, claimed.velocity), (best.rate, claimed.rate)):
        is_better = (fit.misfits < FITS) & (fit.misfits < HALF * own.misfits)
        if (is_better & (own.misfits > DOUBTFUL)).any():
            return True
    if claimed.tilt is None or best.tilt is None or not _fits_tilt(best.tilt):
        return False
    is_better = best.tilt < TILT_FITS * claimed.tilt
    return bool((is_better & (claimed.tilt > TILT_FITS)).any())


def _noticed(search: _Search, claimed: _Reading, run: str) -> list[Finding]:
    """What is unusual, and no contradiction."""
    claim = search.claim
    name = claim.attitude.name
    findings = []
    if claimed.lift < GRAVITY[2] / 2:
        text = (
            f"the force that carries the body points along its -z ({claimed.lift:.1f} "
            f"m/s2): it hangs upside down, or {name} is that of a body in FRD axes, "
            f"and so are its rates: write {_body_turned(claim.attitude)}, and "
            f"axes: ned for {claim.rate.name}"
        )
        findings.append(Finding("upside down", run, 1, text))
    lag = search.tilt_lag(claimed)
    if lag:
        place = f"{claim.position.name} and {claim.velocity.name}"
        turn = f"{name} and {claim.rate.name}"
        late, early = (place, turn) if lag > 0 else (turn, place)
        text = (
            f"{late} come about {abs(lag):.1f} s after {early}: do their clocks agree?"
        )
        findings.append(Finding("late", run, 1, text))
    return findings


def _unexplained(search: _Search, claimed: _Reading) -> str:
    """Which derivative has nothing to do with its signal, though neither is noise."""
    for relation, fit in zip(
        search.relations, (claimed.velocity, claimed.rate), strict=True
    ):
        correlations = relation.correlations
        unrelated = (fit.misfits > BAD) & (np.abs(correlations) < UNRELATED)
        for axis in np.flatnonzero(unrelated & relation.moves & relation.is_smooth):
            return (
                f"{relation.measured.name} in {'xyz'[axis]} has nothing to do with "
                f"the derivative of {relation.derived.name}"
            )
    return ""


def _numbers(search: _Search) -> str:
    """The correlations of what the mapping says."""
    words = []
    for relation in search.relations:
        numbers = ", ".join(f"{number:.2f}" for number in relation.correlations)
        words.append(f"{relation.measured.name} {numbers}")
    return (
        f"correlations with the derivatives, as the mapping reads x, y, z: "
        f"{'; '.join(words)}"
    )


# --- Words ----------------------------------------------------------------------------


def _sentences(best: _Reading, search: _Search) -> list[str]:
    """What is so, and what to write into the mapping, a sentence a mistake."""
    claim = search.claim
    if search.is_other_frame(best):
        other = "ned" if claim.frame == "enu" else "enu"
        (world, body), (other_world, other_body) = NAMES[claim.frame], NAMES[other]
        return [
            f"gravity says that all states are in {other_world} axes of the world and "
            f"{other_body} axes of the body, not in {world} and {body}: "
            f"write frame: {other}"
        ]
    words = [best.attitude.advice] if best.attitude.advice else []
    words += _position_words(best, search)
    words += _fit_words(
        search=search,
        relation=search.relations[1],
        fit=best.rate,
        frame=best.rate_frame,
        units=(_RATES, _ANGLES),
        attitude=best.attitude,
    )
    return words


def _position_words(best: _Reading, search: _Search) -> list[str]:
    """What position and velocity are."""
    claim = search.claim
    relation = search.relations[0]
    fit = best.velocity
    unit, axes = _unit_and_axes(best.position)
    words = []
    if unit != 1 and (fit.factors == 1).all():
        true_unit = _unit_factor(claim.position) / unit
        words.append(
            f"{claim.position.name} and {claim.velocity.name} are {unit:.3g} times "
            f"what gravity says; are their units right? write "
            f"unit: {_unit_name(_LENGTHS, true_unit)} for {claim.position.name} and "
            f"unit: {_unit_name(_SPEEDS, true_unit)} for {claim.velocity.name}"
        )
    if not np.array_equal(axes, np.eye(3)):
        words.append(_axes_words(claim, claim.position, "world", axes))
        if best.velocity_frame == "world":
            fit = replace(fit, matrix=fit.matrix @ axes)
    units = (_SPEEDS, _LENGTHS)
    if np.allclose(fit.factors * unit, 1):
        units = ({}, _LENGTHS)  # gravity says that the velocity's is right
    return words + _fit_words(
        search=search,
        relation=relation,
        fit=fit,
        frame=best.velocity_frame,
        units=units,
        attitude=best.attitude,
    )


def _fit_words(
    search: _Search,
    relation: _Relation,
    fit: _Fit,
    frame: str,
    units: tuple[dict[str, float], dict[str, float]],
    attitude: _AttitudeChange,
) -> list[str]:
    """What a velocity or rate is of the derivative that it should be."""
    signal, of = relation.measured, relation.derived
    words = []
    if frame != relation.frame:
        correlation = search.correlation_in(relation, attitude, frame)
        words.append(
            f"{signal.name} is the derivative of {of.name} in {frame} axes "
            f"(correlation {correlation:.2f}), not in {relation.frame} axes, as the "
            f"mapping says: write frame: {frame} for {signal.name}"
        )
    if not np.array_equal(fit.matrix, np.eye(3)):
        words.append(_axes_words(search.claim, signal, frame, fit.matrix))
    if (fit.factors != 1).any():
        words.append(_unit_words(signal, of, fit.factors, units))
    if fit.lag:
        late, early = (signal, of) if fit.lag > 0 else (of, signal)
        words.append(
            f"{late.name} comes {abs(fit.lag):.2g} s after {early.name}: "
            f"write delay: {abs(fit.lag):.2g} for {late.name}"
        )
    return words


def _axes_words(claim: _Claim, signal: Signal, frame: str, matrix: Array) -> str:
    """What axes a vector is in, whose read axes are a matrix times the true ones."""
    said = claim.axes[signal.name]
    other = "ned" if said == "enu" else "enu"
    place = 0 if frame == "world" else 1
    if np.array_equal(matrix, NED if frame == "world" else FRD):
        return (
            f"{signal.name} is in {NAMES[other][place]} axes, not in "
            f"{NAMES[said][place]}: write axes: {other} for {signal.name}"
        )
    to_enu = claim.to_enu(signal, frame)
    inverse = (to_enu @ matrix @ to_enu).T  # from the file's axes to the true ones
    order = np.abs(inverse).argmax(axis=1).tolist()
    signs = inverse.sum(axis=1)
    flipped = sorted("xyz"[order[axis]] for axis in range(3) if signs[axis] < 0)
    parts = []
    if order != [0, 1, 2]:
        moved = [f"{'xyz'[axis]}" for axis in range(3) if order[axis] != axis]
        parts.append(f"{' and '.join(moved)} of {signal.name} have changed places")
    if len(flipped) == 3:
        parts.append(f"{signal.name} has the opposite sign")
    elif flipped:
        verb = "has" if len(flipped) == 1 else "have"
        parts.append(
            f"{' and '.join(flipped)} of {signal.name} {verb} the opposite sign"
        )
    advice = _vector_columns(signal, order, signs)
    return f"{' and '.join(parts)}: write {advice}"


def _unit_words(
    signal: Signal,
    of: Signal,
    factors: Array,
    units: tuple[dict[str, float], dict[str, float]],
) -> str:
    """Which unit is another than the mapping says."""
    axes = np.flatnonzero(factors != 1)
    factor = float(factors[axes[0]])
    hint = "degrees for radians make a factor of 57"
    if len(axes) == 1:
        scale = np.where(factors == 1, 1.0, 1 / factors)
        return (
            f"{'xyz'[axes[0]]} of {signal.name} is {factor:.3g} times the derivative "
            f"of {of.name}; is its unit right? ({hint}) write "
            f"{_vector_columns(signal, (0, 1, 2), scale)}"
        )
    own = _unit_name(units[0], _unit_factor(signal) / factor)
    others = _unit_name(units[1], _unit_factor(of) * factor)
    advice = " or ".join(
        f"unit: {unit} for {name}"
        for unit, name in ((own, signal.name), (others, of.name))
        if unit
    )
    return (
        f"{signal.name} is {factor:.3g} times the derivative of {of.name}; is its "
        f"unit right? ({hint}){' write ' if advice else ''}{advice}"
    )


def _unit_name(units: dict[str, float], factor: float) -> str:
    """The unit of a factor; empty where none has it."""
    near = [name for name, own in units.items() if abs(own / factor - 1) < 0.02]
    return near[0] if near else ""
