"""Limits, threads, start-up: what a solver in a control loop must withstand."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter

import daqp
import numpy as np
import pytest

from gpmpc.qp import DualActiveSet, PrimalActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.qp.problems import feasible_problem, integer_problem
from tests.qp.test_near_dependence import near_dependent_problem

PACKAGE = Path(__file__).resolve().parents[2] / "gpmpc"


@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_a_solve_goes_on_from_the_iterate_at_the_limit(mode, rng):
    problem = feasible_problem(rng, 20, 30)
    full = DualActiveSet().solve(problem)
    assert full.iterations > 6
    limited = DualActiveSet(iteration_limit=3)
    prepared = limited.prepare(problem.P, problem.G)
    solution = None
    objectives = []
    for _ in range(full.iterations):
        if mode == "prepared":
            solution = prepared.solve(problem.q, problem.lower, problem.upper, solution)
        else:
            solution = limited.solve(problem, solution)
        objectives.append(solution.objective)
        assert solution.residuals().dual < 1e-9
        if solution.status.solved:
            break
        assert solution.status is Status.ITERATION_LIMIT
        assert solution.residuals().primal > 0.0
    assert solution.status.solved
    np.testing.assert_allclose(solution.x, full.x, atol=1e-9)
    # a dual method climbs: each stop is a lower bound on the optimum, better than the
    # one before
    assert (np.diff(objectives) > 0.0).all()
    assert len(objectives) > 2


@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_the_time_limit_stops_a_long_solve_not_a_short_one(mode, rng):
    problem = feasible_problem(rng, 120, 300)
    full = DualActiveSet().solve(problem)
    assert full.iterations > 50

    def solve(solver):
        if mode == "prepared":
            return solver.prepare(problem.P, problem.G).solve(
                problem.q, problem.lower, problem.upper
            )
        return solver.solve(problem)

    hurried = solve(DualActiveSet(time_limit=1e-7))
    assert hurried.status is Status.TIME_LIMIT
    assert hurried.iterations < full.iterations
    assert hurried.residuals().dual < 1e-9
    patient = solve(DualActiveSet(time_limit=60.0))
    assert patient.status is Status.SOLVED
    assert patient.iterations > 2 * hurried.iterations
    np.testing.assert_allclose(patient.x, full.x, atol=1e-9)


def test_all_tries_of_a_program_count_together():
    """It is tried a second time, and with doubled digits."""
    rng = np.random.default_rng(0)
    for _ in range(400):
        problem = near_dependent_problem(rng, feasible=False)
        solution = DualActiveSet(iteration_limit=6).solve(problem)
        assert solution.iterations <= 6 + len(problem.q)  # as many enter at once


def test_a_tolerance_near_rounding_needs_no_doubled_digits(rng, monkeypatch):
    def rescue(*arguments):
        raise AssertionError("solved again with doubled digits")

    monkeypatch.setattr("gpmpc.qp._dual_active_set.rescue", rescue)
    for _ in range(100):
        solution = DualActiveSet(tolerance=1e-14).solve(feasible_problem(rng, 20, 30))
        assert solution.status is Status.SOLVED


def test_the_primal_method_says_when_it_stops_early(rng):
    solution = PrimalActiveSet(iteration_limit=2).solve(feasible_problem(rng, 10, 20))
    assert solution.status is Status.ITERATION_LIMIT


def test_one_solver_and_one_prepared_problem_serve_many_threads(rng):
    problems = [feasible_problem(rng, 12, 20) for _ in range(8)]
    shared = problems[0]
    solver = DualActiveSet()
    prepared = solver.prepare(shared.P, shared.G)
    gradients = [shared.q + rng.standard_normal(12) for _ in range(8)]
    expected = [
        [solver.solve(p).x for p in problems],
        [prepared.solve(q, shared.lower, shared.upper).x for q in gradients],
    ]

    def work(_):
        own = DualActiveSet()
        return [
            [
                [own.solve(p).x for p in problems],
                [prepared.solve(q, shared.lower, shared.upper).x for q in gradients],
            ]
            for _ in range(50)
        ]

    with ThreadPoolExecutor(4) as pool:
        for results in pool.map(work, range(4)):
            for result in results:
                np.testing.assert_array_equal(result, expected)


START = """
import numpy as np
from gpmpc.qp import DualActiveSet
from gpmpc.qp._dual_kernels import solve_kernel
prepared = DualActiveSet().prepare(np.eye(3), np.ones((1, 3)))
solution = prepared.solve(np.ones(3), np.full(4, -0.5), np.full(4, 0.5))
assert solution.is_optimal(1e-12), solution
print(sum(solve_kernel.stats.cache_misses.values()))
"""


def first_solve(folder, **environment):
    """How many kernels a new process must compile for its first solve."""
    return int(
        subprocess.run(
            [sys.executable, "-c", START],
            capture_output=True,
            text=True,
            check=True,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(folder)} | environment,
        ).stdout
    )


def copy_of_the_package(folder):
    modules = ("__init__", "status", "exceptions", "_compiled")
    for source in [
        *(PACKAGE / f"{name}.py" for name in modules),
        *PACKAGE.glob("qp/*.py"),
        *PACKAGE.glob("_kernels/*.py"),
    ]:
        target = folder / source.relative_to(PACKAGE.parent)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(source.read_text())


def test_a_new_process_takes_its_kernels_from_the_cache():
    DualActiveSet().prepare(
        np.eye(2)
    )  # fills the cache beside the source, unless it is there already
    assert first_solve(PACKAGE.parent) == 0


@pytest.mark.slow
def test_the_solver_works_where_no_compiled_code_can_be_kept(tmp_path):
    copy_of_the_package(tmp_path)
    (tmp_path / "gpmpc" / "qp" / "__pycache__").write_text(
        "in the way of the cache beside the source"
    )
    nowhere = str(
        tmp_path / "gpmpc" / "status.py"
    )  # a file: no cache folder can be made below it
    first_solve(tmp_path, HOME=nowhere, XDG_CACHE_HOME=nowhere, NUMBA_CACHE_DIR="")


@pytest.mark.slow
def test_no_disagreement_on_ten_thousand_more_integer_problems():
    solver = DualActiveSet()
    rng = np.random.default_rng(99)
    primal = PrimalActiveSet()
    for _ in range(10000):
        problem = integer_problem(rng, True if rng.random() < 0.5 else None)
        assert solver.solve(problem).status is primal.solve(problem).status


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_a_plain_contradiction_needs_no_doubled_digits(mode, scale, monkeypatch):
    """x <= 1 against a row that says x >= 2."""

    def rescue(*arguments):
        raise AssertionError("solved again with doubled digits")

    monkeypatch.setattr("gpmpc.qp._dual_active_set.rescue", rescue)
    problem = QuadraticProgram(
        np.eye(2), np.ones(2), [[1.0, 0.0]], [2.0 * scale], ub=[scale, np.inf]
    )
    solver = DualActiveSet()
    prepared = solver.prepare(problem.P, problem.G)
    solution = (
        prepared.solve(problem.q, problem.lower, problem.upper)
        if mode == "prepared"
        else solver.solve(problem)
    )
    assert solution.status is Status.INFEASIBLE
    assert solution.iterations <= 2
    ray = solution.multipliers
    np.testing.assert_allclose(ray[:2] + problem.G.T @ ray[2:], 0.0, atol=1e-14)
    assert ray[0] > 0.0 > ray[2]


def crowded_vertex(rng):
    """More rows than variables through one vertex, the solution.

    Some are repeated or sums of others.
    """
    n = int(rng.integers(18, 40))
    m = int(rng.integers(n, 4 * n))
    root = rng.standard_normal((n, n))
    G = rng.standard_normal((m, n))
    vertex = rng.standard_normal(n)
    if rng.random() < 0.3:
        root, G, vertex = (np.round(2.0 * part) for part in (root, G, vertex))
    G[m // 2 :] = G[: m - m // 2] + G[rng.integers(0, m // 2, m - m // 2)] * (
        rng.random() < 0.5
    )
    P = root @ root.T / n + 10.0 ** rng.uniform(-3, 0) * np.eye(n)
    q = -P @ vertex - G.T @ (
        rng.uniform(0, 1, m) * (rng.random(m) < rng.uniform(0.3, 1.0))
    )
    return QuadraticProgram((P + P.T) / 2, q, G, h_upper=G @ vertex), vertex


@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_vertices_where_many_rows_meet_are_found_without_cycling(mode, rng):
    solver = DualActiveSet()
    for _ in range(30):
        problem, vertex = crowded_vertex(rng)
        prepared = solver.prepare(problem.P, problem.G)
        solution = (
            prepared.solve(problem.q, problem.lower, problem.upper)
            if mode == "prepared"
            else solver.solve(problem)
        )
        assert solution.status is Status.SOLVED
        x, _, flag, _ = daqp.solve(
            problem.P.copy(),
            problem.q.copy(),
            problem.G.copy(),
            np.minimum(problem.upper, 1e30),
            np.maximum(problem.lower, -1e30),
            np.zeros(len(problem.lower), dtype=np.int32),
            primal_tol=1e-10,
        )
        assert flag == 1
        np.testing.assert_allclose(solution.x, x, atol=1e-7 * np.abs(vertex).max())


@pytest.mark.parametrize("mode", ["prepared", "changing"])
def test_rows_dependent_but_for_rounding_are_no_obstacle(mode, rng):
    """Two to six times as many rows as variables meet in a vertex.

    They span half of the space.
    """
    solver = DualActiveSet()
    for _ in range(20):
        n = int(rng.integers(18, 40))
        m = int(rng.integers(2 * n, 6 * n))
        root = rng.standard_normal((n, n))
        vertex = np.round(3 * rng.standard_normal(n))
        P = root @ root.T / n + 1e-4 * np.eye(n)
        G = rng.standard_normal((m, n // 2)) @ rng.standard_normal((n // 2, n))
        multipliers = rng.uniform(0, 1, m) * (rng.random(m) < 0.5)
        problem = QuadraticProgram(
            (P + P.T) / 2, -P @ vertex - G.T @ multipliers, G, h_upper=G @ vertex
        )
        prepared = solver.prepare(problem.P, problem.G)
        solution = (
            prepared.solve(problem.q, problem.lower, problem.upper)
            if mode == "prepared"
            else solver.solve(problem)
        )
        assert solution.status is Status.SOLVED
        np.testing.assert_allclose(solution.x, vertex, atol=1e-6 * np.abs(vertex).max())


def test_a_second_look_keeps_the_time_limit(rng):
    """A program that takes the doubled digits seconds, and one float cannot decide."""
    problem = feasible_problem(rng, 60, 120)
    G = np.vstack([problem.G, problem.G + 1e-9 * rng.standard_normal(problem.G.shape)])
    low, high = (
        np.concatenate([h, h + 1e-9 * rng.standard_normal(len(h))])
        for h in (problem.h_lower, problem.h_upper)
    )
    low[120:130] = high[120:130]
    problem = QuadraticProgram(
        problem.P, problem.q, G, low, np.maximum(low, high), problem.lb, problem.ub
    )
    for limit in (1e-3, 1e-2):
        began = perf_counter()
        solution = DualActiveSet(time_limit=limit).solve(problem)
        assert perf_counter() - began < limit + 0.5  # one step of the iteration
        assert solution.status in (Status.TIME_LIMIT, Status.SOLVED, Status.INFEASIBLE)
