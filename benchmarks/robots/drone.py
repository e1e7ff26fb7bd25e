"""Drone with an attitude loop of its own, through four gates in a row."""

import sys

import numpy as np
from scipy.interpolate import CubicSpline

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, cos, sin, sqrt


class Drone:
    state_names = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch")
    input_names = ("thrust", "roll_command", "pitch_command")

    def derivative(self, x, u):
        drag = 0.05 * sqrt(x[3] ** 2 + x[4] ** 2 + x[5] ** 2 + 0.01)
        return [x[3], x[4], x[5],
                u[0] * cos(x[6]) * sin(x[7]) - drag * x[3],
                -u[0] * sin(x[6]) - drag * x[4],
                u[0] * cos(x[6]) * cos(x[7]) - 9.81 - drag * x[5],
                6 * (u[1] - x[6]), 6 * (u[2] - x[7])]  # fmt: skip


gates = [[0, 0, 1], [2, 1, 1.5], [4, -1, 1], [6, 1, 2], [8, 0, 1], [8, 0, 1]]
spline = CubicSpline([0, 1.5, 3, 4.5, 6, 9], gates, bc_type="clamped")
t = 0.05 * np.arange(160)
reference = np.hstack([spline(t), spline(t, 1), np.zeros((160, 2))])
plant = System(
    Drone(), 0.05, start=reference[0], rates={"vx": "x", "vy": "y", "vz": "z"},
    input_lower=[4, -0.6, -0.6], input_upper=[16, 0.6, 0.6], initial_input=[9.81, 0, 0],
    region=[[0, -2, 0, -3, -3, -2, -0.6, -0.6], [8, 2, 3, 3, 3, 2, 0.6, 0.6]],
)  # fmt: skip
seed = int(sys.argv[1])
noise = [0.002] * 3 + [0.01] * 3 + [0.002] * 2
rows = RandomData(samples=500, episode=3, noise=noise, seed=seed)
model = train(rows.transitions(plant), system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[10.0] * 3 + [0.1] * 3 + [0.1] * 2, R=[0.01, 1.0, 1.0]),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 20, plant.initial_input)
flight = closed_loop(plant, controller, reference, plant.start, steps=130)
print(np.linalg.norm(flight.states - reference[:131], axis=1)[[30, 60, 90, 120]])
