"""Checks names of files, and writes files in one piece or not at all.

That holds whenever the process or the machine dies.
"""

import os
import platform
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
    # Processes of several machines may write to one folder at the same time.
    writer = f"{platform.node()}.{os.getpid()}"
    partial = path.parent / f".{path.name}.{writer}.partial"
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


def folders_below(tree: str | Path) -> Iterator[tuple[str, list[str]]]:
    """Yields every folder in a tree, itself included, and the names of its files.

    Links to folders are followed, unless what they lead to is in the tree anyway.
    """
    seen: set[str] = set()
    starts = [str(tree)]
    while starts:
        links: list[str] = []
        for start in starts:
            origin = os.path.realpath(start)
            for folder, subfolders, files in os.walk(start):
                real_folder = origin + folder[len(start) :]
                if real_folder in seen:
                    subfolders.clear()
                    continue
                seen.add(real_folder)
                paths = [os.path.join(folder, name) for name in subfolders]
                links += filter(os.path.islink, paths)
                yield folder, files
        starts = links


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
