"""To first order a stage needs the model at one point, whoever wrote the model."""

import pytest
import torch

from gpmpc.gaussian import Gaussian, square_root
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc.stage_models import disturbed, stage_model
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, Unscented
from tests.mpc.small_models import double_integrator, pendulum_posterior


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
    short = stage_model("zero_order", Linearization(process_noise=noise), model, belief, input)
    long = stage_model("zero_order", ByDifferentiation(process_noise=noise), model, belief, input)
    for mine, theirs in zip(
        [*short[:3], *vars(short.next).values(), short.V], [*long[:3], *vars(long.next).values(), long.V], strict=True
    ):
        assert torch.allclose(mine, theirs, rtol=0, atol=1e-12)


def extended(mode, belief):
    """s of a belief in a covariance mode."""
    if mode == "diagonal":
        return torch.cat([belief.mean, belief.variance.sqrt()])
    if mode == "full":
        return torch.cat([belief.mean, square_root(belief.covariance).flatten()])
    return belief.mean


def belief_at(mode, s, covariance):
    n = len(covariance)
    if mode == "diagonal":
        return Gaussian(s[:n], torch.diag(s[n:] ** 2))
    if mode == "full":
        root = s[n:].unflatten(0, (n, n))
        root = (root + root.T) / 2
        return Gaussian(s[:n], root @ root)
    return Gaussian(s, covariance)


@pytest.mark.parametrize("mode", ["full", "diagonal", "zero_order", "none"])
@pytest.mark.parametrize("propagator", [MomentMatching(), Linearization(), Unscented()], ids=lambda p: type(p).__name__)
def test_a_stage_is_the_derivative_of_its_own_map_and_goes_through_its_point(mode, propagator):
    model, input, h = pendulum_posterior(), torch.tensor([0.4]), 1e-6
    propagator = MeanEquivalence() if mode == "none" else propagator
    root = torch.tensor([[0.2, 0.05], [0.05, 0.3]])
    s = extended(mode, Gaussian(torch.tensor([0.3, -0.2]), root @ root))
    stage = stage_model(mode, propagator, model, belief_at(mode, s, root @ root), input)

    def after(s, input):
        return extended(mode, propagator(model, belief_at(mode, s, root @ root), input))

    def by_differences(function, at):
        return torch.stack([(function(at + h * e) - function(at - h * e)) / (2 * h) for e in torch.eye(len(at))], -1)

    A = stage.A
    if mode == "full":  # S is symmetric: only changes that keep it so mean anything
        A = A.clone()
        A[:, 3] = A[:, 4] = (A[:, 3] + A[:, 4]) / 2
    if mode == "zero_order":  # how the mean depends on the covariance is left out, not how it depends on the mean
        assert torch.allclose(
            stage.next.covariance, propagator(model, belief_at(mode, s, root @ root), input).covariance
        )
    assert torch.allclose(A, by_differences(lambda s: after(s, input), s), atol=1e-6)
    assert torch.allclose(stage.B, by_differences(lambda u: after(s, u), input), atol=1e-6)
    assert torch.allclose(stage.A @ s + stage.B @ input + stage.c, after(s, input), atol=1e-12)


def test_what_a_stage_adds_is_what_does_not_pass_through():
    """Sigma+ = A Sigma A' + V where a feedback can act, whatever the propagator."""
    model, input = pendulum_posterior(), torch.tensor([0.4])
    root = torch.tensor([[0.1, 0.02], [0.02, 0.15]])
    belief = Gaussian(torch.tensor([0.3, -0.2]), root @ root)
    stage = stage_model("zero_order", Linearization(process_noise=True), model, belief, input)
    assert torch.allclose(stage.A @ belief.covariance @ stage.A.T + stage.V, stage.next.covariance, atol=1e-14)
    certain = Gaussian.certain(belief.mean)
    own = model.predict(belief.mean, input).covariance
    for propagator in (Linearization(), MomentMatching(), Unscented()):
        stage = stage_model("zero_order", propagator, model, certain, input)
        assert torch.allclose(stage.V, own, atol=1e-12)


@pytest.mark.parametrize("mode", ["full", "diagonal", "zero_order", "none"])
def test_a_disturbance_moves_the_mean_and_nothing_else(mode):
    model, input = pendulum_posterior(), torch.tensor([0.4])
    propagator = MeanEquivalence() if mode == "none" else Linearization()
    belief = Gaussian(torch.tensor([0.3, -0.2]), 0.04 * torch.eye(2))
    before, pushed = stage_model(mode, propagator, model, belief, input), torch.tensor([0.1, -0.3])
    after = disturbed(before, pushed)
    assert torch.equal(after.next.mean, before.next.mean + pushed)
    assert torch.allclose((after.c - before.c)[:2], pushed, atol=1e-15)
    assert torch.equal(after.c[2:], before.c[2:])
    assert torch.equal(after.next.covariance, before.next.covariance)
    assert torch.equal(after.A, before.A)
