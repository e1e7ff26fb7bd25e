"""Noise that depends on the state is found where it is, and nowhere else; intervals
hold where it is quiet and loud."""

import numpy as np
import pytest
import torch

from gpmpc.estimation import (
    estimate_process_noise,
    estimate_varying_noise,
    with_process_noise,
)
from gpmpc.exceptions import DataError
from gpmpc.gp import Trainer, Transitions
from tests.estimation.test_delay_and_noise import STEP


def sigma(rates, varies):
    """Standard deviations (N, 2) of the noise of angle and rate."""
    return np.column_stack(
        [
            np.full(len(rates), 1e-3),
            np.hypot(0.01, 0.03 * rates) if varies else 0.03 + 0 * rates,
        ]
    )


def log(steps, seed, varies):
    """A flight of a damped pendulum under random pushes, whose noise is in proportion
    to its rate."""
    rng = np.random.default_rng(seed)
    states = [np.array([0.3, 0.0])]
    inputs = np.repeat(rng.uniform(-4, 4, (steps // 4 + 1, 1)), 4, axis=0)[:steps]
    for u in inputs:
        angle, rate = states[-1]
        next_rate = rate + STEP * (-9.81 * np.sin(angle) - rate + 2.0 * u[0])
        noise = rng.normal(0, sigma(np.array([rate]), varies)[0])
        states.append(np.array([angle + STEP * next_rate, next_rate]) + noise)
    return Transitions(np.array(states[:-1]), inputs, np.array(states[1:]))


def learned(rows):
    """A model of every third row."""
    return Trainer(predicts="difference", restarts=0)(rows[::3]).posterior


@pytest.fixture(scope="module")
def driven():
    rows = log(1200, 0, True)
    model = learned(rows)
    return rows, model, estimate_varying_noise(model, rows)


def coverage(model, rows, pick):
    """The share of the rates of some rows that intervals of 95 % hold, process noise
    included."""
    belief = model.predict(rows.states, rows.inputs)
    deviation = (belief.variance + model.noise_covariance.diagonal()).sqrt()
    return float(
        (((rows.next_states - belief.mean) / deviation).abs() < 1.96)[pick, 1]
        .double()
        .mean()
    )


def test_the_noise_is_found_where_it_is(driven):
    rows, model, estimate = driven
    assert estimate.outputs == (1,)
    assert estimate.gain[1] > 5 * estimate.error[1] > 0
    deviations = (
        estimate.model.noise(rows.states, rows.inputs)
        .diagonal(dim1=1, dim2=2)
        .sqrt()
        .numpy()
    )
    error = np.abs(np.log(deviations / sigma(rows.states[:, 1].numpy(), True)))[:, 1]
    assert np.sqrt((error**2).mean()) < 0.16
    assert np.quantile(error, 0.9) < 0.25
    assert np.allclose(deviations[:, 0] ** 2, float(model.noise_variance[0]))
    assert torch.equal(
        estimate.model.predict(rows.states, rows.inputs).mean,
        model.predict(rows.states, rows.inputs).mean,
    )


def test_intervals_hold_where_it_is_quiet_and_where_it_is_loud(driven):
    rows, model, estimate = driven
    fresh = log(6000, 1, True)
    inside = (fresh.features >= rows.features.amin(0)) & (
        fresh.features <= rows.features.amax(0)
    )
    fresh = fresh[inside.all(1).nonzero()[:, 0].tolist()]
    quiet = fresh.states[:, 1].abs() < fresh.states[:, 1].abs().median()
    constant = with_process_noise(model, estimate_process_noise(model, rows))
    assert 0.93 < coverage(estimate.model, fresh, quiet) < 0.97
    assert 0.93 < coverage(estimate.model, fresh, ~quiet) < 0.97
    assert coverage(constant, fresh, quiet) > 0.985
    assert coverage(constant, fresh, ~quiet) < 0.915


@pytest.mark.parametrize("seed", range(3))
def test_a_constant_noise_stays_one_and_the_model_as_it_is(seed):
    rows = log(400, seed, False)
    model = learned(rows)
    estimate = estimate_varying_noise(model, rows)
    assert estimate.outputs == ()
    assert estimate.model is model


def test_the_same_seed_gives_the_same_numbers():
    rows = log(200, 0, True)
    model = learned(rows)
    first, again = (estimate_varying_noise(model, rows).gain for _ in range(2))
    assert torch.equal(first, again)


def test_a_state_that_is_predicted_exactly_has_a_constant_noise():
    rows = log(400, 0, True)
    exact = Transitions(
        rows.states,
        rows.inputs,
        torch.stack([rows.states[:, 0], rows.next_states[:, 1]], dim=1),
    )
    estimate = estimate_varying_noise(learned(exact), exact)
    assert estimate.outputs == (1,)
    assert torch.isfinite(estimate.gain).all()


def test_too_few_rows_are_refused():
    rows = log(199, 0, True)
    with pytest.raises(
        DataError, match="needs 10 blocks of 20 rows or more; got 199 rows"
    ):
        estimate_varying_noise(learned(rows), rows)
