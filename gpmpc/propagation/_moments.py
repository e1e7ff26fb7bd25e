r"""The mean and covariance of f(x~) when f is a GP and its input x~ is itself Gaussian.

This is the specification, in torch; ``gpmpc._kernels`` computes all of it in compiled
loops. Exact moments of an SE-ARD posterior at x~ = (x, u), x ~ N(mu, S), u certain
(Girard, 2004; Deisenroth, 2010, section 2.3; Cao, Lai and Alam, 2017, section 2). With
nu_i = x_i - mu, D_a = diag(1 / l_a^2) on the states, and

    q_ai  = E[k_a(x~_i, x~)]
    Q_ij  = E[k_a(x~_i, x~) k_b(x~_j, x~)] = q_ai q_bj exp(delta_ij)

the textbook form of the covariance, beta_a' Q beta_b - M_a M_b, subtracts two numbers
that agree to many digits where S is small. Here each product is centred before it is
summed, which loses nothing:

    (1)  mean          M_a = sum_i beta_ai q_ai
    (2)  slope         J_a = E[df_a/dx] = dM_a/dmu = G_a' sum_i beta_ai q_ai z_ai
                       z_ai = D_a nu_i,   G_a = (I + S D_a)^-1
    (3)  input-output  Cov[x, f_a] = S J_a'   (Stein, 1981)
    (4)  covariance    V_ab = sum_ij beta_ai beta_bj q_ai q_bj expm1(delta_ij)
                       V_aa = ... + sf2_a - |L_a^-1 q_a|^2
                              - sum_ij [(K_a + sn2_a I)^-1]_ij q_ai q_aj expm1(delta_ij)
    (5)  delta_ij      = r_ab - 1/2 z_ai' T_ab D_b T_a z_ai
                         - 1/2 z_bj' T_ab D_a T_b z_bj + z_ai' T_ab z_bj
    (6)  r_ab          = 1/2 (log|I + S D_a| + log|I + S D_b| - log|I + S (D_a + D_b)|)
    (7)  T_a           = G_a S,   T_ab = (I + S (D_a + D_b))^-1 S

(delta follows from T_ab - T_a = -T_ab D_b T_a.) The controls carry no uncertainty: they
only weigh the points.

A kernel is at most sf2. So Q_ij is at most sf2_b q_ai and at most sf2_a q_bj, and

    Q_ij^2 <= sf2_a sf2_b q_ai q_bj = sf2_a sf2_b Q_ij exp(-delta_ij)

that is, Q_ij <= sf2_a sf2_b exp(-delta_ij): where delta is large the pair counts for
nothing, and the exponent may stay where exp does not overflow.

The mean and J have their derivatives in closed form. With w_ai = G_a' z_ai, c_ai = D_a
(u_i - u) of the controls, and w_c an entry of w_ai,

    dM_a/dS        = 1/2 d2M_a/dmu2   (Price, 1958)
                   = 1/2 sum_i beta_ai q_ai (w_ai w_ai' - G_a' D_a)
    dM_a/du        = sum_i beta_ai q_ai c_ai
    (dJ_a/dS)_cde  = 1/2 sum_i beta_ai q_ai w_c w_d w_e
                     - 1/2 (J_c (G'D)_de + J_d (G'D)_ce + J_e (G'D)_cd)
    dJ_a/du        = sum_i beta_ai q_ai w_ai c_ai'

Those of V come from reverse mode: every pair of outputs has a copy of the belief
of its own, so that one pass over the sum of all entries gives each entry's.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc.exceptions import DataError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior

_LinAlgError = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]
_LARGEST_DELTA = {torch.float64: 300.0, torch.float32: 80.0}
#: numbers in the largest array that is made at once, for one pair of outputs at least
_LARGEST_SIZE = 2**18


class LatentMoments(NamedTuple):
    """Moments of the latent functions f at x ~ N(mu, S)."""

    M: Tensor  # E[f] (*batch, k)
    V: Tensor  # Cov[f] (*batch, k, k)
    J: Tensor  # E[df/dx] (*batch, k, n)


class LatentDerivatives(NamedTuple):
    """Derivatives of ``LatentMoments`` by mu, S and u; dM/dmu is J."""

    dM_dS: Tensor  # (*batch, k, n, n), dJ/dmu / 2 (Price, 1958)
    dM_du: Tensor  # (*batch, k, m)
    dV_dmu: Tensor  # (*batch, k, k, n)
    dV_dS: Tensor  # (*batch, k, k, n, n)
    dV_du: Tensor  # (*batch, k, k, m)
    dJ_dS: Tensor | None  # (*batch, k, n, n, n); None where it was not wanted
    dJ_du: Tensor | None  # (*batch, k, n, m); None where it was not wanted


class _Point(NamedTuple):
    """A belief N(mu, S) and an input u for each of some outputs or pairs of them.

    The axis ``outputs`` has their number of entries, or one entry for all of them.
    """

    mu: Tensor  # (*batch, outputs, n)
    S: Tensor  # (*batch, outputs, n, n)
    u: Tensor  # (*batch, outputs, m)

    @classmethod
    def of_all_outputs(cls, belief: Gaussian, input: Tensor) -> "_Point":
        """Returns one belief and one input for all outputs."""
        return cls(
            mu=belief.mean[..., None, :],
            S=belief.covariance[..., None, :, :],
            u=input[..., None, :],
        )


class _Factorized(NamedTuple):
    """I + S D for a diagonal D, through I + B with B = D^1/2 S D^1/2."""

    half_logdet: Tensor  # 1/2 log|I + S D| (*batch, k)
    factor: Tensor  # the Cholesky factor of I + B (*batch, k, n, n)
    T: Tensor  # (I + S D)^-1 S (*batch, k, n, n)


class _OutputTerms(NamedTuple):
    """Terms of single outputs; the letters are those of the module's text."""

    z: Tensor  # (*batch, k, N, n)
    q: Tensor  # (*batch, k, N)
    half_logdet: Tensor  # 1/2 log|I + S D_a| (*batch, k)
    G: Tensor  # (*batch, k, n, n)
    T: Tensor  # (*batch, k, n, n)


class _Pairs(NamedTuple):
    """Pairs of outputs that are evaluated at once: all with a = b, or none."""

    a: list[int]
    b: list[int]

    @property
    def same(self) -> bool:
        """Whether every pair is an output with itself."""
        return self.a == self.b


def moments(
    model: GPPosterior, belief: Gaussian, input: Tensor, diagonal: bool = False
) -> LatentMoments:
    """Returns the moments of the latent functions f at x ~ N(mu, S).

    Args:
        model: The GPs.
        belief: N(mu, S): mean (*batch, n), covariance (*batch, n, n).
        input: The certain control u (*batch, m).
        diagonal: Leaves the covariances between outputs at zero.
    """
    point = _Point.of_all_outputs(belief, input)
    terms = _output_terms(model, slice(None), point)
    weighted = model.weights * terms.q
    M = weighted.sum(-1)  # (1)
    J = (weighted[..., None, :] @ terms.z @ terms.G)[..., 0, :]  # (2)
    pairs = _pairs_at_once(model, belief, diagonal)
    entries = [_covariances(model, chunk, point) for chunk in pairs]  # (4)
    axis = belief.mean.dim() - 1
    V = _symmetric_from_pairs(entries, pairs, model.output_dim, axis)
    return LatentMoments(M=M + model.offset, V=V, J=J)


def _output_terms(
    model: GPPosterior, outputs: slice | list[int], point: _Point
) -> _OutputTerms:
    """Returns z, q, 1/2 log|I + S D|, G and T of some outputs, at their points."""
    n = model.state_dim
    lengthscales = model.lengthscales[outputs]
    D = lengthscales[:, :n] ** -2
    nu = model.features[:, :n] - point.mu[..., None, :]
    control = model.features[:, n:] - point.u[..., None, :]
    factorized = _factorize(point.S, D)
    # log q_i = log sf2 - 1/2 log|I + S D| - 1/2 nu' (S + D^-1)^-1 nu - 1/2 |control|^2
    root = D.sqrt()
    whitened = torch.linalg.solve_triangular(
        factorized.factor, (nu * root[:, None, :]).mT, upper=False
    )
    certain = (control / lengthscales[:, None, n:]).square().sum(-1)
    squares = certain + whitened.square().sum(-2)
    exponent = squares / 2 + factorized.half_logdet[..., None]
    # cholesky_inverse has no right forward derivative
    eye = torch.eye(n, dtype=D.dtype, device=D.device).expand_as(factorized.factor)
    inverse = torch.cholesky_solve(eye, factorized.factor)
    G = inverse * (root[..., None, :] / root[..., :, None])
    return _OutputTerms(
        z=nu * D[:, None, :],
        q=model.signal_variance[outputs, None] * (-exponent).exp(),
        half_logdet=factorized.half_logdet,
        G=G,
        T=factorized.T,
    )


def _covariances(model: GPPosterior, pairs: _Pairs, point: _Point) -> Tensor:
    """Returns V_ab (*batch, P) of P pairs of outputs, at their points; (4)."""
    a = pairs.a
    b = pairs.b
    D_a = model.lengthscales[a, : model.state_dim] ** -2
    D_b = model.lengthscales[b, : model.state_dim] ** -2
    of_a = _output_terms(model, a, point)
    of_b = of_a if pairs.same else _output_terms(model, b, point)
    joint = _factorize(point.S, D_a + D_b)
    T = joint.T
    r = of_a.half_logdet + of_b.half_logdet - joint.half_logdet  # (6)
    delta_i = r[..., None] - _quadratic(of_a.z, T @ (D_b[:, :, None] * of_a.T)) / 2
    delta_j = -_quadratic(of_b.z, T @ (D_a[:, :, None] * of_b.T)) / 2
    delta = of_a.z @ T @ of_b.z.mT + (delta_i[..., :, None] + delta_j[..., None, :])
    centred = torch.expm1(delta.clamp_max(_LARGEST_DELTA[delta.dtype]))
    if not pairs.same:
        weighted = (model.weights[a] * of_a.q)[..., None, :]
        right = (model.weights[b] * of_b.q)[..., None]
        return (weighted @ centred @ right)[..., 0, 0]
    E = model.weights[a, :, None] * model.weights[a, None, :] - model.precision[a]
    V = (of_a.q[..., None, :] @ (E * centred) @ of_a.q[..., None])[..., 0, 0]
    return V + model.signal_variance[a] - model.variance_reduction(of_a.q, a)


def _factorize(S: Tensor, D: Tensor) -> _Factorized:
    """Factorises I + S D through I + B, B = D^1/2 S D^1/2, which is well conditioned.

    log1p keeps a small S's digits.
    """
    root = D.sqrt()
    B = root[..., :, None] * S * root[..., None, :]
    eye = torch.eye(B.shape[-1], dtype=B.dtype, device=B.device)
    half_logdet = torch.linalg.eigvalsh(B).log1p().sum(-1) / 2
    try:
        factor = torch.linalg.cholesky(B + eye)
    except _LinAlgError as error:
        raise DataError(
            "the belief's covariance must be positive semidefinite; in units of the "
            "length-scales it has an eigenvalue below -1"
        ) from error
    T = torch.cholesky_solve(B, factor) / (root[..., :, None] * root[..., None, :])
    return _Factorized(half_logdet=half_logdet, factor=factor, T=T)


def _quadratic(z: Tensor, M: Tensor) -> Tensor:
    """Returns z_i' M z_i of the rows of z (..., N, n), (..., N)."""
    return ((z @ M) * z).sum(-1)


def moments_with_jacobian(
    model: GPPosterior,
    belief: Gaussian,
    input: Tensor,
    diagonal: bool = False,
    slope_derivatives: bool = True,
) -> tuple[LatentMoments, LatentDerivatives]:
    """Returns the moments of f at x ~ N(mu, S), and their derivatives by mu, S and u.

    Args:
        model: The GPs.
        belief: N(mu, S): mean (*batch, n), covariance (*batch, n, n).
        input: The certain control u (*batch, m).
        diagonal: Leaves the covariances between outputs at zero.
        slope_derivatives: Whether those of J are wanted too.
    """
    n = model.state_dim
    point = _Point.of_all_outputs(belief, input)
    terms = _output_terms(model, slice(None), point)
    D = model.lengthscales[:, None, :n] ** -2
    D_u = model.lengthscales[:, None, n:] ** -2
    G_D = terms.G.mT * D  # G' D, symmetric
    w = terms.z @ terms.G  # dlog q_ai / dmu
    c = (model.features[:, n:] - input[..., None, :])[..., None, :, :] * D_u
    weighted = model.weights * terms.q
    M = weighted.sum(-1)
    weighted_w = weighted[..., None] * w
    J = weighted_w.sum(-2)
    dJ_dS = None
    dJ_du = None
    if slope_derivatives:
        # sum_i beta_i q_i w_i w_i w_i, less the three products of G'D with J
        third = torch.stack(
            [(weighted_w * w[..., d, None]).mT @ w for d in range(n)], dim=-3
        )
        third = third - J[..., :, None, None] * G_D[..., None, :, :]
        third = third - G_D[..., :, :, None] * J[..., None, None, :]
        third = third - G_D[..., :, None, :] * J[..., None, :, None]
        dJ_dS = third / 2
        dJ_du = weighted_w.mT @ c
    V = _covariances_with_gradient(model, belief, point, diagonal)
    latent_derivatives = LatentDerivatives(
        dM_dS=(weighted_w.mT @ w - M[..., None, None] * G_D) / 2,
        dM_du=(weighted[..., None, :] @ c)[..., 0, :],
        dV_dmu=V.dmu,
        dV_dS=(V.dS + V.dS.mT) / 2,
        dV_du=V.du,
        dJ_dS=dJ_dS,
        dJ_du=dJ_du,
    )
    return LatentMoments(M=M + model.offset, V=V.V, J=J), latent_derivatives


class _CovarianceGradient(NamedTuple):
    """V and its derivatives, of P pairs (*batch, P, ...) or all (*batch, k, k, ...)."""

    V: Tensor
    dmu: Tensor  # (..., n)
    dS: Tensor  # (..., n, n)
    du: Tensor  # (..., m)


def _covariances_with_gradient(
    model: GPPosterior, belief: Gaussian, point: _Point, diagonal: bool
) -> _CovarianceGradient:
    """Returns V and its derivatives of all pairs of outputs."""
    axis = belief.mean.dim() - 1
    pairs = _pairs_at_once(model, belief, diagonal)
    with torch.inference_mode(False):
        chunks = [_gradient_of_pairs(model, chunk, point, axis) for chunk in pairs]

    def symmetric(entries: Sequence[Tensor]) -> Tensor:
        return _symmetric_from_pairs(entries, pairs, model.output_dim, axis)

    return _CovarianceGradient(
        V=symmetric([chunk.V for chunk in chunks]),
        dmu=symmetric([chunk.dmu for chunk in chunks]),
        dS=symmetric([chunk.dS for chunk in chunks]),
        du=symmetric([chunk.du for chunk in chunks]),
    )


def _gradient_of_pairs(
    model: GPPosterior, pairs: _Pairs, point: _Point, axis: int
) -> _CovarianceGradient:
    """Returns V_ab of P pairs and its derivatives, by reverse mode of their sum."""

    def total(mu: Tensor, S: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        entries = _covariances(model, pairs, _Point(mu=mu, S=S, u=u))
        return entries.sum(), entries

    count = len(pairs.a)
    (dmu, dS, du), V = torch.func.grad(total, argnums=(0, 1, 2), has_aux=True)(
        point.mu.repeat_interleave(count, dim=axis),
        point.S.repeat_interleave(count, dim=axis),
        point.u.repeat_interleave(count, dim=axis),
    )
    return _CovarianceGradient(V=V, dmu=dmu, dS=dS, du=du)


def _pairs_at_once(
    model: GPPosterior, belief: Gaussian, diagonal: bool
) -> list[_Pairs]:
    """Returns the pairs a <= b of outputs in chunks that fit into memory.

    Those with a = b come first, and share no chunk with others.
    """
    outputs = range(model.output_dim)
    size = len(model)
    numbers = size * (size + 8 * model.state_dim)  # of one pair's matrices and terms
    batch = max(1, belief.mean.shape[:-1].numel() * numbers)
    count = max(1, _LARGEST_SIZE // batch)
    same = [(a, a) for a in outputs]
    different = [(a, b) for b in outputs for a in range(b)]
    chunks = []
    for pairs in (same,) if diagonal else (same, different):
        for first in range(0, len(pairs), count):
            chunk = pairs[first : first + count]
            chunks.append(_Pairs(a=[a for a, _ in chunk], b=[b for _, b in chunk]))
    return chunks


def _symmetric_from_pairs(
    entries: Sequence[Tensor], pairs: Sequence[_Pairs], k: int, axis: int
) -> Tensor:
    """Returns the symmetric matrix (*batch, k, k, ...) of entries (*batch, P, ...).

    It is zero where there is no entry.
    """
    places: dict[tuple[int, int], int] = {}
    for chunk in pairs:
        for a, b in zip(chunk.a, chunk.b, strict=True):
            places[a, b] = len(places)
    zero = len(places)  # the place of a zero behind all entries
    order = []
    for a in range(k):
        for b in range(k):
            order.append(places.get((min(a, b), max(a, b)), zero))
    zeros = torch.zeros_like(entries[0].narrow(axis, 0, 1))
    values = torch.cat([*entries, zeros], dim=axis)
    indices = torch.tensor(order, device=values.device)
    return values.index_select(axis, indices).unflatten(axis, (k, k))
