"""Problem: what linearised propagation and its derivatives need of a model at one point, from compiled loops."""

from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian
from gpmpc.gp.dynamics import DynamicsModel
from gpmpc.gp.evaluation import host_arrays
from gpmpc.gp.posterior import GPPosterior


class Expansion(NamedTuple):
    """The model around a certain state and input.

    Attributes:
        belief: The prediction there.
        A: The mean's derivative by the state (*batch, k, n).
        B: By the input (*batch, k, m).
        variance_by_state: (*batch, k, n).
        variance_by_input: (*batch, k, m).
        mean_by_state2: Second derivatives (*batch, k, n, n).
        mean_by_state_input: (*batch, k, n, m).
    """

    belief: Gaussian
    A: Tensor
    B: Tensor
    variance_by_state: Tensor
    variance_by_input: Tensor
    mean_by_state2: Tensor
    mean_by_state_input: Tensor


def expand(model: DynamicsModel, state: Tensor, input: Tensor) -> Expansion | None:
    """The expansion of a ``GPPosterior``; None for other models, and where torch has to follow."""
    if not isinstance(model, GPPosterior) or (arrays := host_arrays(model.weights, state, input)) is None:
        return None
    from gpmpc import fused  # loads numba

    batch = state.shape[:-1]
    flat = arrays[1].reshape(-1, model.state_dim)
    found = fused.point_with_jacobian(model.packed, flat, arrays[2].reshape(len(flat), model.input_dim))
    parts = [torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found[:8]]
    mean, A = parts[0] + model.offset, parts[2]
    if model.predicts == "difference":
        mean, A = mean + state, A + torch.eye(model.state_dim, dtype=A.dtype)
    return Expansion(Gaussian(mean, torch.diag_embed(parts[1])), A, *parts[3:])
