import gpytorch
import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gp import GPPosterior
from gpmpc.gp.model import BatchExactGP, exact_inference


def posterior(size=30, n=2, m=1, predicts="next_state", seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    return GPPosterior.from_hyperparameters(
        inputs=3 * draw(size, n + m) - 1.5,
        targets=draw(size, n) - 0.5,
        lengthscales=0.5 + draw(n, n + m),
        signal_variance=0.5 + draw(n),
        noise_variance=1e-4 + 1e-2 * draw(n),
        input_dim=m,
        predicts=predicts,
    )


@pytest.mark.parametrize("size", [1, 10, 189, 900])
def test_predictions_are_gpytorchs_at_every_size(size):
    gp = posterior(size, n=3, m=2)
    model = BatchExactGP(gp.features, gp.targets)
    noise_free = torch.cat(
        [
            gp.lengthscales.log(),
            gp.signal_variance[:, None].log() / 2,
            (gp.signal_variance / gp.noise_variance)[:, None].log() / 2,
        ],
        dim=1,
    )
    model.set_hyperparameters(noise_free)
    for name in ("lengthscales", "signal_variance", "noise_variance"):
        assert torch.allclose(getattr(model, name), getattr(gp, name), rtol=1e-12)
    states, inputs = torch.rand(6, 3), torch.rand(6, 2)
    with exact_inference(), torch.no_grad(), gpytorch.settings.skip_posterior_variances(False):
        theirs = model.eval()(torch.cat([states, inputs], dim=1).expand(3, -1, -1))
    ours = gp.predict(states, inputs)
    assert torch.allclose(ours.mean, theirs.mean.T, rtol=0, atol=1e-10)
    assert torch.allclose(ours.variance, theirs.variance.T, rtol=0, atol=1e-10)


def test_a_difference_model_adds_the_state():
    state, control = torch.rand(4, 2), torch.rand(4, 1)
    next_state, difference = posterior(), posterior(predicts="difference")
    assert torch.allclose(difference.predict(state, control).mean, next_state.predict(state, control).mean + state)


def test_batches_and_transforms_agree_with_single_predictions():
    gp, states, inputs = posterior(), torch.rand(3, 5, 2), torch.rand(3, 5, 1)
    batch = gp.predict(states, inputs)
    single = gp.predict(states[1, 2], inputs[1, 2])
    assert torch.allclose(batch.mean[1, 2], single.mean, atol=1e-14)
    assert torch.allclose(batch.covariance[1, 2], single.covariance, atol=1e-14)
    mapped = torch.func.vmap(lambda x, u: gp.predict(x, u).mean)(states[0], inputs[0])
    assert torch.allclose(mapped, batch.mean[0], atol=1e-14)
    forward = torch.func.jacfwd(lambda x: gp.predict(x, inputs[0, 0]).mean)(states[0, 0])
    reverse = torch.func.jacrev(lambda x: gp.predict(x, inputs[0, 0]).mean)(states[0, 0])
    assert torch.allclose(forward, reverse, atol=1e-13)


def test_far_from_the_data_the_prior_returns():
    far = posterior().predict(torch.full((2,), 1e3), torch.zeros(1))
    assert not far.mean.any()
    assert torch.equal(far.variance, posterior().signal_variance)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"lengthscales": torch.ones(2, 2)}, ShapeError, r"lengthscales must have shape \(2, 3\); got \(2, 2\)"),
        ({"targets": torch.ones(9, 2)}, ShapeError, r"targets must have shape \(10, 2\); got \(9, 2\)"),
        ({"noise_variance": torch.zeros(2)}, SettingError, r"noise_variance: must be positive; got \[0.0, 0.0\]"),
        ({"input_dim": 2}, ShapeError, "2 controls; got 3 columns and 2 outputs"),
        ({"predicts": "delta"}, SettingError, "'next_state', 'difference', 'value'; got 'delta'"),
        (
            {"inputs": torch.zeros(10, 3), "noise_variance": torch.tensor([1.0, 1e-18])},
            SettingError,
            "output 1 is not positive",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(change, error, message):
    good = {
        "inputs": torch.rand(10, 3),
        "targets": torch.rand(10, 2),
        "lengthscales": torch.ones(2, 3),
        "signal_variance": torch.ones(2),
        "noise_variance": torch.ones(2),
        "input_dim": 1,
    }
    with pytest.raises(error, match=message):
        GPPosterior.from_hyperparameters(**(good | change))
