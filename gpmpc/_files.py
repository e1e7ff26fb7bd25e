"""Checks names of files, and writes files in one piece or not at all, whenever the process or the machine dies."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from gpmpc.exceptions import DataError, SettingError


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file to write in one piece or not at all: a neighbour, flushed to the disk and renamed if no error came.

    Behind the block both the content and the name are on the disk.
    """
    path = Path(path)
    partial = path.parent / f".{path.name}.{os.getpid()}.partial"
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    if (
        os.name == "posix"
    ):  # elsewhere a folder cannot be opened, and needs not be flushed
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_whole(path: str | Path, content: bytes | str) -> None:
    """Writes a ``whole_file``."""
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def remove_partial(folder: Path) -> None:
    """Removes what processes that were killed have left of ``write_whole``, where nobody else is writing now."""
    for left in folder.glob(".*.partial"):
        left.unlink(missing_ok=True)


def existing_file(path: str | Path, expected: str) -> Path:
    """The path of a file that is there; ``DataError`` where none is, ``SettingError`` of what is no path."""
    if not os.path.isfile(_path(path)):
        raise DataError(f"{path}: no such file; expected {expected}")
    return Path(path)


def new_file(path: str | Path) -> Path:
    """The path of a file to be written; ``DataError`` without its folder, ``SettingError`` of what is no path."""
    path = _path(path)
    if not path.parent.is_dir():
        raise DataError(f"{path}: the folder {path.parent} does not exist")
    return path


def _path(path: Any) -> Path:
    if not isinstance(path, str | Path):
        raise SettingError("path", f"must be the name of one file; got {path!r}")
    return Path(path)
