"""What the model mispredicts for good is estimated, and leaves no offset between
reference and state."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import backend
from gpmpc.models import CasadiFunction, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc.baselines import StateFormMPC
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.status import Status
from tests.mpc.small_models import double_integrator, pendulum_posterior

H = 8
PENDULUM = pendulum_posterior()
PROBLEM = Problem(Tracking([10.0, 1.0], [0.1]), inputs=Box([-6.0], [6.0]))
AT_REST = Reference(np.tile([0.4, 0.0], (H + 1, 1)), np.zeros((H, 1)))
UNKNOWN = np.array(
    [0.0, 0.08]
)  # what the plant does that its model does not say [rad, rad/s]


def controller(kind=GPMPC, model=PENDULUM, propagator=None, **settings):
    iterated = (
        {"iterations": settings.pop("iterations")} if "iterations" in settings else {}
    )
    return kind(
        model,
        propagator or Linearization(),
        PROBLEM,
        H,
        [0.0],
        PredictionSettings(**settings),
        **iterated,
    )


def next_state(model, state, input, unknown=UNKNOWN):
    return (
        model.predict(torch.tensor(state), torch.tensor(input)).mean.numpy() + unknown
    )


def flown(mpc, model=PENDULUM, unknown=UNKNOWN, steps=40):
    """States and decisions; the plant is the model and what it does not know."""
    states = [np.zeros(2)]
    decisions = []
    last = None
    for _ in range(steps):
        last = mpc.control(Gaussian.certain(states[-1]), AT_REST, last)
        assert last.status is Status.SOLVED
        decisions.append(last)
        states.append(next_state(model, states[-1], last.input, unknown))
    return np.array(states), decisions


@pytest.mark.parametrize(
    "settings",
    [
        {"form": "velocity", "covariance": "none"},
        {"disturbance_gain": 1.0},
        {"disturbance_gain": 0.5, "covariance": "none"},
        {"disturbance_gain": 0.5, "covariance": "none", "iterations": 30},
        {"disturbance_gain": 0.5, "covariance": "full", "propagator": MomentMatching()},
        {"disturbance_gain": 0.5, "covariance": "diagonal"},
    ],
    ids=lambda settings: " ".join(settings),
)
def test_a_constant_error_leaves_no_offset(settings):
    states, decisions = flown(controller(**settings))
    exact = settings.get("covariance") not in (
        "full",
        "diagonal",
    )  # these weigh the covariance as well
    assert abs(states[-1, 0] - 0.4) < (1e-4 if exact else 2e-3)
    if "disturbance_gain" in settings:
        assert np.allclose(decisions[-1].disturbance, UNKNOWN, rtol=0, atol=1e-4)


def test_without_an_estimate_it_does():
    states, decisions = flown(controller())
    assert abs(states[-1, 0] - 0.4) > 0.04
    assert decisions[-1].disturbance is None


def test_a_model_that_is_right_is_left_alone():
    plain = flown(controller(), unknown=0.0)
    corrected = flown(controller(disturbance_gain=1.0), unknown=0.0)
    assert np.allclose(plain[0], corrected[0], rtol=0, atol=1e-9)
    assert np.abs([decision.disturbance for decision in corrected[1]]).max() < 1e-12


def test_the_estimate_moves_by_its_gain_towards_the_last_error():
    mpc = controller(disturbance_gain=0.3)
    _, decisions = flown(mpc, steps=6)
    estimates = [decision.disturbance for decision in decisions]
    assert np.allclose(
        estimates, [(1 - 0.7**k) * UNKNOWN for k in range(6)], rtol=0, atol=1e-12
    )


def test_what_was_applied_counts_and_not_what_was_planned():
    mpc = controller(disturbance_gain=1.0)
    last = mpc.control(Gaussian.certain(np.zeros(2)), AT_REST)
    applied = replace(last, input=np.array([1.5]))
    now = mpc.control(
        Gaussian.certain(next_state(PENDULUM, np.zeros(2), applied.input)),
        AT_REST,
        applied,
    )
    assert np.allclose(now.disturbance, UNKNOWN, rtol=0, atol=1e-12)


def test_a_missing_measurement_leaves_the_estimate_unchanged():
    mpc = controller(disturbance_gain=1.0)
    states, _ = flown(mpc, steps=5)
    loop = ControlLoop(mpc)
    loop.input(states[-1], AT_REST)
    loop.last = replace(loop.last, plan=replace(loop.last.plan, disturbance=UNKNOWN))
    loop.input(np.full(2, np.nan), AT_REST)
    blind = loop.last
    assert blind.status is Status.INVALID_MEASUREMENT
    assert np.array_equal(blind.plan.disturbance, UNKNOWN)


@pytest.mark.parametrize("covariance", ["zero_order", "none"])
def test_compiled_torch_batched_and_state_form_agree(covariance):
    mpc = controller(covariance=covariance, disturbance_gain=0.7)
    states, decisions = flown(mpc, steps=4)
    belief = Gaussian.certain(states[-1])
    before = decisions[-1]
    answer = mpc.control(belief, AT_REST, before)
    in_cvxpy = controller(StateFormMPC, covariance=covariance, disturbance_gain=0.7)
    others = [in_cvxpy.control(belief, AT_REST, before)]
    with backend("torch"):
        others += [
            mpc.control(belief, AT_REST, before),
            *mpc.control_many([belief], [AT_REST], [before]),
        ]
    for other, tolerance in zip(others, (1e-6, 1e-9, 1e-9), strict=True):
        assert np.allclose(other.disturbance, answer.disturbance, rtol=0, atol=1e-12)
        assert np.allclose(other.inputs, answer.inputs, rtol=0, atol=tolerance)
        assert np.allclose(other.means, answer.means, rtol=0, atol=tolerance)


def test_any_model_can_be_wrong():
    model = double_integrator()
    states, decisions = flown(controller(model=model, disturbance_gain=0.5), model)
    assert abs(states[-1, 0] - 0.4) < 1e-4
    assert np.allclose(decisions[-1].disturbance, UNKNOWN, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        ({"disturbance_gain": 1.2}, "lie between 0 and 1; got 1.2"),
        ({"disturbance_gain": -0.1}, "got -0.1"),
        (
            {"disturbance_gain": 0.5, "form": "velocity"},
            "be 0 for form 'velocity', which needs none; got 0.5",
        ),
    ],
)
@pytest.mark.parametrize("kind", [GPMPC, StateFormMPC])
def test_a_gain_out_of_range_is_refused(kind, settings, rule):
    with pytest.raises(SettingError, match=rule):
        controller(kind, **settings)


@pytest.mark.parametrize("iterations", [1, 30])
def test_with_model_gives_the_controller_made_with_that_model(iterations):
    other = pendulum_posterior(seed=3)
    inputs = 2.0 * np.ones((H, 1))
    mpc = controller(
        covariance="none", rolled_out=True, iterations=iterations
    ).with_model(other)
    mpc_of_other = controller(
        model=other, covariance="none", rolled_out=True, iterations=iterations
    )
    belief = Gaussian.certain([0.3, -0.2])
    decision = mpc.control(belief, AT_REST, plan=inputs)
    expected = mpc_of_other.control(belief, AT_REST, plan=inputs)
    assert np.array_equal(decision.means, expected.means)
    assert np.array_equal(decision.inputs, expected.inputs)


class TurningModel(KnownModel):
    """A pendulum whose model says that its first state is an angle."""

    angles = (0,)


def turning_model():
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    after = casadi.vertcat(x[0] + 0.1 * x[1], x[1] - 0.4 * casadi.sin(x[0]) + 0.1 * u)
    return TurningModel(CasadiFunction(casadi.Function("f", [x, u], [after])), 2, 1)


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_a_sensor_may_take_a_turn_off_an_angle_of_the_model(gain):
    problem = Problem(Tracking([0.0, 1.0], [0.1]), inputs=Box([-6.0], [6.0]))
    settings = PredictionSettings(covariance="none", disturbance_gain=gain)
    steering = GPMPC(
        turning_model(), Linearization(), problem, H, [0.0], settings, iterations=1
    )
    reference = Reference(np.array([0.0, 2.0]))
    last = steering.control(Gaussian.certain(np.array([3.0, 2.0])), reference)
    state = last.means[1] + 0.01
    turned = state - [2.0 * np.pi, 0.0]
    expected = steering.control(Gaussian.certain(state), reference, last)
    decision = steering.control(Gaussian.certain(turned), reference, last)
    assert np.allclose(decision.inputs, expected.inputs, rtol=0, atol=1e-9)


def test_an_estimate_outlives_a_plan_that_cannot_be_gone_on_from():
    """As where a search flies the controller on from a state of its model."""
    mpc = controller(disturbance_gain=0.5)
    at = Gaussian.certain(np.array([0.4, 0.0]))
    decision = mpc.control(at, AT_REST)
    lost = replace(
        decision,
        status=Status.INFEASIBLE,
        suboptimal=False,
        disturbance=np.array([0.0, 0.08]),
    )
    again = mpc.control(at, AT_REST, lost)
    np.testing.assert_allclose(again.disturbance, [0.0, 0.08], atol=1e-12)


def test_an_estimate_outlives_a_gap_without_a_loop():
    mpc = controller(disturbance_gain=0.5)
    states, decisions = flown(mpc, steps=5)
    unmeasured = Gaussian.certain(np.full(2, np.nan))
    blind = mpc.control(unmeasured, AT_REST, decisions[-1])
    assert blind.status is Status.INVALID_MEASUREMENT
    assert np.array_equal(blind.disturbance, decisions[-1].disturbance)
    again = mpc.control(Gaussian.certain(states[-1]), AT_REST, blind)
    assert np.array_equal(again.disturbance, decisions[-1].disturbance)


@pytest.mark.parametrize(
    ("settings", "missing"),
    [
        ({"disturbance_gain": 0.3}, 1),
        ({"disturbance_gain": 0.3}, 4),
        ({"form": "velocity"}, 1),
        ({"form": "velocity"}, 4),
    ],
)
def test_a_gap_teaches_the_mean_error_of_its_steps(settings, missing):
    """An integrator that is pushed from just before the gap on."""
    pushed = 0.1
    integrator = KnownModel(lambda x, u: x + u, 1, 1)
    steering = GPMPC(
        integrator,
        Linearization(),
        Problem(Tracking([1.0], [0.1]), Box([-2.0], [2.0])),
        H,
        [0.0],
        PredictionSettings(covariance="none", **settings),
    )
    loop = ControlLoop(steering)
    state = np.zeros(1)
    loop.input(state, [0.0])
    for k in range(missing + 1):
        state = state + loop.last.input + pushed
        is_missing = k < missing
        loop.input([np.nan] if is_missing else state, [0.0])
    decision = loop.last.decision
    learned = decision.means[1] - decision.means[0] - decision.inputs[0]
    gain = settings.get("disturbance_gain", 1.0)
    assert learned == pytest.approx(gain * pushed)


def test_a_plan_that_is_used_up_teaches_nothing():
    """Nor does one beside which an input was held."""
    integrator = KnownModel(lambda x, u: x + u, 1, 1)
    problem = Problem(Tracking([1.0], [0.1]), Box([-2.0], [2.0]))
    settings = PredictionSettings(covariance="none", disturbance_gain=0.3)
    steering = GPMPC(integrator, Linearization(), problem, H, [0.0], settings)
    for on_failure, missing in (("previous_plan", H), ("hold", 2)):
        loop = ControlLoop(steering, on_failure)
        for state in ([1.0], *[[np.nan]] * missing, [5.0]):
            loop.input(state, [0.0])
        assert loop.last.decision.disturbance == pytest.approx(0.0)
