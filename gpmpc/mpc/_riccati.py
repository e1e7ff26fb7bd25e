"""Computes gains of the linear-quadratic regulator, u = -K x, by the Riccati recursion.

For x_{k+1} = A_k x_k + B_k u_k and the cost
sum_{k=0..H-1} |x_k|^2_Q + |u_k|^2_R + |x_H|^2_T (Q and R may be other matrices at each
stage), backward from P_H = T (Anderson and Moore, 1990, section 2.4; the second line
keeps P positive semidefinite whatever is rounded):

    D_k = R + B_k' P_{k+1} B_k,   K_k = D_k^-1 B_k' P_{k+1} A_k
    P_k = Q + K_k' R K_k + (A_k - B_k K_k)' P_{k+1} (A_k - B_k K_k)

R is positive definite, so that every step exists whatever A and B are.
"""

from typing import Any

import numpy as np

from gpmpc._arrays import read_array
from gpmpc._calls import explains_arguments
from gpmpc._compiled import compiled, njit_noalloc
from gpmpc._kernels.linalg import (
    add_transposed_product,
    copy_matrix,
    dot,
    product,
    solve_positive,
)
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.mpc._linear_quadratic import DEVIATIONS, INCREMENTS, add_blocks

Array = np.ndarray

# Relative change of P at which the gains of a constant system have converged.
_SETTLED = 1e-12
_LONGEST = 10_000  # stages after which they are taken to have
_STABLE = 1e-9  # by how much rounding may put an eigenvalue outside the unit circle


@compiled
def finite_horizon_lqr(A, B, Q, R, terminal, horizon):
    """Returns gains K_0 .. K_{H-1} (H, m, n) and Hessians D_k (H, m, m) of the cost.

    A, B, Q and R are of H stages or of one that is constant; where all are, the
    recursion ends where P settles.
    """
    n, m = B.shape[1:]
    constant = len(A) == len(Q) == len(R) == 1
    gains = np.zeros((horizon, m, n))
    hessians = np.empty((horizon, m, m))
    P = terminal.copy()
    next_P = np.empty((n, n))
    PB = np.empty((n, m))
    PC = np.empty((n, n))
    closed = np.empty((n, n))
    factor = np.empty((m, m))
    RK = np.empty((m, n))
    for k in range(horizon - 1, -1, -1):
        A_k = A[min(k, len(A) - 1)]
        B_k = B[min(k, len(B) - 1)]
        R_k = R[min(k, len(R) - 1)]
        K = gains[k]
        D = hessians[k]
        product(P, B_k, PB)
        copy_matrix(R_k, D)
        add_transposed_product(B_k, PB, D)
        add_transposed_product(PB, A_k, K)
        copy_matrix(D, factor)
        if not solve_positive(factor, K):
            K[:] = 0.0  # no feedback where no gain can be told
        product(B_k, K, closed)
        for i in range(n):
            for j in range(n):
                closed[i, j] = A_k[i, j] - closed[i, j]
        product(P, closed, PC)
        product(R_k, K, RK)
        copy_matrix(Q[min(k, len(Q) - 1)], next_P)
        add_transposed_product(closed, PC, next_P)
        add_transposed_product(K, RK, next_P)
        change = 0.0
        size = 0.0
        for i in range(n):
            for j in range(i + 1):
                value = 0.5 * (next_P[i, j] + next_P[j, i])
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
    """Returns the feedback that minimises a linear-quadratic cost without bounds.

    u_k = F_k [s_k; u_{k-1}; 1] with F (H, m, p + m + 1). It is that of the regulator of
    [s_k - r_k; u_{k-1}; 1], without u_{k-1} where nothing weighs it, whose input is the
    penalized v. The second result is half the Hessian of the cost in what is added to
    each u_k (H, m, m).
    """
    p, m = stages.B.shape[1:]
    targets = references.states
    squares = cost.squares
    H, n = targets.shape
    incremental = cost.penalized == INCREMENTS
    deviations = cost.penalized == DEVIATIONS
    e = p + (m if incremental or len(squares) > 0 else 0)
    A = np.zeros((H, e + 1, e + 1))
    B = np.zeros((H, e + 1, m))
    # weights of stages 1 .. H - 1
    weights = np.zeros((H if len(squares) > 0 else len(cost.state), e + 1, e + 1))
    terminal = np.zeros((e + 1, e + 1))
    add_blocks(cost.terminal, terminal)
    for k in range(len(weights)):
        add_blocks(cost.state[min(k, len(cost.state) - 1)], weights[k])
    for k in range(len(squares)):
        _add_square(squares[k], targets[k], terminal if k == H - 1 else weights[k], p)
    for k in range(H):
        stage = min(k, len(stages.A) - 1)
        shift = A[k, :, e]
        shift[e] = 1.0
        copy_matrix(stages.A[stage], A[k, :p, :p])
        copy_matrix(stages.B[stage], B[k, :p])
        for i in range(p):
            shift[i] = stages.c[stage, i] - (targets[k, i] if i < n else 0.0)
            if k > 0:
                shift[i] += dot(stages.A[stage, i], targets[k - 1], n)
            if deviations:
                shift[i] += dot(stages.B[stage, i], references.inputs[k], m)
        for i in range(e - p):
            B[k, p + i, i] = 1.0
            if deviations:
                shift[p + i] = references.inputs[k, i]
        if incremental:
            copy_matrix(B[k], A[k, :, p:e])
    # weights of stages 0 .. H - 1
    all_weights = np.concatenate((weights[:1], weights))
    state_weights = all_weights[: H if len(weights) > 1 else 1]
    gains, hessians = finite_horizon_lqr(A, B, state_weights, cost.input, terminal, H)
    feedback = np.zeros((H, m, p + m + 1))
    for k in range(H):
        for i in range(m):
            F = feedback[k, i]
            K = gains[k, i]
            for j in range(e):
                F[j] = -K[j]
            if incremental:
                F[p + i] += 1.0
            F[p + m] = -K[e] + (references.inputs[k, i] if deviations else 0.0)
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


def _square_system(*matrices: Any) -> list[Array]:
    """Returns A (n, n), B (n, m), Q (n, n) and R (m, m) as arrays.

    Raises:
        ShapeError: They are of other shapes.
        DataError: They are no numbers.
    """
    names = ("A", "B", "Q", "R")
    arrays = [
        np.ascontiguousarray(read_array(name, matrix))
        for name, matrix in zip(names, matrices, strict=True)
    ]
    n = len(np.atleast_1d(arrays[0]))
    m = np.shape(np.atleast_2d(arrays[1]))[-1]
    shapes = [array.shape for array in arrays]
    if shapes != [(n, n), (n, m), (n, n), (m, m)]:
        got = ", ".join(map(str, shapes))
        raise ShapeError(
            f"A, B, Q and R must be (n, n), (n, m), (n, n) and (m, m); got {got}"
        )
    return arrays


@explains_arguments
def dlqr(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Returns the stationary gain K (m, n) of the regulator u = -K x.

    It minimises sum_k |x_k|^2_Q + |u_k|^2_R under x_{k+1} = A x_k + B u_k for ever.

    Args:
        A: Derivative of the next state by the state (n, n).
        B: Derivative of the next state by the input (n, m).
        Q: Weight of the state (n, n), positive semidefinite.
        R: Weight of the input (m, m), positive definite.

    Raises:
        SettingError: The inputs do not reach a mode that grows, Q does not weigh one,
            or Q or R is not what it has to be.
        ShapeError: The matrices do not belong together.

    >>> import numpy as np
    >>> gain = dlqr(np.array([[1.0]]), np.array([[1.0]]), np.eye(1), np.eye(1))
    >>> gain.round(3).tolist()
    [[0.618]]

    See Also:
        ``Stability``, which says what a loop does near its rest.
    """
    A, B, Q, R = _square_system(A, B, Q, R)
    _check_definite(Q, R)
    gains, _ = finite_horizon_lqr(A[None], B[None], Q[None], R[None], Q, _LONGEST)
    K = gains[0]
    finite = np.isfinite(K).all()
    if not finite or np.abs(np.linalg.eigvals(A - B @ K)).max() > 1 + _STABLE:
        cause = "Q does not weigh a growing mode"
        if not _reach_growing_modes(A, B):
            cause = "the inputs do not reach a growing mode"
        raise SettingError("A, B, Q", f"there is no stationary gain: {cause}")
    return K


def _check_definite(Q: Array, R: Array) -> None:
    """Raises ``SettingError`` unless Q is positive semidefinite and R definite."""
    lowest = np.linalg.eigvalsh(0.5 * (Q + Q.T)).min()
    if not lowest >= -_STABLE * np.abs(Q).max():
        rule = "must be positive semidefinite"
        raise SettingError("Q", f"{rule}; its smallest eigenvalue is {lowest:.3g}")
    lowest = np.linalg.eigvalsh(0.5 * (R + R.T)).min()
    if not lowest > 0:
        rule = "must be positive definite"
        raise SettingError("R", f"{rule}; its smallest eigenvalue is {lowest:.3g}")


def _reach_growing_modes(A: Array, B: Array) -> bool:
    """Tells whether inputs move all modes that grow (Hautus, 1969)."""
    n = len(A)
    for value in np.linalg.eigvals(A):
        pencil = np.hstack([value * np.eye(n) - A, B])
        if abs(value) > 1 + _STABLE and np.linalg.matrix_rank(pencil) < n:
            return False
    return True
