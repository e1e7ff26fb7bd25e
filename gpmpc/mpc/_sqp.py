"""Sequential quadratic programming for plans whose states need not obey the dynamics yet (multiple shooting).

A program's solution is a step from one plan to the next. One step a control step is taken whole (the real-time
iteration of Diehl, Bock and Schloeder, 2005). Where more are taken, a step is as long as it lowers the exact penalty

    cost + price of violated rows + sum_k mu' |F(s_k, u_k) - s_{k+1}|

with mu above the multipliers of the dynamics (Nocedal and Wright, 2006, section 18.3). Beside each length stands a
second candidate: the dynamics rolled out under the feedback u = u' - K (x - x') towards the plan that the program
proposes. It has no defects, and exists where inputs alone would lead an unstable plant away.

A plan is judged by its relative offset (Bates and Watts, 1981): the Gauss-Newton step in the metric of the cost,
relative to the root of the cost, which is the cosine between the residuals and what a plan can change of them; and by
its defects, relative to the states. Gauss-Newton misses the curvature of the dynamics. Where that makes it creep,
damped BFGS updates put it into the program (Nocedal and Wright, 2006, procedure 18.2). They are made of plans that
obey the dynamics, whose gradients are those of the problem: an iteration that creeps goes on along roll-outs.
"""

import math
from collections import deque
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
import torch

from gpmpc._compiled import compiled, njit_inner
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
_STEP_LENGTHS = [2.0**-k for k in range(11)]
# Share of the cost below which a difference says nothing: posteriors with
# sf2 >> y^2 lose that much.
_ROUND_OFF = 1e-8
# The square of an offset that a model with that round-off need not get below.
_NOISE = 1e-10
# Share of an input's size whose cost counts where the cost itself vanishes.
_SMALL = 1e-3
_MEMORY = 10  # updates of a Hessian
# Relative offset of plans near a solution: steps from further away mislead updates.
_NEAR = 0.2
_CREEP = 0.25  # ratio of two offsets above which the Hessian is updated
_STALL = 0.5  # what two steps leave of an offset that is lost in rounding
_OBEYS = 1e-9  # defects, relative to the states, of a plan that was rolled out
# How much further than the last step a step may lead, squared, to count as one more
# of the same kind; and the share of the cost below which that does not matter.
_FURTHER = 4.0
_SLIGHT = 1e-3
_NEARLY = 5.0  # tolerances, within which an iteration that stalls has arrived
_TINY = 1e-300


class StepForecast(NamedTuple):
    """What the step from a plan to a proposed one promises."""

    cost: float  # of the plan, with the price of its violated rows
    promised: float  # likewise of the proposed plan, as the program sees it
    curvature: float  # of the step in the cost: its length, squared
    defect: float  # the largest of the plan, relative to the states
    merit: float  # of the plan, under the new prices of defects
    defect_prices: Array  # above the multipliers of the dynamics (p,)


class Continuity(NamedTuple):
    """Whether a program's step is one more along the last plan."""

    continues: bool
    step: float  # its length in the metric of the cost, squared


class StepMeasures(NamedTuple):
    """How far a program led from the plan that it was made at."""

    cost: float  # of the plan, with the price of its violated rows
    step: float  # the step's length in the metric of the cost, squared


class PriceTerms(NamedTuple):
    """What costs are reckoned with besides their weights."""

    references: References
    prices: Array  # of violated rows (r,), infinite for hard ones
    row_price: float  # of those


def measure_continuity(
    model: PredictionModel,
    request: Request,
    prediction: Prediction,
    proposed: Plan,
    prices: Array,
) -> Continuity:
    """Whether a step is one more along the last plan, and how long it is.

    Then one program is enough, as in the real-time iteration. A step that leads much
    further than the last one, and is not slight beside the cost, answers a jump of the
    reference or of the state. On plants that bend much, the plans of one program a step
    are not consistent; iterating each of them is slower and, on swing-ups, no better.
    """
    measures = _measure_step.unchecked(
        prediction.cost,
        PriceTerms(request.references, prices, 0.0),
        prediction.rows,
        prediction.plan,
        proposed,
    )
    step = measures.step
    last_steps = () if request.previous is None else request.previous.steps
    if len(last_steps) == 0:
        return Continuity(continues=True, step=step)
    slight = _SLIGHT * (measures.cost + smallest_cost(model, request))
    continues = step <= max(slight, _FURTHER * last_steps[0])
    return Continuity(continues=continues, step=step)


def smallest_cost(model: PredictionModel, request: Request) -> float:
    """What an input costs that is small beside the last one: the cheapest of them."""
    lower, upper = model.problem.inputs.first
    return _smallest_cost.unchecked(
        model.costs.quadratic.input[0],
        lower,
        upper,
        request.references.previous_input,
    )


class Iteration:
    """Chooses the steps of one request's iteration, and says where it ends: at a tolerance of offset and defects."""

    def __init__(
        self,
        model: PredictionModel,
        request: Request,
        tolerance: float,
        prices: Array,
    ):
        self._prices = prices
        self._model = model
        self._request = request
        self._tolerance = tolerance
        self._smallest = smallest_cost(model, request)
        self._defect_prices = np.zeros(model.costs.quadratic.terminal[:, 0].size)
        self._row_price = 0.0
        self._size = math.inf  # of the last step, relative; see the module's text
        self._rate = 1.0  # of two sizes
        self._creeps = False
        self.steps: list[float] = []  # lengths of the programs' steps, squared
        self._obeys = False  # whether the last plan obeyed the dynamics
        # Steps and changes of the gradient.
        self._updates: deque[tuple[Array, Array]] = deque(maxlen=_MEMORY)
        # Inputs, gradient of the Lagrangian, multipliers.
        self._last: tuple[Array, Array, Array] | None = None

    def correct(
        self, program: CondensedProgram, prediction: Prediction
    ) -> CondensedProgram:
        """A program made at a prediction, with the curvature that the last steps showed, where the iteration creeps."""
        if len(program.feedback):  # there the unknowns are other ones at every plan
            return program
        inputs = prediction.plan.inputs.ravel()
        gradient = program.P @ inputs + program.q
        both_obey = self._obeys and _obeys_dynamics(prediction)
        if self._last is not None and both_obey:
            last_inputs, last_gradient, z = self._last
            near = _NOISE < self._size**2 < _NEAR**2
            if near and np.any(inputs != last_inputs):
                change = gradient + program.G.T @ z - last_gradient
                self._updates.append((inputs - last_inputs, change))
        if not (self._updates and self._creeps):
            return program
        P = program.P.copy()
        for step, change in self._updates:
            _update(P, step, change)
        return program._replace(P=P, q=gradient - P @ inputs)

    def __call__(
        self,
        prediction: Prediction,
        program: CondensedProgram,
        solution: QPSolution,
        proposed: Plan,
    ) -> tuple[Prediction, Status | None]:
        """The prediction at the next plan, and how the iteration ends: None where it goes on.

        The program was made at the ``prediction``; ``proposed`` is the plan that its solution means.
        """
        first = math.isinf(self._size)
        self._remember(program, solution, prediction)
        forecast = self._forecast(prediction, solution, proposed)
        self.steps.append(forecast.curvature)
        arrived = self._judge(forecast, first)
        if arrived:
            return prediction._replace(plan=proposed), Status.SOLVED
        trial = self._search_line(prediction, program, proposed, forecast, first)
        if trial is not None:
            return trial, None
        # What could still be gained: the offset's square is a share of the cost.
        if self._size**2 <= _ROUND_OFF:
            return prediction._replace(plan=proposed), Status.SOLVED
        if self._size**2 <= _SLIGHT and self._size <= _NEARLY * self._tolerance:
            return prediction, Status.SOLVED
        if self._updates:  # they may be what misleads
            self._updates.clear()
            self._last = None
            return prediction, None
        return prediction, Status.STALLED

    def _remember(
        self, program: CondensedProgram, solution: QPSolution, prediction: Prediction
    ) -> None:
        """Keeps the gradient of the Lagrangian, of which the next update is made."""
        if len(program.feedback):
            return
        inputs = prediction.plan.inputs.ravel()
        gradient = program.P @ inputs + program.q
        if len(solution.z):
            gradient = gradient + program.G.T @ solution.z
        self._last = inputs, gradient, solution.z
        self._obeys = _obeys_dynamics(prediction)

    def _forecast(
        self, prediction: Prediction, solution: QPSolution, proposed: Plan
    ) -> StepForecast:
        """What a step promises, under prices above the multipliers of its program."""
        multipliers = _row_multipliers(solution, prediction)
        if multipliers.size:
            largest = float(np.abs(multipliers).max())
            self._row_price = max(self._row_price, 2.0 * largest)
        forecast = _forecast_step.unchecked(
            prediction.cost,
            self._terms,
            self._defect_prices,
            prediction.stages.A,
            prediction.stages.next,
            prediction.rows,
            prediction.plan,
            proposed,
            multipliers,
        )
        self._defect_prices = forecast.defect_prices
        return forecast

    @property
    def _terms(self) -> PriceTerms:
        return PriceTerms(self._request.references, self._prices, self._row_price)

    def _judge(self, forecast: StepForecast, first: bool) -> bool:
        """Whether the proposed plan is within the tolerance, or as near as rounding lets it come."""
        offset = math.sqrt(forecast.curvature / (forecast.cost + self._smallest))
        size = max(offset, forecast.defect)
        last_rate = self._rate
        self._rate = 1.0 if first else size / self._size
        self._size = size
        near = _NOISE < size**2 < _NEAR**2
        if near and not first and self._rate > _CREEP:
            self._creeps = True
        if size**2 <= _NOISE and self._rate * last_rate > _STALL:
            return True
        if size <= self._tolerance:
            return True
        # The solution is better than the plan by about the slower of two rates.
        slower = max(self._rate, last_rate)
        return size * slower <= self._tolerance * (1.0 - slower)

    def _search_line(
        self,
        prediction: Prediction,
        program: CondensedProgram,
        proposed: Plan,
        forecast: StepForecast,
        first: bool,
    ) -> Prediction | None:
        """The prediction at the first trial plan whose merit is lower by enough; None where there is none."""
        slope = forecast.promised - forecast.curvature - forecast.merit
        # The last plan, one step on.
        continued = self._request.previous is not None and self._request.states is None
        far = self._size > _NEAR and not (first and continued)
        invisible = self._size**2 <= _ROUND_OFF  # what can be gained is lost in merits
        obeying = self._creeps or far
        for length, trial in self._trials(prediction, program, proposed, obeying):
            if invisible:
                return trial
            largest_merit = (
                forecast.merit
                + _SUFFICIENT_DECREASE * length * min(slope, 0.0)
                + _ROUND_OFF * abs(forecast.merit)
            )
            rows = trial.rows
            if not self._model.constraints.smooth:  # bounds stay those of the program
                rows = prediction.rows._replace(E=trial.rows.E)
            merit = _merit.unchecked(
                trial.cost,
                self._terms,
                self._defect_prices,
                trial.stages.next,
                rows,
                trial.plan,
            )
            if merit <= largest_merit:
                return trial
        return None

    def _trials(
        self,
        prediction: Prediction,
        program: CondensedProgram,
        proposed: Plan,
        obeying: bool,
    ) -> Iterator[tuple[float, Prediction]]:
        """Lengths of the step to a proposed plan, and predictions there or at the plan that obeys the dynamics.

        Far from a solution the second of these leads further, and where the iteration creeps its gradients are needed;
        it comes first where moments are linearised, too, since they overshoot. Means are linearised at once near a
        solution, as a first step from the last plan is taken to be: the plan there will be taken.
        """
        model = self._model
        request = self._request
        order = (True, False)
        if model.linearizer.at_points and not obeying:
            order = (False, True)
        for length, obeys in product(_STEP_LENGTHS, order):
            target = _between(prediction.plan, proposed, length)
            try:
                if obeys:
                    feedback = program.feedback
                    trial = model.roll_out(target, prediction, feedback, request)
                else:
                    trial = model.linearize(model.canonical(target), request)
            except FAILURES:  # a trial plan may lead the model out of its numbers
                continue
            yield length, trial


def _between(plan: Plan, other: Plan, length: float) -> Plan:
    """The plan at a length of the step from one to another."""
    if length == 1.0:
        return other
    return Plan(
        plan.states + length * (other.states - plan.states),
        plan.inputs + length * (other.inputs - plan.inputs),
        plan.covariances + length * (other.covariances - plan.covariances),
    )


def _row_multipliers(solution: QPSolution, prediction: Prediction) -> Array:
    """Those of the rows of the states (H, r); the last of a program's."""
    shape = prediction.rows.lower.shape
    count = prediction.rows.lower.size
    return solution.z[len(solution.z) - count :].reshape(shape)


def _obeys_dynamics(prediction: Prediction) -> bool:
    """Whether a plan has no defects but for rounding."""
    states = prediction.plan.states
    defects = np.abs(prediction.stages.next - states[1:])
    return bool(defects.max() <= _OBEYS * max(1.0, np.abs(states).max()))


@compiled
def _smallest_cost(R, lower, upper, last):
    """The cost of an input that is small beside the last one: of the cheapest."""
    least = np.inf
    for j in range(len(R)):
        size = min(max(1.0, abs(last[j])), upper[j] - lower[j]) * _SMALL
        least = min(least, R[j, j] * size * size)
    return least + _TINY


@njit_inner
def _cost_of_step(cost, references, plan, proposed):
    """What a step from a plan to a proposed one would cost as a plan of its own, without references."""
    zero = References(
        0.0 * references.states,
        0.0 * references.inputs,
        0.0 * references.previous_input,
    )
    states = proposed.states - plan.states
    inputs = proposed.inputs - plan.inputs
    return evaluate_cost(cost, states, inputs, zero, 0.0)


@njit_inner
def _priced_cost(cost, terms, rows, plan):
    """The cost of a plan, and the price of its violated rows."""
    total = evaluate_cost(cost, plan.states, plan.inputs, terms.references, 1.0)
    return total + price_violations(terms.prices, rows, plan, terms.row_price)


@compiled
def _measure_step(cost, terms, rows, plan, proposed):
    """The ``StepMeasures`` of a program's step."""
    here = _priced_cost(cost, terms, rows, plan)
    step = _cost_of_step(cost, terms.references, plan, proposed)
    return StepMeasures(here, step)


@compiled
def _forecast_step(cost, terms, defect_prices, A, after, rows, plan, proposed, z):
    """The ``StepForecast`` of a step from a plan to a proposed one."""
    H, p = after.shape
    defects = np.zeros(p)
    largest = 0.0
    reach = 1.0
    for k in range(H):
        for i in range(p):
            defect = abs(after[k, i] - plan.states[k + 1, i])
            defects[i] += defect
            largest = max(largest, defect)
            reach = max(reach, abs(plan.states[k + 1, i]))
    here = _priced_cost(cost, terms, rows, plan)
    promised = _priced_cost(cost, terms, rows, proposed)
    curvature = _cost_of_step(cost, terms.references, plan, proposed)
    costates = _costates(cost, A, proposed, terms.references.states, rows.E, z)
    prices = defect_prices.copy()
    for k in range(H):
        for i in range(p):
            prices[i] = max(prices[i], 1.5 * abs(costates[k, i]))
    merit = here + dot(defects, prices, p)
    return StepForecast(here, promised, curvature, largest / reach, merit, prices)


@compiled
def _merit(cost, terms, defect_prices, after, rows, plan):
    """The exact penalty function at a plan, within the bounds of ``rows``."""
    merit = _priced_cost(cost, terms, rows, plan)
    for k in range(len(after)):
        for i in range(after.shape[1]):
            merit += defect_prices[i] * abs(after[k, i] - plan.states[k + 1, i])
    return merit


@compiled
def _costates(cost, A, plan, targets, E, z):
    """Multipliers of the dynamics (H, p): the derivatives of cost and rows by s_1 .. s_H, through all that follows."""
    states = plan.states
    inputs = plan.inputs
    Z = cost.squares
    H, n = targets.shape
    p = states.shape[1]
    m = inputs.shape[1]
    costates = np.zeros((H, p))
    for k in range(H - 1, -1, -1):
        weight = weight_of_stage(cost, k, H)
        out = costates[k]
        rows = E[min(k, len(E) - 1)]
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
    product_with_step = P @ step
    curvature = step @ product_with_step
    shown = step @ change
    share = 1.0
    if shown < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - shown)
    damped = share * change + (1.0 - share) * product_with_step
    P += np.outer(damped, damped) / (step @ damped)
    P -= np.outer(product_with_step, product_with_step) / curvature
