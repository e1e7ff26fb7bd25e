"""A quadrotor in MuJoCo with drag and rotors that lag, and its known rigid body.

The model is ``quadrotor.xml`` beside this file. Its z axis points upwards; roll, pitch
and yaw turn the vehicle about its own x, y and z axes, yaw first (Beard and McLain,
2012, eqs. (3.1)-(3.3)). Needs the extra ``sim``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gpmpc.exceptions import check_number, check_numbers
from gpmpc.systems._elementary import cos, sin
from gpmpc.systems._system import GRAVITY, System
from gpmpc.systems.mujoco_ import mujoco_system

_MODEL = Path(__file__).with_name("quadrotor.xml")
ROTORS = ("u1", "u2", "u3", "u4")
_MASS = 0.5  # of the model [kg]


@dataclass(frozen=True)
class RigidBody:
    """A rigid body that four rotors lift and turn.

    It knows neither drag nor that the rotors lag.
    """

    mass: float = 0.4  #: [kg]; less than the model's: that is left to be learned
    #: principal moments of inertia [kg m^2]
    inertia: tuple[float, float, float] = (0.0025, 0.0025, 0.0045)
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
        vx, vy, vz = x[1], x[3], x[5]
        p, q, r = x[7], x[9], x[11]
        ixx, iyy, izz = self.inertia
        s1, c1 = sin(x[6]), cos(x[6])  # of roll
        s2, c2 = sin(x[8]), cos(x[8])  # of pitch
        s3, c3 = sin(x[10]), cos(x[10])  # of yaw
        lift = (u[0] + u[1] + u[2] + u[3]) / self.mass
        vx_dot = lift * (c3 * s2 * c1 + s3 * s1)
        vy_dot = lift * (s3 * s2 * c1 - c3 * s1)
        vz_dot = lift * c1 * c2 - GRAVITY
        turning = q * s1 + r * c1
        roll_dot = p + turning * s2 / c2
        pitch_dot = q * c1 - r * s1
        yaw_dot = turning / c2
        roll_torque = self.arm * (u[0] - u[1] - u[2] + u[3])
        pitch_torque = self.arm * (u[2] + u[3] - u[0] - u[1])
        yaw_torque = self.yaw * (u[1] + u[3] - u[0] - u[2])
        p_dot = ((iyy - izz) * q * r + roll_torque) / ixx
        q_dot = ((izz - ixx) * p * r + pitch_torque) / iyy
        r_dot = ((ixx - iyy) * p * q + yaw_torque) / izz
        return [
            vx,
            vx_dot,
            vy,
            vy_dot,
            vz,
            vz_dot,
            roll_dot,
            p_dot,
            pitch_dot,
            q_dot,
            yaw_dot,
            r_dot,
        ]


def mujoco_quadrotor(
    mass: float = _MASS,
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0),
    input_delay: int = 0,
    substeps: int = 8,
    known: dict[str, Any] | None = None,
) -> System:
    """Makes the quadrotor by its sensors, with a rigid body as its nominal model.

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
    units = {
        **dict.fromkeys(("x", "y", "z"), "m"),
        **dict.fromkeys(("vx", "vy", "vz"), "m/s"),
        **dict.fromkeys(("roll", "pitch", "yaw"), "rad"),
        **dict.fromkeys(("p", "q", "r"), "rad/s"),
        **dict.fromkeys(ROTORS, "N"),
    }
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
    # What follows from the mass.
    flown.dynamics.mujoco.mj_setConst(model, flown.dynamics.data)
    # Linear drag in a wind is drag in still air and a constant force, which gravity on
    # the one body can bring.
    drag = model.dof_damping[[model.joint(axis).dofadr[0] for axis in "xyz"]]  # [N s/m]
    model.opt.gravity += drag * np.array(wind) / mass
    return flown


def _joint_positions(state: np.ndarray) -> np.ndarray:
    """Returns the positions of the model's joints (7,) in a state (12,)."""
    yaw_pitch_roll = np.asarray(state)[10:5:-2]
    qx, qy, qz, scalar = Rotation.from_euler("ZYX", yaw_pitch_roll).as_quat()
    return np.array([state[0], state[2], state[4] - 1, scalar, qx, qy, qz])


def _state(measured: np.ndarray) -> np.ndarray:
    """Returns the state (12,) from position, velocity, quaternion and body rates."""
    position, velocity, quaternion, rates = np.split(measured, (3, 6, 10))
    scalar_last = quaternion[[1, 2, 3, 0]]
    yaw_pitch_roll = Rotation.from_quat(scalar_last).as_euler("ZYX")
    angles = yaw_pitch_roll[::-1]
    # Each value stands before its rate: x, vx, y, vy, ..., yaw, r.
    translational = np.stack([position, velocity], axis=1).ravel()
    rotational = np.stack([angles, rates], axis=1).ravel()
    return np.concatenate([translational, rotational])
