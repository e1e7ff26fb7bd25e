"""Propagates a Gaussian belief over the state through a model, with derivatives."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import batched_jacobian, check_query, is_in_graph
from gpmpc.exceptions import (
    DataError,
    SettingError,
    check_flag,
    check_kind,
    check_method,
)
from gpmpc.gaussian import (
    Gaussian,
    check_tensors,
    constant_arrays,
    nearest_positive_semidefinite,
)
from gpmpc.signals import Signals, signals_of

# the methods that make a step: who overrides one propagates in another way
_STEP_METHODS = {"propagate", "_next_moments", "_add_noise_and_project"}
_LAST_PLACES = 2**12  # units in it, of the round-off that a covariance may have


@dataclass(frozen=True, eq=False)
class Propagation:
    """A belief after one step.

    See Also:
        ``Propagator``, which returns it.
    """

    #: N(mean, covariance) of the next state; symmetric positive semidefinite covariance
    belief: Gaussian
    cross_covariance: Tensor  #: Cov[x, x+] (*batch, n, k)
    #: how far below zero the covariance's smallest eigenvalue was before the projection
    #: (*batch,). More than round-off of the largest entry: the model is too nearly
    #: noise-free for double precision
    deficit: Tensor


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of the next belief N(mu+, Sigma+) by the belief N(mu, Sigma) and u.

    There are k outputs, mostly k = n. Derivatives by Sigma are symmetric in their last
    two indices: d mu+_a = sum_cd mean_by_covariance[a, c, d] dSigma[c, d] for symmetric
    dSigma.

    See Also:
        ``differentiate``, which returns it.
    """

    mean_by_mean: Tensor  #: (*batch, k, n)
    mean_by_covariance: Tensor  #: (*batch, k, n, n)
    mean_by_input: Tensor  #: (*batch, k, m)
    covariance_by_mean: Tensor  #: (*batch, k, k, n)
    covariance_by_covariance: Tensor  #: (*batch, k, k, n, n)
    covariance_by_input: Tensor  #: (*batch, k, k, m)


class NextMoments(NamedTuple):
    """Moments of the next state, before process noise is added."""

    mean: Tensor  # (*batch, k)
    covariance: Tensor  # (*batch, k, k)
    cross_covariance: Tensor  # Cov[x, x+] (*batch, n, k)


class Propagator(Protocol):
    """A way to propagate a Gaussian; as a function it returns the next belief alone.

    A propagator with closed-form derivatives for a model has a method ``differentiate``
    with the arguments of ``propagate``, which returns the ``Propagation`` and its
    ``Sensitivity``, or None where it has none. Three further attributes are optional,
    and False where they are missing:

    ``first_order``: it needs the model's mean, derivatives and variance at the belief's
    mean alone, and carries the covariance by A S A' + V; controllers and filters may
    then take these themselves.
    ``diagonal``: it computes only the diagonal of the predicted covariance.
    ``process_noise``: it adds the model's noise covariance to the predicted one;
    controllers that predict covariances by themselves then add it too, and a
    ``KalmanFilter`` takes no other.

    See Also:
        ``gpmpc.testing.check_propagator``, which tells what one of one's own
        lacks; ``Linearization``.
    """

    def propagate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> Propagation:
        """Propagates a belief over one step.

        Args:
            model: A ``DynamicsModel``.
            belief: Over the state: mean (*batch, n), covariance (*batch, n, n).
            input: The certain control (*batch, m); may be left out where m = 0.

        Raises:
            ShapeError: Belief or input do not fit the model.
            SettingError: Their dtype or device is another one.
            DataError: An entry is not finite, or the covariance is not positive
                semidefinite; or the predicted mean or covariance is not finite.
            UnsupportedModel: There is no formula for this model.
        """
        ...

    def __call__(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> Gaussian:
        """Returns the next state's belief; see ``propagate``."""
        return self.propagate(model, belief, input).belief


class NoisyPropagator(Propagator):
    """A propagator that adds the model's noise covariance to the predicted one.

    Args:
        process_noise: Whether it does: the noise that the model has learned then moves
            the state, at every step, and a belief is over the state that will be there.
            Without it a belief is over the latent function's value, as if all noise
            were of the sensors, and several steps on its intervals are too narrow by
            what happens in between.
    """

    diagonal = False  #: whether only the predicted covariance's diagonal is computed

    def __init__(self, process_noise: bool = True):
        check_flag("process_noise", process_noise)
        self.process_noise = process_noise

    def propagate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> Propagation:
        """Propagates a belief over one step; see ``Propagator.propagate``."""
        input = checked_arguments(model, belief, input)
        moments = self._next_moments(model, belief, input)
        return self._add_noise_and_project(model, moments)

    def _next_moments(self, model: Any, belief: Gaussian, input: Tensor) -> NextMoments:
        """Returns the moments of the next state, without process noise."""
        raise NotImplementedError

    def _add_noise_and_project(self, model: Any, moments: NextMoments) -> Propagation:
        """Adds process noise, if wanted, and projects the covariance.

        Of a ``diagonal`` propagator only the covariance's diagonal stays.
        """
        covariance = moments.covariance
        if self.process_noise:
            covariance = covariance + model.noise_covariance
        if self.diagonal:
            covariance = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1))
        covariance, deficit = nearest_positive_semidefinite(covariance)
        means = constant_arrays(moments.mean.detach())
        if means is not None:
            _check_finite("a predicted mean", means[0])
        return Propagation(
            belief=Gaussian(moments.mean, covariance),
            cross_covariance=moments.cross_covariance,
            deficit=deficit,
        )

    def _complete_step(
        self, model: Any, moments: NextMoments, sensitivity: Sensitivity
    ) -> tuple[Propagation, Sensitivity]:
        """Finishes a step as ``propagate`` does, and its derivatives likewise."""
        if self.diagonal:
            sensitivity = _of_diagonal(sensitivity)
        return self._add_noise_and_project(model, moments), sensitivity


def _of_diagonal(sensitivity: Sensitivity) -> Sensitivity:
    """Returns derivatives whose covariance keeps its diagonal only."""
    by_mean = sensitivity.covariance_by_mean
    eye = torch.eye(by_mean.shape[-2], dtype=by_mean.dtype, device=by_mean.device)
    by_vector = eye[..., None]  # (k, k, 1)
    by_matrix = by_vector[..., None]  # (k, k, 1, 1)
    return replace(
        sensitivity,
        covariance_by_mean=by_vector * by_mean,
        covariance_by_covariance=by_matrix * sensitivity.covariance_by_covariance,
        covariance_by_input=by_vector * sensitivity.covariance_by_input,
    )


@explains_arguments
def differentiate(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> tuple[Propagation, Sensitivity]:
    """Propagates a belief over one step, with the step's derivatives.

    Args:
        propagator: The way to propagate it.
        model: A ``DynamicsModel``.
        belief: Mean (*batch, n), covariance (*batch, n, n).
        input: (*batch, m); may be left out where m = 0.

    Returns:
        What ``propagator.propagate`` returns, and the derivatives. Where the covariance
        had to be projected, a closed form gives those of the matrix that was projected,
        and autograd, for models without a closed form, those of the projection.
        Derivatives of these derivatives by the covariance lack those of its square
        root, of which ``Unscented`` and ``MonteCarlo`` take their points.

    >>> import torch
    >>> from gpmpc.gaussian import Gaussian
    >>> from gpmpc.models import KnownModel
    >>> from gpmpc.propagation import Unscented
    >>> model = KnownModel(lambda x, u: 3.0 * x, state_dim=1, input_dim=0)
    >>> belief = Gaussian(torch.zeros(1).double(), torch.eye(1).double())
    >>> _, slopes = differentiate(Unscented(), model, belief)
    >>> slopes.mean_by_mean.round(decimals=6).tolist()
    [[3.0]]

    See Also:
        ``linearize``, for plans; ``rollout``.
    """
    check_method("propagator", propagator, "propagate", "Linearization()")
    closed_form = getattr(propagator, "differentiate", None)
    if closed_form is not None and claim_holds(propagator, "differentiate"):
        result = closed_form(model, belief, input)
        if result is not None:
            return result
    return by_autograd(propagator, model, belief, input)


def claim_holds(propagator: Any, claim: str) -> bool:
    """Whether what a class says of its way to propagate is of a propagator's own way.

    A subclass that propagates in another way inherits what is no longer true: from the
    class upwards, it counts which comes first, the claim or another step.

    Args:
        propagator: Of the class.
        claim: Attribute or method that says it: ``first_order``, ``differentiate``.
    """
    if claim in getattr(propagator, "__dict__", {}):
        return True
    for owner in type(propagator).__mro__:
        if claim in vars(owner):
            return True
        if not _STEP_METHODS.isdisjoint(vars(owner)):
            return False
    return True


def by_autograd(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> tuple[Propagation, Sensitivity]:
    """Does what ``differentiate`` does by torch autograd, for any propagator and model.

    torch has to be able to follow both.
    """
    input = checked_arguments(model, belief, input)
    n = belief.dim
    k = model.output_dim
    batch = belief.mean.shape[:-1]
    # inference tensors, constants too, could not be saved for backward
    with torch.inference_mode(False):
        rows, columns = torch.tril_indices(k, k, device=belief.mean.device)

    def step(mean: Tensor, covariance: Tensor, control: Tensor) -> tuple[Tensor, ...]:
        """Returns the k + k (k + 1) / 2 numbers to be differentiated, and all parts."""
        perturbed = Gaussian(mean, covariance.unflatten(-1, (n, n)))
        result = propagator.propagate(model, perturbed, control)
        triangle = result.belief.covariance[..., rows, columns]
        return (
            torch.cat([result.belief.mean, triangle], dim=-1),
            result.belief.mean,
            result.belief.covariance,
            result.cross_covariance,
            result.deficit,
        )

    values, (by_mean, by_covariance, by_input) = batched_jacobian(
        step,
        (
            belief.mean,
            belief.covariance.flatten(-2),
            input.expand(*batch, input.shape[-1]),
        ),
        function_in_graph=is_in_graph(model),
    )
    _, mean, covariance, cross_covariance, deficit = values
    by_covariance = by_covariance.unflatten(-1, (n, n))
    by_covariance = (by_covariance + by_covariance.mT) / 2
    # which of the differentiated numbers each entry of the covariance is
    places = torch.zeros(k, k, dtype=torch.long, device=rows.device)
    in_triangle = torch.arange(len(rows), device=rows.device) + k
    places[rows, columns] = in_triangle
    places[columns, rows] = in_triangle
    propagation = Propagation(
        belief=Gaussian(mean, covariance),
        cross_covariance=cross_covariance,
        deficit=deficit,
    )
    sensitivity = Sensitivity(
        mean_by_mean=by_mean[..., :k, :],
        mean_by_covariance=by_covariance[..., :k, :, :],
        mean_by_input=by_input[..., :k, :],
        covariance_by_mean=by_mean[..., places, :],
        covariance_by_covariance=by_covariance[..., places, :, :],
        covariance_by_input=by_input[..., places, :],
    )
    return propagation, sensitivity


def checked_arguments(model: Any, belief: Gaussian, input: Tensor | None) -> Tensor:
    """Checks the belief and returns the control for its batch.

    The rules are those of ``Propagator.propagate``. Values are checked where that is
    free: in host memory, outside torch's transforms.

    Returns:
        The control (*batch, m).
    """
    check_method("model", model, "predict", "GPPosterior")
    check_kind("belief", belief, Gaussian, "a Gaussian")
    if belief.names:
        signals_of(model).check("the model", Signals(belief.names), "it", "belief")
    input = belief.mean[..., :0] if input is None else input
    check_tensors(input=input)
    if input.dim() == 1 and input.shape[-1] == model.input_dim:
        input = input.expand(*belief.mean.shape[:-1], model.input_dim)  # one for all
    check_query(model, belief.mean, input)
    if (
        belief.covariance.dtype != belief.mean.dtype
        or belief.covariance.device != belief.mean.device
    ):
        raise SettingError(
            "belief", "mean and covariance must have the same dtype and device"
        )
    arrays = constant_arrays(belief.mean, belief.covariance, input)
    if arrays is None:
        return input
    mean, covariance, control = arrays
    _check_finite("the belief's mean", mean)
    _check_finite("the belief's covariance", covariance)
    _check_finite("the input", control)
    _check_semidefinite(covariance)
    return input


def _check_finite(name: str, array: np.ndarray) -> None:
    if not np.isfinite(array).all():
        raise DataError(f"{name} must be finite; got {array}")


def _check_semidefinite(covariance: np.ndarray) -> None:
    """Raises ``DataError`` unless covariances (*batch, n, n) are, up to round-off.

    Each entry is judged beside the variances of its own two states, which may be of
    very different units.
    """
    tolerance = np.finfo(covariance.dtype).eps ** 0.5
    squares = _squares_of_units(covariance)
    gaps = np.abs(covariance - np.swapaxes(covariance, -1, -2))
    if gaps.any() and (gaps > tolerance * _products(squares)).any():
        raise DataError(
            "the belief's covariance must be symmetric; got entries that differ by "
            f"{float(gaps.max()):.3g}"
        )
    eye = np.eye(covariance.shape[-1], dtype=covariance.dtype)
    try:
        np.linalg.cholesky(covariance + tolerance * squares[..., None] * eye)
    except np.linalg.LinAlgError:
        correlations = covariance / _products(squares)
        is_wrong = np.linalg.eigvalsh(correlations).min(axis=-1) < -tolerance
        if is_wrong.any():
            first = covariance[is_wrong][0]
            raise DataError(
                "the belief's covariance must be positive semidefinite; got an "
                f"eigenvalue of {float(np.linalg.eigvalsh(first).min()):.3g} "
                f"(largest entry {float(np.abs(first).max()):.3g})"
            ) from None


def _squares_of_units(covariance: np.ndarray) -> np.ndarray:
    """Returns the square (*batch, n) of what each state's deviations are judged in.

    It is the state's variance, or what round-off leaves of it: a product of matrices
    has the round-off of its largest entry in every entry.
    """
    precision = np.finfo(covariance.dtype)
    # of each matrix of a batch: a wide one says nothing of the others
    largest = np.abs(covariance).max(axis=(-2, -1), initial=precision.tiny)
    round_off = _LAST_PLACES * precision.eps * largest
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    # A variance v is judged by tolerance * v: the v for which that is the round-off.
    return np.maximum(variances, round_off[..., None] / precision.eps**0.5)


def _products(squares: np.ndarray) -> np.ndarray:
    """Returns the product (*batch, n, n) of each two roots."""
    roots = np.sqrt(squares)
    return roots[..., :, None] * roots[..., None, :]
