"""Problem: the sum over all pairs of training points inside V_ab, and what its derivatives need of it, in one pass.

    P_ij = beta_ai beta_bj q_ai q_bj expm1(delta_ij),   delta_ij = rise_i + fall_j + left_i . right_j

For a = b, E_ij (``gpmpc.kernels.packed``) stands for beta_ai beta_aj and the sum runs over i >= j. The sums are the
total, the row sums p_i, the column sums p_j and g_j = sum_i R_ij z_i, with R = P where a and b differ (the rest of its
sum has a closed form) and R_ij = E_ij q_i q_j exp(delta_ij) where a = b.

A large delta is harmless. A kernel is at most sf2, so Q_ij = q_ai q_bj exp(delta_ij) is at most sf2_a q_bj and at most
sf2_b q_ai; the two together give Q_ij <= sf2_a sf2_b exp(-delta_ij). From delta = 300 on it is below 1e-130 sf2_a
sf2_b, and the exponent may stay there: nothing overflows, and q that underflow belong to nothing that counts.

Four rows i at a time meet sixteen columns j (``gpmpc.kernels.block``), and nothing of the pair goes to memory but what
it adds to the sums. What sixteen columns bring and gather stands together in a strip, and so does what four rows bring
and gather. So many strips of columns make a tile that it stays in the first cache while all rows pass.

Beliefs are mostly narrow beside the length-scales, and delta is small: where a bound for all pairs at once says so, its
expm1 needs no reduction, a quarter of all instructions.
"""

import math
from typing import NamedTuple

from numpy import ndarray

from gpmpc.compiled import njit_noalloc
from gpmpc.kernels.block import (
    SIZE,
    add_to_columns,
    add_to_rows,
    block,
    clear,
    copy,
    copy_four,
    copy_product,
    expm1,
    expm1_near_zero,
    fetch,
    outer_sum,
    plus,
    plus_outer,
    sum_rows,
    times,
)
from gpmpc.kernels.explained import ASKED, explain_asked
from gpmpc.kernels.exponential import EXACT, NEAR_ZERO, inlined, widest
from gpmpc.kernels.packed import COLUMNS, LANES, ROWS, TILE
from gpmpc.kernels.point_rows import largest, squared_lengths, summed

AHEAD = 16 * SIZE  # how far ahead of its use E is asked for: sixteen blocks last longer than memory takes to answer


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


@njit_noalloc
def column_strip(dims):
    """Numbers in a strip of columns: shift, vectors, weights; a sum and the sums of vectors, all of sixteen columns."""
    return (2 * dims + 3) * COLUMNS


@njit_noalloc
def row_strip(dims):
    """Numbers in a strip of rows: shift, vectors, weights, weights times z, all of four rows; four vectors of sums."""
    return (2 * dims + 2) * ROWS + ROWS * LANES


@njit_noalloc
def strips_memory(dims, padded):
    """Numbers that ``pair_sums`` works in, for ``padded`` points and vectors z of ``dims`` entries."""
    return padded // ROWS * row_strip(dims) + -(-padded // COLUMNS) * column_strip(dims)


@njit_noalloc
def fill_rows(strips, step, shift, left, weights, z):
    """Writes what the rows bring, and zeros for what they gather."""
    dims, padded = left.shape
    flat_left, flat_z, at = left.reshape(left.size), z.reshape(z.size), 0
    for i in range(0, padded, ROWS):
        copy_four(strips, at, shift, i)
        copy_four(strips, at + (dims + 1) * ROWS, weights, i)
        for d in range(dims):
            copy_four(strips, at + (d + 1) * ROWS, flat_left, i + d * padded)
            copy_product(strips, at + (d + dims + 2) * ROWS, flat_z, i + d * padded, weights, i)
        for k in range((2 * dims + 2) * ROWS, step, LANES):
            clear(strips, at + k)
        at += step


@njit_noalloc
def fill_columns(strips, step, shift, z, weights):
    """Writes what the columns bring, and zeros for what they gather and for eight columns that may be missing."""
    dims, padded = z.shape
    flat_z, at = z.reshape(z.size), 0
    for first in range(0, padded, COLUMNS):
        for k in range(0, step, LANES):
            clear(strips, at + k)
        for k in range(0, min(COLUMNS, padded - first), LANES):
            copy(strips, at + k, shift, first + k)
            copy(strips, at + k + (dims + 1) * COLUMNS, weights, first + k)
            for d in range(dims):
                copy(strips, at + k + (d + 1) * COLUMNS, flat_z, first + k + d * padded)
        at += step


@njit_noalloc
def gather(strips, step, place, weights, out):
    """Writes the sums of columns at each strip's ``place``, times their weights."""
    for first in range(0, len(out), COLUMNS):
        for at in range(first, min(first + COLUMNS, len(out)), ROWS):
            copy_product(out, at, strips, place + at - first, weights, at)
        place += step


@njit_noalloc(fastmath=EXACT)
def values_of(near, rows, row, tile, at, dims):
    """expm1(delta) of the rows of the strip at ``row`` and the columns of the strip at ``at``."""
    inlined()
    x = outer_sum(rows, row, tile, at)
    for d in range(1, dims + 1, 3):
        x = plus_outer(x, rows, row + d * ROWS, tile, at + d * COLUMNS)
        x = plus_outer(x, rows, row + (d + 1) * ROWS, tile, at + (d + 1) * COLUMNS)
        x = plus_outer(x, rows, row + (d + 2) * ROWS, tile, at + (d + 2) * COLUMNS)
    return expm1_near_zero(x) if near else expm1(x)


@njit_noalloc(fastmath=EXACT)
def add_vectors(tile, at, block, rows, row, dims):
    """Adds sum_i weights_i z_i block_ij to the sums of vectors from ``at`` on."""
    inlined()
    for d in range(0, dims, 3):
        add_to_columns(tile, at + d * COLUMNS, block, rows, row + d * ROWS)
        add_to_columns(tile, at + (d + 1) * COLUMNS, block, rows, row + (d + 1) * ROWS)
        add_to_columns(tile, at + (d + 2) * COLUMNS, block, rows, row + (d + 2) * ROWS)


@njit_noalloc(fastmath=EXACT)
def meet(derivatives, near, rows, tile, dims, explained):
    """All rows meet a tile of columns of another output; memory is idle meanwhile and is asked for what comes next."""
    widest()
    asked, last = explained.progress[ASKED], len(explained.triangles)
    weights_i, moments_i, sums_i = (dims + 1) * ROWS, (dims + 2) * ROWS, (2 * dims + 2) * ROWS
    weights, sums, moments, step = (dims + 1) * COLUMNS, (dims + 2) * COLUMNS, (dims + 3) * COLUMNS, column_strip(dims)
    for row in range(0, len(rows), row_strip(dims)):
        for at in range(0, len(tile), step):
            fetch(explained.triangles, min(asked, last - SIZE))
            asked = min(asked + SIZE, last)
            value = values_of(near, rows, row, tile, at, dims)
            add_to_columns(tile, at + sums, value, rows, row + weights_i)
            if derivatives:
                add_to_rows(rows, row + sums_i, value, tile, at + weights)
                add_vectors(tile, at + moments, value, rows, row + moments_i, dims)
        explained.progress[ASKED] = asked
        explain_asked(explained)


@njit_noalloc(fastmath=EXACT)
def meet_same(derivatives, near, rows, tile, dims, triangle):
    """Rows meet a tile of columns of the same output; returns how much of E, which starts with the tile's, was used."""
    widest()
    weights_i, moments_i, sums_i = (dims + 1) * ROWS, (dims + 2) * ROWS, (2 * dims + 2) * ROWS
    weights, sums, moments, step = (dims + 1) * COLUMNS, (dims + 2) * COLUMNS, (dims + 3) * COLUMNS, column_strip(dims)
    place = i = 0
    for row in range(0, len(rows), row_strip(dims)):
        i += ROWS
        below = min(len(tile), -(-i // COLUMNS) * step)
        for at in range(0, below, step):
            fetch(triangle, place + AHEAD)
            value, E = values_of(near, rows, row, tile, at, dims), block(triangle, place)
            P = times(E, value)
            add_to_columns(tile, at + sums, P, rows, row + weights_i)
            if derivatives:
                add_to_rows(rows, row + sums_i, P, tile, at + weights)
                add_vectors(tile, at + moments, plus(P, E), rows, row + moments_i, dims)
            place += SIZE
    return place


@njit_noalloc
def largest_exponent(left, rows, columns, work):
    """What no |delta_ij| exceeds, by Cauchy and Schwarz."""
    squared_lengths(left, work)
    square = largest(work)
    squared_lengths(columns.z, work)
    return largest(rows.shift) + largest(columns.shift) + math.sqrt(square * largest(work))


@njit_noalloc
def pair_sums(same, derivatives, triangle, left, rows, columns, explained, memory, out):
    """The sums of the module's text.

    Args:
        same: Whether a = b.
        derivatives: Whether more than the total is wanted.
        triangle: E_a, only read for a = b.
        left: (R, P).
        rows: ``Side`` of output a.
        columns: ``Side`` of output b; its z is right_j.
        explained: Goes on while a and b differ.
        memory: Lent to work in, ``strips_memory`` numbers that start on a cache line.
        out: Receives p_i, p_j and the rows of g (2 + R, P); without derivatives p_j only.

    Returns:
        sum_ij P_ij.
    """
    dims, padded = left.shape
    step_i, step_j, start = row_strip(dims), column_strip(dims), padded // ROWS * row_strip(dims)
    sums = (dims + 2) * COLUMNS
    strips_i, strips_j = memory[:start], memory[start : strips_memory(dims, padded)]
    near = largest_exponent(left, rows, columns, out[1]) <= NEAR_ZERO
    fill_rows(strips_i, step_i, rows.shift, left, rows.weights, rows.z)
    fill_columns(strips_j, step_j, columns.shift, columns.z, columns.weights)
    place = 0
    for at in range(0, len(strips_j), TILE * step_j):
        tile = strips_j[at : at + TILE * step_j]
        if same:
            below = strips_i[at // step_j * COLUMNS // ROWS * step_i :]
            place += meet_same(derivatives, near, below, tile, dims, triangle[place:])
        else:
            meet(derivatives, near, strips_i, tile, dims, explained)
    gather(strips_j, step_j, sums, columns.weights, out[1])
    if derivatives:
        for d in range(dims):
            gather(strips_j, step_j, sums + (d + 1) * COLUMNS, columns.weights, out[2 + d])
        at = (2 * dims + 2) * ROWS
        for i in range(0, padded, ROWS):
            sum_rows(out[0], i, strips_i, at, rows.weights, i)
            at += step_i
    return summed(out[1])
