"""The derivatives of the next belief by the belief and the input it started from.

``differentiate`` gives all six derivatives of (mu+, Sigma+) by (mu, Sigma, u): by the propagator's own method
``differentiate`` where it has closed forms for the model, else by torch autograd.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gpmpc._dynamics import batched_jacobian
from gpmpc.gaussian import Gaussian
from gpmpc.propagation._propagator import Propagation, Propagator, checked_input


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the next belief N(mu+, Sigma+) at a belief N(mu, Sigma) and an input u; k outputs, mostly k = n.

    Those by Sigma are symmetric in their last two indices: d mu+_a = sum_cd mean_by_covariance[a, c, d] dSigma[c, d]
    for symmetric dSigma.
    """

    mean_by_mean: Tensor  #: (*batch, k, n)
    mean_by_covariance: Tensor  #: (*batch, k, n, n)
    mean_by_input: Tensor  #: (*batch, k, m)
    covariance_by_mean: Tensor  #: (*batch, k, k, n)
    covariance_by_covariance: Tensor  #: (*batch, k, k, n, n)
    covariance_by_input: Tensor  #: (*batch, k, k, m)

    def of_variances(self) -> "Sensitivity":
        """The derivatives where only the diagonal of the next covariance is kept."""
        k = self.covariance_by_mean.shape[-2]
        keep = torch.eye(k, dtype=self.mean_by_mean.dtype, device=self.mean_by_mean.device)
        return replace(
            self,
            covariance_by_mean=self.covariance_by_mean * keep[:, :, None],
            covariance_by_covariance=self.covariance_by_covariance * keep[:, :, None, None],
            covariance_by_input=self.covariance_by_input * keep[:, :, None],
        )


def differentiate(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> tuple[Propagation, Sensitivity]:
    """Moves a belief one step on, with its derivatives.

    Args:
        propagator: How.
        model: A ``DynamicsModel``.
        belief: Mean (*batch, n), covariance (*batch, n, n).
        input: (*batch, m); may be left out where m = 0.

    Returns:
        What ``propagator.propagate`` returns, and the derivatives. Where the covariance had to be projected they are
        those of the projection (autograd) or of what was projected (closed form).
    """
    closed_form = getattr(propagator, "differentiate", None)
    if closed_form is not None and (found := closed_form(model, belief, input)) is not None:
        return found
    return by_autograd(propagator, model, belief, input)


def by_autograd(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> tuple[Propagation, Sensitivity]:
    """``differentiate`` by torch autograd, for any propagator and model that torch can follow."""
    input, n, k = checked_input(model, belief, input), belief.dim, model.output_dim
    with torch.inference_mode(False):  # inference tensors, constants too, could not be saved for backward
        rows, columns = torch.tril_indices(k, k, device=belief.mean.device)
    batch = belief.mean.shape[:-1]

    def step(mean: Tensor, covariance: Tensor, control: Tensor) -> tuple[Tensor, ...]:
        out = propagator.propagate(model, Gaussian(mean, covariance.unflatten(-1, (n, n))), control)
        entries = torch.cat([out.belief.mean, out.belief.covariance[..., rows, columns]], dim=-1)
        return entries, out.belief.mean, out.belief.covariance, out.cross_covariance, out.deficit

    values, (by_mean, by_covariance, by_input) = batched_jacobian(
        step, (belief.mean, belief.covariance.flatten(-2), input.expand(*batch, input.shape[-1]))
    )
    by_covariance = by_covariance.unflatten(-1, (n, n))
    by_covariance = (by_covariance + by_covariance.mT) / 2
    whole = torch.zeros(k, k, dtype=torch.long, device=rows.device)
    whole[rows, columns] = whole[columns, rows] = torch.arange(len(rows), device=rows.device) + k
    of_mean = by_mean[..., :k, :], by_covariance[..., :k, :, :], by_input[..., :k, :]
    of_covariance = by_mean[..., whole, :], by_covariance[..., whole, :, :], by_input[..., whole, :]
    moved = Propagation(Gaussian(values[1], values[2]), values[3], values[4])
    return moved, Sensitivity(*of_mean, *of_covariance)
