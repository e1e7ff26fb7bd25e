"""An iteration says that it has arrived, takes as many programs as it needs, and hands
out what it says."""

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError
from gpmpc.gaussian import Gaussian
from gpmpc.models import CasadiFunction, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    Halfspaces,
    Inequality,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc._guess import initial_guess, read_request
from gpmpc.mpc._roll_out import Outcome, outcome_of_inputs
from gpmpc.mpc._sqp import Globalization, Iterate
from gpmpc.propagation import Linearization
from gpmpc.status import Status
from gpmpc.systems import cart_pole, pendulum, planar_quadrotor, step
from tests.mpc.small_models import pendulum_posterior
from tests.mpc.test_starts import known_model

MEANS = PredictionSettings(covariance="none")


def cart(force):
    """Position and velocity under a drag, 10 Hz, pushed by a function of the input."""

    def next_state(x, u):
        position, velocity = x.unbind(-1)
        next_velocity = velocity + 0.1 * (force(u[..., 0]) - 0.3 * velocity)
        return torch.stack([position + 0.1 * velocity, next_velocity], -1)

    return KnownModel(next_state, 2, 1)


@pytest.mark.parametrize(
    "force",
    [lambda u: 2 * torch.tanh(u / 2), lambda u: 3 * torch.sin(u / 3)],
    ids=["tanh", "sin"],
)
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_an_input_that_saturates_is_no_reason_to_creep(force, tolerance):
    """Gauss-Newton alone creeps at a rate of .64 here, or overshoots by 1.64, for
    ever."""
    problem = Problem(Tracking([10.0, 1.0], [0.01]), inputs=Box([-5.0], [5.0]))
    plans = []
    for count in (100, 400):
        controller = GPMPC(
            cart(force),
            Linearization(),
            problem,
            8,
            [0.0],
            MEANS,
            iterations=count,
            tolerance=tolerance / (1 if count == 100 else 1e3),
        )
        decision = controller.control(
            Gaussian.certain([1.0, 0.0]), Reference(np.zeros(2))
        )
        plans.append(decision)
    assert plans[0].status is Status.SOLVED
    assert plans[0].iterations <= 25
    assert np.abs(plans[0].inputs - plans[1].inputs).max() < 100 * tolerance


def flown(iterations, tolerance=None):
    """Cost and programs of a planar quadrotor that jumps from set point to set
    point."""
    system = planar_quadrotor()
    problem = Problem(
        Tracking([10.0, 1.0, 10.0, 1.0, 1.0, 0.1], [0.1, 0.1]),
        Box(system.input_lower, system.input_upper),
    )
    controller = GPMPC(
        known_model(system),
        Linearization(),
        problem,
        15,
        system.initial_input,
        MEANS,
        iterations=iterations,
        tolerance=tolerance,
    )
    state = np.zeros(6)
    decision = None
    cost = 0.0
    programs = []
    for k in range(60):
        goal = np.zeros(6)
        goal[[0, 2]] = [(0.0, 0.0), (1.5, 0.5), (-1.5, 0.0)][k // 20]
        decision = controller.control(
            Gaussian.certain(state), Reference(goal), decision
        )
        assert decision.status is Status.SOLVED
        programs.append(decision.iterations)
        state = step(system, state, decision.input)
        cost += (state - goal) @ problem.cost.Q @ (state - goal)
    return cost, programs


def test_one_program_continues_a_plan_and_a_jump_takes_more():
    cost, programs = flown(None)
    converged, _ = flown(100, 1e-8)
    assert cost < 1.02 * converged
    assert programs[20] > 1  # the first jump
    assert np.mean(programs) < 1.3


def ellipsoid(x):
    off = x[:, [0, 2]] - torch.tensor([1.0, 0.5])
    return (off**2 * torch.tensor([2.0, 0.7])).sum(1, keepdim=True) - 1.0


def distance(x):
    off = x[:, [0, 2]] - torch.tensor([0.8, 0.4])
    return 0.7 - torch.linalg.norm(off, dim=1, keepdim=True)


def energy(x):
    return (x[:, [1, 3]] ** 2).sum(1, keepdim=True) / 2 - 0.2


def puck(x, u):
    """Two carts side by side whose motors saturate."""
    p, v, q, w = x.unbind(-1)
    push = torch.tanh(u)
    parts = [p + 0.2 * v, v + 0.2 * push[..., 0], q + 0.2 * w, w + 0.2 * push[..., 1]]
    return torch.stack(parts, -1)


@pytest.mark.parametrize("h", [ellipsoid, distance, energy])
@pytest.mark.parametrize("stages", [None, [8]], ids=["all stages", "the last"])
@pytest.mark.parametrize("iterations", [None, 1, 30])
def test_a_decision_says_how_far_its_plan_misses_a_curved_bound(
    h, stages, iterations, rng
):
    for _ in range(4):
        problem = Problem(
            Tracking([1.0, 0.1, 1.0, 0.1], [0.1, 0.1], penalized="inputs"),
            inputs=Box([-1.0] * 2, [1.0] * 2),
            constraints=[Inequality(h=h, stages=stages)],
        )
        controller = GPMPC(
            KnownModel(puck, 4, 2),
            Linearization(),
            problem,
            8,
            [0.0, 0.0],
            MEANS,
            iterations=iterations,
        )
        start = rng.normal(size=4) * [2.0, 1.0, 2.0, 1.0]
        decision = controller.control(Gaussian.certain(start), Reference(np.zeros(4)))
        states = [torch.from_numpy(start)]
        for u in decision.inputs:
            states.append(puck(states[-1], torch.from_numpy(u)))
        means = torch.stack(states)
        values = h(means[1:]).numpy().ravel()
        missed = max(0.0, (values if stages is None else values[-1:]).max())
        assert decision.applicable
        assert decision.status is not Status.NUMERICAL_TROUBLE
        assert decision.violation == pytest.approx(missed, abs=1e-9)
        np.testing.assert_allclose(decision.means, means.numpy(), atol=1e-9)
        if decision.status.solved:
            kept = decision.status is Status.SOLVED
            assert kept == (missed <= 1e-5)
        squares = means.numpy()[1:] ** 2 @ [1.0, 0.1, 1.0, 0.1]
        stages_cost = squares + 0.1 * (decision.inputs**2).sum(1)
        np.testing.assert_allclose(decision.stage_costs, stages_cost, rtol=1e-9)
        assert decision.cost == pytest.approx(stages_cost.sum(), rel=1e-12)


def test_a_first_plan_is_iterated_only_where_that_pays():
    """A pendulum under a weak torque would lean for ever; a cart-pole is brought up at
    less cost."""
    ends = {}
    for make in (pendulum, cart_pole):
        system = make()
        Q = [1.0, 0.01] if make is pendulum else [1.0, 0.01, 1.0, 0.01]
        cost = Tracking(Q, [0.01], penalized="inputs", angles=system.angle_indices)
        problem = Problem(cost, Box(system.input_lower, system.input_upper))
        plans = [
            GPMPC(
                known_model(system),
                Linearization(),
                problem,
                30,
                [0.0],
                MEANS,
                iterations=count,
            ).control(
                Gaussian.certain(np.array(system.start)), Reference(np.zeros(len(Q)))
            )
            for count in (None, 1)
        ]
        ends[make] = np.abs(plans[0].inputs - plans[1].inputs).max()
        assert plans[0].applicable
    assert ends[pendulum] < 1e-9
    assert ends[cart_pole] > 0.1


@pytest.mark.parametrize("weight", [0.0, 1e-4])
def test_a_bound_that_no_plan_keeps_does_not_hide_what_pays(weight):
    """A cart-pole beside a load that is too heavy for an exact bound, whatever is
    done."""
    system = cart_pole()
    x = casadi.SX.sym("x", 5)
    u = casadi.SX.sym("u", 1)
    successor = casadi.vertcat(*system.successor(x[:4], u), x[4])
    function = casadi.Function("f", [x, u], [successor])
    model = KnownModel(CasadiFunction(function), 5, 1)
    cost = Tracking(
        [1.0, 0.01, 1.0, 0.01, 0.0],
        [0.01],
        penalized="inputs",
        angles=system.angle_indices,
    )
    load = Box(None, [np.inf] * 4 + [1.0], penalty="exact")
    problem = Problem(cost, Box(system.input_lower, system.input_upper), None, [load])
    start = np.append(system.start, 1.0 + weight)
    plans = []
    for count in (None, 1):
        controller = GPMPC(
            model, Linearization(), problem, 30, [0.0], MEANS, iterations=count
        )
        plan = controller.control(Gaussian.certain(start), Reference(np.zeros(5)))
        assert plan.violation == pytest.approx(weight)
        plans.append(plan)
    assert plans[0].cost < 0.5 * plans[1].cost


def test_violations_and_costs_of_first_plans_are_compared_apart():
    cheap = Outcome(cost=1.0, soft_price=0.0, hard_miss=0.0)
    dear = Outcome(cost=10.0, soft_price=0.0, hard_miss=0.0)
    beyond = cheap._replace(hard_miss=0.1)
    further = cheap._replace(hard_miss=0.3)
    lost = Outcome(cost=np.inf, soft_price=np.inf, hard_miss=np.inf)
    assert cheap.is_much_better_than(dear, 0.7)
    assert not dear.is_much_better_than(cheap, 0.7)
    assert not beyond.is_much_better_than(dear, 0.7)
    assert dear.is_much_better_than(beyond, 0.7)
    assert beyond.is_much_better_than(further, 0.7)
    assert beyond.is_much_better_than(lost, 0.7)
    assert not lost.is_much_better_than(dear, 0.7)
    assert not lost.is_much_better_than(lost, 0.7)
    priced = [outcome._replace(soft_price=1e6) for outcome in (cheap, dear)]
    assert priced[0].is_much_better_than(priced[1], 0.7)
    assert not priced[0]._replace(soft_price=2e6).is_much_better_than(dear, 0.7)


def test_inputs_that_lead_out_of_the_numbers_are_no_cheap_plan():
    """A cubic spring that pushes away: open loop, inputs beyond it diverge."""
    model = KnownModel(lambda x, u: x + x**3 + u, 1, 1)
    problem = Problem(Tracking([1.0], [1e-3]), inputs=Box([-9.0], [9.0]))
    controller = GPMPC(model, Linearization(), problem, 20, [0.0], MEANS)
    prediction = controller.prediction
    request = read_request(
        prediction, Gaussian.certain([1.0]), Reference(np.zeros(1)), None
    )
    local = prediction.linearize(initial_guess(prediction, request), request)
    outcomes = [
        outcome_of_inputs(prediction, local, inputs, np.zeros((21, 1, 1)), request)
        for inputs in (np.full((20, 1), 9.0), np.append(-2.0, np.zeros(19))[:, None])
    ]
    assert outcomes[0].cost == np.inf
    assert outcomes[1].cost == pytest.approx(0.008)  # of two increments
    assert outcomes[1].is_much_better_than(outcomes[0], 0.7)


def test_a_hard_bound_missed_by_rounding_counts_as_kept():
    model = KnownModel(lambda x, u: x + u, 1, 1)
    wall = Box(None, [1.0], penalty=None)
    problem = Problem(Tracking([1.0], [1e-3]), constraints=[wall])
    controller = GPMPC(model, Linearization(), problem, 5, [0.0], MEANS)
    prediction = controller.prediction
    request = read_request(
        prediction, Gaussian.certain([0.0]), Reference(np.zeros(1)), None
    )
    local = prediction.linearize(initial_guess(prediction, request), request)
    for excess, miss in ((1e-9, 0.0), (0.25, 0.25 - 1e-5)):
        inputs = np.array([[1.0 + excess], [0.0], [0.0], [0.0], [0.0]])
        outcome = outcome_of_inputs(
            prediction, local, inputs, np.zeros((6, 1, 1)), request
        )
        assert outcome.hard_miss == pytest.approx(miss)


def test_the_first_plan_stands_where_later_programs_fail(monkeypatch):
    problem = Problem(Tracking([10.0, 1.0], [0.01]), inputs=Box([-5.0], [5.0]))
    controller = GPMPC(cart(torch.tanh), Linearization(), problem, 8, [0.0], MEANS)
    at = Gaussian.certain([1.0, 0.0])
    reference = Reference(np.zeros(2))

    def fails(*arguments):
        raise DataError("beyond the model's numbers")

    monkeypatch.setattr(Globalization, "take_step", fails)
    decision = controller.control(at, reference)
    assert decision.status is Status.SOLVED
    assert decision.iterations == 1


def relaxation(x, u):
    """A van der Pol oscillator, pushed, 10 Hz."""
    a, b = x.unbind(-1)
    return torch.stack(
        [a + 0.1 * b, b + 0.1 * ((1 - a**2) * b - a + 2 * u[..., 0])], -1
    )


@pytest.mark.parametrize("penalty", [None, "exact"], ids=["hard", "soft"])
@pytest.mark.parametrize("iterations", [1, None])
def test_a_plan_rolled_out_beyond_a_bound_says_so(penalty, iterations):
    """One program sees the bound kept along a line; more programs keep it in truth."""
    planes = Halfspaces([[1.0, 1.0], [0.0, 1.0]], [0.9, 0.7], penalty=penalty)
    problem = Problem(
        Tracking([1.0, 0.1], [0.05], penalized="inputs"),
        inputs=Box([-2.0], [2.0]),
        constraints=[planes],
    )
    controller = GPMPC(
        KnownModel(relaxation, 2, 1),
        Linearization(),
        problem,
        10,
        [0.0],
        PredictionSettings(covariance="none", rolled_out=True),
        iterations=iterations,
    )
    decision = controller.control(
        Gaussian.certain([-0.5, 0.0]), Reference(np.array([2.0, 0.0]))
    )
    missed = max(0.0, (decision.means[1:] @ planes.F.T - planes.f).max())
    assert decision.violation == pytest.approx(missed, abs=1e-9)
    assert decision.applicable
    if iterations is None:
        assert decision.status is Status.SOLVED
        assert missed <= 1e-5
        return
    assert missed > 0.1
    name = "HARD_BOUND_MISSED" if penalty is None else "SOFT_BOUND_MISSED"
    assert decision.status is Status[name]


@pytest.mark.parametrize("iterations", [1, None, 30])
def test_a_hard_obstacle_on_the_line_to_the_goal_is_no_dead_end(iterations):
    """The line sees the disc from both sides; the state that stays sees it from one."""
    disc = Inequality(distance, penalty=None)
    problem = Problem(
        Tracking([1.0, 0.1, 1.0, 0.1], [0.1, 0.1], penalized="inputs"),
        inputs=Box([-1.0] * 2, [1.0] * 2),
        constraints=[disc],
    )
    controller = GPMPC(
        KnownModel(puck, 4, 2),
        Linearization(),
        problem,
        8,
        [0.0, 0.0],
        MEANS,
        iterations=iterations,
    )
    goal = Reference(np.array([2.0, 0.0, 1.0, 0.0]))
    decision = controller.control(Gaussian.certain(np.zeros(4)), goal)
    assert decision.applicable
    assert decision.violation < 1e-3


@pytest.mark.parametrize("penalty", [None, 1e3, "exact"])
def test_a_first_plan_whose_inputs_leave_a_bound_is_iterated(penalty):
    """However little they cost: one program sees them stay inside, along a line."""
    planes = Halfspaces([[1.0, 1.0], [0.0, 1.0]], [0.9, 0.7], penalty=penalty)
    problem = Problem(
        Tracking([1.0, 0.1], [0.05], penalized="inputs"),
        inputs=Box([-2.0], [2.0]),
        constraints=[planes],
    )
    controller = GPMPC(
        KnownModel(relaxation, 2, 1), Linearization(), problem, 10, [0.0], MEANS
    )
    decision = controller.control(
        Gaussian.certain([-0.5, 0.0]), Reference(np.array([2.0, 0.0]))
    )
    states = [torch.tensor([-0.5, 0.0])]
    for u in decision.inputs:
        states.append(relaxation(states[-1], torch.from_numpy(u)))
    means = torch.stack(states[1:]).numpy()
    assert (means @ planes.F.T - planes.f).max() < 1e-3


def test_a_step_that_cannot_be_taken_asks_no_further_program(monkeypatch):
    """Another program from the same plan would say the same."""
    problem = Problem(
        Tracking([1.0, 0.1, 1.0, 0.1], [0.1, 0.1], penalized="inputs"),
        inputs=Box([-1.0] * 2, [1.0] * 2),
        constraints=[Inequality(h=energy, penalty="exact")],
    )
    controller = GPMPC(
        KnownModel(puck, 4, 2), Linearization(), problem, 8, [0.0, 0.0], MEANS
    )

    def finds_no_step(self, local, program, solution, proposed):
        return Iterate(local, Status.SOLVED)

    monkeypatch.setattr(Globalization, "take_step", finds_no_step)
    decision = controller.control(
        Gaussian.certain([2.0, 0.0, -2.0, 0.0]), Reference(np.zeros(4))
    )
    assert decision.iterations == 2
    assert decision.status is Status.SOFT_BOUND_MISSED


def test_a_locked_input_takes_no_programs_at_rest():
    """Offsets are relative to the cost of an input that can move."""

    def next_state(x, u):
        angle, rate = x.unbind(-1)
        push = torch.tanh(u.sum(-1))
        next_rate = rate + 0.1 * (9.8 * torch.sin(angle) + push - 0.3 * rate)
        return torch.stack([angle + 0.1 * next_rate, next_rate], -1)

    problem = Problem(
        Tracking([1.0, 1.0], [0.1, 0.1]), inputs=Box([-1.0, 0.0], [1.0, 0.0])
    )
    controller = GPMPC(
        KnownModel(next_state, 2, 2),
        Linearization(),
        problem,
        horizon=10,
        initial_input=[0.0, 0.0],
        prediction=MEANS,
        iterations=10,
    )
    upright = np.array([np.pi, 0.0])
    decision = None
    for k in range(4):
        almost = Gaussian.certain(upright + np.array([1e-12 * (-1) ** k, 1e-13]))
        decision = controller.control(almost, Reference(upright), decision)
        assert decision.status is Status.SOLVED
        assert decision.iterations <= 2


def test_a_point_that_is_held_contradicts_no_plan_of_one_stage():
    problem = Problem(Tracking([10.0, 1.0], [0.1]), inputs=Box([-6.0], [6.0]))
    settings = PredictionSettings(form="velocity", covariance="none")
    model = pendulum_posterior()
    mpc = GPMPC(model, Linearization(), problem, 1, [0.0], settings)
    mpc._state_ranges = np.full(2, 1e-9)
    belief = Gaussian.certain([1.0, 1.0])
    request = read_request(mpc.prediction, belief, Reference([[0.4, 0.0]] * 2), None)
    local = mpc.prediction.linearize(initial_guess(mpc.prediction, request), request)
    assert mpc._at_what_the_model_does(local, request) is local
