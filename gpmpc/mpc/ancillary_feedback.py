"""Problem: predicted without feedback, uncertainty grows over a long horizon until no input satisfies the bounds.

The next solves will see the next states and correct what went wrong. A linear feedback u = u_k + K (x - mu_k) stands in
for that in the prediction (Hewing, Kabzan and Zeilinger, 2020):

    Sigma_{k+1} = (A + B K) Sigma_k (A + B K)' + V

K is the first gain of the regulator over the horizon (``gpmpc.mpc.linear_quadratic``), its sign turned. The bounds of
the inputs hold for u_k, not for what K adds to it.
"""

import numpy as np

from gpmpc.compiled import borrowing, compiled
from gpmpc.kernels.linalg import copy_matrix


@compiled
def spread(A, V, start, horizon):
    """Sigma_0 .. Sigma_H (H + 1, n, n) of Sigma+ = A Sigma A' + V."""
    covariances, scratch = np.empty((horizon + 1, A.shape[0], A.shape[1])), np.empty(len(A))
    copy_matrix(start, covariances[0])
    for k in range(horizon):
        step_spread(A, V, covariances[k], scratch, covariances[k + 1])
    return covariances


@borrowing
def step_spread(A, V, before, scratch, after):
    """Writes A Sigma A' + V."""
    n = len(A)
    for i in range(n):
        for j in range(n):
            scratch[j] = 0.0
        for c in range(n):
            for j in range(n):
                scratch[j] += A[i, c] * before[c, j]
        for j in range(i + 1):
            total = (V[i, j] + V[j, i]) / 2.0
            for c in range(n):
                total += scratch[c] * A[j, c]
            after[i, j] = after[j, i] = total
