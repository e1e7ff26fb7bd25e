"""The league in real time, its robustness board and its film.

Late plans, filter, delay, responsiveness, parts.
"""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from benchmarks import realaigym_real_time, realaigym_robustness
from benchmarks.realaigym import (
    ACTUATED,
    INPUT,
    JOINTS,
    casadi_model,
    fine_model,
    make_parts,
    random_record,
    right_hand_side,
    state_of,
)
from benchmarks.realaigym_film import film
from benchmarks.realaigym_real_time import real_time_pilot
from benchmarks.realaigym_robustness import RateFilter, Watchful, robustness
from gpmpc.models import KnownModel, RollOut
from gpmpc.systems import double_pendulum


def leagues(robot, torque_of, count, delay=0, response=1.0, noise=0.0):
    """Returns states (T + 1, 4) of the pendulum and the torques asked for (T, 2).

    It hangs at first.
    """
    rhs = right_hand_side()
    rng = np.random.default_rng(0)
    last = np.zeros(2)
    states = [np.zeros(4)]
    asked = []
    for k in range(count):
        seen = states[max(0, k - delay)] + np.array(
            [0.0, 0.0, 1.0, 1.0]
        ) * noise * rng.normal(size=4)
        asked.append(torque_of(seen, k * INPUT))
        last = np.clip(last + response * (asked[-1] - last), -6, 6)
        x = states[-1]
        for _ in range(2):  # the midpoint rule
            x = x + INPUT / 2 * rhs(0.0, x + INPUT / 4 * rhs(0.0, x, last), last)
        states.append(x)
    return np.array(states), np.array(asked)


def timed_pilot(monkeypatch, start, decision, value=0.1):
    """A pilot whose starts and decisions take a time, and whose plans have a value."""
    clock = [0.0]

    def slowed(function, seconds):
        def call(*arguments, **named):
            clock[0] += seconds
            return function(*arguments, **named)

        return call

    model = KnownModel(casadi_model(double_pendulum("shoulder")), 4, 1)
    parts = make_parts(model, 0.1, horizon=20, programs=3, wild=False)._replace(
        criterion=lambda plan, goal: value
    )
    who = real_time_pilot(parts, 0)
    monkeypatch.setattr(realaigym_real_time, "process_time", lambda: clock[0])
    planner = who.search.planner
    monkeypatch.setattr(planner, "control", slowed(planner.control, start))
    monkeypatch.setattr(who.step, "control", slowed(who.step.control, decision))
    return who


@pytest.mark.parametrize(("start", "begins"), [(0.01, 30), (0.05, 30), (0.07, None)])
def test_a_plan_acts_after_its_search_and_never_if_late(start, begins, monkeypatch):
    who = timed_pilot(monkeypatch, start, 0.001)
    torques = [
        who.torques(np.array([np.pi + 0.1, 0.0, 0.0, 0.0]), INPUT * k)[0]
        for k in range(60)
    ]
    assert not np.any(torques[:begins])
    assert begins is None or all(torques[begins:])
    assert np.allclose(who.searched, start)
    assert np.allclose(who.seconds, 0.001)
    assert (len(who.seconds) > 0) == (begins is not None)
    who.torques(
        np.array([np.pi + 0.1, 0.0, 0.0, 0.0]), 5.0
    )  # the league had taken it away: no plan, only the brake
    assert who.torques(np.array([np.pi + 0.1, 0.0, 2.0, 0.0]), 5.0 + INPUT)[
        0
    ] == pytest.approx(-0.6)


def test_the_last_plan_flies_until_a_late_decision_is_known(monkeypatch):
    # 15 inputs
    who = timed_pilot(monkeypatch, 0.01, 0.029)
    decided = []
    for k in range(150):
        who.torques(np.array([np.pi + 0.01, 0.0, 0.0, 0.0]), INPUT * k)
        decided.append(len(who.seconds))
    assert np.flatnonzero(np.diff(decided)).tolist() == [
        39,
        59,
        79,
        99,
        119,
        139,
    ]  # every second period of 10


@pytest.mark.parametrize(("value", "searches"), [(0.1, 1), (1.5, 12), (10.0, 20)])
def test_all_starts_are_taken_until_there_is_a_good_plan(value, searches, monkeypatch):
    who = timed_pilot(monkeypatch, 0.05, 0.001, value)
    torques = [
        who.torques(np.array([np.pi + 0.1, 0.0, 0.0, 0.0]), INPUT * k)[0]
        for k in range(600)
    ]
    assert len(who.searched) == searches  # of one start each, and there are twelve
    assert (len(who.seconds) > 0) == np.any(torques) == (value < 5)


def test_rates_are_found_from_angles_under_any_noise_of_rates():
    record = random_record("acrobot", 2.0, 0)[0]
    states = np.array([state_of(x) for x in record.states])
    rates = np.random.default_rng(0).normal(0, 0.5, (len(states), 2))
    filter_ = RateFilter()
    filter_.restart(states[0])
    noisy = states + rates @ np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    found = np.array([filter_(measured) for measured in noisy])
    assert np.sqrt(np.mean((found - states)[50:] ** 2)) < 0.01


@pytest.mark.parametrize(
    ("robot", "delay", "response"),
    [
        ("acrobot", 0, 0.1),
        ("pendubot", 0, 0.3),
        ("acrobot", 3, 1.0),
        ("pendubot", 20, 1.0),
    ],
)
def test_delay_and_responsiveness_are_found_from_probes(robot, delay, response):
    who = Watchful(
        SimpleNamespace(torques=lambda x, t: np.zeros(2)),
        RollOut(fine_model(robot)),
        JOINTS[robot],
    )
    leagues(
        robot, who.torques, realaigym_robustness.PROBES + 1, delay, response, noise=0.2
    )
    assert who.delay == delay
    assert who.response == pytest.approx(response, abs=0.05 if response < 1 else 0.25)


def test_a_pilot_is_shown_the_present_state_of_late_sensors():
    shown = []

    def torques(x, t):
        shown.append(np.array(x))
        return np.array([2.0 * np.sin(20 * t), 0.0])

    who = Watchful(SimpleNamespace(torques=torques), RollOut(fine_model("pendubot")), 0)
    states, _ = leagues("pendubot", who.torques, 400, delay=10, noise=0.5)
    errors = np.array(shown) - states[realaigym_robustness.PROBES : 400]
    assert np.abs(errors).max() < 0.1
    assert (
        np.abs(
            states[realaigym_robustness.PROBES : 390]
            - states[realaigym_robustness.PROBES + 10 : 400]
        ).max()
        > 0.5
    )
    who.torques(np.zeros(4), 0.0)  # the next flight is probed anew
    assert who.delay == 0


def test_the_parts_are_flown_once_and_kept(monkeypatch, tmp_path):
    flown = []

    class Benchmarker:
        def __init__(
            self, controller, x0, dt, t_final, goal, epsilon, check_only_final_state
        ):
            assert (dt, t_final, check_only_final_state) == (0.002, 10.0, True)

        def set_model_parameter(self, model_pars):
            self.parameters = model_pars

        def check_modelpar_robustness(self, names, values):
            flown.append("model")
            assert values["m2"] == pytest.approx([0.75 * 0.6, 0.6, 1.25 * 0.6])
            return {
                name: {"successes": [value >= 0 for value in values[name]]}
                for name in names
            }

        def check_meas_noise_robustness(self, repeated, mode, values):
            flown.append("rate noise")
            return {
                "None": {"successes": [[value < 0.3] * repeated for value in values]}
            }

        def check_unoise_robustness(self, repeated, values):
            return {"successes": [[True] * repeated for _ in values]}

        def check_uresponsiveness_robustness(self, values):
            return {"successes": [value > 1 for value in values]}

        def check_delay_robustness(self, mode, values):
            return {"successes": [value < 0.03 for value in values]}

        def check_perturbation_robustness(self, count, *settings):
            return {"successes": [True] * count}

    module = ModuleType("double_pendulum.analysis.benchmark")
    module.benchmarker = Benchmarker
    for name in ("double_pendulum", "double_pendulum.analysis"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    known = SimpleNamespace(m=[0.5, 0.6], r=[0.2, 0.25], I=[0.03, 0.05])
    monkeypatch.setattr(realaigym_robustness, "league_parameters", lambda limits: known)
    found = [robustness(None, "acrobot", 3, tmp_path / "parts.json") for _ in range(2)]
    assert found[0] == found[1]
    assert flown == ["model", "rate noise"]
    shares = {part: np.mean(successes) for part, successes in found[0].items()}
    assert shares["model"] == pytest.approx(26 / 30)  # of ten, four begin below zero
    assert shares["delay"] == shares["rate noise"] == pytest.approx(2 / 3)


def test_a_film_shows_every_twentieth_of_a_second(tmp_path):
    record = random_record("acrobot", 2.0, 0)[0]
    film(record, 1, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as image:
        assert image.n_frames == 40


def test_every_robot_has_an_actuated_joint():
    assert {
        robot: ("shoulder", "elbow")[joint] for robot, joint in JOINTS.items()
    } == ACTUATED
