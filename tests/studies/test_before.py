"""What is said before a flight, and where it is kept."""

import json
from dataclasses import replace
from functools import partial

import pytest

from gpmpc.datasets import RandomData
from gpmpc.gp import Trainer
from gpmpc.learning import OnlineLearning
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.mpc.baselines import LQR
from gpmpc.propagation import Linearization
from gpmpc.studies.flight import Experiment, metrics, run_trial, summary
from gpmpc.systems import pendulum
from tests.cli.command import forked

COST = Tracking([1.0, 0.01], [0.01], penalized="inputs", angles=[0])
PROBLEM = Problem(COST, inputs=Box([-2.0], [2.0]))
TRAINER = Trainer(predicts="difference", restarts=0)


def experiment(horizon, controller=None, **changes):
    if controller is None:
        controller = partial(
            GPMPC,
            propagator=Linearization(),
            problem=PROBLEM,
            horizon=horizon,
            initial_input=[0.0],
        )
    system = pendulum()
    settings = {
        "data": RandomData(samples=100),
        "trajectory": None,
        "system": system,
        "train": TRAINER,
        "controller": controller,
        "steps": 2,
        "name": "goal",
    }
    return Experiment(**settings | changes)


@pytest.fixture(scope="module")
def model():
    chosen = experiment(2)
    return chosen.learn(chosen.training_rows(), 0).posterior


def flown(model, horizon, **changes):
    """The lines that were said before a flight, and its metrics."""
    chosen = experiment(horizon, model=model, **changes)
    lines = []
    flight = run_trial(chosen, warn=lines.append)
    return lines, metrics(chosen, flight)


def test_a_horizon_that_loses_the_goal_is_said_before_flight(model):
    lines, result = flown(model, 2)
    (line,) = lines
    assert line.startswith("horizon 2: the loop runs away from its reference")
    assert result["outlook"]["warnings"] == lines
    assert result["outlook"]["spectral_radius"] > 1.05
    shortest = result["outlook"]["shortest_horizon"]
    assert line.endswith(f"it settles with {shortest} steps or more")
    assert json.loads(json.dumps(result)) == result
    settings = {
        "options": {"system": "pendulum", "trajectory": "goal", "controller": "convex"}
    }
    rows = dict(summary(result | {"settings": settings}).rows)
    assert rows["before the flight"] == line
    learning, _ = flown(model, 2, learning=OnlineLearning())
    assert learning == lines


def test_a_good_flight_is_told_nothing(model):
    lines, result = flown(model, 20)
    assert lines == []
    assert result["outlook"]["warnings"] == []
    assert result["outlook"]["spectral_radius"] < 1


def test_a_goal_beyond_the_data_is_said_whatever_flies(model):
    away = replace(pendulum(), goal=[0.0, 60.0])
    law = partial(LQR, problem=PROBLEM, horizon=5, initial_input=[0.0])
    lines, result = flown(model, 5, system=away, controller=law)
    (line,) = lines
    assert line.startswith(f"the reference of {away.state_names[1]} is 60, its data ")
    assert result["outlook"]["spectral_radius"] is None


def test_the_command_says_it_once_on_stderr_and_in_its_table(tmp_path):
    settings = ["system=pendulum", "horizon=2", "steps=2", "data.samples=60"]
    settings += ["model.restarts=0", "recorder=none", "folder=tree"]
    done = forked("run", *settings, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("gpmpc: before the flight: horizon 2: the loop runs away")
    assert "before the flight" in done.stdout
    again = forked("run", *settings, cwd=tmp_path)
    assert "before the flight" in again.stdout
    assert again.stderr == ""
