"""Problem: minimise over the inputs alone what the affine stage models say of the states.

    s_{k+1} = A_k s_k + B_k u_k + c_k,   k = 0 .. H-1,   s_0 given
    minimise  sum_{k=1..H} |s_k - r_k|^2_{W_k} + sum_{k=0..H-1} |v_k|^2_R,    rows l_k <= E_k s_k <= h_k

With Gamma_{k,i} = ds_k / du_i the stacked problem is min 1/2 U'P U + q'U with P = 2 (Gamma' W Gamma + R~), q = 2 Gamma'
W (s^0 - r) + ..., s^0 the response to no input at all: (38)-(39) of Cao, Lai and Alam (2017), whose P lacks the 2. The
paper's unknowns are the increments dU = D U; in U the same problem has the input bounds as a box. Bounds on the
increments are rows.

A stage-structured (Riccati) factorisation costs O(H), and a pair of its recursions for every working constraint. With
n = 6, m = 3 and nothing working, condensing with the dense factor takes 0.9 of its time at H = 30, 1.1 at H = 50 and
2.4 at H = 100; where constraints work, condensing gains. So every horizon is condensed.

Multiplying the stacked matrices out costs O(H^3). Here it is O(H^2): Gamma is made a stage at a time, and with the cost
to go M_H = W_H, M_k = W_k + A_k' M_{k+1} A_k of a system without input, block (k, i <= k) of P is 2 B_k' M_{k+1}
Gamma_{k+1,i} (Andersson, 2013; Axehill, 2015, show that this order is reached). Where A
and B are held, Gamma_{k,i} depends on k - i only, and each block of P is its lower right neighbour plus one product.

Weights are block diagonal, (p / n, n, n): Q alone for the mean, and one Q a row of S for s = [mu; vec S], where
diag(Q, I_n kron Q) is never written out.
"""

import numpy as np

from gpmpc.compiled import borrowing, compiled, copy, copy_matrix
from gpmpc.kernels.point_rows import aligned_rows
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.qp.lanes import combine

Array = np.ndarray

PENALIZED = ("inputs", "deviations", "increments")
INPUTS, DEVIATIONS, INCREMENTS = range(3)


class Condenser:
    """Condenses the stages of one tracking problem, input weights and bounds included.

    Attributes:
        known: What ``condense`` and ``tracking_cost`` take of it.

    Args:
        problem: Weights and bounds of the inputs.
        horizon: H.
        weight: W of the extended state (p / n, n, n).
        terminal: W_H (p / n, n, n).
    """

    def __init__(self, problem: TrackingProblem, horizon: int, weight: Array, terminal: Array):
        m = problem.input_dim
        self.problem, self.horizon = problem, horizon
        self._weight, self._terminal = np.ascontiguousarray(weight), np.ascontiguousarray(terminal)
        self._same_terminal = bool(np.array_equal(weight, terminal))
        difference = np.eye(horizon * m) - np.eye(horizon * m, k=-m)  # D: dU = D U - [u_{-1}; 0; ...]
        stacked = np.kron(np.eye(horizon), problem.R)
        self._input_hessian = 2 * (
            difference.T @ stacked @ difference if problem.penalized == "increments" else stacked
        )
        self._rate_rows = difference if problem.rate_limited else difference[:0]
        self._box = np.tile(problem.input_lower, horizon), np.tile(problem.input_upper, horizon)
        self._rates = np.tile(problem.rate_lower, horizon), np.tile(problem.rate_upper, horizon)
        lower, upper = self.bounds(np.zeros(m), np.empty(0), np.empty(0))
        self.known = (
            (self._weight, self._terminal, np.ascontiguousarray(problem.R), PENALIZED.index(problem.penalized)),
            (self._input_hessian, np.ascontiguousarray(self._rate_rows), lower, upper),
        )

    @property
    def rate_rows(self) -> int:
        """How many rows of G bound increments; they come before those of the states."""
        return len(self._rate_rows)

    def curvature(self, A: Array, B: Array, rows: Array) -> tuple[Array, Array]:
        """P (H m, H m) and G (rate rows + H r, H m), which do not depend on where the state is.

        Args:
            A: (H, p, p), or (1, p, p) where it is held; all arrays contiguous.
            B: (H, p, m), or (1, p, m).
            rows: E_k of s_{k+1}, (H, r, p), or (1, r, p) where they are held.
        """
        first, size = self.rate_rows, len(self._input_hessian)
        P = self._input_hessian.copy()
        G = np.zeros((first + self.horizon * rows.shape[1], size))
        G[:first] = self._rate_rows
        if len(A) == 1 and len(rows) == 1:
            _held_curvature(
                A[0], B[0], self._weight, self._terminal, self._same_terminal, rows[0], self.horizon, P, G[first:]
            )
        else:
            _varying_curvature(A, B, self._weight, self._terminal, rows, self.horizon, P, G[first:])
        return P, G

    def slope(
        self, A: Array, B: Array, c: Array, start: Array, rows: Array, targets: Array, wanted: Array, last: Array
    ) -> tuple[Array, Array]:
        """The linear term q (H m,), and E_k s_{k+1} without input (H, r).

        Args:
            A: As for ``curvature``.
            B: As for ``curvature``.
            c: (H, p) or (1, p).
            start: s_0 (p,).
            rows: As for ``curvature``.
            targets: r_1 .. r_H of the mean (H, n); the rest of s is to be zero.
            wanted: Reference inputs (H, m), used where R weighs deviations.
            last: u_{-1} (m,), used where R weighs increments.
        """
        H, m = self.horizon, len(last)
        q, values = np.zeros((H, m)), np.empty((H, rows.shape[1]))
        centre = {"inputs": wanted[:0], "deviations": wanted, "increments": last[None]}[self.problem.penalized]
        _slope(
            A,
            B,
            c,
            start,
            rows,
            targets,
            self._weight,
            self._terminal,
            np.ascontiguousarray(centre),
            self.problem.R,
            q,
            values,
        )
        return q.ravel(), values

    def bounds(self, last: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The bounds of the stacked constraints [U; rates; rows], from those of the rows (H, r) each."""
        parts = [[side] for side in self._box]
        if self.rate_rows:
            for part, side in zip(parts, self._rates, strict=True):
                shifted = side.copy()
                shifted[: len(last)] += last
                part.append(shifted)
        return np.concatenate([*parts[0], lower.ravel()]), np.concatenate([*parts[1], upper.ravel()])

    def cost(self, states: Array, inputs: Array, targets: Array, wanted: Array, last: Array) -> float:
        """The objective itself, constants included [the unit of the cost].

        Args:
            states: s_0 .. s_H (H + 1, p).
            inputs: (H, m).
            targets: r_1 .. r_H (H, n).
            wanted: (H, m).
            last: u_{-1} (m,).
        """
        return tracking_cost(self.known, states, inputs, targets, wanted, last)


@compiled
def tracking_cost(known, states, inputs, targets, wanted, last):
    """``Condenser.cost``; all arrays contiguous."""
    W, T, R, penalized = known[0]
    (H, n), m = targets.shape, len(R)
    total, error, v = 0.0, np.empty(states.shape[1]), np.empty(m)
    for k in range(H):
        copy(states[k + 1], error)
        for i in range(n):
            error[i] -= targets[k, i]
        weight = T if k == H - 1 else W
        for b in range(len(W)):
            for i in range(n):
                for j in range(n):
                    total += error[b * n + i] * weight[b, i, j] * error[b * n + j]
        for i in range(m):
            v[i] = inputs[k, i]
            if penalized == DEVIATIONS:
                v[i] -= wanted[k, i]
            elif penalized == INCREMENTS:
                v[i] -= inputs[k - 1, i] if k > 0 else last[i]
        for i in range(m):
            for j in range(m):
                total += v[i] * R[i, j] * v[j]
    return total


@compiled
def condense(known, stages, start, targets, wanted, last, program):
    """Writes the program of stages that vary to ``program``: P, q, G and the bounds of the stacked constraints.

    Args:
        known: Of a ``Condenser``.
        stages: A (H, p, p), B (H, p, m), c (H, p), rows (H, r, p) or (1, r, p), and their bounds (H, r) each.
        start: s_0 (p,).
        targets: As for ``Condenser.slope``.
        wanted: As for ``Condenser.slope``.
        last: As for ``Condenser.slope``.
        program: (H m, H m), (H m,), (rows, H m), (H m + rows,) twice.
    """
    (W, T, R, penalized), (hessian, rate_rows, box_lower, box_upper) = known
    A, B, c, rows, low, high = stages
    P, q, G, lower, upper = program
    (H, m), r, first, given = wanted.shape, rows.shape[1], len(rate_rows), len(box_lower)
    copy_matrix(hessian, P)
    copy_matrix(rate_rows, G[:first])
    G[first:] = 0.0
    _varying_curvature(A, B, W, T, rows, H, P, G[first:])
    q[:] = 0.0
    centre = wanted[: H if penalized == DEVIATIONS else 0]
    if penalized == INCREMENTS:
        centre = last.reshape(1, m)
    values = np.empty((H, r))
    _slope(A, B, c, start, rows, targets, W, T, centre, R, q.reshape(H, m), values)
    for i in range(given):
        shift = last[i - len(q)] if len(q) <= i < len(q) + m else 0.0
        lower[i], upper[i] = box_lower[i] + shift, box_upper[i] + shift
    for k in range(H):
        for e in range(r):
            lower[given + k * r + e], upper[given + k * r + e] = low[k, e] - values[k, e], high[k, e] - values[k, e]


@compiled
def respond(A, B, c, start, inputs, states):
    """Writes s_0 .. s_H (H + 1, p) under inputs (H, m) to ``states``."""
    held = len(A) - 1
    p, m = B.shape[1], B.shape[2]
    copy(start, states[0])
    for k in range(len(inputs)):
        at = min(k, held)
        s, u = states[k], inputs[k]
        for r in range(p):
            total = c[at, r]
            row = A[at, r]
            for j in range(p):
                total += row[j] * s[j]
            for j in range(m):
                total += B[at, r, j] * u[j]
            states[k + 1, r] = total


@compiled
def _dot(x, y):
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


@compiled
def _varying_curvature(A, B, W, T, rows, H, P, G):
    """Adds 2 Gamma' W Gamma to P, and writes E Gamma to G; whole registers at a time, in padded copies."""
    p, m, r, n, size = B.shape[1], B.shape[2], rows.shape[1], W.shape[1], H * B.shape[2]
    M, MA, MB = _zeros(p, p), _zeros(p, p), _zeros(p, m)
    here, back, reach = _zeros(p, p), np.empty((p, p)), _zeros(p, m)  # A, A' and B of a stage
    pull = np.empty((H, m, p))  # B_k' M_{k+1}, twice
    for k in range(H - 1, -1, -1):  # backward: M_{k+1} = W_{k+1} + A' M A, the second part is there already
        at, weight = min(k, len(A) - 1), T if k == H - 1 else W
        for b in range(len(W)):
            for i in range(n):
                for j in range(n):
                    M[b * n + i, b * n + j] += weight[b, i, j]
        for i in range(p):
            for j in range(p):
                here[i, j] = back[j, i] = A[at, i, j]
            for j in range(m):
                reach[i, j] = B[at, i, j]
        for i in range(p):
            combine(reach, p, M[i], 0, m, MB[i])
            combine(here, p, M[i], 0, p, MA[i])
            for j in range(m):
                pull[k, j, i] = 2.0 * MB[i, j]
        for i in range(p):
            combine(MA, p, back[i], 0, p, M[i])
    gamma, moved, row = _zeros(p, size), _zeros(p, size), _zeros(1, size)[0]
    for k in range(H):  # forward: Gamma_{k+1}
        at, width = min(k, len(A) - 1), (k + 1) * m
        for i in range(p):
            combine(gamma, p, A[at, i], 0, k * m, moved[i])
            for j in range(m):
                moved[i, k * m + j] = B[at, i, j]
        gamma, moved = moved, gamma
        for a in range(m):
            combine(gamma, p, pull[k, a], 0, width, row)
            out = P[k * m + a]
            for j in range(width):
                out[j] += row[j]
        for e in range(r):
            combine(gamma, p, rows[min(k, len(rows) - 1), e], 0, width, row)
            copy(row, G[k * r + e, :width])
    _mirror(P)


@compiled
def _zeros(rows, columns):
    """Zeros in rows of whole registers, on cache lines."""
    matrix = aligned_rows(rows, (columns + 7) // 8 * 8)
    matrix[:] = 0.0
    return matrix


@compiled
def _held_curvature(A, B, W, T, same, rows, H, P, G):
    """The same with one A, B and E for all stages."""
    p, m, r, size = B.shape[0], B.shape[1], rows.shape[0], H * B.shape[1]
    X, back = _zeros(size, p), _zeros(p, p)  # rows l m + a of X: column a of A^l B
    W, T = _widened(W), _widened(T)
    for i in range(p):
        for j in range(p):
            back[j, i] = A[i, j]
        for a in range(m):
            X[a, i] = B[i, a]
    for row in range(m, size):
        combine(back, p, X[row - m], 0, p, X[row])
    reached = size + 8  # whole registers from any column on
    strip, usual, last = _zeros(p, reached), _zeros(1, reached)[0], _zeros(1, reached)[0]
    for row in range(size):
        for i in range(p):
            strip[i, row] = X[row, i]
    total, weighed = _zeros(m, size), _zeros(1, p + 8)[0]
    for k in range(H):
        # Block (j, j - d) is the sum over l <= k = H - 1 - j of X_l' W X_{l + d}, the last with the terminal weight.
        j, start = H - 1 - k, k * m
        for a in range(m):
            _weigh(W, X[start + a], weighed)
            combine(strip, p, weighed, start, size - start, usual)
            if not same:
                _weigh(T, X[start + a], weighed)
                combine(strip, p, weighed, start, size - start, last)
            ends, sums, out = usual if same else last, total[a], P[j * m + a]
            for d in range(j + 1):
                for b in range(m):
                    out[(j - d) * m + b] += 2.0 * (sums[d * m + b] + ends[start + d * m + b])
            for i in range(size - start):
                sums[i] += usual[start + i]
    for e in range(r):
        combine(strip, p, rows[e], 0, size, usual)
        for k in range(H):
            for d in range(k + 1):
                for b in range(m):
                    G[k * r + e, (k - d) * m + b] = usual[d * m + b]
    _mirror(P)


@compiled
def _widened(W):
    """The blocks of a weight, symmetric, in rows of whole registers (p / n, n, n padded)."""
    wide = np.zeros((len(W), W.shape[1], (W.shape[1] + 7) // 8 * 8))
    for b in range(len(W)):
        for i in range(W.shape[1]):
            copy(W[b, i], wide[b, i, : W.shape[1]])
    return wide


@borrowing
def _weigh(W, x, y):
    """Writes W x for the blocks of ``_widened`` to ``y``, and up to seven numbers after it."""
    n = W.shape[1]
    for b in range(len(W)):
        combine(W[b], n, x[b * n :], 0, n, y[b * n :])


@compiled
def _mirror(P):
    """Takes the upper triangle from the lower one; in blocks, which stay in the cache."""
    size = len(P)
    for top in range(0, size, 8):
        for left in range(0, top + 1, 8):
            for i in range(top, min(top + 8, size)):
                for j in range(left, min(left + 8, i)):
                    P[j, i] = P[i, j]


@compiled
def _slope(A, B, c, start, rows, targets, W, T, centre, R, q, values):
    """Adds 2 Gamma' W (s^0 - r) - 2 R centre to q by the adjoint recursion, and writes E s^0 to ``values``."""
    held, held_rows = len(A) - 1, len(rows) - 1
    H, n = targets.shape
    p, m, r = B.shape[1], B.shape[2], rows.shape[1]
    free, nothing = np.empty((H + 1, p)), np.zeros((H, m))
    respond(A, B, c, start, nothing, free)
    for k in range(len(centre)):
        for i in range(m):
            for j in range(m):
                q[k, i] -= 2.0 * R[i, j] * centre[k, j]
    W, T = _widened(W), _widened(T)
    error, slope, pulled = np.empty(p), np.zeros(p + 8), np.zeros(p)
    for k in range(H - 1, -1, -1):
        at, row_at = min(k, held), min(k, held_rows)
        for e in range(r):
            values[k, e] = _dot(rows[row_at, e], free[k + 1])
        copy(free[k + 1], error)
        for i in range(n):
            error[i] -= targets[k, i]
        _weigh(T if k == H - 1 else W, error, slope)
        for i in range(p):
            slope[i] = 2.0 * slope[i] + pulled[i]
        pulled[:] = 0.0
        for i in range(p):
            weight = slope[i]
            row = A[at, i]
            for j in range(p):
                pulled[j] += weight * row[j]
            for j in range(m):
                q[k, j] += weight * B[at, i, j]
