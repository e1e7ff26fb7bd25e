"""Points of GPs that come and go in the time that it takes to read their factors.

With K + N = L L', a point that goes leaves a column l of L below its place, which the later columns absorb by plane
rotations, and a new point adds a row (Gill, Golub, Murray and Saunders, 1974; Osborne, 2010, appendix B, for GPs):

    L33+ L33+' = L33 L33' + l l',     L+ = [L 0; w' r],     w = L^-1 k,     r^2 = sf2 + n - w'w

n is the variance of the new point's noise. Factors are read by columns, so that all loops run over contiguous memory.
"""

import numpy as np

from gpmpc._compiled import call_unchecked, compiled, njit_inner
from gpmpc._kernels._gp_point import _write_kernel, _write_offsets
from gpmpc._kernels._packed import COLUMNS, Array, Packed, aligned
from gpmpc.exceptions import SettingError


def replace_point(
    packed: Packed, targets: Array, point: Array, target: Array, noise: Array, drop: int = -1
) -> tuple[Packed, Array]:
    """Appends a point (d,) with a target (k,) and noise of a variance (k,) to GPs; returns them and all targets (k, N).

    Another point goes where ``drop`` says which. Raises SettingError where a matrix is not positive definite.
    """
    (k, before), d = targets.shape, len(point)
    N = before + (drop < 0)
    P = -(-N // COLUMNS) * COLUMNS
    arrays = packed.arrays._replace(points=aligned((d, P)), weights=aligned((k, P)), size=N)
    after, new = (arrays, np.empty((k, N, N)), np.empty((k, N))), (point, np.ascontiguousarray(target), noise)
    if not call_unchecked(_replace, (packed.arrays.points, packed.columns, targets), after, drop, *new):
        raise SettingError("noise", "is too small beside the signal: a kernel matrix is not positive definite")
    return Packed(arrays, after[1].transpose(0, 2, 1), packed.state_dim, packed.input_dim), after[2]


@compiled
def drop_point(columns, gone, after):
    """Writes the columns of factors (k, N - 1, N - 1) without a point, from those with it (k, N, N)."""
    moved = np.empty(len(after[0]))
    for a in range(len(after)):
        _drop(columns[a], gone, after[a], moved, len(moved))


@compiled
def _replace(before, after, drop, point, target, noise):
    """Writes arrays, columns of factors and targets with a new last point; false where a factor does not exist."""
    (old_points, columns, old_targets), (arrays, factors, targets) = before, after
    points, weights, last = arrays.points, arrays.weights, arrays.size - 1
    gone = drop if drop >= 0 else last
    for rows, old_rows, added in ((points, old_points, point), (targets, old_targets, target)):
        for c in range(len(rows)):
            rows[c, :gone], rows[c, gone:last] = old_rows[c, :gone], old_rows[c, gone + 1 : last + 1]
            rows[c, last:] = added[c]
    memory = np.empty((2 * len(point) + 3, points.shape[1]))
    offsets, squares, new, moved = memory[: len(point)], memory[len(point) : -3], memory[-3], memory[-2]
    _write_offsets(points, point, point[:0], offsets, squares)
    for a in range(len(factors)):
        factor, right = factors[a], weights[a]
        _write_kernel(arrays.log_signal[a], arrays.inverse_squares[a], squares, right, new, memory[-1])
        _drop(columns[a], gone, factor, moved, last)
        right[: last + 1], rest = targets[a], new[last] + noise[a]
        for j in range(last):
            row = factor[j]
            w, y = new[j] / row[j], right[j] / row[j]
            row[last], right[j] = w, y
            rest -= w * w
            right[last] -= w * y
            for i in range(j + 1, last):
                new[i] -= w * row[i]
                right[i] -= y * row[i]
        if not rest > 0.0:
            return False
        factor[last, :last], factor[last, last] = 0.0, np.sqrt(rest)
        right[last] /= factor[last, last]
        for j in range(last, -1, -1):
            total, row = right[j], factor[j]
            for i in range(j + 1, last + 1):
                total -= row[i] * right[i]
            right[j] = total / row[j]
    return True


@njit_inner
def _drop(columns, gone, after, moved, size):
    """Writes the first columns (size, size) without a point; ``moved`` (size,) is lent to work in."""
    if gone < size:
        moved[gone:size] = columns[gone, gone + 1 :]
    for j in range(size):
        row = after[j]
        row[:j] = 0.0
        if j < gone:
            row[j:gone], row[gone:size] = columns[j, j:gone], columns[j, gone + 1 : size + 1]
            continue
        old = columns[j + 1]
        radius = np.hypot(old[j + 1], moved[j])
        c, s = old[j + 1] / radius, moved[j] / radius
        for i in range(j, size):
            entry, rest = old[i + 1], moved[i]
            row[i], moved[i] = c * entry + s * rest, c * rest - s * entry
