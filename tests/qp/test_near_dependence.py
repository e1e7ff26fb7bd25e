"""Rows that are all but dependent, bounds that contradict each other by a hair.

``SOLVED`` is to be true there too.
"""

from fractions import Fraction

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet, PrimalActiveSet, QuadraticProgram, make_solution
from gpmpc.qp._dual_rescue import _AccurateSolver, polish, rescue
from gpmpc.qp._dual_rescue import _add as add_to_pair
from gpmpc.qp._record import (
    HEADER,
    INFEASIBLE,
    ITERATION_LIMIT,
    SOLVED,
    STATUS,
    warm_record,
)
from gpmpc.qp._solution import proves_infeasibility
from gpmpc.status import Status
from tests.qp.problems import feasible_problem


def near_dependent_problem(rng, feasible=True):
    """Rows that repeat a few others up to 2^-10 .. 2^-50, with bounds met by a point.

    Or missed by a hair.
    """
    n = int(rng.integers(2, 10))
    m = int(rng.integers(4, 20))
    root = rng.integers(-16, 17, (n, n)) / 8.0
    base = rng.integers(-16, 17, (max(1, m // 4), n)) / 8.0
    G = base[rng.integers(0, len(base), m)] * np.exp2(rng.integers(-3, 4, m))[:, None]
    G += (
        2.0 ** -int(rng.integers(10, 50))
        * rng.integers(-3, 4, (m, n))
        * (rng.random((m, 1)) < 0.5)
    )
    P = root @ root.T + 10.0 ** rng.integers(-6, 3) * np.eye(n)
    q = rng.integers(-160, 161, n) / 16.0
    values = np.vstack([np.eye(n), G]) @ (rng.integers(-32, 33, n) / 16.0)
    lower = values - rng.integers(0, 3, n + m)
    upper = values + rng.integers(0, 3, n + m)
    if not feasible:
        G[1], lower[n], upper[n], upper[n + 1] = -G[0], -np.inf, values[n], np.inf
        lower[n + 1] = -values[n] + 10.0 ** rng.uniform(-13, -5)
    lower[rng.random(n + m) < 0.3] = -np.inf
    return QuadraticProgram.from_stacked(P, q, G, lower, upper)


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("feasible", [True, False])
@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_solved_means_optimal_and_infeasible_means_infeasible(
    mode, feasible, soft, rng
):
    solver = DualActiveSet()
    solved = 0
    for _ in range(250):
        problem = near_dependent_problem(rng, feasible)
        prices = 10.0 ** rng.uniform(-3, 10, len(problem.G))
        charged = prices if soft else None
        if mode == "prepared":
            prepared = solver.prepare(problem.P, problem.G, charged)
            solution = prepared.solve(problem.q, problem.lower, problem.upper)
        else:
            solution = solver.solve(problem, None, charged)
        if solution.status is Status.SOLVED:
            assert solution.is_optimal(1e-9), solution.residuals()
            assert np.isfinite(solution.x).all()
            solved += 1
        elif feasible:
            assert solution.status is not Status.INFEASIBLE
    assert solved > (200 if feasible or soft else 20)


@pytest.mark.parametrize("seed", [7, 66])
def test_the_primal_method_keeps_what_doubled_digits_lose(seed):
    problem = near_dependent_problem(np.random.default_rng(seed))
    solution = PrimalActiveSet().solve(problem)
    assert solution.status is Status.SOLVED
    assert solution.is_optimal(1e-9)


def test_doubled_digits_replace_no_better_solution():
    """They begin without its working set, and end after a few changes."""
    problem = feasible_problem(np.random.default_rng(5), 60, 120)
    solution = DualActiveSet().solve(problem)
    guessless = make_solution(
        problem,
        Status.SOLVED,
        solution.x,
        solution.multipliers,
        active_set=np.zeros(180),
    )
    polished = polish(guessless, tolerance=1e3)
    assert max(polished.residuals()) <= max(solution.residuals())


@pytest.mark.parametrize("seed", [7, 66, 226])
def test_where_doubled_digits_fail_the_iterate_before_stays(seed):
    problem = near_dependent_problem(np.random.default_rng(seed))
    solution = DualActiveSet().solve(problem)
    assert solution.status is Status.NUMERICAL_TROUBLE
    assert solution.residuals().dual < 1e-12


def test_doubled_digits_put_a_multiplier_on_its_cap(rng):
    """An equality goes from one cap to the other in two steps.

    The second row comes to its price between them.
    """
    problem = QuadraticProgram([[1]], [10], [[1], [0.3]], [2, 9], [2, np.inf])
    guess = warm_record(np.array([0, -1, 0]), 1)
    for price, step in rng.uniform([1.1, 0.0], [1.2, 0.1], (20, 2)):
        prices = [price, (40.0 - price + step) / 0.3]
        record = rescue(problem, np.append(np.inf, prices), guess)
        assert record[STATUS] == SOLVED
        np.testing.assert_array_equal(np.abs(record[HEADER + 2 :][:2]), prices)


def test_doubled_digits_take_no_more_rows_than_variables():
    """However little of a row counts as a distance from the others."""
    problem = QuadraticProgram(
        np.eye(2), [-9, -9], [[3, 1], [1, 7], [-1, -1 / 3]], h_upper=[1, 1, -1]
    )
    solver = _AccurateSolver(problem, np.full(5, np.inf), 0.0, lambda: False)
    assert solver.run(np.zeros(0), 20) == INFEASIBLE


def test_a_multiplier_towards_a_contradiction_is_reset(rng):
    """A multiplier of 2.6e10 was handed out with a row that missed others by 1e-9."""
    for _ in range(500):
        solution = DualActiveSet().solve(near_dependent_problem(rng))
        working = solution.active_set != 0
        assert (
            solution.multipliers[~working] == 0.0
        ).all() or not solution.status.solved


@pytest.mark.parametrize("where", [slice(None), [0, 1]])
def test_a_sum_of_two_floats_keeps_what_the_first_rounds_off(where):
    total = np.zeros((2, 2))
    changes = [[-4.0, 5e-16], [8.9e-16, -3e-17], [2.0**-80, 1e-33]]
    for change in changes:  # each smaller than what is there, as Newton's are
        add_to_pair(total, where, np.array(change))
    for pair, terms in zip(total.T, np.transpose(changes), strict=True):
        high, low = (Fraction(float(part)) for part in pair)
        exact = sum(Fraction(float(term)) for term in terms)
        assert high == Fraction(float(high + low))  # the second is its rounding
        assert abs(high + low - exact) <= abs(exact) * Fraction(2) ** -100


def test_a_limit_met_in_the_second_try_is_the_end(monkeypatch):
    def rescue(problem, caps, record, limit, late):
        assert record[STATUS] != ITERATION_LIMIT
        ends.append(int(record[STATUS]))
        return record

    monkeypatch.setattr("gpmpc.qp._dual_active_set.rescue", rescue)
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(400):
        problem = near_dependent_problem(rng, feasible=False)
        for limit in (3, 6):
            DualActiveSet(iteration_limit=limit).solve(problem)
    assert ends


@pytest.mark.parametrize("seed", [175, 353, 361])
def test_a_second_try_goes_on_after_a_look_at_the_clock(seed, monkeypatch):
    def rescue(problem, caps, record, limit, late):
        assert record[STATUS] != ITERATION_LIMIT
        return record

    monkeypatch.setattr("gpmpc.qp._dual_active_set.rescue", rescue)
    problem = near_dependent_problem(np.random.default_rng(seed), feasible=False)
    DualActiveSet(time_limit=60.0).solve(problem)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_a_ray_proves_what_it_contradicts_and_nothing_else(scale):
    """x + y <= 1 and x + y >= 2: the sum with weights 1 and -1 is 0 <= -1."""
    G = np.ones((2, 2))
    wide = np.full(2, np.inf)
    lower = np.append(-wide, [-np.inf, 2.0])
    upper = np.append(wide, [1.0, np.inf])

    def proves(ray, low=lower, high=upper):
        return proves_infeasibility(scale * np.array(ray), G, low, high)

    assert proves([0, 0, 1, -1])
    of_priced_row = (scale * np.array([0, 0, 1, -1]), G, lower, upper)
    assert not proves_infeasibility(*of_priced_row, caps=np.append(wide, [0.5, 9.0]))
    assert not proves([0, 0, -1, 1])  # of bounds that are absent
    assert not proves([0, 0, 1, -0.5])  # what is left moves a variable without bound
    assert not proves([0, 0, 0, 0])
    assert not proves([0, 0, np.nan, 0])
    assert not proves([0, 0, 1, -1], high=np.append(wide, [2.0, np.inf]))  # they touch
    boxed = (
        np.append(-np.full(2, 0.1), [-np.inf, 2.0]),
        np.append(np.full(2, 0.1), [1.0, np.inf]),
    )
    assert proves([0, 0, 0, -1], *boxed)  # the box carries what is left: x + y <= 0.2
    assert proves([1, 1, 0, -1], *boxed)
    assert not proves([0, 0, 1, 0], *boxed)
    assert (
        not DualActiveSet()
        .solve(QuadraticProgram.from_stacked(np.eye(2), np.zeros(2), G, *boxed))
        .status.solved
    )
