import math

import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.metrics import interval_coverage, mean_squared_error, negative_log_predictive_density


def test_the_mean_squared_error_sums_over_outputs_and_averages_over_samples():
    assert mean_squared_error(torch.tensor([[1.0, 2.0], [0.0, 0.0]]), torch.zeros(2, 2)) == 2.5


def test_the_predictive_density_is_the_gaussians():
    mean, variance, observed = torch.randn(5, 3), torch.rand(5, 3) + 0.1, torch.randn(5, 3)
    exact = -torch.distributions.Normal(mean, variance.sqrt()).log_prob(observed).mean()
    assert negative_log_predictive_density(mean, variance, observed) == pytest.approx(float(exact))


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95])
def test_samples_of_the_prediction_are_covered_at_the_level(level):
    mean, variance = torch.randn(20_000, 2), torch.rand(20_000, 2) + 0.1
    observed = mean + variance.sqrt() * torch.randn(20_000, 2)
    assert abs(interval_coverage(mean, variance, observed, level) - level) < 4 * math.sqrt(level * (1 - level) / 40_000)
    assert interval_coverage(mean, variance / 4, observed, level) < level - 0.1


def test_a_level_outside_zero_and_one_is_refused():
    with pytest.raises(SettingError, match="level: must lie between 0 and 1; got 95"):
        interval_coverage(torch.zeros(1, 1), torch.ones(1, 1), torch.zeros(1, 1), 95)
