"""The memory that a solve works in, besides the record that it writes.

To ask the system for it costs as much as a small solve, so each prepared problem or shape keeps it. Threads may share
it, since a solve keeps the interpreter's lock. It is one matrix, whose rows have an entry per constraint; to slice it
costs nothing. Its first rows stay the same from solve to solve, the others are otherwise undefined:

    iteration limit, tolerance, whether rows are soft, n, M, tag, smallest share of a pivot of P's factor in P_ii
    traits (4 rows, see ``gpmpc.qp.working_set``; lazy mode fills in the scales, and the ends of the rows of G)
    vectors, members (integers), R, and in lazy mode L and rows
"""

import numpy as np
from numba.core import types
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

from gpmpc.compiled import woven

Array = NDArray[np.float64]

LIMIT, TOLERANCE, SOFT, VARIABLES, CONSTRAINTS, TAG, SHARE, SETTINGS = 0, 1, 2, 3, 4, 5, 6, 7
TRAITS, VECTORS, MEMBERS = 4, 24, 4  # rows of each
END_STEP = 4  # ends are rounded up to a multiple of it: sums without a remainder are faster


def gram_workspace(settings: Array, traits: Array) -> Array:
    """Memory for solves in Gram mode with these settings (7,) and traits (4, M)."""
    return _workspace(settings, traits, 0)


def lazy_workspace(settings: Array, softness: Array) -> Array:
    """Memory for solves in lazy mode with these settings (7,) and softness (2, M)."""
    n, M = int(settings[VARIABLES]), int(settings[CONSTRAINTS])
    box = np.arange(M) < n
    ends = np.minimum(n, (np.arange(M) // END_STEP + 1) * END_STEP)
    traits = np.vstack([box, softness, box * ends])
    return _workspace(settings, traits, n * (padded(n) + most_working(n, M, bool(settings[SOFT])) + 2))


def _workspace(settings: Array, traits: Array, own: int) -> Array:
    n, M = int(settings[VARIABLES]), int(settings[CONSTRAINTS])
    capacity = most_working(n, M, bool(settings[SOFT]))
    wide = padded(max(M, capacity + 2, SETTINGS)) + 8  # kernels write whole lanes
    work = aligned(1 + TRAITS + VECTORS + MEMBERS + capacity + 1 + -(-own // wide), wide)
    work[0, :SETTINGS] = settings
    work[1 : 1 + TRAITS, :M] = traits
    return work


def aligned(rows: int, columns: int) -> Array:
    """Zeros that begin where a cache line does: a load of eight numbers that spans two lines takes twice the time."""
    memory = np.zeros(rows * columns + 8)
    start = -memory.ctypes.data // 8 % 8
    return memory[start : start + rows * columns].reshape(rows, columns)


@woven
def most_working(n, M, soft):
    """How many constraints can work at once."""
    return M if soft else min(n, M)


@woven
def padded(size):
    """The next multiple of eight."""
    return (size + 7) // 8 * 8


@woven
def round_end(end, n):
    """The number of leading entries that are looked at where ``end`` may not be zero."""
    return min(n, (end + END_STEP - 1) // END_STEP * END_STEP)


@intrinsic
def matrix(typing_context, memory, start, rows, columns):
    """The entries of a contiguous array from ``start`` on as (rows, columns); numba's reshape takes 20 ns more."""
    kind = types.Array(types.float64, 2, "C")

    def generate(context, builder, signature, arguments):
        source, start, rows, columns = arguments
        data = builder.gep(context.make_array(memory)(context, builder, source).data, [start])
        step = context.get_constant(types.intp, 8)
        view = context.make_array(kind)(context, builder)
        strides = builder.mul(columns, step), step
        populate_array(view, data=data, shape=(rows, columns), strides=strides, itemsize=step, meminfo=None)
        return view._getvalue()

    return kind(memory, types.intp, types.intp, types.intp), generate


@woven
def carve(work):
    """The kernels' arrays: settings, traits, vectors, members, R, and the rest of the memory."""
    settings = work[0]
    capacity = most_working(int(settings[VARIABLES]), int(settings[CONSTRAINTS]), settings[SOFT] != 0.0)
    a = 1 + TRAITS
    b = a + VECTORS
    c = b + MEMBERS
    d = c + capacity + 1
    return settings, work[1:a], work[a:b], work[b:c].view(np.int64), work[c:d], work[d:]


@woven
def is_dense(vector):
    """Whether a vector is as contiguous as its type claims: ``gpmpc.compiled.direct`` does not ask."""
    return vector.strides[0] == vector.itemsize or len(vector) <= 1


@woven
def is_dense_matrix(A):
    """The same for a matrix."""
    rows, columns = A.shape
    return (A.strides[0] == columns * A.itemsize and A.strides[1] == A.itemsize) or rows * columns == 0


@woven
def all_finite(vector):
    """Whether no entry is infinite or NaN."""
    undefined = 0.0
    for value in vector:
        undefined += value * 0.0
    return undefined == 0.0
