import logging
import re
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime

from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    TrainingError,
    UnsupportedModel,
)
from gpmpc.gp import (
    GPPosterior,
    SoftLimits,
    SparseTrainer,
    Trainer,
    Transitions,
    _search,
    _training,
    identity,
    standardize,
    to_gpytorch,
    train,
)


def pendulum(rows=60, noise=1e-3, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, (rows, 2))
    u = rng.uniform(-1, 1, (rows, 1))
    next_states = np.column_stack(
        [x[:, 0] + 0.1 * x[:, 1], x[:, 1] - np.sin(x[:, 0]) + u[:, 0]]
    )
    return Transitions(
        *(
            torch.from_numpy(a)
            for a in (x, u, next_states + noise * rng.normal(size=next_states.shape))
        )
    )


def test_training_finds_the_noise_and_predicts_held_out_rows():
    data = pendulum(120, noise=1e-2)
    held_out = pendulum(200, noise=0.0, seed=1)
    gp = train(data).posterior
    assert torch.allclose(gp.noise_variance.sqrt(), torch.full((2,), 1e-2), rtol=0.3)
    error = gp.predict(held_out.states, held_out.inputs).mean - held_out.next_states
    assert float(error.abs().max()) < 0.1
    assert float(error.square().mean().sqrt()) < 1e-2


def test_next_states_and_differences_are_learned_equally_well():
    held_out = pendulum(100, noise=0.0, seed=1)
    for predicts in ("next_state", "difference"):
        gp = train(pendulum(), predicts=predicts).posterior
        assert gp.predicts == predicts
        error = gp.predict(held_out.states, held_out.inputs).mean - held_out.next_states
        assert float(error.abs().max()) < 0.02


def test_a_seed_repeats_and_more_starts_are_never_worse():
    first = train(pendulum(), seed=3)
    second = train(pendulum(), seed=3)
    assert np.array_equal(first.theta, second.theta)
    single = train(pendulum(), seed=3, restarts=0)
    assert (first.objective <= single.objective + 1e-6).all()
    assert first.explored.shape == (2, 4)
    assert single.evaluations < first.evaluations


def test_the_gpytorch_model_of_a_training_predicts_the_same():
    training = train(pendulum(30))
    states = torch.rand(4, 2)
    inputs = torch.rand(4, 1)
    with torch.no_grad():
        theirs = to_gpytorch(training.posterior)(
            torch.cat([states, inputs], dim=1).expand(2, -1, -1)
        )
    assert torch.allclose(
        training.posterior.predict(states, inputs).mean, theirs.mean.T, atol=1e-8
    )


def test_the_penalty_limits_signal_to_noise_and_lengthscales():
    data = pendulum(40, noise=0.0)
    free = train(data).theta
    limited = train(data, penalty=SoftLimits(signal_to_noise=50.0)).theta
    assert (free[:, -1] > np.log(200)).all()
    assert (limited[:, -1] < 1.2 * np.log(50)).all()
    near = train(data, penalty=SoftLimits(lengthscale_factor=2.0)).theta
    deviations = data.features.std(dim=0).numpy()
    assert (np.abs(near[:, :-2] - np.log(deviations)) < 1.3 * np.log(2)).all()


def test_the_penalty_is_the_papers_and_its_gradient_is_right():
    theta = np.array([1.0, -2.0, 0.5, 7.0])
    log_spread = np.array([0.3, 0.1])
    value, gradient = SoftLimits()(theta, log_spread)
    expected = (
        sum(((theta[:2] - log_spread) / np.log(100)) ** 30)
        + (theta[3] / np.log(1000)) ** 30
    )
    assert value == pytest.approx(expected)
    assert np.allclose(
        gradient,
        approx_fprime(theta, lambda t: SoftLimits()(t, log_spread)[0], 1e-7),
        rtol=1e-4,
        atol=1e-5,
    )


def test_an_input_that_is_known_to_have_no_effect_has_none():
    data = pendulum(40)
    states = data.states.clone()
    next_states = data.next_states.clone()
    states[:, 1] = 0.5
    next_states[:, 1] = 0.5
    assumed = {"prior_lengthscale": "no_effect", "prior_deviation": None}
    huge = Transitions(states * torch.tensor([1.0, 1e10]), data.inputs, next_states)
    long = train(huge, restarts=0, **assumed).posterior.lengthscales
    assert float(long[0, 1]) > 1e17
    still = Transitions(states, data.inputs, next_states)
    gp = train(still, penalty=SoftLimits(), **assumed).posterior
    near = torch.tensor([[0.3, 0.5]])
    far = torch.tensor([[0.3, 2.0]])
    control = torch.tensor([[0.1]])
    assert torch.allclose(
        gp.predict(near, control).mean, gp.predict(far, control).mean, atol=1e-9
    )
    assert float(gp.predict(far, control).mean[0, 1]) == pytest.approx(0.5, abs=1e-3)


def test_the_prior_mean_is_what_the_scaling_maps_to_zero():
    data = pendulum(12)
    means = data.next_states.mean(0)
    for scaling, mean in (
        (None, means),
        (standardize, means),
        (identity, torch.zeros(2)),
    ):
        gp = train(
            data, restarts=0, **({} if scaling is None else {"scaling": scaling})
        ).posterior
        assert torch.allclose(gp.offset, mean, atol=1e-14)
        far = gp.predict(torch.full((2,), 1e6), torch.full((1,), 1e6)).mean
        assert torch.allclose(far, mean, atol=1e-14)


def test_one_row_can_be_trained_on():
    gp = train(pendulum(1), penalty=SoftLimits()).posterior
    assert torch.isfinite(gp.predict(torch.zeros(2), torch.zeros(1)).mean).all()


def test_when_all_starts_fail_the_output_is_named():
    data = pendulum(10)
    next_states = data.next_states.clone()
    next_states[:, 1] = 1e200 * torch.arange(1, 11)
    with pytest.raises(TrainingError, match="no start of 4 .* for state 2:") as caught:
        train(Transitions(data.states, data.inputs, next_states))
    assert caught.value.outputs == [1]


def test_a_search_begun_on_a_subset_ends_at_the_same_optimum():
    data = pendulum(420, noise=1e-2)
    everywhere = train(data, subset=None)
    first_a_part = train(data, subset=100)
    assert np.allclose(first_a_part.objective, everywhere.objective, rtol=1e-6)
    assert np.allclose(first_a_part.theta, everywhere.theta, atol=0.02)
    assert (
        first_a_part.explored > everywhere.explored + 100
    ).all()  # of fewer points: less evidence


def test_a_start_that_is_known_is_searched_from_over_all_points():
    data = pendulum(120, noise=1e-2)
    trainer = Trainer(restarts=0, subset=40)
    first = trainer(data)
    again = trainer.refit(first.posterior)
    assert again.evaluations < first.evaluations
    assert np.allclose(again.explored[:, 0], first.objective, rtol=1e-6)


def test_an_output_still_in_the_subset_is_learned_in_motion():
    """As at a contact; the optimum of the subset is noise, and the search stayed."""
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (400, 2))
    y = 20 * np.maximum(0.0, x[:, :1] - 0.97) * (1 + x[:, 1:])
    rows = torch.from_numpy(x), torch.from_numpy(y), 1
    everywhere = Trainer(subset=None, predicts="value").fit(*rows)
    first_a_part = Trainer(subset=30, predicts="value").fit(*rows)
    assert first_a_part.objective == pytest.approx(everywhere.objective, rel=1e-3)


def test_a_subset_comes_first_for_many_points_and_new_starts():
    data = pendulum(40, noise=1e-2)
    whole, same, fewer = (
        Trainer(restarts=0, subset=subset)(data) for subset in (None, 40, 39)
    )
    assert np.array_equal(same.theta, whole.theta)
    assert same.evaluations == whole.evaluations
    assert not np.array_equal(fewer.explored, whole.explored)
    start = whole.posterior
    again = {}
    for restarts in (0, 1):
        again[restarts] = [
            Trainer(restarts=restarts, subset=subset)(data, start=start)
            for subset in (None, 20)
        ]
    assert np.array_equal(again[0][0].explored, again[0][1].explored)
    assert not np.array_equal(again[1][0].explored, again[1][1].explored)


def test_too_much_for_the_memory_is_refused_with_a_way_out(monkeypatch):
    monkeypatch.setattr("gpmpc.gp._memory.available_memory", lambda: 2 * 2**20)
    with pytest.raises(DataError) as refused:
        train(pendulum(400))
    assert str(refused.value) == (
        "exact GPs of 400 points and 2 outputs need 0.00477 GiB, 0.00119 GiB a kernel "
        "matrix; 0.00195 GiB are "
        "available: train on 256 points or fewer, or sparse GPs (SparseTrainer)"
    )
    assert len(train(pendulum(250), restarts=0, tolerance=1e-3).posterior) == 250
    monkeypatch.setattr("gpmpc.gp._memory.available_memory", lambda: None)
    assert len(train(pendulum(20), restarts=0).posterior) == 20


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"subset": 0}, "subset: must be a whole number, 1 or more; got 0"),
        ({"restarts": -1}, "restarts: must be a whole number, 0 or more; got -1"),
        ({"predicts": "delta"}, "'next_state', 'difference', 'value'; got 'delta'"),
        (
            {"signal_to_noise_limit": 1.0},
            "signal_to_noise_limit: must be a number above 1; got 1.0",
        ),
        ({"tolerance": 0.0}, "tolerance: must be a number above 0; got 0.0"),
        ({"time_limit": 0.0}, r"time_limit: must be a number above 0 \[s\]; got 0.0"),
    ],
)
def test_misuse_is_refused_with_the_rule(setting, message):
    with pytest.raises(SettingError, match=message):
        train(pendulum(5), **setting)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.5,), "lengthscale_factor: must be a number above 1; got 0.5"),
        ((2.0, 0.5), "signal_to_noise: must be a number above 1; got 0.5"),
        ((2.0, "x"), "signal_to_noise: must be a number above 1; got 'x'"),
        ((2.0, 2.0, 3), "power: must be even; got 3"),
    ],
)
def test_limits_that_are_none_are_refused(arguments, message):
    with pytest.raises(SettingError, match=message):
        SoftLimits(*arguments)


def test_features_and_targets_of_any_kind_are_learned_from():
    x = torch.linspace(-2, 2, 30)[:, None]
    for trainer in (
        Trainer(predicts="value", restarts=0),
        SparseTrainer(predicts="value", inducing=20, restarts=0),
    ):
        gp = trainer.fit(x, torch.sin(x), 0).posterior
        assert gp.predicts == "value"
        assert torch.allclose(gp.predict(x).mean, torch.sin(x), atol=1e-2)
        with pytest.raises(
            UnsupportedModel,
            match="transitions hold no targets of GPs with predicts='value'",
        ):
            trainer(pendulum(5))


def two_columns(rows=6):
    return torch.rand(rows, 2), torch.rand(rows, 1)


TABLES = [
    (
        {"features": [[1.0, 2.0]]},
        SettingError,
        "features: must be a torch tensor; got list",
    ),
    (
        {"features": np.ones((6, 2))},
        SettingError,
        "features: must be a torch tensor; got ndarray",
    ),
    (
        {"targets": np.ones((6, 1))},
        SettingError,
        "targets: must be a torch tensor; got ndarray",
    ),
    (
        {"targets": torch.ones(5, 1)},
        ShapeError,
        r"targets must have shape \(6, 1\); got \(5, 1\)",
    ),
    ({"targets": torch.ones(6)}, ShapeError, "need two dimensions, a column and a row"),
    (
        {"targets": torch.ones(6, 0)},
        ShapeError,
        "need two dimensions, a column and a row",
    ),
    (
        {"features": torch.ones(0, 2), "targets": torch.ones(0, 1)},
        ShapeError,
        "a row; got",
    ),
    (
        {"features": torch.full((6, 2), torch.nan)},
        DataError,
        "features must be finite; got nan",
    ),
    (
        {"targets": torch.full((6, 1), torch.inf)},
        DataError,
        "targets must be finite; got inf",
    ),
    ({"features": torch.ones(6, 2).float()}, SettingError, "features: must be float64"),
    (
        {"targets": torch.ones(6, 1, dtype=torch.int64)},
        SettingError,
        "targets: must be float64",
    ),
    (
        {"features": torch.ones(6, 2, device="meta")},
        SettingError,
        "features: must be in host memory for training",
    ),
    ({"input_dim": 2}, ShapeError, "2 controls"),
    ({"input_dim": -1}, SettingError, "input_dim: must be a whole number"),
    ({"input_dim": 1.0}, SettingError, "input_dim: must be a whole number"),
    ({"predicts": "delta"}, SettingError, "predicts: must be one of"),
    ({"predicts": "next_state", "input_dim": 0}, ShapeError, "one state an output"),
]


@pytest.mark.parametrize(
    ("change", "error", "message"), TABLES, ids=lambda value: str(value)[:40]
)
@pytest.mark.parametrize(
    "trainer", [Trainer(), SparseTrainer()], ids=["exact", "sparse"]
)
def test_tables_that_teach_nothing_are_refused_with_the_rule(
    trainer, change, error, message
):
    features, targets = two_columns()
    good = {
        "features": features,
        "targets": targets,
        "input_dim": 1,
        "predicts": "next_state",
    }
    with pytest.raises(error, match=message):
        trainer.fit(**good | change)


def test_tables_of_a_graph_are_learned_apart_from_it():
    features, targets = two_columns()
    gp = (
        Trainer(restarts=0)
        .fit(features.requires_grad_(), targets, 1, "value")
        .posterior
    )
    assert not gp.weights.requires_grad


def test_refits_and_starts_need_a_posterior_that_fits():
    trainer = Trainer(restarts=0)
    gp = train(pendulum(8), restarts=0).posterior
    other = Transitions(torch.zeros(3, 3), torch.zeros(3, 1), torch.zeros(3, 3))
    with pytest.raises(
        ShapeError,
        match="the model has 2 states and 1 inputs; got transitions with 3 and 1",
    ):
        trainer.refit(gp, other)
    with pytest.raises(
        SettingError, match=r"transitions: must be Transitions\(...\); got Tensor"
    ):
        trainer.refit(gp, other.states)
    with pytest.raises(
        UnsupportedModel, match="posterior must be a GPPosterior; got str"
    ):
        trainer.refit("gp.npz")
    with pytest.raises(
        UnsupportedModel, match="start must be a GPPosterior; got Training"
    ):
        trainer(pendulum(8), start=train(pendulum(8), restarts=0))
    with pytest.raises(
        ShapeError,
        match="the posterior to start from must have 4 features and 3 outputs; "
        "got 3 and 2",
    ):
        trainer(other, start=gp)
    values = GPPosterior(**vars(gp) | {"predicts": "value"})
    with pytest.raises(UnsupportedModel, match="transitions hold no targets"):
        trainer.refit(values, pendulum(8))
    assert trainer.refit(values).posterior.predicts == "value"
    with pytest.raises(
        SettingError, match=r"transitions: must be Transitions\(...\); got int"
    ):
        SparseTrainer()(1)


def test_what_takes_long_tells_where_it_is(caplog, monkeypatch):
    data = pendulum(12)
    train(data, restarts=0)
    assert not caplog.records
    monkeypatch.setattr(_search, "_LOG_INTERVAL", 0.0)
    with caplog.at_level(logging.INFO, "gpmpc"):
        training = train(data, restarts=0)
    text = (
        r"training: state (\d) \(\1 of 2\), 12 points: evaluation (\d+), "
        r"minus log evidence .*"
    )
    progress = [re.fullmatch(text, record.message) for record in caplog.records]
    assert [one[1] for one in progress] == sorted(one[1] for one in progress)
    assert len(progress) == training.evaluations


def test_a_time_limit_ends_each_search_with_the_best_so_far(caplog, monkeypatch):
    data = pendulum(40)
    ticks = count()
    converged = train(data)
    clock = SimpleNamespace(perf_counter=lambda: float(next(ticks)))  # a second a look
    for module in (_search, _training):
        monkeypatch.setattr(module, "time", clock)
    with caplog.at_level(logging.INFO, "gpmpc"):
        stopped = train(data, time_limit=40.0)
    assert [r.message for r in caplog.records if "over" in r.message] == [
        "training: state 1 (1 of 2): its share of time_limit=40 s is over",
        "training: state 2 (2 of 2): its share of time_limit=40 s is over",
    ]
    assert 10 < stopped.evaluations < 0.3 * converged.evaluations
    assert (stopped.objective > converged.objective).all()
    assert (stopped.objective <= stopped.explored[:, 0]).all()
    assert np.isnan(stopped.explored[:, 1:]).all()
    ample = train(data, time_limit=1e6)
    assert np.array_equal(ample.theta, converged.theta)


@pytest.mark.parametrize(
    ("failing", "late_after", "explored"), [(0, 0, 2), (1, 0, 1), (1, 2, 2)]
)
def test_a_time_limit_waits_for_one_start_that_succeeds(
    monkeypatch, failing, late_after, explored
):
    starts = count()
    search = _search.OutputSearch._minimize

    def one_fails(self, start, iterations):
        number = next(starts)
        monkeypatch.setattr(
            self.__class__, "_is_late", lambda _: number + 1 >= late_after
        )
        return (
            _search.Optimum(start, 2 * _search.FAILED)
            if number == failing
            else search(self, start, iterations)
        )

    monkeypatch.setattr(_search.OutputSearch, "_minimize", one_fails)
    training = train(pendulum(20), time_limit=60.0)
    assert np.isfinite(training.explored[0]).tolist() == [True] * explored + [False] * (
        4 - explored
    )
    assert (training.explored[0] >= _search.FAILED).tolist() == [
        k == failing and k < explored for k in range(4)
    ]


def test_a_time_limit_leaves_one_start_and_one_iteration(monkeypatch):
    data = pendulum(60, noise=1e-2)
    search = _search.OutputSearch._minimize
    sizes = []
    converged = train(data, subset=20)
    monkeypatch.setattr(
        _search.OutputSearch,
        "_minimize",
        lambda self, *arguments: sizes.append(self._size) or search(self, *arguments),
    )
    training = train(data, subset=20, time_limit=1e-9)
    assert sizes == [20, 60, 20, 60]
    assert (training.objective > converged.objective).all()
    assert len(training.posterior) == 60


def test_a_penalty_that_is_no_number_is_no_success():
    def nowhere(theta, log_std):
        return np.nan, np.zeros_like(theta)

    def without_slope(theta, log_std):
        return 0.0, np.full_like(theta, np.nan)

    for penalty in (nowhere, without_slope):
        with pytest.raises(TrainingError, match="no start of 2 .* finite penalty for"):
            train(pendulum(8), penalty=penalty, restarts=1)


def test_a_start_behind_an_infinite_wall_has_failed(recwarn):
    wall = SoftLimits(lengthscale_factor=1.01, power=200)
    training = train(pendulum(8), penalty=wall, restarts=1)
    assert (training.objective < 100.0).all()
    assert (training.explored[:, 1] == _search.FAILED).all()
    assert not recwarn.list
