"""Exact GPs in GPyTorch: what is taken of those that others trained, and ours as one of its models.

``from_gpytorch`` freezes SE-ARD models to a ``GPPosterior``. ``KernelPosterior`` takes any kernel and mean: GPyTorch
evaluates the prior, and the rest is one exact Cholesky factorisation of K + sn2 I and

    mean = m(x~) + k' (K + sn2 I)^-1 (y - m(X)),   variance = k(x~, x~) - |L^-1 k|^2

(Rasmussen and Williams, 2006, Algorithm 2.1). Left alone, GPyTorch turns to an iterative solver above 800 points, adds
jitter without a word, keeps the noise above 1e-4, takes no leading batch dimensions and fails under ``torch.func``.
"""

import copy
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import gpytorch
import torch
from gpytorch.constraints import Positive
from torch import Tensor

from gpmpc._dynamics import (
    Array,
    Linearized,
    TensorModel,
    check_destination,
    check_query,
    linearize_by_autograd,
)
from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp._kernel import Hyperparameters, Predicts, check_columns
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._scaling import Scaling, identity
from gpmpc.gp._sparse import Method, sparse_posterior
from gpmpc.signals import UNKNOWN, Signals, check_signals, signals_of

_PROBES = 25  # points at which a model's forward is compared with its parts, twice
_SAME = 1e-8  # relative difference of two priors that are the same
_ROADS = (
    "KernelPosterior.from_gpytorch takes an exact model's forward as it is; for "
    "GPPosterior, train on transformed data (GPPosterior.unscaled gives units back)"
)


@contextmanager
def exact_inference() -> Iterator[None]:
    """GPyTorch settings under which fitting and predicting stay on the exact Cholesky factorisation."""
    settings = gpytorch.settings
    # the last: no silent jitter on the diagonal
    with (
        settings.fast_computations(False, False, False),
        settings.max_cholesky_size(10**9),
        settings.cholesky_max_tries(1),
    ):
        yield


class BatchExactGP(gpytorch.models.ExactGP):
    """Independent zero-mean SE-ARD GPs over the same inputs (N, d), one for each column of the targets (N, n)."""

    signals: Signals = UNKNOWN  #: of the posterior that it was made of

    def __init__(self, features: Tensor, targets: Tensor):
        batch = torch.Size([targets.shape[1]])
        d = features.shape[1]
        log = Positive(
            transform=torch.exp, inv_transform=torch.log
        )  # raw values are logarithms
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
        """The prior over all outputs at inputs (N, d)."""
        return gpytorch.distributions.MultivariateNormal(
            self.mean_module(features), self.covar_module(features)
        )

    def set_hyperparameters(self, theta: Tensor) -> None:
        """Takes rows (log l (d), log sf, log(sf / sn)), one an output: (n, d + 2)."""
        with torch.no_grad():
            self.covar_module.base_kernel.raw_lengthscale.copy_(theta[:, None, :-2])
            self.covar_module.raw_outputscale.copy_(2 * theta[:, -2])
            self.likelihood.noise_covar.raw_noise.copy_(
                2 * (theta[:, -2:-1] - theta[:, -1:])
            )


def to_gpytorch(posterior: GPPosterior) -> BatchExactGP:
    """Builds the GPyTorch model of a posterior; its prior mean is a constant that training leaves alone."""
    model = BatchExactGP(posterior.features, posterior.targets)
    model.signals = posterior.signals
    mean = gpytorch.means.ConstantMean(batch_shape=posterior.offset.shape)
    model.mean_module = mean.requires_grad_(False).double()
    model.mean_module.constant.copy_(posterior.offset)
    deviation = posterior.signal_variance.log() / 2
    noise = posterior.noise_variance.log() / 2
    model.set_hyperparameters(
        torch.column_stack([posterior.lengthscales.log(), deviation, deviation - noise])
    )
    return model.eval()


def from_gpytorch(
    model: Any,
    likelihood: Any = None,
    *,
    input_dim: int,
    predicts: Predicts = "next_state",
    signals: Signals | None = None,
) -> GPPosterior:
    """Freezes trained SE-ARD ExactGPs of GPyTorch: one, a batch (one batch dimension, an output each), or a list.

    A sparse one (``InducingPointKernel``) becomes its pseudo-observations; see ``gp.sparse``. Its method is the one by
    which GPyTorch would predict: FITC, unless its setting ``sgpr_diagonal_correction`` is off. (Then its means are
    those of SGPR; its variances lack kxx - qxx and vanish far from Z, ours do not.)

    Args:
        model: An ``ExactGP`` with a zero or constant mean and an ``RBFKernel``, scaled by a ``ScaleKernel`` or
            not; an ``IndependentModelList``; or a sequence of models over the same inputs.
        likelihood: Its ``GaussianLikelihood``, or a list of them; the models' own by default.
        input_dim: m.
        predicts: What the training targets mean.
        signals: Names of states and inputs, and time step; by default those that a model of ``to_gpytorch`` kept.

    Raises:
        UnsupportedModel: The kernel, mean or likelihood is another one, transforms are
            attached, or the model's ``forward`` scales, warps or adds: it is not the
            distribution of its mean and kernel modules.
        ShapeError: The models of a list have other training inputs or inducing points, or there is more than one batch
            dimension.
    """
    signals = signals_of(model) if signals is None else signals
    check_signals(signals)
    rows: list[
        tuple[Tensor, ...]
    ] = []  # targets, length-scales, signal and noise variance, offset
    inputs: list[Tensor] = []
    inducing: list[Tensor] = []
    for one, own in _members(model, likelihood):
        _check_forward(one)
        targets = one.train_targets
        kernel = one.covar_module
        none = torch.zeros((), dtype=torch.float64)
        inputs += _features(one)
        outputs = targets[None] if targets.dim() == 1 else targets
        scale = none + 1
        if (
            isinstance(kernel, gpytorch.kernels.InducingPointKernel)
            and kernel.active_dims is None
        ):
            inducing += kernel.inducing_points.detach().reshape(
                -1, *kernel.inducing_points.shape[-2:]
            )
            kernel = kernel.base_kernel
        if isinstance(kernel, gpytorch.kernels.ScaleKernel):
            scale = kernel.outputscale
            kernel = kernel.base_kernel
        if (
            type(kernel) is not gpytorch.kernels.RBFKernel
            or kernel.active_dims is not None
        ):
            name = type(kernel).__name__ + (
                " on some dimensions" if kernel.active_dims is not None else ""
            )
            rule = (
                "GPPosterior has the SE-ARD kernel: RBFKernel, in a ScaleKernel or not"
            )
            raise UnsupportedModel(
                f"{rule}; got {name}. KernelPosterior takes any kernel"
            )
        if not isinstance(
            one.mean_module, gpytorch.means.ConstantMean | gpytorch.means.ZeroMean
        ):
            raise UnsupportedModel(
                f"the mean must be zero or constant; got {type(one.mean_module).__name__}"
            )
        k = len(outputs)
        constant = getattr(one.mean_module, "constant", none)
        numbers = (
            value.reshape(-1).expand(k).to(targets.device)
            for value in (scale, own.noise, constant)
        )
        lengthscales = kernel.lengthscale.reshape(
            -1, kernel.lengthscale.shape[-1]
        ).expand(k, inputs[0].shape[1])
        rows.append((outputs, lengthscales, *numbers))
    if not _equal(inputs):
        raise ShapeError(
            "all outputs must have the same training inputs (N, d); got different ones"
        )
    targets, *kernel, offset = (
        torch.cat(values).detach().clone() for values in zip(*rows, strict=True)
    )
    features = inputs[0].clone()
    targets = targets.T.contiguous()
    hyperparameters = Hyperparameters(*kernel)
    if not inducing:
        return GPPosterior.from_hyperparameters(
            features, targets, *hyperparameters, input_dim, predicts, offset, signals
        )
    if len(inducing) not in (1, targets.shape[1]) or not _equal(inducing):
        raise ShapeError(
            "all outputs must be sparse, with the same inducing points (M, d); got different ones"
        )
    method: Method = (
        "fitc" if gpytorch.settings.sgpr_diagonal_correction.on() else "sgpr"
    )
    given = (
        inducing[0].clone(),
        features,
        targets - offset,
        hyperparameters,
        input_dim,
        predicts,
        method,
    )
    posterior = sparse_posterior(*given).unscaled(
        identity(features), Scaling(offset, torch.ones_like(offset))
    )
    return replace(posterior, signals=signals)


@dataclass(frozen=True)
class KernelPosterior(TensorModel):
    """Exact GPs with any kernels of GPyTorch, frozen; build it with ``from_gpytorch``.

    It works with every propagation but ``MomentMatching``, which has a closed form for the SE-ARD kernel only.
    """

    parts: tuple[
        "_Part", ...
    ]  #: one a GPyTorch model, each with one output or a batch of them
    input_dim: int  #: m, how many of the last features are controls
    predicts: Predicts  #: what the targets mean
    signals: Signals = UNKNOWN  #: names and time step of the data, where they are known

    _part = property(lambda self: self.parts[0].cholesky)

    @classmethod
    def from_gpytorch(
        cls,
        model: Any,
        likelihood: Any = None,
        *,
        input_dim: int,
        predicts: Predicts = "next_state",
        signals: Signals | None = None,
    ) -> "KernelPosterior":
        """Freezes trained ExactGPs in float64, which are copied; arguments are as for ``gpmpc.gp.from_gpytorch``.

        Raises:
            UnsupportedModel: The model is no such, or approximate, or its ``forward``
                gives a point another prior beside other points, as one that scales by
                the range of what it is given.
            ShapeError: The numbers of features differ, or do not go with the numbers of outputs and controls.
            SettingError: The model is not in float64, or its kernel matrix is not positive definite.
        """
        found = cls(
            tuple(_Part.of(one, own) for one, own in _members(model, likelihood)),
            input_dim,
            predicts,
            signals_of(model) if signals is None else signals,
        )
        widths = sorted({part.features.shape[-1] for part in found.parts})
        if len(widths) > 1:
            raise ShapeError(
                f"all models must have the same number of features; got {widths}"
            )
        check_columns(
            "the models' features", widths[0], found.output_dim, input_dim, predicts
        )
        found.signals.check_sizes(found.state_dim, input_dim)
        return found

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return self.parts[0].features.shape[-1] - self.input_dim

    @property
    def output_dim(self) -> int:
        """Number of outputs, k."""
        return sum(len(part.noise) for part in self.parts)

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations (k, k), diagonal."""
        return torch.diag(torch.cat([part.noise for part in self.parts]))

    def to(
        self, device: str | torch.device | None = None, dtype: torch.dtype | None = None
    ) -> "KernelPosterior":
        """Copies the model to another device, or to another type: float32 or float64."""
        check_destination(device, dtype)
        to: dict[str, Any] = {"device": device, "dtype": dtype}
        parts = [
            (copy.deepcopy(part.model), *(getattr(part, name) for name in _TENSORS))
            for part in self.parts
        ]
        return replace(
            self,
            parts=tuple(
                _Part(*(value.to(**to) for value in values)) for values in parts
            ),
        )

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """The next state's distribution at a certain state and input; see ``GPPosterior.predict``."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        batch = state.shape[:-1]
        query = torch.cat([state, input], dim=-1)
        flat = query.reshape(-1, query.shape[-1])
        means, variances = zip(
            *(part.predict(flat) for part in self.parts), strict=True
        )
        mean, variance = (
            torch.cat(rows, dim=-1).reshape(*batch, -1) for rows in (means, variances)
        )
        return Gaussian(
            mean + state if self.predicts == "difference" else mean,
            torch.diag_embed(variance),
        )

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the mean at K points (K, n), (K, m) by torch autograd."""
        return linearize_by_autograd(self, states, inputs, covariance)


_TENSORS = ("features", "cholesky", "weights", "noise")


@dataclass(frozen=True)
class _Part:
    """One GPyTorch model with its factorisation: features (k, N, d) or (N, d), without batch for a single one."""

    model: Any
    features: Tensor
    cholesky: Tensor
    weights: Tensor
    noise: Tensor  # (k,)

    @classmethod
    def of(cls, model: Any, likelihood: Any) -> "_Part":
        targets = model.train_targets
        if isinstance(
            getattr(model, "covar_module", None), gpytorch.kernels.InducingPointKernel
        ):
            raise UnsupportedModel(
                "the model is sparse (InducingPointKernel): freeze it by from_gpytorch"
            )
        copied = copy.deepcopy(model).eval().requires_grad_(False)
        copied.prediction_strategy = None
        batch = targets.shape[:-1]
        features = _features(copied)
        features = features.expand(*batch, -1, -1) if batch else features[0]
        noise = likelihood.noise.detach().reshape(-1).expand(*batch or (1,)).clone()
        _check_pointwise(copied)
        with exact_inference(), torch.no_grad():
            prior = copied.forward(features)
            kernel = prior.lazy_covariance_matrix.to_dense().clone()
            kernel.diagonal(dim1=-2, dim2=-1).add_(noise.reshape(*batch, 1))
            cholesky, info = torch.linalg.cholesky_ex(kernel)
            if bool(info.any()):
                rule = "its kernel matrix is not positive definite in float64: raise the noise, or drop equal rows"
                raise SettingError("model", rule)
            weights = torch.cholesky_solve((targets - prior.mean)[..., None], cholesky)[
                ..., 0
            ]
        return cls(copied, features, cholesky, weights, noise)

    def predict(self, query: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance (B, k) at (B, d)."""
        size = self.features.shape[-2]
        joined = torch.cat(
            [self.features, query.expand(*self.features.shape[:-2], -1, -1)], dim=-2
        )
        with exact_inference():
            prior = self.model.forward(
                joined
            )  # lazy: only the two blocks below are evaluated
            covariance = prior.lazy_covariance_matrix
            k = covariance[..., :size, size:].to_dense()  # (*k, N, B)
            own = covariance[..., size:, size:].diagonal(dim1=-2, dim2=-1)
        explained = (
            torch.linalg.solve_triangular(self.cholesky, k, upper=False)
            .square()
            .sum(-2)
        )
        mean = prior.mean[..., size:] + (self.weights[..., None] * k).sum(-2)
        variance = (own - explained).clamp_min(0)
        return mean.reshape(len(self.noise), -1).mT, variance.reshape(
            len(self.noise), -1
        ).mT


def _members(model: Any, likelihood: Any) -> list[tuple[Any, Any]]:
    """Trained exact GPs with their likelihoods, from one model, an ``IndependentModelList`` or a sequence; checked."""
    given: list[Any] = [
        getattr(model, "models", model),
        getattr(likelihood, "likelihoods", likelihood),
    ]
    models, likelihoods = (
        list(x) if isinstance(x, Sequence | torch.nn.ModuleList) else [x] for x in given
    )
    likelihoods = likelihoods * len(models) if len(likelihoods) == 1 else likelihoods
    if len(likelihoods) != len(models):
        raise ShapeError(
            f"each model needs one likelihood; got {len(models)} models and {len(likelihoods)}"
        )
    owners = zip(models, likelihoods, strict=True)
    pairs: list[Any] = [
        (one, getattr(one, "likelihood", None) if own is None else own)
        for one, own in owners
    ]
    for one, own in pairs:
        if not isinstance(one, gpytorch.models.ExactGP) or one.train_inputs is None:
            raise UnsupportedModel(
                f"only ExactGP models with training data can be frozen; got {type(one).__name__}"
            )
        if type(own) is not gpytorch.likelihoods.GaussianLikelihood:
            raise UnsupportedModel(
                f"the likelihood must be a GaussianLikelihood; got {type(own).__name__}"
            )
        if one.train_targets.dim() > 2:
            shape = tuple(one.train_targets.shape)
            raise ShapeError(
                f"a batch of models has one batch dimension; got targets {shape}"
            )
        for transform in ("input_transform", "outcome_transform"):
            if getattr(one, transform, None) is not None:
                raise UnsupportedModel(
                    f"the model carries an {transform}, which its hyperparameters do not contain: "
                    "train without it, and give the units back by GPPosterior.unscaled"
                )
        if (
            one.train_targets.dtype != torch.float64
            or one.train_inputs[0].dtype != torch.float64
        ):
            raise SettingError(
                "model", "must be in float64 (model.double(), data too); got float32"
            )
    return pairs


def _check_forward(model: Any) -> None:
    """Raises ``UnsupportedModel`` unless ``forward`` is that of mean and kernel.

    GPyTorch predicts by a model's ``forward``, which may scale inputs, pass them
    through a network, or add to the mean; its modules know nothing of it. So mean and
    covariance of the prior are compared at training points and around them.
    """
    copied = copy.deepcopy(model).eval().requires_grad_(False)
    for part in ("mean_module", "covar_module"):
        if not callable(getattr(copied, part, None)):
            raise UnsupportedModel(
                f"the model has no {part}, which it would be frozen from. {_ROADS}"
            )
    points = _probes(copied)
    with torch.no_grad():
        try:
            prior = copied.forward(points)
            mean = prior.mean
            covariance = prior.covariance_matrix
        except Exception as error:
            raise UnsupportedModel(
                "the model's forward fails at points around its training inputs "
                f"({type(error).__name__}: {error}). {_ROADS}"
            ) from error
        try:
            own_mean = copied.mean_module(points)
            own_covariance = copied.covar_module(points).to_dense()
        except Exception:  # the modules are made for other inputs, as of a network
            own_mean = torch.full_like(mean, torch.nan)
            own_covariance = covariance
    missed = [
        _difference(mean, own_mean, mean.std() + 1),
        _difference(covariance, own_covariance, covariance.abs().max()),
    ]
    for what, error in zip(("mean", "covariance"), missed, strict=True):
        if not error <= _SAME:
            raise UnsupportedModel(
                "the model's forward is not the distribution of its mean_module and "
                f"covar_module: the prior's {what} is another one (it scales, warps or "
                f"adds), and only the modules would be frozen. {_ROADS}"
            )


def _check_pointwise(model: Any) -> None:
    """Raises ``UnsupportedModel`` where a point's prior depends on other points."""
    points = _training_points(model)[..., :_PROBES, :]
    with torch.no_grad():
        alone = model.forward(points[..., :3, :])
        among = model.forward(points)
    count = alone.mean.shape[-1]
    covariance = among.covariance_matrix[..., :count, :count]
    errors = [
        _difference(among.mean[..., :count], alone.mean, among.mean.std() + 1),
        _difference(covariance, alone.covariance_matrix, covariance.abs().max()),
    ]
    if not max(errors) <= _SAME:
        raise UnsupportedModel(
            "the model's forward gives a point another prior beside other points, as "
            "where it scales by the range of what it is given: take the range of the "
            "training inputs once and for all"
        )


def _probes(model: Any) -> Tensor:
    """Points at which priors are compared (*batch, P, d): of the training, and around.

    They lie in the box of the training inputs and up to half its width outside.
    """
    inputs = _training_points(model)
    among = inputs[..., :: max(1, inputs.shape[-2] // _PROBES), :][..., :_PROBES, :]
    lower = inputs.amin(dim=-2)
    upper = inputs.amax(dim=-2)
    width = torch.where(upper > lower, upper - lower, 1.0)
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(
        _PROBES, inputs.shape[-1], generator=generator, dtype=torch.float64
    )
    around = lower[..., None, :] + (2 * unit.to(inputs) - 0.5) * width[..., None, :]
    return torch.cat([among, around], dim=-2)


def _difference(values: Tensor, others: Tensor, unit: Tensor) -> float:
    """The largest difference in a unit; infinite where the shapes differ, or NaN."""
    try:
        others = others.expand_as(values)
    except RuntimeError:
        return math.inf
    return float(((values - others).abs() / unit).max())


def _features(model: Any) -> Tensor:
    """The training inputs of a model, once (1, N, d) or for every member of a batch (k, N, d)."""
    inputs = _training_points(model)
    return inputs.reshape(-1, *inputs.shape[-2:])


def _training_points(model: Any) -> Tensor:
    """The training inputs of a model as they are, but of two dimensions or more."""
    inputs = model.train_inputs[0].detach()
    return inputs[:, None] if inputs.dim() == 1 else inputs


def _equal(tensors: list[Tensor]) -> bool:
    return all(torch.equal(each, tensors[0]) for each in tensors)
