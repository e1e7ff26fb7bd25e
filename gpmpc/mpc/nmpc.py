"""Nonlinear MPC on the true model: the best that a controller can do which knows it, and the paper's benchmark.

A ``TrackingProblem`` under x_{i+1} = plant(x_i, u_i), from the belief's mean; state bounds hold for the states
themselves, since the model is taken to be true. It generated the data of Cao, Lai and Alam (2017), whose sum over
N = H + 1 states starts at the measured one (its cost is constant) and has one input more, which only pays for itself.
Multiple shooting in CasADi (Andersson et al., 2019), solved by IPOPT (Waechter and Biegler, 2006) with exact
derivatives. It starts from the previous input repeated: the last plan shifted saves an interior-point method nothing,
and led IPOPT to a worse local minimum on the paper's elliptical flight, where the end of a plan costs little.
"""

import time
from collections.abc import Sequence

import casadi
import numpy as np

from gpmpc.exceptions import check_number
from gpmpc.gaussian import Gaussian
from gpmpc.interrupts import interrupts_after
from gpmpc.mpc.controller import FEASIBLE, Decision, Reference, Request, Timing, check_controller
from gpmpc.mpc.problem import TrackingProblem
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
        problem: Weights and bounds. Soft state bounds get one slack variable each, with their weights.
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
        problem: TrackingProblem,
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
        start = time.perf_counter()
        request = Request.read(self.problem, H, self.initial_input, belief, reference, previous)
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        (targets, inputs, last), (lower, upper) = request.references, self._bounds
        guess, states = request.constant_guess.clip(self.problem.input_lower, self.problem.input_upper), [request.state]
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
            timing=Timing(0.0, 0.0, time.perf_counter() - start),
            suboptimal=status not in (Status.SOLVED, Status.INFEASIBLE) and bool(violation <= FEASIBLE),
        )


def _build(
    plant: Plant, problem: TrackingProblem, horizon: int, tolerance: float
) -> tuple[casadi.Function, list[dict[str, np.ndarray]]]:
    """IPOPT on the unknowns (x_1 .. x_H, u_0 .. u_{H-1}, slacks), and the bounds of unknowns and constraints."""
    n, m, H, limits = problem.state_dim, problem.input_dim, horizon, problem.state_bounds
    x0, last = casadi.SX.sym("x0", n), casadi.SX.sym("last", m)
    x, u, r, wanted = (casadi.SX.sym(name, size, H) for name, size in (("x", n), ("u", m), ("r", n), ("wanted", m)))
    rates = u - casadi.horzcat(last, u[:, :-1])
    penalized = {"inputs": u, "deviations": u - wanted, "increments": rates}[problem.penalized]
    Q, R, T = casadi.DM(problem.Q), casadi.DM(problem.R), casadi.DM(problem.terminal)
    cost = sum(casadi.bilin(R, v, v) for v in casadi.horzsplit(penalized))
    cost += sum(casadi.bilin(T if k == H - 1 else Q, e, e) for k, e in enumerate(casadi.horzsplit(x - r)))
    before = casadi.horzsplit(casadi.horzcat(x0, x[:, :-1]))
    after = [casadi.vertcat(*plant.successor(s, v)) for s, v in zip(before, casadi.horzsplit(u), strict=True)]
    constraints, g = [casadi.vec(x - casadi.horzcat(*after))], [np.zeros((2, H * n))]
    if problem.rate_limited:
        constraints.append(casadi.vec(rates))
        g.append(np.tile([problem.rate_lower, problem.rate_upper], H))
    free = [np.full(n, -np.inf), np.full(n, np.inf)]
    box = [np.tile(free if limits is None or limits.soft else [limits.lower, limits.upper], H)]
    box.append(np.tile([problem.input_lower, problem.input_upper], H))
    unknowns = [casadi.vec(x), casadi.vec(u)]
    if limits is not None and limits.soft:
        sides = [(limits.upper, 1), (limits.lower, -1)]
        rows = [(int(j), sign, bound[j]) for bound, sign in sides for j in np.flatnonzero(np.isfinite(bound))]
        slack = casadi.SX.sym("slack", len(rows), H)
        cost += casadi.sum1(casadi.vec((limits.l1 or 0.0) * slack + (limits.l2 or 0.0) * slack**2))
        beyond = [sign * (x[j, :] - bound) for j, sign, bound in rows]
        constraints.append(casadi.vec(casadi.vertcat(*beyond) - slack))
        unknowns.append(casadi.vec(slack))
        g.append(np.tile([[-np.inf], [0.0]], H * len(rows)))
        box.append(np.tile([[0.0], [np.inf]], H * len(rows)))
    nlp = {
        "x": casadi.vertcat(*unknowns),
        "p": casadi.vertcat(x0, last, casadi.vec(r), casadi.vec(wanted)),
        "f": cost,
        "g": casadi.vertcat(*constraints),
    }
    options = {
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": 500, "bound_relax_factor": 0.0},
    }
    bounds = [{"x": np.hstack(box)[side], "g": np.hstack(g)[side]} for side in (0, 1)]
    return casadi.nlpsol("nmpc", "ipopt", nlp, options), bounds
