"""Controllers to compare with: nonlinear MPC on the true model, linear-quadratic tracking, and the program in CVXPY.

NMPC is the best that a controller can do which knows the plant, and the paper's benchmark: a ``Problem`` under
x_{i+1} = plant(x_i, u_i), from the belief's mean; constraints hold for the states themselves, since the model is taken
to be true. It generated the data of Cao, Lai and Alam (2017), whose sum over N = H + 1 states starts at the measured
one (its cost is constant) and has one input more, which only pays for itself. Multiple shooting in CasADi (Andersson et
al., 2019), solved by IPOPT (Waechter and Biegler, 2006) with exact derivatives. It starts from the previous input
repeated: the last plan shifted saves an interior-point method nothing, and led IPOPT to a worse local minimum on the
paper's elliptical flight, where the end of a plan costs little.

LQR: along the reference the learned mean is x_{i+1} = A_i x_i + B_i u_i + c_i, for which one Riccati recursion
minimises the cost. It knows no bound; what it gives is clipped.

StateFormMPC: the program of ``GPMPC`` with its states left in, in CVXPY, open to any convex constraint.

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

import casadi
import numpy as np

from gpmpc._dynamics import DynamicsModel, check_next_states
from gpmpc._interrupts import interrupts_after
from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp.casadi_ import successor_function
from gpmpc.mpc._controller import (
    FEASIBLE,
    KEPT,
    Decision,
    Reference,
    Request,
    Timing,
    check_controller,
)
from gpmpc.mpc._linear_quadratic import optimal_feedback
from gpmpc.mpc._prediction import Prediction, PredictionModel, PredictionSettings
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc._stages import ConstraintRows, Plan, StageCosts, StageLinearizer
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Linearization, Propagator
from gpmpc.qp._cvxpy import STATUSES, TIGHT
from gpmpc.signals import signals_of
from gpmpc.status import Status
from gpmpc.systems import System

Array = np.ndarray

_DEFAULT = PredictionSettings()
_STATUSES = {
    "Solve_Succeeded": Status.SOLVED,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
}


class NMPC:
    """Nonlinear MPC on the true model.

    Problem, horizon and initial input are those of ``GPMPC``, and so are the errors. Soft constraints get one slack
    variable a row and stage, with their price.

    Args:
        plant: The model, and what ``x_{i+1} = plant(x_i, u_i)`` means.
        tolerance: IPOPT's, on the scaled optimality conditions.
    """

    def __init__(
        self,
        plant: System,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        tolerance: float = 1e-10,
    ):
        n = len(plant.dynamics.state_names)
        m = len(plant.dynamics.input_names)
        self.signals = signals_of(plant)
        self.initial_input = check_controller(
            problem, n, m, horizon, initial_input, self.signals.input_names
        )
        check_number("tolerance", tolerance, above=0)
        self.plant = plant
        self.problem = problem
        self.horizon = horizon
        self._solver, self._bounds = _build(plant, problem, horizon, tolerance)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Solves the problem from the belief's mean along a reference; see ``Controller.control``."""
        n = self.problem.state_dim
        m = self.problem.input_dim
        H = self.horizon
        start = perf_counter()
        request = Request.read(
            self.problem,
            H,
            self.initial_input,
            belief,
            reference,
            previous,
            signals=self.signals,
        )
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        (targets, inputs, last), (lower, upper) = request.references, self._bounds
        guess = request.constant_guess.clip(*self.problem.inputs.by_stage(H))
        states = [request.state]
        for u in guess:
            states.append(np.array(self.plant.successor(states[-1], u), dtype=float))
        unknowns = np.zeros(len(lower["x"]))
        unknowns[: H * (n + m)] = np.concatenate([*states[1:], guess.ravel()])
        parameters = np.concatenate(
            [request.state, last, targets.ravel(), inputs.ravel()]
        )
        bounds = {
            "lbx": lower["x"],
            "ubx": upper["x"],
            "lbg": lower["g"],
            "ubg": upper["g"],
        }
        with interrupts_after():
            solution = self._solver(x0=unknowns, p=parameters, **bounds)
        stats = self._solver.stats()
        found = {key: np.array(solution[key]).ravel() for key in ("x", "g")}
        means = np.vstack([request.state, found["x"][: H * n].reshape(H, n)])
        inputs = found["x"][H * n : H * (n + m)].reshape(H, m)
        status = _STATUSES.get(stats["return_status"], Status.NUMERICAL_TROUBLE)
        violation = np.max(
            [
                np.maximum(lower[key] - at, at - upper[key]).max()
                for key, at in found.items()
            ]
        )
        suboptimal = status not in (Status.SOLVED, Status.INFEASIBLE) and bool(
            violation <= FEASIBLE
        )
        ended = status, stats["iter_count"], Timing(solve=perf_counter() - start)
        return Decision(
            inputs[0],
            inputs,
            means,
            np.zeros((H + 1, n, n)),
            *ended,
            suboptimal=suboptimal,
            violation=max(0.0, float(violation)),
        )


class LQR:
    """Linear-quadratic tracking on the local models of a learned mean.

    The first local model is taken at the state itself, the others at the reference; their inputs are the reference's
    where it has them, else the last input. Every input of the plan is clipped to the input box and to the rate bounds,
    each seen from the one before; it takes no constraints of states.

    Arguments are those of ``GPMPC``; of the model the mean is used.

    Raises:
        SettingError: As for ``GPMPC``; or constraints of states.
    """

    def __init__(
        self,
        model: DynamicsModel,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
    ):
        self.signals = signals_of(model)
        self.initial_input = check_controller(
            problem,
            *check_next_states(model),
            horizon,
            initial_input,
            self.signals.input_names,
        )
        problem.check_plain("LQR")
        if problem.constraints:
            raise SettingError(
                "constraints",
                "LQR knows the bounds of inputs only; leave those of states out",
            )
        self.model = model
        self.problem = problem
        self.horizon = horizon
        self._linearize = StageLinearizer(model, Linearization(), "none")
        self._cost = StageCosts(problem, horizon, self._linearize).quadratic

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """The clipped linear-quadratic plan; see ``Controller.control``. Covariances are not predicted."""
        began = perf_counter()
        request = Request.read(
            self.problem,
            self.horizon,
            self.initial_input,
            belief,
            reference,
            previous,
            signals=self.signals,
        )
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        (targets, wanted, last), x = request.references, request.state
        states = np.vstack([x, targets[:-1]])
        inputs: Any = request.constant_guess if reference.inputs is None else wanted
        stages = self._linearize(
            states, inputs, np.empty((0, *request.covariance.shape))
        )
        modelled = perf_counter()
        feedback, _ = optimal_feedback(self._cost, stages, request.references)
        if not np.isfinite(feedback).all():
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        states = [x]
        inputs = []
        boxes = (self.problem.inputs, self.problem.input_rates)
        (low, high), (down, up) = (box.by_stage(self.horizon) for box in boxes)
        for k, (A, B, offset, F) in enumerate(zip(*stages[:3], feedback, strict=True)):
            u = F @ np.concatenate([x, last, [1.0]])
            # The box last: where it and the rates contradict each other, the input must at least exist.
            u = u.clip(last + down[k], last + up[k]).clip(low[k], high[k])
            x = A @ x + B @ u + offset
            last = u
            states.append(x)
            inputs.append(u)
        means = np.array(states)
        inputs = np.array(inputs)
        finite = np.isfinite(means).all() and np.isfinite(inputs).all()
        status = Status.SOLVED if finite else Status.NUMERICAL_TROUBLE
        timing = Timing(modelled - began, 0.0, perf_counter() - modelled)
        return Decision(
            inputs[0],
            inputs,
            means,
            np.zeros((*means.shape, len(x))),
            status,
            self.horizon,
            timing,
        )


class StateFormMPC:
    """GP-MPC in states and inputs, one program a step; arguments that are not listed are those of ``GPMPC``.

    Elastic bounds have the exact price here, also where they cannot be kept.

    Args:
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
        self.prediction = PredictionModel(
            model, propagator, problem, horizon, initial_input, prediction
        )
        self.initial_input = self.prediction.initial_input
        self.problem = problem
        self.horizon = horizon
        self.solver = solver
        self.options = TIGHT.get(solver, {}) if options is None else options
        problem.check_plain("StateFormMPC")
        self.signals = self.prediction.signals
        self._build(constraints)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Decides the input for one step; see ``GPMPC.control``."""
        from cvxpy.error import SolverError

        request = self.prediction.read(belief, reference, previous)
        began = perf_counter()
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            prediction = self.prediction.linearize(
                self.prediction.initial_guess(request), request
            )
            if not all(np.isfinite(part).all() for part in prediction.stages):
                raise DataError("the stages are not finite")
        except FAILURES:
            return request.failed_decision(
                Status.NUMERICAL_TROUBLE,
                timing=Timing(perf_counter() - began, 0.0, 0.0),
            )
        modelled = perf_counter()
        self._set(prediction, request)
        built = perf_counter()
        program = self._program
        try:
            with (
                warnings.catch_warnings()
            ):  # that a solution is inaccurate is said by its status
                warnings.simplefilter("ignore")
                program.solve(
                    solver=self.solver, **{"warm_start": False} | self.options
                )
            status = STATUSES.get(program.status, Status.NUMERICAL_TROUBLE)
        except SolverError:
            status = Status.NUMERICAL_TROUBLE
        timing = Timing(modelled - began, built - modelled, perf_counter() - built)
        iterations = (
            (program.solver_stats.num_iters or 0) if program.solver_stats else 0
        )
        values = [variable.value for variable in program.variables()]
        stopped = status is Status.ITERATION_LIMIT and all(
            v is not None and np.isfinite(v).all() for v in values
        )
        suboptimal = stopped and all(
            np.max(rule.violation()) <= FEASIBLE for rule in program.constraints
        )
        if not (status.solved or suboptimal):
            return request.failed_decision(status, iterations, timing)
        inputs = np.ascontiguousarray(self._inputs.value)
        states = np.ascontiguousarray(self._states.value)
        linearizer = self.prediction.linearizer
        means, covariances = linearizer.moments(states, prediction.covariances)
        plan = Plan(states, inputs, prediction.covariances)
        planned = prediction._replace(plan=plan)
        violation = self.prediction.violation(planned, request)
        if status is Status.SOLVED and violation > KEPT:
            status = Status.SOFT_BOUND_MISSED
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=covariances,
            status=status,
            iterations=iterations,
            timing=timing,
            disturbance=request.disturbance,
            suboptimal=suboptimal,
            stage_costs=self.prediction.stage_costs(planned, request),
            violation=violation,
        )

    def _build(self, constraints: Callable[[Any, Any], list] | None) -> None:
        """Makes the CVXPY problem with its parameters."""
        import cvxpy

        model = self.prediction
        problem = self.problem
        H = self.horizon
        m = self.problem.input_dim
        (Q, R), rows = problem.cost.by_stage(H), model.constraints
        weights = [_factor(blocks) for blocks in model.linearizer.weight(Q)]
        p = len(weights[0])
        K = model.points
        r = rows.per_stage
        self._states, self._inputs = s, u = (
            cvxpy.Variable((H + 1, p)),
            cvxpy.Variable((H, m)),
        )
        self._stages = [
            [cvxpy.Parameter(shape) for shape in ((p, p), (p, m), (p,))]
            for _ in range(K)
        ]
        self._start = cvxpy.Parameter(p)
        self._targets = cvxpy.Parameter((H, p), value=np.zeros((H, p)))
        self._wanted = cvxpy.Parameter((H, m))
        self._last = cvxpy.Parameter(m)
        rates = u - cvxpy.vstack(
            [cvxpy.reshape(self._last, (1, m), order="C"), *([u[:-1]] if H > 1 else [])]
        )
        penalized = {"inputs": u, "deviations": u - self._wanted, "increments": rates}[
            problem.cost.penalized
        ]
        cost = sum(
            cvxpy.sum_squares(penalized[k] @ _factor(R[k : k + 1])) for k in range(H)
        )
        cost += sum(
            cvxpy.sum_squares((s[k + 1] - self._targets[k]) @ weights[k])
            for k in range(H)
        )
        rules = [s[0] == self._start, *_within(u, *problem.inputs.by_stage(H))]
        rules += _within(rates, *problem.input_rates.by_stage(H))
        for k in range(H):
            A, B, c = self._stages[min(k, K - 1)]
            rules.append(s[k + 1] == A @ s[k] + B @ u[k] + c)
        self._rows = [cvxpy.Parameter((r, p)) for _ in range(K if r else 0)]
        if r:
            self._bounds = cvxpy.Parameter((H, r))
            hard = np.isinf(rows.prices)
            applies = rows.applies
            slack = np.zeros((H, r))
            if rows.soft:
                slack = cvxpy.multiply(
                    cvxpy.Variable((H, r), nonneg=True),
                    np.tile(np.where(hard, 0.0, 1.0), (H, 1)),
                )
                cost += cvxpy.sum(slack @ np.where(hard, 0.0, rows.prices))
            # Every bound as an upper one: the rows of lower bounds are handed over with their sign turned.
            at = [
                self._rows[min(k, K - 1)] @ s[k + 1] - self._bounds[k] - slack[k]
                for k in range(H)
            ]
            rules += [
                at[k][np.flatnonzero(applies[k])] <= 0.0
                for k in range(H)
                if applies[k].any()
            ]
        rules += [] if constraints is None else list(constraints(s, u))
        self._program = cvxpy.Problem(cvxpy.Minimize(cost), rules)
        if not self._program.is_dpp():
            raise SettingError(
                "constraints",
                "must be convex, and parametrised as CVXPY's rules (DPP) ask",
            )

    def _set(self, prediction: Prediction, request: Request) -> None:
        """Gives all parameters their values of this step."""
        for parameters, values in zip(
            self._stages, zip(*prediction.stages[:3], strict=True), strict=True
        ):
            for parameter, value in zip(parameters, values, strict=True):
                parameter.value = value
        targets = np.zeros(self._targets.shape)
        targets[:, : self.problem.state_dim] = request.references.states
        self._start.value = prediction.plan.states[0]
        self._targets.value = targets
        self._wanted.value = request.references.inputs
        self._last.value = request.references.previous_input
        if self._rows:
            (E, _, lower, upper), sign = (
                prediction.rows,
                self.prediction.constraints.signs,
            )
            for parameter, value in zip(
                self._rows,
                np.broadcast_to(E, (len(self._rows), *E.shape[1:])),
                strict=True,
            ):
                parameter.value = sign[:, None] * value
            bounds = np.where(sign > 0, upper, -lower)
            self._bounds.value = np.where(np.isfinite(bounds), bounds, 0.0)


def _build(
    plant: System, problem: Problem, horizon: int, tolerance: float
) -> tuple[casadi.Function, list[dict[str, np.ndarray]]]:
    """IPOPT on the unknowns (x_1 .. x_H, u_0 .. u_{H-1}, slacks), and the bounds of unknowns and constraints."""
    problem.check_plain("NMPC")
    successor_function(plant)  # says what CasADi cannot follow
    n = problem.state_dim
    m = problem.input_dim
    H = horizon
    goal = problem.cost
    x0 = casadi.SX.sym("x0", n)
    last = casadi.SX.sym("last", m)
    x, u, r, wanted = (
        casadi.SX.sym(name, size, H)
        for name, size in (("x", n), ("u", m), ("r", n), ("wanted", m))
    )
    rates = u - casadi.horzcat(last, u[:, :-1])
    penalized = {"inputs": u, "deviations": u - wanted, "increments": rates}[
        goal.penalized
    ]
    Q, R = goal.by_stage(H)
    cost = sum(
        casadi.bilin(casadi.DM(R[k]), v, v)
        for k, v in enumerate(casadi.horzsplit(penalized))
    )
    cost += sum(
        casadi.bilin(casadi.DM(Q[k]), e, e)
        for k, e in enumerate(casadi.horzsplit(x - r))
    )
    before = casadi.horzsplit(casadi.horzcat(x0, x[:, :-1]))
    after = [
        casadi.vertcat(*plant.successor(s, v))
        for s, v in zip(before, casadi.horzsplit(u), strict=True)
    ]
    constraints = [casadi.vec(x - casadi.horzcat(*after))]
    g = [np.zeros((2, H * n))]
    if problem.input_rates.finite:
        constraints.append(casadi.vec(rates))
        g.append(np.array(problem.input_rates.by_stage(H)).reshape(2, -1))
    unknowns = [casadi.vec(x), casadi.vec(u)]
    box = [np.tile([[-np.inf], [np.inf]], H * n)]
    box.append(np.array(problem.inputs.by_stage(H)).reshape(2, -1))
    rows = ConstraintRows(problem, H, "none")
    E, _, lower, upper = rows.at(
        Plan(np.empty((0, n)), np.empty((0, m)), np.empty(0)), np.empty(0), H
    )
    soft = np.flatnonzero(np.isfinite(rows.prices))
    if rows.per_stage:
        slack = casadi.SX.sym("slack", len(soft), H)
        values = casadi.mtimes(casadi.DM(E[0]), x)
        for e, given in zip(
            soft, casadi.vertsplit(slack) if soft.size else [], strict=True
        ):
            values[int(e), :] -= (
                rows.signs[e] * given
            )  # what a soft row gives way by, on its side
            cost += rows.prices[e] * casadi.sum2(given)
        constraints.append(casadi.vec(values))
        g.append(np.array([lower, upper]).reshape(2, -1))
        unknowns.append(casadi.vec(slack))
        box.append(np.tile([[0.0], [np.inf]], H * len(soft)))
    nlp = {"x": casadi.vertcat(*unknowns), "f": cost, "g": casadi.vertcat(*constraints)}
    nlp["p"] = casadi.vertcat(x0, last, casadi.vec(r), casadi.vec(wanted))
    ipopt = {
        "print_level": 0,
        "sb": "yes",
        "tol": tolerance,
        "max_iter": 500,
        "bound_relax_factor": 0.0,
    }
    options: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt": ipopt,
    }
    bounds = [{"x": np.hstack(box)[side], "g": np.hstack(g)[side]} for side in (0, 1)]
    return casadi.nlpsol("nmpc", "ipopt", nlp, options), bounds


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
