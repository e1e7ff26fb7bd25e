"""Problem: what linearised propagation and its derivatives need of a model at one point, from one evaluation."""

from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc.dynamics import DynamicsModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp.backend import host_arrays
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
    """The expansion of a ``GPPosterior``, compiled or by torch; None for other models."""
    if not isinstance(model, GPPosterior):
        return None
    if (arrays := host_arrays(model.weights, state, input)) is None:
        parts = _by_torch(model, state, input)
    else:
        from gpmpc import kernels  # loads numba

        batch = state.shape[:-1]
        flat = arrays[1].reshape(-1, model.state_dim)
        found = kernels.point_with_jacobian(model.packed, flat, arrays[2].reshape(len(flat), model.input_dim))
        parts = [torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found[:8]]
    mean, A = parts[0] + model.offset, parts[2]
    if model.predicts == "difference":
        mean, A = mean + state, A + torch.eye(model.state_dim, dtype=A.dtype, device=A.device)
    return Expansion(Gaussian(mean, torch.diag_embed(parts[1])), A, *parts[3:])


def _by_torch(model: GPPosterior, state: Tensor, input: Tensor) -> list[Tensor]:
    """The first eight entries of ``kernels.Expansion``."""
    n, inverse_squares = model.state_dim, model.lengthscales**-2
    difference = (model.features - torch.cat([state, input], dim=-1)[..., None, :])[..., None, :, :]
    z = difference * inverse_squares[:, None, :]  # (*batch, k, N, d)
    k = model.signal_variance[:, None] * torch.exp(-(z * difference).sum(-1) / 2)
    weighted, explained_by = model.weights * k, model.solve(k)
    jacobian = (weighted[..., None, :] @ z)[..., 0, :]
    variance_by = -2 * ((explained_by * k)[..., None, :] @ z)[..., 0, :]
    own = torch.diag_embed(inverse_squares)[:, :n]
    second = (weighted[..., None] * z[..., :n]).mT @ z - weighted.sum(-1)[..., None, None] * own
    variance = (model.signal_variance - model.variance_reduction(k)).clamp_min(0)
    parts = [half for whole in (jacobian, variance_by, second) for half in (whole[..., :n], whole[..., n:])]
    return [weighted.sum(-1), variance, *parts]
