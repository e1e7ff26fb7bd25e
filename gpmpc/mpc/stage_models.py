"""Problem: what one stage of a prediction asks of the learned model, for one belief or for many of them at once.

    s+ = A s + B u + c

near a belief and an input, for the s of each covariance mode of ``gpmpc.mpc.prediction``, and the next belief. All
of it is torch on the model's device, batched over leading dimensions. Where a feedback can act on the covariance, V is
what the stage adds to the spread of the state, whatever passes through: Sigma+ less A Cov[x, x+] = A Sigma A' (mean
equivalence lets nothing pass), projected onto the positive semidefinite matrices.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gpmpc.dynamics import DynamicsModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp.posterior import GPPosterior
from gpmpc.propagation import Linearization, Propagator, differentiate, linearize


class StageModel(NamedTuple):
    """One stage.

    Attributes:
        A: (*batch, p, p).
        B: (*batch, p, m).
        c: (*batch, p).
        next: The next belief of the state, without feedback.
        V: (*batch, n, n); None where no feedback can act.
    """

    A: Tensor
    B: Tensor
    c: Tensor
    next: Gaussian
    V: Tensor | None


def stage_model(
    covariance: str, propagator: Propagator, model: DynamicsModel, belief: Gaussian, input: Tensor
) -> StageModel:
    """The stage at a belief (*batch, n) and an input (*batch, m), in a covariance mode."""
    return _MODES[covariance](propagator, model, belief, input)


def disturbed(stage: StageModel, disturbance: Tensor) -> StageModel:
    """The stage whose mean has a disturbance (*batch, n) added."""
    rest = stage.c.shape[-1] - disturbance.shape[-1]  # entries of s that are no means
    after = Gaussian(stage.next.mean + disturbance, stage.next.covariance)
    return stage._replace(c=stage.c + torch.nn.functional.pad(disturbance, (0, rest)), next=after)


def is_first_order(propagator: Propagator) -> bool:
    """Whether a stage of ``zero_order`` needs no more than mean, covariance and the mean's derivatives at a point."""
    return type(propagator) is Linearization and not propagator.hessian


def _full(propagator: Propagator, model: DynamicsModel, belief: Gaussian, input: Tensor) -> StageModel:
    local = linearize(propagator, model, belief, input)
    return StageModel(local.A, local.B, local.c, local.next, None)


def _diagonal(propagator: Propagator, model: DynamicsModel, belief: Gaussian, input: Tensor) -> StageModel:
    belief = Gaussian(belief.mean, torch.diag_embed(belief.variance))
    moved, d = differentiate(propagator, model, belief, input)
    deviations, after = belief.variance.sqrt(), moved.belief.variance.sqrt()
    # d Sigma_cc = 2 sd_c d sd_c, and the same backwards; where the next deviation is zero it has no derivative.
    positive = after > 0
    backwards = torch.where(positive, 0.5 / torch.where(positive, after, 1.0), 0.0)[..., None]
    twice = 2 * deviations[..., None, :]
    mean_by_deviation = d.mean_by_covariance.diagonal(dim1=-2, dim2=-1) * twice
    variance_by_mean, variance_by_input = (
        part.diagonal(dim1=-3, dim2=-2).mT for part in (d.covariance_by_mean, d.covariance_by_input)
    )
    variance_by_variance = d.covariance_by_covariance.diagonal(dim1=-2, dim2=-1).diagonal(dim1=-3, dim2=-2).mT
    upper = torch.cat([d.mean_by_mean, mean_by_deviation], dim=-1)
    lower = torch.cat([backwards * variance_by_mean, backwards * variance_by_variance * twice], dim=-1)
    A = torch.cat([upper, lower], dim=-2)
    B = torch.cat([d.mean_by_input, backwards * variance_by_input], dim=-2)
    s, s_next = torch.cat([belief.mean, deviations], dim=-1), torch.cat([moved.belief.mean, after], dim=-1)
    return StageModel(A, B, _rest(s_next, A, s, B, input), _independent(moved.belief), None)


def _zero_order(propagator: Propagator, model: DynamicsModel, belief: Gaussian, input: Tensor) -> StageModel:
    if is_first_order(propagator):
        at_mean, A, B = model.predict_with_jacobian(belief.mean, input)
        mean, V = at_mean.mean, at_mean.covariance
        V = V + model.noise_covariance if propagator.process_noise else V
        after = Gaussian(mean, A @ belief.covariance @ A.mT + V)
    else:
        moved, d = differentiate(propagator, model, belief, input)
        A, B, after = d.mean_by_mean, d.mean_by_input, moved.belief
        passed = A @ moved.cross_covariance
        eigenvalues, vectors = torch.linalg.eigh(after.covariance - (passed + passed.mT) / 2)
        V = (vectors * eigenvalues.clamp_min(0)[..., None, :]) @ vectors.mT
    return StageModel(A, B, _rest(after.mean, A, belief.mean, B, input), after, V)


def _none(propagator: Propagator, model: DynamicsModel, belief: Gaussian, input: Tensor) -> StageModel:
    if isinstance(model, GPPosterior):
        mean, A, B = model.mean_with_jacobian(belief.mean, input)
    else:
        at_mean, A, B = model.predict_with_jacobian(belief.mean, input)
        mean = at_mean.mean
    return StageModel(A, B, _rest(mean, A, belief.mean, B, input), Gaussian(mean, belief.covariance), None)


_MODES = {"full": _full, "diagonal": _diagonal, "zero_order": _zero_order, "none": _none}


def _rest(after: Tensor, A: Tensor, s: Tensor, B: Tensor, input: Tensor) -> Tensor:
    """The constant c of s+ = A s + B u + c."""
    return after - (A @ s[..., None] + B @ input[..., None])[..., 0]


def _independent(belief: Gaussian) -> Gaussian:
    return Gaussian(belief.mean, torch.diag_embed(belief.variance))
