"""Problem: what a belief's covariance S and diagonal precisions D make of each other, n x n, in plain loops.

With B = D^1/2 S D^1/2 and I + B = C C' (well conditioned for every S >= 0 and D > 0, also where S is singular):

    (I + S D)^-1 = D^-1/2 (I + B)^-1 D^1/2,     1/2 log|I + S D| = 1/2 sum log1p(pivot - 1)

The pivots of the Cholesky factorisation less one come without a one to cancel: a small S keeps its digits.
"""

import math

import numpy as np

from gpmpc.compiled import njit_inner


@njit_inner
def condition(S, D, n, whiten, G):
    """Writes G = (I + S D)^-1 and W = C^-1 D^1/2, |W nu|^2 = nu' (S + D^-1)^-1 nu; returns 1/2 log|I + S D|."""
    half_logdet = 0.0
    C = np.empty((n, n))
    root = np.sqrt(D[:n])
    for c in range(n):
        for d in range(c + 1):
            total = root[c] * S[c, d] * root[d]
            for e in range(d):
                total -= C[c, e] * C[d, e]
            if c == d:
                half_logdet += math.log1p(total) / 2
                C[c, c] = math.sqrt(1.0 + total)
            else:
                C[c, d] = total / C[d, d]
    for d in range(n):  # C^-1 by columns, in place of whiten
        for c in range(d):
            whiten[c, d] = 0.0
        whiten[d, d] = 1.0 / C[d, d]
        for c in range(d + 1, n):
            total = 0.0
            for e in range(d, c):
                total -= C[c, e] * whiten[e, d]
            whiten[c, d] = total / C[c, c]
    for c in range(n):
        for d in range(c + 1):
            total = 0.0
            for e in range(c, n):
                total += whiten[e, c] * whiten[e, d]
            G[c, d] = total * root[d] / root[c]
            G[d, c] = total * root[c] / root[d]
    for c in range(n):
        for d in range(c + 1):
            whiten[c, d] *= root[d]
    return half_logdet


@njit_inner
def product(left, right, n, out):
    """Writes left @ right."""
    for c in range(n):
        for d in range(n):
            out[c, d] = left[c, 0] * right[0, d]
        for e in range(1, n):
            for d in range(n):
                out[c, d] += left[c, e] * right[e, d]


@njit_inner
def transposed_product(left, diagonal, right, n, out):
    """Writes left' @ diag(diagonal) @ right."""
    for c in range(n):
        for d in range(n):
            out[c, d] = left[0, c] * diagonal[0] * right[0, d]
        for e in range(1, n):
            factor = left[e, c] * diagonal[e]
            for d in range(n):
                out[c, d] += factor * right[e, d]


@njit_inner
def congruent(G, inner, n, scratch, out):
    """Writes G' inner G."""
    product(inner, G, n, scratch)
    for c in range(n):
        for d in range(n):
            out[c, d] = G[0, c] * scratch[0, d]
        for e in range(1, n):
            for d in range(n):
                out[c, d] += G[e, c] * scratch[e, d]


@njit_inner
def add_difference(out, F, moment, G_ab, G_a, n, x, y):
    """Adds G_ab' moment G_ab - G_a' moment G_a = F moment G_ab + G_a' moment F' for F = G_ab' - G_a'."""
    product(F, moment, n, x)
    product(x, G_ab, n, y)
    for c in range(n):
        for d in range(n):
            out[c, d] += y[c, d]
    product(x, G_a, n, y)
    for c in range(n):
        for d in range(n):
            out[c, d] += y[d, c]


@njit_inner
def transposed_times(matrix, vector, n, out):
    """Writes matrix' @ vector."""
    for c in range(n):
        total = 0.0
        for d in range(n):
            total += matrix[d, c] * vector[d]
        out[c] = total


@njit_inner
def symmetrise(matrix, n):
    """Replaces a matrix by the mean of itself and its transpose."""
    for c in range(n):
        for d in range(c):
            mean = (matrix[c, d] + matrix[d, c]) / 2
            matrix[c, d] = mean
            matrix[d, c] = mean
