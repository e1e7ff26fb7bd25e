"""Posteriors with any kernel and mean of GPyTorch.

GPyTorch evaluates the prior, and the rest is one exact Cholesky factorisation of
K + sn2 I and

    mean = m(x~) + k' (K + sn2 I)^-1 (y - m(X)),   variance = k(x~, x~) - |L^-1 k|^2

(Rasmussen and Williams, 2006, Algorithm 2.1). Left alone, GPyTorch turns to an
iterative solver above 800 points, adds jitter without a word, keeps the noise above
1e-4, takes no leading batch dimensions and fails under ``torch.func``.
"""

import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gpytorch
import torch
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
from gpmpc.gp._gpytorch_checks import (
    ExactModel,
    check_pointwise,
    exact_inference,
    exact_models,
    training_features,
)
from gpmpc.gp._tensor_checks import Predicts, check_columns
from gpmpc.signals import UNKNOWN, Signals, check_signals, signals_of


@dataclass(frozen=True, eq=False)
class KernelPosterior(TensorModel):
    """Exact GPs with any kernels of GPyTorch, frozen; build it with ``from_gpytorch``.

    It works with every propagation but ``MomentMatching``, which has a closed form for
    the SE-ARD kernel only.

    See Also:
        ``from_gpytorch``, which makes one; ``GPPosterior`` with SE kernels.
    """

    #: one a GPyTorch model, each with one output or a batch of them
    parts: tuple["_FrozenModel", ...]
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
        """Freezes trained ExactGPs in float64, which are copied.

        Arguments are as for ``gpmpc.gp.from_gpytorch``.

        Raises:
            UnsupportedModel: The model is no such, or approximate, or its ``forward``
                gives a point another prior beside other points, as one that scales by
                the range of what it is given.
            ShapeError: The numbers of features differ, or do not go with the numbers of
                outputs and controls.
            SettingError: The model is not in float64, or its kernel matrix is not
                positive definite.
        """
        parts = [_FrozenModel.freeze(one) for one in exact_models(model, likelihood)]
        signals = signals_of(model) if signals is None else signals
        check_signals(signals)
        posterior = cls(
            parts=tuple(parts),
            input_dim=input_dim,
            predicts=predicts,
            signals=signals,
        )
        widths = sorted({part.features.shape[-1] for part in parts})
        if len(widths) > 1:
            raise ShapeError(
                f"all models must have the same number of features; got {widths}"
            )
        check_columns(
            "the models' features",
            d=widths[0],
            k=posterior.output_dim,
            input_dim=input_dim,
            predicts=predicts,
        )
        posterior.signals.check_sizes(posterior.state_dim, input_dim)
        return posterior

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
        """Covariance of the observations (k, k), diagonal."""
        return torch.diag(torch.cat([part.noise for part in self.parts]))

    def to(
        self, device: str | torch.device | None = None, dtype: torch.dtype | None = None
    ) -> "KernelPosterior":
        """Copies the model to another device or type, float32 or float64."""
        check_destination(device, dtype)
        parts = [part.to(device, dtype) for part in self.parts]
        return replace(self, parts=tuple(parts))

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """Predicts the next state's distribution; see ``GPPosterior.predict``."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        query = torch.cat([state, input], dim=-1)
        rows = query.reshape(-1, query.shape[-1])
        predictions = [part.predict(rows) for part in self.parts]
        shape = (*state.shape[:-1], self.output_dim)
        mean = torch.cat([p.mean for p in predictions], dim=-1).reshape(shape)
        variance = torch.cat([p.variance for p in predictions], dim=-1).reshape(shape)
        if self.predicts == "difference":
            mean = mean + state
        return Gaussian(mean, torch.diag_embed(variance))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the mean at K points (K, n), (K, m) by torch autograd."""
        return linearize_by_autograd(self, states, inputs, covariance)


class _Prediction(NamedTuple):
    """Means and variances of a model's outputs at B points."""

    mean: Tensor  #: (B, k)
    variance: Tensor  #: (B, k)


@dataclass(frozen=True, eq=False)
class _FrozenModel:
    """A GPyTorch model with its factorisation; k is left out for a single output."""

    model: Any
    features: Tensor  #: (k, N, d)
    cholesky: Tensor  #: factor of K + sn2 I (k, N, N)
    weights: Tensor  #: (K + sn2 I)^-1 (y - m(X)) (k, N)
    noise: Tensor  #: sn2 (k,), also of a single output

    @classmethod
    def freeze(cls, exact: ExactModel) -> "_FrozenModel":
        """Copies a model, and factorises."""
        kernel_module = getattr(exact.model, "covar_module", None)
        if isinstance(kernel_module, gpytorch.kernels.InducingPointKernel):
            raise UnsupportedModel(
                "the model is sparse (InducingPointKernel): freeze it by from_gpytorch"
            )
        targets = exact.model.train_targets
        model = copy.deepcopy(exact.model).eval().requires_grad_(False)
        model.prediction_strategy = None
        batch = targets.shape[:-1]
        features = training_features(model)
        features = features.expand(*batch, -1, -1) if batch else features[0]
        noise = exact.likelihood.noise.detach().reshape(-1).expand(*batch or (1,))
        noise = noise.clone()
        check_pointwise(model)
        with exact_inference(), torch.no_grad():
            prior = model.forward(features)
            kernel = prior.lazy_covariance_matrix.to_dense().clone()
            kernel.diagonal(dim1=-2, dim2=-1).add_(noise.reshape(*batch, 1))
            cholesky, info = torch.linalg.cholesky_ex(kernel)
            if bool(info.any()):
                raise SettingError(
                    "model",
                    "its kernel matrix is not positive definite in float64: raise the "
                    "noise, or drop equal rows",
                )
            residuals = (targets - prior.mean)[..., None]
            weights = torch.cholesky_solve(residuals, cholesky)[..., 0]
        return cls(
            model=model,
            features=features,
            cholesky=cholesky,
            weights=weights,
            noise=noise,
        )

    def to(self, device: Any, dtype: torch.dtype | None) -> "_FrozenModel":
        """Copies the model to another device or type."""
        return _FrozenModel(
            model=copy.deepcopy(self.model).to(device=device, dtype=dtype),
            features=self.features.to(device=device, dtype=dtype),
            cholesky=self.cholesky.to(device=device, dtype=dtype),
            weights=self.weights.to(device=device, dtype=dtype),
            noise=self.noise.to(device=device, dtype=dtype),
        )

    def predict(self, query: Tensor) -> _Prediction:
        """Predicts at points (B, d)."""
        size = self.features.shape[-2]
        expanded = query.expand(*self.features.shape[:-2], -1, -1)
        joined = torch.cat([self.features, expanded], dim=-2)
        # Nothing but the prior is asked, which depends on none of GPyTorch's settings.
        # These are of the whole process: other threads may be at work with them.
        prior = self.model.forward(joined)
        # Lazy: only the two blocks below are evaluated.
        covariance = prior.lazy_covariance_matrix
        k = covariance[..., :size, size:].to_dense()  # (*k, N, B)
        own = covariance[..., size:, size:].diagonal(dim1=-2, dim2=-1)
        whitened = torch.linalg.solve_triangular(self.cholesky, k, upper=False)
        mean = prior.mean[..., size:] + (self.weights[..., None] * k).sum(-2)
        variance = (own - whitened.square().sum(-2)).clamp_min(0)
        outputs = len(self.noise)
        return _Prediction(
            mean=mean.reshape(outputs, -1).mT,
            variance=variance.reshape(outputs, -1).mT,
        )
