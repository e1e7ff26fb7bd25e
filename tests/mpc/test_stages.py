"""To first order a stage needs the model at one point, whoever wrote the model."""

import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian, square_root
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, Linearized, ResidualModel
from gpmpc.mpc._linear_quadratic import Stages
from gpmpc.mpc._linearization import StageLinearizer
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, Unscented
from tests.mpc.small_models import double_integrator, pendulum_posterior


class ByDifferentiation(Linearization):
    """Linearisation by way of the propagator's own derivatives, which say more than is
    needed."""

    first_order = False


def residual():
    generator = torch.Generator().manual_seed(1)
    points = 2 * torch.rand(12, 2, generator=generator, dtype=torch.float64) - 1
    one = torch.ones(1, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        points,
        torch.sin(3 * points[:, :1]),
        one * torch.tensor([[0.7, 0.9]]),
        one,
        1e-3 * one,
        1,
        "value",
    )
    A = torch.tensor([[1.0, 0.2], [0.0, 0.9]])
    B = torch.tensor([[0.0], [0.2]])
    c = torch.tensor([0.0, 0.1])
    affine = Affine(*(part.double() for part in (A, B, c)))
    return ResidualModel(
        affine, gp, torch.tensor([[0.1], [0.3]], dtype=torch.float64), [1], [0], 1
    )


def stage_at(mode, propagator, model, belief, input, disturbance=None):
    """s and the stage at one point, as arrays without the leading dimension."""
    linearizer = StageLinearizer(model, propagator, mode)
    covariances = belief.covariance.numpy()[None]
    s = linearizer.state(belief.mean.numpy()[None], covariances)
    return s[0], Stages(
        *(
            part[0]
            for part in linearizer(s, input.numpy()[None], covariances, disturbance)
        )
    )


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("model", [residual, double_integrator, pendulum_posterior])
def test_the_shortcut_gives_the_same_stage(model, noise):
    model = model()
    root = torch.tensor([[0.2, 0.0], [0.1, 0.3]], dtype=torch.float64)
    belief = Gaussian(torch.tensor([0.3, -0.2], dtype=torch.float64), root @ root.mT)
    input = 0.4 * torch.ones(1).double()
    _, short = stage_at(
        "zero_order", Linearization(process_noise=noise), model, belief, input
    )
    _, long = stage_at(
        "zero_order", ByDifferentiation(process_noise=noise), model, belief, input
    )
    for mine, theirs in zip(short, long, strict=True):
        assert np.allclose(mine, theirs, rtol=0, atol=1e-12)


def test_a_model_may_give_views_and_other_types():
    model = pendulum_posterior()
    rng = np.random.default_rng(0)
    states = rng.normal(size=(5, 2))
    inputs = rng.normal(size=(5, 1))
    covariances = np.zeros((5, 2, 2))

    class Views:
        state_dim = model.state_dim
        noise_covariance = model.noise_covariance

        def linearize(self, states, inputs, covariance):
            mean, A, B, V = model.linearize(states, inputs, covariance)
            one = np.eye(2, dtype=int)
            return Linearized(
                np.asfortranarray(mean),
                A.mT.copy().mT,
                np.asfortranarray(B),
                np.broadcast_to(one, V.shape),
            )

    noise = model.noise_covariance.numpy()
    expected = StageLinearizer(model, Linearization(), "zero_order")(
        states, inputs, covariances
    )
    stages = StageLinearizer(Views(), Linearization(), "zero_order")(
        states, inputs, covariances
    )
    for mine, theirs in zip(
        stages, expected._replace(V=np.tile(np.eye(2) + noise, (5, 1, 1))), strict=True
    ):
        assert mine.flags.c_contiguous
        assert mine.dtype == float
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("mode", ["full", "diagonal", "zero_order", "none"])
def test_stages_of_many_points_are_those_of_each(mode):
    model = pendulum_posterior()
    rng = np.random.default_rng(0)
    means = rng.normal(size=(5, 2))
    inputs = rng.normal(size=(5, 1))
    roots = 0.2 * rng.normal(size=(5, 2, 2))
    covariances = roots @ roots.mT
    linearizer = StageLinearizer(model, MomentMatching(), mode)
    states = linearizer.state(means, covariances)
    together = linearizer(states, inputs, covariances)
    for k in range(5):
        alone = linearizer(states[k : k + 1], inputs[k : k + 1], covariances[k : k + 1])
        for all_of_them, one in zip(together, alone, strict=True):
            assert np.array_equal(all_of_them[k], one[0])


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
@pytest.mark.parametrize(
    "propagator",
    [MomentMatching(), Linearization(), Unscented()],
    ids=lambda p: type(p).__name__,
)
def test_a_stage_is_the_tangent_of_its_map_at_its_point(mode, propagator):
    model = pendulum_posterior()
    input = torch.tensor([0.4])
    h = 1e-6
    propagator = MeanEquivalence() if mode == "none" else propagator
    root = torch.tensor([[0.2, 0.05], [0.05, 0.3]])
    s = extended(mode, Gaussian(torch.tensor([0.3, -0.2]), root @ root))
    _, stage = stage_at(mode, propagator, model, belief_at(mode, s, root @ root), input)

    def after(s, input):
        return extended(mode, propagator(model, belief_at(mode, s, root @ root), input))

    def by_differences(function, at):
        return torch.stack(
            [
                (function(at + h * e) - function(at - h * e)) / (2 * h)
                for e in torch.eye(len(at))
            ],
            -1,
        )

    A, (s_next, by_s, by_u) = (
        stage.A.copy(),
        (
            part.numpy()
            for part in (
                after(s, input),
                by_differences(lambda s: after(s, input), s),
                by_differences(lambda u: after(s, u), input),
            )
        ),
    )
    if mode == "full":  # S is symmetric: only changes that keep it so mean anything
        A[:, 3] = A[:, 4] = (A[:, 3] + A[:, 4]) / 2
    assert np.allclose(A, by_s, atol=1e-6)
    assert np.allclose(stage.B, by_u, atol=1e-6)
    assert np.allclose(
        stage.A @ s.numpy() + stage.B @ input.numpy() + stage.c, s_next, atol=1e-12
    )
    assert np.allclose(stage.next, s_next, atol=1e-14)


def test_what_a_stage_adds_is_what_does_not_pass_through():
    """Sigma+ = A Sigma A' + V where a feedback can act, whatever the propagator."""
    model = pendulum_posterior()
    input = torch.tensor([0.4])
    root = torch.tensor([[0.1, 0.02], [0.02, 0.15]])
    belief = Gaussian(torch.tensor([0.3, -0.2]), root @ root)
    propagator = Linearization(process_noise=True)
    _, stage = stage_at("zero_order", propagator, model, belief, input)
    after = propagator(model, belief, input).covariance.numpy()
    assert np.allclose(
        stage.A @ belief.covariance.numpy() @ stage.A.T + stage.V, after, atol=1e-14
    )
    certain = Gaussian.certain(belief.mean)
    own = model.predict(belief.mean, input).covariance + model.noise_covariance
    for propagator in (Linearization(), MomentMatching(), Unscented()):
        _, stage = stage_at("zero_order", propagator, model, certain, input)
        assert np.allclose(stage.V, own.numpy(), atol=1e-12)


@pytest.mark.parametrize("mode", ["full", "diagonal", "zero_order", "none"])
def test_a_disturbance_moves_the_mean_and_nothing_else(mode):
    model = pendulum_posterior()
    input = torch.tensor([0.4])
    propagator = MeanEquivalence() if mode == "none" else Linearization()
    belief = Gaussian(torch.tensor([0.3, -0.2]), 0.04 * torch.eye(2))
    pushed = np.array([0.1, -0.3])
    _, before = stage_at(mode, propagator, model, belief, input)
    _, after = stage_at(mode, propagator, model, belief, input, pushed)
    for name in ("c", "next"):
        difference = getattr(after, name) - getattr(before, name)
        assert np.allclose(difference[:2], pushed, atol=1e-15)
        assert np.allclose(difference[2:], 0.0, atol=1e-15)
    assert np.array_equal(after.A, before.A)
    assert np.array_equal(after.V, before.V)
