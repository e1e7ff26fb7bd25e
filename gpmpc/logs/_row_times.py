"""Makes the times of rows: of their stamps, or of a constant step without stamps."""

import numpy as np
import pandas as pd

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._file import STAMP
from gpmpc.logs._mapping import TIME_UNITS, LogMapping
from gpmpc.logs._signals import holds_times, read_column


def read_times(where: str, table: pd.DataFrame, column: str, unit: str) -> Array:
    """Reads the times (K,) [s] of rows; NaN where one is missing.

    Args:
        where: Names the table, for errors.
        table: Whose rows they are.
        column: That holds them.
        unit: Of numbers; dates and durations have their own.

    Raises:
        DataError: The column is missing, or holds something else.
    """
    times = read_column(where, table, column)
    if holds_times(table, column):
        return times
    return times * TIME_UNITS[unit]


def row_times(where: str, table: pd.DataFrame, mapping: LogMapping) -> Array | None:
    """Returns the times (K,) [s] of rows whose step the mapping says; None otherwise.

    Its step is ``time.step``, or that of its ``rate`` where a table has no stamps.

    Args:
        where: Names the table, for errors.
        table: Whose index says at which place of the file each row stands.
        mapping: Says the step.

    Raises:
        DataError: The column that ``time.step`` names does not hold one positive
            number.
    """
    step = mapping.time_step
    if isinstance(step, str):
        step = _only_number(where, table, step)
    if step is not None:
        return _steps_from_first(table) * step * TIME_UNITS[mapping.time_unit]
    if mapping.rate and STAMP not in table and "timestamp" not in table:
        return _steps_from_first(table) / mapping.rate
    return None


def _steps_from_first(table: pd.DataFrame) -> Array:
    """Counts the steps (K,) from the first row of a run to each of its rows.

    Rows of others that stand between those of the run in the file took time as well.
    Where rows of several runs take turns, each takes one step from one of its rows to
    the next.
    """
    places = table.index.to_numpy(dtype=float)
    distances = np.diff(places)
    if not len(distances):
        return np.zeros(len(places))
    usual = np.quantile(distances, 0.5, method="lower")
    steps = np.maximum(distances / usual, 1.0)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _only_number(where: str, table: pd.DataFrame, column: str) -> float:
    """Returns the number that a column holds once, or in all of its rows."""
    values = read_column(where, table, column)
    numbers = np.unique(values[np.isfinite(values)])
    if len(numbers) != 1 or numbers[0] <= 0:
        raise DataError(
            f"{where}: column {column!r} must hold one positive number, the time step; "
            f"it has {len(numbers)} different ones"
        )
    return float(numbers[0])
