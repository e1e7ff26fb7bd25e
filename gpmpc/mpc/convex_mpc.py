"""Problem: steer an uncertain system by one convex program a step, although its model is a Gaussian process.

The belief's future is taken as affine in the inputs (``gpmpc.mpc.prediction`` says how), the states are eliminated
(``gpmpc.mpc.condense``), and what is left is a quadratic program in the inputs: the convex GP-MPC of Cao, Lai and
Alam (2017, section 4), and its time-varying relatives.

With ``form="trajectory"`` the program is that of a Gauss-Newton step from the last plan, shifted: one of them a control
step is the real-time iteration (Diehl, Bock and Schloeder, 2005). More of them solve the nonlinear problem itself, by
sequential quadratic programming (``gpmpc.mpc.sequential``). What is stationary there:

* ``full``, ``diagonal``: the expected cost of the propagated belief, tr(Q Sigma) included, under chance constraints.
* ``zero_order``: the cost of the means under bounds tightened by the covariances that the solution itself leads to;
  that these depend on the inputs is left out of the derivatives.
* ``none``: the cost of the means.
"""

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
import torch

from gpmpc.dynamics import DynamicsModel
from gpmpc.exceptions import DataError, ProblemError, SettingError, ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.batched_prediction import bytes_per_request, predict_many
from gpmpc.mpc.chance_constraints import ChanceConstraints
from gpmpc.mpc.condense import Condenser, StateRows
from gpmpc.mpc.controller import Decision, Reference, Timing
from gpmpc.mpc.convergence import FEASIBLE
from gpmpc.mpc.linear_quadratic import References, Stages, expand
from gpmpc.mpc.prediction import Covariance, Form, Prediction, Predictor
from gpmpc.mpc.request import Request, check_controller, check_dynamics, check_method
from gpmpc.mpc.sequential import Reached, SequentialPrograms
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.propagation import Propagator
from gpmpc.qp import DualActiveSet, Prepared, QPSolution, QPSolver, QuadraticProgram, SoftRows
from gpmpc.status import Status

Array = np.ndarray

FAILED = (DataError, ProblemError, np.linalg.LinAlgError, torch.linalg.LinAlgError)  # no finite numbers


class _Stacked(NamedTuple):
    """A quadratic program as its solver takes it, bounds on [U; G U]."""

    P: Array
    q: Array
    G: Array
    lower: Array
    upper: Array
    feedback: Array
    soft: SoftRows | None
    prepared: Prepared | None


class _Held(NamedTuple):
    """What was made of the last A, B and E that were held."""

    A: Array
    B: Array
    rows: Array
    prepared: Prepared | None


class ConvexMPC:
    """Convex GP-MPC.

    Args:
        model: What was learned.
        propagator: How the belief moves; ``covariance="none"`` needs the model's mean only.
        problem: Weights and bounds.
        horizon: H, the number of predicted states.
        initial_input: The input before the first step, and the first guess of every planned one (m,).
        form: ``"increment"``, ``"deviation"`` or ``"trajectory"``; see ``gpmpc.mpc.prediction``.
        covariance: ``"full"``, ``"diagonal"``, ``"zero_order"`` or ``"none"``; see there.
        solver: Of the quadratic program; ``DualActiveSet()`` by default, which state bounds with a price need.
        iterations: Quadratic programs a step at most; more than one for ``"trajectory"`` only.
        tolerance: Of more iterations: how far the plan may be from a KKT point, as a cosine (``sequential.kkt_share``);
            estimated from the slower of the last two rates of convergence, measured to within ten times. It is enough,
            too, that no step lowers the cost and what is left to gain is round-off. 1e-8 may be out of reach.
        feedback: Rolls plans out, and predicts the covariances of ``"zero_order"``, under an ancillary feedback,
            without which no long horizon with state bounds is feasible. ``"full"`` and ``"diagonal"`` predict their
            covariances without feedback.
        disturbance_gain: L, how fast a constant error of the model is made up for: 0 leaves it, with an offset of the
            state; 1 takes all of what the last step showed, its noise too. See ``gpmpc.mpc.prediction``.

    Attributes:
        soft: Prices of the rows of the program's G, None where all are hard.

    Raises:
        SettingError: A setting is unknown or out of its range, or model and problem have other dimensions.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: TrackingProblem,
        horizon: int,
        initial_input: Sequence[float],
        form: Form = "trajectory",
        covariance: Covariance = "zero_order",
        solver: QPSolver | None = None,
        iterations: int = 1,
        tolerance: float = 1e-6,
        feedback: bool = True,
        disturbance_gain: float = 0.0,
    ):
        self.initial_input = check_controller(problem, *check_dynamics(model), horizon, initial_input)
        check_number("iterations", iterations, least=1, whole=True)
        check_number("tolerance", tolerance, above=0)
        if iterations > 1 and form != "trajectory":
            raise SettingError("iterations", f"form {form!r} is one quadratic program, so 1; got {iterations}")
        self.problem, self.horizon, self.iterations, self.tolerance = problem, horizon, iterations, tolerance
        self.solver = DualActiveSet() if solver is None else solver
        check_method("solver", self.solver, "solve", "DualActiveSet()")
        self.predictor = Predictor(model, propagator, problem, horizon, form, covariance, feedback, disturbance_gain)
        weights = self.predictor.extended(problem.Q), self.predictor.extended(problem.terminal)
        self._condenser = Condenser(problem, horizon, *weights)
        self._chance = ChanceConstraints(problem.state_bounds, problem.state_dim, horizon, covariance)
        self.soft = self._chance.softness(self._condenser.bounds.rate_lower.size)
        if self.soft is not None and not isinstance(self.solver, DualActiveSet):
            raise SettingError(
                "solver", f"state bounds with a price (l1, l2) need DualActiveSet; got {type(self.solver).__name__}"
            )
        rest = (self._chance, self.solver, self.soft, iterations, tolerance)
        self._sequence = SequentialPrograms(self.predictor, self._condenser, *rest) if iterations > 1 else None
        self._held: _Held | None = None  # remembered for speed; no answer depends on it

    def build(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> QuadraticProgram:
        """The (first) quadratic program of a step, checked.

        Its unknowns are the inputs u_0 .. u_{H-1}, one after the other. Rows of G: increments u_k - u_{k-1} where they
        are bounded, then the bounded states of the stages 1 to H, upper bounds first; ``soft`` has their prices.

        Args:
            belief: As for ``control``.
            reference: As for ``control``.
            previous: As for ``control``.

        Raises:
            ShapeError: As for ``control``.
            DataError: The belief is not finite, or it does not stay so.
            ProblemError: The program is malformed, numerically.
        """
        request = read_request(self.predictor, self.initial_input, belief, reference, previous)
        prediction = self.predictor.predict(request, previous)
        return QuadraticProgram.from_stacked(*self._stack(prediction, request)[:5])

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """Decides the input for one step; see ``Controller.control``.

        A belief that is not finite is answered with ``INVALID_MEASUREMENT``. ``iterations`` of the decision counts
        quadratic programs; with more than one allowed, ``ITERATION_LIMIT`` says that the tolerance was not reached, and
        the plan is the best that was: ``suboptimal``.

        Args:
            belief: What is known of the state.
            reference: Over the horizon, with inputs where the form or the weights ask for them.
            previous: The last decision; one that is not applicable is ignored.

        Raises:
            ShapeError: Belief or reference have other dimensions, or reference inputs are missing.
        """
        request = read_request(self.predictor, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.unanswered(Status.INVALID_MEASUREMENT)
        began = perf_counter()
        try:
            if self._sequence is not None:
                return self._decide(request, self._sequence(request, previous, _warm(previous)))
            prediction = self.predictor.predict(request, previous)
        except FAILED:
            return request.unanswered(Status.NUMERICAL_TROUBLE, timing=Timing(perf_counter() - began, 0.0, 0.0))
        return self._answer(request, prediction, previous, perf_counter() - began)

    def control_many(
        self, beliefs: Sequence[Gaussian], references: Sequence[Reference], previous: Sequence[Decision | None]
    ) -> list[Decision]:
        """What ``control`` answers to each of T questions, its model asked for all of them at once.

        The model answers a stage of all T at a time; the quadratic programs are solved one by one. The model's time is
        shared out equally.

        Args:
            beliefs: T, one a question.
            references: T.
            previous: T decisions, None where there is none.

        Raises:
            ShapeError: As for ``control``.
            SettingError: More than one quadratic program a step: each question would need its own line search.
        """
        if self.iterations > 1:
            raise SettingError("iterations", f"many questions at once take 1 quadratic program; got {self.iterations}")
        asked = list(zip(beliefs, references, previous, strict=True))
        requests = [read_request(self.predictor, self.initial_input, *question) for question in asked]
        known, began = [t for t, request in enumerate(requests) if request.finite], perf_counter()
        try:
            found = predict_many(self.predictor, [requests[t] for t in known], [previous[t] for t in known])
        except FAILED:  # one of them spoils the batch: which one, they say alone
            return [self.control(*question) for question in asked]
        spent, predictions = (perf_counter() - began) / max(1, len(known)), dict(zip(known, found, strict=True))
        answers = {t: self._answer(requests[t], made, previous[t], spent) for t, made in predictions.items()}
        return [answers.get(t) or r.unanswered(Status.INVALID_MEASUREMENT) for t, r in enumerate(requests)]

    @property
    def bytes_per_question(self) -> int | None:
        """Memory that ``control_many`` takes for each question at most [bytes]; None where it cannot be known."""
        return bytes_per_request(self.predictor)

    def _answer(self, request: Request, prediction: Prediction, previous: Decision | None, modelled: float) -> Decision:
        """The decision of one quadratic program; ``modelled`` is the time that the prediction took [s]."""
        began = perf_counter()
        try:
            stacked = self._stack(prediction, request)
            built = perf_counter()
            solution = self._solve(stacked, _warm(previous))
        except FAILED:
            timing = Timing(modelled + perf_counter() - began, 0.0, 0.0)
            return request.unanswered(Status.NUMERICAL_TROUBLE, timing=timing)
        timing = Timing(modelled, built - began, perf_counter() - built)
        stages, program = Stages(prediction.A, prediction.B, prediction.c), QuadraticProgram.unchecked(*stacked[:5])
        inputs, states = expand(stages, prediction.start, stacked.feedback, request.last, solution.x)
        ended = solution.status, _improves(solution, request.shifted.ravel()), 1
        return self._decide(request, Reached(*ended, timing, program, solution, inputs, states, prediction.covariances))

    def _stack(self, prediction: Prediction, request: Request) -> _Stacked:
        A, B, rows = prediction.A, prediction.B, self._chance.rows(prediction)
        low, high = self._chance.limits(prediction)
        references = References(request.targets, request.wanted, request.last)
        stages, state_rows = Stages(A, B, prediction.c), StateRows(rows, low, high)
        program = self._condenser.condense(stages, prediction.start, references, state_rows)
        plain, held = not len(program.feedback), self._held if len(A) == 1 else None
        soft = self.soft if plain else self._chance.softness(len(program.G) - low.size)
        if held is not None and plain and all(map(np.array_equal, (A, B, rows), held[:3])):
            if held.prepared is None and isinstance(self.solver, DualActiveSet):  # seen twice: it may well stay
                held = self._held = held._replace(prepared=self.solver.prepare(program.P, program.G, soft))
        else:
            held = self._held = _Held(A, B, rows, None) if len(A) == 1 else None
        return _Stacked(*program, soft, None if held is None else held.prepared)

    def _solve(self, stacked: _Stacked, warm: QPSolution | None) -> QPSolution:
        P, q, G, lower, upper, _, soft, prepared = stacked
        if prepared is not None:
            return prepared.solve(q, lower, upper, warm)
        if isinstance(self.solver, DualActiveSet):
            return self.solver.solve(QuadraticProgram.unchecked(P, q, G, lower, upper), warm, soft)
        warm = warm if warm is not None and len(warm.q) == len(q) and len(warm.lower) == len(lower) else None
        return self.solver.solve(QuadraticProgram.from_stacked(P, q, G, lower, upper), warm)

    def _decide(self, request: Request, reached: Reached) -> Decision:
        status, suboptimal, count, timing, program, solution, inputs, states, covariances = reached
        if not (status.solved or suboptimal):
            return replace(request.unanswered(status, count, timing), problem=program, solution=solution)
        inputs = inputs.copy()
        predicted = self.predictor.moments(states, covariances)
        disturbance = request.disturbance if self.predictor.disturbance_gain else None
        found = program, solution, disturbance, suboptimal
        return Decision(inputs[0], inputs, *predicted, status, count, timing, *found)


def read_request(
    predictor: Predictor, initial_input: Array, belief: Gaussian, reference: Reference, previous: Decision | None
) -> Request:
    """The checked question of a step.

    Raises:
        ShapeError: Belief or reference have other dimensions, or reference inputs are missing.
    """
    problem, H = predictor.problem, predictor.horizon
    request = Request.read(problem, H, initial_input, belief, reference, previous)
    if reference.inputs is None and (predictor.form == "deviation" or problem.penalized == "deviations"):
        what = "form 'deviation'" if predictor.form == "deviation" else "penalized 'deviations'"
        raise ShapeError(f"{what} needs reference inputs ({H}, {problem.input_dim}); got none")
    if predictor.disturbance_gain and request.finite:
        return request._replace(disturbance=predictor.disturbance(request, previous))
    return request


def _warm(previous: Decision | None) -> QPSolution | None:
    return previous.solution if previous is not None and previous.applicable else None


def _improves(solution: QPSolution, plan: Array) -> bool:
    """Whether a solver that stopped at a limit got to a feasible point, and no worse one than a plan (H m,)."""
    if solution.status not in (Status.ITERATION_LIMIT, Status.TIME_LIMIT) or not np.isfinite(solution.x).all():
        return False
    other = solution._replace(x=plan)
    if not _missed(solution) <= FEASIBLE:
        return False
    return solution.objective <= other.objective or _missed(other) > FEASIBLE


def _missed(solution: QPSolution) -> float:
    """The largest violation of a hard row."""
    softness, caps = solution.terms.softness
    return float(solution.violation()[(softness == 0.0) & np.isinf(caps)].max(initial=0.0))
