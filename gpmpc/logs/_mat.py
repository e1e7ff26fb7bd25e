"""Reads MATLAB's files: each vector or matrix of numbers is a column or several.

The fields of a structure are called as in MATLAB, ``data.u``, and so are the entries of
lists, ``data(2).u`` and ``y{1}``. The longer side of a matrix is the time.
Source of the format: MAT-File Format, The MathWorks (version 5); version 7.3 is HDF5.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import DataError
from gpmpc.logs._columns import padded_table
from gpmpc.logs._file import (
    NUMBER_BYTES,
    LogFile,
    ReadOptions,
    check_column_count,
    unread_columns,
)

_HEADER = 128  # of a file of version 5 [bytes]
_MATRIX = 14  # kinds of elements
_COMPRESSED = 15
_ELEMENT_BYTES = 256  # what an element costs in memory
_COPIES = 16  # of a byte: MATLAB stores numbers in fewer bytes than they are read in
_DEEPEST = 20  # structures and cells within each other
_PIECE = 2**20  # that is unfolded at once [bytes]
_HDF5 = b"MATLAB 7.3"


_OPAQUE_FIELDS = ("s0", "s1", "s2")  # name, system and class of objects, for SciPy


class _Array(NamedTuple):
    """Values with the name by which MATLAB finds them."""

    name: str
    values: Any


def read_mat(path: Path, options: ReadOptions) -> LogFile:
    """Reads a file's arrays as one table; NaN stands behind the shorter ones."""
    budget = MemoryBudget(path)
    with path.open("rb") as file:
        head = file.read(_HEADER)
    if head.startswith(_HDF5):
        arrays = list(_hdf5_arrays(path, budget))
    else:
        arrays = list(_arrays_of_version_5(path, head, budget))
    columns: dict[str, np.ndarray] = {}
    unread = []
    for name, values in map(_without_single_axes, arrays):
        if not _holds_columns(values):
            unread.append(name)
            continue
        check_column_count(path, len(columns) + min(values.shape))
        columns |= _columns_of(name, values)
    longest = max(map(len, columns.values()), default=0)
    budget.take(NUMBER_BYTES * longest * len(columns), "its table")
    return LogFile({"": padded_table(columns)}, unread_columns(path, unread))


def _without_single_axes(array: _Array) -> _Array:
    """Leaves out axes of length 1 that an array has beyond two.

    Simulink writes a signal of K samples as 1 x 1 x K.
    """
    values = array.values
    if not isinstance(values, np.ndarray) or values.ndim < 3:
        return array
    values = values.squeeze()
    return array._replace(values=np.atleast_2d(values) if values.size else values)


def _holds_columns(values: Any) -> bool:
    return (
        isinstance(values, np.ndarray)
        and values.dtype.kind in "biuf"
        and values.ndim == 2
        and values.size > 0
    )


def _columns_of(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Splits a matrix into columns of floats, along its longer side."""
    rows = values if values.shape[0] >= values.shape[1] else values.T
    rows = rows.astype(float)
    if rows.shape[1] == 1:
        return {name: rows[:, 0]}
    return {f"{name}[{i}]": column for i, column in enumerate(rows.T)}


def _arrays_of_version_5(
    path: Path, head: bytes, budget: MemoryBudget
) -> Iterator[_Array]:
    """Yields the arrays of a file of version 4 to 7."""
    from scipy.io import loadmat

    if head[124:128] in (b"\x00\x01IM", b"\x01\x00MI"):
        _check_elements(path, budget)
    for name, values in loadmat(path).items():
        if not name.startswith("__"):
            yield from _inner_arrays(name, values)


def _inner_arrays(name: str, values: Any) -> Iterator[_Array]:
    """Yields the arrays inside a structure or a cell array; others as they are."""
    is_list = isinstance(values, np.ndarray) and values.size > 1
    fields = values.dtype.names if isinstance(values, np.ndarray) else None
    if fields and fields[:3] == _OPAQUE_FIELDS:
        entry = values.flat[0]
        variable = _plain_text(entry["s0"])
        kind = _plain_text(entry["s2"])
        label = f"{variable} (a {kind} object of MATLAB: save its numbers as an array)"
        yield _Array(label, None)
    elif fields:
        for number, entry in enumerate(values.flat, start=1):
            prefix = f"{name}({number})" if is_list else name
            for field in fields:
                yield from _inner_arrays(f"{prefix}.{field}", entry[field])
    elif isinstance(values, np.ndarray) and values.dtype == object:
        for number, entry in enumerate(values.flat, start=1):
            yield from _inner_arrays(f"{name}{{{number}}}", entry)
    else:
        yield _Array(name, values)


def _plain_text(text: Any) -> str:
    return text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)


def _check_elements(path: Path, budget: MemoryBudget) -> None:
    """Counts what a file of version 5 unfolds to, and how deep it is nested.

    Raises:
        DataError: It would take too much, or is nested too deeply to be read.
    """
    content = path.read_bytes()
    order = "<" if content[126:128] == b"IM" else ">"
    position = _HEADER
    while position + 8 <= len(content):
        kind, length = struct.unpack_from(f"{order}II", content, position)
        element = content[position + 8 : position + 8 + length]
        if kind == _COMPRESSED:
            _check_nesting(path, _unfold(element, budget), order, budget)
        else:
            budget.take(_COPIES * len(element), "its arrays")
            whole = content[position : position + 8 + length]
            _check_nesting(path, whole, order, budget)
        position += 8 + length


def _unfold(packed: bytes, budget: MemoryBudget) -> bytes:
    """Decompresses an element piece by piece."""
    unpacker = zlib.decompressobj()
    pieces = []
    piece = unpacker.decompress(packed, _PIECE)
    while piece:
        budget.take(_COPIES * len(piece), "its arrays")
        pieces.append(piece)
        piece = unpacker.decompress(unpacker.unconsumed_tail, _PIECE)
    return b"".join(pieces)


def _check_nesting(path: Path, data: bytes, order: str, budget: MemoryBudget) -> None:
    """Raises ``DataError`` where arrays lie too deep within each other."""
    ends = [len(data)]  # of the arrays around the position
    position = 0
    while position + 8 <= len(data):
        while len(ends) > 1 and position >= ends[-1]:
            ends.pop()
        budget.take(_ELEMENT_BYTES, "its elements")
        kind, length = struct.unpack_from(f"{order}II", data, position)
        is_small = kind > 0xFFFF  # the length stands in the upper half
        if is_small:
            position += 8
        elif kind == _MATRIX:
            position += 8
            ends.append(position + length)
        else:
            position += 8 + -(-length // 8) * 8
        if len(ends) > _DEEPEST:
            raise DataError(f"{path}: is nested deeper than {_DEEPEST} levels")


def _hdf5_arrays(path: Path, budget: MemoryBudget) -> Iterator[_Array]:
    """Yields the arrays of a file of version 7.3."""
    try:
        import h5py  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise DataError(
            f"{path}: is of MATLAB's version 7.3 (HDF5): save it with '-v7' in MATLAB, "
            "or pip install h5py"
        ) from error
    with h5py.File(path, "r") as file:
        names: list[str] = []
        file.visit(names.append)  # of each object once, links not followed
        for name in names:
            if name.startswith("#"):  # what references of cells point to
                continue
            values = file[name]
            if not isinstance(values, h5py.Dataset):
                continue
            size = math.prod(values.shape or (0,))
            is_numeric = (
                values.dtype.kind in "biuf" and "MATLAB_empty" not in values.attrs
            )
            is_text = values.attrs.get("MATLAB_class") == b"char"
            if is_numeric and not is_text:
                budget.take(NUMBER_BYTES * size, f"array {name!r}")
                yield _Array(name.replace("/", "."), np.asarray(values[()]).T)
            else:
                yield _Array(name.replace("/", "."), None)
