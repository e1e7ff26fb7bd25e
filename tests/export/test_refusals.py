"""What cannot be exported is refused by name, before anything is written."""

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.export import Question, export_c, write_replay
from gpmpc.gaussian import Gaussian
from gpmpc.models import DelayedModel
from gpmpc.mpc import (
    GPMPC,
    Inequality,
    LeastSquares,
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
ORIGIN = Reference(np.zeros(2))


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


def smooth(states, inputs, values, parameters=0):
    """A CasADi function of these sizes."""
    x = casadi.SX.sym("x", states)
    u = casadi.SX.sym("u", inputs)
    p = casadi.SX.sym("p", parameters)
    arguments = [x, u, p] if parameters else [x, u]
    scale = casadi.sum1(p) if parameters else 1.0
    value = casadi.vertcat(*[x[0] * scale - u[0] - i for i in range(values)])
    return casadi.Function("f", arguments, [value])


OTHER_SIZES = {
    "more values": ("h must map", [Inequality(smooth(2, 1, 2))], []),
    "fewer values": ("h must map", [Inequality(smooth(2, 1, 1), count=2)], []),
    "more states": ("h must map", [Inequality(smooth(3, 1, 1))], []),
    "more inputs": ("h must map", [Inequality(smooth(2, 2, 1))], []),
    "other parameters": (
        r"u \(1,\), p \(1,\)",
        [Inequality(smooth(2, 1, 1, 1)), Inequality(smooth(2, 1, 1, 2))],
        [],
    ),
    "more outputs": ("y must map", [], [LeastSquares(smooth(2, 1, 2), [1.0])]),
}


@pytest.mark.parametrize("name", OTHER_SIZES)
def test_functions_that_c_has_no_room_for_are_refused(name, tmp_path):
    """As Python refuses them at the first step."""
    rule, constraints, outputs = OTHER_SIZES[name]
    weights = Tracking([1.0, 0.1], [0.05])
    controller = gpmpc(
        problem=Problem(weights, constraints=constraints, outputs=outputs)
    )
    with pytest.raises(ShapeError, match=rule):
        export_c(controller, tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
    parameters = [1.0] if name == "other parameters" else None
    with pytest.raises(ShapeError):
        controller.control(Gaussian.certain([0.0, 0.0]), ORIGIN, parameters=parameters)


@pytest.mark.parametrize(
    ("key", "value"), [("precision", "half"), ("on_failure", "raise")]
)
def test_refuses_other_words(key, value, tmp_path):
    with pytest.raises(SettingError, match=key):
        export_c(gpmpc(), tmp_path / "folder", **{key: value})


@pytest.mark.parametrize(
    "name", ["", "Outer", "2nd", "a b", "math", "features", "replay", "write"]
)
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
