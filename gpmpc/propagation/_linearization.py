"""Propagation through a model's expansion at the belief's mean, as in an extended Kalman filter.

With A = dm/dx at (mu, u) and the model's own variance there,

    mu+ = m(mu, u),   Sigma+ = A S A' + Var[f(mu, u)],   Cov[x, x+] = S A'

Mean equivalence leaves A S A' out (Hewing, Kabzan and Zeilinger, 2020).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpmpc._dynamics import predict_with_jacobian
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.gp._backend import host_arrays
from gpmpc.propagation._propagator import NoisyPropagator, Propagation, checked_input
from gpmpc.propagation._sensitivity import Sensitivity


class _Expansion(NamedTuple):
    """The model around a certain state and input."""

    belief: Gaussian  #: the prediction there
    A: Tensor  #: the mean's derivative by the state (*batch, k, n)
    B: Tensor  #: by the input (*batch, k, m)
    variance_by_state: Tensor  #: (*batch, k, n)
    variance_by_input: Tensor  #: (*batch, k, m)
    mean_by_state2: Tensor  #: second derivatives (*batch, k, n, n)
    mean_by_state_input: Tensor  #: (*batch, k, n, m)


def expand(model: Any, state: Tensor, input: Tensor) -> _Expansion | None:
    """The expansion of GPs alone, compiled or by torch; None for other models."""
    form = getattr(model, "affine_form", None)
    if form is None or form.B is not None:
        return None
    gp = form.f
    if (arrays := host_arrays(gp.weights, state, input)) is None:
        parts = _by_torch(gp, state, input)
    else:
        from gpmpc import _kernels as kernels  # loads numba

        batch = state.shape[:-1]
        flat = arrays[1].reshape(-1, gp.state_dim)
        found = kernels.point_with_jacobian(gp.packed, flat, arrays[2].reshape(len(flat), gp.input_dim))
        parts = [torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found]
    mean, A = parts[0] + gp.offset, parts[2]
    if form.A is not None:
        mean, A = mean + state, A + form.A
    return _Expansion(Gaussian(mean, torch.diag_embed(parts[1])), A, *parts[3:])


def _by_torch(model: GPPosterior, state: Tensor, input: Tensor) -> list[Tensor]:
    """The entries of ``kernels.Expansion``."""
    n, inverse_squares = model.state_dim, model.lengthscales**-2
    difference = (model.features - torch.cat([state, input], dim=-1)[..., None, :])[..., None, :, :]
    z = difference * inverse_squares[:, None, :]  # (*batch, k, N, d)
    k = model.signal_variance[:, None] * torch.exp(-(z * difference).sum(-1) / 2)
    weighted, explained_by = model.weights * k, model.solve(k)
    jacobian = (weighted[..., None, :] @ z)[..., 0, :]
    variance_by = -2 * ((explained_by * k)[..., None, :] @ z)[..., 0, :]
    own = torch.diag_embed(inverse_squares)[:, :n]
    second = (weighted[..., None] * z[..., :n]).mT @ z - weighted.sum(-1)[..., None, None] * own
    variance = (model.signal_variance - model.variance_reduction(k)).clamp_min(0)
    parts = [half for whole in (jacobian, variance_by, second) for half in (whole[..., :n], whole[..., n:])]
    return [weighted.sum(-1), variance, *parts]


class Linearization(NoisyPropagator):
    """First order; ``process_noise=True`` adds the model's noise covariance."""

    first_order = True  #: mean, derivatives and variance of the model at the belief's mean are all that it takes

    def propagate(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``."""
        input = checked_input(model, belief, input)
        at_mean, A, _ = predict_with_jacobian(model, belief.mean, input)
        return self._propagation(model, belief, at_mean, A)

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives in closed form; None where the model has none."""
        input = checked_input(model, belief, input)
        if (expansion := expand(model, belief.mean, input)) is None:
            return None
        A = expansion.A
        AS = A @ belief.covariance
        by_mean = torch.einsum("...ip,...jpc->...ijc", AS, expansion.mean_by_state2)
        by_input = torch.einsum("...ip,...jpc->...ijc", AS, expansion.mean_by_state_input)
        by_covariance = torch.einsum("...ic,...jd->...ijcd", A, A)
        sensitivity = Sensitivity(
            A,
            torch.zeros_like(expansion.mean_by_state2),
            expansion.B,
            by_mean + by_mean.transpose(-3, -2) + torch.diag_embed(expansion.variance_by_state.mT).movedim(-3, -1),
            (by_covariance + by_covariance.mT) / 2,
            by_input + by_input.transpose(-3, -2) + torch.diag_embed(expansion.variance_by_input.mT).movedim(-3, -1),
        )
        return self._propagation(model, belief, expansion.belief, A), sensitivity

    def _propagation(self, model: Any, belief: Gaussian, at_mean: Gaussian, A: Tensor) -> Propagation:
        S = belief.covariance
        return self._projected(model, at_mean.mean, at_mean.covariance + A @ S @ A.mT, S @ A.mT)


class MeanEquivalence(NoisyPropagator):
    """The prediction at the belief's mean, as ``Linearization`` but without the uncertainty of the state."""

    def propagate(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief one step on; see ``Propagator.propagate``. State and next state come out uncorrelated."""
        moved = model.predict(belief.mean, checked_input(model, belief, input))
        cross = torch.zeros_like(belief.mean[..., :, None].expand(*belief.mean.shape, moved.dim))
        return self._projected(model, moved.mean, moved.covariance, cross)

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives in closed form; None where the model has none."""
        certain = Gaussian(belief.mean, torch.zeros_like(belief.covariance))
        if (found := Linearization(self.process_noise).differentiate(model, certain, input)) is None:
            return None
        moved, d = found
        return moved, replace(d, covariance_by_covariance=torch.zeros_like(d.covariance_by_covariance))
