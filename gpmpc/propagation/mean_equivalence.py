"""Problem: the cheapest propagation: the mean goes through the model, what is uncertain of the state does not.

mu+ = m(mu, u), Sigma+ = Var[f(mu, u)] (Hewing, Kabzan and Zeilinger, 2020, "mean equivalence").
"""

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian
from gpmpc.gp.dynamics import DynamicsModel
from gpmpc.propagation.propagator import Propagation, checked_input


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
        input = checked_input(model, belief, input)
        moved = model.predict(belief.mean, input)
        covariance = moved.covariance + model.noise_covariance if self.observation_noise else moved.covariance
        cross = torch.zeros_like(belief.mean[..., :, None].expand(*belief.mean.shape, moved.dim))
        return Propagation(Gaussian(moved.mean, covariance), cross, torch.zeros_like(moved.mean[..., 0]))
