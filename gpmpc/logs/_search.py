"""Searches for the structure whose rollouts of held-out rows are best.

1. Nominal structures: every base, with one term more or less at a time; the best one
   of each round goes on, and the second one if it is close.
2. Groups of outputs: those of one nominal structure, the others of another.
3. GPs on the groups of outputs, from none and from all at once, by the change of one
   group at a time that helps most.
4. A correction by the past upon the best structure.

A structure's score is the mean, over groups and steps, of the logarithm of its error
over that of the best baseline; where it is behind, that counts twice. A simulation of
hundreds of steps, over the spread of what is simulated, counts as one step more.
"""

from collections.abc import Iterable, Mapping, MutableMapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._baselines import CONSTANT_STATE, baseline_errors
from gpmpc.logs._comparison import Comparison, compare
from gpmpc.logs._fit_form import fit_from
from gpmpc.logs._fitting import NominalFit
from gpmpc.logs._folds import Fold
from gpmpc.logs._free_simulation import FreeSimulation
from gpmpc.logs._log import Log
from gpmpc.logs._noise import fit_noise
from gpmpc.logs._output_gps import train_output_gp
from gpmpc.logs._rollout_corrections import (
    Rollouts,
    choose_averages,
    fit_correction,
)
from gpmpc.logs._smoothing import smooth
from gpmpc.logs._stability import grows_outside
from gpmpc.logs._structures import (
    MOST_PAST,
    Candidate,
    GroupGP,
    Structure,
    additions,
    bases,
)
from gpmpc.models._correction import StartFilter
from gpmpc.models._grouped import GroupedNominal
from gpmpc.models._kinematics import RigidBodyKinematics
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._log_model import LogModel, OutputGP
from gpmpc.models._parametric import AffineNominal

_WINDOWS_OF_LAGS = 4  # that a log is to hold where inputs act through lags
PAST_ROWS = MOST_PAST  # of the windows that structures are compared on
_AVERAGES = (1, 5, 10)  # rows over which the targets of a GP are averaged
_JUDGED = (1, 10, 50)  # steps whose errors decide
_PIECE = 0.02  # of the score that every piece of a structure has to earn
_BEAM = 2  # structures that go on, of a round
_CLOSE = 0.02  # of the best score: where the second one goes on as well
_WINDOWS = 400  # that structures are compared on
_CORRECTED_WINDOWS = 2400  # that a correction is fitted to
_LARGEST = 1e6  # state of a rollout that a correction is fitted to
_FILTERED_WINDOWS = 4000  # that the filter of starts is fitted to
_FILTER_PENALTY = 1e-4  # of squared coefficients of the filter of starts, per row
_ROWS_SEEN = 8  # most past rows that a GP sees
_EXACT = 1e-4  # of a constant state's error: what is smaller counts as exact
_NOTHING = 1e-9  # of the outputs: a residual that is none
_OUT_OF_REACH = 0.5  # mean logarithm by which rollouts are too bad to be simulated
_UNSTABLE = 10.0  # of the score of what grows without bounds outside of its data
_LOSS = 2.0  # weight of being behind a baseline
_ROUNDS = 8  # of changes of the GPs of one nominal structure, at most


class _TrainingData(NamedTuple):
    """What models are fitted to."""

    log: Log  # smoothed, where its rows are noisy
    start_filter: StartFilter | None  # None where they are not


class _Validation(NamedTuple):
    """Held-out rows, and a model without a correction that was fitted to the others."""

    held_out: Log
    model: LogModel
    rollouts: Rollouts  # of the held-out rows


class Search:
    """A search for the structure whose rollouts of held-out rows are best.

    Args:
        log: All runs.
        folds: Of the log.
        points: Rows that a GP is trained on.
        steps: Of the rollouts.
        seed: Of every random number.
        progress: Called with a line for each structure.
        memory: By the key of a structure without GPs, the parameters of its nominal
            model by fold (lists of numbers); of any other, its errors.
        for_control: Leaves out what no controller can plan with.
    """

    def __init__(
        self,
        log: Log,
        folds: Sequence[Fold],
        points: int,
        steps: int,
        seed: int,
        progress: Any,
        memory: MutableMapping[str, Any],
        for_control: bool,
    ):
        self._log = log
        self._folds = folds
        self._points = points
        self._steps = steps
        self._seed = seed
        self._progress = progress
        self._memory = memory
        self._for_control = for_control
        self._bases = bases(log)
        self.judged_steps = tuple(sorted({min(step, steps) for step in _JUDGED}))
        self._windows = [
            fold.held_out.windows(steps, past=PAST_ROWS, most=_WINDOWS // len(folds))
            for fold in folds
        ]
        self._nominal_models: dict[str, list[LogModel]] = {}
        self._gps: dict[tuple[str, GroupGP], list[OutputGP]] = {}
        self._structures: dict[str, Structure] = {}
        self._errors: dict[str, Array] = {}
        self._validations: dict[str, list[_Validation]] = {}
        self._baselines = self._baseline_distances()
        # What models are fitted to, and how their rollouts start, by fold.
        self._training = [self._training_data(fold.train) for fold in folds]
        still = self._baselines[CONSTANT_STATE].mean(axis=0)
        self._exact = _EXACT * still + 1e-12
        self._scale = self._best_baseline_errors()
        self._simulation: FreeSimulation | None = None
        if not for_control:
            self._simulation = FreeSimulation.of(folds, PAST_ROWS, steps)
        self._simulated: dict[str, Array] = {}
        self._best_logarithm = np.inf  # mean of the errors of rollouts, over baselines
        self._unstable: set[str] = set()  # keys of nominal structures
        self._fits: dict[str, NominalFit] = {}  # to all rows, without corrections

    @property
    def best(self) -> Structure:
        """The best structure so far.

        Raises:
            ValueError: None was considered.
        """
        if not self._structures:
            raise ValueError("no structure was considered")
        return self._ranked(self._structures.values())[0]

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """All structures that were considered, in order; the best one is chosen."""
        best = self.best
        return tuple(
            Candidate(structure.name, self._errors[key], structure is best)
            for key, structure in self._structures.items()
        )

    def run(self) -> None:
        """Considers all structures."""
        self._search_nominals()
        self._search_combinations()
        for start in self._starts_of_gps():
            self._search_gps(start)
        for start in self._starts_of_gps_of_past():
            self._search_gps_of_past(start)
        if self._for_control:
            return
        self._consider_correction(self.best)
        # What is stable by half of the rows need not be so by all.
        while self._marks_as_unstable(self.best, [self._fit_of_all(self.best).model]):
            self._consider_correction(self.best)

    def score(self, structure: Structure) -> float:
        """Returns the score of a structure that was considered; smaller is better."""
        errors = np.maximum(self._errors[structure.key], self._exact)
        logarithms = np.log(errors / self._scale)
        simulated = self._simulated[structure.uncorrected.key]
        if len(simulated):
            logarithms = np.vstack([logarithms, simulated])
        behind = np.maximum(logarithms, 0.0)
        total = logarithms.mean() + (_LOSS - 1) * behind.mean()
        if structure.nominal.key in self._unstable:
            total += _UNSTABLE
        return float(total) + _PIECE * structure.size

    def _ranked(self, structures: Iterable[Structure]) -> list[Structure]:
        """Returns structures that were considered, the best one first."""
        return sorted(structures, key=self.score)

    def _training_data(self, log: Log) -> "_TrainingData":
        """Smooths a log, and fits the filter of starts, where its rows are noisy."""
        kinematics = self._bases[0].model.kinematics
        smoothed = smooth(log, kinematics, self._seed)
        if smoothed is None:
            return _TrainingData(log, None)
        windows = log.windows(0, past=PAST_ROWS, most=_FILTERED_WINDOWS)
        states = smoothed.windows(0, past=PAST_ROWS, most=_FILTERED_WINDOWS).states
        start_filter = StartFilter.fit(
            kinematics, windows, states[:, PAST_ROWS], _FILTER_PENALTY
        )
        return _TrainingData(smoothed, start_filter)

    def _training_of(self, structure: Structure) -> list["_TrainingData"]:
        """Returns what a structure is fitted to, by fold.

        A memory filters the noise of the rows by itself: it is fitted to them as they
        are.
        """
        if structure.model.memory.empty:
            return self._training
        return [_TrainingData(fold.train, None) for fold in self._folds]

    # 1. nominal structures

    def _search_nominals(self) -> None:
        """Lets nominal structures grow and shrink by one term at a time."""
        for base in self._bases:
            self._consider_nominal(base, parent=None)
        grown = list(self._bases)
        previous_best = None
        while self.best is not previous_best:
            previous_best = self.best
            for structure in grown:
                for neighbour in self._neighbours(structure):
                    if neighbour.key not in self._structures:
                        self._consider_nominal(neighbour, parent=structure)
            most = self.score(self.best) + _CLOSE
            ranked = self._ranked(self._structures.values())[:_BEAM]
            grown = [one for one in ranked if self.score(one) <= most]

    def _neighbours(self, structure: Structure) -> list[Structure]:
        """Returns a nominal structure with one addition more, or one less."""
        neighbours = [
            structure.extended(addition)
            for addition in additions(structure)
            if addition.for_control or not self._for_control
        ]
        for removed in structure.additions:
            smaller: Structure | None = self._base_of(structure)
            for addition in structure.additions:
                if addition is not removed and smaller is not None:
                    smaller = smaller.extended(addition)
            neighbours.append(smaller)
        return [one for one in neighbours if one is not None and self._has_rows(one)]

    def _has_rows(self, structure: Structure) -> bool:
        """Returns whether lags can be fitted, and judged on rows that were held out.

        Every fold needs a piece as long as a window, and the log several of them: a
        fifth of it may be all that it is judged on.
        """
        model = structure.model
        if not len(model.time_constants):
            return True
        needed = model.past + self._steps + 1
        if len(self._log) < _WINDOWS_OF_LAGS * needed:
            return False
        return all(
            max(end - begin for run in fold.train for begin, end in run.pieces)
            >= needed
            for fold in self._folds
        )

    def _base_of(self, structure: Structure) -> Structure:
        """Returns the base that a structure grew from."""
        return next(base for base in self._bases if base.base == structure.base)

    def _consider_nominal(self, structure: Structure, parent: Structure | None) -> None:
        """Considers a nominal structure, fitted from the parameters of another."""
        rows = self._training_of(structure)
        if structure.key not in self._memory:
            starts = [structure.model] * len(self._folds)
            if parent is not None:
                starts = self._nominal_models[parent.key]
            fits = [
                fit_from(
                    start_from=start,
                    model=structure.model,
                    log=training.log,
                    steps=self._steps,
                    same_log=parent is not None,
                ).model
                for start, training in zip(starts, rows, strict=True)
            ]
            self._memory[structure.key] = [model.parameters for model in fits]
        models = [
            replace(
                structure.model.with_parameters(parameters),
                start_filter=training.start_filter,
            )
            for parameters, training in zip(
                self._memory[structure.key], rows, strict=True
            )
        ]
        self._nominal_models[structure.key] = models
        self._marks_as_unstable(structure, models)
        self._measure(structure, models)

    # 2. combinations of groups of outputs

    def _search_combinations(self) -> None:
        """Combines the best structure with the best of every other base, by group."""
        ranked = self._ranked(self._structures.values())
        first = ranked[0]
        others: dict[str, Structure] = {}
        for structure in ranked:
            if structure.base != first.base:
                others.setdefault(structure.base, structure)
        for other in others.values():
            self._exchange_groups(first, other)

    def _exchange_groups(self, first: Structure, other: Structure) -> None:
        """Takes groups of outputs from another structure while that helps."""
        groups = tuple(first.model.kinematics.output_groups)
        theirs: tuple[str, ...] = ()
        best = first
        while len(theirs) < len(groups) - 1:
            tried = []
            for group in groups:
                if group in theirs:
                    continue
                taken = tuple(g for g in groups if g == group or g in theirs)
                own = tuple(g for g in groups if g not in taken)
                combined = self._consider_combination(((first, own), (other, taken)))
                if combined is not None:
                    tried.append((combined, taken))
            if not tried:
                return
            combined, taken = min(tried, key=lambda pair: self.score(pair[0]))
            if self.score(combined) >= self.score(best):
                return
            best = combined
            theirs = taken

    def _consider_combination(
        self, parts: tuple[tuple[Structure, tuple[str, ...]], ...]
    ) -> Structure | None:
        """Considers outputs of which some are of one structure, some of another.

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
        structure = Structure("", models[0], parts[0][0].inputs, parts=parts)
        self._nominal_models[structure.key] = models
        self._measure(structure, models)
        return structure

    # 3. GPs

    def _starts_of_gps(self) -> list[Structure]:
        """Returns the nominal structures that GPs are tried on.

        Upon a state that stays a GP is what ``gpmpc.gp.train`` makes of the rows.
        """
        ranked = self._ranked(self._structures.values())
        # Of those without a memory, GPs see rows without noise.
        plain = [one for one in ranked if one.model.memory.empty]
        starts = [one for one in ranked[:1] if one.model.memory.products is None]
        starts += [one for one in plain[:1] if one is not ranked[0]]
        keys = [start.key for start in starts]
        for base in self._bases:
            nominal = base.model.nominal
            is_still = isinstance(nominal, AffineNominal) and not nominal.fitted
            if is_still and base.base == CONSTANT_STATE and base.key not in keys:
                starts.append(base)
        return starts

    def _search_gps(self, start: Structure) -> None:
        """Changes the GPs of a nominal structure by one group at a time."""
        groups = self._groups_with_residual(start)
        if not groups:
            return
        all_groups = self._averaged_least(start, groups)
        rows = all_groups.gps[0].rows
        for current in (start, all_groups):
            for _ in range(_ROUNDS):
                changed = self._changed_gps(current, groups, rows)
                for structure in changed:
                    self._consider_gps(structure)
                best = self._ranked([current, *changed])[0]
                if best is current:
                    break
                current = best

    def _starts_of_gps_of_past(self) -> list[Structure]:
        """Returns the nominal structures on which GPs of past rows are tried.

        They remember few numbers: a GP is a poor function of many.
        """
        if isinstance(self._bases[0].model.kinematics, RigidBodyKinematics):
            return []
        starts = []
        for structure in self._ranked(self._structures.values()):
            model = structure.model
            seen = model.memory.copies
            is_plain = not (structure.gps or structure.parts or model.memory.products)
            if 0 < seen <= _ROWS_SEEN and is_plain:
                starts.append(structure)
        return starts[:_BEAM]

    def _search_gps_of_past(self, start: Structure) -> None:
        """Adds GPs of past rows to one group of outputs after the other."""
        groups = self._groups_with_residual(start)
        current = start
        for _ in range(_ROUNDS):
            with_gp = {gp.group for gp in current.gps}
            changed = [
                current.with_gps([*current.gps, GroupGP(group, 1, sees_past=True)])
                for group in groups
                if group not in with_gp
            ]
            if not changed:
                return
            for structure in changed:
                self._consider_gps(structure)
            best = self._ranked(changed)[0]
            if self.score(best) > self.score(current):
                return
            current = best

    def _averaged_least(self, start: Structure, groups: Sequence[str]) -> Structure:
        """Returns the structure with GPs on all groups, averaged over the best rows.

        Targets are averaged over fewer rows while that helps.
        """
        best: Structure | None = None
        for rows in sorted(_AVERAGES, reverse=True):
            structure = start.with_gps(GroupGP(group, rows) for group in groups)
            self._consider_gps(structure)
            if best is not None and self.score(structure) >= self.score(best):
                break
            best = structure
        assert best is not None
        return best

    def _groups_with_residual(self, structure: Structure) -> tuple[str, ...]:
        """Returns the groups of outputs that a nominal structure leaves a residual of.

        Of the others, such as an angle whose rate is measured, nothing can be learned.
        """
        windows = self._windows[0]
        model = self._nominal_models[structure.key][0]
        measured, modelled = model.first_outputs(windows)
        residual = np.abs(measured - modelled).max(axis=0)
        is_left = residual > _NOTHING * np.abs(measured).max(axis=0)
        groups = model.kinematics.output_groups
        return tuple(name for name, own in groups.items() if is_left[list(own)].any())

    def _changed_gps(
        self, structure: Structure, groups: Sequence[str], rows: int
    ) -> list[Structure]:
        """Returns a structure with a GP more or less, or averaged over other rows."""
        with_gp = {gp.group for gp in structure.gps}
        changed = []
        for group in groups:
            others = [gp for gp in structure.gps if gp.group != group]
            if group not in with_gp:
                others.append(GroupGP(group, rows))
            changed.append(structure.with_gps(others))
        if len(with_gp) == 1:
            (group,) = with_gp
            changed += [structure.with_gps([GroupGP(group, n)]) for n in _AVERAGES]
        return [one for one in changed if one.key != structure.key]

    def _consider_gps(self, structure: Structure) -> None:
        """Considers a structure with GPs."""
        if structure.key in self._structures:
            return
        key = f"simulation of {structure.key}"
        if key not in self._memory:
            models = self._models(structure)
            self._memory[structure.key] = self._mean_errors(models).tolist()
            errors = np.array(self._memory[structure.key])
            self._memory[key] = self._simulate(models, errors).tolist()
        self._simulated[structure.key] = np.array(self._memory[key])
        self._enter(structure, np.array(self._memory[structure.key]))

    # 4. corrections by the past

    def _consider_correction(self, structure: Structure) -> None:
        """Considers the best average of corrections.

        A structure has none whose rollouts diverge on all that a model was not fitted
        to.
        """
        if structure.shares:
            return
        key = f"averages of {structure.key}"
        if key not in self._memory:
            parts = [one.rollouts for one in self._validate(structure)]
            if not all(len(rollouts.windows) for rollouts in parts):
                return
            averages = choose_averages(
                kinematics=structure.model.kinematics,
                rollouts=Rollouts.concatenate(parts),
                judged_steps=self.judged_steps,
            )
            errors = self._errors[structure.key] * averages.ratios
            self._memory[key] = {
                "shares": averages.shares.tolist(),
                "errors": errors.tolist(),
            }
        shares = tuple(
            tuple(tuple(map(float, groups)) for groups in steps)
            for steps in self._memory[key]["shares"]
        )
        errors = np.array(self._memory[key]["errors"])
        self._enter(replace(structure, shares=shares), errors)

    def _validate(self, structure: Structure) -> list[_Validation]:
        """Fits a structure to parts of the rows, and rolls it out on the others.

        Models of half the rows err more than the one of all. Here three quarters are
        fitted to, where there are rows enough for windows.
        """
        structure = replace(structure, shares=())
        if structure.key not in self._validations:
            folds, models = self._validation_models(structure)
            self._validations[structure.key] = [
                _Validation(fold.held_out, model, self._rollouts(model, fold.held_out))
                for fold, model in zip(folds, models, strict=True)
            ]
        return self._validations[structure.key]

    def _validation_models(
        self, structure: Structure
    ) -> tuple[Sequence[Fold], list[LogModel]]:
        """Returns folds with three quarters to fit to, if there are rows enough."""
        if len(self._folds) == 2:
            try:
                folds = self._quarters()
                return folds, [
                    self._fit_to(fold.train, structure).model for fold in folds
                ]
            except DataError:
                pass
        return self._folds, self._models(structure)

    def _quarters(self) -> list[Fold]:
        """Halves what each fold holds out, every other run or block of it.

        Raises:
            DataError: One would be without windows.
        """
        quarters = []
        for fold in self._folds:
            runs = fold.held_out.runs
            for first in range(2):
                others = (*fold.train.runs, *runs[1 - first :: 2])
                quarter = Fold(
                    train=replace(fold.train, runs=others),
                    held_out=replace(fold.held_out, runs=runs[first::2]),
                )
                quarter.held_out.windows(self._steps, past=PAST_ROWS, most=1)
                quarters.append(quarter)
        return quarters

    def _rollouts(self, model: LogModel, held_out: Log) -> Rollouts:
        """Rolls a model out on held-out rows, and leaves out what diverges."""
        share = len(held_out) / len(self._log)
        windows = held_out.windows(
            ahead=self._steps,
            past=PAST_ROWS,
            most=max(round(share * _CORRECTED_WINDOWS), 1),
        )
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = model.rollout(windows)
        is_finite = np.abs(predicted).max(axis=(1, 2)) < _LARGEST
        return Rollouts(windows, predicted)[is_finite]

    def _correct(
        self, model: LogModel, structure: Structure, rollouts: Sequence[Rollouts]
    ) -> LogModel:
        """Adds the correction of a structure, fitted to rollouts, if it has one."""
        if not structure.shares:
            return model
        correction = fit_correction(
            kinematics=model.kinematics,
            rollouts=Rollouts.concatenate(rollouts),
            judged_steps=self.judged_steps,
            shares=np.array(structure.shares),
        )
        return replace(model, correction=correction)

    # what all of them need

    def _marks_as_unstable(
        self, structure: Structure, models: Sequence[LogModel]
    ) -> bool:
        """Marks a structure one of whose models grows outside of its data; says so."""
        inputs = len(self._log.input_names)
        time_step = self._log.time_step
        is_unstable = any(grows_outside(model, inputs, time_step) for model in models)
        if is_unstable:
            self._unstable.add(structure.nominal.key)
        return is_unstable

    def _measure(self, structure: Structure, models: Sequence[LogModel]) -> None:
        """Enters a nominal structure with the errors of its models."""
        errors = self._mean_errors(models)
        key = f"simulation of {structure.key}"
        if key not in self._memory:
            self._memory[key] = self._simulate(models, errors).tolist()
        self._simulated[structure.key] = np.array(self._memory[key])
        self._enter(structure, errors)

    def _simulate(self, models: Sequence[LogModel], errors: Array) -> Array:
        """Simulates long held-out rows; returns the logarithms of errors (g,), or none.

        Of models whose rollouts are far from the best ones the worst is taken.
        """
        if self._simulation is None:
            return np.empty(0)
        logarithm = np.log(np.maximum(errors, self._exact) / self._scale).mean()
        self._best_logarithm = min(self._best_logarithm, logarithm)
        if logarithm > self._best_logarithm + _OUT_OF_REACH:
            return self._simulation.worst_logarithms
        return self._simulation.logarithms(models)

    def _enter(self, structure: Structure, errors: Array) -> None:
        """Enters a candidate with its errors."""
        self._structures[structure.key] = structure
        self._errors[structure.key] = errors
        relative = np.exp(self.score(structure) - _PIECE * structure.size)
        best = " (best so far)" if self.best is structure else ""
        self._progress(
            f"{structure.name}: {relative:.3f} of the best baselines' errors{best}"
        )

    def _models(self, structure: Structure) -> list[LogModel]:
        """Returns the models of a structure, one for each fold."""
        nominals = self._nominal_models[structure.nominal.key]
        gps = [self._trained(structure, gp) for gp in structure.gps]
        models = [
            replace(nominal, gps=tuple(trained[i] for trained in gps))
            for i, nominal in enumerate(nominals)
        ]
        if not structure.shares:
            return models
        rollouts = [
            self._rollouts(model, fold.held_out)
            for model, fold in zip(models, self._folds, strict=True)
        ]
        # What one fold holds out, the models of the others were fitted to.
        return [
            self._correct(model, structure, rollouts[:i] + rollouts[i + 1 :])
            for i, model in enumerate(models)
        ]

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

    def _distances(self, models: Sequence[LogModel]) -> Array:
        """Computes the errors (W, judged steps, groups) of held-out rollouts."""
        errors = [
            model.rollout_errors(windows, self.judged_steps)
            for windows, model in zip(self._windows, models, strict=True)
        ]
        return self._log.space.distances(np.concatenate(errors))

    def _mean_errors(self, models: Sequence[LogModel]) -> Array:
        """Computes the mean errors (judged steps, groups) of held-out rollouts."""
        return self._distances(models).mean(axis=0)

    def _baseline_distances(self) -> dict[str, Array]:
        """Computes the errors (W, judged steps, groups) of the baselines."""
        kinematics = self._bases[0].model.kinematics
        by_fold: list[Mapping[str, Array]] = [
            baseline_errors(kinematics, fold.train, windows, self.judged_steps)
            for fold, windows in zip(self._folds, self._windows, strict=True)
        ]
        return {
            name: self._log.space.distances(
                np.concatenate([errors[name] for errors in by_fold])
            )
            for name in by_fold[0]
        }

    def _best_baseline_errors(self) -> Array:
        """Computes the errors (judged steps, groups) of the best baselines."""
        means = [distances.mean(axis=0) for distances in self._baselines.values()]
        return np.maximum(np.min(means, axis=0), self._exact)

    # the best structure

    def comparisons(self) -> tuple[Comparison, ...]:
        """Compares the best structure with the baselines, and with the second best."""
        best = self.best
        distances = self._distances(self._models(best))
        others = dict(self._baselines)
        ranked = self._ranked(self._structures.values())
        if len(ranked) > 1:
            name = ranked[1].name
            if name in others:  # a baseline, which is fitted otherwise
                name = f"{name}, fitted on rollouts"
            others[name] = self._distances(self._models(ranked[1]))
        block = 2 * -(-self._steps // min(w.stride for w in self._windows))
        return tuple(
            compare(name, distances, other, block=block, seed=self._seed)
            for name, other in others.items()
        )

    def rivals(self) -> dict[str, LogModel]:
        """Returns a model of the best structure of every other base, by its name.

        Those whose outputs are the same whatever the inputs are left out.
        """
        best = self.best
        rivals: dict[str, Structure] = {}
        for structure in self._ranked(self._structures.values()):
            nominal = structure.model.nominal
            is_still = isinstance(nominal, AffineNominal) and not nominal.fitted
            if structure.base != best.base and not (is_still or structure.shares):
                rivals.setdefault(structure.base, structure)
        return {one.name: self._models(one)[0] for one in rivals.values()}

    def fit_noise(self) -> OutputNoise:
        """Fits the noise of the best structure to held-out runs."""
        validations = self._validate(self.best)
        models = []
        for validation in validations:
            others = [one.rollouts for one in validations if one is not validation]
            models.append(self._correct(validation.model, self.best, others))
        held_out = [validation.held_out for validation in validations]
        return fit_noise(models, held_out, self._steps)

    def fit_to_all_runs(self) -> NominalFit:
        """Fits the best structure to all runs, its GPs and its correction as well."""
        fit = self._fit_of_all(self.best)
        rollouts = [validation.rollouts for validation in self._validate(self.best)]
        return replace(fit, model=self._correct(fit.model, self.best, rollouts))

    def _fit_of_all(self, structure: Structure) -> NominalFit:
        """Fits a structure to all runs, without its correction, once."""
        key = structure.uncorrected.key
        if key not in self._fits:
            self._fits[key] = self._fit_to(self._log, structure)
        return self._fits[key]

    def _fit_to(self, log: Log, structure: Structure) -> NominalFit:
        """Fits a structure to a log, without its correction."""
        training = _TrainingData(log, None)
        if structure.model.memory.empty:
            training = self._training_data(log)
        fit = self._fit_nominal_to(training.log, structure.nominal)
        gps = tuple(self._train(gp, fit.model, training.log) for gp in structure.gps)
        model = replace(fit.model, gps=gps, start_filter=training.start_filter)
        return replace(fit, model=model)

    def _fit_nominal_to(self, log: Log, structure: Structure) -> NominalFit:
        """Fits a nominal structure to a log."""
        if not structure.parts:
            start = self._nominal_models[structure.key][0]
            return fit_from(start, structure.model, log, self._steps)
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
