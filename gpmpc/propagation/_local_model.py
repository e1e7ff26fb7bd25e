"""The belief's dynamics as a linear system in an extended state and the input, for convex controllers.

With the extended state s = [mu; vec(S)], S = Sigma^(1/2) the symmetric root, p = n + n^2 (Cao, Lai and Alam, 2017,
section 4.1),

    s+ = F(s, u)  ~  A s + B u + c,    A = dF/ds,  B = dF/du,  c = F(s, u) - A s - B u

Sigma = S S', so dSigma = dS S' + S dS'; the root's derivative solves dS S + S dS = dSigma
(``gaussian.square_root_differential``). Where Sigma = 0 (a measured state) the columns of A for S vanish, because
Sigma+ depends on S to second order only; where Sigma+ is singular the root has no derivative, and its rows are zero in
the null space.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array, tensors_for, to_array
from gpmpc.exceptions import ShapeError
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.propagation._propagator import Propagator, differentiate


@dataclass(frozen=True)
class LocalModel:
    """s+ = A s + B u + c near a belief and an input; batched over leading dimensions."""

    A: Tensor  #: (*batch, p, p), p = n + n^2
    B: Tensor  #: (*batch, p, m)
    c: Tensor  #: (*batch, p)
    next: Gaussian  #: the next belief itself
    next_state: Tensor  #: it as an extended state, F(s, u) (*batch, p)

    def __call__(self, s: Tensor, input: Tensor) -> Tensor:
        """The next extended state (*batch, p)."""
        return (self.A @ s[..., None] + self.B @ input[..., None])[..., 0] + self.c


def square_roots(covariances: Array) -> tuple[Array, Array, Array]:
    """The symmetric roots (*batch, n, n) of covariances, their eigenvalues (*batch, n) and eigenvectors."""
    eigenvalues, U = np.linalg.eigh(covariances)
    r = np.sqrt(np.maximum(eigenvalues, 0.0))
    return (U * r[..., None, :]) @ U.mT, r, U


def linearize(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> LocalModel:
    """Linearises the next belief at a belief and an input, or along a plan when both have a leading dimension H.

    A local model is a constant: no gradient flows through it, and torch's function transforms do not apply. Arguments
    are those of ``differentiate``.
    """
    belief = Gaussian(belief.mean.detach(), belief.covariance.detach())
    input = belief.mean[..., :0] if input is None else input.detach()
    if model.output_dim != belief.dim:
        raise ShapeError(
            f"a local model needs an output a state; got {belief.dim} states, {model.output_dim} outputs"
        )
    moved, d = differentiate(propagator, model, belief, input)
    batch = belief.mean.shape[:-1]
    n = belief.dim
    p = belief.dim + belief.dim**2
    of_mean, mean_by_covariance, mean_by_input, by_mean, by_covariance, by_input = map(
        to_array, vars(d).values()
    )
    covariances = np.stack(
        [to_array(belief.covariance), to_array(moved.belief.covariance)]
    )
    roots, (_, r), (_, U) = square_roots(covariances)
    means = np.stack([to_array(belief.mean), to_array(moved.belief.mean)])
    u = to_array(input.expand(*batch, -1))
    s, s_next = np.concatenate([means, roots.reshape(2, *batch, n * n)], axis=-1)
    # dSigma = E S + S E for a change E of the root: a derivative D by Sigma becomes 2 D S.
    twice = 2 * roots[0][..., None, :, :]
    mean_by_root = (mean_by_covariance @ twice).reshape(*batch, n, n * n)
    by_root = (by_covariance @ twice[..., None, :, :]).reshape(*batch, n, n, n * n)
    # In the basis U of the next root, entry ij of its derivative is that of dSigma+ over r_i + r_j.
    total = r[..., :, None] + r[..., None, :]
    inverse = (total > 0) / np.maximum(total, np.finfo(float).tiny)
    change = _congruence(U.mT, np.concatenate([by_mean, by_root, by_input], axis=-1))
    lower = _congruence(U, change * inverse[..., None]).reshape(*batch, n * n, -1)
    A = np.concatenate(
        [np.concatenate([of_mean, mean_by_root], axis=-1), lower[..., :p]], axis=-2
    )
    B = np.concatenate([mean_by_input, lower[..., p:]], axis=-2)
    c = s_next - (A @ s[..., None] + B @ u[..., None])[..., 0]
    A, B, c, after = tensors_for(model, A, B, c, s_next)
    return LocalModel(A, B, c, moved.belief, after)


def _congruence(U: Array, X: Array) -> Array:
    """U X U' for as many X as wanted along the last dimension (*batch, n, n, j)."""
    return U[..., None, :, :] @ (U @ X.reshape(*X.shape[:-2], -1)).reshape(X.shape)


def rollout(
    propagator: Propagator, model: Any, belief: Gaussian, inputs: Tensor
) -> Gaussian:
    """The beliefs at steps 1 to H: mean (*batch, H, n), covariance (*batch, H, n, n).

    From a belief at step 0 (*batch) and inputs (*batch, H, m); an autonomous model takes (*batch, H, 0).
    """
    check_tensors(inputs=inputs)
    if inputs.dim() < 2 or not inputs.shape[-2]:
        raise ShapeError(
            f"inputs must be (*batch, H, m) with H of 1 or more; got {tuple(inputs.shape)}"
        )
    beliefs = []
    for control in inputs.unbind(-2):
        belief = propagator(model, belief, control)
        beliefs.append(belief)
    covariance = torch.stack([b.covariance for b in beliefs], dim=-3)
    return Gaussian(torch.stack([b.mean for b in beliefs], dim=-2), covariance)
