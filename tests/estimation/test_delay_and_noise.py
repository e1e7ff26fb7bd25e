"""A delay is found in a log with an interval that holds it, and noise where a posterior
has learned too little."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.estimation import estimate_delay, estimate_process_noise, with_process_noise
from gpmpc.estimation._noise import residuals
from gpmpc.exceptions import DataError, SettingError, ShapeError, UnsupportedModel
from gpmpc.gp import GPPosterior, SparseTrainer, Trainer, Transitions
from gpmpc.models import Affine, DelayedModel, NoisyModel, ResidualModel
from gpmpc.propagation import Linearization

STEP = 0.05


def pendulum(x, u):
    rate = x[1] + STEP * (-9.81 * np.sin(x[0]) - 0.3 * x[1] + 2.0 * u[0])
    return np.array([x[0] + STEP * rate, rate])


def log(steps, delay, seed, feedback=0.0, std=(1e-3, 0.02), rho=0.0):
    """States and inputs of a flight; noise is an AR(1) process of these standard
    deviations."""
    rng = np.random.default_rng(seed)
    whole = int(np.ceil(delay))
    fraction = delay - (whole - 1)
    states = [np.array([0.3, 0.0])]
    inputs = [np.zeros(1)] * (whole + 1)
    noise = np.zeros(2)
    for _ in range(steps):
        inputs.append(rng.uniform(-1, 1, 1) - feedback * states[-1][1:])
        acting = (
            fraction * inputs[-1 - whole]
            + (1 - fraction) * inputs[-whole if whole else -1]
        )
        noise = rho * noise + np.sqrt(1 - rho**2) * rng.normal(0, std)
        states.append(pendulum(states[-1], acting) + noise)
    return np.array(states), np.array(inputs[whole + 1 :])


@pytest.mark.parametrize("feedback", [0.0, 0.3])
@pytest.mark.parametrize("delay", [0, 1, 3, 2.4])
def test_a_delay_is_found_also_where_the_input_follows_the_state(delay, feedback):
    estimate = estimate_delay(*log(300, delay, 0, feedback))
    assert estimate.steps == pytest.approx(delay, abs=0.15)
    assert estimate.interval[0] <= delay <= estimate.interval[1]
    assert estimate.interval[1] - estimate.interval[0] < 0.8
    assert (
        estimate.correlations.max()
        == estimate.correlations[estimate.delays.tolist().index(estimate.steps)]
    )


def test_the_interval_holds_the_delay_as_often_as_it_says():
    hits = [estimate_delay(*log(120, 2.4, seed, std=(5e-3, 0.1))) for seed in range(40)]
    covered = sum(one.interval[0] <= 2.4 <= one.interval[1] for one in hits)
    assert covered >= 34  # of a share of 95 % of 40 in less than one of 100 cases


def test_inputs_without_an_effect_give_a_wide_interval():
    states, _ = log(200, 0, 0)
    estimate = estimate_delay(states, np.random.default_rng(5).normal(size=(200, 1)))
    assert estimate.interval[1] - estimate.interval[0] > 3
    assert estimate.correlations.max() < 0.4


@pytest.mark.parametrize("offset", [1e3, -1e6, 1e9])
def test_a_delay_is_found_for_any_zero_of_states_and_inputs(offset):
    states, inputs = log(300, 3, 0)
    away = estimate_delay(states + offset, inputs)
    assert away.steps == pytest.approx(3, abs=0.15)
    assert away.interval[1] - away.interval[0] < 0.8
    assert estimate_delay(states, inputs + offset).steps == pytest.approx(3, abs=0.15)
    scaled = estimate_delay(states * [1e-6, 1e6], inputs * 1e-9)
    assert scaled.steps == estimate_delay(states, inputs).steps


def test_no_delay_is_tried_that_is_longer_than_the_longest():
    states, inputs = log(60, 0, 1)
    delays = estimate_delay(states, inputs, longest=2, resolution=0.3).delays
    assert delays.tolist() == [0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8]
    delays = estimate_delay(states, inputs, longest=3, resolution=0.1).delays
    assert len(delays) == 31
    assert delays[-1] == 3.0


def test_a_delay_at_the_longest_tried_is_said_in_the_log(caplog):
    states, inputs = log(300, 3, 0)
    estimate_delay(states, inputs, longest=4)
    assert not caplog.messages
    assert estimate_delay(states, inputs, longest=2).interval[1] > 2.0
    (line,) = caplog.messages
    assert "the longest delay that was tried, 2 steps: the delay may be longer" in line


def test_states_that_rest_or_repeat_others_change_no_delay():
    states, inputs = log(300, 3, 0)
    uninformative = [np.full(301, 2.0), states[:, 0], states @ [1.0, -3.0]]
    estimate = estimate_delay(np.column_stack([states, *uninformative]), inputs)
    assert estimate.steps == pytest.approx(3, abs=0.15)


def feedback_alone(steps, delay, noise):
    """A log of a pendulum whose torque is a function of its state and nothing else."""
    rng = np.random.default_rng(0)
    gain = np.array([[1.0, 0.3]])
    states = [np.array([0.5, 0.0])]
    inputs = [np.zeros(1)] * (delay + 1)
    for _ in range(steps):
        inputs.append(-gain @ states[-1])
        after = pendulum(states[-1], inputs[-1 - delay])
        states.append(after + noise * rng.normal(0, [1e-3, 0.02]))
    return np.array(states), np.array(inputs[delay + 1 :])


OTHER = np.random.default_rng(3).normal(size=(300, 1))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda x, u: (x, 0 * u), "input 1 is constant"),
        (lambda x, u: (x, 0 * u + 0.1), "input 1 is constant"),
        (lambda x, u: (x, np.hstack([u, 0 * u + 3])), "input 2 is constant"),
        (lambda x, u: (x, np.hstack([u, u])), "inputs 1 and 2 move alike"),
        (
            lambda x, u: (x, np.hstack([OTHER, u, 7 - 3 * u])),
            "inputs 2 and 3 move alike",
        ),
        (
            lambda x, u: (x, np.hstack([u, OTHER, u - OTHER])),
            "input 3 is a sum of those before",
        ),
        (lambda x, u: (0 * x + 1, u), "no state moves"),
        (lambda x, u: (0.1 * np.arange(len(x))[:, None], u), "no state moves"),
        (
            lambda x, u: (x, np.eye(300, 1, -3)),  # one pulse, near the beginning
            "input 1 of 0 steps before is constant in the rows",
        ),
        (
            lambda x, u: feedback_alone(300, 0, 1.0),
            "input 1 of 0 steps before is a function of the state",
        ),
        (
            lambda x, u: feedback_alone(300, 3, 1.0),
            "input 1 of 0 steps before is a function of the state",
        ),
        (
            lambda x, u: feedback_alone(300, 1, 0.0),
            "is a function of the state, as under feedback alone",
        ),
    ],
)
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_a_delay_not_in_the_data_is_refused_with_a_reason(change, reason, offset):
    states, inputs = change(*log(300, 3, 0))
    with pytest.raises(DataError, match=f"{reason}.*the data cannot tell"):
        estimate_delay(states + offset, inputs)


def test_a_little_excitation_beside_a_feedback_is_enough():
    states, inputs = log(600, 3, 0, feedback=2.0)
    estimate = estimate_delay(states, inputs)
    assert estimate.interval[0] <= 3 <= estimate.interval[1]


def test_a_delay_is_found_where_a_spinning_pendulum_wraps():
    states = [np.array([3.0, 6.0])]
    inputs = np.random.default_rng(1).normal(size=(300, 1))
    for k in range(300):
        states.append(pendulum(states[-1], 2 + inputs[max(k - 3, 0)]))
    wrapped = np.array(states)
    wrapped[:, 0] = np.mod(wrapped[:, 0] + np.pi, 2 * np.pi) - np.pi
    estimate = estimate_delay(wrapped, inputs, angles=[0])
    assert estimate.steps == pytest.approx(3, abs=0.15)
    counting = estimate_delay(states, inputs)
    assert np.allclose(estimate.correlations, counting.correlations, atol=1e-4)
    with pytest.raises(
        SettingError, match=r"angles: must be a list of different indices"
    ):
        estimate_delay(wrapped, inputs, angles=[2])


def transitions(states, inputs):
    return Transitions(states[:-1], inputs, states[1:])


def test_noise_and_its_correlation_are_those_of_the_process():
    data = transitions(*log(2000, 0, 0, std=(2e-3, 0.03), rho=0.6))
    model = Trainer(predicts="difference", restarts=0)(data[:150]).posterior
    noise = estimate_process_noise(model, data)
    assert torch.allclose(noise.variance.sqrt(), torch.tensor([2e-3, 0.03]), rtol=0.12)
    assert torch.allclose(noise.correlation, torch.full((2,), 0.6), atol=0.12)
    assert torch.allclose(
        noise.long_run_variance / noise.variance, torch.full((2,), 4.0), rtol=0.35
    )


def test_rows_that_were_trained_on_count_as_if_they_had_not_been():
    data = transitions(*log(200, 0, 3, std=(2e-3, 0.03)))
    model = Trainer(predicts="difference", restarts=0)(data).posterior
    in_sample = (
        (data.next_states - model.predict(data.states, data.inputs).mean)
        .square()
        .mean(0)
    )
    held_out = estimate_process_noise(model, data[:20], block=20)
    without = GPPosterior.from_hyperparameters(
        model.features[20:],
        model.targets[20:],
        model.lengthscales,
        model.signal_variance,
        model.noise_variance,
        1,
        "difference",
        model.offset,
    )
    again = estimate_process_noise(without, data[:20])
    assert torch.allclose(held_out.variance, again.variance, rtol=1e-6)
    assert (estimate_process_noise(model, data).variance > in_sample).all()


def test_rows_between_training_rows_are_left_out_with_them():
    data = transitions(*log(200, 0, 3, std=(2e-3, 0.03)))
    gp = Trainer(predicts="difference", restarts=0)(data[::2]).posterior
    rows = data[:39]  # every second one is one of the first 20 points
    found = residuals(gp, rows, block=20)
    expected = residuals(without_rows(gp, range(20)), rows, block=20)
    assert torch.allclose(found.errors, expected.errors, rtol=1e-6, atol=1e-9)
    assert torch.allclose(found.latent, expected.latent, rtol=1e-6, atol=1e-9)
    # errors that hang together, seen by every second row
    rng = np.random.default_rng(0)
    error = 0.02 * rng.normal(size=601)
    for k in range(1, 601):
        error[k] = 0.9 * error[k - 1] + np.sqrt(1 - 0.9**2) * error[k]
    inputs = np.sin(np.arange(600)[:, None] * [0.035, 0.095]).sum(1, keepdims=True)
    states = np.zeros((601, 1))
    for k in range(600):
        states[k + 1] = 0.95 * states[k] + 0.1 * inputs[k] + error[k]
    every = Transitions(states[:-1], inputs, states[1:])
    half = Trainer(predicts="difference", restarts=0)(every[::2]).posterior
    noise = estimate_process_noise(half, every)
    assert float(noise.variance.sqrt()) == pytest.approx(0.02, rel=0.15)
    assert float(noise.correlation) == pytest.approx(0.9, abs=0.05)


def at_rest_then_pushed(noise):
    """A plant that rests for the half of its log; its sensor shows nothing then."""
    rng = np.random.default_rng(5)
    inputs = np.zeros((60, 1))
    inputs[20:50] = rng.uniform(-1, 1, (30, 1))
    states = np.zeros((61, 2))
    for k in range(20, 50):
        pushed = pendulum(states[k], inputs[k])
        states[k + 1] = pushed + 0.02 * rng.normal(size=2)
    states[50:] = 0
    after = states[1:] + noise * rng.normal(size=(60, 2))
    return Transitions(states[:-1], inputs, after)


def without_rows(gp, rows):
    keep = [i for i in range(len(gp)) if i not in rows]
    return GPPosterior.from_hyperparameters(
        gp.features[keep],
        gp.targets[keep],
        lengthscales=gp.lengthscales,
        signal_variance=gp.signal_variance,
        noise_variance=gp.noise_variance,
        input_dim=gp.input_dim,
        predicts=gp.predicts,
        offset=gp.offset,
    )


@pytest.mark.parametrize("noise", [0.0, 0.01], ids=["equal rows", "equal (x, u)"])
@pytest.mark.parametrize("order", ["of time", "of a training in another order"])
def test_each_row_of_a_plant_at_rest_is_left_out_itself(noise, order):
    data = at_rest_then_pushed(noise)
    trained = data
    if order != "of time":
        trained = data[np.random.default_rng(0).permutation(60).tolist()]
    model = GPPosterior.from_hyperparameters(
        trained.features,
        trained.targets("difference"),
        lengthscales=torch.full((2, 3), 0.8, dtype=torch.float64),
        signal_variance=torch.tensor([0.01, 0.1], dtype=torch.float64),
        noise_variance=torch.tensor([1e-4, 1e-4], dtype=torch.float64),
        input_dim=1,
        predicts="difference",
    )
    in_time = without_rows(model, ())
    if order != "of time":
        in_time = GPPosterior.from_hyperparameters(
            data.features,
            data.targets("difference"),
            lengthscales=model.lengthscales,
            signal_variance=model.signal_variance,
            noise_variance=model.noise_variance,
            input_dim=1,
            predicts="difference",
        )
    squares = []
    for first in range(0, 60, 20):
        block = data[first : first + 20]
        belief = without_rows(in_time, range(first, first + 20)).predict(
            block.states, block.inputs
        )
        squares.append((block.next_states - belief.mean).square() - belief.variance)
    expected = torch.cat(squares).mean(0)
    variance = estimate_process_noise(model, data).variance
    assert (expected > 0).all()
    assert torch.allclose(variance, expected, rtol=1e-6)


def test_a_row_of_known_inputs_and_another_target_is_new():
    data = transitions(*log(40, 0, 3, std=(2e-3, 0.03)))
    gp = Trainer(predicts="difference", restarts=0)(data).posterior
    again = Transitions(data.states, data.inputs, data.next_states + 1.0)
    belief = gp.predict(data.states, data.inputs)
    squares = (again.next_states - belief.mean).square() - belief.variance
    variance = estimate_process_noise(gp, again).variance
    assert torch.allclose(variance, squares.mean(0), rtol=1e-6)


def test_the_part_of_an_error_that_no_residual_reaches_stays():
    data = transitions(*log(80, 0, 2, std=(0.02, 0.03)))
    trained = ResidualModel.train(
        Affine.identity(2, 1),
        data,
        B=torch.tensor([[0.0], [1.0]], dtype=torch.float64),
        trainer=Trainer(restarts=0),
    )
    noise = estimate_process_noise(trained, data)
    untouched = (data.next_states - data.states)[:, 0].square().mean()
    assert float(noise.variance[0]) == pytest.approx(float(untouched), rel=1e-9)


def test_with_process_noise_widens_tubes_and_keeps_the_data():
    data = transitions(*log(80, 0, 1))
    model = Trainer(predicts="difference", restarts=0)(data).posterior
    noise = estimate_process_noise(model, data)
    wider = with_process_noise(model, 4 * noise.variance)
    assert torch.allclose(wider.noise_covariance, torch.diag(4 * noise.variance))
    assert torch.equal(wider.features, model.features)
    belief = Linearization(process_noise=True)(
        wider, wider.predict(data.states[0], data.inputs[0]), data.inputs[1]
    )
    assert (belief.variance > 4 * noise.variance).all()
    residual = ResidualModel.train(
        Affine.identity(2, 1), data, angles=[0], trainer=Trainer(restarts=0)
    )
    assert torch.allclose(
        estimate_process_noise(residual, data).variance, noise.variance, rtol=0.5
    )


def test_an_output_without_an_error_keeps_the_noise_that_it_has():
    states, inputs = log(60, 0, 1)
    states[:, 0] = 0.0
    data = transitions(states, inputs)
    model = Trainer(predicts="difference", restarts=0)(data).posterior
    noise = estimate_process_noise(model, data)
    assert noise.variance[0] == 0
    kept = with_process_noise(model, noise).noise_variance
    assert kept.tolist() == [model.noise_variance[0], noise.variance[1]]


def test_rows_in_no_order_of_time_have_no_correlation():
    data = transitions(*log(60, 0, 1))
    model = Trainer(predicts="difference", restarts=0)(data).posterior
    order = np.random.default_rng(0).permutation(60)
    assert torch.isnan(
        estimate_process_noise(model, data[order.tolist()]).correlation
    ).all()


def test_misuse_is_refused():
    states, inputs = log(60, 0, 1)
    data = transitions(states, inputs)
    model = Trainer(predicts="difference", restarts=0)(data).posterior
    with pytest.raises(DataError, match="needs ten rows or more; got 9"):
        estimate_process_noise(model, data[:9])
    with pytest.raises(
        ShapeError,
        match="the model has 2 states and 1 inputs; got transitions with 2 and 2",
    ):
        estimate_process_noise(
            model, Transitions(data.states, data.states, data.next_states)
        )
    sparse = SparseTrainer(inducing=8, restarts=0, iterations=5, predicts="difference")(
        data
    ).posterior
    with pytest.raises(UnsupportedModel, match="train a sparse one again"):
        with_process_noise(sparse, torch.ones(2))
    with pytest.raises(SettingError, match="noise: must be a torch tensor; got list"):
        with_process_noise(model, [0.1, 0.1])
    with pytest.raises(
        ShapeError, match=r"must be one log; got \(61, 2\) and \(50, 1\)"
    ):
        estimate_delay(states, inputs[:50])
    with pytest.raises(DataError, match="a delay of up to 60 steps needs"):
        estimate_delay(states, inputs, longest=60)
    for settings, rule in (
        ({"confidence": 1.0}, "confidence: must lie between 0 and 1; got 1.0"),
        ({"resamples": 0}, "resamples: must be a whole number, 1 or more; got 0"),
        ({"seed": -1}, "seed: must be a whole number, 0 or more; got -1"),
    ):
        with pytest.raises(SettingError, match=rule):
            estimate_delay(states, inputs, longest=3, **settings)
    with pytest.raises(DataError, match="must be finite"):
        estimate_delay(np.where(states > 1, np.nan, states) * np.nan, inputs)


@pytest.mark.parametrize("delay", [2, 1.3])
def test_rows_of_a_model_inside_of_others_are_left_out_as_well(delay):
    states, inputs = log(62, 2, 3, std=(2e-3, 0.03))
    inner = DelayedModel.transitions(states, inputs, delay)
    model = Trainer(predicts="difference", restarts=0)(inner).posterior
    expected = estimate_process_noise(model, inner).variance
    delayed = DelayedModel(model, delay)
    rows = np.column_stack([states[2:], inputs[:-1], inputs[1:]])
    whole = transitions(rows, inputs[2:])
    variance = estimate_process_noise(delayed, whole).variance
    assert torch.allclose(variance[:2], expected, rtol=1e-6)
    assert not variance[2:].any()
    g = replace(model, predicts="value")
    noisy = NoisyModel(model, g, [0, 1])
    assert torch.allclose(estimate_process_noise(noisy, inner).variance, expected)


@pytest.mark.parametrize("varies", [False, True])
def test_rows_of_a_residual_of_varying_effect_are_left_out(varies):
    data = transitions(*log(60, 0, 3, std=(2e-3, 0.03)))

    def effect(x):
        column = torch.stack([0.05 + 0.0 * x[..., 0], 1.0 + varies * x[..., 0]], dim=-1)
        return column[..., None]

    nominal = Affine.identity(2, 1)
    model = ResidualModel.train(nominal, data, effect, trainer=Trainer(restarts=0))
    squares = []
    for first in range(0, 60, 20):
        block = data[first : first + 20]
        without = replace(
            model,
            residual=without_rows(model.residual, range(first, first + 20)),
        )
        belief = without.predict(block.states, block.inputs)
        squares.append((block.next_states - belief.mean).square() - belief.variance)
    variance = estimate_process_noise(model, data).variance
    assert torch.allclose(variance, torch.cat(squares).mean(0), rtol=1e-6)


def test_a_coarse_delay_has_an_interval_that_holds_those_between():
    rng = np.random.default_rng(0)
    inputs = np.repeat(rng.normal(size=(80, 1)), 3, axis=0)
    acting = np.zeros((240, 1))
    acting[4:] = 0.6 * inputs[:-4] + 0.4 * inputs[1:-3]  # 3.6 steps late
    states = np.vstack([[0.0], acting]).cumsum(axis=0)
    states += 1e-3 * rng.normal(size=states.shape)
    steps = {
        resolution: estimate_delay(states, inputs, 6, resolution, resamples=60).interval
        for resolution in (1, 2)
    }
    assert steps == {1: (4.0, 4.0), 2: (3.0, 5.0)}
