"""Brings inputs to rows that are farther apart than their samples.

A model holds the input of a row until the next one. Where an input changes in between,
no single sample is what acted: the mean is, as far as the system is linear.
"""

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._resampling import Samples

FEWEST_SAMPLES = 1.5  # for each row, from which on samples lie between rows
# Of the spread of an input, in the root mean square: one that departs by more, from its
# held value and from a straight line, changes between rows.
LARGEST_CHANGE = 0.1


def changes_between_rows(samples: Samples, rows: Samples, step: float) -> bool:
    """Tells whether what an input does between rows is neither held nor a slope.

    A command that is held from row to row is in its rows, and a smooth input nearly so.

    Args:
        samples: Of the input.
        rows: What the rows hold of it, the last sample of each.
        step: From one row to the next [s].
    """
    own_step = samples.usual_step
    if not 0 < FEWEST_SAMPLES * own_step <= step or len(rows.time) < 2:
        return False
    row = np.searchsorted(rows.time, samples.time, side="right") - 1
    row = np.clip(row, 0, len(rows.time) - 2)
    elapsed = samples.time - rows.time[row]
    is_between = (elapsed >= 0) & (elapsed < step)
    is_between &= rows.time[row + 1] - rows.time[row] < FEWEST_SAMPLES * step
    row = row[is_between]
    fraction = (elapsed[is_between] / step)[:, None]
    from_row = samples.values[is_between] - rows.values[row]
    slope = rows.values[row + 1] - rows.values[row]
    from_slope = from_row - fraction * slope
    usable = np.isfinite(from_slope).all(axis=1)
    if not usable.any():
        return False
    # of a whole column, from the held value or from the line: from what is nearer
    departure = np.minimum(_size(from_row[usable]), _size(from_slope[usable]))
    spread = np.nanstd(samples.values, axis=0)
    return bool((departure > LARGEST_CHANGE * spread).any())


def _size(deviations: Array) -> Array:
    """Returns the root mean square of deviations (K, c) by column (c,)."""
    return np.sqrt((deviations**2).mean(axis=0))


def held_means(samples: Samples, begins: Array, step: float, max_gap: float) -> Array:
    """Computes the means (G, c) of a held input over steps that begin at times (G,).

    Args:
        samples: Of the input; each acts until the next one.
        begins: Of the steps [s].
        step: Their length [s].
        max_gap: For which a sample may act [s]; the mean is NaN where one acts longer.
    """
    time = samples.time[samples.present]
    values = samples.values[samples.present]
    if not len(time):
        return np.full((len(begins), values.shape[1]), np.nan)
    ends = begins + step
    resolution = samples.resolution
    first = np.searchsorted(time, begins + resolution, side="right") - 1
    last = np.searchsorted(time, ends - resolution, side="right") - 1
    is_before_all = first < 0
    first = np.maximum(first, 0)
    last = np.maximum(last, 0)
    steps = np.diff(time)
    middle = values.mean(axis=0)  # about which sums lose no digits
    parts = (values[:-1] - middle) * steps[:, None]
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(parts, axis=0)])
    until_begin = (
        sums[first] + (values[first] - middle) * (begins - time[first])[:, None]
    )
    until_end = sums[last] + (values[last] - middle) * (ends - time[last])[:, None]
    means = middle + (until_end - until_begin) / step

    long_steps = np.concatenate([[0], np.cumsum(steps > max_gap)])
    is_held_too_long = (
        (begins - time[first] > max_gap)
        | (ends - time[last] > max_gap)
        | (long_steps[last] > long_steps[first])
    )
    means[is_before_all | is_held_too_long] = np.nan
    return means
