r"""Problem: an exact GP costs O(N^2) a prediction; thousands of points have to be summed up in a hundred.

With M inducing points Z, Kzz = Lz Lz' and the correlations Kzx with the N data points, the predictive distributions of
SGPR (Titsias, 2009, eq. (6); "VFE") and FITC (Snelson and Ghahramani, 2006, eq. (8)) are

    mean = k' beta,   variance = sf2 - k' C k,       k = k(Z, x~)
    C    = Kzz^-1 - (Kzz + Kzx Lam^-1 Kxz)^-1,       Lam = sn2 I  (SGPR)   or   diag(Kxx - Qxx) + sn2 I  (FITC)

which is an exact GP on M pseudo-observations with correlated noise, K + R = C^-1. So it is frozen to a ``GPPosterior``
on Z, and all that works with one (moment matching, conditioning, dropping) works at the cost of M points. With
A = Lz^-1 Kzx Lam^-1/2 and A A' = U diag(b) U',

    C = Lz^-T U diag(b / (1 + b)) U' Lz^-1,   beta = Lz^-T U diag(1 / (1 + b)) U' A Lam^-1/2 (y - offset)
    cholesky of C^-1:  R', where Q R = diag(sqrt((1 + b) / b)) U' Lz'    (never squared: C^-1 is huge where b is small)

How good hyperparameters and Z are says ``gpmpc.gp.collapsed_bound``. A jitter on Kzz makes u = f(Z) + noise; the bound
stays one.
"""

from dataclasses import replace

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gaussian import check_tensors
from gpmpc.gp.collapsed_bound import JITTER, Method, check_method, data_sums, inducing_factor
from gpmpc.gp.posterior import GPPosterior, Predicts

UNINFORMED = 1e-10  # directions of which the data tell less than this (b) get a pseudo-noise of 1 / this


def sparse_posterior(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
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
        lengthscales: (k, d).
        signal_variance: (k,).
        noise_variance: (k,).
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
    shell = GPPosterior.from_hyperparameters(
        features[:1], targets[:1], lengthscales, signal_variance, noise_variance, input_dim, predicts, offset
    )
    for name, value in (("inducing", inducing), ("features", features), ("targets", targets)):
        if value.dtype != torch.float64 or not bool(torch.isfinite(value).all()):
            raise SettingError(name, "must be finite and in float64")
    try:
        Lz = inducing_factor(inducing, lengthscales, signal_variance, jitter or 0.0)
    except SettingError:
        if jitter is not None:
            raise
        Lz = inducing_factor(inducing, lengthscales, signal_variance, JITTER)
    kernel = (lengthscales, signal_variance, noise_variance)
    sums = data_sums(Lz, inducing, features, targets - offset, *kernel, method)
    # Ascending: the largest rows of what is factorised come first, as QR needs.
    b, U = torch.linalg.eigh(sums.gram)
    b = b.clamp_min(UNINFORMED)
    upper = torch.linalg.qr(((1 + b) / b).sqrt()[..., None] * (Lz @ U).mT).R
    cholesky = (upper * upper.diagonal(dim1=-2, dim2=-1).sign()[..., None]).mT.contiguous()
    told = U.mT @ sums.told[..., None]
    weights = torch.linalg.solve_triangular(Lz.mT, U @ (told / (1 + b)[..., None]), upper=True)
    pseudo_targets = (cholesky @ (cholesky.mT @ weights))[..., 0].mT + offset
    return replace(shell, features=inducing.clone(), targets=pseudo_targets, cholesky=cholesky, weights=weights[..., 0])
