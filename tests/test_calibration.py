"""Calibration is right for known uncertainty and tells of a wrong one."""

import io
import math
from dataclasses import dataclass
from functools import partial

import pytest
import torch

from gpmpc.calibration import CHUNK, Calibration, Recording, calibrate
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, Transitions
from gpmpc.metrics import binomial_interval
from gpmpc.models import DelayedModel, KnownModel
from gpmpc.plotting import calibration_figure
from gpmpc.propagation import Linearization, MeanEquivalence

A = torch.tensor([[0.9, 0.2], [-0.3, 0.8]])
B = torch.tensor([[0.0], [0.5]])
Q = torch.diag(torch.tensor([0.04, 0.01]))
NOISE = torch.diag(torch.tensor([0.01, 0.09]))

CPU = torch.device("cpu")


@dataclass(frozen=True)
class LinearGaussian:
    """x+ = A x + B u + w, w ~ N(0, Q); what its user does not know is nothing."""

    A: torch.Tensor = A
    Q: torch.Tensor = Q
    noise_covariance: torch.Tensor = NOISE
    state_dim: int = 2
    input_dim: int = 1
    output_dim: int = 2
    dtype: torch.dtype = torch.float64
    device: torch.device = CPU

    def predict(self, state, input=None):
        mean = state @ self.A.mT + input @ B.mT
        return Gaussian(mean, self.Q.expand(*mean.shape, 2))

    def predict_with_jacobian(self, state, input=None):
        belief = self.predict(state, input)
        return (
            belief,
            self.A.expand(*state.shape[:-1], 2, 2),
            B.expand(*state.shape[:-1], 2, 1),
        )


noiseless = partial(LinearGaussian, noise_covariance=0 * NOISE)


def value_model(n, m, outputs, predicts="value"):
    generator = torch.Generator().manual_seed(0)
    ones = torch.ones(outputs)
    features = torch.randn(12, n + m, generator=generator)
    targets = 0.3 * torch.randn(12, outputs, generator=generator)
    return GPPosterior.from_hyperparameters(
        features, targets, torch.ones(outputs, n + m), ones, 0.01 * ones, m, predicts
    )


def runs(count, steps, noisy=True):
    """Makes runs with an exact first state and measured others.

    One start for each run would be exact.
    """
    recordings = []
    for _ in range(count):
        states = [torch.randn(2)]
        inputs = torch.randn(steps, 1)
        for u in inputs:
            states.append(A @ states[-1] + B @ u + Q.sqrt() @ torch.randn(2))
        states = torch.stack(states)
        if noisy:
            states[1:] += torch.randn(steps, 2) @ NOISE.sqrt()
        recordings.append(Recording(states, inputs))
    return recordings


def exact_covariances(steps):
    S = torch.zeros(2, 2)
    covariances = []
    for _ in range(steps):
        S = A @ S @ A.T + Q
        covariances.append(S)
    return torch.stack(covariances)


def test_the_true_model_is_calibrated_at_every_step_and_level():
    count = 400
    levels = (0.5, 0.9, 0.95)
    # Without noise every start is exact; the recordings' starts overlap, hence the
    # generous bound.
    calibration = calibrate(
        noiseless(), runs(count, 8, noisy=False), Linearization(), 6, levels
    )
    assert calibration.samples.tolist() == [count * (8 - k) for k in range(6)]
    for j, level in enumerate(levels):
        error = math.sqrt(level * (1 - level) / count)
        assert float((calibration.coverage[:, :, j] - level).abs().max()) < 4 * error
    variance = exact_covariances(6).diagonal(dim1=-2, dim2=-1)
    assert torch.allclose(calibration.rmse, variance.sqrt(), rtol=0.15)
    assert torch.allclose(
        calibration.nlpd, ((2 * math.pi * variance).log() + 1) / 2, atol=0.15
    )


def test_observations_are_calibrated_with_their_noise():
    recordings = runs(800, 1)
    arguments = {"propagator": Linearization(), "horizon": 1, "levels": (0.9,)}
    calibration = calibrate(LinearGaussian(), recordings, **arguments)
    assert float((calibration.coverage - 0.9).abs().max()) < 0.04
    assert bool(
        (
            calibrate(noiseless(), recordings, **arguments).coverage
            < calibration.coverage - 0.04
        ).all()
    )


def test_noise_of_the_process_adds_up_and_counts_once():
    """x+ = A x + B u + w: what a propagator adds at every step is what happens."""
    recordings = runs(200, 5, noisy=False)
    learned = LinearGaussian(Q=0 * Q, noise_covariance=Q)
    calibration = calibrate(learned, recordings, Linearization(), 5, (0.95,))
    exact = calibrate(noiseless(), recordings, Linearization(), 5, (0.95,))
    assert torch.allclose(calibration.width, exact.width)
    assert torch.equal(calibration.coverage, exact.coverage)
    assert float((calibration.coverage - 0.95).abs().max()) < 0.04
    assert calibration.noise == "the model's noise at every step"
    latent = Linearization(process_noise=False)
    careless = calibrate(learned, recordings, latent, 5, (0.95,))
    assert torch.allclose(careless.width[0], exact.width[0])
    assert float(careless.coverage[4].max()) < 0.8
    assert "at the last step alone" in careless.noise


def test_sensors_that_are_known_make_starts_and_ends_uncertain():
    sensors = NOISE.diagonal().sqrt().tolist()
    recordings = runs(200, 5)
    for recording in recordings:  # their first state is seen by the sensors, too
        recording.states[0] += torch.randn(2) @ NOISE.sqrt()
    model = LinearGaussian(Q=0 * Q, noise_covariance=Q)
    for horizon in (1, 5):
        calibration = calibrate(
            model,
            recordings,
            Linearization(),
            horizon,
            (0.95,),
            measurement_noise=sensors,
        )
        assert float((calibration.coverage - 0.95).abs().max()) < 0.04
        assert "the sensors' at the first and the last" in calibration.noise
    with pytest.raises(SettingError, match="measurement_noise: must be a list of 2"):
        calibrate(model, recordings, horizon=1, measurement_noise=[0.1])
    with pytest.raises(SettingError, match="measurement_noise"):
        calibrate(model, recordings, horizon=1, measurement_noise=[0.1, -1.0])


def test_false_confidence_shows():
    recordings = runs(100, 8, noisy=False)
    honest = calibrate(noiseless(), recordings, Linearization(), 5, (0.9,))
    overconfident = calibrate(
        noiseless(Q=Q / 9), recordings, Linearization(), 5, (0.9,)
    )
    forgetful = calibrate(noiseless(), recordings, MeanEquivalence(), 5, (0.9,))
    biased = calibrate(noiseless(A=0.8 * A), recordings, Linearization(), 5, (0.9,))
    assert float(overconfident.coverage.max()) < 0.6
    assert bool((overconfident.nlpd > honest.nlpd).all())
    assert torch.equal(
        forgetful.coverage[0], honest.coverage[0]
    )  # one step ahead there is nothing to forget
    assert float(forgetful.coverage[4].max()) < float(honest.coverage[4].min())
    assert bool((biased.rmse > honest.rmse).all())


def test_the_batch_of_all_starts_is_the_loop_over_them():
    recordings = [*runs(3, 7), *runs(2, 3), *runs(1, CHUNK)]
    calibration = calibrate(LinearGaussian(), recordings, Linearization(), 5)
    k = 4
    errors = []
    for recording in recordings:
        for t in range(len(recording) - k + 1):
            belief = Gaussian(recording.states[t], torch.zeros(2, 2))
            for step in range(k):
                belief = Linearization()(
                    LinearGaussian(), belief, recording.inputs[t + step]
                )
            errors.append(recording.states[t + k] - belief.mean)
    assert int(calibration.samples[k - 1]) == len(errors)
    assert torch.allclose(
        calibration.rmse[k - 1], torch.stack(errors).square().mean(0).sqrt()
    )


def test_a_posterior_in_float32_is_calibrated_by_moment_matching():
    features = torch.rand(30, 3)
    gp = GPPosterior.from_hyperparameters(
        features,
        features[:, :2].sin(),
        torch.ones(2, 3),
        torch.ones(2),
        torch.full((2,), 1e-2),
        1,
    )
    recordings = runs(2, 5)
    double, single = (
        calibrate(each, recordings, horizon=3)
        for each in (gp, gp.to(dtype=torch.float32))
    )
    assert double.rmse.dtype == single.rmse.dtype == torch.float64
    assert torch.allclose(double.rmse, single.rmse, rtol=1e-3)


def example():
    return Calibration(
        ("angle", "rate"),
        (0.5, 0.95),
        torch.tensor([20, 10]),
        torch.tensor([[0.1, 0.2], [0.3, 0.4]]),
        torch.tensor([[1.0, 2.0], [3.0, math.inf]]),
        torch.tensor([[[0.5, 0.9], [0.6, 1.0]], [[0.4, 0.8], [0.3, 0.7]]]),
        torch.tensor([[1.0, 1.1], [1.2, 1.3]]),
        torch.tensor([20, 5]),
    )


def test_the_report_is_a_data_frame():
    frame = example().to_pandas()
    assert list(frame.columns) == [
        "step",
        "state",
        "samples",
        "rmse",
        "nlpd",
        "width",
        "coverage_0.5",
        "coverage_0.95",
    ]
    assert frame.iloc[1].tolist() == [
        1,
        "rate",
        20,
        pytest.approx(0.2),
        2.0,
        1.1,
        pytest.approx(0.6),
        1.0,
    ]
    assert frame.iloc[3].tolist() == [
        2,
        "rate",
        10,
        pytest.approx(0.4),
        math.inf,
        1.3,
        pytest.approx(0.3),
        pytest.approx(0.7),
    ]
    assert frame["state"].tolist() == ["angle", "rate"] * 2


def test_a_coverages_interval_is_exact_and_counts_no_overlaps():
    assert example().coverage_interval(0, 0, 1) == binomial_interval(18, 20)
    assert example().coverage_interval(1, 0, 1) == binomial_interval(4, 5)
    calibration = calibrate(
        LinearGaussian(), [*runs(3, 7), *runs(2, 3)], Linearization(), 4
    )
    assert calibration.independent.tolist() == [27, 11, 8, 3]
    same = runs(300, 5, noisy=False)
    honest, narrow = (
        calibrate(noiseless(Q=noise), same, Linearization(), 5) for noise in (Q, Q / 9)
    )
    assert honest.width.numpy() == pytest.approx(1.0, abs=0.2)
    assert (narrow.width / honest.width).numpy() == pytest.approx(1 / 3)


def test_the_figure_has_states_as_columns_and_measures_as_rows():
    figure = calibration_figure(example())
    assert len(figure.axes) == 6
    assert [axis.get_title() for axis in figure.axes[:2]] == ["angle", "rate"]
    assert {text.get_text() for text in figure.axes[1].texts} == {"50 %", "95 %"}
    figure.savefig(io.BytesIO(), format="png")


def test_transitions_fall_apart_into_recordings():
    data = Transitions(
        torch.tensor([[0.0], [1.0], [5.0], [6.0]]),
        torch.arange(4.0)[:, None],
        torch.tensor([[1.0], [2.0], [6.0], [7]]),
    )
    first, second = Recording.chained(data)
    assert first.states.ravel().tolist() == [0, 1, 2]
    assert second.states.ravel().tolist() == [5, 6, 7]
    assert second.inputs.ravel().tolist() == [2, 3]


def test_round_off_ends_no_run():
    states = torch.randn(5, 2)
    next_states = states[1:] * (1 + 1e-15)
    (run,) = Recording.chained(Transitions(states[:-1], states[1:, :1], next_states))
    assert len(run) == 4


@pytest.mark.parametrize("delays", [(1.0, 1.0), (1.5,)])
def test_delays_in_float32_are_calibrated_as_in_float64(delays):
    widths = []
    for dtype in (torch.float32, torch.float64):
        model = value_model(2, 1, 2, predicts="difference").to(dtype=dtype)
        for delay in delays:
            model = DelayedModel(model, delay)
        torch.manual_seed(0)
        calibration = calibrate(model, runs(1, 12), Linearization(), horizon=2)
        widths.append(calibration.width)
    assert torch.allclose(widths[0], widths[1], rtol=1e-3)


def test_what_has_no_variance_is_said_in_the_log(caplog):
    model = noiseless(Q=torch.diag(torch.tensor([0.0, 0.01])))
    calibrate(model, runs(1, 4), MeanEquivalence(), names=["angle", "rate"], horizon=2)
    (line,) = caplog.messages
    assert "predictions of angle have no variance" in line


def test_the_noise_is_called_by_what_holds_it():
    arguments = {"recordings": runs(1, 4), "horizon": 1}
    varying = Linearization(process_noise=False)
    for propagator in (Linearization(), varying):
        noise = calibrate(noiseless(), propagator=propagator, **arguments).noise
        assert noise == "what the model itself predicts at every step"
    known = KnownModel(lambda x, u: x + u.sum(dim=-1, keepdim=True), 2, 1)
    assert calibrate(known, **arguments).noise == "no noise, as the model has none"


def test_misuse_is_refused_with_the_rule():
    model = LinearGaussian()
    recording = runs(1, 4)
    for change, error, message in (
        (
            {"horizon": 5},
            SettingError,
            "horizon: must be at most 4 steps, the longest recording; got 5",
        ),
        (
            {"horizon": 0},
            SettingError,
            "horizon: must be a whole number, 1 or more; got 0",
        ),
        (
            {"horizon": 1, "levels": (95,)},
            SettingError,
            r"levels: must be one or more between 0 and 1; got \(95,\)",
        ),
        (
            {"horizon": 1, "levels": ()},
            SettingError,
            r"one or more between 0 and 1; got \(\)",
        ),
        ({"horizon": 1, "names": ["a"]}, ShapeError, "names must name 2 states; got 1"),
        ({"horizon": 1, "recordings": []}, ShapeError, "got no recording"),
        (
            {"horizon": 1, "model": value_model(2, 1, 2)},
            SettingError,
            "model: must predict the next state; got GPs with predicts='value'",
        ),
        (
            {
                "horizon": 1,
                "recordings": Recording(torch.zeros(3, 1), torch.zeros(2, 1)),
            },
            ShapeError,
            r"the model's 2 states and 1 inputs; got \{\(1, 1\)\}",
        ),
    ):
        with pytest.raises(error, match=message):
            calibrate(
                **(
                    {
                        "model": model,
                        "recordings": recording,
                        "propagator": Linearization(),
                    }
                    | change
                )
            )
    with pytest.raises(
        ShapeError, match=r"inputs \(K, m\), K of 1 or more; got \(3, 2\) and \(3, 1\)"
    ):
        Recording(torch.zeros(3, 2), torch.zeros(3, 1))
    with pytest.raises(DataError, match="inputs of a recording must be finite"):
        Recording(torch.zeros(3, 2), torch.full((2, 1), torch.nan))
