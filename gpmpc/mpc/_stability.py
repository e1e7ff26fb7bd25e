"""Tells whether a loop is stable where it is to rest, before it runs.

Near a set point no bound is active, and the first input of the quadratic program is an
affine function of what the program is told:
u_k = F_x s_k + F_u u_{k-1} + F_d d_k + const, the gain of the finite-horizon regulator
of the stages there. Closed with the plant's own linearisation it is a linear system in
(x_k, s_{k-1}, u_{k-1}, d_{k-1}),

    s_k = C x_k
    d_k = (1 - L) d_{k-1} + L (s_k - A s_{k-1} - B u_{k-1})
    x_{k+1} = A_p x_k + B_p u_k

whose spectral radius says whether the loop settles. x is the plant's state, with the
inputs on their way where they act late; s what the controller is told of it; d the
estimate of the disturbance, of gain L. The form ``velocity`` is L = 1: its constant is
what the last step missed. Derivatives of the stages by their points are of second order
where the loop rests, so that the law is that of every iteration and covariance mode,
but for what covariances weigh.

A short horizon may take a plant's inverse response for the whole of it: every program
is solved, and the loop runs away (on receding finite horizons: Bitmead, Gevers and
Wertz, 1990). One backward Riccati recursion gives the first gains of all horizons.

Points of rest are found in ``_rest_points``; the linear system is ``_linear_loop``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.models import DelayedModel
from gpmpc.mpc._controller import Reference, read_reference
from gpmpc.mpc._linear_loop import LinearLoop, observer_gain
from gpmpc.mpc._linearization import PredictionModel
from gpmpc.mpc._rest_points import pending_inputs, rest_points

Array = np.ndarray

_LONGEST = 20  # horizons that are tried, in that of the controller
_GAIN_TOLERANCE = 1e-3  # of a gain that is advised
_SPARE = 0.8  # share of the largest gain of an estimate that is advised
_PLANT_GAINS = (0.7, 1.0, 1.3)  # that an estimate of the disturbance is to bear


@dataclass(frozen=True)
class Stability:
    """What the loop does near the points where it is to rest.

    See Also:
        ``GPMPC.stability``, which computes it.
    """

    horizon: int  #: H, of the controller
    #: the largest size of an eigenvalue of the closed loop: above 1 it does not settle;
    #: NaN where no point could be judged: the model rests nowhere near the reference
    #: within the bounds of inputs and states
    spectral_radius: float
    #: whether no mode grows: integrators that nothing weighs may stand still. Of a
    #: learned model growth counts above 0.1 % a step, since its integrators are not
    #: exact ones, and above two standard deviations of what its GPs know; that of
    #: models of logs and of kernels of one's own is not known, and counts as zero.
    #: False where no point could be judged
    stable: bool
    #: the shortest horizon from which on no mode grows; None without any of those tried
    shortest_horizon: int | None
    horizons: int  #: how many were tried, from 1 on; 0 where weights differ by stage
    #: range of factors of the plant's inputs around 1, tried from 0.5 to 1.5, in which
    #: no mode grows; NaN without any
    gain_range: tuple[float, float]
    #: L, of the controller's estimate; 1 in the form ``velocity``
    disturbance_gain: float
    #: the controller's L where no mode grows while the plant's inputs do 0.7 to 1.3 of
    #: what the model says; where one does, four fifths of the largest L with which none
    #: does; NaN where one does without an estimate, too
    safe_disturbance_gain: float
    states: Array  #: the points that were judged (K, n)
    #: the inputs that hold them (K, m); those at a bound count as held
    inputs: Array

    @property
    def judged(self) -> bool:
        """Whether there was a point to judge."""
        return len(self.states) > 0

    @property
    def warnings(self) -> list[str]:
        """What to change, a line each; none where nothing is."""
        if self.safe_disturbance_gain < self.disturbance_gain:
            fault = f"disturbance_gain {self.disturbance_gain:g} is too large"
            if self.disturbance_gain == 1.0:
                fault = f"{fault} (form 'velocity' has it, too)"
            cause = (
                "the loop swings up where inputs do 0.7 or 1.3 of what the model says"
            )
            return [f"{fault}: {cause}; {self.safe_disturbance_gain:.2g} is safe"]
        if self.stable or not self.judged:
            return []
        growth = 100.0 * (self.spectral_radius - 1.0)
        fault = f"horizon {self.horizon}: the loop runs away from its reference"
        if self.shortest_horizon is not None:
            cure = f"it settles with {self.shortest_horizon} steps or more"
        elif self.horizons:
            cure = f"so it does with any up to {self.horizons}: change the weights"
        else:
            cure = "try a longer one"
        return [f"{fault}, by {growth:.2g} % a step; {cure}"]


def stability(
    prediction: PredictionModel,
    reference: Any,
    plant: DynamicsModel | None = None,
    ahead: DelayedModel | None = None,
    parameters: Any = None,
) -> Stability:
    """Returns what a loop does near its reference; see ``GPMPC.stability``."""
    followed = read_reference(reference).in_order(prediction.stated_signals)
    _check_reference(followed, prediction)
    _check(prediction, plant, ahead)
    horizon = prediction.horizon
    problem = prediction.stated_problem
    n = problem.state_dim
    disturbance_gain = observer_gain(prediction.settings)
    points = rest_points(prediction, followed, parameters)
    if not points:
        return Stability(
            horizon=horizon,
            spectral_radius=math.nan,
            stable=False,
            shortest_horizon=None,
            horizons=0,
            gain_range=(math.nan, math.nan),
            disturbance_gain=disturbance_gain,
            safe_disturbance_gain=math.nan,
            states=np.empty((0, n)),
            inputs=np.empty((0, problem.input_dim)),
        )
    loops = [LinearLoop(prediction, point, plant, ahead) for point in points]
    shortest, tried = _shortest_horizon(loops, horizon)
    gain_ranges = np.array([loop.gain_range() for loop in loops])
    return Stability(
        horizon=horizon,
        spectral_radius=max(loop.radius(horizon) for loop in loops),
        stable=not any(loop.grows(horizon) for loop in loops),
        shortest_horizon=shortest,
        horizons=tried,
        gain_range=(float(gain_ranges[:, 0].max()), float(gain_ranges[:, 1].min())),
        disturbance_gain=disturbance_gain,
        safe_disturbance_gain=_safe_disturbance_gain(loops, disturbance_gain),
        states=np.array([point.state[:n] for point in points]),
        inputs=np.array([point.input for point in points]),
    )


def _safe_disturbance_gain(
    loops: Sequence[LinearLoop], disturbance_gain: float
) -> float:
    """Returns a gain of the estimate with which no loop grows; see ``Stability``.

    It does not at any of the plant's gains.
    """

    def bears(L: float) -> bool:
        return not any(
            loop.grows(loop.horizon, gain, L) for loop in loops for gain in _PLANT_GAINS
        )

    if bears(disturbance_gain):
        return disturbance_gain
    if not bears(0.0):
        return math.nan
    safe = 0.0
    unsafe = disturbance_gain
    while unsafe - safe > _GAIN_TOLERANCE:
        middle = 0.5 * (safe + unsafe)
        if bears(middle):
            safe = middle
        else:
            unsafe = middle
    return math.floor(100.0 * _SPARE * safe) / 100.0


def _check_reference(reference: Reference, prediction: PredictionModel) -> None:
    """Raises ``ShapeError`` or ``DataError`` unless it is finite and of the states."""
    states = np.asarray(reference.states, dtype=float)
    n = prediction.stated_problem.state_dim
    if states.shape[-1] not in (n, prediction.model.state_dim):
        rule = f"must be ({n},) or (K, {n})"
        raise ShapeError(f"reference states {rule}; got {states.shape}")
    if not np.isfinite(states).all():
        raise DataError("reference states must be finite")


def _check(
    prediction: PredictionModel,
    plant: DynamicsModel | None,
    ahead: DelayedModel | None,
) -> None:
    """Raises ``SettingError`` where plant or delay do not belong to the controller."""
    model = prediction.model
    if ahead is not None:
        if not isinstance(ahead, DelayedModel):
            rule = "must be the DelayedModel whose ahead() the controller is told"
            raise SettingError("ahead", f"{rule}; got {type(ahead).__name__}")
        if ahead.remaining.state_dim != model.state_dim:
            rule = f"must leave the controller's {model.state_dim} states"
            got = ahead.remaining.state_dim
            raise SettingError("ahead", f"{rule} in its remaining; got {got}")
    if plant is None:
        return
    own = model.state_dim - len(pending_inputs(model))
    states = plant.state_dim - len(pending_inputs(plant))
    if states < own or plant.input_dim != model.input_dim:
        rule = f"must have at least {own} states and {model.input_dim} inputs"
        raise SettingError("plant", f"{rule}; got {states} and {plant.input_dim}")


def _shortest_horizon(
    loops: Sequence[LinearLoop], horizon: int
) -> tuple[int | None, int]:
    """Returns the shortest horizon from which on no loop grows; None without one.

    The second number is how many were tried.
    """
    if not all(loop.constant for loop in loops):
        return None, 0
    longest = horizon
    if any(loop.grows(horizon) for loop in loops):
        longest = _LONGEST * horizon
        for loop in loops:
            loop.look_ahead(longest)
    shortest = None
    for candidate in range(longest, 0, -1):
        if any(loop.grows(candidate) for loop in loops):
            break
        shortest = candidate
    return shortest, longest
