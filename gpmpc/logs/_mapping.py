"""Says what the columns or topics of a log mean: states, inputs and context.

A mapping is a YAML file or a dictionary (docs/guide_log.md). It names units, frames and
conventions; states come out in m, rad, s, kg and their products.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import (
    SettingError,
    check_choice,
    check_number,
    check_numbers,
)
from gpmpc.logs._mapping_text import load_mapping_text
from gpmpc.logs._units import Conversion, conversion
from gpmpc.models._state_space import StateGroup, StateSpace

Role = Literal["states", "inputs", "context"]
ROLES: tuple[Role, ...] = ("states", "inputs", "context")
AXES = ("enu", "ned")  # of the world; the body's are then FLU or FRD
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_PLAIN_KEYS = (  # whose values are taken as they are
    "run",
    "rate",
    "max_gap",
    "held",
    "rest",
    "model",
    "stamp",
)
_AXES_KEY = "frame"  # as files call the axes of all states
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
    #: A vector, angles, a quaternion, or Euler angles (roll, pitch, yaw; they become a
    #: quaternion).
    kind: str = "vector"
    order: str = "xyzw"  #: of a quaternion: "xyzw" or "wxyz"
    #: The frame that a rigid body's velocity or rate is measured in: "world" or "body";
    #: empty where it has none.
    frame: str = ""
    #: The convention of the axes in both frames, for states of a rigid body: "enu" or
    #: "ned" (see ``AXES``); empty takes the mapping's.
    axes: str = ""
    #: The values are multiplied by it: one number, or one for each column.
    scale: float | tuple[float, ...] = 1.0
    #: [s] by which its stamps are later than what was measured; the values are moved
    #: back.
    delay: float = 0.0
    #: "hold", "linear" or "spherical"; by default states are interpolated and all else
    #: is held
    resample: str = ""
    topic: str = ""  #: the stream that holds the columns; empty where a file has one

    def __post_init__(self) -> None:
        self._check_choices()
        self._check_columns()
        self._check_scale()
        check_number(f"{self._key}.delay", self.delay)
        self._check_texts()

    def _check_choices(self) -> None:
        interpolation = "spherical" if self.is_attitude else "linear"
        for name, choices in (
            ("kind", ("vector", "angle", "quaternion", "euler")),
            ("order", ("xyzw", "wxyz")),
            ("frame", ("", "world", "body")),
            ("axes", ("", *AXES)),
            ("resample", ("", "hold", interpolation)),
        ):
            check_choice(f"{self._key}.{name}", getattr(self, name), choices)

    def _check_columns(self) -> None:
        number = {"quaternion": 4, "euler": 3}.get(self.kind, len(self.columns))
        are_texts = all(isinstance(column, str) for column in self.columns)
        if not self.columns or len(self.columns) != number or not are_texts:
            raise SettingError(
                f"{self._key}.columns",
                f"must be {number or 1} names of columns; got {list(self.columns)}",
            )

    def _check_scale(self) -> None:
        key = f"{self._key}.scale"
        if isinstance(self.scale, list | tuple):
            check_numbers(key, self.scale, len(self.columns))
            object.__setattr__(self, "scale", tuple(self.scale))
        else:
            check_number(key, self.scale)

    def _check_texts(self) -> None:
        for name in ("unit", "topic"):
            value = getattr(self, name)
            if not isinstance(value, str):
                raise SettingError(
                    f"{self._key}.{name}", f"must be a word; got {value!r}"
                )
        if self.kind in ("angle", "euler"):
            check_choice(f"{self._key}.unit", self.unit, ("rad", "deg"))
        conversion(f"{self._key}.unit", self.unit)

    @property
    def _key(self) -> str:
        return f"{self.role}.{self.name}"

    @property
    def _conversion(self) -> Conversion:
        return conversion(f"{self._key}.unit", self.unit)

    @property
    def is_attitude(self) -> bool:
        return self.kind in ("quaternion", "euler")

    @property
    def rule(self) -> str:
        """The rule by which it is resampled."""
        if self.resample:
            return self.resample
        if self.role != "states":
            return "hold"
        return "spherical" if self.is_attitude else "linear"

    @property
    def scales(self) -> tuple[float, ...]:
        """The scale of each column."""
        if isinstance(self.scale, tuple):
            return self.scale
        return (self.scale,) * len(self.columns)

    @property
    def factors(self) -> tuple[float, ...]:
        """The factor of each column, from its values in the file to SI units."""
        factor = self._conversion.factor
        return tuple(scale * factor for scale in self.scales)

    @property
    def group(self) -> StateGroup:
        """The entries of a state that it becomes."""
        if self.is_attitude:
            entries = tuple(f"{self.name}_{axis}" for axis in "xyzw")
            return StateGroup(
                name=self.name, entries=entries, unit="", kind="quaternion"
            )
        return StateGroup(
            name=self.name,
            entries=self.columns,
            unit=self._conversion.unit,
            kind="angle" if self.kind == "angle" else "vector",
        )


class RoleValues(NamedTuple):
    """Rows of all signals, by their role."""

    states: Array  # (K, n)
    inputs: Array  # (K, m)
    context: Array  # (K, c)


@dataclass(frozen=True)
class LogMapping:
    """What a log's columns mean, and how its rows are read."""

    signals: tuple[Signal, ...]  #: states, inputs and context, in this order
    time: str = ""  #: column of the stamps; empty takes the stamps of the messages
    time_unit: str = "s"  #: of that column
    run: str = ""  #: column that names the runs
    #: to which rows are resampled [Hz]; None leaves them as they are
    rate: float | None = None
    #: no value is carried over a longer gap [s]; 1.5 time steps by default
    max_gap: float | None = None
    #: ranges (lowest, highest) of columns; rows outside are left out.
    keep: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: "drop" leaves out rows in which a state's whole signal repeats the row before;
    #: "use" takes them.
    held: str = "drop"
    #: "drop" leaves out parts in which nothing moves; "use" takes them
    rest: str = "drop"
    model: str = "none"  #: what is known of the system: "rigid_body" or "none"
    #: times of a bag's messages: "header" takes the stamps that they carry, "log" the
    #: times at which they were logged; empty takes what gives the topics time in common
    stamp: str = ""
    #: The convention of the axes of a rigid body's states, under the key ``frame``:
    #: "enu" (the body FLU) or "ned" (the body FRD); empty where nothing is said: "ned"
    #: in a PX4 log, and "enu" in any other. A signal's ``frame`` is something else.
    axes: str = ""

    def __post_init__(self) -> None:
        if self.stamp and self.time:
            raise SettingError("stamp", "has no effect where time names a column")
        for key in ("time", "run"):
            value = getattr(self, key)
            if not isinstance(value, str):
                raise SettingError(key, f"must be the name of a column; got {value!r}")
        for key in ("rate", "max_gap"):
            if getattr(self, key) is not None:
                check_number(key, getattr(self, key), above=0)
        for key, choices in (
            ("held", ("drop", "use")),
            ("rest", ("drop", "use")),
            ("model", ("rigid_body", "none")),
            ("stamp", ("", "header", "log")),
        ):
            check_choice(key, getattr(self, key), choices)
        check_choice(_AXES_KEY, self.axes, ("", *AXES))
        if self.axes and self.model == "none":
            raise SettingError(
                _AXES_KEY, f"needs model: rigid_body; got {self.axes} without one"
            )
        check_choice("time.unit", self.time_unit, tuple(TIME_UNITS))
        if not self.of("states"):
            raise SettingError("states", "must name at least one signal; got none")
        if len({signal.topic for signal in self.signals}) > 1 and self.rate is None:
            raise SettingError(
                "rate", "must be given where signals come from several topics; got none"
            )

    def of(self, role: Role) -> tuple[Signal, ...]:
        """Returns the signals of one role."""
        return tuple(signal for signal in self.signals if signal.role == role)

    def split(self, values: Array) -> RoleValues:
        """Splits rows of all signals (K, n + m + c) by their role."""
        n = self._width("states")
        m = self._width("inputs")
        return RoleValues(
            states=np.ascontiguousarray(values[:, :n]),
            inputs=np.ascontiguousarray(values[:, n : n + m]),
            context=np.ascontiguousarray(values[:, n + m :]),
        )

    def _width(self, role: Role) -> int:
        return sum(len(signal.group.entries) for signal in self.of(role))

    def column_names(self, role: Role) -> tuple[str, ...]:
        """Returns the columns of one role in the order that they come out in.

        Their names say what was done to the values.
        """
        names: list[str] = []
        for signal in self.of(role):
            names += self._names_of(signal)
        return tuple(names)

    def _names_of(self, signal: Signal) -> list[str]:
        if signal.kind == "euler":
            return list(signal.group.entries)
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
        return names

    def axes_of(self, signal: Signal) -> str:
        """Returns the axes of a rigid body's state in the file: "enu" or "ned"."""
        return signal.axes or self.axes or "enu"

    def _turns_axes(self, signal: Signal) -> bool:
        """Tells whether a signal comes out in other axes than those of the file."""
        if self.model != "rigid_body" or signal.role != "states":
            return False
        other_frame = {"m/s": "body", "rad/s": "world"}.get(signal.group.unit)
        return signal.frame == other_frame or self.axes_of(signal) == "ned"

    def _swaps_east_and_north(self, signal: Signal) -> bool:
        """Tells whether the first two columns change places: NED has north first."""
        states = self.of("states")
        if self.model != "rigid_body" or self.axes_of(signal) == "enu":
            return False
        is_position = signal in states[0:1]
        is_velocity = signal in states[2:3]
        in_world_axes = is_position or (is_velocity and signal.frame != "body")
        return in_world_axes and len(signal.columns) == 3

    def _group(self, signal: Signal) -> StateGroup:
        """Returns a signal of the states as it comes out."""
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
        """Reads a YAML file.

        Raises:
            SettingError: It cannot be read, or a key or value is wrong.
        """
        return cls.from_dict(load_mapping_text(path))

    @classmethod
    def from_dict(cls, content: Any) -> "LogMapping":
        """Makes a mapping of plain data, as a YAML file holds them.

        Raises:
            SettingError: A key or value is wrong.
        """
        keys = ("time", "keep", *_PLAIN_KEYS, _AXES_KEY, *ROLES)
        _check_keys("mapping", content, keys)
        signals = [signal for role in ROLES for signal in _read_signals(role, content)]
        time = content.get("time") or {}
        if isinstance(time, str):
            time = {"column": time}
        _check_keys("time", time, ("column", "unit"))
        keep = _read_ranges(content.get("keep") or {})
        settings = {key: content[key] for key in _PLAIN_KEYS if key in content}
        return cls(
            signals=tuple(signals),
            time=time.get("column", ""),
            time_unit=time.get("unit", "s"),
            keep=keep,
            axes=content.get(_AXES_KEY, ""),
            **settings,
        )


def _read_signals(role: Role, content: Mapping[str, Any]) -> list[Signal]:
    """Reads the signals of one role."""
    entries = content.get(role) or {}
    _check_keys(role, entries, None)
    signals = []
    for name, entry in entries.items():
        if isinstance(entry, Sequence):
            entry = {"columns": entry}
        _check_keys(f"{role}.{name}", entry, _SIGNAL_KEYS)
        columns = entry.get("columns") or ()
        columns = (columns,) if isinstance(columns, str) else tuple(columns)
        signal = Signal(name=str(name), role=role, **{**entry, "columns": columns})
        if signal.axes and content.get("model") != "rigid_body":
            raise SettingError(
                f"{role}.{name}.axes", "needs model: rigid_body; got none"
            )
        signals.append(signal)
    return signals


def _read_ranges(content: Any) -> dict[str, tuple[float, float]]:
    """Reads the lowest and highest values of columns; None is no limit."""
    _check_keys("keep", content, None)
    ranges = {}
    for column, limits in content.items():
        if not isinstance(limits, list) or len(limits) != 2:
            raise SettingError(
                f"keep.{column}", f"must be [lowest, highest]; got {limits!r}"
            )
        low, high = limits
        lowest = -np.inf if low is None else _read_limit(column, low)
        highest = np.inf if high is None else _read_limit(column, high)
        ranges[column] = (lowest, highest)
    return ranges


def _read_limit(column: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise SettingError(
            f"keep.{column}", f"must be two numbers or null; got {value!r}"
        ) from None


def _check_keys(key: str, content: Any, known_keys: Sequence[str] | None) -> None:
    """Raises ``SettingError`` of what is no mapping, or has other keys than known."""
    if not isinstance(content, Mapping):
        raise SettingError(key, f"must be keys and values; got {content!r:.200}")
    if known_keys is None:
        return
    unknown = [name for name in content if name not in known_keys]
    if unknown:
        raise SettingError(
            f"{key}.{unknown[0]}", f"no such key; known are {', '.join(known_keys)}"
        )
