import gpytorch
import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gp import (
    GPPosterior,
    Scaling,
    backend,
    exact_inference,
    from_gpytorch,
    to_gpytorch,
)


def posterior(size=30, n=2, m=1, predicts="next_state", seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    return GPPosterior.from_hyperparameters(
        features=3 * draw(size, n + m) - 1.5,
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
    model = to_gpytorch(gp)
    states = torch.rand(6, 3)
    inputs = torch.rand(6, 2)
    with (
        exact_inference(),
        torch.no_grad(),
        gpytorch.settings.skip_posterior_variances(False),
    ):
        theirs = model(torch.cat([states, inputs], dim=1).expand(3, -1, -1))
    ours = gp.predict(states, inputs)
    assert torch.allclose(ours.mean, theirs.mean.T, rtol=0, atol=1e-10)
    assert torch.allclose(ours.variance, theirs.variance.T, rtol=0, atol=1e-10)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_model_of_gpytorch_is_where_its_posterior_is():
    gp = posterior(10).to("cuda")
    again = from_gpytorch(to_gpytorch(gp), input_dim=gp.input_dim)
    assert again.device == gp.device
    assert torch.allclose(again.weights, gp.weights)


@pytest.mark.parametrize("choice", ["compiled", "torch"])
def test_states_and_inputs_of_any_kind_are_linearised_at(choice):
    gp = posterior()
    x = np.linspace(-1.0, 1.0, 6).reshape(3, 2)
    u = np.array([[0.1], [0.2], [0.3]])
    with backend(choice):
        expected = gp.linearize(x, u)
        of_lists = gp.linearize(x.tolist(), u.tolist())
        of_tensors = gp.linearize(torch.from_numpy(x), torch.from_numpy(u))
        backwards = gp.linearize(x[::-1], u[::-1])
    assert np.array_equal(of_lists.A, expected.A)
    assert np.array_equal(of_tensors.A, expected.A)
    assert np.allclose(backwards.A[::-1], expected.A, rtol=1e-12)


def test_a_scaling_of_other_columns_is_refused():
    one_column = Scaling(torch.zeros(1), torch.ones(1))
    two_columns = Scaling(torch.zeros(2), torch.ones(2))
    with pytest.raises(ShapeError, match="3 features and 2 targets; got 1 and 2"):
        posterior().unscaled(one_column, two_columns)


def test_a_difference_model_adds_the_state():
    state = torch.rand(4, 2)
    control = torch.rand(4, 1)
    next_state = posterior()
    difference = posterior(predicts="difference")
    assert torch.allclose(
        difference.predict(state, control).mean,
        next_state.predict(state, control).mean + state,
    )


def test_batches_and_transforms_agree_with_single_predictions():
    gp = posterior()
    states = torch.rand(3, 5, 2)
    inputs = torch.rand(3, 5, 1)
    batch = gp.predict(states, inputs)
    single = gp.predict(states[1, 2], inputs[1, 2])
    assert torch.allclose(batch.mean[1, 2], single.mean, atol=1e-14)
    assert torch.allclose(batch.covariance[1, 2], single.covariance, atol=1e-14)
    mapped = torch.func.vmap(lambda x, u: gp.predict(x, u).mean)(states[0], inputs[0])
    assert torch.allclose(mapped, batch.mean[0], atol=1e-14)
    forward = torch.func.jacfwd(lambda x: gp.predict(x, inputs[0, 0]).mean)(
        states[0, 0]
    )
    reverse = torch.func.jacrev(lambda x: gp.predict(x, inputs[0, 0]).mean)(
        states[0, 0]
    )
    assert torch.allclose(forward, reverse, atol=1e-13)


def test_far_from_the_data_the_prior_returns():
    far = posterior().predict(torch.full((2,), 1e3), torch.zeros(1))
    assert not far.mean.any()
    assert torch.equal(far.variance, posterior().signal_variance)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"lengthscales": torch.ones(2, 2)},
            ShapeError,
            r"lengthscales must have shape \(2, 3\); got \(2, 2\)",
        ),
        (
            {"targets": torch.ones(9, 2)},
            ShapeError,
            r"targets must have shape \(10, 2\); got \(9, 2\)",
        ),
        ({"targets": torch.tensor(1.0)}, ShapeError, r"need two .* and \(\)"),
        (
            {"noise_variance": torch.zeros(2)},
            SettingError,
            r"noise_variance: must be positive; got \[0.0, 0.0\]",
        ),
        ({"input_dim": 2}, ShapeError, "2 controls; got 3 columns and 2 outputs"),
        (
            {"predicts": "delta"},
            SettingError,
            "'next_state', 'difference', 'value'; got 'delta'",
        ),
        (
            {
                "features": torch.zeros(10, 3),
                "noise_variance": torch.tensor([1.0, 1e-18]),
            },
            SettingError,
            "output 2 is not positive",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(change, error, message):
    good = {
        "features": torch.rand(10, 3),
        "targets": torch.rand(10, 2),
        "lengthscales": torch.ones(2, 3),
        "signal_variance": torch.ones(2),
        "noise_variance": torch.ones(2),
        "input_dim": 1,
    }
    with pytest.raises(error, match=message):
        GPPosterior.from_hyperparameters(**(good | change))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"features": torch.zeros(0, 3), "targets": torch.zeros(0, 2)},
            ShapeError,
            r"a row; got \(0, 3\) and \(0, 2\)",
        ),
        (
            {"features": torch.full((10, 3), torch.nan)},
            DataError,
            "features must be finite; got nan",
        ),
        (
            {"targets": torch.rand(10, 2).float()},
            SettingError,
            "targets: must be float64",
        ),
        (
            {"offset": torch.zeros(3)},
            ShapeError,
            r"offset must have shape \(2,\); got \(3,\)",
        ),
        (
            {"input_dim": 4, "predicts": "value"},
            ShapeError,
            "4 controls; got 3 columns and 2 outputs",
        ),
    ],
)
def test_data_that_teach_nothing_are_refused_with_the_rule(change, error, message):
    test_misuse_is_refused_with_the_rule(change, error, message)


@pytest.mark.parametrize("predicts", ["next_state", "difference"])
def test_the_jacobian_of_the_mean_is_that_of_autograd(predicts):
    gp = posterior(predicts=predicts)
    state = torch.rand(2)
    control = torch.rand(1)
    belief, by_state, by_input = gp.predict_with_jacobian(state, control)
    reference = torch.func.jacrev(lambda x, u: gp.predict(x, u).mean, argnums=(0, 1))(
        state, control
    )
    assert torch.allclose(belief.mean, gp.predict(state, control).mean, atol=1e-13)
    assert torch.allclose(by_state, reference[0], atol=1e-12)
    assert torch.allclose(by_input, reference[1], atol=1e-12)


def test_an_unscaled_posterior_speaks_physical_units():
    gp = posterior()
    features = Scaling(torch.tensor([1.0, -3.0, 10.0]), torch.tensor([2.0, 0.1, 50.0]))
    targets = Scaling(torch.tensor([5.0, -7.0]), torch.tensor([100.0, 0.01]))
    physical = gp.unscaled(features, targets)
    scaled = torch.rand(6, 3)
    query = features.restore(scaled)
    ours = physical.predict(query[:, :2], query[:, 2:])
    theirs = gp.predict(scaled[:, :2], scaled[:, 2:])
    assert torch.allclose(ours.mean, targets.restore(theirs.mean), rtol=1e-12)
    assert torch.allclose(
        ours.variance, theirs.variance * targets.factor**2, rtol=1e-10
    )
    names = ("lengthscales", "signal_variance", "noise_variance")
    hyperparameters = {name: getattr(physical, name) for name in names}
    fresh = GPPosterior.from_hyperparameters(
        physical.features,
        physical.targets,
        **hyperparameters,
        input_dim=1,
        offset=physical.offset,
    )
    assert torch.allclose(physical.cholesky, fresh.cholesky, rtol=1e-9, atol=1e-9)
    assert torch.allclose(physical.weights, fresh.weights, rtol=1e-8, atol=1e-10)
    assert physical.has_observation_noise


def test_a_value_model_may_have_any_number_of_outputs():
    inputs = torch.rand(12, 4)
    targets = torch.rand(12, 1)
    settings = (torch.ones(1, 4), torch.ones(1), torch.full((1,), 1e-4))
    gp = GPPosterior.from_hyperparameters(
        inputs, targets, *settings, input_dim=1, predicts="value"
    )
    belief, by_state, by_input = gp.predict_with_jacobian(inputs[:, :3], inputs[:, 3:])
    assert (gp.state_dim, gp.output_dim, by_state.shape, by_input.shape) == (
        3,
        1,
        (12, 1, 3),
        (12, 1, 1),
    )
    assert torch.allclose(belief.mean, targets, atol=0.05)


def test_single_precision_predicts_nearly_the_same():
    gp = posterior()
    state = torch.rand(4, 2)
    control = torch.rand(4, 1)
    single = gp.to(dtype=torch.float32)
    assert (single.dtype, single.precision.dtype, gp.dtype) == (
        torch.float32,
        torch.float32,
        torch.float64,
    )
    assert torch.allclose(
        single.predict(state.float(), control.float()).mean.double(),
        gp.predict(state, control).mean,
        atol=1e-3,
    )
    with pytest.raises(
        SettingError,
        match="state: must be torch.float32 on cpu like the model; got torch.float64",
    ):
        single.predict(state, control)


def test_a_query_of_other_dimensions_is_refused():
    with pytest.raises(
        ShapeError, match=r"an input \(\*batch, 1\); got \(2,\) and \(0,\)"
    ):
        posterior().predict(torch.zeros(2))
