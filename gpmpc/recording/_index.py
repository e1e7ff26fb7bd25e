"""Reads what stands behind the data of an MCAP file, and compares it with the data.

The index repeats schemas and channels, says where chunks, attachments and metadata
stand, and counts messages. It rescues what damage hides, if its own checksum is right;
and it tells when a program changed the data without it.
"""

import struct
import zlib
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from gpmpc._bounds import LARGEST
from gpmpc.recording._flaws import DAMAGED_INDEX, WRONG_COUNT, Flaw
from gpmpc.recording._frames import (
    BROKEN,
    HEAD,
    agrees,
    parsed,
    read_frame,
)

DATA_END_SIZE = HEAD.size + 4  # [bytes]
_FOOTER = struct.Struct("<QQI")  # starts of index and offsets, checksum
_TAIL = HEAD.size + _FOOTER.size + len(MCAP0_MAGIC)  # [bytes]

_KINDS = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.STATISTICS,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
)

Place = tuple[int, int]  # where a record starts, and its length with its head


@dataclass
class Content:
    """What was read of the data."""

    messages: Counter[int] = field(default_factory=Counter)  # by channel
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[Place] = field(default_factory=list)
    attachments: list[Place] = field(default_factory=list)
    metadata: list[Place] = field(default_factory=list)


@dataclass
class Index:
    """The records behind the data."""

    start: int  # where the data end
    has_checksum: bool = False
    flaw: str = ""  # why it is not to be believed
    statistics: Statistics | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[Place] = field(default_factory=list)
    attachments: list[Place] = field(default_factory=list)
    metadata: list[Place] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """Whether a checksum vouches for it."""
        return self.has_checksum and not self.flaw

    @cached_property
    def _starts(self) -> list[int]:
        """Where the records of the data stand that it names, and their last one."""
        records = [*self.chunks, *self.attachments, *self.metadata]
        return sorted([start for start, _ in records] + [self.start - DATA_END_SIZE])

    def next_place(self, position: int) -> int:
        """Where the next record of the data stands that it names, or their end."""
        following = bisect_left(self._starts, position)
        return self._starts[following] if following < len(self._starts) else self.start

    def disagreements(self, content: Content) -> list[Flaw]:
        """Says what it counts otherwise than the data hold."""
        if self.flaw:
            return [Flaw(DAMAGED_INDEX, 1, f"its index is damaged: {self.flaw}")]
        flaws = []
        for name, (stated, present) in self._counts(content).items():
            if stated != present:
                text = f"its index counts {stated} {name}; there are {present}"
                flaws.append(Flaw(WRONG_COUNT, 1, text))
        for name in ("chunks", "attachments", "metadata"):
            stated_places = getattr(self, name)
            # A writer may leave a kind of index out.
            if stated_places and sorted(stated_places) != getattr(content, name):
                text = f"its index names other places of {name}"
                flaws.append(Flaw(WRONG_COUNT, 1, text))
        for name in ("schemas", "channels"):
            stated_records = getattr(self, name)
            if stated_records and stated_records != getattr(content, name):
                text = f"its index repeats other {name}"
                flaws.append(Flaw(WRONG_COUNT, 1, text))
        return flaws

    def _counts(self, content: Content) -> dict[str, tuple[int, int]]:
        """Counts of the statistics and of the data, by what they count."""
        statistics = self.statistics
        if statistics is None:
            return {}
        counts = {
            "messages": (statistics.message_count, content.messages.total()),
            "schemas": (statistics.schema_count, len(content.schemas)),
            "channels": (statistics.channel_count, len(content.channels)),
            "chunks": (statistics.chunk_count, len(content.chunks)),
            "attachments": (statistics.attachment_count, len(content.attachments)),
            "metadata": (statistics.metadata_count, len(content.metadata)),
        }
        by_channel = statistics.channel_message_counts
        for channel in sorted(by_channel.keys() | content.messages.keys()):
            known = content.channels.get(channel)
            name = f"messages of {known.topic if known else f'channel {channel}'}"
            counts[name] = by_channel.get(channel, 0), content.messages[channel]
        return counts


def read_index(file: BinaryIO, size: int) -> Index | None:
    """Reads the index of a file of ``size`` bytes; none where the file has no end."""
    footer_start = size - _TAIL
    if footer_start < len(MCAP0_MAGIC):
        return None
    footer = read_frame(file, footer_start, size)
    if footer is None or footer.kind != Opcode.FOOTER:
        return None
    if len(footer.content) != _FOOTER.size or file.read() != MCAP0_MAGIC:
        return None
    start, offsets_start, checksum = _FOOTER.unpack(footer.content)
    if start == 0:  # there is nothing but the footer
        start = footer_start
    if not len(MCAP0_MAGIC) <= start <= footer_start:
        return Index(footer_start, flaw="it starts outside the file")
    if footer_start - start > LARGEST:
        return Index(start, flaw="it is too large")
    file.seek(start)
    data = file.read(size - len(MCAP0_MAGIC) - 4 - start)  # the checksum comes next
    index = Index(start, has_checksum=checksum != 0)
    if not agrees(checksum, zlib.crc32(data)):
        index.flaw = "its checksum is wrong"
        return index
    try:
        offsets = _read_records(index, data[: footer_start - start])
    except BROKEN:
        index.flaw = "a record of it cannot be read"
        return index
    if any(stated != present for stated, present in offsets) or (
        offsets_start and not start <= offsets_start <= footer_start
    ):
        index.flaw = "its parts are not where it says"
    return index


def _read_records(index: Index, data: bytes) -> list[tuple[Place, Place]]:
    """Fills the index; returns where its parts should be and where they are."""
    stream = BytesIO(data)
    groups: dict[int, Place] = {}  # by kind
    stated: dict[int, Place] = {}
    position = 0
    while position < len(data):
        frame = read_frame(stream, position, len(data))
        if frame is None:
            raise RuntimeError("a record does not fit")
        start, length = groups.get(frame.kind, (index.start + position, 0))
        groups[frame.kind] = start, length + frame.end - frame.start
        position = frame.end
        if frame.kind in _KINDS:
            record = parsed(frame.kind, frame.content)
            if isinstance(record, SummaryOffset):
                stated[record.group_opcode] = record.group_start, record.group_length
            else:
                _add(index, record)
    # A writer may name a part that is empty.
    return [(place, groups.get(kind, (place[0], 0))) for kind, place in stated.items()]


def _add(index: Index, record: McapRecord) -> None:
    if isinstance(record, Statistics):
        index.statistics = record
    elif isinstance(record, Schema):
        index.schemas[record.id] = record
    elif isinstance(record, Channel):
        index.channels[record.id] = record
    elif isinstance(record, ChunkIndex):
        index.chunks.append((record.chunk_start_offset, record.chunk_length))
    elif isinstance(record, AttachmentIndex):
        index.attachments.append((record.offset, record.length))
    elif isinstance(record, MetadataIndex):
        index.metadata.append((record.offset, record.length))
