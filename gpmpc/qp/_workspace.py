"""The memory of the dual active-set kernels, and the fields by which they read it.

*Memory* is one matrix that solves work in, the *workspace* the view of it that compiled
code has, and a *record* what a solve leaves behind (``gpmpc.qp._record``).

Asking the system for memory costs as much as a small solve, so each shape of a program,
with its last prices, and each prepared program keeps its own: with the caps and the
place of x in a record it is the program's *workplace* (``_dual_active_set``). Threads
may share it, since a solve keeps the interpreter's lock. The rows of memory, all padded
to the same length, are

    settings (1) | vectors (25) | integer vectors (4) | L | factor | w | K

In compiled code ``work = open_workspace(P, q, G, memory)`` has a field for each of
them: ``work.lower[p]``, ``work.factor[k]``, ``work.tolerance``. To add a vector, add
its name to ``VECTORS``. A ``work`` is a handful of pointers and sizes, as a C struct
would be, and a field becomes an array where it is read. A named tuple of these arrays
would hand seven numbers per array to every function, which doubles the time that
compilation takes (``gpmpc.qp._workspace_type``).

A constraint p is represented by the vector w_p = L^-T c_p with P = L'L, so that K_pq =
c_p'P^-1 c_q = w_p . w_q. The *working set* W is a list of k *slots*: slot i holds one
constraint at one of its bounds, and row i of the factor of K_WW. Its *label* is p + 1
at the upper bound and -(p + 1) at the lower one.
"""

import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from gpmpc._compiled import inline_njit
from gpmpc._kernels.linalg import aligned_rows

Array = NDArray[np.float64]

SETTINGS = (
    "limit",  # changes of the working set
    "tolerance",  # largest residual of a solution
    "soft",  # whether rows may be violated at a price: zero or one
    "tag",  # which prepared program it is (a checksum); zero if it is none
    # Of the program that is being solved.
    "pivot_share",  # what cancellation left of the pivots of P, as a share of P_ii
    "length_of_q",  # its largest |q_j| / sqrt(P_jj), a bound of the lengths of x
    "negligible_length",  # ``NEGLIGIBLE`` times that: an x below it counts as zero
)

VECTORS = (
    # By constraint p < M, box first: C = [I; G], M = n + m. Absent bounds are infinite.
    "lower",
    "upper",
    "allowed_low",  # outside [allowed_low, allowed_high] a constraint is violated;
    "allowed_high",  # infinite for working ones, so that they never are
    "negligible",  # violation of a bound of zero that is none: norm * negligible_length
    "norm",  # length of the vector of c_pj / sqrt(P_jj), j < n
    "cap",  # price of a violation: the largest size of a multiplier
    "row_end",  # leading entries of c_p that may not be zero, in whole registers
    "multiplier",
    "value",  # C x; the first n are the point x
    "excess",  # violation in units of ``norm``
    # By variable j < n.
    "free_rhs",  # L x = free_rhs without working constraints; if prepared, where
    # K takes the place of L, it is -q
    "slope",  # q + C' multiplier
    "gradient",  # P x + q + C' multiplier
    "scratch",
    # By slot i < k of the working set, whose constraint is p.
    "bound",  # b_p, the bound at which p works
    "free_value",  # c_p'x_u, x_u that of ``_start``: before rows came to caps
    "least_multiplier",  # [0, cap] is the range at an upper bound, [-cap, 0] at a
    "most_multiplier",  # lower one, and [-cap, cap] that of an equality
    "diagonal",  # K_pp
    "residual",  # value - bound
    "forward",  # L_K^-1 K_Wp: the row of the factor that p would add
    "direction",  # K_WW^-1 K_Wp: how the working multipliers answer to that of p
    "cosines",  # scratch of Givens rotations
    "sines",
)

INTEGER_VECTORS = (
    "label",  # by slot: of the constraint, see above
    "place",  # by slot: which row of ``w`` is w_p; from slot k on: which are free
    "violated",  # constraints with an excess
    "candidates",  # labels of constraints to be added
)

MATRICES = {
    "P": ("n", "n"),
    "G": ("m", "n"),
    "L": ("n", "width"),  # P = L'L, with reciprocals on the diagonal
    "factor": ("slots", "width"),  # L_K of K_WW = L_K L_K', likewise
    # w_p by place, in prepared memory of all p, whose place is p; see ``FirstRows``
    "w": ("M", "width"),
    "K": ("M", "width"),  # C P^-1 C', if prepared
}

SIZES = ("n", "m", "M", "slots", "width")

_FIRST_MATRIX = 1 + len(VECTORS) + len(INTEGER_VECTORS)
_CAP = 1 + VECTORS.index("cap")
_ROW_END = 1 + VECTORS.index("row_end")
_LIMIT = SETTINGS.index("limit")
_TOLERANCE = SETTINGS.index("tolerance")
_SOFT = SETTINGS.index("soft")
_TAG = SETTINGS.index("tag")


class FirstRows(NamedTuple):
    """The rows of memory in which the matrices begin."""

    L: int
    factor: int
    w: int  # M and one: n + 1 slots need as many places, where m is zero, too
    K: int  # the end of memory that is not prepared


@inline_njit
def first_rows(n, m):
    """Returns where the matrices begin in memory for n variables and m rows of G."""
    L = _FIRST_MATRIX
    factor = L + n
    w = factor + n + 1
    return FirstRows(L=L, factor=factor, w=w, K=w + n + m + 1)


def new_memory(
    caps: Array, n: int, limit: int, tolerance: float, soft: bool, prepared: bool
) -> Array:
    """Returns memory for programs of n variables with these caps (M,)."""
    M = len(caps)
    height = first_rows(n, M - n).K + (M if prepared else 0)
    # kernels write whole registers; loads across cache lines take twice the time
    width = (max(M, n + 2) + 7) // 8 * 8 + 8
    memory = aligned_rows(height, width)
    memory[:] = 0.0
    memory[0, _LIMIT] = limit
    memory[0, _TOLERANCE] = tolerance
    memory[0, _SOFT] = soft
    memory[_CAP, :M] = caps
    registers = np.arange(n) // 8 + 1
    memory[_ROW_END, :n] = np.minimum(n, registers * 8)
    return memory


def with_limit(memory: Array, limit: float) -> Array:
    """Returns a copy of memory with another limit of changes."""
    copy = aligned_rows(*memory.shape)
    copy[:] = memory
    copy[0, _LIMIT] = min(limit, memory[0, _LIMIT])
    return copy


def prepare_memory(memory: Array, G: Array) -> None:
    """Completes prepared memory in which a solve has left the factor of P.

    Writes all w_p, K = C P^-1 C' and the tag.
    """
    m, n = G.shape
    M = n + m
    first = first_rows(n, m)
    L = np.tril(memory[first.L :][:n, :n])
    np.fill_diagonal(L, 1.0 / np.diagonal(L))
    C = np.vstack([np.eye(n), G])
    w = solve_triangular(L, C.T, lower=True, trans="T", check_finite=False).T
    K = memory[first.K :]
    memory[first.w :][:M, :n] = w
    K[:M, :M] = w @ w.T
    memory[0, _TAG] = 1.0 + zlib.crc32(w.tobytes())
