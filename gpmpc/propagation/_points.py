"""Propagation through any model without its derivatives, by points.

The points carry the belief's moments; the next state's covariance is theirs plus the
mean of the model's own (law of total covariance).

Unscented: with n states and lambda = alpha^2 (n + kappa) - n, the points are mu and
mu +- sqrt(n + lambda) times the columns of the symmetric root of Sigma (Julier and
Uhlmann, 2004; van der Merwe, 2004). The default parameters give the spherical cubature
rule (Arasaratnam and Haykin, 2009), whose weights are positive, so that no covariance
can come out indefinite.

Where outputs are angles, whole turns are counted before values are averaged: the mean
of 3.1 and -3.1 rad is pi, not 0. An output that is a state, now or a step later, is
expected to differ from its value at the mean by as much as the point does; any other by
nothing. Values come within half a turn of what is expected. So a wide belief over an
angle stays wide, whether the model wraps or not. A model that moves on by a turn where
its angle does wraps nowhere: its turns are real, as of a heading under a wide belief
over its rate, and stay.

Monte Carlo: the reference for every other. Its standard error falls as one over the
root of the number of samples.
"""

import logging
import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import TURN, angles_of, whole_turns
from gpmpc._calls import explains_arguments
from gpmpc._functions import call
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import (
    Gaussian,
    constant_arrays,
    square_root,
    square_root_differential,
)
from gpmpc.propagation._linearization import (
    SecondOrderExpansion,
    expand_to_second_order,
    on_diagonal,
)
from gpmpc.propagation._propagator import (
    NextMoments,
    NoisyPropagator,
    Propagation,
    Sensitivity,
    checked_arguments,
)

_log = logging.getLogger(__name__)
_LEAST_ALPHA = 1e-7
# n + lambda below which the weights of sigma points, about one over it, leave no digits
_LEAST_SPREAD = _LEAST_ALPHA**2
# samples of all beliefs of a batch that are predicted at once: a GP's points' kernels
# at them are as many times N * outputs numbers, by torch times n + m
_CHUNK = 1000
# part of the points that may lie further than a quarter turn from the first before the
# log says that turns may be miscounted
_FAR_POINTS = 0.01


class _SigmaPoints(NamedTuple):
    """The points of an unscented transform, the mean first."""

    steps: Tensor  # from the mean (*batch, 2n + 1, n)
    states: Tensor  # (*batch, 2n + 1, n)
    inputs: Tensor  # the same input at each (*batch, 2n + 1, m)


class _Weights(NamedTuple):
    """Weights of sigma points (2n + 1,)."""

    mean: Tensor
    covariance: Tensor


class _ByParameters(NamedTuple):
    """Derivatives by the mean, by the covariance and by the input, in that order."""

    mean: Tensor  # (..., n)
    covariance: Tensor  # (..., n, n)
    input: Tensor  # (..., m)


@explains_arguments
class Unscented(NoisyPropagator):
    """The unscented transform.

    Args:
        alpha: Spread of the points.
        beta: Weight of the centre in the covariance; 2 is best for Gaussians of small
            alpha.
        kappa: Secondary spread.
        process_noise: Whether the model's noise covariance is added.

    Raises:
        SettingError: alpha is below 1e-7, or (at the first step) n + kappa is not
            positive, or alpha^2 (n + kappa) below 1e-14.

    >>> import torch
    >>> from gpmpc.gaussian import Gaussian
    >>> from gpmpc.models import KnownModel
    >>> model = KnownModel(lambda x, u: x**2, state_dim=1, input_dim=0)
    >>> belief = Gaussian(torch.zeros(1).double(), torch.eye(1).double())
    >>> Unscented()(model, belief).mean.tolist()
    [1.0]

    See Also:
        ``MomentMatching``, which is exact for GPs; ``MonteCarlo``.
    """

    def __init__(
        self,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.0,
        process_noise: bool = True,
    ):
        check_number("alpha", alpha, least=_LEAST_ALPHA)
        check_number("beta", beta)
        check_number("kappa", kappa)
        super().__init__(process_noise)
        self.alpha = alpha
        self.beta = beta
        self.kappa = kappa

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """Propagates with all derivatives, by those of the model at every point.

        Returns None where the model has no closed ones. Where an eigenvalue of Sigma is
        zero its root has no derivative; zero is taken there, and so are derivatives by
        a Sigma of zero. Next to it, by round-off too, they have other limits.
        """
        input = checked_arguments(model, belief, input)
        eigenvalues, U = torch.linalg.eigh(belief.covariance)
        r = eigenvalues.clamp_min(0).sqrt()
        root = U @ (r[..., :, None] * U.mT)
        points = self._sigma_points(belief, root, input)
        expansion = expand_to_second_order(model, points.states, points.inputs)
        if expansion is None:
            return None
        mean_by, covariance_by = self._derivatives(belief.dim, expansion)
        by_mean = _from_root_to_covariance(mean_by, belief, r, U)
        by_covariance = _from_root_to_covariance(covariance_by, belief, r, U)
        sensitivity = Sensitivity(
            mean_by_mean=by_mean.mean,
            mean_by_covariance=by_mean.covariance,
            mean_by_input=by_mean.input,
            covariance_by_mean=by_covariance.mean,
            covariance_by_covariance=by_covariance.covariance,
            covariance_by_input=by_covariance.input,
        )
        moments = self._moments(
            model, belief, input, steps=points.steps, predictions=expansion.belief
        )
        return self._complete_step(model, moments, sensitivity)

    def _derivatives(
        self, n: int, expansion: SecondOrderExpansion
    ) -> tuple[Tensor, Tensor]:
        """Returns those of mean (*batch, k, p) and covariance (*batch, k, k, p).

        They are by the p parameters [mu, vec(root), u] of the points: point 1 + j moves
        with column j of the root, and point 1 + n + j against it.
        """
        weights = self._weights(expansion.A, n)
        eye = torch.eye(n, dtype=expansion.A.dtype, device=expansion.A.device)
        columns = math.sqrt(self._spread(n)) * eye
        # Point i is mu + root @ steps[i]: so d point_c / d root_cd = steps[i, d].
        steps = torch.cat([torch.zeros_like(columns[:1]), columns, -columns])

        # (*batch, points, k, n) and (*batch, points, k, m) to (*batch, points, k, p)
        def by_parameters(by_state: Tensor, by_input: Tensor) -> Tensor:
            by_root = by_state[..., :, None] * steps[:, None, None, :]
            return torch.cat([by_state, by_root.flatten(-2), by_input], dim=-1)

        values_by = by_parameters(expansion.A, expansion.B)
        variances_by = by_parameters(
            expansion.variance_by_state, expansion.variance_by_input
        )
        values = expansion.belief.mean  # (*batch, points, k)
        mean_by = torch.einsum("i,...iap->...ap", weights.mean, values_by)
        mean = torch.einsum("i,...ia->...a", weights.mean, values)
        half_covariance_by = torch.einsum(
            "i,...iap,...ib->...abp",
            weights.covariance,
            values_by - mean_by[..., None, :, :],
            values - mean[..., None, :],
        )
        variance_by = torch.einsum("i,...iap->...ap", weights.mean, variances_by)
        covariance_by = half_covariance_by + half_covariance_by.transpose(-3, -2)
        return mean_by, covariance_by + on_diagonal(variance_by)

    def _spread(self, n: int) -> float:
        """Returns n + lambda: the points' squared distance in units of the root."""
        if n + self.kappa <= 0:
            raise SettingError(
                "kappa", f"n + kappa must be positive; got {n} states and {self.kappa}"
            )
        spread = self.alpha**2 * (n + self.kappa)
        if spread < _LEAST_SPREAD:
            rule = "alpha^2 (n + kappa) must be 1e-14 or more"
            raise SettingError("kappa", f"{rule}; got {spread:.3g} of {n} states")
        return spread

    def _weights(self, like: Tensor, n: int) -> _Weights:
        """Returns the weights of the points in the mean and in the covariance."""
        spread = self._spread(n)
        in_mean = like.new_full((2 * n + 1,), 1 / (2 * spread))
        in_covariance = in_mean.clone()
        in_mean[0] = 1 - n / spread
        in_covariance[0] = 2 - n / spread - self.alpha**2 + self.beta
        return _Weights(mean=in_mean, covariance=in_covariance)

    def _sigma_points(
        self, belief: Gaussian, root: Tensor, input: Tensor
    ) -> _SigmaPoints:
        # the root is symmetric: its rows are its columns
        columns = math.sqrt(self._spread(belief.dim)) * root
        centre = torch.zeros_like(columns[..., :1, :])
        steps = torch.cat([centre, columns, -columns], dim=-2)
        return _SigmaPoints(
            steps=steps,
            states=belief.mean[..., None, :] + steps,
            inputs=_repeated(input, steps),
        )

    def _next_moments(self, model: Any, belief: Gaussian, input: Tensor) -> NextMoments:
        points = self._sigma_points(belief, square_root(belief.covariance), input)
        predictions = call("model", model.predict, points.states, points.inputs)
        return self._moments(
            model, belief, input, steps=points.steps, predictions=predictions
        )

    def _moments(
        self,
        model: Any,
        belief: Gaussian,
        input: Tensor,
        steps: Tensor,
        predictions: Gaussian,
    ) -> NextMoments:
        """Returns the moments of predictions at the points."""
        weights = self._weights(belief.mean, belief.dim)
        values = _with_turns(
            predictions.mean,
            centre=predictions.mean[..., 0, :],
            steps=steps,
            model=model,
            belief=belief,
            input=input,
        )
        mean = weights.mean @ values
        centred = values - mean[..., None, :]
        covariance = centred.mT @ (weights.covariance[:, None] * centred)
        own = (weights.mean[:, None, None] * predictions.covariance).sum(-3)
        # The centre's step is zero. All other points have one weight, that of the
        # second, in the mean as in the covariance.
        weight = weights.mean[1]
        return NextMoments(
            mean=mean,
            covariance=covariance + own,
            cross_covariance=steps.mT @ (weight * centred),
        )


def _from_root_to_covariance(
    by_parameters: Tensor, belief: Gaussian, r: Tensor, U: Tensor
) -> _ByParameters:
    """Turns derivatives by [mu, vec(root), u] (..., p) into those by mu, Sigma, u.

    The root is U diag(r) U'. Its change dR = L(dSigma) is linear, and L its own adjoint
    (``square_root_differential``). The value that is differentiated has axes of its own
    between those of the batch and p: one of a mean (k, p), two of a covariance.
    """
    n = belief.dim
    by_root = by_parameters[..., n : n + n * n].unflatten(-1, (n, n))
    by_root_symmetric = (by_root + by_root.mT) / 2
    value_axes = by_root.dim() - belief.mean.dim() - 1
    # (*batch, n, n, number of values)
    columns = by_root_symmetric.flatten(-2 - value_axes, -3).movedim(-3, -1)
    by_covariance = square_root_differential(r, U, columns).movedim(-1, -3)
    return _ByParameters(
        mean=by_parameters[..., :n],
        covariance=by_covariance.reshape(by_root.shape),
        input=by_parameters[..., n + n * n :],
    )


@explains_arguments
class MonteCarlo(NoisyPropagator):
    """Sampling; the same seed gives the same samples at every call.

    Args:
        samples: Number of states that are drawn.
        seed: Seed of the draws.
        process_noise: Whether the model's noise covariance is added.

    Raises:
        SettingError: Fewer than two samples, or a seed that is no whole number.

    >>> import torch
    >>> from gpmpc.gaussian import Gaussian
    >>> from gpmpc.models import KnownModel
    >>> model = KnownModel(lambda x, u: 2.0 * x, state_dim=1, input_dim=0)
    >>> belief = Gaussian(torch.zeros(1).double(), torch.eye(1).double())
    >>> after = MonteCarlo(samples=4000)(model, belief)
    >>> round(float(after.covariance), 1) in (3.9, 4.0, 4.1)
    True

    See Also:
        ``MomentMatching``, which is exact for GPs; ``Unscented``.
    """

    def __init__(
        self, samples: int = 10_000, seed: int = 0, process_noise: bool = True
    ):
        check_number("samples", samples, least=2, whole=True)
        check_number("seed", seed, least=0, whole=True)
        super().__init__(process_noise)
        self.samples = samples
        self.seed = seed

    def _next_moments(self, model: Any, belief: Gaussian, input: Tensor) -> NextMoments:
        steps = self._draw_steps(belief)
        means = []
        covariances = 0.0
        beliefs = steps.shape[:-2].numel()
        for chunk in steps.split(max(_CHUNK // max(beliefs, 1), 1), dim=-2):
            states = belief.mean[..., None, :] + chunk
            predictions = call("model", model.predict, states, _repeated(input, states))
            means.append(predictions.mean)
            covariances = covariances + predictions.covariance.sum(-3)
        values = torch.cat(means, dim=-2)
        if angles_of(model):
            centre = model.predict(belief.mean, input).mean
            values = _with_turns(
                values,
                centre=centre,
                steps=steps,
                model=model,
                belief=belief,
                input=input,
            )
        mean = values.mean(-2)
        centred = values - mean[..., None, :]
        sampled = centred.mT @ centred / (self.samples - 1)
        centred_steps = steps - steps.mean(-2, keepdim=True)
        return NextMoments(
            mean=mean,
            covariance=sampled + covariances / self.samples,
            cross_covariance=centred_steps.mT @ centred / (self.samples - 1),
        )

    def _draw_steps(self, belief: Gaussian) -> Tensor:
        """Draws steps from the belief's mean (*batch, samples, n)."""
        # NumPy's generator: torch's would stop a vmap around this call.
        generator = np.random.default_rng(self.seed)
        normal = generator.standard_normal((self.samples, belief.dim))
        return torch.from_numpy(normal).to(belief.mean) @ square_root(belief.covariance)


def _repeated(input: Tensor, states: Tensor) -> Tensor:
    """Returns an input (*batch, m) at each of some states (*batch, points, n)."""
    return input[..., None, :].expand(*states.shape[:-1], input.shape[-1])


def _with_turns(
    values: Tensor,
    centre: Tensor,
    steps: Tensor,
    model: Any,
    belief: Gaussian,
    input: Tensor,
) -> Tensor:
    """Counts the whole turns of outputs that are angles; all others stay.

    Args:
        values: Outputs at points (*batch, points, k).
        centre: Outputs at the belief's mean (*batch, k).
        steps: The points, from the mean (*batch, points, n).
        model: A model of next states, or of measurements.
        belief: Of the states.
        input: (*batch, m).
    """
    angles = angles_of(model)
    if not angles:
        return values
    deviations = values[..., angles] - centre[..., None, angles]
    states = _states_of_outputs(model)
    if states is None:
        expected_deviations = torch.zeros_like(deviations)
    else:
        expected_deviations = steps[..., [states[a] for a in angles]]
    turns = whole_turns(deviations - expected_deviations)
    if states is not None:
        # Two turns on, an angle that the model wraps moves by none, or by one where it
        # crosses the border; one whose turns it counts moves by two, which are no
        # error.
        two_turns = torch.zeros_like(belief.mean)
        two_turns[..., [states[a] for a in angles]] = 2 * TURN
        displacement = model.predict(belief.mean + two_turns, input).mean - centre
        counts_turns = displacement[..., angles] > 1.5 * TURN
        turns = turns.masked_fill(counts_turns[..., None, :], 0.0)
    else:
        _warn_of_wide_angles(deviations - turns, type(model).__name__)
    counted = values.clone()
    counted[..., angles] = values[..., angles] - turns
    return counted


def _states_of_outputs(model: Any) -> Sequence[int] | None:
    """Returns the state that each output is, now or later; None where it is none."""
    if hasattr(model, "measured_states"):
        return model.measured_states
    is_dynamics = model.output_dim == model.state_dim
    return range(model.state_dim) if is_dynamics else None


def _warn_of_wide_angles(deviations: Tensor, name: str) -> None:
    """Logs once where angles (*batch, points, angles) spread over half a turn."""
    arrays = constant_arrays(deviations)
    if arrays is None:
        return
    is_far = np.abs(arrays[0]) > TURN / 4
    if is_far.mean(axis=-2).max(initial=0.0) > _FAR_POINTS:
        _log_wide_angles(name)


@cache
def _log_wide_angles(name: str) -> None:
    _log.warning(
        "an angle of %s spreads over more than half a turn under a belief: its turns "
        "may be miscounted, and the belief corrected the wrong way. Begin with a "
        "narrower belief, or declare an angle that is a state by Measurement.of_states",
        name,
    )
