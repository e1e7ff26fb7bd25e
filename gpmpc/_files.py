"""Checks names of files, and writes files in one piece or not at all.

That holds whenever the process or the machine dies.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from gpmpc.exceptions import DataError, SettingError


@contextmanager
def whole_file(path: str | Path, flush: bool = True) -> Iterator[BinaryIO]:
    """Opens a file to be written in one piece or not at all.

    The block writes to a neighbour of it, which is flushed to the disk, and renamed if
    no error came. Behind the block both the content and the name are on the disk.

    Args:
        path: The file.
        flush: Without it the system writes the file to the disk when it likes. It is
            whole whenever this process dies; where the machine does, it may be empty.
    """
    path = Path(path)
    partial = path.parent / f".{path.name}.{os.getpid()}.partial"
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            if flush:
                os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    # on other systems a folder cannot be opened, and needs not be flushed
    if flush and os.name == "posix":
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_whole(path: str | Path, content: bytes | str, flush: bool = True) -> None:
    """Writes content to a ``whole_file``."""
    if isinstance(content, str):
        content = content.encode()
    with whole_file(path, flush) as file:
        file.write(content)


def remove_partial(folder: Path) -> None:
    """Removes the partial files of processes that were killed in ``write_whole``.

    Nobody else may be writing to the folder now.
    """
    for partial in folder.glob(".*.partial"):
        partial.unlink(missing_ok=True)


def existing_file(path: str | Path, expected: str) -> Path:
    """Returns the path of a file that exists.

    Raises:
        DataError: There is none.
        SettingError: ``path`` is no path.
    """
    if not os.path.isfile(as_path(path)):
        raise DataError(f"{path}: no such file; expected {expected}")
    return Path(path)


def new_file(path: str | Path) -> Path:
    """Returns the path of a file to be written.

    Raises:
        DataError: Its folder does not exist.
        SettingError: ``path`` is no path.
    """
    path = as_path(path)
    if not path.parent.is_dir():
        raise DataError(f"{path}: the folder {path.parent} does not exist")
    return path


def as_path(path: Any) -> Path:
    """Returns a path as such; raises ``SettingError`` where it is none."""
    if not isinstance(path, str | Path):
        raise SettingError("path", f"must be the name of one file; got {path!r}")
    return Path(path)
