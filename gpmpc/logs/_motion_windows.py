"""Cuts short windows of the motion of a rigid body out of the runs of a log."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._axis_fits import FEWEST
from gpmpc.logs._frames import Claim
from gpmpc.logs._log import LogRun

WINDOWS = 600  # of a run that are looked at
HALF_WINDOW = 0.1  # [s] on each side of the middle of a window
HALF_SHORT = 0.03  # [s] likewise, of a body that turns fast
FAST = 1.5  # [rad] within a window that is turning fast
HALF_WIDE = 0.1  # [s] of the windows of accelerations, which are noisier
LONGEST_LAG = 0.8  # [s] that is sought
LAG_STEP = 0.02  # [s] from one lag to the next


class MotionWindows(NamedTuple):
    """N windows of a log in ENU and FLU axes, but for the attitudes: as in the file."""

    moves: Array  # change of the position over the time (N, 3)
    attitudes: Array  # at the first, middle and last row (3, N, 4)
    velocities: Array  # mean (N, 3)
    rates: Array  # mean (N, 3)
    duration: float  # [s]
    lags: Array  # (L,) [s]
    later_velocities: Array  # by each lag (L, N, 3); NaN beyond the piece
    later_rates: Array  # likewise
    wide_attitudes: Array  # at the rows of longer windows (3, N, 4)
    wide_positions: Array  # likewise (3, N, 3)
    wide_velocities: Array  # at their first and last row (2, N, 3)
    wide_duration: float  # [s]


class _RunWindows(NamedTuple):
    """The N windows of one run; as in ``MotionWindows``."""

    steps: Array  # change of the position (N, 3)
    attitudes: Array  # (3, N, 4)
    means: Array  # of velocities and rates (N, 6)
    later_means: Array  # (L, N, 6)
    wide_attitudes: Array  # (3, N, 4)
    wide_positions: Array  # (3, N, 3)
    wide_velocities: Array  # (2, N, 3)


def cut_motion_windows(
    runs: Sequence[LogRun], step: float, claim: Claim
) -> MotionWindows | None:
    """Cuts windows each of which lies inside a piece.

    Args:
        runs: Of a log, with the states of a rigid body as they are in the file.
        step: Time step [s].
        claim: Of what the states are.

    Returns:
        The windows; None where there are too few.
    """
    half = max(round(HALF_WINDOW / step), 1)
    if sum(len(run.starts(half, half)) for run in runs) < FEWEST:
        return None
    if _turns_fast(runs, half):
        half = max(round(HALF_SHORT / step), 1)
    half_wide = max(round(HALF_WIDE / step), half)
    middles = [run.starts(half_wide, half_wide) for run in runs]
    count = sum(len(rows) for rows in middles)
    if count < FEWEST:
        return None
    stride = -(-count // WINDOWS)
    lag_stride = max(round(LAG_STEP / step), 1)
    last_lag = int(LONGEST_LAG / step) // lag_stride
    lags = lag_stride * np.arange(-last_lag, last_lag + 1)
    windows_by_run = [
        _windows_of_run(run, rows[::stride], lags, half, half_wide, claim)
        for run, rows in zip(runs, middles, strict=True)
    ]
    means = _join([own.means for own in windows_by_run])
    later_means = _join([own.later_means for own in windows_by_run])
    duration = 2 * half * step
    return MotionWindows(
        moves=_join([own.steps for own in windows_by_run]) / duration,
        attitudes=_join([own.attitudes for own in windows_by_run]),
        velocities=means[:, 0:3],
        rates=means[:, 3:6],
        duration=duration,
        lags=np.asarray(lags * step, dtype=float),
        later_velocities=later_means[..., 0:3],
        later_rates=later_means[..., 3:6],
        wide_attitudes=_join([own.wide_attitudes for own in windows_by_run]),
        wide_positions=_join([own.wide_positions for own in windows_by_run]),
        wide_velocities=_join([own.wide_velocities for own in windows_by_run]),
        wide_duration=2 * half_wide * step,
    )


def _windows_of_run(
    run: LogRun,
    rows: np.ndarray,
    lags: np.ndarray,
    half: int,
    half_wide: int,
    claim: Claim,
) -> _RunWindows:
    """Cuts the windows of one run.

    Args:
        run: In the axes of the file.
        rows: In the middle of each window (N,).
        lags: (L,) [rows].
        half: Rows on each side of the middle.
        half_wide: Likewise, of the longer windows.
        claim: Of what the states are.
    """
    raw_attitudes = run.states[:, 3:7]
    states = claim.turn_axes(run.states)
    means = _moving_mean(states[:, 7:13], half)
    later_rows = rows + lags[:, None]
    piece = np.searchsorted(run.begins, rows, side="right") - 1
    first = np.array(run.begins)[piece]
    end = np.array([*run.begins[1:], len(run)])[piece]
    inside = (later_rows >= first + half) & (later_rows < end - half)
    later_means = means[np.where(inside, later_rows, 0)]
    later_means[~inside] = np.nan
    ends = (-half, 0, half)
    wide_ends = (-half_wide, 0, half_wide)
    return _RunWindows(
        steps=states[rows + half, 0:3] - states[rows - half, 0:3],
        attitudes=np.stack([raw_attitudes[rows + shift] for shift in ends]),
        means=means[rows],
        later_means=later_means,
        wide_attitudes=np.stack([raw_attitudes[rows + shift] for shift in wide_ends]),
        wide_positions=np.stack([states[rows + shift, 0:3] for shift in wide_ends]),
        wide_velocities=np.stack(
            [states[rows + shift, 7:10] for shift in (-half_wide, half_wide)]
        ),
    )


def _join(arrays: Sequence[Array]) -> Array:
    """Joins arrays (..., N, c) of several runs along their windows."""
    return np.concatenate(arrays, axis=-2)


def _turns_fast(runs: Sequence[LogRun], half: int) -> bool:
    """Tells whether turns within windows come near to half a turn: ambiguous ones."""
    angles = []
    for run in runs:
        rows = run.starts(half, half)
        before = run.states[rows - half, 3:7]
        after = run.states[rows + half, 3:7]
        cosines = np.abs((before * after).sum(axis=1))
        angles.append(2 * np.arccos(np.minimum(cosines, 1.0)))
    return float(np.quantile(np.concatenate(angles), 0.99)) > FAST


def _moving_mean(values: Array, half: int) -> Array:
    """Returns means (K, c) of rows from ``half`` before to after, by trapezoids."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    means = np.zeros_like(values)
    if len(values) > 2 * half:
        whole = sums[2 * half + 1 :] - sums[: -2 * half - 1]
        ends = (values[: -2 * half] + values[2 * half :]) / 2
        means[half : len(values) - half] = (whole - ends) / (2 * half)
    return means
