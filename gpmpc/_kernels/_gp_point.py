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

from gpmpc._compiled import compiled, njit_noalloc
from gpmpc._kernels._packed import Array
from gpmpc._kernels._rows import (
    add_variance_reductions_by_substitution,
    multiply_entries,
    project,
    variance_reduction_by_inverse,
)
from gpmpc._kernels._simd import exp, load, store, total, use_widest_registers, zeros
from gpmpc._kernels.linalg import aligned_rows

# k_a of all points stands in rows, of which variances are solved for four at a time
_ROWS_AT_ONCE = 4


class LinearizedGPs(NamedTuple):
    """Means of GPs at H points and their derivatives."""

    mean: Array  #: (H, k)
    A: Array  #: by the state (H, k, n)
    B: Array  #: by the input (H, k, m)
    #: diagonal (H, k, k); None where it was not wanted, of no points for compiled code
    covariance: Array | None


def kernel_rows(H: int) -> int:
    """Returns the number of rows that hold an output's k_a at H points.

    More rows than one are a multiple of four, so that none is solved for on its own;
    a single point would pay for three that nobody asked for.
    """
    return H if H <= 1 else -(-H // _ROWS_AT_ONCE) * _ROWS_AT_ONCE


@njit_noalloc
def _write_differences(points, x, u, differences, squares):
    """Writes x~_i - x~ and its squares."""
    n = len(x)
    for d in range(len(points)):
        centre = x[d] if d < n else u[d - n]
        point = points[d]
        row = differences[d]
        square = squares[d]
        for j in range(len(point)):
            difference = point[j] - centre
            row[j] = difference
            square[j] = difference * difference


@njit_noalloc
def write_kernel(log_signal, D, squares, weights, kernel_row, weighted):
    """Writes k_j = sf2 exp(-1/2 sum_d D_d (x~_j - x~)_d^2) to ``kernel_row``.

    Writes beta_j k_j to ``weighted`` and returns their sum, the mean less its prior.
    The same numbers weigh z_j in the mean's derivatives, as is so for the squared
    exponential kernel alone. Both rows may be one, which then holds beta_j k_j.
    """
    use_widest_registers()
    sums = zeros()
    for j in range(0, len(kernel_row), 8):
        exponent = zeros() + log_signal
        for d in range(len(D)):
            exponent = exponent - (0.5 * D[d]) * load(squares[d], j)
        value = exp(exponent)
        store(kernel_row, j, value)
        value = value * load(weights, j)
        store(weighted, j, value)
        sums = sums + value
    return total(sums)


@compiled(allocates=False)
def linearize_points(gp, columns, prior_mean, adds_state, x, u, memory, out):
    """Writes ``LinearizedGPs`` of GPs with prior means (k,) at H points.

    L_a by ``columns`` (k, N, N), or with more behind, is read for covariances only.
    ``memory`` is lent, since counting references to own arrays costs a third of a short
    call: eight numbers more than 2 (n + m) + 1 rows of P, and for covariances
    ``kernel_rows(H)`` rows for each output.
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
    differences = memory[:d]
    squares = memory[d : 2 * d]
    weighted = memory[2 * d]
    wants_covariance = len(out.covariance) > 0
    # k_a of all points, for covariances: ``rows_per_output`` rows of each output
    kernel_values = memory[2 * d + 1 :]
    rows_per_output = len(kernel_values) // max(outputs, 1)
    for h in range(len(x)):
        _write_differences(gp.points, x[h], u[h], differences, squares)
        for a in range(outputs):
            D = gp.inverse_squares[a]
            kernel_row = weighted
            if wants_covariance:
                kernel_row = kernel_values[a * rows_per_output + h]
            M[h, a] = prior_mean[a] + write_kernel(
                gp.log_signal[a], D, squares, gp.weights[a], kernel_row, weighted
            )
            project(weighted, differences[:n], A[h, a])
            project(weighted, differences[n:], B[h, a])
            for c in range(n):
                A[h, a, c] *= D[c]
            for c in range(d - n):
                B[h, a, c] *= D[n + c]
            if adds_state:
                M[h, a] += x[h, a]
                A[h, a, a] += 1.0
    if wants_covariance:
        totals = memory[0]  # the first row of differences is not read any more
        _write_variances(
            gp, columns, kernel_values, rows_per_output, totals, out.covariance
        )


@njit_noalloc
def _write_variances(gp, columns, kernel_values, rows_per_output, totals, covariance):
    """Writes sf2_a - |L_a^-1 k_a|^2 of H points to the diagonals (H, k, k).

    ``kernel_values`` has ``rows_per_output`` rows k_a of each output, the first H of
    them points'. They are overwritten; ``totals`` is a row of P, 16 or more, to work
    in.
    """
    use_widest_registers()
    H = len(covariance)
    for a in range(len(gp.weights)):
        rows = kernel_values[a * rows_per_output : (a + 1) * rows_per_output]
        for h in range(H, rows_per_output):
            rows[h, :] = 0.0
        signal = np.exp(gp.log_signal[a])
        # sixteen rows and the columns of L stay in the first cache together
        for first in range(0, rows_per_output, 16):
            totals[:16] = 0.0
            add_variance_reductions_by_substitution(
                columns[a], gp.size, rows[first : first + 16], totals
            )
            for h in range(first, min(first + 16, H)):
                covariance[h, a, a] = max(signal - totals[h - first], 0.0)


@compiled
def expand_points(gp, inverse_cholesky, x, u, out):
    """Writes the arrays of ``gpmpc._kernels.Expansion`` at H points."""
    use_widest_registers()
    d, padded = gp.points.shape
    H, n = x.shape
    differences = aligned_rows(d, padded)
    squares = aligned_rows(d, padded)
    kernel_row = aligned_rows(1, padded)[0]
    weighted = aligned_rows(1, padded)[0]
    solution = aligned_rows(1, padded)[0]  # (K_a + sn2_a I)^-1 k_a
    weighted_difference = aligned_rows(1, padded)[0]
    sums = np.empty(d)
    moment = np.empty(d)
    for h in range(H):
        _write_differences(gp.points, x[h], u[h], differences, squares)
        for a in range(len(gp.weights)):
            D = gp.inverse_squares[a]
            out.M[h, a] = write_kernel(
                gp.log_signal[a], D, squares, gp.weights[a], kernel_row, weighted
            )
            reduction = variance_reduction_by_inverse(
                inverse_cholesky[a], kernel_row, solution
            )
            variance = np.exp(gp.log_signal[a]) - reduction
            if variance < 0.0:  # round-off: it is held at zero, and does not change
                variance = 0.0
                solution[:] = 0.0
            out.variance[h, a] = variance
            # dvar = -2 sum_i [(K_a + sn2_a I)^-1 k_a]_i k_i z_i
            multiply_entries(solution, kernel_row, solution)
            project(solution, differences, sums)
            for c in range(d):
                if c < n:
                    out.dvariance_dx[h, a, c] = -2 * D[c] * sums[c]
                else:
                    out.dvariance_du[h, a, c - n] = -2 * D[c] * sums[c]
            # dM = sum beta k z
            project(weighted, differences, sums)
            for c in range(d):
                sums[c] *= D[c]
            out.J[h, a, :] = sums[:n]
            out.dM_du[h, a, :] = sums[n:]
            # d2M = sum beta k (z z' - D)
            for c in range(n):
                multiply_entries(weighted, differences[c], weighted_difference)
                project(weighted_difference, differences, moment)
                for e in range(n):
                    value = D[c] * D[e] * moment[e]
                    diagonal = D[c] * out.M[h, a] if c == e else 0.0
                    out.d2M_dx2[h, a, c, e] = value - diagonal
                for e in range(n, d):
                    out.d2M_dxdu[h, a, c, e - n] = D[c] * D[e] * moment[e]
