"""Angles within a turn teach and predict what angles that count turns do."""

import logging

import casadi
import numpy as np
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.estimation import (
    AdaptiveTube,
    ConformalTube,
    estimate_process_noise,
    estimate_varying_noise,
)
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, SlidingWindow, SparseTrainer, Trainer, Transitions
from gpmpc.models import (
    Affine,
    CasadiFunction,
    DelayedModel,
    DisturbedModel,
    KnownModel,
    Lags,
    NoisyModel,
    ResidualModel,
    RollOut,
    train,
)
from gpmpc.propagation import Linearization, MonteCarlo, Unscented
from gpmpc.systems import System

STEP = 0.05
F = torch.float64
IDENTITY = Affine.identity(2, 1)
EXACT = Trainer(restarts=0)


def pendulum(x, u):
    """Angle from upright and rate [rad, rad/s] after a step; the angle counts turns."""
    rate = x[..., 1] + STEP * (9.81 * np.sin(x[..., 0]) - 0.2 * x[..., 1] + u[..., 0])
    return np.stack([x[..., 0] + STEP * rate, rate], axis=-1)


def shown(x, lowest=-np.pi):
    """The states as a sensor shows them whose angles begin at ``lowest``."""
    seen = np.array(x)
    seen[..., 0] = np.mod(seen[..., 0] - lowest, 2 * np.pi) + lowest
    return seen


def flight(start, torque, steps=150, seed=0):
    """States (steps + 1, 2), whose angles count turns, and inputs (steps, 1)."""
    rng = np.random.default_rng(seed)
    states = [np.array(start)]
    inputs = []
    for _ in range(steps):
        inputs.append(rng.uniform(-torque, torque, 1))
        states.append(pendulum(states[-1], inputs[-1]))
    return np.array(states), np.array(inputs)


FLIGHTS = {"hanging": flight([np.pi, 0.0], 4.0), "turning": flight([0.5, 6.0], 6.0)}


def transitions(kind, sensor=shown):
    states, inputs = FLIGHTS[kind]
    seen = sensor(states)
    return Transitions(seen[:-1], inputs, seen[1:])


def wrap(angle):
    """The same angles between -pi and pi."""
    return angle - 2 * np.pi * (angle / (2 * np.pi)).round()


def learned(data, nominal=IDENTITY):
    return ResidualModel.train(nominal, data, angles=[0], trainer=EXACT)


HANGING = learned(transitions("hanging"))


def error(model, kind):
    """Largest error of one step from the states of a flight."""
    states, inputs = FLIGHTS[kind]
    return np.abs(model.predict_mean(states[:-1], inputs) - states[1:]).max()


@pytest.mark.parametrize("kind", ["hanging", "turning"])
@pytest.mark.parametrize(
    "sensor",
    [shown, lambda x: shown(x, 0.0), lambda x: shown(x, -1.0)],
    ids=["-pi to pi", "0 to 2 pi", "-1 to 2 pi - 1"],
)
def test_a_sensor_that_wraps_teaches_what_counted_turns_do(kind, sensor):
    data = transitions(kind, sensor)
    assert error(learned(data), kind) < 1e-4
    assert error(learned(transitions(kind, np.array)), kind) < 1e-4


def test_next_states_may_wrap_where_states_count_turns():
    states, inputs = FLIGHTS["turning"]
    data = Transitions(states[:-1], inputs, shown(states[1:]))
    assert error(learned(data), "turning") < 1e-4


@pytest.mark.parametrize("window", [None, SlidingWindow(150)], ids=["all", "window"])
def test_appended_rows_may_wrap(window):
    wrapping, counting = (
        learned(transitions("hanging", sensor)[:100]).append(
            transitions("hanging", sensor)[100:], window
        )
        for sensor in (shown, np.array)
    )
    assert error(wrapping, "hanging") < 1e-4
    assert torch.allclose(wrapping.residual.targets, counting.residual.targets)


def test_differences_leave_out_turns_of_declared_angles_alone():
    data = transitions("hanging")
    plain = data.targets("difference")
    declared = data.targets("difference", [0])
    assert plain[:, 0].abs().max() > 6.0
    assert declared[:, 0].abs().max() < 1.0
    assert torch.equal(plain[:, 1], declared[:, 1])


def wrapping_pendulum(x, u):
    """The pendulum without damping, in torch, with its angle between -pi and pi."""
    rate = x[..., 1] + STEP * (9.81 * x[..., 0].sin() + u[..., 0])
    angle = x[..., 0] + STEP * rate
    return torch.stack([torch.atan2(angle.sin(), angle.cos()), rate], dim=-1)


def wrapping_in_casadi():
    """The same, as a user's function in CasADi."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    rate = x[1] + STEP * (9.81 * casadi.sin(x[0]) + u)
    angle = x[0] + STEP * rate
    wrapped = casadi.atan2(casadi.sin(angle), casadi.cos(angle))
    return casadi.Function("f", [x, u], [casadi.vertcat(wrapped, rate)])


class Linearizing:
    """A nominal model of the own, with its own derivatives."""

    def __init__(self):
        self.inner = CasadiFunction(wrapping_in_casadi())

    def __call__(self, state, input):
        return self.inner(state, input)

    def linearize(self, states, inputs):
        return self.inner.linearize(states, inputs)


NOMINAL = {
    "none": None,
    "torch": wrapping_pendulum,
    "casadi": CasadiFunction(wrapping_in_casadi()),
    "own derivatives": Linearizing(),
}


@pytest.mark.parametrize("nominal", NOMINAL.values(), ids=NOMINAL)
def test_predictions_do_not_jump_at_half_a_turn(nominal):
    model = learned(transitions("hanging"), nominal)
    angles = torch.linspace(np.pi - 0.3, np.pi + 0.3, 61, dtype=F)
    x = torch.stack([angles, torch.full_like(angles, 1.0)], dim=-1)
    u = torch.zeros(61, 1, dtype=F)
    mean = model.predict(x, u).mean
    assert (mean.diff(dim=0)[:, 0] - 0.01).abs().max() < 0.002
    assert np.allclose(model.linearize(x.numpy(), u.numpy()).mean, mean)
    assert np.allclose(model.predict_mean(x.numpy(), u.numpy()), mean)
    rolled_out = RollOut(model).open_loop(x.numpy(), u.numpy()[:, None])
    assert np.allclose(rolled_out[:, 1], mean)
    turned = torch.tensor([6 * np.pi, 0.0], dtype=F)
    assert torch.allclose(model.predict(x + turned, u).mean - turned, mean, atol=1e-9)
    for propagator in (Linearization(), Unscented(), MonteCarlo(200)):
        belief = Gaussian(x, 0.01 * torch.eye(2, dtype=F).expand(61, 2, 2))
        next_belief = propagator(model, belief, u)
        assert (next_belief.mean - mean).abs().max() < 0.05
        assert next_belief.variance[:, 0].max() < 0.02


def test_a_function_that_counts_turns_stays_itself():
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    counting = CasadiFunction(
        casadi.Function("f", [x, u], [casadi.vertcat(x[0] + STEP * x[1], x[1] + u)])
    )
    assert counting.counting_turns((0,)) is counting
    wrapping = CasadiFunction(wrapping_in_casadi())
    assert wrapping.counting_turns(()) is wrapping
    assert wrapping.counting_turns((1,)) is wrapping
    assert wrapping.counting_turns((0,)) is wrapping.counting_turns((0,))


def test_a_function_wraps_where_it_has_a_value():
    """It has none at a negative height, and wraps on the way up alone."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    turned = x[0] + STEP * casadi.sqrt(x[1])
    wrapped = casadi.atan2(casadi.sin(turned), casadi.cos(turned))
    for angle in (wrapped, casadi.if_else(x[1] > 1.0, wrapped, turned)):
        f = casadi.Function("f", [x, u], [casadi.vertcat(angle, x[1])])
        counting = CasadiFunction(f).counting_turns((0,))
        values, *_ = counting.linearize(np.array([[20.0, 1.5]]), np.zeros((1, 1)))
        assert values[0, 0] == pytest.approx(20.0 + STEP * 1.5**0.5)
    nowhere = casadi.vertcat(wrapped + 0 * casadi.sqrt(-4 - x[1] ** 2), x[1])
    counting = CasadiFunction(casadi.Function("f", [x, u], [nowhere]))
    assert counting.counting_turns((0,)) is not counting


class Turning:
    state_names = ("angle", "rate")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [x[1], u[0]]


def turning(time_step):
    return System(
        Turning(),
        time_step,
        input_lower=[-1.0],
        input_upper=[1.0],
        angles=("angle",),
        rates={"rate": "angle"},
    )


def test_a_position_may_turn_by_half_a_turn_in_a_step():
    rng = np.random.default_rng(0)
    h = 0.1
    states = np.column_stack([rng.uniform(-3, 3, 60), rng.uniform(25.0, 45.0, 60)])
    inputs = rng.uniform(-1, 1, (60, 1))
    rate = states[:, 1] + inputs[:, 0]
    after = np.column_stack([states[:, 0] + h * rate, rate])  # half a turn and more
    data = Transitions(states, inputs, shown(after))
    model = train(data, system=turning(h), restarts=0).posterior
    of_gps = model.B.square() @ model.residual.noise_variance
    assert abs(float(model.noise_covariance[0, 0] - of_gps[0])) < 1e-12
    assert model.B.ravel().tolist() == pytest.approx([h, 1.0])


def test_a_noise_that_varies_is_the_same_a_turn_on():
    rng = np.random.default_rng(0)
    angles = rng.normal(np.pi, 0.4, 150)  # hanging: the seam of a sensor in its middle
    states = shown(np.column_stack([angles, rng.normal(0.0, 1.0, 150)]))
    deviations = 0.02 + 0.3 * np.abs(angles - np.pi)
    after = states.copy()
    after[:, 1] += deviations * rng.normal(size=150)
    rows = Transitions(states, np.zeros((150, 1)), after)
    known = AngleOf(Affine.identity(2, 1), 2, 1)
    one = torch.ones(1, dtype=F)
    some = torch.zeros(1, 4, dtype=F)
    loud = GPPosterior.from_hyperparameters(
        some, some[:, :1] + 3, some + 1, one, 0.1 * one, 1, "value"
    )
    # The noise of a noisy model is learned anew, not on top of itself.
    noisy = NoisyModel(known, loud, [1])
    varying = estimate_varying_noise(noisy, rows, block=5)
    assert varying.outputs == (1,)
    assert varying.model.model is known
    x = torch.tensor([[np.pi - 0.5, 0.0], [np.pi + 0.5, 0.0], [3.2, 0.0]], dtype=F)
    u = torch.zeros(3, 1, dtype=F)
    noise = varying.model.noise(x, u)
    assert (
        noise[:, 1, 1].sqrt() / torch.tensor([0.17, 0.17, 0.04])
    ).log().abs().max() < 1
    for turns in (-1, 1, 3):
        turned = x + torch.tensor([2 * np.pi * turns, 0.0], dtype=F)
        assert torch.allclose(varying.model.noise(turned, u), noise, rtol=1e-6)
        V = varying.model.linearize(turned.numpy(), u.numpy()).covariance
        assert np.allclose(V, noise, rtol=1e-6)


class AngleOf(KnownModel):
    """A known model whose first state is an angle."""

    angles = (0,)


class Wrapping:
    """A model of the own that wraps its angle, and says that it is one."""

    state_dim = 2
    output_dim = 2
    input_dim = 1
    angles = (0,)
    dtype = F
    device = torch.device("cpu")
    noise_covariance = 1e-6 * torch.eye(2).to(F)

    def predict(self, state, input):
        mean = wrapping_pendulum(state, input)
        return Gaussian(mean, mean.new_zeros(*mean.shape, 2))


@pytest.mark.parametrize("propagator", [Unscented(), MonteCarlo(4000)])
def test_points_are_averaged_the_short_way_round(propagator):
    away = torch.tensor([np.pi, 0.0], dtype=F)
    spread = torch.diag(torch.tensor([0.04, 0.01], dtype=F))
    u = torch.zeros(1, dtype=F)
    seam = propagator.propagate(Wrapping(), Gaussian(away, spread), u)
    linear = Linearization()(Wrapping(), Gaussian(away, spread), u)
    assert abs(wrap(seam.belief.mean[0] - np.pi)) < 0.02
    assert torch.allclose(
        seam.belief.covariance, linear.covariance, rtol=0.1, atol=1e-3
    )


def test_wrappers_and_lags_know_the_angles_of_their_model():
    effect = torch.tensor([[0.0], [1.0]], dtype=F)
    disturbed = DisturbedModel(HANGING, effect, [0.1])
    assert list(DelayedModel(disturbed, 2).angles) == [0]
    states, inputs = FLIGHTS["hanging"]
    lags = Lags(state_dim=2, input_dim=1, states=1)
    seen = lags.transitions(shown(states), inputs)
    model = ResidualModel.train(
        lags.nominal, seen, lags.B, angles=[0, 2], trainer=EXACT
    )
    whole = lags.augmented(states, inputs)
    missed = model.predict_mean(whole[:-1], inputs[1:]) - whole[1:]
    assert np.abs(missed).max() < 1e-3


@pytest.mark.parametrize(
    "train",
    [
        lambda data: ResidualModel.train(IDENTITY, data, trainer=EXACT),
        lambda data: EXACT(data),
        lambda data: Trainer(predicts="difference", restarts=0)(data),
        lambda data: EXACT.refit(
            EXACT(transitions("hanging", np.array)).posterior, data
        ),
        lambda data: SparseTrainer(inducing=10, subset=40, iterations=1)(data),
    ],
    ids=["residual", "next state", "difference", "refit", "sparse"],
)
def test_training_names_an_undeclared_angle_once(train, caplog):
    with caplog.at_level(logging.WARNING, "gpmpc"):
        train(transitions("hanging"))
    warnings = [
        r.getMessage() for r in caplog.records if "whole turns" in r.getMessage()
    ]
    assert len(warnings) == 1
    assert (
        "column 1 of the states jumps by whole turns (2 pi) in 9 of 150" in warnings[0]
    )
    assert "angles=[0]" in warnings[0]


class WouldTrain(Exception):
    """All that is said before a training was said."""


class NoTrainer:
    """Looks at the data, and learns nothing."""

    def fit(self, **data):
        raise WouldTrain


def warned(states, next_states, caplog, angles=()):
    """What is said of whole turns before a training."""
    data = Transitions(states, np.zeros((len(states), 1)), next_states)
    nominal = Affine.identity(states.shape[1], 1)
    with caplog.at_level(logging.WARNING, "gpmpc"), pytest.raises(WouldTrain):
        ResidualModel.train(nominal, data, angles=angles, trainer=NoTrainer())
    messages = [record.getMessage() for record in caplog.records]
    caplog.clear()
    return "\n".join(message for message in messages if "whole turns" in message)


def test_declared_angles_and_those_that_count_turns_are_no_news(caplog):
    for kind, (states, _) in FLIGHTS.items():
        seen = shown(states)
        assert warned(states[:-1], states[1:], caplog) == "", kind
        assert warned(seen[:-1], seen[1:], caplog, [0]) == "", kind
        assert "column 1" in warned(seen[:-1], seen[1:], caplog), kind


def test_degrees_and_next_states_alone_that_wrap_are_named(caplog):
    states = FLIGHTS["turning"][0][:, :1]
    slow = 0.3 * states
    degrees = np.degrees(wrap(slow))
    assert "by whole turns (360)" in warned(degrees[:-1], degrees[1:], caplog)
    assert "by whole turns (2 pi)" in warned(slow[:-1], wrap(slow[1:]), caplog)
    both = np.column_stack([wrap(slow), states, wrap(slow + 1.0)])
    assert "column 1" in (text := warned(both[:-1], both[1:], caplog))
    assert "column 3" in text
    assert "column 2" not in text


@pytest.mark.parametrize(
    "steps",
    [
        lambda rng: rng.normal(0, 3, 300),
        lambda rng: np.full(300, 2 * np.pi),
        lambda rng: rng.choice(
            [0.01, -0.02, 6.0, -6.0], 300, p=[0.48, 0.48, 0.02, 0.02]
        ),
        lambda rng: np.where(np.arange(300) % 50, 0.0, 25.0) + rng.normal(0, 0.02, 300),
        lambda rng: 0.05 * rng.standard_cauchy(300),
        lambda rng: np.where(np.arange(300) % 30, 0.1, -2.9),
        lambda rng: np.where(np.arange(300) % 90, 0.1, -8.9),
        lambda rng: rng.uniform(0, 9, 300),
        lambda rng: np.zeros(300),
    ],
    ids=[
        "walk",
        "whole turns always",
        "jumps of 6",
        "jumps of 25",
        "heavy tails",
        "sawtooth of 3",
        "sawtooth of 9",
        "only upwards",
        "still",
    ],
)
def test_honest_large_steps_are_no_turns(steps, caplog):
    for seed in range(5):
        x = np.cumsum(steps(np.random.default_rng(seed)))[:, None]
        assert warned(x[:-1], x[1:], caplog) == ""


def test_a_calibration_counts_no_turn_as_an_error():
    states, inputs = FLIGHTS["hanging"]
    counting, wrapping = (
        calibrate(HANGING, Recording(sensor(states), inputs), horizon=3)
        for sensor in (np.array, shown)
    )
    assert torch.allclose(counting.rmse, wrapping.rmse, atol=1e-9)
    assert wrapping.rmse.max() < 1e-2
    assert torch.equal(counting.coverage, wrapping.coverage)
    plain = Trainer(predicts="difference", restarts=0)(transitions("hanging", np.array))
    seen = Recording(shown(states, 0.0) - 2 * np.pi, inputs)
    off, right = (
        calibrate(plain.posterior, seen, horizon=1, angles=angles).rmse
        for angles in ((), [0])
    )
    assert off[0, 0] >= right[0, 0]


def test_process_noise_is_that_of_the_motion_and_ordered_in_time():
    rng, (states, inputs) = np.random.default_rng(0), FLIGHTS["hanging"]
    noisy = states + rng.normal(0, [1e-3, 1e-2], states.shape)
    results = []
    for sensor in (np.array, shown):
        seen = sensor(noisy)
        results.append(
            estimate_process_noise(HANGING, Transitions(seen[:-1], inputs, seen[1:]))
        )
    assert torch.allclose(results[0].variance, results[1].variance, rtol=1e-6)
    assert torch.allclose(results[0].correlation, results[1].correlation, rtol=1e-6)


def test_tubes_hold_across_the_seam():
    states, inputs = FLIGHTS["hanging"]
    model = HANGING
    tubes = [
        ConformalTube.calibrate(
            model, Linearization(process_noise=True), sensor(states), inputs, 5
        )
        for sensor in (np.array, shown)
    ]
    assert np.allclose(tubes[0].scores, tubes[1].scores, rtol=1e-4)
    adaptive = [AdaptiveTube(tube, 0.8) for tube in tubes]
    covariances = np.tile(1e-4 * np.eye(2), (6, 1, 1))
    for k in range(len(states) - 6):
        plan = states[k : k + 6]
        for tube, sensor in zip(adaptive, (np.array, shown), strict=True):
            tube.observe(sensor(states[k]))
            turns = sensor(states[k]) - states[k]  # a plan counts them from there
            tube.remember(plan + turns, covariances)
    assert np.allclose(adaptive[0].misses, adaptive[1].misses)
    assert adaptive[1].misses.sum() == 0
