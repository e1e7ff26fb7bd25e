"""Problem: an oracle for every other propagation: draw states, predict each, and take the moments of what comes out.

The model's own covariance enters as its mean over the draws (law of total covariance), which is less noisy than drawing
the function values too. The standard error falls as one over the root of the number of samples.
"""

import numpy as np
import torch
from torch import Tensor

from gpmpc.dynamics import DynamicsModel
from gpmpc.exceptions import check_number
from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite, square_root
from gpmpc.propagation.propagator import Propagation, checked_input

CHUNK = 1000  # samples predicted at once: bounds the memory at about chunk * N * outputs numbers


class MonteCarlo:
    """Sampling; the same seed gives the same samples at every call.

    Args:
        samples: How many states are drawn.
        seed: Of the draws.
        observation_noise: Adds the model's noise covariance.

    Raises:
        SettingError: Fewer than two samples, or a seed that is no whole number.
    """

    def __init__(self, samples: int = 10_000, seed: int = 0, observation_noise: bool = False):
        check_number("samples", samples, least=2, whole=True)
        check_number("seed", seed, least=0, whole=True)
        self.samples, self.seed, self.observation_noise = samples, seed, observation_noise

    def __call__(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Gaussian:
        """The next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief

    def propagate(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``."""
        input, n = checked_input(model, belief, input), belief.dim
        # NumPy's generator: torch's would stop a vmap around this call.
        normal = torch.from_numpy(np.random.default_rng(self.seed).standard_normal((self.samples, n))).to(belief.mean)
        steps = normal @ square_root(belief.covariance)  # (*batch, samples, n)
        means, spread = [], 0.0
        for chunk in steps.split(CHUNK, dim=-2):
            points = belief.mean[..., None, :] + chunk
            moved = model.predict(points, input[..., None, :].expand(*points.shape[:-1], input.shape[-1]))
            means.append(moved.mean)
            spread = spread + moved.covariance.sum(-3)
        states = torch.cat(means, dim=-2)
        mean = states.mean(-2)
        centred = states - mean[..., None, :]
        covariance = centred.mT @ centred / (self.samples - 1) + spread / self.samples
        if self.observation_noise:
            covariance = covariance + model.noise_covariance
        covariance, deficit = nearest_positive_semidefinite(covariance)
        cross = (steps - steps.mean(-2, keepdim=True)).mT @ centred / (self.samples - 1)
        return Propagation(Gaussian(mean, covariance), cross, deficit)
