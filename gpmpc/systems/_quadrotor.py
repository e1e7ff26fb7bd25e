"""The quadrotor of Cao, Lai and Alam (2017), whole and split into its two subsystems.

Parameters are decoded from the authors' data. The z axis points downwards. The
translational subsystem is driven by the total thrust U1 and by the direction (ux, uy)
of the thrust, which the attitude has to provide; the rotational subsystem provides it,
driven by the moments' forces U2, U3, U4. The paper's x and y accelerate *along* (ux,
uy), so they point against those of the aerospace convention, and its angles' rates are
taken for the body rates, which is good for small angles.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import check_choice, check_number, check_numbers
from gpmpc.systems._elementary import cos, sin
from gpmpc.systems._system import GRAVITY, System
from gpmpc.trajectories import Trajectory

ATTITUDES = ("paper", "exact")  # how thrust direction becomes attitude
OUTER_STEP = 1.0  # [s] for which an attitude is asked for
RESPONSE_TIME = 0.1  # [s]
_POSITION = {"x": "x", "y": "y", "z": "z"}
_ATTITUDE = {"roll": "phi", "pitch": "theta", "yaw": "psi"}
_POSITION_UNITS = dict.fromkeys("xyz", "m") | dict.fromkeys(("vx", "vy", "vz"), "m/s")
_ANGLE_UNITS = dict.fromkeys(("phi", "theta", "psi"), "rad") | dict.fromkeys(
    "pqr", "rad/s"
)
_FOLLOWS_POSITIONS: dict[str, Any] = {
    "tracked": ("x", "y", "z"),
    "rates": {"vx": "x", "vy": "y", "vz": "z"},
    # a hundred times what a controlled one is off; twice where a fifth more mass than
    # learned holds it
    "lost": 10.0,
    "z_down": True,
}


@explains_arguments
@dataclass(frozen=True)
class Translational:
    """Position and velocity, driven by thrust and thrust direction.

    States x, vx, y, vy, z, vz [m, m/s]; inputs U1 [N], ux, uy [-].

    See Also:
        ``translational``, which makes a system of it.
    """

    mass: float = 0.74  #: [kg]
    #: Roll and pitch [rad] whose cos(phi) cos(theta) multiplies the vertical thrust;
    #: the paper's data hold both at pi/4. None takes the factor of the inputs at psi =
    #: 0, cos(phi) cos(theta) = sqrt(1 - ux^2 - uy^2).
    frozen_attitude: tuple[float, float] | None = None

    state_names = ("x", "vx", "y", "vy", "z", "vz")
    input_names = ("U1", "ux", "uy")

    def __post_init__(self) -> None:
        check_number("mass", self.mass, above=0, unit="[kg]")
        if self.frozen_attitude is not None:
            check_numbers("frozen_attitude", self.frozen_attitude, 2, unit="[rad]")
            object.__setattr__(self, "frozen_attitude", tuple(self.frozen_attitude))

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (x, vx, y, vy, z, vz) [m/s, m/s^2]."""
        vx, vy, vz = x[1], x[3], x[5]
        ux, uy = u[1], u[2]
        thrust = u[0] / self.mass  # U1 / m [m/s^2]
        if self.frozen_attitude is None:
            vertical = _vertical_direction(ux, uy)
        else:
            roll, pitch = self.frozen_attitude
            vertical = math.cos(roll) * math.cos(pitch)
        return [vx, ux * thrust, vy, uy * thrust, vz, GRAVITY - vertical * thrust]


def _vertical_direction(ux: Any, uy: Any) -> Any:
    """Returns the vertical entry of a thrust direction, sqrt(1 - ux^2 - uy^2).

    No direction with ux^2 + uy^2 > 1 exists; there the thrust is horizontal:
    max(s, 0) = (s + |s|) / 2. The two small terms keep both roots differentiable where
    their argument would be zero.
    """
    squared = 1 - ux * ux - uy * uy
    magnitude = (squared * squared + 1e-24) ** 0.5
    return ((squared + magnitude) / 2 + 1e-12) ** 0.5


@explains_arguments
@dataclass(frozen=True)
class Rotational:
    """Attitude and body rates, driven by the moments' forces.

    States phi, p, theta, q, psi, r [rad, rad/s]; inputs U2, U3, U4 [N].

    See Also:
        ``rotational``, which makes a system of it.
    """

    arm: float = 0.21  #: distance l from the centre of mass to a rotor [m]
    #: principal moments Ixx, Iyy, Izz [kg m^2]
    inertia: tuple[float, float, float] = (0.005, 0.005, 0.0089)
    #: the rotors' gyroscopic terms Jr W / Ixx and Jr W / Iyy, at their constant speed W
    #: [1/s]
    gyroscopic: tuple[float, float] = (0.01102, 0.01102)

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
        # [-]
        a1 = (iyy - izz) / ixx
        a3 = (izz - ixx) / iyy
        a5 = (ixx - iyy) / izz
        a2, a4 = self.gyroscopic  # a2 W, a4 W [1/s]
        # [1/(kg m)]
        b1 = self.arm / ixx
        b2 = self.arm / iyy
        b3 = self.arm / izz
        p_dot = a1 * q * r + a2 * q + b1 * u[0]
        q_dot = a3 * p * r - a4 * p + b2 * u[1]
        r_dot = a5 * p * q + b3 * u[2]
        return [p, p_dot, q, q_dot, r, r_dot]


@explains_arguments
@dataclass(frozen=True)
class Coupled:
    """Position, velocity, attitude and body rates, driven by thrust and moments.

    States x, vx, y, vy, z, vz [m, m/s], phi, p, theta, q, psi, r [rad, rad/s]; inputs
    U1, U2, U3, U4 [N].

    See Also:
        ``coupled``, which makes a system of it.
    """

    #: of the vehicle [kg]
    mass: float = 0.74
    #: the rotational subsystem
    rotational: Rotational = field(default_factory=Rotational)

    state_names = Translational.state_names + Rotational.state_names
    input_names = ("U1", *Rotational.input_names)

    def __post_init__(self) -> None:
        check_number("mass", self.mass, above=0, unit="[kg]")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt of the twelve states [m/s, m/s^2, rad/s, rad/s^2]."""
        vx, vy, vz = x[1], x[3], x[5]
        phi, theta, psi = x[6], x[8], x[10]
        ux, uy, vertical = thrust_direction(phi, theta, psi)
        thrust = u[0] / self.mass  # U1 / m [m/s^2]
        attitude = [x[i] for i in range(6, 12)]
        attitude_dot = self.rotational.derivative(attitude, [u[1], u[2], u[3]])
        return [
            vx,
            ux * thrust,
            vy,
            uy * thrust,
            vz,
            GRAVITY - vertical * thrust,
            *attitude_dot,
        ]


@explains_arguments
@dataclass(frozen=True)
class Map:
    """Reads a right-hand side as the next state, x[k+1] = f(x[k], u[k]).

    The data of Cao, Lai and Alam (2017) do.

    See Also:
        ``System``, which takes it as dynamics.
    """

    dynamics: Any  #: the right-hand side f

    def __post_init__(self) -> None:
        for key in ("state_names", "input_names"):
            object.__setattr__(self, key, getattr(self.dynamics, key))

    def successor(self, x: Any, u: Any) -> Sequence[Any]:
        """x[k+1] = f(x[k], u[k])."""
        return self.dynamics.derivative(x, u)


def translational(
    time_step: float = 1.0, substeps: int = 1, **parameters: Any
) -> System:
    """Makes the translational subsystem.

    One Runge-Kutta substep is exact: its acceleration follows from the input.

    >>> translational().state_names
    ('x', 'vx', 'y', 'vy', 'z', 'vz')

    See Also:
        ``rotational``, the other half; ``coupled``.
    """
    dynamics = Translational(**parameters)
    return System(
        dynamics,
        time_step,
        substeps,
        name="translational",
        units=_POSITION_UNITS | {"U1": "N", "ux": "1", "uy": "1"},
        input_lower=(0.0, -0.7, -0.7),
        input_upper=(100.0, 0.7, 0.7),
        initial_input=(_weight(dynamics.mass), 0.0, 0.0),
        region=((-20.0, -2.0) * 3, (20.0, 2.0) * 3),
        pose=_POSITION,
        **_FOLLOWS_POSITIONS,
    )


def rotational(
    time_step: float = 0.05, substeps: int = 10, **parameters: Any
) -> System:
    """Makes the rotational subsystem at 20 Hz.

    A trajectory prescribes the attitudes that a flight along it needs.

    >>> len(rotational().state_names)
    6

    See Also:
        ``translational``, the other half; ``coupled``.
    """
    return System(
        Rotational(**parameters),
        time_step,
        substeps,
        name="rotational",
        units=_ANGLE_UNITS | dict.fromkeys(("U2", "U3", "U4"), "N"),
        input_lower=(-2.0,) * 3,
        input_upper=(2.0,) * 3,
        tracked=("phi", "theta", "psi"),
        rates={"p": "phi", "q": "theta", "r": "psi"},
        region=((-0.5, -1.0) * 3, (0.5, 1.0) * 3),
        lost=math.pi / 2,  # a vehicle on its side carries itself no more
        references=rotational_states_along,
        pose=_ATTITUDE,
        z_down=True,
    )


def coupled(
    mass: float = 0.74, time_step: float = 0.05, substeps: int = 2, **parameters: Any
) -> System:
    """Makes the whole quadrotor at the rate of its inner loop.

    Its mass is in kg, and ``parameters`` are those of ``Rotational``.

    >>> len(coupled().state_names)
    12

    See Also:
        ``translational`` and ``rotational``, its halves.
    """
    return System(
        Coupled(mass, Rotational(**parameters)),
        time_step,
        substeps,
        name="coupled",
        units=_POSITION_UNITS
        | _ANGLE_UNITS
        | dict.fromkeys(("U1", "U2", "U3", "U4"), "N"),
        input_lower=(0.0, -2.0, -2.0, -2.0),
        input_upper=(20.0, 2.0, 2.0, 2.0),
        initial_input=(_weight(mass), 0.0, 0.0, 0.0),
        region=((-2.0, -1.0) * 3 + (-0.3, -0.5) * 3, (2.0, 1.0) * 3 + (0.3, 0.5) * 3),
        pose=_POSITION | _ATTITUDE,
        **_FOLLOWS_POSITIONS,
    )


def _weight(mass: float) -> float:
    """Returns the thrust that carries a mass [N]; the paper rounds it, to 7.26."""
    return 7.26 * (mass / 0.74)


def thrust_direction(phi: Any, theta: Any, psi: Any) -> tuple[Any, Any, Any]:
    """Returns the unit vector along the thrust, (ux, uy, lift) [-].

    Of roll, pitch and yaw [rad]; Cao et al. (2017), eq. (2).
    """
    ux = cos(phi) * sin(theta) * cos(psi) + sin(phi) * sin(psi)
    uy = cos(phi) * sin(theta) * sin(psi) - sin(phi) * cos(psi)
    return ux, uy, cos(phi) * cos(theta)


def attitude_for_thrust_direction(
    ux: np.ndarray,
    uy: np.ndarray,
    psi: np.ndarray | float = 0.0,
    convention: str = "exact",
) -> np.ndarray:
    """Returns roll and pitch (*batch, 2) [rad] that point the thrust along (ux, uy).

    This is eq. (2) inverted, at a yaw psi. Turned by -psi, eq. (2) is that of psi = 0,
    where ux = cos(phi) sin(theta) and uy = -sin(phi) give phi = -asin(uy) and theta =
    asin(ux / cos(phi)). The authors' data hold theta = sign(phi) asin(ux) instead,
    which the convention ``"paper"`` takes in the place of ``"exact"``; any other is a
    ``SettingError``. ux and uy saturate at 1 and -1.

    See Also:
        ``rotational``, which follows such attitudes.
    """
    check_choice("attitude", convention, ATTITUDES)
    ux, uy = ux * np.cos(psi) + uy * np.sin(psi), uy * np.cos(psi) - ux * np.sin(psi)
    phi = -np.arcsin(np.clip(uy, -1, 1))
    if convention == "paper":
        theta = np.sign(phi) * np.arcsin(np.clip(ux, -1, 1))
    else:
        horizontal = np.cos(phi)
        ratio = np.divide(
            ux, horizontal, out=np.zeros_like(horizontal), where=horizontal > 1e-12
        )
        theta = np.arcsin(np.clip(ratio, -1, 1))
    return np.stack([phi, theta], axis=-1)


def attitudes_along(
    trajectory: Trajectory, count: int, outer_step: float = OUTER_STEP
) -> np.ndarray:
    """Returns roll and pitch (count, 2) [rad] along a trajectory, one an outer step.

    Between two outer steps the velocity has to change by v[k+1] - v[k], so the thrust
    has to give the mean acceleration a = (v[k+1] - v[k]) / T beside the weight: U1 / m
    = |a - g e_z|, ux = a_x / (U1 / m), uy = a_y / (U1 / m).
    """
    velocities = trajectory.velocity(outer_step * np.arange(count + 1))
    accelerations = np.diff(velocities, axis=0) / outer_step
    thrust = accelerations - [0.0, 0.0, GRAVITY]  # over the mass [m/s^2]
    magnitude = np.linalg.norm(thrust, axis=1, keepdims=True)
    direction = thrust / np.maximum(magnitude, 1e-12)  # of a free fall: none
    return attitude_for_thrust_direction(direction[:, 0], direction[:, 1])


def approach_attitudes(
    angles: np.ndarray, count: int, hold: int, time_step: float, response_time: float
) -> np.ndarray:
    """Returns rotational states (count, 6) that approach attitudes at first order.

    As ``Cascade`` asks it to: roll and pitch (K, 2) [rad], from the first of them on,
    are the target for ``hold`` inner steps each; times [s].
    """
    decay = np.exp(-time_step / response_time)  # of the error, in one step
    states = np.zeros((count, 6))
    attitude = angles[0]
    for j in range(count):
        target = angles[j // hold]
        states[j, [0, 2]] = attitude
        states[j, [1, 3]] = (target - attitude) / response_time
        attitude = target + decay * (attitude - target)
    return states


def rotational_states_along(
    trajectory: Trajectory, count: int, time_step: float
) -> np.ndarray:
    """Returns the rotational states of a flight along a trajectory.

    phi, p, theta, q, psi, r (count, 6) [rad, rad/s], one an inner step.
    """
    hold = max(1, round(OUTER_STEP / time_step))
    angles = attitudes_along(trajectory, -(-count // hold))
    return approach_attitudes(angles, count, hold, time_step, RESPONSE_TIME)
