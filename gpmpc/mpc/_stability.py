"""Whether a loop is stable where it is to rest, known before it runs.

Near a set point no bound is active, and the first input of the quadratic program is an affine function of what the
program is told: u_k = F_x s_k + F_u u_{k-1} + F_d d_k + const, the gain of the finite-horizon regulator of the stages
there. Closed with the plant's own linearisation it is a linear system in (x_k, s_{k-1}, u_{k-1}, d_{k-1}),

    s_k = C x_k,    d_k = (1 - L) d_{k-1} + L (s_k - A s_{k-1} - B u_{k-1}),    x_{k+1} = A_p x_k + B_p u_k

whose spectral radius says whether the loop settles. x is the plant's state, with the inputs on their way where they act
late; s what the controller is told of it; d the estimate of the disturbance, of gain L. The form ``velocity`` is L = 1:
its constant is what the last step missed. Derivatives of the stages by their points are of second order where the loop
rests, so that the law is that of every iteration and covariance mode, but for what covariances weigh.

A short horizon may take a plant's inverse response for the whole of it: every program is solved, and the loop runs away
(on receding finite horizons: Bitmead, Gevers and Wertz, 1990). One backward Riccati recursion gives the first gains of
all horizons.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eig, matrix_balance

from gpmpc._angles import state_difference
from gpmpc._dynamics import DynamicsModel, linearize, to_array
from gpmpc.exceptions import SettingError
from gpmpc.models import DelayedModel
from gpmpc.models._wrapper import Wrapper
from gpmpc.mpc._controller import Reference, read_parameters, read_reference
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._linear_quadratic import DEVIATIONS, INCREMENTS, Plan, QuadraticCost
from gpmpc.mpc._linearization import PredictionModel
from gpmpc.mpc._riccati import finite_horizon_lqr
from gpmpc.mpc._slopes import slope_covariances

Array = np.ndarray

_DEVIATIONS = 2.0  # of a growing mode from 1, by what a model's slopes are known to
_POINTS = 10  # of a trajectory
_LONGEST = 20  # horizons that are tried, in that of the controller
_ROUNDING = 1e-6  # by how much a growing mode of a known model exceeds 1
_LEARNED = 1e-3  # of a learned one: its integrators are not exact ones
_ITERATIONS = 20  # towards a point of rest
_HALVINGS = 10  # of a step that does not improve
_SETTLED = 1e-3  # last change of a point of rest, relative to its size or 1
_AT_REST = 1e-2  # largest step of a state at rest, likewise: learned models drift
_NEGLIGIBLE = 1e-3  # weight of what no cost weighs, in the largest one
_PRICE = 1e3  # of a state that does not rest, in the largest weight
_LOWEST_GAIN = 0.5  # of the plant's inputs, in the model's
_HIGHEST_GAIN = 1.5
_GAINS = 21  # gains that are tried from the lowest to the highest
_GAIN_TOLERANCE = 1e-3
_SPARE = 0.8  # share of the largest gain of an estimate that is advised
_PLANT_GAINS = (0.7, 1.0, 1.3)  # that an estimate of the disturbance is to bear


@dataclass(frozen=True)
class Stability:
    """What the loop does near the points where it is to rest."""

    horizon: int  #: H, of the controller
    #: the largest size of an eigenvalue of the closed loop: above 1 it does not settle; NaN where no point could be
    #: judged: the model rests nowhere near the reference within the bounds of the inputs
    spectral_radius: float
    #: whether no mode grows: integrators that nothing weighs may stand still. Of a learned model growth counts above
    #: 0.1 % a step, since its integrators are not exact ones, and above two standard deviations of what its GPs know
    stable: bool
    #: the shortest horizon from which on no mode grows; None where none of those tried is
    shortest_horizon: int | None
    horizons: int  #: how many were tried, from 1 on; 0 where weights differ by stage
    #: range of factors of the plant's inputs around 1, tried from 0.5 to 1.5, in which no mode grows; NaN without any
    gain_range: tuple[float, float]
    disturbance_gain: float  #: L, of the controller's estimate
    #: the controller's L where no mode grows while the plant's inputs do 0.7 to 1.3 of what the model says; where one
    #: does, four fifths of the largest L with which none does; NaN where one does without an estimate, too
    safe_disturbance_gain: float
    states: Array  #: the points that were judged (K, n)
    inputs: Array  #: the inputs that hold them (K, m)

    @property
    def judged(self) -> bool:
        """Whether there was a point to judge."""
        return len(self.states) > 0

    @property
    def warnings(self) -> list[str]:
        """What to change, a line each; none where nothing is."""
        if self.safe_disturbance_gain < self.disturbance_gain:
            what = f"disturbance_gain {self.disturbance_gain:g} is too large"
            why = "the loop swings up where inputs do 0.7 or 1.3 of what the model says"
            return [f"{what}: {why}; {self.safe_disturbance_gain:.2g} is safe"]
        if self.stable:
            return []
        growth = 100.0 * (self.spectral_radius - 1.0)
        what = f"horizon {self.horizon}: the loop runs away from its reference"
        if self.shortest_horizon is not None:
            cure = f"it settles with {self.shortest_horizon} steps or more"
        elif self.horizons:
            cure = f"so it does with any up to {self.horizons}: change the weights"
        else:
            cure = "try a longer one"
        return [f"{what}, by {growth:.2g} % a step; {cure}"]


class _Point(NamedTuple):
    """Where the loop is to rest, or to move as its reference does, and the model there."""

    state: Array  # (n,)
    input: Array  # (m,)
    A: Array  # (n, n)
    B: Array  # (n, m)
    cost: QuadraticCost


class _Plant(NamedTuple):
    """The plant's linearisation with the last inputs as states, and what the controller is told of them."""

    A: Array  # (p, p)
    B: Array  # (p, m)
    moved: Array  # whether a state (p,) is moved by what the inputs do, not by what they are
    C: Array  # (n, p)
    state: Array  # where, without the last inputs


def stability(
    prediction: PredictionModel,
    reference: Any,
    plant: DynamicsModel | None = None,
    ahead: DelayedModel | None = None,
    parameters: Any = None,
) -> Stability:
    """Returns what a loop does near its reference; see ``GPMPC.stability``."""
    followed = read_reference(reference).in_order(prediction.signals)
    _check(prediction, plant, ahead)
    horizon = prediction.horizon
    problem = prediction.problem
    points = _points(prediction, followed, parameters)
    if not points:
        return Stability(
            horizon=horizon,
            spectral_radius=math.nan,
            stable=True,
            shortest_horizon=None,
            horizons=0,
            gain_range=(math.nan, math.nan),
            disturbance_gain=prediction.settings.disturbance_gain,
            safe_disturbance_gain=math.nan,
            states=np.empty((0, problem.state_dim)),
            inputs=np.empty((0, problem.input_dim)),
        )
    loops = [_Loop(prediction, point, plant, ahead) for point in points]
    shortest, tried = _shortest_horizon(loops, horizon)
    gain_ranges = np.array([loop.gain_range() for loop in loops])
    return Stability(
        horizon=horizon,
        spectral_radius=max(loop.radius(horizon) for loop in loops),
        stable=not any(loop.grows(horizon) for loop in loops),
        shortest_horizon=shortest,
        horizons=tried,
        gain_range=(float(gain_ranges[:, 0].max()), float(gain_ranges[:, 1].min())),
        disturbance_gain=prediction.settings.disturbance_gain,
        safe_disturbance_gain=_safe_disturbance_gain(
            loops, prediction.settings.disturbance_gain
        ),
        states=np.array([point.state for point in points]),
        inputs=np.array([point.input for point in points]),
    )


def _safe_disturbance_gain(loops: "list[_Loop]", disturbance_gain: float) -> float:
    """A gain of the estimate with which no loop grows at any of the plant's gains; see ``Stability``."""

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
    own = model.state_dim - len(_pending(model))
    states = plant.state_dim - len(_pending(plant))
    if states < own or plant.input_dim != model.input_dim:
        rule = f"must have {own} states and {model.input_dim} inputs"
        raise SettingError("plant", f"{rule}; got {states} and {plant.input_dim}")


def _pending(model: Any) -> list[int]:
    """Indices of a model's states that are inputs on their way, the oldest first."""
    if not isinstance(model, Wrapper):
        return []
    within = _pending(model.model)
    if not isinstance(model, DelayedModel):
        return within
    return within + list(range(model.model.state_dim, model.state_dim))


def _points(
    prediction: PredictionModel, reference: Reference, parameters: Any
) -> list[_Point]:
    """The points of a set point, or of some steps of a trajectory, at which the law can be judged."""
    states = np.atleast_2d(np.asarray(reference.states, dtype=float))
    inputs = np.zeros((len(states), prediction.problem.input_dim))
    if reference.inputs is not None:
        given = np.atleast_2d(np.asarray(reference.inputs, dtype=float))
        inputs[: len(given)] = given
        inputs[len(given) :] = given[-1]
    steps = state_difference(states[1:], states[:-1], prediction.angles)
    steps = np.vstack([steps, np.zeros_like(states[:1])]) if len(steps) else 0 * states
    last = len(states) - 1
    n = states.shape[1]
    chosen = np.unique(np.linspace(0, max(last - 1, 0), _POINTS).round().astype(int))
    rows = np.hstack([states, steps, inputs])[chosen]
    points = []
    for row in np.unique(rows, axis=0):
        state, step, input = np.split(row, [n, 2 * n])
        search = _RestSearch(prediction, state, step, input, parameters)
        with suppress(FunctionNotFinite):
            point = search.find()
            points += [] if point is None else [point]
    return points


class _Unrest(NamedTuple):
    """What a state and an input cost, and by how far the model moves them otherwise than it should."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    missing: Array  # of the step that the state is to make (n,)
    cost: QuadraticCost
    weight: Array  # half the Hessian by state and input (n + m, n + m)
    slope: Array  # half the gradient (n + m,)
    value: float  # infinite where the model has none


class _RestSearch:
    """Finds the cheapest state that some input holds, or moves as the reference does."""

    def __init__(
        self,
        prediction: PredictionModel,
        target: Array,
        step: Array,
        target_input: Array,
        parameters: Any,
    ):
        self._prediction = prediction
        self._parameters = parameters
        self._target = target
        self._step = step
        self._target_input = target_input

    def find(self) -> _Point | None:
        """The point by Gauss-Newton steps from the target on; None where they find none within the input's bounds."""
        prediction = self._prediction
        n = len(self._target)
        input = prediction.initial_input.copy()
        state = self._target.copy()
        pending = _pending(prediction.model)
        state[pending] = np.tile(input, len(pending) // len(input))
        here = self._at(state, input)
        for _ in range(_ITERATIONS):
            if not math.isfinite(here.value):
                return None
            change = -np.linalg.solve(here.weight, here.slope)
            there = self._at(state + change[:n], input + change[n:])
            for _ in range(_HALVINGS):
                if there.value <= here.value * (1.0 + _ROUNDING):
                    break
                change = 0.5 * change
                there = self._at(state + change[:n], input + change[n:])
            state = state + change[:n]
            input = input + change[n:]
            here = there
            sizes = np.maximum(1.0, np.abs(np.concatenate([state, input])))
            if (np.abs(change) <= _SETTLED * sizes).all():
                break
        lower, upper = prediction.problem.inputs.first
        within = (lower < input) & (input < upper)
        rests = np.abs(here.missing) <= _AT_REST * np.maximum(1.0, np.abs(state))
        if not (within.all() and rests.all()):
            return None
        return _Point(state, input, here.A, here.B, here.cost)

    def _at(self, state: Array, input: Array) -> _Unrest:
        prediction = self._prediction
        n = len(state)
        m = len(input)
        model = linearize(prediction.model, state[None], input[None], covariance=False)
        A = model.A[0]
        B = model.B[0]
        moved = state_difference(model.mean[:1], state[None], prediction.angles)[0]
        missing = moved - self._step
        cost = _cost_at(prediction, state, input, self._parameters)
        off = np.concatenate([state - self._target, input])
        weight = np.zeros((n + m, n + m))
        weight[:n, :n] = cost.state[0, 0]
        if cost.penalized == DEVIATIONS:
            off[n:] -= self._target_input
        if cost.penalized != INCREMENTS:
            weight[n:, n:] = cost.input[0]
        slope = weight @ off
        value = off @ slope
        if len(cost.squares):
            z = np.concatenate([state, input, [1.0]])
            weight = weight + cost.squares[0, :-1, :-1]
            slope = slope + (cost.squares[0] @ z)[:-1]
            value = value + z @ cost.squares[0] @ z
        largest = np.abs(weight).max() or 1.0
        rows = np.hstack([A - np.eye(n), B])
        price = _PRICE * largest
        weight = weight + _NEGLIGIBLE * largest * np.eye(n + m)
        weight = weight + price * rows.T @ rows
        slope = slope + price * rows.T @ missing
        value = float(value + price * missing @ missing)
        if not (np.isfinite(weight).all() and np.isfinite(slope).all()):
            value = math.inf
        return _Unrest(A, B, missing, cost, weight, slope, value)


def _cost_at(
    prediction: PredictionModel, state: Array, input: Array, parameters: Any
) -> QuadraticCost:
    """The cost of the means with outputs linearised at one point, at every stage."""
    H = prediction.horizon
    values = None if parameters is None else read_parameters(parameters, H)
    plan = Plan(
        states=np.tile(state, (H + 1, 1)),
        inputs=np.tile(input, (H, 1)),
        covariances=np.zeros((H + 1, len(state), len(state))),
    )
    cost = prediction.costs.at(plan, values)
    return cost._replace(state=cost.state[:, :1], terminal=cost.terminal[:1])


class _Loop:
    """The closed loop of a controller and a plant, linearised at a point."""

    def __init__(
        self,
        prediction: PredictionModel,
        point: _Point,
        plant: DynamicsModel | None,
        ahead: DelayedModel | None,
    ):
        self._point = point
        self.horizon = prediction.horizon
        velocity = prediction.settings.form == "velocity"
        self._disturbance_gain = (
            1.0 if velocity else prediction.settings.disturbance_gain
        )
        self._model: Any = plant or ahead or prediction.model
        learned = bool(to_array(self._model.noise_covariance).any())
        self._tolerance = _LEARNED if learned else _ROUNDING
        self._plant = _linear_plant(prediction, point, plant, ahead)
        self._laws = _laws(point.A, point.B, point.cost, prediction.horizon)

    @property
    def constant(self) -> bool:
        """Whether the cost weighs all stages alike, so that another horizon has a meaning."""
        cost = self._point.cost
        parts = (cost.state[:-1], cost.input, cost.squares)
        return all(len(part) == 0 or not np.ptp(part, axis=0).any() for part in parts)

    def look_ahead(self, horizon: int) -> None:
        """Computes the laws of all horizons up to one."""
        point = self._point
        self._laws = _laws(point.A, point.B, point.cost, horizon)

    def radius(
        self, horizon: int, gain: float = 1.0, disturbance_gain: float | None = None
    ) -> float:
        """The spectral radius; see ``matrix``."""
        loop = self.matrix(horizon, gain, disturbance_gain)
        if not np.isfinite(loop).all():  # the recursion of a mode that nothing reaches
            return math.inf
        return float(np.abs(np.linalg.eigvals(loop)).max())

    def grows(
        self, horizon: int, gain: float = 1.0, disturbance_gain: float | None = None
    ) -> bool:
        """Whether the closed loop has a mode that grows by more than its model's doubt; see ``matrix``."""
        loop = self.matrix(horizon, gain, disturbance_gain)
        limit = 1.0 + self._tolerance
        if not np.isfinite(loop).all():
            return True
        if np.abs(np.linalg.eigvals(loop)).max() <= limit:
            return False
        _, (scales, _) = matrix_balance(loop, permute=False, separate=True)
        values, left, right = eig(loop, left=True)
        left = left * scales[:, None]
        right = right / scales[:, None]
        left = left / np.linalg.norm(left, axis=0)
        right = right / np.linalg.norm(right, axis=0)
        return any(
            abs(values[i])
            > limit
            + _DEVIATIONS * self._doubt(values[i], left[:, i], right[:, i], scales)
            for i in np.flatnonzero(np.abs(values) > limit)
        )

    def _doubt(self, value: complex, left: Array, right: Array, scales: Array) -> float:
        """The standard deviation of what the plant's model adds to a mode, by that of its slopes along it.

        Vectors are of length 1 in states of balanced scales. That a mode may be ill-conditioned beside another one is
        left out: this tells the modes that the model has no data of.
        """
        p, m = self._plant.B.shape
        n = self._model.state_dim
        state = (right * scales)[:n]
        input = value * (right * scales)[p : p + m]
        direction = np.concatenate([state, input])
        variances = np.einsum(
            "a,iab,b->i", direction.conj(), self._slope_covariances, direction
        ).real
        spread = np.abs(left[:n] / scales[:n]) ** 2 @ np.maximum(variances, 0.0)
        return math.sqrt(float(spread))

    @cached_property
    def _slope_covariances(self) -> Array:
        return slope_covariances(self._model, self._plant.state, self._point.input)

    def gain_range(self) -> tuple[float, float]:
        """Smallest and largest factor of the plant's inputs, around 1, without a mode that grows; NaN without any."""
        if self.grows(self.horizon):
            return math.nan, math.nan
        return self._last_stable_gain(_LOWEST_GAIN), self._last_stable_gain(
            _HIGHEST_GAIN
        )

    def _last_stable_gain(self, end: float) -> float:
        """The last stable factor on the way from 1 to an end."""
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
        """The closed loop of (x_k, u_{k-1}, s_{k-1}, d_{k-1}), the last two where disturbances are estimated.

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
        B_p = np.where(self._plant.moved, gain, 1.0)[:, None] * self._plant.B
        n, m = B.shape
        p = len(A_p)
        law = self._laws[-horizon]
        error = np.hstack([L * C, -L * B, -L * A, (1.0 - L) * np.eye(n)])
        input = np.hstack([law.by_state @ C, law.by_last_input, np.zeros((m, 2 * n))])
        input = input + law.by_disturbance @ error
        state = np.hstack([A_p, np.zeros((p, m + 2 * n))]) + B_p @ input
        told = np.hstack([C, np.zeros((n, m + 2 * n))])
        loop = np.vstack([state, input, told, error])
        return loop if L > 0 else loop[: p + m, : p + m]


class _Law(NamedTuple):
    """Derivatives of the first inputs u_0 of a horizon (m, ...)."""

    by_state: Array
    by_disturbance: Array
    by_last_input: Array


def _laws(A: Array, B: Array, cost: QuadraticCost, horizon: int) -> list[_Law]:
    """The laws of the horizons from ``horizon`` down to 1, those of the regulator of (s, d, u_{-1}).

    The disturbance is added to the state at every stage, and nothing weighs it.
    """
    n, m = B.shape
    none = np.zeros((n, n))
    incremental = cost.penalized == INCREMENTS
    held = np.eye(m) if incremental else np.zeros((m, m))
    transition = np.block(
        [
            [A, np.eye(n), B @ held],
            [none, np.eye(n), np.zeros((n, m))],
            [np.zeros((m, 2 * n)), held],
        ]
    )
    effect = np.vstack([B, np.zeros((n, m)), np.eye(m)])
    squares = _of_stages(cost.squares, horizon)
    weights = _of_stages(cost.state[:, 0], horizon)
    weights = np.stack([_wide(Q, squares[i : i + 1]) for i, Q in enumerate(weights)])
    if len(weights) > 1:  # from those of s_1 .. s_{H-1} to those of s_0 .. s_{H-1}
        weights = np.concatenate([weights[:1], weights[:-1]])
    gains = finite_horizon_lqr.unchecked(
        transition[None],
        effect[None],
        weights,
        _of_stages(cost.input, horizon),
        _wide(cost.terminal[0], squares[-1:]),
        horizon,
    )[0]
    feedback = -gains
    feedback[:, :, 2 * n :] += held
    return [_Law(*np.split(law, [n, 2 * n], axis=1)) for law in feedback]


def _of_stages(weights: Array, horizon: int) -> Array:
    """Weights of all stages of a horizon, or of one that stands for all."""
    return weights if len(weights) == horizon else weights[:1]


def _wide(Q: Array, squares: Array) -> Array:
    """The weight of (s, d, u_{-1}) of a stage, with that of its outputs where there is one (1 or 0, ...)."""
    n = len(Q)
    m = squares.shape[-1] - 1 - len(Q)
    weight = np.zeros((2 * n + m, 2 * n + m))
    weight[:n, :n] = Q
    known = np.r_[:n, 2 * n : 2 * n + m]
    for square in squares:
        weight[np.ix_(known, known)] += square[:-1, :-1]
    return weight


def _linear_plant(
    prediction: PredictionModel,
    point: _Point,
    plant: DynamicsModel | None,
    ahead: DelayedModel | None,
) -> _Plant:
    """The plant at a point, with as many of its last inputs as states as the controller knows of."""
    model = prediction.model
    n, m = point.B.shape
    pending = _pending(model)
    others = [i for i in range(n) if i not in pending]
    if plant is None:
        plant = model if ahead is None else ahead
    count = len(pending) // m if ahead is None else ahead.pending
    p = plant.state_dim
    at = np.zeros(p)
    queue = _pending(plant)
    own = [i for i in range(p) if i not in queue]
    at[own[: len(others)]] = point.state[others]
    at[queue] = np.tile(point.input, len(queue) // m)
    local = linearize(plant, at[None], point.input[None], covariance=False)
    A = np.zeros((p + count * m, p + count * m))
    B = np.zeros((p + count * m, m))
    A[:p, :p] = local.A[0]
    B[:p] = local.B[0]
    if count:
        A[p:-m, p + m :] = np.eye((count - 1) * m)
        B[-m:] = np.eye(m)
    moved = np.arange(len(A)) < p
    last_inputs = np.eye(len(A))[p:]
    shown = np.eye(len(A))[own[: len(others)]]
    if ahead is not None:
        shown, last_inputs = _look_ahead(ahead, point, shown, last_inputs)
    C = np.zeros((n, len(A)))
    C[others] = shown
    C[pending] = last_inputs[len(last_inputs) - len(pending) :]
    return _Plant(A, B, moved, C, at)


def _look_ahead(
    ahead: DelayedModel, point: _Point, state: Array, inputs: Array
) -> tuple[Array, Array]:
    """Where the inputs on their way (D m, p) lead a state (n, p) to, and those of them that are left.

    Rows are linear functions of the closed loop's own state.
    """
    n = ahead.model.state_dim
    m = ahead.input_dim
    local = linearize(
        ahead.model, point.state[None, :n], point.input[None], covariance=False
    )
    share = ahead.delay - (ahead.pending - 1)
    for k in range(ahead.lead):
        older = inputs[k * m : (k + 1) * m]
        newer = inputs[(k + 1) * m : (k + 2) * m]
        acting = older if share == 1 else share * older + (1 - share) * newer
        state = local.A[0] @ state + local.B[0] @ acting
    return state, inputs[ahead.lead * m :]


def _shortest_horizon(loops: Sequence[_Loop], horizon: int) -> tuple[int | None, int]:
    """The shortest horizon from which on no loop grows, None without one, and how many were tried."""
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
