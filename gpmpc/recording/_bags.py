"""Says what is wrong with an MCAP file of any program, without unfolding its chunks.

The library that decodes the messages checks each chunk. What it cannot see is checked
here: chunks that are missing, a wrong checksum of all data, and that there are none.
"""

import zlib
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from gpmpc.exceptions import RecordingError
from gpmpc.recording._flaws import (
    NO_CHECKSUMS,
    UNFINISHED,
    WRONG_CHECKSUM,
    WRONG_COUNT,
    Flaw,
)
from gpmpc.recording._frames import HEAD, agrees, stored_checksum
from gpmpc.recording._index import read_index

_BLOCK = 2**20  # [bytes] that are read at once
_CHUNK_CHECKSUM = slice(24, 28)  # in the content of a chunk


def bag_flaws(path: str | Path) -> tuple[Flaw, ...]:
    """Says what is wrong with a file, as far as its frames, counts and checksums tell.

    Raises:
        RecordingError: The file is none of MCAP.
    """
    path = Path(path)
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(f"{path}: is not an MCAP file")
        index = read_index(file, size)
        position = len(MCAP0_MAGIC)
        checksum = zlib.crc32(MCAP0_MAGIC)
        chunks = 0
        messages = 0  # outside chunks
        unchecked = 0
        while True:
            file.seek(position)
            head = file.read(HEAD.size)
            kind, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            position += HEAD.size + length
            if not kind or position > size:
                text = f"it is cut off or broken at byte {position - length}"
                return (Flaw(UNFINISHED, 1, text),)
            if kind == Opcode.DATA_END:
                break
            beginning = file.read(min(length, _BLOCK))
            checksum = zlib.crc32(beginning, zlib.crc32(head, checksum))
            checksum = _checksum_of(file, length - len(beginning), checksum)
            if kind == Opcode.CHUNK:
                chunks += 1
                unchecked += beginning[_CHUNK_CHECKSUM] == bytes(4)
            messages += kind == Opcode.MESSAGE
        content = file.read(length)
    stored = stored_checksum(content) if length == 4 else 0
    flaws = []
    if not agrees(stored, checksum):
        text = "the checksum of its data is wrong"
        flaws.append(Flaw(WRONG_CHECKSUM, 1, text))
    statistics = None if index is None else index.statistics
    if statistics is not None and statistics.chunk_count != chunks:
        text = f"its index counts {statistics.chunk_count} chunks; there are {chunks}"
        flaws.append(Flaw(WRONG_COUNT, 1, text))
    if statistics is not None and not chunks and statistics.message_count != messages:
        stated = statistics.message_count
        text = f"its index counts {stated} messages; there are {messages}"
        flaws.append(Flaw(WRONG_COUNT, 1, text))
    if stored == 0 and unchecked + messages:
        what = f"{unchecked} chunks" if unchecked else f"{messages} messages"
        text = f"no checksums: {what} may be altered unnoticed"
        flaws.append(Flaw(NO_CHECKSUMS, unchecked + messages, text))
    return tuple(flaws)


def _checksum_of(file: BinaryIO, length: int, checksum: int) -> int:
    """Continues a checksum with the next ``length`` bytes of a file."""
    while length > 0:
        block = file.read(min(length, _BLOCK))
        if not block:
            return checksum
        checksum = zlib.crc32(block, checksum)
        length -= len(block)
    return checksum
