"""Check of a QP solver of your own: ``check_qp_solver``."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from gpmpc.qp import QPSolution, QPSolver, QuadraticProgram
from gpmpc.status import Status
from gpmpc.testing._promise import require

_INF = np.inf
_FIELDS = ("P", "q", "G", "h_lower", "h_upper", "lb", "ub")


class _Known(NamedTuple):
    """A problem with its minimiser.

    The multipliers ``[z_box; z]`` are None if they are not unique.
    """

    name: str
    problem: QuadraticProgram
    x: Any
    multipliers: Any = None


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
    for known in (*_small(), *_constructed()):
        solution = _solve(solver, known.name, known.problem, None)
        _check(solution, known, tolerance)
        first = solution.x.copy()
        n = len(solution.x)
        right = solution.active_set
        solver.solve(QuadraticProgram(2.0 * np.eye(n), np.ones(n)))
        require(
            np.array_equal(first, solution.x),
            known.name,
            "a later solve changed an earlier solution",
        )
        starts = {
            "its own solution": solution,
            "the right active set": right,
            "the opposite active set": -right,
            "everything at the upper bounds": np.ones(len(known.problem.lower)),
            "everything at the lower bounds": -np.ones(len(known.problem.lower)),
        }
        for kind, warm_start in starts.items():
            again = _solve(solver, known.name, known.problem, warm_start)
            _check(
                again,
                known._replace(name=f"{known.name}, warm-started from {kind}"),
                tolerance,
            )
        awkward = _solve(solver, known.name, _awkward(known.problem), None)
        _check(
            awkward,
            known._replace(name=f"{known.name}, in Fortran order and strided"),
            tolerance,
        )
    for name, problem in _infeasible().items():
        for warm_start in (
            None,
            np.ones(len(problem.lower)),
            -np.ones(len(problem.lower)),
        ):
            status = _solve(solver, name, problem, warm_start).status
            require(
                status is Status.INFEASIBLE,
                name,
                f"expected INFEASIBLE, got {status.name}",
            )


def _small() -> list[_Known]:
    """Returns problems that can be solved by hand.

    Some have more active constraints than variables, or repeat rows.
    """
    book = "Nocedal and Wright, Numerical Optimization (2006), example"
    centre = np.array([3.0, -0.5, -7.0])
    P = [[6.0, 2.0, 1.0], [2.0, 5.0, 2.0], [1.0, 2.0, 4.0]]
    G = [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]
    equalities = QuadraticProgram(P, [-8.0, -3.0, -3.0], G, [3.0, 0.0], [3.0, 0.0])
    rows = [[-1.0, 2.0], [1.0, 2.0], [1.0, -2.0]]
    lower = [-_INF, -1e30, -_INF]
    upper = [2.0, 6.0, 2.0]
    inequalities = QuadraticProgram(
        2.0 * np.eye(2), [-2.0, -5.0], rows, lower, upper, lb=[0.0, 0.0]
    )
    box = QuadraticProgram(
        np.eye(3), -centre, lb=[-1.0, -1.0, -1.0], ub=[1.0, 1.0, 1e20]
    )
    redundant = QuadraticProgram(
        [[2.0]], [-4.0], [[1.0], [2.0]], [-_INF, -_INF], [1.5, 2.0]
    )
    fan = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0.1, 1.4, 7)])
    apex = np.array([1.0, 2.0])
    lines = QuadraticProgram(
        np.diag([1.0, 3.0]), [-9.0, -20.0], fan, np.full(7, -_INF), fan @ apex
    )
    rows = np.outer([1.0, 1e-4, 1e4, 1.0, -3.0], [1.0, 1.0])
    scales = QuadraticProgram(
        np.eye(2), [-2.0, -2.0], rows, [-_INF] * 4 + [-3.0], [1.0, 1e-4, 1e4, 1.0, _INF]
    )
    zero = QuadraticProgram(
        np.eye(2),
        [-2.0, 0.0],
        [[0.0, 0.0], [1.0, 0.0]],
        [0.0, -1.0],
        [0.0, 1.0],
        ub=[1.0, 1.0],
    )
    rows = [[1.0, 1.0], [1.0, -1.0], [2.0, 0.0]]
    equal = QuadraticProgram(
        np.eye(2), [5.0, -5.0], rows, [3.0, 1.0, 4.0], [3.0, 1.0, 4.0]
    )
    return [
        _Known(
            "no constraints",
            QuadraticProgram(np.diag([2.0, 4.0]), [-2.0, -8.0]),
            [1.0, 2.0],
            [0.0, 0.0],
        ),
        _Known("projection on a box", box, [1.0, -0.5, -1.0], [2.0, 0.0, -6.0]),
        _Known(
            f"{book} 16.2 (equalities)",
            equalities,
            [2.0, -1.0, 1.0],
            [0.0, 0.0, 0.0, -3.0, 2.0],
        ),
        _Known(
            f"{book} 16.4 (inequalities)",
            inequalities,
            [1.4, 1.7],
            [0.0, 0.0, 0.8, 0.0, 0.0],
        ),
        _Known(
            "one variable, one redundant and one active row",
            redundant,
            [1.0],
            [0.0, 0.0, 1.0],
        ),
        _Known("seven lines through the solution", lines, apex),
        _Known("the same row five times, at five scales", scales, [0.5, 0.5]),
        _Known("a zero row, and a row that repeats the box", zero, [1.0, 0.0]),
        _Known(
            "equalities that repeat each other and fix every variable",
            equal,
            [2.0, 1.0],
        ),
    ]


def _constructed(count: int = 12) -> Iterator[_Known]:
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
        C = np.vstack([np.eye(n), G])
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
        problem = QuadraticProgram(P, q, G, lower[n:], upper[n:], lower[:n], upper[:n])
        yield _Known(
            f"constructed problem {number} (n = {n}, m = {m})", problem, x, multipliers
        )


def _infeasible() -> dict[str, QuadraticProgram]:
    """Problems that no point satisfies."""
    eye = np.eye(2)
    rows = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    sides = [1.0, 1.0, 3.0]
    return {
        "two opposite rows": QuadraticProgram(
            eye, [0.0, 0.0], [[1.0, 1.0], [-1.0, -1.0]], [-_INF, -_INF], [1.0, -2.0]
        ),
        "a row against the box": QuadraticProgram(
            eye, [1.0, -3.0], [[1.0, 2.0]], [4.0], [_INF], [-1, -1], [1.0, 1.0]
        ),
        "a zero row that should be one": QuadraticProgram(
            np.eye(3), np.ones(3), np.zeros((1, 3)), [1.0], [1.0]
        ),
        "three equalities in two variables": QuadraticProgram(
            eye, [0.0, 0.0], rows, sides, sides
        ),
    }


def _solve(
    solver: QPSolver, name: str, problem: QuadraticProgram, warm_start: Any
) -> QPSolution:
    """Solves, and raises where the solver changed its arguments."""
    before = {field: getattr(problem, field).copy() for field in _FIELDS}
    guess = warm_start.copy() if isinstance(warm_start, np.ndarray) else None
    solution = solver.solve(problem, warm_start)
    for field, array in before.items():
        require(
            np.array_equal(array, getattr(problem, field)),
            name,
            f"the solver modified {field}",
        )
    require(
        guess is None or np.array_equal(guess, warm_start),
        name,
        "the solver modified the warm start",
    )
    return solution


def _awkward(problem: QuadraticProgram) -> QuadraticProgram:
    """Copies a problem into every other element of larger arrays.

    P is copied into Fortran order.
    """

    def strided(array: np.ndarray) -> np.ndarray:
        return np.repeat(array, 2, axis=-1)[..., ::2]

    return QuadraticProgram(
        np.asfortranarray(problem.P),
        *(strided(getattr(problem, field)) for field in _FIELDS[1:]),
    )


def _check(solution: QPSolution, known: _Known, tolerance: float) -> None:
    require(
        solution.status is Status.SOLVED,
        known.name,
        f"expected SOLVED, got {solution.status.name}",
    )
    parts = {"x": (solution.x, known.x)}
    if known.multipliers is not None:
        parts["[z_box; z]"] = (
            np.concatenate([solution.z_box, solution.z]),
            known.multipliers,
        )
    for name, (got, expected) in parts.items():
        error = np.abs(got - expected).max() / max(1.0, np.abs(expected).max())
        require(
            error <= tolerance, known.name, f"{name} is {got}, should be {expected}"
        )
    for kind, value in solution.residuals()._asdict().items():
        require(
            value <= tolerance,
            known.name,
            f"the {kind} residual is {value:.1e}, above {tolerance:.1e}",
        )
