"""Problem: the posterior's arrays in the order in which compiled loops read them.

A vector over the training points is a row: contiguous, N padded to a multiple of 8 (one full vector register) by copies
of the last point with weight zero, which change no sum. The inputs x~ = (x, u) are such rows too: n states, then m
controls, each block padded to a multiple of 3 rows, because the loops take three rows at a time.

Symmetric and triangular N x N matrices are kept as lower block triangles: of rows 8I .. 8I + 7 the first 8 (I + 1)
columns, zeros above the diagonal. The two that exist then fit the memory of one square:

    inverse_cholesky  L_a^-1, for |L_a^-1 q|^2 and (K_a + sn2_a I)^-1 q; row after row, rows 8I .. start at 32 I (I + 1)
    centred           E_a = beta_a beta_a' - (K_a + sn2_a I)^-1, doubled below the diagonal: sums over i >= j suffice;
                      block of 4 x 16 after block, in the order in which ``gpmpc.kernels.pair_sums`` meets them: tile
                      after tile, in a tile row after row of blocks. Memory is read in one stream
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from gpmpc.exceptions import SettingError, ShapeError

LANES = 8  # doubles in a vector register
GROUP = 3  # rows that one loop takes together
ROWS, COLUMNS = 4, 16  # of a block of pairs
TILE = 16  # times 16 columns: a tile, which all rows meet before the next one

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Packed:
    """k GPs over the same N points; build it with ``pack``. P is N padded, R the number of padded rows of x~.

    Attributes:
        points: x~ of the training points (R, P).
        inverse_squares: 1 / l_a^2, zero at padded rows (k, R).
        signal_variance: sf2 (k,).
        weights: beta (k, P).
        cholesky: Lower factor of K + sn2 I (k, N, N).
        state_dim: n.
        input_dim: m.
    """

    points: Array
    inverse_squares: Array
    signal_variance: Array
    weights: Array
    cholesky: Array
    state_dim: int
    input_dim: int

    @property
    def output_dim(self) -> int:
        """Number of outputs, k."""
        return len(self.weights)

    @cached_property
    def log_signal(self) -> Array:
        """The logarithms of sf2 (k,)."""
        return np.log(self.signal_variance)

    @cached_property
    def columns(self) -> Array:
        """L_a by columns (k, N, N); a view where the factor lies in memory so, as LAPACK makes it."""
        return np.ascontiguousarray(self.cholesky.transpose(0, 2, 1))

    @cached_property
    def inverse_cholesky(self) -> Array:
        """L_a^-1 as block triangles (k, triangle_size(P))."""
        return self._triangles(lambda a: scipy.linalg.lapack.dtrtri(self.cholesky[a], lower=1)[0])

    @cached_property
    def centred(self) -> Array:
        """E_a by blocks, doubled below the diagonal (k, a little more than triangle_size(P))."""
        padded, width = self.points.shape[1], TILE * COLUMNS
        size = sum(-(-(i + ROWS) // COLUMNS) for i in range(0, padded, ROWS)) * ROWS * COLUMNS
        triangles = aligned_zeros(len(self.weights), size)
        for a, triangle in enumerate(triangles):
            square, place = self._centred_square(a), 0
            for start in range(0, padded, width):
                for i in range(start, padded, ROWS):
                    count = min(-(-(i + ROWS - start) // COLUMNS), TILE)
                    met, row = np.zeros((ROWS, count * COLUMNS)), square[i : i + ROWS, start : start + count * COLUMNS]
                    met[: row.shape[0], : row.shape[1]] = row
                    triangle[place : place + met.size] = met.reshape(ROWS, count, COLUMNS).swapaxes(0, 1).ravel()
                    place += met.size
        return triangles

    def _centred_square(self, a: int) -> Array:
        size = len(self.cholesky[a])
        precision, _ = scipy.linalg.lapack.dpotri(self.cholesky[a], lower=1)  # the lower triangle
        beta = self.weights[a, :size]
        square = np.tril(np.multiply.outer(2 * beta, beta) - 2 * precision)
        np.fill_diagonal(square, square.diagonal() / 2)
        return square

    def _triangles(self, square) -> Array:
        padded = self.points.shape[1]
        triangles = aligned_zeros(len(self.weights), triangle_size(padded))
        for a, triangle in enumerate(triangles):
            lower = square(a)
            for start in range(0, len(lower), LANES):
                rows = lower[start : start + LANES, : start + LANES]
                length = start + LANES
                at = start * length // 2
                triangle[at : at + LANES * length].reshape(LANES, length)[: rows.shape[0], : rows.shape[1]] = rows
        return triangles


def pack(
    features: Array,
    lengthscales: Array,
    signal_variance: Array,
    cholesky: Array,
    weights: Array,
    state_dim: int,
) -> Packed:
    """Lays out exact SE-ARD GPs for the compiled moments.

    Args:
        features: x~ = (x, u) of the training points (N, n + m).
        lengthscales: l (k, n + m).
        signal_variance: sf2 (k,).
        cholesky: Lower factor L of K + sn2 I (k, N, N); kept, not copied.
        weights: beta = (K + sn2 I)^-1 y (k, N).
        state_dim: n.

    Raises:
        ShapeError: The shapes do not belong together.
        SettingError: ``state_dim`` is not between 1 and n + m, or a hyperparameter is not positive.
    """
    features, lengthscales, signal_variance, weights = (
        np.ascontiguousarray(v, dtype=np.float64) for v in (features, lengthscales, signal_variance, weights)
    )
    cholesky = np.asarray(cholesky, dtype=np.float64)
    (size, d), outputs = features.shape, len(weights)
    expected = {
        "lengthscales": (lengthscales, (outputs, d)),
        "signal_variance": (signal_variance, (outputs,)),
        "cholesky": (cholesky, (outputs, size, size)),
        "weights": (weights, (outputs, size)),
    }
    for name, (value, shape) in expected.items():
        if value.shape != shape:
            raise ShapeError(f"{name} must have shape {shape}; got {value.shape}")
    if not 1 <= state_dim <= d:
        raise SettingError("state_dim", f"must be between 1 and the inputs' {d} columns; got {state_dim}")
    for name, value in (("lengthscales", lengthscales), ("signal_variance", signal_variance)):
        if not (value > 0).all():
            raise SettingError(name, f"must be positive; got {value.tolist()}")

    padded, rows = padded_to(LANES, size), padded_to(GROUP, state_dim)
    places = np.r_[:state_dim, rows : rows + d - state_dim]  # where the columns of x~ go
    points = aligned_zeros(rows + padded_to(GROUP, d - state_dim), padded)
    points[places, :size] = features.T
    points[:, size:] = points[:, size - 1 : size]
    inverse_squares = np.zeros((outputs, len(points)))
    inverse_squares[:, places] = lengthscales**-2.0
    padded_weights = aligned_zeros(outputs, padded)
    padded_weights[:, :size] = weights
    return Packed(points, inverse_squares, signal_variance, padded_weights, cholesky, state_dim, d - state_dim)


def padded_to(multiple: int, size: int) -> int:
    """The least multiple that is not below ``size``."""
    return -(-size // multiple) * multiple


def aligned_zeros(rows: int, columns: int) -> Array:
    """Zeros whose rows start on cache lines when ``columns`` is a multiple of 8."""
    memory = np.zeros(rows * columns + LANES)
    skip = -(memory.ctypes.data // memory.itemsize) % LANES
    return memory[skip : skip + rows * columns].reshape(rows, columns)


def triangle_size(padded: int) -> int:
    """Numbers in the block triangle of a square of ``padded`` rows."""
    return padded * (padded + LANES) // 2
