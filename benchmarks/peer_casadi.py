"""Solves by CasADi on the mean of learned GPs.

Its solvers are IPOPT, its SQP method with HPIPM, and FATROP.

Multiple shooting (Bock and Plitt, 1984) with the states among the unknowns, as CasADi's
own examples have it. What was found to be the best settings here, with the time of the
alternative over that chosen at N = 189, H = 10: the whole problem expanded to scalar
expressions (IPOPT 1.5 to 2.7, the SQP method 2, FATROP 3; compiled to C by ``jit``
slower still, after a minute and a half of compiling), MUMPS for IPOPT, and a warm start
of states, inputs and all multipliers from the last solution, shifted, with a small
barrier parameter (cold 1.5 for IPOPT; 3 for FATROP). The Hessian is the exact one or,
for a sum of squares, that of Gauss and Newton, which spares the second derivatives of
the GPs; the SQP method has the latter, since HPIPM needs a convex program; FATROP takes
the exact one only.
"""

from typing import Any, Literal, NamedTuple

import casadi
import numpy as np

from benchmarks.kkt import Instance
from gpmpc._interrupts import interrupts_after
from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.gp.casadi_ import casadi_function
from gpmpc.mpc import Problem

Array = np.ndarray

IPOPT_WARM = {  # IPOPT's options for a start from the solution of a similar problem
    "warm_start_init_point": "yes",
    "mu_init": 1e-6,
    **dict.fromkeys(
        [
            "warm_start_bound_push",
            "warm_start_mult_bound_push",
            "warm_start_slack_bound_push",
            "warm_start_bound_frac",
            "warm_start_slack_bound_frac",
        ],
        1e-8,
    ),
}
MAX_ITERATIONS = 200


class Solution(NamedTuple):
    """A plan with what the next solve starts from.

    Attributes: inputs: (H, m). unknowns: u_k and x_{k+1} (and u_k again where the last
        input is a state) of every stage (H, ...). bound_multipliers: Of the bounds of
        the unknowns (H, ...). dynamics_multipliers: Of x_{k+1} = m(x_k, u_k) (H, ...).
    """

    inputs: Array
    unknowns: Array
    bound_multipliers: Array
    dynamics_multipliers: Array


class Casadi:
    """Solves tracking problems on the mean of GPs by a solver of CasADi.

    Args: gp: The GPs. problem: Weights of states and increments, and bounds of the
        inputs. horizon: H. method: ``"ipopt"`` or ``"ipopt, gauss-newton"``;
        ``"sqpmethod"`` with HPIPM; ``"fatrop"``. The last two want costs that couple
        one stage only, so their states are (x_k, u_{k-1}).
        tolerance: The solver's own.

    Raises: SettingError: The problem weighs something else than increments, or bounds
        more than inputs.
    """

    def __init__(
        self,
        gp: GPPosterior,
        problem: Problem,
        horizon: int,
        method: Literal["ipopt", "ipopt, gauss-newton", "sqpmethod", "fatrop"],
        tolerance: float,
    ):
        check_problem(problem)
        n = problem.state_dim
        m = problem.input_dim
        H = horizon
        plugin = method.split(",")[0]
        self._stagewise = plugin != "ipopt"
        carried = m if self._stagewise else 0  # of the last input in the state
        step, Q, R, terminal = (
            mean_function(gp),
            *map(casadi.DM, (problem.cost.Q, problem.cost.R, problem.cost.terminal)),
        )
        u = casadi.SX.sym("u", m, H)
        r = casadi.SX.sym("r", n, H)
        x = casadi.SX.sym("x", n + carried, H + 1)  # the first one is given
        last = casadi.SX.sym("last", m)
        cost = 0
        gaps = []
        unknowns = []
        for k in range(H):
            before = x[n:, k] if carried and k else u[:, k - 1] if k else last
            following = casadi.vertcat(
                step(x[:n, k], u[:, k]), u[:, k] if carried else []
            )
            error = x[:n, k + 1] - r[:, k]
            cost += casadi.bilin(R, u[:, k] - before) + casadi.bilin(
                terminal if k == H - 1 else Q, error
            )
            gaps.append(
                following - x[:, k + 1]
                if plugin == "sqpmethod"
                else x[:, k + 1] - following
            )  # as they want it
            unknowns += [u[:, k], x[:, k + 1]]
        w = casadi.vertcat(*unknowns)
        p = casadi.veccat(x[:n, 0], last, r)
        g = casadi.vertcat(*gaps)
        hessian = _gauss_newton(w, p, g, cost, triangle=plugin == "ipopt")
        options = _options(plugin, H, n + m, m, tolerance)
        if method in ("ipopt, gauss-newton", "sqpmethod"):
            options["hess_lag"] = hessian
        self._solver = casadi.nlpsol(
            "peer", plugin, {"x": w, "p": p, "f": cost, "g": g}, options
        )
        free = np.full(n + carried, np.inf)
        self._lower = np.tile(np.concatenate([problem.inputs.lower, -free]), H)
        self._upper = np.tile(np.concatenate([problem.inputs.upper, free]), H)
        self._shape = (H, n, m)

    def __call__(self, instance: Instance, last: Solution | None) -> Solution:
        """Plans along a reference, started from the last solution, shifted."""
        H, _, m = self._shape
        if last is None:
            inputs = np.tile(instance.last, (H, 1))
            start = np.hstack(
                [inputs, instance.targets, inputs]
                if self._stagewise
                else [inputs, instance.targets]
            )
            multipliers = {}
        else:
            start = _shifted(last.unknowns)
            multipliers = {
                "lam_x0": _shifted(last.bound_multipliers).ravel(),
                "lam_g0": _shifted(last.dynamics_multipliers).ravel(),
            }
        with interrupts_after():
            solution = self._solver(
                x0=start.ravel(),
                p=np.concatenate(
                    [instance.state, instance.last, instance.targets.ravel()]
                ),
                lbx=self._lower,
                ubx=self._upper,
                lbg=0.0,
                ubg=0.0,
                **multipliers,
            )
        unknowns, of_bounds, of_dynamics = (
            np.array(solution[key]).reshape(H, -1) for key in ("x", "lam_x", "lam_g")
        )
        return Solution(unknowns[:, :m].copy(), unknowns, of_bounds, of_dynamics)


def check_problem(problem: Problem) -> None:
    """Raises where a problem has what the peers' formulations do not hand on."""
    if (
        problem.cost.penalized != "increments"
        or problem.constraints
        or problem.input_rates.finite
    ):
        raise SettingError(
            "problem", "must weigh increments, and bound nothing but inputs"
        )


def mean_function(gp: GPPosterior) -> casadi.Function:
    """The GPs' mean of the next state as scalar expressions, (state, input) -> mean."""
    x = casadi.MX.sym("state", gp.state_dim)
    u = casadi.MX.sym("input", gp.input_dim)
    return casadi.Function(
        "mean", [x, u], [casadi_function(gp)(x, u)[0]], ["state", "input"], ["mean"]
    ).expand()


def _gauss_newton(w: Any, p: Any, g: Any, cost: Any, triangle: bool) -> casadi.Function:
    """Returns the Hessian of the cost alone: Gauss and Newton's of a quadratic cost."""
    weight = casadi.SX.sym("weight")
    multipliers = casadi.SX.sym("multipliers", g.numel())
    hessian = weight * casadi.hessian(cost, w)[0]
    name, value = (
        ("triu_hess_gamma_x_x", casadi.triu(hessian))
        if triangle
        else ("hess_gamma_x_x", hessian)
    )
    return casadi.Function(
        "nlp_hess_l",
        [w, p, weight, multipliers],
        [value],
        ["x", "p", "lam_f", "lam_g"],
        [name],
    )


def _options(plugin: str, H: int, n: int, m: int, tolerance: float) -> dict[str, Any]:
    """Returns the options of a solver for H stages of n states and m inputs."""
    options: dict[str, Any] = {"print_time": False, "error_on_fail": False}
    if plugin == "ipopt":
        return options | {
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "tol": tolerance,
                "max_iter": MAX_ITERATIONS,
                **IPOPT_WARM,
            }
        }
    stages = {"N": H, "nx": [0] + [n] * H, "nu": [m] * H + [0], "ng": [0] * (H + 1)}
    if plugin == "sqpmethod":
        quiet = dict.fromkeys(
            ("print_header", "print_iteration", "print_status"), False
        )
        hpipm = {
            "print_time": False,
            "error_on_fail": False,
            **stages,
            "hpipm": {"iter_max": 100},
        }
        subproblem = {
            "qpsol": "hpipm",
            "qpsol_options": hpipm,
            "tol_du": tolerance,
            "tol_pr": tolerance,
        }
        return options | quiet | subproblem | {"max_iter": MAX_ITERATIONS}
    fatrop = {"print_level": 0, "tol": tolerance, "mu_init": IPOPT_WARM["mu_init"]}
    structure = {
        "structure_detection": "manual",
        "equality": [True] * (H * n),
        **stages,
    }
    return options | structure | {"fatrop": fatrop}


def _shifted(stages: Array) -> Array:
    """Rows of the stages (H, ...) one step on, the last one repeated."""
    return np.concatenate([stages[1:], stages[-1:]])
