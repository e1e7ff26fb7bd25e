"""Sums over all pairs of points of a pair of outputs: where moments spend their time.

Of two outputs a and b, over i and j,

    P_ij     = weight_i weight_j expm1(delta_ij)
    delta_ij = delta_i + delta_j + (T_ab z_ai) . z_bj

one pass collects row sums p_i, column sums p_j and g_j = sum_i R_ij z_ai. The weights
are beta q, and R = P, for a != b. For a = b they are q, P_ij has the factor E_ij and
runs over i >= j, and R = E q q exp(delta) = P + U. ``padded`` is the number of points,
padded.

Four rows i meet sixteen columns j in registers: eight independent chains are what two
multiply-adds per cycle with a latency of four ask for. Here a0 to a3 are four rows of
the first eight columns, b0 to b3 of the last eight. From delta = 300 on a pair counts
for nothing, and the exponent may stay there. Where a bound says that delta is small for
all pairs, as for beliefs that are narrow beside the length-scales, expm1 needs no
reduction, a quarter of all instructions.
"""

import math
from typing import NamedTuple

from numpy import ndarray

from gpmpc._compiled import inline_njit, njit_inner, njit_noalloc
from gpmpc._kernels._packed import COLUMNS, ROWS
from gpmpc._kernels._rows import largest_size, largest_square, multiply_entries, row_sum
from gpmpc._kernels._simd import (
    NEAR_ZERO,
    expm1,
    expm1_near_zero,
    load,
    store,
    total,
    use_widest_registers,
    zeros,
)
from gpmpc._kernels.linalg import aligned_rows


class PairTerms(NamedTuple):
    """Terms of one pair of outputs a and b, and the sums over their points."""

    delta_i: ndarray  # r_ab - 1/2 z_ai' T_ab D_b T_a z_ai (padded,)
    delta_j: ndarray  # -1/2 z_bj' T_ab D_a T_b z_bj (padded,)
    T_z: ndarray  # T_ab z_ai (n, padded)
    weighted_z: ndarray  # weight_i z_ai (n, padded)
    p_i: ndarray  # row sums of P_ij (padded,)
    p_j: ndarray  # column sums of P_ij (padded,)
    g: ndarray  # g_j = sum_i R_ij z_ai (n, padded)


@njit_inner
def allocate_pair_terms(n, padded):
    """Makes ``PairTerms`` of GPs over ``padded`` points."""
    return PairTerms(
        delta_i=aligned_rows(1, padded)[0],
        delta_j=aligned_rows(1, padded)[0],
        T_z=aligned_rows(n, padded),
        weighted_z=aligned_rows(n, padded),
        p_i=aligned_rows(1, padded)[0],
        p_j=aligned_rows(1, padded)[0],
        g=aligned_rows(n, padded),
    )


@njit_noalloc
def sum_pairs(pair, weights_i, weights_j, z_a, z_b, E, size, same, derivatives):
    """Writes the sums of ``pair``, from its other terms; returns sum_ij P_ij.

    ``E`` is read for a = b (``same``). Sums p_i and g are written only with
    ``derivatives``; without, p_i is of no meaning, also where it is multiplied below.
    """
    for d in range(len(z_a)):
        multiply_entries(weights_i, z_a[d], pair.weighted_z[d])
    _sum_blocks(pair, weights_i, weights_j, z_b, E, size, same, derivatives)
    multiply_entries(pair.p_i, weights_i, pair.p_i)
    multiply_entries(pair.p_j, weights_j, pair.p_j)
    if derivatives:
        for d in range(len(z_a)):
            multiply_entries(pair.g[d], weights_j, pair.g[d])
    return row_sum(pair.p_j)


@njit_noalloc
def _is_near_zero(pair, z_b):
    """Whether a bound says that |delta_ij| is small for all pairs of points."""
    # Cauchy and Schwarz
    across = math.sqrt(largest_square(pair.T_z) * largest_square(z_b))
    bound = largest_size(pair.delta_i) + largest_size(pair.delta_j) + across
    return bound <= NEAR_ZERO


@njit_noalloc
def _sum_blocks(pair, weights_i, weights_j, z_b, E, size, same, derivatives):
    """Writes the sums, not yet multiplied by the weight of their own point.

    So p_i lacks weight_i, and p_j and g_j lack weight_j.
    """
    use_widest_registers()
    n, padded = z_b.shape
    near_zero = _is_near_zero(pair, z_b)
    pair.p_j[:] = 0.0
    if derivatives:
        pair.p_i[:] = 0.0
        pair.g[:] = 0.0
    block = 0  # where E of the block starts
    for i in range(0, size, ROWS):
        w0 = weights_i[i]
        w1 = weights_i[i + 1]
        w2 = weights_i[i + 2]
        w3 = weights_i[i + 3]
        s0 = s1 = s2 = s3 = zeros()
        end = i // COLUMNS * COLUMNS + COLUMNS if same else padded
        for j in range(0, end, COLUMNS):
            P_block = _expm1_of_block(
                near_zero, pair.delta_i, pair.delta_j, pair.T_z, z_b, i, j
            )
            if same:
                R_block, P_block = _multiply_block(P_block, E, block)
                block += ROWS * COLUMNS
            else:
                R_block = P_block
            (a0, b0), (a1, b1), (a2, b2), (a3, b3) = P_block
            p_a = load(pair.p_j, j)
            p_b = load(pair.p_j, j + 8)
            store(pair.p_j, j, p_a + w0 * a0 + w1 * a1 + w2 * a2 + w3 * a3)
            store(pair.p_j, j + 8, p_b + w0 * b0 + w1 * b1 + w2 * b2 + w3 * b3)
            if derivatives:
                w_a = load(weights_j, j)
                w_b = load(weights_j, j + 8)
                s0 = s0 + a0 * w_a + b0 * w_b
                s1 = s1 + a1 * w_a + b1 * w_b
                s2 = s2 + a2 * w_a + b2 * w_b
                s3 = s3 + a3 * w_a + b3 * w_b
                (a0, b0), (a1, b1), (a2, b2), (a3, b3) = R_block
                for d in range(n):
                    g = pair.g[d]
                    y = pair.weighted_z[d]
                    y0 = y[i]
                    y1 = y[i + 1]
                    y2 = y[i + 2]
                    y3 = y[i + 3]
                    g_a = load(g, j) + y0 * a0 + y1 * a1 + y2 * a2 + y3 * a3
                    g_b = load(g, j + 8) + y0 * b0 + y1 * b1 + y2 * b2 + y3 * b3
                    store(g, j, g_a)
                    store(g, j + 8, g_b)
        if derivatives:
            pair.p_i[i] = total(s0)
            pair.p_i[i + 1] = total(s1)
            pair.p_i[i + 2] = total(s2)
            pair.p_i[i + 3] = total(s3)


@inline_njit
def _expm1_of_block(near_zero, delta_i, delta_j, T_z, z_b, i, j):
    """Returns expm1(delta) of the rows from i and the columns from j on."""
    a = load(delta_j, j)
    b = load(delta_j, j + 8)
    a0 = a + delta_i[i]
    a1 = a + delta_i[i + 1]
    a2 = a + delta_i[i + 2]
    a3 = a + delta_i[i + 3]
    b0 = b + delta_i[i]
    b1 = b + delta_i[i + 1]
    b2 = b + delta_i[i + 2]
    b3 = b + delta_i[i + 3]
    for d in range(len(z_b)):
        a = load(z_b[d], j)
        b = load(z_b[d], j + 8)
        x = T_z[d]
        a0 = a0 + x[i] * a
        a1 = a1 + x[i + 1] * a
        a2 = a2 + x[i + 2] * a
        a3 = a3 + x[i + 3] * a
        b0 = b0 + x[i] * b
        b1 = b1 + x[i + 1] * b
        b2 = b2 + x[i + 2] * b
        b3 = b3 + x[i + 3] * b
    if near_zero:
        a0 = expm1_near_zero(a0)
        a1 = expm1_near_zero(a1)
        a2 = expm1_near_zero(a2)
        a3 = expm1_near_zero(a3)
        b0 = expm1_near_zero(b0)
        b1 = expm1_near_zero(b1)
        b2 = expm1_near_zero(b2)
        b3 = expm1_near_zero(b3)
    else:
        a0 = expm1(a0)
        a1 = expm1(a1)
        a2 = expm1(a2)
        a3 = expm1(a3)
        b0 = expm1(b0)
        b1 = expm1(b1)
        b2 = expm1(b2)
        b3 = expm1(b3)
    return (a0, b0), (a1, b1), (a2, b2), (a3, b3)


@inline_njit
def _multiply_block(values, E, start):
    """Returns E exp(delta) and E expm1(delta), from expm1(delta).

    E of these rows and columns begins at ``start``.
    """
    (a0, b0), (a1, b1), (a2, b2), (a3, b3) = values
    e0 = load(E, start)
    e1 = load(E, start + 16)
    e2 = load(E, start + 32)
    e3 = load(E, start + 48)
    f0 = load(E, start + 8)
    f1 = load(E, start + 24)
    f2 = load(E, start + 40)
    f3 = load(E, start + 56)
    a0 = a0 * e0
    a1 = a1 * e1
    a2 = a2 * e2
    a3 = a3 * e3
    b0 = b0 * f0
    b1 = b1 * f1
    b2 = b2 * f2
    b3 = b3 * f3
    P_block = (a0, b0), (a1, b1), (a2, b2), (a3, b3)
    R_block = (
        (a0 + e0, b0 + f0),
        (a1 + e1, b1 + f1),
        (a2 + e2, b2 + f2),
        (a3 + e3, b3 + f3),
    )
    return R_block, P_block
