"""The exported filter believes what Python's does, and its controller decides alike."""

import shutil
import subprocess
from dataclasses import replace
from typing import Any

import casadi
import numpy as np
import pytest
import torch

from gpmpc.estimation import KalmanFilter, LateMeasurements, Measurement
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.export import (
    CompiledLoop,
    Estimator,
    Question,
    answers,
    export_c,
    write_replay,
)
from gpmpc.gaussian import Gaussian
from gpmpc.models import Affine, CasadiFunction, DisturbedModel, KnownModel
from gpmpc.mpc import GPMPC, Box, Halfspaces, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from tests.mpc.small_models import pendulum_posterior

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
COMPILER = ("cc", "-O0", "-Wall", "-Wextra", "-Werror", "-pedantic")
GP: Any = pendulum_posterior()
DISTURBED: Any = DisturbedModel(GP, torch.tensor([[0.0], [1.0]]), [0.01], [0.9])


def pendulum(model=GP):
    weights = [1.0, 0.1, 0.0][: model.state_dim]
    plane = np.zeros((1, model.state_dim))
    plane[0, :2] = 1.0, 0.2
    problem = Problem(
        Tracking(weights, [0.05]),
        Box([-2.0], [2.0]),
        constraints=[Halfspaces(plane, [0.3], probability=0.9)],
    )
    return GPMPC(model, Linearization(), problem, 5, [0.0], iterations=1)


def one_angle(model=GP, std=0.05, angles=(0,)):
    return Measurement.of_states(model.state_dim, [0], [std], angles=angles)


def two_perfect_ones(model=GP):
    return Measurement.of_states(model.state_dim, [0, 0, 1], [0.0, 0.0, 1e-9])


def camera(_=GP, states=2):
    """A position on a circle, of correlated noise."""
    x = casadi.SX.sym("x", states)
    seen = casadi.vertcat(casadi.sin(x[0]), casadi.cos(x[0]) + 0.1 * x[1])
    noise = torch.tensor([[4e-4, 1e-4], [1e-4, 9e-4]], dtype=torch.float64)
    return Measurement(2, noise, CasadiFunction(casadi.Function("h", [x], [seen])))


def gaussian(mean, deviations):
    covariance = torch.diag(torch.tensor(deviations, dtype=torch.float64) ** 2)
    return Gaussian(torch.tensor(mean, dtype=torch.float64), covariance)


CASES = {
    "an angle": (GP, one_angle, gaussian([0.3, 0.0], [0.1, 0.5])),
    "a prior without end": (GP, one_angle, gaussian([0.0, 0.0], [1e7, 1e7])),
    "a known start": (GP, one_angle, gaussian([0.0, 0.0], [0.0, 0.0])),
    "perfect sensors": (GP, two_perfect_ones, gaussian([0.0, 0.0], [1.0, 1.0])),
    "a camera": (GP, camera, gaussian([0.2, 0.1], [0.1, 0.5])),
    "a disturbance": (DISTURBED, one_angle, gaussian([0.3, 0, 0], [0.1, 0.5, 0.2])),
}


def questions(estimator, steps=40, seed=0):
    """Yields measurements along a rough walk, some entries lost, and references."""
    rng = np.random.default_rng(seed)
    measurement = estimator.filter.measurement
    state = np.zeros(measurement.state_dim)
    for k in range(steps):
        state = 0.9 * state + rng.normal(0, 0.2, len(state))
        seen = measurement.predict(torch.from_numpy(state)[None]).mean[0].numpy()
        measured = seen + rng.normal(0, 0.02, len(seen))
        measured[rng.random(len(measured)) < 0.2] = np.nan if k % 2 else -1e38
        if k % 7 == 3 and len(measurement.angles):
            measured[list(measurement.angles)] += 2 * np.pi
        reference = np.zeros(len(state))
        reference[0] = np.sin(0.1 * k)
        yield Question(measured, Reference(reference))


def case(name):
    model, measurement, belief = CASES[name]
    kalman = KalmanFilter.extended(model, measurement(model))
    return pendulum(model), Estimator(kalman, belief)


QUICK = ("perfect sensors", "a camera")  # the others take seconds to compile


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in CASES
    ],
)
def test_filters_and_decides_as_python(name):
    controller, estimator = case(name)
    compiled = CompiledLoop(controller, compiler=COMPILER, estimator=estimator)
    asked = list(questions(estimator))
    for answer in answers(controller, asked, estimator=estimator):
        measured, reference, _ = answer.question
        got = compiled.input(measured, reference)
        assert np.abs(got - answer.input).max() < 1e-9
        assert compiled.status is answer.status
        belief = answer.belief
        scale = 1.0 + belief.covariance.abs().max()
        assert (compiled.belief.mean - belief.mean).abs().max() < 1e-9 * scale.sqrt()
        difference = compiled.belief.covariance - belief.covariance
        assert difference.abs().max() < 1e-9 * scale


@pytest.mark.slow
def test_a_filter_may_have_a_model_of_its_own():
    controller = pendulum()
    other = pendulum_posterior()
    estimator = Estimator(
        KalmanFilter.extended(other, one_angle()), gaussian([0.3, 0.0], [0.1, 0.5])
    )
    compiled = CompiledLoop(controller, compiler=COMPILER, estimator=estimator)
    asked = list(questions(estimator))
    for answer in answers(controller, asked, estimator=estimator):
        got = compiled.input(answer.question.measured, answer.question.reference)
        assert np.abs(got - answer.input).max() < 1e-9


@pytest.mark.slow
def test_float_believes_nearly_the_same():
    controller, estimator = case("an angle")
    compiled = CompiledLoop(controller, "float", compiler=COMPILER, estimator=estimator)
    asked = list(questions(estimator))
    for answer in answers(controller, asked, estimator=estimator):
        got = compiled.input(answer.question.measured, answer.question.reference)
        assert np.abs(got - answer.input).max() < 4e-4


@pytest.mark.slow
def test_the_folder_replays_what_was_measured(tmp_path):
    controller, estimator = case("a camera")
    export_c(controller, tmp_path, estimator=estimator)
    asked = list(questions(estimator))
    replay = tmp_path / "replay.txt"
    assert write_replay(controller, asked, replay, estimator=estimator) == 40
    done = subprocess.run(
        ["make", "check"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    deviation = done.stdout.split("largest deviation ")[1].partition(",")[0]
    assert float(deviation) < 1e-9
    assert "other statuses 0" in done.stdout


def unscented():
    return Estimator(KalmanFilter.unscented(GP, one_angle()), CASES["an angle"][2])


def late():
    kalman = KalmanFilter.extended(GP, one_angle())
    belief = CASES["an angle"][2]
    filter: Any = LateMeasurements(kalman, belief)
    return Estimator(filter, belief)


def of_torch():
    noise = torch.tensor([[1e-4]], dtype=torch.float64)
    seen = Measurement(2, noise, lambda states: states[..., :1].sin())
    return Estimator(KalmanFilter.extended(GP, seen), CASES["an angle"][2])


def of_other_states():
    kalman = KalmanFilter.extended(DISTURBED, one_angle(DISTURBED))
    return Estimator(kalman, CASES["a disturbance"][2])


def of_more_inputs():
    two = torch.zeros(2, 2, dtype=torch.float64)
    model = KnownModel(Affine(torch.eye(2).double(), two, two[0]), 2, 2)
    return Estimator(KalmanFilter.extended(model, one_angle()), CASES["an angle"][2])


def of_another_type():
    belief = CASES["an angle"][2]
    single = Gaussian(belief.mean.float(), belief.covariance.float())
    return Estimator(KalmanFilter.extended(GP, one_angle()), single)


REFUSED = {
    "estimator": lambda: KalmanFilter.extended(GP, one_angle()),
    "filter": late,
    "filter.propagator": unscented,
    "filter.model": of_other_states,
    "filter.model: inputs": of_more_inputs,
    "measurement.function": of_torch,
    "belief": of_another_type,
}


@pytest.mark.parametrize("key", REFUSED)
def test_refuses_by_name(key, tmp_path):
    with pytest.raises(SettingError) as caught:
        export_c(pendulum(), tmp_path / "folder", estimator=REFUSED[key]())
    assert caught.value.key == key.partition(":")[0]
    assert not (tmp_path / "folder").exists()


@pytest.mark.parametrize(("states", "sensors"), [(2, 1), (3, 2)])
def test_sensors_that_c_has_no_room_for_are_refused(states, sensors, tmp_path):
    seen = camera(states=states)
    noise = seen.noise_covariance[:sensors, :sensors]
    kalman = KalmanFilter.extended(GP, replace(seen, noise_covariance=noise))
    with pytest.raises(ShapeError, match=rf"must map \(2,\) to \({sensors},\)"):
        export_c(
            pendulum(),
            tmp_path / "folder",
            estimator=Estimator(kalman, CASES["an angle"][2]),
        )
    assert not (tmp_path / "folder").exists()
