"""Reads the records of an MCAP file that was cut off, damaged, or made by somebody else.

Each record is parsed from its own bytes alone. A chunk that its checksum does not
vouch for is left out, and reading goes on with the next: its place follows from the
lengths of the records or, where one of these is damaged, from the index or from the
mark of a compressed chunk. What is left out is counted as a flaw.
"""

import contextlib
import re
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.writer import MCAP0_MAGIC

from gpmpc._bounds import LARGEST, room
from gpmpc.exceptions import RecordingError
from gpmpc.recording._flaws import (
    DAMAGED_RECORDS,
    LOST_CHUNKS,
    LOST_MESSAGES,
    NO_CHECKSUMS,
    UNFINISHED,
    WRONG_CHECKSUM,
    Flaw,
)
from gpmpc.recording._frames import (
    BROKEN,
    HEAD,
    Frame,
    agrees,
    chunk_length,
    parsed,
    read_frame,
    stored_checksum,
    unfolded,
)
from gpmpc.recording._index import Content, Index, Place, read_index

CONFIG = "config.yaml"  # name of an attachment
RECOVERED = "recovered"  # metadata of a file that holds what was left of another
CHANNELS = (
    "channels"  # metadata: topics by channel, for a run whose first chunk is lost
)
_PRIVATE = 0x80  # from here on, kinds of records are those of applications
_DATA_KINDS = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
)
_PARSED_KINDS = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
)
_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_COMPRESSION = 28  # where the name of the compression stands in a chunk's content
# How the name of the compression stands in a chunk, by which it is found.
_MARK = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_CHANNELS_MARK = len(CHANNELS).to_bytes(4, "little") + CHANNELS.encode()
_MARKS = re.compile(_MARK.pattern + b"|" + re.escape(_CHANNELS_MARK))
_MAGICS = {b"zstd": b"\x28\xb5\x2f\xfd", b"lz4": b"\x04\x22\x4d\x18"}
_LENGTH = struct.Struct("<Q")
_BLOCK = 2**20  # [bytes] that are searched at once


def whole_records(path: Path, flaws: list[Flaw] | None = None) -> Iterator[McapRecord]:
    """Yields what is whole in a file: schemas, channels, messages, metadata, attachments.

    Args:
        path: The file.
        flaws: Takes, when all is read, what is wrong with the file.

    Raises:
        RecordingError: The file cannot be read, is none of MCAP, or unfolds to too much.
    """
    try:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: is not a file")
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
            if magic != MCAP0_MAGIC:
                reason = (
                    "is empty: its recording was killed before it began"
                    if not magic
                    else "is not an MCAP file"
                )
                raise RecordingError(f"{path}: {reason}")
            reader = _Reader(file, path)
            yield from reader.records()
            if flaws is not None:
                flaws.extend(reader.flaws())
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be read: {error.strerror or error}"
        ) from error


class _PlacedChunk(NamedTuple):
    start: int  # of its record's head
    end: int
    chunk: Chunk
    data: bytes  # unfolded


class _Reader:
    """Reads a file once from its beginning to the end of its data."""

    def __init__(self, file: BinaryIO, path: Path):
        self._file = file
        self._path = path
        self._size = path.stat().st_size
        self._index: Index | None = read_index(file, self._size)
        self._data_end = self._size
        if self._index is not None and self._index.sound:
            self._data_end = self._index.start
        self._room = room(path)  # left for what chunks unfold to [bytes]
        self._search_room = (
            2 * LARGEST + 4 * self._size
        )  # for what may be a chunk [bytes]
        self._content = Content()
        self._topics: dict[int, str] = {}  # of ``CHANNELS``
        self._identities: set[tuple[int, int, int]] = set()  # of chunks
        self._position = len(MCAP0_MAGIC)
        self._searched = self._position  # no chunk is sought before
        self._ended = False  # with the record that ends the data
        self._checksum = zlib.crc32(MCAP0_MAGIC)  # of the data so far
        self._data_checksum = 0  # that the data's last record holds
        self._checksum_is_right = True
        self._lost_chunks: list[int] = []  # where they stand
        self._repeated_chunks = 0
        self._damaged_records: list[int] = []  # where they stand
        self._orphans = 0  # messages of no known channel
        self._unchecked = 0  # messages that no checksum of a chunk vouches for

    def records(self) -> Iterator[McapRecord]:
        """Yields the records that are whole."""
        while self._position < self._data_end and not self._ended:
            frame = read_frame(self._file, self._position, self._size)
            if frame is None or not self._is_of_data(frame):
                yield from self._go_on_behind(frame)
                continue
            before = self._checksum
            head = HEAD.pack(frame.kind, len(frame.content))
            self._checksum = zlib.crc32(frame.content, zlib.crc32(head, before))
            self._position = frame.end
            if frame.kind == Opcode.DATA_END:
                self._end(frame, before)
            elif frame.kind == Opcode.CHUNK:
                yield from self._chunk(frame)
            elif frame.kind in _PARSED_KINDS:
                yield from self._record(frame)
        if self._index is not None and self._index.statistics is not None:
            yield self._index.statistics

    def flaws(self) -> list[Flaw]:
        """Says what is wrong with the file, after all was read."""
        damage = self._damage()
        disagreements: list[Flaw] = []
        if self._index is not None and self._ended and not damage:
            disagreements = self._index.disagreements(self._content)
        return [
            *damage,
            *self._missing_end(),
            *disagreements,
            *self._missing_checksums(),
        ]

    def _damage(self) -> list[Flaw]:
        flaws = []
        if self._lost_chunks:
            count = len(self._lost_chunks)
            total = count + len(self._content.chunks)
            where = ", ".join(map(str, self._lost_chunks[:3]))
            text = f"{count} of {total} chunks cannot be read, at byte {where}"
            flaws.append(Flaw(LOST_CHUNKS, count, text + " ..." * (count > 3)))
        if self._damaged_records:
            count = len(self._damaged_records)
            where = ", ".join(map(str, self._damaged_records[:3]))
            text = f"damaged besides: {_records(count)}, at byte {where}"
            flaws.append(Flaw(DAMAGED_RECORDS, count, text + " ..." * (count > 3)))
        if self._repeated_chunks:
            text = f"{self._repeated_chunks} chunks come twice; one of each is left out"
            flaws.append(Flaw(DAMAGED_RECORDS, self._repeated_chunks, text))
        if self._orphans:
            text = f"{self._orphans} messages are of no known channel and left out"
            flaws.append(Flaw(LOST_MESSAGES, self._orphans, text))
        if not self._checksum_is_right and not flaws:
            text = "the checksum of its data is wrong: a record was changed"
            flaws.append(Flaw(WRONG_CHECKSUM, 1, text))
        return flaws

    def _missing_end(self) -> list[Flaw]:
        if not self._ended:
            return [Flaw(UNFINISHED, 1, "it was not finished: it has no end")]
        if self._index is None:
            text = "it was not finished: nothing stands behind its data"
            return [Flaw(UNFINISHED, 1, text)]
        if self._index.start != self._position:
            text = "its end is not where it says"
            return [Flaw(DAMAGED_RECORDS, 1, text)]
        return []

    def _missing_checksums(self) -> list[Flaw]:
        is_covered = self._data_checksum != 0 and self._checksum_is_right
        if is_covered or not self._content.messages:
            return []
        if self._unchecked:
            text = f"no checksums: {self._unchecked} messages may be altered unnoticed"
            return [Flaw(NO_CHECKSUMS, self._unchecked, text)]
        if self._ended and self._data_checksum == 0:
            count = len(self._content.metadata)
            text = "no checksums of its metadata: these may be altered unnoticed"
            return [Flaw(NO_CHECKSUMS, count, text)]
        return []

    def _is_of_data(self, frame: Frame) -> bool:
        """Whether a record is one that stands among data, by its kind."""
        if frame.kind == Opcode.DATA_END:
            return len(frame.content) == 4
        if frame.kind >= _PRIVATE:
            return not _is_like_chunk(frame.content)
        if frame.kind != Opcode.CHUNK and _is_like_chunk(frame.content):
            return False
        return frame.kind in _DATA_KINDS

    def _end(self, frame: Frame, checksum: int) -> None:
        self._ended = True
        self._data_checksum = stored_checksum(frame.content)
        self._checksum_is_right = agrees(self._data_checksum, checksum)

    def _record(self, frame: Frame) -> Iterator[McapRecord]:
        """Yields a record that stands outside chunks."""
        place: Place = (frame.start, frame.end - frame.start)
        try:
            record = parsed(frame.kind, frame.content)
        except BROKEN:
            self._damaged_records.append(frame.start)
            return
        if isinstance(record, Metadata):
            self._content.metadata.append(place)
            if record.name == CHANNELS:
                self._topics |= _topics(record.metadata)
        elif isinstance(record, Attachment):
            self._content.attachments.append(place)
        elif isinstance(record, Message):
            self._unchecked += 1
        yield from self._with_channel(record)

    def _chunk(self, frame: Frame) -> Iterator[McapRecord]:
        """Yields the records of a chunk, and sees to where the next record stands."""
        has_successor = self._is_likely(frame.end)
        try:
            chunk: Chunk = parsed(frame.kind, frame.content)
            end = frame.content_start + chunk_length(chunk)
            data = self._unfold(chunk)
        except RecordingError:
            raise  # it is a RuntimeError, as broken records raise
        except BROKEN:
            if has_successor:
                self._lost_chunks.append(frame.start)
                self._searched = frame.end
            else:
                yield from self._go_on_behind(None, frame.start)
            return
        if end < frame.end and not has_successor:  # its length is wrong
            self._damaged_records.append(frame.start)
            self._position = end
        self._searched = self._position
        yield from self._inside(_PlacedChunk(frame.start, end, chunk, data))

    def _inside(self, placed: _PlacedChunk) -> Iterator[McapRecord]:
        """Yields the records of a chunk that has not been read before."""
        start, end, chunk, data = placed
        identity = (chunk.uncompressed_crc, len(data), zlib.crc32(chunk.data))
        if identity in self._identities:
            self._repeated_chunks += 1
            return
        self._identities.add(identity)
        self._content.chunks.append((start, end - start))
        stream = BytesIO(data)
        position = 0
        while position < len(data):
            frame = read_frame(stream, position, len(data))
            if frame is None:
                self._damaged_records.append(start)
                return
            position = frame.end
            if frame.kind not in _IN_CHUNKS:
                continue
            try:
                record = parsed(frame.kind, frame.content)
            except BROKEN:
                self._damaged_records.append(start)
                return
            if isinstance(record, Message) and chunk.uncompressed_crc == 0:
                self._unchecked += 1
            yield from self._with_channel(record)

    def _with_channel(self, record: McapRecord) -> Iterator[McapRecord]:
        """Yields a record, a message behind the channel that it belongs to."""
        if isinstance(record, Schema):
            self._content.schemas[record.id] = record
        elif isinstance(record, Channel):
            self._content.channels[record.id] = record
        elif isinstance(record, Message):
            if record.channel_id not in self._content.channels:
                definition = list(self._lost_channel(record.channel_id))
                if not definition:
                    self._orphans += 1
                    return
                yield from definition
            self._content.messages[record.channel_id] += 1
        yield record

    def _lost_channel(self, number: int) -> Iterator[Schema | Channel]:
        """Yields a channel, and its schema, whose own record is lost."""
        index = self._index
        if index is not None and not index.flaw and number in index.channels:
            channel = index.channels[number]
            if channel.schema_id in index.schemas:
                schema = index.schemas[channel.schema_id]
                self._content.schemas[schema.id] = schema
                yield schema
        elif number in self._topics:
            channel = Channel(number, self._topics[number], "protobuf", {}, 0)
        else:
            return
        self._content.channels[number] = channel
        yield channel

    def _unfold(self, chunk: Chunk) -> bytes:
        if chunk.uncompressed_size <= LARGEST:
            self._room -= chunk.uncompressed_size
        if self._room < 0:
            raise RecordingError(
                f"{self._path}: its chunks unfold to more than "
                f"{room(self._path) / 1e6:.0f} MB"
            )
        return unfolded(chunk)

    def _is_likely(self, position: int) -> bool:
        """Whether a record of the data, or the end of the file, stands at a position."""
        if position in (self._size, self._data_end):
            return True
        self._file.seek(position)
        head = self._file.read(HEAD.size)
        if len(head) < HEAD.size:
            return False
        kind, length = HEAD.unpack(head)
        if kind == Opcode.DATA_END:
            return bool(length == 4)
        is_known = kind in _DATA_KINDS or kind >= _PRIVATE
        return is_known and length <= self._size - position - HEAD.size

    def _go_on_behind(
        self, frame: Frame | None, start: int | None = None
    ) -> Iterator[McapRecord]:
        """Yields the records of the next whole chunk behind a broken record.

        Reading goes on behind that chunk; or behind the broken record, if its length
        is right; or with the next record that the index names; or it ends.
        """
        start = self._position if start is None else start
        is_other_kind = frame is not None and not _is_like_chunk(frame.content)
        if frame is not None and is_other_kind and self._is_likely(frame.end):
            self._damaged_records.append(start)
            self._position = frame.end
            return
        limit = self._data_end
        if self._index is not None and self._index.sound:
            limit = min(self._index.next_place(start + 1), limit)
        lost_before = len(self._lost_chunks)
        placed = self._next_chunk(self._searched, limit)
        is_end = placed is None and limit == self._size
        if not is_end and len(self._lost_chunks) == lost_before:
            self._damaged_records.append(start)
        if placed is None:
            self._position = limit
            self._searched = max(self._searched, limit)
            return
        self._position = placed.end
        self._searched = placed.end
        yield from self._inside(placed)

    def _next_chunk(self, begin: int, end: int) -> _PlacedChunk | None:
        """Finds the next compressed chunk that a checksum vouches for.

        Topics of channels that stand on the way are taken along.
        """
        for position, mark in self._marks(begin, end):
            if mark == _CHANNELS_MARK:
                self._take_topics(position - HEAD.size)
                continue
            placed = self._chunk_at(position - _COMPRESSION)
            if placed is not None:
                return placed
        return None

    def _take_topics(self, start: int) -> None:
        frame = read_frame(self._file, start, self._size)
        if frame is not None and frame.kind == Opcode.METADATA:
            with contextlib.suppress(*BROKEN):
                self._topics |= _topics(parsed(frame.kind, frame.content).metadata)

    def _marks(self, begin: int, end: int) -> Iterator[tuple[int, bytes]]:
        """Yields the marks of chunks and of ``CHANNELS`` with their places."""
        position = begin
        while position < end:
            length = min(_BLOCK, end - position)
            self._file.seek(position)
            block = self._file.read(length + len(_CHANNELS_MARK) - 1)
            for mark in _MARKS.finditer(block):
                if mark.start() < length:
                    yield position + mark.start(), mark[0]
            position += length

    def _chunk_at(self, content_start: int) -> _PlacedChunk | None:
        """Reads the chunk whose content begins there, if a checksum vouches for it."""
        start = content_start - HEAD.size
        if content_start < self._searched:
            return None
        self._file.seek(content_start)
        head = self._file.read(_COMPRESSION + 4 + 4 + _LENGTH.size + 4)
        name = b"zstd" if head[_COMPRESSION + 4 :].startswith(b"zstd") else b"lz4"
        length_start = _COMPRESSION + 4 + len(name)
        data_start = length_start + _LENGTH.size
        if not head[data_start:].startswith(_MAGICS[name]):
            return None  # such as the entry of a chunk in the index
        (length,) = _LENGTH.unpack_from(head, length_start)
        end = content_start + data_start + length
        if end > min(self._size, content_start + LARGEST):
            return None
        self._search_room -= length
        if self._search_room < 0:
            return None
        self._file.seek(content_start)
        content = self._file.read(data_start + length)
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
        return _PlacedChunk(start, end, chunk, data)


def _is_like_chunk(content: bytes) -> bool:
    """Whether the content of a record is a compressed chunk's, whatever its kind says."""
    return _MARK.match(content, _COMPRESSION) is not None


def _records(count: int) -> str:
    return "1 record" if count == 1 else f"{count} records"


def _topics(pairs: dict[str, str]) -> dict[int, str]:
    """Reads the topics by channel, whose numbers have two bytes."""
    return {
        int(key): topic
        for key, topic in pairs.items()
        if key.isdecimal() and len(key) <= len("65535")
    }
