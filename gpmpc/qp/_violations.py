"""The selection of constraints: which are violated, by how much, which enter next."""

import numpy as np

from gpmpc._compiled import inline_njit
from gpmpc._kernels.linalg import dot

# A violation below this share of the bound is none, whatever the other bound is.
TOLERATED = 2e-14


@inline_njit
def watch(work, p):
    """Lets constraint p, outside the working set, count as violated.

    With a multiplier of zero it must stay within its bounds. At a cap it must stay
    outside the bound that it violates, so the allowed side is the one beyond that.
    """
    low = work.lower[p]
    high = work.upper[p]
    multiplier = work.multiplier[p]
    allowed_low = low - (TOLERATED * abs(low) + work.negligible[p])
    allowed_high = high + (TOLERATED * abs(high) + work.negligible[p])
    if multiplier > 0.0:
        allowed_low = high - (TOLERATED * abs(high) + work.negligible[p])
        allowed_high = np.inf
    elif multiplier < 0.0:
        allowed_low = -np.inf
        allowed_high = low + (TOLERATED * abs(low) + work.negligible[p])
    work.allowed_low[p] = allowed_low
    work.allowed_high[p] = allowed_high


@inline_njit
def stop_watching(work, p):
    """Lets constraint p count as satisfied whatever its value.

    It is in the working set, or cannot be told from one that is.
    """
    work.allowed_low[p] = -np.inf
    work.allowed_high[p] = np.inf


@inline_njit
def is_watched(work, p):
    """Returns whether constraint p can count as violated."""
    return work.allowed_low[p] > -np.inf or work.allowed_high[p] < np.inf


@inline_njit
def list_violated(work, margin):
    """Lists the constraints violated by more than ``margin``; returns how many.

    The margin and ``excess`` are in units of ``norm``.
    """
    value = work.value
    low = work.allowed_low
    high = work.allowed_high
    norm = work.norm
    excess = work.excess
    violated = work.violated
    count = 0
    for p in range(work.M):  # in the unit of the constraint: most lists are empty
        excess[p] = max(value[p] - high[p], low[p] - value[p]) - margin * norm[p]
        count += excess[p] > 0.0
    if count > 0:
        count = 0
        for p in range(work.M):
            if excess[p] > 0.0:
                excess[p] /= norm[p]
                violated[count] = p
                count += 1
    return count


@inline_njit
def recheck_violated(work, margin, count):
    """Computes the listed constraints at the present x; keeps those still violated.

    Returns how many they are. ``excess`` is in units of ``norm``, as is ``margin``.
    """
    value = work.value
    excess = work.excess
    violated = work.violated
    n = work.n
    remaining = 0
    for i in range(count):
        p = violated[i]
        if p >= n:
            value[p] = dot(work.G[p - n], value, int(work.row_end[p]))
        outside = max(value[p] - work.allowed_high[p], work.allowed_low[p] - value[p])
        excess[p] = outside / work.norm[p] - margin
        if excess[p] > 0.0:
            violated[remaining] = p
            remaining += 1
    return remaining


@inline_njit
def most_violated(work, count):
    """Returns the listed constraint with the largest excess."""
    excess = work.excess
    violated = work.violated
    worst = violated[0]
    for i in range(1, count):
        if excess[violated[i]] > excess[worst]:
            worst = violated[i]
    return worst


@inline_njit
def choose_badly_violated(work, threshold, count, most):
    """Makes candidates of the listed constraints with an excess above ``threshold``.

    Those at a cap are left out. Returns how many candidates there are, at most
    ``most``; none where only one constraint is violated that badly, as a single step
    can also find that it contradicts the others.
    """
    chosen = 0
    bad = 0
    for i in range(count):
        p = work.violated[i]
        if work.excess[p] > threshold:
            bad += 1
            if chosen < most and work.multiplier[p] == 0.0:
                at_upper = work.value[p] > work.upper[p]
                work.candidates[chosen] = p + 1 if at_upper else -(p + 1)
                chosen += 1
    return chosen if bad > 1 else 0


@inline_njit
def choose_guessed(work, labels):
    """Makes candidates of the guessed constraints, at no cap, whose bound is there.

    Returns how many.
    """
    chosen = 0
    for label in labels:
        if 1.0 <= abs(label) <= work.M:
            p = int(abs(label)) - 1
            bound = work.upper[p] if label > 0.0 else work.lower[p]
            if work.multiplier[p] == 0.0 and abs(bound) < np.inf:
                work.candidates[chosen] = int(label)
                chosen += 1
    return chosen
