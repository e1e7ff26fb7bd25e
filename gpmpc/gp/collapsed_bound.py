r"""Problem: what a sparse GP's search climbs costs O(N M^2), and its intermediates are M x N matrices, dozens of them.

The bound of Titsias (2009, eq. (9)), for FITC (Snelson and Ghahramani, 2006) without its last term,

    log N(y | 0, Q + Lam) - tr(Kxx - Qxx) / (2 sn2),     Q = A~' A~,  A~ = Lz^-1 Kzx,
    Lam = sn2 I  (SGPR)   or   diag(Kxx - Qxx) + sn2 I  (FITC)

depends on the data through sums over the points alone: with A = A~ Lam^-1/2 and r = Lam^-1/2 y they are A A', A r, r'r
and log|Lam|. So the points come in blocks that fit the cache, output after output: first the sums; then the bound and
its derivatives by the sums, all M x M; then block by block once more the derivatives of each block's part (automatic
differentiation with one checkpoint, Griewank and Walther, 2008, chapter 12). Memory stays that of a block, for any N.
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError
from gpmpc.gp.kernel import kernel_matrix

Method = Literal["sgpr", "fitc"]
JITTER = 1e-8  # of Kzz, in units of sf2
ENTRIES = 200_000  # of a block of A


class Sums(NamedTuple):
    """What the bound needs to know of the data, of every output.

    Attributes:
        gram: A A' (k, M, M).
        told: A r (k, M).
        squares: r'r (k,).
        logdet: log|Lam| (k,).
    """

    gram: Tensor
    told: Tensor
    squares: Tensor
    logdet: Tensor


def check_method(method: str) -> None:
    """Raises where a method is neither of the two.

    Raises:
        SettingError: So.
    """
    if method not in ("sgpr", "fitc"):
        raise SettingError("method", f"must be 'sgpr' or 'fitc'; got {method!r}")


def collapsed_bound(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
    method: Method = "sgpr",
    jitter: float = JITTER,
) -> Tensor:
    """The bound on the log marginal likelihood (SGPR), or FITC's own log marginal likelihood, of every output (k,).

    Differentiable by all of its tensors, in one piece; arguments as in ``gpmpc.gp.sparse.sparse_posterior``.

    Raises:
        SettingError: Kzz is not positive definite, or the method is unknown.
    """
    check_method(method)
    Lz = inducing_factor(inducing, lengthscales, signal_variance, jitter)
    sums = _block_sums(Lz, inducing, features, targets, lengthscales, signal_variance, noise_variance, method)
    return _bound(sums, len(features), signal_variance, noise_variance, method)


def collapsed_bound_with_gradient(
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
    method: Method = "sgpr",
    jitter: float = JITTER,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """``collapsed_bound`` (k,), and the derivatives of its sum over the outputs, in blocks.

    Returns:
        The bound, and its sum's derivatives by inducing (M, d), lengthscales (k, d), signal_variance and noise_variance
        (k,).

    Raises:
        SettingError: Kzz is not positive definite, or the method is unknown.
    """
    check_method(method)
    values, by_inducing, by_others = [], torch.zeros_like(inducing), []
    for a in range(targets.shape[1]):
        y = targets[:, a : a + 1]
        variables = [v.detach().requires_grad_() for v in (inducing, *(v[a, None] for v in (
            lengthscales, signal_variance, noise_variance)))]  # fmt: skip
        with torch.enable_grad():
            Lz = inducing_factor(*variables[:3], jitter)
        cut = Lz.detach().requires_grad_()
        sums = [s.requires_grad_() for s in data_sums(cut, variables[0], features, y, *variables[1:], method)]
        with torch.enable_grad():
            value = _bound(Sums(*sums), len(features), *variables[2:], method)
            direct = torch.autograd.grad(value.sum(), [*sums, *variables[2:]], materialize_grads=True)
        weights, gradients = direct[:4], [torch.zeros_like(v) for v in variables]
        gradients[2] += direct[4]
        gradients[3] += direct[5]
        by_factor = torch.zeros_like(cut)
        for block in _blocks(len(features), len(inducing)):
            with torch.enable_grad():
                part = _block_sums(cut, variables[0], features[block], y[block], *variables[1:], method)
                total = sum((w * s).sum() for w, s in zip(weights, part, strict=True))
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
    return torch.cat(values), (by_inducing, *(torch.cat(of_one) for of_one in zip(*by_others, strict=True)))


def data_sums(
    Lz: Tensor,
    inducing: Tensor,
    features: Tensor,
    targets: Tensor,
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
    method: Method,
) -> Sums:
    """The sums over all points, of every output, in blocks; no derivatives."""
    outputs = []
    with torch.no_grad():
        for a in range(targets.shape[1]):
            own = [v[a, None] for v in (lengthscales, signal_variance, noise_variance)]
            total = None
            for block in _blocks(len(features), len(inducing)):
                part = _block_sums(Lz[a, None], inducing, features[block], targets[block, a, None], *own, method)
                total = part if total is None else Sums(*(t.add_(p) for t, p in zip(total, part, strict=True)))
            outputs.append(total)
    return Sums(*(torch.cat(of_one) for of_one in zip(*outputs, strict=True)))


def inducing_factor(inducing: Tensor, lengthscales: Tensor, signal_variance: Tensor, jitter: float) -> Tensor:
    """Lz (k, M, M), the Cholesky factor of Kzz with a jitter in units of sf2.

    Raises:
        SettingError: Kzz is not positive definite.
    """
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
    lengthscales: Tensor,
    signal_variance: Tensor,
    noise_variance: Tensor,
    method: Method,
) -> Sums:
    whitened = torch.linalg.solve_triangular(Lz, _cross(inducing, features, lengthscales, signal_variance), upper=False)
    Lam = noise_variance[:, None].expand(-1, len(features))
    if method == "fitc":
        Lam = (signal_variance[:, None] - whitened.square().sum(-2)).clamp_min(0) + Lam
    root = Lam.sqrt()
    A, r = whitened / root[:, None, :], targets.mT / root
    return Sums(A @ A.mT, (A @ r[..., None])[..., 0], r.square().sum(-1), Lam.log().sum(-1))


def _bound(sums: Sums, size: int, signal_variance: Tensor, noise_variance: Tensor, method: Method) -> Tensor:
    eye = torch.eye(sums.gram.shape[-1], dtype=sums.gram.dtype, device=sums.gram.device)
    LB = torch.linalg.cholesky(sums.gram + eye)
    explained = torch.linalg.solve_triangular(LB, sums.told[..., None], upper=False).square().sum((-2, -1))
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
    step = max(ENTRIES // inducing, 64)
    return [slice(begin, begin + step) for begin in range(0, size, step)]
