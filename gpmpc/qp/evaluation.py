"""The point that belongs to a set of multipliers, and how well the two solve the QP.

x minimises the Lagrangian, P x = -(q + C'mu), and y = C x are the constraints' values. Gram mode multiplies with P^-1
and may later move y by the rows of K whose multipliers changed; lazy mode, P = L'L, solves. What is called L is the
transposed G in Gram mode, which adds its rows faster than it multiplies those of G.
"""

import math

import numpy as np

from gpmpc.compiled import woven
from gpmpc.qp.factor import backward_solve, dot, forward_solve, four_dots, multiply, subtract_rows
from gpmpc.qp.hessian import solve_lower, solve_transposed
from gpmpc.qp.lanes import (
    any_nonzero,
    combine,
    lanes,
    larger,
    largest,
    less,
    no_lanes,
    plus,
    product,
    put,
    some_lanes,
    total,
)
from gpmpc.qp.working_set import (
    BOUND,
    CAP,
    END,
    FLOOR,
    LEAST,
    LOWER,
    MOST,
    NAME,
    PLACE,
    SCALE,
    SCRATCH,
    SOFTNESS,
    UPPER,
    couple,
)
from gpmpc.qp.workspace import padded

TINY = 1e-300
UNDEFINED = 1e300  # a residual that overflowed; less than infinity, so that refinement is tried


@woven
def add_pull(G, n, q, mu, k, members, traits, soft, slope):
    """``slope = q + C' mu``; only where rows are soft can others than the working ones have a multiplier."""
    for i in range(n):
        slope[i] = q[i] + mu[i]
    if soft:
        for p in range(n, len(mu)):
            if mu[p] != 0.0:
                add_row(mu[p], G[p - n], int(traits[END, p]), slope)
    else:
        for i in range(k):
            p = abs(members[NAME, i]) - 1
            if p >= n:
                add_row(mu[p], G[p - n], int(traits[END, p]), slope)


@woven
def add_row(weight, row, n, target):
    """``target += weight row``."""
    for i in range(n):
        target[i] += weight * row[i]


@woven
def evaluate(lazy, n, q, inverse, L, G, mu, k, members, traits, soft, slope, y):
    """``y = C x`` for the multipliers; leaves ``slope = q + C' mu``."""
    add_pull(G, n, q, mu, k, members, traits, soft, slope)
    if lazy:
        for i in range(n):
            y[i] = slope[i]
        solve_transposed(L, n, y)
        solve_lower(L, n, y)
    else:
        combine(inverse, n, slope, 0, n, y)  # which is symmetric
    for i in range(n):
        y[i] = -y[i]
    row_values(lazy, L, G, n, traits, y)


@woven
def row_values(lazy, L, G, n, traits, y):
    """``y[n:] = G y[:n]``, several rows at a time, as far as they may not be zero."""
    product, ends, m = y[n:], traits[END, n:], len(G)
    p = 0
    if not lazy:
        while p < m:
            size = min(16, m - p)
            combine(L, int(ends[p + size - 1]), y, p, size, product)
            p += size
    while p + 4 <= m:
        size = int(max(max(ends[p], ends[p + 1]), max(ends[p + 2], ends[p + 3])))
        four_dots(G[p], G[p + 1], G[p + 2], G[p + 3], y, size, product[p:])
        p += 4
    while p < m:
        product[p] = dot(G[p], y, n)
        p += 1


@woven
def follow_lazily(n, v, rows, L, mu, k, members, weights, y):
    """Lazy mode without soft rows: x from ``L x = v - sum mu_i w_i``."""
    for i in range(n):
        y[i] = v[i]
    for i in range(k):
        weights[i] = mu[abs(members[NAME, i]) - 1]
    subtract_rows(y, rows, members[PLACE], weights, k, n)
    solve_lower(L, n, y)


@woven
def changes_since(mu, seen, changed, amounts):
    """Lists the multipliers that are not those, ``seen``, that y knows; returns how many."""
    count, M = 0, len(mu)
    for start in range(0, M, 8):
        if any_nonzero(less(some_lanes(mu, start), 1.0, some_lanes(seen, start))):
            for p in range(start, min(start + 8, M)):
                if mu[p] != seen[p]:
                    changed[count], amounts[count] = p, mu[p] - seen[p]
                    count += 1
    return count


@woven
def follow(rows, mu, seen, changed, amounts, y):
    """Gram mode: moves y by the rows of K whose multipliers are not those, ``seen``, that y knows."""
    count = changes_since(mu, seen, changed, amounts)
    for i in range(count):
        seen[changed[i]] = mu[changed[i]]
    subtract_rows(y, rows, changed, amounts, count, len(mu))


@woven
def follow_listed(lazy, n, v, rows, L, G, mu, k, members, traits, seen, weights, y, listed, count, now):
    """The values ``now`` of a few constraints, without those of all others (in lazy mode y then begins with x)."""
    if lazy:
        follow_lazily(n, v, rows, L, mu, k, members, weights, y)
        for i in range(count):
            p = listed[i]
            now[p] = y[p] if p < n else dot(G[p - n], y, int(traits[END, p]))
    else:
        changed = members[SCRATCH]
        changes = changes_since(mu, seen, changed, weights)
        for i in range(count):
            p = listed[i]
            row, value = rows[p], y[p]
            for c in range(changes):
                value -= weights[c] * row[changed[c]]
            now[p] = value


@woven
def residuals(lazy, P, G, n, traits, mu, k, slots, members, y, slope, least, gradient, active):
    """The largest residual of stationarity and of the working constraints, as a share of x = y[:n], y = C x.

    The length of x is that in the metric of P, at least ``least``, so that neither the units of the data nor a cost of
    another size hide an error of x. A hundredth of the error is also measured by the largest entry of x, and that of a
    row by its bound or its own terms. ``UNDEFINED`` where a number that it is made of is not finite: comparisons alone
    would pass over NaN.

    Fills ``gradient = P x + slope`` and ``active = y_W - softness mu_W - b``, where slope = q + C' mu. The vectors
    gradient and slope are padded with zeros.
    """
    if lazy:
        multiply(P, n, y, n, gradient)
        for i in range(n, padded(n)):
            gradient[i] = 0.0
    else:
        combine(P, n, y, 0, n, gradient)
    size = math.sqrt(max(dot(gradient, y, n), least * least, TINY))
    lengths, entries, shifts, undefined, scales = no_lanes(), no_lanes(), no_lanes(), no_lanes(), traits[SCALE]
    for i in range(0, n, 8):
        pull, scale = plus(lanes(gradient, i), 1.0, lanes(slope, i)), lanes(scales, i)
        put(gradient, i, pull)
        length = product(pull, scale)
        lengths, shifts = larger(lengths, length), larger(shifts, product(length, scale))
        entries, undefined = larger(entries, some_lanes(y[:n], i)), plus(undefined, 0.0, pull)
    worst, undefined_sum = largest(lengths) / size, total(undefined)
    worst = max(worst, 0.01 * largest(shifts) / max(largest(entries), TINY))
    for i in range(k):
        p, b = abs(members[NAME, i]) - 1, slots[BOUND, i]
        active[i] = y[p] - traits[SOFTNESS, p] * mu[p] - b
        rest, length = abs(active[i]), size * scales[p]
        undefined_sum += 0.0 * rest
        if rest > 1e-15 * length:  # then by the row's own terms too
            own = max(abs(b), 1e-6 * length)
            if p >= n and rest > 1e-9 * own:
                row = G[p - n]
                for j in range(int(traits[END, p])):
                    own = max(own, abs(row[j] * y[j]))
            worst = max(worst, max(rest / length, 1e-2 * rest / own))
    return worst if worst + undefined_sum + size < np.inf else UNDEFINED


@woven
def worst_violation(n, y, mu, slope, traits, bounds, least):
    """The largest violation beyond what multipliers pay for, as a share of its bound or, a thousandth, of x."""
    worst, size = 0.0, math.sqrt(max(abs(dot(slope, y, n)), least * least))
    for p in range(len(y)):
        if abs(mu[p]) < traits[CAP, p]:
            above, below, paid = y[p] - bounds[UPPER, p], bounds[LOWER, p] - y[p], traits[SOFTNESS, p] * abs(mu[p])
            bound = bounds[UPPER if above > below else LOWER, p]
            rest = max(above, below) - paid - bounds[FLOOR, p]
            worst = max(worst, rest / max(1e-3 * size * traits[SCALE, p], abs(bound)))
    return worst


@woven
def refine(lazy, k, n, rows, L, G, slots, members, traits, R, mu, y, gradient, active, correction, trial):
    """One Newton step on the working set for the residuals ``gradient`` and ``active``; multipliers stay in range."""
    size = n if lazy else len(y)
    if lazy:
        for i in range(n):
            correction[i] = gradient[i]
        solve_transposed(L, n, correction)
    else:
        multiply(rows, size, gradient, n, correction)
    couple(lazy, correction, k, n, rows, members, trial)
    for i in range(k):
        trial[i] = active[i] - trial[i]
    forward_solve(R, k, trial)
    backward_solve(R, k, trial)
    for j in range(size):
        correction[j] = -correction[j]
    subtract_rows(correction, rows, members[PLACE], trial, k, size)
    if lazy:
        solve_lower(L, n, correction)
    for i in range(n):
        y[i] += correction[i]
    for i in range(k):
        p = abs(members[NAME, i]) - 1
        mu[p] = min(max(mu[p] + trial[i], slots[LEAST, i]), slots[MOST, i])
    row_values(lazy, L, G, n, traits, y)
