"""Flies a controller on in its own model.

A program sees H stages, and a swing-up may take many more: the plan of least cost over
H stages may lean for ever where its inputs can hold it. What a plan is worth shows when
it is flown on: by the controller itself, decision by decision, in its own model, until
the goal is held.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from gpmpc._angles import full_turns
from gpmpc._dynamics import linearize
from gpmpc._kernels.gp_rollout import Feedback
from gpmpc.exceptions import SettingError
from gpmpc.models import RollOut
from gpmpc.mpc._controller import Decision, Timing
from gpmpc.mpc._question import Question, first_weight, hold_last
from gpmpc.mpc._riccati import finite_horizon_lqr
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc._stage_meter import CostSum, FlownCosts, StageMeter
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.mpc.problem import Problem
from gpmpc.status import Status

Array = np.ndarray

_HORIZONS = 4  # a flight takes at most so many horizons of the controller,
_STAGES = 200  # or so many stages, where these are more
_HOLDING_PART = 6  # the goal counts as held after this part of a horizon near it,
_FEWEST = 3  # but not after fewer stages
_NEAR_GOAL = 0.01  # share of the dearest stage's cost that a stage near the goal has
_SMALL_PART = 1e-4  # of the range of an input, whose cost is none beside others
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
class ModelFlight:
    """A trajectory of the model, of as many stages as it takes, and its costs."""

    states: Array  #: x_0 .. x_L (L + 1, n)
    inputs: Array  #: (L, m)
    costs: FlownCosts  #: of x_{k+1} and u_k, L stages
    arrives: bool  #: whether it ends where the goal is held
    gains: Array | None = None  #: K of the feedback u_k - K_k (x - x_k) (L, m, n)
    plan: Decision | None = None  #: the controller's last, a stage before the end

    def __len__(self) -> int:
        return len(self.inputs)

    @property
    def cost(self) -> float:
        """Cost of all stages; infinite where one is beyond a hard bound."""
        return float(self.costs.total.sum())

    @property
    def cost_sum(self) -> CostSum:
        """The same in parts, without the stages beyond a hard bound."""
        return self.costs.sum()

    def is_better_than(self, other: "ModelFlight") -> bool:
        """Tells whether it alone arrives, or costs less.

        Where none arrives, both are held at their ends for as long as the longer takes.
        """
        if self.arrives != other.arrives:
            return self.arrives
        if self.arrives:
            return self.cost < other.cost
        length = max(len(self), len(other))
        return self._cost_over(length) < other._cost_over(length)

    def _cost_over(self, length: int) -> float:
        return self.cost + float(self.costs.total[-1]) * (length - len(self))

    def after(self, stages: int) -> "ModelFlight":
        """Returns what is left of it after some stages."""
        return ModelFlight(
            states=self.states[stages:],
            inputs=self.inputs[stages:],
            costs=self.costs[stages:],
            arrives=self.arrives,
            gains=None if self.gains is None else self.gains[stages:],
        )


class Trajectory(NamedTuple):
    """The beginning of a flight, from whose end on a controller steers."""

    controller: GPMPC
    states: Array  # (K + 1, n)
    inputs: Array  # (K, m)
    previous: Decision | None = None  # the controller's last plan


class Foresight:
    """Makes flights of a controller, and of itself with shorter horizons."""

    def __init__(self, controller: GPMPC):
        self.controller = controller
        self.meter = StageMeter(controller.prediction.problem, controller.horizon)
        self.longest = max(_HORIZONS * controller.horizon, _STAGES)  # stages
        self._model = controller.prediction.model
        self._roll_out = RollOut(self._model)
        holding_stages = max(_FEWEST, controller.horizon // _HOLDING_PART)
        # Stages for which the goal is to be held; no plan is longer than its horizon.
        self._holding_stages = min(holding_stages, controller.horizon)
        # The cost of a stage that is as good as free.
        self._negligible = _negligible_cost(controller.prediction.problem)
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
        """Returns the controller with another horizon.

        None where its problem is declared for this horizon: bounds, weights or
        constraints by stage.
        """
        controller = self.controller
        constraints = controller.prediction.problem.constraints
        if any(constraint.stages is not None for constraint in constraints):
            return None
        try:
            return GPMPC(
                self._model,
                controller.prediction.propagator,
                controller.prediction.problem,
                horizon,
                controller.initial_input.tolist(),
                prediction=controller.prediction.settings,
                solver=controller.solver,
                iterations=iterations,
                tolerance=tolerance,
            )
        except SettingError:
            return None

    def arrives(self, costs: FlownCosts, dearest: float = 0.0) -> bool:
        """Tells whether the goal is held at the end of stages with costs.

        Near it, stages weigh little beside the dearest one; or the plant stands still,
        and the inputs that hold it there are all that it costs. What violations of soft
        constraints cost says nothing of how near the goal is, and stages beyond a hard
        bound nothing at all.

        Args:
            costs: Of the stages.
            dearest: What a stage before weighed, where one is known.
        """
        if len(costs) < self._holding_stages:
            return False
        final_costs = costs[-self._holding_stages :]
        if not final_costs.are_finite.all():
            return False
        limit = _NEAR_GOAL * max(dearest, costs.dearest)
        if (final_costs.weighed <= max(limit, self._negligible)).all():
            return True
        is_there = (final_costs.errors <= _NEAR_GOAL * final_costs.weighed).all()
        return bool(is_there) and _stand(final_costs.weighed)

    def fly(
        self, beginning: Trajectory, question: Question, limit: float = np.inf
    ) -> ModelFlight | None:
        """Flies along a trajectory, and on as its controller steers from its end.

        The flight ends where the goal is held, where the plant stands still, or where
        it has become too long.

        Returns:
            None where it costs more than ``limit``, or the controller fails.
        """
        costs = self.meter(beginning.states, beginning.inputs, question)
        if not costs.are_finite.all():
            return None
        growing = _GrowingFlight(self, beginning, costs, question)
        while growing.paid <= limit:
            if growing.stages >= self.controller.horizon:
                flight = growing.flight()
                is_long = growing.stages >= self.longest
                if flight.arrives or is_long or self._stands(flight.costs):
                    return flight
            if not growing.advance():
                return None
        return None

    def prolong(self, flight: ModelFlight, question: Question) -> ModelFlight:
        """Returns a flight and a horizon more, as the controller steers from its end.

        It is the flight itself where the controller fails.
        """
        beginning = Trajectory(
            self.controller, flight.states, flight.inputs, flight.plan
        )
        growing = _GrowingFlight(self, beginning, flight.costs, question)
        for _ in range(self.controller.horizon):
            if not growing.advance():
                return flight
        return growing.flight()

    def _stands(self, costs: FlownCosts) -> bool:
        """Tells whether the last stages cost the same.

        They are as many as the goal is to be held for.
        """
        final_costs = costs[-self._holding_stages :]
        return _stand(final_costs.weighed) and _stand(final_costs.violations)

    def step(self, state: Array, input: Array, question: Question) -> Array:
        """Returns the next state (n,) of the model."""
        return self._roll_out.open_loop(
            state[None], input[None, None], question.disturbance
        )[0, 1]

    def relays(self, state: Array, question: Question) -> Iterator[tuple[Array, Array]]:
        """Makes states and inputs of relays, up to swings that come nearer to the goal.

        Relays switch one input between its bounds where one state passes through its
        value at the start: with a rate they take the plant's own rhythm, whatever it
        is, and pump.
        """
        controller = self.controller
        m = controller.prediction.problem.input_dim
        lower, upper = (side[0] for side in controller.prediction.problem.inputs.sides)
        room = upper - lower
        pushed = np.flatnonzero((room > 0.0) & np.isfinite(room))
        for j, i, sign in product(pushed, range(len(state)), (1.0, -1.0)):
            gains = np.zeros((self.longest, m, len(state)))
            gains[1:, j, i] = sign * _RELAY * (upper[j] - lower[j])
            inputs = np.tile(controller.initial_input, (self.longest, 1))
            inputs[0, j] = upper[j]
            centre = np.tile(state, (self.longest + 1, 1))
            try:
                states, inputs = self.roll_out(centre, inputs, gains, state, question)
            except FAILURES:
                continue
            if not np.isfinite(states).all():
                continue
            for last in _swings(self.meter(states, inputs, question).weighed):
                yield states[: last + 2], inputs[: last + 1]

    def follow(
        self,
        flight: ModelFlight,
        state: Array,
        question: Question,
        dearest: float = 0.0,
    ) -> ModelFlight:
        """Returns a flight under its feedback, from another state at its beginning.

        For ``dearest`` see ``arrives``.
        """
        assert flight.gains is not None
        states = np.full_like(flight.states, np.nan)
        inputs = flight.inputs
        costs = FlownCosts.unknown(len(inputs))
        arrives = False
        with suppress(*FAILURES):
            states, inputs = self.roll_out(
                flight.states, flight.inputs, flight.gains, state, question
            )
        if np.isfinite(states).all():
            costs = self.meter(states, inputs, question)
            arrives = self.arrives(costs, dearest)
        return ModelFlight(
            states=states,
            inputs=inputs,
            costs=costs,
            arrives=arrives,
            gains=flight.gains,
        )

    def roll_out(
        self,
        states: Array,
        inputs: Array,
        gains: Array,
        state: Array,
        question: Question,
    ) -> tuple[Array, Array]:
        """Returns states (L + 1, n) and inputs (L, m) of the law u_k - K_k (x - x_k).

        They start from ``state`` (n,), keep the bounds and rates of the inputs, and
        follow ``states`` (L + 1, n) and ``inputs`` (L, m) with ``gains`` (L, m, n).
        """
        length = len(inputs)
        problem = self.controller.prediction.problem
        lower, upper = (hold_last(side, length) for side in problem.inputs.sides)
        down, up = (hold_last(side, length) for side in problem.input_rates.sides)
        law = Feedback(
            states=np.ascontiguousarray(states[None, :-1]),
            inputs=np.ascontiguousarray(inputs[None]),
            gains=np.ascontiguousarray(-gains[None]),
            lower=lower,
            upper=upper,
            rate_lower=down,
            rate_upper=up,
            previous_input=np.ascontiguousarray(question.previous_input),
        )
        # One trajectory in the batch.
        rolled_states, rolled_inputs = self._roll_out(
            state[None], law, question.disturbance
        )
        return rolled_states[0], rolled_inputs[0]

    def with_gains(self, flight: ModelFlight, question: Question) -> ModelFlight:
        """Returns a flight with the gains of the regulator of its own stages.

        Outputs weigh as they do along it. Stages up to one at which the model has no
        slopes are flown without feedback; all are where linearising fails.
        """
        no_gains = np.zeros((*flight.inputs.shape, flight.states.shape[1]))
        try:
            local = linearize(
                self._model, flight.states[:-1], flight.inputs, covariance=False
            )
        except FAILURES:
            return replace(flight, gains=no_gains)
        problem = self.controller.prediction.problem
        cost = problem.cost
        Q = first_weight(cost.Q)[None]
        R = first_weight(cost.R)[None]
        terminal = cost.terminal
        if problem.outputs:
            Z = self.meter.output_weights(
                flight.states, flight.inputs, question.parameters
            )
            n = flight.states.shape[1]
            terminal = terminal + Z[-1, :n, :n]
            # The regulator weighs x_0 .. x_{L-1}, Z what follows them.
            Q = Q + np.concatenate([Z[:1], Z[:-1]])[:, :n, :n]
            R = R + Z[:, n:-1, n:-1]
        gains = finite_horizon_lqr.unchecked(
            np.ascontiguousarray(local.A),
            np.ascontiguousarray(local.B),
            np.ascontiguousarray(Q),
            np.ascontiguousarray(R),
            np.ascontiguousarray(terminal),
            len(flight),
        )[0]
        has_numbers = np.isfinite(gains).all(axis=(1, 2), keepdims=True)
        return replace(flight, gains=np.where(has_numbers, gains, 0.0))

    def improve(
        self,
        flight: ModelFlight,
        question: Question,
        rounds: int = _ROUNDS,
        programs: int = _PROGRAMS,
    ) -> ModelFlight:
        """Returns a cheaper flight from programs over all of its stages.

        It is the flight itself where there is none.

        Args:
            flight: The flight.
            question: What the controller is asked at its beginning.
            rounds: How often it is solved at most, the turns of its goal read anew.
            programs: Quadratic programs of a round.
        """
        length = len(flight)
        controller = self._with_horizon(length, programs, _TOLERANCE)
        if controller is None:
            return flight
        whole = question.over(length)
        targets = np.asarray(whole.reference.states)
        state = flight.states[0]
        previous = no_plan(
            question.previous_input, len(state), length, question.disturbance
        )
        angles = controller.prediction.problem.cost.angle_indices
        for _ in range(rounds):
            turns = full_turns(flight.states - targets, angles)
            plan = controller.control(
                whole.belief(state),
                replace(whole.reference, states=targets + turns),
                previous,
                whole.parameters,
                plan=(flight.inputs, flight.states),
            )
            if not plan.applicable:
                break
            planned = ModelFlight(
                states=plan.means, inputs=plan.inputs, costs=flight.costs, arrives=True
            )
            # A plan may have defects, which inputs alone would multiply.
            planned = self.with_gains(planned, question)
            candidate = self.follow(planned, state, question)
            if not (candidate.arrives and candidate.cost < flight.cost):
                break
            saving = flight.cost - candidate.cost
            flight = replace(candidate, gains=None, plan=flight.plan)
            if saving <= _GAIN * flight.cost_sum.weighed:
                break
        return flight


class _GrowingFlight:
    """A flight that grows, stage by stage, as a controller steers from its end."""

    def __init__(
        self,
        foresight: Foresight,
        beginning: Trajectory,
        costs: FlownCosts,
        question: Question,
    ):
        self._foresight = foresight
        self._controller = beginning.controller
        self._question = question
        self._question_over_horizon = question.over(beginning.controller.horizon)
        self._states = list(beginning.states)
        self._inputs = list(beginning.inputs)
        self._costs = [costs]
        self.paid = float(costs.total.sum())
        self._plan = beginning.previous
        if self._plan is None:
            n = beginning.states.shape[1]
            horizon = beginning.controller.horizon
            self._plan = no_plan(
                self._last_input, n, horizon, self._question.disturbance
            )

    @property
    def stages(self) -> int:
        """Number of stages so far."""
        return len(self._inputs)

    @property
    def _last_input(self) -> Array:
        return self._inputs[-1] if self._inputs else self._question.previous_input

    def advance(self) -> bool:
        """Adds a stage; returns whether the controller found an input for it."""
        state = self._states[-1]
        now = self._question_over_horizon.after(self.stages)
        plan = self._controller.control(
            now.belief(state), now.reference, self._plan, now.parameters
        )
        if not plan.applicable:
            return False
        try:
            next_state = self._foresight.step(state, plan.input, self._question)
        except FAILURES:
            return False
        question = self._question.after(self.stages)
        question = question._replace(previous_input=self._last_input)
        costs = self._foresight.meter(
            np.array([state, next_state]), plan.input[None], question
        )
        cost = float(costs.total[0])
        if not np.isfinite(cost):
            return False
        self._states.append(next_state)
        self._inputs.append(plan.input)
        self._costs.append(costs)
        self.paid += cost
        self._plan = plan
        return True

    def flight(self) -> ModelFlight:
        """Returns what was flown so far."""
        costs = FlownCosts.joined(self._costs)
        return ModelFlight(
            states=np.array(self._states),
            inputs=np.array(self._inputs),
            costs=costs,
            arrives=self._foresight.arrives(costs),
            plan=self._plan,
        )


def _stand(costs: Array) -> bool:
    """Tells whether stages (K,) cost the same."""
    return bool(np.ptp(costs) <= _STANDSTILL * costs.max())


def _negligible_cost(problem: Problem) -> float:
    """Returns what a small part of the inputs' ranges costs: a stage as good as free.

    Zero where an input is not bounded.
    """
    lower, upper = (side[0] for side in problem.inputs.sides)
    if not np.isfinite(upper - lower).all():
        return 0.0
    small = _SMALL_PART * (upper - lower)
    return float(small @ first_weight(problem.cost.R) @ small)


def _swings(costs: Array) -> list[int]:
    """Returns the first stages (at most four) at which a swing turns.

    Their costs are the lowest so far, and lower than those around.
    """
    stages: list[int] = []
    lowest = costs[0]
    for k in range(1, len(costs) - 1):
        is_turn = costs[k] <= costs[k - 1] and costs[k] < costs[k + 1]
        if is_turn and costs[k] < _NEARER * lowest:
            lowest = costs[k]
            stages.append(k)
    return stages[:_SWINGS]


def no_plan(
    last_input: Array,
    state_dim: int,
    horizon: int,
    disturbance: Array | None = None,
) -> Decision:
    """Returns a decision without a plan.

    What counts of it are the input that was applied and the estimated disturbance (n,).
    """
    return Decision(
        input=last_input,
        inputs=np.tile(last_input, (horizon, 1)),
        means=np.full((horizon + 1, state_dim), np.nan),
        covariances=np.full((horizon + 1, state_dim, state_dim), np.nan),
        status=Status.ITERATION_LIMIT,
        iterations=0,
        timing=Timing(),
        disturbance=disturbance,
    )
