"""A quadrotor in MuJoCo, learned from its flights, picks up a fifth of its mass.

Run as `python examples/payload.py FOLDER` (the present folder by default; needs `pip
install 'gpmpc[sim]'`). It writes payload.png, a recording, and payload.gif where MuJoCo
can render without a screen. The data sheet's mass and inertia are a fifth too small,
and know neither drag nor that the rotors lag; GPs learn what it misses from three
dithered flights.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gp import Trainer, Transitions, standardize
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import CasadiFunction, KnownModel, ResidualModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.plotting import film
from gpmpc.propagation import Linearization
from gpmpc.recording import McapRecorder, RecordedSystem, read_run
from gpmpc.simulation import Noise, closed_loop
from gpmpc.systems.mujoco_quadrotor import mujoco_quadrotor

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
MEASURED = [0.003, 0.01] * 3 + [
    0.002,
    0.02,
] * 3  # standard deviations [m, m/s], [rad, rad/s]
PROBLEM = Problem(
    Tracking([10, 1, 10, 1, 10, 1, 0.3, 0.3, 0.3, 0.3, 1, 0.3], [5.0] * 4),
    inputs=Box([0.0] * 4, [3.0] * 4),
)
vehicle = mujoco_quadrotor()
rng = np.random.default_rng(0)
data_sheet = CasadiFunction(successor_function(vehicle.nominal))


def curve(frequencies, steps):
    """States (steps, 12) of sums of sines from rest about a metre above the ground."""
    t = 0.04 * np.arange(steps)[:, None]
    states = np.zeros((steps, 12))
    states[:, 0:6:2] = [0, 0, 1] + np.minimum(t / 2, 1) * [1.0, 1.0, 0.3] * np.sin(
        frequencies * t
    )
    states[:, 1:6:2] = np.gradient(states[:, 0:6:2], 0.04, axis=0)
    return Reference(states)


def fly(plant, model, reference, gain=0.0, dither=0.0, seed=0, on_step=None):
    """Flies along a curve with a model."""
    settings = PredictionSettings(disturbance_gain=gain)
    controller = GPMPC(
        model, Linearization(), PROBLEM, 20, plant.initial_input, settings
    )
    noise = Noise(measurement=MEASURED, input=[dither] * 4)
    steps = len(reference.states) - 21
    return closed_loop(
        plant,
        controller,
        reference,
        None,
        steps,
        noise=noise,
        on_failure="previous_plan",
        seed=seed,
        on_step=on_step,
    )


rows = []
for seed in range(3):
    flown = fly(
        vehicle,
        KnownModel(data_sheet, 12, 4),
        curve(rng.uniform(0.6, 2, 3), 200),
        dither=0.1,
        seed=seed,
    )
    rows.append((flown.measured[:-1], flown.inputs[:-1], flown.measured[1:]))
states, inputs, next_states = (
    np.concatenate(part)[::3] for part in zip(*rows, strict=True)
)
data = Transitions(states, inputs, next_states)
B = torch.eye(12, dtype=torch.float64)[
    :, 1::2
]  # what is missed acts on velocities and rates
trainer = Trainer(predicts="difference", scaling=standardize, restarts=0)
learned = ResidualModel.train(
    data_sheet, data, B, states=[1, 3, 5, 6, 7, 8, 9, 10, 11], trainer=trainer
)

loaded = mujoco_quadrotor(mass=0.6)
reference = curve(np.array([0.8, 1.6, 0.8]), 300)
recording = FOLDER / "payload.mcap"
flights = {
    "data sheet": fly(loaded, KnownModel(data_sheet, 12, 4), reference),
    "learned without the payload": fly(loaded, learned, reference),
}
with McapRecorder(recording, RecordedSystem.of(loaded)) as recorder:
    flights["and an estimate of what is new"] = fly(
        loaded, learned, reference, 0.3, on_step=recorder.record
    )

plt.style.use("gpmpc.plotting.gpmpc")
figure, (above, height) = plt.subplots(1, 2, figsize=(9, 4))
above.plot(*reference.states[:280, [0, 2]].T, "--", color="0.6", label="reference")
height.plot(0.04 * np.arange(280), reference.states[:280, 4], "--", color="0.6")
rmse = {}
for (name, flight), color in zip(flights.items(), ("C1", "C0", "C2"), strict=True):
    rmse[name] = float(
        np.sqrt(((flight.states - flight.references)[:, 0:6:2] ** 2).sum(axis=1).mean())
    )
    print(f"{name}: RMSE {rmse[name]:.3f} m")
    above.plot(
        *flight.states[:, [0, 2]].T,
        color=color,
        linewidth=1,
        label=f"{name}: {100 * rmse[name]:.1f} cm",
    )
    height.plot(flight.times, flight.states[:, 4], color=color, linewidth=1)
above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
height.set(xlabel="time [s]", ylabel="z [m]")
figure.legend(loc="outside upper center", ncols=4, fontsize="small")
figure.savefig(FOLDER / "payload.png")
try:
    film(read_run(recording), loaded, FOLDER / "payload.gif", frames=60, enlarged=5)
except SettingError as error:
    print(error)
