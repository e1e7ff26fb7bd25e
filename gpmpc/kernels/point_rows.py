"""Problem: sums and products of vectors over the training points, at the speed of the vector registers.

A vector over the points is a row (``gpmpc.kernels.packed``); three rows are taken together, so that each pass over
memory does three multiplications. Lengths are multiples of 8, numbers of rows multiples of 3.
"""

import numpy as np

from gpmpc.compiled import njit_inner, njit_noalloc
from gpmpc.kernels.exponential import EXACT, bits_of, float_of, widest

LINE = 8  # doubles in a cache line


@njit_inner
def aligned(size):
    """Uninitialised doubles that start on a cache line."""
    memory = np.empty(size + LINE)
    skip = (-(memory.ctypes.data >> 3)) % LINE
    return memory[skip : skip + size]


@njit_inner
def aligned_rows(rows, length):
    """The same as a matrix."""
    return aligned(rows * length).reshape(rows, length)


@njit_noalloc(fastmath=EXACT)
def combine(out, factors, rows):
    """Adds sum_d factors[d] rows[d] to ``out``."""
    widest()
    for d in range(0, len(rows), 3):
        row0, row1, row2 = rows[d], rows[d + 1], rows[d + 2]
        factor0, factor1, factor2 = factors[d], factors[d + 1], factors[d + 2]
        for j in range(len(out)):
            out[j] = out[j] + factor0 * row0[j] + factor1 * row1[j] + factor2 * row2[j]


@njit_noalloc
def project(row, rows, out):
    """Writes row . rows[d] to out[d]."""
    widest()
    for d in range(0, len(rows), 3):
        row0, row1, row2 = rows[d], rows[d + 1], rows[d + 2]
        sum0 = sum1 = sum2 = 0.0
        for j in range(len(row)):
            sum0 += row[j] * row0[j]
            sum1 += row[j] * row1[j]
            sum2 += row[j] * row2[j]
        out[d], out[d + 1], out[d + 2] = sum0, sum1, sum2


@njit_noalloc
def summed(row):
    """The sum of a row: numba's own adds one number after the other."""
    widest()
    result = 0.0
    for j in range(len(row)):
        result += row[j]
    return result


@njit_noalloc
def largest(row):
    """The largest magnitude; NaN is the largest of all. Compared as integers, which LLVM turns into full vectors."""
    widest()
    most = 0
    for j in range(len(row)):
        most = max(most, bits_of(row[j]) & 0x7FFFFFFFFFFFFFFF)
    return float_of(most)


@njit_noalloc
def squared_lengths(rows, out):
    """Writes sum_d rows[d]^2."""
    widest()
    for d in range(0, len(rows), 3):
        row0, row1, row2 = rows[d], rows[d + 1], rows[d + 2]
        for j in range(len(out)):
            before = out[j] if d > 0 else 0.0
            out[j] = before + row0[j] * row0[j] + row1[j] * row1[j] + row2[j] * row2[j]


@njit_noalloc
def multiply(row, other, out):
    """Writes the elementwise product to ``out``."""
    widest()
    for j in range(len(out)):
        out[j] = row[j] * other[j]


@njit_noalloc(fastmath=EXACT)
def transform(matrix, rows, out, n):
    """Writes matrix @ rows, of n rows, to the first rows of ``out``."""
    widest()
    for c in range(n):
        target, factors = out[c], matrix[c]
        row0, row1, row2 = rows[0], rows[1], rows[2]
        factor0, factor1, factor2 = factors[0], factors[1], factors[2]
        for j in range(len(target)):
            target[j] = factor0 * row0[j] + factor1 * row1[j] + factor2 * row2[j]
        combine(target, factors[3:], rows[3:])


@njit_noalloc
def second_moments(weights, rows, out, n, scratch):
    """Writes sum_i weights[i] rows[c, i] rows[d, i] to the symmetric out[c, d], c and d < n."""
    for c in range(n):
        multiply(weights, rows[c], scratch)
        project(scratch, rows[: c // 3 * 3 + 3], out[c])
    for c in range(n):
        for d in range(c):
            out[d, c] = out[c, d]


@njit_noalloc(fastmath=EXACT)
def add_products(out, factors, rows, others, n):
    """Adds sum_d factors[d] rows[d] others[d] over n rows to ``out``."""
    widest()
    for d in range(n):
        factor, row, other = factors[d], rows[d], others[d]
        for j in range(len(out)):
            out[j] = out[j] + (factor * row[j]) * other[j]


@njit_noalloc
def explain(triangle, q, solved):
    """Returns |L^-1 q|^2 and writes (K + sn2 I)^-1 q to ``solved``, in one pass over the block triangle of L^-1."""
    solved[:] = 0.0
    total, at = 0.0, 0
    for row in range(0, len(q), 4):
        length = row // 8 * 8 + 8
        total += explain_four(triangle, at, length, q, solved)
        at += 4 * length
    return total


@njit_noalloc
def explain_four(triangle, at, length, q, solved):
    """The part of four rows of L^-1, which start at ``at``: returns theirs of the square, adds theirs to ``solved``."""
    widest()
    row0, row1 = triangle[at : at + length], triangle[at + length : at + 2 * length]
    row2, row3 = triangle[at + 2 * length : at + 3 * length], triangle[at + 3 * length : at + 4 * length]
    v0 = v1 = v2 = v3 = 0.0
    for j in range(length):
        v0 += row0[j] * q[j]
        v1 += row1[j] * q[j]
        v2 += row2[j] * q[j]
        v3 += row3[j] * q[j]
    for j in range(length):
        solved[j] = solved[j] + v0 * row0[j] + v1 * row1[j] + v2 * row2[j] + v3 * row3[j]
    return v0 * v0 + v1 * v1 + v2 * v2 + v3 * v3


@njit_noalloc
def explain_several(columns, q, totals):
    """Adds |L^-1 q_h|^2 of the rows of q, a multiple of four of them, to ``totals``; q is overwritten.

    Forward substitution that reads L, of which ``columns[j]`` is column j, once and four columns at a time.
    """
    widest()
    size, j = len(columns), 0
    while j + 4 <= size:
        c0, c1, c2, c3 = columns[j], columns[j + 1], columns[j + 2], columns[j + 3]
        at = max(0, size - (size - j - 4 + 7) // 8 * 8)  # whole registers; what comes before j + 4 is done with
        d0, d1, d2, d3 = c0[at:], c1[at:], c2[at:], c3[at:]
        for h in range(0, len(q), 4):
            r0, r1, r2, r3 = q[h, at:size], q[h + 1, at:size], q[h + 2, at:size], q[h + 3, at:size]
            e0, e1, e2, e3 = solve_four(c0, c1, c2, c3, j, q[h])
            f0, f1, f2, f3 = solve_four(c0, c1, c2, c3, j, q[h + 1])
            g0, g1, g2, g3 = solve_four(c0, c1, c2, c3, j, q[h + 2])
            h0, h1, h2, h3 = solve_four(c0, c1, c2, c3, j, q[h + 3])
            totals[h] += e0 * e0 + e1 * e1 + e2 * e2 + e3 * e3
            totals[h + 1] += f0 * f0 + f1 * f1 + f2 * f2 + f3 * f3
            totals[h + 2] += g0 * g0 + g1 * g1 + g2 * g2 + g3 * g3
            totals[h + 3] += h0 * h0 + h1 * h1 + h2 * h2 + h3 * h3
            for i in range(len(r0)):
                x0, x1, x2, x3 = d0[i], d1[i], d2[i], d3[i]
                r0[i] -= e0 * x0 + e1 * x1 + e2 * x2 + e3 * x3
                r1[i] -= f0 * x0 + f1 * x1 + f2 * x2 + f3 * x3
                r2[i] -= g0 * x0 + g1 * x1 + g2 * x2 + g3 * x3
                r3[i] -= h0 * x0 + h1 * x1 + h2 * x2 + h3 * x3
        j += 4
    while j < size:
        column = columns[j]
        for h in range(len(q)):
            row, value = q[h], q[h, j] / column[j]
            totals[h] += value * value
            for i in range(j + 1, size):
                row[i] -= value * column[i]
        j += 1


@njit_noalloc
def solve_four(c0, c1, c2, c3, j, row):
    """Entries j to j + 3 of L^-1 q, where what the columns before have to say is in ``row`` already."""
    v0 = row[j] / c0[j]
    v1 = (row[j + 1] - v0 * c0[j + 1]) / c1[j + 1]
    v2 = (row[j + 2] - v0 * c0[j + 2] - v1 * c1[j + 2]) / c2[j + 2]
    v3 = (row[j + 3] - v0 * c0[j + 3] - v1 * c1[j + 3] - v2 * c2[j + 3]) / c3[j + 3]
    return v0, v1, v2, v3
