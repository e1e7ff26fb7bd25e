"""The memory that a solve works in, besides the record that it writes.

To ask the system for it costs as much as a small solve, so each prepared problem or shape keeps what it has used
before: ``list.pop`` and ``list.append`` are atomic, so two threads never hold the same workspace. A workspace begins
with what stays the same from solve to solve and is otherwise undefined:

    [iteration limit, tolerance, whether rows are soft, n, M, tag | traits (5, M) | the kernels' arrays]

Of the traits (``gpmpc.qp.working_set``) lazy mode fills in norms, weights and ends itself.
"""

import numpy as np
from numpy.typing import NDArray

from gpmpc.compiled import borrowing

Array = NDArray[np.float64]

LIMIT, TOLERANCE, SOFT, VARIABLES, CONSTRAINTS, TAG, SETTINGS = 0, 1, 2, 3, 4, 5, 6
VECTORS = 22  # arrays with an entry per constraint


def gram_workspace(settings: Array, traits: Array) -> Array:
    """Memory for solves in Gram mode with these settings (6,) and traits (5, M)."""
    work = np.zeros(_size(settings))
    work[:SETTINGS] = settings
    work[SETTINGS : SETTINGS + traits.size] = traits.ravel()
    return work


def lazy_workspace(settings: Array, softness: Array) -> Array:
    """Memory for solves in lazy mode with these settings (6,) and softness (2, M); with room for L and rows."""
    n, M = int(settings[VARIABLES]), int(settings[CONSTRAINTS])
    rows = most_working(n, M, bool(settings[SOFT])) + 2
    return np.append(
        gram_workspace(settings, np.vstack([np.zeros((2, M)), softness, np.zeros((1, M))])), np.zeros((n + rows) * n)
    )


def _size(settings: Array) -> int:
    n, M = int(settings[VARIABLES]), int(settings[CONSTRAINTS])
    capacity = most_working(n, M, bool(settings[SOFT]))
    return SETTINGS + 5 * M + (VECTORS + 4) * max(M, capacity + 2) + (capacity + 1) ** 2


@borrowing
def most_working(n, M, soft):
    """How many constraints can work at once."""
    return M if soft else min(n, M)


@borrowing
def carve(work):
    """The kernels' arrays: traits, vectors, members, R, and the rest of the memory."""
    n, M = int(work[VARIABLES]), int(work[CONSTRAINTS])
    capacity = most_working(n, M, work[SOFT] != 0.0)
    wide = max(M, capacity + 2)
    a = SETTINGS + 5 * M
    b = a + VECTORS * wide
    c = b + 4 * wide
    d = c + (capacity + 1) * (capacity + 1)
    return (
        work[SETTINGS:a].reshape((5, M)),
        work[a:b].reshape((VECTORS, wide)),
        work[b:c].view(np.int64).reshape((4, wide)),
        work[c:d].reshape((capacity + 1, capacity + 1)),
        work[d:],
    )
