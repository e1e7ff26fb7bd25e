"""Goals and first guesses that a search starts from."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import (
    SettingError,
    ShapeError,
    check_kind,
    check_number,
    check_numbers,
)
from gpmpc.mpc._controller import Array, Reference
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.mpc.problem import Problem


class Start(NamedTuple):
    """A goal, and a first guess of the plan that leads to it."""

    goal: Reference  # the reference in one of its turns
    inputs: Array  # (H, m)
    states: Array  # (H + 1, n)


class Starts:
    """Every pair of a goal and a guess.

    Args:
        planner: It is to plan from them.
        guesses: Inputs (H, m), or None for a line from the state to the goal.
        turns: How many full turns of each angle count as goals.

    Raises:
        SettingError: Turns that are no positive numbers, one for each angle.
        ShapeError: Guesses of another shape.
    """

    def __init__(
        self,
        planner: GPMPC,
        guesses: Sequence[Array | None],
        turns: int | Sequence[int],
    ):
        self._planner = planner
        self._angles = list(planner.prediction.problem.cost.angle_indices)
        H = planner.horizon
        m = planner.prediction.problem.input_dim
        shapes = [np.shape(guess) for guess in guesses if guess is not None]
        if any(shape != (H, m) for shape in shapes):
            raise ShapeError(f"guesses must be None or inputs ({H}, {m}); got {shapes}")
        self.guesses = guesses
        count = len(self._angles)
        numbers = list(turns) if isinstance(turns, Sequence) else [turns] * count
        are_whole = all(isinstance(number, int) and number > 0 for number in numbers)
        if len(numbers) != count or not are_whole:
            rule = f"must be whole numbers from 1 on, one for each of {count} angles"
            raise SettingError("turns", f"{rule}; got {turns!r}")
        self.turns = numbers

    def __len__(self) -> int:
        return len(self.guesses) * math.prod(self.turns)

    def of(self, state: Array, reference: Reference) -> Iterator[Start]:
        """Makes the starts at a state, guess by guess, the nearest goals first."""
        goals = list(self.goals(state, reference))
        for guess, goal in product(self.guesses, goals):
            if guess is None:
                yield self._line(state, goal)
            else:
                inputs = np.asarray(guess, dtype=float)
                try:
                    states = self._planner.prediction.lead(state, inputs)
                except FAILURES:  # it leads the model out of its numbers
                    continue
                yield Start(goal, inputs=guess, states=states)

    def _line(self, state: Array, goal: Reference) -> Start:
        """Returns a guess that moves from a state to the goal in a line."""
        H = self._planner.horizon
        offset = state - goal.states[0]
        states = goal.states + np.linspace(1.0, 0.0, H + 1)[:, None] * offset
        inputs = np.tile(self._planner.initial_input, (H, 1))
        return Start(goal, inputs=inputs, states=states)

    def goals(self, state: Array, reference: Reference) -> Iterator[Reference]:
        """Makes the turns of a reference whose ends are nearest to a state."""
        end = reference.states[-1]
        turns_by_angle = []
        for angle, count in zip(self._angles, self.turns, strict=True):
            distance = (state[angle] - end[angle]) / (2 * np.pi)  # in full turns
            lowest = int(np.floor(distance)) - count
            highest = int(np.ceil(distance)) + count
            candidates = np.arange(lowest, highest + 1)
            order = np.argsort(np.abs(candidates - distance), kind="stable")
            turns_by_angle.append(candidates[order[:count]].tolist())
        choices = list(product(*turns_by_angle))
        turns = np.zeros((len(choices), len(state)))
        counts = np.array(choices).reshape(len(choices), len(self._angles))
        turns[:, self._angles] = 2 * np.pi * counts
        distances = np.abs(state - end - turns)[:, self._angles].sum(axis=1)
        for i in np.argsort(distances, kind="stable"):
            yield turned(reference, turns[i])


def turned(reference: Reference, turns: Array) -> Reference:
    """Returns a reference, moved by full turns (n,) of its angles."""
    states = np.asarray(reference.states, dtype=float)
    return replace(reference, states=states + turns)


@explains_arguments
def kicks(
    problem: Problem, horizon: int, initial_input: Array, share: float = 0.5
) -> list[Array]:
    """Returns guesses of inputs (H, m) that push the plant to and fro.

    The first holds the initial input; for each bounded input that is not
    locked follow a push and a pull,
    and a pull and a push, of H/6 stages each.

    Args:
        problem: With bounds of the inputs.
        horizon: H.
        initial_input: Where all inputs begin and end (m,).
        share: How far a push goes, of the way from the initial input to its bounds.

    >>> from gpmpc.mpc import Box, Problem, Tracking
    >>> problem = Problem(Tracking([1.0], [1.0]), inputs=Box([-2.0], [2.0]))
    >>> guesses = kicks(problem, horizon=4, initial_input=[0.0])
    >>> guesses[0].shape
    (4, 1)

    See Also:
        ``ManyStarts``, which searches from them.
    """
    check_kind("problem", problem, Problem, "Problem(...)")
    check_number("horizon", horizon, least=1, whole=True)
    check_numbers("initial_input", initial_input, problem.input_dim)
    drift = np.tile(np.asarray(initial_input, dtype=float), (horizon, 1))
    length = max(1, horizon // 6)
    lower, upper = problem.inputs.first
    guesses = [drift]
    for j, (first, second) in product(
        range(problem.input_dim), ((upper, lower), (lower, upper))
    ):
        room = abs(first[j] - second[j])
        if room == 0.0 or not np.isfinite(room):
            continue
        inputs = drift.copy()
        inputs[:length, j] += share * (first[j] - initial_input[j])
        inputs[length : 2 * length, j] += share * (second[j] - initial_input[j])
        guesses.append(inputs)
    return guesses
