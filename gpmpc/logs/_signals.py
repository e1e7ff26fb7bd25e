"""Makes signals in SI units of the columns of a table; NaN where a value is missing.

Findings of this file count samples of a column, a signal or a topic that hold no
measurement. Whether a row of the log is left out for it is found out, and counted once,
by ``_usable_rows``: resampling may go over it, and a row may lack several values.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._columns import check_column
from gpmpc.logs._dropouts import sentinels, zero_dropouts
from gpmpc.logs._findings import RunFindings
from gpmpc.logs._mapping import Signal

LARGEST_ANGLE = 4 * np.pi  # [rad]; larger ones are rather degrees
NORM_TOLERANCE = 0.05  # of unit quaternions


def read_column(where: str, table: pd.DataFrame, column: str) -> Array:
    """Reads a column of numbers (K,).

    Args:
        where: Names the table, for errors.
        table: With K rows.
        column: Its name.

    Raises:
        DataError: The column is missing, or holds something else.
    """
    check_column(where, table, column)
    values = table[column]
    numbers = pd.to_numeric(values, errors="coerce").to_numpy(dtype=float)
    is_wrong = np.isnan(numbers) & ~values.isna().to_numpy()
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise DataError(
            f"{where}: row {row + 1}, column {column!r} is {values.iloc[row]!r}; "
            "expected a number"
        )
    return numbers


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
    where: str, table: pd.DataFrame, signal: Signal, findings: RunFindings
) -> Array:
    """Reads a signal (K, c) in the units and conventions of ``gpmpc.logs``.

    Args:
        where: Names the table, for errors.
        table: With K rows.
        signal: Says which columns, and in which units.
        findings: Takes what is missing.

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
        return _unit_quaternions(where, values, signal, findings)
    _check_angles(where, values, signal)
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


def _check_angles(where: str, values: Array, signal: Signal) -> None:
    """Raises ``DataError`` where angles that are said to be radians are too large."""
    if signal.kind not in ("angle", "euler") or signal.unit != "rad":
        return
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if largest > LARGEST_ANGLE:
        raise DataError(
            f"{where}: {signal.name} reaches {largest:.4g} rad: are these degrees? "
            "(unit: deg)"
        )


def _euler_to_quaternions(angles: Array, present: np.ndarray) -> Array:
    """Makes quaternions (K, 4) of roll, pitch and yaw (K, 3) [rad]."""
    quaternions = np.full((len(angles), 4), np.nan)
    turns = Rotation.from_euler("ZYX", angles[present, ::-1])
    quaternions[present] = turns.as_quat()
    return quaternions


def _unit_quaternions(
    where: str, values: Array, signal: Signal, findings: RunFindings
) -> Array:
    """Makes unit quaternions (x, y, z, w) whose sign does not flip."""
    if signal.order == "wxyz":
        values = values[:, [1, 2, 3, 0]]
    norms = np.linalg.norm(values, axis=1)
    is_off = np.abs(norms - 1) > NORM_TOLERANCE
    if is_off.any():
        row = int(np.argmax(is_off))
        raise DataError(
            f"{where}: {signal.name} in row {row + 1} has norm {norms[row]:.4g}; "
            "expected unit quaternions"
        )
    values = values / norms[:, None]
    present = np.flatnonzero(np.isfinite(norms))
    flips = np.einsum("ij,ij->i", values[present[1:]], values[present[:-1]]) < 0
    text = f"{flips.sum()} times: turned back"
    findings.add("quaternion flips its sign", flips.sum(), text)
    values[present[1:]] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return values
