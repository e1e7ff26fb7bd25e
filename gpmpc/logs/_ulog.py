"""Reads PX4's logs (ULog): the topics of a mapping, as far as the file is whole.

``pyulog`` makes tables of what is checked here first: it flattens nested types and
searches damaged files without a bound, so it gets the definitions and the messages that
fit to them, and nothing else.
Source: https://docs.px4.io/main/en/dev_log/ulog_file_format.html.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from gpmpc._bounds import MemoryBudget
from gpmpc.exceptions import DataError
from gpmpc.logs._file import (
    MOST_COLUMNS,
    NUMBER_BYTES,
    LogFile,
    ReadOptions,
    Tables,
    run_name,
)
from gpmpc.logs._findings import Finding

_MAGIC = b"ULog\x01\x12\x35"
_HEADER_SIZE = 16  # of a file [bytes]
_SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"  # what a message of synchronisation holds
_KINDS = frozenset(b"ABCDFILMOPQRS")  # of messages
_HEAD = struct.Struct("<HB")  # length and kind of a message
_SIZES = {  # of primitive types [bytes]
    "int8_t": 1,
    "uint8_t": 1,
    "int16_t": 2,
    "uint16_t": 2,
    "int32_t": 4,
    "uint32_t": 4,
    "int64_t": 8,
    "uint64_t": 8,
    "float": 4,
    "double": 8,
    "bool": 1,
    "char": 1,
}
_FIELD_BYTES = 1024  # of a field of a subscription
_MESSAGE_BYTES = 256  # what a message costs: its time, counted as memory


class _Message(NamedTuple):
    kind: str
    content: bytes
    whole: bytes  # with its head


class _Field(NamedTuple):
    name: str
    type: str


@dataclass
class _Subscription:
    """A topic, and the sizes that its messages may have [bytes]."""

    topic: str
    least: int = 0  # without padding at the end
    most: int = 0
    fields: int = 0


def read_ulog(path: Path, options: ReadOptions) -> LogFile:
    """Reads the topics of a ULog: those of ``options``, or all.

    A file that ends within a message is whole, as loggers end when power does.

    Raises:
        DataError: The file is damaged and ``options.partial`` does not hold, or one of
            the topics cannot be read.
    """
    from pyulog import ULog

    content = path.read_bytes()
    if content[: len(_MAGIC)] != _MAGIC or len(content) < _HEADER_SIZE:
        raise DataError(f"{path}: is not a ULog file")
    messages = _SortedMessages(options.topics, MemoryBudget(path))
    messages.sort(content)
    if (messages.lost or messages.misfits) and not options.partial:
        raise DataError(
            f"{path}: damaged ({messages.lost} of {len(content)} bytes and "
            f"{messages.misfits} messages cannot be read); partial=true takes what is "
            "whole"
        )
    for topic in options.topics:
        if topic in messages.refusals:
            raise DataError(f"{path}: topic {topic}: {messages.refusals[topic]}")
    header = content[:_HEADER_SIZE]
    sound = b"".join((header, *messages.definitions, *messages.data))
    log = ULog(BytesIO(sound))
    tables: Tables = {}
    for data in log.data_list:
        table = pd.DataFrame(data.data)
        table["timestamp"] = table["timestamp"] * 1e-6
        tables[_topic_of(data.name, data.multi_id)] = table
    return LogFile(tables, tuple(messages.findings(run_name(path))))


def _topic_of(name: str, number: int) -> str:
    """Returns the topic of one of several sensors of a kind."""
    return name if number == 0 else f"{name}[{number}]"


class _SortedMessages:
    """The messages of a file: those that pyulog gets, and those that are left out."""

    def __init__(self, topics: tuple[str, ...], budget: MemoryBudget) -> None:
        self._topics = topics  # that are read; none for all
        self._budget = budget
        self._formats: dict[str, list[_Field]] = {}  # by type
        self._subscriptions: dict[int, _Subscription] = {}  # by number
        self._rows: Counter[str] = Counter()  # messages, by topic
        self.definitions: list[bytes] = []
        self.data: list[bytes] = []
        self.refusals: dict[str, str] = {}  # why a topic is not read
        self.misfits = 0  # messages that belong to no topic, or have another length
        self.lost = 0  # [bytes] between what is whole
        self.cut = 0  # [bytes] of a message that the end of the file cuts off

    def sort(self, content: bytes) -> None:
        """Sorts the messages of a file into what can be read and what cannot."""
        in_data = False
        for message in self._read_messages(content):
            try:
                if message.kind == "A":
                    in_data = True
                    self._subscribe(message)
                elif message.kind == "D":
                    self._sort_data(message)
                elif message.kind == "F" and not in_data:
                    name, _, fields = message.content.decode().partition(":")
                    self._formats[name] = _parse_format(fields)
                    self.definitions.append(message.whole)
                elif message.kind == "B" and not self.definitions:
                    self.definitions.append(_flags_without_sections(message))
            except (ValueError, struct.error):
                self.misfits += 1

    def _read_messages(self, content: bytes) -> Iterator[_Message]:
        """Yields whole messages; behind damage it goes on at the next sync message."""
        position = _HEADER_SIZE
        section_ends = [len(content)]
        while position < len(content):
            self._budget.take(_MESSAGE_BYTES, "its messages")
            while len(section_ends) > 1 and position >= section_ends[0]:
                section_ends.pop(0)
            end = section_ends[0]
            head = content[position : position + _HEAD.size]
            begin = position + _HEAD.size
            length, kind = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            if kind in _KINDS and begin + length <= end:
                whole = content[position : begin + length]
                message = _Message(chr(kind), whole[_HEAD.size :], whole)
                if message.kind == "B" and position == _HEADER_SIZE:
                    section_ends = _section_ends(message.content, len(content))
                yield message
                position = begin + length
                continue
            sync = content.find(_SYNC, begin, end)
            resumption = sync - _HEAD.size if sync >= 0 else end
            may_be_cut = kind in _KINDS or begin > len(content)
            if resumption == len(content) and may_be_cut:
                self.cut = resumption - position
            else:
                self.lost += resumption - position
            position = resumption

    def _subscribe(self, message: _Message) -> None:
        """Notes which topic has which number; refuses one that cannot be read."""
        number, message_id = struct.unpack("<BH", message.content[:3])
        name = message.content[3:].decode()
        topic = _topic_of(name, number)
        if message_id in self._subscriptions:
            if self._subscriptions[message_id].topic != topic:
                raise ValueError("a number stands for two topics")
            return
        subscription = _Subscription(topic)
        self._subscriptions[message_id] = subscription
        if self._topics and topic not in self._topics:
            return
        try:
            fields = _flat_fields(name, self._formats)
        except RecursionError:
            self.refusals[topic] = "is nested too deeply"
            return
        except ValueError as error:
            self.refusals[topic] = str(error)
            return
        self._budget.take(_FIELD_BYTES * len(fields), "the fields of its topics")
        subscription.most = sum(_SIZES[field.type] for field in fields)
        while fields and fields[-1].name.startswith("_padding"):
            fields.pop()
        subscription.least = sum(_SIZES[field.type] for field in fields)
        subscription.fields = len(fields)
        if _Field("timestamp", "uint64_t") not in fields:
            self.refusals[topic] = "it has no timestamp"
        elif len({field.name for field in fields}) < len(fields):
            self.refusals[topic] = "two of its fields have one name"
        else:
            self.definitions.append(message.whole)

    def _sort_data(self, message: _Message) -> None:
        """Sorts a message of data to its topic."""
        (message_id,) = struct.unpack("<H", message.content[:2])
        subscription = self._subscriptions.get(message_id)
        if subscription is None:
            raise ValueError("it belongs to no topic")
        topic = subscription.topic
        self._rows[topic] += 1
        is_asked_for = not self._topics or topic in self._topics
        if not is_asked_for or topic in self.refusals:
            return
        if not subscription.least <= len(message.content) - 2 <= subscription.most:
            raise ValueError("it has another length than its topic")
        self._budget.take(
            NUMBER_BYTES * subscription.fields, f"the messages of {topic}"
        )
        self.data.append(message.whole)

    def findings(self, run: str) -> Iterator[Finding]:
        """Yields what was left out or lost, with numbers."""
        if self.cut:
            text = f"the file ends within a message; {self.cut} bytes: left out"
            yield Finding("cut off", run, 1, text)
        if self.lost:
            yield Finding("damaged", run, self.lost, f"{self.lost} bytes: lost")
        if self.misfits:
            text = f"{self.misfits} messages do not fit to their definitions: lost"
            yield Finding("damaged", run, self.misfits, text)
        for topic, reason in self.refusals.items():
            count = self._rows[topic]
            if count:
                text = f"{count} messages of {topic}: {reason}"
                yield Finding("not read", run, count, text)
        unread = [t for t in self._rows if self._topics and t not in self._topics]
        count = sum(self._rows[topic] for topic in unread)
        if count:
            text = f"{count} messages of {len(unread)} other topics: left out"
            yield Finding("not asked for", run, count, text)


def _section_ends(flags: bytes, size: int) -> list[int]:
    """Lists where the sections of a file end.

    Sections are appended to a file that a crash has cut off; the message of flags says
    where they begin.
    """
    offsets = struct.unpack("<3Q", flags[16:40]) if len(flags) >= 40 else ()
    inside = sorted(offset for offset in offsets if _HEADER_SIZE < offset < size)
    return [*inside, size]


def _flags_without_sections(message: _Message) -> bytes:
    """Returns the message of flags without appended sections.

    They stand in their place in what pyulog gets.
    """
    flags = bytearray(message.content)
    if len(flags) < 40:
        raise ValueError("the message of flags is too short")
    flags[8] &= ~1
    flags[16:40] = bytes(24)
    return _HEAD.pack(len(flags), ord("B")) + bytes(flags)


def _parse_format(text: str) -> list[_Field]:
    """Parses a definition such as "uint64_t timestamp;float[3] rate;"."""
    fields = []
    for part in text.split(";"):
        if part:
            kind, name = part.split(" ")[:2]
            size = kind.partition("[")[2].rstrip("]")
            if size and not 0 <= int(size) <= 0xFFFF:
                raise ValueError(f"{name} is a list of {size}")
            fields.append(_Field(name, kind))
    return fields


def _flat_fields(name: str, formats: dict[str, list[_Field]]) -> list[_Field]:
    """Lists the primitive fields of a type and of those inside it.

    Raises:
        ValueError: They are too many, or a type is missing or holds itself.
    """
    flattening = _Flattening(formats)
    flattening.add(name, prefix="", outer_types=())
    return flattening.fields


class _Flattening:
    """Collects the primitive fields of a type and of those inside it."""

    def __init__(self, formats: dict[str, list[_Field]]) -> None:
        self.fields: list[_Field] = []
        self._formats = formats
        self._types = 0  # that were gone through

    def add(self, type_name: str, prefix: str, outer_types: tuple[str, ...]) -> None:
        """Adds the fields of a type, whose names begin with the prefix."""
        self._types += 1
        if type_name in outer_types or type_name not in self._formats:
            raise ValueError(f"its type {type_name!r} is missing, or holds itself")
        for field in self._formats[type_name]:
            kind, bracket, size = field.type.partition("[")
            count = int(size.rstrip("]")) if bracket else 1
            if len(self.fields) + self._types + count > MOST_COLUMNS:
                raise ValueError(f"it has more than {MOST_COLUMNS} fields")
            for i in range(count):
                index = f"[{i}]" if bracket else ""
                path = f"{prefix}{field.name}{index}"
                if kind in _SIZES:
                    self.fields.append(_Field(path, kind))
                else:
                    self.add(kind, f"{path}.", (*outer_types, type_name))
