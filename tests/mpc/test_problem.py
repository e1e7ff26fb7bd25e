import math

import numpy as np
import pytest

from gpmpc.exceptions import SettingError
from gpmpc.mpc import Box, Halfspaces, Inequality, Problem, Tracking


def test_diagonals_and_matrices_mean_the_same():
    a = Tracking([1.0, 2.0], [3.0])
    b = Tracking(np.diag([1.0, 2.0]), [[3.0]], terminal=[1.0, 2.0])
    assert all(
        np.array_equal(getattr(a, key), getattr(b, key))
        for key in ("Q", "R", "terminal")
    )
    assert (Problem(a).state_dim, Problem(a).input_dim) == (2, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"Q": [1.0, -1.0]},
            "Q: must be positive semidefinite; its smallest eigenvalue is -1",
        ),
        ({"Q": [[1.0, 0.5], [0.0, 1.0]]}, "Q: must be symmetric"),
        ({"Q": [[1.0, 0.5]]}, "Q: must be the diagonal of a weight or a square matrix"),
        ({"Q": ["a", "b"]}, "Q: must be the diagonal"),
        ({"Q": [np.nan, 1.0]}, "Q: must be finite"),
        ({"R": [0.0]}, "R: must be positive definite; its smallest eigenvalue is 0"),
        ({"terminal": [1.0]}, "terminal: must be a weight of 2 states; got 1"),
        (
            {"penalized": "rates"},
            "penalized: must be one of 'inputs', 'deviations', 'increments'; "
            "got 'rates'",
        ),
    ],
)
def test_a_cost_that_makes_no_sense_is_refused(arguments, message):
    with pytest.raises(SettingError, match=message):
        Tracking(**({"Q": [1.0, 1.0], "R": [1.0]} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cost": (1, 2)}, r"cost: must be Tracking\(...\); got tuple"),
        ({"inputs": Box([1.0, 2.0])}, "inputs: must bound 1 inputs; got 2"),
        ({"outputs": [Box([1.0])]}, r"outputs: must be LeastSquares\(...\); got Box"),
        ({"inputs": [-1, 1]}, r"inputs: must be Box\(lower, upper\); got list"),
        (
            {"inputs": Box([-1.0], probability=0.9)},
            "inputs: has bounds that are always kept",
        ),
        (
            {"input_rates": Box([-1.0], penalty=None)},
            "input_rates: has bounds that are always kept",
        ),
        (
            {"constraints": [Box([0.0], [1.0])]},
            "constraints: must bound 2 states; got 1",
        ),
        (
            {"constraints": [Halfspaces([[1.0]], [1.0])]},
            "constraints: must bound 2 states; got 1",
        ),
        (
            {"constraints": [(-1, 1)]},
            r"must be Box\(...\), Halfspaces\(...\) or Inequality\(...\); got tuple",
        ),
    ],
)
def test_a_problem_that_makes_no_sense_is_refused(arguments, message):
    with pytest.raises(SettingError, match=message):
        Problem(**({"cost": Tracking([1.0, 1.0], [1.0])} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lower": [2.0]}, "must not cross; entry 0 has 2 above 1"),
        (
            {"lower": [[0.0], [2.0]], "upper": [[1.0], [1.0]]},
            "must not cross; entry 0 has 2 above 1",
        ),
        ({"lower": [math.inf], "upper": [math.inf]}, "lower: no number keeps it"),
        ({"lower": [-math.inf], "upper": [-1e20]}, "upper: no number keeps it"),
        ({"lower": [0.0, 0.0]}, "upper: must be a list of 2 numbers"),
        ({"lower": 0.0}, "lower: must be a list of numbers"),
        ({"lower": [math.nan]}, "lower: must be a list of 1 numbers"),
        ({"probability": 0.5}, r"probability: must lie in \(0.5, 1\); got 0.5"),
        ({"probability": 1.0}, r"probability: must lie in \(0.5, 1\); got 1.0"),
        ({"joint": True}, "joint: needs a probability"),
        ({"kappa": -1.0}, "kappa: must be a number, 0 or more"),
        ({"penalty": 0.0}, "penalty: must be a number above 0"),
        ({"stages": range(3)}, "stages: must be whole numbers from 1 on"),
        ({"stages": 4}, "stages: must be whole numbers from 1 on"),
    ],
)
def test_bounds_that_make_no_sense_are_refused(arguments, message):
    with pytest.raises(SettingError, match=message):
        Box(**({"lower": [0.0], "upper": [1.0]} | arguments))


@pytest.mark.parametrize(
    "arguments",
    [([1.0], [1.0]), ([[1.0]], [1.0, 2.0]), ([[0.0]], [1.0]), ([[1.0]], [math.inf])],
)
def test_halfspaces_that_make_no_sense_are_refused(arguments):
    with pytest.raises(SettingError, match="F, f: must be"):
        Halfspaces(*arguments)


def test_kappa_is_the_quantile_of_the_probability_unless_given():
    assert Box([0.0], [1.0], probability=0.95).standard_deviations() == pytest.approx(
        1.6448536269514722, abs=1e-12
    )
    assert Box([0.0], [1.0], probability=0.95, kappa=2.0).standard_deviations() == 2.0
    assert Box([0.0], [1.0]).standard_deviations() == 0.0
    joint = Box([0.0], [1.0], probability=0.9, joint=True).standard_deviations(sides=10)
    assert joint == pytest.approx(2.3263478740408408, abs=1e-12)  # 0.99 each


def test_the_penalty_is_infinite_as_given_or_above_any_weight():
    problem = Problem(Tracking([1.0, 200.0], [3.0]))
    units = np.eye(2)
    assert (problem.prices(Box([0.0] * 2, penalty=None), units) == math.inf).all()
    assert (problem.prices(Box([0.0] * 2, penalty=7.0), units) == 7.0).all()
    assert (problem.prices(Box([0.0] * 2), units) == 1e6 * 200.0).all()


def test_an_exact_price_is_of_a_distance_at_any_scale_of_rows():
    problem = Problem(Tracking([1.0, 200.0], [3.0]))
    F = np.array([[3e-6, 4e-6], [0.0, -1e3]])
    for penalty in ("elastic", "exact"):
        planes = Halfspaces(F, [1.0, 1.0], penalty=penalty)
        prices = problem.prices(planes, planes.F)
        assert prices == pytest.approx([1e6 * 200.0 / 5e-6, 1e6 * 200.0 / 1e3])
    declared = Halfspaces(F, [1.0, 1.0], penalty=7.0)
    assert (problem.prices(declared, declared.F) == 7.0).all()
    disc = Inequality(lambda x: 1.0 - x[:, :1], penalty="exact")
    assert (problem.prices(disc, disc.rows(5).F) == 1e6 * 200.0).all()


@pytest.mark.parametrize(
    ("rates", "limited"),
    [
        (Box(), False),
        (Box([-1.0, -1.0], [1.0, 1.0]), True),
        (Box([-math.inf, -1.0]), True),
        (Box(None, [2.0, math.inf]), True),
        (Box([-math.inf] * 2, [math.inf] * 2), False),
    ],
)
def test_one_bound_on_one_increment_is_a_rate_limit(rates, limited):
    problem = Problem(Tracking([1.0], [1.0, 1.0]), Box([-1.0, -1.0]), rates)
    assert problem.input_rates.finite is limited


def test_without_bounds_everything_is_free_and_bounds_may_touch():
    free = Problem(Tracking([1.0], [1.0, 1.0]))
    for box in (free.inputs, free.input_rates):
        assert np.array_equal(box.lower, [-math.inf] * 2)
        assert np.array_equal(box.upper, [math.inf] * 2)
    assert Problem(Tracking([1.0], [1.0]), Box([0.3], [0.3])).inputs.lower[0] == 0.3


def test_bounds_are_given_for_one_stage_or_for_every_stage():
    assert np.array_equal(Box([1.0, 2.0], [3.0, 4.0]).by_stage(3)[1], [[3.0, 4.0]] * 3)
    assert np.array_equal(Box([[1.0], [2.0]]).by_stage(2)[0], [[1.0], [2.0]])
    with pytest.raises(
        SettingError, match="lower: must be given for one stage or all 3; got 2"
    ):
        Box([[1.0], [2.0]]).by_stage(3)


@pytest.mark.parametrize("skew", [1e-13, 1e-6])
def test_a_weight_may_be_skew_by_round_off_and_no_more(skew):
    for scale in (1e-6, 1.0, 1e6):
        weight = scale * np.array([[1.0, 0.5], [0.5 * (1 + skew), 1.0]])
        if skew < 1e-12:
            assert len(Tracking(weight, [1.0]).Q) == 2
        else:
            with pytest.raises(SettingError, match="Q: must be symmetric"):
                Tracking(weight, [1.0])


def test_a_computed_weight_is_symmetric_but_for_rounding():
    # Sums that cancel leave other digits on both sides, as of M.T @ Q @ M.
    weight = np.array([[0.5, 1e-17], [2e-17, 1.6]])
    assert np.array_equal(Tracking(weight, [1.0]).Q, weight)
    # States of other units: an entry of one is off by a tenth.
    skew = np.array([[1e10, 0.5], [0.6, 1e-10]])
    with pytest.raises(SettingError, match="Q: must be symmetric"):
        Tracking(skew, [1.0])


@pytest.mark.parametrize("unit", [1e-13, 1.0, 1e13])
def test_a_negative_weight_is_refused_in_any_unit(unit):
    with pytest.raises(SettingError, match="Q: must be positive semidefinite"):
        Tracking([unit, -0.5 * unit], [1.0])


def test_stages_may_be_an_array():
    assert Box([-1.0], [1.0], stages=np.arange(2, 5)).stages == (2, 3, 4)
