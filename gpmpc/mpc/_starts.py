"""Searches for a plan from many starts, and keeps what was found.

A program's solution is a local one, of H stages. Where no plan is at hand that leads to
the goal, at the beginning or after a disturbance, many are made: what the controller
itself would do, programs from every pair of a goal and a guess, and what relays lead to
that push with all the inputs have, in the rhythm of the plant. Each is flown on in the
model until the goal is held (``_foresight``). The flight that costs least is improved
as a whole, and followed under its feedback.

    start         a goal and a guess of a plan                      (``_start_guesses``)
    beginning     states and inputs from which a controller steers on (``Trajectory``)
    flight        a beginning, flown on until the goal is held      (``ModelFlight``)
    pursuit       the flight that is followed: what it was expected to cost, and what
                  is left of that                                   (``_Pursuit``)
    question      what a controller is asked at any state           (``Question``)
    arguments     those of ``control`` at one step                  (``_StepArguments``)

The arguments are what the user asks at one step, with the state and the last decision;
the question is what stays the same of them along a flight, whose states are many.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cmp_to_key
from itertools import islice
from math import inf
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch

from gpmpc._angles import full_turns
from gpmpc._arrays import is_measured
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import to_array
from gpmpc.exceptions import SettingError, ShapeError, check_kind, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc._controller import (
    Array,
    Decision,
    Reference,
    check_arguments,
    one_step_on,
)
from gpmpc.mpc._foresight import Foresight, ModelFlight, Trajectory
from gpmpc.mpc._linear_quadratic import References, evaluate_cost
from gpmpc.mpc._linearization import StageCosts, StageLinearizer
from gpmpc.mpc._question import Question
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc._stage_meter import CostSum, FlownCosts
from gpmpc.mpc._start_guesses import Starts, kicks, turned
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.propagation import Linearization

Criterion = Callable[[Decision, Reference], float]

_RISE = 0.1  # share of what a flight was to cost by which it may become dearer
_DRIFT = 0.01  # the same share, above which what is left of a flight is improved
_CORRECTIONS = 2  # programs that improve it, a decision
_ROOM = 0.3  # share of the cheapest flight's cost that one flown to its end is dearer
_FLIGHTS_IMPROVED = 3  # of a search, the cheapest ones
_ALIKE = 0.05  # share of the range of an input by which the same plan may differ
_STILL = 1e-3  # share of its bounds within which an input is as good as constant
_DEARER = 1e-3  # share of its cost by which a new plan may be dearer than the last one


class _StepArguments(NamedTuple):
    """The arguments of ``control`` at one step."""

    belief: Gaussian
    reference: Reference  # over the horizon
    previous: Decision | None
    parameters: Any

    @property
    def state(self) -> Array:
        """Mean of the belief (n,)."""
        return to_array(self.belief.mean)

    @property
    def end(self) -> Array:
        """The last reference state (n,)."""
        return self.reference.states[-1]


class _Pursuit(NamedTuple):
    """What a decision on the way to a set point leaves for the next one."""

    goal: Array  # the set point (n,)
    # of the whole flight when it was found, or of one before if that was dearer: what
    # shares are shares of
    whole_cost: CostSum
    remaining: CostSum  # what is still to be paid of it
    dearest: float  # of the stages so far, violations left out
    age: int  # decisions since it was found
    costs: FlownCosts  # of the stages of the plan
    states: Array  # of the plan (H + 1, n)
    flight: (
        ModelFlight | None
    )  # from this decision on; None where the controller took over
    arrives: bool = True  # whether it holds the goal in the end

    @classmethod
    def of_plan(cls, goal: Array, costs: FlownCosts, states: Array) -> "_Pursuit":
        """Returns that of the controller's own plan to a set point."""
        return cls(
            goal=goal,
            whole_cost=costs.sum(),
            remaining=costs.sum(),
            dearest=costs.dearest,
            age=0,
            costs=costs,
            states=states,
            flight=None,
        )

    @classmethod
    def of_flight(
        cls, goal: Array, flight: ModelFlight, horizon: int, last: "_Pursuit | None"
    ) -> "_Pursuit":
        """Returns that of a flight that was found.

        What a flight to the same goal was to cost before still counts.
        """
        whole_cost = flight.cost_sum
        dearest = flight.costs.dearest
        if last is not None:
            whole_cost = whole_cost.largest(last.whole_cost)
            dearest = max(dearest, last.dearest)
        return cls(
            goal=goal,
            whole_cost=whole_cost,
            remaining=flight.cost_sum,
            dearest=dearest,
            age=0,
            costs=flight.costs[:horizon],
            states=flight.states[: horizon + 1],
            flight=flight,
            arrives=flight.arrives,
        )

    def after_decision(self, costs: FlownCosts, states: Array) -> "_Pursuit":
        """Returns it after one more decision of the controller, with that plan.

        What remains of a flight is of no use then: its plans are compared.
        """
        return self._replace(
            dearest=max(self.dearest, costs.dearest),
            age=self.age + 1,
            costs=costs,
            states=states,
            flight=None,
        )

    def after_flown_stage(self, flight: ModelFlight, horizon: int) -> "_Pursuit":
        """Returns it after one more decision along a flight, from that decision on."""
        return self._replace(
            remaining=self.remaining_after_stage,
            age=self.age + 1,
            costs=flight.costs[:horizon],
            states=flight.states[: horizon + 1],
            flight=flight,
        )

    @property
    def remaining_after_stage(self) -> CostSum:
        """What is still to be paid once the first stage of the plan was flown."""
        return self.remaining.less(self.costs[:1].sum())

    def moved_to(self, decision: Decision, horizon: int) -> "_Pursuit":
        """Returns it with its plan and flight from a decision's step on.

        That is its own step, unless steps failed since: stages that these have left
        behind are paid by now. Of a flight that is no longer than a horizon a plan of H
        stages sees as much: it is dropped.
        """
        # Means of a plan that was shifted are rows of it: equal to the digit.
        is_now = (self.states == decision.means[0]).all(axis=1)
        stages = np.flatnonzero(is_now)
        if not len(stages):  # no plan can be compared with what is not known
            return self._replace(costs=self.costs[:0], flight=None)
        passed_count = int(stages[0])
        costs = self.costs[passed_count:]
        flight = None
        if self.flight is not None:
            flight = self.flight.after(passed_count)
            costs = flight.costs[:horizon]
            if len(flight) <= horizon:
                flight = None
        return self._replace(
            remaining=self.remaining.less(self.costs[:passed_count].sum()),
            costs=costs,
            states=self.states[passed_count:],
            flight=flight,
        )


@dataclass(frozen=True)
class _FollowedDecision(Decision):
    """A decision on the way that a search found."""

    pursuit: _Pursuit | None = None

    @classmethod
    def of(cls, decision: Decision, pursuit: _Pursuit) -> "_FollowedDecision":
        """Returns a decision with what it leaves for the next one."""
        values = {
            field.name: getattr(decision, field.name) for field in fields(Decision)
        }
        return cls(**values, pursuit=pursuit)


class _FlightSearch:
    """The flights that a search has made so far."""

    def __init__(
        self,
        foresight: Foresight,
        question: Question,
        controller: GPMPC,
        deadline: float,
    ):
        self._foresight = foresight
        self._question = question
        self._deadline = deadline
        self._flights: list[ModelFlight] = []
        self._cheapest: ModelFlight | None = None  # of those that arrive
        self.best_controller = controller  # whose flight that is

    @property
    def is_late(self) -> bool:
        """Whether the time is over, and some flight is at hand."""
        return bool(self._flights) and perf_counter() > self._deadline

    def add(self, flight: ModelFlight) -> None:
        """Adds a flight that was made before."""
        self._flights.append(flight)

    def fly(self, beginning: Trajectory) -> None:
        """Adds the flight from a beginning, unless it costs much more than another."""
        limit = inf
        if self._cheapest is not None:
            room = _ROOM * self._cheapest.cost_sum.weighed
            limit = self._cheapest.cost + room
        flight = self._foresight.fly(beginning, self._question, limit)
        if flight is None:
            return
        self._flights.append(flight)
        if not flight.arrives:
            return
        if self._cheapest is None or flight.cost < self._cheapest.cost:
            self._cheapest = flight
            self.best_controller = beginning.controller

    def best(self) -> ModelFlight | None:
        """Returns the best flight, after the first few were improved; None without."""
        foresight = self._foresight
        question = self._question
        if not self._flights:
            return None
        flights = sorted(self._flights, key=cmp_to_key(_order))
        best = foresight.prolong(flights[0], question)
        for flight in flights[:_FLIGHTS_IMPROVED]:
            if not flight.arrives or perf_counter() > self._deadline:
                break
            candidate = best
            if flight is not flights[0]:
                candidate = foresight.prolong(flight, question)
            improved = foresight.improve(candidate, question)
            if improved.is_better_than(best):
                best = improved
        return foresight.with_gains(best, question)


@explains_arguments
class ManyStarts:
    """Follows what a search found, and searches where that does not lead to the goal.

    What is followed is improved as ``controller`` does. A search flies its starts on in
    the controller's own model until the goal is held, up to four horizons or 200
    stages; what ``controller`` does by itself, from its last plan and without one, is
    among them. The cheapest that holds the goal is followed under its feedback. It is
    searched again where a disturbance makes the rest of the way dearer, and where the
    goal is not held in the end.

    A reference that moves, or a criterion, is judged by the plans of H stages alone.
    Then it is searched where there is no plan.

    Angles are those of the cost. The goal of a plan is the full turn of the reference
    that its end is nearest to.

    Args:
        controller: Of form ``"trajectory"``; takes every step from a plan.
        planner: Takes the starts; more programs a step than ``controller`` are of use.
            ``controller`` by default.
        guesses: Inputs (H, m) that a guess rolls out from the state, or None for a line
            from the state to the goal; by default the line and those of ``kicks``.
        turns: How many full turns of each angle count as goals, the nearest first; one
            number for all or one each.
        criterion: What of a plan is to be small, of the decision and the reference in
            its turns; by default its cost, flown on.
        budget: Time after which no further start is taken, once a plan is found [s];
            None for no limit. A search takes a second or several; what ``controller``
            does from its last plan, or without one, is flown first, whatever the
            budget.

    Raises:
        SettingError: A controller of another form, a planner of another horizon, or a
            number out of range.
        ShapeError: Guesses of another shape.

    >>> from gpmpc.models import KnownModel
    >>> from gpmpc.mpc import GPMPC, Box, Problem, Tracking
    >>> from gpmpc.propagation import Linearization
    >>> problem = Problem(Tracking([1.0], [1.0]), inputs=Box([-2.0], [2.0]))
    >>> model = KnownModel(lambda x, u: 0.9 * x + u, state_dim=1, input_dim=1)
    >>> single = GPMPC(model, Linearization(), problem, 5, [0.0])
    >>> ManyStarts(single).horizon
    5

    See Also:
        ``kicks``, the guesses of inputs that it begins from by default.
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
        for key, one in (("controller", controller), ("planner", self.planner)):
            check_kind(key, one, GPMPC, "GPMPC(...)")
            if one.prediction.settings.is_held:
                raise SettingError(
                    key, "must be of form 'trajectory', whose plans may start anywhere"
                )
        if self.planner.horizon != controller.horizon:
            rule = f"must have the controller's horizon, {controller.horizon}"
            raise SettingError("planner", f"{rule}; got {self.planner.horizon}")
        self.problem = controller.problem
        self._angles = controller.prediction.problem.cost.angle_indices
        self.horizon = controller.horizon
        self.initial_input = controller.initial_input
        self.signals = controller.signals
        if guesses is None:
            guesses = [None, *kicks(self.problem, self.horizon, self.initial_input)]
        self.starts = Starts(self.planner, guesses, turns)
        self.guesses = self.starts.guesses
        self.turns = self.starts.turns
        if budget is not None:
            check_number("budget", budget, above=0, unit="[s]")
        self.budget = budget
        self._judges_flights = criterion is None
        self.criterion = self._cost if criterion is None else criterion
        means = StageLinearizer(controller.prediction.model, Linearization(), "none")
        problem = controller.prediction.problem
        self._weights = StageCosts(problem, self.horizon, means).quadratic
        self._foresight = Foresight(controller)
        is_certain = controller.prediction.settings.covariance == "none"
        self._has_tubes = bool(self.problem.constraints) and not is_certain

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
    ) -> Decision:
        """Decides the input for one step; see ``Controller.control``."""
        check_arguments(belief, reference, previous)
        belief = belief.in_order(self.signals.state_names)
        reference = reference.in_order(self.signals).over(self.horizon)
        state = to_array(belief.mean)
        if state.shape != np.shape(reference.states)[1:]:
            got = f"{state.shape} and {np.shape(reference.states)}"
            raise ShapeError(
                f"state and reference must be of as many states; got {got}"
            )
        if not is_measured(state).all():
            return self.controller.control(belief, reference, previous, parameters)
        if previous is not None and self._can_continue(previous):
            turns = full_turns(state - previous.means[1], self._angles)
            belief = replace(
                belief, mean=belief.mean - torch.tensor(turns).to(belief.mean)
            )
        arguments = _StepArguments(belief, reference, previous, parameters)
        if self._judges_flights and _is_set_point(reference):
            return self._follow_flight(arguments)
        return self._follow_plan(arguments)

    def plans(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
        first: int = 0,
    ) -> Iterator[tuple[Decision, float]]:
        """Makes the decisions of ``len(self)`` starts, from the ``first`` on.

        Each comes with its criterion, infinite if it is not applicable.
        """
        starts = self.starts.of(to_array(belief.mean), reference.over(self.horizon))
        for start in islice(starts, first, None):
            decision = self.planner.control(
                belief,
                start.goal,
                previous,
                parameters,
                plan=(start.inputs, start.states),
            )
            value = self._judge(decision, start.goal, previous, parameters)
            yield decision, value

    def __len__(self) -> int:
        return len(self.starts)

    def gains(self, decision: Decision, parameters: Any = None) -> Array:
        """Returns those of ``controller``."""
        return self.controller.gains(decision, parameters)

    def _can_continue(self, previous: Decision) -> bool:
        return previous.applicable and len(previous.means) == self.horizon + 1

    def _follow_plan(self, arguments: _StepArguments) -> Decision:
        """Returns the last plan, improved or kept; a new one where there is none."""
        previous = arguments.previous
        if previous is not None and self._can_continue(previous):
            decision = self._continue_or_keep(arguments, previous)
            if decision.applicable:
                return decision
        return self._search_plan(arguments)

    def _search_plan(self, arguments: _StepArguments) -> Decision:
        """Returns the plan that the criterion likes best.

        That is the controller's own, or one of all starts.
        """
        belief, reference, previous, parameters = arguments
        deadline = self._deadline()
        last_plan = _without_solution(previous)
        best = self.controller.control(belief, reference, last_plan, parameters)
        goal = self._nearest_turn(reference, best.means[-1])
        lowest = self._judge(best, goal, last_plan, parameters)
        for decision, value in self.plans(belief, reference, last_plan, parameters):
            # Among plans beyond a hard bound, whose cost is infinite, the first one.
            is_first = decision.applicable and not best.applicable
            if is_first or value < lowest:
                best = decision
                lowest = value
            if best.applicable and perf_counter() > deadline:
                break
        return best

    def _follow_flight(self, arguments: _StepArguments) -> Decision:
        """Returns the decision on the way to a set point that was found, or a new one.

        Steps of a flight are followed as long as it costs what it was to cost; once it
        is no longer than a horizon, the controller's own plans are.
        """
        question = self._read_question(arguments)
        pursuit = self._last_pursuit(arguments)
        current = None  # what is left of the flight that was followed
        if pursuit is not None and pursuit.flight is not None:
            current = self._remaining_flight(
                pursuit.flight, pursuit, arguments, question
            )
            pursuit = pursuit.after_flown_stage(current, self.horizon)
            if self._is_as_expected(current, pursuit):
                return self._decide_along(current, pursuit, arguments, question)
        else:
            decision = self._continue_plan(arguments, question, pursuit)
            if decision is not None:
                return decision
        return self._search_anew(arguments, question, pursuit, current)

    def _continue_plan(
        self, arguments: _StepArguments, question: Question, pursuit: _Pursuit | None
    ) -> Decision | None:
        """Returns the controller's decision from its last plan.

        None where there is no plan, or where it needs a new search.
        """
        previous = arguments.previous
        if previous is None or not self._can_continue(previous):
            return None
        decision = self._continue_or_keep(arguments, previous)
        costs = self._foresight.meter(decision.means, decision.inputs, question)
        if not decision.applicable or self._needs_new_search(costs, pursuit):
            return None
        states = decision.means
        next_pursuit = _Pursuit.of_plan(np.array(arguments.end), costs, states)
        if pursuit is not None:
            next_pursuit = pursuit.after_decision(costs, states)
        return _FollowedDecision.of(decision, next_pursuit)

    def _search_anew(
        self,
        arguments: _StepArguments,
        question: Question,
        pursuit: _Pursuit | None,
        current: ModelFlight | None,
    ) -> Decision:
        """Returns the decision along the cheapest flight of a search.

        ``current`` is what is left of the flight that was followed. Where no flight is
        found the decision is that of the best plan.
        """
        flight = self._search_flight(arguments, question, current)
        if flight is None:
            return self._search_plan(arguments)
        pursuit = _Pursuit.of_flight(
            goal=np.array(arguments.end),
            flight=flight,
            horizon=self.horizon,
            last=pursuit,
        )
        return self._decide_along(flight, pursuit, arguments, question)

    def _remaining_flight(
        self,
        flight: ModelFlight,
        pursuit: _Pursuit,
        arguments: _StepArguments,
        question: Question,
    ) -> ModelFlight:
        """Returns what is left of a flight, from the state that its stage led to.

        Where a disturbance made it dearer than it was to be, it is improved.
        """
        foresight = self._foresight
        remaining = foresight.follow(
            flight.after(1), arguments.state, question, pursuit.dearest
        )
        is_dearer = remaining.cost_sum.is_dearer(
            pursuit.remaining_after_stage, _DRIFT, pursuit.whole_cost
        )
        if remaining.arrives and is_dearer:
            remaining = foresight.improve(
                remaining, question, rounds=1, programs=_CORRECTIONS
            )
            remaining = foresight.with_gains(remaining, question)
        return remaining

    def _is_as_expected(self, flight: ModelFlight, pursuit: _Pursuit) -> bool:
        """Tells whether a flight costs what it was to, and arrives if it was to."""
        if flight.cost_sum.is_dearer(pursuit.remaining, _RISE, pursuit.whole_cost):
            return False
        return flight.arrives or not pursuit.arrives

    def _read_question(self, arguments: _StepArguments) -> Question:
        """Returns what the controller is asked on the way, beside its last plan."""
        previous = arguments.previous
        disturbance = None if previous is None else previous.disturbance
        return Question(
            covariance=arguments.belief.covariance,
            reference=arguments.reference,
            parameters=arguments.parameters,
            previous_input=self._input_before(previous),
            disturbance=disturbance,
        )

    def _last_pursuit(self, arguments: _StepArguments) -> _Pursuit | None:
        """Returns what the last decision left; None for another goal."""
        previous = arguments.previous
        if not isinstance(previous, _FollowedDecision) or previous.pursuit is None:
            return None
        # What a reference holds of a model's past moves on with it, and is no goal.
        n = self.problem.state_dim
        if not np.array_equal(previous.pursuit.goal[:n], arguments.end[:n]):
            return None
        return previous.pursuit.moved_to(previous, self.horizon)

    def _needs_new_search(self, costs: FlownCosts, pursuit: _Pursuit | None) -> bool:
        """Tells whether a plan with the costs of its stages is to be searched anew."""
        if pursuit is None:
            return not self._foresight.arrives(costs)
        if self._foresight.arrives(costs, pursuit.dearest):
            return False
        promised = pursuit.costs[1:]  # of the stages that both plans see
        is_dearer = (
            costs[: len(promised)]
            .sum()
            .is_dearer(promised.sum(), _RISE, pursuit.whole_cost)
        )
        return is_dearer or pursuit.age >= self._foresight.longest

    def _decide_along(
        self,
        flight: ModelFlight,
        pursuit: _Pursuit,
        arguments: _StepArguments,
        question: Question,
    ) -> Decision:
        """Returns the decision whose plan are the first stages of a flight."""
        means = flight.states[: self.horizon + 1]
        inputs = flight.inputs[: self.horizon]
        decision = self.controller.control(
            arguments.belief,
            self._nearest_turn(question.reference, means[-1]),
            arguments.previous,
            question.parameters,
            plan=(inputs, means),
        )
        followed = self._with_plan(
            decision, inputs, means, arguments.previous, question.parameters
        )
        return _FollowedDecision.of(followed, pursuit)

    def _search_flight(
        self, arguments: _StepArguments, question: Question, current: ModelFlight | None
    ) -> ModelFlight | None:
        """Returns the cheapest flight of all starts, under its feedback.

        ``current`` is what is left of the flight that was followed. None where the
        controller fails in every one.
        """
        search = _FlightSearch(
            self._foresight, question, self.controller, self._deadline()
        )
        if current is not None and current.costs.are_finite.all():
            search.add(current)
        for beginning in self._controller_beginnings(arguments):
            search.fly(beginning)
            if search.is_late:
                break
        for states, inputs in self._beginnings(arguments, question):
            if search.is_late:
                break
            search.fly(Trajectory(search.best_controller, states, inputs))
        best = search.best()
        if best is None:
            return None
        flight = self._foresight.follow(best, arguments.state, question)
        return flight if np.isfinite(flight.states).all() else None

    def _controller_beginnings(self, arguments: _StepArguments) -> Iterator[Trajectory]:
        """Makes beginnings of the controller by itself.

        That is from its last plan, without one, and with shorter horizons.
        """
        previous = arguments.previous
        present = arguments.state[None]
        nothing = np.empty((0, self.problem.input_dim))
        if previous is not None and self._can_continue(previous):
            yield Trajectory(self.controller, present, nothing, previous)
        for controller in (self.controller, *self._foresight.shorter):
            yield Trajectory(controller, present, nothing)

    def _beginnings(
        self, arguments: _StepArguments, question: Question
    ) -> Iterator[tuple[Array, Array]]:
        """Makes states and inputs of the plans of all starts, and of relays."""
        foresight = self._foresight
        state = arguments.state
        last_plan = _without_solution(arguments.previous)
        different: list[Array] = []
        for decision, _ in self.plans(
            arguments.belief, question.reference, last_plan, question.parameters
        ):
            inputs = decision.inputs
            states = decision.means
            if not decision.applicable:
                continue
            if any(self._are_alike(inputs, other) for other in different):
                continue
            different.append(inputs)
            if not self.planner.prediction.settings.rolled_out:
                try:
                    gains = self.planner.gains(decision, question.parameters)
                    states, inputs = foresight.roll_out(
                        states, inputs, gains, state, question
                    )
                except FAILURES:  # where the model has no slopes, or no numbers
                    continue
            if np.isfinite(states).all():
                yield states, inputs
        yield from foresight.relays(state, question)

    def _continue_or_keep(
        self, arguments: _StepArguments, previous: Decision
    ) -> Decision:
        """Returns the controller's decision from the last plan.

        Where that plan costs less, it is kept.
        """
        goal = self._nearest_turn(arguments.reference, previous.means[-1])
        shifted_inputs = one_step_on(previous.inputs)
        shifted_means = one_step_on(previous.means)
        decision = self.controller.control(
            arguments.belief,
            goal,
            previous,
            arguments.parameters,
            plan=(shifted_inputs, shifted_means),
        )

        def plan_cost(means: Array, inputs: Array) -> float:
            return self._plan_cost(
                means,
                inputs,
                goal,
                previous_input=self._input_before(previous),
                parameters=arguments.parameters,
            )

        limit = inf
        if decision.applicable:
            if self._has_tubes:
                return decision  # which the last plan, moved on, may have left
            limit = plan_cost(decision.means, decision.inputs) / (1.0 + _DEARER)
        # From the state itself it will hardly cost less: no roll-out is worth its time.
        if plan_cost(shifted_means, shifted_inputs) >= limit:
            return decision
        shifted = replace(
            previous,
            inputs=shifted_inputs,
            means=shifted_means,
            covariances=one_step_on(previous.covariances),
        )
        question = self._read_question(arguments._replace(reference=goal))
        try:
            gains = self.controller.gains(shifted, arguments.parameters)
            rolled_states, rolled_inputs = self._foresight.roll_out(
                shifted_means, shifted_inputs, gains, arguments.state, question
            )
        except FAILURES:  # where the model has no slopes, or no numbers
            return decision
        if plan_cost(rolled_states, rolled_inputs) < limit:
            return self._with_plan(
                decision, rolled_inputs, rolled_states, previous, arguments.parameters
            )
        return decision

    def _with_plan(
        self,
        decision: Decision,
        inputs: Array,
        means: Array,
        previous: Decision | None,
        parameters: Any,
    ) -> Decision:
        """Returns a decision for another plan, which is applicable.

        Its violation is that of its means, by constraints of all stages. Where the
        controller itself failed, its status says so, and the covariances are those of
        the last plan: they depend on the time since the last measurement.
        """
        covariances = decision.covariances
        if not decision.applicable:
            covariances = np.zeros((*means.shape, means.shape[1]))
            if previous is not None and self._can_continue(previous):
                covariances = previous.covariances
        changed = replace(
            decision,
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=covariances,
            stage_costs=np.empty(0),
            violation=self._foresight.meter.largest_excess(means, inputs, parameters),
            steps=(),
            plan_novelty=self.controller.novelty_when_read(means, inputs, covariances),
        )
        if decision.applicable:
            return changed
        return replace(changed, solution=None, suboptimal=True)

    def _nearest_turn(self, reference: Reference, end: Array) -> Reference:
        """Returns the turn of a reference whose end is nearest to a state (n,)."""
        turns = full_turns(end - reference.states[-1], self._angles)
        return turned(reference, turns)

    def _plan_cost(
        self,
        means: Array,
        inputs: Array,
        reference: Reference,
        previous_input: Array,
        parameters: Any,
    ) -> float:
        """Returns the cost of means (H + 1, n) and inputs (H, m), all included.

        That is what outputs and violated constraints cost, too. It is infinite where it
        is not finite.
        """
        reference_inputs = np.zeros_like(inputs)
        if reference.inputs is not None:
            reference_inputs = np.asarray(reference.inputs)
        targets = np.asarray(reference.states[1:])
        references = References(targets, reference_inputs, previous_input)
        cost = evaluate_cost(self._weights, means, inputs, references, 1.0)
        outputs, violations = self._foresight.meter.functions(means, inputs, parameters)
        cost += float(outputs.sum() + violations.sum())
        return cost if np.isfinite(cost) else inf

    def _deadline(self) -> float:
        """Returns the ``perf_counter`` after which no further start is taken."""
        return inf if self.budget is None else perf_counter() + self.budget

    def _cost(self, decision: Decision, reference: Reference) -> float:
        """Returns the cost of a decision's plan, its first increment left out.

        It is the ``criterion`` by default, for users that ask for it.
        """
        return self._plan_cost(
            decision.means,
            decision.inputs,
            reference,
            previous_input=decision.inputs[0],
            parameters=None,
        )

    def _judge(
        self,
        decision: Decision,
        goal: Reference,
        previous: Decision | None,
        parameters: Any,
    ) -> float:
        """Returns the criterion of a decision.

        It is infinite where the decision is not applicable, or beyond a hard bound.
        """
        if not decision.applicable:
            return inf
        if not self._judges_flights:
            value = self.criterion(decision, goal)
            return value if np.isfinite(value) else inf
        return self._plan_cost(
            decision.means,
            decision.inputs,
            goal,
            previous_input=self._input_before(previous),
            parameters=parameters,
        )

    def _input_before(self, previous: Decision | None) -> Array:
        """Returns the input (m,) of the last decision, or the one before the first."""
        if previous is None:
            return self.initial_input
        return np.asarray(previous.input, dtype=float)

    def _are_alike(self, inputs: Array, others: Array) -> bool:
        """Tells whether two plans are one, but for the tolerance of their solves.

        Each input (H, m) counts in its own range.
        """
        ranges = np.ptp(others, axis=0)
        lower, upper = self.problem.inputs.first
        still = np.where(np.isfinite(upper - lower), _STILL * (upper - lower), 0.0)
        tolerances = _ALIKE * np.maximum(ranges, still)
        return bool(np.allclose(inputs, others, atol=tolerances))


def _is_set_point(reference: Reference) -> bool:
    """Tells whether a reference (H + 1, n) stands still."""
    states = np.asarray(reference.states)
    if not (states == states[0]).all():
        return False
    if reference.inputs is None:
        return True
    inputs = np.asarray(reference.inputs)
    return bool((inputs == inputs[0]).all())


def _order(one: ModelFlight, other: ModelFlight) -> int:
    """Returns a number below zero where a flight is better than another."""
    return int(other.is_better_than(one)) - int(one.is_better_than(other))


def _without_solution(previous: Decision | None) -> Decision | None:
    """Returns a decision that no solve is warm-started from."""
    return None if previous is None else replace(previous, solution=None)
