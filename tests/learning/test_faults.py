"""Sensors that lie make no flight worse than one without learning."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.learning import (
    ChangedModel,
    LearningController,
    LearningState,
    OnlineLearning,
    learn_from_step,
)
from gpmpc.models import ResidualModel
from gpmpc.mpc import GPMPC, Box, ControlLoop, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.status import Status
from tests.learning.test_online import (
    MODEL,
    NOISE,
    PROBLEM,
    STEP,
    cart,
    excited,
    taught_along,
)

STEPS = 120
HORIZON = 8
NAN = np.nan
WIND = 0.6
TIME = STEP * np.arange(STEPS + HORIZON + 1)
SINE = np.stack([np.sin(TIME), np.cos(TIME)], axis=1)


class Sensor:
    """Shows position and velocity, with the faults that are written into its arrays."""

    def __init__(self):
        self.offset = np.zeros((STEPS, 2))
        self.factor = np.ones((STEPS, 2))
        self.frozen = np.zeros((STEPS, 2), dtype=bool)
        self.shown = np.zeros(2)

    def __call__(self, k, state):
        seen = self.factor[k] * state + self.offset[k]
        self.shown = np.where(self.frozen[k], self.shown, seen)
        return self.shown


def second(random):
    """The steps of one second of the flight."""
    start = int(random.integers(60, 90))
    return slice(start, start + 10)


def sound(random):
    return Sensor()


def glitches(count, size, entry=0):
    def fault(random):
        sensor = Sensor()
        steps = random.choice(np.arange(10, STEPS - 5), count, replace=False)
        sensor.offset[steps, entry] = size * random.choice([-1, 1], count)
        return sensor

    return fault


def missing(part):
    def fault(random):
        sensor = Sensor()
        sensor.offset[random.random(STEPS) < part] = NAN
        return sensor

    return fault


def frozen(*entries):
    def fault(random):
        sensor = Sensor()
        sensor.frozen[second(random), entries] = True
        return sensor

    return fault


def unit(factor, *entries):
    def fault(random):
        sensor = Sensor()
        sensor.factor[second(random), entries] = factor
        return sensor

    return fault


def noisy(random):
    sensor = Sensor()
    sensor.offset[second(random)] = random.normal(0, [0.03, 0.2], (10, 2))
    return sensor


FAULTS = {
    "one glitch of .05": glitches(1, 0.05),
    "five glitches of .5": glitches(5, 0.5),
    "twenty glitches of .05": glitches(20, 0.05),
    "twenty glitches of 2": glitches(20, 2.0),
    "five glitches of .5 m/s": glitches(5, 0.5, entry=1),
    "5 % missing": missing(0.05),
    "frozen": frozen(0, 1),
    "frozen position": frozen(0),
    "times 1000": unit(1000.0, 0),
    "degrees": unit(180 / np.pi, 0),
    "noisy": noisy,
}


def controller_of(learning):
    plain = GPMPC(MODEL, Linearization(), PROBLEM, HORIZON, [0.0])
    return plain if learning is None else LearningController(plain, learning)


def flown(learning, fault, wind=0.0, seed=0):
    """Errors of the position (120,) and decisions; a wind blows from step 40 on."""
    sensor = fault(np.random.default_rng([seed, 7]))
    noise = np.random.default_rng(seed)
    loop = ControlLoop(controller_of(learning))
    state = SINE[0].copy()
    errors = []
    decisions = []
    for k in range(STEPS):
        input = loop.input(sensor(k, state), SINE[k : k + HORIZON + 1])
        state = cart(state, input, wind=wind if k >= 40 else 0.0)
        state = state + noise.normal(0, NOISE)
        errors.append(state[0] - SINE[k + 1, 0])
        decisions.append(loop.last.decision)
    return np.array(errors), decisions


def rms(learning, fault, wind=0.0):
    errors = [flown(learning, fault, wind, seed)[0] for seed in range(2)]
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_a_sensor_that_lies_makes_learning_no_worse_than_none(fault):
    assert rms(OnlineLearning(), fault) <= 1.1 * rms(None, fault)


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_in_a_wind_as_well(fault):
    assert rms(OnlineLearning(), fault, WIND) <= 1.3 * rms(None, fault, WIND)


@pytest.mark.parametrize(
    "fault",
    [
        glitches(5, 0.05),
        glitches(5, 0.05, entry=1),
        glitches(5, 0.5),
        glitches(5, 2.0, entry=1),
        missing(0.05),
    ],
    ids=["position", "velocity", "large", "large velocity", "missing"],
)
def test_the_wind_is_learned_between_wrong_measurements(fault):
    alone = rms(OnlineLearning(), sound, WIND)
    assert rms(OnlineLearning(), fault, WIND) <= 1.5 * alone
    assert alone < 0.2 * rms(None, sound, WIND)


def test_a_measurement_in_doubt_is_not_acted_on():
    sensor = Sensor()
    sensor.offset[60] = [0.5, 0.0]
    sensor.offset[90:93] = [[-0.5, 0.0], [0.0, 2.0], [-0.5, 0.0]]
    errors, decisions = flown(OnlineLearning(), lambda random: sensor)
    assert np.abs(errors[50:]).max() < 0.02
    for k in (60, 90, 91, 92):
        learned = decisions[k].learned
        expected = learned.assumed
        is_wrong = sensor.offset[k] != 0.0
        assert np.array_equal(expected.mean == learned.state, ~is_wrong)
        assert np.array_equal(np.diagonal(expected.covariance) == 0.0, ~is_wrong)
        assert np.array_equal(decisions[k].means[0], expected.mean)
        assert np.array_equal(decisions[k].covariances[0], expected.covariance)
    assert decisions[61].learned.assumed is None


def test_a_doubt_outlives_a_measurement_that_is_missing():
    sensor = Sensor()
    sensor.offset[60:63, 0] = [0.5, NAN, 0.5]
    errors, decisions = flown(OnlineLearning(), lambda random: sensor)
    assert np.abs(errors[50:]).max() < 0.03
    for k in (60, 62):
        assert decisions[k].learned.sensors_in_doubt.tolist() == [True, False]


def test_a_wind_is_learned_where_each_third_step_is_missing():
    sensor = Sensor()
    sensor.offset[2::3] = NAN
    errors, decisions = flown(OnlineLearning(), lambda random: sensor, WIND)
    assert all(one.learned.active for one in decisions[60:] if one is not None)
    assert np.abs(errors[60:]).max() < 0.05


def test_a_push_is_told_from_a_change_by_what_follows():
    states, inputs = excited(40, wind_from=20)
    learned = taught_along(states[:31], inputs[:30])[-1]
    pushed = cart(states[30], inputs[30], wind=0.8) + np.array([0.0, 0.08])
    after = learn_from_step(learned, inputs[30], pushed)
    points = {len(one.model) for one in after.explanations if one.expected.is_certain}
    assert points >= {len(learned.model), len(learned.model) + 1}


def test_a_sensor_wrong_twice_alike_moves_no_plant():
    sensor = Sensor()
    sensor.offset[60:62, 0] = 0.5
    errors, _ = flown(OnlineLearning(), lambda random: sensor)
    assert np.abs(errors[50:]).max() < 0.03


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_measurement_that_is_missing_after_a_doubt_is_missing(dtype):
    sensor = Sensor()
    sensor.offset[60] = [0.5, 0.0]
    _, decisions = flown(OnlineLearning(), lambda random: sensor)
    before, doubted = decisions[59:61]
    controller = controller_of(OnlineLearning())
    reference = Reference(torch.as_tensor(SINE[60 : 60 + HORIZON + 1]))
    shown = torch.as_tensor(doubted.learned.state).to(dtype)
    again = controller.control(Gaussian.certain(shown), reference, before)
    assert again.learned.sensors_in_doubt.tolist() == [True, False]
    assert np.array_equal(again.means[0], again.learned.planned_state)
    nothing = Gaussian.certain(torch.full((2,), torch.nan, dtype=dtype))
    missed = controller.control(nothing, reference, again)
    assert missed.status is Status.INVALID_MEASUREMENT


@pytest.mark.parametrize("entry", [0, 1])
@pytest.mark.parametrize("at", [20, 21, 22])
def test_a_change_is_found_beside_a_wrong_measurement(at, entry):
    states, inputs = excited(40, wind_from=20)
    states[at, entry] -= 0.5
    steps = taught_along(states, inputs)
    # Two measurements of the new plant, beside the wrong one, and at most one more.
    assert all(one.active for one in steps[24:])


def change_at(learned):
    """What the change is at rest, in deviations of the noise (2,)."""
    at_rest = (np.zeros((1, 2)), np.zeros((1, 1)))
    difference = learned.model.linearize(*at_rest).mean - MODEL.linearize(*at_rest).mean
    return difference[0] / NOISE


@pytest.mark.parametrize("entry", [0, 1])
@pytest.mark.parametrize("size", [0.15, -1.0])
def test_a_glitch_teaches_nothing(entry, size):
    states, inputs = excited(30)
    sound_steps = taught_along(states, inputs)
    states[21, entry] += size
    before, glitch, after, later = taught_along(states, inputs)[19:23]
    assert before.assumed is None
    assert np.flatnonzero(glitch.sensors_in_doubt).tolist() == [entry]
    assert after.assumed is None
    assert not any(one.active for one in (glitch, after, later))
    assert np.abs(change_at(after) - change_at(sound_steps[21])).max() < 0.5
    assert np.abs(change_at(later) - change_at(sound_steps[22])).max() < 0.5


def test_a_flight_keeps_its_own_numbers():
    states, inputs = excited(30, wind_from=15)
    expected = taught_along(states, inputs)[-1]
    state = states[0].copy()
    input = np.empty(1)
    learned = LearningState.begin(ChangedModel(MODEL), state)
    for k in range(30):  # a loop that reuses its buffers
        state[:] = states[k + 1]
        input[:] = inputs[k]
        learned = learn_from_step(learned, input, state)
    assert np.array_equal(learned.observed_change, expected.observed_change)
    assert np.array_equal(learned.leads, expected.leads)


def test_a_changed_plant_is_learned_from_its_first_steps():
    states, inputs = excited(40, wind_from=20)
    steps = taught_along(states, inputs)
    assert not any(one.active for one in steps[:20])
    assert all(one.active for one in steps[21:])
    assert len(steps[21].model) == 2


def two_carts(state, inputs, wind=0.0):
    one = cart(state[:2], inputs[:1], wind=wind)
    other = cart(state[2:], inputs[1:], wind=-wind)
    return np.concatenate([one, other])


def test_a_new_plant_that_explains_all_sensors_but_one_is_used():
    random = np.random.default_rng(0)
    noise = np.tile(NOISE, 2)
    inputs = random.uniform(-3, 3, (120, 2))
    states = [np.zeros(4)]
    for k, input in enumerate(inputs):
        state = two_carts(states[-1], input, wind=0.8 if k >= 110 else 0.0)
        states.append(state + random.normal(0, noise))
    data = Transitions(states[:90], inputs[:90], states[1:91])
    model = Trainer(predicts="difference", restarts=0)(data).posterior
    states[112][0] += 0.5
    begin = LearningState.begin(ChangedModel(model), states[90])
    steps = taught_along(states[90:], inputs[90:], begin)
    beside_glitch = steps[21]
    assert beside_glitch.planning is beside_glitch.model
    assert beside_glitch.sensors_in_doubt.tolist() == [True, False, False, False]
    planned_position = beside_glitch.planned_state[0]
    assert planned_position == pytest.approx(states[112][0] - 0.5, abs=0.05)
    assert steps[22].active
    assert steps[22].assumed is None


def test_a_change_that_acts_like_an_input_is_used_at_once():
    states, inputs = excited(20)
    learned = taught_along(states, inputs)[-1]
    blown = cart(states[-1], [1.0], wind=1.0)
    changed = learn_from_step(learned, np.array([1.0]), blown)
    assert changed.planning is changed.model
    assert changed.assumed is None
    assert changed.size == len(MODEL) + 1
    assert changed.after_gap(blown).version > changed.version


@pytest.mark.parametrize("size", [0.1, 0.5])
def test_a_glitch_as_the_plant_changes_is_no_change(size):
    states, inputs = excited(20)
    learned = taught_along(states, inputs)[-1]
    input = np.array([1.0])
    state = states[-1]
    for k in range(3):
        state = cart(state, input, wind=1.0)
        glitch = np.array([size, 0.0]) if k == 0 else np.zeros(2)
        learned = learn_from_step(learned, input, state + glitch)
    assert learned.assumed is None
    assert learned.planning is not None
    mean = learned.planning.linearize(state[None], input[None]).mean[0]
    assert np.abs((mean - cart(state, input, wind=1.0)) / NOISE).max() < 3.0


def test_a_plant_that_was_moved_teaches_nothing():
    states, inputs = excited(40)
    random = np.random.default_rng(5)
    state = states[20] + [0.0, 0.4]
    states[20] = state
    for k in range(20, 40):
        state = cart(state, inputs[k]) + random.normal(0, NOISE)
        states[k + 1] = state
    steps = taught_along(states, inputs)
    assert steps[19].sensors_in_doubt[1]
    assert all(one.assumed is None for one in steps[20:])
    assert not any(one.active for one in steps)


def test_a_large_change_is_less_probable():
    states, inputs = excited(20)
    learned = taught_along(states, inputs)[-1]
    leads = []
    for size in (0.08, 0.3, 0.6):
        after = cart(states[-1], [1.0]) + np.array([0.1 * size, size])
        explanations = learn_from_step(learned, np.array([1.0]), after).explanations
        changed = [
            one.log_weight
            for one in explanations
            if one.began is not None and one.expected.is_certain
        ]
        leads.append(max(changed, default=-np.inf))
    assert leads[0] == 0.0  # the heaviest
    assert leads[0] > leads[1] >= leads[2]


def test_a_frozen_sensor_is_no_witness_of_a_change():
    states, inputs = excited(30)
    states[21:26, 0] = states[20, 0]
    states[20:, 1] += 0.5  # it moves, by the other sensor
    steps = taught_along(states, inputs)
    assert all(one.sensors_in_doubt[0] for one in steps[21:25])
    assert not any(one.active for one in steps[:26])


def test_a_change_that_ends_beside_a_glitch_is_not_used_on():
    states, inputs = excited(40, wind_from=20)
    learned = taught_along(states, inputs)[-1]
    assert learned.active
    random = np.random.default_rng(0)
    state = states[-1]
    for k in range(4):  # the wind has ceased
        input = random.uniform(-3, 3, 1)
        state = cart(state, input) + random.normal(0, NOISE)
        wrong = np.array([0.5, 0.0]) if k == 0 else np.zeros(2)
        learned = learn_from_step(learned, input, state + wrong)
    planning = MODEL if learned.planning is None else learned.planning
    mean = planning.linearize(state[None], np.zeros((1, 1))).mean[0]
    assert np.abs((mean - cart(state, [0.0])) / NOISE).max() < 3.0


def test_a_measurement_that_is_missing_forgets_nothing():
    _, decisions = flown(OnlineLearning(), sound, WIND)
    before = decisions[60]
    controller = controller_of(OnlineLearning())
    reference = Reference(SINE[: HORIZON + 1])
    lost = controller.control(Gaussian.certain(np.full(2, NAN)), reference, before)
    assert lost.status is Status.INVALID_MEASUREMENT
    assert lost.learned.active
    assert lost.learned.model.change is before.learned.model.change
    state = Gaussian.certain(before.means[2])
    again = controller.control(state, reference, lost).learned
    assert again.active
    assert again.model.change is before.learned.model.change
    assert np.array_equal(again.state, before.means[2])


def test_what_was_learned_is_used_at_once_after_a_gap():
    sensor = Sensor()
    sensor.offset[80:84] = NAN
    _, decisions = flown(OnlineLearning(), lambda random: sensor, WIND)
    assert all(decision is None for decision in decisions[80:84])
    assert all(decision.learned.active for decision in decisions[84:])
    points = len(decisions[79].learned.model)
    assert len(decisions[84].learned.model) == points


def test_a_decision_that_fails_is_taken_without_the_change(monkeypatch):
    _, decisions = flown(OnlineLearning(), sound, WIND)
    before = decisions[60]
    assert before.learned.active
    controller = controller_of(OnlineLearning())
    plain = controller.controller

    class Failing:
        def control(self, belief, reference, previous):
            decision = plain.control(belief, reference, previous)
            return replace(decision, status=Status.INFEASIBLE, suboptimal=False)

    monkeypatch.setattr(plain, "with_model", lambda model: Failing())
    state = Gaussian.certain(before.means[1])
    reference = Reference(SINE[: HORIZON + 1])
    decision = controller.control(state, reference, before)
    assert decision.applicable
    assert not decision.learned.active
    assert decision.learned.heaviest.active  # the next decision may use the change
    assert decision.learned.size == len(MODEL)
    alone = plain.control(state, reference, before)
    assert decision.iterations == 2 * alone.iterations  # of both attempts


@pytest.mark.parametrize("invalid", [1e200, np.finfo(float).max, np.inf])
def test_an_absurd_measurement_ends_no_flight(invalid):
    def marked(random):
        sensor = Sensor()
        sensor.offset[50, 0] = invalid
        return sensor

    with np.errstate(all="raise"):
        errors, decisions = flown(OnlineLearning(), marked, WIND)
    assert np.abs(errors[70:]).max() < 0.1
    assert decisions[-1].learned.assumed is None
    assert decisions[-1].learned.active


@pytest.mark.parametrize(("first", "second"), [(0.0, 0.3), (-0.1, 5.0), (0.1, 5.0)])
def test_two_wrong_levels_are_bridged_far_from_the_data_too(first, second):
    """At none the root has no slope, and below no number."""
    random = np.random.default_rng(0)

    def tank(x, u):
        return x + 0.1 * (u - torch.sqrt(x))

    def filled(level, inflow):
        return level + 0.1 * (inflow - np.sqrt(level)) + 0.01 * np.sin(3.0 * level)

    levels = random.uniform(0.2, 2.0, (60, 1))
    inflows = random.uniform(0.0, 2.0, (60, 1))
    after = filled(levels, inflows) + random.normal(0.0, 0.002, (60, 1))
    rows = Transitions(levels, inflows, after)
    model = ResidualModel.train(tank, rows, trainer=Trainer(restarts=0))
    problem = Problem(Tracking([1.0], [0.1]), Box([0.0], [2.0]))
    loop = ControlLoop(
        LearningController(GPMPC(model, Linearization(), problem, HORIZON, [1.0]))
    )
    level = np.ones(1)
    for k in range(20):
        wrong = {8: np.full(1, first), 9: np.full(1, second)}
        measured = wrong.get(k, level + random.normal(0.0, 0.002, 1))
        level = filled(level, loop.input(measured, [1.0]))
        assert abs(level - 1.0) < 0.02
    assert loop.failures == 0
    assert loop.last is not None
    assert loop.last.plan is not None
    assert loop.last.plan.learned.assumed is None


def test_steps_without_a_measurement_count_as_time():
    loop = ControlLoop(controller_of(OnlineLearning()))
    for k in range(20):
        loop.input([NAN, NAN] if 5 <= k < 15 else [0.0, 0.01 * k], np.zeros(2))
    assert loop.last.plan.learned.model.time == 19.0


def test_what_a_failed_decision_was_taught_is_not_lost():
    class Failing(GPMPC):
        fails = False

        def control(self, *arguments, **options):
            decision = super().control(*arguments, **options)
            if not self.fails:
                return decision
            return replace(decision, status=Status.INFEASIBLE, suboptimal=False)

    plain = Failing(MODEL, Linearization(), PROBLEM, HORIZON, [0.0])
    loop = ControlLoop(LearningController(plain, OnlineLearning()))
    for k in range(8):
        plain.fails = k == 6
        loop.input([0.0, 0.01 * k], np.zeros(2))
        learned = loop.last.plan.learned
        assert learned.state.tolist() == [0.0, 0.01 * k]
        assert learned.model.time == k


@pytest.mark.parametrize(("lost", "steps"), [((), 10), ((14, 15), 7)])
def test_a_flight_teaches_while_its_decisions_fail(lost, steps, monkeypatch):
    """What was applied and what came of it is known, but around a dropout."""
    controller = controller_of(OnlineLearning())
    decide = controller.controller.control

    def fail(*arguments):
        decision = decide(*arguments)
        return replace(decision, status=Status.INFEASIBLE, suboptimal=False)

    loop = ControlLoop(controller)
    random = np.random.default_rng(0)
    state = SINE[0].copy()
    sizes = []
    for k in range(21):
        if k == 10:
            monkeypatch.setattr(controller.controller, "control", fail)
        measured = np.full(2, NAN) if k in lost else state
        input = loop.input(measured, SINE[k : k + HORIZON + 1])
        state = cart(state, input) + random.normal(0, NOISE)
        sizes.append(len(loop.last.plan.learned.model))
    assert sizes[20] - sizes[10] == steps
    assert loop.last.plan.learned.model.time == 20.0


def test_feedback_between_plans_is_that_of_the_controller():
    inputs = []
    for learning in (None, OnlineLearning()):
        loop = ControlLoop(controller_of(learning))
        loop.input(np.zeros(2), np.array([0.1, 0.0]))
        inputs.append(loop.input_between([0.05, 0.0], 0.5))
    assert inputs[0] == inputs[1]
    assert inputs[0] != loop.input_between([0.06, 0.0], 0.5)


def test_feedback_between_plans_is_not_that_of_a_sensor_in_doubt():
    states, _ = excited(8)
    loop = ControlLoop(controller_of(OnlineLearning()))
    for state in states[:7]:
        loop.input(state, np.zeros(2))
    doubted = loop.last.decision.means[1] + [0.5, 0.0]
    loop.input(doubted, np.zeros(2))
    assert loop.last.decision.learned.sensors_in_doubt.tolist() == [True, False]
    between = loop.input_between(doubted, 0.0)
    assert between == pytest.approx(loop.last.decision.input)
    assert between != loop.input_between(np.add(doubted, [0.0, 0.1]), 0.0)
    loop.input(np.full(2, np.nan), np.zeros(2))
    between = loop.input_between(doubted, 0.0)
    assert between == loop.input_between(np.add(doubted, [0.3, 0.0]), 0.0)


def test_a_first_plan_is_handed_on():
    plan = 0.1 * np.ones((HORIZON, 1))
    inputs = [
        ControlLoop(controller_of(learning)).input(np.ones(2), np.zeros(2), plan=plan)
        for learning in (None, OnlineLearning())
    ]
    assert inputs[0] == inputs[1]
