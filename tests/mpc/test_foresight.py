"""Stages cost what the problem says, flights end at a held goal, and relays pump."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
import torch

from gpmpc._angles import wrap
from gpmpc.gaussian import Gaussian
from gpmpc.models import CasadiFunction, KnownModel
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
from gpmpc.mpc._foresight import Foresight, ModelFlight, Trajectory
from gpmpc.mpc._question import Question
from gpmpc.mpc._stage_meter import CostSum, FlownCosts, StageMeter
from gpmpc.mpc._starts import _Pursuit
from gpmpc.propagation import Linearization
from gpmpc.systems import cart_pole, pendulum, step


def known_model(system):
    n = len(system.state_names)
    x = casadi.SX.sym("x", n)
    u = casadi.SX.sym("u", 1)
    successor = casadi.vertcat(*system.successor(x, u))
    function = CasadiFunction(casadi.Function("f", [x, u], [successor]))
    return KnownModel(function, n, 1)


def controller(system, problem, horizon, iterations=1):
    return GPMPC(
        known_model(system),
        Linearization(),
        problem,
        horizon,
        system.initial_input,
        PredictionSettings(covariance="none", rolled_out=True),
        iterations=iterations,
        tolerance=1e-2,
    )


def question(reference, parameters=None, last=0.0):
    n = reference.states.shape[1]
    covariance = torch.zeros(n, n, dtype=torch.float64)
    return Question(covariance, reference, parameters, np.array([last]))


def errors_of(*errors):
    zeros = np.zeros(len(errors))
    return FlownCosts(np.array(errors), zeros, zeros)


def pendulum_problem(**parts):
    cost = Tracking([1.0, 0.1], [0.01], penalized="inputs", angles=(0,))
    return Problem(cost, inputs=Box([-2.0], [2.0]), **parts)


def test_angles_are_wrapped_and_the_reference_rests_at_its_end():
    meter = StageMeter(pendulum_problem(), 2)
    states = np.array([[9.0, 9.0], [6.0, 1.0], [0.5, 2.0], [0.5, 0.0], [0.0, 0.0]])
    inputs = np.array([[1.0], [2.0], [0.0], [3.0]])
    reference = Reference(np.array([[0.0, 0.0], [0.0, 0.0], [0.5, 0.0]]))
    costs = meter(states, inputs, question(reference)).total
    expected = [
        (2 * np.pi - 6.0) ** 2 + 0.1 + 0.01,
        0.1 * 4 + 0.01 * 4,
        0.0,
        0.25 + 0.09,
    ]
    assert costs == pytest.approx(expected)


def test_increments_are_counted_from_the_input_before():
    cost = Tracking([0.0, 0.0], [1.0])
    meter = StageMeter(Problem(cost), 5)
    inputs = np.array([[1.0], [4.0], [4.0]])
    reference = Reference(np.zeros((6, 2)))
    costs = meter(np.zeros((4, 2)), inputs, question(reference, last=3.0)).total
    assert costs == pytest.approx([4.0, 9.0, 0.0])


def test_outputs_and_violations_count_with_their_parameters():
    def output(x, u, p):
        return x[:, :1] - p

    def beyond(x, u, p):
        return x[:, 1:] - p

    parts = {
        "outputs": [LeastSquares(output, [2.0])],
        "constraints": [
            Box([-1.0, -np.inf], [1.0, np.inf], penalty=10.0),
            Inequality(beyond, penalty=5.0),
        ],
    }
    cost = Tracking([0.0, 0.0], [1.0], penalized="inputs")
    meter = StageMeter(Problem(cost, **parts), 2)
    states = np.array([[9.0, 9.0], [1.5, 0.0], [0.0, 3.0], [-2.0, 0.0]])
    parameters = np.array([[1.0], [2.0]])  # by stage; the last one is held
    reference = Reference(np.zeros((3, 2)))
    costs = meter(states, np.zeros((3, 1)), question(reference, parameters))
    kept = 1e-5  # by so much a bound may be missed that counts as kept
    errors = [2 * 0.25, 2 * 4.0, 2 * 16.0]
    violations = [10 * (0.5 - kept), 5 * (1 - kept), 10 * (1 - kept)]
    assert costs.errors == pytest.approx(errors, rel=1e-12)
    assert costs.violations == pytest.approx(violations, rel=1e-12)
    assert costs.total == pytest.approx(np.add(errors, violations), rel=1e-12)


def test_a_bound_missed_by_rounding_costs_nothing():
    walls = [Box(None, [1.0, np.inf], penalty="exact")]
    meter = StageMeter(pendulum_problem(constraints=walls), 2)
    states = np.array([[0.0, 0.0], [1.0 + 2e-9, 0.0], [1.1, 0.0]])
    costs = meter(states, np.zeros((2, 1)), question(Reference(np.zeros((3, 2)))))
    assert costs.violations == pytest.approx([0.0, 1e6 * (0.1 - 1e-5)])


def test_a_hard_bound_costs_infinity_unless_it_is_of_few_stages():
    walls = [Box([-1.0, -5.0], [1.0, 5.0], penalty=None)]
    gate = [Box([-1.0, -5.0], [1.0, 5.0], penalty=None, stages=[2])]
    states = np.array([[0.0, 0.0], [0.5, 0.0], [1.5, 0.0]])
    reference = Reference(np.zeros((3, 2)))
    costs = [
        StageMeter(pendulum_problem(constraints=constraints), 2)(
            states, np.zeros((2, 1)), question(reference)
        ).total
        for constraints in (walls, gate)
    ]
    assert np.isinf(costs[0]).tolist() == [False, True]
    assert np.isfinite(costs[1]).all()


def test_a_stage_costs_the_same_wherever_it_stands():
    """Bounds and references by stage count as those of the first one."""
    narrower = Box(upper=[[1.2, np.inf], [0.4, np.inf]], penalty=2.0)
    outputs = LeastSquares(lambda x: x[:, :1], [1.0], reference=[[0.3], [0.9]])
    late = Tracking([[[0.0, 0.0]] * 2, np.eye(2)], [0.01], penalized="inputs")
    problem = Problem(
        late, Box([-2.0], [2.0]), constraints=[narrower], outputs=[outputs]
    )
    meter = StageMeter(problem, 2)
    states = np.zeros((6, 2))
    states[1:, 0] = 1.0
    asked = question(Reference(np.zeros((3, 2))))
    costs = meter(states, np.zeros((5, 1)), asked)
    assert costs.errors == pytest.approx(np.full(5, 0.7**2 + 0.5))
    assert not costs.violations.any()


def test_a_flight_follows_the_controller_and_ends_at_the_goal():
    system = pendulum()
    one = controller(system, pendulum_problem(), 30)
    start = np.array(system.start)
    at_rest = question(Reference(np.zeros((31, 2))))
    beginning = Trajectory(one, start[None], np.empty((0, 1)))
    flight = Foresight(one).fly(beginning, at_rest)
    loop = ControlLoop(one)
    state = start
    for k in range(len(flight)):
        assert np.allclose(flight.states[k], state, atol=1e-6)
        state = step(system, state, loop.input(state, np.zeros(2)))
    assert flight.arrives
    assert np.abs(wrap(flight.states[-4:, 0])).max() < 0.3
    assert Foresight(one).fly(beginning, at_rest, 0.9 * flight.cost) is None
    better = Foresight(one).improve(flight, at_rest)
    assert better.cost <= flight.cost
    for k in range(len(better)):
        after = step(system, better.states[k], better.inputs[k])
        assert np.allclose(better.states[k + 1], after, rtol=1e-6, atol=1e-6)


def test_a_whole_flight_is_improved_where_its_plan_has_defects():
    """Its inputs alone would leave the top of a cart-pole within the flight."""
    system = cart_pole()
    cost = Tracking([1.0, 0.01, 1.0, 0.01], [0.01], penalized="inputs", angles=(2,))
    problem = Problem(cost, Box(system.input_lower, system.input_upper))
    one = GPMPC(
        known_model(system),
        Linearization(),
        problem,
        30,
        [0.0],
        PredictionSettings(covariance="none"),
        iterations=1,
        tolerance=1e-2,
    )
    foresight = Foresight(one)
    at_rest = question(Reference(np.zeros((31, 4))))
    beginning = Trajectory(one, np.array(system.start)[None], np.empty((0, 1)))
    flight = foresight.prolong(foresight.fly(beginning, at_rest), at_rest)
    assert flight.cost == pytest.approx(212.4, rel=1e-2)
    improved = foresight.improve(flight, at_rest)
    assert improved.arrives
    assert improved.cost < 174.0
    for k in range(len(improved)):
        after = step(system, improved.states[k], improved.inputs[k])
        assert np.allclose(improved.states[k + 1], after, rtol=1e-6, atol=1e-6)


def test_a_flight_that_arrives_beats_a_cheaper_one_that_stands():
    states = np.zeros((4, 1))
    inputs = np.zeros((3, 1))
    arrives = ModelFlight(states, inputs, errors_of(9.0, 9.0, 0.0), True)
    stands = ModelFlight(states[:3], inputs[:2], errors_of(3.0, 3.0), False)
    falls = ModelFlight(states, inputs, errors_of(3.0, 2.0, 1.0), False)
    assert arrives.is_better_than(stands)
    assert not stands.is_better_than(arrives)
    assert falls.is_better_than(stands)  # which costs 9 over as many stages


def test_relays_pump_at_the_bounds_in_the_rhythm_of_the_plant():
    system = pendulum()
    foresight = Foresight(controller(system, pendulum_problem(), 30))
    at_rest = question(Reference(np.zeros((31, 2))))
    relays = list(foresight.relays(np.array(system.start), at_rest))
    highest = [np.abs(wrap(states[-1, 0])) for states, _ in relays]
    assert min(highest) < 1.3  # a few swings after hanging
    for states, inputs in relays:
        assert set(np.abs(inputs).round(9).ravel()) == {2.0}
        for k in range(len(inputs)):
            after = step(system, states[k], inputs[k])
            assert np.allclose(states[k + 1], after, rtol=1e-6, atol=1e-6)


def test_a_search_under_constraints_with_parameters_keeps_them():
    x = casadi.SX.sym("x", 4)
    u = casadi.SX.sym("u", 1)
    p = casadi.SX.sym("p", 1)
    beyond = casadi.Function("h", [x, u, p], [x[0] ** 2 - p**2])
    system = cart_pole()
    cost = Tracking([1.0, 0.01, 1.0, 0.01], [0.01], penalized="inputs", angles=(2,))
    walls = [Inequality(beyond, penalty=1000.0)]
    problem = Problem(cost, inputs=Box([-10.0], [10.0]), constraints=walls)
    loop = ControlLoop(ManyStarts(controller(system, problem, horizon=30)))
    state = np.array(system.start)
    path = []
    for _ in range(65):
        state = step(system, state, loop.input(state, np.zeros(4), [0.5]))
        path.append(state)
    assert np.abs(np.array(path)[:, 0]).max() < 0.52
    assert np.abs(wrap(np.array(path)[-10:, 2])).max() < 0.2


def test_a_stage_beyond_a_hard_bound_says_nothing_of_arrival():
    foresight = Foresight(controller(pendulum(), pendulum_problem(), 20))
    beyond = FlownCosts(np.array([9e9]), np.zeros(1), np.array([np.inf]))
    stuck = FlownCosts.joined([errors_of(*[5.0] * 3), beyond, errors_of(*[5.0] * 16)])
    assert not foresight.arrives(stuck)
    held = FlownCosts.joined([stuck, errors_of(*[0.0] * 20)])
    assert foresight.arrives(held)
    assert not foresight.arrives(FlownCosts.joined([held, beyond]))


def test_a_plan_of_a_short_horizon_arrives():
    foresight = Foresight(controller(pendulum(), pendulum_problem(), 2))
    assert foresight.arrives(errors_of(0.0, 0.0))


def test_a_locked_input_takes_no_relays():
    locked = Problem(pendulum_problem().cost, inputs=Box([0.0], [0.0]))
    foresight = Foresight(controller(pendulum(), locked, 30))
    at_rest = question(Reference(np.zeros((31, 2))))
    assert not list(foresight.relays(np.array([3.0, 3.0]), at_rest))


def test_what_a_bound_costs_says_nothing_of_how_near_the_goal_is():
    """A start beyond a soft bound, at its exact price, beside errors of ten."""
    foresight = Foresight(controller(pendulum(), pendulum_problem(), 20))
    errors = np.full(20, 100.0)
    violations = np.zeros(20)
    violations[:2] = 1e5
    far = FlownCosts(errors, np.zeros(20), violations)
    assert not foresight.arrives(far)
    assert not foresight.arrives(far, dearest=100.0)
    near = FlownCosts(np.linspace(10.0, 0.0, 20) ** 4, np.zeros(20), violations)
    assert foresight.arrives(near)
    beyond = FlownCosts(near.errors, near.inputs, np.full(20, 1e5))
    assert foresight.arrives(beyond)  # at a goal that lies beyond the bound


def test_a_goal_that_is_held_is_held_from_the_first_plan_on():
    foresight = Foresight(controller(pendulum(), pendulum_problem(), 20))
    at_the_goal = FlownCosts(np.full(20, 1e-4), np.full(20, 3.0), np.zeros(20))
    assert foresight.arrives(at_the_goal)  # where an input is to hold the plant
    rounding = FlownCosts(np.full(20, 1e-28), np.zeros(20), np.zeros(20))
    assert foresight.arrives(rounding)
    leaning = FlownCosts(np.full(20, 1.0), np.full(20, 3.0), np.zeros(20))
    assert not foresight.arrives(leaning)
    passing = FlownCosts(np.full(20, 1e-4), np.linspace(1.0, 3.0, 20), np.zeros(20))
    assert not foresight.arrives(passing)


def test_shares_of_costs_and_of_violations_are_compared_apart():
    whole = CostSum(weighed=10.0, violations=1e5, beyond=1)
    assert not whole.is_dearer(whole, 0.1, whole)
    dearer = whole._replace(weighed=12.0)
    assert dearer.is_dearer(whole, 0.1, whole)  # a fifth, beside what is violated
    assert not whole._replace(violations=1.01e5).is_dearer(whole, 0.1, whole)
    assert whole._replace(violations=1.2e5).is_dearer(whole, 0.1, whole)
    bought = whole._replace(weighed=12.0, violations=9e4)
    assert not bought.is_dearer(whole, 0.1, whole)
    assert whole._replace(beyond=2).is_dearer(whole, 0.1, whole)
    left = whole.less(CostSum(weighed=4.0, violations=1e5, beyond=1))
    assert left == CostSum(weighed=6.0, violations=0.0, beyond=0)


def test_a_grazed_hard_bound_is_measured_by_the_other_stages():
    costs = FlownCosts(
        np.array([4.0, 9e9, 2.0, 1.0]), np.ones(4), np.array([0.0, np.inf, 0.0, 0.0])
    )
    flight = ModelFlight(np.zeros((5, 1)), np.zeros((4, 1)), costs, True)
    pursuit = _Pursuit.of_flight(np.zeros(1), flight, 3, last=None)
    assert pursuit.remaining == CostSum(weighed=10.0, violations=0.0, beyond=1)
    for stages, left in ((1, (5.0, 1)), (2, (5.0, 0)), (3, (2.0, 0))):
        pursuit = pursuit.after_flown_stage(flight.after(stages), 3)
        assert pursuit.remaining == CostSum(left[0], 0.0, left[1])
        remaining = flight.after(stages).cost_sum
        assert not remaining.is_dearer(pursuit.remaining, 0.1, pursuit.whole_cost)
        dearer = remaining._replace(weighed=remaining.weighed + 2.0)
        assert dearer.is_dearer(pursuit.remaining, 0.1, pursuit.whole_cost)


def test_feedback_of_a_flight_weighs_outputs_as_it_weighs_states():
    weight = [1.0, 0.1]
    output = LeastSquares(lambda x: x, weight=weight)
    gains = []
    for states_weight, outputs in ((weight, []), ([0.0, 0.0], [output])):
        cost = Tracking(states_weight, [0.01], penalized="inputs", angles=(0,))
        problem = Problem(cost, inputs=Box([-2.0], [2.0]), outputs=outputs)
        foresight = Foresight(controller(pendulum(), problem, 10))
        flight = ModelFlight(
            np.zeros((13, 2)), np.zeros((12, 1)), errors_of(*[0.0] * 12), True
        )
        asked = question(Reference(np.zeros(2)).over(10))
        gains.append(foresight.with_gains(flight, asked).gains)
    assert np.abs(gains[0]).min() > 0.1
    assert np.allclose(gains[0], gains[1])


@pytest.mark.parametrize("failed_steps", [0, 1, 3])
def test_after_failed_steps_a_plan_is_compared_stage_by_stage(failed_steps):
    """The late stages of a swing-up are the dear ones: they were promised."""
    one = controller(pendulum(), pendulum_problem(), horizon=5)
    many = ManyStarts(one)
    stages = np.array([1.0, 1.0, 1.0, 5.0, 9.0, 9.0, 9.0, 9.0, 9.0])
    states = np.arange(20.0).reshape(10, 2)

    def costs(first):
        five = stages[first : first + 5]
        return FlownCosts(five, inputs=np.zeros(5), violations=np.zeros(5))

    pursuit = _Pursuit.of_plan(np.zeros(2), costs(0), states[:6])
    previous = one.control(Gaussian.certain(states[0]), Reference(np.zeros(2)))
    previous = replace(previous, means=states[failed_steps : failed_steps + 6])
    pursuit = pursuit.moved_to(previous, horizon=5)
    now = failed_steps + 1
    assert pursuit.costs.total.tolist() == stages[failed_steps:5].tolist()
    assert not many._needs_new_search(costs(now), pursuit)
    dearer = replace(costs(now), errors=1.5 * costs(now).errors)
    assert many._needs_new_search(dearer, pursuit)
