"""Systems that are controlled: what they are called, how they move, how they are flown."""

from gpmpc.systems._attitudes import ATTITUDES, GRAVITY, approach_attitudes, attitude_for_thrust_direction
from gpmpc.systems._coupled import Coupled, attitude_at_yaw, coupled, thrust_direction
from gpmpc.systems._mechanical import (
    acrobot,
    cart_pole,
    double_integrator,
    double_pendulum,
    pendulum,
    planar_quadrotor,
)
from gpmpc.systems._quadrotor import Map, Rotational, Translational, rotational, translational
from gpmpc.systems._reactor import stirred_tank
from gpmpc.systems.system import Dynamics, Plant, System, cos, exp, sin, step, step_many

__all__ = [
    "ATTITUDES",
    "GRAVITY",
    "Coupled",
    "Dynamics",
    "Map",
    "Plant",
    "Rotational",
    "System",
    "Translational",
    "acrobot",
    "approach_attitudes",
    "attitude_at_yaw",
    "attitude_for_thrust_direction",
    "cart_pole",
    "cos",
    "coupled",
    "double_integrator",
    "double_pendulum",
    "exp",
    "pendulum",
    "planar_quadrotor",
    "rotational",
    "sin",
    "step",
    "step_many",
    "stirred_tank",
    "thrust_direction",
    "translational",
]
