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
weight does: else a bound in it would count for nothing.

This is the least price. The linearised program may promise more than the vehicle can
do: as long as a plan that the model itself rolls out costs at most a SHARE of J0 more,
the bound may be dearer. Of a few prices up to the exact one the highest such is taken;
for a first plan, whose guess says little about costs, the least. It is the least, too,
for what follows on a plan that missed such bounds by more than its program, under the
exact price, had promised: what the program sees is not what the model does.
"""

from typing import NamedTuple

import numpy as np

from gpmpc.mpc._linearization import LocalProblem

Array = np.ndarray

# With 4 instead, a car beside its lane was lost now and then; with 1 a reactor's
# economic cost was worth more than its bound.
WORTH = 2.0
# With .05 a car comes back to its lane later; with .25 one of a poor model was lost.
SHARE = 0.1
TRIALS = 5  # prices between the least and the exact one
NO_PRICE = 1e-9  # of a row that does not count: it keeps its place among the others
_TINY = 1e-12


class ElasticLimits(NamedTuple):
    """What elastic rows that cannot be kept may cost.

    Attributes:
        least_price: Under which no plan outweighs what the cost is for.
        extra_cost: What a plan under a higher price may cost more than without them.
    """

    least_price: float
    extra_cost: float


def elastic_limits(
    local: LocalProblem,
    free_cost: float,
    guess_cost: float,
    elastic: Array,
    Q: Array,
    largest_weight: float,
) -> ElasticLimits:
    """Returns the limits of the price of elastic rows, from the plan without them.

    Args:
        local: With the plan that minimises the cost alone.
        free_cost: Of that plan, J0.
        guess_cost: Of the first guess, such as the last plan.
        elastic: Which of the r rows are elastic (r,).
        Q: Weight of the states (n, n), or of those of each stage (H, n, n).
        largest_weight: Of the whole cost, which counts where Q is zero.
    """
    missed = local.row_violations(elastic)
    gradients = _by_stage(local.rows.E, len(missed))
    gradients = gradients[:, elastic, : Q.shape[-1]]
    n = Q.shape[-1]
    of_stages = _by_stage(Q.reshape(-1, n, n), len(missed))
    weights = np.einsum("kri,kij,krj->kr", gradients, of_stages, gradients)
    squares = (gradients**2).sum(axis=2)
    diagonals = np.diagonal(of_stages, axis1=1, axis2=2)
    largest = diagonals.max(axis=1, keepdims=True)
    largest = np.where(largest > 0.0, largest, largest_weight) * squares
    weights = np.where(weights > _TINY * largest, weights, largest)
    # The cheapest move by a violation v along a gradient g has the size v / |g|.
    moving_costs = weights / np.maximum(squares, _TINY) ** 2 * missed**2
    moving_cost = moving_costs.sum()
    cost = min(max(free_cost, guess_cost), 2.0 * free_cost) + moving_cost
    least_price = max(WORTH * cost / max(missed.sum(), _TINY), NO_PRICE)
    return ElasticLimits(
        least_price=_rounded(least_price),
        extra_cost=SHARE * (free_cost + moving_cost),
    )


def _rounded(price: float) -> float:
    """Returns a price of few digits, a quarter of a power of two.

    Else what rounding does to the cost of a plan would change the plan.
    """
    return 2.0 ** (np.floor(4.0 * np.log2(price) + 0.5) / 4.0)


def _by_stage(parts: Array, horizon: int) -> Array:
    """Returns arrays of every stage, given these or one that stands for all."""
    return np.broadcast_to(parts, (horizon, *parts.shape[1:]))
