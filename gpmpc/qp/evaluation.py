"""The point that belongs to a set of multipliers, and how well the two solve the QP.

x minimises the Lagrangian, P x = -(q + C'mu), and y = C x are the constraints' values. Gram mode multiplies with P^-1,
the upper left corner of K, and may later move y by the rows of K whose multipliers changed; lazy mode, P = L L', solves.
"""

from gpmpc.qp.compiled import compiled
from gpmpc.qp.factor import backward_solve, dot, forward_solve, multiply, subtract_rows
from gpmpc.qp.working_set import BOUND, LEAST, MOST, NAME, PLACE, SOFTNESS


@compiled
def solve_transposed(L, n, a):
    """``a <- L^-T a``; the diagonal of L holds reciprocals."""
    for i in range(n - 1, -1, -1):
        row = L[i]
        value = a[i] * row[i]
        a[i] = value
        for j in range(i):
            a[j] -= value * row[j]


@compiled
def add_pull(G, n, q, mu, slope):
    """``slope = q + C' mu``."""
    for i in range(n):
        slope[i] = q[i] + mu[i]
    for p in range(n, len(mu)):
        if mu[p] != 0.0:
            weight, row = mu[p], G[p - n]
            for i in range(n):
                slope[i] += weight * row[i]


@compiled
def evaluate(lazy, n, q, rows, L, G, mu, seen, y, slope):
    """``y = C x`` for the multipliers, from scratch; ``seen`` (M) then holds the multipliers that y knows.

    Leaves ``slope = q + C' mu``.
    """
    for p in range(len(mu)):
        seen[p] = mu[p]
    add_pull(G, n, q, mu, slope)
    if lazy:
        for i in range(n):
            y[i] = -(slope[i] + dot(L[i], y, i)) * L[i, i]
        solve_transposed(L, n, y)
    else:
        multiply(rows, 0, n, slope, n, y)
        for i in range(n):
            y[i] = -y[i]
    multiply(G, 0, len(G), y, n, y[n:])


@compiled
def follow(rows, mu, seen, changed, amounts, y):
    """Gram mode: moves y by the rows of K whose multipliers are not those that y knows."""
    count = 0
    for p in range(len(mu)):
        if mu[p] != seen[p]:
            changed[count], amounts[count] = p, mu[p] - seen[p]
            seen[p] = mu[p]
            count += 1
    subtract_rows(y, rows, changed, amounts, count, len(mu))


@compiled
def residuals(P, q, n, traits, mu, k, slots, members, y, slope, gradient, active):
    """The scaled residuals of (x, mu), x = y[:n]: stationarity and violation of the working set, from P, q and G.

    Fills ``gradient = P x + slope`` and ``active = y_W - softness mu_W - b``, where y = C x and slope = q + C' mu.
    """
    multiply(P, 0, n, y, n, gradient)
    size, stationarity, infeasibility = 1.0, 0.0, 0.0
    for i in range(n):
        size = max(size, max(abs(gradient[i]), abs(q[i])))
        gradient[i] += slope[i]
        stationarity = max(stationarity, abs(gradient[i]))
    for i in range(k):
        p, b = abs(members[NAME, i]) - 1, slots[BOUND, i]
        active[i] = y[p] - traits[SOFTNESS, p] * mu[p] - b
        infeasibility = max(infeasibility, abs(active[i]) / max(1.0, abs(b)))
    return stationarity / size, infeasibility


@compiled
def refine(lazy, k, n, q, rows, L, G, slots, members, R, mu, y, slope, gradient, active, correction, trial):
    """One Newton step on the working set for the residuals ``gradient`` and ``active``; multipliers stay in range."""
    size = n if lazy else len(y)
    if lazy:
        for i in range(n):
            correction[i] = (gradient[i] - dot(L[i], correction, i)) * L[i, i]
    else:
        multiply(rows, 0, size, gradient, n, correction)
    for i in range(k):
        name, place = abs(members[NAME, i]) - 1, members[PLACE, i]
        trial[i] = active[i] - (dot(rows[place], correction, n) if lazy else correction[name])
    forward_solve(R, k, trial)
    backward_solve(R, k, trial)
    for j in range(size):
        correction[j] = -correction[j]
    subtract_rows(correction, rows, members[PLACE], trial, k, size)
    if lazy:
        solve_transposed(L, n, correction)
    for i in range(n):
        y[i] += correction[i]
    for i in range(k):
        p = abs(members[NAME, i]) - 1
        mu[p] = min(max(mu[p] + trial[i], slots[LEAST, i]), slots[MOST, i])
    multiply(G, 0, len(G), y, n, y[n:])
    add_pull(G, n, q, mu, slope)
