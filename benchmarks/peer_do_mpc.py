"""Poses the problem in the do-mpc toolbox (Fiedler et al., 2023).

A discrete model with the GPs' mean as its right-hand side, do-mpc's own ``MPC`` with a
penalty of the increments, and IPOPT with MUMPS behind it. do-mpc starts from its last
solution, as it stands; its internals are left alone.
"""

import importlib
import importlib.util
import warnings
from typing import Any, NamedTuple

import casadi
import numpy as np

from benchmarks.kkt import Instance
from benchmarks.peer_casadi import (
    IPOPT_WARM,
    MAX_ITERATIONS,
    check_problem,
    mean_function,
)
from gpmpc._interrupts import interrupts_after
from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.mpc import Problem

MISSING = "not installed: pip install 'gpmpc[bench]'"


def installed() -> bool:
    """Whether there is a do-mpc here."""
    return importlib.util.find_spec("do_mpc") is not None


class Planned(NamedTuple):
    """A plan (H, m); the toolbox keeps its warm start to itself."""

    inputs: np.ndarray


class DoMpc:
    """Solves one tracking problem after the other on the mean of GPs.

    Args:
        gp: The GPs.
        problem: Diagonal weights of states and increments, and bounds of the inputs.
        horizon: H.
        tolerance: IPOPT's, on its own scaled optimality conditions.

    Raises: SettingError: do-mpc is not installed, or the problem has what this file
        does not hand on.
    """

    def __init__(
        self, gp: GPPosterior, problem: Problem, horizon: int, tolerance: float
    ):
        if not installed():
            raise SettingError("peers", f"do-mpc is {MISSING}")
        check_problem(problem)
        if np.count_nonzero(problem.cost.R - np.diag(problem.cost.R.diagonal())):
            raise SettingError(
                "R", "must be diagonal: do-mpc's penalty of the increments is"
            )
        self._horizon = horizon
        with (
            warnings.catch_warnings()
        ):  # about what else could be installed, and about CasADi's next version
            warnings.simplefilter("ignore")
            self._set_up(gp, problem, tolerance)

    def _set_up(self, gp: GPPosterior, problem: Problem, tolerance: float) -> None:
        toolbox = importlib.import_module("do_mpc")
        model = _model(toolbox, gp)
        self._mpc = mpc = toolbox.controller.MPC(model)
        mpc.settings.n_horizon = self._horizon
        mpc.settings.t_step = 1.0
        mpc.settings.store_full_solution = False
        settings = {
            "tol": tolerance,
            "max_iter": MAX_ITERATIONS,
        } | IPOPT_WARM  # it hands on the last multipliers, but no such option
        mpc.settings.nlpsol_opts = {
            f"ipopt.{name}": value for name, value in settings.items()
        }
        mpc.settings.supress_ipopt_output()
        x = model.x["x"]
        r = model.tvp["r"]
        Q = casadi.DM(problem.cost.Q)
        terminal = casadi.DM(problem.cost.terminal)
        mpc.set_objective(
            mterm=casadi.bilin(terminal, x - r, x - r),
            lterm=casadi.bilin(Q, x - r, x - r),
        )
        mpc.set_rterm(u=problem.cost.R.diagonal())
        mpc.bounds["lower", "_u", "u"] = problem.inputs.lower
        mpc.bounds["upper", "_u", "u"] = problem.inputs.upper
        self._references = mpc.get_tvp_template()
        mpc.set_tvp_fun(lambda time: self._references)
        mpc.setup()

    def __call__(self, instance: Instance, last: Planned | None) -> Planned:
        """The plan from a state along a reference, started as do-mpc does."""
        mpc = self._mpc
        for k, target in enumerate(instance.reference.states):
            self._references["_tvp", k, "r"] = target
        mpc.u0 = instance.last
        if last is None:
            mpc.reset_history()
            mpc.x0 = instance.state
            mpc.set_initial_guess()
        with interrupts_after():
            mpc.make_step(instance.state)
        inputs = [
            np.array(mpc.opt_x_num["_u", k, 0]).ravel() for k in range(self._horizon)
        ]
        return Planned(np.array(inputs))


def _model(toolbox: Any, gp: GPPosterior) -> Any:
    model = toolbox.model.Model("discrete", "SX")
    x = model.set_variable("_x", "x", shape=(gp.state_dim, 1))
    u = model.set_variable("_u", "u", shape=(gp.input_dim, 1))
    model.set_variable("_tvp", "r", shape=(gp.state_dim, 1))
    model.set_rhs("x", mean_function(gp)(x, u))
    model.setup()
    return model
