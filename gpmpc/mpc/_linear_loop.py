"""The closed loop near a point of rest, as a linear system; see ``_stability``."""

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eig, matrix_balance

from gpmpc._dynamics import DynamicsModel, linearize, to_array
from gpmpc.exceptions import UnsupportedModel
from gpmpc.models import DelayedModel
from gpmpc.mpc._linear_quadratic import INCREMENTS
from gpmpc.mpc._linearization import PredictionModel, PredictionSettings
from gpmpc.mpc._rest_points import RestPoint, pending_inputs
from gpmpc.mpc._riccati import finite_horizon_lqr
from gpmpc.mpc._slopes import slope_covariances

Array = np.ndarray

_DEVIATIONS = 2.0  # of a growing mode from 1, by what a model's slopes are known to
_ROUNDING = 1e-6  # by how much a growing mode of a known model exceeds 1
_LEARNED = 1e-3  # of a learned one: its integrators are not exact ones
_LOWEST_GAIN = 0.5  # of the plant's inputs, in the model's
_HIGHEST_GAIN = 1.5
_GAINS = 21  # gains that are tried from the lowest to the highest
_GAIN_TOLERANCE = 1e-3
_REST_STEPS = 20  # of Newton's method, towards rest of states of the plant alone


class _Plant(NamedTuple):
    """The plant's linearisation, with the last inputs as states."""

    A: Array  # (p, p)
    B: Array  # (p, m)
    is_moved: Array  # by what the inputs do, not a copy of what they are (p,)
    C: Array  # (n, p) of what the controller is told
    state: Array  # where, without the last inputs


def observer_gain(settings: PredictionSettings) -> float:
    """Returns the gain L of the estimate of the disturbance that settings mean."""
    if settings.is_held:  # an increment holds all of the last error
        return 1.0
    return settings.disturbance_gain


class LinearLoop:
    """The closed loop of a controller and a plant, linearised at a point.

    Args:
        prediction: The controller's model and settings.
        point: Where.
        plant: What is steered; the controller's model by default.
        ahead: The delay that the controller's belief is predicted over, where it is.
    """

    def __init__(
        self,
        prediction: PredictionModel,
        point: RestPoint,
        plant: DynamicsModel | None,
        ahead: DelayedModel | None,
    ):
        self._point = point
        self.horizon = prediction.horizon
        self._disturbance_gain = observer_gain(prediction.settings)
        self._model: Any = plant or ahead or prediction.model
        self._tolerance = _LEARNED if _has_noise(self._model) else _ROUNDING
        self._plant = _linear_plant(prediction, point, plant, ahead)
        self._laws = _laws(point, prediction.horizon)

    @property
    def constant(self) -> bool:
        """Whether the cost weighs all stages alike.

        Another horizon has a meaning then.
        """
        cost = self._point.cost
        weights = (cost.state[:-1], cost.input, cost.squares)
        return all(len(W) == 0 or not np.ptp(W, axis=0).any() for W in weights)

    def look_ahead(self, horizon: int) -> None:
        """Computes the laws of all horizons up to one."""
        self._laws = _laws(self._point, horizon)

    def radius(
        self, horizon: int, gain: float = 1.0, disturbance_gain: float | None = None
    ) -> float:
        """Returns the spectral radius; see ``matrix``."""
        loop = self.matrix(horizon, gain, disturbance_gain)
        # The recursion of a mode that nothing reaches has no numbers.
        if not np.isfinite(loop).all():
            return math.inf
        return float(np.abs(np.linalg.eigvals(loop)).max())

    def grows(
        self, horizon: int, gain: float = 1.0, disturbance_gain: float | None = None
    ) -> bool:
        """Tells whether a mode grows by more than its model's doubt; see ``matrix``."""
        loop = self.matrix(horizon, gain, disturbance_gain)
        limit = 1.0 + self._tolerance
        if not np.isfinite(loop).all():
            return True
        if np.abs(np.linalg.eigvals(loop)).max() <= limit:
            return False
        _, (scales, _) = matrix_balance(loop, permute=False, separate=True)
        values, left_vectors, right_vectors = eig(loop, left=True)
        left_vectors = left_vectors * scales[:, None]
        right_vectors = right_vectors / scales[:, None]
        left_vectors = left_vectors / np.linalg.norm(left_vectors, axis=0)
        right_vectors = right_vectors / np.linalg.norm(right_vectors, axis=0)
        for i in np.flatnonzero(np.abs(values) > limit):
            doubt = self._doubt(
                values[i], left_vectors[:, i], right_vectors[:, i], scales
            )
            if abs(values[i]) > limit + _DEVIATIONS * doubt:
                return True
        return False

    def _doubt(self, value: complex, left: Array, right: Array, scales: Array) -> float:
        """Returns the standard deviation of a mode's eigenvalue.

        It is that of the slopes of the plant's model along the mode. Vectors are of
        length 1 in states of balanced scales. That a mode may be ill-conditioned beside
        another one is left out: this tells the modes that the model has no data of.
        """
        p, m = self._plant.B.shape
        n = self._model.state_dim
        state = (right * scales)[:n]
        input = value * (right * scales)[p : p + m]
        direction = np.concatenate([state, input])
        variances = np.einsum(
            "a,iab,b->i", direction.conj(), self._slope_covariances, direction
        ).real
        variance = np.abs(left[:n] / scales[:n]) ** 2 @ np.maximum(variances, 0.0)
        return math.sqrt(float(variance))

    @cached_property
    def _slope_covariances(self) -> Array:
        """Covariances of the slopes of the plant's model at the point."""
        return slope_covariances(self._model, self._plant.state, self._point.input)

    def gain_range(self) -> tuple[float, float]:
        """Returns the range of factors of the plant's inputs in which no mode grows.

        The range is around 1; NaN without any.
        """
        if self.grows(self.horizon):
            return math.nan, math.nan
        lowest = self._last_stable_gain(_LOWEST_GAIN)
        highest = self._last_stable_gain(_HIGHEST_GAIN)
        return lowest, highest

    def _last_stable_gain(self, end: float) -> float:
        """Returns the last stable factor on the way from 1 to an end."""
        stable = 1.0
        for gain in np.linspace(1.0, end, _GAINS)[1:]:
            if self.grows(self.horizon, gain):
                break
            stable = gain
        else:
            return end
        unstable = gain
        while abs(stable - unstable) > _GAIN_TOLERANCE:
            middle = 0.5 * (stable + unstable)
            if self.grows(self.horizon, middle):
                unstable = middle
            else:
                stable = middle
        return float(stable)

    def matrix(
        self, horizon: int, gain: float = 1.0, disturbance_gain: float | None = None
    ) -> Array:
        """Returns the closed loop of (x_k, u_{k-1}, s_{k-1}, d_{k-1}).

        The last two are left out where no disturbance is estimated.

        Args:
            horizon: Of the law.
            gain: How many times as much the plant's inputs do as the model says.
            disturbance_gain: L; the controller's own by default.
        """
        L = self._disturbance_gain if disturbance_gain is None else disturbance_gain
        A = self._point.A
        B = self._point.B
        A_p = self._plant.A
        C = self._plant.C
        B_p = np.where(self._plant.is_moved, gain, 1.0)[:, None] * self._plant.B
        n, m = B.shape
        p = len(A_p)
        law = self._laws[-horizon]
        error = np.hstack([L * C, -L * B, -L * A, (1.0 - L) * np.eye(n)])
        input = np.hstack([law.by_state @ C, law.by_last_input, np.zeros((m, 2 * n))])
        input = input + law.by_disturbance @ error
        state = np.hstack([A_p, np.zeros((p, m + 2 * n))]) + B_p @ input
        observed = np.hstack([C, np.zeros((n, m + 2 * n))])
        loop = np.vstack([state, input, observed, error])
        return loop if L > 0 else loop[: p + m, : p + m]


def _has_noise(model: Any) -> bool:
    """Tells whether a model, or one that it is around, has noise: it was learned.

    What is around may count that noise among its predictions.
    """
    try:
        noise = getattr(model, "noise_covariance", None)
    except UnsupportedModel:  # it depends on the state
        return True
    if noise is not None and to_array(noise).any():
        return True
    within = getattr(model, "model", None)
    return within is not None and _has_noise(within)


class _Law(NamedTuple):
    """Derivatives of the first inputs u_0 of a horizon (m, ...)."""

    by_state: Array
    by_disturbance: Array
    by_last_input: Array


def _laws(point: RestPoint, horizon: int) -> list[_Law]:
    """Returns the laws of the horizons from ``horizon`` down to 1.

    They are those of the regulator of (s, d, u_{-1}). The disturbance is added to the
    state at every stage, and nothing weighs it. Inputs that are held do not move.
    """
    A = point.A
    B = point.B
    cost = point.cost
    n, m = B.shape
    none = np.zeros((n, n))
    kept_input = np.zeros((m, m))  # how much of u_{-1} a stage's input goes on from
    if cost.penalized == INCREMENTS:
        kept_input = np.eye(m)
    transition = np.block(
        [
            [A, np.eye(n), B @ kept_input],
            [none, np.eye(n), np.zeros((n, m))],
            [np.zeros((m, 2 * n)), kept_input],
        ]
    )
    effect = np.vstack([B, np.zeros((n, m)), np.eye(m)])
    effect[:, point.is_held] = 0.0
    input_weights = _of_stages(cost.input, horizon).copy()
    input_weights[:, point.is_held] = 0.0
    input_weights[:, :, point.is_held] = 0.0
    input_weights[:, point.is_held, point.is_held] = 1.0
    squares = _of_stages(cost.squares, horizon)
    # The cost weighs s_1 .. s_{H-1}, the regulator s_0 .. s_{H-1}: s_0 is given, and
    # its weight says nothing of the law.
    weights_of_next = np.stack(
        [
            _wide(Q, squares[i : i + 1])
            for i, Q in enumerate(_of_stages(cost.state[:, 0], horizon))
        ]
    )
    weights = weights_of_next
    if len(weights_of_next) > 1:
        weights = np.concatenate([weights_of_next[:1], weights_of_next[:-1]])
    gains = finite_horizon_lqr.unchecked(
        transition[None],
        effect[None],
        weights,
        input_weights,
        _wide(cost.terminal[0], squares[-1:]),
        horizon,
    )[0]
    feedback = -gains
    feedback[:, :, 2 * n :] += kept_input
    return [
        _Law(
            by_state=law[:, :n],
            by_disturbance=law[:, n : 2 * n],
            by_last_input=law[:, 2 * n :],
        )
        for law in feedback
    ]


def _of_stages(weights: Array, horizon: int) -> Array:
    """Returns weights of all stages of a horizon, or of one that stands for all."""
    return weights if len(weights) == horizon else weights[:1]


def _wide(Q: Array, squares: Array) -> Array:
    """Returns the weight of (s, d, u_{-1}) of a stage.

    ``squares`` (1 or 0, ...) is that of its outputs, where there are some.
    """
    n = len(Q)
    m = squares.shape[-1] - 1 - len(Q)
    weight = np.zeros((2 * n + m, 2 * n + m))
    weight[:n, :n] = Q
    weighed = np.r_[:n, 2 * n : 2 * n + m]  # s and u_{-1}
    for square in squares:
        weight[np.ix_(weighed, weighed)] += square[:-1, :-1]
    return weight


def _linear_plant(
    prediction: PredictionModel,
    point: RestPoint,
    plant: DynamicsModel | None,
    ahead: DelayedModel | None,
) -> _Plant:
    """Returns the plant at a point.

    As many of its last inputs are states as the controller knows of:

        states of ``plant`` (p,)          | last inputs (count m,)
        own, further and queue, any order | the oldest first

    ``own`` are those that the controller's model has, too; ``further`` are the plant's
    alone; ``queue`` are inputs on their way to it. Of the controller's states (n,),
    ``observed`` are own states, and ``pending`` are inputs on their way.
    """
    model = prediction.model
    n, m = point.B.shape
    pending = pending_inputs(model)
    observed = [i for i in range(n) if i not in pending]
    if plant is None:
        plant = model if ahead is None else ahead
    count = len(pending) // m if ahead is None else ahead.pending
    p = plant.state_dim
    queue = pending_inputs(plant)
    own = [i for i in range(p) if i not in queue][: len(observed)]
    state = np.zeros(p)
    state[own] = point.state[observed]
    state[queue] = np.tile(point.input, len(queue) // m)
    further = [i for i in range(p) if i not in own and i not in queue]
    if further:
        state = _with_rest(plant, state, point.input, further)
    local = linearize(plant, state[None], point.input[None], covariance=False)
    size = p + count * m
    A = np.zeros((size, size))
    B = np.zeros((size, m))
    A[:p, :p] = local.A[0]
    B[:p] = local.B[0]
    if count:  # the last inputs move on
        A[p:-m, p + m :] = np.eye((count - 1) * m)
        B[-m:] = np.eye(m)
    last_inputs = np.eye(size)[p:]
    own_rows = np.eye(size)[own]
    if ahead is not None:
        own_rows, last_inputs = _look_ahead(ahead, point, own_rows, last_inputs)
    C = np.zeros((n, size))
    C[observed] = own_rows
    C[pending] = last_inputs[len(last_inputs) - len(pending) :]
    return _Plant(A=A, B=B, is_moved=np.arange(size) < p, C=C, state=state)


def _with_rest(
    plant: DynamicsModel, state: Array, input: Array, further: list[int]
) -> Array:
    """Returns a state (p,) whose further entries rest while the others are held.

    They begin at zero; those that no rest is found for stay where Newton's method left
    them.
    """
    state = state.copy()
    for _ in range(_REST_STEPS):
        local = linearize(plant, state[None], input[None], covariance=False)
        defect = (local.mean[0] - state)[further]
        slopes = np.eye(len(further)) - local.A[0][np.ix_(further, further)]
        step = np.linalg.lstsq(slopes, defect, rcond=None)[0]
        if not np.isfinite(step).all():
            break
        state[further] += step
        if np.abs(step).max() <= _ROUNDING * np.abs(state[further]).max():
            break
    return state


def _look_ahead(
    ahead: DelayedModel, point: RestPoint, state: Array, inputs: Array
) -> tuple[Array, Array]:
    """Returns the state that inputs on their way lead to, and those that are left.

    All rows are linear functions of the closed loop's own state: of the state (n, p),
    of the inputs on their way (D m, p).
    """
    n = ahead.model.state_dim
    m = ahead.input_dim
    local = linearize(
        ahead.model, point.state[None, :n], point.input[None], covariance=False
    )
    older_share = ahead.delay - (ahead.pending - 1)  # of a time step
    for k in range(ahead.lead):
        older = inputs[k * m : (k + 1) * m]
        newer = inputs[(k + 1) * m : (k + 2) * m]
        acting = older
        if older_share != 1:
            acting = older_share * older + (1 - older_share) * newer
        state = local.A[0] @ state + local.B[0] @ acting
    return state, inputs[ahead.lead * m :]
