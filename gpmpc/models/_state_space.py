"""State spaces made of vectors, angles and unit quaternions.

The difference of two states is taken in the tangent space (Sola, Deray and Atchuthan,
2018): that of vectors is the ordinary one, that of angles is wrapped to [-pi, pi], and
that of attitudes is the rotation vector log(q_b^-1 q_a) in the body frame. A quaternion
of four numbers so has an error of three.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from gpmpc._angles import wrap
from gpmpc._dynamics import Array
from gpmpc.models._quaternions import (
    quaternion_inverse,
    quaternion_product,
    rotation_quaternion,
    rotation_vector,
)

GroupKind = Literal["vector", "angle", "quaternion"]


@dataclass(frozen=True)
class StateGroup:
    """Entries of a state that are measured together and judged by one error."""

    name: str  #: such as "position"
    entries: tuple[str, ...]  #: names of the entries; four of a quaternion, x, y, z, w
    unit: str = ""  #: of the entries; a quaternion's errors are in rad
    kind: GroupKind = "vector"  #: how differences are taken

    @property
    def error_dim(self) -> int:
        """Number of entries of a difference: three of a quaternion."""
        return 3 if self.kind == "quaternion" else len(self.entries)


@dataclass(frozen=True)
class StateSpace:
    """A state (n,) made of groups, one after the other, with errors (e,)."""

    groups: tuple[StateGroup, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of a state (n,)."""
        return tuple(entry for group in self.groups for entry in group.entries)

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Columns of each group in a state."""
        return _slices([len(group.entries) for group in self.groups])

    @cached_property
    def error_columns(self) -> tuple[slice, ...]:
        """Columns of each group in a difference."""
        return _slices([group.error_dim for group in self.groups])

    @cached_property
    def angles(self) -> tuple[int, ...]:
        """Indices of the entries of a state that are angles."""
        indices: list[int] = []
        for group, columns in zip(self.groups, self.columns, strict=True):
            if group.kind == "angle":
                indices += range(columns.start, columns.stop)
        return tuple(indices)

    @property
    def dim(self) -> int:
        """Number of entries of a state, n."""
        return self.columns[-1].stop

    @property
    def error_dim(self) -> int:
        """Number of entries of a difference, e."""
        return self.error_columns[-1].stop

    @property
    def origin(self) -> Array:
        """The state (n,) of zeros; quaternions are those of no rotation."""
        state = np.zeros(self.dim)
        for group, columns in zip(self.groups, self.columns, strict=True):
            if group.kind == "quaternion":
                state[columns.stop - 1] = 1.0
        return state

    def difference(self, a: Array, b: Array) -> Array:
        """Computes a - b (..., e) of states (..., n)."""
        differences = []
        for group, columns in zip(self.groups, self.columns, strict=True):
            a_part = a[..., columns]
            b_part = b[..., columns]
            if group.kind == "quaternion":
                turn = quaternion_product(quaternion_inverse(b_part), a_part)
                differences.append(rotation_vector(turn))
            elif group.kind == "angle":
                differences.append(wrap(a_part - b_part))
            else:
                differences.append(a_part - b_part)
        return np.concatenate(differences, axis=-1)

    def displace(self, state: Array, error: Array) -> Array:
        """Computes the state (..., n) that lies an error (..., e) off another."""
        displaced = []
        columns = zip(self.columns, self.error_columns, strict=True)
        for group, (state_columns, error_columns) in zip(
            self.groups, columns, strict=True
        ):
            state_part = state[..., state_columns]
            error_part = error[..., error_columns]
            if group.kind == "quaternion":
                turn = rotation_quaternion(error_part)
                displaced.append(quaternion_product(state_part, turn))
            elif group.kind == "angle":
                displaced.append(wrap(state_part + error_part))
            else:
                displaced.append(state_part + error_part)
        return np.concatenate(displaced, axis=-1)

    def distances(self, errors: Array) -> Array:
        """Computes each group's Euclidean or geodesic error (..., groups).

        Args:
            errors: Differences of states (..., e).
        """
        lengths = [np.linalg.norm(errors[..., c], axis=-1) for c in self.error_columns]
        return np.stack(lengths, axis=-1)


def _slices(lengths: Sequence[int]) -> tuple[slice, ...]:
    """Returns the slices of adjacent pieces of some lengths."""
    ends = np.cumsum(lengths).tolist()
    pairs = zip(ends, lengths, strict=True)
    return tuple(slice(end - length, end) for end, length in pairs)
