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
from gpmpc._kernels._simd import (
    any_nonzero,
    clip,
    larger,
    largest,
    load,
    load_some,
    store,
    total,
    zeros,
)
from gpmpc._kernels.linalg import dot, multiply
from gpmpc.qp._dual_iteration import (
    NONE,
    add_multipliers,
    iterate,
    multiply_constraints,
    restore_constraints,
)
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
from gpmpc.qp._triangular import (
    factorise,
    multiply_rows,
    scale,
    solve_lower,
    solve_transposed,
    subtract_rows,
)
from gpmpc.qp._violations import TOLERATED, choose_guess, list_violated, restore_limits
from gpmpc.qp._workspace import (
    ALLOWED_HIGH,
    ALLOWED_LOW,
    BOUND,
    CAP,
    DIAGONAL,
    END,
    GRADIENT,
    LEAST,
    LOWER,
    MOST,
    MU,
    NAME,
    NEGLIGIBLE,
    PLACE,
    REST,
    SCALE,
    SCRATCH,
    SHARE,
    SLOPE,
    UPPER,
    R,
    V,
    Y,
    open_workspace,
)

SIGNATURE = "i8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1])"

_PRESENT = np.nextafter(1e20, 0.0)  # the largest bound that is one
_NOISE = 2e-14  # violation that a constraint which depends on others may be left with: see ``_worst_violation``
_LATER = 1e-11  # violation, as a share of the length of q, that waits for the refined x
_ROUNDS = 10  # returns from the residuals to the iteration
_REFINEMENTS = 3
# residuals at which refinement stops
_FINE = 2e-10
_FINEST = 1e-15
_DOUBT = 3e-7  # times the shares that cancellation left of the pivots: the largest residual of a solution
_ILL = 5e-4  # such a share: what else x violates is seen of the best x only
_OLD = 1000  # changes after which a factor is computed anew
_BATCHES = 4  # see ``iterate``
_TINY = 1e-300
_UNDEFINED = (
    1e300  # a residual that overflowed; less than infinity, so that refinement is tried
)


@compiled(allocates=False, locked=True)
def solve(P, q, G, lower, upper, guess, memory, out):
    """Solves one program; ``memory`` is of ``gpmpc.qp._workspace``, ``guess`` a record or empty. Returns a status."""
    n = P.shape[0]
    M = len(P) + len(G)
    shaped = (
        P.shape[1] == n
        and len(q) == n
        and G.shape[1] == n
        and len(lower) == M
        and len(upper) == M
    )
    dense = _is_dense(q) and _is_dense(lower) and _is_dense(upper) and _is_dense(guess)
    if not (shaped and dense and _is_dense_matrix(P) and _is_dense_matrix(G)):
        return MISUSE
    work = open_workspace(P, q, G, memory)
    if work.tag == 0.0:
        memory[0, SHARE] = _measure_rows(work) if factorise(P, work.L) else 0.0
    share = memory[0, SHARE]
    longest = undefined = zeros()
    for i in range(0, n, 8):
        length = load_some(q, i) * load(work.vectors[SCALE], i)
        longest = larger(longest, length)
        undefined = undefined + 0.0 * length
    least = NONE * largest(longest)  # length of x that is none
    if (
        share == 0.0
        or any_nonzero(undefined)
        or not _read_bounds(work.vectors, lower, upper, least)
    ):
        return MISUSE
    known = (
        len(guess) > HEADER
        and guess[VARIABLES] == n
        and guess[CONSTRAINTS] == M
        and 0 <= guess[WORKING] <= M
    )
    return _solve_opened(work, guess if known else guess[:0], least, share, out)


@inline_njit
def _is_dense(vector):
    """Returns whether a vector is as contiguous as its type claims: an unchecked entry point does not look."""
    return vector.strides[0] == vector.itemsize or len(vector) <= 1


@inline_njit
def _is_dense_matrix(A):
    """Returns whether a matrix is as contiguous as its type claims."""
    rows, columns = A.shape
    return (
        A.strides[0] == columns * A.itemsize and A.strides[1] == A.itemsize
    ) or rows * columns == 0


@inline_njit
def _solve_opened(work, guess, least, pivots, out):
    """Solves the program in the workspace, and writes the record ``out``."""
    vectors = work.vectors
    names = work.indices[NAME]
    factor = work.factor
    n = len(work.q)
    M = n + len(work.G)
    y = vectors[Y]
    mu = vectors[MU]
    k, guessed = _start(work, guess, out)
    margin = _LATER / NONE * least
    fine = _FINE
    # for a literal numba compiles callees anew
    iterations = np.int64(0)
    rounds = 0
    status = NUMERICAL_TROUBLE
    passed = False
    moved = False
    interrupted = len(guess) > 0 and guess[STATUS] == ITERATION_LIMIT
    batches = np.int64(
        _BATCHES if interrupted else 0
    )  # with single steps only the dual objective cannot fall
    count = -1 - guessed
    near = 0.0
    while True:
        if rounds > 0:
            count = list_violated(vectors, work.indices, M, -near)
            if count == 0:
                break
            if fine > _FINEST:  # a small violation is believed of the best x only
                fine = _FINEST
                count = 0
                moved = True
        if count != 0:
            status, k, iterations, batches, passed_now, violated = iterate(
                work, k, count, margin, iterations, batches
            )
            if status != SOLVED:
                break
            moved = moved or violated
            passed = passed or passed_now
        share = pivots
        for i in range(k):
            p = abs(names[i]) - 1
            if p < n:  # bounds of variables hold exactly
                y[p] = vectors[BOUND, i]
            share = min(
                share, 1.0 / (factor[i, i] * factor[i, i] * vectors[DIAGONAL, i])
            )
        share = min(pivots, math.sqrt(share))
        if passed or share < _ILL:
            fine = _FINEST
        worst, size, refined = _refine(work, k, least, min(fine, _DOUBT * share))
        moved = moved or refined
        status = (
            SOLVED
            if worst <= min(work.tolerance, _DOUBT * share)
            else NUMERICAL_TROUBLE
        )
        rounds += 1
        if (not moved and margin == 0.0) or rounds == _ROUNDS or worst >= _UNDEFINED:
            break
        margin = 0.0
        moved = False
        near = (
            worst * size / share if fine > _FINEST else 0.0
        )  # what the error of x may hide
    unsure = passed or rounds == _ROUNDS  # of the violations that are left
    if unsure and status == SOLVED and _worst_violation(work, least) > _NOISE:
        status = NUMERICAL_TROUBLE
    out[STATUS] = status
    out[ITERATIONS] = iterations
    out[WORKING] = k
    out[VARIABLES] = n
    out[CONSTRAINTS] = M
    out[TAG], out[AGE] = work.tag if status == SOLVED else 0.0, out[AGE] + iterations
    scale(1.0, y, out[HEADER:], n)
    scale(1.0, mu, out[HEADER + n :], M)
    for i in range(k):
        out[HEADER + n + M + i] = names[i]
    at = HEADER + n + 2 * M
    for i in range(k if work.tag != 0.0 else 0):
        scale(1.0, factor[i], out[at:], i + 1)
        at += i + 1
    return status


@inline_njit
def _start(work, guess, out):
    """Starts from a guess: x_u, soft rows that stay violated, and the working set.

    Returns:
        How many constraints work already, and how many are guessed to, and are candidates.
    """
    n = len(work.q)
    vectors = work.vectors
    mu = work.vectors[MU]
    M = n + len(work.G)
    out[AGE] = 0.0
    for i in range(n + 1):
        work.indices[PLACE, i] = i
    if work.soft and len(guess) > 0:
        for p in range(n, M):
            value = guess[HEADER + n + p]
            cap = vectors[CAP, p]
            if (
                abs(value) >= cap
                and abs(vectors[UPPER if value > 0.0 else LOWER, p]) < np.inf
            ):
                mu[p] = cap if value > 0.0 else -cap
                restore_limits(vectors, p)
    add_multipliers(work, np.int64(0))
    scale(-1.0, vectors[SLOPE], vectors[V], n)
    if work.tag == 0.0:
        solve_transposed(work.L, n, vectors[V])
    if len(guess) == 0:
        return np.int64(0), np.int64(0)
    first = HEADER + n + M
    names = guess[first : first + int(guess[WORKING])]
    chosen = choose_guess(vectors, work.indices, M, names)
    known = (
        work.tag != 0.0
        and guess[TAG] == work.tag
        and guess[AGE] < _OLD
        and len(guess) == len(out)
    )
    if known and chosen == len(names) and chosen <= n:
        out[AGE] = guess[AGE]
        restore_constraints(work, chosen, guess[first + M :])
        return chosen, np.int64(0)
    return np.int64(0), chosen


@inline_njit
def _read_bounds(vectors, lower, upper, least):
    """Copies the bounds, with absent ones infinite, and clears mu; returns False if any are crossed or undefined."""
    wrong = zeros()
    for p in range(0, len(lower), 8):
        low = _remove_absent(load_some(lower, p))
        high = _remove_absent(load_some(upper, p))
        wrong = wrong + clip(
            high - low, -1.0, 0.0
        )  # infinity less infinity is undefined, and so none of a bound
        negligible = least * load(vectors[SCALE], p)
        store(vectors[LOWER], p, low)
        store(vectors[UPPER], p, high)
        store(vectors[NEGLIGIBLE], p, negligible)
        store(
            vectors[ALLOWED_LOW],
            p,
            low - (TOLERATED * larger(zeros(), low) + negligible),
        )
        store(
            vectors[ALLOWED_HIGH],
            p,
            high + (TOLERATED * larger(zeros(), high) + negligible),
        )
        store(vectors[MU], p, zeros())
    return not any_nonzero(wrong)


@inline_njit
def _remove_absent(bounds):
    """Returns eight bounds, those that are absent infinite."""
    beyond = bounds - clip(bounds, -_PRESENT, _PRESENT)
    return bounds + (beyond * 1e300) * 1e300


@inline_njit
def _measure_rows(work):
    """Writes lengths in the metric of P's diagonal, and the ends of the rows of G.

    Returns what cancellation left of the pivots of P, as a share of P_ii; zero if a length is not finite.
    """
    n = len(work.q)
    G = work.G
    units = work.vectors[SCRATCH]
    ends = work.vectors[END]
    scale_of = work.vectors[SCALE]
    cancelled = 1.0
    undefined = 0.0
    store(units, n // 8 * 8, zeros())
    for i in range(n):
        scale_of[i] = units[i] = 1.0 / math.sqrt(work.P[i, i])
        cancelled = max(cancelled, work.L[i, i] * work.L[i, i] * work.P[i, i])
    for p in range(len(G)):
        row = G[p]
        squares = zeros()
        end = 0
        for j in range(0, n, 8):
            values = load_some(row, j) * load(units, j)
            squares = squares + values * values
            end = j + 8 if any_nonzero(values) else end
        length = math.sqrt(total(squares))
        undefined += length * 0.0
        scale_of[n + p], ends[n + p] = (length if length > 0.0 else 1.0), min(end, n)
    return 1.0 / cancelled if undefined == 0.0 else 0.0


@inline_njit
def _refine(work, k, least, fine):
    """Corrects x and mu on the working set until their residual is ``fine``, or no longer halves.

    Returns:
        The residual, the length of x that it is a share of, and whether x moved.
    """
    worst = np.inf
    size = 0.0
    best = np.inf
    moved = False
    for attempt in range(_REFINEMENTS + 1):
        add_multipliers(work, k)
        worst, size = _measure_residuals(work, k, least)
        if worst <= fine or attempt == _REFINEMENTS or not worst < 0.5 * best:
            break
        best = worst
        moved = True
        _take_newton_step(work, k)
    return worst, size, moved


@inline_njit
def _measure_residuals(work, k, least):
    """Returns the residual of stationarity and of the working constraints, as a share of x, and the length of x.

    This length is that in the metric of P, at least ``least``, so that neither the units of the data nor a cost of
    another size hide an error of x. A hundredth of the error is also measured by the largest entry of x, and that of a
    row by its bound or its own terms. ``_UNDEFINED`` where a number that it is made of is not finite: comparisons alone
    would pass over NaN.

    Fills ``GRADIENT = P x + slope`` and ``REST = y_W - b``, where slope = q + C'mu.
    """
    vectors = work.vectors
    n = len(work.q)
    y = work.vectors[Y]
    scale = work.vectors[SCALE]
    gradient = work.vectors[GRADIENT]
    multiply(work.P, n, y, n, gradient)
    size = math.sqrt(max(dot(gradient, y, n), least * least, _TINY))
    lengths = shifts = entries = nothing = zeros()
    for i in range(0, n, 8):
        rest = load_some(gradient[:n], i) + load_some(vectors[SLOPE][:n], i)
        store(gradient, i, rest)
        length = rest * load(scale, i)
        lengths = larger(lengths, length)
        shifts = larger(shifts, length * load(scale, i))
        entries = larger(entries, load_some(y[:n], i))
        nothing = nothing + 0.0 * length
    worst = largest(lengths) / size
    undefined = total(nothing)
    worst = max(worst, 0.01 * largest(shifts) / max(largest(entries), _TINY))
    for i in range(k):
        p = abs(work.indices[NAME, i]) - 1
        b = vectors[BOUND, i]
        vectors[REST, i] = y[p] - b
        rest = abs(y[p] - b)
        length = size * scale[p]
        undefined += 0.0 * rest
        if rest > 1e-15 * length:  # then by the row's own terms too
            own = max(abs(b), 1e-6 * length)
            if p >= n and rest > 1e-9 * own:
                row = work.G[p - n]
                for j in range(int(vectors[END, p])):
                    own = max(own, abs(row[j] * y[j]))
            worst = max(worst, max(rest / length, 1e-2 * rest / own))
    return (worst if worst + undefined + size < np.inf else _UNDEFINED), size


@inline_njit
def _take_newton_step(work, k):
    """Takes one Newton step on the working set for the residuals; multipliers stay in range."""
    vectors = work.vectors
    places = work.indices[PLACE]
    n = len(work.q)
    y = vectors[Y]
    change = vectors[SCRATCH]
    trial = vectors[R]
    subtract = vectors[GRADIENT]
    scale(1.0, subtract, change, n)
    solve_transposed(work.L, n, change)
    multiply_rows(work.rows, places, k, change, n, trial)
    for i in range(0, k, 8):
        store(trial, i, load(vectors[REST], i) - load(trial, i))
    solve_lower(work.factor, k, trial)
    solve_transposed(work.factor, k, trial)
    scale(-1.0, change, subtract, n)  # -(change + sum trial_i w_i)
    subtract_rows(subtract, work.rows, places, trial, k, n)
    solve_lower(work.L, n, subtract)
    for i in range(0, n, 8):
        store(y, i, load(y, i) + load(subtract, i))
    for i in range(k):
        p = abs(work.indices[NAME, i]) - 1
        vectors[MU, p] = min(
            max(vectors[MU, p] + trial[i], vectors[LEAST, i]), vectors[MOST, i]
        )
    multiply_constraints(work)


@inline_njit
def _worst_violation(work, least):
    """Returns the largest violation beyond what multipliers pay for, as a share of its bound or, a thousandth, of x."""
    vectors = work.vectors
    y = work.vectors[Y]
    worst = 0.0
    size = math.sqrt(max(abs(dot(vectors[SLOPE], y, len(work.q))), least * least))
    for p in range(len(work.q) + len(work.G)):
        if abs(vectors[MU, p]) < vectors[CAP, p]:
            above = y[p] - vectors[UPPER, p]
            below = vectors[LOWER, p] - y[p]
            bound = vectors[UPPER, p] if above > below else vectors[LOWER, p]
            rest = max(above, below) - vectors[NEGLIGIBLE, p]
            worst = max(worst, rest / max(1e-3 * size * vectors[SCALE, p], abs(bound)))
    return worst
