"""Kinematics: how the outputs of a model, such as accelerations, move a state.

Kinematics have nothing to learn. x[k+1] = step(x[k], y[k]) and y[k] = outputs(x[k],
x[k+1]) are inverse to each other as far as the outputs y reach. All functions take any
batch of states (..., n).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.models._quaternions import (
    quaternion_inverse,
    quaternion_product,
    rotate,
    rotation_quaternion,
    rotation_vector,
)
from gpmpc.models._state_space import StateSpace

GRAVITY = np.array([0.0, 0.0, -9.80665])  # [m/s2], world


@dataclass(frozen=True)
class Increments:
    """Kinematics of any system, whose outputs are the rates of change of its state."""

    space: StateSpace

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs: a rate of change for every entry of a difference."""
        return tuple(
            f"d_{entry}"
            for group in self.space.groups
            for entry in group.entries[: group.error_dim]
        )

    @property
    def output_groups(self) -> dict[str, tuple[int, ...]]:
        """Outputs that get a GP, or none, together."""
        groups = zip(self.space.groups, self.space.error_columns, strict=True)
        return {
            group.name: tuple(range(columns.start, columns.stop))
            for group, columns in groups
        }

    def step(self, states: Array, outputs: Array, time_step: float) -> Array:
        """Moves states (..., n) by rates of change (..., e) for a time step [s]."""
        return self.space.displace(states, outputs * time_step)

    def outputs(self, states: Array, next_states: Array, time: float) -> Array:
        """Returns the mean rates of change (..., e) within a time [s]."""
        return self.space.difference(next_states, states) / time

    def features(self, states: Array, inputs: Array, context: Array) -> Array:
        """Returns the features (..., d): states, inputs and context.

        Angles are replaced by their sines and cosines.
        """
        parts: list[Array] = []
        for group, columns in zip(self.space.groups, self.space.columns, strict=True):
            entries = states[..., columns]
            if group.kind == "angle":
                parts += [np.sin(entries), np.cos(entries)]
            else:
                parts.append(entries)
        return np.concatenate([*parts, inputs, context], axis=-1)

    def feature_names(
        self, inputs: Sequence[str], context: Sequence[str]
    ) -> tuple[str, ...]:
        """Returns the names of the features (d,), given those of inputs and context."""
        names: list[str] = []
        for group in self.space.groups:
            if group.kind == "angle":
                names += [f"sine of {entry}" for entry in group.entries]
                names += [f"cosine of {entry}" for entry in group.entries]
            else:
                names += group.entries
        return (*names, *inputs, *context)

    def coast(self, states: Array, time: float) -> Array:
        """Returns the states unchanged: which of them are velocities is not known."""
        return states


class _BodyState(NamedTuple):
    """The parts of the state of a rigid body."""

    position: Array  # (..., 3)
    attitude: Array  # (..., 4)
    velocity: Array  # (..., 3), world axes
    rate: Array  # (..., 3), body axes


def _body_state(states: Array) -> _BodyState:
    """Takes states (..., 13) apart."""
    return _BodyState(
        position=states[..., 0:3],
        attitude=states[..., 3:7],
        velocity=states[..., 7:10],
        rate=states[..., 10:13],
    )


@dataclass(frozen=True)
class RigidBodyKinematics:
    """Kinematics of a rigid body under forces and torques.

    The state is position, attitude (x, y, z, w), velocity in world axes, and angular
    rate in body axes. The outputs are the specific force f [m/s2] and the angular
    acceleration alpha [rad/s2], both in body axes:

        w+ = w + alpha dt,      q+ = q exp((w + alpha dt / 2) dt),
        v+ = v + (R f + g) dt,  p+ = p + v dt + (R f + g) dt^2 / 2

    with R the attitude in the middle of the step.

    See Also:
        ``LogModel``, which moves its states by them.
    """

    space: StateSpace
    output_names = ("fx", "fy", "fz", "alpha_x", "alpha_y", "alpha_z")

    @property
    def output_groups(self) -> dict[str, tuple[int, ...]]:
        """Outputs that get a GP, or none, together."""
        return {"force": (0, 1, 2), "torque": (3, 4, 5)}

    def step(self, states: Array, outputs: Array, time_step: float) -> Array:
        """Moves states (..., 13) by outputs (..., 6) for a time step [s]."""
        p, q, v, w = _body_state(states)
        force = outputs[..., 0:3]
        alpha = outputs[..., 3:6]
        half_turn = rotation_quaternion((w + alpha * (time_step / 2)) * (time_step / 2))
        middle = quaternion_product(q, half_turn)
        a = rotate(middle, force) + GRAVITY
        position = p + v * time_step + a * (time_step**2 / 2)
        attitude = quaternion_product(middle, half_turn)
        velocity = v + a * time_step
        rate = w + alpha * time_step
        return np.concatenate([position, attitude, velocity, rate], axis=-1)

    def outputs(self, states: Array, next_states: Array, time: float) -> Array:
        """Returns the mean outputs (..., 6) within a time [s].

        They are those of the changes of velocity and rate.
        """
        now = _body_state(states)
        after = _body_state(next_states)
        inverse = quaternion_inverse(now.attitude)
        turn = rotation_vector(quaternion_product(inverse, after.attitude))
        middle = quaternion_product(now.attitude, rotation_quaternion(turn / 2))
        acceleration = (after.velocity - now.velocity) / time
        force = rotate(quaternion_inverse(middle), acceleration - GRAVITY)
        alpha = (after.rate - now.rate) / time
        return np.concatenate([force, alpha], axis=-1)

    def features(self, states: Array, inputs: Array, context: Array) -> Array:
        """Returns the features (..., d), without position and heading.

        They are velocity and direction of gravity in body axes, rate, inputs and
        context.
        """
        body = _body_state(states)
        to_body = quaternion_inverse(body.attitude)
        velocity = rotate(to_body, body.velocity)
        up = np.broadcast_to(-GRAVITY / 9.80665, velocity.shape)
        tilt = rotate(to_body, up)[..., :2]
        return np.concatenate([velocity, tilt, body.rate, inputs, context], axis=-1)

    def feature_names(
        self, inputs: Sequence[str], context: Sequence[str]
    ) -> tuple[str, ...]:
        """Returns the names of the features (d,), given those of inputs and context."""
        velocity = [f"velocity along the body's {axis}" for axis in "xyz"]
        tilt = [f"gravity along the body's {axis}" for axis in "xy"]
        rate = [f"rate about the body's {axis}" for axis in "xyz"]
        return (*velocity, *tilt, *rate, *inputs, *context)

    def coast(self, states: Array, time: float) -> Array:
        """Moves states on at constant velocity and rate for a time [s]."""
        p, q, v, w = _body_state(states)
        turned = quaternion_product(q, rotation_quaternion(w * time))
        return np.concatenate([p + v * time, turned, v, w], axis=-1)


Kinematics = Increments | RigidBodyKinematics
