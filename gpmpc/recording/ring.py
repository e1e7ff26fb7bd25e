"""Problem: hand a hundred kilobytes a millisecond from one process to another, and let the giver pay for one copy only.

A pipe makes the giver pay for a system call, fresh kernel memory and the taker's waking up at every step. Here the two
share a ring of memory: the giver copies a frame behind the last one and advances a position, the taker follows. The
pipe remains as a doorbell that is rung after ``BATCH`` bytes or ``PAUSE`` seconds; it carries the position up to which
frames are whole (a system call on either side orders memory on any processor), and its end says that the giver died.

A frame lies in one piece: if it does not fit before the end of the ring, a frame of kind ``SKIP`` fills up.
"""

import mmap
import os
import struct
import tempfile
from collections.abc import Sequence

import numpy as np

FRAME = struct.Struct("<qq")  # kind, length of what follows [bytes]
POSITION = struct.Struct("<q")  # what the doorbell carries
SKIP = -1
CAPACITY = 16 * 1024 * 1024  # [bytes]; the most memory that waiting steps take
BATCH = 1024 * 1024  # [bytes]
PAUSE = 0.05  # [s]
_POSITIONS = 64  # bytes before the ring, for the two positions
_ALIGNMENT = FRAME.size


def open_memory() -> int:
    """The descriptor of memory for a ring; to be closed, and inherited by the other process.

    Raises:
        OSError: There is none.
    """
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("gpmpc-recording")
    else:  # not Linux
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    try:
        os.ftruncate(descriptor, _POSITIONS + CAPACITY)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


class Ring:
    """One side of the shared memory; positions count all bytes since the start.

    Args:
        descriptor: Of ``open_memory``; may be closed afterwards.
    """

    def __init__(self, descriptor: int):
        self._map = mmap.mmap(descriptor, _POSITIONS + CAPACITY)
        self._memory = memoryview(self._map)
        self._positions = self._memory[:16].cast("q")  # given, taken
        self._bytes = self._memory[_POSITIONS:]
        self._numbers = np.frombuffer(self._bytes, np.float64)

    def touch(self) -> None:
        """Makes the system provide the memory now, not page by page in the loop."""
        self._bytes[:] = bytes(CAPACITY)

    @property
    def given(self) -> int:
        """Position behind the last frame."""
        return self._positions[0]

    def give(self, head: bytes, arrays: Sequence[np.ndarray] = (), length: int = 0) -> bool:
        """Appends a frame, if there is room.

        Args:
            head: ``FRAME`` and what follows; of whole multiples of eight bytes where arrays follow.
            arrays: Numbers behind it, of any shape, written row by row as float64.
            length: Of all arrays together [bytes]; with the head no more than half the ring.
        """
        given, taken = self._positions
        size = -(-(len(head) + length) // _ALIGNMENT) * _ALIGNMENT
        start = given % CAPACITY
        skipped = CAPACITY - start if start + size > CAPACITY else 0
        if given + skipped + size - taken > CAPACITY:
            return False
        if skipped:
            FRAME.pack_into(self._bytes, start, SKIP, skipped - FRAME.size)
            start = 0
        self._bytes[start : start + len(head)] = head
        at, numbers = (start + len(head)) // 8, self._numbers
        for array in arrays:
            end = at + array.size
            numbers[at:end] = array.ravel()
            at = end
        self._positions[0] = given + skipped + size
        return True

    def take(self, until: int) -> tuple[int, memoryview] | None:
        """Kind and content of the next frame, valid until ``done``; None at the position ``until``.

        Args:
            until: A position that the giver has announced.
        """
        while self._positions[1] < until:
            start = self._positions[1] % CAPACITY
            kind, length = FRAME.unpack_from(self._bytes, start)
            if kind != SKIP:
                return kind, self._bytes[start + FRAME.size : start + FRAME.size + length]
            self._positions[1] += FRAME.size + length
        return None

    def done(self, length: int) -> None:
        """Gives back the room of the frame taken last.

        Args:
            length: Of its content.
        """
        self._positions[1] += -(-(FRAME.size + length) // _ALIGNMENT) * _ALIGNMENT
