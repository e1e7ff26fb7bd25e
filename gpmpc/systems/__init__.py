"""Systems that are controlled: what they are called, how they move, how they are flown."""

from gpmpc.systems.attitudes import ATTITUDES, attitude_for_thrust_direction
from gpmpc.systems.coupled import Coupled, attitude_at_yaw, coupled, thrust_direction
from gpmpc.systems.mechanical import (
    acrobot,
    cart_pole,
    double_integrator,
    double_pendulum,
    pendulum,
    planar_quadrotor,
)
from gpmpc.systems.quadrotor import Map, Rotational, Translational, rotational, translational
from gpmpc.systems.reactor import stirred_tank
from gpmpc.systems.system import Dynamics, Plant, System, cos, exp, sin, step, step_many

__all__ = [
    "ATTITUDES",
    "Coupled",
    "Dynamics",
    "Map",
    "Plant",
    "Rotational",
    "System",
    "Translational",
    "acrobot",
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
