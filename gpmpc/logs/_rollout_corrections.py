"""Corrections by the past of the rollouts that held-out runs have.

Several are fitted, between the rollout as it is and a ridge regression that knows no
model, and averaged. Which of them are is chosen on whole runs, for each group of states
and step: each run, or block of one, is corrected by what the others say. The best one
comes first, then, one by one, that with which the mean is best (Caruana et al., 2004,
Ensemble selection from libraries of models).

Regressions that keep nothing of a rollout need none. They are fitted to windows of all
rows, at each step to all that reach so far. Windows of held-out blocks end where their
block ends: of short blocks that leaves half of all windows, and what is fitted to those
loses to the baseline.

What is best is told stretch by stretch: a run, or a part of one where there are few. On
each, errors are taken over those of what costs nothing, the ridge regression or a
constant state, whichever is better *there*; and being behind counts twice. (These are
the two of the baselines that are corrections as well; the other two are not among what
is averaged.) For the rows
to come may be like any of the stretches. A mean over all rows would be that of the
wildest ones, and what loses at rest would be chosen.

What is chosen on a few stretches is chosen by chance as well: of it as much is taken as
their gains agree. And up to a half of the average is what costs nothing, where that
costs next to nothing.
"""

from collections.abc import Mapping, Sequence
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
    for penalty in (np.inf, 10.0, 1.0, 0.1, PENALTY, 0.001)
    for movement in (1.0, 0.5, 0.0)
) + tuple(  # where stretches differ, the wildest one decides what is least squared
    Prior(PENALTY, movement, absolute=True) for movement in (1.0, 0.0)
)
_ROLLOUT = _PRIORS.index(Prior(np.inf, 1.0))  # as it is
_RIDGE = _PRIORS.index(Prior(PENALTY, 0.0))  # the ridge regression without a model
_STILL = _PRIORS.index(Prior(np.inf, 0.0))  # a constant state
_FREE = (_RIDGE, _STILL)  # what costs nothing: the baselines that are corrections
_SMALLEST_ERROR = 1e-300  # that is added, so that ratios of exact rollouts are one
_MEMBERS = 8  # of an average, at most; one may be in it several times
_HEDGE_SHARES = (0.5, 0.375, 0.25, 0.125)  # of what costs nothing, to be tried
_HEDGE_COST = 0.04  # regret that such a share may add
_STRETCHES = 8  # of all runs, about; at least one of each
_WINDOWS_OF_STRETCH = 2  # one after the other, that a stretch has rows for at least
# Of the error of what costs nothing: what is smaller, or larger, counts as this.
_LEAST_RATIO = 1e-4
_LARGEST_RATIO = 4.0
_LEAST_OF_MEDIAN = 0.05  # of stretches: the least error that others are compared with


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

    @classmethod
    def of_constant_state(
        cls, windows: Windows, rows: np.ndarray | None = None
    ) -> "Rollouts":
        """Returns rollouts of a state that stays where the windows start."""
        start = windows.states[:, windows.past : windows.past + 1]
        return cls(windows, np.repeat(start, windows.ahead, axis=1), rows)

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
    #: of mean errors over those of the rollout as it is (judged steps, groups)
    ratios_to_rollout: Array


def choose_averages(
    kinematics: Kinematics,
    rollouts: Rollouts,
    judged_steps: Sequence[int],
    constant_states: Mapping[int, Rollouts],
) -> Averages:
    """Chooses which corrections are averaged, for each judged step and group.

    Windows of the same run are no test of a correction, which follows what is common to
    them.

    Args:
        kinematics: Of the model.
        rollouts: Of all that was held out.
        judged_steps: Whose errors decide.
        constant_states: Rollouts on all windows that reach a judged step, by the step.
    """
    errors = _errors_on_other_runs(kinematics, rollouts, judged_steps, constant_states)
    stretches = _stretches_of(rollouts.windows)
    columns_by_group = rollouts.windows.space.error_columns
    shares = np.empty((len(_PRIORS), len(judged_steps), len(columns_by_group)))
    ratios = np.empty(shares.shape[1:])
    for k in range(len(judged_steps)):
        for g, columns in enumerate(columns_by_group):
            own = errors[:, :, k, columns]
            shares[:, k, g] = _choose_shares(own, _Regret(own, stretches))
            averaged = _mean_length(_average(shares[:, k, g], own))
            rolled_out = _mean_length(own[_ROLLOUT])
            ratios[k, g] = (averaged + _SMALLEST_ERROR) / (rolled_out + _SMALLEST_ERROR)
    return Averages(shares, ratios)


def _errors_on_other_runs(
    kinematics: Kinematics,
    rollouts: Rollouts,
    judged_steps: Sequence[int],
    constant_states: Mapping[int, Rollouts],
) -> Array:
    """Computes errors (priors, W, judged steps, e), corrected by what others say."""
    windows = rollouts.windows
    shape = len(_PRIORS), len(windows), len(judged_steps), windows.space.error_dim
    errors = np.empty(shape)
    for is_own in _parts_of_whole_runs(windows):
        own = rollouts[is_own]
        corrections = _fit_each(
            kinematics=kinematics,
            rollouts=_apart_from(own, rollouts),
            constant_states={
                step: _apart_from(own, constant_states[step]) for step in judged_steps
            },
            steps=judged_steps,
        )
        for i, correction in enumerate(corrections):
            corrected = correction(own.windows, own.predicted)
            errors[i, is_own] = own.windows.errors(corrected, judged_steps)
    return errors


def _fit_each(
    kinematics: Kinematics,
    rollouts: Rollouts,
    constant_states: Mapping[int, Rollouts],
    steps: Sequence[int],
) -> list[Correction]:
    """Fits a correction for each prior.

    Args:
        kinematics: Of the model.
        rollouts: Of held-out rows.
        constant_states: By each step, for the priors that keep nothing of a rollout.
        steps: At which a regression stands.
    """
    moving_priors = [prior for prior in _PRIORS if prior.movement]
    still_priors = [prior for prior in _PRIORS if not prior.movement]
    with_movement = Correction.fit_each(
        kinematics=kinematics,
        windows=rollouts.windows,
        predicted=rollouts.predicted,
        steps=steps,
        priors=moving_priors,
    )
    without_movement = [  # by step, then by prior
        Correction.fit_each(
            kinematics=kinematics,
            windows=constant_states[step].windows,
            predicted=constant_states[step].predicted,
            steps=(step,),
            priors=still_priors,
        )
        for step in steps
    ]
    by_prior = dict(zip(moving_priors, with_movement, strict=True))
    for prior, *of_steps in zip(still_priors, *without_movement, strict=True):
        by_prior[prior] = Correction.of_steps(of_steps)
    return [by_prior[prior] for prior in _PRIORS]


def _apart_from(own: Rollouts, rollouts: Rollouts) -> Rollouts:
    """Returns the rollouts that share no row with a part of them.

    The past of a block's first windows is the end of the block before: a correction
    that was fitted there has seen it, and is no test of itself. Where none is apart,
    all are taken that start elsewhere.
    """
    windows = rollouts.windows
    if rollouts.rows is None or own.rows is None:
        return rollouts[~np.isin(windows.runs, own.windows.runs)]
    distances = _distances_to_nearest(rollouts.rows, own.rows)
    are_apart = distances > own.windows.past + own.windows.ahead
    if not are_apart.any():
        are_apart = distances > 0
    return rollouts[are_apart]


def _distances_to_nearest(rows: np.ndarray, own_rows: np.ndarray) -> np.ndarray:
    """Computes how far rows (W,) are from the nearest one of some (V,)."""
    own_rows = np.sort(own_rows)
    insertions = np.searchsorted(own_rows, rows)
    # Before the first own row, and after the last, the same one is on both sides.
    after = own_rows[np.minimum(insertions, len(own_rows) - 1)]
    before = own_rows[np.maximum(insertions - 1, 0)]
    return np.minimum(np.abs(rows - after), np.abs(rows - before))


def _choose_shares(errors: Array, regret: "_Regret") -> Array:
    """Chooses the shares (A,) of an average of errors (A, W, e).

    Args:
        errors: Of each correction, on runs that it was not fitted to.
        regret: Of errors.
    """
    counts = np.zeros(len(errors))
    total = np.zeros(errors.shape[1:])
    least = np.inf
    for members in range(1, _MEMBERS + 1):
        averages = (total + errors) / members  # with each as the next member (A, W, e)
        regrets = regret.means(averages)
        best = regrets.argmin()
        if regrets[best] >= least:
            break
        least = regrets[best]
        counts[best] += 1
        total = total + errors[best]
    shares = _without_chance(counts / counts.sum(), errors, regret)
    return _with_hedge(shares, errors, regret)


class _Regret:
    """How far errors are ahead of what costs nothing, or behind, by stretches.

    Args:
        errors: Of each correction (A, W, e), among them what costs nothing.
        stretches: Number of the stretch of each window (W,).
    """

    def __init__(self, errors: Array, stretches: np.ndarray):
        self._stretches = stretches
        free = errors[list(_FREE)]
        least = self._mean_lengths(free).min(axis=0)
        # Where nothing moves a constant state is exact, and everything else infinitely
        # far behind it.
        self._least = np.maximum(least, _LEAST_OF_MEDIAN * np.median(least))

    def by_stretch(self, errors: Array) -> Array:
        """Computes the regrets (..., stretches) of errors (..., W, e).

        They are logarithms of mean errors over those of what costs nothing; positive
        ones count twice, and no stretch counts more than one that is four times behind.
        """
        ratios = (self._mean_lengths(errors) + _SMALLEST_ERROR) / (
            self._least + _SMALLEST_ERROR
        )
        logarithms = np.log(np.clip(ratios, _LEAST_RATIO, _LARGEST_RATIO))
        return logarithms + np.maximum(logarithms, 0.0)

    def means(self, errors: Array) -> Array:
        """Computes the mean regrets (...) of errors (..., W, e)."""
        return self.by_stretch(errors).mean(axis=-1)

    def _mean_lengths(self, errors: Array) -> Array:
        """Computes the mean lengths (..., stretches) of errors (..., W, e)."""
        lengths = np.linalg.norm(errors, axis=-1)
        is_of = np.eye(self._stretches.max() + 1)[self._stretches]
        return lengths @ (is_of / is_of.sum(axis=0))


def _stretches_of(windows: Windows) -> np.ndarray:
    """Returns the number of the stretch that each window is of (W,).

    A run, or a block of one, is a stretch; where there are few, they are cut into as
    many as have rows for some windows one after the other.
    """
    runs = np.unique(windows.runs, return_inverse=True)[1]
    first_times = np.full(runs.max() + 1, np.inf)
    np.minimum.at(first_times, runs, windows.times)
    # Of each window, since the first one of its run (W,).
    rows = (windows.times - first_times[runs]) / windows.time_step
    rows -= _rows_of_pauses(windows)
    lengths = np.zeros(len(first_times))  # of each run, in rows
    np.maximum.at(lengths, runs, rows)
    lengths += windows.ahead
    proportional = np.round(_STRETCHES * lengths / lengths.sum())
    affordable = lengths // (_WINDOWS_OF_STRETCH * windows.ahead)
    stretches_per_run = np.maximum(np.minimum(proportional, affordable), 1)
    starts_per_run = np.maximum(lengths - windows.ahead + 1, 1)
    stretch_in_run = np.floor(rows * (stretches_per_run / starts_per_run)[runs])
    numbers = runs * (_STRETCHES + 1) + stretch_in_run
    # A gap may leave one of them empty: they are numbered anew.
    return np.unique(numbers, return_inverse=True)[1]


def _rows_of_pauses(windows: Windows) -> Array:
    """Counts the time steps (W,) that a run paused for before each of its windows.

    Starts in neighbouring pieces are a past and the steps ahead apart, and a stride.
    That of a run is the least distance of its windows: those of folds are not alike.
    """
    distances = np.diff(windows.times) / windows.time_step
    is_same_run = np.diff(windows.runs) == 0
    runs = np.unique(windows.runs, return_inverse=True)[1]
    strides = np.full(runs.max() + 1, np.inf)
    np.minimum.at(strides, runs[1:][is_same_run], distances[is_same_run])
    longest = windows.past + windows.ahead + strides[runs[1:]]
    pauses = np.where(is_same_run, np.maximum(distances - longest, 0.0), 0.0)
    before = np.concatenate([[0.0], np.cumsum(pauses)])
    first = np.flatnonzero(np.r_[True, ~is_same_run])
    return before - before[first][runs]


def _without_chance(shares: Array, errors: Array, regret: _Regret) -> Array:
    """Moves shares (A,) to the best single correction, as far as gains disagree.

    That is the rollout as it is, the ridge regression or a constant state. With g the
    mean gain of a stretch upon it and s its standard error, g^2 / (g^2 + s^2) of the
    shares stays.

    Args:
        shares: That were chosen (A,).
        errors: Of each correction (A, W, e).
        regret: Of errors.
    """
    singles = np.array([_ROLLOUT, *_FREE])
    single = singles[regret.means(errors[singles]).argmin()]
    of_single = regret.by_stretch(errors[single])
    gains = of_single - regret.by_stretch(_average(shares, errors))
    gain = gains.mean()
    if gain <= 0 or len(gains) < 2:  # of one stretch all may be chance
        return np.eye(len(shares))[single]
    variance = gains.var(ddof=1) / len(gains)
    agreement = gain**2 / (gain**2 + variance)
    shrunk = agreement * shares
    shrunk[single] += 1 - agreement
    return shrunk


def _with_hedge(shares: Array, errors: Array, regret: _Regret) -> Array:
    """Gives what costs nothing the largest share (A,) that costs next to nothing.

    Args:
        shares: Of the corrections (A,).
        errors: Of each (A, W, e).
        regret: Of errors.
    """
    free = np.array(_FREE)
    best = free[regret.means(errors[free]).argmin()]
    largest = regret.means(_average(shares, errors)) + _HEDGE_COST
    for hedge in _HEDGE_SHARES:
        hedged = (1 - hedge) * shares
        hedged[best] += hedge
        if regret.means(_average(hedged, errors)) <= largest:
            return hedged
    return shares


def _average(shares: Array, errors: Array) -> Array:
    """Averages errors (A, W, e) with shares (A,)."""
    return np.einsum("a,awe->we", shares, errors)


def _mean_length(errors: Array) -> float:
    """Computes the mean length of errors (W, e)."""
    return float(np.linalg.norm(errors, axis=-1).mean())


def correction_steps(last: int) -> list[int]:
    """Returns the steps at which a correction stands, up to the last one."""
    return sorted({knot for knot in _KNOTS if knot < last} | {last})


def fit_correction(
    kinematics: Kinematics,
    rollouts: Rollouts,
    judged_steps: Sequence[int],
    constant_states: Mapping[int, Rollouts],
    shares: Array,
) -> Correction:
    """Fits a correction of rollouts, at all of its steps.

    Args:
        kinematics: Of the model.
        rollouts: That are corrected.
        judged_steps: Those of the shares.
        constant_states: Rollouts on all windows that reach a step, by the step.
        shares: Of the corrections that are averaged (priors, judged steps, groups).
    """
    knots = correction_steps(rollouts.windows.ahead)
    corrections = _fit_each(kinematics, rollouts, constant_states, knots)
    # Each knot has the shares of the nearest judged step.
    judged = np.log(judged_steps)
    nearest = [np.abs(judged - np.log(knot)).argmin() for knot in knots]
    entries = [group.error_dim for group in rollouts.windows.space.groups]
    by_entry = np.repeat(shares[:, nearest], entries, axis=2)
    return Correction.average(corrections, by_entry)


def _parts_of_whole_runs(windows: Windows) -> list[np.ndarray]:
    """Deals runs to parts; returns which windows are of each (W,)."""
    runs = np.unique(windows.runs)
    runs_of_parts = np.array_split(runs, min(_PARTS, len(runs)))
    return [np.isin(windows.runs, own) for own in runs_of_parts]
