"""Computes gains of the linear-quadratic regulator, u = -K x, by the Riccati recursion.

For x_{k+1} = A_k x_k + B_k u_k and the cost sum_{k=0..H-1} |x_k|^2_Q + |u_k|^2_R + |x_H|^2_T, backward from P_H = T
(Anderson and Moore, 1990, section 2.4; the second line keeps P positive semidefinite whatever is rounded):

    D_k = R + B_k' P_{k+1} B_k,   K_k = D_k^-1 B_k' P_{k+1} A_k
    P_k = Q + K_k' R K_k + (A_k - B_k K_k)' P_{k+1} (A_k - B_k K_k)

R is positive definite, so that every step exists whatever A and B are.
"""

from typing import NamedTuple

import numpy as np

from gpmpc.compiled import compiled, njit_noalloc
from gpmpc.exceptions import SettingError
from gpmpc.kernels.linalg import add_transposed_product, copy, copy_matrix, dot, product, solve_positive
from gpmpc.mpc.problem import PENALIZED, Problem

Array = np.ndarray

INPUTS, DEVIATIONS, INCREMENTS = range(3)

_SETTLED = 1e-12  # relative change of P at which the gains of a constant system have converged
_LONGEST = 10_000  # stages after which they are taken to have
_STABLE = 1e-9  # by how much an eigenvalue may lie outside the unit circle by rounding


class Stages(NamedTuple):
    """Affine stages s_{k+1} = A_k s_k + B_k u_k + c_k; H of them, or one that is constant over the horizon."""

    A: Array  # (H or 1, p, p)
    B: Array  # (H or 1, p, m)
    c: Array  # (H or 1, p)


class TrackingCost(NamedTuple):
    """Weights of the cost."""

    state: Array  # W of s_1 .. s_{H-1} (p / n, n, n)
    terminal: Array  # W of s_H (p / n, n, n)
    input: Array  # R (m, m)
    penalized: int  # what R weighs: INPUTS, DEVIATIONS or INCREMENTS

    @classmethod
    def of(cls, problem: Problem, weight: Array, terminal: Array) -> "TrackingCost":
        """The cost of a problem whose Q and terminal weight are W of s (p / n, n, n)."""
        W, T, R = (np.ascontiguousarray(part) for part in (weight, terminal, problem.cost.R))
        return cls(W, T, R, PENALIZED.index(problem.cost.penalized))


class References(NamedTuple):
    """What is tracked."""

    states: Array  # r_1 .. r_H of the mean (H, n); the rest of s is to be zero
    inputs: Array  # (H, m), used where R weighs deviations
    previous_input: Array  # u_{-1} (m,)


@compiled
def expand(stages, start, feedback, previous_input, unknowns):
    """Inputs (H, m) and states s_0 .. s_H (H + 1, p) of the unknowns v (H m,)."""
    p, m = stages.B.shape[1:]
    H, last = len(unknowns) // m, len(stages.A) - 1
    inputs, states = unknowns.copy().reshape(H, m), np.empty((H + 1, p))
    copy(start, states[0])
    for k in range(H):
        s, u, after, at = states[k], inputs[k], states[k + 1], min(k, last)
        if len(feedback) > 0:
            before = inputs[k - 1] if k > 0 else previous_input
            for i in range(m):
                F = feedback[k, i]
                u[i] += F[p + m] + dot(F, s, p) + dot(F[p:], before, m)
        for i in range(p):
            after[i] = stages.c[at, i] + dot(stages.A[at, i], s, p) + dot(stages.B[at, i], u, m)
    return inputs, states


@compiled
def tracking_cost(cost, states, inputs, references):
    """The cost itself, constants included, of states s_0 .. s_H (H + 1, p) and inputs (H, m)."""
    W, R, targets = cost.state, cost.input, references.states
    (H, n), m = targets.shape, len(R)
    total, error, v = 0.0, np.empty(states.shape[1]), np.empty(m)
    for k in range(H):
        copy(states[k + 1], error)
        for i in range(n):
            error[i] -= targets[k, i]
        weight = cost.terminal if k == H - 1 else W
        for b in range(len(W)):
            for i in range(n):
                for j in range(n):
                    total += error[b * n + i] * weight[b, i, j] * error[b * n + j]
        for i in range(m):
            v[i] = inputs[k, i]
            if cost.penalized == DEVIATIONS:
                v[i] -= references.inputs[k, i]
            elif cost.penalized == INCREMENTS:
                v[i] -= inputs[k - 1, i] if k > 0 else references.previous_input[i]
        for i in range(m):
            for j in range(m):
                total += v[i] * R[i, j] * v[j]
    return total


@compiled
def finite_horizon_lqr(A, B, Q, R, terminal, horizon):
    """Gains K_0 .. K_{H-1} (H, m, n) and the Hessians D_k of the cost in u_k (H, m, m).

    Args:
        A: (H, n, n), or (1, n, n) where it is constant: then the recursion ends where P settles.
        B: (H, n, m) or (1, n, m).
        Q: (n, n), positive semidefinite.
        R: (m, m), positive definite.
        terminal: T (n, n), positive semidefinite.
        horizon: H.
    """
    n, m = B.shape[1:]
    gains, hessians = np.zeros((horizon, m, n)), np.empty((horizon, m, m))
    P, following, PB, PC = terminal.copy(), np.empty((n, n)), np.empty((n, m)), np.empty((n, n))
    closed, factor, RK = np.empty((n, n)), np.empty((m, m)), np.empty((m, n))
    for k in range(horizon - 1, -1, -1):
        A_k, B_k, K, D = A[min(k, len(A) - 1)], B[min(k, len(B) - 1)], gains[k], hessians[k]
        product(P, B_k, PB)
        copy_matrix(R, D)
        add_transposed_product(B_k, PB, D)
        add_transposed_product(PB, A_k, K)
        copy_matrix(D, factor)
        solve_positive(factor, K)
        product(B_k, K, closed)
        for i in range(n):
            for j in range(n):
                closed[i, j] = A_k[i, j] - closed[i, j]
        product(P, closed, PC)
        product(R, K, RK)
        copy_matrix(Q, following)
        add_transposed_product(closed, PC, following)
        add_transposed_product(K, RK, following)
        change, size = 0.0, 0.0
        for i in range(n):
            for j in range(i + 1):
                value = 0.5 * (following[i, j] + following[j, i])
                change, size = max(change, abs(value - P[i, j])), max(size, abs(value))
                P[i, j] = P[j, i] = value
        if len(A) == 1 and change <= _SETTLED * size:
            for j in range(k):
                copy_matrix(K, gains[j])
                copy_matrix(D, hessians[j])
            break
    return gains, hessians


@compiled
def optimal_feedback(cost, stages, references):
    """The feedback F (H, m, p + m + 1) that minimises the cost without bounds, u_k = F_k [s_k; u_{k-1}; 1].

    It is that of the regulator of [s_k - r_k; u_{k-1}; 1], without u_{k-1} but for increments, whose input is the
    penalized v. The second result is half the Hessian of the cost in what is added to each u_k (H, m, m).
    """
    (p, m), targets, R = stages.B.shape[1:], references.states, cost.input
    (H, n), e = targets.shape, p + (m if cost.penalized == INCREMENTS else 0)
    A, B = np.zeros((H, e + 1, e + 1)), np.zeros((H, e + 1, m))
    weight, terminal = np.zeros((e + 1, e + 1)), np.zeros((e + 1, e + 1))
    add_blocks(cost.state, weight)
    add_blocks(cost.terminal, terminal)
    for k in range(H):
        at = min(k, len(stages.A) - 1)
        A[k, e, e] = 1.0
        for i in range(p):
            A[k, i, e] = stages.c[at, i]
            for j in range(p):
                A[k, i, j] = stages.A[at, i, j]
            for j in range(n):
                A[k, i, e] += stages.A[at, i, j] * targets[k - 1, j] if k > 0 else 0.0
            for j in range(m):
                B[k, i, j] = stages.B[at, i, j]
                if cost.penalized == DEVIATIONS:
                    A[k, i, e] += stages.B[at, i, j] * references.inputs[k, j]
        for i in range(n):
            A[k, i, e] -= targets[k, i]
        for i in range(e - p):
            A[k, p + i, p + i] = B[k, p + i, i] = 1.0
            for j in range(p):
                A[k, j, p + i] = stages.B[at, j, i]
    gains, hessians = finite_horizon_lqr(A, B, weight, R, terminal, H)
    feedback = np.zeros((H, m, p + m + 1))
    for k in range(H):
        for i in range(m):
            F, K = feedback[k, i], gains[k, i]
            for j in range(e):
                F[j] = -K[j]
            if cost.penalized == INCREMENTS:
                F[p + i] += 1.0
            F[p + m] = -K[e] + (references.inputs[k, i] if cost.penalized == DEVIATIONS else 0.0)
            if k > 0:
                F[p + m] += dot(K, targets[k - 1], n)
    return feedback, hessians


@njit_noalloc
def add_blocks(W, M):
    """Adds the blocks of a weight to the diagonal of M."""
    n = W.shape[1]
    for b in range(len(W)):
        for i in range(n):
            for j in range(n):
                M[b * n + i, b * n + j] += W[b, i, j]


def dlqr(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """The gain K (m, n) of u = -K x that minimises sum_k |x_k|^2_Q + |u_k|^2_R under x_{k+1} = A x_k + B u_k for ever.

    Args:
        A: (n, n).
        B: (n, m).
        Q: (n, n), positive semidefinite.
        R: (m, m), positive definite.

    Raises:
        SettingError: The inputs do not reach a mode that grows.
    """
    A, B, Q, R = (np.ascontiguousarray(matrix, dtype=float) for matrix in (A, B, Q, R))
    K = finite_horizon_lqr(A[None], B[None], Q, R, Q, _LONGEST)[0][0]
    if not np.isfinite(K).all() or np.abs(np.linalg.eigvals(A - B @ K)).max() > 1 + _STABLE:
        raise SettingError("A, B, Q", "there is no stationary gain: the inputs do not reach a growing mode")
    return K
