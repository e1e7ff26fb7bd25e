"""Nominal models of outputs with a few parameters, for ``fit_nominal``.

A nominal model has ``parameter_names``, a starting point ``start`` and a method ``outputs(theta, states, inputs,
context)``; theta unpacks into one array a parameter, which broadcasts against ``states[..., 0]``, so that many
parameter vectors are rolled out at once.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gpmpc.exceptions import SettingError
from gpmpc.logs._state_space import Array, quaternion_inverse, rotate


class Nominal(Protocol):
    """Outputs (..., o) as a function of P named parameters, with the point (P,) at which a fit begins."""

    @property
    def parameter_names(self) -> tuple[str, ...]: ...
    @property
    def start(self) -> Array: ...
    def outputs(self, theta: Any, states: Array, inputs: Array, context: Array) -> Array: ...


@dataclass(frozen=True)
class Still:
    """Outputs that are zero: nothing is known."""

    output_dim: int
    parameter_names: tuple[str, ...] = ()

    @property
    def start(self) -> Array:
        return np.empty(0)

    def outputs(self, theta: Any, states: Array, inputs: Array, context: Array) -> Array:
        return np.zeros((*states.shape[:-1], self.output_dim))


@dataclass(frozen=True)
class MultirotorNominal:
    """A multirotor: thrust and torque from squared motor signals, drag, and what a closed loop adds.

    With u2 = the squared motor signals (or the signals themselves, where they are thrusts), times the battery's voltage
    over ``voltage`` where it is in the context:

        fx, fy = -drag_xy v,  fz = thrust mean(u2) - drag_z v          (v in body axes)
        alpha = torque u2 - damping w + feedback tilt                  (tilt: the world's z axis in body axes)

    ``feedback`` describes flights whose attitude a controller held: it predicts such flights, and is no property of
    the vehicle.
    """

    motors: int  #: number of inputs, all of them motor signals
    torque: bool = False  #: whether the motors' torques are parameters
    feedback: bool = False  #: whether the tilt's effect is
    voltage: float = 0.0  #: at which ``thrust`` and ``torque`` are stated [V]; zero leaves the voltage out
    thrusts: bool = False  #: whether the inputs are thrusts instead of speeds

    def __post_init__(self) -> None:
        if self.motors < 1:
            raise SettingError("inputs", "must name the motor signals of a rigid body; got none")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        names = ["thrust", "drag_xy", "drag_z", "damping_x", "damping_y", "damping_z"]
        if self.feedback:
            names += ["feedback_x_by_y", "feedback_x_by_x", "feedback_y_by_x", "feedback_y_by_y"]
        if self.torque:
            names += [f"torque_{axis}{i + 1}" for axis in "xyz" for i in range(self.motors)]
        return tuple(names)

    @property
    def start(self) -> Array:
        """Hover at a mean squared signal of a half, without drag, little damping."""
        start = np.zeros(len(self.parameter_names))
        start[0], start[3:6] = 20.0, 5.0
        return start

    def outputs(self, theta: Any, states: Array, inputs: Array, context: Array) -> Array:
        thrust, drag_xy, drag_z, *rest = theta
        to_body = quaternion_inverse(states[..., 3:7])
        v, w = rotate(to_body, states[..., 7:10]), states[..., 10:13]
        u2 = (inputs if self.thrusts else inputs**2) * (context[..., :1] / self.voltage if self.voltage else 1.0)
        force = [-drag_xy * v[..., 0], -drag_xy * v[..., 1], thrust * u2.mean(axis=-1) - drag_z * v[..., 2]]
        alpha = [-rest[i] * w[..., i] for i in range(3)]
        if self.feedback:
            tilt = rotate(to_body, np.broadcast_to(np.array([0.0, 0.0, 1.0]), v.shape))
            alpha[0] = alpha[0] + rest[3] * tilt[..., 1] + rest[4] * tilt[..., 0]
            alpha[1] = alpha[1] + rest[5] * tilt[..., 0] + rest[6] * tilt[..., 1]
        if self.torque:
            gains = rest[len(rest) - 3 * self.motors :]
            for axis in range(3):
                own = gains[axis * self.motors : (axis + 1) * self.motors]
                alpha[axis] = alpha[axis] + sum(g * u2[..., i] for i, g in enumerate(own))
        return np.stack(np.broadcast_arrays(*force, *alpha), axis=-1)


@dataclass(frozen=True)
class AffineNominal:
    """Outputs A z + b of the features z: parameters enter linearly, so least squares one step ahead find them."""

    kinematics: Any  #: has the features
    output_dim: int  #: o
    feature_dim: int = 0  #: d, their number; known once it is fitted

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return tuple(f"A_{i}_{j}" for i in range(self.output_dim) for j in range(self.feature_dim + 1))

    @property
    def start(self) -> Array:
        return np.zeros(len(self.parameter_names))

    def outputs(self, theta: Any, states: Array, inputs: Array, context: Array) -> Array:
        z = self.kinematics.features(states, inputs, context)
        A = np.asarray(theta, dtype=float).reshape(self.output_dim, self.feature_dim + 1)
        return z @ A[:, :-1].T + A[:, -1]
