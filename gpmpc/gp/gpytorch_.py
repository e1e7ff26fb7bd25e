"""Exact GPs in GPyTorch: one per output as one batch, their likelihood, and safe training of models of any kernel.

Everything is float64, and the Cholesky factorisation is exact at every size: left alone, GPyTorch turns to an iterative
solver above 800 points, adds jitter without a word, and keeps the noise above 1e-4.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import gpytorch
import numpy as np
import torch
from gpytorch.constraints import Positive
from scipy.optimize import minimize
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError, TrainingError, UnsupportedModel, check_number
from gpmpc.gp._kernel import centred
from gpmpc.gp._likelihood import FAILED
from gpmpc.gp.posterior import GPPosterior


@contextmanager
def exact_inference() -> Iterator[None]:
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


def to_gpytorch(posterior: GPPosterior) -> BatchExactGP:
    """Builds the GPyTorch model of a posterior; its prior mean is a constant that training leaves alone."""
    model = BatchExactGP(posterior.features, posterior.targets)
    model.mean_module = gpytorch.means.ConstantMean(batch_shape=posterior.offset.shape).requires_grad_(False)
    model.mean_module.constant.copy_(posterior.offset)
    deviation, noise = posterior.signal_variance.log() / 2, posterior.noise_variance.log() / 2
    theta = torch.cat([posterior.lengthscales.log(), torch.stack([deviation, deviation - noise], 1)], 1)
    model.set_hyperparameters(theta)
    return model.eval()


class GPyTorchLikelihood:
    """Evaluates the negative log marginal likelihood by GPyTorch, as ``NegativeLogMarginalLikelihood`` does.

    Args:
        features: x~ (N, d).
        targets: y (N,).
    """

    def __init__(self, features: np.ndarray, targets: np.ndarray):
        self._model = BatchExactGP(torch.from_numpy(centred(features)), torch.from_numpy(targets)[:, None]).train()
        self._likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(self._model.likelihood, self._model)

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and gradient (d + 2,) at theta; infinite where K is not positive definite."""
        model = self._model
        model.set_hyperparameters(torch.from_numpy(theta)[None])
        model.zero_grad()
        try:
            with exact_inference():
                # GPyTorch divides by the number of points.
                value = -self._likelihood(model(*model.train_inputs), model.train_targets) * len(model.train_inputs[0])
            value.sum().backward()
        except (gpytorch.utils.errors.NotPSDError, gpytorch.utils.errors.NanError):
            return np.inf, np.zeros_like(theta)
        by_lengthscale = model.covar_module.base_kernel.raw_lengthscale.grad[0, 0].numpy()
        by_signal = float(2 * model.covar_module.raw_outputscale.grad[0])
        by_noise = float(2 * model.likelihood.noise_covar.raw_noise.grad[0, 0])
        return float(value.detach()), np.append(by_lengthscale, [by_signal + by_noise, -by_noise])


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


@dataclass(frozen=True)
class GPyTorchFit:
    """The result of ``fit``, one entry a model.

    Attributes:
        objective: Negative log marginal likelihood, all outputs of a batch together, minus log priors.
        explored: The same from every start; ``FAILED`` where there was none.
        evaluations: All starts and models together.
        seconds: Wall time [s].
    """

    objective: np.ndarray
    explored: np.ndarray
    evaluations: int
    seconds: float  # [s]


def fit(
    model: Any,
    likelihood: Any = None,
    *,
    restarts: int = 0,
    iterations: int = 500,
    tolerance: float = 1e-8,
    seed: int = 0,
) -> GPyTorchFit:
    """Trains models in place, from their present parameters, and leaves them in evaluation mode.

    The exact marginal likelihood (with the priors of the model's parameters, if it has any) is maximised over all
    parameters that require a gradient by scipy's L-BFGS-B, which steps back from a failed evaluation.

    Args:
        model: An ``ExactGP`` in float64 (single or batch), an ``IndependentModelList``, or a sequence of models.
        likelihood: Its ``GaussianLikelihood``, or a list of them; the models' own by default.
        restarts: Random starts besides the present one: normal steps of one from it in the raw parameters.
        iterations: Of L-BFGS from every start, at most.
        tolerance: Relative decrease of the objective at which L-BFGS stops.
        seed: Of the random starts.

    Raises:
        TrainingError: Every start failed for a model; its outputs are named, and its parameters are as they were.
        SettingError: A setting is out of range, or a model is not in float64.
        UnsupportedModel: It is no single-task ``ExactGP`` with a ``GaussianLikelihood``.
    """
    check_number("restarts", restarts, least=0, whole=True)
    check_number("iterations", iterations, least=1, whole=True)
    check_number("tolerance", tolerance, above=0)
    begin, rng, first = time.perf_counter(), np.random.default_rng(seed), 0
    explored, evaluations = [], 0
    for one, own in members(model, likelihood):
        objective = _Objective(one, own)
        outputs = one.train_targets.shape[0] if one.train_targets.dim() > 1 else 1
        present = objective.vector()
        starts = [present, *(present + rng.normal(size=(restarts, len(present))))]
        options = {"ftol": tolerance, "gtol": 1e-6, "maxiter": iterations, "maxfun": 5 * iterations}
        ends = [minimize(objective, start, jac=True, method="L-BFGS-B", options=options) for start in starts]
        best = min(ends, key=lambda end: end.fun)
        evaluations += sum(end.nfev for end in ends)
        if best.fun >= FAILED:
            objective.write(present)
            names = ", ".join(str(a) for a in range(first, first + outputs))
            raise TrainingError(
                list(range(first, first + outputs)),
                f"no start of {restarts + 1} led to a positive definite kernel matrix for output {names}: "
                "raise the noise or its lower limit, remove duplicate rows, or scale the data",
            )
        objective.write(best.x)
        one.eval()
        own.eval()
        explored.append([end.fun for end in ends])
        first += outputs
    found = np.array(explored)
    return GPyTorchFit(found.min(axis=1), found, evaluations, time.perf_counter() - begin)


class _Objective:
    """The negative log marginal likelihood over the vector of all raw parameters."""

    def __init__(self, model: Any, likelihood: Any):
        self.model = model
        model.train()
        likelihood.train()
        self.likelihood = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
        # A likelihood that is not the model's own has parameters of its own; nothing twice.
        both = [*model.parameters(), *likelihood.parameters()]
        self.parameters = list({id(p): p for p in both if p.requires_grad}.values())
        self.size = model.train_targets.shape[-1]

    def vector(self) -> np.ndarray:
        return torch.cat([p.detach().reshape(-1) for p in self.parameters]).to("cpu", torch.float64).numpy().copy()

    def write(self, vector: np.ndarray) -> None:
        pieces = torch.from_numpy(vector).split([p.numel() for p in self.parameters])
        with torch.no_grad():
            for parameter, piece in zip(self.parameters, pieces, strict=True):
                parameter.copy_(piece.reshape(parameter.shape))

    def __call__(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        self.write(vector)
        for parameter in self.parameters:
            parameter.grad = None
        try:
            with exact_inference(), torch.enable_grad():
                # GPyTorch divides by the number of points.
                value = (
                    -self.likelihood(self.model(*self.model.train_inputs), self.model.train_targets).sum() * self.size
                )
                value.backward()
        except (gpytorch.utils.errors.NotPSDError, gpytorch.utils.errors.NanError, torch.linalg.LinAlgError):  # pyright: ignore[reportPrivateImportUsage]
            return FAILED, np.zeros_like(vector)
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.parameters]
        gradient = torch.cat([g.reshape(-1) for g in gradients]).to("cpu", torch.float64).numpy()
        total = float(value.detach())
        if not (np.isfinite(total) and np.isfinite(gradient).all()):
            return FAILED, np.zeros_like(vector)
        return total, gradient
