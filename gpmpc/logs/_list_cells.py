"""Cells of texts that hold lists of numbers, such as "[0.1, 0.2]" or "[0.1 0.2]".

So pandas writes a column of arrays. Each number of the lists becomes a column.
"""

import re
from pathlib import Path

import numpy as np
import pandas as pd

from gpmpc._bounds import MemoryBudget
from gpmpc._dynamics import Array
from gpmpc.logs._file import NUMBER_BYTES, check_column_count

_LIST = re.compile(r"\s*[\[(]([^\[\]()]*)[\])]\s*")
_SEPARATORS = re.compile(r"[,;\s]+")
_LONGEST = 64  # of a list, as in messages of bags


def unpack_lists(path: Path, table: pd.DataFrame, budget: MemoryBudget) -> pd.DataFrame:
    """Replaces columns of lists by columns ``name[0]``, ``name[1]``, ...

    A column stays as it is unless all of its lists are of numbers and equally long.
    """
    columns: list[pd.Series] = []
    for name, column in table.items():
        lists = _read_lists(column, budget)
        if lists is None:
            columns.append(column)
            continue
        for i, numbers in enumerate(lists.T):
            columns.append(pd.Series(numbers, name=f"{name}[{i}]"))
    if len(columns) == len(table.columns):
        return table
    check_column_count(path, len(columns))
    return pd.concat(columns, axis=1)


def _read_lists(column: pd.Series, budget: MemoryBudget) -> Array | None:
    """Reads the lists of a column (rows, entries); None where it has none.

    A cell without a list has numbers that are missing.
    """
    if pd.api.types.is_numeric_dtype(column):
        return None
    first = column.first_valid_index()
    if first is None:
        return None
    entries = _read_list(column[first])
    if entries is None or not 0 < len(entries) <= _LONGEST:
        return None
    budget.take(NUMBER_BYTES * len(column) * len(entries), "its lists")
    rows = np.full((len(column), len(entries)), np.nan)
    for row, (cell, is_missing) in enumerate(zip(column, column.isna(), strict=True)):
        if is_missing:
            continue
        numbers = _read_list(cell)
        if numbers is None or len(numbers) != len(entries):
            return None
        rows[row] = numbers
    return rows


def _read_list(cell: object) -> list[float] | None:
    """Reads the numbers of a list; None where a cell is none."""
    match = _LIST.fullmatch(cell) if isinstance(cell, str) else None
    if match is None:
        return None
    try:
        return [float(text) for text in _SEPARATORS.split(match[1].strip()) if text]
    except ValueError:
        return None
