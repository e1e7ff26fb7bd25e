"""Applies the declared policy where a controller fails, and checks every input.

A failed iterate is never applied and never handed on: the next call gets the last plan
that was applicable, shifted as if it had been made one step ago, with what was really
applied as its first input. A plan that is used up holds its last input. Inputs beyond a
bound by rounding are put onto it; others count as failed, whatever the status of a
decision.

To add a policy, such as one that holds the input for three steps and then follows an
LQR: name it in ``OnFailure``, which ``check_policy`` and the settings of loops and
studies read; choose its input in ``_input_of_policy``, and what is applied between
decisions in ``ControlLoop.input_between``; and tell of it in ``decide`` and there. A
``Command`` holds the last plan alone: what a policy counts or remembers is to be a
field of it. A policy that asks another controller needs that beside the name; what is
known of the state is ``situation.belief``.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from inspect import Parameter, signature
from typing import Any, Literal, get_args

import numpy as np
from scipy.interpolate import krogh_interpolate

from gpmpc._angles import full_turns
from gpmpc._arrays import is_measured, read_array
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import to_array
from gpmpc.exceptions import (
    SettingError,
    ShapeError,
    SolverFailure,
    check_choice,
    check_method,
    check_number,
)
from gpmpc.gaussian import Gaussian
from gpmpc.mpc._control_step import rare_kernels_loaded
from gpmpc.mpc._controller import (
    Controller,
    Decision,
    ParametersNotFinite,
    Reference,
    Timing,
    is_usable_belief,
    one_step_on,
    read_reference,
)
from gpmpc.mpc._judgement import FlightJudge, Judgement
from gpmpc.mpc._past import Situation, plan_of_first_states
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc.problem import Problem
from gpmpc.signals import UNKNOWN, signals_of
from gpmpc.status import Status

OnFailure = Literal["previous_plan", "hold", "raise"]

# Share of an input, or of 1 if that is more, by which a loose solver may miss a bound.
_ROUNDING = 1e-4


@dataclass(frozen=True)
class Command:
    """What one step applies, and what the next one needs."""

    input: np.ndarray  #: applied (m,)
    #: how the step's own solve ended; ``INVALID_MEASUREMENT`` where the controller was
    #: not called, ``NUMERICAL_TROUBLE`` where it called a plan solved that must not
    #: reach a plant
    status: Status
    #: of the controller, with this status; None where it was not called or returned
    #: inputs of another shape. A prediction of another shape is NaN
    decision: Decision | None
    #: the decision that the next step goes on from, not its plan alone: the one that is
    #: applied now, or the last applicable one, shifted to this step. Before any was:
    #: one that is not applicable, whose ``input`` is what was applied. None where
    #: nothing was
    plan: Decision | None
    #: that the step began in (n,), of a model whose state holds its past; None of
    #: others. Means of ``plan`` are of all of this state, those of ``decision`` of its
    #: first entries, which are measured
    state: np.ndarray | None = None

    @property
    def failed(self) -> bool:
        """Whether the policy chose the input, not the decision."""
        return self.decision is None or not self.decision.applicable


def decide(
    controller: Controller,
    belief: Gaussian,
    reference: Reference,
    last: Command | None = None,
    on_failure: OnFailure = "raise",
    step: int = 0,
    parameters: Any = None,
    plan: Any = None,
) -> Command:
    """Decides one step's input: by the controller, or by the policy where that fails.

    ``"previous_plan"`` goes on along the last applicable plan, ``"hold"`` keeps the
    last input applied once there is such a plan, ``"raise"`` stops. Before it, the
    first two take the reference's own input if there is one, else the controller's
    initial input, within its input and rate bounds.

    Args:
        controller: It is called where the belief is finite and below 1e30 in size;
            beyond are marks of sensors that saw nothing, such as 3.4e38. What it
            decides counts where the parameters are finite.
        belief: What is known of the state.
        reference: Over the horizon, or a set point.
        last: Command of the step before; None at the first.
        on_failure: The policy.
        step: Number of the step, for messages.
        parameters: As for ``ControlLoop.input``; not handed over where it is None.
        plan: Likewise.

    Raises:
        SettingError: The controller takes no parameters, or no plan.
        SolverFailure: The policy is ``"raise"``, or there is nothing to fall back on.
    """
    reference = reference.over(controller.horizon)
    options: dict[str, Any] = {}
    if parameters is not None:
        options["parameters"] = parameters
    if plan is not None:
        options["plan"] = plan
    situation = _situation(controller, belief, reference, last)
    decision = None
    if _is_usable(situation.belief):
        previous = None if last is None else last.plan
        # What parameters say, such as where an obstacle is, is measured, too.
        with suppress(ParametersNotFinite):
            decision = _control(
                controller, situation.belief, situation.reference, previous, options
            )
    return _conclude(controller, decision, situation, last, on_failure, step)


def _control(
    controller: Controller,
    belief: Gaussian,
    reference: Reference,
    previous: Decision | None,
    options: dict[str, Any],
) -> Decision:
    """Calls a controller, with parameters or a plan where there are some.

    Raises:
        SettingError: It takes none.
    """
    try:
        return controller.control(belief, reference, previous, **options)
    except TypeError as error:
        accepted = signature(controller.control).parameters
        takes_all = any(p.kind is Parameter.VAR_KEYWORD for p in accepted.values())
        for key in options:
            if key not in accepted and not takes_all:
                rule = f"is nothing that {type(controller).__name__}.control takes"
                raise SettingError(key, rule) from error
        raise


def _situation(
    controller: Controller, belief: Gaussian, reference: Reference, last: Command | None
) -> Situation:
    """Returns what one step's decision is made on."""
    return Situation.of(
        controller,
        belief,
        reference,
        last_state=None if last is None else last.state,
        last_input=None if last is None else last.input,
    )


def decide_many(
    controller: Controller,
    beliefs: Sequence[Gaussian],
    reference: Reference,
    last: Sequence[Command | None],
    on_failure: OnFailure = "raise",
    step: int = 0,
) -> list[Command | SolverFailure]:
    """Decides for many systems that follow one reference; see ``decide``.

    Where that would raise ``SolverFailure``, the error is returned instead. A
    controller whose ``control_many`` belongs to its ``control`` is called once for all
    of them.
    """
    reference = reference.over(controller.horizon)
    situations = [
        _situation(controller, belief, reference, command)
        for belief, command in zip(beliefs, last, strict=True)
    ]
    finite = [i for i, one in enumerate(situations) if _is_usable(one.belief)]
    plans = [None if command is None else command.plan for command in last]
    if len(beliefs) == 1 or not _decides_together(controller):
        decided = [
            controller.control(situations[i].belief, situations[i].reference, plans[i])
            for i in finite
        ]
    else:
        together: Any = controller
        decided = together.control_many(
            [situations[i].belief for i in finite],
            [situations[i].reference for i in finite],
            [plans[i] for i in finite],
        )
    decisions = dict(zip(finite, decided, strict=True))
    commands: list[Command | SolverFailure] = []
    for i, last_command in enumerate(last):
        try:
            command: Command | SolverFailure = _conclude(
                controller,
                decisions.get(i),
                situations[i],
                last_command,
                on_failure,
                step,
            )
        except SolverFailure as failure:
            command = failure
        commands.append(command)
    return commands


def _decides_together(controller: Controller) -> bool:
    """Tells whether ``control_many`` decides as ``control`` does.

    It does not where the latter was overridden alone: by a class below, by an attribute
    of the object, or by a wrapper that hands all else on to what it wraps.
    """
    own = getattr(controller, "__dict__", {})
    for names in (own, *map(vars, type(controller).__mro__)):
        if "control_many" in names:
            return True
        if "control" in names:
            return False
    return False


@explains_arguments
class ControlLoop:
    """Steers a plant that is not ours, step by step.

    It holds what one step needs of the last. What ``input`` returns is finite, within
    the bounds of the controller's problem and, where these allow it, its rates,
    whatever happened: a measurement that is not finite or 1e30 or more in size,
    parameters that are not finite, a program without a solution, an error of the
    numbers. Before the first plan that is the reference's input, or the controller's
    initial one.

    Args:
        controller: With a problem and an initial input. All states that ``input`` is
            told are judged, such as a disturbance of a filter's belief; where the
            problem is of more, those that are told, the first ones.
        on_failure: ``"previous_plan"`` goes on along the last plan, ``"hold"`` keeps
            the last input, ``"raise"`` stops: what is applied then is not known here,
            and another flight takes a loop of its own.

    Attributes:
        last: Command of the last step: its input, decision and status; None before the
            first.
        failures: Number of steps whose input the policy chose.
        judgement: Whether the last step was healthy, suspicious or lost, and why; None
            before the first.

    Raises:
        SettingError: No such policy.

    See Also:
        ``gpmpc.simulation.closed_loop``, which does the same with a plant of this
        package; the guide "Your own loop".
    """

    def __init__(self, controller: Controller, on_failure: OnFailure = "previous_plan"):
        check_policy(on_failure)
        check_method("controller", controller, "control", "GPMPC(...)")
        self.controller = controller
        self.on_failure: OnFailure = on_failure
        self.last: Command | None = None
        self.failures = 0
        self.judgement: Judgement | None = None
        self._steps = 0
        self._judge: FlightJudge | None = None
        self._command_before: Command | None = None
        # Of the last state; plans may be of more. None before the first call.
        self._measured_dim: int | None = None
        self._parameters: Any = None  # of the last call
        # The last plan whose feedback was needed, and its gains (H, m, n).
        self._gains: tuple[Decision, np.ndarray] | None = None

    def input(
        self, state: Any, reference: Any, parameters: Any = None, plan: Any = None
    ) -> np.ndarray:
        """Returns the input to apply now (m,).

        Args:
            state: Measured (n,), or a ``Gaussian``.
            reference: A set point (n,), states (H + 1, n), or a ``Reference``.
            parameters: Of the controller's outputs and smooth constraints, where it has
                any.
            plan: To start from in the place of the last one: inputs (H, m), or these
                and states (H + 1, n); for controllers that take one.

        Raises:
            ShapeError: State, reference, parameters or plan have other dimensions than
                the controller.
            DataError: A reference, or a plan, that is not finite.
            SettingError: The controller takes no parameters, or no plan.
            SolverFailure: The policy is ``"raise"``.
        """
        signals = signals_of(self.controller)
        if isinstance(state, Gaussian):
            belief = state.in_order(signals.state_names)
        else:
            mean = read_array("state", state, signals.state_names)
            belief = Gaussian.certain(mean)
        followed = read_reference(reference)
        if followed.signals is not UNKNOWN:
            followed = followed.in_order(signals)
        self._measured_dim = belief.mean.shape[-1]
        command = decide(
            self.controller,
            belief,
            followed,
            last=self.last,
            on_failure=self.on_failure,
            step=self._steps,
            parameters=parameters,
            plan=plan,
        )
        self._command_before = self.last
        self._parameters = parameters
        self.last = command
        self.failures = self.failures + command.failed
        self._steps = self._steps + 1
        self.judgement = self._judge_step(belief, followed, command)
        return command.input.copy()

    def _judge_step(
        self, belief: Gaussian, reference: Reference, command: Command
    ) -> Judgement:
        """Returns the judgement of a command: of the states that its problem weighs."""
        measured = to_array(belief.mean)
        if self._judge is None:
            self._judge = FlightJudge.of(
                self.controller,
                state_dim=len(measured),
                input_dim=len(command.input),
            )
        states = np.asarray(reference.states, dtype=float)
        decision = command.decision
        problem = getattr(self.controller, "problem", None)
        if isinstance(problem, Problem) and problem.state_dim < len(measured):
            n = problem.state_dim
            measured = measured[:n]
            states = states[..., :n]
            decision = plan_of_first_states(decision, n)
        return self._judge.judge(measured, states, decision, command.input)

    def input_between(self, state: Any, share: float) -> np.ndarray:
        """Returns the input to apply until the next decision (m,).

        It is the plan's, corrected by its feedback, for plants that take inputs more
        often than there is time to decide. The feedback is that of the controller's
        method ``gains``, at the stage of the plan that the time falls into; a late
        decision goes on along the plan. Where the last step failed and ``"hold"`` is
        the policy, it is the input that is held.

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
        is_held = self.last.failed and self.on_failure == "hold"
        state = read_array("state", state, signals_of(self.controller).state_names)
        n = self._measured_dim
        if n is None:
            n = plan.means.shape[1]
        if state.shape != (n,):
            raise ShapeError(f"state must have shape {(n,)}; got {state.shape}")
        if is_held:
            return self.last.input.copy()
        horizon = len(plan.inputs)
        stage = min(int(share), horizon - 1)
        input = plan.inputs[stage]
        if np.isfinite(plan.means).all() and is_measured(state).all():
            planned_state = _state_along(plan.means[:, :n], min(share, horizon))
            error = self._short_way(state - planned_state)
            correction = self._gains_of(plan)[stage][:, :n] @ error
            if np.isfinite(correction).all():
                input = input - correction
        last_input = _input_before(self.controller, self._command_before)
        if stage > 0:
            last_input = plan.inputs[stage - 1]
        return _within_bounds(self.controller, input, last_input)

    def _gains_of(self, plan: Decision) -> np.ndarray:
        """Returns the gains (H, m, n) of a plan's feedback; zero without any."""
        if self._gains is None or self._gains[0] is not plan:
            method = getattr(self.controller, "gains", None)
            gains = np.zeros((*plan.inputs.shape, plan.means.shape[1]))
            with suppress(*FAILURES):  # then the plan is flown without a feedback
                if method is not None and self._parameters is None:
                    gains = method(plan)
                elif method is not None:
                    gains = method(plan, self._parameters)
            self._gains = (plan, gains)
        return self._gains[1]

    def _short_way(self, error: np.ndarray) -> np.ndarray:
        """Returns an error (n,) without full turns of the cost's angles."""
        cost = getattr(getattr(self.controller, "problem", None), "cost", None)
        angles = getattr(cost, "angles", None) or ()
        return error - full_turns(error, angles)

    @explains_arguments
    def warm_up(self, state: Any, reference: Any, parameters: Any = None) -> None:
        """Decides twice and forgets it: everything is then compiled beforehand."""
        rehearsal = ControlLoop(self.controller, "previous_plan")
        with rare_kernels_loaded():
            for _ in range(2):
                rehearsal.input(state, reference, parameters)


def _state_along(states: np.ndarray, time: float) -> np.ndarray:
    """Returns the state (n,) at a time in steps from s_0 on.

    It lies on the cubic through the four nearest of s_0 .. s_H (H + 1, n).
    """
    count = min(4, len(states))
    first = min(max(int(time) - 1, 0), len(states) - count)
    nodes = np.arange(first, first + count)
    return krogh_interpolate(nodes, states[nodes], time)


def check_policy(on_failure: str) -> None:
    """Raises ``SettingError`` unless there is such a policy."""
    check_choice("on_failure", on_failure, get_args(OnFailure))


def _is_usable(belief: Gaussian) -> bool:
    """Tells whether a belief can be decided on."""
    return is_usable_belief(to_array(belief.mean), to_array(belief.covariance))


def _conclude(
    controller: Controller,
    decision: Decision | None,
    situation: Situation,
    last: Command | None,
    on_failure: OnFailure,
    step: int,
) -> Command:
    """Returns the command for a decision, None where the controller was not called."""
    reference = situation.reference
    status = Status.INVALID_MEASUREMENT if decision is None else decision.status
    reason = status.advice
    readable = _readable(controller, decision, situation, last)
    admitted = None
    if readable is not None and readable.applicable:
        admitted = _admit(controller, readable, last)
    if admitted is not None:
        return _command(admitted, status, decision=admitted, situation=situation)
    if decision is not None and decision.applicable:  # it is refused
        reason = (
            f"its plan, {status.name}, is not finite or out of its bounds or shape; "
            f"its input: {decision.input}"
        )
        status = Status.NUMERICAL_TROUBLE
        if readable is not None:
            readable = replace(readable, status=status, suboptimal=False)
    if on_failure == "raise":
        raise SolverFailure(step, reason)
    plan = _plan_of_policy(controller, last, on_failure)
    if plan is None:
        plan = _plan_without_prediction(controller, reference, last, status)
    if plan is None:
        rule = "no earlier plan and no reference input to fall back on"
        raise SolverFailure(step, f"{reason} ({rule})")
    plan = replace(plan, learned=_learned_so_far(decision, last, plan.input))
    return _command(plan, status, decision=readable, situation=situation)


def _command(
    plan: Decision, status: Status, decision: Decision | None, situation: Situation
) -> Command:
    """Returns the command of a plan; of the decision it shows what is measured."""
    return Command(
        input=plan.input,
        status=status,
        decision=situation.measured_part(decision),
        plan=plan,
        state=situation.state,
    )


def _learned_so_far(
    decision: Decision | None, last: Command | None, input: np.ndarray
) -> Any:
    """Returns what a flight has taught when a decision is not applied.

    A controller that was called has learned up to this step's measurement. One that was
    not called knows the step that ends here by its input alone. Either learns the step
    that begins here by the input that is applied.

    Args:
        decision: That failed; None where the controller was not called.
        last: Command of the step before.
        input: Of the policy (m,).
    """
    learned: Any = None
    if decision is not None and decision.learned is not None:
        learned = decision.learned
    elif last is not None and last.plan is not None:
        learned = last.plan.learned
        if hasattr(learned, "later"):
            learned = learned.later(last.input)
    if hasattr(learned, "with_input_of_policy"):
        learned = learned.with_input_of_policy(input)
    return learned


def _plan_of_policy(
    controller: Controller, last: Command | None, on_failure: OnFailure
) -> Decision | None:
    """Returns the last plan one step on, with the input of the policy as its first.

    None where there is none to be applied. What an input that was held once leads to is
    not planned: the plan then counts as used up.
    """
    if last is None or last.plan is None:
        return None
    if not last.plan.applicable:  # it was applied before any plan, without prediction
        return None
    plan = _shifted(last.plan)
    if on_failure == "hold" and plan.policy_steps > 1:
        plan = replace(plan, policy_steps=len(plan.inputs))
    input = _input_of_policy(on_failure, plan, last)
    # bounds may change from stage to stage
    input = _within_bounds(controller, input, last.input)
    return _admit(controller, _with_first(plan, plan.inputs, input), last)


def _input_of_policy(
    on_failure: OnFailure, plan: Decision, last: Command
) -> np.ndarray:
    """Returns the input (m,) of a failed step; bounds are looked after elsewhere.

    Args:
        on_failure: The policy.
        plan: The last one, shifted to this step.
        last: Command of the step before.
    """
    if on_failure == "hold":
        return last.input
    return plan.inputs[0]


def _shifted(plan: Decision) -> Decision:
    """Returns a plan as if it had been made one step ago; its ends are held."""
    return replace(
        plan,
        inputs=one_step_on(plan.inputs),
        means=one_step_on(plan.means),
        covariances=one_step_on(plan.covariances),
        policy_steps=plan.policy_steps + 1,
        stage_costs=np.empty(0),  # those of the plan before it was shifted
        violation=math.nan,  # likewise
    )


def _plan_without_prediction(
    controller: Controller,
    reference: Reference,
    last: Command | None,
    status: Status,
) -> Decision | None:
    """Returns the reference's input, or the controller's initial one, as a plan.

    None where neither is known. The plan is not applicable: it predicts nothing.
    """
    known_input = getattr(controller, "initial_input", None)
    if reference.inputs is not None and np.isfinite(reference.inputs[0]).all():
        known_input = reference.inputs[0]
    if known_input is None or not np.isfinite(known_input).all():
        return None
    input = _within_bounds(
        controller, np.array(known_input, dtype=float), _input_before(controller, last)
    )
    H = reference.horizon
    n = reference.states.shape[1]
    return Decision(
        input=input,
        inputs=np.tile(input, (H, 1)),
        means=np.full((H + 1, n), np.nan),
        covariances=np.full((H + 1, n, n), np.nan),
        status=status,
        iterations=0,
        timing=Timing(),
    )


def _readable(
    controller: Controller,
    decision: Decision | None,
    situation: Situation,
    last: Command | None,
) -> Decision | None:
    """Returns a decision of inputs (H, m), whose prediction is (H + 1, n).

    The prediction is NaN where the controller predicts nothing, or something of another
    shape. None without such inputs.
    """
    if decision is None or not _has_right_shape(controller, decision, last):
        return None
    stages = len(decision.inputs) + 1
    n = situation.belief.mean.shape[-1]
    has_means = np.shape(decision.means) == (stages, n)
    if has_means and np.shape(decision.covariances) == (stages, n, n):
        return decision
    return replace(
        decision,
        means=np.full((stages, n), np.nan),
        covariances=np.full((stages, n, n), np.nan),
    )


def _has_right_shape(
    controller: Controller, decision: Decision, last: Command | None
) -> bool:
    """Tells whether the inputs of a decision have the shapes (m,) and (H, m)."""
    problem = getattr(controller, "problem", None)
    if isinstance(problem, Problem):
        m = problem.input_dim
    elif last is not None:
        m = last.input.size
    else:
        m = decision.input.size
    inputs_fit = np.shape(decision.inputs)[1:] == (m,) and len(decision.inputs) > 0
    return decision.input.shape == (m,) and inputs_fit


def _admit(
    controller: Controller, plan: Decision, last: Command | None
) -> Decision | None:
    """Returns a plan, its first input put onto the bounds that it misses by rounding.

    None where it must not be applied.
    """
    input = _within_bounds(controller, plan.input, _input_before(controller, last))
    miss = np.abs(input - plan.input)
    tolerance = _ROUNDING * np.maximum(1.0, np.abs(input))
    is_rounding = (miss <= tolerance).all()  # the miss of a NaN is a NaN
    if not is_rounding or not np.isfinite(plan.inputs).all():
        return None
    if not miss.any():
        return plan
    return _with_first(plan, plan.inputs, input)


def _input_before(controller: Controller, last: Command | None) -> np.ndarray | None:
    """Returns the input of a command, or the one before the first; None if unknown."""
    if last is not None:
        return last.input
    return getattr(controller, "initial_input", None)


def _within_bounds(
    controller: Controller, input: np.ndarray, last_input: np.ndarray | None
) -> np.ndarray:
    """Returns the nearest input in the box and, among these, within the rates.

    Without a problem of the controller, that is the input itself.
    """
    problem = getattr(controller, "problem", None)
    if not isinstance(problem, Problem):
        return input
    if last_input is not None:
        down, up = problem.input_rates.first
        input = np.minimum(np.maximum(input, last_input + down), last_input + up)
    low, high = problem.inputs.first
    return np.minimum(np.maximum(input, low), high)


def _with_first(plan: Decision, inputs: np.ndarray, first: np.ndarray) -> Decision:
    """Returns a plan with other inputs (H, m), the first of them replaced."""
    return replace(plan, input=first, inputs=np.concatenate([first[None], inputs[1:]]))
