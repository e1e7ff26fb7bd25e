"""Checks models, propagators and QP solvers of your own.

They are held against what the rest of gpmpc relies on.
"""

from gpmpc.testing._model import check_model
from gpmpc.testing._propagator import check_propagator
from gpmpc.testing._qp import check_qp_solver

__all__ = ["check_model", "check_propagator", "check_qp_solver"]
