"""Evaluates the marginal likelihood of one SE-ARD GP by GPyTorch.

The closed form is compared with it.
"""

import gpytorch
import numpy as np
import torch

from gpmpc.gp import exact_inference
from gpmpc.gp._gpytorch import BatchExactGP
from gpmpc.gp._kernel import centred


class GPyTorchLikelihood:
    """Evaluates as ``NegativeLogMarginalLikelihood`` does, by GPyTorch.

    Args:
        features: x~ (N, d).
        targets: y (N,).
    """

    def __init__(self, features: np.ndarray, targets: np.ndarray):
        self._model = BatchExactGP(
            torch.from_numpy(centred(features)), torch.from_numpy(targets)[:, None]
        ).train()
        self._likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(
            self._model.likelihood, self._model
        )

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and gradient (d + 2,) at theta.

        Infinite where K is not positive definite.
        """
        model = self._model
        model.set_hyperparameters(torch.from_numpy(theta)[None])
        model.zero_grad()
        try:
            with exact_inference():
                # GPyTorch divides by the number of points.
                value = -self._likelihood(
                    model(*model.train_inputs), model.train_targets
                ) * len(model.train_inputs[0])
            value.sum().backward()
        except (gpytorch.utils.errors.NotPSDError, gpytorch.utils.errors.NanError):
            return np.inf, np.zeros_like(theta)
        by_lengthscale = model.covar_module.base_kernel.raw_lengthscale.grad[
            0, 0
        ].numpy()
        by_signal = float(2 * model.covar_module.raw_outputscale.grad[0])
        by_noise = float(2 * model.likelihood.noise_covar.raw_noise.grad[0, 0])
        return float(value.detach()), np.append(
            by_lengthscale, [by_signal + by_noise, -by_noise]
        )
