"""Check of a QP solver of your own: ``check_qp_solver``."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gpmpc._calls import explains_arguments
from gpmpc.qp import QPSolution, QPSolver, QuadraticProgram
from gpmpc.status import Status
from gpmpc.testing._promise import require

_INF = np.inf
_ARRAYS = ("P", "q", "G", "h_lower", "h_upper", "lb", "ub")

_WarmStart = QPSolution | np.ndarray | None


class _SolvedProblem(NamedTuple):
    """A problem with its minimiser.

    The multipliers ``[z_box; z]`` are None if they are not unique.
    """

    name: str
    problem: QuadraticProgram
    x: ArrayLike
    multipliers: ArrayLike | None = None


@explains_arguments
def check_qp_solver(solver: QPSolver, tolerance: float = 1e-6) -> None:
    """Checks a solver against the protocol ``gpmpc.qp.QPSolver``.

    It solves problems whose minimisers and multipliers are known and problems without a
    solution, from warm starts that are right, wrong and absurd, and from arrays in
    awkward layouts. ``tolerance`` is the largest error in x and multipliers (relative
    to their size) and in scaled residuals.

    Raises:
        AssertionError: The solver breaks a promise; the message says which, on which
            problem.
    """
    for reference in (*_solved_by_hand(), *_constructed()):
        solution = _solve(solver, reference.name, reference.problem, None)
        _check_solution(solution, reference, tolerance)
        _check_independence(solver, reference.name, solution)
        _check_warm_starts(solver, reference, solution, tolerance)
        _check_layout(solver, reference, tolerance)
    for name, problem in _infeasible().items():
        _check_infeasible(solver, name, problem)


def _check_solution(
    solution: QPSolution, reference: _SolvedProblem, tolerance: float
) -> None:
    """Compares a solution with the known one, and its residuals with the tolerance."""
    require(
        solution.status is Status.SOLVED,
        reference.name,
        f"expected SOLVED, got {solution.status.name}",
    )
    _check_array(reference.name, "x", solution.x, reference.x, tolerance)
    if reference.multipliers is not None:
        multipliers = np.concatenate([solution.z_box, solution.z])
        _check_array(
            reference.name,
            "[z_box; z]",
            multipliers,
            reference.multipliers,
            tolerance,
        )
    for kind, residual in solution.residuals()._asdict().items():
        require(
            residual <= tolerance,
            reference.name,
            f"the {kind} residual is {residual:.1e}, above {tolerance:.1e}",
        )


def _check_array(
    problem_name: str,
    name: str,
    result: np.ndarray,
    expected: ArrayLike,
    tolerance: float,
) -> None:
    """Compares an array with the known one, relative to its largest entry."""
    difference = np.abs(result - np.asarray(expected)).max()
    error = difference / max(1.0, np.abs(expected).max())
    require(
        error <= tolerance,
        problem_name,
        f"{name} is {result!r}, should be {expected!r}",
    )


def _check_independence(solver: QPSolver, name: str, solution: QPSolution) -> None:
    """Checks that another solve leaves an earlier solution as it is."""
    before = solution.x.copy()
    n = len(before)
    solver.solve(QuadraticProgram(2.0 * np.eye(n), np.ones(n)))
    require(
        np.array_equal(before, solution.x),
        name,
        "a later solve changed an earlier solution",
    )


def _check_warm_starts(
    solver: QPSolver,
    reference: _SolvedProblem,
    solution: QPSolution,
    tolerance: float,
) -> None:
    """Checks that every warm start leads to the solution."""
    active_set = solution.active_set
    constraint_count = len(reference.problem.lower)
    warm_starts: dict[str, _WarmStart] = {
        "its own solution": solution,
        "the right active set": active_set,
        "the opposite active set": -active_set,
        "everything at the upper bounds": np.ones(constraint_count),
        "everything at the lower bounds": -np.ones(constraint_count),
    }
    for kind, warm_start in warm_starts.items():
        warm_solution = _solve(solver, reference.name, reference.problem, warm_start)
        name = f"{reference.name}, warm-started from {kind}"
        _check_solution(warm_solution, reference._replace(name=name), tolerance)


def _check_layout(
    solver: QPSolver, reference: _SolvedProblem, tolerance: float
) -> None:
    """Checks that arrays that are not contiguous lead to the solution."""
    solution = _solve(solver, reference.name, _awkward(reference.problem), None)
    name = f"{reference.name}, in Fortran order and strided"
    _check_solution(solution, reference._replace(name=name), tolerance)


def _check_infeasible(solver: QPSolver, name: str, problem: QuadraticProgram) -> None:
    """Checks that a problem without a solution is called infeasible."""
    upper = np.ones(len(problem.lower))
    for warm_start in (None, upper, -upper):
        status = _solve(solver, name, problem, warm_start).status
        require(
            status is Status.INFEASIBLE, name, f"expected INFEASIBLE, got {status.name}"
        )


def _solve(
    solver: QPSolver, name: str, problem: QuadraticProgram, warm_start: _WarmStart
) -> QPSolution:
    """Solves, and raises where the solver changed its arguments."""
    arrays = _argument_arrays(problem, warm_start)
    before = {argument: array.copy() for argument, array in arrays.items()}
    solution = solver.solve(problem, warm_start)
    for argument, array in _argument_arrays(problem, warm_start).items():
        require(
            np.array_equal(before[argument], array),
            name,
            f"the solver modified {argument}",
        )
    return solution


def _argument_arrays(
    problem: QuadraticProgram, warm_start: _WarmStart
) -> dict[str, np.ndarray]:
    """Returns the arrays that a solver is given, by their names in messages."""
    arrays = {name: getattr(problem, name) for name in _ARRAYS}
    if isinstance(warm_start, np.ndarray):
        arrays["the warm start"] = warm_start
    return arrays


def _awkward(problem: QuadraticProgram) -> QuadraticProgram:
    """Copies P into Fortran order, and other arrays into a part of larger ones."""
    return QuadraticProgram(
        P=np.asfortranarray(problem.P),
        q=_strided(problem.q),
        G=_strided(problem.G),
        h_lower=_strided(problem.h_lower),
        h_upper=_strided(problem.h_upper),
        lb=_strided(problem.lb),
        ub=_strided(problem.ub),
    )


def _strided(array: np.ndarray) -> np.ndarray:
    """Copies an array into every other element of a larger one."""
    return np.repeat(array, 2, axis=-1)[..., ::2]


def _solved_by_hand() -> list[_SolvedProblem]:
    """Returns problems that can be solved by hand."""
    return [*_textbook_problems(), *_degenerate_problems()]


def _textbook_problems() -> list[_SolvedProblem]:
    """Returns problems with unique multipliers."""
    book = "Nocedal and Wright, Numerical Optimization (2006), example"
    return [
        _SolvedProblem(
            name="no constraints",
            problem=QuadraticProgram(np.diag([2.0, 4.0]), [-2.0, -8.0]),
            x=[1.0, 2.0],
            multipliers=[0.0, 0.0],
        ),
        _SolvedProblem(
            name="projection on a box",
            problem=QuadraticProgram(
                np.eye(3),
                [-3.0, 0.5, 7.0],
                lb=[-1.0, -1.0, -1.0],
                ub=[1.0, 1.0, 1e20],
            ),
            x=[1.0, -0.5, -1.0],
            multipliers=[2.0, 0.0, -6.0],
        ),
        _SolvedProblem(
            name=f"{book} 16.2 (equalities)",
            problem=QuadraticProgram(
                [[6.0, 2.0, 1.0], [2.0, 5.0, 2.0], [1.0, 2.0, 4.0]],
                [-8.0, -3.0, -3.0],
                [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]],
                h_lower=[3.0, 0.0],
                h_upper=[3.0, 0.0],
            ),
            x=[2.0, -1.0, 1.0],
            multipliers=[0.0, 0.0, 0.0, -3.0, 2.0],
        ),
        _SolvedProblem(
            name=f"{book} 16.4 (inequalities)",
            problem=QuadraticProgram(
                2.0 * np.eye(2),
                [-2.0, -5.0],
                [[-1.0, 2.0], [1.0, 2.0], [1.0, -2.0]],
                h_lower=[-_INF, -1e30, -_INF],
                h_upper=[2.0, 6.0, 2.0],
                lb=[0.0, 0.0],
            ),
            x=[1.4, 1.7],
            multipliers=[0.0, 0.0, 0.8, 0.0, 0.0],
        ),
        _SolvedProblem(
            name="one variable, one redundant and one active row",
            problem=QuadraticProgram(
                [[2.0]],
                [-4.0],
                [[1.0], [2.0]],
                h_lower=[-_INF, -_INF],
                h_upper=[1.5, 2.0],
            ),
            x=[1.0],
            multipliers=[0.0, 0.0, 1.0],
        ),
    ]


def _degenerate_problems() -> list[_SolvedProblem]:
    """Returns problems whose active constraints depend on each other."""
    angles = np.linspace(0.1, 1.4, 7)
    lines = np.column_stack([np.cos(angles), np.sin(angles)])
    apex = np.array([1.0, 2.0])
    return [
        _SolvedProblem(
            name="seven lines through the solution",
            problem=QuadraticProgram(
                np.diag([1.0, 3.0]),
                [-9.0, -20.0],
                lines,
                h_lower=np.full(7, -_INF),
                h_upper=lines @ apex,
            ),
            x=apex,
        ),
        _SolvedProblem(
            name="the same row five times, at five scales",
            problem=QuadraticProgram(
                np.eye(2),
                [-2.0, -2.0],
                np.outer([1.0, 1e-4, 1e4, 1.0, -3.0], [1.0, 1.0]),
                h_lower=[-_INF, -_INF, -_INF, -_INF, -3.0],
                h_upper=[1.0, 1e-4, 1e4, 1.0, _INF],
            ),
            x=[0.5, 0.5],
        ),
        _SolvedProblem(
            name="a zero row, and a row that repeats the box",
            problem=QuadraticProgram(
                np.eye(2),
                [-2.0, 0.0],
                [[0.0, 0.0], [1.0, 0.0]],
                h_lower=[0.0, -1.0],
                h_upper=[0.0, 1.0],
                ub=[1.0, 1.0],
            ),
            x=[1.0, 0.0],
        ),
        _SolvedProblem(
            name="equalities that repeat each other and fix every variable",
            problem=QuadraticProgram(
                np.eye(2),
                [5.0, -5.0],
                [[1.0, 1.0], [1.0, -1.0], [2.0, 0.0]],
                h_lower=[3.0, 1.0, 4.0],
                h_upper=[3.0, 1.0, 4.0],
            ),
            x=[2.0, 1.0],
        ),
    ]


def _constructed(count: int = 12) -> Iterator[_SolvedProblem]:
    """Returns random problems with a chosen minimiser, active set and multipliers.

    They are built backwards from these; the multipliers are unique.
    """
    rng = np.random.default_rng(2017)
    for number in range(count):
        n = int(rng.integers(2, 25))
        m = int(rng.integers(1, 30))
        root = rng.standard_normal((n, n))
        P = root @ root.T + np.eye(n)
        G = rng.standard_normal((m, n))
        x = rng.standard_normal(n)
        C = np.vstack([np.eye(n), G])  # rows of the box, then those of G
        active = rng.choice(n + m, size=int(rng.integers(0, n)), replace=False)
        sides = rng.choice([-1.0, 1.0], size=len(active))
        multipliers = np.zeros(n + m)
        multipliers[active] = sides * rng.uniform(0.1, 10.0, size=len(active))
        below, above = rng.uniform(0.1, 2.0, (2, n + m))
        below[active[sides < 0]] = 0.0
        above[active[sides > 0]] = 0.0
        lower = C @ x - below
        upper = C @ x + above
        q = -P @ x - C.T @ multipliers
        yield _SolvedProblem(
            name=f"constructed problem {number} (n = {n}, m = {m})",
            problem=QuadraticProgram(
                P=P,
                q=q,
                G=G,
                h_lower=lower[n:],
                h_upper=upper[n:],
                lb=lower[:n],
                ub=upper[:n],
            ),
            x=x,
            multipliers=multipliers,
        )


def _infeasible() -> dict[str, QuadraticProgram]:
    """Returns problems that no point satisfies."""
    return {
        "two opposite rows": QuadraticProgram(
            np.eye(2),
            [0.0, 0.0],
            [[1.0, 1.0], [-1.0, -1.0]],
            h_lower=[-_INF, -_INF],
            h_upper=[1.0, -2.0],
        ),
        "a row against the box": QuadraticProgram(
            np.eye(2),
            [1.0, -3.0],
            [[1.0, 2.0]],
            h_lower=[4.0],
            h_upper=[_INF],
            lb=[-1.0, -1.0],
            ub=[1.0, 1.0],
        ),
        "a zero row that should be one": QuadraticProgram(
            np.eye(3), np.ones(3), np.zeros((1, 3)), h_lower=[1.0], h_upper=[1.0]
        ),
        "three equalities in two variables": QuadraticProgram(
            np.eye(2),
            [0.0, 0.0],
            [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]],
            h_lower=[1.0, 1.0, 3.0],
            h_upper=[1.0, 1.0, 3.0],
        ),
    }
