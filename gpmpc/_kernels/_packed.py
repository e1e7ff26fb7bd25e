"""The posterior's arrays in the order in which compiled loops read them.

A vector over the training points is a row: contiguous, N padded to P, a multiple of 16
(two vector registers), by copies of the last point with weight zero, which change no
sum. The inputs x~ = (x, u) are such rows: n states, then m controls.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from gpmpc._kernels.linalg import aligned_rows
from gpmpc.exceptions import ShapeError

Array = NDArray[np.float64]

# the size of a block of pairs of points
ROWS = 4
COLUMNS = 16


class GPArrays(NamedTuple):
    """k GPs over the same points, for compiled code."""

    points: Array  #: x~ of the training points (n + m, P)
    inverse_squares: Array  #: D = 1 / l^2 (k, n + m)
    log_signal: Array  #: log sf2 (k,)
    weights: Array  #: beta (k, P)
    size: int  #: N


class VarianceFactors(NamedTuple):
    """What variances are made of: lower triangles of k matrices in all entries (k, E).

    With (K + sn2 I)^-1 = L^-T L^-1.
    """

    #: L_a^-1, four rows after four rows: of rows i to i + 3 the columns before i + 4,
    #: rounded up to a multiple of 8, with zeros above the diagonal
    inverse_cholesky: Array
    #: E_a = beta_a beta_a' - (K_a + sn2_a I)^-1, doubled below the diagonal, so that
    #: sums over i >= j suffice; block of 4 x 16 after block, rows of blocks one after
    #: the other
    doubled_E: Array


@dataclass(frozen=True)
class Packed:
    """k GPs over the same N points; build it with ``pack``."""

    arrays: GPArrays  #: what predictions of the mean read
    cholesky: Array  #: lower factor L of K + sn2 I (k, N, N)
    state_dim: int  #: n
    input_dim: int  #: m

    @property
    def output_dim(self) -> int:
        """Number of outputs, k."""
        return len(self.cholesky)

    @cached_property
    def columns(self) -> Array:
        """L by columns (k, N, N).

        It is a view where the factor lies in memory so, as LAPACK makes it.
        """
        return np.ascontiguousarray(self.cholesky.transpose(0, 2, 1))

    @cached_property
    def variance_factors(self) -> VarianceFactors:
        """The matrices that exact moments and derivatives of the variance read."""
        size = self.arrays.size
        padded = self.arrays.weights.shape[1]
        inverse = []
        doubled_E = []
        for a in range(self.output_dim):
            factor = self.cholesky[a]
            beta = self.arrays.weights[a, :size]
            inverse.append(_inverse_by_four_rows(factor, padded))
            doubled_E.append(_doubled_E_by_blocks(factor, beta, padded))
        return VarianceFactors(
            inverse_cholesky=_aligned_copy(inverse), doubled_E=_aligned_copy(doubled_E)
        )


def _inverse_by_four_rows(factor: Array, padded: int) -> Array:
    """Returns the inverse of a factor as ``VarianceFactors.inverse_cholesky`` (E,)."""
    size = len(factor)
    square = np.zeros((padded, padded))
    square[:size, :size], _ = scipy.linalg.lapack.dtrtri(factor, lower=1)
    rows = [
        square[i : i + ROWS, : i // 8 * 8 + 8].ravel() for i in range(0, padded, ROWS)
    ]
    return np.concatenate(rows)


def _doubled_E_by_blocks(factor: Array, beta: Array, padded: int) -> Array:
    """Returns beta beta' - (L L')^-1 as ``VarianceFactors.doubled_E`` (E,)."""
    size = len(factor)
    precision, _ = scipy.linalg.lapack.dpotri(factor, lower=1)  # the lower triangle
    square = np.zeros((padded, padded))
    square[:size, :size] = np.tril(np.multiply.outer(2 * beta, beta) - 2 * precision)
    np.fill_diagonal(square, square.diagonal() / 2)
    blocks = []
    for i in range(0, padded, ROWS):
        row = square[i : i + ROWS, : i // COLUMNS * COLUMNS + COLUMNS]
        blocks.append(row.reshape(ROWS, -1, COLUMNS).swapaxes(0, 1).ravel())
    return np.concatenate(blocks)


def pack(
    features: Array,
    lengthscales: Array,
    signal_variance: Array,
    cholesky: Array,
    weights: Array,
    state_dim: int,
) -> Packed:
    """Lays out exact SE-ARD GPs for the compiled kernels.

    Args:
        features: The points x~ (N, n + m).
        lengthscales: l (k, n + m).
        signal_variance: sf2 (k,).
        cholesky: Lower factor L of K + sn2 I (k, N, N), which is kept and not copied
            if it is float64.
        weights: beta = (K + sn2 I)^-1 y (k, N).
        state_dim: n.

    Raises:
        ShapeError: The shapes do not belong together.
    """
    size, d = features.shape
    k = len(weights)
    shapes = (
        lengthscales.shape,
        signal_variance.shape,
        cholesky.shape,
        weights.shape,
    )
    if shapes != ((k, d), (k,), (k, size, size), (k, size)):
        raise ShapeError(
            "l (k, d), sf2 (k,), L (k, N, N) and beta (k, N) of points "
            f"{features.shape}; got {shapes}"
        )
    padded = -(-size // COLUMNS) * COLUMNS
    points = aligned((d, padded))
    points[:, :size] = features.T
    points[:, size:] = features[-1:].T
    padded_weights = aligned((k, padded))
    padded_weights[:, :size] = weights
    arrays = GPArrays(
        points=points,
        inverse_squares=as_doubles(lengthscales) ** -2.0,
        log_signal=np.log(as_doubles(signal_variance)),
        weights=padded_weights,
        size=size,
    )
    return Packed(
        arrays=arrays,
        cholesky=np.asarray(cholesky, dtype=np.float64),
        state_dim=state_dim,
        input_dim=d - state_dim,
    )


def as_doubles(values: Array) -> Array:
    """Returns numbers as kernels take them for granted: contiguous float64."""
    return np.ascontiguousarray(values, dtype=np.float64)


def aligned(shape: tuple[int, int]) -> Array:
    """Returns zeros; rows of a multiple of 8 numbers start on cache lines."""
    rows = aligned_rows(*shape)
    rows[:] = 0.0
    return rows


def _aligned_copy(rows: list[Array]) -> Array:
    copy = aligned((len(rows), len(rows[0])))
    copy[:] = rows
    return copy
