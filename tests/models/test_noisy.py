"""A model whose noise depends on state and input counts it once, everywhere."""

import numpy as np
import pytest
import torch

from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import (
    Affine,
    DelayedModel,
    DisturbedModel,
    KnownModel,
    NoisyModel,
    ResidualModel,
    load_model,
    save_model,
)
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Unscented,
    best_propagator,
)
from gpmpc.testing import check_model

F = torch.float64


def draw(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F)


def gp(outputs, predicts, noise=0.01, by_input=1.0):
    ones = torch.ones(outputs, dtype=F)
    scales = 1 + draw(3, outputs, 3).abs()
    targets = 0.3 * draw(2, 25, outputs)
    scales[:, 2] /= by_input
    return GPPosterior.from_hyperparameters(
        draw(1, 25, 3), targets, scales, ones, noise * ones, 1, predicts
    )


def residual(noise=None):
    return ResidualModel(
        Affine.identity(2, 1),
        gp(2, "value"),
        torch.eye(2, dtype=F),
        [0, 1],
        [0],
        1,
        noise=noise,
    )


MODELS = {
    "difference": gp(2, "difference"),
    "residual": residual(),
    "known": KnownModel(Affine.identity(2, 1), 2, 1),
}
QUIET = Gaussian(
    torch.tensor([0.3, -0.2], dtype=F), torch.diag(torch.tensor([0.04, 0.02], dtype=F))
)
PUSH = torch.tensor([0.4], dtype=F)


def noisy(inner="difference", outputs=(1,)):
    return NoisyModel(MODELS[inner], gp(len(outputs), "value"), outputs)


@pytest.mark.parametrize("outputs", [(1,), (1, 0)])
@pytest.mark.parametrize("inner", MODELS)
def test_a_noisy_model_is_a_model_and_what_holds_it_is_one(inner, outputs):
    model = noisy(inner, outputs)
    for one in (
        model,
        DelayedModel(model, 1.5),
        DisturbedModel(model, torch.eye(2, 1, dtype=F), [0.1]),
    ):
        check_model(one)


def test_all_noise_is_in_the_prediction_and_the_mean_stays():
    model = noisy()
    x = draw(7, 6, 2)
    u = draw(8, 6, 1)
    inner = model.model
    g = model.log_noise.predict(x, u)
    belief = model.predict(x, u)
    alone = inner.predict(x, u)
    noise = model.noise(x, u)
    assert torch.equal(belief.mean, alone.mean)
    assert torch.equal(belief.covariance, alone.covariance + noise)
    assert torch.equal(noise[:, 0, 0], torch.full((6,), 0.01, dtype=F))
    draws = (
        (g.mean + g.variance.sqrt() * draw(9, 100_000, 1, 1)).exp().mean(0)
    )  # of sigma^2
    assert torch.allclose(noise[:, 1, 1], draws[:, 0], rtol=0.02)
    assert not noise[:, 0, 1].any()
    assert not model.noise_covariance.any()
    assert torch.equal(
        model.to(dtype=torch.float32)
        .predict(x.float(), u.float())
        .mean.double()
        .round(decimals=4),
        belief.mean.round(decimals=4),
    )


@pytest.mark.parametrize(
    "kind", [Linearization, Unscented, MeanEquivalence, MonteCarlo]
)
def test_every_propagator_counts_it_once(kind):
    model = noisy()
    with_noise, without = (
        kind(process_noise=on)(model, QUIET, PUSH) for on in (True, False)
    )
    assert torch.equal(with_noise.covariance, without.covariance)
    alone = kind(process_noise=False)(model.model, QUIET, PUSH)
    added = with_noise.covariance - alone.covariance
    there = model.noise(QUIET.mean, PUSH)
    assert torch.allclose(added[0, 0], there[0, 0])
    if kind in (Linearization, MeanEquivalence):
        assert torch.allclose(added, there, atol=1e-12)
    else:  # its mean over the belief
        states = QUIET.mean + draw(4, 100_000, 2) @ QUIET.covariance.sqrt()
        averaged = model.noise(states, PUSH.expand(len(states), 1)).mean(0)
        assert torch.allclose(added, averaged, rtol=0.02, atol=1e-12)


def test_moments_have_no_closed_form():
    with pytest.raises(UnsupportedModel, match="got NoisyModel"):
        MomentMatching()(noisy(), QUIET, PUSH)
    assert isinstance(best_propagator(noisy()), Unscented)


def test_a_filter_is_that_of_the_noise_at_the_belief():
    model = noisy()
    sensor = Measurement.of_states(2, [0], std=[0.1])
    noise = model.noise(QUIET.mean, PUSH)
    fixed = residual(noise)
    same = NoisyModel(MODELS["residual"], model.log_noise, (1,))
    found, expected = (
        KalmanFilter.extended(one, sensor).predict(QUIET, PUSH) for one in (same, fixed)
    )
    assert torch.allclose(found.covariance, expected.covariance, atol=1e-13)


@pytest.mark.parametrize("covariance", ["zero_order", "none", "diagonal", "full"])
@pytest.mark.parametrize("kind", [Linearization, Unscented])
def test_the_tube_of_a_controller_holds_the_noise_where_it_goes(covariance, kind):
    model = NoisyModel(MODELS["known"], gp(2, "value", by_input=1e-9), (0, 1))
    problem = Problem(
        Tracking([1.0, 1.0], [0.1]),
        Box([-1.0], [1.0]),
        constraints=[Box(upper=[2.0, 2.0], probability=0.9)],
    )
    controller = GPMPC(
        model,
        kind(process_noise=True),
        problem,
        3,
        [0.0],
        PredictionSettings(covariance=covariance),
    )
    decision = controller.control(
        Gaussian.certain(QUIET.mean), Reference(np.zeros((4, 2)))
    )
    if covariance == "none":
        assert not decision.covariances.any()
        return
    first = model.noise(QUIET.mean, torch.as_tensor(decision.inputs[0]))
    assert np.allclose(np.diagonal(decision.covariances[1]), first.diagonal())


def test_a_file_holds_both_parts(tmp_path):
    model = DelayedModel(noisy("residual", (1, 0)), 1)
    save_model(model, tmp_path / "m.safetensors")
    read = load_model(tmp_path / "m.safetensors")
    x = draw(7, 6, 3)
    u = draw(8, 6, 1)
    assert read.model.outputs == [1, 0]
    assert torch.equal(read.predict(x, u).covariance, model.predict(x, u).covariance)


def test_misuse_is_refused():
    model = gp(2, "difference")
    with pytest.raises(SettingError, match="must predict 'value'.*got 'difference'"):
        NoisyModel(model, gp(2, "difference"), [0, 1])
    with pytest.raises(SettingError, match="must be distinct, of 0 .. 1; got \\[2\\]"):
        NoisyModel(model, gp(1, "value"), [2])
    with pytest.raises(
        ShapeError, match=r"must have 2 states, 1 inputs and 1 outputs; got \(2, 1, 2\)"
    ):
        NoisyModel(model, gp(2, "value"), [1])


@pytest.mark.parametrize("outputs", [[1.0], [True], None, 1, []])
def test_outputs_that_are_no_whole_numbers_are_refused(outputs):
    with pytest.raises(SettingError, match="outputs: must be a list of whole numbers"):
        NoisyModel(MODELS["difference"], gp(1, "value"), outputs)
