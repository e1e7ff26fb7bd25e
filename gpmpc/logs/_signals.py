"""Makes signals in SI units of the columns of a table; NaN where a value is missing.

Findings of this file count samples of a column, a signal or a topic that hold no
measurement. Whether a row of the log is left out for it is found out, and counted once,
by ``_usable_rows``: resampling may go over it, and a row may lack several values.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from gpmpc._angles import wrap
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.gp._wrapped import RADIANS, wrapped_columns
from gpmpc.logs._columns import check_column
from gpmpc.logs._dropouts import sentinels, zero_dropouts
from gpmpc.logs._file import doubts_of
from gpmpc.logs._findings import RunFindings
from gpmpc.logs._mapping import Signal

LARGEST_ANGLE = 4 * np.pi  # [rad]; larger ones count turns, or are degrees
FEWEST_JUMPS = 2  # by more than half a turn: a wrong sample may make one
WHOLE_TURNS = 0.5  # [rad] by which jumps of whole turns differ from the motion before
NO_ATTITUDE = 1e-6  # norm: what an estimator writes before it has begun
NORM_TOLERANCE = 0.05  # of unit quaternions
MOST_OFF = 0.05  # of the samples of an attitude; beyond, they are no unit quaternions


def read_column(where: str, table: pd.DataFrame, column: str) -> Array:
    """Reads a column of numbers (K,); dates and durations are seconds.

    Args:
        where: Names the table, for errors.
        table: With K rows.
        column: Its name.

    Raises:
        DataError: The column is missing, or holds something else, or what its numbers
            mean is not sure.
    """
    check_column(where, table, column)
    doubt = doubts_of(table).get(column, "")
    if doubt:
        raise DataError(f"{where}: {doubt}")
    values = table[column]
    if holds_times(table, column):
        return seconds(values)
    numbers = pd.to_numeric(values, errors="coerce").to_numpy(dtype=float)
    is_wrong = np.isnan(numbers) & ~values.isna().to_numpy()
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise DataError(
            f"{where}: row {row + 1}, column {column!r} is {values.iloc[row]!r}; "
            "expected a number"
        )
    return numbers


def holds_times(table: pd.DataFrame, column: str) -> bool:
    """Tells whether a column holds dates or durations, which have their own unit."""
    return table[column].dtype.kind in "mM"


def seconds(times: pd.Series) -> Array:
    """Returns dates, since 1970, or durations (K,) in seconds; NaN for none."""
    if isinstance(times.dtype, pd.DatetimeTZDtype):
        times = times.dt.tz_convert(None)
    values = times.to_numpy()
    if values.dtype.kind == "M":
        values = values - np.datetime64(0, "s")
    return values / np.timedelta64(1, "s")


def nan_zero_dropouts(
    where: str, table: pd.DataFrame, signals: Sequence[Signal], findings: RunFindings
) -> pd.DataFrame:
    """Puts NaN where all states of a row are zero, because no sensor was read."""
    columns = [
        column
        for signal in signals
        if signal.role == "states"
        for column in signal.columns
    ]
    states = [read_column(where, table, column) for column in columns]
    if not states:
        return table
    dropouts = zero_dropouts(np.column_stack(states))
    count = int(dropouts.sum())
    if not count:
        return table
    text = f"{count} rows with zeros for all states: left out"
    findings.add("all zero", count, text)
    with_nan = table.astype(dict.fromkeys(columns, float))
    with_nan.loc[dropouts, columns] = np.nan
    return with_nan


def read_signal(
    where: str,
    table: pd.DataFrame,
    signal: Signal,
    findings: RunFindings,
    is_kept: np.ndarray,
    is_next_step: np.ndarray,
) -> Array:
    """Reads a signal (K, c) in the units and conventions of ``gpmpc.logs``.

    Args:
        where: Names the table, for errors.
        table: With K rows.
        signal: Says which columns, and in which units.
        findings: Takes what is missing.
        is_kept: Rows (K,) that will not be left out: no other has to be right.
        is_next_step: Rows (K,) that stand a usual time step behind the row before.

    Raises:
        DataError: A column cannot be read, angles are rather in degrees, or quaternions
            have no unit length.
    """
    columns = [
        _without_sentinels(column, read_column(where, table, column), findings)
        for column in signal.columns
    ]
    values = np.column_stack(columns) * signal.factors
    values[~np.isfinite(values)] = np.nan
    absent = np.asarray(np.isnan(values).any(axis=1))
    text = f"{absent.sum()} samples of {signal.name} hold no value"
    findings.add("empty sample", absent.sum(), text)
    if signal.kind == "quaternion":
        return _unit_quaternions(where, values, signal, findings, is_kept)
    if signal.kind == "heading":
        quaternions = _unit_quaternions(where, values, signal, findings, is_kept)
        headings = _headings(quaternions)
        _note_turns(headings, signal, findings, is_next_step)
        return headings
    kept_values = np.where(is_kept[:, None], values, np.nan)
    _check_angles(where, kept_values, signal, findings, is_next_step)
    _note_turns(values, signal, findings, is_next_step)
    _note_undeclared_angles(values, signal, findings, is_next_step)
    if signal.kind == "euler":
        return _euler_to_quaternions(values, present=~absent)
    return values


def _without_sentinels(column: str, numbers: Array, findings: RunFindings) -> Array:
    """Puts NaN where a logger wrote a number for a missing value."""
    is_sentinel = sentinels(numbers)
    if is_sentinel.any():
        listed = ", ".join(f"{n:g}" for n in np.unique(numbers[is_sentinel])[:3])
        count = is_sentinel.sum()
        text = f"{count} rows of {column} hold {listed}, no measurement: left out"
        findings.add("sentinel", count, text)
    return np.where(is_sentinel, np.nan, numbers)


def _check_angles(
    where: str,
    values: Array,
    signal: Signal,
    findings: RunFindings,
    is_next_step: np.ndarray,
) -> None:
    """Notes angles that are said to be radians and are large: they may be degrees.

    Angles that count turns are as large, but go from row to row by less than half a
    turn, or by whole turns more where a counter of several begins anew. Over a gap they
    go by any angle.

    Raises:
        DataError: They jump more than once, or are a roll or a pitch.
    """
    if signal.kind not in ("angle", "euler") or signal.unit != "rad":
        return
    largest = np.nanmax(np.abs(values), axis=0, initial=0.0)
    if largest.max() <= LARGEST_ANGLE:
        return
    text = (
        f"{signal.name} reaches {largest.max():.4g} rad: are these degrees? (unit: deg)"
    )
    is_tilt = signal.kind == "euler" and largest[:2].max() > LARGEST_ANGLE
    changes = np.diff(values, axis=0)
    changes[~is_next_step[1:]] = np.nan
    if is_tilt or _count_jumps(changes) >= FEWEST_JUMPS:
        raise DataError(f"{where}: {text}")
    count = int((np.abs(values) > LARGEST_ANGLE).any(axis=1).sum())
    findings.add("large angle", count, f"{text} or does it count turns? left in")


def _note_turns(
    values: Array, signal: Signal, findings: RunFindings, is_next_step: np.ndarray
) -> None:
    """Notes angles of inputs and context that jump by a turn: they are plain numbers.

    Models take the sine and the cosine of angles of states alone.
    """
    if signal.group.kind != "angle" or signal.role == "states":
        return
    jumps = np.abs(np.diff(values, axis=0)[is_next_step[1:]]) > np.pi
    text = (
        f"{signal.name} jumps by a turn {jumps.sum()} times, and is no state: models "
        "take it as a plain number; log its sine and cosine, or count its turns"
    )
    findings.add("turns", jumps.sum(), text)


def _note_undeclared_angles(
    values: Array, signal: Signal, findings: RunFindings, is_next_step: np.ndarray
) -> None:
    """Notes columns that jump by whole turns, and that no ``kind`` calls angles.

    Between the rows of a rate they pass through all angles, where the sensor passed
    from one end of its range to the other.
    """
    may_be_angles = signal.group.unit in ("rad", "")
    if signal.kind != "vector" or not may_be_angles:
        return
    behind = np.flatnonzero(is_next_step)
    present = np.isfinite(values[behind]) & np.isfinite(values[behind - 1])
    for column, name in enumerate(signal.columns):
        rows = behind[present[:, column]]
        after = values[rows, column][:, None]
        before = values[rows - 1, column][:, None]
        # whole numbers from 0 to 6 are no radians
        is_counter = not (values[rows, column] % 1).any()
        for wrapped in wrapped_columns(before, after):
            if is_counter and wrapped.turn == RADIANS:
                continue
            text = (
                f"{name} jumps by a whole turn ({wrapped.turn}) {wrapped.rows} times, "
                "and is taken as a plain number, also by a rate: is it an angle? "
                "(kind: angle, unit: rad or deg)"
            )
            findings.add("turns", wrapped.rows, text)


def _count_jumps(changes: Array) -> int:
    """Counts changes (K, c) [rad] by more than half a turn, but for whole turns.

    A change by whole turns goes on, less those, as the one before.
    """
    jumps = np.abs(changes) > np.pi
    moves_before = np.abs(changes[:-1]) <= np.pi
    accelerations = wrap(changes[1:] - changes[:-1])[jumps[1:] & moves_before]
    is_whole = np.abs(accelerations) < WHOLE_TURNS
    return int(jumps.sum()) if is_whole.sum() < 0.5 * jumps.sum() else 0


def _euler_to_quaternions(angles: Array, present: np.ndarray) -> Array:
    """Makes quaternions (K, 4) of roll, pitch and yaw (K, 3) [rad]."""
    quaternions = np.full((len(angles), 4), np.nan)
    turns = Rotation.from_euler("ZYX", angles[present, ::-1])
    quaternions[present] = turns.as_quat()
    return _with_steady_signs(quaternions).quaternions


def _headings(quaternions: Array) -> Array:
    """Computes the yaw (K, 1) [rad] of quaternions (x, y, z, w) (K, 4)."""
    x, y, z, w = quaternions.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return yaw[:, None]


def _unit_quaternions(
    where: str,
    values: Array,
    signal: Signal,
    findings: RunFindings,
    is_kept: np.ndarray,
) -> Array:
    """Makes unit quaternions (x, y, z, w) whose sign does not flip; NaN for none."""
    if signal.order == "wxyz":
        values = values[:, [1, 2, 3, 0]]
    norms = np.linalg.norm(values, axis=1)
    is_empty = norms < NO_ATTITUDE
    text = f"{is_empty.sum()} samples of {signal.name} are zeros, no attitude: left out"
    findings.add("empty sample", is_empty.sum(), text)
    is_off = np.abs(norms - 1) > NORM_TOLERANCE
    is_wrong = is_off & is_kept & ~is_empty
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        text = f"{signal.name} in row {row + 1} has norm {norms[row]:.4g}"
        is_sample = np.isfinite(norms) & is_kept & ~is_empty
        if is_wrong.sum() > MOST_OFF * is_sample.sum():
            raise DataError(f"{where}: {text}; expected unit quaternions")
        text = f"{text}, as {is_wrong.sum()} samples: no attitude, left out"
        findings.add("norm", is_wrong.sum(), text)
    norms[is_off] = np.nan
    steady = _with_steady_signs(values / norms[:, None])
    text = f"{steady.flips} times: turned back"
    findings.add("quaternion flips its sign", steady.flips, text)
    return steady.quaternions


class _SteadySigns(NamedTuple):
    """Quaternions whose sign does not flip, and how often it did."""

    quaternions: Array  # (K, 4)
    flips: int


def _with_steady_signs(quaternions: Array) -> _SteadySigns:
    """Gives quaternions (K, 4) signs that do not flip from row to row.

    Opposite ones are one attitude. The scalar of the first is not negative, so that
    runs that begin alike have the same sign.
    """
    values = quaternions.copy()
    present = np.flatnonzero(np.isfinite(values).all(axis=1))
    flips = np.einsum("ij,ij->i", values[present[1:]], values[present[:-1]]) < 0
    signs = np.where(np.cumsum(np.r_[False, flips]) % 2, -1.0, 1.0)
    if len(present) and values[present[0], 3] < 0:
        signs = -signs
    values[present] *= signs[: len(present), None]
    return _SteadySigns(values, int(flips.sum()))
