"""The working set: which constraints are held at a bound, the ranges of their multipliers, and the factor.

Everything lives in a few arrays that the kernels hand around, a column per constraint or per *slot* of the working set:

* ``bounds`` (5, M): the bounds, how much violation of a bound of zero counts as none, and the band outside which
  ``most_violated`` reports a constraint (infinitely wide for a working one).
* ``slots`` (5, capacity + 1): the bound b that holds, the constraint's value at the unconstrained minimiser, the range
  of its multiplier: [0, cap] at an upper bound, [-cap, 0] at a lower one, [-cap, cap] for an equality, and its entry of
  the diagonal of K + softness. The cap is infinite unless the row is soft with a linear weight; a constraint that
  leaves at its cap stays violated.
* ``members`` (4, capacity + 2) integers: the signed number +-(p + 1) of the constraint in each slot, where its row is,
  scratch for lists of candidates, and the list of violated constraints.
* ``traits`` (4, M): the length of c_p by which violations are measured, in the metric of P^-1 (Gram mode) or of the
  inverse of P's diagonal (lazy mode), softness 1/rho and cap (``gpmpc.qp.soft_rows``), and the number of leading
  entries of c_p that may not be zero.
* ``mu`` (M): multipliers; zero outside the working set except at a cap.
* ``R``: the Cholesky factor of K_WW + softness (``gpmpc.qp.factor``).

A *row* represents a constraint in the metric of P^-1, K_pq = row_p . row_q or simply entry q of row p: in Gram mode row
p is K_p, known beforehand; in lazy mode, P = L'L, it is w_p = L^-T c_p, made when p enters, and as short as c_p.
"""

import math

import numpy as np

from gpmpc.compiled import woven
from gpmpc.qp.factor import append_row, backward_solve, dot, forward_solve, multiply_at, remove_row
from gpmpc.qp.hessian import make_row, make_rows
from gpmpc.qp.lanes import any_nonzero, lanes, no_lanes, plus, plus_product, product, some_lanes, total
from gpmpc.qp.workspace import round_end

LOWER, UPPER, FLOOR, LOW_WATCH, HIGH_WATCH = 0, 1, 2, 3, 4  # rows of ``bounds``
BOUND, FREE_VALUE, LEAST, MOST, DIAGONAL = 0, 1, 2, 3, 4  # rows of ``slots``
NAME, PLACE, SCRATCH, LISTED = 0, 1, 2, 3  # rows of ``members``
SCALE, SOFTNESS, CAP, END = 0, 1, 2, 3  # rows of ``traits``

TOLERATED = 2e-14  # a violation below this share of the bound is none, whatever the constraint's other bound is
GUESSED_PIVOT = 1e-9  # share of K_pp: a guessed constraint that depends on the others by more is left out


@woven
def watch(p, mu, bounds):
    """Puts constraint p, outside the working set, under the watch of ``most_violated``.

    With mu_p = 0 it must stay within its bounds; at a cap it must stay outside the bound that it violates.
    """
    low, high, floor = bounds[LOWER, p], bounds[UPPER, p], bounds[FLOOR, p]
    below, above = TOLERATED * abs(low) + floor, TOLERATED * abs(high) + floor
    bounds[LOW_WATCH, p], bounds[HIGH_WATCH, p] = low - below, high + above
    if mu[p] > 0.0:
        bounds[LOW_WATCH, p], bounds[HIGH_WATCH, p] = high - above, np.inf
    elif mu[p] < 0.0:
        bounds[LOW_WATCH, p], bounds[HIGH_WATCH, p] = -np.inf, low + below


@woven
def ignore(p, bounds):
    """Takes constraint p out of the watch of ``most_violated``."""
    bounds[LOW_WATCH, p], bounds[HIGH_WATCH, p] = -np.inf, np.inf


@woven
def find_row(lazy, p, k, n, rows, L, G, traits, members):
    """Where row p is; in lazy mode it is made in the place that slot k has free."""
    if not lazy:
        return p
    place = members[PLACE, k]
    make_row(p, n, L, G, traits[END], rows[place])
    return place


@woven
def couple(lazy, row, k, size, rows, members, product):
    """The products of a row (``size`` entries in lazy mode) with those of the working set, K_Wp if it is row p."""
    if lazy:
        multiply_at(rows, members[PLACE], k, row, size, product)
    else:
        for i in range(k):
            product[i] = row[abs(members[NAME, i]) - 1]


@woven
def admit(k, p, above, place, diagonal, traits, free, bounds, slots, members):
    """Writes constraint p into slot k, at its upper bound (``above``) or its lower one."""
    members[NAME, k], members[PLACE, k] = (p + 1 if above else -(p + 1)), place
    slots[BOUND, k] = bounds[UPPER, p] if above else bounds[LOWER, p]
    slots[FREE_VALUE, k], slots[DIAGONAL, k] = free, diagonal
    cap, equality = traits[CAP, p], bounds[LOWER, p] == bounds[UPPER, p]
    slots[LEAST, k] = -cap if equality or not above else 0.0
    slots[MOST, k] = cap if equality or above else 0.0


@woven
def evict(k, slot, slots, members, R, solved, scratch):
    """Deletes a slot of the working set of k members; its place is free for the next row.

    Mends the factor, and the solution ``solved`` of a forward solve.
    """
    remove_row(R, k, slot, scratch, solved)
    place = members[PLACE, slot]
    for i in range(slot, k - 1):
        members[NAME, i], members[PLACE, i] = members[NAME, i + 1], members[PLACE, i + 1]
        for field in range(5):
            slots[field, i] = slots[field, i + 1]
    members[PLACE, k - 1] = place


@woven
def free_value(lazy, row, v, q, n):
    """c_p'x_u, the constraint's value at the unconstrained minimiser: from v = -L^-T q, or from row p of K and q."""
    return dot(row, v, n) if lazy else -dot(row, q, n)


@woven
def choose_guess(names, room, bounds, mu, candidates):
    """Writes the guessed constraints that can be taken, at most ``room``, to ``candidates``; returns how many."""
    count = 0
    for name in names:
        if 1.0 <= abs(name) <= len(mu) and count < room:
            p = int(abs(name)) - 1
            watched = bounds[LOW_WATCH, p] > -np.inf or bounds[HIGH_WATCH, p] < np.inf
            if watched and mu[p] == 0.0 and abs(bounds[UPPER if name > 0.0 else LOWER, p]) < np.inf:
                candidates[count] = int(name)
                count += 1
                ignore(p, bounds)
    return count


@woven
def choose_violated(share, room, y, excess, listed, violated, bounds, mu, candidates):
    """The same for the listed constraints whose scaled excess is above ``share``, except those at a cap."""
    count = 0
    for i in range(violated):
        p = listed[i]
        if excess[p] > share and count < room and mu[p] == 0.0:
            candidates[count] = p + 1 if y[p] > bounds[UPPER, p] else -(p + 1)
            count += 1
            ignore(p, bounds)
    return count


@woven
def take(lazy, candidates, count, k, n, q, v, rows, L, G, traits, bounds, mu, slots, members, R, solved):
    """Takes the candidates into the working set, but for those that depend on the others; returns its size."""
    first = k
    if lazy:
        make_rows(candidates, count, n, L, G, traits[END], rows, members[PLACE, first:])
    for i in range(count):
        p = abs(candidates[i]) - 1
        place = members[PLACE, first + i] if lazy else p
        row = rows[place]
        size = int(traits[END, p])
        couple(lazy, row, k, size, rows, members, solved)
        forward_solve(R, k, solved)
        diagonal = (dot(row, row, size) if lazy else row[p]) + traits[SOFTNESS, p]
        pivot = diagonal - dot(solved, solved, k)
        if pivot > GUESSED_PIVOT * diagonal:
            members[PLACE, first + i] = members[PLACE, k]
            free = free_value(lazy, row, v, q, n)
            admit(k, p, candidates[i] > 0, place, diagonal, traits, free, bounds, slots, members)
            append_row(R, k, solved, pivot)
            k += 1
        else:
            watch(p, mu, bounds)
    return k


@woven
def settle(k, bounds, mu, slots, members, R, scratch):
    """The multipliers of the working set; drops the most wrong one until all are in range. Returns the size.

    Any working set is a valid start of a dual method once this is done.
    """
    solved, trial = scratch[1], scratch[2]
    for i in range(k):
        solved[i] = slots[FREE_VALUE, i] - slots[BOUND, i]
    forward_solve(R, k, solved)
    while True:
        for i in range(k):
            trial[i] = solved[i]
        backward_solve(R, k, trial)
        worst, slot = 0.0, np.int64(-1)  # for a literal numba compiles what is called with it anew, and uses none of it
        for i in range(k):
            outside = max(trial[i] - slots[MOST, i], slots[LEAST, i] - trial[i])
            if outside > worst:
                worst, slot = outside, i
        if slot < 0:
            break
        p = abs(members[NAME, slot]) - 1
        evict(k, slot, slots, members, R, solved, scratch[0])
        k -= 1
        mu[p] = 0.0
        watch(p, mu, bounds)
    for i in range(k):
        mu[abs(members[NAME, i]) - 1] = trial[i]
    return k


@woven
def clip_multipliers(k, mu, slots, members):
    """Puts the multipliers of the working set back into their ranges."""
    for i in range(k):
        p = abs(members[NAME, i]) - 1
        mu[p] = min(max(mu[p], slots[LEAST, i]), slots[MOST, i])


@woven
def smallest_share(k, slots, R):
    """The smallest pivot of the factor, as a share of its diagonal entry: what cancellation left of it."""
    loss = 1.0
    for i in range(k):
        loss = max(loss, R[i, i] * R[i, i] * slots[DIAGONAL, i])
    return 1.0 / loss


@woven
def measure(P, G, n, traits, units):
    """Writes the scales and ends of the constraints, lengths in the metric of P's diagonal; False if not finite.

    ``units`` is scratch, an entry per variable and a lane more.
    """
    norms, ends = traits[SCALE, n:], traits[END, n:]
    for i in range(n):
        traits[SCALE, i] = units[i] = 1.0 / math.sqrt(P[i, i])
    for i in range(n, n + 8):
        units[i] = 0.0
    undefined, end = 0.0, 0
    for p in range(len(G)):
        row, near, far = G[p], no_lanes(), no_lanes()
        head, tail, rest = row[:end], row[end:], units[end:]
        for j in range(0, end, 8):
            values = product(some_lanes(head, j), lanes(units, j))
            near = plus_product(near, values, values)
        for j in range(0, n - end, 8):
            values = product(some_lanes(tail, j), lanes(rest, j))
            far = plus_product(far, values, values)
        if any_nonzero(far):  # longer than the row before
            end = n
            while end > 0 and row[end - 1] == 0.0:
                end -= 1
            end = round_end(end, n)
        norms[p], ends[p] = total(plus(near, 1.0, far)), end
    for p in range(len(G)):
        norm = math.sqrt(norms[p])
        norms[p] = norm if norm > 0.0 else 1.0
        undefined += norm * 0.0
    return undefined == 0.0
