"""Trials flown together are the trials flown alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import Diverged, SettingError, ShapeError, SolverFailure
from gpmpc.gaussian import Gaussian
from gpmpc.gp import backend
from gpmpc.mpc import (
    GPMPC,
    Box,
    Decision,
    PredictionSettings,
    Problem,
    Reference,
    Timing,
    Tracking,
)
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import Dropout, Gust, ModelLoop, Noise, closed_loop, closed_loops
from gpmpc.status import Status
from gpmpc.systems import (
    Coupled,
    Map,
    Rotational,
    System,
    Translational,
    step,
    step_many,
)
from tests.mpc.systems import HOVER, QUADROTOR, quadrotor_gp

H = 3
STEPS = 8
GP = quadrotor_gp(20)
REFERENCES = Reference(np.zeros((STEPS + H, 6)), np.tile(HOVER, (STEPS + H - 1, 1)))
START = np.array([0.3, 0.0, -0.2, 0.0, 0.1, 0.0])
NOISE = Noise(process=[0.01] * 6, measurement=[0.005] * 6, input=[0.02, 0.002, 0.002])
ARRAYS = (
    "states",
    "covariances",
    "measured",
    "inputs",
    "references",
    "predicted_means",
    "predicted_covariances",
)


def controller(
    covariance="zero_order", propagator=None, model=GP, bound=2.0, **settings
):
    box = {"inputs": Box([0, -0.4, -0.4], [15, 0.4, 0.4])}
    problem = Problem(
        Tracking([1] * 6, [0.1] * 3),
        constraints=[Box([-bound] * 6, [bound] * 6, probability=0.95, penalty=None)],
        **box,
    )
    return GPMPC(
        model,
        propagator or Linearization(),
        problem,
        H,
        HOVER,
        prediction=PredictionSettings(covariance=covariance),
        **settings,
    )


def fly(mpc, seeds=4, plant=QUADROTOR, initial=START, **settings):
    return closed_loops(
        plant, mpc, REFERENCES, initial, STEPS, seeds, **({"noise": NOISE} | settings)
    )


def alone(mpc, seed, plant=QUADROTOR, initial=START, **settings):
    settings.pop("chunk", None)
    return closed_loop(
        plant,
        mpc,
        REFERENCES,
        initial,
        STEPS,
        seed=seed,
        **({"noise": NOISE} | settings),
    )


def assert_same(ours, theirs, tolerance=1e-9):
    for key in ARRAYS:
        assert np.allclose(
            getattr(ours, key),
            getattr(theirs, key),
            rtol=0,
            atol=tolerance,
            equal_nan=True,
        ), key
    assert ours.statuses == theirs.statuses
    assert ours.time_step == theirs.time_step
    assert np.array_equal(ours.iterations, theirs.iterations)
    assert len(ours.timings) == len(theirs.timings)


@pytest.mark.parametrize("choice", ["auto", "torch"])
@pytest.mark.parametrize(
    ("covariance", "propagator"),
    [
        ("none", Linearization()),
        ("zero_order", Linearization()),
        ("full", MomentMatching()),
    ],
    ids=["mean", "linearised", "moment-matched"],
)
def test_a_trial_gives_the_same_numbers_in_a_crowd_and_alone(
    covariance, propagator, choice
):
    mpc = controller(covariance, propagator)
    with backend(choice):
        for trial in fly(mpc):
            assert trial.error is None
            assert_same(trial.result, alone(mpc, trial.seed))


@pytest.mark.parametrize("chunk", [1, 2, 50])
def test_the_size_of_a_chunk_changes_no_number(chunk):
    mpc = controller("full", MomentMatching())
    seeds = [7, 0, 3, 12, 5]
    for ours, theirs in zip(fly(mpc, seeds, chunk=chunk), fly(mpc, seeds), strict=True):
        assert ours.seed == theirs.seed
        assert_same(ours.result, theirs.result)


def test_trials_come_in_the_order_of_their_seeds_and_differ():
    flown = fly(controller("none"), [4, 2, 9])
    assert [trial.seed for trial in flown] == [4, 2, 9]
    assert not np.allclose(flown[0].result.states, flown[1].result.states)


def test_starts_are_drawn_and_winds_blow_as_alone():
    initial = Gaussian(torch.tensor(START), 0.01 * torch.eye(6))
    settings = {
        "initial": initial,
        "disturbances": [Gust({"vx": 0.3}, start=1.0, stop=2.0)],
    }
    mpc = controller()
    for trial in fly(mpc, **settings):
        assert_same(trial.result, alone(mpc, trial.seed, **settings))


# Drawn from here, some trials start where no input keeps the bounds.
SPREAD = {"initial": Gaussian(torch.tensor(START), 0.01 * torch.eye(6))}


@pytest.mark.parametrize("policy", ["previous_plan", "hold"])
def test_failures_are_bridged_and_counted_as_alone(policy):
    mpc = controller(bound=0.5)
    settings = SPREAD | {"on_failure": policy, "disturbances": [Dropout(2.0, 2.5)]}
    flown = fly(mpc, 6, **settings)
    for trial in flown:
        assert_same(trial.result, alone(mpc, trial.seed, **settings))
        assert (4, Status.INVALID_MEASUREMENT) in trial.result.failures
    infeasible = {
        sum(status is Status.INFEASIBLE for status in trial.result.statuses)
        for trial in flown
    }
    assert len(infeasible) > 1


def outcome(fly_alone):
    """Returns a flight's rollout, or what ``Trial.error`` says of its failure."""
    try:
        return fly_alone()
    except (SolverFailure, Diverged) as error:
        return f"{type(error).__name__}: {error}"


def assert_each_ends_as_alone(flown, fly_alone):
    ended = [trial.error for trial in flown if trial.error is not None]
    assert 0 < len(ended) < len(flown)
    for trial in flown:
        expected = outcome(lambda seed=trial.seed: fly_alone(seed))
        if trial.error is None:
            assert_same(trial.result, expected)
        else:
            assert trial.error == expected
            assert trial.result is None


def test_a_trial_that_fails_stops_no_other():
    mpc = controller(bound=0.5)
    assert_each_ends_as_alone(
        fly(mpc, 8, **SPREAD), lambda seed: alone(mpc, seed, **SPREAD)
    )


class Explosive:
    """x' = x^3: it leaves the finite numbers from far out only."""

    state_names = ("x",)
    input_names = ("u",)

    def derivative(self, x, u):
        return [x[0] * x[0] * x[0] + u[0]]


class Proportional:
    """u = -3 x, one answer at a time."""

    horizon = 1

    def control(self, belief, reference, previous=None):
        input = -3 * belief.mean.numpy()
        nothing = np.zeros((2, 1)), np.zeros((2, 1, 1))
        return Decision(
            input, input[None], *nothing, Status.SOLVED, 1, Timing(0.0, 0.0, 0.0)
        )


def test_many_fly_one_by_one_and_divergence_is_one_trials_own():
    plant = System(Explosive(), time_step=0.5)
    initial = Gaussian(torch.zeros(1), 4 * torch.eye(1))
    reference = np.zeros((20, 1))

    def alone(seed):
        return closed_loop(plant, Proportional(), reference, initial, 15, seed=seed)

    flown = closed_loops(plant, Proportional(), reference, initial, 15, seeds=12)
    assert any("Diverged: step" in trial.error for trial in flown if trial.error)
    assert_each_ends_as_alone(flown, alone)


@pytest.mark.parametrize(
    "plant",
    [
        System(Map(Translational(frozen_attitude=(0.7, 0.7))), 1.0),
        System(Translational(), 0.3),
        System(Rotational(), 0.1, substeps=2),
        System(Coupled(), 0.05),
        System(Map(Explosive()), 1.0),
    ],
    ids=lambda plant: f"{type(plant).__name__} {type(plant.dynamics).__name__}",
)
def test_many_plants_step_as_one_does(plant, rng):
    n = len(plant.dynamics.state_names)
    m = len(plant.dynamics.input_names)
    states = 0.3 * rng.normal(size=(5, n))
    inputs = 0.3 * rng.normal(size=(5, m))
    expected = [step(plant, x, u) for x, u in zip(states, inputs, strict=True)]
    assert np.allclose(
        step_many(plant, states, inputs), expected, rtol=1e-14, atol=1e-15
    )


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (
            {"plant": ModelLoop(GP, Linearization())},
            SettingError,
            "plant: a model loop draws no random numbers",
        ),
        ({"seeds": 0}, SettingError, "seeds: must be a whole number, 1 or more; got 0"),
        ({"seeds": [1, 1]}, SettingError, "different whole numbers"),
        ({"chunk": 0}, SettingError, "chunk: must be a whole number, 1 or more; got 0"),
        ({"on_failure": "ignore"}, SettingError, "on_failure: must be one of"),
        (
            {"initial": np.zeros(3)},
            ShapeError,
            r"the initial state must have shape \(6,\); got \(3,\)",
        ),
        (
            {"noise": Noise(process=[0.1])},
            ShapeError,
            "noise.process must have 6 standard deviations; got 1",
        ),
    ],
)
def test_misuse_is_refused_before_the_first_step(settings, error, message):
    with pytest.raises(error, match=message):
        fly(controller("none"), **settings)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize(
    ("covariance", "propagator"),
    [
        ("none", Linearization()),
        ("zero_order", Linearization()),
        ("full", MomentMatching()),
    ],
    ids=["mean", "linearised", "moment-matched"],
)
def test_flights_with_the_model_on_a_gpu_are_those_on_the_cpu(covariance, propagator):
    here = controller(covariance, propagator)
    there = controller(covariance, propagator, GP.to("cuda"))
    for ours, theirs in zip(fly(there), fly(here), strict=True):
        assert_same(ours.result, theirs.result)


class Lifting(GPMPC):
    """Overrides ``control`` alone."""

    def control(self, *arguments, **options):
        decision = super().control(*arguments, **options)
        return replace(decision, input=HOVER + 1.0, inputs=np.tile(HOVER + 1.0, (H, 1)))


def test_a_control_that_is_overridden_alone_decides_for_many():
    problem = Problem(Tracking([1.0] * 6, [0.1] * 3))
    controller = Lifting(GP, Linearization(), problem, H, HOVER)
    for trial in fly(controller, seeds=2, noise=None):
        assert np.array_equal(trial.result.inputs, np.tile(HOVER + 1.0, (STEPS, 1)))
