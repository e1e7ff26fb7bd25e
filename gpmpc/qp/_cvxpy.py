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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import ProblemError
from gpmpc.qp import _record as layout
from gpmpc.qp._dual_rescue import polish
from gpmpc.qp._primal_active_set import farkas_ray
from gpmpc.qp._problem import ABSENT, QuadraticProgram, as_program, check_positive
from gpmpc.qp._solution import QPSolution, WarmStart, largest_residual, make_solution
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


@explains_arguments
@dataclass(frozen=True)
class CvxpySolver:
    """Solves through CVXPY.

    Args:
        name: An installed CVXPY solver ("CLARABEL", "OSQP", "SCS", "HIGHS", ...).
        options: The solver's own options, by its own names; if omitted, Clarabel is
            first asked for tight tolerances.
        tolerance: Largest of the ``residuals()`` of a solution called ``SOLVED``.

    Raises:
        ProblemError: A solver that CVXPY does not find (the message lists those it
            finds), or a tolerance that is not positive.
    """

    name: str = "CLARABEL"
    options: dict | None = None
    tolerance: float = 1e-6

    def __post_init__(self):
        import cvxpy

        check_positive(self, "tolerance")
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
        began = perf_counter()
        problem = as_program(problem)
        compiled = _compile_for(problem)
        transform = _Transform.of(problem)
        transform.write_parameters(compiled, problem)
        has_start = False
        if isinstance(warm_start, QPSolution) and len(warm_start.x) == len(problem.q):
            has_start = True
            compiled.y.value = transform.upper_factor @ (warm_start.x - transform.free)
        built = perf_counter()
        choices = [self.options]
        if self.options is None:  # the solver's own, and tight ones before
            choices = [{}]
            if self.name in TIGHT:
                choices.insert(0, TIGHT[self.name])
        best = None
        least = np.inf
        for options in choices:
            status = self._run(compiled.program, has_start, options)
            solution = _read_solution(problem, compiled, transform, status)
            solution = solution._replace(
                build_seconds=built - began, solve_seconds=perf_counter() - built
            )
            if solution.status is Status.INFEASIBLE:
                return solution
            residual = largest_residual(solution)
            if solution.status is Status.SOLVED and residual <= self.tolerance:
                return solution
            if best is None or residual < least:
                best = solution
                least = residual
        assert best is not None
        if best.status is Status.SOLVED:
            best.record[layout.STATUS] = layout.NUMERICAL_TROUBLE
            if self.options is None:  # its working set may be right all the same
                began = perf_counter()
                polished = polish(best, self.tolerance)
                seconds = best.solve_seconds + perf_counter() - began
                return polished._replace(solve_seconds=seconds)
        return best

    def _run(self, program: Any, warm_start: bool, options: dict | None) -> Status:
        """Runs the solver; returns what it says of the result."""
        import cvxpy

        with warnings.catch_warnings(), suppress(cvxpy.SolverError):
            # an inaccurate solution is judged by its residuals
            warnings.simplefilter("ignore")
            program.solve(solver=self.name, warm_start=warm_start, **(options or {}))
            return STATUSES.get(program.status, Status.NUMERICAL_TROUBLE)
        return Status.NUMERICAL_TROUBLE


class _Side(NamedTuple):
    """Constraints of one kind: equalities, upper bounds or lower bounds."""

    members: NDArray[np.bool_]  # (M,) which of the stacked constraints
    sign: float  # of their multipliers: -1 for lower bounds, else +1
    rows: Any  # CVXPY's parameter, (members, n)
    bound: Any  # its parameter, (members,)
    constraint: Any  # its constraint


class _Compiled(NamedTuple):
    """A problem of least distance in CVXPY's form."""

    program: Any
    y: Any  # its variable (n,)
    sides: list[_Side]


class _Transform(NamedTuple):
    """The change of variables x = free + back y."""

    upper_factor: Array  # (n, n) L' with P = L L' (in the kernels P = L'L)
    back: Array  # (n, n) L^-T
    free: Array  # (n,) the free minimiser

    @classmethod
    def of(cls, problem: QuadraticProgram) -> "_Transform":
        """Returns the transform of a problem."""
        upper_factor = np.asarray(np.linalg.cholesky(problem.P), dtype=np.float64).T
        return cls(
            upper_factor=upper_factor,
            back=solve_triangular(upper_factor, np.eye(len(upper_factor))),
            free=-cho_solve((upper_factor, False), problem.q),
        )

    def write_parameters(self, compiled: _Compiled, problem: QuadraticProgram) -> None:
        """Writes the rows and bounds in y."""
        columns = np.concatenate([self.back, problem.G @ self.back])
        offset = np.concatenate([self.free, problem.G @ self.free])
        for side in compiled.sides:
            bounds = problem.lower if side.sign < 0 else problem.upper
            side.rows.value = columns[side.members]
            side.bound.value = (bounds - offset)[side.members]


def _read_solution(
    problem: QuadraticProgram,
    compiled: _Compiled,
    transform: _Transform,
    status: Status,
) -> QPSolution:
    """Returns what the solver found, with multipliers signed as in this package."""
    x = np.zeros(len(problem.q))
    multipliers = np.zeros(len(problem.lower))
    y = compiled.y.value
    if status is Status.INFEASIBLE:
        ray = farkas_ray(problem)
        if ray is None:
            status = Status.NUMERICAL_TROUBLE
        else:
            multipliers = ray
    elif status is not Status.NUMERICAL_TROUBLE and y is not None:
        x = np.clip(transform.free + transform.back @ y, problem.lb, problem.ub)
        for side in compiled.sides:
            dual = side.constraint.dual_value
            if dual is not None:
                multipliers[side.members] += side.sign * np.ravel(dual)
    # beside this size an interior-point method's remains are small
    size = max(1.0, np.abs(multipliers).max())
    active = np.abs(multipliers) > 1e-7 * size
    statistics = compiled.program.solver_stats
    return make_solution(
        problem,
        status,
        x,
        multipliers,
        active_set=np.sign(multipliers) * active,
        iterations=(statistics.num_iters or 0) if statistics else 0,
    )


def _compile_for(problem: QuadraticProgram) -> _Compiled:
    """Returns this thread's compiled problem for a pattern of bounds."""
    equal = (problem.lower == problem.upper) & (problem.upper < ABSENT)
    above = (problem.upper < ABSENT) & ~equal
    below = (problem.lower > -ABSENT) & ~equal
    return _compile(
        threading.get_ident(),
        len(problem.q),
        equal.tobytes(),
        above.tobytes(),
        below.tobytes(),
    )


@lru_cache(maxsize=64)
def _compile(
    thread: int, n: int, equal: bytes, above: bytes, below: bytes
) -> _Compiled:
    """Compiles the problem of a thread for a pattern of bounds.

    ``equal``, ``above`` and ``below`` are masks (M,) of the stacked constraints that
    are equalities, or have an upper or a lower bound.
    """
    import cvxpy

    y = cvxpy.Variable(n)
    sides = []
    for kind, sign in ((equal, 1.0), (above, 1.0), (below, -1.0)):
        members = np.frombuffer(kind, dtype=bool)
        if not members.any():
            continue
        rows = cvxpy.Parameter((members.sum(), n))
        bound = cvxpy.Parameter(members.sum())
        value = rows @ y
        if kind is equal:
            constraint = value == bound
        elif sign > 0:
            constraint = value <= bound
        else:
            constraint = bound <= value
        sides.append(_Side(members, sign, rows, bound, constraint))
    distance = cvxpy.Minimize(0.5 * cvxpy.sum_squares(y))
    program = cvxpy.Problem(distance, [side.constraint for side in sides])
    return _Compiled(program, y, sides)
