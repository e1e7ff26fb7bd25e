"""Finds delays between the channels of a table by the correlation of their differences.

Delays are sought block by block, so that clocks that wander are seen. A slow
oscillation is correlated with any other at some delay; a delay has a sharp peak.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gpmpc._dynamics import Array

BLOCKS = 16
BLOCK_ROWS = 4096  # at most
LARGEST_LAG = 50  # rows
MOST_CHANNELS = 64  # that are compared in pairs: more take minutes and gigabytes
SHARP = 10  # rows within which a peak falls by a fifth
CORRELATED = 0.5  # from which a delay says something
_COLUMNS = [
    "channel",
    "later channel",
    "rows",
    "lowest",
    "highest",
    "agreement",
    "correlation",
]


class Delay(NamedTuple):
    """A delay [rows] of one channel behind another, over all blocks."""

    channel: str
    later_channel: str
    rows: float  # median; negative where the later channel comes earlier
    lowest: float
    highest: float
    agreement: float  # share of the blocks that agree to a row
    correlation: float  # of the differences

    @property
    def warning(self) -> str:
        """Says that a channel is late; empty where it is not."""
        if abs(self.rows) < 1 and self.highest - self.lowest <= 2:
            return ""
        side = "before" if self.rows < 0 else "after"
        return (
            f"{self.later_channel} comes {abs(self.rows):g} rows {side} {self.channel} "
            f"({self.lowest:g} to {self.highest:g}; {self.agreement:.0%} of the blocks "
            "agree)"
        )


def delay_table(delays: Sequence[Delay]) -> pd.DataFrame:
    """Makes a table with a row for each delay."""
    return pd.DataFrame(delays, columns=_COLUMNS)


def find_delays(names: Sequence[str], values: Array) -> list[Delay]:
    """Finds the delays of all pairs of channels whose differences are correlated.

    Args:
        names: Of the channels; of those that move, the first ``MOST_CHANNELS`` are
            compared.
        values: Of the channels (K, c); NaN where a value is missing.
    """
    moving = moving_channels(values)[:MOST_CHANNELS]
    if not len(moving):
        return []
    moving_names = [names[int(channel)] for channel in moving]
    length = min(BLOCK_ROWS, len(values) // 8)
    steps = _differences(_without_units(values[:, moving]), length)
    norms = np.linalg.norm(steps, axis=1)
    usable = np.flatnonzero((norms > 0).all(axis=0))
    size = 1 << int(np.ceil(np.log2(steps.shape[1] + LARGEST_LAG)))
    spectra = np.fft.rfft(steps[:, :, usable] / norms[:, None, usable], size, axis=1)
    delays = []
    for i in range(len(usable)):
        correlations = _cross_correlations(spectra, i, size)
        for j in range(correlations.shape[2]):
            delay = _delay_of_pair(
                channel=moving_names[int(usable[i])],
                later_channel=moving_names[int(usable[i + 1 + j])],
                correlations=correlations[:, :, j],
            )
            if delay is not None:
                delays.append(delay)
    return delays


def moving_channels(values: Array) -> NDArray[np.intp]:
    """Returns which channels (K, c) change; none where rows are too few for delays."""
    if min(BLOCK_ROWS, len(values) // 8) < 4 * LARGEST_LAG:
        return np.empty(0, dtype=np.intp)
    lowest = np.where(np.isfinite(values), values, np.inf).min(axis=0)
    highest = np.where(np.isfinite(values), values, -np.inf).max(axis=0)
    return np.flatnonzero(highest > lowest)


def _without_units(values: Array) -> Array:
    """Divides channels by their largest values.

    Correlations have no unit, and of values such as 1e200 the squares would overflow.
    """
    finite = np.isfinite(values)
    largest = np.abs(np.where(finite, values, 0.0)).max(axis=0)
    return np.where(finite, values, np.nan) / np.where(largest > 0, largest, 1.0)


def _differences(values: Array, length: int) -> Array:
    """Returns first differences (b, length - 1, c) in blocks spread over the rows.

    The mean of each block is taken off.
    """
    starts = np.unique(np.linspace(0, len(values) - length, BLOCKS).astype(int))
    blocks = [values[start : start + length] for start in starts]
    steps = np.nan_to_num(np.diff(blocks, axis=1))
    return steps - steps.mean(axis=1, keepdims=True)


def _cross_correlations(
    spectra: NDArray[np.complex128], channel: int, size: int
) -> Array:
    """Returns correlations (b, 2 LARGEST_LAG + 1, others) with all channels behind it.

    Lags go from -LARGEST_LAG to LARGEST_LAG.
    """
    reference = np.conj(spectra[:, :, channel : channel + 1])
    cross = np.fft.irfft(spectra[:, :, channel + 1 :] * reference, size, axis=1)
    return np.concatenate(
        [cross[:, -LARGEST_LAG:], cross[:, : LARGEST_LAG + 1]], axis=1
    )


def _delay_of_pair(
    channel: str, later_channel: str, correlations: Array
) -> Delay | None:
    """Finds the delay of one pair by its correlations (b, lags); None where none."""
    peaks = np.abs(correlations).argmax(axis=1)  # (b,)
    heights = np.take_along_axis(correlations, peaks[:, None], axis=1)[:, 0]
    correlation = float(np.median(heights))
    middle = int(np.clip(np.median(peaks), SHARP, 2 * LARGEST_LAG - SHARP))
    sides = np.median(np.abs(correlations[:, [middle - SHARP, middle + SHARP]]), axis=0)
    is_sharp = sides.max() < 0.8 * abs(correlation)
    if abs(correlation) < CORRELATED or not is_sharp:
        return None
    lags = peaks - LARGEST_LAG
    median = np.median(lags)
    return Delay(
        channel=channel,
        later_channel=later_channel,
        rows=float(median),
        lowest=float(lags.min()),
        highest=float(lags.max()),
        agreement=float((np.abs(lags - median) <= 1).mean()),
        correlation=correlation,
    )
