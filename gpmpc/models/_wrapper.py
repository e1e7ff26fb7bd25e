"""What models around another model have in common."""

from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array, DynamicsModel, Linearized, TensorModel, check_query, linearize, tensors_for
from gpmpc.gaussian import Gaussian


class Wrapper(TensorModel):
    """A model with the states, the inputs, the type and the device of the model that it holds."""

    model: DynamicsModel  #: the model that is wrapped
    _part = property(lambda self: self.model)

    @property
    def state_dim(self) -> int:
        """Number of states, n; with further ones where there are some."""
        return self.model.state_dim

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.model.input_dim

    @property
    def output_dim(self) -> int:
        """Number of outputs: the next state."""
        return self.state_dim


class LinearWrapper(Wrapper):
    """A model f whose further states are linear: z+ = [f(x, Z z + W u); 0] + L z + M u, x the first n entries of z."""

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Z (m, k), W (m, m), L (k, k) and M (k, m), for k states z."""
        raise NotImplementedError

    def to(self, device: Any = None, dtype: torch.dtype | None = None) -> Any:
        """Copies the model to another device or type."""
        own: Any = self
        parts = {field.name: getattr(own, field.name) for field in fields(own)}
        moved = {name: part.to(device=device, dtype=dtype) for name, part in parts.items() if isinstance(part, Tensor)}
        return replace(own, model=own.model.to(device, dtype), **moved)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at z (*batch, k) and u (*batch, m), without the noise."""
        check_query(self, state, input)
        n, (Z, W, L, M) = self.model.state_dim, tensors_for(self, *self.matrices)
        moved = self.model.predict(state[..., :n], state @ Z.mT + input @ W.mT)
        mean = torch.nn.functional.pad(moved.mean, (0, self.state_dim - n)) + state @ L.mT + input @ M.mT
        return Gaussian(mean, padded(moved.covariance, self.state_dim))

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises the model at K points (K, k), (K, m), by the inner model's ``linearize``."""
        n, K, (Z, W, L, M) = self.model.state_dim, len(states), self.matrices
        inner = linearize(self.model, np.ascontiguousarray(states[:, :n]), states @ Z.T + inputs @ W.T, covariance)
        mean, A, B = states @ L.T + inputs @ M.T, np.tile(L, (K, 1, 1)), np.tile(M, (K, 1, 1))
        mean[:, :n] += inner.mean
        A[:, :n] += inner.B @ Z
        A[:, :n, :n] += inner.A
        B[:, :n] += inner.B @ W
        more = self.state_dim - n
        V = None if inner.covariance is None else np.pad(inner.covariance, ((0, 0), (0, more), (0, more)))
        return Linearized(mean, A, B, V)


def padded(covariance: Tensor, size: int) -> Tensor:
    """A covariance (*batch, n, n) with zeros for further, certain variables (*batch, size, size)."""
    more = size - covariance.shape[-1]
    return torch.nn.functional.pad(covariance, (0, more, 0, more))
