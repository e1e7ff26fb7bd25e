"""Which constraints are violated, by how much, and which of them enter the working set together."""

import numpy as np

from gpmpc._compiled import inline_njit
from gpmpc._kernels.linalg import dot
from gpmpc.qp._workspace import (
    ALLOWED_HIGH,
    ALLOWED_LOW,
    CANDIDATES,
    END,
    EXCESS,
    LOWER,
    MU,
    NEGLIGIBLE,
    SCALE,
    UPPER,
    VIOLATED,
    Y,
)

TOLERATED = 2e-14  # a violation below this share of the bound is none, whatever the constraint's other bound is


@inline_njit
def restore_limits(vectors, p):
    """Lets constraint p, outside the working set, count as violated again.

    With mu_p = 0 it must stay within its bounds; at a cap it must stay outside the bound that it violates.
    """
    low = vectors[LOWER, p]
    high = vectors[UPPER, p]
    mu = vectors[MU, p]
    allowed_low = low - (TOLERATED * abs(low) + vectors[NEGLIGIBLE, p])
    allowed_high = high + (TOLERATED * abs(high) + vectors[NEGLIGIBLE, p])
    if mu > 0.0:
        allowed_low = high - (TOLERATED * abs(high) + vectors[NEGLIGIBLE, p])
        allowed_high = np.inf
    elif mu < 0.0:
        allowed_low = -np.inf
        allowed_high = low + (TOLERATED * abs(low) + vectors[NEGLIGIBLE, p])
    vectors[ALLOWED_LOW, p] = allowed_low
    vectors[ALLOWED_HIGH, p] = allowed_high


@inline_njit
def ignore_violations(vectors, p):
    """Lets constraint p count as satisfied whatever its value: it is a working one, or cannot be told from one."""
    vectors[ALLOWED_LOW, p] = -np.inf
    vectors[ALLOWED_HIGH, p] = np.inf


@inline_njit
def list_violated(vectors, indices, M, margin):
    """Lists the constraints violated by more than ``margin``, in units of ``SCALE``; returns how many."""
    y = vectors[Y]
    low = vectors[ALLOWED_LOW]
    high = vectors[ALLOWED_HIGH]
    scale = vectors[SCALE]
    excess = vectors[EXCESS]
    violated = indices[VIOLATED]
    count = 0
    for p in range(M):
        excess[p] = max(y[p] - high[p], low[p] - y[p]) - margin * scale[p]
        count += excess[p] > 0.0
    if count > 0:
        count = 0
        for p in range(M):
            if excess[p] > 0.0:
                excess[p] /= scale[p]
                violated[count] = p
                count += 1
    return count


@inline_njit
def keep_violated(work, margin, count):
    """Computes the listed constraints anew, from x = y[:n]; keeps the violated ones, and returns how many."""
    vectors = work.vectors
    y = work.vectors[Y]
    excess = work.vectors[EXCESS]
    violated = work.indices[VIOLATED]
    kept = 0
    n = len(work.q)
    for i in range(count):
        p = violated[i]
        if p >= n:
            y[p] = dot(work.G[p - n], y, int(vectors[END, p]))
        outside = max(y[p] - vectors[ALLOWED_HIGH, p], vectors[ALLOWED_LOW, p] - y[p])
        excess[p] = outside / vectors[SCALE, p] - margin
        if excess[p] > 0.0:
            violated[kept] = p
            kept += 1
    return kept


@inline_njit
def most_violated(vectors, indices, count):
    """Returns the listed constraint with the largest excess."""
    excess = vectors[EXCESS]
    violated = indices[VIOLATED]
    worst = violated[0]
    for i in range(1, count):
        if excess[violated[i]] > excess[worst]:
            worst = violated[i]
    return worst


@inline_njit
def choose_bad(vectors, indices, threshold, count, room):
    """Makes candidates of the listed constraints with an excess above ``threshold``, none at a cap.

    Returns how many there are, at most ``room``; none where but one is that bad.
    """
    candidates = indices[CANDIDATES]
    bad = 0
    chosen = 0
    for i in range(count):
        p = indices[VIOLATED, i]
        if vectors[EXCESS, p] > threshold:
            bad += 1
            if chosen < room and vectors[MU, p] == 0.0:
                candidates[chosen] = (
                    p + 1 if vectors[Y, p] > vectors[UPPER, p] else -(p + 1)
                )
                chosen += 1
    return chosen if bad > 1 else 0


@inline_njit
def choose_guess(vectors, indices, M, names):
    """Makes candidates of the guessed constraints, at no cap, whose bound is there; returns how many."""
    candidates = indices[CANDIDATES]
    chosen = 0
    for name in names:
        if 1.0 <= abs(name) <= M:
            p = int(abs(name)) - 1
            if (
                vectors[MU, p] == 0.0
                and abs(vectors[UPPER if name > 0.0 else LOWER, p]) < np.inf
            ):
                candidates[chosen] = int(name)
                chosen += 1
    return chosen
