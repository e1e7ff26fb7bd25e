"""The file of a recorder: what was written is saved when the recorder says so."""

import os
from pathlib import Path

from filelock import lock_descriptor

from gpmpc.exceptions import RecordingError


class Sink:
    """A file that collects what the library writes until it is saved.

    So an error of the disk reaches the caller. A writer that is not closed adds a
    footer when Python collects it: what is never saved does no harm.

    Args:
        path: Its folder is made; an older file is replaced.

    Raises:
        RecordingError: It cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path):
        self._data = bytearray()
        self._position = 0
        self._is_closed = False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.descriptor = os.open(
                path, os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666
            )
        except OSError as error:
            raise RecordingError(
                f"{path}: cannot be written: {error.strerror}"
            ) from error
        if not lock_descriptor(self.descriptor, blocking=False):
            os.close(self.descriptor)
            raise RecordingError(f"{path}: another process is recording to this file")
        os.ftruncate(self.descriptor, 0)

    def close(self) -> None:
        """Closes the file, once; other processes may write it from now on."""
        if not self._is_closed:
            self._is_closed = True
            os.close(self.descriptor)

    @property
    def unsaved(self) -> bytes:
        """The bytes that were written since it was saved."""
        return bytes(self._data)

    def write(self, data: bytes | bytearray) -> int:
        """Takes all of the data."""
        self._data += data
        self._position += len(data)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Returns the position, which the library reads although it does not seek."""
        return self._position

    def flush(self) -> None:
        """Does nothing: see ``save``."""

    def save(self, sync: bool) -> None:
        """Writes what was collected, and puts it on the disk if asked to."""
        unwritten = memoryview(self._data)
        self._data = bytearray()
        while unwritten:
            unwritten = unwritten[os.write(self.descriptor, unwritten) :]
        if sync:
            os.fsync(self.descriptor)
