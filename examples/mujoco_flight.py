"""A quadrotor in MuJoCo is learned from the logs of its own flights.

Run as `python examples/mujoco_flight.py FOLDER` (the present folder by default; needs
`pip install 'gpmpc[sim]'`). The data sheet's mass is a fifth too small, its inertia
too, and it knows neither drag nor that the rotors lag. Four flights with that model,
excited by dithered thrusts, become CSV files; `gpmpc.logs.learn` makes a model of them,
and the same controller flies a curve that no flight before it flew, with either model.
"""

import sys
from pathlib import Path

import numpy as np
import pandas

from gpmpc.logs import LogMapping, learn, load_flyable, read_log, save_learned
from gpmpc.models import LogDynamics, LogModel, MultirotorNominal, RigidBodyKinematics
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, Rollout, closed_loop
from gpmpc.systems import System
from gpmpc.systems.mujoco_ import mujoco_system
from gpmpc.systems.mujoco_quadrotor import mujoco_quadrotor

STEP = 0.02
ROTORS = ["u1", "u2", "u3", "u4"]
STATES = ["px", "py", "pz", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx", "wy", "wz"]
MAPPING = {
    "time": "t",
    "model": "rigid_body",
    "states": {
        "position": {"columns": STATES[:3], "unit": "m"},
        "attitude": {"columns": STATES[3:7], "kind": "quaternion", "order": "xyzw"},
        "velocity": {"columns": STATES[7:10], "unit": "m/s", "frame": "world"},
        "rate": {"columns": STATES[10:], "unit": "rad/s", "frame": "body"},
    },
    "inputs": {"thrusts": {"columns": ROTORS, "unit": "N"}},
}
# of the data sheet [kg], [kg m2], [m], [m]
MASS = 0.4
INERTIA = (0.0025, 0.0025, 0.0045)
ARM = 0.12
YAW = 0.016
SIGNS = np.array(
    [[1, -1, -1, 1], [-1, -1, 1, 1], [-1, 1, -1, 1]]
)  # of each rotor's roll, pitch and yaw


def quadrotor() -> System:
    """The package's quadrotor by its sensors, quaternions scalar last."""
    return mujoco_system(
        mujoco_quadrotor().dynamics.path,
        actuators=ROTORS,
        sensors=["position", "quaternion", "velocity", "rate"],
        substeps=4,
        observation={
            "state_names": STATES,
            "observe": lambda s: np.r_[s[:3], s[4:7], s[3], s[7:]],
        },
        tracked=["px", "py", "pz"],
        goal=[0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0],
        initial_input=[0.5 * 9.81 / 4] * 4,
    )


def data_sheet() -> LogDynamics:
    """A rigid body without drag, by the numbers of the data sheet."""
    lever = np.array([[ARM], [ARM], [YAW]]) / np.array(INERTIA)[:, None]
    theta = np.r_[4 / MASS, 0.0, 0.0, 0.0, 0.0, 0.0, (lever * SIGNS).ravel()]
    body = RigidBodyKinematics(LogMapping.from_dict(MAPPING).space)
    return LogDynamics(
        LogModel(
            body, MultirotorNominal(4, torque=True, thrusts=True), theta, (0,) * 6
        ),
        4,
        STEP,
    )


def curve(frequencies: np.ndarray, steps: int) -> np.ndarray:
    """Returns states (steps, 13) of sums of sines a metre high, from rest."""
    t = STEP * np.arange(steps)[:, None]
    reference = np.zeros((steps, 13))
    reference[:, 6] = 1.0
    ramp = np.minimum(t / 2, 1)
    reference[:, :3] = [0, 0, 1] + ramp * np.array([1.0, 1.0, 0.4]) * np.sin(
        frequencies * t
    )
    reference[:, 7:10] = np.gradient(reference[:, :3], STEP, axis=0)
    return reference


def fly(
    model, reference: np.ndarray, dither: float = 0.0, gain: float = 0.0, seed: int = 0
) -> Rollout:
    """Flies a curve with a model."""
    cost = Tracking(
        [10, 10, 10, 1, 1, 1, 0.1, 1, 1, 1, 0.05, 0.05, 0.05],
        [0.02] * 4,
        penalized="increments",
    )
    problem = Problem(cost, inputs=Box([0.0] * 4, [3.0] * 4))
    settings = PredictionSettings(disturbance_gain=gain)
    controller = GPMPC(
        model, Linearization(), problem, 20, [MASS * 9.81 / 4] * 4, settings
    )
    noise = Noise(input=[dither] * 4) if dither else None
    steps = len(reference) - 21
    return closed_loop(
        quadrotor(),
        controller,
        reference,
        None,
        steps,
        noise=noise,
        on_failure="previous_plan",
        seed=seed,
    )


def main(folder: Path) -> dict[str, float]:
    """Flies, learns, flies again; returns the RMSE of the position [m] by the model."""
    for seed in range(4):
        frequencies = np.random.default_rng(seed).uniform(0.6, 2.0, 3)
        flown = fly(data_sheet(), curve(frequencies, 400), dither=0.12, seed=seed)
        table = np.column_stack([flown.times[:-1], flown.states[:-1], flown.inputs])
        pandas.DataFrame(table, columns=["t", *STATES, *ROTORS]).to_csv(
            folder / f"flight_{seed}.csv", index=False
        )
    log = read_log(sorted(folder.glob("flight_*.csv")), MAPPING)
    learned = learn(log, points=100, steps=25, for_control=True, progress=print)
    save_learned(learned, folder / "model.safetensors")
    models = {
        "data sheet": data_sheet(),
        "learned": load_flyable(folder / "model.safetensors").model,
    }
    reference = curve(np.array([1.3, 1.7, 0.9]), 421)
    found = {}
    for gain in (0.0, 0.3):
        for name, model in models.items():
            flown = fly(model, reference, gain=gain)
            error = (flown.states - flown.references)[:, :3]
            found[f"{name}, disturbance_gain {gain:g}"] = float(
                np.sqrt((error**2).sum(axis=1).mean())
            )
    for name, rmse in found.items():
        print(f"{name}: {rmse:.3f} m")
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
