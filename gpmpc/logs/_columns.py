"""Finds the columns that a mapping names: by name, by number, or one set for each run.

A file of one table may name no columns, name one twice, or hold runs side by side, such
as the data for estimation and those for validation.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from gpmpc.exceptions import DataError
from gpmpc.logs._file import STAMP, Tables, doubts_of, with_doubts
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._units import said_units, unit_text_of_time, units_of, with_units

LISTED_COLUMNS = 12  # of a table, where one is missing


class TablesOfRun(NamedTuple):
    """The tables of one of the runs that a mapping finds in a file."""

    run: str  # empty where the file is the run
    tables: Tables


def with_unique_names(table: pd.DataFrame) -> pd.DataFrame:
    """Adds its number to the name of each column whose name comes more than once."""
    if not table.columns.has_duplicates:
        return table
    is_repeated = table.columns.duplicated(keep=False)
    names = [
        f"{name} (column {number})" if repeated else name
        for number, (name, repeated) in enumerate(
            zip(table.columns, is_repeated, strict=True), start=1
        )
    ]
    return table.set_axis(names, axis=1)


def check_column(where: str, table: pd.DataFrame, column: str) -> None:
    """Raises ``DataError`` where a table has no such column."""
    if column in table:
        return
    repeated = [name for name in table if str(name).startswith(f"{column} (column ")]
    if repeated:
        raise DataError(
            f"{where}: column {column!r} stands there {len(repeated)} times: name one "
            f"of them, {', '.join(map(repr, repeated))}"
        )
    listed = ", ".join(map(str, table.columns[:LISTED_COLUMNS]))
    if len(table.columns) > LISTED_COLUMNS:
        listed += ", ..."
    raise DataError(f"{where}: column {column!r} is missing; it has {listed}")


def named_columns(path: str | Path, tables: Tables, mapping: LogMapping) -> Tables:
    """Gives the columns of a single table the names by which the mapping calls them.

    A column that the mapping calls by its number appears under both names. What the
    file says of its unit goes with a column, also what its name there says.

    Args:
        path: Of the file, for errors.
        tables: Of the file; those of topics stay as they are.
        mapping: Its ``names`` replace those of the file; a number that it uses, and
            that no column is called by, is the number of a column.

    Raises:
        DataError: The mapping has more names than the file has columns.
    """
    if "" not in tables:
        return tables
    table = tables[""]
    if len(mapping.names) > len(table.columns):
        raise DataError(
            f"{path}: the mapping names {len(mapping.names)} columns; there are "
            f"{len(table.columns)}"
        )
    names_in_file = list(table.columns)
    unit_by_name = said_units(table)
    stated_units = units_of(table)  # without those that names say
    doubt_by_name = doubts_of(table)
    if mapping.names:
        others = table.columns[len(mapping.names) :]
        table = with_unique_names(table.set_axis([*mapping.names, *others], axis=1))
    numbers = {
        name: number
        for name in mapping.used_columns
        if (number := column_number(table, name))
    }
    by_number = {name: table.iloc[:, n - 1] for name, n in numbers.items()}
    times = _columns_of_times(mapping)
    numbers_of_times = {numbers[name] for name in times if name in numbers}
    units = []
    for number, name in enumerate(names_in_file, start=1):
        unit = unit_by_name.get(name, "")
        is_time = number in numbers_of_times or table.columns[number - 1] in times
        if is_time:
            unit = stated_units.get(name, "") or unit_text_of_time(str(name))
        units.append(unit)
    unit_of_column = dict(zip(table.columns, units, strict=True))
    unit_of_column |= {name: units[number - 1] for name, number in numbers.items()}
    doubts = [doubt_by_name.get(name, "") for name in names_in_file]
    doubt_of_column = dict(zip(table.columns, doubts, strict=True))
    doubt_of_column |= {name: doubts[number - 1] for name, number in numbers.items()}
    table = with_units(table.assign(**by_number), unit_of_column)
    return {**tables, "": with_doubts(table, doubt_of_column)}


def _columns_of_times(mapping: LogMapping) -> set[str]:
    """Returns the columns of times, as a mapping and its runs call them."""
    names = {mapping.time, str(mapping.time_step)}
    of_runs = {
        column
        for columns in mapping.runs.values()
        for name, column in columns.items()
        if name in names
    }
    return names | of_runs


def column_number(table: pd.DataFrame, name: str) -> int:
    """Returns which column a number means, from 1 on; 0 of a column's name."""
    if name in table or not (name.isascii() and name.isdecimal()):
        return 0
    number = int(name)
    return number if number <= len(table.columns) else 0


def runs_side_by_side(
    path: str | Path, tables: Tables, mapping: LogMapping
) -> Iterator[TablesOfRun]:
    """Yields the runs for which the mapping has columns of their own; one without.

    Rows after the last value of a run belong to longer ones.

    Raises:
        DataError: A column is missing.
    """
    if not mapping.runs:
        yield TablesOfRun("", _until_last_value(tables, mapping))
        return
    if "" not in tables:
        raise DataError(f"{path}: has topics, and is one run; runs needs one table")
    table = tables[""]
    for run, columns in mapping.runs.items():
        for column in columns.values():
            check_column(f"{path}, run {run}", table, column)
        own = table.assign(**{name: table[column] for name, column in columns.items()})
        units = units_of(table)
        own_units = {name: units.get(column, "") for name, column in columns.items()}
        own = with_units(own, {**units, **own_units})
        doubts = doubts_of(table)
        own_doubts = {name: doubts.get(column, "") for name, column in columns.items()}
        own = with_doubts(own, {**doubts, **own_doubts})
        yield TablesOfRun(run, _until_last_value({"": own}, mapping))


def _until_last_value(tables: Tables, mapping: LogMapping) -> Tables:
    """Cuts a single table after the last row in which a column of the mapping has one.

    Stamps count as well: rows without any other value are rows of the run. Tables of
    topics stay as they are.
    """
    if "" not in tables:
        return tables
    table = tables[""]
    columns = [
        column
        for column in (*mapping.signal_columns, mapping.time, STAMP, "timestamp")
        if column in table
    ]
    if not columns:
        return tables
    has_value = table[columns].notna().any(axis=1).to_numpy()
    rows = int(np.flatnonzero(has_value)[-1]) + 1 if has_value.any() else len(table)
    return {**tables, "": table.iloc[:rows]}


def padded_table(columns: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """Makes a table of columns (K,) of different lengths; NaN stands after short ones.

    A single number stands in the first row.
    """
    series = {name: pd.Series(values) for name, values in columns.items()}
    return pd.DataFrame(series)
