"""The same QP through CVXPY: any solver it knows, as a reference and for comparison.

CVXPY turns a problem into a solver's standard form, which takes milliseconds; with Parameters in the places that the
rules of disciplined parametrised programming allow (Agrawal et al., 2019) it does so once per shape. A quadratic form
with a parameter matrix is not among those places, so the problem is handed over as one of least distance (Lawson and
Hanson, 1974, chapter 23): with P = L L' and the free minimiser x_f = -P^-1 q,

    minimise 1/2 |y|^2   subject to   lower - C x_f <= C L^-T y <= upper - C x_f,   x = x_f + L^-T y

It has the same multipliers. The cost of tracking, which no input changes, is gone: an interior-point method that weighs
its duality gap against a cost of 6e5 stopped 1e-3 away from inputs of 0.1.

The compiled problem is kept per shape and per pattern of absent bounds and equalities, one set per thread. The duals
come back signed as this package signs them. The answer is ``SOLVED`` only if its own residuals say so, ``INFEASIBLE``
only with Farkas' proof.
"""

import threading
import warnings
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from gpmpc.exceptions import ProblemError
from gpmpc.qp import _record as layout
from gpmpc.qp._dual_rescue import rescue
from gpmpc.qp.primal_active_set import LAST_CHANGES, farkas_ray
from gpmpc.qp.problem import ABSENT, QuadraticProgram
from gpmpc.qp.solution import QPSolution, WarmStart, make_solution
from gpmpc.status import Status

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_KEPT = 16  # compiled problems per thread
STATUSES = {
    "optimal": Status.SOLVED,
    "optimal_inaccurate": Status.SOLVED,
    "infeasible": Status.INFEASIBLE,
    "infeasible_inaccurate": Status.INFEASIBLE,
    "user_limit": Status.ITERATION_LIMIT,
}
TIGHT = {"CLARABEL": {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-14, "tol_feas": 1e-12}}
"""Options that are tried first, before the solver's own; what is not reached is judged by its residuals."""


@dataclass(frozen=True)
class CvxpySolver:
    """Solves through CVXPY.

    Args:
        name: An installed CVXPY solver ("CLARABEL", "OSQP", "SCS", "HIGHS", ...).
        options: The solver's own options, by its own names; if omitted, Clarabel is first asked for tight tolerances.
        tolerance: Largest scaled KKT residual of a solution called ``SOLVED``.

    Raises:
        ProblemError: A solver that CVXPY does not find; the message lists those it finds.
    """

    name: str = "CLARABEL"
    options: dict | None = None
    tolerance: float = 1e-6
    _compiled: threading.local = field(default_factory=threading.local, init=False, repr=False, compare=False)

    def __post_init__(self):
        import cvxpy

        installed = cvxpy.installed_solvers()
        if self.name not in installed:
            raise ProblemError(f"CVXPY finds no solver named {self.name!r}; it finds {', '.join(installed)}")

    def solve(self, problem: QuadraticProgram, warm_start: WarmStart = None) -> QPSolution:
        """The minimiser; a warm start's x is offered to solvers that take one. See ``gpmpc.qp.solver.QPSolver``."""
        began = perf_counter()
        lower, upper = problem.lower, problem.upper
        n, M = len(problem.q), len(lower)
        form = self._form(n, lower, upper)
        factor = np.linalg.cholesky(problem.P).T
        free = -cho_solve((factor, False), problem.q)
        back = solve_triangular(factor, np.eye(n))  # L^-T
        columns, offset = np.concatenate([back, problem.G @ back]), np.concatenate([free, problem.G @ free])
        for side in form.sides:
            side.rows.value = columns[side.members]
            side.bound.value = ((lower if side.sign < 0 else upper) - offset)[side.members]
        warm = False
        if isinstance(warm_start, QPSolution) and len(warm_start.x) == n:
            warm = True
            form.y.value = factor @ (warm_start.x - free)
        built = perf_counter()
        solutions = []
        for options in (TIGHT.get(self.name, {}), {}) if self.options is None else (self.options,):
            claim = _solve_form(form, self.name, warm, options)
            status, x, multipliers = STATUSES.get(claim, Status.NUMERICAL_TROUBLE), np.zeros(n), np.zeros(M)
            if status is Status.INFEASIBLE:
                ray = farkas_ray(problem)
                status, multipliers = (Status.NUMERICAL_TROUBLE, multipliers) if ray is None else (status, ray)
            elif claim in STATUSES and form.y.value is not None:
                x = np.clip(free + back @ form.y.value, problem.lb, problem.ub)
                for side in form.sides:
                    if side.constraint.dual_value is not None:
                        multipliers[side.members] += side.sign * np.ravel(side.constraint.dual_value)
            statistics = form.problem.solver_stats
            solution = make_solution(
                problem,
                status,
                x,
                multipliers,
                active_set=_working(multipliers),
                iterations=(statistics.num_iters or 0) if statistics else 0,
                build_seconds=built - began,
                solve_seconds=perf_counter() - built,
            )
            if status is Status.INFEASIBLE:
                return solution
            residual = max(solution.residuals(zero=1.0))  # an interior point does not reach zero
            solutions.append((float(np.nan_to_num(residual, nan=np.inf)), solution))
            if status is Status.SOLVED and solutions[-1][0] <= self.tolerance:
                return solution
        residual, solution = min(solutions, key=lambda pair: pair[0])
        if solution.status is Status.SOLVED and residual > self.tolerance:
            solution.record[layout.STATUS] = layout.NUMERICAL_TROUBLE
            if self.options is None:  # its working set may be right all the same
                solution.record[:] = rescue(problem, solution.softness, solution.record, LAST_CHANGES, lambda: False)
        return solution

    def _form(self, n: int, lower: Array, upper: Array) -> "_Form":
        """The compiled problem for this pattern of bounds, from the thread's own store."""
        forms = self._compiled.__dict__.setdefault("forms", {})
        equal = (lower == upper) & (upper < ABSENT)
        below, above = (lower > -ABSENT) & ~equal, (upper < ABSENT) & ~equal
        key = (n, equal.tobytes(), below.tobytes(), above.tobytes())
        if key not in forms:
            if len(forms) == _KEPT:
                del forms[next(iter(forms))]
            forms[key] = _formulate(n, equal, below, above)
        return forms[key]


def _solve_form(form: "_Form", name: str, warm: bool, options: dict) -> str:
    """Hands the problem to the solver; returns what CVXPY says of it."""
    import cvxpy

    try:
        with warnings.catch_warnings():  # an inaccurate solution is judged by its residuals
            warnings.simplefilter("ignore")
            form.problem.solve(solver=name, warm_start=warm, **options)
    except cvxpy.SolverError:
        return "solver_error"
    return form.problem.status


class _Side(NamedTuple):
    """The constraints of one kind: equalities, upper bounds (sign +1) or lower bounds (sign -1)."""

    members: Mask
    sign: float
    rows: Any
    bound: Any
    constraint: Any


class _Form(NamedTuple):
    """A CVXPY problem with its parameters."""

    problem: Any
    y: Any
    sides: list[_Side]


def _formulate(n: int, equal: Mask, below: Mask, above: Mask) -> _Form:
    import cvxpy

    y, sides = cvxpy.Variable(n), []
    for members, sign in ((equal, 1.0), (above, 1.0), (below, -1.0)):
        count = int(members.sum())
        if count:
            rows, bound = cvxpy.Parameter((count, n)), cvxpy.Parameter(count)
            at = rows @ y
            constraint = at == bound if members is equal else at <= bound if sign > 0 else bound <= at
            sides.append(_Side(members, sign, rows, bound, constraint))
    cost = 0.5 * cvxpy.sum_squares(y)
    return _Form(cvxpy.Problem(cvxpy.Minimize(cost), [side.constraint for side in sides]), y, sides)


def _working(multipliers: Array) -> Array:
    """The signs of the multipliers that are not an interior-point method's remains."""
    size = max(1.0, np.abs(multipliers).max(initial=0.0))
    return np.where(np.abs(multipliers) > 1e-7 * size, np.sign(multipliers), 0.0)
