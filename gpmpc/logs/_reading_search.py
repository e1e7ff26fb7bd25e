"""Searches among all readings of a rigid body's columns for those that fit its motion.

A reading says what position, attitude, velocity and rate are. Its score adds the
logarithms of the misfits of three relations (``gpmpc.logs._conventions``) and a price
for each mistake that it supposes: the fewest mistakes that explain a log come first.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from gpmpc.logs._attitude_readings import RARE, AttitudeReading, attitude_readings
from gpmpc.logs._axis_fits import (
    CHANGE,
    FEWEST,
    QUANTILES,
    AxisFit,
    LaggedVectors,
    absolute_quantiles,
    agreements,
    axis_changes,
    centred,
    correlation,
    count_mistakes,
    fit_axes_and_lag,
    lagged_correlations,
    lagged_vectors,
    misfits,
)
from gpmpc.logs._frames import FRD, NED, Claim
from gpmpc.logs._kinematics import (
    GRAVITY,
    Array,
    quaternion_inverse,
    quaternion_product,
    rotate,
    rotation_vector,
)
from gpmpc.logs._log import LogRun
from gpmpc.logs._mapping import Signal
from gpmpc.logs._units import DEGREE, conversion

WINDOWS = 600  # of a run that are looked at
HALF_WINDOW = 0.1  # [s] on each side of the middle of a window
HALF_SHORT = 0.03  # [s] likewise, of a body that turns fast
FAST = 1.5  # [rad] within a window that is turning fast
HALF_WIDE = 0.1  # [s] of the windows of accelerations, which are noisier
LONGEST_LAG = 0.8  # [s] that is sought
LAG_STEP = 0.02  # [s] from one lag to the next
LEAST_CLOCK_LAG = 0.1  # [s] of the attitude behind the position that is said
LEAST_AGREEMENT = 0.7  # sum of three correlations of which a reading is worth while
AGREEMENT = 0.15  # in that sum, which is more than chance
DOUBTFUL = 0.2  # misfit from which another reading is looked for
HALF = 0.5  # of the claim's misfit, which a better reading has to stay below
TILT_FITS = 0.6  # misfit below which the third relation holds; drag disturbs it
TILT_MOVES = 0.3  # [m/s2] of the horizontal force from which it is looked at
MOVES = 0.3  # [m/s], [rad/s] of an axis that is no hover's
SMOOTH = 0.8  # correlation with the next window of what is no noise
# Misfits below these are noise or smoothing, and no reason to prefer a reading.
FLOOR_VELOCITY = 0.05
FLOOR_RATE = 0.1
FLOOR_TILT = 0.1
LENGTHS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "in": 0.0254}
SPEEDS = {
    "m/s": 1.0,
    "mm/s": 1e-3,
    "cm/s": 1e-2,
    "km/h": 1 / 3.6,
    "ft/s": 0.3048,
    "kn": 1852 / 3600,
    "mph": 0.44704,
}
ANGLES = {"rad": 1.0, "deg": DEGREE}
RATES = {"rad/s": 1.0, "deg/s": DEGREE, "rpm": float(np.pi / 30)}


class MotionWindows(NamedTuple):
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


def cut_motion_windows(
    runs: Sequence[LogRun], step: float, claim: Claim
) -> MotionWindows | None:
    """Windows that lie inside a piece each; None where there are too few."""
    half = max(round(HALF_WINDOW / step), 1)
    if sum(len(run.starts(half, half)) for run in runs) < FEWEST:
        return None
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
    return MotionWindows(
        moves=moves / duration,
        attitudes=attitudes,
        velocities=means[:, 0:3],
        rates=means[:, 3:6],
        duration=duration,
        lags=np.asarray(lags * step, dtype=float),
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
    """Means (K, c) of rows from ``half`` before to ``half`` after, by trapezoids."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    means = np.zeros_like(values)
    if len(values) > 2 * half:
        whole = sums[2 * half + 1 :] - sums[: -2 * half - 1]
        ends = (values[: -2 * half] + values[2 * half :]) / 2
        means[half : len(values) - half] = (whole - ends) / (2 * half)
    return means


class Relation(NamedTuple):
    """A signal and the derivative that it should be, as the mapping claims them."""

    measured: Signal
    derived: Signal
    frame: str
    correlations: Array  # by axis (3,)
    moves: np.ndarray  # whether both do, by axis (3,)
    is_smooth: np.ndarray  # whether both are no noise, by axis (3,)


@dataclass(frozen=True)
class Reading:
    """One reading of all columns, and how the three relations fit it."""

    attitude: AttitudeReading
    position: Array  # how axes and unit of the true position are read (3, 3)
    velocity: AxisFit  # to the changes of the position as it is read
    rate: AxisFit
    velocity_frame: str
    rate_frame: str
    tilt: Array | None  # misfits of the third relation (2,); None without excitation
    lift: float  # [m/s2] median of the force along the body's z
    cost: float = 0.0
    score: float = 0.0


class ReadingSearch:
    """Readings of the windows of a log under what a mapping claims."""

    def __init__(self, windows: MotionWindows, claim: Claim) -> None:
        self.windows = windows
        self.claim = claim
        self._velocities_in = self._in_both_frames(
            windows.later_velocities, claim.velocity, claim.velocity_frame
        )
        self._rates_in = self._in_both_frames(
            windows.later_rates, claim.rate, claim.rate_frame
        )
        self.velocities = self._velocities_in[claim.velocity_frame]
        self.rates = self._rates_in[claim.rate_frame]
        self.attitudes = attitude_readings(claim)
        self.speed_factors = _factors(claim.velocity, SPEEDS, claim.position, LENGTHS)
        self.rate_factors = _factors(claim.rate, RATES, claim.attitude, ANGLES)

    def _in_both_frames(
        self, later: Array, signal: Signal, claimed_frame: str
    ) -> dict[str, LaggedVectors]:
        """The measured vectors, taken for those of either frame."""
        claimed = lagged_vectors(self.windows.lags, later)
        both = {}
        for frame in ("world", "body"):
            turn = self._turn_to(signal, claimed_frame, frame)
            both[frame] = claimed
            if not np.array_equal(turn, np.eye(3)):
                both[frame] = lagged_vectors(self.windows.lags, later @ turn)
        return both

    def _turn_to(self, signal: Signal, claimed_frame: str, frame: str) -> Array:
        """What brings a vector that was taken for one of the claimed frame's (3, 3).

        NED becomes ENU by another change of the axes than FRD becomes FLU.
        """
        claimed = self.claim.to_enu(signal, claimed_frame)
        return claimed @ self.claim.to_enu(signal, frame)

    def claimed(self) -> Reading:
        """What the mapping says."""
        attitude = self.attitudes[0]
        velocity = AxisFit(
            misfits=misfits(*self._velocities(attitude, self._frames[0]))
        )
        rate = AxisFit(misfits=misfits(*self._rates(attitude, self._frames[1])))
        return self._reading(
            attitude=attitude,
            position=np.eye(3),
            velocity=replace(velocity, score=_score(velocity, FLOOR_VELOCITY)),
            rate=replace(rate, score=_score(rate, FLOOR_RATE)),
            velocity_frame=self._frames[0],
            rate_frame=self._frames[1],
        )

    @cached_property
    def relations(self) -> tuple[Relation, Relation]:
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
            Relation(
                measured=claim.velocity,
                derived=claim.position,
                frame=claim.velocity_frame,
                correlations=correlation(velocities, speeds),
                moves=_move(velocities) & _move(speeds),
                is_smooth=self._is_smooth(self.velocities, moves),
            ),
            Relation(
                measured=claim.rate,
                derived=claim.attitude,
                frame=claim.rate_frame,
                correlations=correlation(rates, own_turns),
                moves=_move(rates) & _move(own_turns),
                is_smooth=self._is_smooth(self.rates, turns),
            ),
        )

    def _is_smooth(
        self, series: LaggedVectors, neighbours: Sequence[Array]
    ) -> np.ndarray:
        """Whether windows are like the next ones, of measured and of derived axes."""
        next_one = int(np.argmin(np.abs(series.lags - self.windows.duration)))
        pair = series.later[[len(series.lags) // 2, next_one]]
        inside = np.isfinite(pair).all(axis=(0, 2))
        measured = correlation(pair[0, inside], pair[1, inside])
        derived = correlation(neighbours[0], neighbours[1])
        return np.minimum(measured, derived) > SMOOTH

    def correlation_in(
        self, relation: Relation, attitude: AttitudeReading, frame: str
    ) -> float:
        """Mean correlation of a signal with its derivative in a frame."""
        is_rate = relation.measured == self.claim.rate
        vectors = self._rates if is_rate else self._velocities
        measured, derived = vectors(attitude, frame)
        return float(np.abs(correlation(measured, derived)).mean())

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
            sums = np.trace(lagged_correlations(series, derived), axis1=1, axis2=2)
            lags.append(float(series.lags[int(sums.argmax())]))
        return lags[0], lags[1]

    def tilt_lag(self, claimed: Reading) -> float:
        """The lag [s] of the accelerations after the tilt; 0 where it is not clear."""
        if self.claim.velocity_frame == "body" or claimed.tilt is None:
            return 0.0
        series = self.velocities
        if len(series.lags) < 3:
            return 0.0
        reach = max(round(HALF_WIDE / (series.lags[1] - series.lags[0])), 1)
        if len(series.lags) <= 2 * reach:
            return 0.0
        span = series.lags[2 * reach] - series.lags[0]
        rises = (series.later[2 * reach :] - series.later[: -2 * reach]) / span
        lags = series.lags[reach:-reach]
        if np.isfinite(rises[len(lags) // 2]).all(axis=1).sum() < FEWEST:
            return 0.0
        body_axis = self._body_axis(self.attitudes[0])
        accelerations = lagged_vectors(lags, rises)
        leans = np.column_stack([body_axis[:, :2], np.zeros(len(body_axis))])
        sums = lagged_correlations(accelerations, leans)[:, [0, 1], [0, 1]].sum(axis=1)
        lag = int(sums.argmax())
        rows = accelerations.inside[lag]
        if abs(lags[lag]) < LEAST_CLOCK_LAG or rows.sum() < FEWEST:
            return 0.0
        tilt = _tilt_misfits(rises[lag][rows], body_axis[rows])
        if tilt is None or not fits_tilt(tilt):
            return 0.0
        is_better = (tilt < HALF * claimed.tilt).any()
        return float(lags[lag]) if is_better else 0.0

    def _velocities(
        self, attitude: AttitudeReading, frame: str, position: Array | None = None
    ) -> tuple[Array, Array]:
        """Measured velocities, and those of the positions, in a frame (N, 3)."""
        moves = self.windows.moves
        if position is not None:
            moves = moves @ np.linalg.inv(position).T
        if frame == "body":
            middle = attitude.attitudes(self.windows.attitudes[1])
            moves = rotate(quaternion_inverse(middle), moves)
        return self.windows.velocities, moves

    def _rates(self, attitude: AttitudeReading, frame: str) -> tuple[Array, Array]:
        """Measured rates, and those of the attitudes, in a frame (N, 3)."""
        before, middle, after = attitude.attitudes(self.windows.attitudes)
        turns = rotation_vector(quaternion_product(quaternion_inverse(before), after))
        turns = turns / self.windows.duration
        if frame == "world":
            turns = rotate(middle, turns)
        return self.windows.rates, turns

    def _accelerations(
        self, attitude: AttitudeReading, position: Array, velocity: AxisFit, frame: str
    ) -> Array:
        """Accelerations (N, 3) in world axes, after this reading."""
        turn = self._turn_to(self.claim.velocity, self.claim.velocity_frame, frame)
        velocities = (self.windows.wide_velocities @ turn) / velocity.factors
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
        attitude: AttitudeReading,
        position: Array,
        velocity: AxisFit,
        rate: AxisFit,
        velocity_frame: str,
        rate_frame: str,
        body_axis: Array | None = None,
    ) -> Reading:
        """A reading with the third relation, its cost and its score."""
        if body_axis is None:
            body_axis = self._body_axis(attitude)
        accelerations = self._accelerations(
            attitude, position, velocity, velocity_frame
        )
        force = accelerations - GRAVITY
        lift = float(np.median((force * body_axis).sum(axis=-1)))
        tilt = _tilt_misfits(accelerations, body_axis)
        reading = Reading(
            attitude=attitude,
            position=position,
            velocity=velocity,
            rate=rate,
            velocity_frame=velocity_frame,
            rate_frame=rate_frame,
            tilt=tilt,
            lift=lift,
        )
        cost = self._cost(reading)
        fits = velocity.score + rate.score - CHANGE * (velocity.cost + rate.cost)
        score = fits + CHANGE * cost
        if tilt is not None and fits_tilt(tilt):
            score += float(np.nansum(np.log(np.maximum(tilt, FLOOR_TILT))))
        if lift < 0:
            score += CHANGE  # a body that hangs from its own top is rare
        return replace(reading, cost=cost, score=score)

    def _body_axis(self, attitude: AttitudeReading) -> Array:
        """The body's axis z in world axes (N, 3), on average over the wide windows."""
        attitudes = attitude.attitudes(self.windows.wide_attitudes)
        before, middle, after = rotate(
            attitudes, np.broadcast_to([0.0, 0.0, 1.0], (*attitudes.shape[:-1], 3))
        )
        return (before + 4 * middle + after) / 6

    def _cost(self, reading: Reading) -> float:
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
        unit, axes = unit_and_axes(reading.position)
        if reading.velocity_frame == "body":
            return cost + count_mistakes(axes) + (unit != 1) + fit.cost
        # What the velocity is to the read position, it is to the true one by both.
        is_shared = np.array_equal(fit.matrix, np.eye(3))
        if axes[2, 2] != 1 and not np.array_equal(axes, NED):
            cost += RARE - 1  # whether z points up, gravity hardly says
        cost += count_mistakes(axes) + (
            0 if is_shared else count_mistakes(fit.matrix @ axes)
        )
        in_units = fit.cost - count_mistakes(fit.matrix) - (fit.lag != 0)
        if in_units and np.allclose(fit.factors * unit, 1):
            in_units = 0.0  # the unit of the position is the only one that is wrong
        return cost + (unit != 1) + in_units + (fit.lag != 0)

    def _turns_rate(self, reading: Reading) -> bool:
        """Whether NED and ENU, or FRD and FLU, change places in the rate."""
        turned = FRD if reading.rate_frame == "body" else NED
        return np.array_equal(reading.rate.matrix, turned)

    def is_other_frame(self, reading: Reading) -> bool:
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

    def readings(self) -> Iterator[Reading]:
        """All readings that may be better than the claim."""
        claimed = self.claimed()
        best = claimed.score
        in_world = fit_axes_and_lag(
            self._velocities_in["world"],
            self.windows.moves,
            self.speed_factors,
            FLOOR_VELOCITY,
        )
        positions = [*_position_changes()]
        explained = in_world.matrix * in_world.factors[:, None]
        if not np.array_equal(explained, np.eye(3)) and not in_world.lag:
            positions.append(np.array(np.linalg.inv(explained), dtype=float))
        # No reading can fit a velocity better than this.
        best_velocity = 3 * np.log(FLOOR_VELOCITY)
        may_be_body = self._is_body_velocity(self.attitudes[0], claimed)
        if not may_be_body:
            best_velocity = in_world.score - CHANGE * in_world.cost
        best_tilt = 2 * np.log(FLOOR_TILT)
        least_agreement = self._least_agreement(claimed)
        for attitude in self.attitudes:
            body_axis = self._body_axis(attitude)
            for rate_frame in ("body", "world"):
                _, derived = self._rates(attitude, rate_frame)
                rates = self._rates_in[rate_frame]
                agreement = float(agreements(rates, derived).max())
                if attitude.cost and agreement < least_agreement:
                    continue
                rate = fit_axes_and_lag(rates, derived, self.rate_factors, FLOOR_RATE)
                # A mistake that several signals share counts once.
                least_cost = attitude.cost + (rate_frame != self._frames[1]) - 2
                least = rate.score + CHANGE * max(least_cost, -rate.cost)
                if least + best_velocity + best_tilt > best:
                    continue
                frames = ["world"]
                if self._is_body_velocity(attitude, claimed):
                    frames.append("body")
                for frame, position in itertools.product(frames, positions):
                    velocity = in_world
                    if frame == "body":
                        if not _is_likely(attitude, position):
                            continue
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

    def _least_agreement(self, claimed: Reading) -> float:
        """Sum of the rate's correlations of which another attitude is worth while."""
        _, derived = self._rates(self.attitudes[0], self._frames[1])
        now = len(self.rates.lags) // 2
        agreement = float(np.trace(lagged_correlations(self.rates, derived)[now]))
        is_velocity_doubtful = claimed.velocity.misfits.max() > DOUBTFUL
        is_in_question = is_velocity_doubtful and self._frames[0] == "body"
        if claimed.tilt is not None and not fits_tilt(claimed.tilt):
            is_in_question = True
        chance = -AGREEMENT if is_in_question else AGREEMENT
        return max(agreement + chance, LEAST_AGREEMENT)

    def _is_body_velocity(self, attitude: AttitudeReading, claimed: Reading) -> bool:
        """Whether a velocity in body axes is worth while to be looked at."""
        if self._frames[0] == "body":
            return True
        if claimed.velocity.misfits.max() < DOUBTFUL:
            return False
        now = len(self.velocities.lags) // 2
        own = np.trace(lagged_correlations(self.velocities, self.windows.moves)[now])
        _, derived = self._velocities(attitude, "body")
        agreement = agreements(self._velocities_in["body"], derived).max()
        return bool(agreement > max(own, LEAST_AGREEMENT))

    def _fit_body_velocity(self, attitude: AttitudeReading, position: Array) -> AxisFit:
        _, derived = self._velocities(attitude, "body", position)
        return fit_axes_and_lag(
            self._velocities_in["body"], derived, self.speed_factors, FLOOR_VELOCITY
        )


def _move(vectors: Array) -> np.ndarray:
    """Whether the axes of vectors (N, 3) are more than a hover's (3,)."""
    large = QUANTILES.index(0.9)
    return absolute_quantiles(centred(vectors))[large] > MOVES


def _score(fit: AxisFit, floor: float) -> float:
    return float(np.log(np.maximum(fit.misfits, floor)).sum())


@cache
def _position_changes() -> list[Array]:
    """Axes and units of positions that are tried: the first is what is claimed."""
    changes = axis_changes()
    single = [
        m for m, cost in zip(changes.matrices, changes.costs, strict=True) if cost < 2
    ]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turns = [quarter, quarter @ quarter, quarter.T]
    units = [unit for unit in LENGTHS.values() if unit != 1]
    factors = sorted({*units, *(1 / unit for unit in units)})
    return [*single, *turns, *(factor * np.eye(3) for factor in factors)]


def unit_and_axes(position: Array) -> tuple[float, Array]:
    """The factor and the change of axes (3, 3) that are in one change of a position."""
    unit = float(abs(np.linalg.det(position)) ** (1 / 3))
    if abs(unit - 1) < 1e-9:
        unit = 1.0
    return unit, np.rint(position / unit)


def _is_likely(attitude: AttitudeReading, position: Array) -> bool:
    """Whether both are worth while to be tried with a velocity in body axes."""
    if np.array_equal(position, np.eye(3)):
        return True
    unit, axes = unit_and_axes(position)
    one_mistake = unit == 1 and count_mistakes(axes) < 2
    return one_mistake and (attitude.cost == 0 or attitude.turns_axes)


def _factors(
    measured: Signal,
    measured_units: dict[str, float],
    derived: Signal,
    derived_units: dict[str, float],
) -> tuple[float, ...]:
    """What a measured value is over the derived one where one unit is mistaken."""
    said = unit_factor(measured)
    ratios = {said / unit for unit in measured_units.values()}
    said = unit_factor(derived)
    ratios |= {unit / said for unit in derived_units.values()}
    return tuple(sorted(ratio for ratio in ratios if abs(ratio - 1) > 1e-9))


def unit_factor(signal: Signal) -> float:
    return conversion(signal.name, signal.unit).factor


def _tilt_misfits(accelerations: Array, body_axis: Array) -> Array | None:
    """Misfits (2,) of a_xy t_z to t_xy (a_z + g); NaN of an axis that does not move.

    None where neither does.
    """
    measured = accelerations[:, :2] * body_axis[:, 2:]
    derived = body_axis[:, :2] * (accelerations[:, 2:] - GRAVITY[2])
    large = QUANTILES.index(0.9)
    sizes = np.maximum(
        absolute_quantiles(centred(measured)), absolute_quantiles(centred(derived))
    )
    moves = sizes[large] > TILT_MOVES
    if not moves.any():
        return None
    return np.where(moves, misfits(measured, derived), np.nan)


def fits_tilt(tilt: Array | None) -> bool:
    """Whether the body is carried along its axis z, as far as it moves."""
    return tilt is not None and not (tilt > TILT_FITS).any()
