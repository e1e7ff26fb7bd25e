"""The program of ``gpmpc.mpc.gp_mpc`` with its states left in, in CVXPY, open to any convex constraint.

    minimise    sum_{k=1..H} |s_k - r_k|^2_{W_k} + sum_{k=0..H-1} |v_k|^2_R + price of violated bounds
    subject to  s_{k+1} = A_k s_k + B_k u_k + c_k,   bounds of inputs, increments and states

It has Parameters where disciplined parametrised programming allows them (Agrawal et al., 2019), so it is compiled once.
It is slower than the condensed program and gives the same inputs by another method: an independent check, and the
place to try a constraint of one's own, which takes one line:

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
from gpmpc.mpc._prediction import Prediction, PredictionModel, PredictionSettings
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc.controller import FEASIBLE, Decision, Reference, Request, Timing
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Propagator
from gpmpc.qp.cvxpy_ import STATUSES, TIGHT
from gpmpc.status import Status

Array = np.ndarray

_DEFAULT = PredictionSettings()


class StateFormMPC:
    """GP-MPC in states and inputs, one program a step.

    Args:
        model: What was learned.
        propagator: How the belief moves.
        problem: Weights and bounds.
        horizon: H.
        initial_input: The input before the first step (m,).
        prediction: As for ``GPMPC``.
        constraints: Of the states s_0 .. s_H (H + 1, p), whose first n columns are the means, and the inputs (H, m),
            two CVXPY variables: a list of constraints. Called once.
        solver: A CVXPY solver.
        options: The solver's own; tight tolerances for Clarabel by default.

    Raises:
        SettingError: As for ``GPMPC``; or a constraint that is not convex, or not parametrised by the rules.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        prediction: PredictionSettings = _DEFAULT,
        constraints: Callable[[Any, Any], list] | None = None,
        solver: str = "CLARABEL",
        options: dict | None = None,
    ):
        self.prediction = PredictionModel(model, propagator, problem, horizon, initial_input, prediction)
        self.initial_input, self.problem, self.horizon = self.prediction.initial_input, problem, horizon
        self.solver, self.options = solver, TIGHT.get(solver, {}) if options is None else options
        problem.check_plain("StateFormMPC")
        self._program = _Program(self.prediction, constraints)

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """Decides the input for one step; see ``GPMPC.control``."""
        from cvxpy.error import SolverError

        request, began = self.prediction.read(belief, reference, previous), perf_counter()
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            plan = self.prediction.initial_guess(request)
            prediction = self.prediction.linearize(plan, request)
            if not all(np.isfinite(part).all() for part in prediction.stages):
                raise DataError("the stages are not finite")
        except FAILURES:
            return request.failed_decision(Status.NUMERICAL_TROUBLE, timing=Timing(perf_counter() - began, 0.0, 0.0))
        modelled = perf_counter()
        self._program.set(prediction, request)
        built, program = perf_counter(), self._program.problem
        try:
            with warnings.catch_warnings():  # that a solution is inaccurate is said by its status
                warnings.simplefilter("ignore")
                program.solve(solver=self.solver, **{"warm_start": False} | self.options)
            status = STATUSES.get(program.status, Status.NUMERICAL_TROUBLE)
        except SolverError:
            status = Status.NUMERICAL_TROUBLE
        timing = Timing(modelled - began, built - modelled, perf_counter() - built)
        iterations = (program.solver_stats.num_iters or 0) if program.solver_stats else 0
        suboptimal = status is Status.ITERATION_LIMIT and self._program.feasible
        if not (status.solved or suboptimal):
            return request.failed_decision(status, iterations, timing)
        inputs, states = np.array(self._program.inputs.value), np.array(self._program.states.value)
        beliefs = self.prediction.linearizer.moments(states, prediction.covariances)
        disturbance = request.disturbance if self.prediction.settings.disturbance_gain else None
        ended: Any = {"disturbance": disturbance, "suboptimal": suboptimal}
        return Decision(inputs[0], inputs, *beliefs, status, iterations, timing, **ended)


class _Program:
    """The CVXPY problem with its parameters."""

    def __init__(self, model: PredictionModel, constraints: Callable[[Any, Any], list] | None):
        import cvxpy

        problem, H, m, rows = model.problem, model.horizon, model.problem.input_dim, model.constraints
        Q, R = problem.cost.by_stage(H)
        weights = [_factor(blocks) for blocks in model.linearizer.weight(Q)]
        p, K, r = len(weights[0]), model.points, rows.per_stage
        self.states, self.inputs = s, u = cvxpy.Variable((H + 1, p)), cvxpy.Variable((H, m))
        self._stages = [[cvxpy.Parameter(shape) for shape in ((p, p), (p, m), (p,))] for _ in range(K)]
        self._start, self._targets = cvxpy.Parameter(p), cvxpy.Parameter((H, p), value=np.zeros((H, p)))
        self._wanted, self._last = cvxpy.Parameter((H, m)), cvxpy.Parameter(m)
        rates = u - cvxpy.vstack([cvxpy.reshape(self._last, (1, m), order="C"), *([u[:-1]] if H > 1 else [])])
        penalized = {"inputs": u, "deviations": u - self._wanted, "increments": rates}[problem.cost.penalized]
        cost = sum(cvxpy.sum_squares(penalized[k] @ _factor(R[k : k + 1])) for k in range(H))
        cost += sum(cvxpy.sum_squares((s[k + 1] - self._targets[k]) @ weights[k]) for k in range(H))
        rules = [s[0] == self._start, *_within(u, *problem.inputs.by_stage(H))]
        rules += _within(rates, *problem.input_rates.by_stage(H))
        for k in range(H):
            A, B, c = self._stages[min(k, K - 1)]
            rules.append(s[k + 1] == A @ s[k] + B @ u[k] + c)
        self._rows, self._signs = [cvxpy.Parameter((r, p)) for _ in range(K if r else 0)], rows.signs
        if r:
            self._bounds, hard, applies = cvxpy.Parameter((H, r)), np.isinf(rows.prices), rows.applies
            slack = np.zeros((H, r))
            if rows.soft:
                slack = cvxpy.multiply(cvxpy.Variable((H, r), nonneg=True), np.tile(np.where(hard, 0.0, 1.0), (H, 1)))
                cost += cvxpy.sum(slack @ np.where(hard, 0.0, rows.prices))
            # Every bound as an upper one: the rows of lower bounds are handed over with their sign turned.
            at = [self._rows[min(k, K - 1)] @ s[k + 1] - self._bounds[k] - slack[k] for k in range(H)]
            rules += [at[k][np.flatnonzero(applies[k])] <= 0.0 for k in range(H) if applies[k].any()]
        rules += [] if constraints is None else list(constraints(s, u))
        self.problem = cvxpy.Problem(cvxpy.Minimize(cost), rules)
        if not self.problem.is_dpp():
            raise SettingError("constraints", "must be convex, and parametrised as CVXPY's rules (DPP) ask")

    @property
    def feasible(self) -> bool:
        """Whether the last iterate keeps all constraints."""
        values = [variable.value for variable in self.problem.variables()]
        if not all(value is not None and np.isfinite(value).all() for value in values):
            return False
        return all(np.max(rule.violation()) <= FEASIBLE for rule in self.problem.constraints)

    def set(self, prediction: Prediction, request: Request) -> None:
        """Gives all parameters their values of this step."""
        for parameters, values in zip(self._stages, zip(*prediction.stages[:3], strict=True), strict=True):
            for parameter, value in zip(parameters, values, strict=True):
                parameter.value = value
        self._start.value, self._last.value = prediction.plan.states[0], request.references.previous_input
        self._wanted.value, targets = request.references.inputs, np.zeros(self._targets.shape)
        targets[:, : request.references.states.shape[1]] = request.references.states
        self._targets.value = targets
        if self._rows:
            E, _, lower, upper = prediction.rows
            sign = self._signs
            for parameter, value in zip(self._rows, np.broadcast_to(E, (len(self._rows), *E.shape[1:])), strict=True):
                parameter.value = sign[:, None] * value
            bounds = np.where(sign > 0, upper, -lower)
            self._bounds.value = np.where(np.isfinite(bounds), bounds, 0.0)


def _factor(blocks: Array) -> Array:
    """F with F F' = W, for a block-diagonal weight (b, n, n)."""
    b, n = blocks.shape[:2]
    eigenvalues, vectors = np.linalg.eigh(blocks)
    roots = vectors * np.sqrt(np.clip(eigenvalues, 0, None))[:, None, :]
    whole = np.zeros((b, n, b, n))
    whole[np.arange(b), :, np.arange(b)] = roots
    return whole.reshape(b * n, b * n)


def _within(values: Any, lower: Array, upper: Array) -> list:
    """Constraints for the entries of bounds (H, m) on values (H, m) that are finite at every stage or at some."""
    below, above = (np.nonzero(np.isfinite(side)) for side in (lower, upper))
    rules = [values[below] >= lower[below]] if below[0].size else []
    return rules + ([values[above] <= upper[above]] if above[0].size else [])
