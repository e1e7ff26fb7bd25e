"""The price of violating a bound that gives way: an elastic one that cannot be kept.

An exact price of 1e6 weights says that nothing matters beside the bound. Where it can
be kept that is what is asked for. Where it cannot, as after a gust that pushed a
vehicle out of its lane, such a price spends everything on coming back a step earlier,
be it the vehicle. There a price is taken that cannot outweigh what the cost is for:
with J0 and V0 the cost and the violations, all in all, of the plan without elastic
bounds, at

    price = WORTH (J + J_move) / V0,   J0 <= J <= 2 J0

no plan that is better under it costs more than J0 + WORTH J, at most five times J0:
that is what its violations may cost. J is the cost of the last plan within these
limits: where that keeps the bound at some cost, the bound is worth more. A plan that
costs nothing has no scale: J_move is what it would cost to be beside its reference by
its violations. A direction that the cost does not weigh counts there as its largest
weight does, and so does one of the inputs, whose own weight says nothing of what they
move: else a bound in it would count for nothing.

This is the safe price. The linearised program may promise more than the vehicle can
do: as long as a plan that the model itself rolls out costs at most a SHARE of
J0 + J_move more, the bound may be dearer. Of a few prices up to the exact one the
highest such is taken; for a first plan, whose guess says little about costs, the safe
one. So it is for what follows on a plan that missed such bounds by more than its
program, under the exact price, had promised: what the program sees is not what the
model does.

A detour is worth it where the bound is kept again at its end. Where violations under
the exact price grow along the horizon, as where a model leaves its data and tubes
become wider than the lane, it is not: paid for at every step, it has led a car away
that came back without the lane. There the SHARE of J0 is all that the bound may cost,
and prices below the safe one are among those that are tried.

Bounds that the exact price does keep are none of these: theirs stays.

Rows come in units of their own, and cost in any. So violations count as distances: what
a row misses over what it rises per unit of distance, its length. Prices here are of
distances. That of a row is one over its length, its exact price at most: multiplying a
row of a box or a half-space by a number, or the whole cost, changes no plan. (The exact
prices of other rows take their slopes as 1, which moves the prices that are tried.)
"""

from typing import NamedTuple

import numpy as np

from gpmpc.mpc._controller import KEPT
from gpmpc.mpc._linearization import LocalProblem

Array = np.ndarray

# With 4 instead, a car beside its lane was lost now and then; with 1 a reactor's
# economic cost was worth more than its bound.
WORTH = 2.0
# With .05 a car comes back to its lane later; with .2 one of a poor model falls behind.
SHARE = 0.1
TRIALS = 5  # prices between the lowest and the exact one
# Of its exact price, for a row that does not count: it keeps its place among others.
NO_PRICE = 1e-15
LOWEST = 2.0**-8  # of the safe price, where violations grow along the horizon
NO_MOMENT = 1e-6  # share of its terms below which a sum is rounding
NO_WEIGHT = 1e-12  # share of the largest weight below which a direction has none
_TINY = 1e-12  # a distance


class ElasticRows(NamedTuple):
    """The elastic rows that a program misses under their exact prices.

    Attributes:
        gives_way: Which of the rows they are (r,).
        lengths: What each rises per unit of distance (r,), 1 of all others. Where it
            does not rise alike at all stages it is the mean, by what is missed there.
        are_kept_again: Whether they are missed early on the horizon rather than late.
    """

    gives_way: Array
    lengths: Array
    are_kept_again: bool


class ElasticLimits(NamedTuple):
    """What elastic rows that cannot be kept may cost; prices are of distances.

    Attributes:
        safe_price: Under which no plan outweighs what the cost is for.
        lowest_trial_price: Of those that are tried for a plan that goes on.
        exact_price: The highest of the rows.
        affordable_extra_cost: What such a plan may cost more than without them.
    """

    safe_price: float
    lowest_trial_price: float
    exact_price: float
    affordable_extra_cost: float


def elastic_rows(
    violations: Array, row_lengths: Array, may_give_way: Array
) -> ElasticRows:
    """Returns the rows that give way, since a plan misses them.

    Args:
        violations: By how much the plan under exact prices misses each row (H, r).
        row_lengths: What each rises per unit of distance (H, r).
        may_give_way: The elastic rows that are still at their exact price (r,).
    """
    is_missed = (violations / row_lengths).max(axis=0) > KEPT
    gives_way = may_give_way & is_missed
    first = row_lengths[0]
    # exactly the first where all stages have the same
    beyond_first = (violations * (row_lengths - first)).sum(axis=0)
    lengths = np.ones(len(first))
    missed = violations.sum(axis=0)[gives_way]
    lengths[gives_way] = first[gives_way] + beyond_first[gives_way] / missed
    distances = (violations / lengths)[:, gives_way].sum(axis=1)
    return ElasticRows(gives_way, lengths, are_kept_again(distances))


def elastic_limits(
    free: LocalProblem,
    programmed_free_cost: float,
    guess_cost: float,
    rows: ElasticRows,
    exact_prices: Array,
    Q: Array,
    largest_weight: float,
) -> ElasticLimits:
    """Returns the limits of the price of elastic rows, from the plan without them.

    Args:
        free: With the plan that minimises the cost without these rows.
        programmed_free_cost: Of that plan, J0, as the program sees it.
        guess_cost: Of the first guess, such as the last plan.
        rows: Those that give way.
        exact_prices: Of all rows (r,).
        Q: Weight of the states (n, n), or of those of each stage (H, n, n).
        largest_weight: Of the whole cost, which counts where Q is zero.
    """
    gives_way = rows.gives_way
    lengths = rows.lengths[gives_way]
    exact_price = float((exact_prices[gives_way] * lengths).max())
    missed = free.row_violations()[:, gives_way]
    moving_cost = _moving_cost(free, missed, gives_way, Q, largest_weight)
    cost = min(max(programmed_free_cost, guess_cost), 2.0 * programmed_free_cost)
    distance = float((missed / lengths).sum())
    safe_price = WORTH * (cost + moving_cost) / max(distance, _TINY)
    lowest_price = NO_PRICE * exact_price
    safe_price = _rounded(max(safe_price, lowest_price), exact_price)
    if rows.are_kept_again:
        return ElasticLimits(
            safe_price=safe_price,
            lowest_trial_price=safe_price,
            exact_price=exact_price,
            affordable_extra_cost=SHARE * (programmed_free_cost + moving_cost),
        )
    return ElasticLimits(
        safe_price=safe_price,
        lowest_trial_price=max(LOWEST * safe_price, lowest_price),
        exact_price=exact_price,
        affordable_extra_cost=SHARE * programmed_free_cost,
    )


def are_kept_again(distances: Array) -> bool:
    """Returns whether rows are missed early on the horizon rather than late.

    ``distances`` are by how much, all rows together, at each stage (H,).
    """
    centred_stages = np.arange(len(distances)) - (len(distances) - 1) / 2
    terms = centred_stages * distances
    return bool(terms.sum() <= NO_MOMENT * np.abs(terms).sum())


def _moving_cost(
    free: LocalProblem,
    missed: Array,
    gives_way: Array,
    Q: Array,
    largest_weight: float,
) -> float:
    """Returns J_move, what it costs to be beside the reference by violations.

    The violations ``missed`` (H, r') are of the rows that give way; other arguments are
    those of ``elastic_limits``.
    """
    n = Q.shape[-1]
    H = len(missed)
    gradients = _by_stage(free.rows.E, H)[:, gives_way, :n]
    state_weights = _by_stage(Q.reshape(-1, n, n), H)
    diagonals = np.diagonal(state_weights, axis1=1, axis2=2)
    largest = diagonals.max(axis=1, keepdims=True)
    largest = np.where(largest > 0.0, largest, largest_weight)
    squared_gradients = (gradients**2).sum(axis=2)
    weights = np.einsum("kri,kij,krj->kr", gradients, state_weights, gradients)
    has_weight = weights > NO_WEIGHT * largest * squared_gradients
    weights = np.where(has_weight, weights, largest * squared_gradients)
    if len(free.rows.D):
        by_input = free.rows.D[:, gives_way]
        weights = weights + largest * (by_input**2).sum(axis=2)
    # The cheapest move by a violation v along a gradient g is v g / |g|^2.
    squared_lengths = free.row_lengths()[:, gives_way] ** 2
    return float((weights * (missed / squared_lengths) ** 2).sum())


def _rounded(price: float, exact_price: float) -> float:
    """Returns a price of few digits: the exact one over quarters of powers of two.

    Else what rounding does to the cost of a plan would change the plan.
    """
    quarters = np.floor(4.0 * np.log2(price / exact_price) + 0.5)
    return float(exact_price * 2.0 ** (quarters / 4.0))


def _by_stage(parts: Array, horizon: int) -> Array:
    """Returns arrays of every stage, given these or one that stands for all."""
    return np.broadcast_to(parts, (horizon, *parts.shape[1:]))
