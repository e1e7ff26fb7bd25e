"""Holds a cart as near to a wall as 95 % allow, while gusts push it.

Run as `python examples/wall.py FOLDER` (the present folder by default); it writes
wall.png there.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from gpmpc.gp import Transitions, standardize, train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, closed_loop
from gpmpc.systems import System, step_many

# [m], [-]
WALL = 1.0
STEPS = 400
GUSTS = [0.005, 0.05]  # standard deviations a step [m, m/s]


class Cart:
    """A cart with drag that is pushed along a rail."""

    state_names = ("position", "velocity")
    input_names = ("push",)

    def derivative(self, x, u):
        """d/dt of the state."""
        return [x[1], 2.0 * u[0] - 0.5 * x[1] - 0.2 * x[1] ** 3]


cart = System(Cart(), time_step=0.1, units={"position": "m", "velocity": "m/s"})
rng = np.random.default_rng(0)
states = rng.uniform([-1.5, -2.0], [1.5, 2.0], (300, 2))
pushes = rng.uniform(-2, 2, (300, 1))
after = step_many(cart, states, pushes) + rng.normal(0, GUSTS, (300, 2))
gp = train(
    Transitions(states, pushes, after), predicts="difference", scaling=standardize
).posterior

flights = {}
for name, probability in (
    ("mean behind the wall", None),
    ("95 % of what may come", 0.95),
):
    behind = Box(upper=[WALL, np.inf], probability=probability)
    problem = Problem(
        Tracking([10.0, 0.1], [0.1]), inputs=Box([-2.0], [2.0]), constraints=[behind]
    )
    controller = GPMPC(gp, Linearization(), problem, horizon=10, initial_input=[0.0])
    flights[name] = closed_loop(
        cart, controller, [WALL, 0.0], [-1.0, 0.0], STEPS, noise=Noise(process=GUSTS)
    )
    beyond = (flights[name].states[1:, 0] > WALL).mean()
    print(f"{name:24} beyond the wall in {beyond:4.1%} of the steps")

plt.style.use("gpmpc.plotting.gpmpc")
figure, axis = plt.subplots(figsize=(7, 3.4))
for (name, flight), color in zip(flights.items(), ("C1", "C0"), strict=True):
    axis.plot(flight.times, flight.states[:, 0], color=color, linewidth=1, label=name)
axis.axhline(WALL, color="black", linewidth=2, label="wall")
axis.set(
    xlabel="time [s]",
    ylabel="position [m]",
    ylim=(0.9, 1.04),
    title="A cart at a wall, gusts of 0.05 m/s per step",
)
figure.legend(loc="outside lower center", ncols=3)
figure.savefig(Path(sys.argv[1] if len(sys.argv) > 1 else ".") / "wall.png")
