"""What a violation costs of a bound that gives way: an elastic one that a program cannot keep.

An exact price of 1e6 weights says that nothing matters beside the bound. Where it can be kept that is what is asked
for. Where it cannot, as after a gust that pushed a vehicle out of its lane, such a price spends everything on coming
back a step earlier, be it the vehicle. There a price is taken that cannot outweigh what the cost is for: with J0 the
cost of the plan without elastic bounds, and V0 the sum of its violations, at

    price = WORTH J0 / V0

no plan that is better under it costs more than (1 + WORTH) J0, whatever it gains: J + price V <= J0 + price V0. A plan
that costs nothing has no scale; what it would cost to be beside its reference by its violations is added to J0.
"""

import numpy as np

from gpmpc.mpc._prediction import Prediction

Array = np.ndarray

# In costs of the plan without elastic bounds, what keeping them may cost. On a car in
# a lane, more than 4 spends the car now and then, and less leaves the lane for longer.
WORTH = 4.0
_TINY = 1e-12


def violations(prediction: Prediction, elastic: Array) -> Array:
    """By how much a plan misses each elastic row at each stage (H, r), zero where it is kept."""
    E, D, lower, upper = prediction.rows
    states = prediction.plan.states[1:]
    values = np.einsum("kri,ki->kr", _by_stage(E, len(states)), states)
    if len(D):
        values = values + np.einsum("krj,kj->kr", D, prediction.plan.inputs)
    outside = np.maximum(values - upper, lower - values)
    return np.maximum(0.0, outside)[:, elastic]


def elastic_price(
    prediction: Prediction, cost: float, elastic: Array, Q: Array
) -> float:
    """The price of elastic rows, from the plan without them.

    Args:
        prediction: With the plan that minimises the cost alone.
        cost: Of that plan.
        elastic: Which of the r rows are elastic (r,).
        Q: Weight of the states (n, n), or of those of each stage (H, n, n).
    """
    missed = violations(prediction, elastic)
    gradients = _by_stage(prediction.rows.E, len(missed))
    gradients = gradients[:, elastic, : Q.shape[-1]]
    weights = np.einsum("kri,...ij,krj->kr", gradients, _one_weight(Q), gradients)
    squares = (gradients**2).sum(axis=2)
    # The cheapest move by a violation v along a gradient g has the size v / |g|.
    beside = weights / np.maximum(squares, _TINY) ** 2 * missed**2
    return WORTH * (cost + beside.sum()) / max(missed.sum(), _TINY)


def _by_stage(rows: Array, horizon: int) -> Array:
    """Rows of every stage, where one may stand for all."""
    return np.broadcast_to(rows, (horizon, *rows.shape[1:]))


def _one_weight(Q: Array) -> Array:
    """The largest of the weights of all stages, entry by entry, or the one of all."""
    return Q if Q.ndim == 2 else Q.max(axis=0)
