"""Models of logs and their rollouts: many windows, many steps, and many parameter vectors in one batch.

    y[k] = nominal(theta; x[k], u[k - lag], c) + gp(x[k], u[k - lag], c) + d,    x[k+1] = kinematics(x[k], y[k])

The disturbance d of an output is the mean, over the last rows before a prediction, of what was measured minus what the
model says; it is held through the prediction, and so is the context c (a battery's voltage reacts to the inputs, and
its future is not known).

A nominal model has ``parameter_names`` (P), ``start`` (P,) at which a fit begins, and a method ``outputs(theta, states,
inputs, context)`` (..., o); theta unpacks into one array a parameter, which broadcasts against ``states[..., 0]``, so
that many parameter vectors are rolled out at once.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.logs._kinematics import Array, Kinematics, quaternion_inverse, rotate
from gpmpc.logs._log import Windows

STEPS = 50  # of the rollouts that models are judged by
PAST = 20  # rows before them


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
            raise SettingError(
                "inputs", "must name the motor signals of a rigid body; got none"
            )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        names = ["thrust", "drag_xy", "drag_z", "damping_x", "damping_y", "damping_z"]
        if self.feedback:
            names += [
                "feedback_x_by_y",
                "feedback_x_by_x",
                "feedback_y_by_x",
                "feedback_y_by_y",
            ]
        if self.torque:
            names += [
                f"torque_{axis}{i + 1}" for axis in "xyz" for i in range(self.motors)
            ]
        return tuple(names)

    @property
    def start(self) -> Array:
        """Hover at a mean squared signal of a half, without drag, little damping."""
        start = np.zeros(len(self.parameter_names))
        start[0] = 20.0
        start[3:6] = 5.0
        return start

    def outputs(
        self, theta: Any, states: Array, inputs: Array, context: Array
    ) -> Array:
        thrust, drag_xy, drag_z, *rest = theta
        to_body = quaternion_inverse(states[..., 3:7])
        v = rotate(to_body, states[..., 7:10])
        w = states[..., 10:13]
        u2 = (inputs if self.thrusts else inputs**2) * (
            context[..., :1] / self.voltage if self.voltage else 1.0
        )
        force = [
            -drag_xy * v[..., 0],
            -drag_xy * v[..., 1],
            thrust * u2.mean(axis=-1) - drag_z * v[..., 2],
        ]
        alpha = [-rest[i] * w[..., i] for i in range(3)]
        if self.feedback:
            tilt = rotate(to_body, np.broadcast_to(np.array([0.0, 0.0, 1.0]), v.shape))
            alpha[0] = alpha[0] + rest[3] * tilt[..., 1] + rest[4] * tilt[..., 0]
            alpha[1] = alpha[1] + rest[5] * tilt[..., 0] + rest[6] * tilt[..., 1]
        if self.torque:
            gains = rest[len(rest) - 3 * self.motors :]
            for axis in range(3):
                own = gains[axis * self.motors : (axis + 1) * self.motors]
                alpha[axis] = alpha[axis] + sum(
                    g * u2[..., i] for i, g in enumerate(own)
                )
        return np.stack(np.broadcast_arrays(*force, *alpha), axis=-1)


@dataclass(frozen=True)
class AffineNominal:
    """Outputs A z + b of the features z, whose many nameless parameters least squares one step ahead find, or zero."""

    kinematics: Any  #: has the features
    fitted: bool = True  #: otherwise the outputs are zero
    parameter_names = ()
    start = np.empty(0)

    def outputs(
        self, theta: Any, states: Array, inputs: Array, context: Array
    ) -> Array:
        o = len(self.kinematics.output_names)
        if not self.fitted:
            return np.zeros((*states.shape[:-1], o))
        A = np.asarray(theta, dtype=float).reshape(o, -1)
        return (
            self.kinematics.features(states, inputs, context) @ A[:, :-1].T + A[:, -1]
        )


@dataclass(frozen=True)
class OutputGP:
    """GPs that add to some outputs."""

    outputs: tuple[int, ...]  #: their numbers
    posterior: GPPosterior  #: of the features, with ``predicts="value"`` and no inputs of its own

    def mean(self, features: Array) -> Array:
        """Computes the means (..., k) at features (..., d)."""
        flat = np.ascontiguousarray(features.reshape(-1, features.shape[-1]))
        mean = self.posterior.linearize(flat, np.empty((len(flat), 0)), False).mean
        return mean.reshape(*features.shape[:-1], -1)


@dataclass(frozen=True)
class LogModel:
    """A model of the outputs behind a log."""

    kinematics: Kinematics  #: what the outputs do
    nominal: Any  #: the part with parameters, such as a ``MultirotorNominal``
    theta: Array  #: its parameters (P,)
    history: tuple[
        int, ...
    ]  #: rows over which each output's disturbance is averaged (o,); zero for none
    lag: int = 0  #: rows by which the inputs act late
    gps: tuple[OutputGP, ...] = ()  #: what is learned besides

    def __post_init__(self) -> None:
        if len(self.history) != len(self.kinematics.output_names):
            raise SettingError(
                "history",
                f"must have {len(self.kinematics.output_names)} numbers; got {self.history}",
            )

    @property
    def past(self) -> int:
        """Rows that a prediction needs before its start."""
        return max(self.history) + self.lag

    def outputs(
        self, states: Array, inputs: Array, context: Array, theta: Any = None
    ) -> Array:
        """Computes the outputs (..., o) without disturbance; ``theta`` (unpacked) instead of the own one."""
        y = self.nominal.outputs(
            self.theta if theta is None else theta, states, inputs, context
        )
        if self.gps:
            whole = np.broadcast_to(context, (*states.shape[:-1], context.shape[-1]))
            z = self.kinematics.features(
                states,
                np.broadcast_to(inputs, (*states.shape[:-1], inputs.shape[-1])),
                whole,
            )
            y = y.copy()
            for gp in self.gps:
                y[..., list(gp.outputs)] += gp.mean(z)
        return y

    def disturbance(self, windows: Windows, theta: Any = None) -> Array:
        """Estimates the disturbances at the starts of windows (..., W, o) from the rows before."""
        total = np.zeros((len(windows), len(self.history)))
        expand = None if theta is None else [np.asarray(p)[..., None] for p in theta]
        for rows in sorted({h for h in self.history if h}):
            at = slice(windows.past - rows, windows.past)
            x = windows.states[:, windows.past - rows : windows.past + 1]
            u = windows.inputs[:, at.start - self.lag : at.stop - self.lag]
            said = self.outputs(x[:, :-1], u, windows.context[:, at], expand).mean(
                axis=-2
            )
            seen = self.kinematics.outputs(x[:, :-1], x[:, 1:], windows.time_step).mean(
                axis=-2
            )
            total = total + np.where(np.array(self.history) == rows, seen - said, 0.0)
        return total

    def rollout(
        self, windows: Windows, steps: int | None = None, theta: Array | None = None
    ) -> Array:
        """Predicts windows from their starts with the inputs that were applied: the states after it (W, steps, n).

        Windows need ``past`` rows before the start; all steps that they hold are predicted by default. Parameter
        vectors theta (T, P) are rolled out beside each other (T, W, steps, n); the model's own by default.
        """
        steps = windows.ahead if steps is None else steps
        if windows.past < self.past:
            raise SettingError(
                "past",
                f"must be {self.past} rows or more for this model; got {windows.past}",
            )
        terms = (
            None if theta is None else [p[:, None] for p in np.moveaxis(theta, -1, 0)]
        )
        batch = (len(windows),) if theta is None else (len(theta), len(windows))
        x = np.broadcast_to(
            windows.states[:, windows.past], (*batch, windows.states.shape[-1])
        )
        context = windows.context[:, windows.past]
        d = self.disturbance(windows, terms)
        found = np.empty((*batch, steps, x.shape[-1]))
        for k in range(steps):
            y = (
                self.outputs(
                    x, windows.inputs[:, windows.past + k - self.lag], context, terms
                )
                + d
            )
            x = self.kinematics.step(x, y, windows.time_step)
            found[..., k, :] = x
        return found


def rollout_errors(windows: Windows, predicted: Array, steps: Any = None) -> Array:
    """Computes the errors (..., W, steps, e) of rollouts (..., W, K, n) at some steps from 1, by default all."""
    steps = (
        np.arange(1, predicted.shape[-2] + 1) if steps is None else np.asarray(steps)
    )
    return windows.space.difference(
        predicted[..., steps - 1, :], windows.states[:, windows.past + steps]
    )


def finite_errors(windows: Windows, model: LogModel, steps: Any = None) -> Array:
    """Computes the errors of a model's rollouts, of which those that diverge are 1e9."""
    with np.errstate(over="ignore", invalid="ignore"):
        errors = rollout_errors(windows, model.rollout(windows), steps)
    return np.nan_to_num(errors, nan=1e9, posinf=1e9, neginf=-1e9)
