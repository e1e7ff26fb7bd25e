"""Compares the errors of two predictors window by window, with intervals.

Windows that overlap have errors that are alike. So blocks of windows are drawn, each
longer than a window, and the ratio of the mean errors is computed anew for every draw
(block bootstrap; Kuensch, 1989).
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gpmpc._dynamics import Array

_DRAWS = 400
_LEVEL = 0.95
_FEWEST_BLOCKS = 8
_DIVERGED = 1e100  # error of what is larger, or not finite
_LARGEST_RATIO = 1e9


@dataclass(frozen=True)
class Comparison:
    """Mean errors of a model over those of another predictor, on the same windows."""

    name: str  #: of the other predictor
    ratio: Array  #: (judged steps, groups)
    low: Array  #: likewise, of the 95 % interval
    high: Array  #: likewise


def compare(
    name: str, distances: Array, others: Array, block: int, seed: int
) -> Comparison:
    """Compares the errors of a model with those of another predictor.

    Args:
        name: Of the other predictor.
        distances: Of the model (W, steps, groups), in the order of time.
        others: Of the other predictor, likewise.
        block: Windows that are drawn together.
        seed: Of the draws.
    """
    count = len(distances)
    block = max(min(block, count // _FEWEST_BLOCKS), 1)
    starts = np.arange(0, count - block + 1)
    rng = np.random.default_rng(seed)
    draws = rng.choice(starts, (_DRAWS, -(-count // block)))
    distances = _at_most_diverged(distances)
    others = _at_most_diverged(others)
    # Sums over all blocks first: a draw then adds few of them.
    sums = _block_sums(distances, block)
    other_sums = _block_sums(others, block)
    ratios = np.stack(
        [_ratio(sums[draw].sum(axis=0), other_sums[draw].sum(axis=0)) for draw in draws]
    )
    tail = (1 - _LEVEL) / 2
    low, high = np.quantile(ratios, [tail, 1 - tail], axis=0)
    ratio = _ratio(distances.mean(axis=0), others.mean(axis=0))
    return Comparison(name, ratio, low, high)


def _at_most_diverged(distances: Array) -> Array:
    """Bounds distances, so that those which are not finite can be summed."""
    return np.minimum(np.nan_to_num(distances, nan=_DIVERGED), _DIVERGED)


def _ratio(errors: Array, other_errors: Array) -> Array:
    """Computes ratios, which are finite and bounded as well."""
    ratio = errors / np.maximum(other_errors, 1e-200)
    return np.minimum(ratio, _LARGEST_RATIO)


def _block_sums(values: Array, block: int) -> Array:
    """Sums values (W, ...) over every block of consecutive windows.

    Each for itself: differences of running sums would lose all that is smaller than
    the rounding of what came before.
    """
    return sliding_window_view(values, block, axis=0).sum(axis=-1)
