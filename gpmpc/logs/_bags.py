"""Reads MCAP files of any writer: the numbers of each topic's messages, with stamps.

Channels say how their messages are encoded; the file's profile decides nothing. Only
topics that were asked for are decoded, and what is left out or lost is counted. Chunks
and data have to agree with their checksums, where they have some.
"""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

from gpmpc._bounds import Room
from gpmpc.exceptions import DataError, GpmpcError
from gpmpc.logs._encodings import UnreadError, decoder
from gpmpc.logs._file import (
    NUMBER,
    STAMP,
    TEXT,
    LogFile,
    check_column_count,
    flaw_findings,
    run_name,
)
from gpmpc.logs._log import Finding
from gpmpc.logs._ros2 import Cells, Decode
from gpmpc.recording import NO_CHECKSUMS, Flaw, bag_flaws
from gpmpc.recording._flaws import WRONG_COUNT
from gpmpc.recording._frames import BROKEN, agrees, unfolded

MAGIC = b"\x89MCAP0\r\n"
SAME_CLOCK = 1.0  # [s] between two clocks that are taken for one
_UNSEEN = (NO_CHECKSUMS, WRONG_COUNT)  # flaws that no record shows by itself
_PROFILE = b"\5\0\0\0gpmpc"
_RECORDING = "gpmpc.Step"  # the definition of a recording's steps
_HEAD = struct.Struct("<BQ")  # kind and length of a record
_MESSAGE = struct.Struct("<HIQQ")  # channel, number, time of the log, of publishing
_RECORD = 256  # what a record costs [bytes]: its time, counted as memory
_CHANNEL = 16_384  # what a channel and its definition cost [bytes], as above
_DECODED = 2048  # what a message costs that is decoded [bytes], as above
_COPIES = 4  # of the bytes of a message that is decoded
_LISTED_DAMAGES = 5  # each by its text
_STAMP_FIELDS = [  # seconds and nanoseconds, as ROS 2, ROS 1, Foxglove and protobuf say
    (f"{place}.{seconds}", f"{place}.{nanoseconds}")
    for place in ("header.stamp", "stamp", "timestamp")
    for seconds, nanoseconds in (
        ("sec", "nanosec"),
        ("sec", "nsec"),
        ("secs", "nsecs"),
        ("seconds", "nanos"),
    )
]


_Parsed = TypeVar("_Parsed", Chunk, Schema, Channel)


class _Damaged(Exception):
    """What a file holds does not agree with what it says."""


class _Record(NamedTuple):
    kind: int
    content: bytes


@dataclass
class _Topic:
    """The messages of a topic that were decoded, a column a number."""

    columns: dict[str, array] = field(default_factory=dict)
    log_times: array = field(default_factory=lambda: array("Q"))  # [ns]
    malformed: int = 0

    def append(self, log_time: int, cells: Cells, room: Room) -> None:
        """Adds a message; where it has no number that others have, NaN stands."""
        rows = len(self.log_times)
        new = [path for path in cells if path not in self.columns]
        absent = len(self.columns) + len(new) - len(cells)
        size = TEXT * (len(cells) + absent) + NUMBER * rows * len(new)
        room.take(size, "the numbers of its messages")
        for path in new:
            self.columns[path] = array("d", [np.nan]) * rows
        for path, value in cells.items():
            self.columns[path].append(value)
        if absent:
            for path in self.columns.keys() - cells.keys():
                self.columns[path].append(np.nan)
        self.log_times.append(log_time)


@dataclass
class _Channel:
    """A channel of the file, and how many messages it has."""

    topic: str
    decode: Decode | None
    refusal: str = ""  # why messages that were asked for are not read
    messages: int = 0


def has_own_profile(path: Path) -> bool:
    """Whether the head of an MCAP file says that this package has written it."""
    with path.open("rb") as file:
        # The profile with its length is the first field of the first record.
        head = file.read(len(MAGIC) + _HEAD.size + len(_PROFILE))
    return head.endswith(_PROFILE)


def read_bag(
    path: Path, topics: tuple[str, ...], partial: bool, stamp: str = ""
) -> LogFile | None:
    """Reads the topics of a bag: those that are named, or all.

    None where no topic is named and the file is a recording of this package, whoever
    has rewritten it.

    Args:
        path: An MCAP file.
        topics: Their names; none for all that can be read.
        partial: Takes what is whole of a file that is damaged or cut off.
        stamp: The times of the messages: "header", "log", or "" (see ``_clocks``).

    Raises:
        DataError: The file is damaged, a topic is missing or cannot be read.
    """
    unseen_flaws = [flaw for flaw in bag_flaws(path) if flaw.kind in _UNSEEN]
    if not partial:
        _check_counts(path, unseen_flaws)
    bag = _Bag(path, topics, partial, Room(path))
    try:
        for record in _records(path, bag.room, bag.note_damage):
            bag.take(record)
            if bag.is_recording:
                return None
    except _Damaged as error:
        raise DataError(
            f"{path}: the bag cannot be read to its end ({error}); "
            "partial=true takes what is whole"
        ) from error
    bag.check_topics()
    clocks = _clocks(path, bag.tables, stamp, alone=not topics)
    streams = {
        name: _table(bag.tables[name], clocks.times[name]) for name in bag.tables
    }
    findings = bag.findings() + flaw_findings(path, unseen_flaws)
    return LogFile(streams, (*findings, *clocks.findings))


def _check_counts(path: Path, flaws: list[Flaw]) -> None:
    """Raises ``DataError`` where an index counts otherwise than there is."""
    reasons = [flaw.text for flaw in flaws if flaw.kind == WRONG_COUNT]
    if reasons:
        raise DataError(
            f"{path}: the bag cannot be read to its end ({'; '.join(reasons)}); "
            "partial=true takes what is whole"
        )


@dataclass
class _Bag:
    """What was read of a file so far."""

    path: Path
    topics: tuple[str, ...]  # that are asked for; none for all
    partial: bool  # whether what is whole will do
    room: Room
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, _Channel] = field(default_factory=dict)
    tables: dict[str, _Topic] = field(default_factory=dict)  # by topic
    damages: Counter[str] = field(default_factory=Counter)  # how often, by their texts
    is_recording: bool = False  # of this package, and no topic is asked for

    def note_damage(self, text: str) -> None:
        """Counts what is broken, or raises ``_Damaged`` where all has to be whole."""
        if not self.partial:
            raise _Damaged(text)
        self.damages[text] += 1

    def take(self, record: _Record) -> None:
        """Takes a schema, a channel or a message; all else is nothing to read."""
        kind, content = record
        number = int.from_bytes(content[:2], "little")
        try:
            if kind == Opcode.MESSAGE:
                self._take_message(content)
            elif kind == Opcode.SCHEMA and number not in self.schemas:
                self.room.take(_CHANNEL, "its definitions")
                schema = self.schemas[number] = _parsed(Schema, content)
                is_of_run = schema.name == _RECORDING and not any(self.topics)
                self.is_recording = self.is_recording or is_of_run
            elif kind == Opcode.CHANNEL and number not in self.channels:
                self.room.take(_CHANNEL, "its channels")
                self.channels[number] = self._channel(_parsed(Channel, content))
        except _Damaged as error:
            self.note_damage(str(error))

    def _channel(self, channel: Channel) -> _Channel:
        """How a channel's messages are read; not at all if nobody asked for them."""
        if self.topics and channel.topic not in self.topics:
            return _Channel(channel.topic, decode=None)
        try:
            schema = self.schemas.get(channel.schema_id)
            return _Channel(channel.topic, decoder(channel, schema, self.room))
        except UnreadError as error:
            return _Channel(channel.topic, decode=None, refusal=str(error))

    def _take_message(self, content: bytes) -> None:
        """Counts a message, and decodes it if its topic was asked for."""
        if len(content) < _MESSAGE.size:
            raise _Damaged("a message is shorter than its head")
        channel_id, _, log_time, _ = _MESSAGE.unpack_from(content)
        if channel_id not in self.channels:
            raise _Damaged(f"a message is of channel {channel_id}, which there is not")
        channel = self.channels[channel_id]
        channel.messages += 1
        if channel.decode is None:
            return
        data = content[_MESSAGE.size :]
        self.room.take(_DECODED + _COPIES * len(data), "its messages")
        table = self.tables.setdefault(channel.topic, _Topic())
        try:
            cells = channel.decode(data)
        except GpmpcError:
            raise
        except Exception as error:  # whatever a library raises on a damaged message
            table.malformed += 1
            if self.partial:
                return
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DataError(
                f"{self.path}: message {channel.messages} of {channel.topic} cannot be "
                f"read: {reason[:200]}; partial=true leaves it out"
            ) from error
        table.append(log_time, cells, self.room)
        check_column_count(self.path, len(table.columns), channel.topic)

    def check_topics(self) -> None:
        """Raises ``DataError`` where a topic that was asked for cannot be read."""
        channels = self.channels.values()
        for channel in channels:
            if channel.refusal and channel.topic in self.topics:
                raise DataError(
                    f"{self.path}: topic {channel.topic}: {channel.refusal}"
                )
        known = {channel.topic for channel in channels}
        for topic in self.topics:
            if topic in known and topic not in self.tables:
                raise DataError(f"{self.path}: topic {topic!r} has no message")
            if topic not in known:
                listed = ", ".join(sorted(known)) or "no topics"
                what = f"topic {topic!r} is missing"
                if not topic:
                    what = "a bag has topics, and the mapping names none for a signal"
                raise DataError(f"{self.path}: {what}; it has {listed}")

    def findings(self) -> list[Finding]:
        """What was not read, lost or damaged, with numbers."""
        run = run_name(self.path)
        findings = []
        for text, count in self.damages.most_common(_LISTED_DAMAGES):
            often = f" ({count} times)" if count > 1 else ""
            findings.append(Finding("damaged", run, count, f"{text}{often}: lost"))
        unlisted = self.damages.total() - sum(finding.count for finding in findings)
        if unlisted:
            text = f"{unlisted} other places are damaged: lost"
            findings.append(Finding("damaged", run, unlisted, text))
        for topic, table in self.tables.items():
            count = table.malformed
            if count:
                text = f"{count} messages of {topic} cannot be read: left out"
                findings.append(Finding("malformed message", run, count, text))
        for channel in self.channels.values():
            count = channel.messages
            if channel.refusal and count:
                text = f"{count} messages of {channel.topic}: {channel.refusal}"
                findings.append(Finding("not read", run, count, text))
        asked = self.topics or {channel.topic for channel in self.channels.values()}
        others = [c for c in self.channels.values() if c.topic not in asked]
        count = sum(channel.messages for channel in others)
        if count:
            text = f"{count} messages of {len(others)} other topics: left out"
            findings.append(Finding("not asked for", run, count, text))
        return findings


def _records(
    path: Path, room: Room, note_damage: Callable[[str], None]
) -> Iterator[_Record]:
    """Yields the records of the data section, those inside of chunks in their place.

    Args:
        path: An MCAP file.
        room: What chunks unfold to is taken from it.
        note_damage: Takes what is broken, in words; may raise.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise DataError(f"{path}: is not an MCAP file")
        checksum = zlib.crc32(MAGIC)
        while True:
            position = file.tell()
            record = _next_record(file, size)
            if record is None:
                left = size - position
                note_damage(f"the last {left} of {size} bytes are cut off or no record")
                return
            kind, content = record
            if kind == Opcode.DATA_END:
                if not agrees(int.from_bytes(content[:4], "little"), checksum):
                    note_damage("the checksum of all data is wrong")
                return
            head = _HEAD.pack(kind, len(content))
            checksum = zlib.crc32(content, zlib.crc32(head, checksum))
            room.take(_RECORD, "its records")
            if kind != Opcode.CHUNK:
                yield record
                continue
            where = f"at byte {position}"
            try:
                chunk = _parsed(Chunk, content)
                begin = chunk.message_start_time
                end = chunk.message_end_time
                where = f"with the messages from {begin / 1e9} to {end / 1e9} s"
                yield from _inside(_unfold(chunk, room), room)
            except _Damaged as error:
                note_damage(f"a chunk {where} is damaged: {error}")


def _next_record(file: BinaryIO, size: int) -> _Record | None:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    kind, length = _HEAD.unpack(head)
    if not kind or length > size - file.tell():
        return None
    return _Record(kind, file.read(length))


def _unfold(chunk: Chunk, room: Room) -> bytes:
    """Decompresses a chunk; ``_Damaged`` where its size or its checksum is another."""
    room.take(chunk.uncompressed_size, "its chunks")
    try:
        return unfolded(chunk, largest=room.size)
    except BROKEN as error:
        raise _Damaged("its size, its checksum or its compression is wrong") from error


def _inside(data: bytes, room: Room) -> Iterator[_Record]:
    """Yields the records of an unfolded chunk."""
    position = 0
    while position < len(data):
        if position + _HEAD.size > len(data):
            raise _Damaged("it ends within a record")
        kind, length = _HEAD.unpack_from(data, position)
        begin = position + _HEAD.size
        position = begin + length
        if position > len(data):
            raise _Damaged("it ends within a record")
        room.take(_RECORD, "its records")
        if kind in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            yield _Record(kind, data[begin:position])


def _parsed(kind: type[_Parsed], content: bytes) -> _Parsed:
    """Parses a record that is none of a message."""
    try:
        return kind.read(ReadDataStream(BytesIO(content)))
    except Exception as error:  # whatever the library raises on damaged records
        raise _Damaged(f"a {kind.__name__.lower()} record is broken") from error


class _Clocks(NamedTuple):
    """The times (K,) [s] of the messages by topic."""

    times: dict[str, np.ndarray]
    findings: tuple[Finding, ...] = ()


def _clocks(path: Path, tables: dict[str, _Topic], stamp: str, alone: bool) -> _Clocks:
    """Chooses between the stamps in the messages and the times of the log.

    Unless the mapping decides, messages have the times of their stamps where all topics
    are stamped by one clock, and those of the log otherwise. A topic without stamps has
    the log's clock. So topics have time in common whenever the log can have it.

    Args:
        path: Of the file.
        tables: By topic.
        stamp: "header", "log", or "" for the rule above.
        alone: Whether each topic is looked at for itself.
    """
    logged = {topic: _log_times(table) for topic, table in tables.items()}
    stamped = {topic: _stamps(table) for topic, table in tables.items()}
    headers = {topic: times for topic, times in stamped.items() if times is not None}
    bare = [topic for topic in tables if topic not in headers]
    if stamp == "header" and bare:
        raise DataError(
            f"{path}: stamp: header, but the messages of {bare[0]} carry no stamps"
        )
    if stamp == "log" or not headers:
        return _Clocks(logged)
    chosen = _Clocks(logged | headers)
    if stamp == "header" or alone:
        return chosen
    reference = bare[0] if bare else next(iter(headers))
    offsets = {
        topic: _offset(topic, reference, logged, chosen.times) for topic in headers
    }
    farthest = max(offsets, key=lambda topic: abs(offsets[topic]))
    if abs(offsets[farthest]) <= SAME_CLOCK:
        return chosen
    text = (
        f"the stamps of {farthest} are {offsets[farthest]:.6g} s off the clock of "
        f"{reference}: all times are those of the log (stamp: header | log decides)"
    )
    return _Clocks(logged, (Finding("times of the log", run_name(path), 1, text),))


def _offset(
    topic: str,
    reference: str,
    logged: dict[str, np.ndarray],
    times: dict[str, np.ndarray],
) -> float:
    """By how much a topic's clock is ahead of another's, as the log sees them [s]."""
    order = np.argsort(logged[reference])
    behind = (logged[reference] - times[reference])[order]
    finite = np.isfinite(behind)
    if not finite.any():
        return np.inf
    expected = np.interp(
        logged[topic], logged[reference][order][finite], behind[finite]
    )
    return float(np.nanmedian(expected - (logged[topic] - times[topic])))


def _stamps(table: _Topic) -> np.ndarray | None:
    """The stamps (K,) [s] in a topic's messages; None where they carry none.

    They carry none where all are equal, such as zero. A single zero is a time: a
    simulated clock begins with it.
    """
    for seconds, nanoseconds in _STAMP_FIELDS:
        if seconds in table.columns and nanoseconds in table.columns:
            times = np.array(table.columns[seconds])
            times += np.array(table.columns[nanoseconds]) / 1e9
            finite = times[np.isfinite(times)]
            is_set = len(finite) > 0 and (np.ptp(finite) > 0 or finite[0] != 0)
            is_stuck = len(finite) > 1 and np.ptp(finite) == 0
            return times if is_set and not is_stuck else None
    return None


def _log_times(table: _Topic) -> np.ndarray:
    """The times (K,) [s] at which a topic's messages were logged."""
    return np.array(table.log_times, dtype=np.uint64) / 1e9


def _table(topic: _Topic, times: np.ndarray) -> pd.DataFrame:
    """The messages of a topic in the order of the log, which files need not keep."""
    order = np.argsort(np.array(topic.log_times), kind="stable")
    columns = {STAMP: times} | {k: np.array(v) for k, v in topic.columns.items()}
    return pd.DataFrame(columns).iloc[order].reset_index(drop=True)
