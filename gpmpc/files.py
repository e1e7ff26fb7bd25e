"""Problem: a file that looks finished has to be finished, whenever the process or the machine dies."""

import os
from pathlib import Path


def write_whole(path: str | Path, content: bytes | str) -> None:
    """Writes a file in one piece or not at all: to a neighbour first, flushed to the disk, then renamed over it.

    When it returns, both the content and the name are on the disk.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    if os.name == "posix":  # elsewhere a folder cannot be opened, and needs not be flushed
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def remove_partial(folder: Path) -> None:
    """Removes what processes that were killed have left of ``write_whole``, where nobody else is writing now."""
    for left in folder.glob(".*.partial"):
        left.unlink(missing_ok=True)
