"""A flight follows from its experiment alone."""

import json
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from gpmpc.datasets import Excitation, ExcitedData
from gpmpc.exceptions import Diverged, SettingError
from gpmpc.gp import Trainer, Transitions
from gpmpc.mpc import GPMPC, Box, Decision, Problem, Timing, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise
from gpmpc.status import Status
from gpmpc.studies import _trial
from gpmpc.studies.flight import Experiment, metrics, run_trial
from gpmpc.systems import coupled, pendulum, rotational, translational
from gpmpc.trajectories import Elliptical, Hover, Lorenz, Step
from tests.systems.experiments import experiment as experiment_of

CONF = Path(__file__).resolve().parents[2] / "conf"
PLANT = translational()
PROBLEM = Problem(
    Tracking([10, 1] * 3, [0.1, 1, 1]), inputs=Box([0, -0.7, -0.7], [20, 0.7, 0.7])
)
HOVER = [7.26, 0, 0]
EXCITED = Excitation([1] * 6, [1] * 3, HOVER, [0.3, 0.03, 0.03], [0.01] * 6)
CONVEX = partial(
    GPMPC, propagator=Linearization(), problem=PROBLEM, horizon=2, initial_input=HOVER
)
ON_THE_PLANT = partial(NMPC, problem=PROBLEM, horizon=2, initial_input=HOVER)


class Blind:
    """Applies a law of the state alone; a call takes as long as ``seconds`` gives."""

    horizon = 1
    problem = replace(PROBLEM, inputs=Box())
    initial_input = HOVER

    def __init__(self, plant, law, seconds=lambda: 0.0):
        self.law = law
        self.seconds = seconds

    def control(self, belief, reference, previous=None):
        inputs = np.array([self.law(belief.mean.numpy())], dtype=float)
        timing = Timing(self.seconds(), 0.0, 0.0)
        return Decision(
            inputs[0],
            inputs,
            np.zeros((2, 6)),
            np.zeros((2, 6, 6)),
            Status.SOLVED,
            1,
            timing,
        )


def blind(law, **changes):
    seconds = changes.pop("seconds", lambda: 0.0)
    return experiment(
        data=None,
        controller=partial(Blind, law=law, seconds=seconds),
        **{"steps": 30} | changes,
    )


def experiment(**changes):
    settings = {
        "data": ExcitedData(EXCITED, EXCITED, samples=25),
        "trajectory": Elliptical(),
        "system": PLANT,
        "train": Trainer(restarts=0),
        "controller": CONVEX,
        "size": 20,
        "steps": 4,
    }
    return Experiment(**settings | changes)


def numbers(experiment):
    result = metrics(experiment, run_trial(experiment))
    assert result.pop("times")["total"]["median"] >= 0
    return result


def test_a_seed_gives_the_same_numbers_and_another_one_others():
    noise = Noise(measurement=[0.01] * 6)
    first, again, other = (
        numbers(experiment(noise=noise, seed=seed)) for seed in (3, 3, 4)
    )
    assert first == again
    assert first["rmse"]["total"] != other["rmse"]["total"]
    assert first["training"]["size"] == 20


def test_a_seeds_rows_are_nested_and_in_the_flights_order():
    everything = experiment(size=None).training_rows().features.numpy()
    small, large = (
        experiment(size=size, seed=1).training_rows().features.numpy()
        for size in (5, 12)
    )
    assert len(everything) == 25
    places = [
        [int(np.flatnonzero((everything == row).all(axis=1))[0]) for row in rows]
        for rows in (small, large)
    ]
    assert places[1] == sorted(places[1])
    assert set(places[0]) < set(places[1])


def test_a_model_loop_needs_no_plant_and_a_true_model_no_data():
    flown = run_trial(experiment(loop="model"))
    assert np.trace(flown.rollout.covariances[-1]) > 0
    by_true_model = run_trial(experiment(controller=ON_THE_PLANT, data=None))
    assert by_true_model.training is None
    assert (
        metrics(experiment(controller=ON_THE_PLANT), by_true_model)["rmse"]["total"]
        < 0.01
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": 0}, "data.size: must be a whole number, 1 or more"),
        ({"steps": 0}, "steps: must be a whole number, 1 or more"),
        ({"loop": "plan"}, "loop: must be 'plant' or 'model'; got 'plan'"),
        ({"on_failure": "cry"}, "on_failure: must be one of"),
        (
            {"plant": coupled()},
            "plant: must have the states, inputs and time step of translational; got",
        ),
        (
            {"plant": translational(time_step=0.5)},
            "plant: must have the states, inputs and time step",
        ),
        (
            {"controller": ON_THE_PLANT, "loop": "model"},
            "loop: a model loop needs a controller that learns",
        ),
    ],
    ids=str,
)
def test_what_cannot_be_flown_is_refused(changes, message):
    with pytest.raises(SettingError, match=message):
        experiment(**changes)


def test_the_rotational_subsystem_follows_at_its_own_rate():
    excited = Excitation([1] * 6, [1] * 3, [0] * 3, [0.05] * 3, [1e-4, 1e-3] * 3)
    problem = Problem(Tracking([100, 1] * 3, [1] * 3), inputs=Box([-2] * 3, [2] * 3))
    settings = {
        "propagator": Linearization(),
        "problem": problem,
        "horizon": 5,
        "initial_input": [0] * 3,
    }
    turning = experiment(
        system=rotational(substeps=5),
        trajectory=Lorenz(),
        data=ExcitedData(EXCITED, excited, samples=60),
        controller=partial(GPMPC, **settings),
        size=None,
        steps=100,
    )
    flight = run_trial(turning)
    result = metrics(turning, flight)
    assert flight.rollout.time_step == 0.05
    assert (
        np.ptp(flight.rollout.references[:, 0]) > 0.03
    )  # [rad]: there was something to follow
    assert set(result["rmse"]) == {"phi", "theta", "psi", "total"}
    assert result["unit"] == "rad"
    assert result["rmse"]["total"] < 0.005


@pytest.mark.parametrize(
    "trajectory",
    [Elliptical(), Lorenz(), Hover((0, 0, -5)), Step((0, 0, 0), (1, 1, -1), 3.0)],
)
@pytest.mark.parametrize(
    "law", [lambda x: [0, 0, 0], lambda x: [100, 0, 0], lambda x: [7.26, 0.6, 0]]
)
def test_a_lost_flight_says_since_when(trajectory, law):
    lost = blind(law, trajectory=trajectory)
    flight = run_trial(lost)
    loss = metrics(lost, flight)["lost"]
    away = np.linalg.norm(
        (flight.rollout.states - flight.rollout.references)[:, ::2], axis=1
    )
    assert loss["time"] == loss["step"]
    assert 10 < away[loss["step"]] <= away.max()
    assert away[: loss["step"]].max() < away[loss["step"]]
    assert f"{away[loss['step']]:.3g} m from its reference" in loss["reason"]


@pytest.mark.parametrize("trajectory", [Elliptical(), Lorenz(), Hover((0, 0, -5))])
def test_an_offset_and_a_short_flight_are_no_loss(trajectory):
    heavy = translational(mass=0.888)
    problem = replace(PROBLEM, cost=Tracking([1] * 6, [1] * 3))
    sagging = experiment(
        trajectory=trajectory,
        data=None,
        controller=lambda plant: ON_THE_PLANT(PLANT, problem=problem),
        plant=heavy,
        steps=20,
    )
    result = metrics(sagging, run_trial(sagging))
    assert result["rmse"]["z"] > 3
    assert result["lost"] is None
    for steps in (1, 2):
        assert numbers(experiment(trajectory=trajectory, steps=steps))["lost"] is None


def test_a_plan_holds_process_noise_if_its_covariances_do():
    noisy = Noise(process=[1e-3] * 6)
    latent = Linearization(process_noise=False)
    for settings, expected in (
        ({"noise": noisy}, 1e-3),
        ({"noise": noisy, "propagator": latent}, 1e-3),
        ({"noise": noisy, "propagator": Linearization()}, 0.0),
        ({"noise": Noise(measurement=[1e-3] * 6)}, 0.0),
        ({}, 0.0),
    ):
        assert (
            blind(lambda x: HOVER, **settings).unplanned_noise(None).tolist()
            == [expected] * 6
        )


LARGEST_THRUST = [1.7e308, 0, 0]


def kicked_twice(first):
    """A thrust, and where it has carried the plant away, one that is almost infinite.

    What is farther away than 1e30 is not measured, and not answered.
    """
    return lambda x: LARGEST_THRUST if abs(x[4]) > 100 else [first, 0, 0]


@pytest.mark.parametrize("thrust", [1e6, 1e29])
def test_a_diverged_flight_has_metrics_that_can_be_written(thrust):
    recorded = []
    diverging = blind(kicked_twice(thrust), trajectory=Hover((0, 0, -5)))
    flight = run_trial(
        diverging, lambda controller, training: nullcontext(recorded.append)
    )
    result = metrics(diverging, flight)
    json.dumps(result, allow_nan=False)
    assert result["lost"]["step"] == 1
    assert "the plant's state is not finite any more" in result["lost"]["reason"]
    assert set(result["rmse"].values()) == {None}
    assert result["steps"] == flight.diverged.step == len(recorded) < 30
    assert result["violations"]["inputs"]["steps"] == result["steps"]
    with pytest.raises(Diverged):  # nothing was flown
        run_trial(blind(lambda x: LARGEST_THRUST, trajectory=Hover((0, 0, -5))))


def test_what_the_first_calls_take_is_no_part_of_the_times():
    slow = iter([40.0, 20.0])
    measured = blind(lambda x: HOVER, steps=5, seconds=lambda: next(slow, 0.001))
    assert metrics(measured, run_trial(measured))["times"]["total"]["largest"] == 0.001


def composed():
    """Settings of flights with every controller, propagation and solver there is."""
    names = {
        group: sorted(path.stem for path in (CONF / group).glob("*.yaml"))
        for group in CHOSEN
    }
    return [
        f"{group}={name}" for group, found in names.items() for name in found
    ] + MORE


CHOSEN = ("controller", "propagation", "solver")
MORE = [
    "loop=model",
    "controller.iterations=5",
    "controller.prediction.disturbance_gain=0.3",
    "system=rotational",
]


@pytest.fixture(scope="module")
def learned():
    """Rows and what was learned from them, by system; trained once."""
    trainings = {}

    def of(settings):
        if settings.system.name not in trainings:
            rows = settings.training_rows()
            trainings[settings.system.name] = rows, settings.train(rows, seed=0)
        rows, training = trainings[settings.system.name]

        class Kept:
            note = ""

            def transitions(self, *_):
                return rows

        return replace(settings, data=Kept(), train=lambda *_, **__: training)

    return of


@pytest.mark.parametrize("choice", composed())
def test_the_rehearsal_changes_no_bit(choice, learned, monkeypatch):
    words = ["data.samples=20", "model.restarts=0", "steps=4", "horizon=3"]
    if choice != "loop=model":
        words += [f"noise.process={[1e-3] * 6}", f"noise.measurement={[1e-3] * 6}"]
    settings = learned(experiment_of(choice, *words))
    rehearsed = run_trial(settings).rollout
    monkeypatch.setattr(_trial, "rehearse", lambda *_: None)
    at_once = run_trial(settings).rollout
    for name in (
        "states",
        "covariances",
        "measured",
        "inputs",
        "predicted_means",
        "predicted_covariances",
        "iterations",
    ):
        assert np.array_equal(
            getattr(rehearsed, name), getattr(at_once, name), equal_nan=True
        ), name
    assert rehearsed.statuses == at_once.statuses


def test_more_rows_than_there_are_are_refused():
    with pytest.raises(
        SettingError,
        match="data.size: must be at most 25, the rows of the data; got 26",
    ):
        run_trial(experiment(size=26))


@pytest.mark.parametrize(
    "settings", [{}, {"predicts": "difference"}], ids=["next states", "differences"]
)
def test_the_scales_of_columns_at_rest_follow_from_the_limits(settings):
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (20, 6))
    inputs = rng.uniform(-0.5, 0.5, (20, 3))
    states[:, 4] = 1.0
    states[:, 5] = 0.0
    inputs[:, :2] = [7.26, 0.1]
    data = Transitions(states, inputs, rng.uniform(-1, 1, (20, 6)))
    flown = experiment(train=Trainer(restarts=0, **settings))
    posterior = flown.learn(data, seed=0).posterior
    gp = getattr(posterior, "residual", posterior)
    # One unit; a tenth of 4 m/s; one unit though thrusts reach 100 N; a tenth of 1.4.
    expected = [1.0, 0.4, 1.0, 0.14]
    assert np.allclose(gp.lengthscales[:, [4, 5, 6, 7]], expected)
    with_prior = replace(flown, train=replace(flown.train, prior_lengthscale=3.0))
    posterior = with_prior.learn(data, seed=0).posterior
    gp = getattr(posterior, "residual", posterior)
    assert np.allclose(gp.lengthscales[:, [4, 5, 6, 7]], 3.0)


def test_angles_at_rest_seen_by_sine_and_cosine_have_one_unit():
    plant = replace(pendulum(), region=[[-3.0, -2.0], [3.0, 2.0]])
    rng = np.random.default_rng(0)
    states = np.column_stack([np.full(20, 0.5), rng.uniform(-1, 1, 20)])
    data = Transitions(states, np.full((20, 1), 0.2), rng.uniform(-1, 1, (20, 2)))
    flown = replace(
        experiment(train=Trainer(restarts=0, predicts="difference")),
        system=plant,
        trajectory=None,
        controller=partial(ON_THE_PLANT, problem=Problem(Tracking([1, 1], [1]))),
    )
    learned = flown.learn(data, seed=0).posterior.residual
    assert np.allclose(learned.lengthscales[:, [0, 1, 3]], [1.0, 1.0, 0.4])
