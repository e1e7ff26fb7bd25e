"""The compiled entry point of the dual active set: a warm-started, judged solve.

``solve_kernel`` minimises ``1/2 x'Px + q'x`` subject to
``lower <= [x; Gx] <= upper`` from a guessed working set and writes a record
(``gpmpc.qp._record``). The guess is corrected
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
    larger_magnitude,
    largest,
    load,
    load_some,
    store,
    total,
    zeros,
)
from gpmpc.qp._dual_iteration import (
    BATCHES,
    add_multipliers,
    iterate,
)
from gpmpc.qp._problem import ABSENT
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
    watch,
)
from gpmpc.qp._working_set import constraint_in, is_prepared, restore_working_set
from gpmpc.qp._workspace_type import open_workspace

_VECTOR = "f8[::1]"
_MATRIX = "f8[:, ::1]"
SIGNATURE = (
    f"i8({_MATRIX}, {_VECTOR}, {_MATRIX}, {_VECTOR}, {_VECTOR}, "
    f"{_VECTOR}, {_MATRIX}, {_VECTOR})"
)

# An x shorter than this share of the length of q counts as zero, and so does a
# violation of a bound of zero by as little: see ``negligible_length`` and
# ``negligible`` in ``gpmpc.qp._workspace``.
NEGLIGIBLE = 1e-26
_LARGEST_BOUND = np.nextafter(ABSENT, 0.0)  # the last float below ``ABSENT``
# A constraint that depends on others may be left with this violation: see
# ``worst_violation``.
_TOLERATED_IF_DEPENDENT = 2e-14
# A violation up to this share of the length of q waits for the refined x.
_FIRST_MARGIN = 1e-11
_ROUNDS = 10  # returns from the residuals to the iteration
# Residuals at which refinement stops: at first, and where x is to be as good as can be.
_FINE = 2e-10
_FINEST = 1e-15
# The largest residual of a solution, as a multiple of the share that cancellation left
# of the pivots.
_RESIDUAL_PER_PIVOT_SHARE = 3e-7
# With a smaller share of the pivots x is to be as good as can be from the first round.
_ILL_CONDITIONED_SHARE = 5e-4
_REFACTORISE_AFTER = 1000  # changes of the working set


@compiled(allocates=False, locked=True)
def solve_kernel(P, q, G, lower, upper, guess, memory, out):
    """Solves one program and returns the status.

    The memory of a prepared program holds the factor of its P already, and is not to be
    used with another P or G; that of others has P factorised at each solve.

    It returns ``MISUSE``, and writes no record, where shapes do not match, arrays are
    not contiguous, bounds are crossed or numbers overflow.

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
    if not is_prepared(work):
        work.pivot_share = _measure_rows(work) if factorise(P, work.L) else 0.0
    work.length_of_q = _length_of_q(work)
    work.negligible_length = NEGLIGIBLE * work.length_of_q
    if work.pivot_share == 0.0 or not work.length_of_q < np.inf:
        return MISUSE
    if not _read_bounds(work, lower, upper):
        return MISUSE
    if not _is_record_of(guess, n, M):
        guess = guess[:0]
    return _solve_opened(work, guess, out)


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
        len(record) >= HEADER + n + 2 * M
        and record[VARIABLES] == n
        and record[CONSTRAINTS] == M
        and 0 <= record[WORKING] <= M
    )


@inline_njit
def _measure_rows(work):
    """Writes the norms, and where the rows of G end.

    The norm of c_p is the length of the vector of c_pj / sqrt(P_jj), or its largest
    entry where the squares are too small for a float; one for a row of zeros.

    Returns what cancellation left of the pivots of P, as a share of P_ii; zero if a
    norm is not finite.
    """
    n = work.n
    units = work.scratch
    cancelled = 1.0  # the largest P_ii over its pivot, which is 1 / L_ii^2
    undefined = 0.0
    store(units, n // 8 * 8, zeros())
    for i in range(n):
        units[i] = 1.0 / math.sqrt(work.P[i, i])
        work.norm[i] = units[i]
        cancelled = max(cancelled, work.L[i, i] * work.L[i, i] * work.P[i, i])
    for i in range(work.m):
        row = work.G[i]
        squares = zeros()
        entries = zeros()
        row_end = 0
        for j in range(0, n, 8):
            values = load_some(row, j) * load(units, j)
            squares = squares + values * values
            entries = larger_magnitude(entries, values)
            if any_nonzero(values):
                row_end = j + 8
        norm = math.sqrt(total(squares))
        if norm == 0.0:
            norm = largest(entries)
        undefined += norm * 0.0
        work.norm[n + i] = norm if norm > 0.0 else 1.0
        work.row_end[n + i] = min(row_end, n)
    return 1.0 / cancelled if undefined == 0.0 else 0.0


@inline_njit
def _length_of_q(work):
    """Returns the largest |q_j| / sqrt(P_jj); infinity if one is not finite."""
    longest = zeros()
    undefined = zeros()
    for j in range(0, work.n, 8):
        length = load_some(work.q, j) * load(work.norm, j)
        longest = larger_magnitude(longest, length)
        undefined = undefined + 0.0 * length
    return np.inf if any_nonzero(undefined) else largest(longest)


@inline_njit
def _read_bounds(work, lower, upper):
    """Copies the bounds, with absent ones infinite, and clears the multipliers.

    Returns False if any are crossed or undefined.
    """
    wrong = zeros()
    for p in range(0, len(lower), 8):
        low = _remove_absent(load_some(lower, p))
        high = _remove_absent(load_some(upper, p))
        # both infinite with one sign: NaN, which counts as wrong
        wrong = wrong + clip(high - low, -1.0, 0.0)
        negligible = work.negligible_length * load(work.norm, p)
        below = TOLERATED * larger_magnitude(zeros(), low) + negligible
        above = TOLERATED * larger_magnitude(zeros(), high) + negligible
        store(work.lower, p, low)
        store(work.upper, p, high)
        store(work.negligible, p, negligible)
        store(work.allowed_low, p, low - below)
        store(work.allowed_high, p, high + above)
        store(work.multiplier, p, zeros())
    return not any_nonzero(wrong)


@inline_njit
def _remove_absent(bounds):
    """Returns eight bounds, those that are absent infinite.

    Without a branch: what lies beyond the largest bound, zero or at least 16384 (the
    spacing of floats there), is multiplied until it overflows, for which one factor of
    1e300 is too small.
    """
    beyond = bounds - clip(bounds, -_LARGEST_BOUND, _LARGEST_BOUND)
    return bounds + (beyond * 1e300) * 1e300


@inline_njit
def _solve_opened(work, guess, out):
    """Solves the program in the workspace, and writes the record ``out``.

    A round iterates, refines x on its working set, and looks for violations that are
    left. The rounds end when the refined x has none.
    """
    # start from the guess
    k, guessed, age = _start(work, guess, len(out))
    iterations = 0
    batches_left = BATCHES
    if len(guess) > 0 and guess[STATUS] == ITERATION_LIMIT:
        batches_left = 0  # only single steps let the dual objective rise for sure

    fine = min(_FINE, work.tolerance)
    margin = _FIRST_MARGIN * work.length_of_q  # small violations wait for the refined x
    first_round = True
    must_iterate = True  # else a round refines x only
    rounds = 0
    count = 0  # of the listed violated constraints
    finest = False  # whether x is to be as good as can be
    passed_over = False
    status = NUMERICAL_TROUBLE
    while True:
        # iterate until no constraint is violated by more than the margin
        if must_iterate:
            progress = iterate(
                work, k, first_round, guessed, count, margin, iterations, batches_left
            )
            k = progress.size
            iterations = progress.iterations
            batches_left = progress.batches_left
            passed_over = passed_over or progress.passed_over
            status = progress.status
            if status != SOLVED:
                break
        first_round = False

        # refine x, as good as can be where that is in doubt, and judge it. Written out:
        # a function that returns all this costs 9 s of compilation
        _put_on_bounds(work, k)
        # an error of mu is magnified by K_WW = W W', but reaches x through W' alone: by
        # the root of that
        pivot_share = min(work.pivot_share, math.sqrt(_least_pivot_share(work, k)))
        finest = finest or passed_over or pivot_share < _ILL_CONDITIONED_SHARE
        largest_residual = _RESIDUAL_PER_PIVOT_SHARE * pivot_share
        refined = refine(work, k, min(_FINEST if finest else fine, largest_residual))
        accurate = refined.residual <= min(work.tolerance, largest_residual)
        status = SOLVED if accurate else NUMERICAL_TROUBLE
        rounds += 1
        if rounds == _ROUNDS or refined.residual >= UNDEFINED:
            break
        margin = 0.0

        # list what the refined x violates. Before x is as good as can be its error may
        # hide a violation: rows that hold by less than the error are listed, too
        error = refined.residual * refined.length / pivot_share
        count = list_violated(work, 0.0 if finest else -error)
        if count == 0:
            break
        # violations of an x that is not as good as can be are not believed yet: the
        # next round only refines it
        refines_once_more = not finest
        must_iterate = not refines_once_more
        finest = True
    unsure = passed_over or rounds == _ROUNDS  # of the violations that are left
    if unsure and status == SOLVED and worst_violation(work) > _TOLERATED_IF_DEPENDENT:
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
    scale(-1.0, work.slope, work.free_rhs, n)  # which is all if prepared
    if not is_prepared(work):
        solve_transposed(work.L, n, work.free_rhs)
    k = 0
    candidates = 0
    age = 0.0
    if len(guess) > 0:
        first_label = HEADER + n + M
        labels = guess[first_label : first_label + int(guess[WORKING])]
        candidates = choose_guessed(work, labels)
        factor_is_known = (
            is_prepared(work)
            and guess[TAG] == work.tag
            and guess[AGE] < _REFACTORISE_AFTER
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
            watch(work, p)


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
    smallest = work.pivot_share
    for i in range(k):
        reciprocal = work.factor[i, i]
        smallest = min(smallest, 1.0 / (reciprocal * reciprocal * work.diagonal[i]))
    return smallest


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
    if is_prepared(work):
        start = HEADER + n + 2 * M
        for i in range(k):
            scale(1.0, work.factor[i], out[start:], i + 1)
            start += i + 1
