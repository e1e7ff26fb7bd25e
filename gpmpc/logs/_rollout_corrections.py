"""Corrections by the past of the rollouts that held-out runs have.

Several are fitted, between the rollout as it is and a ridge regression that knows no
model, and averaged. Which of them are is chosen on whole runs, for each group of states
and step: each run, or block of one, is corrected by what the others say. The best one
comes first, then, one by one, that with which the mean is best (Caruana et al., 2004,
Ensemble selection from libraries of models). Each run counts alike, by its errors over
those of the ridge regression there: the runs to come may be like any of them. What is
chosen on a few runs is chosen by chance as well: of it as much is taken as the gains of
single runs agree, and up to a half of the average is the ridge regression where that
costs next to nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.models._correction import PENALTY, Correction, Prior
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._windows import Windows

_PARTS = 6  # of the held-out runs, each corrected by what the others say
_KNOTS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50)  # steps of a correction
_PRIORS = tuple(
    Prior(penalty, movement)
    for penalty in (np.inf, 10.0, 1.0, 0.1, 0.01, 0.001)
    for movement in (1.0, 0.5, 0.0)
)
_RIDGE = _PRIORS.index(Prior(PENALTY, 0.0))  # the ridge regression without a model
_NOTHING = 1e-300  # an error that is added, so that ratios of exact rollouts are one
_MEMBERS = 8  # of an average, at most; one may be in it several times
_RIDGE_SHARES = (0.5, 0.375, 0.25, 0.125)  # of an average, the first that costs little
_COST = 0.04  # of the mean error, that such a share may add


@dataclass(frozen=True)
class Rollouts:
    """Windows, and what a model predicts of them."""

    windows: Windows
    predicted: Array  # (W, steps, n)
    #: rows of the log at which the windows start (W,), where they are of parts of runs
    rows: np.ndarray | None = None

    def __getitem__(self, index: Any) -> "Rollouts":
        rows = None if self.rows is None else self.rows[index]
        return Rollouts(self.windows[index], self.predicted[index], rows)

    def distances(self, steps: Sequence[int]) -> Array:
        """Computes the errors (W, steps, groups) at some steps."""
        errors = self.windows.errors(self.predicted, steps)
        return self.windows.space.distances(errors)

    @classmethod
    def concatenate(cls, parts: Sequence["Rollouts"]) -> "Rollouts":
        """Concatenates rollouts of different runs, those of the first part first.

        The runs are numbered anew.
        """
        windows = [part.windows for part in parts]
        rows = [part.rows for part in parts if part.rows is not None]
        runs = []
        first = 0
        for one in windows:
            numbers, numbered = np.unique(one.runs, return_inverse=True)
            runs.append(first + numbered)
            first += len(numbers)
        joined = replace(
            windows[0],
            stride=min(one.stride for one in windows),
            states=np.concatenate([one.states for one in windows]),
            inputs=np.concatenate([one.inputs for one in windows]),
            context=np.concatenate([one.context for one in windows]),
            runs=np.concatenate(runs),
            times=np.concatenate([one.times for one in windows]),
        )
        return cls(
            windows=joined,
            predicted=np.concatenate([part.predicted for part in parts]),
            rows=np.concatenate(rows) if len(rows) == len(parts) else None,
        )


class Averages(NamedTuple):
    """Shares of corrections in their averages, and what is gained on other runs."""

    shares: Array  # of each prior (priors, judged steps, groups)
    ratios: Array  # of mean errors with and without (judged steps, groups)


def choose_averages(
    kinematics: Kinematics, rollouts: Rollouts, judged_steps: Sequence[int]
) -> Averages:
    """Chooses which corrections are averaged, for each judged step and group.

    Windows of the same run are no test of a correction, which follows what is common to
    them.

    Args:
        kinematics: Of the model.
        rollouts: Of all that was held out.
        judged_steps: Whose errors decide.
    """
    errors = _errors_on_other_runs(kinematics, rollouts, judged_steps)
    runs = rollouts.windows.runs
    columns_by_group = rollouts.windows.space.error_columns
    shares = np.empty((len(_PRIORS), len(judged_steps), len(columns_by_group)))
    ratios = np.empty(shares.shape[1:])
    for k in range(len(judged_steps)):
        for g, columns in enumerate(columns_by_group):
            own = errors[:, :, k, columns]
            shares[:, k, g] = _choose_shares(own, runs)
            averaged = _mean_length(_average(shares[:, k, g], own))
            # The first prior leaves the rollouts as they are.
            without = _mean_length(own[0])
            ratios[k, g] = (averaged + _NOTHING) / (without + _NOTHING)
    return Averages(shares, ratios)


def _errors_on_other_runs(
    kinematics: Kinematics, rollouts: Rollouts, judged_steps: Sequence[int]
) -> Array:
    """Computes errors (priors, W, judged steps, e), corrected by what others say."""
    windows = rollouts.windows
    shape = len(_PRIORS), len(windows), len(judged_steps), windows.space.error_dim
    errors = np.empty(shape)
    for is_own in _parts_of_whole_runs(windows):
        others = rollouts[_are_apart(rollouts, is_own)]
        own = rollouts[is_own]
        corrections = Correction.fit_each(
            kinematics=kinematics,
            windows=others.windows,
            predicted=others.predicted,
            steps=judged_steps,
            priors=_PRIORS,
        )
        for i, correction in enumerate(corrections):
            corrected = correction(own.windows, own.predicted)
            errors[i, is_own] = own.windows.errors(corrected, judged_steps)
    return errors


def _are_apart(rollouts: Rollouts, is_own: np.ndarray) -> np.ndarray:
    """Finds the windows (W,) of others that share no row with those of a part.

    The past of a block's first windows is the end of the block before: a correction
    that was fitted there has seen it, and is no test of itself. Where no window is
    apart, all others are taken.
    """
    if rollouts.rows is None:
        return ~is_own
    own_rows = np.sort(rollouts.rows[is_own])
    following = np.searchsorted(own_rows, rollouts.rows)
    next_row = own_rows[np.minimum(following, len(own_rows) - 1)]
    last_row = own_rows[np.maximum(following - 1, 0)]
    distances = np.minimum(
        np.abs(rollouts.rows - next_row), np.abs(rollouts.rows - last_row)
    )
    are_near = distances <= rollouts.windows.past + rollouts.windows.ahead
    are_apart = ~is_own & ~are_near
    return are_apart if are_apart.any() else ~is_own


def _choose_shares(errors: Array, runs: np.ndarray) -> Array:
    """Chooses the shares (A,) of an average of errors (A, W, e).

    Args:
        errors: Of each correction, on runs that it was not fitted to.
        runs: Number of the run of each window (W,).
    """
    weights = _weights_by_run(np.linalg.norm(errors[_RIDGE], axis=-1), runs)
    counts = np.zeros(len(errors))
    total = np.zeros(errors.shape[1:])
    least = np.inf
    for members in range(1, _MEMBERS + 1):
        scores = np.linalg.norm((total + errors) / members, axis=-1) @ weights
        best = scores.argmin()
        if scores[best] >= least:
            break
        least = scores[best]
        counts[best] += 1
        total = total + errors[best]
    shares = _without_chance(counts / counts.sum(), errors, runs, weights)
    return _with_ridge(shares, errors)


def _without_chance(
    shares: Array, errors: Array, runs: np.ndarray, weights: Array
) -> Array:
    """Moves shares (A,) to the rollout as it is, as far as the runs' gains disagree.

    With g the mean gain of a run and s its standard error, g^2 / (g^2 + s^2) of them
    stays.

    Args:
        shares: That were chosen (A,).
        errors: (A, W, e), those of the rollout as it is first.
        runs: Number of the run of each window (W,).
        weights: Of the windows (W,).
    """
    lengths = np.linalg.norm(errors[0], axis=-1)
    gains = lengths - np.linalg.norm(_average(shares, errors), axis=-1)
    by_run = np.bincount(np.unique(runs, return_inverse=True)[1], weights * gains)
    gain = by_run.mean()
    if gain <= 0:
        return np.eye(1, len(shares))[0]
    if len(by_run) < 2:
        return shares
    variance = by_run.var(ddof=1) / len(by_run)
    kept = gain**2 / (gain**2 + variance)
    moved = kept * shares
    moved[0] += 1 - kept
    return moved


def _with_ridge(shares: Array, errors: Array) -> Array:
    """Gives the ridge regression the largest share (A,) that costs next to nothing.

    Args:
        shares: Of the corrections (A,).
        errors: Of each (A, W, e).
    """
    most = (1 + _COST) * _mean_length(_average(shares, errors))
    for share in _RIDGE_SHARES:
        mixed = (1 - share) * shares
        mixed[_RIDGE] += share
        if _mean_length(_average(mixed, errors)) <= most:
            return mixed
    return shares


def _average(shares: Array, errors: Array) -> Array:
    """Averages errors (A, W, e) with shares (A,)."""
    return np.einsum("a,awe->we", shares, errors)


def _mean_length(errors: Array) -> float:
    """Computes the mean length of errors (W, e)."""
    return float(np.linalg.norm(errors, axis=-1).mean())


def _weights_by_run(reference: Array, runs: np.ndarray) -> Array:
    """Returns weights (W,) with which each run counts alike.

    Args:
        reference: Errors of the windows (W,), over whose mean in a run those of the run
            are taken.
        runs: Number of the run of each window (W,).
    """
    numbers = np.unique(runs, return_inverse=True)[1]
    total = np.bincount(numbers, reference)
    return 1 / (len(total) * np.maximum(total, _NOTHING))[numbers]


def fit_correction(
    kinematics: Kinematics,
    rollouts: Rollouts,
    judged_steps: Sequence[int],
    shares: Array,
) -> Correction:
    """Fits a correction of rollouts, at all of its steps.

    Args:
        kinematics: Of the model.
        rollouts: That are corrected.
        judged_steps: Those of the shares.
        shares: Of the corrections that are averaged (priors, judged steps, groups).
    """
    last = rollouts.windows.ahead
    knots = sorted({knot for knot in _KNOTS if knot < last} | {last})
    corrections = Correction.fit_each(
        kinematics=kinematics,
        windows=rollouts.windows,
        predicted=rollouts.predicted,
        steps=knots,
        priors=_PRIORS,
    )
    # Each knot has the shares of the nearest judged step.
    judged = np.log(judged_steps)
    nearest = [np.abs(judged - np.log(knot)).argmin() for knot in knots]
    entries = [group.error_dim for group in rollouts.windows.space.groups]
    by_entry = np.repeat(shares[:, nearest], entries, axis=2)
    return Correction.average(corrections, by_entry)


def _parts_of_whole_runs(windows: Windows) -> list[np.ndarray]:
    """Deals runs to parts; returns which windows are of each (W,)."""
    runs = np.unique(windows.runs)
    parts = np.array_split(runs, min(_PARTS, len(runs)))
    return [np.isin(windows.runs, part) for part in parts]
