"""Problem: the best that a controller can do which knows the true model (nonlinear MPC, the paper's benchmark).

    minimise over u_0 .. u_{H-1}   sum_{i<H} |x_i - r_i|^2_Q + |u_i|^2_R,   x_0 measured,  x_{i+1} = plant(x_i, u_i)

It generated the data of Cao, Lai and Alam (2017), and the sum is theirs: it starts at the measured state (whose cost is
constant) and ends at x_{H-1}, so the last input only pays for itself. Multiple shooting in CasADi (Andersson et al.,
2019), solved by IPOPT (Waechter and Biegler, 2006) with exact derivatives.
"""

import time
from collections.abc import Sequence

import casadi
import numpy as np

from gpmpc.control.controller import Decision
from gpmpc.exceptions import ShapeError, check_number, check_numbers
from gpmpc.plants import Plant
from gpmpc.status import Status

IPOPT_STATUS = {
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
        horizon: H, the number of states in the cost, the measured one included.
        Q: State weights, the diagonal (n,).
        R: Input weights, the diagonal (m,).
        initial_input: First guess of every planned input (m,) where there is no previous decision.
        tolerance: IPOPT's, on the scaled optimality conditions.

    Raises:
        SettingError: A horizon below 1, a negative weight, or a weight or guess of the wrong length.
    """

    def __init__(
        self,
        plant: Plant,
        horizon: int,
        Q: Sequence[float],
        R: Sequence[float],
        initial_input: Sequence[float],
        tolerance: float = 1e-10,
    ):
        n, m = len(plant.dynamics.state_names), len(plant.dynamics.input_names)
        check_number("horizon", horizon, least=1, whole=True)
        check_numbers("Q", Q, n, least=0)
        check_numbers("R", R, m, least=0)
        check_numbers("initial_input", initial_input, m)
        check_number("tolerance", tolerance, above=0)
        self.plant = plant
        self.horizon = horizon
        self.initial_input = np.array(initial_input, dtype=float)
        self._solver = _build(plant, horizon, np.array(Q, dtype=float), np.array(R, dtype=float), tolerance)

    def control(self, state: np.ndarray, reference: np.ndarray, previous: Decision | None = None) -> Decision:
        """Solves the problem from a measured state (n,) along reference states (H, n)."""
        n, m, H = len(state), len(self.initial_input), self.horizon
        if np.shape(reference) != (H, n):
            raise ShapeError(f"reference must have shape ({H}, {n}); got {np.shape(reference)}")
        start = time.perf_counter()
        # The last input is held, not the plan shifted: the end of a plan steers little of this cost, so its inputs
        # lie far from the next solution; from there IPOPT found a worse local minimum on the elliptical flight.
        guess = np.tile(self.initial_input if previous is None else previous.input, (H, 1))
        states = _rollout(self.plant, state, guess)
        solution = self._solver(
            x0=np.concatenate([states.ravel(), guess.ravel()]),
            p=np.concatenate([state, np.ravel(reference)]),
            lbg=0.0,
            ubg=0.0,
        )
        plan = np.array(solution["x"]).ravel()
        stats = self._solver.stats()
        states, inputs = plan[: H * n].reshape(H, n), plan[H * n :].reshape(H, m)
        return Decision(
            input=inputs[0],
            inputs=inputs,
            states=states,
            status=IPOPT_STATUS.get(stats["return_status"], Status.NUMERICAL_TROUBLE),
            iterations=stats["iter_count"],
            seconds=time.perf_counter() - start,
        )


def _build(plant: Plant, horizon: int, Q: np.ndarray, R: np.ndarray, tolerance: float) -> casadi.Function:
    """The optimisation problem in the unknowns (x_0 .. x_{H-1}, u_0 .. u_{H-1}) as an IPOPT solver."""
    n, m = len(Q), len(R)
    x = [casadi.SX.sym(f"x{i}", n) for i in range(horizon)]
    u = [casadi.SX.sym(f"u{i}", m) for i in range(horizon)]
    measured, r = casadi.SX.sym("measured", n), [casadi.SX.sym(f"r{i}", n) for i in range(horizon)]
    cost = sum(casadi.dot(Q, (x[i] - r[i]) ** 2) + casadi.dot(R, u[i] ** 2) for i in range(horizon))
    gaps = [x[0] - measured]
    gaps += [x[i + 1] - casadi.vertcat(*plant.successor(x[i], u[i])) for i in range(horizon - 1)]
    problem = {"x": casadi.vertcat(*x, *u), "p": casadi.vertcat(measured, *r), "f": cost, "g": casadi.vertcat(*gaps)}
    options = {
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": 500},
    }
    return casadi.nlpsol("nmpc", "ipopt", problem, options)


def _rollout(plant: Plant, state: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """States (H, n) that inputs (H, m) lead to, from a state (n,); the last input is not used."""
    states = [np.asarray(state, dtype=float)]
    for u in inputs[:-1]:
        states.append(np.array(plant.successor(states[-1], u), dtype=float))
    return np.array(states)
