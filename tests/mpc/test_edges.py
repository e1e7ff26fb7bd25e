"""Questions at the edge of what a controller is asked."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.models import KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Halfspaces,
    PredictionSettings,
    Problem,
    Reference,
    Request,
    Tracking,
)
from gpmpc.propagation import Linearization
from gpmpc.status import Status

H = 6


def cart_step(x, u):
    position, rate = x.unbind(-1)
    return torch.stack([position + 0.1 * rate, rate + 0.1 * u.sum(-1)], dim=-1)


def cart(problem, inputs=1, horizon=H):
    return GPMPC(
        KnownModel(cart_step, 2, inputs),
        Linearization(),
        problem,
        horizon,
        [0.0] * inputs,
        PredictionSettings(covariance="none"),
    )


def at(*state):
    return Gaussian.certain(np.array(state, dtype=float))


def tracking(inputs=1, **settings):
    return Tracking([1.0, 0.1], [0.01] * inputs, penalized="inputs", **settings)


def test_a_decision_of_another_number_of_inputs_is_refused():
    one = cart(Problem(tracking())).control(at(1.0, 0.0), Reference(np.zeros(2)))
    with pytest.raises(ShapeError, match=r"input of the last decision .* \(2,\)"):
        cart(Problem(tracking(inputs=2)), inputs=2).control(
            at(1.0, 0.0), Reference(np.zeros(2)), one
        )


def test_a_decision_of_another_number_of_states_is_no_plan():
    controller = cart(Problem(tracking()))
    question = at(1.0, 0.0), Reference(np.zeros(2))
    decision = controller.control(*question)
    widened = replace(decision, means=np.zeros((H + 1, 5)))
    again = controller.control(*question, widened)
    np.testing.assert_allclose(again.inputs, decision.inputs, atol=1e-9)


@pytest.mark.parametrize("bound", [[0.2], np.full((H, 1), 0.2)])
def test_halfspaces_of_some_stages_hold_there_alone(bound):
    rail = Halfspaces([[1.0, 0.0]], bound, stages=range(3, 5), penalty=None)
    problem = Problem(tracking(), constraints=[rail])
    decision = cart(problem).control(at(0.0, 0.0), Reference(np.array([2.0, 0.0])))
    assert decision.status is Status.SOLVED
    assert decision.means[3:5, 0].max() == pytest.approx(0.2, abs=1e-7)
    assert decision.means[6, 0] > 0.25


def test_a_bound_of_no_side_bounds_nothing():
    nothing = Box([-np.inf] * 2, [np.inf] * 2, probability=0.95, joint=True)
    question = at(1.0, 0.0), Reference(np.zeros(2))
    free = cart(Problem(tracking())).control(*question)
    bounded = cart(Problem(tracking(), constraints=[nothing])).control(*question)
    np.testing.assert_allclose(bounded.inputs, free.inputs, atol=1e-9)


def test_an_elastic_bound_counts_where_no_state_is_weighed():
    cost = Tracking([0.0, 0.0], [0.01], penalized="inputs")
    side = Box([-np.inf] * 2, [0.5, np.inf])
    controller = cart(Problem(cost, Box([-1.0], [1.0]), constraints=[side]))
    decision = controller.control(at(1.0, 0.0), Reference(np.zeros(2)))
    assert decision.status is Status.SOFT_BOUND_MISSED
    assert decision.input[0] < -0.05


def test_a_reference_of_many_turns_has_no_jump_of_a_turn():
    problem = Problem(tracking(angles=[0]))
    angles = 0.3 * np.arange(21)
    reference = Reference(np.stack([angles + 4 * np.pi, np.zeros(21)], axis=1))
    request = Request.read(
        problem=problem,
        horizon=20,
        initial_input=np.zeros(1),
        belief=at(0.0, 0.0),
        reference=reference,
        previous=None,
    )
    np.testing.assert_allclose(request.references.states[:, 0], angles[1:], atol=1e-9)


def test_a_plan_that_goes_on_keeps_the_tighter_bound_of_now():
    """Inputs may be larger later on; a plan's second input is applied as the first."""
    bounds = Box(
        np.array([[-0.5]] + [[-2.0]] * (H - 1)), np.array([[0.5]] + [[2.0]] * (H - 1))
    )
    loop = ControlLoop(cart(Problem(tracking(), bounds)))
    target = np.array([5.0, 0.0])
    first = loop.input(np.array([0.0, 0.0]), Reference(target))
    assert first == pytest.approx([0.5])
    held = loop.input(np.array([np.nan, 0.0]), Reference(target))
    assert held == pytest.approx([0.5])
    assert loop.last.plan.applicable


@pytest.mark.parametrize("probability", [None, 0.95])
def test_arrays_that_lie_column_by_column_say_the_same(probability):
    directions = np.array([[1.0, 0.5], [0.0, 1.0]])
    upper = np.linspace(0.3, 0.5, 2 * H).reshape(H, 2)
    path = np.linspace(0.0, 2.0, 2 * (H + 1)).reshape(H + 1, 2)
    limits = np.linspace(1.0, 2.0, 2 * H).reshape(H, 2)
    decisions = []
    for order in "CF":

        def laid(array, order=order):
            return np.array(array, order=order)

        rails = Halfspaces(laid(directions), laid(upper), probability=probability)
        bounds = Box(-laid(limits), laid(limits))
        problem = Problem(tracking(inputs=2), bounds, constraints=[rails])
        mode = "none" if probability is None else "zero_order"
        controller = GPMPC(
            KnownModel(cart_step, 2, 2),
            Linearization(),
            problem,
            H,
            [0.0, 0.0],
            PredictionSettings(covariance=mode),
        )
        belief = Gaussian(torch.zeros(2), torch.diag(torch.tensor([1e-3, 4e-3])))
        decisions.append(controller.control(belief, Reference(laid(path))))
    by_rows, by_columns = decisions
    assert by_rows.status.solved
    assert np.array_equal(by_columns.inputs, by_rows.inputs)


def test_inputs_handed_over_lead_to_the_goal_in_their_turn():
    """They swing the other way round than the last plan did."""
    problem = Problem(tracking(angles=[0]), Box([-60.0], [60.0]))
    controller = cart(problem, horizon=12)
    goal = Reference(np.array([3.0, 0.0]))
    last = controller.control(at(0.0, 0.0), goal)
    assert last.means[-1, 0] > 0.0
    push = np.zeros((12, 1))
    push[0] = -40.0
    decision = controller.control(at(0.0, 0.0), goal, last, plan=push)
    assert decision.means[-1, 0] < -2.5


def test_a_distance_alone_that_rounds_below_zero_is_a_step():
    """Two vehicles that move alike: what is weighed is a difference of large states."""

    def both(x, u):
        return x + u

    rng = np.random.default_rng(0)
    for _ in range(10):
        Q = 10.0 ** rng.uniform(0, 6) * np.array([[1.0, -1.0], [-1.0, 1.0]])
        cost = Tracking(Q, [1e-8], terminal=Q)
        start, goal, first_input = 1e3 * rng.normal(size=3)
        controller = GPMPC(
            KnownModel(both, 2, 1),
            Linearization(),
            Problem(cost, Box([-1e5], [1e5])),
            10,
            [first_input],
            PredictionSettings(covariance="none"),
        )
        apart = start + np.array([1e-6 * rng.normal(), 0.0])
        decision = controller.control(
            Gaussian.certain(apart), Reference(np.full(2, goal))
        )
        assert decision.status is Status.SOLVED
        assert min(decision.steps, default=0.0) >= 0.0


@pytest.mark.parametrize("level", [-0.1, -0.5])
def test_a_line_to_where_the_model_has_no_number_is_no_guess(level):
    """The set point of a tank is below empty, by what a sensor is off."""

    def tank(x, u):
        return x + 0.1 * (u - torch.sqrt(x))

    problem = Problem(Tracking([1.0], [0.1]), Box([0.0], [2.0]))
    controller = GPMPC(
        KnownModel(tank, 1, 1),
        Linearization(),
        problem,
        10,
        [0.7],
        PredictionSettings(covariance="none"),
    )
    decision = controller.control(at(0.5), Reference(np.array([level])))
    assert decision.status is Status.SOLVED
    assert decision.input[0] == pytest.approx(0.0, abs=1e-9)
