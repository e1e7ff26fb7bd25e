"""The two compiled entry points of the dual active set: Gram mode and lazy mode.

Both solve ``min 1/2 x'Px + q'x`` subject to ``lower <= [x; Gx] <= upper`` from a guessed working set and write a record
(``gpmpc.qp.record``). *Gram mode* is for P and G that stay: K = C P^-1 C' is known, and a solve only reads rows of it.
*Lazy mode* is for P and G that change: it factors P and makes the rows that it needs.

The guess is corrected in a few sweeps that take all badly violated constraints at once, then by the dual iteration, one
at a time. Nothing is believed without its residuals: the result is computed anew from P, q and G, refined on its
working set by Newton's method (one step is exact but for rounding), and handed back to the iteration while a bound is
violated.
"""

import math

import numpy as np

from gpmpc.compiled import borrowing, woven
from gpmpc.qp import record, workspace
from gpmpc.qp.cholesky import factorise
from gpmpc.qp.dual_iteration import (
    CONTRADICTION,
    keep_violated,
    list_violated,
    most_violated,
    step_to,
    write_ray,
)
from gpmpc.qp.evaluation import (
    UNDEFINED,
    add_pull,
    evaluate,
    follow,
    follow_lazily,
    follow_listed,
    refine,
    residuals,
    row_values,
    worst_violation,
)
from gpmpc.qp.factor import multiply_at, pack, unpack
from gpmpc.qp.hessian import solve_transposed
from gpmpc.qp.lanes import (
    bounded,
    lanes,
    larger,
    largest,
    less,
    negative,
    no_lanes,
    plus,
    put,
    scaled,
    some_lanes,
)
from gpmpc.qp.working_set import (
    BOUND,
    CAP,
    FLOOR,
    HIGH_WATCH,
    LISTED,
    LOW_WATCH,
    LOWER,
    NAME,
    PLACE,
    SCALE,
    SCRATCH,
    SOFTNESS,
    TOLERATED,
    UPPER,
    admit,
    choose_guess,
    choose_violated,
    clip_multipliers,
    ignore,
    measure,
    settle,
    smallest_share,
    take,
    watch,
)
from gpmpc.qp.workspace import all_finite, carve, is_dense, is_dense_matrix, matrix, most_working, padded

STATUS, ITERATIONS, VARIABLES, CONSTRAINTS = record.STATUS, record.ITERATIONS, record.VARIABLES, record.CONSTRAINTS
WORKING, TAG, AGE, HEADER = record.WORKING, record.TAG, record.AGE, record.HEADER
SOLVED, INFEASIBLE, ITERATION_LIMIT = record.SOLVED, record.INFEASIBLE, record.ITERATION_LIMIT
NUMERICAL_TROUBLE, MISUSE, NO_TAG = record.NUMERICAL_TROUBLE, record.MISUSE, record.NO_TAG

GRAM_SIGNATURE = "i8(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1])"
LAZY_SIGNATURE = "i8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1])"

ABSENT = 1e20  # a bound of this size or more is none
NEGLIGIBLE = 1e-26  # share of the length of q below which x, and a violation of a bound of zero, is none
NOISE = 2e-14  # violation that a constraint which depends on others may be left with: see ``worst_violation``
HOPELESS = 1e-7  # violation of such a constraint that is taken for a contradiction
SWEEPS = 4  # times that all badly violated constraints are taken at once
SWEPT = 0.5  # those violated by more than this share of the worst
LATER = 1e-11  # violation, as a share of the length of q, that waits for the refined x
ROUNDS = 10  # returns from the residuals to the iteration
REFINEMENTS = 3
FINE, FINEST = 2e-10, 1e-15  # residuals at which refinement stops
DOUBT = 3e-7  # times the shares that cancellation left of the pivots: the largest residual of a solution
ILL = 5e-4  # such a share: what else x violates is seen of the best x only
OLD = 1000  # changes after which a factor is computed anew


@woven
def read_bounds(lower, upper, scales, least, bounds):
    """Copies the bounds, with absent ones infinite; True if any are crossed or undefined."""
    crossed = no_lanes()
    for p in range(0, len(lower), 8):
        low, high = some_lanes(lower, p), some_lanes(upper, p)
        low, high = bounded(low, ABSENT, np.inf), bounded(high, ABSENT, np.inf)
        crossed = plus(crossed, 1.0, negative(less(high, 1.0, low)))
        floor = scaled(least, lanes(scales, p))
        put(bounds[LOWER], p, low)
        put(bounds[UPPER], p, high)
        put(bounds[FLOOR], p, floor)
        put(bounds[LOW_WATCH], p, less(less(low, TOLERATED, larger(no_lanes(), low)), 1.0, floor))
        put(bounds[HIGH_WATCH], p, plus(plus(high, TOLERATED, larger(no_lanes(), high)), 1.0, floor))
    return largest(crossed) > 0.0


@woven
def keep_capped(n, warm, traits, bounds, mu):
    """Starts with the guess's multipliers that are at their caps: soft rows that stay violated."""
    for p in range(n, len(mu)):
        value, cap = warm[HEADER + n + p], traits[CAP, p]
        if abs(value) >= cap and abs(bounds[UPPER if value > 0.0 else LOWER, p]) < np.inf:
            mu[p] = cap if value > 0.0 else -cap
            watch(p, mu, bounds)


@woven
def count_above(values, threshold, listed, count):
    """How many of the listed values are above the threshold."""
    above = 0
    for i in range(count):
        above += values[listed[i]] > threshold
    return above


@woven
def all_present(names, bounds, mu):
    """Whether every one of the named bounds is there to be held (it may have become absent since)."""
    for name in names:
        if not 1.0 <= abs(name) <= len(mu):
            return False
        p = int(abs(name)) - 1
        if mu[p] != 0.0 or abs(bounds[UPPER if name > 0.0 else LOWER, p]) == np.inf:
            return False
    return True


@borrowing  # woven into ``optimise`` it would cost the solves that need no step a twentieth of a microsecond
def climb(
    lazy, n, q, inverse, pull, v, rows, L, G, traits, bounds, mu, slots, members, R, scratch, y, now, seen, excess,
    gradient, slope, k, capacity, soft, limit, iterations, sweeps, count, margin, least,
):  # fmt: skip
    """Changes the working set until none of the constraints is violated; ``count`` are, and listed.

    Returns:
        ``SOLVED``, ``INFEASIBLE`` or ``ITERATION_LIMIT``, the size of the working set, iterations and sweeps so far,
        and whether a constraint was passed over because it contradicts others by what may be rounding.
    """
    candidates, listed, fresh, passed = members[SCRATCH], members[LISTED], True, False
    for p in range(len(mu)):
        seen[p] = mu[p]
    while count > 0:
        if iterations >= limit:
            return ITERATION_LIMIT, k, iterations, sweeps, passed
        p = most_violated(excess, listed, count)
        value, several = y[p] if fresh else now[p], False
        if fresh and sweeps < SWEEPS and count_above(excess, SWEPT * excess[p], listed, count) > 1:
            sweeps += 1
            before = k
            chosen = choose_violated(SWEPT * excess[p], capacity - k, y, excess, listed, count, bounds, mu, candidates)
            k = take(
                lazy, candidates, chosen, k, n, pull, v, rows, L, G, traits, bounds, mu, slots, members, R, scratch[1]
            )
            several = k > before
            iterations += k - before
            k = settle(k, bounds, mu, slots, members, R, scratch)
        if not several:
            before_step = mu[p]
            outcome, k, changes = step_to(
                lazy, p, value, k, capacity, n, pull, v, rows, L, G, traits, bounds, mu, slots, members, R, scratch
            )
            iterations += changes
            if outcome == CONTRADICTION:
                if excess[p] * traits[SCALE, p] > HOPELESS * max(abs(value), least / NEGLIGIBLE * traits[SCALE, p]):
                    write_ray(p, value > bounds[UPPER, p], k, bounds, members, scratch[2], mu)
                    return INFEASIBLE, k, iterations, sweeps, passed
                mu[p], passed = before_step, True  # what it gained on the way belongs to no working set
                ignore(p, bounds)
                if not soft:  # else refinement has to do
                    k = settle(k, bounds, mu, slots, members, R, scratch)
            if soft:
                sweeps = SWEEPS  # caps may have changed what ``pull`` says
        fresh = several or soft or count == 1 or iterations >= limit
        if not fresh:  # first satisfy those that were seen to be violated, then look at all
            follow_listed(lazy, n, v, rows, L, G, mu, k, members, traits, seen, gradient, y, listed, count, now)
            count = keep_violated(now, margin, traits[SCALE], bounds, excess, listed, count)
            fresh = count == 0
        if fresh:
            if not lazy:
                follow(rows, mu, seen, candidates, gradient, y)
            elif soft:
                evaluate(lazy, n, q, inverse, L, G, mu, k, members, traits, soft, slope, y)
            else:
                follow_lazily(n, v, rows, L, mu, k, members, gradient, y)
                row_values(lazy, L, G, n, traits, y)
            count = list_violated(y, margin, traits[SCALE], bounds, excess, listed)
    clip_multipliers(k, mu, slots, members)  # which rounding can take out of their ranges
    return SOLVED, k, iterations, sweeps, passed


@woven
def optimise(lazy, P, inverse, linear, G, n, rows, L, traits, vectors, members, R, lower, upper, warm, settings, out):
    """Both modes after their set-up; ``rows`` is K and L is G' in Gram mode, which knows P's inverse."""
    M = len(lower)
    limit, tolerance = int(settings[workspace.LIMIT]), settings[workspace.TOLERANCE]
    soft = settings[workspace.SOFT] != 0.0
    capacity = most_working(n, M, soft)
    bounds, slots, scratch, y = vectors[:5], vectors[5:10], vectors[10:14], vectors[14, :M]
    seen, excess, gradient, active = vectors[15], vectors[16], vectors[17], vectors[18]
    v, slope, pulled, now, q = vectors[19], vectors[20], vectors[21], vectors[22], vectors[23]
    x, mu = out[HEADER : HEADER + n], out[HEADER + n : HEADER + n + M]
    least = 0.0
    for i in range(n):
        q[i] = linear[i]
        least = max(least, abs(linear[i]) * traits[SCALE, i])
    least *= NEGLIGIBLE
    for p in range(M):
        mu[p] = 0.0
    for i in range(capacity + 2):
        members[PLACE, i] = i
    if read_bounds(lower, upper, traits[SCALE], least, bounds):
        return MISUSE
    guessed = len(warm) > HEADER and warm[VARIABLES] == n and warm[CONSTRAINTS] == M and 0 <= warm[WORKING] <= M
    pull = q
    if guessed and soft:
        keep_capped(n, warm, traits, bounds, mu)
        pull = pulled
        add_pull(G, n, q, mu, 0, members, traits, soft, pull)
    if lazy:
        for i in range(n):
            v[i] = -pull[i]
        solve_transposed(L, n, v)
    k, age, tag, candidates = np.int64(0), 0.0, settings[workspace.TAG], members[SCRATCH]  # see ``settle``
    listed = members[LISTED]
    if guessed:
        names = warm[HEADER + n + M : HEADER + n + M + int(warm[WORKING])]
        fits = len(names) <= capacity and len(names) * (len(names) + 1) // 2 <= len(warm) - (HEADER + n + 2 * M)
        known = tag != NO_TAG and warm[TAG] == tag and warm[AGE] < OLD
        if known and fits and all_present(names, bounds, mu):
            k, age = len(names), warm[AGE]
            unpack(warm[HEADER + n + 2 * M :], k, R)
            for i in range(k):
                candidates[i] = int(abs(names[i])) - 1
            multiply_at(rows, candidates, k, pull, n, gradient)
            for i in range(k):
                p = candidates[i]
                diagonal = rows[p, p] + traits[SOFTNESS, p]
                admit(i, p, names[i] > 0.0, p, diagonal, traits, -gradient[i], bounds, slots, members)
                ignore(p, bounds)
        else:
            count = choose_guess(names, capacity, bounds, mu, candidates)
            k = take(
                lazy, candidates, count, k, n, pull, v, rows, L, G, traits, bounds, mu, slots, members, R, scratch[1]
            )
        k = settle(k, bounds, mu, slots, members, R, scratch)
    if lazy and not soft:
        follow_lazily(n, v, rows, L, mu, k, members, gradient, y)
        row_values(lazy, L, G, n, traits, y)
    else:
        evaluate(lazy, n, q, inverse, L, G, mu, k, members, traits, soft, slope, y)
    margin, fine = LATER / NEGLIGIBLE * least, FINE
    iterations, rounds, status, worst = np.int64(0), 0, NUMERICAL_TROUBLE, np.inf
    interrupted = guessed and warm[STATUS] == ITERATION_LIMIT
    sweeps = SWEEPS if interrupted else 0  # the dual objective climbs with single steps only, and so the end is sure
    count = list_violated(y, margin, traits[SCALE], bounds, excess, listed)
    current, moved = not lazy or soft, False  # whether slope belongs to mu, and x is not what was last looked at
    passed = False  # whether a constraint was passed over
    while True:
        if count > 0:
            status, k, iterations, sweeps, passed_over = climb(
                lazy, n, q, inverse, pull, v, rows, L, G, traits, bounds, mu, slots, members, R, scratch, y, now, seen,
                excess, gradient, slope, k, capacity, soft, limit, iterations, sweeps, count, margin, least,
            )  # fmt: skip
            if status != SOLVED:
                break
            current, moved, passed = False, True, passed or passed_over
            if not lazy:
                row_values(lazy, L, G, n, traits, y)
        for i in range(k):  # bounds of variables hold exactly
            p = abs(members[NAME, i]) - 1
            if p < n:
                y[p] = slots[BOUND, i]
        if not current:
            add_pull(G, n, q, mu, k, members, traits, soft, slope)
        if passed:
            fine = FINEST
        best, share = np.inf, settings[workspace.SHARE]
        if k > 0:
            share = min(share, math.sqrt(smallest_share(k, slots, R)))
        if share < ILL:
            fine = FINEST
        for attempt in range(REFINEMENTS + 1):
            worst = residuals(lazy, P, G, n, traits, mu, k, slots, members, y, slope, least, gradient, active)
            if worst <= min(fine, DOUBT * share) or attempt == REFINEMENTS or not worst < 0.5 * best:
                break
            best, moved = worst, True
            refine(lazy, k, n, rows, L, G, slots, members, traits, R, mu, y, gradient, active, scratch[0], scratch[2])
            add_pull(G, n, q, mu, k, members, traits, soft, slope)
        status = SOLVED if worst <= min(tolerance, DOUBT * share) else NUMERICAL_TROUBLE
        rounds += 1
        if (not moved and margin == 0.0) or rounds == ROUNDS or worst >= UNDEFINED:
            break
        margin = 0.0
        count = list_violated(y, margin, traits[SCALE], bounds, excess, listed)
        if count == 0:
            break
        if fine > FINEST:  # a small violation is believed of the best x only
            fine, count, moved = FINEST, 0, True
    unsure = passed or rounds == ROUNDS  # of the violations that are left
    if unsure and status == SOLVED and worst_violation(n, y, mu, slope, traits, bounds, least) > NOISE:
        status = NUMERICAL_TROUBLE
    out[STATUS], out[ITERATIONS], out[WORKING] = status, iterations, k
    out[VARIABLES], out[CONSTRAINTS], out[TAG], out[AGE] = n, M, NO_TAG, age + iterations
    factor = out[HEADER + n + 2 * M :]
    if tag != NO_TAG and k * (k + 1) // 2 <= len(factor):
        pack(R, k, factor)
        out[TAG] = tag
    for i in range(n):
        x[i] = y[i]
    for i in range(k):
        out[HEADER + n + M + i] = members[NAME, i]
    return status


@borrowing(locked=True)
def solve_gram(q, lower, upper, warm, system, work, out):
    """Gram mode; ``system`` is of ``gpmpc.qp.gram_system``, ``work`` of ``gpmpc.qp.workspace``."""
    settings, traits, vectors, members, R, _ = carve(work)
    n, M = int(settings[workspace.VARIABLES]), int(settings[workspace.CONSTRAINTS])
    dense = is_dense(q) and is_dense(lower) and is_dense(upper) and is_dense(warm)
    if not dense or len(q) != n or len(lower) != M or len(upper) != M or not all_finite(q):
        return MISUSE
    m, wide, wide_rows = M - n, padded(n), padded(M - n)
    a = M * padded(M)
    b = a + n * wide
    c = b + n * wide
    d = c + n * wide_rows
    K, inverse, P = matrix(system, 0, M, padded(M)), matrix(system, a, n, wide), matrix(system, b, n, wide)
    turned, G = matrix(system, c, n, wide_rows), matrix(system, d, m, wide)
    return optimise(
        False, P, inverse, q, G, n, K, turned, traits, vectors, members, R, lower, upper, warm, settings, out
    )


@borrowing(locked=True)
def solve_lazy(P, q, G, lower, upper, warm, work, out):
    """Lazy mode; ``work`` is of ``gpmpc.qp.workspace``."""
    n, m = P.shape[0], len(G)
    M = n + m
    shaped = P.shape[1] == n and len(q) == n and G.shape[1] == n and len(lower) == M and len(upper) == M
    dense = is_dense(q) and is_dense(lower) and is_dense(upper) and is_dense(warm)
    dense &= is_dense_matrix(P) and is_dense_matrix(G)
    if not shaped or not dense or not all_finite(q):
        return MISUSE
    settings, traits, vectors, members, R, rest = carve(work)
    L, rows = matrix(rest, 0, n, padded(n)), matrix(rest, n * padded(n), len(R) + 1, n)  # nearer without gaps
    if not factorise(P, L):
        return MISUSE
    if not measure(P, G, n, traits, vectors[0]):
        return MISUSE
    loss = 1.0
    for i in range(n):
        loss = max(loss, L[i, i] * L[i, i] * P[i, i])
    settings[workspace.SHARE] = 1.0 / loss
    return optimise(True, P, P, q, G, n, rows, L, traits, vectors, members, R, lower, upper, warm, settings, out)
