r"""Sparse GPs: M inducing points stand for N data points, for O(M^2) a prediction instead of O(N^2).

With inducing points Z, Kzz = Lz Lz' and the correlations Kzx with the data, the predictive distributions of SGPR
(Titsias, 2009, eq. (6); "VFE") and FITC (Snelson and Ghahramani, 2006, eq. (8)) are

    mean = k' beta,   variance = sf2 - k' C k,       k = k(Z, x~)
    C    = Kzz^-1 - (Kzz + Kzx Lam^-1 Kxz)^-1,       Lam = sn2 I  (SGPR)   or   diag(Kxx - Qxx) + sn2 I  (FITC)

which is an exact GP on M pseudo-observations with correlated noise, K + R = C^-1, and frozen to a ``GPPosterior`` on
Z. With A = Lz^-1 Kzx Lam^-1/2 and A A' = U diag(b) U',

    C = Lz^-T U diag(b / (1 + b)) U' Lz^-1,   beta = Lz^-T U diag(1 / (1 + b)) U' A Lam^-1/2 (y - offset)
    cholesky of C^-1:  R', where Q R = diag(sqrt((1 + b) / b)) U' Lz'    (never squared: C^-1 is huge where b is small)

The collapsed bound of Titsias (2009, eq. (9)), for FITC without its last term, measures Z and hyperparameters:

    log N(y | 0, Q + Lam) - tr(Kxx - Qxx) / (2 sn2),     Q = A~' A~,  A~ = Lz^-1 Kzx

It depends on the data through sums over the points alone: with r = Lam^-1/2 y they are A A', A r, r'r and log|Lam|. So
the points come in blocks that fit the cache, each computed once more for the derivatives (checkpoints: Griewank and
Walther, 2008, chapter 12): memory stays that of a block, for any N.
"""

import math
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gpmpc.exceptions import SettingError
from gpmpc.gp._kernel import Hyperparameters, Predicts, check_posterior, kernel_matrix
from gpmpc.gp._posterior import GPPosterior

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
    method: Method = "sgpr",
    jitter: float | None = None,
) -> GPPosterior:
    """Freezes a sparse GP with prior mean zero to M pseudo-observations; errors as of ``from_hyperparameters``.

    Args:
        inducing: Z (M, d), shared by all outputs.
        features: x~ (N, d).
        targets: (N, k).
        hyperparameters: Of the k GPs.
        input_dim: m, how many of the last features are controls.
        predicts: What the targets mean.
        method: ``"sgpr"`` or ``"fitc"``.
        jitter: Added to the diagonal of Kzz, in units of sf2; by default only where it is needed. ``SettingError``
            where Kzz is not positive definite.
    """
    given = {"features": features, "targets": targets, **hyperparameters._asdict()}
    check_posterior(given, input_dim, predicts)
    try:
        Lz = inducing_factor(inducing, hyperparameters, jitter or 0.0)
    except SettingError:
        if jitter is not None:
            raise
        Lz = inducing_factor(inducing, hyperparameters, JITTER)
    sums = data_sums(Lz, inducing, features, targets, hyperparameters, method)
    # Ascending: the largest rows of what is factorised come first, as QR needs.
    b, U = torch.linalg.eigh(sums.gram)
    b = b.clamp_min(_UNINFORMED)
    upper = torch.linalg.qr(((1 + b) / b).sqrt()[..., None] * (Lz @ U).mT).R
    cholesky = (
        upper * upper.diagonal(dim1=-2, dim2=-1).sign()[..., None]
    ).mT.contiguous()
    projections = U.mT @ sums.projections[..., None]
    weights = torch.linalg.solve_triangular(
        Lz.mT, U @ (projections / (1 + b)[..., None]), upper=True
    )
    pseudo_targets = (cholesky @ (cholesky.mT @ weights))[..., 0].mT
    kernel = Hyperparameters(*(value.clone() for value in hyperparameters))
    offset = torch.zeros_like(pseudo_targets[0])
    return GPPosterior(
        inducing.clone(),
        pseudo_targets,
        *kernel,
        offset,
        cholesky,
        weights[..., 0],
        input_dim,
        predicts,
    )


def collapsed_bound(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    hyperparameters: Hyperparameters,
    method: Method = "sgpr",
    jitter: float = JITTER,
) -> Tensor:
    """The bound on the log marginal likelihood (SGPR), or FITC's own log marginal likelihood, of every output (k,).

    Arguments and errors are as for ``sparse_posterior``; ``backward`` differentiates it by inducing points and
    hyperparameters.
    """
    if (outputs := targets.shape[1]) > 1:
        kernels = [
            Hyperparameters(*(value[a, None] for value in hyperparameters))
            for a in range(outputs)
        ]
        columns = targets.split(1, dim=1)
        return torch.cat(
            [
                collapsed_bound(inducing, features, *of, method, jitter)
                for of in zip(columns, kernels, strict=True)
            ]
        )
    Lz = inducing_factor(inducing, hyperparameters, jitter)
    sums = data_sums(Lz, inducing, features, targets, hyperparameters, method)
    LB = torch.linalg.cholesky(
        sums.gram + torch.eye(len(inducing), dtype=Lz.dtype, device=Lz.device)
    )
    explained = (
        torch.linalg.solve_triangular(LB, sums.projections[..., None], upper=False)
        .square()
        .sum((-2, -1))
    )
    logdet = 2 * LB.diagonal(dim1=-2, dim2=-1).log().sum(-1) + sums.logdet
    bound = (
        -(len(features) * math.log(2 * math.pi) + logdet + sums.squares - explained) / 2
    )
    if method == "fitc":
        return bound
    trace = sums.gram.diagonal(dim1=-2, dim2=-1).sum(-1)
    prior = (
        len(features) * hyperparameters.signal_variance / hyperparameters.noise_variance
    )
    return bound - (prior - trace) / 2


def data_sums(
    Lz: Tensor, Z: Tensor, x: Tensor, y: Tensor, kernel: Hyperparameters, method: Method
) -> _Sums:
    """The sums over all points, of every output, in blocks."""
    step = max(_ENTRIES // len(Z), 64)
    outputs = []
    for a in range(y.shape[1]):
        total: Any = 0.0, 0.0, 0.0, 0.0
        for rows in (slice(begin, begin + step) for begin in range(0, len(x), step)):
            block: Any = (
                Lz[a, None],
                Z,
                x[rows],
                y[rows, a, None],
                *(value[a, None] for value in kernel),
                method,
            )
            if torch.is_grad_enabled() and step < len(x):
                part: Any = checkpoint(
                    _block_sums, *block, use_reentrant=True, preserve_rng_state=False
                )
            else:
                part = _block_sums(*block)
            total = [t + p for t, p in zip(total, part, strict=True)]
        outputs.append(total)
    return _Sums(*(torch.cat(of_one) for of_one in zip(*outputs, strict=True)))


def inducing_factor(inducing: Tensor, kernel: Hyperparameters, jitter: float) -> Tensor:
    """Lz (k, M, M), the Cholesky factor of Kzz with a jitter in units of sf2; raises where there is none."""
    Kzz = kernel_matrix(inducing, inducing, kernel.lengthscales, kernel.signal_variance)
    Kzz = Kzz + torch.diag_embed(
        (jitter * kernel.signal_variance)[:, None].expand(-1, len(inducing))
    )
    Lz, info = torch.linalg.cholesky_ex(Kzz)
    if bool(info.any()):
        raise SettingError(
            "inducing",
            f"their kernel matrix of output {int(torch.nonzero(info)[0])} is not positive definite: points too near "
            "each other for its length-scales; take fewer, or a larger jitter",
        )
    return Lz


def _block_sums(
    Lz: Tensor, Z: Tensor, x: Tensor, y: Tensor, *kernel_and_method: Any
) -> _Sums:
    *tensors, method = kernel_and_method
    kernel = Hyperparameters(*tensors)
    _, signal_variance, noise_variance = kernel
    whitened = torch.linalg.solve_triangular(Lz, _cross(Z, x, kernel), upper=False)
    Lam = noise_variance[:, None].expand(-1, len(x))
    if method == "fitc":
        Lam = (signal_variance[:, None] - whitened.square().sum(-2)).clamp_min(0) + Lam
    root = Lam.sqrt()
    A = whitened / root[:, None, :]
    r = y.mT / root
    return _Sums(
        A @ A.mT, (A @ r[..., None])[..., 0], r.square().sum(-1), Lam.log().sum(-1)
    )


def _cross(inducing: Tensor, features: Tensor, kernel: Hyperparameters) -> Tensor:
    """Kzx (k, M, N) by one matrix product an output; around a common centre, so that little cancels."""
    centre = inducing.detach().mean(0)
    scales = kernel.lengthscales[:, None, :]
    z = (inducing - centre) / scales
    x = (features - centre) / scales
    half = z.square().sum(-1)[..., :, None] / 2 + x.square().sum(-1)[..., None, :] / 2
    return kernel.signal_variance[:, None, None] * (z @ x.mT - half).clamp_max(0).exp()
