"""The Cholesky factor of the working set's matrix, kept current while constraints enter and leave.

``L L' = K_WW`` with L lower triangular. Row j of the array R holds column j of L, from its diagonal on: R[j, i] =
L_ij, i >= j. A constraint that enters appends one row to L, found by the same forward solve that prices it; one that
leaves deletes a row, and Givens rotations restore the triangle (Golub and Van Loan, Matrix Computations, 4th ed.,
section 6.5.2). The diagonal holds reciprocals, so that no solve divides.
"""

import math

from gpmpc.compiled import woven


@woven
def dot(a, b, size):
    """Inner product of the first ``size`` entries."""
    total = 0.0
    for i in range(size):
        total += a[i] * b[i]
    return total


@woven
def subtract_rows(state, rows, places, factors, count, size):
    """``state -= sum_i factors[i] rows[places[i]]``, four rows at a time."""
    i = 0
    while i + 4 <= count:
        r0, r1, r2, r3 = rows[places[i]], rows[places[i + 1]], rows[places[i + 2]], rows[places[i + 3]]
        f0, f1, f2, f3 = factors[i], factors[i + 1], factors[i + 2], factors[i + 3]
        for j in range(size):
            state[j] -= f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j]
        i += 4
    while i < count:
        row, f = rows[places[i]], factors[i]
        for j in range(size):
            state[j] -= f * row[j]
        i += 1


@woven
def multiply(A, count, vector, size, product):
    """``product[i] = A[i] . vector`` for the first ``count`` rows, four at a time."""
    i = 0
    while i + 4 <= count:
        four_dots(A[i], A[i + 1], A[i + 2], A[i + 3], vector, size, product[i:])
        i += 4
    while i < count:
        product[i] = dot(A[i], vector, size)
        i += 1


@woven
def multiply_at(A, places, count, vector, size, product):
    """``product[i] = A[places[i]] . vector``, four at a time."""
    i = 0
    while i + 4 <= count:
        r0, r1, r2, r3 = A[places[i]], A[places[i + 1]], A[places[i + 2]], A[places[i + 3]]
        four_dots(r0, r1, r2, r3, vector, size, product[i:])
        i += 4
    while i < count:
        product[i] = dot(A[places[i]], vector, size)
        i += 1


@woven
def four_dots(r0, r1, r2, r3, vector, size, product):
    """Four inner products with one vector, which is read once and whose sums hide each other's latency."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for j in range(size):
        value = vector[j]
        s0 += r0[j] * value
        s1 += r1[j] * value
        s2 += r2[j] * value
        s3 += r3[j] * value
    product[0], product[1], product[2], product[3] = s0, s1, s2, s3


@woven
def forward_solve(R, k, a):
    """``a <- L^-1 a`` in place, four columns at a time."""
    j = 0
    while j + 4 <= k:
        r0, r1, r2, r3 = R[j, j:k], R[j + 1, j:k], R[j + 2, j:k], R[j + 3, j:k]
        rest = a[j:k]
        f0 = rest[0] * r0[0]
        f1 = (rest[1] - f0 * r0[1]) * r1[1]
        f2 = (rest[2] - f0 * r0[2] - f1 * r1[2]) * r2[2]
        f3 = (rest[3] - f0 * r0[3] - f1 * r1[3] - f2 * r2[3]) * r3[3]
        rest[0], rest[1], rest[2], rest[3] = f0, f1, f2, f3
        rest, r0, r1, r2, r3 = rest[4:], r0[4:], r1[4:], r2[4:], r3[4:]
        for i in range(len(rest)):
            rest[i] -= f0 * r0[i] + f1 * r1[i] + f2 * r2[i] + f3 * r3[i]
        j += 4
    while j < k:
        value = a[j] * R[j, j]
        a[j] = value
        for i in range(j + 1, k):
            a[i] -= value * R[j, i]
        j += 1


@woven
def backward_solve(R, k, a):
    """``a <- L^-T a`` in place, four columns at a time."""
    j = k
    while j % 4:
        j -= 1
        a[j] = (a[j] - dot(R[j, j + 1 :], a[j + 1 :], k - j - 1)) * R[j, j]
    while j > 0:
        j -= 4
        r0, r1, r2, r3 = R[j, j:k], R[j + 1, j:k], R[j + 2, j:k], R[j + 3, j:k]
        rest = a[j:k]
        s0, s1, s2, s3 = rest[0], rest[1], rest[2], rest[3]
        four_dots(r0[4:], r1[4:], r2[4:], r3[4:], rest[4:], len(rest) - 4, rest)
        f3 = (s3 - rest[3]) * r3[3]
        f2 = (s2 - rest[2] - r2[3] * f3) * r2[2]
        f1 = (s1 - rest[1] - r1[2] * f2 - r1[3] * f3) * r1[1]
        f0 = (s0 - rest[0] - r0[1] * f1 - r0[2] * f2 - r0[3] * f3) * r0[0]
        rest[0], rest[1], rest[2], rest[3] = f0, f1, f2, f3


@woven
def append_row(R, k, solved, pivot):
    """Row k of L: ``solved = L^-1 K_Wp`` and ``pivot = K_pp - |solved|^2 > 0``."""
    for j in range(k):
        R[j, k] = solved[j]
    R[k, k] = 1.0 / math.sqrt(pivot)


@woven
def remove_row(R, k, gone, carry, solved):
    """Deletes row ``gone`` of L, which has k rows, and solves ``solved = L^-1 a`` for a without entry ``gone``.

    ``carry`` is scratch of length k.
    """
    left = solved[gone]
    for j in range(gone):
        column = R[j, gone:k]
        for i in range(len(column) - 1):
            column[i] = column[i + 1]
    rest = carry[: k - gone - 1]
    column = R[gone, gone + 1 : k]
    for i in range(len(rest)):
        rest[i] = column[i]
    for c in range(gone + 1, k):
        diagonal = 1.0 / R[c, c]
        reciprocal = 1.0 / math.sqrt(rest[0] * rest[0] + diagonal * diagonal)
        cosine, sine = rest[0] * reciprocal, diagonal * reciprocal
        R[c - 1, c - 1] = reciprocal
        below = solved[c]
        solved[c - 1], left = cosine * left + sine * below, cosine * below - sine * left
        old, new = R[c, c + 1 : k], R[c - 1, c : k - 1]
        for i in range(len(old)):
            following, below = rest[i + 1], old[i]
            new[i] = cosine * following + sine * below
            rest[i] = cosine * below - sine * following
        rest = rest[: len(old)]


@woven
def pack(R, k, packed):
    """Copies the triangle of k rows to a flat array of k (k + 1) / 2 entries."""
    at = 0
    for j in range(k):
        column = R[j, j:k]
        for i in range(len(column)):
            packed[at + i] = column[i]
        at += len(column)


@woven
def unpack(packed, k, R):
    """The inverse of ``pack``."""
    at = 0
    for j in range(k):
        column = R[j, j:k]
        for i in range(len(column)):
            column[i] = packed[at + i]
        at += len(column)
