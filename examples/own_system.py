"""A system of one's own: an arm is learned from 200 random steps and flown.

It writes ``own_system.png`` into the folder that is named on the command line, or into
the current one. The guide ``docs/guide_system.md`` flies the same arm from the command
line.
"""

import sys
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt

from gpmpc.calibration import Recording, calibrate
from gpmpc.datasets import RandomData
from gpmpc.gp import Trainer, standardize
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.studies.flight import Experiment, metrics, run_trial
from gpmpc.systems import System, sin
from gpmpc.trajectories import Waypoints


class Arm:
    """A uniform arm of one metre that hangs from its joint."""

    state_names = ("angle", "rate")
    input_names = ("torque",)

    def __init__(self, mass: float = 1.0):
        self.mass = mass  # [kg]

    def derivative(self, x, u):
        """d/dt (angle, rate) [rad/s, rad/s^2]."""
        torque = u[0] - 0.1 * x[1] - self.mass * 9.81 / 2 * sin(x[0])  # [N m]
        return [x[1], torque / (self.mass / 3)]


def arm(mass: float = 1.0) -> System:
    """Makes the system."""
    return System(
        Arm(mass),
        time_step=0.05,
        name="arm",
        units={"angle": "rad", "rate": "rad/s", "torque": "N m"},
        input_lower=[-8.0],
        input_upper=[8.0],
        start=[0.0, 0.0],
        region=[[-2.0, -6.0], [2.0, 6.0]],
        angles=["angle"],
        rates={"rate": "angle"},
        lost=1.5,
    )


system = arm()
problem = Problem(
    Tracking(Q=[10.0, 0.1], R=[0.01]),
    inputs=Box(system.input_lower, system.input_upper),
)
flight = Experiment(
    data=RandomData(samples=200),
    trajectory=Waypoints([0.0, 1.5, 3.0, 4.5], [[0.0], [1.2], [-1.2], [0.5]]),
    system=system,
    train=Trainer(predicts="difference", scaling=standardize),
    controller=partial(
        GPMPC,
        propagator=Linearization(),
        problem=problem,
        horizon=15,
        initial_input=[0.0],
    ),
    steps=120,
)
flown = run_trial(flight)
result = metrics(flight, flown)
fresh = RandomData(samples=200, seed=1).transitions(system)
assert flown.training is not None
calibration = calibrate(
    flown.training.posterior,
    Recording.chained(fresh),
    horizon=3,
    names=system.state_names,
)

print(f"RMSE {result['rmse']['total']:.3f} {system.unit}, lost: {result['lost']}")
print(calibration.to_pandas().round(3).to_string(index=False))
rollout = flown.rollout
plt.style.use("gpmpc.plotting.gpmpc")
plt.plot(rollout.times, rollout.references[:, 0], "--", color="C6", label="reference")
plt.plot(rollout.times, rollout.states[:, 0], label="angle [rad]")
plt.step(
    rollout.times[1:], rollout.inputs[:, 0] / 8, label="torque / 8 N m", linewidth=0.8
)
plt.xlabel("time [s]")
plt.title("An arm on a joint, flown through its waypoints")
plt.figlegend(loc="outside lower center", ncols=3)
plt.savefig(Path(sys.argv[1] if len(sys.argv) > 1 else ".") / "own_system.png")
