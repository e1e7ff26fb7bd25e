"""Propagation through any model without its derivatives, by points that carry the belief's moments.

The next state's covariance is theirs plus the mean of the model's own (law of total covariance).

Unscented: with n states and lambda = alpha^2 (n + kappa) - n, the points are mu and mu +- sqrt(n + lambda) times the
columns of the symmetric root of Sigma (Julier and Uhlmann, 2004; van der Merwe, 2004). The default parameters give the
spherical cubature rule (Arasaratnam and Haykin, 2009), whose weights are positive, so that no covariance can come out
indefinite.

Where outputs are angles, the values of all points are moved by whole turns towards that of the first before they are
averaged: the mean of 3.1 and -3.1 rad is pi, and not 0.

Monte Carlo: the reference for every other. Its standard error falls as one over the root of the number of samples.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import angles_of, whole_turns
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian, square_root, square_root_differential
from gpmpc.propagation._linearization import expand
from gpmpc.propagation._propagator import (
    NoisyPropagator,
    Propagation,
    Sensitivity,
    checked_input,
)

_CHUNK = 1000  # samples predicted at once: bounds the memory at about chunk * N * outputs numbers


class Unscented(NoisyPropagator):
    """The unscented transform.

    Args:
        alpha: Spread of the points.
        beta: Weight of the centre in the covariance; 2 is best for Gaussians of small alpha.
        kappa: Secondary spread.
        process_noise: Whether the model's noise covariance is added.

    Raises:
        SettingError: alpha is not positive, or (at the first step) n + kappa is not.
    """

    def __init__(
        self,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.0,
        process_noise: bool = True,
    ):
        check_number("alpha", alpha, above=0)
        check_number("beta", beta)
        check_number("kappa", kappa)
        super().__init__(process_noise)
        self.alpha = alpha
        self.beta = beta
        self.kappa = kappa

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives, by those of the model at every point; None where it has no closed ones.

        Where Sigma is singular its root has no derivative in the null space; zero is taken there.
        """
        input = checked_input(model, belief, input)
        n = belief.dim
        r, U = torch.linalg.eigh(belief.covariance)
        r = r.clamp_min(0).sqrt()
        steps, points, controls = self._points(
            belief, U @ (r[..., :, None] * U.mT), input
        )
        if (expansion := expand(model, points, controls)) is None:
            return None
        of_mean, of_covariance = self._weights(belief)

        # Of every point by [mu, vec(root), u] (*batch, 2n + 1, k, p): point 1 + j moves with column j of the root.
        one = math.sqrt(self._spread(n)) * torch.eye(
            n, dtype=steps.dtype, device=steps.device
        )
        ways = torch.cat([torch.zeros_like(one[:1]), one, -one])[:, None, None, :]

        def by_parameters(by_state: Tensor, by_input: Tensor) -> Tensor:
            by_root = by_state[..., :, None] * ways
            return torch.cat([by_state, by_root.flatten(-2), by_input], dim=-1)

        moves = by_parameters(expansion.A, expansion.B)
        mean_by = torch.einsum("i,...iap->...ap", of_mean, moves)
        mean = torch.einsum("i,...ia->...a", of_mean, expansion.belief.mean)
        centred = expansion.belief.mean - mean[..., None, :]
        half = torch.einsum(
            "i,...iap,...ib->...abp",
            of_covariance,
            moves - mean_by[..., None, :, :],
            centred,
        )
        spread_by = by_parameters(
            expansion.variance_by_state, expansion.variance_by_input
        )
        own = torch.diag_embed(
            torch.einsum("i,...iap->...pa", of_mean, spread_by)
        ).movedim(-3, -1)
        covariance_by = half + half.transpose(-3, -2) + own

        def parts(by: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            by_root = by[..., n : n + n * n].unflatten(-1, (n, n))
            count = (
                by_root.dim() - belief.mean.dim() - 1
            )  # dimensions of what is differentiated
            columns = (
                ((by_root + by_root.mT) / 2).flatten(-2 - count, -3).movedim(-3, -1)
            )
            # dR = L(dSigma) is linear, and L its own adjoint.
            by_covariance = square_root_differential(r, U, columns).movedim(-1, -3)
            return (
                by[..., :n],
                by_covariance.reshape(by_root.shape),
                by[..., n + n * n :],
            )

        of_means = parts(mean_by)
        of_covariances = parts(covariance_by)
        moments = self._moments(model, belief, steps, expansion.belief)
        moved = self._projected(model, *moments)
        return moved, Sensitivity(*of_means, *of_covariances)

    def _spread(self, n: int) -> float:
        """The square of the distance of the points in units of the root: n + lambda."""
        if n + self.kappa <= 0:
            raise SettingError(
                "kappa", f"n + kappa must be positive; got {n} states and {self.kappa}"
            )
        return self.alpha**2 * (n + self.kappa)

    def _weights(self, belief: Gaussian) -> tuple[Tensor, Tensor]:
        """Of the points in the mean and in the covariance (2n + 1,)."""
        n = belief.dim
        spread = self._spread(belief.dim)
        of_mean = belief.mean.new_full((2 * n + 1,), 1 / (2 * spread))
        of_covariance = of_mean.clone()
        of_mean[0] = 1 - n / spread
        of_covariance[0] = 2 - n / spread - self.alpha**2 + self.beta
        return of_mean, of_covariance

    def _points(
        self, belief: Gaussian, root: Tensor, input: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Steps from the mean, points (*batch, 2n + 1, n), and the input at each."""
        columns = (
            math.sqrt(self._spread(belief.dim)) * root
        )  # symmetric: rows are columns
        steps = torch.cat(
            [torch.zeros_like(columns[..., :1, :]), columns, -columns], dim=-2
        )
        points = belief.mean[..., None, :] + steps
        return (
            steps,
            points,
            input[..., None, :].expand(*points.shape[:-1], input.shape[-1]),
        )

    def _moved(
        self, model: Any, belief: Gaussian, input: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        steps, points, controls = self._points(
            belief, square_root(belief.covariance), input
        )
        return self._moments(model, belief, steps, model.predict(points, controls))

    def _moments(
        self, model: Any, belief: Gaussian, steps: Tensor, moved: Gaussian
    ) -> tuple[Tensor, Tensor, Tensor]:
        of_mean, of_covariance = self._weights(belief)
        values = _near_the_first(moved.mean, model)
        mean = of_mean @ values
        centred = values - mean[..., None, :]
        covariance = centred.mT @ (of_covariance[:, None] * centred)
        covariance = covariance + (of_mean[:, None, None] * moved.covariance).sum(-3)
        return mean, covariance, steps.mT @ (of_mean[1] * centred)


class MonteCarlo(NoisyPropagator):
    """Sampling; the same seed gives the same samples at every call.

    Args:
        samples: How many states are drawn.
        seed: Of the draws.
        process_noise: Whether the model's noise covariance is added.

    Raises:
        SettingError: Fewer than two samples, or a seed that is no whole number.
    """

    def __init__(
        self, samples: int = 10_000, seed: int = 0, process_noise: bool = True
    ):
        check_number("samples", samples, least=2, whole=True)
        check_number("seed", seed, least=0, whole=True)
        super().__init__(process_noise)
        self.samples = samples
        self.seed = seed

    def _moved(
        self, model: Any, belief: Gaussian, input: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        # NumPy's generator: torch's would stop a vmap around this call.
        normal = np.random.default_rng(self.seed).standard_normal(
            (self.samples, belief.dim)
        )
        steps = torch.from_numpy(normal).to(belief.mean) @ square_root(
            belief.covariance
        )  # (*batch, samples, n)
        means = []
        spread = 0.0
        for chunk in steps.split(_CHUNK, dim=-2):
            points = belief.mean[..., None, :] + chunk
            moved = model.predict(
                points, input[..., None, :].expand(*points.shape[:-1], input.shape[-1])
            )
            means.append(moved.mean)
            spread = spread + moved.covariance.sum(-3)
        states = _near_the_first(torch.cat(means, dim=-2), model)
        mean = states.mean(-2)
        centred = states - mean[..., None, :]
        covariance = centred.mT @ centred / (self.samples - 1) + spread / self.samples
        cross = (steps - steps.mean(-2, keepdim=True)).mT @ centred / (self.samples - 1)
        return mean, covariance, cross


def _near_the_first(values: Tensor, model: Any) -> Tensor:
    """A model's outputs at points (*batch, points, k), moved by whole turns.

    Those of angles come within half a turn of the first point's; all others stay.
    """
    angles = angles_of(model)
    if not angles:
        return values
    own = values[..., angles]
    moved = values.clone()
    moved[..., angles] = own - whole_turns(own - own[..., :1, :])
    return moved
