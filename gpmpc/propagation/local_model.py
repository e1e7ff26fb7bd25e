"""The belief's dynamics as a linear system in an extended state and the input, for convex controllers.

With the extended state s = [mu; vec(S)], S = Sigma^(1/2) the symmetric root, p = n + n^2 (Cao, Lai and Alam, 2017,
section 4.1),

    s+ = F(s, u)  ~  A s + B u + c,    A = dF/ds,  B = dF/du,  c = F(s, u) - A s - B u

Sigma = S S', so dSigma = dS S' + S dS'; the root's derivative solves dS S + S dS = dSigma
(``gaussian.square_root_differential``). Where Sigma = 0 (a measured state) the columns of A for S vanish, because
Sigma+ depends on S to second order only; where Sigma+ is singular the root has no derivative, and its rows are zero in
the null space.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.exceptions import ShapeError
from gpmpc.gaussian import Gaussian, check_tensors, square_root_differential
from gpmpc.gp.backend import host_arrays
from gpmpc.propagation.propagator import Propagator
from gpmpc.propagation.sensitivity import Sensitivity, differentiate


@dataclass(frozen=True)
class LocalModel:
    """s+ = A s + B u + c near a belief and an input; batched over leading dimensions.

    Attributes:
        A: (*batch, p, p), p = n + n^2.
        B: (*batch, p, m).
        c: (*batch, p).
        next: The next belief itself, F(s, u).
    """

    A: Tensor
    B: Tensor
    c: Tensor
    next: Gaussian

    def __call__(self, s: Tensor, input: Tensor) -> Tensor:
        """The next extended state (*batch, p)."""
        return (self.A @ s[..., None] + self.B @ input[..., None])[..., 0] + self.c


def extended_state(belief: Gaussian) -> tuple[Tensor, Tensor, Tensor]:
    """The vector s = [mu; vec(S)] (*batch, p), and the eigenvalues (*batch, n) and eigenvectors (*batch, n, n) of S."""
    eigenvalues, U = torch.linalg.eigh(belief.covariance)
    r = eigenvalues.clamp_min(0).sqrt()
    S = U @ (r[..., :, None] * U.mT)
    return torch.cat([belief.mean, S.flatten(-2)], dim=-1), r, U


def linearize(propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None) -> LocalModel:
    """The local model at a belief and an input, or along a plan when both have a leading dimension H.

    A local model is a constant: no gradient flows through it, and torch's function transforms do not apply.

    Args:
        propagator: How the belief moves.
        model: A ``DynamicsModel``.
        belief: Mean (*batch, n), covariance (*batch, n, n).
        input: (*batch, m); may be left out where m = 0.
    """
    belief = Gaussian(belief.mean.detach(), belief.covariance.detach())
    input = belief.mean[..., :0] if input is None else input.detach()
    if model.output_dim != belief.dim:
        raise ShapeError(f"a local model needs an output a state; got {belief.dim} states, {model.output_dim} outputs")
    moved, d = differentiate(propagator, model, belief, input)
    batch, n, m = belief.mean.shape[:-1], belief.dim, input.shape[-1]
    input = input.expand(*batch, m)
    parts = belief.mean, belief.covariance, input, moved.belief.mean, moved.belief.covariance
    derivatives = [getattr(d, field.name) for field in fields(d)]
    arrays = host_arrays(*parts, *derivatives)
    if arrays is None:
        return LocalModel(*_extended(belief, input, moved.belief, d), moved.belief)
    from gpmpc.kernels.extended_state import extended_models  # loads numba

    H, p = batch.numel(), n + n * n
    arrays = [np.ascontiguousarray(array.reshape(H, *array.shape[len(batch) :])) for array in arrays]
    out = np.empty((H, p, p)), np.empty((H, p, m)), np.empty((H, p))
    extended_models(*arrays[:5], tuple(arrays[5:]), *out)
    A, B, c = (torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in out)
    return LocalModel(A, B, c, moved.belief)


def _extended(belief: Gaussian, input: Tensor, after: Gaussian, d: Sensitivity) -> tuple[Tensor, Tensor, Tensor]:
    """A, B and c by torch."""
    s, _, _ = extended_state(belief)
    s_next, r_next, U_next = extended_state(after)
    n = belief.dim
    S = s[..., n:].unflatten(-1, (n, n))

    # dSigma = E S' + S E' for a unit change E_kl of S: a derivative D by Sigma becomes 2 D S.
    mean_by_root = 2 * d.mean_by_covariance @ S[..., None, :, :]
    covariance_by_root = 2 * d.covariance_by_covariance @ S[..., None, None, :, :]
    k = after.dim
    covariance_rows = torch.cat(
        [d.covariance_by_mean.flatten(-3, -2), covariance_by_root.flatten(-2).flatten(-3, -2)], dim=-1
    )
    by_input = d.covariance_by_input.flatten(-3, -2)
    roots = square_root_differential(
        r_next, U_next, torch.cat([covariance_rows, by_input], dim=-1).unflatten(-2, (k, k))
    )
    roots = roots.flatten(-3, -2)
    p = n + n * n
    A = torch.cat([torch.cat([d.mean_by_mean, mean_by_root.flatten(-2)], dim=-1), roots[..., :p]], dim=-2)
    B = torch.cat([d.mean_by_input, roots[..., p:]], dim=-2)
    c = s_next - (A @ s[..., None] + B @ input[..., None])[..., 0]
    return A, B, c


def rollout(propagator: Propagator, model: Any, belief: Gaussian, inputs: Tensor) -> Gaussian:
    """The beliefs at steps 1 to H: mean (*batch, H, n), covariance (*batch, H, n, n).

    Args:
        propagator: How the belief moves.
        model: A ``DynamicsModel``.
        belief: At step 0 (*batch).
        inputs: (*batch, H, m); an autonomous model takes (*batch, H, 0).
    """
    check_tensors(inputs=inputs)
    if inputs.dim() < 2 or not inputs.shape[-2]:
        raise ShapeError(f"inputs must be (*batch, H, m) with H of 1 or more; got {tuple(inputs.shape)}")
    beliefs = []
    for control in inputs.unbind(-2):
        belief = propagator(model, belief, control)
        beliefs.append(belief)
    return Gaussian(
        torch.stack([b.mean for b in beliefs], dim=-2), torch.stack([b.covariance for b in beliefs], dim=-3)
    )
