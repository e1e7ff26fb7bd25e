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

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import DynamicsModel, linearize
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.models import DelayedModel
from gpmpc.mpc._condense import condense
from gpmpc.mpc._controller import (
    FEASIBLE,
    KEPT,
    Decision,
    Reference,
    Request,
    Timing,
    check_method,
)
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._elastic import elastic_price, violations
from gpmpc.mpc._linear_quadratic import CondensedProgram, expand
from gpmpc.mpc._novelty import data_scales, later, novelty_of
from gpmpc.mpc._prediction import Prediction, PredictionModel, PredictionSettings
from gpmpc.mpc._sqp import FAILURES, Iteration, measure_continuity
from gpmpc.mpc._stability import Stability, stability
from gpmpc.mpc._stages import Covariance, Plan, price_violations
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Propagator
from gpmpc.qp import DualActiveSet, QPSolution, QPSolver, QuadraticProgram
from gpmpc.signals import Signals
from gpmpc.status import Status

Array = np.ndarray

_DEFAULT = PredictionSettings()
_MOST = 10  # programs of a step, where their number is not set
_LOOSE = 1e-2  # tolerance there
_TIGHT = 1e-6  # tolerance where it is set
_PAYS = 0.7  # of a first plan's cost, below which one that took more programs is taken
_SLIGHTLY_MORE = 1.02  # than its program may a plan miss a smooth constraint
# Price of a row that does not count: a free row keeps its place among the others.
_NEXT_TO_NOTHING = 1e-9


class Stopwatch:
    """Sums the wall time of the parts of a decision."""

    def __init__(self, spent: float = 0.0):
        self._last = perf_counter() - spent
        self._began = self._last
        self._seconds = {"model": 0.0, "build": 0.0, "solve": 0.0}

    def lap(self, part: str) -> None:
        """Adds the time since the last lap to a part."""
        now = perf_counter()
        self._seconds[part] += now - self._last
        self._last = now

    @property
    def elapsed(self) -> float:
        """All time so far [s]."""
        return perf_counter() - self._began

    @property
    def timing(self) -> Timing:
        """The sums so far."""
        return Timing(**self._seconds)


class Outcome(NamedTuple):
    """How the programs of a decision ended."""

    program: CondensedProgram  # the last one
    solution: QPSolution  # of it
    status: Status
    programs: int  # how many there were
    steps: tuple[float, ...]  # see ``Decision``


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
        iterations: Quadratic programs a step at most; more than one for the form ``"trajectory"`` only. By default as
            many as a step needs: one where the last plan goes on, more after a jump or a disturbance.
        tolerance: Of more iterations: relative offset and defects of a plan that counts as solved (``gpmpc.mpc._sqp``),
            estimated from the slower of the last two rates of convergence. 1e-8 may be out of reach. By default 1e-2
            where the number of programs is not set, and 1e-6 where it is.
        budget: Time of a decision after which no further program is begun [s]; None for no limit. Decisions then
            depend on the machine.

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
        iterations: int | None = None,
        tolerance: float | None = None,
        budget: float | None = None,
    ):
        self.prediction = PredictionModel(
            model, propagator, problem, horizon, initial_input, prediction
        )
        if iterations is not None:
            check_number("iterations", iterations, least=1, whole=True)
        if tolerance is None:
            tolerance = _LOOSE if iterations is None else _TIGHT
        check_number("tolerance", tolerance, above=0)
        self.tolerance = tolerance
        if budget is not None:
            check_number("budget", budget, above=0, unit="[s]")
        self.budget = budget
        if (
            iterations is not None
            and iterations > 1
            and prediction.form != "trajectory"
        ):
            rule = f"form {prediction.form!r} is one quadratic program, so 1"
            raise SettingError("iterations", f"{rule}; got {iterations}")
        self.initial_input = self.prediction.initial_input
        self.problem = problem
        self.horizon = horizon
        self.iterations = iterations
        self.solver = DualActiveSet() if solver is None else solver
        check_method("solver", self.solver, "solve", "DualActiveSet()")
        self._is_elastic = bool(self.prediction.constraints.elastic.any())
        velocity = prediction.form == "velocity"
        self._most = 1 if velocity else iterations or _MOST
        self._scales = data_scales(model)
        rows = self.prediction.constraints
        # Prices: of hard rows alone.
        self._hard = np.where(np.isinf(rows.prices), np.inf, 0.0)
        if rows.soft and not isinstance(self.solver, DualActiveSet):
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
            Stopwatch(),
        )

    def _decide(
        self,
        request: Request,
        stopwatch: Stopwatch,
        prediction: Prediction | None = None,
    ) -> Decision:
        """The decision on a request from the prediction at its first guess: failed where numbers are not finite."""
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            if prediction is None:
                guess = self.prediction.initial_guess(request)
                prediction = self.prediction.linearize(guess, request)
            is_first = request.previous is None and request.states is None
            chooses = self.iterations is None and self._most > 1
            # A curved bound lies elsewhere than one program sees it.
            if is_first and chooses and not self.prediction.constraints.smooth:
                return self._begin(prediction, request, stopwatch)
            return self._improve(prediction, request, stopwatch, self._most)
        except FAILURES as error:
            status = Status.NUMERICAL_TROUBLE
            if isinstance(error, FunctionNotFinite):
                status = Status.FUNCTION_NOT_FINITE
            return request.failed_decision(status, timing=stopwatch.timing)

    def _begin(
        self, prediction: Prediction, request: Request, stopwatch: Stopwatch
    ) -> Decision:
        """The decision without a plan to go on from: that of one program, unless more of them pay much.

        One program's first plan need not be consistent yet, and the next decisions lead it
        further than its horizon shows: a swing-up that is iterated at once may lean for ever.
        """
        quick = self._improve(prediction, request, stopwatch, most=1)
        if not (quick.applicable and self.prediction.linearizer.at_points):
            return quick
        if self.budget is not None and stopwatch.elapsed > self.budget:
            return quick
        try:
            thorough = self._improve(prediction, request, stopwatch, self._most)
        except FAILURES:  # more programs led the model out of its numbers
            return quick
        iterations = quick.iterations + thorough.iterations
        quick_cost, thorough_cost = (
            self.prediction.cost_of_inputs(plan.inputs, request)
            for plan in (quick, thorough)
        )
        pays = thorough.applicable and thorough_cost < _PAYS * quick_cost
        chosen = thorough if pays else quick
        return replace(chosen, iterations=iterations, timing=stopwatch.timing)

    def _improve(
        self,
        prediction: Prediction,
        request: Request,
        stopwatch: Stopwatch,
        most: int,
    ) -> Decision:
        """The decision from a prediction: program by program, to a plan that is good enough or the last program."""
        guess = prediction.plan
        solution = None if request.previous is None else request.previous.solution
        iteration: Iteration | None = None
        prices = self.prediction.constraints.prices
        steps: list[float] = []
        status: Status | None = None
        count = 0
        while True:
            stopwatch.lap("model")
            program = self._condense(prediction, request)
            if iteration is not None:
                program = iteration.correct(program, prediction)
            stopwatch.lap("build")
            solution = self._solve(program, solution, prices)
            if count == 0 and solution.status.solved and self._is_elastic:
                lower = self._give_way(program, solution, prediction, request)
                if lower is not None:
                    prices = lower
                    solution = self._solve(program, solution, prices)
            stopwatch.lap("solve")
            count += 1
            status = solution.status
            ending = prediction
            if not _is_usable(program, solution, prediction.plan):
                if prediction.plan is not guess:
                    ending = self._obey(prediction, prediction, program, request)
                break
            proposed = _expand(program, solution, prediction, request)
            late = False
            enough = most == 1
            smooth = self.prediction.constraints.smooth
            follows = smooth or request.previous is not None
            continuing = self.iterations is None and follows
            if continuing and count == 1 and not enough:
                continuity = measure_continuity(
                    self.prediction, request, prediction, proposed, prices
                )
                enough = continuity.continues
                steps = [continuity.step]
            if enough:  # the real-time iteration takes the whole step
                ending = prediction._replace(plan=proposed)
            else:
                if iteration is None:
                    iteration = Iteration(
                        self.prediction, request, self.tolerance, prices
                    )
                ending, status = iteration(prediction, program, solution, proposed)
                steps = iteration.steps
                late = self.budget is not None and stopwatch.elapsed > self.budget
                if status is None and count < most and not late:
                    prediction = ending
                    continue
            within_tolerance = self.iterations is not None and status is Status.SOLVED
            open_defects = not (enough or within_tolerance)
            if open_defects or smooth or self.prediction.settings.rolled_out:
                ending = self._obey(ending, prediction, program, request)
            solved = status is not None and status.solved
            if not solved or self._keeps_promise(ending, solution, request):
                break
            if count == most or late:
                status = None if most > 1 else status
                break
            # A curved bound lies elsewhere than the program saw it.
            prediction = self.prediction.linearize(ending.plan, request)
        stopwatch.lap("model")
        if status is None:
            status = Status.ITERATION_LIMIT
        outcome = Outcome(program, solution, status, count, tuple(steps))
        return self._conclude(ending, guess, outcome, request, stopwatch.timing)

    def _condense(self, prediction: Prediction, request: Request) -> CondensedProgram:
        """The program at a prediction."""
        return condense(
            prediction.cost,
            self.prediction.bounds,
            prediction.stages,
            prediction.plan.states[0],
            request.references,
            prediction.rows,
        )

    def _keeps_promise(
        self, ending: Prediction, solution: QPSolution, request: Request
    ) -> bool:
        """Whether a plan misses smooth constraints by no more than its program did."""
        if not self.prediction.constraints.smooth:
            return True
        promised = float(solution.violation().max(initial=0.0))
        missed = self.prediction.violation(ending, request)
        return missed <= _SLIGHTLY_MORE * promised + KEPT

    def _obey(
        self,
        ending: Prediction,
        linearized: Prediction,
        program: CondensedProgram,
        request: Request,
    ) -> Prediction:
        """The prediction whose plan obeys the dynamics.

        It is the ending itself where that leads out of the model's numbers.
        """
        try:
            feedback = program.feedback
            return self.prediction.obey(ending, linearized, feedback, request)
        except FAILURES:
            return ending

    def _conclude(
        self,
        prediction: Prediction,
        guess: Plan,
        outcome: Outcome,
        request: Request,
        timing: Timing,
    ) -> Decision:
        """The decision for the plan of a prediction: failed where it is the guess or misses a hard bound."""
        status = outcome.status
        program = QuadraticProgram.unchecked(*outcome.program[:5])
        plan = prediction.plan
        suboptimal = False
        if not status.solved and plan is not guess:
            missed = price_violations(self._hard, prediction.rows, plan, 1.0)
            suboptimal = missed <= FEASIBLE
        if not (status.solved or suboptimal):
            failed = request.failed_decision(status, outcome.programs, timing)
            return replace(failed, problem=program, solution=outcome.solution)
        violation = self.prediction.violation(prediction, request)
        if status is Status.SOLVED and violation > KEPT:
            status = Status.SOFT_BOUND_MISSED
        stage_costs = self.prediction.stage_costs(prediction, request)
        means, covariances = self.prediction.linearizer.moments(
            plan.states, prediction.covariances
        )
        inputs = plan.inputs.copy()
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=covariances,
            status=status,
            iterations=outcome.programs,
            timing=timing,
            problem=program,
            solution=outcome.solution,
            disturbance=request.disturbance,
            suboptimal=suboptimal,
            plan_novelty=self._novelty(prediction, means, inputs, covariances),
            stage_costs=stage_costs,
            violation=violation,
            steps=outcome.steps,
        )

    def _novelty(
        self, prediction: Prediction, means: Array, inputs: Array, covariances: Array
    ) -> float | Callable[[], float]:
        """How far a plan is from the data; to be measured when it is read, where its stages hold no variances."""
        if self._scales is None:
            return math.nan
        linearizer = self.prediction.linearizer
        if linearizer.covariance == "zero_order":
            V = prediction.stages.V
            return novelty_of(V, linearizer.noise, covariances, self._scales)
        model = self.prediction.model
        return later(model, means, inputs, covariances, self._scales)

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
        requests = [self.prediction.read(*question) for question in asked]
        began = perf_counter()
        known = [request for request in requests if request.finite]
        try:
            made = iter(self.prediction.linearize_many(known))
        except FAILURES:  # one of them spoils the batch: which one, they say alone
            return [self._decide(request, Stopwatch()) for request in requests]
        share = (perf_counter() - began) / max(1, len(known))
        return [
            self._decide(r, Stopwatch(share), next(made) if r.finite else None)
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

    def _give_way(
        self,
        program: CondensedProgram,
        solution: QPSolution,
        prediction: Prediction,
        request: Request,
    ) -> Array | None:
        """Prices of the rows (r,) where the solution misses elastic ones; None where it keeps them."""
        elastic = self.prediction.constraints.elastic
        plan = _expand(program, solution, prediction, request)
        planned = prediction._replace(plan=plan)
        if violations(planned, elastic).max() <= KEPT:
            return None
        prices = self.prediction.constraints.prices.copy()
        prices[elastic] = _NEXT_TO_NOTHING
        free = self._solve(program, solution, prices)
        plan = _expand(program, free, prediction, request)
        planned = prediction._replace(plan=plan)
        prices[elastic] = elastic_price(
            planned,
            free_cost=float(self.prediction.stage_costs(planned, request).sum()),
            last_cost=float(self.prediction.stage_costs(prediction, request).sum()),
            elastic=elastic,
            Q=self.problem.cost.Q,
        )
        return prices

    def _solve(
        self, program: CondensedProgram, warm: QPSolution | None, row_prices: Array
    ) -> QPSolution:
        """The solution of a program, its violations priced by row (r,)."""
        if isinstance(self.solver, DualActiveSet):
            prices = None
            if self.prediction.constraints.soft:
                # The rows of the states are the last ones; all others are hard.
                prices = np.full(len(program.G), np.inf)
                soft = np.tile(row_prices, self.horizon)
                prices[len(prices) - len(soft) :] = soft
            problem = QuadraticProgram.unchecked(*program[:5])
            return self.solver.solve(problem, warm, prices)
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
        settings = PredictionSettings(covariance=covariance)
        start = (problem, horizon, initial_input)
        super().__init__(
            model,
            propagator,
            *start,
            settings,
            iterations=iterations,
            tolerance=tolerance,
        )


def _expand(
    program: CondensedProgram,
    solution: QPSolution,
    prediction: Prediction,
    request: Request,
) -> Plan:
    """The plan that the solution of a program means."""
    unknowns = np.ascontiguousarray(solution.x, dtype=np.float64)
    inputs, states = expand.unchecked(
        prediction.stages,
        prediction.plan.states[0],
        program.feedback,
        request.references.previous_input,
        unknowns,
    )
    return Plan(states, inputs, prediction.covariances)


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
