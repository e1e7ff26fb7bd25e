"""Problem: predicted without feedback, uncertainty grows over a long horizon until no input satisfies the bounds.

The next solves will see the next states and correct what went wrong. A linear feedback u = u_k + K (x - mu_k) stands in
for that in the prediction (Hewing, Kabzan and Zeilinger, 2020):

    Sigma_{k+1} = (A + B K) Sigma_k (A + B K)' + V

K is the first gain of the LQR over the horizon, by the Riccati recursion; R is positive definite, so each of its steps
exists whatever A and B are. The bounds of the inputs hold for u_k, not for what K adds to it.
"""

import numpy as np

from gpmpc.compiled import borrowing, compiled, copy_matrix
from gpmpc.mpc.small_matrices import add_product, add_transposed_product, solve_positive

Array = np.ndarray

SETTLED = 1e-9  # relative change of the cost to go at which the recursion has reached its limit


@compiled
def lqr_gain(A, B, Q, R, terminal, horizon):
    """K (m, n) of u = K x for x+ = A x + B u under sum x'Qx + u'Ru and x_H' terminal x_H."""
    n, m = B.shape
    M, cost, MA, MB = terminal.copy(), np.empty((n, n)), np.empty((n, n)), np.empty((n, m))
    K, W, MBA = np.zeros((m, n)), np.empty((m, m)), np.empty((m, n))
    for _ in range(horizon):
        MA[:], MB[:], MBA[:] = 0.0, 0.0, 0.0
        copy_matrix(R, W)
        copy_matrix(Q, cost)
        add_product(M, A, MA)
        add_product(M, B, MB)
        add_transposed_product(MB, A, MBA)
        add_transposed_product(B, MB, W)
        copy_matrix(MBA, K)
        solve_positive(W, K)
        for j in range(m):
            for i in range(n):
                K[j, i] = -K[j, i]
        add_transposed_product(A, MA, cost)
        add_transposed_product(MBA, K, cost)
        change, size = 0.0, 0.0
        for i in range(n):
            for j in range(i + 1):
                value = (cost[i, j] + cost[j, i]) / 2.0
                change, size = max(change, abs(value - M[i, j])), max(size, abs(value))
                M[i, j] = M[j, i] = value
        if change <= SETTLED * size:
            break
    return K


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
