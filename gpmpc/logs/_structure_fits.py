"""Models of structures, fitted to the rows of each fold, and at last to all.

Rows that are noisy are smoothed before; a memory filters the noise by itself and is
fitted to them as they are.
"""

from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._fit_form import fit_from
from gpmpc.logs._fitting import PAST, NominalFit
from gpmpc.logs._folds import Fold
from gpmpc.logs._linear_terms import choose_penalties
from gpmpc.logs._log import Log
from gpmpc.logs._output_gps import train_output_gp
from gpmpc.logs._smoothing import smooth
from gpmpc.logs._structures import GroupGP, Structure
from gpmpc.models._correction import StartFilter
from gpmpc.models._grouped import GroupedNominal
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._log_model import LogModel, OutputGP

_FILTERED_WINDOWS = 4000  # that the filter of starts is fitted to
_FILTER_PENALTY = 1e-4  # of squared coefficients of the filter of starts, per row


class _TrainingData(NamedTuple):
    """What models are fitted to."""

    log: Log  # smoothed, where its rows are noisy
    start_filter: StartFilter | None  # None where they are not


class StructureFits:
    """Fits of structures to the training rows of each fold, each made once.

    Args:
        log: All runs.
        folds: Of the log.
        kinematics: Of all models.
        points: Rows that a GP is trained on.
        steps: Of the rollouts.
        seed: Of every random number.
        results: By the key of a structure without GPs, the parameters of its nominal
            model by fold (lists of numbers); by "penalties of" a key, those of its
            outputs. What ``Search`` keeps there stays as it is.
    """

    def __init__(
        self,
        log: Log,
        folds: Sequence[Fold],
        kinematics: Kinematics,
        points: int,
        steps: int,
        seed: int,
        results: MutableMapping[str, Any],
    ):
        self._log = log
        self._folds = folds
        self._kinematics = kinematics
        self._points = points
        self._steps = steps
        self._seed = seed
        self._results = results
        self._nominal_models: dict[str, list[LogModel]] = {}
        self._gps: dict[tuple[str, GroupGP], list[OutputGP]] = {}
        self._fits: dict[str, NominalFit] = {}  # to all rows
        # What models are fitted to, and how their rollouts start, by fold.
        self._training = [self._training_data(fold.train) for fold in folds]

    def fit_nominal(
        self, structure: Structure, parent: Structure | None
    ) -> list[LogModel]:
        """Fits a nominal structure on each fold, from the parameters of another."""
        data = self._training_of(structure)
        if structure.key not in self._results:
            starts = [structure.model] * len(self._folds)
            if parent is not None:  # whose models were fitted on the same folds
                starts = self._nominal_models[parent.key]
            fits = [
                fit_from(
                    start_from=start,
                    model=structure.model,
                    log=training.log,
                    steps=self._steps,
                    choose_penalties=self._penalties_of(structure),
                    starts_on_same_log=parent is not None,
                ).model
                for start, training in zip(starts, data, strict=True)
            ]
            self._results[structure.key] = [model.parameters for model in fits]
        models = [
            replace(
                structure.model.with_parameters(parameters),
                start_filter=training.start_filter,
            )
            for parameters, training in zip(
                self._results[structure.key], data, strict=True
            )
        ]
        self._nominal_models[structure.key] = models
        return models

    def combine(
        self, parts: tuple[tuple[Structure, tuple[str, ...]], ...]
    ) -> Structure | None:
        """Combines nominal structures that were fitted, each with groups of outputs.

        Returns None where they do not fit.
        """
        by_fold = [
            combine_models(
                [self._nominal_models[part.key][i] for part, _ in parts],
                [groups for _, groups in parts],
            )
            for i in range(len(self._folds))
        ]
        models = [model for model in by_fold if model is not None]
        if len(models) < len(by_fold):
            return None
        first = parts[0][0]
        structure = replace(
            first, base="", model=models[0], ranges=(), additions=(), parts=parts
        )
        self._nominal_models[structure.key] = models
        return structure

    def models(self, structure: Structure) -> list[LogModel]:
        """Returns the models of a structure, one of each fold, without corrections."""
        nominals = self._nominal_models[structure.nominal.key]
        gps = [self._trained(structure, gp) for gp in structure.gps]
        return [
            replace(nominal, gps=tuple(trained[i] for trained in gps))
            for i, nominal in enumerate(nominals)
        ]

    def fit_to_all_runs(self, structure: Structure) -> NominalFit:
        """Fits a structure to all runs, without its correction, once."""
        key = structure.uncorrected.key
        if key not in self._fits:
            self._fits[key] = self.fit_to(self._log, structure)
        return self._fits[key]

    def fit_to(self, log: Log, structure: Structure) -> NominalFit:
        """Fits a structure to a log, without its correction."""
        training = _TrainingData(log, None)
        if structure.model.memory.empty:
            training = self._training_data(log)
        fit = self._fit_nominal_to(training.log, structure.nominal)
        gps = tuple(self._train(gp, fit.model, training.log) for gp in structure.gps)
        model = replace(fit.model, gps=gps, start_filter=training.start_filter)
        return replace(fit, model=model)

    def _training_data(self, log: Log) -> _TrainingData:
        """Smooths a log, and fits the filter of starts, where its rows are noisy."""
        smoothed = smooth(log, self._kinematics, self._seed)
        if smoothed is None:
            return _TrainingData(log, None)
        windows = log.windows(0, past=PAST, most=_FILTERED_WINDOWS)
        states = smoothed.windows(0, past=PAST, most=_FILTERED_WINDOWS).states
        start_filter = StartFilter.fit(
            self._kinematics, windows, states[:, PAST], _FILTER_PENALTY
        )
        return _TrainingData(smoothed, start_filter)

    def _training_of(self, structure: Structure) -> list[_TrainingData]:
        """Returns what a structure is fitted to, by fold."""
        if structure.model.memory.empty:
            return self._training
        return [_TrainingData(fold.train, None) for fold in self._folds]

    def _trained(self, structure: Structure, gp: GroupGP) -> list[OutputGP]:
        """Returns a GP on a group of outputs, trained on each fold."""
        key = structure.nominal.key, gp
        if key not in self._gps:
            nominals = self._nominal_models[structure.nominal.key]
            self._gps[key] = [
                self._train(gp, model, training.log)
                for model, training in zip(
                    nominals, self._training_of(structure), strict=True
                )
            ]
        return self._gps[key]

    def _train(self, gp: GroupGP, model: LogModel, log: Log) -> OutputGP:
        """Trains a GP on a group of outputs."""
        return train_output_gp(
            model=model,
            log=log,
            outputs=model.kinematics.output_groups[gp.group],
            rows=gp.rows,
            points=self._points,
            seed=self._seed,
            sees_memory=gp.sees_past,
        )

    def _penalties_of(self, structure: Structure) -> Callable[[LogModel], Array]:
        """Returns what chooses the penalties (o,) of a structure: once, on all rows.

        It takes the first model that was fitted but for the linear term.
        """
        key = f"penalties of {structure.key}"

        def choose(model: LogModel) -> Array:
            if key not in self._results:
                penalties = choose_penalties(model, self._log, self._steps)
                self._results[key] = penalties.tolist()
            return np.array(self._results[key])

        return choose

    def _fit_nominal_to(self, log: Log, structure: Structure) -> NominalFit:
        """Fits a nominal structure to a log."""
        if not structure.parts:
            start = self._nominal_models[structure.key][0]
            return fit_from(
                start_from=start,
                model=structure.model,
                log=log,
                steps=self._steps,
                choose_penalties=self._penalties_of(structure),
            )
        fits = [self._fit_nominal_to(log, part) for part, _ in structure.parts]
        groups = [groups for _, groups in structure.parts]
        model = combine_models([fit.model for fit in fits], groups)
        assert model is not None
        errors = [
            fit.standard_errors
            if len(fit.standard_errors)
            else np.full(len(fit.model.theta), np.nan)
            for fit in fits
        ]
        return NominalFit(model, np.concatenate(errors))


def combine_models(
    models: Sequence[LogModel], groups: Sequence[Sequence[str]]
) -> LogModel | None:
    """Combines nominal models by groups of outputs; None where they do not fit.

    Args:
        models: Without GPs, of the same kinematics.
        groups: Names of the groups of outputs that come from each.
    """
    forms = {(model.lag, model.memory, len(model.time_constants)) for model in models}
    if len(forms) > 1 or len(models[0].time_constants):
        return None
    names = models[0].kinematics.output_groups
    outputs = [tuple(i for name in own for i in names[name]) for own in groups]
    history = list(models[0].history)
    weights = models[0].weights.copy()
    without_nominal: list[int] = []
    for model, indices in zip(models, outputs, strict=True):
        without_nominal += [i for i in indices if i in model.without_nominal]
        for i in indices:
            history[i] = model.history[i]
        if len(weights):
            weights[list(indices)] = model.weights[list(indices)]
    return replace(
        models[0],
        nominal=GroupedNominal(
            parts=tuple(model.nominal for model in models),
            outputs_of=tuple(outputs),
            sizes=tuple(len(model.theta) for model in models),
        ),
        theta=np.concatenate([model.theta for model in models]),
        history=tuple(history),
        weights=weights,
        without_nominal=tuple(without_nominal),
    )
