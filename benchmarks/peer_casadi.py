"""Problem: what most people would do with a learned model and an optimal control problem: CasADi and IPOPT.

Multiple shooting (Bock and Plitt, 1984) with the states among the unknowns, as CasADi's own examples have it, and what
was found to be its best settings here (N = 189, H = 10, in parentheses the time of the alternative over that chosen):
the GPs' mean as scalar expressions (as matrices 1.8; mapped over the stages 1.4; compiled to C by ``jit`` 1.4 and a
minute and a half of compiling), MUMPS, and a warm start of states, inputs and all multipliers from the last answer,
shifted, with a small barrier parameter (cold 1.5). The Hessian is the exact one or, for a sum of squares, that of Gauss
and Newton, which spares the second derivatives of the GPs (0.6; IPOPT's limited-memory updates 2).
"""

from typing import Literal, NamedTuple

import casadi
import numpy as np

from benchmarks.kkt import Instance
from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.gp.casadi_ import casadi_function
from gpmpc.interrupts import interrupts_after
from gpmpc.mpc.tracking import TrackingProblem

Array = np.ndarray

WARM = {  # IPOPT's options for a start from the solution of a similar problem
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


class Answer(NamedTuple):
    """A plan, with what the next solve starts from.

    Attributes:
        inputs: (H, m).
        states: x_1 .. x_H (H, n).
        of_bounds: Multipliers of the bounds of states and inputs, in their order (H (n + m),).
        of_steps: Multipliers of x_{i+1} = m(x_i, u_i) (H n,).
    """

    inputs: Array
    states: Array
    of_bounds: Array
    of_steps: Array


class CasadiIpopt:
    """Solves one tracking problem after the other on the mean of GPs.

    Args:
        gp: The GPs.
        problem: Weights of states and increments, and bounds of the inputs.
        horizon: H.
        hessian: ``"exact"`` or ``"gauss-newton"``.
        tolerance: IPOPT's, on its own scaled optimality conditions.

    Raises:
        SettingError: The problem weighs something else than increments, or bounds more than inputs.
    """

    def __init__(
        self,
        gp: GPPosterior,
        problem: TrackingProblem,
        horizon: int,
        hessian: Literal["exact", "gauss-newton"],
        tolerance: float,
    ):
        if problem.penalized != "increments" or problem.state_bounds is not None or problem.rate_limited:
            raise SettingError("problem", "must weigh increments, and bound nothing but inputs")
        n, m, H = problem.state_dim, problem.input_dim, horizon
        step, Q, R = mean_function(gp), casadi.DM(problem.Q), casadi.DM(problem.R)
        X, U, r = casadi.MX.sym("X", n, H), casadi.MX.sym("U", m, H), casadi.MX.sym("r", n, H)
        x0, last = casadi.MX.sym("x0", n), casadi.MX.sym("last", m)
        before = [x0, *casadi.horzsplit(X)]
        errors, increments = X - r, U - casadi.horzcat(last, U[:, :-1])
        cost = casadi.sum2(casadi.sum1(errors[:, :-1] * (Q @ errors[:, :-1])))
        cost += casadi.bilin(casadi.DM(problem.terminal), errors[:, -1], errors[:, -1])
        cost += casadi.sum2(casadi.sum1(increments * (R @ increments)))
        unknowns, given = casadi.veccat(X, U), casadi.veccat(x0, last, r)
        defects = casadi.vec(X - casadi.horzcat(*[step(before[k], U[:, k]) for k in range(H)]))
        options = {
            "print_time": False,
            "ipopt": {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": 200, **WARM},
        }
        if hessian == "gauss-newton":
            weight, multipliers = casadi.MX.sym("weight"), casadi.MX.sym("multipliers", H * n)
            triangle = casadi.triu(weight * casadi.hessian(cost, unknowns)[0])
            arguments, names = [unknowns, given, weight, multipliers], ["x", "p", "lam_f", "lam_g"]
            options["hess_lag"] = casadi.Function("nlp_hess_l", arguments, [triangle], names, ["triu_hess_gamma_x_x"])
        nlp = {"x": unknowns, "p": given, "f": cost, "g": defects}
        self._solver = casadi.nlpsol("peer", "ipopt", nlp, options)
        free = np.full(H * n, np.inf)
        self._lower = np.concatenate([-free, np.tile(problem.input_lower, H)])
        self._upper = np.concatenate([free, np.tile(problem.input_upper, H)])
        self._shape = (H, n, m)

    def __call__(self, instance: Instance, last: Answer | None) -> Answer:
        """The plan from a state along a reference, started from the last one, shifted."""
        H, n, m = self._shape
        if last is None:
            start = np.concatenate([instance.targets.ravel(), np.tile(instance.last, H)])
            multipliers = {}
        else:
            bounds_x, bounds_u = last.of_bounds[: H * n], last.of_bounds[H * n :]
            start = np.concatenate([_shifted(last.states, n), _shifted(last.inputs, m)])
            multipliers = {
                "lam_x0": np.concatenate([_shifted(bounds_x, n), _shifted(bounds_u, m)]),
                "lam_g0": _shifted(last.of_steps, n),
            }
        with interrupts_after():
            found = self._solver(
                x0=start,
                p=np.concatenate([instance.state, instance.last, instance.targets.ravel()]),
                lbx=self._lower,
                ubx=self._upper,
                lbg=0.0,
                ubg=0.0,
                **multipliers,
            )
        x, of_bounds, of_steps = (np.array(found[key]).ravel() for key in ("x", "lam_x", "lam_g"))
        return Answer(x[H * n :].reshape(H, m), x[: H * n].reshape(H, n), of_bounds, of_steps)


def mean_function(gp: GPPosterior) -> casadi.Function:
    """The GPs' mean of the next state as scalar expressions, (state, input) -> mean."""
    x, u = casadi.MX.sym("state", gp.state_dim), casadi.MX.sym("input", gp.input_dim)
    return casadi.Function("mean", [x, u], [casadi_function(gp)(x, u)[0]], ["state", "input"], ["mean"]).expand()


def _shifted(values: Array, width: int) -> Array:
    """Stages (H width,) one step on, the last one repeated."""
    flat = values.ravel()
    return np.concatenate([flat[width:], flat[-width:]])
