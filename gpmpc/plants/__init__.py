"""The systems that are controlled."""

from gpmpc.plants.plant import Dynamics, Integrated, Map, Plant, step
from gpmpc.plants.quadrotor import ATTITUDES, Rotational, Translational, attitude_for_thrust_direction

__all__ = [
    "ATTITUDES",
    "Dynamics",
    "Integrated",
    "Map",
    "Plant",
    "Rotational",
    "Translational",
    "attitude_for_thrust_direction",
    "step",
]
