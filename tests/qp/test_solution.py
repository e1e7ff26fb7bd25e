import pickle

import numpy as np
import pytest

from gpmpc.exceptions import ProblemError
from gpmpc.qp import DualActiveSet, QuadraticProgram, make_solution
from gpmpc.status import Status
from tests.qp.problems import feasible_problem, worst_residual


@pytest.fixture
def solved(rng):
    problem = feasible_problem(rng, 6, 8)
    return problem, DualActiveSet().solve(problem)


def test_a_solution_parts_are_those_of_the_stacked_problem(solved):
    problem, solution = solved
    np.testing.assert_array_equal(
        solution.multipliers, np.concatenate([solution.z_box, solution.z])
    )
    assert solution.x.shape == (6,)
    assert solution.z.shape == (8,)
    assert solution.active_set.shape == (14,)
    working = solution.active_set != 0
    assert working.any()
    assert not solution.multipliers[~working].any()
    assert (solution.multipliers[working] * solution.active_set[working] >= 0).all()
    assert solution.objective == pytest.approx(
        0.5 * solution.x @ problem.P @ solution.x + problem.q @ solution.x
    )
    assert solution.solve_seconds > 0.0


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_residuals_see_a_moved_point_and_changed_multipliers(solved, rng, sign):
    problem, solution = solved
    assert solution.is_optimal(1e-9)
    off_optimum = make_solution(
        problem, Status.SOLVED, solution.x + sign * 1e-3, solution.multipliers
    )
    assert not off_optimum.is_optimal(1e-6)
    working = np.flatnonzero(solution.multipliers)[0]
    changed = solution.multipliers.copy()
    changed[working] += sign * 1e-2
    assert (
        make_solution(problem, Status.SOLVED, solution.x, changed).residuals().dual
        > 1e-5
    )


def test_a_multiplier_of_the_wrong_sign_is_not_optimal():
    # min 1/2 x^2 on -1 <= x <= 1: at x = 1 the multiplier -1 is stationary, but says
    # "at the lower bound".
    problem = QuadraticProgram([[1.0]], [0.0], lb=[-1.0], ub=[1.0])
    claim = make_solution(problem, Status.SOLVED, [1.0], [-1.0])
    assert claim.residuals().dual == 0.0
    assert claim.residuals().primal == 0.0
    assert claim.residuals().gap > 0.1
    assert not claim.is_optimal()


def test_a_multiplier_of_an_absent_bound_is_a_dual_residual():
    problem = QuadraticProgram([[1.0]], [1.0], ub=[5.0])
    assert make_solution(problem, Status.SOLVED, [0.0], [-1.0]).residuals().dual == 1.0


@pytest.mark.parametrize("absent", [-np.inf, -1e20])
def test_a_rounded_multiplier_of_an_absent_bound_is_no_gap(absent):
    """An interior-point solver leaves 1e-16 where there is no bound."""
    problem = QuadraticProgram([[1.0]], [1.0], lb=[absent], ub=[5.0])
    claim = make_solution(problem, Status.SOLVED, [-1.0], [-1e-16])
    assert claim.residuals().gap == 0.0
    assert claim.is_optimal()


def test_a_solver_of_another_process_solves_to_the_same_bits(solved):
    problem, solution = solved
    solver = DualActiveSet(tolerance=1e-8, iteration_limit=500)
    solver.solve(problem)
    copied = pickle.loads(pickle.dumps(solver))
    assert copied == solver
    assert copied.solve(problem).x.tobytes() == solution.x.tobytes()


def test_parts_of_the_wrong_shape_are_refused(solved):
    problem, solution = solved
    with pytest.raises(ProblemError, match="a solution needs x of shape"):
        make_solution(problem, Status.SOLVED, solution.x[:-1], solution.multipliers)
    with pytest.raises(ProblemError, match="active set of shape"):
        make_solution(
            problem, Status.SOLVED, solution.x, solution.multipliers, active_set=[1]
        )


def test_a_solution_survives_being_made_from_its_parts(solved):
    problem, solution = solved
    copy = make_solution(
        problem,
        solution.status,
        solution.x,
        solution.multipliers,
        active_set=solution.active_set,
    )
    np.testing.assert_array_equal(copy.active_set, solution.active_set)
    assert worst_residual(copy) == worst_residual(solution)
    assert copy.status is Status.SOLVED
