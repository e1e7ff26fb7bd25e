"""The memory that the dual active-set kernels work in, besides the record that a solve writes.

Asking the system for memory costs as much as a small solve, so each shape (and each prepared problem) keeps its own.
Threads may share it, since a solve keeps the interpreter's lock. It is one matrix, whose rows ``open_workspace`` names.
"""

import zlib
from typing import Any, NamedTuple

import numpy as np
from numba.core import types
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from gpmpc._compiled import inline_njit
from gpmpc._kernels.linalg import aligned_rows
from gpmpc.qp._record import HEADER

Array = NDArray[np.float64]

_LIMIT, _TOLERANCE, _SOFT, _TAG, SHARE, _SETTINGS = range(6)  # a tag of zero: not prepared
_REALS, _INTEGERS = 4, 26  # rows of ``memory`` at which vectors begin, after settings and traits,
_REST = 30  # then integers, the factor of the working set, L and rows
_END_STEP = 4  # ends are rounded up to a multiple of it: sums without a remainder are faster


class Workspace(NamedTuple):
    """A quadratic program as the kernels see it, its point, and scratch; C = [I; G], M = n + m.

    A constraint p is represented by its *row* w_p = L^-T c_p, so that K_pq = c_p'P^-1 c_q = w_p . w_q.
    """

    P: Any  # (n, n)
    q: Any  # (n,)
    G: Any  # (m, n)
    L: Any  # (n, n) with P = L'L
    rows: Any  # (capacity + 1, n) the w_p of the working set, by place; all M of a prepared problem
    gram: Any  # (M, M), padded: all K_pq of a prepared problem; empty otherwise
    v: Any  # (n,) -L^-T q: L x = v without working constraints; of a prepared problem -q
    seen: Any  # (M,) the multipliers that y of a prepared problem belongs to
    lower: Any  # (M,) bounds, infinite where absent
    upper: Any
    allowed_low: Any  # (M,) outside these a constraint is violated; infinite for a working one
    allowed_high: Any
    negligible: Any  # (M,) violation of a bound of zero that is none
    scale: Any  # (M,) length of c_p in the metric of the inverse of P's diagonal
    cap: Any  # (M,) price of a violation: the largest size of a multiplier
    end: Any  # (M,) leading entries of c_p that may not be zero
    record: Any  # what the solve returns, see ``gpmpc.qp._record``; in it
    x: Any  # (n,) the point and
    mu: Any  # (M,) its multipliers
    y: Any  # (M,) C x
    excess: Any  # (M,) violations in units of ``scale``
    violated: Any  # (M,) integers: the constraints with one
    candidates: Any  # (M,) integers
    slope: Any  # (n,) q + C'mu
    gradient: Any  # (n,) P x + q + C'mu
    rest: Any  # (k,) residual of the working constraints
    solved: Any  # (k,) L_K^-1 K_Wp
    r: Any  # (k,) K_WW^-1 K_Wp
    cosines: Any  # (k,)
    sines: Any  # (k,)
    scratch: Any  # (n,) or (k,)
    capacity: int  # how many constraints can work at once
    limit: int  # changes of the working set
    tolerance: float
    soft: bool  # whether rows are soft
    settings: Any  # of the memory; one is what cancellation left of the pivots of P, as a share of P_ii
    tag: float  # of a prepared problem, whose L, scale, end, rows and gram are there; zero otherwise
    prepared: bool


class WorkingSet(NamedTuple):
    """The constraints that are held at a bound, one to a slot; the kernels pass their number k."""

    name: Any  # integers: p + 1 at the upper bound, -(p + 1) at the lower one
    place: Any  # integers: which of ``Workspace.rows``; free places from k on
    bound: Any  # b_p
    free_value: Any  # c_p'x at the unconstrained minimiser
    least: Any  # range of the multiplier: [0, cap] at an upper bound,
    most: Any  # [-cap, 0] at a lower one, [-cap, cap] for an equality
    diagonal: Any  # K_pp
    factor: Any  # L_K of K_WW = L_K L_K'


def new_memory(caps: Array, n: int, limit: int, tolerance: float, soft: bool, prepared: bool) -> Array:
    """Returns memory for programs of n variables with these caps (M,); ``prepared`` has room for all M rows."""
    M = len(caps)
    capacity = min(n, M)
    wide = padded(max(M, capacity + 2, _SETTINGS)) + 8  # kernels write whole lanes
    own = n * padded(n) + (M * (n + padded(M)) if prepared else n * (capacity + 1))
    memory = aligned_rows(_REST + capacity + 1 - (-own // wide), wide)  # loads across cache lines take twice the time
    memory[:] = 0.0
    box = np.arange(M) < n
    memory[0, :_SETTINGS] = limit, tolerance, soft, 0.0, 1.0
    memory[1, :M], memory[2, :M] = box, caps
    memory[3, :M] = box * np.minimum(n, (np.arange(M) // _END_STEP + 1) * _END_STEP)
    return memory


def prepare_memory(memory: Array, G: Array) -> None:
    """Completes ``prepared`` memory, in which a solve has left the factor of P, with the rows w_p and K = C P^-1 C'."""
    m, n = G.shape
    rest = memory[_REST + n + 1 :].reshape(-1)
    L = np.tril(rest[: n * padded(n)].reshape(n, padded(n))[:, :n])
    np.fill_diagonal(L, 1.0 / np.diagonal(L))
    rows = solve_triangular(L, np.vstack([np.eye(n), G]).T, lower=True, trans="T", check_finite=False).T  # L^-T c_p
    rest[n * padded(n) :][: rows.size] = rows.ravel()
    M = n + m
    rest[n * padded(n) + rows.size :][: M * padded(M)].reshape(M, padded(M))[:, :M] = rows @ rows.T
    memory[0, _TAG] = 1.0 + zlib.crc32(rest.tobytes())


@inline_njit
def padded(size):
    """Returns the next multiple of eight."""
    return (size + 7) // 8 * 8


@inline_njit
def round_end(end, n):
    """Returns the number of leading entries that are read where ``end`` may not be zero."""
    return min(n, (end + _END_STEP - 1) // _END_STEP * _END_STEP)


@intrinsic
def _matrix(typing_context, memory, start, rows, columns):
    """The entries of ``memory`` from ``start`` on as a matrix; numba's reshape takes 20 to 90 ns more."""
    kind = types.Array(types.float64, 2, "C")

    def generate(context, builder, signature, arguments):
        source, start, rows, columns = arguments
        data = builder.gep(context.make_array(memory)(context, builder, source).data, [start])
        step, view = context.get_constant(types.intp, 8), context.make_array(kind)(context, builder)
        strides = builder.mul(columns, step), step
        populate_array(view, data=data, shape=(rows, columns), strides=strides, itemsize=step, meminfo=None)
        return view._getvalue()

    return kind(memory, types.intp, types.intp, types.intp), generate


@inline_njit
def open_workspace(P, q, G, memory, out):
    """Returns the workspace and the working set in ``memory`` and the record ``out``."""
    n, M = len(q), len(q) + len(G)
    settings, real, whole = memory[0], memory[_REALS:_INTEGERS], memory[_INTEGERS:_REST].view(np.int64)
    soft, tag, capacity = settings[_SOFT] != 0.0, settings[_TAG], min(n, M)
    prepared = tag != 0.0
    factor, start = memory[_REST : _REST + capacity + 1], (_REST + capacity + 1) * memory.shape[1]
    count, end = M if prepared else capacity + 1, start + n * padded(n)
    L, rows = _matrix(memory, start, n, padded(n)), _matrix(memory, end, count, n)  # pyright: ignore[reportCallIssue]
    gram = _matrix(memory, end + count * n, M * prepared, padded(M))  # pyright: ignore[reportCallIssue]
    x, mu = out[HEADER : HEADER + n], out[HEADER + n : HEADER + n + M]
    work = Workspace(
        P, q, G, L, rows, gram, real[0], real[21], real[1], real[2], real[3], real[4], real[5], memory[1], memory[2],
        memory[3], out, x, mu, real[6][:M], real[7], whole[0], whole[1], real[8], real[9], real[10], real[11], real[12],
        real[13], real[14], real[15], capacity, int(settings[_LIMIT]), settings[_TOLERANCE], soft, settings, tag,
        prepared,
    )  # fmt: skip
    active = WorkingSet(whole[2], whole[3], real[16], real[17], real[18], real[19], real[20], factor)
    return work, active


@inline_njit
def is_dense(vector):
    """Returns whether a vector is as contiguous as its type claims: an unchecked entry point does not look."""
    return vector.strides[0] == vector.itemsize or len(vector) <= 1


@inline_njit
def is_dense_matrix(A):
    """Returns whether a matrix is as contiguous as its type claims."""
    rows, columns = A.shape
    return (A.strides[0] == columns * A.itemsize and A.strides[1] == A.itemsize) or rows * columns == 0


@inline_njit
def all_finite(vector):
    """Returns whether no entry is infinite or NaN."""
    undefined = 0.0
    for value in vector:
        undefined += value * 0.0
    return undefined == 0.0
