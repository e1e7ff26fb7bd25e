"""Stirred tank with an exothermic reaction, brought to an unstable point near by."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, exp


class StirredTank:
    state_names, input_names = ("concentration", "temperature"), ("coolant",)

    def derivative(self, x, u):
        reaction = 7.2e10 * exp(-8750 / x[1]) * x[0]
        return [1 - x[0] - reaction,
                350 - x[1] + 209.2 * reaction + 2.092 * (u[0] - x[1])]  # fmt: skip


plant = System(
    StirredTank(), time_step=0.05, input_lower=[280.0], input_upper=[320.0],
    units={"concentration": "mol/L", "temperature": "K", "coolant": "K"},
    tracked=["concentration", "temperature"], initial_input=[300.0],
    start=[0.65, 338.0], goal=[0.5, 350.0], region=[[0.2, 320.0], [0.95, 370.0]],
)  # fmt: skip
seed = int(sys.argv[1])
data = RandomData(samples=500, episode=1, noise=[0.001, 0.1], seed=seed).transitions(
    plant
)
model = train(data, system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[100.0, 0.01], R=[0.001]),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 30, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=100)
print(np.round(flight.states[-1], 3))
