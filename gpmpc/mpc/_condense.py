"""Condenses a linear-quadratic problem into a quadratic program without states.

    s_{k+1} = A_k s_k + B_k u_k + c_k,   k = 0 .. H-1,   s_0 given
    minimise    sum_{k=0..H-1} |s_{k+1} - r_{k+1}|^2_W + |v_k|^2_R + z_k' Z_k z_k
    subject to  bounds on u_k, on u_k - u_{k-1} and on E_k s_{k+1} + D_k u_k

where v is the input, its deviation from a reference or its increment, and Z are the
squares of linearised outputs in z_k = [x_{k+1}; u_k; 1], x the mean in s. Weights of s
are block diagonal, (p / n, n, n): Q alone for the mean, and one Q a row of S for
s = [mu; vec S]. D comes with H stages of E.

Input coordinates. With Gamma_{k,i} = ds_k / du_i the program is min 1/2 U'P U + q'U,
P = 2 (Gamma' W Gamma + R~): (38)-(39) of Cao, Lai and Alam (2017), whose P lacks the 2
and whose unknowns are the increments. Bounds of inputs are a box. P takes O(H^2), not
O(H^3): with the cost to go M_H = W_H, M_k = W_k + A_k' M_{k+1} A_k of a system without
input, block (k, i <= k) of P is 2 B_k' M_{k+1} Gamma_{k+1,i} (Andersson, 2013; Axehill,
2015). Where A and B are constant, Gamma_{k,i} depends on k - i only, and each block of
P is its lower right neighbour plus one product.

Feedback coordinates. Where A grows over the horizon, P spans more digits than a number
has, and its smallest eigenvalue, of the size of R, is lost. There the unknowns are what
is added to the optimal unbounded feedback, u_k = F_k [s_k; u_{k-1}; 1] + v_k, by the
Riccati recursion: P is block diagonal, q is zero, and the response to v is stable. The
bounds of inputs are rows, for which stable plants would pay two to three times the
time. So these coordinates are used where the entries of the diagonal of P, each over
that of the last stage, which no A enters, sum up to more than ``_LARGEST_GROWTH``.
Weights by stage that are much smaller at the end count as growth, too.
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
    weight_of_stage,
)
from gpmpc.mpc._riccati import optimal_feedback

Array = np.ndarray

# Quadrotors over 100 stages have 2e7; in doubled precision a solve from 1e8 on takes
# 20 ms.
_LARGEST_GROWTH = 3e7


def condense(
    cost: QuadraticCost,
    bounds: InputBounds,
    stages: Stages,
    start: Array,
    references: References,
    rows: StageRows,
) -> CondensedProgram:
    """Makes the program in the coordinates that suit it.

    ``expand`` gives inputs and states of its solution.

    Args:
        cost: Weights.
        bounds: Of inputs and increments.
        stages: Affine dynamics.
        start: s_0 (p,).
        references: To track.
        rows: Bounds of E s + D u.

    Raises:
        ShapeError: Stages, start, rows, reference states or squares are not contiguous:
            the kernel ignores strides.
    """
    read_arrays = (*stages, start, rows.E, rows.D, references.states, cost.squares)
    for array in read_arrays:
        if not array.flags.c_contiguous:
            raise ShapeError("stages, rows and references must be contiguous arrays")
    p, m = stages.B.shape[1:]
    size = bounds.lower.size
    row_count = bounds.rate_lower.size + rows.lower.size
    program = CondensedProgram(
        P=np.empty((size, size)),
        q=np.empty(size),
        G=np.empty((row_count, size)),
        lower=np.empty(size + row_count),
        upper=np.empty(size + row_count),
        feedback=np.empty((0, m, p + m + 1)),
    )
    growth = _condense.unchecked(cost, bounds, stages, start, references, rows, program)
    if growth <= _LARGEST_GROWTH:
        return program
    return condense_with_feedback.unchecked(
        cost, bounds, stages, start, references, rows
    )


@compiled
def _condense(cost, bounds, stages, start, references, rows, program):
    """Writes the program in input coordinates.

    Returns the growth of A: P_ii over the last stage's, summed.
    """
    H, m = bounds.lower.shape
    rate_rows = bounds.rate_lower.size
    P = program.P
    G = program.G
    P[:] = 0.0
    G[:] = 0.0
    for k in range(H):
        R = cost.input[min(k, len(cost.input) - 1)]
        next_R = cost.input[min(k + 1, len(cost.input) - 1)]
        for i in range(m):
            for j in range(m):
                P[k * m + i, k * m + j] = 2.0 * R[i, j]
                if cost.penalized == INCREMENTS and k < H - 1:
                    P[k * m + i, k * m + j] += 2.0 * next_R[i, j]
                if cost.penalized == INCREMENTS and k > 0:
                    P[k * m + i, (k - 1) * m + j] = -2.0 * R[i, j]
    for i in range(rate_rows):
        G[i, i] = 1.0
        if i >= m:
            G[i, i - m] = -1.0
    constant = len(stages.A) == len(rows.E) == len(cost.state) == 1
    if constant and len(rows.D) == len(cost.squares) == 0:
        _add_constant_stages(cost, stages, rows.E[0], H, P, G[rate_rows:])
    else:
        _add_varying_stages(cost, stages, rows, H, P, G[rate_rows:])
    growth = 0.0
    for i in range(H * m):
        growth += P[i, i] / P[(H - 1) * m + i % m, (H - 1) * m + i % m]
    _write_gradient_and_bounds(cost, bounds, stages, start, references, rows, program)
    return growth


@njit_inner
def _add_varying_stages(cost, stages, rows, H, P, G):
    """Adds 2 Gamma' W Gamma to P, and writes E Gamma to G.

    It takes whole registers at a time, in padded copies.
    """
    p, m = stages.B.shape[1:]
    n = cost.terminal.shape[1]
    last = len(stages.A) - 1
    Z = cost.squares
    E = rows.E
    D = rows.D
    r = E.shape[1]
    M = _zeros(p, p)
    MA = _zeros(p, p)
    MB = _zeros(p, m)
    A = _zeros(p, p)
    A_transposed = np.empty((p, p))
    B = _zeros(p, m)
    BM = np.empty((H, m, p))  # 2 B_k' M_{k+1}
    # backward: M_{k+1} = W_{k+1} + A' M A, the second part is there already
    for k in range(H - 1, -1, -1):
        stage = min(k, last)
        add_blocks(weight_of_stage(cost, k, H), M)
        add_blocks(Z[k : k + 1, :n, :n], M)
        for i in range(p):
            for j in range(p):
                A[i, j] = A_transposed[j, i] = stages.A[stage, i, j]
            for j in range(m):
                B[i, j] = stages.B[stage, i, j]
        for i in range(p):
            combine_rows(B, p, M[i], 0, m, MB[i])
            combine_rows(A, p, M[i], 0, p, MA[i])
            for j in range(m):
                BM[k, j, i] = 2.0 * MB[i, j]
        for i in range(p):
            combine_rows(MA, p, A_transposed[i], 0, p, M[i])
        if len(Z) > 0:
            _add_inputs_of_square(Z[k], stages.B[stage], BM[k], P[k * m :, k * m :])
    gamma = _zeros(p, H * m)
    next_gamma = _zeros(p, H * m)
    row = _zeros(1, H * m)[0]
    for k in range(H):  # forward: Gamma_{k+1}
        stage = min(k, last)
        width = (k + 1) * m
        for i in range(p):
            combine_rows(gamma, p, stages.A[stage, i], 0, k * m, next_gamma[i])
            for j in range(m):
                next_gamma[i, k * m + j] = stages.B[stage, i, j]
        gamma, next_gamma = next_gamma, gamma
        for a in range(m):
            combine_rows(gamma, p, BM[k, a], 0, width, row)
            P_row = P[k * m + a]
            for j in range(width):
                P_row[j] += row[j]
        for e in range(r):
            combine_rows(gamma, p, E[min(k, len(E) - 1), e], 0, width, row)
            copy(row, G[k * r + e, :width])
            for j in range(m if len(D) > 0 else 0):
                G[k * r + e, k * m + j] += D[k, e, j]
    _mirror(P)


@njit_inner
def _add_inputs_of_square(Z, B, BM, P):
    """Adds the weights of u_k in z'Zz: alone and with s_{k+1} to its block of P.

    With what came before they go to 2 B'M.
    """
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
    """Does what ``_add_varying_stages`` does, for one A, B and E."""
    p, m = stages.B.shape[1:]
    r = len(E)
    size = len(P)
    # row l m + a of X: column a of A^l B
    X = _zeros(size, p)
    A_transposed = _zeros(p, p)
    W = _padded(cost.state[0])
    terminal_W = _padded(cost.terminal)
    same_weights = _are_equal(cost.state[0], cost.terminal)
    for i in range(p):
        for j in range(p):
            A_transposed[j, i] = stages.A[0, i, j]
        for a in range(m):
            X[a, i] = stages.B[0, i, a]
    for row in range(m, size):
        combine_rows(A_transposed, p, X[row - m], 0, p, X[row])
    X_transposed = _zeros(p, size + 8)
    stage = _zeros(1, size + 8)[0]
    end = _zeros(1, size + 8)[0]
    for row in range(size):
        for i in range(p):
            X_transposed[i, row] = X[row, i]
    sums = _zeros(m, size)
    weighed = _zeros(1, p + 8)[0]
    for k in range(H):
        # Block (j, j - d) is the sum over l <= k = H - 1 - j of X_l' W X_{l + d}, the
        # last with the terminal weight.
        j = H - 1 - k
        start = k * m
        for a in range(m):
            _weigh(W, X[start + a], weighed)
            combine_rows(X_transposed, p, weighed, start, size - start, stage)
            if not same_weights:
                _weigh(terminal_W, X[start + a], weighed)
                combine_rows(X_transposed, p, weighed, start, size - start, end)
            last_term = stage if same_weights else end
            total = sums[a]
            P_row = P[j * m + a]
            for d in range(j + 1):
                for b in range(m):
                    P_row[(j - d) * m + b] += 2.0 * (
                        total[d * m + b] + last_term[start + d * m + b]
                    )
            for i in range(size - start):
                total[i] += stage[start + i]
    for e in range(r):
        combine_rows(X_transposed, p, E[e], 0, size, stage)
        for k in range(H):
            for d in range(k + 1):
                for b in range(m):
                    G[k * r + e, (k - d) * m + b] = stage[d * m + b]
    _mirror(P)


@njit_inner
def _write_gradient_and_bounds(cost, bounds, stages, start, references, rows, program):
    """Writes q by the adjoint recursion, and the bounds, in input coordinates."""
    A = stages.A
    B = stages.B
    Z = cost.squares
    targets = references.states
    last = len(stages.A) - 1
    H, m = references.inputs.shape
    n = targets.shape[1]
    p = len(start)
    q = program.q.reshape(H, m)
    previous_input = references.previous_input
    # states without input
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
    costate = np.zeros(p)  # A_k' times the gradient by s_{k+1}
    for k in range(H - 1, -1, -1):
        R = cost.input[min(k, len(cost.input) - 1)]
        for j in range(m):
            if cost.penalized == DEVIATIONS:
                centre = references.inputs[k, j]
            elif cost.penalized == INCREMENTS and k == 0:
                centre = previous_input[j]
            else:
                centre = 0.0
            for i in range(m):
                q[k, i] -= 2.0 * R[i, j] * centre
        copy(free[k + 1], error)
        for i in range(n):
            error[i] -= targets[k, i]
        if len(cost.state) == 1 and k < H - 1:
            _weigh(W, error, gradient)
        else:
            _weigh(_padded(weight_of_stage(cost, k, H)), error, gradient)
        for i in range(p):
            gradient[i] = 2.0 * gradient[i] + costate[i]
        for i in range(n + m if len(Z) > 0 else 0):
            slope = 2.0 * (dot(Z[k, i], free[k + 1], n) + Z[k, i, n + m])
            if i < n:
                gradient[i] += slope
            else:
                q[k, i - n] += slope
        costate[:] = 0.0
        for i in range(p):
            weight = gradient[i]
            A_row = A[min(k, last), i]
            B_row = B[min(k, last), i]
            for j in range(p):
                costate[j] += weight * A_row[j]
            for j in range(m):
                q[k, j] += weight * B_row[j]
    _write_bounds(bounds, rows, np.zeros((H, m)), free, previous_input, 0, program)


@compiled
def condense_with_feedback(cost, bounds, stages, start, references, rows):
    """Returns the program in feedback coordinates; see ``condense``."""
    p, m = stages.B.shape[1:]
    E = rows.E
    D = rows.D
    r = E.shape[1]
    H = len(references.inputs)
    rate_rows = bounds.rate_lower.size
    size = H * m
    row_count = size + rate_rows + H * r
    feedback, hessians = optimal_feedback(cost, stages, references)
    P = np.zeros((size, size))
    G = np.zeros((row_count, size))
    # derivatives by v
    response = _zeros(p + m, size)  # of s_k and u_{k-1}
    next_state = _zeros(p, size)  # of s_{k+1}
    inputs = _zeros(m, size)  # of u_k
    factors = np.empty(p + m)
    for k in range(H):
        stage = min(k, len(stages.A) - 1)
        here = k * m
        width = (k + 1) * m
        for i in range(m):
            for j in range(m):
                P[here + i, here + j] = 2.0 * hessians[k, i, j]
            combine_rows(response, p + m, feedback[k, i], 0, here, inputs[i])
            inputs[i, here + i] = 1.0
            copy(inputs[i], G[here + i, :width])
            if rate_rows > 0:
                for j in range(width):
                    G[size + here + i, j] = inputs[i, j] - response[p + i, j]
        for i in range(m):
            copy(inputs[i], response[p + i])
            inputs[i, here + i] = 0.0
        for i in range(p):
            for j in range(p + m):
                if j < p:
                    factors[j] = stages.A[stage, i, j]
                else:
                    factors[j] = stages.B[stage, i, j - p]
            combine_rows(response, p + m, factors, 0, width, next_state[i])
        copy_matrix(next_state, response[:p])
        for e in range(r):
            factors[:p] = E[min(k, len(E) - 1), e]
            factors[p:] = 0.0
            if len(D) > 0:
                factors[p:] = D[k, e]
            combine_rows(response, p + m, factors, 0, width, inputs[0])
            copy(inputs[0], G[size + rate_rows + k * r + e, :width])
            inputs[0, here:width] = 0.0
    previous_input = references.previous_input
    lower = np.empty(size + row_count)
    upper = np.empty(size + row_count)
    for row in range(size + row_count):
        lower[row] = -np.inf
        upper[row] = np.inf
    program = CondensedProgram(P, np.zeros(size), G, lower, upper, feedback)
    free_inputs, free = expand(stages, start, feedback, previous_input, program.q)
    _write_bounds(bounds, rows, free_inputs, free, previous_input, size, program)
    return program


@njit_inner
def _write_bounds(bounds, rows, inputs, states, previous_input, unbounded, program):
    """Writes bounds of the stacked constraints after the unbounded ones.

    Inputs and states are those at v = 0.
    """
    H, m = inputs.shape
    E = rows.E
    D = rows.D
    r = E.shape[1]
    rate_rows = bounds.rate_lower.size
    lower = program.lower
    upper = program.upper
    first_rate = unbounded + H * m
    first_row = first_rate + rate_rows
    for k in range(H):
        for i in range(m):
            c = unbounded + k * m + i
            lower[c] = bounds.lower[k, i] - inputs[k, i]
            upper[c] = bounds.upper[k, i] - inputs[k, i]
            if rate_rows > 0:
                rate = inputs[k, i] - (inputs[k - 1, i] if k > 0 else previous_input[i])
                c = first_rate + k * m + i
                lower[c] = bounds.rate_lower[k, i] - rate
                upper[c] = bounds.rate_upper[k, i] - rate
        for e in range(r):
            value = dot(E[min(k, len(E) - 1), e], states[k + 1], E.shape[2])
            value += dot(D[k, e], inputs[k], m) if len(D) > 0 else 0.0
            c = first_row + k * r + e
            lower[c] = rows.lower[k, e] - value
            upper[c] = rows.upper[k, e] - value


@njit_inner
def _zeros(rows, columns):
    """Returns zeros in rows of whole registers, on cache lines."""
    matrix = aligned_rows(rows, (columns + 7) // 8 * 8)
    matrix[:] = 0.0
    return matrix


@njit_noalloc
def _are_equal(W, V):
    """Returns whether two weights of the same shape (b, n, n) are equal.

    numba takes half a second to compile ``np.array_equal``, and as long for
    ``np.full``.
    """
    b, n, m = W.shape
    for block in range(b):
        for i in range(n):
            for j in range(m):
                if W[block, i, j] != V[block, i, j]:
                    return False
    return True


@njit_inner
def _padded(W):
    """Returns the blocks of a weight in rows of whole registers (p / n, n, ...)."""
    n = W.shape[1]
    padded = np.zeros((len(W), n, (n + 7) // 8 * 8))
    for b in range(len(W)):
        for i in range(n):
            copy(W[b, i], padded[b, i, :n])
    return padded


@njit_noalloc
def _weigh(W, x, y):
    """Writes W x for the symmetric blocks of ``_padded`` to ``y``.

    Up to seven numbers after it are written, too.
    """
    n = W.shape[1]
    for b in range(len(W)):
        combine_rows(W[b], n, x[b * n :], 0, n, y[b * n :])


@njit_noalloc
def _mirror(P):
    """Takes the upper triangle from the lower one; in blocks, which stay in cache."""
    size = len(P)
    for top in range(0, size, 8):
        for left in range(0, top + 1, 8):
            for i in range(top, min(top + 8, size)):
                for j in range(left, min(left + 8, i)):
                    P[j, i] = P[i, j]
