"""Discrete-time plants made from right-hand sides f(x, u), for controllers and simulations to step.

There are two readings. ``Map`` takes the next state to *be* the
right-hand side, x[k+1] = f(x[k], u[k]); this is what the data of Cao, Lai and Alam (2017) obey to 1e-6. ``Integrated``
integrates the same right-hand side over the sampling time with the input held constant, which is the physical system.

A right-hand side is written once, with plain arithmetic on the entries of x and u, so that floats, NumPy arrays and
CasADi expressions all pass through the same formula.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gpmpc.exceptions import SettingError, ShapeError, check_number


class Dynamics(Protocol):
    """A continuous-time right-hand side f(x, u) with named states and inputs."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the n states, in order."""
        ...

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the m inputs, in order."""
        ...

    def derivative(self, x: Any, u: Any) -> Sequence[Any]:
        """The n entries of f(x, u), from anything that is indexed from 0 and knows arithmetic."""
        ...


class Plant(Protocol):
    """A discrete-time system."""

    @property
    def dynamics(self) -> Dynamics:
        """Right-hand side, with the names of states and inputs."""
        ...

    @property
    def time_step(self) -> float:
        """Time of one step [s]."""
        ...

    def successor(self, x: Any, u: Any) -> Sequence[Any]:
        """The n entries of x[k+1], symbolic or numeric, like ``Dynamics.derivative``."""
        ...


@dataclass(frozen=True)
class Map:
    """The paper's reading: x[k+1] = f(x[k], u[k]).

    Attributes:
        dynamics: The right-hand side f.
        time_step: Time that one step stands for [s]; it labels the axis and does not enter the equations.

    Raises:
        SettingError: The time step is not positive, or the right-hand side means nothing as a map.
    """

    dynamics: Dynamics
    time_step: float = 1.0  # [s]

    def __post_init__(self) -> None:
        check_number("time_step", self.time_step, above=0, unit="[s]")
        if getattr(self.dynamics, "integrated_only", False):
            raise SettingError("plant", f"{type(self.dynamics).__name__} means nothing as a map; take Integrated")

    def successor(self, x: Any, u: Any) -> list[Any]:
        """x[k+1] = f(x[k], u[k])."""
        return list(self.dynamics.derivative(x, u))


@dataclass(frozen=True)
class Integrated:
    """The physical reading: f integrated over the sampling time, the input held constant (zero-order hold).

    Classical Runge-Kutta of order four on equal substeps; exact for the translational quadrotor, whose acceleration
    depends on the input alone.

    Attributes:
        dynamics: The right-hand side f.
        time_step: Sampling time [s].
        substeps: Runge-Kutta steps a sampling time.

    Raises:
        SettingError: The time step is not positive, or there is no substep.
        ShapeError: (at a step) The derivative has another number of entries than there are states.
    """

    dynamics: Dynamics
    time_step: float = 1.0  # [s]
    substeps: int = 10

    def __post_init__(self) -> None:
        check_number("time_step", self.time_step, above=0, unit="[s]")
        check_number("substeps", self.substeps, least=1, whole=True)

    def successor(self, x: Any, u: Any) -> list[Any]:
        """x[k+1] = x[k] + the integral of f(x(t), u[k]) over one sampling time."""
        f, h = self.dynamics.derivative, self.time_step / self.substeps
        n = len(self.dynamics.state_names)
        x = [x[i] for i in range(n)]
        for _ in range(self.substeps):
            k1 = f(x, u)
            if hasattr(k1, "__len__") and len(k1) != n:
                raise ShapeError(f"derivative must give {n} entries, one for each of state_names; got {len(k1)}")
            k2 = f([x[i] + h / 2 * k1[i] for i in range(n)], u)
            k3 = f([x[i] + h / 2 * k2[i] for i in range(n)], u)
            k4 = f([x[i] + h * k3[i] for i in range(n)], u)
            x = [x[i] + h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]) for i in range(n)]
        return x


def step(plant: Plant, state: np.ndarray, input: np.ndarray) -> np.ndarray:
    """The next state (n,) of a plant from a state (n,) and an input (m,).

    Raises:
        ShapeError: State or input are of another length.
    """
    shapes = ((len(plant.dynamics.state_names),), (len(plant.dynamics.input_names),))
    if (np.shape(state), np.shape(input)) != shapes:
        raise ShapeError(
            f"state and input must have shapes {shapes[0]} and {shapes[1]}; got {np.shape(state)} and {np.shape(input)}"
        )
    return np.array(plant.successor(state, input), dtype=float)


def step_many(plant: Plant, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """The next states (T, n) of T copies of a plant, from states (T, n) and inputs (T, m), in one evaluation."""
    entries = plant.successor(states.T, inputs.T)
    return np.stack([np.broadcast_to(np.asarray(entry, dtype=float), len(states)) for entry in entries], axis=1)
