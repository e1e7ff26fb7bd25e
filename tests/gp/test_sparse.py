"""Sparse GPs frozen to pseudo-observations, against their textbook formulas, the exact
GP, and each other."""

import logging

import gpytorch
import numpy as np
import pytest
import torch

from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    TrainingError,
    UnsupportedModel,
)
from gpmpc.gaussian import Gaussian
from gpmpc.gp import (
    GPPosterior,
    Hyperparameters,
    SlidingWindow,
    SparseTrainer,
    Trainer,
    Transitions,
    append_transitions,
    exact_inference,
    informative_points,
    remove_points,
    standardize,
)
from gpmpc.gp._kernel import kernel_matrix
from gpmpc.gp._sparse import _cross, collapsed_bound, sparse_posterior
from gpmpc.propagation import MomentMatching, MonteCarlo
from tests.gp.their_models import sgpr


def problem(rows=150, noise=1e-2, seed=0, spread=1.0):
    generator = torch.Generator().manual_seed(seed)
    x = 4 * torch.rand(rows, 3, generator=generator) - 2
    y = torch.stack([torch.sin(2 * x[:, 0]) + x[:, 2], x[:, 1] * x[:, 0]], dim=1)
    settings = {
        "lengthscales": spread * torch.tensor([[0.8, 2.0, 1.5], [1.0, 1.2, 3.0]]),
        "signal_variance": torch.tensor([1.0, 2.0]),
        "noise_variance": torch.full((2,), noise),
    }
    return x, y + noise**0.5 * torch.randn(y.shape, generator=generator), settings


def textbook(Z, x, y, query, method, lengthscales, signal_variance, noise_variance):
    """Mean and variance from the formulas with their inverses (Quinonero-Candela and
    Rasmussen, 2005, section 5)."""
    means = []
    variances = []
    for a in range(len(lengthscales)):

        def k(p, q, a=a):
            return kernel_matrix(
                p, q, lengthscales[a : a + 1], signal_variance[a : a + 1]
            )[0]

        explained = (k(Z, x) * torch.linalg.solve(k(Z, Z), k(Z, x))).sum(0)
        Lam = noise_variance[a] + (
            signal_variance[a] - explained if method == "fitc" else torch.zeros(len(x))
        )
        S = k(Z, Z) + k(Z, x) / Lam @ k(x, Z)
        means.append(k(query, Z) @ torch.linalg.solve(S, k(Z, x) / Lam @ y[:, a]))
        change = torch.linalg.solve(k(Z, Z), k(Z, query)) - torch.linalg.solve(
            S, k(Z, query)
        )
        variances.append(signal_variance[a] - (k(Z, query) * change).sum(0))
    return torch.stack(means, dim=1), torch.stack(variances, dim=1)


@pytest.mark.parametrize("method", ["sgpr", "fitc"])
@pytest.mark.parametrize("noise", [1e-5, 1e-1])
def test_a_frozen_posterior_has_the_textbooks_mean_and_variance(method, noise):
    x, y, settings = problem(noise=noise)
    gp = sparse_posterior(
        x[:25],
        x,
        y,
        Hyperparameters(**settings),
        input_dim=1,
        predicts="value",
        method=method,
    )
    query = problem(40, seed=1)[0]
    mean, variance = textbook(x[:25], x, y, query, method, **settings)
    belief = gp.predict(query[:, :2], query[:, 2:])
    assert torch.allclose(belief.mean, mean, rtol=0, atol=1e-8)
    assert torch.allclose(belief.variance, variance, rtol=0, atol=1e-8)
    solved = torch.cholesky_solve((gp.targets - gp.offset).mT[..., None], gp.cholesky)[
        ..., 0
    ]
    assert torch.allclose(solved, gp.weights, rtol=1e-9)


@pytest.mark.parametrize("method", ["sgpr", "fitc"])
def test_with_every_point_as_inducing_point_it_is_the_exact_gp(method):
    x, y, settings = problem(60)
    offset = torch.tensor([0.5, -1.0])
    query = problem(40, seed=1)[0]
    more = settings | {"input_dim": 1, "predicts": "value", "offset": offset}
    exact = GPPosterior.from_hyperparameters(x, y, **more).predict(
        query[:, :2], query[:, 2:]
    )
    frozen = sparse_posterior(
        x, x, y - offset, Hyperparameters(**settings), 1, "value", method
    )
    sparse = frozen.predict(query[:, :2], query[:, 2:])
    assert torch.allclose(sparse.mean + offset, exact.mean, rtol=0, atol=1e-8)
    assert torch.allclose(sparse.variance, exact.variance, rtol=0, atol=1e-8)


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6])
def test_no_covariance_of_distant_points_exceeds_the_variance(distance):
    x, _, settings = problem(40)
    far = torch.cat([x, x + distance])
    covariances = _cross(far, far, Hyperparameters(**settings))
    assert (covariances <= settings["signal_variance"][:, None, None]).all()
    assert torch.allclose(
        covariances.diagonal(dim1=1, dim2=2),
        settings["signal_variance"][:, None],
        rtol=1e-3,
    )
    assert covariances[:, :40, 40:].max() == 0


def test_nearly_equal_points_get_the_jitter_they_need():
    x, y, settings = problem(100, spread=20.0)
    gp = sparse_posterior(
        x, x, y, Hyperparameters(**settings), input_dim=1, predicts="value"
    )
    exact = GPPosterior.from_hyperparameters(
        x, y, **settings, input_dim=1, predicts="value"
    )
    query = problem(40, seed=1)[0]
    ours, theirs = (model.predict(query[:, :2], query[:, 2:]) for model in (gp, exact))
    assert torch.allclose(ours.mean, theirs.mean, rtol=0, atol=1e-4)
    assert torch.allclose(ours.variance, theirs.variance, rtol=0, atol=1e-5)
    with pytest.raises(
        SettingError,
        match="inducing: their kernel matrix of output . is not positive definite",
    ):
        sparse_posterior(
            x,
            x,
            y,
            Hyperparameters(**settings),
            input_dim=1,
            predicts="value",
            jitter=0.0,
        )


def test_the_bound_reaches_the_evidence_with_every_point_only():
    x, y, settings = problem(60)
    gp = GPPosterior.from_hyperparameters(
        x, y, **settings, input_dim=1, predicts="value"
    )
    prior = torch.distributions.MultivariateNormal(
        torch.zeros(60), scale_tril=gp.cholesky
    )
    evidence = prior.log_prob(y.mT)
    few, more = (
        collapsed_bound(x[:count], x, y, Hyperparameters(**settings))
        for count in (10, 40)
    )
    assert (few < more).all()
    assert (more < evidence).all()
    assert torch.allclose(
        collapsed_bound(x, x, y, Hyperparameters(**settings), jitter=1e-12),
        evidence,
        atol=1e-5,
    )
    assert torch.allclose(
        collapsed_bound(
            x, x, y, Hyperparameters(**settings), method="fitc", jitter=1e-12
        ),
        evidence,
        atol=1e-5,
    )


def test_the_bound_is_gpytorchs():
    model = sgpr()
    kernel, (x, *_), y = (
        model.covar_module.base_kernel,
        model.train_inputs,
        model.train_targets,
    )
    ours = collapsed_bound(
        model.covar_module.inducing_points.detach(),
        x[0],
        y.mT,
        Hyperparameters(
            kernel.base_kernel.lengthscale.detach()[:, 0],
            kernel.outputscale.detach(),
            model.likelihood.noise.detach()[:, 0],
        ),
        jitter=0.0,
    )
    likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(
        model.likelihood.train(), model.train()
    )
    with exact_inference(), torch.no_grad():
        bound = likelihood(model(*model.train_inputs), y) * y.shape[-1]
    assert torch.allclose(ours, bound, rtol=1e-8)


def test_the_bounds_gradient_is_right():
    x, y, settings = problem(30)
    leaves = [x[:6].clone(), *settings.values()]
    for method in ("sgpr", "fitc"):

        def bound(Z, *hyperparameters, method=method):
            return collapsed_bound(
                Z, x, y, Hyperparameters(*hyperparameters), method=method
            )

        assert torch.autograd.gradcheck(
            bound, [leaf.clone().requires_grad_() for leaf in leaves], atol=1e-4
        )


@pytest.mark.parametrize("method", ["sgpr", "fitc"])
def test_bound_and_gradient_in_blocks_are_those_in_one_piece(method, monkeypatch):
    x, y, settings = problem(150)
    leaves = [leaf.clone().requires_grad_() for leaf in (x[:12], *settings.values())]
    whole = collapsed_bound(
        leaves[0], x, y, Hyperparameters(*leaves[1:]), method=method
    )
    slopes = torch.autograd.grad(whole.sum(), leaves)
    monkeypatch.setattr("gpmpc.gp._sparse._ENTRIES", 1)  # 64 points at a time
    value = collapsed_bound(
        leaves[0], x, y, Hyperparameters(*leaves[1:]), method=method
    )
    value.sum().backward()
    gradients = [leaf.grad for leaf in leaves]
    assert torch.allclose(value, whole, rtol=1e-12)
    for ours, theirs in zip(gradients, slopes, strict=True):
        assert torch.allclose(
            ours, theirs, rtol=1e-8, atol=1e-8 * float(theirs.abs().max())
        )


@pytest.mark.parametrize("method", ["sgpr", "fitc"])
def test_a_frozen_sparse_model_is_used_like_any_other(method):
    x, y, settings = problem(200, noise=1e-3)
    gp = sparse_posterior(
        x[:40], x, y, Hyperparameters(**settings), input_dim=1, method=method
    )
    new = Transitions(x[:3, :2] + 0.1, x[:3, 2:], y[:3])
    grown = append_transitions(gp, new)
    assert (
        grown.predict(new.states, new.inputs).variance
        < gp.predict(new.states, new.inputs).variance
    ).all()
    back = remove_points(grown, [40, 41, 42])
    query = torch.rand(5, 2)
    assert torch.allclose(
        back.predict(query, query[:, :1]).mean,
        gp.predict(query, query[:, :1]).mean,
        atol=1e-8,
    )
    assert len(SlidingWindow(40, "least_informative")(gp, new)) == 40
    at = Gaussian(torch.tensor([0.3, -0.2]), 0.05 * torch.eye(2))
    control = torch.zeros(1)
    matched = MomentMatching()(gp, at, control)
    sampled = MonteCarlo(20_000)(gp, at, control)
    error = (sampled.covariance.diagonal() / 20_000).sqrt()
    assert ((matched.mean - sampled.mean).abs() < 5 * error).all()
    assert torch.allclose(matched.covariance, sampled.covariance, atol=0.03)
    with pytest.raises(UnsupportedModel, match="train again with SparseTrainer"):
        Trainer().refit(gp)


@pytest.mark.parametrize("count", [-1, 1.5, "all"])
def test_the_number_of_informative_points_is_one(count):
    one = torch.ones(1, dtype=torch.float64)
    with pytest.raises(SettingError, match="count: must be a whole number"):
        informative_points(one[:, None], (one[:, None], one, one), count)


def test_informative_points_differ_and_end_with_the_information():
    x, _, settings = problem(100)
    chosen = torch.cat([x, x])[
        informative_points(torch.cat([x, x]), Hyperparameters(**settings), 30)
    ]
    assert len(torch.unique(chosen, dim=0)) == 30
    assert (
        len(informative_points(x[[0, 1, 0, 1, 0]], Hyperparameters(**settings), 5)) == 2
    )
    in_float32 = [value.float() for value in settings.values()]
    points = x[:4].float().repeat(5, 1)
    assert sorted(informative_points(points, in_float32, 20)) == [0, 1, 2, 3]
    random = [
        collapsed_bound(
            x[i : i + 30], x, problem(100)[1], Hyperparameters(**settings)
        ).sum()
        for i in range(0, 70, 10)
    ]
    assert collapsed_bound(
        chosen, x, problem(100)[1], Hyperparameters(**settings)
    ).sum() > max(random)


def transitions(rows, noise=1e-2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = 4 * torch.rand(rows, 2, generator=generator) - 2
    u = 2 * torch.rand(rows, 1, generator=generator) - 1
    next_states = torch.stack(
        [x[:, 0] + 0.2 * x[:, 1], x[:, 1] - torch.sin(2 * x[:, 0]) + u[:, 0]], dim=1
    )
    return Transitions(
        x, u, next_states + noise * torch.randn(rows, 2, generator=generator)
    )


@pytest.mark.parametrize(
    "settings",
    [{}, {"method": "fitc"}, {"predicts": "difference", "scaling": standardize}],
)
def test_training_sums_up_many_transitions_in_a_few_points(settings, caplog):
    data = transitions(600)
    held_out = transitions(200, noise=0.0, seed=1)
    trainer = SparseTrainer(
        inducing=40, subset=50, restarts=0, iterations=15, **settings
    )
    with caplog.at_level(logging.INFO, "gpmpc"):
        training = trainer(data, seed=2)
    gp = training.posterior
    assert len(gp) == 40
    assert (
        training.objective <= training.explored[:, 0] + 1e-9
    ).all() or training.objective.sum() < training.explored[:, 0].sum()
    error = gp.predict(held_out.states, held_out.inputs).mean - held_out.next_states
    assert float(error.square().mean().sqrt()) < 6e-3  # 50 exact points: 3e-2
    assert torch.allclose(gp.noise_variance.sqrt(), torch.full((2,), 1e-2), rtol=0.3)
    assert "40 inducing points chosen among 600" in caplog.text
    assert "iteration 10, minus the bound" in caplog.text


def test_more_rows_than_a_block_are_trained_without_a_warning(monkeypatch, recwarn):
    monkeypatch.setattr("gpmpc.gp._sparse._ENTRIES", 600)  # 64 points at a time
    x, y, _ = problem(rows=150)
    trainer = SparseTrainer(inducing=10, iterations=1, subset=20, restarts=0)
    assert len(trainer.fit(x, y, 1, "value").posterior) == 10
    assert not recwarn.list


def test_targets_below_a_billionth_are_learned_in_their_own_box():
    x, y, _ = problem(rows=80, noise=1e-4)
    trainer = SparseTrainer(
        inducing=30, iterations=10, subset=30, restarts=0, resolution=0.0
    )
    small = trainer.fit(x, 1e-11 * y, 1, "value").posterior
    plain = trainer.fit(x, y, 1, "value").posterior
    ratio = small.signal_variance / plain.signal_variance
    assert torch.allclose(1e22 * ratio, torch.ones(2), rtol=0.5)


def test_fewer_points_than_inducing_points_are_all_taken():
    data = transitions(20)
    assert (
        len(SparseTrainer(inducing=50, iterations=3, restarts=0)(data).posterior) == 20
    )


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"inducing": 0}, "inducing: must be a whole number, 1 or more; got 0"),
        ({"method": "dtc"}, "'sgpr', 'fitc'; got 'dtc'"),
        ({"predicts": "delta"}, "'next_state', 'difference', 'value'; got 'delta'"),
        ({"scaling": "standardize"}, "scaling: must be a function such as standardize"),
        ({"iterations": 1.5}, "iterations: must be a whole number, 0 or more; got 1.5"),
    ],
)
def test_misuse_of_the_trainer_is_refused_with_the_rule(setting, message):
    with pytest.raises(SettingError, match=message):
        SparseTrainer(**setting)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"features": [[0.0] * 3] * 10},
            SettingError,
            "features: must be a torch tensor; got list",
        ),
        (
            {"targets": torch.zeros(9, 2)},
            ShapeError,
            r"targets must have shape \(10, 2\); got \(9, 2\)",
        ),
        (
            {"features": torch.full((10, 3), torch.nan)},
            DataError,
            "features must be finite; got nan",
        ),
        (
            {"noise_variance": torch.zeros(2)},
            SettingError,
            "noise_variance: must be positive",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(change, error, message):
    x, y, settings = problem(10)
    settings = {name: change.pop(name, value) for name, value in settings.items()}
    good = {
        "inducing": x[:4],
        "features": x,
        "targets": y,
        "hyperparameters": Hyperparameters(**settings),
    }
    with pytest.raises(error, match=message):
        sparse_posterior(**(good | {"input_dim": 1, "predicts": "value"} | change))


def sines(rows, d, noise, seed):
    generator = torch.Generator().manual_seed(seed)
    x = 4 * torch.rand(rows, d, generator=generator) - 2
    y = torch.sin(1.5 * x).sum(1, keepdim=True)
    return x, y + noise * torch.randn(rows, 1, generator=generator)


def explained(gp, x, y):
    return 1 - float(
        (gp.predict(x).mean - y).square().sum() / (y - y.mean(0)).square().sum()
    )


@pytest.mark.parametrize(
    ("d", "rows", "noise", "least"),
    [
        (8, 2000, 0.1, 0.7),
        (4, 1000, 0.01, 0.98),
        (4, 500, 0.5, 0.8),
        (2, 500, 1e-3, 0.999),
    ],
)
def test_by_default_more_is_learned_than_noise(d, rows, noise, least):
    x, y = sines(rows, d, noise, seed=0)
    assert (
        explained(SparseTrainer(inducing=50).fit(x, y, 0, "value").posterior, x, y)
        > least
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("noise", [0.01, 0.1])
@pytest.mark.parametrize("d", [4, 8, 12])
def test_by_default_more_is_learned_than_noise_whatever_the_seed(d, noise, seed):
    x, y = sines(2000, d, noise, seed)
    assert (
        explained(
            SparseTrainer(inducing=50).fit(x, y, 0, "value", seed).posterior, x, y
        )
        > 0.6
    )


@pytest.mark.parametrize("settings", [{}, {"method": "fitc"}, {"scaling": standardize}])
def test_no_iterations_leave_everything_where_it_began(settings):
    x, y = sines(300, 3, 0.1, seed=1)
    training = SparseTrainer(inducing=20, iterations=0, **settings).fit(
        x, y, 0, "value"
    )
    assert np.array_equal(training.objective, training.explored[:, 0])
    away = (training.posterior.features[:, None] - x).abs().sum(-1)
    assert float(away.min(dim=1).values.max()) < 1e-12


def test_the_best_point_of_a_search_is_kept(monkeypatch):
    def astray(objective, start, bounds, **_):
        values = [
            objective(np.clip(start + step, *bounds.T))[0] for step in (0.0, 1e-3, 3.0)
        ]
        assert values[-1] > values[0]

    monkeypatch.setattr("gpmpc.gp._sparse_training.minimize", astray)
    training = SparseTrainer(inducing=20).fit(*sines(300, 3, 0.1, seed=1), 0, "value")
    assert (training.objective <= training.explored[:, 0]).all()


def test_points_that_miss_all_there_is_to_learn_are_refused():
    x, _ = sines(500, 2, 0.0, seed=0)
    y = torch.sin(2 * x).prod(1, keepdim=True)
    with pytest.raises(
        TrainingError,
        match="1 inducing points learned nothing but noise of output 2, where exact",
    ) as e:
        SparseTrainer(inducing=1).fit(x, torch.cat([x[:, :1], y], dim=1), 0, "value")
    assert e.value.outputs == [1]


def test_where_there_is_nothing_but_noise_the_log_says_so(caplog):
    x, _ = sines(300, 2, 0.0, seed=0)
    with caplog.at_level(logging.WARNING, "gpmpc"):
        gp = (
            SparseTrainer(inducing=20)
            .fit(x, 3 + torch.randn(300, 2), 0, "value")
            .posterior
        )
    assert "nothing but noise was found in output" in caplog.text
    assert torch.allclose(gp.noise_variance, torch.ones(2), atol=0.2)


def test_an_output_at_rest_is_learned_and_assumptions_are_said(caplog):
    x, y = sines(300, 2, 0.1, seed=0)
    with caplog.at_level(logging.WARNING, "gpmpc"):
        gp = (
            SparseTrainer(inducing=20)
            .fit(x, torch.cat([y, torch.full_like(y, 7.0)], dim=1), 0, "value")
            .posterior
        )
    assert torch.allclose(gp.predict(x).mean[:, 1], torch.tensor(7.0), atol=1e-6)
    assert len(caplog.records) == 1
    assert "output 2 (7). How much it varies elsewhere is not known" in caplog.text
