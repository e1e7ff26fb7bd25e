"""Filters and the smoother, against conditioning of the joint Gaussian, and their
consistency on a pendulum."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest
import torch

from gpmpc.estimation import (
    KalmanFilter,
    LateMeasurements,
    Measurement,
    autocorrelation,
    estimation_errors,
    normalized_errors,
    smooth,
)
from gpmpc.estimation._conditioning import unexplained_covariance
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import DelayedModel, DisturbedModel, KnownModel
from gpmpc.plotting import innovations_figure
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MonteCarlo,
    Unscented,
)
from gpmpc.signals import Signals
from gpmpc.testing import check_model

F = torch.float64
STEP = 0.05


class Known:
    """A known function of state and input with process noise."""

    input_dim = 1
    dtype = F
    device = torch.device("cpu")

    def __init__(self, function, noise):
        self.function = function
        self.noise_covariance = torch.diag(torch.tensor(noise, dtype=F) ** 2)
        self.state_dim = self.output_dim = len(noise)

    def predict(self, state, input):
        mean = self.function(state, input)
        return Gaussian(mean, mean.new_zeros(*mean.shape, len(self.noise_covariance)))


A = torch.tensor([[1.0, 0.1], [-0.3, 0.9]], dtype=F)
B = torch.tensor([[0.0], [0.1]], dtype=F)
LINEAR = Known(lambda x, u: x @ A.mT + u @ B.mT, [0.05, 0.1])


def pendulum(x, u):
    rate = x[..., 1] + STEP * (-9.81 * x[..., 0].sin() - 0.2 * x[..., 1] + u[..., 0])
    return torch.stack([x[..., 0] + STEP * rate, rate], dim=-1)


PENDULUM = Known(pendulum, [1e-3, 0.02])
PRIOR = Gaussian(
    torch.tensor([0.5, 0.0], dtype=F), torch.diag(torch.tensor([0.04, 0.09], dtype=F))
)


def simulated(model, steps, seed, measurement, prior=PRIOR):
    rng = np.random.default_rng(seed)

    def noise(covariance):
        return torch.from_numpy(
            rng.multivariate_normal(np.zeros(len(covariance)), covariance.numpy())
        )

    states = [prior.mean + noise(prior.covariance)]
    inputs = torch.from_numpy(rng.normal(size=(steps, 1)))
    for u in inputs:
        states.append(model.predict(states[-1], u).mean + noise(model.noise_covariance))
    x = torch.stack(states)
    measured = torch.stack(
        [measurement.function(s) + noise(measurement.noise_covariance) for s in x]
    )
    return x, inputs, measured


def conditioned(inputs, measured, H, R):
    """Means and covariances of all states of the linear model given all measurements,
    from their joint Gaussian."""
    T = len(measured)
    n = 2
    mean = torch.zeros(T, n, dtype=F)
    covariance = torch.zeros(T, n, T, n, dtype=F)
    mean[0] = PRIOR.mean
    covariance[0, :, 0] = PRIOR.covariance
    for k in range(1, T):
        mean[k] = A @ mean[k - 1] + B @ inputs[k - 1]
        for j in range(k):
            covariance[k, :, j] = A @ covariance[k - 1, :, j]
            covariance[j, :, k] = covariance[k, :, j].mT
        covariance[k, :, k] = (
            A @ covariance[k - 1, :, k - 1] @ A.mT + LINEAR.noise_covariance
        )
    whole = covariance.reshape(T * n, T * n)
    big_H = torch.block_diag(*[H] * T)
    seen = torch.isfinite(measured.flatten())
    big_H = big_H[seen]
    y = measured.flatten()[seen]
    S = big_H @ whole @ big_H.mT + torch.block_diag(*[R] * T)[seen][:, seen]
    gain = torch.linalg.solve(S, big_H @ whole).mT
    after = mean.flatten() + gain @ (y - big_H @ mean.flatten())
    whole = whole - gain @ big_H @ whole
    blocks = whole.reshape(T, n, T, n)
    return after.reshape(T, n), torch.stack([blocks[k, :, k] for k in range(T)])


@pytest.mark.parametrize("kind", [KalmanFilter.extended, KalmanFilter.unscented])
def test_filter_and_smoother_are_the_conditional_gaussian(kind):
    both = Measurement.of_states(2, [0, 1], [0.1, 0.3])
    _, inputs, measured = simulated(LINEAR, 12, 0, both)
    measured[3] = torch.nan
    measured[5, 0] = torch.nan
    measured[7, 1] = torch.nan
    measured[8, 0] = torch.inf
    run = kind(LINEAR, both).run(PRIOR, inputs, measured)
    measured[8, 0] = torch.nan
    mean, covariance = conditioned(
        inputs, measured, torch.eye(2, dtype=F), both.noise_covariance
    )
    assert torch.allclose(run.filtered.mean[-1], mean[-1], atol=1e-10)
    assert torch.allclose(run.filtered.covariance[-1], covariance[-1], atol=1e-10)
    smoothed = smooth(run)
    assert torch.allclose(smoothed.mean, mean, atol=1e-10)
    assert torch.allclose(smoothed.covariance, covariance, atol=1e-10)
    assert torch.isnan(run.innovations[3]).all()
    assert torch.isnan(run.innovations).sum() == 5


def test_a_late_measurement_counts_as_if_it_had_come_in_time():
    first = Measurement.of_states(2, [0], [0.1])
    filter = KalmanFilter(PENDULUM, first, Unscented(process_noise=True))
    _, inputs, measured = simulated(PENDULUM, 12, 1, first)
    in_time = filter.run(PRIOR, inputs, measured).filtered
    late = LateMeasurements(filter, PRIOR, longest=4)
    late.measure(measured[0])
    for k, u in enumerate(inputs):
        late.step(u)
        if k + 1 in (5, 8):
            continue  # comes two steps later, after a newer one
        late.measure(measured[k + 1])
        if k - 1 in (5, 8):
            late.measure(measured[k - 1], age=2)
    assert torch.allclose(late.belief.mean, in_time.mean[-1], atol=1e-12)
    assert torch.allclose(late.belief.covariance, in_time.covariance[-1], atol=1e-12)
    with pytest.raises(
        SettingError, match="age: must be at most 4 steps, which are remembered; got 5"
    ):
        late.measure(measured[0], age=5)


def test_a_late_filter_keeps_its_numbers_and_survives_mistakes():
    sensor = Measurement.of_states(2, [0], [0.1])
    filter = KalmanFilter.extended(LINEAR, sensor)
    _, inputs, measured = simulated(LINEAR, 8, 1, sensor)
    start = PRIOR.mean.numpy().copy()
    expected = LateMeasurements(filter, Gaussian.certain(start.copy()))
    reused = LateMeasurements(filter, Gaussian.certain(start))
    start[:] = 7.0
    # Buffers of a loop, which it goes on to use.
    input = np.zeros(1)
    y = torch.zeros(1, dtype=F)
    for k in range(8):
        expected.step(inputs[k])
        expected.measure(measured[k + 1])
        input[:] = inputs[k].numpy()
        y.copy_(measured[k + 1])
        reused.step(input)
        reused.measure(y)
        with pytest.raises(ShapeError):
            reused.measure([1.0, 2.0, 3.0], age=min(k, 3))
        with pytest.raises(DataError):
            reused.measure("high")
        with pytest.raises(ShapeError):
            reused.step([1.0, 2.0])
        with pytest.raises(DataError):
            reused.step([np.nan])
    expected.measure([0.3], age=5)
    reused.measure([0.3], age=5)
    assert torch.equal(reused.belief.mean, expected.belief.mean)
    assert torch.equal(reused.belief.covariance, expected.belief.covariance)


@pytest.mark.parametrize("kind", [KalmanFilter.extended, KalmanFilter.unscented])
def test_estimates_from_sine_and_cosine_are_consistent(kind):
    def bearing(x):
        return torch.stack([x[..., 0].sin(), x[..., 0].cos()], dim=-1)

    sensor = Measurement(2, 0.05**2 * torch.eye(2, dtype=F), bearing)
    check_model(sensor)
    filter = kind(PENDULUM, sensor)
    errors = []
    covariances = []
    for seed in range(12):
        x, inputs, measured = simulated(PENDULUM, 40, seed, sensor)
        measured[
            torch.rand(41, generator=torch.Generator().manual_seed(seed)) < 0.2
        ] = torch.nan
        run = filter.run(PRIOR, inputs, measured)
        errors.append(estimation_errors(run.filtered, x)[-1])
        covariances.append(run.filtered.covariance[-1])
    nees = normalized_errors(torch.stack(errors), torch.stack(covariances))
    assert nees.consistent, (nees.mean, nees.band)
    assert float(torch.stack(errors)[:, 0].square().mean().sqrt()) < 0.05
    whiteness, limit = autocorrelation(run.innovations, run.innovation_covariances)
    assert abs(whiteness) < 1.5 * limit


def test_an_angle_modulo_one_turn_corrects_by_the_short_way():
    sensor = Measurement.of_states(2, [0], [0.1], angles=[0])
    before = Gaussian(torch.tensor([3.1, 0.0], dtype=F), PRIOR.covariance)
    update = KalmanFilter.extended(PENDULUM, sensor).update(before, [-3.1])
    assert float(update.innovation[0]) == pytest.approx(2 * np.pi - 6.2)
    assert 3.1 < float(update.belief.mean[0]) < 3.2


def test_sigma_points_have_the_same_innovation_past_half_a_turn():
    sensor = Measurement.of_states(2, [0], [0.1], angles=[0])

    def wrapping(x):
        return torch.remainder(x[..., :1] + np.pi, 2 * np.pi) - np.pi

    shown = Measurement(2, sensor.noise_covariance, wrapping, angles=[0])
    for mean in (3.1, np.pi, -3.12, 9.4, 0.3):
        before = Gaussian(torch.tensor([mean, 0.0], dtype=F), PRIOR.covariance)
        y = wrapping(before.mean) - 0.1
        exact = KalmanFilter.extended(PENDULUM, sensor).update(before, y)
        for observer in (Unscented(), Unscented(alpha=0.5), MonteCarlo(20_000)):
            filter = KalmanFilter(PENDULUM, shown, observer=observer)
            update = filter.update(before, y)
            loose = 0.02 if isinstance(observer, MonteCarlo) else 1e-9
            assert float(update.innovation[0]) == pytest.approx(-0.1, abs=loose)
            assert torch.allclose(update.covariance, exact.covariance, rtol=loose)
            assert torch.allclose(update.belief.mean, exact.belief.mean, atol=loose)


@pytest.mark.parametrize("observer", [Unscented(), MonteCarlo(400, seed=3)])
def test_a_heading_that_nobody_knows_is_corrected_the_right_way(observer, caplog):
    """Points past half a turn of their sensor came back on the other side."""
    model = Known(lambda x, u: x, [0.01] * 4)
    sensor = Measurement.of_states(4, [0, 1], [0.01, 0.1], angles=[0])
    wide = Gaussian(
        torch.zeros(4, dtype=F), torch.diag(torch.tensor([2.0, 1, 1, 1], dtype=F) ** 2)
    )
    update = KalmanFilter(model, sensor, observer=observer).update(wide, [1.0, 0.5])
    exact = KalmanFilter.extended(model, sensor).update(wide, [1.0, 0.5])
    loose = 0.15 if isinstance(observer, MonteCarlo) else 1e-9
    assert torch.allclose(update.covariance, exact.covariance, rtol=loose, atol=loose)
    assert torch.allclose(update.belief.mean, exact.belief.mean, atol=loose)
    assert not caplog.records


def test_turns_that_cannot_be_counted_are_said_in_the_log(caplog):
    class Bearing(Measurement):
        """A name of its own: the log says it once for each."""

    shown = Bearing(1, 0.01 * torch.eye(1, dtype=F), lambda x: x.atan(), angles=[0])
    other = Bearing(1, 0.01 * torch.eye(1, dtype=F), lambda x: 2 * x, angles=[0])
    model = Known(lambda x, u: x, [0.01])
    prior = Gaussian(torch.zeros(1, dtype=F), torch.eye(1, dtype=F))
    for sensor, count in ((shown, 0), (other, 1), (other, 1)):
        KalmanFilter.unscented(model, sensor).update(prior, [0.1])
        assert len(caplog.records) == count
    assert "angle of Bearing spreads over more than half a turn" in caplog.text


def test_a_flight_across_half_a_turn_is_estimated_as_any_other():
    """The pendulum hangs at pi here: the sensor flips between both ends of its turn."""
    hanging = Known(
        lambda x, u: (
            pendulum(x - torch.tensor([np.pi, 0.0], dtype=F), u)
            + torch.tensor([np.pi, 0.0], dtype=F)
        ),
        [1e-3, 0.02],
    )
    turned = torch.tensor([np.pi, 0.0], dtype=F)
    sensor = Measurement.of_states(2, [0], [0.05], angles=[0])
    x, inputs, measured = simulated(PENDULUM, 30, 3, sensor)
    seen = torch.remainder(measured + 2 * np.pi, 2 * np.pi) - np.pi
    assert (seen.diff(dim=0).abs() > 3).any()
    away = Gaussian(PRIOR.mean + turned, PRIOR.covariance)
    for kind in (KalmanFilter.extended, KalmanFilter.unscented):
        here = kind(PENDULUM, sensor).run(PRIOR, inputs, measured)
        there = kind(hanging, sensor).run(away, inputs, seen)
        assert torch.allclose(here.innovations, there.innovations, atol=1e-7)
        assert torch.allclose(smooth(here).mean + turned, smooth(there).mean, atol=1e-7)
        errors = estimation_errors(there.filtered, x + turned - 2 * np.pi, [0])
        assert errors[:, 0].abs().max() < 0.3


def exact_update(P, H, R, mean, y):
    """Mean and covariance given measurements of independent noise, in rational
    numbers."""
    P, H, mean, y, R = (
        np.vectorize(Fraction, otypes=[object])(np.asarray(part, dtype=float))
        for part in (P, H, mean, y, R)
    )
    for h, value, r in zip(H, y, R, strict=True):
        C = P @ h
        S = h @ C + r
        if S:
            mean = mean + C * ((value - h @ mean) / S)
            P = P - np.outer(C, C) / S
    return mean.astype(float), P.astype(float)


def random_covariance(n, scale):
    root = np.random.default_rng(n).normal(size=(n, n))
    return scale * (root @ root.T)


WIDE = {
    "1e14": (1e14 * np.eye(1), [[1.0]], [1.0]),
    "1e16": (1e16 * np.eye(1), [[1.0]], [1.0]),
    "3e20": (3e20 * np.eye(1), [[1.0]], [1.0]),
    "two sensors of one state": (3e16 * np.eye(1), [[1.0], [2.0]], [1.0, 3.0]),
    "ten sensors of one state": (np.diag([1e14, 1.0]), [[1.0, 0.0]] * 10, [1.0] * 10),
    "wide beside narrow": (np.diag([3e16, 2.0]), [[1.0, 1.0], [1.0, -2.0]], [1.0, 0.3]),
    "only a sum": (np.diag([3e14, 7e14]), [[1.0, 1.0]], [1.0]),
    "correlated": (random_covariance(6, 1e14), np.eye(6)[:4], [1.0] * 4),
    "correlated, all": (random_covariance(6, 1e16), np.eye(6), [1.0] * 6),
    "nearly singular": ([[1.0, 1 - 1e-12], [1 - 1e-12, 1.0]], [[1.0, 0.0]], [1e-6]),
    "nearly singular, difference": (
        [[1.0, 1 - 1e-12], [1 - 1e-12, 1.0]],
        [[1.0, -1.0]],
        [1e-8],
    ),
    "singular": (
        7 * np.outer([1.0, 2.0, -3.0], [1.0, 2.0, -3.0]),
        [[1.0, 0.0, 0.0]],
        [1e-3],
    ),
    "singular and wide": (3e14 * np.ones((2, 2)), [[1.0, 0.0]], [1.0]),
    "Hilbert's matrix": (
        1 / (np.arange(5)[:, None] + np.arange(5) + 1),
        np.eye(5)[:3],
        [1e-6] * 3,
    ),
    "perfect": (random_covariance(4, 1.0), [[1.0, 0.0, 0.0, 0.0]], [0.0]),
    "perfect, thrice": (
        random_covariance(4, 1.0),
        [[1, 2, 0, 0], [2, 4, 0, 0], [1, 2, 0, 0]],
        [0.0] * 3,
    ),
    "perfect and noisy": (
        random_covariance(4, 1.0),
        [[1, 2, 0.3, 0], [1, 2, 0.3, 0], [0, 1, 1, 1]],
        [0.0, 1e-3, 1e-5],
    ),
    "unlike scales": (
        random_covariance(4, 1.0),
        [[1, 2, 0.3, 0], [0, 2, 0.3, 1], [0, 1, 1, 1]],
        [1e-12, 1.0, 1e12],
    ),
    "unlike units": (
        random_covariance(4, 1e3),
        [[1e6, 2e6, 0, 0], [0, 2e-6, 1e-6, 1e-6]],
        [1e-2, 1e-18],
    ),
    "certain": (np.zeros((2, 2)), [[1.0, 1.0], [1.0, 0.0]], [0.0, 0.0]),
}


@pytest.mark.parametrize("name", WIDE)
@pytest.mark.parametrize("kind", [KalmanFilter.extended, KalmanFilter.unscented])
def test_an_update_is_exact_for_any_prior_and_sensors(kind, name):
    P, H, R = (np.asarray(part, dtype=float) for part in WIDE[name])
    rng = np.random.default_rng(0)
    n = len(P)
    mean = rng.normal(size=n)
    y = H @ mean + rng.normal(size=len(H)) * np.sqrt(np.diag(H @ P @ H.T) + R)
    y = np.full_like(y, (H @ mean).mean()) if name == "certain" else y
    expected_mean, expected = exact_update(P, H, R, mean, y)
    rows = torch.from_numpy(H)
    still = Known(lambda x, u: x, [0.1] * n)
    sensor = Measurement(n, torch.from_numpy(np.diag(R)), lambda x: x @ rows.mT)
    prior = Gaussian(torch.from_numpy(mean), torch.from_numpy(P))
    posterior = kind(still, sensor).update(prior, y).belief
    deviations = np.sqrt(np.diag(expected))
    covariance = posterior.covariance.numpy()
    scale = np.outer(deviations, deviations) + 1e-15 * np.abs(P)
    assert np.all(np.abs(covariance - expected) <= 1e-6 * scale)
    missed = np.abs(posterior.mean.numpy() - expected_mean)
    assert np.all(missed <= 1e-5 * deviations + 1e-13 * np.abs(expected_mean))
    assert np.array_equal(covariance, covariance.T)
    assert np.diag(covariance).min() >= 0.0
    assert np.linalg.eigvalsh(covariance).min() >= -1e-15 * np.abs(covariance).max()


def test_a_smoother_keeps_its_digits_under_a_flat_prior():
    """Ten measurements of a position say what a velocity of unknown size was at the
    start."""
    first = Measurement.of_states(2, [0], [0.1])
    track = Known(
        lambda x, u: x @ torch.tensor([[1.0, 0.1], [0.0, 1.0]], dtype=F).mT,
        [1e-3, 1e-3],
    )
    y = torch.linspace(0, 1, 11, dtype=F)[:, None]
    inputs = torch.zeros(10, 1, dtype=F)
    runs = [
        smooth(
            KalmanFilter.extended(track, first).run(
                Gaussian(torch.zeros(2, dtype=F), scale * torch.eye(2, dtype=F)),
                inputs,
                y,
            )
        )
        for scale in (1e6, 1e10)
    ]
    assert torch.allclose(runs[0].covariance, runs[1].covariance, rtol=1e-4)
    assert torch.allclose(runs[0].mean, runs[1].mean, atol=1e-5)
    assert (torch.linalg.eigvalsh(runs[1].covariance) > 0).all()


def test_negative_weights_take_no_noise_from_a_sensor():
    n = 6
    observer = Unscented(kappa=3.0 - n)
    squares = Measurement(
        n, torch.eye(1, dtype=F), lambda x: x.square().sum(-1, keepdim=True)
    )
    plant = Known(lambda x, u: x, [0.1] * n)
    prior = Gaussian(
        torch.tensor([3.0] + [0.0] * (n - 1), dtype=F), torch.eye(n, dtype=F)
    )
    update = KalmanFilter(plant, squares, observer=observer).update(prior, [9.0])
    # To first order y = 6 x_1: what the points find of Cov[y], 18, is less than 36.
    assert update.belief.covariance[0, 0].item() == pytest.approx(1 - 36 / 37)
    assert update.covariance.item() == pytest.approx(37)


@pytest.mark.parametrize("variance", [1e-8, 1e-12, 1e-16, 1e-20, 1e-26])
def test_contradictory_good_sensors_move_other_states_little(variance):
    P = random_covariance(5, 1.0)
    H = [[1, 2, 0.3, 0, 1], [1, 2, 0.3, 0, 1]]
    rows = torch.tensor(H, dtype=F)
    mean = np.zeros(5)
    y = [1.0, 1.5]
    expected, covariance = exact_update(P, H, [variance] * 2, mean, y)
    sensor = Measurement(5, variance * torch.eye(2, dtype=F), lambda x: x @ rows.mT)
    still = Known(lambda x, u: x, [0.1] * 5)
    prior = Gaussian(torch.from_numpy(mean), torch.from_numpy(P))
    posterior = KalmanFilter.extended(still, sensor).update(prior, y).belief
    missed = np.abs(posterior.mean.numpy() - expected)
    assert missed.max() < 0.02  # the sensors differ by 0.5
    assert np.allclose(posterior.covariance, covariance, atol=1e-12)


def test_correlated_noise_of_precise_sensors_is_taken_as_it_is():
    R = torch.tensor([[1e-20, 1e-20], [1e-20, 1.0]], dtype=F)
    H = torch.tensor([[1.0, 1.0], [1.0, 0.0]], dtype=F)
    sensor = Measurement(2, R, lambda x: x @ H.mT)
    y = torch.tensor([1.0, 0.4], dtype=F)
    posterior = KalmanFilter.extended(LINEAR, sensor).update(PRIOR, y).belief
    # The second measurement less the first has a noise of its own.
    apart = [[1.0, 1.0], [0.0, -1.0]]
    mean, covariance = exact_update(
        PRIOR.covariance, apart, [1e-20, 1.0], PRIOR.mean, [1.0, -0.6]
    )
    assert np.allclose(posterior.mean, mean, rtol=1e-9)
    assert np.allclose(posterior.covariance, covariance, rtol=1e-9, atol=1e-18)


def test_many_beliefs_are_updated_at_once():
    sensor = Measurement.of_states(2, [0, 1], [0.1, 0.2])
    filter = KalmanFilter.extended(PENDULUM, sensor)
    y = torch.tensor([[0.4, torch.nan], [0.3, 0.2], [torch.nan, torch.nan]], dtype=F)
    many = Gaussian(PRIOR.mean.expand(3, 2), PRIOR.covariance.expand(3, 2, 2))
    together = filter.update(many, y)
    for k in range(3):
        alone = filter.update(PRIOR, y[k]).belief
        assert torch.allclose(together.belief.mean[k], alone.mean, atol=1e-13)
        assert torch.allclose(
            together.belief.covariance[k], alone.covariance, atol=1e-13
        )
    assert torch.allclose(together.belief.mean[2], PRIOR.mean)


def test_an_unmeasured_disturbance_is_estimated_through_a_delay():
    disturbed = DisturbedModel(LINEAR, torch.tensor([[0.0], [1.0]], dtype=F), [0.001])
    model = DelayedModel(disturbed, 2)
    sensor = Measurement.of_states(5, [0], [0.01])
    filter = KalmanFilter.extended(model, sensor)
    x = PRIOR.mean
    queue = torch.zeros(2, 1, dtype=F)
    belief = model.augmented(disturbed.augmented(PRIOR, [1.0]), queue)
    for k in range(80):
        u = torch.sin(torch.tensor([0.3 * k], dtype=F))
        x = LINEAR.predict(x, queue[0]).mean + torch.tensor([0.0, 0.2])
        queue = torch.cat([queue[1:], u[None]])
        belief = filter.update(filter.predict(belief, u), x[:1]).belief
    assert float(belief.mean[2]) == pytest.approx(0.2, abs=0.01)
    assert torch.allclose(belief.mean[3:], queue[:, 0])
    assert 0 < float(belief.covariance[2, 2]) < 0.1


def test_a_model_without_inputs_is_filtered_without_any():
    model = KnownModel(lambda x, u: x @ A.mT, 2, 0)
    filter = KalmanFilter.extended(model, Measurement.of_states(2, [0], [0.1]))
    expected = Linearization()(model, PRIOR)
    late = LateMeasurements(filter, PRIOR)
    for belief in (filter.predict(PRIOR), filter.predict(PRIOR, None), late.step()):
        assert torch.equal(belief.mean, expected.mean)
        assert torch.equal(belief.covariance, expected.covariance)


def test_errors_of_the_wrong_size_are_inconsistent():
    errors = torch.from_numpy(np.random.default_rng(0).normal(size=(200, 3)))
    P = torch.eye(3).expand(200, 3, 3)
    assert normalized_errors(errors, P).consistent
    assert normalized_errors(errors, P / 1.5).mean == pytest.approx(
        1.5 * normalized_errors(errors, P).mean
    )
    assert not normalized_errors(errors, P / 1.5).consistent
    assert not normalized_errors(errors, 1.5 * P).consistent
    wide = normalized_errors(errors, P, independent=20)
    assert wide.band[0] < normalized_errors(errors, P).band[0] < 1 < wide.band[1]
    errors[5] = torch.nan
    errors[6, 0] = torch.nan
    assert normalized_errors(errors, P).degrees.sum() == 596


@pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param(
            "cuda",
            marks=pytest.mark.skipif(
                not torch.cuda.is_available(), reason="needs CUDA"
            ),
        ),
    ],
)
def test_errors_of_a_graph_or_a_gpu_are_judged_as_their_numbers(device):
    numbers = torch.from_numpy(np.random.default_rng(0).normal(size=(50, 2)))
    covariances = torch.eye(2, dtype=F, device=device).expand(50, 2, 2)
    errors = numbers.to(device, copy=True).requires_grad_()
    expected = normalized_errors(numbers, covariances.cpu())
    assert normalized_errors(errors, covariances).mean == expected.mean
    white = autocorrelation(numbers, covariances.cpu())
    assert autocorrelation(errors, covariances) == white
    belief = Gaussian(errors.detach(), covariances)
    assert torch.equal(estimation_errors(belief, numbers.numpy()).cpu(), 0 * numbers)


def test_a_batch_of_one_is_projected_as_its_member():
    eps = torch.finfo(F).eps
    covariance = torch.tensor([[1.0, 1 + 24 * eps], [1 + 24 * eps, 1.0]], dtype=F)
    shown = torch.zeros(2, 2, dtype=F)
    alone = unexplained_covariance(covariance, shown)
    in_batch = unexplained_covariance(covariance[None], shown[None])
    assert torch.equal(in_batch[0], alone)


def test_white_innovations_of_correlated_sensors_are_white():
    S = np.array([[1.0, 0.95, 0.0], [0.95, 1.0, 0.0], [0.0, 0.0, 0.0]])
    S[2, :2] = S[:2, 2] = 0.4
    S[2, 2] = 2.0
    L = np.linalg.cholesky(S)
    beyond = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        innovations = rng.normal(size=(120, 3)) @ L.T
        innovations[rng.random((120, 3)) < 0.1] = np.nan
        value, limit = autocorrelation(innovations, np.tile(S, (120, 1, 1)))
        beyond += abs(value) > limit
    assert beyond <= 11  # 5 are expected; by deviations alone 13 are
    # Two perfect sensors of one state say what one says.
    e = np.random.default_rng(0).normal(size=(50, 1))
    alone = autocorrelation(e, np.ones((50, 1, 1)))
    assert autocorrelation(np.hstack([e, e]), np.ones((50, 2, 2))) == alone


class NoiseUnsaid:
    """Adds no noise, and has no attribute that says so."""

    def propagate(self, model, belief, input=None):
        return Linearization(False).propagate(model, belief, input)


def of_values():
    ones = torch.ones(2, dtype=F)
    data = torch.eye(3, dtype=F)
    return GPPosterior.from_hyperparameters(
        data, data[:, :2], torch.ones(2, 3, dtype=F), ones, 0.1 * ones, 1, "value"
    )


@pytest.mark.parametrize(
    ("make", "error", "rule"),
    [
        (
            lambda m: normalized_errors(np.ones((3, 2)), np.ones((3, 2, 2))),
            DataError,
            "must be positive definite; got one that is not",
        ),
        (
            lambda m: autocorrelation(np.ones((5, 2)), np.ones((5, 2, 2)), lag=0),
            SettingError,
            "lag: must be a whole number, 1 or more; got 0",
        ),
        (
            lambda m: autocorrelation(np.ones((5, 2)), np.ones((5, 2))),
            ShapeError,
            r"need covariances \(T, p, p\); got \(5, 2\) and \(5, 2\)",
        ),
        (
            lambda m: KalmanFilter(
                LINEAR, replace(m, noise_covariance=m.noise_covariance.float())
            ),
            SettingError,
            "measurement: must be torch.float64 on cpu like the model",
        ),
        (
            lambda m: replace(m, noise_covariance=torch.tensor([[-1e-4]], dtype=F)),
            SettingError,
            "noise_covariance: must have variances of zero or more",
        ),
        (
            lambda m: replace(m, noise_covariance=torch.tensor([[np.nan]], dtype=F)),
            SettingError,
            "noise_covariance: must hold finite real numbers",
        ),
        (
            lambda m: replace(
                m, noise_covariance=torch.tensor([[1.0, 0.5], [0.4, 1.0]], dtype=F)
            ),
            SettingError,
            "noise_covariance: must be symmetric",
        ),
        (
            lambda m: replace(
                m, noise_covariance=torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=F)
            ),
            SettingError,
            "must be positive semidefinite; .* eigenvalue -1",
        ),
        (
            lambda m: LateMeasurements(LINEAR, PRIOR),
            SettingError,
            r"filter: must be KalmanFilter\(...\); got Known",
        ),
        (
            lambda m: KalmanFilter(LINEAR, Measurement.of_states(3, [0], [0.1])),
            SettingError,
            "measurement: must be of",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m, Linearization(False)),
            SettingError,
            "propagator: must add the proc",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m, NoiseUnsaid()),
            SettingError,
            "propagator: must add .* and say so; got NoiseUnsaid without process_noise",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m, MeanEquivalence()),
            SettingError,
            "propagator: must say how .* depends on the state.*; got MeanEquivalence",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m, observer=MeanEquivalence()),
            SettingError,
            "observer: must say how .* depends on the state.*; got MeanEquivalence",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m, observer="exact"),
            SettingError,
            "observer: must",
        ),
        (
            lambda m: KalmanFilter(of_values(), m),
            SettingError,
            "model: must predict the next state; got GPs with predicts='value'",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m, MeanEquivalence(False)),
            SettingError,
            "propagator: must add the proc",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m).update(PRIOR, [0.0, 1.0]),
            ShapeError,
            r"shape \(1,\); got \(2,\)",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m).run(
                PRIOR, np.zeros((2, 1)), np.zeros((2, 1))
            ),
            ShapeError,
            "got 2 and 2",
        ),
        (
            lambda m: Measurement.of_states(2, [2], [0.1]),
            SettingError,
            "states: must be a list of indices",
        ),
        (
            lambda m: Measurement.of_states(2, [1], [-0.1]),
            SettingError,
            "std: must be a number",
        ),
        (
            lambda m: Measurement(2, torch.eye(2), lambda x: x[..., :1]).predict(
                PRIOR.mean
            ),
            ShapeError,
            "must give",
        ),
        (
            lambda m: normalized_errors([[np.nan]], [[[1.0]]]),
            DataError,
            "no error is finite",
        ),
        (
            lambda m: normalized_errors([[1.0]], [[[-1.0]]]),
            DataError,
            "must be positive definite",
        ),
        (
            lambda m: normalized_errors([[1.0]], [[[np.nan]]]),
            DataError,
            "must be finite",
        ),
        (
            lambda m: normalized_errors([[1.0]], [[[1.0]]], level=95),
            SettingError,
            "level: must lie between 0 and 1",
        ),
        (
            lambda m: normalized_errors([[1.0]], [[[1.0]]], independent=0),
            SettingError,
            "independent: must be a whole number",
        ),
        (
            lambda m: normalized_errors([[1.0]], [[[1.0]]], independent=2),
            SettingError,
            "independent: must be at most 1, the errors; got 2",
        ),
        (
            lambda m: autocorrelation(np.zeros((5, 1)), np.ones((5, 1, 1))),
            DataError,
            "not all zero",
        ),
        (
            lambda m: KalmanFilter(LINEAR, m).run(
                np.zeros(2), np.zeros((2, 1)), np.zeros((3, 1))
            ),
            SettingError,
            "belief: must be a Gaussian",
        ),
    ],
)
def test_misuse_is_refused(make, error, rule):
    with pytest.raises(error, match=rule):
        make(Measurement.of_states(2, [0], [0.1]))


def test_the_figure_shows_measured_innovations_and_those_outside():
    sensor = Measurement.of_states(2, [0, 1], [0.1, 0.3])
    _, inputs, measured = simulated(LINEAR, 60, 0, sensor)
    measured[:6, 1] = torch.nan
    run = KalmanFilter.extended(LINEAR, sensor).run(PRIOR, inputs, measured)
    axes = innovations_figure(run, 0.1, ["a", "b"]).axes
    points = [axis.lines[0].get_ydata() for axis in axes]
    assert [len(part) for part in points] == [61, 55]
    white = run.innovations[:, 0] / run.innovation_covariances[:, 0, 0].sqrt()
    assert np.allclose(points[0], white)
    assert "10 % missing" in axes[1].lines[0].get_label()
    with pytest.raises(SettingError, match="names: must be 2, one a measured value"):
        innovations_figure(run, names=["a"])
    run.innovation_covariances[:6] = 0.0  # known exactly beforehand
    label = innovations_figure(run).axes[0].lines[0].get_label()
    assert ", 0 % missing" in label


def test_labels_that_two_sensors_share_are_taken_as_they_stand():
    named = Known(LINEAR.function, [0.05, 0.1])
    named.signals = Signals(["angle", "rate"])
    sensor = Measurement.of_states(2, [0, 0, 1], [0.1, 0.2, 0.1])
    labels = ["angle", "angle", "rate"]
    table = pd.DataFrame([[0.1, 0.2, 0.3]] * 3, columns=labels)
    plain = KalmanFilter(LINEAR, sensor).run(PRIOR, np.zeros((2, 1)), table.to_numpy())
    found = KalmanFilter(named, sensor).run(PRIOR, np.zeros((2, 1)), table)
    assert torch.equal(found.filtered.mean, plain.filtered.mean)
