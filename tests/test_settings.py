"""A setting out of its range is refused by its name when an object is made."""

import math

import numpy as np
import pytest

from gpmpc import datasets
from gpmpc.datasets import Excitation
from gpmpc.exceptions import SettingError
from gpmpc.mpc import GPMPC, PredictionSettings, Problem, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import Linearization
from gpmpc.simulation import Cascade, Dropout, Gust
from gpmpc.systems import Coupled, Map, Rotational, System, Translational
from gpmpc.trajectories import Elliptical, Step, Waypoints
from tests.mpc.small_models import double_integrator

PLANT = System(Rotational(), 0.05, 1)
PROBLEM = Problem(Tracking([1.0] * 6, [1.0] * 3, penalized="inputs"))


def nmpc(**settings):
    return NMPC(PLANT, PROBLEM, 2, [0.0] * 3, **settings)


def convex(**settings):
    problem = Problem(Tracking([1.0, 1.0], [1.0], penalized="inputs"))
    defaults = {
        "propagator": Linearization(),
        "problem": problem,
        "horizon": 2,
        "initial_input": [0.0],
    }
    return GPMPC(double_integrator(), **(defaults | settings))


def flown(**settings):
    return datasets.Tracking(
        **(
            {"plant": PLANT, "Q": [1] * 6, "R": [1] * 3, "initial_input": [0] * 3}
            | settings
        )
    )


def excited(**settings):
    defaults = {
        "Q": [1] * 6,
        "R": [1] * 3,
        "initial_input": [0] * 3,
        "dither": [0] * 3,
        "noise": [0] * 6,
    }
    return Excitation(**(defaults | settings))


CASES = [
    (nmpc, "tolerance", (0.0, -1e-6, math.nan)),
    (convex, "iterations", (0, 1.5, -1)),
    (convex, "tolerance", (0.0, math.inf, "small")),
    (PredictionSettings, "disturbance_gain", (-0.1, math.nan)),
    (convex, "horizon", (0, 2.5)),
    (convex, "solver", ("daqp", int)),
    (convex, "propagator", (None, "linear", Linearization)),
    (convex, "problem", (None, "tracking")),
    (lambda **settings: Cascade(nmpc(), nmpc(), **settings), "ratio", (0, 0.5)),
    (
        lambda **settings: Cascade(nmpc(), nmpc(), **settings),
        "response_time",
        (0.0, -1.0),
    ),
    (flown, "Q", ([1] * 5, [1] * 5 + [-1], [1] * 5 + [math.nan])),
    (flown, "R", ([1] * 2, [1, 1, -1])),
    (excited, "Q", ([1] * 7, [-1] * 6)),
    (excited, "R", ([1] * 4, [-1] * 3)),
    (
        lambda **settings: System(Map(Rotational()), **settings),
        "time_step",
        (0.0, -1.0, math.inf),
    ),
    (
        lambda **settings: System(Rotational(), **settings),
        "time_step",
        (0.0, -1.0, math.nan),
    ),
    (
        lambda **settings: System(Rotational(), 1.0, **settings),
        "substeps",
        (0, 1.5, -2),
    ),
    (Translational, "mass", (0.0, -0.74, math.nan)),
    (Translational, "frozen_attitude", ((1.0, math.nan), (1.0, 2.0, 3.0))),
    (Coupled, "mass", (0.0, math.inf)),
    (Rotational, "arm", (0.0, math.nan)),
    (Rotational, "inertia", ((1.0, 0.0, 1.0), (1.0, 1.0))),
    (Rotational, "gyroscopic", ((1.0, math.inf), (1.0, 1.0, 1.0))),
    (Elliptical, "radius_x", (math.nan, "15")),
    (Elliptical, "radius_y", (math.inf,)),
    (Elliptical, "rate", (math.nan,)),
    (Elliptical, "start_z", (math.nan,)),
    (Elliptical, "climb_rate", (-math.inf,)),
    (Step, "at", (math.nan,)),
    (Step, "before", ((0.0, 0.0), (0.0, 0.0, math.nan))),
    (
        lambda **settings: Waypoints(positions=np.zeros((2, 3)), **settings),
        "times",
        ([0.0], [1.0, 0.0]),
    ),
    (
        lambda **settings: Gust(
            {"vx": 1.0}, **({"start": 0.0, "stop": 1.0} | settings)
        ),
        "stop",
        (0.0, -1.0),
    ),
    (Gust, "rates", ({"vx": math.nan}, {}, [1.0])),
    (
        lambda **settings: Dropout(**({"start": 0.0, "stop": 1.0} | settings)),
        "start",
        (math.nan,),
    ),
    (lambda **settings: Dropout(0.0, 1.0, **settings), "entries", ((0, -1), (0.5,))),
]


@pytest.mark.parametrize(
    ("make", "setting", "values"),
    CASES,
    ids=[f"{i}-{case[1]}" for i, case in enumerate(CASES)],
)
def test_a_setting_out_of_its_range_is_refused_by_its_name(make, setting, values):
    for value in values:
        with pytest.raises(SettingError, match=setting):
            make(**{setting: value})
