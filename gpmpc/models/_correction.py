"""Corrections of rollouts by the past: a ridge regression for each step ahead.

    x^[k] = rollout[k] (+) W_k z,
    z = (past states, past inputs, inputs to come, rollout[k] (-) x[0])

A rollout begins at a measured row, with its noise, unless a filter estimates the start
from the rows before it; and it knows nothing of what an actuator or an estimator still
holds of earlier rows. What of its errors is linear in
the past is found by a regression for each step, straight from the past to the error
that far ahead. The movement that was rolled out is among the regressors, so that a
share of it can be left out. Upon a state that does not move this is the ordinary ridge
regression.

A penalty pulls the coefficients to those of a prior: the rollout as it is, a share of
its movement, or none of it, which is the start. The coefficients of the movement are
those of the prior: as good as the movement is on some runs, on faster ones it may be
worse, and what is fitted to it is no longer the ridge regression. Corrections with
different priors and penalties predict best together: their coefficients are averaged.
So are those of least squares and of least absolute errors: where most rows are calm and
others wild, as of a tank that runs over, the squares are those of the wild ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc._dynamics import Array
from gpmpc.gp._data_checks import constant_columns
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._windows import Windows

ROWS_SEEN = (1, 2, 3, 5, 8, 12, 20)  # of the past, counted back from the start
BINS = 5  # means of the inputs to come that a correction sees
PENALTY = 0.01  # of squared coefficients of standardised columns, per row
_REWEIGHTINGS = 4  # of rows, towards least absolute errors
_LEAST_ERROR = 0.1  # of the median one: smaller ones have no more weight
_MOST_ENTRIES = 8  # of the errors whose rows are weighted, each for itself


class Prior(NamedTuple):
    """What the coefficients of a correction are pulled to, and how strongly."""

    penalty: float  #: of squared deviations from it, per row; infinite: it is taken
    movement: float = 1.0  #: share of the predicted movement that it keeps
    #: whether the mean absolute error is least, where errors have few entries; else it
    #: is the squared one, which the rows of the largest errors decide
    absolute: bool = False


@dataclass(frozen=True, eq=False)
class Correction:
    """Linear corrections of rollouts at some steps, and between them."""

    kinematics: Kinematics  #: has the features of the start
    steps: tuple[int, ...]  #: at which a regression stands (S,), increasing
    mean: Array  #: of the regressors (S, r)
    deviation: Array  #: likewise
    weights: Array  #: (S, 1 + r, e), the constant first

    @classmethod
    def fit_each(
        cls,
        kinematics: Kinematics,
        windows: Windows,
        predicted: Array,
        steps: Sequence[int],
        priors: Sequence[Prior],
    ) -> list["Correction"]:
        """Fits regressions to the errors of rollouts, one for each of several priors.

        Args:
            kinematics: Has the features of the start.
            windows: W of them, with ``max(ROWS_SEEN)`` rows of past or more.
            predicted: Rollouts (W, K, n).
            steps: At which a regression stands.
            priors: Of the coefficients.
        """
        moments = []
        for step in steps:
            measured = windows.states[:, windows.past + step]
            rollout = predicted[:, step - 1]
            moments.append(_moments(kinematics, windows, rollout, step, measured))
        return [
            cls(
                kinematics=kinematics,
                steps=tuple(steps),
                mean=np.array([one.mean for one in moments]),
                deviation=np.array([one.deviation for one in moments]),
                weights=np.array([_weights(one, prior) for one in moments]),
            )
            for prior in priors
        ]

    @staticmethod
    def average(corrections: "Sequence[Correction]", shares: Array) -> "Correction":
        """Averages corrections with the same steps.

        Args:
            corrections: A of them.
            shares: Of each, by step and entry of the errors (A, S, e).
        """
        first = corrections[0]
        weights = np.array(
            [one._weights_for(first.mean, first.deviation) for one in corrections]
        )
        averaged = np.einsum("ase,asre->sre", shares, weights)
        return replace(first, weights=averaged)

    @staticmethod
    def of_steps(corrections: "Sequence[Correction]") -> "Correction":
        """Returns the correction that stands at the steps of several, in their order.

        Args:
            corrections: Each at later steps than the one before.
        """
        return Correction(
            kinematics=corrections[0].kinematics,
            steps=tuple(step for one in corrections for step in one.steps),
            mean=np.concatenate([one.mean for one in corrections]),
            deviation=np.concatenate([one.deviation for one in corrections]),
            weights=np.concatenate([one.weights for one in corrections]),
        )

    def _weights_for(self, mean: Array, deviation: Array) -> Array:
        """Returns the weights (S, 1 + r, e) of regressors standardised otherwise.

        Args:
            mean: Of the regressors (S, r).
            deviation: Likewise.
        """
        slopes = self.weights[:, 1:] / self.deviation[..., None]
        weights = np.empty_like(self.weights)
        weights[:, 1:] = slopes * deviation[..., None]
        weights[:, 0] = self.weights[:, 0]
        weights[:, 0] += np.einsum("sr,sre->se", mean - self.mean, slopes)
        return weights

    def __call__(self, windows: Windows, predicted: Array) -> Array:
        """Corrects rollouts (W, K, n).

        It is linear between its steps; where the rollouts end between two of them, the
        correction of the last step that they reach is held. After the last of all it
        fades, to nothing at twice as many steps: the past has said what it has to say.
        """
        knots = [0]
        corrections = [np.zeros((len(windows), self.weights.shape[-1]))]
        for i, step in enumerate(self.steps):
            if step <= predicted.shape[1]:
                knots.append(step)
                corrections.append(self._at(i, windows, predicted[:, step - 1]))
        if len(knots) == 1:  # the rollouts end before the first step
            return predicted
        if predicted.shape[1] > self.steps[-1]:
            knots.append(2 * self.steps[-1])
            corrections.append(np.zeros_like(corrections[0]))
        values = np.stack(corrections, axis=1)
        ahead = np.arange(1, predicted.shape[1] + 1)
        after = np.clip(np.searchsorted(knots, ahead), 1, len(knots) - 1)
        low = np.array(knots)[after - 1]
        high = np.array(knots)[after]
        fraction = np.clip((ahead - low) / (high - low), 0, 1)[:, None]
        between = (1 - fraction) * values[:, after - 1] + fraction * values[:, after]
        return windows.space.displace(predicted, between)

    def _at(self, i: int, windows: Windows, predicted: Array) -> Array:
        """Computes the corrections (W, e) of states (W, n) at one of its steps."""
        regressors = _regressors(self.kinematics, windows, predicted, self.steps[i])
        z = _standardized(regressors, self.mean[i], self.deviation[i])
        return z @ self.weights[i]


@dataclass(frozen=True, eq=False)
class StartFilter:
    """Linear estimate of the state that a rollout begins in, from noisy rows."""

    kinematics: Kinematics  #: has the features of the start
    mean: Array  #: of the regressors (r,)
    deviation: Array  #: likewise
    weights: Array  #: (1 + r, e), the constant first

    @classmethod
    def fit(
        cls, kinematics: Kinematics, windows: Windows, states: Array, penalty: float
    ) -> "StartFilter":
        """Fits the estimate.

        Args:
            kinematics: Has the features of the start.
            windows: W of them, as measured.
            states: At their starts, without the noise (W, n).
            penalty: Of squared coefficients, per row.
        """
        start = windows.states[:, windows.past]
        moments = _moments(kinematics, windows, start, 0, states)
        weights = _weights(moments, Prior(penalty))
        return cls(kinematics, moments.mean, moments.deviation, weights)

    def __call__(self, windows: Windows) -> Array:
        """Estimates the states (W, n) at the starts of windows."""
        start = windows.states[:, windows.past]
        regressors = _regressors(self.kinematics, windows, start, 0)
        z = _standardized(regressors, self.mean, self.deviation)
        return windows.space.displace(start, z @ self.weights)


class _Moments(NamedTuple):
    """What a regression needs of W windows."""

    mean: Array  # of the regressors (r,)
    deviation: Array  # likewise
    normal: Array  # z^T z of the standardised regressors (1 + r, 1 + r)
    with_errors: Array  # z^T e (1 + r, e)
    z: Array  # (W, 1 + r)
    errors: Array  # (W, e)


def _moments(
    kinematics: Kinematics,
    windows: Windows,
    predicted: Array,
    step: int,
    measured: Array,
) -> _Moments:
    """Computes the moments of the errors of states (W, n) at a step."""
    regressors = _regressors(kinematics, windows, predicted, step)
    mean = regressors.mean(axis=0)
    # What moves by round-off keeps its unit: scaled to one it would be fitted as if it
    # said something.
    at_rest = _at_rest(windows, regressors)
    deviation = np.where(at_rest, 1.0, regressors.std(axis=0))
    z = _standardized(regressors, mean, deviation)
    errors = windows.space.difference(measured, predicted)
    return _Moments(mean, deviation, z.T @ z, z.T @ errors, z, errors)


def _weights(moments: _Moments, prior: Prior) -> Array:
    """Computes the weights (1 + r, e) with a prior.

    Those of the movement, which are the last ones, are not fitted.
    """
    weights = _expected_weights(moments, prior.movement)
    if np.isinf(prior.penalty):
        return weights
    entries = weights.shape[1]
    fitted = slice(0, len(weights) - entries)
    is_penalized = np.diag(np.r_[0.0, np.ones(len(moments.mean))])
    penalty = (prior.penalty * len(moments.z) * is_penalized)[fitted, fitted]
    missed = moments.with_errors - moments.normal @ weights
    normal = moments.normal[fitted, fitted]
    solution: Any = np.linalg.solve(normal + penalty, missed[fitted])
    if prior.absolute and entries <= _MOST_ENTRIES:
        errors = moments.errors - moments.z @ weights
        z = moments.z[:, fitted]
        for i in range(entries):
            solution[:, i] = _least_absolute(z, errors[:, i], penalty, solution[:, i])
    weights[fitted] += solution
    return weights


def _least_absolute(z: Array, errors: Array, penalty: Array, start: Array) -> Array:
    """Returns weights (r,) whose mean absolute error, about, is least.

    Rows are weighted by the inverse of what they miss, again and again (iteratively
    reweighted least squares). So the rows of a calm stretch decide as much as those of
    a wild one.

    Args:
        z: Regressors (W, r).
        errors: That they explain (W,).
        penalty: Of squared weights (r, r).
        start: Weights of least squares.
    """
    weights = start
    for _ in range(_REWEIGHTINGS):
        missed = np.abs(errors - z @ weights)
        least = _LEAST_ERROR * np.median(missed)
        if not least > 0:  # half of the rows are exact
            return weights
        of_rows = 1 / np.maximum(missed, least)
        weighted = z * (of_rows / of_rows.mean())[:, None]
        weights = np.linalg.solve(z.T @ weighted + penalty, weighted.T @ errors)
    return weights


def _expected_weights(moments: _Moments, movement: float) -> Array:
    """Returns the weights (1 + r, e) that keep a share of the movement, and no more.

    The movement is in the last regressors. What is taken off it is taken off its mean,
    by the constant, and off its standardised rest.
    """
    weights = np.zeros_like(moments.with_errors)
    entries = weights.shape[1]
    taken_off = movement - 1.0
    weights[0] = taken_off * moments.mean[-entries:]
    weights[-entries:] = np.diag(taken_off * moments.deviation[-entries:])
    return weights


def _regressors(
    kinematics: Kinematics, windows: Windows, predicted: Array, step: int
) -> Array:
    """Returns what is known of windows at their starts (W, r).

    It is features, past states and inputs, means of inputs to come, and the movement
    that is predicted. A step that is too near for as many means has zeros for the
    others.
    """
    start_row = windows.past
    inputs = windows.inputs
    start = windows.states[:, start_row]
    columns = [
        kinematics.features(start, inputs[:, start_row], windows.context[:, start_row])
    ]
    for rows in ROWS_SEEN:
        earlier = windows.states[:, start_row - rows]
        columns.append(windows.space.difference(start, earlier))
    for rows in ROWS_SEEN:
        columns.append(inputs[:, start_row - rows])
    for rows in np.array_split(np.arange(step), min(BINS, step)) if step else ():
        columns.append(inputs[:, start_row + rows].mean(axis=1))
    missing = max(BINS - step, 0) * inputs.shape[-1]
    columns.append(np.zeros((len(windows), missing)))
    columns.append(windows.space.difference(predicted, start))
    return np.concatenate(columns, axis=1)


def _at_rest(windows: Windows, regressors: Array) -> NDArray[np.bool_]:
    """Finds the regressors (r,) that move by no more than round-off.

    The round-off of a difference is that of the states: of a place on a map, not of
    the millimetres that a vehicle has moved since.
    """
    space = windows.space
    starts = windows.states[:, windows.past]
    entries = np.abs(space.difference(starts, space.origin)).max(axis=0)
    input_columns = (len(ROWS_SEEN) + BINS) * windows.inputs.shape[-1]
    differences = (len(ROWS_SEEN) + 1) * len(entries)
    features = regressors.shape[1] - differences - input_columns
    magnitudes = np.concatenate(
        [
            np.zeros(features),  # those and the inputs have their own
            np.tile(entries, len(ROWS_SEEN)),
            np.zeros(input_columns),
            entries,
        ]
    )
    return constant_columns(regressors, resolution=0.0, magnitudes=magnitudes)


def _standardized(regressors: Array, mean: Array, deviation: Array) -> Array:
    """Standardises regressors, with a column of ones before them."""
    ones = np.ones(len(regressors))
    return np.column_stack([ones, (regressors - mean) / deviation])
