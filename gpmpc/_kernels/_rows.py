"""Sums and products of vectors over the training points.

They are rows of P numbers, P a multiple of 16. Loops that add up several rows at once
do so for the latency of an addition: four sums in turns hide it.
"""

from gpmpc._compiled import inline_njit, njit_noalloc
from gpmpc._kernels._simd import (
    larger_magnitude,
    largest,
    load,
    store,
    use_widest_registers,
    zeros,
)
from gpmpc._kernels.linalg import dot


@inline_njit
def multiply_entries(x, y, out):
    """Writes x y, entry by entry."""
    for j in range(len(out)):
        out[j] = x[j] * y[j]


@inline_njit
def row_sum(row):
    """Returns the sum of a row; numba's own adds one number after the other."""
    total = 0.0
    for j in range(len(row)):
        total += row[j]
    return total


@njit_noalloc
def project(row, rows, out):
    """Writes row . rows[d] to out[d], three at a time."""
    use_widest_registers()
    whole = len(rows) // 3 * 3
    for d in range(0, whole, 3):
        row0 = rows[d]
        row1 = rows[d + 1]
        row2 = rows[d + 2]
        sum0 = sum1 = sum2 = 0.0
        for j in range(len(row)):
            sum0 += row[j] * row0[j]
            sum1 += row[j] * row1[j]
            sum2 += row[j] * row2[j]
        out[d] = sum0
        out[d + 1] = sum1
        out[d + 2] = sum2
    for d in range(whole, len(rows)):
        out[d] = dot(row, rows[d], len(row))


@njit_noalloc
def second_moments(weights, rows, scratch, out):
    """Writes sum_i weights[i] rows[c, i] rows[d, i] to the symmetric out[c, d]."""
    use_widest_registers()
    for c in range(len(rows)):
        multiply_entries(weights, rows[c], scratch)
        for d in range(c + 1):
            out[c, d] = out[d, c] = dot(scratch, rows[d], len(scratch))


@njit_noalloc
def transform(matrix, rows, out):
    """Writes matrix @ rows."""
    use_widest_registers()
    for j in range(0, rows.shape[1], 8):
        for c in range(len(matrix)):
            total = matrix[c, 0] * load(rows[0], j)
            for d in range(1, len(rows)):
                total = total + matrix[c, d] * load(rows[d], j)
            store(out[c], j, total)


@njit_noalloc
def add_products(factors, rows, others, out):
    """Adds sum_d factors[d] rows[d] others[d]."""
    use_widest_registers()
    for j in range(0, len(out), 8):
        total = load(out, j)
        for d in range(len(rows)):
            total = total + factors[d] * (load(rows[d], j) * load(others[d], j))
        store(out, j, total)


@njit_noalloc
def largest_square(rows):
    """Returns the largest squared length of a column; NaN is passed over."""
    use_widest_registers()
    most = zeros()
    for j in range(0, rows.shape[1], 8):
        square = zeros()
        for d in range(len(rows)):
            x = load(rows[d], j)
            square = square + x * x
        most = larger_magnitude(most, square)
    return largest(most)


@njit_noalloc
def largest_size(row):
    """Returns the largest magnitude; NaN is passed over."""
    use_widest_registers()
    most = zeros()
    for j in range(0, len(row), 8):
        most = larger_magnitude(most, load(row, j))
    return largest(most)


@njit_noalloc
def variance_reduction_by_inverse(triangle, q, solution):
    """Returns |L^-1 q|^2 and writes (K + sn2 I)^-1 q to ``solution``.

    It takes one pass over ``triangle``, L^-1 as ``VarianceFactors.inverse_cholesky``:
    four entries of v = L^-1 q at a time, times their rows, add up to L^-T v.
    """
    use_widest_registers()
    solution[:] = 0.0
    total = 0.0
    start = 0
    for i in range(0, len(q), 4):
        length = i // 8 * 8 + 8
        row0 = triangle[start : start + length]
        row1 = triangle[start + length : start + 2 * length]
        row2 = triangle[start + 2 * length : start + 3 * length]
        row3 = triangle[start + 3 * length : start + 4 * length]
        v0 = v1 = v2 = v3 = 0.0
        for j in range(length):
            v0 += row0[j] * q[j]
            v1 += row1[j] * q[j]
            v2 += row2[j] * q[j]
            v3 += row3[j] * q[j]
        for j in range(length):
            solution[j] = (
                solution[j] + v0 * row0[j] + v1 * row1[j] + v2 * row2[j] + v3 * row3[j]
            )
        total += v0 * v0 + v1 * v1 + v2 * v2 + v3 * v3
        start += 4 * length
    return total


@njit_noalloc
def add_variance_reductions_by_substitution(columns, size, q, totals):
    """Adds |L^-1 q_h|^2 of the rows of q to ``totals``; q is overwritten.

    Forward substitution that reads L, of which ``columns[j]`` begins with column j,
    once and four columns at a time, for four rows of q at a time.
    """
    use_widest_registers()
    j = 0
    while j + 4 <= size:
        c0 = columns[j]
        c1 = columns[j + 1]
        c2 = columns[j + 2]
        c3 = columns[j + 3]
        # whole registers; the entries before j + 4 have been solved for
        start = max(0, size - (size - j - 4 + 7) // 8 * 8)
        d0 = c0[start:]
        d1 = c1[start:]
        d2 = c2[start:]
        d3 = c3[start:]
        # with a bound of len(q) // 4 * 4 LLVM makes loops that take twice as long
        for h in range(0, len(q) - 3, 4):
            r0 = q[h, start:size]
            r1 = q[h + 1, start:size]
            r2 = q[h + 2, start:size]
            r3 = q[h + 3, start:size]
            e0, e1, e2, e3 = _solve_four(c0, c1, c2, c3, j, q[h])
            f0, f1, f2, f3 = _solve_four(c0, c1, c2, c3, j, q[h + 1])
            g0, g1, g2, g3 = _solve_four(c0, c1, c2, c3, j, q[h + 2])
            h0, h1, h2, h3 = _solve_four(c0, c1, c2, c3, j, q[h + 3])
            totals[h] += e0 * e0 + e1 * e1 + e2 * e2 + e3 * e3
            totals[h + 1] += f0 * f0 + f1 * f1 + f2 * f2 + f3 * f3
            totals[h + 2] += g0 * g0 + g1 * g1 + g2 * g2 + g3 * g3
            totals[h + 3] += h0 * h0 + h1 * h1 + h2 * h2 + h3 * h3
            for i in range(len(r0)):
                x0 = d0[i]
                x1 = d1[i]
                x2 = d2[i]
                x3 = d3[i]
                r0[i] -= e0 * x0 + e1 * x1 + e2 * x2 + e3 * x3
                r1[i] -= f0 * x0 + f1 * x1 + f2 * x2 + f3 * x3
                r2[i] -= g0 * x0 + g1 * x1 + g2 * x2 + g3 * x3
                r3[i] -= h0 * x0 + h1 * x1 + h2 * x2 + h3 * x3
        for h in range(len(q) // 4 * 4, len(q)):
            r0 = q[h, start:size]
            e0, e1, e2, e3 = _solve_four(c0, c1, c2, c3, j, q[h])
            totals[h] += e0 * e0 + e1 * e1 + e2 * e2 + e3 * e3
            for i in range(len(r0)):
                r0[i] -= e0 * d0[i] + e1 * d1[i] + e2 * d2[i] + e3 * d3[i]
        j += 4
    while j < size:
        column = columns[j]
        for h in range(len(q)):
            row = q[h]
            value = q[h, j] / column[j]
            totals[h] += value * value
            for i in range(j + 1, size):
                row[i] -= value * column[i]
        j += 1


@inline_njit
def _solve_four(c0, c1, c2, c3, j, row):
    """Returns entries j to j + 3 of L^-1 q; ``row`` is q less the columns before."""
    v0 = row[j] / c0[j]
    v1 = (row[j + 1] - v0 * c0[j + 1]) / c1[j + 1]
    v2 = (row[j + 2] - v0 * c0[j + 2] - v1 * c1[j + 2]) / c2[j + 2]
    v3 = (row[j + 3] - v0 * c0[j + 3] - v1 * c1[j + 3] - v2 * c2[j + 3]) / c3[j + 3]
    return v0, v1, v2, v3
