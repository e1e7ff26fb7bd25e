"""The costs of stages as they are paid, one by one, over any number of stages.

The stage costs of a decision (``Decision.stage_costs``) are those of its program: with
the weights of H stages, the terminal one at the end, and spreads. What is flown on has
more stages than that and no end, so each is weighed here as the first one of a program.
"""

from typing import Any

import numpy as np

from gpmpc.mpc._constraints import ConstraintRows
from gpmpc.mpc._controller import FEASIBLE
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._linear_quadratic import Plan
from gpmpc.mpc._question import Question, hold_last, rows_over
from gpmpc.mpc.problem import Problem

Array = np.ndarray


class StageMeter:
    """Costs of stages as they are paid, outputs and violated constraints included.

    Weights are those of the first stage, wherever a stage stands; angles count within
    half a turn. Constraints of a part of the horizon only do not count.
    """

    def __init__(self, problem: Problem, horizon: int):
        self._problem = problem
        self._horizon = horizon
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
        if not (self._problem.outputs or self._rows.per_stage):
            return costs
        H = self._horizon
        next_states = states[1:]
        for first in range(0, count, H):
            end = min(first + H, count)
            chunk_states = hold_last(next_states[first:end], H)
            chunk_inputs = hold_last(inputs[first:end], H)
            chunk_parameters = None
            if parameters is not None:
                chunk_parameters = rows_over(parameters, first + H)[first:]
            try:
                chunk = self._outputs(chunk_states, chunk_inputs, chunk_parameters)
                chunk += self._violations(chunk_states, chunk_inputs, chunk_parameters)
            except FunctionNotFinite:
                chunk = np.full(H, np.inf)
            costs[first:end] = chunk[: end - first]
        return costs

    def _outputs(self, states: Array, inputs: Array, parameters: Any) -> Array:
        """Returns the costs of outputs at next states (H, n) and inputs (H, m)."""
        points = np.hstack([states, inputs, np.ones((self._horizon, 1))])
        costs = np.zeros(self._horizon)
        for output in self._problem.outputs:
            squares = output.squares(states, inputs, parameters)
            costs += np.einsum("ki,kij,kj->k", points, squares, points)
        return costs

    def _violations(self, states: Array, inputs: Array, parameters: Any) -> Array:
        """Returns the prices of violated constraints (H,), infinite of hard ones."""
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
        excess = np.maximum(values - rows.upper, rows.lower - values).clip(0.0)
        excess = excess[:, self._always]
        prices = self._rows.prices[self._always]
        hard = np.isinf(prices)
        costs = excess[:, ~hard] @ prices[~hard]
        costs[(excess[:, hard] > FEASIBLE).any(axis=1)] = np.inf
        return costs
