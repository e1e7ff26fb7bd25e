from time import sleep

import cvxpy
import numpy as np
import pytest

from gpmpc.exceptions import ProblemError
from gpmpc.qp import CvxpySolver, DualActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.qp.problems import distance, feasible_problem


def test_an_unknown_solver_is_refused_with_those_installed():
    with pytest.raises(
        ProblemError, match=r"no solver named 'GUROBIX'; it finds .*CLARABEL"
    ):
        CvxpySolver("GUROBIX")


@pytest.mark.parametrize("name", ["CLARABEL", "DAQP", "OSQP"])
def test_solvers_of_cvxpy_find_our_minimiser_and_multipliers(name, rng):
    options = (
        {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100000}
        if name == "OSQP"
        else None
    )
    solver = CvxpySolver(name, options)
    for n, m in ((3, 0), (4, 6), (12, 20)):
        problem = feasible_problem(rng, n, m)
        ours = DualActiveSet().solve(problem)
        theirs = solver.solve(problem)
        assert theirs.status is Status.SOLVED
        assert distance(problem, ours.x, theirs.x) < 1e-6
        np.testing.assert_allclose(theirs.multipliers, ours.multipliers, atol=1e-4)


@pytest.fixture
def compiled(monkeypatch):
    """The problems that are compiled from now on."""
    make = cvxpy.Problem
    problems = []

    def watched(*arguments):
        problems.append(make(*arguments))
        return problems[-1]

    monkeypatch.setattr(cvxpy, "Problem", watched)
    return problems


def test_a_problem_of_the_same_shape_is_not_compiled_again(rng, compiled):
    solver = CvxpySolver()
    first = solver.solve(feasible_problem(rng, 7, 11))
    second_problem = feasible_problem(rng, 7, 11)
    second = solver.solve(second_problem, first)
    assert second.is_optimal(1e-6)
    assert len(compiled) == 1
    np.testing.assert_allclose(
        second.x, DualActiveSet().solve(second_problem).x, atol=1e-6
    )


def test_the_store_of_compiled_problems_stays_small(compiled):
    solver = CvxpySolver()

    def solve(n):
        problem = QuadraticProgram(np.eye(n), np.ones(n), lb=np.zeros(n))
        assert solver.solve(problem).status.solved

    for n in range(1, 70):
        solve(n)
    compiled.clear()
    for n in range(69, 5, -1):  # the last 64
        solve(n)
    assert not compiled
    for n in (1, 2):
        solve(n)
    assert len(compiled) == 2


def test_an_answer_with_large_residuals_is_not_called_solved(rng):
    sloppy = CvxpySolver("OSQP", {"eps_abs": 1e-1, "eps_rel": 1e-1, "max_iter": 100000})
    problem = feasible_problem(rng, 10, 15)
    solution = sloppy.solve(problem)
    assert not solution.is_optimal(1e-6)
    assert solution.status is Status.NUMERICAL_TROUBLE


def test_an_answer_in_doubled_digits_counts_where_it_is_better():
    """They stop after a few changes, far from where the solver was."""
    problem = feasible_problem(np.random.default_rng(5), 60, 120)
    solution = CvxpySolver("OSQP").solve(problem)
    assert solution.status is Status.NUMERICAL_TROUBLE
    assert max(solution.residuals()) < 1e-4


@pytest.mark.parametrize("options", [None, {}])
def test_a_bound_is_kept_however_far_the_free_minimiser_is(options):
    """x <= 1e-6, from 1e6 without it."""
    problem = QuadraticProgram([[1.0]], [-1e6], [[1.0]], h_upper=[1e-6])
    solution = CvxpySolver("CLARABEL", options).solve(problem)
    assert solution.status.solved is solution.is_optimal(1e-6)
    assert solution.status.solved is (options is None)


def test_doubled_digits_count_in_the_time_of_a_solve(monkeypatch):
    def polish(solution, tolerance):
        sleep(0.2)
        return solution

    monkeypatch.setattr("gpmpc.qp._cvxpy.polish", polish)
    problem = QuadraticProgram([[1.0]], [-1e6], [[1.0]], h_upper=[1e-6])
    assert CvxpySolver("OSQP").solve(problem).solve_seconds > 0.2


def test_an_iteration_limit_is_translated(rng):
    solution = CvxpySolver("CLARABEL", {"max_iter": 2}).solve(
        feasible_problem(rng, 10, 15)
    )
    assert solution.status is Status.ITERATION_LIMIT


def test_a_minimiser_far_from_zero_costs_no_digits(rng):
    """The thrust that carries the vehicle makes x'Px huge.

    What is to be found is a small change of it.
    """
    for _ in range(20):
        basis = np.linalg.qr(rng.normal(size=(30, 30)))[0]
        P = (basis * np.geomspace(4.0, 2e5, 30)) @ basis.T
        P = (P + P.T) / 2
        centre = np.tile([7.0, 0.0, 0.0], 10)
        q = -P @ (centre + rng.normal(scale=0.1, size=30))
        problem = QuadraticProgram(P, q, lb=centre - 0.1, ub=centre + 0.1)
        ours = DualActiveSet().solve(problem)
        np.testing.assert_allclose(CvxpySolver().solve(problem).x, ours.x, atol=1e-8)
