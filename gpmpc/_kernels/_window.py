"""GPs whose points come one at a time and go many at a time, in the time that it takes to read their factors.

With K + N = L L' and v = L^-1 y, a new point adds a row to L and an entry to v, and changes the weights L^-T v:

    L+ = [L 0; w' r],     v+ = [v; (y - w'v) / r],     w = L^-1 k,     r^2 = sf2 + n - w'w

n is the variance of its noise. What was there before stays, so that old and new GPs share it. Points go when a factor
of the others takes the place of theirs; it is made beforehand, some rows with every new point. Factors are read by
columns, so that all loops run over contiguous memory.

``drop_point`` removes a point from a factor: what stands below it in its column l is absorbed by plane rotations,
L33+ L33+' = L33 L33' + l l' (Gill, Golub, Murray and Saunders, 1974; Osborne, 2010, appendix B, for GPs).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gpmpc._compiled import call_unchecked, compiled, njit_inner
from gpmpc._kernels._gp_point import _write_kernel
from gpmpc._kernels._packed import COLUMNS, Array, GPArrays, aligned
from gpmpc._kernels._simd import load, store, total, use_widest_registers, zeros
from gpmpc._kernels.linalg import aligned_rows, dot
from gpmpc.exceptions import SettingError


@dataclass(frozen=True)
class Window:
    """k GPs over N points, as ``linearize`` takes them; begin with ``Window.empty``."""

    arrays: GPArrays  #: what predictions of the mean read
    data: Array  #: of the points x~ (d,), their targets (k,), the variances of their noise (k,) and beta (k,): (d + 3 k, P)
    columns: Array  #: L by columns, and v at their ends (k, C, more than C); what is beyond N belongs to later windows
    state_dim: int  #: n
    rows: int = 0  #: of L that there are, N where the GPs are to predict
    _free: list[None] = field(default_factory=lambda: [None])  #: has an item until a later window writes to ``columns``

    @classmethod
    def empty(cls, lengthscales: Array, signal_variance: Array, state_dim: int, capacity: int) -> "Window":
        """GPs with length-scales (k, d) and sf2 (k,), for ``capacity`` points, without any."""
        k, d = lengthscales.shape
        data = np.zeros((d + 3 * k, 0))
        arrays = GPArrays(data[:d], lengthscales**-2.0, np.log(signal_variance), data[:k], 0)
        return cls(arrays, data, _no_columns(k, capacity), state_dim)

    @property
    def output_dim(self) -> int:
        """Number of outputs, k."""
        return len(self.columns)

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return len(self.arrays.points) - self.state_dim

    def without(self, gone: Sequence[int]) -> "Window":
        """The GPs without some points, and as yet without a row of the factor."""
        kept = np.delete(np.arange(self.arrays.size), gone)
        data, columns = np.ascontiguousarray(self.data[:, kept]), _no_columns(*self.columns.shape[:2])
        return Window(self.arrays._replace(size=len(kept)), data, columns, self.state_dim)

    def append(self, point: Array, target: Array, noise: Array, rows: int | None = None) -> "Window":
        """The GPs with a further point (d,), its target (k,) and the variance of its noise (k,).

        ``rows`` says how many rows of the factor there are to be. Raises SettingError where it does not exist.
        """
        (k, d), N, columns = self.arrays.inverse_squares.shape, self.arrays.size + 1, self.columns
        P = -(-N // COLUMNS) * COLUMNS
        data = aligned((d + 3 * k, P))
        arrays = self.arrays._replace(points=data[:d], weights=data[-k:], size=N)
        try:
            self._free.pop()
        except IndexError:  # another window has followed on this one
            own, known = _no_columns(*columns.shape[:2]), slice(self.rows)
            own[:, known, known], own[:, known, -2:] = columns[:, known, known], columns[:, known, -2:]
            columns = own
        rows, new = N if rows is None else rows, np.concatenate([point, target, noise])
        if not call_unchecked(_append, self.data, new, data, arrays, columns, self.rows, rows):
            raise SettingError("noise", "is too small beside the signal: a kernel matrix is not positive definite")
        return Window(arrays, data, columns, self.state_dim, rows)


def _no_columns(outputs: int, capacity: int) -> Array:
    width = -(-capacity // COLUMNS) * COLUMNS + 8
    return aligned((outputs * capacity, width)).reshape(outputs, capacity, width)


@compiled
def _append(before, new, data, gps, columns, first, last):
    """Writes data with a new point, rows of factors, and the weights where all rows are there; false without factor."""
    use_widest_registers()
    (k, d), P, N = gps.inverse_squares.shape, data.shape[1], gps.size
    for c in range(len(new)):
        data[c, : N - 1], data[c, N - 1 :] = before[c, : N - 1], new[c]
    memory = aligned_rows(d + 2, P)
    squares, q, weighted = memory[:d], memory[d], memory[d + 1]
    for a in range(k):
        factor, weights, targets, noises = columns[a], gps.weights[a], data[d + a], data[d + k + a]
        for i in range(first, last):
            size = i // 8 * 8 + 8
            for c in range(d):
                point, square, at = gps.points[c], squares[c], gps.points[c, i]
                for j in range(size):
                    square[j] = (point[j] - at) * (point[j] - at)
            _write_kernel(gps.log_signal[a], gps.inverse_squares[a], squares, weights, q[:size], weighted)
            rest, y = q[i] + noises[i], targets[i]
            whole = i // 4 * 4
            for j in range(0, whole, 4):
                c0, c1, c2, c3 = factor[j], factor[j + 1], factor[j + 2], factor[j + 3]
                w0 = q[j] * c0[-2]
                w1 = (q[j + 1] - w0 * c0[j + 1]) * c1[-2]
                w2 = (q[j + 2] - w0 * c0[j + 2] - w1 * c1[j + 2]) * c2[-2]
                w3 = (q[j + 3] - w0 * c0[j + 3] - w1 * c1[j + 3] - w2 * c2[j + 3]) * c3[-2]
                for m in range((j + 4) // 8 * 8, size, 8):
                    store(q, m, load(q, m) - (w0 * load(c0, m) + w1 * load(c1, m) + w2 * load(c2, m) + w3 * load(c3, m)))
                rest -= w0 * w0 + w1 * w1 + w2 * w2 + w3 * w3
                y -= w0 * c0[-1] + w1 * c1[-1] + w2 * c2[-1] + w3 * c3[-1]
                c0[i], c1[i], c2[i], c3[i] = w0, w1, w2, w3
            for j in range(whole, i):
                column = factor[j]
                w = q[j] * column[-2]
                for m in range(j + 1, i):
                    q[m] -= w * column[m]
                rest -= w * w
                y -= w * column[-1]
                column[i] = w
            if not rest > 0.0:
                return False
            root = np.sqrt(rest)
            factor[i, i], factor[i, -2], factor[i, -1] = root, 1.0 / root, y / root
        j = N if last == N else 0
        while j > 0:  # L' weights = v
            if j % 4 > 0:
                j -= 1
                weights[j] = (factor[j, -1] - dot(factor[j, j + 1 :], weights[j + 1 :], N - j - 1)) * factor[j, -2]
                continue
            j -= 4
            c0, c1, c2, c3 = factor[j], factor[j + 1], factor[j + 2], factor[j + 3]
            s0 = s1 = s2 = s3 = zeros()
            for m in range((j + 4) // 8 * 8, N, 8):
                known = load(weights, m)
                s0, s1, s2, s3 = s0 + load(c0, m) * known, s1 + load(c1, m) * known, s2 + load(c2, m) * known, s3 + load(c3, m) * known
            w3 = (c3[-1] - total(s3)) * c3[-2]
            w2 = (c2[-1] - total(s2) - c2[j + 3] * w3) * c2[-2]
            w1 = (c1[-1] - total(s1) - c1[j + 3] * w3 - c1[j + 2] * w2) * c1[-2]
            w0 = (c0[-1] - total(s0) - c0[j + 3] * w3 - c0[j + 2] * w2 - c0[j + 1] * w1) * c0[-2]
            weights[j], weights[j + 1], weights[j + 2], weights[j + 3] = w0, w1, w2, w3
    return True


@compiled
def drop_point(columns, gone, after):
    """Writes the columns of factors (k, N - 1, N - 1) without a point, from those with it (k, N, N)."""
    moved = np.empty(len(after[0]))
    for a in range(len(after)):
        _drop(columns[a], gone, after[a], moved, len(moved))


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
