"""Vehicles on a plane, with the parameters that a log of them tells.

Headings are zero along x and positive anticlockwise; a positive steering angle turns to
the left. Inputs may be what a driver sends, such as a throttle between -1 and 1: gains
and offsets are parameters.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError
from gpmpc.systems._elementary import cos, sin, sqrt, tan
from gpmpc.systems._system import System

_SLOWEST = 0.5  # [m/s] that a slip counts besides the speed: no car divides by zero


@explains_arguments
@dataclass(frozen=True)
class KinematicBicycle:
    """A car whose wheels roll without slip.

    Source: Kong, Pfeiffer, Schildbach and Borrelli (2015), Kinematic and dynamic
    vehicle models for autonomous driving control design.

    See Also:
        ``kinematic_bicycle``, which makes a system of it.
    """

    #: of the path, per unit of steering while that is small: steering_scale / wheelbase
    curvature: float = 1.0
    rear_length: float = 0.0  #: from the rear axle to where the position is taken [m]
    steering_offset: float = 0.0  #: added to the steering, in its unit
    steering_scale: float = 1.0  #: angle of a unit of steering [rad]
    drive_gain: float = 1.0  #: acceleration of a unit of drive [m/s2]
    drive_offset: float = 0.0  #: acceleration without drive [m/s2]
    drag: float = 0.0  #: [1/s]

    state_names = ("x", "y", "heading", "speed")
    input_names = ("steering", "drive")

    def __post_init__(self) -> None:
        if np.isscalar(self.steering_scale) and self.steering_scale == 0:
            raise SettingError("steering_scale", "must not be 0 [rad]")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (x, y, heading, speed) [m/s, m/s, rad/s, m/s^2]."""
        heading = x[2]
        speed = x[3]
        slope = self.curvature * _tangent(self, u[0])  # of the path of the rear axle
        slip = self.rear_length * slope  # tangent of the angle of slip
        norm = sqrt(1 + slip * slip)
        c = cos(heading)
        s = sin(heading)
        drive = self.drive_gain * u[1] + self.drive_offset
        return [
            speed * (c - s * slip) / norm,
            speed * (s + c * slip) / norm,
            speed * slope / norm,
            drive - self.drag * speed,
        ]


@explains_arguments
@dataclass(frozen=True)
class DynamicBicycle:
    """A car whose tyres slip, with forces that saturate.

    Source: Rajamani (2012), Vehicle Dynamics and Control, chapter 2, with a tyre force
    F = C a / sqrt(1 + (C a / grip)^2) at a slip a, all divided by the mass. A slip is a
    tyre's speed sideways over its speed v forwards, here over sqrt(v^2 + (0.5 m/s)^2):
    a car at rest is not turned by its steering, and it may drive backwards.

    See Also:
        ``dynamic_bicycle``, which makes a system of it.
    """

    front_length: float = 0.15  #: from the centre of mass to the front axle [m]
    rear_length: float = 0.15  #: to the rear axle [m]
    front_stiffness: float = 30.0  #: of the front tyres, over the mass [m/s2]
    rear_stiffness: float = 30.0  #: of the rear tyres, likewise
    front_grip: float = 10.0  #: largest force of the front tyres, likewise
    rear_grip: float = 10.0  #: of the rear tyres, likewise
    yaw_ratio: float = 40.0  #: mass over moment of inertia [1/m2]
    steering_gain: float = 1.0  #: angle of a unit of steering [rad]
    steering_offset: float = 0.0  #: added to the steering, in its unit
    drive_gain: float = 1.0  #: acceleration of a unit of drive [m/s2]
    drive_offset: float = 0.0  #: acceleration without drive [m/s2]
    drag: float = 0.0  #: [1/s]

    state_names = ("x", "y", "heading", "forward_speed", "lateral_speed", "yaw_rate")
    input_names = ("steering", "drive")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt of the state; velocities are those along the car's axes."""
        c = cos(x[2])
        s = sin(x[2])
        forward = x[3]
        lateral = x[4]
        rate = x[5]
        rolling = sqrt(forward * forward + _SLOWEST * _SLOWEST)
        steering = self.steering_gain * (u[0] + self.steering_offset)
        front_lateral_speed = lateral + self.front_length * rate
        rear_lateral_speed = lateral - self.rear_length * rate
        front_slip = (steering * forward - front_lateral_speed) / rolling
        rear_slip = -rear_lateral_speed / rolling
        front = _tyre_force(front_slip, self.front_stiffness, self.front_grip)
        rear = _tyre_force(rear_slip, self.rear_stiffness, self.rear_grip)
        drive = self.drive_gain * u[1] + self.drive_offset - self.drag * forward
        front_lateral = front * cos(steering)
        torque = self.front_length * front_lateral - self.rear_length * rear
        return [
            c * forward - s * lateral,
            s * forward + c * lateral,
            rate,
            drive - front * sin(steering) + lateral * rate,
            front_lateral + rear - forward * rate,
            self.yaw_ratio * torque,
        ]


@explains_arguments
@dataclass(frozen=True)
class DifferentialDrive:
    """A robot on two wheels that turn as they are told.

    The inputs are the speeds of both wheels, or a speed and a turn rate: how each moves
    and turns it are parameters.

    See Also:
        ``differential_drive``, which makes a system of it.
    """

    forward_by_first: float = 1.0  #: speed of a unit of the first input [m/s]
    forward_by_second: float = 0.0  #: of the second
    turn_by_first: float = 0.0  #: turn rate of a unit of the first input [rad/s]
    turn_by_second: float = 1.0  #: of the second
    turn_offset: float = 0.0  #: turn rate without inputs [rad/s]

    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "heading")
    input_names: ClassVar[tuple[str, ...]] = ("first", "second")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (x, y, heading) [m/s, m/s, rad/s]."""
        speed, turn_rate = self.motion(u)
        return [speed * cos(x[2]), speed * sin(x[2]), turn_rate]

    def motion(self, u: Any) -> tuple[Any, Any]:
        """Computes the speed [m/s] and the turn rate [rad/s] that inputs ask for."""
        speed = self.forward_by_first * u[0] + self.forward_by_second * u[1]
        turn_rate = self.turn_by_first * u[0] + self.turn_by_second * u[1]
        return speed, turn_rate + self.turn_offset


@explains_arguments
@dataclass(frozen=True)
class LaggedDifferentialDrive(DifferentialDrive):
    """A robot on two wheels whose speed and turn rate follow what they are told.

    See Also:
        ``DifferentialDrive``, without the lag.
    """

    speed_decay: float = 3.0  #: one over the time constant of the speed [1/s]
    turn_decay: float = 3.0  #: of the turn rate [1/s]

    state_names: ClassVar[tuple[str, ...]] = (
        "x",
        "y",
        "heading",
        "speed",
        "turn_rate",
    )

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt of the state [m/s, m/s, rad/s, m/s^2, rad/s^2]."""
        speed, turn_rate = self.motion(u)
        return [
            x[3] * cos(x[2]),
            x[3] * sin(x[2]),
            x[4],
            self.speed_decay * (speed - x[3]),
            self.turn_decay * (turn_rate - x[4]),
        ]


def kinematic_bicycle(time_step: float = 0.05, **parameters: float) -> System:
    """Makes a car that rolls without slip.

    >>> kinematic_bicycle().input_names
    ('steering', 'drive')

    See Also:
        ``dynamic_bicycle``, whose tyres slip.
    """
    return System(
        KinematicBicycle(**parameters),
        time_step,
        2,
        name="kinematic_bicycle",
        units={
            "x": "m",
            "y": "m",
            "heading": "rad",
            "speed": "m/s",
            "steering": "rad",
            "drive": "m/s2",
        },
        angles=["heading"],
        input_lower=[-0.4, -3.0],
        input_upper=[0.4, 3.0],
        start=[0.0, 0.0, 0.0, 1.0],
        goal=[0.0, 0.0, 0.0, 1.0],
        region=[[-3.0, -3.0, -3.0, 0.0], [3.0, 3.0, 3.0, 3.0]],
    )


def dynamic_bicycle(time_step: float = 0.02, **parameters: float) -> System:
    """Makes a car whose tyres slip, of a tenth of a car's size.

    >>> dynamic_bicycle().state_names
    ('x', 'y', 'heading', 'forward_speed', 'lateral_speed', 'yaw_rate')

    See Also:
        ``kinematic_bicycle``, whose tyres do not slip.
    """
    return System(
        DynamicBicycle(**parameters),
        time_step,
        4,
        name="dynamic_bicycle",
        units={
            "x": "m",
            "y": "m",
            "heading": "rad",
            "forward_speed": "m/s",
            "lateral_speed": "m/s",
            "yaw_rate": "rad/s",
            "steering": "rad",
            "drive": "m/s2",
        },
        angles=["heading"],
        rates={"yaw_rate": "heading"},
        input_lower=[-0.4, -3.0],
        input_upper=[0.4, 3.0],
        start=[0.0, 0.0, 0.0, 1.5, 0.0, 0.0],
        goal=[0.0, 0.0, 0.0, 1.5, 0.0, 0.0],
        region=[
            [-3.0, -3.0, -3.0, 0.5, -0.5, -2.0],
            [3.0, 3.0, 3.0, 3.0, 0.5, 2.0],
        ],
    )


def differential_drive(time_step: float = 0.1, **parameters: float) -> System:
    """Makes a robot on two wheels, told its speed and its turn rate.

    >>> differential_drive().angles
    ('heading',)

    See Also:
        ``kinematic_bicycle``.
    """
    return System(
        DifferentialDrive(**parameters),
        time_step,
        2,
        name="differential_drive",
        units={
            "x": "m",
            "y": "m",
            "heading": "rad",
            "first": "m/s",
            "second": "rad/s",
        },
        angles=["heading"],
        input_lower=[-1.0, -2.0],
        input_upper=[1.0, 2.0],
        start=[0.0, 0.0, 0.0],
        region=[[-3.0, -3.0, -3.0], [3.0, 3.0, 3.0]],
    )


def _tangent(car: KinematicBicycle, steering: Any) -> Any:
    """Returns the tangent of the steering's angle, over the angle of a unit."""
    angle = car.steering_scale * (steering + car.steering_offset)
    return tan(angle) / car.steering_scale


def _tyre_force(slip: Any, stiffness: Any, grip: Any) -> Any:
    """Returns the force of tyres over the mass [m/s2]."""
    linear = stiffness * slip
    saturation = linear / grip
    return linear / sqrt(1 + saturation * saturation)
