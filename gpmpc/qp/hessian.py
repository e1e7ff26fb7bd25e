"""Lazy mode's work with P: its Cholesky factor, and the rows w_p = L^-1 c_p of the constraints that enter.

``P = L L'``; the diagonal of the array L holds reciprocals, its upper triangle is undefined. Four rows are worked on
at a time: each entry of L that is read then serves four sums, which hide each other's latency.
"""

import math

import numpy as np

from gpmpc.compiled import borrowing
from gpmpc.qp.factor import dot


@borrowing
def factorise(P, L):
    """Fills L; False if P is not symmetric, finite and positive definite."""
    n = len(P)
    if not is_symmetric(P):
        return False
    for top in range(0, n, 4):
        end = min(top + 4, n)
        if end - top == 4:
            for j in range(top):
                L[top, j], L[top + 1, j], L[top + 2, j], L[top + 3, j] = (
                    P[top, j],
                    P[top + 1, j],
                    P[top + 2, j],
                    P[top + 3, j],
                )
            eliminate(L, 0, top, L[top], L[top + 1], L[top + 2], L[top + 3])
        done = top if end - top == 4 else 0
        for i in range(top, end):
            row = L[i]
            for j in range(done, i):
                row[j] = (P[i, j] - dot(row, L[j], j)) * L[j, j]
            pivot = P[i, i] - dot(row, row, i)
            if not (pivot > len(P) * 2.3e-16 * P[i, i] and pivot < np.inf):
                return False
            row[i] = 1.0 / math.sqrt(pivot)
    return True


@borrowing
def is_symmetric(P):
    """Whether P equals its transpose but for rounding; read in blocks that stay in the cache."""
    n = len(P)
    largest, skew = 0.0, 0.0
    for i in range(n):
        largest = max(largest, abs(P[i, i]))
    for left in range(0, n, 8):
        right = min(left + 8, n)
        for i in range(left, n):
            for j in range(left, min(right, i)):
                skew = max(skew, abs(P[i, j] - P[j, i]))
    return skew <= 1e-10 * largest


@borrowing
def eliminate(L, first, last, a, b, c, d):
    """Solves ``L w = .`` in place for four right-hand sides whose entries before ``first`` are zero, up to ``last``."""
    a, b, c, d = a[first:], b[first:], c[first:], d[first:]
    for j in range(last - first):
        row = L[first + j, first:]
        sa, sb, sc, sd = 0.0, 0.0, 0.0, 0.0
        for i in range(j):
            value = row[i]
            sa += a[i] * value
            sb += b[i] * value
            sc += c[i] * value
            sd += d[i] * value
        reciprocal = row[j]
        a[j], b[j] = (a[j] - sa) * reciprocal, (b[j] - sb) * reciprocal
        c[j], d[j] = (c[j] - sc) * reciprocal, (d[j] - sd) * reciprocal


@borrowing
def write_constraint(p, n, G, row):
    """``row = c_p``, row p of C = [I; G]; returns its first entry that is not zero for sure."""
    if p >= n:
        c = G[p - n]
        for i in range(n):
            row[i] = c[i]
        return 0
    for i in range(n):
        row[i] = 0.0
    row[p] = 1.0
    return p


@borrowing
def make_row(p, n, L, G, row):
    """``row = L^-1 c_p``."""
    first = write_constraint(p, n, G, row)
    for i in range(first, n):
        row[i] = (row[i] - dot(L[i, first:], row[first:], i - first)) * L[i, i]


@borrowing
def make_rows(names, count, n, L, G, rows, places):
    """``rows[places[i]] = L^-1 c_p`` for the constraints p with signed numbers ``names``."""
    i = 0
    while i + 4 <= count:
        a, b, c, d = rows[places[i]], rows[places[i + 1]], rows[places[i + 2]], rows[places[i + 3]]
        first = write_constraint(abs(names[i]) - 1, n, G, a)
        first = min(first, write_constraint(abs(names[i + 1]) - 1, n, G, b))
        first = min(first, write_constraint(abs(names[i + 2]) - 1, n, G, c))
        first = min(first, write_constraint(abs(names[i + 3]) - 1, n, G, d))
        eliminate(L, first, n, a, b, c, d)
        i += 4
    while i < count:
        make_row(abs(names[i]) - 1, n, L, G, rows[places[i]])
        i += 1


@borrowing
def solve_lower(L, n, a, solution):
    """``solution = L^-1 a``."""
    for i in range(n):
        solution[i] = (a[i] - dot(L[i], solution, i)) * L[i, i]


@borrowing
def solve_transposed(L, n, a):
    """``a <- L^-T a``."""
    for i in range(n - 1, -1, -1):
        row = L[i]
        value = a[i] * row[i]
        a[i] = value
        for j in range(i):
            a[j] -= value * row[j]
