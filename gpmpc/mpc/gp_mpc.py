"""GP model predictive control: the control step, from a belief and a reference.

A decision follows the method in its order:

    request    belief, reference and last plan are read            (``_guess``)
    plan       a first guess: the last plan, shifted               (``_guess``)
    local      stages, covariances, rows and cost at the plan      (``_linearization``)
    program    the states eliminated                               (``_condense``)
    solution   of the quadratic program                      (``_priced_solver``)
    step       taken whole, or as far as it pays                   (``_sqp``)
    decision   the plan, judged                                    (here)

One program a step, of the form ``trajectory``, is the real-time iteration (Diehl, Bock
and Schloeder, 2005); of the form ``velocity`` with moments matched it is the convex
GP-MPC of Cao, Lai and Alam (2017, section 4). Iterated, programs solve the nonlinear
problem itself. Where the iteration ends, in the covariance modes of
``_linear_quadratic``:

* ``full``, ``diagonal``: at a KKT point of the expected cost of the propagated belief,
  tr(Q Sigma) included, under chance constraints: the nonlinear GP-MPC of Cao, Lai and
  Alam (2017, eq. (22)), where moments are matched.
* ``zero_order``: the cost of the means under bounds tightened by the covariances that
  the solution itself leads to; that these depend on the inputs is left out of the
  derivatives.
* ``none``: the cost of the means.
"""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel, linearize
from gpmpc.exceptions import SettingError, check_method, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.models import DelayedModel
from gpmpc.mpc._condense import condense
from gpmpc.mpc._controller import (
    FEASIBLE,
    KEPT,
    Decision,
    Reference,
    Request,
    read_parameters,
)
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._guess import (
    initial_guess,
    is_contradicted,
    open_loop_plan,
    read_request,
)
from gpmpc.mpc._linear_quadratic import (
    CondensedProgram,
    Covariance,
    Plan,
)
from gpmpc.mpc._linearization import LocalProblem, PredictionModel, PredictionSettings
from gpmpc.mpc._novelty import data_scales, novelty_of, novelty_when_read
from gpmpc.mpc._priced_solver import PricedSolver
from gpmpc.mpc._roll_out import (
    MISS_RATIO,
    OUT_OF_NUMBERS,
    Outcome,
    close_defects,
    outcome_of_inputs,
)
from gpmpc.mpc._sqp import FAILURES, Globalization, Iterate, measure_continuity
from gpmpc.mpc._stability import Stability, stability
from gpmpc.mpc._stopwatch import Stopwatch
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


@explains_arguments
class GPMPC:
    """GP-MPC by quadratic programs.

    Args:
        model: What was learned.
        propagator: How the belief moves; ``covariance="none"`` needs the model's mean
            only.
        problem: Weights and bounds; of a model whose state holds its past, of those
            states that are measured, or of all.
        horizon: H, the number of predicted states.
        initial_input: The input before the first step, and the first guess of every
            planned one (m,).
        prediction: Form, covariance mode, feedback and disturbance estimate.
        solver: Of the quadratic program; ``DualActiveSet()`` by default, which soft
            constraints need.
        iterations: Quadratic programs a step at most, but for those that only look for
            the price of an elastic bound; more than one for the form ``"trajectory"``
            only. By default as many as a step needs: one where the last plan goes on,
            more after a jump or a disturbance.
        tolerance: Of more iterations: relative offset and defects of a plan that counts
            as solved (``gpmpc.mpc._sqp``), estimated from the slower of the last two
            rates of convergence. 1e-8 may be out of reach. By default 1e-2 where the
            number of programs is not set, and 1e-6 where it is. A step that goes on
            along the last plan by one program is not measured by it: it is solved where
            its program is.
        budget: Time of a decision after which no further program is begun [s]: it then
            ends with ``TIME_LIMIT``, unless it was solved. The first program, and what
            an elastic bound takes at least, are solved whatever it is. None for no
            limit. Decisions then depend on the machine.

    Raises:
        SettingError: A setting is unknown or out of its range, or model and problem
            have other dimensions.

    >>> import torch
    >>> from gpmpc.models import KnownModel
    >>> from gpmpc.mpc import Box, Problem, Tracking
    >>> from gpmpc.propagation import Linearization
    >>> A = torch.tensor([[1.0, 0.1], [0.0, 1.0]], dtype=torch.float64)
    >>> B = torch.tensor([[0.0], [0.1]], dtype=torch.float64)
    >>> model = KnownModel(lambda x, u: x @ A.T + u @ B.T, state_dim=2, input_dim=1)
    >>> problem = Problem(Tracking([1.0, 0.1], [0.1]), inputs=Box([-1.0], [1.0]))
    >>> controller = GPMPC(
    ...     model, Linearization(), problem, horizon=10, initial_input=[0.0]
    ... )
    >>> controller.horizon, controller.iterations
    (10, None)

    See Also:
        ``ControlLoop`` for a loop of your own, ``gpmpc.simulation.closed_loop`` for a
        simulated one; ``ManyStarts`` where a plan may end in the wrong valley;
        ``gpmpc.mpc.baselines.NMPC`` on the true model.
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
        _check_iterations(iterations, prediction)
        if tolerance is None:
            tolerance = _LOOSE if iterations is None else _TIGHT
        check_number("tolerance", tolerance, above=0)
        if budget is not None:
            check_number("budget", budget, above=0, unit="[s]")
        self.initial_input = self.prediction.initial_input
        self.problem = self.prediction.stated_problem
        self.horizon = horizon
        self.iterations = iterations
        self.tolerance = tolerance
        self.budget = budget
        self.solver = DualActiveSet() if solver is None else solver
        check_method("solver", self.solver, "solve", "DualActiveSet()")
        soft = self.prediction.constraints.soft
        if soft and not isinstance(self.solver, DualActiveSet):
            rule = "soft constraints need DualActiveSet (penalty=None makes them hard)"
            raise SettingError("solver", f"{rule}; got {type(self.solver).__name__}")
        self._most_programs = iterations or _MOST
        if not prediction.may_iterate:
            self._most_programs = 1
        #: what novelty is measured by; see ``with_model``
        self.data_scales = data_scales(model)
        # Of the states in the model's data (n,); infinite where none are known.
        self._state_ranges = np.full(self.prediction.state_dim, np.inf)
        if self.data_scales is not None:
            self._state_ranges = self.data_scales.ranges

    @property
    def most_programs(self) -> int:
        """Quadratic programs that a step takes at most."""
        return self._most_programs

    @property
    def signals(self) -> Signals:
        """Names of states and inputs, and time step, as far as the model knows them."""
        return self.prediction.stated_signals

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
        plan: Any = None,
    ) -> Decision:
        """Decides the input for one step; see ``Controller.control``.

        A belief that is not finite gives ``INVALID_MEASUREMENT``. ``iterations`` of the
        decision counts quadratic programs, those that look for the price of an elastic
        bound as one; ``ITERATION_LIMIT``, or ``TIME_LIMIT`` where the budget was spent,
        says that the tolerance was not reached: the plan is the best there was.

        Args:
            belief: What is known of the state.
            reference: Over the horizon, with inputs where the weights ask for them.
            previous: The last decision. Of one that is not applicable only the input
                counts, as the one that rates and increments start from.
            parameters: Of outputs and smooth constraints, (q,) or by stage (H, q), such
                as where an obstacle will be.
            plan: To start from in the place of the last one: inputs (H, m), or these
                and states (H + 1, n), which need not obey the dynamics. With states,
                angles of the reference are taken as they are, turns included; with
                inputs alone, in the turns of the states that these lead to.

        Raises:
            ShapeError: Belief, reference, parameters or plan have other dimensions, or
                reference inputs are missing.
            DataError: Reference, parameters or plan are not finite.
        """
        stopwatch = Stopwatch(self.budget)
        request = read_request(
            self.prediction, belief, reference, previous, parameters, plan
        )
        return self._decide(request, stopwatch)

    def _decide(
        self,
        request: Request,
        stopwatch: Stopwatch,
        local: LocalProblem | None = None,
    ) -> Decision:
        """Returns the decision on a request.

        It starts from the problem at the first guess, which is linearised here unless
        it is handed over. The decision is a failed one where numbers are not finite,
        unless a program before had a plan.
        """
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            if local is None:
                guess = initial_guess(self.prediction, request)
                local = self.prediction.linearize(guess, request)
            local = self._at_what_the_model_does(local, request)
            if not request.starts_afresh:
                return self._run_programs(
                    local, request, stopwatch, self._most_programs
                )
            decision = self._decide_first(local, request, stopwatch)
            is_infeasible = decision.status is Status.INFEASIBLE
            may_be_tried_again = is_infeasible and not decision.applicable
            if may_be_tried_again and not self.prediction.is_held:
                # A line through an obstacle may see it from both of its sides.
                motion = open_loop_plan(self.prediction, local.plan, request)
                local = self.prediction.linearize(motion, request)
                decision = self._decide_first(local, request, stopwatch, decision)
            return decision
        except FAILURES as error:
            stopwatch.lap("model")
            return request.failed_decision(_status_of(error), timing=stopwatch.timing)

    def _at_what_the_model_does(
        self, local: LocalProblem, request: Request
    ) -> LocalProblem:
        """Returns the problem at the first guess, or at what its inputs lead to.

        The latter where the model contradicts the guess: derivatives along states that
        no motion takes, multiplied over the horizon, may grow beyond any number; and
        where it has no number at a stage. States that were handed over are taken as
        they are, and one point that is held contradicts nothing.
        """
        if request.guessed_states is not None or self.prediction.is_held:
            return local
        if not is_contradicted(local.plan, local.stages, self._state_ranges):
            return local
        motion = open_loop_plan(self.prediction, local.plan, request)
        return self.prediction.linearize(motion, request)

    def _run_programs(
        self,
        local: LocalProblem,
        request: Request,
        stopwatch: Stopwatch,
        most_programs: int,
    ) -> Decision:
        """Returns the decision that up to so many programs lead to."""
        return _ControlStep(self, request, stopwatch, most_programs).run(local)

    def _decide_first(
        self,
        local: LocalProblem,
        request: Request,
        stopwatch: Stopwatch,
        failed: Decision | None = None,
    ) -> Decision:
        """Returns a decision without a plan to go on from.

        Args:
            local: The problem at a first guess.
            request: Of the decision.
            stopwatch: Likewise.
            failed: What another guess led to, whose programs count.
        """
        number_is_open = self.iterations is None and self._most_programs > 1
        # A curved bound lies elsewhere than one program sees it.
        if number_is_open and not self.prediction.constraints.smooth:
            decision = self._decide_whether_more_pay(local, request, stopwatch)
        else:
            decision = self._run_programs(
                local, request, stopwatch, self._most_programs
            )
        if failed is None:
            return decision
        return replace(decision, iterations=decision.iterations + failed.iterations)

    def _decide_whether_more_pay(
        self, local: LocalProblem, request: Request, stopwatch: Stopwatch
    ) -> Decision:
        """Returns a first decision of one program, unless more of them pay much.

        One program's first plan need not be consistent yet, and the next decisions lead
        it further than its horizon shows. A swing-up that is iterated at once may lean
        for ever.
        """
        quick = self._run_programs(local, request, stopwatch, most_programs=1)
        linearizer = self.prediction.linearizer
        if linearizer.depends_on_covariance or not quick.applicable:
            return quick
        if stopwatch.is_late:
            return quick
        try:
            thorough = self._run_programs(
                local, request, stopwatch, self._most_programs
            )
            pays = thorough.applicable and self._pays(thorough, quick, local, request)
        except FAILURES:  # more programs led out of the model's numbers
            return quick
        stopwatch.lap("model")
        return replace(
            thorough if pays else quick,
            iterations=quick.iterations + thorough.iterations,
            timing=stopwatch.timing,
        )

    def _pays(
        self,
        thorough: Decision,
        quick: Decision,
        local: LocalProblem,
        request: Request,
    ) -> bool:
        """Returns whether a decision is much better than one of a single program.

        Its inputs cost much less, or its plan misses a bound by less that the program
        had promised to keep.
        """
        promised = MISS_RATIO * quick.program_violation + KEPT
        if quick.violation > promised:
            return MISS_RATIO * thorough.violation < quick.violation
        outcome = self._outcome(thorough, local, request)
        return outcome.is_much_better_than(self._outcome(quick, local, request), _PAYS)

    def _outcome(
        self, decision: Decision, local: LocalProblem, request: Request
    ) -> Outcome:
        """Returns what the inputs of a decision lead to in the model."""
        try:
            return outcome_of_inputs(
                self.prediction, local, decision.inputs, decision.covariances, request
            )
        except FAILURES:
            return OUT_OF_NUMBERS

    def control_many(
        self,
        beliefs: Sequence[Gaussian],
        references: Sequence[Reference],
        previous: Sequence[Decision | None],
        parameters: Sequence[Any] | None = None,
    ) -> list[Decision]:
        """Decides for lists of the arguments of ``control``.

        The first stages of all of them are linearised in one call. The quadratic
        programs are solved one by one; the model's time is shared out equally.
        """
        start = perf_counter()
        all_parameters = parameters
        if all_parameters is None:
            all_parameters = [None] * len(beliefs)
        requests = [
            read_request(self.prediction, belief, reference, last, values)
            for belief, reference, last, values in zip(
                beliefs, references, previous, all_parameters, strict=True
            )
        ]
        finite = [request for request in requests if request.finite]
        try:
            guesses = [initial_guess(self.prediction, request) for request in finite]
            problems = iter(self.prediction.linearize_many(guesses, finite))
        except FAILURES:  # one of them spoils the batch: which one, they say alone
            return [
                self._decide(request, Stopwatch(self.budget)) for request in requests
            ]
        seconds = (perf_counter() - start) / max(1, len(finite))
        decisions = []
        for request in requests:
            local = next(problems) if request.finite else None
            stopwatch = Stopwatch(self.budget, seconds_before=seconds)
            decisions.append(self._decide(request, stopwatch, local))
        return decisions

    def novelty_when_read(
        self, means: Array, inputs: Array, covariances: Array
    ) -> float | Callable[[], float]:
        """Returns what measures the novelty of a plan when called; NaN without GPs.

        Args:
            means: Of its states (H + 1, n).
            inputs: (H, m).
            covariances: Of the states (H + 1, n, n).
        """
        if self.data_scales is None:
            return math.nan
        return novelty_when_read(
            self.prediction.model, means, inputs, covariances, self.data_scales
        )

    def with_model(self, model: DynamicsModel) -> "GPMPC":
        """Returns the controller for another model of as many states and inputs.

        It takes microseconds: the novelty of its plans is still measured by the ranges
        and variances of the first model's data, which would take longer to read anew.
        So what is learned in flight does not move the scale, and a plan that has left
        the ranges of that data counts as far from it.
        """
        other = copy(self)
        other.prediction = self.prediction.with_model(model)
        return other

    def gains(self, decision: Decision, parameters: Any = None) -> Array:
        """Returns K_0 .. K_{H-1} (H, m, n) of u = u_k - K_k (x - x_k).

        They are those of the regulator of the stages along a decision's plan;
        ``parameters`` are those that it was decided with.
        """
        if parameters is not None:
            parameters = read_parameters(parameters, self.horizon)
        local = linearize(
            self.prediction.model,
            decision.means[:-1],
            decision.inputs,
            covariance=False,
        )
        plan = Plan(decision.means, decision.inputs, decision.covariances)
        cost = self.prediction.costs.at(plan, parameters)
        return self.prediction.gains(local.A, local.B, cost)

    def stability(
        self,
        reference: Any,
        plant: DynamicsModel | None = None,
        ahead: DelayedModel | None = None,
        parameters: Any = None,
    ) -> Stability:
        """Tells before the loop runs whether it settles near a reference.

        It tells with which horizons, too; see ``Stability``.

        Args:
            reference: A set point (n,), or states of any number of steps (K + 1, n) of
                which some are judged.
            plant: A model of what is steered, of other gains, or with a
                ``DelayedModel`` around it; the controller's own model by default.
            ahead: The delay that the belief is predicted over (``DelayedModel.ahead``)
                where it is.
            parameters: Of outputs, as for ``control``.

        Raises:
            SettingError: The plant or the delay does not belong to the controller.
        """
        return stability(self.prediction, reference, plant, ahead, parameters)


@explains_arguments
class NonlinearGPMPC(GPMPC):
    """Nonlinear GP-MPC (Cao, Lai and Alam, 2017, eq. (22)), iterated to convergence.

    Its programs hold the whole belief: it is ``GPMPC`` of another covariance mode and
    more iterations; arguments as there.

    See Also:
        ``GPMPC``, which it makes; ``gpmpc.mpc.baselines.NMPC`` with a known
        model.
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
        super().__init__(
            model,
            propagator,
            problem,
            horizon,
            initial_input,
            prediction=PredictionSettings(covariance=covariance),
            iterations=iterations,
            tolerance=tolerance,
        )


class _Ending(NamedTuple):
    """What a round led to: its plan is the last one where the next round fails."""

    problem: LocalProblem  # with the plan
    program: CondensedProgram
    solution: QPSolution


class _ControlStep:
    """One decision's programs, from a first guess to a plan that is good enough."""

    def __init__(
        self,
        controller: GPMPC,
        request: Request,
        stopwatch: Stopwatch,
        most_programs: int,
    ):
        self._controller = controller
        self._prediction = controller.prediction
        self._request = request
        self._stopwatch = stopwatch
        self._most_programs = most_programs
        self._programs = 0  # solved so far
        self._solver = PricedSolver(
            prediction=self._prediction,
            solver=controller.solver,
            request=request,
            stopwatch=stopwatch,
        )
        self._globalization: Globalization | None = None
        self._squared_lengths: list[float] = []  # of the programs' steps
        self._ending: _Ending | None = None  # of the rounds before
        self._warm_start: QPSolution | None = None
        if request.last_plan is not None:
            self._warm_start = request.last_plan.solution

    def run(self, local: LocalProblem) -> Decision:
        """Returns the decision that programs lead to from the problem at a guess.

        Where a later round leaves the numbers of model or solver, the plan of the round
        before is the last one.
        """
        guess = local.plan
        try:
            return self._run_rounds(local, guess)
        except FAILURES as error:
            if self._ending is None:
                raise
            problem, program, solution = self._ending
            last_problem = self._close_defects(problem, problem, program)
            return self._conclude(last_problem, guess, solution, _status_of(error))

    def _run_rounds(self, local: LocalProblem, guess: Plan) -> Decision:
        """Returns the decision of ``run``.

        Each round solves the program of ``local`` and takes its step, which leads to
        the next ``local``. The last round is the one whose program fails, whose step
        says so by a status, or behind which a limit allows no other. Its plan is rolled
        out where it may not obey the dynamics. Where that misses a bound by more than
        the program promised, one more round starts at the plan that was rolled out.
        """
        while True:
            self._stopwatch.lap("model")
            program = self._condense(local)
            self._stopwatch.lap("build")
            solution = self._solve(program, local)
            self._stopwatch.lap("solve")
            if not _solution_is_usable(program, solution, local.plan):
                # The plan of the round before is the last one.
                has_left_guess = local.plan is not guess
                if has_left_guess:
                    local = self._close_defects(local, local, program)
                return self._conclude(local, guess, solution, solution.status)
            iterate = self._take_step(local, program, solution)
            if iterate.status is None and self._may_go_on:
                local = iterate.local
                has_left_guess = local.plan is not guess
                if has_left_guess:
                    self._ending = _Ending(local, program, solution)
                continue
            last_problem = self._rolled_out_where_needed(iterate, local, program)
            status = iterate.status
            is_rolled_out = last_problem is not iterate.local
            has_moved = iterate.local is not local  # else a program more says the same
            may_be_mended = is_rolled_out and has_moved
            if may_be_mended and self._breaks_promise(status, last_problem, solution):
                if self._may_go_on:
                    # A bound lies elsewhere than the program saw it.
                    self._ending = _Ending(last_problem, program, solution)
                    plan = last_problem.plan
                    local = self._prediction.linearize(plan, self._request)
                    self._solver.look_again()
                    continue
                if self._takes_plan_back(last_problem):
                    status = None
            if status is None:
                status = self._limit_reached
            return self._conclude(last_problem, guess, solution, status)

    @property
    def _may_go_on(self) -> bool:
        """Whether one more program may be solved."""
        return self._programs < self._most_programs and not self._stopwatch.is_late

    @property
    def _limit_reached(self) -> Status:
        """The limit that keeps the iteration from one more program."""
        if self._programs < self._most_programs:
            return Status.TIME_LIMIT
        return Status.ITERATION_LIMIT

    def _condense(self, local: LocalProblem) -> CondensedProgram:
        """Returns the quadratic program in the inputs."""
        program = condense(
            cost=local.cost,
            bounds=self._prediction.program_bounds,
            stages=local.stages,
            start=local.plan.states[0],
            references=self._request.references,
            rows=local.rows,
        )
        if self._globalization is not None:
            program = self._globalization.correct(program, local)
        return program

    def _solve(self, program: CondensedProgram, local: LocalProblem) -> QPSolution:
        """Returns the solution of a program, warm-started from the last one."""
        prices_before = self._solver.row_prices
        solution = self._solver.solve(program, local, self._warm_start)
        prices = self._solver.row_prices
        if prices is not prices_before and not np.array_equal(prices, prices_before):
            self._globalization = None  # it weighs by the prices before
        self._programs += 1
        self._warm_start = solution
        return solution

    def _take_step(
        self, local: LocalProblem, program: CondensedProgram, solution: QPSolution
    ) -> Iterate:
        """Takes a program's step: whole where that is enough, else globalised."""
        planned = local.with_solution(program, solution.x, self._request)
        if self._most_programs == 1:
            return Iterate(planned, solution.status)
        if self._may_stop_after_one:
            continuity = measure_continuity(
                self._prediction, self._request, local, planned.plan
            )
            if continuity.goes_on:
                # The next decision compares the length of its step with this one.
                self._squared_lengths.append(continuity.squared_length)
                return Iterate(planned, solution.status)
        if self._globalization is None:
            self._globalization = Globalization(
                self._prediction,
                self._request,
                self._controller.tolerance,
                self._solver.row_prices,
            )
        globalization = self._globalization
        iterate = globalization.take_step(local, program, solution, planned.plan)
        self._squared_lengths.append(globalization.squared_length)
        is_solved = iterate.status is Status.SOLVED
        has_loose_tolerance = self._controller.iterations is None
        return iterate._replace(needs_roll_out=not is_solved or has_loose_tolerance)

    @property
    def _may_stop_after_one(self) -> bool:
        """Whether the step may be taken whole, as in the real-time iteration.

        It may be by the first program of a decision that has a last plan to compare
        with, where it starts from another plan that was handed over, too: what counts
        is how far the last decision's step led. Under curved rows first plans may as
        well: a program is judged by the plan it leads to.
        """
        is_first_program = self._programs == 1
        number_is_open = self._controller.iterations is None
        has_last_plan = self._request.last_plan is not None
        is_curved = self._prediction.constraints.smooth
        return is_first_program and number_is_open and (has_last_plan or is_curved)

    def _rolled_out_where_needed(
        self, iterate: Iterate, local: LocalProblem, program: CondensedProgram
    ) -> LocalProblem:
        """Returns the problem of the plan that a step led to, rolled out where needed.

        Args:
            iterate: What the step led to.
            local: The problem that the step started from.
            program: Of that problem.
        """
        if iterate.needs_roll_out or self._prediction.rolls_out:
            return self._close_defects(iterate.local, local, program)
        return iterate.local

    def _close_defects(
        self, ending: LocalProblem, local: LocalProblem, program: CondensedProgram
    ) -> LocalProblem:
        """Returns a problem whose plan obeys the dynamics.

        It is the ending itself where that leads out of the model's numbers.
        """
        try:
            return close_defects(
                self._prediction, ending, local, program.feedback, self._request
            )
        except FAILURES:
            return ending

    def _breaks_promise(
        self, status: Status | None, ending: LocalProblem, solution: QPSolution
    ) -> bool:
        """Returns whether a solved plan misses bounds by more than its program.

        A program sees curved bounds, and the dynamics that lead to any, as they are at
        the plan before.
        """
        if not self._prediction.constraints.per_stage:
            return False
        if status is None or not status.solved:
            return False
        missed = ending.row_violations()
        row_promises = solution.violation()[-missed.size :].reshape(missed.shape)
        promised = row_promises.max(axis=0)
        return bool((missed.max(axis=0) > MISS_RATIO * promised + KEPT).any())

    def _takes_plan_back(self, ending: LocalProblem) -> bool:
        """Returns whether SOLVED becomes a limit, as a plan breaks its promise.

        It stays where a single program was asked for, and where a hard row is missed:
        as unsolved that plan would not be applied, and it is to be, as
        ``HARD_BOUND_MISSED``.
        """
        if self._most_programs == 1:
            return False
        return not self._prediction.misses_hard_rows(ending, FEASIBLE)

    def _violation(self, local: LocalProblem) -> float:
        """Returns by how much a plan misses a bound, at most."""
        last_input = self._request.references.previous_input
        return local.violation(self._prediction.program_bounds, last_input)

    def _conclude(
        self,
        local: LocalProblem,
        guess: Plan,
        solution: QPSolution,
        status: Status,
    ) -> Decision:
        """Returns the decision for a plan: failed if it is the guess or infeasible.

        A guess that was rolled out obeys the dynamics and counts as a plan.
        """
        self._stopwatch.lap("model")
        plan = local.plan
        suboptimal = False
        if not status.solved:
            misses = self._prediction.misses_hard_rows(local, FEASIBLE)
            has_left_guess = plan is not guess
            suboptimal = has_left_guess and not misses
            if not suboptimal:
                return self._failed_decision(solution, status)
        violation = self._violation(local)
        if status is Status.SOLVED:
            status = self._prediction.end_of_solved(local, violation)
            suboptimal = not status.solved
        means, covariances = self._prediction.linearizer.moments(
            plan.states, local.covariances
        )
        stage_costs = local.stage_costs(self._request.references)
        inputs = plan.inputs.copy()
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=covariances,
            status=status,
            iterations=self._programs,
            timing=self._stopwatch.timing,
            problem=QuadraticProgram._make(solution.arrays),
            solution=solution,
            disturbance=self._request.disturbance,
            suboptimal=suboptimal,
            plan_novelty=self._novelty(local, means, inputs, covariances),
            stage_costs=stage_costs,
            violation=violation,
            steps=tuple(self._squared_lengths),
        )

    def _failed_decision(self, solution: QPSolution, status: Status) -> Decision:
        """Returns the decision of a step that found no plan to apply."""
        failed = self._request.failed_decision(
            status, self._programs, self._stopwatch.timing
        )
        problem = QuadraticProgram._make(solution.arrays)
        return replace(failed, problem=problem, solution=solution)

    def _novelty(
        self, local: LocalProblem, means: Array, inputs: Array, covariances: Array
    ) -> float | Callable[[], float]:
        """Returns how far a plan is from the data.

        Where its stages hold no variances, it is to be measured when it is read.
        """
        scales = self._controller.data_scales
        linearizer = self._prediction.linearizer
        if scales is not None and linearizer.covariance == "zero_order":
            V = local.stages.V
            return novelty_of(V, linearizer.noise, covariances, scales)
        return self._controller.novelty_when_read(means, inputs, covariances)


def _check_iterations(iterations: int | None, prediction: PredictionSettings) -> None:
    """Raises ``SettingError`` unless a form may take so many programs."""
    if iterations is None:
        return
    check_number("iterations", iterations, least=1, whole=True)
    if iterations > 1 and not prediction.may_iterate:
        rule = f"form {prediction.form!r} is one quadratic program, so 1"
        raise SettingError("iterations", f"{rule}; got {iterations}")


def _status_of(error: Exception) -> Status:
    """Returns how a decision ends whose numbers were not finite."""
    if isinstance(error, FunctionNotFinite):
        return Status.FUNCTION_NOT_FINITE
    return Status.NUMERICAL_TROUBLE


def _solution_is_usable(
    program: CondensedProgram, solution: QPSolution, plan: Plan
) -> bool:
    """Returns whether a solution leads to a plan that is no worse.

    It does where it was solved, or where the solver stopped at a limit at a feasible
    point that costs no more than the plan. In feedback coordinates the plan has no
    unknowns of its own: there the point is compared with v = 0, the optimum without
    bounds, which costs least, so that it is used only where that breaks a hard row.
    """
    status = solution.status
    if status.solved:
        return True
    at_limit = status in (Status.ITERATION_LIMIT, Status.TIME_LIMIT)
    if not (at_limit and np.isfinite(solution.x).all()):
        return False
    if _hard_violation(solution) > FEASIBLE:
        return False
    unknowns = plan.inputs.ravel()
    if len(program.feedback):
        unknowns = 0.0 * solution.x
    alternative = solution._replace(x=unknowns)
    is_infeasible = _hard_violation(alternative) > FEASIBLE
    return is_infeasible or solution.objective <= alternative.objective


def _hard_violation(solution: QPSolution) -> float:
    """Returns the largest violation of a hard row."""
    hard = np.isinf(solution.caps)
    return float(solution.violation()[hard].max(initial=0.0))
