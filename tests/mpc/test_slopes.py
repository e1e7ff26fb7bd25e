"""What a GP knows of its own slopes, and what a loop makes of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.gp import (
    GPPosterior,
    Trainer,
    Transitions,
    standardize,
    train,
)
from gpmpc.gp._kernel import kernel_matrix
from gpmpc.models import Affine, DelayedModel, KnownModel, NoisyModel, ResidualModel
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.mpc._slopes import slope_covariances
from gpmpc.propagation import Linearization
from gpmpc.systems import System, step_many
from tests.gp.their_models import matern_dynamics


@pytest.fixture(scope="module")
def gp():
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform(-1, 1, (8, 3)))
    return GPPosterior.from_hyperparameters(
        points,
        torch.from_numpy(rng.normal(size=(8, 2))),
        torch.tensor([[1.0, 0.7, 2.0], [0.5, 3.0, 1.0]], dtype=torch.float64),
        torch.tensor([1.5, 0.4], dtype=torch.float64),
        torch.tensor([0.01, 0.1], dtype=torch.float64),
        1,
    )


STATE = np.array([0.3, -0.2])
INPUT = np.array([0.5])
ALONG = np.array([1.0, -2.0])
BY_INPUT = np.array([0.7])


def by_differences(gp, along, by_input, width=1e-4):
    """Variances of central differences, by the joint posterior of both ends."""
    middle = np.concatenate([STATE, INPUT])
    direction = np.concatenate([along, by_input])
    ends = torch.from_numpy(middle + width * np.outer([1, -1], direction))
    kernel = (gp.lengthscales, gp.signal_variance)
    joint = kernel_matrix(ends, ends, *kernel)
    cross = kernel_matrix(gp.features, ends, *kernel)
    variances = []
    for i in range(2):
        solved = torch.linalg.solve_triangular(gp.cholesky[i], cross[i], upper=False)
        covariance = joint[i] - solved.mT @ solved
        difference = torch.tensor([1.0, -1.0], dtype=torch.float64)
        spread = difference @ covariance @ difference
        variances.append(float(spread) / (2 * width) ** 2)
    return variances


def test_the_covariance_of_slopes_is_that_of_differences(gp):
    covariances = slope_covariances(gp, STATE, INPUT)
    direction = np.concatenate([ALONG, BY_INPUT])
    variance = direction @ covariances @ direction
    assert variance == pytest.approx(by_differences(gp, ALONG, BY_INPUT), rel=1e-4)


def test_models_around_a_gp_are_looked_through(gp):
    late = DelayedModel(gp, 1)  # its input acts a step later
    covariances = slope_covariances(late, np.append(STATE, INPUT), np.zeros(1))
    assert covariances[:2, :3, :3] == pytest.approx(slope_covariances(gp, STATE, INPUT))
    assert not covariances[2].any()
    assert not covariances[:, 3].any()
    log_noise = replace(gp, predicts="value")
    noisy = slope_covariances(NoisyModel(gp, log_noise, [0, 1]), STATE, INPUT)
    assert noisy == pytest.approx(slope_covariances(gp, STATE, INPUT))
    nominal = KnownModel(Affine.identity(2, 1), 2, 1)
    assert not slope_covariances(nominal, STATE, INPUT).any()
    of_any_kernel = ResidualModel(
        Affine.identity(2, 1),
        residual=matern_dynamics("value"),
        B=torch.eye(2, dtype=torch.float64),
        states=[0, 1],
        inputs=[0],
        input_dim=1,
    )
    assert not slope_covariances(of_any_kernel, STATE, INPUT).any()


def test_an_angle_is_seen_through_its_sine_and_cosine():
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (30, 2))
    inputs = rng.uniform(-1, 1, (30, 1))
    after = states + 0.1 * np.sin(states[:, :1]) + rng.normal(0, 0.01, (30, 2))
    model = ResidualModel.train(
        Affine.identity(2, 1),
        Transitions(states, inputs, after),
        angles=[0],
        trainer=Trainer(restarts=0),
    )
    covariances = slope_covariances(model, STATE, INPUT)
    sine = np.sin(STATE[0])
    cosine = np.cos(STATE[0])
    direct = slope_covariances(
        model.residual, np.array([sine, cosine, STATE[1]]), INPUT
    )
    seen = np.array([[cosine, 0, 0], [-sine, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert covariances == pytest.approx(seen.T @ direct @ seen)


class Pendulum:
    """Its state lies on a circle, off which no data say anything."""

    state_names = ("cosine", "sine", "rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [-x[1] * x[2], x[0] * x[2], 15.0 * x[1] + 3.0 * u[0]]


def test_only_growth_along_the_data_is_a_warning():
    plant = System(Pendulum(), time_step=0.05)
    rng = np.random.default_rng(0)
    angles = rng.uniform(-np.pi, np.pi, 200)
    torques = rng.uniform(-2, 2, (200, 1))
    rates = rng.uniform(-8, 8, 200)
    states = np.column_stack([np.cos(angles), np.sin(angles), rates])
    after = step_many(plant, states, torques) + rng.normal(0, 0.001, (200, 3))
    data = Transitions(states, torques, after)
    model = train(data, predicts="difference", scaling=standardize).posterior
    cost = Tracking([1.0, 1.0, 0.01], [0.01], penalized="inputs")
    problem = Problem(cost, inputs=Box([-2.0], [2.0]))

    def stability(horizon):
        controller = GPMPC(model, Linearization(), problem, horizon, [0.0])
        return controller.stability([1.0, 0.0, 0.0])

    assert stability(30).spectral_radius > 1.005  # off the circle
    assert stability(30).stable
    assert not stability(2).stable
    (line,) = stability(2).warnings
    assert line.endswith(
        f"it settles with {stability(30).shortest_horizon} steps or more"
    )
