"""Problem: exact moments with all first derivatives, in torch: for many beliefs at once and on any device.

``gpmpc.kernels.moments`` states the derivatives (with the letters that stand here) and computes them in compiled loops
for a belief in host memory. Reverse mode through ``moment_matching.moments`` would give the same, one pass an entry of
the next belief, and keep every N x N product of all pairs of outputs meanwhile. Here one pair of outputs has its N x N
matrix at a time:

    dV_ab = sum_ij P_ij dlog Q_ij + sum_ij U_ij d(log Q_ij - log q_ai - log q_bj),   P_ij = U_ij expm1(delta_ij)

needs of it the total, the sums of rows and columns, and sum_ij P_ij z_ai z_bj'; the sums with U_ij are products.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian
from gpmpc.gp.posterior import GPPosterior
from gpmpc.propagation.composition import Latent
from gpmpc.propagation.moment_matching import Pairs, Seen, centred_products, gathered, pair, see


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
        belief: Over what they see of the state (*batch).
        input: (*batch, m).
        diagonal: Leaves the covariances between outputs at zero.
        cross: Adds the derivatives of J.
    """
    n, k = model.state_dim, model.output_dim
    seen = see(model, belief, input)
    pairs = pair(belief, seen, diagonal)
    c = seen.control * model.lengthscales[:, None, n:] ** -2  # c_ai (*batch, k, N, m)
    G, A = seen.inverse, seen.inverse.mT * seen.D[:, None, :]  # A = G' D, symmetric
    f = _Sums.of(model.weights * seen.q, seen.z, c)
    e = _Sums.of(seen.q * model.solve(seen.q), seen.z, c)
    J = _transposed(G, f.first)
    dM_dS = _symmetric(G.mT @ f.second @ G - f.total[..., None, None] * A) / 2
    dJ_dS, dJ_du = _slopes(model.weights * seen.q, seen, c, J, A) if cross else (None, None)

    explained, entries = model.variance_reduction(seen.q), []
    for p, (a, b) in enumerate(zip(pairs.a, pairs.b, strict=True)):  # one N x N matrix at a time
        U, moment = _products(f.at(a), f.at(b))
        weights = model.weights[a][:, None] * model.weights[b]
        if a == b:
            own, G_a = e.at(a), G[..., a, :, :]
            weighted = seen.q[..., a, :, None] * seen.z[..., a, :, :]
            U = [_Sums(*(part - less for part, less in zip(side, own, strict=True))) for side in U]
            moment = moment - weighted.mT @ (model.precision[a] @ weighted)
            weights = weights - model.precision[a]
        total, by_mu, by_S, by_u = _pair(weights * centred_products(seen, pairs, p), U, moment, p, pairs, seen, c)
        if a == b:  # sf2 - |L^-1 q|^2, whose derivative is -2 sum_i e_i dlog q_i
            total = total + model.signal_variance[a] - explained[..., a]
            by_mu, by_u = by_mu - 2 * _transposed(G_a, own.first), by_u - 2 * own.control
            by_S = by_S - _symmetric(G_a.mT @ own.second @ G_a - own.total[..., None, None] * A[..., a, :, :])
        entries.append((total, by_mu, by_S, by_u))
    V, dV_dmu, dV_dS, dV_du = (gathered(part, pairs, k) for part in zip(*entries, strict=True))
    return Latent(f.total + model.offset, V, J, dM_dS, f.control, dV_dmu, dV_dS, dV_du, dJ_dS, dJ_du)


def _products(f_a: _Sums, f_b: _Sums) -> tuple[list[_Sums], Tensor]:
    """Sums over i and j weighted by beta_ai q_ai beta_bj q_bj: of what belongs to i, to j, and of z_ai z_bj'."""
    sides = []
    for own, other in ((f_a, f_b), (f_b, f_a)):
        share = other.total[..., None]
        sides.append(_Sums(own.total * other.total, share * own.first, share[..., None] * own.second, own.control))
    return sides, f_a.first[..., :, None] * f_b.first[..., None, :]


def _pair(
    P: Tensor, U: list[_Sums], moment: Tensor, p: int, pairs: Pairs, seen: Seen, c: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """sum_ij P_ij of one pair of outputs, and the derivatives by mu, S and u of the module's text.

    Args:
        P: (*batch, N, N).
        U: Sums with U_ij of what belongs to i, and to j.
        moment: sum_ij U_ij z_ai z_bj' (*batch, n, n).
        p: Which pair.
        pairs: All of them.
        seen: The points.
        c: (*batch, k, N, m).
    """
    a, b = pairs.a[p], pairs.b[p]
    z_a, z_b, G = seen.z[..., a, :, :], seen.z[..., b, :, :], pairs.inverse[..., p, :, :]
    rows, columns = _Sums.of(P.sum(-1), z_a, c[..., a, :, :]), _Sums.of(P.sum(-2), z_b, c[..., b, :, :])
    H = z_a.mT @ (P @ z_b) + moment
    by_mu = _transposed(G, rows.first + columns.first)
    D_ab = (seen.D[a] + seen.D[b])[:, None]
    by_S = G.mT @ (rows.second + columns.second + H + H.mT) @ G - rows.total[..., None, None] * _scaled(G, D_ab)
    for own, other, sums in ((a, b, U[0]), (b, a, U[1])):
        F = -_scaled(G, seen.D[other][:, None]) @ seen.T[..., own, :, :]  # G_ab' - G_a', without cancellation
        passed = F @ sums.second
        by_mu = by_mu + (F @ sums.first[..., None])[..., 0]
        by_S = by_S + passed @ G + (passed @ seen.inverse[..., own, :, :]).mT
        by_S = by_S - sums.total[..., None, None] * F * seen.D[own]
    return rows.total, by_mu, _symmetric(by_S) / 2, rows.control + columns.control


def _slopes(weighted: Tensor, seen: Seen, c: Tensor, J: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
    """dJ/dS = 1/2 [sum_i beta_i q_i w_i w_i w_i - three times A with J] and dJ/du = sum_i beta_i q_i w_i c_i'."""
    w = seen.z @ seen.inverse
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
