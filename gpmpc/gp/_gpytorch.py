"""Exact GPs in GPyTorch: one per output as one batch, and what is taken of those that others trained.

Everything is float64, and the Cholesky factorisation is exact at every size: left alone, GPyTorch turns to an iterative
solver above 800 points, adds jitter without a word, and keeps the noise above 1e-4.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import gpytorch
import torch
from gpytorch.constraints import Positive
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gp._posterior import GPPosterior


@contextmanager
def exact_inference() -> Iterator[None]:
    """GPyTorch settings under which fitting and predicting stay on the exact Cholesky factorisation."""
    with ExitStack() as settings:
        settings.enter_context(gpytorch.settings.fast_computations(False, False, False))
        settings.enter_context(gpytorch.settings.max_cholesky_size(10**9))
        settings.enter_context(gpytorch.settings.cholesky_max_tries(1))  # no silent jitter on the diagonal
        yield


class BatchExactGP(gpytorch.models.ExactGP):
    """Independent zero-mean SE-ARD GPs over the same inputs (N, d), one for each column of the targets (N, n)."""

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

    def set_hyperparameters(self, theta: Tensor) -> None:
        """Takes rows (log l (d), log sf, log(sf / sn)), one an output: (n, d + 2)."""
        with torch.no_grad():
            self.covar_module.base_kernel.raw_lengthscale.copy_(theta[:, None, :-2])
            self.covar_module.raw_outputscale.copy_(2 * theta[:, -2])
            self.likelihood.noise_covar.raw_noise.copy_(2 * (theta[:, -2:-1] - theta[:, -1:]))


def to_gpytorch(posterior: GPPosterior) -> BatchExactGP:
    """Builds the GPyTorch model of a posterior; its prior mean is a constant that training leaves alone."""
    model = BatchExactGP(posterior.features, posterior.targets)
    mean = gpytorch.means.ConstantMean(batch_shape=posterior.offset.shape)
    model.mean_module = mean.requires_grad_(False).double()
    model.mean_module.constant.copy_(posterior.offset)
    deviation, noise = posterior.signal_variance.log() / 2, posterior.noise_variance.log() / 2
    theta = torch.cat([posterior.lengthscales.log(), torch.stack([deviation, deviation - noise], 1)], 1)
    model.set_hyperparameters(theta)
    return model.eval()


def _log_parameter() -> Positive:
    """A positive parameter whose raw value is its logarithm."""
    return Positive(transform=torch.exp, inv_transform=torch.log)


def members(model: Any, likelihood: Any = None) -> list[tuple[Any, Any]]:
    """Trained exact GPs with their likelihoods, from one model, an ``IndependentModelList`` or a sequence; checked."""
    given: list[Any] = [getattr(model, "models", model), getattr(likelihood, "likelihoods", likelihood)]
    models, likelihoods = (list(x) if isinstance(x, Sequence | torch.nn.ModuleList) else [x] for x in given)
    if len(likelihoods) == 1:
        likelihoods *= len(models)
    if len(likelihoods) != len(models):
        raise ShapeError(f"each model needs one likelihood; got {len(models)} models and {len(likelihoods)}")
    owners = zip(models, likelihoods, strict=True)
    pairs: list[Any] = [(one, getattr(one, "likelihood", None) if own is None else own) for one, own in owners]
    for one, own in pairs:
        if not isinstance(one, gpytorch.models.ExactGP) or one.train_inputs is None:
            raise UnsupportedModel(f"only ExactGP models with training data can be frozen; got {type(one).__name__}")
        if type(own) is not gpytorch.likelihoods.GaussianLikelihood:
            raise UnsupportedModel(f"the likelihood must be a GaussianLikelihood; got {type(own).__name__}")
        if one.train_targets.dim() > 2:
            shape = tuple(one.train_targets.shape)
            raise ShapeError(f"a batch of models has one batch dimension; got targets {shape}")
        for transform in ("input_transform", "outcome_transform"):
            if getattr(one, transform, None) is not None:
                raise UnsupportedModel(
                    f"the model carries an {transform}, which its hyperparameters do not contain: "
                    "train without it, and give the units back by GPPosterior.unscaled"
                )
        if one.train_targets.dtype != torch.float64 or one.train_inputs[0].dtype != torch.float64:
            raise SettingError("model", "must be in float64 (model.double(), data too); got float32")
    return pairs
