"""What data cannot teach: columns that never move, states that never follow, copies.

A training goes on all the same. What it could not learn it says in one line of the log,
with the rule and the way out.
"""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc.gp._prior_scales import PriorScales
from gpmpc.gp._transitions import Transitions

_log = logging.getLogger(__name__)

#: Part of its magnitude by which a column moves for round-off alone: twelve of the 52
#: bits of a number. A feature of spread 1 around 1e9, which is 2e-9, moves.
ROUND_OFF = 2**12 * np.finfo(np.float64).eps
#: What a column moves by at most, in its own unit, where it does not move: solvers and
#: simulators leave residues of as much.
RESOLUTION = 1e-9
_SHOWN = 6  # columns that a line names; of more it says how many


class Columns(NamedTuple):
    """What is known of the columns of features and targets beside their numbers."""

    features: Sequence[str]  #: names (d,)
    outputs: Sequence[str]  #: names (k,)
    #: of the numbers that the targets are differences of (k,), which round-off is
    #: relative to; None: of the targets themselves
    magnitudes: NDArray[np.float64] | None = None
    #: what ``prior_deviation`` counts in (k,), in the units of the targets; None: those
    deviations: NDArray[np.float64] | None = None

    @property
    def units(self) -> NDArray[np.float64]:
        """What ``prior_deviation`` counts in (k,)."""
        return (
            np.ones(len(self.outputs)) if self.deviations is None else self.deviations
        )

    @classmethod
    def of(cls, features: Tensor, targets: Tensor, input_dim: int, predicts: str):
        """Columns of states and inputs without names, which are counted from 1."""
        d = features.shape[1]
        k = targets.shape[1]
        states = [f"state {i + 1}" for i in range(d - input_dim)]
        inputs = [f"input {i + 1}" for i in range(input_dim)]
        outputs = states
        if predicts == "value":
            outputs = [f"output {a + 1}" for a in range(k)]
        magnitudes = None
        if predicts == "difference":
            magnitudes = features[:, :k].abs().amax(dim=0).numpy()
        return cls(features=states + inputs, outputs=outputs, magnitudes=magnitudes)


class Constants(NamedTuple):
    """Which columns of a training's data never move."""

    features: NDArray[np.bool_]  #: (d,)
    outputs: NDArray[np.bool_]  #: (k,)

    @classmethod
    def of(cls, features: Tensor, targets: Tensor, columns: Columns, resolution: float):
        """Those of features (N, d) and targets (N, k) in the units of the data."""
        return cls(
            features=constant_columns(features.numpy(), resolution),
            outputs=constant_columns(targets.numpy(), resolution, columns.magnitudes),
        )


def constant_columns(
    columns: np.ndarray,
    resolution: float = RESOLUTION,
    magnitudes: np.ndarray | None = None,
) -> NDArray[np.bool_]:
    """Which columns (d,) of (N, d) move by no more than round-off or ``resolution``.

    Round-off is relative to the columns' own magnitudes or to ``magnitudes`` (d,), the
    larger of both: it is that of the numbers that a column holds or is the difference
    of.
    """
    largest = np.abs(columns).max(axis=0)
    if magnitudes is not None:
        largest = np.maximum(largest, magnitudes)
    return np.ptp(columns, axis=0) <= np.maximum(ROUND_OFF * largest, resolution)


def signal_names(transitions: Transitions) -> tuple[list[str], list[str]]:
    """Names of the states and of the inputs: the data's own, or numbers from 1."""
    states = list(transitions.signals.state_names)
    inputs = list(transitions.signals.input_names)
    if not states:
        states = [f"state {i + 1}" for i in range(transitions.state_dim)]
    if not inputs:
        inputs = [f"input {i + 1}" for i in range(transitions.input_dim)]
    return states, inputs


def columns_of(transitions: Transitions, predicts: str) -> Columns:
    """The columns of GPs that learn next states, or differences, of transitions."""
    states, inputs = signal_names(transitions)
    magnitudes = None
    if predicts == "difference":
        magnitudes = transitions.states.abs().amax(dim=0).numpy()
    return Columns(features=states + inputs, outputs=states, magnitudes=magnitudes)


def warn_of_constants(
    features: Tensor,
    targets: Tensor,
    columns: Columns,
    constants: Constants,
    prior: PriorScales,
    resolution: float,
) -> None:
    """Names in the log what the data hold still, and what is supposed of it instead.

    What a setting says is known is not named: a feature of an infinite length-scale,
    and outputs whose deviation the search is to find.
    """
    size = len(features)
    unknown_features = constants.features & np.isfinite(prior.lengthscales)
    lengths = _numbers(prior.lengthscales[unknown_features])
    unknown_outputs = np.zeros_like(constants.outputs)
    deviations = ""
    if prior.deviations is not None:
        unknown_outputs = constants.outputs
        deviations = _numbers(prior.deviations[unknown_outputs])
    if size == 1 and (unknown_features.any() or unknown_outputs.any()):
        _log.warning(
            "training: one row says nothing of how anything varies. Supposed are "
            "length-scales of %s (prior_lengthscale) and deviations of %s "
            "(prior_deviation)",
            lengths or "infinity",
            deviations or "what is found",
        )
        return
    if unknown_features.any():
        _log.warning(
            "training: never moves by more than %.1g (resolution) in the %d rows: %s. "
            "What it changes is not known: away from that value predictions return to "
            "the prior, over a length-scale of %s (prior_lengthscale; 'no_effect' "
            "where it is known to change nothing)",
            resolution,
            size,
            _listed(columns.features, features[0], unknown_features),
            lengths,
        )
    if unknown_outputs.any():
        _log.warning(
            "training: never changes by more than %.1g (resolution) in the targets of "
            "the %d rows: %s. How much it varies elsewhere is not known: supposed is a "
            "deviation of %s (prior_deviation)",
            resolution,
            size,
            _listed(columns.outputs, targets[0], unknown_outputs),
            deviations,
        )


def warn_of_transitions(transitions: Transitions) -> None:
    """Says in the log where transitions look like a mistake of whoever made them.

    Next states that all equal the states, though the states move, are no system's: the
    shift by a row was forgotten. And most of the rows that move are copies of others:
    they teach no more than one of each, but look as if nothing were uncertain.
    Rows at rest, where nothing moves, may repeat.
    """
    states = transitions.states
    next_states = transitions.next_states
    moved = (states != next_states).any(dim=1)
    if not bool(moved.any()):
        if not constant_columns(states.numpy()).all():
            _log.warning(
                "training: next_states equal states in all %d rows, though the states "
                "differ from row to row: next_states[k] must be the states one step "
                "after states[k] (of one recording x: states x[:-1], "
                "next_states x[1:])",
                len(states),
            )
        return
    rows = torch.cat([transitions.features, next_states], dim=1)[moved]
    distinct = len(np.unique(rows.numpy(force=True), axis=0))
    if 2 * distinct <= len(rows):
        _log.warning(
            "training: only %d of %d rows that move are different: copies teach "
            "nothing new, and make the noise look smaller than it is; give every row "
            "once",
            distinct,
            len(rows),
        )


def _numbers(values: NDArray[np.float64]) -> str:
    """Different numbers, in ascending order."""
    return ", ".join(f"{value:.3g}" for value in np.unique(values))


def _listed(names: Sequence[str], values: Tensor, chosen: NDArray[np.bool_]) -> str:
    """The chosen columns with the value that each holds, or how many they are."""
    indices = np.flatnonzero(chosen).tolist()
    texts = [f"{names[i]} ({float(values[i]):.6g})" for i in indices]
    if len(texts) <= _SHOWN:
        return ", ".join(texts)
    return ", ".join(texts[:_SHOWN]) + f" and {len(texts) - _SHOWN} more"
