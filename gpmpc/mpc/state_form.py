"""Problem: the program of ``gpmpc.mpc.convex_mpc`` with the states left in it, open to any convex constraint.

    minimise    sum_{k=1..H} |s_k - r_k|^2_{W_k} + sum_{k=0..H-1} |v_k|^2_R + price of violated bounds
    subject to  s_{k+1} = A_k s_k + B_k u_k + c_k,   bounds of inputs, increments and states

Written in CVXPY (Diamond and Boyd, 2016) with Parameters where disciplined parametrised programming allows them
(Agrawal et al., 2019), so that it is compiled once. It is slower than the condensed program and gives the same inputs,
by another road: an independent check, and the place to try a constraint of one's own, which takes one line:

    StateFormMPC(..., constraints=lambda states, inputs: [states[1:, 0] + states[1:, 2] <= 5.0])
"""

import warnings
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from gpmpc.dynamics import DynamicsModel
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.chance_constraints import ChanceConstraints
from gpmpc.mpc.controller import Decision, Reference, Timing
from gpmpc.mpc.convergence import FEASIBLE
from gpmpc.mpc.convex_mpc import read_request
from gpmpc.mpc.prediction import Covariance, Form, Prediction, Predictor
from gpmpc.mpc.request import Request, check_controller, check_dynamics
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.propagation import Propagator
from gpmpc.qp.cvxpy_ import STATUSES, TIGHT
from gpmpc.status import Status

Array = np.ndarray


class StateFormMPC:
    """Convex GP-MPC in states and inputs, one program a step.

    Args:
        model: What was learned.
        propagator: How the belief moves.
        problem: Weights and bounds.
        horizon: H.
        initial_input: The input before the first step (m,).
        form: As for ``ConvexMPC``.
        covariance: As for ``ConvexMPC``.
        feedback: As for ``ConvexMPC``.
        disturbance_gain: As for ``ConvexMPC``.
        constraints: Of the states s_0 .. s_H (H + 1, p), whose first n columns are the means, and the inputs (H, m),
            two CVXPY variables: a list of constraints. Called once.
        solver: A CVXPY solver.
        options: The solver's own; tight tolerances for Clarabel by default.

    Raises:
        SettingError: As for ``ConvexMPC``; or a constraint that is not convex, or not parametrised by the rules.
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
        feedback: bool = True,
        disturbance_gain: float = 0.0,
        constraints: Callable[[Any, Any], list] | None = None,
        solver: str = "CLARABEL",
        options: dict | None = None,
    ):
        self.initial_input = check_controller(problem, *check_dynamics(model), horizon, initial_input)
        self.problem, self.horizon, self.solver = problem, horizon, solver
        self.options = TIGHT.get(solver, {}) if options is None else options
        self.predictor = Predictor(model, propagator, problem, horizon, form, covariance, feedback, disturbance_gain)
        self._chance = ChanceConstraints(problem.state_bounds, problem.state_dim, horizon, covariance)
        self._program = _Program(self.predictor, self._chance, constraints)

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """Decides the input for one step; see ``ConvexMPC.control``."""
        import cvxpy

        request = read_request(self.predictor, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.unanswered(Status.INVALID_MEASUREMENT)
        began = perf_counter()
        try:
            prediction = self.predictor.predict(request, previous)
        except DataError:  # the rollout left the finite numbers
            return request.unanswered(Status.NUMERICAL_TROUBLE, timing=Timing(perf_counter() - began, 0.0, 0.0))
        modelled = perf_counter()
        self._program.set(prediction, request, self._chance)
        built = perf_counter()
        program = self._program.problem
        try:
            with warnings.catch_warnings():  # that a solution is inaccurate is said by its status
                warnings.simplefilter("ignore")
                program.solve(solver=self.solver, **{"warm_start": False} | self.options)
            status = STATUSES.get(program.status, Status.NUMERICAL_TROUBLE)
        except cvxpy.error.SolverError:
            status = Status.NUMERICAL_TROUBLE
        timing = Timing(modelled - began, built - modelled, perf_counter() - built)
        iterations = (program.solver_stats.num_iters or 0) if program.solver_stats else 0
        suboptimal = status is Status.ITERATION_LIMIT and self._program.feasible
        if not (status.solved or suboptimal):
            return request.unanswered(status, iterations, timing)
        inputs = np.array(self._program.inputs.value)
        means, covariances = self.predictor.beliefs(prediction, inputs)
        disturbance = request.disturbance if self.predictor.disturbance_gain else None
        found = means, covariances, status, iterations, timing
        return Decision(inputs[0], inputs, *found, disturbance=disturbance, suboptimal=suboptimal)


class _Program:
    """The CVXPY problem with its parameters."""

    def __init__(self, predictor: Predictor, chance: ChanceConstraints, constraints: Callable[[Any, Any], list] | None):
        import cvxpy

        problem, H = predictor.problem, predictor.horizon
        n, m = problem.state_dim, problem.input_dim
        weight, terminal = predictor.extended(problem.Q), predictor.extended(problem.terminal)
        p, K = n * len(weight), H if predictor.form == "trajectory" else 1
        self.states, self.inputs = s, u = cvxpy.Variable((H + 1, p)), cvxpy.Variable((H, m))
        self._A = [cvxpy.Parameter((p, p)) for _ in range(K)]
        self._B = [cvxpy.Parameter((p, m)) for _ in range(K)]
        self._c = [cvxpy.Parameter(p) for _ in range(K)]
        self._start, self._targets = cvxpy.Parameter(p), cvxpy.Parameter((H, p), value=np.zeros((H, p)))
        self._wanted, self._last = cvxpy.Parameter((H, m)), cvxpy.Parameter(m)
        rates = u - cvxpy.vstack([cvxpy.reshape(self._last, (1, m), order="C"), *([u[:-1]] if H > 1 else [])])
        penalized = {"inputs": u, "deviations": u - self._wanted, "increments": rates}[problem.penalized]
        cost = cvxpy.sum_squares(penalized @ _factor(problem.R[None]))
        cost += cvxpy.sum_squares((s[H] - self._targets[H - 1]) @ _factor(terminal))
        if H > 1:
            cost += cvxpy.sum_squares((s[1:H] - self._targets[:-1]) @ _factor(weight))
        rules = [s[0] == self._start]
        for k in range(H):
            at = min(k, K - 1)
            rules.append(s[k + 1] == self._A[at] @ s[k] + self._B[at] @ u[k] + self._c[at])
        rules += _within(u, problem.input_lower, problem.input_upper)
        rules += _within(rates, problem.rate_lower, problem.rate_upper)
        self._rows, self._bounds = [], None
        if chance.per_stage:
            r = chance.per_stage
            self._rows = [cvxpy.Parameter((r, p)) for _ in range(K)]
            self._bounds = cvxpy.Parameter((H, r))
            slack = cvxpy.Variable((H, r), nonneg=True) if chance.soft else np.zeros((H, r))
            for k in range(H):
                # Every bound as an upper one: the rows of lower bounds are handed over with their sign turned.
                rules.append(self._rows[min(k, K - 1)] @ s[k + 1] <= self._bounds[k] + slack[k])
            if chance.soft:
                limits = problem.state_bounds
                cost += (limits.l1 or 0.0) * cvxpy.sum(slack) + (limits.l2 or 0.0) * cvxpy.sum_squares(slack)
        rules += [] if constraints is None else list(constraints(s, u))
        self.problem = cvxpy.Problem(cvxpy.Minimize(cost), rules)
        if not self.problem.is_dcp(dpp=True):
            raise SettingError("constraints", "must be convex, and parametrised as CVXPY's rules (DPP) ask")

    @property
    def feasible(self) -> bool:
        """Whether the last iterate keeps all constraints."""
        values = [variable.value for variable in self.problem.variables()]
        if not all(value is not None and np.isfinite(value).all() for value in values):
            return False
        return all(np.max(rule.violation()) <= FEASIBLE for rule in self.problem.constraints)

    def set(self, prediction: Prediction, request: Request, chance: ChanceConstraints) -> None:
        """Gives all parameters their values of this step."""
        for kind, values in ((self._A, prediction.A), (self._B, prediction.B), (self._c, prediction.c)):
            for parameter, value in zip(kind, values, strict=True):
                parameter.value = value
        self._start.value, self._last.value, self._wanted.value = prediction.start, request.last, request.wanted
        targets = np.zeros(self._targets.shape)
        targets[:, : request.targets.shape[1]] = request.targets
        self._targets.value = targets
        if self._rows:
            r = chance.per_stage
            rows, (lower, upper) = chance.rows(prediction)[:, :r], (side[:, :r] for side in chance.limits(prediction))
            turned = np.where(np.isfinite(upper[0]), 1.0, -1.0)
            rows = np.broadcast_to(rows, (len(self._rows), *rows.shape[1:])) * turned[:, None]
            for parameter, value in zip(self._rows, rows, strict=True):
                parameter.value = value
            self._bounds.value = np.where(turned > 0, upper, -lower)


def _factor(blocks: Array) -> Array:
    """F with F F' = W, for a block-diagonal weight (b, n, n)."""
    n = blocks.shape[1]
    eigenvalues, vectors = np.linalg.eigh(blocks)
    roots = vectors * np.sqrt(np.clip(eigenvalues, 0, None))[:, None, :]
    whole = np.zeros((len(blocks) * n, len(blocks) * n))
    for b, root in enumerate(roots):
        whole[b * n : (b + 1) * n, b * n : (b + 1) * n] = root
    return whole


def _within(values: Any, lower: Array, upper: Array) -> list:
    """Constraints for the finite entries of bounds (m,) on values (H, m)."""
    below, above = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
    length = values.shape[0]
    rules = []
    if len(below):
        rules.append(values[:, below] >= np.tile(lower[below], (length, 1)))
    if len(above):
        rules.append(values[:, above] <= np.tile(upper[above], (length, 1)))
    return rules
