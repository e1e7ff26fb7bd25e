"""A quadrotor becomes heavier, and its model learns that while it flies.

    python examples/learning.py [FOLDER]

The model was learned from a flight of the lighter vehicle. One step a second; at 20 s
the mass changes.
"""

import sys
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from gpmpc.datasets import Excitation, ExcitedData
from gpmpc.gp import Trainer, standardize
from gpmpc.learning import LearningController
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, Replaced, closed_loop
from gpmpc.systems import translational
from gpmpc.trajectories import Elliptical, states_along

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
STEPS = 60
HORIZON = 10
HOVER = [7.26, 0.0, 0.0]
light = translational()
heavy = translational(mass=1.2 * 0.74)

outer = Excitation([1] * 6, [1] * 3, HOVER, dither=[0.3, 0.03, 0.03], noise=[0.01] * 6)
data = ExcitedData(outer, outer).transitions(light, Elliptical())
model = Trainer(predicts="difference", scaling=standardize, restarts=0)(data).posterior

problem = Problem(Tracking([1] * 6, [1] * 3), Box([0, -0.7, -0.7], [20, 0.7, 0.7]))
plain = GPMPC(model, Linearization(), problem, HORIZON, HOVER)
references = states_along(Elliptical(), np.arange(STEPS + HORIZON + 1.0))
fly = partial(
    closed_loop,
    light,
    references=references,
    initial=references[0],
    steps=STEPS,
    noise=Noise(process=[0.01] * 6),
    disturbances=[Replaced(heavy, start=20.0)],
    on_failure="previous_plan",
)
flights = {"as learned": fly(plain), "online learning": fly(LearningController(plain))}

plt.style.use("gpmpc.plotting.gpmpc")
for (name, flight), line in zip(flights.items(), ("--", "-"), strict=True):
    away = np.linalg.norm((flight.states - flight.references)[:, [0, 2, 4]], axis=1)
    print(
        f"{name:16} {away[26:].max():.2f} m away at most, from 5 s after the change on"
    )
    plt.semilogy(flight.times[1:], away[1:], line, label=name)
plt.axvline(20.0, color="black", linestyle=":", label="a fifth heavier from here")
plt.xlabel("time [s]")
plt.ylabel("distance to the reference [m]")
plt.title("A quadrotor on an ellipse becomes a fifth heavier")
plt.figlegend(loc="outside lower center", ncols=3)
plt.savefig(FOLDER / "learning.png")
