"""Residuals, objective and violations agree with definitions, entry by entry."""

import numpy as np
import pytest

from gpmpc.qp import QuadraticProgram, make_solution
from gpmpc.status import Status

ABSENT = 1e20


def excess(value, lower, upper):
    return max(
        0.0,
        value - upper if upper < ABSENT else 0.0,
        lower - value if lower > -ABSENT else 0.0,
    )


@np.errstate(invalid="ignore")  # the gap at an absent bound
def by_definition(solution):
    """Primal and dual residual, duality gap."""
    (P, q, G, lower, upper), caps = solution.arrays, solution.caps
    x = solution.x
    y = solution.multipliers
    n = len(q)
    C = np.vstack([np.eye(n), G])
    M = len(lower)
    units = [np.sqrt(P[i, i]) for i in range(n)]
    free = max(abs(q[i]) / units[i] for i in range(n))
    zero = max(1e-4 * max(units[i] * abs(x[i]) for i in range(n)), 1e-12 * free)
    primal = dual = bounds = price = 0.0
    stray = np.zeros(M)
    for p in range(M):
        value = C[p] @ x
        missed = excess(value, lower[p], upper[p])
        paid_for = y[p] if value > upper[p] else -y[p]
        beyond = 0.0 if paid_for >= caps[p] else missed
        own = sum(abs(C[p, i]) * max(abs(x[i]), zero / units[i]) for i in range(n))
        if beyond:
            primal = max(
                primal,
                beyond / max(own, abs(upper[p] if value > upper[p] else lower[p])),
            )
        bound = upper[p] if y[p] > 0 else lower[p]
        stray[p] = (
            abs(y[p])
            if y[p] and abs(bound) >= ABSENT
            else max(0.0, abs(y[p]) - caps[p])
        )
        bounds += abs(y[p] * bound) if y[p] else 0.0
        price += caps[p] * missed if abs(y[p]) >= caps[p] else 0.0
        price += y[p] * bound if y[p] else 0.0
    for i in range(n):
        residual = abs(P[i] @ x + q[i] + C[:, i] @ y) + np.abs(C[:, i]) @ stray
        own = (
            np.abs(P[i]) @ np.abs(x) + abs(q[i]) + np.abs(C[:, i]) @ (np.abs(y) - stray)
        )
        dual = max(dual, residual / max(own, zero * units[i]))
    gap = abs(x @ P @ x + q @ x + price) / max(
        abs(x @ P @ x), abs(q @ x), bounds, zero * free
    )
    return primal, dual, gap


def random_claim(rng, soft=False, absent=False, scale=1.0):
    """A program and any x with any multipliers as its solution."""
    n = int(rng.integers(1, 5))
    m = int(rng.integers(1, 5))
    root = rng.normal(size=(n, n))
    P = root @ root.T + np.eye(n)
    q = rng.normal(size=n)
    G = rng.normal(size=(m, n))
    lower = -rng.uniform(0.1, 2, n + m)
    upper = rng.uniform(0.1, 2, n + m)
    x = scale * rng.normal(size=n)
    y = scale * rng.normal(size=n + m) * (rng.random(n + m) < 0.7)
    if absent:
        lower[0] = -np.inf
        upper[-1] = 1e20
        y[0], y[-1] = -abs(y[0]), abs(y[-1])
    claim = make_solution(
        QuadraticProgram.from_stacked(P, q, G, lower, upper), Status.SOLVED, x, y
    )
    if soft:
        prices = np.where(rng.random(m) < 0.5, rng.uniform(0.1, 1.5, m), np.inf)
        claim = claim._replace(caps=np.append(claim.caps[:n], prices))
    return claim


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("scale", [0.0, 1e-9, 1.0, 1e3])
def test_residuals_are_those_of_their_definition(soft, scale, rng):
    for _ in range(40):
        claim = random_claim(rng, soft, scale=scale)
        np.testing.assert_allclose(
            claim.residuals(), by_definition(claim), rtol=1e-9, atol=1e-15
        )


def test_a_multiplier_of_an_absent_bound_counts_whole(rng):
    for _ in range(40):
        claim = random_claim(rng, absent=True)
        np.testing.assert_allclose(
            claim.residuals()[:2], by_definition(claim)[:2], rtol=1e-9
        )


def test_what_counts_as_zero_is_a_share_of_the_free_minimiser():
    program = QuadraticProgram(np.diag([4.0, 1.0]), [2.0, 3.0], ub=[-1e-9, 1.0])
    claim = make_solution(program, Status.SOLVED, *np.zeros((2, 2)))
    assert claim.residuals().dual == 1.0
    assert claim.residuals(zero=1e-3).primal == pytest.approx(1e-9 / (1e-3 * 3 / 2))
    assert claim.residuals(zero=2.0).dual == pytest.approx(0.5)
    assert claim.residuals().gap == 0.0


@pytest.mark.parametrize("soft", [False, True])
def test_objective_and_violations_are_those_of_their_definition(soft, rng):
    for _ in range(20):
        claim = random_claim(rng, soft)
        (P, q, G, lower, upper), caps = claim.arrays, claim.caps
        missed = [
            excess(v, a, b)
            for v, a, b in zip([*claim.x, *(G @ claim.x)], lower, upper, strict=True)
        ]
        np.testing.assert_allclose(claim.violation(), missed, atol=1e-15)
        price = sum(v * c for v, c in zip(missed, caps, strict=True) if np.isfinite(c))
        assert claim.objective == pytest.approx(
            0.5 * claim.x @ P @ claim.x + q @ claim.x + price
        )


def test_a_solution_from_parts_holds_each_of_them(rng):
    program = QuadraticProgram(np.eye(2), [1.0, 2.0], [[1.0, 1.0]], [-1.0], [1.0])
    effort = {"iterations": 7, "build_seconds": 0.25, "solve_seconds": 0.5}
    solution = make_solution(
        program, Status.TIME_LIMIT, [3.0, 4.0], [0.0, -5.0, 6.0], **effort
    )
    assert (
        solution.status,
        solution.iterations,
        solution.build_seconds,
        solution.solve_seconds,
    ) == (
        Status.TIME_LIMIT,
        7,
        0.25,
        0.5,
    )
    assert (solution.x.tolist(), solution.z_box.tolist(), solution.z.tolist()) == (
        [3.0, 4.0],
        [0.0, -5.0],
        [6.0],
    )
    assert solution.active_set.tolist() == [0, -1, 1]
    other = make_solution(
        program, Status.SOLVED, [0.0, 0.0], np.zeros(3), active_set=[1, 0, -1]
    )
    assert other.active_set.tolist() == [1, 0, -1]
    bare = make_solution(program, Status.INFEASIBLE, [0.0, 0.0], np.full(3, np.nan))
    assert (bare.iterations, bare.build_seconds, bare.solve_seconds) == (0, 0.0, 0.0)
    assert not bare.active_set.any()
    assert not bare.is_optimal()
