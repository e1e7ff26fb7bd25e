"""The working set's slots, and the factor K_WW = L_K L_K' as constraints come and go.

The functions take a workspace (``gpmpc.qp._workspace``) and the number k of working
constraints, which fill the slots 0 to k - 1. Slot k holds the one that may be added.
"""

from gpmpc._compiled import inline_njit
from gpmpc._kernels._simd import load_some, store, zeros
from gpmpc._kernels.linalg import dot
from gpmpc.qp._triangular import (
    append_row,
    delete_row,
    multiply_rows,
    scale,
    solve_lower,
    solve_transposed,
    subtract_rows,
)
from gpmpc.qp._violations import is_watched, stop_watching

# A candidate depends on the working constraints if less than this share of K_pp is
# left.
_CANDIDATE_PIVOT = 1e-9


@inline_njit
def is_prepared(work):
    """Returns whether the memory holds the factor, all w_p and K beforehand."""
    return work.tag != 0.0


@inline_njit
def constraint_in(work, slot):
    """Returns the constraint that a slot holds."""
    return abs(work.label[slot]) - 1


@inline_njit
def write_slot(work, k, p, at_upper):
    """Writes constraint p, at its upper or its lower bound, to slot k."""
    if is_prepared(work):
        work.place[k] = p  # prepared memory has w by constraint
        row = work.K[p]  # begins with c_p'P^-1, as ``free_rhs`` is -q
        work.diagonal[k] = row[p]
    else:
        row = work.w[work.place[k]]
        end = int(work.row_end[p])
        _write_constraint(work, p, row)
        solve_transposed(work.L, end, row)  # w_p = L^-T c_p
        work.diagonal[k] = dot(row, row, end)
    low = work.lower[p]
    high = work.upper[p]
    cap = work.cap[p]
    equality = low == high
    work.label[k] = p + 1 if at_upper else -(p + 1)
    work.bound[k] = high if at_upper else low
    work.least_multiplier[k] = -cap if equality or not at_upper else 0.0
    work.most_multiplier[k] = cap if equality or at_upper else 0.0
    work.free_value[k] = dot(row, work.free_rhs, work.n)


@inline_njit
def _write_constraint(work, p, row):
    """Writes c_p, a row of C = [I; G]."""
    n = work.n
    if p >= n:
        for j in range(0, n, 8):
            store(row, j, load_some(work.G[p - n], j))
    else:
        for j in range(0, n, 8):
            store(row, j, zeros())
        row[p] = 1.0


@inline_njit
def compute_factor_row(work, k, p):
    """Writes L_K^-1 K_Wp, the row that p in slot k would add, to ``forward``."""
    forward = work.forward
    place = work.place
    if is_prepared(work):
        column = work.K[p]
        for i in range(k):
            forward[i] = column[place[i]]
    else:
        row = work.w[place[k]]
        multiply_rows(work.w, place, k, row, int(work.row_end[p]), forward)
    solve_lower(work.factor, k, forward)


@inline_njit
def distance_to_span(work, k):
    """Returns d = |w_p - sum r_i w_i|^2 for p in slot k and r = ``direction``.

    As a sum of squares it cannot cancel.
    """
    n = work.n
    difference = work.scratch
    scale(1.0, work.w[work.place[k]], difference, n)
    subtract_rows(difference, work.w, work.place, work.direction, k, n)
    return dot(difference, difference, n)


@inline_njit
def add_constraint(work, k, p, pivot):
    """Adds p, in slot k, to the working set; ``forward`` is its row of the factor.

    ``pivot = K_pp - |forward|^2 > 0``. Returns the size of the working set.
    """
    append_row(work.factor, k, work.forward, pivot)
    stop_watching(work, p)
    return k + 1


@inline_njit
def add_candidates(work, k, count):
    """Adds the first ``count`` candidates, but for those that depend on others.

    Returns the size of the working set.
    """
    for i in range(count):
        label = work.candidates[i]
        p = abs(label) - 1
        if is_watched(work, p) and k < work.n:
            write_slot(work, k, p, label > 0)
            compute_factor_row(work, k, p)
            pivot = work.diagonal[k] - dot(work.forward, work.forward, k)
            if pivot > _CANDIDATE_PIVOT * work.diagonal[k]:
                k = add_constraint(work, k, p, pivot)
    return k


@inline_njit
def restore_working_set(work, count, packed_factor):
    """Makes the candidates of a prepared program the working set.

    Their factor is known: ``packed_factor`` holds its rows one after the other.
    """
    start = 0
    for i in range(count):
        label = work.candidates[i]
        p = abs(label) - 1
        write_slot(work, i, p, label > 0)
        stop_watching(work, p)
        scale(1.0, packed_factor[start:], work.factor[i], i + 1)
        start += i + 1


@inline_njit
def drop_constraint(work, k, slot):
    """Drops the constraint in a slot; those behind it, up to slot k, go one slot down.

    Its entry of ``forward`` goes too. Its place in ``w`` becomes that of slot k.
    """
    delete_row(work.factor, k, slot, work.forward, work.cosines, work.sines)
    free_place = work.place[slot]
    for i in range(slot, k):
        work.label[i] = work.label[i + 1]
        work.place[i] = work.place[i + 1]
        work.bound[i] = work.bound[i + 1]
        work.free_value[i] = work.free_value[i + 1]
        work.least_multiplier[i] = work.least_multiplier[i + 1]
        work.most_multiplier[i] = work.most_multiplier[i + 1]
        work.diagonal[i] = work.diagonal[i + 1]
    work.place[k] = free_place
