"""Models of outputs that kinematics turn into movements, and their rollouts.

    y[k] = nominal(theta; x[k], u[k - lag], c) + gp(x[k], u[k - lag], c) + d
    x[k+1] = kinematics.step(x[k], y[k])

A correction may add to the states that were rolled out what the past says of them.
Many windows, many steps and many parameter vectors are rolled out in one batch. The
disturbance d of an output is the mean, over the last rows before a prediction, of the
measured output minus the model's; it is held through the prediction. So is the context
c: a battery's voltage reacts to the inputs, and its future is not known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.models._correction import LAGS, Correction, StartFilter
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._parametric import ParametricNominal
from gpmpc.models._roll_out import iterate
from gpmpc.models._windows import Windows

DIVERGED = 1e9  # error of a rollout that is not finite


@dataclass(frozen=True)
class OutputGP:
    """GPs that add to some outputs of the nominal model."""

    outputs: tuple[int, ...]  #: indices of these outputs (k,)
    #: of the features, with ``predicts="value"`` and no inputs of its own
    posterior: GPPosterior

    def mean(self, features: Array) -> Array:
        """Computes the means (..., k) at features (..., d)."""
        points = np.ascontiguousarray(features.reshape(-1, features.shape[-1]))
        no_inputs = np.empty((len(points), 0))
        mean = self.posterior.linearize(points, no_inputs, covariance=False).mean
        return mean.reshape(*features.shape[:-1], -1)


@dataclass(frozen=True)
class LogModel:
    """A model of the outputs behind a log: a nominal part and GPs on its residual.

    Raises:
        SettingError: ``history`` has another number of outputs.
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

    def __post_init__(self) -> None:
        o = len(self.kinematics.output_names)
        if len(self.history) != o:
            raise SettingError("history", f"must have {o} numbers; got {self.history}")

    @property
    def past(self) -> int:
        """Number of rows that a prediction needs before its start."""
        past = max(self.history) + self.lag
        if self.correction is None and self.start_filter is None:
            return past
        return max(past, *LAGS)

    def outputs(
        self, states: Array, inputs: Array, context: Array, theta: Any = None
    ) -> Array:
        """Computes the outputs (..., o) without disturbance.

        Args:
            states: (..., n).
            inputs: (..., m), those that act.
            context: (..., c).
            theta: Parameters, one array each, instead of the model's own.
        """
        if theta is None:
            theta = self.theta
        nominal = self.nominal.outputs(theta, states, inputs, context)
        if not self.gps:
            return nominal
        batch = states.shape[:-1]
        inputs = np.broadcast_to(inputs, (*batch, inputs.shape[-1]))
        context = np.broadcast_to(context, (*batch, context.shape[-1]))
        features = self.kinematics.features(states, inputs, context)
        y = nominal.copy()
        for gp in self.gps:
            y[..., list(gp.outputs)] += gp.mean(features)
        return y

    def disturbance(self, windows: Windows, theta: Any = None) -> Array:
        """Estimates the disturbances (..., W, o) at the starts of windows.

        Args:
            windows: With ``past`` rows before their starts.
            theta: Parameters, one array (..., 1) each, instead of the model's own.
        """
        if theta is not None:
            theta = [np.asarray(parameter)[..., None] for parameter in theta]
        disturbance = np.zeros((len(windows), len(self.history)))
        for rows in sorted({rows for rows in self.history if rows}):
            is_averaged = np.array(self.history) == rows
            residual = self._mean_residual(windows, rows, theta)
            disturbance = disturbance + np.where(is_averaged, residual, 0.0)
        return disturbance

    def _mean_residual(self, windows: Windows, rows: int, theta: Any) -> Array:
        """Averages measured minus modelled outputs (..., W, o) over the last rows."""
        start = windows.past
        first = start - rows
        states = windows.states[:, first:start]
        next_states = windows.states[:, first + 1 : start + 1]
        inputs = windows.inputs[:, first - self.lag : start - self.lag]
        context = windows.context[:, first:start]
        modelled = self.outputs(states, inputs, context, theta)
        measured = self.kinematics.outputs(states, next_states, windows.time_step)
        return measured.mean(axis=-2) - modelled.mean(axis=-2)

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
            theta: Parameter vectors (T, P) that are rolled out beside each other,
                without the correction; the model's own by default.

        Returns:
            The states after the start (W, steps, n), or (T, W, steps, n).

        Raises:
            SettingError: The windows have too few rows before their starts.
        """
        if windows.past < self.past:
            rule = f"must be {self.past} rows or more for this model"
            raise SettingError("past", f"{rule}; got {windows.past}")
        if steps is None:
            steps = windows.ahead
        start = self.start(windows)
        parameters = None
        if theta is not None:
            start = np.broadcast_to(start, (len(theta), *start.shape))
            parameters = [values[:, None] for values in np.moveaxis(theta, -1, 0)]
        context = windows.context[:, windows.past]
        disturbance = self.disturbance(windows, parameters)

        def step(k: int, states: Array) -> Array:
            inputs = windows.inputs[:, windows.past + k - self.lag]
            outputs = self.outputs(states, inputs, context, parameters) + disturbance
            return self.kinematics.step(states, outputs, windows.time_step)

        predicted = iterate(step, start, steps)[..., 1:, :]
        if self.correction is None or theta is not None:
            return predicted
        return self.correction(windows, predicted)

    def rollout_errors(
        self, windows: Windows, steps: Sequence[int] | np.ndarray | None = None
    ) -> Array:
        """Computes the errors (W, steps, e) of rollouts at some steps, or at all.

        Errors of rollouts that diverge are 1e9.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            errors = windows.errors(self.rollout(windows), steps)
        return np.nan_to_num(errors, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
