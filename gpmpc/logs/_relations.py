"""Compares what was measured of a rigid body with the derivatives that it should be.

In windows of its motion, the mean velocity is the change of the position over the time,
the mean angular rate is the turn of the attitude over the time, and a body that is
carried along its own axis z accelerates to where it tilts (``_conventions``).
"""

import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._attitude_interpretations import (
    AttitudeInterpretation,
    attitude_interpretations,
)
from gpmpc.logs._axis_fits import (
    FEWEST,
    QUANTILES,
    AxisFit,
    LaggedVectors,
    absolute_quantiles,
    centred,
    correlation,
    lagged_correlations,
    lagged_vectors,
    misfits,
)
from gpmpc.logs._frames import Claim
from gpmpc.logs._mapping import Signal
from gpmpc.logs._motion_windows import HALF_WIDE, MotionWindows
from gpmpc.models._kinematics import GRAVITY
from gpmpc.models._quaternions import (
    quaternion_inverse,
    quaternion_product,
    rotate,
    rotation_vector,
)

LEAST_CLOCK_LAG = 0.1  # [s] of the attitude behind the position that is said
BETTER_RATIO = (
    0.5  # of the claim's misfit, which a better interpretation has to stay below
)
TILT_FITS = 0.6  # misfit below which the third relation holds; drag disturbs it
TILT_MOVES = 0.3  # [m/s2] of the horizontal force from which it is looked at
MOVES = 0.3  # [m/s], [rad/s] of an axis that is no hover's
SMOOTH = 0.8  # correlation with the next window of what is no noise


class Compared(NamedTuple):
    """Measured vectors, and the derivatives that they should be (N, 3)."""

    measured: Array
    derived: Array


class Relation(NamedTuple):
    """A signal and the derivative that it should be, as the mapping claims them."""

    measured: Signal
    derived: Signal
    frame: str
    correlations: Array  # by axis (3,)
    moves: np.ndarray  # whether both do, by axis (3,)
    is_smooth: np.ndarray  # whether both are no noise, by axis (3,)


class MotionRelations:
    """Windows of a log, with the relations that a mapping claims to hold in them."""

    def __init__(self, windows: MotionWindows, claim: Claim) -> None:
        self.windows = windows
        self.claim = claim
        #: by the frame that they are taken for
        self.velocity_series = self._in_both_frames(
            windows.later_velocities, claim.velocity, claim.velocity_frame
        )
        self.rate_series = self._in_both_frames(
            windows.later_rates, claim.rate, claim.rate_frame
        )
        self.claimed_velocities = self.velocity_series[claim.velocity_frame]
        self.claimed_rates = self.rate_series[claim.rate_frame]
        self.attitudes = attitude_interpretations(claim)

    @property
    def claimed_attitude(self) -> AttitudeInterpretation:
        """The interpretation of the attitude that the mapping claims."""
        return self.attitudes[0]

    def _in_both_frames(
        self, later: Array, signal: Signal, claimed_frame: str
    ) -> dict[str, LaggedVectors]:
        """Returns the measured vectors, taken for those of either frame."""
        claimed = lagged_vectors(self.windows.lags, later)
        series = {}
        for frame in ("world", "body"):
            turn = self._turn_to(signal, claimed_frame, frame)
            if np.array_equal(turn, np.eye(3)):
                series[frame] = claimed
            else:
                series[frame] = lagged_vectors(self.windows.lags, later @ turn)
        return series

    def _turn_to(self, signal: Signal, claimed_frame: str, frame: str) -> Array:
        """Returns the matrix (3, 3) for a vector that is taken for one in a frame.

        It was read as one in the claimed frame: NED becomes ENU by another change of
        the axes than FRD becomes FLU.
        """
        claimed = self.claim.to_enu(signal, claimed_frame)  # its own inverse
        return claimed @ self.claim.to_enu(signal, frame)

    def velocities(
        self,
        attitude: AttitudeInterpretation,
        frame: str,
        position: Array | None = None,
    ) -> Compared:
        """Compares velocities with the changes of the position, in a frame.

        Args:
            attitude: Turns the changes to body axes.
            frame: "world" or "body".
            position: Axes and unit of the position, as it is interpreted (3, 3).
        """
        moves = self.windows.moves
        if position is not None:
            moves = moves @ np.linalg.inv(position).T
        if frame == "body":
            middle = attitude.attitudes(self.windows.attitudes[1])
            moves = rotate(quaternion_inverse(middle), moves)
        return Compared(measured=self.windows.velocities, derived=moves)

    def rates(self, attitude: AttitudeInterpretation, frame: str) -> Compared:
        """Compares angular rates with the turns of the attitude, in a frame."""
        before, middle, after = attitude.attitudes(self.windows.attitudes)
        turns = rotation_vector(quaternion_product(quaternion_inverse(before), after))
        turns = turns / self.windows.duration
        if frame == "world":
            turns = rotate(middle, turns)
        return Compared(measured=self.windows.rates, derived=turns)

    def accelerations(
        self,
        attitude: AttitudeInterpretation,
        position: Array,
        velocity: AxisFit,
        frame: str,
    ) -> Array:
        """Derives accelerations (N, 3) in world axes from the interpreted velocity."""
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

    def body_axis(self, attitude: AttitudeInterpretation) -> Array:
        """Returns the body's axis z in world axes (N, 3), averaged in wide windows."""
        attitudes = attitude.attitudes(self.windows.wide_attitudes)
        up = np.broadcast_to([0.0, 0.0, 1.0], (*attitudes.shape[:-1], 3))
        before, middle, after = rotate(attitudes, up)
        return (before + 4 * middle + after) / 6  # by Simpson's rule

    @cached_property
    def claimed_relations(self) -> tuple[Relation, Relation]:
        """Those of the velocity and of the rate, as the mapping claims them."""
        claim = self.claim
        attitude = self.claimed_attitude
        attitudes = attitude.attitudes(self.windows.wide_attitudes)
        turns = [
            rotation_vector(quaternion_product(quaternion_inverse(before), after))
            for before, after in itertools.pairwise(attitudes)
        ]
        if claim.rate_frame == "world":
            turns = [rotate(attitudes[1], turn) for turn in turns]
        moves = list(np.diff(self.windows.wide_positions, axis=0))
        if claim.velocity_frame == "body":
            to_body = quaternion_inverse(attitudes[1])
            moves = [rotate(to_body, move) for move in moves]
        velocities = self.velocities(attitude, claim.velocity_frame)
        rates = self.rates(attitude, claim.rate_frame)
        of_velocity = Relation(
            measured=claim.velocity,
            derived=claim.position,
            frame=claim.velocity_frame,
            correlations=correlation(velocities.measured, velocities.derived),
            moves=_move(velocities.measured) & _move(velocities.derived),
            is_smooth=self._is_smooth(self.claimed_velocities, moves),
        )
        of_rate = Relation(
            measured=claim.rate,
            derived=claim.attitude,
            frame=claim.rate_frame,
            correlations=correlation(rates.measured, rates.derived),
            moves=_move(rates.measured) & _move(rates.derived),
            is_smooth=self._is_smooth(self.claimed_rates, turns),
        )
        return of_velocity, of_rate

    def _is_smooth(
        self, series: LaggedVectors, neighbours: Sequence[Array]
    ) -> np.ndarray:
        """Tells of which axes (3,) windows are like the next ones.

        Args:
            series: Of the measured vectors.
            neighbours: Derived vectors of windows (N, 3), and of those behind them.
        """
        next_lag = int(np.argmin(np.abs(series.lags - self.windows.duration)))
        pair = series.later[[len(series.lags) // 2, next_lag]]
        inside = np.isfinite(pair).all(axis=(0, 2))
        measured = correlation(pair[0, inside], pair[1, inside])
        derived = correlation(neighbours[0], neighbours[1])
        return np.minimum(measured, derived) > SMOOTH

    def correlation_in(
        self, relation: Relation, attitude: AttitudeInterpretation, frame: str
    ) -> float:
        """Returns the mean correlation of a signal with its derivative in a frame."""
        if relation.measured == self.claim.rate:
            vectors = self.rates(attitude, frame)
        else:
            vectors = self.velocities(attitude, frame)
        correlations = correlation(vectors.measured, vectors.derived)
        return float(np.abs(correlations).mean())

    def claimed_lags(self) -> tuple[float, float]:
        """Returns the lags [s] of velocity and rate at which they correlate most."""
        attitude = self.claimed_attitude
        velocities = self.velocities(attitude, self.claim.velocity_frame)
        rates = self.rates(attitude, self.claim.rate_frame)
        return (
            _lag_of_best_correlation(self.claimed_velocities, velocities.derived),
            _lag_of_best_correlation(self.claimed_rates, rates.derived),
        )

    def tilt_lag(self, claimed_tilt: Array | None) -> float:
        """Returns the lag [s] of accelerations after the tilt; 0 where it is not clear.

        Args:
            claimed_tilt: Misfits (2,) of the third relation, as the mapping claims it;
                None where nothing moves.
        """
        if self.claim.velocity_frame == "body" or claimed_tilt is None:
            return 0.0
        series = self.claimed_velocities
        if len(series.lags) < 3:
            return 0.0
        half_width = max(round(HALF_WIDE / (series.lags[1] - series.lags[0])), 1)
        if len(series.lags) <= 2 * half_width:
            return 0.0
        span = series.lags[2 * half_width] - series.lags[0]
        rises = (
            series.later[2 * half_width :] - series.later[: -2 * half_width]
        ) / span
        # an acceleration is known at lags that have half a window on both sides
        lags = series.lags[half_width:-half_width]
        if np.isfinite(rises[len(lags) // 2]).all(axis=1).sum() < FEWEST:
            return 0.0
        body_axis = self.body_axis(self.claimed_attitude)
        accelerations = lagged_vectors(lags, rises)
        leans = np.column_stack([body_axis[:, :2], np.zeros(len(body_axis))])
        correlations = lagged_correlations(accelerations, leans)
        best = int((correlations[:, 0, 0] + correlations[:, 1, 1]).argmax())
        rows = accelerations.inside[best]
        if abs(lags[best]) < LEAST_CLOCK_LAG or rows.sum() < FEWEST:
            return 0.0
        tilt = tilt_misfits(rises[best][rows], body_axis[rows])
        if tilt is None or not fits_tilt(tilt):
            return 0.0
        is_better = (tilt < BETTER_RATIO * claimed_tilt).any()
        return float(lags[best]) if is_better else 0.0


def _lag_of_best_correlation(series: LaggedVectors, derived: Array) -> float:
    """Returns the lag [s] at which the axes' correlations have the largest sum."""
    correlations = lagged_correlations(series, derived)
    sums = np.trace(correlations, axis1=1, axis2=2)
    return float(series.lags[int(sums.argmax())])


def _move(vectors: Array) -> np.ndarray:
    """Tells which axes (3,) of vectors (N, 3) move more than a hover's."""
    large = QUANTILES.index(0.9)
    return absolute_quantiles(centred(vectors))[large] > MOVES


def tilt_misfits(accelerations: Array, body_axis: Array) -> Array | None:
    """Returns misfits (2,) of a_xy t_z to t_xy (a_z + g).

    Args:
        accelerations: In world axes (N, 3).
        body_axis: The body's axis z in world axes (N, 3).

    Returns:
        The misfits, NaN of an axis that does not move; None where neither does.
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
    """Tells whether the body is carried along its axis z, as far as it moves."""
    return tilt is not None and not (tilt > TILT_FITS).any()
