"""Right-hand sides of a quadrotor, split into its translational and its rotational subsystem.

The model of Cao, Lai and Alam (2017), with the parameters decoded from their data. The z axis points downwards. The
translational subsystem is driven by the total thrust U1 and by the direction (ux, uy) of the thrust, which the attitude
has to provide; the rotational subsystem provides it, driven by the moments' forces U2, U3, U4. The plants that step
these right-hand sides are in ``plant``.
"""

from dataclasses import dataclass
from math import cos
from typing import Any

import numpy as np

from gpmpc.exceptions import SettingError, check_number, check_numbers

GRAVITY = 9.81  # [m/s^2]
ATTITUDES = ("paper", "exact")  # how thrust direction becomes attitude


@dataclass(frozen=True)
class Translational:
    """Position and velocity, driven by thrust and thrust direction (Cao, Lai and Alam, 2017; ux, uy: eq. (2)).

    States x, vx, y, vy, z, vz [m, m/s]; inputs U1 [N], ux, uy [-].

    Attributes:
        mass: Mass of the vehicle [kg].
        frozen_attitude: Roll and pitch [rad] whose cos(phi) cos(theta) multiplies the vertical thrust. The paper's data
            hold both at pi/4. ``None`` takes the factor that belongs to the inputs: with psi = 0,
            ux = cos(phi) sin(theta) and uy = -sin(phi), so cos(phi) cos(theta) = sqrt(1 - ux^2 - uy^2).
    """

    mass: float = 0.74  # [kg]
    frozen_attitude: tuple[float, float] | None = None  # roll, pitch [rad]

    state_names = ("x", "vx", "y", "vy", "z", "vz")
    input_names = ("U1", "ux", "uy")

    def __post_init__(self) -> None:
        check_number("mass", self.mass, above=0, unit="[kg]")
        if self.frozen_attitude is not None:
            check_numbers("frozen_attitude", self.frozen_attitude, 2, unit="[rad]")
            object.__setattr__(self, "frozen_attitude", tuple(self.frozen_attitude))

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (x, vx, y, vy, z, vz) [m/s, m/s^2]."""
        thrust = u[0] / self.mass  # U1 / m [m/s^2]
        if self.frozen_attitude is None:
            # No direction with ux^2 + uy^2 > 1 exists; there the thrust is horizontal: max(s, 0) = (s + |s|) / 2.
            # The two small terms keep both roots differentiable where their argument would be zero.
            squared = 1 - u[1] * u[1] - u[2] * u[2]
            vertical = ((squared + (squared * squared + 1e-24) ** 0.5) / 2 + 1e-12) ** 0.5
        else:
            roll, pitch = self.frozen_attitude
            vertical = cos(roll) * cos(pitch)
        return [x[1], u[1] * thrust, x[3], u[2] * thrust, x[5], GRAVITY - vertical * thrust]


@dataclass(frozen=True)
class Rotational:
    """Attitude and body rates, driven by the moments' forces (Cao, Lai and Alam, 2017).

    States phi, p, theta, q, psi, r [rad, rad/s]; inputs U2, U3, U4 [N].

    Attributes:
        arm: Distance l from the centre of mass to a rotor [m].
        inertia: Principal moments of inertia Ixx, Iyy, Izz [kg m^2].
        gyroscopic: The rotors' gyroscopic terms Jr W / Ixx and Jr W / Iyy, at their constant speed W [1/s].
    """

    arm: float = 0.21  # [m]
    inertia: tuple[float, float, float] = (0.005, 0.005, 0.0089)  # [kg m^2]
    gyroscopic: tuple[float, float] = (0.01102, 0.01102)  # [1/s]

    state_names = ("phi", "p", "theta", "q", "psi", "r")
    input_names = ("U2", "U3", "U4")

    def __post_init__(self) -> None:
        check_number("arm", self.arm, above=0, unit="[m]")
        check_numbers("inertia", self.inertia, 3, above=0, unit="[kg m^2]")
        check_numbers("gyroscopic", self.gyroscopic, 2, unit="[1/s]")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (phi, p, theta, q, psi, r) [rad/s, rad/s^2]."""
        p, q, r = x[1], x[3], x[5]
        ixx, iyy, izz = self.inertia
        a1, a3, a5 = (iyy - izz) / ixx, (izz - ixx) / iyy, (ixx - iyy) / izz  # [-]
        a2, a4 = self.gyroscopic  # a2 W, a4 W [1/s]
        b1, b2, b3 = self.arm / ixx, self.arm / iyy, self.arm / izz  # [1/(kg m)]
        return [
            p,
            a1 * q * r + a2 * q + b1 * u[0],
            q,
            a3 * p * r - a4 * p + b2 * u[1],
            r,
            a5 * p * q + b3 * u[2],
        ]


def attitude_for_thrust_direction(ux: np.ndarray, uy: np.ndarray, convention: str = "exact") -> np.ndarray:
    """Roll and pitch that point the thrust along (ux, uy) at psi = 0; Cao, Lai and Alam (2017), eq. (2) inverted.

    ux = cos(phi) sin(theta) and uy = -sin(phi) give phi = -asin(uy) and theta = asin(ux / cos(phi)). The authors' data
    hold theta = sign(phi) asin(ux) instead. Arguments outside [-1, 1] saturate.

    Args:
        ux: Thrust direction along x, any shape [-].
        uy: Thrust direction along y, same shape [-].
        convention: ``"exact"``, or ``"paper"`` for the authors' formula.

    Returns:
        Roll and pitch [rad], stacked along a new last axis of length 2.

    Raises:
        SettingError: The convention is neither of the two.
    """
    phi = -np.arcsin(np.clip(uy, -1, 1))
    if convention == "paper":
        theta = np.sign(phi) * np.arcsin(np.clip(ux, -1, 1))
    elif convention == "exact":
        horizontal = np.cos(phi)
        ratio = np.divide(ux, horizontal, out=np.zeros_like(horizontal), where=horizontal > 1e-12)
        theta = np.arcsin(np.clip(ratio, -1, 1))
    else:
        raise SettingError("attitude", f"must be 'paper' or 'exact'; got {convention!r}")
    return np.stack([phi, theta], axis=-1)
