"""Predictions that cost nothing, beside which every model of a log is shown: a model that loses to them is no model.

The state that it is, constant velocities, least squares one step ahead rolled out, and a ridge regression from the past
and the inputs straight to each step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc.logs._kinematics import Kinematics
from gpmpc.logs._log import Log, Windows
from gpmpc.logs._nominal import AffineNominal
from gpmpc.logs._rollouts import PAST, LogModel, choose_stride
from gpmpc.logs._state_space import Array

LAGS = (1, 2, 3, 5, 8, 12, 20)  # rows of the past that the ridge regression sees
BINS = 5  # means of the future inputs that it sees
PENALTY = 1.0  # of squared coefficients of standardised columns, per 100 rows
WINDOWS = 3000


def fit_least_squares(kinematics: Kinematics, log: Log) -> LogModel:
    """Fits outputs that are affine in the features, one step ahead on all rows."""
    cut = log.windows(1)
    x, u, c = cut.states[:, 0], cut.inputs[:, 0], cut.context[:, 0]
    z = kinematics.features(x, u, c)
    y = kinematics.outputs(x, cut.states[:, 1], log.time_step)
    solution: Any = np.linalg.lstsq(np.column_stack([z, np.ones(len(z))]), y, rcond=1e-8)[0]
    nominal = AffineNominal(kinematics, y.shape[1], z.shape[1])
    return LogModel(kinematics, nominal, solution.T.ravel(), (0,) * y.shape[1])


@dataclass(frozen=True)
class Ridge:
    """Ridge regressions from past states, past inputs and coming inputs to the difference at each of some steps."""

    kinematics: Kinematics
    coefficients: dict[int, tuple[Array, Array, Array]]  # mean, factor of the columns, and weights, by step

    @classmethod
    def fit(cls, kinematics: Kinematics, log: Log, steps: Sequence[int]) -> "Ridge":
        """Fits one regression a step."""
        cut = log.windows(max(steps), PAST, choose_stride(log, max(steps) + PAST, WINDOWS))
        found = {}
        for step in steps:
            z = _regressors(kinematics, cut, step)
            mean, factor = z.mean(axis=0), np.maximum(z.std(axis=0), 1e-12)
            z = np.column_stack([np.ones(len(z)), (z - mean) / factor])
            y = cut.space.difference(cut.states[:, PAST + step], cut.states[:, PAST])
            penalty = PENALTY / 100 * len(z) * np.eye(z.shape[1])
            penalty[0, 0] = 0
            found[step] = (mean, factor, np.linalg.solve(z.T @ z + penalty, z.T @ y))
        return cls(kinematics, found)

    def predict(self, windows: Windows, step: int) -> Array:
        """The state (W, n) at one of the steps after the start."""
        mean, factor, weights = self.coefficients[step]
        z = (_regressors(self.kinematics, windows, step) - mean) / factor
        return windows.space.displace(windows.states[:, windows.past], np.column_stack([np.ones(len(z)), z]) @ weights)


def _regressors(kinematics: Kinematics, windows: Windows, step: int) -> Array:
    past, u = windows.past, windows.inputs
    start = windows.states[:, past]
    columns = [kinematics.features(start, u[:, past], windows.context[:, past])]
    columns += [windows.space.difference(start, windows.states[:, past - lag]) for lag in LAGS]
    columns += [u[:, past - lag] for lag in LAGS]
    columns += [u[:, past + rows].mean(axis=1) for rows in np.array_split(np.arange(step), min(BINS, step))]
    return np.concatenate(columns, axis=1)
