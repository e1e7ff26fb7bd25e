"""Does a QP solver keep its promises?

``check_qp_solver(solver)`` gives it problems whose minimisers and multipliers are known, problems without a solution,
warm starts that are right, wrong and absurd, and arrays in awkward layouts. It raises an ``AssertionError`` that
names the problem and what was wrong with the answer, and returns nothing if all is well.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpmpc.qp import QPSolution, QPSolver, QuadraticProgram
from gpmpc.status import Status

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReferenceProblem:
    """A QP with its known minimiser; multipliers ``[z_box; z]`` are None where they are not unique."""

    name: str
    problem: QuadraticProgram
    x: Array
    multipliers: Array | None


def check_qp_solver(solver: QPSolver, tolerance: float = 1e-6) -> None:
    """Checks ``solver`` against the protocol ``gpmpc.qp.solver.QPSolver``.

    Args:
        solver: The object to check.
        tolerance: Largest error in x, multipliers (relative to their size) and scaled residuals.

    Raises:
        AssertionError: The solver breaks a promise; the message says which, on which problem.
    """
    references = [*textbook_problems(), *degenerate_problems(), *constructed_problems()]
    for reference in references:
        solution = _solve_untouched(solver, reference.name, reference.problem, None)
        _check(solution, reference, tolerance)
        n, M = len(reference.x), len(reference.problem.lower)
        right = solution.active_set
        for kind, warm_start in (
            ("its own solution", solution),
            ("the right active set", right),
            ("the opposite active set", -right),
            ("everything at the upper bounds", np.ones(M)),
            ("everything at the lower bounds", -np.ones(M)),
        ):
            again = _solve_untouched(solver, reference.name, reference.problem, warm_start)
            _check(again, replace(reference, name=f"{reference.name}, warm-started from {kind}"), tolerance)
        first = solution.x.copy()
        solver.solve(QuadraticProgram(2.0 * np.eye(n), np.ones(n)))
        _require(np.array_equal(first, solution.x), f"{reference.name}: a later solve changed an earlier solution")
        awkward = _solve_untouched(solver, reference.name, _awkward(reference.problem), None)
        _check(awkward, replace(reference, name=f"{reference.name}, in Fortran order and strided"), tolerance)
    for name, problem in infeasible_problems().items():
        for warm_start in (None, np.ones(len(problem.lower)), -np.ones(len(problem.lower))):
            status = _solve_untouched(solver, name, problem, warm_start).status
            _require(status is Status.INFEASIBLE, f"{name}: expected INFEASIBLE, got {status.name}")


def textbook_problems() -> list[ReferenceProblem]:
    """Small problems that can be solved by hand."""
    inf = np.inf
    centre = np.array([3.0, -0.5, -7.0])
    return [
        ReferenceProblem(
            "no constraints", QuadraticProgram(np.diag([2.0, 4.0]), [-2.0, -8.0]), np.array([1.0, 2.0]), np.zeros(2)
        ),
        ReferenceProblem(
            "projection on a box",
            QuadraticProgram(np.eye(3), -centre, lb=[-1.0, -1.0, -1.0], ub=[1.0, 1.0, 1e20]),
            np.array([1.0, -0.5, -1.0]),
            np.array([2.0, 0.0, -6.0]),
        ),
        ReferenceProblem(
            "Nocedal and Wright, Numerical Optimization (2006), example 16.2 (equalities)",
            QuadraticProgram(
                [[6.0, 2.0, 1.0], [2.0, 5.0, 2.0], [1.0, 2.0, 4.0]], [-8.0, -3.0, -3.0],
                [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]], [3.0, 0.0], [3.0, 0.0],
            ),
            np.array([2.0, -1.0, 1.0]),
            np.array([0.0, 0.0, 0.0, -3.0, 2.0]),
        ),
        ReferenceProblem(
            "Nocedal and Wright, Numerical Optimization (2006), example 16.4 (inequalities)",
            QuadraticProgram(
                2.0 * np.eye(2), [-2.0, -5.0], [[-1.0, 2.0], [1.0, 2.0], [1.0, -2.0]], [-inf, -1e30, -inf],
                [2.0, 6.0, 2.0], lb=[0.0, 0.0],
            ),
            np.array([1.4, 1.7]),
            np.array([0.0, 0.0, 0.8, 0.0, 0.0]),
        ),
        ReferenceProblem(
            "one variable, one redundant and one working row",
            QuadraticProgram([[2.0]], [-4.0], [[1.0], [2.0]], [-inf, -inf], [1.5, 2.0]),
            np.array([1.0]),
            np.array([0.0, 0.0, 1.0]),
        ),
    ]  # fmt: skip


def degenerate_problems() -> list[ReferenceProblem]:
    """Vertices with more constraints than variables, repeated, scaled and zero rows."""
    fan = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0.1, 1.4, 7)])
    apex = np.array([1.0, 2.0])
    return [
        ReferenceProblem(
            "seven lines through the solution",
            QuadraticProgram(np.diag([1.0, 3.0]), [-9.0, -20.0], fan, np.full(7, -np.inf), fan @ apex),
            apex,
            None,
        ),
        ReferenceProblem(
            "the same row five times, at five scales",
            QuadraticProgram(
                np.eye(2), [-2.0, -2.0], np.outer([1.0, 1e-4, 1e4, 1.0, -3.0], [1.0, 1.0]),
                [-np.inf] * 4 + [-3.0], [1.0, 1e-4, 1e4, 1.0, np.inf],
            ),
            np.array([0.5, 0.5]),
            None,
        ),
        ReferenceProblem(
            "a zero row, and a row that repeats the box",
            QuadraticProgram(np.eye(2), [-2.0, 0.0], [[0.0, 0.0], [1.0, 0.0]], [0.0, -1.0], [0.0, 1.0], ub=[1.0, 1.0]),
            np.array([1.0, 0.0]),
            None,
        ),
        ReferenceProblem(
            "equalities that repeat each other and fix every variable",
            QuadraticProgram(
                np.eye(2), [5.0, -5.0], [[1.0, 1.0], [1.0, -1.0], [2.0, 0.0]], [3.0, 1.0, 4.0], [3.0, 1.0, 4.0]
            ),
            np.array([2.0, 1.0]),
            None,
        ),
    ]  # fmt: skip


def constructed_problems(count: int = 12) -> list[ReferenceProblem]:
    """Random problems built backwards from a chosen minimiser, active set and multipliers (which are then unique)."""
    rng = np.random.default_rng(2017)
    problems = []
    for number in range(count):
        n = int(rng.integers(2, 25))
        m = int(rng.integers(1, 30))
        root = rng.standard_normal((n, n))
        P, G, x = root @ root.T + np.eye(n), rng.standard_normal((m, n)), rng.standard_normal(n)
        C = np.vstack([np.eye(n), G])
        working = rng.choice(n + m, size=int(rng.integers(0, n)), replace=False)
        sides = rng.choice([-1.0, 1.0], size=len(working))
        multipliers = np.zeros(n + m)
        multipliers[working] = sides * rng.uniform(0.1, 10.0, size=len(working))
        margin_below, margin_above = rng.uniform(0.1, 2.0, (2, n + m))
        margin_below[working[sides < 0]], margin_above[working[sides > 0]] = 0.0, 0.0
        lower, upper = C @ x - margin_below, C @ x + margin_above
        q = -P @ x - C.T @ multipliers
        problem = QuadraticProgram(P, q, G, lower[n:], upper[n:], lower[:n], upper[:n])
        problems.append(ReferenceProblem(f"constructed problem {number} (n = {n}, m = {m})", problem, x, multipliers))
    return problems


def infeasible_problems() -> dict[str, QuadraticProgram]:
    """Problems that no point satisfies."""
    inf = np.inf
    return {
        "two opposite rows": QuadraticProgram(
            np.eye(2), [0.0, 0.0], [[1.0, 1.0], [-1.0, -1.0]], [-inf, -inf], [1.0, -2.0]
        ),
        "a row against the box": QuadraticProgram(
            np.eye(2), [1.0, -3.0], [[1.0, 2.0]], [4.0], [inf], [-1, -1], [1.0, 1.0]
        ),
        "a zero row that should be one": QuadraticProgram(np.eye(3), np.ones(3), np.zeros((1, 3)), [1.0], [1.0]),
        "three equalities in two variables": QuadraticProgram(
            np.eye(2), [0.0, 0.0], [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], [1.0, 1.0, 3.0], [1.0, 1.0, 3.0]
        ),
    }


def _solve_untouched(solver: QPSolver, name: str, problem: QuadraticProgram, warm_start) -> QPSolution:
    arrays = {field: getattr(problem, field) for field in ("P", "q", "G", "h_lower", "h_upper", "lb", "ub")}
    before = {field: array.copy() for field, array in arrays.items()}
    guess = warm_start.copy() if isinstance(warm_start, np.ndarray) else None
    solution = solver.solve(problem, warm_start)
    for field, array in arrays.items():
        _require(np.array_equal(array, before[field]), f"{name}: the solver modified {field}")
    if guess is not None:
        _require(np.array_equal(guess, warm_start), f"{name}: the solver modified the warm start")
    return solution


def _awkward(problem: QuadraticProgram) -> QuadraticProgram:
    """The same numbers in Fortran order and every other element of larger arrays."""

    def strided(array):
        wide = np.repeat(np.repeat(array, 2, axis=0), 2, axis=-1) if array.ndim == 2 else np.repeat(array, 2)
        return wide[::2, ::2] if array.ndim == 2 else wide[::2]

    return QuadraticProgram(
        np.asfortranarray(problem.P), strided(problem.q), strided(problem.G), strided(problem.h_lower),
        strided(problem.h_upper), strided(problem.lb), strided(problem.ub),
    )  # fmt: skip


def _check(solution: QPSolution, reference: ReferenceProblem, tolerance: float) -> None:
    name = reference.name
    _require(solution.status is Status.SOLVED, f"{name}: expected SOLVED, got {solution.status.name}")
    error = np.abs(solution.x - reference.x).max() / max(1.0, np.abs(reference.x).max())
    _require(error <= tolerance, f"{name}: x is {solution.x}, should be {reference.x}")
    if reference.multipliers is not None:
        given = np.concatenate([solution.z_box, solution.z])
        error = np.abs(given - reference.multipliers).max() / max(1.0, np.abs(reference.multipliers).max())
        _require(error <= tolerance, f"{name}: [z_box; z] is {given}, should be {reference.multipliers}")
    for kind, value in solution.residuals()._asdict().items():
        _require(value <= tolerance, f"{name}: the {kind} residual is {value:.1e}, above {tolerance:.1e}")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)
