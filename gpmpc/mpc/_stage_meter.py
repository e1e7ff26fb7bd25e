"""The costs of stages as they are paid, one by one, over any number of stages.

The stage costs of a decision (``Decision.stage_costs``) are those of its program: with
the weights of H stages, the terminal one at the end, and spreads. What is flown on has
more stages than that and no end, so each is weighed here as the first one of a program.

What is weighed and what is violated stand apart: beside an exact price of 1e6 weights
nothing else would be seen, where shares of a cost are compared.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc.mpc._constraints import ConstraintRows
from gpmpc.mpc._controller import FEASIBLE, KEPT
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._linear_quadratic import Plan
from gpmpc.mpc._question import Question, first_weight, hold_last, rows_over
from gpmpc.mpc.problem import Problem

Array = np.ndarray


class CostSum(NamedTuple):
    """What many stages cost together."""

    weighed: float  # errors, outputs and inputs
    violations: float  # of soft constraints
    beyond: int  # stages beyond a hard bound, which have no price

    @property
    def total(self) -> float:
        """All that has a price."""
        return self.weighed + self.violations

    def less(self, other: "CostSum") -> "CostSum":
        """Returns what is left after other stages were paid."""
        return CostSum(
            weighed=self.weighed - other.weighed,
            violations=self.violations - other.violations,
            beyond=self.beyond - other.beyond,
        )

    def largest(self, other: "CostSum") -> "CostSum":
        """Returns the larger one of each part."""
        return CostSum(
            weighed=max(self.weighed, other.weighed),
            violations=max(self.violations, other.violations),
            beyond=max(self.beyond, other.beyond),
        )

    def is_dearer(self, expected: "CostSum", share: float, whole: "CostSum") -> bool:
        """Tells whether it is above what was expected, by more than a share of a whole.

        What is weighed counts against what is weighed of the whole, and violations
        against violations: neither is lost beside the other.
        """
        if self.beyond > expected.beyond:
            return True
        # What moves from one of the two parts to the other makes nothing dearer.
        rises_altogether = self.total - expected.total > share * whole.weighed
        if not rises_altogether:
            return False
        weighed_rises = self.weighed - expected.weighed > share * whole.weighed
        violation_rise = self.violations - expected.violations
        return weighed_rises or violation_rise > share * whole.violations


@dataclass(frozen=True)
class FlownCosts:
    """What each stage of a trajectory costs, in parts."""

    errors: Array  #: of states and outputs (L,)
    inputs: Array  #: (L,)
    violations: Array  #: of constraints (L,); infinite beyond a hard bound

    def __len__(self) -> int:
        return len(self.errors)

    def __getitem__(self, stages: slice) -> "FlownCosts":
        return FlownCosts(
            errors=self.errors[stages],
            inputs=self.inputs[stages],
            violations=self.violations[stages],
        )

    @classmethod
    def joined(cls, parts: "list[FlownCosts]") -> "FlownCosts":
        """Returns those of trajectories one behind the other."""
        return cls(
            errors=np.concatenate([part.errors for part in parts]),
            inputs=np.concatenate([part.inputs for part in parts]),
            violations=np.concatenate([part.violations for part in parts]),
        )

    @classmethod
    def unknown(cls, count: int) -> "FlownCosts":
        """Returns those of stages that cannot be flown."""
        return cls(
            errors=np.zeros(count),
            inputs=np.zeros(count),
            violations=np.full(count, np.inf),
        )

    @property
    def weighed(self) -> Array:
        """Of each stage without its violations (L,)."""
        return self.errors + self.inputs

    @property
    def total(self) -> Array:
        """Of each stage (L,)."""
        return self.weighed + self.violations

    @property
    def are_finite(self) -> Array:
        """Which stages have a price (L,): those that keep hard bounds."""
        return np.isfinite(self.total)

    @property
    def dearest(self) -> float:
        """What the dearest stage weighs of those that keep hard bounds; 0 without."""
        return float(self.weighed[self.are_finite].max(initial=0.0))

    def sum(self) -> CostSum:
        """Returns what all stages cost."""
        finite = self.are_finite
        return CostSum(
            weighed=float(self.weighed[finite].sum()),
            violations=float(self.violations[finite].sum()),
            beyond=int((~finite).sum()),
        )


class _Horizon(NamedTuple):
    """As many stages of a trajectory as a controller's horizon has."""

    first: int  # its first stage in the trajectory
    next_states: Array  # (H, n)
    inputs: Array  # (H, m)
    parameters: Any  # (H, q); None without any


class StageMeter:
    """Measures what stages cost, outputs and violated constraints included.

    Weights, references of outputs and bounds are those of the first stage, wherever a
    stage stands: what is weighed at the end alone is left out, unless the first stage
    weighs nothing. Angles count within half a turn. Constraints of a part of the
    horizon only do not count.
    """

    def __init__(self, problem: Problem, horizon: int):
        cost = problem.cost
        self._cost = replace(cost, Q=first_weight(cost.Q), R=first_weight(cost.R))
        self._horizon = horizon
        self._outputs = [
            replace(
                output,
                weight=first_weight(output.weight),
                reference=np.atleast_2d(output.reference)[0],
            )
            for output in problem.outputs
        ]
        self._rows = ConstraintRows(problem, horizon, "none")
        self._always = self._rows.applies.all(axis=0)
        self._declared = np.ones(self._rows.per_stage, dtype=bool)  # not linearised
        for smooth in self._rows.smooth_rows:
            self._declared[smooth.columns] = False

    def __call__(self, states: Array, inputs: Array, question: Question) -> FlownCosts:
        """Returns the costs of states (L + 1, n) and inputs (L, m).

        The reference is that of the question; beyond its end it stands still.
        """
        count = len(inputs)
        reference = question.reference
        reference_inputs = None
        if reference.inputs is not None:
            reference_inputs = hold_last(np.asarray(reference.inputs), count)
        paid = self._cost.paid_parts(
            states=states,
            inputs=inputs,
            references=hold_last(np.asarray(reference.states), count + 1),
            previous_input=question.previous_input,
            reference_inputs=reference_inputs,
        )
        outputs, violations = self.functions(states, inputs, question.parameters)
        return FlownCosts(
            errors=paid.states + outputs, inputs=paid.inputs, violations=violations
        )

    def functions(
        self, states: Array, inputs: Array, parameters: Any
    ) -> tuple[Array, Array]:
        """Returns the costs of outputs (L,) and of violated constraints (L,).

        They are evaluated for a horizon at a time; see ``__call__``. Where a function
        or its slope is not finite, a horizon's violations are infinite.
        """
        count = len(inputs)
        outputs = np.zeros(count)
        violations = np.zeros(count)
        if not (self._outputs or self._rows.per_stage):
            return outputs, violations
        for stages in self._horizons(states, inputs, parameters):
            first = stages.first
            end = min(first + self._horizon, count)
            try:
                output_costs = self._output_costs(stages)
                violation_costs = self._violations(stages)
            except FunctionNotFinite:
                output_costs = np.zeros(self._horizon)
                violation_costs = np.full(self._horizon, np.inf)
            outputs[first:end] = output_costs[: end - first]
            violations[first:end] = violation_costs[: end - first]
        return outputs, violations

    def largest_excess(self, states: Array, inputs: Array, parameters: Any) -> float:
        """Returns by how much constraints are missed at most, in their own units.

        NaN where a function or its slope is not finite.
        """
        if not self._always.any():
            return 0.0
        try:
            return max(
                float(self._excess(stages).max())
                for stages in self._horizons(states, inputs, parameters)
            )
        except FunctionNotFinite:
            return math.nan

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
        """Returns the prices of violated constraints (H,), infinite of hard ones.

        Soft ones count from where they are no longer kept: at an exact price, rounding
        would cost more than the rest of a plan.
        """
        if not self._rows.per_stage:
            return np.zeros(self._horizon)
        excess = self._excess(stages)
        prices = self._rows.prices[self._always]
        hard = np.isinf(prices)
        costs = (excess[:, ~hard] - KEPT).clip(0.0) @ prices[~hard]
        costs[(excess[:, hard] > FEASIBLE).any(axis=1)] = np.inf
        return costs

    def _excess(self, stages: _Horizon) -> Array:
        """Returns by how much constraints of all stages are missed (H, r)."""
        states = stages.next_states
        inputs = stages.inputs
        n = states.shape[1]
        certain = np.zeros((self._horizon + 1, n, n))
        # No row is of x_0: any state may stand in its place.
        plan = Plan(np.vstack([states[:1], states]), inputs, certain)
        rows = self._rows.at(plan, certain, 1, stages.parameters)
        E = np.broadcast_to(rows.E, (self._horizon, *rows.E.shape[1:]))
        values = np.einsum("kri,ki->kr", E, states)
        if len(rows.D):
            values += np.einsum("kri,ki->kr", rows.D, inputs)
        lower = np.where(self._declared, rows.lower[:1], rows.lower)
        upper = np.where(self._declared, rows.upper[:1], rows.upper)
        excess = np.maximum(values - upper, lower - values).clip(0.0)
        return excess[:, self._always]
