"""Closed-form derivatives against torch autograd through the torch evaluation, for every model that has them."""

import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Affine, GPPosterior, ResidualModel, evaluation
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, differentiate
from gpmpc.propagation.sensitivity import by_autograd
from tests.propagation.test_moment_matching import belief, model

generator = torch.Generator().manual_seed(1)


def draw(*shape):
    return torch.randn(*shape, generator=generator)


def residual_model():
    f = GPPosterior.from_hyperparameters(
        draw(30, 3), draw(30, 2), 1 + draw(2, 3).abs(), torch.ones(2), torch.full((2,), 1e-2), 1, "value", draw(2)
    )
    return ResidualModel(Affine(draw(3, 3), draw(3, 2), draw(3)), f, draw(3, 2), [2, 0], [1], 2)


MODELS = {
    "next state": model(n=3, m=2),
    "difference": model(n=3, m=2, predicts="difference"),
    "autonomous": model(n=3, m=0, predicts="difference"),
    "residual": residual_model(),
}
PROPAGATORS = [
    MeanEquivalence(),
    Linearization(),
    Linearization(observation_noise=True),
    MomentMatching(),
    MomentMatching(diagonal=True),
    MomentMatching(observation_noise=True),
]


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("propagator", PROPAGATORS, ids=lambda p: f"{type(p).__name__}{sorted(vars(p).items())}")
def test_closed_forms_are_autograds_derivatives(propagator, name, batch):
    gp, at = MODELS[name], belief(3)
    at = Gaussian(at.mean + 0.3 * draw(*batch, 3), at.covariance.expand(*batch, 3, 3).clone())
    control = draw(*batch, gp.input_dim)
    moved, closed_form = differentiate(propagator, gp, at, control)
    with evaluation("torch"):
        expected, automatic = by_autograd(propagator, gp, at, control)
    pairs = [(getattr(closed_form, part), getattr(automatic, part)) for part in vars(automatic)]
    pairs += [
        (moved.belief.mean, expected.belief.mean),
        (moved.belief.covariance, expected.belief.covariance),
        (moved.cross_covariance, expected.cross_covariance),
        (moved.deficit, expected.deficit),
    ]
    for mine, other in pairs:
        assert mine.shape == other.shape
        assert torch.allclose(
            mine, other, rtol=1e-9, atol=1e-10 * max(1.0, float(other.abs().max()) if other.numel() else 1)
        )


def test_the_evaluation_can_be_forced_and_refuses_what_it_cannot_do():
    gp, state, control = MODELS["next state"], torch.zeros(3), torch.zeros(2)
    with evaluation("torch"):
        by_torch = gp.predict_with_jacobian(state, control)
    with evaluation("compiled"):
        compiled = gp.predict_with_jacobian(state, control)
        with pytest.raises(SettingError, match="part of a graph"):
            gp.predict_with_jacobian(state.requires_grad_(), control)
    for mine, other in zip(compiled[1:], by_torch[1:], strict=True):
        assert torch.allclose(mine, other, rtol=1e-12, atol=1e-13)
    assert torch.allclose(compiled[0].covariance, by_torch[0].covariance, atol=1e-13)
    with pytest.raises(SettingError, match="must be 'auto', 'compiled' or 'torch'; got 'numba'"), evaluation("numba"):
        pass


def test_transforms_and_forward_mode_fall_back_to_torch_unasked():
    gp, control = MODELS["next state"], torch.zeros(2)
    states = draw(3, 3)
    mapped = torch.func.vmap(lambda x: gp.predict_with_jacobian(x, control)[1])(states)
    assert torch.allclose(mapped, gp.predict_with_jacobian(states, control.expand(3, 2))[1], atol=1e-12)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(states[0], torch.ones(3))
        mean, _, _ = gp.mean_with_jacobian(dual, control)
        tangent = torch.autograd.forward_ad.unpack_dual(mean).tangent
    assert torch.allclose(tangent, mapped[0].sum(-1), atol=1e-12)


def test_a_float32_model_is_answered_by_torch_in_float32():
    gp = MODELS["next state"].to(dtype=torch.float32)
    mean, A, _ = gp.mean_with_jacobian(torch.zeros(3, dtype=torch.float32), torch.zeros(2, dtype=torch.float32))
    assert mean.dtype == A.dtype == torch.float32
