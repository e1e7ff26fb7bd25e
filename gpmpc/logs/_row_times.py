"""Makes the times of rows: of their stamps, or of a constant step without stamps."""

import numpy as np
import pandas as pd

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._file import STAMP
from gpmpc.logs._mapping import TIME_UNITS, LogMapping
from gpmpc.logs._signals import holds_times, read_column, seconds
from gpmpc.logs._units import unit_at_end, unit_in_name, units_of

# columns that hold the time where nobody says which
TIMES = (STAMP, "timestamp", "t", "time", "stamp", "Time", "seconds")
LATEST_UNSTATED = 1e11  # [s] since 1970, in the year 5138
LONGEST_UNSTATED = 3600.0  # [s] between rows whose stamps nobody gave a unit
EARLIEST_DATE = 1e9  # [s] since 1970: stamps from there on are rather in s


def time_unit(table: pd.DataFrame, column: str) -> str:
    """Returns the unit of a column of times that the file says; empty for none.

    It stands in a line of units, or in the column's name.
    """
    stated = units_of(table).get(column, "")
    if stated in TIME_UNITS:
        return stated
    return unit_in_name(column) or unit_at_end(column)


def usual_time_column(table: pd.DataFrame) -> str:
    """Finds a column that is called as times are, or holds dates; empty without one.

    A date that is the same in all rows, as of when the file was made, is no time.
    """
    for name in TIMES:
        if name in table:
            return name
    for name in map(str, table):
        if unit_in_name(name):
            return name
    dates = (str(name) for name in table if holds_times(table, name))
    return next((name for name in dates if table[name].nunique() > 1), "")


def read_times(where: str, table: pd.DataFrame, column: str, unit: str) -> Array:
    """Reads the times (K,) [s] of rows; NaN where one is missing.

    Args:
        where: Names the table, for errors.
        table: Whose rows they are.
        column: That holds them.
        unit: Of numbers; dates and durations have their own. Where it is empty, it is
            what the file says (see ``time_unit``), or s.

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
    stated = unit or time_unit(table, column)
    times = times * TIME_UNITS[stated or "s"]
    if not stated:
        _check_unstated_unit(where, times, column)
    return times


def _check_unstated_unit(where: str, times: Array, column: str) -> None:
    """Raises ``DataError`` of times (K,) [s] that are rather of a smaller unit."""
    steps = np.diff(times[np.isfinite(times)])
    if not len(steps):
        return
    step = np.median(steps)
    if step > LONGEST_UNSTATED:
        doubt = f"rows are {step:.3g} s apart"
    elif np.nanmedian(times) > LATEST_UNSTATED:
        doubt = "rows are of a year after 5000"
    else:
        return
    raise DataError(
        f"{where}: {doubt} if {column} is in s: in which unit is it? (time: {{column: "
        f"{column}, unit: us}}, or s, ms, ns)"
    )


def doubt_of_unit(table: pd.DataFrame, column: str, unit: str, times: Array) -> str:
    """Says that times (K,) [s] may be of another unit; empty where they may not.

    They may where nobody stated one and they are whole numbers, as a counter of ms is.
    """
    is_stated = unit or time_unit(table, column) or holds_times(table, column)
    times = times[np.isfinite(times)]
    steps = np.abs(np.diff(times))
    if is_stated or not len(steps) or times.max() > EARLIEST_DATE:
        return ""
    if (times % 1 != 0).any():
        return ""
    return (
        f"{column} has whole numbers, whose unit nobody stated: rows are taken as "
        f"{np.median(steps):.3g} s apart; of ms, state time: {{column: {column}, "
        "unit: ms}"
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

    Its step is ``time.step``, or that of its ``rate`` where a table has no times.

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
        unit = mapping.time_unit
        if isinstance(mapping.time_step, str):
            unit = unit or time_unit(table, mapping.time_step)
        return _steps_from_first(table) * step * TIME_UNITS[unit or "s"]
    if mapping.rate and not unread_times(table, mapping):
        return _steps_from_first(table) / mapping.rate
    return None


def unread_times(table: pd.DataFrame, mapping: LogMapping) -> str:
    """Returns the time column of a table that no signal reads; empty without one.

    One that is a signal, such as t of a temperature, is no time.
    """
    others = [name for name in table if name not in mapping.signal_columns]
    return usual_time_column(table[others])


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
