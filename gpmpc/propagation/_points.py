"""Propagation through any model without its derivatives, by points that carry the belief's moments.

The next state's covariance is theirs plus the mean of the model's own (law of total covariance).

Unscented: with n states and lambda = alpha^2 (n + kappa) - n, the points are mu and mu +- sqrt(n + lambda) times the
columns of the symmetric root of Sigma (Julier and Uhlmann, 2004; van der Merwe, 2004). The default parameters give the
spherical cubature rule (Arasaratnam and Haykin, 2009), whose weights are positive, so that no covariance can come out
indefinite.

Monte Carlo: the reference for every other. Its standard error falls as one over the root of the number of samples.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian, square_root
from gpmpc.propagation._linearization import Expansion, expand
from gpmpc.propagation._propagator import NoisyPropagator, Propagation, Sensitivity, by_autograd, checked_input

_CHUNK = 1000  # samples predicted at once: bounds the memory at about chunk * N * outputs numbers


class Unscented(NoisyPropagator):
    """The unscented transform.

    Args:
        alpha: Spread of the points.
        beta: Weight of the centre in the covariance; 2 is best for Gaussians of small alpha.
        kappa: Secondary spread.
        process_noise: Adds the model's noise covariance.

    Raises:
        SettingError: alpha is not positive, or (at the first step) n + kappa is not.
    """

    def __init__(self, alpha: float = 1.0, beta: float = 0.0, kappa: float = 0.0, process_noise: bool = False):
        check_number("alpha", alpha, above=0)
        check_number("beta", beta)
        check_number("kappa", kappa)
        super().__init__(process_noise)
        self.alpha, self.beta, self.kappa = alpha, beta, kappa

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives, by those of the model at every point; None where it has no closed ones.

        Where Sigma is singular its root has no derivative in the null space; zero is taken there.
        """
        input = checked_input(model, belief, input)
        _, points, controls = self._points(belief, input)
        with torch.inference_mode(False):  # of inference tensors nothing could be saved for backward
            expansion = expand(model, points, controls)
        if expansion is None:
            return None
        return by_autograd(self, _FirstOrder(model, points, controls, expansion), belief, input)

    def _moved(self, model: Any, belief: Gaussian, input: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        n, (steps, points, controls) = belief.dim, self._points(belief, input)
        spread = self._spread(n)
        of_mean = belief.mean.new_full((2 * n + 1,), 1 / (2 * spread))
        of_covariance = of_mean.clone()
        of_mean[0], of_covariance[0] = 1 - n / spread, 2 - n / spread - self.alpha**2 + self.beta
        moved = model.predict(points, controls)
        mean = of_mean @ moved.mean
        centred = moved.mean - mean[..., None, :]
        covariance = centred.mT @ (of_covariance[:, None] * centred)
        covariance = covariance + (of_mean[:, None, None] * moved.covariance).sum(-3)
        return mean, covariance, steps.mT @ (of_mean[1] * centred)

    def _spread(self, n: int) -> float:
        """The square of the distance of the points in units of the root: n + lambda."""
        if n + self.kappa <= 0:
            raise SettingError("kappa", f"n + kappa must be positive; got {n} states and {self.kappa}")
        return self.alpha**2 * (n + self.kappa)

    def _points(self, belief: Gaussian, input: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Steps from the mean, points (*batch, 2n + 1, n), and the input at each."""
        columns = math.sqrt(self._spread(belief.dim)) * square_root(belief.covariance)  # symmetric: rows are columns
        steps = torch.cat([torch.zeros_like(columns[..., :1, :]), columns, -columns], dim=-2)
        points = belief.mean[..., None, :] + steps
        return steps, points, input[..., None, :].expand(*points.shape[:-1], input.shape[-1])


class _FirstOrder:
    """A model's expansion at points, as a model that torch can differentiate once at these points."""

    def __init__(self, model: Any, points: Tensor, inputs: Tensor, expansion: Expansion):
        self._model, self._points, self._inputs, self._at = model, points, inputs, expansion

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        at, x, u = self._at, (state - self._points)[..., None], (input - self._inputs)[..., None]
        mean = at.belief.mean + (at.A @ x + at.B @ u)[..., 0]
        change = (at.variance_by_state @ x + at.variance_by_input @ u)[..., 0]
        return Gaussian(mean, at.belief.covariance + torch.diag_embed(change))


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

    def _moved(self, model: Any, belief: Gaussian, input: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # NumPy's generator: torch's would stop a vmap around this call.
        normal = np.random.default_rng(self.seed).standard_normal((self.samples, belief.dim))
        steps = torch.from_numpy(normal).to(belief.mean) @ square_root(belief.covariance)  # (*batch, samples, n)
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
        return mean, covariance, cross
