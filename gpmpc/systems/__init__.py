"""Systems that are controlled: their names, their dynamics, how they are flown."""

from gpmpc.systems._quadrotor import (
    ATTITUDES,
    Coupled,
    Map,
    Rotational,
    Translational,
    attitude_for_thrust_direction,
    coupled,
    rotational,
    translational,
)
from gpmpc.systems._system import GRAVITY, System, cos, exp, sin, step, step_many
from gpmpc.systems._textbook import (
    acrobot,
    cart_pole,
    double_integrator,
    double_pendulum,
    pendulum,
    planar_quadrotor,
    stirred_tank,
)

__all__ = [
    "ATTITUDES",
    "GRAVITY",
    "Coupled",
    "Map",
    "Rotational",
    "System",
    "Translational",
    "acrobot",
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
    "translational",
]
