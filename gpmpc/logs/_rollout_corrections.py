"""Corrections by the past of the rollouts that held-out runs have.

Their penalties are chosen on whole runs: each run, or block of one, is corrected by
what the others say.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.models._correction import Correction
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._windows import Windows

_PARTS = 6  # of the held-out runs, each corrected by what the others say
_KNOTS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50)  # steps of a correction
_PENALTIES = (0.001, 0.01, 0.1, 1.0, 10.0, np.inf)  # tried of a correction


@dataclass(frozen=True)
class Rollouts:
    """Windows, and what a model predicts of them."""

    windows: Windows
    predicted: Array  # (W, steps, n)

    def __getitem__(self, rows: Any) -> "Rollouts":
        return Rollouts(self.windows[rows], self.predicted[rows])

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
        return cls(joined, np.concatenate([part.predicted for part in parts]))


class ChosenPenalties(NamedTuple):
    """Penalties of a correction, and what it gains with them on other runs."""

    penalties: Array  # the best ones (judged steps, groups)
    ratios: Array  # of mean errors with and without the correction, likewise


def choose_penalties(
    kinematics: Kinematics, rollouts: Rollouts, judged_steps: Sequence[int]
) -> ChosenPenalties:
    """Chooses the penalties of a correction, for each judged step and group.

    Windows of the same run are no test of a correction, which follows what is common to
    them.

    Args:
        kinematics: Of the model.
        rollouts: Of all that was held out.
        judged_steps: Whose errors decide.
    """
    without = rollouts.distances(judged_steps)
    alternatives = [np.full(without.shape[1:], one) for one in _PENALTIES]
    distances = np.empty((len(_PENALTIES), *without.shape))
    for is_own in _parts_of_whole_runs(rollouts.windows):
        corrections = _fit_corrections(
            kinematics=kinematics,
            rollouts=rollouts[~is_own],
            knots=judged_steps,
            judged_steps=judged_steps,
            alternatives=alternatives,
        )
        own = rollouts[is_own]
        for i, correction in enumerate(corrections):
            corrected = replace(own, predicted=correction(own.windows, own.predicted))
            distances[i, is_own] = corrected.distances(judged_steps)
    ratios = distances.mean(axis=1) / without.mean(axis=0)
    best = np.argmin(ratios, axis=0)
    return ChosenPenalties(np.array(_PENALTIES)[best], np.min(ratios, axis=0))


def fit_correction(
    kinematics: Kinematics,
    rollouts: Rollouts,
    judged_steps: Sequence[int],
    penalties: Array,
) -> Correction:
    """Fits a correction of rollouts, at all of its steps.

    Args:
        kinematics: Of the model.
        rollouts: That are corrected.
        judged_steps: Those of the penalties.
        penalties: (judged steps, groups).
    """
    last = rollouts.windows.ahead
    knots = sorted({knot for knot in _KNOTS if knot < last} | {last})
    (correction,) = _fit_corrections(
        kinematics=kinematics,
        rollouts=rollouts,
        knots=knots,
        judged_steps=judged_steps,
        alternatives=[penalties],
    )
    return correction


def _fit_corrections(
    kinematics: Kinematics,
    rollouts: Rollouts,
    knots: Sequence[int],
    judged_steps: Sequence[int],
    alternatives: Sequence[Array],
) -> list[Correction]:
    """Fits corrections of rollouts, with each of some penalties.

    Args:
        kinematics: Of the model.
        rollouts: That are corrected.
        knots: Steps of the corrections; each has the penalty of the nearest judged
            step.
        judged_steps: Those of the penalties.
        alternatives: Penalties (judged steps, groups).
    """
    judged = np.log(judged_steps)
    nearest = [np.abs(judged - np.log(knot)).argmin() for knot in knots]
    entries = [group.error_dim for group in rollouts.windows.space.groups]
    return Correction.fit_each(
        kinematics=kinematics,
        windows=rollouts.windows,
        predicted=rollouts.predicted,
        steps=knots,
        alternatives=[
            np.repeat(penalties[nearest], entries, axis=1) for penalties in alternatives
        ],
    )


def _parts_of_whole_runs(windows: Windows) -> list[np.ndarray]:
    """Deals runs to parts; returns which windows are of each (W,)."""
    runs = np.unique(windows.runs)
    parts = np.array_split(runs, min(_PARTS, len(runs)))
    return [np.isin(windows.runs, part) for part in parts]
