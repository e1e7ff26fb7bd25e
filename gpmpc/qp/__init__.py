"""Quadratic programs and their solvers (NumPy float64)."""

from gpmpc.qp.cvxpy_ import CvxpySolver
from gpmpc.qp.dual_active_set import DualActiveSet, Prepared
from gpmpc.qp.primal_active_set import PrimalActiveSet
from gpmpc.qp.problem import QuadraticProgram
from gpmpc.qp.soft_rows import SoftRows
from gpmpc.qp.solution import QPSolution, make_solution
from gpmpc.qp.solver import QPSolver

__all__ = [
    "CvxpySolver",
    "DualActiveSet",
    "Prepared",
    "PrimalActiveSet",
    "QPSolution",
    "QPSolver",
    "QuadraticProgram",
    "SoftRows",
    "make_solution",
]
