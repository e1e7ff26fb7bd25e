"""Families of small programs that are awkward for floating point."""

import numpy as np

from gpmpc.qp import QuadraticProgram


def base(rng, feasible=True, whole=False):
    """Draws P, q, G and stacked bounds of a program of up to four variables.

    Numbers are small integers or normally distributed.
    """
    n = int(rng.integers(1, 5))
    m = int(rng.integers(1, 7))
    draw = (
        (lambda *shape: rng.integers(-3, 4, shape).astype(float))
        if whole
        else (lambda *s: rng.standard_normal(s))
    )
    root = draw(n, n)
    P = root @ root.T + np.eye(n) * (1.0 if whole else 0.1)
    q = 3.0 * draw(n)
    G = draw(m, n)
    P = (P + P.T) / 2
    C = np.vstack([np.eye(n), G])
    centre = C @ draw(n)
    widths = (
        rng.integers(0, 3, (2, n + m)) if whole else rng.uniform(0.0, 2.0, (2, n + m))
    )
    lower = centre - widths[0]
    upper = centre + widths[1]
    if not feasible:
        shift = 2.0 * draw(n + m)
        lower = lower + shift
        upper = upper + shift
    lower[rng.random(n + m) < 0.4] = -np.inf
    upper[rng.random(n + m) < 0.4] = np.inf
    return P, q, G, lower, upper


def program(P, q, G, lower, upper):
    return QuadraticProgram.from_stacked(P, q, G, lower, np.maximum(lower, upper))


def magnitude(rng, low, high):
    return 10.0 ** rng.uniform(low, high)


def huge_bounds(rng):
    """A bound, or a variable's or row's place, of 1e3 to 1e15 (or 1e19).

    The others are of order one; there are equalities, too.
    """
    P, q, G, lower, upper = base(rng)
    n = len(q)
    M = len(lower)
    for p in np.flatnonzero(rng.random(M) < 0.6):
        size = 1e19 if rng.random() < 0.1 else magnitude(rng, 3, 15)
        kind = rng.integers(0, 4)
        if kind == 0:
            lower[p] = -size
        elif kind == 1:
            upper[p] = size
        elif kind == 2:
            lower[p] = -size
            upper[p] = size * rng.uniform(0.1, 1.0)
        elif p >= n and np.isfinite(upper[p]):
            lower[p] = upper[p]
    if rng.random() < 0.2:  # the whole program far from zero
        far = magnitude(rng, 3, 12) * rng.standard_normal(n)
        values = np.vstack([np.eye(n), G]) @ far
        q = q - P @ far
        lower = lower + values
        upper = upper + values
    return program(P, q, G, lower, upper)


def nearly_infeasible(rng):
    """Rows that contradict each other by 1e-3 to 1e-12, or miss that by as much.

    They are two rows, three, or a row and the box.
    """
    P, q, G, lower, upper = base(rng)
    n = len(q)
    size = magnitude(rng, -3, 3)
    gap = rng.choice([-1.0, 1.0]) * magnitude(rng, -12, -3) * size
    lower[:] = np.where(rng.random(len(lower)) < 0.7, -np.inf, lower)
    upper[:] = np.where(rng.random(len(upper)) < 0.7, np.inf, upper)
    a = rng.standard_normal(n)
    kind = rng.integers(0, 3)
    if kind == 0:
        scale = rng.choice([1.0, 2.0, magnitude(rng, -3, 3)])
        more = [a, scale * a]
        low = [-np.inf, scale * (size + gap)]
        high = [size, np.inf]
    elif kind == 1:
        b = rng.standard_normal(n)
        more = [a, b, a + b]
        low = [-np.inf, -np.inf, 2.0 * size + gap]
        high = [size, size, np.inf]
    else:
        more = [np.abs(a)]
        low = [np.abs(a).sum() * size + gap]
        high = [np.inf]
        lower[:n] = -np.inf
        upper[:n] = size
    order = rng.permutation(len(G) + len(more))
    G = np.vstack([G, more])[order]
    lower[n:], upper[n:] = lower[n:], upper[n:]
    lower = np.concatenate([lower[:n], np.concatenate([lower[n:], low])[order]])
    upper = np.concatenate([upper[:n], np.concatenate([upper[n:], high])[order]])
    return program(P, q, G, lower, upper)


def parallel_rows(rng):
    """Zero rows, and rows that repeat others or combinations of them, scaled.

    They do so exactly or up to 1e-3 .. 1e-13.
    """
    P, q, G, lower, upper = base(rng, whole=rng.random() < 0.5)
    n = len(q)
    G = list(G)
    low = list(lower[n:])
    high = list(upper[n:])
    for _ in range(int(rng.integers(1, 4))):
        kind, i, j = rng.integers(0, 4), *rng.integers(0, len(G), 2)
        scale = rng.choice([1.0, -1.0, 2.0, 0.125, magnitude(rng, -6, 6)])
        if kind == 0:
            G.append(np.zeros(n))
            low.append(-np.inf)
            high.append(float(rng.choice([0.0, 1.0, -1e-17, 1e-17, -1e-3])))
            continue
        row = G[i] if kind < 3 else G[i] + G[j]
        values = (low[i], high[i]) if kind < 3 else (low[i] + low[j], high[i] + high[j])
        values = sorted(scale * v for v in values)
        if kind == 2:
            row = row + magnitude(rng, -13, -3) * rng.integers(-2, 3, n)
            values[1] += abs(scale) * magnitude(rng, -13, -3) * rng.integers(-2, 3)
        G.append(scale * row)
        low.append(values[0])
        high.append(values[1])
    return program(
        P,
        q,
        np.array(G),
        np.concatenate([lower[:n], low]),
        np.concatenate([upper[:n], high]),
    )


def small_direction(rng):
    """Equalities that leave a small share of one variable.

    1e-3 to 1e-12, and the solution as far away as it asks.
    """
    n = int(rng.integers(2, 5))
    share = magnitude(rng, -12, -3)
    G = np.eye(n)
    G[-1] = 1.0
    G[-1, -1] = share
    b = np.append(rng.integers(-2, 3, n - 1), 0.0) * float(rng.random() < 0.5)
    b[-1] = b[:-1].sum() + share * magnitude(rng, -3, 4)
    P = np.eye(n)
    q = rng.standard_normal(n) * float(rng.random() < 0.5)
    upper = b if rng.random() < 0.7 else np.full(n, np.inf)
    order = rng.permutation(n)
    return program(
        P,
        q,
        G[order],
        np.concatenate([np.full(n, -np.inf), b[order]]),
        np.concatenate([np.full(n, np.inf), upper[order]]),
    )


def scaled(rng):
    """Data, cost, rows or variables (one or several) multiplied by 1e-12 .. 1e12."""
    P, q, G, lower, upper = base(rng, feasible=rng.random() < 0.9)
    n = len(q)
    m = len(G)
    kinds = rng.random(4) < 0.4
    if kinds[0]:
        s = magnitude(rng, -12, 12)
        P = s * P
        q = s * q
        G = s * G
        lower = s * lower
        upper = s * upper
    if kinds[1]:
        s = magnitude(rng, -12, 12)
        P = s * P
        q = s * q
    if kinds[2]:
        s = 10.0 ** rng.uniform(-12, 12, m)
        G = s[:, None] * G
        lower = lower.copy()
        upper = upper.copy()
        lower[n:], upper[n:] = s * lower[n:], s * upper[n:]
    if kinds[3]:
        s = magnitude(rng, -12, 12) ** (
            rng.uniform(-1, 1, n) if rng.random() < 0.7 else np.ones(n)
        )
        P = P * np.outer(s, s)
        q = q * s
        G = G * s
        lower = lower.copy()
        upper = upper.copy()
        P = (P + P.T) / 2
        lower[:n], upper[:n] = lower[:n] / s, upper[:n] / s
    finite = np.concatenate([lower, upper])
    finite = np.abs(finite[np.isfinite(finite)])
    return program(P, q, G, lower, upper) if (finite < 1e20).all() else scaled(rng)


def small_numbers(rng):
    """The matrices of order one, and q and the bounds of order 1e-3 .. 1e-15.

    The solution is that small.
    """
    P, q, G, lower, upper = base(rng)
    s = magnitude(rng, -15, -3)
    return program(P, s * q, G, s * lower, s * upper)


def degenerate(rng):
    """Small integers.

    Ties, and vertices met by more rows than variables, on which the solution often
    lies.
    """
    P, q, G, lower, upper = base(rng, whole=True)
    n = len(q)
    vertex = rng.integers(-2, 3, n).astype(float)
    G = np.vstack([G, rng.integers(-2, 3, (int(rng.integers(n, 3 * n + 3)), n))])
    values = G @ vertex
    upper = np.concatenate([np.full(n, np.inf), values])
    lower = np.where(
        rng.random(n + len(G)) < 0.2,
        np.concatenate([vertex - 2.0, values - 3.0]),
        -np.inf,
    )
    if rng.random() < 0.5:
        q = -P @ vertex - G.T @ rng.integers(0, 2, len(G))
    return program(P, q.astype(float), G, lower, upper)


def equalities(rng):
    """Equalities in place of rows, no fewer than variables, that agree or do not."""
    P, q, G, lower, upper = base(rng, whole=rng.random() < 0.7)
    n = len(q)
    m = len(G)
    b = G @ rng.integers(-3, 4, n)
    if rng.random() < 0.3:
        b = b + rng.integers(0, 2, m) * magnitude(rng, -9, 0)
    some = rng.random(m) < 0.7
    lower[n:], upper[n:] = np.where(some, b, lower[n:]), np.where(some, b, upper[n:])
    return program(P, q, G, lower, upper)


FAMILIES = {
    function.__name__: function
    for function in (
        huge_bounds,
        nearly_infeasible,
        parallel_rows,
        small_direction,
        scaled,
        small_numbers,
        degenerate,
        equalities,
    )
}
