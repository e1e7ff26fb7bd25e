"""Features of a GP: columns, sines and cosines, lags; effects of the state."""

import dataclasses
import functools

import casadi
import numpy as np
import pytest
import torch

from gpmpc import systems
from gpmpc.exceptions import DataError, SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, Trainer, Transitions
from gpmpc.gp.casadi_ import casadi_function, successor_function
from gpmpc.models import (
    Affine,
    CasadiFunction,
    Features,
    Lags,
    ResidualModel,
    linearize,
    load_model,
    save_model,
)
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Unscented,
    differentiate,
)
from gpmpc.testing import check_model

STEP = 0.1
F = torch.float64


def draw(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F)


def pendulum(x, u, damping=0.2):
    """Angle and rate [rad, rad/s] after a step, with a torque on it."""
    turn = x[..., 1] + STEP * (
        -9.81 * x[..., 0].sin() - damping * x[..., 1] + u[..., 0]
    )
    return torch.stack([x[..., 0] + STEP * turn, turn], dim=-1)


@dataclasses.dataclass
class Damped:
    damping: float

    def __call__(self, x, u):
        return pendulum(x, u, self.damping)


def pendulum_in_casadi(damping=0.2):
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u", 1)
    turn = x[1] + STEP * (-9.81 * casadi.sin(x[0]) - damping * x[1] + u)
    return casadi.Function(
        "pendulum", [x, u], [casadi.vertcat(x[0] + STEP * turn, turn)]
    )


def rotation(x):
    """A force in a frame that turns with the angle (*batch, 2, 1)."""
    return torch.stack([x[..., 0].sin(), 1 + 0.5 * x[..., 0].cos()], dim=-1)[..., None]


def rotation_in_casadi():
    x = casadi.SX.sym("x", 2)
    return casadi.Function(
        "rotation", [x], [casadi.vertcat(casadi.sin(x[0]), 1 + 0.5 * casadi.cos(x[0]))]
    )


def every_operation():
    """An effect that no path leads to, of each operation that a compiled loop knows."""
    x = casadi.SX.sym("x", 2)
    c = casadi
    a = 1 + x[0] ** 2
    b = x[1]
    first = (
        c.sqrt(a)
        + c.log(a) * c.tan(b / 9)
        - c.atan2(b, a)
        + a**0.3
        + a**b
        + c.fmin(a, b) * c.fmax(a, 1.5)
    )
    second = (
        c.exp(-c.fabs(b))
        + c.tanh(b) / a
        + c.atan(b)
        + 1 / a
        + 2 * b
        - c.sin(a) * c.cos(b)
    )
    return c.Function("all", [x], [c.vertcat(first, second)])


def gp(n, m, k, size=25):
    ones = torch.ones(k, dtype=F)
    scales = 1 + draw(3, k, n + m).abs()
    return GPPosterior.from_hyperparameters(
        draw(1, size, n + m), draw(2, size, k), scales, ones, 0.01 * ones, m, "value"
    )


def with_angles(n=4, B=None):
    B = torch.eye(n, dtype=F) if B is None else B
    return ResidualModel(
        Affine.identity(n, 2), gp(5, 1, B.shape[1]), B, [3, 1, 0], [1], 2, angles=[0, 3]
    )


def with_effect(nominal=pendulum, effect=rotation):
    return ResidualModel(
        nominal,
        gp(3, 0, 1),
        effect,
        [0, 1],
        [],
        1,
        [0],
        noise=0.01 * torch.eye(2, dtype=F),
    )


MODELS = {
    "angles": with_angles,
    "fewer outputs": lambda: with_angles(B=draw(5, 4, 2)),
    "effect in torch": with_effect,
    "all in CasADi": lambda: with_effect(
        CasadiFunction(pendulum_in_casadi()), CasadiFunction(rotation_in_casadi())
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_model_with_features_is_a_model(name):
    check_model(MODELS[name]())


def test_torch_and_casadi_give_the_same_expansion():
    x = draw(8, 6, 2).numpy()
    u = draw(9, 6, 1).numpy()
    for ours, theirs in zip(
        MODELS["effect in torch"]().linearize(x, u),
        MODELS["all in CasADi"]().linearize(x, u),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_turns_and_left_out_columns_change_nothing():
    model = with_angles()
    x = draw(8, 5, 4)
    u = draw(9, 5, 2)
    prediction = model.predict(x, u)
    turn = x + torch.tensor(
        [2 * torch.pi, 0, 7.0, -4 * torch.pi]
    )  # state 2 is not seen
    after = model.predict(turn, u)
    assert torch.allclose(after.mean - turn, prediction.mean - x, atol=1e-12)
    assert torch.allclose(after.covariance, prediction.covariance, atol=1e-12)


def test_angles_of_an_array_and_whole_numbers_are_what_they_say():
    listed = Features([0, 1], [0], [0], state_dim=2, input_dim=1)
    counted = Features([0, 1], [0], np.array([0]), state_dim=2, input_dim=1)
    states = np.array([[2, 3], [0, 1]])
    inputs = np.zeros((2, 1))
    for features in (listed, counted):
        values, _, slopes = features.linearize(states, inputs)
        np.testing.assert_allclose(values[0], [np.sin(2), np.cos(2), 3])
        np.testing.assert_allclose(slopes[0], [np.cos(2), -np.sin(2), 1])


@pytest.mark.parametrize(
    "propagator", [Linearization(), Unscented()], ids=lambda p: type(p).__name__
)
@pytest.mark.parametrize("name", ["angles", "effect in torch"])
def test_a_belief_moves_through_features_as_sampling_says(name, propagator):
    model = MODELS[name]()
    n = model.state_dim
    m = model.input_dim
    belief = Gaussian(0.3 * draw(1, n), 0.0003 * torch.eye(n, dtype=F))
    sampled = MonteCarlo(50_000)(model, belief, draw(2, m))
    next_belief = propagator(model, belief, draw(2, m))
    assert torch.allclose(next_belief.mean, sampled.mean, atol=5e-3)
    assert torch.allclose(next_belief.covariance, sampled.covariance, atol=3e-4)
    with pytest.raises(UnsupportedModel, match="Possible with any model"):
        MomentMatching()(model, belief, draw(2, m))


def observed(rows=60, seed=0):
    x = draw(seed, rows, 2) * torch.tensor([3.0, 2.0])
    u = draw(seed + 1, rows, 1)
    return Transitions(x, u, pendulum(x, u))


def test_sine_and_cosine_predict_a_pendulum_at_unseen_angles():
    seen = observed()
    model = ResidualModel.train(
        Affine.identity(2, 1), seen, angles=[0], trainer=Trainer(restarts=0)
    )
    x = observed(40, seed=5).states
    u = observed(40, seed=5).inputs
    far = x + torch.tensor([6 * torch.pi, 0.0])
    error = (model.predict(far, u).mean - pendulum(far, u)).abs().max()
    assert float(error) < 0.02
    grown = model.append(observed(10, seed=7))
    assert len(grown.residual) == 70
    check_model(model, x, u)


def test_an_effect_that_depends_on_the_state_is_learned():
    x = draw(0, 60, 2)
    u = draw(1, 60, 1)
    force = (0.5 * x[:, 1].sin())[:, None, None]
    noise = 1e-3 * draw(3, 60, 2)
    seen = Transitions(x, u, pendulum(x, u) + (rotation(x) * force)[..., 0] + noise)
    model = ResidualModel.train(
        pendulum, seen, rotation, [1], [], trainer=Trainer(restarts=0)
    )
    speed = torch.linspace(-1.5, 1.5, 20)[:, None]
    assert torch.allclose(
        model.residual.predict(speed).mean[:, 0], 0.5 * speed[:, 0].sin(), atol=3e-3
    )
    assert (
        1e-8
        < float(model.noise_covariance.diagonal().min())
        < float(model.noise_covariance.diagonal().max())
        < 1e-5
    )


def test_lags_shift_and_reveal_an_unmeasured_velocity():
    lags = Lags(1, 1, states=1, inputs=2)
    angles = np.arange(6.0)[:, None]
    inputs = 10 + np.arange(5.0)[:, None]
    data = lags.transitions(angles, inputs)
    assert data.states.tolist() == [[2, 1, 11, 10], [3, 2, 12, 11], [4, 3, 13, 12]]
    assert data.inputs.tolist() == [[12], [13], [14]]
    shifted = lags.nominal(
        data.states, data.inputs
    )  # the learned part moves the first entry only
    assert shifted[:, 1:].tolist() == data.next_states[:, 1:].tolist()
    x = [torch.tensor([0.5, 0.0], dtype=F)]
    u = draw(4, 150, 1)
    for k in range(150):
        x.append(pendulum(x[-1], u[k]))
    measured = torch.stack(x)[:, :1].numpy()
    lags = Lags(1, 1, states=1, inputs=1)
    seen = lags.transitions(measured[:100], u[:99].numpy())
    model = ResidualModel.train(
        lags.nominal, seen, lags.B, angles=[0], trainer=Trainer(restarts=0)
    )
    held_out = lags.transitions(measured[100:], u[100:].numpy())
    means = model.predict(held_out.states, held_out.inputs).mean
    assert float((means - held_out.next_states).abs().max()) < 0.01
    check_model(model, held_out.states[:4], held_out.inputs[:4])


@pytest.mark.parametrize(
    ("nominal", "effect"),
    [
        (Affine.identity(2, 1), rotation),
        (pendulum, rotation),
        (
            functools.partial(pendulum, damping=0.3),
            CasadiFunction(rotation_in_casadi()),
        ),
        (Damped(0.3), rotation),
        (CasadiFunction(pendulum_in_casadi()), CasadiFunction(rotation_in_casadi())),
        (
            CasadiFunction(successor_function(systems.pendulum())),
            CasadiFunction(every_operation()),
        ),
    ],
    ids=["numbers", "function", "partial", "dataclass", "operations", "system"],
)
def test_nominal_and_effect_are_saved_by_path_or_operations(nominal, effect, tmp_path):
    model = with_effect(nominal, effect)
    save_model(model, tmp_path / "m.safetensors")
    loaded = load_model(tmp_path / "m.safetensors", trusted=["tests"])
    x = draw(8, 6, 2)
    u = draw(9, 6, 1)
    for ours, theirs in zip(
        model.linearize(x.numpy(), u.numpy()),
        loaded.linearize(x.numpy(), u.numpy()),
        strict=True,
    ):
        assert np.array_equal(ours, theirs)


def test_code_without_a_path_that_leads_to_it_is_refused(tmp_path, monkeypatch):
    with pytest.raises(
        UnsupportedModel, match="nominal is code that a file cannot name"
    ):
        save_model(with_effect(lambda x, u: x), tmp_path / "m")
    cached = functools.lru_cache(pendulum)  # under the name of what it wraps
    monkeypatch.setitem(globals(), "pendulum", cached)
    with pytest.raises(UnsupportedModel, match="nominal is code that a file cannot"):
        save_model(with_effect(cached), tmp_path / "m")
    monkeypatch.undo()
    save_model(with_effect(), tmp_path / "m")
    # a table is no operation that a file holds
    x = casadi.MX.sym("x", 2)
    u = casadi.MX.sym("u", 1)
    table = casadi.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 2.0])
    with pytest.raises(
        UnsupportedModel, match="nominal is code that a file cannot name"
    ):
        save_model(
            with_effect(CasadiFunction(casadi.Function("f", [x, u], [x * table(u)]))),
            tmp_path / "m",
        )
    monkeypatch.delitem(globals(), "rotation")
    with pytest.raises(DataError, match="rotation cannot be imported here"):
        load_model(tmp_path / "m", trusted=["tests"])


def test_maps_over_points_are_kept_for_few_numbers_of_points():
    x = casadi.MX.sym("x", 1)
    table = casadi.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 2.0])
    function = CasadiFunction(casadi.Function("f", [x], [table(x)]))
    for points in range(1, 30):
        values, slopes = function.linearize(np.full((points, 1), 0.3))
        np.testing.assert_allclose(values, 0.6)
        np.testing.assert_allclose(slopes, 2.0)
    assert len(function._mapped_expansions) <= 20


@pytest.mark.parametrize(
    ("value", "got"),
    [
        ({0: 0.3}, r"\{0: 0.3\} \(dict\)"),
        ((0.3,), r"\(0.3,\) \(tuple\)"),
        ([[(0.3,)]], r"\[\[\(0.3,\)\]\] \(list\)"),
        (np.ones(1), r"array\(\[1.\]\) \(ndarray\)"),
        (Damped(0.3), r"Damped.* \(Damped\)"),
    ],
)
def test_parameters_that_a_file_would_change_are_refused(value, got, tmp_path):
    model = with_effect(Damped(0.3))
    changed = dataclasses.replace(
        model, nominal=functools.partial(pendulum, damping=value)
    )
    with pytest.raises(UnsupportedModel, match=f"nominal has .* damping={got}"):
        save_model(changed, tmp_path / "m")
    kept = {"a": [1, 0.5, None, True, "text", np.float64(0.1)]}
    kept = functools.partial(pendulum, damping=kept)
    save_model(dataclasses.replace(model, nominal=kept), tmp_path / "m")
    loaded = load_model(tmp_path / "m", trusted=["tests"])
    assert loaded.nominal.keywords == kept.keywords


@pytest.mark.parametrize(
    ("settings", "error", "rule"),
    [
        (
            {"angles": [2]},
            SettingError,
            r"angles: must be a list of different indices from 0 to 1; got \[2\]",
        ),
        (
            {"states": [1], "angles": [0]},
            SettingError,
            r"angles: must be some of the selected states \[1\]",
        ),
        ({"angles": []}, ShapeError, "has 3 states and 0 inputs; got 2 and 0 selected"),
        ({"noise": None}, SettingError, "noise: must be given"),
    ],
)
def test_misuse_is_refused(settings, error, rule):
    good = {
        "nominal": pendulum,
        "residual": gp(3, 0, 1),
        "B": rotation,
        "states": [0, 1],
        "inputs": [],
        "input_dim": 1,
    }
    good |= {"angles": [0], "noise": torch.eye(2, dtype=F)}
    with pytest.raises(error, match=rule):
        ResidualModel(**(good | settings))


@pytest.mark.parametrize("name", ["angles", "effect in torch"])
def test_torch_can_follow_the_jacobian_of_the_fast_road(name):
    model = MODELS[name]()
    x = draw(8, 5, model.state_dim)
    u = draw(9, 5, model.input_dim)
    fast = linearize(model, x.numpy(), u.numpy())
    at = Gaussian.certain(x.clone().requires_grad_())
    followed, slopes = differentiate(MeanEquivalence(), model, at, u)
    for got, expected in (
        (followed.belief.mean, fast.mean),
        (slopes.mean_by_mean, fast.A),
        (slopes.mean_by_input, fast.B),
    ):
        assert torch.allclose(got, torch.from_numpy(expected), atol=1e-10)
    assert slopes.mean_by_mean.requires_grad


@pytest.mark.parametrize("name", ["angles", "fewer outputs", "all in CasADi"])
def test_a_model_with_features_is_exported_to_casadi(name):
    model = MODELS[name]()
    function = casadi_function(model)
    x = draw(8, model.state_dim)
    u = draw(9, model.input_dim)
    belief = model.predict(x, u)
    mean, variance = function(x.numpy(), u.numpy())
    np.testing.assert_allclose(mean.full()[:, 0], belief.mean.numpy(), atol=1e-11)
    np.testing.assert_allclose(
        variance.full()[:, 0], belief.variance.numpy(), atol=1e-11
    )
