from dataclasses import replace

import numpy as np
import pytest

from gpmpc.exceptions import SettingError, SolverFailure
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Box, ControlLoop, Decision, Problem, Reference, Timing, Tracking
from gpmpc.status import Status

STATE = Gaussian.certain(np.zeros(1))
FAR = Reference(np.zeros((5, 1)))
LOST = Gaussian.certain(np.array([np.nan]))


class Planner:
    """Plans (10 k, 10 k + 1, ..) at call k; the failing ones plan 666."""

    horizon = 4

    def __init__(self, *failing):
        self.failing = failing
        self.previous = []

    def control(self, belief, reference, previous=None):
        k = len(self.previous)
        self.previous.append(previous)
        failed = k in self.failing
        inputs = (
            np.full((4, 1), 666.0) if failed else 10.0 * k + np.arange(4.0)[:, None]
        )
        means = np.arange(5.0)[:, None] + 100 * k
        covariances = np.arange(5.0)[:, None, None] + 100 * k
        status = Status.ITERATION_LIMIT if failed else Status.SOLVED
        return Decision(
            inputs[0], inputs, means, covariances, status, 1, Timing(0.0, 0.0, 0.0)
        )


def run(planner, steps, on_failure, beliefs=None, reference=FAR):
    loop = ControlLoop(planner, on_failure)
    commands = []
    for k in range(steps):
        applied = loop.input(beliefs[k] if beliefs else STATE, reference)
        assert np.array_equal(applied, loop.last.input)
        commands.append(loop.last)
    return commands


def test_the_previous_plan_goes_on_and_holds_its_last_input():
    commands = run(Planner(2, 3, 4, 5, 6), 8, "previous_plan")
    assert [c.input[0] for c in commands] == [0, 10, 11, 12, 13, 13, 13, 70]


def test_hold_keeps_the_last_input_that_was_applied():
    commands = run(Planner(2, 3, 4), 6, "hold")
    assert [c.input[0] for c in commands] == [0, 10, 10, 10, 10, 50]


@pytest.mark.parametrize("on_failure", ["previous_plan", "hold"])
def test_a_failed_iterate_is_never_handed_on(on_failure):
    planner = Planner(1, 2, 5)
    commands = run(planner, 8, on_failure)
    assert all(
        p is None or (p.status.solved and not (p.inputs == 666).any())
        for p in planner.previous
    )
    assert [c.status.solved for c in commands] == [k not in (1, 2, 5) for k in range(8)]
    assert commands[1].decision.status is Status.ITERATION_LIMIT


def test_the_next_warm_start_is_the_last_solved_plan_shifted():
    planner = Planner(1, 2)
    run(planner, 4, "previous_plan")
    aged = planner.previous[
        3
    ]  # made at step 0, two steps of which have gone by when step 2 is over
    assert aged.inputs[:, 0].tolist() == [2, 3, 3, 3]
    assert aged.input[0] == 2  # what step 2 applied
    assert aged.means[:, 0].tolist() == [2, 3, 4, 4, 4]
    assert aged.covariances[:, 0, 0].tolist() == [2, 3, 4, 4, 4]


def test_a_held_input_begins_the_next_warm_start():
    planner = Planner(1)
    run(planner, 3, "hold")
    assert planner.previous[2].inputs[:, 0].tolist() == [0, 2, 3, 3]
    assert planner.previous[2].input[0] == 0


def test_a_non_finite_state_never_reaches_the_controller():
    planner = Planner()
    infinite = Gaussian(STATE.mean, STATE.covariance + np.inf)
    commands = run(planner, 4, "previous_plan", [STATE, LOST, infinite, STATE])
    assert len(planner.previous) == 2
    assert [c.status for c in commands[1:3]] == [Status.INVALID_MEASUREMENT] * 2
    assert [c.input[0] for c in commands] == [0, 1, 2, 10]
    assert commands[1].decision is None


def test_before_a_plan_the_reference_input_applies_or_it_stops():
    reference = Reference(np.zeros((5, 1)), np.full((4, 1), 7.0))
    assert [c.input[0] for c in run(Planner(0, 1), 3, "hold", reference=reference)] == [
        7,
        7,
        20,
    ]
    with pytest.raises(
        SolverFailure, match="step 0: .* no reference input to fall back on"
    ):
        run(Planner(0), 1, "previous_plan")


def test_raise_stops_at_the_step():
    with pytest.raises(SolverFailure, match="step 1: stopped at the iteration limit"):
        run(Planner(1), 3, "raise")
    with pytest.raises(
        SolverFailure, match="step 0: the state is not finite: check the estimator"
    ):
        run(Planner(), 1, "raise", [LOST])


def test_a_misspelt_policy_is_refused():
    with pytest.raises(
        SettingError,
        match="on_failure: must be one of 'previous_plan', 'hold', 'raise'; got 'held'",
    ):
        ControlLoop(Planner(), "held")


def test_before_the_first_plan_the_reference_input_is_applied():
    planner = Planner()
    planner.problem = Problem(
        Tracking([1.0], [1.0], penalized="inputs"), inputs=Box([-2.0], [2.0])
    )
    reference = Reference(np.zeros((5, 1)), np.full((4, 1), 5.0))
    commands = run(planner, 3, "previous_plan", [LOST, LOST, STATE], reference)
    assert [c.input[0] for c in commands] == [2, 2, 0]
    handed_on = planner.previous[0]
    assert handed_on.input[0] == 2
    assert not handed_on.status.solved


@pytest.mark.parametrize("on_failure", ["previous_plan", "hold"])
def test_before_a_plan_each_step_applies_its_reference_input(on_failure):
    """What was applied for want of a plan is no plan, and is not gone on along."""
    planner = Planner(0, 1, 2)
    loop = ControlLoop(planner, on_failure)
    applied = []
    for k in range(4):
        reference = Reference(np.zeros((5, 1)), 100.0 + k + np.arange(4.0)[:, None])
        applied.append(loop.input(STATE, reference)[0])
    assert applied == [100, 101, 102, 30]
    assert loop.last.plan.status.solved


class Odd(Planner):
    """Its failing decisions are of another shape; its predictions, too, if asked."""

    def __init__(self, *failing, inputs=(4, 1), means=(5, 1), status=Status.SOLVED):
        super().__init__(*failing)
        self.shapes = (inputs, means)
        self.status = status

    def control(self, belief, reference, previous=None):
        k = len(self.previous)
        decision = super().control(belief, reference, previous)
        if k not in self.failing:
            return decision
        inputs, means = (np.ones(shape) for shape in self.shapes)
        return replace(
            decision,
            input=inputs[0] if len(inputs) else np.empty(0),
            inputs=inputs,
            means=means,
            status=self.status,
        )


@pytest.mark.parametrize(
    ("change", "status", "input"),
    [
        ({"inputs": (0, 1), "status": Status.INFEASIBLE}, Status.INFEASIBLE, 11),
        ({"inputs": (4, 2), "status": Status.INFEASIBLE}, Status.INFEASIBLE, 11),
        ({"inputs": (4, 2)}, Status.NUMERICAL_TROUBLE, 11),
        ({"means": (0, 1)}, Status.SOLVED, 1),
        ({"means": (1, 1)}, Status.SOLVED, 1),
        ({"means": (5, 2)}, Status.SOLVED, 1),
    ],
)
def test_a_decision_of_another_shape_costs_no_input(change, status, input):
    """Inputs that predict nothing are applied; the step after may go on along them."""
    loop = ControlLoop(Odd(2, **change))
    for _ in range(3):
        applied = loop.input(np.zeros(1), np.zeros(1))
    assert applied.tolist() == [input]
    assert loop.last.status is status
    assert (loop.last.decision is None) == ("inputs" in change)
    goes_on = loop.input([np.nan], np.zeros(1))
    assert goes_on.tolist() == [12 if input == 11 else 1]
    assert np.isfinite(loop.input_between([0.0], 0.5)).all()


def test_a_reference_input_that_is_not_finite_is_none():
    planner = Planner()
    planner.initial_input = np.array([3.0])
    reference = Reference(np.zeros((5, 1)), np.full((4, 1), np.nan))
    (command,) = run(planner, 1, "previous_plan", [LOST], reference)
    assert command.input == pytest.approx([3.0])
