"""Brings the states of a rigid body to the axes of ``gpmpc.logs``.

The world's axes are east, north, up (ENU) and the body's forward, left, up (FLU), so
that gravity is ``GRAVITY`` in every log.
Aviation, and PX4's logs, have north, east, down (NED) and forward, right, down (FRD).

Two words are kept apart here: ``axes`` ("enu" or "ned") is the convention, ``frame``
("world" or "body") is what a vector is measured in. Only the mapping's key ``frame``
means the axes.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError
from gpmpc.models._quaternions import quaternion_inverse, quaternion_product, rotate

if TYPE_CHECKING:
    from gpmpc.logs._mapping import LogMapping, Signal

# Both matrices are their own inverses, and so are the turns that they make.
NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD = np.diag([1.0, -1.0, -1.0])
NED_TURN = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
FRD_TURN = np.array([1.0, 0.0, 0.0, 0.0])
NAMES = {  # by the axes: of the world, and of the body
    "enu": ("ENU", "FLU"),
    "ned": ("NED", "FRD"),
}


def other_convention(axes: str) -> str:
    """Returns the convention of axes that is not the given one."""
    return "ned" if axes == "enu" else "enu"


def with_axes_of_files(mapping: "LogMapping", files: Sequence[Path]) -> "LogMapping":
    """Returns the mapping, with the axes of this kind of files where it says none.

    Raises:
        SettingError: It says none, and the files are of two kinds.
    """
    if mapping.model != "rigid_body" or mapping.axes:
        return mapping
    are_px4 = {file.suffix.lower() == ".ulg" for file in files}
    if all(signal.axes for signal in mapping.of("states")):
        return mapping
    if len(are_px4) > 1:
        raise SettingError(
            "frame",
            "must be enu or ned where PX4 logs, which are NED, are read with others",
        )
    return replace(mapping, axes="ned" if are_px4 == {True} else "enu")


def attitudes_to_enu(attitudes: Array, axes: str) -> Array:
    """Turns attitudes (..., 4) to those of a FLU body in an ENU world."""
    if axes == "enu":
        return attitudes
    return quaternion_product(quaternion_product(NED_TURN, attitudes), FRD_TURN)


def axes_to_enu(axes: str, frame: str) -> Array:
    """Returns the matrix (3, 3) that brings vectors of a frame to ENU or FLU axes."""
    if axes == "enu":
        return np.eye(3)
    return NED if frame == "world" else FRD


def velocities_to_world(states: Array, frame: str) -> Array:
    """Returns the velocities (..., 3) of states in world axes."""
    velocities = states[..., 7:10]
    if frame == "world":
        return velocities
    return rotate(states[..., 3:7], velocities)


def rates_to_body(states: Array, frame: str) -> Array:
    """Returns the angular rates (..., 3) of states in body axes."""
    rates = states[..., 10:13]
    if frame == "body":
        return rates
    return rotate(quaternion_inverse(states[..., 3:7]), rates)


class Claim:
    """A mapping's claim of what the states of a rigid body are."""

    def __init__(self, mapping: "LogMapping") -> None:
        self.position, self.attitude, self.velocity, self.rate = mapping.of("states")
        self.velocity_frame = self.velocity.frame or "world"
        self.rate_frame = self.rate.frame or "body"
        self.default_axes = mapping.axes or "enu"
        self.axes = {  # by signal
            signal.name: mapping.axes_of(signal) for signal in mapping.of("states")
        }

    def to_enu(self, signal: "Signal", frame: str) -> Array:
        """Returns the matrix (3, 3) from the file's axes of a frame to ENU or FLU."""
        return axes_to_enu(self.axes[signal.name], frame)

    def turn_axes(self, states: Array) -> Array:
        """Turns states (..., 13) to ENU and FLU axes, in the frames of the mapping."""
        p, q, v, w = np.split(states, [3, 7, 10], axis=-1)
        position = p @ self.to_enu(self.position, "world")
        attitude = attitudes_to_enu(q, self.axes[self.attitude.name])
        velocity = v @ self.to_enu(self.velocity, self.velocity_frame)
        rate = w @ self.to_enu(self.rate, self.rate_frame)
        return np.concatenate([position, attitude, velocity, rate], axis=-1)

    def read(self, states: Array) -> Array:
        """Returns states (..., 13) in ``gpmpc.logs``' axes and frames."""
        states = self.turn_axes(states)
        velocities = velocities_to_world(states, self.velocity_frame)
        rates = rates_to_body(states, self.rate_frame)
        return np.concatenate([states[..., :7], velocities, rates], axis=-1)
