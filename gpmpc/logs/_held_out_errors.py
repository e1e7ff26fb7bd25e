"""Errors of rollouts of held-out rows, beside those of the baselines."""

from collections.abc import Mapping, Sequence

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._baselines import CONSTANT_STATE, baseline_errors
from gpmpc.logs._comparison import (
    Comparison,
    compare,
    independent_predictions,
)
from gpmpc.logs._fitting import judged_steps
from gpmpc.logs._folds import Fold
from gpmpc.logs._log import Log
from gpmpc.logs._ranges import state_widths
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._log_model import LogModel

_WINDOWS = 400  # that structures are compared on
_EXACT_SHARE = 1e-4  # of a constant state's error: what is smaller counts as exact
_ROUNDING = 1e-12  # of a state's range: likewise, where a constant state is exact


class HeldOutErrors:
    """Errors of rollouts of what each fold holds out.

    Args:
        log: All runs.
        folds: Of the log.
        kinematics: Of all models.
        past_rows: Before the start of each.
        steps: Of the rollouts.
    """

    def __init__(
        self,
        log: Log,
        folds: Sequence[Fold],
        kinematics: Kinematics,
        past_rows: int,
        steps: int,
    ):
        self._space = log.space
        self._folds = folds
        self._steps = steps
        #: after the starts, whose errors count
        self.judged_steps = judged_steps(steps)
        #: of each fold
        self.windows = [
            fold.held_out.windows(steps, past=past_rows, most=_WINDOWS // len(folds))
            for fold in folds
        ]
        self._baselines = self._baseline_distances(kinematics)
        still = self._baselines[CONSTANT_STATE].mean(axis=0)
        states = np.concatenate([run.states for run in log])
        sizes = log.space.distances(state_widths(log.space, states))
        # Errors that are smaller count as these (judged steps, groups).
        self._exact_errors = _EXACT_SHARE * still + _ROUNDING * sizes
        self._scale = self._best_baseline_errors()

    def mean(self, models: Sequence[LogModel]) -> Array:
        """Computes the mean errors (judged steps, groups) of models.

        Args:
            models: One of each fold.
        """
        return self._distances(models).mean(axis=0)

    def logarithms(self, errors: Array) -> Array:
        """Computes the logarithms of mean errors over those of the best baselines.

        Args:
            errors: (judged steps, groups).
        """
        return np.log(np.maximum(errors, self._exact_errors) / self._scale)

    def compare(
        self,
        models: Sequence[LogModel],
        rivals: Mapping[str, Sequence[LogModel]],
        seed: int,
    ) -> tuple[Comparison, ...]:
        """Compares models with the baselines, and with other models.

        Args:
            models: One of each fold.
            rivals: Likewise, by their names.
            seed: Of the intervals.
        """
        distances = self._distances(models)
        others = dict(self._baselines)
        for name, rival in rivals.items():
            if name in others:  # a baseline, which is fitted otherwise
                name = f"{name}, fitted on rollouts"
            others[name] = self._distances(rival)
        block = 2 * -(-self._steps // min(w.stride for w in self.windows))
        independent = np.sum(
            [independent_predictions(w, self.judged_steps) for w in self.windows],
            axis=0,
        )
        return tuple(
            compare(
                name=name,
                distances=distances,
                others=other,
                block=block,
                independent=independent,
                seed=seed,
            )
            for name, other in others.items()
        )

    def _distances(self, models: Sequence[LogModel]) -> Array:
        """Computes the errors (W, judged steps, groups) of models, one of each fold."""
        errors = [
            model.rollout_errors(windows, self.judged_steps)
            for windows, model in zip(self.windows, models, strict=True)
        ]
        return self._space.distances(np.concatenate(errors))

    def _baseline_distances(self, kinematics: Kinematics) -> dict[str, Array]:
        """Computes the errors (W, judged steps, groups) of the baselines."""
        by_fold: list[Mapping[str, Array]] = [
            baseline_errors(kinematics, fold.train, windows, self.judged_steps)
            for fold, windows in zip(self._folds, self.windows, strict=True)
        ]
        return {
            name: self._space.distances(
                np.concatenate([errors[name] for errors in by_fold])
            )
            for name in by_fold[0]
        }

    def _best_baseline_errors(self) -> Array:
        """Computes the errors (judged steps, groups) of the best baselines."""
        means = [distances.mean(axis=0) for distances in self._baselines.values()]
        return np.maximum(np.min(means, axis=0), self._exact_errors)
