"""The systems that are controlled."""

from gpmpc.systems.coupled import Coupled, attitude_at_yaw, thrust_direction
from gpmpc.systems.plant import Dynamics, Integrated, Map, Plant, step, step_many
from gpmpc.systems.quadrotor import ATTITUDES, Rotational, Translational, attitude_for_thrust_direction

__all__ = [
    "ATTITUDES",
    "Coupled",
    "Dynamics",
    "Integrated",
    "Map",
    "Plant",
    "Rotational",
    "Translational",
    "attitude_at_yaw",
    "attitude_for_thrust_direction",
    "step",
    "step_many",
    "thrust_direction",
]
