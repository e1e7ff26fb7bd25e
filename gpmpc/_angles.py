"""Differences of states some of whose entries are angles.

An angle and the same angle a turn later are one direction. Where one of two states comes
from a sensor that shows angles within a turn, their difference is off by whole turns.
What is taken off is counted here. Arrays and tensors are taken alike.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

TURN = 2.0 * np.pi


def whole_turns(angle: Any) -> Any:
    """The whole turns in angles [rad], of any shape; none in half a turn."""
    return TURN * (angle / TURN).round()


def wrap(angle: Any) -> Any:
    """The angles in [-pi, pi] that differ from others by whole turns [rad].

    What lies there already stays as it is, to the last digit.
    """
    return angle - whole_turns(angle)


def state_difference(one: Any, other: Any, angles: Sequence[int]) -> Any:
    """The difference of states (..., n), whose angles are taken within half a turn.

    Args:
        one: States, as an array or a tensor.
        other: What is taken off them, of the same kind.
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
    """The whole turns (..., n) in differences of states; zero where they are no angles.

    Args:
        difference: Of states (..., n).
        angles: Indices of the states that are angles [rad].
    """
    turns = np.zeros_like(difference)
    places = list(angles)
    if not places:
        return turns
    turns[..., places] = whole_turns(difference[..., places])
    return turns


def angles_of(model: Any) -> list[int]:
    """Indices of a model's states, or of a measurement's entries, that are angles."""
    return list(getattr(model, "angles", ()))
