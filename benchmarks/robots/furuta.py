"""Furuta pendulum: an arm turns about a column, a pendulum at its end swings up."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, cos, sin


class Furuta:
    state_names = ("arm", "arm_rate", "pendulum", "pendulum_rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        s, c, a, b = sin(x[2]), cos(x[2]), x[1], x[3]
        m11, m12, m22 = 0.014 + 0.00225 * s * s, 0.003 * c, 0.003
        r1 = u[0] - 0.002 * a - 0.0045 * s * c * a * b + 0.003 * s * b * b
        r2 = 0.00225 * s * c * a * a + 0.147 * s - 0.0002 * b
        determinant = m11 * m22 - m12 * m12
        return [a, (m22 * r1 - m12 * r2) / determinant,
                b, (m11 * r2 - m12 * r1) / determinant]  # fmt: skip


plant = System(
    Furuta(), time_step=0.04, input_lower=[-0.4], input_upper=[0.4],
    angles=["arm", "pendulum"], rates={"arm_rate": "arm", "pendulum_rate": "pendulum"},
    start=[0, 0, np.pi, 0], region=[[-3.1, -8, -3.1, -12], [3.1, 8, 3.1, 12]],
)  # fmt: skip
seed = int(sys.argv[1])
noise = [0.002, 0.02, 0.002, 0.02]
data = RandomData(samples=500, noise=noise, seed=seed).transitions(plant)
model = train(data, system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[1.0, 0.02, 5.0, 0.02], R=[5.0], penalized="inputs"),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 35, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=120)
print(np.round(flight.states[-1], 3))
