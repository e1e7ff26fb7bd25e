"""The compiled entry point of the dual active set: a warm-started, judged solve.

``solve`` minimises ``1/2 x'Px + q'x`` subject to ``lower <= [x; Gx] <= upper`` from a
guessed working set and writes a record (``gpmpc.qp._record``). The guess is corrected
until its multipliers have the right signs, then by the dual iteration
(``gpmpc.qp._dual_iteration``). Nothing is believed without its residuals: x is refined
on its working set (``gpmpc.qp._refinement``), and handed back to the iteration while a
bound is violated.
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
from gpmpc.qp._dual_iteration import (
    BATCHES,
    NONE,
    UNLISTED,
    add_multipliers,
    iterate,
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
from gpmpc.qp._refinement import UNDEFINED, refine, worst_violation
from gpmpc.qp._triangular import factorise, scale, solve_transposed
from gpmpc.qp._violations import (
    TOLERATED,
    choose_guessed,
    list_violated,
    restore_limits,
)
from gpmpc.qp._working_set import constraint_in, restore_working_set
from gpmpc.qp._workspace_type import open_workspace

_VECTOR = "f8[::1]"
_MATRIX = "f8[:, ::1]"
SIGNATURE = (
    f"i8({_MATRIX}, {_VECTOR}, {_MATRIX}, {_VECTOR}, {_VECTOR}, "
    f"{_VECTOR}, {_MATRIX}, {_VECTOR})"
)

_PRESENT = np.nextafter(1e20, 0.0)  # the largest bound that is one
# A constraint that depends on others may be left with this violation: see
# ``worst_violation``.
_NOISE = 2e-14
# A violation up to this share of the length of q waits for the refined x.
_LATER = 1e-11
_ROUNDS = 10  # returns from the residuals to the iteration
# Residuals at which refinement stops: at first, and where x is to be as good as can be.
_FINE = 2e-10
_FINEST = 1e-15
# The largest residual of a solution is this multiple of the share that cancellation
# left of the pivots; with a smaller share than the second, violations are seen of the
# best x only.
_DOUBT = 3e-7
_ILL = 5e-4
_OLD = 1000  # changes after which a factor is computed anew


@compiled(allocates=False, locked=True)
def solve(P, q, G, lower, upper, guess, memory, out):
    """Solves one program and returns the status.

    Args:
        P: (n, n) symmetric positive definite.
        q: (n,).
        G: (m, n).
        lower: (n + m,) lower bounds of x, then of the rows of G.
        upper: (n + m,) upper bounds likewise.
        guess: The record of a similar program, or empty.
        memory: See ``gpmpc.qp._workspace.new_memory``.
        out: The record to be written.
    """
    n = len(P)
    M = n + len(G)
    shapes_match = (
        P.shape[1] == n
        and len(q) == n
        and G.shape[1] == n
        and len(lower) == M
        and len(upper) == M
    )
    dense = _is_dense(q) and _is_dense(lower) and _is_dense(upper) and _is_dense(guess)
    if not (shapes_match and dense and _is_dense_matrix(P) and _is_dense_matrix(G)):
        return MISUSE
    work = open_workspace(P, q, G, memory)
    if work.tag == 0.0:
        work.pivot_share = _measure_rows(work) if factorise(P, work.L) else 0.0
    least = NONE * _length_of_slope(work)  # length of an x that is none
    if work.pivot_share == 0.0 or not least < np.inf:
        return MISUSE
    if not _read_bounds(work, lower, upper, least):
        return MISUSE
    if not _is_record_of(guess, n, M):
        guess = guess[:0]
    return _solve_opened(work, guess, least, out)


@inline_njit
def _is_dense(vector):
    """Returns whether a vector is contiguous.

    An unchecked entry point does not look.
    """
    return vector.strides[0] == vector.itemsize or len(vector) <= 1


@inline_njit
def _is_dense_matrix(A):
    """Returns whether a matrix is contiguous."""
    rows, columns = A.shape
    dense = A.strides[0] == columns * A.itemsize and A.strides[1] == A.itemsize
    return dense or rows * columns == 0


@inline_njit
def _is_record_of(record, n, M):
    """Returns whether a record is that of a program of this size."""
    return (
        len(record) > HEADER
        and record[VARIABLES] == n
        and record[CONSTRAINTS] == M
        and 0 <= record[WORKING] <= M
    )


@inline_njit
def _measure_rows(work):
    """Writes norms in the metric of P's diagonal, and the ends of the rows of G.

    Returns what cancellation left of the pivots of P, as a share of P_ii; zero if a
    norm is not finite.
    """
    n = work.n
    units = work.scratch
    cancelled = 1.0
    undefined = 0.0
    store(units, n // 8 * 8, zeros())
    for i in range(n):
        units[i] = 1.0 / math.sqrt(work.P[i, i])
        work.norm[i] = units[i]
        cancelled = max(cancelled, work.L[i, i] * work.L[i, i] * work.P[i, i])
    for i in range(work.m):
        row = work.G[i]
        squares = zeros()
        end = 0
        for j in range(0, n, 8):
            values = load_some(row, j) * load(units, j)
            squares = squares + values * values
            if any_nonzero(values):
                end = j + 8
        norm = math.sqrt(total(squares))
        undefined += norm * 0.0
        work.norm[n + i] = norm if norm > 0.0 else 1.0
        work.end[n + i] = min(end, n)
    return 1.0 / cancelled if undefined == 0.0 else 0.0


@inline_njit
def _length_of_slope(work):
    """Returns the largest entry of q in the metric of P's diagonal.

    Infinite if one is not finite.
    """
    longest = zeros()
    undefined = zeros()
    for j in range(0, work.n, 8):
        length = load_some(work.q, j) * load(work.norm, j)
        longest = larger(longest, length)
        undefined = undefined + 0.0 * length
    return np.inf if any_nonzero(undefined) else largest(longest)


@inline_njit
def _read_bounds(work, lower, upper, least):
    """Copies the bounds, with absent ones infinite, and clears the multipliers.

    Returns False if any are crossed or undefined.
    """
    wrong = zeros()
    for p in range(0, len(lower), 8):
        low = _remove_absent(load_some(lower, p))
        high = _remove_absent(load_some(upper, p))
        # infinity less infinity is undefined, and so none of a bound
        wrong = wrong + clip(high - low, -1.0, 0.0)
        negligible = least * load(work.norm, p)
        below = TOLERATED * larger(zeros(), low) + negligible
        above = TOLERATED * larger(zeros(), high) + negligible
        store(work.lower, p, low)
        store(work.upper, p, high)
        store(work.negligible, p, negligible)
        store(work.allowed_low, p, low - below)
        store(work.allowed_high, p, high + above)
        store(work.multiplier, p, zeros())
    return not any_nonzero(wrong)


@inline_njit
def _remove_absent(bounds):
    """Returns eight bounds, those that are absent infinite."""
    beyond = bounds - clip(bounds, -_PRESENT, _PRESENT)
    return bounds + (beyond * 1e300) * 1e300


@inline_njit
def _solve_opened(work, guess, least, out):
    """Solves the program in the workspace, and writes the record ``out``."""
    k, guessed, age = _start(work, guess, len(out))
    # only single steps let the dual objective rise for sure
    interrupted = len(guess) > 0 and guess[STATUS] == ITERATION_LIMIT
    batches = BATCHES if interrupted else 0
    iterations = 0
    margin = _LATER / NONE * least
    tolerance = _FINE
    passed_over = False
    changed = False  # whether x or the working set did, since violations were listed
    rounds = 0
    status = NUMERICAL_TROUBLE
    count = UNLISTED
    while True:
        if count != 0:
            progress = iterate(work, k, count, guessed, margin, iterations, batches)
            k = progress.size
            iterations = progress.iterations
            batches = progress.batches
            changed = changed or progress.violated
            passed_over = passed_over or progress.passed_over
            status = progress.status
            if status != SOLVED:
                break
        _put_on_bounds(work, k)
        share = min(work.pivot_share, math.sqrt(_least_pivot_share(work, k)))
        if passed_over or share < _ILL:
            tolerance = _FINEST
        refined = refine(work, k, least, min(tolerance, _DOUBT * share))
        accurate = refined.residual <= min(work.tolerance, _DOUBT * share)
        status = SOLVED if accurate else NUMERICAL_TROUBLE
        changed = changed or refined.moved
        rounds += 1
        settled = not changed and margin == 0.0
        if settled or rounds == _ROUNDS or refined.residual >= UNDEFINED:
            break
        margin = 0.0
        changed = False
        error = (
            refined.residual * refined.length / share
        )  # of x, which hides violations
        count = list_violated(work, -error if tolerance > _FINEST else -0.0)
        if count == 0:
            break
        if tolerance > _FINEST:  # a small violation is believed of the best x only
            tolerance = _FINEST
            count = 0
            changed = True
    unsure = passed_over or rounds == _ROUNDS  # of the violations that are left
    if unsure and status == SOLVED and worst_violation(work, least) > _NOISE:
        status = NUMERICAL_TROUBLE
    _write_record(work, k, status, iterations, age + iterations, out)
    return status


@inline_njit
def _start(work, guess, record_size):
    """Starts from a guess: soft rows that stay violated, and the working set.

    Returns the size of the working set, how many candidates are guessed to belong to
    it, too, and the age of its factor.
    """
    n = work.n
    M = work.M
    for i in range(n + 1):
        work.place[i] = i
    if work.soft != 0.0 and len(guess) > 0:
        _start_at_caps(work, guess)
    # for a literal number numba would compile the function once more
    add_multipliers(work, np.int64(0))
    scale(-1.0, work.slope, work.free_rhs, n)
    if work.tag == 0.0:
        solve_transposed(work.L, n, work.free_rhs)
    k = 0
    candidates = 0
    age = 0.0
    if len(guess) > 0:
        first_label = HEADER + n + M
        labels = guess[first_label : first_label + int(guess[WORKING])]
        candidates = choose_guessed(work, labels)
        factor_is_known = (
            work.tag != 0.0
            and guess[TAG] == work.tag
            and guess[AGE] < _OLD
            and len(guess) == record_size
        )
        if factor_is_known and candidates == len(labels) and candidates <= n:
            restore_working_set(work, candidates, guess[first_label + M :])
            k = candidates
            candidates = 0
            age = guess[AGE]
    return k, candidates, age


@inline_njit
def _start_at_caps(work, guess):
    """Leaves the soft rows violated whose guessed multipliers are at their caps."""
    for p in range(work.n, work.M):
        multiplier = guess[HEADER + work.n + p]
        cap = work.cap[p]
        bound = work.upper[p] if multiplier > 0.0 else work.lower[p]
        if abs(multiplier) >= cap and abs(bound) < np.inf:
            work.multiplier[p] = cap if multiplier > 0.0 else -cap
            restore_limits(work, p)


@inline_njit
def _put_on_bounds(work, k):
    """Makes working bounds of variables hold exactly."""
    for i in range(k):
        p = constraint_in(work, i)
        if p < work.n:
            work.value[p] = work.bound[i]


@inline_njit
def _least_pivot_share(work, k):
    """Returns what cancellation left of the smallest pivot of K_WW, as a share of K_pp.

    It is no larger than that of P.
    """
    share = work.pivot_share
    for i in range(k):
        reciprocal = work.factor[i, i]
        share = min(share, 1.0 / (reciprocal * reciprocal * work.diagonal[i]))
    return share


@inline_njit
def _write_record(work, k, status, iterations, age, out):
    """Writes the result; of a prepared program with the factor of its working set."""
    n = work.n
    M = work.M
    out[STATUS] = status
    out[ITERATIONS] = iterations
    out[WORKING] = k
    out[VARIABLES] = n
    out[CONSTRAINTS] = M
    out[TAG] = work.tag if status == SOLVED else 0.0
    out[AGE] = age
    scale(1.0, work.value, out[HEADER:], n)
    scale(1.0, work.multiplier, out[HEADER + n :], M)
    for i in range(k):
        out[HEADER + n + M + i] = work.label[i]
    if work.tag != 0.0:
        start = HEADER + n + 2 * M
        for i in range(k):
            scale(1.0, work.factor[i], out[start:], i + 1)
            start += i + 1
