"""A Gaussian belief over the state moved one step on through a model, and the derivatives of that step."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import batched_jacobian, check_query
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import (
    Gaussian,
    check_tensors,
    constant_arrays,
    nearest_positive_semidefinite,
)
from gpmpc.signals import Signals, signals_of


@dataclass(frozen=True)
class Propagation:
    """A belief moved one step on."""

    belief: Gaussian  #: N(mean, covariance) of the next state; the covariance is symmetric positive semidefinite
    cross_covariance: Tensor  #: Cov[x, x+] (*batch, n, k)
    #: how far below zero the covariance's smallest eigenvalue was before the projection (*batch,). More than round-off
    #: of the largest entry: the model is too nearly noise-free for double precision
    deficit: Tensor


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the next belief N(mu+, Sigma+) at a belief N(mu, Sigma) and an input u; k outputs, mostly k = n.

    Those by Sigma are symmetric in their last two indices: d mu+_a = sum_cd mean_by_covariance[a, c, d] dSigma[c, d]
    for symmetric dSigma.
    """

    mean_by_mean: Tensor  #: (*batch, k, n)
    mean_by_covariance: Tensor  #: (*batch, k, n, n)
    mean_by_input: Tensor  #: (*batch, k, m)
    covariance_by_mean: Tensor  #: (*batch, k, k, n)
    covariance_by_covariance: Tensor  #: (*batch, k, k, n, n)
    covariance_by_input: Tensor  #: (*batch, k, k, m)


class Propagator(Protocol):
    """One way to move a Gaussian through a model; called, it gives the next belief alone.

    A propagator with closed-form derivatives for a model has a method ``differentiate`` with the arguments of
    ``propagate``, which returns the ``Propagation`` and its ``Sensitivity``, or None where it has none.
    """

    def propagate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> Propagation:
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

    def __call__(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> Gaussian:
        """The next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief


class NoisyPropagator(Propagator):
    """A propagator that adds the model's noise covariance to the predicted one, unless it is told not to.

    Args:
        process_noise: Whether the noise that the model has learned moves the state, at every step: a belief is then
            over the state that will be there. Without it a belief is over the latent function's value, as if all
            noise were of the sensors, and several steps on its intervals are too narrow by what happens in between.
    """

    diagonal = False  #: whether only the diagonal of the predicted covariance is kept

    def __init__(self, process_noise: bool = True):
        self.process_noise = process_noise

    def propagate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``."""
        return self._projected(
            model, *self._moved(model, belief, checked_input(model, belief, input))
        )

    def _moved(
        self, model: Any, belief: Gaussian, input: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, covariance and Cov[x, x+] of the next state, without process noise."""
        raise NotImplementedError

    def _projected(
        self, model: Any, mean: Tensor, covariance: Tensor, cross: Tensor
    ) -> Propagation:
        """Adds the process noise, if any, and projects the covariance."""
        if self.process_noise:
            covariance = covariance + model.noise_covariance
        if self.diagonal:
            covariance = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
        covariance, deficit = nearest_positive_semidefinite(covariance)
        return Propagation(Gaussian(mean, covariance), cross, deficit)


def differentiate(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> tuple[Propagation, Sensitivity]:
    """Moves a belief one step on, with its derivatives.

    Args:
        propagator: How.
        model: A ``DynamicsModel``.
        belief: Mean (*batch, n), covariance (*batch, n, n).
        input: (*batch, m); may be left out where m = 0.

    Returns:
        What ``propagator.propagate`` returns, and the derivatives. Where the covariance had to be projected they are
        those of the projection (autograd) or of what was projected (closed form).
    """
    closed_form = getattr(propagator, "differentiate", None)
    if (
        closed_form is not None
        and (found := closed_form(model, belief, input)) is not None
    ):
        return found
    return by_autograd(propagator, model, belief, input)


def by_autograd(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> tuple[Propagation, Sensitivity]:
    """``differentiate`` by torch autograd, for any propagator and model that torch can follow."""
    input = checked_input(model, belief, input)
    n = belief.dim
    k = model.output_dim
    with torch.inference_mode(
        False
    ):  # inference tensors, constants too, could not be saved for backward
        rows, columns = torch.tril_indices(k, k, device=belief.mean.device)
    batch = belief.mean.shape[:-1]

    def step(mean: Tensor, covariance: Tensor, control: Tensor) -> tuple[Tensor, ...]:
        out = propagator.propagate(
            model, Gaussian(mean, covariance.unflatten(-1, (n, n))), control
        )
        entries = torch.cat(
            [out.belief.mean, out.belief.covariance[..., rows, columns]], dim=-1
        )
        return (
            entries,
            out.belief.mean,
            out.belief.covariance,
            out.cross_covariance,
            out.deficit,
        )

    values, (by_mean, by_covariance, by_input) = batched_jacobian(
        step,
        (
            belief.mean,
            belief.covariance.flatten(-2),
            input.expand(*batch, input.shape[-1]),
        ),
    )
    by_covariance = by_covariance.unflatten(-1, (n, n))
    by_covariance = (by_covariance + by_covariance.mT) / 2
    whole = torch.zeros(k, k, dtype=torch.long, device=rows.device)
    whole[rows, columns] = whole[columns, rows] = (
        torch.arange(len(rows), device=rows.device) + k
    )
    of_mean = by_mean[..., :k, :], by_covariance[..., :k, :, :], by_input[..., :k, :]
    of_covariance = (
        by_mean[..., whole, :],
        by_covariance[..., whole, :, :],
        by_input[..., whole, :],
    )
    moved = Propagation(Gaussian(values[1], values[2]), values[3], values[4])
    return moved, Sensitivity(*of_mean, *of_covariance)


def checked_input(model: Any, belief: Gaussian, input: Tensor | None) -> Tensor:
    """Checks belief and control by the rules of ``Propagator.propagate``; returns the control (*batch, m).

    Values are checked where that is free: in host memory, outside torch's transforms.
    """
    if not isinstance(belief, Gaussian):
        raise SettingError("belief", f"must be a Gaussian; got {type(belief).__name__}")
    if belief.names:
        signals_of(model).check("the model", Signals(belief.names), "it", "belief")
    input = belief.mean[..., :0] if input is None else input
    check_tensors(input=input)
    if input.dim() == 1 and input.shape[-1] == model.input_dim:
        input = input.expand(
            *belief.mean.shape[:-1], model.input_dim
        )  # one control for all
    check_query(model, belief.mean, input)
    if (
        belief.covariance.dtype != belief.mean.dtype
        or belief.covariance.device != belief.mean.device
    ):
        raise SettingError(
            "belief", "mean and covariance must have the same dtype and device"
        )
    if (arrays := constant_arrays(belief.mean, belief.covariance, input)) is None:
        return input
    for name, array in zip(
        ("the belief's mean", "the belief's covariance", "the input"),
        arrays,
        strict=True,
    ):
        if not np.isfinite(array).all():
            raise DataError(f"{name} must be finite; got {array}")
    _check_semidefinite(arrays[1])
    return input


def _check_semidefinite(covariance: np.ndarray) -> None:
    largest = np.abs(covariance).max(initial=0.0)
    round_off = np.finfo(covariance.dtype).eps ** 0.5 * largest
    gap = np.abs(covariance - np.swapaxes(covariance, -1, -2)).max(initial=0.0)
    if gap > round_off:
        raise DataError(
            f"the belief's covariance must be symmetric; got entries that differ by {float(gap):.3g}"
        )
    try:
        np.linalg.cholesky(
            covariance
            + round_off * np.eye(covariance.shape[-1], dtype=covariance.dtype)
        )
    except np.linalg.LinAlgError:
        if (lowest := float(np.linalg.eigvalsh(covariance).min())) < -round_off:
            raise DataError(
                f"the belief's covariance must be positive semidefinite; got an eigenvalue of {lowest:.3g} "
                f"(largest entry {float(largest):.3g})"
            ) from None
