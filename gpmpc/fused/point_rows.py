"""Problem: sums and products of vectors over the training points, at the speed of the vector registers.

A vector over the points is a row (``gpmpc.fused.packed``); three rows are taken together, so that each pass over
memory does three multiplications. Lengths are multiples of 8, numbers of rows multiples of 3.
"""

import numpy as np

from gpmpc.compiled import borrowing, compiled
from gpmpc.fused.exponential import EXACT, widest

LINE = 8  # doubles in a cache line


@compiled
def aligned(size):
    """Uninitialised doubles that start on a cache line."""
    memory = np.empty(size + LINE)
    skip = (-(memory.ctypes.data >> 3)) % LINE
    return memory[skip : skip + size]


@compiled
def aligned_rows(rows, length):
    """The same as a matrix."""
    return aligned(rows * length).reshape(rows, length)


@borrowing(fastmath=EXACT)
def combine(out, factors, rows):
    """Adds sum_d factors[d] rows[d] to ``out``."""
    widest()
    for d in range(0, len(rows), 3):
        row0, row1, row2 = rows[d], rows[d + 1], rows[d + 2]
        factor0, factor1, factor2 = factors[d], factors[d + 1], factors[d + 2]
        for j in range(len(out)):
            out[j] = out[j] + factor0 * row0[j] + factor1 * row1[j] + factor2 * row2[j]


@borrowing
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


@borrowing
def multiply(row, other, out):
    """Writes the elementwise product to ``out``."""
    widest()
    for j in range(len(out)):
        out[j] = row[j] * other[j]


@borrowing(fastmath=EXACT)
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


@borrowing
def second_moments(weights, rows, out, n, scratch):
    """Writes sum_i weights[i] rows[c, i] rows[d, i] to the symmetric out[c, d], c and d < n."""
    for c in range(n):
        multiply(weights, rows[c], scratch)
        project(scratch, rows[: c // 3 * 3 + 3], out[c])
    for c in range(n):
        for d in range(c):
            out[d, c] = out[c, d]


@borrowing(fastmath=EXACT)
def add_products(out, factors, rows, others, n):
    """Adds sum_d factors[d] rows[d] others[d] over n rows to ``out``."""
    widest()
    for d in range(n):
        factor, row, other = factors[d], rows[d], others[d]
        for j in range(len(out)):
            out[j] = out[j] + (factor * row[j]) * other[j]


@borrowing
def explain(triangle, q, solved):
    """Returns |L^-1 q|^2 and writes (K + sn2 I)^-1 q to ``solved``, in one pass over the block triangle of L^-1."""
    widest()
    solved[:] = 0.0
    total = 0.0
    for start in range(0, len(q), 4):
        length = start // 8 * 8 + 8
        at = start // 8 * 8 * length // 2 + start % 8 * length
        row0, row1 = triangle[at : at + length], triangle[at + length : at + 2 * length]
        row2, row3 = triangle[at + 2 * length : at + 3 * length], triangle[at + 3 * length : at + 4 * length]
        v0 = v1 = v2 = v3 = 0.0
        for j in range(length):
            v0 += row0[j] * q[j]
            v1 += row1[j] * q[j]
            v2 += row2[j] * q[j]
            v3 += row3[j] * q[j]
        total += v0 * v0 + v1 * v1 + v2 * v2 + v3 * v3
        for j in range(length):
            solved[j] = solved[j] + v0 * row0[j] + v1 * row1[j] + v2 * row2[j] + v3 * row3[j]
    return total


@borrowing
def explain_several(triangle, q, totals):
    """Adds |L^-1 q_h|^2 of the rows of q, a multiple of four of them, to ``totals``, in one pass over L^-1."""
    widest()
    for start in range(0, q.shape[1], 4):
        length = start // 8 * 8 + 8
        at = start // 8 * 8 * length // 2 + start % 8 * length
        row0, row1 = triangle[at : at + length], triangle[at + length : at + 2 * length]
        row2, row3 = triangle[at + 2 * length : at + 3 * length], triangle[at + 3 * length : at + 4 * length]
        for h in range(0, len(q), 4):
            q0, q1, q2, q3 = q[h], q[h + 1], q[h + 2], q[h + 3]
            a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = 0.0
            c0 = c1 = c2 = c3 = d0 = d1 = d2 = d3 = 0.0
            for j in range(length):
                r0, r1, r2, r3 = row0[j], row1[j], row2[j], row3[j]
                a0, a1, a2, a3 = a0 + r0 * q0[j], a1 + r1 * q0[j], a2 + r2 * q0[j], a3 + r3 * q0[j]
                b0, b1, b2, b3 = b0 + r0 * q1[j], b1 + r1 * q1[j], b2 + r2 * q1[j], b3 + r3 * q1[j]
                c0, c1, c2, c3 = c0 + r0 * q2[j], c1 + r1 * q2[j], c2 + r2 * q2[j], c3 + r3 * q2[j]
                d0, d1, d2, d3 = d0 + r0 * q3[j], d1 + r1 * q3[j], d2 + r2 * q3[j], d3 + r3 * q3[j]
            totals[h] += a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3
            totals[h + 1] += b0 * b0 + b1 * b1 + b2 * b2 + b3 * b3
            totals[h + 2] += c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3
            totals[h + 3] += d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3
