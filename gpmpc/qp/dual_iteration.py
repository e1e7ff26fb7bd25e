"""The dual active-set iteration: which constraints hold with equality at the minimum of a strictly convex QP?

For a working set W the minimiser over ``c_p'x = b_p, p in W`` is x = x_u - P^-1 C_W' mu with K_WW mu = y_W - b_W, where
x_u is the unconstrained minimiser, y = C x_u and K = C P^-1 C'. The method of Goldfarb and Idnani (Math. Programming
27, 1983, algorithm 1) keeps every multiplier in its range and moves to the most violated constraint p until none is
violated: with r = K_WW^-1 K_Wp and d = K_pp - K_pW r, a step t changes mu_p by t, mu_W by -t r and y_p by -t d. It
ends at t = violation / d (p joins W), or where a multiplier reaches the end of its range (that constraint leaves W),
or never (d = 0: the constraints contradict each other, and (r, -1) is Farkas' proof).
"""

import numpy as np

from gpmpc.compiled import woven
from gpmpc.qp.factor import append_row, backward_solve, dot, forward_solve, subtract_rows
from gpmpc.qp.working_set import (
    BOUND,
    END,
    FLOOR,
    HIGH_WATCH,
    LEAST,
    LOW_WATCH,
    LOWER,
    MOST,
    NAME,
    PLACE,
    SOFTNESS,
    UPPER,
    admit,
    couple,
    evict,
    find_row,
    free_value,
    ignore,
    watch,
)

REACHED, CONTRADICTION = 0, 1
DEPENDENT = 1e-12  # d below this share of K_pp: the constraint depends on the working ones
ROUNDING = 1e-15  # share of the bounds of a contradiction by which it may be their rounding
DOUBTFUL = 1e-4  # d below this share of K_pp is computed again without cancellation (lazy mode)


@woven
def list_violated(y, margin, scales, bounds, excess, listed):
    """Lists the constraints outside their watch by more than ``margin``, and by how much more, in units of ``scales``.

    Returns how many there are.
    """
    lo, hi = bounds[LOW_WATCH], bounds[HIGH_WATCH]
    violated = 0
    for p in range(len(y)):
        excess[p] = max(y[p] - hi[p], lo[p] - y[p]) - margin * scales[p]
        violated += excess[p] > 0.0
    if violated > 0:
        count = 0
        for p in range(len(y)):
            if excess[p] > 0.0:
                excess[p] /= scales[p]
                listed[count] = p
                count += 1
    return violated


@woven
def keep_violated(now, margin, scales, bounds, excess, listed, count):
    """The same for the listed constraints, which stay listed if they are still outside their watch."""
    kept = 0
    for i in range(count):
        p = listed[i]
        excess[p] = max(now[p] - bounds[HIGH_WATCH, p], bounds[LOW_WATCH, p] - now[p]) / scales[p] - margin
        if excess[p] > 0.0:
            listed[kept] = p
            kept += 1
    return kept


@woven
def most_violated(excess, listed, count):
    """The one of the listed constraints with the largest excess."""
    worst = listed[0]
    for i in range(1, count):
        if excess[listed[i]] > excess[worst]:
            worst = listed[i]
    return worst


@woven
def step_to(lazy, p, value, k, capacity, n, q, v, rows, L, G, traits, bounds, mu, slots, members, R, scratch):
    """Changes multipliers until constraint p, whose value is given, is satisfied.

    Returns:
        The outcome, the size of the working set, and the number of constraints that entered or left.
    """
    changes = 0
    above = mu[p] > 0.0 or (mu[p] == 0.0 and value > bounds[UPPER, p])
    sense = 1.0 if above == (mu[p] == 0.0) else -1.0  # from a cap the multiplier comes back
    violation = (value - bounds[UPPER if above else LOWER, p]) * sense
    place = find_row(lazy, p, k, n, rows, L, G, traits, members)
    row, size = rows[place], int(traits[END, p])
    free = free_value(lazy, row, v, q, n)
    diagonal = (dot(row, row, size) if lazy else row[p]) + traits[SOFTNESS, p]
    solved, r = scratch[1], scratch[2]
    couple(lazy, row, k, size, rows, members, solved)
    forward_solve(R, k, solved)
    while True:
        admit(k, p, above, place, diagonal, traits, free, bounds, slots, members)
        for i in range(k):
            r[i] = solved[i]
        backward_solve(R, k, r)
        d = diagonal - dot(solved, solved, k)
        if lazy and d < DOUBTFUL * diagonal:
            d = distance_to_span(row, k, n, rows, members, r, scratch[3]) + traits[SOFTNESS, p]
            for i in range(k):
                d += traits[SOFTNESS, abs(members[NAME, i]) - 1] * r[i] * r[i]
        movable = d > DEPENDENT * diagonal and k < capacity
        step = max(0.0, violation) / d if movable else np.inf
        own_room = slots[MOST, k] - mu[p] if sense > 0.0 else mu[p] - slots[LEAST, k]
        capped = own_room < step
        if capped:
            step = own_room
        step, blocking = first_block(step, sense, k, mu, slots, members, r)
        if step == np.inf:
            for i in range(k):
                bounds[FLOOR, p] += ROUNDING * abs(r[i] * slots[BOUND, i])
            return CONTRADICTION, k, changes
        for i in range(k):
            mu[abs(members[NAME, i]) - 1] -= sense * step * r[i]
        mu[p] += sense * step
        changes += 1
        if blocking < k:
            leaving = abs(members[NAME, blocking]) - 1
            mu[leaving] = slots[LEAST if sense * r[blocking] > 0.0 else MOST, blocking]
            evict(k, blocking, slots, members, R, solved, scratch[0])
            k -= 1
            members[PLACE, k + 1] = members[PLACE, k]  # the entering row keeps its place in slot k
            watch(leaving, mu, bounds)
            violation -= step * d
            continue
        if capped:
            mu[p] = slots[MOST if sense > 0.0 else LEAST, k]
            watch(p, mu, bounds)
        else:
            append_row(R, k, solved, d)
            ignore(p, bounds)
            k += 1
        return REACHED, k, changes


@woven
def distance_to_span(row, k, n, rows, members, r, rest):
    """|row - sum r_i row_i|^2: what is left of a row outside the span of the working ones (lazy mode)."""
    for j in range(n):
        rest[j] = row[j]
    subtract_rows(rest, rows, members[PLACE], r, k, n)
    return dot(rest, rest, n)


@woven
def first_block(step, sense, k, mu, slots, members, r):
    """The longest step, up to ``step``, that keeps the multipliers in range, and the slot that ends it (or k)."""
    size = 0.0
    for i in range(k):
        size = max(size, abs(r[i]))
    blocking = k
    for i in range(k):
        rate = sense * r[i]
        if abs(rate) > 1e-12 * size:
            room = (mu[abs(members[NAME, i]) - 1] - slots[LEAST if rate > 0.0 else MOST, i]) / rate
            if room < step:
                step, blocking = max(room, 0.0), i
    return step, blocking


@woven
def write_ray(p, above, k, bounds, members, r, mu):
    """Farkas' proof that constraint p contradicts the working ones, ``C' ray = 0`` and ``ray' bounds < 0``, into mu."""
    sense = 1.0 if above else -1.0
    mu[:] = 0.0
    for i in range(k):
        at = abs(members[NAME, i]) - 1
        mu[at] = -sense * r[i]
        if mu[at] * members[NAME, i] < 0.0 and bounds[LOWER, at] < bounds[UPPER, at]:
            mu[at] = 0.0  # rounding: this bound cannot pull that way
    mu[p] = sense
