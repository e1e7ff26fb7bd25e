"""Loops keep what the state of a model holds beside what is measured."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.logs import SavedModel
from gpmpc.models import DelayedModel, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Halfspaces,
    Inequality,
    LeastSquares,
    ManyStarts,
    PredictionSettings,
    Problem,
    Tracking,
    beyond_data,
)
from gpmpc.mpc.baselines import LQR
from gpmpc.propagation import Linearization
from gpmpc.simulation import Dropout, ModelLoop, closed_loop, closed_loops
from gpmpc.systems import System
from tests.logs.made_models import affine_dynamics

DT = 0.05
LAG = 0.1  # time constant of the actuator [s]
LATE = 2  # rows
FOLLOWED = 0.4  # of a change of velocity in a row, once more in the next
GOAL = np.array([1.0, 0.0])
COST = Tracking([10.0, 1.0], [0.1], penalized="inputs")


class Cart:
    """A cart with a late and lagging motor: two of its six states are measured."""

    stateful = True
    state_names = ("x", "v")
    input_names = ("u",)

    def reset(self, seed):
        self.measured = np.zeros(2)
        self.force = self.last_velocity = 0.0
        self.queue = [0.0] * LATE
        return self.measured

    def successor(self, x, u):
        assert np.array_equal(x, self.measured)
        self.queue.append(float(u[0]))
        command = self.queue.pop(0)
        decay = np.exp(-DT / LAG)
        acting = command + (self.force - command) * (1 - decay) * LAG / DT
        self.force = command + decay * (self.force - command)
        gain = FOLLOWED * (x[1] - self.last_velocity)
        self.last_velocity = x[1]
        self.measured = x + DT * np.array([x[1], acting]) + np.array([0.0, gain])
        return self.measured


PLANT = System(Cart(), DT)


def dynamics(noise=0.0):
    """The cart as a model of a log knows it."""
    weights = np.zeros((2, 7))  # of (x, v, u), their differences from the last, and 1
    weights[1, 4] = FOLLOWED / DT
    return affine_dynamics(
        ("x", "v"),
        theta=[[0, 1.0, 0, 0], [0, 0, 1.0, 0]],
        time_step=DT,
        noise=noise,
        rows_back=1,
        lag=LATE,
        time_constants=np.array([LAG]),
        weights=weights,
    )


def controller(model, constraints=(), outputs=()):
    """A controller that weighs what is measured."""
    inputs = Box([-3.0], [3.0])
    problem = Problem(COST, inputs, constraints=constraints, outputs=outputs)
    propagator = Linearization(process_noise=True)
    return GPMPC(model, propagator, problem, 25, [0.0])


def from_many_starts():
    """A search for the plan, as short as it may be."""
    pilot = controller(dynamics(1e-6))
    return ManyStarts(pilot, guesses=[None], turns=1, budget=1e-6)


def regulator():
    """The linear-quadratic regulator of the same problem."""
    return LQR(dynamics(1e-6), Problem(COST, Box([-3.0], [3.0])), 25, [0.0])


@pytest.mark.parametrize(
    "made",
    [lambda: controller(dynamics(1e-6)), from_many_starts, regulator],
    ids=["one", "many", "lqr"],
)
def test_what_is_not_measured_is_kept_from_step_to_step(made):
    pilot = made()
    steps = []
    flown = closed_loop(PLANT, pilot, GOAL, None, 50, on_step=steps.append)
    assert abs(flown.states[-1] - GOAL).max() < 1e-2
    assert flown.judgement.level == "healthy"
    # The model knows all that the plant does.
    np.testing.assert_allclose(flown.predicted_means, flown.states[1:], atol=1e-9)
    # Plans and tubes are of what is measured.
    plan = steps[5].decision
    assert (plan.means.shape, plan.covariances.shape) == ((26, 2), (26, 2, 2))
    variances = plan.covariances[1:].diagonal(axis1=1, axis2=2)
    assert (variances > 0).all() or made is regulator


def test_a_dropout_is_bridged_by_the_model():
    pilot = controller(dynamics())
    flown = closed_loop(
        PLANT, pilot, GOAL, None, 30, on_failure="previous_plan",
        disturbances=[Dropout(start=0.5, stop=0.7)],
    )  # fmt: skip
    assert {status.name for status in flown.statuses[10:14]} == {"INVALID_MEASUREMENT"}
    np.testing.assert_allclose(flown.predicted_means[14:], flown.states[15:], atol=1e-9)


def test_constraints_and_outputs_see_what_is_measured():
    seen = []

    def height(x, u):
        seen.append(x.shape[1])
        return x[:, :1] - 0.5

    pilot = controller(
        dynamics(),
        constraints=[
            Box([-9.0, -0.5], [9.0, 0.5]),
            Halfspaces([[1.0, 1.0]], [5.0]),
            Inequality(lambda x: x[:, 0] - 0.8),
        ],
        outputs=[LeastSquares(height, [0.01])],
    )
    flown = closed_loop(PLANT, pilot, GOAL, None, 45)
    assert set(seen) == {2}
    assert flown.states[:, 1].max() < 0.501
    assert 0.75 < flown.states[-1, 0] < 0.801


def test_a_loop_of_ones_own_keeps_it_as_well():
    flown = closed_loop(PLANT, controller(dynamics()), GOAL, None, 8)
    loop = ControlLoop(controller(dynamics()))
    for state, applied in zip(flown.states, flown.inputs, strict=False):
        np.testing.assert_array_equal(loop.input(state, GOAL), applied)
    assert loop.judgement is not None
    assert loop.judgement.level == "healthy"
    assert loop.last is not None
    assert loop.last.decision is not None
    planned = loop.last.decision.means[0]
    expected = loop.last.decision.inputs[0]
    np.testing.assert_allclose(loop.input_between(planned, 0.0), expected)
    pushed = loop.input_between(planned + np.array([0.1, 0.0]), 0.0)
    assert pushed < expected


def test_a_loop_judges_the_states_that_its_problem_weighs():
    model = dynamics()
    loop = ControlLoop(controller(model))
    goal = model.at_rest(GOAL, np.zeros(1))
    told = model.at_rest(np.zeros(2), np.zeros(1))
    measured = ControlLoop(controller(model)).input(np.zeros(2), GOAL)
    assert loop.input(told, goal) == pytest.approx(measured)
    assert loop.judgement is not None
    assert loop.judgement.level == "healthy"


def test_a_loop_corrects_between_steps_whatever_was_measured():
    loop = ControlLoop(controller(dynamics()))
    start = np.zeros(2)
    lost = np.full(2, np.nan)
    applied = loop.input(lost, GOAL)
    assert loop.input_between(start, 0.0) == applied
    loop.input(start, GOAL)
    applied = loop.input(lost, GOAL)
    assert loop.last is not None
    assert loop.last.plan is not None
    planned = loop.last.plan.means[0, :2]
    assert loop.input_between(planned, 0.0) == pytest.approx(applied)
    assert loop.input_between(planned + np.array([0.1, 0.0]), 0.0) < applied


def test_stability_is_judged_with_the_past():
    steady = controller(dynamics()).stability(GOAL)
    assert steady.stable
    np.testing.assert_allclose(steady.states, [GOAL], atol=1e-6)
    late = DelayedModel(dynamics(), 8)
    assert not controller(dynamics()).stability(GOAL, plant=late).stable


def test_a_model_loop_carries_the_past_on():
    model = dynamics()
    flown = closed_loop(
        ModelLoop(model, Linearization()), controller(model), GOAL,
        Gaussian.certain([0.0, 0.0]), 60,
    )  # fmt: skip
    assert flown.states.shape == (61, 2)
    np.testing.assert_allclose(flown.predicted_means, flown.states[1:], atol=1e-9)


def test_recorded_flights_are_predicted_with_their_past():
    flown = closed_loop(PLANT, controller(dynamics()), GOAL, None, 60)
    recording = Recording(flown.states, flown.inputs)
    judged = calibrate(dynamics(1e-6), [recording], horizon=3)
    assert judged.names == ("x1", "x2")
    known = 60 - dynamics().past  # from where it is known what came before
    assert judged.samples.tolist() == [known, known - 1, known - 2]
    assert float(judged.rmse.max()) < 1e-9
    with pytest.raises(SettingError, match=f"at most {known} steps"):
        calibrate(dynamics(1e-6), [recording], horizon=known + 1)


def test_a_delay_is_kept_like_any_other_past():
    A = torch.tensor([[1.0, DT], [0.0, 1.0]], dtype=torch.float64)
    B = torch.tensor([[0.0], [DT]], dtype=torch.float64)
    cart = KnownModel(lambda x, u: x @ A.mT + u @ B.mT, 2, 1, PLANT.signals)
    delayed = DelayedModel(cart, 1.5)
    pilot = controller(delayed)

    class Delayed(Cart):
        def successor(self, x, u):
            self.queue.append(float(u[0]))
            acting = 0.5 * (self.queue[0] + self.queue[1])
            self.queue.pop(0)
            self.measured = x + DT * np.array([x[1], acting])
            return self.measured

    flown = closed_loop(System(Delayed(), DT), pilot, GOAL, None, 60)
    np.testing.assert_allclose(flown.predicted_means, flown.states[1:], atol=1e-9)
    assert abs(flown.states[-1] - GOAL).max() < 1e-2
    # Names are those of what is measured.
    SavedModel("delayed.safetensors", delayed, delayed.signals).check(PLANT)
    state = torch.tensor([0.2, 0.1], dtype=torch.float64)
    named = Gaussian(state, torch.zeros(2, 2, dtype=torch.float64), ("v", "x"))
    loops = ControlLoop(pilot), ControlLoop(pilot)
    applied = loops[0].input(named, GOAL)
    np.testing.assert_array_equal(applied, loops[1].input([0.1, 0.2], GOAL))
    model_loop = ModelLoop(delayed, Linearization())
    alone = closed_loop(model_loop, pilot, GOAL, Gaussian.certain([0.0, 0.0]), 20)
    np.testing.assert_allclose(alone.states, flown.states[:21], atol=1e-9)

    class Plain:
        state_names = ("x", "v")
        input_names = ("u",)

        def derivative(self, x, u):
            return [x[1], u[0]]

    plant = System(Plain(), DT)
    start = Gaussian.certain([0.0, 0.0])
    trials = closed_loops(plant, pilot, GOAL, start, 5, 3)
    alone = closed_loop(plant, pilot, GOAL, start, 5, seed=2)
    together = trials[2].result
    assert together is not None
    np.testing.assert_allclose(together.states, alone.states, atol=1e-12)


def test_a_reference_beyond_the_log_is_named():
    ranges = np.array([[-2.0, -0.2, -3.0], [2.0, 0.2, 3.0]])
    model = replace(dynamics(), ranges=ranges)
    assert beyond_data(model, GOAL) == []
    (beyond,) = beyond_data(DelayedModel(model, 1), [1.0, 0.5])
    assert beyond.data == (-0.2, 0.2)


def test_models_of_logs_are_compared_by_identity():
    one = dynamics()
    other = dynamics()
    assert one != other
    assert one.model != other.model
    assert one.model in [other.model, one.model]


class Draining(KnownModel):
    """A level, of which the mean of the logarithm is remembered."""

    measured_dim = 1
    past = 30

    def __init__(self):
        def drain(x, u):
            mean = 0.9 * x[..., 1] + 0.1 * torch.log(x[..., 0])
            return torch.stack([x[..., 0] + u[..., 0] - 0.4, mean], dim=-1)

        super().__init__(drain, 2, 1)

    def at_rest(self, measured, input):
        return np.array([measured[0], np.log(measured[0])])

    def follow(self, state, input, measured):
        mean = 0.9 * state[1] + 0.1 * np.log(state[0])
        return np.array([measured[0], mean])


@pytest.mark.parametrize("missing", [3, 4, 9])
def test_a_past_heals_after_a_gap_that_left_the_numbers(missing):
    problem = Problem(Tracking([1.0], [0.1]), Box([0.0], [0.1]))
    settings = PredictionSettings(covariance="none")
    pilot = GPMPC(Draining(), Linearization(), problem, 2, [0.0], settings)
    loop = ControlLoop(pilot)
    with np.errstate(invalid="ignore"):
        for level in (1.0, *[np.nan] * missing, 1.0, 0.9):
            loop.input([level], [1.0])
    assert loop.failures == missing
    assert loop.last is not None
    assert loop.last.state is not None
    assert np.isfinite(loop.last.state).all()
