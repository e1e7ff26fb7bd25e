"""Problem: an array takes half a microsecond to cross into compiled code, and several where the caches are cold.

A kernel that needs fifty of them is handed one that holds them all, each from the start of a cache line, and a table
that says where each begins and how many rows and columns it has.
"""

import math
from collections.abc import Sequence

import numpy as np

from gpmpc.compiled import compiled
from gpmpc.qp.workspace import aligned, matrix

Array = np.ndarray

LINE = 8  # doubles in a cache line


class Layout:
    """Where arrays of these shapes stand in a flat one.

    Args:
        shapes: Of one dimension or more; in compiled code all but the last count as rows.

    Attributes:
        table: Start, rows and columns of each (K, 3).
        size: Of the flat array.
    """

    def __init__(self, shapes: Sequence[tuple[int, ...]]):
        sizes = [math.prod(shape) for shape in shapes]
        ends = np.cumsum([-(-size // LINE) * LINE for size in sizes])
        starts = [0, *ends[:-1].tolist()]
        rows = [math.prod(shape[:-1]) for shape in shapes]
        self.table = np.array([starts, rows, [shape[-1] for shape in shapes]], dtype=np.int64).T.copy()
        self.size = int(ends[-1])
        self._places = [(slice(a, a + size), shape) for a, size, shape in zip(starts, sizes, shapes, strict=True)]

    def parts(self, flat: Array) -> list[Array]:
        """The arrays in a flat one, views."""
        return [flat[place].reshape(shape) for place, shape in self._places]


def flattened(arrays: Sequence[Array]) -> tuple[Array, Array]:
    """Arrays copied into a flat one, and its table."""
    layout = Layout([array.shape for array in arrays])
    flat = aligned(1, layout.size)[0]
    for place, array in zip(layout.parts(flat), arrays, strict=True):
        place[:] = array
    return flat, layout.table


@compiled(kernel=False, inline=True)
def part(flat, place):
    """One of ``Layout.parts`` in compiled code, with two dimensions; ``place`` is its row of the table."""
    return matrix(flat, place[0], place[1], place[2])  # with its number numba would compile this for each of them
