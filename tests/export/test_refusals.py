"""What cannot be exported is refused by name, before anything is written."""

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.export import Question, export_c, write_replay
from gpmpc.models import DelayedModel
from gpmpc.mpc import (
    GPMPC,
    Inequality,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc.baselines import LQR
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.qp import DualActiveSet, PrimalActiveSet
from tests.mpc.small_models import double_integrator, pendulum_posterior

GP = pendulum_posterior()
PROBLEM = Problem(Tracking([1.0, 0.1], [0.05]))


def gpmpc(
    model=GP,
    propagator=None,
    problem=PROBLEM,
    iterations=1,
    solver=None,
    budget=None,
    **prediction,
):
    return GPMPC(
        model,
        Linearization() if propagator is None else propagator,
        problem,
        5,
        [0.0],
        prediction=PredictionSettings(**prediction),
        iterations=iterations,
        solver=solver,
        budget=budget,
    )


def outside_a_disc(states):
    return 1.0 - torch.linalg.vector_norm(states, dim=1, keepdim=True)


REFUSED = {
    "controller": lambda: LQR(GP, PROBLEM, 5, [0.0]),
    "iterations": lambda: gpmpc(iterations=None),
    "budget": lambda: gpmpc(budget=0.01),
    "covariance": lambda: gpmpc(covariance="full"),
    "propagator": lambda: gpmpc(propagator=MomentMatching()),
    "solver": lambda: gpmpc(solver=PrimalActiveSet()),
    "solver.time_limit": lambda: gpmpc(solver=DualActiveSet(time_limit=1.0)),
    "model": lambda: gpmpc(model=double_integrator()),
    "problem": lambda: gpmpc(model=DelayedModel(GP, 2)),
    "h": lambda: gpmpc(
        problem=Problem(
            Tracking([1.0, 0.1], [0.05]), constraints=[Inequality(outside_a_disc)]
        )
    ),
}


@pytest.mark.parametrize("key", REFUSED)
def test_refuses_by_name(key, tmp_path):
    with pytest.raises(SettingError) as caught:
        export_c(REFUSED[key](), tmp_path / "folder")
    assert caught.value.key == key
    assert not (tmp_path / "folder").exists()


@pytest.mark.parametrize(
    ("key", "value"), [("precision", "half"), ("on_failure", "raise")]
)
def test_refuses_other_words(key, value, tmp_path):
    with pytest.raises(SettingError, match=key):
        export_c(gpmpc(), tmp_path / "folder", **{key: value})


@pytest.mark.parametrize("name", ["", "Outer", "2nd", "a b", "math", "replay"])
def test_refuses_names_that_c_or_make_cannot_hold(name, tmp_path):
    with pytest.raises(SettingError) as caught:
        export_c(gpmpc(), tmp_path / "folder", name=name)
    assert caught.value.key == "name"
    assert not (tmp_path / "folder").exists()


def test_a_file_of_somebody_else_stays(tmp_path):
    (tmp_path / "Makefile").write_text("all:\n")
    with pytest.raises(SettingError, match="Makefile was not written by an export"):
        export_c(gpmpc(), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["Makefile"]
    assert (tmp_path / "Makefile").read_text() == "all:\n"
    for _ in range(2):  # the second goes over the first
        export_c(gpmpc(), tmp_path / "own")
    replay = tmp_path / "own/replay.txt"
    asked = [Question(np.zeros(2), Reference(np.zeros(2)))]
    for _ in range(2):
        write_replay(gpmpc(), asked, replay)
    replay.write_text("0.0 1.0\n")
    with pytest.raises(SettingError, match="replay.txt was not written by an export"):
        write_replay(gpmpc(), asked, replay)
    assert replay.read_text() == "0.0 1.0\n"


def test_numbers_are_read_back_to_the_same_bits(tmp_path):
    export = export_c(gpmpc(), tmp_path)
    source = export.source.read_text()
    text = source.partition("gp0_weights")[2].partition("{")[2].partition("}")[0]
    weights = np.array([float(number) for number in text.split(",")])
    assert (weights == GP.weights.numpy().ravel()).all()
