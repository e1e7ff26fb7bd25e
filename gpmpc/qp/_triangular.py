"""Dense algebra of the dual active-set kernels.

Products, and triangular factors L with reciprocals on the diagonal.

A factor is lower triangular and stored by rows, so that one pair of solves serves both
P = L'L and K_WW = L L'. Loops take four rows at a time: their sums hide each other's
latency. The plain loops are those of the same names in ``gpmpc/export/qp.c``. Nothing
is allocated and nothing is checked. What takes few arrays is called, not inlined: a
solve is then compiled in two thirds of the time and is a seventh faster.
"""

import math

from gpmpc._compiled import inline_njit, njit_noalloc
from gpmpc._kernels._simd import load, load_some, store, total, zeros
from gpmpc._kernels.linalg import dot, four_dots

_LANES = 8
_BLOCK = 4
_ROUNDING = 2.3e-16  # times n: share of P_ii below which a pivot is rounding
_SKEW = 1e-10  # largest |P_ij - P_ji| accepted, as a share of sqrt(P_ii P_jj)


@inline_njit
def scale(multiple, x, y, size):
    """Writes ``y = multiple x``; both are padded, and whole registers are written."""
    for i in range(0, size, _LANES):
        store(y, i, multiple * load(x, i))


@njit_noalloc
def multiply_to_ends(A, ends, vector, product):
    """Writes ``product = A vector``; only ``ends`` leading entries of rows count.

    The entries behind them are zero.
    """
    i = 0
    while i + 4 <= len(A):
        size = int(max(max(ends[i], ends[i + 1]), max(ends[i + 2], ends[i + 3])))
        four_dots((A[i], A[i + 1], A[i + 2], A[i + 3]), vector, size, product[i:])
        i += 4
    while i < len(A):
        product[i] = dot(A[i], vector, int(ends[i]))
        i += 1


@inline_njit
def _four_rows(A, places, i):
    """Returns the rows of A at places i to i + 3."""
    return A[places[i]], A[places[i + 1]], A[places[i + 2]], A[places[i + 3]]


@njit_noalloc
def multiply_rows(A, places, count, vector, size, product):
    """Writes ``product[i] = A[places[i]] . vector``."""
    i = 0
    while i + 4 <= count:
        four_dots(_four_rows(A, places, i), vector, size, product[i:])
        i += 4
    while i < count:
        product[i] = dot(A[places[i]], vector, size)
        i += 1


@njit_noalloc
def subtract_rows(target, rows, places, weights, count, size):
    """Writes ``target -= sum_i weights[i] rows[places[i]]``."""
    i = 0
    while i + 4 <= count:
        r0, r1, r2, r3 = _four_rows(rows, places, i)
        f0 = weights[i]
        f1 = weights[i + 1]
        f2 = weights[i + 2]
        f3 = weights[i + 3]
        for j in range(size):
            target[j] -= f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j]
        i += 4
    while i < count:
        row = rows[places[i]]
        f = weights[i]
        for j in range(size):
            target[j] -= f * row[j]
        i += 1


@njit_noalloc
def solve_lower(L, k, a):
    """Writes ``a <- L^-1 a``."""
    i = 0
    while i + 4 <= k:
        r0 = L[i]
        r1 = L[i + 1]
        r2 = L[i + 2]
        r3 = L[i + 3]
        s0 = s1 = s2 = s3 = zeros()
        whole = i // _LANES * _LANES
        for j in range(0, whole, _LANES):
            x = load(a, j)
            s0 = s0 + load(r0, j) * x
            s1 = s1 + load(r1, j) * x
            s2 = s2 + load(r2, j) * x
            s3 = s3 + load(r3, j) * x
        a0 = a[i] - total(s0)
        a1 = a[i + 1] - total(s1)
        a2 = a[i + 2] - total(s2)
        a3 = a[i + 3] - total(s3)
        if whole < i:
            x0 = a[whole]
            x1 = a[whole + 1]
            x2 = a[whole + 2]
            x3 = a[whole + 3]
            a0 -= (
                r0[whole] * x0
                + r0[whole + 1] * x1
                + r0[whole + 2] * x2
                + r0[whole + 3] * x3
            )
            a1 -= (
                r1[whole] * x0
                + r1[whole + 1] * x1
                + r1[whole + 2] * x2
                + r1[whole + 3] * x3
            )
            a2 -= (
                r2[whole] * x0
                + r2[whole + 1] * x1
                + r2[whole + 2] * x2
                + r2[whole + 3] * x3
            )
            a3 -= (
                r3[whole] * x0
                + r3[whole + 1] * x1
                + r3[whole + 2] * x2
                + r3[whole + 3] * x3
            )
        a0 = a0 * r0[i]
        a1 = (a1 - r1[i] * a0) * r1[i + 1]
        a2 = (a2 - r2[i] * a0 - r2[i + 1] * a1) * r2[i + 2]
        a3 = (a3 - r3[i] * a0 - r3[i + 1] * a1 - r3[i + 2] * a2) * r3[i + 3]
        a[i] = a0
        a[i + 1] = a1
        a[i + 2] = a2
        a[i + 3] = a3
        i += 4
    while i < k:
        a[i] = (a[i] - dot(L[i], a, i)) * L[i, i]
        i += 1


@njit_noalloc
def solve_transposed(L, end, a):
    """Writes ``a <- L^-T a`` for a vector that is zero from ``end`` on."""
    j = end
    while j % 4:
        j -= 1
        row = L[j]
        f = a[j] * L[j, j]
        a[j] = f
        for i in range(j):
            a[i] -= f * row[i]
    while j > 0:
        j -= 4
        r0 = L[j]
        r1 = L[j + 1]
        r2 = L[j + 2]
        r3 = L[j + 3]
        a3 = a[j + 3] * r3[j + 3]
        a2 = (a[j + 2] - a3 * r3[j + 2]) * r2[j + 2]
        a1 = (a[j + 1] - a3 * r3[j + 1] - a2 * r2[j + 1]) * r1[j + 1]
        a0 = (a[j] - a3 * r3[j] - a2 * r2[j] - a1 * r1[j]) * r0[j]
        a[j] = a0
        a[j + 1] = a1
        a[j + 2] = a2
        a[j + 3] = a3
        for i in range(j):
            a[i] -= a0 * r0[i] + a1 * r1[i] + a2 * r2[i] + a3 * r3[i]


@inline_njit
def append_row(L, k, solved, pivot):
    """Writes row k of ``L L' = K_WW``.

    With ``solved = L^-1 K_Wp`` and ``pivot = K_pp - |solved|^2 > 0``.
    """
    row = L[k]
    scale(1.0, solved, row, k)
    row[k] = 1.0 / math.sqrt(pivot)


@njit_noalloc
def delete_row(L, k, gone, solved, cosines, sines):
    """Deletes row ``gone`` of L, which has k rows.

    And entry ``gone`` of a in ``solved = L^-1 a``.

    Givens rotations restore the triangle (Golub and Van Loan, Matrix Computations, 4th
    ed., section 6.5.2); ``cosines`` and ``sines`` (k,) are scratch.
    """
    rotated_entry = solved[gone]
    for i in range(gone + 1, k):
        row = L[i]
        above = L[i - 1]
        rotated_column = L[i, gone]
        below = solved[i]
        for j in range(gone):
            above[j] = row[j]
        for j in range(gone + 1, i):
            entry = row[j]
            above[j - 1], rotated_column = (
                cosines[j] * rotated_column + sines[j] * entry,
                cosines[j] * entry - sines[j] * rotated_column,
            )
        diagonal = 1.0 / row[i]
        reciprocal = 1.0 / math.sqrt(
            rotated_column * rotated_column + diagonal * diagonal
        )
        cosines[i] = rotated_column * reciprocal
        sines[i] = diagonal * reciprocal
        above[i - 1] = reciprocal
        solved[i - 1], rotated_entry = (
            cosines[i] * rotated_entry + sines[i] * below,
            cosines[i] * below - sines[i] * rotated_entry,
        )


@njit_noalloc
def factorise(P, L):
    """Writes L of ``P = L'L``.

    Returns False unless P is symmetric, finite and positive definite.

    Variables are eliminated from the last to the first: a constraint on the first few
    variables only, as all are in predictive control where no state depends on later
    inputs, then has as short a row L^-T c. Rows of L are padded to a multiple of eight;
    its upper triangle is undefined.
    """
    n = len(P)
    roots = L[n - 1]  # of P_ii, until the factor is written there
    skewed = 0
    for i in range(n):
        roots[i] = math.sqrt(abs(P[i, i]))
    for i in range(n):
        for j in range(i):
            skewed += not abs(P[i, j] - P[j, i]) <= _SKEW * roots[i] * roots[j]
    top = n // _BLOCK * _BLOCK
    good = skewed == 0 and _finish_last_rows(P, L, top)
    while good and top > 0:
        top -= _BLOCK
        good = _finish_four_rows(P, L, top)
    return good


@inline_njit
def _is_pivot(pivot, diagonal, n):
    """Returns whether a pivot is positive, finite, and more than rounding."""
    return (pivot > n * _ROUNDING * diagonal) & (pivot < math.inf)


@inline_njit
def _finish_last_rows(P, L, top):
    """Writes the rows from ``top`` on, fewer than four.

    Returns False where a pivot is no positive number.
    """
    n = len(P)
    for i in range(top, n):
        for j in range(0, n, _LANES):
            store(L[i], j, load_some(P[i], j))
    for i in range(n - 1, top - 1, -1):
        row = L[i]
        pivot = L[i, i]
        if not _is_pivot(pivot, P[i, i], n):
            return False
        reciprocal = 1.0 / math.sqrt(pivot)
        for j in range(0, i, _LANES):
            store(row, j, load(row, j) * reciprocal)
        row[i] = reciprocal
        for k in range(top, i):
            target = L[k]
            multiple = row[k]
            for j in range(0, k + 1, _LANES):
                store(target, j, load(target, j) - multiple * load(row, j))
    return True


@inline_njit
def _finish_four_rows(P, L, top):
    """Writes rows ``top`` to ``top + 3``, given those below.

    Returns False where a pivot is no positive number.
    """
    n = len(P)
    end = top + _BLOCK
    p0 = P[top]
    p1 = P[top + 1]
    p2 = P[top + 2]
    p3 = P[top + 3]
    t0 = L[top]
    t1 = L[top + 1]
    t2 = L[top + 2]
    t3 = L[top + 3]
    # P less what the rows of L below take off: registers hold all of it
    for j in range(0, end, _LANES):
        a0 = load_some(p0, j)
        a1 = load_some(p1, j)
        a2 = load_some(p2, j)
        a3 = load_some(p3, j)
        for s in range(end, n):
            row = L[s]
            x = load(row, j)
            a0 = a0 - row[top] * x
            a1 = a1 - row[top + 1] * x
            a2 = a2 - row[top + 2] * x
            a3 = a3 - row[top + 3] * x
        store(t0, j, a0)
        store(t1, j, a1)
        store(t2, j, a2)
        store(t3, j, a3)
    # the block of four by four: its pivots d, and what of which row to subtract from
    # which
    d3 = t3[top + 3]
    r3 = 1.0 / d3
    m23 = t3[top + 2] * r3
    m13 = t3[top + 1] * r3
    m03 = t3[top] * r3
    d2 = t2[top + 2] - m23 * t3[top + 2]
    r2 = 1.0 / d2
    e21 = t2[top + 1] - m23 * t3[top + 1]
    e20 = t2[top] - m23 * t3[top]
    m12 = e21 * r2
    m02 = e20 * r2
    d1 = t1[top + 1] - m13 * t3[top + 1] - m12 * e21
    r1 = 1.0 / d1
    e10 = t1[top] - m13 * t3[top] - m12 * e20
    m01 = e10 * r1
    d0 = t0[top] - m03 * t3[top] - m02 * e20 - m01 * e10
    good = _is_pivot(d3, p3[top + 3], n) & _is_pivot(d2, p2[top + 2], n)
    if not (good & _is_pivot(d1, p1[top + 1], n) & _is_pivot(d0, p0[top], n)):
        return False
    g3 = math.sqrt(r3)
    g2 = math.sqrt(r2)
    g1 = math.sqrt(r1)
    g0 = 1.0 / math.sqrt(d0)
    for j in range(0, end, _LANES):
        a3 = load(t3, j)
        a2 = load(t2, j) - m23 * a3
        a1 = load(t1, j) - m13 * a3 - m12 * a2
        a0 = load(t0, j) - m03 * a3 - m02 * a2 - m01 * a1
        store(t0, j, g0 * a0)
        store(t1, j, g1 * a1)
        store(t2, j, g2 * a2)
        store(t3, j, g3 * a3)
    t0[top] = g0
    t1[top + 1] = g1
    t2[top + 2] = g2
    t3[top + 3] = g3
    return True
