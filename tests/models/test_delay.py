"""Delayed models and disturbance states obey the protocol, and look ahead exactly."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.estimation import ConformalTube, KalmanFilter, Measurement
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import (
    Affine,
    DelayedModel,
    DisturbedModel,
    KnownModel,
    NoisyModel,
    load_model,
    save_model,
)
from gpmpc.mpc import GPMPC, Problem, Tracking, beyond_data
from gpmpc.propagation import Linearization, MonteCarlo
from gpmpc.signals import Signals
from gpmpc.simulation import ModelLoop, closed_loop
from gpmpc.testing import check_model

F = torch.float64


def draw(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F)


def gp(n=2, m=1, size=25):
    ones = torch.ones(n, dtype=F)
    scales = 1 + draw(3, n, n + m).abs()
    targets = 0.3 * draw(2, size, n)
    return GPPosterior.from_hyperparameters(
        draw(1, size, n + m), targets, scales, ones, 0.01 * ones, m, "difference"
    )


@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("delay", [0.4, 1, 1.7, 3])
def test_a_delayed_model_is_a_model(delay, m):
    check_model(DelayedModel(gp(m=m), delay))


@pytest.mark.parametrize("delay", [1, 3])
def test_an_input_acts_as_many_steps_later_as_the_delay_is(delay):
    model = DelayedModel(gp(), delay)
    inner = gp()
    inputs = draw(5, 8, 1)
    z = model.augmented(Gaussian.certain(torch.zeros(2)), np.zeros((delay, 1))).mean
    x = torch.zeros(2)
    for k in range(8):
        z = model.predict(z, inputs[k]).mean
        x = inner.predict(x, inputs[k - delay] if k >= delay else torch.zeros(1)).mean
        assert torch.allclose(z[:2], x, atol=1e-13)


def test_a_fraction_of_a_step_mixes_two_inputs():
    class Integrator(
        torch.nn.Module
    ):  # the exact answer is the mean of the input over the step
        state_dim = 1
        input_dim = 1
        output_dim = 1
        dtype = F
        device = torch.device("cpu")
        noise_covariance = torch.zeros(1, 1, dtype=F)

        def predict(self, state, input):
            return Gaussian(state + input, torch.zeros(*state.shape, 1, dtype=F))

    model = DelayedModel(Integrator(), 1.25)
    assert model.pending == 2
    after = model.predict(torch.tensor([0.0, 4.0, 8.0]), torch.tensor([100.0])).mean
    assert after.tolist() == [0.25 * 4 + 0.75 * 8, 8, 100]


@pytest.mark.parametrize("delay", [1, 3, 0.6, 2.3])
def test_looking_ahead_agrees_with_the_delayed_model(delay):
    model = DelayedModel(gp(), delay)
    propagator = Linearization(process_noise=True)
    queue = 0.5 * draw(6, model.pending, 1)
    now = Gaussian(torch.tensor([0.1, -0.2]), 0.01 * torch.eye(2, dtype=F))
    ahead = model.ahead(propagator, now, queue)
    whole = model.augmented(now, queue)
    next_input = torch.zeros(1, dtype=F)
    for _ in range(model.lead):
        whole = propagator(model, whole, next_input)
    n = model.remaining.state_dim
    assert torch.allclose(ahead.mean[:2], whole.mean[:2], atol=1e-10)
    assert torch.allclose(
        ahead.covariance[:2, :2], whole.covariance[:2, :2], atol=1e-10
    )
    if delay % 1:
        assert n == 3
        assert float(ahead.mean[2]) == float(queue[-1])


def test_disturbance_states_move_as_sampling_says():
    effect = torch.tensor([[0.0, 0.1], [0.5, 0.0]], dtype=F)
    model = DisturbedModel(gp(), effect, [0.1, 0.2], [1.0, 0.8])
    check_model(model)
    check_model(DelayedModel(model, 1.5))
    prior = model.augmented(
        Gaussian(0.1 * draw(1, 2), 0.01 * torch.eye(2, dtype=F)), [0.3, 0.1]
    )
    belief = Linearization(process_noise=True)(model, prior, torch.zeros(1))
    sampled = MonteCarlo(50_000, process_noise=True)(model, prior, torch.zeros(1))
    assert torch.allclose(belief.mean, sampled.mean, atol=1e-2)
    assert torch.allclose(belief.covariance, sampled.covariance, atol=3e-3)
    assert float(belief.covariance[2, 2]) == pytest.approx(0.3**2 + 0.1**2)


@pytest.mark.parametrize(
    "model",
    [gp(), DelayedModel(DisturbedModel(gp(), torch.eye(2, dtype=F), [0.1, 0.1]), 2.5)],
    ids=["posterior", "nested"],
)
def test_models_are_saved_and_loaded_whole(model, tmp_path):
    save_model(model, tmp_path / "m.safetensors", {"states": ["a", "b"]})
    loaded = load_model(tmp_path / "m.safetensors")
    assert type(loaded) is type(model)
    x = draw(8, 4, model.state_dim).numpy()
    u = draw(9, 4, 1).numpy()
    for ours, theirs in zip(model.linearize(x, u), loaded.linearize(x, u), strict=True):
        assert np.array_equal(ours, theirs)
    assert torch.equal(model.noise_covariance, loaded.noise_covariance)


@pytest.mark.parametrize(
    ("make", "error", "rule"),
    [
        (
            lambda: DelayedModel(gp(), 0),
            SettingError,
            "delay: must be a number above 0",
        ),
        (lambda: DelayedModel("gp", 1), SettingError, "model: must be a DynamicsModel"),
        (
            lambda: DelayedModel(gp(), 2).augmented(
                Gaussian.certain(torch.zeros(2)), [[0.0]]
            ),
            ShapeError,
            r"\(2, 1\)",
        ),
        (
            lambda: DisturbedModel(gp(), torch.eye(3, dtype=F), [1.0] * 3),
            ShapeError,
            r"effect must be \(2, q\)",
        ),
        (
            lambda: DisturbedModel(gp(), torch.eye(2, dtype=F), [1.0]),
            SettingError,
            "std: must be a list of 2",
        ),
        (
            lambda: DisturbedModel(gp(), torch.eye(2, dtype=F), [1.0] * 2, [1.0, 1.1]),
            SettingError,
            "decay: must lie",
        ),
        (
            lambda: DisturbedModel(gp(), torch.eye(2, dtype=F), [1, 1]).augmented(
                Gaussian.certain(torch.zeros(2)), [1.0]
            ),
            SettingError,
            "std: must be a list of 2",
        ),
    ],
)
def test_misuse_is_refused(make, error, rule):
    with pytest.raises(error, match=rule):
        make()


NAMED = replace(gp(), signals=Signals(["angle", "rate"], ["torque"], 0.1))


def test_measurements_of_a_delayed_model_have_its_names():
    delayed = DelayedModel(NAMED, 1)
    assert delayed.signals.state_names == ("angle", "rate", "torque[k-1]")
    states = 0.1 * draw(5, 9, 2)
    inputs = draw(6, 8, 1)
    for signals in (NAMED.signals, Signals()):
        flight = Recording(states, inputs, signals)
        assert calibrate(delayed, flight, horizon=2).names == ("angle", "rate")
    swapped = pd.Series({"rate": 9.0, "angle": 0.1})
    (beyond,) = beyond_data(delayed, swapped)
    assert beyond.name == "rate"
    loop = ModelLoop(delayed, Linearization(), 0.1)
    problem = Problem(Tracking([1.0, 1.0], [0.1]))
    controller = GPMPC(delayed, Linearization(), problem, 2, [0.0])

    def begun(initial):
        return closed_loop(loop, controller, np.zeros((4, 2)), initial, 1)

    assert begun(swapped).states[0].tolist() == [0.1, 9.0]
    named = Gaussian(torch.tensor([9.0, 0.1]), torch.diag(torch.tensor([4.0, 1.0])))
    belief = replace(named, names=("rate", "angle"))
    assert begun(belief).covariances[0].diagonal().tolist() == [1.0, 4.0]


@pytest.mark.parametrize(("delay", "steps"), [(0.3 / 0.1, 3), ((0.1 + 0.2) / 0.1, 3)])
def test_whole_steps_that_come_from_a_division_are_whole(delay, steps):
    assert delay != steps
    model = DelayedModel(gp(), delay)
    assert (model.pending, model.lead) == (steps, steps)
    assert model.remaining is model.model


def test_a_noisy_model_has_the_past_of_its_model():
    delayed = DelayedModel(NAMED, 2)
    ones = torch.ones(1, dtype=F)
    scales = torch.ones(1, 5, dtype=F)
    g = GPPosterior.from_hyperparameters(
        draw(1, 9, 5), draw(2, 9, 1), scales, ones, 0.1 * ones, 1, "value"
    )
    noisy = NoisyModel(delayed, g, [1])
    assert not hasattr(noisy.log_noise, "past")
    assert (noisy.measured_dim, noisy.past) == (2, delayed.past)
    states = 0.1 * draw(5, 9, 2)
    inputs = draw(6, 8, 1)
    judged = calibrate(noisy, Recording(states, inputs), horizon=2)
    assert judged.names == ("angle", "rate")
    measured = np.ones(2)
    whole = []
    for model in (noisy, delayed):
        state = model.at_rest(measured, np.zeros(1))
        for torque in range(3):
            state = model.follow(state, np.array([float(torque)]), measured)
            whole.append(state)
    np.testing.assert_array_equal(whole[:3], whole[3:])


def test_a_model_around_a_named_one_adds_no_names():
    class Remembering:  # its state goes on with what has no name
        state_dim = output_dim = 3
        measured_dim = 2
        input_dim = 1
        signals = Signals(["x", "v"])
        dtype = F
        device = torch.device("cpu")
        noise_covariance = 0.01 * torch.eye(3).double()

        def predict(self, state, input):
            return Gaussian(state, torch.zeros(*state.shape, 3, dtype=F))

    inner = Remembering()
    disturbed = DisturbedModel(inner, torch.eye(3, 1, dtype=F), [0.1])
    assert disturbed.signals.state_names == ("x", "v")
    for model, state in ((disturbed, 2), (disturbed, 3), (inner, 2)):
        sensor = Measurement.of_states(model.state_dim, [0, state], [0.1, 0.1])
        belief = Gaussian.certain(torch.zeros(model.state_dim))
        update = KalmanFilter(model, sensor).update(belief, [0.1, 0.2])
        assert update.innovation.tolist() == [0.1, 0.2]


@pytest.mark.parametrize("delay", [1, 2, 0.4, 2.3])
def test_a_model_inside_is_trained_on_the_inputs_that_acted(delay):
    plant = Affine(torch.tensor([[0.9]]), torch.tensor([[0.5]]), torch.zeros(1))
    known = KnownModel(plant, 1, 1)
    delayed = DelayedModel(known, delay)
    inputs = draw(4, 12, 1)
    z = torch.zeros(delayed.state_dim)
    states = [z[:1]]
    for u in inputs:
        z = delayed.predict(z, u).mean
        states.append(z[:1])
    rows = DelayedModel.transitions(torch.stack(states), inputs, delay)
    assert len(rows) == 12 - delayed.pending
    predicted = known.predict(rows.states, rows.inputs).mean
    assert torch.allclose(predicted, rows.next_states, atol=1e-14)
    table = pd.DataFrame({"x": torch.stack(states)[:, 0]})
    assert DelayedModel.transitions(table, inputs, delay).signals.state_names == ("x",)
    with pytest.raises(ShapeError, match="need T above"):
        DelayedModel.transitions(table[:2], inputs[:1], delay)


def test_a_delayed_models_tube_is_calibrated_on_measurements():
    delayed = DelayedModel(NAMED, 1)
    states = 0.1 * draw(5, 41, 2)
    inputs = draw(6, 40, 1)
    table = pd.DataFrame(states.numpy(), columns=["angle", "rate"])
    tube = ConformalTube.calibrate(delayed, Linearization(), table, inputs, 3)
    assert tube.rows.shape == (4, 2)
    # The same as of the model inside with the inputs that acted.
    inner = ConformalTube.calibrate(
        NAMED, Linearization(), states[1:], inputs[:-1], horizon=3
    )
    np.testing.assert_allclose(tube.scores, inner.scores, rtol=1e-9)
