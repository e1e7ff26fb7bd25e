r"""Sparse GPs: M inducing points stand for N data points, for O(M^2) a prediction instead of O(N^2).

With inducing points Z, Kzz = Lz Lz' and the correlations Kzx with the data, the predictive distributions of SGPR
(Titsias, 2009, eq. (6); "VFE") and FITC (Snelson and Ghahramani, 2006, eq. (8)) are

    mean = k' beta,   variance = sf2 - k' C k,       k = k(Z, x~)
    C    = Kzz^-1 - (Kzz + Kzx Lam^-1 Kxz)^-1,       Lam = sn2 I  (SGPR)   or   diag(Kxx - Qxx) + sn2 I  (FITC)

which is an exact GP on M pseudo-observations with correlated noise, K + R = C^-1. So it is frozen to a ``GPPosterior``
on Z, and all that works with one (moment matching, appending, removing) works at the cost of M points. With
A = Lz^-1 Kzx Lam^-1/2 and A A' = U diag(b) U',

    C = Lz^-T U diag(b / (1 + b)) U' Lz^-1,   beta = Lz^-T U diag(1 / (1 + b)) U' A Lam^-1/2 (y - offset)
    cholesky of C^-1:  R', where Q R = diag(sqrt((1 + b) / b)) U' Lz'    (never squared: C^-1 is huge where b is small)

The collapsed bound of Titsias (2009, eq. (9)), for FITC without its last term, measures Z and hyperparameters:

    log N(y | 0, Q + Lam) - tr(Kxx - Qxx) / (2 sn2),     Q = A~' A~,  A~ = Lz^-1 Kzx

It depends on the data through sums over the points alone: with r = Lam^-1/2 y they are A A', A r, r'r and log|Lam|. So
the points come in blocks that fit the cache, output after output: first the sums; then the bound and its derivatives by
the sums, all M x M; then block by block once more the derivatives of each block's part (automatic differentiation with
one checkpoint, Griewank and Walther, 2008, chapter 12). Memory stays that of a block, for any N. A jitter on Kzz makes
u = f(Z) + noise; the bound stays one.
"""

import math
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gaussian import check_tensors
from gpmpc.gp._kernel import Hyperparameters, Predicts, kernel_matrix
from gpmpc.gp.posterior import GPPosterior

Method = Literal["sgpr", "fitc"]
JITTER = 1e-8  # of Kzz, in units of sf2
_ENTRIES = 200_000  # of a block of A
_UNINFORMED = 1e-10  # directions in which the data inform less than this (b) get a pseudo-noise of 1 / this


class _Sums(NamedTuple):
    """The sums over the data, of every output: A A' (k, M, M), A r (k, M), r'r (k,) and log|Lam| (k,)."""

    gram: Tensor
    projections: Tensor
    squares: Tensor
    logdet: Tensor


def sparse_posterior(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    hyperparameters: Hyperparameters,
    input_dim: int,
    predicts: Predicts = "next_state",
    offset: Tensor | None = None,
    method: Method = "sgpr",
    jitter: float | None = None,
) -> GPPosterior:
    """Freezes a sparse GP to M pseudo-observations.

    Args:
        inducing: Z (M, d), shared by all outputs.
        features: x~ (N, d), float64 like all that follows.
        targets: (N, k).
        hyperparameters: Of the k GPs.
        input_dim: m, how many of the last features are controls.
        predicts: What the targets mean.
        offset: Constant prior means (k,); zero by default.
        method: ``"sgpr"`` or ``"fitc"``.
        jitter: Added to the diagonal of Kzz, in units of sf2; by default only where it is needed.

    Raises:
        ShapeError: The shapes do not belong together.
        SettingError: Kzz is not positive definite, or what ``GPPosterior.from_hyperparameters`` refuses.
        DataError: An entry is not finite.
    """
    if jitter is not None:
        check_number("jitter", jitter, least=0)
    check_method(method)
    check_tensors(inducing=inducing, features=features, targets=targets)
    offset = torch.zeros_like(targets[0]) if offset is None else offset
    if inducing.dim() != 2 or inducing.shape[1:] != features.shape[1:] or not len(inducing):
        raise ShapeError(f"inducing must be (M, {features.shape[-1]}), M > 0; got {tuple(inducing.shape)}")
    if len(features) != len(targets):
        raise ShapeError(f"features and targets need the same number of rows; got {len(features)} and {len(targets)}")
    # Of one row, for its checks of everything else; the data themselves are checked by their sum.
    shell = GPPosterior.from_hyperparameters(features[:1], targets[:1], *hyperparameters, input_dim, predicts, offset)
    for name, value in (("inducing", inducing), ("features", features), ("targets", targets)):
        if value.dtype != torch.float64 or not bool(torch.isfinite(value).all()):
            raise SettingError(name, "must be finite and in float64")
    try:
        Lz = inducing_factor(inducing, hyperparameters, jitter or 0.0)
    except SettingError:
        if jitter is not None:
            raise
        Lz = inducing_factor(inducing, hyperparameters, JITTER)
    sums = data_sums(Lz, inducing, features, targets - offset, hyperparameters, method)
    # Ascending: the largest rows of what is factorised come first, as QR needs.
    b, U = torch.linalg.eigh(sums.gram)
    b = b.clamp_min(_UNINFORMED)
    upper = torch.linalg.qr(((1 + b) / b).sqrt()[..., None] * (Lz @ U).mT).R
    cholesky = (upper * upper.diagonal(dim1=-2, dim2=-1).sign()[..., None]).mT.contiguous()
    projections = U.mT @ sums.projections[..., None]
    weights = torch.linalg.solve_triangular(Lz.mT, U @ (projections / (1 + b)[..., None]), upper=True)
    pseudo_targets = (cholesky @ (cholesky.mT @ weights))[..., 0].mT + offset
    return replace(shell, features=inducing.clone(), targets=pseudo_targets, cholesky=cholesky, weights=weights[..., 0])


def check_method(method: str) -> None:
    """Raises ``SettingError`` unless a method is known."""
    if method not in ("sgpr", "fitc"):
        raise SettingError("method", f"must be 'sgpr' or 'fitc'; got {method!r}")


def collapsed_bound_with_gradient(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    hyperparameters: Hyperparameters,
    method: Method = "sgpr",
    jitter: float = JITTER,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """The bound on the log marginal likelihood (SGPR), or FITC's own log marginal likelihood, of every output (k,).

    Arguments are as for ``sparse_posterior``.

    Returns:
        The bound, and the derivatives of its sum over the outputs by inducing (M, d), lengthscales (k, d),
        signal_variance and noise_variance (k,).

    Raises:
        SettingError: Kzz is not positive definite, or the method is unknown.
    """
    check_method(method)
    values, by_inducing, by_others = [], torch.zeros_like(inducing), []
    for a in range(targets.shape[1]):
        y = targets[:, a : a + 1]
        variables = [v.detach().requires_grad_() for v in (inducing, *hyperparameters.output(a))]
        Z, kernel = variables[0], Hyperparameters(*variables[1:])
        with torch.enable_grad():
            Lz = inducing_factor(Z, kernel, jitter)
        cut = Lz.detach().requires_grad_()
        sums = [s.requires_grad_() for s in data_sums(cut, Z, features, y, kernel, method)]
        with torch.enable_grad():
            value = _bound(_Sums(*sums), len(features), kernel, method)
            direct = torch.autograd.grad(value.sum(), [*sums, *variables[2:]], materialize_grads=True)
        weights, gradients = direct[:4], [torch.zeros_like(v) for v in variables]
        gradients[2] += direct[4]
        gradients[3] += direct[5]
        by_factor = torch.zeros_like(cut)
        for block in _blocks(len(features), len(inducing)):
            with torch.enable_grad():
                part = _block_sums(cut, Z, features[block], y[block], kernel, method)
                total = torch.stack([(w * s).sum() for w, s in zip(weights, part, strict=True)]).sum()
                found = torch.autograd.grad(total, [cut, *variables])
            by_factor += found[0]
            for gradient, more in zip(gradients, found[1:], strict=True):
                gradient += more
        through = torch.autograd.grad(Lz, variables[:3], by_factor)
        for gradient, more in zip(gradients, through, strict=False):
            gradient += more
        values.append(value.detach())
        by_inducing += gradients[0]
        by_others.append(gradients[1:])
    by_lengthscales, by_signal, by_noise = (torch.cat(of_one) for of_one in zip(*by_others, strict=True))
    return torch.cat(values), (by_inducing, by_lengthscales, by_signal, by_noise)


def data_sums(
    Lz: Tensor,
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    hyperparameters: Hyperparameters,
    method: Method,
) -> _Sums:
    """The sums over all points, of every output, in blocks; no derivatives.

    tr(A A') is, in units of the noise, the variance of the data that the inducing points explain.
    """
    outputs = []
    with torch.no_grad():
        for a in range(targets.shape[1]):
            own = hyperparameters.output(a)
            total = None
            for block in _blocks(len(features), len(inducing)):
                part = _block_sums(Lz[a, None], inducing, features[block], targets[block, a, None], own, method)
                total = part if total is None else _Sums(*(t.add_(p) for t, p in zip(total, part, strict=True)))
            outputs.append(total)
    return _Sums(*(torch.cat(of_one) for of_one in zip(*outputs, strict=True)))


def inducing_factor(inducing: Tensor, hyperparameters: Hyperparameters, jitter: float) -> Tensor:
    """Lz (k, M, M), the Cholesky factor of Kzz with a jitter in units of sf2.

    Raises:
        SettingError: Kzz is not positive definite.
    """
    lengthscales, signal_variance, _ = hyperparameters
    Kzz = kernel_matrix(inducing, inducing, lengthscales, signal_variance)
    Kzz = Kzz + torch.diag_embed((jitter * signal_variance)[:, None].expand(-1, len(inducing)))
    Lz, info = torch.linalg.cholesky_ex(Kzz)
    if bool(info.any()):
        output = int(torch.nonzero(info)[0])
        raise SettingError(
            "inducing",
            f"their kernel matrix of output {output} is not positive definite: points too near each other for its "
            "length-scales; take fewer, or a larger jitter",
        )
    return Lz


def _block_sums(
    Lz: Tensor,
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    hyperparameters: Hyperparameters,
    method: Method,
) -> _Sums:
    lengthscales, signal_variance, noise_variance = hyperparameters
    whitened = torch.linalg.solve_triangular(Lz, _cross(inducing, features, lengthscales, signal_variance), upper=False)
    Lam = noise_variance[:, None].expand(-1, len(features))
    if method == "fitc":
        Lam = (signal_variance[:, None] - whitened.square().sum(-2)).clamp_min(0) + Lam
    root = Lam.sqrt()
    A, r = whitened / root[:, None, :], targets.mT / root
    return _Sums(A @ A.mT, (A @ r[..., None])[..., 0], r.square().sum(-1), Lam.log().sum(-1))


def _bound(sums: _Sums, size: int, hyperparameters: Hyperparameters, method: Method) -> Tensor:
    _, signal_variance, noise_variance = hyperparameters
    eye = torch.eye(sums.gram.shape[-1], dtype=sums.gram.dtype, device=sums.gram.device)
    LB = torch.linalg.cholesky(sums.gram + eye)
    explained = torch.linalg.solve_triangular(LB, sums.projections[..., None], upper=False).square().sum((-2, -1))
    logdet = 2 * LB.diagonal(dim1=-2, dim2=-1).log().sum(-1) + sums.logdet
    bound = -(size * math.log(2 * math.pi) + logdet + sums.squares - explained) / 2
    if method == "sgpr":
        trace = sums.gram.diagonal(dim1=-2, dim2=-1).sum(-1)
        bound = bound - (size * signal_variance / noise_variance - trace) / 2
    return bound


def _cross(inducing: Tensor, features: Tensor, lengthscales: Tensor, signal_variance: Tensor) -> Tensor:
    """Kzx (k, M, N) by one matrix product an output; around a common centre, so that little cancels."""
    centre = inducing.detach().mean(0)
    z = (inducing - centre) / lengthscales[:, None, :]
    x = (features - centre) / lengthscales[:, None, :]
    half = z.square().sum(-1)[..., :, None] / 2 + x.square().sum(-1)[..., None, :] / 2
    return signal_variance[:, None, None] * (z @ x.mT - half).clamp_max(0).exp()


def _blocks(size: int, inducing: int) -> list[slice]:
    step = max(_ENTRIES // inducing, 64)
    return [slice(begin, begin + step) for begin in range(0, size, step)]
