"""Cart-pole whose sensor shows the pole's angle within one turn: it swings up."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, atan2, cart_pole, cos, sin


class Wrapped:
    state_names, input_names = ("position", "velocity", "angle", "rate"), ("force",)

    def successor(self, x, u):
        position, velocity, angle, rate = cart_pole().successor(x, u)
        return [position, velocity, atan2(sin(angle), cos(angle)), rate]


plant = System(
    Wrapped(), time_step=0.05, input_lower=[-10.0], input_upper=[10.0],
    angles=["angle"], rates={"velocity": "position", "rate": "angle"},
    start=[0, 0, np.pi, 0], region=[[-2, -3, -3.1, -8], [2, 3, 3.1, 8]],
)  # fmt: skip
seed = int(sys.argv[1])
noise = [0.002, 0.01, 0.002, 0.01]
data = RandomData(samples=500, noise=noise, seed=seed).transitions(plant)
model = train(data, system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[1.0, 0.01, 1.0, 0.01], R=[0.01], penalized="inputs"),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 30, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=100)
print(np.round(flight.states[-1], 3))
