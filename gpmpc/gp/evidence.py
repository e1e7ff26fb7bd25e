"""Problem: the log marginal likelihood of one GP and its gradient, hundreds of times for one training.

For the SE-ARD kernel both have a closed form (Rasmussen and Williams, 2006, eqs. (2.30) and (5.9); Cao, Lai and Alam,
2017, eq. (9)); here it is evaluated with one Cholesky factorisation and no (N, N, d) intermediate:

    L(theta)      = 1/2 y' K^-1 y + 1/2 log|K| + N/2 log(2 pi),              K = sf2 E + sn2 I
    dL/dtheta     = 1/2 tr(W dK/dtheta),                                     W = K^-1 - (K^-1 y)(K^-1 y)'
    dL/dlog l_d   = 1/2 sum_ij M_ij (z_id - z_jd)^2 = sum_{i<j} M_ij (z_id - z_jd)^2,     M = W o sf2 E,  z = x / l

GPyTorch evaluates the same function by automatic differentiation for any kernel (``gpmpc.gp.model``), some four
times slower at the sizes of model predictive control; a test keeps the two equal. From some 400 points on
``gpmpc.gp.evidence_in_place`` takes over.
"""

import numpy as np
from scipy.linalg import blas, lapack

from gpmpc.gp.kernel import centred


class LogEvidence:
    """The negative log marginal likelihood of one output over theta = (log l (d), log sf, log(sf / sn)).

    Args:
        features: x~ (N, d).
        targets: y (N,).
    """

    def __init__(self, features: np.ndarray, targets: np.ndarray):
        self.x = np.ascontiguousarray(centred(features))
        self.y = np.ascontiguousarray(targets)

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and gradient (d + 2,); an infinite value where K is not positive definite in float64."""
        size, d = self.x.shape
        scale, sf2, sn2 = np.exp(-theta[:d]), np.exp(2 * theta[d]), np.exp(2 * (theta[d] - theta[d + 1]))
        z = self.x * scale
        half_squares = -np.einsum("id,id->i", z, z) / 2
        signal = z @ z.T
        signal += half_squares
        signal += half_squares[:, None]
        np.exp(signal, out=signal)
        signal *= sf2
        covariance = signal.copy()
        covariance.flat[:: size + 1] += sn2
        factor, info = lapack.dpotrf(covariance.T, lower=1, overwrite_a=1)
        if info:
            return np.inf, np.zeros_like(theta)
        weights, _ = lapack.dpotrs(factor, self.y, lower=1)
        value = self.y @ weights / 2 + np.log(factor.diagonal()).sum() + size / 2 * np.log(2 * np.pi)

        inverse, _ = lapack.dlauum(_triangular_inverse(factor), lower=1, overwrite_c=1)  # K^-1 = L^-T L^-1
        W = blas.dsyr(-1.0, weights, a=inverse, lower=1, overwrite_a=1).T  # upper triangle; zeros below
        trace = W.trace()
        M = np.multiply(W, signal, out=W)
        gradient = np.empty_like(theta)
        gradient[:d] = (M.sum(axis=0) + M.sum(axis=1)) @ (z * z) - 2 * np.einsum("id,id->d", M @ z, z)
        gradient[d] = 2 * M.sum() - sf2 * trace + sn2 * trace
        gradient[d + 1] = -sn2 * trace
        return value, gradient


def _triangular_inverse(lower: np.ndarray) -> np.ndarray:
    """The inverse of a lower triangular matrix (N, N), by halves: twice as fast as LAPACK's dtrtri at N = 189."""
    size = len(lower)
    if size <= 64:
        return lapack.dtrtri(lower, lower=1)[0]
    half = size // 2
    inverse = np.zeros((size, size), order="F")
    inverse[:half, :half] = _triangular_inverse(lower[:half, :half])
    inverse[half:, half:] = _triangular_inverse(lower[half:, half:])
    inverse[half:, :half] = -inverse[half:, half:] @ (lower[half:, :half] @ inverse[:half, :half])
    return inverse
