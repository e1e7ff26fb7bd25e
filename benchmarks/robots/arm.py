"""Two-link arm in MuJoCo: moves its links against gravity to given angles."""

import sys
from pathlib import Path

import numpy as np

from gpmpc.datasets import RandomData
from gpmpc.models import train
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems.mujoco_ import mujoco_system

LINK = '<geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4" mass="0.6"/>'
JOINT = '<joint name="{}" axis="0 1 0" damping="0.05"/>'
Path("arm.xml").write_text(
    '<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body>'
    + JOINT.format("shoulder") + LINK + '<body pos="0 0 -0.4">'
    + JOINT.format("elbow") + LINK + "</body></body></worldbody><actuator>"
    '<motor name="m1" joint="shoulder" ctrllimited="true" ctrlrange="-8 8"/>'
    '<motor name="m2" joint="elbow" ctrllimited="true" ctrlrange="-3 3"/>'
    "</actuator></mujoco>"
)  # fmt: skip
plant = mujoco_system(
    "arm.xml", joints=["shoulder", "elbow"], actuators=["m1", "m2"], substeps=8,
    angles=["shoulder", "elbow"], start=[0, 0, 0, 0], goal=[2.0, -1.0, 0, 0],
    region=[[-3.1, -3.1, -6, -8], [3.1, 3.1, 6, 8]],
)  # fmt: skip
seed = int(sys.argv[1])
noise = [0.001, 0.001, 0.01, 0.01]
data = RandomData(samples=500, noise=noise, seed=seed).transitions(plant)
model = train(data, system=plant, seed=seed).posterior
problem = Problem(
    Tracking(Q=[10.0, 10.0, 0.1, 0.1], R=[0.01, 0.01]),
    inputs=Box(plant.input_lower, plant.input_upper),
)
controller = GPMPC(model, Linearization(), problem, 20, plant.initial_input)
flight = closed_loop(plant, controller, plant.goal, plant.start, steps=80)
print(np.round(flight.states[-1], 3))
