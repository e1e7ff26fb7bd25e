"""GP model predictive control: the control step, from a belief and a reference to the input.

The dynamics of the belief are linearised along a plan (``_prediction``), the states eliminated
(``_condense``), and what is left is a quadratic program in the inputs. One of them a step, of the form
``trajectory``, is the real-time iteration (Diehl, Bock and Schloeder, 2005); of the form ``velocity`` with moments
matched it is the convex GP-MPC of Cao, Lai and Alam (2017, section 4). Iterated (``_sqp``), programs solve the
nonlinear problem itself. Where the iteration ends, in the covariance modes of ``_stages``:

* ``full``, ``diagonal``: at a KKT point of the expected cost of the propagated belief, tr(Q Sigma) included, under
  chance constraints: the nonlinear GP-MPC of Cao, Lai and Alam (2017, eq. (22)), where moments are matched.
* ``zero_order``: the cost of the means under bounds tightened by the covariances that the solution itself leads to;
  that these depend on the inputs is left out of the derivatives.
* ``none``: the cost of the means.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np

from gpmpc._compiled import call_unchecked, compiled
from gpmpc._dynamics import DynamicsModel, linearize
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.models import DelayedModel
from gpmpc.mpc._condense import condense
from gpmpc.mpc._controller import (
    FEASIBLE,
    Decision,
    Reference,
    Request,
    Timing,
    check_method,
)
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._linear_quadratic import CondensedProgram, expand
from gpmpc.mpc._prediction import Prediction, PredictionModel, PredictionSettings
from gpmpc.mpc._sqp import FAILURES, Globalization
from gpmpc.mpc._stability import Stability, stability
from gpmpc.mpc._stages import Covariance, Plan, price_violations
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Propagator
from gpmpc.qp import DualActiveSet, QPSolution, QPSolver, QuadraticProgram
from gpmpc.signals import Signals
from gpmpc.status import Status

Array = np.ndarray

_DEFAULT = PredictionSettings()


class GPMPC:
    """GP-MPC by quadratic programs.

    Args:
        model: What was learned.
        propagator: How the belief moves; ``covariance="none"`` needs the model's mean only.
        problem: Weights and bounds.
        horizon: H, the number of predicted states.
        initial_input: The input before the first step, and the first guess of every planned one (m,).
        prediction: Form, covariance mode, feedback and disturbance estimate.
        solver: Of the quadratic program; ``DualActiveSet()`` by default, which soft constraints need.
        iterations: Quadratic programs a step at most; more than one for the form ``"trajectory"`` only.
        tolerance: Of more iterations: relative offset and defects of a plan that counts as solved (``gpmpc.mpc._sqp``),
            estimated from the slower of the last two rates of convergence. 1e-8 may be out of reach.

    Raises:
        SettingError: A setting is unknown or out of its range, or model and problem have other dimensions.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        prediction: PredictionSettings = _DEFAULT,
        solver: QPSolver | None = None,
        iterations: int = 1,
        tolerance: float = 1e-6,
    ):
        self.prediction = PredictionModel(
            model, propagator, problem, horizon, initial_input, prediction
        )
        check_number("iterations", iterations, least=1, whole=True)
        check_number("tolerance", tolerance, above=0)
        if iterations > 1 and prediction.form != "trajectory":
            rule = f"form {prediction.form!r} is one quadratic program, so 1"
            raise SettingError("iterations", f"{rule}; got {iterations}")
        self.initial_input, self.problem, self.horizon = (
            self.prediction.initial_input,
            problem,
            horizon,
        )
        self.iterations, self.tolerance = iterations, tolerance
        self.solver = DualActiveSet() if solver is None else solver
        check_method("solver", self.solver, "solve", "DualActiveSet()")
        self._prior = self.prediction.linearizer.prior_variances()
        rows, hard = (
            self.prediction.constraints,
            np.full(self.prediction.bounds.rate_lower.size, np.inf),
        )
        self._hard = np.where(
            np.isinf(rows.prices), np.inf, 0.0
        )  # prices: of hard rows alone
        self._prices = (
            np.concatenate([hard, np.tile(rows.prices, horizon)]) if rows.soft else None
        )  # of rows of G
        if self._prices is not None and not isinstance(self.solver, DualActiveSet):
            rule = "soft constraints need DualActiveSet (penalty=None makes them hard)"
            raise SettingError("solver", f"{rule}; got {type(self.solver).__name__}")

    @property
    def signals(self) -> Signals:
        """Names of states and inputs, and time step, as far as the model knows them."""
        return self.prediction.signals

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
        plan: Any = None,
    ) -> Decision:
        """Decides the input for one step; see ``Controller.control``.

        A belief that is not finite gives ``INVALID_MEASUREMENT``. ``iterations`` of the decision counts quadratic
        programs; ``ITERATION_LIMIT`` says that the tolerance was not reached: the plan is the best there was.

        Args:
            belief: What is known of the state.
            reference: Over the horizon, with inputs where the weights ask for them.
            previous: The last decision; one that is not applicable is ignored.
            parameters: Of outputs and smooth constraints, (q,) or by stage (H, q), such as where an obstacle will be.
            plan: To start from in the place of the last one: inputs (H, m), or these and states (H + 1, n), which need
                not obey the dynamics. With states, angles of the reference are taken as they are, turns included.

        Raises:
            ShapeError: Belief, reference, parameters or plan have other dimensions, or reference inputs are missing.
            DataError: Reference, parameters or plan are not finite.
        """
        return self._decide(
            self.prediction.read(belief, reference, previous, parameters, plan),
            [perf_counter()],
        )

    def _decide(
        self, request: Request, laps: list[float], prediction: Prediction | None = None
    ) -> Decision:
        """The decision on a request from the prediction at its first guess: failed where numbers are not finite."""
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            if prediction is None:
                prediction = self.prediction.linearize(
                    self.prediction.initial_guess(request), request
                )
            return self._improve(prediction, request, laps)
        except FAILURES as error:
            at_function = isinstance(error, FunctionNotFinite)
            status = (
                Status.FUNCTION_NOT_FINITE if at_function else Status.NUMERICAL_TROUBLE
            )
            return request.failed_decision(status, timing=_timing(laps))

    def _improve(
        self, prediction: Prediction, request: Request, laps: list[float]
    ) -> Decision:
        """The decision from a prediction: program by program, up to a KKT point or the last one."""
        guess, solution = (
            prediction.plan,
            None if request.previous is None else request.previous.solution,
        )
        search = (
            Globalization(self.prediction, request, self.tolerance)
            if self.iterations > 1
            else None
        )
        solved_at, status, count = None, None, 0
        while True:
            laps.append(perf_counter())
            at = prediction.stages, prediction.plan.states[0], request.references
            program = condense(
                prediction.cost, self.prediction.bounds, *at, prediction.rows
            )
            program = (
                program if search is None else search.correct(program, prediction.plan)
            )
            laps.append(perf_counter())
            solution = self._solve(program, solution)
            laps.append(perf_counter())
            count, status = count + 1, solution.status
            if _is_usable(program, solution, prediction.plan):
                unknowns = np.ascontiguousarray(solution.x, dtype=np.float64)
                at = (
                    prediction.stages,
                    prediction.plan.states[0],
                    program.feedback,
                    request.references.previous_input,
                )
                inputs, states = call_unchecked(expand, *at, unknowns)
                proposed = Plan(states, inputs, prediction.covariances)
                solved_at = prediction, program.feedback
                if search is None:  # the real-time iteration takes the whole step
                    prediction = prediction._replace(plan=proposed)
                else:
                    prediction, status = search(prediction, program, solution, proposed)
            if status is not None or count == self.iterations:
                break
        if solved_at is not None and self.prediction.settings.rolled_out:
            obeying = self.prediction.roll_out(prediction.plan, *solved_at, request)
            prediction = (
                obeying if np.isfinite(obeying.plan.states).all() else prediction
            )
        laps.append(perf_counter())
        timing = _timing(laps)
        program, status = (
            QuadraticProgram.unchecked(*program[:5]),
            Status.ITERATION_LIMIT if status is None else status,
        )
        suboptimal = not status.solved and prediction.plan is not guess
        suboptimal = (
            suboptimal
            and price_violations(self._hard, prediction.rows, prediction.plan, 1.0)
            <= FEASIBLE
        )
        if not (status.solved or suboptimal):
            return replace(
                request.failed_decision(status, count, timing),
                problem=program,
                solution=solution,
            )
        plan = prediction.plan
        means, covariances = self.prediction.linearizer.moments(
            plan.states, prediction.covariances
        )
        novelty = call_unchecked(_largest_ratio, prediction.stages.V, self._prior)
        inputs, found = (
            plan.inputs.copy(),
            (program, solution, request.disturbance, suboptimal, novelty),
        )
        return Decision(
            inputs[0], inputs, means, covariances, status, count, timing, *found
        )

    def with_model(self, model: DynamicsModel) -> "GPMPC":
        """Returns the controller for another model of as many states and inputs, in microseconds."""
        other = copy(self)
        other.prediction = self.prediction.with_model(model)
        return other

    def control_many(
        self,
        beliefs: Sequence[Gaussian],
        references: Sequence[Reference],
        previous: Sequence[Decision | None],
        parameters: Sequence[Any] | None = None,
    ) -> list[Decision]:
        """``control`` for lists of its arguments, with the first stages of all of them linearised in one call.

        The quadratic programs are solved one by one; the model's time is shared out equally.
        """
        own = [None] * len(beliefs) if parameters is None else parameters
        asked = zip(beliefs, references, previous, own, strict=True)
        requests, began = (
            [self.prediction.read(*question) for question in asked],
            perf_counter(),
        )
        known = [request for request in requests if request.finite]
        try:
            made = iter(self.prediction.linearize_many(known))
        except FAILURES:  # one of them spoils the batch: which one, they say alone
            return [self._decide(request, [perf_counter()]) for request in requests]
        share = (perf_counter() - began) / max(1, len(known))
        return [
            self._decide(r, [perf_counter() - share], next(made) if r.finite else None)
            for r in requests
        ]

    def gains(self, decision: Decision, parameters: Array | None = None) -> Array:
        """K_0 .. K_{H-1} (H, m, n) of u = u_k - K_k (x - x_k), the regulator of the stages along a decision's plan."""
        found = linearize(
            self.prediction.model,
            decision.means[:-1],
            decision.inputs,
            covariance=False,
        )
        cost = self.prediction.costs.at(
            Plan(decision.means, decision.inputs, decision.covariances), parameters
        )
        return self.prediction.gains(found.A, found.B, cost)

    def stability(
        self,
        reference: Any,
        plant: DynamicsModel | None = None,
        ahead: DelayedModel | None = None,
        parameters: Any = None,
    ) -> Stability:
        """Tells before the loop runs whether it settles near a reference, and with which horizons; see ``Stability``.

        Args:
            reference: A set point (n,), or states of any number of steps (K + 1, n) of which some are judged.
            plant: A model of what is steered, of other gains, or with a ``DelayedModel`` around it; the controller's
                own model by default.
            ahead: The delay that the belief is predicted over (``DelayedModel.ahead``) where it is.
            parameters: Of outputs, as for ``control``.

        Raises:
            SettingError: The plant or the delay does not belong to the controller.
        """
        return stability(self.prediction, reference, plant, ahead, parameters)

    def _solve(self, program: CondensedProgram, warm: QPSolution | None) -> QPSolution:
        if isinstance(self.solver, DualActiveSet):
            prices = self._prices
            if prices is not None and len(
                program.feedback
            ):  # there the bounds of inputs are rows, too
                prices = np.concatenate(
                    [np.full(len(program.G) - len(prices), np.inf), prices]
                )
            return self.solver.solve(
                QuadraticProgram.unchecked(*program[:5]), warm, prices
            )
        fits = warm is not None and warm.arrays[2].shape == program.G.shape
        return self.solver.solve(
            QuadraticProgram.from_stacked(*program[:5]), warm if fits else None
        )


class NonlinearGPMPC(GPMPC):
    """Nonlinear GP-MPC (Cao, Lai and Alam, 2017, eq. (22)): programs of the whole belief, iterated to convergence.

    It is ``GPMPC`` of another covariance mode and more iterations; arguments as there.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        covariance: Covariance = "full",
        iterations: int = 100,
        tolerance: float = 1e-5,
    ):
        settings, start = (
            PredictionSettings(covariance=covariance),
            (problem, horizon, initial_input),
        )
        super().__init__(
            model,
            propagator,
            *start,
            settings,
            iterations=iterations,
            tolerance=tolerance,
        )


def _is_usable(program: CondensedProgram, solution: QPSolution, plan: Plan) -> bool:
    """Whether a program was solved, or its solver stopped at a limit at a feasible point no worse than the plan."""
    if solution.status.solved:
        return True
    stopped = (
        solution.status in (Status.ITERATION_LIMIT, Status.TIME_LIMIT)
        and np.isfinite(solution.x).all()
    )
    if not (stopped and _violation(solution) <= FEASIBLE):
        return False
    other = solution._replace(
        x=0.0 * solution.x if len(program.feedback) else plan.inputs.ravel()
    )
    return solution.objective <= other.objective or _violation(other) > FEASIBLE


def _violation(solution: QPSolution) -> float:
    """The largest violation of a hard row."""
    return float(solution.violation()[np.isinf(solution.caps)].max(initial=0.0))


def _timing(laps: list[float]) -> Timing:
    """Sums the times between laps, of the model, of building and of solving in turns."""
    parts = [end - begin for begin, end in pairwise(laps)]
    return Timing(sum(parts[::3]), sum(parts[1::3]), sum(parts[2::3]))


@compiled
def _largest_ratio(V, prior):
    """The root of the largest V_kii / prior_i; NaN without a prior."""
    largest = 0.0 if len(prior) > 0 else np.nan
    for k in range(len(V)):
        for i in range(len(prior)):
            largest = max(largest, V[k, i, i] / prior[i] if prior[i] > 0.0 else 0.0)
    return np.sqrt(largest)
