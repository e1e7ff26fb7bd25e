r"""The mean and covariance of f(x~) when f is a GP and its input x~ is itself Gaussian, in torch.

Exact moments of an SE-ARD posterior at x~ = (x, u), x ~ N(mu, S), u certain (Girard, 2004; Deisenroth, 2010, section
2.3; Cao, Lai and Alam, 2017, section 2). With nu_i = x_i - mu, Lam_a = diag(l_a^2) on the states, and

    q_ai  = E[k_a(x~_i, x~)],   Q_ij = E[k_a(x~_i, x~) k_b(x~_j, x~)] = q_ai q_bj exp(delta_ij)

the textbook form of the covariance, beta_a' Q beta_b - M_a M_b, subtracts two numbers that agree to many digits where S
is small. Here each product is centred before it is summed, which loses nothing:

    mean          M_a = sum_i beta_ai q_ai
    slope         J_a = E[df_a/dx] = dM_a/dmu = (I + Lam_a^-1 S)^-1 sum_i beta_ai q_ai z_ai
    input-output  Cov[x, f_a] = S J_a' (Stein, 1981)
    covariance    V_ab = sum_ij beta_ai beta_bj q_ai q_bj expm1(delta_ij)
                  V_aa = ... + sf2_a - |L_a^-1 q_a|^2 - sum_ij [(K_a + sn2_a I)^-1]_ij q_ai q_aj expm1(delta_ij)
    delta_ij      = r_ab - 1/2 z_ai' T_ab Lam_b^-1 T_a z_ai - 1/2 z_bj' T_ab Lam_a^-1 T_b z_bj + z_ai' T_ab z_bj
    r_ab          = 1/2 (log|I + S Lam_a^-1| + log|I + S Lam_b^-1| - log|I + S (Lam_a^-1 + Lam_b^-1)|)
    z_ai          = Lam_a^-1 nu_i,  T_a = (I + S Lam_a^-1)^-1 S,  T_ab = (I + S (Lam_a^-1 + Lam_b^-1))^-1 S

(delta follows from T_ab - T_a = -T_ab Lam_b^-1 T_a.) The controls carry no uncertainty: they only weigh the points.

The derivatives (``gpmpc.kernels.moments`` states them and computes them in compiled loops) have one N x N matrix of one
pair of outputs at a time, where reverse mode would keep those of all pairs:

    dV_ab = sum_ij P_ij dlog Q_ij + sum_ij U_ij d(log Q_ij - log q_ai - log q_bj),   P_ij = U_ij expm1(delta_ij)

needs of it the total, the sums of rows and columns, and sum_ij P_ij z_ai z_bj'; the sums with U_ij are products.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian
from gpmpc.gp.posterior import GPPosterior
from gpmpc.propagation._composition import Latent


class _OutputTerms(NamedTuple):
    """What each output needs at a belief, one row an output; the letters are those of the module's text.

    Attributes:
        D: The diagonals of Lam_a^-1 (k, n).
        z: (*batch, k, N, n).
        control: u_i - u (*batch, 1, N, m).
        q: (*batch, k, N).
        log_q: (*batch, k, N).
        half_logdet: 1/2 log|I + S Lam_a^-1| (*batch, k).
        inverse: G_a = (I + S Lam_a^-1)^-1 (*batch, k, n, n).
        T: (*batch, k, n, n).
    """

    D: Tensor
    z: Tensor
    control: Tensor
    q: Tensor
    log_q: Tensor
    half_logdet: Tensor
    inverse: Tensor
    T: Tensor


class _PairTerms(NamedTuple):
    """The pairs of outputs a <= b with delta_ij = rise_i - fall_j + left_i . z_bj; P of them.

    Attributes:
        a: (P,).
        b: (P,).
        row_term: (*batch, P, N).
        column_term: (*batch, P, N).
        row_factor: (*batch, P, N, n).
        inverse: G_ab = (I + S (Lam_a^-1 + Lam_b^-1))^-1 (*batch, P, n, n).
    """

    a: list[int]
    b: list[int]
    row_term: Tensor
    column_term: Tensor
    row_factor: Tensor
    inverse: Tensor


def moments(
    model: GPPosterior, belief: Gaussian, input: Tensor, diagonal: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """M (*batch, k), V (*batch, k, k) and J = E[df/dx] (*batch, k, n) of the latent functions f; the module's text."""
    terms = _output_terms(model, belief, input)
    pairs = _pair_terms(belief, terms, diagonal)
    weighted = model.weights * terms.q
    mean = weighted.sum(-1) + model.offset
    slope = (weighted[..., None, :] @ terms.z @ terms.inverse)[..., 0, :]
    reductions = model.variance_reduction(terms.q)
    entries = []
    for p, (i, j) in enumerate(zip(pairs.a, pairs.b, strict=True)):  # one at a time: (N, N) fits the cache
        centred = _centred_products(terms, pairs, p)
        entry = ((centred @ model.weights[j]) * model.weights[i]).sum(-1)
        if i == j:
            reduction = (model.precision[i] * centred).sum((-2, -1))
            entry = entry + model.signal_variance[i] - reductions[..., i] - reduction
        entries.append(entry)
    return mean, _symmetric_from_pairs(entries, pairs, model.output_dim), slope


def _output_terms(model: GPPosterior, belief: Gaussian, input: Tensor) -> _OutputTerms:
    """The terms of each output alone."""
    n = model.state_dim
    D = model.lengthscales[:, :n].square().reciprocal()
    nu = (model.features[:, :n] - belief.mean[..., None, :])[..., None, :, :]  # (*batch, 1, N, n)
    control = (model.features[:, n:] - input[..., None, :])[..., None, :, :]
    half_logdet, factor, T = _conditioned(belief.covariance[..., None, :, :], D)
    whitened = torch.linalg.solve_triangular(factor, (nu * D.sqrt()[:, None, :]).mT, upper=False)
    certain = (control / model.lengthscales[:, None, n:]).square().sum(-1)
    exponent = (certain + whitened.square().sum(-2)) / 2
    log_q = model.signal_variance.log()[:, None] - exponent - half_logdet[..., None]
    return _OutputTerms(D, nu * D[:, None, :], control, log_q.exp(), log_q, half_logdet, _inverse(factor, D), T)


def _pair_terms(belief: Gaussian, terms: _OutputTerms, diagonal: bool) -> _PairTerms:
    """The terms of each pair that are no larger than the points; with ``diagonal`` of the pairs a = b alone."""
    k, D, z = len(terms.D), terms.D, terms.z
    a, b = torch.triu_indices(k, k, device=z.device)
    if diagonal:
        a = b = torch.arange(k, device=z.device)
    half_logdet, factor, T = _conditioned(belief.covariance[..., None, :, :], D[a] + D[b])
    z_a, z_b = z[..., a, :, :], z[..., b, :, :]
    of_i = _quadratic(z_a, T @ (D[b][:, :, None] * terms.T[..., a, :, :])) / 2
    of_j = _quadratic(z_b, T @ (D[a][:, :, None] * terms.T[..., b, :, :])) / 2
    r = terms.half_logdet[..., a] + terms.half_logdet[..., b] - half_logdet
    return _PairTerms(a.tolist(), b.tolist(), r[..., None] - of_i, of_j, z_a @ T, _inverse(factor, D[a] + D[b]))


def _centred_products(terms: _OutputTerms, pairs: _PairTerms, p: int) -> Tensor:
    """q_ai q_bj expm1(delta_ij) (*batch, N, N) of the pair p."""
    i, j = pairs.a[p], pairs.b[p]
    delta = pairs.row_factor[..., p, :, :] @ terms.z[..., j, :, :].mT
    delta = delta + (pairs.row_term[..., p, :, None] - pairs.column_term[..., p, None, :])
    return _centred_product(terms.log_q[..., i, :, None] + terms.log_q[..., j, None, :], delta)


def _symmetric_from_pairs(entries: Sequence[Tensor], pairs: _PairTerms, k: int) -> Tensor:
    """A symmetric matrix (*batch, k, k, ...) from its entries (*batch, ...), a pair each; zero where there is none."""
    places = {}
    for p, place in enumerate(zip(pairs.a, pairs.b, strict=True)):
        places[place] = places[place[::-1]] = entries[p]
    nothing, first = torch.zeros_like(entries[0]), entries[0].dim() - len(pairs.row_term.shape[:-2])
    rows = [torch.stack([places.get((i, j), nothing) for j in range(k)], -1 - first) for i in range(k)]
    return torch.stack(rows, -2 - first)


def _conditioned(S: Tensor, D: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """1/2 log|I + S D|, the Cholesky factor of I + B, and T = (I + S D)^-1 S, for diagonal D.

    Through B = D^1/2 S D^1/2, whose I + B is well conditioned; log1p keeps the digits of a small S.
    """
    root = D.sqrt()
    B = root[..., :, None] * S * root[..., None, :]
    half_logdet = torch.linalg.eigvalsh(B).log1p().sum(-1) / 2
    factor = torch.linalg.cholesky(B + torch.eye(B.shape[-1], dtype=B.dtype, device=B.device))
    return half_logdet, factor, torch.cholesky_solve(B, factor) / (root[..., :, None] * root[..., None, :])


def _inverse(factor: Tensor, D: Tensor) -> Tensor:
    """(I + S D)^-1 from the factor of I + B."""
    root, eye = D.sqrt(), torch.eye(D.shape[-1], dtype=D.dtype, device=D.device)
    inverse = torch.cholesky_solve(eye.expand_as(factor), factor)  # cholesky_inverse has no right forward derivative
    return inverse * (root[..., None, :] / root[..., :, None])


def _quadratic(z: Tensor, M: Tensor) -> Tensor:
    """z_i' M z_i of the rows of z (..., N, n), (..., N)."""
    return ((z @ M) * z).sum(-1)


def _centred_product(log_qq: Tensor, delta: Tensor) -> Tensor:
    """q_i q_j expm1(delta_ij) from logarithms, without overflow or cancellation for either sign of delta.

    expm1(d) = exp(d) (-expm1(-d)) for d > 0: every exponential is of a product's own logarithm or of -|d|.
    """
    positive = (delta > 0).to(delta.dtype)
    sign = 2 * positive - 1
    return -sign * (log_qq + positive * delta).exp() * torch.expm1(-sign * delta)


class _Sums(NamedTuple):
    """Sums over the points of each output, weighted by w_ai.

    Attributes:
        total: sum_i w_ai (*batch, k).
        first: sum_i w_ai z_ai (*batch, k, n).
        second: sum_i w_ai z_ai z_ai' (*batch, k, n, n).
        control: sum_i w_ai c_ai (*batch, k, m).
    """

    total: Tensor
    first: Tensor
    second: Tensor
    control: Tensor

    @classmethod
    def of(cls, weights: Tensor, z: Tensor, c: Tensor) -> "_Sums":
        row = weights[..., None, :]
        second = (weights[..., None] * z).mT @ z
        return cls(weights.sum(-1), (row @ z)[..., 0, :], second, (row @ c)[..., 0, :])

    def at(self, a: int) -> "_Sums":
        """Those of one output."""
        return _Sums(*(part.select(self.total.dim() - 1, a) for part in self))


def moments_with_jacobian(
    model: GPPosterior, belief: Gaussian, input: Tensor, diagonal: bool = False, cross: bool = True
) -> Latent:
    """The moments of f at x ~ N(mu, S), and their derivatives by mu, S and u.

    Args:
        model: The GPs.
        belief: Over the states that they depend on (*batch).
        input: (*batch, m).
        diagonal: Leaves the covariances between outputs at zero.
        cross: Adds the derivatives of J.
    """
    n, k = model.state_dim, model.output_dim
    terms = _output_terms(model, belief, input)
    pairs = _pair_terms(belief, terms, diagonal)
    c = terms.control * model.lengthscales[:, None, n:] ** -2  # c_ai (*batch, k, N, m)
    G, A = terms.inverse, terms.inverse.mT * terms.D[:, None, :]  # A = G' D, symmetric
    f = _Sums.of(model.weights * terms.q, terms.z, c)
    e = _Sums.of(terms.q * model.solve(terms.q), terms.z, c)
    J = _transposed(G, f.first)
    dM_dS = _symmetric(G.mT @ f.second @ G - f.total[..., None, None] * A) / 2
    slopes = _slopes(model.weights * terms.q, terms, c, J, A) if cross else ()

    reductions, entries = model.variance_reduction(terms.q), []
    for p, (a, b) in enumerate(zip(pairs.a, pairs.b, strict=True)):  # one N x N matrix at a time
        U, moment = _products(f.at(a), f.at(b))
        weights = model.weights[a][:, None] * model.weights[b]
        own, G_a = e.at(a), G[..., a, :, :]
        if a == b:
            weighted = terms.q[..., a, :, None] * terms.z[..., a, :, :]
            U = [_Sums(*(part - less for part, less in zip(side, own, strict=True))) for side in U]
            moment = moment - weighted.mT @ (model.precision[a] @ weighted)
            weights = weights - model.precision[a]
        total, by_mu, by_S, by_u = _pair(weights * _centred_products(terms, pairs, p), U, moment, p, pairs, terms, c)
        if a == b:  # sf2 - |L^-1 q|^2, whose derivative is -2 sum_i e_i dlog q_i
            total = total + model.signal_variance[a] - reductions[..., a]
            by_mu, by_u = by_mu - 2 * _transposed(G_a, own.first), by_u - 2 * own.control
            by_S = by_S - _symmetric(G_a.mT @ own.second @ G_a - own.total[..., None, None] * A[..., a, :, :])
        entries.append((total, by_mu, by_S, by_u))
    V, dV_dmu, dV_dS, dV_du = (_symmetric_from_pairs(part, pairs, k) for part in zip(*entries, strict=True))
    return Latent(f.total + model.offset, V, J, dM_dS, f.control, dV_dmu, dV_dS, dV_du, *slopes)


def _products(f_a: _Sums, f_b: _Sums) -> tuple[list[_Sums], Tensor]:
    """Sums over i and j weighted by beta_ai q_ai beta_bj q_bj: of what belongs to i, to j, and of z_ai z_bj'."""
    sides = []
    for own, other in ((f_a, f_b), (f_b, f_a)):
        share = other.total[..., None]
        sides.append(_Sums(own.total * other.total, share * own.first, share[..., None] * own.second, own.control))
    return sides, f_a.first[..., :, None] * f_b.first[..., None, :]


def _pair(
    P: Tensor, U: list[_Sums], moment: Tensor, p: int, pairs: _PairTerms, terms: _OutputTerms, c: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """sum_ij P_ij of one pair of outputs, and the derivatives by mu, S and u of the module's text.

    Args:
        P: (*batch, N, N).
        U: Sums with U_ij of what belongs to i, and to j.
        moment: sum_ij U_ij z_ai z_bj' (*batch, n, n).
        p: Which pair.
        pairs: All of them.
        terms: The points.
        c: (*batch, k, N, m).
    """
    a, b = pairs.a[p], pairs.b[p]
    z_a, z_b, G = terms.z[..., a, :, :], terms.z[..., b, :, :], pairs.inverse[..., p, :, :]
    rows, columns = _Sums.of(P.sum(-1), z_a, c[..., a, :, :]), _Sums.of(P.sum(-2), z_b, c[..., b, :, :])
    H = z_a.mT @ (P @ z_b) + moment
    by_mu = _transposed(G, rows.first + columns.first)
    D_ab = (terms.D[a] + terms.D[b])[:, None]
    by_S = G.mT @ (rows.second + columns.second + H + H.mT) @ G - rows.total[..., None, None] * _scaled(G, D_ab)
    for own, other, sums in ((a, b, U[0]), (b, a, U[1])):
        F = -_scaled(G, terms.D[other][:, None]) @ terms.T[..., own, :, :]  # G_ab' - G_a', without cancellation
        passed = F @ sums.second
        by_mu = by_mu + (F @ sums.first[..., None])[..., 0]
        by_S = by_S + passed @ G + (passed @ terms.inverse[..., own, :, :]).mT
        by_S = by_S - sums.total[..., None, None] * F * terms.D[own]
    return rows.total, by_mu, _symmetric(by_S) / 2, rows.control + columns.control


def _slopes(weighted: Tensor, terms: _OutputTerms, c: Tensor, J: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
    """dJ/dS = 1/2 [sum_i beta_i q_i w_i w_i w_i - three times A with J] and dJ/du = sum_i beta_i q_i w_i c_i'."""
    w = terms.z @ terms.inverse
    once = weighted[..., None] * w
    third = torch.stack([(once * w[..., d, None]).mT @ w for d in range(w.shape[-1])], dim=-3)
    third = third - J[..., :, None, None] * A[..., None, :, :]
    third = third - A[..., :, :, None] * J[..., None, None, :] - A[..., :, None, :] * J[..., None, :, None]
    return third / 2, once.mT @ c


def _transposed(matrix: Tensor, vector: Tensor) -> Tensor:
    """M' v, batch by batch."""
    return (vector[..., None, :] @ matrix)[..., 0, :]


def _scaled(G: Tensor, D: Tensor) -> Tensor:
    """G' diag(D), D as a column."""
    return (D * G).mT


def _symmetric(matrix: Tensor) -> Tensor:
    return (matrix + matrix.mT) / 2
