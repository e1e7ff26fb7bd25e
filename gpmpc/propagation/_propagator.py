"""The protocol of propagation: a Gaussian belief over the state moved one step on through a model."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import check_query
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import Gaussian, check_tensors, constant_arrays, nearest_positive_semidefinite


@dataclass(frozen=True)
class Propagation:
    """A belief moved one step on."""

    belief: Gaussian  #: N(mean, covariance) of the next state; the covariance is symmetric positive semidefinite
    cross_covariance: Tensor  #: Cov[x, x+] (*batch, n, k)
    #: how far below zero the covariance's smallest eigenvalue was before the projection (*batch,). More than round-off
    #: of the largest entry: the model is too nearly noise-free for double precision
    deficit: Tensor


class Propagator(Protocol):
    """One way to move a Gaussian through a model; called, it gives the next belief alone.

    A propagator with closed-form derivatives for a model has a method ``differentiate`` with the arguments of
    ``propagate``, which returns the ``Propagation`` and its ``Sensitivity``, or None where it has none.
    """

    def propagate(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on.

        Args:
            model: A ``DynamicsModel``.
            belief: Over the state: mean (*batch, n), covariance (*batch, n, n).
            input: The certain control (*batch, m); may be left out where m = 0.

        Raises:
            ShapeError: Belief or input do not fit the model.
            SettingError: Their dtype or device is another one.
            DataError: An entry is not finite, or the covariance is not positive semidefinite.
            UnsupportedModel: There is no formula for this model.
        """
        ...

    def __call__(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Gaussian:
        """The next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief


class NoisyPropagator(Propagator):
    """A propagator that adds the model's noise covariance to the predicted one where it is asked to."""

    diagonal = False  #: whether only the diagonal of the predicted covariance is kept

    def __init__(self, process_noise: bool = False):
        self.process_noise = process_noise

    def _projected(self, model: Any, mean: Tensor, covariance: Tensor, cross: Tensor) -> Propagation:
        """Adds the process noise, if any, and projects the covariance; ``cross`` is Cov[x, x+]."""
        if self.process_noise:
            covariance = covariance + model.noise_covariance
        if self.diagonal:
            covariance = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
        covariance, deficit = nearest_positive_semidefinite(covariance)
        return Propagation(Gaussian(mean, covariance), cross, deficit)


def checked_input(model: Any, belief: Gaussian, input: Tensor | None) -> Tensor:
    """Checks belief and control by the rules of ``Propagator.propagate``; returns the control (*batch, m).

    Values are checked where that is free: in host memory, outside torch's transforms.
    """
    if not isinstance(belief, Gaussian):
        raise SettingError("belief", f"must be a Gaussian; got {type(belief).__name__}")
    input = belief.mean[..., :0] if input is None else input
    check_tensors(input=input)
    if input.dim() == 1 and input.shape[-1] == model.input_dim:
        input = input.expand(*belief.mean.shape[:-1], model.input_dim)  # one control for all
    check_query(model, belief.mean, input)
    if belief.covariance.dtype != belief.mean.dtype or belief.covariance.device != belief.mean.device:
        raise SettingError("belief", "mean and covariance must have the same dtype and device")
    if (arrays := constant_arrays(belief.mean, belief.covariance, input)) is None:
        return input
    for name, array in zip(("the belief's mean", "the belief's covariance", "the input"), arrays, strict=True):
        if not np.isfinite(array).all():
            raise DataError(f"{name} must be finite; got {array}")
    _check_semidefinite(arrays[1])
    return input


def _check_semidefinite(covariance: np.ndarray) -> None:
    if not (largest := np.abs(covariance).max(initial=0.0)):
        return
    round_off = np.finfo(covariance.dtype).eps ** 0.5 * largest
    gap = np.abs(covariance - np.swapaxes(covariance, -1, -2)).max()
    if gap > round_off:
        raise DataError(f"the belief's covariance must be symmetric; got entries that differ by {float(gap):.3g}")
    try:
        np.linalg.cholesky(covariance + round_off * np.eye(covariance.shape[-1], dtype=covariance.dtype))
    except np.linalg.LinAlgError:
        lowest = float(np.linalg.eigvalsh(covariance).min())
        if lowest < -round_off:
            raise DataError(
                f"the belief's covariance must be positive semidefinite; got an eigenvalue of {lowest:.3g} "
                f"(largest entry {float(largest):.3g})"
            ) from None
