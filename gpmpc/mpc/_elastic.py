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
"""

from typing import NamedTuple

import numpy as np

from gpmpc.mpc._linearization import LocalProblem

Array = np.ndarray

# With 4 instead, a car beside its lane was lost now and then; with 1 a reactor's
# economic cost was worth more than its bound.
WORTH = 2.0
# With .05 a car comes back to its lane later; with .2 one of a poor model falls behind.
SHARE = 0.1
TRIALS = 5  # prices between the lowest and the exact one
NO_PRICE = 1e-9  # of a row that does not count: it keeps its place among the others
_LOWEST = 2.0**-8  # of the safe price, where violations grow along the horizon
_NO_MOMENT = 1e-6  # share of its terms below which a sum is rounding
_TINY = 1e-12


class ElasticLimits(NamedTuple):
    """What elastic rows that cannot be kept may cost.

    Attributes:
        safe_price: Under which no plan outweighs what the cost is for.
        lowest_trial_price: Of those that are tried for a plan that goes on.
        affordable_extra_cost: What such a plan may cost more than without them.
    """

    safe_price: float
    lowest_trial_price: float
    affordable_extra_cost: float


def elastic_limits(
    free: LocalProblem,
    free_cost: float,
    guess_cost: float,
    rows: Array,
    are_kept_again: bool,
    Q: Array,
    largest_weight: float,
) -> ElasticLimits:
    """Returns the limits of the price of elastic rows, from the plan without them.

    Args:
        free: With the plan that minimises the cost without these rows.
        free_cost: Of that plan, J0.
        guess_cost: Of the first guess, such as the last plan.
        rows: Which of the r rows they are (r,).
        are_kept_again: See ``are_kept_again``.
        Q: Weight of the states (n, n), or of those of each stage (H, n, n).
        largest_weight: Of the whole cost, which counts where Q is zero.
    """
    missed = free.row_violations()[:, rows]
    H = len(missed)
    n = Q.shape[-1]
    by_state = _by_stage(free.rows.E, H)[:, rows, :n]
    state_weights = _by_stage(Q.reshape(-1, n, n), H)
    diagonals = np.diagonal(state_weights, axis1=1, axis2=2)
    largest = diagonals.max(axis=1, keepdims=True)
    largest = np.where(largest > 0.0, largest, largest_weight)
    squares = (by_state**2).sum(axis=2)
    weights = np.einsum("kri,kij,krj->kr", by_state, state_weights, by_state)
    weights = np.where(weights > _TINY * largest * squares, weights, largest * squares)
    if len(free.rows.D):
        input_squares = (free.rows.D[:, rows] ** 2).sum(axis=2)
        weights = weights + largest * input_squares
        squares = squares + input_squares
    # The cheapest move by a violation v along a gradient g has the size v / |g|.
    lengths = np.where(squares > 0.0, squares, 1.0)
    moving_cost = (weights / lengths**2 * missed**2).sum()
    cost = min(max(free_cost, guess_cost), 2.0 * free_cost) + moving_cost
    safe_price = WORTH * cost / max(missed.sum(), _TINY)
    safe_price = _rounded(max(safe_price, NO_PRICE))
    if are_kept_again:
        return ElasticLimits(
            safe_price=safe_price,
            lowest_trial_price=safe_price,
            affordable_extra_cost=SHARE * (free_cost + moving_cost),
        )
    return ElasticLimits(
        safe_price=safe_price,
        lowest_trial_price=max(_LOWEST * safe_price, NO_PRICE),
        affordable_extra_cost=SHARE * free_cost,
    )


def are_kept_again(violations: Array) -> bool:
    """Returns whether rows are missed (H, r) early on the horizon rather than late."""
    by_stage = violations.sum(axis=1)
    centred_stages = np.arange(len(by_stage)) - (len(by_stage) - 1) / 2
    terms = centred_stages * by_stage
    return bool(terms.sum() <= _NO_MOMENT * np.abs(terms).sum())


def _rounded(price: float) -> float:
    """Returns a price of few digits, a quarter of a power of two.

    Else what rounding does to the cost of a plan would change the plan.
    """
    return 2.0 ** (np.floor(4.0 * np.log2(price) + 0.5) / 4.0)


def _by_stage(parts: Array, horizon: int) -> Array:
    """Returns arrays of every stage, given these or one that stands for all."""
    return np.broadcast_to(parts, (horizon, *parts.shape[1:]))
