"""Problem: the evidence of thousands of points, whose kernel matrix is 200 MB at N = 5000, and five of them 1 GB.

``LogEvidence`` keeps the kernel, its factor, the inverse of that and what comes between as matrices of their own, the
fastest way at the sizes of model predictive control. Here is one single N x N array, for all evaluations of a search:

    strictly above the diagonal   sf2 E, which stays
    below it                      K = sf2 E + sn2 I,  then L,  then K^-1  (LAPACK's dpotrf and dpotri, in place)

The gradient's sums over M = W o sf2 E, W = K^-1 - beta beta', run over block columns of the lower half and the block
rows of the upper half that mirror them; the formulas are those of ``gpmpc.gp.evidence`` (Rasmussen and Williams, 2006,
eqs. (2.30) and (5.9)). From some 400 points on this is also the faster way: the N^3 multiplications and additions are
all in LAPACK's blocked, threaded routines, the rest is O(N^2 d).
"""

import numpy as np
from scipy.linalg import lapack

from gpmpc.gp.kernel import centred

BLOCK = 256  # columns at a time: a block and its mirror image fit the cache


class InPlaceEvidence:
    """What ``LogEvidence`` is: the negative log marginal likelihood over theta = (log l, log sf, log(sf / sn)).

    One call at a time: the array is this object's.

    Args:
        features: x~ (N, d).
        targets: y (N,).
    """

    def __init__(self, features: np.ndarray, targets: np.ndarray):
        self.x, self.y = np.ascontiguousarray(centred(features)), np.ascontiguousarray(targets)
        self.square = np.empty((len(targets), len(targets)), order="F")

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and gradient (d + 2,); an infinite value where K is not positive definite in float64."""
        size, d = self.x.shape
        sf2, sn2 = np.exp(2 * theta[d]), np.exp(2 * (theta[d] - theta[d + 1]))
        z = self.x * np.exp(-theta[:d])
        self._fill(z, sf2, sn2)
        # LAPACK leaves the other half alone: clean = 0.
        factor, info = lapack.dpotrf(self.square, lower=1, clean=0, overwrite_a=1)
        if info:
            return np.inf, np.zeros_like(theta)
        beta, _ = lapack.dpotrs(factor, self.y, lower=1)
        value = self.y @ beta / 2 + np.log(factor.diagonal()).sum() + size / 2 * np.log(2 * np.pi)
        inverse, info = lapack.dpotri(factor, lower=1, overwrite_c=1)
        if info:
            return np.inf, np.zeros_like(theta)
        trace = inverse.trace() - beta @ beta  # of W
        by_lengthscale, total = self._sums(z, beta)
        gradient = np.append(by_lengthscale, [2 * total + (sf2 + sn2) * trace, -sn2 * trace])
        return value, gradient

    def _fill(self, z: np.ndarray, sf2: float, sn2: float) -> None:
        """Writes K, both halves, from the points in units of their length-scales (N, d)."""
        half_squares = np.einsum("id,id->i", z, z) / 2
        for begin in range(0, len(z), BLOCK):
            block = slice(begin, begin + BLOCK)
            signal = z[block] @ z[begin:].T
            signal -= half_squares[block, None]
            signal -= half_squares[begin:]
            np.exp(signal, out=signal)
            signal *= sf2
            self.square[block, begin:] = signal
            self.square[begin:, block] = signal.T
        self.square.flat[:: len(z) + 1] = sf2 + sn2

    def _sums(self, z: np.ndarray, beta: np.ndarray) -> tuple[np.ndarray, float]:
        """sum_{i>j} M_ij (z_id - z_jd)^2 (d,), and sum_{i>j} M_ij."""
        by_lengthscale, total = np.zeros(z.shape[1]), 0.0
        for begin in range(0, len(z), BLOCK):
            block = slice(begin, begin + BLOCK)
            M = np.multiply.outer(-beta[begin:], beta[block])
            M += self.square[begin:, block]
            M *= self.square[block, begin:].T
            corner = M[: M.shape[1]]
            corner[np.triu_indices(len(corner))] = 0
            rows, columns = M.sum(axis=1), M.sum(axis=0)
            total += rows.sum()
            by_lengthscale += rows @ z[begin:] ** 2 + columns @ z[block] ** 2
            by_lengthscale -= 2 * np.einsum("id,id->d", M @ z[block], z[begin:])
        return by_lengthscale, total
