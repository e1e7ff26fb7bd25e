"""Where data lie must not matter: a shift of features and targets, however large,
shifts what is learned, no more.

All numbers are multiples of 2^-20, so that float64 holds them exactly at offsets of
1e8, where it resolves 1.5e-8.
"""

import casadi
import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import (
    GPPosterior,
    Hyperparameters,
    Scaling,
    SparseTrainer,
    Trainer,
    Transitions,
    append_points,
    backend,
    identity,
    min_max,
    remove_points,
    standardize,
)
from gpmpc.gp._data_checks import column_scales, constant_columns
from gpmpc.gp._likelihood import NegativeLogMarginalLikelihood
from gpmpc.gp._sparse import collapsed_bound, sparse_posterior
from gpmpc.gp.casadi_ import casadi_function
from gpmpc.gp.module import PosteriorModule
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Unscented,
    differentiate,
    linearize,
)

FEATURES = [1e8, torch.tensor([-1e8, 1e7, 13.75])]
TARGETS = [-1e8, torch.tensor([1e8, 0.0])]


def on_grid(values):
    return (values * 2**20).round() / 2**20


def data(rows=30, noise=1e-3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = 4 * torch.rand(rows, 3, generator=generator) - 2
    y = torch.stack([torch.sin(x[:, 0]) + 0.3 * x[:, 1], x[:, 1] * x[:, 2]], dim=1)
    return on_grid(x), on_grid(y + noise * torch.randn(y.shape, generator=generator))


TRAINERS = {
    "exact": Trainer(restarts=0),
    "exact, standardized": Trainer(restarts=0, scaling=standardize),
    "exact, on an interval": Trainer(restarts=0, scaling=min_max),
    "sparse": SparseTrainer(inducing=15, restarts=0, iterations=15),
    "fitc": SparseTrainer(inducing=15, restarts=0, iterations=15, method="fitc"),
}


def assert_same_training(trainer, x, y, by, targets_by=0.0):
    here = trainer.fit(x, y, 1, "value")
    there = trainer.fit(x + by, y + targets_by, 1, "value")
    assert np.abs(here.objective - there.objective).max() < 0.01
    at = on_grid(data(20, seed=1)[0])
    (ours, *slopes), (theirs, *their_slopes) = (
        training.posterior.predict_with_jacobian(points[:, :2], points[:, 2:])
        for training, points in ((here, at), (there, at + by))
    )
    assert torch.allclose(theirs.mean - targets_by, ours.mean, rtol=0, atol=1e-3)
    assert torch.allclose(theirs.variance, ours.variance, rtol=1e-2, atol=1e-7)
    for slope, their_slope in zip(slopes, their_slopes, strict=True):
        assert torch.allclose(slope, their_slope, rtol=0, atol=1e-2)


def test_inducing_points_are_rounded_before_they_are_factorised():
    """They are found around zero, and kept where the data lie."""
    generator = torch.Generator().manual_seed(0)
    x = on_grid(torch.randn(60, 1, generator=generator))
    y = torch.sin(2 * x) + 1e-2 * torch.randn(x.shape, generator=generator)
    trainer = SparseTrainer(inducing=15, restarts=0, iterations=10)
    here = trainer.fit(x, y, 0, "value").posterior.predict(x)
    there = trainer.fit(x + 1e9, y, 0, "value").posterior.predict(x + 1e9)
    assert torch.allclose(there.mean, here.mean, rtol=0, atol=1e-8)
    assert torch.allclose(there.variance, here.variance, rtol=1e-6)


@pytest.mark.parametrize("by", FEATURES, ids=str)
@pytest.mark.parametrize("name", TRAINERS)
def test_training_does_not_see_where_the_features_lie(name, by):
    assert_same_training(TRAINERS[name], *data(), by)


@pytest.mark.parametrize("by", FEATURES, ids=str)
def test_training_in_place_does_not_see_where_the_features_lie(by, monkeypatch):
    monkeypatch.setattr("gpmpc.gp._likelihood._IN_PLACE", 1)
    assert_same_training(Trainer(restarts=0), *data(), by)


@pytest.mark.parametrize("by", FEATURES, ids=str)
def test_training_with_a_zero_mean_ignores_shifted_features(by):
    assert_same_training(Trainer(restarts=0, scaling=identity), *data(), by)


@pytest.mark.parametrize("by", TARGETS, ids=str)
@pytest.mark.parametrize("name", TRAINERS)
def test_training_does_not_see_where_the_targets_lie(name, by):
    assert_same_training(TRAINERS[name], *data(noise=0.01), 1e8, by)


@pytest.mark.parametrize("by", FEATURES, ids=str)
def test_every_evidence_is_that_of_the_shifted_features(by):
    x, y = data(60)
    theta = np.array([0.2, 0.5, 0.1, 0.3, np.log(1e3)])
    shifted = x + by
    for in_place in (False, True):
        value, gradient = NegativeLogMarginalLikelihood(
            x.numpy(), y[:, 0].numpy(), in_place
        )(theta)
        there, slopes = NegativeLogMarginalLikelihood(
            shifted.numpy(), y[:, 0].numpy(), in_place
        )(theta)
        assert there == pytest.approx(value, rel=1e-10)
        assert np.allclose(slopes, gradient, rtol=1e-7)
    kernel = [
        torch.tensor(theta[None, :3]).exp(),
        torch.ones(1),
        torch.full((1,), 1e-4),
    ]
    bounds = [
        collapsed_bound(p[:20], p, y[:, :1], Hyperparameters(*kernel))
        for p in (x, shifted)
    ]
    assert torch.allclose(*bounds, rtol=1e-10)


def test_a_column_moves_around_a_large_value_unless_at_rest():
    x = data()[0].numpy()
    assert np.array_equal(column_scales(x + 1e8), column_scales(x))
    assert not constant_columns(x + 1e8).any()
    at_rest = 0.5 + 1e-12 * x
    assert constant_columns(at_rest).all()
    assert np.allclose(column_scales(at_rest), np.abs(at_rest).max(axis=0))


def posterior(by=0.0, targets_by=0.0, sparse=False, predicts="next_state"):
    x, y = data(25)
    kernel = {
        "lengthscales": torch.tensor([[1.5, 2.5, 2.0], [1.0, 1.5, 3.0]]),
        "signal_variance": torch.tensor([1.0, 2.0]),
        "noise_variance": torch.tensor([1e-4, 1e-3]),
        "input_dim": 1,
        "predicts": predicts,
        "offset": torch.full((2,), 0.25) + targets_by,
    }
    if sparse:
        hyperparameters = Hyperparameters(
            *(kernel.pop(name) for name in Hyperparameters._fields)
        )
        offset = kernel.pop("offset")
        gp = sparse_posterior(
            x[:10] + by, x + by, y + targets_by - offset, hyperparameters, **kernel
        )
        return gp.unscaled(identity(x), Scaling(offset, torch.ones_like(offset)))
    return GPPosterior.from_hyperparameters(x + by, y + targets_by, **kernel)


def query(by=0.0):
    at = on_grid(data(6, seed=3)[0]) + by
    return at[:, :2], at[:, 2:]


def everything(gp, by):
    """What a model says at shifted points: a list of tensors."""
    x, u = query(by)
    said = [*map(torch.from_numpy, gp.linearize(x.numpy(), u.numpy()))]
    belief, *slopes = gp.predict_with_jacobian(x, u)
    said += [belief.mean, belief.covariance, *slopes]
    module = PosteriorModule(gp)(x, u)
    said += [*module, *torch.export.export(PosteriorModule(gp), (x, u)).module()(x, u)]
    said += [
        torch.from_numpy(np.array(part)).mT
        for part in casadi_function(gp).map(6)(casadi.DM(x.numpy().T), u.numpy().T)
    ]
    return said


@pytest.mark.parametrize("by", FEATURES, ids=str)
@pytest.mark.parametrize("choice", ["compiled", "torch"])
@pytest.mark.parametrize("sparse", [False, True], ids=["exact", "sparse"])
def test_predictions_and_exports_are_those_of_the_shifted_model(by, choice, sparse):
    with backend(choice):
        here = everything(posterior(sparse=sparse), 0.0)
        there = everything(posterior(by, sparse=sparse), by)
    for ours, theirs in zip(here, there, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-7, atol=1e-8 if sparse else 1e-10)


PROPAGATORS = [
    (MomentMatching(), 1e-10),
    (MomentMatching(diagonal=True, process_noise=True), 1e-10),
    (Linearization(), 1e-10),
    (MeanEquivalence(), 1e-10),
    # Sigma points and samples are states, of which float64 resolves 1.5e-8 at 1e8.
    (Unscented(), 3e-7),
    (MonteCarlo(300), 3e-7),
]


@pytest.mark.parametrize("choice", ["auto", "torch"])
@pytest.mark.parametrize(
    ("propagator", "atol"), PROPAGATORS, ids=lambda value: type(value).__name__
)
def test_propagations_are_those_of_the_shifted_model(propagator, atol, choice):
    by = torch.tensor([1e8, -3e6, 1e7])
    covariance = torch.tensor([[0.09, 0.02], [0.02, 0.04]])
    said = []
    for shift in (torch.zeros(3), by):
        x, u = query(shift)
        with backend(choice):
            propagation = propagator.propagate(
                posterior(shift), Gaussian(x[0], covariance), u[0]
            )
            derivatives = differentiate(
                propagator, posterior(shift), Gaussian(x[0], covariance), u[0]
            )[1]
        said.append(
            [
                propagation.belief.mean,
                propagation.belief.covariance,
                propagation.cross_covariance,
                *vars(derivatives).values(),
            ]
        )
    for ours, theirs in zip(*said, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-6, atol=atol)


@pytest.mark.parametrize("predicts", ["next_state", "difference"])
def test_the_local_model_of_a_shifted_state_is_shifted(predicts):
    by = torch.tensor([1e8, -3e6, 1e7])
    covariance = torch.tensor([[0.09, 0.02], [0.02, 0.04]])
    targets_by = by[:2] if predicts == "next_state" else 0.0
    said = []
    for shift, of_targets in ((torch.zeros(3), 0.0), (by, targets_by)):
        x, u = query(shift)
        gp = posterior(shift, of_targets, predicts=predicts)
        belief = Gaussian(x[0], covariance)
        next_belief = MomentMatching()(gp, belief, u[0])
        local = linearize(MomentMatching(), gp, belief, u[0])
        said.append(
            [next_belief.mean - shift[:2], next_belief.covariance, local.A, local.B]
        )
    for ours, theirs in zip(*said, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-6, atol=1e-7)


def test_points_come_and_go_around_a_large_value_as_around_zero():
    x, y = data(28)
    new = slice(25, 28)
    here = remove_points(append_points(posterior(), x[new], y[new]), [0, 7])
    there = remove_points(
        append_points(posterior(1e8, -1e8), x[new] + 1e8, y[new] - 1e8), [0, 7]
    )
    (a, u), (b, v) = query(), query(1e8)
    assert torch.allclose(
        here.predict(a, u).mean, there.predict(b, v).mean + 1e8, rtol=0, atol=1e-6
    )
    assert torch.allclose(
        here.predict(a, u).variance, there.predict(b, v).variance, atol=1e-9
    )


def test_what_flies_around_a_large_value_is_learned_by_default():
    x, y = data(60)
    far = torch.tensor([1e8, -3e6])
    held_out, expected = data(40, noise=0.0, seed=5)
    gp = Trainer()(Transitions(x[:, :2] + far, x[:, 2:], y + far)).posterior
    error = gp.predict(held_out[:, :2] + far, held_out[:, 2:]).mean - far - expected
    assert float(error.square().mean().sqrt()) < 0.05


def test_the_spread_of_a_constant_column_is_its_magnitude_or_one():
    columns = np.column_stack(
        [[1.0, 2.0, 3.0], [-4.0] * 3, [0.0] * 3, [0.5, 0.5 + 1e-12, 0.5]]
    )
    assert np.allclose(column_scales(columns), [1, 4, 1, 0.5])
    assert np.allclose(column_scales(np.array([[2.0, 0.0]])), [2, 1])
    assert np.allclose(
        column_scales(np.array([[1e9, 1.0], [3e9, 1.002]])),
        np.sqrt(2) * np.array([1e9, 1e-3]),
    )
    assert np.allclose(
        column_scales(np.array([[1e9, 1.0, 1.0], [1e9 + 1e-2, 1.0, 1.0 + 1e-5]])),
        [1e-2 / np.sqrt(2), 1, 1e-5 / np.sqrt(2)],
        rtol=1e-5,
    )
