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
from gpmpc.logs._nominal_system import NominalSystem
from gpmpc.logs._units import TIME_UNITS, Conversion, conversion
from gpmpc.models._namings import Namings
from gpmpc.models._state_space import StateGroup, StateSpace

Role = Literal["states", "inputs", "context"]
ROLES: tuple[Role, ...] = ("states", "inputs", "context")
AXES = ("enu", "ned")  # of the world; the body's are then FLU or FRD
_PLAIN_KEYS = (  # whose values are taken as they are
    "rate",
    "max_gap",
    "held",
    "rest",
    "model",
    "stamp",
)
# as files call the axes of all states, enu or ned; the ``frame`` of a signal is another
# thing: the world's or the body's
_AXES_KEY = "frame"
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
    "held",
    "topic",
)


@dataclass(frozen=True)
class Signal:
    """Columns of a log that belong together."""

    name: str  #: such as "attitude"
    role: Role
    #: as they are called in the file, or their numbers in it, from "1" on
    columns: tuple[str, ...]
    unit: str = ""  #: of the columns in the file
    #: A vector, angles, a quaternion, Euler angles (roll, pitch, yaw; they become a
    #: quaternion), or the heading of a quaternion (one angle).
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
    #: [s] by which its stamps are later than what was measured: one number, or one for
    #: each column. The values are moved back.
    delay: float | tuple[float, ...] = 0.0
    #: "hold", "linear" or "spherical"; by default states are interpolated, and all else
    #: is held, or averaged where an input changes between rows
    resample: str = ""
    #: of a state, "drop" or "use" (see ``LogMapping.held``); empty takes the mapping's
    held: str = ""
    topic: str = ""  #: the stream that holds the columns; empty where a file has one

    def __post_init__(self) -> None:
        self._check_choices()
        self._check_columns()
        self._check_number_or_numbers("scale")
        self._check_number_or_numbers("delay")
        self._check_delay()
        self._check_texts()

    def _check_choices(self) -> None:
        interpolation = "spherical" if self.is_attitude else "linear"
        for name, choices in (
            ("kind", ("vector", "angle", "quaternion", "euler", "heading")),
            ("order", ("xyzw", "wxyz")),
            ("frame", ("", "world", "body")),
            ("axes", ("", *AXES)),
            ("resample", ("", "hold", interpolation)),
            ("held", ("", "drop", "use") if self.role == "states" else ("",)),
        ):
            check_choice(f"{self._key}.{name}", getattr(self, name), choices)

    def _check_columns(self) -> None:
        numbers = {"quaternion": 4, "euler": 3, "heading": 4}
        number = numbers.get(self.kind, len(self.columns))
        are_texts = all(isinstance(column, str) for column in self.columns)
        if not self.columns or len(self.columns) != number or not are_texts:
            raise SettingError(
                f"{self._key}.columns",
                f"must be {number or 1} names of columns; got {list(self.columns)}",
            )

    def _check_number_or_numbers(self, name: str) -> None:
        """Raises ``SettingError`` of what is not one number, or one for each column."""
        value = getattr(self, name)
        if isinstance(value, list | tuple):
            check_numbers(f"{self._key}.{name}", value, len(self.columns))
            object.__setattr__(self, name, tuple(value))
        else:
            check_number(f"{self._key}.{name}", value)

    def _check_delay(self) -> None:
        if self.combines_columns and len(set(self.delays)) > 1:
            raise SettingError(
                f"{self._key}.delay",
                "must be one number for an attitude or a heading; got "
                f"{list(self.delays)}",
            )

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
    def combines_columns(self) -> bool:
        """Whether each of its entries is made of all its columns."""
        return self.is_attitude or self.kind == "heading"

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
    def delays(self) -> tuple[float, ...]:
        """The delay of each column [s]."""
        if isinstance(self.delay, tuple):
            return self.delay
        return (float(self.delay),) * len(self.columns)

    @property
    def entries(self) -> tuple[str, ...]:
        """The names of its values: those of the columns, or its own for numbers.

        A heading has its own.
        """
        if self.kind == "heading":
            return (self.name,)
        if not any(column.isdecimal() for column in self.columns):
            return self.columns
        if len(self.columns) == 1:
            return (self.name,)
        return tuple(f"{self.name}_{i + 1}" for i in range(len(self.columns)))

    @property
    def factors(self) -> tuple[float, ...]:
        """The factor of each column, from its values in the file to SI units."""
        factor = self._conversion.factor
        return tuple(scale * factor for scale in self.scales)

    @property
    def group(self) -> StateGroup:
        """The entries of a state that it becomes, after ``read_signal``.

        Angles of an attitude have become a quaternion there, which has no unit;
        ``factors`` are of the columns before.
        """
        if self.is_attitude:
            entries = tuple(f"{self.name}_{axis}" for axis in "xyzw")
            return StateGroup(
                name=self.name, entries=entries, unit="", kind="quaternion"
            )
        is_angle = self.kind in ("angle", "heading")
        return StateGroup(
            name=self.name,
            entries=self.entries,
            unit="rad" if is_angle else self._conversion.unit,
            kind="angle" if is_angle else "vector",
        )


class RoleValues(NamedTuple):
    """Rows of all signals, by their role."""

    states: Array  # (K, n)
    inputs: Array  # (K, m)
    context: Array  # (K, c)


@dataclass(frozen=True)
class LogMapping:
    """What a log's columns mean, and how its rows are read.

    See Also:
        ``read_log``, which takes it, or a dictionary of the same keys.
    """

    signals: tuple[Signal, ...]  #: states, inputs and context, in this order
    time: str = ""  #: column of the stamps; empty takes the stamps of the messages
    #: of that column; empty takes what its name says, as ``t_ms`` does, or s
    time_unit: str = ""
    #: the constant step of rows without stamps [s], or the column that holds it as its
    #: only number
    time_step: float | str | None = None
    #: names of the columns, in their order, in place of those in the file
    names: tuple[str, ...] = ()
    run: str = ""  #: column that names the runs
    #: runs that stand side by side in a file: which column of the file (or which
    #: number) each name of this mapping means in a run, by the run's name
    runs: dict[str, dict[str, str]] = field(default_factory=dict)
    #: to which rows are resampled [Hz]; None leaves them as they are
    rate: float | None = None
    #: no value is carried over a longer gap [s]; 1.5 time steps by default, which is
    #: also the most where no rate resamples over gaps
    max_gap: float | None = None
    #: ranges (lowest, highest) of columns; rows outside are left out.
    keep: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: "drop" leaves out rows in which a state's whole signal repeats the row before;
    #: "use" takes them, and zeros of all states at once.
    held: str = "drop"
    #: "drop" leaves out parts in which nothing moves; "use" takes them
    rest: str = "drop"
    #: what is known of the system: "rigid_body", "bicycle", "differential_drive" or
    #: "none"
    model: str = "none"
    #: a system with named parameters, which are fitted; none by default
    nominal: NominalSystem | None = None
    #: times of a bag's messages: "header" takes the stamps that they carry, "log" the
    #: times at which they were logged; empty takes what gives the topics time in common
    stamp: str = ""
    #: The convention of the axes of a rigid body's states, under the key ``frame``:
    #: "enu" (the body FLU) or "ned" (the body FRD); empty where nothing is said: "ned"
    #: in a PX4 log, and "enu" in any other. A signal's ``frame`` is something else.
    axes: str = ""

    def __post_init__(self) -> None:
        self._check_time()
        self._check_runs()
        for key in ("rate", "max_gap"):
            if getattr(self, key) is not None:
                check_number(key, getattr(self, key), above=0)
        for key, choices in (
            ("held", ("drop", "use")),
            ("rest", ("drop", "use")),
            ("model", ("rigid_body", "bicycle", "differential_drive", "none")),
            ("stamp", ("", "header", "log")),
        ):
            check_choice(key, getattr(self, key), choices)
        check_choice(_AXES_KEY, self.axes, ("", *AXES))
        if self.nominal is not None and self.model != "none":
            raise SettingError(
                "nominal", f"must stand alone; got model: {self.model} as well"
            )
        if self.axes and self.model != "rigid_body":
            raise SettingError(
                _AXES_KEY, f"needs model: rigid_body; got {self.axes} without one"
            )
        if self.time_unit:
            check_choice("time.unit", self.time_unit, tuple(TIME_UNITS))
        if not self.of("states"):
            raise SettingError("states", "must name at least one signal; got none")
        self._check_repeated_columns()
        self._check_topics()

    def _check_time(self) -> None:
        if not isinstance(self.time, str):
            raise SettingError(
                "time", f"must be the name of a column; got {self.time!r}"
            )
        if self.stamp and self.time:
            raise SettingError("stamp", "has no effect where time names a column")
        if self.time_step is None:
            return
        if self.time:
            raise SettingError(
                "time.step", f"is for rows without stamps; got a column, {self.time!r}"
            )
        if not isinstance(self.time_step, str):
            check_number("time.step", self.time_step, above=0)

    def _check_runs(self) -> None:
        if not isinstance(self.run, str):
            raise SettingError("run", f"must be the name of a column; got {self.run!r}")
        if self.run and self.runs:
            raise SettingError("runs", f"must stand alone; got run: {self.run} as well")
        for run, columns in self.runs.items():
            for name in columns:
                if name not in self._names_used:
                    raise SettingError(
                        f"runs.{run}.{name}", "is no column that the mapping uses"
                    )

    def _check_repeated_columns(self) -> None:
        """Raises ``SettingError`` where a column of the states is used once more.

        A rollout is given the inputs to come: with a state among them it would be
        given what it predicts.
        """
        for meanings in ({}, *self.runs.values()):
            signals: dict[tuple[str, str], Signal] = {}  # by topic and column
            for signal in (*self.of("states"), *self.of("inputs")):
                for column in signal.columns:
                    key = (signal.topic, meanings.get(column, column))
                    first = signals.setdefault(key, signal)
                    is_new = first is signal and signal.columns.count(column) == 1
                    if first.role == "states" and not is_new:
                        raise SettingError(
                            f"{signal.role}.{signal.name}.columns",
                            f"must have none of states.{first.name} again; got "
                            f"{key[1]!r}",
                        )

    def _check_topics(self) -> None:
        topics = {signal.topic for signal in self.signals}
        for key, value in (
            ("time.step", self.time_step),
            ("names", self.names),
            ("runs", self.runs),
        ):
            if value and any(topics):
                raise SettingError(
                    key, f"needs a file of one table; got topic {max(topics)!r}"
                )
        if len(topics) > 1 and self.rate is None:
            raise SettingError(
                "rate", "must be given where signals come from several topics; got none"
            )

    @property
    def signal_columns(self) -> tuple[str, ...]:
        """The columns of all signals."""
        return tuple(column for signal in self.signals for column in signal.columns)

    @property
    def _names_used(self) -> set[str]:
        """The columns that the mapping uses, as it calls them."""
        others = {self.time, self.time_step, self.run, *self.keep}
        texts = {name for name in others if isinstance(name, str) and name}
        return {*self.signal_columns, *texts}

    @property
    def used_columns(self) -> tuple[str, ...]:
        """The columns that the mapping uses, as it and as its runs call them."""
        of_runs = [name for columns in self.runs.values() for name in columns.values()]
        return tuple(sorted({*self._names_used, *of_runs}))

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
        if signal.kind in ("euler", "heading"):
            return list(signal.group.entries)
        names = [
            name if factor == 1 else f"{name} times {factor:.6g}"
            for name, factor in zip(signal.columns, signal.factors, strict=True)
        ]
        names = self._in_order_of_states(signal, names)
        if self._turns_axes(signal):
            names = [f"{name} in other axes" for name in names]
        return names

    def _in_order_of_states(self, signal: Signal, names: list[str]) -> list[str]:
        """Returns names of a signal's columns in the order that they come out in."""
        if signal.kind == "quaternion" and signal.order == "wxyz":
            names = [*names[1:], names[0]]
        if self._swaps_east_and_north(signal):
            names = [names[1], names[0], names[2]]
        return names

    @property
    def namings(self) -> Namings:
        """What states and inputs may be called: as columns, as entries, as signals."""
        return Namings(self._namings_of("states"), self._namings_of("inputs"))

    def _namings_of(self, role: Role) -> tuple[tuple[str, ...], ...]:
        """Returns ways to call the entries of one role, which are different names each.

        They are the columns, the entries of the signals, and the signals' own names
        where these have one entry.
        """
        by_column: list[str] = []
        by_entry: list[str] = []
        by_signal: list[str] = []
        for signal in self.of(role):
            is_euler = signal.kind == "euler"
            columns = signal.group.entries if is_euler else signal.entries
            group = self._group(signal) if role == "states" else signal.group
            entries = group.entries
            by_column += self._in_order_of_states(signal, list(columns))
            by_entry += entries
            by_signal += [signal.name] if len(entries) == 1 else entries
        ways = dict.fromkeys(map(tuple, (by_column, by_entry, by_signal)))
        return tuple(names for names in ways if len(set(names)) == len(names))

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
        keys = ("time", "keep", "names", "run", "runs", "nominal", *_PLAIN_KEYS)
        keys = (*keys, _AXES_KEY, *ROLES)
        _check_keys("mapping", content, keys)
        signals = [signal for role in ROLES for signal in _read_signals(role, content)]
        time = _value_or(content.get("time"), {})
        if not isinstance(time, Mapping):
            time = {"column": _as_name(time)}
        _check_keys("time", time, ("column", "unit", "step"))
        nominal = content.get("nominal") or None
        settings = {key: content[key] for key in _PLAIN_KEYS if key in content}
        return cls(
            signals=tuple(signals),
            time=_as_name(time.get("column", "")),
            time_unit=time.get("unit", ""),
            time_step=time.get("step"),
            names=_read_names("names", _value_or(content.get("names"), ())),
            run=_as_name(content.get("run", "")),
            runs=_read_runs(_value_or(content.get("runs"), {})),
            keep=_read_ranges(_value_or(content.get("keep"), {})),
            axes=content.get(_AXES_KEY, ""),
            nominal=None if nominal is None else NominalSystem.from_plain(nominal),
            **settings,
        )


def _value_or(value: Any, default: Any) -> Any:
    """Returns the value of a key, or a default where it is missing or empty.

    The number 0 is a value: somebody counts columns from it.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return value if value or is_number else default


def _as_name(column: Any) -> Any:
    """Returns the number of a column as a text; all else as it is."""
    is_number = isinstance(column, int) and not isinstance(column, bool)
    return str(column) if is_number else column


def _read_names(key: str, names: Any) -> tuple[str, ...]:
    """Reads different names of columns."""
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise SettingError(key, f"must be a list of names; got {names!r:.200}")
    texts = tuple(_as_name(name) for name in names)
    are_texts = all(isinstance(name, str) and name for name in texts)
    if not are_texts or len(set(texts)) < len(texts):
        raise SettingError(key, f"must be different names; got {list(names)!r:.200}")
    return texts


def _read_runs(content: Any) -> dict[str, dict[str, str]]:
    """Reads which column each name means, for each run."""
    _check_keys("runs", content, None)
    runs = {}
    for run, columns in content.items():
        _check_keys(f"runs.{run}", columns, None)
        names = {_as_name(name): _as_name(column) for name, column in columns.items()}
        for name, column in names.items():
            if not isinstance(column, str):
                raise SettingError(
                    f"runs.{run}.{name}", f"must be a column; got {column!r:.200}"
                )
        runs[str(run)] = names
    return runs


def _read_signals(role: Role, content: Mapping[str, Any]) -> list[Signal]:
    """Reads the signals of one role."""
    entries = _value_or(content.get(role), {})
    _check_keys(role, entries, None)
    signals = []
    for name, entry in entries.items():
        if isinstance(entry, Sequence | int):
            entry = {"columns": entry}
        _check_keys(f"{role}.{name}", entry, _SIGNAL_KEYS)
        columns = _value_or(entry.get("columns"), ())
        if isinstance(columns, str | int):
            columns = (columns,)
        if not isinstance(columns, Sequence):
            raise SettingError(
                f"{role}.{name}.columns",
                f"must be a name, or a list of names; got {columns!r:.200}",
            )
        columns = tuple(_as_name(column) for column in columns)
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
        ranges[_as_name(column)] = (lowest, highest)
    return ranges


def _read_limit(column: str, value: Any) -> float:
    try:
        limit = float(value)
    except (TypeError, ValueError, OverflowError):
        limit = np.nan
    if np.isnan(limit):
        raise SettingError(
            f"keep.{column}", f"must be two numbers or null; got {value!r}"
        )
    return limit


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
