"""What it takes to be a QP solver of this package: one method."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gpmpc.qp.problem import QuadraticProgram
from gpmpc.qp.solution import QPSolution

WarmStart = QPSolution | NDArray[np.number] | None
"""The solution of a similar problem, or an active set: (M,) -1 at a lower bound, +1 at an upper one, 0 elsewhere."""


class QPSolver(Protocol):
    """Solves strictly convex quadratic programs; ``gpmpc.testing.check_qp_solver`` says whether an object does."""

    def solve(self, problem: QuadraticProgram, warm_start: WarmStart = None) -> QPSolution:
        """The minimiser, or the status that says why there is none. The same answer from any warm start."""
        ...
