"""A flight follows from its experiment alone."""

from functools import partial

import numpy as np
import pytest

from gpmpc.control.convex_mpc import ConvexMPC
from gpmpc.control.nmpc import NMPC
from gpmpc.control.tracking import TrackingProblem
from gpmpc.datasets import Excitation, ExcitedData
from gpmpc.exceptions import SettingError
from gpmpc.experiments.run import Experiment, fly, metrics, training_rows
from gpmpc.experiments.run_folder import Busy, RunFolder, folder_name
from gpmpc.gp import Trainer
from gpmpc.plants import Coupled, Integrated, Map, Rotational, Translational
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise
from gpmpc.trajectories import Elliptical, Lorenz

PLANT = Integrated(Translational(), time_step=1.0, substeps=1)
PROBLEM = TrackingProblem(
    [10, 1] * 3, [0.1, 1, 1], penalized="increments", input_lower=[0, -0.7, -0.7], input_upper=[20, 0.7, 0.7]
)
HOVER = [7.26, 0, 0]
EXCITED = Excitation(PLANT, [1] * 6, [1] * 3, HOVER, [0.3, 0.03, 0.03], [0.01] * 6)
CONVEX = partial(ConvexMPC, propagator=Linearization(), problem=PROBLEM, horizon=2, initial_input=HOVER)
ON_THE_PLANT = partial(NMPC, problem=PROBLEM, horizon=2, initial_input=HOVER)


def experiment(**changes):
    settings = {
        "data": ExcitedData(EXCITED, EXCITED, samples=25), "trajectory": Elliptical(), "plant": PLANT,
        "train": Trainer(restarts=0), "controller": CONVEX, "size": 20, "steps": 4,
    }  # fmt: skip
    return Experiment(**settings | changes)


def numbers(experiment):
    found = metrics(experiment, fly(experiment))
    assert found.pop("times")["total"]["median"] >= 0
    return found


def test_the_same_seed_gives_the_same_numbers_and_another_one_others():
    noise = Noise(measurement=[0.01] * 6)
    first, again, other = (numbers(experiment(noise=noise, seed=seed)) for seed in (3, 3, 4))
    assert first == again
    assert first["rmse"]["total"] != other["rmse"]["total"]
    assert first["training"]["size"] == 20


def test_the_rows_of_a_seed_are_nested_and_in_the_order_of_the_flight():
    everything = training_rows(experiment(size=None)).features.numpy()
    small, large = (training_rows(experiment(size=size, seed=1)).features.numpy() for size in (5, 12))
    assert len(everything) == 25
    places = [[int(np.flatnonzero((everything == row).all(axis=1))[0]) for row in rows] for rows in (small, large)]
    assert places[1] == sorted(places[1])
    assert set(places[0]) < set(places[1])


def test_a_model_loop_never_meets_the_plant_and_the_true_model_needs_no_data():
    flown = fly(experiment(loop="model"))
    assert np.trace(flown.rollout.covariances[-1]) > 0
    known = fly(experiment(controller=ON_THE_PLANT, data=None))
    assert known.training is None
    assert metrics(experiment(controller=ON_THE_PLANT), known)["rmse"]["total"] < 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": 0}, "data.size: must be a whole number, 1 or more"),
        ({"steps": 0}, "steps: must be a whole number, 1 or more"),
        ({"loop": "plan"}, "loop: must be 'plant' or 'model'; got 'plan'"),
        ({"on_failure": "cry"}, "on_failure: must be one of"),
        ({"plant": Integrated(Coupled())}, "the translational subsystem, x, vx, y, vy, z, vz; got x, .*cascade_loop"),
        ({"subsystem": "rotational"}, "must have the states of the rotational subsystem, phi, p"),
        ({"subsystem": "rotational", "plant": Map(Rotational())}, "flown at its own rate; a Map has none"),
        ({"subsystem": "whole"}, "subsystem: must be one of translational, rotational; got 'whole'"),
        ({"controller": ON_THE_PLANT, "loop": "model"}, "loop: a model loop needs a controller that learns"),
    ],
    ids=str,
)
def test_what_cannot_be_flown_is_refused(changes, message):
    with pytest.raises(SettingError, match=message):
        experiment(**changes)


def test_the_rotational_subsystem_follows_the_attitudes_of_the_trajectory_at_its_own_rate():
    plant = Integrated(Rotational(), time_step=0.05, substeps=5)
    excited = Excitation(plant, [1] * 6, [1] * 3, [0] * 3, [0.05] * 3, [1e-4, 1e-3] * 3)
    problem = TrackingProblem([100, 1] * 3, [1] * 3, penalized="increments", input_lower=[-2] * 3, input_upper=[2] * 3)
    settings = {"propagator": Linearization(), "problem": problem, "horizon": 5, "initial_input": [0] * 3}
    turning = experiment(
        subsystem="rotational", plant=plant, trajectory=Lorenz(), data=ExcitedData(EXCITED, excited, samples=60),
        controller=partial(ConvexMPC, **settings), size=None, steps=100,
    )  # fmt: skip
    flight = fly(turning)
    found = metrics(turning, flight)
    assert flight.rollout.time_step == 0.05
    assert np.ptp(flight.rollout.references[:, 0]) > 0.03  # [rad]: there was something to follow
    assert set(found["rmse"]) == {"phi", "theta", "psi", "total"}
    assert found["unit"] == "rad"
    assert found["rmse"]["total"] < 0.005


def test_more_rows_than_there_are_are_refused():
    with pytest.raises(SettingError, match="data.size: must be at most 25, the rows of the data; got 26"):
        fly(experiment(size=26))


def test_a_folder_is_finished_when_its_metrics_are_there_and_one_process_works_on_it(tmp_path):
    folder = RunFolder(tmp_path / "run")
    with folder.claimed():
        with pytest.raises(Busy), RunFolder(tmp_path / "run").claimed(wait=False):
            pass
        folder.fail(ValueError("no\nluck"), {})
        assert not folder.finished
        assert folder.failed_at
        folder.begin("steps: 1")
        assert folder.failed_at is None
        folder.finish({"rmse": 1, "settings": {}})
    assert folder.finished
    assert folder.result() == {"rmse": 1, "settings": {}}
    with folder.claimed(wait=False):
        pass
    assert sorted(path.name for path in folder.path.iterdir()) == ["config.yaml", "metrics.json"]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (["a=x/y"], ["a=x_y"]),
        (["a=X"], ["a=x"]),
        (["a=" + "1" * 300], ["a=" + "1" * 301]),
        (["a=1", "b=2"], ["a=1,b=2"]),
    ],
    ids=["characters", "case", "length", "commas"],
)
def test_folders_of_different_choices_never_collide(one, other):
    names = [folder_name(choices) for choices in (one, other)]
    assert names[0].lower() != names[1].lower()
    assert all(len(name) < 200 and "/" not in name for name in names)


def test_the_order_of_choices_does_not_matter_for_the_name():
    assert folder_name(["b=2", "a=1"]) == folder_name(["a=1", "b=2"]) == "a=1,b=2"
