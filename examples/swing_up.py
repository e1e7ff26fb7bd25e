"""Learns a pendulum from 400 random samples and swings it up.

Its torque is too weak to lift it at once.
"""

import numpy as np

from gpmpc.gp import Transitions
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.plotting import flight_figure
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, sin, step_many


class Pendulum:
    """Upright at 0 rad; a unit of torque gives 3 rad/s^2, gravity up to 15."""

    state_names = ("angle", "rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [x[1], 15.0 * sin(x[0]) + 3.0 * u[0]]


plant = System(
    Pendulum(),
    time_step=0.05,
    units={"angle": "rad", "rate": "rad/s", "torque": "N m"},
    input_lower=[-2.0],
    input_upper=[2.0],
    angles=["angle"],
    rates={"rate": "angle"},
)
rng = np.random.default_rng(0)
states = rng.uniform([-np.pi, -8.0], [np.pi, 8.0], (400, 2))
torques = rng.uniform(-2.0, 2.0, (400, 1))
measured = step_many(plant, states, torques) + rng.normal(0, 0.001, (400, 2))
model = train(Transitions(states, torques, measured), system=plant).posterior

problem = Problem(
    Tracking(Q=[1.0, 0.01], R=[0.01], penalized="inputs"),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, horizon=30, initial_input=[0.0])
flight = closed_loop(plant, controller, [0.0, 0.0], [np.pi, 0.0], steps=100)

away = np.abs(flight.states[:, 0]) > 0.1
print("upright after", flight.times[away][-1].round(2), "s")
flight_figure(flight, plant).savefig("swing_up.png")
