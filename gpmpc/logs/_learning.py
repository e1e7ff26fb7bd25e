"""Learns a model from a log: its structure, its parameters, its GPs and its noise.

Nominal models of growing size are fitted on rollouts and compared on runs that they
were not fitted to. Then a GP on each group of outputs, with targets averaged over 1, 5
or 10 rows, stays only where the rollouts of held-out runs get better. The noise comes
from those rollouts as well.
"""

from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import check_number
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.logs._fitting import (
    PAST,
    STEPS,
    NominalFit,
    fit_least_squares,
    fit_nominal,
)
from gpmpc.logs._log import Log
from gpmpc.logs._noise import fit_noise
from gpmpc.logs._output_gps import train_output_gp
from gpmpc.logs._structures import (
    LATE,
    Candidate,
    GroupGP,
    Structure,
    additions,
    bases,
)
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._log_model import LogModel, OutputGP
from gpmpc.models._parametric import AffineNominal

_AVERAGES = (1, 5, 10)  # rows over which the targets of a GP are averaged
_JUDGED = (10, 50)  # steps whose errors decide
_GAIN = 0.01  # least relative improvement for which a model may grow
_LOSS = 0.05  # most relative loss in any group at any step
_WINDOWS = 200  # of a fold


@dataclass(frozen=True)
class IdentifiedModel:
    """A model identified from a log, and the record of its identification."""

    model: LogModel  #: fitted to all runs
    noise: OutputNoise  #: of its outputs
    fit: NominalFit  #: of the nominal part, to all runs
    candidates: tuple[Candidate, ...]  #: every structure that was tried, in order
    #: smallest and largest value (2, n + m) of the states and inputs in the log
    ranges: Array
    runs: tuple[str, ...]  #: names of the runs
    state_names: tuple[str, ...]  #: as the file's columns are called (n,)
    input_names: tuple[str, ...]  #: likewise (m,)
    context_names: tuple[str, ...]  #: likewise
    time_step: float  #: [s]


def learn(
    log: Log,
    points: int = 300,
    steps: int = STEPS,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
    memory: MutableMapping[str, Any] | None = None,
    for_control: bool = False,
) -> IdentifiedModel:
    """Learns a model of the outputs behind a log.

    Args:
        log: Of one run at least; several are split by run, one by time.
        points: Rows that a GP is trained on, chosen by k-means.
        steps: Of the rollouts.
        seed: Of every random number.
        progress: Called with a line at each stage.
        memory: Holds results of the stages, as plain data: those of an earlier call
            with equal arguments are not computed again.
        for_control: Leaves out what predicts such runs and no controller can plan with:
            the feedback of the controller that flew, and inputs that act late.

    Raises:
        DataError: The log is too short for rollouts of that many steps.
        TrainingError: A GP could not be trained.
    """
    check_number("points", points, least=10, whole=True)
    check_number("steps", steps, least=2, whole=True)
    advice = "Say kind: angle of it in the mapping"
    warn_of_turns(log.transitions(), log.space.angles, advice)
    search = Search(
        log=log,
        points=points,
        steps=steps,
        seed=seed,
        progress=progress,
        memory={} if memory is None else memory,
    )
    for base in bases(log):
        search.consider(base)
    for addition in additions(search.best.structure):
        structure = search.best.structure.extended(addition)
        if structure is not None and (addition.for_control or not for_control):
            search.consider(structure)
    for group in search.output_groups:
        for rows in _AVERAGES:
            search.consider(search.best.structure.with_gp(GroupGP(group, rows)))
    progress(f"chosen: {search.best.structure.name}")
    progress("noise from the errors of held-out rollouts")
    noise = search.fit_noise()
    progress("the chosen structure, fitted to all runs")
    fit = search.fit_to_all_runs()
    return IdentifiedModel(
        model=replace(fit.model, gps=search.train_on_all_runs(fit.model)),
        noise=noise,
        fit=fit,
        candidates=search.candidates,
        ranges=_ranges(log),
        runs=tuple(run.name for run in log),
        state_names=log.mapping.column_names("states"),
        input_names=log.mapping.column_names("inputs"),
        context_names=log.mapping.column_names("context"),
        time_step=log.time_step,
    )


def _ranges(log: Log) -> Array:
    """Returns the smallest and the largest value of states and inputs (2, n + m)."""
    values = np.concatenate([np.hstack([run.states, run.inputs]) for run in log])
    return np.stack([values.min(axis=0), values.max(axis=0)])


class Fold(NamedTuple):
    """A split of a log into runs that models are fitted to, and held-out runs."""

    train: Log
    held_out: Log


class Contender(NamedTuple):
    """The structure that is best so far, with its models: those of the folds."""

    structure: Structure
    models: list[LogModel]
    candidate_index: int  # of its record among the candidates


class Search:
    """A search for the structure whose rollouts of held-out runs are best.

    Args:
        log: All runs.
        points: Rows that a GP is trained on.
        steps: Of the rollouts.
        seed: Of every random number.
        progress: Called with a line for each structure.
        memory: By the key of a structure without GPs, the parameters of its nominal
            model by fold (lists of numbers); by the key of one with GPs, its errors.
    """

    def __init__(
        self,
        log: Log,
        points: int,
        steps: int,
        seed: int,
        progress: Callable[[str], None],
        memory: MutableMapping[str, Any],
    ):
        self._log = log
        self._points = points
        self._steps = steps
        self._seed = seed
        self._progress = progress
        # Two mappings in one, as files hold them: keys of structures with GPs differ.
        self._known_parameters: MutableMapping[str, list[list[float]]] = memory
        self._known_gp_errors: MutableMapping[str, list[list[float]]] = memory
        self._folds = split_folds(log)
        self._windows = [
            fold.held_out.windows(steps, past=PAST + LATE, most=_WINDOWS)
            for fold in self._folds
        ]
        self._candidates: list[Candidate] = []
        self._best: Contender | None = None

    @property
    def best(self) -> Contender:
        """The best structure so far.

        Raises:
            ValueError: None was considered.
        """
        if self._best is None:
            raise ValueError("no structure was considered")
        return self._best

    @property
    def output_groups(self) -> dict[str, tuple[int, ...]]:
        """Groups of outputs of the best structure, by name."""
        return self.best.structure.model.kinematics.output_groups

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """All structures that were considered, in order; the best one is chosen."""
        candidates = list(self._candidates)
        best = self.best.candidate_index
        candidates[best] = replace(candidates[best], chosen=True)
        return tuple(candidates)

    def consider(self, structure: Structure) -> None:
        """Makes a structure the best one if its rollouts are better."""
        if structure.gps:
            self._consider_gps(structure)
        else:
            self._consider_nominal(structure)

    def _consider_nominal(self, structure: Structure) -> None:
        """Considers a structure without GPs."""
        self._progress(f"{structure.name}: fitted on rollouts of {self._steps} steps")
        if structure.key not in self._known_parameters:
            fitted = self._fit_folds(structure)
            parameters = [model.theta.tolist() for model in fitted]
            self._known_parameters[structure.key] = parameters
        models = [
            replace(structure.model, theta=np.array(theta, dtype=float))
            for theta in self._known_parameters[structure.key]
        ]
        if self._enter(structure, self._errors(models)):
            self._make_best(structure, models)

    def _consider_gps(self, structure: Structure) -> None:
        """Considers a structure with GPs, of which the last one is new."""
        self._progress(structure.name)
        models = None
        if structure.key not in self._known_gp_errors:
            models = self._train_folds(structure)
            self._known_gp_errors[structure.key] = self._errors(models).tolist()
        errors = np.array(self._known_gp_errors[structure.key])
        if self._enter(structure, errors):
            self._make_best(structure, models or self._train_folds(structure))

    def _enter(self, structure: Structure, errors: Array) -> bool:
        """Enters a candidate; returns whether it is better than the best one so far."""
        self._candidates.append(Candidate(structure.name, errors))
        if self._best is None:
            return True
        return is_improvement(
            errors, self._candidates[self._best.candidate_index].errors
        )

    def _make_best(self, structure: Structure, models: list[LogModel]) -> None:
        """Makes the structure that was entered last the best one."""
        last = len(self._candidates) - 1
        self._best = Contender(structure, models, candidate_index=last)

    def _errors(self, models: Sequence[LogModel]) -> Array:
        """Computes mean errors of rollouts (steps, groups) on the held-out runs."""
        steps = [min(step, self._steps) for step in _JUDGED]
        errors = [
            model.rollout_errors(windows, steps)
            for windows, model in zip(self._windows, models, strict=True)
        ]
        return self._log.space.distances(np.concatenate(errors)).mean(axis=0)

    def _fit_folds(self, structure: Structure) -> list[LogModel]:
        """Fits the nominal model to each fold, from the best parameters so far."""
        simpler = [structure.model] * len(self._folds)
        if self._best is not None:
            simpler = self._best.models
        fits = [
            fit_from(model, structure.model, fold.train, self._steps)
            for model, fold in zip(simpler, self._folds, strict=True)
        ]
        return [fit.model for fit in fits]

    def _train_folds(self, structure: Structure) -> list[LogModel]:
        """Trains the last GP of a structure on each fold, beside those before it.

        ``learn`` goes through the groups one by one. So the best models have the GPs
        before it, and behind them at most one more: the GP on the same group, averaged
        over other rows, which the new one replaces.
        """
        others = len(structure.gps) - 1
        models = []
        for model, fold in zip(self.best.models, self._folds, strict=True):
            gp = self._train(structure.gps[-1], model, fold.train)
            models.append(replace(model, gps=(*model.gps[:others], gp)))
        return models

    def _train(self, gp: GroupGP, model: LogModel, log: Log) -> OutputGP:
        """Trains a GP on a group of outputs."""
        return train_output_gp(
            model=model,
            log=log,
            outputs=self.output_groups[gp.group],
            rows=gp.rows,
            points=self._points,
            seed=self._seed,
        )

    def fit_noise(self) -> OutputNoise:
        """Fits the noise of the best structure to the held-out runs."""
        held_out = [fold.held_out for fold in self._folds]
        return fit_noise(self.best.models, held_out, self._steps)

    def fit_to_all_runs(self) -> NominalFit:
        """Fits the nominal model of the best structure to all runs."""
        model = self.best.structure.model
        return fit_from(self.best.models[0], model, self._log, self._steps)

    def train_on_all_runs(self, model: LogModel) -> tuple[OutputGP, ...]:
        """Trains the GPs of the best structure on all runs."""
        gps = self.best.structure.gps
        return tuple(self._train(gp, model, self._log) for gp in gps)


def is_improvement(errors: Array, best: Array) -> bool:
    """Returns whether errors are smaller on the whole, and none is much larger."""
    logarithms = np.log(np.maximum(errors, 1e-12) / np.maximum(best, 1e-12))
    return bool(logarithms.mean() < -_GAIN and logarithms.max() < _LOSS)


def split_folds(log: Log) -> list[Fold]:
    """Splits a log into two folds by run; a single run by time."""
    if len(log.runs) == 1:
        halves = log.split_by_time(0.5)
        log = replace(log, runs=tuple(half.runs[0] for half in halves))
    names = [run.name for run in sorted(log.runs, key=len)]
    folds = []
    for i in range(2):
        train, held_out = log.split(names[i::2])
        folds.append(Fold(train, held_out))
    return folds


def fit_from(start_from: LogModel, model: LogModel, log: Log, steps: int) -> NominalFit:
    """Fits the nominal part of a model.

    Args:
        start_from: The search begins at the parameters that this fitted model has in
            common with the other.
        model: The model, whose parameters are not known yet.
        log: The data.
        steps: Of the rollouts.
    """
    nominal = model.nominal
    if isinstance(nominal, AffineNominal) and nominal.fitted:
        # It is linear in its many parameters.
        fitted = fit_least_squares(nominal.kinematics, log)
        fitted = replace(fitted, history=model.history)
        return NominalFit(fitted, standard_errors=np.empty(0))
    names = start_from.nominal.parameter_names
    fitted_values = dict(zip(names, start_from.theta, strict=False))
    defaults = zip(nominal.parameter_names, nominal.start, strict=True)
    theta0 = np.array([fitted_values.get(name, value) for name, value in defaults])
    return fit_nominal(model, theta0, log, steps)
