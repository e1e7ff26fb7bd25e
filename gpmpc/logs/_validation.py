"""Rollouts of held-out rows to which corrections and the noise are fitted."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._fitting import PAST, NominalFit, rows_before
from gpmpc.logs._folds import MANY_RUNS, Fold
from gpmpc.logs._log import Log, LogRun
from gpmpc.logs._noise import as_flown, fit_noise, learning_gains, noise_steps
from gpmpc.logs._rollout_corrections import (
    Averages,
    Rollouts,
    choose_averages,
    correction_steps,
    fit_correction,
)
from gpmpc.logs._structure_fits import StructureFits
from gpmpc.logs._structures import Structure
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._log_model import LogModel
from gpmpc.models._windows import Windows

_CORRECTED_WINDOWS = 2400  # that a correction is fitted to
_WINDOWS_WITHOUT_MODEL = 6000  # likewise, where it needs no rollout of a model
#: Rows grow by 4/3 from three quarters to all, by 3/2 from halves to three quarters.
_GAIN_EXPONENT = np.log(4 / 3) / np.log(3 / 2)
#: ranges of a state in the log, by which a rollout that a correction is fitted to may
#: leave it
_LARGEST_DEPARTURE = 1e6


class _Validation(NamedTuple):
    """Held-out rows, and a model without a correction that was fitted to the others."""

    fold: int  # number of the fold, of whose held-out rows they are all or a half
    train: Log  # the others
    held_out: Log
    model: LogModel
    rollouts: Rollouts  # of the held-out rows


class _Quarter(NamedTuple):
    """A half of what a fold holds out, and all other rows."""

    fold: int  # number of the fold
    rows: Fold


class Validations:
    """Structures fitted to parts of the rows, and rolled out on the others.

    Models of half the rows err more than the one of all. So where there are two folds,
    corrections and the noise are fitted to rollouts of models of three quarters, if
    there are rows enough for windows; else to those of the folds' own models.

    Args:
        log: All runs.
        folds: Of the log.
        fits: Of structures.
        past_rows: That any of them needs before the start of a rollout.
        steps: Of the rollouts.
        judged_steps: Those at which corrections are fitted.
    """

    def __init__(
        self,
        log: Log,
        folds: Sequence[Fold],
        fits: StructureFits,
        past_rows: int,
        steps: int,
        judged_steps: tuple[int, ...],
    ):
        self._log = log
        self._folds = folds
        self._fits = fits
        self._past_rows = past_rows
        self._steps = steps
        self._judged_steps = judged_steps
        self._validations: dict[str, list[_Validation]] = {}
        self._corrected_models: dict[str, list[LogModel]] = {}  # of the folds
        self._fold_rollouts: dict[str, list[Rollouts]] = {}
        states = np.concatenate([run.states for run in log])
        low = states.min(axis=0)
        high = states.max(axis=0)
        self._middle = (low + high) / 2  # of each state (n,)
        magnitude = np.maximum(np.abs(low), np.abs(high))
        # Of a state that never moves, its size; of zeros, one.
        size = np.where(magnitude > 0, magnitude, 1.0)
        self._range = np.where(high > low, high - low, size)  # (n,)

    def choose_averages(self, structure: Structure) -> Averages | None:
        """Chooses the best average of corrections of a structure.

        There is none where rollouts diverge on all that a model was not fitted to.
        """
        rollouts = [one.rollouts for one in self._validate(structure)]
        rollouts_of_folds = self._rollouts_of_folds(structure)
        if not all(len(one.windows) for one in (*rollouts, *rollouts_of_folds)):
            return None
        return choose_averages(
            kinematics=structure.model.kinematics,
            rollouts=Rollouts.concatenate(rollouts),
            judged_steps=self._judged_steps,
            constant_states=self._constant_states(self._log),
        )

    def corrected_models(self, structure: Structure) -> list[LogModel]:
        """Returns the models of a structure, one of each fold, with its correction.

        Those of a structure without one are the models that ``StructureFits`` has.
        """
        models = self._fits.models(structure)
        if not structure.correction_shares:
            return models
        if structure.key not in self._corrected_models:
            rollouts = self._rollouts_of_folds(structure)
            # What one fold holds out, the models of the others were fitted to.
            self._corrected_models[structure.key] = [
                self._correct(
                    model=model,
                    structure=structure,
                    rollouts=rollouts[:i] + rollouts[i + 1 :],
                    fitted_to=fold.train,
                )
                for i, (model, fold) in enumerate(zip(models, self._folds, strict=True))
            ]
        return self._corrected_models[structure.key]

    def _rollouts_of_folds(self, structure: Structure) -> list[Rollouts]:
        """Rolls the models of the folds out on what is held out, uncorrected."""
        key = structure.uncorrected.key
        if key not in self._fold_rollouts:
            models = self._fits.models(structure)
            self._fold_rollouts[key] = [
                self._rollouts(model, _unseen(fold, model).held_out)
                for model, fold in zip(models, self._folds, strict=True)
            ]
        return self._fold_rollouts[key]

    def fit_noise(self, structure: Structure) -> OutputNoise:
        """Fits the noise of a structure to the errors of its rollouts."""
        validations = self._validate(structure)
        models = []
        for validation in validations:
            others = [one.rollouts for one in validations if one is not validation]
            model = self._correct(
                model=validation.model,
                structure=structure,
                rollouts=others,
                fitted_to=validation.train,
            )
            models.append(model)
        held_out = [validation.held_out for validation in validations]
        steps = noise_steps(self._steps)
        has_quarters = len(validations) > len(self._folds)
        # Of many runs, how unlike they are decides, not how many rows they have.
        if not has_quarters or len(self._log.runs) >= MANY_RUNS:
            return fit_noise(models, held_out, steps)
        of_halves = self.corrected_models(structure)
        fewer = [of_halves[validation.fold] for validation in validations]
        gains = learning_gains(fewer, models, held_out, steps, _GAIN_EXPONENT)
        flown_gains = learning_gains(
            fewer=[as_flown(model) for model in fewer],
            models=[as_flown(model) for model in models],
            logs=held_out,
            steps=steps,
            exponent=_GAIN_EXPONENT,
        )
        return fit_noise(models, held_out, steps, gains, flown_gains)

    def fit_to_all_runs(self, structure: Structure) -> NominalFit:
        """Fits a structure to all runs, its GPs and its correction as well."""
        fit = self._fits.fit_to_all_runs(structure)
        rollouts = [validation.rollouts for validation in self._validate(structure)]
        model = self._correct(
            model=fit.model,
            structure=structure,
            rollouts=rollouts,
            fitted_to=self._log,
        )
        return replace(fit, model=model)

    def _validate(self, structure: Structure) -> list[_Validation]:
        """Fits a structure to parts of the rows, and rolls it out on the others."""
        structure = replace(structure, correction_shares=())
        if structure.key not in self._validations:
            validations = None
            if len(self._folds) == 2:
                validations = self._validate_on_quarters(structure)
            if validations is None:
                models = self._fits.models(structure)
                validations = [
                    self._validation(number, fold, model)
                    for number, (fold, model) in enumerate(
                        zip(self._folds, models, strict=True)
                    )
                ]
            self._validations[structure.key] = validations
        return self._validations[structure.key]

    def _validate_on_quarters(self, structure: Structure) -> list[_Validation] | None:
        """Fits a structure to three quarters of the rows; None where they are few."""
        try:
            quarters = self._quarters()
            models = [
                self._fits.fit_to(quarter.rows.train, structure).model
                for quarter in quarters
            ]
        except DataError:
            return None
        return [
            self._validation(quarter.fold, quarter.rows, model)
            for quarter, model in zip(quarters, models, strict=True)
        ]

    def _validation(self, number: int, rows: Fold, model: LogModel) -> _Validation:
        """Rolls out a model on the rows that it was not fitted to.

        Args:
            number: Of the fold.
            rows: Those of the fold, or a quarter of it.
            model: Without a correction.
        """
        rows = _unseen(rows, model)
        return _Validation(
            fold=number,
            train=rows.train,
            held_out=rows.held_out,
            model=model,
            rollouts=self._rollouts(model, rows.held_out),
        )

    def _quarters(self) -> list[_Quarter]:
        """Halves what each of two folds holds out, every other run or block of it.

        Raises:
            DataError: One would be without windows.
        """
        quarters = []
        for number, fold in enumerate(self._folds):
            runs = fold.held_out.runs
            for first in range(2):
                held_out_runs = runs[first::2]
                other_half = runs[1 - first :: 2]
                predicted = [
                    run.part(self._past_rows, len(run), "predicted")
                    for run in held_out_runs
                    if len(run) > self._past_rows
                ]
                # The past of a short block may reach into one that is held out.
                unseen = [_without_first(run, predicted, 0) for run in other_half]
                train_runs = (*fold.train.runs, *unseen)
                rows = Fold(
                    train=replace(fold.train, runs=train_runs),
                    held_out=replace(fold.held_out, runs=held_out_runs),
                )
                rows.held_out.windows(self._steps, past=self._past_rows, most=1)
                quarters.append(_Quarter(number, rows))
        return quarters

    def _rollouts(self, model: LogModel, held_out: Log) -> Rollouts:
        """Rolls a model out on held-out rows, and leaves out what diverges."""
        fraction = len(held_out) / len(self._log)
        windows = held_out.windows(
            ahead=self._steps,
            past=rows_before(model),
            most=max(round(fraction * _CORRECTED_WINDOWS), 1),
        )
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = model.rollout(windows)
            departures = np.abs(predicted - self._middle) / self._range
        stays_near = departures.max(axis=(1, 2)) < _LARGEST_DEPARTURE
        rows = self._rows_of(windows, held_out)
        return Rollouts(windows, predicted, rows)[stays_near]

    def _constant_states(self, part: Log) -> dict[int, Rollouts]:
        """Returns rollouts of a constant state on all that a part of the log has.

        For each step of a correction they are as long.
        """
        rollouts = {}
        for step in correction_steps(self._steps):
            windows = part.windows(step, past=PAST, most=_WINDOWS_WITHOUT_MODEL)
            rows = self._rows_of(windows, part)
            rollouts[step] = Rollouts.of_constant_state(windows, rows)
        return rollouts

    def _rows_of(self, windows: Windows, part: Log) -> np.ndarray:
        """Returns the rows of the log at which windows of a part of it start (W,).

        Runs count as far apart.
        """
        rows = np.empty(len(windows), dtype=int)
        first = 0
        for run in self._log:
            name = run.origin or run.name
            for number, own in enumerate(part):
                if (own.origin or own.name) == name:
                    is_own = windows.runs == number
                    places = np.searchsorted(run.time, windows.times[is_own])
                    rows[is_own] = first + places
            first += 2 * len(run) + len(self._log)
        return rows

    def _correct(
        self,
        model: LogModel,
        structure: Structure,
        rollouts: Sequence[Rollouts],
        fitted_to: Log,
    ) -> LogModel:
        """Adds the correction of a structure, if it has one.

        Args:
            model: Without a correction.
            structure: Of the model.
            rollouts: That are corrected.
            fitted_to: Rows that the model was fitted to.
        """
        if not structure.correction_shares:
            return model
        correction = fit_correction(
            kinematics=model.kinematics,
            rollouts=Rollouts.concatenate(rollouts),
            judged_steps=self._judged_steps,
            constant_states=self._constant_states(fitted_to),
            shares=np.array(structure.correction_shares),
        )
        return replace(model, correction=correction)


def _unseen(rows: Fold, model: LogModel) -> Fold:
    """Returns a fold of whose held-out rows a model predicts none that it has seen.

    Held-out blocks begin with the past that the most demanding structure needs, which
    may be rows of the training. A model that looks back on fewer would predict some.
    """
    past = rows_before(model)
    runs = [
        _without_first(run, rows.train.runs, kept=past + 1) for run in rows.held_out
    ]
    return rows._replace(held_out=replace(rows.held_out, runs=tuple(runs)))


def _without_first(run: LogRun, others: Sequence[LogRun], kept: int) -> LogRun:
    """Returns a run without its first rows, up to the last one that others have.

    Args:
        run: Which may be a part of a run of the log.
        others: Likewise.
        kept: So many of these rows stay.
    """
    name = run.origin or run.name
    times = [other.time for other in others if (other.origin or other.name) == name]
    if not times:
        return run
    shared = np.flatnonzero(np.isin(run.time, np.concatenate(times)))
    first = max(shared.max(initial=-1) + 1 - kept, 0)
    return run.part(first, len(run), "unseen") if first else run
