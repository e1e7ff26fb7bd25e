"""Residuals of a point on its working set, and Newton's method to make them small.

One step is exact but for rounding. Residuals are computed from P, q and G, not from the
factors that led to the point.
"""

import math
from typing import NamedTuple

import numpy as np

from gpmpc._compiled import inline_njit
from gpmpc._kernels._simd import (
    larger_magnitude,
    largest,
    load,
    load_some,
    store,
    total,
    zeros,
)
from gpmpc._kernels.linalg import dot, multiply
from gpmpc.qp._dual_iteration import add_multipliers, multiply_constraints
from gpmpc.qp._triangular import (
    multiply_rows,
    scale,
    solve_lower,
    solve_transposed,
    subtract_rows,
)
from gpmpc.qp._working_set import constraint_in

# A residual that overflowed. It is less than half of infinity, so that ``refine`` takes
# a step all the same; what is as large after that ends the solve (``_solve_opened``).
UNDEFINED = 1e300
_STEPS = 3
_TINY = 1e-300


class Refinement(NamedTuple):
    """The outcome of ``refine``."""

    residual: float  # as a share of the length of x
    length: float  # of x, in the metric of P


@inline_njit
def refine(work, k, tolerance):
    """Corrects x and the multipliers on the working set.

    Ends when their residual is at most ``tolerance``, or does not halve any more.
    """
    residual = np.inf
    length = 0.0
    best = np.inf
    for step in range(_STEPS + 1):
        add_multipliers(work, k)
        residual, length = _measure_residual(work, k)
        halved = residual < 0.5 * best
        if residual <= tolerance or step == _STEPS or not halved:
            break
        best = residual
        _take_newton_step(work, k)
    return Refinement(residual, length)


@inline_njit
def _measure_residual(work, k):
    """Returns the residual of a point as a share of the length of x, and this length.

    The residual is that of stationarity and of the working constraints. The length is
    that in the metric of P, at least ``negligible_length``, so that neither the units
    of the data nor a cost of another size hide an error of x. The error
    beside the largest entry of x counts, too, divided by 100, and that of a row beside
    its bound or its own terms.
    ``UNDEFINED`` where a number that it is made of is not finite: comparisons alone
    would pass over NaN.

    Writes ``gradient`` and ``residual``; reads ``slope``.
    """
    n = work.n
    x = work.value
    gradient = work.gradient
    multiply(work.P, n, x, n, gradient)
    least = work.negligible_length
    length = math.sqrt(max(dot(gradient, x, n), least * least, _TINY))
    steps = zeros()
    shifts = zeros()
    entries = zeros()
    nothing = zeros()
    for j in range(0, n, 8):
        entry = load_some(gradient[:n], j) + load_some(work.slope[:n], j)
        store(gradient, j, entry)
        step = entry * load(work.norm, j)
        steps = larger_magnitude(steps, step)
        shifts = larger_magnitude(shifts, step * load(work.norm, j))
        entries = larger_magnitude(entries, load_some(x[:n], j))
        nothing = nothing + 0.0 * step
    worst = largest(steps) / length
    undefined = total(nothing)
    worst = max(worst, 0.01 * largest(shifts) / max(largest(entries), _TINY))
    for i in range(k):
        residual = work.value[constraint_in(work, i)] - work.bound[i]
        work.residual[i] = residual
        worst = max(worst, _relative_residual(work, i, abs(residual), length))
        undefined += 0.0 * residual
    if worst + undefined + length < np.inf:
        return worst, length
    return UNDEFINED, length


@inline_njit
def _relative_residual(work, slot, residual, length):
    """Returns a working constraint's residual by x, or a hundredth by its own terms."""
    p = constraint_in(work, slot)
    scaled_length = length * work.norm[p]
    if not residual > 1e-15 * scaled_length:
        return 0.0
    bound = work.bound[slot]
    terms = max(abs(bound), 1e-6 * scaled_length)
    if p >= work.n and residual > 1e-9 * terms:
        row = work.G[p - work.n]
        for j in range(int(work.row_end[p])):
            terms = max(terms, abs(row[j] * work.value[j]))
    return max(residual / scaled_length, 1e-2 * residual / terms)


@inline_njit
def _take_newton_step(work, k):
    """Takes one Newton step for the residuals; multipliers stay in range.

    The residuals are ``gradient`` and ``residual``.
    """
    n = work.n
    x = work.value
    transformed = work.scratch  # L^-T gradient
    scale(1.0, work.gradient, transformed, n)
    solve_transposed(work.L, n, transformed)

    dmu = work.direction  # K_WW^-1 (residual - W transformed)
    multiply_rows(work.w, work.place, k, transformed, n, dmu)
    for i in range(0, k, 8):
        store(dmu, i, load(work.residual, i) - load(dmu, i))
    solve_lower(work.factor, k, dmu)
    solve_transposed(work.factor, k, dmu)

    dx = work.gradient  # -L^-1 (transformed + sum dmu_i w_i)
    scale(-1.0, transformed, dx, n)
    subtract_rows(dx, work.w, work.place, dmu, k, n)
    solve_lower(work.L, n, dx)

    for j in range(0, n, 8):
        store(x, j, load(x, j) + load(dx, j))
    for i in range(k):
        p = constraint_in(work, i)
        above_least = max(work.multiplier[p] + dmu[i], work.least_multiplier[i])
        work.multiplier[p] = min(above_least, work.most_multiplier[i])
    multiply_constraints(work)


@inline_njit
def worst_violation(work):
    """Returns the largest violation beyond what multipliers pay for.

    It is a share of the bound or of a thousandth of the length of x. A constraint at
    its cap violates that by being inside the bound which it pays for.
    """
    least = work.negligible_length
    length = math.sqrt(max(abs(dot(work.slope, work.value, work.n)), least * least))
    worst = 0.0
    for p in range(work.M):
        above = work.value[p] - work.upper[p]
        below = work.lower[p] - work.value[p]
        multiplier = work.multiplier[p]
        if abs(multiplier) >= work.cap[p]:
            at_upper = multiplier > 0.0
            violation = -above if at_upper else -below
        else:
            at_upper = above > below
            violation = above if at_upper else below
        bound = work.upper[p] if at_upper else work.lower[p]
        size = max(1e-3 * length * work.norm[p], abs(bound))
        # NaN without bounds, which ``max`` passes over as its second argument
        worst = max(worst, (violation - work.negligible[p]) / size)
    return worst
