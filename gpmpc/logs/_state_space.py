"""State spaces made of vectors, angles and unit quaternions, with differences, norms and interpolation on each.

The difference of two states is taken in the tangent space (Sola, Deray and Atchuthan, 2018): a vector's is the ordinary
one, an angle's is wrapped to [-pi, pi), and an attitude's is the rotation vector log(q_b^-1 q_a) in the body frame, so
a quaternion of four numbers has an error of three. Quaternions are scalar last (x, y, z, w), body to world.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["vector", "angle", "quaternion"]


@dataclass(frozen=True)
class StateGroup:
    """Entries of a state that are measured together and judged by one error."""

    name: str  #: such as "position"
    entries: tuple[str, ...]  #: names of the entries; four of a quaternion, x, y, z, w
    unit: str = ""  #: of the entries; a quaternion's errors are in rad
    kind: Kind = "vector"  #: how differences are taken

    @property
    def error_dim(self) -> int:
        """Number of entries of a difference: three of a quaternion."""
        return 3 if self.kind == "quaternion" else len(self.entries)

    @property
    def error_unit(self) -> str:
        return "rad" if self.kind == "quaternion" else self.unit


@dataclass(frozen=True)
class StateSpace:
    """A state (n,) made of groups, one after the other, with errors (e,)."""

    groups: tuple[StateGroup, ...]

    @cached_property
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

    @property
    def dim(self) -> int:
        """Number of entries of a state, n."""
        return len(self.names)

    @property
    def error_dim(self) -> int:
        """Number of entries of a difference, e."""
        return sum(group.error_dim for group in self.groups)

    def difference(self, a: Array, b: Array) -> Array:
        """Computes a - b (..., e) of states (..., n)."""
        parts = []
        for group, at in zip(self.groups, self.columns, strict=True):
            one, other = a[..., at], b[..., at]
            if group.kind == "quaternion":
                parts.append(rotation_vector(quaternion_product(quaternion_inverse(other), one)))
            elif group.kind == "angle":
                parts.append(wrap(one - other))
            else:
                parts.append(one - other)
        return np.concatenate(np.broadcast_arrays(*parts) if len(parts) == 1 else parts, axis=-1)

    def displace(self, state: Array, error: Array) -> Array:
        """Computes the state (..., n) whose difference from ``state`` is ``error`` (..., e)."""
        parts = []
        for group, at, error_at in zip(self.groups, self.columns, self.error_columns, strict=True):
            one, by = state[..., at], error[..., error_at]
            if group.kind == "quaternion":
                parts.append(quaternion_product(one, rotation_quaternion(by)))
            else:
                parts.append(wrap(one + by) if group.kind == "angle" else one + by)
        return np.concatenate(parts, axis=-1)

    def distances(self, errors: Array) -> Array:
        """Computes the Euclidean or geodesic length of each group's error (..., groups) of errors (..., e)."""
        return np.stack([np.linalg.norm(errors[..., at], axis=-1) for at in self.error_columns], axis=-1)


def _slices(lengths: Sequence[int]) -> tuple[slice, ...]:
    ends = np.cumsum(lengths).tolist()
    return tuple(slice(end - length, end) for end, length in zip(ends, lengths, strict=True))


def wrap(angle: Array) -> Array:
    """Wraps angles [rad] to [-pi, pi)."""
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def quaternion_product(a: Array, b: Array) -> Array:
    """Computes the Hamilton product (..., 4) of quaternions (x, y, z, w)."""
    ax, ay, az, aw = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bx, by, bz, bw = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


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
    axis, scalar = q[..., :3], q[..., 3:]
    t = 2 * _cross(axis, vector)
    return vector + scalar * t + _cross(axis, t)


def _cross(a: Array, b: Array) -> Array:  # several times faster than np.cross
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def quaternion_from_euler(angles: Array) -> Array:
    """Computes the quaternions (..., 4) of roll, pitch and yaw (..., 3) [rad], turned about z, then y, then x."""
    (sx, sy, sz), (cx, cy, cz) = np.moveaxis(np.sin(angles / 2), -1, 0), np.moveaxis(np.cos(angles / 2), -1, 0)
    x, y = sx * cy * cz - cx * sy * sz, cx * sy * cz + sx * cy * sz
    return np.stack([x, y, cx * cy * sz - sx * sy * cz, cx * cy * cz + sx * sy * sz], axis=-1)
