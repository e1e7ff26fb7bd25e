r"""The exact moments of k GPs at uncertain states x ~ N(mu, S) and their derivatives.

The specification is ``gpmpc.propagation._moments``: its letters are used here, and its
equations (1) to (7). Loops run over explicit vectors; without these they take four
times as long. With c_ai = D_a (u_i - u) of the controls and G_ab = (I + S (D_a +
D_b))^-1, exponents change by

    (8)   dlog q_ai = w_ai . dmu + 1/2 <w_ai w_ai' - G_a' D_a, dS> + c_ai . du
          w_ai = G_a' z_ai
    (9)   dlog Q_ij = y_ij . dmu + 1/2 <y_ij y_ij' - G_ab' (D_a + D_b), dS>
                      + (c_ai + c_bj) . du
          y_ij = y_ai + y_bj,   y_ai = G_ab' z_ai = w_ai + F_a z_ai
    (10)  F_a = G_ab' - G_a' = -G_ab' D_b G_a S
    (11)  dV_ab = sum_ij P_ij dlog Q_ij + U_ij d(log Q_ij - log q_ai - log q_bj)
          P_ij = U_ij expm1(delta_ij)

with U_ij = beta_ai beta_bj q_ai q_bj, or E_ij q_ai q_aj, E = beta_a beta_a' - (K_a +
sn2_a I)^-1, for a = b. The rest of dV_aa is that of -|L_a^-1 q_a|^2: (8) with the
weights -2 e_i, e_i = q_i [(K + sn2 I)^-1 q]_i. ``_pair_sums`` takes one pass over the
N^2 pairs of points of a pair of outputs, from which derivatives are algebra on sums.

``padded`` is the number of points, padded. D_a is the matrix of the n states, D_u that
of the m controls. Of one output with itself U has the factor E, so that its sums are
those of beta q less those of e; of two outputs those of e count with the factor zero.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from gpmpc._compiled import compiled, njit_inner, njit_noalloc
from gpmpc._kernels._packed import GPArrays
from gpmpc._kernels._pair_sums import allocate_pair_terms, sum_pairs
from gpmpc._kernels._rows import (
    add_products,
    multiply_entries,
    project,
    row_sum,
    second_moments,
    transform,
    variance_reduction_by_inverse,
)
from gpmpc._kernels._simd import exp, load, store, use_widest_registers
from gpmpc._kernels.linalg import (
    add_product,
    aligned_rows,
    congruence,
    invert_identity_plus,
    multiply_transposed,
    product,
    symmetrize,
)


class _CentredGPs(NamedTuple):
    """GPs whose points are centred at a belief N(mu, S) and an input u."""

    gp: GPArrays
    S: ndarray  # (n, n)
    nu: ndarray  # x_i - mu (n, padded)
    input_differences: ndarray  # u_i - u (m, padded)


class _CompiledTerms(NamedTuple):
    """Terms of single outputs: vectors over the points, matrices, and sums."""

    z: ndarray  # (k, n, padded)
    Tz: ndarray  # T_a z_ai; before, |W nu_i|^2 is made here (k, n, padded)
    q: ndarray  # (k, padded)
    precision_q: ndarray  # (K_a + sn2_a I)^-1 q_a (k, padded)
    weighted: ndarray  # beta q (k, padded)
    G: ndarray  # (k, n, n)
    T: ndarray  # (k, n, n)
    half_logdet: ndarray  # 1/2 log|I + S D_a| (k,)
    M: ndarray  # sum_i beta_i q_i (k,)
    first: ndarray  # sum_i beta_i q_i z_i (k, n)
    second: ndarray  # sum_i beta_i q_i z_i z_i' (k, n, n)
    e: ndarray  # sum_i e_i (k,), e_i = q_i [(K + sn2 I)^-1 q]_i
    e_first: ndarray  # sum_i e_i z_i (k, n)
    e_second: ndarray  # sum_i e_i z_i z_i' (k, n, n)


class _Scratch(NamedTuple):
    """Memory to work in.

    Only G_ab outlives a call: derivatives of a pair read that of its moments. Each
    function below writes ``row``, ``other_row``, X and Y before it reads them, and
    ``_add_difference`` F.
    """

    row: ndarray  # (padded,)
    other_row: ndarray  # (padded,)
    G_ab: ndarray  # of the pair of outputs (n, n)
    T_ab: ndarray  # G_ab S (n, n), like those that follow
    F: ndarray  # of (10)
    X: ndarray
    Y: ndarray
    cross: ndarray
    twice_dS: ndarray


class _Gradient(NamedTuple):
    """Derivatives of one moment by the belief and the input."""

    dmu: ndarray  # (n,)
    dS: ndarray  # symmetric (n, n)
    du: ndarray  # (m,)


@compiled
def evaluate_moments(gp, factors, mu, S, u, diagonal, derivatives, out):
    """Writes ``gpmpc._kernels.Moments`` at mu (H, n), S (H, n, n) and u (H, m).

    The arrays of ``out`` are full of zeros; those of derivatives are empty where these
    are not wanted.
    """
    use_widest_registers()
    k, padded = gp.weights.shape
    n = mu.shape[1]
    m = u.shape[1]
    points = aligned_rows(n + m, padded)
    terms = _allocate_output_terms(k, n, padded)
    pair = allocate_pair_terms(n, padded)
    scratch = _allocate_scratch(n, padded)
    for h in range(len(mu)):
        centred = _CentredGPs(
            gp=gp, S=S[h], nu=points[:n], input_differences=points[n : n + m]
        )
        _centre_points(gp.points, mu[h], u[h], points)
        _clear_sums_over_e(terms)
        for a in range(k):
            _evaluate_output(centred, a, terms, scratch)
            out.M[h, a] = terms.M[a]
            multiply_transposed(terms.G[a], terms.first[a], out.J[h, a])
            if derivatives:
                _differentiate_mean(centred, a, h, terms, scratch, out)
        for a in range(k):
            out.V[h, a, a] = _evaluate_variance(gp, factors, a, terms)
            if derivatives:
                _differentiate_variance(centred, a, h, terms, scratch, out)
            for b in range(a, a + 1 if diagonal else k):
                P_sum = _evaluate_pair(
                    centred,
                    a,
                    b,
                    terms,
                    E=factors.doubled_E[a],
                    derivatives=derivatives,
                    pair=pair,
                    scratch=scratch,
                )
                out.V[h, a, b] += P_sum
                out.V[h, b, a] = out.V[h, a, b]
                if derivatives:
                    gradient = _Gradient(
                        dmu=out.dV_dmu[h, a, b],
                        dS=out.dV_dS[h, a, b],
                        du=out.dV_du[h, a, b],
                    )
                    _differentiate_pair(
                        centred, a, b, terms, P_sum, pair, scratch, gradient
                    )
                    out.dV_dmu[h, b, a] = gradient.dmu
                    out.dV_dS[h, b, a] = gradient.dS
                    out.dV_du[h, b, a] = gradient.du


@njit_inner
def _allocate_output_terms(k, n, padded):
    return _CompiledTerms(
        z=aligned_rows(k * n, padded).reshape(k, n, padded),
        Tz=aligned_rows(k * n, padded).reshape(k, n, padded),
        q=aligned_rows(k, padded),
        precision_q=aligned_rows(k, padded),
        weighted=aligned_rows(k, padded),
        G=np.zeros((k, n, n)),
        T=np.zeros((k, n, n)),
        half_logdet=np.zeros(k),
        M=np.zeros(k),
        first=np.zeros((k, n)),
        second=np.zeros((k, n, n)),
        e=np.zeros(k),
        e_first=np.zeros((k, n)),
        e_second=np.zeros((k, n, n)),
    )


@njit_noalloc
def _clear_sums_over_e(terms):
    """Writes zeros to the sums over e, which are filled output by output.

    Pairs with an output to come read them with the factor zero, which would not stop
    NaN of the point before.
    """
    terms.e[:] = 0.0
    terms.e_first[:] = 0.0
    terms.e_second[:] = 0.0


@njit_inner
def _allocate_scratch(n, padded):
    return _Scratch(
        row=aligned_rows(1, padded)[0],
        other_row=aligned_rows(1, padded)[0],
        G_ab=np.empty((n, n)),
        T_ab=np.empty((n, n)),
        F=np.empty((n, n)),
        X=np.empty((n, n)),
        Y=np.empty((n, n)),
        cross=np.empty((n, n)),
        twice_dS=np.empty((n, n)),
    )


@njit_noalloc
def _centre_points(points, mu, u, centred):
    """Writes x_i - mu and u_i - u (n + m, padded)."""
    n = len(mu)
    for d in range(len(centred)):
        centre = mu[d] if d < n else u[d - n]
        row = centred[d]
        point = points[d]
        for j in range(len(row)):
            row[j] = point[j] - centre


@njit_inner
def _evaluate_output(centred, a, terms, scratch):
    """Fills the terms of output a, but for ``precision_q``, ``second``, sums over e.

    q is E[k_a(x~_i, x~)]; M holds (1), and G' first is J, (2).
    """
    use_widest_registers()
    gp = centred.gp
    n = len(centred.S)
    log_q = scratch.row
    whiten = scratch.X
    D = gp.inverse_squares[a, :n]
    D_u = gp.inverse_squares[a, n:]
    whitened = terms.Tz[a]  # W nu_i, until T_a z_ai takes its place
    # log q_i = log sf2 - 1/2 log|I + S D| - 1/2 |W nu_i|^2
    #           - 1/2 (u_i - u)' D_u (u_i - u)
    terms.half_logdet[a] = invert_identity_plus(centred.S, D, whiten, terms.G[a])
    log_q[:] = gp.log_signal[a] - terms.half_logdet[a]
    transform(whiten, centred.nu, whitened)
    add_products(np.full(n, -0.5), whitened, whitened, log_q)
    add_products(
        D_u * -0.5, centred.input_differences, centred.input_differences, log_q
    )
    for j in range(0, len(log_q), 8):
        store(terms.q[a], j, exp(load(log_q, j)))
    multiply_entries(gp.weights[a], terms.q[a], terms.weighted[a])
    terms.M[a] = row_sum(terms.weighted[a])
    product(terms.G[a], centred.S, terms.T[a])
    symmetrize(terms.T[a])
    for d in range(n):
        z = terms.z[a, d]
        nu = centred.nu[d]
        for j in range(len(z)):
            z[j] = D[d] * nu[j]
    transform(terms.T[a], terms.z[a], terms.Tz[a])
    project(terms.weighted[a], terms.z[a], terms.first[a])


@njit_inner
def _differentiate_mean(centred, a, h, terms, scratch, out):
    """Writes the derivatives of M_a and J_a at point h: (8) with the weights beta q.

    The derivative of M_a by the mean is J_a: the sum writes it once more, and ``first``
    of the terms as well, both the same numbers again.
    """
    _differentiate_sum(
        v=terms.weighted[a],
        factor=1.0,
        centred=centred,
        a=a,
        terms=terms,
        scratch=scratch,
        first=terms.first[a],
        second=terms.second[a],
        gradient=_Gradient(dmu=out.J[h, a], dS=out.dM_dS[h, a], du=out.dM_du[h, a]),
    )
    _differentiate_J(centred, a, terms, out.J[h, a], out.dJ_dS[h, a], out.dJ_du[h, a])


@njit_noalloc
def _evaluate_variance(gp, factors, a, terms):
    """Returns sf2_a - |L_a^-1 q_a|^2 of (4); fills ``precision_q`` of the terms."""
    reduction = variance_reduction_by_inverse(
        factors.inverse_cholesky[a], terms.q[a], terms.precision_q[a]
    )
    return np.exp(gp.log_signal[a]) - reduction


@njit_noalloc
def _differentiate_variance(centred, a, h, terms, scratch, out):
    """Writes the derivatives of -|L_a^-1 q_a|^2 at point h: (8) with weights -2 e."""
    e = scratch.row
    multiply_entries(terms.precision_q[a], terms.q[a], e)
    terms.e[a] = _differentiate_sum(
        v=e,
        factor=-2.0,
        centred=centred,
        a=a,
        terms=terms,
        scratch=scratch,
        first=terms.e_first[a],
        second=terms.e_second[a],
        gradient=_Gradient(
            dmu=out.dV_dmu[h, a, a], dS=out.dV_dS[h, a, a], du=out.dV_du[h, a, a]
        ),
    )


@njit_noalloc
def _differentiate_sum(v, factor, centred, a, terms, scratch, first, second, gradient):
    """Writes ``factor`` sum_i v_i dlog q_ai, by (8), and returns sum_i v_i.

    Fills the sums ``first`` of v_i z_i and ``second`` of v_i z_i z_i'.
    """
    dmu = gradient.dmu
    dS = gradient.dS
    du = gradient.du
    n = len(centred.S)
    v_sum = row_sum(v)
    G = terms.G[a]
    D = centred.gp.inverse_squares[a, :n]
    D_u = centred.gp.inverse_squares[a, n:]
    X = scratch.X  # sum_i v_i w_i w_i'
    project(v, terms.z[a], first)
    project(v, centred.input_differences, du)
    second_moments(v, terms.z[a], scratch.other_row, second)
    congruence(G, second, scratch.Y, X)
    multiply_transposed(G, first, dmu)
    for c in range(n):
        dmu[c] *= factor
        for d in range(c + 1):
            twice_G_D = G[d, c] * D[d] + G[c, d] * D[c]  # of the symmetric G' D
            value = factor * (X[c, d] + X[d, c] - v_sum * twice_G_D) / 4
            dS[c, d] = dS[d, c] = value
    for c in range(len(du)):
        du[c] *= factor * D_u[c]
    return v_sum


@njit_inner
def _differentiate_J(centred, a, terms, J, dJ_dS, dJ_du):
    """Writes the derivatives of J = sum_i beta_i q_i w_i, (8) once more.

    dJ/dS = 1/2 sum beta q (w w w - three times G'D with w), dJ/du = sum beta q w c'.
    """
    n, padded = centred.nu.shape
    G = terms.G[a]
    D = centred.gp.inverse_squares[a, :n]
    D_u = centred.gp.inverse_squares[a, n:]
    w = aligned_rows(n, padded)
    weighted_w = aligned_rows(1, padded)[0]
    weighted_ww = aligned_rows(1, padded)[0]
    sums = np.empty(n)
    G_D = np.empty((n, n))  # G' D
    for c in range(n):
        for d in range(n):
            G_D[c, d] = G[d, c] * D[d]
    transform(np.ascontiguousarray(G.T), terms.z[a], w)
    for c in range(n):
        multiply_entries(terms.weighted[a], w[c], weighted_w)
        project(weighted_w, centred.input_differences, dJ_du[c])
        for d in range(len(centred.input_differences)):
            dJ_du[c, d] *= D_u[d]
        for d in range(c + 1):
            multiply_entries(weighted_w, w[d], weighted_ww)
            project(weighted_ww, w, sums)
            for e in range(d + 1):
                value = (
                    sums[e] - G_D[c, d] * J[e] - G_D[c, e] * J[d] - G_D[d, e] * J[c]
                ) / 2
                dJ_dS[c, d, e] = dJ_dS[c, e, d] = dJ_dS[d, c, e] = value
                dJ_dS[d, e, c] = dJ_dS[e, c, d] = dJ_dS[e, d, c] = value


@njit_inner
def _evaluate_pair(centred, a, b, terms, E, derivatives, pair, scratch):
    """Returns sum_ij P_ij of (4); fills the terms of the pair, and G_ab.

    ``E`` is read for a = b alone. delta_ij = delta_i + delta_j + (T_ab z_ai) . z_bj is
    (5), with r of (6).
    """
    gp = centred.gp
    n = len(centred.S)
    T_ab = scratch.T_ab
    D_a = gp.inverse_squares[a, :n]
    D_b = gp.inverse_squares[b, :n]
    r = terms.half_logdet[a] + terms.half_logdet[b]
    r -= invert_identity_plus(centred.S, D_a + D_b, scratch.X, scratch.G_ab)
    product(scratch.G_ab, centred.S, T_ab)
    symmetrize(T_ab)
    pair.delta_j[:] = 0.0
    transform(T_ab, terms.z[b], pair.T_z)
    add_products(D_a * -0.5, pair.T_z, terms.Tz[b], pair.delta_j)
    pair.delta_i[:] = r
    transform(T_ab, terms.z[a], pair.T_z)
    add_products(D_b * -0.5, pair.T_z, terms.Tz[a], pair.delta_i)
    same = a == b
    weights_i = terms.q[a] if same else terms.weighted[a]
    weights_j = terms.q[b] if same else terms.weighted[b]
    return sum_pairs(
        pair=pair,
        weights_i=weights_i,
        weights_j=weights_j,
        z_a=terms.z[a],
        z_b=terms.z[b],
        E=E,
        size=gp.size,
        same=same,
        derivatives=derivatives,
    )


@njit_inner
def _differentiate_pair(centred, a, b, terms, P_sum, pair, scratch, gradient):
    """Adds the derivatives of sum_ij P_ij to those of V_ab, by (11)."""
    dmu = gradient.dmu
    dS = gradient.dS
    du = gradient.du
    n = len(centred.S)
    same = a == b
    G_ab = scratch.G_ab
    X = scratch.X
    Y = scratch.Y
    cross = scratch.cross  # sum_ij (P_ij + U_ij) z_ai z_bj'
    twice_dS = scratch.twice_dS  # twice the derivative by S, not yet symmetric
    D_a = centred.gp.inverse_squares[a, :n]
    D_b = centred.gp.inverse_squares[b, :n]
    D_ua = centred.gp.inverse_squares[a, n:]
    D_ub = centred.gp.inverse_squares[b, n:]
    sums = np.empty((2, n))
    controls = np.empty((2, len(du)))
    # Y = sum_ij P_ij (z_ai + z_bj) (z_ai + z_bj)' + U_ij (z_ai z_bj' + z_bj z_ai')
    second_moments(pair.p_i, terms.z[a], scratch.row, X)
    second_moments(pair.p_j, terms.z[b], scratch.row, Y)
    _write_cross_moment(pair, terms, a, b, cross)
    for c in range(n):
        for d in range(n):
            Y[c, d] += X[c, d] + cross[c, d] + cross[d, c]
    congruence(G_ab, Y, X, twice_dS)
    # dmu: sum_ij P_ij y_ij
    project(pair.p_i, terms.z[a], sums[0])
    project(pair.p_j, terms.z[b], sums[1])
    for c in range(n):
        sums[0, c] += sums[1, c]
    multiply_transposed(G_ab, sums[0], sums[1])
    for c in range(n):
        dmu[c] += sums[1, c]
        for d in range(n):
            twice_dS[c, d] -= P_sum * G_ab[d, c] * (D_a[d] + D_b[d])
    # U_ij = beta_ai beta_bj q_ai q_bj, or E_ij q_ai q_aj: F_a and F_b times the sums of
    # each output alone
    e_factor = 1.0 if same else 0.0
    U_sum = terms.M[a] * terms.M[b] - e_factor * terms.e[a]
    _add_difference(
        terms=terms,
        a=a,
        D=D_a,
        D_other=D_b,
        U_sum=U_sum,
        M_other=terms.M[b],
        e_factor=e_factor,
        scratch=scratch,
        dmu=dmu,
        twice_dS=twice_dS,
    )
    _add_difference(
        terms=terms,
        a=b,
        D=D_b,
        D_other=D_a,
        U_sum=U_sum,
        M_other=terms.M[a],
        e_factor=e_factor,
        scratch=scratch,
        dmu=dmu,
        twice_dS=twice_dS,
    )
    project(pair.p_i, centred.input_differences, controls[0])
    project(pair.p_j, centred.input_differences, controls[1])
    for c in range(len(du)):
        du[c] += controls[0, c] * D_ua[c] + controls[1, c] * D_ub[c]
    for c in range(n):
        for d in range(c + 1):
            value = dS[c, d] + (twice_dS[c, d] + twice_dS[d, c]) / 4
            dS[c, d] = dS[d, c] = value


@njit_noalloc
def _write_cross_moment(pair, terms, a, b, cross):
    """Writes sum_ij (P_ij + U_ij) z_ai z_bj'.

    For a = b the pass over the points has summed both. For a != b it has summed P, and
    U is the product of beta_ai q_ai and beta_bj q_bj, whose sums there are.
    """
    n = len(cross)
    for c in range(n):
        project(pair.g[c], terms.z[b], cross[c])
        if a != b:
            for d in range(n):
                cross[c, d] += terms.first[a, c] * terms.first[b, d]


@njit_noalloc
def _add_difference(
    terms, a, D, D_other, U_sum, M_other, e_factor, scratch, dmu, twice_dS
):
    """Adds the part of output a in the second term of (11), with F = F_a of (10).

    To dmu it adds sum_i U_i F z_i, to twice dS sum_i U_i (y_i y_i' - w_i w_i') - sum_ij
    U_ij F D, where y_i = G_ab' z_i, w_i = G_a' z_i and U_i = sum_j U_ij = M_other
    beta_i q_i - e_factor e_i. The factor is zero for two different outputs, of which
    the sums over e may not be there yet.
    """
    F = scratch.F
    moment = scratch.Y
    X = scratch.X
    G_a = terms.G[a]
    G_ab = scratch.G_ab
    n = len(F)
    for c in range(n):
        for d in range(n):
            F[c, d] = 0.0
            for e in range(n):
                F[c, d] -= G_ab[e, c] * D_other[e] * terms.T[a, e, d]
            moment[c, d] = (
                M_other * terms.second[a, c, d] - e_factor * terms.e_second[a, c, d]
            )
    for c in range(n):
        for d in range(n):
            first = M_other * terms.first[a, d] - e_factor * terms.e_first[a, d]
            dmu[c] += F[c, d] * first
            twice_dS[c, d] -= U_sum * F[c, d] * D[d]
    # G_ab' X G_ab - G_a' X G_a = F X G_ab + (F X G_a)'
    product(F, moment, X)
    add_product(X, G_ab, twice_dS)
    product(X, G_a, moment)
    for c in range(n):
        for d in range(n):
            twice_dS[c, d] += moment[d, c]
