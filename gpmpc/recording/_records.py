"""Reads the records of an MCAP file that may be cut off, damaged, or of another maker.

Each record is parsed from its own bytes alone. A chunk that its checksum does not
vouch for is left out, and reading goes on with the next: its place follows from the
lengths of the records or, where one of these is damaged, from the index or from the
mark of a compressed chunk. What is left out is counted as a flaw.
"""

import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

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

from gpmpc._bounds import LARGEST, memory_limit
from gpmpc.exceptions import RecordingError
from gpmpc.recording._chunk_search import (
    ChunkSearch,
    PlacedChunk,
    is_like_chunk,
    topics_by_channel,
)
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
from gpmpc.recording._index import Index, Inventory, Place, read_index
from gpmpc.recording._schema import CHANNELS_METADATA

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
_LISTED_PLACES = 3  # of damage


def whole_records(path: Path, flaws: list[Flaw] | None = None) -> Iterator[McapRecord]:
    """Yields the whole records of a file: schemas, channels, messages and others.

    Args:
        path: The file.
        flaws: Takes, when all is read, what is wrong with the file.

    Raises:
        RecordingError: The file cannot be read, is no MCAP, or unfolds to too much.
    """
    try:
        if path.exists() and not path.is_file():
            raise RecordingError(f"{path}: is not a file")
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
            if magic != MCAP0_MAGIC:
                reason = "is not an MCAP file"
                if not magic:
                    reason = "is empty: its recording was killed before it began"
                raise RecordingError(f"{path}: {reason}")
            reader = _DataReader(file, path)
            yield from reader.records()
            if flaws is not None:
                flaws.extend(reader.flaws())
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be read: {error.strerror or error}"
        ) from error


@dataclass
class _Damage:
    """What is broken in the data of a file, as far as it was read."""

    lost_chunks: list[int] = field(default_factory=list)  # where they stand
    damaged_records: list[int] = field(default_factory=list)  # where they stand
    repeated_chunks: int = 0
    orphans: int = 0  # messages of no known channel

    def flaws(self, whole_chunks: int) -> list[Flaw]:
        """Says what is broken, beside the chunks that are whole."""
        flaws = []
        if self.lost_chunks:
            count = len(self.lost_chunks)
            total = count + whole_chunks
            where = _listed(self.lost_chunks)
            text = f"{count} of {total} chunks cannot be read, at byte {where}"
            flaws.append(Flaw(LOST_CHUNKS, count, text))
        if self.damaged_records:
            count = len(self.damaged_records)
            records = "1 record" if count == 1 else f"{count} records"
            where = _listed(self.damaged_records)
            text = f"damaged besides: {records}, at byte {where}"
            flaws.append(Flaw(DAMAGED_RECORDS, count, text))
        if self.repeated_chunks:
            text = f"{self.repeated_chunks} chunks come twice; one of each is left out"
            flaws.append(Flaw(DAMAGED_RECORDS, self.repeated_chunks, text))
        if self.orphans:
            text = f"{self.orphans} messages are of no known channel and left out"
            flaws.append(Flaw(LOST_MESSAGES, self.orphans, text))
        return flaws


def _listed(places: list[int]) -> str:
    text = ", ".join(str(place) for place in places[:_LISTED_PLACES])
    return text + " ..." if len(places) > _LISTED_PLACES else text


class _DataReader:
    """A reader that goes once from the beginning of a file to the end of its data.

    ``_position`` is where the next record is expected. ``_search.begin``, where a
    search for a chunk would begin, is never beyond it: after the last chunk that was
    whole, or known to be lost. The records between the two were read by their lengths;
    where one of these was wrong, a chunk may stand among them.
    """

    def __init__(self, file: BinaryIO, path: Path):
        self._file = file
        self._path = path
        self._size = path.stat().st_size
        self._index: Index | None = read_index(file, self._size)
        self._data_end = self._size
        if self._index is not None and self._index.sound:
            self._data_end = self._index.start
        self._memory_left = memory_limit(path)  # left for what chunks unfold to [bytes]
        self._inventory = Inventory()
        self._messages: Counter[int] = Counter()  # by channel
        self._identities: set[tuple[int, int, int]] = set()  # of chunks
        self._damage = _Damage()
        self._search = ChunkSearch(
            file, self._size, self._unfold, self._damage.lost_chunks
        )
        self._position = len(MCAP0_MAGIC)
        self._search.begin = self._position
        self._ended = False  # with the record that ends the data
        self._checksum = zlib.crc32(MCAP0_MAGIC)  # of the data so far
        self._data_checksum = 0  # that the data's last record holds
        self._checksum_is_right = True
        self._unchecked = 0  # messages that no checksum of a chunk vouches for

    def records(self) -> Iterator[McapRecord]:
        """Yields the records that are whole."""
        while self._position < self._data_end and not self._ended:
            frame = read_frame(self._file, self._position, self._size)
            if frame is None:
                yield from self._seek_chunk(self._position)
                continue
            if not self._is_of_data(frame):
                if self._has_right_length(frame):
                    self._skip_record(frame)
                else:
                    yield from self._seek_chunk(frame.start)
                continue
            before = self._checksum
            head = HEAD.pack(frame.kind, len(frame.content))
            self._checksum = zlib.crc32(frame.content, zlib.crc32(head, before))
            self._position = frame.end
            if frame.kind == Opcode.DATA_END:
                self._end(frame, before)
            elif frame.kind == Opcode.CHUNK:
                yield from self._records_of_chunk(frame)
            elif frame.kind in _PARSED_KINDS:
                yield from self._records_outside(frame)
        if self._index is not None and self._index.statistics is not None:
            yield self._index.statistics

    def flaws(self) -> list[Flaw]:
        """Says what is wrong with the file, after all was read."""
        damage = self._damage.flaws(whole_chunks=len(self._inventory.chunks))
        if not self._checksum_is_right and not damage:
            text = "the checksum of its data is wrong: a record was changed"
            damage.append(Flaw(WRONG_CHECKSUM, 1, text))
        disagreements: list[Flaw] = []
        if self._index is not None and self._ended and not damage:
            disagreements = self._index.disagreements(self._inventory, self._messages)
        return [
            *damage,
            *self._missing_end(),
            *disagreements,
            *self._missing_checksums(),
        ]

    def _missing_end(self) -> list[Flaw]:
        """Says whether the file has no end, or another than its index names."""
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
        """Says what no checksum vouches for."""
        is_covered = self._data_checksum != 0 and self._checksum_is_right
        if is_covered or not self._messages:
            return []
        if self._unchecked:
            text = f"no checksums: {self._unchecked} messages may be altered unnoticed"
            return [Flaw(NO_CHECKSUMS, self._unchecked, text)]
        if self._ended and self._data_checksum == 0:
            count = len(self._inventory.metadata)
            text = "no checksums of its metadata: these may be altered unnoticed"
            return [Flaw(NO_CHECKSUMS, count, text)]
        return []

    def _is_of_data(self, frame: Frame) -> bool:
        """Tells whether a record is one that stands among data, by its kind."""
        if frame.kind == Opcode.DATA_END:
            return len(frame.content) == 4
        if frame.kind >= _PRIVATE:
            return not is_like_chunk(frame.content)
        if frame.kind != Opcode.CHUNK and is_like_chunk(frame.content):
            return False
        return frame.kind in _DATA_KINDS

    def _end(self, frame: Frame, checksum: int) -> None:
        """Compares the checksum of all data with that of the record that ends them.

        Args:
            frame: That record.
            checksum: Of all data before it.
        """
        self._ended = True
        self._data_checksum = stored_checksum(frame.content)
        self._checksum_is_right = agrees(self._data_checksum, checksum)

    def _records_outside(self, frame: Frame) -> Iterator[McapRecord]:
        """Yields a record that stands outside chunks."""
        place = Place(frame.start, frame.end - frame.start)
        try:
            record = parsed(frame.kind, frame.content)
        except BROKEN:
            self._damage.damaged_records.append(frame.start)
            return
        if isinstance(record, Metadata):
            self._inventory.metadata.append(place)
            if record.name == CHANNELS_METADATA:
                self._search.topics |= topics_by_channel(record.metadata)
        elif isinstance(record, Attachment):
            self._inventory.attachments.append(place)
        elif isinstance(record, Message):
            self._unchecked += 1
        yield from self._with_channel(record)

    def _records_of_chunk(self, frame: Frame) -> Iterator[McapRecord]:
        """Yields the records of a chunk, and sees to where the next record stands."""
        has_successor = self._may_be_record(frame.end)
        try:
            chunk: Chunk = parsed(frame.kind, frame.content)
            end = frame.content_start + chunk_length(chunk)
            data = self._unfold(chunk)
        except RecordingError:
            raise  # it is a RuntimeError, as broken records raise
        except BROKEN:
            if has_successor:
                self._damage.lost_chunks.append(frame.start)
                self._search.begin = frame.end
            else:
                yield from self._seek_chunk(frame.start)
            return
        if end < frame.end and not has_successor:  # its length is wrong
            self._damage.damaged_records.append(frame.start)
            self._position = end
        self._search.begin = self._position
        placed = PlacedChunk(start=frame.start, end=end, chunk=chunk, data=data)
        yield from self._records_inside(placed)

    def _records_inside(self, placed: PlacedChunk) -> Iterator[McapRecord]:
        """Yields the records of a chunk that has not been read before."""
        chunk = placed.chunk
        data = placed.data
        identity = (chunk.uncompressed_crc, len(data), zlib.crc32(chunk.data))
        if identity in self._identities:
            self._damage.repeated_chunks += 1
            return
        self._identities.add(identity)
        self._inventory.chunks.append(Place(placed.start, placed.end - placed.start))
        stream = BytesIO(data)
        position = 0
        while position < len(data):
            frame = read_frame(stream, position, len(data))
            if frame is None:
                self._damage.damaged_records.append(placed.start)
                return
            position = frame.end
            if frame.kind not in _IN_CHUNKS:
                continue
            try:
                record = parsed(frame.kind, frame.content)
            except BROKEN:
                self._damage.damaged_records.append(placed.start)
                return
            if isinstance(record, Message) and chunk.uncompressed_crc == 0:
                self._unchecked += 1
            yield from self._with_channel(record)

    def _with_channel(self, record: McapRecord) -> Iterator[McapRecord]:
        """Yields a record, a message behind the channel that it belongs to."""
        if isinstance(record, Schema):
            self._inventory.schemas[record.id] = record
        elif isinstance(record, Channel):
            self._inventory.channels[record.id] = record
        elif isinstance(record, Message):
            if record.channel_id not in self._inventory.channels:
                definition = list(self._lost_channel(record.channel_id))
                if not definition:
                    self._damage.orphans += 1
                    return
                yield from definition
            self._messages[record.channel_id] += 1
        yield record

    def _lost_channel(self, number: int) -> Iterator[Schema | Channel]:
        """Yields a channel, and its schema, whose own record is lost."""
        index = self._index
        if index is not None and not index.flaw and number in index.inventory.channels:
            channel = index.inventory.channels[number]
            schema = index.inventory.schemas.get(channel.schema_id)
            if schema is not None:
                self._inventory.schemas[schema.id] = schema
                yield schema
        elif number in self._search.topics:
            channel = Channel(number, self._search.topics[number], "protobuf", {}, 0)
        else:
            return
        self._inventory.channels[number] = channel
        yield channel

    def _unfold(self, chunk: Chunk) -> bytes:
        """Decompresses a chunk; ``RecordingError`` where all unfold to too much."""
        if chunk.uncompressed_size <= LARGEST:
            self._memory_left -= chunk.uncompressed_size
        if self._memory_left < 0:
            raise RecordingError(
                f"{self._path}: its chunks unfold to more than "
                f"{memory_limit(self._path) / 1e6:.0f} MB"
            )
        return unfolded(chunk)

    def _has_right_length(self, frame: Frame) -> bool:
        """Tells whether a broken record ends where another begins, and is no chunk."""
        return not is_like_chunk(frame.content) and self._may_be_record(frame.end)

    def _may_be_record(self, position: int) -> bool:
        """Tells whether a record of the data, or the end, stands at a position."""
        if position in (self._size, self._data_end):
            return True
        self._file.seek(position)
        head = self._file.read(HEAD.size)
        if len(head) < HEAD.size:
            return False
        kind, length = HEAD.unpack(head)
        if kind == Opcode.DATA_END:
            return bool(length == 4)
        is_data_kind = kind in _DATA_KINDS or kind >= _PRIVATE
        return is_data_kind and length <= self._size - position - HEAD.size

    def _skip_record(self, frame: Frame) -> None:
        """Goes on behind a broken record whose length is right."""
        self._damage.damaged_records.append(frame.start)
        self._position = frame.end

    def _seek_chunk(self, start: int) -> Iterator[McapRecord]:
        """Yields the records of the next whole chunk behind a broken record.

        Reading goes on behind that chunk. Where there is none, it goes on with the next
        record that the index names, or ends.

        Args:
            start: Where the broken record begins; where it ends is not known.
        """
        limit = self._data_end
        if self._index is not None and self._index.sound:
            limit = min(self._index.next_place(start + 1), limit)
        lost_before = len(self._damage.lost_chunks)
        placed = self._search.next_chunk(limit)
        is_end = placed is None and limit == self._size
        if not is_end and len(self._damage.lost_chunks) == lost_before:
            self._damage.damaged_records.append(start)
        if placed is None:
            self._position = limit
            self._search.begin = max(self._search.begin, limit)
            return
        self._position = placed.end
        self._search.begin = placed.end
        yield from self._records_inside(placed)
