"""Flies a planar quadrotor among three discs, two of which move.

Its forces are learned from 500 random steps.

Where the discs will be comes with every call; each is to be missed with 95 % at every
stage. Run as `python examples/obstacles.py FOLDER` (the present folder by default); it
writes obstacles.png there.
"""

import sys
from dataclasses import replace
from pathlib import Path

import casadi
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from gpmpc.gp import Trainer, Transitions, standardize
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc import GPMPC, Box, ControlLoop, Inequality, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.systems import planar_quadrotor, step_many

HORIZON = 30
STEPS = 110
NOISE = [0.002, 0.02, 0.002, 0.02, 0.002, 0.02]  # standard deviations a step
RADII = np.array([0.35, 0.3, 0.3])  # [m]
PLACES = np.array([[0.9, 0.1], [1.9, -1.0], [2.9, 1.0]])
VELOCITIES = np.array([[0.0, 0.0], [0.0, 0.5], [0.0, -0.4]])
GOAL = np.array([4.0, 0.0, 0.0, 0.0, 0.0, 0.0])

quadrotor = planar_quadrotor()
rng = np.random.default_rng(0)
lowest = np.array([-0.5, -2.5, -1.5, -2.0, -0.8, -4.0])
highest = np.array([4.5, 2.5, 1.5, 2.0, 0.8, 4.0])
states = rng.uniform(lowest, highest, (500, 6))
thrusts = rng.uniform(2.0, 6.0, (500, 2))
after = step_many(quadrotor, states, thrusts) + rng.normal(0, NOISE, (500, 6))
kinematics = torch.eye(6, dtype=torch.float64)  # what is known: rates move positions
kinematics[[0, 2, 4], [1, 3, 5]] = quadrotor.time_step
nominal = replace(Affine.identity(6, 2), A=kinematics)
data = Transitions(states, thrusts, after)
trainer = Trainer(scaling=standardize, restarts=0)
model = ResidualModel.train(
    nominal, data, states=[4, 5], inputs=[0, 1], trainer=trainer
)  # by tilt, its rate, thrusts

# p: the discs' centres
x = casadi.SX.sym("x", 6)
u = casadi.SX.sym("u", 2)
p = casadi.SX.sym("p", 6)
inside = [
    radius - casadi.norm_2(casadi.vertcat(x[0] - p[2 * i], x[2] - p[2 * i + 1]))
    for i, radius in enumerate(RADII)
]
discs = casadi.Function("discs", [x, u, p], [casadi.vertcat(*inside)])
TILT = Box([-np.inf] * 4 + [-0.6, -3.0], [np.inf] * 4 + [0.6, 3.0])
problem = Problem(
    cost=Tracking(Q=[1.0, 0.3, 1.0, 0.3, 0.5, 0.1], R=[0.3, 0.3]),
    inputs=Box([2.4, 2.4], [5.4, 5.4]),
    constraints=[Inequality(discs, count=3, probability=0.95), TILT],
)
controller = GPMPC(model, Linearization(), problem, HORIZON, quadrotor.initial_input)


def centres(times: np.ndarray) -> np.ndarray:
    """Where the discs are at some times [s], (T, 3, 2) [m]."""
    return PLACES + VELOCITIES * np.asarray(times)[..., None, None]


loop = ControlLoop(controller)
flown = [np.zeros(6)]
gaps = []
times = quadrotor.time_step * np.arange(STEPS + HORIZON + 1)
for k in range(STEPS):
    thrust = loop.input(
        flown[-1], GOAL, centres(times[k + 1 : k + 1 + HORIZON]).reshape(HORIZON, 6)
    )
    flown.append(
        step_many(quadrotor, flown[-1][None], thrust[None])[0] + rng.normal(0, NOISE)
    )
    gaps.append(
        np.linalg.norm(centres(times[k + 1]) - flown[-1][[0, 2]], axis=1) - RADII
    )
path = np.array(flown)
nearest = float(np.min(gaps))
away = float(np.linalg.norm(path[-1, [0, 2]] - GOAL[[0, 2]]))
print(
    f"{away:.2f} m from the goal, never nearer than {nearest:.3f} m to a disc, "
    f"{loop.failures} failures"
)


def figure() -> Figure:
    """Draws the path and the discs at four moments.

    The discs are larger by the vehicle's own size.
    """
    plt.style.use("gpmpc.plotting.gpmpc")
    drawn, axes = plt.subplots(2, 2, sharex=True, sharey=True, figsize=(7, 5))
    for axis, k in zip(axes.flat, (10, 21, 32, STEPS), strict=True):
        for place, radius, velocity in zip(
            centres(times[k]), RADII, VELOCITIES, strict=True
        ):
            axis.add_patch(
                Circle(
                    (place[0], place[1]),
                    radius,
                    color="C1" if velocity.any() else "C7",
                    alpha=0.6,
                )
            )
        axis.plot(path[: k + 1, 0], path[: k + 1, 2], color="C0")
        tilt = path[k, 4]
        at = path[k, [0, 2]]
        arm = 0.1 * np.array([np.cos(tilt), np.sin(tilt)])
        axis.plot(*np.transpose([at - arm, at + arm]), color="black", linewidth=3)
        axis.plot(*GOAL[[0, 2]], "+", color="black", markersize=9)
        axis.set(
            title=f"{times[k]:.1f} s",
            aspect="equal",
            xlim=(-0.5, 4.5),
            ylim=(-1.5, 1.5),
        )
    drawn.suptitle("A planar quadrotor's centre among discs; those in vermilion move")
    drawn.supxlabel("x [m]", fontsize="medium")
    drawn.supylabel("y, upwards [m]", fontsize="medium")
    return drawn


figure().savefig(Path(sys.argv[1] if len(sys.argv) > 1 else ".") / "obstacles.png")
