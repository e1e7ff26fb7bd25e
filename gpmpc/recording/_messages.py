"""Defines the protobuf messages of a recording.

States and inputs become scalar fields with the plant's own names (``state.x``, ``input.U1``), because a plot tool draws
an array as one line. The descriptors are therefore built at run time and travel in the file. A descriptor loses
comments, so units stand in the file's metadata record ``units``, by field path.

Packed ``repeated double`` has the wire format of ``bytes`` that hold the little-endian float64 values. The package
reads and writes its messages with ``bytes`` in these places: a thousand numbers then cost one copy.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.status import Status

if TYPE_CHECKING:
    from gpmpc.systems import System

STEP, PLAN, QP = "/step", "/plan", "/qp"
TOPICS = {STEP: "Step", PLAN: "Plan", QP: "QuadraticProgram"}
TIMING = ("model", "build", "solve", "total")
POSITION, ATTITUDE = ("x", "y", "z"), ("roll", "pitch", "yaw")
QP_ARRAYS = ("P", "q", "G", "lower", "upper", "softness", "x", "multipliers")

_FIELDS = {
    "Step": {
        "time": "double",
        "k": "int64",
        "reference": "State",
        "state": "State",
        "measured": "State",
        "input": "Input",
        "input_lower": "Input",
        "input_upper": "Input",
        "innovation": "State",
        "belief_std": "State",
        "belief_covariance": "repeated double",
        "status": "Status",
        "iterations": "int64",
        "active_set_size": "int64",
        "timing": "Timing",
        "residuals": "",  # of the first edition; the reader computes them
        "gp_size": "int64",
        "gp_version": "int64",
        "failed": "bool",
        "novelty": "double",
    },
    "Stage": {"time": "double", "mean": "State", "std": "State", "input": "Input"},
    "Plan": {"time": "double", "k": "int64", "stages": "repeated Stage", "covariances": "repeated double"},
    "QuadraticProgram": {"time": "double", "k": "int64", "variables": "int64", "rows": "int64"}
    | dict.fromkeys(QP_ARRAYS, "repeated double"),
}
_LARGEST = 1000  # states or inputs
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class RecordedSystem:
    """Describes the system whose steps are recorded."""

    state_names: Sequence[str]  # names of the n states; they become field names
    input_names: Sequence[str]  # names of the m inputs
    time_step: float  # of the plant [s]; it dates the stages of a plan
    units: Mapping[str, str] = field(default_factory=dict)  # by name of state or input, such as ``{"x": "m"}``
    input_bounds: Any = None  # lower and upper bounds of the input (2, m), repeated in every step for plots
    # states of position and attitude (Rz(yaw) Ry(pitch) Rx(roll)) in space, by x, y, z, roll, pitch, yaw
    pose: Mapping[str, str] = field(default_factory=dict)
    z_down: bool = True  # whether the z axis of positions points downwards, as the quadrotor's does

    def __post_init__(self) -> None:
        for key in ("state_names", "input_names"):
            object.__setattr__(self, key, check_names(key, getattr(self, key)))
        check_number("time_step", self.time_step, above=0, unit="[s]")
        if self.input_bounds is not None and np.shape(self.input_bounds) != (2, len(self.input_names)):
            raise ShapeError(f"input bounds must be (2, {len(self.input_names)}); got {np.shape(self.input_bounds)}")
        states, inputs = self.state_names, self.input_names
        for key, given, names in (
            ("units", self.units, (*states, *inputs)),
            ("pose", self.pose, POSITION + ATTITUDE),
            ("pose", self.pose.values(), states),
        ):
            if unknown := sorted({*given} - {*names}):
                raise SettingError(key, f"must be of {', '.join(names)}; got {', '.join(unknown)}")

    @classmethod
    def of(cls, system: "System", input_bounds: Any = None) -> "RecordedSystem":
        """Describes a system by its own names, units and pose, with its limits where no other bounds are given."""
        bounds = [system.input_lower, system.input_upper] if input_bounds is None else input_bounds
        names = system.state_names, system.input_names, system.time_step, system.units
        return cls(*names, input_bounds=bounds, pose=system.pose, z_down=system.z_down)

    @property
    def field_units(self) -> dict[str, str]:
        """Units of the scalar fields by path, of ``Step`` and, after ``stages``, of ``Plan``; unknown ones are "?"."""
        found = {"time": "s", "stages.time": "s"} | {f"timing.{name}": "s" for name in TIMING}
        for message, prefix in (("Step", ""), ("Stage", "stages.")):
            for key, kind in _FIELDS[message].items():
                names = {"State": self.state_names, "Input": self.input_names}.get(kind, ())
                found |= {f"{prefix}{key}.{name}": self.units.get(name, "?") for name in names}
        return found


def check_names(kind: str, names: Sequence[str]) -> tuple[str, ...]:
    """Returns the names, if each can be a field of a message and none comes twice."""
    names = tuple(names)
    if not 1 <= len(names) <= _LARGEST:
        raise SettingError(kind, f"must be 1 to {_LARGEST} names; got {len(names)}")
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise SettingError(kind, f"a name must be letters, digits and _, a letter first; got {name!r}")
    if len(set(names)) < len(names):
        raise SettingError(kind, f"a name must be unique; got {', '.join(names)}")
    return names


def descriptor(states: Sequence[str], inputs: Sequence[str], packed: str = "repeated double") -> FileDescriptorProto:
    """Describes all messages.

    Args:
        states: Names of the n states.
        inputs: Names of the m inputs.
        packed: Kind of the arrays: "repeated double", or "bytes" for the package itself.
    """
    file = FileDescriptorProto(name="gpmpc/recording.proto", package="gpmpc", syntax="proto3")
    status = file.enum_type.add(name="Status")
    for number, value in enumerate(Status):
        status.value.add(name=value.name, number=number)
    groups = {"State": states, "Input": inputs, "Timing": TIMING}
    for name, fields in ({k: dict.fromkeys(v, "double") for k, v in groups.items()} | _FIELDS).items():
        message = file.message_type.add(name=name)
        for number, (key, kind) in enumerate(fields.items(), start=1):
            *repeated, kind = (packed if kind == "repeated double" else kind or "none").split()
            if kind == "none":
                continue
            label = FieldDescriptorProto.LABEL_REPEATED if repeated else FieldDescriptorProto.LABEL_OPTIONAL
            added = message.field.add(name=key, number=number, label=label)
            if kind in groups or kind in _FIELDS or kind == "Status":
                added.type_name = f".gpmpc.{kind}"
                kind = "enum" if kind == "Status" else "message"
            added.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
    return file


def message_classes(file: FileDescriptorProto) -> dict[str, Any]:
    """Builds the message classes by their short name."""
    pool = DescriptorPool()
    try:
        pool.Add(file)
    except TypeError as error:
        raise SettingError("state_names", f"and input_names cannot be fields of a message: {error}") from error
    return {m.name: GetMessageClass(pool.FindMessageTypeByName(f"gpmpc.{m.name}")) for m in file.message_type}
