"""Small programs against rational arithmetic.

What is called solved is, what is called infeasible is.
"""

from fractions import Fraction

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet, PrimalActiveSet, QuadraticProgram, make_solution
from gpmpc.status import Status
from tests.qp.exact import exact_solution, rational
from tests.qp.families import FAMILIES
from tests.qp.problems import changing, prepared, primal

SLICE = 60
STUDY = 2000
UNSOLVED = 1e-3
ROUNDING = Fraction(1, 10**14)


def guessed(problem):
    guess = np.random.default_rng(len(problem.lower)).integers(
        -1, 2, len(problem.lower)
    )
    return prepared(problem, guess)


def error(problem, x, exact):
    """The largest error of x as a share of x.

    Of its largest entry, and of the largest in the units of P's diagonal.
    """
    if not np.isfinite(x).all():
        return np.inf
    units = np.sqrt(np.diagonal(problem.P))
    exact_x = np.array([float(value) for value in exact])
    difference = np.array(
        [abs(float(Fraction(float(a)) - b)) for a, b in zip(x, exact, strict=True)]
    )
    zero = 1e-12 * np.abs(problem.q / units).max()
    plain = difference.max() / max(np.abs(exact_x).max(), (zero / units).max(), 1e-300)
    return max(
        plain,
        (units * difference).max() / max((units * np.abs(exact_x)).max(), zero, 1e-300),
    )


def row_sizes(problem, x):
    """The size of the numbers whose rounding a violation may be.

    A constraint's bounds and own terms.
    """
    sizes = np.abs(np.stack([problem.lower, problem.upper]))
    terms = np.append(np.abs(x), np.abs(problem.G) @ np.abs(x))
    sizes = np.maximum(np.where(np.isfinite(sizes), sizes, 0.0).max(axis=0), terms)
    empty = np.append(np.zeros(len(problem.q), dtype=bool), ~problem.G.any(axis=1))
    # in a zero row numbers of the size of the others cancelled, or of one
    others = np.abs(np.stack([problem.lower, problem.upper]))[:, ~empty]
    largest = others[np.isfinite(others)].max(initial=0.0)
    return np.where(empty, min(1.0, largest or 1.0), sizes)


def solves_up_to_rounding(problem, x):
    """Whether x solves the program with bounds that are wider by rounding.

    2e-14 of a row's terms, or any part of it.

    The solutions for all parts lie on a line from the one with the whole, twice as far
    as that with half.
    """
    slack = 2e-14 * row_sizes(problem, x)
    whole = exact_solution(problem, problem.lower - slack, problem.upper + slack)
    half = exact_solution(problem, problem.lower - slack / 2, problem.upper + slack / 2)
    if whole is None:
        return False
    wholly = np.array([float(value) for value in whole])
    away = np.abs(x - wholly)
    between = (
        np.zeros(len(x))
        if half is None
        else np.array([float(2 * abs(a - b)) for a, b in zip(whole, half, strict=True)])
    )
    return error(problem, np.where(away <= 1.01 * between, wholly, x), whole) < 1e-6


def proves_infeasibility_up_to_rounding(problem, ray):
    """Whether the ray proves infeasibility once entries of C change by 1e-14.

    The bound on the change is that of Oettli and Prager.
    """
    y = rational(ray)
    C = np.vstack([rational(np.eye(len(problem.q))), rational(problem.G)])
    if not (abs(C.T @ y) <= ROUNDING * (abs(C.T) @ abs(y))).all():
        return False
    return (
        sum(
            a * Fraction(float(problem.upper[p] if a > 0 else problem.lower[p]))
            for p, a in enumerate(y)
            if a
        )
        < 0
    )


def unsolved(family, solve, count):
    """How many of ``count`` programs are left unsolved.

    An answer that is wrong fails at once.
    """
    rng = np.random.default_rng([14, list(FAMILIES).index(family)])
    left = 0
    for number in range(count):
        problem = FAMILIES[family](rng)
        exact = exact_solution(problem)
        solution = solve(problem)
        case = f"{family} {number}: {solution.status.name}"
        if solution.status is Status.SOLVED:
            if exact is None or error(problem, solution.x, exact) > 1e-6:
                assert solves_up_to_rounding(problem, solution.x), case
            if exact is not None:
                assert solution.is_optimal(1e-8), (case, solution.residuals())
        elif solution.status is Status.INFEASIBLE:
            assert exact is None or proves_infeasibility_up_to_rounding(
                problem, solution.multipliers
            ), case
        else:
            left += 1
    return left


@pytest.mark.parametrize("solve", [changing, prepared, guessed])
@pytest.mark.parametrize("family", FAMILIES)
def test_no_answer_of_the_dual_method_is_wrong(family, solve):
    assert unsolved(family, solve, SLICE) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_no_answer_of_the_primal_method_is_wrong(family):
    unsolved(family, primal, SLICE // 3)


@pytest.mark.slow
@pytest.mark.parametrize("solve", [changing, prepared, guessed])
@pytest.mark.parametrize("family", FAMILIES)
def test_no_answer_of_two_thousand_is_wrong(family, solve):
    assert unsolved(family, solve, STUDY) <= UNSOLVED * STUDY


@pytest.mark.parametrize(
    "family",
    [
        "huge_bounds",
        "nearly_infeasible",
        "parallel_rows",
        "small_numbers",
        "degenerate",
    ],
)
def test_rows_priced_above_their_multipliers_are_exactly_hard(family):
    rng = np.random.default_rng([15, list(FAMILIES).index(family)])
    solver = DualActiveSet()
    feasible = 0
    for number in range(20):
        problem = FAMILIES[family](rng)
        exact = exact_solution(problem)
        hard = changing(problem)
        if exact is not None and hard.status.solved:
            prices = np.full(
                len(problem.G),
                2.0 * max(np.abs(hard.z).max(initial=0.0), np.finfo(float).tiny),
            )
            for solution in (
                solver.solve(problem, prices=prices),
                solver.prepare(problem.P, problem.G, prices).solve(
                    problem.q, problem.lower, problem.upper
                ),
            ):
                assert solution.status is Status.SOLVED, (family, number)
                assert error(problem, solution.x, exact) < 1e-6, (family, number)
            feasible += 1
    assert feasible > 5


@pytest.mark.parametrize("solve", [changing, prepared, primal])
@pytest.mark.parametrize("size", [1e3, 1e6, 1e9, 1e12, 1e15, 1e19])
@pytest.mark.parametrize("place", ["box", "row"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_large_bound_on_one_side_leaves_the_other_as_it_is(solve, size, place, sign):
    sides = sorted([-sign * size, sign])
    bounds = (
        {"lb": sides[:1], "ub": sides[1:]}
        if place == "box"
        else {"h_lower": sides[:1], "h_upper": sides[1:]}
    )
    solution = solve(
        QuadraticProgram(
            np.eye(1), [-5.0 * sign], None if place == "box" else np.eye(1), **bounds
        )
    )
    assert solution.status is Status.SOLVED
    assert solution.x[0] == sign


@pytest.mark.parametrize("solve", [changing, prepared])
@pytest.mark.parametrize("share", [1e-3, 1e-6, 1e-9, 1e-12])
def test_what_only_looks_like_a_contradiction_is_solved(solve, share):
    G = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, share]])
    b = np.array([0.0, 0.0, 1e3 * share])
    solution = solve(QuadraticProgram(np.eye(3), np.zeros(3), G, b, b))
    assert solution.status is Status.SOLVED
    np.testing.assert_allclose(solution.x, [0.0, 0.0, 1e3], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("solve", [changing, prepared, primal])
def test_a_zero_row_proves_infeasibility_beyond_rounding_only(solve):
    for bound, status in ((-1e-17, Status.SOLVED), (-1e-6, Status.INFEASIBLE)):
        problem = QuadraticProgram(
            np.eye(2), [-1.0, 2.0], np.zeros((1, 2)), h_upper=[bound]
        )
        assert solve(problem).status is status


@pytest.mark.parametrize("scale", [1e-12, 1e-9, 1e-6, 1e6, 1e12])
def test_residuals_are_the_same_in_all_units(scale, rng):
    problem = FAMILIES["huge_bounds"](rng)
    solution = PrimalActiveSet().solve(problem)
    scaled = QuadraticProgram.from_stacked(
        scale * problem.P,
        scale * problem.q,
        scale * problem.G,
        np.append(problem.lb, scale * problem.h_lower),
        np.append(problem.ub, scale * problem.h_upper),
    )
    off_optimum = solution.x * 1.01
    multipliers = solution.multipliers * 0.9
    before = make_solution(problem, Status.SOLVED, off_optimum, multipliers).residuals()
    multipliers[: len(off_optimum)] *= scale
    after = make_solution(scaled, Status.SOLVED, off_optimum, multipliers).residuals()
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-14)
