"""Says what the columns or topics of a log mean: states, inputs and context, with units, frames and conventions.

A mapping is a YAML file or a dictionary (docs/guide_log.md). States come out in m, rad, s, kg and their products.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from gpmpc.exceptions import SettingError, check_choice, check_number
from gpmpc.logs._kinematics import Array, StateGroup, StateSpace

Role = Literal["states", "inputs", "context"]
ROLES: tuple[Role, ...] = ("states", "inputs", "context")
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
_PLAIN = (
    "run",
    "rate",
    "max_gap",
    "held",
    "rest",
    "model",
)  # keys whose values are taken as they are
_SIGNAL_KEYS = (
    "columns",
    "unit",
    "kind",
    "order",
    "frame",
    "scale",
    "resample",
    "topic",
)


@dataclass(frozen=True)
class Signal:
    """Columns of a log that belong together."""

    name: str  #: such as "attitude"
    role: Role
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
        for name, known in (
            ("kind", ("vector", "angle", "quaternion", "euler")),
            ("order", ("xyzw", "wxyz")),
            ("frame", ("", "world", "body")),
            ("resample", ("", "hold", "spherical" if self.turns else "linear")),
        ):
            check_choice(f"{key}.{name}", getattr(self, name), known)
        number = {"quaternion": 4, "euler": 3}.get(self.kind, len(self.columns))
        if (
            not self.columns
            or len(self.columns) != number
            or not all(isinstance(c, str) for c in self.columns)
        ):
            raise SettingError(
                f"{key}.columns",
                f"must be {number or 1} names of columns; got {list(self.columns)}",
            )
        check_number(f"{key}.scale", self.scale)
        if self.kind in ("angle", "euler"):
            check_choice(f"{key}.unit", self.unit, ("rad", "deg"))

    @property
    def turns(self) -> bool:
        """Whether it is an attitude."""
        return self.kind in ("quaternion", "euler")

    @property
    def rule(self) -> str:
        """How it is resampled."""
        return self.resample or (
            "hold" if self.role != "states" else "spherical" if self.turns else "linear"
        )

    @property
    def factor(self) -> float:
        """Of its values in the file, to the units that they come out in."""
        return self.scale * UNITS.get(self.unit, ("", 1.0))[1]

    @property
    def group(self) -> StateGroup:
        """As it comes out."""
        if self.turns:
            return StateGroup(
                self.name,
                tuple(f"{self.name}_{axis}" for axis in "xyzw"),
                "",
                "quaternion",
            )
        unit = UNITS.get(self.unit, (self.unit, 1.0))[0]
        return StateGroup(
            self.name, self.columns, unit, "angle" if self.kind == "angle" else "vector"
        )


@dataclass(frozen=True)
class LogMapping:
    """What a log's columns mean, and how its rows are read."""

    signals: tuple[Signal, ...]  #: states, inputs and context, in this order
    time: str = ""  #: column of the stamps; empty takes the stamps of the messages
    time_unit: str = "s"  #: of that column
    run: str = ""  #: column that names the runs
    rate: float | None = (
        None  #: to which rows are resampled [Hz]; None leaves them as they are
    )
    max_gap: float | None = (
        None  #: no value is carried over a longer gap [s]; 1.5 time steps by default
    )
    #: ranges (lowest, highest) of columns; rows outside are left out.
    keep: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: "drop" leaves out rows in which a state's whole signal repeats the row before; "use" takes them.
    held: str = "drop"
    rest: str = (
        "drop"  #: "drop" leaves out parts in which nothing moves; "use" takes them
    )
    model: str = "none"  #: what is known of the system: "rigid_body" or "none"

    def __post_init__(self) -> None:
        for key in ("rate", "max_gap"):
            if getattr(self, key) is not None:
                check_number(key, getattr(self, key), above=0)
        for key, known in (
            ("held", ("drop", "use")),
            ("rest", ("drop", "use")),
            ("model", ("rigid_body", "none")),
        ):
            check_choice(key, getattr(self, key), known)
        check_choice("time.unit", self.time_unit, tuple(TIME_UNITS))
        if not self.of("states"):
            raise SettingError("states", "must name at least one signal; got none")
        if len({signal.topic for signal in self.signals}) > 1 and self.rate is None:
            raise SettingError(
                "rate", "must be given where signals come from several topics; got none"
            )

    def of(self, role: Role) -> tuple[Signal, ...]:
        """The signals of one role."""
        return tuple(signal for signal in self.signals if signal.role == role)

    def split(self, values: Array) -> list[Array]:
        """Splits rows of all signals (K, n + m + c) into those of states, inputs and context."""
        sizes = [
            sum(len(signal.group.entries) for signal in self.of(role)) for role in ROLES
        ]
        return [
            np.ascontiguousarray(part)
            for part in np.split(values, np.cumsum(sizes[:-1]), axis=1)
        ]

    def column_names(self, role: Role) -> tuple[str, ...]:
        """The columns of one role in the order that they come out in, with what was done to their values."""
        found: list[str] = []
        for signal in self.of(role):
            if signal.kind == "euler":
                found += signal.group.entries
                continue
            names = signal.columns
            if signal.kind == "quaternion" and signal.order == "wxyz":
                names = (*names[1:], names[0])
            other_frame = {"m/s": "body", "rad/s": "world"}.get(signal.group.unit)
            done = f" times {signal.factor:.6g}" * (signal.factor != 1)
            done += " in other axes" * (
                self.model == "rigid_body" and signal.frame == other_frame
            )
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
            raise SettingError(
                "mapping", f"{path} cannot be read ({' '.join(str(error).split())})"
            ) from error
        return cls.from_dict(content)

    @classmethod
    def from_dict(cls, content: Any) -> "LogMapping":
        """Makes one of plain data, as a YAML file holds them; ``SettingError`` where a key or value is wrong."""
        _check_keys("mapping", content, ("time", "keep", *_PLAIN, *ROLES))
        signals = []
        for role in ROLES:
            _check_keys(role, content.get(role) or {}, None)
            for name, given in (content.get(role) or {}).items():
                given = {"columns": given} if isinstance(given, Sequence) else given
                _check_keys(f"{role}.{name}", given, _SIGNAL_KEYS)
                columns = given.get("columns") or ()
                columns = (columns,) if isinstance(columns, str) else tuple(columns)
                signals.append(Signal(str(name), role, **{**given, "columns": columns}))
        time = content.get("time") or {}
        time = {"column": time} if isinstance(time, str) else time
        _check_keys("time", time, ("column", "unit"))
        keep = {}
        for column, limits in (content.get("keep") or {}).items():
            if not isinstance(limits, list) or len(limits) != 2:
                raise SettingError(
                    f"keep.{column}", f"must be [lowest, highest]; got {limits!r}"
                )
            low, high = limits
            keep[column] = (
                -np.inf if low is None else float(low),
                np.inf if high is None else float(high),
            )
        plain = {key: content[key] for key in _PLAIN if key in content}
        return cls(
            tuple(signals),
            time.get("column", ""),
            time.get("unit", "s"),
            keep=keep,
            **plain,
        )


def _check_keys(key: str, given: Any, known: Sequence[str] | None) -> None:
    if not isinstance(given, Mapping):
        raise SettingError(key, f"must be keys and values; got {given!r}")
    unknown = [name for name in given if known is not None and name not in known]
    if unknown:
        raise SettingError(
            f"{key}.{unknown[0]}", f"no such key; known are {', '.join(known or ())}"
        )
