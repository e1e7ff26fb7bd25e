"""Right-hand sides of a quadrotor, split into its translational and its rotational subsystem.

The model of Cao, Lai and Alam (2017), with the parameters decoded from their data. The z axis points downwards. The
translational subsystem is driven by the total thrust U1 and by the direction (ux, uy) of the thrust, which the attitude
has to provide; the rotational subsystem provides it, driven by the moments' forces U2, U3, U4. ``translational`` and
``rotational`` make the systems, integrated; ``Map`` reads a right-hand side as the paper's data do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, pi
from typing import Any

from gpmpc.exceptions import check_number, check_numbers
from gpmpc.systems._attitudes import GRAVITY, rotational_states_along
from gpmpc.systems.system import System

POSITION = {"x": "x", "y": "y", "z": "z"}
ATTITUDE = {"roll": "phi", "pitch": "theta", "yaw": "psi"}
POSITION_UNITS = dict.fromkeys("xyz", "m") | dict.fromkeys(("vx", "vy", "vz"), "m/s")
ANGLE_UNITS = dict.fromkeys(("phi", "theta", "psi"), "rad") | dict.fromkeys("pqr", "rad/s")

FOLLOWS_POSITIONS: dict[str, Any] = {
    "tracked": ("x", "y", "z"),
    "rates": {"vx": "x", "vy": "y", "vz": "z"},
    "lost": 10.0,  # a hundred times what a controlled one is off; twice where a fifth more mass than learned holds it
    "z_down": True,
}


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
        roll, pitch = a1 * q * r + a2 * q + b1 * u[0], a3 * p * r - a4 * p + b2 * u[1]
        return [p, roll, q, pitch, r, a5 * p * q + b3 * u[2]]


@dataclass(frozen=True)
class Map:
    """Reads a right-hand side as the next state, x[k+1] = f(x[k], u[k]): the data of Cao, Lai and Alam (2017) do.

    Attributes:
        dynamics: The right-hand side f.
    """

    dynamics: Any

    def __post_init__(self) -> None:
        for key in ("state_names", "input_names"):
            object.__setattr__(self, key, getattr(self.dynamics, key))

    def successor(self, x: Any, u: Any) -> Sequence[Any]:
        """x[k+1] = f(x[k], u[k])."""
        return self.dynamics.derivative(x, u)


def translational(time_step: float = 1.0, substeps: int = 1, **parameters: Any) -> System:
    """Makes the translational subsystem; one substep is exact, since its acceleration depends on the input alone.

    Args:
        time_step: [s].
        substeps: Runge-Kutta steps per time step.
        parameters: Attributes of ``Translational``.
    """
    return System(
        Translational(**parameters),
        time_step,
        substeps,
        name="translational",
        units=POSITION_UNITS | {"U1": "N", "ux": "1", "uy": "1"},
        input_lower=(0.0, -0.7, -0.7),
        input_upper=(100.0, 0.7, 0.7),
        initial_input=(7.26, 0.0, 0.0),  # the weight m g
        region=((-20.0, -2.0) * 3, (20.0, 2.0) * 3),
        pose=POSITION,
        **FOLLOWS_POSITIONS,
    )


def rotational(time_step: float = 0.05, substeps: int = 10, **parameters: Any) -> System:
    """Makes the rotational subsystem at 20 Hz; a trajectory prescribes the attitudes that a flight along it needs.

    Args:
        time_step: [s].
        substeps: Runge-Kutta steps per time step.
        parameters: Attributes of ``Rotational``.
    """
    return System(
        Rotational(**parameters),
        time_step,
        substeps,
        name="rotational",
        units=ANGLE_UNITS | dict.fromkeys(("U2", "U3", "U4"), "N"),
        input_lower=(-2.0,) * 3,
        input_upper=(2.0,) * 3,
        tracked=("phi", "theta", "psi"),
        rates={"p": "phi", "q": "theta", "r": "psi"},
        region=((-0.5, -1.0) * 3, (0.5, 1.0) * 3),
        lost=pi / 2,  # a vehicle on its side carries itself no more
        references=rotational_states_along,
        pose=ATTITUDE,
        z_down=True,
    )
