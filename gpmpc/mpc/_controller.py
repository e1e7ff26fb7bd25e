"""The protocol of controllers: from a belief and a reference to a decision.

A controller keeps nothing between calls: what it needs of its last plan is part of the
``Decision`` that it returns, and is handed to it again as ``previous``.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from gpmpc._angles import full_turns
from gpmpc._arrays import UNMEASURED, names_of, read_array, sorted_columns
from gpmpc._calls import explains_arguments
from gpmpc._compiled import compiled
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_kind,
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
# By how much a suboptimal plan may miss hard bounds, in their units: a next step mends
# it.
FEASIBLE = 1e-3
KEPT = 1e-5  # by how much a bound may be missed that counts as kept, in its unit
_FLOAT64 = np.dtype(np.float64)


class ParametersNotFinite(DataError):
    """Parameters of a decision that are not finite, such as of an obstacle unseen."""


@explains_arguments
@dataclass(frozen=True)
class Reference:
    """A path for a controller to follow over its horizon H, from the current time on.

    Raises:
        ShapeError: States, inputs and kappas do not belong together.
        SettingError: A kappa is negative.

    >>> import numpy as np
    >>> Reference(np.zeros((11, 2)), inputs=np.zeros((10, 1))).states.shape
    (11, 2)

    See Also:
        ``gpmpc.systems.System.reference_states``, which makes the states along a
        trajectory.
    """

    #: r_0 .. r_H (H + 1, n); r_0 belongs to the current time. Or a set point (n,), for
    #: any horizon
    states: Array
    #: u*_0 .. u*_{H-1} (H, m), the inputs that belong to it where they are known; (m,)
    #: for a set point
    inputs: Array | None = None
    #: standard deviations (H,) between the means and the sides of chance constraints,
    #: by stage, in the place of the problem's, such as those of an ``AdaptiveTube``;
    #: for covariances of ``zero_order``
    kappas: Array | None = None
    #: names of states and inputs, where they are known: by default of a series'
    #: entries, or of a table's columns. A controller sorts by them
    signals: Signals = UNKNOWN

    def __post_init__(self) -> None:
        states_plain = type(self.states) is np.ndarray
        inputs_plain = self.inputs is None or type(self.inputs) is np.ndarray
        if self.signals is not UNKNOWN or not (states_plain and inputs_plain):
            check_signals(self.signals)
            self._read_names()
        states_shape = np.shape(self.states)
        inputs_shape = None if self.inputs is None else np.shape(self.inputs)
        if len(states_shape) == 1:
            if inputs_shape is not None and len(inputs_shape) != 1:
                rule = "inputs of a set point must be (m,)"
                raise ShapeError(f"{rule}; got {inputs_shape}")
            return
        if len(states_shape) != 2 or states_shape[0] < 2:
            rule = "reference states must be (H + 1, n), H of 1 or more"
            raise ShapeError(f"{rule}; got {states_shape}")
        H = states_shape[0] - 1
        if inputs_shape is not None and (
            len(inputs_shape) != 2 or inputs_shape[0] != H
        ):
            raise ShapeError(f"reference inputs must be ({H}, m); got {inputs_shape}")
        if self.kappas is not None and np.shape(self.kappas) != (H,):
            raise ShapeError(f"kappas must be ({H},); got {np.shape(self.kappas)}")
        if self.kappas is not None and (np.asarray(self.kappas) < 0).any():
            raise SettingError("kappas", f"must not be negative; got {self.kappas}")

    def _read_names(self) -> None:
        """Turns tensors, series and tables into arrays; the latter two have names."""
        states = self.signals.state_names or names_of(self.states)
        inputs = self.signals.input_names or names_of(self.inputs)
        signals = Signals(states, inputs) if states or inputs else UNKNOWN
        object.__setattr__(self, "signals", signals)
        for key, names in (
            ("states", signals.state_names),
            ("inputs", signals.input_names),
        ):
            values = getattr(self, key)
            if values is None:
                continue
            if hasattr(values, "detach"):
                array = _as_array(values)
            else:
                array = read_array(f"reference {key}", values, names)
            object.__setattr__(self, key, array)

    def in_order(self, signals: Signals) -> "Reference":
        """Returns the reference, its columns sorted by names, where they are known.

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
        """Returns the reference itself, or a set point repeated over a horizon."""
        if np.ndim(self.states) == 2:
            return self
        states = np.tile(_as_array(self.states), (horizon + 1, 1))
        inputs = None
        if self.inputs is not None:
            inputs = np.tile(_as_array(self.inputs), (horizon, 1))
        return Reference(states, inputs, self.kappas, self.signals)

    @property
    def horizon(self) -> int:
        """H; 1 for a set point."""
        return len(self.states) - 1 if np.ndim(self.states) == 2 else 1


def read_reference(value: Any) -> Reference:
    """Returns a reference, given as one, a set point (n,) or states (H + 1, n).

    Raises:
        DataError: They are no real numbers.
    """
    if isinstance(value, Reference):
        return value
    read_array("a reference", value)  # says what is no number; a table keeps its names
    return Reference(value)


@dataclass(frozen=True)
class Timing:
    """Wall time of the parts of a decision [s].

    >>> Timing(model=2e-4, build=1e-5, solve=1e-5).model
    0.0002

    See Also:
        ``Decision``, which has one.
    """

    model: float = 0.0  # propagation and linearisation
    build: float = 0.0  # from the local model to the optimisation problem
    solve: float = 0.0  # of the optimisation problem

    @property
    def total(self) -> float:
        """All of it [s]."""
        return self.model + self.build + self.solve


@dataclass(frozen=True)
class Decision:
    """The input that a controller decided on at one step, with its plan.

    See Also:
        ``GPMPC.control``, which returns it; ``gpmpc.status.Status`` for what
        its status means.
    """

    input: Array  #: to apply now (m,)
    inputs: Array  #: planned (H, m); the first row is ``input``
    #: predicted means of the states (H + 1, n), from the current state on
    means: Array
    #: of these (H + 1, n, n); zero where the controller does not predict them
    covariances: Array
    status: Status  #: how the solve ended
    #: of the solver; of ``GPMPC`` its quadratic programs, those for the price of an
    #: elastic bound counted once, of ``LQR`` the horizon, its Riccati steps
    iterations: int
    timing: Timing  #: of the parts
    #: that was solved last, where there is one
    problem: QuadraticProgram | None = None
    #: of it: active set, multipliers, residuals; a warm start for the next
    solution: QPSolution | None = None
    #: estimate of the model's constant error (n,), added to its mean at every stage;
    #: None where nothing is estimated
    disturbance: Array | None = None
    #: whether the solve stopped short of its tolerance, at a limit say, with a plan
    #: that keeps its bounds. It comes from steps towards the optimum, so it is better
    #: than the guess (Scokaert, Mayne and Rawlings, 1999). Or whether the program keeps
    #: a hard bound and its plan, rolled out by the model, does not
    #: (``HARD_BOUND_MISSED``). Or whether ``ManyStarts`` goes on along a plan at a step
    #: whose own solve failed as the status says
    suboptimal: bool = False
    #: predicted cost of each stage of the plan (H,), that of x_{k+1} and u_k; empty
    #: where it is not known
    stage_costs: Array = field(default_factory=lambda: np.empty(0))
    #: by how much the plan misses a bound, in the bound's unit: smooth constraints are
    #: taken at its means; soft ones may be missed. Zero but for rounding where all are
    #: kept; NaN where that is not known. Up to 1e-5 a bound counts as kept: state
    #: bounds in units in which that is little
    violation: float = math.nan
    #: lengths of the steps that its programs took, squared in the metric of the cost:
    #: by them the next decision tells a jump. Empty after a first plan of one program,
    #: but under smooth constraints, and along a flight of ``ManyStarts``: then the
    #: next one takes one program
    steps: tuple[float, ...] = ()
    #: ``novelty``; or a function where no variances were computed, which is called when
    #: ``novelty`` is read
    plan_novelty: float | Callable[[], float] = math.nan
    #: what the flight has taught a controller that learns (``gpmpc.learning``), for its
    #: next decision; with ``size``, the points of the model that decided, and
    #: ``version``, how often it has changed. Where it has ``later(input)``, that is
    #: handed on after a step of this input (m,), at whose end the controller was not
    #: called
    learned: Any = None
    #: steps by which a policy has moved the plan on since it was decided: its first
    #: mean is then predicted, and not measured
    policy_steps: int = 0

    def __post_init__(self) -> None:
        # a copy, no view of the plan
        object.__setattr__(self, "input", np.array(self.input, dtype=float))

    @property
    def applicable(self) -> bool:
        """Whether the plan may be applied, and started from.

        The inputs of a decision that is not applicable are a failed iterate. What is
        applied instead is the loop's policy (``gpmpc.mpc._policy``).
        """
        return self.status.solved or self.suboptimal

    @property
    def is_used_up(self) -> bool:
        """Whether a policy has left less of the plan than two steps.

        It then says nothing of what the next step was to be.
        """
        return self.policy_steps > 0 and (self.policy_steps > len(self.inputs) - 2)

    @cached_property
    def novelty(self) -> float:
        """Distance of the plan from what the model knows: near 0 among data.

        1 where the model says no more than the data. It is the largest of two ratios
        over all stages and states: the deviation that a stage adds without its noise,
        over the deviation of what the model has learned (1 at most); and the deviation
        predicted for a stage, over the range of that state in the data (half a turn for
        an angle), which has no bound. NaN for models without GPs, or whose GPs act as
        the state says (a callable B).

        Of a plan without variances it is measured when it is first read, by the model
        as it is then: read it before the next decision of a controller that learns.
        """
        novelty = self.plan_novelty
        if callable(novelty):
            novelty = novelty()
            object.__setattr__(self, "plan_novelty", novelty)
        return novelty

    @property
    def far_from_data(self) -> bool:
        """Whether the plan leaves the data behind.

        Its model says little more there than the data alone.
        """
        return self.novelty > _FAR

    @property
    def cost(self) -> float:
        """Predicted cost of the plan, all stages together; NaN where it is unknown."""
        return float(self.stage_costs.sum()) if len(self.stage_costs) else math.nan

    @property
    def program_violation(self) -> float:
        """By how much the last program's solution misses a bound; NaN without one.

        Of smooth constraints the program holds what they are at the plan before: the
        plan itself may miss them by more, ``violation``.
        """
        if self.solution is None:
            return math.nan
        return float(self.solution.violation().max(initial=0.0))


def model_of(controller: Any) -> Any:
    """Returns the model that a controller predicts with; None where it has none."""
    steering = steering_of(controller)
    model = getattr(steering, "model", None)
    if model is not None:
        return model
    return getattr(getattr(steering, "prediction", None), "model", None)


def steering_of(controller: Any) -> Any:
    """Returns the innermost one of controllers around each other."""
    inner = getattr(controller, "controller", None)
    return controller if inner is None else steering_of(inner)


class Controller(Protocol):
    """A feedback law with a look-ahead.

    See Also:
        ``GPMPC`` for the package's own; ``gpmpc.simulation.closed_loop``, which
        flies one.
    """

    @property
    def horizon(self) -> int:
        """H, how far it looks ahead."""
        ...

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Decides the input for one step.

        Args:
            belief: Of the state; ``Gaussian.certain(x)`` for a measured one.
            reference: Over the controller's horizon.
            previous: The last decision, to warm-start from; None at the first step.
        """
        ...


class Request(NamedTuple):
    """The arguments of ``control``, validated, as contiguous float64 arrays.

    See Also:
        ``Controller``, whose arguments it holds.
    """

    state: Array  # mean of the belief (n,)
    covariance: Array  # of the belief (n, n)
    #: r_1 .. r_H, reference inputs (zero where there are none), and the input before
    #: this step
    references: References
    #: inputs (H, m) within their bounds: those handed over; else the last plan's, one
    #: step on, the last one repeated; else the previous input repeated
    guessed_inputs: Array
    #: whether the belief is, and was measured; one that is not is a bad measurement,
    #: not misuse
    finite: bool
    #: added to the model's mean at every stage (n,); None where nothing is estimated
    disturbance: Array | None = None
    parameters: Array | None = None  # of the smooth constraints, by stage (H, q)
    kappas: Array | None = None  # of the reference (H,), where it has some
    #: the last decision, where its plan may be started from and has this horizon
    last_plan: Decision | None = None
    #: a first guess of x_0 .. x_H (H + 1, n), where states or inputs were handed over
    guessed_states: Array | None = None

    @property
    def continues_last_plan(self) -> bool:
        """Whether the first guess is the last plan, one step on."""
        return self.last_plan is not None and self.guessed_states is None

    @property
    def starts_afresh(self) -> bool:
        """Whether there is neither a last plan nor one that was handed over."""
        return self.last_plan is None and self.guessed_states is None

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

        It needs no model. Parameters, the disturbance estimate, and the states that
        inputs handed over lead to are left out: ``gpmpc.mpc._guess.read_request`` adds
        them for controllers with a ``PredictionModel``.

        Args:
            problem: Weights and bounds.
            horizon: H.
            initial_input: The previous input where there is no decision before (m,).
            belief: Of the state; sorted by names where it has some.
            reference: Over the horizon; likewise.
            previous: The last decision; of one that is not applicable only ``input``
                counts, what was applied.
            plan: To start from; see ``GPMPC.control``.
            signals: Names of the controller, by which belief and reference are sorted.

        Raises:
            ShapeError: See ``GPMPC.control``.
            DataError: Likewise.
        """
        check_arguments(belief, reference, previous)
        if belief.names:
            belief = belief.in_order(signals.state_names)
        if reference.signals is not UNKNOWN:
            reference = reference.in_order(signals)
        reference = reference.over(horizon)
        n = problem.cost.Q.shape[-1]
        m = problem.cost.R.shape[-1]
        state = _as_array(belief.mean)
        covariance = _as_array(belief.covariance)
        finite = is_usable_belief(state, covariance)
        targets = _read_targets(reference, state, horizon, n)
        if reference.inputs is None and problem.cost.penalized == "deviations":
            rule = f"needs reference inputs ({horizon}, {m})"
            raise ShapeError(f"penalized 'deviations' {rule}; got none")
        target_inputs = _read_target_inputs(reference, horizon, m)
        kappas = _read_kappas(reference)
        last_decision = previous if _can_continue(previous, horizon, n, m) else None
        last_input = _read_last_input(previous, initial_input)
        states = None
        if plan is not None:
            guess, states = _read_plan(plan, horizon, n, m)
        elif last_decision is not None:
            guess = one_step_on(_as_array(last_decision.inputs))
        else:
            guess = np.tile(last_input, (horizon, 1))
        if problem.cost.angle_indices and states is None and finite:
            targets = _unwrap(targets, state, last_decision, problem.cost.angle_indices)
        lower, upper = problem.inputs.sides
        return cls(
            state=state,
            covariance=covariance,
            references=References(targets[1:], target_inputs, last_input),
            guessed_inputs=np.minimum(np.maximum(guess, lower), upper),
            finite=finite,
            kappas=kappas,
            last_plan=last_decision,
            guessed_states=states,
        )

    def refuse_kappas(self, controller: str) -> None:
        """Raises ``SettingError`` where the reference has kappas.

        It is for a controller, by its name, that predicts no covariances.
        """
        if self.kappas is not None:
            rule = "are for the predicted covariances of GPMPC"
            raise SettingError("kappas", f"{rule}; {controller} predicts none")

    @property
    def constant_guess(self) -> Array:
        """The previous input over the whole horizon (H, m)."""
        previous_input = self.references.previous_input[None]
        return np.repeat(previous_input, len(self.guessed_inputs), axis=0)

    def failed_decision(
        self, status: Status, iterations: int = 0, timing: Timing | None = None
    ) -> Decision:
        """Returns the decision of a step without a usable solve.

        It holds the guessed inputs, the disturbance estimate, and no prediction.
        """
        H, n = self.references.states.shape
        return Decision(
            input=self.guessed_inputs[0],
            inputs=self.guessed_inputs,
            means=np.full((H + 1, n), np.nan),
            covariances=np.full((H + 1, n, n), np.nan),
            status=status,
            iterations=iterations,
            timing=timing or Timing(),
            disturbance=self.disturbance,
        )


def _read_targets(reference: Reference, state: Array, horizon: int, n: int) -> Array:
    """Returns finite reference states (H + 1, n); checks the state's dimension, too."""
    targets = _as_array(reference.states)
    if state.shape != (n,) or targets.shape != (horizon + 1, n):
        rule = f"must have shapes ({n},) and ({horizon + 1}, {n})"
        got = f"{state.shape} and {targets.shape}"
        raise ShapeError(f"state and reference {rule}; got {got}")
    _check_finite("states", targets)
    return targets


def _read_target_inputs(reference: Reference, horizon: int, m: int) -> Array:
    """Returns finite reference inputs (H, m), zero where there are none."""
    if reference.inputs is None:
        return np.zeros((horizon, m))
    inputs = _as_array(reference.inputs)
    if inputs.shape != (horizon, m):
        rule = f"must have shape ({horizon}, {m})"
        raise ShapeError(f"reference inputs {rule}; got {inputs.shape}")
    _check_finite("inputs", inputs)
    return inputs


def _read_kappas(reference: Reference) -> Array | None:
    """Returns finite kappas (H,), where the reference has some."""
    if reference.kappas is None:
        return None
    kappas = _as_array(reference.kappas)
    if not np.isfinite(kappas).all():
        raise DataError(f"reference kappas must be finite; got {kappas}")
    return kappas


def _check_finite(name: str, values: Array) -> None:
    """Raises ``DataError`` unless a part of a reference is finite."""
    if not _is_finite(values):
        got = values[~np.isfinite(values)][0]
        raise DataError(f"reference {name} must be finite; got {got}")


def _can_continue(previous: Decision | None, horizon: int, n: int, m: int) -> bool:
    """Returns whether a decision has a plan of this horizon to start from."""
    if previous is None or not previous.applicable:
        return False
    has_inputs = np.shape(previous.inputs) == (horizon, m)
    return has_inputs and np.shape(previous.means) == (horizon + 1, n)


def _read_last_input(previous: Decision | None, initial_input: Array) -> Array:
    """Returns the input before this step (m,): the initial one where it is unknown."""
    initial_input = _as_array(initial_input)
    if previous is None:
        return initial_input
    last_input = _as_array(previous.input)
    if last_input.shape != initial_input.shape:
        rule = f"input of the last decision must have shape {initial_input.shape}"
        raise ShapeError(f"{rule}; got {last_input.shape}")
    return last_input if _is_finite(last_input) else initial_input


def one_step_on(rows: Array) -> Array:
    """Returns the rows of a plan, one step on, the last one repeated."""
    shifted = np.empty_like(rows)
    shifted[:-1] = rows[1:]
    shifted[-1] = rows[-1]
    return shifted


def continued_means(previous: Decision, state: Array, angles: Sequence[int]) -> Array:
    """Returns the means x_1 .. x_H (H, n) of the last plan, one step on.

    Their angles are in the turn of the state: a sensor may have taken a turn off.
    """
    means = one_step_on(previous.means[1:])
    if len(angles):
        means += full_turns(state - previous.means[1], angles)
    return means


def check_arguments(belief: Any, reference: Any, previous: Any) -> None:
    """Checks the kinds of the arguments of ``control``.

    Raises:
        ShapeError: Belief or reference are of another kind.
        SettingError: The last decision is.
    """
    if not (isinstance(belief, Gaussian) and isinstance(reference, Reference)):
        raise ShapeError(
            "control takes a Gaussian (Gaussian.certain(x) for a measured state) "
            "and a Reference(states); "
            f"got {type(belief).__name__} and {type(reference).__name__}"
        )
    if not (previous is None or isinstance(previous, Decision)):
        rule = "the last Decision, or None at the first step"
        check_kind("previous", previous, Decision, rule)


def check_controller(
    problem: Problem,
    states: int,
    inputs: int,
    horizon: int,
    initial_input: Any,
    input_names: Sequence[str] = (),
) -> Array:
    """Checks the settings that every controller has against its model.

    Args:
        problem: Weights and bounds.
        states: Number of states of the model, n.
        inputs: Number of its inputs, m.
        horizon: H.
        initial_input: (m,).
        input_names: Of the model, where they are known.

    Returns:
        The initial input as an array (m,).

    Raises:
        SettingError: One of them does not fit.
    """
    if not isinstance(problem, Problem):
        got = type(problem).__name__
        raise SettingError("problem", f"must be Problem(...); got {got}")
    check_number("horizon", horizon, least=1, whole=True)
    if names_of(initial_input):
        initial_input = read_array("initial_input", initial_input, input_names)
    check_numbers("initial_input", initial_input, inputs)
    if (problem.state_dim, problem.input_dim) != (states, inputs):
        rule = f"must weigh {states} states and {inputs} inputs"
        got = f"{problem.state_dim} and {problem.input_dim}"
        raise SettingError("problem", f"{rule}; got {got}")
    return np.array(initial_input, dtype=float)


def _as_array(value: Any, key: str = "a state, a reference or a plan") -> Array:
    """Converts a tensor or array to contiguous float64 in host memory.

    Raises:
        DataError: It is no real numbers.
    """
    if type(value) is not np.ndarray and hasattr(value, "detach"):
        try:
            value = value.numpy()
        except (RuntimeError, TypeError):  # on another device, or part of a graph
            value = value.numpy(force=True)
    if type(value) is not np.ndarray or value.dtype != _FLOAT64:
        value = read_array(key, value)
    return np.ascontiguousarray(value)


def read_parameters(parameters: Any, horizon: int) -> Array:
    """Returns finite parameters of every stage (H, q), given as these or as (q,).

    Raises:
        ShapeError: They are neither.
        ParametersNotFinite: Some are not finite.
    """
    values = parameters_by_stage(parameters, horizon)
    if not np.isfinite(values).all():
        raise ParametersNotFinite("parameters must be finite")
    return values


def parameters_by_stage(parameters: Any, horizon: int) -> Array:
    """Returns parameters of every stage (H, q), given as these or as (q,).

    Raises:
        ShapeError: They are neither.
    """
    values = np.atleast_1d(_as_array(parameters, "parameters"))
    if values.ndim == 1:
        values = np.tile(values, (horizon, 1))
    if values.ndim != 2 or len(values) != horizon:
        raise ShapeError(
            f"parameters must be (q,) or ({horizon}, q); got {np.shape(parameters)}"
        )
    return values


def _read_plan(plan: Any, horizon: int, n: int, m: int) -> tuple[Array, Array | None]:
    """Returns inputs (H, m) of a plan, and its states (H + 1, n) where it has some."""
    inputs = plan
    states = None
    if isinstance(plan, tuple):
        if len(plan) != 2:
            rule = f"a plan must be inputs ({horizon}, {m}), or a pair (inputs, states)"
            raise ShapeError(f"{rule}; got a {type(plan).__name__} of {len(plan)}")
        inputs, states = plan
    inputs = _as_array(inputs, "inputs of a plan")
    fits = inputs.shape == (horizon, m)
    finite = bool(np.isfinite(inputs).all())
    got = f"{inputs.shape}"
    if states is not None:
        states = _as_array(states, "states of a plan")
        fits = fits and states.shape == (horizon + 1, n)
        finite = finite and bool(np.isfinite(states).all())
        got = f"{inputs.shape}, {states.shape}"
    if not fits:
        shapes = f"inputs ({horizon}, {m}), or these and states ({horizon + 1}, {n})"
        raise ShapeError(f"a plan must be {shapes}; got {got}")
    if not finite:
        raise DataError("a plan to start from must be finite")
    return inputs, states


def _unwrap(
    targets: Array, state: Array, previous: Decision | None, angles: Sequence[int]
) -> Array:
    """Returns references (H + 1, n) whose angles are moved by full turns.

    They move towards the last plan. Where there is none, no stage is further than half
    a turn from the stage before, and the first one than that from the state.
    """
    if previous is None:
        before = state
        turned = targets.copy()
        for target in turned:
            target += full_turns(before - target, angles)
            before = target
        return turned
    plan = np.concatenate([state[None], continued_means(previous, state, angles)])
    return targets + full_turns(plan - targets, angles)


def is_usable_belief(mean: Array, covariance: Array) -> bool:
    """Tells whether a belief can be decided on: mean (n,) and covariance (n, n).

    It is finite, and its mean was measured (``gpmpc._arrays.UNMEASURED``).
    """
    return all_measured(mean) and _is_finite(covariance)


def all_measured(values: Array) -> bool:
    """Tells whether all numbers of a contiguous array were measured."""
    return _all_measured.unchecked(values.ravel())


def _is_finite(values: Array) -> bool:
    """Returns whether all numbers of a contiguous array are finite.

    NumPy takes 2 us for it, of which a control step would pay five times.
    """
    return _all_finite.unchecked(values.ravel())


@compiled(locked=True)
def _all_measured(values):
    """Returns whether all numbers (d,) are measured ones."""
    count = 0
    for value in values:
        count += abs(value) < UNMEASURED
    return count == len(values)


@compiled(locked=True)
def _all_finite(values):
    """Returns whether all numbers (d,) are finite."""
    total = 0.0
    for value in values:
        total += value * 0.0
    return total == 0.0
