import numpy as np
import pytest
import torch

from gpmpc.exceptions import ProblemError
from gpmpc.qp import DualActiveSet, PrimalActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.qp.problems import solve_stacked

EYE = np.eye(2)
INDEFINITE = np.array([[1.0, 2.0], [2.0, 1.0]])  # eigenvalues -1 and 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"P": np.ones(2), "q": [0, 0]}, "square matrix"),
        ({"P": np.zeros((0, 0)), "q": []}, "at least one row"),
        ({"P": EYE, "q": [0, 0, 0]}, r"q must have shape \(2,\); got \(3,\)"),
        ({"P": EYE, "q": [0, np.nan]}, "q must not contain NaN; it does at index 1"),
        ({"P": EYE, "q": [0, np.inf]}, "q must be finite"),
        ({"P": EYE, "q": ["a", "b"]}, "real numbers"),
        (
            {"P": [[1.0, np.nan], [0.0, 1.0]], "q": [0, 0]},
            "P must not contain NaN; it does at index 0, 1",
        ),
        ({"P": [[np.inf, 0.0], [0.0, 1.0]], "q": [0, 0]}, "P must be finite"),
        (
            {"P": [[1.0, 0.5], [0.0, 1.0]], "q": [0, 0]},
            r"symmetric; got P\[0, 1\] = 0.5 and P\[1, 0\] = 0",
        ),
        (
            {"P": [[1e8, 1e-3], [0.0, 1e-4]], "q": [0, -1]},
            r"symmetric; got P\[0, 1\] = 0.001 and P\[1, 0\] = 0",
        ),
        ({"P": [[1.0, 1 + 5e-11], [1 - 1e-12, 1.0]], "q": [0, 0]}, "positive definite"),
        (
            {"P": INDEFINITE, "q": [0, 0]},
            r"smallest eigenvalue \(number 0 of 2, in ascending order\) is -1,",
        ),
        ({"P": [[1.0, 1.0], [1.0, 1.0]], "q": [0, 0]}, "positive definite"),
        ({"P": EYE, "q": [0, 0], "G": [1.0, 1.0]}, "matrix of 2 columns"),
        (
            {"P": EYE, "q": [0, 0], "G": [[1.0, 1.0, 1.0]]},
            r"G must have shape \(1, 2\); got \(1, 3\)",
        ),
        ({"P": EYE, "q": [0, 0], "G": [[1.0, np.inf]]}, "G must be finite"),
        ({"P": EYE, "q": [0, 0], "h_upper": [1.0]}, "without G"),
        (
            {
                "P": EYE,
                "q": [0, 0],
                "G": [[1.0, 1.0]],
                "h_lower": [2.0],
                "h_upper": [1.0],
            },
            "row 0: h_lower must not exceed",
        ),
        (
            {"P": EYE, "q": [0, 0], "lb": [0.0, 1.0], "ub": [0.0, 0.5]},
            r"variable 1: lb must not exceed ub; got 1 > 0.5",
        ),
        (
            {"P": EYE, "q": [0, 0], "lb": [np.inf, 0.0]},
            "variable 0: no number satisfies lb = inf",
        ),
        (
            {"P": EYE, "q": [0, 0], "lb": [1e20, 0.0]},
            "variable 0: no number satisfies lb",
        ),
        (
            {"P": EYE, "q": [0, 0], "ub": [0.0, -1e20]},
            "variable 1: no number satisfies ub",
        ),
        ({"P": EYE, "q": [0, 0], "ub": [0.0, np.nan]}, "ub must not contain NaN"),
    ],
)
def test_a_malformed_problem_is_refused_with_rule_and_value(arguments, message):
    with pytest.raises(ProblemError, match=message):
        QuadraticProgram(**arguments)


GOOD = {
    "P": EYE,
    "q": np.zeros(2),
    "G": np.ones((1, 2)),
    "lower": -np.ones(3),
    "upper": np.ones(3),
}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("P", INDEFINITE, "smallest eigenvalue"),
        ("P", np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        ("P", np.array([[1e10, 0.9], [0.0, 1e-12]]), "symmetric"),
        ("P", np.array([[1.0, 0.0], [0.0, np.nan]]), "NaN"),
        ("P", np.ones((2, 3)), "square"),
        ("q", np.array([0.0, np.nan]), "NaN"),
        ("q", np.array([0.0, -np.inf]), "finite"),
        ("q", np.zeros(3), "shape"),
        ("G", np.full((1, 2), np.nan), "NaN"),
        ("G", np.ones((1, 3)), "shape"),
        ("lower", np.array([-1.0, np.nan, -1.0]), "NaN"),
        ("lower", np.array([-1.0, -1.0, 2.0]), "row 0"),
        ("lower", -np.ones(2), "shape"),
        ("upper", np.ones(4), "shape"),
    ],
)
def test_the_fast_entries_refuse_the_same_misuse(name, value, message):
    arguments = GOOD | {name: value}
    with pytest.raises(ProblemError, match=message):
        solve_stacked(**arguments)
    with pytest.raises(ProblemError, match=message):
        DualActiveSet().prepare(arguments.pop("P"), arguments.pop("G")).solve(
            **arguments
        )


def test_the_good_problem_of_these_tests_is_good():
    assert solve_stacked(**GOOD).status.solved


@pytest.mark.parametrize("bound", [np.inf, 1e20, 1e25, 1e300])
def test_a_bound_of_1e20_or_more_is_none(bound):
    free = QuadraticProgram(
        EYE,
        [-3.0, 4.0],
        EYE,
        [-bound, -bound],
        [bound, bound],
        [-bound, -bound],
        [bound, bound],
    )
    for solver in (DualActiveSet(), PrimalActiveSet()):
        solution = solver.solve(free)
        assert solution.status.solved
        np.testing.assert_allclose(solution.x, [3.0, -4.0])
        assert not solution.multipliers.any()


def test_lists_are_converted_and_the_callers_arrays_unchanged():
    P = [[2, 0], [0, 2]]
    G = np.asfortranarray([[1, 2], [3, 4]])
    problem = QuadraticProgram(P, [1, 1], G, h_upper=[1, 1])
    assert problem.G.flags.c_contiguous
    assert problem.G.dtype == np.float64
    assert G.flags.f_contiguous
    assert G.dtype.kind == "i"


def test_unstacking_and_stacking_bounds_are_inverse(rng):
    lower = -rng.random(5)
    upper = rng.random(5)
    problem = QuadraticProgram.from_stacked(
        EYE, np.zeros(2), rng.random((3, 2)), lower, upper
    )
    np.testing.assert_array_equal(problem.lower, lower)
    np.testing.assert_array_equal(problem.upper, upper)


@pytest.mark.parametrize(
    ("prices", "message"),
    [
        ([1.0, 0.0], "price of row 1 must be positive; got 0"),
        ([-1.0, 1.0], "price of row 0 must be positive"),
        ([1.0, np.nan], "prices of rows must not contain NaN"),
        ([1.0], r"prices of rows must have shape \(2,\); got \(1,\)"),
    ],
)
def test_prices_are_positive_numbers_one_for_each_row(prices, message):
    with pytest.raises(ProblemError, match=message):
        DualActiveSet().solve(QuadraticProgram(EYE, [0.0, 0.0], EYE), prices=prices)
    with pytest.raises(ProblemError, match=message):
        DualActiveSet().prepare(EYE, EYE, prices)


@pytest.mark.parametrize("solver", [DualActiveSet, PrimalActiveSet])
@pytest.mark.parametrize(
    "settings",
    [
        {"tolerance": 0.0},
        {"tolerance": None},
        {"iteration_limit": -1},
        {"tolerance": float("nan")},
    ],
)
def test_settings_that_make_no_sense_are_refused(solver, settings):
    with pytest.raises(ProblemError, match="must be positive"):
        solver(**settings)


@pytest.mark.parametrize("solver", [DualActiveSet(), PrimalActiveSet()])
def test_a_warm_start_of_another_shape_is_misuse(solver):
    with pytest.raises(ProblemError, match="warm start"):
        solver.solve(QuadraticProgram(EYE, [0.0, 0.0]), np.ones(5))
    with pytest.raises(ProblemError, match="-1, 0 or"):
        solver.solve(QuadraticProgram(EYE, [0.0, 0.0]), np.array([True, False]))


@pytest.mark.parametrize("units", [[1.0] * 3, [1e3] * 3, [1e-90, 1.0, 1e9]])
@pytest.mark.parametrize(("skew", "accepted"), [(5e-11, True), (2e-10, False)])
def test_what_is_skew_by_rounding_is_taken_for_symmetric(units, skew, accepted):
    P = np.array([[1.0, 0.3, 0.1], [0.3, 0.5, 0.0], [0.1 + skew, 0.0, 0.6]])
    P *= np.outer(units, units)
    program = QuadraticProgram.unchecked(
        P, np.array(units), np.zeros((0, 3)), np.full(3, -np.inf), np.full(3, np.inf)
    )
    if accepted:
        x = DualActiveSet().solve(program).x * units
        assert x == pytest.approx(
            np.linalg.solve(P / np.outer(units, units), -np.ones(3)), rel=1e-9
        )
    else:
        with pytest.raises(ProblemError, match="symmetric"):
            DualActiveSet().solve(program)


@pytest.mark.parametrize("solver", [DualActiveSet(), PrimalActiveSet()])
def test_what_is_no_program_is_misuse(solver):
    program = QuadraticProgram(EYE, [1.0, 1.0])
    assert solver.solve(tuple(program)).status is Status.SOLVED
    for problem in (solver.solve(program), (EYE, [1.0, 1.0]), None):
        with pytest.raises(ProblemError, match="problem must be QuadraticProgram"):
            solver.solve(problem)


@pytest.mark.parametrize("seed", [15, 39, 62])
def test_a_program_is_not_judged_by_those_of_its_shape_before(seed):
    """Cholesky's method refuses P from its first row on, not from its last."""
    rng = np.random.default_rng(seed)
    root = rng.integers(-9, 10, (2, 3)) / 7.0
    P = root.T @ root
    P += np.diag(np.diagonal(P)) * rng.choice([3e-16, 6e-16, 1e-15])
    free = np.full(3, np.inf)
    no_rows = np.zeros((0, 3))
    program = QuadraticProgram.unchecked(P, P @ np.ones(3), no_rows, -free, free)
    solver = DualActiveSet()
    solver.solve(QuadraticProgram(np.eye(3), np.ones(3)))
    for later_or_first in (solver, DualActiveSet()):
        assert later_or_first.solve(program).status is Status.SOLVED


class TestArraysOfOtherKinds:
    def test_a_matrix_is_solved_as_the_array_it_holds(self):
        with pytest.warns(PendingDeprecationWarning):
            G = np.matrix([[1.0, 1.0]])
        solution = DualActiveSet().solve(
            QuadraticProgram(np.eye(2), [-1.0, -1.0], G, h_upper=[1.0])
        )
        assert solution.status is Status.SOLVED
        assert max(solution.residuals()) < 1e-12
        np.testing.assert_allclose(solution.x, [0.5, 0.5])

    @pytest.mark.parametrize(
        "q",
        [
            [1.0, 2.0 + 1j],
            np.ma.masked_array([1.0, 2.0], mask=[0, 1]),
            ["1", "2"],
            torch.ones(2, requires_grad=True),
        ],
    )
    def test_numbers_that_are_not_real_or_masked_are_refused(self, q):
        with pytest.raises(ProblemError, match="q must be an array of real numbers"):
            QuadraticProgram(np.eye(2), q)

    def test_rows_of_unlike_length_are_refused(self):
        with pytest.raises(ProblemError, match="P must be a matrix"):
            QuadraticProgram([[1.0], [0.0, 1.0]], [1.0, 1.0])
        with pytest.raises(ProblemError, match="P must be a matrix"):
            DualActiveSet().prepare([[1.0], [0.0, 1.0]])

    @pytest.mark.parametrize("solver", [DualActiveSet, PrimalActiveSet])
    @pytest.mark.parametrize("limit", [2.5, np.inf, True, 0])
    def test_a_limit_is_a_whole_number(self, solver, limit):
        with pytest.raises(ProblemError, match="whole number"):
            solver(iteration_limit=limit)

    def test_a_prepared_program_is_not_changed_from_outside(self):
        P = np.eye(2)
        G = np.array([[1.0, 0.0]])
        prepared = DualActiveSet().prepare(P, G)
        G[0, 1] = 1.0
        P[0, 0] = 100.0
        bounds = np.array([-np.inf, -np.inf, -np.inf]), np.array([np.inf, np.inf, 1.0])
        solution = prepared.solve(np.array([-2.0, -2.0]), *bounds)
        np.testing.assert_allclose(solution.x, [1.0, 2.0])
        assert max(solution.residuals()) < 1e-12
