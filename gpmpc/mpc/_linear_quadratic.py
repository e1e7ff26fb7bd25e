"""Computes gains of the linear-quadratic regulator, u = -K x, by the Riccati recursion.

For x_{k+1} = A_k x_k + B_k u_k and the cost sum_{k=0..H-1} |x_k|^2_Q + |u_k|^2_R + |x_H|^2_T (Q and R may be other
matrices at each stage), backward from P_H = T
(Anderson and Moore, 1990, section 2.4; the second line keeps P positive semidefinite whatever is rounded):

    D_k = R + B_k' P_{k+1} B_k,   K_k = D_k^-1 B_k' P_{k+1} A_k
    P_k = Q + K_k' R K_k + (A_k - B_k K_k)' P_{k+1} (A_k - B_k K_k)

R is positive definite, so that every step exists whatever A and B are.
"""

from typing import NamedTuple

import numpy as np

from gpmpc._compiled import compiled, njit_inner, njit_noalloc
from gpmpc._kernels.linalg import (
    add_transposed_product,
    copy,
    copy_matrix,
    dot,
    product,
    solve_positive,
)
from gpmpc.exceptions import SettingError

Array = np.ndarray

INPUTS, DEVIATIONS, INCREMENTS = range(3)

_SETTLED = (
    1e-12  # relative change of P at which the gains of a constant system have converged
)
_LONGEST = 10_000  # stages after which they are taken to have
_STABLE = 1e-9  # by how much an eigenvalue may lie outside the unit circle by rounding


class Stages(NamedTuple):
    """Affine stages s_{k+1} = A_k s_k + B_k u_k + c_k: K = H along a plan, or K = 1 that is held over the horizon."""

    A: Array  # (K, p, p)
    B: Array  # (K, p, m)
    c: Array  # (K, p); the defects of the plan are part of it
    next: Array = np.empty(
        (0, 0)
    )  # where the dynamics lead from the points of the plan, F(s_k, u_k) (K, p)
    V: Array = np.empty(
        (0, 0, 0)
    )  # what a stage adds to A Sigma A' (K, n, n), in the mode ``zero_order``; else zero


class QuadraticCost(NamedTuple):
    """Weights of a cost, the sum of |s_{k+1} - r_{k+1}|^2_W + |v_k|^2_R + z'Z z, z = [x_{k+1}; u_k; 1], x the mean."""

    state: Array  # W of s_1 .. s_{H-1} (H or 1, p / n, n, n)
    terminal: Array  # W of s_H (p / n, n, n)
    input: Array  # R (H or 1, m, m)
    penalized: int  # what R weighs: INPUTS, DEVIATIONS or INCREMENTS
    squares: Array  # Z of linearised outputs (H, n + m + 1, n + m + 1), or (0, n + m + 1, n + m + 1)


class References(NamedTuple):
    """What is tracked."""

    states: Array  # r_1 .. r_H of the mean (H, n); the rest of s is to be zero
    inputs: Array  # (H, m), used where R weighs deviations
    previous_input: Array  # u_{-1} (m,)


class InputBounds(NamedTuple):
    """Bounds of u_k and of u_k - u_{k-1}."""

    lower: Array  # (H, m)
    upper: Array  # (H, m)
    rate_lower: Array  # (H, m), or (0, m) where rates have no bounds
    rate_upper: Array  # (H, m) or (0, m)


class StageRows(NamedTuple):
    """Bounds lower_k <= E_k s_{k+1} + D_k u_k <= upper_k."""

    E: Array  # (H or 1, r, p)
    D: Array  # (H, r, m), or (0, r, m)
    lower: Array  # (H, r)
    upper: Array  # (H, r)


class CondensedProgram(NamedTuple):
    """min 1/2 v'P v + q'v under lower <= [v; G v] <= upper.

    The last of the stacked constraints are the bounds of inputs, of increments (where there are such) and of E s, stage
    by stage: all of them in input coordinates, all after H m unbounded v in feedback coordinates.
    """

    P: Array  # (H m, H m)
    q: Array  # (H m,)
    G: Array  # (rows, H m)
    lower: Array  # (H m + rows,)
    upper: Array  # (H m + rows,)
    feedback: Array  # F_k of u_k = F_k [s_k; u_{k-1}; 1] + v_k (H, m, p + m + 1); (0, m, p + m + 1) where u = v


@compiled
def expand(stages, start, feedback, previous_input, unknowns):
    """Inputs (H, m) and states s_0 .. s_H (H + 1, p) of the unknowns v (H m,)."""
    p, m = stages.B.shape[1:]
    H = len(unknowns) // m
    last = len(stages.A) - 1
    inputs = unknowns.copy().reshape(H, m)
    states = np.empty((H + 1, p))
    copy(start, states[0])
    for k in range(H):
        s = states[k]
        u = inputs[k]
        after = states[k + 1]
        at = min(k, last)
        if len(feedback) > 0:
            before = inputs[k - 1] if k > 0 else previous_input
            for i in range(m):
                F = feedback[k, i]
                u[i] += F[p + m] + dot(F, s, p) + dot(F[p:], before, m)
        for i in range(p):
            after[i] = (
                stages.c[at, i]
                + dot(stages.A[at, i], s, p)
                + dot(stages.B[at, i], u, m)
            )
    return inputs, states


@compiled
def evaluate_cost(cost, states, inputs, references, constant):
    """The cost of states s_0 .. s_H (H + 1, p) and inputs (H, m), with ``constant`` in the place of the 1 of z."""
    total = 0.0
    for stage_cost in evaluate_stages(cost, states, inputs, references, constant):
        total += stage_cost
    return total


@compiled
def evaluate_stages(cost, states, inputs, references, constant):
    """The costs of the stages (H,) whose sum ``evaluate_cost`` is; stage k is that of s_{k+1} and u_k."""
    targets = references.states
    H, n = targets.shape
    m = inputs.shape[1]
    error = np.empty(states.shape[1])
    v = np.empty(m)
    z = np.full(n + m + 1, constant)
    costs = np.empty(H)
    for k in range(H):
        copy(states[k + 1], error)
        for i in range(n):
            error[i] -= targets[k, i]
        weight = weight_of_stage(cost, k, H)
        R = cost.input[min(k, len(cost.input) - 1)]
        total = 0.0
        for b in range(len(weight)):
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
        if len(cost.squares) > 0:
            copy(states[k + 1, :n], z[:n])
            copy(inputs[k], z[n : n + m])
            for i in range(n + m + 1):
                total += z[i] * dot(cost.squares[k, i], z, n + m + 1)
        costs[k] = total
    return costs


@njit_inner
def weight_of_stage(cost, k, H):
    """W of s_{k+1} (p / n, n, n)."""
    return cost.terminal if k == H - 1 else cost.state[min(k, len(cost.state) - 1)]


@compiled
def finite_horizon_lqr(A, B, Q, R, terminal, horizon):
    """Gains K_0 .. K_{H-1} (H, m, n) and the Hessians D_k of the cost in u_k (H, m, m).

    A, B, Q and R are of H stages or of one that is constant; where all are, the recursion ends where P settles.
    """
    (n, m), constant = B.shape[1:], len(A) == len(Q) == len(R) == 1
    gains = np.zeros((horizon, m, n))
    hessians = np.empty((horizon, m, m))
    P = terminal.copy()
    following = np.empty((n, n))
    PB = np.empty((n, m))
    PC = np.empty((n, n))
    closed = np.empty((n, n))
    factor = np.empty((m, m))
    RK = np.empty((m, n))
    for k in range(horizon - 1, -1, -1):
        A_k = A[min(k, len(A) - 1)]
        B_k = B[min(k, len(B) - 1)]
        K = gains[k]
        D = hessians[k]
        R_k = R[min(k, len(R) - 1)]
        product(P, B_k, PB)
        copy_matrix(R_k, D)
        add_transposed_product(B_k, PB, D)
        add_transposed_product(PB, A_k, K)
        copy_matrix(D, factor)
        solve_positive(factor, K)
        product(B_k, K, closed)
        for i in range(n):
            for j in range(n):
                closed[i, j] = A_k[i, j] - closed[i, j]
        product(P, closed, PC)
        product(R_k, K, RK)
        copy_matrix(Q[min(k, len(Q) - 1)], following)
        add_transposed_product(closed, PC, following)
        add_transposed_product(K, RK, following)
        change = 0.0
        size = 0.0
        for i in range(n):
            for j in range(i + 1):
                value = 0.5 * (following[i, j] + following[j, i])
                change = max(change, abs(value - P[i, j]))
                size = max(size, abs(value))
                P[i, j] = P[j, i] = value
        if constant and change <= _SETTLED * size:
            for j in range(k):
                copy_matrix(K, gains[j])
                copy_matrix(D, hessians[j])
            break
    return gains, hessians


@compiled
def optimal_feedback(cost, stages, references):
    """The feedback F (H, m, p + m + 1) that minimises the cost without bounds, u_k = F_k [s_k; u_{k-1}; 1].

    It is that of the regulator of [s_k - r_k; u_{k-1}; 1], without u_{k-1} where nothing weighs it, whose input is the
    penalized v. The second result is half the Hessian of the cost in what is added to each u_k (H, m, m).
    """
    (p, m), targets, squares = stages.B.shape[1:], references.states, cost.squares
    incremental = cost.penalized == INCREMENTS
    (H, n), e = targets.shape, p + (m if incremental or len(squares) > 0 else 0)
    A = np.zeros((H, e + 1, e + 1))
    B = np.zeros((H, e + 1, m))
    weights = np.zeros(
        (H if len(squares) > 0 else len(cost.state), e + 1, e + 1)
    )  # of stages 1 .. H - 1
    terminal = np.zeros((e + 1, e + 1))
    add_blocks(cost.terminal, terminal)
    for k in range(len(weights)):
        add_blocks(cost.state[min(k, len(cost.state) - 1)], weights[k])
    for k in range(len(squares)):
        _add_square(squares[k], targets[k], terminal if k == H - 1 else weights[k], p)
    for k in range(H):
        at = min(k, len(stages.A) - 1)
        shift = A[k, :, e]
        shift[e] = 1.0
        copy_matrix(stages.A[at], A[k, :p, :p])
        copy_matrix(stages.B[at], B[k, :p])
        for i in range(p):
            shift[i] = stages.c[at, i] - (targets[k, i] if i < n else 0.0)
            if k > 0:
                shift[i] += dot(stages.A[at, i], targets[k - 1], n)
            if cost.penalized == DEVIATIONS:
                shift[i] += dot(stages.B[at, i], references.inputs[k], m)
        for i in range(e - p):
            B[k, p + i, i] = 1.0
            if cost.penalized == DEVIATIONS:
                shift[p + i] = references.inputs[k, i]
        if incremental:
            copy_matrix(B[k], A[k, :, p:e])
    before = np.concatenate((weights[:1], weights))[
        : H if len(weights) > 1 else 1
    ]  # of stages 0 .. H - 1
    gains, hessians = finite_horizon_lqr(A, B, before, cost.input, terminal, H)
    feedback = np.zeros((H, m, p + m + 1))
    for k in range(H):
        for i in range(m):
            F = feedback[k, i]
            K = gains[k, i]
            for j in range(e):
                F[j] = -K[j]
            if incremental:
                F[p + i] += 1.0
            F[p + m] = -K[e] + (
                references.inputs[k, i] if cost.penalized == DEVIATIONS else 0.0
            )
            if k > 0:
                F[p + m] += dot(K, targets[k - 1], n)
    return feedback, hessians


@njit_noalloc
def _add_square(Z, target, W, p):
    """Adds z'Zz, z = [x; u; 1], to a weight W of [s - r; u; 1]."""
    n = len(target)
    e = len(W) - 1
    m = e - p
    for i in range(n + m):
        row = i if i < n else p + i - n
        constant = Z[i, n + m] + dot(Z[i], target, n)
        for j in range(n + m):
            W[row, j if j < n else p + j - n] += Z[i, j]
        W[row, e] += constant
        W[e, row] += constant


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

    Raises:
        SettingError: The inputs do not reach a mode that grows.
    """
    A, B, Q, R = (np.ascontiguousarray(matrix, dtype=float) for matrix in (A, B, Q, R))
    K = finite_horizon_lqr(A[None], B[None], Q[None], R[None], Q, _LONGEST)[0][0]
    if (
        not np.isfinite(K).all()
        or np.abs(np.linalg.eigvals(A - B @ K)).max() > 1 + _STABLE
    ):
        raise SettingError(
            "A, B, Q",
            "there is no stationary gain: the inputs do not reach a growing mode",
        )
    return K
