"""The Cholesky factor of P for lazy mode.

``P = L'L`` with L lower triangular, so that variables are eliminated from the last to the first: a constraint on the
first few variables only, as all are in predictive control where no state depends on later inputs, then has as short a
row L^-T c. The diagonal of the array L holds reciprocals, its upper triangle is undefined; its rows are padded to a
multiple of eight.

Four rows are finished at a time, in pieces that stay in registers until the rows below have been subtracted and the
four have been solved for each other. The four pivots wait for one division each; square roots are taken afterwards.
"""

import math

from gpmpc.compiled import woven
from gpmpc.qp.lanes import lanes, less, put, scaled

WIDTH, BLOCK = 8, 4
SMALLEST = 2.3e-16  # times n: share of P_ii below which a pivot is rounding


@woven
def factorise(P, L):
    """Fills L; False if P is not symmetric, finite and positive definite."""
    n = len(P)
    if not is_symmetric(P):
        return False
    whole = n // BLOCK * BLOCK
    if whole < n and not finish_last_rows(P, L, whole):
        return False
    good, top = True, whole - BLOCK
    while good and top >= 0:
        good = finish_four_rows(P, L, top)
        top -= BLOCK
    return good


@woven
def finish_last_rows(P, L, top):
    """The rows from ``top`` on, fewer than four."""
    n = len(P)
    for i in range(top, n):
        for j in range(i + 1):
            L[i, j] = P[i, j]
    for i in range(n - 1, top - 1, -1):
        row, pivot = L[i], L[i, i]
        if not is_pivot(pivot, P[i, i], n):
            return False
        reciprocal = 1.0 / math.sqrt(pivot)
        for j in range(i):
            row[j] *= reciprocal
        row[i] = reciprocal
        for k in range(top, i):
            factor, target = row[k], L[k]
            for j in range(k + 1):
                target[j] -= factor * row[j]
    return True


@woven
def is_pivot(pivot, diagonal, n):
    """Whether a pivot is positive, finite, and more than rounding."""
    return (pivot > n * SMALLEST * diagonal) & (pivot < math.inf)


@woven
def finish_four_rows(P, L, top):
    """Rows ``top`` to ``top + 3``, given those below."""
    n = len(P)
    t0, t1, t2, t3 = L[top], L[top + 1], L[top + 2], L[top + 3]
    p0, p1, p2, p3 = P[top], P[top + 1], P[top + 2], P[top + 3]
    j = top // WIDTH * WIDTH  # the piece with the diagonal comes first
    if j + WIDTH <= n:
        a0, a1, a2, a3 = lanes(p0, j), lanes(p1, j), lanes(p2, j), lanes(p3, j)
    else:
        for c in range(j, n):
            t0[c], t1[c], t2[c], t3[c] = p0[c], p1[c], p2[c], p3[c]
        a0, a1, a2, a3 = lanes(t0, j), lanes(t1, j), lanes(t2, j), lanes(t3, j)
    for s in range(top + BLOCK, n):
        row = L[s]
        x = lanes(row, j)
        a0, a1 = less(a0, row[top], x), less(a1, row[top + 1], x)
        a2, a3 = less(a2, row[top + 2], x), less(a3, row[top + 3], x)
    put(t0, j, a0)
    put(t1, j, a1)
    put(t2, j, a2)
    put(t3, j, a3)
    # the block of four by four: its pivots d, and what of which row to subtract from which
    d3 = t3[top + 3]
    r3 = 1.0 / d3
    m23, m13, m03 = t3[top + 2] * r3, t3[top + 1] * r3, t3[top] * r3
    d2 = t2[top + 2] - m23 * t3[top + 2]
    r2 = 1.0 / d2
    e21, e20 = t2[top + 1] - m23 * t3[top + 1], t2[top] - m23 * t3[top]
    m12, m02 = e21 * r2, e20 * r2
    d1 = t1[top + 1] - m13 * t3[top + 1] - m12 * e21
    r1 = 1.0 / d1
    e10 = t1[top] - m13 * t3[top] - m12 * e20
    m01 = e10 * r1
    d0 = t0[top] - m03 * t3[top] - m02 * e20 - m01 * e10
    good = is_pivot(d3, p3[top + 3], n) & is_pivot(d2, p2[top + 2], n)
    if not (good & is_pivot(d1, p1[top + 1], n) & is_pivot(d0, p0[top], n)):
        return False
    g3, g2, g1, g0 = math.sqrt(r3), math.sqrt(r2), math.sqrt(r1), 1.0 / math.sqrt(d0)
    a2 = less(a2, m23, a3)
    a1 = less(less(a1, m13, a3), m12, a2)
    a0 = less(less(less(a0, m03, a3), m02, a2), m01, a1)
    put(t0, j, scaled(g0, a0))
    put(t1, j, scaled(g1, a1))
    put(t2, j, scaled(g2, a2))
    put(t3, j, scaled(g3, a3))
    t0[top], t1[top + 1], t2[top + 2], t3[top + 3] = g0, g1, g2, g3
    j -= WIDTH
    while j >= WIDTH:  # sixteen columns at a time
        i = j - WIDTH
        a0, a1, a2, a3 = lanes(p0, j), lanes(p1, j), lanes(p2, j), lanes(p3, j)
        b0, b1, b2, b3 = lanes(p0, i), lanes(p1, i), lanes(p2, i), lanes(p3, i)
        for s in range(top + BLOCK, n):
            row = L[s]
            x, y = lanes(row, j), lanes(row, i)
            f0, f1, f2, f3 = row[top], row[top + 1], row[top + 2], row[top + 3]
            a0, a1, a2, a3 = less(a0, f0, x), less(a1, f1, x), less(a2, f2, x), less(a3, f3, x)
            b0, b1, b2, b3 = less(b0, f0, y), less(b1, f1, y), less(b2, f2, y), less(b3, f3, y)
        a2, b2 = less(a2, m23, a3), less(b2, m23, b3)
        a1, b1 = less(less(a1, m13, a3), m12, a2), less(less(b1, m13, b3), m12, b2)
        a0 = less(less(less(a0, m03, a3), m02, a2), m01, a1)
        b0 = less(less(less(b0, m03, b3), m02, b2), m01, b1)
        put(t0, j, scaled(g0, a0))
        put(t1, j, scaled(g1, a1))
        put(t2, j, scaled(g2, a2))
        put(t3, j, scaled(g3, a3))
        put(t0, i, scaled(g0, b0))
        put(t1, i, scaled(g1, b1))
        put(t2, i, scaled(g2, b2))
        put(t3, i, scaled(g3, b3))
        j -= 2 * WIDTH
    if j == 0:
        a0, a1, a2, a3 = lanes(p0, j), lanes(p1, j), lanes(p2, j), lanes(p3, j)
        for s in range(top + BLOCK, n):
            row = L[s]
            x = lanes(row, j)
            a0, a1 = less(a0, row[top], x), less(a1, row[top + 1], x)
            a2, a3 = less(a2, row[top + 2], x), less(a3, row[top + 3], x)
        a2 = less(a2, m23, a3)
        a1 = less(less(a1, m13, a3), m12, a2)
        a0 = less(less(less(a0, m03, a3), m02, a2), m01, a1)
        put(t0, j, scaled(g0, a0))
        put(t1, j, scaled(g1, a1))
        put(t2, j, scaled(g2, a2))
        put(t3, j, scaled(g3, a3))
    return True


@woven
def is_symmetric(P):
    """Whether P equals its transpose but for rounding; read in blocks that stay in the cache."""
    n = len(P)
    largest, squares, skewed = 0.0, 0.0, 0
    for i in range(n):
        largest = max(largest, abs(P[i, i]))
    allowed = 1e-10 * largest
    for left in range(0, n, 8):
        for i in range(left, min(left + 8, n)):
            for j in range(left, i):
                squares += (P[i, j] - P[j, i]) * (P[i, j] - P[j, i])
        for i in range(left + 8, n):
            for j in range(left, left + 8):
                squares += (P[i, j] - P[j, i]) * (P[i, j] - P[j, i])
    if squares <= allowed * allowed:  # enough, and quickly summed
        return True
    for i in range(n):
        for j in range(i):
            skewed += not abs(P[i, j] - P[j, i]) <= allowed
    return skewed == 0
