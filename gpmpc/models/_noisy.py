"""Models whose noise varies with state and input."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import angles_of
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import (
    Array,
    DynamicsModel,
    Linearized,
    check_next_states,
    linearize,
    to_array,
)
from gpmpc._functions import call
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models._features import Features
from gpmpc.models._past import ModelWithPast, measured_dim, rows_before
from gpmpc.models._tensors import check_like, move
from gpmpc.models._wrapper import Wrapper


@explains_arguments
@dataclass(frozen=True, eq=False)
class NoisyModel(Wrapper):
    """A model whose predictions contain its noise, a GP on its logarithm.

        x[k+1] = f(x[k], u[k]) + e[k],   e_i ~ N(0, sigma_i^2(x, u))
        log sigma_i^2 = g_i(phi(x), u) ~ N(m_i, v_i) a posteriori

    (Goldberg, Williams and Bishop, 1998); phi(x) are the states, the model's angles as
    sine and cosine at their place. The variance that is used is the mean of sigma_i^2
    given the data, exp(m_i + v_i / 2). Everything that predicts counts the
    noise once: the covariances of ``predict`` and ``linearize`` contain all of it and
    ``noise_covariance`` is zero, so that a propagator gives the same with
    ``process_noise`` and without. Linearisations hold the covariance at their points.
    ``MomentMatching``, which has no closed form for it, raises ``UnsupportedModel``.

    Raises:
        SettingError: ``outputs`` are no distinct outputs of the model, which predicts
            next states, or type or device of the GPs are others.
        ShapeError: The GPs have other states, inputs or outputs.

    See Also:
        ``gpmpc.estimation.estimate_varying_noise``, which learns one.
    """

    model: DynamicsModel  #: f, of n states and m inputs
    #: g, over (phi(x), u), with ``predicts="value"``: an output each. One over (x, u),
    #: of files of gpmpc 0.2, is taken as well
    log_noise: GPPosterior
    #: the states whose noise g describes, in its order; others keep that of the model
    outputs: Sequence[int]

    to = move

    def __post_init__(self) -> None:
        n, m = check_next_states(self.model)
        g = self.log_noise
        if getattr(g, "predicts", None) != "value":
            got = repr(g.predicts) if isinstance(g, GPPosterior) else type(g).__name__
            rule = "must be a GPPosterior, and must predict 'value'"
            raise SettingError("log_noise", f"{rule}; got {got}")
        check_like("log_noise", g, self)
        _check_outputs(self.outputs, n)
        k = len(self.outputs)
        d = self._features.dim
        dimensions = (g.state_dim, g.input_dim, g.output_dim)
        if dimensions != (d, m, k):
            rule = f"log_noise must have {d} states, {m} inputs and {k} outputs"
            raise ShapeError(f"{rule}; got {dimensions}")

    @cached_property
    def _features(self) -> Features:
        """What g sees: phi(x) and u."""
        periodic = noise_features(self.model)
        if self.log_noise.state_dim == self.state_dim:  # over the states as they are
            return replace(periodic, angles=())
        return periodic

    @property
    def measured_dim(self) -> int:
        """Number of the states that are measured: those of the model."""
        return measured_dim(self.model)

    @property
    def past(self) -> int:
        """Number of rows after which the state forgets what it began with."""
        return rows_before(self.model)

    def at_rest(self, measured: Array, input: Array) -> Array:
        """Returns the state of a plant that stood; see the model, which has a past."""
        return self._model_with_past.at_rest(measured, input)

    def follow(self, state: Array, input: Array, measured: Array) -> Array:
        """Returns the state after a measurement; see the model, which has a past."""
        return self._model_with_past.follow(state, input, measured)

    @property
    def _model_with_past(self) -> ModelWithPast:
        """The model, one of those whose state holds the past."""
        return cast(ModelWithPast, self.model)

    @property
    def noise_covariance(self) -> Tensor:
        """Zero (n, n): ``predict`` contains the noise."""
        return torch.zeros_like(self.model.noise_covariance)

    def noise(self, state: Tensor, input: Tensor) -> Tensor:
        """Computes the covariance of the noise (*batch, n, n).

        Args:
            state: (*batch, n).
            input: (*batch, m).
        """
        features, input = self._features(state, input)
        g = self.log_noise.predict(features, input)
        variances = (g.mean + g.variance / 2).exp() @ self._selection
        return self._constant_noise + torch.diag_embed(variances)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """Predicts the next state with its noise.

        Args:
            state: (*batch, n).
            input: (*batch, m).
        """
        belief = call("model", self.model.predict, state, input)
        return Gaussian(belief.mean, belief.covariance + self.noise(state, input))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises f at K points (K, n), (K, m); covariances contain the noise."""
        inner = linearize(self.model, states, inputs, covariance)
        if inner.covariance is None:
            return inner
        features, inputs, _ = self._features.linearize(states, inputs)
        g = self.log_noise.linearize(features, inputs)
        assert g.covariance is not None
        log_variances = np.einsum("kii->ki", g.covariance)
        outputs = list(self.outputs)
        V = inner.covariance + to_array(self._constant_noise)
        V[:, outputs, outputs] += np.exp(g.mean + log_variances / 2)
        return inner._replace(covariance=V)

    @cached_property
    def _selection(self) -> Tensor:
        """Rows of the identity (k, n), one for each of the outputs."""
        identity = torch.eye(self.state_dim, dtype=self.dtype, device=self.device)
        return identity[list(self.outputs)]

    @cached_property
    def _constant_noise(self) -> Tensor:
        """Covariance of the model's noise without the outputs of g (n, n)."""
        is_constant = 1 - self._selection.sum(0)
        return is_constant[:, None] * self.model.noise_covariance * is_constant


def noise_features(model: DynamicsModel) -> Features:
    """Returns what a GP on the logarithm of a model's noise sees.

    It is all states and inputs, with the model's angles as sine and cosine.
    """
    return Features(
        states=list(range(model.state_dim)),
        inputs=list(range(model.input_dim)),
        angles=angles_of(model),
        state_dim=model.state_dim,
        input_dim=model.input_dim,
    )


def _check_outputs(outputs: Sequence[int], n: int) -> None:
    """Raises ``SettingError`` unless outputs are distinct indices of n states."""
    is_list = hasattr(outputs, "__len__") and len(outputs) > 0
    if not is_list or not all(type(i) is int for i in outputs):
        rule = "must be a list of whole numbers"
        raise SettingError("outputs", f"{rule}; got {outputs!r}")
    if len(set(outputs)) < len(outputs) or not set(outputs) <= set(range(n)):
        rule = f"must be distinct, of 0 .. {n - 1}"
        raise SettingError("outputs", f"{rule}; got {list(outputs)}")
