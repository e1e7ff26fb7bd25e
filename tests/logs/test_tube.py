"""The tube of a controller that flies what was learned holds what it says."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.estimation import ConformalTube
from gpmpc.gaussian import Gaussian
from gpmpc.logs import Log, LogMapping
from gpmpc.logs._log import LogRun
from gpmpc.logs._noise import fit_noise, noise_steps
from gpmpc.models import DelayedModel, DisturbedModel, LogDynamics, LogModel
from gpmpc.models._kinematics import Increments, RigidBodyKinematics
from gpmpc.models._log_dynamics import OutputNoise, TubeNoise
from gpmpc.models._parametric import AffineNominal, MultirotorNominal
from gpmpc.models._quaternions import rotation_quaternion
from gpmpc.models._state_space import StateGroup, StateSpace
from gpmpc.mpc import GPMPC, Box, ControlLoop, FlightJudge, Problem, Tracking
from gpmpc.mpc._judgement import _learned_noise
from gpmpc.propagation import Linearization
from gpmpc.signals import Signals

DT = 0.02
ROWS = 2000
DRAG = 1.5
SENSORS = np.array([0.01, 0.02])
MAPPING = LogMapping.from_dict(
    {"states": {"x": ["x"], "v": ["v"]}, "inputs": {"u": ["u"]}}
)
BODY = StateSpace(
    (
        StateGroup("p", ("px", "py", "pz")),
        StateGroup("q", ("qx", "qy", "qz", "qw"), "", "quaternion"),
        StateGroup("v", ("vx", "vy", "vz")),
        StateGroup("w", ("wx", "wy", "wz")),
    )
)


def cart_log(seed, sensors, force, correlation):
    """A cart that is pushed, and by noise as well, as its sensors measured it."""
    rng = np.random.default_rng(seed)
    inputs = np.repeat(rng.normal(size=ROWS // 10), 10)
    x = np.zeros(2)
    push = 0.0
    states = []
    for u in inputs:
        states.append(x)
        innovation = np.sqrt(1 - correlation**2) * rng.normal()
        push = correlation * push + force * innovation
        x = x + DT * np.array([x[1], u - DRAG * x[1] + push])
    measured = np.array(states) + sensors * rng.normal(size=(ROWS, 2))
    time = DT * np.arange(ROWS, dtype=float)
    run = LogRun(f"run {seed}", time, measured, inputs[:, None], np.empty((ROWS, 0)))
    return Log(MAPPING, DT, (run,))


def cart_model():
    """The cart without the noise."""
    kinematics = Increments(MAPPING.space)
    theta = np.array([[0, 1.0, 0, 0], [0, -DRAG, 1.0, 0]]).ravel()
    return LogModel(kinematics, AffineNominal(kinematics), theta, (0, 0))


@pytest.mark.parametrize(
    ("sensors", "force", "correlation", "widest"),
    [(SENSORS, 0.0, 0.0, 1.25), (SENSORS, 0.5, 0.0, 1.25), (0.0, 0.5, 0.9, 4.0)],
    ids=["of sensors", "of both", "coloured"],
)
def test_a_tube_holds_held_out_rows(sensors, force, correlation, widest):
    log = cart_log(0, sensors, force, correlation)
    model = cart_model()
    noise = fit_noise([model], [log], noise_steps(50))
    dynamics = LogDynamics(model, 1, DT, noise)
    (run,) = cart_log(1, sensors, force, correlation)
    recording = Recording(run.states, run.inputs[:-1])
    found = calibrate(dynamics, recording, Linearization(), 50, levels=(0.95,))
    assert found.noise.endswith("what the model knows of the sensors' at the first")
    coverage = found.coverage[[0, 9, 49], :, 0].numpy()
    width = found.width[[0, 9, 49]].numpy()
    assert (coverage > 0.84).all(), coverage
    assert ((width > 0.75) & (width < 1.4))[1:].all(), width
    # White noise that grows as coloured noise does is too large one step ahead; the
    # next place is known where no sensor has noise.
    assert width[0, 1] < widest, width


def with_tube(model, inputs, start):
    """A model of a log whose rows are uncertain."""
    outputs = np.ones(len(model.history))
    variances = OutputNoise(np.ones((4, len(outputs))), np.ones(len(start)))
    tube = TubeNoise(outputs=outputs, start=start)
    return LogDynamics(model, inputs, DT, replace(variances, tube=tube))


def test_an_attitude_that_was_measured_is_uncertain_about_itself():
    model = LogModel(
        RigidBodyKinematics(BODY), MultirotorNominal(4), np.zeros(6), (0,) * 6
    )
    start = np.arange(1.0, 13.0) * 1e-4
    state = np.zeros(13)
    state[3:7] = rotation_quaternion(np.array([0.3, -1.0, 2.0]))
    covariance = with_tube(model, 4, start).start_covariance(state)
    rng = np.random.default_rng(0)
    errors = np.sqrt(start) * rng.normal(size=(200_000, 12))
    samples = BODY.displace(state, errors) - state
    scale = np.sqrt(np.outer(covariance.diagonal(), covariance.diagonal()))
    np.testing.assert_array_less(
        abs(samples.T @ samples / len(samples) - covariance), 0.01 * scale + 1e-6
    )


@pytest.mark.parametrize("delay", [0, 2])
def test_a_loop_begins_with_what_is_known_of_rows(delay):
    start = np.array([4e-4, 9e-4])
    model = with_tube(cart_model(), 1, start)
    if delay:
        model = DelayedModel(model, delay)
    problem = Problem(Tracking([10.0, 1.0], [0.1]), Box([-3.0], [3.0]))
    pilot = GPMPC(model, Linearization(), problem, 5, [0.0])
    loop = ControlLoop(pilot)
    loop.input([0.5, 0.0], np.zeros(2))
    assert loop.last is not None
    plan = loop.last.decision
    assert plan is not None
    np.testing.assert_allclose(plan.covariances[0], np.diag(start))
    assert (plan.covariances[1].diagonal() > start).all()
    # What a filter believes stays.
    belief = Gaussian(torch.zeros(2).double(), 0.01 * torch.eye(2).double())
    loop.input(belief, np.zeros(2))
    plan = loop.last.decision
    assert plan is not None
    np.testing.assert_allclose(plan.covariances[0], 0.01 * np.eye(2))
    # A plan of means alone leaves both out.
    blind = replace(pilot.prediction.settings, covariance="none")
    of_means = GPMPC(model, Linearization(), problem, 5, [0.0], prediction=blind)
    noise = _learned_noise(of_means)
    assert noise is not None
    np.testing.assert_allclose(noise[:2], start + DT**2, rtol=1e-6)


def test_a_disturbance_beside_a_log_model_is_flown_and_judged():
    model = with_tube(cart_model(), 1, np.array([4e-4, 9e-4]))
    named = replace(model, signals=Signals(("x", "v"), ("u",)))
    disturbed = DisturbedModel(named, torch.ones(2, 1).double(), [0.01])
    problem = Problem(Tracking([10.0, 1.0, 0.0], [0.1]), Box([-3.0], [3.0]))
    loop = ControlLoop(GPMPC(disturbed, Linearization(), problem, 3, [0.0]))
    loop.input([0.5, 0.0, 0.1], np.zeros(3))  # as an observer estimates it
    assert loop.last is not None
    plan = loop.last.decision
    assert plan is not None
    assert not plan.covariances[0].any()
    judge = FlightJudge.of(loop.controller, 2, 1)
    judgement = judge.judge(np.zeros(2), np.zeros(2), plan)
    assert judgement.level == "healthy"


def test_a_conformal_tube_begins_with_what_is_known_of_rows():
    (run,) = cart_log(2, SENSORS, 0.0, 0.0)
    tube = TubeNoise(outputs=np.full(2, 1e-12), start=2 * SENSORS**2)
    noise = replace(OutputNoise(np.ones((4, 2)), np.ones(2)), tube=tube)
    model = LogDynamics(cart_model(), 1, DT, noise)
    found = ConformalTube.calibrate(
        model, Linearization(), run.states, run.inputs[:-1], horizon=5
    )
    # The larger of two sides of two Gaussian states.
    assert abs(np.median(found.scores) - 1.05) < 0.15
