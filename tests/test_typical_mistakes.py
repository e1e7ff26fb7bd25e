"""What newcomers do wrong, and the line that tells them.

A row is a call and the first words of its message. Every row raises an error of the
package, of one line, where the mistake is made; on the command line it is exit code 2.

Not in the table, since nothing in the numbers tells: degrees in the place of radians,
two states of one unit exchanged, a controller of another robot of as many states where
neither has names.
"""

import math
from functools import cache

import numpy as np
import pandas
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.datasets import RandomData
from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.exceptions import GpmpcError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import (
    Trainer,
    Transitions,
    append_transitions,
    load_posterior,
    save_posterior,
    train,
)
from gpmpc.learning import LearningController, OnlineLearning
from gpmpc.logs import read_log
from gpmpc.models import (
    Affine,
    DelayedModel,
    KnownModel,
    ResidualModel,
    save_model,
)
from gpmpc.models import train as train_model
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Halfspaces,
    Inequality,
    ManyStarts,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
    dlqr,
)
from gpmpc.mpc.baselines import NMPC
from gpmpc.plotting import calibration_figure, flight_figure, tracking_figure
from gpmpc.propagation import Linearization, rollout
from gpmpc.qp import DualActiveSet
from gpmpc.recording import McapRecorder, RecordedSystem, read_run, replay
from gpmpc.signals import Signals
from gpmpc.simulation import Dropout, Gust, Noise, closed_loop, closed_loops
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.systems import System, pendulum, step, step_many
from gpmpc.trajectories import Hover, Waypoints
from tests.cli.command import forked


class Cart:
    state_names, input_names = ("position", "speed"), ("force",)

    def derivative(self, x, u):
        return [x[1], u[0] - 0.2 * x[1]]


def cart_of(function):
    """Returns a system whose derivative is a function of a newcomer."""
    dynamics = Cart()
    dynamics.derivative = function
    return System(dynamics, 0.1)


class Circular(Cart):
    input_names = ("speed",)


def filled(x, u):
    """The derivative of a newcomer who fills an array."""
    derivative = np.zeros(2)
    derivative[0] = x[1]
    derivative[1] = u[0]
    return derivative


PLANT = System(Cart(), 0.1)
NAMES = Signals(("position", "speed"), ("force",), 0.1)
_rng = np.random.default_rng(0)
X = _rng.uniform(-2, 2, (20, 2))
U = _rng.uniform(-2, 2, (20, 1))
Y = step_many(PLANT, X, U)
COST = Tracking([10.0, 1.0], [0.1], penalized="inputs")
GOAL = [1.0, 0.0]
START = [0.0, 0.0]
ROWS = np.zeros((6, 2))


@cache
def gp():
    data = Transitions(X, U, Y, NAMES)
    return Trainer(restarts=0, predicts="difference")(data).posterior


def data():
    return Transitions(X, U, Y)


def controller(**changed):
    arguments = {
        "model": gp(),
        "propagator": Linearization(),
        "problem": Problem(COST, inputs=Box([-2.0], [2.0])),
        "horizon": 5,
        "initial_input": [0.0],
    }
    return GPMPC(**arguments | changed)


def constrained(constraint):
    return controller(problem=Problem(COST, constraints=[constraint]))


def control(**changed):
    arguments = {"belief": Gaussian.certain(START), "reference": Reference(ROWS)}
    return controller().control(**arguments | changed)


def fly(**changed):
    arguments = {
        "system": PLANT,
        "controller": controller(),
        "references": GOAL,
        "initial": START,
        "steps": 2,
    }
    return closed_loop(**arguments | changed)


def kalman():
    return KalmanFilter(gp(), Measurement.of_states(2, [0], [0.1]))


def renamed():
    dynamics = Cart()
    dynamics.state_names = ("angle", "rate")
    return System(dynamics, 0.1)


def log(path="log.csv", **changed):
    mapping = {
        "time": {"column": "t", "unit": "s"},
        "states": {"x": {"columns": ["x"]}},
        "inputs": {"u": {"columns": ["u"]}},
    }
    return read_log(path, mapping | changed)


SYSTEMS = {
    "no time step": (lambda: System(Cart()), "time_step: must be a number above 0"),
    "time step as text": (lambda: System(Cart(), "0.1"), "time_step: must be a number"),
    "dt": (lambda: System(Cart(), dt=0.1), "dt: is no argument (did you mean 'time_st"),
    "a class": (lambda: System(Cart, 0.1), "dynamics: must be an object, such as Cart"),
    "a function": (
        lambda: System(lambda x, u: x, 0.1),
        "dynamics.state_names: must be",
    ),
    "too few rates": (lambda: cart_of(lambda x, u: [x[1]]), "derivative must give 2"),
    "one rate": (lambda: cart_of(lambda x, u: x[1]), "derivative must give 2 entries"),
    "no return": (lambda: cart_of(lambda x, u: None), "derivative must give 2 entries"),
    "no such input": (
        lambda: cart_of(lambda x, u: [x[1], u[1]]),
        "dynamics: must step from state",
    ),
    "math": (
        lambda: step_many(cart_of(lambda x, u: [x[1], math.sin(x[0])]), X, U),
        "dynamics: must be written with",
    ),
    "unit of no state": (
        lambda: System(Cart(), 0.1, units={"pos": "m"}),
        "units: must be of position, speed, force; got pos",
    ),
    "units in a list": (
        lambda: System(Cart(), 0.1, units=["m", "m/s", "N"]),
        "units: must map names",
    ),
    "rates in a list": (
        lambda: System(Cart(), 0.1, rates=["speed"]),
        "rates: must map names",
    ),
    "limits cross": (
        lambda: System(Cart(), 0.1, input_lower=[2], input_upper=[-2]),
        "input_lower, input_upper: must not cross",
    ),
    "a limit as a number": (
        lambda: System(Cart(), 0.1, input_lower=-2),
        "input_lower: must be a list of 1 numbers",
    ),
    "region crosses": (
        lambda: System(Cart(), 0.1, region=[[1, 1], [-1, -1]]),
        "region: must not cross",
    ),
    "angle by number": (
        lambda: System(Cart(), 0.1, angles=[0]),
        "angles: must name states",
    ),
    "angle without a list": (
        lambda: System(Cart(), 0.1, angles="position"),
        "angles: must be a list of names",
    ),
    "long start": (
        lambda: System(Cart(), 0.1, start=[0, 0, 0]),
        "start: must be a list of 2 numbers",
    ),
    "no such parameter": (
        lambda: pendulum(length_m=1.0),
        "length_m: is no argument (did you mean 'length'?)",
    ),
    "negative mass": (lambda: pendulum(mass=-1), "mass: must be a number above 0"),
    "step swapped": (
        lambda: step(PLANT, [0.0], [0.0, 0.0]),
        "state and input must have shapes (2,) and (1,); got (1,) and (2,)",
    ),
    "step of a number": (
        lambda: step(PLANT, START, 0.0),
        "state and input must have shapes (2,) and (1,)",
    ),
    "step of dynamics": (lambda: step(Cart(), START, [0.0]), "plant: must be a plant"),
    "step of nothing": (
        lambda: step(PLANT, None, [0.0]),
        "state must be real numbers; got None",
    ),
    "step_many of one row": (
        lambda: step_many(PLANT, START, [0.0]),
        "states and inputs must be (T, 2) and (T, 1)",
    ),
    "step_many swapped": (
        lambda: step_many(PLANT, U, X),
        "states and inputs must be (T, 2) and (T, 1)",
    ),
}
DATA = {
    "swapped": (lambda: Transitions(U, X, Y), "states (N, n), inputs (N, m)"),
    "another order": (lambda: Transitions(X, Y, U), "states (N, n), inputs (N, m)"),
    "ragged": (
        lambda: Transitions([[1, 2], [3]], [[1], [2]], [[1, 2], [3, 4]]),
        "states must be numbers in rows and columns",
    ),
    "one column": (
        lambda: Transitions(X[:, 0], U, Y),
        "states must have two dimensions",
    ),
    "a trajectory": (lambda: Transitions(X, U, X[1:]), "states (N, n), inputs (N, m)"),
    "transposed": (lambda: Transitions(X.T, U.T, Y.T), "states (N, n), inputs (N, m)"),
    "a missing value": (
        lambda: Transitions(np.where(X > 1.5, np.nan, X), U, Y),
        "states must be finite; got nan in row",
    ),
    "words": (lambda: Transitions([["a"]], [["b"]], [["c"]]), "states must be numbers"),
    "a file name": (lambda: Transitions("log.csv", U, Y), "states must be numbers in"),
    "no next states": (lambda: Transitions(X, U), "next_states: is missing"),
    "names in a list": (
        lambda: Transitions(X, U, Y, ["position", "speed"]),
        "signals: must be Signals(...); got list",
    ),
    "too few names": (
        lambda: Transitions(X, U, Y, Signals(("position",), ("force",))),
        "2 states need as many names",
    ),
    "other columns": (
        lambda: Transitions(
            pandas.DataFrame(X, columns=["a", "b"]), U, Y, signals=NAMES
        ),
        "states must have the names position, speed",
    ),
    "no such file": (
        lambda: Transitions.from_csv("no.csv", ["x"], ["u"]),
        "no.csv: no such file",
    ),
    "no such column": (
        lambda: Transitions.from_csv("log.csv", ["position"], ["u"]),
        "log.csv: column 'position' is missing; the header has t, x, u",
    ),
    "a name without a list": (
        lambda: Transitions.from_csv("log.csv", "x", ["u"]),
        "states: must be a list of column names",
    ),
    "words in a column": (
        lambda: Transitions.from_csv("words.csv", ["x"], ["u"]),
        "words.csv: row 2, column u is 'a'",
    ),
    "a CSV file loaded": (
        lambda: Transitions.load("log.csv"),
        "log.csv: not a readable .npz",
    ),
    "train of arrays": (lambda: train((X, U, Y)), "transitions: must be Transitions"),
    "no such target": (
        lambda: Trainer(predicts="delta"),
        "predicts: must be one of 'next_state', 'difference'",
    ),
    "scaling as a word": (
        lambda: Trainer(scaling="standardize"),
        "scaling: must be a function such as standardize",
    ),
    "epochs": (lambda: Trainer(epochs=100), "epochs: is no argument; Trainer takes"),
    "negative restarts": (lambda: Trainer(restarts=-1), "restarts: must be a whole"),
    "appended arrays": (
        lambda: append_transitions(gp(), X),
        "transitions: must be Transitions(...); got ndarray",
    ),
    "metadata as text": (
        lambda: save_posterior(gp(), "gp.safetensors", metadata="metres"),
        "metadata: must be a mapping",
    ),
    "a CSV file as a model": (lambda: load_posterior("log.csv"), "log.csv: damaged"),
    "no such model": (
        lambda: load_posterior("no.safetensors"),
        "no.safetensors: no such file",
    ),
}
MODELS = {
    "arrays": (lambda: gp().predict(X[0], U[0]), "state: must be a torch tensor; got"),
    "float32": (
        lambda: gp().predict(torch.zeros(2, dtype=torch.float32), torch.zeros(1)),
        "state: must be torch.float64 on cpu",
    ),
    "swapped": (
        lambda: gp().predict(torch.zeros(1), torch.zeros(2)),
        "the model takes a state (*batch, 2)",
    ),
    "a nominal of NumPy": (
        lambda: ResidualModel.train(lambda x, u: np.sin(x), data()),
        "nominal: must be written with torch",
    ),
    "a derivative partly lost": (
        lambda: ResidualModel.train(
            lambda x, u: torch.stack([x[..., 0].detach(), x[..., 1]], dim=-1), data()
        ),
        "nominal: must be followed by torch as a whole",
    ),
    "a nominal of the state": (
        lambda: ResidualModel.train(lambda x: x, data()),
        "nominal: too many positional arguments; nominal takes x",
    ),
    "a system as nominal": (
        lambda: ResidualModel.train(PLANT, data()),
        "nominal: must be a function of tensors; got System",
    ),
    "negative delay": (lambda: DelayedModel(gp(), -1), "delay: must be a number above"),
    "a belief of numbers": (
        lambda: Linearization()(gp(), torch.zeros(2), torch.zeros(1)),
        "belief: must be a Gaussian; got Tensor",
    ),
    "a filter of nothing": (
        lambda: KalmanFilter(None, Measurement.of_states(2, [0], [0.1])),
        "model: must be a DynamicsModel",
    ),
    "no measurement": (
        lambda: KalmanFilter(gp(), None),
        "measurement: must be Measurement(...)",
    ),
    "filter, no belief": (
        lambda: kalman().predict(None, [0.0]),
        "belief: must be a Gaussian",
    ),
    "filter, nothing measured": (
        lambda: kalman().update(Gaussian.certain(START), None),
        "a measurement must be real numbers; got None",
    ),
    "measured by name": (
        lambda: Measurement.of_states(2, ["position"], [0.1]),
        "states: must be a list of indices",
    ),
    "negative deviation": (
        lambda: Measurement.of_states(2, [0], [-0.1]),
        "std: must be a number, 0 or more",
    ),
    "calibration on arrays": (
        lambda: calibrate(gp(), X),
        "recordings: must be Recording(states, inputs); got ndarray",
    ),
    "a level in per cent": (
        lambda: calibrate(gp(), Recording(X, U[1:]), levels=95),
        "levels: must be a list",
    ),
}
CONTROLLERS = {
    "no R": (lambda: Tracking([1.0, 1.0]), "R: is missing; Tracking takes Q, R"),
    "negative Q": (lambda: Tracking([-1.0], [1.0]), "Q: must be positive semidefinite"),
    "R of zero": (lambda: Tracking([1.0], [0.0]), "R: must be positive definite"),
    "Q as a number": (lambda: Tracking(1.0, 1.0), "Q: must be the diagonal"),
    "Q as nothing": (lambda: Tracking(None, [1.0]), "Q: must be the diagonal"),
    "Q not symmetric": (
        lambda: Tracking([[1.0, 2.0], [0.0, 1.0]], [1.0]),
        "Q: must be symmetric",
    ),
    "Q of another length": (
        lambda: controller(problem=Problem(Tracking([1.0] * 3, [1.0]))),
        "problem: must weigh 2 states and 1 inputs; got 3 and 1",
    ),
    "Q and R exchanged": (
        lambda: controller(problem=Problem(Tracking([1.0], [1.0, 1.0]))),
        "problem: must weigh 2 states and 1 inputs; got 1 and 2",
    ),
    "angle without a list": (
        lambda: Tracking([1.0, 1.0], [1.0], angles=0),
        "angles: must be a list of different indices",
    ),
    "penalized, misspelt": (
        lambda: Tracking([1.0], [1.0], penalized="input"),
        "penalized: must be one of 'inputs'",
    ),
    "a box that crosses": (lambda: Box([2.0], [-2.0]), "lower, upper: must not cross"),
    "a box of numbers": (lambda: Box(-2.0, 2.0), "lower: must be a list of numbers"),
    "lb": (lambda: Box(lb=[-2.0]), "lb: is no argument (did you mean 'lower'?)"),
    "95 per cent": (
        lambda: Box([-1.0], [1.0], probability=95),
        "probability: must lie in (0.5, 1); got 95",
    ),
    "bounds in a tuple": (
        lambda: Problem(COST, inputs=(-2, 2)),
        "inputs: must be Box(lower, upper); got tuple",
    ),
    "weights in a list": (lambda: Problem([1.0, 1.0]), "cost: must be Tracking(...)"),
    "a flat half-space": (
        lambda: Halfspaces([1.0, 0.0], [1.0]),
        "F, f: must be (r, n)",
    ),
    "a constraint of NumPy": (
        lambda: constrained(Inequality(lambda x: np.sin(x[:, 0]))).control(
            Gaussian.certain(START), Reference(ROWS)
        ),
        "h: must be written with torch",
    ),
    "a constraint that compares": (
        lambda: constrained(Inequality(lambda x: x[:, 0] < 1.0)).control(
            Gaussian.certain(START), Reference(ROWS)
        ),
        "h must give real numbers, below zero where it is kept",
    ),
    "negative horizon": (lambda: controller(horizon=-3), "horizon: must be a whole"),
    "horizon in seconds": (lambda: controller(horizon=0.5), "horizon: must be a whole"),
    "N": (lambda: controller(N=5), "N: is no argument (did you mean 'horizon'?)"),
    "an input as a number": (
        lambda: controller(initial_input=0.0),
        "initial_input: must be a list of 1 numbers",
    ),
    "too many inputs": (
        lambda: controller(initial_input=[0.0, 0.0]),
        "initial_input: must be a list of 1 numbers",
    ),
    "a plant as model": (
        lambda: controller(model=PLANT),
        "model: must be a DynamicsModel, such as GPPosterior; got System",
    ),
    "a class as propagator": (
        lambda: controller(propagator=Linearization),
        "propagator: must be an object with the method 'propagate'",
    ),
    "another order": (
        lambda: GPMPC(gp(), Problem(COST), Linearization(), 5, [0.0]),
        "problem: must be Problem(...); got Linearization",
    ),
    "weights as problem": (
        lambda: controller(problem=COST),
        "problem: must be Problem(...); got Tracking",
    ),
    "a solver by name": (
        lambda: controller(solver="osqp"),
        "solver: must be an object with the method 'solve'",
    ),
    "a gain above one": (
        lambda: PredictionSettings(disturbance_gain=2),
        "disturbance_gain: must lie between 0 and 1",
    ),
    "a GP for NMPC": (
        lambda: NMPC(gp(), Problem(COST), 5, [0.0]),
        "plant: must be a plant",
    ),
    "a GP for many starts": (
        lambda: ManyStarts(gp()),
        "controller: must be GPMPC(...); got GPPosterior",
    ),
    "a state without Gaussian": (
        lambda: control(belief=np.zeros(2)),
        "control takes a Gaussian",
    ),
    "a goal without Reference": (
        lambda: control(reference=ROWS),
        "control takes a Gaussian",
    ),
    "a short reference": (
        lambda: control(reference=Reference(ROWS[:3])),
        "state and reference must have shapes (2,) and (6, 2); got (2,) and (3, 2)",
    ),
    "the last input as decision": (
        lambda: control(previous=[0.0]),
        "previous: must be the last Decision",
    ),
    "a reference in words": (lambda: Reference("up"), "reference states must be real"),
}
LOOPS = {
    "a GP as controller": (lambda: ControlLoop(gp()), "controller: must be an object"),
    "a class": (lambda: ControlLoop(GPMPC), "controller: must be an object with the"),
    "no such policy": (
        lambda: ControlLoop(controller(), "stop"),
        "on_failure: must be one of 'previous_plan', 'hold', 'raise'",
    ),
    "a short state": (
        lambda: ControlLoop(controller()).input([0.0], GOAL),
        "state and reference must have shapes (2,) and (6, 2); got (1,)",
    ),
    "a column": (
        lambda: ControlLoop(controller()).input([[0.0], [0.0]], GOAL),
        "state and reference must have shapes (2,) and (6, 2); got (2, 1)",
    ),
    "a goal as a number": (
        lambda: ControlLoop(controller()).input(START, 1.0),
        "reference states must be (H + 1, n)",
    ),
    "no goal": (
        lambda: ControlLoop(controller()).input(START, None),
        "a reference must be real numbers; got None",
    ),
    "warm-up of nothing": (
        lambda: ControlLoop(controller()).warm_up(),
        "state: is missing; warm_up takes state, reference",
    ),
    "dynamics as system": (lambda: fly(system=Cart()), "system: must be a plant"),
    "plant and controller exchanged": (
        lambda: closed_loop(controller(), PLANT, GOAL, START, 2),
        "controller: must be an object with the method 'control'",
    ),
    "no controller": (
        lambda: fly(controller=None),
        "controller: must be an object with the method 'control'",
    ),
    "x0": (lambda: fly(x0=START), "x0: is no argument (did you mean 'initial'?)"),
    "no references": (lambda: fly(references=None), "a reference must be real numbers"),
    "few references": (
        lambda: fly(references=ROWS[:4]),
        "2 steps with horizon 5 need 7 references; got 4",
    ),
    "a trajectory": (lambda: fly(references=Hover()), "a reference must be real"),
    "no start": (lambda: fly(initial=None), "initial: must be a state"),
    "a start that is missing": (
        lambda: fly(initial=[np.nan, 0.0]),
        "initial: must be finite",
    ),
    "steps in seconds": (lambda: fly(steps=0.5), "steps: must be a whole number"),
    "noise as a number": (lambda: fly(noise=0.1), "noise: must be Noise(...); got 0.1"),
    "noise of one state": (
        lambda: fly(noise=Noise(process=[0.1])),
        "noise.process must have 2 standard deviations; got 1",
    ),
    "negative noise": (
        lambda: Noise(process=[-0.1, 0.1]),
        "noise.process: must be a number, 0 or more",
    ),
    "a gust without a list": (
        lambda: fly(disturbances=Gust({"speed": 1.0})),
        "disturbances: must be a list",
    ),
    "a gust on no state": (
        lambda: fly(disturbances=[Gust({"velocity": 1.0})]),
        "rates: must name states of the plant",
    ),
    "a seed in words": (lambda: fly(seed="a"), "seed: must be a whole number"),
    "a controller of another system": (
        lambda: fly(system=renamed()),
        "system: the controller has the states position, speed; Cart has angle, rate",
    ),
    "a model of another time step": (
        lambda: fly(system=System(Cart(), 0.2)),
        "system: the controller has time steps of 0.1 s; Cart has 0.2 s",
    ),
    "no seeds": (
        lambda: closed_loops(PLANT, controller(), GOAL, START, 2, 0),
        "seeds: must be a whole number, 1 or more",
    ),
    "a figure of states": (
        lambda: flight_figure(ROWS, PLANT),
        "rollout: must be a Rollout of closed_loop; got ndarray",
    ),
}
STUDIES = {
    "negative samples": (
        lambda: RandomData(samples=-3),
        "data.samples: must be a whole number",
    ),
    "a plant without limits": (
        lambda: RandomData(samples=10).transitions(PLANT),
        "data: random inputs need limits; force of Cart has none",
    ),
    "a controller, not how to make it": (
        lambda: Experiment(RandomData(), None, pendulum(), Trainer(), controller()),
        "controller: must be a function from a model to a controller",
    ),
    "a trial of a system": (
        lambda: run_trial(PLANT),
        "experiment: must be Experiment(...); got System",
    ),
    "waypoints in disorder": (
        lambda: Waypoints([1, 0], [[0, 0, 0], [1, 1, 1]]),
        "times: must be strictly increasing",
    ),
    "no such recording": (lambda: read_run("no.mcap"), "no.mcap: cannot be read"),
    "a CSV file as recording": (lambda: read_run("log.csv"), "log.csv: is not an MCAP"),
    "a plant to be recorded": (
        lambda: McapRecorder("run.mcap", PLANT),
        "system: must be RecordedSystem.of(system); got System",
    ),
    "dynamics to be recorded": (
        lambda: RecordedSystem.of(Cart()),
        "system: must be a System(dynamics, time_step); got Cart",
    ),
    "no such log": (lambda: log("no.csv"), "no.csv: no such file"),
    "a key of no mapping": (lambda: log(state={}), "mapping.state: no such key"),
    "a column of no log": (
        lambda: log(inputs={"u": {"columns": ["force"]}}),
        "log.csv: column 'force' is missing; it has t, x, u",
    ),
    "an unknown unit": (
        lambda: log(states={"x": {"columns": ["x"], "unit": "parsec"}}),
        "states.x.unit: 'parsec' is an unknown unit",
    ),
}
FURTHER = {
    "the class of a trainer": (
        lambda: train_model(data(), trainer=Trainer),
        "trainer: must be Trainer(...); got Trainer",
    ),
    "a trainer by its name": (
        lambda: train_model(data(), trainer="sparse"),
        "trainer: must be Trainer(...); got 'sparse'",
    ),
    "rows as an array": (
        lambda: train_model(X),
        "transitions: must be Transitions(...); got ndarray",
    ),
    "the function that makes a system": (
        lambda: train_model(data(), system=pendulum),
        "system: must be a System, such as",
    ),
    "kinematics as yes and no": (
        lambda: train_model(data(), system=PLANT, kinematics=True),
        "kinematics: must be one of 'integrated', 'learned'",
    ),
    "one deviation for all states of random data": (
        lambda: RandomData(samples=5, noise=0.1),
        "data.noise: must be a list of standard deviations",
    ),
    "random data of dynamics": (
        lambda: RandomData(samples=5).transitions(Cart()),
        "system: must be a plant, such as System(",
    ),
    "rates as a pair": (
        lambda: System(Cart(), 0.1, rates=("speed", "position")),
        "rates: must map names, as {name: ...}",
    ),
    "an angle by its index": (
        lambda: System(pendulum().dynamics, 0.05, angles=[0]),
        "angles: must name states, angle, rate; got 0",
    ),
    "a region a row a state": (
        lambda: System(Cart(), 0.1, region=[[-1, 1], [-1, 1], [0, 1]]),
        "region: must be the smallest and the largest states",
    ),
    "a region upside down": (
        lambda: System(Cart(), 0.1, region=[[1, 1], [-1, -1]]),
        "region: must not cross",
    ),
    "a training as a model": (
        lambda: controller(model=Trainer(restarts=0)(data())),
        "model: must be a DynamicsModel, such as GPPosterior; got Training",
    ),
    "a cost as a problem": (
        lambda: controller(problem=COST),
        "problem: must be Problem(...); got Tracking",
    ),
    "the class of a propagator": (
        lambda: controller(propagator=Linearization),
        "propagator: must be an object with the method 'propagate'",
    ),
    "the class of a controller": (
        lambda: fly(controller=GPMPC),
        "controller: must be an object with the method 'control'",
    ),
    "one number as noise of a flight": (
        lambda: fly(noise=0.1),
        "noise: must be Noise(...); got 0.1",
    ),
    "half a step": (lambda: fly(steps=2.5), "steps: must be a whole number"),
    "a reference of another system": (
        lambda: fly(references=[1.0, 0.0, 0.0]),
        "state and reference must have shapes (2,) and (6, 2)",
    ),
    "a dropout that ends before it begins": (
        lambda: Dropout(start=2.0, stop=1.0),
        "stop: must be a number above 2.0 [s]; got 1.0",
    ),
    "a model of arrays": (
        lambda: Affine(np.eye(2), np.ones((2, 1)), np.zeros(2)),
        "A: must be a torch tensor; got ndarray",
    ),
    "a folder that is not there": (
        lambda: save_model(gp(), "missing/folder/model.safetensors"),
        "missing/folder/model.safetensors: the folder",
    ),
    "a controller drawn": (
        lambda: flight_figure(controller(), PLANT),
        "rollout: must be a Rollout of closed_loop; got GPMPC",
    ),
}
OF_A_KIND = {
    "one constraint as a function": (
        lambda: Problem(COST, constraints=lambda x: x[:, 0] - 1),
        "constraints: must be Box(...), Halfspaces(...) or Inequality(...); got func",
    ),
    "constraints by name": (
        lambda: Problem(COST, constraints={"wall": Box([-1, -1], [1, 1])}),
        "constraints: must be Box(...), Halfspaces(...) or Inequality(...); got dict",
    ),
    "the class of a constraint": (
        lambda: Problem(COST, constraints=[Box]),
        "constraints: must be Box(...), Halfspaces(...) or Inequality(...); got the c",
    ),
    "a mask in the place of indices": (
        lambda: Tracking([1.0, 1.0], [1.0], angles=[True, False]),
        "angles: must be a list of different indices from 0 to 1; got [True, False]",
    ),
    "one state without a list": (
        lambda: Measurement.of_states(2, 0, [0.1]),
        "states: must be a list of indices from 0 to 1; got 0",
    ),
    "an angle named twice": (
        lambda: Tracking([1.0, 1.0], [1.0], angles=[0, 0]),
        "angles: must be a list of different indices from 0 to 1; got [0, 0]",
    ),
    "the class of a model": (
        lambda: controller(model=Trainer),
        "model: must be a DynamicsModel, such as GPPosterior; got the class Trainer",
    ),
    "a flight as the last decision": (
        lambda: control(previous=fly()),
        "previous: must be the last Decision, or None at the first step; got Rollout",
    ),
    "yes for true": (
        lambda: Linearization(process_noise="yes"),
        "process_noise: must be true or false; got 'yes'",
    ),
    "model and propagator exchanged": (
        lambda: rollout(gp(), Linearization(), Gaussian.certain(START), torch.ones(1)),
        "propagator: must be an object with the method 'propagate'",
    ),
    "an input that is a state": (
        lambda: System(Circular(), 0.1),
        "dynamics.input_names: must be no names of states; got 'speed'",
    ),
    "rate and position exchanged": (
        lambda: System(Cart(), 0.1, rates={"position": "speed"}),
        "rates: must map a rate to what it is the rate of, such as {'speed': 'posi",
    ),
    "angles as yes": (
        lambda: System(Cart(), 0.1, angles=True),
        "angles: must be a list of names; got True",
    ),
    "a unit that is a number": (
        lambda: System(Cart(), 0.1, units={"position": 1}),
        "units: must be texts, such as 'm'; got 1 of position",
    ),
    "dynamics as what is known": (
        lambda: System(Cart(), 0.1, nominal=Cart()),
        "nominal: must be System(dynamics, time_step); got Cart",
    ),
    "an array that is filled": (
        lambda: step_many(cart_of(filled), X, U),
        "dynamics: must be written with plain arithmetic and functions of gpmpc.syst",
    ),
    "a column of states and inputs": (
        lambda: Transitions.from_csv("log.csv", ["x"], ["x"]),
        "inputs: must be no states; got 'x'",
    ),
    "dt of a CSV file": (
        lambda: Transitions.from_csv("log.csv", ["x"], ["u"], dt=0.1),
        "dt: is no argument (did you mean 'time_step'?)",
    ),
    "a column by its name": (
        lambda: data()["position"],
        "rows: must be whole numbers or a slice; columns are in states and inputs",
    ),
    "a single row": (
        lambda: data()[0],
        "rows: must be whole numbers or a slice; columns are in states and inputs; got",
    ),
    "a system as a known model": (
        lambda: KnownModel(PLANT, 2, 1),
        "function: must be a function of tensors; got System",
    ),
    "a known model of NumPy": (
        lambda: KnownModel(lambda x, u: np.zeros(2), 2, 1),
        "function must give next states (*batch, 2) of states (*batch, 2) and inputs",
    ),
    "a known model of one state": (
        lambda: KnownModel(lambda x, u: torch.stack([x[0], x[1] + u[0]]), 2, 1),
        "function must give next states (*batch, 2) of states (*batch, 2) and inputs",
    ),
    "a known model without numbers": (
        lambda: KnownModel(lambda x, u: x),
        "state_dim: is missing; KnownModel takes function, state_dim, input_dim",
    ),
    "the class of a disturbance": (
        lambda: fly(disturbances=[Gust]),
        "disturbances: must be an object with the method 'disturb_plant'",
    ),
    "a function as disturbance": (
        lambda: fly(disturbances=[lambda time: 0.0]),
        "disturbances: must be an object with the method 'disturb_plant'",
    ),
    "learning in a dictionary": (
        lambda: LearningController(controller(), {"points": 10}),
        "learning: must be OnlineLearning(...); got dict",
    ),
    "a share in per cent": (
        lambda: OnlineLearning(share=10),
        "share: must be at most 1; got 10",
    ),
    "a flight as a recording": (
        lambda: tracking_figure(fly()),
        "run: must be a Run of read_run; got Rollout",
    ),
    "a path as a recording": (
        lambda: replay("run.mcap", 1),
        "run: must be a Run of read_run; got str",
    ),
    "a figure without its system": (
        lambda: flight_figure(fly()),
        "system: is missing; flight_figure takes rollout, system",
    ),
    "a recording of nothing": (
        lambda: read_run(None),
        "path: must be the name of one file; got None",
    ),
    "a flight as a calibration": (
        lambda: calibration_figure(fly()),
        "calibration: must be what calibrate returns; got Rollout",
    ),
    "an experiment in another order": (
        lambda: Experiment(pendulum(), RandomData(), None, Trainer(), controller),
        "system: must be a System; got NoneType",
    ),
    "weights as a diagonal for a gain": (
        lambda: dlqr([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], [1.0, 1.0], [1.0]),
        "A, B, Q and R must be (n, n), (n, m), (n, n) and (m, m); got (2, 2), (2, 1)",
    ),
    "a tolerance in words": (
        lambda: DualActiveSet(tolerance="tight"),
        "tolerance must be positive; got tight",
    ),
    "a program in pieces": (
        lambda: DualActiveSet().solve(np.eye(2), np.zeros(2)),
        "problem must be QuadraticProgram(...); got ndarray",
    ),
}
ROOMS = {
    "systems": SYSTEMS,
    "data": DATA,
    "models": MODELS,
    "controllers": CONTROLLERS,
    "loops": LOOPS,
    "studies": STUDIES,
    "further": FURTHER,
    "of a kind": OF_A_KIND,
}
CALLS = {
    f"{room}: {name}": row for room, rows in ROOMS.items() for name, row in rows.items()
}
COMMANDS = {
    "fly": "unknown command 'fly'",
    "run systm=pendulum": "unknown setting 'systm' (did you mean 'system'?)",
    "run system=pendulumm": "system: no such option 'pendulumm'",
    "run horizon=ten": "horizon: must be a whole number, 1 or more; got 'ten'",
    "run horizon = 5": "'horizon': cannot be read; a setting is written SETTING=VALUE",
    "run --horizon 5": "unknown option '--horizon'",
    "run -m seed=range(3": "'seed=range(3': cannot be read",
    "run model=nothere.safetensors": "nothere.safetensors: no such file",
    "run noise=0.1": "noise: must be set by its parts, as noise.NAME=VALUE; got 0.1",
    "run folder=": "folder: must be the path of a folder",
    "plot": "the following arguments are required: RUN",
    "plot log.csv": "log.csv: is not an MCAP file",
    "log inspect no.csv": "no.csv: no such file",
    "report nowhere": "nowhere: no such folder",
    "run trajectory=": "trajectory: choose one of elliptical, goal, hover, lorenz",
    "learn no.yaml log.csv": (
        "mapping: no.yaml cannot be read (No such file or directory)\n"
    ),
    "new 2arm": "NAME: must be letters, digits and _",
    "new class": "NAME: class is the name of a keyword of Python",
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder but for a log of six rows, and one with a word in it."""
    rows = [f"{0.1 * k:.1f},{k},{k % 2}" for k in range(6)]
    (tmp_path / "log.csv").write_text("\n".join(["t,x,u", *rows]))
    (tmp_path / "words.csv").write_text("x,u\n1,a\n2,3\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", CALLS)
def test_a_mistake_is_refused_with_one_line_of_ours(name, folder):
    call, words = CALLS[name]
    with pytest.raises(GpmpcError) as refused:
        call()
    text = str(refused.value)
    assert "\n" not in text
    assert text.startswith(words), text


@pytest.mark.parametrize("line", COMMANDS)
def test_a_mistaken_command_is_one_line_and_exit_code_2(line, folder):
    done = forked(*line.split(" "), cwd=folder)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert done.stderr.startswith(f"gpmpc: {COMMANDS[line]}")


def test_whole_numbers_of_numpy_are_whole_numbers():
    assert controller(horizon=np.int64(5)).horizon == 5
    assert len(fly(steps=np.int32(2)).inputs) == 2


def test_a_field_of_a_settings_object_is_found_by_its_name():
    with pytest.raises(GpmpcError, match=r"prediction=PredictionSettings\(rolled_out="):
        controller(rolled_out=True)


def test_few_rows_are_learned_from_with_a_warning(caplog):
    Trainer(restarts=0)(data()[:3])
    assert "3 rows for 3 columns of states and inputs" in caplog.text
    caplog.clear()
    Trainer(restarts=0)(data())
    assert "rows for" not in caplog.text
