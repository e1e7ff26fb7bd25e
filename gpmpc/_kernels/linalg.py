"""Dense linear algebra for compiled loops.

It is for small vectors and matrices, for which a library call costs too much. Sizes
come from the arrays; where rows are padded, a caller passes the number of entries that
count.
"""

import math

import numpy as np

from gpmpc._compiled import inline_njit, njit_inner, njit_noalloc
from gpmpc._kernels._simd import load, store, zeros


@njit_inner
def aligned_rows(rows, length):
    """Makes an uninitialised matrix.

    Its rows start on cache lines where ``length`` is a multiple of 8.
    """
    memory = np.empty(rows * length + 8)
    skip = (-(memory.ctypes.data >> 3)) % 8
    return memory[skip : skip + rows * length].reshape(rows, length)


@njit_noalloc
def copy(x, y):
    """Copies x to y.

    ``y[:] = x`` makes numba compile the message of an error, a second per kernel.
    """
    for i in range(len(y)):
        y[i] = x[i]


@njit_noalloc
def copy_matrix(X, Y):
    """Copies X to Y."""
    for i in range(len(Y)):
        copy(X[i], Y[i])


@inline_njit
def dot(x, y, size):
    """Returns x' y of the first ``size`` entries."""
    total = 0.0
    for i in range(size):
        total += x[i] * y[i]
    return total


@inline_njit
def four_dots(rows, x, size, out):
    """Writes rows[i]' x of four vectors to ``out``.

    x is read once, and four sums hide each other's latency.
    """
    r0, r1, r2, r3 = rows
    s0 = 0.0
    s1 = 0.0
    s2 = 0.0
    s3 = 0.0
    for j in range(size):
        value = x[j]
        s0 += r0[j] * value
        s1 += r1[j] * value
        s2 += r2[j] * value
        s3 += r3[j] * value
    out[0] = s0
    out[1] = s1
    out[2] = s2
    out[3] = s3


@inline_njit
def multiply(A, count, x, size, out):
    """Writes A x for the first ``count`` rows and ``size`` columns of A."""
    i = 0
    while i + 4 <= count:
        four_dots((A[i], A[i + 1], A[i + 2], A[i + 3]), x, size, out[i:])
        i += 4
    while i < count:
        out[i] = dot(A[i], x, size)
        i += 1


@inline_njit
def combine_rows(rows, count, factors, start, width, out):
    """Writes sum_j factors[j] rows[j] over ``count`` rows.

    It does so for ``width`` columns from ``start`` on, sixteen at a time, with sums of
    four rows side by side. Rows and ``out`` are padded: what lies between the last and
    the next whole register is written too.
    """
    column = start
    end = start + width
    while column + 8 < end:
        a = b = c = d = e = f = g = h = zeros()
        j = 0
        while j + 4 <= count:
            r0 = rows[j]
            r1 = rows[j + 1]
            r2 = rows[j + 2]
            r3 = rows[j + 3]
            f0 = factors[j]
            f1 = factors[j + 1]
            f2 = factors[j + 2]
            f3 = factors[j + 3]
            a = a + f0 * load(r0, column)
            b = b + f0 * load(r0, column + 8)
            c = c + f1 * load(r1, column)
            d = d + f1 * load(r1, column + 8)
            e = e + f2 * load(r2, column)
            f = f + f2 * load(r2, column + 8)
            g = g + f3 * load(r3, column)
            h = h + f3 * load(r3, column + 8)
            j += 4
        while j < count:
            a = a + factors[j] * load(rows[j], column)
            b = b + factors[j] * load(rows[j], column + 8)
            j += 1
        store(out, column, (a + c) + (e + g))
        store(out, column + 8, (b + d) + (f + h))
        column += 16
    if column < end:
        a = b = c = d = zeros()
        j = 0
        while j + 4 <= count:
            a = a + factors[j] * load(rows[j], column)
            b = b + factors[j + 1] * load(rows[j + 1], column)
            c = c + factors[j + 2] * load(rows[j + 2], column)
            d = d + factors[j + 3] * load(rows[j + 3], column)
            j += 4
        while j < count:
            a = a + factors[j] * load(rows[j], column)
            j += 1
        store(out, column, (a + b) + (c + d))


@njit_noalloc
def multiply_transposed(A, x, out):
    """Writes A' x."""
    for j in range(len(out)):
        out[j] = A[0, j] * x[0]
    for i in range(1, len(x)):
        for j in range(len(out)):
            out[j] += A[i, j] * x[i]


@njit_noalloc
def add_product(A, B, out):
    """Adds A B."""
    for i in range(len(A)):
        row = out[i]
        for k in range(len(B)):
            factor = A[i, k]
            B_row = B[k]
            for j in range(len(row)):
                row[j] += factor * B_row[j]


@njit_noalloc
def add_transposed_product(A, B, out):
    """Adds A' B."""
    for k in range(len(B)):
        B_row = B[k]
        for i in range(len(out)):
            factor = A[k, i]
            row = out[i]
            for j in range(len(row)):
                row[j] += factor * B_row[j]


@njit_noalloc
def product(A, B, out):
    """Writes A B."""
    out[:] = 0.0
    add_product(A, B, out)


@njit_noalloc
def congruence(A, X, scratch, out):
    """Writes A' X A; ``scratch`` has the shape of X A."""
    product(X, A, scratch)
    out[:] = 0.0
    add_transposed_product(A, scratch, out)


@njit_noalloc
def symmetrize(A):
    """Replaces A by (A + A') / 2."""
    for i in range(len(A)):
        for j in range(i):
            A[i, j] = A[j, i] = (A[i, j] + A[j, i]) / 2


@njit_noalloc
def solve_positive(A, X):
    """Replaces X by A^-1 X, and the lower triangle of A = L L' by L.

    Returns False where a pivot is not positive.
    """
    n, width = X.shape
    for i in range(n):
        for j in range(i):
            A[i, j] = (A[i, j] - dot(A[i], A[j], j)) / A[j, j]
        pivot = A[i, i] - dot(A[i], A[i], i)
        if not pivot > 0.0:
            return False
        A[i, i] = math.sqrt(pivot)
    for i in range(n):  # L^-1 X
        for j in range(i):
            for k in range(width):
                X[i, k] -= A[i, j] * X[j, k]
        for k in range(width):
            X[i, k] /= A[i, i]
    for i in range(n - 1, -1, -1):  # L^-T (L^-1 X)
        for j in range(i + 1, n):
            for k in range(width):
                X[i, k] -= A[j, i] * X[j, k]
        for k in range(width):
            X[i, k] /= A[i, i]
    return True


@njit_noalloc
def invert_identity_plus(S, D, whiten, G):
    """Writes (I + S D)^-1 to G for S >= 0, diagonal D > 0; returns 1/2 log|I + S D|.

    W = C^-1 D^1/2 goes to ``whiten``. With B = D^1/2 S D^1/2 and I + B = C C', well
    conditioned also where S is singular, G = D^-1/2 (I + B)^-1 D^1/2 and |W x|^2 = x'
    (S + D^-1)^-1 x. The pivots less one come without a one to cancel: a small S keeps
    its digits. For S D = 1e-12 the logarithm of a rounded 1 + S D has four digits
    right, log1p(S D) all.
    """
    n = len(S)
    half_logdet = 0.0
    for i in range(n):  # C, in place of G
        for j in range(i + 1):
            total = math.sqrt(D[i]) * S[i, j] * math.sqrt(D[j]) - dot(G[i], G[j], j)
            if i == j:
                half_logdet += math.log1p(total) / 2
                G[i, i] = math.sqrt(1.0 + total)
            else:
                G[i, j] = total / G[j, j]
    for j in range(n):  # C^-1 by columns
        for i in range(n):
            whiten[i, j] = 1.0 if i == j else 0.0
        for i in range(j, n):
            for k in range(j, i):
                whiten[i, j] -= G[i, k] * whiten[k, j]
            whiten[i, j] /= G[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += whiten[k, i] * whiten[k, j]
            G[i, j] = total * math.sqrt(D[j] / D[i])
            G[j, i] = total * math.sqrt(D[i] / D[j])
    for i in range(n):
        for j in range(i + 1):
            whiten[i, j] *= math.sqrt(D[j])
    return half_logdet
