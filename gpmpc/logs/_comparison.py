"""Compares the errors of two predictors window by window, with intervals.

Windows that overlap have errors that are alike. So blocks of windows are drawn, each
longer than a window, and the ratio of the mean errors is computed anew for every draw
(block bootstrap; Kuensch, 1989).
"""

from dataclasses import dataclass

import numpy as np

from gpmpc._dynamics import Array

_DRAWS = 400
_LEVEL = 0.95
_FEWEST_BLOCKS = 8


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
    # Sums over all blocks first: a draw then adds few of them.
    sums = _block_sums(distances, block)
    other_sums = _block_sums(others, block)
    ratios = np.stack(
        [
            sums[draw].sum(axis=0) / np.maximum(other_sums[draw].sum(axis=0), 1e-300)
            for draw in draws
        ]
    )
    tail = (1 - _LEVEL) / 2
    low, high = np.quantile(ratios, [tail, 1 - tail], axis=0)
    ratio = distances.mean(axis=0) / np.maximum(others.mean(axis=0), 1e-300)
    return Comparison(name, ratio, low, high)


def _block_sums(values: Array, block: int) -> Array:
    """Sums values (W, ...) over every block of consecutive windows."""
    sums = np.cumsum(values, axis=0)
    before = np.concatenate([np.zeros_like(sums[:1]), sums[:-block]])
    return sums[block - 1 :] - before
