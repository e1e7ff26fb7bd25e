"""Reads CSV files as tables; how a file is written is found out by ``_csv_text``.

The size of the text is counted before anything of it is parsed, and it is parsed part
by part, so that the texts in its cells are counted before there are many.
"""

import gzip
import io
import warnings
from pathlib import Path
from typing import Any

import pandas as pd

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import DataError
from gpmpc.logs._csv_text import DELIMITERS, CsvText, open_csv
from gpmpc.logs._file import (
    NUMBER_BYTES,
    TEXT_BYTES,
    LogFile,
    ReadOptions,
    check_column_count,
    run_name,
)
from gpmpc.logs._findings import Finding

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
    findings: tuple[Finding, ...] = ()
    if csv.is_cut:
        text = "the last line has no end, and may be cut within a number: left out"
        findings = (Finding("cut line", run_name(path), 1, text),)
    return LogFile({"": table.rename(columns=str.strip)}, findings)


def _open(path: Path) -> io.BufferedReader:
    """Opens a file, unpacked where it is packed."""
    if path.name.lower().endswith(".gz"):
        return io.BufferedReader(gzip.GzipFile(path))
    return path.open("rb")


def _check_text(path: Path, budget: MemoryBudget) -> None:
    """Counts what a text file unfolds to, before anything of it is parsed."""
    with _open(path) as file:
        first_line = file.readline(LONGEST_LINE)
        check_column_count(path, _count_delimiters(first_line) + 1)
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
        sep=csv.delimiter,
        decimal=csv.decimal,
        chunksize=max(_CELLS_PER_PART // len(csv.names), 1),
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
