"""Stages cost what the problem says, flights end at a held goal, and relays pump."""

import casadi
import numpy as np
import pytest
import torch

from gpmpc._angles import wrap
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
from gpmpc.mpc._stage_meter import StageMeter
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


def pendulum_problem(**parts):
    cost = Tracking([1.0, 0.1], [0.01], penalized="inputs", angles=(0,))
    return Problem(cost, inputs=Box([-2.0], [2.0]), **parts)


def test_angles_are_wrapped_and_the_reference_rests_at_its_end():
    meter = StageMeter(pendulum_problem(), 2)
    states = np.array([[9.0, 9.0], [6.0, 1.0], [0.5, 2.0], [0.5, 0.0], [0.0, 0.0]])
    inputs = np.array([[1.0], [2.0], [0.0], [3.0]])
    reference = Reference(np.array([[0.0, 0.0], [0.0, 0.0], [0.5, 0.0]]))
    costs = meter(states, inputs, question(reference))
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
    costs = meter(np.zeros((4, 2)), inputs, question(reference, last=3.0))
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
    expected = [2 * 0.25 + 5.0, 2 * 4.0 + 5.0, 2 * 16.0 + 10.0]
    assert costs == pytest.approx(expected)


def test_a_hard_bound_costs_infinity_unless_it_is_of_few_stages():
    walls = [Box([-1.0, -5.0], [1.0, 5.0], penalty=None)]
    gate = [Box([-1.0, -5.0], [1.0, 5.0], penalty=None, stages=[2])]
    states = np.array([[0.0, 0.0], [0.5, 0.0], [1.5, 0.0]])
    reference = Reference(np.zeros((3, 2)))
    costs = [
        StageMeter(pendulum_problem(constraints=constraints), 2)(
            states, np.zeros((2, 1)), question(reference)
        )
        for constraints in (walls, gate)
    ]
    assert np.isinf(costs[0]).tolist() == [False, True]
    assert np.isfinite(costs[1]).all()


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


def test_a_flight_that_arrives_beats_a_cheaper_one_that_stands():
    states = np.zeros((4, 1))
    inputs = np.zeros((3, 1))
    arrives = ModelFlight(states, inputs, np.array([9.0, 9.0, 0.0]), True)
    stands = ModelFlight(states[:3], inputs[:2], np.array([3.0, 3.0]), False)
    falls = ModelFlight(states, inputs, np.array([3.0, 2.0, 1.0]), False)
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
    stuck = np.full(20, 5.0)
    stuck[3] = np.inf
    assert not foresight.arrives(stuck)
    held = np.append(stuck, np.zeros(20))
    assert foresight.arrives(held)
    assert not foresight.arrives(np.append(held, np.inf))


def test_feedback_of_a_flight_weighs_outputs_as_it_weighs_states():
    weight = [1.0, 0.1]
    output = LeastSquares(lambda x: x, weight=weight)
    gains = []
    for states_weight, outputs in ((weight, []), ([0.0, 0.0], [output])):
        cost = Tracking(states_weight, [0.01], penalized="inputs", angles=(0,))
        problem = Problem(cost, inputs=Box([-2.0], [2.0]), outputs=outputs)
        foresight = Foresight(controller(pendulum(), problem, 10))
        flight = ModelFlight(np.zeros((13, 2)), np.zeros((12, 1)), np.zeros(12), True)
        asked = question(Reference(np.zeros(2)).over(10))
        gains.append(foresight.with_gains(flight, asked).gains)
    assert np.abs(gains[0]).min() > 0.1
    assert np.allclose(gains[0], gains[1])
