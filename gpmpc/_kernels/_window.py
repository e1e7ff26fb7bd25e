"""GPs whose points come one at a time and go many at a time.

Both take the time to read the GPs' factors. With K + N = L L' and v = L^-1 y, a new
point adds a row to L and an entry to v, and changes the weights L^-T v:

    L+ = [L 0; w' r],   v+ = [v; (y - w'v) / r],   w = L^-1 k,   r^2 = sf2 + n - w'w

n is the variance of its noise. All other entries stay, so that old and new GPs share
them. Points go when a factor of the others takes the place of theirs; it is made
beforehand, some rows with every new point. Factors are read by columns, so that all
loops run over contiguous memory.

``drop_point`` removes a point from a factor: the part below it of its column l is
absorbed by plane rotations, L33+ L33+' = L33 L33' + l l' (Gill, Golub, Murray and
Saunders, 1974; Osborne, 2010, appendix B, for GPs).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gpmpc._compiled import compiled, njit_noalloc
from gpmpc._kernels._gp_point import write_kernel
from gpmpc._kernels._packed import COLUMNS, Array, GPArrays, aligned, as_doubles
from gpmpc._kernels._simd import load, store, use_widest_registers
from gpmpc._kernels.linalg import aligned_rows, four_dots
from gpmpc.exceptions import DataError, SettingError, ShapeError

# where a column j of L has 1 / L_jj and v_j: [0 .. 0, L_jj .. L_Nj, .., 1 / L_jj, v_j]
INVERSE = -2
V = -1


@dataclass(frozen=True)
class Window:
    """k GPs over N points, as ``linearize_gps`` takes them.

    Begin with ``Window.empty``. The GPs that it and ``without`` return predict only
    once ``append`` has written all rows of their factor.
    """

    arrays: GPArrays  #: what predictions of the mean read
    #: of the points: x~ (d rows), targets (k rows), variances of their noise (k rows)
    #: and beta (k rows): (d + 3 k, P)
    data: Array
    #: L by columns, each with 1 / L_jj and v_j at its end (k, C, C + 8); C > N is for
    #: later windows
    columns: Array
    state_dim: int  #: n
    input_dim: int  #: m
    rows: int = 0  #: number of rows of L that are computed: N > 0 where the GPs predict
    #: whether a next window may write to ``columns``: one item, which the first takes;
    #: a list, since to take from it is one step also where threads share the window. It
    #: is not given back where that append fails: the next one copies
    _extension_token: list[None] = field(default_factory=lambda: [None])

    @classmethod
    def empty(
        cls, lengthscales: Array, signal_variance: Array, state_dim: int, capacity: int
    ) -> "Window":
        """Makes GPs without points, for ``capacity`` of them.

        Length-scales are (k, d), sf2 is (k,).
        """
        k, d = lengthscales.shape
        data = np.zeros((d + 3 * k, 0))
        arrays = GPArrays(
            points=data[:d],
            inverse_squares=as_doubles(lengthscales) ** -2.0,
            log_signal=np.log(as_doubles(signal_variance)),
            weights=data[:k],  # of the shape alone, as N = 0
            size=0,
        )
        return cls(
            arrays=arrays,
            data=data,
            columns=_no_columns(k, capacity),
            state_dim=state_dim,
            input_dim=d - state_dim,
        )

    def without(self, gone: Sequence[int]) -> "Window":
        """Returns the GPs without some points, and without a row of the factor yet.

        ``arrays`` still has the points and weights of before, which nobody may read.
        """
        points = self.data[:, : self.arrays.size]
        data = np.ascontiguousarray(np.delete(points, gone, axis=1))
        return Window(
            arrays=self.arrays._replace(size=data.shape[1]),
            data=data,
            columns=_no_columns(*self.columns.shape[:2]),
            state_dim=self.state_dim,
            input_dim=self.input_dim,
        )

    def append(
        self, point: Array, target: Array, noise: Array, rows: int | None = None
    ) -> "Window":
        """Returns the GPs with a further point.

        Args:
            point: x~ (d,).
            target: Its targets (k,).
            noise: The variances of its noise (k,).
            rows: Number of rows of the factor that there are to be; by default all,
                also those that were left out before.

        Raises:
            ShapeError: The point, its targets or their noise have another length.
            DataError: An entry is not finite.
            SettingError: The factor does not exist, or has no room for the point.
        """
        k, d = self.arrays.inverse_squares.shape
        N = self.arrays.size + 1
        capacity = self.columns.shape[1]
        if capacity < N:
            raise SettingError("capacity", f"of {capacity} points is used up")
        P = -(-N // COLUMNS) * COLUMNS
        data = aligned((d + 3 * k, P))
        arrays = self.arrays._replace(points=data[:d], weights=data[-k:], size=N)
        shapes = np.shape(point), np.shape(target), np.shape(noise)
        if shapes != ((d,), (k,), (k,)):
            rule = f"a point ({d},), targets ({k},) and noise ({k},)"
            raise ShapeError(f"{rule} are appended; got {shapes}")
        # the kernel takes any array for one of doubles
        new = np.concatenate([point, target, noise], dtype=np.float64)
        if not np.isfinite(new).all():
            raise DataError("a point, its targets and their noise must be finite")
        columns = self._columns_to_extend()
        rows = N if rows is None else rows
        positive = _append.unchecked(
            before=self.data,
            new=new,
            data=data,
            gps=arrays,
            columns=columns,
            first=self.rows,
            last=rows,
        )
        if not positive:
            raise SettingError(
                "noise",
                "is too small beside the signal: a kernel matrix is not positive "
                "definite",
            )
        return Window(
            arrays=arrays,
            data=data,
            columns=columns,
            state_dim=self.state_dim,
            input_dim=self.input_dim,
            rows=rows,
        )

    def _columns_to_extend(self) -> Array:
        """Returns the factors that a next window may write further rows to.

        They are this window's own for the first that follows on it, else a copy.
        """
        try:
            self._extension_token.pop()
        except IndexError:
            columns = _no_columns(*self.columns.shape[:2])
            done = slice(self.rows)
            columns[:, done, done] = self.columns[:, done, done]
            columns[:, done, INVERSE:] = self.columns[:, done, INVERSE:]
            return columns
        return self.columns


def _no_columns(outputs: int, capacity: int) -> Array:
    capacity = -(-capacity // COLUMNS) * COLUMNS
    return aligned((outputs * capacity, capacity + 8)).reshape(
        outputs, capacity, capacity + 8
    )


@compiled
def _append(before, new, data, gps, columns, first, last):
    """Writes data with a new point, and rows ``first`` to ``last`` of factors.

    Writes the weights where all rows are there. Returns False where a factor does not
    exist.
    """
    use_widest_registers()
    k, d = gps.inverse_squares.shape
    N = gps.size
    for c in range(len(new)):
        data[c, : N - 1] = before[c, : N - 1]
        data[c, N - 1 :] = new[c]
    squares = aligned_rows(d, data.shape[1])
    q = aligned_rows(1, data.shape[1])[0]
    weighted = aligned_rows(1, data.shape[1])[0]
    for a in range(k):
        factor = columns[a]
        targets = data[d + a]
        noises = data[d + k + a]
        for i in range(first, last):
            _write_kernel_row(gps, a, i, squares, q, weighted)
            if not _write_factor_row(factor, i, q, noises[i], targets[i]):
                return False
        if last == N:
            _write_weights(factor, N, gps.weights[a], weighted)
    return True


@njit_noalloc
def _write_kernel_row(gps, a, i, squares, q, weighted):
    """Writes k_a(x~_j, x~_i) to q, for all j up to i and a few more."""
    size = i // 8 * 8 + 8
    for c in range(len(gps.points)):
        point = gps.points[c]
        square = squares[c]
        centre = point[i]
        for j in range(size):
            square[j] = (point[j] - centre) * (point[j] - centre)
    write_kernel(
        gps.log_signal[a],
        gps.inverse_squares[a],
        squares,
        gps.weights[a],
        q[:size],
        weighted,
    )


@njit_noalloc
def _write_factor_row(factor, i, q, noise, target):
    """Writes row i of L and v_i, from q = k(x~_j, x~_i); False where r^2 <= 0.

    It solves L w = q, four columns of L at a time.
    """
    use_widest_registers()
    size = i // 8 * 8 + 8
    square = q[i] + noise  # becomes r^2
    y = target  # becomes y - w'v
    # columns of L from i on are still zero, so the last group of four may pass i
    for j in range(0, i, 4):
        c0 = factor[j]
        c1 = factor[j + 1]
        c2 = factor[j + 2]
        c3 = factor[j + 3]
        w0 = q[j] * c0[INVERSE]
        w1 = (q[j + 1] - w0 * c0[j + 1]) * c1[INVERSE]
        w2 = (q[j + 2] - w0 * c0[j + 2] - w1 * c1[j + 2]) * c2[INVERSE]
        w3 = (q[j + 3] - w0 * c0[j + 3] - w1 * c1[j + 3] - w2 * c2[j + 3]) * c3[INVERSE]
        for m in range((j + 4) // 8 * 8, size, 8):
            product = (
                w0 * load(c0, m)
                + w1 * load(c1, m)
                + w2 * load(c2, m)
                + w3 * load(c3, m)
            )
            store(q, m, load(q, m) - product)
        square -= w0 * w0 + w1 * w1 + w2 * w2 + w3 * w3
        y -= w0 * c0[V] + w1 * c1[V] + w2 * c2[V] + w3 * c3[V]
        c0[i] = w0
        c1[i] = w1
        c2[i] = w2
        c3[i] = w3
    if not square > 0.0:
        return False
    root = np.sqrt(square)
    factor[i, i] = root
    factor[i, INVERSE] = 1.0 / root
    factor[i, V] = y / root
    return True


@njit_noalloc
def _write_weights(factor, N, beta, sums):
    """Solves L' beta = v, from the last four columns of L to the first."""
    use_widest_registers()
    for j in range((N - 1) // 4 * 4, -1, -4):
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
        w3 = (c3[V] - sums[3]) * c3[INVERSE]
        w2 = (c2[V] - sums[2] - c2[j + 3] * w3) * c2[INVERSE]
        w1 = (c1[V] - sums[1] - c1[j + 3] * w3 - c1[j + 2] * w2) * c1[INVERSE]
        residual = c0[V] - sums[0] - c0[j + 3] * w3 - c0[j + 2] * w2 - c0[j + 1] * w1
        w0 = residual * c0[INVERSE]
        beta[j] = w0
        beta[j + 1] = w1
        beta[j + 2] = w2
        beta[j + 3] = w3


@compiled
def drop_point(columns, gone, after):
    """Writes the columns of factors without a point (k, N - 1, N - 1).

    ``columns`` (k, N, N) are those with it.
    """
    size = len(after[0])
    below = np.empty(size)  # the part of the point's column to be absorbed
    for a in range(len(after)):
        below[gone:] = columns[a, gone, gone + 1 :]
        for j in range(size):
            row = after[a, j]
            row[:j] = 0.0
            if j < gone:
                row[j:gone] = columns[a, j, j:gone]
                row[gone:] = columns[a, j, gone + 1 :]
                continue
            old_column = columns[a, j + 1]
            radius = np.hypot(old_column[j + 1], below[j])
            c = old_column[j + 1] / radius
            s = below[j] / radius
            for i in range(j, size):
                entry = old_column[i + 1]
                absorbed = below[i]
                row[i] = c * entry + s * absorbed
                below[i] = c * absorbed - s * entry
