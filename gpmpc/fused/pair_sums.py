"""Problem: the sum over all pairs of training points inside V_ab, and what its derivatives need of it, in one pass.

    P_ij = beta_ai beta_bj q_ai q_bj expm1(delta_ij),   delta_ij = rise_i + fall_j + left_i . right_j

For a = b, E_ij (``gpmpc.fused.packed``) stands for beta_ai beta_aj and the sum runs over i >= j. The sums are the
total, the row sums p_i, the column sums p_j and g_j = sum_i R_ij z_i, with R = P where a and b differ (the rest of its
sum has a closed form) and R_ij = E_ij q_i q_j exp(delta_ij) where a = b.

A large delta is harmless. A kernel is at most sf2, so Q_ij = q_ai q_bj exp(delta_ij) is at most sf2_a q_bj and at most
sf2_b q_ai; the two together give Q_ij <= sf2_a sf2_b exp(-delta_ij). From delta = 300 on it is below 1e-130 sf2_a
sf2_b, and the exponent may stay there: nothing overflows, and q that underflow belong to nothing that counts.

Eight rows i at a time meet eight columns j (``gpmpc.fused.block``), and nothing of the pair goes to memory but what it
adds to the sums. What eight columns bring and gather stands together in a strip of vectors of eight; so many strips
make a tile that it stays in the first cache while all rows pass. What eight rows bring is a strip, too.
"""

from typing import NamedTuple

from numpy import ndarray

from gpmpc.compiled import borrowing
from gpmpc.fused.block import (
    EDGE,
    SIZE,
    add_row_sums,
    add_to_columns,
    block,
    copy,
    copy_product,
    expm1,
    fetch,
    outer_sum,
    plus,
    plus_outer,
    plus_scaled,
    times,
    zeros,
)
from gpmpc.fused.exponential import EXACT, inlined, widest
from gpmpc.fused.packed import TILE

AHEAD = 4 * SIZE  # how far ahead of its use E is asked for: four blocks last longer than memory takes to answer


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


@borrowing
def strip(dims):
    """Numbers in a strip: shift, vectors, weights; then a sum and the sums of vectors, or weights times z."""
    return (2 * dims + 3) * EDGE


@borrowing
def tile_memory(dims):
    """Numbers that ``pair_sums`` works in, for vectors z of ``dims`` entries."""
    return (TILE + 1) * strip(dims)


@borrowing
def fill(memory, at, shift, vectors, weights, first):
    """Writes the first part of the strip of eight points from ``first`` on."""
    dims = len(vectors)
    copy(memory, at, shift, first)
    copy(memory, at + (dims + 1) * EDGE, weights, first)
    for d in range(dims):
        copy(memory, at + (d + 1) * EDGE, vectors[d], first)


@borrowing(fastmath=EXACT)
def values_of(rows, tile, at, dims):
    """expm1(delta) of eight rows and the columns of the strip at ``at``."""
    inlined()
    x = outer_sum(rows, 0, tile, at)
    for d in range(1, dims + 1, 3):
        x = plus_outer(x, rows, d * EDGE, tile, at + d * EDGE)
        x = plus_outer(x, rows, (d + 1) * EDGE, tile, at + (d + 1) * EDGE)
        x = plus_outer(x, rows, (d + 2) * EDGE, tile, at + (d + 2) * EDGE)
    return expm1(x)


@borrowing(fastmath=EXACT)
def add_vectors(tile, at, block, rows, first, dims):
    """Adds sum_i weights_i z_i block_ij to the sums of vectors from ``at`` on."""
    inlined()
    for d in range(0, dims, 3):
        add_to_columns(tile, at + d * EDGE, block, rows, first + d * EDGE)
        add_to_columns(tile, at + (d + 1) * EDGE, block, rows, first + (d + 1) * EDGE)
        add_to_columns(tile, at + (d + 2) * EDGE, block, rows, first + (d + 2) * EDGE)


@borrowing(fastmath=EXACT)
def meet(derivatives, rows, tile, strips, p_i, i, dims):
    """Eight rows meet a tile of columns of another output."""
    widest()
    weights, sums, step = (dims + 1) * EDGE, (dims + 2) * EDGE, strip(dims)
    if derivatives:
        sums_of_rows = zeros()
        for at in range(0, strips * step, step):
            value = values_of(rows, tile, at, dims)
            add_to_columns(tile, at + sums, value, rows, weights)
            sums_of_rows = plus_scaled(sums_of_rows, value, tile, at + weights)
            add_vectors(tile, at + sums + EDGE, value, rows, weights + EDGE, dims)
        add_row_sums(p_i, i, sums_of_rows, rows, weights)
    else:
        for at in range(0, strips * step, step):
            add_to_columns(tile, at + sums, values_of(rows, tile, at, dims), rows, weights)


@borrowing(fastmath=EXACT)
def meet_same(derivatives, rows, tile, strips, p_i, i, dims, triangle, place):
    """Eight rows meet a tile of columns of the same output, whose blocks of E start at ``place``."""
    widest()
    weights, sums, step = (dims + 1) * EDGE, (dims + 2) * EDGE, strip(dims)
    if derivatives:
        sums_of_rows = zeros()
        for at in range(0, strips * step, step):
            fetch(triangle, place + AHEAD)
            value, E = values_of(rows, tile, at, dims), block(triangle, place)
            P = times(E, value)
            R = plus(P, E)
            add_to_columns(tile, at + sums, P, rows, weights)
            sums_of_rows = plus_scaled(sums_of_rows, P, tile, at + weights)
            add_vectors(tile, at + sums + EDGE, R, rows, weights + EDGE, dims)
            place += SIZE
        add_row_sums(p_i, i, sums_of_rows, rows, weights)
    else:
        for at in range(0, strips * step, step):
            P = times(block(triangle, place), values_of(rows, tile, at, dims))
            add_to_columns(tile, at + sums, P, rows, weights)
            place += SIZE


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
    step, weights, sums = strip(dims), (dims + 1) * EDGE, (dims + 2) * EDGE
    tile, row = memory[: TILE * step], memory[TILE * step :]
    p_i, total, count, place = out[0], 0.0, padded // EDGE, 0
    p_i[:] = 0.0
    for start in range(0, count, TILE):
        strips = min(TILE, count - start)
        for column in range(strips):
            fill(tile, column * step, columns.shift, columns.z, columns.weights, (start + column) * EDGE)
            tile[column * step + sums : (column + 1) * step] = 0.0
        for eight in range(start if same else 0, count):
            i = eight * EDGE
            fill(row, 0, rows.shift, left, rows.weights, i)
            for d in range(dims):
                copy_product(row, sums + d * EDGE, rows.z[d], i, rows.weights, i)
            if same:
                below = min(eight + 1 - start, strips)
                meet_same(derivatives, row, tile, below, p_i, i, dims, triangle, place)
                place += below * SIZE
            else:
                meet(derivatives, row, tile, strips, p_i, i, dims)
        for column in range(strips):
            at, j = column * step, (start + column) * EDGE
            for k in range(EDGE):
                total += tile[at + sums + k] * tile[at + weights + k]
            if derivatives:
                for d in range(dims + 1):
                    copy_product(out[1 + d], j, tile, at + sums + d * EDGE, tile, at + weights)
    return total
