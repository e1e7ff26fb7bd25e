"""The .npz files of transitions and of the models of gpmpc 1, which no damaged file passes for.

The file is an ``.npz`` archive, as NumPy makes it: a zip of ``.npy`` arrays, each with its own CRC-32, and here of a
``header.json``, which holds a checksum of itself and of the arrays' names, sizes and CRCs: parts that changed places
are noticed. Before anything is read, what the archive declares is held against its size. No pickle: reading runs no
code.

Damage makes zipfile, json and NumPy raise whatever they come upon first (struct.error, EOFError, MemoryError, ...):
callers of ``read_header``, ``read_arrays`` and ``check_whole`` take any exception for one and name the file.
"""

import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gpmpc.exceptions import DataError, SettingError

HEADER = "header.json"
_EXPANSION = 20  # times its size is what a compressed file may hold: measured numbers shrink to a half, or a tenth
_LONGEST = 2**20  # bytes of a header
_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def existing_file(path: str | Path, expected: str) -> Path:
    """The path of a file that is there.

    Raises:
        SettingError: It is no path.
        DataError: There is no file, or it cannot be looked at.
    """
    try:
        found = _path(path).is_file()
    except OSError as error:
        raise DataError(f"{path}: cannot be looked at ({error.strerror}); expected {expected}") from error
    if not found:
        raise DataError(f"{path}: no such file; expected {expected}")
    return Path(path)


def new_file(path: str | Path) -> Path:
    """The path of a file that can be written.

    Raises:
        SettingError: It is no path.
        DataError: The folder does not exist.
    """
    path = _path(path)
    if not path.parent.is_dir():
        raise DataError(f"{path}: the folder {path.parent} does not exist")
    return path


def pack(header: dict[str, Any], arrays: Iterable[tuple[str, np.ndarray]]) -> bytes:
    """The content of a file that holds a header and named arrays, uncompressed."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, value in arrays:
            array = io.BytesIO()
            np.lib.format.write_array(array, value, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), array.getvalue())
        header = header | {"checksum": _checksum(header, archive)}
        archive.writestr(zipfile.ZipInfo(HEADER), json.dumps(header, indent=2))
    return content.getvalue()


def read_header(path: Path) -> Any:
    """Reads ``header.json``; None where there is none."""
    with _opened(path) as (archive, _):
        if HEADER not in archive.namelist():
            return None
        if archive.getinfo(HEADER).file_size > _LONGEST:
            raise ValueError(f"{HEADER} is longer than {_LONGEST} bytes")
        return json.loads(archive.read(HEADER))


def read_arrays(path: Path, names: Collection[str] | None = None) -> Iterator[tuple[str, np.ndarray]]:
    """Names and read-only arrays of real numbers, one after another; all of them, or those of the given names."""
    with _opened(path) as (archive, size):
        left = _EXPANSION * size // 8  # numbers
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name != info.filename and (names is None or name in names):
                array = _array(name, archive.read(info), left)  # compares the CRC
                left -= array.size
                yield name, array


def check_whole(path: Path, header: dict[str, Any]) -> None:
    """Raises where header and arrays are not those that were written together; files without a checksum pass."""
    with _opened(path) as (archive, _):
        if "checksum" in header and header["checksum"] != _checksum(header, archive):
            raise ValueError("the checksum of its parts differs from the one in its header")


def _path(path: Any) -> Path:
    if not isinstance(path, str | Path):
        raise SettingError("path", f"must be the name of one file; got {path!r}")
    return Path(path)


def _checksum(header: dict[str, Any], archive: zipfile.ZipFile) -> str:
    parts = sorted((i.filename, i.file_size, i.CRC) for i in archive.infolist() if i.filename.endswith(".npy"))
    said = {key: value for key, value in header.items() if key != "checksum"}
    return hashlib.sha256(json.dumps([said, parts], sort_keys=True).encode()).hexdigest()


class _File(io.FileIO):
    """Sets aside no more memory for a read than the file has left, whatever a damaged number demands."""

    def read(self, count: int | None = -1) -> bytes:
        left = max(os.fstat(self.fileno()).st_size - self.tell(), 0)
        return super().read(left if count is None or count < 0 else min(count, left))


@contextmanager
def _opened(path: Path) -> Iterator[tuple[zipfile.ZipFile, int]]:
    """The archive and its size, after what it declares was held against that."""
    size = path.stat().st_size
    with _File(path) as file, zipfile.ZipFile(file) as archive:
        for info in archive.infolist():
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"{info.filename} is compressed in a way that is not read; write it uncompressed")
        declared = sum(info.file_size for info in archive.infolist())
        if declared > _EXPANSION * size:
            raise ValueError(f"declares {declared} bytes, more than a file of {size} bytes can hold")
        yield archive, size


def _array(name: str, data: bytes, most: int) -> np.ndarray:
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in _READERS:
        raise ValueError(f"{name} is in version {version} of the .npy format")
    shape, by_columns, dtype = _READERS[version](file)
    if dtype.kind not in "fiu":
        raise ValueError(f"{name} must hold real numbers; got {dtype}")
    rest, count = len(data) - file.tell(), math.prod(shape)
    if min(shape, default=0) < 0 or count > most or count * dtype.itemsize != rest:
        raise ValueError(f"{name} declares {shape} numbers of {dtype}, but holds {rest} bytes")
    return np.frombuffer(data, dtype, count, file.tell()).reshape(shape, order="F" if by_columns else "C")
