"""Positions that a system is to follow, as functions of time.

Every trajectory is called with times t [s] of any shape and returns positions (..., d),
one for each tracked state of the system, in its unit; ``velocity`` returns their time
derivative (..., d). ``Elliptical`` and ``Lorenz``, with d = 3, are those of Cao, Lai
and Alam (2017), section 5, decoded from the authors' data (the paper's z axis points
downwards); the others are for everyday use and have any d.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.integrate import RK45, OdeSolution
from scipy.interpolate import PchipInterpolator

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, check_number, check_numbers


class Trajectory(Protocol):
    """A position over time."""

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Positions (..., d) at times (...) [s]."""
        ...

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Velocities (..., d) at times (...) [s]."""
        ...


@explains_arguments
@dataclass(frozen=True)
class Elliptical:
    """The paper's helix: x = a sin(w t), y = b cos(w t), z = z0 + c t.

    >>> Elliptical()(0.0).tolist(), Elliptical().velocity(0.0).tolist()
    ([0.0, 15.0, -5.0], [1.5, -0.0, -0.25])
    """

    radius_x: float = 15.0  #: semi-axis a [m]
    radius_y: float = 15.0  #: semi-axis b [m]
    rate: float = 0.1  #: angular rate w [rad/s]
    start_z: float = -5.0  #: z0 [m]
    climb_rate: float = -0.25  #: c [m/s], negative upwards because z points down

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            check_number(key, value)

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Positions (..., 3) [m] at times (...) [s]."""
        t = np.asarray(time, dtype=float)
        x = self.radius_x * np.sin(self.rate * t)
        y = self.radius_y * np.cos(self.rate * t)
        return np.stack([x, y, self.start_z + self.climb_rate * t], axis=-1)

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Velocities (..., 3) [m/s] at times (...) [s]."""
        t = np.asarray(time, dtype=float)
        angle = self.rate * t
        along_x = self.radius_x * self.rate * np.cos(angle)
        along_y = -self.radius_y * self.rate * np.sin(angle)
        return np.stack([along_x, along_y, np.full_like(t, self.climb_rate)], axis=-1)


@explains_arguments
@dataclass(frozen=True)
class Lorenz:
    """The paper's chaotic path.

    (0.7 X, -0.7 Y, Z) of the Lorenz system (Lorenz, 1963, eqs. (25)-(27)).

    The authors sampled an adaptive Dormand-Prince 5(4) integration at its natural
    output points, four a step, so equal steps of flight time are unequal steps of
    Lorenz time. Between samples the flight follows the integrator's dense output,
    Lorenz time running linearly from one sample to the next.
    """

    sigma: float = 10.0  #: Prandtl number of the Lorenz system
    rho: float = 28.0  #: Rayleigh number of the Lorenz system
    beta: float = 8 / 3  #: geometric factor of the Lorenz system
    start: tuple[float, float, float] = (-1.79, -3.13, 12.74)  #: (X, Y, Z) at time zero
    scale: tuple[float, float, float] = (
        0.7,
        -0.7,
        1.0,
    )  #: factors from (X, Y, Z) to metres [m]
    relative_tolerance: float = (
        1e-3  #: of the adaptive integration; it sets the sampling
    )
    samples_per_step: int = 4  #: output points of one accepted integration step
    sampling_time: float = 1.0  #: flight time from one output point to the next [s]
    duration: float = 400.0  #: flight time that the trajectory is defined for [s]

    def __post_init__(self) -> None:
        for key in ("sigma", "rho", "beta"):
            check_number(key, getattr(self, key))
        for key in ("start", "scale"):
            check_numbers(key, getattr(self, key), 3)
        check_number("samples_per_step", self.samples_per_step, least=1, whole=True)
        for key in ("relative_tolerance", "sampling_time", "duration"):
            check_number(key, getattr(self, key), above=0)

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Positions (..., 3) [m] at times (...) [s]."""
        return self._state(self._lorenz_time(time)[0]) * np.array(self.scale)

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Returns velocities (..., 3) [m/s] at times (...) [s].

        At a sample it is that of the interval that begins there.
        """
        lorenz_time, speed = self._lorenz_time(time)
        rate = np.moveaxis(
            self._derivative(0.0, np.moveaxis(self._state(lorenz_time), -1, 0)), 0, -1
        )
        return rate * speed[..., None] * np.array(self.scale)

    def _derivative(self, _: float, state: np.ndarray) -> np.ndarray:
        x, y, z = state
        return np.array(
            [self.sigma * (y - x), x * (self.rho - z) - y, x * y - self.beta * z]
        )

    @cached_property
    def _path(self) -> OdeSolution:
        """The dense output of every accepted step."""
        solver = RK45(
            self._derivative,
            0.0,
            np.array(self.start),
            np.inf,
            rtol=self.relative_tolerance,
            atol=1e-6,
        )
        ends = [0.0]
        pieces = []
        for _ in range(
            int(np.ceil(self.duration / self.sampling_time / self.samples_per_step))
        ):
            solver.step()
            ends.append(solver.t)
            pieces.append(solver.dense_output())
        return OdeSolution(ends, pieces)

    @cached_property
    def _samples(self) -> np.ndarray:
        """Lorenz times of the samples."""
        ends = self._path.ts
        each = self.samples_per_step
        return np.interp(
            np.arange(each * (len(ends) - 1) + 1) / each, np.arange(len(ends)), ends
        )

    def _state(self, lorenz_time: np.ndarray) -> np.ndarray:
        return np.reshape(
            [self._path(t) for t in np.ravel(lorenz_time)], (*np.shape(lorenz_time), 3)
        )

    def _lorenz_time(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lorenz time at flight times, and its rate of change."""
        t = np.asarray(time, dtype=float)
        if not ((t >= 0) & (t <= self.duration)).all():
            rule = f"this Lorenz trajectory is defined from 0 to {self.duration:g} s"
            raise SettingError("duration", f"{rule}; got {t.min():g} to {t.max():g} s")
        samples = self._samples
        position = t / self.sampling_time
        index = np.minimum(position.astype(int), len(samples) - 2)
        spacing = samples[index + 1] - samples[index]
        return samples[index] + (
            position - index
        ) * spacing, spacing / self.sampling_time


@explains_arguments
@dataclass(frozen=True)
class Step:
    """A jump from one position to another."""

    before: Sequence[float] = (0.0, 0.0, 0.0)  #: position until the jump (d,)
    after: Sequence[float] = (1.0, 1.0, -1.0)  #: position from the jump on (d,)
    at: float = 0.0  #: time of the jump [s]

    def __post_init__(self) -> None:
        check_number("at", self.at)
        _check_positions("before, after", [self.before, self.after])

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Positions (..., d) at times (...) [s]."""
        return np.where(
            np.asarray(time)[..., None] >= self.at,
            np.array(self.after, float),
            self.before,
        )

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Zero (..., d): the jump has no velocity."""
        return np.zeros((*np.shape(time), len(self.after)))


@explains_arguments
@dataclass(frozen=True)
class Hover:
    """One position, held."""

    position: Sequence[float] = (0.0, 0.0, 0.0)  #: where (d,)

    def __post_init__(self) -> None:
        _check_positions("position", [self.position])

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Positions (..., d) at times (...) [s]."""
        return np.tile(np.asarray(self.position, dtype=float), (*np.shape(time), 1))

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Zero (..., d)."""
        return np.zeros((*np.shape(time), len(self.position)))


@explains_arguments
@dataclass(frozen=True)
class Waypoints:
    """A smooth path through given positions at given times.

    The first and the last one are held outside.

    A monotone cubic (Fritsch and Carlson, 1980) per coordinate: it passes every
    waypoint and overshoots none.

    >>> path = Waypoints(times=[0.0, 10.0], positions=[[0.0, 0.0], [4.0, 2.0]])
    >>> path(5.0).round(3).tolist()
    [2.0, 1.0]
    """

    times: Sequence[float]  #: strictly increasing times of the waypoints [s]
    positions: Sequence[Sequence[float]]  #: one position (d,) per time

    def __post_init__(self) -> None:
        _check_positions("positions", self.positions)
        got = f"{len(self.times)} times, {len(self.positions)} positions"
        if not 2 <= len(self.times) == len(self.positions):
            raise SettingError(
                "times", f"must be two or more, one a position; got {got}"
            )
        if not np.all(np.diff(np.asarray(self.times, dtype=float)) > 0):
            raise SettingError(
                "times", f"must be strictly increasing [s]; got {list(self.times)}"
            )

    @cached_property
    def _path(self) -> PchipInterpolator:
        return PchipInterpolator(
            np.asarray(self.times, dtype=float), np.asarray(self.positions, dtype=float)
        )

    def __call__(self, time: np.ndarray) -> np.ndarray:
        """Positions (..., d) at times (...) [s]."""
        return self._path(np.clip(time, self.times[0], self.times[-1]))

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """Returns velocities (..., d) at times (...) [s].

        They are zero before the first and after the last waypoint.
        """
        t = np.asarray(time, dtype=float)
        inside = (t >= self.times[0]) & (t <= self.times[-1])
        return (
            self._path.derivative()(np.clip(t, self.times[0], self.times[-1]))
            * inside[..., None]
        )


def states_along(trajectory: Trajectory, time: np.ndarray) -> np.ndarray:
    """Returns translational states x, vx, y, vy, z, vz (..., 6) [m, m/s].

    They are those of a flight along a trajectory at times (...) [s].

    Raises:
        SettingError: The trajectory has no velocity, or not three coordinates.
    """
    if not hasattr(trajectory, "velocity"):
        rule = "must have positions over time and the method velocity(time)"
        raise SettingError("trajectory", f"{rule}; got {trajectory!r}")
    positions = trajectory(time)
    if positions.shape[-1] != 3:
        rule = "must have positions (..., 3), x, y and z"
        raise SettingError("trajectory", f"{rule}; got {positions.shape[-1]} entries")
    return np.stack([positions, trajectory.velocity(time)], axis=-1).reshape(
        *positions.shape[:-1], 6
    )


def _check_positions(key: str, positions: Sequence[Sequence[float]]) -> None:
    """Raises unless all are lists of one length of finite numbers."""
    for position in positions:
        length = (
            len(positions[0])
            if hasattr(positions[0], "__len__") and len(positions[0])
            else -1
        )
        try:
            check_numbers(key, position, length)
        except SettingError:
            what = (
                "a position is a list of finite numbers, one per tracked state, "
                "and all have one length"
            )
            raise SettingError(key, f"{what}; got {position}") from None
