"""The dual active-set method: which constraints hold with equality at the minimum of a strictly convex QP?

For a working set W the minimiser over ``c_p'x = b_p, p in W`` is x = x_u - P^-1 C_W' mu with K_WW mu = y_W - b_W, where
x_u is the unconstrained minimiser, y = C x_u and K = C P^-1 C'. The method of Goldfarb and Idnani (Math. Programming
27, 1983, algorithm 1) keeps every multiplier in its range and moves to the most violated constraint p until none is
violated. A multiplier at its cap, the price of a soft row, leaves with a constraint that stays violated; then mu_p is
not zero outside the working set.

The functions take a ``Workspace``, a ``WorkingSet`` and the number k of its constraints; those that change k return it.
"""

import numpy as np

from gpmpc._compiled import inline_njit
from gpmpc._kernels.linalg import combine_rows, dot
from gpmpc.qp._record import INFEASIBLE, ITERATION_LIMIT, SOLVED
from gpmpc.qp._triangular import (
    append_row,
    delete_row,
    multiply_rows,
    multiply_to_ends,
    solve_lower,
    solve_transposed,
    subtract_rows,
)
from gpmpc.qp._violations import (
    choose_bad,
    count_bad,
    ignore_violations,
    keep_violated,
    list_violated,
    most_violated,
    restore_limits,
)

NEGLIGIBLE = 1e-26  # share of the length of q below which x, and a violation of a bound of zero, is none
_GUESSED_PIVOT = 1e-9  # share of K_pp: a guessed constraint that depends on the others by more is left out
_DEPENDENT = 1e-12  # d below this share of K_pp: the constraint depends on the working ones
_DOUBTFUL = 1e-4  # d below this share of K_pp is computed again without cancellation
_ROUNDING = 1e-15  # share of the bounds of a contradiction by which it may be their rounding
_HOPELESS = 1e-7  # violation of a dependent constraint that is taken for a contradiction
_BATCHES = 4  # times that all badly violated constraints enter at once
_BAD = 0.5  # those violated by more than this share of the worst


@inline_njit
def iterate(work, active, k, count, margin, iterations, batches):
    """Changes the working set until no constraint is violated by more than ``margin``, in units of ``scale``.

    ``count`` are, and listed; ``-1 - g`` says that y is not known yet and that g guessed candidates enter first.

    Returns:
        ``SOLVED``, ``INFEASIBLE`` or ``ITERATION_LIMIT``, the size of the working set, iterations and batches so far,
        whether a constraint was passed over because it contradicts others by what may be rounding, and whether any was
        violated.
    """
    p, chosen, begins, violated, passed = 0, -1 - count, count < 0, False, False
    complete = True  # whether y and the list are those of all constraints
    while count != 0:
        if not begins:
            if iterations >= work.limit:
                return ITERATION_LIMIT, k, iterations, batches, passed, True
            p, chosen, violated = most_violated(work, count), 0, True
            if complete and batches < _BATCHES and count_bad(work, _BAD * work.excess[p], count) > 1:
                batches += 1
                chosen = choose_bad(work, _BAD * work.excess[p], count, work.capacity - k)
        before = k
        k = add_constraints(work, active, k, chosen)
        if not begins:
            iterations += k - before
        several = unsettled = begins or k > before
        if not several:
            mu_p, scale = work.mu[p], work.scale[p]
            satisfied, k, changes = _satisfy_constraint(work, active, k, p)
            iterations += changes
            if not satisfied:
                size = max(abs(work.y[p]), work.negligible[p] / NEGLIGIBLE)
                if work.excess[p] * scale > _HOPELESS * size:
                    _write_ray(work, active, k, p)
                    return INFEASIBLE, k, iterations, batches, passed, True
                work.mu[p], passed = mu_p, True  # what it gained on the way belongs to no working set
                ignore_violations(work, p)
                unsettled = not work.soft  # else refinement has to do
            if work.soft:
                batches = _BATCHES  # caps may have changed x_u
        if unsettled:
            k = drop_wrong_multipliers(work, active, k)
        if work.prepared and not begins:
            _follow_multipliers(work)
        else:
            _minimise(work, active, k)
            complete = several or work.soft or work.prepared or count == 1 or iterations >= work.limit
            if not complete:  # first satisfy those that were seen to be violated, then look at all
                count = keep_violated(work, margin, count)
                complete = count == 0
            if complete:
                multiply_constraints(work)
            for i in range(len(work.mu) if work.prepared else 0):
                work.seen[i] = work.mu[i]
        if complete:
            count = list_violated(work, margin)
        begins = False
    if violated:
        for i in range(k):  # rounding can take multipliers out of their ranges
            p = abs(active.name[i]) - 1
            work.mu[p] = min(max(work.mu[p], active.least[i]), active.most[i])
        if work.prepared:
            multiply_constraints(work)  # which x has, but for rounding
    return SOLVED, k, iterations, batches, passed, violated


@inline_njit
def _satisfy_constraint(work, active, k, p):
    """Moves multipliers until constraint p is satisfied: steps 1 and 2 of Goldfarb and Idnani's algorithm.

    Returns:
        False if it contradicts the working ones, the size of the working set, and how many entered or left.
    """
    mu, r, solved, changes = work.mu, work.r, work.solved, 0
    above = mu[p] > 0.0 or (mu[p] == 0.0 and work.y[p] > work.upper[p])
    sense = 1.0 if above == (mu[p] == 0.0) else -1.0  # the direction of mu_p, which comes back from a cap
    violation = (work.y[p] - (work.upper[p] if above else work.lower[p])) * sense
    place = _make_row(work, active, k, p)
    row, size = work.rows[place], int(work.end[p])
    free_value, K_pp = _measure_row(work, p, row, size)
    _multiply_working_rows(work, active, k, p, row)
    solve_lower(active.factor, k, solved)
    while True:
        _write_slot(work, active, k, p, above)
        active.place[k], active.free_value[k], active.diagonal[k] = place, free_value, K_pp
        # step direction:  r = K_WW^-1 K_Wp,  d = K_pp - K_pW r;  mu_p moves by t, mu_W by -t r and y_p by -t d
        for i in range(k):
            r[i] = solved[i]
        solve_transposed(active.factor, k, r)
        d = K_pp - dot(solved, solved, k)
        if d < _DOUBTFUL * K_pp:
            d = _distance_to_span(work, active, k, row)
        # ratio test:  t = min(t1, t2);  t2 = violation / d makes p hold,  t1 takes a multiplier to the end of its range
        step = max(0.0, violation) / d if d > _DEPENDENT * K_pp and k < work.capacity else np.inf
        room = active.most[k] - mu[p] if sense > 0.0 else mu[p] - active.least[k]
        capped = room < step
        step, blocking = _first_blocking(work, active, k, sense, room if capped else step)
        if step == np.inf:  # no step ends: (r, -1) is Farkas' proof, unless rounding made the violation
            for i in range(k):
                work.negligible[p] += _ROUNDING * abs(r[i] * active.bound[i])
            return False, k, changes
        # take the step
        for i in range(k):
            mu[abs(active.name[i]) - 1] -= sense * step * r[i]
        mu[p] += sense * step
        changes += 1
        if blocking < k:  # partial step: the blocking constraint leaves, and p is tried again
            leaving = abs(active.name[blocking]) - 1
            mu[leaving] = active.least[blocking] if sense * r[blocking] > 0.0 else active.most[blocking]
            _drop_constraint(work, active, k, blocking)
            k -= 1
            active.place[k + 1] = active.place[k]  # the entering row keeps its place in slot k
            restore_limits(work, leaving)
            violation -= step * d
        elif capped:  # a soft row that stays violated
            mu[p] = active.most[k] if sense > 0.0 else active.least[k]
            restore_limits(work, p)
            return True, k, changes
        else:  # full step: p enters
            append_row(active.factor, k, solved, d)
            ignore_violations(work, p)
            return True, k + 1, changes


@inline_njit
def _first_blocking(work, active, k, sense, step):
    """Returns the longest step up to ``step`` that keeps the multipliers in range, and the slot that ends it (or k)."""
    r, size = work.r, 0.0
    for i in range(k):
        size = max(size, abs(r[i]))
    blocking = k
    for i in range(k):
        rate = sense * r[i]
        if abs(rate) > 1e-12 * size:
            room = (work.mu[abs(active.name[i]) - 1] - (active.least[i] if rate > 0.0 else active.most[i])) / rate
            if room < step:
                step, blocking = max(room, 0.0), i
    return step, blocking


@inline_njit
def _distance_to_span(work, active, k, row):
    """Returns ``d = |w_p - sum r_i w_i|^2`` as a sum of squares, which cannot cancel."""
    rest, n = work.scratch, len(work.x)
    for j in range(n):
        rest[j] = row[j]
    subtract_rows(rest, work.rows, active.place, work.r, k, n)
    return dot(rest, rest, n)


@inline_njit
def _write_ray(work, active, k, p):
    """Writes Farkas' proof that p contradicts the working constraints to mu: ``C' ray = 0``, ``ray' bounds < 0``."""
    sense = 1.0 if work.y[p] > work.upper[p] else -1.0
    for i in range(len(work.mu)):
        work.mu[i] = 0.0
    for i in range(k):
        w = abs(active.name[i]) - 1
        ray = -sense * work.r[i]
        if ray * active.name[i] >= 0.0 or work.lower[w] == work.upper[w]:  # else rounding: it cannot pull that way
            work.mu[w] = ray
    work.mu[p] = sense


@inline_njit
def add_constraints(work, active, k, count):
    """Adds the first ``count`` candidates to the working set, but for those that depend on others; returns its size."""
    first, solved = k, work.solved
    for i in range(count):
        p = abs(work.candidates[i]) - 1
        place = _make_row(work, active, first + i, p)
        row, size = work.rows[place], int(work.end[p])
        _multiply_working_rows(work, active, k, p, row)
        solve_lower(active.factor, k, solved)
        free_value, K_pp = _measure_row(work, p, row, size)
        pivot = K_pp - dot(solved, solved, k)
        if pivot > _GUESSED_PIVOT * K_pp:
            active.place[first + i] = active.place[k]
            _write_slot(work, active, k, p, work.candidates[i] > 0)
            active.place[k], active.free_value[k], active.diagonal[k] = place, free_value, K_pp
            append_row(active.factor, k, solved, pivot)
            k += 1
        else:
            restore_limits(work, p)
    return k


@inline_njit
def restore_constraints(work, active, names, factor):
    """Makes the named constraints of a prepared problem the working set, whose factor is known; returns its size."""
    k, at = len(names), 0
    for i in range(k):
        p, row = int(abs(names[i])) - 1, active.factor[i]
        active.place[i] = p
        active.free_value[i], active.diagonal[i] = _measure_row(work, p, work.rows[p], 0)
        _write_slot(work, active, i, p, names[i] > 0.0)
        ignore_violations(work, p)
        for j in range(i + 1):
            row[j] = factor[at + j]
        at += i + 1
    return k


@inline_njit
def _make_row(work, active, slot, p):
    """Returns the place of ``w_p = L^-T c_p``, computed in the place that the slot has free if it is not known."""
    if work.prepared:
        return p
    place, n = active.place[slot], len(work.x)
    row = work.rows[place]
    if p >= n:
        c = work.G[p - n]
        for i in range(n):
            row[i] = c[i]
    else:
        for i in range(n):
            row[i] = 0.0
        row[p] = 1.0
    solve_transposed(work.L, int(work.end[p]), row)
    return place


@inline_njit
def _measure_row(work, p, row, size):
    """Returns c_p'x at the unconstrained minimiser, and K_pp; ``row`` is w_p."""
    n = len(work.x)
    if work.prepared:
        return dot(work.gram[p], work.v, n), work.gram[p, p]
    return dot(row, work.v, n), dot(row, row, size)


@inline_njit
def _multiply_working_rows(work, active, k, p, row):
    """Writes K_Wp to ``solved``, where ``row`` is w_p."""
    if work.prepared:
        for i in range(k):
            work.solved[i] = work.gram[p, active.place[i]]
    else:
        multiply_rows(work.rows, active.place, k, row, int(work.end[p]), work.solved)


@inline_njit
def _write_slot(work, active, k, p, above):
    """Writes constraint p, at its upper bound (``above``) or its lower one, and its multiplier's range to slot k."""
    cap, equality = work.cap[p], work.lower[p] == work.upper[p]
    active.name[k] = p + 1 if above else -(p + 1)
    active.bound[k] = work.upper[p] if above else work.lower[p]
    active.least[k] = -cap if equality or not above else 0.0
    active.most[k] = cap if equality or above else 0.0


@inline_njit
def _drop_constraint(work, active, k, slot):
    """Drops the constraint in a slot from the working set of k, and from ``work.solved``; its place becomes free."""
    delete_row(active.factor, k, slot, work.solved, work.cosines, work.sines)
    place = active.place[slot]
    for i in range(slot, k - 1):
        active.name[i], active.place[i], active.bound[i] = active.name[i + 1], active.place[i + 1], active.bound[i + 1]
        active.least[i], active.most[i] = active.least[i + 1], active.most[i + 1]
        active.free_value[i], active.diagonal[i] = active.free_value[i + 1], active.diagonal[i + 1]
    active.place[k - 1] = place


@inline_njit
def drop_wrong_multipliers(work, active, k):
    """Solves ``K_WW mu = y_W - b_W``; drops the most wrong multiplier until all are in range. Returns the size.

    Any working set is a valid start of a dual method once this is done.
    """
    solved, trial = work.solved, work.r
    for i in range(k):
        solved[i] = active.free_value[i] - active.bound[i]
    solve_lower(active.factor, k, solved)
    while True:
        for i in range(k):
            trial[i] = solved[i]
        solve_transposed(active.factor, k, trial)
        worst, slot = 0.0, k
        for i in range(k):
            outside = max(trial[i] - active.most[i], active.least[i] - trial[i])
            if outside > worst:
                worst, slot = outside, i
        if slot == k:
            break
        p = abs(active.name[slot]) - 1
        _drop_constraint(work, active, k, slot)
        k -= 1
        work.mu[p] = 0.0
        restore_limits(work, p)
    for i in range(k):
        work.mu[abs(active.name[i]) - 1] = trial[i]
    return k


@inline_njit
def _minimise(work, active, k):
    """Writes the minimiser of the Lagrangian, ``P x = -(q + C'mu)``, to the first n entries of y."""
    n, y = len(work.x), work.y
    if work.prepared or work.soft:  # constraints at their caps have multipliers, too
        add_multipliers(work, active, k)
        if work.prepared:
            combine_rows(work.gram, n, work.slope, 0, n, y)
        for i in range(n):
            y[i] = -y[i] if work.prepared else -work.slope[i]
        if work.prepared:
            return
        solve_transposed(work.L, n, y)
    else:  # L x = v - sum mu_i w_i
        for i in range(n):
            y[i] = work.v[i]
        for i in range(k):
            work.scratch[i] = work.mu[abs(active.name[i]) - 1]
        subtract_rows(y, work.rows, active.place, work.scratch, k, n)
    solve_lower(work.L, n, y)


@inline_njit
def _follow_multipliers(work):
    """Moves y of a prepared program by the rows of K whose multipliers have changed."""
    mu, seen, amounts, count, M = work.mu, work.seen, work.excess, 0, len(work.mu)
    for p in range(M):
        work.candidates[count] = p
        amounts[count] = mu[p] - seen[p]
        count += amounts[count] != 0.0
        seen[p] = mu[p]
    subtract_rows(work.y, work.gram, work.candidates, amounts, count, M)


@inline_njit
def multiply_constraints(work):
    """Writes ``y[n:] = G y[:n]``."""
    n = len(work.x)
    multiply_to_ends(work.G, work.end[n:], work.y, work.y[n:])


@inline_njit
def add_multipliers(work, active, k):
    """Writes ``slope = q + C' mu``; only where rows are soft can others than the working ones have a multiplier."""
    n, mu, slope = len(work.x), work.mu, work.slope
    for i in range(n):
        slope[i] = work.q[i] + mu[i]
    for i in range(len(work.G) if work.soft else k):
        p = n + i if work.soft else abs(active.name[i]) - 1
        if p >= n and mu[p] != 0.0:
            weight, row = mu[p], work.G[p - n]
            for j in range(int(work.end[p])):
                slope[j] += weight * row[j]
