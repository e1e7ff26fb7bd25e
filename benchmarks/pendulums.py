"""Coupled pendulums of any number, and GPs of them: one system of every size.

A row of c pendulums, each with a torque of its own and a spring to its neighbours: 2 c
states, c inputs; smooth, nonlinear, coupled and stable to fly with any model of it. Its
GPs are not trained, since hyperparameters do not change what a prediction costs: they
come from the ranges of the data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from gpmpc.exceptions import check_number
from gpmpc.gp import GPPosterior
from gpmpc.systems import System, step

DAMPING = 0.3  # [1/s]
SPRING = 1.0  # [1/s^2]
STIFFNESS = 4.0  # g / l [1/s^2]
TIME_STEP = 0.1  # [s]
NOISE_SHARE = 1e-6  # of the signal's variance


@dataclass(frozen=True)
class Pendulums:
    """c coupled pendulums of unit inertia.

    Attributes:
        count: c.

    Raises:
        SettingError: Fewer than one.
    """

    count: int
    state_names: tuple[str, ...] = field(init=False)
    input_names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        check_number("count", self.count, least=1, whole=True)
        every = range(1, self.count + 1)
        names = tuple(name for i in every for name in (f"angle{i}", f"rate{i}"))
        object.__setattr__(self, "state_names", names)
        object.__setattr__(self, "input_names", tuple(f"torque{i}" for i in every))

    def derivative(self, x: Any, u: Any) -> Sequence[Any]:
        """Returns d/dt (angle1, rate1, angle2, ...) [rad/s, rad/s^2].

        Torques are per inertia [1/s^2].
        """
        rates = []
        for i in range(self.count):
            angle = x[2 * i]
            rate = x[2 * i + 1]
            pull = -STIFFNESS * np.sin(angle) - DAMPING * rate + u[i]
            if i > 0:
                pull = pull + SPRING * (x[2 * i - 2] - angle)
            if i + 1 < self.count:
                pull = pull + SPRING * (x[2 * i + 2] - angle)
            rates += [rate, pull]
        return rates


def pendulum_plant(state_dim: int) -> System:
    """The plant with n = ``state_dim`` states."""
    return System(Pendulums(state_dim // 2), TIME_STEP, 4)


def pendulum_gp(state_dim: int, size: int, seed: int = 0) -> GPPosterior:
    """Returns GPs on ``size`` transitions from where ``pendulum_references`` goes."""
    random = np.random.default_rng([seed, state_dim, size])
    plant = pendulum_plant(state_dim)
    n = state_dim
    m = state_dim // 2
    states = random.uniform(-1.0, 1.0, (size, n)) * np.tile(
        [1.2, 2.5], m
    )  # [rad, rad/s]
    inputs = random.uniform(-6.0, 6.0, (size, m))  # [1/s^2]
    changes = (
        np.array([step(plant, x, u) for x, u in zip(states, inputs, strict=True)])
        - states
    )
    features = np.concatenate([states, inputs], axis=1)
    # Wider than the data, as for a smooth system, and every feature counts in every
    # output.
    scales = np.tile(6.0 * (features.std(0) + 1e-3), (n, 1))
    signal = 100.0 * (changes.var(0) + 1e-6)
    parts = (features, changes, scales, signal, NOISE_SHARE * signal)
    return GPPosterior.from_hyperparameters(
        *map(torch.from_numpy, parts), m, predicts="difference"
    )


def pendulum_references(state_dim: int, steps: int) -> np.ndarray:
    """Reference states (steps, n).

    Every pendulum swings, each a little later than its neighbour.
    """
    time = TIME_STEP * np.arange(steps)
    m = state_dim // 2
    phase = time[:, None] - 0.3 * np.arange(m)
    angles = 0.8 * np.sin(1.5 * phase)
    rates = 0.8 * 1.5 * np.cos(1.5 * phase)
    return np.stack([angles, rates], axis=2).reshape(steps, state_dim)
