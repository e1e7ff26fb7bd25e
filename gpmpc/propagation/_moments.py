r"""The mean and covariance of f(x~) when f is a GP and its input x~ is itself Gaussian, in torch: the specification.

Exact moments of an SE-ARD posterior at x~ = (x, u), x ~ N(mu, S), u certain (Girard, 2004; Deisenroth, 2010, section
2.3; Cao, Lai and Alam, 2017, section 2). With nu_i = x_i - mu, D_a = diag(1 / l_a^2) on the states, and

    q_ai  = E[k_a(x~_i, x~)],   Q_ij = E[k_a(x~_i, x~) k_b(x~_j, x~)] = q_ai q_bj exp(delta_ij)

the textbook form of the covariance, beta_a' Q beta_b - M_a M_b, subtracts two numbers that agree to many digits where S
is small. Here each product is centred before it is summed, which loses nothing:

    mean          M_a = sum_i beta_ai q_ai
    slope         J_a = E[df_a/dx] = dM_a/dmu = G_a' sum_i beta_ai q_ai z_ai,   z_ai = D_a nu_i,  G_a = (I + S D_a)^-1
    input-output  Cov[x, f_a] = S J_a' (Stein, 1981)
    covariance    V_ab = sum_ij beta_ai beta_bj q_ai q_bj expm1(delta_ij)
                  V_aa = ... + sf2_a - |L_a^-1 q_a|^2 - sum_ij [(K_a + sn2_a I)^-1]_ij q_ai q_aj expm1(delta_ij)
    delta_ij      = r_ab - 1/2 z_ai' T_ab D_b T_a z_ai - 1/2 z_bj' T_ab D_a T_b z_bj + z_ai' T_ab z_bj
    r_ab          = 1/2 (log|I + S D_a| + log|I + S D_b| - log|I + S (D_a + D_b)|)
    T_a           = G_a S,  T_ab = (I + S (D_a + D_b))^-1 S

(delta follows from T_ab - T_a = -T_ab D_b T_a.) The controls carry no uncertainty: they only weigh the points. A kernel
is at most sf2, so that Q_ij <= sf2_a sf2_b exp(-delta_ij): where delta is large the pair counts for nothing, and the
exponent may stay where exp does not overflow.

The mean and J have their derivatives in closed form, with dM/dS = 1/2 d2M/dmu2 (Price, 1958). Those of V come from
reverse mode: every pair of outputs has a copy of the belief of its own, so that one pass over the sum of all entries
gives each entry's. ``gpmpc._kernels`` computes all of this in compiled loops.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior

_ENTRIES = (
    2**18
)  # of what is made at once of each kind, for one pair of outputs at least
_Pairs = tuple[list[int], list[int]]
_NOT_WANTED: Any = None
_LARGEST = {torch.float64: 300.0, torch.float32: 80.0}  # delta


class Latent(NamedTuple):
    """Moments of f at x_s ~ N(mu_s, S_s), with derivatives by mu_s, S_s and u_s where they are wanted."""

    M: Tensor  # E[f] (*batch, k)
    V: Tensor  # Cov[f] (*batch, k, k)
    J: Tensor  # E[df/dx_s] (*batch, k, n_s)
    dM_dS: Tensor = _NOT_WANTED  # (*batch, k, n_s, n_s); half of dJ/dmu (Price, 1958)
    dM_du: Tensor = _NOT_WANTED  # (*batch, k, m_s)
    dV_dmu: Tensor = _NOT_WANTED  # (*batch, k, k, n_s)
    dV_dS: Tensor = _NOT_WANTED  # (*batch, k, k, n_s, n_s)
    dV_du: Tensor = _NOT_WANTED  # (*batch, k, k, m_s)
    dJ_dS: Tensor = (
        _NOT_WANTED  # (*batch, k, n_s, n_s, n_s); needed where A is not zero
    )
    dJ_du: Tensor = _NOT_WANTED  # (*batch, k, n_s, m_s); needed where A is not zero


class _OutputTerms(NamedTuple):
    """What each output needs at a belief of its own; the letters are those of the module's text."""

    z: Tensor  # (*batch, k, N, n)
    q: Tensor  # (*batch, k, N)
    half_logdet: Tensor  # 1/2 log|I + S D_a| (*batch, k)
    G: Tensor  # (*batch, k, n, n)
    T: Tensor  # (*batch, k, n, n)


def moments(
    model: GPPosterior, belief: Gaussian, input: Tensor, diagonal: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """M (*batch, k), V (*batch, k, k) and J = E[df/dx] (*batch, k, n) of the latent functions f; the module's text.

    ``diagonal`` leaves the covariances between outputs at zero.
    """
    at = (
        belief.mean[..., None, :],
        belief.covariance[..., None, :, :],
        input[..., None, :],
    )
    terms = _output_terms(model, slice(None), *at)
    pairs = _chunks(model, belief, diagonal)
    weighted = model.weights * terms.q
    slope = (weighted[..., None, :] @ terms.z @ terms.G)[..., 0, :]
    V = _symmetric_from_pairs(
        [_pair_entries(model, *ab, *at) for ab in pairs], pairs, belief.mean.dim() - 1
    )
    return weighted.sum(-1) + model.offset, V, slope


def moments_with_jacobian(
    model: GPPosterior,
    belief: Gaussian,
    input: Tensor,
    diagonal: bool = False,
    cross: bool = True,
) -> Latent:
    """The moments of f at x ~ N(mu, S), and their derivatives by mu, S and u; ``cross`` adds those of J."""
    n = model.state_dim
    axis = belief.mean.dim() - 1
    at = (
        belief.mean[..., None, :],
        belief.covariance[..., None, :, :],
        input[..., None, :],
    )
    terms = _output_terms(model, slice(None), *at)
    pairs = _chunks(model, belief, diagonal)
    w = terms.z @ terms.G  # dlog q_ai / dmu
    c = (model.features[:, n:] - input[..., None, :])[
        ..., None, :, :
    ] * model.lengthscales[:, None, n:] ** -2
    A = terms.G.mT * model.lengthscales[:, None, :n] ** -2  # G' D, symmetric
    weighted = model.weights * terms.q
    M = weighted.sum(-1)
    once = weighted[..., None] * w
    J = once.sum(-2)
    dM_dS = (once.mT @ w - M[..., None, None] * A) / 2
    dJ = ()
    if cross:  # dJ/dS = 1/2 [sum_i beta_i q_i w_i w_i w_i - three times A with J],   dJ/du = sum_i beta_i q_i w_i c_i'
        third = torch.stack([(once * w[..., d, None]).mT @ w for d in range(n)], dim=-3)
        third = third - J[..., :, None, None] * A[..., None, :, :]
        third = (
            third
            - A[..., :, :, None] * J[..., None, None, :]
            - A[..., :, None, :] * J[..., None, :, None]
        )
        dJ = third / 2, once.mT @ c
    with torch.inference_mode(False):
        parts = [_pair_entries_with_gradient(model, ab, at, axis) for ab in pairs]
    V, dV_dmu, dV_dS, dV_du = (
        _symmetric_from_pairs(part, pairs, axis) for part in zip(*parts, strict=True)
    )
    dM_du = (weighted[..., None, :] @ c)[..., 0, :]
    return Latent(
        M + model.offset, V, J, dM_dS, dM_du, dV_dmu, (dV_dS + dV_dS.mT) / 2, dV_du, *dJ
    )


def _output_terms(
    model: GPPosterior, a: Any, mu: Tensor, S: Tensor, u: Tensor
) -> _OutputTerms:
    """The terms of outputs a (k,) at mu (*batch, k, n), S (*batch, k, n, n) and u (*batch, k, m), or one for all."""
    n = model.state_dim
    lengthscales = model.lengthscales[a]
    D = lengthscales[:, :n] ** -2
    nu = model.features[:, :n] - mu[..., None, :]
    control = model.features[:, n:] - u[..., None, :]
    half_logdet, factor, T = _conditioned(S, D)
    whitened = torch.linalg.solve_triangular(
        factor, (nu * D.sqrt()[:, None, :]).mT, upper=False
    )
    certain = (control / lengthscales[:, None, n:]).square().sum(-1)
    exponent = (certain + whitened.square().sum(-2)) / 2 + half_logdet[..., None]
    root = D.sqrt()
    eye = torch.eye(n, dtype=D.dtype, device=D.device)
    inverse = torch.cholesky_solve(
        eye.expand_as(factor), factor
    )  # cholesky_inverse has no right forward derivative
    G = inverse * (root[..., None, :] / root[..., :, None])
    return _OutputTerms(
        nu * D[:, None, :],
        model.signal_variance[a, None] * (-exponent).exp(),
        half_logdet,
        G,
        T,
    )


def _pair_entries(
    model: GPPosterior, a: list[int], b: list[int], mu: Tensor, S: Tensor, u: Tensor
) -> Tensor:
    """V_ab (*batch, P) of P pairs, all with a = b or none, at one belief for all or one for each (as above)."""
    same = a[0] == b[0]
    D_a, D_b = (model.lengthscales[one, : model.state_dim] ** -2 for one in (a, b))
    of_a = _output_terms(model, a, mu, S, u)
    of_b = of_a if same else _output_terms(model, b, mu, S, u)
    half_logdet, _, T = _conditioned(S, D_a + D_b)
    rise = of_a.half_logdet + of_b.half_logdet - half_logdet
    rise = rise[..., None] - _quadratic(of_a.z, T @ (D_b[:, :, None] * of_a.T)) / 2
    fall = _quadratic(of_b.z, T @ (D_a[:, :, None] * of_b.T)) / 2
    delta = of_a.z @ T @ of_b.z.mT + (rise[..., :, None] - fall[..., None, :])
    centred = torch.expm1(delta.clamp_max(_LARGEST[delta.dtype]))
    if not same:
        return (
            (model.weights[a] * of_a.q)[..., None, :]
            @ centred
            @ (model.weights[b] * of_b.q)[..., None]
        )[..., 0, 0]
    E = model.weights[a, :, None] * model.weights[a, None, :] - model.precision[a]
    entries = (of_a.q[..., None, :] @ (E * centred) @ of_a.q[..., None])[..., 0, 0]
    return entries + model.signal_variance[a] - model.variance_reduction(of_a.q, a)


def _pair_entries_with_gradient(
    model: GPPosterior, ab: _Pairs, at: Sequence[Tensor], axis: int
) -> tuple[Tensor, ...]:
    """V_ab (*batch, P), and its derivatives by mu (*batch, P, n), S (*batch, P, n, n) and u (*batch, P, m)."""

    def total(*copies: Tensor) -> tuple[Tensor, Tensor]:
        entries = _pair_entries(model, *ab, *copies)
        return entries.sum(), entries

    copies = [part.repeat_interleave(len(ab[0]), dim=axis) for part in at]
    gradients, entries = torch.func.grad(total, argnums=(0, 1, 2), has_aux=True)(
        *copies
    )
    return entries, *gradients


def _chunks(model: GPPosterior, belief: Gaussian, diagonal: bool) -> list[_Pairs]:
    """The pairs a <= b of outputs, as many in one list as are evaluated at once; first those with a = b."""
    outputs = range(model.output_dim)
    size = len(model) * (
        len(model) + 8 * model.state_dim
    )  # of the matrices (N, N), and of the points' terms
    count = max(1, _ENTRIES // max(1, belief.mean.shape[:-1].numel() * size))
    kinds = (
        [(a, a) for a in outputs],
        [(a, b) for b in outputs for a in range(b) if not diagonal],
    )
    chunks = [
        pairs[i : i + count] for pairs in kinds for i in range(0, len(pairs), count)
    ]
    return [([a for a, _ in chunk], [b for _, b in chunk]) for chunk in chunks]


def _symmetric_from_pairs(
    parts: Sequence[Tensor], pairs: Sequence[_Pairs], axis: int
) -> Tensor:
    """A symmetric matrix (*batch, k, k, ...) from its entries (*batch, P, ...); zero where there is none."""
    places = {
        pair: p
        for p, pair in enumerate(
            (a, b) for chunk in pairs for a, b in zip(*chunk, strict=True)
        )
    }
    k = max(places)[0] + 1
    order = [
        places.get((min(a, b), max(a, b)), len(places))
        for a in range(k)
        for b in range(k)
    ]
    entries = torch.cat(
        [*parts, torch.zeros_like(parts[0].narrow(axis, 0, 1))], dim=axis
    )
    return entries.index_select(
        axis, torch.tensor(order, device=entries.device)
    ).unflatten(axis, (k, k))


def _conditioned(S: Tensor, D: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """1/2 log|I + S D|, the Cholesky factor of I + B, and T = (I + S D)^-1 S, for diagonal D.

    Through B = D^1/2 S D^1/2, whose I + B is well conditioned; log1p keeps the digits of a small S.
    """
    root = D.sqrt()
    B = root[..., :, None] * S * root[..., None, :]
    half_logdet = torch.linalg.eigvalsh(B).log1p().sum(-1) / 2
    factor = torch.linalg.cholesky(
        B + torch.eye(B.shape[-1], dtype=B.dtype, device=B.device)
    )
    return (
        half_logdet,
        factor,
        torch.cholesky_solve(B, factor) / (root[..., :, None] * root[..., None, :]),
    )


def _quadratic(z: Tensor, M: Tensor) -> Tensor:
    """z_i' M z_i of the rows of z (..., N, n), (..., N)."""
    return ((z @ M) * z).sum(-1)
