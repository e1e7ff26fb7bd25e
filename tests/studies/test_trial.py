"""A trial is put together from its experiment: its data, its flight and its start."""

from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import Diverged, SettingError, ShapeError
from gpmpc.gp import Trainer, Transitions
from gpmpc.learning import EpisodicLearning, OnlineLearning
from gpmpc.mpc import PredictionSettings, Problem, Tracking
from gpmpc.simulation import ModelLoop, Noise
from gpmpc.studies import _experiment, _trial
from gpmpc.studies.flight import Experiment, Flown, run_trial
from gpmpc.studies.study import random_rows
from gpmpc.systems import pendulum, translational
from gpmpc.trajectories import Elliptical

PLANT = translational()
PENDULUM = pendulum()
ROLLOUT = object()
MODEL = SimpleNamespace(
    name="model", state_dim=6, output_dim=6, input_dim=2, predict=None
)
STEP = object()


def steering(model=None, **attributes):
    return SimpleNamespace(
        horizon=3, initial_input=[7.0, 0.0, 0.1], made_of=model, **attributes
    )


def experiment(**changes):
    settings = {
        "data": None,
        "trajectory": Elliptical(),
        "system": PLANT,
        "train": Trainer(),
        "controller": steering,
    }
    return Experiment(**settings | {"steps": 5, "model": MODEL} | changes)


@pytest.fixture
def loops(monkeypatch):
    """What was rehearsed, and what was flown, in their order."""
    calls = []
    monkeypatch.setattr(_trial, "rehearse", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr(
        _trial,
        "closed_loop",
        lambda *arguments, **keywords: calls.append((arguments, keywords)) or ROLLOUT,
    )
    return calls


def test_a_flight_has_references_for_all_that_its_last_plan_sees(loops):
    heavy = translational(mass=0.9)
    noise = Noise(process=[0.1] * 6)
    gust = SimpleNamespace(disturb_plant=None)
    prepared_trials = []
    chosen = experiment(plant=heavy, noise=noise, seed=4, on_failure="raise")
    object.__setattr__(chosen, "disturbances", (gust,))
    flown = run_trial(
        chosen, lambda *prepared: prepared_trials.append(prepared) or nullcontext(STEP)
    )
    rehearsed, (arguments, keywords) = loops
    system, controller, reference, start, steps = arguments
    assert (system, steps, controller.made_of) == (heavy, 5, MODEL)
    assert all(
        one is other for one, other in zip(rehearsed, arguments[:4], strict=True)
    )
    assert np.array_equal(
        reference.states, PLANT.reference_states(Elliptical(), 5 + 3 + 1)
    )
    assert np.array_equal(reference.inputs, [[7.0, 0.0, 0.1]] * 8)
    assert np.array_equal(start, reference.states[0])
    settings = {
        "noise": noise,
        "disturbances": (gust,),
        "on_failure": "raise",
        "seed": 4,
        "on_step": STEP,
    }
    assert keywords == settings
    assert prepared_trials == [(controller, None)]
    assert (flown.rollout, flown.controller, flown.training, flown.diverged) == (
        ROLLOUT,
        controller,
        None,
        None,
    )
    assert flown.before == ()


def test_a_flight_begins_where_the_plant_says(loops):
    """A plant that keeps its own state is given no start."""
    began = replace(PLANT, start=tuple(range(6)))
    run_trial(experiment(system=began))
    assert loops[0][3] == loops[1][0][3] == tuple(range(6))
    assert loops[1][1]["on_step"] is None
    own = experiment()
    stateful_plant = SimpleNamespace(
        start=None, dynamics=SimpleNamespace(stateful=True), time_step=1.0
    )
    object.__setattr__(own, "plant", stateful_plant)
    run_trial(own)
    assert loops[-1][0][0] is stateful_plant
    assert loops[-1][0][3] is None


def test_a_controller_that_knows_the_plant_is_made_of_it(loops):
    run_trial(experiment(controller=lambda plant: steering(plant), model=None))
    assert loops[1][0][1].made_of is PLANT


@pytest.mark.parametrize("propagator", [None, SimpleNamespace(propagate=None)])
def test_a_model_loop_is_flown_in_the_models_own_world(propagator, loops, monkeypatch):
    def best(model):
        return SimpleNamespace(propagate=None, best_for=model)

    monkeypatch.setattr(_trial, "best_propagator", best)
    run_trial(
        experiment(
            loop="model", propagator=propagator, system=translational(time_step=0.25)
        )
    )
    (system, *_), _ = loops[1]
    assert isinstance(system, ModelLoop)
    assert system.model is MODEL
    assert system.propagator == (propagator or best(MODEL))
    assert system.time_step == 0.25


def test_a_controller_that_learns_while_it_flies_is_wrapped(loops, monkeypatch):
    monkeypatch.setattr(
        _trial, "LearningController", lambda *arguments: steering(arguments=arguments)
    )
    online = OnlineLearning()
    run_trial(experiment(learning=online))
    inner, learning = loops[1][0][1].arguments
    assert (inner.made_of, learning) == (MODEL, online)


def test_a_diverged_flight_is_its_flown_part_or_raises(loops, monkeypatch):
    error = Diverged(3, "away")

    def diverge(*_, **__):
        raise error

    monkeypatch.setattr(_trial, "closed_loop", diverge)
    with pytest.raises(Diverged):
        run_trial(experiment())
    error.rollout = ROLLOUT
    flown = run_trial(experiment())
    assert (flown.rollout, flown.diverged, flown.controller.made_of) == (
        ROLLOUT,
        error,
        MODEL,
    )


def test_a_recording_sees_how_its_flight_ends(loops, monkeypatch):
    ends = []

    @contextmanager
    def open_recording(controller, training):
        try:
            yield STEP
        except Diverged as error:
            ends.append(str(error))
            raise
        ends.append("complete")

    run_trial(experiment(), open_recording)
    error = Diverged(3, "away")
    error.rollout = ROLLOUT

    def diverge(*_, on_step, **__):
        assert on_step is STEP
        raise error

    monkeypatch.setattr(_trial, "closed_loop", diverge)
    assert run_trial(experiment(), open_recording).diverged is error
    assert ends == ["complete", "step 3: away"]


def test_episodes_have_own_seeds_and_the_best_model_flies_last(monkeypatch):
    errors = [3.0, 1.0, 2.0]
    flown = []
    learned = []

    def learn(_, data, seed):
        learned.append((list(data), seed))
        return SimpleNamespace(posterior=f"model {len(learned)}")

    def fly(experiment, open_recording, model, training, warn):
        flown.append((experiment.seed, open_recording, model))
        return Flown(f"flight {len(flown)}", None, training)

    monkeypatch.setattr(Experiment, "training_rows", lambda _: ["rows"])
    monkeypatch.setattr(Experiment, "learn", learn)
    monkeypatch.setattr(_trial, "_fly", fly)
    monkeypatch.setattr(
        _trial, "rmse", lambda _, flown: errors[int(flown.rollout[-1]) - 1]
    )
    monkeypatch.setattr(
        EpisodicLearning, "with_flight", lambda _, data, rollout: [*data, rollout]
    )
    episodes = run_trial(
        experiment(model=None, seed=9, learning=EpisodicLearning(3)), "prepare"
    )
    seeds = [int(np.random.SeedSequence([9, k]).generate_state(1)[0]) for k in range(3)]
    models = ["model 1", "model 2", "model 3", "model 2"]
    assert flown == [
        (seed, "prepare", model)
        for seed, model in zip([*seeds, 9], models, strict=True)
    ]
    assert learned == [
        (["rows", *(f"flight {i}" for i in range(1, k))], 9) for k in (1, 2, 3)
    ]
    assert [each.rollout for each in episodes.before] == [
        "flight 1",
        "flight 2",
        "flight 3",
    ]
    assert episodes.rollout == "flight 4"


def test_an_experiment_trains_as_its_system_says(monkeypatch):
    calls = []

    def train(transitions, **arguments):
        calls.append((transitions, arguments))
        return "training"

    monkeypatch.setattr(_experiment, "train", train)
    flight = experiment(system=PENDULUM, trajectory=None, kinematics="learned")
    assert flight.learn("rows", 3) == "training"
    expected = {
        "system": PENDULUM,
        "trainer": flight.train,
        "kinematics": "learned",
        "seed": 3,
    }
    assert calls == [("rows", expected)]


class Rows:
    """Transitions of some dimensions."""

    def __init__(self, n, m):
        self.rows = Transitions(
            torch.arange(5.0 * n).reshape(5, n), torch.zeros(5, m), torch.zeros(5, n)
        )

    def transitions(self, system, trajectory, name):
        assert (system, trajectory, name) == (PLANT, Elliptical(), "mine")
        return self.rows

    def check(self, system, trajectory):
        raise SettingError(
            "data", f"{system.name} along {type(trajectory).__name__} is refused"
        )


def test_data_have_the_systems_dimensions_and_the_asked_rows():
    def drawn(n=6, m=3, **changes):
        return experiment(data=Rows(n, m), name="mine", **changes).training_rows()

    assert np.array_equal(drawn().states, Rows(6, 3).rows.states)
    assert len(drawn(size=5)) == 5
    assert np.array_equal(
        drawn(size=2, seed=1).states,
        Rows(6, 3).rows[random_rows(5, 2, 1)].states,
    )
    for n, m in ((6, 2), (5, 3)):
        with pytest.raises(
            ShapeError, match=rf"must have the same dimensions; got \({n}, {m}\)"
        ):
            drawn(n, m)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"learning": OnlineLearning(), "loop": "model"},
            "learning: needs a controller that learns a model, and a",
        ),
        (
            {"learning": OnlineLearning(), "controller": lambda plant: None},
            "learning: needs a controller that learns",
        ),
        ({"disturbances": [object()]}, "disturbances: must each name what it is"),
        ({"seed": -1}, "seed: must be a whole number, 0 or more"),
        (
            {"data": Rows(6, 3), "model": None},
            "data: translational along Elliptical is refused",
        ),
        (
            {
                "controller": partial(
                    steering, problem=Problem(Tracking([1] * 5, [1] * 3))
                )
            },
            "controller.problem: weighs 5 states and 3 inputs; translational has 6 "
            "and 3",
        ),
        (
            {
                "controller": partial(
                    steering, problem=Problem(Tracking([1] * 6, [1] * 2))
                )
            },
            "controller.problem: weighs 6 states and 2 inputs; translational has 6 "
            "and 3",
        ),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_learning(changes, message):
    with pytest.raises(SettingError, match=message):
        experiment(**changes)


def test_data_are_not_asked_where_nothing_is_learned_from_them():
    experiment(data=Rows(6, 3))
    experiment(data=Rows(6, 3), model=None, controller=lambda plant: None)


def test_noise_is_held_against_the_plant_where_there_is_one():
    with pytest.raises(ShapeError):
        experiment(noise=Noise(process=[0.1] * 5))
    experiment(noise=Noise(process=[0.1] * 5), loop="model")


def test_a_plan_leaves_out_what_a_learned_model_takes_for_noise():
    noisy = SimpleNamespace(noise_covariance=torch.diag(torch.tensor([4.0, 9.0])))
    other = SimpleNamespace(posterior=SimpleNamespace(noise_covariance=torch.eye(2)))
    assert experiment(model=noisy).unplanned_noise(None).tolist() == [2, 3]
    assert experiment(model=noisy).unplanned_noise(other).tolist() == [1, 1]
    assert (
        experiment(model=noisy, loop="model").unplanned_noise(None).tolist() == [0] * 6
    )
    holding = SimpleNamespace(process_noise=True)
    assert (
        experiment(model=noisy, propagator=holding).unplanned_noise(None).tolist()
        == [0] * 6
    )
    means_alone = experiment(model=noisy, propagator=holding)
    means = PredictionSettings(covariance="none")
    alone = partial(means_alone.controller, prediction=means)
    alone = replace(means_alone, controller=alone)
    assert alone.unplanned_noise(None).tolist() == [2, 3]
    compiled = SimpleNamespace(plans_means_alone=True)
    held = experiment(model=noisy, propagator=holding)
    assert held.unplanned_noise(None, compiled).tolist() == [2, 3]


def test_episodes_train_their_models():
    with pytest.raises(SettingError, match=r"\Alearning: episodes train their models"):
        experiment(learning=EpisodicLearning(2))


def test_learning_beside_an_estimate_is_refused_before_training():
    plain = experiment(learning=OnlineLearning())
    settings = PredictionSettings(disturbance_gain=0.3)
    estimating = partial(plain.controller, prediction=settings)
    with pytest.raises(SettingError, match=r"disturbance_gain: must be 0 beside onl"):
        replace(plain, controller=estimating)
