"""Flies a controller on in its own model, and says what each stage of a flight costs.

A program sees H stages, and a swing-up may take many more: the plan of least cost over
H stages may lean for ever where its inputs can hold it. What a plan is worth shows when
it is flown on: by the controller itself, decision by decision, in its own model, until
the goal is held.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch

from gpmpc._angles import full_turns, state_difference
from gpmpc._dynamics import linearize
from gpmpc._kernels.gp_rollout import Feedback
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.models import RollOut
from gpmpc.mpc._controller import FEASIBLE, Decision, Reference, Timing
from gpmpc.mpc._linear_quadratic import finite_horizon_lqr
from gpmpc.mpc._stages import ConstraintRows, Plan
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.mpc.problem import Problem
from gpmpc.status import Status

Array = np.ndarray

_HORIZONS = 4  # of the controller that a flight takes at most,
_STAGES = 200  # or this many stages, where they are more
_HELD = 6  # the goal counts as held after a sixth of a horizon near it,
_FEWEST = 3  # but not after fewer stages
_NEAR_GOAL = 0.01  # share of the dearest stage's cost that a stage near the goal has
_STANDSTILL = 0.01  # share by which costs differ where the plant stands still
_ROUNDS = 5  # in which a flight is improved, the turns of its goal read anew
_PROGRAMS = 10  # of a round
_TOLERANCE = 1e-2  # of these programs
_GAIN = 1e-3  # share of its cost that a round gains at least, if another follows
_SHORTEST = 5  # stages of a controller that looks less far ahead
_SWINGS = 4  # of a relay, after each of which the controller may take over
_NEARER = 0.95  # share of the cost before that a swing has to come down to
_RELAY = 1e6  # gain of a relay, in ranges of the input per unit of a state


@dataclass(frozen=True)
class Flight:
    """A trajectory of the model, of as many stages as it takes, and its costs."""

    states: Array  #: x_0 .. x_L (L + 1, n)
    inputs: Array  #: (L, m)
    costs: Array  #: of x_{k+1} and u_k (L,)
    arrives: bool  #: whether it ends where the goal is held
    gains: Array | None = None  #: K of the feedback u_k - K_k (x - x_k) (L, m, n)
    plan: Decision | None = None  #: the controller's last, a stage before the end

    def __len__(self) -> int:
        return len(self.inputs)

    @property
    def cost(self) -> float:
        """Of all stages."""
        return float(self.costs.sum())

    def is_better_than(self, other: "Flight") -> bool:
        """Whether it alone arrives, or costs less.

        Where none arrives, both are held at their ends for as long as the longer takes.
        """
        if self.arrives != other.arrives:
            return self.arrives
        if self.arrives:
            return self.cost < other.cost
        length = max(len(self), len(other))
        return self._cost_over(length) < other._cost_over(length)

    def _cost_over(self, length: int) -> float:
        return self.cost + float(self.costs[-1]) * (length - len(self))

    def after(self, stages: int) -> "Flight":
        """What is left of it after some stages."""
        gains = None if self.gains is None else self.gains[stages:]
        return Flight(
            self.states[stages:],
            self.inputs[stages:],
            self.costs[stages:],
            self.arrives,
            gains,
        )


class Question(NamedTuple):
    """What a controller is asked at a state, beside its last plan."""

    covariance: torch.Tensor  # of the belief (n, n)
    reference: Reference  # over the horizon
    parameters: Any
    previous_input: Array  # the input before (m,)
    disturbance: Array | None = None  # of the model (n,)

    def over(self, horizon: int) -> "Question":
        """The question to a controller of another horizon: what ends sooner is held."""
        if self.reference.horizon == horizon:
            return self
        reference = self.reference
        inputs = reference.inputs
        if inputs is not None:
            inputs = held(np.asarray(inputs), horizon)
        states = held(np.asarray(reference.states), horizon + 1)
        parameters = self.parameters
        if parameters is not None:
            parameters = rows_over(parameters, horizon)
        return self._replace(reference=Reference(states, inputs), parameters=parameters)

    def after(self, stages: int) -> "Question":
        """The question some stages later: parameters by stage move on, the last one held."""
        if self.parameters is None or np.ndim(self.parameters) < 2:
            return self
        count = len(self.parameters)
        return self._replace(
            parameters=rows_over(self.parameters, stages + count)[stages:]
        )

    def belief(self, state: Array) -> Gaussian:
        """The belief with a mean (n,)."""
        return Gaussian(torch.as_tensor(np.ascontiguousarray(state)), self.covariance)


class Trajectory(NamedTuple):
    """The beginning of a flight, from whose end on a controller steers."""

    controller: GPMPC
    states: Array  # (K + 1, n)
    inputs: Array  # (K, m)
    previous: Decision | None = None  # the controller's last plan


class StageMeter:
    """Costs of stages as they are paid, outputs and violated constraints included.

    Weights are those of the first stage, wherever a stage stands; angles count within
    half a turn. Constraints of a part of the horizon only do not count.
    """

    def __init__(self, problem: Problem, horizon: int):
        self._problem = problem
        self._horizon = horizon
        self._Q = first_weight(problem.cost.Q)
        self._R = first_weight(problem.cost.R)
        self._rows = ConstraintRows(problem, horizon, "none")
        self._always = self._rows.applies.all(axis=0)

    def __call__(self, states: Array, inputs: Array, question: Question) -> Array:
        """Costs (L,) of states (L + 1, n) and inputs (L, m), infinite beyond a hard bound.

        The reference is that of the question; beyond its end it stands still.
        """
        cost = self._problem.cost
        reference = question.reference
        targets = held(np.asarray(reference.states)[1:], len(inputs))
        error = state_difference(states[1:], targets, cost.angles)
        penalized = inputs
        if cost.penalized == "deviations":
            penalized = inputs - held(np.asarray(reference.inputs), len(inputs))
        elif cost.penalized == "increments":
            before = question.previous_input[None]
            penalized = np.diff(inputs, axis=0, prepend=before)
        costs = np.einsum("ki,ij,kj->k", error, self._Q, error)
        costs += np.einsum("ki,ij,kj->k", penalized, self._R, penalized)
        costs += self.functions(states, inputs, question.parameters)
        return costs

    def functions(self, states: Array, inputs: Array, parameters: Any) -> Array:
        """What outputs and violated constraints of stages cost (L,); see ``__call__``."""
        costs = np.zeros(len(inputs))
        if not (self._problem.outputs or self._rows.per_stage):
            return costs
        H = self._horizon
        for first in range(0, len(inputs), H):
            part = slice(first, first + H)
            after = held(states[1:][part], H)
            steered = held(inputs[part], H)
            own = None
            if parameters is not None:
                own = rows_over(parameters, first + H)[first:]
            parts = self._outputs(after, steered, own)
            parts += self._violations(after, steered, own)
            costs[part] = parts[: len(inputs[part])]
        return costs

    def _outputs(self, states: Array, inputs: Array, parameters: Any) -> Array:
        points = np.hstack([states, inputs, np.ones((self._horizon, 1))])
        costs = np.zeros(self._horizon)
        for output in self._problem.outputs:
            squares = output.squares(states, inputs, parameters)
            costs += np.einsum("ki,kij,kj->k", points, squares, points)
        return costs

    def _violations(self, states: Array, inputs: Array, parameters: Any) -> Array:
        if not self._rows.per_stage:
            return np.zeros(self._horizon)
        n = states.shape[1]
        certain = np.zeros((self._horizon + 1, n, n))
        plan = Plan(np.vstack([states[:1], states]), inputs, certain)
        rows = self._rows.at(plan, certain, 1, parameters)
        E = np.broadcast_to(rows.E, (self._horizon, *rows.E.shape[1:]))
        values = np.einsum("kri,ki->kr", E, states)
        if len(rows.D):
            values += np.einsum("kri,ki->kr", rows.D, inputs)
        outside = np.maximum(values - rows.upper, rows.lower - values).clip(0.0)
        outside = outside[:, self._always]
        prices = self._rows.prices[self._always]
        hard = np.isinf(prices)
        costs = outside[:, ~hard] @ prices[~hard]
        costs[(outside[:, hard] > FEASIBLE).any(axis=1)] = np.inf
        return costs


class Foresight:
    """Makes flights of a controller, and of itself with shorter horizons."""

    def __init__(self, controller: GPMPC):
        self.controller = controller
        self.meter = StageMeter(controller.problem, controller.horizon)
        self.longest = max(_HORIZONS * controller.horizon, _STAGES)
        self._model = controller.prediction.model
        self._roll_out = RollOut(self._model)
        self._hold = max(_FEWEST, controller.horizon // _HELD)
        horizons = (controller.horizon // 2, controller.horizon // 4)
        shorter = [
            self._with_horizon(horizon, controller.iterations, controller.tolerance)
            for horizon in horizons
            if horizon >= _SHORTEST
        ]
        self.shorter = [other for other in shorter if other is not None]

    def _with_horizon(
        self, horizon: int, iterations: int | None, tolerance: float
    ) -> GPMPC | None:
        """The controller with another horizon; None where its problem is of this one."""
        own = self.controller
        constraints = own.problem.constraints
        if any(constraint.stages is not None for constraint in constraints):
            return None
        try:
            return GPMPC(
                self._model,
                own.prediction.propagator,
                own.problem,
                horizon,
                own.initial_input.tolist(),
                own.prediction.settings,
                own.solver,
                iterations,
                tolerance,
            )
        except SettingError:
            return None

    def arrives(self, costs: Array, dearest: float = 0.0) -> bool:
        """Whether the goal is held at the end of stages with these costs (L,).

        ``dearest`` is the cost of a stage before, where one is known.
        """
        if len(costs) < self._hold:
            return False
        limit = _NEAR_GOAL * max(dearest, float(costs.max()))
        return bool((costs[-self._hold :] <= limit).all())

    def fly(
        self, beginning: Trajectory, question: Question, limit: float = np.inf
    ) -> Flight | None:
        """The flight along a trajectory, and on as the controller steers from its end.

        Returns:
            None where it costs more than ``limit``, or the controller fails.
        """
        costs = self.meter(beginning.states, beginning.inputs, question)
        if not np.isfinite(costs).all():
            return None
        steering = _Steering(self, beginning, costs, question)
        while steering.paid <= limit:
            if steering.stages >= self.controller.horizon:
                flight = steering.flight()
                is_long = steering.stages >= self.longest
                if flight.arrives or is_long or self._stands(flight.costs):
                    return flight
            if not steering.advance():
                return None
        return None

    def hold(self, flight: Flight, question: Question) -> Flight:
        """The flight and a horizon more, as the controller steers from its end."""
        beginning = Trajectory(
            self.controller, flight.states, flight.inputs, flight.plan
        )
        steering = _Steering(self, beginning, flight.costs, question)
        for _ in range(self.controller.horizon):
            if not steering.advance():
                return flight
        return steering.flight()

    def _stands(self, costs: Array) -> bool:
        """Whether the last stages, as many as the goal is to be held for, cost the same."""
        last = costs[-self._hold :]
        return bool(np.ptp(last) <= _STANDSTILL * last.max())

    def step(self, state: Array, input: Array, question: Question) -> Array:
        """The next state (n,) of the model."""
        return self._roll_out.open_loop(
            state[None], input[None, None], question.disturbance
        )[0, 1]

    def relays(self, state: Array, question: Question) -> Iterator[tuple[Array, Array]]:
        """States and inputs of relays: inputs at their bounds, each up to a swing that comes nearer to the goal.

        Relays switch one input where one state passes through its value at the start:
        with a rate they take the plant's own rhythm, whatever it is, and pump.
        """
        controller = self.controller
        m = controller.problem.input_dim
        lower, upper = (side[0] for side in controller.problem.inputs.sides)
        pushed = np.flatnonzero(np.isfinite(upper - lower))
        for j, i, sign in product(pushed, range(len(state)), (1.0, -1.0)):
            gains = np.zeros((self.longest, m, len(state)))
            gains[1:, j, i] = sign * _RELAY * (upper[j] - lower[j])
            inputs = np.tile(controller.initial_input, (self.longest, 1))
            inputs[0, j] = upper[j]
            centre = np.tile(state, (self.longest + 1, 1))
            states, inputs = self.roll_out(centre, inputs, gains, state, question)
            if not np.isfinite(states).all():
                continue
            for last in _swings(self.meter(states, inputs, question)):
                yield states[: last + 2], inputs[: last + 1]

    def follow(
        self, flight: Flight, state: Array, question: Question, dearest: float = 0.0
    ) -> Flight:
        """The flight under its feedback, from another state at its beginning.

        For ``dearest`` see ``arrives``.
        """
        assert flight.gains is not None
        states, inputs = self.roll_out(
            flight.states, flight.inputs, flight.gains, state, question
        )
        if not np.isfinite(states).all():
            costs = np.full(len(inputs), np.inf)
            return Flight(states, inputs, costs, False, flight.gains)
        costs = self.meter(states, inputs, question)
        arrives = self.arrives(costs, dearest)
        return Flight(states, inputs, costs, arrives, flight.gains)

    def roll_out(
        self,
        states: Array,
        inputs: Array,
        gains: Array,
        state: Array,
        question: Question,
    ) -> tuple[Array, Array]:
        """States (L + 1, n) and inputs (L, m) of u_k - K_k (x - x_k) from a state on."""
        length = len(inputs)
        problem = self.controller.problem
        lower, upper = (held(side, length) for side in problem.inputs.sides)
        down, up = (held(side, length) for side in problem.input_rates.sides)
        law = Feedback(
            np.ascontiguousarray(states[None, :-1]),
            np.ascontiguousarray(inputs[None]),
            np.ascontiguousarray(-gains[None]),
            lower,
            upper,
            down,
            up,
            np.ascontiguousarray(question.previous_input),
        )
        rolled, steered = self._roll_out(state[None], law, question.disturbance)
        return rolled[0], steered[0]

    def with_gains(self, flight: Flight) -> Flight:
        """The flight with the gains of the regulator of its own stages."""
        local = linearize(
            self._model, flight.states[:-1], flight.inputs, covariance=False
        )
        cost = self.controller.problem.cost
        gains = finite_horizon_lqr.unchecked(
            np.ascontiguousarray(local.A),
            np.ascontiguousarray(local.B),
            np.ascontiguousarray(first_weight(cost.Q)[None]),
            np.ascontiguousarray(first_weight(cost.R)[None]),
            np.ascontiguousarray(cost.terminal),
            len(flight),
        )[0]
        return replace(flight, gains=gains)

    def improve(
        self,
        flight: Flight,
        question: Question,
        rounds: int = _ROUNDS,
        programs: int = _PROGRAMS,
    ) -> Flight:
        """A cheaper flight from programs over all of its stages; itself where there is none."""
        length = len(flight)
        controller = self._with_horizon(length, programs, _TOLERANCE)
        if controller is None:
            return flight
        asked = question.over(length)
        targets = np.asarray(asked.reference.states)
        state = flight.states[0]
        last = no_plan(question.previous_input, len(state), length)
        angles = controller.problem.cost.angles
        for _ in range(rounds):
            turns = full_turns(flight.states - targets, angles)
            plan = controller.control(
                asked.belief(state),
                Reference(targets + turns, asked.reference.inputs),
                last,
                asked.parameters,
                (flight.inputs, flight.states),
            )
            if not plan.applicable:
                break
            gains = np.zeros((length, *np.shape(plan.inputs)[1:], len(state)))
            towards = Flight(plan.means, plan.inputs, flight.costs, True, gains)
            other = self.follow(towards, state, question)
            if not (other.arrives and other.cost < flight.cost):
                break
            gain = flight.cost - other.cost
            flight = replace(other, gains=None, plan=flight.plan)
            if gain <= _GAIN * flight.cost:
                break
        return flight


class _Steering:
    """A flight that grows, stage by stage, as a controller steers from its end."""

    def __init__(
        self,
        foresight: Foresight,
        beginning: Trajectory,
        costs: Array,
        question: Question,
    ):
        self._foresight = foresight
        self._controller = beginning.controller
        self._question = question
        self._asked = question.over(beginning.controller.horizon)
        self._states = list(beginning.states)
        self._inputs = list(beginning.inputs)
        self._costs = list(costs)
        self.paid = float(costs.sum())
        self._plan = beginning.previous
        if self._plan is None:
            n = beginning.states.shape[1]
            horizon = beginning.controller.horizon
            self._plan = no_plan(self._last_input, n, horizon)

    @property
    def stages(self) -> int:
        """As many as it has now."""
        return len(self._inputs)

    @property
    def _last_input(self) -> Array:
        return self._inputs[-1] if self._inputs else self._question.previous_input

    def advance(self) -> bool:
        """Adds a stage; whether the controller found an input for it."""
        state = self._states[-1]
        asked = self._asked.after(self.stages)
        plan = self._controller.control(
            asked.belief(state), asked.reference, self._plan, asked.parameters
        )
        if not plan.applicable:
            return False
        after = self._foresight.step(state, plan.input, self._question)
        question = self._question.after(self.stages)
        question = question._replace(previous_input=self._last_input)
        costs = self._foresight.meter(
            np.array([state, after]), plan.input[None], question
        )
        cost = float(costs[0])
        if not np.isfinite(cost):
            return False
        self._states.append(after)
        self._inputs.append(plan.input)
        self._costs.append(cost)
        self.paid += cost
        self._plan = plan
        return True

    def flight(self) -> Flight:
        """What it is now."""
        costs = np.array(self._costs)
        arrives = self._foresight.arrives(costs)
        return Flight(
            np.array(self._states),
            np.array(self._inputs),
            costs,
            arrives,
            plan=self._plan,
        )


def _swings(costs: Array) -> list[int]:
    """The first stages (at most four) whose costs are the lowest so far, and lower than those around."""
    stages: list[int] = []
    lowest = costs[0]
    for k in range(1, len(costs) - 1):
        is_turn = costs[k] <= costs[k - 1] and costs[k] < costs[k + 1]
        if is_turn and costs[k] < _NEARER * lowest:
            lowest = costs[k]
            stages.append(k)
    return stages[:_SWINGS]


def held(part: Array, count: int) -> Array:
    """The first rows of a part, the last one repeated up to a count."""
    part = part[:count]
    if len(part) < count:
        part = np.concatenate([part, np.repeat(part[-1:], count - len(part), axis=0)])
    return np.ascontiguousarray(part)


def rows_over(parameters: Any, count: int) -> Array:
    """Parameters of a number of stages (count, q), from (q,) or those of others."""
    return held(np.atleast_2d(np.asarray(parameters, dtype=float)), count)


def first_weight(weight: Array) -> Array:
    """The weight of the first stage, from one for all or those by stage."""
    return weight.reshape(-1, *weight.shape[-2:])[0]


def no_plan(last_input: Array, state_dim: int, horizon: int) -> Decision:
    """A decision without a plan: what counts of it is the input that was applied."""
    inputs = np.tile(last_input, (horizon, 1))
    means = np.full((horizon + 1, state_dim), np.nan)
    covariances = np.full((horizon + 1, state_dim, state_dim), np.nan)
    status = Status.ITERATION_LIMIT
    return Decision(last_input, inputs, means, covariances, status, 0, Timing())
