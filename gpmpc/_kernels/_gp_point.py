"""The GPs' mean and variance at certain points, with derivatives.

    M_a = sum_i beta_ai k_ai,   k_ai = k_a(x~_i, x~),   var_a = sf2_a - |L_a^-1 k_a|^2

With z_i = D_a (x~_i - x~), over states and inputs together, dk_i = k_i z_i and every
derivative of M is a moment of z under the weights beta_ai k_ai (Rasmussen and Williams,
2006, eqs. (2.25)-(2.26), differentiated):

    dM = sum beta k z,   d2M = sum beta k (z z' - D)
    dvar = -2 sum_i [(K_a + sn2_a I)^-1 k_a]_i k_i z_i

The moments are summed over x~_i - x~, which all outputs share, and scaled by D_a
afterwards.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from gpmpc._compiled import compiled, njit_noalloc
from gpmpc._kernels._rows import multiply, project, reduce_variance, reduce_variances
from gpmpc._kernels._simd import exp, load, store, total, use_widest_registers, zeros
from gpmpc._kernels.linalg import aligned_rows


class PointArrays(NamedTuple):
    """The arrays that ``linearize_points`` writes."""

    mean: ndarray  # (K, k)
    A: ndarray  # (K, k, n)
    B: ndarray  # (K, k, m)
    covariance: ndarray  # (K, k, k), or (0, k, k) where it is not wanted


@njit_noalloc
def _write_offsets(points, x, u, offsets, squares):
    """Writes x~_i - x~ and its squares."""
    n = len(x)
    for d in range(len(points)):
        centre = x[d] if d < n else u[d - n]
        point = points[d]
        offset = offsets[d]
        square = squares[d]
        for j in range(len(point)):
            difference = point[j] - centre
            offset[j] = difference
            square[j] = difference * difference


@njit_noalloc
def write_kernel(log_signal, D, squares, weights, k, weighted):
    """Writes k_j = sf2 exp(-1/2 sum_d D_d (x~_j - x~)_d^2) and beta_j k_j.

    Returns the sum of the latter.
    """
    use_widest_registers()
    sums = zeros()
    for j in range(0, len(k), 8):
        exponent = zeros() + log_signal
        for d in range(len(D)):
            exponent = exponent - (0.5 * D[d]) * load(squares[d], j)
        value = exp(exponent)
        store(k, j, value)
        value = value * load(weights, j)
        store(weighted, j, value)
        sums = sums + value
    return total(sums)


@compiled(allocates=False)
def linearize_points(gp, columns, offset, adds_state, x, u, memory, out):
    """Writes ``PointArrays`` of GPs with prior means ``offset`` (k,).

    L_a by ``columns`` (k, N, N), or with more behind, is read for covariances only.
    ``memory`` is lent, since counting references to own arrays costs a third of a short
    call: eight numbers more than 2 (n + m) + 1 rows of P, and for covariances k rows a
    point, K rounded up to fours.
    """
    use_widest_registers()
    M = out.mean
    A = out.A
    B = out.B
    d, padded = gp.points.shape
    n = x.shape[1]
    outputs = len(gp.weights)
    skip = (-(memory.ctypes.data >> 3)) % 8  # rows start on cache lines
    rows = (len(memory) - 8) // padded
    memory = memory[skip : skip + rows * padded].reshape(-1, padded)
    offsets = memory[:d]
    squares = memory[d : 2 * d]
    weighted = memory[2 * d]
    kernels = memory[2 * d + 1 :]  # k_a of all points, for covariances
    K = len(out.covariance)
    # rows of k_a that each output has there
    count = (K + 3) // 4 * 4 if K > 1 else K
    for h in range(len(x)):
        _write_offsets(gp.points, x[h], u[h], offsets, squares)
        for a in range(outputs):
            D = gp.inverse_squares[a]
            k = kernels[a * count + h] if count > 0 else weighted
            M[h, a] = offset[a] + write_kernel(
                gp.log_signal[a], D, squares, gp.weights[a], k, weighted
            )
            project(weighted, offsets[:n], A[h, a])
            project(weighted, offsets[n:], B[h, a])
            for c in range(n):
                A[h, a, c] *= D[c]
            for c in range(d - n):
                B[h, a, c] *= D[n + c]
            if adds_state:
                M[h, a] += x[h, a]
                A[h, a, a] += 1.0
    if count > 0:
        _write_variances(gp, columns, kernels, count, memory[0], out.covariance)


@njit_noalloc
def _write_variances(gp, columns, kernels, count, totals, covariance):
    """Writes sf2_a - |L_a^-1 k_a|^2 of K points to the diagonals (K, k, k).

    ``kernels`` has ``count`` rows k_a of each output, the first K of them points'.
    """
    use_widest_registers()
    K = len(covariance)
    for a in range(len(gp.weights)):
        k = kernels[a * count : (a + 1) * count]
        for h in range(K, count):
            k[h, :] = 0.0
        signal = np.exp(gp.log_signal[a])
        # sixteen rows and the columns of L stay in the first cache together
        for first in range(0, count, 16):
            totals[:16] = 0.0
            reduce_variances(columns[a], gp.size, k[first : first + 16], totals)
            for h in range(first, min(first + 16, K)):
                covariance[h, a, a] = max(signal - totals[h - first], 0.0)


@compiled
def expand_points(gp, inverse_cholesky, x, u, out):
    """Writes the arrays of ``gpmpc._kernels.Expansion`` at K points."""
    use_widest_registers()
    d, padded = gp.points.shape
    K, n = x.shape
    offsets = aligned_rows(d, padded)
    squares = aligned_rows(d, padded)
    k = aligned_rows(1, padded)[0]
    weighted = aligned_rows(1, padded)[0]
    solution = aligned_rows(1, padded)[0]  # (K_a + sn2_a I)^-1 k_a
    weighted_offset = aligned_rows(1, padded)[0]
    sums = np.empty(d)
    moment = np.empty(d)
    for h in range(K):
        _write_offsets(gp.points, x[h], u[h], offsets, squares)
        for a in range(len(gp.weights)):
            D = gp.inverse_squares[a]
            out.M[h, a] = write_kernel(
                gp.log_signal[a], D, squares, gp.weights[a], k, weighted
            )
            reduction = reduce_variance(inverse_cholesky[a], k, solution)
            out.variance[h, a] = max(np.exp(gp.log_signal[a]) - reduction, 0.0)
            # dvar = -2 sum_i [(K_a + sn2_a I)^-1 k_a]_i k_i z_i
            multiply(solution, k, solution)
            project(solution, offsets, sums)
            for c in range(d):
                if c < n:
                    out.dvariance_dx[h, a, c] = -2 * D[c] * sums[c]
                else:
                    out.dvariance_du[h, a, c - n] = -2 * D[c] * sums[c]
            # dM = sum beta k z
            project(weighted, offsets, sums)
            for c in range(d):
                sums[c] *= D[c]
            out.J[h, a, :] = sums[:n]
            out.dM_du[h, a, :] = sums[n:]
            # d2M = sum beta k (z z' - D)
            for c in range(n):
                multiply(weighted, offsets[c], weighted_offset)
                project(weighted_offset, offsets, moment)
                for e in range(n):
                    value = D[c] * D[e] * moment[e]
                    diagonal = D[c] * out.M[h, a] if c == e else 0.0
                    out.d2M_dx2[h, a, c, e] = value - diagonal
                for e in range(n, d):
                    out.d2M_dxdu[h, a, c, e - n] = D[c] * D[e] * moment[e]
