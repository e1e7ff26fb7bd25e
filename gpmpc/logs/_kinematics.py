"""State spaces made of vectors, angles and unit quaternions, and how outputs that a model learns move a state.

The difference of two states is taken in the tangent space (Sola, Deray and Atchuthan, 2018): a vector's is the ordinary
one, an angle's is wrapped to [-pi, pi], and an attitude's is the rotation vector log(q_b^-1 q_a) in the body frame, so
a quaternion of four numbers has an error of three. Quaternions are scalar last (x, y, z, w), body to world.

Kinematics have nothing to learn: x[k+1] = step(x[k], y[k]) and y[k] = outputs(x[k], x[k+1]) are inverse to each other
as far as the outputs y, such as accelerations, reach. All functions take any batch of states (..., n).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gpmpc._angles import wrap

Array = NDArray[np.float64]
GRAVITY = np.array([0.0, 0.0, -9.80665])  # [m/s2], world


@dataclass(frozen=True)
class StateGroup:
    """Entries of a state that are measured together and judged by one error."""

    name: str  #: such as "position"
    entries: tuple[str, ...]  #: names of the entries; four of a quaternion, x, y, z, w
    unit: str = ""  #: of the entries; a quaternion's errors are in rad
    kind: Literal["vector", "angle", "quaternion"] = (
        "vector"  #: how differences are taken
    )

    @property
    def error_dim(self) -> int:
        """Number of entries of a difference: three of a quaternion."""
        return 3 if self.kind == "quaternion" else len(self.entries)


@dataclass(frozen=True)
class StateSpace:
    """A state (n,) made of groups, one after the other, with errors (e,)."""

    groups: tuple[StateGroup, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(entry for group in self.groups for entry in group.entries)

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Where each group stands in a state."""
        return _slices([len(group.entries) for group in self.groups])

    @cached_property
    def error_columns(self) -> tuple[slice, ...]:
        """Where each group stands in a difference."""
        return _slices([group.error_dim for group in self.groups])

    @cached_property
    def angles(self) -> tuple[int, ...]:
        """Which entries of a state are angles."""
        pairs = zip(self.groups, self.columns, strict=True)
        columns = [at for group, at in pairs if group.kind == "angle"]
        return tuple(entry for at in columns for entry in range(at.start, at.stop))

    @property
    def dim(self) -> int:
        """Number of entries of a state, n."""
        return self.columns[-1].stop

    @property
    def error_dim(self) -> int:
        """Number of entries of a difference, e."""
        return self.error_columns[-1].stop

    def difference(self, a: Array, b: Array) -> Array:
        """Computes a - b (..., e) of states (..., n)."""
        parts = []
        for group, at in zip(self.groups, self.columns, strict=True):
            one = a[..., at]
            other = b[..., at]
            if group.kind == "quaternion":
                parts.append(
                    rotation_vector(quaternion_product(quaternion_inverse(other), one))
                )
            else:
                parts.append(
                    wrap(one - other) if group.kind == "angle" else one - other
                )
        return np.concatenate(parts, axis=-1)

    def displace(self, state: Array, error: Array) -> Array:
        """Computes the state (..., n) whose difference from ``state`` is ``error`` (..., e)."""
        parts = []
        for group, at, error_at in zip(
            self.groups, self.columns, self.error_columns, strict=True
        ):
            one = state[..., at]
            by = error[..., error_at]
            if group.kind == "quaternion":
                parts.append(quaternion_product(one, rotation_quaternion(by)))
            else:
                parts.append(wrap(one + by) if group.kind == "angle" else one + by)
        return np.concatenate(parts, axis=-1)

    def distances(self, errors: Array) -> Array:
        """Computes the Euclidean or geodesic length of each group's error (..., groups) of errors (..., e)."""
        return np.stack(
            [np.linalg.norm(errors[..., at], axis=-1) for at in self.error_columns],
            axis=-1,
        )


def _slices(lengths: Sequence[int]) -> tuple[slice, ...]:
    ends = np.cumsum(lengths).tolist()
    return tuple(
        slice(end - length, end) for end, length in zip(ends, lengths, strict=True)
    )


# scipy's Rotation does the same, several times slower for the small batches of a rollout's step.
def quaternion_product(a: Array, b: Array) -> Array:
    """Computes the Hamilton product (..., 4) of quaternions (x, y, z, w)."""
    ax = a[..., 0]
    ay = a[..., 1]
    az = a[..., 2]
    aw = a[..., 3]
    bx = b[..., 0]
    by = b[..., 1]
    bz = b[..., 2]
    bw = b[..., 3]
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return np.stack([x, y, z, aw * bw - ax * bx - ay * by - az * bz], axis=-1)


def quaternion_inverse(q: Array) -> Array:
    """Computes the inverse of unit quaternions (..., 4)."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def rotation_quaternion(vector: Array) -> Array:
    """Computes the unit quaternion (..., 4) of rotation vectors (..., 3) [rad]."""
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    return np.concatenate([vector * np.sinc(half / np.pi) / 2, np.cos(half)], axis=-1)


def rotation_vector(q: Array) -> Array:
    """Computes the rotation vector (..., 3) [rad], at most pi long, of unit quaternions (..., 4)."""
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    return q[..., :3] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def rotate(q: Array, vector: Array) -> Array:
    """Turns vectors (..., 3) from body to world axes by quaternions (..., 4)."""
    axis = q[..., :3]
    scalar = q[..., 3:]
    t = 2 * _cross(axis, vector)
    return vector + scalar * t + _cross(axis, t)


def _cross(a: Array, b: Array) -> Array:  # several times faster than np.cross
    ax = a[..., 0]
    ay = a[..., 1]
    az = a[..., 2]
    bx = b[..., 0]
    by = b[..., 1]
    bz = b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


@dataclass(frozen=True)
class Increments:
    """The outputs are the rates of change of every state, of any system."""

    space: StateSpace

    @property
    def output_names(self) -> tuple[str, ...]:
        """One rate of change for every entry of a difference."""
        return tuple(
            f"d_{entry}"
            for group in self.space.groups
            for entry in group.entries[: group.error_dim]
        )

    @property
    def output_groups(self) -> dict[str, tuple[int, ...]]:
        """Outputs that are learned, or not, together."""
        groups = zip(self.space.groups, self.space.error_columns, strict=True)
        return {group.name: tuple(range(at.start, at.stop)) for group, at in groups}

    def step(self, states: Array, outputs: Array, time_step: float) -> Array:
        return self.space.displace(states, outputs * time_step)

    def outputs(self, states: Array, next_states: Array, time: float) -> Array:
        return self.space.difference(next_states, states) / time

    def features(self, states: Array, inputs: Array, context: Array) -> Array:
        """What models see (..., d): the states, of angles sine and cosine, inputs and context."""
        parts: list[Array] = []
        for group, at in zip(self.space.groups, self.space.columns, strict=True):
            own = states[..., at]
            parts += [np.sin(own), np.cos(own)] if group.kind == "angle" else [own]
        return np.concatenate([*parts, inputs, context], axis=-1)

    def feature_names(
        self, inputs: Sequence[str], context: Sequence[str]
    ) -> tuple[str, ...]:
        """What the features are called (d,), of inputs and context by their names."""
        names: list[str] = []
        for group in self.space.groups:
            if group.kind == "angle":
                names += [f"sine of {entry}" for entry in group.entries]
                names += [f"cosine of {entry}" for entry in group.entries]
            else:
                names += group.entries
        return (*names, *inputs, *context)

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
        p, q, v, w = _parts(states)
        force = outputs[..., 0:3]
        alpha = outputs[..., 3:6]
        half_turn = rotation_quaternion((w + alpha * (time_step / 2)) * (time_step / 2))
        middle = quaternion_product(q, half_turn)
        a = rotate(middle, force) + GRAVITY
        parts = [
            p + v * time_step + a * (time_step**2 / 2),
            quaternion_product(middle, half_turn),
        ]
        return np.concatenate(
            [*parts, v + a * time_step, w + alpha * time_step], axis=-1
        )

    def outputs(self, states: Array, next_states: Array, time: float) -> Array:
        """The mean force and angular acceleration of the changes of velocity and rate."""
        (_, q, v, w), (_, q_after, v_after, w_after) = (
            _parts(states),
            _parts(next_states),
        )
        turn = rotation_vector(quaternion_product(quaternion_inverse(q), q_after))
        middle = quaternion_product(q, rotation_quaternion(turn / 2))
        force = rotate(quaternion_inverse(middle), (v_after - v) / time - GRAVITY)
        return np.concatenate([force, (w_after - w) / time], axis=-1)

    def features(self, states: Array, inputs: Array, context: Array) -> Array:
        """Velocity and direction of gravity in body axes, rate, inputs and context, without place and heading."""
        _, q, v, w = _parts(states)
        to_body = quaternion_inverse(q)
        down = rotate(to_body, np.broadcast_to(-GRAVITY / 9.80665, v.shape))
        return np.concatenate(
            [rotate(to_body, v), down[..., :2], w, inputs, context], axis=-1
        )

    def feature_names(
        self, inputs: Sequence[str], context: Sequence[str]
    ) -> tuple[str, ...]:
        """What the features are called (d,), of inputs and context by their names."""
        velocity = [f"velocity along the body's {axis}" for axis in "xyz"]
        down = [f"gravity along the body's {axis}" for axis in "xy"]
        rate = [f"rate about the body's {axis}" for axis in "xyz"]
        return (*velocity, *down, *rate, *inputs, *context)

    def coast(self, states: Array, time: float) -> Array:
        """Goes on at constant velocity and rate for a time [s]."""
        p, q, v, w = _parts(states)
        return np.concatenate(
            [p + v * time, quaternion_product(q, rotation_quaternion(w * time)), v, w],
            axis=-1,
        )


def _parts(states: Array) -> tuple[Array, Array, Array, Array]:
    return states[..., 0:3], states[..., 3:7], states[..., 7:10], states[..., 10:13]


Kinematics = Increments | RigidBody
