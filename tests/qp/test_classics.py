"""Problems that are known to break quadratic programming codes."""

import numpy as np
import pytest
from scipy.linalg import hilbert

from gpmpc.qp import QuadraticProgram
from gpmpc.status import Status
from tests.qp.problems import (
    changing,
    feasible_problem,
    prepared,
    primal,
    stacked_rows,
    worst_residual,
)

ALL = pytest.mark.parametrize("solve", [prepared, changing, primal])
DUAL = pytest.mark.parametrize("solve", [prepared, changing])


@ALL
@pytest.mark.parametrize("n", [2, 5, 8])
def test_klee_minty_cubes_take_at_most_10_n_iterations(solve, n):
    # sum_{j<i} 2^(i-j+1) x_j + x_i <= 5^i, x >= 0 (Klee and Minty, 1972), with a small
    # Hessian
    G = np.tril(
        2.0 ** (np.subtract.outer(np.arange(n), np.arange(n)) + 1.0), -1
    ) + np.eye(n)
    q = -(2.0 ** np.arange(n - 1, -1, -1))
    problem = QuadraticProgram(
        1e-3 * np.eye(n), q, G, h_upper=5.0 ** np.arange(1, n + 1), lb=np.zeros(n)
    )
    solution = solve(problem)
    assert solution.status is Status.SOLVED
    assert worst_residual(solution) < 1e-9
    assert solution.iterations <= 10 * n


@ALL
@pytest.mark.parametrize("n", [3, 6, 8])
def test_hilbert_hessians_are_solved_to_1e_9(solve, n):
    P = hilbert(n)
    problem = QuadraticProgram(
        P,
        -P @ np.linspace(-2.0, 2.0, n),
        np.ones((1, n)),
        [0.5],
        [0.5],
        -np.ones(n),
        np.ones(n),
    )
    solution = solve(problem)
    assert solution.status is Status.SOLVED
    assert worst_residual(solution) < 1e-9


@ALL
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_repeated_and_scaled_rows_change_multipliers_alone(solve, scale, rng):
    problem = feasible_problem(rng, 6, 5)
    repeated = QuadraticProgram(
        problem.P,
        problem.q,
        np.vstack([problem.G, scale * problem.G, -problem.G]),
        np.concatenate([problem.h_lower, scale * problem.h_lower, -problem.h_upper]),
        np.concatenate([problem.h_upper, scale * problem.h_upper, -problem.h_lower]),
        problem.lb,
        problem.ub,
    )
    solution = solve(repeated)
    assert solution.status is Status.SOLVED
    assert worst_residual(solution) < 1e-9
    np.testing.assert_allclose(solution.x, solve(problem).x, atol=1e-8)


@ALL
@pytest.mark.parametrize("n", [2, 3, 5])
def test_a_vertex_of_more_constraints_than_variables_is_found(solve, n, rng):
    vertex = rng.standard_normal(n)
    G = rng.standard_normal((40, n))
    G[:, 0] = np.abs(G[:, 0]) + 1.0
    problem = QuadraticProgram(
        np.eye(n), -vertex - 5.0 * G.sum(axis=0), G, h_upper=G @ vertex
    )
    solution = solve(problem)
    assert solution.status is Status.SOLVED
    assert worst_residual(solution) < 1e-9
    np.testing.assert_allclose(solution.x, vertex, atol=1e-8)


@ALL
def test_equalities_alone_give_the_solution_of_their_kkt_system(solve, rng):
    n = 8
    m = 5
    problem = feasible_problem(rng, n, m)
    b = problem.G @ rng.standard_normal(n)
    solution = solve(QuadraticProgram(problem.P, problem.q, problem.G, b, b))
    kkt = np.block([[problem.P, problem.G.T], [problem.G, np.zeros((m, m))]])
    expected = np.linalg.solve(kkt, np.concatenate([-problem.q, b]))
    np.testing.assert_allclose(solution.x, expected[:n], atol=1e-9)
    np.testing.assert_allclose(solution.z, expected[n:], atol=1e-8)


@ALL
def test_dependent_equalities_are_feasible_where_they_agree(solve, rng):
    n = 4
    G = rng.standard_normal((3, n))
    G = np.vstack([G, G[0] + G[1], 2.0 * G[2]])
    b = G @ rng.standard_normal(n)
    assert solve(QuadraticProgram(np.eye(n), np.ones(n), G, b, b)).is_optimal(1e-9)
    b[3] += 1e-3
    assert (
        solve(QuadraticProgram(np.eye(n), np.ones(n), G, b, b)).status
        is Status.INFEASIBLE
    )


@DUAL
def test_infeasibility_comes_with_a_farkas_proof(solve, rng):
    problem = QuadraticProgram(
        np.eye(3),
        np.ones(3),
        rng.random((4, 3)),
        h_lower=np.full(4, 9.0),
        ub=np.ones(3),
    )
    solution = solve(problem)
    assert solution.status is Status.INFEASIBLE
    ray = solution.multipliers
    np.testing.assert_allclose(stacked_rows(problem).T @ ray, 0.0, atol=1e-12)
    bounds = np.where(ray > 0, problem.upper, problem.lower)
    assert np.sum(ray[ray != 0] * bounds[ray != 0]) < -1e-6


@DUAL
@pytest.mark.parametrize("gap", [1e-3, 1e-5, 1e-6])
def test_a_thin_but_real_feasible_set_is_not_called_infeasible(solve, gap):
    # two nearly parallel rows leave a sliver between them
    G = np.array([[1.0, 1.0], [1.0 + gap, 1.0], [0.0, 1.0]])
    problem = QuadraticProgram(
        np.eye(2), [-1.0, -1.0], G, [1.0, -np.inf, -np.inf], [np.inf, 1.0, 5.0]
    )
    solution = solve(problem)
    assert solution.status is Status.SOLVED
    assert worst_residual(solution) < 1e-9


@DUAL
@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_badly_scaled_variables_are_not_called_infeasible(solve, scale, rng):
    for _ in range(20):
        problem = feasible_problem(rng, 6, 10)
        D = scale ** rng.uniform(-1.0, 1.0, 6)
        scaled = QuadraticProgram(
            problem.P * np.outer(D, D),
            problem.q * D,
            problem.G * D,
            problem.h_lower,
            problem.h_upper,
            problem.lb / D,
            problem.ub / D,
        )
        solution = solve(scaled)
        assert solution.status is Status.SOLVED
        np.testing.assert_allclose(solution.x * D, solve(problem).x, atol=1e-6)


@DUAL
def test_a_fixed_variable_stays_where_it_is_put(solve, rng):
    problem = feasible_problem(rng, 5, 0)
    lb = problem.lb.copy()
    ub = problem.ub.copy()
    lb[2] = ub[2] = 0.7
    solution = solve(QuadraticProgram(problem.P, problem.q, lb=lb, ub=ub))
    assert solution.x[2] == pytest.approx(0.7, abs=1e-12)
    assert solution.is_optimal(1e-9)


def test_the_primal_method_takes_no_rounding_for_a_direction(rng):
    problem = feasible_problem(rng, 60, 60, condition=1e6)
    solution = primal(problem)
    assert solution.status is Status.SOLVED
    assert worst_residual(solution) < 1e-9
    assert solution.iterations < 500
