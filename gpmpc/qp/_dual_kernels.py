"""The compiled entry point of the dual active set: a warm-started solve whose result is judged by its own residuals.

``solve`` minimises ``1/2 x'Px + q'x`` subject to ``lower <= [x; Gx] <= upper`` from a guessed working set and writes a
record (``gpmpc.qp._record``). The guess is corrected until its multipliers have the right signs, then by the dual
iteration (``gpmpc.qp._dual_iteration``). Nothing is believed without its residuals: x is refined on its working set by
Newton's method (one step is exact but for rounding) with residuals computed from P, q and G, and handed back to the
iteration while a bound is violated.
"""

import math

import numpy as np

from gpmpc._compiled import compiled, inline_njit
from gpmpc._kernels._simd import any_nonzero, clip, larger, largest, load, load_some, store, total, zeros
from gpmpc._kernels.linalg import dot, multiply
from gpmpc.qp._dual_iteration import NEGLIGIBLE, add_multipliers, iterate, multiply_constraints, restore_constraints
from gpmpc.qp._record import (
    AGE,
    CONSTRAINTS,
    HEADER,
    ITERATION_LIMIT,
    ITERATIONS,
    MISUSE,
    NUMERICAL_TROUBLE,
    SOLVED,
    STATUS,
    TAG,
    VARIABLES,
    WORKING,
)
from gpmpc.qp._triangular import factorise, multiply_rows, solve_lower, solve_transposed, subtract_rows
from gpmpc.qp._violations import TOLERATED, are_present, choose_guess, list_violated, restore_limits
from gpmpc.qp._workspace import SHARE, all_finite, is_dense, is_dense_matrix, open_workspace, round_end

SIGNATURE = "i8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1])"

_PRESENT = np.nextafter(1e20, 0.0)  # the largest bound that is one
_NOISE = 2e-14  # violation that a constraint which depends on others may be left with: see ``_worst_violation``
_LATER = 1e-11  # violation, as a share of the length of q, that waits for the refined x
_ROUNDS = 10  # returns from the residuals to the iteration
_REFINEMENTS = 3
_FINE, _FINEST = 2e-10, 1e-15  # residuals at which refinement stops
_DOUBT = 3e-7  # times the shares that cancellation left of the pivots: the largest residual of a solution
_ILL = 5e-4  # such a share: what else x violates is seen of the best x only
_OLD = 1000  # changes after which a factor is computed anew
_BATCHES = 4  # see ``iterate``
_TINY = 1e-300
_UNDEFINED = 1e300  # a residual that overflowed; less than infinity, so that refinement is tried


@compiled(allocates=False, locked=True)
def solve(P, q, G, lower, upper, guess, memory, out):
    """Solves one program; ``memory`` is of ``gpmpc.qp._workspace``, ``guess`` a record or empty. Returns a status."""
    n, M = P.shape[0], len(P) + len(G)
    shaped = P.shape[1] == n and len(q) == n and G.shape[1] == n and len(lower) == M and len(upper) == M
    dense = is_dense(q) and is_dense(lower) and is_dense(upper) and is_dense(guess)
    if not (shaped and dense and is_dense_matrix(P) and is_dense_matrix(G) and all_finite(q)):
        return MISUSE
    work, active = open_workspace(P, q, G, memory, out)
    if not work.prepared and not (factorise(P, work.L) and _measure_rows(work)):
        return MISUSE
    longest = zeros()
    for i in range(0, n, 8):
        longest = larger(longest, load_some(q, i) * load(work.scale, i))
    least = NEGLIGIBLE * largest(longest)  # length of x that is none
    if not _read_bounds(work, lower, upper, least):
        return MISUSE
    return _solve_opened(work, active, guess, least)


@inline_njit
def _solve_opened(work, active, guess, least):
    """Solves the program in the workspace."""
    n, M = len(work.x), len(work.mu)
    known = len(guess) > HEADER and guess[VARIABLES] == n and guess[CONSTRAINTS] == M and 0 <= guess[WORKING] <= M
    k, guessed = _start(work, active, guess if known else guess[:0])
    pivots, margin, fine = work.settings[SHARE], _LATER / NEGLIGIBLE * least, _FINE
    iterations, rounds = np.int64(0), 0  # for a literal numba compiles callees anew
    status, passed, moved = NUMERICAL_TROUBLE, False, False
    interrupted = known and guess[STATUS] == ITERATION_LIMIT
    batches = np.int64(_BATCHES if interrupted else 0)  # with single steps only the dual objective cannot fall
    count, near = -1 - guessed, 0.0
    while True:
        if rounds > 0:
            count = list_violated(work, -near)
            if count == 0:
                break
            if fine > _FINEST:  # a small violation is believed of the best x only
                fine, count, moved = _FINEST, 0, True
        if count != 0:
            status, k, iterations, batches, passed_now, violated = iterate(
                work, active, k, count, margin, iterations, batches
            )
            if status != SOLVED:
                break
            moved, passed = moved or violated, passed or passed_now
        for i in range(k):  # bounds of variables hold exactly
            p = abs(active.name[i]) - 1
            if p < n:
                work.y[p] = active.bound[i]
        share = pivots
        for i in range(k):
            share = min(share, 1.0 / (active.factor[i, i] * active.factor[i, i] * active.diagonal[i]))
        share = min(pivots, math.sqrt(share))
        if passed or share < _ILL:
            fine = _FINEST
        worst, size, refined = _refine(work, active, k, least, min(fine, _DOUBT * share))
        moved = moved or refined
        status = SOLVED if worst <= min(work.tolerance, _DOUBT * share) else NUMERICAL_TROUBLE
        rounds += 1
        if (not moved and margin == 0.0) or rounds == _ROUNDS or worst >= _UNDEFINED:
            break
        margin, moved = 0.0, False
        near = worst * size / share if fine > _FINEST else 0.0  # what the error of x may hide
    unsure = passed or rounds == _ROUNDS  # of the violations that are left
    if unsure and status == SOLVED and _worst_violation(work, least) > _NOISE:
        status = NUMERICAL_TROUBLE
    out = work.record
    out[STATUS], out[ITERATIONS], out[WORKING], out[VARIABLES], out[CONSTRAINTS] = status, iterations, k, n, M
    out[TAG], out[AGE] = work.tag if status == SOLVED else 0.0, out[AGE] + iterations
    for i in range(n):
        work.x[i] = work.y[i]
    for i in range(k):
        out[HEADER + n + M + i] = active.name[i]
    if work.prepared:
        at = HEADER + n + 2 * M
        for i in range(k):
            row = active.factor[i]
            for j in range(i + 1):
                out[at + j] = row[j]
            at += i + 1
    return status


@inline_njit
def _start(work, active, guess):
    """Starts from a guess: x_u, soft rows that stay violated, and the working set.

    Returns:
        How many constraints work already, and how many are guessed to, and are candidates.
    """
    n, M = len(work.x), len(work.mu)
    work.record[AGE] = 0.0
    if not work.prepared:
        for i in range(work.capacity + 2):
            active.place[i] = i
    if work.soft and len(guess) > 0:
        for p in range(n, M):
            value, cap = guess[HEADER + n + p], work.cap[p]
            if abs(value) >= cap and abs(work.upper[p] if value > 0.0 else work.lower[p]) < np.inf:
                work.mu[p] = cap if value > 0.0 else -cap
                restore_limits(work, p)
    add_multipliers(work, active, np.int64(0))
    for i in range(n):
        work.v[i] = -work.slope[i]
    if not work.prepared:
        solve_transposed(work.L, n, work.v)
    if len(guess) == 0:
        return np.int64(0), np.int64(0)
    first = HEADER + n + M
    names, known = guess[first : first + int(guess[WORKING])], work.prepared and guess[TAG] == work.tag
    if known and len(guess) == len(work.record) and guess[AGE] < _OLD and are_present(work, names):
        work.record[AGE] = guess[AGE]
        return restore_constraints(work, active, names, guess[first + M :]), np.int64(0)
    return np.int64(0), choose_guess(work, names)


@inline_njit
def _read_bounds(work, lower, upper, least):
    """Copies the bounds, with absent ones infinite, and clears mu; returns False if any are crossed or undefined."""
    wrong = zeros()
    for p in range(0, len(lower), 8):
        low, high = _remove_absent(load_some(lower, p)), _remove_absent(load_some(upper, p))
        wrong = wrong + clip(high - low, -1.0, 0.0)  # infinity less infinity is undefined, and so none of a bound
        negligible = least * load(work.scale, p)
        store(work.lower, p, low)
        store(work.upper, p, high)
        store(work.negligible, p, negligible)
        store(work.allowed_low, p, low - (TOLERATED * larger(zeros(), low) + negligible))
        store(work.allowed_high, p, high + (TOLERATED * larger(zeros(), high) + negligible))
    for p in range(len(lower)):
        work.mu[p] = 0.0
    return not any_nonzero(wrong)


@inline_njit
def _remove_absent(bounds):
    """Returns eight bounds, those that are absent infinite."""
    beyond = bounds - clip(bounds, -_PRESENT, _PRESENT)
    return bounds + (beyond * 1e300) * 1e300


@inline_njit
def _measure_rows(work):
    """Writes lengths in the metric of P's diagonal, and the ends of the rows of G; returns False if not finite."""
    n, G, units, scale, cancelled = len(work.x), work.G, work.scratch, work.scale, 1.0
    for i in range(n):
        scale[i] = units[i] = 1.0 / math.sqrt(work.P[i, i])
        cancelled = max(cancelled, work.L[i, i] * work.L[i, i] * work.P[i, i])
    work.settings[SHARE] = 1.0 / cancelled
    for i in range(n, n + 8):
        units[i] = 0.0
    undefined, end = 0.0, 0
    for p in range(len(G)):
        row, near, far = G[p], zeros(), zeros()
        head, tail, rest = row[:end], row[end:], units[end:]
        for j in range(0, end - 7, 8):
            values = load(head, j) * load(units, j)
            near = near + values * values
        values = load_some(head, end // 8 * 8) * load(units, end // 8 * 8)
        near = near + values * values
        for j in range(0, n - end - 7, 8):
            values = load(tail, j) * load(rest, j)
            far = far + values * values
        values = load_some(tail, (n - end) // 8 * 8) * load(rest, (n - end) // 8 * 8)
        far = far + values * values
        if any_nonzero(far):  # longer than the row before
            end = n
            while end > 0 and row[end - 1] == 0.0:
                end -= 1
            end = round_end(end, n)
        length = math.sqrt(total(near + far))
        undefined += length * 0.0
        scale[n + p], work.end[n + p] = (length if length > 0.0 else 1.0), end
    return undefined == 0.0


@inline_njit
def _refine(work, active, k, least, fine):
    """Corrects x and mu on the working set until their residual is ``fine``, or no longer halves.

    Returns:
        The residual, the length of x that it is a share of, and whether x moved.
    """
    worst, size, best, moved = np.inf, 0.0, np.inf, False
    for attempt in range(_REFINEMENTS + 1):
        add_multipliers(work, active, k)
        worst, size = _measure_residuals(work, active, k, least)
        if worst <= fine or attempt == _REFINEMENTS or not worst < 0.5 * best:
            break
        best, moved = worst, True
        _take_newton_step(work, active, k)
    return worst, size, moved


@inline_njit
def _measure_residuals(work, active, k, least):
    """Returns the residual of stationarity and of the working constraints, as a share of x, and the length of x.

    This length is that in the metric of P, at least ``least``, so that neither the units of the data nor a cost of
    another size hide an error of x. A hundredth of the error is also measured by the largest entry of x, and that of a
    row by its bound or its own terms. ``_UNDEFINED`` where a number that it is made of is not finite: comparisons alone
    would pass over NaN.

    Fills ``gradient = P x + slope`` and ``rest = y_W - b``, where slope = q + C'mu.
    """
    P, y, slope, gradient, n = work.P, work.y, work.slope, work.gradient, len(work.x)
    multiply(P, n, y, n, gradient)
    size = math.sqrt(max(dot(gradient, y, n), least * least, _TINY))
    lengths = shifts = entries = nothing = zeros()
    for i in range(0, n, 8):
        rest = load_some(gradient[:n], i) + load_some(slope[:n], i)
        store(gradient, i, rest)
        length = rest * load(work.scale, i)
        lengths, shifts = larger(lengths, length), larger(shifts, length * load(work.scale, i))
        entries, nothing = larger(entries, load_some(y[:n], i)), nothing + 0.0 * length
    worst, undefined = largest(lengths) / size, total(nothing)
    worst = max(worst, 0.01 * largest(shifts) / max(largest(entries), _TINY))
    for i in range(k):
        p, b = abs(active.name[i]) - 1, active.bound[i]
        work.rest[i] = y[p] - b
        rest, length = abs(work.rest[i]), size * work.scale[p]
        undefined += 0.0 * rest
        if rest > 1e-15 * length:  # then by the row's own terms too
            own = max(abs(b), 1e-6 * length)
            if p >= n and rest > 1e-9 * own:
                row = work.G[p - n]
                for j in range(int(work.end[p])):
                    own = max(own, abs(row[j] * y[j]))
            worst = max(worst, max(rest / length, 1e-2 * rest / own))
    return (worst if worst + undefined + size < np.inf else _UNDEFINED), size


@inline_njit
def _take_newton_step(work, active, k):
    """Takes one Newton step on the working set for the residuals; multipliers stay in range."""
    n, y, change, trial = len(work.x), work.y, work.scratch, work.r
    for i in range(n):
        change[i] = work.gradient[i]
    solve_transposed(work.L, n, change)
    multiply_rows(work.rows, active.place, k, change, n, trial)
    for i in range(k):
        trial[i] = work.rest[i] - trial[i]
    solve_lower(active.factor, k, trial)
    solve_transposed(active.factor, k, trial)
    subtract = work.gradient  # -(change + sum trial_i w_i)
    for i in range(n):
        subtract[i] = -change[i]
    subtract_rows(subtract, work.rows, active.place, trial, k, n)
    solve_lower(work.L, n, subtract)
    for i in range(n):
        y[i] += subtract[i]
    for i in range(k):
        p = abs(active.name[i]) - 1
        work.mu[p] = min(max(work.mu[p] + trial[i], active.least[i]), active.most[i])
    multiply_constraints(work)


@inline_njit
def _worst_violation(work, least):
    """Returns the largest violation beyond what multipliers pay for, as a share of its bound or, a thousandth, of x."""
    y, mu, worst = work.y, work.mu, 0.0
    size = math.sqrt(max(abs(dot(work.slope, y, len(work.x))), least * least))
    for p in range(len(y)):
        if abs(mu[p]) < work.cap[p]:
            above, below = y[p] - work.upper[p], work.lower[p] - y[p]
            bound = work.upper[p] if above > below else work.lower[p]
            rest = max(above, below) - work.negligible[p]
            worst = max(worst, rest / max(1e-3 * size * work.scale[p], abs(bound)))
    return worst
