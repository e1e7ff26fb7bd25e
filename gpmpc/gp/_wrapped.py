"""Finds states that jump by whole turns: angles that a sensor shows within a turn, and that nobody declared.

A model that takes such a jump for a change of the state learns that a pendulum is thrown by a turn where it passes
the seam. An angle that wraps has three marks, which honest large steps do not have together: there are steps of almost
a turn and, but for these, only steps that are far smaller; without the turn the large ones are as small as the others;
and all values lie within one turn. Where values lie farther apart, as where a simulator counts turns in its states and
wraps in its next states, the large steps have to be whole turns as exactly as the others are small.
"""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc._angles import TURN
from gpmpc.gp._transitions import Transitions

_log = logging.getLogger(__name__)
_FAR_SMALLER = 1 / 6  # of a turn: the largest step that is no jump
_FAR_SMALLER_APART = 1 / 12  # likewise, where values lie farther apart than a turn
_EXACT = 0.05  # of a turn, by which jumps may miss whole turns there
_SLACK = 0.01  # of a turn: noise that was added after the angle was wrapped
_AS_SMALL = 1.25  # jumps without their turns, over the largest other step
_UNITS = ((TURN, "2 pi"), (360.0, "360"))


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
        before, after = states[:, column], next_states[:, column]
        for turn, unit in _UNITS:
            rows = _jumps(before, after, turn)
            if rows:
                columns.append(WrappedColumn(column, rows, unit))
                break
    return columns


def warn_of_turns(transitions: Transitions, angles: Sequence[int] = ()) -> None:
    """Logs which states jump by whole turns although they are not among the declared angles."""
    columns = wrapped_columns(
        transitions.states.numpy(force=True), transitions.next_states.numpy(force=True)
    )
    undeclared = [found for found in columns if found.column not in angles]
    if not undeclared:
        return
    what = "; ".join(
        f"column {found.column + 1} of the states jumps by whole turns ({found.turn}) "
        f"in {found.rows} of {len(transitions)} rows"
        for found in undeclared
    )
    _log.warning(
        "%s, as an angle does that is shown within one turn: jumps are learned as motion. Declare angles, in rad "
        "(train_residual or ResidualModel.train with angles=%s), or let them count turns (numpy.unwrap)",
        what,
        [found.column for found in undeclared],
    )


def _jumps(
    before: NDArray[np.float64], after: NDArray[np.float64], turn: float
) -> int:
    """How many steps of a column (N,) are whole turns; none unless that is what they are."""
    steps = after - before
    large = np.abs(steps) > turn / 2
    jumps = steps[large]
    others = np.abs(steps[~large])
    if not len(jumps) or len(others) < 2:
        return 0
    smallness = float(others.max())
    misses = float(np.abs(jumps - turn * np.round(jumps / turn)).max())
    lowest = min(before.min(), after.min())
    highest = max(before.max(), after.max())
    if highest - lowest <= (1 + _SLACK) * turn:
        as_small = misses <= _AS_SMALL * smallness + _SLACK * turn
        return len(jumps) if smallness <= _FAR_SMALLER * turn and as_small else 0
    as_small = misses <= min(_AS_SMALL * smallness, _EXACT * turn)
    far_smaller = smallness <= _FAR_SMALLER_APART * turn
    return len(jumps) if far_smaller and as_small and len(jumps) > 1 else 0
