"""Defines the protobuf messages of a recording; copies steps as they are recorded, and serialises the copies later.

States and inputs become scalar fields with the plant's own names (``state.x``, ``input.U1``), because a plot tool draws
an array as one line. The descriptors are therefore built at run time and travel in the file. A descriptor loses
comments, so units stand in the file's metadata record ``units``, by field path.

Packed ``repeated double`` has the wire format of ``bytes`` that hold the little-endian float64 values. The package
reads and writes its messages with ``bytes`` in these places: a thousand numbers then cost one copy.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import foxglove
import numpy as np
from google.protobuf.descriptor_pb2 import (
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.status import Status
from gpmpc.step import Step

if TYPE_CHECKING:
    from gpmpc.systems import System


STEP = "/step"
PLAN = "/plan"
QP = "/qp"
TOPICS = {STEP: "Step", PLAN: "Plan", QP: "QuadraticProgram"}
TIMING = ("model", "build", "solve", "total")
RESIDUALS = ("primal", "dual", "gap")
POSITION = ("x", "y", "z")
ATTITUDE = ("roll", "pitch", "yaw")
QP_ARRAYS = ("P", "q", "G", "lower", "upper", "softness", "x", "multipliers")

FIELDS = {
    "Step": {"time": "double", "k": "int64"}
    | dict.fromkeys(("reference", "state", "measured"), "State")
    | dict.fromkeys(("input", "input_lower", "input_upper"), "Input")
    | dict.fromkeys(("innovation", "belief_std"), "State")
    | {"belief_covariance": "repeated double", "status": "Status"}
    | {"iterations": "int64", "active_set_size": "int64", "timing": "Timing"}
    | {"residuals": ""}  # of the first edition; the reader computes them
    | {
        "gp_size": "int64",
        "gp_version": "int64",
        "failed": "bool",
        "novelty": "double",
        "judgement": "string",
        "reason": "string",
    },
    "Stage": {"time": "double", "mean": "State", "std": "State", "input": "Input"},
    "Plan": {
        "time": "double",
        "k": "int64",
        "stages": "repeated Stage",
        "covariances": "repeated double",
    },
    "QuadraticProgram": {
        "time": "double",
        "k": "int64",
        "variables": "int64",
        "rows": "int64",
    }
    | dict.fromkeys(QP_ARRAYS, "repeated double"),
}
LEVELS = (
    "",
    "healthy",
    "suspicious",
    "lost",
)  # of a judgement, empty where there is none
_LARGEST = 1000  # states or inputs
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_STATES = ("reference", "state", "measured", "innovation")  # arrays (n,) of a step


@dataclass(frozen=True)
class RecordedSystem:
    """Describes the system whose steps are recorded."""

    state_names: Sequence[str]  # names of the n states; they become field names
    input_names: Sequence[str]  # names of the m inputs
    time_step: float  # of the plant [s]; it dates the stages of a plan
    units: Mapping[str, str] = field(
        default_factory=dict
    )  # by name of state or input, such as ``{"x": "m"}``
    input_bounds: Any = None  # lower and upper bounds of the input (2, m), repeated in every step for plots
    # states of position and attitude (Rz(yaw) Ry(pitch) Rx(roll)) in space, by x, y, z, roll, pitch, yaw
    pose: Mapping[str, str] = field(default_factory=dict)
    z_down: bool = True  # whether the z axis of positions points downwards, as the quadrotor's does

    def __post_init__(self) -> None:
        for key in ("state_names", "input_names"):
            object.__setattr__(self, key, check_names(key, getattr(self, key)))
        check_number("time_step", self.time_step, above=0, unit="[s]")
        if self.input_bounds is not None and np.shape(self.input_bounds) != (
            2,
            len(self.input_names),
        ):
            raise ShapeError(
                f"input bounds must be (2, {len(self.input_names)}); got {np.shape(self.input_bounds)}"
            )
        states = self.state_names
        inputs = self.input_names
        for key, given, names in (
            ("units", self.units, (*states, *inputs)),
            ("pose", self.pose, POSITION + ATTITUDE),
            ("pose", self.pose.values(), states),
        ):
            if unknown := sorted({*given} - {*names}):
                raise SettingError(
                    key, f"must be of {', '.join(names)}; got {', '.join(unknown)}"
                )

    @classmethod
    def of(cls, system: "System", input_bounds: Any = None) -> "RecordedSystem":
        """Describes a system by its own names, units and pose, with its limits where no other bounds are given."""
        bounds = (
            [system.input_lower, system.input_upper]
            if input_bounds is None
            else input_bounds
        )
        names = system.state_names, system.input_names, system.time_step, system.units
        return cls(*names, input_bounds=bounds, pose=system.pose, z_down=system.z_down)

    @property
    def field_units(self) -> dict[str, str]:
        """Units of the scalar fields by path, of ``Step`` and, after ``stages``, of ``Plan``; unknown ones are "?"."""
        found = {"time": "s", "stages.time": "s"} | {
            f"timing.{name}": "s" for name in TIMING
        }
        for message, prefix in (("Step", ""), ("Stage", "stages.")):
            for key, kind in FIELDS[message].items():
                names = {"State": self.state_names, "Input": self.input_names}.get(
                    kind, ()
                )
                found |= {
                    f"{prefix}{key}.{name}": self.units.get(name, "?") for name in names
                }
        return found


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


def descriptor(
    states: Sequence[str], inputs: Sequence[str], packed: str = "repeated double"
) -> FileDescriptorProto:
    """Describes all messages; arrays are of the kind "repeated double", or "bytes" for the package itself."""
    file = FileDescriptorProto(
        name="gpmpc/recording.proto", package="gpmpc", syntax="proto3"
    )
    status = file.enum_type.add(name="Status")
    for number, value in enumerate(Status):
        status.value.add(name=value.name, number=number)
    groups = {"State": states, "Input": inputs, "Timing": TIMING}
    for name, fields in (
        {k: dict.fromkeys(v, "double") for k, v in groups.items()} | FIELDS
    ).items():
        message = file.message_type.add(name=name)
        for number, (key, kind) in enumerate(fields.items(), start=1):
            *repeated, kind = (
                packed if kind == "repeated double" else kind or "none"
            ).split()
            if kind == "none":
                continue
            label = (
                FieldDescriptorProto.LABEL_REPEATED
                if repeated
                else FieldDescriptorProto.LABEL_OPTIONAL
            )
            added = message.field.add(name=key, number=number, label=label)
            if kind in groups or kind in FIELDS or kind == "Status":
                added.type_name = f".gpmpc.{kind}"
                kind = "enum" if kind == "Status" else "message"
            added.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
    return file


def names_in(schema: bytes) -> list[list[str]] | None:
    """Reads the names of states and inputs out of the schema of a step.

    None where it is no such schema.
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
    names = [fields.get("State"), fields.get("Input")]
    return [group for group in names if group] if all(names) else None


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
        m.name: GetMessageClass(pool.FindMessageTypeByName(f"gpmpc.{m.name}"))
        for m in file.message_type
    }


Array = np.ndarray
_NUMBERS = {status: number for number, status in enumerate(Status)}


class StepCopy:
    """A step with copies of its arrays in one piece of memory: those of ``step`` itself may have changed since.

    ``ShapeError`` where an array does not fit n states and m inputs.
    """

    def __init__(self, step: Step, n: int, m: int, record_problem: bool):
        decision = step.decision
        arrays: dict[str, Any] = {
            name: getattr(step, name)
            for name in (*_STATES, "input", "belief_covariance")
        }
        shapes: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(_STATES, (n,)),
            "input": (m,),
            "belief_covariance": (n, n),
        }
        if decision is not None:
            H = len(decision.inputs)
            solution = decision.solution
            program = decision.problem
            arrays |= {
                name: getattr(decision, name)
                for name in ("inputs", "means", "covariances")
            }
            shapes |= {
                "inputs": (H, m),
                "means": (H + 1, n),
                "covariances": (H + 1, n, n),
            }
            if solution is not None:
                arrays |= {"x": solution.x, "record": solution.record}
            if record_problem and solution is not None:
                arrays |= {
                    **dict(zip(QP_ARRAYS, solution.arrays, strict=False)),
                    "caps": solution.caps,
                }
            elif record_problem and program is not None:
                arrays |= {name: getattr(program, name) for name in QP_ARRAYS[:5]}
                arrays["caps"] = np.full(len(program.lower), np.inf)
        self.step = step
        arrays = {
            name: np.ascontiguousarray(array, dtype=float)
            for name, array in arrays.items()
        }
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise ShapeError(
                    f"step {step.k}: {name} must be {shape}; got {arrays[name].shape}"
                )
        self.data = b"".join(arrays.values())
        self._shapes = {name: array.shape for name, array in arrays.items()}

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Views of the copy by name: of the step, and where there are any of its plan, solution and program."""
        ends = np.cumsum([math.prod(shape) for shape in self._shapes.values()])
        parts = np.split(np.frombuffer(self.data), ends[:-1])
        return {
            name: part.reshape(shape)
            for part, (name, shape) in zip(parts, self._shapes.items(), strict=True)
        }

    @property
    def status(self) -> Status:
        """How the solve ended."""
        decision = self.step.decision
        return (
            self.step.status
            or (decision and decision.status)
            or Status.INVALID_MEASUREMENT
        )


class Encoder:
    """Serialises steps of a system as messages."""

    def __init__(self, system: RecordedSystem):
        self._states = system.state_names
        self._inputs = system.input_names
        self._time_step = system.time_step
        self._schema = FileDescriptorSet(
            file=[descriptor(self._states, self._inputs)]
        ).SerializeToString()
        own = message_classes(descriptor(self._states, self._inputs, "bytes"))
        self._step, self._plan, self._qp = (
            own[TOPICS[topic]] for topic in (STEP, PLAN, QP)
        )
        bounds = (
            ()
            if system.input_bounds is None
            else np.array(system.input_bounds, dtype=float)
        )
        self._bounds = {
            f"input_{side}": self._input(b)
            for side, b in zip(("lower", "upper"), bounds, strict=False)
        }

    def channels(self, context: foxglove.Context) -> dict[str, foxglove.Channel]:
        """Opens the channels by topic."""
        found = {}
        for topic, name in TOPICS.items():
            schema = foxglove.Schema(
                name=f"gpmpc.{name}", encoding="protobuf", data=self._schema
            )
            found[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="protobuf", context=context
            )
        return found

    def encode(self, copy: StepCopy) -> Iterator[tuple[str, bytes]]:
        """Yields topics and messages of a step."""
        step = copy.step
        decision = copy.step.decision
        arrays = copy.arrays
        head = {"time": step.time, "k": step.k}
        solution = None if decision is None else decision.solution
        if solution is not None:
            solution = solution._replace(x=arrays["x"], record=arrays["record"])
        timing = None if decision is None else decision.timing
        times = (
            (0.0, 0.0, 0.0)
            if timing is None
            else (timing.model, timing.build, timing.solve)
        )
        message = self._step(
            **head,
            **{name: self._state(arrays[name]) for name in _STATES},
            belief_std=self._state(deviations(arrays["belief_covariance"])),
            input=self._input(arrays["input"]),
            belief_covariance=arrays["belief_covariance"].tobytes(),
            status=_NUMBERS[copy.status],
            iterations=0 if decision is None else decision.iterations,
            active_set_size=0
            if solution is None
            else np.count_nonzero(solution.active_set),
            timing=dict(zip(TIMING, (*times, sum(times)), strict=True)),
            gp_size=step.gp_size,
            gp_version=step.gp_version,
            failed=step.failed,
            novelty=np.nan if decision is None else decision.novelty,
            judgement="" if step.judgement is None else step.judgement.level,
            reason="" if step.judgement is None else step.judgement.reason,
            **self._bounds,
        )
        yield STEP, message.SerializeToString()
        if decision is not None:
            means = arrays["means"]
            stds = deviations(arrays["covariances"])
            plan = self._plan(covariances=arrays["covariances"].tobytes(), **head)
            inputs = [
                *({"input": self._input(values)} for values in arrays["inputs"]),
                {},
            ]  # none at the last stage
            for i, (mean, std, given) in enumerate(
                zip(means, stds, inputs, strict=True)
            ):
                time = step.time + self._time_step * i
                plan.stages.add(
                    time=time, mean=self._state(mean), std=self._state(std), **given
                )
            yield PLAN, plan.SerializeToString()
        if "P" in arrays:
            caps = arrays["caps"]
            found = arrays | {"softness": np.stack([np.zeros_like(caps), caps])}
            if solution is not None:
                found["multipliers"] = solution.multipliers
            program = {
                name: found[name].tobytes() for name in QP_ARRAYS if name in found
            }
            size = {"variables": len(arrays["q"]), "rows": len(arrays["G"])}
            yield QP, self._qp(**size, **program, **head).SerializeToString()

    def _state(self, values: Array) -> dict[str, float]:
        return dict(zip(self._states, values.tolist(), strict=True))

    def _input(self, values: Array) -> dict[str, float]:
        return dict(zip(self._inputs, values.tolist(), strict=True))


def deviations(covariances: Array) -> Array:
    """Returns the standard deviations (..., n) of covariances (..., n, n)."""
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0))
