"""Quadruple tank: four levels, two pumps, outflows by square roots."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, max, sqrt


class Tank:
    state_names, input_names = ("h1", "h2", "h3", "h4"), ("pump1", "pump2")

    def derivative(self, h, u):
        out = [0.071 * sqrt(2 * 981 * max(level, 0.01)) for level in (h[0], h[2])]
        out2, out4 = (
            0.057 * sqrt(2 * 981 * max(level, 0.01)) for level in (h[1], h[3])
        )
        return [
            (out[1] - out[0] + 0.70 * 3.33 * u[0]) / 28,
            (out4 - out2 + 0.60 * 3.35 * u[1]) / 32,
            (-out[1] + 0.40 * 3.35 * u[1]) / 28,
            (-out4 + 0.30 * 3.33 * u[0]) / 32,
        ]


plant = System(
    Tank(), time_step=3.0, input_lower=[0.0, 0.0], input_upper=[6.0, 6.0],
    region=[[2.0, 2.0, 0.5, 0.5], [20.0, 20.0, 6.0, 6.0]], start=[6.0, 6.0, 1.0, 1.0],
    goal=[12.26, 12.78, 1.63, 1.41], initial_input=[3.0, 3.0],
)  # fmt: skip
seed = int(sys.argv[1])
data = RandomData(samples=300, noise=[0.01] * 4, seed=seed).transitions(plant)
model = train(data, system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[1.0, 1.0, 0.0, 0.0], R=[0.1, 0.1]),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 20, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=80)
print(np.round(flight.states[-1], 2))
