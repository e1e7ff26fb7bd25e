"""Costs of outputs, weights and bounds by stage, rows of inputs, and plans that are
handed over."""

from functools import partial
from typing import NamedTuple

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Transitions, train
from gpmpc.models import Affine, KnownModel, ResidualModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Inequality,
    LeastSquares,
    ManyStarts,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc.baselines import LQR, NMPC, StateFormMPC
from gpmpc.propagation import Linearization
from gpmpc.status import Status
from tests.mpc.double_pendulum import ACROBOT, DoublePendulum
from tests.mpc.small_models import COVARIANCES, FORMS
from tests.mpc.systems import LinearPlant, linear_gaussian

H = 7
STATE = np.array([0.4, -0.3, 0.2])
GOAL = Reference(np.array([0.1, 0.2, -0.1]), np.array([0.05, -0.1]))
BOX = Box([-0.3] * 2, [0.25] * 2)


class PlanOfThree(NamedTuple):
    """What no controller takes for a plan."""

    states: np.ndarray
    inputs: np.ndarray
    covariances: np.ndarray


def planned(
    problem, covariance="zero_order", form="trajectory", kind=GPMPC, **settings
):
    controller = kind(
        linear_gaussian(3, 2),
        Linearization(),
        problem,
        H,
        [0.1, 0.0],
        prediction=PredictionSettings(form=form, covariance=covariance),
        **settings,
    )
    return controller.control(Gaussian.certain(STATE), GOAL)


@pytest.mark.parametrize("covariance", COVARIANCES)
@pytest.mark.parametrize("form", FORMS)
def test_a_linear_output_costs_what_tracking_does(form, covariance):
    """x - r and u as outputs with the weights Q and R, beside a cost that is next to
    nothing."""
    Q = np.diag([3.0, 0.5, 1.0]) + 0.1
    R = np.diag([0.2, 0.4])
    tracking = planned(
        Problem(Tracking(Q, R + 1e-9 * np.eye(2), penalized="inputs"), BOX),
        covariance,
        form,
    )
    outputs = [
        LeastSquares(lambda x: x, Q, reference=GOAL.states),
        LeastSquares(lambda x, u: u, R),
    ]
    small = Tracking([0.0] * 3, [1e-9] * 2, penalized="inputs")
    problem = Problem(small, BOX, outputs=outputs)
    plan = planned(problem, covariance, form)
    assert np.allclose(plan.inputs, tracking.inputs, atol=1e-7)
    if covariance == "zero_order":  # under the feedback that the outputs' weights give
        assert np.allclose(plan.covariances, tracking.covariances, atol=1e-6)


@pytest.mark.parametrize("penalized", ["inputs", "deviations", "increments"])
def test_weights_and_bounds_by_stage_match_the_sparse_program(penalized, rng):
    Q = rng.uniform(0.1, 2.0, (H, 3))
    R = rng.uniform(0.1, 1.0, (H, 2))
    low = rng.uniform(-0.3, -0.1, (H, 2))
    high = rng.uniform(0.1, 0.3, (H, 2))
    cost = Tracking(
        *(weights[:, :, None] * np.eye(weights.shape[1]) for weights in (Q, R)),
        penalized=penalized,
    )
    problem = Problem(cost, Box(low, high), Box(-0.1 - 0.1 * np.ones((H, 2)), None))
    for covariance in ("zero_order", "full"):
        plans = [
            planned(problem, covariance, kind=kind).inputs
            for kind in (GPMPC, StateFormMPC)
        ]
        assert np.allclose(*plans, atol=1e-6)
    nonlinear = NMPC(LinearPlant(linear_gaussian(3, 2)), problem, H, [0.1, 0.0])
    assert np.allclose(
        nonlinear.control(Gaussian.certain(STATE), GOAL).inputs,
        planned(problem).inputs,
        atol=1e-5,
    )
    free = Problem(cost)
    law = LQR(linear_gaussian(3, 2), free, H, [0.1, 0.0]).control(
        Gaussian.certain(STATE), GOAL
    )
    assert np.allclose(law.inputs, planned(free).inputs, atol=1e-9)


def tip(x, u, p):
    """Place of a double pendulum's tip over the one that p says, and the power that its
    motor takes."""
    elbow = x[..., 0]
    hand = x[..., 0] + x[..., 1]
    place = [
        torch.sin(elbow) + torch.sin(hand) - p[..., 0],
        torch.cos(elbow) + torch.cos(hand) - p[..., 1],
    ]
    return torch.stack([*place, 0.02 * u[..., 0] * x[..., 3]], dim=-1)


def casadi_tip():
    x, u, p = (
        casadi.SX.sym(name, size) for name, size in (("x", 4), ("u", 1), ("p", 2))
    )
    elbow = x[0]
    hand = x[0] + x[1]
    place = (
        casadi.sin(elbow) + casadi.sin(hand) - p[0],
        casadi.cos(elbow) + casadi.cos(hand) - p[1],
    )
    return casadi.Function(
        "tip", [x, u, p], [casadi.vertcat(*place, 0.02 * u[0] * x[3])]
    )


@pytest.mark.parametrize("y", [tip, casadi_tip()], ids=["torch", "CasADi"])
def test_an_iterated_plan_is_stationary_in_the_cost_of_outputs(y):
    """The gradient of the true cost in the inputs, by differences of a roll-out,
    vanishes: KKT without bounds."""
    model = DoublePendulum(ACROBOT)
    steps = 12
    R = 1e-2
    place = np.array([0.5, 1.6])
    start = np.array([0.2, 0.1, 0.0, 0.0])
    problem = Problem(
        Tracking([0.0, 0.0, 0.02, 0.02], [R], penalized="inputs"),
        outputs=[LeastSquares(y, [5.0, 5.0, 1.0])],
    )
    settings = PredictionSettings(covariance="none")
    controller = GPMPC(
        model,
        Linearization(),
        problem,
        steps,
        [0.0],
        settings,
        iterations=60,
        tolerance=1e-9,
    )
    plan = controller.control(
        Gaussian.certain(start), Reference(np.zeros(4)), None, place
    )
    assert plan.status is Status.SOLVED
    assert plan.iterations > 3

    def cost(inputs):
        x = start
        total = 0.0
        for u in inputs:
            x = model.successor(x, u)
            out = tip(torch.tensor(x), torch.tensor(u), torch.tensor(place)).numpy()
            total += (
                out @ np.diag([5.0, 5.0, 1.0]) @ out + R * u @ u + 0.02 * x[2:] @ x[2:]
            )
        return total

    step = 1e-5 * np.eye(steps)[:, :, None]
    slopes = np.array(
        [(cost(plan.inputs + d) - cost(plan.inputs - d)) / 2e-5 for d in step]
    )
    at_rest = np.array([(cost(d) - cost(-d)) / 2e-5 for d in step])
    assert np.abs(slopes).max() < 1e-4 * np.abs(at_rest).max()
    assert cost(plan.inputs) < 0.97 * cost(0.0 * plan.inputs)


def test_a_constraint_of_states_and_inputs_is_kept_and_touched():
    """An input stays above x_3^2 - 0.2, whether it is said in torch or in CasADi."""
    x = casadi.SX.sym("x", 3)
    u = casadi.SX.sym("u", 2)
    limits = [
        lambda x, u: x[:, 2] ** 2 - u[:, 0] - 0.2,
        casadi.Function("limit", [x, u], [x[2] ** 2 - u[0] - 0.2]),
    ]
    plans = []
    for limit in limits:
        problem = Problem(
            Tracking([1.0] * 3, [0.1] * 2), BOX, constraints=[Inequality(limit)]
        )
        plans.append(planned(problem, iterations=40, tolerance=1e-8))
        assert plans[-1].status is Status.SOLVED
        assert (
            plans[-1].means[1:, 2] ** 2 - plans[-1].inputs[:, 0]
        ).max() == pytest.approx(0.2, abs=1e-7)
        assert plans[-1].violation < 1e-7
    free = planned(Problem(Tracking([1.0] * 3, [0.1] * 2), BOX))
    assert (free.means[1:, 2] ** 2 - free.inputs[:, 0]).max() > 0.25
    assert np.allclose(plans[0].inputs, plans[1].inputs, atol=1e-6)


def test_the_iteration_starts_at_a_given_plan():
    model = DoublePendulum(ACROBOT)
    goal = Reference(np.zeros(4))
    cost = Tracking([1.0] * 4, [1e-3], penalized="inputs")
    mpc = partial(
        GPMPC,
        model,
        Linearization(),
        Problem(cost, Box([-6.0], [6.0])),
        horizon=15,
        initial_input=[0.0],
        prediction=PredictionSettings(covariance="none"),
        tolerance=1e-9,
    )
    start = Gaussian.certain(np.array([0.3, -0.2, 0.0, 0.0]))
    controller = mpc(iterations=60)
    solved = controller.control(start, goal)
    for plan in (
        solved.inputs,
        (solved.inputs, solved.means),
        (torch.tensor(solved.inputs), solved.means),
    ):
        again = controller.control(start, goal, plan=plan)
        assert again.iterations == 1
        assert np.allclose(again.inputs, solved.inputs, atol=1e-6)
    loop = ControlLoop(mpc())
    first = loop.input(start, goal, plan=solved.inputs)
    assert np.allclose(first, solved.input, atol=1e-6)
    before = loop.last.plan
    later = controller.control(start, goal, before, plan=solved.inputs)
    assert np.allclose(later.inputs, solved.inputs, atol=1e-6)


def test_a_plan_is_flagged_only_where_it_leaves_the_data(rng):
    states = rng.uniform(-1, 1, (60, 2))
    inputs = rng.uniform(-1, 1, (60, 1))
    after = states + 0.1 * np.stack(
        [np.sin(3 * states[:, 1]), np.sin(3 * inputs[:, 0])], axis=1
    )
    data = Transitions(states, inputs, after + rng.normal(0, 1e-3, (60, 2)))
    problem = Problem(Tracking([1.0, 1.0], [0.1]), Box([-1.0], [1.0]))
    for model in (
        train(data, predicts="difference").posterior,
        ResidualModel.train(Affine.identity(2, 1), data),
    ):
        controller = GPMPC(model, Linearization(), problem, 5, [0.0])
        places = [np.full(2, place) for place in (0.2, 4e3)]
        among, beyond = (
            controller.control(Gaussian.certain(place), Reference(place))
            for place in places
        )
        assert among.novelty < 0.2
        assert not among.far_from_data
        assert beyond.novelty == pytest.approx(1.0, abs=0.05)
        assert beyond.far_from_data


def test_a_module_is_a_function_of_what_its_forward_takes():
    layer = torch.nn.Linear(2, 1, dtype=torch.float64)
    output = LeastSquares(layer, [1.0])
    assert output.squares(np.ones((3, 2)), np.ones((3, 1)), None).shape == (3, 4, 4)


def test_mistakes_are_one_clear_error():
    tracking = Tracking([1.0] * 3, [0.1] * 2)
    at = Gaussian.certain(STATE)
    for output, message in (
        ((1.0, [1.0]), "y: must be a function; got float"),
        ((len, [-1.0]), "weight: must be positive semidefinite"),
        ((len, [1.0], [0.0, 1.0]), "reference: must be 1 finite numbers"),
    ):
        with pytest.raises(SettingError, match=message):
            LeastSquares(*output)
    with pytest.raises(
        SettingError, match=r"outputs: must be LeastSquares\(...\); got Box"
    ):
        Problem(tracking, outputs=[BOX])
    with pytest.raises(
        SettingError, match="weight: must be given for one stage or all 7; got 2"
    ):
        planned(
            Problem(
                tracking,
                outputs=[LeastSquares(torch.sin, np.ones((2, 3, 3)) + np.eye(3))],
            )
        )
    with pytest.raises(
        SettingError,
        match="parameters: must come with every call: y is a function of them",
    ):
        planned(
            Problem(tracking, outputs=[LeastSquares(lambda x, u, p: x - p, [1.0] * 3)])
        )
    with pytest.raises(ShapeError, match=r"y must give \(7, 2\); got \(7, 3\)"):
        planned(Problem(tracking, outputs=[LeastSquares(lambda x: x, [1.0] * 2)]))
    assert (
        planned(Problem(tracking, outputs=[LeastSquares(torch.log, [1.0] * 3)])).status
        is Status.FUNCTION_NOT_FINITE
    )
    mixed = Problem(tracking, outputs=[LeastSquares(torch.sin, [1.0] * 3)])
    for kind in (LQR, StateFormMPC):
        arguments = (Linearization(),) if kind is StateFormMPC else ()
        with pytest.raises(
            SettingError, match="Inequality and LeastSquares are for GPMPC"
        ):
            kind(linear_gaussian(3, 2), *arguments, mixed, H, [0.0] * 2)
    controller = GPMPC(
        linear_gaussian(3, 2), Linearization(), Problem(tracking), H, [0.0] * 2
    )
    with pytest.raises(
        ShapeError,
        match=r"a plan must be inputs \(7, 2\), or these and states \(8, 3\); "
        r"got \(3, 2\)",
    ):
        controller.control(at, GOAL, plan=np.zeros((3, 2)))
    with pytest.raises(DataError, match="a plan to start from must be finite"):
        controller.control(at, GOAL, plan=np.full((7, 2), np.nan))
    last = controller.control(at, GOAL)
    plan = PlanOfThree(last.means, last.inputs, last.covariances)
    with pytest.raises(
        ShapeError, match=r"or a pair \(inputs, states\); got a PlanOfThree of 3"
    ):
        controller.control(at, GOAL, plan=plan)


def test_a_first_plan_counts_where_its_followed_cost_is_unknown():
    """The plan stays where the logarithm is finite; the model from its inputs not."""
    model = KnownModel(lambda x, u: x + u + 5.0 * u**2, state_dim=1, input_dim=1)
    barrier = LeastSquares(lambda x: torch.log(2.0 - x), [[0.01]])
    problem = Problem(Tracking([1.0], [1e-3]), Box([-2.0], [2.0]), outputs=[barrier])
    steering = GPMPC(model, Linearization(), problem, H, [0.0])
    decision = steering.control(Gaussian.certain([0.0]), Reference([1.5]))
    assert decision.status is Status.SOLVED
    assert decision.means[-1, 0] == pytest.approx(1.5, abs=0.2)


def test_feedback_between_decisions_knows_their_parameters():
    weighed = LeastSquares(lambda x, u, p: x - p, [[1.0]])
    model = KnownModel(lambda x, u: x + 0.1 * u, state_dim=1, input_dim=1)
    problem = Problem(Tracking([1e-6], [0.1]), Box([-2.0], [2.0]), outputs=[weighed])
    for controller in (
        GPMPC(model, Linearization(), problem, H, [0.0]),
        ManyStarts(GPMPC(model, Linearization(), problem, H, [0.0])),
    ):
        loop = ControlLoop(controller)
        loop.input([0.0], np.zeros(1), parameters=[0.1])
        plan = loop.last.plan
        pushed = loop.input_between(plan.means[0] + 0.01, 0.0)
        gain = controller.gains(plan, [0.1])[0, 0, 0]
        assert gain > 0.1
        assert pushed == pytest.approx(plan.inputs[0] - 0.01 * gain)


def test_functions_are_checked_where_a_flight_starts():
    cost = Tracking([1.0] * 3, [1.0] * 2)
    start = (STATE, np.zeros(2))
    weight = np.stack([np.eye(3)] * H)
    Problem(
        cost, outputs=[LeastSquares(lambda x: x, weight, np.zeros((H, 3)))]
    ).check_start(*start)
    with pytest.raises(
        SettingError,
        match=r"y or its gradient is not finite at x = \[ 0\.4 -0\.3  0\.2\], u",
    ):
        Problem(
            cost, outputs=[LeastSquares(torch.log, weight, np.zeros((H, 3)))]
        ).check_start(*start)
    log_of_inputs = Inequality(lambda x, u: u.log().sum(dim=1))
    with pytest.raises(
        SettingError,
        match=r"h or its gradient is not finite at x = .* where the flight starts",
    ):
        Problem(cost, constraints=[log_of_inputs]).check_start(*start)


@pytest.mark.parametrize("goal", [249.4, 1274.3, 1870.2])
def test_a_cost_of_outputs_that_rounds_below_zero_is_none(goal):
    """At rest at the goal the squares cancel, to either sign."""
    model = KnownModel(lambda x, u: x + 0.1 * u, state_dim=2, input_dim=2)
    output = LeastSquares(lambda x: x[:, :1], [10.0], [goal])
    problem = Problem(Tracking([0.0] * 2, [1e-4] * 2), outputs=[output])
    for count in (None, 5):
        steering = GPMPC(
            model, Linearization(), problem, 20, [0.0] * 2, iterations=count
        )
        last = None
        for _ in range(2):
            at = Gaussian.certain([goal, 0.0])
            last = steering.control(at, Reference([0.0, 0.0]), last)
            assert np.abs(last.input).max() < 1e-3


def test_a_first_plan_that_leads_out_of_an_output_gives_way():
    """One program's inputs lead to a negative state; those of more do not."""
    model = KnownModel(lambda x, u: x + 0.2 * (u - 2.455 * x), 1, 1)
    output = LeastSquares(torch.log, [0.121], reference=[-0.7024])
    problem = Problem(
        Tracking([1e-3], [4.1e-3]), Box([-10.0], [10.0]), outputs=[output]
    )
    settings = PredictionSettings(covariance="none")
    steering = GPMPC(model, Linearization(), problem, 10, [2.1537], settings)
    decision = steering.control(Gaussian.certain([2.2729]), Reference([0.4954]))
    assert decision.status is Status.SOLVED
    states = steering.prediction.lead(np.array([2.2729]), decision.inputs)
    assert states.min() > 0.0
