"""Says what the columns or topics of a log mean: states, inputs and context, with units, frames and conventions.

A mapping is a YAML file or a dictionary:

    rate: 100                       # [Hz] rows are resampled to it; without it rows stay as they are
    time: {column: t, unit: s}
    run: flight                     # a column that names the runs; without it a file is a run
    max_gap: 0.03                   # [s] no value is carried over a longer gap
    keep: {pz: [0.2, null]}         # only rows whose column lies in this range
    states:
      position: {columns: [px, py, pz], unit: m}
      attitude: {columns: [qx, qy, qz, qw], kind: quaternion, order: xyzw}
      velocity: {columns: [vx, vy, vz], unit: m/s, frame: world}
      rate: {columns: [wx, wy, wz], unit: rad/s, frame: body}
    inputs:
      motors: {columns: [m1, m2, m3, m4], scale: 1.5e-5}
    context:                        # known where a prediction begins, held through it
      battery: {columns: [vbat], unit: V}

States come out in m, rad, s, kg and their products. A signal of a bag or a PX4 log has ``topic`` besides.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from gpmpc.exceptions import SettingError, check_number
from gpmpc.logs._kinematics import StateGroup, StateSpace

Role = Literal["states", "inputs", "context"]
ROLES: tuple[Role, ...] = ("states", "inputs", "context")
KINDS = ("vector", "angle", "quaternion", "euler")
DEGREE = float(np.pi / 180)
UNITS = {  # what one of it is in the units that states come out in
    "deg": ("rad", DEGREE),
    "deg/s": ("rad/s", DEGREE),
    "rpm": ("rad/s", float(np.pi / 30)),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "km": ("m", 1e3),
    "mm/s": ("m/s", 1e-3),
    "cm/s": ("m/s", 1e-2),
    "km/h": ("m/s", 1 / 3.6),
    "g": ("m/s2", 9.80665),
    "mV": ("V", 1e-3),
}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_KEYS = ("time", "run", "rate", "max_gap", "keep", "held", "rest", *ROLES, "model")
_SIGNAL_KEYS = ("columns", "unit", "kind", "order", "frame", "scale", "resample", "topic")


@dataclass(frozen=True)
class Signal:
    """Columns of a log that belong together."""

    name: str  #: such as "attitude"
    role: Role  #: states, inputs or context
    columns: tuple[str, ...]  #: as they are called in the file
    unit: str = ""  #: of the columns in the file
    #: A vector, angles, a quaternion, or Euler angles (roll, pitch, yaw; they become a quaternion).
    kind: str = "vector"
    order: str = "xyzw"  #: of a quaternion: "xyzw" or "wxyz"
    frame: str = ""  #: "world" or "body", for velocities and rates of a rigid body; empty where it has none
    scale: float = 1.0  #: the values are multiplied by it
    resample: str = ""  #: "hold", "linear" or "spherical"; by default states are interpolated and all else is held
    topic: str = ""  #: the stream that holds the columns; empty where a file has one

    def __post_init__(self) -> None:
        key = f"{self.role}.{self.name}"
        if not self.columns or not all(isinstance(column, str) for column in self.columns):
            raise SettingError(f"{key}.columns", f"must be a list of column names; got {list(self.columns)}")
        turned = self.kind in ("quaternion", "euler")
        rules = ("hold", "spherical") if turned else ("hold", "linear")
        for name, value, known in (
            ("kind", self.kind, KINDS),
            ("order", self.order, ("xyzw", "wxyz")),
            ("frame", self.frame, ("", "world", "body")),
            ("resample", self.resample, ("", *rules)),
        ):
            if value not in known:
                raise SettingError(f"{key}.{name}", f"must be one of {', '.join(filter(None, known))}; got {value!r}")
        wanted = {"quaternion": 4, "euler": 3}.get(self.kind, len(self.columns))
        if len(self.columns) != wanted:
            raise SettingError(f"{key}.columns", f"must be {wanted} of a {self.kind}; got {list(self.columns)}")
        check_number(f"{key}.scale", self.scale)
        if self.kind in ("angle", "euler") and self.unit not in ("rad", "deg"):
            raise SettingError(f"{key}.unit", f"must be rad or deg of angles; got {self.unit!r}")

    @property
    def rule(self) -> str:
        """How it is resampled."""
        usual = "hold" if self.role != "states" else "spherical" if self.kind in ("quaternion", "euler") else "linear"
        return self.resample or usual

    @property
    def group(self) -> StateGroup:
        """As it comes out."""
        if self.kind in ("quaternion", "euler"):
            return StateGroup(self.name, tuple(f"{self.name}_{axis}" for axis in "xyzw"), "", "quaternion")
        unit = UNITS.get(self.unit, (self.unit, 1.0))[0]
        return StateGroup(self.name, self.columns, unit, "angle" if self.kind == "angle" else "vector")


@dataclass(frozen=True)
class LogMapping:
    """What a log's columns mean, and how its rows are read; see the head of this file."""

    signals: tuple[Signal, ...]  #: states, inputs and context, in this order
    time: str = ""  #: column of the stamps; empty takes the stamps of the messages
    time_unit: str = "s"  #: of that column
    run: str = ""  #: column that names the runs
    rate: float | None = None  #: to which rows are resampled [Hz]; None leaves them as they are
    max_gap: float | None = None  #: no value is carried over a longer gap [s]; 1.5 time steps by default
    #: ranges (lowest, highest) of columns; rows outside are left out.
    keep: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: "drop" leaves out rows in which a state's whole signal repeats the row before; "use" takes them.
    held: str = "drop"
    rest: str = "drop"  #: "drop" leaves out parts in which nothing moves; "use" takes them
    model: str = "none"  #: what is known of the system: "rigid_body" or "none"

    def __post_init__(self) -> None:
        for key in ("rate", "max_gap"):
            if getattr(self, key) is not None:
                check_number(key, getattr(self, key), above=0)
        for key, known in (("held", ("drop", "use")), ("rest", ("drop", "use")), ("model", ("rigid_body", "none"))):
            if getattr(self, key) not in known:
                raise SettingError(key, f"must be one of {', '.join(known)}; got {getattr(self, key)!r}")
        if self.time_unit not in TIME_UNITS:
            raise SettingError("time.unit", f"must be one of {', '.join(TIME_UNITS)}; got {self.time_unit!r}")
        if not self.of("states"):
            raise SettingError("states", "must name at least one signal; got none")
        if len({signal.topic for signal in self.signals}) > 1 and self.rate is None:
            raise SettingError("rate", "must be given where signals come from several topics; got none")

    def of(self, role: Role) -> tuple[Signal, ...]:
        """The signals of one role."""
        return tuple(signal for signal in self.signals if signal.role == role)

    def entries(self, role: Role) -> tuple[str, ...]:
        """Names of the entries of one role, as they come out."""
        return tuple(entry for signal in self.of(role) for entry in signal.group.entries)

    def column_names(self, role: Role) -> tuple[str, ...]:
        """The columns of one role in the order that they come out in, with what was done to their values."""
        found = []
        for signal in self.of(role):
            turned = signal.kind == "euler"
            names = signal.group.entries if turned else signal.columns
            if signal.kind == "quaternion" and signal.order == "wxyz":
                names = (*names[1:], names[0])
            factor = signal.scale * UNITS.get(signal.unit, ("", 1.0))[1]
            turned_frame = {"m/s": "body", "rad/s": "world"}.get(signal.group.unit)
            other = self.model == "rigid_body" and signal.frame == turned_frame
            done = f" times {factor:.6g}" * (factor != 1 and not turned) + " in other axes" * other
            found += [f"{name}{done}" for name in names]
        return tuple(found)

    @property
    def space(self) -> StateSpace:
        """The space of the states."""
        return StateSpace(tuple(signal.group for signal in self.of("states")))

    @classmethod
    def load(cls, path: str | Path) -> "LogMapping":
        """Reads a YAML file; ``SettingError`` where that fails, or a key or value is wrong."""
        try:
            content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise SettingError("mapping", f"{path} cannot be read ({' '.join(str(error).split())})") from error
        return cls.from_dict(content)

    @classmethod
    def from_dict(cls, content: Any) -> "LogMapping":
        """Makes one of plain data, as a YAML file holds them; ``SettingError`` where a key or value is wrong."""
        _check_keys("mapping", content, _KEYS)
        signals = []
        for role in ROLES:
            _check_keys(role, content.get(role) or {}, None)
            for name, given in (content.get(role) or {}).items():
                given = {"columns": given} if isinstance(given, Sequence) else given
                _check_keys(f"{role}.{name}", given, _SIGNAL_KEYS)
                columns = given.get("columns", ())
                columns = (columns,) if isinstance(columns, str) else tuple(columns or ())
                signals.append(Signal(str(name), role, **{**given, "columns": columns}))
        time = content.get("time") or {}
        time = {"column": time} if isinstance(time, str) else time
        _check_keys("time", time, ("column", "unit"))
        keep = {}
        for column, limits in (content.get("keep") or {}).items():
            if not isinstance(limits, list) or len(limits) != 2:
                raise SettingError(f"keep.{column}", f"must be [lowest, highest]; got {limits!r}")
            low, high = (default if x is None else x for x, default in zip(limits, (-np.inf, np.inf), strict=True))
            keep[column] = (float(low), float(high))
        rest = {key: content[key] for key in ("run", "rate", "max_gap", "held", "rest", "model") if key in content}
        return cls(tuple(signals), time.get("column", ""), time.get("unit", "s"), keep=keep, **rest)


def _check_keys(key: str, given: Any, known: Sequence[str] | None) -> None:
    if not isinstance(given, Mapping):
        raise SettingError(key, f"must be keys and values; got {given!r}")
    unknown = [name for name in given if known is not None and name not in known]
    if unknown:
        raise SettingError(f"{key}.{unknown[0]}", f"no such key; known are {', '.join(known or ())}")
