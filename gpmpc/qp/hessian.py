"""Lazy mode's work with the factor of P (``gpmpc.qp.cholesky``): the rows w_p = L^-T c_p of constraints that enter."""

from gpmpc.compiled import woven
from gpmpc.qp.factor import dot, four_dots


@woven
def subtract(target, factor, row, size):
    """``target -= factor row``."""
    for j in range(size):
        target[j] -= factor * row[j]


@woven
def subtract_four(target, a, b, c, d, fa, fb, fc, fd, size):
    """``target -= fa a + fb b + fc c + fd d``."""
    for j in range(size):
        target[j] -= fa * a[j] + fb * b[j] + fc * c[j] + fd * d[j]


@woven
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


@woven
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


@woven
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


@woven
def make_row(p, n, L, G, ends, row):
    """``row = L^-T c_p``."""
    solve_transposed(L, write_constraint(p, n, G, ends, row), row)


@woven
def make_rows(names, count, n, L, G, ends, rows, places):
    """``rows[places[i]] = L^-T c_p`` for the constraints p with signed numbers ``names``."""
    for i in range(count):
        make_row(abs(names[i]) - 1, n, L, G, ends, rows[places[i]])
