"""Soft rows against the same problem written out with slack variables."""

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet, PrimalActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.qp.problems import feasible_problem, start_of_x, worst_residual


def prepared(problem, prices, warm_start=None):
    prepared = DualActiveSet().prepare(problem.P, problem.G, prices)
    return prepared.solve(problem.q, problem.lower, problem.upper, warm_start)


def changing(problem, prices, warm_start=None):
    return DualActiveSet().solve(problem, warm_start, prices)


DUAL = pytest.mark.parametrize("solve", [prepared, changing])


def with_slacks(problem, prices, curvature=1e-6):
    """The problem in (x, v+, v-).

    G x - v+ + v- within bounds, v >= 0, at the prices.
    """
    n = len(problem.q)
    m = len(problem.h_lower)
    hard = np.isinf(prices)
    linear = np.where(hard, 0.0, prices)
    P = curvature * np.eye(n + 2 * m)
    P[:n, :n] = problem.P
    return QuadraticProgram(
        P,
        np.concatenate([problem.q, linear, linear]),
        np.hstack([problem.G, -np.eye(m), np.eye(m)]),
        problem.h_lower,
        problem.h_upper,
        np.concatenate([problem.lb, np.zeros(2 * m)]),
        np.concatenate([problem.ub, np.tile(np.where(hard, 0.0, np.inf), 2)]),
    )


def conflicting_problem(rng, n, m):
    """Rows that ask for more than the box allows, so that some must be violated."""
    problem = feasible_problem(rng, n, m)
    shift = rng.uniform(-3.0, 3.0, m)
    return QuadraticProgram(
        problem.P,
        problem.q,
        problem.G,
        problem.h_lower + shift,
        problem.h_upper + shift,
        problem.lb,
        problem.ub,
    )


@DUAL
@pytest.mark.parametrize("hard", [0, 2])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (4, 6), (10, 25)])
def test_soft_rows_solve_the_problem_written_out_with_slacks(solve, hard, n, m, rng):
    violated = 0
    for _ in range(10):
        problem = conflicting_problem(rng, n, m)
        prices = 10.0 ** rng.uniform(-1.0, 2.0, m)
        prices[: hard if m > 1 else 0] = np.inf
        solution = solve(problem, prices)
        if (
            solve(problem, np.where(np.isinf(prices), np.inf, 1e-9)).status
            is Status.INFEASIBLE
        ):
            assert solution.status is Status.INFEASIBLE
            continue
        assert solution.status is Status.SOLVED
        assert worst_residual(solution) < 1e-9
        written_out = PrimalActiveSet(tolerance=1e-7).solve(
            with_slacks(problem, prices)
        )
        np.testing.assert_allclose(solution.x, written_out.x[:n], atol=2e-5)
        violated += int((solution.violation()[n:] > 1e-6).sum())
        again = solve(problem, prices, solution)
        np.testing.assert_allclose(again.x, solution.x, atol=1e-9)
        assert again.iterations == 0
    assert violated > 0


@DUAL
def test_a_large_exact_penalty_leaves_feasible_problems_alone(solve, rng):
    problem = feasible_problem(rng, 6, 9)
    hard = changing(problem, None)
    assert np.abs(hard.z).max() > 0.1
    exact = solve(problem, np.full(9, 1.01 * np.abs(hard.z).max()))
    np.testing.assert_allclose(exact.x, hard.x, atol=1e-10)
    cheap = solve(problem, np.full(9, 0.5 * np.abs(hard.z).max()))
    assert cheap.violation().max() > 1e-6


@DUAL
def test_rows_of_infinite_price_are_hard(solve, rng):
    problem = feasible_problem(rng, 6, 9)
    np.testing.assert_allclose(
        solve(problem, np.full(9, np.inf)).x, solve(problem, None).x, atol=1e-10
    )


@DUAL
def test_contradictory_rows_have_a_solution_once_soft(solve):
    G = np.array([[1.0, 1.0], [1.0, 1.0]])
    problem = QuadraticProgram(np.eye(2), np.zeros(2), G, [2.0, -np.inf], [np.inf, 1.0])
    assert DualActiveSet().solve(problem).status is Status.INFEASIBLE
    solution = solve(problem, [5.0, 3.0])
    np.testing.assert_allclose(solution.x, [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(solution.z, [-4.0, 3.0], atol=1e-12)


@DUAL
def test_a_hard_box_stays_hard_however_dear_the_soft_rows(solve):
    problem = QuadraticProgram(
        np.eye(1), [0.0], [[1.0]], [5.0], [np.inf], [-1.0], [1.0]
    )
    solution = solve(problem, [1e6])
    assert solution.status is Status.SOLVED
    assert solution.x[0] == pytest.approx(1.0, abs=1e-12)


@DUAL
def test_a_sequence_of_soft_problems_is_the_same_warm_and_cold(solve, rng):
    n = 8
    m = 20
    problem = conflicting_problem(rng, n, m)
    prices = 10.0 ** rng.uniform(-1.0, 1.0, m)
    last = None
    at_caps = 0
    for _ in range(60):
        shift = rng.uniform(-2.0, 2.0, m)
        turn = rng.standard_normal(n)
        following = QuadraticProgram(
            problem.P,
            problem.q + 3.0 * turn,
            problem.G,
            problem.h_lower + shift,
            problem.h_upper + shift,
            problem.lb,
            problem.ub,
        )
        last = solve(following, prices, last)
        cold = solve(following, prices)
        assert last.status is cold.status is Status.SOLVED
        assert worst_residual(last) < 1e-9
        np.testing.assert_allclose(last.x, cold.x, atol=1e-9)
        at_caps += int((np.abs(last.z) == prices).sum())
    assert at_caps > 0


@DUAL
def test_a_record_that_was_cut_off_is_not_read_beyond_its_end(solve, rng):
    """What lies behind it in memory says which rows stay violated."""
    problem = conflicting_problem(rng, 4, 12)
    cold = solve(problem, np.full(12, 0.1))
    assert (np.abs(cold.z) == 0.1).any()
    cut_off = cold._replace(record=cold.record[: start_of_x(cold) + 4])
    again = solve(problem, np.full(12, 0.1), cut_off)
    assert again.iterations == cold.iterations


@DUAL
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("price", [0.5, 40.0])
def test_a_multiplier_above_its_rows_price_is_a_dual_residual(solve, side, price):
    """min 1/2 x^2 with the row |x| >= 100 at the price w a unit.

    X = w. At any other x the multiplier is no price.
    """
    bounds = ([100.0], [np.inf]) if side > 0 else ([-np.inf], [-100.0])
    solution = solve(QuadraticProgram(np.eye(1), [0.0], [[1.0]], *bounds), [price])
    assert solution.x[0] == pytest.approx(side * price)
    assert solution.is_optimal()
    solution.x[:] *= (
        1.5  # still stationary, P x + G'z = 0, and the violation is still paid for
    )
    solution.z[:] *= 1.5
    assert solution.residuals().primal == 0
    assert (
        solution.residuals().dual > 0.1
    )  # half the price, whatever it is held against
    assert not solution.is_optimal(0.1)


def test_prices_that_change_and_return_leave_nothing_behind(rng):
    problem = conflicting_problem(rng, 6, 8)
    other = conflicting_problem(rng, 6, 8)
    solver = DualActiveSet()
    low, high = np.full(8, 0.1), np.full(8, 5.0)
    solutions = [
        (asked, prices, solver.solve(asked, prices=prices))
        for prices in (low, low, high, low, None, high)
        for asked in (problem, other)
    ]
    for asked, prices, solution in solutions:
        alone = DualActiveSet().solve(asked, prices=prices)
        np.testing.assert_array_equal(solution.x, alone.x)
        np.testing.assert_array_equal(solution.caps, alone.caps)
    below, above = solutions[0][2], solutions[4][2]
    assert np.abs(below.z).max() <= 0.1 < np.abs(above.z).max()
