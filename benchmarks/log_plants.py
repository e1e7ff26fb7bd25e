"""Six simulated plants, and the noisy logs of their excited runs.

A pendulum, a cart-pole, a quadruple tank, a bicycle car, a two-link arm in MuJoCo and a
quadrotor in MuJoCo whose rotors lag. A log has 60 s at 100 Hz: inputs that are held for
random times (added to a weak feedback where the plant would run away), and white noise
on every measured state.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas
from scipy.spatial.transform import Rotation

from gpmpc.systems import System, cart_pole, pendulum, step
from gpmpc.systems.mujoco_ import mujoco_system
from gpmpc.systems.mujoco_quadrotor import mujoco_quadrotor

Array = np.ndarray
RATE = 100.0  # [Hz]
DURATION = 60.0  # [s]
GRAVITY = 9.81  # [m/s^2]
Law = Callable[[float, Array], Array]  # from time [s] and state to the inputs

ARM = """
<mujoco>
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1.0"/>
      <body pos="0 0 -0.4">
        <joint name="elbow" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.025" mass="0.6"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="tau1" joint="shoulder" ctrlrange="-6 6" ctrllimited="true"/>
    <motor name="tau2" joint="elbow" ctrlrange="-2 2" ctrllimited="true"/>
  </actuator>
</mujoco>
"""
LAGGING_PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="1.0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="torque" joint="hinge" dyntype="filter" dynprm="0.08"
      ctrlrange="-4 4" ctrllimited="true"/>
  </actuator>
  <sensor>
    <jointpos name="angle" joint="hinge"/>
    <jointvel name="rate" joint="hinge"/>
  </sensor>
</mujoco>
"""
BODY = ["px", "py", "pz", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx", "wy", "wz"]
ROTORS = ["u1", "u2", "u3", "u4"]


@dataclass(frozen=True)
class QuadrupleTank:
    """Four tanks and two pumps (Johansson, 2000), small enough to fill in seconds."""

    state_names = ("h1", "h2", "h3", "h4")  # [cm]
    input_names = ("pump1", "pump2")  # [V]

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt of the levels [cm/s]."""
        area, split1, split2, gain1, gain2 = 4.0, 0.7, 0.6, 3.33, 3.35
        hole1, hole2, hole3, hole4 = 0.071, 0.057, 0.071, 0.057
        q = [
            hole * (2 * 981.0 * abs(level) + 1e-6) ** 0.5
            for hole, level in zip((hole1, hole2, hole3, hole4), x, strict=True)
        ]
        return [
            (-q[0] + q[2] + split1 * gain1 * u[0]) / area,
            (-q[1] + q[3] + split2 * gain2 * u[1]) / area,
            (-q[2] + (1 - split2) * gain2 * u[1]) / area,
            (-q[3] + (1 - split1) * gain1 * u[0]) / area,
        ]


@dataclass(frozen=True)
class BicycleCar:
    """A car on two wheels, with drag."""

    state_names = ("x", "y", "heading", "speed")
    input_names = ("throttle", "steering")  # [m/s^2], [rad]

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (x, y, heading, speed)."""
        slip = np.arctan(0.5 * np.tan(u[1]))
        return [
            x[3] * np.cos(x[2] + slip),
            x[3] * np.sin(x[2] + slip),
            x[3] * np.sin(slip) / 0.16,
            u[0] - 0.4 * x[3] - 0.05 * x[3] * abs(x[3]),
        ]


@dataclass(frozen=True)
class Plant:
    """A plant, how it is excited and measured, and what its log's columns mean."""

    name: str
    system: Callable[[], System]  # made anew: a simulator moves on by itself
    mapping: Mapping[str, Any]
    noise: tuple[float, ...]  # standard deviations of the measurements
    excite: Callable[[np.random.Generator], Law]
    start: tuple[float, ...]

    def log(self, seed: int) -> pandas.DataFrame:
        """Simulates a log of 60 s."""
        rng = np.random.default_rng(seed)
        law = self.excite(rng)
        system = self.system()
        x = np.array(self.start)
        reset = getattr(system.dynamics, "reset", None)
        if reset is not None:
            x = np.asarray(reset(seed), dtype=float)
        rows = []
        for k in range(int(DURATION * RATE)):
            u = law(k / RATE, x)
            u = np.clip(u, system.input_lower, system.input_upper)
            rows.append(np.r_[k / RATE, x, u])
            x = np.asarray(step(system, x, u), dtype=float)
        table = np.array(rows)
        n = len(self.start)
        table[:, 1 : n + 1] = self._measured(table[:, 1 : n + 1], rng)
        names = ["t", *system.state_names, *system.input_names]
        return pandas.DataFrame(table, columns=names)

    def _measured(self, states: Array, rng: np.random.Generator) -> Array:
        """Adds white noise; to an attitude, a small turn."""
        noise = rng.normal(size=(len(states), len(self.noise))) * self.noise
        if len(self.noise) == states.shape[1]:
            return states + noise
        turned = Rotation.from_quat(states[:, 3:7]) * Rotation.from_rotvec(
            noise[:, 3:6]
        )
        return np.hstack(
            [
                states[:, :3] + noise[:, :3],
                turned.as_quat(),
                states[:, 7:] + noise[:, 6:],
            ]
        )


def held(
    rng: np.random.Generator, low: Any, high: Any, shortest: float, longest: float
) -> Law:
    """Inputs that are drawn anew after random times [s], each on its own."""
    low = np.asarray(low, dtype=float)
    high = np.asarray(high, dtype=float)
    values = []
    for i in range(len(low)):
        column: list[float] = []
        while len(column) < DURATION * RATE + 1:
            rows = round(rng.uniform(shortest, longest) * RATE)
            column += [rng.uniform(low[i], high[i])] * max(rows, 1)
        values.append(column[: int(DURATION * RATE) + 1])
    table = np.array(values).T
    return lambda time, state: table[round(time * RATE)]


def _vectors(units: Mapping[str, str], angles: tuple[str, ...] = ()) -> dict[str, Any]:
    """Returns signals of a column each, some of them angles."""
    return {
        name: {"columns": [name], "unit": unit}
        | ({"kind": "angle"} if name in angles else {})
        for name, unit in units.items()
    }


def _cart_excitation(rng: np.random.Generator) -> Law:
    random = held(rng, [-8.0], [8.0], 0.1, 0.6)
    return lambda t, x: random(t, x) - 3.0 * x[:1] - 2.0 * x[1:2]


def _car_excitation(rng: np.random.Generator) -> Law:
    random = held(rng, [-1.5, -0.35], [3.0, 0.35], 0.2, 1.0)

    def law(time: float, x: Array) -> Array:
        return random(time, x) + np.array([0.8 * (1.5 - x[3]), 0.0])

    return law


def _arm_excitation(rng: np.random.Generator) -> Law:
    random = held(rng, [-5.0, -1.6], [5.0, 1.6], 0.1, 0.5)
    return lambda t, x: random(t, x)


def _quadrotor_excitation(rng: np.random.Generator) -> Law:
    """Flies along sums of sines, with dithered thrusts."""
    frequencies = rng.uniform(0.5, 1.8, 3)
    dither = held(rng, [-0.12] * 4, [0.12] * 4, 0.02, 0.1)
    signs = np.array([[1, -1, -1, 1], [-1, -1, 1, 1], [-1, 1, -1, 1]])

    def law(time: float, x: Array) -> Array:
        target = [0, 0, 1] + np.array([0.8, 0.8, 0.3]) * np.sin(frequencies * time)
        force = 4.0 * (target - x[:3]) - 3.0 * x[7:10] + [0, 0, GRAVITY]
        attitude = Rotation.from_quat(x[3:7])
        up = attitude.inv().apply(force / np.linalg.norm(force))
        yaw = attitude.as_euler("ZYX")[0]
        rates = np.array([-8 * up[1], 8 * up[0], -2 * yaw])
        moments = np.array([0.0025, 0.0025, 0.0045]) * 15 * (rates - x[10:])
        levers = np.array([0.12, 0.12, 0.016])
        collective = 0.5 * float(attitude.inv().apply(force)[2]) / 4
        return collective + (moments / levers) @ signs / 4 + dither(time, x)

    return law


def _mujoco(xml: str, **settings: Any) -> System:
    """Makes a MuJoCo model; its file only has to live until it is loaded."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(xml)
        return mujoco_system(path, substeps=5, **settings)


def _arm() -> System:
    return _mujoco(ARM, joints=["shoulder", "elbow"], actuators=["tau1", "tau2"])


def _lagging_pendulum() -> System:
    return _mujoco(
        LAGGING_PENDULUM,
        sensors=["angle", "rate"],
        actuators=["torque"],
        angles=["angle"],
        observation={"input_delay": 4},
    )


def _quadrotor() -> System:
    return mujoco_system(
        mujoco_quadrotor().dynamics.path,
        actuators=ROTORS,
        sensors=["position", "quaternion", "velocity", "rate"],
        substeps=2,
        observation={
            "state_names": BODY,
            "observe": lambda s: np.r_[s[:3], s[4:7], s[3], s[7:]],
        },
        tracked=["px", "py", "pz"],
        goal=[0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0],
        initial_input=[0.5 * GRAVITY / 4] * 4,
    )


def lagging_pendulum() -> Plant:
    """Returns a pendulum whose motor lags and acts late; neither is measured."""
    return Plant(
        name="lagging pendulum",
        system=_lagging_pendulum,
        mapping={
            "time": "t",
            "states": _vectors({"angle": "rad", "rate": "rad/s"}, ("angle",)),
            "inputs": {"torque": {"columns": ["torque"], "unit": "N m"}},
        },
        noise=(0.005, 0.03),
        excite=lambda rng: held(rng, [-4.0], [4.0], 0.1, 0.8),
        start=(0.0, 0.0),
    )


def plants() -> list[Plant]:
    """Returns the six plants."""
    return [
        Plant(
            name="pendulum",
            system=lambda: pendulum(1 / RATE),
            mapping={
                "time": "t",
                "states": _vectors({"angle": "rad", "rate": "rad/s"}, ("angle",)),
                "inputs": {"torque": {"columns": ["torque"], "unit": "N m"}},
            },
            noise=(0.01, 0.05),
            excite=lambda rng: held(rng, [-2.0], [2.0], 0.1, 0.8),
            start=(np.pi, 0.0),
        ),
        Plant(
            name="cart-pole",
            system=lambda: cart_pole(1 / RATE),
            mapping={
                "time": "t",
                "states": _vectors(
                    {
                        "position": "m",
                        "velocity": "m/s",
                        "angle": "rad",
                        "rate": "rad/s",
                    },
                    ("angle",),
                ),
                "inputs": {"force": {"columns": ["force"], "unit": "N"}},
            },
            noise=(0.003, 0.02, 0.005, 0.05),
            excite=_cart_excitation,
            start=(0.0, 0.0, np.pi, 0.0),
        ),
        Plant(
            name="quadruple tank",
            system=lambda: System(
                QuadrupleTank(), 1 / RATE, 2, input_lower=[0, 0], input_upper=[8, 8]
            ),
            mapping={
                "time": "t",
                "states": _vectors({"h1": "", "h2": "", "h3": "", "h4": ""}),
                "inputs": _vectors({"pump1": "", "pump2": ""}),
            },
            noise=(0.05, 0.05, 0.05, 0.05),
            excite=lambda rng: held(rng, [0.5, 0.5], [6.0, 6.0], 1.0, 6.0),
            start=(8.0, 8.0, 2.0, 2.0),
        ),
        Plant(
            name="bicycle car",
            system=lambda: System(
                BicycleCar(), 1 / RATE, 2, input_lower=[-3, -0.5], input_upper=[3, 0.5]
            ),
            mapping={
                "time": "t",
                "states": {
                    "position": {"columns": ["x", "y"], "unit": "m"},
                    "heading": {"columns": ["heading"], "unit": "rad", "kind": "angle"},
                    "speed": {"columns": ["speed"], "unit": "m/s"},
                },
                "inputs": {
                    "throttle": {"columns": ["throttle"], "unit": "m/s2"},
                    "steering": {"columns": ["steering"], "unit": "rad"},
                },
            },
            noise=(0.02, 0.02, 0.005, 0.03),
            excite=_car_excitation,
            start=(0.0, 0.0, 0.0, 1.0),
        ),
        Plant(
            name="two-link arm",
            system=_arm,
            mapping={
                "time": "t",
                "states": {
                    "joints": {
                        "columns": ["shoulder", "elbow"],
                        "unit": "rad",
                        "kind": "angle",
                    },
                    "rates": {
                        "columns": ["shoulder_rate", "elbow_rate"],
                        "unit": "rad/s",
                    },
                },
                "inputs": {"torques": {"columns": ["tau1", "tau2"], "unit": "N m"}},
            },
            noise=(0.004, 0.004, 0.03, 0.03),
            excite=_arm_excitation,
            start=(0.0, 0.0, 0.0, 0.0),
        ),
        Plant(
            name="quadrotor",
            system=_quadrotor,
            mapping={
                "time": "t",
                "model": "rigid_body",
                "states": {
                    "position": {"columns": BODY[:3], "unit": "m"},
                    "attitude": {
                        "columns": BODY[3:7],
                        "kind": "quaternion",
                        "order": "xyzw",
                    },
                    "velocity": {
                        "columns": BODY[7:10],
                        "unit": "m/s",
                        "frame": "world",
                    },
                    "rate": {"columns": BODY[10:], "unit": "rad/s", "frame": "body"},
                },
                "inputs": {"thrusts": {"columns": ROTORS, "unit": "N"}},
            },
            noise=(0.004,) * 3 + (0.004,) * 3 + (0.02,) * 3 + (0.03,) * 3,
            excite=_quadrotor_excitation,
            start=(0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0),
        ),
    ]
