"""GP model predictive control: the control step, from a belief and a reference.

A decision follows the method in its order:

    request    belief, reference and last plan are read            (``_guess``)
    plan       a first guess: the last plan, shifted               (``_guess``)
    local      stages, covariances, rows and cost at the plan      (``_linearization``)
    program    the states eliminated                               (``_condense``)
    solution   of the quadratic program                      (``_priced_solver``)
    step       taken whole, or as far as it pays                   (``_sqp``)
    decision   the plan, judged                           (``_control_step``)

Its loop is ``_control_step.ControlStep.run``. What stands here chooses the guess, and
how many programs a first plan takes.

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
from typing import Any

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel, linearize
from gpmpc.exceptions import SettingError, check_method, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.models import DelayedModel
from gpmpc.mpc._control_step import ControlStep, StepSettings, Stopwatch, status_of
from gpmpc.mpc._controller import (
    KEPT,
    Decision,
    Reference,
    Request,
    read_parameters,
)
from gpmpc.mpc._guess import (
    initial_guess,
    is_contradicted,
    open_loop_plan,
    read_request,
)
from gpmpc.mpc._linear_quadratic import (
    Covariance,
    Plan,
)
from gpmpc.mpc._linearization import LocalProblem, PredictionModel, PredictionSettings
from gpmpc.mpc._novelty import data_scales, novelty_when_read
from gpmpc.mpc._roll_out import (
    MISS_RATIO,
    OUT_OF_NUMBERS,
    Outcome,
    outcome_of_inputs,
)
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc._stability import Stability, stability
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Propagator
from gpmpc.qp import DualActiveSet, QPSolver
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
            return request.failed_decision(status_of(error), timing=stopwatch.timing)

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
        settings = StepSettings(
            prediction=self.prediction,
            solver=self.solver,
            tolerance=self.tolerance,
            number_is_open=self.iterations is None,
            data_scales=self.data_scales,
        )
        return ControlStep(settings, request, stopwatch, most_programs).run(local)

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
        if stopwatch.is_late():
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
            ShapeError: A reference of another number of states.
            DataError: One that is not finite.
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


def _check_iterations(iterations: int | None, prediction: PredictionSettings) -> None:
    """Raises ``SettingError`` unless a form may take so many programs."""
    if iterations is None:
        return
    check_number("iterations", iterations, least=1, whole=True)
    if iterations > 1 and not prediction.may_iterate:
        rule = f"form {prediction.form!r} is one quadratic program, so 1"
        raise SettingError("iterations", f"{rule}; got {iterations}")
