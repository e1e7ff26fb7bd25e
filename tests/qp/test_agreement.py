"""Our solvers, DAQP and Clarabel agree on problems made to be awkward."""

import daqp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpmpc.qp import CvxpySolver, PrimalActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.qp.problems import (
    changing,
    distance,
    feasible_problem,
    integer_problem,
    prepared,
    worst_residual,
)

# -6: infeasible by its presolve of equal or crossed bounds
DAQP_SOLVED = (1, 2)
DAQP_INFEASIBLE = (-1, -6)


def daqp_solution(problem: QuadraticProgram):
    """(x, solved or not) from DAQP, which reads only contiguous arrays rightly."""
    lower = np.maximum(problem.lower, -1e30)
    upper = np.minimum(problem.upper, 1e30)
    x, _, flag, _ = daqp.solve(
        problem.P.copy(),
        problem.q.copy(),
        problem.G.copy(),
        upper,
        lower,
        np.zeros(len(lower), dtype=np.int32),
        primal_tol=1e-9,
    )
    assert flag in DAQP_SOLVED + DAQP_INFEASIBLE
    return x, flag in DAQP_SOLVED


@pytest.mark.parametrize("feasible", [True, None])
@pytest.mark.parametrize("block", range(4))
def test_daqp_agrees_on_feasible_and_infeasible_integers(block, feasible):
    rng = np.random.default_rng([block, bool(feasible)])
    outcomes = set()
    for _ in range(600):
        problem = integer_problem(rng, feasible)
        guess = rng.integers(-1, 2, len(problem.lower)) if rng.random() < 0.5 else None
        x, solved = daqp_solution(problem)
        outcomes.add(solved)
        for solve in (prepared, changing):
            solution = solve(problem, guess)
            assert solution.status is (Status.SOLVED if solved else Status.INFEASIBLE)
            if solved:
                assert distance(problem, solution.x, x) < 1e-6
                assert worst_residual(solution) < 1e-9
    assert outcomes == ({True} if feasible else {True, False})


@pytest.mark.parametrize("feasible", [True, None])
def test_no_disagreement_with_clarabel_on_integer_problems(feasible):
    rng = np.random.default_rng([7, bool(feasible)])
    clarabel = CvxpySolver()
    for _ in range(60):
        problem = integer_problem(rng, feasible)
        theirs = clarabel.solve(problem)
        ours = changing(problem)
        assert ours.status is theirs.status
        if ours.status.solved:
            assert distance(problem, ours.x, theirs.x) < 1e-6


@pytest.mark.parametrize("feasible", [True, None])
def test_the_papers_algorithm_finds_what_the_dual_method_finds(feasible):
    rng = np.random.default_rng([8, bool(feasible)])
    primal = PrimalActiveSet()
    for _ in range(600):
        problem = integer_problem(rng, feasible)
        guess = rng.integers(-1, 2, len(problem.lower)) if rng.random() < 0.5 else None
        dual = changing(problem)
        solution = primal.solve(problem, guess)
        assert solution.status is dual.status
        if dual.status.solved:
            assert worst_residual(solution) < 1e-9
            assert distance(problem, solution.x, dual.x) < 1e-8


numbers = st.integers(-3, 3).map(float)


@st.composite
def small_problems(draw):
    n = draw(st.integers(1, 4))
    m = draw(st.integers(0, 6))
    root = np.array(draw(st.lists(numbers, min_size=n * n, max_size=n * n))).reshape(
        n, n
    )
    P = root.T @ root + draw(st.sampled_from([1e-3, 1.0, 100.0])) * np.eye(n)
    q = np.array(draw(st.lists(numbers, min_size=n, max_size=n)))
    G = np.array(draw(st.lists(numbers, min_size=m * n, max_size=m * n))).reshape(m, n)
    bound = st.one_of(st.none(), numbers)
    lower = []
    upper = []
    for _ in range(n + m):
        low = draw(bound)
        width = draw(st.one_of(st.none(), st.sampled_from([0.0, 0.5, 2.0])))
        lower.append(-np.inf if low is None else low)
        upper.append(np.inf if width is None else (0.0 if low is None else low) + width)
    guess = draw(st.lists(st.sampled_from([-1, 0, 1]), min_size=n + m, max_size=n + m))
    return QuadraticProgram.from_stacked(
        P, q, G, np.array(lower), np.array(upper)
    ), np.array(guess)


@given(small_problems())
@settings(max_examples=400, deadline=None, derandomize=True)
def test_three_methods_agree_on_whatever_hypothesis_invents(case):
    problem, guess = case
    solutions = [
        prepared(problem, guess),
        changing(problem, guess),
        PrimalActiveSet().solve(problem, guess),
    ]
    assert len({solution.status for solution in solutions}) == 1
    assert solutions[0].status in (Status.SOLVED, Status.INFEASIBLE)
    if solutions[0].status.solved:
        for solution in solutions:
            assert worst_residual(solution) < 1e-9
            assert distance(problem, solutions[0].x, solution.x) < 1e-8


@pytest.mark.parametrize("solve", [prepared, changing])
@pytest.mark.parametrize("condition", [1.0, 1e4, 1e8])
@pytest.mark.parametrize("n", [1, 2, 3, 7, 20, 50, 150])
def test_every_size_and_conditioning_is_solved_to_1e_9(solve, n, condition, rng):
    for m in (0, n, 2 * n):
        problem = feasible_problem(rng, n, m, condition)
        solution = solve(problem)
        assert solution.status is Status.SOLVED
        assert worst_residual(solution) < 1e-9
        x, _ = daqp_solution(problem)
        assert distance(problem, solution.x, x) < 1e-6


@pytest.mark.parametrize("n", range(1, 151, 7))
def test_every_number_of_variables_from_1_to_150_without_rows(n, rng):
    problem = feasible_problem(rng, n, 0)
    for solution in (prepared(problem), changing(problem)):
        assert solution.is_optimal(1e-9)
