"""Sequential quadratic programming for plans with defects (multiple shooting).

A program's solution is a step from one plan to the next. One step a control step is
taken whole (the real-time iteration of Diehl, Bock and Schloeder, 2005). Where more are
taken, a step is as long as it lowers the exact penalty

    cost + price of violated rows + sum_k mu' |F(s_k, u_k) - s_{k+1}|

with mu above the multipliers of the dynamics (Nocedal and Wright, 2006, section 18.3).
The price of a row is twice its largest multiplier (of hard rows the largest of all),
and at most its own: under an exact price of 1e6 weights a step along a curved row would
be refused for what it misses in second order (the Maratos effect; section 15.5 there).
Beside each length stands a second candidate: the dynamics rolled out under the feedback
u = u' - K (x - x') towards the plan that the program proposes. It has no defects, and
exists where inputs alone would lead an unstable plant away.

A plan is judged by its relative offset (Bates and Watts, 1981): the Gauss-Newton step
in the metric of the cost, relative to the root of the cost, which is the cosine between
the residuals and what a plan can change of them; and by its defects, relative to the
states. Gauss-Newton misses the curvature of the dynamics. Where that makes it creep,
damped BFGS updates put it into the program (Nocedal and Wright, 2006, procedure 18.2).
They are made of plans that obey the dynamics, whose gradients are those of the problem:
an iteration that creeps goes on along roll-outs.
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
from gpmpc.mpc._constraints import price_violations
from gpmpc.mpc._controller import Request
from gpmpc.mpc._linear_quadratic import (
    CondensedProgram,
    Plan,
    References,
    StageRows,
    evaluate_cost,
    weight_of_stage,
)
from gpmpc.mpc._linearization import LocalProblem, PredictionModel
from gpmpc.mpc._roll_out import roll_out
from gpmpc.qp import QPSolution
from gpmpc.status import Status

Array = np.ndarray

_TORCH_FAILURE = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]
LINEAR_ALGEBRA_FAILURES = (np.linalg.LinAlgError, _TORCH_FAILURE)
# No finite numbers.
FAILURES = (DataError, ProblemError, *LINEAR_ALGEBRA_FAILURES)
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
# A step is one more of the same kind if it is at most so many times as long, squared,
# as the last one,
_FURTHER = 4.0
# or if its squared length is at most this share of the cost.
_SLIGHT_STEP = 1e-3
# An iteration that stalls has arrived if this share of the cost could still be gained.
_SLIGHT_GAIN = 1e-3
_NEARLY = 5.0  # tolerances, within which an iteration that stalls has arrived
_TINY = 1e-300


class MeritTerms(NamedTuple):
    """References and prices, which a cost needs besides its weights."""

    references: References
    prices: Array  # of violated rows (r,), finite


class StepForecast(NamedTuple):
    """The promise of the step from a plan to a proposed one."""

    cost: float  # of the plan, without the price of violated rows
    promised: float  # of the proposed plan, with that price, as the program sees it
    squared_length: float  # of the step in the metric of the cost
    defect: float  # the largest of the plan, relative to the states
    merit: float  # of the plan, under the new prices of defects
    defect_prices: Array  # above the multipliers of the dynamics (p,)


class Iterate(NamedTuple):
    """The problem at the next plan of an iteration, and how the iteration ends."""

    local: LocalProblem
    status: Status | None  # None where one more program is due
    # whether the plan, if it is the last one, is rolled out before it is used: one of
    # a loose tolerance has defects, too
    needs_roll_out: bool = False


class _Trial(NamedTuple):
    """A problem at a length of the step to a proposed plan."""

    length: float  # in (0, 1]
    local: LocalProblem


class Progress(NamedTuple):
    """Sizes of an iteration's steps.

    The size of a step is the larger of relative offset and defect.
    """

    size: float = math.inf  # of the last step
    rate: float = 1.0  # its ratio to the one before
    last_rate: float = 1.0
    steps: int = 0
    creeps: bool = False  # whether steps near the solution became little smaller

    def after(self, size: float) -> "Progress":
        """Returns the progress after one more step."""
        is_later = self.steps > 0
        rate = size / self.size if is_later and self.size > 0.0 else 1.0
        near = _NOISE < size**2 < _NEAR**2
        creeps = self.creeps or (near and is_later and rate > _CREEP)
        return Progress(
            size=size,
            rate=rate,
            last_rate=self.rate,
            steps=self.steps + 1,
            creeps=creeps,
        )

    def is_converged(self, tolerance: float) -> bool:
        """Returns whether the last step led to within the tolerance of a solution.

        It also has where rounding lets it come no nearer.
        """
        has_two_rates = self.steps > 2
        stalls = has_two_rates and self.rate * self.last_rate > _STALL
        if self.size**2 <= _NOISE and stalls:
            return True
        if self.size <= tolerance:
            return True
        # The solution is better than the plan by about the slower of two rates.
        slower = max(self.rate, self.last_rate)
        return self.size * slower <= tolerance * (1.0 - slower)


class Continuity(NamedTuple):
    """Whether a step goes on along the last plan."""

    goes_on: bool
    squared_length: float  # of the step, in the metric of the cost


def measure_continuity(
    prediction: PredictionModel,
    request: Request,
    local: LocalProblem,
    proposed: Plan,
) -> Continuity:
    """Tells whether a step goes on along the last plan, so that one program is enough.

    That is the real-time iteration. A step that leads much further than the last one,
    and is not slight beside the cost, answers a jump of the reference or of the state.
    On plants that bend much, the plans of one program a step are not consistent;
    iterating each of them is slower and, on swing-ups, no better.
    """
    cost, squared_length = _measure_step.unchecked(local, request.references, proposed)
    last_lengths = () if request.last_plan is None else request.last_plan.steps
    if len(last_lengths) == 0:
        return Continuity(True, squared_length)
    slight = _SLIGHT_STEP * (max(cost, 0.0) + smallest_cost(prediction, request))
    longest = max(slight, _FURTHER * last_lengths[0])
    return Continuity(squared_length <= longest, squared_length)


def smallest_cost(prediction: PredictionModel, request: Request) -> float:
    """Returns the least cost, over the inputs, of a thousandth of the last input.

    It keeps relative offsets finite where a plan costs nothing.
    """
    return _cost_of_small_input.unchecked(
        R=prediction.costs.quadratic.input[0],
        lower=prediction.roll_out_bounds.lower[0],
        upper=prediction.roll_out_bounds.upper[0],
        previous_input=request.references.previous_input,
    )


class Globalization:
    """Chooses the steps of one request's iteration, and says where it ends.

    For each program the caller calls ``correct`` before it is solved, and ``take_step``
    after. ``take_step`` remembers the gradient at the plan, from which the next
    ``correct``, at another plan, makes an update of the Hessian.

    Args:
        prediction: Of the controller.
        request: Of the decision.
        tolerance: Of relative offset and defects.
        row_prices: Of violated rows (r,), infinite for hard ones.

    Attributes:
        squared_length: Of the last program's step, in the metric of the cost.
    """

    def __init__(
        self,
        prediction: PredictionModel,
        request: Request,
        tolerance: float,
        row_prices: Array,
    ):
        self._prediction = prediction
        self._request = request
        self._tolerance = tolerance
        self._cost_floor = smallest_cost(prediction, request)
        self._highest_prices = row_prices
        no_prices = np.zeros(len(row_prices))
        self._merit_terms = MeritTerms(request.references, no_prices)
        weight = prediction.costs.quadratic.terminal
        blocks, n, _ = weight.shape
        self._defect_prices = np.zeros(blocks * n)
        self._curvature = CurvatureUpdates()
        self._progress = Progress()
        self.squared_length = math.nan

    def correct(
        self, program: CondensedProgram, local: LocalProblem
    ) -> CondensedProgram:
        """Returns a program with the curvature that the last steps showed."""
        return self._curvature.correct(program, local, self._progress)

    def take_step(
        self,
        local: LocalProblem,
        program: CondensedProgram,
        solution: QPSolution,
        proposed: Plan,
    ) -> Iterate:
        """Takes a step towards the plan that a program proposes.

        Args:
            local: The problem that the program was made of.
            program: The condensed problem.
            solution: Of the program.
            proposed: The plan that the solution means.
        """
        self._curvature.remember(program, solution, local)
        multipliers = _multipliers_by_stage(solution, local)
        self._raise_row_prices(multipliers)
        forecast = _forecast_step.unchecked(
            local, self._merit_terms, self._defect_prices, proposed, multipliers
        )
        self._defect_prices = forecast.defect_prices
        self.squared_length = forecast.squared_length
        # Prices of violations are no residuals; rounding may leave a zero below it.
        scale = max(forecast.cost, 0.0) + self._cost_floor
        offset = math.sqrt(forecast.squared_length / scale)
        self._progress = self._progress.after(max(offset, forecast.defect))
        # A solver that stopped early may propose no step far from the optimum.
        is_optimum = solution.status.solved
        if is_optimum and self._progress.is_converged(self._tolerance):
            return Iterate(local._replace(plan=proposed), Status.SOLVED)
        trial = self._search_line(local, program, proposed, forecast)
        if trial is not None:
            return Iterate(trial, status=None)
        return self._end_without_step(local, proposed, is_optimum)

    def _raise_row_prices(self, multipliers: Array) -> None:
        """Raises what rows cost in the merit above their multipliers (H, r).

        Hard rows have one price: a step may lead into one that no program has met yet.
        """
        sufficient = 2.0 * np.abs(multipliers).max(axis=0)
        raised = np.maximum(self._merit_terms.prices, sufficient)
        prices = np.minimum(raised, self._highest_prices)
        is_hard = np.isinf(self._highest_prices)
        if is_hard.any():
            prices[is_hard] = prices[is_hard].max()
        self._merit_terms = self._merit_terms._replace(prices=prices)

    def _search_line(
        self,
        local: LocalProblem,
        program: CondensedProgram,
        proposed: Plan,
        forecast: StepForecast,
    ) -> LocalProblem | None:
        """Returns the problem at the first trial whose merit is lower by enough.

        None where no trial's is.
        """
        progress = self._progress
        # The program's cost along the step is merit + slope t + squared_length t^2,
        # which is what it promised at t = 1.
        slope = forecast.promised - forecast.squared_length - forecast.merit
        # What can be gained is lost in the rounding of merits.
        invisible = progress.size**2 <= _ROUND_OFF
        for length, candidate in self._trials(local, program, proposed):
            if invisible:
                return candidate
            largest_merit = (
                forecast.merit
                + _SUFFICIENT_DECREASE * length * min(slope, 0.0)
                + _ROUND_OFF * abs(forecast.merit)
            )
            judged = candidate._replace(rows=self._judged_rows(candidate, local))
            merit = _merit.unchecked(judged, self._merit_terms, self._defect_prices)
            if merit <= largest_merit:
                return candidate
        return None

    def _judged_rows(self, trial: LocalProblem, local: LocalProblem) -> StageRows:
        """Returns the rows at the plan of a trial, tightened as the program's are.

        Programs leave out how covariances depend on the plan: a merit that counted it
        would find that no step pays.
        """
        constraints = self._prediction.constraints
        if not constraints.smooth:
            return local.rows._replace(E=trial.rows.E)
        if not constraints.kappas.any():
            return trial.rows
        return constraints.at(
            trial.plan,
            local.covariances,
            self._prediction.stage_count,
            self._request.parameters,
            self._request.kappas,
        )

    def _trials(
        self, local: LocalProblem, program: CondensedProgram, proposed: Plan
    ) -> Iterator[_Trial]:
        """Yields problems on the step to a proposed plan, the longest ones first.

        Each length has two: at the plan itself, and at one that obeys the dynamics.
        """
        prediction = self._prediction
        request = self._request
        obeying_first = self._tries_obeying_plan_first()
        order = (obeying_first, not obeying_first)
        for length, obeys in product(_STEP_LENGTHS, order):
            target = _between(local.plan, proposed, length)
            try:
                if obeys:
                    trial = roll_out(
                        prediction, target, local, program.feedback, request
                    )
                else:
                    trial = prediction.linearize(prediction.canonical(target), request)
            except FAILURES:  # a trial plan may lead the model out of its numbers
                continue
            yield _Trial(length, trial)

    def _tries_obeying_plan_first(self) -> bool:
        """Returns whether the first trial of a length obeys the dynamics.

        Far from a solution plans that obey lead further, and where the iteration creeps
        their gradients are needed; they come first where moments are linearised, too,
        since these overshoot. Means are linearised at once near a solution, as a first
        step from the last plan is taken to be: the plan there will be taken.
        """
        progress = self._progress
        request = self._request
        goes_on = progress.steps == 1 and request.continues_last_plan
        far = progress.size > _NEAR and not goes_on
        matches_moments = self._prediction.linearizer.depends_on_covariance
        return matches_moments or progress.creeps or far

    def _end_without_step(
        self, local: LocalProblem, proposed: Plan, is_optimum: bool
    ) -> Iterate:
        """Returns how an iteration ends whose line search found no plan."""
        size = self._progress.size
        # What could still be gained: the offset's square is a share of the cost.
        if is_optimum and size**2 <= _ROUND_OFF:
            return Iterate(local._replace(plan=proposed), Status.SOLVED)
        if is_optimum and size**2 <= _SLIGHT_GAIN and size <= _NEARLY * self._tolerance:
            return Iterate(local, Status.SOLVED)
        goes_on = self._curvature.forget()  # the updates may be what misleads
        status = None if goes_on else Status.STALLED
        return Iterate(local, status)


class LagrangianGradient(NamedTuple):
    """The gradient of a program's Lagrangian at the plan that it was made at."""

    inputs: Array  # of the plan (H m,)
    gradient: Array  # by the inputs (H m,)
    # of the rows G (rows,); those of the box are left out: their part of the gradient
    # is the same at every plan
    multipliers: Array
    obeys: bool  # whether the plan obeyed the dynamics


class HessianUpdate(NamedTuple):
    """A change of the inputs, and how the gradient changed with it."""

    input_change: Array  # (H m,)
    gradient_change: Array  # (H m,)


class CurvatureUpdates:
    """The curvature of the dynamics that an iteration's last steps showed."""

    def __init__(self) -> None:
        self._updates: deque[HessianUpdate] = deque(maxlen=_MEMORY)
        self._last: LagrangianGradient | None = None

    def remember(
        self, program: CondensedProgram, solution: QPSolution, local: LocalProblem
    ) -> None:
        """Keeps the gradient of the Lagrangian, of which the next update is made."""
        if len(program.feedback):
            return
        inputs = local.plan.inputs.ravel()
        gradient = program.P @ inputs + program.q
        multipliers = solution.z
        if len(multipliers):
            gradient = gradient + program.G.T @ multipliers
        self._last = LagrangianGradient(
            inputs=inputs,
            gradient=gradient,
            multipliers=multipliers,
            obeys=_obeys_dynamics(local),
        )

    def correct(
        self, program: CondensedProgram, local: LocalProblem, progress: Progress
    ) -> CondensedProgram:
        """Returns a program with the curvature added, where the iteration creeps."""
        if len(program.feedback):  # there the unknowns are other ones at every plan
            return program
        inputs = local.plan.inputs.ravel()
        gradient = program.P @ inputs + program.q
        last = self._last
        if last is not None and last.obeys and _obeys_dynamics(local):
            near = _NOISE < progress.size**2 < _NEAR**2
            if near and np.any(inputs != last.inputs):
                change = gradient + program.G.T @ last.multipliers - last.gradient
                self._updates.append(HessianUpdate(inputs - last.inputs, change))
        if not (self._updates and progress.creeps):
            return program
        P = program.P.copy()
        for update in self._updates:
            _update(P, update.input_change, update.gradient_change)
        return program._replace(P=P, q=gradient - P @ inputs)

    def forget(self) -> bool:
        """Forgets all updates; returns whether there were any."""
        if not self._updates:
            return False
        self._updates.clear()
        self._last = None
        return True


def _between(plan: Plan, other: Plan, length: float) -> Plan:
    """Returns the plan at a length of the step from one to another."""
    if length == 1.0:
        return other
    return Plan(
        plan.states + length * (other.states - plan.states),
        plan.inputs + length * (other.inputs - plan.inputs),
        plan.covariances + length * (other.covariances - plan.covariances),
    )


def _multipliers_by_stage(solution: QPSolution, local: LocalProblem) -> Array:
    """Returns multipliers of the state rows (H, r), which are a program's last rows."""
    count = local.rows.lower.size
    last_rows = solution.z[len(solution.z) - count :]
    return last_rows.reshape(local.rows.lower.shape)


def _obeys_dynamics(local: LocalProblem) -> bool:
    """Returns whether a plan has no defects but for rounding."""
    states = local.plan.states
    defects = np.abs(local.stages.next - states[1:])
    return bool(defects.max() <= _OBEYS * max(1.0, np.abs(states).max()))


@compiled
def _cost_of_small_input(R, lower, upper, previous_input):
    """Returns the least cost, over the inputs, of a thousandth of the last input.

    An input whose bounds leave it no room does not count.
    """
    least = np.inf
    for j in range(len(R)):
        size = min(max(1.0, abs(previous_input[j])), upper[j] - lower[j]) * _SMALL
        if size > 0.0:
            least = min(least, R[j, j] * size * size)
    if least == np.inf:
        return _TINY
    return least + _TINY


@njit_inner
def _cost_of_step(cost, references, plan, proposed):
    """Returns the cost of a step as a plan of its own, without references."""
    zero = References(
        0.0 * references.states,
        0.0 * references.inputs,
        0.0 * references.previous_input,
    )
    states = proposed.states - plan.states
    inputs = proposed.inputs - plan.inputs
    # Rounding may leave a zero below it, where a difference of states is weighed.
    return max(evaluate_cost(cost, states, inputs, zero, 0.0), 0.0)


@njit_inner
def _priced_cost(cost, terms, rows, plan):
    """Returns the cost of a plan, with the price of its violated rows."""
    total = evaluate_cost(cost, plan.states, plan.inputs, terms.references, 1.0)
    return total + price_violations(terms.prices, rows, plan)


@compiled
def _measure_step(local, references, proposed):
    """Returns the cost of a plan, violations left out, and a step's squared length."""
    plan = local.plan
    cost = evaluate_cost(local.cost, plan.states, plan.inputs, references, 1.0)
    squared_length = _cost_of_step(local.cost, references, local.plan, proposed)
    return cost, squared_length


@compiled
def _forecast_step(local, terms, defect_prices, proposed, multipliers):
    """Returns the ``StepForecast`` of a step from a plan to a proposed one.

    The multipliers (H, r) are those of the rows.
    """
    states = local.plan.states
    after = local.stages.next
    H, p = after.shape
    defects = np.zeros(p)
    largest_defect = 0.0
    largest_state = 1.0
    for k in range(H):
        for i in range(p):
            defect = abs(after[k, i] - states[k + 1, i])
            defects[i] += defect
            largest_defect = max(largest_defect, defect)
            largest_state = max(largest_state, abs(states[k + 1, i]))
    cost = evaluate_cost(
        local.cost, local.plan.states, local.plan.inputs, terms.references, 1.0
    )
    priced_cost = _priced_cost(local.cost, terms, local.rows, local.plan)
    promised = _priced_cost(local.cost, terms, local.rows, proposed)
    squared_length = _cost_of_step(local.cost, terms.references, local.plan, proposed)
    targets = terms.references.states
    costates = _costates(
        local.cost, local.stages.A, proposed, targets, local.rows.E, multipliers
    )
    prices = defect_prices.copy()
    for k in range(H):
        for i in range(p):
            prices[i] = max(prices[i], 1.5 * abs(costates[k, i]))
    merit = priced_cost + dot(defects, prices, p)
    relative_defect = largest_defect / largest_state
    return StepForecast(cost, promised, squared_length, relative_defect, merit, prices)


@compiled
def _merit(local, terms, defect_prices):
    """Returns the exact penalty function at the plan of a problem."""
    states = local.plan.states
    after = local.stages.next
    merit = _priced_cost(local.cost, terms, local.rows, local.plan)
    for k in range(len(after)):
        for i in range(after.shape[1]):
            merit += defect_prices[i] * abs(after[k, i] - states[k + 1, i])
    return merit


@compiled
def _costates(cost, A, plan, targets, E, multipliers):
    """Returns multipliers of the dynamics (H, p).

    They are derivatives of cost and rows by s_1 .. s_H, through all that follows.
    """
    states = plan.states
    inputs = plan.inputs
    Z = cost.squares
    H, n = targets.shape
    p = states.shape[1]
    m = inputs.shape[1]
    costates = np.zeros((H, p))
    for k in range(H - 1, -1, -1):
        weight = weight_of_stage(cost, k, H)
        costate = costates[k]
        rows = E[min(k, len(E) - 1)]
        for i in range(n if len(Z) > 0 else 0):
            costate[i] += 2.0 * (
                dot(Z[k, i], states[k + 1], n)
                + dot(Z[k, i, n:], inputs[k], m)
                + Z[k, i, n + m]
            )
        for i in range(p):
            for j in range(n):
                error = states[k + 1, i // n * n + j] - (
                    targets[k, j] if i < n else 0.0
                )
                costate[i] += 2.0 * weight[i // n, i % n, j] * error
            for e in range(len(rows)):
                costate[i] += rows[e, i] * multipliers[k, e]
            if k < H - 1:
                for j in range(p):
                    costate[i] += A[k + 1, j, i] * costates[k + 1, j]
    return costates


def _update(P: Array, input_change: Array, gradient_change: Array) -> None:
    """Updates P towards P input_change = gradient_change; it stays positive definite.

    It is damped for that (Powell, 1978).
    """
    product_with_P = P @ input_change
    curvature = input_change @ product_with_P
    new_curvature = input_change @ gradient_change
    damping = 1.0
    if new_curvature < 0.2 * curvature:
        damping = 0.8 * curvature / (curvature - new_curvature)
    damped = damping * gradient_change + (1.0 - damping) * product_with_P
    P += np.outer(damped, damped) / (input_change @ damped)
    P -= np.outer(product_with_P, product_with_P) / curvature
