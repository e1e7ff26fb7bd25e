"""A Gaussian given a measurement, in square-root form.

With Sigma = L L', a measurement y = H x + v and v ~ N(0, N), the posterior covariance
is

    Sigma+ = L (I - Y' (Y Y' + N)^-1 Y) L',     Y = H L

and Sigma - K S K' takes two numbers of the size of Sigma from each other: where Sigma
is 1e16 times N no digit is left. Here L itself is turned into a root of Sigma+, by an
orthogonal matrix T that makes the array lower triangular (Kailath, Sayed and Hassibi,
2000, chapter 12):

    [Y  N^(1/2)] T = [S^(1/2)  0 ],      S = Y Y' + N,   K = G S^(-1/2)
    [L  0      ]     [G        L+]

T is made of reflections of Householder. The columns of the prior, which are large, come
before those of the noise, so that large and small entries are not mixed (Cox and
Higham, 1998): the error of a standard deviation is round-off of the prior's, relatively
that of Sigma+ the root of what Sigma - K S K' loses.

Sensors that are perfect, or nearly, are taken one by one instead. What one of them
shows of what others have shown already is round-off of its row, and must not be taken
for knowledge: two such sensors that contradict each other would move other states.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc.gaussian import nearest_positive_semidefinite

_ROUND_OFF = 16.0  # of a sum of products, in units of the last place of its largest
# deviation of a sensor's noise over what it shows: below, it is nearly perfect
_PERFECT = 1e-6


class Conditioned(NamedTuple):
    """A Gaussian after a measurement."""

    gain: Tensor  #: K (*batch, n, p): the mean moves by K times the innovation
    root: Tensor  #: L+ (*batch, n, n), with L+ L+' the posterior covariance

    @property
    def covariance(self) -> Tensor:
        """Covariance (*batch, n, n): symmetric and positive semidefinite."""
        return squared(self.root)


def squared(root: Tensor) -> Tensor:
    """Computes L L' (*batch, n, n) of a root L, symmetric to the last digit."""
    covariance = root @ root.mT
    return (covariance + covariance.mT) / 2


def covariance_root(covariance: Tensor) -> Tensor:
    """Computes a root L (*batch, n, n) with L L' = Sigma.

    It is Cholesky's where Sigma has one. Of singular covariances it is that of the
    correlations, times the deviations: a small variance beside a large one keeps its
    digits. What is left of a variance by cancellation, round-off of it, is none.
    """
    factor, info = torch.linalg.cholesky_ex(covariance)
    variances = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    pivots = factor.diagonal(dim1=-2, dim2=-1).square()
    eps = torch.finfo(covariance.dtype).eps
    singular = (info > 0) | (pivots <= eps * variances).any(-1)
    if not bool(singular.any()):
        return factor
    deviations = variances.sqrt()
    inverse = torch.where(deviations > 0, 1 / deviations, 0.0)
    correlations = inverse[..., :, None] * covariance * inverse[..., None, :]
    eigenvalues, vectors = torch.linalg.eigh((correlations + correlations.mT) / 2)
    positive = eigenvalues > covariance.shape[-1] * eps * eigenvalues[..., -1:]
    lengths = torch.where(positive, eigenvalues, 0.0).sqrt()
    root = deviations[..., :, None] * vectors * lengths[..., None, :]
    return torch.where(singular[..., None, None], root, factor)


def whitened_cross_covariance(root: Tensor, cross_covariance: Tensor) -> Tensor:
    """Computes Y = Cov[y, x] L'^-1 (*batch, p, n), for Cov[x, y] = L Y' (*batch, n, p).

    It is the least one if L is singular. Y = H L where the measurement is linear, and
    the best linear one elsewhere.
    """
    regular = bool((root.diagonal(dim1=-2, dim2=-1) > 0).all())
    if regular and torch.equal(root, root.tril()):
        solved = torch.linalg.solve_triangular(root, cross_covariance, upper=False)
        return solved.mT
    # Rows in the units of their deviations: small states are not lost beside large
    # ones.
    deviations = root.norm(dim=-1, keepdim=True)
    inverse = torch.where(deviations > 0, 1 / deviations, 0.0)
    return (torch.linalg.pinv(inverse * root) @ (inverse * cross_covariance)).mT


def unexplained_covariance(covariance: Tensor, H_root: Tensor) -> Tensor:
    """Computes the part of Cov[y] (*batch, p, p) that Y = H L does not explain.

    That is the error of linearisation, a covariance. Sigma points of which one has a
    negative weight may find less of Cov[y] than Y explains: what lies below zero is
    left out, since it would take from the sensors' noise, which is known.

    Entries that are round-off of Cov[y] are zero.
    """
    remainder = covariance - H_root @ H_root.mT
    remainder = (remainder + remainder.mT) / 2
    deviations = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    sizes = deviations[..., :, None] * deviations[..., None, :]
    round_off = _ROUND_OFF * torch.finfo(covariance.dtype).eps
    remainder = torch.where(remainder.abs() <= round_off * sizes, 0.0, remainder)
    correlations = torch.where(sizes > 0, remainder / sizes, 0.0)
    projected, deficit = nearest_positive_semidefinite(correlations)
    indefinite = deficit > round_off * deviations.shape[-1]
    return torch.where(indefinite[..., None, None], sizes * projected, remainder)


def condition(root: Tensor, H_root: Tensor, noise: Tensor) -> Conditioned:
    """Conditions a Gaussian of root L on a measurement y = H x + v.

    Args:
        root: L (*batch, n, n).
        H_root: Y = H L (*batch, p, n); a row of zeros shows nothing.
        noise: N (*batch, p, p), positive semidefinite: zero for what is measured
            exactly.
    """
    batch = H_root.shape[:-2]
    p, n = H_root.shape[-2:]
    noise = noise.expand(*batch, p, p)
    root = root.expand(*batch, n, n)
    noise_root, info = torch.linalg.cholesky_ex(noise)
    deviations = noise_root.diagonal(dim1=-2, dim2=-1)
    # One sensor alone has no other to contradict.
    nearly_perfect = (p > 1) & (deviations <= _PERFECT * H_root.norm(dim=-1))
    if bool((info > 0).any() | nearly_perfect.any()):
        return _one_by_one(root, H_root, noise)
    of_prior = torch.cat([H_root.mT, root.mT], dim=-1)
    of_noise = torch.cat([noise_root.mT, root.new_zeros(*batch, p, n)], dim=-1)
    triangular = torch.linalg.qr(torch.cat([of_prior, of_noise], dim=-2), mode="r").R.mT
    innovation_root = triangular[..., :p, :p]
    gain = torch.linalg.solve_triangular(
        innovation_root, triangular[..., p:, :p], upper=False, left=False
    )
    return Conditioned(gain=gain, root=triangular[..., p:, p:])


def _one_by_one(root: Tensor, H_root: Tensor, noise: Tensor) -> Conditioned:
    """Conditions by one scalar measurement after the other, also perfect ones."""
    batch = H_root.shape[:-2]
    p = H_root.shape[-2]
    unit_lower, variances = decorrelated(noise)
    rows = torch.linalg.solve_triangular(
        unit_lower, H_root, upper=False, unitriangular=True
    )
    round_off = _ROUND_OFF * torch.finfo(H_root.dtype).eps * rows.norm(dim=-1)
    # What is measured and the states are corrected alike: rows of one matrix.
    factor = torch.cat([rows, root], dim=-2)
    gains = factor.new_zeros(*batch, factor.shape[-2], p)
    unit_innovations = torch.eye(p, dtype=H_root.dtype, device=H_root.device)
    for i in range(p):
        row = factor[..., i, :]
        variance = variances[..., i]
        row = torch.where(row.abs() <= round_off[..., i, None], 0.0, row)
        weights, factor = _corrected(factor, row, variance)
        # How the i-th decorrelated innovation depends on all p; what earlier sensors
        # have corrected already (row i of the gains) is subtracted.
        innovation = unit_innovations[i] - gains[..., i, :]
        gains = gains + weights[..., :, None] * innovation[..., None, :]
    gain = torch.linalg.solve_triangular(
        unit_lower, gains[..., p:, :], upper=False, left=False, unitriangular=True
    )
    return Conditioned(gain=gain, root=factor[..., p:, :])


def _corrected(factor: Tensor, row: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Corrects everything by one scalar measurement.

    The vector that is reflected is (row, sqrt(variance)). In its last column the factor
    is zero: so only ``row`` is stored.

    Args:
        factor: A row of what is corrected each (*batch, q, n).
        row: That of what is measured (*batch, n).
        variance: Of its noise (*batch,).

    Returns:
        Gains (*batch, q), zero where nothing is shown, and the factor given the
        measurement (*batch, q, n).
    """
    innovation = row.square().sum(-1) + variance
    shown = innovation > 0
    scale = torch.where(shown, innovation, 1.0).sqrt()
    largest = row.abs().argmax(-1, keepdim=True)
    pivot = torch.zeros_like(row).scatter(-1, largest, 1.0)
    entry = row.gather(-1, largest)
    sign = torch.where(entry < 0, -1.0, 1.0).to(row)
    normal = row + sign * scale[..., None] * pivot  # of the reflection
    length = scale * (scale + entry[..., 0].abs())  # half of its square
    weight = torch.where(shown, 1 / length, 0.0)
    along = weight[..., None] * (factor @ normal[..., None])[..., 0]
    reflected = factor - along[..., :, None] * normal[..., None, :]
    noise = -along * variance.sqrt()[..., None]
    # The pivot's column has become that of the measurement, and the noise takes its
    # place.
    replaced = shown[..., None, None] & (pivot[..., None, :] > 0)
    corrected = torch.where(replaced, noise[..., :, None], reflected)
    covariances = (factor @ row[..., None])[..., 0]
    gains = torch.where(shown[..., None], covariances / scale[..., None] ** 2, 0.0)
    return gains, corrected


def decorrelated(noise: Tensor) -> tuple[Tensor, Tensor]:
    """Factorises N = T diag(d) T'.

    Returns:
        T (*batch, p, p), unit lower triangular, and d >= 0 (*batch, p).
    """
    p = noise.shape[-1]
    unit_lower = torch.eye(p, dtype=noise.dtype, device=noise.device)
    unit_lower = unit_lower.expand(noise.shape).clone()
    remainder = noise.clone()
    variances = []
    for i in range(p):
        pivot = remainder[..., i, i]
        round_off = _ROUND_OFF * torch.finfo(noise.dtype).eps * noise[..., i, i].abs()
        exact = pivot <= round_off
        pivot = torch.where(exact, 0.0, pivot)
        column = remainder[..., i + 1 :, i]
        divisor = torch.where(exact, 1.0, pivot)[..., None]
        column = torch.where(exact[..., None], 0.0, column / divisor)
        unit_lower[..., i + 1 :, i] = column
        outer = pivot[..., None, None] * column[..., :, None] * column[..., None, :]
        remainder[..., i + 1 :, i + 1 :] -= outer
        variances.append(pivot)
    return unit_lower, torch.stack(variances, dim=-1)
