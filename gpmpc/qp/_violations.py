"""Which constraints are violated, by how much, and which of them enter the working set together."""

import numpy as np

from gpmpc._compiled import inline_njit
from gpmpc._kernels.linalg import dot

TOLERATED = 2e-14  # a violation below this share of the bound is none, whatever the constraint's other bound is


@inline_njit
def restore_limits(work, p):
    """Lets constraint p, outside the working set, count as violated again.

    With mu_p = 0 it must stay within its bounds; at a cap it must stay outside the bound that it violates.
    """
    low, high = work.lower[p], work.upper[p]
    below, above = TOLERATED * abs(low) + work.negligible[p], TOLERATED * abs(high) + work.negligible[p]
    work.allowed_low[p], work.allowed_high[p] = low - below, high + above
    if work.mu[p] > 0.0:
        work.allowed_low[p], work.allowed_high[p] = high - above, np.inf
    elif work.mu[p] < 0.0:
        work.allowed_low[p], work.allowed_high[p] = -np.inf, low + below


@inline_njit
def ignore_violations(work, p):
    """Lets constraint p count as satisfied whatever its value: it is a working one, or cannot be told from one."""
    work.allowed_low[p], work.allowed_high[p] = -np.inf, np.inf


@inline_njit
def list_violated(work, margin):
    """Lists the constraints violated by more than ``margin``, in units of ``scale``; returns how many."""
    y, low, high, scale, excess, count = work.y, work.allowed_low, work.allowed_high, work.scale, work.excess, 0
    for p in range(len(y)):
        excess[p] = max(y[p] - high[p], low[p] - y[p]) - margin * scale[p]
        count += excess[p] > 0.0
    if count > 0:
        count = 0
        for p in range(len(y)):
            if excess[p] > 0.0:
                excess[p] /= scale[p]
                work.violated[count] = p
                count += 1
    return count


@inline_njit
def keep_violated(work, margin, count):
    """Computes the listed constraints anew, from x = y[:n]; keeps the violated ones, and returns how many."""
    kept, n, y = 0, len(work.x), work.y
    for i in range(count):
        p = work.violated[i]
        if p >= n:
            y[p] = dot(work.G[p - n], y, int(work.end[p]))
        work.excess[p] = max(y[p] - work.allowed_high[p], work.allowed_low[p] - y[p]) / work.scale[p] - margin
        if work.excess[p] > 0.0:
            work.violated[kept] = p
            kept += 1
    return kept


@inline_njit
def most_violated(work, count):
    """Returns the listed constraint with the largest excess."""
    worst = work.violated[0]
    for i in range(1, count):
        if work.excess[work.violated[i]] > work.excess[worst]:
            worst = work.violated[i]
    return worst


@inline_njit
def count_bad(work, threshold, count):
    """Returns how many of the listed constraints have an excess above the threshold."""
    above = 0
    for i in range(count):
        above += work.excess[work.violated[i]] > threshold
    return above


@inline_njit
def choose_bad(work, threshold, count, room):
    """Writes the constraints that ``count_bad`` counts to the candidates, at most ``room``, none at a cap; how many."""
    chosen = 0
    for i in range(count):
        p = work.violated[i]
        if work.excess[p] > threshold and chosen < room and work.mu[p] == 0.0:
            work.candidates[chosen] = p + 1 if work.y[p] > work.upper[p] else -(p + 1)
            chosen += 1
            ignore_violations(work, p)
    return chosen


@inline_njit
def choose_guess(work, names):
    """Writes the guessed constraints that can work to the candidates; returns how many."""
    chosen = 0
    for name in names:
        if 1.0 <= abs(name) <= len(work.mu) and chosen < work.capacity:
            p = int(abs(name)) - 1
            watched = work.allowed_low[p] > -np.inf or work.allowed_high[p] < np.inf
            if watched and work.mu[p] == 0.0 and abs(work.upper[p] if name > 0.0 else work.lower[p]) < np.inf:
                work.candidates[chosen] = int(name)
                chosen += 1
                ignore_violations(work, p)
    return chosen


@inline_njit
def are_present(work, names):
    """Returns whether every one of the named bounds is there (it may have become absent), its multiplier at no cap."""
    for name in names:
        if not 1.0 <= abs(name) <= len(work.mu):
            return False
        p = int(abs(name)) - 1
        if work.mu[p] != 0.0 or abs(work.upper[p] if name > 0.0 else work.lower[p]) == np.inf:
            return False
    return True
