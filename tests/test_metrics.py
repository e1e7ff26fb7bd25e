import math

import numpy as np
import pytest
import torch
from scipy import stats

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.metrics import (
    binomial_interval,
    find_loss,
    interval_coverage,
    mean_squared_error,
    negative_log_predictive_density,
    time_quantiles,
    tracking_error,
    violation_rate,
)

AXES = (0, 2, 4)  # x, y, z of the translational states


def test_the_mean_squared_error_sums_outputs_averages_samples():
    assert (
        mean_squared_error(torch.tensor([[1.0, 2.0], [0.0, 0.0]]), torch.zeros(2, 2))
        == 2.5
    )


def test_the_predictive_density_is_the_gaussians():
    mean = torch.randn(5, 3)
    variance = torch.rand(5, 3) + 0.1
    observed = torch.randn(5, 3)
    exact = -torch.distributions.Normal(mean, variance.sqrt()).log_prob(observed).mean()
    assert negative_log_predictive_density(mean, variance, observed) == pytest.approx(
        float(exact)
    )


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95])
def test_samples_of_the_prediction_are_covered_at_the_level(level):
    mean = torch.randn(20_000, 2)
    variance = torch.rand(20_000, 2) + 0.1
    observed = mean + variance.sqrt() * torch.randn(20_000, 2)
    assert abs(
        interval_coverage(mean, variance, observed, level) - level
    ) < 4 * math.sqrt(level * (1 - level) / 40_000)
    assert interval_coverage(mean, variance / 4, observed, level) < level - 0.1


def test_a_level_outside_zero_and_one_is_refused():
    with pytest.raises(SettingError, match="level: must lie between 0 and 1; got 95"):
        interval_coverage(torch.zeros(1, 1), torch.ones(1, 1), torch.zeros(1, 1), 95)


def test_the_tracking_error_leaves_out_the_start():
    states = np.zeros((3, 6))
    references = np.zeros((3, 6))
    states[0] = 100.0  # where nobody steered
    states[1, ::2] = [3, 0, 0]
    states[2, ::2] = [0, 4, 0]
    states[:, 1::2] = 7.0  # velocities are not looked at
    error = tracking_error(states, references, AXES)
    assert np.allclose(error.axes, [np.sqrt(9 / 2), np.sqrt(16 / 2), 0])
    assert error.total == pytest.approx(np.sqrt(25 / 2))
    assert tracking_error(states, references, axes=[1]).total == pytest.approx(7.0)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("shift", [0.0, -3.0])
def test_a_flight_is_lost_where_standing_still_would_be_nearer(scale, shift):
    references = (
        np.outer(np.arange(6.0), [3, 0, 4]) + shift
    )  # 25 from its start in the end
    away = references + np.outer([0, 10, 24, 26, 200, 1], [0, 1, 0])
    loss = find_loss(scale * away, scale * references, axes=range(3))
    assert (loss.step, loss.distance, loss.limit) == (
        3,
        pytest.approx(26 * scale),
        pytest.approx(25 * scale),
    )
    staying = np.tile(references[:1], (6, 1))
    for near in (
        references,
        staying,
        references + np.outer([0, 24, 24, 24, 24, 24], [0, 1, 0]),
    ):
        assert find_loss(scale * near, scale * references, axes=range(3)) is None


def test_a_hover_is_lost_beyond_the_least_distance_or_by_nan():
    references = np.zeros((4, 6))
    drifting = np.outer(
        np.arange(4.0), [1, 50, 0, 50, 0, 50]
    )  # velocities are not looked at
    assert find_loss(drifting, references, AXES, least=3.0) is None
    assert find_loss(drifting, references, AXES, least=1.5).step == 2
    drifting[1, 0] = np.nan
    assert find_loss(drifting, references, AXES, least=1.5).step == 1
    assert (
        find_loss(
            np.outer([0, 1, 1e300, 1e308], np.ones(6)), references, AXES, least=2.0
        ).step
        == 2
    )


def test_errors_of_angles_are_taken_within_half_a_turn():
    turned = np.array([[3.0, 0.0], [2 * np.pi + 0.1, 0.0], [-2 * np.pi - 0.1, 0.0]])
    upright = np.zeros((3, 2))
    assert tracking_error(turned, upright, [0], angles=[0]).total == pytest.approx(0.1)
    assert find_loss(turned, upright, [0], angles=[0]) is None
    assert find_loss(turned, upright, [0]).step == 1


def test_coming_back_from_a_distant_start_is_no_loss():
    approaching = np.outer([9.0, 5.0, -2.0, 0.5], np.ones(6))
    assert find_loss(approaching, np.zeros((4, 6)), AXES) is None
    assert (
        find_loss(-approaching * [[1], [1], [5], [1]], np.zeros((4, 6)), AXES).step == 2
    )


def test_a_violation_is_a_step_with_any_entry_outside():
    values = np.array(
        [[0.0, 0.0], [1.5, -3.0], [1.0 + 1e-12, 0.0], [np.nan, 0.0], [0.0, 5.0]]
    )
    rate = violation_rate(values, [-1.0, -2.0], [1.0, np.inf])
    assert (rate.violations, rate.steps, rate.rate) == (2, 5, 0.4)
    assert (rate.worst, rate.worst_by_entry) == (1.0, (0.5, 1.0))
    assert rate.low < 0.4 < rate.high


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (10, 10), (3, 40), (1, 1)])
def test_the_binomial_interval_is_the_exact_test_turned_round(successes, trials):
    low, high = binomial_interval(successes, trials, 0.9)
    if successes:
        assert stats.binom.sf(successes - 1, trials, low) == pytest.approx(0.05)
    else:
        assert low == 0
    if successes < trials:
        assert stats.binom.cdf(successes, trials, high) == pytest.approx(0.05)
    else:
        assert high == 1


def test_the_quantiles_of_times_are_in_order():
    quantiles = time_quantiles(np.arange(101.0))
    assert quantiles == {"median": 50, "p95": 95, "p99": 99, "largest": 100}


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: find_loss(np.zeros((3, 6)), np.zeros((2, 6)), AXES),
            ShapeError,
            "states and references must both be",
        ),
        (
            lambda: tracking_error(np.zeros((3, 6)), np.zeros((2, 6)), AXES),
            ShapeError,
            r"got \(3, 6\) and \(2, 6\)",
        ),
        (
            lambda: violation_rate(np.zeros((3, 2)), [0], [1]),
            ShapeError,
            r"bounds \(d,\).*got \(3, 2\), \(1,\)",
        ),
        (
            lambda: binomial_interval(3, 2),
            SettingError,
            "successes: must lie between 0 and trials",
        ),
        (lambda: time_quantiles(np.zeros(0)), ShapeError, r"seconds must be \(K,\)"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_a_bound_is_kept_up_to_the_tolerance_on_either_side():
    lower = np.array([-1.0, -np.inf])
    upper = np.array([1.0, 2.0])
    for sign, entry, bound in ((-1, 0, -1.0), (1, 0, 1.0), (1, 1, 2.0)):
        values = np.zeros((4, 2))
        values[:, entry] = bound + sign * np.array([-0.5, 0.0, 0.9e-6, 1.1e-6])
        rate = violation_rate(values, lower, upper, tolerance=1e-6)
        assert (rate.violations, rate.steps) == (1, 4)
        assert rate.worst == pytest.approx(1.1e-6)
    assert violation_rate(np.full((3, 2), 0.5), lower, upper).worst == 0


def test_the_interval_of_a_violation_rate_is_the_binomial_one():
    rate = violation_rate(np.array([0.0] * 37 + [2.0] * 3)[:, None], [-1.0], [1.0])
    exact = stats.binomtest(3, 40).proportion_ci(0.95, method="exact")
    assert (rate.low, rate.high) == pytest.approx((exact.low, exact.high))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: violation_rate(np.zeros((3, 2)), [0, 1], [1, 0]),
            SettingError,
            "entry 1 has 1 above 0",
        ),
        (
            lambda: violation_rate(np.zeros((0, 2)), [0, 0], [1, 1]),
            ShapeError,
            "K of 1 or more",
        ),
        (
            lambda: violation_rate(np.zeros((3, 2)), [0, 0], [1]),
            ShapeError,
            r"got \(3, 2\), \(2,\), \(1,\)",
        ),
        (
            lambda: tracking_error(np.zeros((3, 6)), np.zeros((3, 6)), [6]),
            ShapeError,
            r"from 0 to 5; got \(6,\)",
        ),
        (
            lambda: tracking_error(np.zeros((3, 6)), np.zeros((3, 6)), [-7]),
            ShapeError,
            r"from 0 to 5; got \(-7,\)",
        ),
        (
            lambda: tracking_error(np.zeros((1, 6)), np.zeros((1, 6)), AXES),
            ShapeError,
            "K of 1 or more",
        ),
        (lambda: binomial_interval(0, 0), SettingError, "got 0 of 0"),
        (lambda: binomial_interval(-1, 3), SettingError, "got -1 of 3"),
        (
            lambda: mean_squared_error(torch.zeros(2, 1), torch.zeros(2, 2)),
            ShapeError,
            r"predicted \(2, 1\)",
        ),
        (
            lambda: interval_coverage(*[torch.ones(1, 1)] * 3, 0),
            SettingError,
            "must lie between 0 and 1; got 0",
        ),
    ],
)
def test_what_has_no_answer_is_refused_with_the_rule(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_axes_may_be_counted_from_the_end():
    states = np.arange(18.0).reshape(3, 6)
    last = tracking_error(states, np.zeros((3, 6)), [-1, 0])
    assert np.array_equal(
        last.axes, tracking_error(states, np.zeros((3, 6)), [5, 0]).axes
    )
