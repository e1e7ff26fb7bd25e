"""Residual models against sampling, finite differences and known residuals."""

from dataclasses import replace

import pytest
import torch

from gpmpc.estimation import Measurement
from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import (
    GPPosterior,
    SlidingWindow,
    SparseTrainer,
    Trainer,
    Transitions,
    append_points,
    append_transitions,
    remove_points,
    to_gpytorch,
)
from gpmpc.models import (
    Affine,
    DelayedModel,
    KnownModel,
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
)

A = torch.tensor([[1.0, 0.1, 0.0], [0.0, 0.9, 0.1], [0.2, 0.0, 0.8]])
G = torch.tensor([[0.0, 0.1], [0.1, 0.0], [0.5, 0.2]])
B = torch.tensor([[0.0, 0.3], [1.0, 0.0], [0.5, 1.0]])
AFFINE = Affine(A, G, torch.tensor([0.1, 0.0, -0.2]))


def nonlinear(x, u):
    return AFFINE(x, u) + 0.3 * torch.sin(2 * x.roll(1, dims=-1))


def gp(size=30, seed=0):
    """Of two outputs over the states 2, 0 and the input 1."""
    generator = torch.Generator().manual_seed(seed)
    x = 3 * torch.rand(size, 3, generator=generator) - 1.5
    return GPPosterior.from_hyperparameters(
        x,
        torch.stack([torch.sin(2 * x[:, 0]), x[:, 1] * x[:, 2]], dim=1),
        lengthscales=torch.tensor([[0.8, 1.2, 1.5], [1.1, 0.9, 2.0]]),
        signal_variance=torch.tensor([1.0, 0.7]),
        noise_variance=torch.tensor([1e-3, 2e-3]),
        input_dim=1,
        predicts="value",
    )


def model(nominal=AFFINE):
    return ResidualModel(nominal, gp(), B, states=[2, 0], inputs=[1], input_dim=2)


def belief(spread=0.3):
    root = spread * torch.tensor([[1.0, 0.2, 0.0], [0.0, 0.8, -0.3], [0.4, 0.0, 0.5]])
    return Gaussian(torch.tensor([0.2, -0.4, 0.5]), root @ root.T)


@pytest.mark.parametrize("nominal", [AFFINE, nonlinear])
def test_a_prediction_is_nominal_plus_residual_where_it_acts(nominal):
    x = torch.rand(4, 3)
    u = torch.rand(4, 2)
    prediction = model(nominal).predict(x, u)
    d = gp().predict(x[:, [2, 0]], u[:, [1]])
    assert torch.allclose(prediction.mean, nominal(x, u) + d.mean @ B.T)
    assert torch.allclose(prediction.covariance, B @ d.covariance @ B.T)
    assert torch.allclose(
        model().noise_covariance, B @ torch.diag(torch.tensor([1e-3, 2e-3])) @ B.T
    )


def test_a_residual_may_depend_on_inputs_alone(tmp_path):
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(40, 3, generator=generator)
    u = 4 * torch.rand(40, 2, generator=generator) - 2
    effect = torch.tensor([[0.0], [1.0], [0.5]])
    after = AFFINE(x, u) + 0.1 * torch.sin(u[:, :1]) @ effect.T
    learned = ResidualModel.train(
        AFFINE,
        Transitions(x, u, after),
        B=effect,
        states=[],
        inputs=[0],
        trainer=Trainer(restarts=0),
    )
    assert learned.residual.state_dim == 0
    control = torch.tensor([0.7, 0.0])
    expected = belief()
    exact = AFFINE(expected.mean, control) + 0.1 * effect[:, 0] * torch.sin(control[0])
    for propagator in (MomentMatching(), Unscented(), Linearization()):
        moved = propagator(learned, expected, control)
        assert torch.allclose(moved.mean, exact, atol=1e-3)
        covariance = A @ expected.covariance @ A.T
        assert torch.allclose(moved.covariance, covariance, atol=1e-4)
    save_model(learned, tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    assert torch.equal(loaded.predict(x, u).mean, learned.predict(x, u).mean)


@pytest.mark.parametrize("nominal", [AFFINE, nonlinear])
def test_the_jacobian_is_that_of_finite_differences(nominal):
    residual_model = model(nominal)
    x = torch.rand(2, 4, 3)
    u = torch.rand(2, 4, 2)
    step = 1e-6
    slopes = linearize(residual_model, x.flatten(0, 1).numpy(), u.flatten(0, 1).numpy())
    by_state = torch.from_numpy(slopes.A).unflatten(0, (2, 4))
    by_input = torch.from_numpy(slopes.B).unflatten(0, (2, 4))
    for d in range(3):
        shift = step * torch.eye(3)[d]
        slope = (
            residual_model.predict(x + shift, u).mean
            - residual_model.predict(x - shift, u).mean
        ) / (2 * step)
        assert torch.allclose(by_state[..., d], slope, atol=1e-8)
    for d in range(2):
        shift = step * torch.eye(2)[d]
        slope = (
            residual_model.predict(x, u + shift).mean
            - residual_model.predict(x, u - shift).mean
        ) / (2 * step)
        assert torch.allclose(by_input[..., d], slope, atol=1e-8)


@pytest.mark.parametrize("nominal", [AFFINE, nonlinear])
def test_a_batch_moves_alike_where_torch_follows_it(nominal):
    residual_model = model(nominal)
    means = torch.rand(2, 4, 3)
    covariance = 0.01 * torch.eye(3) + 0.005
    inputs = torch.rand(2, 4, 2)
    batch = Gaussian(means, covariance.expand(2, 4, 3, 3))
    followed = Gaussian(means.clone().requires_grad_(), batch.covariance)
    moved = Linearization()(residual_model, batch, inputs)
    by_autograd = Linearization()(residual_model, followed, inputs)
    assert by_autograd.mean.requires_grad
    assert torch.allclose(moved.mean, by_autograd.mean, atol=1e-12)
    assert torch.allclose(moved.covariance, by_autograd.covariance, atol=1e-12)
    one = Linearization()(
        residual_model, Gaussian(means[1, 2], covariance), inputs[1, 2]
    )
    assert torch.allclose(moved.covariance[1, 2], one.covariance, atol=1e-12)


def test_moment_matching_with_an_affine_nominal_model():
    residual_model = model()
    prior = belief()
    control = torch.tensor([0.3, -0.5])
    exact = MomentMatching().propagate(residual_model, prior, control)
    samples = [
        MonteCarlo(20_000, seed=seed).propagate(residual_model, prior, control)
        for seed in range(20)
    ]
    for exactly, drawn in (
        (exact.belief.mean, torch.stack([f.belief.mean for f in samples])),
        (exact.belief.covariance, torch.stack([f.belief.covariance for f in samples])),
        (exact.cross_covariance, torch.stack([f.cross_covariance for f in samples])),
    ):
        z = (drawn.mean(0) - exactly) / (drawn.std(0) / 20**0.5 + 1e-15)
        assert (
            float(z.abs().max()) < 4.5
        )  # of Student's t with 19 degrees of freedom: 1 in 4000 each


def test_a_nonlinear_nominal_goes_with_every_other_propagation():
    residual_model = model(nonlinear)
    prior = belief(0.05)
    control = torch.tensor([0.3, -0.5])
    with pytest.raises(
        UnsupportedModel,
        match="Possible with any model: MeanEquivalence, Linearization, Unscented",
    ):
        MomentMatching()(residual_model, prior, control)
    sampled = MonteCarlo(50_000)(residual_model, prior, control)
    for propagator in (Linearization(), Unscented()):
        next_belief = propagator(residual_model, prior, control)
        assert torch.allclose(next_belief.mean, sampled.mean, atol=5e-3)
        assert torch.allclose(next_belief.covariance, sampled.covariance, atol=1e-3)
    assert torch.allclose(
        MeanEquivalence()(residual_model, prior, control).mean,
        residual_model.predict(prior.mean, control).mean,
    )


def transitions(rows, noise=1e-3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = 3 * torch.rand(rows, 3, generator=generator) - 1.5
    u = torch.rand(rows, 2, generator=generator)
    next_states = AFFINE(x, u) + torch.sin(2 * x[:, :1]) * torch.tensor([0.0, 0.5, 1.0])
    return Transitions(
        x, u, next_states + noise * torch.randn(rows, 3, generator=generator)
    )


ACTS = torch.tensor([[0.0], [0.5], [1.0]])


@pytest.mark.parametrize(
    "trainer",
    [Trainer(restarts=0), SparseTrainer(inducing=15, restarts=0, iterations=5)],
)
def test_training_finds_a_known_residual(trainer):
    learned = ResidualModel.train(
        AFFINE, transitions(40), ACTS, states=[0], inputs=[], trainer=trainer
    )
    x = torch.linspace(-1.3, 1.3, 30)[:, None].expand(-1, 3)
    predicted = learned.residual.predict(x[:, :1]).mean[:, 0]
    assert torch.allclose(predicted, torch.sin(2 * x[:, 0]), atol=5e-3)
    held_out = transitions(50, noise=0.0, seed=1)
    assert torch.allclose(
        learned.predict(held_out.states, held_out.inputs).mean,
        held_out.next_states,
        atol=2e-2,
    )


def test_what_the_effect_does_not_reach_is_said(caplog):
    def train(noise, B=ACTS):
        ResidualModel.train(
            AFFINE, transitions(40, noise), B, trainer=Trainer(restarts=0)
        )
        return [record.getMessage() for record in caplog.records]

    assert not train(0.0)
    assert not train(0.1, torch.eye(3))
    (message,) = train(0.1)
    assert "of state 1 0.11 remain" in message
    assert "the noise of the model has 0:" in message


def test_by_default_every_state_has_a_residual_of_everything():
    learned = ResidualModel.train(AFFINE, transitions(15), trainer=Trainer(restarts=0))
    assert (
        learned.residual.state_dim,
        learned.residual.input_dim,
        learned.residual.output_dim,
    ) == (3, 2, 3)


def test_a_residual_model_learns_while_it_runs():
    data = transitions(60)
    learned = ResidualModel.train(
        AFFINE, data[:20], ACTS, states=[0], inputs=[], trainer=Trainer(restarts=0)
    )
    grown = learned.append(data[20:])
    assert len(grown.residual) == 60
    x = transitions(20, seed=1).states
    u = transitions(20, seed=1).inputs
    assert (
        grown.predict(x, u).covariance[:, 2, 2]
        < learned.predict(x, u).covariance[:, 2, 2]
    ).all()
    windowed = learned
    for i in range(20, 60):
        windowed = windowed.append(
            data[i : i + 1], SlidingWindow(25, "least_informative")
        )
    assert len(windowed.residual) == 25
    with pytest.raises(
        ShapeError, match="3 states and 2 inputs; got transitions with 3 and 1"
    ):
        learned.append(
            Transitions(torch.zeros(1, 3), torch.zeros(1, 1), torch.zeros(1, 3))
        )


def test_a_residual_model_can_be_moved_to_single_precision():
    x = torch.rand(4, 3)
    u = torch.rand(4, 2)
    single = model().to(dtype=torch.float32)
    assert torch.allclose(
        single.predict(x.float(), u.float()).mean.double(),
        model().predict(x, u).mean,
        atol=1e-4,
    )


def test_any_trainer_learns_residuals_and_nothing_else_does():
    residuals = [
        ResidualModel.train(
            AFFINE, transitions(15), trainer=Trainer(predicts=predicts, restarts=0)
        ).residual
        for predicts in ("value", "difference")
    ]
    assert residuals[1].predicts == "value"
    assert torch.equal(residuals[0].weights, residuals[1].weights)
    with pytest.raises(
        SettingError, match="trainer: must be a Trainer or SparseTrainer; got 3"
    ):
        ResidualModel.train(AFFINE, transitions(15), trainer=3)
    with pytest.raises(
        SettingError, match=r"transitions: must be Transitions\(...\); got str"
    ):
        ResidualModel.train(AFFINE, "data.npz")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"states": [2.0, 0]},
            SettingError,
            r"states: must be a list of different indices from 0 to 2; got \[2.0, 0\]",
        ),
        (
            {"inputs": [True]},
            SettingError,
            r"inputs: must be a list of different indices from 0 to 1; got \[True\]",
        ),
        (
            {"states": [2]},
            ShapeError,
            "has 2 states and 1 inputs; got 1 and 1 selected",
        ),
        (
            {"states": [2, 3]},
            SettingError,
            r"states: must be a list of different indices from 0 to 2; got \[2, 3\]",
        ),
        (
            {"inputs": [2]},
            SettingError,
            r"inputs: must be a list of different indices from 0 to 1; got \[2\]",
        ),
        (
            {"states": [1, 1]},
            SettingError,
            r"different indices from 0 to 2; got \[1, 1\]",
        ),
        (
            {"B": torch.ones(3, 3)},
            ShapeError,
            r"B must have shape \(3, 2\); got \(3, 3\)",
        ),
        (
            {"noise": -torch.eye(3)},
            SettingError,
            "noise: must have variances of zero or more",
        ),
        (
            {"residual": GPPosterior(**(vars(gp()) | {"predicts": "difference"}))},
            SettingError,
            "predicts='value'",
        ),
    ],
)
def test_misuse_is_refused_with_the_rule(change, error, message):
    good = {
        "nominal": AFFINE,
        "residual": gp(),
        "B": B,
        "states": [2, 0],
        "inputs": [1],
        "input_dim": 2,
    }
    with pytest.raises(error, match=message):
        ResidualModel(**(good | change))


def double_sided(dtype):
    return Affine(
        torch.eye(3, dtype=dtype), torch.zeros(3, 2, dtype=dtype), torch.zeros(3)
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"B": torch.eye(3).float()}, "B: must be torch.float64 on cpu like the tr"),
        ({"nominal": double_sided(torch.float32)}, "nominal.A: must be torch.float64"),
        (
            {"B": lambda x: torch.ones(*x.shape, 1, dtype=torch.float32)},
            "B: must be torch.float64 on cpu like the states; got torch.float32",
        ),
    ],
)
def test_tensors_of_another_type_are_refused_before_the_training(change, message):
    good = {"nominal": double_sided(torch.float64)}
    with pytest.raises(SettingError, match=message):
        ResidualModel.train(transitions=transitions(12), **(good | change))


def test_models_are_equal_to_themselves_alone():
    one = model()
    noisy = DelayedModel(one, 1)
    sensor = Measurement.of_states(3, [0], [0.1])
    for part in (one, noisy, AFFINE, sensor, KnownModel(AFFINE, 3, 2)):
        assert part in [replace(part), part]
        assert part != replace(part)
        assert len({part, replace(part)}) == 2


@pytest.mark.parametrize(
    "change",
    [
        lambda model: append_transitions(model, transitions(3)),
        lambda model: append_points(model, torch.zeros(2, 3), torch.zeros(2, 2)),
        lambda model: remove_points(model, [0]),
        to_gpytorch,
    ],
)
def test_a_residual_model_is_not_taken_for_its_gps(change):
    rule = "posterior must be a GPPosterior; got ResidualModel .*its `residual`"
    with pytest.raises(UnsupportedModel, match=rule):
        change(model())


def test_a_nominal_is_followed_at_an_angle_of_many_turns():
    def nominal(x, u):
        rate = x[:, 1] - 0.5 * x[:, 0].sin() + u[:, 0]
        return torch.stack([x[:, 0] + 0.05 * x[:, 1], rate, x[:, 2]], dim=-1)

    data = transitions(10)
    turned = data.states + 2 * torch.pi * torch.tensor([5000.0, 0.0, 0.0])
    data = replace(data, states=turned, next_states=nominal(turned, data.inputs))
    trained = ResidualModel.train(
        nominal, data, angles=[0], trainer=Trainer(restarts=0)
    )
    assert trained.angles == [0]


def test_an_effect_that_torch_loses_a_part_of_is_refused():
    def effect(x):
        lost = x[:, 1].detach() ** 2 + 1.0
        return torch.stack([x[:, 0].cos(), lost, x[:, 2] + 2.0], dim=-1)

    message = r"B: must be followed by torch .* entry 2 by column 2 of \(x, u\)"
    with pytest.raises(SettingError, match=message):
        ResidualModel.train(AFFINE, transitions(10), B=effect)
