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
from dataclasses import dataclass, field

import numpy as np

from gpmpc._compiled import compiled
from gpmpc._kernels._gp_point import _write_kernel
from gpmpc._kernels._packed import COLUMNS, Array, GPArrays, aligned
from gpmpc._kernels._simd import load, store, use_widest_registers
from gpmpc._kernels.linalg import aligned_rows, four_dots
from gpmpc.exceptions import SettingError


@dataclass(frozen=True)
class Window:
    """k GPs over N points, as ``linearize`` takes them; begin with ``Window.empty``."""

    arrays: GPArrays  #: what predictions of the mean read
    data: Array  #: of the points: x~ (d,), targets (k,), variances of their noise (k,) and beta (k,): (d + 3 k, P)
    columns: Array  #: L by columns, each with 1 / L_jj and v_j at its end (k, C, C + 8); C > N is for later windows
    state_dim: int  #: n
    input_dim: int  #: m
    rows: int = 0  #: of L that there are, N where the GPs are to predict
    _free: list[None] = field(
        default_factory=lambda: [None]
    )  #: has an item until a later window writes to ``columns``

    @classmethod
    def empty(
        cls, lengthscales: Array, signal_variance: Array, state_dim: int, capacity: int
    ) -> "Window":
        """GPs with length-scales (k, d) and sf2 (k,), for ``capacity`` points, without any."""
        k, d = lengthscales.shape
        data = np.zeros((d + 3 * k, 0))
        arrays = GPArrays(
            data[:d], lengthscales**-2.0, np.log(signal_variance), data[:k], 0
        )
        return cls(arrays, data, _no_columns(k, capacity), state_dim, d - state_dim)

    def without(self, gone: Sequence[int]) -> "Window":
        """The GPs without some points, and as yet without a row of the factor."""
        data = np.ascontiguousarray(
            np.delete(self.data[:, : self.arrays.size], gone, axis=1)
        )
        arrays = self.arrays._replace(size=data.shape[1])
        columns = _no_columns(*self.columns.shape[:2])
        return Window(arrays, data, columns, self.state_dim, self.input_dim)

    def append(
        self, point: Array, target: Array, noise: Array, rows: int | None = None
    ) -> "Window":
        """The GPs with a further point (d,), its target (k,) and the variance of its noise (k,).

        ``rows`` says how many rows of the factor there are to be. Raises SettingError where it does not exist.
        """
        (k, d), N, columns = (
            self.arrays.inverse_squares.shape,
            self.arrays.size + 1,
            self.columns,
        )
        P = -(-N // COLUMNS) * COLUMNS
        data = aligned((d + 3 * k, P))
        arrays = self.arrays._replace(points=data[:d], weights=data[-k:], size=N)
        try:
            self._free.pop()
        except IndexError:  # another window has followed on this one
            own = _no_columns(*columns.shape[:2])
            known = slice(self.rows)
            own[:, known, known], own[:, known, -2:] = (
                columns[:, known, known],
                columns[:, known, -2:],
            )
            columns = own
        rows = N if rows is None else rows
        new = np.concatenate([point, target, noise])
        if not _append.unchecked(
            self.data, new, data, arrays, columns, self.rows, rows
        ):
            raise SettingError(
                "noise",
                "is too small beside the signal: a kernel matrix is not positive definite",
            )
        return Window(arrays, data, columns, self.state_dim, self.input_dim, rows)


def _no_columns(outputs: int, capacity: int) -> Array:
    capacity = -(-capacity // COLUMNS) * COLUMNS
    return aligned((outputs * capacity, capacity + 8)).reshape(
        outputs, capacity, capacity + 8
    )


@compiled
def _append(before, new, data, gps, columns, first, last):
    """Writes data with a new point, rows of factors, and the weights where all rows are there; false without factor."""
    use_widest_registers()
    (k, d), P, N = gps.inverse_squares.shape, data.shape[1], gps.size
    for c in range(len(new)):
        data[c, : N - 1], data[c, N - 1 :] = before[c, : N - 1], new[c]
    memory = aligned_rows(d + 2, P)
    squares = memory[:d]
    q = memory[d]
    sums = memory[d + 1]
    for a in range(k):
        factor = columns[a]
        targets = data[d + a]
        noises = data[d + k + a]
        beta = gps.weights[a]
        for i in range(first, last):
            size = i // 8 * 8 + 8
            for c in range(d):
                point = gps.points[c]
                square = squares[c]
                at = gps.points[c, i]
                for j in range(size):
                    square[j] = (point[j] - at) * (point[j] - at)
            _write_kernel(
                gps.log_signal[a], gps.inverse_squares[a], squares, beta, q[:size], sums
            )
            rest = q[i] + noises[i]
            y = targets[i]
            for j in range(0, i, 4):  # columns from i on have zeros yet
                c0 = factor[j]
                c1 = factor[j + 1]
                c2 = factor[j + 2]
                c3 = factor[j + 3]
                w0 = q[j] * c0[-2]
                w1 = (q[j + 1] - w0 * c0[j + 1]) * c1[-2]
                w2 = (q[j + 2] - w0 * c0[j + 2] - w1 * c1[j + 2]) * c2[-2]
                w3 = (q[j + 3] - w0 * c0[j + 3] - w1 * c1[j + 3] - w2 * c2[j + 3]) * c3[
                    -2
                ]
                for m in range((j + 4) // 8 * 8, size, 8):
                    known = (
                        w0 * load(c0, m)
                        + w1 * load(c1, m)
                        + w2 * load(c2, m)
                        + w3 * load(c3, m)
                    )
                    store(q, m, load(q, m) - known)
                rest -= w0 * w0 + w1 * w1 + w2 * w2 + w3 * w3
                y -= w0 * c0[-1] + w1 * c1[-1] + w2 * c2[-1] + w3 * c3[-1]
                c0[i] = w0
                c1[i] = w1
                c2[i] = w2
                c3[i] = w3
            if not rest > 0.0:
                return False
            root = np.sqrt(rest)
            factor[i, i] = root
            factor[i, -2] = 1.0 / root
            factor[i, -1] = y / root
        for j in range((N - 1) // 4 * 4, -1 if last == N else N, -4):  # L' beta = v
            c0 = factor[j]
            c1 = factor[j + 1]
            c2 = factor[j + 2]
            c3 = factor[j + 3]
            four_dots(
                (c0[j + 4 :], c1[j + 4 :], c2[j + 4 :], c3[j + 4 :]),
                beta[j + 4 :],
                N - j - 4,
                sums,
            )
            w3 = (c3[-1] - sums[3]) * c3[-2]
            w2 = (c2[-1] - sums[2] - c2[j + 3] * w3) * c2[-2]
            w1 = (c1[-1] - sums[1] - c1[j + 3] * w3 - c1[j + 2] * w2) * c1[-2]
            w0 = (
                c0[-1] - sums[0] - c0[j + 3] * w3 - c0[j + 2] * w2 - c0[j + 1] * w1
            ) * c0[-2]
            beta[j] = w0
            beta[j + 1] = w1
            beta[j + 2] = w2
            beta[j + 3] = w3
    return True


@compiled
def drop_point(columns, gone, after):
    """Writes the columns of factors (k, N - 1, N - 1) without a point, from those with it (k, N, N)."""
    size = len(after[0])
    moved = np.empty(size)
    for a in range(len(after)):
        moved[gone:] = columns[a, gone, gone + 1 :]
        for j in range(size):
            row = after[a, j]
            row[:j] = 0.0
            if j < gone:
                row[j:gone], row[gone:] = (
                    columns[a, j, j:gone],
                    columns[a, j, gone + 1 :],
                )
                continue
            old = columns[a, j + 1]
            radius = np.hypot(old[j + 1], moved[j])
            c = old[j + 1] / radius
            s = moved[j] / radius
            for i in range(j, size):
                entry = old[i + 1]
                rest = moved[i]
                row[i] = c * entry + s * rest
                moved[i] = c * rest - s * entry
