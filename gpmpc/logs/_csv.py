"""Reads texts of rows as tables; how one is written is found out by ``_csv_text``.

The size of the text is counted before anything of it is parsed, and it is parsed part
by part, so that the texts in its cells are counted before there are many.
"""

import gzip
import io
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import DataError
from gpmpc.logs._columns import with_unique_names
from gpmpc.logs._csv_numbers import read_marked_numbers
from gpmpc.logs._csv_text import DELIMITERS, WHITE_SPACE, CsvText, open_csv
from gpmpc.logs._file import (
    NUMBER_BYTES,
    TEXT_BYTES,
    LogFile,
    ReadOptions,
    blocks_of,
    check_column_count,
    run_name,
    with_blocks,
    with_doubts,
)
from gpmpc.logs._findings import Finding
from gpmpc.logs._list_cells import unpack_lists
from gpmpc.logs._units import with_units

LONGEST_LINE = 2**20  # of a text file [bytes]
_DELIMITERS = [mark.encode() for mark in DELIMITERS]
_CELLS_PER_PART = 500_000  # that are parsed at once
_QUOTED_COPIES = 3  # further ones of a text in quotes, which may stand over many lines
# Before version 3, pandas reads some numbers wrong in their last digit otherwise.
_EXACT: dict[str, Any] = {}
if int(pd.__version__.split(".")[0]) < 3:
    _EXACT = {"float_precision": "round_trip"}


def read_csv(path: Path, options: ReadOptions) -> LogFile:
    """Reads a file, packed or not, as one table."""
    budget = MemoryBudget(path)
    _check_text(path, budget)
    with _open(path) as file:
        csv = open_csv(str(path), file)
        with warnings.catch_warnings():  # of rows that are longer than the header
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = _read_in_parts(csv, budget)
    swallowed = csv.stream.rows - len(table)
    table.columns = _column_names(csv)
    units = dict(zip(table.columns, csv.units, strict=False))
    table, unsure, doubts = read_marked_numbers(_without_empty_end(table), csv.decimal)
    unique_names = with_unique_names(table).columns
    doubt_by_name = {str(unique_names[index]): doubts[index] for index in doubts}
    table = unpack_lists(path, table, budget)
    findings = (
        *_findings(path, csv, swallowed),
        *_unsure_marks(path, unsure),
        *(Finding("thousands", run_name(path), 1, doubts[index]) for index in doubts),
    )
    table = with_doubts(with_units(table, units), doubt_by_name)
    if not swallowed:  # lines are rows
        table = with_blocks(table, blocks_of(csv.rows_behind_blank, len(table)))
    return LogFile({"": table}, findings)


def _unsure_marks(path: Path, columns: Sequence[str]) -> Iterator[Finding]:
    """Yields a finding of columns whose decimal mark may mark thousands."""
    if columns:
        text = (
            f"the numbers of {', '.join(columns)} have three digits behind a mark, as "
            "in 1,024: it is taken for the decimal mark; does it mark thousands?"
        )
        yield Finding("decimal mark", run_name(path), len(columns), text)


def _column_names(csv: CsvText) -> list[str]:
    """Names the columns; those without a name by their numbers, from 1 on."""
    names = [*csv.names, *[""] * (csv.columns - len(csv.names))]
    return [name or str(number) for number, name in enumerate(names, start=1)]


def _without_empty_end(table: pd.DataFrame) -> pd.DataFrame:
    """Leaves out last columns without name and value, as behind a comma at the end."""
    columns = len(table.columns)
    while columns > 1:
        is_nameless = table.columns[columns - 1] == str(columns)
        if not is_nameless or table.iloc[:, columns - 1].notna().any():
            break
        columns -= 1
    return table.iloc[:, :columns]


def _findings(path: Path, csv: CsvText, swallowed: int) -> Iterator[Finding]:
    """Yields what was noticed in a text, once all of it is read.

    Args:
        path: Of the file.
        csv: The text.
        swallowed: Lines that became no row of their own.
    """
    run = run_name(path)
    if csv.skipped:
        lines = "1 line" if csv.skipped == 1 else f"{csv.skipped} lines"
        text = f"{lines} before the rows without names of columns: left out"
        yield Finding("lines before the rows", run, csv.skipped, text)
    if not csv.names:
        text = (
            "no line names the columns: where a mapping has no names for them, they "
            "are called by their numbers, 1, 2, ..."
        )
        yield Finding("no names", run, csv.columns, text)
    blank = len(csv.rows_behind_blank)
    if blank:
        is_parted = not swallowed and blocks_of(csv.rows_behind_blank, csv.stream.rows)
        effect = "rows behind them are pieces of their own"
        if not is_parted:
            effect = "they are no step of the time"
        text = (
            f"{blank} blank lines between rows: left out; where rows are counted, "
            f"{effect}"
        )
        yield Finding("blank lines", run, blank, text)
    if swallowed > 0:
        text = (
            f"{swallowed} lines stand inside texts in quotes, and are no rows: is a "
            "quote alone in its cell?"
        )
        yield Finding("lines in quotes", run, swallowed, text)
    if csv.is_cut:
        text = "the last line has no end, and may be cut within a number: left out"
        yield Finding("cut line", run, 1, text)


def _open(path: Path) -> io.BufferedReader:
    """Opens a file, unpacked where it is packed."""
    if path.name.lower().endswith(".gz"):
        return io.BufferedReader(gzip.GzipFile(path))
    return path.open("rb")


def _check_text(path: Path, budget: MemoryBudget) -> None:
    """Counts what a text file unfolds to, before anything of it is parsed."""
    with _open(path) as file:
        first_line = file.readline(LONGEST_LINE)
        check_column_count(path, _count_delimiters(b" ".join(first_line.split())) + 1)
        block = first_line
        copies = 1
        while block:
            lines = max(block.count(b"\n"), block.count(b"\r"))
            if len(block) == LONGEST_LINE and not lines:
                raise DataError(f"{path}: has a line of more than {LONGEST_LINE} bytes")
            if b'"' in block:
                copies = 1 + _QUOTED_COPIES
            cells = _count_delimiters(block) + lines
            budget.take(copies * len(block) + NUMBER_BYTES * cells, "its text")
            block = file.read(LONGEST_LINE)


def _count_delimiters(text: bytes) -> int:
    return max(text.count(delimiter) for delimiter in _DELIMITERS)


def _read_in_parts(csv: CsvText, budget: MemoryBudget) -> pd.DataFrame:
    """Parses text part by part, so that texts are counted before there are many."""
    parts: list[pd.DataFrame] = []
    text_columns: set[Any] = set()
    with pd.read_csv(
        csv.stream,
        sep=r"\s+" if csv.delimiter == WHITE_SPACE else csv.delimiter,
        decimal=csv.decimal,
        dtype=dict.fromkeys(csv.doubtful, str),
        header=None,
        names=range(csv.columns),
        chunksize=max(_CELLS_PER_PART // csv.columns, 1),
        index_col=False,
        skipinitialspace=True,
        **_EXACT,
    ) as reader:
        for part in reader:
            texts = part.select_dtypes(exclude=["number", "bool"])
            budget.take(TEXT_BYTES * texts.size, "its texts")
            text_columns.update(texts.columns)
            parts.append(part)
    # Numbers in a column that also holds texts become objects, like texts.
    numbers = sum(part[column].size for part in parts for column in text_columns)
    budget.take(TEXT_BYTES * numbers, "its texts")
    return pd.concat(parts, ignore_index=True)
