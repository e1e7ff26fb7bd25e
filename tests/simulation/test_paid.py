"""What a flight has cost is what its plans predicted, where the model is exact."""

import numpy as np
import pytest

from gpmpc.exceptions import SettingError
from gpmpc.mpc import Decision, Timing, Tracking
from gpmpc.simulation import closed_loop
from gpmpc.status import Status
from gpmpc.systems import System

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.005], [0.1]])
START = np.array([1.0, 0.0])
AT_REST = np.zeros(1)


class Cart:
    """A mass that a force moves, sampled every 0.1 s."""

    state_names = ("position", "speed")
    input_names = ("force",)

    def successor(self, x, u):
        return list(A @ x + B @ u)


def riccati(cost):
    """Returns the value P (2, 2) and the gain (1, 2) of the optimal regulator."""
    P = cost.Q
    for _ in range(2000):
        gain = np.linalg.solve(cost.R + B.T @ P @ B, B.T @ P @ A)
        P = cost.Q + A.T @ P @ (A - B @ gain)
    return P, gain


class Regulator:
    """A gain on the state."""

    horizon = 1

    def __init__(self, gain):
        self.gain = gain

    def control(self, belief, reference, previous=None):
        state = belief.mean.numpy()
        input = -self.gain @ state
        means = np.vstack([state, A @ state + B @ input])
        return Decision(
            input=input,
            inputs=input[None],
            means=means,
            covariances=np.zeros((2, 2, 2)),
            status=Status.SOLVED,
            iterations=1,
            timing=Timing(),
        )


def fly(cost, steps=400):
    _, gain = riccati(cost)
    plant = System(Cart(), time_step=0.1)
    references = np.zeros((steps + 1, 2))
    return closed_loop(plant, Regulator(gain), references, START, steps=steps)


def test_an_optimal_regulator_pays_its_riccati_value():
    cost = Tracking(Q=[1.0, 0.1], R=[0.5], penalized="inputs")
    paid = fly(cost).paid(cost, AT_REST).sum()
    P, _ = riccati(cost)
    value = START @ (P - cost.Q) @ START  # x[0] itself is not paid
    assert paid == pytest.approx(value, rel=1e-9)


def test_increments_count_from_the_input_before():
    flight = fly(Tracking(Q=[1.0, 0.1], R=[0.5], penalized="inputs"), steps=5)
    increments = np.diff(flight.inputs[:, 0], prepend=0.3)
    cost = Tracking(Q=[0.0, 0.0], R=[2.0], penalized="increments")
    assert np.allclose(flight.paid(cost, np.array([0.3])), 2 * increments**2)


def test_an_angle_is_paid_within_half_a_turn():
    cost = Tracking(Q=[1.0, 0.0], R=[1.0], penalized="inputs", angles=[0])
    states = np.array([[0.0, 0.0], [2 * np.pi + 0.1, 0.0]])
    paid = cost.paid(states, np.zeros((1, 1)), np.zeros((2, 2)), AT_REST)
    assert paid[0] == pytest.approx(0.01)


def test_deviations_need_what_they_deviate_from():
    cost = Tracking(Q=[1.0, 0.1], R=[0.5], penalized="deviations")
    states = np.zeros((2, 2))
    inputs = np.ones((1, 1))
    assert cost.paid(states, inputs, states, AT_REST, inputs - 2)[0] == 2.0
    with pytest.raises(SettingError, match="reference_inputs: must be handed over"):
        cost.paid(states, inputs, states, AT_REST)
