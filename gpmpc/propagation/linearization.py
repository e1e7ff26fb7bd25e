"""Problem: propagate through the model's first-order expansion at the belief's mean, as an extended Kalman filter does.

With A = dm/dx, H_a = d2m_a/dx2 at (mu, u) and the model's own variance there,

    mu+ = m(mu, u) (+ 1/2 tr(H_a S)),   Sigma+ = A S A' + Var[f(mu, u)] (+ 1/2 tr(H_a S H_b S)),   Cov[x, x+] = S A'

The terms in brackets are those of the second-order filter (Jazwinski, 1970, section 9.3; Girard, Rasmussen, Quinonero
Candela and Murray-Smith, 2003, for GPs). The model's variance is taken at the mean.
"""

import torch
from torch import Tensor

from gpmpc.dynamics import DynamicsModel
from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite
from gpmpc.propagation.composition import Composition
from gpmpc.propagation.expansion import expand
from gpmpc.propagation.propagator import Propagation, checked_input
from gpmpc.propagation.sensitivity import Sensitivity


class Linearization:
    """First order, or with the Hessian terms second.

    Args:
        hessian: Adds the second-order terms.
        observation_noise: Adds the model's noise covariance.
    """

    def __init__(self, hessian: bool = False, observation_noise: bool = False):
        self.hessian, self.observation_noise = hessian, observation_noise

    @property
    def first_order(self) -> bool:
        """Whether mean, derivatives and variance of the model at the belief's mean are all that it takes."""
        return not self.hessian

    def __call__(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Gaussian:
        """The next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief

    def propagate(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``."""
        input = checked_input(model, belief, input)
        at_mean, A, _ = model.predict_with_jacobian(belief.mean, input)
        return self._propagation(model, belief, input, at_mean, A)

    def differentiate(
        self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives in closed form; None where there is none (always with ``hessian``)."""
        input = checked_input(model, belief, input)
        expansion = None if self.hessian else expand(model, belief.mean, input)
        if expansion is None:
            return None
        A = expansion.A
        AS = A @ belief.covariance
        by_mean = torch.einsum("...ip,...jpc->...ijc", AS, expansion.mean_by_state2)
        by_input = torch.einsum("...ip,...jpc->...ijc", AS, expansion.mean_by_state_input)
        by_covariance = torch.einsum("...ic,...jd->...ijcd", A, A)
        sensitivity = Sensitivity(
            A,
            torch.zeros_like(expansion.mean_by_state2),
            expansion.B,
            by_mean + by_mean.transpose(-3, -2) + torch.diag_embed(expansion.variance_by_state.mT).movedim(-3, -1),
            (by_covariance + by_covariance.mT) / 2,
            by_input + by_input.transpose(-3, -2) + torch.diag_embed(expansion.variance_by_input.mT).movedim(-3, -1),
        )
        return self._propagation(model, belief, input, expansion.belief, A), sensitivity

    def _propagation(
        self, model: DynamicsModel, belief: Gaussian, input: Tensor, at_mean: Gaussian, A: Tensor
    ) -> Propagation:
        S = belief.covariance
        mean, covariance = at_mean.mean, at_mean.covariance + A @ S @ A.mT
        if self.hessian:
            H = mean_hessian(model, belief.mean, input)
            HS = H @ S[..., None, :, :]
            mean = mean + HS.diagonal(dim1=-2, dim2=-1).sum(-1) / 2
            covariance = covariance + (HS[..., :, None, :, :] * HS[..., None, :, :, :].mT).sum((-2, -1)) / 2
        if self.observation_noise:
            covariance = covariance + model.noise_covariance
        covariance, deficit = nearest_positive_semidefinite(covariance)
        return Propagation(Gaussian(mean, covariance), S @ A.mT, deficit)


def mean_hessian(model: DynamicsModel, state: Tensor, input: Tensor) -> Tensor:
    """d2m/dx2 (*batch, k, n, n): in closed form for SE-ARD GPs, else by torch autograd."""
    composition = Composition.of(model)
    if composition is not None:  # an affine part has no second derivative
        seen, control = composition.seen(Gaussian.certain(state), input)
        return composition.outer(composition.f.mean_hessian(seen.mean, control))
    again = torch.is_grad_enabled() and (state.requires_grad or input.requires_grad)
    with torch.inference_mode(False), torch.enable_grad():
        x = state if state.requires_grad and again else state.detach().clone().requires_grad_()
        _, A, _ = model.predict_with_jacobian(x, input)
        if not A.requires_grad:  # the model is linear in the state
            return A.new_zeros(*A.shape, A.shape[-1])
        rows = [
            torch.autograd.grad(A[..., a, d].sum(), x, create_graph=again, retain_graph=True, materialize_grads=True)[0]
            for a in range(A.shape[-2])
            for d in range(A.shape[-1])
        ]
    return torch.stack(rows, dim=-2).unflatten(-2, A.shape[-2:])
