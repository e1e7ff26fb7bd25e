"""The posterior's arrays in the order in which compiled loops read them.

A vector over the training points is a row: contiguous, N padded to P, a multiple of 16 (two vector registers), by
copies of the last point with weight zero, which change no sum. The inputs x~ = (x, u) are such rows: n states, then m
controls.
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

# of a block of pairs of points
ROWS = 4
COLUMNS = 16


class GPArrays(NamedTuple):
    """k GPs over the same points, for compiled code."""

    points: Array  #: x~ of the training points (n + m, P)
    inverse_squares: Array  #: D = 1 / l^2 (k, n + m)
    log_signal: Array  #: log sf2 (k,)
    weights: Array  #: beta (k, P)
    size: int  #: N


class Precision(NamedTuple):
    """(K + sn2 I)^-1 of k GPs in two forms, as lower triangles."""

    #: L_a^-1, four rows after four rows: of rows i to i + 3 the columns before i + 4, rounded up to a multiple of 8,
    #: with zeros above the diagonal (k, size)
    inverse_cholesky: Array
    #: E_a = beta_a beta_a' - (K_a + sn2_a I)^-1, doubled below the diagonal, so that sums over i >= j suffice; block of
    #: 4 x 16 after block, rows of blocks one after the other (k, size)
    centred: Array


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
        """L by columns (k, N, N); a view where the factor lies in memory so, as LAPACK makes it."""
        return np.ascontiguousarray(self.cholesky.transpose(0, 2, 1))

    @cached_property
    def precision(self) -> Precision:
        """What exact moments and derivatives of the variance read."""
        (k, padded), size = self.arrays.weights.shape, self.arrays.size
        starts = range(0, padded, ROWS)
        inverse = []
        centred = []
        for factor, beta in zip(
            self.cholesky, self.arrays.weights[:, :size], strict=True
        ):
            square = np.zeros((padded, padded))
            square[:size, :size], _ = scipy.linalg.lapack.dtrtri(factor, lower=1)
            inverse.append(
                np.concatenate(
                    [square[i : i + ROWS, : i // 8 * 8 + 8].ravel() for i in starts]
                )
            )
            precision, _ = scipy.linalg.lapack.dpotri(
                factor, lower=1
            )  # the lower triangle
            square[:size, :size] = np.tril(
                np.multiply.outer(2 * beta, beta) - 2 * precision
            )
            np.fill_diagonal(square, square.diagonal() / 2)
            rows = (
                square[i : i + ROWS, : i // COLUMNS * COLUMNS + COLUMNS] for i in starts
            )
            blocks = (
                row.reshape(ROWS, -1, COLUMNS).swapaxes(0, 1).ravel() for row in rows
            )
            centred.append(np.concatenate(list(blocks)))
        found = Precision(aligned((k, len(inverse[0]))), aligned((k, len(centred[0]))))
        found.inverse_cholesky[:] = inverse
        found.centred[:] = centred
        return found


def pack(
    features: Array,
    lengthscales: Array,
    signal_variance: Array,
    cholesky: Array,
    weights: Array,
    state_dim: int,
) -> Packed:
    """Lays out exact SE-ARD GPs for the compiled kernels.

    From points x~ (N, n + m), l (k, n + m), sf2 (k,), the lower factor L of K + sn2 I (k, N, N), which is kept and not
    copied, and beta = (K + sn2 I)^-1 y (k, N). Raises ShapeError where the shapes do not belong together.
    """
    (size, d), k = features.shape, len(weights)
    got = lengthscales.shape, signal_variance.shape, cholesky.shape, weights.shape
    if got != ((k, d), (k,), (k, size, size), (k, size)):
        raise ShapeError(
            f"l (k, d), sf2 (k,), L (k, N, N) and beta (k, N) of points {features.shape}; got {got}"
        )
    padded = -(-size // COLUMNS) * COLUMNS
    points = aligned((d, padded))
    padded_weights = aligned((k, padded))
    points[:, :size] = features.T
    points[:, size:] = features[-1:].T
    padded_weights[:, :size] = weights
    arrays = GPArrays(
        points,
        np.ascontiguousarray(lengthscales**-2.0),
        np.log(signal_variance),
        padded_weights,
        size,
    )
    return Packed(arrays, cholesky, state_dim, d - state_dim)


def aligned(shape: tuple[int, int]) -> Array:
    """Zeros whose rows start on cache lines where they are multiples of 8."""
    rows = aligned_rows(*shape)
    rows[:] = 0.0
    return rows
