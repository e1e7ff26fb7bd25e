"""Noise of the process and of the sensors, told apart on motions whose noise is
known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.estimation import (
    estimate_process_noise,
    separate_noise,
    with_process_noise,
)
from gpmpc.exceptions import DataError, SettingError, UnsupportedModel
from gpmpc.gp import (
    GPPosterior,
    SlidingWindow,
    SparseTrainer,
    Trainer,
    Transitions,
    append_transitions,
    from_gpytorch,
    to_gpytorch,
    train,
)
from gpmpc.models import Affine, KnownModel, ResidualModel
from gpmpc.propagation import Linearization

A = np.array([[1.0, 0.1], [-0.2, 0.95]])
B = np.array([[0.005], [0.1]])


def motion(steps, process, sensors, seed=0):
    """States as they are seen (steps + 1, n), and inputs."""
    rng = np.random.default_rng(seed)
    states = [rng.normal(0.0, 0.3, 2)]
    inputs = rng.uniform(-1, 1, (steps, 1))
    for u in inputs:
        after = A @ states[-1] + B @ u + 0.02 * np.sin(3 * states[-1])
        states.append(after + rng.normal(0.0, 1.0, 2) * process)
    seen = np.array(states)
    return seen + rng.normal(0.0, 1.0, seen.shape) * sensors, inputs


def learned(process, sensors, kind="gp", steps=250):
    states, inputs = motion(steps, process, sensors)
    rows = Transitions(states[:-1], inputs, states[1:])
    if kind == "gp":
        return train(rows, predicts="difference", restarts=0).posterior, rows
    if kind == "residual":
        return ResidualModel.train(Affine.identity(2, 1), rows), rows
    return ResidualModel.train(Affine.identity(2, 1), rows, angles=[0]), rows


@pytest.mark.parametrize("kind", ["gp", "residual", "features"])
@pytest.mark.parametrize(
    ("process", "sensors"),
    [
        ([0.01, 0.02], [0.0, 0.0]),
        ([0.0, 0.0], [0.01, 0.02]),
        ([0.01, 0.02], [0.01, 0.02]),
    ],
)
def test_each_part_is_found(kind, process, sensors):
    model, rows = learned(np.array(process), np.array(sensors), kind)
    separation = separate_noise(model, rows)
    measurement = separation.measurement.sqrt().numpy()
    assert np.allclose(measurement, sensors, atol=2e-3, rtol=0.3)
    if any(process):
        process_std = separation.process.sqrt().numpy()
        assert np.allclose(process_std, process, rtol=0.35)
    if not any(sensors):
        assert not separation.measurement.any()
        assert torch.allclose(
            separation.model.noise_covariance, model.noise_covariance, rtol=1e-12
        )


def test_the_model_predicts_the_same_with_process_noise():
    sensors = np.array([0.01, 0.02])
    for kind in ("gp", "features"):
        model, rows = learned(0.3 * sensors, sensors, kind)
        separation = separate_noise(model, rows)
        state = torch.tensor([0.1, -0.2], dtype=torch.float64)
        input = torch.zeros(1, dtype=torch.float64)
        before = model.predict(state, input)
        after = separation.model.predict(state, input)
        assert torch.equal(before.mean, after.mean)
        assert torch.equal(before.covariance, after.covariance)
        noise = separation.model.noise_covariance.diagonal()
        assert torch.allclose(noise, separation.process)
        assert bool((noise < 0.7 * model.noise_covariance.diagonal()).all())


def test_a_separation_keeps_all_that_was_learned():
    sensors = np.array([0.01, 0.02])
    gp, rows = learned(0.3 * sensors, sensors, steps=120)
    separated = separate_noise(gp, rows).model
    assert torch.allclose(separated.observation_noise, gp.noise_variance, rtol=1e-9)
    # Further measured rows are as noisy as those before.
    further = append_transitions(gp, rows[:5])
    apart = append_transitions(separated, rows[:5])
    assert torch.allclose(apart.weights, further.weights, rtol=1e-9)
    assert torch.equal(apart.noise_variance, separated.noise_variance)
    one_row = SlidingWindow(points=1)
    last = one_row(one_row(separated, rows[:1]), rows[1:2])
    assert torch.allclose(last.observation_noise, gp.noise_variance, rtol=1e-9)
    noise = estimate_process_noise(gp, rows).variance
    assert torch.allclose(estimate_process_noise(separated, rows).variance, noise)
    again = separate_noise(separated, rows)
    assert torch.allclose(again.process, separated.noise_variance, rtol=1e-6)
    trainer = Trainer(predicts="difference", restarts=0)
    refitted = trainer.refit(separated).posterior.noise_variance
    assert torch.allclose(refitted, gp.noise_variance, rtol=0.05)
    replaced = with_process_noise(separated, gp.noise_variance)
    assert torch.allclose(replaced.cholesky, gp.cholesky)
    again = from_gpytorch(to_gpytorch(separated), input_dim=1, predicts="difference")
    assert torch.allclose(again.weights, gp.weights, rtol=1e-6)


def test_separated_noise_reaches_every_form_of_residual_model():
    sensors = np.array([0.01, 0.02])
    model, rows = learned(0.3 * sensors, sensors, kind="residual", steps=120)
    usual = separate_noise(model, rows)
    own = replace(model, noise=model.noise_covariance)
    separation = separate_noise(own, rows)
    assert torch.allclose(separation.process, usual.process)
    assert torch.equal(separation.model.observation_noise, own.noise)
    again = separate_noise(separation.model, rows)
    assert torch.allclose(again.process, usual.process)
    assert torch.allclose(again.model.noise, separation.model.noise)
    of_model = separation.model.noise_covariance.diagonal()
    assert torch.allclose(of_model, usual.process)
    # An output that acts on no state keeps its noise.
    one_alone = replace(model, B=torch.tensor([[0.0, 0.0], [0.0, 1.0]]).double())
    noise = separate_noise(one_alone, rows).model.residual.noise_variance
    assert float(noise[1]) < 0.7 * float(model.residual.noise_variance[1])
    assert noise[0] == model.residual.noise_variance[0]


def test_only_separated_noise_gives_honest_intervals():
    sensors = np.array([0.01, 0.02])
    model, rows = learned(0.1 * sensors, sensors)
    fresh = [
        Recording(*motion(60, 0.1 * sensors, sensors, seed)) for seed in range(1, 9)
    ]
    separation = separate_noise(model, rows)
    sensor_std = separation.measurement.sqrt().tolist()
    judge = partial(calibrate, propagator=Linearization(), horizon=15)
    apart = judge(separation.model, fresh, measurement_noise=sensor_std)
    cautious = judge(model, fresh)
    assert float(apart.coverage[-1, :, -1].min()) > 0.88
    assert float(apart.coverage[:, :, -1].mean()) < 0.98
    assert float(cautious.coverage[-1, :, -1].min()) > 0.985
    assert float(cautious.width[-1].min()) > 1.4 * float(apart.width[-1].max())


def test_what_cannot_be_separated_is_refused():
    model, rows = learned(np.full(2, 0.01), np.zeros(2), steps=60)
    nominal = KnownModel(Affine.identity(2, 1), 2, 1)
    sparse = SparseTrainer(inducing=10, restarts=0)(rows).posterior
    for other in (nominal, sparse):
        with pytest.raises(UnsupportedModel, match="can be separated"):
            separate_noise(other, rows)
    residual, _ = learned(np.full(2, 0.01), np.zeros(2), kind="residual", steps=60)
    for function in (separate_noise, estimate_process_noise):
        with pytest.raises(SettingError, match="model: must predict the next state"):
            function(residual.residual, rows)  # it predicts what is missed, not states
    with pytest.raises(UnsupportedModel, match="pseudo-observations, no data"):
        to_gpytorch(sparse)
    assert isinstance(model, GPPosterior)
    with pytest.raises(DataError, match="needs 20 rows that follow one another; got 0"):
        separate_noise(model, rows[torch.arange(0, 60, 2)])
