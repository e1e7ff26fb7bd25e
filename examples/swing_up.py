"""Learns a pendulum from 400 random samples and swings it up.

Its torque is too weak to lift it at once.
"""

import matplotlib.pyplot as plt
import numpy as np

from gpmpc.gp import Transitions, standardize, train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, step_many


class Pendulum:
    """Upright at (1, 0, 0); a unit of torque gives 3 rad/s^2, gravity up to 15."""

    state_names = ("cosine", "sine", "rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [-x[1] * x[2], x[0] * x[2], 15.0 * x[1] + 3.0 * u[0]]


plant = System(Pendulum(), time_step=0.05)
rng = np.random.default_rng(0)
angles = rng.uniform(-np.pi, np.pi, 400)
torques = rng.uniform(-2, 2, (400, 1))
states = np.column_stack([np.cos(angles), np.sin(angles), rng.uniform(-8, 8, 400)])
measured = step_many(plant, states, torques) + rng.normal(0, 0.001, (400, 3))
gp = train(
    Transitions(states, torques, measured), predicts="difference", scaling=standardize
).posterior

problem = Problem(
    Tracking([1.0, 1.0, 0.01], [0.01], penalized="inputs"), inputs=Box([-2.0], [2.0])
)
controller = GPMPC(gp, Linearization(), problem, horizon=30, initial_input=[0.0])
flight = closed_loop(plant, controller, [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], steps=100)

print(
    "upright after",
    flight.times[np.abs(flight.states[:, 0] - 1) > 0.01][-1].round(2),
    "s",
)
plt.style.use("gpmpc.plotting.gpmpc")
plt.legend(
    plt.plot(flight.times, flight.states),
    Pendulum.state_names,
    title="over time [s]; dashed: torque",
)
plt.step(flight.times[1:], flight.inputs, "k--")
plt.savefig("swing_up.png")
