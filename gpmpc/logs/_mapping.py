"""Says what the columns or topics of a log mean: states, inputs and context, with units, frames and conventions.

A mapping is a YAML file or a dictionary (docs/guide_log.md). States come out in m, rad, s, kg and their products.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from gpmpc.exceptions import (
    SettingError,
    check_choice,
    check_number,
    check_numbers,
)
from gpmpc.logs._kinematics import Array, StateGroup, StateSpace
from gpmpc.logs._units import Conversion, conversion

Role = Literal["states", "inputs", "context"]
ROLES: tuple[Role, ...] = ("states", "inputs", "context")
AXES = ("enu", "ned")  # of the world; the body's are then FLU or FRD
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_PLAIN = (
    "run",
    "rate",
    "max_gap",
    "held",
    "rest",
    "model",
    "stamp",
    "frame",
)  # keys whose values are taken as they are
_LONGEST = 2**16  # of a mapping's text [characters]
_DEEPEST = 10  # levels of a mapping's text
_SIGNAL_KEYS = (
    "columns",
    "unit",
    "kind",
    "order",
    "frame",
    "axes",
    "scale",
    "delay",
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
    #: "enu" or "ned", for states of a rigid body; empty takes the mapping's frame.
    axes: str = ""
    #: The values are multiplied by it: one number, or one for each column.
    scale: float | tuple[float, ...] = 1.0
    #: [s] by which its values come later than their stamps say; they are moved back.
    delay: float = 0.0
    resample: str = ""  #: "hold", "linear" or "spherical"; by default states are interpolated and all else is held
    topic: str = ""  #: the stream that holds the columns; empty where a file has one

    def __post_init__(self) -> None:
        key = f"{self.role}.{self.name}"
        for name, known in (
            ("kind", ("vector", "angle", "quaternion", "euler")),
            ("order", ("xyzw", "wxyz")),
            ("frame", ("", "world", "body")),
            ("axes", ("", *AXES)),
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
        if isinstance(self.scale, list | tuple):
            check_numbers(f"{key}.scale", self.scale, len(self.columns))
            object.__setattr__(self, "scale", tuple(self.scale))
        else:
            check_number(f"{key}.scale", self.scale)
        check_number(f"{key}.delay", self.delay)
        for name in ("unit", "topic"):
            if not isinstance(getattr(self, name), str):
                raise SettingError(
                    f"{key}.{name}", f"must be a word; got {getattr(self, name)!r}"
                )
        if self.kind in ("angle", "euler"):
            check_choice(f"{key}.unit", self.unit, ("rad", "deg"))
        conversion(f"{key}.unit", self.unit)

    @property
    def _conversion(self) -> Conversion:
        return conversion(f"{self.role}.{self.name}.unit", self.unit)

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
    def factors(self) -> tuple[float, ...]:
        """Of each column's values in the file, to the units that they come out in."""
        scales = self.scale
        if not isinstance(scales, tuple):
            scales = (scales,) * len(self.columns)
        return tuple(scale * self._conversion.factor for scale in scales)

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
        return StateGroup(
            name=self.name,
            entries=self.columns,
            unit=self._conversion.unit,
            kind="angle" if self.kind == "angle" else "vector",
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
    #: times of a bag's messages: "header" takes the stamps that they carry, "log" the
    #: times at which they were logged; empty takes what gives the topics time in common
    stamp: str = ""
    #: of a rigid body's states: "enu" (the body FLU) or "ned" (the body FRD); empty
    #: where nothing is said: "ned" in a PX4 log, and "enu" in any other.
    frame: str = ""

    def __post_init__(self) -> None:
        if self.stamp and self.time:
            raise SettingError("stamp", "has no effect where time names a column")
        for key in ("time", "run"):
            if not isinstance(getattr(self, key), str):
                raise SettingError(
                    key, f"must be the name of a column; got {getattr(self, key)!r}"
                )
        for key in ("rate", "max_gap"):
            if getattr(self, key) is not None:
                check_number(key, getattr(self, key), above=0)
        for key, known in (
            ("held", ("drop", "use")),
            ("rest", ("drop", "use")),
            ("model", ("rigid_body", "none")),
            ("stamp", ("", "header", "log")),
            ("frame", ("", *AXES)),
        ):
            check_choice(key, getattr(self, key), known)
        if self.frame and self.model == "none":
            raise SettingError(
                "frame", f"needs model: rigid_body; got {self.frame} without one"
            )
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
            names = [
                name if factor == 1 else f"{name} times {factor:.6g}"
                for name, factor in zip(signal.columns, signal.factors, strict=True)
            ]
            if signal.kind == "quaternion" and signal.order == "wxyz":
                names = [*names[1:], names[0]]
            if self._swaps_east_and_north(signal):
                names = [names[1], names[0], names[2]]
            if self._turns_axes(signal):
                names = [f"{name} in other axes" for name in names]
            found += names
        return tuple(found)

    def axes_of(self, signal: Signal) -> str:
        """The axes of a rigid body's state in the file: "enu" or "ned"."""
        return signal.axes or self.frame or "enu"

    def _turns_axes(self, signal: Signal) -> bool:
        """Whether a signal comes out in other axes than those of the file."""
        if self.model != "rigid_body" or signal.role != "states":
            return False
        other_frame = {"m/s": "body", "rad/s": "world"}.get(signal.group.unit)
        return signal.frame == other_frame or self.axes_of(signal) == "ned"

    def _swaps_east_and_north(self, signal: Signal) -> bool:
        """Whether the first two columns change places: in NED north comes first."""
        states = self.of("states")
        if self.model != "rigid_body" or self.axes_of(signal) == "enu":
            return False
        is_position = signal in states[0:1]
        is_velocity = signal in states[2:3]
        in_world_axes = is_position or (is_velocity and signal.frame != "body")
        return in_world_axes and len(signal.columns) == 3

    def _group(self, signal: Signal) -> StateGroup:
        """A signal of the states as it comes out."""
        group = signal.group
        if not self._swaps_east_and_north(signal):
            return group
        north, east, down = group.entries
        return replace(group, entries=(east, north, down))

    @property
    def space(self) -> StateSpace:
        """The space of the states."""
        return StateSpace(tuple(self._group(signal) for signal in self.of("states")))

    @classmethod
    def load(cls, path: str | Path) -> "LogMapping":
        """Reads a YAML file; ``SettingError`` where that fails, or a key or value is wrong."""
        try:
            with Path(path).open(encoding="utf-8") as file:
                text = file.read(_LONGEST + 1)
            if len(text) > _LONGEST:
                raise SettingError(
                    "mapping", f"{path} has more than {_LONGEST} characters"
                )
            _check_structure(text)
            content = yaml.load(text, Loader=_UniqueKeys)
        except (
            OSError,
            ValueError,  # of numbers and dates that are none
            RecursionError,
            yaml.YAMLError,
        ) as error:
            if isinstance(error, SettingError):
                raise
            name = " ".join(str(path).split())
            reason = " ".join(str(error).split())
            raise SettingError(
                "mapping", f"{name:.200} cannot be read ({reason:.300})"
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
                signal = Signal(str(name), role, **{**given, "columns": columns})
                if signal.axes and content.get("model") != "rigid_body":
                    raise SettingError(
                        f"{role}.{name}.axes", "needs model: rigid_body; got none"
                    )
                signals.append(signal)
        time = content.get("time") or {}
        time = {"column": time} if isinstance(time, str) else time
        _check_keys("time", time, ("column", "unit"))
        _check_keys("keep", content.get("keep") or {}, None)
        keep = {}
        for column, limits in (content.get("keep") or {}).items():
            if not isinstance(limits, list) or len(limits) != 2:
                raise SettingError(
                    f"keep.{column}", f"must be [lowest, highest]; got {limits!r}"
                )
            low, high = limits
            keep[column] = (
                -np.inf if low is None else _limit(column, low),
                np.inf if high is None else _limit(column, high),
            )
        plain = {key: content[key] for key in _PLAIN if key in content}
        return cls(
            tuple(signals),
            time.get("column", ""),
            time.get("unit", "s"),
            keep=keep,
            **plain,
        )


class _UniqueKeys(yaml.SafeLoader):
    """Reads YAML in which no mapping has a key twice, of which the last would win."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        content = super().construct_mapping(node, deep)
        if len(content) < len(node.value):
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            key, _ = Counter(keys).most_common(1)[0]
            raise SettingError("mapping", f"holds the key {key!r:.80} twice")
        return content


def _check_structure(text: str) -> None:
    """Raises ``SettingError`` of YAML that takes for ever, though it is short.

    A few aliases of aliases stand for more than any memory holds, and the time of
    nested brackets grows with the square of their depth.
    """
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise SettingError(
                "mapping",
                f"has an alias, *{event.anchor}; write out what it stands for",
            )
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise SettingError("mapping", f"is nested deeper than {_DEEPEST} levels")


def _limit(column: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise SettingError(
            f"keep.{column}", f"must be two numbers or null; got {value!r}"
        ) from None


def _check_keys(key: str, given: Any, known: Sequence[str] | None) -> None:
    if not isinstance(given, Mapping):
        raise SettingError(key, f"must be keys and values; got {given!r:.200}")
    unknown = [name for name in given if known is not None and name not in known]
    if unknown:
        raise SettingError(
            f"{key}.{unknown[0]}", f"no such key; known are {', '.join(known or ())}"
        )
