"""Wheeled inverted pendulum: drives a metre and a half, and stays upright."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, cos, sign, sin


class Wheeled:
    state_names, input_names = ("x", "v", "lean", "lean_rate"), ("torque",)

    def derivative(self, x, u):
        c, s = cos(x[2]), sin(x[2])
        m11, m12, m22 = 4.5, 0.6 * c, 0.16  # body 3 kg at 0.2 m, wheels of 0.1 m
        drive = u[0] - 0.2 * sign(x[1] / 0.1 - x[3], width=1.0)
        r1 = drive / 0.1 + 0.6 * s * x[3] ** 2
        r2 = 0.6 * 9.81 * s - drive
        det = m11 * m22 - m12 * m12
        return [x[1], (m22 * r1 - m12 * r2) / det, x[3], (m11 * r2 - m12 * r1) / det]


plant = System(
    Wheeled(), time_step=0.04, input_lower=[-4.0], input_upper=[4.0],
    angles=["lean"], rates={"v": "x", "lean_rate": "lean"}, start=[-1.5, 0, 0, 0],
    region=[[-2, -2, -0.7, -4], [1, 2, 0.7, 4]],
)  # fmt: skip
seed = int(sys.argv[1])
noise = [0.001, 0.005, 0.001, 0.01]
rows = RandomData(samples=400, episode=3, noise=noise, seed=seed)
model = train(rows.transitions(plant), system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[5.0, 0.1, 1.0, 0.1], R=[0.1], penalized="inputs"),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 40, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=120)
print(np.round(flight.states[-1], 3))
