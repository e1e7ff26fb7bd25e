r"""Problem: the mean and covariance of f(x~) when f is a GP and its input x~ is itself Gaussian.

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
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite
from gpmpc.gp.evaluation import host_arrays
from gpmpc.gp.posterior import GPPosterior
from gpmpc.propagation.composition import Composition, Latent
from gpmpc.propagation.propagator import Propagation, checked_input, unsupported
from gpmpc.propagation.sensitivity import Sensitivity


class MomentMatching:
    """Exact moment matching through a ``GPPosterior``, or a ``ResidualModel`` with an affine nominal part.

    Args:
        diagonal: Takes the outputs as independent: only the diagonal of the predicted covariance is computed, at a
            quarter of the cost for six outputs.
        observation_noise: Adds the noise variance sn2 to the predicted covariance. The paper's tables do not.
    """

    def __init__(self, diagonal: bool = False, observation_noise: bool = False):
        self.diagonal, self.observation_noise = diagonal, observation_noise

    def __call__(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Gaussian:
        """The next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief

    def propagate(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief N(mu, S) one step on; see ``Propagator.propagate``.

        Raises:
            UnsupportedModel: There is no closed form for this model.
        """
        input = checked_input(model, belief, input)
        composition = self._composition(model)
        seen, control = composition.seen(belief, input)
        return self._propagation(model, *composition.moments(belief, input, self._latent(composition.f, seen, control)))

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives in closed form; None where only torch can follow."""
        input = checked_input(model, belief, input)
        composition = self._composition(model)
        seen, control = composition.seen(belief, input)
        arrays = host_arrays(composition.f.weights, seen.mean, seen.covariance, control)
        if arrays is None:
            return None
        f = self._compiled(composition.f, seen.mean.shape[:-1], arrays[1:], composition.A is not None)
        sensitivity = composition.sensitivity(belief.covariance, f)
        if self.diagonal:
            sensitivity = sensitivity.of_variances()
        return self._propagation(model, *composition.moments(belief, input, f)), sensitivity

    def _composition(self, model: Any) -> Composition:
        composition = Composition.of(model)
        if composition is None:
            raise unsupported(self, model, "a GPPosterior, or a ResidualModel of an Affine nominal model and one")
        return composition

    def _latent(self, f: GPPosterior, belief: Gaussian, input: Tensor) -> Latent:
        """The moments of f, compiled or by torch."""
        arrays = host_arrays(f.weights, belief.mean, belief.covariance, input)
        if arrays is None:
            return Latent(*moments(f, belief, input, self.diagonal))
        return self._compiled(f, belief.mean.shape[:-1], arrays[1:])

    def _compiled(self, f: GPPosterior, batch: torch.Size, arrays: Sequence[Any], cross: bool | None = None) -> Latent:
        """The moments of f by ``gpmpc.fused``; ``cross`` asks for derivatives, with those of J or without."""
        from gpmpc import fused  # loads numba

        mean, S, u = arrays
        n, m = f.state_dim, f.input_dim
        flat = mean.reshape(-1, n), S.reshape(-1, n, n), u.reshape(len(mean.reshape(-1, n)), m)
        if cross is None:
            found = fused.moments(f.packed, *flat, self.diagonal)
        else:
            found = fused.moments_with_jacobian(f.packed, *flat, self.diagonal, cross)
        parts = [p if p is None else torch.from_numpy(p.reshape(*batch, *p.shape[1:])) for p in found]
        parts[0] += f.offset
        return Latent(*parts)

    def _propagation(self, model: Any, mean: Tensor, covariance: Tensor, cross: Tensor) -> Propagation:
        if self.observation_noise:
            covariance = covariance + model.noise_covariance
        if self.diagonal:
            covariance = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
        covariance, deficit = nearest_positive_semidefinite(covariance)
        return Propagation(Gaussian(mean, covariance), cross, deficit)


def moments(
    model: GPPosterior, belief: Gaussian, input: Tensor, diagonal: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """M (*batch, k), V (*batch, k, k) and J = E[df/dx] (*batch, k, n) of the latent functions f; the module's text."""
    n, k = model.state_dim, model.output_dim
    S = belief.covariance[..., None, :, :]  # (*batch, 1, n, n), one copy an output or pair
    inverse_squares = model.lengthscales[:, :n].square().reciprocal()  # the diagonals of Lam_a^-1, (k, n)
    nu = (model.features[:, :n] - belief.mean[..., None, :])[..., None, :, :]  # (*batch, 1, N, n)
    control = (model.features[:, n:] - input[..., None, :])[..., None, :, :] / model.lengthscales[:, None, n:]
    z = nu * inverse_squares[:, None, :]  # (*batch, k, N, n)

    half_logdet, factor, T = _against(S, inverse_squares)
    root = inverse_squares.sqrt()
    whitened = torch.linalg.solve_triangular(factor, (nu * root[:, None, :]).mT, upper=False)
    log_q = (
        model.signal_variance.log()[:, None]
        - (control.square().sum(-1) + whitened.square().sum(-2)) / 2
        - half_logdet[..., None]
    )  # (*batch, k, N)
    q = log_q.exp()
    mean = (model.weights * q).sum(-1) + model.offset
    slope = ((model.weights * q)[..., None, :] @ z)[..., 0, :]
    slope = root * torch.cholesky_solve((slope / root)[..., None], factor)[..., 0]

    a, b = torch.triu_indices(k, k, device=nu.device)  # the pairs of outputs a <= b
    if diagonal:
        a = b = torch.arange(k, device=nu.device)
    half_logdet_ab, _, T_ab = _against(S, inverse_squares[a] + inverse_squares[b])
    z_a, z_b = z[..., a, :, :], z[..., b, :, :]
    of_i = _quadratic(z_a, T_ab @ (inverse_squares[b][:, :, None] * T[..., a, :, :])) / 2
    of_j = _quadratic(z_b, T_ab @ (inverse_squares[a][:, :, None] * T[..., b, :, :])) / 2
    r = half_logdet[..., a] + half_logdet[..., b] - half_logdet_ab
    of_i, z_a = r[..., None] - of_i, z_a @ T_ab
    explained = model.explained(q)

    entries = {}
    for pair, (i, j) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):  # one at a time: (N, N) fits the cache
        delta = of_i[..., pair, :, None] - of_j[..., pair, None, :] + z_a[..., pair, :, :] @ z_b[..., pair, :, :].mT
        centred = _centred_product(log_q[..., i, :, None] + log_q[..., j, None, :], delta)
        entry = ((centred @ model.weights[j]) * model.weights[i]).sum(-1)
        if i == j:
            reduction = (model.precision[i] * centred).sum((-2, -1))
            entry = entry + model.signal_variance[i] - explained[..., i] - reduction
        entries[i, j] = entries[j, i] = entry
    if diagonal:
        return mean, torch.diag_embed(torch.stack([entries[i, i] for i in range(k)], dim=-1)), slope
    rows = [torch.stack([entries[i, j] for j in range(k)], dim=-1) for i in range(k)]
    return mean, torch.stack(rows, dim=-2), slope


def _against(S: Tensor, D: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """1/2 log|I + S D|, the Cholesky factor of I + B, and T = (I + S D)^-1 S, for diagonal D.

    Through B = D^1/2 S D^1/2, whose I + B is well conditioned; log1p keeps the digits of a small S.
    """
    root = D.sqrt()
    B = root[..., :, None] * S * root[..., None, :]
    half_logdet = torch.linalg.eigvalsh(B).log1p().sum(-1) / 2
    factor = torch.linalg.cholesky(B + torch.eye(B.shape[-1], dtype=B.dtype, device=B.device))
    return half_logdet, factor, torch.cholesky_solve(B, factor) / (root[..., :, None] * root[..., None, :])


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
