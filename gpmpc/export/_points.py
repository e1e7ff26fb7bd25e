"""Fewer points: a sparse GP over some of a GP's own points.

They are chosen by what they explain, each where most is unexplained by those before
(``informative_points``). The targets of all points count: the sparse GP over the chosen
ones is that of Titsias (2009), with the hyperparameters as they are. A GP that is
sparse already has pseudo-observations, whose noise is correlated; its means at its
points count as targets then, so that variances come out larger, never the means off.
"""

from dataclasses import replace
from typing import Any, TypeVar

import torch

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gp import GPPosterior, Hyperparameters, informative_points
from gpmpc.gp._kernel import kernel_matrix
from gpmpc.gp._sparse import JITTER, sparse_posterior
from gpmpc.models import ResidualModel
from gpmpc.models._wrapper import LinearWrapper

_Model = TypeVar("_Model", bound=DynamicsModel)


@explains_arguments
def with_points(model: _Model, points: int) -> _Model:
    """Returns a model whose GPs have fewer points: those that explain most.

    The targets of all points go on to count (sparse GPs). Where further points would
    explain nothing but round-off the model has fewer than were asked for.

    Args:
        model: A ``GPPosterior``, a ``ResidualModel``, or one of these in a
            ``DelayedModel`` or ``DisturbedModel``.
        points: How many, at most as many as the model has.

    Raises:
        SettingError: Another model, or another number of points.

    See Also:
        ``choose_points``, which finds the number that a chip holds.
    """
    size = len(posterior_of(model))
    check_number("points", points, least=1, whole=True)
    if points > size:
        raise SettingError("points", f"the model has {size} points; got {points}")
    if points == size:
        return model
    return _with_points(model, points)


def posterior_of(model: Any) -> GPPosterior:
    """Returns the GPs of a model.

    Raises:
        SettingError: There are none, or such that cannot be exported.
    """
    if isinstance(model, GPPosterior):
        return model
    if isinstance(model, ResidualModel) and isinstance(model.residual, GPPosterior):
        return model.residual
    if isinstance(model, LinearWrapper):
        return posterior_of(model.model)
    rule = "must be one of GPs to have points, a GPPosterior or a ResidualModel of one"
    raise SettingError("model", f"{rule}; got {type(model).__name__}")


def informative_order(model: DynamicsModel) -> list[int]:
    """Returns the points of a model's GPs, each the most informative after the last.

    Those that explain nothing but round-off after the others are missing.
    """
    gp = posterior_of(model)
    return informative_points(gp.features, _hyperparameters(gp), len(gp))


def _with_points(model: Any, count: int) -> Any:
    """Returns a model around GPs of fewer points."""
    if isinstance(model, GPPosterior):
        return _sparse(model, count)
    if isinstance(model, ResidualModel):
        return replace(model, residual=_sparse(model.residual, count))
    return replace(model, model=_with_points(model.model, count))


def _sparse(gp: GPPosterior, count: int) -> GPPosterior:
    """Returns the sparse GPs over the most informative points."""
    hyperparameters = _hyperparameters(gp)
    chosen = informative_points(gp.features, hyperparameters, count)
    targets = gp.targets - gp.offset
    if not gp.has_observation_noise:
        targets = _means_at_points(gp)
    with torch.no_grad():
        sparse = sparse_posterior(
            gp.features[chosen],
            gp.features,
            targets,
            hyperparameters,
            input_dim=gp.input_dim,
            predicts=gp.predicts,
            # always: it moves means by hundredths of the noise, and makes the weights,
            # whose terms cancel in a sum, several times smaller
            jitter=JITTER,
        )
    return replace(
        sparse,
        targets=sparse.targets + gp.offset,
        offset=gp.offset,
        signals=gp.signals,
        # less than what was observed with, where the process' part was told apart
        noise_variance=gp.noise_variance,
    )


def _means_at_points(gp: GPPosterior) -> Any:
    """Returns the means of GPs at their own points (N, k), less the prior means."""
    kernel = kernel_matrix(
        gp.features, gp.features, gp.lengthscales, gp.signal_variance
    )
    return (kernel @ gp.weights[..., None])[..., 0].mT


def _hyperparameters(gp: GPPosterior) -> Hyperparameters:
    """Returns the hyperparameters of GPs, with the noise of what was observed."""
    noise = gp.observation_noise
    if noise is None:
        noise = gp.noise_variance
    return Hyperparameters(
        lengthscales=gp.lengthscales,
        signal_variance=gp.signal_variance,
        noise_variance=noise,
    )
