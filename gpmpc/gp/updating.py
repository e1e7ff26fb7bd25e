"""Problem: points come and go while a controller runs, and factorising K + sn2 I anew each time is cubic in them.

Adding points extends the Cholesky factor by rows, dropping one changes only the block below it, by a rank-one term
(Gill, Golub, Murray and Saunders, 1974; Osborne, 2010, appendix B, for GPs). With K + sn2 I = L L' and p new points X*,

    L+ = [ L    0 ]        L22 L22' = K(X*, X*) + sn2 I - L21 L21',      L21' = L^-1 K(X, X*)
         [ L21 L22]

    dropping i:  L33+ L33+' = L33 L33' + l32 l32',     l32 = L[i+1:, i]

which is O(N^2) a point. The second is an update by a positive term, which is stable; and the weights are solved for
from the factor each time, two triangular systems, so that no error is carried along with them.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gpmpc.compiled import compiled
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import check_tensors
from gpmpc.gp.kernel import kernel_matrix

if TYPE_CHECKING:
    from gpmpc.gp.posterior import GPPosterior

MANY = 0.2  # where more than this part of the points is dropped, one factorisation costs less than the updates


def extended(posterior: "GPPosterior", features: Tensor, targets: Tensor) -> "GPPosterior":
    """The posterior that has seen p more points; see ``GPPosterior.condition_on_targets``."""
    features, targets = (_checked(posterior, *given) for given in _expected(posterior, features, targets))
    size, p = len(posterior), len(features)
    scales, sf2 = posterior.lengthscales, posterior.signal_variance
    old_targets = (posterior.targets - posterior.offset).mT[..., None]  # (k, N, 1)
    new_targets = (targets - posterior.offset).mT[..., None]
    # One pass over the factor serves the new rows and the first half of the weights.
    right = torch.cat([kernel_matrix(posterior.features, features, scales, sf2), old_targets], dim=-1)
    right = torch.linalg.solve_triangular(posterior.cholesky, right, upper=False)
    L21, w1 = right[..., :p].mT, right[..., p:]
    corner = kernel_matrix(features, features, scales, sf2) - L21 @ L21.mT
    corner.diagonal(dim1=-2, dim2=-1).add_(posterior.noise_variance[:, None])
    L22, info = torch.linalg.cholesky_ex(corner)
    if bool(info.any()):
        output = int(torch.nonzero(info)[0])
        ratio = float((sf2 / posterior.noise_variance)[output])
        raise SettingError(
            "noise_variance",
            f"with the new points the kernel matrix of output {output} is not positive definite in {posterior.dtype}; "
            f"signal-to-noise ratio {ratio:.1e}: raise the noise",
        )
    cholesky = posterior.cholesky.new_empty(posterior.output_dim, size + p, size + p)
    cholesky[:, :size, :size] = posterior.cholesky
    cholesky[:, :size, size:] = 0
    cholesky[:, size:, :size] = L21
    cholesky[:, size:, size:] = L22
    w2 = torch.linalg.solve_triangular(L22, new_targets - L21 @ w1, upper=False)
    weights = torch.linalg.solve_triangular(cholesky.mT, torch.cat([w1, w2], dim=-2), upper=True)[..., 0]
    return replace(
        posterior,
        features=torch.cat([posterior.features, features]),
        targets=torch.cat([posterior.targets, targets]),
        cholesky=cholesky,
        weights=weights,
    )


def without(posterior: "GPPosterior", indices: Sequence[int] | Tensor) -> "GPPosterior":
    """The posterior that has not seen some of its points; see ``GPPosterior.drop``."""
    size = len(posterior)
    dropped = _indices(indices, size)
    if not dropped:
        return posterior
    chosen = set(dropped)
    kept = torch.tensor([i for i in range(size) if i not in chosen], device=posterior.device)
    if not len(kept):
        raise DataError(f"a posterior needs at least one point; dropping {len(dropped)} of {size} leaves none")
    if posterior.device.type != "cpu" or posterior.cholesky.requires_grad or len(dropped) > MANY * size:
        rows = posterior.cholesky[:, kept]
        first = dropped[0]  # nothing changes above it
        cholesky = rows[:, :, kept]
        cholesky[:, first:, first:] = torch.linalg.cholesky(rows[:, first:, first:] @ rows[:, first:, first:].mT)
    else:
        cholesky = posterior.cholesky.new_zeros(posterior.output_dim, len(kept), len(kept))
        before = posterior.cholesky.detach().numpy()
        for factor, smaller in zip(before, cholesky.numpy(), strict=True):
            _remove(factor, smaller, kept.numpy(), np.array(dropped))
    targets = posterior.targets[kept]
    right = (targets - posterior.offset).mT[..., None]
    half = torch.linalg.solve_triangular(cholesky, right, upper=False)
    weights = torch.linalg.solve_triangular(cholesky.mT, half, upper=True)[..., 0]
    return replace(posterior, features=posterior.features[kept], targets=targets, cholesky=cholesky, weights=weights)


@compiled
def _remove(factor: np.ndarray, smaller: np.ndarray, kept: np.ndarray, dropped: np.ndarray) -> None:
    """Writes the lower factor of the rows that are kept, from that of all (N, N), into ``smaller`` (N - r, N - r).

    Every dropped column v is absorbed by the block below it, L L' + v v', through plane rotations; the last one first,
    so that each meets only columns that stay. Row by row: row i needs the rotations of the columns before it, which
    are known once their own rows were reached.
    """
    size = len(kept)
    for i in range(size):
        for j in range(i + 1):
            smaller[i, j] = factor[kept[i], kept[j]]
    c, s = np.empty(size), np.empty(size)
    for which in range(len(dropped) - 1, -1, -1):
        start = dropped[which] - which
        for i in range(start, size):
            row, v = smaller[i], factor[kept[i], dropped[which]]
            for j in range(start, i):
                entry = row[j]
                row[j] = c[j] * entry + s[j] * v
                v = c[j] * v - s[j] * entry
            radius = np.hypot(row[i], v)
            c[i], s[i] = row[i] / radius, v / radius
            row[i] = radius


def _expected(posterior: "GPPosterior", features: Tensor, targets: Tensor) -> tuple[tuple, tuple]:
    check_tensors(features=features, targets=targets)
    if features.dim() != 2 or targets.dim() != 2 or len(features) != len(targets) or not len(features):
        raise ShapeError(
            "features (p, d) and targets (p, k) need two dimensions and the same number of rows, one or more; "
            f"got {tuple(features.shape)} and {tuple(targets.shape)}"
        )
    return (
        ("features", features, posterior.features.shape[1]),
        ("targets", targets, posterior.output_dim),
    )


def _checked(posterior: "GPPosterior", name: str, value: Tensor, columns: int) -> Tensor:
    if value.shape[1] != columns:
        raise ShapeError(f"{name} must have {columns} columns like the posterior's; got {value.shape[1]}")
    if not bool(torch.isfinite(value).all()):
        raise DataError(f"{name} must be finite; got {value[~torch.isfinite(value)][0]}")
    return value.to(posterior.features)


def _indices(indices: Sequence[int] | Tensor, size: int) -> list[int]:
    """Different indices from 0 to size - 1 in ascending order; negative ones count from the end, as everywhere."""
    given = indices.tolist() if isinstance(indices, Tensor | np.ndarray) else indices
    given = [given] if isinstance(given, int) else list(given)
    if any(isinstance(i, bool) or not isinstance(i, int | np.integer) or not -size <= i < size for i in given):
        raise SettingError("indices", f"must be whole numbers from {-size} to {size - 1}; got {given}")
    found = sorted({int(i) % size for i in given})
    if len(found) != len(given):
        raise SettingError("indices", f"must be different; got {given}")
    return found
