"""Planar quadrotor: a bar with two rotors flies to a point and hovers."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, cos, sin


class Bar:
    state_names = ("x", "y", "tilt", "vx", "vy", "tilt_rate")
    input_names = ("right", "left")

    def derivative(self, x, u):
        lift = (u[0] + u[1]) / 0.74
        drag_x, drag_y = 0.1 * x[3], 0.1 * x[4]
        tilting = 0.21 * (u[0] - u[1]) / 0.01
        return [x[3], x[4], x[5],
                -lift * sin(x[2]) - drag_x, lift * cos(x[2]) - 9.81 - drag_y,
                tilting]  # fmt: skip


plant = System(
    Bar(), time_step=0.05, input_lower=[1.0, 1.0], input_upper=[7.0, 7.0],
    units={"x": "m", "y": "m", "tilt": "rad"}, tracked=["x", "y", "tilt"],
    angles=["tilt"], rates={"vx": "x", "vy": "y", "tilt_rate": "tilt"},
    start=[1.0, -1.0, 0, 0, 0, 0], initial_input=[3.63, 3.63],
    region=[[-2, -2, -0.8, -2, -2, -3], [2, 2, 0.8, 2, 2, 3]],
)  # fmt: skip
seed = int(sys.argv[1])
noise = [0.002, 0.002, 0.002, 0.01, 0.01, 0.02]
rows = RandomData(samples=400, episode=2, noise=noise, seed=seed)
model = train(rows.transitions(plant), system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[10.0, 10.0, 1.0, 1.0, 1.0, 0.1], R=[0.1, 0.1]),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 25, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=100)
print(np.round(flight.states[-1], 3))
