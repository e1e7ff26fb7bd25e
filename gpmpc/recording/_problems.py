"""Recorded quadratic programs: their arrays, residuals, and solving them again."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gpmpc.exceptions import RecordingError
from gpmpc.status import Status

if TYPE_CHECKING:
    from gpmpc.qp import QPSolution

Array = np.ndarray
_NO_RESIDUALS = (np.nan, np.nan, np.nan)


class RecordedProblem(NamedTuple):
    """A quadratic program as it was solved; letters as in ``gpmpc.qp``."""

    P: Array  # (n, n)
    q: Array  # (n,)
    G: Array  # (m, n)
    lower: Array  # (M,) bounds of the stacked constraints [x; Gx]
    upper: Array  # (M,)
    # (2, M) zeros (older recordings: 1/rho of quadratic prices), and the multipliers'
    # largest sizes
    softness: Array
    x: Array  # (n,) the solution found then; empty where there was none
    multipliers: Array  # (M,) its multipliers; empty where there was none


def solve_again(recorded: RecordedProblem) -> "QPSolution":
    """Solves a recorded program.

    Raises:
        GpmpcError: It is no convex program, or has prices that are not solved today.
    """
    from gpmpc.qp import DualActiveSet, QuadraticProgram

    number_of_variables = len(recorded.q)
    quadratic_prices = recorded.softness[0, number_of_variables:]
    caps = recorded.softness[1, number_of_variables:]
    problem = QuadraticProgram.from_stacked(
        recorded.P, recorded.q, recorded.G, recorded.lower, recorded.upper
    )
    if quadratic_prices.any():
        raise RecordingError(
            "its rows have quadratic prices, as in files of the first edition"
        )
    prices = None if np.isinf(caps).all() else caps
    return DualActiveSet().solve(problem, prices=prices)


def residuals(problem: RecordedProblem | None) -> tuple[float, float, float]:
    """Returns primal and dual residual and duality gap of a recorded solution.

    They are NaN where there is none.
    """
    from gpmpc.qp import QuadraticProgram, make_solution

    if problem is None or not len(problem.x):
        return _NO_RESIDUALS
    program = QuadraticProgram.unchecked(
        problem.P, problem.q, problem.G, problem.lower, problem.upper
    )
    solution = make_solution(program, Status.SOLVED, problem.x, problem.multipliers)
    return solution._replace(caps=problem.softness[1]).residuals()
