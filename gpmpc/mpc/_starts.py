"""Searches for a plan from many starts, and keeps what was found.

A program's solution is a local one, of H stages. Where no plan is at hand that leads to
the goal, at the beginning or after a disturbance, many are made: what the controller
itself would do, programs from every pair of a goal and a guess, and what relays lead to
that push with all the inputs have, in the rhythm of the plant. Each is flown on in the
model until the goal is held (``_foresight``). The flight that costs least is improved as
a whole, and followed under its feedback.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cmp_to_key
from itertools import islice, product
from math import inf
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch

from gpmpc._angles import full_turns
from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc._controller import (
    Array,
    Decision,
    Reference,
    check_arguments,
    read_parameters,
)
from gpmpc.mpc._foresight import Flight, Foresight, Question, Trajectory
from gpmpc.mpc._linear_quadratic import References, evaluate_cost
from gpmpc.mpc._stages import StageCosts, StageLinearizer
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Linearization
from gpmpc.status import Status

Criterion = Callable[[Decision, Reference], float]

_RISE = 0.1  # share of what a search promised by which a flight may become dearer
_DRIFT = 0.01  # by which it may before it is improved
_CORRECTIONS = 2  # programs that do so in a decision
_ROOM = 1.3  # cost of a flight that may still be improved, in that of the cheapest
_IMPROVED = 3  # flights that are
_ALIKE = 0.05  # share of the range of a plan's inputs by which the same plan may differ
_KEPT = 1e-3  # share of its cost by which a new plan may be dearer than the last one


class _Memory(NamedTuple):
    """What a decision on the way to a set point leaves for the next one."""

    goal: Array  # the set point (n,)
    promised: float  # cost of the whole flight when it was found, or of one before
    remaining: float  # what is still to be paid of it
    dearest: float  # of the stages so far
    age: int  # decisions since it was found
    costs: Array  # of the stages of the plan (H,)
    flight: Flight | None  # from this decision on; None where the controller took over
    arrives: bool = True  # whether it holds the goal in the end

    @classmethod
    def of_plan(cls, goal: Array, costs: Array) -> "_Memory":
        """That of the controller's own plan to a set point."""
        cost = float(costs.sum())
        return cls(goal, cost, cost, float(costs.max()), 0, costs, None)

    def continued(self, costs: Array) -> "_Memory":
        """After one more decision of the controller, for a plan with these costs."""
        return self._replace(
            dearest=max(self.dearest, float(costs.max())),
            age=self.age + 1,
            costs=costs,
            flight=None,
        )

    def followed(self, flight: Flight, horizon: int) -> "_Memory":
        """After one more decision along a flight, from that decision on."""
        return self._replace(
            remaining=self.remaining - float(self.costs[0]),
            age=self.age + 1,
            costs=flight.costs[:horizon],
            flight=flight,
        )


@dataclass(frozen=True)
class _FollowedDecision(Decision):
    """A decision on the way that a search found."""

    memory: _Memory | None = None


class ManyStarts:
    """Follows what a search found, improved as ``controller`` does; searches where that does not lead to the goal.

    A search flies its starts on in the controller's own model until the goal is held, up
    to four horizons or 200 stages; what ``controller`` does by itself, from its last plan
    and without one, is among them. The cheapest that holds the goal is followed under
    its feedback. It is searched again where a disturbance makes the rest of the way
    dearer, and where the goal is not held in the end.

    A reference that moves, or a criterion, is judged by the plans of H stages alone.
    Then it is searched where there is no plan.

    Angles are those of the cost. The goal of a plan is the full turn of the reference that its end is nearest to.

    Args:
        controller: Of form ``"trajectory"``; takes every step from a plan.
        planner: Takes the starts; more programs a step than ``controller`` are of use. ``controller`` by default.
        guesses: Inputs (H, m) that a guess rolls out from the state, or None for a line from the state to the goal;
            by default the line and those of ``kicks``.
        turns: How many full turns of each angle count as goals, the nearest first; one number for all or one each.
        criterion: What of a plan is to be small, of the decision and the reference in its turns; by default its cost,
            flown on.
        budget: Time after which no further start is taken, once a plan is found [s];
            None for no limit. A search takes a second or several; what ``controller``
            does by itself is flown first, whatever the budget.

    Raises:
        SettingError: A controller of another form, or a number out of range.
        ShapeError: Guesses of another shape.
    """

    def __init__(
        self,
        controller: GPMPC,
        planner: GPMPC | None = None,
        guesses: Sequence[Array | None] | None = None,
        turns: int | Sequence[int] = 2,
        criterion: Criterion | None = None,
        budget: float | None = None,
    ):
        self.controller = controller
        self.planner = controller if planner is None else planner
        for one in (self.controller, self.planner):
            if one.prediction.settings.form != "trajectory":
                raise SettingError(
                    "controller",
                    "must be of form 'trajectory', whose plans may start anywhere",
                )
        self.problem = controller.problem
        self.horizon = controller.horizon
        self.initial_input = controller.initial_input
        self.signals = controller.signals
        H = self.horizon
        m = self.problem.input_dim
        angles = self.problem.cost.angles
        if guesses is None:
            guesses = [None, *kicks(self.problem, H, self.initial_input)]
        shapes = [np.shape(guess) for guess in guesses if guess is not None]
        if any(shape != (H, m) for shape in shapes):
            raise ShapeError(f"guesses must be None or inputs ({H}, {m}); got {shapes}")
        self.guesses = guesses
        self.turns = [turns] * len(angles) if isinstance(turns, int) else list(turns)
        if len(self.turns) != len(angles) or min(self.turns, default=1) < 1:
            raise SettingError(
                "turns",
                f"must be whole numbers from 1 on, one for each of {len(angles)} angles",
            )
        if budget is not None:
            check_number("budget", budget, above=0, unit="[s]")
        self._judges_flights = criterion is None
        self.criterion = self._cost if criterion is None else criterion
        means = StageLinearizer(controller.prediction.model, Linearization(), "none")
        self._weights = StageCosts(self.problem, H, means).quadratic
        self._foresight = Foresight(controller)
        is_certain = controller.prediction.settings.covariance == "none"
        self._has_tubes = bool(self.problem.constraints) and not is_certain
        self.budget = budget

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
    ) -> Decision:
        """Decides the input for one step; see ``Controller.control``."""
        check_arguments(belief, reference)
        belief = belief.in_order(self.signals.state_names)
        reference = reference.in_order(self.signals).over(self.horizon)
        state = belief.mean.numpy()
        if not np.isfinite(state).all():
            return self.controller.control(belief, reference, previous, parameters)
        if previous is not None and self._can_continue(previous):
            turns = full_turns(state - previous.means[1], self.problem.cost.angles)
            belief = replace(belief, mean=belief.mean - torch.as_tensor(turns))
        if self._judges_flights and _is_set_point(reference):
            decision = self._follow_flight(belief, reference, previous, parameters)
        else:
            decision = self._follow_plan(belief, reference, previous, parameters)
        return decision

    def _can_continue(self, previous: Decision) -> bool:
        return previous.applicable and len(previous.means) == self.horizon + 1

    def _follow_plan(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None,
        parameters: Any,
    ) -> Decision:
        """The last plan, improved or kept; that of a search where there is none."""
        if previous is not None and self._can_continue(previous):
            decision = self._improve(belief, reference, previous, parameters)
            if decision.applicable:
                return decision
        return self._search_plan(belief, reference, previous, parameters)

    def _search_plan(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None,
        parameters: Any,
    ) -> Decision:
        """The plan that the criterion likes best: the controller's own, or one of all starts."""
        deadline = self._deadline()
        last = None if previous is None else replace(previous, solution=None)
        best = self.controller.control(belief, reference, last, parameters)
        turns = full_turns(
            best.means[-1] - reference.states[-1], self.problem.cost.angles
        )
        lowest = self._judge(best, _moved(reference, turns))
        for decision, value in self.plans(belief, reference, last, parameters):
            if value < lowest:
                best = decision
                lowest = value
            if lowest < inf and perf_counter() > deadline:
                break
        return best

    def _follow_flight(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None,
        parameters: Any,
    ) -> Decision:
        """The decision on the way to a set point that was found, or on a new one."""
        question = self._question(belief, reference, previous, parameters)
        memory = self._memory(previous, reference)
        known = None
        if memory is not None and memory.flight is not None:
            known = self._rest(memory.flight, memory, belief, question)
            memory = memory.followed(known, self.horizon)
            if self._is_as_promised(known, memory):
                return self._along(known, memory, belief, question, previous)
        elif previous is not None and self._can_continue(previous):
            decision = self._improve(belief, reference, previous, parameters)
            costs = self._foresight.meter(decision.means, decision.inputs, question)
            if decision.applicable and not self._is_lost(costs, memory):
                if memory is None:
                    memory = _Memory.of_plan(np.array(reference.states[-1]), costs)
                else:
                    memory = memory.continued(costs)
                return _remembering(decision, memory)
        flight = self._search_flight(belief, question, previous, known)
        if flight is None:
            return self._search_plan(belief, reference, previous, parameters)
        promised = flight.cost
        dearest = float(flight.costs.max())
        if memory is not None:
            promised = max(promised, memory.promised)
            dearest = max(dearest, memory.dearest)
        memory = _Memory(
            goal=np.array(reference.states[-1]),
            promised=promised,
            remaining=flight.cost,
            dearest=dearest,
            age=0,
            costs=flight.costs[: self.horizon],
            flight=flight,
            arrives=flight.arrives,
        )
        return self._along(flight, memory, belief, question, previous)

    def _rest(
        self, flight: Flight, memory: _Memory, belief: Gaussian, question: Question
    ) -> Flight:
        """What is left of a flight, from the state that its first stage led to.

        Where a disturbance made it dearer than it was to be, it is improved.
        """
        foresight = self._foresight
        state = belief.mean.numpy()
        rest = foresight.follow(flight.after(1), state, question, memory.dearest)
        promised = memory.remaining - float(memory.costs[0])
        if rest.arrives and rest.cost > promised + _DRIFT * memory.promised:
            rest = foresight.improve(rest, question, 1, _CORRECTIONS)
            rest = foresight.with_gains(rest)
        return rest

    def _is_as_promised(self, rest: Flight, memory: _Memory) -> bool:
        """Whether the rest of a flight costs about what it was to cost, and arrives if it was to."""
        limit = memory.remaining + _RISE * memory.promised
        return rest.cost <= limit and (rest.arrives or not memory.arrives)

    def _question(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None,
        parameters: Any,
    ) -> Question:
        last_input = self.initial_input
        disturbance = None
        if previous is not None:
            last_input = np.asarray(previous.input, dtype=float)
            disturbance = previous.disturbance
        return Question(
            belief.covariance, reference, parameters, last_input, disturbance
        )

    def _memory(
        self, previous: Decision | None, reference: Reference
    ) -> _Memory | None:
        """What the last decision left, its flight from that decision on; None for another goal."""
        if not isinstance(previous, _FollowedDecision) or previous.memory is None:
            return None
        memory = previous.memory
        if not np.array_equal(memory.goal, reference.states[-1]):
            return None
        if memory.flight is not None:  # which a failed step may have left behind
            expected = (memory.flight.states == previous.means[0]).all(axis=1)
            passed = np.flatnonzero(expected)
            flight = None
            if len(passed):
                flight = memory.flight.after(int(passed[0]))
            if flight is not None and len(flight) <= self.horizon:
                flight = None  # from here on a plan of H stages sees as much
            memory = memory._replace(flight=flight)
        return memory

    def _is_lost(self, costs: Array, memory: _Memory | None) -> bool:
        """Whether a plan of stages with these costs (H,) is to be searched anew."""
        if memory is None:
            return not self._foresight.arrives(costs)
        if self._foresight.arrives(costs, memory.dearest):
            return False
        rise = costs[:-1].sum() - memory.costs[1:].sum()
        is_dearer = rise > _RISE * memory.promised
        return is_dearer or memory.age >= self._foresight.longest

    def _along(
        self,
        flight: Flight,
        memory: _Memory,
        belief: Gaussian,
        question: Question,
        previous: Decision | None,
    ) -> Decision:
        """The decision whose plan are the first stages of a flight."""
        H = self.horizon
        means = flight.states[: H + 1]
        inputs = flight.inputs[:H]
        reference = question.reference
        turns = full_turns(means[-1] - reference.states[-1], self.problem.cost.angles)
        goal = _moved(reference, turns)
        decision = self.controller.control(
            belief, goal, previous, question.parameters, (inputs, means)
        )
        return _remembering(_with_plan(decision, inputs, means), memory)

    def _search_flight(
        self,
        belief: Gaussian,
        question: Question,
        previous: Decision | None,
        known: Flight | None,
    ) -> Flight | None:
        """The cheapest flight of all starts; None where the controller fails in every one."""
        foresight = self._foresight
        deadline = self._deadline()
        flights = []
        if known is not None and np.isfinite(known.cost):
            flights.append(known)
        limit = inf
        steering = self.controller
        lowest = inf
        for beginning in self._alone(belief, previous):
            flight = foresight.fly(beginning, question, limit)
            if flight is not None:
                flights.append(flight)
                if flight.arrives and flight.cost < lowest:
                    lowest = flight.cost
                    limit = _ROOM * lowest
                    steering = beginning.controller
            if flights and perf_counter() > deadline:
                break
        for states, inputs in self._beginnings(belief, question, previous):
            if flights and perf_counter() > deadline:
                break
            beginning = Trajectory(steering, states, inputs)
            flight = foresight.fly(beginning, question, limit)
            if flight is not None:
                flights.append(flight)
                if flight.arrives:
                    limit = min(limit, _ROOM * flight.cost)
        if not flights:
            return None
        flights.sort(key=cmp_to_key(_order))
        best = foresight.hold(flights[0], question)
        for flight in flights[:_IMPROVED]:
            if not flight.arrives or perf_counter() > deadline:
                break
            held = best
            if flight is not flights[0]:
                held = foresight.hold(flight, question)
            improved = foresight.improve(held, question)
            if improved.is_better_than(best):
                best = improved
        best = foresight.with_gains(best)
        return foresight.follow(best, belief.mean.numpy(), question)

    def _alone(
        self, belief: Gaussian, previous: Decision | None
    ) -> Iterator[Trajectory]:
        """The controller by itself: from its last plan, without one, and with shorter horizons."""
        here = belief.mean.numpy()[None]
        nothing = np.empty((0, self.problem.input_dim))
        if previous is not None and self._can_continue(previous):
            yield Trajectory(self.controller, here, nothing, previous)
        for controller in (self.controller, *self._foresight.shorter):
            yield Trajectory(controller, here, nothing)

    def _beginnings(
        self, belief: Gaussian, question: Question, previous: Decision | None
    ) -> Iterator[tuple[Array, Array]]:
        """States and inputs of the plans of all starts, and of relays."""
        foresight = self._foresight
        state = belief.mean.numpy()
        last = None if previous is None else replace(previous, solution=None)
        tried: list[Array] = []
        for decision, value in self.plans(
            belief, question.reference, last, question.parameters
        ):
            if value < inf and not any(_are_alike(decision.inputs, u) for u in tried):
                tried.append(decision.inputs)
                states = decision.means
                inputs = decision.inputs
                if not self.planner.prediction.settings.rolled_out:
                    gains = self._plan_gains(
                        self.planner, decision, question.parameters
                    )
                    states, inputs = foresight.roll_out(
                        states, inputs, gains, state, question
                    )
                if np.isfinite(states).all():
                    yield states, inputs
        yield from foresight.relays(state, question)

    def _improve(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision,
        parameters: Any,
    ) -> Decision:
        """The controller's decision from the last plan, or that plan kept, where it costs less."""
        turns = full_turns(
            previous.means[-1] - reference.states[-1], self.problem.cost.angles
        )
        goal = _moved(reference, turns)
        inputs = np.concatenate([previous.inputs[1:], previous.inputs[-1:]])
        means = np.concatenate([previous.means[1:], previous.means[-1:]])
        decision = self.controller.control(
            belief, goal, previous, parameters, (inputs, means)
        )
        question = self._question(belief, goal, previous, parameters)
        limit = inf
        if decision.applicable:
            if self._has_tubes:
                return decision  # which the last plan, moved on, may have left
            cost = self._plan_cost(decision.means, decision.inputs, question)
            limit = cost / (1.0 + _KEPT)
        if self._plan_cost(means, inputs, question) >= limit:
            return decision
        gains = self._plan_gains(self.controller, previous, parameters)
        gains = np.concatenate([gains[1:], gains[-1:]])
        states, inputs = self._foresight.roll_out(
            means, inputs, gains, belief.mean.numpy(), question
        )
        if self._plan_cost(states, inputs, question) < limit:
            return _with_plan(decision, inputs, states)
        return decision

    def _plan_gains(
        self, controller: GPMPC, decision: Decision, parameters: Any
    ) -> Array:
        own = parameters
        if own is not None:
            own = read_parameters(own, self.horizon)
        return controller.gains(decision, own)

    def _plan_cost(self, means: Array, inputs: Array, question: Question) -> float:
        """The cost of a plan, violated constraints included; infinite where it is not finite."""
        cost = self._tracking_cost(
            means, inputs, question.reference, question.previous_input
        )
        functions = self._foresight.meter.functions(means, inputs, question.parameters)
        cost += float(functions.sum())
        return cost if np.isfinite(cost) else inf

    def _deadline(self) -> float:
        """The time of ``perf_counter`` after which a search takes no further start."""
        return inf if self.budget is None else perf_counter() + self.budget

    def plans(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
        first: int = 0,
    ) -> Iterator[tuple[Decision, float]]:
        """Makes the decisions of ``len(self)`` starts, from the ``first`` on, one by one.

        Each comes with its criterion, infinite if it is not applicable.
        """
        candidates = self._candidates(belief.mean.numpy(), reference.over(self.horizon))
        for goal, guess in islice(candidates, first, None):
            yield self._try(self.planner, belief, goal, previous, parameters, guess)

    def __len__(self) -> int:
        return len(self.guesses) * math.prod(self.turns)

    def gains(self, decision: Decision) -> Array:
        """Those of ``controller``."""
        return self.controller.gains(decision)

    def _cost(self, decision: Decision, reference: Reference) -> float:
        """The tracking cost of a plan."""
        return self._tracking_cost(
            decision.means, decision.inputs, reference, decision.inputs[0]
        )

    def _tracking_cost(
        self, means: Array, inputs: Array, reference: Reference, previous_input: Array
    ) -> float:
        wanted = np.zeros_like(inputs)
        if reference.inputs is not None:
            wanted = np.asarray(reference.inputs)
        targets = np.asarray(reference.states[1:])
        references = References(targets, wanted, previous_input)
        return evaluate_cost(self._weights, means, inputs, references, 1.0)

    def _try(
        self, controller: GPMPC, belief: Gaussian, goal: Reference, *more: Any
    ) -> tuple[Decision, float]:
        """A controller's decision on its arguments, and its criterion: infinite where it is not applicable."""
        decision = controller.control(belief, goal, *more)
        return decision, self._judge(decision, goal)

    def _judge(self, decision: Decision, goal: Reference) -> float:
        """The criterion of a decision; infinite where it is not applicable."""
        value = self.criterion(decision, goal) if decision.applicable else inf
        return value if np.isfinite(value) else inf

    def _candidates(
        self, state: Array, reference: Reference
    ) -> Iterator[tuple[Reference, tuple[Array, Array]]]:
        """Goals and guesses, inputs and states, guess by guess, the nearest goals first."""
        goals = list(self._goals(state, reference))
        H = self.horizon
        for guess, goal in product(self.guesses, goals):
            if guess is None:
                shares = np.linspace(1.0, 0.0, H + 1)[:, None]
                targets = goal.states
                yield (
                    goal,
                    (
                        np.tile(self.initial_input, (H, 1)),
                        targets + shares * (state - targets[0]),
                    ),
                )
            else:
                yield (
                    goal,
                    (
                        guess,
                        self.planner.prediction.lead(
                            state, np.asarray(guess, dtype=float)
                        ),
                    ),
                )

    def _goals(self, state: Array, reference: Reference) -> Iterator[Reference]:
        angles = list(self.problem.cost.angles)
        moves = []
        for angle, count in zip(angles, self.turns, strict=True):
            off = (state[angle] - reference.states[-1, angle]) / (2 * np.pi)
            around = range(int(np.floor(off)) - count, int(np.ceil(off)) + count + 1)
            moves.append(sorted(around, key=lambda k: abs(k - off))[:count])
        chosen = list(product(*moves))
        turns = np.zeros((len(chosen), len(state)))
        turns[:, angles] = 2 * np.pi * np.array(chosen).reshape(len(turns), len(angles))
        distances = np.abs(state - reference.states[-1] - turns)[:, angles].sum(axis=1)
        return (
            _moved(reference, turns[i]) for i in np.argsort(distances, kind="stable")
        )


def kicks(
    problem: Problem, horizon: int, initial_input: Array, share: float = 0.5
) -> list[Array]:
    """The initial input held (H, m); for each bounded input a push and a pull, and a pull and a push, of H/6 stages.

    ``share`` is the way from the initial input to its bounds.
    """
    drift = np.tile(np.asarray(initial_input, dtype=float), (horizon, 1))
    length = max(1, horizon // 6)
    found = [drift]
    bounds = (problem.inputs.upper, problem.inputs.lower)
    for j, sides in product(range(problem.input_dim), (bounds, bounds[::-1])):
        if np.isfinite([side[j] for side in sides]).all():
            inputs = drift.copy()
            for part, side in zip(
                (slice(0, length), slice(length, 2 * length)), sides, strict=True
            ):
                inputs[part, j] += share * (side[j] - initial_input[j])
            found.append(inputs)
    return found


def _moved(reference: Reference, turns: Array) -> Reference:
    return replace(reference, states=np.asarray(reference.states, dtype=float) + turns)


def _is_set_point(reference: Reference) -> bool:
    """Whether a reference (H + 1, n) stands still."""
    states = np.asarray(reference.states)
    inputs = (
        np.zeros((1, 1)) if reference.inputs is None else np.asarray(reference.inputs)
    )
    return bool((states == states[0]).all() and (inputs == inputs[0]).all())


def _are_alike(inputs: Array, others: Array) -> bool:
    """Whether two plans are one, but for the tolerance that they were solved to."""
    return bool(np.allclose(inputs, others, atol=_ALIKE * np.ptp(others)))


def _order(one: Flight, other: Flight) -> int:
    """Below zero where a flight is better than another."""
    return int(other.is_better_than(one)) - int(one.is_better_than(other))


def _with_plan(decision: Decision, inputs: Array, means: Array) -> Decision:
    """A decision for another plan, which is applicable."""
    changes: dict[str, Any] = {
        "stage_costs": np.empty(0),
        "violation": math.nan,
        "steps": (),
    }
    if not decision.applicable:
        changes["status"] = Status.ITERATION_LIMIT
        changes["suboptimal"] = True
        changes["covariances"] = np.zeros((*means.shape, means.shape[1]))
    return replace(decision, input=inputs[0], inputs=inputs, means=means, **changes)


def _remembering(decision: Decision, memory: _Memory) -> Decision:
    parts = {part.name: getattr(decision, part.name) for part in fields(Decision)}
    return _FollowedDecision(**parts, memory=memory)
