"""What reaches a plant is finite and within box and rates, or the policy acts.

It does so whatever a controller says.
"""

import numpy as np
import pytest

from gpmpc.exceptions import ShapeError, SolverFailure
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Box, ControlLoop, Decision, Problem, Reference, Timing, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Cascade, ModelLoop, cascade_loop, closed_loop, closed_loops
from gpmpc.status import Status
from gpmpc.systems import Coupled, System
from tests.mpc.systems import QUADROTOR, quadrotor_gp

H = 3
STEPS = 12
LOWER = np.array([5.0, -0.2, -0.2])
UPPER = np.array([9.0, 0.2, 0.2])
RATE = np.array([0.5, 0.1, 0.1])
PROBLEM = Problem(
    Tracking([1] * 6, [1] * 3), inputs=Box(LOWER, UPPER), input_rates=Box(-RATE, RATE)
)
FIRST = np.array([7.0, 0.0, 0.0])
FAR = np.array(
    [1e6, 1.0, 1.0]
)  # the inputs that belong to the reference, outside of everything
REFERENCES = Reference(np.zeros((STEPS + H, 6)), np.tile(FAR, (STEPS + H - 1, 1)))
START = np.zeros(6)
NOTHING = (np.zeros((H + 1, 6)), np.zeros((H + 1, 6, 6)))


def spoilt(plan, row, column, value):
    plan = plan.copy()
    plan[row, column] = value
    return plan


LIES = {
    "nan": lambda plan: spoilt(plan, 0, 1, np.nan),
    "infinite": lambda plan: spoilt(plan, 0, 0, np.inf),
    "minus infinite": lambda plan: spoilt(plan, 0, 2, -np.inf),
    "nan later": lambda plan: spoilt(plan, -1, 0, np.nan),
    "above the box": lambda plan: spoilt(plan, 0, 0, UPPER[0] + 0.01),
    "below the box": lambda plan: spoilt(plan, 0, 1, -1e9),
    "a leap": lambda plan: spoilt(
        plan, 0, 0, plan[0, 0] + (0.8 if plan[0, 0] < 7 else -0.8)
    ),
    "two inputs": lambda plan: plan[:, :2],
    "four inputs": lambda plan: np.hstack([plan, plan[:, :1]]),
    "none": lambda plan: plan[:, :0],
}


class Liar:
    """Moves its inputs about within box and rates.

    It calls its plans solved, ``lies`` (steps to kinds) too.
    """

    horizon = H
    problem = PROBLEM
    initial_input = FIRST

    def __init__(self, lies=(), status=Status.SOLVED):
        self.lies = dict(lies)
        self.calls = 0
        self.status = status
        self.draws = np.random.default_rng(0)

    def control(self, belief, reference, previous=None):
        k = self.calls
        self.calls = self.calls + 1
        plan = [self.initial_input if previous is None else previous.input]
        for _ in range(H):
            plan.append(
                np.clip(
                    plan[-1] + RATE * self.draws.uniform(-0.9, 0.9, 3), LOWER, UPPER
                )
            )
        plan = (
            LIES[self.lies[k]](np.array(plan[1:]))
            if k in self.lies
            else np.array(plan[1:])
        )
        means = np.tile(belief.mean.numpy(), (H + 1, 1))
        covariances = np.zeros((H + 1, 6, 6))
        suboptimal = not self.status.solved
        return Decision(
            plan[0],
            plan,
            means,
            covariances,
            self.status,
            1,
            Timing(0.0, 0.0, 0.0),
            suboptimal=suboptimal,
        )


def check(inputs):
    assert np.isfinite(inputs).all()
    assert (inputs >= LOWER).all()
    assert (inputs <= UPPER).all()
    assert (np.abs(np.diff(np.vstack([FIRST, inputs]), axis=0)) <= RATE + 1e-12).all()


@pytest.mark.parametrize(
    "status", [Status.SOLVED, Status.ITERATION_LIMIT], ids=["solved", "suboptimal"]
)
@pytest.mark.parametrize("policy", ["previous_plan", "hold"])
@pytest.mark.parametrize(
    "system",
    [QUADROTOR, ModelLoop(quadrotor_gp(10), Linearization())],
    ids=["plant", "model"],
)
def test_in_a_loop_no_lie_is_applied(system, policy, status):
    for shift, kinds in enumerate((list(LIES), list(LIES)[::-1])):
        lies = {
            k + shift: kind for k, kind in enumerate(kinds)
        }  # from the first step on, and after a good one
        flight = closed_loop(
            system, Liar(lies, status), REFERENCES, START, STEPS, on_failure=policy
        )
        check(flight.inputs)
        assert flight.failures == tuple(
            (k, Status.NUMERICAL_TROUBLE) for k in sorted(lies)
        )
        assert flight.suboptimal == (
            () if status.solved else tuple(sorted(set(range(STEPS)) - set(lies)))
        )
        assert np.isnan(flight.predicted_means[sorted(lies)]).all()
        assert np.isfinite(
            np.delete(flight.predicted_means, sorted(lies), axis=0)
        ).all()


def test_in_a_cascade_no_lie_is_applied_by_either_controller():
    cascade = Cascade(
        Liar({0: "nan", 2: "a leap"}),
        Liar({0: "two inputs", 3: "infinite", 4: "above the box"}),
        2,
    )
    plant = System(Coupled(), 0.05, 1)
    flight = cascade_loop(
        plant, cascade, REFERENCES, np.zeros(12), 4, on_failure="hold"
    )
    check(flight.outer.inputs)
    assert [k for k, _ in flight.outer.failures] == [0, 2]
    assert [k for k, _ in flight.inner.failures] == [0, 3, 4]
    assert np.isfinite(flight.inputs).all()
    assert (flight.inner.inputs[1:] >= LOWER).all()


@pytest.mark.parametrize("kind", LIES)
def test_many_at_once_are_looked_at_one_by_one(kind):
    class Crowd(Liar):
        def control_many(self, beliefs, references, previous):
            return [
                self.control(*question)
                for question in zip(beliefs, references, previous, strict=True)
            ]

    for controller in (Liar({4: kind}), Crowd({4: kind})):
        flown = closed_loops(
            QUADROTOR, controller, REFERENCES, START, STEPS, 3, on_failure="hold"
        )
        for trial in flown:
            check(trial.result.inputs)
        assert [len(trial.result.failures) for trial in flown] == [
            0,
            1,
            0,
        ]  # the second trial's second step


@pytest.mark.parametrize("kind", LIES)
def test_a_loop_of_ones_own_is_stopped_where_the_policy_says_so(kind):
    state = Gaussian.certain(START)
    reference = Reference(REFERENCES.states[: H + 1])
    stopped = ControlLoop(Liar({2: kind}), "raise")
    for _ in range(2):
        stopped.input(state, reference)
    with pytest.raises(
        SolverFailure,
        match="step 2: its plan, SOLVED, is not finite or out of its bounds or shape",
    ):
        stopped.input(state, reference)
    together = [np.zeros((H + 1, 6)), START, 1, 1]
    (first,) = closed_loops(QUADROTOR, Liar({0: kind}), *together, on_failure="hold")
    assert len(first.result.failures) == 1
    # there is nothing else to hold
    assert np.array_equal(first.result.inputs[0], Liar.initial_input)
    loop = ControlLoop(Liar(), "hold")
    good = loop.input(state, reference)
    assert not loop.last.failed
    loop.controller = Liar({0: kind})
    assert np.array_equal(loop.input(state, reference), good)
    assert loop.last.failed
    assert loop.last.status is Status.NUMERICAL_TROUBLE
    assert loop.last.decision is None or not loop.last.decision.applicable


def test_what_misses_a_bound_by_rounding_is_put_onto_it():
    class Loose(Liar):
        def control(self, belief, reference, previous=None):
            plan = np.tile(np.array([7.5, 0.1, -0.1]) + 1e-7, (H, 1))
            return Decision(
                plan[0],
                plan,
                np.zeros((H + 1, 6)),
                np.zeros((H + 1, 6, 6)),
                Status.SOLVED,
                1,
                Timing(0.0, 0.0, 0.0),
            )

    loop = ControlLoop(Loose(), "raise")
    loop.input(Gaussian.certain(START), Reference(REFERENCES.states[: H + 1]))
    command = loop.last
    assert command.input.tolist() == [7.5, 0.1, -0.1 + 1e-7]
    assert (
        command.plan.inputs[0].tolist()
        == command.plan.input.tolist()
        == command.input.tolist()
    )
    assert not command.failed


def test_a_non_finite_reference_is_no_fallback():
    lost = Gaussian.certain(START * np.nan)
    reference = Reference(REFERENCES.states[: H + 1], np.full((H, 3), np.nan))
    held = ControlLoop(Liar(), "hold").input(lost, reference)
    assert np.array_equal(held, Liar.initial_input)
    controller = Liar()
    controller.initial_input = None
    with pytest.raises(SolverFailure, match="no reference input to fall back on"):
        ControlLoop(controller, "hold").input(lost, reference)


def test_without_declared_bounds_inputs_are_finite_and_as_many():
    class Foreign(Liar):
        problem = initial_input = None

        def control(self, belief, reference, previous=None):
            plan = np.full((H, 3), 1e3)
            plan = (
                LIES[self.lies[self.calls]](plan) if self.calls in self.lies else plan
            )
            self.calls += 1
            return Decision(
                plan[0],
                plan,
                np.zeros((H + 1, 6)),
                np.zeros((H + 1, 6, 6)),
                Status.SOLVED,
                1,
                Timing(0.0, 0.0, 0.0),
            )

    flight = closed_loop(
        QUADROTOR,
        Foreign({2: "nan", 3: "two inputs"}),
        REFERENCES,
        START,
        4,
        on_failure="hold",
    )
    assert np.array_equal(flight.inputs, np.full((4, 3), 1e3))
    assert [k for k, _ in flight.failures] == [2, 3]
    with pytest.raises(
        ShapeError, match=r"the plant takes inputs of shape \(3,\); got \(2,\)"
    ):
        closed_loop(QUADROTOR, Foreign({0: "two inputs"}), REFERENCES, START, 4)


def test_a_recorder_is_told_that_the_policy_chose_the_input():
    lies = {1: "nan", 3: "two inputs"}
    steps = []
    closed_loop(
        QUADROTOR,
        Liar(lies),
        REFERENCES,
        START,
        5,
        on_failure="hold",
        on_step=steps.append,
    )
    assert [step.failed for step in steps] == [False, True, False, True, False]
    assert [step.status.solved for step in steps] == [True, False, True, False, True]
    assert [step.decision is None for step in steps] == [
        False,
        False,
        False,
        True,
        False,
    ]
    steps.clear()
    closed_loop(
        QUADROTOR,
        Liar(status=Status.TIME_LIMIT),
        REFERENCES,
        START,
        5,
        on_step=steps.append,
    )
    assert not any(step.failed for step in steps)
    assert np.isfinite(steps[1].innovation).all()
