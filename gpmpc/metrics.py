"""Problem: say in numbers how good predictions are, and whether their stated uncertainty can be believed."""

import math

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError


def mean_squared_error(predicted: Tensor, observed: Tensor) -> float:
    """Squared error summed over the outputs, averaged over the samples; both (N, n)."""
    return float((predicted - observed).square().sum(dim=-1).mean())


def negative_log_predictive_density(mean: Tensor, variance: Tensor, observed: Tensor) -> float:
    """-log N(observed; mean, variance), averaged over samples and outputs; all (N, n). Lower is better.

    Quinonero-Candela et al. (2006), "Evaluating predictive uncertainty challenge".
    """
    return float(((2 * math.pi * variance).log() + (observed - mean).square() / variance).mean() / 2)


def interval_coverage(mean: Tensor, variance: Tensor, observed: Tensor, level: float = 0.95) -> float:
    """Part of the observations inside the central interval of the given level; all (N, n). Ideal is the level."""
    if not 0 < level < 1:
        raise SettingError("level", f"must lie between 0 and 1; got {level}")
    half_width = torch.special.ndtri(torch.tensor((1 + level) / 2, dtype=variance.dtype)) * variance.sqrt()
    return float(((observed - mean).abs() <= half_width).double().mean())
