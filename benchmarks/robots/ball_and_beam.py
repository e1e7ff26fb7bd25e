"""Ball and beam: a ball rolls on a beam whose angle accelerates as commanded."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, sin


class BallAndBeam:
    state_names, input_names = ("r", "v", "tilt", "tilt_rate"), ("turn",)

    def derivative(self, x, u):
        return [x[1], 5 / 7 * (x[0] * x[3] ** 2 - 9.81 * sin(x[2])), x[3], u[0]]


plant = System(
    BallAndBeam(), time_step=0.05, input_lower=[-6.0], input_upper=[6.0],
    units={"r": "m", "v": "m/s", "tilt": "rad", "tilt_rate": "rad/s"},
    tracked=["r", "tilt"], rates={"v": "r", "tilt_rate": "tilt"}, start=[0.8, 0, 0, 0],
    region=[[-1.0, -1.0, -0.6, -2.0], [1.0, 1.0, 0.6, 2.0]],
)  # fmt: skip
seed = int(sys.argv[1])
noise = [0.001, 0.005, 0.001, 0.005]
data = RandomData(samples=300, noise=noise, seed=seed).transitions(plant)
model = train(data, system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[10.0, 0.1, 1.0, 0.1], R=[0.01], penalized="inputs"),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 30, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=120)
print(np.round(flight.states[-1], 3))
