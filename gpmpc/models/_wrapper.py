"""Models around another model, whose further states are linear."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from torch import Tensor
from torch.nn.functional import pad

from gpmpc._angles import angles_of
from gpmpc._dynamics import (
    Array,
    DynamicsModel,
    Linearized,
    TensorModel,
    check_query,
    linearize,
    tensors_for,
)
from gpmpc._functions import call
from gpmpc.gaussian import Gaussian
from gpmpc.models._tensors import move
from gpmpc.signals import Signals, signals_of


class Wrapper(TensorModel):
    """A model around another one, whose inputs, type and device it has.

    Its state begins with that of the other model.
    """

    model: DynamicsModel  #: the model that is wrapped
    _part = property(lambda self: self.model)

    @property
    def state_dim(self) -> int:
        """Number of states, those of the model and further ones."""
        return self.model.state_dim

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.model.input_dim

    @property
    def output_dim(self) -> int:
        """Number of outputs: the next state."""
        return self.state_dim

    @property
    def angles(self) -> Sequence[int]:
        """Indices of the states that are angles: those of the model."""
        return angles_of(self.model)

    @property
    def signals(self) -> Signals:
        """Names and time step, where the model knows them, with further states.

        Of a model that names no more than the first of its states, these names alone.
        """
        inner = signals_of(self.model)
        further_names = self._further_names
        names_all = len(inner.state_names) == self.model.state_dim
        if not further_names or not names_all:
            return inner
        names = (*inner.state_names, *further_names)
        are_distinct = len(set(names)) == len(names)  # not so of a delay around a delay
        return replace(inner, state_names=names if are_distinct else ())

    @property
    def _further_names(self) -> list[str]:
        """Names of the states beyond those of the model."""
        return []


class LinearPart(NamedTuple):
    """The matrices of a ``LinearWrapper`` of k states z and m inputs u.

    z+ = [f(x, Z z + W u); 0] + L z + M u, where f is the model inside.
    """

    Z: Array  # what f takes as input, by z (m, k)
    W: Array  # likewise by u (m, m)
    L: Array  # what is added to f, by z (k, k)
    M: Array  # likewise by u (k, m)


class LinearWrapper(Wrapper):
    """A model around a model f, linear but for f.

        z+ = [f(x, Z z + W u); 0] + L z + M u,     x the first n of k entries of z

    A delay is of this form, and so are disturbances as states.
    """

    to = move

    @cached_property
    def linear_part(self) -> LinearPart:
        """The matrices Z, W, L and M."""
        raise NotImplementedError

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """Predicts the next state, without the noise.

        Args:
            state: z (*batch, k).
            input: u (*batch, m).
        """
        check_query(self, state, input)
        n = self.model.state_dim
        Z, W, L, M = tensors_for(self, *self.linear_part)
        # What is added to its mean has a derivative also where torch lost the mean's.
        inner = call(
            "model", self.model.predict, state[..., :n], state @ Z.mT + input @ W.mT
        )
        further = self.state_dim - n
        mean = pad(inner.mean, (0, further)) + state @ L.mT + input @ M.mT
        return Gaussian(mean, self._padded(inner.covariance))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the model at K points, by the inner model's ``linearize``.

        Args:
            states: z (K, k).
            inputs: u (K, m).
            covariance: Whether the covariances at the points are computed.
        """
        n = self.model.state_dim
        K = len(states)
        Z, W, L, M = self.linear_part
        inner_states = np.ascontiguousarray(states[:, :n])
        inner_inputs = states @ Z.T + inputs @ W.T
        inner = linearize(self.model, inner_states, inner_inputs, covariance)
        mean = states @ L.T + inputs @ M.T
        A = np.tile(L, (K, 1, 1))
        B = np.tile(M, (K, 1, 1))
        mean[:, :n] += inner.mean
        A[:, :n] += inner.B @ Z
        A[:, :n, :n] += inner.A
        B[:, :n] += inner.B @ W
        V = None
        if inner.covariance is not None:
            further = self.state_dim - n
            V = np.pad(inner.covariance, ((0, 0), (0, further), (0, further)))
        return Linearized(mean, A, B, V)

    def _padded(self, covariance: Tensor) -> Tensor:
        """Pads a covariance (*batch, n, n) with zeros for the further states."""
        further = self.state_dim - covariance.shape[-1]
        return pad(covariance, (0, further, 0, further))
