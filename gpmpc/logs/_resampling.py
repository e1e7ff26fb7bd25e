"""Makes one grid of times for all topics of a run, and resamples values to it.

A grid over a jump of ten days would take all memory, so it is made piece by piece.
"""

from collections.abc import Mapping
from functools import reduce
from typing import NamedTuple

import numpy as np

from gpmpc._angles import wrap
from gpmpc._bounds import MemoryBudget
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._clocks import JUMP, ORDER_TOPICS, Stamps, find_jumps
from gpmpc.logs._file import NUMBER_BYTES
from gpmpc.logs._findings import RunFindings
from gpmpc.models._quaternions import (
    quaternion_inverse,
    quaternion_product,
    rotation_quaternion,
    rotation_vector,
)

STAMP_RESOLUTION = 1e-6  # [s]: float64 seconds since 1970 resolve a quarter of it
FINE_RESOLUTION = 0.1  # of the usual step between samples, where that is less
COPIES = 2  # of a grid's values, while signals are put on it


class Grid(NamedTuple):
    """Times (G,) [s] at which a run has rows, and where its pieces begin."""

    time: Array
    breaks: np.ndarray  # (G,) rows that do not go on from the one before


def grid_of_rows(
    stamps: Stamps, columns: int, max_gap: float | None, budget: MemoryBudget
) -> Grid:
    """Takes the stamps of a single table as they are.

    Args:
        stamps: Of its rows.
        columns: How many will be put on the grid.
        max_gap: From the mapping [s].
        budget: What the rows will take is taken from it.
    """
    rows = len(stamps.time)
    budget.take(_memory(rows, columns), f"{rows} rows of {columns} columns")
    return Grid(stamps.time, _begins_piece(stamps, max_gap))


def grid_at_rate(
    pieces: Array,
    rate: float,
    columns: int,
    max_gap: float | None,
    budget: MemoryBudget,
) -> Grid:
    """Makes equal time steps in pieces.

    Args:
        pieces: Their begins and ends (P, 2) [s].
        rate: [Hz].
        columns: How many will be put on the grid.
        max_gap: From the mapping [s], for errors.
        budget: What the rows will take is taken from it.

    Raises:
        DataError: The grid would be too large.
    """
    steps = (pieces[:, 1] - pieces[:, 0]) * rate * (1 + 1e-12)
    resolution_in_steps = min(STAMP_RESOLUTION * rate, FINE_RESOLUTION)
    lengths = np.floor(steps + resolution_in_steps) + 1
    rows = float(lengths.sum())
    description = f"{rows:.6g} rows of {columns} columns at a rate of {rate:g} Hz"
    if (max_gap or 0.0) > JUMP:
        description += f", with gaps of up to {max_gap:g} s (max_gap),"
    budget.take(_memory(rows, columns), description)

    counts = lengths.astype(int)
    first_rows = np.r_[0, np.cumsum(lengths)[:-1]].astype(int)
    begins = np.repeat(pieces[:, 0], counts)
    row_in_piece = np.arange(len(begins)) - np.repeat(first_rows, counts)
    breaks = np.zeros(len(begins), dtype=bool)
    breaks[first_rows[1:]] = True
    return Grid(begins + row_in_piece / rate, breaks)


def _memory(rows: float, columns: int) -> float:
    """Returns what a run's rows take while they are worked on [bytes]."""
    return rows * columns * COPIES * NUMBER_BYTES


def common_pieces(
    stamps: Mapping[str, Stamps],
    max_gap: float | None,
    where: str,
    findings: RunFindings,
) -> Array:
    """Finds the pieces (C, 2) [s] that all topics have in common.

    Args:
        stamps: By topic.
        max_gap: From the mapping [s].
        where: Names the file and the run, for errors.
        findings: Takes how many rows have no time in common with others.

    Raises:
        DataError: There is none.
    """
    pieces = {
        topic: cut_pieces(topic_stamps, max_gap)
        for topic, topic_stamps in stamps.items()
    }
    common = reduce(intersect_pieces, pieces.values())
    if not len(common):
        hint = f": {ORDER_TOPICS}" if any(stamps) else ""
        raise DataError(
            f"{where}: the topics {', '.join(stamps)} have no time in common{hint}"
        )
    for topic, pieces_of_topic in pieces.items():
        count = count_rows_alone(stamps[topic].time, pieces_of_topic, common)
        text = f"{count} rows of {topic} have no time in common with others: left out"
        findings.add("no time in common", count, text)
    return common


def cut_pieces(stamps: Stamps, max_gap: float | None) -> Array:
    """Returns begins and ends (P, 2) [s] of the pieces of a run."""
    time = stamps.time
    first_rows = np.flatnonzero(_begins_piece(stamps, max_gap))
    begins = time[np.r_[0, first_rows]]
    ends = time[np.r_[first_rows - 1, len(time) - 1]]
    return np.column_stack([begins, ends])


def _begins_piece(stamps: Stamps, max_gap: float | None) -> np.ndarray:
    """Tells before which rows (K,) time jumped, or does not go on (``Stamps``)."""
    begins = stamps.starts_piece.copy()
    begins[find_jumps(stamps.time, max_gap) + 1] = True
    return begins


def intersect_pieces(pieces: Array, others: Array) -> Array:
    """Intersects two lists of pieces (P, 2) in the order of time; returns (C, 2)."""
    common = []
    i = 0
    j = 0
    while i < len(pieces) and j < len(others):
        begin = max(pieces[i, 0], others[j, 0])
        end = min(pieces[i, 1], others[j, 1])
        if begin < end:
            common.append((begin, end))
        if pieces[i, 1] < others[j, 1]:
            i += 1
        else:
            j += 1
    return np.array(common).reshape(-1, 2)


def count_rows_alone(time: Array, pieces: Array, common: Array) -> int:
    """Counts the rows of a topic in pieces (P, 2) of which nothing is in common."""
    # the first common piece that ends after the begin of each
    candidates = np.searchsorted(common[:, 1], pieces[:, 0])
    nearest = common[np.minimum(candidates, len(common) - 1)]
    is_alone = (nearest[:, 1] < pieces[:, 0]) | (nearest[:, 0] > pieces[:, 1])
    ends = np.searchsorted(time, pieces[:, 1], side="right")
    rows = ends - np.searchsorted(time, pieces[:, 0])
    return int(rows[is_alone].sum())


class Samples(NamedTuple):
    """Values of a signal at increasing times."""

    time: Array  # (K,) [s]
    values: Array  # (K, c); those with a NaN are no samples

    @property
    def present(self) -> np.ndarray:
        """The rows (K,) that are samples."""
        return np.asarray(np.isfinite(self.values).all(axis=1))

    @property
    def usual_step(self) -> float:
        """The median time between samples [s]; zero where there are less than two."""
        steps = np.diff(self.time[self.present])
        return float(np.median(steps)) if len(steps) else 0.0

    @property
    def resolution(self) -> float:
        """The time [s] by which a sample may be later than a row that has it."""
        usual_step = self.usual_step
        if not usual_step:
            return STAMP_RESOLUTION
        return min(STAMP_RESOLUTION, FINE_RESOLUTION * usual_step)

    def column(self, index: int) -> "Samples":
        """Returns the samples of one column."""
        return Samples(self.time, self.values[:, index : index + 1])


class Interpolation(NamedTuple):
    """How the values between samples are found."""

    #: "hold" takes the last sample, "linear" interpolates, "spherical" interpolates
    #: quaternions.
    rule: str
    #: [s]; values are NaN where two samples are farther apart, as beyond all samples
    max_gap: float
    #: whether values are angles [rad], between which "linear" goes the short way round
    angles: bool = False


def resample(samples: Samples, grid: Array, interpolation: Interpolation) -> Array:
    """Computes values (G, c) at the times of a grid (G,) [s] from samples."""
    present = samples.present
    time = samples.time[present]
    values = samples.values[present]
    if not len(time):
        return np.full((len(grid), values.shape[1]), np.nan)
    resolution = samples.resolution
    sample = np.searchsorted(time, grid + resolution, side="right") - 1
    before = np.clip(sample, 0, None)
    after = np.clip(sample + 1, None, len(time) - 1)
    lag = grid - time[before]
    span = time[after] - time[before]
    if interpolation.rule == "hold":
        usable = (sample >= 0) & (lag <= interpolation.max_gap)
        return np.where(usable[:, None], values[before], np.nan)

    fraction = np.divide(lag, span, out=np.zeros_like(lag), where=span > 0)[:, None]
    start = values[before]
    end = values[after]
    if interpolation.rule == "spherical":
        turn = rotation_vector(quaternion_product(quaternion_inverse(start), end))
        resampled = quaternion_product(start, rotation_quaternion(fraction * turn))
    elif interpolation.angles:
        resampled = start + fraction * wrap(end - start)
    else:
        resampled = start + fraction * (end - start)
    is_on_sample = lag <= resolution
    is_between = (sample < len(time) - 1) & (span <= interpolation.max_gap)
    usable = (sample >= 0) & (is_on_sample | is_between)
    return np.where(usable[:, None], resampled, np.nan)
