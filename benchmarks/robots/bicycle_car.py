"""Dynamic bicycle: a car with tyres that slip drives a figure eight."""

import sys

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, atan2, cos, sin


class Car:
    state_names, input_names = ("x", "y", "yaw", "vx", "vy", "r"), ("push", "steer")

    def derivative(self, x, u):
        front = 60.0 * (u[1] - atan2(x[4] + 0.17 * x[5], x[3]))
        rear = -60.0 * atan2(x[4] - 0.16 * x[5], x[3])
        s, c = sin(x[2]), cos(x[2])
        return [x[3] * c - x[4] * s, x[3] * s + x[4] * c, x[5],
                u[0] - 0.1 * x[3] - front * sin(u[1]) / 4 + x[4] * x[5],
                (front * cos(u[1]) + rear) / 4 - x[3] * x[5],
                (0.17 * front * cos(u[1]) - 0.16 * rear) / 0.08]  # fmt: skip


t = 0.05 * np.arange(400)
path = np.stack([3 * np.sin(0.5 * t), 1.5 * np.sin(t)], axis=1)
speed = np.gradient(path, t, axis=0)
yaw = np.unwrap(np.arctan2(speed[:, 1], speed[:, 0]))
reference = np.c_[path, yaw, np.hypot(*speed.T), 0 * t, np.gradient(yaw, t)]
plant = System(
    Car(), time_step=0.05, input_lower=[-4.0, -0.5], input_upper=[4.0, 0.5],
    angles=["yaw"], rates={"r": "yaw"}, start=reference[0],
    region=[[-3, -2, -3.1, 0.8, -0.4, -2.5], [3, 2, 3.1, 3.0, 0.4, 2.5]],
)  # fmt: skip
seed = int(sys.argv[1])
rows = RandomData(500, episode=2, noise=[0.001] * 3 + [0.005] * 3, seed=seed)
model = train(rows.transitions(plant), system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[10.0, 10.0, 1.0, 0.1, 0.0, 0.0], R=[0.1, 1.0]),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 20, plant.initial_input)
flight = closed_loop(plant, controller, reference, plant.start, steps=300)
print(np.abs(flight.states - reference[:301])[50:, :2].max(0).round(3))
