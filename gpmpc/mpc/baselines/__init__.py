"""Controllers to compare with.

``NMPC`` is nonlinear MPC on the true model, ``LQR`` linear-quadratic tracking, and
``StateFormMPC`` the program of ``GPMPC`` in CVXPY.
"""

from gpmpc.mpc.baselines._lqr import LQR
from gpmpc.mpc.baselines._nmpc import NMPC
from gpmpc.mpc.baselines._state_form import StateFormMPC

__all__ = ["LQR", "NMPC", "StateFormMPC"]
