"""Describes a system that is controlled: how it moves, what its states and inputs are called, how it is flown."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, isfinite
from typing import Any, cast

import numpy as np

from gpmpc._arrays import labels_of, read_array
from gpmpc._functions import call_dynamics, dynamics_advice
from gpmpc.exceptions import (
    GpmpcError,
    SettingError,
    ShapeError,
    check_number,
    check_numbers,
)
from gpmpc.signals import Signals
from gpmpc.trajectories import Trajectory

Array = np.ndarray
GRAVITY = 9.81  # [m/s^2]
UNKNOWN = "?"  # the unit of a state or an input that has none given


@dataclass(frozen=True, eq=False)
class System:
    """A discrete-time system; whatever a run, a report, a recording or a figure says of it comes from here.

    Its ``dynamics`` have the names of the n states and m inputs, in order (``state_names``, ``input_names``), and one
    method of two: ``derivative(x, u)``, the n entries of dx/dt, or ``successor(x, u)``, those of the next state. They
    are written once, with plain arithmetic on the entries of x and u, so that floats, NumPy arrays and CasADi
    expressions all pass through the same formula; ``sin``, ``cos`` and ``exp`` are for all of them. A right-hand side
    is integrated with the input held constant, by the Runge-Kutta method of order four on equal substeps.

    Raises:
        SettingError: A number out of range, an unknown name, tracked states of several units, or dynamics without a
            finite value where the system starts.
        ShapeError: A list has another length than there are states or inputs, or the dynamics have.
    """

    dynamics: Any  #: names of states and inputs, and how it moves
    time_step: float = cast(float, None)  #: sampling time [s]; it has to be said
    substeps: int = 10  #: Runge-Kutta steps per sampling time
    name: str = ""  #: what it is called; by default as the class of its dynamics
    units: Mapping[str, str] = field(
        default_factory=dict
    )  #: by name of state or input, such as ``{"x": "m"}``
    input_lower: Any = None  #: smallest inputs (m,); None where there is no limit
    input_upper: Any = None  #: largest inputs (m,)
    initial_input: Any = None  #: the input before the first step (m,), such as the one at rest; zero by default
    start: Any = None  #: where a flight begins (n,); on its reference by default
    goal: Any = None  #: the state that is held where no trajectory is followed (n,); zero by default
    region: Any = (
        None  #: smallest and largest states that random data start from (2, n)
    )
    angles: Sequence[
        str
    ] = ()  #: states whose errors are taken within half a turn [rad]
    #: states that a trajectory prescribes and errors are reported of, in one unit; by default all in that of the first
    tracked: Sequence[str] = ()
    #: for a state, the tracked one that it is the time derivative of, such as ``{"vx": "x"}``
    rates: Mapping[str, str] = field(default_factory=dict)
    #: a flight is not lost while its tracked states are nearer than this to their reference, in their unit; with
    #: infinity only one that leaves the finite numbers is
    lost: float = inf
    #: from a trajectory, a count K and the time step to reference states (K, n), where a trajectory prescribes
    #: something other than tracked states
    references: Callable[[Trajectory, int, float], Array] | None = None
    #: states that say where it is in space and how it is turned, by x, y, z, roll, pitch, yaw; pictures show it there
    pose: Mapping[str, str] = field(default_factory=dict)
    z_down: bool = False  #: whether the z axis of that space points downwards
    #: what is known of it before anything is learned, as a system with its states, inputs and time step; a model of
    #: differences learns what it misses
    nominal: "System | None" = None

    def __post_init__(self) -> None:
        check_number("time_step", self.time_step, above=0, unit="[s]")
        check_number("substeps", self.substeps, least=1, whole=True)
        states, inputs = (
            _names(self.dynamics, key) for key in ("state_names", "input_names")
        )
        n = len(states)
        m = len(inputs)
        every = (*states, *inputs)
        self._set("name", self.name or type(self.dynamics).__name__)
        if unknown := set(self.units) - {*every}:
            raise SettingError(
                "units",
                f"must be of {', '.join(every)}; got {', '.join(sorted(unknown))}",
            )
        self._set("units", {name: self.units.get(name, UNKNOWN) for name in every})
        tracked = self.tracked or [
            name for name in states if self.units[name] == self.units[states[0]]
        ]
        for key, names in (("angles", self.angles), ("tracked", tracked)):
            self._set(key, tuple(names))
        named = {
            "angles": self.angles,
            "tracked": self.tracked,
            "rates": self.rates,
            "pose": self.pose.values(),
        }
        for key, names in named.items():
            for name in names:
                if name not in states:
                    raise SettingError(
                        key, f"must name states, {', '.join(states)}; got {name!r}"
                    )
        for name in self.rates.values():
            if name not in self.tracked:
                raise SettingError(
                    "rates",
                    f"must be of tracked states, {', '.join(self.tracked)}; got {name!r}",
                )
        if len(found := {self.units[name] for name in self.tracked}) > 1:
            raise SettingError(
                "tracked", f"must be states of one unit; got {', '.join(sorted(found))}"
            )
        if self.lost != inf:
            check_number("lost", self.lost, above=0)
        for key, default, names in (
            ("input_lower", (-inf,) * m, inputs),
            ("input_upper", (inf,) * m, inputs),
            ("initial_input", (0.0,) * m, inputs),
            ("goal", (0.0,) * n, states),
        ):
            given = getattr(self, key)
            self._set(key, default if given is None else _floats(key, given, names))
        if any(
            low > high
            for low, high in zip(self.input_lower, self.input_upper, strict=True)
        ):
            raise SettingError(
                "input_lower, input_upper",
                f"must not cross; got {self.input_lower, self.input_upper}",
            )
        if self.start is not None:
            self._set("start", _floats("start", self.start, states))
        if self.region is not None:
            if len(self.region) != 2:
                raise SettingError(
                    "region",
                    f"must be the smallest and the largest states; got {self.region!r}",
                )
            self._set(
                "region", tuple(_floats("region", side, states) for side in self.region)
            )
        if self.nominal is not None and self.nominal.signals != self.signals:
            rule = f"must have the states, inputs and time step {self.signals}"
            raise SettingError("nominal", f"{rule}; got {self.nominal.signals}")
        self._check_dynamics()

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
        """Names of states and inputs, and time step: what data and models of it carry."""
        return Signals(self.state_names, self.input_names, self.time_step)

    @property
    def stateful(self) -> bool:
        """Whether it is a simulator under way, which a step moves on."""
        return getattr(self.dynamics, "stateful", False)

    @property
    def unit(self) -> str:
        """The unit of the tracked states."""
        return self.units[self.tracked[0]]

    @cached_property
    def tracked_indices(self) -> list[int]:
        """Where the tracked states stand."""
        return [self.state_names.index(name) for name in self.tracked]

    @cached_property
    def angle_indices(self) -> list[int]:
        """Where the angles stand."""
        return [self.state_names.index(name) for name in self.angles]

    def successor(self, x: Any, u: Any) -> list[Any]:
        """The n entries of x[k+1], from the entries of x[k] and u[k]: floats, arrays, or symbols.

        Raises:
            ShapeError: The dynamics have another number of entries than there are states.
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
        """Computes the states to follow (count, n), one per time step; the goal where there is no trajectory.

        Raises:
            ShapeError: The trajectory prescribes another number of states than are tracked.
        """
        if trajectory is None:
            return np.tile(np.array(self.goal), (count, 1))
        if self.references is not None:
            return self.references(trajectory, count, self.time_step)
        times = self.time_step * np.arange(count)
        positions = trajectory(times)
        states = np.tile(np.array(self.goal), (count, 1))
        if positions.shape[1:] != (len(self.tracked),):
            what = f"must prescribe {', '.join(self.tracked)} of {self.name}"
            raise ShapeError(
                f"trajectory: {what}; got positions of {positions.shape[-1]} numbers"
            )
        states[:, self.tracked_indices] = positions
        if self.rates:
            velocities = trajectory.velocity(times)
            for name, of in self.rates.items():
                states[:, self.state_names.index(name)] = velocities[
                    :, self.tracked.index(of)
                ]
        return states

    def _check_length(self, method: str, entries: Any) -> Any:
        got = len(entries) if hasattr(entries, "__len__") else type(entries).__name__
        if got != (n := len(self.dynamics.state_names)):
            raise ShapeError(
                f"{method} must give {n} entries, one for each of state_names; got {got}"
            )
        return entries

    def _check_dynamics(self) -> None:
        """Evaluates the dynamics once, where the system starts; a simulator under way a step would move."""
        if not (
            hasattr(self.dynamics, "derivative") or hasattr(self.dynamics, "successor")
        ):
            what = "must have derivative(x, u), or successor(x, u) for the next state"
            raise SettingError(
                "dynamics", f"{what}; got {type(self.dynamics).__name__}"
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
            what = f"must step from state {x} with input {u}"
            raise SettingError(
                "dynamics", f"{what}; got {type(error).__name__}: {error}"
            ) from error
        for name, entry in zip(self.state_names, entries, strict=True):
            if not isfinite(entry):
                raise SettingError(
                    "dynamics",
                    f"must be finite at state {x}, input {u}; {name} is {entry} after it",
                )


def step(plant: System, state: Array, input: Array) -> Array:
    """The next state (n,) of a plant from a state (n,) and an input (m,).

    >>> from gpmpc.systems import pendulum
    >>> step(pendulum(), [0.1, 0.0], [0.0]).round(3).tolist()
    [0.102, 0.074]

    Raises:
        ShapeError: State or input are of another length.
        DataError: They are no real numbers, or have other names than the plant's.
    """
    names = plant.dynamics.state_names, plant.dynamics.input_names
    state = read_array("state", state, names[0])
    input = read_array("input", input, names[1])
    shapes = ((len(names[0]),), (len(names[1]),))
    if (found := (np.shape(state), np.shape(input))) != shapes:
        raise ShapeError(
            f"state and input must have shapes {shapes[0]} and {shapes[1]}; got {found[0]} and {found[1]}"
        )
    return np.array(plant.successor(state, input), dtype=float)


def step_many(plant: System, states: Array, inputs: Array) -> Array:
    """The next states (T, n) of T copies of a plant, from states (T, n) and inputs (T, m), in one evaluation."""
    entries = call_dynamics(plant.successor, states.T, inputs.T)
    return np.stack(
        [
            np.broadcast_to(np.asarray(entry, dtype=float), len(states))
            for entry in entries
        ],
        axis=1,
    )


def sin(angle: Any) -> Any:
    """Sine of a float, an array, or whatever knows its own (CasADi, torch)."""
    return angle.sin() if hasattr(angle, "sin") else np.sin(angle)


def cos(angle: Any) -> Any:
    """Cosine of a float, an array, or whatever knows its own (CasADi, torch)."""
    return angle.cos() if hasattr(angle, "cos") else np.cos(angle)


def exp(value: Any) -> Any:
    """Exponential of a float, an array, or whatever knows its own (CasADi, torch)."""
    return value.exp() if hasattr(value, "exp") else np.exp(value)


def _names(dynamics: Any, key: str) -> tuple[str, ...]:
    names = getattr(dynamics, key, None)
    listed = isinstance(names, Sequence) and not isinstance(names, str)
    if (
        not listed
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
