"""Problem: predicted without feedback, uncertainty grows over a long horizon until no input satisfies the bounds.

The next solves will see the next states and correct what went wrong. A linear feedback u = u_k + K (x - mu_k) stands in
for that in the prediction (Hewing, Kabzan and Zeilinger, 2020):

    Sigma_{k+1} = (A + B K) Sigma_k (A + B K)' + V

K is the first gain of the LQR over the horizon, by the Riccati recursion; R is positive definite, so each of its steps
exists whatever A and B are. The bounds of the inputs hold for u_k, not for what K adds to it.
"""

import numpy as np

from gpmpc.compiled import compiled

Array = np.ndarray

SETTLED = 1e-9  # relative change of the cost to go at which the recursion has reached its limit


@compiled
def lqr_gain(A, B, Q, R, terminal, horizon):
    """K (m, n) of u = K x for x+ = A x + B u under sum x'Qx + u'Ru and x_H' terminal x_H."""
    M = terminal.copy()
    K = np.zeros((B.shape[1], B.shape[0]))
    for _ in range(horizon):
        MA = M @ A
        K = -np.linalg.solve(R + B.T @ M @ B, B.T @ MA)
        cost = Q + A.T @ (MA + M @ B @ K)
        cost = (cost + cost.T) / 2.0
        change = np.abs(cost - M).max()
        M = cost
        if change <= SETTLED * np.abs(M).max():
            break
    return K


@compiled
def spread(A, V, start, horizon):
    """Sigma_0 .. Sigma_H (H + 1, n, n) of Sigma+ = A Sigma A' + V."""
    covariances = np.empty((horizon + 1, A.shape[0], A.shape[1]))
    covariances[0] = start
    for k in range(horizon):
        S = A @ covariances[k] @ A.T + V
        covariances[k + 1] = (S + S.T) / 2.0
    return covariances
