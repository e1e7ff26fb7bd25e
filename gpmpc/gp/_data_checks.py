"""Checks of training data: constant columns, states that never follow, copies.

A training goes on all the same. The log says in one line what could not be learned,
with the rule and the way out.
"""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc.gp._transitions import Transitions, check_transitions
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.signals import UNKNOWN, Signals

_log = logging.getLogger(__name__)

#: Part of its magnitude by which a column moves for round-off alone: twelve of the 52
#: bits of a number. A feature of standard deviation 1 around 1e9, 1e-9 of it, moves.
ROUND_OFF = 2**12 * np.finfo(np.float64).eps
#: What a column moves by at most, in its own unit, where it does not move: solvers and
#: simulators leave residues of as much.
RESOLUTION = 1e-9


class ColumnDescriptions(NamedTuple):
    """Names and magnitudes of the columns of features and targets."""

    features: Sequence[str]  #: names (d,)
    outputs: Sequence[str]  #: names (k,)
    #: of the numbers that the targets are differences of (k,), which round-off is
    #: relative to; None: of the targets themselves
    magnitudes: NDArray[np.float64] | None = None
    #: what ``prior_deviation`` counts in (k,), in the units of the targets; None: those
    deviation_units: NDArray[np.float64] | None = None

    @classmethod
    def of_tensors(
        cls,
        features: Tensor,
        targets: Tensor,
        input_dim: int,
        predicts: str,
        signals: Signals = UNKNOWN,
    ) -> "ColumnDescriptions":
        """Names states and inputs as signals do, and all others by numbers from 1.

        Args:
            features: x~ = (x, u) (N, n + m).
            targets: (N, k).
            input_dim: m.
            predicts: What the targets mean.
            signals: Of the data, where they are known.
        """
        output_count = targets.shape[1]
        states = list(signals.state_names)
        if not states:
            states = _numbered("state", features.shape[1] - input_dim)
        inputs = list(signals.input_names) or _numbered("input", input_dim)
        outputs = states
        if predicts == "value":
            outputs = _numbered("output", output_count)
        magnitudes = None
        if predicts == "difference":
            largest = features[:, :output_count].abs().amax(dim=0)
            magnitudes = largest.numpy(force=True)
        return cls(features=states + inputs, outputs=outputs, magnitudes=magnitudes)

    @classmethod
    def of_transitions(
        cls, transitions: Transitions, predicts: str
    ) -> "ColumnDescriptions":
        """Names the columns of GPs that learn next states, or differences."""
        states, inputs = signal_names(transitions)
        magnitudes = None
        if predicts == "difference":
            magnitudes = transitions.states.abs().amax(dim=0).numpy(force=True)
        return cls(features=states + inputs, outputs=states, magnitudes=magnitudes)


class ConstantColumns(NamedTuple):
    """Which columns of a training's data are constant."""

    features: NDArray[np.bool_]  #: (d,)
    outputs: NDArray[np.bool_]  #: (k,)

    @classmethod
    def find(
        cls,
        features: Tensor,
        targets: Tensor,
        columns: ColumnDescriptions,
        resolution: float,
    ) -> "ConstantColumns":
        """Finds the constant columns of features (N, d) and targets (N, k).

        Both are in the units of the data.
        """
        return cls(
            features=constant_columns(features.numpy(), resolution),
            outputs=constant_columns(targets.numpy(), resolution, columns.magnitudes),
        )


def constant_columns(
    columns: np.ndarray,
    resolution: float = RESOLUTION,
    magnitudes: np.ndarray | None = None,
) -> NDArray[np.bool_]:
    """Finds the columns (d,) of (N, d) that move by no more than ``resolution``.

    A column does not move, either, by round-off. That is relative to the columns' own
    magnitudes or to ``magnitudes`` (d,), the larger of both: to the numbers that a
    column holds or is the difference of.
    """
    largest = np.abs(columns).max(axis=0)
    if magnitudes is not None:
        largest = np.maximum(largest, magnitudes)
    return np.ptp(columns, axis=0) <= np.maximum(ROUND_OFF * largest, resolution)


def column_scales(
    columns: np.ndarray, constant: np.ndarray | None = None
) -> np.ndarray:
    """Computes the scales (d,) of columns (N, d): their standard deviations.

    That of a constant column is its magnitude, or 1 where that is at most 1e-9
    (``RESOLUTION``).

    Args:
        columns: (N, d).
        constant: Which of them are constant (d,); by default as ``constant_columns``
            finds.
    """
    constant = constant_columns(columns) if constant is None else constant
    shifted = columns - columns[0]
    magnitude = np.abs(columns).max(axis=0)
    magnitude = np.where(magnitude > RESOLUTION, magnitude, 1.0)
    unit = np.where(constant, magnitude, np.abs(shifted).max(axis=0))
    deviation = (shifted / unit).std(axis=0, ddof=min(1, len(columns) - 1))
    return unit * np.where(constant, 1.0, deviation)


def signal_names(transitions: Transitions) -> tuple[list[str], list[str]]:
    """Returns the names of the states and of the inputs, or numbers from 1."""
    states = list(transitions.signals.state_names)
    inputs = list(transitions.signals.input_names)
    if not states:
        states = _numbered("state", transitions.state_dim)
    if not inputs:
        inputs = _numbered("input", transitions.input_dim)
    return states, inputs


def _numbered(word: str, count: int) -> list[str]:
    return [f"{word} {i + 1}" for i in range(count)]


def checked_targets(transitions: Transitions, predicts: str) -> Tensor:
    """Returns the targets (N, n) of transitions; the log names what looks wrong.

    Raises:
        SettingError: They are no ``Transitions``.
        UnsupportedModel: The GPs predict values, which transitions do not hold.
    """
    check_transitions(transitions)
    targets = transitions.targets(predicts)
    warn_of_turns(transitions)
    warn_of_transitions(transitions)
    return targets


def warn_of_transitions(transitions: Transitions) -> None:
    """Logs where transitions look like a mistake of whoever made them.

    Next states that all equal the states, though the states move, are no system's: the
    shift by a row was forgotten. And most of the rows that move are copies of others:
    they teach no more than one of each, but look as if nothing were uncertain.
    Rows at rest, where nothing moves, may repeat.
    """
    states = transitions.states
    next_states = transitions.next_states
    moving = (states != next_states).any(dim=1)
    if not bool(moving.any()):
        if not constant_columns(states.numpy(force=True)).all():
            _log.warning(
                "training: next_states equal states in all %d rows, though the states "
                "differ from row to row: next_states[k] must be the states one step "
                "after states[k] (of one recording x: states x[:-1], "
                "next_states x[1:])",
                len(states),
            )
        return
    rows = torch.cat([transitions.features, next_states], dim=1)[moving]
    distinct = len(np.unique(rows.numpy(force=True), axis=0))
    if 2 * distinct <= len(rows):
        _log.warning(
            "training: only %d of %d rows that move are different: copies teach "
            "nothing new, and make the noise look smaller than it is; give every row "
            "once",
            distinct,
            len(rows),
        )
