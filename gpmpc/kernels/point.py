"""Problem: the GPs' mean and variance at a certain point, with the derivatives that linearised propagation needs.

    M_a = sum_i beta_ai k_ai,   k_ai = k_a(x~_i, x~),   var_a = sf2_a - |L_a^-1 k_a|^2

With z_i = D_a (x~_i - x~), over states and controls together, dk_i = k_i z_i and every derivative of M is a moment of z
under the weights beta_ai k_ai (Rasmussen and Williams, 2006, eqs. (2.25)-(2.26), differentiated):

    dM = sum beta k z,   d2M = sum beta k (z z' - D),   d3M = sum beta k (z z z - three times D with z)
    dvar = -2 sum_i [(K_a + sn2_a I)^-1 k_a]_i k_i z_i

The moments are summed over x~_i - x~, which all outputs share, and scaled by D_a afterwards.
"""

import numpy as np

from gpmpc.compiled import compiled, njit_noalloc
from gpmpc.kernels.exponential import exp, exp_all, widest
from gpmpc.kernels.point_rows import (
    LINE,
    aligned_rows,
    combine,
    explain,
    explain_several,
    multiply,
    project,
    summed,
)

JACOBIAN, HESSIAN = 1, 2  # how much is wanted: up to second derivatives of M, up to third


@njit_noalloc
def offsets(points, x, u, difference):
    """Writes x~_i - x~ as rows."""
    states = (len(x) + 2) // 3 * 3
    for c in range(len(points)):
        at = 0.0
        if c < len(x):
            at = x[c]
        elif states <= c < states + len(u):
            at = u[c - states]
        row, source = difference[c], points[c]
        for j in range(len(row)):
            row[j] = source[j] - at


@njit_noalloc
def correlate(log_signal, D, squares, factors, k):
    """Writes k_i = sf2 exp(-1/2 sum_d D_d (x~_i - x~)_d^2) to ``k``, from squared offsets; ``factors`` is scratch."""
    for c in range(len(squares)):
        factors[c] = D[c] / -2
    k[:] = log_signal
    combine(k, factors, squares)
    exp_all(k)


def means_memory(rows, padded):
    """Numbers that ``means_along`` works in, for ``points`` of this shape."""
    return (2 * rows + 1) * padded + rows + LINE


@compiled(allocates=False)
def means_along(points, inverse_squares, log_signal, beta, queries, n, memory, out):
    """M and its gradient at H points x~ = (x, u), queries (H, n + m), into out (H, k, 1 + n + m).

    What it works in is lent by the caller, ``means_memory`` numbers: counting references costs a third of a call.
    """
    widest()
    rows, padded = points.shape
    skipped = (n + 2) // 3 * 3 - n  # padded rows between the states' and the controls'
    skip = (-(memory.ctypes.data >> 3)) % LINE  # rows start on cache lines
    table = memory[skip : skip + (2 * rows + 1) * padded].reshape(2 * rows + 1, padded)
    difference, squares, k, sums = table[:rows], table[rows : 2 * rows], table[2 * rows], memory[-rows:]
    for h in range(len(queries)):
        offsets(points, queries[h, :n], queries[h, n:], difference)
        for c in range(rows):
            multiply(difference[c], difference[c], squares[c])
        for a in range(len(beta)):
            D, answer = inverse_squares[a], out[h, a]
            correlate(log_signal[a], D, squares, sums, k)
            multiply(k, beta[a], k)
            answer[0] = summed(k)
            project(k, difference, sums)
            for c in range(len(answer) - 1):
                row = c if c < n else c + skipped
                answer[1 + c] = D[row] * sums[row]


@njit_noalloc
def padded_inputs(m):
    """Rows of the controls."""
    return (m + 2) // 3 * 3


@njit_noalloc
def expand_at(gp, x, u, memory, kept, place, M, J, J_u):
    """M, its gradient J (k, n) and J_u (k, m) at one point, for other loops; the k_a stay in ``kept[:, place]``.

    ``gp`` holds the first four arrays of ``means_along``; ``memory`` has 2 R + 2 aligned rows.
    """
    widest()
    points, inverse_squares, log_signal, beta = gp
    (rows, padded), n, m = points.shape, len(x), len(u)
    U = rows - padded_inputs(m)
    difference, squares, weighted, sums = memory[:rows], memory[rows : 2 * rows], memory[2 * rows], memory[2 * rows + 1]
    for c in range(rows):
        at = x[c] if c < n else (u[c - U] if U <= c < U + m else 0.0)
        source, offset, square = points[c], difference[c], squares[c]
        for j in range(padded):
            value = source[j] - at
            offset[j] = value
            square[j] = value * value
    for a in range(len(beta)):  # written out: calls would take a fifth of the time
        D, k, factors, start = inverse_squares[a], kept[a, place], beta[a], log_signal[a]
        for c in range(0, rows, 3):
            square0, square1, square2 = squares[c], squares[c + 1], squares[c + 2]
            D0, D1, D2 = D[c] / -2, D[c + 1] / -2, D[c + 2] / -2
            if c == 0:
                for j in range(padded):
                    k[j] = start + D0 * square0[j] + D1 * square1[j] + D2 * square2[j]
            else:
                for j in range(padded):
                    k[j] = k[j] + D0 * square0[j] + D1 * square1[j] + D2 * square2[j]
        total = 0.0
        for j in range(padded):
            value = exp(k[j])
            k[j] = value
            value *= factors[j]
            weighted[j] = value
            total += value
        M[a] = total
        for c in range(0, rows, 3):
            offset0, offset1, offset2 = difference[c], difference[c + 1], difference[c + 2]
            sum0 = sum1 = sum2 = 0.0
            for j in range(padded):
                sum0 += weighted[j] * offset0[j]
                sum1 += weighted[j] * offset1[j]
                sum2 += weighted[j] * offset2[j]
            sums[c], sums[c + 1], sums[c + 2] = sum0, sum1, sum2
        for c in range(n):
            J[a, c] = D[c] * sums[c]
        for c in range(m):
            J_u[a, c] = D[U + c] * sums[U + c]


@compiled
def points_along(order, points, inverse_squares, log_signal, beta, inverse_cholesky, x, u, out):
    """Everything at H points, into the ten arrays of ``gpmpc.kernels.Expansion`` with H in front."""
    widest()
    M, variance, dM_dx, dM_du, dvar_dx, dvar_du, d2M_dx2, d2M_dxdu, d3M_dx3, d3M_dx2du = out
    (rows, padded), n, m = points.shape, x.shape[1], u.shape[1]
    U = rows - padded_inputs(m)  # where the controls begin
    memory = aligned_rows(2 * rows + 5, padded)
    difference, squares, k, weighted = memory[:rows], memory[rows : 2 * rows], memory[2 * rows], memory[2 * rows + 1]
    solved, once, twice = memory[2 * rows + 2], memory[2 * rows + 3], memory[2 * rows + 4]
    sums, moment = np.empty(rows), np.empty(rows)
    for h in range(len(x)):
        offsets(points, x[h], u[h], difference)
        for c in range(rows):
            multiply(difference[c], difference[c], squares[c])
        for a in range(len(beta)):
            D = inverse_squares[a]
            correlate(log_signal[a], D, squares, sums, k)
            variance[h, a] = max(np.exp(log_signal[a]) - explain(inverse_cholesky[a], k, solved), 0.0)
            multiply(solved, k, solved)
            project(solved, difference, sums)
            for c in range(n):
                dvar_dx[h, a, c] = -2 * D[c] * sums[c]
            for c in range(m):
                dvar_du[h, a, c] = -2 * D[U + c] * sums[U + c]

            multiply(k, beta[a], weighted)
            M[h, a] = summed(weighted)
            project(weighted, difference, sums)
            J, J_u = dM_dx[h, a], dM_du[h, a]
            for c in range(n):
                J[c] = D[c] * sums[c]
            for c in range(m):
                J_u[c] = D[U + c] * sums[U + c]
            for c in range(n):
                multiply(weighted, difference[c], once)
                project(once, difference, moment)
                for d in range(n):
                    d2M_dx2[h, a, c, d] = D[c] * D[d] * moment[d] - (D[c] * M[h, a] if c == d else 0.0)
                for d in range(m):
                    d2M_dxdu[h, a, c, d] = D[c] * D[U + d] * moment[U + d]
                if order == HESSIAN:
                    third, third_u = d3M_dx3[h, a], d3M_dx2du[h, a]
                    for d in range(c + 1):
                        multiply(once, difference[d], twice)
                        project(twice, difference, moment)
                        for e in range(n):
                            value = D[c] * D[d] * D[e] * moment[e]
                            value -= D[c] * J[e] if c == d else 0.0
                            value -= D[c] * J[d] if c == e else 0.0
                            value -= D[d] * J[c] if d == e else 0.0
                            third[c, d, e] = third[d, c, e] = value
                        for e in range(m):
                            value = D[c] * D[d] * D[U + e] * moment[U + e] - (D[c] * J_u[e] if c == d else 0.0)
                            third_u[c, d, e] = third_u[d, c, e] = value


@compiled
def linearize_along(gp, columns, offset, adds_state, x, u, M, J, J_u, covariance):
    """Writes M (K, k), its derivatives J (K, k, n) and J_u (K, k, m), and the diagonals of covariance (K, k, k).

    ``gp`` and ``columns`` are the posterior's arrays, ``offset`` (k,) its prior mean; ``adds_state`` where the GPs
    predict differences. No covariance is computed where there is no room for one (0, k, k). The triangle L_a is read
    once for all K points.
    """
    points, _, log_signal, beta = gp
    K, k, padded = len(x), len(beta), points.shape[1]
    memory = aligned_rows(2 * len(points) + 2, padded)
    places = (K + 3) // 4 * 4 if len(covariance) else 1
    correlations = aligned_rows(k * places, padded).reshape(k, places, padded)
    for h in range(K):
        expand_at(gp, x[h], u[h], memory, correlations, h if len(covariance) else 0, M[h], J[h], J_u[h])
        for a in range(k):
            M[h, a] += offset[a]
            if adds_state:
                M[h, a] += x[h, a]
                J[h, a, a] += 1.0
    if len(covariance):
        correlations[:, K:] = 0.0
        explained = np.zeros(places)
        for a in range(k):
            explained[:] = 0.0
            explain_several(columns[a], correlations[a], explained)
            signal = np.exp(log_signal[a])
            for h in range(K):
                covariance[h, a, a] = max(signal - explained[h], 0.0)
