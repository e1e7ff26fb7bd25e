"""Judges models by simulations of held-out rows, hundreds of steps long.

Many a record of inputs and outputs is there to be simulated: only its inputs will be
known. A model that is good 50 steps ahead may drift or diverge after it. The error of a
simulation, over the spread of what is simulated, says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._folds import Fold
from gpmpc.logs._ranges import state_widths
from gpmpc.models._log_model import LogModel
from gpmpc.models._windows import Windows

_LONGEST = 300  # rows of a simulation
_LEAST = 1.3  # times as long as the rollouts that decide, or it says nothing new
_SIMULATIONS = 12  # of all folds, about
_LARGEST_ERROR = 2.0  # that counts, over the spread
_EXACT_SHARE = 1e-4  # of the spread: what is smaller counts as exact


@dataclass(frozen=True)
class FreeSimulation:
    """Long windows of what each fold holds out."""

    windows: tuple[Windows, ...]  # of each fold
    #: root mean square length of the deviations from the mean, by group (g,)
    spread: Array

    @classmethod
    def of(
        cls, folds: Sequence[Fold], past_rows: int, steps: int
    ) -> "FreeSimulation | None":
        """Cuts windows; returns None where pieces are short, or states have angles.

        Args:
            folds: Of the log.
            past_rows: Before each start.
            steps: Of the rollouts that decide.
        """
        lengths = [
            max(end - begin for run in fold.held_out for begin, end in run.pieces)
            for fold in folds
        ]
        ahead = min(min(lengths) - past_rows - 2, _LONGEST)
        space = folds[0].held_out.space
        are_vectors = all(group.kind == "vector" for group in space.groups)
        if ahead < _LEAST * steps or not are_vectors:
            return None
        most = max(_SIMULATIONS // len(folds), 1)
        windows = tuple(
            fold.held_out.windows(ahead, past=past_rows, most=most) for fold in folds
        )
        rows = np.concatenate([run.states for fold in folds for run in fold.held_out])
        deviations = space.distances((rows - rows.mean(axis=0))[:, None])[:, 0]
        spread = np.sqrt(np.square(deviations).mean(axis=0))
        # Of a state that never moves, its size.
        sizes = space.distances(state_widths(space, rows))
        return cls(windows, np.where(spread > 0, spread, sizes))

    @property
    def worst_logarithms(self) -> Array:
        """Those (g,) of the worst models."""
        return np.full(len(self.spread), np.log(_LARGEST_ERROR))

    def logarithms(self, models: Sequence[LogModel]) -> Array:
        """Computes the logarithms (g,) of root mean squared errors over the spread.

        Args:
            models: One for each fold.
        """
        squares = []
        for model, windows in zip(models, self.windows, strict=True):
            distances = windows.space.distances(model.rollout_errors(windows))
            # One that diverges is no worse than bad.
            worst = _LARGEST_ERROR * self.spread
            squares.append(np.square(np.minimum(distances, worst)).mean(axis=(0, 1)))
        error = np.sqrt(np.mean(squares, axis=0))
        return np.log(np.maximum(error / self.spread, _EXACT_SHARE))
