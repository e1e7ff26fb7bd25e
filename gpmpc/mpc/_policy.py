"""Applies the declared policy where a controller fails, and checks every input before it reaches a plant.

A failed iterate is never applied and never handed on: the next call gets the last plan that was applicable, shifted as
if it had been made one step ago, with what was really applied as its first input. A plan that is used up holds its last
input. Inputs beyond a bound by rounding are put onto it; others count as failed, whatever the status of a decision.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from scipy.interpolate import krogh_interpolate

from gpmpc._angles import full_turns
from gpmpc._arrays import read_array
from gpmpc._dynamics import to_array
from gpmpc.exceptions import (
    SettingError,
    ShapeError,
    SolverFailure,
    check_choice,
    check_number,
)
from gpmpc.gaussian import Gaussian
from gpmpc.mpc._controller import (
    Controller,
    Decision,
    Reference,
    Timing,
    read_reference,
)
from gpmpc.mpc._judgement import FlightJudge, Judgement
from gpmpc.mpc.problem import Problem
from gpmpc.signals import UNKNOWN, signals_of
from gpmpc.status import Status

OnFailure = Literal["previous_plan", "hold", "raise"]

_ROUNDING = 1e-4  # share of an input or of 1, whichever is more, by which a loose solver may miss a bound


@dataclass(frozen=True)
class Command:
    """What one step applies, and what the next one needs."""

    input: np.ndarray  #: applied (m,)
    #: how the step's own solve ended; ``INVALID_MEASUREMENT`` where the controller was not called,
    #: ``NUMERICAL_TROUBLE`` where it called a plan solved that must not reach a plant
    status: Status
    #: of the controller, with this status; None where it was not called or returned inputs of another shape
    decision: Decision | None
    #: the last applicable decision, shifted to this step; before the first one that is not, with what was applied as
    #: its ``input``; None where nothing was
    plan: Decision | None

    @property
    def failed(self) -> bool:
        """Whether the policy chose the input, not the decision."""
        return self.decision is None or not self.decision.applicable


def command(
    controller: Controller,
    belief: Gaussian,
    reference: Reference,
    last: Command | None = None,
    on_failure: OnFailure = "raise",
    step: int = 0,
    parameters: Any = None,
    plan: Any = None,
) -> Command:
    """Decides one step's input by a controller where the belief is finite, or by the policy where that has none.

    ``"previous_plan"`` goes on along the last applicable plan, ``"hold"`` keeps the last input applied, ``"raise"``
    stops. Before the first such plan, the first two take the reference's own input if there is one, else the
    controller's initial input, within its input and rate bounds. ``last`` is the command of the step before, None at
    the first; ``step`` is for the message; for parameters and plan see ``ControlLoop.input``.

    Raises:
        SolverFailure: The policy is ``"raise"``, or there is nothing to fall back on.
    """
    previous = None if last is None else last.plan
    reference = reference.over(controller.horizon)
    known = {
        key: value
        for key, value in (("parameters", parameters), ("plan", plan))
        if value is not None
    }
    decision = (
        controller.control(belief, reference, previous, **known)
        if _is_finite(belief)
        else None
    )
    return _conclude(controller, decision, reference, last, on_failure, step)


def commands(
    controller: Controller,
    beliefs: Sequence[Gaussian],
    reference: Reference,
    last: Sequence[Command | None],
    on_failure: OnFailure = "raise",
    step: int = 0,
) -> list[Command | SolverFailure]:
    """``command`` for many systems that follow one reference; where it would raise ``SolverFailure``, that instead.

    A controller with ``control_many`` is called once for all of them.
    """
    finite = [t for t, belief in enumerate(beliefs) if _is_finite(belief)]
    plans = [None if command is None else command.plan for command in last]
    many = getattr(controller, "control_many", None)
    if many is None:
        found = [controller.control(beliefs[t], reference, plans[t]) for t in finite]
    else:
        found = many(
            [beliefs[t] for t in finite],
            [reference] * len(finite),
            [plans[t] for t in finite],
        )
    decisions = dict(zip(finite, found, strict=True))
    outcomes: list[Command | SolverFailure] = []
    for t, before in enumerate(last):
        try:
            outcomes.append(
                _conclude(
                    controller, decisions.get(t), reference, before, on_failure, step
                )
            )
        except SolverFailure as failure:
            outcomes.append(failure)
    return outcomes


class ControlLoop:
    """Steers a plant that is not ours: holds what one step needs of the last, and returns an input that may be applied.

    What ``input`` returns is finite, and within the bounds and rates of the controller's problem, whatever happened: a
    measurement that is not finite, a program without a solution, an error of the numbers. Before the first plan that
    is the reference's input, or the controller's initial one.

    Args:
        controller: With a problem and an initial input.
        on_failure: ``"previous_plan"`` goes on along the last plan, ``"hold"`` keeps the last input, ``"raise"`` stops.

    Attributes:
        last: Command of the last step: its input, decision and status; None before the first.
        failures: Number of steps whose input the policy chose.
        judgement: Whether the last step was healthy, suspicious or lost, and why; None before the first.

    Raises:
        SettingError: No such policy.
    """

    def __init__(self, controller: Controller, on_failure: OnFailure = "previous_plan"):
        check_policy(on_failure)
        self.controller = controller
        self.on_failure: OnFailure = on_failure
        self.last: Command | None = None
        self.failures = 0
        self._steps = 0
        self.judgement: Judgement | None = None
        self._judge: FlightJudge | None = None
        self._before: Command | None = None  # the one before the last
        self._gains: tuple[Decision, np.ndarray] | None = (
            None  # of the last plan that they were needed of
        )

    def input(
        self, state: Any, reference: Any, parameters: Any = None, plan: Any = None
    ) -> np.ndarray:
        """Returns the input to apply now (m,).

        Args:
            state: Measured (n,), or a ``Gaussian``.
            reference: A set point (n,), states (H + 1, n), or a ``Reference``.
            parameters: Of the controller's outputs and smooth constraints, where it has any.
            plan: To start from in the place of the last one: inputs (H, m), or these and states (H + 1, n).

        Raises:
            ShapeError: State, reference, parameters or plan have other dimensions than the controller.
            SolverFailure: The policy is ``"raise"``.
        """
        belief = state
        if not isinstance(state, Gaussian):
            names = signals_of(self.controller).state_names
            belief = Gaussian.certain(read_array("state", state, names))
        wanted = read_reference(reference)
        if wanted.signals is not UNKNOWN:
            wanted = wanted.in_order(signals_of(self.controller))
        known = self.last, self.on_failure, self._steps, parameters, plan
        self._before = self.last
        self.last = command(self.controller, belief, wanted, *known)
        self.failures = self.failures + self.last.failed
        self._steps = self._steps + 1
        self.judgement = self._judged(belief, wanted, self.last)
        return self.last.input.copy()

    def _judged(self, belief: Gaussian, wanted: Reference, last: Command) -> Judgement:
        """The judgement of the last command."""
        measured = to_array(belief.mean)
        if self._judge is None:
            input_dim = len(last.input)
            self._judge = FlightJudge.of(self.controller, len(measured), input_dim)
        states = np.asarray(wanted.states, dtype=float)
        return self._judge.judge(measured, states, last.decision)

    def input_between(self, state: Any, share: float) -> np.ndarray:
        """Returns the input to apply until the next decision (m,): the plan's, corrected by its feedback.

        For plants that take inputs more often than there is time to decide. The feedback is that of the controller's
        method ``gains``, at the stage of the plan that the time falls into; a late decision goes on along the plan.

        Args:
            state: Measured (n,).
            share: Time since the last decision, in time steps of the controller.

        Raises:
            SettingError: Nothing was decided yet, or a share below zero.
            ShapeError: A state of another length.
        """
        if self.last is None or self.last.plan is None:
            raise SettingError("input_between", "needs a decision: call input first")
        check_number("share", share, least=0)
        plan = self.last.plan
        state = read_array("state", state, signals_of(self.controller).state_names)
        stage = min(int(share), len(plan.inputs) - 1)
        input = plan.inputs[stage]
        if state.shape != plan.means.shape[1:]:
            raise ShapeError(
                f"state must have shape {plan.means.shape[1:]}; got {state.shape}"
            )
        if np.isfinite(plan.means).all() and np.isfinite(state).all():
            if self._gains is None or self._gains[0] is not plan:
                gains = getattr(self.controller, "gains", None)
                none = np.zeros((*plan.inputs.shape, len(state)))
                self._gains = plan, none if gains is None else gains(plan)
            error = state - _state_along(plan.means, min(share, len(plan.inputs)))
            cost = getattr(getattr(self.controller, "problem", None), "cost", None)
            error -= full_turns(error, () if cost is None else cost.angles)
            input = input - self._gains[1][stage] @ error
        return _within_bounds(self.controller, input, self._before)

    def warm_up(self, state: Any, reference: Any, parameters: Any = None) -> None:
        """Decides twice and forgets it, so that everything is compiled before the loop starts."""
        rehearsal = ControlLoop(self.controller, "previous_plan")
        for _ in range(2):
            rehearsal.input(state, reference, parameters)


def _state_along(states: np.ndarray, time: float) -> np.ndarray:
    """The state (n,) at a time in steps from s_0 on, by the cubic through the four nearest of s_0 .. s_H (H + 1, n)."""
    count = min(4, len(states))
    first = min(max(int(time) - 1, 0), len(states) - count)
    nodes = np.arange(first, first + count)
    return krogh_interpolate(nodes, states[nodes], time)


def check_policy(on_failure: str) -> None:
    """Raises ``SettingError`` unless there is such a policy."""
    check_choice("on_failure", on_failure, get_args(OnFailure))


def _is_finite(belief: Gaussian) -> bool:
    return bool(
        torch.isfinite(belief.mean).all() and torch.isfinite(belief.covariance).all()
    )


def _conclude(
    controller: Controller,
    decision: Decision | None,
    reference: Reference,
    last: Command | None,
    on_failure: OnFailure,
    step: int,
) -> Command:
    """The command of a decision; of none, where the controller was not called."""
    status = Status.INVALID_MEASUREMENT if decision is None else decision.status
    reason = status.advice
    if decision is not None and decision.applicable:
        fits = _has_right_shape(controller, decision, last)
        if fits and (checked := _admit(controller, decision, last)) is not None:
            return Command(checked.input, status, checked, checked)
        reason = f"its plan, {status.name}, is not finite or out of its bounds or shape; its input: {decision.input}"
        status = Status.NUMERICAL_TROUBLE
        decision = replace(decision, status=status, suboptimal=False) if fits else None
    if on_failure == "raise":
        raise SolverFailure(step, reason)
    if last is not None and last.plan is not None and last.plan.applicable:
        rows = (plan := last.plan).inputs, plan.means, plan.covariances
        inputs, means, covariances = (
            np.concatenate([part[1:], part[-1:]]) for part in rows
        )
        first = last.input if on_failure == "hold" else inputs[0]
        shifted = replace(
            _with_first(plan, inputs, first), means=means, covariances=covariances
        )
        if (admitted := _admit(controller, shifted, last)) is not None:
            return Command(admitted.input, status, decision, admitted)
    known = (
        getattr(controller, "initial_input", None)
        if reference.inputs is None
        else reference.inputs[0]
    )
    if known is None or not np.isfinite(known).all():
        raise SolverFailure(
            step, f"{reason} (no earlier plan and no reference input to fall back on)"
        )
    input = _within_bounds(controller, np.array(known, dtype=float), last)
    H = reference.horizon
    n = reference.states.shape[1]
    unknown = np.full((H + 1, n), np.nan), np.full((H + 1, n, n), np.nan)
    return Command(
        input,
        status,
        decision,
        Decision(input, np.tile(input, (H, 1)), *unknown, status, 0, Timing()),
    )


def _has_right_shape(
    controller: Controller, decision: Decision, last: Command | None
) -> bool:
    """Whether the inputs of a decision have the shapes (m,) and (H, m)."""
    problem = getattr(controller, "problem", None)
    m = (
        problem.input_dim
        if isinstance(problem, Problem)
        else (decision if last is None else last).input.size
    )
    return (
        decision.input.shape == (m,) == np.shape(decision.inputs)[1:]
        and len(decision.inputs) > 0
    )


def _admit(
    controller: Controller, plan: Decision, last: Command | None
) -> Decision | None:
    """A plan, its first input put onto the bounds that it misses by rounding; None where it must not be applied."""
    input = _within_bounds(controller, plan.input, last)
    off = np.abs(input - plan.input)
    if (
        not (off <= _ROUNDING * np.maximum(1.0, np.abs(input))).all()
        or not np.isfinite(plan.inputs).all()
    ):
        return None  # off is NaN where an input is not finite
    return _with_first(plan, plan.inputs, input) if off.any() else plan


def _within_bounds(
    controller: Controller, input: np.ndarray, last: Command | None
) -> np.ndarray:
    """The nearest input in the box of the controller's problem, where it has one, and among these within its rates."""
    problem = getattr(controller, "problem", None)
    if not isinstance(problem, Problem):
        return input
    before = getattr(controller, "initial_input", None) if last is None else last.input
    if before is not None:
        down, up = problem.input_rates.first
        input = np.minimum(np.maximum(input, before + down), before + up)
    low, high = problem.inputs.first
    return np.minimum(np.maximum(input, low), high)


def _with_first(plan: Decision, inputs: np.ndarray, first: np.ndarray) -> Decision:
    return replace(plan, input=first, inputs=np.concatenate([first[None], inputs[1:]]))
