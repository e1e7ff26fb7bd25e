"""Models of outputs that kinematics turn into movements, and their rollouts.

    y[k] = nominal(theta; x[k], v[k], c) + W r(x[k], v[k], c, s[k]) + gp + d
    x[k+1] = kinematics.step(x[k], y[k])

v are the inputs as they act: late by some rows and through first-order lags
(``_actuators``). s is what the model remembers of past rows (``_memory``), r the
regressors of its linear term. A correction may add to the states that were rolled out
what the past says of them. Many windows, many steps and many parameter vectors are
rolled out in one batch. The disturbance d of an output is the mean, over the last rows
before a prediction, of the measured output minus the model's; it is held through the
prediction. So is the context c: a battery's voltage reacts to the inputs, and its
future is not known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.models._actuators import FirstOrderLags
from gpmpc.models._correction import ROWS_SEEN, Correction, StartFilter
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._memory import NO_MEMORY, Memory
from gpmpc.models._parametric import ParametricNominal, feedback_outputs
from gpmpc.models._roll_out import iterate
from gpmpc.models._windows import Windows

DIVERGED = 1e9  # error of a rollout that is not finite
# Over which the state of first-order lags is found: lags begin at the first input of
# the window, and of a time constant of T rows exp(-40 / T) of that error is left.
LAG_FILL_ROWS = 40


@dataclass(frozen=True, eq=False)
class OutputGP:
    """GPs that add to some outputs of the nominal model."""

    outputs: tuple[int, ...]  #: indices of these outputs (k,)
    #: of the features, with ``predicts="value"`` and no inputs of its own
    posterior: GPPosterior
    #: whether it sees the regressors of the model's memory in the place of the features
    sees_memory: bool = False

    def mean(self, features: Array) -> Array:
        """Computes the means (..., k) at features (..., d)."""
        points = np.ascontiguousarray(features.reshape(-1, features.shape[-1]))
        no_inputs = np.empty((len(points), 0))
        mean = self.posterior.linearize(points, no_inputs, covariance=False).mean
        return mean.reshape(*features.shape[:-1], mean.shape[1])


class StateParts(NamedTuple):
    """The parts of a state with all that a model carries on beside it."""

    states: Array  # x (..., n)
    lagged: Array  # of first-order lags (..., m); (..., 0) without them
    pending: Array  # inputs on their way, the oldest first (..., D m)
    memory: Array  # s (..., s)


class _ActingState(NamedTuple):
    """A state in a step, the inputs that act there, and what follows from them."""

    states: Array  # x (..., n)
    memory: Array  # s (..., s)
    inputs: Array  # as they act (..., m)
    next_lagged: Array  # of first-order lags, after the step (..., m or 0)
    next_pending: Array  # inputs on their way, after the step (..., D m)


def _over_batch(values: Array, batch: tuple[int, ...]) -> Array:
    """Returns values (..., k) repeated over a batch (*batch, k), as a view.

    ``broadcast_to`` is slow beside a step of few windows, and mostly not needed.
    """
    if values.shape[:-1] == batch:
        return values
    return np.broadcast_to(values, (*batch, values.shape[-1]))


@dataclass(frozen=True, eq=False)
class LogModel:
    """A model of the outputs behind a log: a nominal part and what is learned on it.

    Raises:
        SettingError: ``history`` has another number of outputs, or there is one beside
            a memory, whose means of outputs take its place.

    See Also:
        ``gpmpc.logs.learn``, which identifies one; ``LogDynamics``, which flies
        one.
    """

    kinematics: Kinematics  #: how the outputs move a state
    nominal: ParametricNominal  #: such as a ``MultirotorNominal``
    theta: Array  #: parameters of the nominal part (P,)
    #: rows over which each output's disturbance is averaged (o,); zero for none
    history: tuple[int, ...]
    lag: int = 0  #: rows by which the inputs act late
    gps: tuple[OutputGP, ...] = ()  #: on the residual of the nominal part
    #: of rollouts, by the past before their starts; none by default
    correction: Correction | None = None
    #: estimates the starts of rollouts from noisy rows; none where they have no noise
    start_filter: StartFilter | None = None
    #: of the first-order lags through which the inputs act [s] (m,); empty without
    time_constants: Array = field(default_factory=lambda: np.empty(0))
    memory: Memory = NO_MEMORY  #: of past rows
    #: W of the linear term (o, r), or many of them (T, o, r) that are rolled out beside
    #: each other; zero where it is empty
    weights: Array = field(default_factory=lambda: np.empty((0, 0)))
    #: outputs to which the nominal part does not add
    without_nominal: tuple[int, ...] = ()
    #: whether W is fitted to rollouts, beyond one step; predictions do not need it
    refined: bool = False

    def __post_init__(self) -> None:
        o = len(self.kinematics.output_names)
        if len(self.history) != o:
            raise SettingError("history", f"must have {o} numbers; got {self.history}")
        if any(self.history) and not self.memory.empty:
            rule = "must be zero beside a memory, which takes its place"
            raise SettingError("history", f"{rule}; got {self.history}")

    @property
    def past(self) -> int:
        """Number of rows that a prediction needs before its start.

        Those that a correction or a start filter sees are among them.
        """
        fill_rows = LAG_FILL_ROWS if len(self.time_constants) else 0
        rows = max(*self.history, self.memory.rows_back, fill_rows) + self.lag
        if self.correction is None and self.start_filter is None:
            return rows
        return max(rows, *ROWS_SEEN)

    @property
    def feedback_outputs(self) -> tuple[int, ...]:
        """Indices of the outputs that hold the feedback of the controller that flew."""
        of_nominal = feedback_outputs(self.nominal)
        return tuple(i for i in of_nominal if i not in self.without_nominal)

    @property
    def parameters(self) -> list[list[float]]:
        """All numbers but those of GPs, as ``with_parameters`` takes them."""
        groups = (self.theta, self.time_constants, self.weights.ravel())
        return [group.tolist() for group in groups]

    def with_parameters(self, parameters: Sequence[Sequence[float]]) -> "LogModel":
        """Returns the model with the ``parameters`` of another one of its form."""
        theta, time_constants, weights = [np.array(p, dtype=float) for p in parameters]
        rows = len(self.history) if len(weights) else 0
        return replace(
            self,
            theta=theta,
            time_constants=time_constants,
            weights=weights.reshape(rows, -1) if rows else np.empty((0, 0)),
        )

    def nominal_outputs(
        self, states: Array, inputs: Array, context: Array, theta: Any = None
    ) -> Array:
        """Computes the outputs of the nominal part alone (..., o).

        Args:
            states: (..., n).
            inputs: (..., m), as they act.
            context: (..., c).
            theta: Parameters, one array each, instead of the model's own.
        """
        theta = self.theta if theta is None else theta
        nominal = self.nominal.outputs(theta, states, inputs, context)
        if self.without_nominal:
            nominal[..., list(self.without_nominal)] = 0.0
        return nominal

    def learned_outputs(self, features: Array, memory: Array) -> Array | float:
        """Computes what the linear term and the GPs add to the outputs (..., o).

        Args:
            features: (..., d); see ``features``.
            memory: What is remembered (..., s).
        """
        if not self.gps and not self.weights.size:
            return 0.0
        y = np.zeros((*features.shape[:-1], len(self.history)))
        regressors = features
        if self.weights.size or not self.memory.empty:
            regressors = self.memory.regressors(features, memory)
        if self.weights.size:
            y += regressors @ np.swapaxes(self.weights, -1, -2)
        for gp in self.gps:
            points = regressors[..., :-1] if gp.sees_memory else features
            y[..., list(gp.outputs)] += gp.mean(points)
        return y

    def features(self, states: Array, inputs: Array, context: Array) -> Array:
        """Returns the features (..., d) of states, inputs and context."""
        batch = states.shape[:-1]
        inputs = _over_batch(inputs, batch)
        context = _over_batch(context, batch)
        return self.kinematics.features(states, inputs, context)

    def outputs(
        self,
        states: Array,
        inputs: Array,
        context: Array,
        theta: Any = None,
        memory: Array | None = None,
    ) -> Array:
        """Computes the outputs (..., o) without disturbance.

        Args:
            states: (..., n).
            inputs: (..., m), as they act.
            context: (..., c).
            theta: Parameters, one array each, instead of the model's own.
            memory: What is remembered (..., s); it may be left out where nothing is.
        """
        if memory is None:
            memory = np.empty((*states.shape[:-1], 0))
        nominal = self.nominal_outputs(states, inputs, context, theta)
        if not self._sees_features:
            return nominal
        features = self.features(states, inputs, context)
        return nominal + self.learned_outputs(features, memory)

    @property
    def _sees_features(self) -> bool:
        """Whether something that is learned, or remembered, is of the features."""
        return bool(self.gps) or self.weights.size > 0 or not self.memory.empty

    def carried_dim(self, input_dim: int, context_dim: int = 0) -> int:
        """Returns the number of entries that are carried on beside a state."""
        lagged = len(self.time_constants)
        return lagged + self.lag * input_dim + self._memory_dim(input_dim, context_dim)

    def _memory_dim(self, input_dim: int, context_dim: int) -> int:
        """Returns the number of remembered numbers, s."""
        if self.memory.empty:
            return 0
        features = self.features(
            self.kinematics.space.origin, np.zeros(input_dim), np.zeros(context_dim)
        )
        return self.memory.dim(len(features), len(self.history))

    def parts(self, carried: Array, input_dim: int) -> StateParts:
        """Takes states with all that is carried on (..., n + ...) apart."""
        n = self.kinematics.space.dim
        lagged_end = n + len(self.time_constants)
        pending_end = lagged_end + self.lag * input_dim
        return StateParts(
            states=carried[..., :n],
            lagged=carried[..., n:lagged_end],
            pending=carried[..., lagged_end:pending_end],
            memory=carried[..., pending_end:],
        )

    def step(
        self,
        carried: Array,
        inputs: Array,
        context: Array,
        time_step: float,
        disturbance: Array | float = 0.0,
        theta: Any = None,
        time_constants: Any = None,
    ) -> Array:
        """Moves states, with all that is carried on beside them, by a time step.

        Args:
            carried: States and what is carried on (..., n + ...); see ``parts``.
            inputs: Those that are commanded now (..., m).
            context: (..., c).
            time_step: [s].
            disturbance: Added to the outputs (..., o).
            theta: Parameters, one array each, instead of the model's own.
            time_constants: Of the inputs (..., m) [s], instead of the model's own.
        """
        now = self._acting_now(carried, inputs, time_step, time_constants)
        states = now.states
        context = _over_batch(context, states.shape[:-1])
        features = self._features_of_step(now, context)
        learned = self.learned_outputs(features, now.memory)
        beyond_nominal = learned + disturbance
        nominal = self.nominal_outputs(states, now.inputs, context, theta)
        outputs = nominal + beyond_nominal
        after = self.kinematics.step(states, outputs, time_step)
        beyond_nominal = np.broadcast_to(beyond_nominal, outputs.shape)
        return self._carry_on(now, after, features, beyond_nominal)

    def follow(
        self,
        carried: Array,
        inputs: Array,
        measured: Array,
        context: Array,
        time_step: float,
    ) -> Array:
        """Returns measured states with all that is carried on, a step later.

        Args:
            carried: States a step before, with what is carried on (..., n + ...).
            inputs: Those that were commanded there (..., m).
            measured: The states that they led to (..., n).
            context: (..., c).
            time_step: [s].
        """
        now = self._acting_now(carried, inputs, time_step)
        context = _over_batch(context, measured.shape[:-1])
        features = self._features_of_step(now, context)
        outputs = self.kinematics.outputs(now.states, measured, time_step)
        modelled = self.nominal_outputs(now.states, now.inputs, context)
        return self._carry_on(now, measured, features, outputs - modelled)

    def at_rest(self, states: Array, inputs: Array, context: Array) -> Array:
        """Returns a state with all that is carried on, as if it had stood there.

        Of the outputs it is remembered that the nominal part was right.

        Args:
            states: (n,).
            inputs: That were commanded all the time (m,).
            context: (c,).
        """
        lagged = inputs if len(self.time_constants) else np.empty(0)
        memory = np.empty(0)
        if not self.memory.empty:
            features = self.features(states, inputs, context)
            no_outputs = np.zeros((1, len(self.history)))
            memory = self.memory.begin(features[None], no_outputs)
        return np.concatenate([states, lagged, np.tile(inputs, self.lag), memory])

    def _acting_now(
        self,
        carried: Array,
        inputs: Array,
        time_step: float,
        time_constants: Any = None,
    ) -> "_ActingState":
        """Returns the inputs that act in a step, beside the parts of a state."""
        m = inputs.shape[-1]
        state_parts = self.parts(carried, m)
        inputs = _over_batch(inputs, carried.shape[:-1])
        queue = np.concatenate([state_parts.pending, inputs], axis=-1)
        acting = queue[..., :m]
        lagged = state_parts.lagged
        if len(self.time_constants):
            lags = self.lags(time_step, time_constants)
            lagged = lags.after(state_parts.lagged, acting)
            acting = lags.acting(state_parts.lagged, acting)
        return _ActingState(
            states=state_parts.states,
            memory=state_parts.memory,
            inputs=acting,
            next_lagged=lagged,
            next_pending=queue[..., m:],
        )

    def _features_of_step(self, now: "_ActingState", context: Array) -> Array:
        """Returns the features (..., d) of a step; none where nothing sees them."""
        if not self._sees_features:
            return now.states[..., :0]
        return self.features(now.states, now.inputs, context)

    def _carry_on(
        self, now: "_ActingState", after: Array, features: Array, beyond_nominal: Array
    ) -> Array:
        """Returns next states with all that is carried on.

        Args:
            now: The step.
            after: Next states (..., n).
            features: Of the step (..., d).
            beyond_nominal: What the nominal part left of the outputs (..., o).
        """
        memory = now.memory
        if not self.memory.empty:
            memory = self.memory.step(memory, features, beyond_nominal)
        next_parts = [after, now.next_lagged, now.next_pending, memory]
        return np.concatenate(next_parts, axis=-1)

    def lags(self, time_step: float, time_constants: Any = None) -> FirstOrderLags:
        """Returns the first-order lags, discretised.

        Args:
            time_step: [s].
            time_constants: Of the inputs (..., m) [s], instead of the model's own.
        """
        if time_constants is None:
            time_constants = self.time_constants
        return FirstOrderLags.of(time_constants, time_step)

    def acting_inputs(
        self, windows: Windows, rows: slice, time_constants: Any = None
    ) -> tuple[Array, Array]:
        """Computes what acts in the rows of windows, from rest at the first row.

        Args:
            windows: Of W.
            rows: Rows of the windows; they begin at ``lag`` or later.
            time_constants: As in ``step``, one for each input (T, 1, m), to compute
                many side by side.

        Returns:
            The inputs as they act (..., W, rows, m), and the state of the first-order
            lags after the last one (..., W, m); (..., W, 0) without them.
        """
        delayed = windows.inputs[:, : rows.stop - self.lag]
        if not len(self.time_constants):
            acting = delayed[:, rows.start - self.lag :]
            return acting, np.empty((len(windows), 0))
        lags = self.lags(windows.time_step, time_constants)
        acting, lagged = lags.filter(delayed)
        return acting[..., rows.start - self.lag :, :], lagged

    def disturbance(self, windows: Windows, theta: Any = None) -> Array:
        """Estimates the disturbances (..., W, o) at the starts of windows.

        Args:
            windows: With ``past`` rows before their starts.
            theta: Parameters, one array (..., 1) each, instead of the model's own.
        """
        theta, time_constants = self._split(theta)
        return self._disturbance(windows, theta, time_constants)

    def _disturbance(self, windows: Windows, theta: Any, time_constants: Any) -> Array:
        disturbance = np.zeros((len(windows), len(self.history)))
        if not any(self.history):
            return disturbance
        longest = max(self.history)
        first = windows.past - longest
        if theta is not None:
            theta = [np.asarray(parameter)[..., None] for parameter in theta]
        residual = self._residuals(
            windows, slice(first, windows.past), theta, time_constants
        )
        for rows in sorted({rows for rows in self.history if rows}):
            is_averaged = np.array(self.history) == rows
            mean = residual[..., longest - rows :, :].mean(axis=-2)
            disturbance = disturbance + np.where(is_averaged, mean, 0.0)
        return disturbance

    def _residuals(
        self, windows: Windows, rows: slice, theta: Any, time_constants: Any
    ) -> Array:
        """Computes measured minus modelled outputs (..., W, rows, o); no memory."""
        states = windows.states[:, rows]
        next_states = windows.states[:, rows.start + 1 : rows.stop + 1]
        inputs, _ = self.acting_inputs(windows, rows, time_constants)
        # Many time constants side by side make as many inputs of the same states.
        batch = inputs.shape[:-1]
        context = _over_batch(windows.context[:, rows], batch)
        modelled = self.outputs(_over_batch(states, batch), inputs, context, theta)
        measured = self.kinematics.outputs(states, next_states, windows.time_step)
        return measured - modelled

    def first_outputs(self, windows: Windows) -> tuple[Array, Array]:
        """Returns the outputs that follow the starts of windows (W, o).

        They are measured, and modelled with the disturbance.
        """
        start = windows.past
        states = windows.states[:, start]
        next_states = windows.states[:, start + 1]
        # The measured outputs begin at the measured state: so do those of the model.
        unfiltered = replace(self, start_filter=None)
        predicted = unfiltered.rollout_carried(windows, 1)[:, 1, : states.shape[-1]]
        outputs = self.kinematics.outputs
        return (
            outputs(states, next_states, windows.time_step),
            outputs(states, predicted, windows.time_step),
        )

    def _split(self, theta: Any) -> tuple[Any, Any]:
        """Splits parameter vectors into those of the nominal part and the lags'.

        Args:
            theta: One array each; None for the model's own.
        """
        lags = len(self.time_constants)
        if theta is None or not lags:
            return theta, None
        return theta[:-lags], np.stack(theta[-lags:], axis=-1)

    def recall(self, windows: Windows, theta: Any = None) -> Array:
        """Returns the states at the starts of windows with all that is carried on.

        Args:
            windows: With ``past`` rows before their starts.
            theta: Parameters, one array (..., 1) each, instead of the model's own;
                those of first-order lags come last.
        """
        theta, time_constants = self._split(theta)
        start = windows.past
        states = self.start(windows)
        first = start - self.lag
        pending = windows.inputs[:, first:start].reshape(len(windows), -1)
        no_lags = not len(self.time_constants)
        lagged = np.empty((len(windows), 0))
        memory = lagged
        rows = slice(self.lag, start)
        if not no_lags:
            _, lagged = self.acting_inputs(windows, rows, time_constants)
        if not self.memory.empty:
            memory = self._remembered(windows, rows)
        batch = lagged.shape[:-1]
        arrays = (states, lagged, pending, memory)
        arrays = [np.broadcast_to(array, (*batch, array.shape[-1])) for array in arrays]
        return np.concatenate(arrays, axis=-1)

    def _remembered(self, windows: Windows, rows: slice) -> Array:
        """Returns what is remembered at the starts of windows (W, s)."""
        features, residuals = self.nominal_residuals(windows, rows)
        return self.memory.begin(features, residuals)

    def nominal_residuals(self, windows: Windows, rows: slice) -> tuple[Array, Array]:
        """Computes what a memory sees of measured rows.

        Args:
            windows: W of them.
            rows: Rows of the windows; they begin at ``lag`` or later.

        Returns:
            The features (W, rows, d), and what the nominal part leaves of the outputs
            (W, rows, o).
        """
        states = windows.states[:, rows]
        next_states = windows.states[:, rows.start + 1 : rows.stop + 1]
        inputs, _ = self.acting_inputs(windows, rows)
        context = windows.context[:, rows]
        modelled = self.nominal_outputs(states, inputs, context)
        measured = self.kinematics.outputs(states, next_states, windows.time_step)
        return self.features(states, inputs, context), measured - modelled

    def start(self, windows: Windows) -> Array:
        """Estimates the states (W, n) at the starts of windows."""
        if self.start_filter is None:
            return windows.states[:, windows.past]
        return self.start_filter(windows)

    def rollout(
        self, windows: Windows, steps: int | None = None, theta: Array | None = None
    ) -> Array:
        """Predicts windows from their starts with the inputs that were applied.

        Args:
            windows: With ``past`` rows or more before their starts.
            steps: Number of states; by default as many as the windows hold.
            theta: Parameter vectors (T, P) that are rolled out beside each other, with
                the time constants of first-order lags last, and without the correction;
                the model's own by default.

        Returns:
            The states after the start (W, steps, n), or (T, W, steps, n).

        Raises:
            SettingError: The windows have too few rows before their starts.
        """
        n = self.kinematics.space.dim
        predicted = self.rollout_carried(windows, steps, theta, kept=n)[..., 1:, :]
        if self.correction is None or theta is not None:
            return predicted
        return self.correction(windows, predicted)

    def rollout_carried(
        self,
        windows: Windows,
        steps: int | None = None,
        theta: Array | None = None,
        kept: int | None = None,
    ) -> Array:
        """Predicts as ``rollout``, with the start and all that is carried on.

        Args:
            windows: As in ``rollout``.
            steps: Likewise.
            theta: Likewise.
            kept: Number of entries that are returned, the first ones; all by default.

        Returns:
            (W, 1 + steps, n + ...), or (T, W, 1 + steps, n + ...).
        """
        if windows.past < self.past:
            rule = f"must be {self.past} rows or more for this model"
            raise SettingError("past", f"{rule}; got {windows.past}")
        if steps is None:
            steps = windows.ahead
        parameters = None
        if theta is not None:
            parameters = [values[:, None] for values in np.moveaxis(theta, -1, 0)]
        carried = self.recall(windows, parameters)
        count = None if theta is None else len(theta)
        if self.weights.ndim == 3:
            count = len(self.weights)
        if count is not None and carried.ndim == 2:
            carried = np.broadcast_to(carried, (count, *carried.shape))
        context = windows.context[:, windows.past]
        disturbance = self.disturbance(windows, parameters)
        nominal_theta, time_constants = self._split(parameters)

        def step(k: int, carried: Array) -> Array:
            return self.step(
                carried,
                inputs=windows.inputs[:, windows.past + k],
                context=context,
                time_step=windows.time_step,
                disturbance=disturbance,
                theta=nominal_theta,
                time_constants=time_constants,
            )

        return iterate(step, carried, steps, kept)

    def rollout_errors(
        self, windows: Windows, steps: Sequence[int] | np.ndarray | None = None
    ) -> Array:
        """Computes the errors (W, steps, e) of rollouts at some steps, or at all.

        Errors of rollouts that diverge are 1e9.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            errors = windows.errors(self.rollout(windows), steps)
        return np.nan_to_num(errors, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
