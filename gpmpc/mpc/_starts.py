"""Searches for a plan from many starts: goals a full turn apart, and several first guesses towards each.

A program's solution is a local one. Where no plan is at hand that is worth improving, at the beginning or after a
disturbance, sequential programs are started from every pair of a goal and a guess, within a budget of time, and the
plan that a criterion likes best is followed from then on.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, product
from math import inf
from time import perf_counter
from typing import Any

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
)
from gpmpc.mpc._linear_quadratic import References, evaluate_cost
from gpmpc.mpc._stages import StageCosts, StageLinearizer
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Linearization

Criterion = Callable[[Decision, Reference], float]


class ManyStarts:
    """Improves the last plan as ``controller`` does; without one that is good enough, searches from many starts.

    Angles are those of the cost. The goal of a plan is the full turn of the reference that its end is nearest to.

    Args:
        controller: Of form ``"trajectory"``; takes every step from a plan.
        planner: Takes the starts; more programs a step than ``controller`` are of use. ``controller`` by default.
        guesses: Inputs (H, m) that a guess rolls out from the state, or None for a line from the state to the goal;
            by default the line and those of ``kicks``.
        turns: How many full turns of each angle count as goals, the nearest first; one number for all or one each.
        criterion: What of a plan is to be small, of the decision and the reference in its turns; by default its cost.
        limit: Value of the criterion above which a plan is given up for the best that a search finds.
        budget: Time after which no further start is taken, once a plan is found [s]; None for no limit.

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
        limit: float = inf,
        budget: float | None = None,
    ):
        self.controller, self.planner = (
            controller,
            controller if planner is None else planner,
        )
        for one in (self.controller, self.planner):
            if one.prediction.settings.form != "trajectory":
                raise SettingError(
                    "controller",
                    "must be of form 'trajectory', whose plans may start anywhere",
                )
        self.problem, self.horizon = controller.problem, controller.horizon
        self.initial_input = controller.initial_input
        self.signals = controller.signals
        H, m, angles = self.horizon, self.problem.input_dim, self.problem.cost.angles
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
        self.criterion = self._cost if criterion is None else criterion
        means = StageLinearizer(controller.prediction.model, Linearization(), "none")
        self._weights = StageCosts(self.problem, H, means).quadratic
        self.limit, self.budget = limit, budget

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
        best, lowest = None, inf
        if (
            previous is not None
            and previous.applicable
            and len(previous.means) == self.horizon + 1
        ):
            angles = self.problem.cost.angles
            belief = replace(
                belief,
                mean=belief.mean
                - torch.as_tensor(full_turns(state - previous.means[1], angles)),
            )
            goal = _moved(
                reference, full_turns(previous.means[-1] - reference.states[-1], angles)
            )
            shifted = tuple(
                np.concatenate([part[1:], part[-1:]])
                for part in (previous.inputs, previous.means)
            )
            best, lowest = self._try(
                self.controller, belief, goal, previous, parameters, shifted
            )
            if best.applicable and lowest <= self.limit:
                return best
        begin, last = (
            perf_counter(),
            None if previous is None else replace(previous, solution=None),
        )
        for decision, value in self.plans(belief, reference, last, parameters):
            if best is None or value < lowest:
                best, lowest = decision, value
            if (
                lowest < inf
                and self.budget is not None
                and perf_counter() - begin > self.budget
            ):
                break
        assert best is not None
        return best

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
        wanted = (
            np.zeros_like(decision.inputs)
            if reference.inputs is None
            else np.asarray(reference.inputs)
        )
        references = References(
            np.asarray(reference.states[1:]), wanted, decision.inputs[0]
        )
        return evaluate_cost(
            self._weights, decision.means, decision.inputs, references, 1.0
        )

    def _try(
        self, controller: GPMPC, belief: Gaussian, goal: Reference, *more: Any
    ) -> tuple[Decision, float]:
        """A controller's decision on its arguments, and its criterion: infinite where it is not applicable."""
        decision = controller.control(belief, goal, *more)
        value = self.criterion(decision, goal) if decision.applicable else inf
        return decision, value if np.isfinite(value) else inf

    def _candidates(
        self, state: Array, reference: Reference
    ) -> Iterator[tuple[Reference, tuple[Array, Array]]]:
        """Goals and guesses, inputs and states, guess by guess, the nearest goals first."""
        goals, H = list(self._goals(state, reference)), self.horizon
        for guess, goal in product(self.guesses, goals):
            if guess is None:
                shares, targets = np.linspace(1.0, 0.0, H + 1)[:, None], goal.states
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
        angles, moves = list(self.problem.cost.angles), []
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
    drift, length = (
        np.tile(np.asarray(initial_input, dtype=float), (horizon, 1)),
        max(1, horizon // 6),
    )
    found, bounds = [drift], (problem.inputs.upper, problem.inputs.lower)
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
