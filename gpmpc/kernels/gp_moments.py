r"""The exact moments of k GPs at uncertain states x ~ N(mu, S) and their first derivatives: the specification.

Letters as in ``gpmpc.propagation.moment_matching``: D_a = 1 / l_a^2 of the states, z_ai = D_a (x_i - mu),

    G_a  = (I + S D_a)^-1                q_ai = E[k_a(x, x_i)]
    G_ab = (I + S (D_a + D_b))^-1        Q_ij = E[k_a(x, x_i) k_b(x, x_j)] = q_ai q_bj exp(delta_ij)

    M_a  = sum_i beta_ai q_ai
    V_ab = sum_ij beta_ai beta_bj q_ai q_bj expm1(delta_ij)                       for a != b
    V_aa = sf2_a - q_a' (K_a + sn2_a I)^-1 q_a + sum_ij E_ij q_ai q_aj expm1(delta_ij),
    E    = beta_a beta_a' - (K_a + sn2_a I)^-1

With J = E[df/dx] = dM/dmu (Stein, 1981) Cov[x, f] = S J', and dM/dS = 1/2 d2M/dmu2 (Price, 1958). Exponents change by

    dlog q_ai = w_ai . dmu + 1/2 <w_ai w_ai' - G_a' D_a, dS> + c_ai . du,                  w_ai = G_a' z_ai
    dlog Q_ij = y_ij . dmu + 1/2 <y_ij y_ij' - G_ab' (D_a + D_b), dS> + (c_ai + c_bj) . du,
    y_ij = y_ai + y_bj,  y_ai = G_ab' z_ai = w_ai + f_ai,  f_ai = F_a z_ai,  F_a = G_ab' - G_a' = -G_ab' D_b G_a S

The sums are written as they stand here: one pair of points after the other, in arrays that no cache plan has touched.
``gpmpc.kernels.gp_moments_simd`` computes the same behind the same signature, some fifty times faster.
"""

import math

import numpy as np

from gpmpc.compiled import compiled, njit_inner
from gpmpc.kernels.linalg import condition

VALUE, JACOBIAN, CROSS = 0, 1, 2  # derivatives of nothing, of M and V, of J as well


@compiled
def evaluate_moments(order, diagonal, gp, precision, mu, S, u, out):
    """Writes the arrays of ``gpmpc.kernels.Moments`` at H beliefs.

    Args:
        order: ``VALUE``, ``JACOBIAN`` or ``CROSS``.
        diagonal: Leaves the covariances between outputs at zero.
        gp: ``GPArrays``.
        precision: (K_a + sn2_a I)^-1 (k, N, N).
        mu: (H, n).
        S: (H, n, n).
        u: (H, m).
        out: The arrays, full of zeros; empty where ``order`` does not ask for them.
    """
    n, k, N = mu.shape[1], len(gp.weights), gp.size
    whiten, G_ab = np.empty((n, n)), np.empty((n, n))
    for h in range(len(mu)):
        x = np.ascontiguousarray(gp.points[:n, :N].T) - mu[h]
        v = np.ascontiguousarray(gp.points[n:, :N].T) - u[h]
        z, w, c = np.empty((k, N, n)), np.empty((k, N, n)), np.empty((k, N, len(u[h])))
        q, G, half_logdet = np.empty((k, N)), np.empty((k, n, n)), np.empty(k)
        for a in range(k):
            D, D_u = gp.inverse_squares[a, :n], gp.inverse_squares[a, n:]
            # log q_ai = log sf2 - 1/2 log|I + S D| - 1/2 (x_i - mu)' D G (x_i - mu) - 1/2 (u_i - u)' D_u (u_i - u)
            half_logdet[a] = condition(S[h], D, whiten, G[a])
            z[a], c[a] = x * D, v * D_u
            w[a] = z[a] @ G[a]
            for i in range(N):
                exponent = (w[a, i] * x[i]).sum() + (c[a, i] * v[i]).sum()
                q[a, i] = math.exp(gp.log_signal[a] - half_logdet[a] - exponent / 2)
            # M = sum beta q,   dM = sum beta q dlog q
            weighted = gp.weights[a, :N] * q[a]
            M = out.M[h, a] = weighted.sum()
            for i in range(N):
                out.J[h, a] += weighted[i] * w[a, i]
            if order < JACOBIAN:
                continue
            GD = _symmetric(G[a].T * D)
            for i in range(N):
                out.dM_dS[h, a] += weighted[i] / 2 * np.outer(w[a, i], w[a, i])
                out.dM_du[h, a] += weighted[i] * c[a, i]
            out.dM_dS[h, a] -= M / 2 * GD
            # dJ/dS = 1/2 sum beta q (w w w - three times G'D with w),   dJ/du = sum beta q w c'
            for e in range(n if order == CROSS else 0):
                J = out.J[h, a]
                for i in range(N):
                    out.dJ_dS[h, a, e] += weighted[i] * w[a, i, e] / 2 * np.outer(w[a, i], w[a, i])
                    out.dJ_du[h, a, e] += weighted[i] * w[a, i, e] * c[a, i]
                out.dJ_dS[h, a, e] -= (J[e] * GD + np.outer(GD[e], J) + np.outer(J, GD[e])) / 2

        for a in range(k):
            for b in range(a, a + 1 if diagonal else k):
                D_a, D_b = gp.inverse_squares[a, :n], gp.inverse_squares[b, :n]
                r = half_logdet[a] + half_logdet[b] - condition(S[h], D_a + D_b, whiten, G_ab)
                T_a, T_b, T_ab = G[a] @ S[h], G[b] @ S[h], G_ab @ S[h]
                F_a, F_b = -(G_ab.T * D_b) @ T_a, -(G_ab.T * D_a) @ T_b
                f_a, f_b, y_a, y_b = z[a] @ F_a.T, z[b] @ F_b.T, z[a] @ G_ab, z[b] @ G_ab
                GD_ab, FD = G_ab.T * (D_a + D_b), F_a * D_a + F_b * D_b
                # delta_ij = rise_i + fall_j + z_ai' T_ab z_bj: a difference of logarithms, so that nothing cancels
                rise = r - ((z[a] @ T_ab * D_b) * (z[a] @ T_a)).sum(1) / 2
                fall = -((z[b] @ T_ab * D_a) * (z[b] @ T_b)).sum(1) / 2
                across = (z[a] @ T_ab) @ z[b].T
                dV_dmu, dV_dS, dV_du = np.zeros(n), np.zeros((n, n)), np.zeros(len(u[h]))
                total = 0.0
                for i in range(N):
                    for j in range(N):
                        U = gp.weights[a, i] * gp.weights[b, j] * q[a, i] * q[b, j]
                        if a == b:
                            U -= precision[a, i, j] * q[a, i] * q[a, j]
                        # from delta = 300 on Q_ij is below 1e-130 sf2_a sf2_b: the exponent may stay there
                        P = U * math.expm1(min(rise[i] + fall[j] + across[i, j], 300.0))
                        total += P
                        if order < JACOBIAN:
                            continue
                        # dV = sum P dlog Q + sum U d(log Q - log q - log q)
                        y = y_a[i] + y_b[j]
                        dV_dmu += P * y + U * (f_a[i] + f_b[j])
                        dV_du += P * (c[a, i] + c[b, j])
                        difference = np.outer(f_a[i], y_a[i]) + np.outer(w[a, i], f_a[i]) + np.outer(y_a[i], y_b[j])
                        difference += np.outer(f_b[j], y_b[j]) + np.outer(w[b, j], f_b[j]) + np.outer(y_b[j], y_a[i])
                        dV_dS += P / 2 * (np.outer(y, y) - GD_ab) + U / 2 * (difference - FD)
                if a == b:
                    # dV_aa = -2 sum_i e_i dlog q_ai,   e_i = q_ai [(K_a + sn2_a I)^-1 q_a]_i
                    e = q[a] * (precision[a] @ q[a])
                    total += math.exp(gp.log_signal[a]) - e.sum()
                    for i in range(N if order >= JACOBIAN else 0):
                        dV_dmu -= 2 * e[i] * w[a, i]
                        dV_dS -= e[i] * (np.outer(w[a, i], w[a, i]) - G[a].T * D_a)
                        dV_du -= 2 * e[i] * c[a, i]
                for s, t in ((a, b), (b, a)):
                    out.V[h, s, t] = total
                    if order >= JACOBIAN:
                        out.dV_dmu[h, s, t], out.dV_du[h, s, t] = dV_dmu, dV_du
                        out.dV_dS[h, s, t] = _symmetric(dV_dS)


@njit_inner
def _symmetric(A):
    return (A + A.T) / 2
