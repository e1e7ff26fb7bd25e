"""Makes the times of rows: of their stamps, or of a constant step without stamps."""

import re

import numpy as np
import pandas as pd

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._file import STAMP
from gpmpc.logs._mapping import TIME_UNITS, LogMapping
from gpmpc.logs._signals import holds_times, read_column, seconds

LONGEST_UNSTATED = 3600.0  # [s] between rows whose stamps nobody gave a unit
# names of times that say their unit: "Time [ms]", "time (us)", "t_s"; TimeUS is
# ArduPilot's
_TIME_WITH_UNIT = re.compile(
    r"(?:[Tt]ime|[Tt]imestamp|t)(?: ?[\[(](s|ms|us|ns)[\])]|_(s|ms|us|ns))"
)
_TIME_US = "TimeUS"


def unit_in_name(column: str) -> str:
    """Returns the unit that the name of a column of times says; empty for none.

    >>> unit_in_name("t_ms"), unit_in_name("time [us]"), unit_in_name("t")
    ('ms', 'us', '')
    """
    if column == _TIME_US:
        return "us"
    match = _TIME_WITH_UNIT.fullmatch(column)
    return (match[1] or match[2]) if match is not None else ""


def read_times(where: str, table: pd.DataFrame, column: str, unit: str) -> Array:
    """Reads the times (K,) [s] of rows; NaN where one is missing.

    Args:
        where: Names the table, for errors.
        table: Whose rows they are.
        column: That holds them.
        unit: Of numbers; dates and durations have their own. Where it is empty, it is
            what the column's name says, or s.

    Raises:
        DataError: The column is missing, or holds something else, or rows are hours
            apart in a unit that nobody stated.
    """
    dates = read_dates(table, column) if column in table else None
    if dates is not None:
        return dates
    try:
        times = read_column(where, table, column)
    except DataError as error:
        hint = (
            "dates are read where they are written as 2024-05-01 12:00:00.0; else say "
            "time: {step: SECONDS} where rows are equally far apart"
        )
        raise DataError(f"{error}; {hint}") from error
    if holds_times(table, column):
        return times
    stated = unit or unit_in_name(column)
    times = times * TIME_UNITS[stated or "s"]
    if not stated:
        _check_unstated_unit(where, times, column)
    return times


def _check_unstated_unit(where: str, times: Array, column: str) -> None:
    """Raises ``DataError`` of times (K,) [s] that are rather of a smaller unit."""
    steps = np.diff(times[np.isfinite(times)])
    if not len(steps) or np.median(steps) <= LONGEST_UNSTATED:
        return
    raise DataError(
        f"{where}: rows are {np.median(steps):.3g} s apart if {column} is in s: in "
        f"which unit is it? (time: {{column: {column}, unit: us}}, or s, ms, ns)"
    )


def read_dates(table: pd.DataFrame, column: str) -> Array | None:
    """Reads dates (K,) [s] since 1970 that are texts, such as 2024-05-01 12:00:00.

    They are in ISO's format alone: in others, the day and the month may be confused.
    Returns None where the column holds anything else.
    """
    texts = table[column]
    if texts.dtype.kind in "biufmM" or pd.to_numeric(texts, errors="coerce").any():
        return None
    dates = pd.to_datetime(texts, format="ISO8601", utc=True, errors="coerce")
    is_wrong = dates.isna() & ~texts.isna()
    if is_wrong.any() or dates.isna().all():
        return None
    return seconds(dates)


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
        unit = TIME_UNITS[mapping.time_unit or "s"]
        return _steps_from_first(table) * step * unit
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
