"""Reads the numbers of ROS messages by their definitions: of ROS 2 (CDR) and ROS 1.

The work is bounded by a message's own bytes: what its definition declares is counted
before anything is read, and lists of messages are walked over without being kept.
Sources: the OMG's CDR (DDSI-RTPS 2.5, section 10; DDS-XTYPES 1.3, section 7.4) and
https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html;
https://wiki.ros.org/msg (ROS 1: the same numbers one after the other, without gaps).
"""

import re
import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

from gpmpc._bounds import MemoryBudget
from gpmpc.logs._file import MOST_COLUMNS, TEXT_BYTES, are_names, names_of_list

LISTED = 64  # entries of a list that become columns, at most
_STEP = 1024  # of a step of a plan [bytes]
_CODES = {  # of ``struct``, by the names of primitive types
    "bool": "?",
    "byte": "B",
    "char": "B",
    "float32": "f",
    "float64": "d",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
}
_TIMES = "int32 sec\nuint32 nanosec"
_BUILTIN = {
    "builtin_interfaces/Time": _TIMES,
    "builtin_interfaces/Duration": _TIMES,
}
_SEPARATOR = re.compile(r"^={3,}\s*$", re.MULTILINE)
_TITLE = re.compile(r"^\s*MSG:\s*(\S+)\s*$", re.MULTILINE)
_CONSTANT = re.compile(r"^\S+\s+[A-Za-z]\w*\s*=")
_FIELD = re.compile(r"^([\w/]+)(<=\d+)?(\[(<=)?(\d*)\])?\s+([A-Za-z]\w*)")
_PLAIN_CDR = {0: ">", 1: "<"}  # byte order, by the kind of encapsulation

Cells = dict[str, float]
Decode = Callable[[bytes], Cells]


class _Step(NamedTuple):
    """One thing that stands in a message: numbers, texts, or a list of messages."""

    path: str  # such as "pose.position.x"
    type: str  # a primitive one, "string", or the name of a message
    length: int | None  # of a fixed list; None: a single value
    counted: bool = False  # whether the list's length stands before it

    @property
    def is_list(self) -> bool:
        return self.counted or self.length is not None


def ros2_decoder(
    name: str, definition: str, budget: MemoryBudget, version: int = 2
) -> Decode:
    """Returns the function that reads the numbers of a message with their paths.

    Args:
        name: Of the type, such as "geometry_msgs/msg/Pose".
        definition: Its text with those of the types inside it.
        budget: Of the file; plans and what is walked over are taken from it.
        version: Of ROS.

    Raises:
        ValueError: The definition is not complete, or holds what cannot be read.
    """
    types = _definitions(name, definition)
    plans: dict[str, list[_Step]] = {}

    def plan(type_name: str) -> list[_Step]:
        if type_name not in plans:
            plans[type_name] = _flat_steps(type_name, types)
            budget.take(_STEP * len(plans[type_name]), f"the message {type_name}")
        return plans[type_name]

    whole = plan(_short(name))
    message = _Message if version == 2 else _PackedMessage
    return lambda data: message(data, plan, budget).numbers(whole)


def _definitions(name: str, text: str) -> dict[str, str]:
    """Returns the definitions of a text, by the short names of their types."""
    types = dict(_BUILTIN)
    for number, part in enumerate(_SEPARATOR.split(text)):
        title = _TITLE.search(part)
        if title:
            types[_short(title[1])] = _TITLE.sub("", part, count=1)
        elif number == 0:
            types[_short(name)] = part
    return types


def _short(name: str) -> str:
    """Returns the name of a type without the folder that ROS 2 puts into it."""
    return name.replace("/msg/", "/")


def _parse_definition(type_name: str, text: str) -> list[_Step]:
    """Parses the fields of a type, those of the types inside it not yet."""
    package = type_name.rpartition("/")[0]
    fields = []
    for line in text.splitlines():
        line = line.partition("#")[0].strip()
        if not line or _CONSTANT.match(line):
            continue
        field = _FIELD.match(line)
        if not field:
            raise ValueError(f"the definition of {type_name} has a line {line[:60]!r}")
        kind, _, brackets, at_most, size, field_name = field.groups()
        if kind == "Header":
            kind = "std_msgs/Header"
        if kind in ("time", "duration"):
            kind = f"builtin_interfaces/{kind.title()}"
        elif kind not in _CODES and kind not in ("string", "wstring"):
            kind = _short(kind if "/" in kind else f"{package}/{kind}")
        counted = bool(brackets) and (bool(at_most) or not size)
        fixed = bool(brackets) and not counted
        if fixed and not int(size):
            raise ValueError(f"{type_name} has a list {field_name!r} of length 0")
        fields.append(_Step(field_name, kind, int(size) if fixed else None, counted))
    return fields


def _flat_steps(type_name: str, types: dict[str, str]) -> list[_Step]:
    """Lists the steps of a message and of the messages inside it, in their order."""
    flattening = _Flattening(type_name, types)
    flattening.add(type_name, prefix="", outer_types=())
    return flattening.steps


class _Flattening:
    """Collects the steps of a message and of the messages inside it."""

    def __init__(self, type_name: str, types: dict[str, str]) -> None:
        self.steps: list[_Step] = []
        self._type_name = type_name
        self._types = types  # definitions, by the names of the types
        self._fields: dict[str, list[_Step]] = {}  # by type
        self._numbers = 0

    def add(self, name: str, prefix: str, outer_types: tuple[str, ...]) -> None:
        """Adds the steps of a type, whose paths begin with the prefix."""
        if name not in self._types:
            raise ValueError(f"the definition of {name} is missing")
        if name in outer_types:
            raise ValueError(f"a message of type {name} holds itself")
        for field in self._fields_of(name):
            path = f"{prefix}{field.path}"
            is_message = field.type in self._types or "/" in field.type
            if is_message and not field.is_list:
                self.add(field.type, f"{path}.", (*outer_types, name))
                continue
            self.steps.append(field._replace(path=path))
            self._numbers += min(field.length or 1, LISTED)
            if self._numbers > MOST_COLUMNS:
                raise ValueError(
                    f"{self._type_name} holds more than {MOST_COLUMNS} numbers"
                )

    def _fields_of(self, name: str) -> list[_Step]:
        if name not in self._fields:
            # A message without fields has a byte: IDL knows no empty structures.
            empty = _Step("", "empty", None)
            fields = _parse_definition(name, self._types[name])
            self._fields[name] = fields or [empty]
        return self._fields[name]


class _Message:
    """The bytes of a message, and how far they were read."""

    empty_size = 1  # of a message without fields [bytes]

    def __init__(
        self, data: bytes, plan: Callable[[str], list[_Step]], budget: MemoryBudget
    ):
        if len(data) < 4:
            raise ValueError(f"it has {len(data)} bytes, fewer than its head")
        kind = data[0] * 256 + data[1]
        if kind not in _PLAIN_CDR:
            raise ValueError(
                f"its encapsulation is {kind:#06x} (XCDR2 or a list of parameters); "
                "only plain CDR is read"
            )
        self.data = data
        self.plan = plan
        self.budget = budget
        self.order = _PLAIN_CDR[kind]
        self.position = 4
        self.names: dict[int, int] = {}  # checksums of lists of names, by length

    def numbers(self, plan: list[_Step]) -> Cells:
        """Reads all numbers but those of lists of more than ``LISTED`` entries."""
        cells: Cells = {}
        lengths: dict[str, int] = {}  # of lists of numbers, by path
        for step in plan:
            values = self.values(step)
            if step.is_list:
                lengths[step.path] = len(values)
                for i, value in enumerate(values):
                    cells[f"{step.path}[{i}]"] = float(value)
            elif values:
                cells[step.path] = float(values[0])
        for path, length in lengths.items():
            if length in self.names and f"{path}[0]" in cells:
                cells[names_of_list(path)] = float(self.names[length])
        return cells

    def values(self, step: _Step) -> tuple[float, ...]:
        """Moves over a step, and returns its numbers; none where they are many."""
        count = 1 if step.length is None else step.length
        if step.counted:
            count = self.length()
        if step.type == "empty":
            self.scalars("B", self.empty_size)
            return ()
        if step.type in _CODES:
            return self.scalars(_CODES[step.type], count)
        if step.type == "wstring":
            raise ValueError(f"{step.path} is a wstring, which is not read")
        if count > len(self.data) - self.position:  # each has a byte at least
            raise ValueError(f"it ends within {step.path}")
        if step.type == "string":
            self.budget.take(TEXT_BYTES * count, "the texts of its messages")
            for _ in range(count):
                length = self.length()
                self.scalars("B", length)
                if step.is_list and are_names(step.path):
                    text = self.data[self.position - length : self.position]
                    self.names[count] = zlib.crc32(text, self.names.get(count, 0))
            return ()
        inner = self.plan(step.type)
        self.budget.take(TEXT_BYTES * count * len(inner), "the lists of its messages")
        for _ in range(count):
            for inner_step in inner:
                self.values(inner_step)
        return ()

    def length(self) -> int:
        """Reads the length of a list or text."""
        return int(self.scalars("I", 1)[0])

    def scalars(self, code: str, count: int) -> tuple[float, ...]:
        """Reads ``count`` numbers of one kind; only moves over more than ``LISTED``."""
        size = struct.calcsize(f"={code}")
        begin = self.begin(size) if count else self.position
        end = begin + size * count
        if end > len(self.data):
            raise ValueError(f"it ends after {len(self.data)} bytes, within its fields")
        self.position = end
        if count > LISTED:
            return ()
        return struct.unpack_from(f"{self.order}{count}{code}", self.data, begin)

    def begin(self, size: int) -> int:
        """Returns where the next number of ``size`` bytes begins."""
        return 4 + -(-(self.position - 4) // size) * size


class _PackedMessage(_Message):
    """The bytes of a message of ROS 1: without head and gaps."""

    empty_size = 0

    def __init__(
        self, data: bytes, plan: Callable[[str], list[_Step]], budget: MemoryBudget
    ):
        self.data = data
        self.plan = plan
        self.budget = budget
        self.order = "<"
        self.position = 0
        self.names: dict[int, int] = {}

    def begin(self, size: int) -> int:
        """Returns where the next number begins: behind the one before."""
        return self.position
