"""Describes a system that is controlled: its dynamics, its names, how it is flown."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, isfinite
from typing import Any, cast

import numpy as np

from gpmpc._arrays import labels_of, read_array
from gpmpc._calls import explains_arguments
from gpmpc._functions import call_dynamics, dynamics_advice
from gpmpc.exceptions import (
    GpmpcError,
    SettingError,
    ShapeError,
    check_kind,
    check_number,
    check_numbers,
)
from gpmpc.signals import Signals
from gpmpc.systems._elementary import cos, exp, sin  # noqa: F401 (older files: here)
from gpmpc.trajectories import Trajectory

Array = np.ndarray
GRAVITY = 9.81  # [m/s^2]
UNKNOWN = "?"  # the unit of a state or an input that has none given


@explains_arguments
@dataclass(frozen=True, eq=False)
class System:
    """A discrete-time system, with all that reports, recordings and figures say of it.

    Its ``dynamics`` have the names of the n states and m inputs, in order
    (``state_names``, ``input_names``), and one method of two: ``derivative(x, u)``, the
    n entries of dx/dt, or ``successor(x, u)``, those of the next state. They are
    written once, with plain arithmetic on the entries of x and u, so that floats, NumPy
    arrays and CasADi expressions all pass through the same formula; for all of them
    are ``sin``, ``sqrt``, ``where`` and their like of this package, and numpy's of the
    same names. A right-hand side is integrated with the input held
    constant, by the Runge-Kutta method of order four on equal substeps.

    Raises:
        SettingError: A number out of range, an unknown name, rates of each other, or
            dynamics without a finite value where the system starts.
        ShapeError: A list has another length than there are states or inputs, or the
            dynamics have.

    >>> class Cart:
    ...     state_names, input_names = ("position", "speed"), ("force",)
    ...
    ...     def derivative(self, x, u):
    ...         return [x[1], u[0] - 0.2 * x[1]]
    >>> plant = System(Cart(), time_step=0.1, units={"position": "m", "force": "N"})
    >>> plant.name, plant.state_names, plant.unit
    ('Cart', ('position', 'speed'), 'm')

    See Also:
        ``step`` and ``step_many``, which move it on; ``gpmpc.systems.pendulum`` and
        others that come with the package; ``gpmpc.simulation.closed_loop``, which flies
        it.
    """

    #: names of states and inputs, and how it moves
    dynamics: Any
    #: sampling time [s]; it has to be said
    time_step: float = cast(float, None)
    #: Runge-Kutta steps per sampling time
    substeps: int = 10
    #: what it is called; by default as the class of its dynamics
    name: str = ""
    #: by name of state or input, such as ``{"x": "m"}``
    units: Mapping[str, str] = field(default_factory=dict)
    #: smallest inputs (m,); None where there is no limit
    input_lower: Any = None
    #: largest inputs (m,)
    input_upper: Any = None
    #: the input before the first step (m,), such as the one at rest; zero by default
    initial_input: Any = None
    #: where a flight begins (n,); on its reference by default
    start: Any = None
    #: the state that is held where no trajectory is followed (n,); zero by default
    goal: Any = None
    #: smallest and largest states that random data start from (2, n)
    region: Any = None
    #: states whose errors are taken within half a turn [rad]
    angles: Sequence[str] = ()
    #: states that a trajectory prescribes and errors are reported of, unit by unit; by
    #: default all in the unit of the first state
    tracked: Sequence[str] = ()
    #: for a state, the one that it is the time derivative of, such as ``{"vx": "x"}``:
    #: a model integrates that one, and references have both
    rates: Mapping[str, str] = field(default_factory=dict)
    #: a flight is not lost while its tracked states are nearer than this to their
    #: reference, in the unit of the first of them, or by unit such as ``{"m": 10.0,
    #: "rad": 1.5}``; with infinity only one that leaves the finite numbers is
    lost: float | Mapping[str, float] = inf
    #: from a trajectory, a count K and the time step to reference states (K, n), where
    #: a trajectory prescribes something other than tracked states
    references: Callable[[Trajectory, int, float], Array] | None = None
    #: states that say where it is in space and how it is turned, by x, y, z, roll,
    #: pitch, yaw, in m and rad; pictures show it there
    pose: Mapping[str, str] = field(default_factory=dict)
    #: whether the z axis of that space points downwards
    z_down: bool = False
    #: what is known of it before anything is learned, as a system with its states,
    #: inputs and time step; a model of differences learns what it misses
    nominal: "System | None" = None

    def __post_init__(self) -> None:
        check_number("time_step", self.time_step, above=0, unit="[s]")
        check_number("substeps", self.substeps, least=1, whole=True)
        if isinstance(self.dynamics, type):
            name = self.dynamics.__name__
            raise SettingError(
                "dynamics", f"must be an object, such as {name}(); got the class {name}"
            )
        states = _names(self.dynamics, "state_names")
        inputs = _names(self.dynamics, "input_names")
        for name in inputs:
            if name in states:
                rule = "must be no names of states"
                raise SettingError("dynamics.input_names", f"{rule}; got {name!r}")
        self._set("name", self.name or type(self.dynamics).__name__)
        self._complete_units((*states, *inputs))
        self._complete_tracked(states)
        self._check_lost()
        self._complete_vectors(states, inputs)
        self._check_nominal()
        self._check_dynamics()

    def _check_nominal(self) -> None:
        """Raises unless what is known before is a system of these signals, or None."""
        if self.nominal is None:
            return
        check_kind("nominal", self.nominal, System, "System(dynamics, time_step)")
        if self.nominal.signals != self.signals:
            raise SettingError(
                "nominal",
                f"must have the states, inputs and time step {self.signals}; "
                f"got {self.nominal.signals}",
            )

    def _complete_units(self, names: Sequence[str]) -> None:
        """Gives every state and input a unit."""
        _check_mapping("units", self.units)
        unknown = sorted({*self.units} - {*names})
        if unknown:
            raise SettingError(
                "units", f"must be of {', '.join(names)}; got {', '.join(unknown)}"
            )
        for name, unit in self.units.items():
            if not isinstance(unit, str):
                rule = "must be texts, such as 'm'"
                raise SettingError("units", f"{rule}; got {unit!r} of {name}")
        self._set("units", {name: self.units.get(name, UNKNOWN) for name in names})

    def _complete_tracked(self, states: Sequence[str]) -> None:
        """Says which states are tracked, and checks every setting that names states."""
        tracked = self.tracked
        if not tracked:
            unit = self.units[states[0]]
            tracked = [name for name in states if self.units[name] == unit]
        for key in ("angles", "tracked"):
            value = getattr(self, key)
            if isinstance(value, str) or not isinstance(value, Iterable):
                raise SettingError(key, f"must be a list of names; got {value!r}")
        _check_mapping("rates", self.rates)
        _check_mapping("pose", self.pose)
        self._set("rates", dict(self.rates))
        self._set("pose", dict(self.pose))
        self._set("angles", tuple(self.angles))
        self._set("tracked", tuple(tracked))
        for key, names in (
            ("angles", self.angles),
            ("tracked", self.tracked),
            ("rates", [*self.rates, *self.rates.values()]),
            ("pose", self.pose.values()),
        ):
            for name in names:
                if name not in states:
                    raise SettingError(
                        key, f"must name states, {', '.join(states)}; got {name!r}"
                    )
        self._check_rates()
        self._check_pose()

    def _check_pose(self) -> None:
        """Raises where a pose is in units that pictures in space do not have."""
        for axis, name in self.pose.items():
            unit = "m" if axis in ("x", "y", "z") else "rad"
            if self.units[name] not in (unit, UNKNOWN):
                raise SettingError(
                    "pose",
                    f"must be in m and rad; got {name} [{self.units[name]}] for {axis}",
                )

    def _check_rates(self) -> None:
        """Raises where a state has two rates, or is in the end its own."""
        for rate, position in self.rates.items():
            if list(self.rates.values()).count(position) > 1:
                raise SettingError(
                    "rates", f"must be one a state; got several of {position}"
                )
            integrals = [rate]
            while integrals[-1] in self.rates:
                integrals.append(self.rates[integrals[-1]])
                if integrals[-1] in integrals[:-1]:
                    chain = " of ".join(integrals)
                    raise SettingError(
                        "rates", f"must not go round in circles; got {chain}"
                    )

    def _check_lost(self) -> None:
        """Raises unless ``lost`` has positive distances of units that are tracked."""
        distances = self.lost
        if not isinstance(distances, Mapping):
            distances = {self.unit: distances}
        units = list(self.tracked_by_unit)
        for unit, distance in distances.items():
            if unit not in units:
                raise SettingError(
                    "lost",
                    f"must be of units of tracked states, {', '.join(units)}; "
                    f"got {unit!r}",
                )
            if distance != inf:
                check_number("lost", distance, above=0)

    def _complete_vectors(self, states: Sequence[str], inputs: Sequence[str]) -> None:
        """Turns limits, input, goal, start and region into tuples of floats."""
        n = len(states)
        m = len(inputs)
        self._set_floats("input_lower", inputs, default=(-inf,) * m)
        self._set_floats("input_upper", inputs, default=(inf,) * m)
        self._set_floats("initial_input", inputs, default=(0.0,) * m)
        self._set_floats("goal", states, default=(0.0,) * n)
        # A start that nobody gave is where the reference begins, which a flight knows.
        self._set_floats("start", states, default=None)
        limits = zip(self.input_lower, self.input_upper, strict=True)
        if any(lower > upper for lower, upper in limits):
            raise SettingError(
                "input_lower, input_upper",
                f"must not cross; got {self.input_lower, self.input_upper}",
            )
        if self.region is None:
            return
        if not hasattr(self.region, "__len__") or len(self.region) != 2:
            raise SettingError(
                "region",
                f"must be the smallest and the largest states; got {self.region!r}",
            )
        smallest = _floats("region", self.region[0], states)
        largest = _floats("region", self.region[1], states)
        if any(low > high for low, high in zip(smallest, largest, strict=True)):
            raise SettingError(
                "region", f"must not cross; got {smallest} and {largest}"
            )
        self._set("region", (smallest, largest))

    def _set_floats(self, key: str, names: Sequence[str], default: Any) -> None:
        """Replaces a list of numbers, one a name, by a tuple; None by the default."""
        values = getattr(self, key)
        self._set(key, default if values is None else _floats(key, values, names))

    def _set(self, key: str, value: Any) -> None:
        object.__setattr__(self, key, value)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the n states."""
        return tuple(self.dynamics.state_names)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the m inputs."""
        return tuple(self.dynamics.input_names)

    @cached_property
    def signals(self) -> Signals:
        """Names of states and inputs, and time step, as data and models carry them."""
        return Signals(self.state_names, self.input_names, self.time_step)

    @property
    def stateful(self) -> bool:
        """Whether it is a simulator under way, which a step moves on."""
        return getattr(self.dynamics, "stateful", False)

    @property
    def unit(self) -> str:
        """The unit of the first tracked state."""
        return self.units[self.tracked[0]]

    @cached_property
    def tracked_by_unit(self) -> dict[str, list[int]]:
        """Where the tracked states of each unit stand; ``unit`` is the first one."""
        by_unit: dict[str, list[int]] = {}
        for name in self.tracked:
            places = by_unit.setdefault(self.units[name], [])
            places.append(self.state_names.index(name))
        return by_unit

    def lost_from(self, unit: str) -> float:
        """Returns the distance up to which no flight is lost, in a unit of ``lost``."""
        if isinstance(self.lost, Mapping):
            return self.lost.get(unit, inf)
        return self.lost if unit == self.unit else inf

    @cached_property
    def tracked_indices(self) -> list[int]:
        """Where the tracked states stand."""
        return [self.state_names.index(name) for name in self.tracked]

    @cached_property
    def angle_indices(self) -> list[int]:
        """Where the angles stand."""
        return [self.state_names.index(name) for name in self.angles]

    def successor(self, x: Any, u: Any) -> list[Any]:
        """Returns the n entries of x[k+1], from the entries of x[k] and u[k].

        They may be floats, arrays or symbols.

        Raises:
            ShapeError: The dynamics have another number of entries than there are
                states.
        """
        if hasattr(self.dynamics, "successor"):
            return list(self._check_length("successor", self.dynamics.successor(x, u)))
        f = self.dynamics.derivative
        h = self.time_step / self.substeps
        n = len(self.dynamics.state_names)
        x = [x[i] for i in range(n)]
        for _ in range(self.substeps):
            k1 = self._check_length("derivative", f(x, u))
            k2 = f([x[i] + h / 2 * k1[i] for i in range(n)], u)
            k3 = f([x[i] + h / 2 * k2[i] for i in range(n)], u)
            k4 = f([x[i] + h * k3[i] for i in range(n)], u)
            x = [
                x[i] + h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]) for i in range(n)
            ]
        return x

    def reference_states(self, trajectory: Trajectory | None, count: int) -> Array:
        """Returns the states to follow (count, n), one per time step.

        They are the goal where there is no trajectory.

        Raises:
            ShapeError: The trajectory prescribes another number of states than are
                tracked.
        """
        if trajectory is None:
            return np.tile(np.array(self.goal), (count, 1))
        if self.references is not None:
            return self.references(trajectory, count, self.time_step)
        times = self.time_step * np.arange(count)
        positions = trajectory(times)
        states = np.tile(np.array(self.goal), (count, 1))
        if positions.shape[1:] != (len(self.tracked),):
            rule = f"must prescribe {', '.join(self.tracked)} of {self.name}"
            raise ShapeError(
                f"trajectory: {rule}; got positions of {positions.shape[-1]} numbers"
            )
        states[:, self.tracked_indices] = positions
        if self.rates:
            velocities = trajectory.velocity(times)
            for rate, position in self.rates.items():
                if position in self.tracked:
                    column = self.state_names.index(rate)
                    states[:, column] = velocities[:, self.tracked.index(position)]
        return states

    def _check_length(self, method: str, entries: Any) -> Any:
        n = len(self.dynamics.state_names)
        count: int | str = type(entries).__name__
        if hasattr(entries, "__len__"):
            count = len(entries)
        if count != n:
            raise ShapeError(
                f"{method} must give {n} entries, one for each of state_names; "
                f"got {count}"
            )
        return entries

    def _check_dynamics(self) -> None:
        """Evaluates the dynamics once, where the system starts.

        A simulator under way is left alone: a step would move it.
        """
        if not (
            hasattr(self.dynamics, "derivative") or hasattr(self.dynamics, "successor")
        ):
            rule = "must have derivative(x, u), or successor(x, u) for the next state"
            raise SettingError(
                "dynamics", f"{rule}; got {type(self.dynamics).__name__}"
            )
        if self.stateful:
            return
        x = list(self.goal if self.start is None else self.start)
        u = list(self.initial_input)
        try:
            entries = [float(entry) for entry in self.successor(x, u)]
        except GpmpcError:
            raise
        except Exception as error:
            if advice := dynamics_advice(error, ("torch",)):  # math takes floats
                raise SettingError("dynamics", advice) from error
            rule = f"must step from state {x} with input {u}"
            raise SettingError(
                "dynamics", f"{rule}; got {type(error).__name__}: {error}"
            ) from error
        for name, entry in zip(self.state_names, entries, strict=True):
            if not isfinite(entry):
                raise SettingError(
                    "dynamics",
                    f"must be finite at state {x}, input {u}; "
                    f"{name} is {entry} after it",
                )
        self._check_exchanged_rates(x, u)

    def _check_exchanged_rates(self, x: list[float], u: list[float]) -> None:
        """Raises where the dynamics show that a rate was taken for its position."""
        if not (self.rates and hasattr(self.dynamics, "derivative")):
            return
        nearby = [value + 0.01 * (i + 1) for i, value in enumerate(x)]
        try:
            slopes = [float(entry) for entry in self.dynamics.derivative(nearby, u)]
        except Exception:  # nothing is known of it there
            return
        for rate, position in self.rates.items():
            i = self.state_names.index(rate)
            j = self.state_names.index(position)
            if slopes[i] == nearby[j] and slopes[j] != nearby[i]:
                rule = "must map a rate to what it is the rate of"
                right = f"{{{position!r}: {rate!r}}}"
                raise SettingError("rates", f"{rule}, such as {right}; got exchanged")


@explains_arguments
def step(plant: System, state: Array, input: Array) -> Array:
    """Returns the next state (n,) of a plant from a state (n,) and an input (m,).

    >>> from gpmpc.systems import pendulum
    >>> step(pendulum(), [0.1, 0.0], [0.0]).round(3).tolist()
    [0.102, 0.074]

    Raises:
        ShapeError: State or input are of another length.
        DataError: They are no real numbers, or have other names than the plant's.
    """
    check_system("plant", plant)
    state_names = plant.dynamics.state_names
    input_names = plant.dynamics.input_names
    state = read_array("state", state, state_names)
    input = read_array("input", input, input_names)
    state_shape = (len(state_names),)
    input_shape = (len(input_names),)
    if np.shape(state) != state_shape or np.shape(input) != input_shape:
        raise ShapeError(
            f"state and input must have shapes {state_shape} and {input_shape}; "
            f"got {np.shape(state)} and {np.shape(input)}"
        )
    return np.array(plant.successor(state, input), dtype=float)


@explains_arguments
def step_many(plant: System, states: Array, inputs: Array) -> Array:
    """Returns the next states (T, n) of T copies of a plant, in one evaluation.

    Args:
        plant: What is stepped.
        states: (T, n).
        inputs: (T, m).

    Raises:
        ShapeError: States or inputs are no table, or have another size.
        DataError: They are no real numbers.

    >>> from gpmpc.systems import double_integrator
    >>> states = [[0.0, 1.0], [0.0, 2.0]]
    >>> step_many(double_integrator(), states, inputs=[[0.0], [0.0]]).tolist()
    [[0.1, 1.0], [0.2, 2.0]]
    """
    check_system("plant", plant)
    n = len(plant.state_names)
    m = len(plant.input_names)
    states = read_array("states", states, plant.state_names)
    inputs = read_array("inputs", inputs, plant.input_names)
    are_tables = states.ndim == inputs.ndim == 2
    if not are_tables or states.shape[1] != n or inputs.shape != (len(states), m):
        raise ShapeError(
            f"states and inputs must be (T, {n}) and (T, {m}); "
            f"got {states.shape} and {inputs.shape}"
        )
    entries = call_dynamics(plant.successor, states.T, inputs.T)
    columns = [
        np.broadcast_to(np.asarray(entry, dtype=float), len(states))
        for entry in entries
    ]
    return np.stack(columns, axis=1)


def check_system(key: str, value: Any) -> None:
    """Raises ``SettingError`` unless a value is a plant with dynamics."""
    if not hasattr(value, "dynamics"):
        rule = "must be a plant, such as System(dynamics, time_step)"
        raise SettingError(key, f"{rule}; got {type(value).__name__}")


def _check_mapping(key: str, value: Any) -> None:
    """Raises ``SettingError`` unless a value maps names."""
    if not isinstance(value, Mapping):
        raise SettingError(key, f"must map names, as {{name: ...}}; got {value!r}")


def _names(dynamics: Any, key: str) -> tuple[str, ...]:
    """Returns the names of the states or inputs of dynamics."""
    names = getattr(dynamics, key, None)
    is_list = isinstance(names, Sequence) and not isinstance(names, str)
    if (
        not is_list
        or not names
        or not all(isinstance(name, str) for name in names)
        or len(set(names)) < len(names)
    ):
        raise SettingError(
            f"dynamics.{key}", f"must be a list of different names; got {names!r}"
        )
    return tuple(names)


def _floats(key: str, values: Any, names: Sequence[str]) -> tuple[float, ...]:
    """Numbers as floats, one a name; None stays for an infinite bound."""
    length = len(names)
    if labels_of(values):
        values = read_array(key, values, names)
    values = values.tolist() if isinstance(values, np.ndarray) else values
    infinite = {"input_lower": -inf, "input_upper": inf}.get(key)
    finite = values
    if infinite is not None and isinstance(values, Sequence):
        values = [infinite if value is None else value for value in values]
        finite = [0.0 if value == infinite else value for value in values]
    check_numbers(key, finite, length)
    return tuple(float(value) for value in values)
