"""Problem: a recording has to explain itself to any MCAP reader, with a named field for everything people plot.

The messages depend on the plant: its states and inputs become scalar fields with its own names (``state.x``,
``input.U1``), because a plot tool draws an array as one line. Their protobuf descriptors are therefore built at run
time, under the full names ``gpmpc.Step``, ``gpmpc.Plan`` and ``gpmpc.QuadraticProgram``, and travel in the file.

A descriptor loses comments, so units and frames stand in the file's metadata records ``units`` (by field path, such as
``state.x``: ``m``) and ``frames``, written before any message; every MCAP tool shows them, and recovery keeps them.

Large arrays are packed ``repeated double``. Their wire format is the one of ``bytes`` that hold the little-endian
float64 values, so the reader uses a twin of each schema with ``bytes`` in their place (``READ``): a thousand numbers
then cost one copy. Likewise a nested message is ``bytes`` that hold it serialised, and in the writer's twin
(``WRITTEN``) these come from ``encoding``.
"""

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from gpmpc.exceptions import SettingError
from gpmpc.status import Status

STEP, PLAN, QP = "gpmpc.Step", "gpmpc.Plan", "gpmpc.QuadraticProgram"
STATE, INPUT, TIMINGS, RESIDUES, STAGE = "gpmpc.State", "gpmpc.Input", "gpmpc.Timing", "gpmpc.Residuals", "gpmpc.Stage"

_SCALARS = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "int64": FieldDescriptorProto.TYPE_INT64,
    "bool": FieldDescriptorProto.TYPE_BOOL,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
}
TIMING = ("model", "build", "solve", "total")
RESIDUALS = ("primal", "dual", "gap")
READ = {"doubles": "bytes"}
WRITTEN = READ | dict.fromkeys(("State", "Input", "Timing", "Residuals"), "bytes") | {"Stages": "list of bytes"}
LARGEST = 1000  # states or inputs; a covariance of more would not fit into a step
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def check_names(kind: str, names: Sequence[str]) -> tuple[str, ...]:
    """The names, if each can be a field of a message and none comes twice.

    Raises:
        SettingError: They cannot.
    """
    names = tuple(names)
    if not 1 <= len(names) <= LARGEST:
        raise SettingError(kind, f"must be 1 to {LARGEST} names; got {len(names)}")
    for name in names:
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise SettingError(kind, f"a name must be letters, digits and _, a letter first; got {name!r}")
        if names.count(name) > 1:
            raise SettingError(kind, f"a name must be unique; {name!r} comes {names.count(name)} times")
    return names


def message_classes(
    state_names: Sequence[str], input_names: Sequence[str], twin: Mapping[str, str] = MappingProxyType({})
) -> dict[str, type]:
    """The classes of all messages by full name.

    Args:
        state_names: Names of the n states.
        input_names: Names of the m inputs.
        twin: Kinds of fields in place of those that a file declares, with the same wire format: ``READ``, ``WRITTEN``.

    Raises:
        SettingError: Two names are one to protobuf.
    """
    file = FileDescriptorProto(name="gpmpc/recording.proto", package="gpmpc", syntax="proto3")
    status = file.enum_type.add(name="Status")
    for number, value in enumerate(Status):
        status.value.add(name=value.name, number=number)

    def add(name: str, fields: dict[str, str]) -> None:
        _message(file, name, {field: twin.get(kind, kind) for field, kind in fields.items()})

    add("State", dict.fromkeys(state_names, "double"))
    add("Input", dict.fromkeys(input_names, "double"))
    add("Timing", dict.fromkeys(TIMING, "double"))
    add("Residuals", dict.fromkeys(RESIDUALS, "double"))
    add(
        "Step",
        {
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
            "belief_covariance": "doubles",
            "status": "Status",
            "iterations": "int64",
            "active_set_size": "int64",
            "timing": "Timing",
            "residuals": "Residuals",
            "gp_size": "int64",
            "gp_version": "int64",
            "failed": "bool",
        },
    )
    add("Stage", {"time": "double", "mean": "State", "std": "State", "input": "Input"})
    add("Plan", {"time": "double", "k": "int64", "stages": "Stages", "covariances": "doubles"})
    arrays = dict.fromkeys(("P", "q", "G", "lower", "upper", "softness", "x", "multipliers"), "doubles")
    add("QuadraticProgram", {"time": "double", "k": "int64", "variables": "int64", "rows": "int64"} | arrays)
    pool = DescriptorPool()
    try:
        pool.Add(file)
    except TypeError as error:  # two names that are one to protobuf, such as x_1 and x1
        raise SettingError("state_names", f"and input_names cannot be fields of a message: {error}") from error
    return {
        name: GetMessageClass(pool.FindMessageTypeByName(name))
        for name in (STEP, PLAN, QP, STATE, INPUT, TIMINGS, RESIDUES, STAGE)
    }


def units_by_field(units: dict[str, str], state_names: Sequence[str], input_names: Sequence[str]) -> dict[str, str]:
    """The unit of every scalar field by its path: of ``gpmpc.Step``, and of ``gpmpc.Plan`` after ``stages``.

    Args:
        units: By name of state or input; a name without unit gets "?".
        state_names: Names of the n states.
        input_names: Names of the m inputs.

    Raises:
        SettingError: A unit for a name that is neither.
    """
    unknown = set(units) - set(state_names) - set(input_names)
    if unknown:
        known = ", ".join([*state_names, *input_names])
        raise SettingError("units", f"must be of {known}; got {', '.join(sorted(unknown))}")
    fields = {"time": "s", "stages.time": "s"}
    for group in ("reference", "state", "measured", "innovation", "belief_std", "stages.mean", "stages.std"):
        fields |= {f"{group}.{name}": units.get(name, "?") for name in state_names}
    for group in ("input", "input_lower", "input_upper", "stages.input"):
        fields |= {f"{group}.{name}": units.get(name, "?") for name in input_names}
    return fields | {f"timing.{name}": "s" for name in TIMING} | {f"residuals.{name}": "1" for name in RESIDUALS}


def _message(file: FileDescriptorProto, name: str, fields: dict[str, str]) -> None:
    message: DescriptorProto = file.message_type.add(name=name)
    for number, (field, kind) in enumerate(fields.items(), start=1):
        added = message.field.add(name=field, number=number, label=FieldDescriptorProto.LABEL_OPTIONAL)
        if kind == "doubles":
            added.type, added.label = FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.LABEL_REPEATED
        elif kind in _SCALARS:
            added.type = _SCALARS[kind]
        elif kind == "Status":
            added.type, added.type_name = FieldDescriptorProto.TYPE_ENUM, ".gpmpc.Status"
        elif kind == "list of bytes":
            added.type, added.label = FieldDescriptorProto.TYPE_BYTES, FieldDescriptorProto.LABEL_REPEATED
        elif kind == "Stages":
            added.label = FieldDescriptorProto.LABEL_REPEATED
            added.type, added.type_name = FieldDescriptorProto.TYPE_MESSAGE, ".gpmpc.Stage"
        else:
            added.type, added.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".gpmpc.{kind}"
