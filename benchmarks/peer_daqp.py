"""DAQP as a QP solver of the controllers.

DAQP (Arnstroem, Bemporad and Axehill, 2022), a dual active-set method in C, through the
interface of its Python package that keeps the working set from one solve to the next.
"""

import importlib.util

import numpy as np

from benchmarks.peer_do_mpc import MISSING
from gpmpc.exceptions import SettingError
from gpmpc.qp import QPSolution, QuadraticProgram, make_solution
from gpmpc.qp._problem import ABSENT
from gpmpc.status import Status

STATUSES = {
    1: Status.SOLVED,
    2: Status.SOLVED,
    -1: Status.INFEASIBLE,
    -4: Status.ITERATION_LIMIT,
}  # of its exit flags


def installed() -> bool:
    """Whether there is a DAQP here."""
    return importlib.util.find_spec("daqp") is not None


class Daqp:
    """DAQP as a ``QPSolver``.

    The warm start is its own, from the last program of the same size.

    Raises:
        SettingError: DAQP is not installed.
    """

    def __init__(self) -> None:
        if not installed():
            raise SettingError("solver", f"daqp is {MISSING}")
        self._models: dict = {}

    def solve(self, problem: QuadraticProgram, warm_start: object = None) -> QPSolution:
        """The minimiser; see ``gpmpc.qp.solver.QPSolver``.

        ``warm_start`` is not looked at.
        """
        import daqp

        # Strided arrays are read wrongly by DAQP 0.11, and nothing is said.
        P, q, G = (
            np.ascontiguousarray(part) for part in (problem.P, problem.q, problem.G)
        )
        lower = np.clip(problem.lower, -ABSENT, ABSENT)
        upper = np.clip(problem.upper, -ABSENT, ABSENT)
        model = self._models.get(G.shape)
        if model is None:
            model = self._models[G.shape] = daqp.Model()
            model.setup(P, q, G, upper, lower, np.zeros(len(lower), dtype=np.int32))
        else:
            rows = {"A": G} if len(G) else {}  # which it does not take empty here
            model.update(H=P, f=q, bupper=upper, blower=lower, **rows)
        x, _, flag, details = model.solve()
        status = STATUSES.get(int(flag), Status.NUMERICAL_TROUBLE)
        if not status.solved:
            del self._models[G.shape]  # the next one starts afresh
        return make_solution(
            problem, status, x, details["lam"], iterations=int(details["iterations"])
        )
