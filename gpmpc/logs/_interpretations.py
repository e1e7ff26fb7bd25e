"""Searches among all interpretations of a rigid body's columns for those that fit.

An interpretation says what the columns of position, attitude, velocity and rate are.
Its score has the form of that of a single fit (``gpmpc.logs._axis_fits``), over the
three relations of ``gpmpc.logs._conventions``; the smallest one is the best. The fewest
mistakes that explain a log come first:

    score = log misfit of velocity, of rate and of tilt + CHANGE * (cost + hangs)
    cost = OTHER_FRAME_COST                   where all is in NED instead of ENU; else:
           attitude.cost + rate.cost
           + 1 for the frame of the velocity, and for that of the rate, if not claimed
           - SHARED_SOURCE                    (``_shared_by_attitude_and_rate``)
           + cost of the position             (``_position_cost``)
           + cost of the velocity             (``_velocity_cost``)

``hangs`` is 1 where the lift points down: a body that hangs from its own top is rare.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._attitude_interpretations import RARE, AttitudeInterpretation
from gpmpc.logs._axis_fits import (
    CHANGE,
    AxisFit,
    agreements,
    axis_changes,
    count_mistakes,
    fit_axes_and_lag,
    lagged_correlations,
    misfits,
)
from gpmpc.logs._frames import FRD, NED
from gpmpc.logs._mapping import Signal
from gpmpc.logs._relations import MotionRelations, fits_tilt, tilt_misfits
from gpmpc.logs._units import DEGREE, conversion
from gpmpc.models._kinematics import GRAVITY

LEAST_AGREEMENT = 0.7  # sum of three correlations, to be worth while
AGREEMENT = 0.15  # in that sum, which is more than chance
DOUBTFUL = 0.2  # misfit from which another interpretation is looked for
OTHER_FRAME_COST = 0.5  # of NED for ENU in all states: the commonest mistake
SHARED_SOURCE = 0.75  # of a mistake: attitude and rate come from one sensor
# Attitude and rate in NED are two mistakes if counted singly, and have one cause: no
# cost is less than the sum of its parts by more than these two.
MOST_SHARED = 2.0
UP_IS_RARE = RARE - 1  # what makes one mistake of the axes a rare one
# Misfits below these are noise or smoothing, and no reason to prefer an interpretation.
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


@dataclass(frozen=True)
class Interpretation:
    """One interpretation of all columns, and how the three relations fit it."""

    attitude: AttitudeInterpretation
    #: the columns of the position are this matrix (3, 3), of axes and a unit, times the
    #: true position
    position: Array
    velocity: AxisFit  # to the changes of the position as it is read
    rate: AxisFit
    velocity_frame: str
    rate_frame: str
    tilt: Array | None  # misfits of the third relation (2,); None without excitation
    lift: float  # [m/s2] median of the force along the body's z
    cost: float = 0.0  # number of mistakes
    score: float = 0.0  # the smaller, the better


class InterpretationSearch:
    """Interpretations of the windows of a log, beside the claim of a mapping."""

    def __init__(self, relations: MotionRelations) -> None:
        claim = relations.claim
        self.relations = relations
        self.claim = claim
        self.speed_factors = _factors(claim.velocity, SPEEDS, claim.position, LENGTHS)
        self.rate_factors = _factors(claim.rate, RATES, claim.attitude, ANGLES)

    def claimed(self) -> Interpretation:
        """Returns the interpretation of the mapping."""
        claim = self.claim
        attitude = self.relations.claimed_attitude
        velocities = self.relations.velocities(attitude, claim.velocity_frame)
        velocity_misfits = misfits(velocities.measured, velocities.derived)
        rates = self.relations.rates(attitude, claim.rate_frame)
        rate_misfits = misfits(rates.measured, rates.derived)
        return self._interpretation(
            attitude=attitude,
            position=np.eye(3),
            velocity=AxisFit(velocity_misfits, floor=FLOOR_VELOCITY),
            rate=AxisFit(rate_misfits, floor=FLOOR_RATE),
            velocity_frame=claim.velocity_frame,
            rate_frame=claim.rate_frame,
            body_axis=self.relations.body_axis(attitude),
        )

    def candidates(self) -> Iterator[Interpretation]:
        """Yields all interpretations that may be better than the claim."""
        claimed = self.claimed()
        best_score = claimed.score
        in_world = self._fit_world_velocity()
        positions = _positions_to_try(in_world)
        velocity_bound = self._velocity_bound(claimed, in_world)
        tilt_bound = 2 * np.log(FLOOR_TILT)
        least_agreement = self._least_agreement(claimed)
        attitudes = self.relations.attitudes
        for attitude, rate_frame in itertools.product(attitudes, ("body", "world")):
            rate = self._fit_rate(attitude, rate_frame, least_agreement)
            if rate is None:
                continue
            rate_bound = self._rate_bound(attitude, rate_frame, rate)
            if rate_bound + velocity_bound + tilt_bound > best_score:
                continue
            body_axis = self.relations.body_axis(attitude)
            frames = ["world"]
            if self._may_be_body_velocity(attitude, claimed):
                frames.append("body")
            for frame, position in itertools.product(frames, positions):
                velocity = in_world
                if frame == "body":
                    if not _is_likely(attitude, position):
                        continue
                    velocity = self._fit_body_velocity(attitude, position)
                candidate = self._interpretation(
                    attitude=attitude,
                    position=position,
                    velocity=velocity,
                    rate=rate,
                    velocity_frame=frame,
                    rate_frame=rate_frame,
                    body_axis=body_axis,
                )
                best_score = min(best_score, candidate.score)
                yield candidate

    def _fit_world_velocity(self) -> AxisFit:
        return fit_axes_and_lag(
            series=self.relations.velocity_series["world"],
            derived=self.relations.windows.moves,
            factors=self.speed_factors,
            floor=FLOOR_VELOCITY,
        )

    def _fit_body_velocity(
        self, attitude: AttitudeInterpretation, position: Array
    ) -> AxisFit:
        velocities = self.relations.velocities(attitude, "body", position)
        return fit_axes_and_lag(
            series=self.relations.velocity_series["body"],
            derived=velocities.derived,
            factors=self.speed_factors,
            floor=FLOOR_VELOCITY,
        )

    def _fit_rate(
        self, attitude: AttitudeInterpretation, frame: str, least_agreement: float
    ) -> AxisFit | None:
        """Fits the rate to another attitude; None where they hardly correlate."""
        derived = self.relations.rates(attitude, frame).derived
        series = self.relations.rate_series[frame]
        agreement = float(agreements(series, derived).max())
        if attitude.cost and agreement < least_agreement:
            return None
        return fit_axes_and_lag(series, derived, self.rate_factors, FLOOR_RATE)

    def _velocity_bound(self, claimed: Interpretation, in_world: AxisFit) -> float:
        """Returns the log misfit of the velocity, or a bound of it from below."""
        if self._may_be_body_velocity(self.relations.claimed_attitude, claimed):
            return float(3 * np.log(FLOOR_VELOCITY))
        return in_world.log_misfit

    def _rate_bound(
        self, attitude: AttitudeInterpretation, rate_frame: str, rate: AxisFit
    ) -> float:
        """Returns a bound of the score of attitude and rate, from below."""
        is_other_frame = rate_frame != self.claim.rate_frame
        cost = attitude.cost + rate.cost + is_other_frame
        return rate.log_misfit + CHANGE * max(cost - MOST_SHARED, 0.0)

    def _least_agreement(self, claimed: Interpretation) -> float:
        """Returns the rate's correlations of which another attitude is worth while."""
        rates = self.relations.rates(
            self.relations.claimed_attitude, self.claim.rate_frame
        )
        series = self.relations.claimed_rates
        now = len(series.lags) // 2
        agreement = float(np.trace(lagged_correlations(series, rates.derived)[now]))
        is_velocity_doubtful = claimed.velocity.misfits.max() > DOUBTFUL
        is_in_question = is_velocity_doubtful and self.claim.velocity_frame == "body"
        if claimed.tilt is not None and not fits_tilt(claimed.tilt):
            is_in_question = True
        chance = -AGREEMENT if is_in_question else AGREEMENT
        return max(agreement + chance, LEAST_AGREEMENT)

    def _may_be_body_velocity(
        self, attitude: AttitudeInterpretation, claimed: Interpretation
    ) -> bool:
        """Tells whether a velocity in body axes is worth while to be looked at."""
        if self.claim.velocity_frame == "body":
            return True
        if claimed.velocity.misfits.max() < DOUBTFUL:
            return False
        series = self.relations.claimed_velocities
        now = len(series.lags) // 2
        moves = self.relations.windows.moves
        claimed_agreement = np.trace(lagged_correlations(series, moves)[now])
        velocities = self.relations.velocities(attitude, "body")
        body_series = self.relations.velocity_series["body"]
        agreement = agreements(body_series, velocities.derived).max()
        return bool(agreement > max(claimed_agreement, LEAST_AGREEMENT))

    def _interpretation(
        self,
        attitude: AttitudeInterpretation,
        position: Array,
        velocity: AxisFit,
        rate: AxisFit,
        velocity_frame: str,
        rate_frame: str,
        body_axis: Array,
    ) -> Interpretation:
        """Makes an interpretation with the third relation, its cost and its score."""
        accelerations = self.relations.accelerations(
            attitude=attitude,
            position=position,
            velocity=velocity,
            frame=velocity_frame,
        )
        force = accelerations - GRAVITY
        interpretation = Interpretation(
            attitude=attitude,
            position=position,
            velocity=velocity,
            rate=rate,
            velocity_frame=velocity_frame,
            rate_frame=rate_frame,
            tilt=tilt_misfits(accelerations, body_axis),
            lift=float(np.median((force * body_axis).sum(axis=-1))),
        )
        cost = self._cost(interpretation)
        score = _score(interpretation, cost)
        return replace(interpretation, cost=cost, score=score)

    def _cost(self, interpretation: Interpretation) -> float:
        """Counts mistakes; one that several signals share counts once."""
        if self.is_other_frame(interpretation):
            return OTHER_FRAME_COST
        cost = interpretation.attitude.cost + interpretation.rate.cost
        cost += interpretation.velocity_frame != self.claim.velocity_frame
        cost += interpretation.rate_frame != self.claim.rate_frame
        cost -= _shared_by_attitude_and_rate(interpretation)
        return cost + _position_cost(interpretation) + _velocity_cost(interpretation)

    def is_other_frame(self, interpretation: Interpretation) -> bool:
        """Tells whether all is in NED that is said to be in ENU, or the reverse."""
        velocity = interpretation.velocity
        rate = interpretation.rate
        in_world = interpretation.velocity_frame == "world"
        claim = self.claim
        return (
            interpretation.attitude.turns_axes
            and np.array_equal(interpretation.position, NED)
            and np.array_equal(velocity.matrix, np.eye(3) if in_world else FRD)
            and _turns_rate(interpretation)
            and all(fit.lag == 0 for fit in (velocity, rate))
            and all((fit.factors == 1).all() for fit in (velocity, rate))
            and interpretation.velocity_frame == claim.velocity_frame
            and interpretation.rate_frame == claim.rate_frame
        )


def _turns_rate(interpretation: Interpretation) -> bool:
    """Tells whether NED and ENU, or FRD and FLU, change places in the rate."""
    turned = FRD if interpretation.rate_frame == "body" else NED
    return np.array_equal(interpretation.rate.matrix, turned)


def _shared_by_attitude_and_rate(interpretation: Interpretation) -> float:
    """Returns what counts once where both have the wrong one of NED and ENU."""
    if interpretation.attitude.turns_axes and _turns_rate(interpretation):
        return SHARED_SOURCE
    return 0.0


def _position_cost(interpretation: Interpretation) -> float:
    """Counts the mistakes of the position: its axes and its unit."""
    unit, axes = unit_and_axes(interpretation.position)
    cost = count_mistakes(axes)
    if unit != 1:
        cost += 1
    turns_up = axes[2, 2] != 1 and not np.array_equal(axes, NED)
    if interpretation.velocity_frame == "world" and turns_up:
        cost += UP_IS_RARE  # whether z points up, gravity hardly says
    return cost


def _velocity_cost(interpretation: Interpretation) -> float:
    """Counts the mistakes of the velocity that are not those of the position."""
    fit = interpretation.velocity
    if interpretation.velocity_frame == "body":
        return fit.cost
    unit, axes = unit_and_axes(interpretation.position)
    axes_cost = _world_velocity_axes_cost(fit, axes)
    unit_cost = _world_velocity_unit_cost(fit, unit)
    return axes_cost + unit_cost + fit.lag_cost


def _world_velocity_axes_cost(fit: AxisFit, position_axes: Array) -> float:
    """Counts the mistakes of the axes of a velocity in world axes.

    Where it fits the position as that is read, both have the same axes, and the
    mistakes are counted with the position. Otherwise the velocity is to the true
    position what it is to the read one, and the read one to the true one.
    """
    if np.array_equal(fit.matrix, np.eye(3)):
        return 0.0
    return count_mistakes(fit.matrix @ position_axes)


def _world_velocity_unit_cost(fit: AxisFit, position_unit: float) -> float:
    """Counts a wrong unit of a velocity in world axes; 0 if the position's is wrong."""
    if np.allclose(fit.factors * position_unit, 1):
        return 0.0
    return fit.unit_cost


def _score(interpretation: Interpretation, cost: float) -> float:
    """Returns the score of an interpretation by its number of mistakes."""
    log_misfit = interpretation.velocity.log_misfit + interpretation.rate.log_misfit
    tilt = interpretation.tilt
    if tilt is not None and fits_tilt(tilt):
        log_misfit += float(np.nansum(np.log(np.maximum(tilt, FLOOR_TILT))))
    hangs = 1.0 if interpretation.lift < 0 else 0.0
    return log_misfit + CHANGE * (cost + hangs)


def _positions_to_try(in_world: AxisFit) -> list[Array]:
    """Lists axes and units (3, 3) of the position: the first is what is claimed.

    Args:
        in_world: The fit of a velocity in world axes; the last position explains it.
    """
    positions = [*_position_changes()]
    explained = in_world.matrix * in_world.factors[:, None]
    if not np.array_equal(explained, np.eye(3)) and not in_world.lag:
        positions.append(np.array(np.linalg.inv(explained), dtype=float))
    return positions


@cache
def _position_changes() -> list[Array]:
    """Lists axes and units of positions that are tried, the claimed one first."""
    changes = axis_changes()
    single = [
        matrix
        for matrix, cost in zip(changes.matrices, changes.costs, strict=True)
        if cost < 2
    ]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turns = [quarter, quarter @ quarter, quarter.T]
    units = [unit for unit in LENGTHS.values() if unit != 1]
    factors = sorted({*units, *(1 / unit for unit in units)})
    return [*single, *turns, *(factor * np.eye(3) for factor in factors)]


def unit_and_axes(position: Array) -> tuple[float, Array]:
    """Splits a change of a position (3, 3) into a factor and a change of axes."""
    unit = float(abs(np.linalg.det(position)) ** (1 / 3))
    if abs(unit - 1) < 1e-9:
        unit = 1.0
    return unit, np.rint(position / unit)


def _is_likely(attitude: AttitudeInterpretation, position: Array) -> bool:
    """Tells whether to try both with a velocity in body axes."""
    if np.array_equal(position, np.eye(3)):
        return True
    unit, axes = unit_and_axes(position)
    is_one_mistake = unit == 1 and count_mistakes(axes) < 2
    return is_one_mistake and (attitude.cost == 0 or attitude.turns_axes)


def _factors(
    measured: Signal,
    measured_units: dict[str, float],
    derived: Signal,
    derived_units: dict[str, float],
) -> tuple[float, ...]:
    """Lists the ratios of measured to derived values where one unit is mistaken."""
    measured_unit = unit_factor(measured)
    derived_unit = unit_factor(derived)
    ratios = {measured_unit / unit for unit in measured_units.values()}
    ratios |= {unit / derived_unit for unit in derived_units.values()}
    return tuple(sorted(ratio for ratio in ratios if abs(ratio - 1) > 1e-9))


def unit_factor(signal: Signal) -> float:
    """Returns what one of a signal's unit is in SI units."""
    return conversion(signal.name, signal.unit).factor
