"""The memory that the dual active-set kernels work in, besides the record that a solve writes.

Asking the system for memory costs as much as a small solve, so each shape (and each prepared program) keeps its own.
Threads may share it, since a solve keeps the interpreter's lock. It is one matrix; ``Workspace`` has few fields because
each of an array's seven numbers is handed to each function that numba compiles, which makes up half of the time that
compilation takes.
"""

import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from gpmpc._compiled import inline_njit
from gpmpc._kernels.linalg import aligned_rows

Array = NDArray[np.float64]

# Rows of ``Workspace.vectors`` by constraint (M,), box first: C = [I; G], M = n + m. Bounds are infinite where absent;
# outside of what is allowed a constraint is violated, which a working one cannot be.
LOWER, UPPER, ALLOWED_LOW, ALLOWED_HIGH = range(4)
NEGLIGIBLE = 4  # violation of a bound of zero that is none
SCALE = 5  # length of c_p in the metric of the inverse of P's diagonal
CAP = 6  # price of a violation: the largest size of a multiplier
END = 7  # leading entries of c_p that may not be zero, in steps of a register
MU, Y, EXCESS = (
    8,
    9,
    10,
)  # multipliers; C x, so that the first n are the point; violations in units of ``SCALE``
# by variable (n,): -L^-T q, so that L x = v without working constraints (-q if prepared); q + C'mu; P x + q + C'mu
V = 11
SLOPE = 12
GRADIENT = 13
SCRATCH = 14
# and by slot of the working set (k,): b_p; c_p'x at the unconstrained minimiser; the range of the multiplier, which is
# [0, cap] at an upper bound, [-cap, 0] at a lower one and [-cap, cap] for an equality; K_pp
BOUND, FREE_VALUE, LEAST, MOST, DIAGONAL = range(15, 20)
REST, SOLVED_K, R, COSINES, SINES, _VECTORS = range(
    20, 26
)  # residual; L_K^-1 K_Wp; K_WW^-1 K_Wp; of rotations

# Rows of ``Workspace.indices``: in the slots of the working set p + 1 at the upper bound or -(p + 1) at the lower one,
# and the place of w_p in ``rows`` (those of slots from k on are free); the constraints with an excess; those to enter.
NAME, PLACE, VIOLATED, CANDIDATES, _INDICES = range(5)

# In the first row of memory; a tag of zero: not prepared; what cancellation left of the pivots of P, a share of P_ii.
_LIMIT, _TOLERANCE, _SOFT, _TAG, SHARE = range(5)


class Workspace(NamedTuple):
    """A quadratic program as the kernels see it, its point and its working set W of k constraints.

    A constraint p is represented by its *row* w_p = L^-T c_p, so that K_pq = c_p'P^-1 c_q = w_p . w_q.
    """

    P: Any  # (n, n)
    q: Any  # (n,)
    G: Any  # (m, n)
    L: Any  # (n, n) with P = L'L
    rows: Any  # (n + 1, n) the w_p of the working set, by place; if prepared all of them, then K (2M, M)
    factor: Any  # (n + 1, n) L_K of K_WW = L_K L_K'
    vectors: Any  # see above
    indices: Any
    limit: int  # changes of the working set
    tolerance: float
    soft: bool  # whether rows are soft
    tag: float  # of a prepared program, of which L, rows, ``SCALE``, ``END`` and share are there; zero otherwise


def new_memory(
    caps: Array, n: int, limit: int, tolerance: float, soft: bool, prepared: bool
) -> Array:
    """Returns memory for programs of n variables with these caps (M,)."""
    M = len(caps)
    wide = padded(max(M, n + 2)) + 8  # kernels write whole lanes
    rows = n + (2 * M if prepared else n + 1) + n + 1
    memory = aligned_rows(
        1 + _VECTORS + _INDICES + rows, wide
    )  # loads across cache lines take twice the time
    memory[:] = 0.0
    box = np.arange(M) < n
    memory[0, :_TAG] = limit, tolerance, soft
    memory[1 + CAP, :M] = caps
    memory[1 + END, :M] = box * np.minimum(n, (np.arange(M) // 8 + 1) * 8)
    return memory


def prepare_memory(memory: Array, G: Array) -> None:
    """Completes ``prepared`` memory, in which a solve has left the factor of P, with the rows w_p and K = C P^-1 C'."""
    m, n = G.shape
    _, L, rows, K, _ = np.split(
        memory, 1 + _VECTORS + _INDICES + np.cumsum([0, n, n + m, n + m])
    )
    L = np.tril(L[:, :n])
    np.fill_diagonal(L, 1.0 / np.diagonal(L))
    w = solve_triangular(
        L, np.vstack([np.eye(n), G]).T, lower=True, trans="T", check_finite=False
    ).T  # L^-T c_p
    rows[:, :n] = w
    K[:, : n + m] = w @ w.T
    memory[0, _TAG] = 1.0 + zlib.crc32(w.tobytes())


@inline_njit
def padded(size):
    """Returns the next multiple of eight."""
    return (size + 7) // 8 * 8


@inline_njit
def open_workspace(P, q, G, memory):
    """Returns the workspace in ``memory``."""
    n = len(q)
    settings = memory[0]
    whole = 1 + _VECTORS
    L = whole + _INDICES
    rows = whole + _INDICES + n
    factor = len(memory) - n - 1
    return Workspace(
        P, q, G, memory[L:rows], memory[rows:factor], memory[factor:], memory[1:whole],
        memory[whole:L].view(np.int64), int(settings[_LIMIT]), settings[_TOLERANCE], settings[_SOFT] != 0.0,
        settings[_TAG],
    )  # fmt: skip
