"""Finds what is wrong with an MCAP file of any program, without unfolding its chunks.

The library that decodes the messages checks each chunk. What it cannot see is checked
here: chunks that are missing, a wrong checksum of all data, and that there are none.
"""

import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Statistics
from mcap.writer import MCAP0_MAGIC

from gpmpc._calls import explains_arguments
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


class _DataSection(NamedTuple):
    """The data of a file, as far as their frames tell."""

    chunks: int
    unchecked_chunks: int  # without a checksum
    messages: int  # outside chunks
    checksum: int  # computed
    stored_checksum: int  # 0 where there is none


class _CutOff(Exception):
    """A file has no end; the text says where it is broken."""


@explains_arguments
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
        try:
            data = _read_data_section(file, size)
        except _CutOff as error:
            return (Flaw(UNFINISHED, 1, str(error)),)
    statistics = None if index is None else index.statistics
    flaws = []
    if not agrees(data.stored_checksum, data.checksum):
        text = "the checksum of its data is wrong"
        flaws.append(Flaw(WRONG_CHECKSUM, 1, text))
    if statistics is not None:
        flaws += _count_flaws(data, statistics)
    if data.stored_checksum == 0:
        flaws += _missing_checksums(data)
    return tuple(flaws)


def _read_data_section(file: BinaryIO, size: int) -> _DataSection:
    """Goes over the frames of a file of ``size`` bytes, up to the end of its data."""
    position = len(MCAP0_MAGIC)
    checksum = zlib.crc32(MCAP0_MAGIC)
    chunks = 0
    unchecked_chunks = 0
    messages = 0
    while True:
        file.seek(position)
        head = file.read(HEAD.size)
        kind, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
        position += HEAD.size + length
        if not kind or position > size:
            raise _CutOff(f"it is cut off or broken at byte {position - length}")
        if kind == Opcode.DATA_END:
            break
        beginning = file.read(min(length, _BLOCK))
        checksum = zlib.crc32(beginning, zlib.crc32(head, checksum))
        checksum = _continue_checksum(file, length - len(beginning), checksum)
        if kind == Opcode.CHUNK:
            chunks += 1
            unchecked_chunks += beginning[_CHUNK_CHECKSUM] == bytes(4)
        messages += kind == Opcode.MESSAGE
    content = file.read(length)
    return _DataSection(
        chunks=chunks,
        unchecked_chunks=unchecked_chunks,
        messages=messages,
        checksum=checksum,
        stored_checksum=stored_checksum(content) if length == 4 else 0,
    )


def _count_flaws(data: _DataSection, statistics: Statistics) -> list[Flaw]:
    """Compares the counts of the index with the data."""
    flaws = []
    stated = statistics.chunk_count
    if stated != data.chunks:
        text = f"its index counts {stated} chunks; there are {data.chunks}"
        flaws.append(Flaw(WRONG_COUNT, 1, text))
    stated = statistics.message_count
    if not data.chunks and stated != data.messages:
        text = f"its index counts {stated} messages; there are {data.messages}"
        flaws.append(Flaw(WRONG_COUNT, 1, text))
    return flaws


def _missing_checksums(data: _DataSection) -> list[Flaw]:
    """Says what no checksum vouches for, where the data have none of their own."""
    count = data.unchecked_chunks + data.messages
    if not count:
        return []
    subject = f"{data.messages} messages"
    if data.unchecked_chunks:
        subject = f"{data.unchecked_chunks} chunks"
    text = f"no checksums: {subject} may be altered unnoticed"
    return [Flaw(NO_CHECKSUMS, count, text)]


def _continue_checksum(file: BinaryIO, length: int, checksum: int) -> int:
    """Continues a checksum with the next ``length`` bytes of a file."""
    while length > 0:
        block = file.read(min(length, _BLOCK))
        if not block:
            return checksum
        checksum = zlib.crc32(block, checksum)
        length -= len(block)
    return checksum
