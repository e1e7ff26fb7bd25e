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
from gpmpc.gp._backend import host_arrays
from gpmpc.propagation._propagator import (
    NoisyPropagator,
    Propagation,
    Sensitivity,
    checked_input,
)


class _Expansion(NamedTuple):
    """The model around a certain state and input."""

    belief: Gaussian  # the prediction there
    A: Tensor  # the mean's derivative by the state (*batch, k, n)
    B: Tensor  # by the input (*batch, k, m)
    variance_by_state: Tensor  # (*batch, k, n)
    variance_by_input: Tensor  # (*batch, k, m)
    mean_by_state2: Tensor  # second derivatives (*batch, k, n, n)
    mean_by_state_input: Tensor  # (*batch, k, n, m)


def expand(model: Any, state: Tensor, input: Tensor) -> _Expansion | None:
    """The expansion of GPs alone by the compiled loops; None for other models, and where those cannot evaluate."""
    form = getattr(model, "affine_form", None)
    if (
        form is None
        or form.B is not None
        or (arrays := host_arrays(form.f.weights, state, input)) is None
    ):
        return None
    from gpmpc import _kernels as kernels  # loads numba

    batch = state.shape[:-1]
    gp = form.f
    flat = arrays[1].reshape(-1, gp.state_dim)
    found = kernels.point_with_jacobian(
        gp.packed, flat, arrays[2].reshape(len(flat), gp.input_dim)
    )
    parts = [torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found]
    mean = parts[0] + gp.offset
    A = parts[2]
    if form.A is not None:
        mean = mean + state
        A = A + form.A
    return _Expansion(Gaussian(mean, torch.diag_embed(parts[1])), A, *parts[3:])


class Linearization(NoisyPropagator):
    """First order, with the model's noise unless ``process_noise=False``."""

    first_order = True  #: mean, derivatives and variance of the model at the belief's mean are all that it takes

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives in closed form; None where there is none."""
        input = checked_input(model, belief, input)
        if (expansion := expand(model, belief.mean, input)) is None:
            return None
        A = expansion.A
        AS = A @ belief.covariance
        by_mean = torch.einsum("...ip,...jpc->...ijc", AS, expansion.mean_by_state2)
        by_input = torch.einsum(
            "...ip,...jpc->...ijc", AS, expansion.mean_by_state_input
        )
        by_covariance = torch.einsum("...ic,...jd->...ijcd", A, A)
        sensitivity = Sensitivity(
            A,
            torch.zeros_like(expansion.mean_by_state2),
            expansion.B,
            by_mean
            + by_mean.transpose(-3, -2)
            + torch.diag_embed(expansion.variance_by_state.mT).movedim(-3, -1),
            (by_covariance + by_covariance.mT) / 2,
            by_input
            + by_input.transpose(-3, -2)
            + torch.diag_embed(expansion.variance_by_input.mT).movedim(-3, -1),
        )
        return self._projected(
            model, *_first_order(belief, expansion.belief, A)
        ), sensitivity

    def _moved(
        self, model: Any, belief: Gaussian, input: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        at_mean, A, _ = predict_with_jacobian(model, belief.mean, input)
        return _first_order(belief, at_mean, A)


class MeanEquivalence(NoisyPropagator):
    """The prediction at the belief's mean, as ``Linearization`` but without the uncertainty of the state.

    State and next state come out uncorrelated.
    """

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """``propagate`` with all derivatives in closed form; None where there is none."""
        input = checked_input(model, belief, input)
        certain = Gaussian(belief.mean, torch.zeros_like(belief.covariance))
        if (
            found := Linearization(self.process_noise).differentiate(
                model, certain, input
            )
        ) is None:
            return None
        moved, d = found
        return moved, replace(
            d, covariance_by_covariance=torch.zeros_like(d.covariance_by_covariance)
        )

    def _moved(
        self, model: Any, belief: Gaussian, input: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        moved = model.predict(belief.mean, input)
        return (
            moved.mean,
            moved.covariance,
            moved.covariance.new_zeros(*belief.mean.shape, moved.dim),
        )


def _first_order(
    belief: Gaussian, at_mean: Gaussian, A: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    S = belief.covariance
    return at_mean.mean, at_mean.covariance + A @ S @ A.mT, S @ A.mT
