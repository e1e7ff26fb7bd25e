"""Sequential quadratic programming for plans whose states need not obey the dynamics yet (multiple shooting).

A program's solution is a step from one plan to the next. One step a control step is taken whole (the real-time
iteration of Diehl, Bock and Schloeder, 2005). Where more are taken, a step is as long as it lowers the exact penalty

    cost + price of violated rows + sum_k mu' |F(s_k, u_k) - s_{k+1}|

with mu above the multipliers of the dynamics (Nocedal and Wright, 2006, section 18.3). Beside each length stands a
second candidate: the dynamics rolled out under the feedback u = u' - K (x - x') towards the plan that the program
proposes. It has no defects, and exists where inputs alone would lead an unstable plant away.

A plan is judged by its relative offset (Bates and Watts, 1981): the Gauss-Newton step in the metric of the cost,
relative to the root of the cost, which is the cosine between the residuals and what a plan can change of them; and by
its defects, relative to the states. Gauss-Newton misses the curvature of the dynamics. Where that makes it creep, with
matched beliefs, damped BFGS updates put it into the program (Nocedal and Wright, 2006, procedure 18.2).
"""

import math
from collections import deque
from collections.abc import Iterator
from itertools import product

import numpy as np
import torch

from gpmpc._compiled import call_unchecked, compiled
from gpmpc._kernels.linalg import dot
from gpmpc.exceptions import DataError, ProblemError
from gpmpc.mpc._controller import Request
from gpmpc.mpc._linear_quadratic import (
    CondensedProgram,
    References,
    evaluate_cost,
    weight_of_stage,
)
from gpmpc.mpc._prediction import Prediction, PredictionModel
from gpmpc.mpc._stages import Plan, price_violations
from gpmpc.qp import QPSolution
from gpmpc.status import Status

Array = np.ndarray

_TORCH_FAILURE = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]
FAILURES = (
    DataError,
    ProblemError,
    np.linalg.LinAlgError,
    _TORCH_FAILURE,
)  # no finite numbers
_SUFFICIENT_DECREASE = 1e-4  # of what the program promised (Armijo)
_SHARES = [2.0**-k for k in range(11)]  # of a step
_ROUND_OFF = 1e-8  # share of the cost below which a difference says nothing: posteriors with sf2 >> y^2 lose that much
_NOISE = (
    1e-10  # the square of an offset that a model with that round-off need not get below
)
_SMALL = (
    1e-3  # share of an input's size whose cost counts where the cost itself vanishes
)
_MEMORY = 10  # updates of a Hessian
_NEAR = 0.2  # relative offset of plans near a solution: steps from further away mislead updates
_CREEP = 0.25  # ratio of two offsets above which the Hessian is updated


class Globalization:
    """Chooses the steps of one request's iteration, and says where it ends: at a tolerance of offset and defects."""

    def __init__(self, model: PredictionModel, request: Request, tolerance: float):
        self._model, self._request, self._tolerance = model, request, tolerance
        self._references = request.references
        R, bounds = model.costs.quadratic.input[0], model.problem.inputs.first
        self._smallest = call_unchecked(
            _smallest_cost, R, *bounds, self._references.previous_input
        )
        self._defect_prices, self._row_price = (
            np.zeros(model.costs.quadratic.terminal[:, 0].size),
            0.0,
        )
        self._size, self._rate, self._creeps = math.inf, 1.0, False
        self._updates: deque[tuple[Array, Array]] = deque(
            maxlen=_MEMORY
        )  # steps and changes of the gradient
        self._gradient = np.empty(0)  # of the cost at the plan of the last program
        self._last: tuple[Array, Array, Array] | None = (
            None  # inputs, gradient of the Lagrangian, multipliers
        )

    def correct(self, program: CondensedProgram, at: Prediction) -> CondensedProgram:
        """A program made at a plan, with the curvature that the last steps showed, where the iteration creeps."""
        if not self._updatable(program):
            return program
        plan = at.plan
        obeys = np.abs(at.stages.next - plan.states[1:]).max() <= 1e-9*max(1.0,np.abs(plan.states).max())
        inputs = plan.inputs.ravel()
        self._gradient = gradient = program.P @ inputs + program.q
        if self._last is not None:
            before, last_gradient, z = self._last
            if _NOISE < self._size**2 < _NEAR**2 and np.any(inputs != before) and self._obeys and obeys:
                self._updates.append(
                    (inputs - before, gradient + program.G.T @ z - last_gradient)
                )
        self._obeys = obeys
        if not (self._updates and self._creeps):
            return program
        P = program.P.copy()
        for step, change in self._updates:
            _update(P, step, change)
        return program._replace(P=P, q=gradient - P @ inputs)

    def __call__(
        self,
        at: Prediction,
        program: CondensedProgram,
        solution: QPSolution,
        proposed: Plan,
    ) -> tuple[Prediction, Status | None]:
        """The prediction at the next plan, and how the iteration ends: None where it goes on.

        The program was made at the prediction ``at``; ``proposed`` is the plan that its solution means.
        """
        plan, last_rate, prices = at.plan, self._rate, self._model.constraints.prices
        z = solution.z
        if self._updatable(program):
            gradient = self._gradient + program.G.T @ z if len(z) else self._gradient
            self._last = plan.inputs.ravel(), gradient, z
        z = z[len(z) - at.rows.lower.size :].reshape(at.rows.lower.shape)
        self._row_price = (
            max(self._row_price, 2.0 * float(np.abs(z).max()))
            if z.size
            else self._row_price
        )
        terms, stages = (
            (self._references, prices, self._row_price),
            (at.stages.A, at.stages.next),
        )
        found = call_unchecked(
            _assess,
            at.cost,
            terms,
            self._defect_prices,
            stages,
            at.rows,
            plan,
            proposed,
            z,
        )
        cost, curvature, promised, largest, merit, self._defect_prices = found
        size, first = (
            max(math.sqrt(curvature / (cost + self._smallest)), largest),
            math.isinf(self._size),
        )
        self._size, self._rate = (
            size,
            size / self._size if math.isfinite(self._size) else 1.0,
        )
        self._creeps = self._creeps or (not first and self._rate > _CREEP and _NOISE < size**2 < _NEAR**2)
        slower = max(
            self._rate, last_rate
        )  # the solution is better than the plan by about the slower of two rates
        settled = size**2 <= _NOISE and self._rate * last_rate > 0.5
        if (
            settled
            or size <= self._tolerance
            or size * slower <= self._tolerance * (1.0 - slower)
        ):
            return at._replace(plan=proposed), Status.SOLVED
        slope = promised - curvature - merit
        continued = (
            self._request.previous is not None and self._request.states is None
        )  # the last plan, one step on
        far = self._creeps or (size > _NEAR and not (first and continued))
        for length, trial in self._trials(at, plan, proposed, program.feedback, far):
            bound = (
                merit
                + _SUFFICIENT_DECREASE * length * min(slope, 0.0)
                + _ROUND_OFF * abs(merit)
            )
            rows = (
                trial.rows
                if self._model.constraints.smooth
                else at.rows._replace(E=trial.rows.E)
            )
            points = trial.stages.next, rows, trial.plan
            if size**2 <= _ROUND_OFF or (
                call_unchecked(_merit, trial.cost, terms, self._defect_prices, *points)
                <= bound
            ):
                return trial, None
        if size**2 <= _ROUND_OFF:  # size^2 of the cost is what could still be gained
            return at._replace(plan=proposed), Status.SOLVED
        return at, Status.NUMERICAL_TROUBLE

    def _updatable(self, program: CondensedProgram) -> bool:
        """Whether steps are remembered: where covariances make it creep; plans of means come from too far away."""
        return not len(program.feedback)

    def _trials(
        self, at: Prediction, plan: Plan, proposed: Plan, feedback: Array, far: bool
    ) -> Iterator[tuple[float, Prediction]]:
        """Shares of the step to a proposed plan; predictions at the plan that obeys the dynamics and at the plan there.

        Far from a solution the first of these leads further; and it comes first where moments are linearised, since
        they overshoot. Means are linearised at once near a solution, as a first step from the last plan is taken to
        be: the plan there will be taken.
        """
        model, request = self._model, self._request
        for share, first in product(_SHARES, (True, False)):
            towards = _between(plan, proposed, share)
            try:
                if first is (far or not model.linearizer.at_points):
                    yield share, model.roll_out(towards, at, feedback, request)
                else:
                    yield share, model.linearize(model.canonical(towards), request)
            except FAILURES:  # a trial plan may lead the model out of its numbers
                continue


def _between(plan: Plan, other: Plan, share: float) -> Plan:
    return (
        other
        if share == 1.0
        else Plan(*(a + share * (b - a) for a, b in zip(plan, other, strict=True)))
    )


@compiled
def _smallest_cost(R, lower, upper, last):
    """The cost of an input that is small beside the last one: of the cheapest."""
    least = np.inf
    for j in range(len(R)):
        size = min(max(1.0, abs(last[j])), upper[j] - lower[j]) * _SMALL
        least = min(least, R[j, j] * size * size)
    return least + 1e-300


@compiled
def _assess(cost, terms, defect_prices, stages, rows, plan, proposed, z):
    """What a step from a plan to a proposed one promises.

    Returns cost with price of violated rows at the plan, curvature of the step in the cost, cost with price promised,
    the largest defect relative to the states, merit of the plan under new prices of defects, and these prices (p,).
    """
    (references, prices, row_price), (A, after) = terms, stages
    zero = References(
        0.0 * references.states,
        0.0 * references.inputs,
        0.0 * references.previous_input,
    )
    (H, p), reach, largest, defects, new = (
        after.shape,
        1.0,
        0.0,
        np.zeros(after.shape[1]),
        defect_prices.copy(),
    )
    for k in range(H):
        for i in range(p):
            reach = max(reach, abs(plan.states[k + 1, i]))
            defects[i] += abs(after[k, i] - plan.states[k + 1, i])
            largest = max(largest, abs(after[k, i] - plan.states[k + 1, i]))
    here = evaluate_cost(cost, plan.states, plan.inputs, references, 1.0)
    here += price_violations(prices, rows, plan, row_price)
    curvature = evaluate_cost(
        cost, proposed.states - plan.states, proposed.inputs - plan.inputs, zero, 0.0
    )
    promised = evaluate_cost(cost, proposed.states, proposed.inputs, references, 1.0)
    promised += price_violations(prices, rows, proposed, row_price)
    costates = _costates(cost, A, proposed, references.states, rows.E, z)
    for k in range(H):
        for i in range(p):
            new[i] = max(new[i], 1.5 * abs(costates[k, i]))
    return here, curvature, promised, largest / reach, here + dot(defects, new, p), new


@compiled
def _merit(cost, terms, defect_prices, after, rows, plan):
    """The exact penalty function at a plan, within the bounds of ``rows``."""
    references, prices, row_price = terms
    merit = evaluate_cost(cost, plan.states, plan.inputs, references, 1.0)
    merit += price_violations(prices, rows, plan, row_price)
    for k in range(len(after)):
        for i in range(after.shape[1]):
            merit += defect_prices[i] * abs(after[k, i] - plan.states[k + 1, i])
    return merit


@compiled
def _costates(cost, A, plan, targets, E, z):
    """Multipliers of the dynamics (H, p): the derivatives of cost and rows by s_1 .. s_H, through all that follows."""
    states, inputs, (H, n), Z = plan.states, plan.inputs, targets.shape, cost.squares
    p, m = states.shape[1], inputs.shape[1]
    costates = np.zeros((H, p))
    for k in range(H - 1, -1, -1):
        weight, out, rows = (
            weight_of_stage(cost, k, H),
            costates[k],
            E[min(k, len(E) - 1)],
        )
        for i in range(n if len(Z) > 0 else 0):
            out[i] += 2.0 * (
                dot(Z[k, i], states[k + 1], n)
                + dot(Z[k, i, n:], inputs[k], m)
                + Z[k, i, n + m]
            )
        for i in range(p):
            for j in range(n):
                error = states[k + 1, i // n * n + j] - (
                    targets[k, j] if i < n else 0.0
                )
                out[i] += 2.0 * weight[i // n, i % n, j] * error
            for e in range(len(rows)):
                out[i] += rows[e, i] * z[k, e]
            if k < H - 1:
                for j in range(p):
                    out[i] += A[k + 1, j, i] * costates[k + 1, j]
    return costates


def _update(P: Array, step: Array, change: Array) -> None:
    """Updates P towards P step = change, damped so that it stays positive definite (Powell, 1978)."""
    moved = P @ step
    found, curvature, share = step @ change, step @ moved, 1.0
    if found < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - found)
    damped = share * change + (1.0 - share) * moved
    P += np.outer(damped, damped) / (step @ damped) - np.outer(moved, moved) / curvature
