"""Reads bags in MCAP, of any writer: the numbers of each topic's messages, with stamps.

``Bag`` collects the messages of a bag, in whatever files they are (``_rosbags`` has
others).

Channels say how their messages are encoded; the file's profile decides nothing. Only
topics that were asked for are decoded, and what is left out or lost is counted. Chunks
and data have to agree with their checksums, where they have some.
"""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import DataError, GpmpcError
from gpmpc.logs._bag_clocks import choose_times
from gpmpc.logs._encodings import UnreadError, find_decoder
from gpmpc.logs._file import (
    LIST_NAMES,
    NUMBER_BYTES,
    STAMP,
    TEXT_BYTES,
    LogFile,
    ReadOptions,
    check_column_count,
    first_line,
    flaw_findings,
    run_name,
)
from gpmpc.logs._findings import Finding
from gpmpc.logs._ros2 import Cells, Decode
from gpmpc.recording import NO_CHECKSUMS, Flaw, bag_flaws
from gpmpc.recording._flaws import WRONG_COUNT
from gpmpc.recording._frames import BROKEN, agrees, unfolded

MAGIC = b"\x89MCAP0\r\n"
_UNSEEN = (NO_CHECKSUMS, WRONG_COUNT)  # flaws that no record shows by itself
_PROFILE = b"\5\0\0\0gpmpc"
_RECORDING = "gpmpc.Step"  # the definition of a recording's steps
_HEAD = struct.Struct("<BQ")  # kind and length of a record
_MESSAGE = struct.Struct("<HIQQ")  # channel, number, time of the log, of publishing
_RECORD_BYTES = 256  # what a record costs: its time, counted as memory
_CHANNEL_BYTES = 16_384  # what a channel and its definition cost, as above
_DECODED_BYTES = 2048  # what a message costs that is decoded, as above
_COPIES = 4  # of the bytes of a message that is decoded
_LISTED_DAMAGES = 5  # each by its text
_Parsed = TypeVar("_Parsed", Chunk, Schema, Channel)


class _Damaged(Exception):
    """The content of a file does not agree with what the file says."""


class _Record(NamedTuple):
    kind: int
    content: bytes


@dataclass
class _TopicTable:
    """The messages of a topic that were decoded, a column a number."""

    columns: dict[str, array] = field(default_factory=dict)
    log_times: array = field(default_factory=lambda: array("Q"))  # [ns]
    malformed: int = 0

    def append(self, log_time: int, cells: Cells, budget: MemoryBudget) -> None:
        """Adds a message; where it has no number that others have, NaN stands."""
        rows = len(self.log_times)
        new_paths = [path for path in cells if path not in self.columns]
        absent = len(self.columns) + len(new_paths) - len(cells)
        size = TEXT_BYTES * (len(cells) + absent)
        size += NUMBER_BYTES * rows * len(new_paths)
        budget.take(size, "the numbers of its messages")
        for path in new_paths:
            self.columns[path] = array("d", [np.nan]) * rows
        for path, value in cells.items():
            self.columns[path].append(value)
        if absent:
            for path in self.columns.keys() - cells.keys():
                self.columns[path].append(np.nan)
        self.log_times.append(log_time)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the columns as arrays (K,)."""
        return {path: np.array(column) for path, column in self.columns.items()}

    def seconds(self) -> np.ndarray:
        """Returns the times (K,) [s] at which the messages were logged."""
        return np.array(self.log_times, dtype=np.uint64) / 1e9

    def as_frame(self, times: np.ndarray) -> pd.DataFrame:
        """Makes a table in the order of the log, which files need not keep.

        Args:
            times: Of the messages, in the order of the file (K,) [s].
        """
        order = np.argsort(np.array(self.log_times), kind="stable")
        columns = self.arrays()
        for path in [path for path in columns if path.endswith(LIST_NAMES)]:
            names = columns[path]
            if len(np.unique(names[np.isfinite(names)])) < 2:
                del columns[path]
        frame = pd.DataFrame({STAMP: times} | columns)
        return frame.iloc[order].reset_index(drop=True)


@dataclass
class BagChannel:
    """A channel of a file, and how many messages it has."""

    topic: str
    decode: Decode | None
    refusal: str = ""  # why messages that were asked for are not read
    messages: int = 0


def has_own_profile(path: Path) -> bool:
    """Tells whether the head of an MCAP file says that this package has written it."""
    with path.open("rb") as file:
        # The profile with its length is the first field of the first record.
        head = file.read(len(MAGIC) + _HEAD.size + len(_PROFILE))
    return head.endswith(_PROFILE)


def read_bag(
    path: Path, options: ReadOptions, files: Sequence[Path] = ()
) -> LogFile | None:
    """Reads the topics of a bag: those of ``options``, or all.

    Args:
        path: An MCAP file, or a folder of some.
        options: See ``ReadOptions``.
        files: Those of a folder.

    Returns:
        The tables; None where no topic is named and the file is a recording of this
        package, whoever has rewritten it.

    Raises:
        DataError: The file is damaged, or a topic is missing or cannot be read.
    """
    bag = Bag(path, options, MemoryBudget(path))
    unseen_flaws: list[Flaw] = []
    for file in files or [path]:
        bag.begin_file()
        flaws = [flaw for flaw in bag_flaws(file) if flaw.kind in _UNSEEN]
        unseen_flaws += flaws
        try:
            if not options.partial:
                _check_counts(flaws)
            for record in _records(file, bag.budget, bag.note_damage):
                bag.add(record)
                if bag.is_recording:
                    return None
        except _Damaged as error:
            raise DataError(
                f"{file}: the bag cannot be read to its end ({error}); "
                "partial=true takes what is whole"
            ) from error
    log_file = bag.log_file()
    findings = (*log_file.findings, *flaw_findings(path, unseen_flaws))
    return log_file._replace(findings=findings)


def _check_counts(flaws: list[Flaw]) -> None:
    """Raises ``_Damaged`` where an index counts otherwise than there is."""
    reasons = [flaw.text for flaw in flaws if flaw.kind == WRONG_COUNT]
    if reasons:
        raise _Damaged("; ".join(reasons))


@dataclass
class Bag:
    """The content of a bag's files, as far as they were read."""

    path: Path
    options: ReadOptions
    budget: MemoryBudget
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, BagChannel] = field(default_factory=dict)  # of the present file
    all_channels: list[BagChannel] = field(default_factory=list)
    tables: dict[str, _TopicTable] = field(default_factory=dict)  # by topic
    damages: Counter[str] = field(default_factory=Counter)  # how often, by their texts
    is_recording: bool = False  # of this package, and no topic is asked for

    def begin_file(self) -> None:
        """Forgets the numbers of channels and definitions, which each file has anew."""
        self.schemas = {}
        self.channels = {}

    def is_asked_for(self, topic: str) -> bool:
        """Tells whether the messages of a topic are read."""
        return not self.options.topics or topic in self.options.topics

    def add_channel(self, number: int, channel: BagChannel) -> None:
        """Adds a channel of the present file."""
        self.budget.take(_CHANNEL_BYTES, "its channels")
        self.channels[number] = channel
        self.all_channels.append(channel)

    def note_damage(self, text: str) -> None:
        """Counts what is broken, or raises ``_Damaged`` where all has to be whole."""
        if not self.options.partial:
            raise _Damaged(text)
        self.damages[text] += 1

    def add(self, record: _Record) -> None:
        """Adds a schema, a channel or a message; all else is nothing to read."""
        kind, content = record
        number = int.from_bytes(content[:2], "little")
        try:
            if kind == Opcode.MESSAGE:
                self._add_message(content)
            elif kind == Opcode.SCHEMA and number not in self.schemas:
                self.budget.take(_CHANNEL_BYTES, "its definitions")
                schema = _parsed(Schema, content)
                self.schemas[number] = schema
                if schema.name == _RECORDING and not any(self.options.topics):
                    self.is_recording = True
            elif kind == Opcode.CHANNEL and number not in self.channels:
                self.add_channel(number, self._channel(_parsed(Channel, content)))
        except _Damaged as error:
            self.note_damage(str(error))

    def _channel(self, channel: Channel) -> BagChannel:
        """Finds the decoder of a channel's messages; none if nobody asked for them."""
        if not self.is_asked_for(channel.topic):
            return BagChannel(channel.topic, decode=None)
        try:
            schema = self.schemas.get(channel.schema_id)
            decode = find_decoder(channel, schema, self.budget)
            return BagChannel(channel.topic, decode)
        except UnreadError as error:
            return BagChannel(channel.topic, decode=None, refusal=str(error))

    def _add_message(self, content: bytes) -> None:
        """Adds a message."""
        if len(content) < _MESSAGE.size:
            raise _Damaged("a message is shorter than its head")
        channel_id, _, log_time, _ = _MESSAGE.unpack_from(content)
        if channel_id not in self.channels:
            raise _Damaged(f"a message is of channel {channel_id}, which there is not")
        self.add_data(self.channels[channel_id], log_time, content[_MESSAGE.size :])

    def add_data(self, channel: BagChannel, log_time: int, data: bytes) -> None:
        """Decodes a message that was logged at a time [ns], if its topic is read."""
        channel.messages += 1
        if channel.decode is None:
            return
        self.budget.take(_DECODED_BYTES + _COPIES * len(data), "its messages")
        table = self.tables.setdefault(channel.topic, _TopicTable())
        try:
            cells = channel.decode(data)
        except GpmpcError:
            raise
        except Exception as error:  # whatever a library raises on a damaged message
            table.malformed += 1
            if self.options.partial:
                return
            reason = first_line(error)[:200]
            raise DataError(
                f"{self.path}: message {channel.messages} of {channel.topic} cannot be "
                f"read: {reason}; partial=true leaves it out"
            ) from error
        table.append(log_time, cells, self.budget)
        check_column_count(self.path, len(table.columns), channel.topic)

    def log_file(self) -> LogFile:
        """Makes the tables of what was read.

        Raises:
            DataError: A topic that was asked for cannot be read.
        """
        self._check_topics()
        clocks = choose_times(
            path=self.path,
            columns={name: table.arrays() for name, table in self.tables.items()},
            logged={name: table.seconds() for name, table in self.tables.items()},
            stamp=self.options.stamp,
            topic_by_topic=not self.options.topics,
        )
        tables = {
            name: table.as_frame(clocks.times[name])
            for name, table in self.tables.items()
        }
        return LogFile(tables, (*self._findings(), *clocks.findings))

    def _check_topics(self) -> None:
        """Raises ``DataError`` where a topic that was asked for cannot be read."""
        for channel in self.all_channels:
            if channel.refusal and channel.topic in self.options.topics:
                raise DataError(
                    f"{self.path}: topic {channel.topic}: {channel.refusal}"
                )
        present = {channel.topic for channel in self.all_channels}
        for topic in self.options.topics:
            if topic in present and topic not in self.tables:
                raise DataError(f"{self.path}: topic {topic!r} has no message")
            if topic not in present:
                listed = ", ".join(sorted(present)) or "no topics"
                fault = f"topic {topic!r} is missing"
                if not topic:
                    fault = "a bag has topics, and the mapping names none for a signal"
                raise DataError(f"{self.path}: {fault}; it has {listed}")

    def _findings(self) -> list[Finding]:
        """Returns what was not read, lost or damaged, with numbers."""
        run = run_name(self.path)
        findings = self._damage_findings(run)
        for topic, table in self.tables.items():
            count = table.malformed
            if count:
                text = f"{count} messages of {topic} cannot be read: left out"
                findings.append(Finding("malformed message", run, count, text))
        for channel in self.all_channels:
            count = channel.messages
            if channel.refusal and count:
                text = f"{count} messages of {channel.topic}: {channel.refusal}"
                findings.append(Finding("not read", run, count, text))
        if self.options.topics:
            findings += self._unread_findings(run)
        return findings

    def _damage_findings(self, run: str) -> list[Finding]:
        findings = []
        for text, count in self.damages.most_common(_LISTED_DAMAGES):
            often = f" ({count} times)" if count > 1 else ""
            findings.append(Finding("damaged", run, count, f"{text}{often}: lost"))
        unlisted = self.damages.total() - sum(finding.count for finding in findings)
        if unlisted:
            text = f"{unlisted} other places are damaged: lost"
            findings.append(Finding("damaged", run, unlisted, text))
        return findings

    def _unread_findings(self, run: str) -> list[Finding]:
        unread = [
            channel
            for channel in self.all_channels
            if channel.topic not in self.options.topics
        ]
        count = sum(channel.messages for channel in unread)
        if not count:
            return []
        topics = {channel.topic for channel in unread}
        text = f"{count} messages of {len(topics)} other topics: left out"
        return [Finding("not asked for", run, count, text)]


def _records(
    path: Path, budget: MemoryBudget, note_damage: Callable[[str], None]
) -> Iterator[_Record]:
    """Yields the records of the data section, those inside of chunks in their place.

    Args:
        path: An MCAP file.
        budget: What chunks unfold to is taken from it.
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
                unread = size - position
                note_damage(
                    f"the last {unread} of {size} bytes are cut off or no record"
                )
                return
            kind, content = record
            if kind == Opcode.DATA_END:
                if not agrees(int.from_bytes(content[:4], "little"), checksum):
                    note_damage("the checksum of all data is wrong")
                return
            head = _HEAD.pack(kind, len(content))
            checksum = zlib.crc32(content, zlib.crc32(head, checksum))
            budget.take(_RECORD_BYTES, "its records")
            if kind == Opcode.CHUNK:
                yield from _records_of_chunk(content, position, budget, note_damage)
            else:
                yield record


def _records_of_chunk(
    content: bytes,
    position: int,
    budget: MemoryBudget,
    note_damage: Callable[[str], None],
) -> Iterator[_Record]:
    """Yields the records of a chunk that stands at a position, up to damage."""
    where = f"at byte {position}"
    try:
        chunk = _parsed(Chunk, content)
        begin = chunk.message_start_time / 1e9
        end = chunk.message_end_time / 1e9
        where = f"with the messages from {begin} to {end} s"
        yield from _inside(_unfold(chunk, budget), budget)
    except _Damaged as error:
        note_damage(f"a chunk {where} is damaged: {error}")


def _next_record(file: BinaryIO, size: int) -> _Record | None:
    """Reads the next record of a file of ``size`` bytes; None where there is none."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    kind, length = _HEAD.unpack(head)
    if not kind or length > size - file.tell():
        return None
    return _Record(kind, file.read(length))


def _unfold(chunk: Chunk, budget: MemoryBudget) -> bytes:
    """Decompresses a chunk; ``_Damaged`` where its size or its checksum is another."""
    budget.take(chunk.uncompressed_size, "its chunks")
    try:
        return unfolded(chunk, largest=budget.size)
    except BROKEN as error:
        raise _Damaged("its size, its checksum or its compression is wrong") from error


def _inside(data: bytes, budget: MemoryBudget) -> Iterator[_Record]:
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
        budget.take(_RECORD_BYTES, "its records")
        if kind in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            yield _Record(kind, data[begin:position])


def _parsed(kind: type[_Parsed], content: bytes) -> _Parsed:
    """Parses a schema, a channel or a chunk."""
    try:
        return kind.read(ReadDataStream(BytesIO(content)))
    except Exception as error:  # whatever the library raises on damaged records
        raise _Damaged(f"a {kind.__name__.lower()} record is broken") from error
