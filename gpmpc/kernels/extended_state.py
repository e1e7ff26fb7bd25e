"""The local model s+ = A s + B u + c of the extended state s = [mu; vec S], S = Sigma^(1/2), for H beliefs.

Mathematics: ``gpmpc.propagation.local_model``. With dSigma = E S + S E for a change E of the root, derivatives
D by Sigma become 2 D S; the next root's derivative X solves X S+ + S+ X = dSigma+, entry by entry in the basis of S+.
"""

import numpy as np

from gpmpc.compiled import compiled, njit_noalloc
from gpmpc.kernels.linalg import copy, square_root


@compiled
def extended_models(means, covariances, inputs, next_means, next_covariances, derivatives, A, B, c):
    """Writes A (H, p, p), B (H, p, m) and c (H, p).

    Args:
        means: mu (H, n).
        covariances: Sigma (H, n, n).
        inputs: u (H, m).
        next_means: (H, n).
        next_covariances: (H, n, n).
        derivatives: The six of ``gpmpc.propagation.Sensitivity``, in its order, H in front.
        A: Out.
        B: Out.
        c: Out.
    """
    mean_by_mean, mean_by_covariance, mean_by_input, by_mean, by_covariance, by_input = derivatives
    H, n = means.shape
    m, p = inputs.shape[1], n + n * n
    now, after, S, S_next = np.empty(p), np.empty(p), np.empty((n, n)), np.empty((n, n))
    change, rotated = np.empty((n * n, p + m)), np.empty((n * n, p + m))
    for h in range(H):
        square_root(covariances[h], S)
        r, U = square_root(next_covariances[h], S_next)
        copy(means[h], now[:n])
        copy(next_means[h], after[:n])
        copy(S.reshape(n * n), now[n:])
        copy(S_next.reshape(n * n), after[n:])
        for i in range(n):
            copy(mean_by_mean[h, i], A[h, i, :n])
            copy(mean_by_input[h, i], B[h, i])
            _write_derivative_by_root(mean_by_covariance[h, i], S, A[h, i, n:])
            for j in range(n):
                row = change[i * n + j]
                copy(by_mean[h, i, j], row[:n])
                copy(by_input[h, i, j], row[p:])
                _write_derivative_by_root(by_covariance[h, i, j], S, row[n:p])
        _rotate(U.T.copy(), change, rotated)
        _rotate(U.T.copy(), rotated, change)
        for i in range(n):
            for j in range(n):
                total = r[i] + r[j]
                for column in range(p + m):
                    change[i * n + j, column] *= 1.0 / total if total > 0.0 else 0.0
        _rotate(U, change, rotated)
        _rotate(U, rotated, change)
        for i in range(n * n):
            copy(change[i, :p], A[h, n + i])
            copy(change[i, p:], B[h, n + i])
        for i in range(p):
            c[h, i] = after[i]
            for j in range(p):
                c[h, i] -= A[h, i, j] * now[j]
            for j in range(m):
                c[h, i] -= B[h, i, j] * inputs[h, j]


@compiled
def square_roots(covariances, out):
    """Writes the symmetric roots of covariances (H, n, n)."""
    for h in range(len(covariances)):
        square_root(covariances[h], out[h])


@njit_noalloc
def _write_derivative_by_root(D, S, row):
    """Writes 2 D S, row by row."""
    n = len(S)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += D[i, k] * S[k, j]
            row[i * n + j] = 2.0 * total


@njit_noalloc
def _rotate(U, matrices, out):
    """Writes (U X)' for each column's matrix X; applied twice this gives U X U'."""
    n = len(U)
    for i in range(n):
        for j in range(n):
            target = out[j * n + i]
            target[:] = 0.0
            for k in range(n):
                factor, row = U[i, k], matrices[k * n + j]
                for column in range(len(row)):
                    target[column] += factor * row[column]
