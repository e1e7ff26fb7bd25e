"""A quadrotor in MuJoCo whose rotors lag and which air drags on, and the rigid body that is known of it.

The model is ``quadrotor.xml`` beside this file. Its z axis points upwards; roll, pitch and yaw turn the vehicle about
its own x, y and z axes, yaw first (Beard and McLain, 2012, eqs. (3.1)-(3.3)). Needs the extra ``sim``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gpmpc.exceptions import check_number, check_numbers
from gpmpc.systems._system import GRAVITY, System, cos, sin
from gpmpc.systems.mujoco_ import mujoco_system

_MODEL = Path(__file__).with_name("quadrotor.xml")
ROTORS = ("u1", "u2", "u3", "u4")
# of the model [N s/m], [kg]
_DRAG = 0.25
_MASS = 0.5


@dataclass(frozen=True)
class RigidBody:
    """A rigid body that four rotors lift and turn; it knows neither drag nor that the rotors lag."""

    mass: float = 0.4  #: [kg]
    inertia: tuple[float, float, float] = (
        0.0025,
        0.0025,
        0.0045,
    )  #: principal moments of inertia [kg m^2]
    arm: float = 0.12  #: from the centre to a rotor, along x and along y [m]
    yaw: float = 0.016  #: torque about z that a rotor's thrust brings [m]

    state_names = (
        "x",
        "vx",
        "y",
        "vy",
        "z",
        "vz",
        "roll",
        "p",
        "pitch",
        "q",
        "yaw",
        "r",
    )
    input_names = ROTORS

    def __post_init__(self) -> None:
        for key in ("mass", "arm", "yaw"):
            check_number(key, getattr(self, key), above=0)
        check_numbers("inertia", self.inertia, 3, above=0)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt of the twelve states [m/s, m/s^2, rad/s, rad/s^2]."""
        (p, q, r), (ixx, iyy, izz) = (x[7], x[9], x[11]), self.inertia
        s1, c1, s2, c2, s3, c3 = (f(x[i]) for i in (6, 8, 10) for f in (sin, cos))
        lift = (u[0] + u[1] + u[2] + u[3]) / self.mass
        turned = q * s1 + r * c1
        roll = self.arm * (u[0] - u[1] - u[2] + u[3])
        pitch = self.arm * (u[2] + u[3] - u[0] - u[1])
        return [
            x[1],
            lift * (c3 * s2 * c1 + s3 * s1),
            x[3],
            lift * (s3 * s2 * c1 - c3 * s1),
            x[5],
            lift * c1 * c2 - GRAVITY,
            p + turned * s2 / c2,
            ((iyy - izz) * q * r + roll) / ixx,
            q * c1 - r * s1,
            ((izz - ixx) * p * r + pitch) / iyy,
            turned / c2,
            ((ixx - iyy) * p * q + self.yaw * (u[1] + u[3] - u[0] - u[2])) / izz,
        ]


def mujoco_quadrotor(
    mass: float = _MASS,
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0),
    input_delay: int = 0,
    substeps: int = 8,
    known: dict[str, Any] | None = None,
) -> System:
    """Makes the quadrotor by its sensors, with a data sheet's rigid body as the nominal model.

    Args:
        mass: [kg].
        wind: [m/s]; drag grows with the speed through the air.
        input_delay: Steps after which thrusts act.
        substeps: Steps of 5 ms per time step.
        known: Parameters of ``RigidBody`` that differ from the data sheet's.
    """
    check_number("mass", mass, above=0, unit="[kg]")
    check_numbers("wind", wind, 3, unit="[m/s]")
    names = RigidBody.state_names
    hover = [_MASS * GRAVITY / 4] * 4
    units = dict.fromkeys(("x", "y", "z"), "m") | dict.fromkeys(
        ("vx", "vy", "vz"), "m/s"
    )
    units |= (
        dict.fromkeys(("roll", "pitch", "yaw"), "rad")
        | dict.fromkeys("pqr", "rad/s")
        | dict.fromkeys(ROTORS, "N")
    )
    flown = mujoco_system(
        _MODEL,
        ROTORS,
        sensors=("position", "velocity", "quaternion", "rate"),
        substeps=substeps,
        observation={
            "state_names": names,
            "observe": _state,
            "input_delay": input_delay,
        },
        nominal=System(
            RigidBody(**(known or {})), 0.005 * substeps, 2, initial_input=hover
        ),
        units=units,
        initial_input=hover,
        goal=[0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0],
        tracked=("x", "y", "z"),
        rates={"vx": "x", "vy": "y", "vz": "z"},
        angles=("roll", "pitch", "yaw"),
        lost=10.0,
        pose={name: name for name in ("x", "y", "z", "roll", "pitch", "yaw")},
    )
    flown.dynamics.positions = _joint_positions
    model = flown.dynamics.model
    vehicle = flown.dynamics.model.body("vehicle").id
    model.body_mass[vehicle] = mass
    flown.dynamics.mujoco.mj_setConst(
        model, flown.dynamics.data
    )  # what follows from the mass
    # Linear drag in a wind is drag in still air and a constant force, which gravity on the one body can bring.
    model.opt.gravity += _DRAG * np.array(wind) / mass
    return flown


def _joint_positions(state: np.ndarray) -> np.ndarray:
    """The positions of the model's joints (7,) in a state (12,)."""
    turn = Rotation.from_euler("ZYX", np.asarray(state)[10:5:-2]).as_quat()
    return np.array(
        [state[0], state[2], state[4] - 1, turn[3], *turn[:3]]
    )  # the quaternion's scalar first


def _state(measured: np.ndarray) -> np.ndarray:
    """The states of position, velocity, quaternion and body rates."""
    position, velocity, quaternion, rates = np.split(measured, (3, 6, 10))
    angles = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_euler("ZYX")[
        ::-1
    ]  # scalar last
    return (
        np.stack([position, velocity, angles, rates])
        .reshape(2, 2, 3)
        .swapaxes(1, 2)
        .ravel()
    )
