"""The program of ``GPMPC`` with its states left in, in CVXPY, open to any constraint.

    minimise    sum_{k=1..H} |s_k - r_k|^2_{W_k} + sum_{k=0..H-1} |v_k|^2_R
                + price of violated bounds
    subject to  s_{k+1} = A_k s_k + B_k u_k + c_k,
                bounds of inputs, increments and states

It has Parameters where disciplined parametrised programming allows them (Agrawal et
al., 2019), so it is compiled once. It is slower than the condensed program and gives
the same inputs by another method: an independent check, and the place to try a convex
constraint of one's own, which takes one line:

    StateFormMPC(
        ..., constraints=lambda states, inputs: [states[1:, 0] + states[1:, 2] <= 5.0]
    )
"""

import warnings
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.mpc._constraints import ConstraintRows
from gpmpc.mpc._controller import (
    FEASIBLE,
    Decision,
    Reference,
    Request,
    Timing,
)
from gpmpc.mpc._guess import initial_guess, read_request
from gpmpc.mpc._linear_quadratic import Plan
from gpmpc.mpc._linearization import (
    LocalProblem,
    PredictionModel,
    PredictionSettings,
)
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Propagator
from gpmpc.qp._cvxpy import STATUSES, TIGHT
from gpmpc.status import Status

Array = np.ndarray
Constraints = Callable[[Any, Any], list]

_DEFAULT = PredictionSettings()


@explains_arguments
class StateFormMPC:
    """GP-MPC in states and inputs, one program a step.

    Elastic bounds have the exact price here, also where they cannot be kept.

    Args:
        model: As for ``GPMPC``.
        propagator: As for ``GPMPC``.
        problem: As for ``GPMPC``.
        horizon: As for ``GPMPC``.
        initial_input: As for ``GPMPC``.
        prediction: As for ``GPMPC``.
        constraints: Of the states s_0 .. s_H (H + 1, p), whose first n columns are the
            means, and the inputs (H, m), two CVXPY variables: a list of constraints.
            Called once.
        solver: A CVXPY solver.
        options: The solver's own; tight tolerances for Clarabel by default.

    Raises:
        SettingError: As for ``GPMPC``; or a constraint that is not convex, or not
            parametrised by the rules.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        prediction: PredictionSettings = _DEFAULT,
        constraints: Constraints | None = None,
        solver: str = "CLARABEL",
        options: dict | None = None,
    ):
        self.prediction = PredictionModel(
            model, propagator, problem, horizon, initial_input, prediction
        )
        self.initial_input = self.prediction.initial_input
        self.problem = self.prediction.stated_problem
        self.horizon = horizon
        self.solver = solver
        self.options = TIGHT.get(solver, {}) if options is None else options
        self.problem.check_plain("StateFormMPC")
        self.signals = self.prediction.stated_signals
        self._program = _StateFormProgram(self.prediction, constraints)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Decides the input for one step; see ``GPMPC.control``."""
        request = read_request(self.prediction, belief, reference, previous)
        start = perf_counter()
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            prediction = self._linearize(request)
        except FAILURES:
            timing = Timing(model=perf_counter() - start)
            return request.failed_decision(Status.NUMERICAL_TROUBLE, timing=timing)
        linearized = perf_counter()
        program = self._program
        program.set_parameters(prediction, request)
        built = perf_counter()
        status = program.solve(self.solver, {"warm_start": False} | self.options)
        timing = Timing(
            model=linearized - start,
            build=built - linearized,
            solve=perf_counter() - built,
        )
        suboptimal = status is Status.ITERATION_LIMIT and program.is_feasible()
        if not (status.solved or suboptimal):
            return request.failed_decision(status, program.iterations, timing)
        inputs = np.ascontiguousarray(program.inputs.value)
        states = np.ascontiguousarray(program.states.value)
        linearizer = self.prediction.linearizer
        means, covariances = linearizer.moments(states, prediction.covariances)
        plan = Plan(states, inputs, prediction.covariances)
        planned = prediction._replace(plan=plan)
        violation = planned.violation(
            self.prediction.program_bounds, request.references.previous_input
        )
        if status is Status.SOLVED:
            status = self.prediction.end_of_solved(planned, violation)
            suboptimal = not status.solved
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=covariances,
            status=status,
            iterations=program.iterations,
            timing=timing,
            disturbance=request.disturbance,
            suboptimal=suboptimal,
            stage_costs=planned.stage_costs(request.references),
            violation=violation,
        )

    def _linearize(self, request: Request) -> LocalProblem:
        """Returns the prediction along the first guess.

        Raises:
            DataError: It is not finite, or a bound that applies is not.
        """
        guess = initial_guess(self.prediction, request)
        prediction = self.prediction.linearize(guess, request)
        if not all(np.isfinite(part).all() for part in prediction.stages):
            raise DataError("the stages are not finite")
        if not self._program.has_finite_bounds(prediction):
            raise DataError(
                "bounds, less what covariances take of them, are not finite"
            )
        return prediction


class _StateFormProgram:
    """The CVXPY problem of all steps, with its parameters.

    Args:
        model: Whose stages it takes.
        constraints: Further ones of states and inputs.

    Attributes:
        states: s_0 .. s_H (H + 1, p), a variable.
        inputs: u_0 .. u_{H-1} (H, m), a variable.
    """

    def __init__(self, model: PredictionModel, constraints: Constraints | None):
        import cvxpy

        problem = model.problem
        H = model.horizon
        m = problem.input_dim
        Q, R = problem.cost.by_stage(H)
        weights = [_factor(blocks) for blocks in model.linearizer.weight(Q)]
        p = len(weights[0])
        self._problem = problem
        self._horizon = H
        self._stage_count = model.stage_count
        self.states = cvxpy.Variable((H + 1, p))
        self.inputs = cvxpy.Variable((H, m))
        self._A = [cvxpy.Parameter((p, p)) for _ in range(model.stage_count)]
        self._B = [cvxpy.Parameter((p, m)) for _ in range(model.stage_count)]
        self._c = [cvxpy.Parameter(p) for _ in range(model.stage_count)]
        self._start = cvxpy.Parameter(p)
        self._targets = cvxpy.Parameter((H, p), value=np.zeros((H, p)))
        self._reference_inputs = cvxpy.Parameter((H, m))
        self._previous_input = cvxpy.Parameter(m)

        increments = self._increments()
        cost = self._tracking_cost(weights, R, increments)
        rules = [
            self.states[0] == self._start,
            *_within(self.inputs, *problem.inputs.by_stage(H)),
            *_within(increments, *problem.input_rates.by_stage(H)),
            *self._dynamics(),
        ]
        self._rows = model.constraints
        self._row_values: list[Any] = []  # parameters, a point each
        self._row_bounds: Any = None  # a parameter
        if self._rows.per_stage:
            price, row_rules = self._constrain_states(self._rows)
            cost += price
            rules += row_rules
        if constraints is not None:
            rules += list(constraints(self.states, self.inputs))
        self._program = cvxpy.Problem(cvxpy.Minimize(cost), rules)
        if not self._program.is_dpp():
            raise SettingError(
                "constraints",
                "must be convex, and parametrised as CVXPY's rules (DPP) ask",
            )

    def _tracking_cost(self, weights: list[Array], R: Array, increments: Any) -> Any:
        """Returns the cost of states, by factors of their weights, and of inputs."""
        import cvxpy

        penalized = {
            "inputs": self.inputs,
            "deviations": self.inputs - self._reference_inputs,
            "increments": increments,
        }[self._problem.cost.penalized]
        stages = range(self._horizon)
        errors = [self.states[k + 1] - self._targets[k] for k in stages]
        cost = sum(
            cvxpy.sum_squares(penalized[k] @ _factor(R[k : k + 1])) for k in stages
        )
        cost += sum(cvxpy.sum_squares(errors[k] @ weights[k]) for k in stages)
        return cost

    def _increments(self) -> Any:
        """Returns u_k - u_{k-1} (H, m) as an expression."""
        import cvxpy

        m = self._problem.input_dim
        first = cvxpy.reshape(self._previous_input, (1, m), order="C")
        before: list[Any] = [first]
        if self._horizon > 1:
            before.append(self.inputs[:-1])
        return self.inputs - cvxpy.vstack(before)

    def _dynamics(self) -> list[Any]:
        """Returns s_{k+1} = A_k s_k + B_k u_k + c_k, a constraint a stage."""
        s = self.states
        u = self.inputs
        rules = []
        for k in range(self._horizon):
            point = self._point(k)
            A = self._A[point]
            B = self._B[point]
            rules.append(s[k + 1] == A @ s[k] + B @ u[k] + self._c[point])
        return rules

    def _point(self, k: int) -> int:
        """Returns the point of stage k; later stages share the last one."""
        return min(k, self._stage_count - 1)

    def _constrain_states(self, rows: ConstraintRows) -> tuple[Any, list[Any]]:
        """Returns the price of violated soft bounds, and all bounds as constraints.

        Every bound is an upper one: ``set_parameters`` turns the sign of the rows of
        lower bounds.
        """
        import cvxpy

        H = self._horizon
        r = rows.per_stage
        p = self.states.shape[1]
        self._row_values = [cvxpy.Parameter((r, p)) for _ in range(self._stage_count)]
        self._row_bounds = cvxpy.Parameter((H, r))
        hard = np.isinf(rows.prices)
        price: Any = 0.0
        slack: Any = np.zeros((H, r))
        if rows.soft:
            is_soft = np.tile(np.where(hard, 0.0, 1.0), (H, 1))
            slack = cvxpy.multiply(cvxpy.Variable((H, r), nonneg=True), is_soft)
            price = cvxpy.sum(slack @ np.where(hard, 0.0, rows.prices))
        rules = []
        for k in range(H):
            if not rows.applies[k].any():
                continue
            values = self._row_values[self._point(k)] @ self.states[k + 1]
            excess = values - self._row_bounds[k] - slack[k]
            rules.append(excess[np.flatnonzero(rows.applies[k])] <= 0.0)
        return price, rules

    def set_parameters(self, prediction: LocalProblem, request: Request) -> None:
        """Gives all parameters their values of this step."""
        stages = prediction.stages
        for point in range(self._stage_count):
            self._A[point].value = stages.A[point]
            self._B[point].value = stages.B[point]
            self._c[point].value = stages.c[point]
        references = request.references
        targets = np.zeros(self._targets.shape)
        targets[:, : self._problem.state_dim] = references.states
        self._start.value = prediction.plan.states[0]
        self._targets.value = targets
        self._reference_inputs.value = references.inputs
        self._previous_input.value = references.previous_input
        if not self._row_values:
            return
        rows = prediction.rows
        signs = self._rows.signs
        E = np.broadcast_to(rows.E, (self._stage_count, *rows.E.shape[1:]))
        for parameter, value in zip(self._row_values, E, strict=True):
            parameter.value = signs[:, None] * value
        bounds = np.where(signs > 0, rows.upper, -rows.lower)
        # Those that do not apply are in no constraint.
        self._row_bounds.value = np.where(np.isfinite(bounds), bounds, 0.0)

    def has_finite_bounds(self, prediction: LocalProblem) -> bool:
        """Tells whether all rows that apply have finite bounds."""
        if not self._row_values:
            return True
        rows = prediction.rows
        bounds = np.where(self._rows.signs > 0, rows.upper, -rows.lower)
        return bool(np.isfinite(bounds[self._rows.applies]).all())

    def solve(self, solver: str, options: dict) -> Status:
        """Solves it; returns how that ended."""
        from cvxpy.error import SolverError

        try:
            # That a solution is inaccurate is said by its status.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._program.solve(solver=solver, **options)
        except SolverError:
            return Status.NUMERICAL_TROUBLE
        return STATUSES.get(self._program.status, Status.NUMERICAL_TROUBLE)

    @property
    def iterations(self) -> int:
        """Number of the solver's iterations; 0 where it does not say."""
        stats = self._program.solver_stats
        if stats is None:
            return 0
        return stats.num_iters or 0

    def is_feasible(self) -> bool:
        """Tells whether the last iterate keeps all constraints."""
        values = [variable.value for variable in self._program.variables()]
        if any(value is None or not np.isfinite(value).all() for value in values):
            return False
        rules = self._program.constraints
        return all(np.max(rule.violation()) <= FEASIBLE for rule in rules)


def _factor(blocks: Array) -> Array:
    """Returns F with F F' = W, for a block-diagonal weight (b, n, n)."""
    b, n = blocks.shape[:2]
    eigenvalues, vectors = np.linalg.eigh(blocks)
    roots = vectors * np.sqrt(np.clip(eigenvalues, 0, None))[:, None, :]
    whole = np.zeros((b, n, b, n))
    whole[np.arange(b), :, np.arange(b)] = roots
    return whole.reshape(b * n, b * n)


def _within(values: Any, lower: Array, upper: Array) -> list[Any]:
    """Returns constraints for the finite ones of bounds (H, m) on values (H, m)."""
    below = np.nonzero(np.isfinite(lower))
    above = np.nonzero(np.isfinite(upper))
    rules = []
    if below[0].size:
        rules.append(values[below] >= lower[below])
    if above[0].size:
        rules.append(values[above] <= upper[above])
    return rules
