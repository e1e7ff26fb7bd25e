"""Problem: predict the next state from a trained exact GP, fast and safely under torch's function transforms.

GPyTorch trains; what it found is frozen here to plain tensors: data, Cholesky factor, weights and hyperparameters, one
GP per output with the squared exponential kernel with automatic relevance determination (SE-ARD),

    k_a(x~, x~') = sf2_a exp(-1/2 sum_d (x~_d - x~'_d)^2 / l_ad^2),   x~ = (x, u)

Rasmussen and Williams (2006), eqs. (2.25)-(2.26), Algorithm 2.1; the GP model of Cao, Lai and Alam (2017).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian

Predicts = Literal["next_state", "difference"]


@dataclass(frozen=True)
class GPPosterior:
    """Exact GPs, one per output, over the same N points; build it with ``from_hyperparameters``.

    Attributes:
        features: x~ = (x, u) of the training points (N, n + m).
        targets: What the GPs learned (N, n): next states, or differences x[k+1] - x[k].
        lengthscales: l (n, n + m), one row an output.
        signal_variance: sf2 (n,).
        noise_variance: sn2 (n,).
        cholesky: Lower factor L of K + sn2 I (n, N, N).
        weights: beta = (K + sn2 I)^-1 y (n, N).
        predicts: What the targets mean.
    """

    features: Tensor
    targets: Tensor
    lengthscales: Tensor
    signal_variance: Tensor
    noise_variance: Tensor
    cholesky: Tensor
    weights: Tensor
    predicts: Predicts

    @classmethod
    def from_hyperparameters(
        cls,
        inputs: Tensor,
        targets: Tensor,
        lengthscales: Tensor,
        signal_variance: Tensor,
        noise_variance: Tensor,
        input_dim: int,
        predicts: Predicts = "next_state",
    ) -> "GPPosterior":
        """Factorises K + sn2 I and solves for the weights.

        Args:
            inputs: The GPs' inputs x~ = (x, u) (N, d), d = n + m.
            targets: (N, n).
            lengthscales: (n, d).
            signal_variance: (n,).
            noise_variance: (n,).
            input_dim: m, how many of the last columns of ``inputs`` are controls.
            predicts: ``"next_state"``, or ``"difference"`` for targets x[k+1] - x[k].

        Raises:
            ShapeError: The shapes do not belong together.
            SettingError: A hyperparameter is not positive, or the kernel matrix is not positive definite.
        """
        n, d = targets.shape[-1], inputs.shape[-1]
        expected = {
            "targets": (targets, (len(inputs), n)),
            "lengthscales": (lengthscales, (n, d)),
            "signal_variance": (signal_variance, (n,)),
            "noise_variance": (noise_variance, (n,)),
        }
        for name, (value, shape) in expected.items():
            if tuple(value.shape) != shape:
                raise ShapeError(f"{name} must have shape {shape}; got {tuple(value.shape)}")
        if d != n + input_dim:
            raise ShapeError(
                f"inputs must have n + m columns, one state an output and {input_dim} controls; "
                f"got {d} columns and {n} outputs"
            )
        if predicts not in ("next_state", "difference"):
            raise SettingError("predicts", f"must be 'next_state' or 'difference'; got {predicts!r}")
        for name in ("lengthscales", "signal_variance", "noise_variance"):
            if not bool((expected[name][0] > 0).all()):
                raise SettingError(name, f"must be positive; got {expected[name][0].tolist()}")
        kernel = signal_variance[:, None, None] * torch.exp(-scaled_square_distances(inputs, lengthscales) / 2)
        kernel.diagonal(dim1=-2, dim2=-1).add_(noise_variance[:, None])
        cholesky, info = torch.linalg.cholesky_ex(kernel)
        if bool(info.any()):
            output = int(torch.nonzero(info)[0])
            raise SettingError(
                "noise_variance",
                f"the kernel matrix of output {output} is not positive definite in float64; "
                f"signal-to-noise ratio {float((signal_variance / noise_variance)[output]):.1e}: raise the noise",
            )
        weights = torch.cholesky_solve(targets.mT[..., None], cholesky)[..., 0]
        return cls(inputs, targets, lengthscales, signal_variance, noise_variance, cholesky, weights, predicts)

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return self.targets.shape[1]

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.features.shape[1] - self.state_dim

    def __len__(self) -> int:
        return len(self.features)

    @cached_property
    def precision(self) -> Tensor:
        """(K + sn2 I)^-1 (n, N, N)."""
        return torch.cholesky_inverse(self.cholesky)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at a certain state and input (Rasmussen and Williams, 2006, eq. (2.25)).

        Args:
            state: x (*batch, n).
            input: u (*batch, m).

        Returns:
            Mean (*batch, n) and diagonal covariance (*batch, n, n) of the latent function: observation noise is not
            added.
        """
        query = torch.cat([state, input], dim=-1)
        difference = (self.features - query[..., None, :])[..., None, :, :] / self.lengthscales[:, None, :]
        k = self.signal_variance[:, None] * torch.exp(-difference.square().sum(-1) / 2)  # (*batch, n, N)
        mean = (k * self.weights).sum(-1)
        explained = torch.linalg.solve_triangular(self.cholesky, k[..., None], upper=False)[..., 0].square().sum(-1)
        if self.predicts == "difference":
            mean = mean + state
        return Gaussian(mean, torch.diag_embed((self.signal_variance - explained).clamp_min(0)))


def scaled_square_distances(points: Tensor, lengthscales: Tensor) -> Tensor:
    """sum_d (x_id - x_jd)^2 / l_ad^2, (n, N, N), from points (N, d) and length-scales (n, d).

    Summed over differences a column at a time: exact for near points, where |x|^2 + |x'|^2 - 2 x'x cancels.
    """
    total = torch.zeros(len(lengthscales), len(points), len(points), dtype=points.dtype, device=points.device)
    for column, scale in zip(points.T, lengthscales.T, strict=True):
        total += ((column[:, None] - column) / scale[:, None, None]).square()
    return total
