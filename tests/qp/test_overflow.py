"""Numbers beyond the range of float64 end in a status, not in an exception."""

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet, PrimalActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.qp.problems import solve_stacked

FREE = np.full(3, np.inf)
PROBLEMS = {  # the minimum is at -P^-1 q, which float64 cannot hold
    "everywhere": (1e-160 * np.eye(3), np.full(3, 1e160)),
    "in one variable": (np.diag([1e-155, 1.0, 1.0]), np.array([1e155, 1.0, 1.0])),
    "in the last of many": (
        np.diag([*np.ones(12), 1e-155]),
        np.array([*np.ones(12), 1e155]),
    ),
}


def solve_in(mode, P, q, G, lower, upper):
    if mode == "prepared":
        return DualActiveSet().prepare(P, G).solve(q, lower, upper)
    if mode == "changing":
        return solve_stacked(P, q, G, lower, upper)
    return PrimalActiveSet().solve(QuadraticProgram.from_stacked(P, q, G, lower, upper))


@pytest.mark.parametrize("mode", ["prepared", "changing", "primal"])
@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("rows", [0, 2])
def test_a_non_finite_minimiser_is_never_called_a_solution(mode, name, rows):
    P, q = PROBLEMS[name]
    G = np.eye(rows, len(q))
    free = np.full(len(q) + rows, np.inf)
    solution = solve_in(mode, P, q, G, -free, free)
    assert solution.status is Status.NUMERICAL_TROUBLE


@pytest.mark.parametrize("mode", ["prepared", "changing"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_bounds_that_keep_it_finite_give_the_solution(mode, name):
    P, q = PROBLEMS[name]
    bound = np.ones(len(q))
    solution = solve_in(mode, P, q, np.zeros((0, len(q))), -bound, bound)
    assert solution.status.solved
    np.testing.assert_allclose(solution.x, -bound)
    assert solution.is_optimal(1e-9)


@pytest.mark.parametrize("size", [1, 3, 4, 5, 8, 9, 13])
@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_one_overflowing_entry_is_seen_wherever_it_stands(size, mode):
    for place in range(size):
        P = np.ones(size)
        q = np.ones(size)
        P[place] = 1e-155
        q[place] = -1e155
        free = np.full(size, np.inf)
        solution = solve_in(mode, np.diag(P), q, np.zeros((0, size)), -free, free)
        assert solution.status is Status.NUMERICAL_TROUBLE


def test_a_refused_problem_is_not_answered_from_stale_memory(monkeypatch):
    """A row whose norm overflows; zeros in memory read as SOLVED, with x = 0."""
    monkeypatch.setattr(np, "empty", np.zeros)
    rows = np.full((1, 3), 2e300)
    solution = solve_in(
        "changing",
        np.eye(3),
        np.ones(3),
        rows,
        np.full(4, -np.inf),
        np.array([*np.full(3, np.inf), -1.0]),
    )
    assert solution.is_optimal(1e-9) or not solution.status.solved


@pytest.mark.parametrize(("size", "bound"), [(1e300, -1.0), (1e-170, -1e-170)])
@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_a_row_whose_squares_overflow_is_not_satisfied(mode, size, bound):
    q = np.array([1.0, -2.0, 1.0])
    upper = np.array([np.inf, np.inf, np.inf, bound])
    row = size * np.array([[1.0, 2.0, 0.0]])
    solution = solve_in(mode, np.eye(3), q, row, np.full(4, -np.inf), upper)
    assert solution.is_optimal(1e-9) or not solution.status.solved


def test_a_bound_that_overflows_in_doubled_digits_is_not_absent():
    problem = QuadraticProgram([[1.0]], [0.0], [[1e-300]], h_lower=[1e19])
    assert DualActiveSet().solve(problem).status is Status.NUMERICAL_TROUBLE
    problem = QuadraticProgram([[1.0]], [0.0], [[1e-300]], h_lower=[1.0])
    solution = DualActiveSet().solve(problem, prices=[1e10])
    assert solution.is_optimal(1e-9) or not solution.status.solved


@pytest.mark.parametrize("unit", [1e-14, 1e-150, 1e14])
@pytest.mark.parametrize("bound", [0.5, -0.5])
def test_the_primal_method_has_no_units_of_its_own(unit, bound):
    """The number of changes is more than doubled digits would make."""
    n = 30
    upper = np.full(n, bound * unit)
    upper[0] = 1e3 * unit
    problem = QuadraticProgram(
        np.eye(n) / unit**2,
        np.full(n, -1.0 / unit),
        [np.ones(n)],
        [-n * unit],
        ub=upper,
    )
    solution = PrimalActiveSet().solve(problem)
    assert solution.status is Status.SOLVED
    assert solution.is_optimal(1e-12)
    np.testing.assert_allclose(solution.x, np.minimum(unit, upper), rtol=1e-12)


def test_soft_rows_do_not_hide_it():
    P, q = PROBLEMS["in one variable"]
    free = np.append(FREE, 1.0)
    solution = solve_stacked(
        P, q, np.array([[0.0, 1.0, 0.0]]), -free, free, prices=[1.0]
    )
    assert solution.status is Status.NUMERICAL_TROUBLE


def test_residuals_that_are_undefined_do_not_bear_a_solution_out():
    solution = solve_stacked(
        np.eye(2), np.ones(2), np.zeros((0, 2)), -np.ones(2), np.ones(2)
    )
    assert solution.is_optimal()
    for value in (np.nan, np.inf):
        x = np.array([value, -1.0])
        with np.errstate(invalid="ignore"):
            assert not solution._replace(x=x).is_optimal()
