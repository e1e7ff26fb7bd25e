"""Conditioning and dropping against a fresh factorisation of the same points."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError, UnsupportedModel
from gpmpc.gp import (
    GPPosterior,
    SoftLimits,
    Trainer,
    Transitions,
    append_points,
    append_transitions,
    remove_points,
    standardize,
    train,
)


def transitions(rows, n=3, m=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = 4 * torch.rand(rows, n, generator=generator) - 2
    u = 2 * torch.rand(rows, m, generator=generator) - 1
    next_states = x + 0.1 * torch.sin(x.roll(1, dims=1)) + 0.1 * u[:, :1] * x
    return Transitions(
        x, u, next_states + 1e-3 * torch.randn(rows, n, generator=generator)
    )


def posterior(data, noise=1e-3, predicts="next_state", offset=None):
    n = data.state_dim
    d = data.features.shape[1]
    targets = (
        data.next_states - data.states if predicts == "difference" else data.next_states
    )
    return GPPosterior.from_hyperparameters(
        data.features,
        targets,
        lengthscales=1.0 + 0.1 * torch.arange(n * d).reshape(n, d),
        signal_variance=0.5 + torch.arange(n, dtype=torch.float64),
        noise_variance=noise * (0.5 + torch.arange(n)),
        input_dim=data.input_dim,
        predicts=predicts,
        offset=offset,
    )


def fresh(gp):
    return GPPosterior.from_hyperparameters(
        gp.features,
        gp.targets,
        gp.lengthscales,
        gp.signal_variance,
        gp.noise_variance,
        gp.input_dim,
        gp.predicts,
        gp.offset,
    )


def assert_equal(one, other, tolerance=1e-9):
    query = torch.linspace(-2, 2, 12).reshape(4, 3)
    control = torch.zeros(4, 2)
    ours = one.predict(query, control)
    theirs = other.predict(query, control)
    assert torch.equal(one.features, other.features)
    assert torch.equal(one.targets, other.targets)
    assert torch.allclose(one.cholesky, other.cholesky, rtol=0, atol=tolerance)
    assert torch.allclose(
        one.weights,
        other.weights,
        rtol=0,
        atol=tolerance * float(1 + other.weights.abs().max()),
    )
    assert torch.allclose(ours.mean, theirs.mean, rtol=0, atol=tolerance)
    assert torch.allclose(ours.variance, theirs.variance, rtol=0, atol=tolerance)


@pytest.mark.parametrize("predicts", ["next_state", "difference"])
@pytest.mark.parametrize("new", [1, 7])
def test_conditioning_is_the_posterior_of_all_points(predicts, new):
    data = transitions(40 + new)
    offset = torch.tensor([0.3, -1.0, 0.0])
    grown = append_transitions(
        posterior(data[:40], predicts=predicts, offset=offset), data[40:]
    )
    assert_equal(grown, posterior(data, predicts=predicts, offset=offset), 1e-12)


@pytest.mark.parametrize(
    "gone",
    [
        [0],
        [39],
        [17],
        [-1],
        [3, 4, 30],
        [30, 3, 4],
        list(range(35)),
        range(5),
        torch.tensor([2, 9]),
        6,
    ],
)
def test_dropping_is_the_posterior_of_the_others(gone):
    data = transitions(40)
    rows = np.delete(np.arange(40), gone)
    assert_equal(
        remove_points(posterior(data), gone), posterior(data[rows.tolist()]), 1e-11
    )


def test_dropping_nothing_changes_nothing():
    gp = posterior(transitions(5))
    assert remove_points(gp, []) is gp


@pytest.mark.parametrize("noise", [1e-6, 1e-2])
def test_hundreds_of_random_changes_leave_no_error_behind(noise, rng):
    data = transitions(900)
    gp = posterior(data[:60], noise)
    seen = 60
    for _ in range(250):
        new = int(rng.integers(1, 4))
        gp = remove_points(
            append_transitions(gp, data[seen : seen + new]),
            rng.choice(len(gp) + new, new, replace=False),
        )
        seen += new
    assert len(gp) == 60
    assert_equal(gp, fresh(gp))


def test_the_old_posterior_is_as_it_was():
    data = transitions(30)
    gp = posterior(data[:25])
    same = posterior(data[:25])
    append_transitions(gp, data[25:])
    remove_points(gp, [0, 12])
    assert_equal(gp, same, 0)


@pytest.mark.parametrize("noise", [1e-6, 1e-2])
def test_points_that_are_there_already_do_no_harm(noise):
    data = transitions(30)
    gp = posterior(data, noise)
    for _ in range(20):
        gp = append_transitions(gp, data[:5])
    assert_equal(gp, fresh(gp))
    assert_equal(remove_points(gp, range(30, len(gp))), posterior(data, noise))


def test_what_was_told_is_believed_and_what_was_forgotten_is_not():
    data = transitions(60)
    gp = posterior(data[:50], 1e-6)
    new = data[50:51]
    grown = append_transitions(gp, new)
    before = gp.predict(new.states, new.inputs)
    after = grown.predict(new.states, new.inputs)
    assert (after.variance < before.variance).all()
    assert torch.allclose(after.mean, new.next_states, atol=1e-2)
    assert_equal(remove_points(grown, 50), gp)


def test_single_precision_posteriors_can_be_updated_too():
    data = transitions(40)
    gp = remove_points(
        append_transitions(
            posterior(data[:30], 1e-2).to(dtype=torch.float32), data[30:]
        ),
        [0],
    )
    query = data.states
    control = data.inputs
    assert gp.dtype == torch.float32
    assert gp.has_observation_noise
    exact = posterior(data[1:], 1e-2).predict(query, control).mean
    assert torch.allclose(
        gp.predict(query.float(), control.float()).mean.double(), exact, atol=1e-3
    )


def test_more_points_than_the_noise_allows_are_refused():
    data = transitions(3)
    without_noise = posterior(data, 1e-17)
    with pytest.raises(
        SettingError, match="the kernel matrix of output . is not positive"
    ):
        append_points(
            without_noise,
            without_noise.features[0] + 1e-5 * torch.randn(30, 5),
            torch.zeros(30, 3),
        )


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            lambda gp: append_transitions(gp, transitions(2, n=2)),
            ShapeError,
            "3 states and 2 inputs; got .* 2 and 2",
        ),
        (
            lambda gp: append_transitions(gp, transitions(2, m=1)),
            ShapeError,
            "3 states and 2 inputs; got .* 3 and 1",
        ),
        (
            lambda gp: append_points(gp, torch.zeros(2, 5), torch.zeros(1, 3)),
            ShapeError,
            r"targets must have shape \(2, 3\); got \(1, 3\)",
        ),
        (
            lambda gp: append_points(gp, torch.zeros(2, 4), torch.zeros(2, 3)),
            ShapeError,
            "features must have n . m columns, .* got 4 columns and 3 outputs",
        ),
        (
            lambda gp: append_points(
                replace(gp, predicts="value"), torch.zeros(2, 4), torch.zeros(2, 3)
            ),
            ShapeError,
            "features and targets like those of GPPosterior.*; got 4 and 3",
        ),
        (
            lambda gp: append_points(
                gp, torch.zeros(1, 5), torch.full((1, 3), torch.nan)
            ),
            DataError,
            "targets must be finite; got nan",
        ),
        (
            lambda gp: remove_points(gp, range(10)),
            DataError,
            "at least one point; removing 10 of 10 leaves none",
        ),
        (
            lambda gp: remove_points(gp, [10]),
            SettingError,
            r"whole numbers from -10 to 9; got \[10\]",
        ),
        (
            lambda gp: remove_points(gp, [True]),
            SettingError,
            r"whole numbers from -10 to 9; got \[True\]",
        ),
        (
            lambda gp: remove_points(gp, [1, -9]),
            SettingError,
            r"must be different; got \[1, -9\]",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(change, error, message):
    with pytest.raises(error, match=message):
        change(posterior(transitions(10)))


def test_a_posterior_of_values_says_how_it_is_conditioned():
    gp = GPPosterior(**(vars(posterior(transitions(10))) | {"predicts": "value"}))
    with pytest.raises(UnsupportedModel, match="use append_points"):
        append_transitions(gp, transitions(1))
    assert len(append_points(gp, torch.zeros(1, 5), torch.zeros(1, 3))) == 11


def test_refitting_starts_where_the_last_training_ended():
    data = transitions(60, n=2, m=1)
    trainer = Trainer(penalty=SoftLimits(), restarts=0)
    first = trainer(data[:45])
    again = trainer.refit(first.posterior)
    assert (again.objective <= first.objective + 1e-6).all()
    assert again.evaluations < first.evaluations
    more = trainer.refit(first.posterior, data[45:])
    cold = trainer(data)
    assert len(more.posterior) == 60
    assert (more.objective <= cold.objective + 0.5).all()
    gp = Trainer(predicts="difference", restarts=0)(data[:20]).posterior
    leaves = {
        name: getattr(gp, name).clone().requires_grad_()
        for name in ("features", "targets", "lengthscales")
    }
    followed = trainer.refit(replace(gp, **leaves))
    np.testing.assert_array_equal(followed.theta, trainer.refit(gp).theta)


def test_refitting_keeps_units_and_what_is_predicted():
    data = transitions(50, n=2, m=1)
    trainer = Trainer(predicts="difference", scaling=standardize, restarts=0)
    grown = append_transitions(trainer(data[:40]).posterior, data[40:])
    again = trainer.refit(grown)
    assert again.posterior.predicts == "difference"
    assert (again.objective <= trainer(data).objective + 1e-3).all()
    error = again.posterior.predict(data.states, data.inputs).mean - data.next_states
    assert float(error.abs().max()) < 1e-2


def test_a_start_of_other_dimensions_is_refused():
    other = train(transitions(10, n=2), restarts=0).posterior
    with pytest.raises(
        ShapeError, match="must have 5 features and 3 outputs; got 4 and 2"
    ):
        Trainer()(transitions(10), start=other)
