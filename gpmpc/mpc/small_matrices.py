"""Problem: matrices of a handful of rows, in compiled loops over stages: a library call costs more than its work."""

import math

from gpmpc.compiled import borrowing


@borrowing
def add_product(A, X, Y):
    """Y += A X."""
    for r in range(len(A)):
        out = Y[r]
        for c in range(A.shape[1]):
            a, row = A[r, c], X[c]
            for i in range(len(row)):
                out[i] += a * row[i]


@borrowing
def add_transposed_product(A, X, Y):
    """Y += A' X."""
    for c in range(len(A)):
        row = X[c]
        for r in range(A.shape[1]):
            a, out = A[c, r], Y[r]
            for i in range(len(row)):
                out[i] += a * row[i]


@borrowing
def solve_positive(W, X):
    """X <- W^-1 X for a symmetric positive definite W, whose lower triangle is overwritten (Cholesky)."""
    m, n = len(W), X.shape[1]
    for i in range(m):
        for j in range(i + 1):
            total = W[i, j]
            for k in range(j):
                total -= W[i, k] * W[j, k]
            W[i, j] = total / W[j, j] if j < i else math.sqrt(total)
    for i in range(m):
        for j in range(i):
            for k in range(n):
                X[i, k] -= W[i, j] * X[j, k]
        for k in range(n):
            X[i, k] /= W[i, i]
    for i in range(m - 1, -1, -1):
        for j in range(i + 1, m):
            for k in range(n):
                X[i, k] -= W[j, i] * X[j, k]
        for k in range(n):
            X[i, k] /= W[i, i]
