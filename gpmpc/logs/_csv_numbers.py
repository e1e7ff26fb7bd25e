"""Reads numbers that pandas left as texts: with the other decimal mark, or thousands.

The decimal mark of a text is known by its first rows. Where these hold whole numbers,
or programs of two countries wrote the columns, others follow. ``1,024`` is 1024 to one
program and 1.024 to another. Where the column or the file says that it may be
thousands, the column stays text, and a mapping that reads it is refused.
"""

import re
from typing import NamedTuple

import numpy as np
import pandas as pd

MARKS = {",": "comma", ".": "point"}
_OTHER = {",": ".", ".": ","}
_NUMBERS = {
    mark: re.compile(rf"[+-]?\d*{re.escape(mark)}\d+(?:[eE][+-]?\d+)?")
    for mark in MARKS
}
# 1,024 and 1,024,000, but not 0,024 and 1024,000
_THOUSANDS = {
    mark: re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:{re.escape(mark)}\d{{3}})+")
    for mark in MARKS
}
_WHOLE = re.compile(r"[+-]?\d+")
_POWER = re.compile(r"[+-]?\d+[eE][+-]?\d+")  # 1e-3: a number without a mark
_LARGE = 100  # a whole number from which on 1,024 beside it is rather 1024


class _Cells(NamedTuple):
    """The different kinds of numbers in a column or in a part of it."""

    marked: list[str]  # numbers with the mark
    whole: list[str]  # numbers without any
    thousands: bool  # all that are marked may have the mark for thousands

    @property
    def have_several_marks(self) -> bool:
        """Whether a number has the mark more than once, as 1,024,000 has."""
        return any(sum(map(number.count, MARKS)) > 1 for number in self.marked)

    @property
    def are_doubtful(self) -> bool:
        """Whether numbers with the mark are rather thousands.

        Who writes marks of thousands writes those below 1000 without. Who leaves out
        zeros behind a decimal mark leaves out the last ones of all.
        """
        sizes = [abs(int(number)) for number in self.whole]
        if not self.thousands or not sizes or max(sizes) >= 1000:
            return False
        keeps_zeros = any(number.endswith("0") for number in self.marked)
        return keeps_zeros or max(sizes) >= _LARGE


def _cells(numbers: list[str], mark: str) -> _Cells:
    """Sorts the numbers of a column by whether they have a mark."""
    marked = [number for number in numbers if mark in number]
    return _Cells(
        marked=marked,
        whole=[number for number in numbers if _WHOLE.fullmatch(number)],
        thousands=bool(marked) and all(map(_THOUSANDS[mark].fullmatch, marked)),
    )


def doubtful_columns(rows: list[list[str]], decimal: str) -> list[int]:
    """Finds columns whose numbers with a decimal mark may be thousands instead.

    Args:
        rows: The first ones of a text, in fields.
        decimal: The mark that they have.
    """
    width = max(map(len, rows), default=0)
    columns = [[row[i] for row in rows if i < len(row)] for i in range(width)]
    sorted_cells = [_cells(column, decimal) for column in columns]
    is_sure = any(
        not cells.thousands and any(map(_NUMBERS[decimal].fullmatch, cells.marked))
        for cells in sorted_cells
    )
    return [
        index
        for index, cells in enumerate(sorted_cells)
        if cells.thousands and (cells.whole or (decimal == "," and not is_sure))
    ]


class MarkedNumbers(NamedTuple):
    """A table in which texts of numbers are numbers."""

    table: pd.DataFrame
    unsure: list[str]  # columns that may hold thousands, and were taken as decimals
    doubts: dict[int, str]  # by columns that rather hold thousands, and stay text


def read_marked_numbers(table: pd.DataFrame, decimal: str) -> MarkedNumbers:
    """Makes numbers of columns of texts that all hold one, with either decimal mark.

    Args:
        table: As pandas read it.
        decimal: The mark that it was told.
    """
    texts = {}  # by the number of the column
    has_decimals = dict.fromkeys(MARKS, False)
    for index in range(len(table.columns)):
        column = table.iloc[:, index]
        if pd.api.types.is_numeric_dtype(column):
            values = column.to_numpy(dtype=float, na_value=np.nan)
            values = values[np.isfinite(values)]
            has_decimals[decimal] |= bool((values % 1 != 0).any())
            continue
        numbers = _numbers_of(column)
        if numbers is None:
            continue
        texts[index] = numbers
        for mark in MARKS:
            cells = _cells(numbers, mark)
            has_decimals[mark] |= bool(cells.marked) and not cells.thousands
    unsure = []
    doubts = {}
    columns = {}
    for index, numbers in texts.items():
        name = str(table.columns[index])
        marks = [mark for mark in MARKS if any(mark in number for number in numbers)]
        for mark in marks:
            cells = _cells(numbers, mark)
            has_other_mark = has_decimals[_OTHER[mark]]
            if has_decimals[mark]:  # of other columns, whose numbers surely have it
                is_doubtful = has_other_mark and mark != decimal
            else:
                is_doubtful = has_other_mark or cells.are_doubtful
            if cells.have_several_marks or (cells.thousands and is_doubtful):
                doubts[index] = _doubt(name, cells, mark)
            elif cells.thousands and not has_decimals[mark]:
                unsure.append(name)
        if len(marks) < 2 and index not in doubts:
            columns[index] = _as_floats(table.iloc[:, index])
    if not columns:
        return MarkedNumbers(table, unsure, doubts)
    series = [
        columns.get(index, table.iloc[:, index]) for index in range(len(table.columns))
    ]
    return MarkedNumbers(pd.concat(series, axis=1), unsure, doubts)


def _numbers_of(column: pd.Series) -> list[str] | None:
    """Returns the texts of a column as they stand there; None where one is no number.

    Numbers that pandas made of a part of the rows are written as it writes them.
    """
    numbers = []
    for cell in column.dropna():
        text = cell.strip() if isinstance(cell, str) else f"{cell:.17g}"
        forms = (_WHOLE, _POWER, *_NUMBERS.values(), *_THOUSANDS.values())
        if not any(form.fullmatch(text) for form in forms):
            return None
        numbers.append(text)
    return numbers or None


def _as_floats(column: pd.Series) -> pd.Series:
    """Reads the numbers of a column, which have one decimal mark or none."""
    numbers = column.map(
        lambda cell: float(cell.replace(",", ".") if isinstance(cell, str) else cell),
        na_action="ignore",
    )
    return numbers.astype(float)


def _doubt(name: str, cells: _Cells, mark: str) -> str:
    """Says of a column that it rather has marks of thousands."""
    first = cells.marked[0]
    beside = f" beside {cells.whole[0]!r}" if cells.whole else ""
    whole = first.replace(mark, "")
    return (
        f"column {name!r} holds {first!r}{beside}: is that {whole}, or has it "
        f"a decimal {MARKS[mark]}? write numbers without marks of thousands, and all "
        "with one decimal mark"
    )
