"""Kinematics: how outputs that a model learns, such as accelerations, move a state; exact, with nothing to learn.

x[k+1] = step(x[k], y[k]) and y[k] = outputs(x[k], x[k+1]) are inverse to each other as far as the outputs reach. All
functions take any batch of states (..., n).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpmpc.logs._state_space import (
    Array,
    StateSpace,
    quaternion_inverse,
    quaternion_product,
    rotate,
    rotation_quaternion,
    rotation_vector,
)

GRAVITY = np.array([0.0, 0.0, -9.80665])  # [m/s2], world


class Kinematics(Protocol):
    """How outputs move a state of a space: ``step`` and its inverse ``outputs`` [s].

    ``output_groups`` are learned, or not, together; ``features`` are what their GPs see (..., d), and ``coast`` goes on
    at constant velocities for a time [s].
    """

    @property
    def space(self) -> StateSpace: ...
    @property
    def output_names(self) -> tuple[str, ...]: ...
    @property
    def output_groups(self) -> dict[str, tuple[int, ...]]: ...
    def step(self, states: Array, outputs: Array, time_step: float) -> Array: ...
    def outputs(self, states: Array, next_states: Array, time: float) -> Array: ...
    def features(self, states: Array, inputs: Array, context: Array) -> Array: ...
    def coast(self, states: Array, time: float) -> Array: ...


@dataclass(frozen=True)
class Increments:
    """The outputs are the rates of change of every state, of any system."""

    space: StateSpace

    @property
    def output_names(self) -> tuple[str, ...]:
        """One rate of change for every entry of a difference."""
        return tuple(f"d_{entry}" for group in self.space.groups for entry in group.entries[: group.error_dim])

    @property
    def output_groups(self) -> dict[str, tuple[int, ...]]:
        groups = zip(self.space.groups, self.space.error_columns, strict=True)
        return {group.name: tuple(range(at.start, at.stop)) for group, at in groups}

    def step(self, states: Array, outputs: Array, time_step: float) -> Array:
        return self.space.displace(states, outputs * time_step)

    def outputs(self, states: Array, next_states: Array, time: float) -> Array:
        return self.space.difference(next_states, states) / time

    def features(self, states: Array, inputs: Array, context: Array) -> Array:
        """The states, of angles sine and cosine, inputs and context."""
        parts: list[Array] = []
        for group, at in zip(self.space.groups, self.space.columns, strict=True):
            own = states[..., at]
            parts += [np.sin(own), np.cos(own)] if group.kind == "angle" else [own]
        return np.concatenate([*parts, inputs, context], axis=-1)

    def coast(self, states: Array, time: float) -> Array:
        """The states themselves: nothing says which of them are velocities."""
        return states


@dataclass(frozen=True)
class RigidBody:
    """A rigid body: position, attitude (x, y, z, w), velocity in world axes, angular rate in body axes.

    The outputs are the specific force f [m/s2] and the angular acceleration alpha [rad/s2], both in body axes:

        w+ = w + alpha dt,      q+ = q exp((w + alpha dt / 2) dt),
        v+ = v + (R f + g) dt,  p+ = p + v dt + (R f + g) dt^2 / 2

    with R the attitude in the middle of the step.
    """

    space: StateSpace
    output_names = ("fx", "fy", "fz", "alpha_x", "alpha_y", "alpha_z")

    @property
    def output_groups(self) -> dict[str, tuple[int, ...]]:
        return {"force": (0, 1, 2), "torque": (3, 4, 5)}

    def step(self, states: Array, outputs: Array, time_step: float) -> Array:
        p, q, v, w = states[..., 0:3], states[..., 3:7], states[..., 7:10], states[..., 10:13]
        force, alpha = outputs[..., 0:3], outputs[..., 3:6]
        half_turn = rotation_quaternion((w + alpha * (time_step / 2)) * (time_step / 2))
        middle = quaternion_product(q, half_turn)
        a = rotate(middle, force) + GRAVITY
        parts = [p + v * time_step + a * (time_step**2 / 2), quaternion_product(middle, half_turn)]
        return np.concatenate([*parts, v + a * time_step, w + alpha * time_step], axis=-1)

    def outputs(self, states: Array, next_states: Array, time: float) -> Array:
        """The mean force and angular acceleration of the changes of velocity and rate."""
        q, after = states[..., 3:7], next_states[..., 3:7]
        turn = rotation_vector(quaternion_product(quaternion_inverse(q), after))
        middle = quaternion_product(q, rotation_quaternion(turn / 2))
        a = (next_states[..., 7:10] - states[..., 7:10]) / time - GRAVITY
        force = rotate(quaternion_inverse(middle), a)
        return np.concatenate([force, (next_states[..., 10:13] - states[..., 10:13]) / time], axis=-1)

    def features(self, states: Array, inputs: Array, context: Array) -> Array:
        """Velocity and direction of gravity in body axes, rate, inputs and context, without place and heading."""
        to_body = quaternion_inverse(states[..., 3:7])
        down = rotate(to_body, np.broadcast_to(-GRAVITY / 9.80665, states[..., 0:3].shape))
        parts = [rotate(to_body, states[..., 7:10]), down[..., :2], states[..., 10:13]]
        return np.concatenate([*parts, inputs, context], axis=-1)

    def coast(self, states: Array, time: float) -> Array:
        p, q, v, w = states[..., 0:3], states[..., 3:7], states[..., 7:10], states[..., 10:13]
        return np.concatenate([p + v * time, quaternion_product(q, rotation_quaternion(w * time)), v, w], axis=-1)
