"""The Cholesky factor of the working set's matrix, kept current while constraints enter and leave.

``R R' = K_WW`` with R lower triangular, stored row after row without the zeros: row i starts at i (i + 1) / 2. A constraint
that enters appends one row, found by the same forward solve that prices it; one that leaves deletes a row, and Givens
rotations restore the triangle (Golub and Van Loan, Matrix Computations, 4th ed., section 6.5.2). The diagonal holds
reciprocals, so that no solve divides.
"""

import math

from gpmpc.qp.compiled import compiled


@compiled
def dot(a, b, size):
    """Inner product of the first ``size`` entries."""
    total = 0.0
    for i in range(size):
        total += a[i] * b[i]
    return total


@compiled
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


@compiled
def multiply(A, first, last, vector, size, product):
    """``product[i] = A[i] . vector`` for the rows ``first`` to ``last``, four at a time."""
    i = first
    while i + 4 <= last:
        r0, r1, r2, r3 = A[i], A[i + 1], A[i + 2], A[i + 3]
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        for j in range(size):
            value = vector[j]
            s0 += r0[j] * value
            s1 += r1[j] * value
            s2 += r2[j] * value
            s3 += r3[j] * value
        product[i], product[i + 1], product[i + 2], product[i + 3] = s0, s1, s2, s3
        i += 4
    while i < last:
        product[i] = dot(A[i], vector, size)
        i += 1


@compiled
def forward_solve(R, k, a):
    """``a <- R^-1 a`` in place."""
    start = 0
    for i in range(k):
        row = R[start : start + i + 1]
        a[i] = (a[i] - dot(row, a, i)) * row[i]
        start += i + 1


@compiled
def backward_solve(R, k, a):
    """``a <- R^-T a`` in place."""
    start = k * (k + 1) // 2
    for i in range(k - 1, -1, -1):
        start -= i + 1
        row = R[start : start + i + 1]
        value = a[i] * row[i]
        a[i] = value
        for j in range(i):
            a[j] -= value * row[j]


@compiled
def append_row(R, k, solved, pivot):
    """Row k of the factor: ``solved = R^-1 K_Wp`` and ``pivot = K_pp - |solved|^2 > 0``."""
    row = R[k * (k + 1) // 2 : (k + 1) * (k + 2) // 2]
    for j in range(k):
        row[j] = solved[j]
    row[k] = 1.0 / math.sqrt(pivot)


@compiled
def remove_row(R, k, gone, cosines, sines):
    """Deletes row ``gone`` of a factor of k rows; ``cosines`` and ``sines`` are scratch of length k."""
    for i in range(gone + 1, k):
        old = R[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]
        new = R[(i - 1) * i // 2 : i * (i + 1) // 2]
        for j in range(gone):
            new[j] = old[j]
        carry = old[gone]
        for j in range(gone, i - 1):
            following = old[j + 1]
            new[j] = cosines[j] * carry + sines[j] * following
            carry = cosines[j] * following - sines[j] * carry
        diagonal = 1.0 / old[i]
        reciprocal = 1.0 / math.sqrt(carry * carry + diagonal * diagonal)
        cosines[i - 1], sines[i - 1] = carry * reciprocal, diagonal * reciprocal
        new[i - 1] = reciprocal
