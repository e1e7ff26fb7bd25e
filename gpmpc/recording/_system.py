"""Describes the system whose steps are recorded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.recording._schema import check_names, message_fields

if TYPE_CHECKING:
    from gpmpc.systems import System

POSITION = ("x", "y", "z")
ATTITUDE = ("roll", "pitch", "yaw")


@explains_arguments
@dataclass(frozen=True)
class RecordedSystem:
    """A description of the system whose steps are recorded."""

    state_names: Sequence[str]  # names of the n states; they become field names
    input_names: Sequence[str]  # names of the m inputs
    time_step: float  # of the plant [s]; it dates the stages of a plan
    # by name of state or input, such as ``{"x": "m"}``
    units: Mapping[str, str] = field(default_factory=dict)
    # lower and upper bounds of the input (2, m), repeated in every step for plots
    input_bounds: Any = None
    # states of position and attitude (Rz(yaw) Ry(pitch) Rx(roll)) in space, by x, y, z,
    # roll, pitch, yaw
    pose: Mapping[str, str] = field(default_factory=dict)
    # whether the z axis of positions points downwards, as the quadrotor's does
    z_down: bool = True

    def __post_init__(self) -> None:
        for key in ("state_names", "input_names"):
            object.__setattr__(self, key, check_names(key, getattr(self, key)))
        check_number("time_step", self.time_step, above=0, unit="[s]")
        m = len(self.input_names)
        if self.input_bounds is not None and np.shape(self.input_bounds) != (2, m):
            raise ShapeError(
                f"input bounds must be (2, {m}); got {np.shape(self.input_bounds)}"
            )
        names = (*self.state_names, *self.input_names)
        _check_known("units", self.units, names)
        _check_known("pose", self.pose, POSITION + ATTITUDE)
        _check_known("pose", self.pose.values(), self.state_names)

    @classmethod
    def of(cls, system: "System", input_bounds: Any = None) -> "RecordedSystem":
        """Describes a system by its own names, units and pose.

        Args:
            system: The plant.
            input_bounds: (2, m); the system's limits by default.
        """
        if not hasattr(system, "input_lower"):
            rule = "must be a System(dynamics, time_step)"
            raise SettingError("system", f"{rule}; got {type(system).__name__}")
        if input_bounds is None:
            input_bounds = [system.input_lower, system.input_upper]
        return cls(
            state_names=system.state_names,
            input_names=system.input_names,
            time_step=system.time_step,
            units=system.units,
            input_bounds=input_bounds,
            pose=system.pose,
            z_down=system.z_down,
        )

    @property
    def field_units(self) -> dict[str, str]:
        """Units of the scalar fields by path; unknown ones are "?".

        Paths begin at ``Step`` or, after ``stages``, at the stages of ``Plan``.
        """
        units = {"time": "s", "stages.time": "s"}
        for part in message_fields()["Timing"]:
            units[f"timing.{part.name}"] = "s"
        names_by_type = {"State": self.state_names, "Input": self.input_names}
        for message, prefix in (("Step", ""), ("Stage", "stages.")):
            for part in message_fields()[message]:
                for name in names_by_type.get(part.type, ()):
                    units[f"{prefix}{part.name}.{name}"] = self.units.get(name, "?")
        return units


def _check_known(key: str, names: Any, known_names: Sequence[str]) -> None:
    """Raises ``SettingError`` where a name is none of those that are known."""
    unknown = sorted({*names} - {*known_names})
    if unknown:
        raise SettingError(
            key, f"must be of {', '.join(known_names)}; got {', '.join(unknown)}"
        )
