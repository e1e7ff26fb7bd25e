"""The content of a recording: topics with protobuf messages, metadata, an attachment.

``PROTO`` defines the messages. States and inputs become scalar fields with the plant's
own names (``state.x``, ``input.U1``), because a plot tool draws an array as one line.
So the definitions are completed at run time, and travel in the file. A descriptor loses
comments, so units stand in the file's metadata record ``units``, by field path.

Packed ``repeated double`` has the wire format of ``bytes`` that hold the little-endian
float64 values. The package reads and writes its messages with ``bytes`` in these
places: a thousand numbers then cost one copy.
"""

import re
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import (
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from gpmpc.exceptions import SettingError
from gpmpc.status import Status

# The marks @STATES@, @INPUTS@ and @STATUSES@ stand for a field, or value, of each name.
PROTO = """
syntax = "proto3";
package gpmpc;

enum Status {
  @STATUSES@
}

message State {
  @STATES@
}

message Input {
  @INPUTS@
}

message Timing {  // of a decision [s]
  double model = 1;
  double build = 2;
  double solve = 3;
  double total = 4;
}

message Step {  // topic /step, one a time step
  double time = 1;
  int64 k = 2;
  State reference = 3;
  State state = 4;
  State measured = 5;
  Input input = 6;
  Input input_lower = 7;
  Input input_upper = 8;
  State innovation = 9;
  State belief_std = 10;
  repeated double belief_covariance = 11;  // (n, n)
  Status status = 12;
  int64 iterations = 13;
  int64 active_set_size = 14;
  Timing timing = 15;
  // 16 was a field of older recordings, and is not used again.
  int64 gp_size = 17;
  int64 gp_version = 18;
  bool failed = 19;
  double novelty = 20;
  string judgement = 21;  // of LEVELS
  string reason = 22;
}

message Stage {  // of a plan; the last has no input
  double time = 1;
  State mean = 2;
  State std = 3;
  Input input = 4;
}

message Plan {  // topic /plan, one a decision
  double time = 1;
  int64 k = 2;
  repeated Stage stages = 3;
  repeated double covariances = 4;  // (H + 1, n, n)
}

message QuadraticProgram {  // topic /qp; letters as in gpmpc.qp
  double time = 1;
  int64 k = 2;
  int64 variables = 3;
  int64 rows = 4;
  repeated double P = 5;
  repeated double q = 6;
  repeated double G = 7;
  repeated double lower = 8;
  repeated double upper = 9;
  repeated double softness = 10;
  repeated double x = 11;
  repeated double multipliers = 12;
}
"""

STEP = "/step"
PLAN = "/plan"
QP = "/qp"
TOPICS = {STEP: "Step", PLAN: "Plan", QP: "QuadraticProgram"}  # with their messages
LEVELS = ("", "healthy", "suspicious", "lost")  # of a judgement; empty without one

COMPLETE = "complete"  # outcome of a recording that no error ended
CONFIG_ATTACHMENT = "config.yaml"
CHANNELS_METADATA = "channels"  # topics by channel, for a run whose first chunk is lost
RECOVERY_METADATA = "recovered"  # of a file that holds what was left of another

_LARGEST = 1000  # states or inputs
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_BLOCK = re.compile(r"(enum|message) (\w+) \{([^}]*)\}")
_VALUE = re.compile(r"(\w+) = (\d+);")
_FIELD = re.compile(r"(repeated )?(\w+) (\w+) = (\d+);")


class Field(NamedTuple):
    """A field of a message."""

    name: str
    type: str  # such as "double" or "State"
    number: int
    is_repeated: bool


def check_names(kind: str, names: Sequence[str]) -> tuple[str, ...]:
    """Returns the names, if each can be a field of a message and none comes twice."""
    names = tuple(names)
    if not 1 <= len(names) <= _LARGEST:
        raise SettingError(kind, f"must be 1 to {_LARGEST} names; got {len(names)}")
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise SettingError(
                kind,
                f"a name must be letters, digits and _, a letter first; got {name!r}",
            )
    if len(set(names)) < len(names):
        raise SettingError(kind, f"a name must be unique; got {', '.join(names)}")
    return names


def proto_text(states: Sequence[str], inputs: Sequence[str]) -> str:
    """Returns the definitions with the names of the states and inputs."""
    statuses = [f"{status.name} = {i};" for i, status in enumerate(Status)]
    text = PROTO.replace("@STATUSES@", "\n  ".join(statuses))
    text = text.replace("@STATES@", _doubles(states))
    return text.replace("@INPUTS@", _doubles(inputs))


def _doubles(names: Sequence[str]) -> str:
    fields = [f"double {name} = {i};" for i, name in enumerate(names, start=1)]
    return "\n  ".join(fields)


@cache
def message_fields() -> dict[str, list[Field]]:
    """Returns the fields by message; State and Input have none without their names."""
    text = proto_text(states=(), inputs=())
    return {
        name: _parse_fields(body)
        for kind, name, body in _BLOCK.findall(_without_comments(text))
        if kind == "message"
    }


def _without_comments(text: str) -> str:
    return re.sub("//.*", "", text)


def _parse_fields(body: str) -> list[Field]:
    """Parses the fields of a message's body."""
    return [
        Field(name=name, type=kind, number=int(number), is_repeated=bool(repeated))
        for repeated, kind, name, number in _FIELD.findall(body)
    ]


def descriptor(
    states: Sequence[str], inputs: Sequence[str], arrays_as_bytes: bool = False
) -> FileDescriptorProto:
    """Describes all messages.

    Args:
        states: Names of the states.
        inputs: Names of the inputs.
        arrays_as_bytes: Whether arrays are ``bytes``, as the package itself reads and
            writes them, in place of ``repeated double``.
    """
    file = FileDescriptorProto(
        name="gpmpc/recording.proto", package="gpmpc", syntax="proto3"
    )
    text = _without_comments(proto_text(states, inputs))
    enums = {name for kind, name, _ in _BLOCK.findall(text) if kind == "enum"}
    for kind, name, body in _BLOCK.findall(text):
        if kind == "enum":
            _add_values(file.enum_type.add(name=name), body)
            continue
        message = file.message_type.add(name=name)
        for field in _parse_fields(body):
            if arrays_as_bytes and field.is_repeated and field.type == "double":
                field = field._replace(type="bytes", is_repeated=False)
            _describe(field, message.field.add(), enums)
    return file


def _add_values(enum: EnumDescriptorProto, body: str) -> None:
    for name, number in _VALUE.findall(body):
        enum.value.add(name=name, number=int(number))


def _describe(field: Field, described: FieldDescriptorProto, enums: set[str]) -> None:
    """Fills the descriptor of a field."""
    described.name = field.name
    described.number = field.number
    described.label = FieldDescriptorProto.LABEL_OPTIONAL
    if field.is_repeated:
        described.label = FieldDescriptorProto.LABEL_REPEATED
    kind = field.type
    if kind[0].isupper():  # it is defined in the file
        described.type_name = f".gpmpc.{kind}"
        kind = "enum" if kind in enums else "message"
    described.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")


def names_in(schema: bytes) -> list[list[str]] | None:
    """Reads the names of states and inputs out of the schema of a step.

    Returns:
        Both; None where it is no such schema.
    """
    files = FileDescriptorSet()
    try:
        files.ParseFromString(schema)
    except DecodeError:
        return None
    fields = {
        message.name: [field.name for field in message.field]
        for file in files.file
        for message in file.message_type
    }
    states = fields.get("State")
    inputs = fields.get("Input")
    return [states, inputs] if states and inputs else None


def message_classes(file: FileDescriptorProto) -> dict[str, Any]:
    """Builds the message classes by their short name."""
    pool = DescriptorPool()
    try:
        pool.Add(file)
    except TypeError as error:
        raise SettingError(
            "state_names", f"and input_names cannot be fields of a message: {error}"
        ) from error
    return {
        message.name: GetMessageClass(
            pool.FindMessageTypeByName(f"gpmpc.{message.name}")
        )
        for message in file.message_type
    }
