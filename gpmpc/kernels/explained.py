"""Problem: |L_a^-1 q_a|^2 and (K_a + sn2_a I)^-1 q_a of all outputs, without waiting for L_a^-1.

From some hundred points on the triangles of L_a^-1 fit no cache near the processor, and reading them takes longer than
the two multiply-adds per number. Pairs of two outputs compute for long and read little: while they do, the rows that
come next are asked for, block by block, and four of them are dealt with whenever they have arrived.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from gpmpc.compiled import njit_inner, njit_noalloc
from gpmpc.kernels.point_rows import aligned_rows, explain_four

OUTPUT, ROW, PLACE, ASKED = range(4)
ARRIVING = 1024  # numbers asked for last, which may still be on their way: a row of blocks in a tile


class Explained(NamedTuple):
    """The outputs' triangles and how far they have been read.

    Attributes:
        triangles: L_a^-1 of ``gpmpc.kernels.packed``, one after the other (k T,).
        q: (k, P).
        solved: (K_a + sn2_a I)^-1 q_a (k, P).
        totals: |L_a^-1 q_a|^2 (k,).
        progress: The output and the row that come next, where they stand in ``triangles``, and to where that was asked
            for (4,).
    """

    triangles: ndarray
    q: ndarray
    solved: ndarray
    totals: ndarray
    progress: ndarray


@njit_inner
def unexplained(triangles, q):
    """``Explained`` at its beginning; triangles (k, T), q (k, P)."""
    solved = aligned_rows(*q.shape)
    solved[:] = 0.0
    return Explained(triangles.reshape(triangles.size), q, solved, np.zeros(len(q)), np.zeros(4, np.int64))


@njit_noalloc
def explain_asked(explained):
    """Deals with the rows that have been asked for and must have arrived."""
    triangles, progress = explained.triangles, explained.progress
    a, row, place, asked = progress[OUTPUT], progress[ROW], progress[PLACE], progress[ASKED]
    arrived = asked - ARRIVING if asked < len(triangles) else asked
    while a < len(explained.q):
        length = row // 8 * 8 + 8
        if place + 4 * length > arrived:
            break
        explained.totals[a] += explain_four(triangles, place, length, explained.q[a], explained.solved[a])
        place, row = place + 4 * length, row + 4
        if row == explained.q.shape[1]:
            a, row = a + 1, 0
    progress[OUTPUT], progress[ROW], progress[PLACE] = a, row, place


@njit_noalloc
def explain_rest(explained):
    """Deals with all that is left."""
    explained.progress[ASKED] = len(explained.triangles)
    explain_asked(explained)
