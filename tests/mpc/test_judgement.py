"""A flight is suspicious or lost when something breaks, and healthy otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.judgement import Frozen, Late, Reversed, tank
from gpmpc.exceptions import ShapeError
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import CasadiFunction, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Decision,
    FlightJudge,
    FlightJudgement,
    Halfspaces,
    Judgement,
    PredictionSettings,
    Problem,
    Reference,
    Timing,
    Tracking,
)
from gpmpc.propagation import Linearization
from gpmpc.simulation import (
    Disturbance,
    Dropout,
    Gust,
    Noise,
    Replaced,
    closed_loop,
    closed_loops,
)
from gpmpc.status import Status
from gpmpc.systems import double_integrator

PLANT = double_integrator()
T = PLANT.time_step
NOISE = Noise(measurement=[0.003, 0.003])
WAY = np.zeros((161, 2))  # to and fro, so that something moves at every step
WAY[:, 0] = np.sin(0.6 * T * np.arange(161))
WAY[:, 1] = 0.6 * np.cos(0.6 * T * np.arange(161))


def controller(horizon=15, **settings):
    model = KnownModel(CasadiFunction(successor_function(PLANT)), 2, 1)
    problem = Problem(
        Tracking([1.0, 0.1], [0.01]), inputs=Box([-1.0], [1.0]), **settings
    )
    prediction = PredictionSettings(covariance="none")
    return GPMPC(model, Linearization(), problem, horizon, [0.0], prediction)


CONTROLLER = controller()


def fly(*disturbances, noise=NOISE, steps=80, seed=0, references=WAY, law=CONTROLLER):
    return closed_loop(
        PLANT,
        law,
        references,
        WAY[0],
        steps,
        noise=noise,
        disturbances=disturbances,
        on_failure="previous_plan",
        seed=seed,
    )


def levels(rollout):
    return [judgement.level for judgement in rollout.judgements]


class Glitch(Disturbance):
    """One wrong measurement."""

    def disturb_measurement(self, state, time):
        is_wrong = time == pytest.approx(40 * T)
        return np.array([state[0] + 0.5 * is_wrong, state[1]])


class Rounded(Disturbance):
    """A position that is shown in coarse steps."""

    def disturb_measurement(self, state, time):
        return np.array([np.round(state[0], 2), state[1]])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", [None, NOISE])
def test_a_flight_without_faults_is_healthy_at_every_step(noise, seed):
    rollout = fly(noise=noise, seed=seed)
    assert levels(rollout) == ["healthy"] * 80
    assert rollout.judgement == FlightJudgement()


@pytest.mark.parametrize("nothing", [Glitch(), Rounded()])
def test_one_wrong_measurement_or_a_coarse_sensor_is_no_alarm(nothing):
    assert fly(nothing).judgement == FlightJudgement()


@pytest.mark.parametrize(
    "broken",
    [
        Reversed(0, 40 * T),
        Frozen([0], 40 * T),
        Late(4, 40 * T),
        Replaced(replace(PLANT, dynamics=replace(PLANT.dynamics, mass=2.0)), 40 * T),
        Gust({"velocity": 1.0}, 40 * T, np.inf),
    ],
)
@pytest.mark.parametrize("seed", range(2))
def test_what_breaks_is_called_within_twenty_steps(broken, seed):
    judged_levels = levels(fly(broken, seed=seed))
    assert judged_levels[:40] == ["healthy"] * 40
    assert set(judged_levels[40:60]) > {"healthy"}


def test_a_plant_that_stops_obeying_is_lost_since_that_step():
    rollout = fly(Reversed(0, 40 * T), steps=120)
    judgement = rollout.judgement
    assert judgement.level == "lost"
    assert judgement.step == levels(rollout).index("lost") > 40
    assert (judgement.suspicious, judgement.lost) == (
        levels(rollout).count("suspicious"),
        levels(rollout).count("lost"),
    )
    assert judgement.reason.startswith("ever faster away from its reference")


def test_a_gust_is_suspicious_and_over_when_it_is_over():
    rollout = fly(Gust({"velocity": 0.5}, 40 * T, 55 * T))
    assert "lost" not in levels(rollout)
    assert "suspicious" in levels(rollout)[40:60]
    assert rollout.judgement == FlightJudgement(suspicious=rollout.judgement.suspicious)


def test_reasons_name_states_and_inputs():
    frozen = fly(Frozen([0], 40 * T)).judgements[44]
    assert frozen.reason.startswith("position is measured the same for 4 steps")
    judge = FlightJudge(CONTROLLER.problem)
    assert "state 0" in judged_alone(judge, frozen_from=20)[-1].reason


def judged_alone(judge, frozen_from):
    """Judgements of a point that is to stand still, and whose first sensor freezes."""
    rng = np.random.default_rng(0)
    judgements = []
    for k in range(30):
        measured = rng.normal(0.0, 0.01, 2)
        if k >= frozen_from:
            measured[0] = 0.005
        judgements.append(judge.judge(measured, np.zeros(2), plan_of(measured)))
    return judgements


def plan_of(state, **changes):
    H = 5
    return Decision(
        np.zeros(1),
        np.zeros((H, 1)),
        np.tile(state, (H + 1, 1)),
        np.zeros((H + 1, 2, 2)),
        **({"status": Status.SOLVED, "iterations": 1, "timing": Timing()} | changes),
    )


def test_a_sensor_that_freezes_is_named_after_four_steps():
    judgements = judged_alone(FlightJudge(CONTROLLER.problem), frozen_from=20)
    assert {judgement.level for judgement in judgements[:24]} == {"healthy"}
    assert judgements[24].reason.startswith("state 0 is measured the same for 4 steps")


def test_failed_decisions_are_suspicious_from_the_third_on():
    judge = FlightJudge(CONTROLLER.problem)
    for k in range(20):
        status = Status.INFEASIBLE if k >= 10 else Status.SOLVED
        judgement = judge.judge(
            np.zeros(2), np.zeros(2), plan_of(np.zeros(2), status=status)
        )
        assert judgement.level == ("suspicious" if k >= 12 else "healthy")
    assert judgement.reason == "8 of the last 8 decisions could not be applied"
    for _ in range(8):
        judgement = judge.judge(np.zeros(2), np.zeros(2), plan_of(np.zeros(2)))
    assert judgement == Judgement()


def judged_at_half_rate(first_measured):
    """Judgements of a point whose second sensor is read every second step."""
    rng = np.random.default_rng(0)
    judge = FlightJudge(CONTROLLER.problem)
    judgements = []
    for k in range(60):
        measured = rng.normal(0.0, 0.01, 2)
        if k % 2 != first_measured:
            measured[1] = np.nan
        judgements.append(judge.judge(measured, np.zeros(2), plan_of(np.zeros(2))))
    return judgements


@pytest.mark.parametrize("first_measured", [0, 1])
def test_a_sensor_at_half_rate_is_no_alarm(first_measured):
    assert set(judged_at_half_rate(first_measured)) == {Judgement()}


def test_each_input_at_a_bound_has_its_own_yardstick():
    box = Box([-1.0, -1.0], [1.0, 1.0])
    judge = FlightJudge(Problem(Tracking([1.0, 0.0], [0.01, 0.01]), inputs=box))
    for k in range(45):
        distance = 1.2 if k == 30 else 1.0
        second = 1.0 if k >= 30 else 0.0
        plan = plan_of(np.array([distance, 0.0]))
        inputs = np.tile([1.0, second], (5, 1))
        plan = replace(plan, input=inputs[0], inputs=inputs)
        judgement = judge.judge(plan.means[0], np.zeros(2), plan)
    assert judgement.reason.startswith("input 0 is at its bound for 45 steps")


def test_plans_cheaper_than_the_first_do_not_climb():
    judge = FlightJudge(CONTROLLER.problem)
    distances = np.concatenate([np.full(10, 10.0), np.linspace(2.0, 1.0, 25)])
    distances = np.concatenate([distances, 1.2 ** np.arange(25)])
    reasons = []
    for k, distance in enumerate(distances):
        following = distances[min(k + 1, len(distances) - 1)]
        means = np.tile([following, 0.1 * following], (6, 1))
        means[0] = [distance, 0.1 * distance]
        plan = replace(plan_of(np.zeros(2)), means=means)
        reasons.append(judge.judge(means[0], np.zeros(2), plan).reason)
    rising = [reason for reason in reasons if "although the model" in reason]
    assert rising[0].startswith("the plans have stopped falling and rise: they cost 0.")


@pytest.mark.parametrize("variance", [0.0, 9.0])
def test_plans_far_from_data_are_suspicious_away_from_the_goal(variance):
    """However little the model says that it knows there."""
    covariances = np.tile(variance * np.eye(2), (6, 1, 1))
    for place, level in ([0.0, "healthy"], [1.0, "suspicious"]):
        judge = FlightJudge(CONTROLLER.problem)
        x = np.array([place, 0.0])
        plan = replace(plan_of(x, plan_novelty=0.95), covariances=covariances)
        judged_levels = [judge.judge(x, np.zeros(2), plan).level for _ in range(4)]
        assert judged_levels == ["healthy", "healthy", level, level]


def test_a_flight_is_judged_again_when_measurements_are_back():
    rollout = fly(Dropout(30 * T, 40 * T))
    judged_levels = levels(rollout)
    assert judged_levels[31:33] == ["healthy", "suspicious"]
    assert "lost" not in judged_levels
    assert judged_levels[-20:] == ["healthy"] * 20


@pytest.mark.parametrize("missing", [[], [0], [5], [5, 6], [0, 1]])
def test_a_slow_approach_with_dropouts_is_healthy(missing):
    judge = FlightJudge(CONTROLLER.problem)
    way = np.zeros((110, 2))
    way[:, 0] = 10.0 - 0.04 * np.arange(110)
    way[:, 1] = 0.01 * (np.arange(110) % 2)
    judgements = []
    for k in range(100):
        is_missing = k in missing
        measured = np.full(2, np.nan) if is_missing else way[k]
        means = np.full((6, 2), np.nan) if is_missing else way[k : k + 6]
        plan = replace(plan_of(np.zeros(2)), means=means)
        judgements.append(judge.judge(measured, np.zeros(2), plan))
    assert set(judgements) == {Judgement()}


def test_a_dropout_does_not_end_a_loss():
    rollout = fly(Reversed(0, 40 * T), Dropout(100 * T, 100.5 * T), steps=110)
    assert np.isnan(rollout.measured[100:101]).all()
    assert levels(rollout)[95:] == ["lost"] * 15


def test_a_frozen_sensor_is_called_across_a_dropout():
    judge = FlightJudge(CONTROLLER.problem)
    rng = np.random.default_rng(0)
    for k in range(20):
        measured = rng.normal(0.0, 0.01, 2)
        if k >= 10:
            measured[0] = np.nan if k == 12 else 0.005
        judgement = judge.judge(measured, np.zeros(2), plan_of(measured))
    assert judgement.reason.startswith("state 0 is measured the same for")


def test_a_constraint_that_plans_keep_missing_is_suspicious():
    wall = Halfspaces([[1.0, 0.0]], [-0.5])  # the way leads through it
    beyond = fly(law=controller(constraints=[wall]), references=np.zeros(2), noise=None)
    assert "healthy" in levels(beyond)
    impossible = Halfspaces([[1.0, 0.0], [-1.0, 0.0]], [-0.5, -0.5])
    judgements = fly(law=controller(constraints=[impossible]), noise=None).judgements
    assert any(
        "plans miss a constraint" in judgement.reason for judgement in judgements
    )


@pytest.mark.parametrize(
    ("horizon", "level"), [(10, "lost"), (30, "lost"), (80, "healthy")]
)
def test_a_tank_that_runs_away_is_lost_though_programs_solve(horizon, level):
    rollout = tank(horizon)
    assert all(status.solved for status in rollout.statuses)
    assert rollout.judgement.level == level
    if level == "lost":
        assert "the horizon is too short for the plant" in rollout.judgement.reason


def test_what_plans_miss_at_rest_is_no_alarm():
    flown = tank(60, steps=260)
    innovations = flown.measured[1:] - flown.predicted_means[:-1]
    assert 0.0 < np.abs(innovations[-60:]).max() < 1e-7
    assert {judgement.level for judgement in flown.judgements[-60:]} == {"healthy"}


@pytest.mark.parametrize("preview", [True, False])
def test_a_jump_of_the_set_point_is_no_alarm(preview):
    states = np.zeros((121, 2))
    states[40:, 0] = 1.0
    if preview:
        judgements = fly(references=states, noise=None).judgements
    else:
        judgements = []
        x = np.zeros(2)
        loop = ControlLoop(CONTROLLER)
        for k in range(80):
            u = loop.input(x, states[k])
            judgements.append(loop.judgement)
            x = np.array([x[0] + T * x[1] + T**2 / 2 * u[0], x[1] + T * u[0]])
    assert {judgement.level for judgement in judgements} == {"healthy"}


def test_every_loop_judges_alike():
    broken = Reversed(0, 40 * T)
    alone = fly(broken, seed=3)
    many = closed_loops(
        PLANT, CONTROLLER, WAY, WAY[0], 80, [1, 3], noise=NOISE, disturbances=[broken]
    )
    assert many[1].result.judgements == alone.judgements
    loop = ControlLoop(CONTROLLER)
    for k, measured in enumerate(alone.measured):
        loop.input(measured, Reference(WAY[k : k + 16]))
        assert loop.judgement.level == alone.judgements[k].level


def test_what_a_judge_saw_of_a_flight_is_no_part_of_the_next():
    first = fly(Frozen([0], 40 * T))
    again = fly()
    assert first.judgement.level != "healthy"
    assert again.judgement.level == "healthy"


def test_without_a_problem_innovations_are_judged():
    class Standing:
        horizon = 5

        def control(self, belief, reference, previous=None):
            return plan_of(belief.mean.numpy())

    still = closed_loop(PLANT, Standing(), np.zeros(2), np.zeros(2), 40, noise=NOISE)
    assert still.judgement.level == "healthy"
    pushed = [Gust({"velocity": 0.5}, 2.0)]
    disturbed = closed_loop(
        PLANT,
        Standing(),
        np.zeros(2),
        np.zeros(2),
        40,
        noise=NOISE,
        disturbances=pushed,
    )
    assert disturbed.judgement.level == "suspicious"


def test_a_flight_is_what_its_steps_say():
    well = Judgement()
    odd = Judgement("suspicious", "a")
    gone = Judgement("lost", "b")
    of = FlightJudgement.of
    assert of([]) == of([well, well]) == FlightJudgement()
    assert of([odd, well]) == FlightJudgement(suspicious=1)
    assert of([odd, well, odd, odd]) == FlightJudgement("suspicious", "a", 2, 3)
    assert of([odd, gone, gone]) == FlightJudgement("lost", "b", 1, 1, 2)
    back = FlightJudgement("lost", "b; back from step 2 on", 1, 0, 1)
    assert of([well, gone, well]) == back
    assert str(odd) == "suspicious: a"
    assert str(well) == "healthy"


def test_arrays_of_other_sizes_are_refused():
    problem = Problem(Tracking([1.0, 1.0], [0.1]))
    with pytest.raises(ShapeError, match=r"noise must be \(2,\); got \(1,\)"):
        FlightJudge(problem, noise=[0.1])
    judge = FlightJudge(problem)
    state = np.zeros(2)
    with pytest.raises(ShapeError, match=r"measured must be \(2,\); got \(3,\)"):
        judge.judge(np.zeros(3), state, None)
    for reference in (np.zeros(1), np.zeros((4, 3)), np.zeros((0, 2))):
        with pytest.raises(ShapeError, match="reference must be"):
            judge.judge(state, reference, None)


@pytest.mark.parametrize("absurd", [np.inf, 1e200])
def test_an_absurd_measurement_does_not_blind_the_judge(absurd):
    judge = FlightJudge(CONTROLLER.problem)
    rng = np.random.default_rng(0)
    for k in range(40):
        measured = rng.normal(0.0, 1e-3, 2)
        if k == 12:
            measured[0] = absurd
        if k > 30:
            measured[0] += 0.05
        judgement = judge.judge(measured, np.zeros(2), plan_of(np.zeros(2)))
        assert k > 30 or judgement == Judgement()
    assert judgement.reason.startswith("innovations of state 0")


def test_an_absurd_first_measurement_hides_no_distance():
    class Absent(Disturbance):
        def disturb_measurement(self, state, time):
            return state if time else np.full(2, np.inf)

    assert fly(Absent(), Reversed(0, 40 * T), steps=120).judgement.level == "lost"


@pytest.mark.parametrize("missing", [1, 2])
def test_a_first_step_without_a_plan_promised_nothing(missing):
    judge = FlightJudge(CONTROLLER.problem)
    way = np.zeros((60, 2))
    way[:, 0] = 10.0 - 0.04 * np.arange(60)
    way[:, 1] = 0.01 * (np.arange(60) % 2)
    for k in range(40):
        no_plan = plan_of(np.zeros(2), status=Status.INVALID_MEASUREMENT)
        measured = np.full(2, np.nan) if k < missing else way[k]
        means = way[k : k + 11]
        covariances = np.zeros((11, 2, 2))
        plan = replace(plan_of(np.zeros(2)), means=means, covariances=covariances)
        judgement = judge.judge(measured, np.zeros(2), no_plan if k < missing else plan)
        assert judgement == Judgement()


def test_plans_that_climb_after_a_first_dropout_are_lost():
    rollout = tank(10, disturbances=[Dropout(0.0, 10.0)])
    assert np.isnan(rollout.measured[:2]).all()
    assert "the horizon is too short for the plant" in rollout.judgement.reason


def test_failed_decisions_count_where_no_state_is_weighed():
    judge = FlightJudge(Problem(Tracking([0.0, 0.0], [1.0])))
    failed = plan_of(np.full(2, np.nan), status=Status.INFEASIBLE)
    for _ in range(8):
        judgement = judge.judge(np.zeros(2), np.zeros(2), failed)
    assert judgement.reason == "8 of the last 8 decisions could not be applied"


def test_a_state_that_is_to_stay_is_not_frozen():
    judge = FlightJudge(CONTROLLER.problem)
    for k in range(30):
        measured = np.array([0.1 * k, 0.0])
        means = measured + np.outer(np.arange(6), [0.1, 0.0])
        plan = replace(plan_of(measured), means=means)
        judgement = judge.judge(measured, np.zeros(2), plan)
        assert "is measured the same" not in judgement.reason


def test_an_input_at_its_bound_from_the_first_step_is_named():
    judge = FlightJudge(CONTROLLER.problem)
    for k in range(50):
        measured = np.full(2, np.nan) if k == 0 else np.array([1.0, 0.01 * (k % 2)])
        plan = plan_of(np.array([1.0, 0.0]))
        judgement = judge.judge(measured, np.zeros(2), replace(plan, input=np.ones(1)))
    assert judgement.reason.startswith("input 0 is at its bound")


def judged_at(distances, **by_step):
    """Judgements of a point at distances from its goal, where its plans keep it.

    A policy applies 1.
    """
    judge = FlightJudge(CONTROLLER.problem)
    judgements = []
    for k, distance in enumerate(distances):
        state = np.array([distance, 0.01 * (k % 2)])
        plan = plan_of(np.array([distance, 0.0]))
        plan = replace(plan, **{name: values[k] for name, values in by_step.items()})
        applied = None if plan.applicable else np.ones(1)
        judgements.append(judge.judge(state, np.zeros(2), plan, applied))
    return judgements


def test_a_step_without_a_plan_is_judged_by_the_last_horizon():
    judge = FlightJudge(CONTROLLER.problem)
    means = np.tile([1.0, 0.0], (51, 1))
    long_plan = replace(
        plan_of(np.zeros(2)),
        inputs=np.zeros((50, 1)),
        means=means,
        covariances=np.zeros((51, 2, 2)),
    )
    for k in range(152):
        is_missing = k in (45, 70, 100)
        plan = None if is_missing else replace(long_plan, input=np.ones(1))
        measured = np.full(2, np.nan) if is_missing else [1.0, 0.01 * (k % 2)]
        judgement = judge.judge(np.array(measured), np.zeros(2), plan)
        if k < 100:
            assert judgement == Judgement()
    assert judgement.reason.startswith("no nearer to the reference for 151 steps")


@pytest.mark.parametrize("input", [0.0, -1.0], ids=["free", "at its bound"])
@pytest.mark.parametrize("way", [0.0, 1.0])
def test_a_push_after_a_long_rest_is_no_long_way(way, input):
    """What it rests with may be at a bound, as of a brake."""
    distances = np.concatenate([[way], np.zeros(100), 0.6 * np.ones(70)])
    inputs = np.full((171, 1), input)
    reasons = [each.reason for each in judged_at(distances, input=inputs)]
    assert not any("bound" in reason or "nearer" in reason for reason in reasons[:141])
    expected = "no nearer to the reference for 61 steps"
    if input:
        expected = "input 0 is at its bound for 41 steps"
        assert reasons[141].startswith(expected)
    else:
        assert reasons[162].startswith(expected)


def test_an_input_of_the_policy_is_an_input_as_well():
    """A failed decision has none: what is applied is that of the policy."""
    failing = [Status.INFEASIBLE if k % 20 == 15 else Status.SOLVED for k in range(50)]
    judgements = judged_at(np.ones(50), status=failing, input=np.ones((50, 1)))
    assert judgements[-1].reason.startswith("input 0 is at its bound for 50 steps")


@pytest.mark.parametrize(
    ("violation", "is_missed"), [(5e-6, False), (2e-5, True)], ids=["kept", "missed"]
)
def test_a_constraint_that_is_missed_is_so_across_failed_solves(violation, is_missed):
    wall = Halfspaces([[1.0, 0.0]], [-0.5])
    judge = FlightJudge(controller(constraints=[wall]).problem)
    for k in range(40):
        status = Status.INFEASIBLE if k % 12 == 6 else Status.SOLVED
        plan = plan_of(np.zeros(2), status=status, violation=violation)
        judgement = judge.judge(np.array([0.0, 0.01 * (k % 2)]), np.zeros(2), plan)
    assert ("plans miss a constraint" in judgement.reason) == is_missed


def test_a_lost_flight_names_its_last_cost_where_no_plan_is():
    judge = FlightJudge(CONTROLLER.problem)
    for k in range(60):
        distance = 1.2 ** max(0, k - 20)
        means = np.tile([1.2 * distance, 0.0], (6, 1))
        means[0] = [distance, 0.0]
        plan = None if k == 59 else replace(plan_of(np.zeros(2)), means=means)
        judgement = judge.judge(means[0], np.zeros(2), plan)
        if k == 58:
            last = judgement
    assert "ever more, although the model predicts well" in judgement.reason
    assert judgement == last


def test_names_of_another_number_of_states_are_refused():
    for names in ((["x"], ["u"]), (["x", "y"], ["u", "v"])):
        with pytest.raises(ShapeError, match="names must be of 2 states and 1 inputs"):
            FlightJudge(CONTROLLER.problem, names=names)


def test_a_locked_input_is_not_at_its_bound():
    box = Box([-1.0, 0.5], [1.0, 0.5])
    judge = FlightJudge(Problem(Tracking([1.0, 0.0], [0.01, 0.01]), inputs=box))
    for _ in range(60):
        plan = plan_of(np.array([1.0, 0.0]))
        inputs = np.tile([0.2, 0.5], (5, 1))
        plan = replace(plan, input=inputs[0], inputs=inputs)
        judgement = judge.judge(plan.means[0], np.zeros(2), plan)
    assert "bound" not in judgement.reason


def run_away(references, factor=1.2, model=None, start=1.0, count=120, Q=(1.0, 0.0)):
    """Levels of a plant that grows by a factor a step, as its plans promise.

    The model's factor is by default the plant's.
    """
    judge = FlightJudge(Problem(Tracking(Q, [0.01])))
    powers = (factor if model is None else model) ** np.arange(21)
    judged_levels = []
    for k in range(count):
        distance = start * factor**k
        means = np.outer(distance * powers, [1.0, 0.0])
        plan = replace(
            plan_of(np.zeros(2)), means=means, covariances=np.zeros((21, 2, 2))
        )
        judgement = judge.judge(means[0], references(k), plan)
        judged_levels.append(judgement.level)
    return judged_levels, judgement


@pytest.mark.parametrize("pace", [0.0, 0.001])
@pytest.mark.parametrize("has_preview", [False, True])
def test_a_plant_that_runs_away_is_lost_wherever_its_goal_goes(pace, has_preview):
    ahead = np.arange(21 if has_preview else 1)

    def references(k):
        return np.outer(pace * (k + ahead), [1.0, 0.0])

    judged_levels, _ = run_away(references)
    assert "lost" in judged_levels[:50]


def test_a_goal_that_moves_without_notice_is_no_alarm():
    rng = np.random.default_rng(0)
    judge = FlightJudge(CONTROLLER.problem)
    goals = np.cumsum(rng.normal(0.0, 0.1, 200))
    x = 0.0
    for goal in goals:
        plan = plan_of(np.zeros(2))
        means = np.outer(goal + (x - goal) * 0.5 ** np.arange(6), [1.0, 0.0])
        state = np.array([x, 0.001 * rng.normal()])
        assert judge.judge(state, [goal, 0.0], replace(plan, means=means)).level == (
            "healthy"
        )
        x = goal + 0.5 * (x - goal)


def test_preparing_for_a_jump_of_unknown_length_is_no_alarm():
    """A plan that sees one stage behind a jump does not move yet; later ones do."""
    steps = np.arange(120)
    goals = (steps >= 60).astype(float)
    places = (0.05 * (steps - 45)).clip(0.0, 1.0)
    judge = FlightJudge(CONTROLLER.problem)
    for k in range(60):
        rows = slice(k, k + 26)
        means = np.zeros((26, 2))
        if k > 35:
            means[:, 0] = places[rows]
        plan = replace(
            plan_of(np.zeros(2)), means=means, covariances=np.zeros((26, 2, 2))
        )
        measured = np.array([places[k], 0.001 * (-1.0) ** k])
        references = np.column_stack([goals[rows], np.zeros(26)])
        assert judge.judge(measured, references, plan).level == "healthy", k


def test_a_goal_that_moves_away_from_a_dead_plant_is_suspicious():
    """Each plan explains why it still stands, and promises that it will follow."""
    judge = FlightJudge(CONTROLLER.problem)
    shares = 1.0 - 0.5 ** np.array([0, 0, 1, 2, 3, 4])
    for k in range(60):
        goal = 0.01 * k
        plan = replace(plan_of(np.zeros(2)), means=np.outer(goal * shares, [1.0, 0.0]))
        measured = (-1.0) ** k * np.array([0.001, 0.01])
        judgement = judge.judge(measured, [goal, 0.0], plan)
    assert judgement.level == "suspicious"


def test_a_runaway_that_a_wrong_model_half_explains_is_lost():
    judged_levels, judgement = run_away(lambda k: np.zeros(2), model=1.17, start=60.0)
    assert judged_levels.index("lost") < 60
    assert "and the plans cost ever more" in judgement.reason


def test_a_weight_of_the_end_promises_nothing():
    """It would be paid nowhere: steps have the weight of a stage."""
    cost = Tracking([1.0, 0.0], [0.01], terminal=[100.0, 0.0])
    judge = FlightJudge(Problem(cost))
    covariances = np.tile(1e-4 * np.eye(2), (11, 1, 1))
    means = np.outer(0.5 ** np.arange(11), [1.0, 0.0])
    plan = replace(plan_of(np.zeros(2)), means=means, covariances=covariances)
    for k in range(30):
        judgement = judge.judge([1.2, 0.01 * (k % 2)], np.zeros(2), plan)
    assert judgement.level == "suspicious"
    flight = judge._memory.flight[0]
    assert flight["paid"][:10].sum() == pytest.approx(14.4)
    assert flight["promises"][0] == pytest.approx((0.25 ** np.arange(1, 11)).sum())


@pytest.mark.parametrize("length", [20, 2000])
def test_what_matters_does_not_grow_with_the_length_of_a_path(length):
    judge = FlightJudge(CONTROLLER.problem)
    for k in range(length + 60):
        lag = 0.0 if k < length else 5.0
        reference = np.outer(0.5 * (k + np.arange(6)), [1.0, 0.0])
        measured = reference[0] - [lag, 0.01 * (k % 2)]
        plan = replace(plan_of(np.zeros(2)), means=reference - [lag, 0.0])
        judgement = judge.judge(measured, reference, replace(plan, input=np.ones(1)))
    assert judgement.reason.startswith("input 0 is at its bound")


@pytest.mark.parametrize("origin", [0.0, 5.5e6])
def test_a_jump_of_a_sensor_is_one_wherever_the_origin_is(origin):
    judge = FlightJudge(CONTROLLER.problem)
    rng = np.random.default_rng(0)
    for k in range(40):
        measured = np.array([origin, 0.0]) + rng.normal(0.0, 1e-3, 2)
        if k > 30:
            measured[0] += 0.5
        goal = np.array([origin, 0.0])
        judgement = judge.judge(measured, goal, plan_of(np.array([origin, 0.0])))
        assert k > 30 or judgement == Judgement()
    assert judgement.reason.startswith("innovations of state 0")


@pytest.mark.parametrize("noise", [0.01, 0.0])
@pytest.mark.parametrize("n", [1, 2])
def test_sensors_that_all_freeze_at_once_are_named(noise, n):
    """Without noise they may: the plant comes to rest."""
    judge = FlightJudge(Problem(Tracking(np.ones(n), [0.01])), noise=np.full(n, 1e-4))
    rng = np.random.default_rng(0)
    plan = replace(plan_of(np.zeros(n)), covariances=np.zeros((6, n, n)))
    for k in range(45):
        resting = np.full(n, 0.25 ** min(k, 30))
        moving = resting + rng.normal(0.0, 0.01, n)
        frozen = np.full(n, 0.005)
        measured = resting
        if noise:
            measured = moving if k < 30 else frozen
        judgement = judge.judge(measured, np.zeros(n), plan)
        if k < 38 or not noise:
            assert judgement == Judgement()
    assert ("no measurement is new" in judgement.reason) == (noise > 0.0)


@pytest.mark.parametrize("turn", [0.0, 2.0 * np.pi])
def test_a_plant_without_noise_may_stop_at_once(turn):
    """At its hard stop, where the model misses both the stop and some of the way."""
    angles = [0] if turn else []
    judge = FlightJudge(Problem(Tracking([1.0], [0.01], angles=angles)))
    plan = replace(plan_of(np.zeros(1)), covariances=np.zeros((6, 1, 1)))
    state = np.ones(1)
    stops_at = 3.2  # half a turn is 3.14
    for k in range(80):
        # a wheel shows less than half a turn, and is stopped behind it
        shown = np.remainder(state + np.pi, turn) - np.pi if turn else state
        move = 0.1 + 0.03 * np.sin(0.3 * k)
        means = np.tile(shown + 0.1, (6, 1))
        judgement = judge.judge(shown, np.zeros(1), replace(plan, means=means))
        assert "no measurement is new" not in judgement.reason
        state = np.minimum(state + move, stops_at)
    assert state == stops_at


@pytest.mark.parametrize(
    "cost",
    [
        Tracking(np.concatenate([np.zeros((4, 2, 2)), np.eye(2)[None]]), [0.01]),
        Tracking([0.0, 0.0], [0.01], terminal=[1.0, 1.0]),
    ],
    ids=["last stage", "end"],
)
def test_distances_count_where_the_first_stage_weighs_none(cost):
    judge = FlightJudge(Problem(cost, inputs=Box([-1.0], [1.0])))
    for k in range(50):
        plan = replace(plan_of(np.array([1.0, 0.0])), input=np.ones(1))
        judgement = judge.judge([1.0, 0.01 * (k % 2)], np.zeros(2), plan)
    assert judgement.reason.startswith("input 0 is at its bound")
