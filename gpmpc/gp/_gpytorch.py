"""Conversion of SE-ARD GPs from GPyTorch, and to it.

``from_gpytorch`` freezes models that were trained with GPyTorch to a ``GPPosterior``:
exact ones with their training data, sparse ones with pseudo-observations.
``to_gpytorch`` makes a GPyTorch model of a posterior. Models with other kernels or
means become a ``KernelPosterior`` (``gpmpc.gp._gpytorch_posteriors``).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import gpytorch
import torch
from gpytorch.constraints import Positive
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import ShapeError, UnsupportedModel
from gpmpc.gp._gpytorch_checks import (
    ExactModel,
    all_equal,
    check_forward,
    exact_models,
    training_features,
)
from gpmpc.gp._kernel import Hyperparameters
from gpmpc.gp._posterior import GPPosterior, check_posterior
from gpmpc.gp._scaling import Scaling, identity
from gpmpc.gp._sparse import Method, sparse_posterior
from gpmpc.gp._tensor_checks import Predicts
from gpmpc.signals import UNKNOWN, Signals, check_signals, signals_of


class BatchExactGP(gpytorch.models.ExactGP):
    """Independent zero-mean SE-ARD GPs over the same inputs.

    Args:
        features: (N, d).
        targets: (N, n), a GP for each column.
    """

    signals: Signals = UNKNOWN  #: of the posterior that it was made of

    def __init__(self, features: Tensor, targets: Tensor):
        batch = torch.Size([targets.shape[1]])
        d = features.shape[1]
        # Raw values are logarithms.
        log = Positive(transform=torch.exp, inv_transform=torch.log)
        likelihood = gpytorch.likelihoods.GaussianLikelihood(
            batch_shape=batch, noise_constraint=log
        )
        super().__init__(features, targets.T.contiguous(), likelihood)
        self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
        kernel = gpytorch.kernels.RBFKernel(
            ard_num_dims=d, batch_shape=batch, lengthscale_constraint=log
        )
        self.covar_module = gpytorch.kernels.ScaleKernel(
            kernel, batch_shape=batch, outputscale_constraint=log
        )
        self.double()

    def forward(self, features: Tensor) -> gpytorch.distributions.MultivariateNormal:
        """Evaluates the prior over all outputs at inputs (N, d)."""
        return gpytorch.distributions.MultivariateNormal(
            self.mean_module(features), self.covar_module(features)
        )

    def set_hyperparameters(self, theta: Tensor) -> None:
        """Takes rows (log l (d), log sf, log(sf / sn)), one an output: (n, d + 2)."""
        log_noise = theta[:, -2:-1] - theta[:, -1:]
        with torch.no_grad():
            self.covar_module.base_kernel.raw_lengthscale.copy_(theta[:, None, :-2])
            self.covar_module.raw_outputscale.copy_(2 * theta[:, -2])
            self.likelihood.noise_covar.raw_noise.copy_(2 * log_noise)


@explains_arguments
def to_gpytorch(posterior: GPPosterior) -> BatchExactGP:
    """Builds the GPyTorch model of a posterior.

    It is on the posterior's device, in float64. Its prior mean is a constant that
    training leaves alone. Its noise is that of the targets,
    ``GPPosterior.observation_noise``.

    Raises:
        UnsupportedModel: The posterior holds a sparse model's pseudo-observations,
            whose noise no likelihood of GPyTorch has, or is none.

    See Also:
        ``from_gpytorch``, the way back.
    """
    check_posterior("posterior", posterior)
    noise = posterior.observation_noise
    if noise is None:
        raise UnsupportedModel(
            "the posterior holds a sparse model's pseudo-observations, no data: "
            "to_gpytorch takes posteriors of observed rows"
        )
    model = BatchExactGP(posterior.features, posterior.targets)
    model.signals = posterior.signals
    mean = gpytorch.means.ConstantMean(batch_shape=posterior.offset.shape)
    model.mean_module = mean.requires_grad_(False).double()
    model.mean_module.constant.copy_(posterior.offset)
    log_lengthscales = posterior.lengthscales.log()
    log_signal = posterior.signal_variance.log() / 2
    log_noise = noise.log() / 2
    theta = torch.column_stack([log_lengthscales, log_signal, log_signal - log_noise])
    model.set_hyperparameters(theta)
    return model.to(posterior.device).eval()


@explains_arguments
def from_gpytorch(
    model: Any,
    likelihood: Any = None,
    *,
    input_dim: int,
    predicts: Predicts = "next_state",
    signals: Signals | None = None,
) -> GPPosterior:
    """Freezes trained SE-ARD ExactGPs of GPyTorch.

    They are one model, a batch (one batch dimension, an output each), or a list. A
    sparse one (``InducingPointKernel``) becomes its pseudo-observations; see
    ``SparseTrainer``. Its method is the one by which GPyTorch would predict: FITC,
    unless its setting ``sgpr_diagonal_correction`` is off. (Then its means are those of
    SGPR; its variances lack kxx - qxx and vanish far from Z, ours do not.)

    Args:
        model: An ``ExactGP`` with a zero or constant mean and an ``RBFKernel``, scaled
            by a ``ScaleKernel`` or not; an ``IndependentModelList``; or a sequence of
            models over the same inputs.
        likelihood: Its ``GaussianLikelihood``, or a list of them; the models' own by
            default.
        input_dim: m.
        predicts: What the training targets mean.
        signals: Names of states and inputs, and time step; by default those that a
            model of ``to_gpytorch`` kept.

    Raises:
        UnsupportedModel: The kernel, mean or likelihood is another one, transforms are
            attached, or the model's ``forward`` scales, warps or adds: it is not the
            distribution of its mean and kernel modules.
        ShapeError: The models of a list have other training inputs or inducing points,
            or there is more than one batch dimension.

    See Also:
        ``to_gpytorch``, the way back; ``gpmpc.models.train``.
    """
    signals = signals_of(model) if signals is None else signals
    check_signals(signals)
    members = [_read_se_ard(exact) for exact in exact_models(model, likelihood)]
    inputs = [points for member in members for points in member.inputs]
    if not all_equal(inputs):
        raise ShapeError(
            "all outputs must have the same training inputs (N, d); got different ones"
        )
    features = inputs[0].clone()
    targets = _joined([member.targets for member in members]).T.contiguous()
    kernel = Hyperparameters(
        lengthscales=_joined([member.lengthscales for member in members]),
        signal_variance=_joined([member.signal_variance for member in members]),
        noise_variance=_joined([member.noise_variance for member in members]),
    )
    offset = _joined([member.offset for member in members])
    inducing = [points for member in members for points in member.inducing]
    are_sparse = [bool(member.inducing) for member in members]
    if not any(are_sparse):
        return GPPosterior.from_hyperparameters(
            features,
            targets,
            lengthscales=kernel.lengthscales,
            signal_variance=kernel.signal_variance,
            noise_variance=kernel.noise_variance,
            input_dim=input_dim,
            predicts=predicts,
            offset=offset,
            signals=signals,
        )
    if not all(are_sparse) or not all_equal(inducing):
        raise ShapeError(
            "all outputs must be sparse, with the same inducing points (M, d); "
            "got different ones"
        )
    corrects_diagonal = gpytorch.settings.sgpr_diagonal_correction.on()
    method: Method = "fitc" if corrects_diagonal else "sgpr"
    without_offset = sparse_posterior(
        inducing[0].clone(),
        features,
        targets - offset,
        kernel,
        input_dim=input_dim,
        predicts=predicts,
        method=method,
    )
    posterior = without_offset.unscaled(
        identity(features), Scaling(offset, torch.ones_like(offset))
    )
    return replace(posterior, signals=signals)


class _SEARDModel(NamedTuple):
    """The parts of a GPyTorch model with k outputs and the SE-ARD kernel."""

    inputs: list[Tensor]  #: training inputs (N, d), one or one a member of a batch
    targets: Tensor  #: (k, N)
    lengthscales: Tensor  #: (k, d)
    signal_variance: Tensor  #: (k,)
    noise_variance: Tensor  #: (k,)
    offset: Tensor  #: the prior means (k,)
    #: inducing points (M, d), one or one a member of a batch; none of an exact model
    inducing: list[Tensor]


def _read_se_ard(exact: ExactModel) -> _SEARDModel:
    """Reads the parts of an exact model, after a check that it has no others."""
    model = exact.model
    check_forward(model)
    inputs = list(training_features(model))
    targets = model.train_targets
    targets = targets[None] if targets.dim() == 1 else targets
    k = len(targets)

    kernel = model.covar_module
    inducing: list[Tensor] = []
    is_sparse = type(kernel) is gpytorch.kernels.InducingPointKernel
    if is_sparse and kernel.active_dims is None:
        points = kernel.inducing_points.detach()
        inducing = list(points.reshape(-1, *points.shape[-2:]))
        kernel = kernel.base_kernel
    signal_variance = torch.ones((), dtype=torch.float64)
    # a derived class may compute something else, and ``active_dims`` select features
    if type(kernel) is gpytorch.kernels.ScaleKernel and kernel.active_dims is None:
        signal_variance = kernel.outputscale
        kernel = kernel.base_kernel
    _check_se_ard(kernel)
    lengthscales = kernel.lengthscale.reshape(-1, kernel.lengthscale.shape[-1])

    mean = model.mean_module
    if type(mean) not in (gpytorch.means.ConstantMean, gpytorch.means.ZeroMean):
        raise UnsupportedModel(
            f"the mean must be zero or constant; got {type(mean).__name__}"
        )
    offset = getattr(mean, "constant", torch.zeros((), dtype=torch.float64))

    def one_an_output(value: Tensor) -> Tensor:
        return value.reshape(-1).expand(k).to(targets.device)

    return _SEARDModel(
        inputs=inputs,
        targets=targets,
        lengthscales=lengthscales.expand(k, inputs[0].shape[1]),
        signal_variance=one_an_output(signal_variance),
        noise_variance=one_an_output(exact.likelihood.noise),
        offset=one_an_output(offset),
        inducing=inducing,
    )


def _check_se_ard(kernel: Any) -> None:
    """Raises ``UnsupportedModel`` unless a kernel is the SE-ARD kernel."""
    is_rbf = type(kernel) is gpytorch.kernels.RBFKernel
    if is_rbf and kernel.active_dims is None:
        return
    name = type(kernel).__name__
    if kernel.active_dims is not None:
        name += " on some dimensions"
    raise UnsupportedModel(
        "GPPosterior has the SE-ARD kernel: RBFKernel, in a ScaleKernel or not; "
        f"got {name}. KernelPosterior takes any kernel"
    )


def _joined(parts: list[Tensor]) -> Tensor:
    """Joins the outputs of all models, apart from any graph."""
    return torch.cat(parts).detach().clone()
