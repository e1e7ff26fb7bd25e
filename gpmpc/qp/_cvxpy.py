"""The same QP through CVXPY: any solver it knows, as a reference and for comparison.

CVXPY turns a problem into a solver's standard form, which takes milliseconds; with
Parameters in the places that the rules of disciplined parametrised programming allow
(Agrawal et al., 2019) it does so once per shape. A quadratic form with a parameter
matrix is not among those places, so the problem is handed over as one of least distance
(Lawson and Hanson, 1974, chapter 23): with P = L L' and the free minimiser x_f = -P^-1
q,

    minimise 1/2 |y|^2   subject to   lower - C x_f <= C L^-T y <= upper - C x_f

    and   x = x_f + L^-T y

It has the same multipliers. The cost of tracking, which no input changes, is gone: an
interior-point method that weighs its duality gap against a cost of 6e5 stopped 1e-3
away from inputs of 0.1.

Compiled problems are kept by thread, shape, and pattern of absent bounds and
equalities. The duals come back signed as this package signs them. The answer is
``SOLVED`` only if its own residuals say so, ``INFEASIBLE`` only with Farkas' proof.
"""

import threading
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from gpmpc.exceptions import ProblemError
from gpmpc.qp import _record as layout
from gpmpc.qp._dual_rescue import rescue
from gpmpc.qp._primal_active_set import farkas_ray
from gpmpc.qp._problem import ABSENT, QuadraticProgram
from gpmpc.qp._solution import QPSolution, WarmStart, make_solution
from gpmpc.status import Status

Array = NDArray[np.float64]

STATUSES = {
    "optimal": Status.SOLVED,
    "optimal_inaccurate": Status.SOLVED,
    "infeasible": Status.INFEASIBLE,
    "infeasible_inaccurate": Status.INFEASIBLE,
    "user_limit": Status.ITERATION_LIMIT,
}
TIGHT = {"CLARABEL": {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-14, "tol_feas": 1e-12}}
"""Options that are tried first, before the solver's own.

A solution that misses them is judged by its residuals.
"""


@dataclass(frozen=True)
class CvxpySolver:
    """Solves through CVXPY.

    Args:
        name: An installed CVXPY solver ("CLARABEL", "OSQP", "SCS", "HIGHS", ...).
        options: The solver's own options, by its own names; if omitted, Clarabel is
            first asked for tight tolerances.
        tolerance: Largest scaled KKT residual of a solution called ``SOLVED``.

    Raises:
        ProblemError: A solver that CVXPY does not find; the message lists those it
            finds.
    """

    name: str = "CLARABEL"
    options: dict | None = None
    tolerance: float = 1e-6

    def __post_init__(self):
        import cvxpy

        installed = cvxpy.installed_solvers()
        if self.name not in installed:
            raise ProblemError(
                f"CVXPY finds no solver named {self.name!r}; "
                f"it finds {', '.join(installed)}"
            )

    def solve(
        self, problem: QuadraticProgram, warm_start: WarmStart = None
    ) -> QPSolution:
        """Solves one problem, see ``QPSolver``.

        A warm start's x is offered to solvers that take one.
        """
        import cvxpy

        began = perf_counter()
        P, q, G, lower, upper = problem
        n = len(q)
        M = len(lower)
        equal = (lower == upper) & (upper < ABSENT)
        kinds = (equal, (upper < ABSENT) & ~equal, (lower > -ABSENT) & ~equal)
        program, y, sides = _compile(
            threading.get_ident(), n, *(kind.tobytes() for kind in kinds)
        )
        factor = np.linalg.cholesky(P).T
        # back = L^-T
        free = -cho_solve((factor, False), q)
        back = solve_triangular(factor, np.eye(n))
        columns = np.concatenate([back, G @ back])
        offset = np.concatenate([free, G @ free])
        for members, sign, rows, bound, _ in sides:
            rows.value = columns[members]
            bound.value = ((lower if sign < 0 else upper) - offset)[members]
        warm = False
        if isinstance(warm_start, QPSolution) and len(warm_start.x) == n:
            warm = True
            y.value = factor @ (warm_start.x - free)
        built = perf_counter()
        best = None
        least = np.inf
        for options in (
            (TIGHT.get(self.name, {}), {}) if self.options is None else (self.options,)
        ):
            status = Status.NUMERICAL_TROUBLE
            x = np.zeros(n)
            multipliers = np.zeros(M)
            with warnings.catch_warnings(), suppress(cvxpy.SolverError):
                warnings.simplefilter(
                    "ignore"
                )  # an inaccurate solution is judged by its residuals
                program.solve(solver=self.name, warm_start=warm, **options)
                status = STATUSES.get(program.status, status)
            if status is Status.INFEASIBLE:
                ray = farkas_ray(problem)
                status, multipliers = (
                    (Status.NUMERICAL_TROUBLE, multipliers)
                    if ray is None
                    else (status, ray)
                )
            elif status is not Status.NUMERICAL_TROUBLE and y.value is not None:
                x = np.clip(free + back @ y.value, problem.lb, problem.ub)
                for members, sign, _, _, constraint in sides:
                    if constraint.dual_value is not None:
                        multipliers[members] += sign * np.ravel(constraint.dual_value)
            size = max(
                1.0, np.abs(multipliers).max()
            )  # beside which an interior-point method's remains are small
            statistics = program.solver_stats
            solution = make_solution(
                problem,
                status,
                x,
                multipliers,
                active_set=np.sign(multipliers) * (np.abs(multipliers) > 1e-7 * size),
                iterations=(statistics.num_iters or 0) if statistics else 0,
                build_seconds=built - began,
                solve_seconds=perf_counter() - built,
            )
            if status is Status.INFEASIBLE:
                return solution
            residual = np.nan_to_num(
                max(solution.residuals(zero=1.0)), nan=np.inf
            )  # no interior point reaches zero
            if status is Status.SOLVED and residual <= self.tolerance:
                return solution
            if best is None or residual < least:
                best = solution
                least = residual
        assert best is not None
        if best.status is Status.SOLVED:
            best.record[layout.STATUS] = layout.NUMERICAL_TROUBLE
            if self.options is None:  # its working set may be right all the same
                best.record[:] = rescue(problem, best.caps, best.record)
        return best


@lru_cache(maxsize=64)
def _compile(
    thread: int, n: int, equal: bytes, above: bytes, below: bytes
) -> tuple[Any, Any, list]:
    """Returns the compiled problem of a thread for a pattern of bounds.

    Of each kind (equalities and upper bounds have the sign +1, lower bounds -1): which
    of the stacked constraints it holds, the sign, the parameters for their rows and
    bounds, and CVXPY's constraint.
    """
    import cvxpy

    y = cvxpy.Variable(n)
    sides = []
    for kind, sign in ((equal, 1.0), (above, 1.0), (below, -1.0)):
        members = np.frombuffer(kind, dtype=bool)
        if members.any():
            rows = cvxpy.Parameter((members.sum(), n))
            bound = cvxpy.Parameter(members.sum())
            at = rows @ y
            constraint = (
                at == bound
                if kind is equal
                else at <= bound
                if sign > 0
                else bound <= at
            )
            sides.append((members, sign, rows, bound, constraint))
    return (
        cvxpy.Problem(
            cvxpy.Minimize(0.5 * cvxpy.sum_squares(y)), [side[-1] for side in sides]
        ),
        y,
        sides,
    )
