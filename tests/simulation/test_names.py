"""A controller steers what its model is of; series and tables are sorted by name."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from gpmpc.datasets import RandomData
from gpmpc.estimation import KalmanFilter, LateMeasurements, Measurement
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import train
from gpmpc.learning import EpisodicLearning, LearningController
from gpmpc.models import DelayedModel, DisturbedModel
from gpmpc.mpc import GPMPC, ControlLoop, ManyStarts, Problem, Reference, Tracking
from gpmpc.mpc.baselines import LQR, NMPC, StateFormMPC
from gpmpc.propagation import Linearization
from gpmpc.signals import Signals
from gpmpc.simulation import (
    Cascade,
    ModelLoop,
    Noise,
    cascade_loop,
    closed_loop,
    closed_loops,
)
from gpmpc.systems import Coupled, Rotational, System, Translational, pendulum, step


class Swapped:
    """A pendulum whose states are named in another order."""

    state_names = ("rate", "angle")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [np.float64(15.0) * x[1] + u[0], x[0]]


PLANT = pendulum(0.1)
PROBLEM = Problem(Tracking([1.0, 0.1], [0.1], penalized="inputs"))
START = pd.Series({"rate": -0.4, "angle": 0.3})
GOAL = pd.Series({"rate": 0.0, "angle": 0.2})
NUMBERS = np.array([0.3, -0.4])
TARGET = np.array([0.2, 0.0])


@pytest.fixture(scope="module")
def model():
    return train(RandomData(samples=15).transitions(PLANT), restarts=0).posterior


def gp_mpc(model, **settings):
    return GPMPC(model, Linearization(), PROBLEM, 3, [0.0], **settings)


@pytest.fixture(scope="module")
def controller(model):
    return gp_mpc(model)


def fly(controller, plant=PLANT, **changed):
    defaults = {"references": TARGET, "initial": NUMBERS, "steps": 3}
    return closed_loop(plant, controller, **defaults | changed)


def test_data_of_a_system_and_what_learns_from_them_know_it(model, controller):
    assert model.signals == controller.signals == PLANT.signals
    assert PLANT.signals == Signals(("angle", "rate"), ("torque",), 0.1)


@pytest.mark.parametrize(
    ("plant", "message"),
    [
        (
            System(Swapped(), 0.1),
            "the controller has the states angle, rate; Swapped has rate, angle, the",
        ),
        (pendulum(0.5), "has time steps of 0.1 s; pendulum has 0.5 s"),
    ],
    ids=["order", "time step"],
)
def test_a_plant_of_other_names_or_time_step_is_not_steered(
    controller, model, plant, message
):
    for steering in (
        controller,
        LearningController(controller),
        NMPC(PLANT, PROBLEM, 2, [0.0]),
        LQR(model, PROBLEM, 2, [0.0]),
        ManyStarts(controller),
    ):
        with pytest.raises(SettingError, match=message):
            fly(steering, plant)
    with pytest.raises(SettingError, match=message):
        closed_loops(plant, controller, TARGET, NUMBERS, 2, seeds=2)


def test_what_a_model_does_not_know_refuses_no_plant(model):
    for signals in (Signals(), Signals(time_step=0.1), Signals(("angle", "rate"))):
        unknown = gp_mpc(replace(model, signals=signals))
        assert np.array_equal(fly(unknown).inputs, fly(gp_mpc(model)).inputs)
    other = gp_mpc(replace(model, signals=Signals()))
    assert len(fly(other, System(Swapped(), 0.5), steps=1).inputs) == 1


def test_a_model_loop_takes_the_time_step_of_its_model(model, controller):
    loop = ModelLoop(model, Linearization())
    assert loop.time_step == 0.1
    assert fly(controller, loop).time_step == 0.1
    assert ModelLoop(replace(model, signals=Signals()), Linearization()).time_step == 1
    with pytest.raises(SettingError, match=r"time steps of 0.1 s; the model loop has"):
        ModelLoop(model, Linearization(), 0.5)


def test_a_controller_takes_no_model_of_other_names(model, controller):
    other = replace(model, signals=Signals(("rate", "angle")))
    with pytest.raises(SettingError, match="the same in another order"):
        controller.with_model(other)
    assert controller.with_model(replace(model, signals=Signals())).horizon == 3


def test_series_and_tables_fly_like_their_numbers_in_order(controller):
    plain = fly(controller)
    table = pd.DataFrame([GOAL] * 7)
    for changed in (
        {"initial": START},
        {"initial": Gaussian.certain(START)},
        {"references": GOAL},
        {"references": table},
        {"references": Reference(GOAL)},
        {"references": Reference(table)},
        {"references": Reference(TARGET, pd.Series({"torque": 0.0}))},
        {"noise": Noise(process=pd.Series({"rate": 0.0, "angle": 0.0}))},
    ):
        assert np.array_equal(fly(controller, **changed).states, plain.states)
    noise = {"rate": 0.5, "angle": 0.0}
    shaken = fly(controller, noise=Noise(process=pd.Series(noise)))
    assert np.array_equal(shaken.states[1, 0], plain.states[1, 0])
    assert not np.array_equal(shaken.states[1, 1], plain.states[1, 1])
    loop = ModelLoop(controller.prediction.model, Linearization())
    for start in (START, Gaussian.certain(START)):
        ends = [fly(controller, loop, initial=at).states for at in (NUMBERS, start)]
        assert np.array_equal(*ends) or isinstance(start, Gaussian)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_model_with_a_past_starts_from_what_is_measured(model, dtype):
    delayed = DelayedModel(model.to(dtype=dtype), 1)
    loop = ModelLoop(delayed, Linearization())
    controller = gp_mpc(DelayedModel(model, 1))
    ends = [
        fly(controller, loop, initial=start).states
        for start in (NUMBERS, START, Gaussian.certain(START))
    ]
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0][0], ends[2][0])


def test_a_controller_sorts_a_series_by_the_names_of_its_model(model, controller):
    for steering in (
        controller,
        NMPC(PLANT, PROBLEM, 2, [0.0]),
        LQR(model, PROBLEM, 2, [0.0]),
        StateFormMPC(model, Linearization(), PROBLEM, 2, [0.0]),
        LearningController(controller),
        ManyStarts(controller),
    ):
        plain = steering.control(Gaussian.certain(NUMBERS), Reference(TARGET))
        named = steering.control(Gaussian.certain(START), Reference(GOAL))
        assert np.array_equal(named.inputs, plain.inputs)
        assert np.allclose(named.means[0], NUMBERS, atol=1e-9)


def test_a_control_loop_sorts_states_and_references_by_name(controller):
    loops = [ControlLoop(controller) for _ in range(2)]
    table = pd.DataFrame([GOAL] * 4)
    for reference in (GOAL, table, Reference(table)):
        inputs = [
            loops[0].input(NUMBERS, TARGET),
            loops[1].input(START, reference),
        ]
        assert np.array_equal(*inputs)
    between = [
        loops[0].input_between(NUMBERS, 0.5),
        loops[1].input_between(START, 0.5),
    ]
    assert np.array_equal(*between)


def test_numbered_entries_and_unnamed_models_keep_their_order(model, controller):
    plain = fly(controller).states
    assert np.array_equal(fly(controller, initial=pd.Series(NUMBERS)).states, plain)
    unknown = gp_mpc(replace(model, signals=Signals()))
    inputs = [
        ControlLoop(unknown).input(state, TARGET)
        for state in (pd.Series({"rate": 0.3, "angle": -0.4}), NUMBERS)
    ]
    assert np.array_equal(*inputs)


@pytest.mark.parametrize(
    "call",
    [
        lambda controller, other: fly(controller, initial=other),
        lambda controller, other: fly(controller, references=other),
        lambda controller, other: fly(controller, initial=Gaussian.certain(other)),
        lambda controller, other: controller.control(
            Gaussian.certain(other), Reference(TARGET)
        ),
        lambda controller, other: controller.control(
            Gaussian.certain(NUMBERS), Reference(other)
        ),
        lambda controller, other: ControlLoop(controller).input(other, TARGET),
        lambda controller, other: ControlLoop(controller).input(NUMBERS, other),
        lambda controller, other: step(PLANT, other, [0.0]),
        lambda controller, other: (
            pendulum(0.1, mass=1.0) and System(PLANT.dynamics, 0.1, start=other)
        ),
    ],
)
def test_series_of_other_names_are_refused(controller, call):
    other = pd.Series({"angle": 0.1, "speed": 0.0})
    with pytest.raises(DataError, match="must have the names angle, rate; got angle, "):
        call(controller, other)


def test_a_plant_steps_and_starts_from_series(model):
    torque = pd.Series({"torque": 0.1})
    assert np.array_equal(step(PLANT, START, torque), step(PLANT, NUMBERS, [0.1]))
    named = System(PLANT.dynamics, 0.1, start=START, initial_input=torque)
    assert (named.start, named.initial_input) == ((0.3, -0.4), (0.1,))
    same = GPMPC(model, Linearization(), PROBLEM, 3, torque)
    assert np.array_equal(same.initial_input, [0.1])
    with pytest.raises(DataError, match="initial_input must have the names torque"):
        GPMPC(model, Linearization(), PROBLEM, 3, pd.Series({"push": 0.1}))


def test_filters_sort_beliefs_inputs_and_measurements_by_name(model):
    measurement = Measurement.of_states(2, [1, 0], [0.1, 0.2])
    filter = KalmanFilter.extended(model, measurement)
    belief = Gaussian.certain(NUMBERS)
    torque = pd.Series({"torque": 0.1})
    prior = filter.predict(Gaussian.certain(START), torque)
    assert torch.equal(prior.mean, filter.predict(belief, [0.1]).mean)
    seen = pd.Series({"angle": 0.3, "rate": -0.5})
    posterior_mean = filter.update(prior, seen).belief.mean
    assert torch.equal(posterior_mean, filter.update(prior, [-0.5, 0.3]).belief.mean)
    log = pd.DataFrame([seen, seen])
    whole = filter.run(Gaussian.certain(START), pd.DataFrame([torque]), log)
    plain = filter.run(belief, [[0.1]], [[-0.5, 0.3]] * 2)
    assert torch.equal(whole.filtered.mean, plain.filtered.mean)
    late = LateMeasurements(filter, Gaussian.certain(START))
    assert torch.equal(late.step(torque).mean, prior.mean)
    with pytest.raises(DataError, match="must have the names rate, angle; got x, y"):
        filter.update(prior, pd.Series({"x": 0.3, "y": -0.5}))


def test_beliefs_are_sorted_and_another_order_is_refused(model):
    belief = Gaussian.certain(NUMBERS)
    named = Gaussian.certain(START)
    delayed = DelayedModel(model, 1)
    effect = torch.eye(2, dtype=torch.float64)
    disturbed = DisturbedModel(model, effect, [0.1, 0.1])
    for augment in (
        lambda at: delayed.augmented(at, pd.DataFrame({"torque": [0.1]})),
        lambda at: disturbed.augmented(at, [0.1, 0.1]),
    ):
        assert torch.equal(augment(named).mean, augment(belief).mean)
    torque = torch.zeros(1, dtype=torch.float64)
    with pytest.raises(SettingError, match="belief: .* it has rate, angle, the same"):
        Linearization()(model, named, torque)
    sorted_by_name = named.in_order(("angle", "rate"))
    next_belief = Linearization()(model, sorted_by_name, torque)
    assert torch.equal(next_belief.mean, Linearization()(model, belief, torque).mean)


def test_a_belief_in_order_takes_its_covariance_along():
    covariance = torch.tensor([[4.0, 1.0], [1.0, 9.0]])
    belief = Gaussian(torch.tensor([1.0, 2.0]), covariance, ("a", "b"))
    reordered = belief.in_order(("b", "a"))
    assert reordered.mean.tolist() == [2.0, 1.0]
    assert reordered.covariance.tolist() == [[9.0, 1.0], [1.0, 4.0]]


def test_a_cascade_checks_both_loops():
    problem = Problem(Tracking([1.0] * 6, [1.0] * 3, penalized="inputs"))
    plant = System(Coupled(), 0.05, 1)
    outer = NMPC(System(Translational(), 1.0, 1), problem, 1, [7.26, 0, 0])
    inner = NMPC(System(Rotational(), 0.05, 1), problem, 1, [0, 0, 0])
    late = NMPC(System(Rotational(), 0.1, 1), problem, 1, [0, 0, 0])
    references = np.zeros((3, 6))
    for cascade, message in (
        (Cascade(outer, late), "0.1 s; the inner loop has 0.05 s"),
        (Cascade(outer, inner, ratio=10), "1 s; the outer loop has 0.5 s"),
        (Cascade(inner, outer), "states phi, p, .*; the outer loop has x, vx"),
    ):
        with pytest.raises(SettingError, match=message):
            cascade_loop(plant, cascade, references, np.zeros(12), 1)


def test_a_flight_of_another_time_step_joins_no_data(controller):
    data = RandomData(samples=15).transitions(PLANT)
    learning = EpisodicLearning()
    flight = fly(controller)
    assert learning.with_flight(data, flight).signals == PLANT.signals
    with pytest.raises(SettingError, match="the data has time steps of 0.1 s"):
        learning.with_flight(data, replace(flight, time_step=0.5))


def test_a_system_without_a_time_step_is_refused():
    with pytest.raises(
        SettingError, match=r"time_step: must be a number above 0 \[s\]"
    ):
        System(PLANT.dynamics)
