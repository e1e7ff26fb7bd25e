"""Many starts find plans that one misses, over any full turn, within their time.

What was found is kept.
"""

from dataclasses import replace
from itertools import product

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.models import CasadiFunction, DelayedModel, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    LeastSquares,
    ManyStarts,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
    kicks,
)
from gpmpc.propagation import Linearization
from gpmpc.status import Status
from gpmpc.systems import cart_pole, double_pendulum, pendulum, step
from tests.mpc.small_models import pendulum_posterior


def known_model(system):
    n = len(system.state_names)
    m = len(system.input_names)
    x = casadi.SX.sym("x", n)
    u = casadi.SX.sym("u", m)
    return KnownModel(
        CasadiFunction(
            casadi.Function("f", [x, u], [casadi.vertcat(*system.successor(x, u))])
        ),
        n,
        m,
    )


def controller(system, Q, R, horizon, iterations=1, rolled_out=True, **bounds):
    problem = Problem(
        Tracking(Q, R, penalized="inputs", angles=system.angle_indices),
        inputs=Box(system.input_lower, system.input_upper),
        **bounds,
    )
    settings = PredictionSettings(covariance="none", rolled_out=rolled_out)
    return GPMPC(
        known_model(system),
        Linearization(),
        problem,
        horizon,
        system.initial_input,
        settings,
        iterations=iterations,
        tolerance=1e-2,
    )


class CountedStarts(ManyStarts):
    """Counts its searches."""

    searches = 0

    def plans(self, *arguments, **named):
        self.searches += 1
        return super().plans(*arguments, **named)


def counted_starts(system, Q, R, horizon, iterations, **settings):
    """Starts of a controller that takes one program, improved by ``iterations``."""
    return CountedStarts(
        controller(system, Q, R, horizon),
        controller(system, Q, R, horizon, iterations),
        **settings,
    )


def pendulums(iterations=15, **settings):
    return counted_starts(pendulum(), [1.0, 0.01], [0.01], 30, iterations, **settings)


def cart_poles(horizon=40):
    return counted_starts(
        cart_pole(), [1.0, 0.01, 1.0, 0.01], [0.01], horizon, iterations=10
    )


def wrap(angle):
    """The same angle between -pi and pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def fly(steering, system, steps, kicks=(), measure=lambda state, k: state):
    """States and what they cost, under kicks (step, change of the state)."""
    loop = ControlLoop(steering)
    state = np.array(system.start, dtype=float)
    states = [state]
    cost = steering.problem.cost
    paid = 0.0
    for k in range(steps):
        input = loop.input(measure(state, k), np.zeros(len(state)))
        state = step(system, state, input)
        for when, change in kicks:
            state = state + (k == when) * np.array(change)
        states.append(state)
        error = state.copy()
        error[list(cost.angles)] = wrap(error[list(cost.angles)])
        paid += error @ cost.Q @ error + input @ cost.R @ input
    return np.array(states), paid


def off_upright(states, angle):
    return np.abs(wrap(states[:, angle]))


def test_many_starts_swing_a_cart_pole_up_and_follow_the_plan():
    many = cart_poles()
    states, _ = fly(many, cart_pole(), 60)
    assert many.searches == 1
    assert off_upright(states[-20:], 2).max() < 0.15
    assert np.abs(states[-1, [0, 1, 3]]).max() < 0.15


@pytest.mark.parametrize("horizon", [30, 60])
def test_many_starts_cost_no_more_than_the_controller_alone(horizon):
    system = pendulum()
    many = counted_starts(system, [1.0, 0.01], [0.01], horizon, iterations=10)
    states, paid = fly(many, system, 80)
    alone, paid_alone = fly(many.controller, system, 80)
    assert off_upright(alone[-15:], 0).max() < 0.2
    assert off_upright(states[-15:], 0).max() < 0.2
    assert paid < 1.001 * paid_alone
    assert many.searches == 1


def test_a_cart_pole_is_up_sooner_than_by_the_controller_alone():
    system = cart_pole()
    many = cart_poles(60)
    states, paid = fly(many, system, 90)
    alone, paid_alone = fly(many.controller, system, 90)
    ups = [np.flatnonzero(off_upright(x, 2) > 0.2)[-1] for x in (states, alone)]
    assert ups[0] < ups[1] - 20
    assert paid < 0.8 * paid_alone


def test_a_push_that_makes_the_way_dearer_restarts_the_search():
    system = pendulum()
    many = pendulums()
    push = (30, [0.4, 3.0])
    states, _ = fly(many, system, 110, [push])
    assert many.searches == 2
    assert off_upright(states[-15:], 0).max() < 0.2
    many = pendulums()
    fly(many, system, 110, [(30, [0.005, 0.01])])
    assert many.searches == 1


def test_a_push_off_the_top_is_a_cause_to_search_again():
    many = pendulums()
    states, _ = fly(many, pendulum(), 170, [(85, [0.9, 3.0])])
    assert off_upright(states[80:85], 0).max() < 0.2
    assert many.searches == 2
    assert off_upright(states[-15:], 0).max() < 0.2


def test_noise_at_the_top_is_none():
    rng = np.random.default_rng(0)
    many = pendulums()
    noise = rng.normal(size=(120, 2)) * [0.005, 0.02]
    fly(many, pendulum(), 120, measure=lambda state, k: state + noise[k])
    assert many.searches == 1


def test_a_failed_measurement_does_not_lose_the_plan():
    def measure(state, k):
        return np.full(2, np.nan) if k in (12, 13, 40) else state

    many = pendulums()
    states, _ = fly(many, pendulum(), 90, measure=measure)
    assert many.searches == 1
    assert off_upright(states[-15:], 0).max() < 0.2


def test_a_plan_is_not_torn_by_the_controller_that_follows_it():
    def cost(decision, goal):
        return many._cost(decision, goal)

    system = cart_pole()
    many = counted_starts(
        system, [1.0, 0.01, 1.0, 0.01], [0.1], 80, iterations=10, criterion=cost
    )
    state = np.array(system.start)
    decision = None
    ratios = []
    for _ in range(40):
        last = decision
        decision = many.control(
            Gaussian.certain(state), Reference(np.zeros(4)), decision
        )
        state = step(system, state, decision.input)
        if last is None:
            continue
        turn = np.zeros(4)
        turn[2] = 2 * np.pi * np.round(last.means[-1, 2] / (2 * np.pi))
        goal = Reference(np.tile(turn, (81, 1)))
        inputs = np.concatenate([last.inputs[1:], last.inputs[-1:]])
        means = many.controller.prediction.lead(last.means[1], inputs)
        kept = replace(last, inputs=inputs, means=means)
        ratios.append(cost(decision, goal) / cost(kept, goal))
    assert many.searches == 1
    assert max(ratios) < 1.01


def test_another_set_point_is_not_the_one_that_a_flight_leads_to():
    system = cart_pole()
    many = cart_poles()
    loop = ControlLoop(many)
    state = np.array(system.start)
    for k in range(80):
        goal = np.array([0.0 if k < 5 else 1.0, 0.0, 0.0, 0.0])
        state = step(system, state, loop.input(state, goal))
    assert state[0] == pytest.approx(1.0, abs=0.1)
    assert off_upright(state[None], 2)[0] < 0.1


def test_a_reference_that_moves_is_followed_by_plans_alone():
    system = cart_pole()
    many = cart_poles(20)
    loop = ControlLoop(many)
    state = np.array([0.0, 0.0, 0.05, 0.0])
    for k in range(60):
        times = 0.05 * (k + np.arange(21))
        reference = np.zeros((21, 4))
        reference[:, 0] = 0.3 * np.sin(times)
        reference[:, 1] = 0.3 * np.cos(times)
        state = step(system, state, loop.input(state, reference))
    assert many.searches == 1
    assert np.abs(state[0] - 0.3 * np.sin(0.05 * 60)) < 0.1


def test_the_search_is_never_worse_than_any_of_its_starts():
    reference = Reference(np.zeros(2))
    state = Gaussian.certain(np.array([2.5, 3.0]))
    many = pendulums(turns=3)
    decision = many.control(state, reference)
    goals = [2 * np.pi * turn for turn in (-1, 0, 1, 2)]
    nearest = min(goals, key=lambda goal: abs(goal - decision.means[-1, 0]))
    best = many.criterion(decision, Reference(np.tile([nearest, 0.0], (31, 1))))
    for guess in many.guesses:
        one = pendulums(turns=1, guesses=[guess])
        alone = one.control(state, reference)
        goal = min(goals, key=lambda goal: abs(goal - alone.means[-1, 0]))
        if alone.applicable:
            assert (
                best
                <= one.criterion(alone, Reference(np.tile([goal, 0.0], (31, 1)))) + 1e-9
            )


def test_a_plan_obeys_the_dynamics_and_may_end_a_turn_away():
    system = pendulum()
    decision = pendulums().control(
        Gaussian.certain(np.array([5.5, 2.0])), Reference(np.zeros(2))
    )
    for k, u in enumerate(decision.inputs):
        assert np.allclose(
            decision.means[k + 1],
            step(system, decision.means[k], u),
            rtol=1e-7,
            atol=1e-9,
        )
    assert decision.means[-1, 0] == pytest.approx(2 * np.pi, abs=0.3)


def test_a_sensor_that_takes_a_turn_off_changes_nothing():
    many = pendulums()
    reference = Reference(np.zeros(2))
    first = many.control(Gaussian.certain(np.array([5.5, 2.0])), reference)
    states = [first.means[1] - turn for turn in ([0.0, 0.0], [2 * np.pi, 0.0])]
    inputs = [
        many.control(Gaussian.certain(state), reference, first).inputs
        for state in states
    ]
    assert np.allclose(*inputs, rtol=1e-6, atol=1e-6)


def test_the_users_criterion_chooses_until_the_budget_is_spent():
    state = Gaussian.certain(np.array([np.pi, 0.0]))
    reference = Reference(np.zeros(2))
    seen = []

    def to_the_right(decision, goal):
        seen.append(goal.states[-1, 0])
        return abs(decision.means[-1, 0] - 2 * np.pi)

    chosen = pendulums(criterion=to_the_right).control(state, reference)
    assert chosen.means[-1, 0] > np.pi
    assert len(seen) > 4
    assert {0.0, 6.283185} == set(np.round(seen, 6).tolist())
    seen.clear()
    assert (
        pendulums(criterion=to_the_right, budget=1e-9)
        .control(state, reference)
        .applicable
    )
    assert len(seen) == 2  # the controller's own plan, and one start


def test_only_a_plan_that_misses_the_goal_is_given_up():
    state = Gaussian.certain(np.array([np.pi, 0.0]))
    reference = Reference(np.zeros(2))
    one = controller(pendulum(), [1.0, 0.01], [0.01], 30)
    many = pendulums()
    many.control(state, reference, one.control(state, reference))
    assert many.searches == 1
    near = Gaussian.certain(np.array([0.1, 0.0]))
    many = pendulums()
    many.control(near, reference, one.control(near, reference))
    assert many.searches == 0


@pytest.mark.parametrize("penalty", ["elastic", "exact"])
def test_a_start_beyond_a_soft_bound_is_searched_as_others_are(penalty):
    """What leaving the bound costs says nothing of whether a plan ends at the goal."""
    slow = [Box([-np.inf, -2.0], [np.inf, 2.0], penalty=penalty)]
    settings = {"constraints": slow}
    one = controller(pendulum(), [1.0, 0.01], [0.01], 30, **settings)
    for rate, near in ((2.5, False), (0.0, True)):
        many = CountedStarts(one, controller(pendulum(), [1.0, 0.01], [0.01], 30, 15))
        state = Gaussian.certain(np.array([0.1 if near else np.pi, rate]))
        reference = Reference(np.zeros(2))
        many.control(state, reference, one.control(state, reference))
        assert many.searches == (0 if near else 1)


class Failing(GPMPC):
    """Finds no plan from some step on."""

    fails = False

    def control(self, *arguments, **named):
        decision = super().control(*arguments, **named)
        if not self.fails:
            return decision
        nothing = np.full_like(decision.means, np.nan)
        return replace(decision, means=nothing, status=Status.INFEASIBLE)


def test_a_plan_that_is_kept_says_that_the_controller_failed():
    one = Failing(
        pendulum_posterior(),
        Linearization(),
        Problem(Tracking([1.0, 0.1], [0.05]), Box([-2.0], [2.0])),
        12,
        [0.0],
    )
    many = ManyStarts(one)
    loop = ControlLoop(many)
    state = np.array([0.2, 0.0])
    loop.input(state, np.zeros(2))
    last = loop.last.decision
    one.fails = True
    loop.input(last.means[1], np.zeros(2))
    assert loop.last.status is Status.INFEASIBLE
    decision = loop.last.decision
    assert decision.applicable
    assert decision.suboptimal
    assert decision.solution is None
    assert np.abs(last.covariances).max() > 0.0
    assert np.array_equal(decision.covariances, last.covariances)


def test_plans_that_differ_in_a_small_input_are_two():
    """A thrust of a thousand newtons, and a wheel turned to the left or the right."""
    two_inputs = Problem(
        Tracking([1.0], [1e-6, 1.0], penalized="inputs"),
        inputs=Box([0.0, -0.5], [1000.0, 0.5]),
    )
    model = KnownModel(lambda x, u: x + u.sum(-1, keepdim=True), 1, 2)
    many = ManyStarts(GPMPC(model, Linearization(), two_inputs, 10, [0.0, 0.0]))
    thrust = np.linspace(0.0, 1000.0, 10)
    left = np.stack([thrust, np.full(10, 0.4)], axis=1)
    assert not many._are_alike(left, left * [1.0, -1.0])
    assert not many._are_alike(left, left * [0.5, 1.0])
    assert many._are_alike(left, left + np.array([10.0, 1e-6]))
    one = ManyStarts(controller(pendulum(), [1.0, 0.01], [0.01], 10))
    swing = np.linspace(-1.0, 1.0, 10)[:, None]
    assert one._are_alike(swing + 0.09, swing)
    assert not one._are_alike(swing + 0.11, swing)


def test_a_plan_to_a_moving_reference_is_judged_by_all_its_cost():
    """By outputs, by bounds that it misses, and by the increment of its first input."""

    def off_three(x, u, p):
        return x[:, :1] - p

    problem = Problem(
        Tracking([0.0], [0.1]),
        inputs=Box([-1.0], [1.0]),
        constraints=[Box(None, [2.0], penalty=7.0)],
        outputs=[LeastSquares(off_three, [1.0])],
    )
    model = KnownModel(lambda x, u: x + u, 1, 1)
    means = PredictionSettings(covariance="none")
    one = GPMPC(model, Linearization(), problem, 6, [-0.5], means)
    reference = Reference(np.linspace(0.0, 0.01, 7)[:, None])
    belief = Gaussian.certain(np.zeros(1))
    plans = list(ManyStarts(one).plans(belief, reference, parameters=[4.0]))
    for plan, value in plans:
        outputs = ((plan.means[1:] - 4.0) ** 2).sum()
        increments = 0.1 * (np.diff(plan.inputs[:, 0], prepend=-0.5) ** 2).sum()
        missed = 7.0 * (plan.means[1:] - 2.0 - 1e-5).clip(0.0).sum()
        assert value == pytest.approx(outputs + increments + missed, rel=1e-6)


def test_a_spent_budget_leaves_the_controllers_own_plan():
    system = pendulum()
    many = pendulums(budget=1e-9)
    state = Gaussian.certain(np.array(system.start))
    decision = many.control(state, Reference(np.zeros(2)))
    alone = many.controller.control(state, Reference(np.zeros(2)))
    assert np.allclose(decision.input, alone.input)
    states, _ = fly(many, system, 80)
    assert off_upright(states[-15:], 0).max() < 0.2


def test_non_finite_measurements_and_misuse_are_refused():
    bad = pendulums().control(
        Gaussian.certain(np.array([np.nan, 0.0])), Reference(np.zeros(2))
    )
    assert bad.status is Status.INVALID_MEASUREMENT
    with pytest.raises(ShapeError, match="guesses must be None or inputs"):
        pendulums(guesses=[np.zeros((3, 1))])
    with pytest.raises(SettingError, match="turns"):
        pendulums(turns=(2, 2))
    one = controller(pendulum(), [1.0, 0.01], [0.01], 30)
    with pytest.raises(ShapeError, match="a plan must be inputs"):
        one.control(
            Gaussian.certain(np.zeros(2)),
            Reference(np.zeros(2)),
            plan=(np.zeros((2, 1)), np.zeros((3, 2))),
        )


def test_goals_are_the_nearest_turns_of_the_references_end():
    many = ManyStarts(
        controller(double_pendulum("elbow"), [10.0, 0.1, 10.0, 0.1], [0.01], 3),
        turns=(2, 3),
    )
    angle = np.array([[0.0, 3.0, 7.0, 10.0], [5.0, 4.0, 2.0, -9.0]])
    reference = Reference(
        np.stack([angle[0], np.full(4, 0.5), angle[1], np.full(4, -0.5)], axis=1)
    )
    state = np.array([3.0, 8.0, 1.0, -8.0])
    off = state[[0, 2]] - angle[:, -1]
    around = [
        sorted(range(-9, 9), key=lambda k, a=a: abs(off[a] - 2 * np.pi * k))[
            : (2, 3)[a]
        ]
        for a in range(2)
    ]
    expected = sorted(
        product(*around),
        key=lambda turns: np.abs(off - 2 * np.pi * np.array(turns)).sum(),
    )
    goals = list(many.starts.goals(state, reference))
    assert len(goals) == 6
    for goal, turns in zip(goals, expected, strict=True):
        full_turns = 2 * np.pi * np.array([turns[0], 0, turns[1], 0])
        assert np.allclose(goal.states, reference.states + full_turns, atol=1e-12)


def test_a_guess_is_a_line_to_the_goal_or_a_roll_out():
    system = pendulum()
    H = 4
    inputs = np.array([[0.5], [-0.5], [1.0], [0.0]])
    many = ManyStarts(
        controller(system, [1.0, 0.01], [0.01], H),
        guesses=[None, inputs, 1e308 * inputs],
        turns=2,
    )
    state = np.array([0.3, -0.2])
    targets = np.stack([np.linspace(0.0, 1.0, 5), np.ones(5)], axis=1)
    starts = list(many.starts.of(state, Reference(targets)))
    assert len(starts) == 6  # guess by guess, two goals each
    for goal, start_inputs, states in starts[:2]:
        assert np.allclose(states[0], state)
        assert np.allclose(states[-1], goal.states[-1])
        for k in range(H + 1):
            assert np.allclose(
                states[k], goal.states[k] + (1 - k / H) * (state - goal.states[0])
            )
        assert np.array_equal(start_inputs, np.tile(system.initial_input, (H, 1)))
    for _, start_inputs, states in starts[2:4]:
        assert start_inputs is inputs
        for k in range(H):
            assert np.allclose(
                states[k + 1],
                step(system, states[k], start_inputs[k]),
                rtol=1e-7,
                atol=1e-9,
            )
        assert np.array_equal(states[0], state)
    for _, _, states in starts[4:]:  # which leads nowhere
        assert np.array_equal(states, np.tile(state, (H + 1, 1)))


def test_what_cannot_be_searched_is_refused():
    one = controller(pendulum(), [1.0, 0.01], [0.01], 30)
    for settings, message in (
        (
            {"turns": 0},
            "turns: must be whole numbers from 1 on, one for each of 1 angles",
        ),
        ({"turns": [1, 0]}, "turns: must be whole numbers"),
        ({"turns": 2.0}, "turns: must be whole numbers.*; got 2.0"),
        ({"budget": 0.0}, "budget: must be a number above 0"),
    ):
        with pytest.raises(SettingError, match=message):
            ManyStarts(one, **settings)
    settings = PredictionSettings("velocity", "none")
    paper = GPMPC(
        one.prediction.model,
        Linearization(),
        one.problem,
        30,
        one.initial_input,
        settings,
    )
    for key, parts in (("controller", (paper,)), ("planner", (one, paper))):
        with pytest.raises(SettingError, match=f"{key}: must be of form 'trajectory'"):
            ManyStarts(*parts)
    bare = ManyStarts(one)
    assert (bare.planner, bare.budget, bare.turns) == (one, None, [2])
    assert (bare.horizon, bare.problem) == (30, one.problem)


def test_kicks_push_every_input_to_both_sides_within_its_bounds():
    problem = Problem(
        Tracking([1.0], [1.0, 1.0, 1.0], penalized="inputs"),
        inputs=Box([0.0, -1.0, 0.3], [2.0, np.inf, 0.3]),
    )
    guesses = kicks(problem, 12, np.array([0.5, 0.0, 0.3]))
    assert [inputs[0, 0] for inputs in guesses] == [0.5, 1.25, 0.25]
    assert all(
        (inputs[:, 0] >= 0).all() and not inputs[:, 1].any() for inputs in guesses
    )
    assert [inputs[:6, 0].tolist() for inputs in guesses[1:]] == [
        [1.25, 1.25, 0.25, 0.25, 0.5, 0.5],
        [0.25, 0.25, 1.25, 1.25, 0.5, 0.5],
    ]
    whole = kicks(problem, 3, np.array([0.5, 0.0, 0.3]), share=1.0)[1]
    assert whole[:, 0].tolist() == [2.0, 0.0, 0.5]


@pytest.mark.parametrize("starts", [3, pytest.param(20, marks=pytest.mark.slow)])
def test_wild_starts_of_a_double_pendulum_break_no_solve(starts):
    # 2 joints x starts x 6 goals x 4 guesses: 960 solves, each iterated, over 1.2 s
    count = 0
    rng = np.random.default_rng(7)
    for actuated in ("elbow", "shoulder"):
        system = double_pendulum(actuated)
        one = controller(system, [10.0, 0.1, 10.0, 0.1], [0.01], 60, 20)
        many = ManyStarts(one, turns=(2, 3))
        for _ in range(starts):
            state = np.array(
                [
                    rng.uniform(-np.pi, np.pi),
                    rng.uniform(-15, 15),
                    rng.uniform(-np.pi, np.pi),
                    0.0,
                ]
            )
            state[3] = rng.uniform(-15, 15)
            for goal, *guess in list(
                many.starts.of(state, Reference(np.zeros(4)).over(60))
            )[:: 1 if starts > 3 else 5]:
                decision = one.control(Gaussian.certain(state), goal, plan=tuple(guess))
                count += 1
                assert (
                    decision.status in (Status.SOLVED, Status.ITERATION_LIMIT)
                    or decision.suboptimal
                ), decision.status
                assert np.isfinite(decision.inputs).all()
                assert np.isfinite(decision.means).all()
                assert np.abs(decision.inputs).max() <= 6.0 + 1e-9
    assert count == (960 if starts > 3 else 30)


def test_kicks_go_to_the_bounds_of_the_first_stage():
    upper = np.linspace(1.0, 2.0, 12)[:, None] * [1.0, 3.0]
    by_stage = Problem(Tracking([1.0], [1.0, 1.0]), Box(-upper, upper))
    first = Problem(Tracking([1.0], [1.0, 1.0]), Box(-upper[0], upper[0]))
    for guess, expected in zip(
        kicks(by_stage, 12, np.zeros(2)), kicks(first, 12, np.zeros(2)), strict=True
    ):
        assert np.array_equal(guess, expected)


def test_a_start_that_leaves_the_domain_of_an_output_is_no_start():
    system = pendulum()
    barrier = LeastSquares(lambda x: torch.log(4.0 - x[:, 1:]), [[1e-3]])
    one = controller(system, [1.0, 0.01], [0.01], 20, outputs=[barrier])
    loop = ControlLoop(ManyStarts(one))
    state = np.array(system.start)
    for _ in range(5):
        state = step(system, state, loop.input(state, np.zeros(2)))
        assert loop.last.decision.applicable
    for rate in (5.0, 50.0):  # beyond the domain, and nowhere near it
        beyond = loop.input(np.array([np.pi, rate]), np.zeros(2))
        assert np.isfinite(beyond).all()
    assert loop.last.decision.status is Status.FUNCTION_NOT_FINITE


def test_between_decisions_feedback_follows_the_plan():
    system = pendulum()
    fine = pendulum(time_step=system.time_step / 10)
    many = pendulums()
    loop = ControlLoop(many)
    plain = ControlLoop(many)
    with pytest.raises(SettingError, match="call input first"):
        loop.input_between(np.zeros(2), 0.5)
    state = np.array([0.05, 0.0])
    for one in (loop, plain):
        one.input(state, np.zeros(2))
    plan = loop.last.plan
    assert loop.input_between(plan.means[0], 0.0) == pytest.approx(plan.inputs[0])
    assert loop.input_between(plan.means[3], 3.0) == pytest.approx(plan.inputs[3])
    assert np.abs(loop.input_between(np.array([40.0, 90.0]), 0.5)).max() <= 2.0
    pushed = left = state + np.array([0.01, -0.1])
    for k in range(10):
        pushed = step(fine, pushed, loop.input_between(pushed, k / 10))
        left = step(fine, left, plain.last.input)
    K = many.gains(plan)[1]
    assert np.abs(K @ (pushed - plan.means[1])) < np.abs(K @ (left - plan.means[1]))
    with pytest.raises(ShapeError, match="state must have shape"):
        loop.input_between(np.zeros(3), 0.5)


def test_a_plan_that_cannot_be_improved_is_searched_for_anew():
    walls = [
        Box([-9.0, -9.0], [-8.0, 9.0], penalty=None)
    ]  # far from the state: no program of this controller succeeds
    walled = controller(pendulum(), [1.0, 0.01], [0.01], 30, constraints=walls)
    many = ManyStarts(walled, controller(pendulum(), [1.0, 0.01], [0.01], 30, 15))
    state = Gaussian.certain(np.array([1.0, 0.0]))
    reference = Reference(np.zeros(2))
    first = many.control(state, reference)
    assert many.control(state, reference, first).applicable


def test_plans_are_made_start_by_start_from_any_start_on():
    many = pendulums(3)
    belief = Gaussian.certain(np.array([np.pi, 0.3]))
    reference = Reference(np.zeros(2))
    every = list(many.plans(belief, reference))
    assert len(every) == len(many)
    later = list(many.plans(belief, reference, first=2))
    assert len({tuple(plan.inputs[:, 0]) for plan, _ in every}) > 2
    assert [value for _, value in later] == [value for _, value in every[2:]]
    assert all(
        np.array_equal(a.inputs, b.inputs)
        for (a, _), (b, _) in zip(later, every[2:], strict=True)
    )


def test_the_novelty_of_a_followed_flight_is_of_its_plan():
    problem = Problem(Tracking([1.0, 0.1], [0.05]), Box([-2.0], [2.0]))
    controller = GPMPC(pendulum_posterior(), Linearization(), problem, 8, [0.0])
    decision = ManyStarts(controller).control(
        Gaussian.certain(np.array([1.5, 0.0])), Reference(np.zeros(2))
    )
    measure = controller.novelty_when_read(
        decision.means, decision.inputs, decision.covariances
    )
    assert callable(measure)
    assert decision.novelty == pytest.approx(measure(), rel=1e-9)


def test_a_planner_of_another_horizon_is_refused():
    one = controller(pendulum(), [1.0, 0.01], [0.01], 10)
    longer = controller(pendulum(), [1.0, 0.01], [0.01], 12)
    with pytest.raises(SettingError, match=r"planner: .* horizon, 10; got 12"):
        ManyStarts(one, longer, guesses=[None])


def test_a_flight_of_a_model_with_a_past_is_followed():
    """What is added to its references moves on with the past, and is no goal."""
    late = DelayedModel(known_model(pendulum()), 1)
    cost = Tracking([1.0, 0.01], [0.01], penalized="inputs", angles=(0,))
    settings = PredictionSettings(covariance="none", rolled_out=True)
    problem = Problem(cost, inputs=Box([-2.0], [2.0]))
    one = GPMPC(late, Linearization(), problem, 20, [0.0], settings, iterations=3)
    many = CountedStarts(one, guesses=[None])
    fly(many, pendulum(), 3)
    assert many.searches == 1


def test_a_flight_through_a_state_without_slopes_is_flown():
    """An empty tank: the root of its level has a value there, and no slope."""

    def fill(x, u):
        return x + 0.1 * (u - torch.sqrt(torch.clamp(x, min=0.0)))

    problem = Problem(Tracking([1.0], [0.01]), inputs=Box([0.0], [2.0]))
    settings = PredictionSettings(covariance="none", rolled_out=True)
    one = GPMPC(KnownModel(fill, 1, 1), Linearization(), problem, 5, [0.0], settings)
    loop = ControlLoop(ManyStarts(one))
    assert 0.0 <= loop.input(np.zeros(1), np.array([0.5]))[0] <= 2.0


def test_a_followed_flight_says_what_it_misses():
    wall = Box([-9.0, -0.5], [9.0, 0.5], penalty=1.0)
    one = controller(pendulum(), [1.0, 0.01], [0.01], 20, constraints=[wall])
    loop = ControlLoop(ManyStarts(one, guesses=[None]))
    state = np.array([np.pi, 0.0])
    for _ in range(2):
        state = step(pendulum(), state, loop.input(state, np.zeros(2)))
    plan = loop.last.decision
    missed = np.abs(plan.means[1:, 1]).max() - 0.5
    assert missed > 0.1
    assert plan.violation == pytest.approx(missed)


def test_beliefs_that_gradients_run_through_are_beliefs():
    """``numpy()`` of such a tensor fails, as of one on another device."""
    many = pendulums(1)
    mean = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    belief = Gaussian(mean, torch.zeros(2, 2, dtype=torch.float64))
    reference = Reference(np.zeros(2))
    first = many.control(belief, reference)
    assert many.control(belief, reference, first).applicable
    with pytest.raises(ShapeError, match="state and reference must be of as many"):
        many.control(belief, Reference(np.zeros(3)))
