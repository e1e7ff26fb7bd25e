"""Problem: propagate through any model without its derivatives, by a few points that carry the belief's moments.

With n states and lambda = alpha^2 (n + kappa) - n, the points are mu and mu +- sqrt(n + lambda) times the columns of
the symmetric root of Sigma; the next state's covariance is theirs plus the mean of the model's own (Julier and Uhlmann,
2004; van der Merwe, 2004). The default parameters give the spherical cubature rule (Arasaratnam and Haykin, 2009),
whose weights are positive, so that no covariance can come out indefinite.
"""

import math

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite, square_root
from gpmpc.gp.dynamics import DynamicsModel
from gpmpc.propagation.propagator import Propagation, checked_input


class Unscented:
    """The unscented transform.

    Args:
        alpha: Spread of the points.
        beta: Weight of the centre in the covariance; 2 is best for Gaussians of small alpha.
        kappa: Secondary spread.
        observation_noise: Adds the model's noise covariance.

    Raises:
        SettingError: alpha is not positive, or (at the first step) n + kappa is not.
    """

    def __init__(self, alpha: float = 1.0, beta: float = 0.0, kappa: float = 0.0, observation_noise: bool = False):
        check_number("alpha", alpha, above=0)
        check_number("beta", beta)
        check_number("kappa", kappa)
        self.alpha, self.beta, self.kappa, self.observation_noise = alpha, beta, kappa, observation_noise

    def __call__(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Gaussian:
        """The next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief

    def propagate(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``."""
        input, n = checked_input(model, belief, input), belief.dim
        if n + self.kappa <= 0:
            raise SettingError("kappa", f"n + kappa must be positive; got {n} states and {self.kappa}")
        spread = self.alpha**2 * (n + self.kappa)  # n + lambda
        weights = torch.full((2 * n + 1,), 1 / (2 * spread), dtype=belief.mean.dtype, device=belief.mean.device)
        centre = torch.arange(2 * n + 1, device=belief.mean.device) == 0
        of_mean = torch.where(centre, 1 - n / spread, weights)
        of_covariance = torch.where(centre, 2 - n / spread - self.alpha**2 + self.beta, weights)

        columns = math.sqrt(spread) * square_root(belief.covariance)  # symmetric: rows are columns
        steps = torch.cat([torch.zeros_like(columns[..., :1, :]), columns, -columns], dim=-2)
        points = belief.mean[..., None, :] + steps  # (*batch, 2 n + 1, n)
        moved = model.predict(points, input[..., None, :].expand(*points.shape[:-1], input.shape[-1]))
        mean = of_mean @ moved.mean
        centred = moved.mean - mean[..., None, :]
        covariance = centred.mT @ (of_covariance[:, None] * centred)
        covariance = covariance + (of_mean[:, None, None] * moved.covariance).sum(-3)
        if self.observation_noise:
            covariance = covariance + model.noise_covariance
        covariance, deficit = nearest_positive_semidefinite(covariance)
        return Propagation(Gaussian(mean, covariance), steps.mT @ (weights[:, None] * centred), deficit)
