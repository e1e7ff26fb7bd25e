"""What cannot be exported, refused by name before anything is written."""

from typing import Any

from gpmpc._dynamics import check_next_states
from gpmpc.exceptions import SettingError, check_choice
from gpmpc.models import DelayedModel
from gpmpc.mpc import GPMPC, Reference
from gpmpc.qp import DualActiveSet


def check_kappas(reference: Reference) -> None:
    """Raises ``SettingError`` for a reference with deviations of its own."""
    if reference.kappas is not None:
        rule = "an exported controller keeps its problem's deviations; leave them out"
        raise SettingError("reference.kappas", f"{rule}; got {reference.kappas}")


def check_exportable(controller: Any, on_failure: str) -> None:
    """Raises ``SettingError`` of the first setting that a file in C cannot hold."""
    if not isinstance(controller, GPMPC):
        rule = "an exported one is GPMPC"
        raise SettingError("controller", f"{rule}; got {type(controller).__name__}")
    check_next_states(controller.prediction.model)
    check_choice("on_failure", on_failure, ("previous_plan", "hold"))
    _check_weighed_states(controller)
    _check_programs(controller)
    _check_clock("budget", controller.budget)
    _check_covariance(controller)
    _check_solver(controller.solver)


def _check_weighed_states(controller: GPMPC) -> None:
    """Raises where inputs on their way are to be kept by the loop: C keeps none."""
    n = controller.prediction.state_dim
    weighed = controller.problem.state_dim
    if isinstance(controller.prediction.model, DelayedModel) and weighed != n:
        rule = f"an exported one weighs all {n} states, pending inputs by zero"
        raise SettingError("problem", f"{rule}; got {weighed}")


def _check_programs(controller: GPMPC) -> None:
    """Raises unless a step takes one program."""
    if controller.most_programs > 1:
        rule = (
            "an exported step takes one program; fly with iterations=1 first, on the "
            "command line controller.iterations=1"
        )
        raise SettingError("iterations", f"{rule}; got {controller.iterations}")


def _check_clock(key: str, limit: float | None) -> None:
    """Raises where a time ends a decision."""
    if limit is not None:
        rule = "an exported step knows no clock; take the solver's iteration_limit"
        raise SettingError(key, f"{rule}; got {limit}")


def _check_covariance(controller: GPMPC) -> None:
    """Raises unless covariances are first-order ones, or none."""
    settings = controller.prediction.settings
    if settings.covariance not in ("zero_order", "none"):
        rule = "an exported program holds means: 'zero_order' or 'none'"
        raise SettingError("covariance", f"{rule}; got {settings.covariance!r}")
    if controller.prediction.linearizer.depends_on_covariance:
        rule = "an exported covariance is linearised: Linearization()"
        got = type(controller.prediction.propagator).__name__
        raise SettingError("propagator", f"{rule}; got {got}")


def _check_solver(solver: Any) -> None:
    """Raises unless the solver is the dual active set, without a clock."""
    if not isinstance(solver, DualActiveSet):
        rule = "an exported one is DualActiveSet()"
        raise SettingError("solver", f"{rule}; got {type(solver).__name__}")
    _check_clock("solver.time_limit", solver.time_limit)
