"""Nominal models of outputs with parameters that are fitted to data.

``gpmpc.logs`` fits them: ``fit_nominal`` by the errors of rollouts, ``learn`` besides
chooses among several. A parameter vector theta unpacks into one array for each
parameter, which broadcasts against ``states[..., 0]``: many parameter vectors are
rolled out at once.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._quaternions import quaternion_inverse, rotate

_UP = np.array([0.0, 0.0, 1.0])


class ParametricNominal(Protocol):
    """A nominal model of outputs y = f(theta; x, u, c).

    It may have ``sees_inputs`` and ``feedback_outputs`` as well, which are asked for by
    functions of these names.
    """

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters (P,); none where they are too many to be named."""
        ...

    @property
    def start(self) -> Array:
        """Parameters at which a fit begins (P,)."""
        ...

    def outputs(
        self, theta: Any, states: Array, inputs: Array, context: Array
    ) -> Array:
        """Computes the outputs (..., o) at states (..., n)."""
        ...


def sees_inputs(nominal: ParametricNominal) -> bool:
    """Returns whether the outputs of a nominal model are functions of the inputs."""
    return getattr(nominal, "sees_inputs", True)


def feedback_outputs(nominal: ParametricNominal) -> tuple[int, ...]:
    """Returns which outputs hold the feedback of the controller that flew."""
    return getattr(nominal, "feedback_outputs", ())


@dataclass(frozen=True)
class MultirotorNominal:
    """A multirotor with squared motor signals, drag, and the effect of a controller.

    With u2 = the squared motor signals (or the signals themselves, where they are
    thrusts), times the battery's voltage over ``voltage`` where it is in the context:

        fx, fy = -drag_xy v,  fz = thrust mean(u2) - drag_z v    (v in body axes)
        alpha = torque u2 - damping w + feedback tilt

    The tilt is the world's z axis in body axes. ``feedback`` describes flights whose
    attitude a controller held: it predicts such flights, and is no property of the
    vehicle.

    Raises:
        SettingError: There is no motor.

    See Also:
        ``gpmpc.logs.fit_nominal``, which fits its parameters.
    """

    motors: int  #: number of inputs, all of them motor signals
    torque: bool = False  #: whether the motors' torques are parameters
    feedback: bool = False  #: whether the tilt's effect is
    #: at which ``thrust`` and ``torque`` are stated [V]; zero leaves the voltage out
    voltage: float = 0.0
    thrusts: bool = False  #: whether the inputs are thrusts instead of speeds

    def __post_init__(self) -> None:
        if self.motors < 1:
            raise SettingError(
                "inputs", "must name the motor signals of a rigid body; got none"
            )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of theta."""
        names = ["thrust", "drag_xy", "drag_z", "damping_x", "damping_y", "damping_z"]
        if self.feedback:
            names += ["feedback_x_by_y", "feedback_x_by_x"]
            names += ["feedback_y_by_x", "feedback_y_by_y"]
        if self.torque:
            motors = range(1, self.motors + 1)
            names += [f"torque_{axis}{motor}" for axis in "xyz" for motor in motors]
        return tuple(names)

    @property
    def start(self) -> Array:
        """Parameters of hover at a mean squared signal of a half, with some damping."""
        start = np.zeros(len(self.parameter_names))
        start[0] = 20.0
        start[3:6] = 5.0
        return start

    @property
    def feedback_outputs(self) -> tuple[int, ...]:
        """Indices of the outputs that hold the controller's feedback: about x and y."""
        return (3, 4) if self.feedback else ()

    def outputs(
        self, theta: Any, states: Array, inputs: Array, context: Array
    ) -> Array:
        """Computes specific forces and angular accelerations (..., 6)."""
        parameters = dict(zip(self.parameter_names, theta, strict=True))
        to_body = quaternion_inverse(states[..., 3:7])
        v = rotate(to_body, states[..., 7:10])
        w = states[..., 10:13]
        u2 = self._squared_signals(inputs, context)
        force = [
            -parameters["drag_xy"] * v[..., 0],
            -parameters["drag_xy"] * v[..., 1],
            parameters["thrust"] * u2.mean(axis=-1) - parameters["drag_z"] * v[..., 2],
        ]
        alpha = [
            -parameters[f"damping_{axis}"] * w[..., i] for i, axis in enumerate("xyz")
        ]
        if self.feedback:
            tilt = rotate(to_body, np.broadcast_to(_UP, v.shape))
            tilt_x = tilt[..., 0]
            tilt_y = tilt[..., 1]
            alpha[0] = alpha[0] + parameters["feedback_x_by_y"] * tilt_y
            alpha[0] = alpha[0] + parameters["feedback_x_by_x"] * tilt_x
            alpha[1] = alpha[1] + parameters["feedback_y_by_x"] * tilt_x
            alpha[1] = alpha[1] + parameters["feedback_y_by_y"] * tilt_y
        if self.torque:
            for i, axis in enumerate("xyz"):
                alpha[i] = alpha[i] + sum(
                    parameters[f"torque_{axis}{motor + 1}"] * u2[..., motor]
                    for motor in range(self.motors)
                )
        return np.stack(np.broadcast_arrays(*force, *alpha), axis=-1)

    def _squared_signals(self, inputs: Array, context: Array) -> Array:
        """Returns the squared motor signals (..., m), scaled by the voltage."""
        squared = inputs if self.thrusts else inputs**2
        if not self.voltage:
            return squared
        return squared * (context[..., :1] / self.voltage)


@dataclass(frozen=True)
class AffineNominal:
    """Outputs A z + b of the features z, or zero.

    The parameters (A, b) have no names: least squares one step ahead find them.
    """

    kinematics: Kinematics  #: has the features
    fitted: bool = True  #: otherwise the outputs are zero
    parameter_names = ()
    start = np.empty(0)

    @property
    def sees_inputs(self) -> bool:
        """Whether the outputs are functions of the inputs."""
        return self.fitted

    def outputs(
        self, theta: Any, states: Array, inputs: Array, context: Array
    ) -> Array:
        """Computes the outputs (..., o)."""
        o = len(self.kinematics.output_names)
        if not self.fitted:
            return np.zeros((*states.shape[:-1], o))
        weights = np.asarray(theta, dtype=float).reshape(o, -1)
        A = weights[:, :-1]
        b = weights[:, -1]
        return self.kinematics.features(states, inputs, context) @ A.T + b


def is_still(nominal: ParametricNominal) -> bool:
    """Returns whether a nominal model says that no state moves."""
    return isinstance(nominal, AffineNominal) and not nominal.fitted
