r"""The exact moments of k GPs at uncertain states x ~ N(mu, S) and their first derivatives, with explicit vectors.

Specification: ``gpmpc.propagation._moments``, whose letters these are. (Without explicit vectors the loops take four
times as long.) With c_ai = D_a (u_i - u) of the controls and G_ab = (I + S (D_a + D_b))^-1, exponents change by

    dlog q_ai = w_ai . dmu + 1/2 <w_ai w_ai' - G_a' D_a, dS> + c_ai . du,                  w_ai = G_a' z_ai
    dlog Q_ij = y_ij . dmu + 1/2 <y_ij y_ij' - G_ab' (D_a + D_b), dS> + (c_ai + c_bj) . du,
    y_ij = y_ai + y_bj,  y_ai = G_ab' z_ai = w_ai + F_a z_ai,  F_a = G_ab' - G_a' = -G_ab' D_b G_a S
    dV_ab = sum_ij P_ij dlog Q_ij + U_ij d(log Q_ij - log q_ai - log q_bj),   P_ij = U_ij expm1(delta_ij)

with U_ij = beta_ai beta_bj q_ai q_bj, or E_ij q_ai q_aj, E = beta_a beta_a' - (K_a + sn2_a I)^-1, for a = b. One pass
over the N^2 pairs of points of a pair of outputs collects row sums p_i, column sums p_j and g_j = sum_i R_ij z_ai of

    P_ij = weight_i weight_j expm1(delta_ij),   delta_ij = rise_i + fall_j + left_i . z_bj,   left_i = T_ab z_ai

with weights beta q and R = P for a != b, where the rest of the sum is a product of single sums. For a = b the weights
are q, P_ij has the factor E_ij and runs over i >= j, and R = E q q exp(delta). Derivatives are algebra on the sums.
Four rows i meet sixteen columns j in registers: eight independent chains are what two multiply-adds per cycle with a
latency of four ask for. From delta = 300 on a pair counts for nothing, and the exponent may stay there. Where a bound
says that delta is small for all pairs, as for beliefs that are narrow beside the length-scales, expm1 needs no
reduction, a quarter of all instructions.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from gpmpc._compiled import compiled, inline_njit, njit_inner, njit_noalloc
from gpmpc._kernels._packed import GPArrays
from gpmpc._kernels._rows import (
    add_products,
    largest_size,
    largest_square,
    multiply,
    project,
    reduce_variance,
    row_sum,
    second_moments,
    transform,
)
from gpmpc._kernels._simd import (
    NEAR_ZERO,
    exp,
    expm1,
    expm1_near_zero,
    load,
    store,
    total,
    use_widest_registers,
    zeros,
)
from gpmpc._kernels.linalg import (
    add_product,
    aligned_rows,
    condition,
    congruence,
    multiply_transposed,
    product,
    symmetrize,
)


class _Belief(NamedTuple):
    """A belief, and the GPs with their points relative to its mean and input."""

    gp: GPArrays
    S: ndarray  # (n, n)
    x: ndarray  # x_i - mu (n, P)
    u: ndarray  # u_i - u (m, P)


class _OutputTerms(NamedTuple):
    """What each output has alone: vectors over the points, matrices, and sums over the points."""

    z: ndarray  # (k, n, P)
    Tz: ndarray  # T_a z_ai (k, n, P)
    q: ndarray  # (k, P)
    weighted: ndarray  # beta q (k, P)
    G: ndarray  # (k, n, n)
    T: ndarray  # (k, n, n)
    half_logdet: ndarray  # 1/2 log|I + S D_a| (k,)
    M: ndarray  # sum_i beta_i q_i (k,)
    first: ndarray  # sum_i beta_i q_i z_i (k, n)
    second: ndarray  # sum_i beta_i q_i z_i z_i' (k, n, n)
    e: ndarray  # sum_i e_i (k,), e_i = q_i [(K + sn2 I)^-1 q]_i
    e_first: ndarray  # sum_i e_i z_i (k, n)
    e_second: ndarray  # sum_i e_i z_i z_i' (k, n, n)


class _Work(NamedTuple):
    """What the sum over pairs of points reads, the sums, and memory to work in."""

    rise: ndarray  # (P,)
    fall: ndarray  # (P,)
    left: ndarray  # (n, P)
    weighted_z: ndarray  # weight_i z_i (n, P)
    p_i: ndarray  # row sums (P,)
    p_j: ndarray  # column sums (P,)
    g: ndarray  # (n, P)
    row: ndarray  # (P,)
    other: ndarray  # (P,)
    G_ab: ndarray  # (n, n), like those that follow
    F: ndarray
    x: ndarray
    y: ndarray
    H: ndarray


@compiled
def evaluate_moments(derivatives, diagonal, gp, precision, mu, S, u, out):
    """Writes the arrays of ``gpmpc._kernels.Moments`` at mu (H, n), S (H, n, n) and u (H, m).

    The arrays of ``out`` are full of zeros; those of derivatives are empty where these are not wanted.
    """
    use_widest_registers()
    (k, padded), n, m = gp.weights.shape, mu.shape[1], u.shape[1]
    rows, (terms, work) = aligned_rows(n + m, padded), _make_terms(k, n, padded)
    for h in range(len(mu)):
        belief = _Belief(gp, S[h], rows[:n], rows[n : n + m])
        for d in range(n + m):
            at = mu[h, d] if d < n else u[h, d - n]
            row = rows[d]
            point = gp.points[d]
            for j in range(padded):
                row[j] = point[j] - at
        for a in range(k):
            _evaluate_output(belief, a, terms, work)
            out.M[h, a] = terms.M[a]
            multiply_transposed(terms.G[a], terms.first[a], out.J[h, a])
            if derivatives:
                to = (out.J[h, a], out.dM_dS[h, a], out.dM_du[h, a])
                sums = (terms.first[a], terms.second[a])
                _differentiate_sum(
                    terms.weighted[a], 1.0, belief, a, terms, sums, work, to
                )
                _differentiate_J(
                    belief, a, terms, out.J[h, a], out.dJ_dS[h, a], out.dJ_du[h, a]
                )
        for a in range(k):
            reduction = reduce_variance(
                precision.inverse_cholesky[a], terms.q[a], work.row
            )
            out.V[h, a, a] = np.exp(gp.log_signal[a]) - reduction
            if derivatives:
                to = out.dV_dmu[h, a, a], out.dV_dS[h, a, a], out.dV_du[h, a, a]
                sums = terms.e_first[a], terms.e_second[a]
                multiply(
                    work.row, terms.q[a], work.row
                )  # (K_a + sn2_a I)^-1 q_a becomes e
                terms.e[a] = _differentiate_sum(
                    work.row, -2.0, belief, a, terms, sums, work, to
                )
            for b in range(a, a + 1 if diagonal else k):
                P_sum = _evaluate_pair(
                    belief, a, b, terms, precision.centred[a], derivatives, work
                )
                out.V[h, a, b] += P_sum
                out.V[h, b, a] = out.V[h, a, b]
                if derivatives:
                    to = out.dV_dmu[h, a, b], out.dV_dS[h, a, b], out.dV_du[h, a, b]
                    _differentiate_pair(belief, a, b, terms, P_sum, work, to)
                    out.dV_dmu[h, b, a], out.dV_dS[h, b, a], out.dV_du[h, b, a] = to


@njit_inner
def _make_terms(k, n, padded):
    vectors = aligned_rows(2 * k * n, padded).reshape(2, k, n, padded)
    rows = aligned_rows(2 * k, padded)
    squares = np.zeros((4, k, n, n))
    sums = np.zeros((2, k, n))
    numbers = np.zeros((3, k))
    single = (
        vectors[0],
        vectors[1],
        rows[:k],
        rows[k:],
        squares[0],
        squares[1],
        numbers[0],
        numbers[1],
    )
    terms = _OutputTerms(*single, sums[0], squares[2], numbers[2], sums[1], squares[3])
    w = aligned_rows(3 * n + 6, padded)
    square = np.empty((5, n, n))
    of_points = (
        w[0],
        w[1],
        w[6 : 6 + n],
        w[6 + n : 6 + 2 * n],
        w[2],
        w[3],
        w[6 + 2 * n :],
        w[4],
        w[5],
    )
    return terms, _Work(
        *of_points, square[0], square[1], square[2], square[3], square[4]
    )


@njit_inner
def _evaluate_output(belief, a, terms, work):
    """Fills the terms of output a, but for ``second`` and the sums over e."""
    use_widest_registers()
    gp = belief.gp
    n = len(belief.S)
    log_q = work.row
    whiten = work.x
    D = gp.inverse_squares[a, :n]
    D_u = gp.inverse_squares[a, n:]
    # log q_i = log sf2 - 1/2 log|I + S D| - 1/2 |W (x_i - mu)|^2 - 1/2 (u_i - u)' D_u (u_i - u)
    terms.half_logdet[a] = condition(belief.S, D, whiten, terms.G[a])
    log_q[:] = gp.log_signal[a] - terms.half_logdet[a]
    transform(whiten, belief.x, terms.Tz[a])
    add_products(np.full(n, -0.5), terms.Tz[a], terms.Tz[a], log_q)
    add_products(D_u * -0.5, belief.u, belief.u, log_q)
    for j in range(0, len(log_q), 8):
        store(terms.q[a], j, exp(load(log_q, j)))
    multiply(gp.weights[a], terms.q[a], terms.weighted[a])
    terms.M[a] = row_sum(terms.weighted[a])
    product(terms.G[a], belief.S, terms.T[a])
    symmetrize(terms.T[a])
    for d in range(n):
        z = terms.z[a, d]
        x = belief.x[d]
        for j in range(len(z)):
            z[j] = D[d] * x[j]
    transform(terms.T[a], terms.z[a], terms.Tz[a])
    project(terms.weighted[a], terms.z[a], terms.first[a])


@njit_noalloc
def _differentiate_sum(v, factor, belief, a, terms, sums, work, to):
    """Writes ``factor`` sum_i v_i dlog q_ai; fills the sums of v_i z_i and v_i z_i z_i', and returns that of v_i."""
    (first, second), (dmu, dS, du) = sums, to
    n = len(belief.S)
    total = row_sum(v)
    G = terms.G[a]
    D = belief.gp.inverse_squares[a]
    x = work.x
    project(v, terms.z[a], first)
    project(v, belief.u, du)
    second_moments(v, terms.z[a], work.other, second)
    congruence(G, second, work.y, x)
    multiply_transposed(G, first, dmu)
    for c in range(n):
        dmu[c] *= factor
        for d in range(c + 1):
            value = (
                factor
                * (x[c, d] + x[d, c] - total * (G[d, c] * D[d] + G[c, d] * D[c]))
                / 4
            )
            dS[c, d] = dS[d, c] = value
    for c in range(len(du)):
        du[c] *= factor * D[n + c]
    return total


@njit_inner
def _differentiate_J(belief, a, terms, J, dJ_dS, dJ_du):
    """dJ/dS = 1/2 sum beta q (w w w - three times G'D with w), dJ/du = sum beta q w c'."""
    (n, padded), G, D = belief.x.shape, terms.G[a], belief.gp.inverse_squares[a]
    w = aligned_rows(n, padded)
    work = aligned_rows(2, padded)
    sums = np.empty(n)
    A = np.empty((n, n))
    for c in range(n):
        for d in range(n):
            A[c, d] = G[d, c] * D[d]
    transform(np.ascontiguousarray(G.T), terms.z[a], w)
    for c in range(n):
        multiply(terms.weighted[a], w[c], work[0])
        project(work[0], belief.u, dJ_du[c])
        for d in range(len(belief.u)):
            dJ_du[c, d] *= D[n + d]
        for d in range(c + 1):
            multiply(work[0], w[d], work[1])
            project(work[1], w, sums)
            for e in range(d + 1):
                value = (sums[e] - A[c, d] * J[e] - A[c, e] * J[d] - A[d, e] * J[c]) / 2
                dJ_dS[c, d, e] = dJ_dS[c, e, d] = dJ_dS[d, c, e] = value
                dJ_dS[d, e, c] = dJ_dS[e, c, d] = dJ_dS[e, d, c] = value


@njit_inner
def _evaluate_pair(belief, a, b, terms, E, derivatives, work):
    """Returns sum_ij P_ij; its parts go to ``work``, and so does G_ab."""
    gp = belief.gp
    n = len(belief.S)
    T_ab = work.F
    whiten = work.x
    D_a = gp.inverse_squares[a, :n]
    D_b = gp.inverse_squares[b, :n]
    r = (
        terms.half_logdet[a]
        + terms.half_logdet[b]
        - condition(belief.S, D_a + D_b, whiten, work.G_ab)
    )
    product(work.G_ab, belief.S, T_ab)
    symmetrize(T_ab)
    # rise_i = r - 1/2 z_ai' T_ab D_b T_a z_ai,   fall_j = -1/2 z_bj' T_ab D_a T_b z_bj
    work.fall[:] = 0.0
    transform(T_ab, terms.z[b], work.left)
    add_products(D_a * -0.5, work.left, terms.Tz[b], work.fall)
    work.rise[:] = r
    transform(T_ab, terms.z[a], work.left)
    add_products(D_b * -0.5, work.left, terms.Tz[a], work.rise)
    weights_i, weights_j = (
        (terms.q[a], terms.q[b]) if a == b else (terms.weighted[a], terms.weighted[b])
    )
    for d in range(n):
        multiply(weights_i, terms.z[a, d], work.weighted_z[d])
    across = math.sqrt(
        largest_square(work.left) * largest_square(terms.z[b])
    )  # Cauchy and Schwarz
    near = largest_size(work.rise) + largest_size(work.fall) + across <= NEAR_ZERO
    _sum_pairs(
        gp.size, a == b, near, derivatives, work, (weights_i, weights_j), terms.z[b], E
    )
    multiply(work.p_i, weights_i, work.p_i)
    multiply(work.p_j, weights_j, work.p_j)
    if derivatives:
        for d in range(n):
            multiply(work.g[d], weights_j, work.g[d])
    return row_sum(work.p_j)


@njit_noalloc
def _sum_pairs(size, same, near, derivatives, work, weights, z, E):
    """Writes the sums over i and j of ``work`` before they are multiplied by the weight of their own point."""
    use_widest_registers()
    (n, padded), (weights_i, weights_j) = z.shape, weights
    work.p_j[:] = 0.0
    if derivatives:
        work.p_i[:] = 0.0
        work.g[:] = 0.0
    at = 0
    for i in range(0, size, 4):
        w0 = weights_i[i]
        w1 = weights_i[i + 1]
        w2 = weights_i[i + 2]
        w3 = weights_i[i + 3]
        s0 = s1 = s2 = s3 = zeros()
        for j in range(0, i // 16 * 16 + 16 if same else padded, 16):
            P = _expm1_of_block(near, work.rise, work.fall, work.left, z, i, j)
            if same:
                R, P = _multiply_block(P, E, at)
                at += 64
            else:
                R = P
            (a0, b0), (a1, b1), (a2, b2), (a3, b3) = P
            store(
                work.p_j, j, load(work.p_j, j) + w0 * a0 + w1 * a1 + w2 * a2 + w3 * a3
            )
            store(
                work.p_j,
                j + 8,
                load(work.p_j, j + 8) + w0 * b0 + w1 * b1 + w2 * b2 + w3 * b3,
            )
            if derivatives:
                u = load(weights_j, j)
                v = load(weights_j, j + 8)
                s0 = s0 + a0 * u + b0 * v
                s1 = s1 + a1 * u + b1 * v
                s2 = s2 + a2 * u + b2 * v
                s3 = s3 + a3 * u + b3 * v
                (a0, b0), (a1, b1), (a2, b2), (a3, b3) = R
                for d in range(n):
                    g = work.g[d]
                    y = work.weighted_z[d]
                    y0 = y[i]
                    y1 = y[i + 1]
                    y2 = y[i + 2]
                    y3 = y[i + 3]
                    store(g, j, load(g, j) + y0 * a0 + y1 * a1 + y2 * a2 + y3 * a3)
                    store(
                        g, j + 8, load(g, j + 8) + y0 * b0 + y1 * b1 + y2 * b2 + y3 * b3
                    )
        if derivatives:
            work.p_i[i] = total(s0)
            work.p_i[i + 1] = total(s1)
            work.p_i[i + 2] = total(s2)
            work.p_i[i + 3] = total(s3)


@inline_njit
def _expm1_of_block(near, rise, fall, left, z, i, j):
    """expm1(delta) of the rows from i and the columns from j on."""
    a = load(fall, j)
    b = load(fall, j + 8)
    a0 = a + rise[i]
    a1 = a + rise[i + 1]
    a2 = a + rise[i + 2]
    a3 = a + rise[i + 3]
    b0 = b + rise[i]
    b1 = b + rise[i + 1]
    b2 = b + rise[i + 2]
    b3 = b + rise[i + 3]
    for d in range(len(z)):
        a = load(z[d], j)
        b = load(z[d], j + 8)
        x = left[d]
        a0 = a0 + x[i] * a
        a1 = a1 + x[i + 1] * a
        a2 = a2 + x[i + 2] * a
        a3 = a3 + x[i + 3] * a
        b0 = b0 + x[i] * b
        b1 = b1 + x[i + 1] * b
        b2 = b2 + x[i + 2] * b
        b3 = b3 + x[i + 3] * b
    if near:
        a0 = expm1_near_zero(a0)
        a1 = expm1_near_zero(a1)
        a2 = expm1_near_zero(a2)
        a3 = expm1_near_zero(a3)
        b0 = expm1_near_zero(b0)
        b1 = expm1_near_zero(b1)
        b2 = expm1_near_zero(b2)
        b3 = expm1_near_zero(b3)
    else:
        a0 = expm1(a0)
        a1 = expm1(a1)
        a2 = expm1(a2)
        a3 = expm1(a3)
        b0 = expm1(b0)
        b1 = expm1(b1)
        b2 = expm1(b2)
        b3 = expm1(b3)
    return (a0, b0), (a1, b1), (a2, b2), (a3, b3)


@inline_njit
def _multiply_block(values, E, at):
    """E exp(delta) and E expm1(delta), from expm1(delta); ``at`` is where E of these rows and columns stands."""
    (a0, b0), (a1, b1), (a2, b2), (a3, b3) = values
    e0 = load(E, at)
    e1 = load(E, at + 16)
    e2 = load(E, at + 32)
    e3 = load(E, at + 48)
    f0 = load(E, at + 8)
    f1 = load(E, at + 24)
    f2 = load(E, at + 40)
    f3 = load(E, at + 56)
    a0 = a0 * e0
    a1 = a1 * e1
    a2 = a2 * e2
    a3 = a3 * e3
    b0 = b0 * f0
    b1 = b1 * f1
    b2 = b2 * f2
    b3 = b3 * f3
    P = (a0, b0), (a1, b1), (a2, b2), (a3, b3)
    return (
        (a0 + e0, b0 + f0),
        (a1 + e1, b1 + f1),
        (a2 + e2, b2 + f2),
        (a3 + e3, b3 + f3),
    ), P


@njit_inner
def _differentiate_pair(belief, a, b, terms, P_sum, work, to):
    """Adds the derivatives of the pair's sum to those of V_ab."""
    dmu, dS, du = to
    n = len(belief.S)
    same = a == b
    G_ab = work.G_ab
    x = work.x
    y = work.y
    H = work.H
    D_a = belief.gp.inverse_squares[a]
    D_b = belief.gp.inverse_squares[b]
    sums = np.empty((2, n))
    controls = np.empty((2, len(du)))
    # y = sum_ij P_ij (z_ai + z_bj) (z_ai + z_bj)' + U_ij (z_ai z_bj' + z_bj z_ai')
    second_moments(work.p_i, terms.z[a], work.row, x)
    second_moments(work.p_j, terms.z[b], work.row, y)
    for c in range(n):
        project(work.g[c], terms.z[b], H[c])
        for d in range(n if not same else 0):  # in g of a = b is R, not P
            H[c, d] += terms.first[a, c] * terms.first[b, d]
    for c in range(n):
        for d in range(n):
            y[c, d] += x[c, d] + H[c, d] + H[d, c]
    congruence(G_ab, y, x, H)
    # dmu: sum_ij P_ij y_ij
    project(work.p_i, terms.z[a], sums[0])
    project(work.p_j, terms.z[b], sums[1])
    for c in range(n):
        sums[0, c] += sums[1, c]
    multiply_transposed(G_ab, sums[0], sums[1])
    for c in range(n):
        dmu[c] += sums[1, c]
        for d in range(n):
            H[c, d] -= P_sum * G_ab[d, c] * (D_a[d] + D_b[d])
    # U_ij = beta_ai beta_bj q_ai q_bj, or E_ij q_ai q_aj: what F_a and F_b make of the sums of each output alone
    e_share = 1.0 if same else 0.0
    U_sum = terms.M[a] * terms.M[b] - e_share * terms.e[a]
    _add_difference((dmu, H), terms, a, U_sum, terms.M[b], e_share, (D_a, D_b), work)
    _add_difference((dmu, H), terms, b, U_sum, terms.M[a], e_share, (D_b, D_a), work)
    project(work.p_i, belief.u, controls[0])
    project(work.p_j, belief.u, controls[1])
    for c in range(len(du)):
        du[c] += controls[0, c] * D_a[n + c] + controls[1, c] * D_b[n + c]
    for c in range(n):
        for d in range(c + 1):
            value = dS[c, d] + (H[c, d] + H[d, c]) / 4
            dS[c, d] = dS[d, c] = value


@njit_noalloc
def _add_difference(to, terms, a, U_sum, M, e_share, scales, work):
    """Adds sum_i U_i F z_i to dmu and sum_i U_i (y_i y_i' - w_i w_i') - sum_ij U_ij F D to dS, F = G_ab' - G_a'.

    U_i = sum_j U_ij = M beta_i q_i - e_share e_i, y_i = G_ab' z_i, w_i = G_a' z_i.
    """
    (dmu, dS), (D, D_other) = to, scales
    F = work.F
    moment = work.y
    x = work.x
    G_a = terms.G[a]
    G_ab = work.G_ab
    n = len(F)
    for c in range(n):
        for d in range(n):
            F[c, d] = 0.0
            for e in range(n):
                F[c, d] -= G_ab[e, c] * D_other[e] * terms.T[a, e, d]
            moment[c, d] = M * terms.second[a, c, d] - e_share * terms.e_second[a, c, d]
    for c in range(n):
        for d in range(n):
            dmu[c] += F[c, d] * (M * terms.first[a, d] - e_share * terms.e_first[a, d])
            dS[c, d] -= U_sum * F[c, d] * D[d]
    # G_ab' X G_ab - G_a' X G_a = F X G_ab + (F X G_a)'
    product(F, moment, x)
    add_product(x, G_ab, dS)
    product(x, G_a, moment)
    for c in range(n):
        for d in range(n):
            dS[c, d] += moment[d, c]
