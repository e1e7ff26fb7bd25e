"""To first order a stage needs the model at one point, whoever wrote the model."""

import pytest
import torch

from gpmpc.control.stage_models import stage_model
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Affine, GPPosterior, ResidualModel
from gpmpc.propagation import Linearization
from tests.control.small_models import double_integrator, pendulum_posterior


class ByDifferentiation(Linearization):
    """The same by way of the propagator's own derivatives, which say more than is needed."""


def residual():
    generator = torch.Generator().manual_seed(1)
    points = 2 * torch.rand(12, 2, generator=generator, dtype=torch.float64) - 1
    one = torch.ones(1, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        points, torch.sin(3 * points[:, :1]), one * torch.tensor([[0.7, 0.9]]), one, 1e-3 * one, 1, "value"
    )
    A, B, c = torch.tensor([[1.0, 0.2], [0.0, 0.9]]), torch.tensor([[0.0], [0.2]]), torch.tensor([0.0, 0.1])
    affine = Affine(*(part.double() for part in (A, B, c)))
    return ResidualModel(affine, gp, torch.tensor([[0.1], [0.3]], dtype=torch.float64), [1], [0], 1)


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("model", [residual, double_integrator, pendulum_posterior])
def test_the_shortcut_gives_the_same_stage(model, noise):
    model = model()
    root = torch.tensor([[0.2, 0.0], [0.1, 0.3]], dtype=torch.float64)
    belief, input = (
        Gaussian(torch.tensor([0.3, -0.2], dtype=torch.float64), root @ root.mT),
        0.4 * torch.ones(1).double(),
    )
    short = stage_model("zero_order", Linearization(observation_noise=noise), model, belief, input)
    long = stage_model("zero_order", ByDifferentiation(observation_noise=noise), model, belief, input)
    for mine, theirs in zip(
        [*short[:3], *vars(short.next).values(), short.V], [*long[:3], *vars(long.next).values(), long.V], strict=True
    ):
        assert torch.allclose(mine, theirs, rtol=0, atol=1e-12)
