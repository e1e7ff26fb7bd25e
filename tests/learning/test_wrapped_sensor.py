"""A sensor that shows an angle within a turn changes no flight and teaches nothing."""

import numpy as np
import pytest

from gpmpc.gp import Trainer, Transitions
from gpmpc.learning import ChangedModel, EpisodicLearning, LearningController
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc import GPMPC, Box, ControlLoop, PredictionSettings, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import ModelLoop, closed_loop
from gpmpc.systems import System

STEP = 0.05
STEPS = 120
HORIZON = 8
NOISE = np.array([1e-4, 1e-3])
PROBLEM = Problem(Tracking([10.0, 1.0], [0.01], angles=[0]), Box([-15.0], [15.0]))
TIME = STEP * np.arange(STEPS + HORIZON + 1)
SWING = np.stack([np.pi + 0.6 * np.sin(1.5 * TIME), 0.9 * np.cos(1.5 * TIME)], axis=1)


def moved(x, u):
    """Angle and rate of a hanging pendulum a step later; the angle counts turns."""
    rate = x[1] + STEP * (-9.81 * np.sin(x[0]) - 0.2 * x[1] + u[0])
    return np.array([x[0] + STEP * rate, rate])


def shown(x):
    seen = np.array(x)
    seen[..., 0] = np.mod(seen[..., 0] + np.pi, 2 * np.pi) - np.pi
    return seen


def data():
    rng = np.random.default_rng(0)
    x = rng.uniform([-4, -3], [4, 3], (120, 2))
    u = rng.uniform(-12, 12, (120, 1))
    after = np.array([moved(*row) for row in zip(x, u, strict=True)])
    return Transitions(shown(x), u, shown(after + rng.normal(0, NOISE, (120, 2))))


MODEL = ResidualModel.train(
    Affine.identity(2, 1), data(), angles=[0], trainer=Trainer(restarts=0)
)


def controller(**settings):
    prediction = PredictionSettings(**settings)
    return GPMPC(MODEL, Linearization(), PROBLEM, HORIZON, [0.0], prediction=prediction)


def flown(control, sensor):
    """Inputs and decisions of a flight that swings across half a turn."""
    loop = ControlLoop(control)
    rng = np.random.default_rng(1)
    x = SWING[0]
    inputs = []
    decisions = []
    for k in range(STEPS):
        inputs.append(loop.input(sensor(x), SWING[k : k + HORIZON + 1]))
        decisions.append(loop.last.decision)
        x = moved(x, inputs[-1]) + rng.normal(0, NOISE)
    return np.array(inputs), decisions


@pytest.mark.parametrize(
    "make",
    [
        controller,
        lambda: LearningController(controller()),
        lambda: controller(form="velocity"),
        lambda: controller(disturbance_gain=0.3),
    ],
    ids=["plans", "learning", "velocity", "disturbance"],
)
def test_a_wrapping_sensor_gives_the_flight_of_an_unwrapped_one(make):
    (counting, _), (wrapping, decisions) = (
        flown(make(), sensor) for sensor in (np.array, shown)
    )
    assert np.abs(counting - wrapping).max() < 1e-5
    learned = [decision.learned for decision in decisions if decision.learned]
    assert not any(one.active for one in learned)
    estimates = [d.disturbance for d in decisions if d.disturbance is not None]
    assert np.abs(np.array(estimates)).max(initial=0.0) < 0.01


def test_angles_of_the_cost_alone_are_known_to_learning_as_well():
    rng = np.random.default_rng(0)
    plain = data()
    x = rng.uniform([2.0, -3], [4.2, 3], (60, 2))
    u = rng.uniform(-12, 12, (60, 1))
    after = np.array([moved(*row) for row in zip(x, u, strict=True)])
    posterior = Trainer(predicts="difference", restarts=0)(
        Transitions(x, u, after)
    ).posterior
    assert len(plain) == 120
    control = GPMPC(posterior, Linearization(), PROBLEM, HORIZON, [0.0])
    assert LearningController(control)._model.angles == [0]
    changed = ChangedModel(posterior, further_angles=[0])
    at = np.array([3.13, 2.0])
    torque = np.array([1.0])
    errors = [
        changed.observe(at, torque, sensor(moved(at, torque))).value
        for sensor in (np.array, shown)
    ]
    assert np.allclose(errors[0], errors[1], atol=1e-12)
    assert np.abs(errors[1]).max() < 0.01


class Hanging:
    """A pendulum whose angle is zero where it hangs."""

    state_names = ("angle", "rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        return np.stack([x[1], -9.81 * np.sin(x[0]) - 0.2 * x[1] + u[0]])


class WrappingSensor:
    """Shows the angle between -pi and pi."""

    def disturb_plant(self, plant, time):
        return plant

    def disturb_measurement(self, measured, time):
        return shown(measured)


def test_learned_flights_have_innovations_without_turns():
    plant = System(Hanging(), STEP, angles=["angle"])
    recorded = []
    flight = closed_loop(
        plant,
        controller(),
        SWING,
        SWING[0],
        60,
        disturbances=[WrappingSensor()],
        on_step=recorded.append,
    )
    assert (np.abs(np.diff(flight.measured[:, 0])) > 3).any()
    assert np.abs(np.diff(flight.states[:, 0])).max() < 0.2
    assert np.abs([step.innovation for step in recorded[1:]]).max() < 0.5
    rows = EpisodicLearning().with_flight(data(), flight)
    again = ResidualModel.train(
        Affine.identity(2, 1), rows, angles=[0], trainer=Trainer(restarts=0)
    )
    missed = again.predict_mean(flight.states[:-1], flight.inputs) - flight.states[1:]
    assert np.abs(missed).max() < 0.05


class WrappingModel:
    """A model of the own whose angle comes out between -pi and pi."""

    angles = (0,)

    def __init__(self, model):
        self._model = model

    def __getattr__(self, name):
        return getattr(self._model, name)

    def predict(self, state, input):
        belief = self._model.predict(state, input)
        belief.mean[..., 0] = (belief.mean[..., 0] + np.pi) % (2 * np.pi) - np.pi
        return belief

    def linearize(self, states, inputs, covariance=True):
        linearized = self._model.linearize(states, inputs, covariance)
        return linearized._replace(mean=shown(linearized.mean))


def test_a_model_loop_has_innovations_without_turns():
    loop = ModelLoop(WrappingModel(MODEL), Linearization(), STEP)
    recorded = []
    closed_loop(loop, controller(), SWING, SWING[0], 20, on_step=recorded.append)
    states = np.array([step.state for step in recorded])
    assert (np.abs(np.diff(states[:, 0])) > 3).any()
    assert np.abs([step.innovation[0] for step in recorded[1:]]).max() < 0.1
