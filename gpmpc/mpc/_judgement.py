"""Judges a flight while it flies: healthy, suspicious or lost, and why.

A decision that is SOLVED says that a program was solved, not that the plant does what
was planned. Each step of a flight tells more, and a judge looks at

* the *innovation*, measured minus predicted, whose squares over their variance are of
  chi-square where the model is right (Bar-Shalom, Li and Kirubarajan, 2001, section
  5.4). The variance is the predicted one, the noise that the model has learned, that of
  the sensors, and a share of what moves. The sensors' noise is not known: it is the
  median of squared differences of successive innovations, in which what changes slowly
  has no part, and a jump no weight;
* the *promise*: what the stages of a plan cost, without a weight of its end, and what
  the same steps then cost in truth. In optimal control the cost falls by what is paid
  (Gruene and Rantzer, 2008, section 3); where steps cost several times as much as was
  promised, the plan does not lead where it says;
* the *distance* from the reference in the cost's metric: a plant whose distance grows
  faster and faster, against the promise or with plans that cost ever more, is lost;
* *novelty*, as long as the reference is far away or the promise not kept; *violation*,
  failed solves, sensors that stand still and inputs that stay at a bound without
  effect.

There is nothing to set. Windows are short (eight steps) beside those of the loss, so
that one wrong measurement is no alarm, and a change is named within ten steps. The
checks, in their order, are in ``_flight_checks``.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np

from gpmpc.exceptions import ShapeError, UnsupportedModel
from gpmpc.models._past import first_signals, variances_of_next_row
from gpmpc.mpc import _flight_memory as memory
from gpmpc.mpc._controller import Decision, model_of, steering_of
from gpmpc.mpc._cost import Tracking
from gpmpc.mpc._flight_checks import judge_step
from gpmpc.mpc._question import first_weight
from gpmpc.mpc.problem import Problem
from gpmpc.signals import signals_of

Array = np.ndarray
Level = Literal["healthy", "suspicious", "lost"]

_FLOAT64 = np.dtype(np.float64)


class Judgement(NamedTuple):
    """What a step says of its flight.

    >>> Judgement().level
    'healthy'

    See Also:
        ``FlightJudge``, which makes it.
    """

    level: Level = "healthy"
    reason: str = ""  #: in words; empty where it is healthy

    def __str__(self) -> str:
        return f"{self.level}: {self.reason}" if self.reason else self.level


class FlightJudgement(NamedTuple):
    """What all steps say of their flight.

    It is lost if one of them says so, else what the last one says.

    >>> FlightJudgement().level
    'healthy'

    See Also:
        ``FlightJudge``, which makes it.
    """

    level: Level = "healthy"
    reason: str = ""  #: in words; empty where it is healthy
    step: int | None = None  #: the first one of that; None where it is healthy
    suspicious: int = 0  #: steps that were
    lost: int = 0  #: steps that were

    @classmethod
    def of(cls, steps: Sequence[Judgement]) -> "FlightJudgement":
        """The judgement of a flight by those of its steps."""
        levels = [judgement.level for judgement in steps]
        suspicious = levels.count("suspicious")
        lost_steps = levels.count("lost")
        if not steps:
            return cls()
        if lost_steps:
            first = levels.index("lost")
            reason = steps[first].reason
            if levels[-1] != "lost":
                last_lost = len(levels) - 1 - levels[::-1].index("lost")
                reason += f"; back from step {last_lost + 1} on"
            return cls("lost", reason, first, suspicious, lost_steps)
        if levels[-1] == "healthy":
            return cls(suspicious=suspicious)
        first = len(levels)
        while first > 0 and levels[first - 1] == "suspicious":
            first -= 1
        return cls("suspicious", steps[-1].reason, first, suspicious)


class FlightJudge:
    """Judges the steps of one flight, in their order.

    For a robot of one's own as well as for ``closed_loop``.

    Args:
        problem: What the controller makes small; its state weights measure distances:
            those of the first stage, where they are zero the mean ones, and where all
            are that of the end. What weighs outputs alone measures none.
        noise: Variances (n,) of a next state that the covariances of plans leave out,
            as the model has learned them; zero by default.
        names: Of the states and of the inputs, for the reasons; by default their
            numbers.

    Raises:
        ShapeError: The noise is of another number of states, or the names of other
            numbers of states or inputs.

    Attributes:
        last: Judgement of the last step.

    See Also:
        ``FlightJudgement``, its result; ``Judgement``, that of a step.
    """

    def __init__(
        self,
        problem: Problem,
        noise: Any = None,
        names: tuple[Sequence[str], Sequence[str]] = ((), ()),
    ):
        n = problem.state_dim
        m = problem.input_dim
        lower, upper = problem.inputs.first
        angles = np.zeros(n)
        angles[list(problem.cost.angle_indices)] = 1.0
        model_noise = np.zeros(n)
        if noise is not None:
            model_noise = _float64(noise)
            _check_shape("noise", model_noise.shape, (n,))
        self._memory = memory.Memory(
            states=memory.new_state_memory(model_noise, is_angle=angles),
            inputs=memory.new_input_memory(_float64(lower), _float64(upper)),
            weights=memory.weights_of(
                stage=_stage_weight(problem.cost), end=_float64(problem.cost.terminal)
            ),
            flight=memory.new_flight_memory(),
        )
        self._constrained = bool(problem.constraints)
        self._plans_hold_more = False  # states, behind those that are judged
        self._states = tuple(names[0]) or tuple(f"state {i}" for i in range(n))
        self._inputs = tuple(names[1]) or tuple(f"input {j}" for j in range(m))
        if len(self._states) != n or len(self._inputs) != m:
            raise ShapeError(
                f"names must be of {n} states and {m} inputs; "
                f"got {self._states} and {self._inputs}"
            )
        self._unknown_input = np.full(m, np.nan)
        self._no_means = np.full((2, n), np.nan)
        self._no_covariances = np.full((2, n, n), np.nan)
        self.last = Judgement()

    @classmethod
    def of(
        cls,
        controller: Any,
        state_dim: int,
        input_dim: int,
        names: tuple[Sequence[str], Sequence[str]] | None = None,
    ) -> "FlightJudge":
        """Makes a judge of a controller's flights.

        It takes the controller's problem and the noise that its model has learned. Of a
        controller without a problem no distance is judged; of one whose problem is of
        more states than ``state_dim``, the first are. Names are by default its own.
        """
        problem = getattr(controller, "problem", None)
        if not isinstance(problem, Problem):
            nothing = Tracking(Q=np.zeros(state_dim), R=np.ones(input_dim))
            problem = Problem(nothing)
        is_constrained = bool(problem.constraints)
        holds_more = problem.state_dim > state_dim
        if holds_more:
            problem = _of_first_states(problem, state_dim)
        if names is None:
            signals = first_signals(signals_of(controller), problem.state_dim)
            names = (signals.state_names, signals.input_names)
        noise = _learned_noise(controller)
        if noise is not None:  # of a model with a past more than what is measured
            noise = noise[: problem.state_dim]
        judge = cls(problem, noise, names)
        judge._constrained = is_constrained
        judge._plans_hold_more = holds_more
        return judge

    def judge(
        self,
        measured: Array,
        reference: Array,
        decision: Decision | None,
        input: Array | None = None,
    ) -> Judgement:
        """Judges one step.

        Args:
            measured: The state as the controller got it (n,); NaN where it was not
                measured.
            reference: What it is to be from now on (H + 1, n), or a set point (n,).
            decision: What the controller decided on it; None where it was not called.
            input: What is applied until the next step (m,); by default that of an
                applicable decision, and unknown without one.

        Raises:
            ShapeError: One of them is of another number of states or inputs.
        """
        measured = _float64(measured)
        references = _float64(reference)
        if references.ndim == 1:
            references = references[None]
        means = self._no_means
        covariances = self._no_covariances
        novelty = math.nan
        violation = math.nan
        is_applied = decision is not None and decision.applicable
        if decision is not None and is_applied:
            if input is None:
                input = decision.input
            means = _float64(decision.means)
            covariances = _float64(decision.covariances)
            # One that would have to be measured first is not worth the time here.
            if not callable(decision.plan_novelty):
                novelty = float(decision.plan_novelty)
            if self._constrained:
                violation = float(decision.violation)
        if self._plans_hold_more:
            n = self._no_means.shape[1]
            if measured.ndim == 1:  # a model loop shows pending inputs, too
                measured = measured[:n]
            references = _float64(references[..., :n])
            means = _float64(means[..., :n])
            covariances = _float64(covariances[..., :n, :n])
        applied_input = self._unknown_input if input is None else _float64(input)
        code = memory.MISFIT
        has_right_axes = (
            measured.ndim == 1
            and references.ndim == 2
            and means.ndim == 2
            and covariances.ndim == 3
            and applied_input.ndim == 1
        )
        if has_right_axes:  # else compiled code must not see them
            code = judge_step.unchecked(
                self._memory,
                measured=measured,
                reference=references,
                means=means,
                covariances=covariances,
                input=applied_input,
                is_applied=is_applied,
                novelty=novelty,
                violation=violation,
            )
        if code == memory.HEALTHY:
            self.last = _ALL_WELL
        elif code == memory.MISFIT:
            self._refuse_shapes(measured, references, means, covariances, applied_input)
        else:
            self.last = self._alarm_in_words()
        return self.last

    def _refuse_shapes(
        self,
        measured: Array,
        references: Array,
        means: Array,
        covariances: Array,
        input: Array,
    ) -> NoReturn:
        """Raises ``ShapeError``: one of the arrays is of another shape than the rest.

        Compiled code compares them, in a tenth of the time that this takes.
        """
        n = self._no_means.shape[1]
        stages = max(len(means), 2)  # the next state is one of them
        _check_shape("measured", measured.shape, (n,))
        _check_shape("input", input.shape, self._unknown_input.shape)
        _check_shape("decision.means", means.shape, (stages, n))
        _check_shape("decision.covariances", covariances.shape, (stages, n, n))
        got = references.shape
        raise ShapeError(f"reference must be (H + 1, {n}) or ({n},); got {got}")

    def _alarm_in_words(self) -> Judgement:
        """Returns the judgement that the alarm of the last step stands for."""
        alarm = self._memory.flight[0]
        reason = int(alarm["reason"])
        value = float(alarm["value"])
        sentence = _WORDS[reason]
        if reason == memory.CLIMBING and value < 1.0:
            sentence = _CLIMBING_BELOW_THE_FIRST
        if reason in _LOST:
            return Judgement("lost", sentence.format(value=value))
        names = self._inputs if reason == memory.SATURATED else self._states
        name = names[alarm["entry"]]
        return Judgement("suspicious", sentence.format(name=name, value=value))


def _learned_noise(controller: Any) -> Array | None:
    """Returns the variances (n,) of the noise that a controller's model has learned.

    They hold what is not known of a measured start. All are zero where its plans hold
    the noise; None where there is no such model.
    """
    prediction = getattr(steering_of(controller), "prediction", None)
    model = model_of(controller)
    try:
        variances = variances_of_next_row(model)
    except UnsupportedModel:  # it depends on the state
        variances = None
    if variances is None:
        return None
    settings = getattr(prediction, "settings", None)
    propagator = getattr(prediction, "propagator", None)
    planned = settings is not None and settings.covariance != "none"
    if planned and getattr(propagator, "process_noise", False):
        return np.zeros_like(variances)
    return variances


def _of_first_states(problem: Problem, n: int) -> Problem:
    """Returns what a problem weighs of its first n states, and its inputs' bounds."""
    cost = problem.cost
    first_cost = Tracking(
        Q=cost.Q[..., :n, :n],
        R=cost.R,
        terminal=cost.terminal[:n, :n],
        angles=[i for i in cost.angle_indices if i < n],
    )
    return Problem(first_cost, inputs=problem.inputs)


def _stage_weight(cost: Tracking) -> Array:
    """Returns the weight (n, n) by which distances are measured.

    That of the first stage, or where that is zero the mean one; where all are, that of
    the end.
    """
    weight = first_weight(cost.Q)
    return _float64(weight if weight.any() else cost.terminal)


_ALL_WELL = Judgement()


def _check_shape(name: str, got: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """Raises ``ShapeError`` unless an array has the expected shape."""
    if got != expected:
        raise ShapeError(f"{name} must be {expected}; got {got}")


def _float64(values: Any) -> Array:
    """Returns values as a contiguous array of float64, without a copy if they are."""
    # in a third of the time that looking at type and flags first would take
    return np.asarray(values, dtype=_FLOAT64, order="C")


_LOST = (memory.AWAY, memory.ESCAPING, memory.RISING)
# The words for plans that cost more again, but less than the first one still.
_CLIMBING_BELOW_THE_FIRST = (
    "the plans have stopped falling and rise: they cost {value:.2g} times as much as "
    "at first, although the model predicts well"
)
_WORDS = {
    memory.INNOVATION: (
        "innovations of {name} are {value:.3g} standard deviations, "
        f"root mean square of {memory.WINDOW} steps"
    ),
    memory.BIAS: (
        "innovations of {name} do not cancel each other: {value:.3g} standard "
        f"deviations in the mean of {memory.BIAS_WINDOW} steps"
    ),
    memory.FROZEN: (
        "{name} is measured the same for {value:.0f} steps while other states move"
    ),
    memory.STILL: (
        "{name} is measured the same for {value:.0f} steps, and so is every state, "
        "and they scattered before: no measurement is new"
    ),
    memory.PROMISE: "steps cost {value:.3g} times what the plans promised",
    memory.NOVELTY: (
        "plans are far from the data: there the model knows little more than its prior"
    ),
    memory.VIOLATION: (
        "plans miss a constraint, by {value:.3g} now, and no less with time"
    ),
    memory.FAILURES: (
        f"{{value:.0f}} of the last {memory.WINDOW} decisions could not be applied"
    ),
    memory.SATURATED: (
        "{name} is at its bound for {value:.0f} steps, "
        "and the distance from the reference does not fall"
    ),
    memory.AWAY: (
        "ever faster away from its reference, against what the plans promised; "
        "{value:.3g} from it, in the metric of the cost"
    ),
    memory.ESCAPING: (
        "ever faster away from its reference, and the plans cost ever more; "
        "{value:.3g} from it, in the metric of the cost"
    ),
    memory.CLIMBING: (
        "the plans cost {value:.2g} times as much as at first and ever more, "
        "although the model predicts well"
    ),
    memory.STANDING: "no nearer to the reference for {value:.0f} steps",
    memory.RISING: (
        "the plans cost {value:.3g} times as much as at first and ever more, "
        "although the model predicts well: the horizon is too short for the plant"
    ),
}
