"""Problem: the sum over all pairs of training points inside V_ab, and what its derivatives need of it, in one pass.

    P_ij = beta_ai beta_bj q_ai q_bj expm1(delta_ij),   delta_ij = rise_i + fall_j + left_i . right_j

For a = b, E_ij (``gpmpc.fused.packed``) stands for beta_ai beta_aj and the sum runs over i >= j. The sums are the
total, the row sums p_i, the column sums p_j and g_j = sum_i R_ij z_i, with R = P where a and b differ (the rest of its
sum has a closed form) and R_ij = E_ij q_i q_j exp(delta_ij) where a = b.

A large delta is harmless. A kernel is at most sf2, so Q_ij = q_ai q_bj exp(delta_ij) is at most sf2_a q_bj and at most
sf2_b q_ai; the two together give Q_ij <= sf2_a sf2_b exp(-delta_ij). From delta = 300 on it is below 1e-130 sf2_a
sf2_b, and the exponent may stay there: nothing overflows, and q that underflow belong to nothing that counts.

Four rows i at a time meet a tile of columns j: the exponents, then their exponentials, then the sums, each in loops
over slices that stay in the first cache. The four lie in one array, TILE apart: LLVM must see that they do not overlap.
"""

from typing import NamedTuple

from numpy import ndarray

from gpmpc.compiled import borrowing
from gpmpc.fused.exponential import EXACT, capped_expm1, widest

TILE = 200  # columns a tile: whole cache lines, and the four rows do not fall on each other in the cache
BLOCK = 4  # rows that meet a tile together
EXTENDED = BLOCK * TILE  # where R follows P


class Side(NamedTuple):
    """What one side of the pair, rows i or columns j, brings along.

    Attributes:
        z: The vectors z (R, P).
        shift: rise or fall (P,).
        weights: beta q, or q for a = b (P,).
    """

    z: ndarray
    shift: ndarray
    weights: ndarray


@borrowing(fastmath=EXACT)
def exponents(values, length, left, rise, i, right, fall):
    """Writes delta_ij of four rows from i on."""
    widest()
    rise0, rise1, rise2, rise3 = rise[i], rise[i + 1], rise[i + 2], rise[i + 3]
    for d in range(0, len(left), 3):
        x, y, z = left[d], left[d + 1], left[d + 2]
        x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
        y0, y1, y2, y3 = y[i], y[i + 1], y[i + 2], y[i + 3]
        z0, z1, z2, z3 = z[i], z[i + 1], z[i + 2], z[i + 3]
        columns = right[d * TILE :]
        if d == 0:
            for j in range(length):
                base, u, v, w = fall[j], columns[j], columns[TILE + j], columns[2 * TILE + j]
                values[j] = base + rise0 + x0 * u + y0 * v + z0 * w
                values[TILE + j] = base + rise1 + x1 * u + y1 * v + z1 * w
                values[2 * TILE + j] = base + rise2 + x2 * u + y2 * v + z2 * w
                values[3 * TILE + j] = base + rise3 + x3 * u + y3 * v + z3 * w
        else:
            for j in range(length):
                u, v, w = columns[j], columns[TILE + j], columns[2 * TILE + j]
                values[j] = values[j] + x0 * u + y0 * v + z0 * w
                values[TILE + j] = values[TILE + j] + x1 * u + y1 * v + z1 * w
                values[2 * TILE + j] = values[2 * TILE + j] + x2 * u + y2 * v + z2 * w
                values[3 * TILE + j] = values[3 * TILE + j] + x3 * u + y3 * v + z3 * w


@borrowing(fastmath=EXACT)
def exponentials(values, length):
    """Replaces delta by expm1(delta)."""
    widest()
    for j in range(length):
        values[j] = capped_expm1(values[j])
        values[TILE + j] = capped_expm1(values[TILE + j])
        values[2 * TILE + j] = capped_expm1(values[2 * TILE + j])
        values[3 * TILE + j] = capped_expm1(values[3 * TILE + j])


@borrowing(fastmath=EXACT)
def weigh(values, length, triangle, at, step, q):
    """For a = b: P_ij = E_ij q_j value, and R_ij = P_ij + E_ij q_j beside it, both without q_i."""
    widest()
    row0, row1, row2, row3 = triangle[at:], triangle[at + step :], triangle[at + 2 * step :], triangle[at + 3 * step :]
    for j in range(length):
        e0, e1, e2, e3 = row0[j] * q[j], row1[j] * q[j], row2[j] * q[j], row3[j] * q[j]
        p0, p1, p2, p3 = values[j], values[TILE + j], values[2 * TILE + j], values[3 * TILE + j]
        values[j], values[TILE + j], values[2 * TILE + j], values[3 * TILE + j] = e0 * p0, e1 * p1, e2 * p2, e3 * p3
        values[EXTENDED + j] = e0 * p0 + e0
        values[EXTENDED + TILE + j] = e1 * p1 + e1
        values[EXTENDED + 2 * TILE + j] = e2 * p2 + e2
        values[EXTENDED + 3 * TILE + j] = e3 * p3 + e3


@borrowing(fastmath=EXACT)
def add_weighed(sums, length, values, i, weights, triangle, at, step):
    """For a = b: adds weights_i E_ij values_ij of four rows to the columns' sums."""
    widest()
    row0, row1, row2, row3 = triangle[at:], triangle[at + step :], triangle[at + 2 * step :], triangle[at + 3 * step :]
    w0, w1, w2, w3 = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
    for j in range(length):
        total = sums[j] + (w0 * row0[j]) * values[j] + (w1 * row1[j]) * values[TILE + j]
        sums[j] = total + (w2 * row2[j]) * values[2 * TILE + j] + (w3 * row3[j]) * values[3 * TILE + j]


@borrowing(fastmath=EXACT)
def add_columns(sums, length, values, i, weights):
    """Adds weights_i values_ij of four rows to the columns' sums."""
    widest()
    w0, w1, w2, w3 = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
    for j in range(length):
        total = sums[j] + w0 * values[j] + w1 * values[TILE + j]
        sums[j] = total + w2 * values[2 * TILE + j] + w3 * values[3 * TILE + j]


@borrowing
def add_rows(sums, length, values, i, weights, factors):
    """Adds weights_i values_ij factors_j of four rows to the rows' sums."""
    widest()
    sum0 = sum1 = sum2 = sum3 = 0.0
    for j in range(length):
        factor = factors[j]
        sum0 += factor * values[j]
        sum1 += factor * values[TILE + j]
        sum2 += factor * values[2 * TILE + j]
        sum3 += factor * values[3 * TILE + j]
    sums[i] += weights[i] * sum0
    sums[i + 1] += weights[i + 1] * sum1
    sums[i + 2] += weights[i + 2] * sum2
    sums[i + 3] += weights[i + 3] * sum3


@borrowing(fastmath=EXACT)
def add_vectors(sums, length, values, i, weights, z):
    """Adds weights_i z_i values_ij of four rows to the columns' vectors, a component a TILE."""
    widest()
    w0, w1, w2, w3 = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
    for d in range(0, len(z), 3):
        x, y, t = z[d], z[d + 1], z[d + 2]
        x0, x1, x2, x3 = w0 * x[i], w1 * x[i + 1], w2 * x[i + 2], w3 * x[i + 3]
        y0, y1, y2, y3 = w0 * y[i], w1 * y[i + 1], w2 * y[i + 2], w3 * y[i + 3]
        t0, t1, t2, t3 = w0 * t[i], w1 * t[i + 1], w2 * t[i + 2], w3 * t[i + 3]
        target = sums[d * TILE :]
        for j in range(length):
            v0, v1, v2, v3 = values[j], values[TILE + j], values[2 * TILE + j], values[3 * TILE + j]
            target[j] = target[j] + x0 * v0 + x1 * v1 + x2 * v2 + x3 * v3
            target[TILE + j] = target[TILE + j] + y0 * v0 + y1 * v1 + y2 * v2 + y3 * v3
            target[2 * TILE + j] = target[2 * TILE + j] + t0 * v0 + t1 * v1 + t2 * v2 + t3 * v3


@borrowing
def tile_memory(dims):
    """Numbers that ``pair_sums`` works in, for vectors z of ``dims`` entries."""
    return (2 * BLOCK + 2 * dims + 2) * TILE


@borrowing
def pair_sums(same, derivatives, triangle, left, rows, columns, memory, out):
    """The sums of the module's text.

    Args:
        same: Whether a = b.
        derivatives: Whether more than the total is wanted.
        triangle: E_a, only read for a = b.
        left: (R, P).
        rows: ``Side`` of output a.
        columns: ``Side`` of output b; its z is right_j.
        memory: Lent to work in, ``tile_memory`` numbers that start on a cache line.
        out: Receives p_i, p_j and the rows of g (2 + R, P), where derivatives are wanted.

    Returns:
        sum_ij P_ij.
    """
    dims, padded = left.shape
    values, right = memory[: 2 * EXTENDED], memory[2 * EXTENDED : 2 * EXTENDED + dims * TILE]
    sums, ones = memory[2 * EXTENDED + dims * TILE :], memory[2 * EXTENDED + (2 * dims + 1) * TILE :]
    extended, vectors, p_i = values[EXTENDED:], sums[TILE:], out[0]
    ones[:] = 1.0
    p_i[:] = 0.0
    total = 0.0
    for start in range(0, padded, TILE):
        stop = min(start + TILE, padded)
        for d in range(dims):
            for j in range(stop - start):
                right[d * TILE + j] = columns.z[d, start + j]
        sums[: (dims + 1) * TILE] = 0.0
        fall, weights = columns.shift[start:stop], columns.weights[start:stop]
        factors = ones if same and derivatives else weights  # what the columns' sums still lack at the end
        for i in range(start if same else 0, padded, BLOCK):
            step = i // 8 * 8 + 8 if same else padded
            at = i // 8 * 8 * step // 2 + i % 8 * step + start
            length = min(step, stop) - start
            exponents(values, length, left, rows.shift, i, right, fall)
            exponentials(values, length)
            if same and not derivatives:
                add_weighed(sums, length, values, i, rows.weights, triangle, at, step)
                continue
            if same:
                weigh(values, length, triangle, at, step, weights)
            add_columns(sums, length, values, i, rows.weights)
            if derivatives:
                add_rows(p_i, length, values, i, rows.weights, factors)
                add_vectors(vectors, length, extended if same else values, i, rows.weights, rows.z)
        for j in range(stop - start):
            sums[j] *= factors[j]
            total += sums[j]
        if derivatives:
            for j in range(stop - start):
                out[1, start + j] = sums[j]
            for d in range(dims):
                for j in range(stop - start):
                    out[2 + d, start + j] = sums[(d + 1) * TILE + j] * factors[j]
    return total
