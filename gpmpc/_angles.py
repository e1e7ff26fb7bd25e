"""Differences of states some of whose entries are angles.

An angle and the same angle a turn later are one direction. Where one of two states
comes from a sensor that shows angles within a turn, their difference is off by whole
turns, which the functions here count and subtract. They take arrays and tensors alike.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

TURN = 2.0 * np.pi


def whole_turns(angle: Any) -> Any:
    """Returns the whole turns in angles [rad], of any shape; none in half a turn."""
    return TURN * (angle / TURN).round()


def wrap(angle: Any) -> Any:
    """Returns the angles in [-pi, pi] that differ from others by whole turns [rad].

    Angles that lie there already stay as they are, to the last digit.
    """
    return angle - whole_turns(angle)


def arc(angles: NDArray[np.float64]) -> tuple[float, float]:
    """Returns beginning and end of the shortest arc that holds angles [rad].

    It begins in [-pi, pi], and may end beyond.

    Args:
        angles: At least one (N,), with any whole turns.
    """
    ordered = np.sort(wrap(angles))
    gaps = np.append(np.diff(ordered), ordered[0] + TURN - ordered[-1])
    widest = int(np.argmax(gaps))
    first = float(ordered[(widest + 1) % len(ordered)])
    return first, first + TURN - float(gaps[widest])


def state_difference(one: Any, other: Any, angles: Sequence[int]) -> Any:
    """Returns the difference of states (..., n), its angles within half a turn.

    Args:
        one: States, as an array or a tensor.
        other: States that are subtracted from them, of the same kind.
        angles: Indices of the states that are angles [rad].
    """
    difference = one - other
    places = list(angles)
    if places:
        difference[..., places] = wrap(difference[..., places])
    return difference


def full_turns(
    difference: NDArray[np.float64], angles: Sequence[int]
) -> NDArray[np.float64]:
    """Returns the whole turns (..., n) in differences of states.

    They are zero in states that are no angles.

    Args:
        difference: Differences of states (..., n).
        angles: Indices of the states that are angles [rad].
    """
    turns = np.zeros_like(difference)
    places = list(angles)
    if not places:
        return turns
    turns[..., places] = whole_turns(difference[..., places])
    return turns


def angles_of(model: Any) -> list[int]:
    """Returns the indices of a model's states, or measured entries, that are angles."""
    return list(getattr(model, "angles", ()))
