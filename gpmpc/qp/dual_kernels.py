"""The two compiled entry points of the dual active set: Gram mode and lazy mode.

Both solve ``min 1/2 x'Px + q'x`` subject to ``lower <= [x; Gx] <= upper`` from a guessed working set and write a record
(``gpmpc.qp.record``). *Gram mode* is for P and G that stay: K = C P^-1 C' is known, and a solve never touches more than
its rows. *Lazy mode* is for P and G that change: it factors P and makes only the rows that it needs.

Nothing is believed without its residuals: the result is recomputed from P, q and G themselves, refined on its working set
by Newton's method (one step is exact but for rounding), and handed back to the iteration while a bound is still violated.
"""

import math

import numpy as np

from gpmpc.qp import record
from gpmpc.qp.compiled import compiled
from gpmpc.qp.dual_iteration import (
    CONTRADICTION,
    NOISE,
    ignore,
    make_row,
    most_violated,
    place_state,
    settle_guess,
    step_to,
    take_guess,
    watch,
)
from gpmpc.qp.factor import backward_solve, dot, forward_solve, subtract_rows

STATUS, ITERATIONS, WORKING, HEADER = record.STATUS, record.ITERATIONS, record.WORKING, record.HEADER
SOLVED, INFEASIBLE, ITERATION_LIMIT = record.SOLVED, record.INFEASIBLE, record.ITERATION_LIMIT
NUMERICAL_TROUBLE, MISUSE = record.NUMERICAL_TROUBLE, record.MISUSE

GRAM_SIGNATURE = "i8(f8[::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])"
LAZY_SIGNATURE = "i8(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], f8[::1])"

ABSENT = 1e20  # a bound of this size or more is none
SLACK = 1e-10  # a violation below this share of the size of a constraint is none
ROUNDS = 10  # returns from the residuals to the iteration
REFINEMENTS = 3
FINE = 1e-12  # scaled residual at which refinement stops


@compiled
def read_bounds(given_lower, given_upper, norms, lower, upper, slack, lo, hi):
    """Copies the bounds, with absent ones infinite; True if any are crossed or undefined."""
    bad = False
    for p in range(len(lower)):
        low, high = given_lower[p], given_upper[p]
        bad |= not (low <= high and low < ABSENT and high > -ABSENT)
        low = low if low > -ABSENT else -np.inf
        high = high if high < ABSENT else np.inf
        size = norms[p]
        if low > -np.inf:
            size = max(size, abs(low))
        if high < np.inf:
            size = max(size, abs(high))
        lower[p], upper[p], slack[p] = low, high, SLACK * size
        lo[p], hi[p] = low - slack[p], high + slack[p]
    return bad


@compiled
def residuals(P, q, G, n, lower, upper, softness, caps, mu, W, k, b, x, y, gradient, active):
    """The scaled residuals of (x, mu): stationarity, and the larger of the working set's and the others' violation.

    Fills ``y = C x``, ``gradient = P x + q + C' mu`` and ``active = y_W - softness mu_W - b``.
    """
    size = 1.0
    for i in range(n):
        value = dot(P[i], x, n)
        gradient[i] = value + q[i]
        size = max(size, abs(value), abs(q[i]))
    for i in range(n):
        y[i] = x[i]
        gradient[i] += mu[i]
    for p in range(n, len(y)):
        y[p] = dot(G[p - n], x, n)
        if mu[p] != 0.0:
            weight, row = mu[p], G[p - n]
            for i in range(n):
                gradient[i] += weight * row[i]
    stationarity = 0.0
    for i in range(n):
        stationarity = max(stationarity, abs(gradient[i]))
    feasibility = 0.0
    for i in range(k):
        p = abs(W[i]) - 1
        active[i] = y[p] - softness[p] * mu[p] - b[i]
        feasibility = max(feasibility, abs(active[i]) / max(1.0, abs(b[i])))
    return stationarity / size, feasibility


@compiled
def refine(lazy, k, n, rows, L, G, W, places, R, ends, mu, state, x, gradient, active, correction, trial, change):
    """One Newton step on the working set for the residuals ``gradient`` and ``active``; multipliers stay admissible."""
    size = rows.shape[1]
    if lazy:
        for i in range(n):
            correction[i] = (gradient[i] - dot(L[i], correction, i)) * L[i, i]
    else:
        for j in range(size):
            correction[j] = 0.0
        for i in range(n):
            weight, row = gradient[i], rows[i]
            for j in range(size):
                correction[j] += weight * row[j]
    for i in range(k):
        trial[i] = active[i] - (dot(rows[places[i]], correction, size) if lazy else correction[abs(W[i]) - 1])
    forward_solve(R, k, trial)
    backward_solve(R, k, trial)
    for j in range(size):
        correction[j] = -correction[j]
    subtract_rows(correction, rows, places, trial, k, size)
    if lazy:
        place_state(correction, n, L, G[:0], change)
        for i in range(n):
            x[i] += change[i]
            state[i] += correction[i]
    else:
        for i in range(n):
            x[i] += correction[i]
    for i in range(k):
        p = abs(W[i]) - 1
        mu[p] = min(max(mu[p] + trial[i], ends[0, i]), ends[1, i])


@compiled
def keep_capped(lazy, n, rows, L, G, lower, upper, slack, caps, warm, mu, lo, hi, state, scratch):
    """Starts with the guess's multipliers that are at their caps: soft rows that stay violated."""
    size, M = rows.shape[1], len(lower)
    for p in range(n, M):
        value = warm[HEADER + n + p]
        if abs(value) >= caps[p] and abs(upper[p] if value > 0.0 else lower[p]) < np.inf:
            mu[p] = caps[p] if value > 0.0 else -caps[p]
            watch(p, mu, lower, upper, slack, lo, hi)
            row = scratch if lazy else rows[p]
            if lazy:
                make_row(p, n, L, G, row)
            for j in range(size):
                state[j] -= mu[p] * row[j]


@compiled
def write_ray(p, k, y, lower, upper, W, r, mu):
    """Farkas' proof that constraint p contradicts the working ones, ``C' ray = 0`` and ``ray' bounds < 0``, into mu."""
    sense = 1.0 if y[p] > upper[p] else -1.0
    mu[:] = 0.0
    for i in range(k):
        at = abs(W[i]) - 1
        mu[at] = -sense * r[i]
        if mu[at] * W[i] < 0.0 and lower[at] < upper[at]:
            mu[at] = 0.0  # rounding: this bound cannot pull that way
    mu[p] = sense


@compiled
def optimise(
    lazy, P, q, G, n, rows, L, start, norms, weights, softness, caps, given_lower, given_upper, warm, settings, out
):
    """Both modes after their set-up: ``start`` is the state of the unconstrained minimiser; it is overwritten."""
    M, size = len(given_lower), rows.shape[1]
    limit, tolerance, soft = int(settings[0]), settings[1], settings[2] != 0.0
    capacity = M if soft else min(n, M)
    floats = np.empty(6 * M + 3 * (capacity + 1) + 6 * max(size, capacity + 1) + (capacity + 1) * (capacity + 2) // 2)
    lower, upper, slack = floats[:M], floats[M : 2 * M], floats[2 * M : 3 * M]
    lo, hi, excess = floats[3 * M : 4 * M], floats[4 * M : 5 * M], floats[5 * M : 6 * M]
    at = 6 * M
    b, ends = (
        floats[at : at + capacity + 1],
        floats[at + capacity + 1 : at + 3 * (capacity + 1)].reshape(2, capacity + 1),
    )
    at += 3 * (capacity + 1)
    wide = max(size, capacity + 1)
    scratch = floats[at : at + 6 * wide].reshape(6, wide)
    R = floats[at + 6 * wide :]
    whole = np.empty(2 * (capacity + 2), np.int64)
    W, places = whole[: capacity + 2], whole[capacity + 2 :]
    x, mu = out[HEADER : HEADER + n], out[HEADER + n : HEADER + n + M]
    for p in range(M):
        mu[p] = 0.0
    for i in range(capacity + 2):
        places[i] = i
    bad = read_bounds(given_lower, given_upper, norms, lower, upper, slack, lo, hi)
    if bad:
        return MISUSE
    state = start
    y = np.empty(M) if lazy else state
    k = 0
    guessed = len(warm) == len(out) and 0 <= warm[WORKING] <= M
    if guessed and soft:
        keep_capped(lazy, n, rows, L, G, lower, upper, slack, caps, warm, mu, lo, hi, state, scratch[0])
    if guessed:
        codes = warm[HEADER + n + M : HEADER + n + M + int(warm[WORKING])]
        k = take_guess(
            lazy, n, codes, rows, L, G, lower, upper, slack, softness, caps, capacity, mu, lo, hi, W, places, b, ends, R
        )
        k = settle_guess(lazy, k, n, rows, state, lower, upper, slack, mu, lo, hi, W, places, b, ends, R, scratch)
    if lazy:
        place_state(state, n, L, G, y)
    iterations, status, rounds = 0, NUMERICAL_TROUBLE, 0
    while True:
        p = most_violated(y, lo, hi, weights, excess, M)
        if p >= 0:
            if iterations >= limit:
                status = ITERATION_LIMIT
                break
            outcome, k, steps = step_to(
                lazy, p, k, n, rows, L, G, state, y, lower, upper, slack, softness, caps, capacity, mu, lo, hi,
                W, places, b, ends, R, scratch,
            )  # fmt: skip
            iterations += steps
            if outcome == CONTRADICTION:
                if excess[p] > NOISE * weights[p] * slack[p] / SLACK:
                    status = INFEASIBLE
                    write_ray(p, k, y, lower, upper, W, scratch[2], mu)
                    break
                ignore(p, lo, hi)
            continue
        for i in range(n):
            x[i] = y[i]
        best = np.inf
        for attempt in range(REFINEMENTS + 1):
            stationarity, feasibility = residuals(
                P, q, G, n, lower, upper, softness, caps, mu, W, k, b, x, y, scratch[0], scratch[1]
            )
            worst = max(stationarity, feasibility)
            if worst <= FINE or attempt == REFINEMENTS or not worst < 0.5 * best:
                break
            best = worst
            refine(
                lazy, k, n, rows, L, G, W, places, R, ends, mu, state, x,
                scratch[0], scratch[1], scratch[2], scratch[3], scratch[4],
            )  # fmt: skip
        status = SOLVED if worst <= tolerance else NUMERICAL_TROUBLE
        rounds += 1
        if rounds == ROUNDS or most_violated(y, lo, hi, weights, excess, M) < 0:
            break
    out[STATUS], out[ITERATIONS], out[WORKING] = status, iterations, k
    for i in range(n):
        x[i] = y[i]
    for i in range(k):
        out[HEADER + n + M + i] = W[i]
    return status


@compiled
def solve_gram(q, lower, upper, warm, system, settings, out):
    """Gram mode; ``system`` stacks K (M rows), norms, weights, softness, caps, P (n rows) and G (m rows), M wide."""
    n, M = int(settings[3]), system.shape[1]
    if len(q) != n or len(lower) != M or len(upper) != M:
        return MISUSE
    state = np.zeros(M)
    undefined = 0.0
    for j in range(n):
        weight, row = q[j], system[j]
        undefined += weight * 0.0
        for p in range(M):
            state[p] -= weight * row[p]
    if undefined != 0.0:
        return MISUSE
    P, G = system[M + 4 : M + 4 + n], system[M + 4 + n :]
    return optimise(
        False, P, q, G, n, system[:M], P, state, system[M], system[M + 1], system[M + 2], system[M + 3],
        lower, upper, warm, settings, out,
    )  # fmt: skip


@compiled
def factorise(P, L):
    """``P = L L'``; the diagonal of L holds reciprocals. False if P is not symmetric, defined and positive definite."""
    n = len(P)
    largest, skew = 0.0, 0.0
    for i in range(n):
        for j in range(i):
            skew = max(skew, abs(P[i, j] - P[j, i]))
        largest = max(largest, P[i, i])
    if not skew <= 1e-10 * largest:
        return False
    for i in range(n):
        row = L[i]
        for j in range(i):
            row[j] = (P[i, j] - dot(row, L[j], j)) * L[j, j]
        pivot = P[i, i] - dot(row, row, i)
        if not (pivot > 0.0 and pivot < np.inf):
            return False
        row[i] = 1.0 / math.sqrt(pivot)
    return True


@compiled
def solve_lazy(P, q, G, lower, upper, warm, soft, settings, out):
    """Lazy mode; ``soft`` stacks softness and caps, M wide."""
    n, m = P.shape[0], len(G)
    M = n + m
    shaped = P.shape[1] == n and len(q) == n and (m == 0 or G.shape[1] == n) and len(lower) == M and len(upper) == M
    if not shaped or soft.shape[1] != M:
        return MISUSE
    L = np.empty((n, n))
    if not factorise(P, L):
        return MISUSE
    norms, weights, state = np.empty(M), np.empty(M), np.empty(n)
    undefined = 0.0
    for i in range(n):
        norms[i], weights[i] = 1.0, 1.0
        undefined += q[i] * 0.0
        state[i] = -(q[i] + dot(L[i], state, i)) * L[i, i]
    for p in range(m):
        norm = math.sqrt(dot(G[p], G[p], n))
        undefined += norm * 0.0
        norms[n + p], weights[n + p] = norm, 1.0 / norm if norm > 0.0 else 1.0
    if undefined != 0.0:
        return MISUSE
    rows = np.empty((min(n, M) + 2 if settings[2] == 0.0 else M + 2, n))
    return optimise(
        True, P, q, G, n, rows, L, state, norms, weights, soft[0], soft[1], lower, upper, warm, settings, out
    )
