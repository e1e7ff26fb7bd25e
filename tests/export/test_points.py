"""Fewer points decide nearly as all do, and as many are chosen as a budget holds."""

import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.exceptions import Diverged, SettingError
from gpmpc.export import (
    Budget,
    Estimator,
    Footprint,
    Question,
    choose_points,
    export_c,
    measure_footprint,
    with_points,
)
from gpmpc.export._price import flight_of, ratio_of_errors
from gpmpc.gaussian import Gaussian
from gpmpc.gp import SparseTrainer, Transitions
from gpmpc.models import DelayedModel, KnownModel, ResidualModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Dropout, ModelLoop, closed_loop, rehearse
from gpmpc.systems import System
from tests.export.test_decisions import pendulum_with_features
from tests.mpc.small_models import pendulum_posterior

GP = pendulum_posterior()
PLANT = pendulum_posterior(size=60, seed=1)
PROBLEM = Problem(Tracking([1.0, 0.1], [0.05]), Box([-2.0], [2.0]))


def pendulum(model: Any = GP, problem=PROBLEM):
    return GPMPC(
        model,
        Linearization(),
        problem,
        4,
        [0.0],
        prediction=PredictionSettings(covariance="none"),
        iterations=1,
    )


def fly(controller):
    loop = ModelLoop(PLANT, Linearization(), time_step=0.2)
    start = Gaussian.certain(np.array([1.0, 0.0]))
    return closed_loop(loop, controller, [0.0, 0.0], start, 10)


def queries(count=200):
    generator = torch.Generator().manual_seed(1)
    states = (2 * torch.rand(count, 2, generator=generator) - 1) * 2.0
    return states, 2 * torch.rand(count, 1, generator=generator) - 1


def errors(model, other):
    """Largest difference of means; ratios of variances."""
    one = model.predict(*queries())
    two = other.predict(*queries())
    return (one.mean - two.mean).abs().max(), two.variance / one.variance


def test_fewer_points_predict_what_all_do():
    differences = [errors(GP, with_points(GP, count))[0] for count in (6, 12, 30)]
    assert differences[2] < differences[1] < differences[0]
    assert differences[2] < 0.01  # the noise
    _, ratios = errors(GP, with_points(GP, 12))
    assert ratios.min() > 0.99  # fewer points know no more


def test_points_that_explain_most_beat_random_ones():
    """Exact GPs over as many of the points, drawn at random."""
    chosen, _ = errors(GP, with_points(GP, 12))
    for seed in range(5):
        rows = torch.randperm(40, generator=torch.Generator().manual_seed(seed))[:12]
        random = type(GP).from_hyperparameters(
            GP.features[rows],
            GP.targets[rows],
            GP.lengthscales,
            GP.signal_variance,
            GP.noise_variance,
            input_dim=1,
            predicts=GP.predicts,
        )
        assert chosen < errors(GP, random)[0]


def test_a_prior_mean_stays_where_there_are_no_data():
    raised = type(GP).from_hyperparameters(
        GP.features,
        GP.targets + 3.0,
        GP.lengthscales,
        GP.signal_variance,
        GP.noise_variance,
        input_dim=1,
        predicts="value",
        offset=torch.full((2,), 3.0),
    )
    far = torch.full((1, 2), 1e3), torch.zeros(1, 1)
    assert (with_points(raised, 12).predict(*far).mean == 3.0).all()
    assert errors(raised, with_points(raised, 30))[0] < 0.01


def test_sparse_models_get_sparser():
    states, inputs = queries()
    trained = SparseTrainer(inducing=30, predicts="difference", iterations=0)(
        Transitions(states, inputs, GP.predict(states, inputs).mean)
    ).posterior
    difference, ratios = errors(trained, with_points(trained, 20))
    assert difference < 0.02
    assert ratios.min() > 0.5


def test_a_separated_noise_stays_that_of_the_process():
    """The rows keep the noise that they were observed with: means do not follow it."""
    noisy = pendulum_posterior(noise=0.01)
    separated = replace(noisy, noise_variance=1e-4 * noisy.noise_variance)
    fewer = with_points(separated, 30)
    states, inputs = queries()
    expected = with_points(noisy, 30).predict(states, inputs).mean
    assert (fewer.predict(states, inputs).mean - expected).abs().max() < 1e-9
    assert torch.equal(fewer.noise_covariance, separated.noise_covariance)


def test_models_around_gps_get_fewer_points():
    residual = pendulum_with_features()
    fewer = with_points(residual, 12)
    assert len(fewer.residual) == 12
    delayed = with_points(DelayedModel(residual, 1.5), 12)
    assert isinstance(delayed.model, ResidualModel)
    assert len(delayed.model.residual) == 12
    assert with_points(residual, len(residual.residual)) is residual


@pytest.mark.parametrize("points", [0, 41, 2.5, True])
def test_other_numbers_of_points_are_refused(points, tmp_path):
    with pytest.raises(SettingError, match="points"):
        with_points(GP, points)
    with pytest.raises(SettingError, match="points"):
        export_c(pendulum(), tmp_path / "folder", points=points)
    assert not (tmp_path / "folder").exists()


def test_the_header_says_how_many_points_are_kept(tmp_path):
    export = export_c(pendulum(), tmp_path, points=12)
    header = export.header.read_text()
    assert "points: 12 of the 40 of the model" in header
    assert "#define GPMPC_POINTS 12 " in header
    assert "points:" not in export_c(pendulum(), tmp_path).header.read_text()


def filtered_pendulum():
    controller = pendulum()
    kalman = KalmanFilter.extended(GP, Measurement.of_states(2, [0], [0.05]))
    start = Gaussian(torch.zeros(2), torch.eye(2))
    return controller, Estimator(kalman, start)


def test_a_filter_of_the_same_model_gets_as_few_points(tmp_path):
    controller, estimator = filtered_pendulum()
    export = export_c(controller, tmp_path, estimator=estimator, points=12)
    source = export.source.read_text()
    assert "over N = 12 points" in source
    assert "over N = 40 points" not in source
    assert "#define filter_model model" in source


def test_budgets_are_read():
    budget = Budget.parse("Flash=64kB, ram=32.5KiB instructions=1.5M")
    assert budget == Budget(flash=65536, ram=33280, instructions=1_500_000)
    assert Budget.parse("flash=2MB,ram=100") == Budget(flash=2 * 1024**2, ram=100)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must limit something"),
        ("rom=64kB", "must limit flash or ram or instructions"),
        ("flsh=64kB", "did you mean 'flash'?"),
        ("flash", "flash must be a number with k or M"),
        ("flash=64kg", "got 'flash=64kg'"),
        ("flash=-1", "got 'flash=-1'"),
        ("flash=nan", "got 'flash=nan'"),
        ("ram=0", "above 0"),
        ("ram=1k,ram=2k", "ram stands there twice"),
        ("instructions=2MB", "such as instructions=2M"),
    ],
)
def test_what_is_no_budget_is_refused(text, message):
    with pytest.raises(SettingError) as caught:
        Budget.parse(text)
    assert message in str(caught.value)


@pytest.fixture
def compiled(monkeypatch):
    """Footprints by a formula, and which numbers of points were compiled."""
    counts = []

    def footprint(controller, questions, **_):
        points = len(controller.prediction.model)
        counts.append(points)
        assert len(questions) in (0, 10)
        return Footprint(
            flash=1000 + 100 * points, ram=500, stack=points, compiler="formula"
        )

    monkeypatch.setattr("gpmpc.export._choice.measure_footprint", footprint)
    monkeypatch.setattr("gpmpc.export._choice.check_chip", lambda chip: None)
    return counts


@pytest.mark.parametrize(
    ("budget", "points"),
    [
        (Budget(flash=1e6), 40),
        (Budget(flash=4999), 39),
        (Budget(flash=2750), 17),
        (Budget(flash=1400), 4),
        (Budget(flash=1e6, ram=511), 11),
    ],
)
def test_the_most_points_that_fit_are_chosen(budget, points, compiled):
    choice = choose_points(pendulum(), fly, budget, chip="host")
    assert choice.points == points
    assert choice.rows[0].points == 40
    assert choice.rows[-1].points == 4  # a plane over three features
    assert len(compiled) <= len(set(compiled)) + 1 < 14  # the chosen one twice
    assert choice.rows[0].cost == choice.rows[0].error == 1.0
    assert abs(choice.rows[1].cost - 1.0) < 1e-3
    assert choice.rows[-1].error > choice.rows[1].error
    assert f"{points} chosen" in choice.table()


def test_what_fits_nowhere_says_what_the_smallest_needs(compiled):
    with pytest.raises(SettingError) as caught:
        choose_points(pendulum(), fly, Budget(flash=1024, ram=300), chip="host")
    assert str(caught.value).startswith(
        "budget: nothing fits: 4 points, the fewest, need 1.4 kB of flash where the "
        "budget is 1.0 kB and 504 B of ram where the budget is 300 B; measured: "
    )


def test_a_flight_that_fails_is_lost(compiled):
    flights = []

    def fails_with_fewer_points(controller):
        flights.append(controller)
        if len(flights) > 1:
            raise Diverged(3, "left the finite numbers")
        return fly(controller)

    budget = Budget(flash=1e6)
    choice = choose_points(pendulum(), fails_with_fewer_points, budget, chip="host")
    assert [row.cost for row in choice.rows[1:]] == [np.inf] * (len(choice.rows) - 1)
    assert "lost" in choice.table()


class Swing:
    """The equations of a damped pendulum."""

    state_names = ("angle", "rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [x[1], -4.0 * np.sin(x[0]) - 0.3 * x[1] + u[0]]


@pytest.mark.parametrize(("start", "stop"), [(0.3, 0.7), (-0.1, 0.1)])
def test_a_lost_measurement_is_no_question(start, stop):
    """Those after it are of their own steps, and a rehearsal's of none."""
    plant = System(Swing(), time_step=0.2)
    path = np.zeros((15, 2))
    path[:, 0] = 0.1 * np.arange(15)
    reference = Reference(path, np.zeros((14, 1)))

    def fly_blindly(controller):
        rehearse(plant, controller, reference, [1.0, 0.0])
        return closed_loop(
            plant,
            controller,
            reference,
            [1.0, 0.0],
            10,
            disturbances=[Dropout(start, stop)],
            on_failure="previous_plan",
        )

    controller = pendulum()
    rollout = fly_blindly(controller)
    flight = flight_of(fly_blindly, controller)
    assert np.isnan(rollout.measured).any()
    np.testing.assert_array_equal(flight.states, rollout.measured)
    followed = [question.reference.over(4).states[0] for question in flight.questions]
    np.testing.assert_array_equal(followed[1:], rollout.references[1:10])
    assert np.isfinite(flight.cost)
    assert ratio_of_errors(GP, GP, flight) == 1.0


def test_states_that_no_sensor_shows_cost_nothing(compiled):
    model = DelayedModel(GP, 1)
    weights = Tracking([1.0, 0.1, 0.0], [0.05])
    controller = pendulum(model, Problem(weights, Box([-2.0], [2.0])))
    origin = Reference(np.zeros(3))

    def fly_late(controller):
        plant = DelayedModel(PLANT, 1)
        loop = ModelLoop(plant, Linearization(), time_step=0.2)
        start = Gaussian.certain(np.array([1.0, 0.0, 0.0]))
        return closed_loop(loop, controller, origin, start, 10)

    points = []

    def footprint(controller, *_, **__):
        points.append(len(controller.prediction.model.model))
        return Footprint(flash=10 * points[-1], ram=0, stack=None, compiler="formula")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gpmpc.export._choice.measure_footprint", footprint)
        choice = choose_points(controller, fly_late, Budget(flash=225), chip="host")
        rule = "ram holds the stack.*; got formula"
        with pytest.raises(SettingError, match=rule):
            choose_points(controller, fly_late, Budget(ram=225), chip="host")
    assert choice.points == 22
    assert np.isfinite([row.error for row in choice.rows]).all()


def known():
    model = KnownModel(lambda x, u: x + u, state_dim=2, input_dim=1)
    return pendulum(model)


@pytest.mark.parametrize(
    ("key", "arguments"),
    [
        ("model", {"controller": known()}),
        ("fly", {"fly": lambda controller: None}),
        ("fly", {"fly": 3}),
        ("fly", {"fly": lambda controller: fly(pendulum())}),
        ("budget", {"budget": "flash=64kB"}),
        ("budget", {"budget": Budget(instructions=1e6), "chip": "host"}),
        ("estimator", {"estimator": GP}),
        ("chip", {"chip": "avr"}),
        ("precision", {"precision": "half"}),
    ],
)
def test_misuse_is_named(key, arguments):
    controller = pendulum()
    call = {"controller": controller, "fly": fly, "budget": Budget(flash=1e6)}
    with pytest.raises(SettingError) as caught:
        choose_points(**{**call, "chip": "host", **arguments})
    assert caught.value.key == key


@pytest.mark.slow  # compiles as for release
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_a_footprint_holds_tables_and_memory():
    footprint = measure_footprint(pendulum(), chip="host", precision="double")
    assert footprint.flash > 40 * 8 * (3 + 2)  # points and weights
    assert footprint.ram > 40 * 8 * (3 + 2)  # differences and kernels of a state
    assert footprint.stack is None or 200 < footprint.stack < 10_000
    assert footprint.worst is None


@pytest.mark.slow  # compiles for a Cortex-M4F and runs in QEMU
@pytest.mark.skipif(
    not (shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")),
    reason="needs a compiler for the chip, and QEMU",
)
def test_a_chip_decides_as_python():
    controller = pendulum()
    flown = fly(controller)
    origin = Reference(np.zeros(2))
    questions = [Question(state, origin) for state in flown.measured]
    footprints = [
        measure_footprint(
            pendulum(with_points(GP, points)), questions, "cortex-m4f", "float"
        )
        for points in (40, 12)
    ]
    all_points, fewer = footprints
    assert all_points.inputs is not None
    assert np.abs(all_points.inputs - flown.inputs).max() < 1e-4
    assert fewer.flash < all_points.flash
    assert fewer.memory < all_points.memory
    assert fewer.worst is not None
    assert all_points.worst is not None
    assert fewer.worst < 0.8 * all_points.worst
