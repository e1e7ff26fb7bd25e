"""Any warm start, right or absurd, gives the same answer.

The right one gives it at once.
"""

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet
from gpmpc.status import Status
from tests.qp.problems import (
    changing,
    feasible_problem,
    integer_problem,
    prepared,
    primal,
    solve_stacked,
    start_of_x,
    worst_residual,
)

ALL = pytest.mark.parametrize("solve", [prepared, changing, primal])
DUAL = pytest.mark.parametrize("solve", [prepared, changing])


@ALL
@pytest.mark.parametrize(("n", "m"), [(1, 1), (5, 8), (20, 30)])
def test_the_answer_does_not_depend_on_the_warm_start(solve, n, m, rng):
    problem = feasible_problem(rng, n, m)
    cold = solve(problem)
    M = n + m
    other = solve(feasible_problem(rng, n, m))
    elsewhere = solve(feasible_problem(rng, n + 1, m))
    for guess in (
        cold,
        other,
        elsewhere,
        np.ones(M),
        -np.ones(M),
        *rng.integers(-1, 2, (5, M)),
    ):
        warm = solve(problem, guess)
        assert warm.status is Status.SOLVED
        assert worst_residual(warm) < 1e-9
        np.testing.assert_allclose(
            warm.x, cold.x, atol=1e-9 * max(1.0, np.abs(cold.x).max())
        )


@DUAL
def test_the_right_guess_needs_no_iteration(solve, rng):
    problem = feasible_problem(rng, 15, 20)
    cold = solve(problem)
    assert cold.iterations > 0
    assert solve(problem, cold).iterations == 0
    assert solve(problem, cold.active_set).iterations == 0


@DUAL
def test_a_record_full_of_nonsense_is_a_harmless_warm_start(solve, rng):
    problem = feasible_problem(rng, 6, 8)
    cold = solve(problem)
    for filling in (np.nan, np.inf, -np.inf, 1e300, -7.5, 0.0, 3.0):
        for count in (0.0, 3.0, 14.0, np.nan, -1.0, 1e9):
            for position in range(start_of_x(cold)):
                record = np.full_like(cold.record, filling)
                record[position] = count
                again = solve(problem, cold._replace(record=record))
                np.testing.assert_allclose(again.x, cold.x, atol=1e-10)


@ALL
def test_the_same_question_gets_the_same_bits(solve, rng):
    for _ in range(20):
        problem = integer_problem(rng)
        guess = rng.integers(-1, 2, len(problem.lower))
        first = solve(problem, guess)
        second = solve(problem, guess)
        assert first.status is second.status
        np.testing.assert_array_equal(first.x, second.x)
        np.testing.assert_array_equal(first.multipliers, second.multipliers)


def test_memory_layout_and_integers_give_the_same_bits(rng):
    problem = feasible_problem(rng, 6, 9)
    P = problem.P
    q = np.round(problem.q)
    G = problem.G
    lower = problem.lower
    upper = problem.upper

    def strided(array):
        return np.repeat(array, 3, axis=-1)[..., ::3]

    def frozen(array):
        array = array.copy()
        array.flags.writeable = False
        return array

    prepared = DualActiveSet().prepare(P, G)
    expected = prepared.solve(q, lower, upper)
    expected_lazy = solve_stacked(P, q, G, lower, upper)
    for change in (strided, np.asfortranarray, frozen):
        arrays = [change(array) for array in (P, q, G, lower, upper)]
        copies = [array.copy() for array in arrays]
        again = (
            DualActiveSet()
            .prepare(arrays[0], arrays[2])
            .solve(arrays[1], arrays[3], arrays[4])
        )
        np.testing.assert_array_equal(again.x, expected.x)
        again = solve_stacked(*arrays)
        np.testing.assert_array_equal(again.x, expected_lazy.x)
        for array, copy in zip(arrays, copies, strict=True):
            np.testing.assert_array_equal(array, copy)
    np.testing.assert_array_equal(
        prepared.solve(q.astype(int), lower.tolist(), upper).x, expected.x
    )
    np.testing.assert_array_equal(
        prepared.solve(q, lower, upper, expected).x,
        prepared.solve(q, lower, upper, expected).x,
    )


@DUAL
def test_a_solution_is_a_copy_that_later_solves_leave_alone(solve, rng):
    problem = feasible_problem(rng, 5, 5)
    first = solve(problem)
    first_x = first.x.copy()
    solve(feasible_problem(rng, 5, 5), first)
    np.testing.assert_array_equal(first.x, first_x)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (6, 9), (20, 40)])
def test_a_used_prepared_program_gives_the_bits_of_a_new_one(n, m, rng):
    """The factor of the working set comes with the guess, not from solver memory."""
    problem = feasible_problem(rng, n, m)
    used = DualActiveSet().prepare(problem.P, problem.G)
    last = None
    changes = 0
    for k in range(60):
        q = problem.q + (0.0 if k % 3 == 0 else 2.0) * rng.standard_normal(n)
        guess = rng.integers(-1, 2, n + m) if k % 7 == 6 else last
        new = (
            DualActiveSet()
            .prepare(problem.P, problem.G)
            .solve(q, problem.lower, problem.upper, guess)
        )
        last = used.solve(q, problem.lower, problem.upper, guess)
        assert last.status is new.status is Status.SOLVED
        np.testing.assert_array_equal(last.x, new.x)
        np.testing.assert_array_equal(last.multipliers, new.multipliers)
        changes += last.iterations > 0
    assert changes > 0
