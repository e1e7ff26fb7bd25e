"""Unit quaternions, scalar last (x, y, z, w), from body to world axes.

SciPy's ``Rotation`` computes the same. It is several times slower for the small batches
of one step of a rollout.
"""

import numpy as np

from gpmpc._dynamics import Array


def quaternion_product(a: Array, b: Array) -> Array:
    """Computes the Hamilton product (..., 4) of quaternions (..., 4)."""
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
    w = aw * bw - ax * bx - ay * by - az * bz
    return np.stack([x, y, z, w], axis=-1)


def quaternion_inverse(q: Array) -> Array:
    """Computes the inverse of unit quaternions (..., 4)."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def rotation_quaternion(vector: Array) -> Array:
    """Computes the unit quaternion (..., 4) of rotation vectors (..., 3) [rad]."""
    half_angle = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    axis = vector * np.sinc(half_angle / np.pi) / 2
    return np.concatenate([axis, np.cos(half_angle)], axis=-1)


def rotation_vector(q: Array) -> Array:
    """Computes the rotation vector (..., 3) [rad] of unit quaternions (..., 4).

    Its length is at most pi.
    """
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    factor = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return q[..., :3] * factor


def rotate(q: Array, vector: Array) -> Array:
    """Turns vectors (..., 3) from body to world axes by quaternions (..., 4)."""
    axis = q[..., :3]
    scalar = q[..., 3:]
    t = 2 * _cross(axis, vector)
    return vector + scalar * t + _cross(axis, t)


def _cross(a: Array, b: Array) -> Array:
    """Computes the cross product (..., 3), several times faster than ``np.cross``."""
    ax = a[..., 0]
    ay = a[..., 1]
    az = a[..., 2]
    bx = b[..., 0]
    by = b[..., 1]
    bz = b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
