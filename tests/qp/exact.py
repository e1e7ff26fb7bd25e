"""Quadratic programs solved in rational arithmetic.

Nothing is rounded there, and nothing needs a tolerance.

A float is a rational number, so a program has one exact answer. It is found by the dual
method of Goldfarb and Idnani (1983), which cannot cycle because each full step raises
the dual objective, and proven before it is returned: a minimiser by the conditions of
Karush, Kuhn and Tucker, an infeasibility by Farkas' lemma.
"""

from fractions import Fraction

import numpy as np


def exact_solution(problem, lower=None, upper=None):
    """The minimiser (n,) as Fractions, or None if no point is feasible.

    Args:
        problem: A ``QuadraticProgram`` of a few variables, with hard rows.
        lower: (M,) bounds to use in place of the program's own.
        upper: (M,) likewise.
    """
    P = rational(problem.P)
    q = rational(problem.q)
    G = rational(problem.G)
    n = len(q)
    M = len(problem.lower)
    C = np.vstack([rational(np.eye(n)), G])
    low = _bounds(problem.lower if lower is None else lower)
    high = _bounds(problem.upper if upper is None else upper)
    answers = solve_linear(P, np.column_stack([C.T, q]))  # P^-1 [C', q]
    K = C @ answers[:, :M]
    y = -(C @ answers[:, M])
    # constraint: +1 at its upper bound, -1 at its lower one
    mu = zeros(M)
    working = {}
    while True:
        excess = [_excess(y[p], low[p], high[p]) for p in range(M)]
        p = max(range(M), key=lambda i: excess[i] ** 2 / (K[i, i] or 1))
        if excess[p] == 0:
            x = -(answers[:, M] + answers[:, :M] @ mu)
            _prove_optimal(P, q, C, low, high, x, mu)
            return x
        side = 1 if high[p] is not None and y[p] > high[p] else -1
        left = excess[p]
        while True:
            members = list(working)
            r = solve_linear(K[np.ix_(members, members)], K[members, p][:, None])[:, 0]
            direction = K[:, p] - K[:, members] @ r  # of y for a unit of mu_p
            blocks = {
                w: mu[w] / (side * r[i])
                for i, w in enumerate(members)
                if low[w] != high[w] and side * r[i] * working[w] > 0
            }
            leaving = min(blocks, key=blocks.get, default=None)
            full = left / direction[p] if direction[p] > 0 else None
            if full is None and leaving is None:
                ray = zeros(M)
                ray[members] = -side * r
                ray[p] = Fraction(side)
                _prove_infeasible(C, low, high, ray)
                return None
            blocked = full is None or (leaving is not None and blocks[leaving] < full)
            step = blocks[leaving] if blocked else full
            mu[members] -= side * step * r
            mu[p] += side * step
            y = y - side * step * direction
            left = left - step * direction[p]
            if not blocked:
                working[p] = side
                break
            mu[leaving] = Fraction(0)
            del working[leaving]


def rational(array):
    """The same numbers as Fractions."""
    return np.array(
        [Fraction(float(v)) for v in np.ravel(array)], dtype=object
    ).reshape(np.shape(array))


def zeros(*shape):
    return np.full(shape, Fraction(0), dtype=object)


def solve_linear(A, B):
    """``A^-1 B`` by elimination."""
    A, B, n = A.copy(), B.copy(), len(A)
    for i in range(n):
        pivot = next(j for j in range(i, n) if A[j, i] != 0)
        A[[i, pivot]], B[[i, pivot]] = A[[pivot, i]], B[[pivot, i]]
        B[i], A[i] = B[i] / A[i, i], A[i] / A[i, i]
        for j in range(n):
            if j != i and A[j, i] != 0:
                A[j], B[j] = A[j] - A[j, i] * A[i], B[j] - A[j, i] * B[i]
    return B


def _bounds(values):
    """Bounds as fractions; one of size 1e20 or more is none."""
    return [None if abs(v) >= 1e20 else Fraction(float(v)) for v in values]


def _excess(value, low, high):
    return max(
        Fraction(0),
        Fraction(0) if high is None else value - high,
        Fraction(0) if low is None else low - value,
    )


def _prove_optimal(P, q, C, low, high, x, mu):
    assert not (P @ x + q + C.T @ mu).any()
    for value, a, b, multiplier in zip(C @ x, low, high, mu, strict=True):
        assert _excess(value, a, b) == 0
        assert multiplier == 0 or value == (b if multiplier > 0 else a)


def _prove_infeasible(C, low, high, ray):
    assert not (C.T @ ray).any()
    assert (
        sum(
            y * (b if y > 0 else a)
            for y, a, b in zip(ray, low, high, strict=True)
            if y != 0
        )
        < 0
    )
