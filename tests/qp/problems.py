"""Random quadratic programs for the tests.

Degenerate by integers, ill-conditioned, badly scaled.
"""

import numpy as np

from gpmpc.qp import DualActiveSet, PrimalActiveSet, QuadraticProgram


def integer_problem(
    rng: np.random.Generator, feasible: bool | None = None
) -> QuadraticProgram:
    """Small integers everywhere.

    Ties, repeated rows, vertices met by too many constraints.

    With ``feasible=True`` the bounds admit an integer point, on which many of them hold
    with equality.
    """
    n = int(rng.integers(1, 9))
    m = int(rng.integers(0, 15))
    root = rng.integers(-2, 3, (n, n))
    P = (root.T @ root + np.eye(n)).astype(float)
    q = rng.integers(-5, 6, n).astype(float)
    G = rng.integers(-2, 3, (m, n)).astype(float)
    if m > 2 and rng.random() < 0.5:
        G[0], G[2] = G[1], 2.0 * G[1]
    C = np.vstack([np.eye(n), G])
    anchor = C @ rng.integers(-2, 3, n) if feasible else rng.integers(-3, 4, n + m)
    lower = anchor - rng.integers(0, 3, n + m)
    upper = anchor + rng.integers(0, 3, n + m)
    lower = np.where(rng.random(n + m) < 0.4, -np.inf, lower)
    upper = np.where(rng.random(n + m) < 0.4, np.inf, upper)
    return QuadraticProgram.from_stacked(P, q, G, lower, upper)


def feasible_problem(
    rng: np.random.Generator, n: int, m: int, condition: float = 1e2
) -> QuadraticProgram:
    """A feasible problem whose Hessian has eigenvalues spread over ``condition``.

    About half of the bounds matter.
    """
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    eigenvalues = np.geomspace(1.0, condition, n) if n > 1 else np.ones(1)
    P = basis @ np.diag(eigenvalues) @ basis.T
    P = 0.5 * (P + P.T)
    G = rng.standard_normal((m, n))
    C = np.vstack([np.eye(n), G])
    inside = C @ rng.standard_normal(n)
    q = -P @ (3.0 * rng.standard_normal(n))
    lower = inside - rng.uniform(0.0, 2.0, n + m)
    upper = inside + rng.uniform(0.0, 2.0, n + m)
    return QuadraticProgram.from_stacked(P, q, G, lower, upper)


def stacked_rows(problem: QuadraticProgram) -> np.ndarray:
    """C = [I; G]."""
    return np.vstack([np.eye(len(problem.q)), problem.G])


def worst_residual(solution) -> float:
    """The largest of the three scaled KKT residuals."""
    return max(solution.residuals())


def distance(problem: QuadraticProgram, x: np.ndarray, other: np.ndarray) -> float:
    """The P-norm of the difference, relative to that of x (at least 1)."""
    size = np.sqrt(max(1.0, x @ problem.P @ x))
    return float(np.sqrt((x - other) @ problem.P @ (x - other)) / size)


def prepared(problem, warm_start=None):
    return (
        DualActiveSet()
        .prepare(problem.P, problem.G)
        .solve(problem.q, problem.lower, problem.upper, warm_start)
    )


def changing(problem, warm_start=None):
    return DualActiveSet().solve(problem, warm_start)


def primal(problem, warm_start=None):
    return PrimalActiveSet().solve(problem, warm_start)


def solve_stacked(P, q, G, lower, upper, warm_start=None, prices=None):
    """The solution of arrays that nobody has checked."""
    return DualActiveSet().solve(
        QuadraticProgram.unchecked(P, q, G, lower, upper), warm_start, prices
    )


def start_of_x(solution):
    """Where x, which is a view of a solution's record, begins in it."""
    record_address = solution.record.__array_interface__["data"][0]
    x_address = solution.x.__array_interface__["data"][0]
    return (x_address - record_address) // solution.record.itemsize
