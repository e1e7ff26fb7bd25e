r"""Problem: the exact moments of k GPs at one belief and all their first derivatives, in compiled loops.

Letters as in ``gpmpc.propagation.moment_matching``; D_a = Lam_a^-1, G_a = (I + S D_a)^-1, G_ab = (I + S (D_a +
D_b))^-1, w_ai = G_a' z_ai, c_ai = (u_i - u) / l_a^2, y_ij = G_ab' (z_ai + z_bj), and the difference, in a form that
cancels nothing, F_a = G_ab' - G_a' = -G_ab' D_b T_a:

    dlog q_ai  = w_ai . dmu + 1/2 <w_ai w_ai' - G_a' D_a, dS> + c_ai . du
    dlog Q_ij  = y_ij . dmu + 1/2 <y_ij y_ij' - G_ab' (D_a + D_b), dS> + (c_ai + c_bj) . du
    dV_ab      = sum_ij P_ij dlog Q_ij + sum_ij U_ij d(log Q_ij - log q_ai - log q_bj)

by the chain rule, where P is the centred product of ``gpmpc.kernels.pair_sums``. U_ij = beta_ai beta_bj q_ai q_bj,
whose sums are products of sums over single points; on the diagonal U_ij = E_ij q_ai q_aj, and -d|L_a^-1 q_a|^2 =
-2 sum_i e_i dlog q_ai with e_i = q_ai [(K_a + sn2_a I)^-1 q_a]_i is added. For the mean, J = E[df/dx] = dM/dmu (Stein,
1981) and dM/dS = 1/2 d2M/dmu2 (Price, 1958).
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from gpmpc.compiled import compiled, njit_inner, njit_noalloc
from gpmpc.kernels.belief_algebra import (
    add_difference,
    condition,
    congruent,
    product,
    symmetrise,
    transposed_product,
    transposed_times,
)
from gpmpc.kernels.explained import explain_rest, unexplained
from gpmpc.kernels.exponential import exp_all, widest
from gpmpc.kernels.pair_sums import Side, pair_sums, strips_memory
from gpmpc.kernels.point_rows import (
    add_products,
    aligned,
    aligned_rows,
    multiply,
    project,
    second_moments,
    summed,
    transform,
)

VALUE, JACOBIAN, CROSS = 0, 1, 2  # how much is wanted: derivatives of M and V as well, those of J as well


class Belief(NamedTuple):
    """The belief and the points as seen from it; R rows of states, of which n are in use.

    Attributes:
        S: (n, n).
        nu: x_i - mu (R, P).
        control: u_i - u, as rows (padded, P).
        inputs: m.
    """

    S: ndarray
    nu: ndarray
    control: ndarray
    inputs: int


class Single(NamedTuple):
    """What each output has alone; the vectors over the points first.

    Attributes:
        z: (k, R, P).
        moved: T_a z_ai (k, R, P).
        q: (k, P).
        weighted: beta q (k, P).
        G: (k, R, R).
        T: (k, R, R).
        half_logdet: 1/2 log|I + S D_a| (k,).
        first: sum_i beta_i q_i z_i (k, R).
        second: sum_i beta_i q_i z_i z_i' (k, R, R).
        e_total: sum_i e_i (k,).
        e_first: sum_i e_i z_i (k, R).
        e_second: sum_i e_i z_i z_i' (k, R, R).
    """

    z: ndarray
    moved: ndarray
    q: ndarray
    weighted: ndarray
    G: ndarray
    T: ndarray
    half_logdet: ndarray
    first: ndarray
    second: ndarray
    e_total: ndarray
    e_first: ndarray
    e_second: ndarray


class Derivatives(NamedTuple):
    """Where derivatives go, see ``gpmpc.kernels.Moments``; empty where they are not wanted."""

    dM_dS: ndarray
    dM_du: ndarray
    dV_dmu: ndarray
    dV_dS: ndarray
    dV_du: ndarray
    dJ_dS: ndarray
    dJ_du: ndarray


@njit_inner
def seen_from(points, mu, S, u):
    """The ``Belief``."""
    n, m = len(mu), len(u)
    R, padded = (n + 2) // 3 * 3, points.shape[1]
    nu, control = aligned_rows(R, padded), aligned_rows(len(points) - R, padded)
    for c in range(R):
        centre(points[c], mu[c] if c < n else 0.0, nu[c])
    for c in range(len(control)):
        centre(points[R + c], u[c] if c < m else 0.0, control[c])
    return Belief(S, nu, control, m)


@njit_noalloc
def centre(row, number, out):
    """Writes row - number."""
    for j in range(len(out)):
        out[j] = row[j] - number


@njit_inner
def room(k, R, padded):
    """An empty ``Single``."""
    z, moved = aligned_rows(k * R, padded).reshape(k, R, padded), aligned_rows(k * R, padded).reshape(k, R, padded)
    q, weighted = aligned_rows(k, padded), aligned_rows(k, padded)
    squares, vectors, numbers = np.zeros((4, k, R, R)), np.zeros((2, k, R)), np.zeros((2, k))
    G, T, second, e_second = squares[0], squares[1], squares[2], squares[3]
    return Single(z, moved, q, weighted, G, T, numbers[0], vectors[0], second, numbers[1], vectors[1], e_second)


@njit_inner
def evaluate_single(belief, D, signal, beta, a, single, n):
    """Fills everything of output a but the sums; returns M_a."""
    widest()
    nu, control, R = belief.nu, belief.control, len(belief.nu)
    z, moved, q, G, T, whiten = single.z[a], single.moved[a], single.q[a], single.G[a], single.T[a], np.zeros((R, R))
    single.half_logdet[a] = condition(belief.S, D, n, whiten, G)
    product(G, belief.S, n, T)
    symmetrise(T, n)
    q[:] = np.log(signal) - single.half_logdet[a]
    transform(whiten, nu, moved, n)
    add_products(q, np.full(n, -0.5), moved, moved, n)
    add_products(q, D[R:] / -2, control, control, len(control))
    exp_all(q)
    multiply(beta, q, single.weighted[a])
    for c in range(R):
        for j in range(len(q)):
            z[c, j] = D[c] * nu[c, j]
    transform(T, z, moved, n)
    project(single.weighted[a], z, single.first[a])
    return summed(single.weighted[a])


@njit_inner
def differentiate_mean(belief, D, a, single, n, M, to, work, x, y):
    """Fills the second moments of output a and dM."""
    widest()
    control, R, G = belief.control, len(belief.nu), single.G[a]
    controls = np.empty(len(control))
    second_moments(single.weighted[a], single.z[a], single.second[a], n, work[0])
    congruent(G, single.second[a], n, y, x)
    for c in range(n):
        for d in range(n):
            to.dM_dS[a, c, d] = (x[c, d] + x[d, c] - M * (G[d, c] * D[d] + G[c, d] * D[c])) / 4
    project(single.weighted[a], control, controls)
    for c in range(belief.inputs):
        to.dM_du[a, c] = controls[c] * D[R + c]


@njit_inner
def differentiate_explained(belief, D, a, single, solved, n, to, work, x, y):
    """Fills the sums over e_i of output a and what -|L_a^-1 q_a|^2 adds to dV_aa."""
    widest()
    control, R, G, e = belief.control, len(belief.nu), single.G[a], work[1]
    controls = np.empty(len(control))
    multiply(solved, single.q[a], e)
    single.e_total[a] = summed(e)
    project(e, single.z[a], single.e_first[a])
    second_moments(e, single.z[a], single.e_second[a], n, work[0])
    project(e, control, controls)
    congruent(G, single.e_second[a], n, y, x)
    transposed_times(G, single.e_first[a], n, y[0])
    for c in range(n):
        to.dV_dmu[a, a, c] = -2 * y[0, c]
        for d in range(n):
            to.dV_dS[a, a, c, d] = single.e_total[a] * (G[d, c] * D[d] + G[c, d] * D[c]) / 2 - (x[c, d] + x[d, c]) / 2
    for c in range(belief.inputs):
        to.dV_du[a, a, c] = -2 * controls[c] * D[R + c]


@njit_inner
def differentiate_cross(belief, D, a, single, n, J, to, work):
    """dJ/dS = 1/2 [sum_i beta_i q_i w_i w_i w_i - three times G'D with J] and dJ/du = sum_i beta_i q_i w_i c_i'."""
    widest()
    control, R, padded = belief.control, len(belief.nu), len(work[0])
    w, A = aligned_rows(R, padded), np.empty((n, n))
    transform(single.G[a].T.copy(), single.z[a], w, n)
    w[n:] = 0.0
    sums, controls, once, twice = np.empty(R), np.empty(len(control)), work[0], work[1]
    for c in range(n):
        for d in range(n):
            A[c, d] = single.G[a, d, c] * D[d]
    dJ_dS = to.dJ_dS[a]
    for c in range(n):
        multiply(single.weighted[a], w[c], once)
        project(once, control, controls)
        for d in range(belief.inputs):
            to.dJ_du[a, c, d] = controls[d] * D[R + d]
        for d in range(c + 1):
            multiply(once, w[d], twice)
            project(twice, w[: d // 3 * 3 + 3], sums)
            for e in range(d + 1):
                value = (sums[e] - A[c, d] * J[e] - A[c, e] * J[d] - A[d, e] * J[c]) / 2
                dJ_dS[c, d, e] = dJ_dS[c, e, d] = dJ_dS[d, c, e] = value
                dJ_dS[d, e, c] = dJ_dS[e, c, d] = dJ_dS[e, d, c] = value


@njit_inner
def evaluate_pair(belief, D_a, D_b, a, b, single, triangle, explained, n, order, work, left, strips, G_ab, x):
    """sum_ij P_ij of the pair; its parts go to ``work[3:]``, G_ab is filled."""
    widest()
    T_ab, D_ab, rise, fall = np.zeros_like(G_ab), D_a + D_b, work[1], work[2]
    r = single.half_logdet[a] + single.half_logdet[b] - condition(belief.S, D_ab, n, x, G_ab)
    product(G_ab, belief.S, n, T_ab)
    symmetrise(T_ab, n)
    fall[:] = 0.0
    transform(T_ab, single.z[b], left, n)
    add_products(fall, D_a / -2, left, single.moved[b], n)
    rise[:] = r
    if a != b:
        transform(T_ab, single.z[a], left, n)
        add_products(rise, D_b / -2, left, single.moved[a], n)
    else:
        for j in range(len(rise)):
            rise[j] += fall[j]
    weights_a, weights_b = (single.q[a], single.q[b]) if a == b else (single.weighted[a], single.weighted[b])
    rows, columns = Side(single.z[a], rise, weights_a), Side(single.z[b], fall, weights_b)
    return pair_sums(a == b, order > VALUE, triangle, left, rows, columns, explained, strips, work[3:])


@njit_inner
def differentiate_pair(belief, D_a, D_b, a, b, single, n, M, P_total, to, work, G_ab, x, y, H):
    """Adds the derivatives of the pair's sum to those of V_ab."""
    widest()
    R, control, same = len(belief.nu), belief.control, a == b
    p_i, p_j, g = work[3], work[4], work[5:]
    vector, U1, U2 = np.zeros((2, R)), np.zeros((2, R)), np.zeros((2, R, R))
    controls, dmu, D_ab = np.empty((2, len(control))), to.dV_dmu[a, b], D_a + D_b
    # x = sum p_i z_i z_i' + sum p_j z_j z_j' + H + H', H = sum_ij (P_ij + U_ij) z_i z_j'
    second_moments(p_i, single.z[a], x, n, work[0])
    second_moments(p_j, single.z[b], y, n, work[0])
    project(p_i, single.z[a], vector[0])
    project(p_j, single.z[b], vector[1])
    project(p_i, control, controls[0])
    project(p_j, control, controls[1])
    for c in range(n):
        project(g[c], single.z[b], H[c])
    if same:
        U_total = M[a] * M[a] - single.e_total[a]
        for c in range(n):
            U1[0, c] = U1[1, c] = M[a] * single.first[a, c] - single.e_first[a, c]
            for d in range(n):
                U2[0, c, d] = U2[1, c, d] = M[a] * single.second[a, c, d] - single.e_second[a, c, d]
    else:
        U_total = M[a] * M[b]
        for c in range(n):
            U1[0, c], U1[1, c] = M[b] * single.first[a, c], M[a] * single.first[b, c]
            for d in range(n):
                H[c, d] += single.first[a, c] * single.first[b, d]
                U2[0, c, d], U2[1, c, d] = M[b] * single.second[a, c, d], M[a] * single.second[b, c, d]
    for c in range(n):
        for d in range(n):
            x[c, d] += y[c, d] + H[c, d] + H[d, c]
    for c in range(R):
        vector[0, c] += vector[1, c]
    congruent(G_ab, x, n, y, H)
    transposed_times(G_ab, vector[0], n, vector[1])
    for c in range(n):
        dmu[c] += vector[1, c]
        for d in range(n):
            H[c, d] -= P_total * G_ab[d, c] * D_ab[d]
    for side in range(2):  # F_a of the rows' output, F_b of the columns'
        of, D, other = (a, D_a, D_b) if side == 0 else (b, D_b, D_a)
        F = np.empty_like(G_ab)
        transposed_product(G_ab, -other, single.T[of], n, F)
        for c in range(n):
            for d in range(n):
                dmu[c] += F[c, d] * U1[side, d]
                H[c, d] -= U_total * F[c, d] * D[d]
        add_difference(H, F, U2[side], G_ab, single.G[of], n, x, y)
    for c in range(n):
        for d in range(n):
            to.dV_dS[a, b, c, d] += (H[c, d] + H[d, c]) / 4
    for c in range(belief.inputs):
        to.dV_du[a, b, c] += controls[0, c] * D_a[R + c] + controls[1, c] * D_b[R + c]
    if not same:
        for c in range(n):
            to.dV_dmu[b, a, c] = dmu[c]
            for d in range(n):
                to.dV_dS[b, a, c, d] = to.dV_dS[a, b, c, d]
        for c in range(belief.inputs):
            to.dV_du[b, a, c] = to.dV_du[a, b, c]


@njit_inner
def moments_at(
    order, diagonal, points, inverse_squares, signal, beta, inverse_cholesky, centred, mu, S, u, M, V, J, to
):
    """M, V, J and the derivatives ``to`` of one belief."""
    widest()
    n, k, padded = len(mu), len(M), points.shape[1]
    belief = seen_from(points, mu, S, u)
    R = len(belief.nu)
    single = room(k, R, padded)
    work, left, strips = aligned_rows(R + 5, padded), aligned_rows(R, padded), aligned(strips_memory(R, padded))
    left[:] = 0.0
    G_ab, x, y, H = np.zeros((R, R)), np.zeros((R, R)), np.zeros((R, R)), np.zeros((R, R))
    V[:] = 0.0
    to.dV_dmu[:] = 0.0
    to.dV_dS[:] = 0.0
    to.dV_du[:] = 0.0
    for a in range(k):
        D = inverse_squares[a]
        M[a] = evaluate_single(belief, D, signal[a], beta[a], a, single, n)
        transposed_times(single.G[a], single.first[a], n, J[a])
        if order >= JACOBIAN:
            differentiate_mean(belief, D, a, single, n, M[a], to, work, x, y)
        if order == CROSS:
            differentiate_cross(belief, D, a, single, n, J[a], to, work)
    explained = unexplained(inverse_cholesky, single.q)
    for apart in range(0 if diagonal else k - 1, -1, -1):  # a = b last: what is explained is needed there only
        if apart == 0:
            explain_rest(explained)
        for a in range(k - apart):
            b = a + apart
            D_a, D_b = inverse_squares[a], inverse_squares[b]
            if a == b:
                V[a, a] = signal[a] - explained.totals[a]
                if order >= JACOBIAN:
                    differentiate_explained(belief, D_a, a, single, explained.solved[a], n, to, work, x, y)
            total = evaluate_pair(
                belief, D_a, D_b, a, b, single, centred[a], explained, n, order, work, left, strips, G_ab, x
            )
            V[a, b] += total
            V[b, a] = V[a, b]
            if order >= JACOBIAN:
                differentiate_pair(belief, D_a, D_b, a, b, single, n, M, total, to, work, G_ab, x, y, H)


@compiled
def moments_along(order, diagonal, points, inverse_squares, signal, beta, inverse_cholesky, centred, mu, S, u, out):
    """``moments_at`` for H beliefs: mu (H, n), S (H, n, n), u (H, m) and ten outputs with H in front."""
    widest()
    M, V, J, dM_dS, dM_du, dV_dmu, dV_dS, dV_du, dJ_dS, dJ_du = out
    for h in range(len(mu)):
        to = Derivatives(dM_dS[h], dM_du[h], dV_dmu[h], dV_dS[h], dV_du[h], dJ_dS[h], dJ_du[h])
        moments_at(
            order, diagonal, points, inverse_squares, signal, beta, inverse_cholesky, centred,
            mu[h], S[h], u[h], M[h], V[h], J[h], to,
        )  # fmt: skip
