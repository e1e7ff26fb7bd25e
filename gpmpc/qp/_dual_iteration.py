"""The dual active-set method: which constraints hold with equality at the minimum of a strictly convex QP?

For a working set W the minimiser over ``c_p'x = b_p, p in W`` is x = x_u - P^-1 C_W' mu with K_WW mu = y_W - b_W, where
x_u is the unconstrained minimiser, y = C x_u and K = C P^-1 C'. The method of Goldfarb and Idnani (Math. Programming
27, 1983, algorithm 1) keeps every multiplier in its range and moves to the most violated constraint p until none is
violated. A multiplier at its cap, the price of a soft row, leaves with a constraint that stays violated; then mu_p is
not zero outside the working set.

The functions take a ``Workspace`` and the number k of its working constraints; those that change k return it.
"""

import numpy as np

from gpmpc._compiled import inline_njit
from gpmpc._kernels._simd import load, load_some, store, zeros
from gpmpc._kernels.linalg import dot, multiply
from gpmpc.qp._record import INFEASIBLE, ITERATION_LIMIT, SOLVED
from gpmpc.qp._triangular import (
    append_row,
    delete_row,
    multiply_rows,
    multiply_to_ends,
    scale,
    solve_lower,
    solve_transposed,
    subtract_rows,
)
from gpmpc.qp._violations import (
    choose_bad,
    ignore_violations,
    keep_violated,
    list_violated,
    most_violated,
    restore_limits,
)
from gpmpc.qp._workspace import (
    ALLOWED_HIGH,
    ALLOWED_LOW,
    BOUND,
    CANDIDATES,
    CAP,
    COSINES,
    DIAGONAL,
    END,
    EXCESS,
    FREE_VALUE,
    LEAST,
    LOWER,
    MOST,
    MU,
    NAME,
    NEGLIGIBLE,
    PLACE,
    SCALE,
    SCRATCH,
    SINES,
    SLOPE,
    SOLVED_K,
    UPPER,
    R,
    V,
    Y,
)

NONE = 1e-26  # share of the length of q below which x, and a violation of a bound of zero, is none
_GUESSED_PIVOT = 1e-9  # share of K_pp: a guessed constraint that depends on the others by more is left out
_DEPENDENT = (
    1e-12  # d below this share of K_pp: the constraint depends on the working ones
)
_DOUBTFUL = 1e-4  # d below this share of K_pp is computed again without cancellation
_ROUNDING = (
    1e-15  # share of the bounds of a contradiction by which it may be their rounding
)
_HOPELESS = (
    1e-7  # violation of a dependent constraint that is taken for a contradiction
)
_BATCHES = 4  # times that all badly violated constraints enter at once
_BAD = 0.5  # those violated by more than this share of the worst


@inline_njit
def iterate(work, k, count, margin, iterations, batches):
    """Changes the working set until no constraint is violated by more than ``margin``, in units of ``SCALE``.

    ``count`` are, and listed; ``-1 - g`` says that y is not known yet and that g guessed candidates enter first.

    Returns:
        ``SOLVED``, ``INFEASIBLE`` or ``ITERATION_LIMIT``, the size of the working set, iterations and batches so far,
        whether a constraint was passed over because it contradicts others by what may be rounding, and whether any was
        violated.
    """
    vectors = work.vectors
    indices = work.indices
    n = len(work.q)
    M = n + len(work.G)
    p = 0
    chosen = -1 - count
    begins = count < 0
    violated = False
    passed = False
    complete = True  # whether y and the list are those of all constraints
    while count != 0:
        if not begins:
            if iterations >= work.limit:
                return ITERATION_LIMIT, k, iterations, batches, passed, True
            p = most_violated(vectors, indices, count)
            chosen = 0
            violated = True
            if complete and batches < _BATCHES:
                chosen = choose_bad(
                    vectors, indices, _BAD * vectors[EXCESS, p], count, n - k
                )
                batches += chosen > 0
        before = k
        k = add_constraints(work, k, chosen)
        if not begins:
            iterations += k - before
        several = unsettled = begins or k > before
        if not several:
            mu_p = vectors[MU, p]
            satisfied, k, changes = _satisfy_constraint(work, k, p)
            iterations += changes
            if not satisfied:
                size = max(abs(vectors[Y, p]), vectors[NEGLIGIBLE, p] / NONE)
                if vectors[EXCESS, p] * vectors[SCALE, p] > _HOPELESS * size:
                    _write_ray(work, k, p)
                    return INFEASIBLE, k, iterations, batches, passed, True
                # what it gained on the way belongs to no working set
                vectors[MU, p] = mu_p
                passed = True
                ignore_violations(vectors, p)
                unsettled = not work.soft  # else refinement has to do
            if work.soft:
                batches = _BATCHES  # caps may have changed x_u
        if unsettled:
            k = _drop_wrong_multipliers(work, k)
        _minimise(work, k)
        complete = several or work.soft or count == 1 or iterations >= work.limit
        if (
            not complete
        ):  # first satisfy those that were seen to be violated, then look at all
            count = keep_violated(work, margin, count)
            complete = count == 0
        if complete:
            multiply_constraints(work)
            count = list_violated(vectors, indices, M, margin)
        begins = False
    if violated:
        for i in range(k):  # rounding can take multipliers out of their ranges
            p = abs(indices[NAME, i]) - 1
            vectors[MU, p] = min(
                max(vectors[MU, p], vectors[LEAST, i]), vectors[MOST, i]
            )
    return SOLVED, k, iterations, batches, passed, violated


@inline_njit
def _satisfy_constraint(work, k, p):
    """Moves multipliers until constraint p is satisfied: steps 1 and 2 of Goldfarb and Idnani's algorithm.

    Returns:
        False if it contradicts the working ones, the size of the working set, and how many entered or left.
    """
    vectors = work.vectors
    names = work.indices[NAME]
    factor = work.factor
    changes = 0
    mu = vectors[MU]
    r = vectors[R]
    solved = vectors[SOLVED_K]
    least = vectors[LEAST]
    most = vectors[MOST]
    above = mu[p] > 0.0 or (mu[p] == 0.0 and vectors[Y, p] > vectors[UPPER, p])
    sense = (
        1.0 if above == (mu[p] == 0.0) else -1.0
    )  # the direction of mu_p, which comes back from a cap
    _write_slot(work, k, p, above)
    _solve_slot(work, k, p)
    violation = (vectors[Y, p] - vectors[BOUND, k]) * sense
    K_pp = vectors[DIAGONAL, k]
    while True:
        # step direction:  r = K_WW^-1 K_Wp,  d = K_pp - K_pW r;  mu_p moves by t, mu_W by -t r and y_p by -t d
        scale(1.0, solved, r, k)
        solve_transposed(factor, k, r)
        d = K_pp - dot(solved, solved, k)
        if d < _DOUBTFUL * K_pp:
            d = _distance_to_span(work, k)
        # ratio test:  t = min(t1, t2);  t2 = violation / d makes p hold,  t1 takes a multiplier to the end of its range
        step = (
            max(0.0, violation) / d
            if d > _DEPENDENT * K_pp and k < len(work.q)
            else np.inf
        )
        room = most[k] - mu[p] if sense > 0.0 else mu[p] - least[k]
        capped = room < step
        step, blocking = _first_blocking(
            vectors, names, k, sense, room if capped else step
        )
        if (
            step == np.inf
        ):  # no step ends: (r, -1) is Farkas' proof, unless rounding made the violation
            for i in range(k):
                vectors[NEGLIGIBLE, p] += _ROUNDING * abs(r[i] * vectors[BOUND, i])
            return False, k, changes
        # take the step
        for i in range(k):
            mu[abs(names[i]) - 1] -= sense * step * r[i]
        mu[p] += sense * step
        changes += 1
        if (
            blocking < k
        ):  # partial step: the blocking constraint leaves, and p is tried again
            leaving = abs(names[blocking]) - 1
            mu[leaving] = (
                least[blocking] if sense * r[blocking] > 0.0 else most[blocking]
            )
            _drop_constraint(work, k, blocking)
            k -= 1
            restore_limits(vectors, leaving)
            violation -= step * d
        elif capped:  # a soft row that stays violated
            mu[p] = most[k] if sense > 0.0 else least[k]
            restore_limits(vectors, p)
            return True, k, changes
        else:  # full step: p enters
            append_row(factor, k, solved, d)
            ignore_violations(vectors, p)
            return True, k + 1, changes


@inline_njit
def _first_blocking(vectors, names, k, sense, step):
    """Returns the longest step up to ``step`` that keeps the multipliers in range, and the slot that ends it (or k)."""
    r = vectors[R]
    size = 0.0
    for i in range(k):
        size = max(size, abs(r[i]))
    blocking = k
    for i in range(k):
        rate = sense * r[i]
        if abs(rate) > 1e-12 * size:
            end = vectors[LEAST, i] if rate > 0.0 else vectors[MOST, i]
            room = (vectors[MU, abs(names[i]) - 1] - end) / rate
            if room < step:
                step = max(room, 0.0)
                blocking = i
    return step, blocking


@inline_njit
def _distance_to_span(work, k):
    """Returns ``d = |w_p - sum r_i w_i|^2``, p in slot k, as a sum of squares, which cannot cancel."""
    rest = work.vectors[SCRATCH]
    row = work.rows[work.indices[PLACE, k]]
    places = work.indices[PLACE]
    n = len(work.q)
    scale(1.0, row, rest, n)
    subtract_rows(rest, work.rows, places, work.vectors[R], k, n)
    return dot(rest, rest, n)


@inline_njit
def _write_ray(work, k, p):
    """Writes Farkas' proof that p contradicts the working constraints to mu: ``C' ray = 0``, ``ray' bounds < 0``."""
    vectors = work.vectors
    names = work.indices[NAME]
    mu = vectors[MU]
    sense = 1.0 if vectors[Y, p] > vectors[UPPER, p] else -1.0
    for i in range(len(mu)):
        mu[i] = 0.0
    for i in range(k):
        w = abs(names[i]) - 1
        ray = -sense * vectors[R, i]
        if (
            ray * names[i] >= 0.0 or vectors[LOWER, w] == vectors[UPPER, w]
        ):  # else rounding: it cannot pull that way
            mu[w] = ray
    mu[p] = sense


@inline_njit
def add_constraints(work, k, count):
    """Adds the first ``count`` candidates to the working set, but for those that depend on others; returns its size."""
    vectors = work.vectors
    solved = work.vectors[SOLVED_K]
    for i in range(count):
        name = work.indices[CANDIDATES, i]
        p = abs(name) - 1
        outside = (
            vectors[ALLOWED_LOW, p] > -np.inf or vectors[ALLOWED_HIGH, p] < np.inf
        )  # of the working set
        if outside and k < len(work.q):
            _write_slot(work, k, p, name > 0)
            _solve_slot(work, k, p)
            pivot = vectors[DIAGONAL, k] - dot(solved, solved, k)
            if pivot > _GUESSED_PIVOT * vectors[DIAGONAL, k]:
                append_row(work.factor, k, solved, pivot)
                ignore_violations(vectors, p)
                k += 1
    return k


@inline_njit
def _write_slot(work, k, p, above):
    """Writes constraint p, at its upper bound (``above``) or its lower one, to slot k."""
    vectors = work.vectors
    places = work.indices[PLACE]
    n = len(work.q)
    if work.tag != 0.0:
        places[k] = p
        row = work.rows[n + len(work.G) + p]
        vectors[DIAGONAL, k] = row[p]
    else:
        row = work.rows[places[k]]
        size = int(vectors[END, p])
        if p >= n:
            for i in range(0, n, 8):
                store(row, i, load_some(work.G[p - n], i))
        else:
            for i in range(0, n, 8):
                store(row, i, zeros())
            row[p] = 1.0
        solve_transposed(work.L, size, row)
        vectors[DIAGONAL, k] = dot(row, row, size)
    low = vectors[LOWER, p]
    high = vectors[UPPER, p]
    cap = vectors[CAP, p]
    work.indices[NAME, k] = p + 1 if above else -(p + 1)
    vectors[BOUND, k] = high if above else low
    vectors[LEAST, k] = -cap if low == high or not above else 0.0
    vectors[MOST, k] = cap if low == high or above else 0.0
    vectors[FREE_VALUE, k] = dot(row, vectors[V], n)


@inline_njit
def _solve_slot(work, k, p):
    """Writes L_K^-1 K_Wp for constraint p in slot k."""
    solved = work.vectors[SOLVED_K]
    places = work.indices[PLACE]
    if work.tag != 0.0:
        row = work.rows[len(work.q) + len(work.G) + p]
        for i in range(k):
            solved[i] = row[places[i]]
    else:
        multiply_rows(
            work.rows,
            places,
            k,
            work.rows[places[k]],
            int(work.vectors[END, p]),
            solved,
        )
    solve_lower(work.factor, k, solved)


@inline_njit
def restore_constraints(work, count, factor):
    """Makes the candidates of a prepared program the working set, whose factor is known."""
    at = 0
    for i in range(count):
        name = work.indices[CANDIDATES, i]
        p = abs(name) - 1
        _write_slot(work, i, p, name > 0)
        ignore_violations(work.vectors, p)
        scale(1.0, factor[at:], work.factor[i], i + 1)
        at += i + 1


@inline_njit
def _drop_constraint(work, k, slot):
    """Drops the constraint in a slot from the working set of k, and from ``SOLVED``; those behind move up, k too."""
    vectors = work.vectors
    names = work.indices[NAME]
    places = work.indices[PLACE]
    delete_row(
        work.factor, k, slot, vectors[SOLVED_K], vectors[COSINES], vectors[SINES]
    )
    place = places[slot]
    for i in range(slot, k):
        names[i], places[i] = names[i + 1], places[i + 1]
        for j in range(BOUND, DIAGONAL + 1):
            vectors[j, i] = vectors[j, i + 1]
    places[k] = place


@inline_njit
def _drop_wrong_multipliers(work, k):
    """Solves ``K_WW mu = y_W - b_W``; drops the most wrong multiplier until all are in range. Returns the size.

    Any working set is a valid start of a dual method once this is done.
    """
    vectors = work.vectors
    names = work.indices[NAME]
    solved = work.vectors[SOLVED_K]
    trial = work.vectors[R]
    for i in range(k):
        solved[i] = vectors[FREE_VALUE, i] - vectors[BOUND, i]
    solve_lower(work.factor, k, solved)
    while True:
        scale(1.0, solved, trial, k)
        solve_transposed(work.factor, k, trial)
        worst = 0.0
        slot = k
        for i in range(k):
            outside = max(trial[i] - vectors[MOST, i], vectors[LEAST, i] - trial[i])
            if outside > worst:
                worst = outside
                slot = i
        if slot == k:
            break
        p = abs(names[slot]) - 1
        _drop_constraint(work, k, slot)
        k -= 1
        vectors[MU, p] = 0.0
        restore_limits(vectors, p)
    for i in range(k):
        vectors[MU, abs(names[i]) - 1] = trial[i]
    return k


@inline_njit
def _minimise(work, k):
    """Writes the minimiser of the Lagrangian, ``P x = -(q + C'mu)``, to the first n entries of y."""
    n = len(work.q)
    vectors = work.vectors
    y = work.vectors[Y]
    if work.soft:  # constraints at their caps have multipliers, too
        add_multipliers(work, k)
        scale(-1.0, vectors[SLOPE], y, n)
        solve_transposed(work.L, n, y)
    elif work.tag != 0.0:
        add_multipliers(work, k)
        scale(-1.0, vectors[SLOPE], vectors[SCRATCH], n)
        multiply(work.rows[n + len(work.G) :], n, vectors[SCRATCH], n, y)
        return
    else:  # L x = v - sum mu_i w_i
        scale(1.0, vectors[V], y, n)
        for i in range(k):
            vectors[SCRATCH, i] = vectors[MU, abs(work.indices[NAME, i]) - 1]
        subtract_rows(y, work.rows, work.indices[PLACE], vectors[SCRATCH], k, n)
    solve_lower(work.L, n, y)


@inline_njit
def multiply_constraints(work):
    """Writes ``y[n:] = G y[:n]``."""
    y = work.vectors[Y]
    n = len(work.q)
    multiply_to_ends(work.G, work.vectors[END][n:], y, y[n:])


@inline_njit
def add_multipliers(work, k):
    """Writes ``SLOPE = q + C' mu``; only where rows are soft can others than the working ones have a multiplier."""
    n = len(work.q)
    mu = work.vectors[MU]
    slope = work.vectors[SLOPE]
    for i in range(0, n, 8):
        store(slope, i, load_some(work.q, i) + load(mu, i))
    for i in range(len(work.G) if work.soft else k):
        p = n + i if work.soft else abs(work.indices[NAME, i]) - 1
        if p >= n and mu[p] != 0.0:
            weight = mu[p]
            row = work.G[p - n]
            for j in range(0, int(work.vectors[END, p]), 8):
                store(slope, j, load(slope, j) + weight * load_some(row, j))
