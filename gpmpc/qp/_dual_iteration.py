"""The dual active-set method of Goldfarb and Idnani (Math. Programming 27, 1983).

Which constraints hold with equality at the minimum of a strictly convex QP? For a
working set W the minimiser over ``c_p'x = b_p, p in W`` is

    x = x_u - P^-1 C_W' mu   with   K_WW mu = y_W - b_W

where x_u is the unconstrained minimiser, y = C x_u and K = C P^-1 C'. The method keeps
every multiplier in its range and moves to the most violated constraint p until none is
violated (their algorithm 1). A multiplier at its cap, the price of a soft row, leaves
with a constraint that stays violated; then mu_p is not zero outside the working set,
and x_u is the minimiser with the multipliers at caps added to q.

The functions take a workspace (``gpmpc.qp._workspace``) and the number k of its working
constraints; those that change k return it.
"""

from typing import NamedTuple

import numpy as np

from gpmpc._compiled import inline_njit
from gpmpc._kernels._simd import load, load_some, store
from gpmpc._kernels.linalg import dot, multiply
from gpmpc.qp._record import INFEASIBLE, ITERATION_LIMIT, SOLVED
from gpmpc.qp._triangular import (
    multiply_to_ends,
    scale,
    solve_lower,
    solve_transposed,
    subtract_rows,
)
from gpmpc.qp._violations import (
    choose_badly_violated,
    list_violated,
    most_violated,
    recheck_violated,
    stop_watching,
    watch,
)
from gpmpc.qp._working_set import (
    add_candidates,
    add_constraint,
    compute_factor_row,
    constraint_in,
    distance_to_span,
    drop_constraint,
    is_prepared,
    write_slot,
)

# Times that all badly violated constraints enter at once, and which are: those violated
# by more than this share of the worst.
BATCHES = 4
_BADLY = 0.5
# The squared distance d of p from the span of the working ones, as a share of K_pp:
# below the first p depends on them, below the second d is computed again without
# cancellation.
_DEPENDENT_SQUARE = 1e-12
_DOUBTFUL_SQUARE = 1e-4
# A contradiction may be the rounding of its bounds up to this share of them.
_ROUNDING_OF_BOUNDS = 1e-15
# A dependent constraint violated by more than this share of its terms contradicts.
_HOPELESS = 1e-7
# The square of the share of the longest r_i w_i below which r_i may be rounding.
_NO_RATE_SQUARE = 1e-24


class Progress(NamedTuple):
    """The state in which the iteration ends."""

    status: int  # ``SOLVED``, ``INFEASIBLE`` or ``ITERATION_LIMIT``
    size: int  # of the working set
    iterations: int
    batches_left: int
    passed_over: bool  # whether one contradicts others by what may be rounding


@inline_njit
def iterate(
    work,
    k,
    is_first_look,
    guessed_count,
    violated_count,
    margin,
    iterations,
    batches_left,
):
    """Adds and drops constraints until none is violated by more than ``margin``.

    At the first look it is not known yet which constraints are violated: the first
    ``guessed_count`` candidates enter before all else. Later ``violated_count`` of them
    are listed; their excess and the margin are in units of ``norm``. ``iterations`` are
    the changes of the working set so far. Up to ``batches_left`` times several
    constraints enter at once.
    """
    p = 0
    entering = guessed_count
    status = SOLVED
    violated = False
    passed_over = False
    all_listed = True  # whether the list was made of all constraints
    while is_first_look or violated_count > 0:
        # select the violated constraint p, or several at once: the candidates
        if not is_first_look:
            violated = True
            if iterations >= work.limit:
                status = ITERATION_LIMIT
                break
            p = most_violated(work, violated_count)
            entering = 0
            if all_listed and batches_left > 0:
                threshold = _BADLY * work.excess[p]
                entering = choose_badly_violated(
                    work, threshold, violated_count, work.n - k
                )
                batches_left -= entering > 0

        # add the candidates, or move to p, which enters unless it stays violated
        size_before = k
        k = add_candidates(work, k, entering)
        must_solve_multipliers = True
        single = not is_first_look and k == size_before
        if single:
            entry = _enter(work, k, p)
            k = entry.size
            iterations += entry.changes
            if entry.infeasible:
                status = INFEASIBLE
                break
            passed_over = passed_over or entry.passed_over
            # A soft row that comes to its cap moves x_u, and ``free_value`` stays that
            # of before. From then on there are single steps only, and refinement
            # corrects the multipliers
            must_solve_multipliers = entry.passed_over and work.soft == 0.0
            if work.soft != 0.0:  # p may have come to its cap
                batches_left = 0
        elif not is_first_look:
            iterations += k - size_before

        # put the multipliers into their ranges, and x where they have their minimum
        if must_solve_multipliers:
            k = _drop_wrong_multipliers(work, k)
        _minimise(work, k)

        # first satisfy the others that were seen to be violated, then look at all
        only_p_was_listed = violated_count == 1
        is_last_look = iterations >= work.limit
        looks_at_all = only_p_was_listed or work.soft != 0.0 or is_last_look
        all_listed = looks_at_all or not single
        if not all_listed:
            violated_count = recheck_violated(work, margin, violated_count)
            all_listed = violated_count == 0
        if all_listed:
            multiply_constraints(work)
            violated_count = list_violated(work, margin)
        is_first_look = False
    if status == SOLVED and violated:
        _clip_multipliers(work, k)
    return Progress(
        status=status,
        size=k,
        iterations=iterations,
        batches_left=batches_left,
        passed_over=passed_over,
    )


class _Entry(NamedTuple):
    """What became of a violated constraint."""

    size: int  # of the working set
    changes: int  # how many constraints entered or left
    infeasible: bool  # it contradicts the working ones; the ray is written
    passed_over: bool  # it does by no more than rounding


@inline_njit
def _enter(work, k, p):
    """Moves to constraint p, which then enters the working set.

    One that contradicts the working ones stays outside: it proves that there is no x,
    or is passed over where the contradiction may be rounding.
    """
    multiplier_before = work.multiplier[p]
    attempt = _satisfy_constraint(work, k, p)
    k = attempt.size
    infeasible = False
    if attempt.contradicts:
        terms = _terms_of_combination(work, k)
        infeasible = _is_contradiction(work, p, terms)
        if infeasible:
            _write_ray(work, k, p)
        else:
            # what p gained on the way belongs to no working set
            work.multiplier[p] = multiplier_before
            work.negligible[p] += _ROUNDING_OF_BOUNDS * terms
            stop_watching(work, p)
    return _Entry(
        size=k,
        changes=attempt.changes,
        infeasible=infeasible,
        passed_over=attempt.contradicts and not infeasible,
    )


class _Attempt(NamedTuple):
    """How a constraint came out of ``_satisfy_constraint``."""

    contradicts: bool  # the working ones; else it is satisfied, or violated at its cap
    size: int  # of the working set
    changes: int  # how many constraints entered or left


@inline_njit
def _satisfy_constraint(work, k, p):
    """Moves multipliers until constraint p is satisfied: steps 1 and 2 of algorithm 1.

    A soft one may come to its cap instead, and stays violated.
    """
    mu = work.multiplier
    r = work.direction
    if mu[p] == 0.0:
        at_upper = work.value[p] > work.upper[p]
        sense = 1.0 if at_upper else -1.0  # the direction in which mu_p moves
    else:  # it comes back from a cap: p holds, and need not be paid for
        at_upper = mu[p] > 0.0
        sense = -1.0 if at_upper else 1.0
    write_slot(work, k, p, at_upper)
    compute_factor_row(work, k, p)
    violation = (work.value[p] - work.bound[k]) * sense
    K_pp = work.diagonal[k]
    changes = 0
    while True:
        # step direction: r = K_WW^-1 K_Wp and d = K_pp - K_pW r; then mu_p moves by t,
        # mu_W by -t r and y_p by -t d
        scale(1.0, work.forward, r, k)
        solve_transposed(work.factor, k, r)
        d = K_pp - dot(work.forward, work.forward, k)
        if d < _DOUBTFUL_SQUARE * K_pp:
            d = distance_to_span(work, k)

        # step length: t2 = violation / d makes p hold, at ``room`` its multiplier
        # reaches the end of its range (its cap, or zero on the way back), at t1 a
        # working one does
        independent = d > _DEPENDENT_SQUARE * K_pp and k < work.n
        step = max(0.0, violation) / d if independent else np.inf
        range_end = work.most_multiplier[k] if sense > 0.0 else work.least_multiplier[k]
        room = (range_end - mu[p]) * sense
        reaches_range_end = room < step
        if reaches_range_end:
            step = room
        step, blocking = _first_blocking(work, k, sense, step)
        if step == np.inf:  # (r, -1) is Farkas' proof, unless rounding violates p
            return _Attempt(contradicts=True, size=k, changes=changes)

        # take the step
        for i in range(k):
            mu[constraint_in(work, i)] -= sense * step * r[i]
        mu[p] += sense * step
        changes += 1
        if blocking < k:  # partial step: drop what blocks, and try p again
            leaving = constraint_in(work, blocking)
            mu[leaving] = _end_of_range(work, blocking, sense * r[blocking])
            drop_constraint(work, k, blocking)
            k -= 1
            watch(work, leaving)
            violation -= step * d
        elif reaches_range_end:
            # p stays outside the working set, violated at its cap or satisfied at zero
            mu[p] = range_end
            watch(work, p)
            return _Attempt(contradicts=False, size=k, changes=changes)
        else:  # full step: add p
            k = add_constraint(work, k, p, d)
            return _Attempt(contradicts=False, size=k, changes=changes)


@inline_njit
def _first_blocking(work, k, sense, step):
    """Returns the longest step that keeps the multipliers in range, and what ends it.

    That is a slot, or k where ``step`` is not too long for any. A rate r_i that may be
    rounding blocks nothing. The unit of r_i is that of its row, so it is weighed by the
    length of w_i: the square of |r_i w_i| is r_i^2 K_ii.
    """
    r = work.direction
    largest_square = 0.0
    for i in range(k):
        largest_square = max(largest_square, r[i] * r[i] * work.diagonal[i])
    rounding = _NO_RATE_SQUARE * largest_square
    blocking = k
    for i in range(k):
        rate = sense * r[i]
        if rate * rate * work.diagonal[i] > rounding:
            range_end = _end_of_range(work, i, rate)
            room = (work.multiplier[constraint_in(work, i)] - range_end) / rate
            if room < step:
                step = max(room, 0.0)
                blocking = i
    return step, blocking


@inline_njit
def _end_of_range(work, slot, rate):
    """Returns where the range of a multiplier ends that decreases at this rate."""
    return work.least_multiplier[slot] if rate > 0.0 else work.most_multiplier[slot]


@inline_njit
def _terms_of_combination(work, k):
    """Returns sum |r_i b_i|, of which the value of the constraint sum r_i c_i is made.

    r is ``direction``.
    """
    terms = 0.0
    for i in range(k):
        terms += abs(work.direction[i] * work.bound[i])
    return terms


@inline_njit
def _is_contradiction(work, p, terms):
    """Returns whether p, which depends on others, is violated by more than rounding.

    Rounding is a share of c_p'x, of the terms of the others' combination, and of the
    longest x.
    """
    size = max(abs(work.value[p]), terms, work.length_of_q * work.norm[p])
    return work.excess[p] * work.norm[p] > _HOPELESS * size


@inline_njit
def _write_ray(work, k, p):
    """Writes Farkas' proof that p contradicts the working set to the multipliers.

    ``C' ray = 0`` and ``ray' bounds < 0``.
    """
    sense = 1.0 if work.value[p] > work.upper[p] else -1.0
    for i in range(work.width):
        work.multiplier[i] = 0.0
    for i in range(k):
        w = constraint_in(work, i)
        ray = -sense * work.direction[i]
        # else it is rounding: the bound cannot pull that way
        if ray * work.label[i] >= 0.0 or work.lower[w] == work.upper[w]:
            work.multiplier[w] = ray
    work.multiplier[p] = sense


@inline_njit
def _drop_wrong_multipliers(work, k):
    """Solves K_WW mu = y_W - b_W; drops the most wrong one until all are in range.

    Any working set is a valid start of a dual method once this is done. Returns the
    size of the working set.
    """
    trial = work.direction
    for i in range(k):
        work.forward[i] = work.free_value[i] - work.bound[i]
    solve_lower(work.factor, k, work.forward)
    while True:
        scale(1.0, work.forward, trial, k)
        solve_transposed(work.factor, k, trial)
        worst = 0.0
        slot = k
        for i in range(k):
            above = trial[i] - work.most_multiplier[i]
            outside = max(above, work.least_multiplier[i] - trial[i])
            if outside > worst:
                worst = outside
                slot = i
        if slot == k:
            break
        p = constraint_in(work, slot)
        drop_constraint(work, k, slot)
        k -= 1
        work.multiplier[p] = 0.0
        watch(work, p)
    for i in range(k):
        work.multiplier[constraint_in(work, i)] = trial[i]
    return k


@inline_njit
def _clip_multipliers(work, k):
    """Puts the working multipliers into their ranges, which rounding can leave."""
    for i in range(k):
        p = constraint_in(work, i)
        above_least = max(work.multiplier[p], work.least_multiplier[i])
        work.multiplier[p] = min(above_least, work.most_multiplier[i])


@inline_njit
def _minimise(work, k):
    """Writes the minimiser of the Lagrangian, P x = -(q + C'mu), to ``value[:n]``."""
    n = work.n
    x = work.value
    if work.soft != 0.0:  # constraints at their caps have multipliers, too
        add_multipliers(work, k)
        scale(-1.0, work.slope, x, n)
        solve_transposed(work.L, n, x)
        solve_lower(work.L, n, x)
    elif is_prepared(work):  # K = C P^-1 C' begins with P^-1
        add_multipliers(work, k)
        scale(-1.0, work.slope, work.scratch, n)
        multiply(work.K, n, work.scratch, n, x)
    else:  # L x = free_rhs - sum mu_i w_i
        scale(1.0, work.free_rhs, x, n)
        for i in range(k):
            work.scratch[i] = work.multiplier[constraint_in(work, i)]
        subtract_rows(x, work.w, work.place, work.scratch, k, n)
        solve_lower(work.L, n, x)


@inline_njit
def multiply_constraints(work):
    """Writes the values of the rows, G x."""
    n = work.n
    multiply_to_ends(work.G, work.row_end[n:], work.value, work.value[n:])


@inline_njit
def add_multipliers(work, k):
    """Writes ``slope = q + C' mu``.

    Only where rows are soft can others than the working ones have a multiplier.
    """
    n = work.n
    mu = work.multiplier
    slope = work.slope
    for j in range(0, n, 8):
        store(slope, j, load_some(work.q, j) + load(mu, j))
    for i in range(work.m if work.soft != 0.0 else k):
        p = n + i if work.soft != 0.0 else constraint_in(work, i)
        if p >= n and mu[p] != 0.0:
            weight = mu[p]
            row = work.G[p - n]
            for j in range(0, int(work.row_end[p]), 8):
                store(slope, j, load(slope, j) + weight * load_some(row, j))
