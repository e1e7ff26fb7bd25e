"""The GPs' mean and variance at certain points, with the derivatives that linearised propagation needs.

    M_a = sum_i beta_ai k_ai,   k_ai = k_a(x~_i, x~),   var_a = sf2_a - |L_a^-1 k_a|^2

With z_i = D_a (x~_i - x~), over states and inputs together, dk_i = k_i z_i and every derivative of M is a moment of z
under the weights beta_ai k_ai (Rasmussen and Williams, 2006, eqs. (2.25)-(2.26), differentiated):

    dM = sum beta k z,   d2M = sum beta k (z z' - D)
    dvar = -2 sum_i [(K_a + sn2_a I)^-1 k_a]_i k_i z_i

The moments are summed over x~_i - x~, which all outputs share, and scaled by D_a afterwards.
"""

import numpy as np

from gpmpc._compiled import compiled, njit_noalloc
from gpmpc._kernels._rows import multiply, project, reduce_variance, reduce_variances
from gpmpc._kernels._simd import exp, load, store, total, use_widest_registers, zeros
from gpmpc._kernels.linalg import aligned_rows


@njit_noalloc
def _write_offsets(points, x, u, offsets, squares):
    """Writes x~_i - x~ and its squares."""
    n = len(x)
    for d in range(len(points)):
        at = x[d] if d < n else u[d - n]
        point = points[d]
        offset = offsets[d]
        square = squares[d]
        for j in range(len(point)):
            difference = point[j] - at
            offset[j] = difference
            square[j] = difference * difference


@njit_noalloc
def _write_kernel(log_signal, D, squares, weights, k, weighted):
    """Writes k_j = sf2 exp(-1/2 sum_d D_d (x~_j - x~)_d^2) and beta_j k_j; returns the sum of the latter."""
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
def linearize_points(gp, columns, outer, x, u, memory, out):
    """Writes M (K, k), A (K, k, n), B (K, k, m) and the diagonal of the covariance (K, k, k), or none to (0, k, k).

    L_a by ``columns`` (k, N, N), or with more behind, is read for covariances only. ``outer`` are the prior means (k,)
    and whether the state is added. ``memory`` is lent, since counting references to own arrays costs a third of a short
    call: eight numbers more than 2 (n + m) + 1 rows of P, and for covariances k rows a point, K rounded up to fours.
    """
    use_widest_registers()
    (M, A, B, covariance), (offset, adds_state) = out, outer
    (d, padded), n, outputs = gp.points.shape, x.shape[1], len(gp.weights)
    skip = (-(memory.ctypes.data >> 3)) % 8  # rows start on cache lines
    memory = memory[skip : skip + (len(memory) - 8) // padded * padded].reshape(
        -1, padded
    )
    offsets = memory[:d]
    squares = memory[d : 2 * d]
    weighted = memory[2 * d]
    K = len(covariance)
    blocks = (K + 3) // 4 * 4 if K > 1 else K  # points whose k_a are kept, padded
    for h in range(len(x)):
        _write_offsets(gp.points, x[h], u[h], offsets, squares)
        for a in range(outputs):
            D = gp.inverse_squares[a]
            k = memory[2 * d + 1 + a * blocks + h] if blocks > 0 else weighted
            M[h, a] = offset[a] + _write_kernel(
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
    if blocks > 0:
        totals = memory[0]
        for a in range(outputs):
            kept = memory[2 * d + 1 + a * blocks : 2 * d + 1 + (a + 1) * blocks]
            for h in range(len(x), blocks):
                kept[h, :] = 0.0
            signal = np.exp(gp.log_signal[a])
            for first in range(
                0, blocks, 16
            ):  # these and the columns of L stay in the first cache together
                totals[:16] = 0.0
                reduce_variances(columns[a], gp.size, kept[first : first + 16], totals)
                for h in range(first, min(first + 16, len(x))):
                    covariance[h, a, a] = max(signal - totals[h - first], 0.0)


@compiled
def expand_points(gp, inverse_cholesky, x, u, out):
    """Writes the arrays of ``gpmpc._kernels.Expansion`` at K points."""
    use_widest_registers()
    d, (K, n) = len(gp.points), x.shape
    padded = gp.points.shape[1]
    memory = aligned_rows(2 * d + 4, padded)
    offsets = memory[:d]
    squares = memory[d : 2 * d]
    k = memory[2 * d]
    weighted = memory[2 * d + 1]
    solved = memory[2 * d + 2]
    once = memory[2 * d + 3]
    sums = np.empty(d)
    moment = np.empty(d)
    for h in range(K):
        _write_offsets(gp.points, x[h], u[h], offsets, squares)
        for a in range(len(gp.weights)):
            D = gp.inverse_squares[a]
            out.M[h, a] = _write_kernel(
                gp.log_signal[a], D, squares, gp.weights[a], k, weighted
            )
            reduction = reduce_variance(inverse_cholesky[a], k, solved)
            out.variance[h, a] = max(np.exp(gp.log_signal[a]) - reduction, 0.0)
            # dvar = -2 sum_i [(K_a + sn2_a I)^-1 k_a]_i k_i z_i
            multiply(solved, k, solved)
            project(solved, offsets, sums)
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
            for c in range(n):
                # d2M = sum beta k (z z' - D)
                multiply(weighted, offsets[c], once)
                project(once, offsets, moment)
                for e in range(n):
                    out.d2M_dx2[h, a, c, e] = D[c] * D[e] * moment[e] - (
                        D[c] * out.M[h, a] if c == e else 0.0
                    )
                for e in range(n, d):
                    out.d2M_dxdu[h, a, c, e - n] = D[c] * D[e] * moment[e]
