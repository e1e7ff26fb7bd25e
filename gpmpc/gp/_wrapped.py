"""Finds angles that a sensor shows within a turn, and that nobody declared.

A model that takes such a jump for a change of the state learns that a pendulum is
thrown by a turn where it passes the seam. An angle that wraps has three marks, which
honest large steps do not have together: there are steps of almost a turn and, but for
these, only steps that are far smaller; without the turn the large ones are as small as
the others; and all values lie within one turn. Where values lie farther apart, as where
a simulator counts turns in its states and wraps in its next states, the large steps
have to be whole turns as exactly as the others are small.
"""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc._angles import TURN
from gpmpc.gp._transitions import Transitions

_log = logging.getLogger(__name__)
# of a turn: as ``Turn.far_smaller``, where values lie farther apart than a turn
_FAR_SMALLER_APART = 1 / 10
_EXACT = 0.1  # of a turn, by which jumps may miss whole turns there
_SLACK = 0.005  # of a turn: noise that was added after the angle was wrapped
# what is left of jumps without whole turns, over the largest other step
_AS_SMALL = 1.15


DECLARE = (
    "Declare angles, in rad (train_residual or ResidualModel.train with "
    "angles={columns}), or let them count turns (numpy.unwrap)"
)


RADIANS = "2 pi"  # a turn in words


class Turn(NamedTuple):
    """A whole turn in a unit."""

    size: float
    words: str
    far_smaller: float  #: largest step that is no jump, where there are some [turns]


# Many honest states reach hundreds, few of them 6: what counts for degrees is stricter.
_TURNS = (
    Turn(size=TURN, words=RADIANS, far_smaller=1 / 6),
    Turn(size=360.0, words="360", far_smaller=1 / 36),
)


class WrappedColumn(NamedTuple):
    """A state that jumps by whole turns."""

    column: int  #: its index, from 0
    rows: int  #: how many rows jump
    turn: str  #: what it jumps by, in words


def wrapped_columns(
    states: NDArray[np.float64], next_states: NDArray[np.float64]
) -> list[WrappedColumn]:
    """Finds the columns of x[k] and x[k+1], both (N, n), that jump by whole turns."""
    columns = []
    for column in range(states.shape[1]):
        before = states[:, column]
        after = next_states[:, column]
        for turn in _TURNS:
            rows = _jumps(before, after, turn)
            if rows:
                columns.append(WrappedColumn(column, rows, turn.words))
                break
    return columns


def warn_of_turns(
    transitions: Transitions, angles: Sequence[int] = (), remedy: str = DECLARE
) -> None:
    """Logs which states jump by whole turns although they are no declared angles.

    Args:
        transitions: What a model is about to learn from.
        angles: Indices of the states that are declared.
        remedy: What the message tells the user to do; ``{columns}`` stands for the
            indices.
    """
    columns = wrapped_columns(
        transitions.states.numpy(force=True), transitions.next_states.numpy(force=True)
    )
    undeclared = [wrapped for wrapped in columns if wrapped.column not in angles]
    if not undeclared:
        return
    jumps = [
        f"column {wrapped.column + 1} of the states jumps by whole turns "
        f"({wrapped.turn}) in {wrapped.rows} of {len(transitions)} rows"
        for wrapped in undeclared
    ]
    _log.warning(
        "%s, as an angle does that is shown within one turn: jumps are learned as "
        "motion. %s",
        "; ".join(jumps),
        remedy.format(columns=[wrapped.column for wrapped in undeclared]),
    )


def _jumps(before: NDArray[np.float64], after: NDArray[np.float64], turn: Turn) -> int:
    """Counts the steps of a column (N,) that are whole turns.

    Zero unless the column has all marks of an angle that wraps.
    """
    steps = (after - before) / turn.size
    large = np.abs(steps) > 0.5
    small_steps = np.abs(steps[~large])
    count = int(large.sum())
    if not count or len(small_steps) < 2:
        return 0
    largest_small = float(small_steps.max())
    remainder = float(np.abs(steps[large] - np.round(steps[large])).max())
    lowest = min(before.min(), after.min())
    highest = max(before.max(), after.max())
    if highest - lowest <= (1 + 2 * _SLACK) * turn.size:
        step_limit = turn.far_smaller
        remainder_limit = _AS_SMALL * largest_small + _SLACK
    else:  # values lie farther apart than a turn
        step_limit = min(turn.far_smaller, _FAR_SMALLER_APART)
        remainder_limit = 0.0
        if count > 1:
            remainder_limit = min(_AS_SMALL * largest_small, _EXACT)
    wraps = largest_small <= step_limit and remainder <= remainder_limit
    return count if wraps else 0
