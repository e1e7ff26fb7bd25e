"""Problem: the exact GPs in GPyTorch, one per output, as one batch; and what a trained model of others says.

GPyTorch holds the hyperparameters and evaluates the marginal likelihood of the whole batch by automatic differentiation
(``GPyTorchEvidence``); ``posterior`` freezes what training found. Parameters are kept as logarithms, everything is
float64, and the Cholesky factorisation is exact at every size: left alone, GPyTorch turns to an iterative
solver above 800 points, and keeps the noise above 1e-4.
"""

from collections.abc import Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import gpytorch
import numpy as np
import torch
from gpytorch.constraints import Positive
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel

if TYPE_CHECKING:
    from gpmpc.gp.posterior import GPPosterior


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


def gpytorch_model(posterior: "GPPosterior") -> BatchExactGP:
    """The GPyTorch model that a posterior could have come from; its prior mean is no parameter of a training."""
    model = BatchExactGP(posterior.features, posterior.targets)
    model.mean_module = gpytorch.means.ConstantMean(batch_shape=posterior.offset.shape).requires_grad_(False)
    model.mean_module.constant.copy_(posterior.offset)
    deviation, noise = posterior.signal_variance.log() / 2, posterior.noise_variance.log() / 2
    theta = torch.cat([posterior.lengthscales.log(), torch.stack([deviation, deviation - noise], 1)], 1)
    model.set_hyperparameters(theta)
    return model.eval()


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


def members(model: Any, likelihood: Any = None) -> list[tuple[Any, Any]]:
    """Trained exact GPs with their likelihoods, from one model, an ``IndependentModelList`` or a sequence.

    Raises:
        UnsupportedModel: One is no single-task ``ExactGP`` with a ``GaussianLikelihood``, or carries transforms.
        SettingError: One is not in float64.
    """
    models = list(model.models) if hasattr(model, "models") else list(model) if isinstance(model, Sequence) else [model]
    likelihoods = getattr(likelihood, "likelihoods", likelihood)
    likelihoods = list(likelihoods) if isinstance(likelihoods, Sequence | torch.nn.ModuleList) else [likelihoods]
    if len(likelihoods) == 1:
        likelihoods *= len(models)
    if len(likelihoods) != len(models):
        raise ShapeError(f"each model needs one likelihood; got {len(models)} models and {len(likelihoods)}")
    pairs = [
        (m, getattr(m, "likelihood", None) if own is None else own) for m, own in zip(models, likelihoods, strict=True)
    ]
    for one, own in pairs:
        if not isinstance(one, gpytorch.models.ExactGP) or one.train_inputs is None:
            raise UnsupportedModel(f"only ExactGP models with training data can be frozen; got {type(one).__name__}")
        if type(own) is not gpytorch.likelihoods.GaussianLikelihood:
            raise UnsupportedModel(f"the likelihood must be a GaussianLikelihood; got {type(own).__name__}")
        for transform in ("input_transform", "outcome_transform"):
            if getattr(one, transform, None) is not None:
                raise UnsupportedModel(
                    f"the model carries an {transform}, which its hyperparameters know nothing of: "
                    "train without it, and give the units back by GPPosterior.unscaled"
                )
        if one.train_targets.dtype != torch.float64 or one.train_inputs[0].dtype != torch.float64:
            raise SettingError("model", "must be in float64 (model.double(), data too); got float32")
    return pairs


def hyperparameters(model: Any, likelihood: Any = None) -> dict[str, Any]:
    """The arguments of ``GPPosterior.from_hyperparameters`` in trained SE-ARD models: single, batch or a list.

    Of sparse models (an ``InducingPointKernel`` around the kernel) those of ``sparse_posterior``: also ``inducing``,
    and the ``method`` by which GPyTorch would predict: FITC, unless its setting ``sgpr_diagonal_correction`` is off.
    (Then its means are those of SGPR; its variances lack kxx - qxx and vanish far from Z, ours do not.)

    Raises:
        UnsupportedModel: The kernel is no (scaled) ``RBFKernel``, the mean neither zero nor constant.
        ShapeError: The models of a list have other training inputs or inducing points, or there is more than one batch
            dimension.
    """
    rows: dict[str, list[Tensor]] = {}
    first, inducing = None, []
    for one, own in members(model, likelihood):
        inputs, targets = one.train_inputs[0], one.train_targets
        inputs = inputs[:, None] if inputs.dim() == 1 else inputs
        if targets.dim() > 2:
            raise ShapeError(f"a batch of models has one batch dimension; got targets {tuple(targets.shape)}")
        outputs, shared = targets[None] if targets.dim() == 1 else targets, inputs.reshape(-1, *inputs.shape[-2:])
        first = shared[0] if first is None else first
        if any(each.shape != first.shape or not torch.equal(each, first) for each in shared):
            raise ShapeError("all outputs must have the same training inputs (N, d); got different ones")
        scale, kernel = 1.0, one.covar_module
        if isinstance(kernel, gpytorch.kernels.InducingPointKernel) and kernel.active_dims is None:
            inducing += kernel.inducing_points.detach().reshape(-1, *kernel.inducing_points.shape[-2:])
            kernel = kernel.base_kernel
        if isinstance(kernel, gpytorch.kernels.ScaleKernel):
            scale, kernel = kernel.outputscale, kernel.base_kernel
        if type(kernel) is not gpytorch.kernels.RBFKernel or kernel.active_dims is not None:
            name = type(kernel).__name__ + (" on some dimensions" if kernel.active_dims is not None else "")
            raise UnsupportedModel(
                f"GPPosterior has the SE-ARD kernel: RBFKernel, in a ScaleKernel or not; got {name}. "
                "KernelPosterior.from_gpytorch takes any kernel"
            )
        if isinstance(one.mean_module, gpytorch.means.ConstantMean):
            constant = one.mean_module.constant
        elif isinstance(one.mean_module, gpytorch.means.ZeroMean):
            constant = torch.zeros((), dtype=torch.float64)
        else:
            raise UnsupportedModel(f"the mean must be zero or constant; got {type(one.mean_module).__name__}")
        k, d = len(outputs), first.shape[1]
        found = {
            "targets": outputs,
            "lengthscales": kernel.lengthscale.reshape(-1, kernel.lengthscale.shape[-1]).expand(k, d),
            "signal_variance": torch.as_tensor(scale, dtype=torch.float64).reshape(-1).expand(k),
            "noise_variance": own.noise.reshape(-1).expand(k),
            "offset": constant.reshape(-1).expand(k),
        }
        for name, value in found.items():
            rows.setdefault(name, []).append(value.detach().to(first.device))
    joined = {name: torch.cat(values).clone() for name, values in rows.items()}
    joined = {"inputs": first.detach().clone(), **joined, "targets": joined["targets"].T.contiguous()}
    if not inducing:
        return joined
    if len(inducing) not in (1, joined["targets"].shape[1]) or any(not torch.equal(Z, inducing[0]) for Z in inducing):
        raise ShapeError("all outputs must be sparse, with the same inducing points (M, d); got different ones")
    method = "fitc" if gpytorch.settings.sgpr_diagonal_correction.on() else "sgpr"
    return {**joined, "inducing": inducing[0].clone(), "method": method}
