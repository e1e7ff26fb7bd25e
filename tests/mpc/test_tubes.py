"""Predicted covariances stay as small as the plan's own feedback can keep them."""

import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.models import KnownModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.status import Status

TIME_STEP = 0.05  # [s]
INITIAL_DEVIATION = 0.01  # [rad, rad/s]


def push_pivot(state, input):
    """A pendulum whose pivot is pushed: the input acts by the cosine of the angle."""
    angle, rate = state.unbind(-1)
    acceleration = 5 * torch.sin(angle) + 5 * torch.cos(angle) * input[..., 0]
    next_rate = rate + TIME_STEP * acceleration
    return torch.stack([angle + TIME_STEP * next_rate, next_rate], dim=-1)


def deviations(horizon, feedback):
    """Predicted standard deviations (H + 1, 2) of a swing from hanging to upright."""
    controller = GPMPC(
        KnownModel(push_pivot, state_dim=2, input_dim=1),
        Linearization(),
        Problem(Tracking([1.0, 0.1], [0.1]), Box([-2.0], [2.0])),
        horizon,
        [0.0],
        PredictionSettings(feedback=feedback),
        iterations=1,
    )
    hanging = Gaussian(
        torch.tensor([np.pi, 0.0], dtype=torch.float64),
        INITIAL_DEVIATION**2 * torch.eye(2, dtype=torch.float64),
    )
    decision = controller.control(hanging, Reference(np.zeros(2)))
    assert decision.status is Status.SOLVED
    return np.sqrt(np.einsum("kii->ki", decision.covariances))


@pytest.mark.parametrize("horizon", [20, 40, 80])
def test_a_tube_stays_narrow_where_the_input_changes_its_sign(horizon):
    with_feedback = deviations(horizon, feedback=True)
    assert with_feedback.max() < 2 * INITIAL_DEVIATION
    without = deviations(horizon, feedback=False)
    assert (with_feedback.max(axis=0) <= without.max(axis=0) * (1 + 1e-9)).all()
