"""A ridge regression that predicts states straight from past states and inputs."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._windows import Windows

_LAGS = (1, 2, 3, 5, 8, 12, 20)  # rows of the past that it sees
_BINS = 5  # means of the future inputs that it sees
_PENALTY = 0.01  # of squared coefficients of standardised columns, per row


@dataclass(frozen=True)
class RidgeRegression:
    """A linear prediction of the state some steps ahead."""

    kinematics: Kinematics
    step: int  # k
    mean: Array  # of the regressors (r,)
    deviation: Array  # likewise
    weights: Array  # (1 + r, e), the constant first

    @classmethod
    def fit(
        cls, kinematics: Kinematics, windows: Windows, step: int
    ) -> "RidgeRegression":
        """Fits the regression to windows."""
        regressors = _regressors(kinematics, windows, step)
        mean = regressors.mean(axis=0)
        deviation = np.maximum(regressors.std(axis=0), 1e-12)
        z = _standardized(regressors, mean, deviation)
        start = windows.states[:, windows.past]
        y = windows.space.difference(windows.states[:, windows.past + step], start)
        is_penalized = np.r_[0.0, np.ones(regressors.shape[1])]
        penalty = _PENALTY * len(z) * np.diag(is_penalized)
        weights: Any = np.linalg.solve(z.T @ z + penalty, z.T @ y)
        return cls(kinematics, step, mean, deviation, weights)

    def predict(self, windows: Windows) -> Array:
        """Predicts the states (W, n) of windows at the step."""
        regressors = _regressors(self.kinematics, windows, self.step)
        z = _standardized(regressors, self.mean, self.deviation)
        start = windows.states[:, windows.past]
        return windows.space.displace(start, z @ self.weights)


def _regressors(kinematics: Kinematics, windows: Windows, step: int) -> Array:
    """Returns features, past states and inputs, and means of inputs to come (W, r)."""
    past = windows.past
    inputs = windows.inputs
    start = windows.states[:, past]
    columns = [kinematics.features(start, inputs[:, past], windows.context[:, past])]
    for lag in _LAGS:
        earlier = windows.states[:, past - lag]
        columns.append(windows.space.difference(start, earlier))
    for lag in _LAGS:
        columns.append(inputs[:, past - lag])
    for rows in np.array_split(np.arange(step), min(_BINS, step)):
        columns.append(inputs[:, past + rows].mean(axis=1))
    return np.concatenate(columns, axis=1)


def _standardized(regressors: Array, mean: Array, deviation: Array) -> Array:
    """Standardises regressors, with a column of ones before them."""
    ones = np.ones(len(regressors))
    return np.column_stack([ones, (regressors - mean) / deviation])
