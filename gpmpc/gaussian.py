"""Problem: what is known about a state is a Gaussian belief N(mean, covariance), alone or in a batch."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gpmpc.exceptions import ShapeError


@dataclass(frozen=True)
class Gaussian:
    """N(mean, covariance), batched over leading dimensions.

    Attributes:
        mean: (*batch, n).
        covariance: (*batch, n, n), symmetric.

    Raises:
        ShapeError: The shapes do not belong together.
    """

    mean: Tensor
    covariance: Tensor

    def __post_init__(self) -> None:
        expected = (*self.mean.shape, self.mean.shape[-1]) if self.mean.dim() else ()
        if self.covariance.shape != expected:
            raise ShapeError(
                f"mean (*batch, n) needs a covariance (*batch, n, n); "
                f"got {tuple(self.mean.shape)} and {tuple(self.covariance.shape)}"
            )

    @property
    def dim(self) -> int:
        """n, the dimension of the random vector."""
        return self.mean.shape[-1]

    @property
    def variance(self) -> Tensor:
        """The diagonal of the covariance (*batch, n)."""
        return self.covariance.diagonal(dim1=-2, dim2=-1)


def nearest_positive_semidefinite(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """The symmetric positive semidefinite matrix nearest to a given one in the Frobenius norm (Higham, 1988).

    Args:
        covariance: (*batch, n, n).

    Returns:
        The projection (*batch, n, n), and how far below zero the smallest eigenvalue was (*batch,); zero where the
        symmetrised matrix was positive semidefinite already, which is then returned unchanged.
    """
    symmetric = (covariance + covariance.mT) / 2
    deficit = (-torch.linalg.eigvalsh(symmetric.detach())[..., 0]).clamp_min(0)
    negative = deficit[..., None, None] > 0
    # The derivative of eigh divides by differences of eigenvalues; where nothing is projected it gets distinct ones.
    distinct = torch.arange(1, symmetric.shape[-1] + 1, dtype=symmetric.dtype, device=symmetric.device).diag()
    eigenvalues, vectors = torch.linalg.eigh(torch.where(negative, symmetric, distinct))
    projected = vectors @ (eigenvalues.clamp_min(0)[..., None] * vectors.mT)
    return torch.where(negative, (projected + projected.mT) / 2, symmetric), deficit
