"""Problem: the exact GPs in GPyTorch, one per output, as one batch; the only door to gpytorch.

GPyTorch holds the hyperparameters and evaluates the marginal likelihood of the whole batch by automatic differentiation
(``GPyTorchEvidence``); ``posterior`` freezes what training found. Parameters are kept as logarithms, everything is
float64, and the Cholesky factorisation is exact at every size: left alone, GPyTorch turns to an iterative
solver above 800 points, and keeps the noise above 1e-4.
"""

from contextlib import ExitStack, contextmanager

import gpytorch
import numpy as np
import torch
from gpytorch.constraints import Positive
from torch import Tensor


@contextmanager
def exact_inference():
    """GPyTorch settings under which fitting and predicting stay on the exact Cholesky factorisation."""
    with ExitStack() as settings:
        settings.enter_context(gpytorch.settings.fast_computations(False, False, False))
        settings.enter_context(gpytorch.settings.max_cholesky_size(10**9))
        settings.enter_context(gpytorch.settings.cholesky_max_tries(1))  # no silent jitter on the diagonal
        yield


class BatchExactGP(gpytorch.models.ExactGP):
    """Independent zero-mean SE-ARD GPs, one per output, over the same inputs.

    Args:
        features: x~ (N, d).
        targets: (N, n).
    """

    def __init__(self, features: Tensor, targets: Tensor):
        batch, d = torch.Size([targets.shape[1]]), features.shape[1]
        likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=batch, noise_constraint=_log_parameter())
        super().__init__(features, targets.T.contiguous(), likelihood)
        self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
        kernel = gpytorch.kernels.RBFKernel(ard_num_dims=d, batch_shape=batch, lengthscale_constraint=_log_parameter())
        self.covar_module = gpytorch.kernels.ScaleKernel(
            kernel, batch_shape=batch, outputscale_constraint=_log_parameter()
        )
        self.double()

    def forward(self, features: Tensor) -> gpytorch.distributions.MultivariateNormal:
        """The prior over all outputs at inputs (N, d)."""
        return gpytorch.distributions.MultivariateNormal(self.mean_module(features), self.covar_module(features))

    @property
    def lengthscales(self) -> Tensor:
        """(n, d)."""
        return self.covar_module.base_kernel.lengthscale.detach()[:, 0]

    @property
    def signal_variance(self) -> Tensor:
        """(n,)."""
        return self.covar_module.outputscale.detach()

    @property
    def noise_variance(self) -> Tensor:
        """(n,)."""
        return self.likelihood.noise.detach()[:, 0]

    def set_hyperparameters(self, theta: Tensor) -> None:
        """Takes rows (log l (d), log sf, log(sf / sn)), one an output: (n, d + 2)."""
        with torch.no_grad():
            self.covar_module.base_kernel.raw_lengthscale.copy_(theta[:, None, :-2])
            self.covar_module.raw_outputscale.copy_(2 * theta[:, -2])
            self.likelihood.noise_covar.raw_noise.copy_(2 * (theta[:, -2:-1] - theta[:, -1:]))


class GPyTorchEvidence:
    """The negative log marginal likelihoods of all outputs by GPyTorch, over theta as in ``LogEvidence``.

    Args:
        model: The batch of GPs; its hyperparameters are overwritten at every call.
    """

    def __init__(self, model: BatchExactGP):
        self.model = model.train()
        self._likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)

    def __call__(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (n,) and gradients (n, d + 2) at theta (n, d + 2); infinite where K is not positive definite."""
        model = self.model
        model.set_hyperparameters(torch.from_numpy(theta))
        model.zero_grad()
        try:
            with exact_inference():
                # GPyTorch divides by the number of points.
                values = -self._likelihood(model(*model.train_inputs), model.train_targets) * len(model.train_inputs[0])
            values.sum().backward()
        except (gpytorch.utils.errors.NotPSDError, gpytorch.utils.errors.NanError):
            return np.full(len(theta), np.inf), np.zeros_like(theta)
        noise = 2 * model.likelihood.noise_covar.raw_noise.grad[:, 0]
        gradient = torch.cat(
            [
                model.covar_module.base_kernel.raw_lengthscale.grad[:, 0],
                (2 * model.covar_module.raw_outputscale.grad + noise)[:, None],
                -noise[:, None],
            ],
            dim=1,
        )
        return values.detach().numpy(), gradient.numpy()


def _log_parameter() -> Positive:
    """A positive parameter whose raw value is its logarithm."""
    return Positive(transform=torch.exp, inv_transform=torch.log)
