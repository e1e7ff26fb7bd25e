"""The protocol of controllers: from a belief and a reference to a decision.

A controller keeps nothing between calls: what it needs of its last plan is part of the ``Decision`` that it returns,
and is handed to it again as ``previous``.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from gpmpc._angles import full_turns
from gpmpc._arrays import names_of, read_array, sorted_columns
from gpmpc._compiled import compiled, njit_inner
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_number,
    check_numbers,
)
from gpmpc.gaussian import Gaussian
from gpmpc.mpc._linear_quadratic import References
from gpmpc.mpc.problem import Problem
from gpmpc.qp import QPSolution, QuadraticProgram
from gpmpc.signals import UNKNOWN, Signals, check_signals
from gpmpc.status import Status

Array = np.ndarray

_FAR = 0.9  # a novelty
FEASIBLE = 1e-3  # by how much a suboptimal plan may miss hard bounds, in their units: a next step mends it
KEPT = 1e-5  # by how much a bound may be missed that counts as kept, in its unit
_NO_PLAN = np.empty((0, 0))
_FLOAT64 = np.dtype(np.float64)


@dataclass(frozen=True)
class Reference:
    """What a controller is to follow over its horizon H, from the current time on.

    Raises:
        ShapeError: They do not belong together.
    """

    states: Array  #: r_0 .. r_H (H + 1, n); r_0 belongs to the current time. Or a set point (n,), for any horizon
    #: u*_0 .. u*_{H-1} (H, m), the inputs that belong to it where they are known; (m,) for a set point
    inputs: Array | None = None
    #: standard deviations (H,) between the means and the sides of chance constraints, by stage, in the place of the
    #: problem's, such as those of an ``AdaptiveTube``; for covariances of ``zero_order``
    kappas: Array | None = None
    #: names of states and inputs, where they are known: by default of a series'
    #: entries, or of a table's columns. A controller sorts by them
    signals: Signals = UNKNOWN

    def __post_init__(self) -> None:
        plain = type(self.states) is np.ndarray and (
            self.inputs is None or type(self.inputs) is np.ndarray
        )
        if not plain or self.signals is not UNKNOWN:
            check_signals(self.signals)
            self._read_names()
        shape = np.shape(self.states)
        wide = None if self.inputs is None else np.shape(self.inputs)
        if len(shape) == 1:
            if wide is not None and len(wide) != 1:
                raise ShapeError(f"inputs of a set point must be (m,); got {wide}")
            return
        if len(shape) != 2 or shape[0] < 2:
            raise ShapeError(
                f"reference states must be (H + 1, n), H of 1 or more; got {shape}"
            )
        if wide is not None and (len(wide) != 2 or wide[0] != shape[0] - 1):
            raise ShapeError(
                f"reference inputs must be ({shape[0] - 1}, m); got {wide}"
            )
        if self.kappas is not None and np.shape(self.kappas) != (self.horizon,):
            raise ShapeError(
                f"kappas must be ({self.horizon},); got {np.shape(self.kappas)}"
            )

    def _read_names(self) -> None:
        """Turns series and tables into arrays, whose names are known then."""
        states = self.signals.state_names or names_of(self.states)
        inputs = self.signals.input_names or names_of(self.inputs)
        signals = Signals(states, inputs) if states or inputs else UNKNOWN
        object.__setattr__(self, "signals", signals)
        for key, names in (
            ("states", signals.state_names),
            ("inputs", signals.input_names),
        ):
            values = getattr(self, key)
            if values is not None and not hasattr(values, "detach"):
                array = read_array(f"reference {key}", values, names)
                object.__setattr__(self, key, array)

    def in_order(self, signals: Signals) -> "Reference":
        """The reference, its columns sorted by names; itself where they are not known.

        Raises:
            DataError: Its own names are others.
        """
        states = self.states
        inputs = self.inputs
        if self.signals.state_names and signals.state_names:
            names = self.signals.state_names
            states = sorted_columns(
                "reference states", states, names, signals.state_names
            )
        if self.signals.input_names and signals.input_names and inputs is not None:
            names = self.signals.input_names
            inputs = sorted_columns(
                "reference inputs", inputs, names, signals.input_names
            )
        return Reference(states, inputs, self.kappas)

    def over(self, horizon: int) -> "Reference":
        """The reference itself, or a set point repeated over a horizon."""
        if np.ndim(self.states) == 2:
            return self
        inputs = (
            None if self.inputs is None else np.tile(_array(self.inputs), (horizon, 1))
        )
        states = np.tile(_array(self.states), (horizon + 1, 1))
        return Reference(states, inputs, self.kappas, self.signals)

    @property
    def horizon(self) -> int:
        """H; 1 for a set point."""
        return len(self.states) - 1 if np.ndim(self.states) == 2 else 1


def read_reference(value: Any) -> Reference:
    """A reference, or the one of a set point (n,) or of states (H + 1, n).

    Raises:
        DataError: They are no real numbers.
    """
    if isinstance(value, Reference):
        return value
    read_array("a reference", value)  # says what is no number; a table keeps its names
    return Reference(value)


@dataclass(frozen=True)
class Timing:
    """Wall time of the parts of a decision [s]."""

    model: float = 0.0  # propagation and linearisation
    build: float = 0.0  # from the local model to the optimisation problem
    solve: float = 0.0  # of the optimisation problem

    @property
    def total(self) -> float:
        """All of it [s]."""
        return self.model + self.build + self.solve


@dataclass(frozen=True)
class Decision:
    """What a controller decided at one step."""

    input: Array  #: to apply now (m,)
    inputs: Array  #: planned (H, m); the first row is ``input``
    means: Array  #: predicted means of the states (H + 1, n), from the current state on
    covariances: Array  #: of these (H + 1, n, n); zero where the controller does not predict them
    status: Status  #: how the solve ended
    iterations: int  #: of the solver
    timing: Timing  #: of the parts
    problem: QuadraticProgram | None = None  #: that was solved last, where there is one
    solution: QPSolution | None = (
        None  #: of it: active set, multipliers, residuals; a warm start for the next
    )
    #: estimate of the model's constant error (n,), added to its mean at every stage; None where nothing is estimated
    disturbance: Array | None = None
    #: the solve stopped short of its tolerance, at a limit say, with a plan that keeps its bounds and that steps
    #: towards the optimum led to (Scokaert, Mayne and Rawlings, 1999)
    suboptimal: bool = False
    #: predicted cost of each stage of the plan (H,), that of x_{k+1} and u_k; empty where
    #: it is not known
    stage_costs: Array = field(default_factory=lambda: np.empty(0))
    #: by how much the plan misses a bound, in the bound's unit: smooth constraints are
    #: taken at its means; soft ones may be missed. Zero but for rounding where all are
    #: kept; NaN where that is not known
    violation: float = math.nan
    #: lengths of the steps that its programs took, squared in the metric of the cost
    steps: tuple[float, ...] = ()
    #: ``novelty``, or what measures it when it is read: a plan of means alone does not pay for variances
    plan_novelty: float | Callable[[], float] = math.nan
    #: what the flight has taught a controller that learns (``gpmpc.learning``), for its next decision; with ``size``,
    #: the points of the model that decided, and ``version``, how often it has changed
    learned: Any = None

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "input", np.array(self.input, dtype=float)
        )  # no view of the plan

    @property
    def applicable(self) -> bool:
        """Whether the plan may be applied, and started from; the inputs of another decision are a failed iterate."""
        return self.status.solved or self.suboptimal

    @cached_property
    def novelty(self) -> float:
        """How far the plan is from what the model knows: near 0 among data, 1 where it says no more than they do.

        The largest of two ratios over all stages and states: the deviation that a stage adds without its noise, over
        the deviation of what the model has learned (1 at most); and the deviation predicted for a stage, over the
        range of that state in the data (half a turn for an angle), which has no bound. NaN for models without GPs, or
        whose GPs act as the state says (a callable B).

        Of a plan without variances it is measured when it is first read, by the model as it is then: read it before
        the next decision of a controller that learns.
        """
        found = self.plan_novelty
        if callable(found):
            found = found()
            object.__setattr__(self, "plan_novelty", found)
        return found

    @property
    def far_from_data(self) -> bool:
        """Whether the plan leaves the data behind: its model says little more there than the data alone."""
        return self.novelty > _FAR

    @property
    def cost(self) -> float:
        """The predicted cost of the plan, all stages together; NaN where it is not known."""
        return float(self.stage_costs.sum()) if len(self.stage_costs) else math.nan

    @property
    def program_violation(self) -> float:
        """By how much the solution of the last program misses a bound of it; NaN without one.

        Of smooth constraints the program holds what they are at the plan before: the
        plan itself may miss them by more, ``violation``.
        """
        if self.solution is None:
            return math.nan
        return float(self.solution.violation().max(initial=0.0))


class Controller(Protocol):
    """A feedback law with a look-ahead."""

    @property
    def horizon(self) -> int:
        """H, how far it looks ahead."""
        ...

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Decides the input for one step.

        Args:
            belief: What is known of the state; ``Gaussian.certain(x)`` for a measured one.
            reference: Over the controller's horizon.
            previous: The last decision, to warm-start from; None at the first step.
        """
        ...


class Request(NamedTuple):
    """The arguments of ``control``, validated and converted to contiguous float64 arrays."""

    state: Array  # mean of the belief (n,)
    covariance: Array  # of the belief (n, n)
    references: References  # r_1 .. r_H, reference inputs (zero where there are none), and the input before this step
    #: inputs (H, m) within their bounds: those handed over; else the last plan's, one step on, the last one repeated;
    #: else the previous input repeated
    initial_guess: Array
    finite: (
        bool  # whether the belief is; one that is not is a bad measurement, not misuse
    )
    disturbance: Array | None = (
        None  # added to the model's mean at every stage (n,); None where nothing is estimated
    )
    parameters: Array | None = None  # of the smooth constraints, by stage (H, q)
    kappas: Array | None = None  # of the reference (H,), where it has some
    previous: Decision | None = (
        None  # the last one, where its plan may be started from and has this horizon
    )
    states: Array | None = (
        None  # a first guess of x_0 .. x_H (H + 1, n), where one was handed over
    )

    @classmethod
    def read(
        cls,
        problem: Problem,
        horizon: int,
        initial_input: Array,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None,
        plan: Any = None,
        signals: Signals = UNKNOWN,
    ) -> "Request":
        """Validates the arguments of ``Controller.control`` for H stages of a problem.

        ``initial_input`` is taken for the previous one where there is no decision before; of one that is not applicable
        only ``input`` counts: what was applied. For ``plan``, and the errors, see
        ``GPMPC.control``. ``signals`` are the controller's, by which a belief and a
        reference with names are sorted.
        """
        check_arguments(belief, reference)
        if belief.names:
            belief = belief.in_order(signals.state_names)
        if reference.signals is not UNKNOWN:
            reference = reference.in_order(signals)
        reference = reference.over(horizon)
        n = problem.state_dim
        m = problem.input_dim
        state = _array(belief.mean)
        covariance = _array(belief.covariance)
        states = _array(reference.states)
        if state.shape != (n,) or states.shape != (horizon + 1, n):
            expected = f"({n},) and ({horizon + 1}, {n})"
            raise ShapeError(
                f"state and reference must have shapes {expected}; got {state.shape} and {states.shape}"
            )
        inputs = (
            np.zeros((horizon, m))
            if reference.inputs is None
            else _array(reference.inputs)
        )
        if inputs.shape != (horizon, m):
            raise ShapeError(
                f"reference inputs must have shape ({horizon}, {m}); got {inputs.shape}"
            )
        last = _array(initial_input if previous is None else previous.input)
        guess = np.empty((horizon, m))
        usable = (
            previous is not None
            and previous.applicable
            and np.shape(previous.inputs) == guess.shape
        )
        made = previous if usable else None
        first = _NO_PLAN if made is None else _array(made.inputs)
        guessed = None
        if plan is not None:
            first, guessed = _read_plan(plan, horizon, n, m)
        given = (state, covariance, states, inputs)
        limits = problem.inputs.sides
        finite = _check.unchecked(*given, last, first, limits, guess)
        if not finite[3]:
            last = _array(initial_input)
            _check.unchecked(*given, last, first, limits, guess)
        kappas = None if reference.kappas is None else _array(reference.kappas)
        for name, values, known in (
            ("states", states, finite[1]),
            ("inputs", inputs, finite[2]),
        ):
            if not known:
                raise DataError(
                    f"reference {name} must be finite; got {values[~np.isfinite(values)][0]}"
                )
        if kappas is not None and not np.isfinite(kappas).all():
            raise DataError(f"reference kappas must be finite; got {kappas}")
        if problem.cost.angles and guessed is None and finite[0]:
            states = _unwrapped(states, state, made, problem.cost.angles)
        references = References(states[1:], inputs, last)
        more: dict[str, Any] = {"kappas": kappas, "previous": made, "states": guessed}
        return cls(state, covariance, references, guess, finite[0], **more)

    @property
    def constant_guess(self) -> Array:
        """The previous input over the whole horizon (H, m)."""
        return np.tile(self.references.previous_input, (len(self.initial_guess), 1))

    def failed_decision(
        self, status: Status, iterations: int = 0, timing: Timing | None = None
    ) -> Decision:
        """The decision of a step without a usable solve: the initial guess, and no prediction."""
        (H, n), inputs = self.references.states.shape, self.initial_guess
        unknown = np.full((H + 1, n), np.nan), np.full((H + 1, n, n), np.nan)
        return Decision(
            inputs[0], inputs, *unknown, status, iterations, timing or Timing()
        )


def check_arguments(belief: Any, reference: Any) -> None:
    """Raises ``ShapeError`` unless these are what ``control`` takes."""
    if not (isinstance(belief, Gaussian) and isinstance(reference, Reference)):
        raise ShapeError(
            "control takes a Gaussian (Gaussian.certain(x) for a measured state) "
            "and a Reference(states); "
            f"got {type(belief).__name__} and {type(reference).__name__}"
        )


def check_method(key: str, value: object, method: str, example: str) -> None:
    """Raises ``SettingError`` unless a setting is an object (no class of them) with a method."""
    if isinstance(value, type) or not hasattr(value, method):
        got = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
        raise SettingError(
            key,
            f"must be an object with the method {method!r}, such as {example}; got {got}",
        )


def check_controller(
    problem: Problem,
    states: int,
    inputs: int,
    horizon: int,
    initial_input: Any,
    input_names: Sequence[str] = (),
) -> Array:
    """Checks the settings that every controller has against its model; returns the initial input as an array (m,)."""
    if not isinstance(problem, Problem):
        raise SettingError(
            "problem", f"must be Problem(...); got {type(problem).__name__}"
        )
    check_number("horizon", horizon, least=1, whole=True)
    if names_of(initial_input):
        initial_input = read_array("initial_input", initial_input, input_names)
    check_numbers("initial_input", initial_input, inputs)
    if (problem.state_dim, problem.input_dim) != (states, inputs):
        got = f"{problem.state_dim} and {problem.input_dim}"
        raise SettingError(
            "problem", f"must weigh {states} states and {inputs} inputs; got {got}"
        )
    return np.array(initial_input, dtype=float)


def _array(value: Any, key: str = "a state, a reference or a plan") -> Array:
    """A tensor or array as contiguous float64 in host memory.

    ``DataError`` where it is no real numbers.
    """
    if type(value) is not np.ndarray and hasattr(value, "detach"):
        try:
            value = value.numpy()
        except (RuntimeError, TypeError):  # on another device, or part of a graph
            value = value.numpy(force=True)
    if type(value) is not np.ndarray or value.dtype is not _FLOAT64:
        value = read_array(key, value)
    return np.ascontiguousarray(value)


def read_parameters(parameters: Any, horizon: int) -> Array:
    """Returns finite parameters of every stage (H, q), given as these or as (q,)."""
    values = np.atleast_1d(_array(parameters, "parameters"))
    if values.ndim == 1:
        values = np.tile(values, (horizon, 1))
    if values.ndim != 2 or len(values) != horizon:
        raise ShapeError(
            f"parameters must be (q,) or ({horizon}, q); got {np.shape(parameters)}"
        )
    if not np.isfinite(values).all():
        raise DataError("parameters must be finite")
    return values


def _read_plan(plan: Any, horizon: int, n: int, m: int) -> tuple[Array, Array | None]:
    """The inputs of a plan, after one more row, and its states where it has some."""
    inputs, states = plan if isinstance(plan, tuple) else (plan, None)
    inputs = _array(inputs, "inputs of a plan")
    states = None if states is None else _array(states, "states of a plan")
    if inputs.shape != (horizon, m) or (
        states is not None and states.shape != (horizon + 1, n)
    ):
        shapes = f"inputs ({horizon}, {m}), or these and states ({horizon + 1}, {n})"
        raise ShapeError(
            f"a plan must be {shapes}; got {inputs.shape}{'' if states is None else f', {states.shape}'}"
        )
    if not (
        np.isfinite(inputs).all() and (states is None or np.isfinite(states).all())
    ):
        raise DataError("a plan to start from must be finite")
    return np.vstack([inputs[:1], inputs]), states


def _unwrapped(
    states: Array, state: Array, previous: Decision | None, angles: Sequence[int]
) -> Array:
    """References (H + 1, n) whose angles are moved by full turns towards the plan, or the state where none is."""
    plan = np.tile(state, (len(states), 1))
    if previous is not None:
        plan[1:] = np.concatenate([previous.means[2:], previous.means[-1:]])
        plan[1:] += full_turns(state - previous.means[1], angles)
    return states + full_turns(plan - states, angles)


@compiled(locked=True)
def _check(state, covariance, states, inputs, last, plan, limits, guess):
    """Writes the initial guess; returns whether belief, reference states and inputs, and last input are finite."""
    (H, m), (lower, upper) = guess.shape, limits
    for k in range(H):
        for j in range(m):
            u = plan[min(k + 1, len(plan) - 1), j] if len(plan) > 0 else last[j]
            at = min(k, len(lower) - 1)
            guess[k, j] = min(max(u, lower[at, j]), upper[at, j])
    belief = _is_finite(state) and _is_finite(covariance.ravel())
    return (
        belief,
        _is_finite(states.ravel()),
        _is_finite(inputs.ravel()),
        _is_finite(last),
    )


@njit_inner
def _is_finite(values):
    total = 0.0
    for value in values:
        total += value * 0.0
    return total == 0.0
