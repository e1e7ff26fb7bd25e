"""The pole of gymnasium's InvertedPendulum, learned from random motion, is balanced
within bounds of cart and pole."""

from dataclasses import replace

import numpy as np
import pytest

from gpmpc.studies.flight import metrics, run_trial
from gpmpc.studies.study import one_thread
from tests.systems.experiments import experiment

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco")
pytest.importorskip("imageio")  # which gymnasium's MuJoCo environments need

WORDS = [
    "system=gymnasium",
    "system.environment=InvertedPendulum-v5",
    "system.state_names=[cart,pole,cart_rate,pole_rate]",
    "system.tracked=[cart]",
    "data.samples=206",
    "data.episode=100",
    "data.starts=start",
    "controller.problem.cost.Q=[1,1,0.1,0.1]",
    "controller.problem.cost.R=[0.01]",
    "controller.problem.constraints=[{_target_: gpmpc.mpc.problem.Box, "
    "lower: [-0.9,-0.15,-inf,-inf], "
    "upper: [0.9,0.15,inf,inf]}]",
    "steps=300",
]


class ToAndFro:
    """The cart half a metre to either side, in turn every three seconds."""

    def __call__(self, time):
        return np.where(np.asarray(time)[..., None] % 6 < 3, 0.5, -0.5)

    def velocity(self, time):
        return np.zeros((*np.shape(time), 1))


def flown(seed):
    chosen = experiment(*WORDS, f"seed={seed}", f"data.seed={seed}")
    chosen = replace(chosen, trajectory=ToAndFro())
    with one_thread():
        return chosen, run_trial(chosen)


@pytest.mark.parametrize(
    "seed",
    [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 20))],
)
def test_a_pole_learned_from_random_rows_survives_cart_jumps(seed):
    chosen, flight = flown(seed)
    assert len(flight.training.posterior) == 206
    assert len(flight.rollout.states) == 301
    assert metrics(chosen, flight)["lost"] is None
    states = flight.rollout.states
    assert np.abs(states[:, 0]).max() < 0.95
    assert (
        np.abs(states[:, 1]).max() < 0.2
    )  # beyond it the environment ends its episode
    assert np.abs(states[55:62, 0] - 0.5).max() < 0.05
