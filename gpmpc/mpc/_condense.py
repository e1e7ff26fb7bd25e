"""Condenses a linear-quadratic tracking problem over affine stages into a quadratic program without states.

    s_{k+1} = A_k s_k + B_k u_k + c_k,   k = 0 .. H-1,   s_0 given
    minimise    sum_{k=0..H-1} |s_{k+1} - r_{k+1}|^2_W + |v_k|^2_R + z_k' Z_k z_k
    subject to  bounds on u_k, on u_k - u_{k-1} and on E_k s_{k+1} + D_k u_k

where v is the input, its deviation from a reference or its increment, and Z are the squares of linearised outputs in
z_k = [x_{k+1}; u_k; 1], x the mean in s. Weights of s are block diagonal, (p / n, n, n): Q alone for the mean, and one
Q a row of S for s = [mu; vec S]. D comes with H stages of E.

Input coordinates. With Gamma_{k,i} = ds_k / du_i the program is min 1/2 U'P U + q'U, P = 2 (Gamma' W Gamma + R~): (38)-
(39) of Cao, Lai and Alam (2017), whose P lacks the 2 and whose unknowns are the increments. Bounds of inputs are a box.
P takes O(H^2), not O(H^3): with the cost to go M_H = W_H, M_k = W_k + A_k' M_{k+1} A_k of a system without input, block
(k, i <= k) of P is 2 B_k' M_{k+1} Gamma_{k+1,i} (Andersson, 2013; Axehill, 2015). Where A and B are constant,
Gamma_{k,i} depends on k - i only, and each block of P is its lower right neighbour plus one product.

Feedback coordinates. Where A grows over the horizon, P spans more digits than a number has, and its smallest
eigenvalue, of the size of R, is lost. There the unknowns are what is added to the optimal unbounded feedback,
u_k = F_k [s_k; u_{k-1}; 1] + v_k, by the Riccati recursion: P is block diagonal, q is zero, and the response to v is
stable. The bounds of inputs are rows, for which stable plants would pay two to three times the time. So these
coordinates are used where the diagonal of P exceeds that of the last stage, which no A enters, by ``_LARGEST_GROWTH``.
"""

import numpy as np

from gpmpc._compiled import compiled, njit_inner, njit_noalloc
from gpmpc._kernels.linalg import aligned_rows, combine_rows, copy, copy_matrix, dot
from gpmpc.exceptions import ShapeError
from gpmpc.mpc._linear_quadratic import (
    DEVIATIONS,
    INCREMENTS,
    CondensedProgram,
    InputBounds,
    QuadraticCost,
    References,
    StageRows,
    Stages,
    add_blocks,
    expand,
    optimal_feedback,
    weight_of_stage,
)

Array = np.ndarray

_LARGEST_GROWTH = 3e7  # quadrotors over 100 stages have 2e7; in doubled precision a solve from 1e8 on takes 20 ms


def condense(
    cost: QuadraticCost,
    bounds: InputBounds,
    stages: Stages,
    start: Array,
    references: References,
    rows: StageRows,
) -> CondensedProgram:
    """Makes the program in the coordinates that suit it; ``expand`` gives inputs and states of its solution."""
    for array in (
        *stages,
        start,
        rows.E,
        rows.D,
        references.states,
        cost.squares,
    ):  # the kernel ignores strides
        if not array.flags.c_contiguous:
            raise ShapeError("stages, rows and references must be contiguous arrays")
    (p, m), size, count = (
        stages.B.shape[1:],
        bounds.lower.size,
        bounds.rate_lower.size + rows.lower.size,
    )
    lower, upper = np.empty((2, size + count))
    P = np.empty((size, size))
    q = np.empty(size)
    G = np.empty((count, size))
    program = CondensedProgram(P, q, G, lower, upper, np.empty((0, m, p + m + 1)))
    given = cost, bounds, stages, start, references, rows
    if _condense.unchecked(*given, program) <= _LARGEST_GROWTH:
        return program
    return condense_with_feedback.unchecked(*given)


@compiled
def _condense(cost, bounds, stages, start, references, rows, program):
    """Writes the program in input coordinates, and returns the growth of A: P_ii over the last stage's, summed."""
    (H, m), first, P, G, growth = (
        bounds.lower.shape,
        bounds.rate_lower.size,
        program.P,
        program.G,
        0.0,
    )
    P[:] = 0.0
    G[:] = 0.0
    for k in range(H):
        R = cost.input[min(k, len(cost.input) - 1)]
        following = cost.input[min(k + 1, len(cost.input) - 1)]
        for i in range(m):
            for j in range(m):
                P[k * m + i, k * m + j] = 2.0 * R[i, j]
                if cost.penalized == INCREMENTS and k < H - 1:
                    P[k * m + i, k * m + j] += 2.0 * following[i, j]
                if cost.penalized == INCREMENTS and k > 0:
                    P[k * m + i, (k - 1) * m + j] = -2.0 * R[i, j]
    for i in range(first):
        G[i, i] = 1.0
        if i >= m:
            G[i, i - m] = -1.0
    if len(stages.A) == len(rows.E) == len(cost.state) == 1 and len(cost.squares) == 0:
        _add_constant_stages(cost, stages, rows.E[0], H, P, G[first:])
    else:
        _add_varying_stages(cost, stages, rows, H, P, G[first:])
    for i in range(H * m):
        growth += P[i, i] / P[(H - 1) * m + i % m, (H - 1) * m + i % m]
    _write_gradient_and_bounds(cost, bounds, stages, start, references, rows, program)
    return growth


@njit_inner
def _add_varying_stages(cost, stages, rows, H, P, G):
    """Adds 2 Gamma' W Gamma to P, and writes E Gamma to G; whole registers at a time, in padded copies."""
    (p, m), n, last, Z = (
        stages.B.shape[1:],
        cost.terminal.shape[1],
        len(stages.A) - 1,
        cost.squares,
    )
    E = rows.E
    D = rows.D
    r = E.shape[1]
    M = _zeros(p, p)
    MA = _zeros(p, p)
    MB = _zeros(p, m)
    A = _zeros(p, p)
    transposed = np.empty((p, p))
    B = _zeros(p, m)
    BM = np.empty((H, m, p))  # 2 B_k' M_{k+1}
    for k in range(
        H - 1, -1, -1
    ):  # backward: M_{k+1} = W_{k+1} + A' M A, the second part is there already
        at = min(k, last)
        add_blocks(weight_of_stage(cost, k, H), M)
        add_blocks(Z[k : k + 1, :n, :n], M)
        for i in range(p):
            for j in range(p):
                A[i, j] = transposed[j, i] = stages.A[at, i, j]
            for j in range(m):
                B[i, j] = stages.B[at, i, j]
        for i in range(p):
            combine_rows(B, p, M[i], 0, m, MB[i])
            combine_rows(A, p, M[i], 0, p, MA[i])
            for j in range(m):
                BM[k, j, i] = 2.0 * MB[i, j]
        for i in range(p):
            combine_rows(MA, p, transposed[i], 0, p, M[i])
        if len(Z) > 0:
            _add_inputs_of_square(Z[k], stages.B[at], BM[k], P[k * m :, k * m :])
    gamma = _zeros(p, H * m)
    following = _zeros(p, H * m)
    row = _zeros(1, H * m)[0]
    for k in range(H):  # forward: Gamma_{k+1}
        at = min(k, last)
        width = (k + 1) * m
        for i in range(p):
            combine_rows(gamma, p, stages.A[at, i], 0, k * m, following[i])
            for j in range(m):
                following[i, k * m + j] = stages.B[at, i, j]
        gamma, following = following, gamma
        for a in range(m):
            combine_rows(gamma, p, BM[k, a], 0, width, row)
            out = P[k * m + a]
            for j in range(width):
                out[j] += row[j]
        for e in range(r):
            combine_rows(gamma, p, E[min(k, len(E) - 1), e], 0, width, row)
            copy(row, G[k * r + e, :width])
            for j in range(m if len(D) > 0 else 0):
                G[k * r + e, k * m + j] += D[k, e, j]
    _mirror(P)


@njit_inner
def _add_inputs_of_square(Z, B, BM, P):
    """Adds what weighs u_k in z'Zz: alone and with s_{k+1} to its block of P, with what came before to 2 B'M."""
    m = len(BM)
    n = len(Z) - len(BM) - 1
    for a in range(m):
        for b in range(m):
            P[a, b] += 2.0 * Z[n + a, n + b]
            for i in range(n):
                P[a, b] += 2.0 * B[i, a] * Z[i, n + b]
        for i in range(n):
            BM[a, i] += 2.0 * Z[n + a, i]


@njit_inner
def _add_constant_stages(cost, stages, E, H, P, G):
    """``_add_varying_stages`` for one A, B and E."""
    (p, m), r, size = stages.B.shape[1:], len(E), len(P)
    # row l m + a of X: column a of A^l B
    X = _zeros(size, p)
    transposed = _zeros(p, p)
    W = _padded(cost.state[0])
    T = _padded(cost.terminal)
    same = np.array_equal(cost.state[0], cost.terminal)
    for i in range(p):
        for j in range(p):
            transposed[j, i] = stages.A[0, i, j]
        for a in range(m):
            X[a, i] = stages.B[0, i, a]
    for row in range(m, size):
        combine_rows(transposed, p, X[row - m], 0, p, X[row])
    strip = _zeros(p, size + 8)
    stage = _zeros(1, size + 8)[0]
    end = _zeros(1, size + 8)[0]
    for row in range(size):
        for i in range(p):
            strip[i, row] = X[row, i]
    sums = _zeros(m, size)
    weighed = _zeros(1, p + 8)[0]
    for k in range(H):
        # Block (j, j - d) is the sum over l <= k = H - 1 - j of X_l' W X_{l + d}, the last with the terminal weight.
        j = H - 1 - k
        start = k * m
        for a in range(m):
            _weigh(W, X[start + a], weighed)
            combine_rows(strip, p, weighed, start, size - start, stage)
            if not same:
                _weigh(T, X[start + a], weighed)
                combine_rows(strip, p, weighed, start, size - start, end)
            ends = stage if same else end
            total = sums[a]
            out = P[j * m + a]
            for d in range(j + 1):
                for b in range(m):
                    out[(j - d) * m + b] += 2.0 * (
                        total[d * m + b] + ends[start + d * m + b]
                    )
            for i in range(size - start):
                total[i] += stage[start + i]
    for e in range(r):
        combine_rows(strip, p, E[e], 0, size, stage)
        for k in range(H):
            for d in range(k + 1):
                for b in range(m):
                    G[k * r + e, (k - d) * m + b] = stage[d * m + b]
    _mirror(P)


@njit_inner
def _write_gradient_and_bounds(cost, bounds, stages, start, references, rows, program):
    """Writes q by the adjoint recursion, and the bounds of the stacked constraints, in input coordinates."""
    A = stages.A
    B = stages.B
    Z = cost.squares
    targets = references.states
    last = len(stages.A) - 1
    (H, m), n, p = references.inputs.shape, targets.shape[1], len(start)
    q = program.q.reshape(H, m)
    previous = references.previous_input
    free = np.empty((H + 1, p))
    copy(start, free[0])
    for k in range(H):
        for i in range(p):
            free[k + 1, i] = stages.c[min(k, last), i] + dot(
                A[min(k, last), i], free[k], p
            )
    q[:] = 0.0
    W = _padded(cost.state[0])
    error = np.empty(p)
    gradient = np.zeros(p + 8)
    pulled = np.zeros(p)
    for k in range(H - 1, -1, -1):
        R = cost.input[min(k, len(cost.input) - 1)]
        for j in range(m):
            if cost.penalized == DEVIATIONS:
                centre = references.inputs[k, j]
            else:
                centre = previous[j] if cost.penalized == INCREMENTS and k == 0 else 0.0
            for i in range(m):
                q[k, i] -= 2.0 * R[i, j] * centre
        copy(free[k + 1], error)
        for i in range(n):
            error[i] -= targets[k, i]
        _weigh(
            W
            if len(cost.state) == 1 and k < H - 1
            else _padded(weight_of_stage(cost, k, H)),
            error,
            gradient,
        )
        for i in range(p):
            gradient[i] = 2.0 * gradient[i] + pulled[i]
        for i in range(n + m if len(Z) > 0 else 0):
            slope = 2.0 * (dot(Z[k, i], free[k + 1], n) + Z[k, i, n + m])
            if i < n:
                gradient[i] += slope
            else:
                q[k, i - n] += slope
        pulled[:] = 0.0
        for i in range(p):
            weight = gradient[i]
            row = A[min(k, last), i]
            reach = B[min(k, last), i]
            for j in range(p):
                pulled[j] += weight * row[j]
            for j in range(m):
                q[k, j] += weight * reach[j]
    _write_bounds(bounds, rows, np.zeros((H, m)), free, previous, 0, program)


@compiled
def condense_with_feedback(cost, bounds, stages, start, references, rows):
    """``condense`` in feedback coordinates."""
    (p, m), r, E, D = stages.B.shape[1:], rows.E.shape[1], rows.E, rows.D
    H = len(references.inputs)
    limited = bounds.rate_lower.size
    size = H * m
    count = H * m + limited + H * r
    feedback, hessians = optimal_feedback(cost, stages, references)
    P = np.zeros((size, size))
    G = np.zeros((count, size))
    reach, following, factors = (
        _zeros(p + m, size),
        _zeros(p, size),
        np.empty(p + m),
    )  # of s_k and u_{k-1}; of s_{k+1}
    inputs = _zeros(m, size)  # of u_k
    for k in range(H):
        at = min(k, len(stages.A) - 1)
        here = k * m
        width = (k + 1) * m
        for i in range(m):
            for j in range(m):
                P[here + i, here + j] = 2.0 * hessians[k, i, j]
            combine_rows(reach, p + m, feedback[k, i], 0, here, inputs[i])
            inputs[i, here + i] = 1.0
            copy(inputs[i], G[here + i, :width])
            if limited > 0:
                for j in range(width):
                    G[size + here + i, j] = inputs[i, j] - reach[p + i, j]
        for i in range(m):
            copy(inputs[i], reach[p + i])
            inputs[i, here + i] = 0.0
        for i in range(p):
            for j in range(p + m):
                factors[j] = stages.A[at, i, j] if j < p else stages.B[at, i, j - p]
            combine_rows(reach, p + m, factors, 0, width, following[i])
        copy_matrix(following, reach[:p])
        for e in range(r):
            factors[:p] = E[min(k, len(E) - 1), e]
            factors[p:] = 0.0
            if len(D) > 0:
                factors[p:] = D[k, e]
            combine_rows(reach, p + m, factors, 0, width, inputs[0])
            copy(inputs[0], G[size + limited + k * r + e, :width])
            inputs[0, here:width] = 0.0
    previous = references.previous_input
    lower = np.full(size + count, -np.inf)
    upper = np.full(size + count, np.inf)
    program = CondensedProgram(P, np.zeros(size), G, lower, upper, feedback)
    free_inputs, free = expand(stages, start, feedback, previous, program.q)
    _write_bounds(bounds, rows, free_inputs, free, previous, size, program)
    return program


@njit_inner
def _write_bounds(bounds, rows, inputs, states, previous_input, unbounded, program):
    """Writes bounds of the stacked constraints after the unbounded ones, given what inputs and states are at v = 0."""
    (H, m), limited, E, D = inputs.shape, bounds.rate_lower.size, rows.E, rows.D
    lower = program.lower
    upper = program.upper
    first = unbounded + H * m
    r = E.shape[1]
    for k in range(H):
        for i in range(m):
            at = unbounded + k * m + i
            lower[at] = bounds.lower[k, i] - inputs[k, i]
            upper[at] = bounds.upper[k, i] - inputs[k, i]
            if limited > 0:
                rate = inputs[k, i] - (inputs[k - 1, i] if k > 0 else previous_input[i])
                at = first + k * m + i
                lower[at] = bounds.rate_lower[k, i] - rate
                upper[at] = bounds.rate_upper[k, i] - rate
        for e in range(r):
            at = first + limited + k * r + e
            value = dot(E[min(k, len(E) - 1), e], states[k + 1], E.shape[2])
            value += dot(D[k, e], inputs[k], m) if len(D) > 0 else 0.0
            lower[at] = rows.lower[k, e] - value
            upper[at] = rows.upper[k, e] - value


@njit_inner
def _zeros(rows, columns):
    """Zeros in rows of whole registers, on cache lines."""
    matrix = aligned_rows(rows, (columns + 7) // 8 * 8)
    matrix[:] = 0.0
    return matrix


@njit_inner
def _padded(W):
    """The blocks of a weight in rows of whole registers (p / n, n, n padded)."""
    wide = np.zeros((len(W), W.shape[1], (W.shape[1] + 7) // 8 * 8))
    for b in range(len(W)):
        for i in range(W.shape[1]):
            copy(W[b, i], wide[b, i, : W.shape[1]])
    return wide


@njit_noalloc
def _weigh(W, x, y):
    """Writes W x for the symmetric blocks of ``_padded`` to ``y``, and up to seven numbers after it."""
    n = W.shape[1]
    for b in range(len(W)):
        combine_rows(W[b], n, x[b * n :], 0, n, y[b * n :])


@njit_noalloc
def _mirror(P):
    """Takes the upper triangle from the lower one; in blocks, which stay in the cache."""
    size = len(P)
    for top in range(0, size, 8):
        for left in range(0, top + 1, 8):
            for i in range(top, min(top + 8, size)):
                for j in range(left, min(left + 8, i)):
                    P[j, i] = P[i, j]
