"""The dual active-set iteration: which constraints hold with equality at the minimum of a strictly convex QP?

For a working set W the minimiser over ``c_p'x = b_p, p in W`` is x = x_u - P^-1 C_W' mu with K_WW mu = y_W - b_W, where x_u
is the unconstrained minimiser, y = C x_u and K = C P^-1 C'. The method of Goldfarb and Idnani (Math. Programming 27, 1983,
algorithm 1) keeps every multiplier in its admissible range and moves to the most violated constraint p until none is
violated: with r = K_WW^-1 K_Wp and d = K_pp - K_pW r, a step t changes mu_p by t, mu_W by -t r and y_p by -t d. It ends
at t = violation / d (p joins W), or where a multiplier reaches the end of its range (that constraint leaves W), or never
(d = 0: the constraints contradict each other, and (r, -1) is Farkas' proof).

A multiplier's range is [0, cap] at an upper bound, [-cap, 0] at a lower one, [-cap, cap] for an equality; cap is infinite
unless the row is soft with a linear weight (exact L1 penalty), and a constraint that leaves at its cap stays violated.

Both modes share this file. They differ in what a *row* is and in the state that the steps move:
Gram mode: row p = K_p, state = y (x is its first n entries). Lazy mode, P = L L': row p = w_p = L^-1 c_p, made when p
enters, state = v = L'x, and y = C x is recomputed from it.
"""


import numpy as np

from gpmpc.qp.compiled import compiled
from gpmpc.qp.factor import append_row, backward_solve, dot, forward_solve, remove_row, subtract_rows

NO_CONSTRAINT = -1
REACHED, STALLED, CONTRADICTION = 0, 1, 2
ENTERING_PIVOT = 1e-12  # d below this share of K_pp: the constraint depends on the working ones
GUESSED_PIVOT = 1e-9  # the same for a constraint of the warm start, which nothing obliges us to take
NOISE = 1e-7  # share of the size of a constraint below which a contradiction is taken for rounding


@compiled
def most_violated(y, lo, hi, weights, excess, count):
    """The constraint farthest outside its bounds after weighting, or ``NO_CONSTRAINT``."""
    for p in range(count):
        excess[p] = max(y[p] - hi[p], lo[p] - y[p]) * weights[p]
    best, chosen = 0.0, NO_CONSTRAINT
    for p in range(count):
        if excess[p] > best:
            best, chosen = excess[p], p
    return chosen


@compiled
def watch(p, mu, lower, upper, slack, lo, hi):
    """Puts constraint p, outside the working set, under the watch of ``most_violated``.

    With mu_p = 0 it must stay within its bounds; at a cap it must stay outside the bound that it violates.
    """
    if mu[p] == 0.0:
        lo[p], hi[p] = lower[p] - slack[p], upper[p] + slack[p]
    elif mu[p] > 0.0:
        lo[p], hi[p] = upper[p] - slack[p], np.inf
    else:
        lo[p], hi[p] = -np.inf, lower[p] + slack[p]


@compiled
def ignore(p, lo, hi):
    """Takes constraint p out of the watch of ``most_violated``."""
    lo[p], hi[p] = -np.inf, np.inf


@compiled
def admit(k, p, above, place, lower, upper, caps, W, places, b, ends):
    """Writes constraint p into slot k of the working set, at its upper (``above``) or its lower bound."""
    W[k], places[k] = (p + 1 if above else -(p + 1)), place
    b[k] = upper[p] if above else lower[p]
    equality = lower[p] == upper[p]
    ends[0, k] = -caps[p] if equality or not above else 0.0
    ends[1, k] = caps[p] if equality or above else 0.0


@compiled
def evict(k, slot, W, places, b, ends, R, scratch):
    """Deletes a slot of the working set of k members and mends the factor."""
    remove_row(R, k, slot, scratch[0], scratch[1])
    place = places[slot]
    for i in range(slot, k - 1):
        W[i], places[i], b[i] = W[i + 1], places[i + 1], b[i + 1]
        ends[0, i], ends[1, i] = ends[0, i + 1], ends[1, i + 1]
    places[k - 1] = place  # free for the next row


@compiled
def make_row(p, n, L, G, row):
    """``row = L^-1 c_p`` for the stacked constraint p; L row-major with reciprocal diagonal."""
    if p < n:
        for i in range(p):
            row[i] = 0.0
        row[p] = L[p, p]
        for i in range(p + 1, n):
            row[i] = -dot(L[i, p:], row[p:], i - p) * L[i, i]
    else:
        c = G[p - n]
        for i in range(n):
            row[i] = (c[i] - dot(L[i], row, i)) * L[i, i]


@compiled
def place_state(state, n, L, G, y):
    """``y = C L^-T state``: the stacked constraint values of the lazy mode's state."""
    for i in range(n):
        y[i] = state[i]
    for i in range(n - 1, -1, -1):
        value = y[i] * L[i, i]
        y[i] = value
        row = L[i]
        for j in range(i):
            y[j] -= value * row[j]
    for p in range(len(G)):
        y[n + p] = dot(G[p], y, n)


@compiled
def take_guess(
    lazy, n, codes, rows, L, G, lower, upper, slack, softness, caps, capacity, mu, lo, hi, W, places, b, ends, R
):
    """Factors the guessed working set ``codes``, leaving out whatever is absurd, absent or dependent; returns its size."""
    M, size, k = len(lower), rows.shape[1], 0
    for code in codes:
        p = int(abs(code)) - 1 if 1.0 <= abs(code) <= M else NO_CONSTRAINT
        if p < 0 or k == capacity or mu[p] != 0.0 or (lo[p] == -np.inf and hi[p] == np.inf):
            continue
        above = code > 0.0
        if abs(upper[p] if above else lower[p]) == np.inf:
            continue
        place, solved = p, R[k * (k + 1) // 2 :]
        if lazy:
            place = places[k]
            make_row(p, n, L, G, rows[place])
            for i in range(k):
                solved[i] = dot(rows[places[i]], rows[place], size)
            diagonal = dot(rows[place], rows[place], size) + softness[p]
        else:
            for i in range(k):
                solved[i] = rows[p, abs(W[i]) - 1]
            diagonal = rows[p, p]
        forward_solve(R, k, solved)
        pivot = diagonal - dot(solved, solved, k)
        if pivot > GUESSED_PIVOT * diagonal:
            append_row(R, k, solved, pivot)
            admit(k, p, above, place, lower, upper, caps, W, places, b, ends)
            ignore(p, lo, hi)
            k += 1
    return k


@compiled
def settle_guess(lazy, k, n, rows, state, lower, upper, slack, mu, lo, hi, W, places, b, ends, R, scratch):
    """Solves for the multipliers of the guess and drops the most wrong one until all are admissible; returns the size."""
    size = rows.shape[1]
    trial = scratch[2]
    while k > 0:
        for i in range(k):
            trial[i] = (dot(rows[places[i]], state, size) if lazy else state[abs(W[i]) - 1]) - b[i]
        forward_solve(R, k, trial)
        backward_solve(R, k, trial)
        worst, slot = 0.0, -1
        for i in range(k):
            outside = max(trial[i] - ends[1, i], ends[0, i] - trial[i])
            if outside > worst:
                worst, slot = outside, i
        if slot < 0:
            break
        p = abs(W[slot]) - 1
        evict(k, slot, W, places, b, ends, R, scratch)
        k -= 1
        watch(p, mu, lower, upper, slack, lo, hi)
    for i in range(k):
        mu[abs(W[i]) - 1] = trial[i]
    subtract_rows(state, rows, places, trial, k, size)
    return k


@compiled
def step_to(
    lazy, p, k, n, rows, L, G, state, y, lower, upper, slack, softness, caps, capacity, mu, lo, hi, W, places, b, ends, R,
    scratch,
):  # fmt: skip
    """Moves until constraint p is satisfied; returns the outcome, the size of the working set and the evictions."""
    size, steps = rows.shape[1], 0
    above = mu[p] > 0.0 or (mu[p] == 0.0 and y[p] > upper[p])
    sense = -1.0 if (mu[p] > 0.0 or (mu[p] == 0.0 and not above)) else 1.0
    row_norm = 0.0
    place = p
    if lazy:
        place = places[k]
        make_row(p, n, L, G, rows[place])
        row_norm = dot(rows[place], rows[place], size) + softness[p]
    else:
        row_norm = rows[p, p]
    row = rows[place]
    r, direction = scratch[2], scratch[3]
    violation = (y[p] - (upper[p] if above else lower[p])) * sense
    while True:
        admit(k, p, above, place, lower, upper, caps, W, places, b, ends)
        solved = R[k * (k + 1) // 2 :]
        if lazy:
            for i in range(k):
                solved[i] = dot(rows[places[i]], row, size)
        else:
            for i in range(k):
                solved[i] = row[abs(W[i]) - 1]
        forward_solve(R, k, solved)
        for i in range(k):
            r[i] = solved[i]
        backward_solve(R, k, r)
        for j in range(size):
            direction[j] = row[j]
        subtract_rows(direction, rows, places, r, k, size)
        if lazy:
            d = dot(direction, direction, size) + softness[p]
            for i in range(k):
                d += softness[abs(W[i]) - 1] * r[i] * r[i]
        else:
            d = row_norm - dot(solved, solved, k)
        free = d > ENTERING_PIVOT * row_norm and k < capacity
        step = max(0.0, violation) / d if free else np.inf
        blocking = k
        own = (ends[1, k] - mu[p]) if sense > 0.0 else (mu[p] - ends[0, k])
        capped = own < step
        if capped:
            step = own
        largest = 0.0
        for i in range(k):
            largest = max(largest, abs(r[i]))
        for i in range(k):
            rate = sense * r[i]
            if abs(rate) > 1e-12 * largest:
                value = mu[abs(W[i]) - 1]
                room = (value - ends[0, i]) / rate if rate > 0.0 else (value - ends[1, i]) / rate
                if room < step:
                    step, blocking = max(room, 0.0), i
        if step == np.inf:
            return CONTRADICTION, k, steps
        for i in range(k):
            mu[abs(W[i]) - 1] -= sense * step * r[i]
        mu[p] += sense * step
        if free:
            for j in range(size):
                state[j] -= sense * step * direction[j]
            violation -= step * d
        if blocking < k:
            leaving = abs(W[blocking]) - 1
            rate = sense * r[blocking]
            mu[leaving] = ends[0, blocking] if rate > 0.0 else ends[1, blocking]
            evict(k, blocking, W, places, b, ends, R, scratch)
            k -= 1
            if lazy:  # the entering row keeps its place: it moves from slot k + 1 to slot k
                places[k + 1] = places[k]
            steps += 1
            watch(leaving, mu, lower, upper, slack, lo, hi)
            continue
        if capped:
            mu[p] = ends[1, k] if sense > 0.0 else ends[0, k]
            watch(p, mu, lower, upper, slack, lo, hi)
        else:
            append_row(R, k, solved, d)
            ignore(p, lo, hi)
            k += 1
        if lazy:
            place_state(state, n, L, G, y)
        return REACHED, k, steps + 1
