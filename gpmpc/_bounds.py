"""Bounds the memory of a file's content: a small file cannot ask for all memory."""

from pathlib import Path

from gpmpc.exceptions import DataError

LARGEST = 32 * 2**20  # of a record or an unfolded chunk of a recording [bytes]
_LEAST_LIMIT = 64 * 2**20  # [bytes]
_RATIO = 300  # bytes a byte of the file; recordings are compressed 2 to 10 times


def memory_limit(path: Path) -> int:
    """Returns the memory that the content of a file or a folder may take [bytes].

    Recordings and logs of this size hold far less.
    """
    return _LEAST_LIMIT + _RATIO * _size(path)


def _size(path: Path) -> int:
    """Returns the size of a file, or of the files in a folder [bytes]."""
    if not path.is_dir():
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.iterdir() if file.is_file())


class MemoryBudget:
    """The memory that a file's content may still take.

    Readers take from it before they allocate. Records that are skipped cost time and
    hardly any memory, and are counted as memory too: so time is bounded as well. Each
    stage has a budget of its own: reading a file, and making rows of its tables.
    """

    def __init__(self, path: Path):
        self.path = path
        self.size = memory_limit(path)  #: [bytes]
        self.left = float(self.size)  #: [bytes]

    def take(self, size: float, what: str) -> None:
        """Takes ``size`` bytes for ``what``; ``DataError`` where fewer are left."""
        self.left -= size
        if self.left < 0:
            file_size = _size(self.path) / 1e6
            raise DataError(
                f"{self.path}: {what} would take more than the {self.size / 1e6:.0f} MB"
                f" that a file of {file_size:.3g} MB may take; a log that is so large"
                " is read in parts, or uncompressed"
            )
