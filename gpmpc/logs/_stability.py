"""Stability of models of logs far from their data."""

from dataclasses import replace

import numpy as np

from gpmpc.models._log_linearization import LogLinearizer
from gpmpc.models._log_model import LogModel

_MARGIN = 1e-3  # of growth in a step that is none


def grows_outside(model: LogModel, input_dim: int, time_step: float) -> bool:
    """Returns whether a model of products grows without bounds outside of its data.

    There its products stand still, and its linear part alone decides: whether an
    eigenvalue of it is outside of the unit circle. Any other model is what it is.

    Args:
        model: Without context.
        input_dim: m.
        time_step: [s].
    """
    memory = model.memory
    if memory.products is None:
        return False
    count = len(memory.products.factors)
    weights = np.delete(model.weights, np.s_[-1 - count : -1], axis=1)
    linear = replace(
        model,
        memory=replace(memory, products=None),
        weights=weights,
        gps=(),
        correction=None,
        start_filter=None,
    )
    carried = np.zeros(linear.carried_dim(input_dim))
    origin = np.concatenate([model.kinematics.space.origin, carried])
    at_origin = LogLinearizer(linear, input_dim, time_step)(
        origin[None], np.zeros((1, input_dim)), covariance=False
    )
    return bool(np.abs(np.linalg.eigvals(at_origin.A[0])).max() > 1 + _MARGIN)
