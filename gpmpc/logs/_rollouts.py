"""Models of logs and their rollouts: many windows, many steps, and many parameter vectors in one batch.

    y[k] = nominal(theta; x[k], u[k - lag], c) + gp(x[k], u[k - lag], c) + d,    x[k+1] = kinematics(x[k], y[k])

The disturbance d of an output is the mean, over the last rows before a prediction, of what was measured minus what the
model says; it is held through the prediction, and so is the context c (a battery's voltage reacts to the inputs, and
its future is not known).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.logs._kinematics import Kinematics
from gpmpc.logs._log import Log, Windows
from gpmpc.logs._nominal import Nominal
from gpmpc.logs._state_space import Array

STEPS = 50  # of the rollouts that models are judged by
PAST = 20  # rows before them


@dataclass(frozen=True)
class OutputGP:
    """GPs that add to some outputs."""

    outputs: tuple[int, ...]  #: their numbers
    posterior: GPPosterior  #: of the features, with ``predicts="value"`` and no inputs of its own

    def mean(self, features: Array) -> Array:
        """Computes the means (..., k) at features (..., d)."""
        flat = np.ascontiguousarray(features.reshape(-1, features.shape[-1]))
        mean = self.posterior.linearize(flat, np.empty((len(flat), 0)), False).mean
        return mean.reshape(*features.shape[:-1], -1)


@dataclass(frozen=True)
class LogModel:
    """A model of the outputs behind a log."""

    kinematics: Kinematics  #: what the outputs do
    nominal: Nominal  #: the part with parameters
    theta: Array  #: its parameters (P,)
    history: tuple[int, ...]  #: rows over which each output's disturbance is averaged (o,); zero for none
    lag: int = 0  #: rows by which the inputs act late
    gps: tuple[OutputGP, ...] = ()  #: what is learned besides

    def __post_init__(self) -> None:
        if len(self.history) != len(self.kinematics.output_names):
            raise SettingError("history", f"must have {len(self.kinematics.output_names)} numbers; got {self.history}")

    @property
    def past(self) -> int:
        """Rows that a prediction needs before its start."""
        return max(self.history) + self.lag

    def outputs(self, states: Array, inputs: Array, context: Array, theta: Any = None) -> Array:
        """Computes the outputs (..., o) without disturbance; ``theta`` as of ``Nominal`` instead of the own one."""
        y = self.nominal.outputs(self.theta if theta is None else theta, states, inputs, context)
        if self.gps:
            whole = np.broadcast_to(context, (*states.shape[:-1], context.shape[-1]))
            z = self.kinematics.features(states, np.broadcast_to(inputs, (*states.shape[:-1], inputs.shape[-1])), whole)
            y = y.copy()
            for gp in self.gps:
                y[..., list(gp.outputs)] += gp.mean(z)
        return y

    def disturbance(self, windows: Windows, theta: Any = None) -> Array:
        """Estimates the disturbances at the starts of windows (..., W, o) from the rows before."""
        total = np.zeros((len(windows), len(self.history)))
        for rows in sorted({h for h in self.history if h}):
            at = slice(windows.past - rows, windows.past)
            x = windows.states[:, windows.past - rows : windows.past + 1]
            u = windows.inputs[:, at.start - self.lag : at.stop - self.lag]
            expand = None if theta is None else [np.asarray(p)[..., None] for p in theta]
            said = self.outputs(x[:, :-1], u, windows.context[:, at], expand).mean(axis=-2)
            seen = self.kinematics.outputs(x[:, :-1], x[:, 1:], windows.time_step).mean(axis=-2)
            total = total + np.where(np.array(self.history) == rows, seen - said, 0.0)
        return total

    def rollout(self, windows: Windows, steps: int | None = None, theta: Array | None = None) -> Array:
        """Predicts windows from their starts with the inputs that were applied.

        Args:
            windows: W of them, with ``past`` rows or more before the start.
            steps: All that the windows hold by default.
            theta: Parameter vectors (T, P), rolled out beside each other; the model's own by default.

        Returns:
            States 1 to ``steps`` after the start (W, steps, n), or (T, W, steps, n).
        """
        steps = windows.ahead if steps is None else steps
        if windows.past < self.past:
            raise SettingError("past", f"must be {self.past} rows or more for this model; got {windows.past}")
        terms = None if theta is None else [p[:, None] for p in np.moveaxis(theta, -1, 0)]
        batch = (len(windows),) if theta is None else (len(theta), len(windows))
        x = np.broadcast_to(windows.states[:, windows.past], (*batch, windows.states.shape[-1]))
        context, d = windows.context[:, windows.past], self.disturbance(windows, terms)
        found = np.empty((*batch, steps, x.shape[-1]))
        for k in range(steps):
            y = self.outputs(x, windows.inputs[:, windows.past + k - self.lag], context, terms) + d
            x = self.kinematics.step(x, y, windows.time_step)
            found[..., k, :] = x
        return found


def rollout_errors(windows: Windows, predicted: Array, steps: Any = None) -> Array:
    """Computes the differences of predictions from what was measured.

    Args:
        windows: W of them.
        predicted: Of ``LogModel.rollout`` (..., W, K, n).
        steps: Which of the K, from 1; all by default.

    Returns:
        Errors (..., W, steps, e).
    """
    steps = np.arange(1, predicted.shape[-2] + 1) if steps is None else np.asarray(steps)
    return windows.space.difference(predicted[..., steps - 1, :], windows.states[:, windows.past + steps])


def finite_errors(windows: Windows, model: LogModel, steps: Any = None) -> Array:
    """Computes the errors of a model's rollouts, of which those that diverge are 1e9."""
    with np.errstate(over="ignore", invalid="ignore"):
        errors = rollout_errors(windows, model.rollout(windows), steps)
    return np.nan_to_num(errors, nan=1e9, posinf=1e9, neginf=-1e9)


def choose_stride(log: Log, rows: int, most: int) -> int:
    """The stride at which windows of that many rows are ``most`` at most."""
    count = sum(max(b - a - rows, 0) for run in log.runs for a, b in run.pieces)
    return max(-(-count // most), 1)
