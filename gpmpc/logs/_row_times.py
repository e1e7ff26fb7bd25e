"""Makes the times of rows: of their stamps, or of a constant step without stamps.

- Messages of bags have the column ``STAMP`` in s, of their headers or of the log.
- Topics of PX4's logs have ``timestamp``, which their reader brings to s.
- Tables of other files have any column, in any unit: ``time`` in the mapping, or
  ``timestamp``, or those of ``TIMES``, which only tell that there are times.
"""

import re

import numpy as np
import pandas as pd

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._file import STAMP
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._signals import holds_times, read_column, seconds
from gpmpc.logs._units import (
    NAMES_OF_TIMES,
    TIME_UNITS,
    is_known,
    is_name_of_time,
    is_no_unit,
    unit_in_name,
    unit_of_time,
    unit_said_of_time,
    unit_text_of_time,
    units_of,
)

# columns that hold the time where nobody says which
TIMES = (STAMP, *NAMES_OF_TIMES)
_CLOCK = re.compile(r"\s*\d+:\d\d:\d\d(?:\.\d+)?\s*")
# the year first, and other marks than ISO's between the parts: 2024_05_01_12_00_00_500
_PARTS_OF_DATE = re.compile(
    r"^\s*(\d{4})[-_/.](\d\d?)[-_/.](\d\d?)[-_ T]+(\d\d?)[-_:.](\d\d?)"
    r"[-_:.](\d\d?)(?:[-_:.,](\d+))?\s*$"
)
_DECIMALS = re.compile(r"[.,]\d+\s*$")
_WITH_UNIT = re.compile(r"^\s*(-?\d+(?:\.\d+)?)\s*([^\W\d_]+)\s*$")
_SAMPLE = 50  # rows in which texts are looked at: are they dates?
_SAME_SPAN = 0.02  # of the time that a log took: a clock in its messages goes as far
LATEST_UNSTATED = 1e11  # [s] since 1970, in the year 5138
LONGEST_UNSTATED = 3600.0  # [s] between rows whose stamps nobody gave a unit
EARLIEST_DATE = 1e9  # [s] since 1970: stamps from there on are rather in s


def time_unit(where: str, table: pd.DataFrame, column: str) -> str:
    """Returns the unit of a column of times that the file says; empty for none.

    Args:
        where: Names the table, for errors.
        table: That has the column.
        column: Its name.

    Raises:
        DataError: What the file says is a unit of another kind.
    """
    text = unit_text(table, column)
    unit = unit_said_of_time(text)
    if not unit and text and is_known(text):
        raise DataError(
            f"{where}: the file says {text!r} of the unit of {column}, which is no "
            f"unit of times: in which is it? (time: {{column: {column}, unit: ms}}, "
            f"or {_units_but('ms')})"
        )
    return unit


def unit_text(table: pd.DataFrame, column: str) -> str:
    """Returns what a file says of the unit of a column of times; empty for nothing.

    It stands in a line of units, or in the column's name.
    """
    stated = units_of(table).get(column, "")
    text = unit_text_of_time(column) if is_no_unit(stated) else stated
    return "" if is_no_unit(text) else text


def _units_but(unit: str) -> str:
    """Lists the units of times but for one that an example has."""
    return ", ".join(other for other in TIME_UNITS if other != unit)


def usual_time_column(table: pd.DataFrame) -> str:
    """Finds a column that is called as times are, or holds dates; empty without one.

    A date that is the same in all rows, as of when the file was made, is no time; nor
    are texts that are the same in most, as the day of a session.
    """
    columns = [str(name) for name in table]
    for time in TIMES:
        for name in columns:
            if name == time or (is_name_of_time(name) and name.casefold() == time):
                return name
    for name in columns:
        if unit_in_name(name):
            return name
    return next((str(name) for name in table if _holds_dates(table, name)), "")


def _holds_dates(table: pd.DataFrame, column: str) -> bool:
    """Tells whether a column holds different dates, also as texts in its rows."""
    if holds_times(table, column):
        return table[column].nunique() > 1
    if read_dates(table.head(_SAMPLE), column) is None:
        return False
    return table[column].nunique() > len(table) / 2


def read_times(where: str, table: pd.DataFrame, column: str, unit: str) -> Array:
    """Reads the times (K,) [s] of rows; NaN where one is missing.

    Args:
        where: Names the table, for errors.
        table: Whose rows they are.
        column: That holds them.
        unit: Of numbers; dates and durations have their own. Where it is empty, it is
            what the file says (see ``time_unit``), or s.

    Raises:
        DataError: The column is missing, or holds something else, or its unit is
            of another kind, or rows are hours apart in a unit that nobody stated.
    """
    dates = read_dates(table, column) if column in table else None
    if dates is not None:
        return dates
    try:
        times = read_column(where, table, column)
    except DataError as error:
        hint = (
            "dates are read where they are written as 2024-05-01 12:00:00.0, and "
            "durations as 00:01:02.5 or 62.5 s; else say time: {step: SECONDS} where "
            "rows are equally far apart"
        )
        raise DataError(f"{error}; {hint}") from error
    if holds_times(table, column):
        return times
    stated = unit or time_unit(where, table, column)
    times = times * TIME_UNITS[stated or "s"]
    fault = "" if stated else fault_of_seconds(times, column)
    if fault:
        raise DataError(f"{where}: {fault}")
    return times


def fault_of_seconds(times: Array, column: str) -> str:
    """Says that times (K,) are rather of a smaller unit than s; empty otherwise."""
    steps = np.diff(times[np.isfinite(times)])
    if not len(steps):
        return ""
    step = np.median(steps)
    if step > LONGEST_UNSTATED:
        doubt = f"rows are {step:.3g} s apart"
    elif np.nanmedian(times) > LATEST_UNSTATED:
        doubt = "rows are of a year after 5000"
    else:
        return ""
    return (
        f"{doubt} if {column} is in s: in which unit is it? (time: {{column: "
        f"{column}, unit: us}}, or {_units_but('us')})"
    )


def doubt_of_unit(table: pd.DataFrame, column: str, unit: str, times: Array) -> str:
    """Says that times (K,) [s] may be of another unit; empty where they may not.

    They may where nobody stated one and they are whole numbers, as a counter of ms is.
    """
    is_number = pd.api.types.is_numeric_dtype(table[column])
    is_stated = unit or unit_said_of_time(unit_text(table, column)) or not is_number
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


def unit_of_clock(table: pd.DataFrame, column: str) -> str:
    """Returns the unit in which a column of whole numbers goes on as stamps do.

    Args:
        table: Of a topic, with the stamps of its messages.
        column: That may be a clock in the messages.

    Returns:
        One of ``TIME_UNITS``; empty where the column is none, or no such clock.
    """
    if STAMP not in table or column not in table:
        return ""
    clock = pd.to_numeric(table[column], errors="coerce").to_numpy(dtype=float)
    stamps = table[STAMP].to_numpy(dtype=float)
    is_clock = np.isfinite(clock).all() and (clock % 1 == 0).all()
    if len(clock) < 2 or not is_clock or (np.diff(clock) < 0).any():
        return ""
    stamps = stamps[np.isfinite(stamps)]
    if not len(stamps):
        return ""
    elapsed = np.ptp(clock)
    logged = np.ptp(stamps)
    for unit, factor in TIME_UNITS.items():
        if abs(elapsed * factor - logged) < _SAME_SPAN * logged:
            return unit
    return ""


def read_dates(table: pd.DataFrame, column: str) -> Array | None:
    """Reads dates or durations (K,) [s] that are texts; None of anything else.

    Dates begin with the year, as 2024-05-01 12:00:00 and 2024_05_01_12_00_00_500 do:
    in others, the day and the month may be confused. They come out since 1970.
    Durations are as a clock shows them, 00:01:02.5, or have their unit, 62.5 sec.
    """
    texts = table[column]
    if texts.dtype.kind in "biufmM" or pd.to_numeric(texts, errors="coerce").any():
        return None
    durations = _read_durations(texts)
    if durations is not None:
        return durations
    dates = _read_iso_dates(texts)
    if dates.isna().all():
        dates = _read_iso_dates(_in_iso_format(texts))
    is_wrong = dates.isna() & ~texts.isna()
    if is_wrong.any() or dates.isna().all():
        return None
    return seconds(dates)


def _read_iso_dates(texts: pd.Series) -> pd.Series:
    return pd.to_datetime(texts, format="ISO8601", utc=True, errors="coerce")


def _in_iso_format(texts: pd.Series) -> pd.Series:
    """Writes dates whose year comes first as ISO does; other texts are missing."""
    parts = texts.astype("string").str.extract(_PARTS_OF_DATE)
    year, month, day, hour, minute, second = (
        parts[index].str.zfill(2) for index in range(6)
    )
    # Behind another mark than a point these are whole ms, or us.
    fraction = parts[6].fillna("0")
    are_counts = ~texts.astype("string").str.contains(_DECIMALS, na=False)
    as_milliseconds = fraction.str.zfill(3)
    as_microseconds = fraction.str.zfill(6)
    counts = as_milliseconds.where(fraction.str.len() <= 3, as_microseconds)
    fraction = fraction.where(~are_counts, counts)
    date = year + "-" + month + "-" + day
    return date + "T" + hour + ":" + minute + ":" + second + "." + fraction


def _read_durations(texts: pd.Series) -> Array | None:
    """Reads durations (K,) [s] that are texts; None of anything else."""
    present = texts.dropna()
    first = present.iloc[0] if len(present) else None
    if not isinstance(first, str) or not (
        _CLOCK.match(first) or _WITH_UNIT.match(first)
    ):
        return None
    if not all(isinstance(text, str) for text in present):
        return None
    if present.str.fullmatch(_CLOCK).all():
        return seconds(pd.to_timedelta(texts))
    parts = texts.str.extract(_WITH_UNIT)
    if parts[0].notna().sum() < len(present):
        return None
    factors = {
        word: TIME_UNITS.get(unit_of_time(word), np.nan)
        for word in parts[1].dropna().unique()
    }
    durations = parts[0].astype(float) * parts[1].map(factors)
    return None if durations.isna().sum() > texts.isna().sum() else durations.to_numpy()


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
    if not counts_rows(table, mapping):
        return None
    step = mapping.time_step
    if isinstance(step, str):
        step = _only_number(where, table, step)
    if step is not None:
        unit = mapping.time_unit
        if isinstance(mapping.time_step, str):
            unit = unit or time_unit(where, table, mapping.time_step)
        return _steps_from_first(table) * step * TIME_UNITS[unit or "s"]
    assert mapping.rate is not None  # of rows that are counted without a step
    return _steps_from_first(table) / mapping.rate


def counts_rows(table: pd.DataFrame, mapping: LogMapping) -> bool:
    """Tells whether rows have no times, but a step that the mapping says."""
    if mapping.time:
        return False
    if mapping.time_step is not None:
        return True
    return mapping.rate is not None and not time_column_beside_signals(table, mapping)


def time_column_beside_signals(table: pd.DataFrame, mapping: LogMapping) -> str:
    """Returns the time column of a table that no signal reads; empty without one.

    One that is a signal, such as t of a temperature, is no time.
    """
    read = {*mapping.signal_columns, mapping.run}
    others = [name for name in table if name not in read]
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
