"""Searches for the structure whose rollouts of held-out rows are best.

1. Nominal structures: every base, with one term more or less at a time; the best one
   of each round goes on, and the second one if it is close.
2. Groups of outputs: those of one nominal structure, the others of another.
3. GPs on the groups of outputs, from none and from all at once, by the change of one
   group at a time that helps most.
4. GPs of past rows, on one group after the other.
5. A correction by the past upon the best structure, unless it costs more than little:
   it hedges against runs that are unlike those of the log.

Models for a controller end with the fourth.

A structure's score is the mean, over groups and steps, of the logarithm of its error
over that of the best baseline; where it is behind, that counts twice. A simulation of
hundreds of steps, over the spread of what is simulated, counts as one step more.
"""

from collections.abc import Iterable, MutableMapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._baselines import CONSTANT_STATE
from gpmpc.logs._comparison import Comparison
from gpmpc.logs._fitting import NominalFit
from gpmpc.logs._folds import Fold
from gpmpc.logs._free_simulation import FreeSimulation
from gpmpc.logs._held_out_errors import HeldOutErrors
from gpmpc.logs._log import Log
from gpmpc.logs._stability import grows_outside
from gpmpc.logs._structure_fits import StructureFits
from gpmpc.logs._structures import (
    Addition,
    Candidate,
    GroupGP,
    Structure,
    additions,
    bases,
    past_rows_needed,
)
from gpmpc.logs._validation import Validations
from gpmpc.models._kinematics import RigidBodyKinematics
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._log_model import LogModel
from gpmpc.models._parametric import is_still

_WINDOWS_OF_LAGS = 4  # that a log is to hold where inputs act through lags
_AVERAGES = (1, 5, 10)  # rows over which the targets of a GP are averaged
_PIECE = 0.02  # of the score that every piece of a structure has to earn
_BEAM = 2  # structures that go on, of a round
_CLOSE = 0.02  # of the best score: where the second one goes on as well
_MOST_ROWS_OF_GP = 8  # past rows that a GP sees
_NO_RESIDUAL = 1e-9  # of the outputs: a residual up to this is round-off
_OUT_OF_REACH = 0.5  # mean logarithm by which rollouts are too bad to be simulated
_UNSTABLE = 10.0  # of the score of what grows without bounds outside of its data
_CORRECTION_BONUS = 0.03  # of the score, that a correction may cost
_LOSS = 2.0  # weight of being behind a baseline
_ROUNDS = 8  # of changes of the GPs of one nominal structure, at most


class Search:
    """A search for the structure whose rollouts of held-out rows are best.

    Args:
        log: All runs.
        folds: Of the log.
        most_rows_back: That a structure may look back on.
        points: Rows that a GP is trained on.
        steps: Of the rollouts.
        seed: Of every random number.
        progress: Called with a line for each structure.
        results: By the key of a structure without GPs, the parameters of its nominal
            model by fold (lists of numbers), and by "penalties of" it those of its
            outputs; of any other, its errors. By "simulation of" a key, the logarithms
            of the errors of its simulations; by "averages of" one, the shares and
            errors of its corrections.
        for_control: Leaves out what no controller can plan with.
        delay_rows: By which inputs are likely to act late.
    """

    def __init__(
        self,
        log: Log,
        folds: Sequence[Fold],
        most_rows_back: int,
        points: int,
        steps: int,
        seed: int,
        progress: Any,
        results: MutableMapping[str, Any],
        for_control: bool,
        delay_rows: int = 0,
    ):
        self._log = log
        self._folds = folds
        self._steps = steps
        self._seed = seed
        self._progress = progress
        self._results = results
        self._for_control = for_control
        self._bases = bases(log, most_rows_back, delay_rows)
        kinematics = self._bases[0].model.kinematics
        past_rows = past_rows_needed(most_rows_back, delay_rows)
        self._held_out = HeldOutErrors(log, folds, kinematics, past_rows, steps)
        self.judged_steps = self._held_out.judged_steps
        progress(f"smoothing the rows of {len(folds)} folds")
        self._fits = StructureFits(
            log=log,
            folds=folds,
            kinematics=kinematics,
            points=points,
            steps=steps,
            seed=seed,
            results=results,
        )
        self._validations = Validations(
            log, folds, self._fits, past_rows, steps, self.judged_steps
        )
        self._structures: dict[str, Structure] = {}
        # Means by the structure's key; of those with a correction, estimates.
        self._errors: dict[str, Array] = {}
        self._simulation: FreeSimulation | None = None
        if not for_control:
            self._simulation = FreeSimulation.of(folds, past_rows, steps)
        self._simulated: dict[str, Array] = {}
        # Least mean logarithm of a structure's rollouts over those of baselines.
        self._best_logarithm = np.inf
        self._unstable: set[str] = set()  # keys of nominal structures

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
        """All structures that were considered, in order; the best one is chosen.

        Those with a correction were ranked by an estimate. Here their errors are
        measured, on the rows of all others.
        """
        best = self.best
        candidates = []
        for key, structure in self._structures.items():
            errors = self._errors[key]
            if structure.correction_shares:
                models = self._validations.corrected_models(structure)
                errors = self._held_out.mean(models)
            candidates.append(Candidate(structure.name, errors, structure is best))
        return tuple(candidates)

    def run(self) -> None:
        """Considers all structures."""
        self._search_nominals()
        self._search_combinations()
        for start in self._starts_of_gps():
            self._search_gps(start)
        for start in self._starts_of_gps_of_past():
            self._search_gps_of_past(start)
        if self._for_control:  # no correction, and no products that may be unstable
            return
        self._consider_correction(self.best)
        # What is stable by half of the rows need not be so by all.
        while self._is_found_unstable_by_all_rows(self.best):
            self._unstable.add(self.best.nominal.key)
            self._consider_correction(self.best)

    def score(self, structure: Structure) -> float:
        """Returns the score of a structure that was considered; smaller is better."""
        bonus = _CORRECTION_BONUS if structure.correction_shares else 0.0
        return self._score_without_pieces(structure) + _PIECE * structure.size - bonus

    def _score_without_pieces(self, structure: Structure) -> float:
        """Computes the score without what pieces cost; what is unstable is behind."""
        logarithms = self._held_out.logarithms(self._errors[structure.key])
        simulated = self._simulated[structure.uncorrected.key]
        if len(simulated):
            logarithms = np.vstack([logarithms, simulated])
        behind = np.maximum(logarithms, 0.0)
        total = logarithms.mean() + (_LOSS - 1) * behind.mean()
        if structure.nominal.key in self._unstable:
            total += _UNSTABLE
        return float(total)

    def _ranked(self, structures: Iterable[Structure]) -> list[Structure]:
        """Returns structures that were considered, the best one first."""
        return sorted(structures, key=self.score)

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
            neighbours.append(self._without(structure, removed))
        return [one for one in neighbours if one is not None and self._has_rows(one)]

    def _without(self, structure: Structure, removed: Addition) -> Structure | None:
        """Builds a structure anew without an addition.

        Returns None where another addition needs the one that is removed.
        """
        smaller: Structure | None = self._base_of(structure)
        for addition in structure.additions:
            if addition is not removed and smaller is not None:
                smaller = smaller.extended(addition)
        return smaller

    def _has_rows(self, structure: Structure) -> bool:
        """Returns whether lags can be fitted, and judged on rows that were held out.

        Every fold needs a piece as long as a window, and the log several of them:
        ``gpmpc learn`` may judge the model on a quarter as many rows as these.
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
        models = self._fits.fit_nominal(structure, parent)
        if self._is_unstable(models):
            self._unstable.add(structure.nominal.key)
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
        groups_of_other: tuple[str, ...] = ()
        best = first
        while len(groups_of_other) < len(groups) - 1:
            combinations = []
            for group in groups:
                if group in groups_of_other:
                    continue
                one_more = {*groups_of_other, group}
                exchanged = tuple(name for name in groups if name in one_more)
                own = tuple(name for name in groups if name not in one_more)
                combined = self._consider_combination(
                    ((first, own), (other, exchanged))
                )
                if combined is not None:
                    combinations.append((combined, exchanged))
            if not combinations:
                return
            combined, exchanged = min(
                combinations, key=lambda combination: self.score(combination[0])
            )
            if self.score(combined) >= self.score(best):
                return
            best = combined
            groups_of_other = exchanged

    def _consider_combination(
        self, parts: tuple[tuple[Structure, tuple[str, ...]], ...]
    ) -> Structure | None:
        """Considers outputs of which some are of one structure, some of another.

        Returns None where they do not fit.
        """
        structure = self._fits.combine(parts)
        if structure is not None:
            self._measure(structure, self._fits.models(structure))
        return structure

    # 3. GPs

    def _starts_of_gps(self) -> list[Structure]:
        """Returns the nominal structures that GPs are tried on.

        Upon a state that stays a GP is what ``gpmpc.gp.train`` makes of the rows.
        """
        ranked = self._ranked(self._structures.values())
        best = ranked[0]
        # Products of past rows and GPs would explain the same.
        starts = [best] if best.model.memory.products is None else []
        # Those without a memory are fitted to smoothed rows, so their GPs are as well.
        without_memory = [one for one in ranked if one.model.memory.empty]
        starts += [one for one in without_memory[:1] if one is not best]
        keys = [start.key for start in starts]
        for base in self._bases:
            is_constant_state = base.base == CONSTANT_STATE
            if is_constant_state and base.key not in keys:
                starts.append(base)
        return starts

    def _search_gps(self, start: Structure) -> None:
        """Changes the GPs of a nominal structure by one group at a time."""
        groups = self._groups_with_residual(start)
        if not groups:
            return
        averages = self._averages(start)
        if not averages:
            return
        all_groups = self._averaged_least(start, groups, averages)
        rows = all_groups.gps[0].rows
        for current in (start, all_groups):
            for _ in range(_ROUNDS):
                changed = self._changed_gps(current, groups, rows, averages)
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
            rows = model.memory.copies
            is_plain = not (structure.gps or structure.parts or model.memory.products)
            if 0 < rows <= _MOST_ROWS_OF_GP and is_plain:
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

    def _averages(self, start: Structure) -> tuple[int, ...]:
        """Returns the rows that targets may be averaged over.

        Every fold needs a piece of so many upon those that the structure looks back on.
        """
        longest = min(fold.train.longest_piece for fold in self._folds)
        most = longest - start.model.past - 1
        return tuple(rows for rows in _AVERAGES if rows <= most)

    def _averaged_least(
        self, start: Structure, groups: Sequence[str], averages: Sequence[int]
    ) -> Structure:
        """Returns the structure with GPs on all groups, averaged over the best rows.

        Targets are averaged over fewer rows while that helps.
        """
        best: Structure | None = None
        for rows in sorted(averages, reverse=True):
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
        windows = self._held_out.windows[0]
        model = self._fits.models(structure.nominal)[0]
        measured, modelled = model.first_outputs(windows)
        residual = np.abs(measured - modelled).max(axis=0)
        is_left = residual > _NO_RESIDUAL * np.abs(measured).max(axis=0)
        groups = model.kinematics.output_groups
        return tuple(name for name, own in groups.items() if is_left[list(own)].any())

    def _changed_gps(
        self,
        structure: Structure,
        groups: Sequence[str],
        rows: int,
        averages: Sequence[int],
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
            changed += [structure.with_gps([GroupGP(group, n)]) for n in averages]
        return [one for one in changed if one.key != structure.key]

    def _consider_gps(self, structure: Structure) -> None:
        """Considers a structure with GPs."""
        if structure.key in self._structures:
            return
        key = f"simulation of {structure.key}"
        if key not in self._results:
            models = self._fits.models(structure)
            self._results[structure.key] = self._held_out.mean(models).tolist()
            errors = np.array(self._results[structure.key])
            self._results[key] = self._simulate(models, errors).tolist()
        errors = np.array(self._results[structure.key])
        self._enter_simulated(structure, errors, np.array(self._results[key]))

    # 4. corrections by the past

    def _consider_correction(self, structure: Structure) -> None:
        """Considers the best average of corrections.

        A structure has none whose rollouts diverge on all that a model was not fitted
        to.
        """
        if structure.correction_shares:
            return
        key = f"averages of {structure.key}"
        if key not in self._results:
            averages = self._validations.choose_averages(structure)
            if averages is None:
                return
            errors = self._errors[structure.key] * averages.ratios_to_rollout
            self._results[key] = {
                "shares": averages.shares.tolist(),
                "errors": errors.tolist(),
            }
        shares = tuple(
            tuple(tuple(map(float, groups)) for groups in steps)
            for steps in self._results[key]["shares"]
        )
        errors = np.array(self._results[key]["errors"])
        self._enter(replace(structure, correction_shares=shares), errors)

    # what all of them need

    def _is_unstable(self, models: Sequence[LogModel]) -> bool:
        """Returns whether one of some models grows outside of its data."""
        inputs = len(self._log.input_names)
        time_step = self._log.time_step
        return any(grows_outside(model, inputs, time_step) for model in models)

    def _is_found_unstable_by_all_rows(self, structure: Structure) -> bool:
        """Returns whether the model of all rows grows outside of its data.

        Not of a structure of which that was known: one that is best nevertheless stays.
        """
        if structure.nominal.key in self._unstable:
            return False
        fit = self._fits.fit_to_all_runs(structure)
        return self._is_unstable([fit.model])

    def _measure(self, structure: Structure, models: Sequence[LogModel]) -> None:
        """Enters a nominal structure with the errors of its models."""
        errors = self._held_out.mean(models)
        key = f"simulation of {structure.key}"
        if key not in self._results:
            self._results[key] = self._simulate(models, errors).tolist()
        self._enter_simulated(structure, errors, np.array(self._results[key]))

    def _enter_simulated(
        self, structure: Structure, errors: Array, simulated: Array
    ) -> None:
        """Enters a candidate with its errors and those of its simulations.

        They may be of an earlier call: what comes next is then reached as it was there.
        """
        self._best_logarithm = min(self._best_logarithm, self._mean_logarithm(errors))
        self._simulated[structure.key] = simulated
        self._enter(structure, errors)

    def _mean_logarithm(self, errors: Array) -> float:
        """Computes the mean logarithm of errors over those of the best baselines."""
        return float(self._held_out.logarithms(errors).mean())

    def _simulate(self, models: Sequence[LogModel], errors: Array) -> Array:
        """Simulates long held-out rows; returns the logarithms of errors (g,), or none.

        Models whose rollouts are far from the best ones are not simulated: they get the
        worst errors that count.
        """
        if self._simulation is None:
            return np.empty(0)
        if self._mean_logarithm(errors) > self._best_logarithm + _OUT_OF_REACH:
            return self._simulation.worst_logarithms
        return self._simulation.logarithms(models)

    def _enter(self, structure: Structure, errors: Array) -> None:
        """Enters a candidate with its errors."""
        self._structures[structure.key] = structure
        self._errors[structure.key] = errors
        relative = np.exp(self._score_without_pieces(structure))
        best = " (best so far)" if self.best is structure else ""
        self._progress(
            f"{structure.name}: {relative:.3f} of the best baselines' errors{best}"
        )

    # the best structure

    def comparisons(self) -> tuple[Comparison, ...]:
        """Compares the best structure with the baselines, and with the second best."""
        ranked = self._ranked(self._structures.values())
        second = {
            one.name: self._validations.corrected_models(one) for one in ranked[1:2]
        }
        models = self._validations.corrected_models(ranked[0])
        return self._held_out.compare(models, second, self._seed)

    def rivals(self) -> dict[str, LogModel]:
        """Returns a model of the best structure of every other base, by its name.

        Those whose outputs are the same whatever the inputs are left out.
        """
        best = self.best
        rivals: dict[str, Structure] = {}
        for structure in self._ranked(self._structures.values()):
            if structure.base == best.base or structure.correction_shares:
                continue
            if not is_still(structure.model.nominal):
                rivals.setdefault(structure.base, structure)
        return {one.name: self._fits.models(one)[0] for one in rivals.values()}

    def fit_noise(self) -> OutputNoise:
        """Fits the noise of the best structure to held-out runs."""
        return self._validations.fit_noise(self.best)

    def fit_to_all_runs(self) -> NominalFit:
        """Fits the best structure to all runs, its GPs and its correction as well."""
        return self._validations.fit_to_all_runs(self.best)
