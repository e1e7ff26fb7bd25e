"""Compares the errors of two predictors window by window, with intervals.

Windows that overlap have errors that are alike. So blocks of windows are drawn, each
longer than a window, and the ratio of the mean errors is computed anew for every draw
(block bootstrap; Kuensch, 1989). Of few independent predictions the draws are too much
alike: their interval is widened as Student's t distribution is, and of fewer than four
nothing is said.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtri, stdtrit

from gpmpc._dynamics import Array
from gpmpc.models._windows import Windows

_DRAWS = 400
_LEVEL = 0.95
_FEWEST_BLOCKS = 8
FEWEST_PREDICTIONS = 4  # that do not overlap: fewer tell nothing from chance
_DIVERGED = 1e100  # error of what is larger, or not finite
_LARGEST_RATIO = 1e9


@dataclass(frozen=True)
class Comparison:
    """Mean errors of a model over those of another predictor, on the same windows."""

    name: str  #: of the other predictor
    ratio: Array  #: (judged steps, groups)
    #: likewise, of the 95 % interval; zero where there are too few rows to tell
    low: Array
    high: Array  #: likewise; infinite there


def compare(
    name: str,
    distances: Array,
    others: Array,
    block: int,
    independent: Sequence[float] | Array,
    seed: int,
) -> Comparison:
    """Compares the errors of a model with those of another predictor.

    Args:
        name: Of the other predictor.
        distances: Of the model (W, steps, groups), in the order of time.
        others: Of the other predictor, likewise.
        block: Windows that are drawn together.
        independent: Number of predictions that do not overlap, by judged step.
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
    widening = _student(independent)[:, None]
    is_told = np.isfinite(widening)
    widening = np.where(is_told, widening, 1.0)
    size = np.maximum(ratio, 1e-200)
    low = size * np.minimum(low / size, 1.0) ** widening
    high = np.minimum(size * np.maximum(high / size, 1.0) ** widening, _LARGEST_RATIO)
    return Comparison(
        name, ratio, np.where(is_told, low, 0.0), np.where(is_told, high, np.inf)
    )


def independent_predictions(windows: Windows, steps: Sequence[int]) -> Array:
    """Counts the predictions (steps,) that say something of their own.

    In each piece that is one, and as many more as fit into the rows of its starts; a
    part of one counts as a part.

    Args:
        windows: From whose starts is predicted.
        steps: After the starts.
    """
    stride = windows.stride
    starts = stride * (_windows_of_pieces(windows) - 1) + 1
    return predictions_of_pieces(starts, np.maximum(steps, stride))


def predictions_of_pieces(starts: Array, steps: Array) -> Array:
    """Counts the predictions (steps,) of pieces that say something of their own.

    Args:
        starts: Rows from the first to the last start of each piece (pieces,), one at
            least.
        steps: After the starts (steps,).
    """
    return (1 + (starts - 1) / steps[:, None]).sum(axis=1)


def _windows_of_pieces(windows: Windows) -> Array:
    """Counts the windows of each piece (pieces,).

    Neighbours in a piece are a stride apart, those of two pieces all of a window.
    """
    apart = max(windows.past + windows.ahead + 1, windows.stride)
    rows = np.diff(windows.times) / windows.time_step
    begins_piece = (np.diff(windows.runs) != 0) | (rows > (apart + windows.stride) / 2)
    begins = np.flatnonzero(np.r_[True, begins_piece])
    return np.diff([*begins, len(windows)])


def effective_number(values: Array, runs: np.ndarray) -> float:
    """Computes how many independent values a mean of correlated ones is as good as.

    That is N / (1 + 2 sum of autocorrelations), these summed in pairs of neighbouring
    lags up to the first pair that is not positive (Geyer, 1992, Practical Markov chain
    Monte Carlo: initial positive sequence).

    Args:
        values: N of them, in the order of time within each run (N,).
        runs: Number of the run that each is of; runs tell nothing of each other (N,).
    """
    count = len(values)
    deviations = values - values.mean()
    autocovariances = np.zeros(count + count % 2)
    for run in np.unique(runs):
        own = deviations[runs == run]
        spectrum = np.abs(np.fft.rfft(own, 2 * len(own))) ** 2
        autocovariances[: len(own)] += np.fft.irfft(spectrum)[: len(own)]
    if autocovariances[0] <= 0:
        return float(count)
    pairs = autocovariances.reshape(-1, 2).sum(axis=1) / autocovariances[0]
    positive = np.logical_and.accumulate(pairs > 0)
    return count / max(2 * pairs[positive].sum() - 1, 1.0)


def _student(independent: Sequence[float] | Array) -> Array:
    """Returns by how much the logarithms of intervals (steps,) are to be longer.

    That is infinitely where there are too few predictions.
    """
    count = np.asarray(independent, dtype=float)
    probability = (1 + _LEVEL) / 2
    quantile = stdtrit(np.maximum(count - 1, 1.0), probability)
    return np.where(count < FEWEST_PREDICTIONS, np.inf, quantile / ndtri(probability))


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
