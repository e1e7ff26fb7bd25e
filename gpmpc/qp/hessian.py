"""Lazy mode's work with P: its Cholesky factor, and the rows w_p = L^-T c_p of the constraints that enter.

``P = L'L`` with L lower triangular, so that variables are eliminated from the last to the first: a constraint on the
first few variables only, as all are in predictive control where no state depends on later inputs, then has as short a
row. The diagonal of the array L holds reciprocals, its upper triangle is undefined.

Rows are subtracted from rows, up to eight at a time, so that the one that changes is read and written seldom.
"""

import math

from gpmpc.compiled import borrowing
from gpmpc.qp.factor import dot, four_dots


@borrowing
def factorise(P, L):
    """Fills L; False if P is not symmetric, finite and positive definite."""
    n = len(P)
    if not is_symmetric(P):
        return False
    for top in range((n - 1) // 4 * 4, -1, -4):
        end = min(top + 4, n)
        for i in range(top, end):
            source, target = P[i], L[i]
            for j in range(end):
                target[j] = source[j]
        s = top + 4
        while s + 8 <= n:
            for i in range(top, end):
                subtract_eight(L[i], L, s, i, end)
            s += 8
        while s + 4 <= n:
            a, b, c, d = L[s], L[s + 1], L[s + 2], L[s + 3]
            for i in range(top, end):
                subtract_four(L[i], a, b, c, d, a[i], b[i], c[i], d[i], end)
            s += 4
        while s < n:
            for i in range(top, end):
                subtract(L[i], L[s, i], L[s], end)
            s += 1
        for i in range(end - 1, top - 1, -1):
            row = L[i]
            pivot = row[i]
            if not (pivot > n * 2.3e-16 * P[i, i] and pivot < math.inf):
                return False
            reciprocal = 1.0 / math.sqrt(pivot)
            for j in range(i):
                row[j] *= reciprocal
            row[i] = reciprocal
            for j in range(top, i):
                subtract(L[j], row[j], row, j + 1)
    return True


@borrowing
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


@borrowing
def subtract(target, factor, row, size):
    """``target -= factor row``."""
    for j in range(size):
        target[j] -= factor * row[j]


@borrowing
def subtract_four(target, a, b, c, d, fa, fb, fc, fd, size):
    """``target -= fa a + fb b + fc c + fd d``."""
    for j in range(size):
        target[j] -= fa * a[j] + fb * b[j] + fc * c[j] + fd * d[j]


@borrowing
def subtract_eight(target, L, s, i, size):
    """``target -= sum_r L[r, i] L[r]`` for the eight rows from s on."""
    a, b, c, d, e, f, g, h = L[s], L[s + 1], L[s + 2], L[s + 3], L[s + 4], L[s + 5], L[s + 6], L[s + 7]
    fa, fb, fc, fd, fe, ff, fg, fh = a[i], b[i], c[i], d[i], e[i], f[i], g[i], h[i]
    for j in range(size):
        low = fa * a[j] + fb * b[j] + fc * c[j] + fd * d[j]
        target[j] -= low + (fe * e[j] + ff * f[j] + fg * g[j] + fh * h[j])


@borrowing
def solve_transposed(L, end, a):
    """``a <- L^-T a`` in place, where a is zero from ``end`` on."""
    j = end
    while j % 4:
        j -= 1
        a[j] *= L[j, j]
        subtract(a, a[j], L[j], j)
    while j > 0:
        j -= 4
        r0, r1, r2, r3 = L[j], L[j + 1], L[j + 2], L[j + 3]
        a3 = a[j + 3] * r3[j + 3]
        a2 = (a[j + 2] - a3 * r3[j + 2]) * r2[j + 2]
        a1 = (a[j + 1] - a3 * r3[j + 1] - a2 * r2[j + 1]) * r1[j + 1]
        a0 = (a[j] - a3 * r3[j] - a2 * r2[j] - a1 * r1[j]) * r0[j]
        a[j], a[j + 1], a[j + 2], a[j + 3] = a0, a1, a2, a3
        subtract_four(a, r0, r1, r2, r3, a0, a1, a2, a3, j)


@borrowing
def solve_lower(L, n, a):
    """``a <- L^-1 a`` in place."""
    i = 0
    while i + 4 <= n:
        r1, r2, r3 = L[i + 1], L[i + 2], L[i + 3]
        a0, a1, a2, a3 = a[i], a[i + 1], a[i + 2], a[i + 3]
        four_dots(L[i], r1, r2, r3, a, i, a[i:])
        a0 = (a0 - a[i]) * L[i, i]
        a1 = (a1 - a[i + 1] - r1[i] * a0) * r1[i + 1]
        a2 = (a2 - a[i + 2] - r2[i] * a0 - r2[i + 1] * a1) * r2[i + 2]
        a3 = (a3 - a[i + 3] - r3[i] * a0 - r3[i + 1] * a1 - r3[i + 2] * a2) * r3[i + 3]
        a[i], a[i + 1], a[i + 2], a[i + 3] = a0, a1, a2, a3
        i += 4
    while i < n:
        a[i] = (a[i] - dot(L[i], a, i)) * L[i, i]
        i += 1


@borrowing
def write_constraint(p, n, G, ends, row):
    """``row = c_p``, row p of C = [I; G]; returns the number of its leading entries that may not be zero."""
    if p >= n:
        c = G[p - n]
        for i in range(n):
            row[i] = c[i]
    else:
        for i in range(n):
            row[i] = 0.0
        row[p] = 1.0
    return int(ends[p])


@borrowing
def make_row(p, n, L, G, ends, row):
    """``row = L^-T c_p``."""
    solve_transposed(L, write_constraint(p, n, G, ends, row), row)


@borrowing
def make_rows(names, count, n, L, G, ends, rows, places):
    """``rows[places[i]] = L^-T c_p`` for the constraints p with signed numbers ``names``."""
    for i in range(count):
        make_row(abs(names[i]) - 1, n, L, G, ends, rows[places[i]])
