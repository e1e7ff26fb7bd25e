"""What the data do not tell must not be known: columns at rest, single rows, copies.

The plant is nonlinear in everything, also in what the data hold still, so that a model
that is sure of itself away from its data is wrong by many of its standard deviations.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import (
    SoftLimits,
    SparseTrainer,
    Trainer,
    Transitions,
    append_transitions,
    identity,
    min_max,
    standardize,
    train,
)
from gpmpc.learning import (
    ChangedModel,
    LearningState,
    OnlineLearning,
    learn_from_step,
)
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc import GPMPC, Box, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.signals import Signals

REST = 0.5  # of the input that never moves


def plant(x, u):
    """Two states, two inputs, one step of 0.1 s."""
    rate = x[:, 1] - 0.1 * np.sin(x[:, 0]) + 0.2 * u[:, 0] + 0.15 * np.sin(3 * u[:, 1])
    return np.column_stack([x[:, 0] + 0.1 * x[:, 1], rate])


def hover(rows=60, rest=REST, noise=1e-3, round_off=0.0, seed=0):
    """Data in which the second input never moves, but for round-off."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, (rows, 2))
    still = rest + round_off * rng.uniform(-1, 1, rows)
    u = np.column_stack([rng.uniform(-1, 1, rows), still])
    return Transitions(x, u, plant(x, u) + noise * rng.normal(size=x.shape))


def deviations(gp, x, u):
    """Standard deviations over those of the prior (k,)."""
    belief = gp.predict(torch.tensor(x), torch.tensor(u))
    return (belief.variance / gp.signal_variance).sqrt()


TRAINERS = {
    "exact": Trainer(restarts=0),
    "standardized": Trainer(restarts=0, scaling=standardize),
    "on an interval": Trainer(restarts=0, scaling=min_max),
    "as the paper": Trainer(restarts=0, scaling=identity, penalty=SoftLimits()),
    "of differences": Trainer(restarts=0, predicts="difference"),
    "a subset first": Trainer(restarts=0, subset=30),
    "sgpr": SparseTrainer(inducing=30, restarts=0, iterations=15),
    "fitc": SparseTrainer(inducing=30, restarts=0, iterations=15, method="fitc"),
    "sparse of a subset": SparseTrainer(
        inducing=30, restarts=0, iterations=15, subset=20, scaling=standardize
    ),
}


@pytest.mark.parametrize(
    ("name", "round_off"),
    [
        *((name, 1e-12) for name in TRAINERS),
        *((name, 0.0) for name in ("exact", "standardized", "sgpr")),
    ],
)
def test_nothing_is_known_away_from_an_input_at_rest(name, round_off, caplog):
    gp = TRAINERS[name](hover(round_off=round_off)).posterior
    assert (deviations(gp, [0.3, 0.2], [0.1, REST]) < 0.05).all()
    assert (deviations(gp, [0.3, 0.2], [0.1, REST + 1.0]) > 0.5).all()
    assert (deviations(gp, [0.3, 0.2], [0.1, REST - 4.0]) > 0.99).all()
    warnings = [record for record in caplog.records if "never moves" in record.message]
    assert len(warnings) == 1
    assert "input 2 (0.5)" in warnings[0].message
    assert "input 1" not in warnings[0].message
    assert "state" not in warnings[0].message


def test_a_model_of_hover_data_is_not_wrong_by_more_than_it_says():
    rng = np.random.default_rng(1)
    gp = train(hover(), restarts=0).posterior
    x = rng.uniform(-1.5, 1.5, (200, 2))
    u = rng.uniform(-1, 1, (200, 2))
    belief = gp.predict(torch.tensor(x), torch.tensor(u))
    error = torch.tensor(plant(x, u)) - belief.mean
    inside = error.abs() < 2 * (belief.variance + gp.noise_variance).sqrt()
    assert inside.double().mean() > 0.9


@pytest.mark.parametrize("value", [0.0, 2.0, -7.5, 293.15, 1e5])
def test_a_state_at_any_set_point_is_unknown_elsewhere(value, caplog):
    data = hover()
    states = data.states.clone()
    next_states = data.next_states.clone()
    states[:, 0] = next_states[:, 0] = value
    gp = train(Transitions(states, data.inputs, next_states), restarts=0).posterior
    assert (deviations(gp, [value, 0.1], [0.1, REST]) < 0.1).all()
    assert (deviations(gp, [value + 2.0, 0.1], [0.1, REST]) > 0.8).all()
    assert f"state 1 ({value:.6g}), input 2 (0.5)." in caplog.records[0].message
    assert f"state 1 ({value:.6g})." in caplog.records[1].message
    assert len(caplog.records) == 2


def at_rest(columns, caplog):
    """Which of three inputs never move, as a training says."""
    x = np.linspace(-2, 2, len(columns))[:, None]
    caplog.clear()
    Trainer(restarts=0)(Transitions(x, columns, np.sin(x)))
    return [f"input {i}" for i in (1, 2, 3) if f"input {i} (" in caplog.text]


@pytest.mark.parametrize("value", [1e-3, 7.3, 1e5])
def test_round_off_does_not_move_a_column(value, rng, caplog):
    every = ["input 1", "input 2", "input 3"]
    relative = value * (1 + 1e-13 * rng.normal(size=(50, 3)))
    assert at_rest(relative, caplog) == every
    assert at_rest(value + 1e-12 * rng.normal(size=(50, 3)), caplog) == every


@pytest.mark.parametrize(("spread", "offset"), [(1.0, 1e9), (1e-3, 1e9), (1.0, 1e12)])
def test_a_column_moves_by_its_resolution_not_its_magnitude(
    spread, offset, rng, caplog
):
    columns = offset + spread * (rng.uniform(size=(30, 3)) - 0.5)
    assert at_rest(columns, caplog) == []
    assert "never move" not in caplog.text


@pytest.mark.parametrize(
    "trainer",
    [
        Trainer(restarts=0),
        Trainer(restarts=0, scaling=standardize),
        SparseTrainer(inducing=30, restarts=0, iterations=20),
    ],
    ids=["exact", "standardized", "sparse"],
)
def test_a_feature_of_spread_one_around_a_billion_is_learned(trainer, caplog, rng):
    x = torch.from_numpy(1e9 + rng.uniform(-0.5, 0.5, (60, 1)))
    value = torch.sin(3 * (x - 1e9))
    gp = trainer.fit(x, value, 0, "value").posterior
    held_out = torch.from_numpy(1e9 + rng.uniform(-0.45, 0.45, (40, 1)))
    error = gp.predict(held_out).mean - torch.sin(3 * (held_out - 1e9))
    assert error.abs().max() < 1e-3
    assert not caplog.records


ONE_ROW = {
    "exact": Trainer(),
    "standardized": Trainer(scaling=standardize),
    "sparse": SparseTrainer(inducing=5),
}


@pytest.mark.parametrize("name", ONE_ROW)
def test_one_row_knows_little_beside_itself_and_says_so_once(name, caplog):
    data = hover(rows=1)
    gp = ONE_ROW[name](data).posterior
    at = data.states[0].tolist()
    control = data.inputs[0].tolist()
    assert (
        gp.predict(data.states, data.inputs).mean - data.next_states
    ).abs().max() < 0.1
    assert (deviations(gp, at, control) < 0.2).all()
    assert (deviations(gp, [at[0] + 1.0, at[1]], control) > 0.5).all()
    assert torch.allclose(
        gp.predict(data.states + 50.0, data.inputs).variance, torch.ones(1, 2)
    )
    assert len(caplog.records) == 1
    assert "one row says nothing of how anything varies" in caplog.text


@pytest.mark.parametrize(
    ("name", "value"),
    [*((name, 7.0) for name in TRAINERS), ("exact", 0.0), ("sgpr", 1e6)],
)
def test_an_output_at_rest_is_known_among_the_data_alone(name, value, caplog):
    data = hover()
    trainer = TRAINERS[name]
    constant = torch.full_like(data.states, value)
    if trainer.predicts == "difference":
        constant = data.states + value
    gp = trainer(Transitions(data.states, data.inputs, constant)).posterior
    near = gp.predict(torch.zeros(2), torch.tensor([0.0, REST]))
    assert torch.allclose(near.mean, torch.tensor(value), atol=1e-2)
    assert (deviations(gp, [0.0, 0.0], [0.0, REST]) < 0.03).all()
    assert (deviations(gp, [50.0, 0.0], [0.0, REST]) > 0.99).all()
    assert (gp.signal_variance >= 0.999).all()
    warnings = [
        record for record in caplog.records if "never changes" in record.message
    ]
    assert len(warnings) == 1
    assert f"state 1 ({value:.6g}), state 2 ({value:.6g})" in warnings[0].message


def test_round_off_of_differences_is_relative_to_the_states(rng, caplog):
    x = 1e4 + rng.uniform(-1, 1, (40, 1))
    after = x * (1 + 4e-16 * rng.integers(-1, 2, (40, 1)))
    after[0] = x[0] * (1 + 4e-16)
    difference = train(
        Transitions(x, np.empty((40, 0)), after), predicts="difference", resolution=0.0
    )
    assert float(difference.posterior.signal_variance) == pytest.approx(1.0)
    caplog.clear()
    residual = ResidualModel.train(
        Affine.identity(1, 0),
        Transitions(x, np.empty((40, 0)), after),
        trainer=Trainer(resolution=0.0),
    )
    assert "what is missed of state 1" in caplog.text
    assert float(residual.residual.signal_variance) == pytest.approx(1.0)


def test_residuals_at_rest_may_be_a_whole_step_elsewhere(caplog):
    data = hover(noise=0.0)
    A = torch.tensor([[1.0, 0.1], [0.0, 1.0]])
    nominal = Affine(A, torch.zeros(2, 2), torch.zeros(2))
    model = ResidualModel.train(nominal, data, trainer=Trainer(restarts=0))
    step = (data.next_states - data.states)[:, 0].std(correction=0)
    assert model.residual.signal_variance[0].sqrt() == pytest.approx(step)
    assert "targets of the 60 rows: what is missed of state 1 (0)" in caplog.text
    assert "rows: input 2 (0.5)." in caplog.text


def test_a_sensor_that_flips_makes_no_step_of_a_residual_larger():
    A = torch.tensor([[1.0, 0.1], [0.0, 1.0]])
    x = torch.stack([torch.linspace(2.9, 3.4, 40), torch.linspace(0, 1, 40) ** 2], 1)
    variances = []
    for show in (
        lambda angle: angle,
        lambda angle: torch.atan2(angle.sin(), angle.cos()),
    ):
        rows = [torch.stack([show(a[:, 0]), a[:, 1]], dim=1) for a in (x, x @ A.mT)]
        data = Transitions(rows[0], np.empty((40, 0)), rows[1])
        nominal = Affine(A, torch.zeros(2, 0), torch.zeros(2))
        trainer = Trainer(restarts=0, resolution=1e-6)
        model = ResidualModel.train(nominal, data, angles=[0], trainer=trainer)
        variances.append(model.residual.signal_variance)
    assert torch.allclose(variances[1], variances[0])


def test_a_refit_calls_columns_by_the_names_of_the_posterior(caplog):
    signals = Signals(["angle", "rate"], ["torque", "wind"])
    first = train(replace(hover(), signals=signals), restarts=0).posterior
    caplog.clear()
    Trainer(restarts=0).refit(first)
    assert "rows: wind (0.5)." in caplog.text


def test_round_off_is_no_change_to_a_refit_either(rng):
    """Differences of states around 1e6 move by their round-off."""
    x = np.column_stack([1e6 + rng.uniform(-1, 1, 60), rng.uniform(-1, 1, 60)])
    after = x + np.column_stack([1e-8 * rng.uniform(-1, 1, 60), np.sin(x[:, 1])])
    after[40:, 0] += np.sin(x[40:, 1])
    data = Transitions(x, np.empty((60, 0)), after)
    trainer = Trainer(restarts=0, predicts="difference")
    still = trainer(data[:40]).posterior
    assert float(still.signal_variance[0]) == pytest.approx(1.0)
    refit = trainer.refit(still, data[40:])
    assert refit.explored[0] == trainer(data).explored[0]  # from the plain start


def test_angles_at_rest_are_named_as_what_is_seen_of_them(caplog):
    data = hover()
    states = data.states.clone()
    states[:, 0] = 1.0
    still = Transitions(states, data.inputs, data.next_states)
    identity_model = Affine.identity(2, 2)
    ResidualModel.train(
        identity_model, still, angles=[0], inputs=[1], trainer=Trainer(restarts=0)
    )
    assert (
        "sine of state 1 (0.841471), cosine of state 1 (0.540302), input 2 (0.5)"
        in caplog.text
    )


def test_columns_with_names_are_called_by_them(caplog):
    data = replace(hover(), signals=Signals(["angle", "rate"], ["torque", "wind"]))
    train(data, restarts=0)
    assert "rows: wind (0.5)." in caplog.text


def test_of_many_columns_at_rest_few_are_named_others_counted(caplog, rng):
    x = np.column_stack([rng.uniform(size=20), np.zeros((20, 9))])
    Trainer(restarts=0).fit(torch.from_numpy(x), torch.rand(20, 1), 2, "value")
    assert "state 7 (0) and 3 more." in caplog.text


def test_one_who_knows_says_so_and_is_told_nothing(caplog):
    settings = {"prior_lengthscale": [1.0, 1.0, 1.0, "no_effect"], "restarts": 0}
    gp = train(hover(), **settings).posterior
    assert (deviations(gp, [0.3, 0.2], [0.1, 5.0]) < 0.05).all()
    assert not caplog.records
    longer = train(hover(), prior_lengthscale=10.0, restarts=0).posterior
    assert torch.allclose(longer.lengthscales[:, 3], torch.tensor(10.0))
    constant = torch.full((60, 2), 7.0)
    still = Transitions(hover().states, hover().inputs, constant)
    smaller = train(still, prior_deviation=0.01, restarts=0).posterior
    assert torch.allclose(smaller.signal_variance.sqrt(), torch.tensor(0.01))
    caplog.clear()
    without_prior = train(
        still, prior_deviation=None, prior_lengthscale="no_effect", restarts=0
    ).posterior
    assert (without_prior.signal_variance.sqrt() < 1e-3).all()
    assert not caplog.records


@pytest.mark.parametrize("make", [Trainer, SparseTrainer])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"prior_lengthscale": 0.0},
            "prior_lengthscale: must be numbers above 0, or 'no_effect'",
        ),
        (
            {"prior_lengthscale": "long"},
            "prior_lengthscale: .* got 'long'",
        ),
        (
            {"prior_lengthscale": [1.0, -1.0]},
            "prior_lengthscale: must be numbers .* got -1.0",
        ),
        (
            {"prior_lengthscale": math.nan},
            "prior_lengthscale: must be numbers above 0, or 'no_effect'",
        ),
        (
            {"prior_lengthscale": np.array([1.0, 2.0])},
            r"prior_lengthscale: must be numbers .* got array\(\[1., 2.\]\)",
        ),
        ({"prior_deviation": 0.0}, "prior_deviation: must be a number above 0"),
        ({"prior_deviation": math.inf}, "prior_deviation: must be a number above 0"),
        ({"resolution": -1.0}, "resolution: must be a number, 0 or more; got -1.0"),
    ],
)
def test_scales_that_are_none_are_refused(make, settings, message):
    with pytest.raises(SettingError, match=message):
        make(**settings)


@pytest.mark.parametrize("make", [Trainer, SparseTrainer])
def test_there_are_as_many_prior_lengthscales_as_features(make):
    with pytest.raises(SettingError, match="must be one number, or 4, one a feature"):
        make(prior_lengthscale=[1.0, 2.0])(hover())


def test_what_moves_outside_of_a_sparse_subset_is_learned(caplog):
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (200, 2))
    chosen = np.random.default_rng(0).permutation(200)[
        :40
    ]  # by the seed of the training
    x[:, 1] *= 1e-6
    x[chosen, 1] = 0.0
    second = np.sin(2e6 * x[:, 1])
    values = np.column_stack([np.sin(2 * x[:, 0]) + second, second])
    trainer = SparseTrainer(inducing=40, subset=40, restarts=0, iterations=40)
    features = torch.from_numpy(x)
    targets = torch.from_numpy(values)
    gp = trainer.fit(features, targets, 0, "value", seed=0).posterior
    error = (gp.predict(features).mean - targets).square().mean(0).sqrt()
    assert (error < 0.05).all()
    assert not caplog.records


def test_a_refit_learns_what_moves_by_now():
    first = Trainer(restarts=0)(hover()).posterior
    ignored = Trainer(restarts=0, prior_lengthscale="no_effect")(hover()).posterior
    rng = np.random.default_rng(2)
    x = rng.uniform(-2, 2, (60, 2))
    u = rng.uniform(-1, 1, (60, 2))
    moving = Transitions(x, u, plant(x, u))
    for posterior in (first, ignored):
        gp = Trainer(restarts=0).refit(posterior, moving).posterior
        x = rng.uniform(-1, 1, (100, 2))
        u = rng.uniform(-1, 1, (100, 2))
        error = gp.predict(torch.tensor(x), torch.tensor(u)).mean.numpy() - plant(x, u)
        assert np.sqrt((error**2).mean()) < 0.03


def test_an_output_that_changes_by_now_is_learned_by_a_refit():
    data = hover()
    still = Transitions(data.states, data.inputs, torch.full_like(data.states, 3.0))
    first = Trainer(restarts=0)(still).posterior
    gp = Trainer(restarts=0).refit(first, hover(rows=80, seed=3)).posterior
    assert torch.isfinite(gp.weights).all()
    assert len(gp) == 140


def test_appended_points_are_known_where_the_column_was_at_rest():
    gp = Trainer(restarts=0)(hover()).posterior
    x = np.array([[0.3, 0.2]])
    u = np.array([[0.1, REST + 2.0]])
    assert (deviations(gp, [0.3, 0.2], [0.1, REST + 2.0]) > 0.9).all()
    larger = append_transitions(gp, Transitions(x, u, plant(x, u)))
    assert (deviations(larger, [0.3, 0.2], [0.1, REST + 2.0]) < 0.1).all()
    single = larger.to(dtype=torch.float32)
    x = torch.tensor([0.3, 0.2])
    u = torch.tensor([0.1, REST + 4.0])
    far = single.predict(x.float(), u.float()).variance / single.signal_variance
    assert (far > 0.8).all()


@pytest.mark.parametrize("predicts", ["next_state", "difference"])
def test_what_was_at_rest_is_learned_while_flying(predicts):
    gp = Trainer(restarts=0, predicts=predicts)(hover(rows=80)).posterior
    rng = np.random.default_rng(5)
    learning = OnlineLearning()
    state = np.array([0.5, 0.0])
    alone = []
    changed = []
    learned = LearningState.begin(ChangedModel(gp, learning), state)
    for k in range(120):
        feedback = -0.5 * state[0] - state[1] + 0.2 * rng.normal()
        other = REST if k < 20 else REST + 0.4 * np.sin(0.3 * k)
        control = np.array([feedback, other]).clip(-1, 1)
        first, second = (
            model.linearize(state[None], control[None]) for model in (gp, learned.model)
        )
        after = plant(state[None], control[None])[0] + 1e-3 * rng.normal(size=2)
        alone.append(np.abs(after - first.mean[0]).max())
        changed.append(np.abs(after - second.mean[0]).max())
        learned = learn_from_step(learned, control, after)
        state = after
    assert learned.active
    assert np.mean(changed[80:]) < 0.2 * np.mean(alone[80:])
    here, there = (
        model.linearize(state[None], control[None]).covariance[0].diagonal()
        for model in (learned.model, gp)
    )
    assert (here < 0.1 * there).all()
    point = torch.from_numpy(state)
    u = torch.from_numpy(control)
    assert np.allclose(learned.model.predict(point, u).variance.numpy(), here)


def test_a_plan_that_moves_a_resting_column_is_outside_its_data():
    problem = Problem(
        cost=Tracking(Q=[10, 1], R=[0.1, 0.1], penalized="inputs"),
        inputs=Box([-1, -1], [1, 1]),
    )
    gp = Trainer(restarts=0, predicts="difference")(hover(rows=80)).posterior
    controller = GPMPC(gp, Linearization(), problem, 10, [0.0, REST])
    state = np.array([1.0, 0.0])
    decision = None
    novelties = []
    missed = []
    for _ in range(20):
        belief = Gaussian(torch.tensor(state), 1e-8 * torch.eye(2))
        decision = controller.control(belief, Reference(np.zeros((11, 2))), decision)
        novelties.append(decision.novelty)
        forecast = gp.predict(torch.tensor(state), torch.tensor(decision.inputs[0]))
        state = plant(state[None], decision.inputs[:1])[0]
        deviation = (forecast.variance + gp.noise_variance).sqrt().numpy()
        missed.append(np.abs(state - forecast.mean.numpy()) / deviation)
    assert max(novelties) > 0.3
    assert np.max(missed) < 3.0


# --- transitions that look like a mistake -------------------------------------------


def flight(rows=50, seed=0):
    """A recording: states (rows + 1, 2) and inputs (rows, 2)."""
    rng = np.random.default_rng(seed)
    states = [rng.uniform(-1, 1, 2)]
    inputs = rng.uniform(-1, 1, (rows, 2))
    for control in inputs:
        states.append(plant(states[-1][None], control[None])[0])
    return np.array(states), inputs


WAYS = {
    "exact": lambda data: Trainer(restarts=0)(data),
    "sparse": lambda data: SparseTrainer(inducing=10, iterations=2)(data),
    "residual": lambda data: ResidualModel.train(
        Affine.identity(2, 2), data, trainer=Trainer(restarts=0)
    ),
}


@pytest.mark.parametrize("name", WAYS)
def test_a_forgotten_shift_is_said_once_with_the_rule(name, caplog):
    x, u = flight()
    WAYS[name](Transitions(x[:-1], u, x[:-1]))
    warnings = [r.message for r in caplog.records if "next_states" in r.message]
    assert len(warnings) == 1
    assert "next_states equal states in all 50 rows" in warnings[0]
    assert "states x[:-1], next_states x[1:]" in warnings[0]


@pytest.mark.parametrize("name", WAYS)
def test_copies_of_few_rows_are_said_once_with_the_rule(name, caplog):
    x, u = flight(5)
    copies = [np.tile(part, (20, 1)) for part in (x[:-1], u, x[1:])]
    WAYS[name](Transitions(*copies))
    warnings = [r.message for r in caplog.records if "different" in r.message]
    assert len(warnings) == 1
    assert "only 5 of 100 rows that move are different" in warnings[0]
    assert "give every row once" in warnings[0]


def log_at_rest():
    """Most of a recording whose sensors are quantised stands still."""
    x, u = flight(40)
    x = np.vstack([x, np.tile(x[-1], (100, 1))])
    u = np.vstack([u, np.zeros((100, 2))])
    return Transitions(x[:-1], u, x[1:])


def log_with_a_state_that_stays():
    x, u = flight()
    before = x[:-1].copy()
    after = x[1:].copy()
    before[:, 1] = after[:, 1] = np.repeat([1.0, 2.0], 25)
    return Transitions(before, u, after)


def log_with_some_rows_twice():
    x, u = flight()
    rows = [*range(50), *range(20)]
    return Transitions(x[:-1][rows], u[rows], x[1:][rows])


def log_with_repeated_points_and_noise():
    x, u = flight(5)
    parts = [np.tile(part, (10, 1)) for part in (x[:-1], u, x[1:])]
    noise = 1e-3 * np.random.default_rng(0).normal(size=parts[2].shape)
    return Transitions(parts[0], parts[1], parts[2] + noise)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Transitions(flight()[0][:-1], flight()[1], flight()[0][1:]),
        log_at_rest,
        log_with_a_state_that_stays,
        log_with_some_rows_twice,
        log_with_repeated_points_and_noise,
    ],
    ids=[
        "right",
        "at rest",
        "a state that stays",
        "some rows twice",
        "repeated points",
    ],
)
def test_right_logs_are_learned_without_a_word(make, caplog):
    Trainer(restarts=0)(make())
    assert not caplog.records
