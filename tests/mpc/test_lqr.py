"""Linear-quadratic tracking against least squares, Riccati and its own bounds."""

import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.models import linearize_by_autograd
from gpmpc.mpc import Box, NonlinearGPMPC, Problem, Reference, Tracking, dlqr
from gpmpc.mpc.baselines import LQR
from gpmpc.propagation import MeanEquivalence
from gpmpc.status import Status
from tests.mpc.small_models import LinearGaussian, double_integrator, pendulum_posterior

A = np.array([[1.0, 0.5], [0.0, 1.0]])
B = np.array([[0.125], [0.5]])
Q = np.array([[3.0, 0.4], [0.4, 0.5]])
R = np.array([[0.2]])


@pytest.mark.parametrize("penalized", ["inputs", "deviations", "increments"])
def test_without_bounds_it_is_the_optimum_of_a_linear_model(penalized, rng):
    H = 6
    model = double_integrator(c=[0.1, -0.2])
    problem = Problem(Tracking(Q, R, terminal=3 * Q, penalized=penalized))
    reference = Reference(rng.normal(size=(H + 1, 2)), rng.normal(size=(H, 1)))
    state = Gaussian.certain(rng.normal(size=2))
    ours = LQR(model, problem, H, [0.3]).control(state, reference)
    best = NonlinearGPMPC(
        model, MeanEquivalence(), problem, H, [0.3], tolerance=1e-9
    ).control(state, reference)
    assert ours.status is Status.SOLVED
    assert np.allclose(ours.inputs, best.inputs, atol=1e-8)
    assert np.allclose(ours.means, best.means, atol=1e-8)
    assert ours.covariances.shape == (H + 1, 2, 2)


def test_the_stationary_gain_solves_the_riccati_equation():
    K = dlqr(A, B, Q, R)
    closed_loop = A - B @ K
    P = sum(
        np.linalg.matrix_power(closed_loop.T, i)
        @ (Q + K.T @ R @ K)
        @ np.linalg.matrix_power(closed_loop, i)
        for i in range(400)
    )
    assert np.abs(np.linalg.eigvals(closed_loop)).max() < 1
    assert np.allclose(
        P,
        Q + A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A),
        rtol=1e-10,
    )


def test_a_long_horizon_gives_the_stationary_gain(rng):
    controller = LQR(
        double_integrator(), Problem(Tracking(Q, R, penalized="inputs")), 60, [0.0]
    )
    state = rng.normal(size=2)
    decision = controller.control(Gaussian.certain(state), Reference(np.zeros((61, 2))))
    assert np.allclose(decision.input, -dlqr(A, B, Q, R) @ state, atol=1e-9)


def test_an_unweighted_mode_of_modulus_one_uses_the_recursion():
    K = dlqr(
        np.diag([1.0, 0.5]), np.array([[0.0], [1.0]]), np.diag([0.0, 1.0]), np.eye(1)
    )
    assert K[0, 0] == pytest.approx(0, abs=1e-12)
    assert K[0, 1] == pytest.approx(dlqr([[0.5]], [[1.0]], [[1.0]], [[1.0]])[0, 0])


def test_a_growing_mode_out_of_reach_has_no_gain():
    with pytest.raises(SettingError, match="do not reach a growing mode"):
        dlqr(np.diag([1.2, 0.5]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))


def test_reference_inputs_feed_forward():
    H = 5
    model = double_integrator()
    states = [np.array([0.2, -0.1])]
    inputs = np.array([[0.3], [0.1], [-0.4], [0.2], [0.0]])
    for u in inputs:
        states.append(A @ states[-1] + B @ u)
    controller = LQR(model, Problem(Tracking(Q, R, penalized="deviations")), H, [0.0])
    decision = controller.control(
        Gaussian.certain(states[0]), Reference(np.array(states), inputs)
    )
    assert np.allclose(decision.inputs, inputs, atol=1e-10)


def test_inputs_are_clipped_to_the_box_and_the_rates():
    bounds = {"inputs": Box([-0.5], [0.4]), "input_rates": Box([-0.3], [0.3])}
    controller = LQR(
        double_integrator(),
        Problem(Tracking(Q, R, penalized="inputs"), **bounds),
        6,
        [0.0],
    )
    decision = controller.control(
        Gaussian.certain(np.array([-3.0, 0.0])), Reference(np.zeros((7, 2)))
    )
    rates = np.diff(decision.inputs[:, 0], prepend=0.0)
    assert rates[0] == pytest.approx(0.3)
    assert decision.inputs.max() == pytest.approx(0.4)
    assert np.abs(rates).max() <= 0.3 + 1e-12
    assert np.allclose(decision.means[1], A @ [-3.0, 0.0] + B @ decision.input)


def test_an_input_without_effect_stays_at_rest():
    model = LinearGaussian(A.tolist(), [[0.125, 0.0], [0.5, 0.0]])
    controller = LQR(
        model, Problem(Tracking(Q, [1e-3, 1e-3], penalized="inputs")), 3, [0.0, 0.0]
    )
    decision = controller.control(
        Gaussian.certain(np.array([1.0, 0.0])), Reference(np.zeros((4, 2)))
    )
    assert np.allclose(decision.inputs[:, 1], 0)


def test_it_brings_a_learned_pendulum_to_rest():
    model = pendulum_posterior()
    state = np.array([0.8, 0.0])
    decision = None
    controller = LQR(
        model,
        Problem(
            Tracking([5.0, 0.5], [0.05], penalized="inputs"), inputs=Box([-4.0], [4.0])
        ),
        15,
        [0.0],
    )
    for _ in range(40):
        decision = controller.control(
            Gaussian.certain(state), Reference(np.zeros((16, 2))), decision
        )
        acceleration = -4 * np.sin(state[0]) - 0.3 * state[1] + decision.input[0]
        state = state + np.array(
            [0.2 * state[1] + 0.02 * acceleration, 0.2 * acceleration]
        )
    assert np.abs(state).max() < 0.02


def test_a_bad_measurement_is_said_so_and_misuse_is_refused():
    controller = LQR(
        double_integrator(), Problem(Tracking(Q, R, penalized="inputs")), 3, [0.2]
    )
    decision = controller.control(
        Gaussian.certain(np.array([np.nan, 0.0])), Reference(np.zeros((4, 2)))
    )
    assert decision.status is Status.INVALID_MEASUREMENT
    assert np.array_equal(decision.inputs, np.full((3, 1), 0.2))
    with pytest.raises(ShapeError, match=r"shapes \(2,\) and \(4, 2\)"):
        controller.control(Gaussian.certain(np.zeros(2)), Reference(np.zeros((3, 2))))
    with pytest.raises(
        SettingError, match="must weigh 2 states and 1 inputs; got 2 and 2"
    ):
        LQR(
            double_integrator(),
            Problem(Tracking(Q, [1.0, 1.0], penalized="inputs")),
            3,
            [0.2],
        )


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_no_input_leaves_the_box_where_rates_contradict_it(side, rng):
    """The input before was far outside; the rates alone would keep the next there."""
    problem = Problem(
        Tracking(Q, R), inputs=Box([-0.5], [0.4]), input_rates=Box([-0.1], [0.1])
    )
    controller = LQR(double_integrator(), problem, 5, [side * 3.0])
    for _ in range(20):
        decision = controller.control(
            Gaussian.certain(rng.normal(size=2)),
            Reference(rng.normal(size=(6, 2))),
            None,
        )
        assert decision.inputs.min() >= -0.5
        assert decision.inputs.max() <= 0.4
        assert decision.input[0] == (0.4 if side > 0 else -0.5)
        assert np.abs(np.diff(decision.inputs[:, 0])).max() <= 0.1 + 1e-12


class Watched(LinearGaussian):
    """Keeps where it was linearised; its Jacobian by the state may be damaged."""

    def __init__(self, *arguments, factor=1.0):
        super().__init__(*arguments)
        self.factor = factor

    def linearize(self, states, inputs, covariance=True):
        self.seen = states, inputs
        at = linearize_by_autograd(self, states, inputs, covariance)
        return at._replace(
            A=at.A * self.factor if np.isfinite(self.factor) else at.A + self.factor
        )


@pytest.mark.parametrize(
    "known", [True, False], ids=["reference inputs", "no reference inputs"]
)
def test_local_models_are_at_the_state_then_at_the_reference(known, rng):
    model = Watched(A.tolist(), B.tolist())
    H = 4
    states = rng.normal(size=(H + 1, 2))
    reference_inputs = rng.normal(size=(H, 1))
    state = rng.normal(size=2)
    reference = Reference(states, reference_inputs if known else None)
    LQR(model, Problem(Tracking(Q, R, penalized="inputs")), H, [0.3]).control(
        Gaussian.certain(state), reference
    )
    assert np.array_equal(model.seen[0], np.vstack([state, states[1:-1]]))
    assert np.array_equal(
        model.seen[1], reference_inputs if known else np.full((H, 1), 0.3)
    )


@pytest.mark.parametrize("factor", [np.nan, np.inf, 1e250])
def test_a_non_finite_or_exploding_model_is_numerical_trouble(factor):
    controller = LQR(
        Watched(A.tolist(), B.tolist(), factor=factor),
        Problem(Tracking(Q, R, penalized="inputs")),
        4,
        [0.2],
    )
    decision = controller.control(
        Gaussian.certain(np.ones(2)), Reference(np.zeros((5, 2)))
    )
    assert decision.status is Status.NUMERICAL_TROUBLE
    assert np.array_equal(decision.inputs, np.full((4, 1), 0.2))


def test_a_model_that_raises_is_numerical_trouble():
    class Raising(Watched):
        def linearize(self, states, inputs, covariance=True):
            raise DataError("no data out there")

    model = Raising(A.tolist(), B.tolist())
    controller = LQR(model, Problem(Tracking(Q, R, penalized="inputs")), 4, [0.2])
    decision = controller.control(
        Gaussian.certain(np.ones(2)), Reference(np.zeros((5, 2)))
    )
    assert decision.status is Status.NUMERICAL_TROUBLE


def test_a_state_that_requires_gradients_is_like_any_other():
    controller = LQR(
        double_integrator(), Problem(Tracking(Q, R, penalized="inputs")), 3, [0.2]
    )
    reference = Reference(np.zeros((4, 2)))
    state = torch.tensor([0.3, -0.2], requires_grad=True)
    ours = controller.control(Gaussian(2 * state, torch.zeros(2, 2)), reference)
    assert np.array_equal(
        ours.inputs, controller.control(Gaussian.certain([0.6, -0.4]), reference).inputs
    )


@pytest.mark.parametrize(
    ("Q", "R", "message"),
    [
        (0.0, 1.0, "Q does not weigh a growing mode"),
        (-1.0, 1.0, "Q: must be positive semidefinite"),
        (1.0, 0.0, "R: must be positive definite"),
    ],
)
def test_a_stationary_gain_says_what_it_lacks(Q, R, message):
    with pytest.raises(SettingError, match=message):
        dlqr(np.array([[1.2]]), np.eye(1), Q * np.eye(1), R * np.eye(1))
    with pytest.raises(SettingError, match="the inputs do not reach a growing mode"):
        dlqr(np.array([[1.2]]), np.zeros((1, 1)), np.eye(1), np.eye(1))
