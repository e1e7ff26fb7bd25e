"""Checks of GPyTorch models before they are frozen: are they exact, and their modules?

GPyTorch predicts by a model's ``forward``, which may scale inputs, pass them through a
network, or add to the mean; its mean and kernel modules know nothing of it. So the
prior by ``forward`` is compared with theirs at training points and around them.
"""

import copy
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import gpytorch
import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel

_PROBES = 25  # points at which a model's forward is compared with its parts, twice
_SAME = 1e-8  # relative difference of two priors that are the same
_REMEDY = (
    "KernelPosterior.from_gpytorch takes an exact model's forward as it is; for "
    "GPPosterior, train on transformed data (GPPosterior.unscaled gives units back)"
)


@contextmanager
def exact_inference() -> Iterator[None]:
    """Keeps GPyTorch on the exact Cholesky factorisation in a ``with`` block.

    GPyTorch's settings are of the whole process: one thread at a time may be in it.

    See Also:
        ``to_gpytorch``, whose predictions it keeps exact.
    """
    settings = gpytorch.settings
    with (
        settings.fast_computations(False, False, False),
        settings.max_cholesky_size(10**9),
        settings.cholesky_max_tries(1),  # no silent jitter on the diagonal
    ):
        yield


class ExactModel(NamedTuple):
    """A trained exact GP of GPyTorch, of one output or a batch of them."""

    model: Any  #: an ``ExactGP``
    likelihood: Any  #: its ``GaussianLikelihood``


def exact_models(model: Any, likelihood: Any) -> list[ExactModel]:
    """Lists trained exact GPs with their likelihoods, and checks them.

    Args:
        model: One model, an ``IndependentModelList`` or a sequence of models.
        likelihood: One for all, a list, or None for the models' own.

    Raises:
        UnsupportedModel: A model or a likelihood is of another kind.
        ShapeError: The numbers of models and likelihoods differ, or there is more than
            one batch dimension.
        SettingError: A model is not in float64.
    """
    models = _as_list(getattr(model, "models", model))
    likelihoods = _as_list(getattr(likelihood, "likelihoods", likelihood))
    if len(likelihoods) == 1:
        likelihoods = likelihoods * len(models)
    if len(likelihoods) != len(models):
        raise ShapeError(
            f"each model needs one likelihood; got {len(models)} models and "
            f"{len(likelihoods)}"
        )
    pairs = []
    for one, own in zip(models, likelihoods, strict=True):
        own = getattr(one, "likelihood", None) if own is None else own
        _check_exact(one, own)
        pairs.append(ExactModel(model=one, likelihood=own))
    return pairs


def _as_list(value: Any) -> list[Any]:
    if isinstance(value, Sequence | torch.nn.ModuleList):
        return list(value)
    return [value]


def _check_exact(model: Any, likelihood: Any) -> None:
    """Raises unless this is an exact GP with Gaussian noise, as ``exact_models``."""
    if not isinstance(model, gpytorch.models.ExactGP) or model.train_inputs is None:
        raise UnsupportedModel(
            "only ExactGP models with training data can be frozen; "
            f"got {type(model).__name__}"
        )
    if type(likelihood) is not gpytorch.likelihoods.GaussianLikelihood:
        raise UnsupportedModel(
            "the likelihood must be a GaussianLikelihood; "
            f"got {type(likelihood).__name__}"
        )
    targets: Any = model.train_targets
    if targets.dim() > 2:
        raise ShapeError(
            "a batch of models has one batch dimension; "
            f"got targets {tuple(targets.shape)}"
        )
    for transform in ("input_transform", "outcome_transform"):
        if getattr(model, transform, None) is not None:
            raise UnsupportedModel(
                f"the model carries an {transform}, which its hyperparameters do not "
                "contain: train without it, and give the units back by "
                "GPPosterior.unscaled"
            )
    if targets.dtype != torch.float64 or model.train_inputs[0].dtype != torch.float64:
        raise SettingError(
            "model", "must be in float64 (model.double(), data too); got float32"
        )


def check_forward(model: Any) -> None:
    """Raises ``UnsupportedModel`` unless ``forward`` is that of mean and kernel.

    Mean and covariance of the prior are compared at training points and around them.
    """
    copied = copy.deepcopy(model).eval().requires_grad_(False)
    for part in ("mean_module", "covar_module"):
        if not callable(getattr(copied, part, None)):
            raise UnsupportedModel(
                f"the model has no {part}, which it would be frozen from. {_REMEDY}"
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
                f"({type(error).__name__}: {error}). {_REMEDY}"
            ) from error
        try:
            own_mean = copied.mean_module(points)
            own_covariance = copied.covar_module(points).to_dense()
        except Exception:  # the modules are made for other inputs, as of a network
            own_mean = torch.full_like(mean, torch.nan)
            own_covariance = covariance
    differences = {
        "mean": _difference(mean, own_mean, mean.std() + 1),
        "covariance": _difference(covariance, own_covariance, covariance.abs().max()),
    }
    for what, difference in differences.items():
        if not difference <= _SAME:
            raise UnsupportedModel(
                "the model's forward is not the distribution of its mean_module and "
                f"covar_module: the prior's {what} is another one (it scales, warps or "
                f"adds), and only the modules would be frozen. {_REMEDY}"
            )


def check_pointwise(model: Any) -> None:
    """Raises ``UnsupportedModel`` where a point's prior depends on other points."""
    points = training_points(model)[..., :_PROBES, :]
    with torch.no_grad():
        prior_of_three = model.forward(points[..., :3, :])
        prior = model.forward(points)
    mean = prior_of_three.mean
    count = mean.shape[-1]
    covariance = prior.covariance_matrix[..., :count, :count]
    differences = [
        _difference(prior.mean[..., :count], mean, prior.mean.std() + 1),
        _difference(
            covariance, prior_of_three.covariance_matrix, covariance.abs().max()
        ),
    ]
    if not max(differences) <= _SAME:
        raise UnsupportedModel(
            "the model's forward gives a point another prior beside other points, as "
            "where it scales by the range of what it is given: take the range of the "
            "training inputs once and for all"
        )


def _probes(model: Any) -> Tensor:
    """Returns points at which priors are compared (*batch, P, d).

    They are training points, and points around them: in the box of the training
    inputs and up to half its width outside.
    """
    inputs = training_points(model)
    among = inputs[..., :: max(1, inputs.shape[-2] // _PROBES), :][..., :_PROBES, :]
    lower = inputs.amin(dim=-2)
    upper = inputs.amax(dim=-2)
    width = torch.where(upper > lower, upper - lower, 1.0)
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(
        _PROBES,
        inputs.shape[-1],
        generator=generator,
        dtype=torch.float64,
        device="cpu",  # the generator's
    )
    around = lower[..., None, :] + (2 * unit.to(inputs) - 0.5) * width[..., None, :]
    return torch.cat([among, around], dim=-2)


def _difference(values: Tensor, others: Tensor, unit: Tensor) -> float:
    """Computes the largest difference in a unit; infinite where the shapes differ."""
    try:
        others = others.expand_as(values)
    except RuntimeError:
        return math.inf
    return float(((values - others).abs() / unit).max())


def training_features(model: Any) -> Tensor:
    """Returns the training inputs (1, N, d), or those of a batch (k, N, d)."""
    inputs = training_points(model)
    return inputs.reshape(-1, *inputs.shape[-2:])


def training_points(model: Any) -> Tensor:
    """Returns the training inputs with two dimensions or more."""
    inputs = model.train_inputs[0].detach()
    return inputs[:, None] if inputs.dim() == 1 else inputs


def all_equal(tensors: list[Tensor]) -> bool:
    return all(torch.equal(each, tensors[0]) for each in tensors)
