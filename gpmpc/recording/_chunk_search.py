"""Searches a damaged file for compressed chunks by the marks of their compression."""

import contextlib
import re
import struct
from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Chunk

from gpmpc._bounds import LARGEST
from gpmpc.exceptions import RecordingError
from gpmpc.recording._frames import BROKEN, HEAD, parsed, read_frame
from gpmpc.recording._schema import CHANNELS_METADATA

_COMPRESSION = 28  # where the name of the compression stands in a chunk's content
_COMPRESSION_MARK = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_CHANNELS_MARK = len(CHANNELS_METADATA).to_bytes(4, "little")
_CHANNELS_MARK += CHANNELS_METADATA.encode()
_ANY_MARK = re.compile(_COMPRESSION_MARK.pattern + b"|" + re.escape(_CHANNELS_MARK))
_DATA_BEGIN = {b"zstd": b"\x28\xb5\x2f\xfd", b"lz4": b"\x04\x22\x4d\x18"}
_LENGTH = struct.Struct("<Q")
_BLOCK = 2**20  # [bytes] that are searched at once


class PlacedChunk(NamedTuple):
    """A chunk that a checksum vouches for, and where it stands."""

    start: int  # of its record's head
    end: int
    chunk: Chunk
    data: bytes  # unfolded


class ChunkSearch:
    """A search for whole chunks behind damage.

    Args:
        file: That is searched.
        size: Of the file [bytes].
        unfold: Decompresses a chunk; raises one of ``BROKEN`` where it is damaged.
        lost_chunks: Takes where chunks stand that cannot be read.
    """

    def __init__(
        self,
        file: BinaryIO,
        size: int,
        unfold: Callable[[Chunk], bytes],
        lost_chunks: list[int],
    ) -> None:
        self.begin = 0  # no chunk is sought before
        self.topics: dict[int, str] = {}  # by channel, as far as they were found
        self._file = file
        self._size = size
        self._unfold = unfold
        self._lost_chunks = lost_chunks
        self._room = 2 * LARGEST + 4 * size  # left for what may be a chunk [bytes]

    def next_chunk(self, end: int) -> PlacedChunk | None:
        """Finds the next compressed chunk before ``end`` that a checksum vouches for.

        Topics of channels that stand on the way are noted.
        """
        for position, mark in self._marks(self.begin, end):
            if mark == _CHANNELS_MARK:
                self._note_topics(position - HEAD.size)
                continue
            placed = self._chunk_at(position - _COMPRESSION)
            if placed is not None:
                return placed
        return None

    def _marks(self, begin: int, end: int) -> Iterator[tuple[int, bytes]]:
        """Yields the marks of chunks and of topics with their places."""
        position = begin
        while position < end:
            length = min(_BLOCK, end - position)
            self._file.seek(position)
            block = self._file.read(length + len(_CHANNELS_MARK) - 1)
            for mark in _ANY_MARK.finditer(block):
                if mark.start() < length:
                    yield position + mark.start(), mark[0]
            position += length

    def _note_topics(self, start: int) -> None:
        frame = read_frame(self._file, start, self._size)
        if frame is not None and frame.kind == Opcode.METADATA:
            with contextlib.suppress(*BROKEN):
                metadata = parsed(frame.kind, frame.content).metadata
                self.topics |= topics_by_channel(metadata)

    def _chunk_at(self, content_start: int) -> PlacedChunk | None:
        """Reads the chunk whose content begins there, if a checksum vouches for it."""
        start = content_start - HEAD.size
        if content_start < self.begin:
            return None
        content = self._read_content(content_start)
        if content is None:
            return None
        try:
            chunk: Chunk = parsed(Opcode.CHUNK, content)
            data = self._unfold(chunk)
        except RecordingError:
            raise  # it is a RuntimeError, as broken records raise
        except BROKEN:
            self._lost_chunks.append(start)
            return None
        if chunk.uncompressed_crc == 0:
            self._lost_chunks.append(start)
            return None
        return PlacedChunk(start, content_start + len(content), chunk, data)

    def _read_content(self, start: int) -> bytes | None:
        """Reads the content of what may be a chunk; None where it is none."""
        self._file.seek(start)
        head = self._file.read(_COMPRESSION + 4 + 4 + _LENGTH.size + 4)
        name = b"zstd" if head[_COMPRESSION + 4 :].startswith(b"zstd") else b"lz4"
        length_start = _COMPRESSION + 4 + len(name)
        data_start = length_start + _LENGTH.size
        if not head[data_start:].startswith(_DATA_BEGIN[name]):
            return None  # such as the entry of a chunk in the index
        (length,) = _LENGTH.unpack_from(head, length_start)
        end = start + data_start + length
        if end > min(self._size, start + LARGEST):
            return None
        self._room -= length
        if self._room < 0:
            return None
        self._file.seek(start)
        return self._file.read(data_start + length)


def is_like_chunk(content: bytes) -> bool:
    """Tells whether the content of a record is a compressed chunk's, of any kind."""
    return _COMPRESSION_MARK.match(content, _COMPRESSION) is not None


def topics_by_channel(pairs: dict[str, str]) -> dict[int, str]:
    """Reads the topics by channel, whose numbers have two bytes."""
    return {
        int(key): topic
        for key, topic in pairs.items()
        if key.isdecimal() and len(key) <= len("65535")
    }
