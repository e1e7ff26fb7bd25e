r"""Sparse GPs: M inducing points stand for N data points.

A prediction takes O(M^2) instead of O(N^2).

With inducing points Z, Kzz = Lz Lz' and the correlations Kzx with the data, the
predictive distributions of SGPR (Titsias, 2009, eq. (6); "VFE") and FITC (Snelson and
Ghahramani, 2006, eq. (8)) are

    mean = k' beta,   variance = sf2 - k' C k,       k = k(Z, x~)
    C    = Kzz^-1 - (Kzz + Kzx Lam^-1 Kxz)^-1
    Lam  = sn2 I  (SGPR)   or   diag(Kxx - Qxx) + sn2 I  (FITC)

which is an exact GP on M pseudo-observations with correlated noise, K + R = C^-1, and
frozen to a ``GPPosterior`` on Z. With A = Lz^-1 Kzx Lam^-1/2 and A A' = U diag(b) U',

    C    = Lz^-T U diag(b / (1 + b)) U' Lz^-1
    beta = Lz^-T U diag(1 / (1 + b)) U' A Lam^-1/2 (y - offset)
    cholesky of C^-1:  R', where Q R = diag(sqrt((1 + b) / b)) U' Lz'

(R is never squared: C^-1 is huge where b is small.)

The collapsed bound of Titsias (2009, eq. (9)), for FITC without its last term, measures
Z and hyperparameters:

    log N(y | 0, Q + Lam) - tr(Kxx - Qxx) / (2 sn2),     Q = A~' A~,  A~ = Lz^-1 Kzx

It depends on the data through sums over the points alone: with r = Lam^-1/2 y they are
A A', A r, r'r and log|Lam|. So the points come in blocks that fit the cache, each
computed once more for the derivatives (checkpoints: Griewank and Walther, 2008, chapter
12): memory stays that of a block, for any N.
"""

import math
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gpmpc.exceptions import SettingError
from gpmpc.gp._kernel import Hyperparameters, kernel_matrix, kernel_of_squares
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._tensor_checks import Predicts, check_gp_tensors

Method = Literal["sgpr", "fitc"]
# of Kzz, in units of sf2: ``SparseTrainer`` adds it always, ``sparse_posterior`` by
# default only where Kzz has no factor without
JITTER = 1e-8
_ENTRIES = 200_000  # of a block of A
# directions in which the data inform less than this (b) get a pseudo-noise of 1 / this
_UNINFORMED = 1e-10


class _Sums(NamedTuple):
    """Sums over the data, of every output."""

    gram: Tensor  #: A A' (k, M, M)
    projections: Tensor  #: A r (k, M)
    squares: Tensor  #: r'r (k,)
    logdet: Tensor  #: log|Lam| (k,)


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
    """Freezes a sparse GP with prior mean zero to M pseudo-observations.

    Args:
        inducing: Z (M, d), shared by all outputs.
        features: x~ (N, d).
        targets: (N, k).
        hyperparameters: Of the k GPs.
        input_dim: m, how many of the last features are controls.
        predicts: What the targets mean.
        method: ``"sgpr"`` or ``"fitc"``.
        jitter: Added to the diagonal of Kzz, in units of sf2; by default only where it
            is needed.

    Raises:
        SettingError: Kzz is not positive definite. Further errors are those of
            ``GPPosterior.from_hyperparameters``.
    """
    check_gp_tensors(
        features, targets, input_dim, predicts, **hyperparameters._asdict()
    )
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
    signs = upper.diagonal(dim1=-2, dim2=-1).sign()
    cholesky = (upper * signs[..., None]).mT.contiguous()
    projections = U.mT @ sums.projections[..., None]
    shrunk = U @ (projections / (1 + b)[..., None])
    weights = torch.linalg.solve_triangular(Lz.mT, shrunk, upper=True)
    pseudo_targets = (cholesky @ (cholesky.mT @ weights))[..., 0].mT
    return GPPosterior(
        features=inducing.clone(),
        targets=pseudo_targets,
        lengthscales=hyperparameters.lengthscales.clone(),
        signal_variance=hyperparameters.signal_variance.clone(),
        noise_variance=hyperparameters.noise_variance.clone(),
        offset=torch.zeros_like(pseudo_targets[0]),
        cholesky=cholesky,
        weights=weights[..., 0],
        input_dim=int(input_dim),
        predicts=predicts,
    )


def collapsed_bound(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    hyperparameters: Hyperparameters,
    method: Method = "sgpr",
    jitter: float = JITTER,
) -> Tensor:
    """Computes the bound on the log marginal likelihood of every output (k,).

    With FITC it is that method's own log marginal likelihood. ``backward``
    differentiates it by inducing points and hyperparameters. Arguments are as for
    ``sparse_posterior``; the data are not checked.

    Raises:
        SettingError: Kzz is not positive definite.
        torch.linalg.LinAlgError: I + A A' is not, to double precision.
    """
    bounds = [
        _output_bound(
            inducing,
            features,
            targets[:, a, None],
            hyperparameters.of_output(a),
            method,
            jitter,
        )
        for a in range(targets.shape[1])
    ]
    return torch.cat(bounds)


def _output_bound(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    kernel: Hyperparameters,
    method: Method,
    jitter: float,
) -> Tensor:
    """Computes the bound of one output (1,), whose targets are (N, 1)."""
    size = len(features)
    Lz = inducing_factor(inducing, kernel, jitter)
    sums = data_sums(Lz, inducing, features, targets, kernel, method)
    eye = torch.eye(len(inducing), dtype=Lz.dtype, device=Lz.device)
    LB = torch.linalg.cholesky(sums.gram + eye)
    projections = torch.linalg.solve_triangular(
        LB, sums.projections[..., None], upper=False
    )
    explained = projections.square().sum((-2, -1))
    logdet = 2 * LB.diagonal(dim1=-2, dim2=-1).log().sum(-1) + sums.logdet
    bound = -(size * math.log(2 * math.pi) + logdet + sums.squares - explained) / 2
    if method == "fitc":
        return bound
    trace = sums.gram.diagonal(dim1=-2, dim2=-1).sum(-1)
    prior = size * kernel.signal_variance / kernel.noise_variance
    return bound - (prior - trace) / 2


def data_sums(
    Lz: Tensor, Z: Tensor, x: Tensor, y: Tensor, kernel: Hyperparameters, method: Method
) -> _Sums:
    """Computes the sums over all points, of every output, in blocks.

    Args:
        Lz: Factor of Kzz (k, M, M).
        Z: Inducing points (M, d).
        x: Points (N, d).
        y: Targets (N, k).
        kernel: Hyperparameters of the k GPs.
        method: ``"sgpr"`` or ``"fitc"``.
    """
    outputs = [
        _output_sums(Lz[a, None], Z, x, y[:, a, None], kernel.of_output(a), method)
        for a in range(y.shape[1])
    ]
    return _Sums(
        gram=torch.cat([sums.gram for sums in outputs]),
        projections=torch.cat([sums.projections for sums in outputs]),
        squares=torch.cat([sums.squares for sums in outputs]),
        logdet=torch.cat([sums.logdet for sums in outputs]),
    )


def _output_sums(
    Lz: Tensor, Z: Tensor, x: Tensor, y: Tensor, kernel: Hyperparameters, method: Method
) -> _Sums:
    """Computes the sums of one output, whose targets are (N, 1)."""
    step = max(_ENTRIES // len(Z), 64)
    sums_of_block: Any = _block_sums
    in_graph = torch.is_grad_enabled() and any(
        tensor.requires_grad for tensor in (Lz, Z, x, y, *kernel)
    )
    if in_graph and step < len(x):
        # ``checkpoint`` passes tensors on to ``backward`` only as plain arguments.
        sums_of_block = partial(
            checkpoint, _block_sums, use_reentrant=True, preserve_rng_state=False
        )
    total: _Sums | None = None
    for begin in range(0, len(x), step):
        rows = slice(begin, begin + step)
        block = _Sums(*sums_of_block(Lz, Z, x[rows], y[rows], *kernel, method))
        if total is None:
            total = block
        else:
            total = _Sums(
                gram=total.gram + block.gram,
                projections=total.projections + block.projections,
                squares=total.squares + block.squares,
                logdet=total.logdet + block.logdet,
            )
    assert total is not None  # there is a point
    return total


def inducing_factor(inducing: Tensor, kernel: Hyperparameters, jitter: float) -> Tensor:
    """Computes Lz (k, M, M), the Cholesky factor of Kzz with a jitter.

    Args:
        inducing: Z (M, d).
        kernel: Hyperparameters of k GPs.
        jitter: Added to the diagonal, in units of sf2.

    Raises:
        SettingError: A matrix is not positive definite.
    """
    Kzz = kernel_matrix(inducing, inducing, kernel.lengthscales, kernel.signal_variance)
    added = (jitter * kernel.signal_variance)[:, None].expand(-1, len(inducing))
    Lz, info = torch.linalg.cholesky_ex(Kzz + torch.diag_embed(added))
    if bool(info.any()):
        output = int(torch.nonzero(info)[0])
        raise SettingError(
            "inducing",
            f"their kernel matrix of output {output + 1} is not positive definite: "
            "points too near each other for its length-scales; take fewer, or a larger "
            "jitter",
        )
    return Lz


def _block_sums(
    Lz: Tensor,
    Z: Tensor,
    x: Tensor,
    y: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
    method: Method,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Computes what a block of points adds to the fields of ``_Sums``."""
    kernel = Hyperparameters(lengthscales, signal_variance, noise_variance)
    whitened = torch.linalg.solve_triangular(Lz, _cross(Z, x, kernel), upper=False)
    Lam = noise_variance[:, None].expand(-1, len(x))
    if method == "fitc":
        explained = whitened.square().sum(-2)
        Lam = (signal_variance[:, None] - explained).clamp_min(0) + Lam
    root = Lam.sqrt()
    A = whitened / root[:, None, :]
    r = y.mT / root
    gram = A @ A.mT
    projections = (A @ r[..., None])[..., 0]
    return gram, projections, r.square().sum(-1), Lam.log().sum(-1)


def _cross(inducing: Tensor, features: Tensor, kernel: Hyperparameters) -> Tensor:
    """Computes Kzx (k, M, N) by one matrix product an output.

    The points are taken around a common centre, so that little cancels.
    """
    centre = inducing.detach().mean(0)
    scales = kernel.lengthscales[:, None, :]
    z = (inducing - centre) / scales
    x = (features - centre) / scales
    norms = z.square().sum(-1)[..., :, None] + x.square().sum(-1)[..., None, :]
    squares = (norms - 2 * z @ x.mT).clamp_min(0)
    return kernel_of_squares(squares, kernel.signal_variance[:, None, None])
