"""Gaussian beliefs N(mean, covariance), and symmetric square roots of covariances."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad

from gpmpc._arrays import names_of, read_array, sorted_columns
from gpmpc.exceptions import DataError, SettingError, ShapeError

__all__ = ["Gaussian", "nearest_positive_semidefinite", "square_root"]

_FLOATS = np.dtype(np.float64), np.dtype(np.float32), np.dtype(np.float16)


def check_tensors(**values: Any) -> None:
    """Raises ``SettingError`` of the first value by name that is no tensor."""
    for key, value in values.items():
        if not isinstance(value, Tensor):
            raise SettingError(
                key,
                f"must be a torch tensor; got {type(value).__name__} "
                "(torch.as_tensor(..., dtype=torch.float64))",
            )


def check_covariance(key: str, value: Tensor) -> None:
    """Raises ``SettingError`` unless a tensor (p, p) is a covariance.

    It is finite, symmetric and positive semidefinite, up to round-off of its
    deviations; these may be zero.
    """
    if not value.is_floating_point() or not bool(torch.isfinite(value).all()):
        raise SettingError(key, f"must hold finite real numbers; got {value.tolist()}")
    variances = value.diagonal()
    if bool((variances < 0).any()):
        raise SettingError(
            key, f"must have variances of zero or more; got {variances.tolist()}"
        )
    inverse = torch.where(variances > 0, variances.rsqrt(), 1.0)
    correlations = inverse[:, None] * value * inverse
    round_off = 16 * len(value) * torch.finfo(value.dtype).eps
    if bool(((correlations - correlations.mT).abs() > round_off).any()):
        raise SettingError(key, f"must be symmetric; got {value.tolist()}")
    smallest = float(torch.linalg.eigvalsh(correlations)[0])
    if smallest < -round_off:
        raise SettingError(
            key,
            "must be positive semidefinite; got correlations with the eigenvalue "
            f"{smallest:.3g}",
        )


def constant_arrays(*tensors: Tensor) -> list[NDArray[Any]] | None:
    """Returns tensors that are constants in host memory as arrays.

    It takes microseconds: control steps call it repeatedly.

    Returns:
        None where a tensor is on another device, or where autograd or a function
        transform follows it: the caller then computes by torch.
    """
    arrays = []
    try:
        for tensor in tensors:
            arrays.append(tensor.numpy())
            if forward_ad.unpack_dual(tensor).tangent is not None:
                return None
    except (RuntimeError, TypeError):
        return None
    return arrays


@dataclass(frozen=True, eq=False)
class Gaussian:
    """N(mean, covariance), batched over leading dimensions.

    Raises:
        ShapeError: The shapes do not belong together.
        SettingError: One of the two is no tensor.

    >>> import torch
    >>> belief = Gaussian(torch.zeros(2), 0.25 * torch.eye(2))
    >>> belief.dim, belief.variance.sqrt().tolist()
    (2, [0.5, 0.5])

    See Also:
        ``Gaussian.certain``, for a state that was measured exactly.
    """

    mean: Tensor  #: (*batch, n)
    covariance: Tensor  #: (*batch, n, n), symmetric
    #: of the n entries, where they are known: a controller and a filter sort by them
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_tensors(mean=self.mean, covariance=self.covariance)
        expected = (*self.mean.shape, self.mean.shape[-1]) if self.mean.dim() else None
        if self.covariance.shape != expected:
            raise ShapeError(
                f"mean (*batch, n) needs a covariance (*batch, n, n); "
                f"got {tuple(self.mean.shape)} and {tuple(self.covariance.shape)}"
            )

    @classmethod
    def certain(cls, value: Any) -> "Gaussian":
        """Makes a belief without doubt, such as a measured state (*batch, n).

        The value is a tensor, an array or a list. Tensors and arrays of floating point
        keep their type; everything else becomes float64. The labels of a series or of a
        table's columns become the belief's names.

        >>> Gaussian.certain([1.0, 2.0]).variance.tolist()
        [0.0, 0.0]

        Raises:
            ShapeError: No vector of numbers was given.
        """
        mean = _as_mean(value)
        if not mean.dim():
            raise ShapeError(
                f"a state must be numbers (*batch, n); got the single number {value!r}"
            )
        n = mean.shape[-1]
        covariance = torch.zeros(*mean.shape, n, dtype=mean.dtype, device=mean.device)
        has_no_labels = isinstance(value, np.ndarray | Tensor)
        names = () if has_no_labels else names_of(value)
        return cls(mean=mean, covariance=covariance, names=names)

    def in_order(self, names: Sequence[str]) -> "Gaussian":
        """Returns the belief in the order of names; itself if its own are not known.

        Raises:
            DataError: Its own names are others.
        """
        if not self.names or not names or self.names == tuple(names):
            return self
        mean = sorted_columns("state", self.mean, self.names, names)
        by_column = sorted_columns("state", self.covariance, self.names, names)
        covariance = sorted_columns("state", by_column.mT, self.names, names)
        return Gaussian(mean, covariance, tuple(names))

    @property
    def dim(self) -> int:
        """n, the dimension of the random vector."""
        return self.mean.shape[-1]

    @property
    def variance(self) -> Tensor:
        """The diagonal of the covariance (*batch, n)."""
        return self.covariance.diagonal(dim1=-2, dim2=-1)


def _as_mean(value: Any) -> Tensor:
    """Returns a tensor, an array or a list of numbers as a tensor of floating point."""
    if isinstance(value, np.ndarray) and value.dtype in _FLOATS:
        is_reversed = any(stride < 0 for stride in value.strides)
        return torch.as_tensor(value.copy() if is_reversed else value)
    if isinstance(value, Tensor) and _is_real(value):
        return value if value.is_floating_point() else value.to(torch.float64)
    try:
        return torch.from_numpy(np.array(read_array("a state", value)))
    except DataError as error:
        got = str(error).partition("; got ")[2]
        raise ShapeError(f"a state must be numbers (*batch, n); got {got}") from error


def _is_real(value: Tensor) -> bool:
    return not (value.is_complex() or value.dtype == torch.bool)


def nearest_positive_semidefinite(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Projects matrices (*batch, n, n) to the nearest positive semidefinite ones.

    They are nearest in the Frobenius norm (Higham, 1988), and symmetric. Where the
    symmetrised matrix is positive semidefinite already it is returned unchanged. The
    projection carries its first derivative, in which eigenvalues below zero by no more
    than round-off count as zero or more; second derivatives of it are not provided.

    Returns:
        The matrices, and how far below zero the smallest eigenvalue was (*batch,).

    Raises:
        DataError: An entry is not finite.
    """
    symmetric = (covariance + covariance.mT) / 2
    constants = constant_arrays(symmetric)
    values = constants or constant_arrays(symmetric.detach())
    # asked first: an infinite variance has a Cholesky factor
    if values is not None and not np.isfinite(values[0]).all():
        raise DataError(f"a predicted covariance must be finite; got {values[0]}")
    if constants is not None:  # the usual case, cheaply
        failed = torch.linalg.cholesky_ex(symmetric).info.any()
        if not bool(failed):
            return symmetric, torch.zeros_like(symmetric[..., 0, 0])
    constant = symmetric.detach()
    deficit = (-torch.linalg.eigvalsh(constant)[..., 0]).clamp_min(0)
    negative = deficit[..., None, None] > 0
    eigenvalues, vectors = torch.linalg.eigh(constant)
    kept = eigenvalues.clamp_min(0)
    projected = vectors @ (kept[..., None] * vectors.mT)
    projected = (projected + projected.mT) / 2
    # It is zero, and carries the derivative: autograd through the eigendecomposition
    # would divide by differences of eigenvalues, which may be equal.
    change = _projection_differential(eigenvalues, vectors, symmetric - constant)
    return torch.where(negative, projected + change, symmetric), deficit


def _projection_differential(
    eigenvalues: Tensor, vectors: Tensor, change: Tensor
) -> Tensor:
    """Returns the change of U diag(max(b, 0)) U' with that of U diag(b) U'.

    In the eigenbasis entry ij of the change is weighed by the slope of max(b, 0)
    between b_i and b_j (Daleckii and Krein, 1965): 1 where both are kept, 0 where none
    is, b_i / (b_i - b_j) where b_i alone is.

    Args:
        eigenvalues: b (*batch, n).
        vectors: U (*batch, n, n).
        change: Of the matrix (*batch, n, n).
    """
    n = eigenvalues.shape[-1]
    largest = eigenvalues.abs().amax(-1, keepdim=True)
    round_off = n * torch.finfo(eigenvalues.dtype).eps * largest
    is_kept = eigenvalues >= -round_off
    kept = torch.where(is_kept, eigenvalues.clamp_min(0), 0.0)
    from_zero = torch.where(is_kept, kept, -eigenvalues)
    kept_sum = kept[..., :, None] + kept[..., None, :]
    total = from_zero[..., :, None] + from_zero[..., None, :]
    positive = total > 0
    slope = torch.where(positive, kept_sum / torch.where(positive, total, 1.0), 1.0)
    return vectors @ (slope * (vectors.mT @ change @ vectors)) @ vectors.mT


def square_root(covariance: Tensor) -> Tensor:
    """Returns the symmetric positive semidefinite roots R of covariances, R R = Sigma.

    They are (*batch, n, n) and carry their derivative, which solves the Sylvester
    equation dR R + R dR = dSigma in the eigenbasis U of R: in it, entry ij of dR is
    that of dSigma over r_i + r_j (Cao, Lai and Alam, 2017, section 4.1, need it for A).
    Autograd through the eigendecomposition would divide by differences of eigenvalues
    instead. Where r_i + r_j = 0 the derivative does not exist and is taken as zero;
    second derivatives are not provided. Eigenvalues of Sigma below zero count as zero.
    """
    constant = covariance.detach()
    eigenvalues, U = torch.linalg.eigh((constant + constant.mT) / 2)
    r = eigenvalues.clamp_min(0).sqrt()
    R = U @ (r[..., :, None] * U.mT)
    # One step of Newton's method from R, which is the solution already: it changes no
    # value and carries the derivative.
    change = (covariance - constant)[..., None]
    return R + square_root_differential(r, U, change)[..., 0]


def square_root_differential(r: Tensor, U: Tensor, change: Tensor) -> Tensor:
    """Returns the change dR of a symmetric root R = U diag(r) U'.

    It solves dR R + R dR = dSigma for changes dSigma of R R, and is zero where
    r_i + r_j is.

    Args:
        r: Eigenvalues of the root (*batch, n).
        U: Its eigenvectors (*batch, n, n).
        change: dSigma (*batch, n, n, j), any number of them.

    Returns:
        dR (*batch, n, n, j).
    """
    total = (r[..., :, None] + r[..., None, :])[..., None]
    rotated = _congruent(U.mT, change)
    positive = total > 0
    return _congruent(
        U, torch.where(positive, rotated / torch.where(positive, total, 1.0), 0.0)
    )


def _congruent(U: Tensor, matrices: Tensor) -> Tensor:
    """Returns U X U' for symmetric X along the last dimension (*batch, n, n, j)."""
    shape = matrices.shape[-2:]
    half = U @ matrices.flatten(-2)  # its rows are of U X, one X beside the other
    return (U @ half.unflatten(-1, shape).transpose(-3, -2).flatten(-2)).unflatten(
        -1, shape
    )
