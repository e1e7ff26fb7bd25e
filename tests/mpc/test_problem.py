import math

import numpy as np
import pytest

from gpmpc.exceptions import SettingError
from gpmpc.mpc.problem import StateBounds, TrackingProblem


def test_diagonals_and_matrices_mean_the_same():
    a = TrackingProblem([1.0, 2.0], [3.0])
    b = TrackingProblem(np.diag([1.0, 2.0]), [[3.0]], terminal=[1.0, 2.0])
    assert all(np.array_equal(getattr(a, key), getattr(b, key)) for key in ("Q", "R", "terminal"))
    assert (a.state_dim, a.input_dim, a.rate_limited) == (2, 1, False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"Q": [1.0, -1.0]}, "Q: must be positive semidefinite; its smallest eigenvalue is -1"),
        ({"Q": [[1.0, 0.5], [0.0, 1.0]]}, "Q: must be symmetric"),
        ({"Q": [[1.0, 0.5]]}, "Q: must be the diagonal of a weight or a square matrix"),
        ({"Q": ["a", "b"]}, "Q: must be the diagonal"),
        ({"Q": [np.nan, 1.0]}, "Q: must be finite"),
        ({"R": [0.0]}, "R: must be positive definite; its smallest eigenvalue is 0"),
        ({"terminal": [1.0]}, "terminal: must be a weight of 2 states; got 1"),
        ({"penalized": "rates"}, "penalized: must be 'inputs', 'deviations' or 'increments'; got 'rates'"),
        ({"input_lower": [2.0], "input_upper": [1.0]}, "must not cross; entry 0 has 2 above 1"),
        ({"input_lower": [math.inf]}, "input_lower: no number keeps it"),
        ({"rate_upper": [-1e20]}, "rate_upper: no number keeps it"),
        ({"rate_upper": [1.0, 2.0]}, "rate_upper: must be a list of 1 numbers"),
        ({"state_bounds": StateBounds([0.0], [1.0])}, "state_bounds: must bound 2 states; got 1"),
    ],
)
def test_a_problem_that_makes_no_sense_is_refused(arguments, message):
    with pytest.raises(SettingError, match=message):
        TrackingProblem(**({"Q": [1.0, 1.0], "R": [1.0]} | arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lower": [2.0]}, "must not cross"),
        ({"lower": [math.inf], "upper": [math.inf]}, "lower: no number keeps it"),
        ({"lower": [-math.inf], "upper": [-math.inf]}, "upper: no number keeps it"),
        ({"confidence": 0.5}, r"eta must lie in \(0.5, 1\); got 0.5"),
        ({"confidence": 1.0}, r"eta must lie in \(0.5, 1\); got 1.0"),
        ({"kappa": -1.0}, "kappa: must be a number, 0 or more"),
        ({"l1": 0.0}, "l1: must be a number above 0"),
        ({"l2": -3.0}, "l2: must be a number above 0"),
    ],
)
def test_state_bounds_that_make_no_sense_are_refused(arguments, message):
    with pytest.raises(SettingError, match=message):
        StateBounds(**({"lower": [0.0], "upper": [1.0]} | arguments))


def test_kappa_is_the_quantile_of_the_confidence_unless_given():
    assert StateBounds([0.0], [1.0], 0.95).kappa == pytest.approx(1.6448536269514722, abs=1e-12)
    assert StateBounds([0.0], [1.0], 0.95, kappa=2.0).kappa == 2.0
    assert not StateBounds([0.0], [math.inf]).soft
    assert StateBounds([0.0], [math.inf], l2=1.0).soft


@pytest.mark.parametrize(
    ("bounds", "limited"),
    [
        ({}, False),
        ({"rate_lower": [-1.0, -1.0], "rate_upper": [1.0, 1.0]}, True),
        ({"rate_lower": [-math.inf, -1.0]}, True),
        ({"rate_upper": [2.0, math.inf]}, True),
        ({"rate_lower": [-math.inf] * 2, "rate_upper": [math.inf] * 2}, False),
        ({"input_lower": [-1.0, -1.0]}, False),
    ],
)
def test_one_bound_on_one_increment_is_a_rate_limit(bounds, limited):
    assert TrackingProblem([1.0], [1.0, 1.0], **bounds).rate_limited is limited


def test_without_bounds_everything_is_free_and_bounds_may_touch():
    free = TrackingProblem([1.0], [1.0, 1.0])
    for key, value in (("input_lower", -math.inf), ("input_upper", math.inf), ("rate_lower", -math.inf)):
        assert np.array_equal(getattr(free, key), [value, value])
    assert np.array_equal(free.rate_upper, [math.inf, math.inf])
    assert TrackingProblem([1.0], [1.0], input_lower=[0.3], input_upper=[0.3]).input_lower[0] == 0.3
    assert StateBounds([0.3], [0.3]).upper[0] == 0.3


@pytest.mark.parametrize("skew", [1e-13, 1e-6])
def test_a_weight_may_be_skew_by_round_off_and_no_more(skew):
    for scale in (1e-6, 1.0, 1e6):
        weight = scale * np.array([[1.0, 0.5], [0.5 * (1 + skew), 1.0]])
        if skew < 1e-12:
            assert TrackingProblem(weight, [1.0]).state_dim == 2
        else:
            with pytest.raises(SettingError, match="Q: must be symmetric"):
                TrackingProblem(weight, [1.0])
