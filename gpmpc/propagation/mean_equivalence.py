"""Problem: the cheapest propagation: the mean goes through the model, what is uncertain of the state does not.

mu+ = m(mu, u), Sigma+ = Var[f(mu, u)] (Hewing, Kabzan and Zeilinger, 2020, "mean equivalence").
"""

import torch
from torch import Tensor

from gpmpc.dynamics import DynamicsModel
from gpmpc.gaussian import Gaussian
from gpmpc.propagation.expansion import expand
from gpmpc.propagation.propagator import Propagation, checked_input
from gpmpc.propagation.sensitivity import Sensitivity


class MeanEquivalence:
    """The prediction at the belief's mean.

    Args:
        observation_noise: Adds the model's noise covariance.
    """

    def __init__(self, observation_noise: bool = False):
        self.observation_noise = observation_noise

    def __call__(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Gaussian:
        """The next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief

    def propagate(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``. State and next state come out uncorrelated."""
        return self._propagation(model, belief, model.predict(belief.mean, checked_input(model, belief, input)))

    def differentiate(
        self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives in closed form; None where the model has none."""
        expansion = expand(model, belief.mean, checked_input(model, belief, input))
        if expansion is None:
            return None
        sensitivity = Sensitivity(
            expansion.A,
            torch.zeros_like(expansion.mean_by_state2),
            expansion.B,
            torch.diag_embed(expansion.variance_by_state.mT).movedim(-3, -1),
            torch.zeros_like(expansion.mean_by_state2)[..., None, :, :].repeat_interleave(expansion.belief.dim, -3),
            torch.diag_embed(expansion.variance_by_input.mT).movedim(-3, -1),
        )
        return self._propagation(model, belief, expansion.belief), sensitivity

    def _propagation(self, model: DynamicsModel, belief: Gaussian, moved: Gaussian) -> Propagation:
        covariance = moved.covariance + model.noise_covariance if self.observation_noise else moved.covariance
        cross = torch.zeros_like(belief.mean[..., :, None].expand(*belief.mean.shape, moved.dim))
        return Propagation(Gaussian(moved.mean, covariance), cross, torch.zeros_like(moved.mean[..., 0]))
