"""Reads PX4's logs: the topics that are asked for, as far as the file is whole.

``pyulog`` makes tables of what is checked here first: it flattens nested types and
searches damaged files without a bound, so it gets the definitions and the messages that
fit to them, and nothing else.
Source: https://docs.px4.io/main/en/dev_log/ulog_file_format.html.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from gpmpc._bounds import Room
from gpmpc.exceptions import DataError
from gpmpc.logs._file import MOST_COLUMNS, NUMBER, LogFile, Streams, run_name
from gpmpc.logs._log import Finding

_MAGIC = b"ULog\x01\x12\x35"
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
_FIELD = 1024  # of a field of a subscription [bytes]
_MESSAGE = 256  # what a message costs [bytes]: its time, counted as memory


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
    least: int  # without padding at the end
    most: int
    fields: int


@dataclass
class _Parts:
    """What pyulog gets, and what it does not."""

    definitions: list[bytes] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)
    subscriptions: dict[int, _Subscription] = field(default_factory=dict)
    refusals: dict[str, str] = field(default_factory=dict)  # why, by topic
    rows: Counter[str] = field(default_factory=Counter)  # messages, by topic
    misfits: int = 0  # messages that belong to no topic, or have another length
    lost: int = 0  # [bytes] between what is whole
    cut: int = 0  # [bytes] of a message that the end of the file cuts off


def read_ulog(path: Path, topics: tuple[str, ...], partial: bool) -> LogFile:
    """Reads the topics of a ULog: those that are named, or all.

    A file that ends within a message is whole, as loggers end when power does.

    Raises:
        DataError: The file is damaged and ``partial`` does not hold, or a topic that is
            asked for cannot be read.
    """
    from pyulog import ULog

    content = path.read_bytes()
    if content[: len(_MAGIC)] != _MAGIC or len(content) < 16:
        raise DataError(f"{path}: is not a ULog file")
    parts = _sorted_out(content, topics, Room(path))
    if (parts.lost or parts.misfits) and not partial:
        raise DataError(
            f"{path}: damaged ({parts.lost} of {len(content)} bytes and {parts.misfits}"
            " messages cannot be read); partial=true takes what is whole"
        )
    for topic in topics:
        if topic in parts.refusals:
            raise DataError(f"{path}: topic {topic}: {parts.refusals[topic]}")
    sound = b"".join((content[:16], *parts.definitions, *parts.data))
    log = ULog(BytesIO(sound))
    streams: Streams = {}
    for data in log.data_list:
        table = pd.DataFrame(data.data)
        table["timestamp"] = table["timestamp"] * 1e-6
        streams[_title(data.name, data.multi_id)] = table
    return LogFile(streams, tuple(_findings(path, parts, topics)))


def _title(name: str, number: int) -> str:
    return name if number == 0 else f"{name}[{number}]"


def _sorted_out(content: bytes, topics: tuple[str, ...], room: Room) -> _Parts:
    """Sorts the messages of a file into what can be read and what cannot."""
    parts = _Parts()
    formats: dict[str, list[_Field]] = {}
    in_data = False
    for message in _messages(content, parts, room):
        try:
            if message.kind == "A":
                in_data = True
                _subscribe(message, formats, topics, parts, room)
            elif message.kind == "D":
                _sort_in(message, topics, parts, room)
            elif message.kind == "F" and not in_data:
                name, _, fields = message.content.decode().partition(":")
                formats[name] = _fields(fields)
                parts.definitions.append(message.whole)
            elif message.kind == "B" and not parts.definitions:
                parts.definitions.append(_flags(message))
        except (ValueError, struct.error):
            parts.misfits += 1
    return parts


def _messages(content: bytes, parts: _Parts, room: Room) -> Iterator[_Message]:
    """Yields whole messages; behind damage it goes on at the next synchronisation."""
    position = 16
    ends = [len(content)]
    while position < len(content):
        room.take(_MESSAGE, "its messages")
        while len(ends) > 1 and position >= ends[0]:
            ends.pop(0)
        head = content[position : position + _HEAD.size]
        begin = position + _HEAD.size
        length, kind = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        if kind in _KINDS and begin + length <= ends[0]:
            whole = content[position : begin + length]
            message = _Message(chr(kind), whole[_HEAD.size :], whole)
            if message.kind == "B" and position == 16:
                ends = _section_ends(message.content, len(content))
            yield message
            position = begin + length
            continue
        found = content.find(_SYNC, begin, ends[0])
        resumption = found - _HEAD.size if found >= 0 else ends[0]
        may_be_cut = kind in _KINDS or begin > len(content)
        if resumption == len(content) and may_be_cut:
            parts.cut = resumption - position
        else:
            parts.lost += resumption - position
        position = resumption


def _section_ends(flags: bytes, size: int) -> list[int]:
    """Where the sections of a file end; others are appended to what a crash cut off."""
    offsets = struct.unpack("<3Q", flags[16:40]) if len(flags) >= 40 else ()
    return [*sorted(offset for offset in offsets if 16 < offset < size), size]


def _flags(message: _Message) -> bytes:
    """The message of flags without appended sections, which stand in their place."""
    flags = bytearray(message.content)
    if len(flags) < 40:
        raise ValueError("the message of flags is too short")
    flags[8] &= ~1
    flags[16:40] = bytes(24)
    return _HEAD.pack(len(flags), ord("B")) + bytes(flags)


def _fields(text: str) -> list[_Field]:
    """The fields of a definition such as "uint64_t timestamp;float[3] rate;"."""
    fields = []
    for part in text.split(";"):
        if part:
            kind, name = part.split(" ")[:2]
            size = kind.partition("[")[2].rstrip("]")
            if size and not 0 <= int(size) <= 0xFFFF:
                raise ValueError(f"{name} is a list of {size}")
            fields.append(_Field(name, kind))
    return fields


def _flat(name: str, formats: dict[str, list[_Field]]) -> list[_Field]:
    """The primitive fields of a type and of those inside it; ``ValueError`` of many."""
    flat: list[_Field] = []
    types = 0

    def add(type_name: str, prefix: str, outer: tuple[str, ...]) -> None:
        nonlocal types
        types += 1
        if type_name in outer or type_name not in formats:
            raise ValueError(f"its type {type_name!r} is missing, or holds itself")
        for name, kind in formats[type_name]:
            kind, bracket, size = kind.partition("[")
            count = int(size.rstrip("]")) if bracket else 1
            if len(flat) + types + count > MOST_COLUMNS:
                raise ValueError(f"it has more than {MOST_COLUMNS} fields")
            for i in range(count):
                path = f"{prefix}{name}[{i}]" if bracket else f"{prefix}{name}"
                if kind in _SIZES:
                    flat.append(_Field(path, kind))
                else:
                    add(kind, f"{path}.", (*outer, type_name))

    add(name, "", ())
    return flat


def _subscribe(
    message: _Message,
    formats: dict[str, list[_Field]],
    topics: tuple[str, ...],
    parts: _Parts,
    room: Room,
) -> None:
    """Notes which topic has which number; those that cannot be read are refused."""
    number, message_id = struct.unpack("<BH", message.content[:3])
    name = message.content[3:].decode()
    topic = _title(name, number)
    if message_id in parts.subscriptions:
        if parts.subscriptions[message_id].topic != topic:
            raise ValueError("a number stands for two topics")
        return
    subscription = _Subscription(topic, least=0, most=0, fields=0)
    parts.subscriptions[message_id] = subscription
    if topics and topic not in topics:
        return
    try:
        fields = _flat(name, formats)
    except (ValueError, RecursionError) as error:
        reason = "is nested too deeply" if isinstance(error, RecursionError) else error
        parts.refusals[topic] = str(reason)
        return
    room.take(_FIELD * len(fields), "the fields of its topics")
    subscription.most = sum(_SIZES[kind] for _, kind in fields)
    while fields and fields[-1].name.startswith("_padding"):
        fields.pop()
    subscription.least = sum(_SIZES[kind] for _, kind in fields)
    subscription.fields = len(fields)
    if _Field("timestamp", "uint64_t") not in fields:
        parts.refusals[topic] = "it has no timestamp"
    elif len({name for name, _ in fields}) < len(fields):
        parts.refusals[topic] = "two of its fields have one name"
    else:
        parts.definitions.append(message.whole)


def _sort_in(
    message: _Message, topics: tuple[str, ...], parts: _Parts, room: Room
) -> None:
    """Sorts a message of data to its topic."""
    (message_id,) = struct.unpack("<H", message.content[:2])
    subscription = parts.subscriptions.get(message_id)
    if subscription is None:
        raise ValueError("it belongs to no topic")
    topic = subscription.topic
    parts.rows[topic] += 1
    if (topics and topic not in topics) or topic in parts.refusals:
        return
    if not subscription.least <= len(message.content) - 2 <= subscription.most:
        raise ValueError("it has another length than its topic")
    room.take(NUMBER * subscription.fields, f"the messages of {topic}")
    parts.data.append(message.whole)


def _findings(path: Path, parts: _Parts, topics: tuple[str, ...]) -> Iterator[Finding]:
    """What was left out or lost, with numbers."""
    run = run_name(path)
    if parts.cut:
        text = f"the file ends within a message; {parts.cut} bytes: left out"
        yield Finding("cut off", run, 1, text)
    if parts.lost:
        yield Finding("damaged", run, parts.lost, f"{parts.lost} bytes: lost")
    if parts.misfits:
        text = f"{parts.misfits} messages do not fit to their definitions: lost"
        yield Finding("damaged", run, parts.misfits, text)
    for topic, reason in parts.refusals.items():
        count = parts.rows[topic]
        if count:
            yield Finding(
                "not read", run, count, f"{count} messages of {topic}: {reason}"
            )
    others = [topic for topic in parts.rows if topics and topic not in topics]
    count = sum(parts.rows[topic] for topic in others)
    if count:
        text = f"{count} messages of {len(others)} other topics: left out"
        yield Finding("not asked for", run, count, text)
