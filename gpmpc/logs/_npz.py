"""Reads NumPy archives: each array is a column, or several where it has two axes."""

import math
import zipfile
from collections.abc import Set
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import DataError
from gpmpc.logs._columns import padded_table
from gpmpc.logs._file import (
    NUMBER_BYTES,
    TEXT_BYTES,
    LogFile,
    ReadOptions,
    check_column_count,
    unread_columns,
)


class _DeclaredArray(NamedTuple):
    """What the head of an array says before its values are read."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def is_table(self) -> bool:
        """Whether it is a number, or has columns of numbers, times or short texts."""
        if not self.shape:
            return self.is_number
        return len(self.shape) in (1, 2) and self.dtype.kind in "biufSUmM"

    @property
    def is_row(self) -> bool:
        """Whether it is one row of several values."""
        return len(self.shape) == 2 and self.shape[0] == 1 and self.shape[1] > 1

    def is_sideways(self, lengths: Set[int]) -> bool:
        """Tells whether its columns are those of a log and not its rows.

        ``lengths`` are those of the archive's arrays of one dimension.
        """
        if len(self.shape) != 2:
            return False
        rows, columns = self.shape
        is_as_long = columns in lengths and rows not in lengths
        return self.is_row or (is_as_long and rows < columns)

    def count_columns(self, lengths: Set[int]) -> int:
        """Returns the number of columns that it becomes."""
        if self.is_sideways(lengths):
            return self.shape[0]
        return math.prod(self.shape[1:])

    @property
    def is_number(self) -> bool:
        return self.dtype.kind in "biuf"


def read_npz(path: Path, options: ReadOptions) -> LogFile:
    """Reads the arrays of an archive as the columns of one table.

    An array has its columns side by side, or below each other where these are as long
    as the arrays of one dimension. One of a single row is a column: those of MATLAB are
    row vectors.
    """
    declared = _declared_arrays(path)
    tables = {name: array for name, array in declared.items() if array.is_table}
    lengths = {array.shape[0] for array in tables.values() if len(array.shape) == 1}
    _take_memory(path, tables, lengths)
    columns: dict[str, np.ndarray] = {}
    with np.load(path, allow_pickle=False) as archive:
        for name, array in tables.items():
            values: Any = np.atleast_1d(archive[name])
            if array.shape:
                values = values.reshape(array.shape)
            if array.dtype.kind == "S":
                values = np.char.decode(values, "utf-8", "replace")
            if array.is_row:
                columns[name] = values[0]
                continue
            if len(array.shape) < 2:
                columns[name] = values
                continue
            columns_first = values if array.is_sideways(lengths) else values.T
            for i, column in enumerate(columns_first):
                columns[f"{name}[{i}]"] = column
    unread = sorted(declared.keys() - tables.keys())
    return LogFile({"": padded_table(columns)}, unread_columns(path, unread))


def _take_memory(
    path: Path, tables: dict[str, _DeclaredArray], lengths: Set[int]
) -> None:
    """Counts what arrays take before they are read."""
    budget = MemoryBudget(path)
    check_column_count(
        path, sum(array.count_columns(lengths) for array in tables.values())
    )
    for name, array in tables.items():
        bytes_per_cell = NUMBER_BYTES
        if array.dtype.kind in "SU":
            bytes_per_cell = TEXT_BYTES + 2 * array.dtype.itemsize
        label = f"array {name!r} of shape {array.shape}"
        budget.take(math.prod(array.shape) * bytes_per_cell, label)


def _declared_arrays(path: Path) -> dict[str, _DeclaredArray]:
    """Reads the heads of the arrays of an archive."""
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise DataError(f"{path}: array {name!r} is compressed in another way")
            array = _read_head(archive, member)
            size = math.prod(array.shape) * array.dtype.itemsize
            is_too_short = array.dtype.kind != "O" and size > member.file_size
            if min(array.shape, default=0) < 0 or is_too_short:
                raise DataError(f"{path}: array {name!r} is shorter than its head says")
            arrays[name] = array
    return arrays


def _read_head(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> _DeclaredArray:
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        elif version == (2, 0):
            shape, _, dtype = np.lib.format.read_array_header_2_0(file)
        else:  # of structured arrays, which are no columns
            return _DeclaredArray(shape=(), dtype=np.dtype(object))
    if len(shape) > 2 and sum(length != 1 for length in shape) < 2:
        shape = (math.prod(shape),)  # a signal of Simulink has axes of length 1
    return _DeclaredArray(shape=shape, dtype=dtype)
