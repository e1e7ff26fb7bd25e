"""Propagation by sampling, the reference for every other: draw states, predict each, and take the moments.

The model's own covariance enters as its mean over the draws (law of total covariance), which is less noisy than drawing
the function values too. The standard error falls as one over the root of the number of samples.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.exceptions import check_number
from gpmpc.gaussian import Gaussian, square_root
from gpmpc.propagation._propagator import NoisyPropagator, Propagation, checked_input

_CHUNK = 1000  # samples predicted at once: bounds the memory at about chunk * N * outputs numbers


class MonteCarlo(NoisyPropagator):
    """Sampling; the same seed gives the same samples at every call.

    Args:
        samples: How many states are drawn.
        seed: Of the draws.
        process_noise: Adds the model's noise covariance.

    Raises:
        SettingError: Fewer than two samples, or a seed that is no whole number.
    """

    def __init__(self, samples: int = 10_000, seed: int = 0, process_noise: bool = False):
        check_number("samples", samples, least=2, whole=True)
        check_number("seed", seed, least=0, whole=True)
        super().__init__(process_noise)
        self.samples, self.seed = samples, seed

    def propagate(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``."""
        input, n = checked_input(model, belief, input), belief.dim
        # NumPy's generator: torch's would stop a vmap around this call.
        normal = torch.from_numpy(np.random.default_rng(self.seed).standard_normal((self.samples, n))).to(belief.mean)
        steps = normal @ square_root(belief.covariance)  # (*batch, samples, n)
        means, spread = [], 0.0
        for chunk in steps.split(_CHUNK, dim=-2):
            points = belief.mean[..., None, :] + chunk
            moved = model.predict(points, input[..., None, :].expand(*points.shape[:-1], input.shape[-1]))
            means.append(moved.mean)
            spread = spread + moved.covariance.sum(-3)
        states = torch.cat(means, dim=-2)
        mean = states.mean(-2)
        centred = states - mean[..., None, :]
        covariance = centred.mT @ centred / (self.samples - 1) + spread / self.samples
        cross = (steps - steps.mean(-2, keepdim=True)).mT @ centred / (self.samples - 1)
        return self._projected(model, mean, covariance, cross)
