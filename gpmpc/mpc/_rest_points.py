"""Points at which a loop is to rest, or to move as its reference does."""

import math
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from gpmpc._angles import state_difference
from gpmpc._dynamics import Linearized, linearize
from gpmpc.models import DelayedModel
from gpmpc.models._past import has_past
from gpmpc.models._wrapper import Wrapper
from gpmpc.mpc._controller import KEPT, Reference, read_parameters
from gpmpc.mpc._linear_quadratic import DEVIATIONS, INCREMENTS, Plan, QuadraticCost
from gpmpc.mpc._linearization import PredictionModel
from gpmpc.mpc._novelty import data_scales
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc._stage_meter import StageMeter

Array = np.ndarray

_POINTS = 10  # of a trajectory
_ITERATIONS = 20  # towards a point of rest
_HALVINGS = 10  # of a step that does not improve
_ROUNDING = 1e-6  # relative rise of a value that counts as none
_SETTLED = 1e-3  # last change of a point of rest, relative to its size
_AT_REST = 1e-2  # largest step of a state at rest, likewise: learned models drift
_NEGLIGIBLE = 1e-3  # weight of what no cost weighs, in the largest one
_LAST_DIGITS = 1e-9  # of a state, which arithmetic may lose
_PRICE = 1e3  # of a state that does not rest, in the largest weight


class RestPoint(NamedTuple):
    """A point where the loop is to rest, or to move as its reference does."""

    state: Array  # (n,)
    input: Array  # (m,)
    A: Array  # (n, n) of the model there
    B: Array  # (n, m)
    is_held: Array  # which inputs are at a bound there, or locked (m,)
    cost: QuadraticCost


def rest_points(
    prediction: PredictionModel, reference: Reference, parameters: Any
) -> list[RestPoint]:
    """Returns the points at which the law can be judged.

    They are those of a set point, or of some steps of a trajectory; without those where
    a function or the model has no numbers, those at which all inputs are at their
    bounds, and those that miss a constraint.
    """
    if parameters is not None:
        read_parameters(parameters, prediction.horizon)
    meter = StageMeter(prediction.problem, prediction.horizon)
    states = np.atleast_2d(np.asarray(reference.states, dtype=float))
    inputs = _reference_inputs(reference, (len(states), prediction.problem.input_dim))
    steps = np.zeros_like(states)  # of the reference; none at its end
    steps[:-1] = state_difference(states[1:], states[:-1], prediction.angles)
    final_row = len(states) - 1
    n = states.shape[1]
    chosen = np.unique(
        np.linspace(0, max(final_row - 1, 0), _POINTS).round().astype(int)
    )
    rows = np.hstack([states, steps, inputs])[chosen]
    points = []
    for row in np.unique(rows, axis=0):
        state, step, input = np.split(row, [n, 2 * n])
        search = _RestSearch(
            prediction,
            target=state,
            step=step,
            target_input=input,
            parameters=parameters,
        )
        with suppress(*FAILURES):
            point = search.find()
            if point is not None and _keeps_constraints(point, meter, parameters):
                points.append(point)
    return points


def _keeps_constraints(point: RestPoint, meter: StageMeter, parameters: Any) -> bool:
    """Tells whether a point keeps the constraints of all stages."""
    states = np.tile(point.state, (2, 1))
    return meter.largest_excess(states, point.input[None], parameters) <= KEPT


def _reference_inputs(reference: Reference, shape: tuple[int, int]) -> Array:
    """Returns the inputs of every step, the last one held; zero without any."""
    inputs = np.zeros(shape)
    if reference.inputs is not None:
        given_inputs = np.atleast_2d(np.asarray(reference.inputs, dtype=float))
        count = len(given_inputs)
        inputs[:count] = given_inputs
        inputs[count:] = given_inputs[-1]
    return inputs


def pending_inputs(model: Any) -> list[int]:
    """Returns the indices of a model's states that are inputs on their way.

    The oldest come first.
    """
    if not isinstance(model, Wrapper):
        return []
    within = pending_inputs(model.model)
    if not isinstance(model, DelayedModel):
        return within
    return within + list(range(model.model.state_dim, model.state_dim))


class _Unrest(NamedTuple):
    """What a state and an input cost, and by how far they are from rest."""

    A: Array  # (n, n) of the model there
    B: Array  # (n, m)
    defect: Array  # of the step that the state is to make (n,)
    cost: QuadraticCost
    hessian: Array  # half of it, by state and input (n + m, n + m)
    gradient: Array  # half of it (n + m,)
    value: float  # infinite where the model has none


class _RestSearch:
    """Finds the cheapest state that some input holds, or moves as the reference does.

    Args:
        prediction: Model, cost and bounds of the controller.
        target: State of the reference (n,).
        step: How far the state is to move in a step (n,).
        target_input: Input of the reference (m,).
        parameters: Of the outputs.
    """

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
        model = prediction.model
        if has_past(model) and len(target) < model.state_dim:
            input = prediction.initial_input
            later = model.at_rest(target + step, input)
            target = model.at_rest(target, input)
            step = later - target
        self._target = target
        self._step = step
        self._target_input = target_input
        # of states and inputs (n + m,), in which weights and prices are compared
        self._units = np.ones(len(target) + len(target_input))

    def find(self) -> RestPoint | None:
        """Returns the point, by Gauss-Newton steps from the target on.

        Inputs stay within their bounds. None where no step leads to rest, or where no
        input is free to move.
        """
        prediction = self._prediction
        n = len(self._target)
        lower, upper = prediction.problem.inputs.first
        input = prediction.initial_input.clip(lower, upper)
        state = self._target.copy()
        pending = pending_inputs(prediction.model)
        state[pending] = np.tile(input, len(pending) // len(input))
        start = np.concatenate([state, input])
        ranges = self._ranges(state, input)
        # An input that is locked, or a state that moves none, has no range.
        has_range = np.isfinite(ranges) & (ranges > 0.0)
        self._units = np.where(has_range, ranges, 1.0)
        # states and inputs near zero have a size all the same
        least_sizes = np.minimum(1.0, ranges)
        current = self._at(state, input)
        sizes = least_sizes
        for _ in range(_ITERATIONS):
            if not math.isfinite(current.value):
                return None
            change = _step_within(current, lower - input, upper - input)
            candidate = self._at(state + change[:n], input + change[n:])
            for _ in range(_HALVINGS):
                if candidate.value <= current.value * (1.0 + _ROUNDING):
                    break
                change = 0.5 * change
                candidate = self._at(state + change[:n], input + change[n:])
            state = state + change[:n]
            input = input + change[n:]
            current = candidate
            # Sizes are those of ways: where zero is says nothing of them.
            way = np.abs(np.concatenate([state, input]) - start)
            sizes = np.maximum(least_sizes, way)
            # A step that does not improve was halved until it is small: it ends here.
            if (np.abs(change) <= _SETTLED * sizes).all():
                break
        is_held = (input <= lower) | (input >= upper)
        largest_defects = _AT_REST * self._state_ranges(sizes[:n])
        largest_defects += _LAST_DIGITS * np.abs(state)
        rests = np.abs(current.defect) <= largest_defects
        if is_held.all() or not rests.all():
            return None
        return RestPoint(
            state, input, A=current.A, B=current.B, is_held=is_held, cost=current.cost
        )

    def _state_ranges(self, sizes: Array) -> Array:
        """Returns sizes of states (n,), no less than their ranges in the data."""
        scales = data_scales(self._prediction.model)
        if scales is None:
            return sizes
        has_range = np.isfinite(scales.ranges)
        return np.where(has_range, np.maximum(sizes, scales.ranges), sizes)

    def _ranges(self, state: Array, input: Array) -> Array:
        """Returns the ranges (n + m,) of states and inputs.

        Of a state it is that in the model's data; without any, as far as the inputs
        move it within a horizon, or it a state that they move, 1 at most. Of an input
        it is that between its bounds.
        """
        prediction = self._prediction
        lower, upper = prediction.problem.inputs.first
        input_ranges = upper - lower
        if np.isfinite(input_ranges).all():
            H = prediction.horizon
            start = self._linearize(state, input)
            A = start.A[0]
            reachable = _reachable_ranges(A, start.B[0], input_ranges, H)
            state_ranges = _ranges_by_effect(A, reachable, H)
        else:
            state_ranges = np.ones(len(state))
        scales = data_scales(prediction.model)
        if scales is not None:
            has_range = np.isfinite(scales.ranges)
            state_ranges = np.where(has_range, scales.ranges, state_ranges)
        return np.concatenate([state_ranges, input_ranges])

    def _linearize(self, state: Array, input: Array) -> Linearized:
        """Returns the model at a state (n,) and an input (m,)."""
        return linearize(
            self._prediction.model, state[None], input[None], covariance=False
        )

    def _at(self, state: Array, input: Array) -> _Unrest:
        """Returns cost and defect at a state (n,) and an input (m,)."""
        prediction = self._prediction
        n = len(state)
        m = len(input)
        model = self._linearize(state, input)
        A = model.A[0]
        B = model.B[0]
        move = state_difference(model.mean[:1], state[None], prediction.angles)[0]
        defect = move - self._step
        cost = _cost_at(prediction, state, input, self._parameters)
        error = np.concatenate([state - self._target, input])
        hessian = np.zeros((n + m, n + m))
        hessian[:n, :n] = cost.state[0, 0]
        if cost.penalized == DEVIATIONS:
            error[n:] -= self._target_input
        if cost.penalized != INCREMENTS:
            hessian[n:, n:] = cost.input[0]
        gradient = hessian @ error
        value = error @ gradient
        if len(cost.squares):
            z = np.concatenate([state, input, [1.0]])
            hessian = hessian + cost.squares[0, :-1, :-1]
            gradient = gradient + (cost.squares[0] @ z)[:-1]
            value = value + z @ cost.squares[0] @ z
        # Weights and prices are compared in the units of ``_units``, not in the user's.
        units = self._units
        largest = np.abs(hessian * np.outer(units, units)).max() or 1.0
        rows = np.hstack([A - np.eye(n), B])
        prices = _PRICE * largest / units[:n] ** 2
        damped_units = units.copy()
        damped_units[n:] = units[n:].max()  # inputs share what several can hold
        hessian = hessian + np.diag(_NEGLIGIBLE * largest / damped_units**2)
        hessian = hessian + (rows.T * prices) @ rows
        gradient = gradient + rows.T @ (prices * defect)
        value = float(value + prices @ defect**2)
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
            value = math.inf
        return _Unrest(
            A=A,
            B=B,
            defect=defect,
            cost=cost,
            hessian=hessian,
            gradient=gradient,
            value=value,
        )


def _step_within(current: _Unrest, lowest: Array, highest: Array) -> Array:
    """Returns the step (n + m,) to the least value, of inputs between two bounds (m,).

    Inputs that a step takes beyond a bound are held there, for the rest of this step.
    """
    unbounded = np.full(len(current.A), np.inf)
    least = np.concatenate([-unbounded, lowest])
    most = np.concatenate([unbounded, highest])
    step = np.zeros(len(least))
    is_free = np.ones(len(least), dtype=bool)
    for _ in range(len(lowest) + 1):
        gradient = current.gradient + current.hessian @ np.where(is_free, 0.0, step)
        hessian = current.hessian[np.ix_(is_free, is_free)]
        step[is_free] = -np.linalg.solve(hessian, gradient[is_free])
        is_beyond = (step < least) | (step > most)
        if not is_beyond.any():
            break
        step = step.clip(least, most)
        is_free &= ~is_beyond
    return step


def _reachable_ranges(A: Array, B: Array, input_ranges: Array, horizon: int) -> Array:
    """Returns how far inputs within their ranges (m,) move states (n,), 1 at most."""
    effect = B
    reachable = np.abs(effect) @ input_ranges
    for _ in range(horizon - 1):
        if (reachable >= 1.0).all():
            break
        effect = A @ effect
        reachable = np.minimum(1.0, reachable + np.abs(effect) @ input_ranges)
    return reachable


def _ranges_by_effect(A: Array, reachable: Array, horizon: int) -> Array:
    """Returns the ranges of states (n,), also of those that no input reaches.

    Such a one is as large as it takes to move one that an input reaches by its range
    within a horizon, 1 at most; 0 where it moves none.
    """
    is_reached = reachable > 0.0
    if is_reached.all():
        return reachable
    power = A
    effects = np.abs(A)  # largest ones so far
    for _ in range(horizon - 1):
        power = A @ power
        effects = np.maximum(effects, np.abs(power))
    with np.errstate(divide="ignore"):
        sizes = reachable[is_reached, None] / effects[is_reached]
    least = sizes.min(axis=0, initial=np.inf)
    own_ranges = np.where(np.isfinite(least), np.minimum(1.0, least), 0.0)
    return np.where(is_reached, reachable, own_ranges)


def _cost_at(
    prediction: PredictionModel, state: Array, input: Array, parameters: Any
) -> QuadraticCost:
    """Returns the cost of the means, its outputs linearised at one point."""
    H = prediction.horizon
    values = None if parameters is None else read_parameters(parameters, H)
    plan = Plan(
        states=np.tile(state, (H + 1, 1)),
        inputs=np.tile(input, (H, 1)),
        covariances=np.zeros((H + 1, len(state), len(state))),
    )
    cost = prediction.costs.at(plan, values)
    return cost._replace(state=cost.state[:, :1], terminal=cost.terminal[:1])
