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
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite
from gpmpc.gp.backend import host_arrays
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
    ) -> tuple[Propagation, Sensitivity]:
        """``propagate`` with all derivatives in closed form, compiled or by torch."""
        from gpmpc.propagation.moment_derivatives import moments_with_jacobian  # which builds on this module

        input = checked_input(model, belief, input)
        composition = self._composition(model)
        seen, control = composition.seen(belief, input)
        arrays = host_arrays(composition.f.weights, seen.mean, seen.covariance, control)
        cross = composition.A is not None
        if arrays is None:
            f = moments_with_jacobian(composition.f, seen, control, self.diagonal, cross)
        else:
            f = self._compiled(composition.f, seen.mean.shape[:-1], arrays[1:], cross)
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
        """The moments of f by ``gpmpc.kernels``; ``cross`` asks for derivatives, with those of J or without."""
        from gpmpc import kernels  # loads numba

        mean, S, u = arrays
        n, m = f.state_dim, f.input_dim
        flat = mean.reshape(-1, n), S.reshape(-1, n, n), u.reshape(len(mean.reshape(-1, n)), m)
        if cross is None:
            found = kernels.moments(f.packed, *flat, self.diagonal)
        else:
            found = kernels.moments_with_jacobian(f.packed, *flat, self.diagonal, cross)
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


class Seen(NamedTuple):
    """The training points as seen from a belief, one row an output; the letters are those of the module's text.

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


class Pairs(NamedTuple):
    """The pairs of outputs a <= b with delta_ij = rise_i - fall_j + left_i . z_bj; P of them.

    Attributes:
        a: (P,).
        b: (P,).
        rise: (*batch, P, N).
        fall: (*batch, P, N).
        left: (*batch, P, N, n).
        inverse: G_ab = (I + S (Lam_a^-1 + Lam_b^-1))^-1 (*batch, P, n, n).
    """

    a: list[int]
    b: list[int]
    rise: Tensor
    fall: Tensor
    left: Tensor
    inverse: Tensor


def moments(
    model: GPPosterior, belief: Gaussian, input: Tensor, diagonal: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """M (*batch, k), V (*batch, k, k) and J = E[df/dx] (*batch, k, n) of the latent functions f; the module's text."""
    seen = see(model, belief, input)
    pairs = pair(belief, seen, diagonal)
    weighted = model.weights * seen.q
    mean = weighted.sum(-1) + model.offset
    slope = (weighted[..., None, :] @ seen.z @ seen.inverse)[..., 0, :]
    explained = model.variance_reduction(seen.q)
    entries = []
    for p, (i, j) in enumerate(zip(pairs.a, pairs.b, strict=True)):  # one at a time: (N, N) fits the cache
        centred = centred_products(seen, pairs, p)
        entry = ((centred @ model.weights[j]) * model.weights[i]).sum(-1)
        if i == j:
            reduction = (model.precision[i] * centred).sum((-2, -1))
            entry = entry + model.signal_variance[i] - explained[..., i] - reduction
        entries.append(entry)
    return mean, gathered(entries, pairs, model.output_dim), slope


def see(model: GPPosterior, belief: Gaussian, input: Tensor) -> Seen:
    """Whatever each output has alone."""
    n = model.state_dim
    D = model.lengthscales[:, :n].square().reciprocal()
    nu = (model.features[:, :n] - belief.mean[..., None, :])[..., None, :, :]  # (*batch, 1, N, n)
    control = (model.features[:, n:] - input[..., None, :])[..., None, :, :]
    half_logdet, factor, T = _against(belief.covariance[..., None, :, :], D)
    whitened = torch.linalg.solve_triangular(factor, (nu * D.sqrt()[:, None, :]).mT, upper=False)
    certain = (control / model.lengthscales[:, None, n:]).square().sum(-1)
    exponent = (certain + whitened.square().sum(-2)) / 2
    log_q = model.signal_variance.log()[:, None] - exponent - half_logdet[..., None]
    return Seen(D, nu * D[:, None, :], control, log_q.exp(), log_q, half_logdet, _inverse(factor, D), T)


def pair(belief: Gaussian, seen: Seen, diagonal: bool) -> Pairs:
    """Whatever each pair has that is no larger than the points; with ``diagonal`` the pairs a = b alone."""
    k, D, z = len(seen.D), seen.D, seen.z
    a, b = torch.triu_indices(k, k, device=z.device)
    if diagonal:
        a = b = torch.arange(k, device=z.device)
    half_logdet, factor, T = _against(belief.covariance[..., None, :, :], D[a] + D[b])
    z_a, z_b = z[..., a, :, :], z[..., b, :, :]
    of_i = _quadratic(z_a, T @ (D[b][:, :, None] * seen.T[..., a, :, :])) / 2
    of_j = _quadratic(z_b, T @ (D[a][:, :, None] * seen.T[..., b, :, :])) / 2
    r = seen.half_logdet[..., a] + seen.half_logdet[..., b] - half_logdet
    return Pairs(a.tolist(), b.tolist(), r[..., None] - of_i, of_j, z_a @ T, _inverse(factor, D[a] + D[b]))


def centred_products(seen: Seen, pairs: Pairs, p: int) -> Tensor:
    """q_ai q_bj expm1(delta_ij) (*batch, N, N) of the pair p."""
    i, j = pairs.a[p], pairs.b[p]
    delta = pairs.left[..., p, :, :] @ seen.z[..., j, :, :].mT
    delta = delta + (pairs.rise[..., p, :, None] - pairs.fall[..., p, None, :])
    return _centred_product(seen.log_q[..., i, :, None] + seen.log_q[..., j, None, :], delta)


def gathered(entries: Sequence[Tensor], pairs: Pairs, k: int) -> Tensor:
    """A symmetric matrix (*batch, k, k, ...) from its entries (*batch, ...), a pair each; zero where there is none."""
    places = {}
    for p, place in enumerate(zip(pairs.a, pairs.b, strict=True)):
        places[place] = places[place[::-1]] = entries[p]
    nothing, first = torch.zeros_like(entries[0]), entries[0].dim() - len(pairs.rise.shape[:-2])
    rows = [torch.stack([places.get((i, j), nothing) for j in range(k)], -1 - first) for i in range(k)]
    return torch.stack(rows, -2 - first)


def _against(S: Tensor, D: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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
