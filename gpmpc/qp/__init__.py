"""Quadratic programs and their solvers, in NumPy float64.

``DualActiveSet`` is the default of the controllers, ``PrimalActiveSet`` Algorithm 1 of
Cao, Lai and Alam (2017), and ``CvxpySolver`` takes any solver of CVXPY. Solvers are
imported at first use: who needs a problem or a solution only, such as the writer of
recordings, loads no compiler.
"""

import importlib
from typing import TYPE_CHECKING, Any

from gpmpc.qp._problem import QuadraticProgram
from gpmpc.qp._solution import QPSolution, QPSolver, Residuals, make_solution

if TYPE_CHECKING:
    from gpmpc.qp._cvxpy import CvxpySolver
    from gpmpc.qp._dual_active_set import DualActiveSet, Prepared
    from gpmpc.qp._primal_active_set import PrimalActiveSet

__all__ = [
    "CvxpySolver",
    "DualActiveSet",
    "Prepared",
    "PrimalActiveSet",
    "QPSolution",
    "QPSolver",
    "QuadraticProgram",
    "Residuals",
    "make_solution",
]

_SOLVERS = {
    "CvxpySolver": "_cvxpy",
    "DualActiveSet": "_dual_active_set",
    "Prepared": "_dual_active_set",
    "PrimalActiveSet": "_primal_active_set",
}


def __getattr__(name: str) -> Any:
    if name not in _SOLVERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(
        importlib.import_module(f"{__name__}.{_SOLVERS[name]}"), name
    )
    return value
