"""Noise that depends on state and input, as a GP on its logarithm (Goldberg, Williams and Bishop, 1998).

    x[k+1] = f(x[k], u[k]) + e[k],     e_i ~ N(0, sigma_i^2(x, u)),     log sigma_i^2 = g_i ~ N(m_i, v_i) a posteriori

The variance that is used is the mean of sigma_i^2 given the data, exp(m_i + v_i / 2). It varies along a plan with its
states and inputs, and it is averaged over a belief by the propagators that evaluate a model at several points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array, DynamicsModel, Linearized, check_next_states, linearize, to_array
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models._wrapper import Wrapper


@dataclass(frozen=True)
class NoisyModel(Wrapper):
    """A model whose predictions contain its noise, which depends on state and input.

    Everything that predicts counts the noise once: the covariances of ``predict`` and ``linearize`` contain all of it
    and ``noise_covariance`` is zero, so that a propagator gives the same with ``process_noise`` and without. The noise
    of outputs that are not in ``outputs`` is the model's own constant. Linearisations hold the covariance at their
    points. ``MomentMatching``, which has no closed form for it, raises ``UnsupportedModel``.

    Raises:
        SettingError: ``outputs`` are no distinct outputs of the model, which predicts next states, or type or device
            of the GPs are others.
        ShapeError: The GPs have other states, inputs or outputs.
    """

    model: DynamicsModel  #: f, of n states and m inputs
    log_noise: GPPosterior  #: g, over (x, u), with ``predicts="value"``: an output each
    outputs: Sequence[int]  #: the states whose noise g describes, in its order; the others keep that of the model

    def __post_init__(self) -> None:
        n, m = check_next_states(self.model)
        g = self.log_noise
        if not hasattr(g, "predicts"):
            raise SettingError("log_noise", f"must be a GPPosterior; got {type(g).__name__}")
        given: Any = self.outputs
        if not hasattr(given, "__len__") or not given or not all(type(i) is int for i in given):
            raise SettingError("outputs", f"must be a list of whole numbers; got {given!r}")
        outputs = list(self.outputs)
        if g.predicts != "value" or g.dtype != self.dtype or g.device != self.device:
            got = f"{g.predicts!r}, {g.dtype} on {g.device}"
            raise SettingError("log_noise", f"must predict 'value', {self.dtype} on {self.device}; got {got}")
        if len(set(outputs)) < len(outputs) or not set(outputs) <= set(range(n)):
            raise SettingError("outputs", f"must be distinct, of 0 .. {n - 1}; got {outputs}")
        if (found := (g.state_dim, g.input_dim, g.output_dim)) != (n, m, len(outputs)):
            raise ShapeError(f"log_noise must have {n} states, {m} inputs and {len(outputs)} outputs; got {found}")

    @property
    def noise_covariance(self) -> Tensor:
        """Zero (n, n): ``predict`` contains the noise."""
        return torch.zeros_like(self.model.noise_covariance)

    def noise(self, state: Tensor, input: Tensor) -> Tensor:
        """Covariance of the noise at x (*batch, n) and u (*batch, m), (*batch, n, n)."""
        g = self.log_noise.predict(state, input)
        return self._constant + torch.diag_embed((g.mean + g.variance / 2).exp() @ self._places)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at x (*batch, n) and u (*batch, m), with the noise."""
        belief = self.model.predict(state, input)
        return Gaussian(belief.mean, belief.covariance + self.noise(state, input))

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises f at K points (K, n), (K, m); with the noise in the covariance."""
        found = linearize(self.model, states, inputs, covariance)
        if found.covariance is None:
            return found
        g, at = self.log_noise.linearize(states, inputs), list(self.outputs)
        V = found.covariance + to_array(self._constant)
        V[:, at, at] += np.exp(g.mean + np.einsum("kii->ki", cast(Array, g.covariance)) / 2)
        return found._replace(covariance=V)

    def to(self, device: Any = None, dtype: torch.dtype | None = None) -> "NoisyModel":
        """Copies the model to another device or type."""
        inner: Any = self.model
        return replace(self, model=inner.to(device, dtype), log_noise=self.log_noise.to(device, dtype))

    @cached_property
    def _places(self) -> Tensor:
        """Rows of the identity (k, n)."""
        return torch.eye(self.state_dim, dtype=self.dtype, device=self.device)[list(self.outputs)]

    @cached_property
    def _constant(self) -> Tensor:
        """The model's noise covariance without those outputs (n, n)."""
        kept = 1 - self._places.sum(0)
        return kept[:, None] * self.model.noise_covariance * kept
