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
from typing import BinaryIO, NamedTuple

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


class Place(NamedTuple):
    """The place of a record in a file."""

    start: int
    length: int  # with its head


@dataclass
class Inventory:
    """The records of the data of a file: as its index says, or as they were read."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[Place] = field(default_factory=list)
    attachments: list[Place] = field(default_factory=list)
    metadata: list[Place] = field(default_factory=list)

    def places(self) -> dict[str, list[Place]]:
        """Returns the places of records by what they are."""
        return {
            "chunks": self.chunks,
            "attachments": self.attachments,
            "metadata": self.metadata,
        }


@dataclass
class Index:
    """The records behind the data."""

    start: int  # where the data end
    has_checksum: bool = False
    flaw: str = ""  # why it is not to be believed
    statistics: Statistics | None = None
    inventory: Inventory = field(default_factory=Inventory)

    @property
    def sound(self) -> bool:
        """Whether a checksum vouches for it."""
        return self.has_checksum and not self.flaw

    @cached_property
    def _starts(self) -> list[int]:
        """The starts of the records that it names, and of the data's last one."""
        places = [p for places in self.inventory.places().values() for p in places]
        return sorted([p.start for p in places] + [self.start - DATA_END_SIZE])

    def next_place(self, position: int) -> int:
        """Returns where the next record stands that it names, or the data's end."""
        following = bisect_left(self._starts, position)
        return self._starts[following] if following < len(self._starts) else self.start

    def disagreements(self, present: Inventory, messages: Counter[int]) -> list[Flaw]:
        """Says what it counts otherwise than the data hold.

        Args:
            present: What was read of the data.
            messages: How many were read, by channel.
        """
        if self.flaw:
            return [Flaw(DAMAGED_INDEX, 1, f"its index is damaged: {self.flaw}")]
        texts = self._other_counts(present, messages)
        present_places = present.places()
        for name, places in self.inventory.places().items():
            # A writer may leave a kind of index out.
            if places and sorted(places) != present_places[name]:
                texts.append(f"its index names other places of {name}")
        stated = self.inventory
        if stated.schemas and stated.schemas != present.schemas:
            texts.append("its index repeats other schemas")
        if stated.channels and stated.channels != present.channels:
            texts.append("its index repeats other channels")
        return [Flaw(WRONG_COUNT, 1, text) for text in texts]

    def _other_counts(self, present: Inventory, messages: Counter[int]) -> list[str]:
        """Names the counts of the statistics that the data do not have."""
        statistics = self.statistics
        if statistics is None:
            return []
        counts = {
            "messages": (statistics.message_count, messages.total()),
            "schemas": (statistics.schema_count, len(present.schemas)),
            "channels": (statistics.channel_count, len(present.channels)),
            "chunks": (statistics.chunk_count, len(present.chunks)),
            "attachments": (statistics.attachment_count, len(present.attachments)),
            "metadata": (statistics.metadata_count, len(present.metadata)),
        }
        stated_messages = statistics.channel_message_counts
        for number in sorted(stated_messages.keys() | messages.keys()):
            channel = present.channels.get(number)
            topic = f"channel {number}" if channel is None else channel.topic
            stated = stated_messages.get(number, 0)
            counts[f"messages of {topic}"] = (stated, messages[number])
        return [
            f"its index counts {stated} {name}; there are {count}"
            for name, (stated, count) in counts.items()
            if stated != count
        ]


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
    is_outside = offsets_start and not start <= offsets_start <= footer_start
    if is_outside or any(stated != present for stated, present in offsets):
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
        group = groups.get(frame.kind, Place(index.start + position, 0))
        length = group.length + frame.end - frame.start
        groups[frame.kind] = Place(group.start, length)
        position = frame.end
        if frame.kind in _KINDS:
            record = parsed(frame.kind, frame.content)
            if isinstance(record, SummaryOffset):
                place = Place(record.group_start, record.group_length)
                stated[record.group_opcode] = place
            else:
                _add(index, record)
    # A writer may name a part that is empty.
    return [
        (place, groups.get(kind, Place(place.start, 0)))
        for kind, place in stated.items()
    ]


def _add(index: Index, record: McapRecord) -> None:
    """Adds a record to the index."""
    if isinstance(record, Statistics):
        index.statistics = record
    elif isinstance(record, Schema):
        index.inventory.schemas[record.id] = record
    elif isinstance(record, Channel):
        index.inventory.channels[record.id] = record
    elif isinstance(record, ChunkIndex):
        place = Place(record.chunk_start_offset, record.chunk_length)
        index.inventory.chunks.append(place)
    elif isinstance(record, AttachmentIndex):
        place = Place(record.offset, record.length)
        index.inventory.attachments.append(place)
    elif isinstance(record, MetadataIndex):
        place = Place(record.offset, record.length)
        index.inventory.metadata.append(place)
