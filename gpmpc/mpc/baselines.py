"""Two controllers to compare with: nonlinear MPC on the true model, and linear-quadratic tracking on a learned one.

NMPC is the best that a controller can do which knows the plant, and the paper's benchmark: a ``Problem`` under
x_{i+1} = plant(x_i, u_i), from the belief's mean; constraints hold for the states themselves, since the model is taken
to be true. It generated the data of Cao, Lai and Alam (2017), whose sum over N = H + 1 states starts at the measured
one (its cost is constant) and has one input more, which only pays for itself. Multiple shooting in CasADi (Andersson et
al., 2019), solved by IPOPT (Waechter and Biegler, 2006) with exact derivatives. It starts from the previous input
repeated: the last plan shifted saves an interior-point method nothing, and led IPOPT to a worse local minimum on the
paper's elliptical flight, where the end of a plan costs little.

LQR: along the reference the learned mean is x_{i+1} = A_i x_i + B_i u_i + c_i, for which one Riccati recursion
minimises the cost (``gpmpc.mpc._linear_quadratic.optimal_feedback``). It knows no bound; what it gives is clipped.
"""

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import casadi
import numpy as np

from gpmpc.dynamics import DynamicsModel, check_next_states, linearize
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.interrupts import interrupts_after
from gpmpc.mpc._linear_quadratic import Stages, optimal_feedback
from gpmpc.mpc._stages import ConstraintRows, Plan, StageCosts, StageLinearizer
from gpmpc.mpc.controller import FEASIBLE, Decision, Reference, Request, Timing, check_controller
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Linearization
from gpmpc.status import Status
from gpmpc.systems import Plant

_STATUSES = {
    "Solve_Succeeded": Status.SOLVED,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
}


class NMPC:
    """Nonlinear MPC on the true model.

    Args:
        plant: The model, and what ``x_{i+1} = plant(x_i, u_i)`` means.
        problem: Weights and constraints. Soft ones get one slack variable a row and stage, with their price.
        horizon: H, the number of predicted states.
        initial_input: Taken for the previous input where there is no decision before (m,): the first guess, and where
            rates and increments start.
        tolerance: IPOPT's, on the scaled optimality conditions.

    Raises:
        SettingError: A horizon below 1, weights of another dimension than the plant's, or an initial input of the wrong
            length.
    """

    def __init__(
        self,
        plant: Plant,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        tolerance: float = 1e-10,
    ):
        n, m = len(plant.dynamics.state_names), len(plant.dynamics.input_names)
        self.initial_input = check_controller(problem, n, m, horizon, initial_input)
        check_number("tolerance", tolerance, above=0)
        self.plant, self.problem, self.horizon = plant, problem, horizon
        self._solver, self._bounds = _build(plant, problem, horizon, tolerance)

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """Solves the problem from the belief's mean along a reference; see ``Controller.control``.

        Raises:
            ShapeError: The reference does not belong to this controller.
        """
        n, m, H = self.problem.state_dim, self.problem.input_dim, self.horizon
        start = perf_counter()
        request = Request.read(self.problem, H, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        (targets, inputs, last), (lower, upper) = request.references, self._bounds
        guess, states = request.constant_guess.clip(*self.problem.inputs.by_stage(H)), [request.state]
        for u in guess:
            states.append(np.array(self.plant.successor(states[-1], u), dtype=float))
        unknowns = np.zeros(len(lower["x"]))
        unknowns[: H * (n + m)] = np.concatenate([*states[1:], guess.ravel()])
        parameters = np.concatenate([request.state, last, targets.ravel(), inputs.ravel()])
        bounds = {"lbx": lower["x"], "ubx": upper["x"], "lbg": lower["g"], "ubg": upper["g"]}
        with interrupts_after():
            solution = self._solver(x0=unknowns, p=parameters, **bounds)
        stats, found = self._solver.stats(), {key: np.array(solution[key]).ravel() for key in ("x", "g")}
        means = np.vstack([request.state, found["x"][: H * n].reshape(H, n)])
        inputs = found["x"][H * n : H * (n + m)].reshape(H, m)
        status = _STATUSES.get(stats["return_status"], Status.NUMERICAL_TROUBLE)
        violation = np.max([np.maximum(lower[key] - at, at - upper[key]).max() for key, at in found.items()])
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=np.zeros((H + 1, n, n)),
            status=status,
            iterations=stats["iter_count"],
            timing=Timing(0.0, 0.0, perf_counter() - start),
            suboptimal=status not in (Status.SOLVED, Status.INFEASIBLE) and bool(violation <= FEASIBLE),
        )


class LQR:
    """Linear-quadratic tracking on the local models of a learned mean.

    The first local model is taken at the state itself, the others at the reference; their inputs are the reference's
    where it has them, else the last input. Every input of the plan is clipped to the input box and to the rate bounds,
    each seen from the one before; it takes no constraints of states.

    Args:
        model: What was learned; its variance is not used.
        problem: Weights and bounds.
        horizon: H, the number of predicted states.
        initial_input: Taken for the last input where there is no previous decision (m,).

    Raises:
        SettingError: A horizon below 1, weights of another dimension than the model's, or an initial input of the wrong
            length.
    """

    def __init__(self, model: DynamicsModel, problem: Problem, horizon: int, initial_input: Sequence[float]):
        self.initial_input = check_controller(problem, *check_next_states(model), horizon, initial_input)
        problem.check_plain("LQR")
        if problem.constraints:
            raise SettingError("constraints", "LQR knows the bounds of inputs only; leave those of states out")
        self.model, self.problem, self.horizon = model, problem, horizon
        self._cost = StageCosts(problem, horizon, StageLinearizer(model, Linearization(), "none")).quadratic

    def control(self, belief: Gaussian, reference: Reference, previous: Decision | None = None) -> Decision:
        """The clipped linear-quadratic plan; see ``Controller.control``. Covariances are not predicted.

        Raises:
            ShapeError: The belief or the reference does not belong to this controller.
        """
        began = perf_counter()
        request = Request.read(self.problem, self.horizon, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        (targets, wanted, last), x = request.references, request.state
        states = np.vstack([x, targets[:-1]])
        inputs: Any = request.constant_guess if reference.inputs is None else wanted
        at = linearize(self.model, states, inputs, covariance=False)
        modelled = perf_counter()
        c = at.mean - np.einsum("iab,ib->ia", at.A, states) - np.einsum("iab,ib->ia", at.B, inputs)
        stages = Stages(at.A, at.B, c)
        if not all(np.isfinite(part).all() for part in stages):
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        feedback, _ = optimal_feedback(self._cost, stages, request.references)
        if not np.isfinite(feedback).all():
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        states, inputs, box, rates = [x], [], self.problem.inputs, self.problem.input_rates
        (low, high), (down, up) = (bounds.by_stage(self.horizon) for bounds in (box, rates))
        for k, (A, B, offset, F) in enumerate(zip(*stages, feedback, strict=True)):
            u = F @ np.concatenate([x, last, [1.0]])
            # The box last: where it and the rates contradict each other, the input must at least exist.
            u = u.clip(last + down[k], last + up[k]).clip(low[k], high[k])
            x, last = A @ x + B @ u + offset, u
            states.append(x)
            inputs.append(u)
        finite = bool(np.isfinite(states).all() and np.isfinite(inputs).all())
        return Decision(
            input=inputs[0],
            inputs=np.array(inputs),
            means=np.array(states),
            covariances=np.zeros((self.horizon + 1, len(x), len(x))),
            status=Status.SOLVED if finite else Status.NUMERICAL_TROUBLE,
            iterations=self.horizon,
            timing=Timing(modelled - began, 0.0, perf_counter() - modelled),
        )


def _build(
    plant: Plant, problem: Problem, horizon: int, tolerance: float
) -> tuple[casadi.Function, list[dict[str, np.ndarray]]]:
    """IPOPT on the unknowns (x_1 .. x_H, u_0 .. u_{H-1}, slacks), and the bounds of unknowns and constraints."""
    problem.check_plain("NMPC")
    n, m, H, goal = problem.state_dim, problem.input_dim, horizon, problem.cost
    x0, last = casadi.SX.sym("x0", n), casadi.SX.sym("last", m)
    x, u, r, wanted = (casadi.SX.sym(name, size, H) for name, size in (("x", n), ("u", m), ("r", n), ("wanted", m)))
    rates = u - casadi.horzcat(last, u[:, :-1])
    penalized = {"inputs": u, "deviations": u - wanted, "increments": rates}[goal.penalized]
    Q, R = goal.by_stage(H)
    cost = sum(casadi.bilin(casadi.DM(R[k]), v, v) for k, v in enumerate(casadi.horzsplit(penalized)))
    cost += sum(casadi.bilin(casadi.DM(Q[k]), e, e) for k, e in enumerate(casadi.horzsplit(x - r)))
    before = casadi.horzsplit(casadi.horzcat(x0, x[:, :-1]))
    after = [casadi.vertcat(*plant.successor(s, v)) for s, v in zip(before, casadi.horzsplit(u), strict=True)]
    constraints, g = [casadi.vec(x - casadi.horzcat(*after))], [np.zeros((2, H * n))]
    if problem.input_rates.finite:
        constraints.append(casadi.vec(rates))
        g.append(np.array(problem.input_rates.by_stage(H)).reshape(2, -1))
    unknowns, states = [casadi.vec(x), casadi.vec(u)], np.stack([np.full((H, n), -np.inf), np.full((H, n), np.inf)])
    box = [np.empty((2, 0)), np.array(problem.inputs.by_stage(H)).reshape(2, -1)]
    rows = ConstraintRows(problem, H, "none")
    soft = np.isfinite(rows.prices)
    E, _, lower, upper = rows.at(Plan(np.empty((0, n)), np.empty((0, m)), np.empty(0)), np.empty(0), H)
    single = (np.count_nonzero(E[0], axis=1) == 1) & (E[0].max(axis=1) == 1.0)
    for e in np.flatnonzero(single & ~soft):
        j = int(np.argmax(E[0, e]))
        states[0, :, j] = np.maximum(states[0, :, j], lower[:, e])
        states[1, :, j] = np.minimum(states[1, :, j], upper[:, e])
    mixed, priced = np.flatnonzero(~single & ~soft), np.flatnonzero(soft)
    if mixed.size:
        constraints.append(casadi.vec(casadi.mtimes(casadi.DM(E[0, mixed]), x)))
        g.append(np.array([lower[:, mixed], upper[:, mixed]]).reshape(2, -1))
    if priced.size:
        slack = casadi.SX.sym("slack", len(priced), H)
        cost += casadi.sum1(casadi.vec(casadi.DM(rows.prices[priced]) * slack))
        bounds = np.where(rows.signs > 0, upper, lower)[:, priced]
        sign, applies = rows.signs[priced], rows.applies[:, priced]
        beyond = casadi.DM(sign) * (
            casadi.mtimes(casadi.DM(E[0, priced]), x) - casadi.DM(np.where(applies, bounds, 0).T)
        )
        constraints.append(casadi.vec(beyond - slack))
        unknowns.append(casadi.vec(slack))
        g.append(np.array([np.full(applies.shape, -np.inf), np.where(applies, 0.0, np.inf)]).reshape(2, -1))
        box.append(np.tile([[0.0], [np.inf]], H * len(priced)))
    box[0] = states.reshape(2, -1)
    nlp = {
        "x": casadi.vertcat(*unknowns),
        "p": casadi.vertcat(x0, last, casadi.vec(r), casadi.vec(wanted)),
        "f": cost,
        "g": casadi.vertcat(*constraints),
    }
    options: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": 500, "bound_relax_factor": 0.0},
    }
    bounds = [{"x": np.hstack(box)[side], "g": np.hstack(g)[side]} for side in (0, 1)]
    return casadi.nlpsol("nmpc", "ipopt", nlp, options), bounds
