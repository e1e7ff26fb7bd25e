"""The costs of stages as they are paid, one by one, over any number of stages.

The stage costs of a decision (``Decision.stage_costs``) are those of its program: with
the weights of H stages, the terminal one at the end, and spreads. What is flown on has
more stages than that and no end, so each is weighed here as the first one of a program.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc.mpc._constraints import ConstraintRows
from gpmpc.mpc._controller import FEASIBLE
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._linear_quadratic import Plan
from gpmpc.mpc._question import Question, first_weight, hold_last, rows_over
from gpmpc.mpc.problem import Problem

Array = np.ndarray


class _Horizon(NamedTuple):
    """As many stages of a trajectory as a controller's horizon has."""

    first: int  # its first stage in the trajectory
    next_states: Array  # (H, n)
    inputs: Array  # (H, m)
    parameters: Any  # (H, q); None without any


class StageMeter:
    """Costs of stages as they are paid, outputs and violated constraints included.

    Weights are those of the first stage, wherever a stage stands, of outputs as well:
    what is weighed at the end alone is left out. Angles count within half a turn.
    Constraints of a part of the horizon only do not count.
    """

    def __init__(self, problem: Problem, horizon: int):
        self._problem = problem
        self._horizon = horizon
        self._outputs = [
            replace(output, weight=first_weight(output.weight))
            for output in problem.outputs
        ]
        self._rows = ConstraintRows(problem, horizon, "none")
        self._always = self._rows.applies.all(axis=0)

    def __call__(self, states: Array, inputs: Array, question: Question) -> Array:
        """Returns the costs (L,) of states (L + 1, n) and inputs (L, m).

        They are infinite beyond a hard bound. The reference is that of the question;
        beyond its end it stands still.
        """
        count = len(inputs)
        reference = question.reference
        reference_inputs = None
        if reference.inputs is not None:
            reference_inputs = hold_last(np.asarray(reference.inputs), count)
        costs = self._problem.cost.paid(
            states=states,
            inputs=inputs,
            references=hold_last(np.asarray(reference.states), count + 1),
            previous_input=question.previous_input,
            reference_inputs=reference_inputs,
        )
        costs += self.functions(states, inputs, question.parameters)
        return costs

    def functions(self, states: Array, inputs: Array, parameters: Any) -> Array:
        """Returns the costs of outputs and of violated constraints (L,).

        They are evaluated for a horizon at a time; see ``__call__``. Where a function
        or its slope is not finite, a horizon's costs are infinite.
        """
        count = len(inputs)
        costs = np.zeros(count)
        if not (self._outputs or self._rows.per_stage):
            return costs
        for stages in self._horizons(states, inputs, parameters):
            first = stages.first
            end = min(first + self._horizon, count)
            try:
                chunk = self._output_costs(stages) + self._violations(stages)
            except FunctionNotFinite:
                chunk = np.full(self._horizon, np.inf)
            costs[first:end] = chunk[: end - first]
        return costs

    def output_weights(self, states: Array, inputs: Array, parameters: Any) -> Array:
        """Returns the weights Z (L, n + m + 1, n + m + 1) of [x_{k+1}; u_k; 1].

        They are those of the outputs, linearised along states (L + 1, n) and inputs
        (L, m); zero where these are not finite.
        """
        count = len(inputs)
        size = states.shape[1] + inputs.shape[1] + 1
        weights = np.zeros((count, size, size))
        if not self._outputs:
            return weights
        for stages in self._horizons(states, inputs, parameters):
            first = stages.first
            end = min(first + self._horizon, count)
            with suppress(FunctionNotFinite):
                weights[first:end] = self._squares(stages)[: end - first]
        return weights

    def _horizons(
        self, states: Array, inputs: Array, parameters: Any
    ) -> Iterator[_Horizon]:
        """Makes the stages of a trajectory, a horizon at a time, the last one held."""
        H = self._horizon
        next_states = states[1:]
        for first in range(0, len(inputs), H):
            own_parameters = None
            if parameters is not None:
                own_parameters = rows_over(parameters, first + H)[first:]
            yield _Horizon(
                first=first,
                next_states=hold_last(next_states[first : first + H], H),
                inputs=hold_last(inputs[first : first + H], H),
                parameters=own_parameters,
            )

    def _squares(self, stages: _Horizon) -> Array:
        """Returns the weights of all outputs (H, n + m + 1, n + m + 1)."""
        squares: Any = 0.0
        for output in self._outputs:
            squares = squares + output.squares(
                stages.next_states, stages.inputs, stages.parameters
            )
        return squares

    def _output_costs(self, stages: _Horizon) -> Array:
        """Returns the costs of outputs (H,)."""
        if not self._outputs:
            return np.zeros(self._horizon)
        ones = np.ones((self._horizon, 1))
        points = np.hstack([stages.next_states, stages.inputs, ones])
        return np.einsum("ki,kij,kj->k", points, self._squares(stages), points)

    def _violations(self, stages: _Horizon) -> Array:
        """Returns the prices of violated constraints (H,), infinite of hard ones."""
        if not self._rows.per_stage:
            return np.zeros(self._horizon)
        states = stages.next_states
        inputs = stages.inputs
        n = states.shape[1]
        certain = np.zeros((self._horizon + 1, n, n))
        plan = Plan(np.vstack([states[:1], states]), inputs, certain)
        rows = self._rows.at(plan, certain, 1, stages.parameters)
        E = np.broadcast_to(rows.E, (self._horizon, *rows.E.shape[1:]))
        values = np.einsum("kri,ki->kr", E, states)
        if len(rows.D):
            values += np.einsum("kri,ki->kr", rows.D, inputs)
        excess = np.maximum(values - rows.upper, rows.lower - values).clip(0.0)
        excess = excess[:, self._always]
        prices = self._rows.prices[self._always]
        hard = np.isinf(prices)
        costs = excess[:, ~hard] @ prices[~hard]
        costs[(excess[:, hard] > FEASIBLE).any(axis=1)] = np.inf
        return costs
