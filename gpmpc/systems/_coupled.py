"""Right-hand side of the whole quadrotor, whose attitude decides where its thrust points.

The translational and the rotational subsystem of Cao, Lai and Alam (2017), joined by their eq. (2): with roll phi,
pitch theta and yaw psi the thrust U1 points along

    ux = cos(phi) sin(theta) cos(psi) + sin(phi) sin(psi)
    uy = cos(phi) sin(theta) sin(psi) - sin(phi) cos(psi)

and lifts by cos(phi) cos(theta); the three squares sum to one. z points downwards; the paper's x and y accelerate
*along* (ux, uy), so they point against those of the aerospace convention. As in the paper, the angles' rates are taken
for the body rates, which is good for small angles.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpmpc.exceptions import check_number
from gpmpc.systems._attitudes import GRAVITY, attitude_for_thrust_direction
from gpmpc.systems._quadrotor import (
    ANGLE_UNITS,
    ATTITUDE,
    FOLLOWS_POSITIONS,
    POSITION,
    POSITION_UNITS,
    Rotational,
    Translational,
)
from gpmpc.systems.system import System, cos, sin


@dataclass(frozen=True)
class Coupled:
    """Position, velocity, attitude and body rates, driven by the thrust and the moments' forces.

    States x, vx, y, vy, z, vz [m, m/s], phi, p, theta, q, psi, r [rad, rad/s]; inputs U1, U2, U3, U4 [N].

    Attributes:
        mass: Mass of the vehicle [kg].
        rotational: The rotational subsystem.
    """

    mass: float = 0.74  # [kg]
    rotational: Rotational = field(default_factory=Rotational)

    state_names = Translational.state_names + Rotational.state_names
    input_names = ("U1", *Rotational.input_names)

    def __post_init__(self) -> None:
        check_number("mass", self.mass, above=0, unit="[kg]")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt of the twelve states [m/s, m/s^2, rad/s, rad/s^2]."""
        ux, uy, vertical = thrust_direction(x[6], x[8], x[10])
        thrust = u[0] / self.mass  # U1 / m [m/s^2]
        turning = self.rotational.derivative([x[i] for i in range(6, 12)], [u[1], u[2], u[3]])
        return [x[1], ux * thrust, x[3], uy * thrust, x[5], GRAVITY - vertical * thrust, *turning]


def coupled(mass: float = 0.74, time_step: float = 0.05, substeps: int = 2, **parameters: Any) -> System:
    """Makes the whole quadrotor at the rate of its inner loop; ``gpmpc.simulation.cascade_loop`` flies it.

    Args:
        mass: [kg].
        time_step: [s].
        substeps: Runge-Kutta steps per time step.
        parameters: Attributes of ``Rotational``.
    """
    return System(
        Coupled(mass, Rotational(**parameters)),
        time_step,
        substeps,
        name="coupled",
        units=POSITION_UNITS | ANGLE_UNITS | dict.fromkeys(("U1", "U2", "U3", "U4"), "N"),
        input_lower=(0.0, -2.0, -2.0, -2.0),
        input_upper=(20.0, 2.0, 2.0, 2.0),
        initial_input=(7.26, 0.0, 0.0, 0.0),  # the weight m g
        region=((-2.0, -1.0) * 3 + (-0.3, -0.5) * 3, (2.0, 1.0) * 3 + (0.3, 0.5) * 3),
        pose=POSITION | ATTITUDE,
        **FOLLOWS_POSITIONS,
    )


def thrust_direction(phi: Any, theta: Any, psi: Any) -> tuple[Any, Any, Any]:
    """(ux, uy) and cos(phi) cos(theta) [-] of an attitude [rad]; Cao, Lai and Alam (2017), eq. (2)."""
    ux = cos(phi) * sin(theta) * cos(psi) + sin(phi) * sin(psi)
    uy = cos(phi) * sin(theta) * sin(psi) - sin(phi) * cos(psi)
    return ux, uy, cos(phi) * cos(theta)


def attitude_at_yaw(ux: np.ndarray, uy: np.ndarray, psi: np.ndarray, convention: str = "exact") -> np.ndarray:
    """Roll and pitch [rad], along a new last axis, that point the thrust along (ux, uy) [-] at a yaw psi [rad].

    Turned by -psi, eq. (2) is that of psi = 0: ux cos(psi) + uy sin(psi) = cos(phi) sin(theta) and
    uy cos(psi) - ux sin(psi) = -sin(phi).
    """
    forward, sideways = ux * np.cos(psi) + uy * np.sin(psi), uy * np.cos(psi) - ux * np.sin(psi)
    return attitude_for_thrust_direction(forward, sideways, convention)
