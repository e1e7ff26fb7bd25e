"""Models of systems whose inputs act late, by a whole or a fractional number of steps.

The state of a delayed model holds the inputs that are on their way, z = (x, u_{k-D}, .., u_{k-1}), D the delay rounded
up. With a delay of D - 1 + w steps, 0 < w <= 1, the input that acts within step k changes from u_{k-D} to u_{k-D+1}
after the part w of it, and the model takes their mean over the step, exact to first order in the time step:

    x[k+1] = f(x[k], w u_{k-D} + (1 - w) u_{k-D+1}),    the other inputs move on by a place

(Franklin, Powell and Workman, 1998, section 4.3, for linear systems.) A controller plans with the delayed model itself,
or, with fewer states, with the undelayed one from where the inputs on their way will have led (``DelayedModel.ahead``;
the prediction of Smith, 1957, in state space).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.dynamics import Array, DynamicsModel, Linearized, check_next_states, check_query, linearize
from gpmpc.exceptions import ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.models._wrapper import Wrapper, padded


@dataclass(frozen=True)
class DelayedModel(Wrapper):
    """A model whose input acts late.

    Attributes:
        model: Without the delay, of n states and m inputs.
        delay: In steps, more than zero; a fraction is allowed.

    Raises:
        SettingError: The delay is no positive number, or the model does not predict next states.
    """

    model: DynamicsModel
    delay: float

    def __post_init__(self) -> None:
        check_number("delay", self.delay, above=0, unit="[steps]")
        check_next_states(self.model)

    @property
    def pending(self) -> int:
        """Number of inputs on their way, D: the delay rounded up."""
        return math.ceil(self.delay)

    @property
    def state_dim(self) -> int:
        """Number of states, n + D m."""
        return self.model.state_dim + self.pending * self.model.input_dim

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations; inputs on their way have none."""
        return padded(self.model.noise_covariance, self.state_dim)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at z (*batch, n + D m) and u (*batch, m)."""
        check_query(self, state, input)
        n, m, w = self.model.state_dim, self.input_dim, self._share
        queue = torch.cat([state[..., n:], input], dim=-1)
        acting = w * queue[..., :m] + (1 - w) * queue[..., m : 2 * m]
        moved = self.model.predict(state[..., :n], acting)
        mean = torch.cat([moved.mean, queue[..., m:]], dim=-1)
        return Gaussian(mean, padded(moved.covariance, self.state_dim))

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises the model at K points, by the undelayed model's ``linearize``."""
        n, m, w, size = self.model.state_dim, self.input_dim, self._share, self.state_dim
        queue = np.concatenate([states[:, n:], inputs], axis=1)
        acting = w * queue[:, :m] + (1 - w) * queue[:, m : 2 * m]
        inner = linearize(self.model, np.ascontiguousarray(states[:, :n]), acting, covariance)
        by_queue = np.zeros((len(states), size, (self.pending + 1) * m))
        by_queue[:, :n, :m] = w * inner.B
        by_queue[:, :n, m : 2 * m] = (1 - w) * inner.B
        by_queue[:, n:, m:] = np.eye(self.pending * m)
        A = np.concatenate([np.zeros((len(states), size, n)), by_queue[:, :, :-m]], axis=2)
        A[:, :n, :n] = inner.A
        mean = np.concatenate([inner.mean, queue[:, m:]], axis=1)
        V = None if inner.covariance is None else _padded_array(inner.covariance, size)
        return Linearized(mean, A, np.ascontiguousarray(by_queue[:, :, -m:]), V)

    def augmented(self, belief: Gaussian, inputs: Any) -> Gaussian:
        """The belief over z, from one over x and the inputs on their way.

        Args:
            belief: Over x: mean (*batch, n).
            inputs: u_{k-D} .. u_{k-1} (D, m), the oldest first.

        Raises:
            ShapeError: Another number of inputs.
        """
        queue = self._queue(belief, inputs).flatten(-2).expand(*belief.mean.shape[:-1], self.pending * self.input_dim)
        return Gaussian(torch.cat([belief.mean, queue], dim=-1), padded(belief.covariance, self.state_dim))

    @cached_property
    def remaining(self) -> DynamicsModel:
        """The model to plan with from where ``ahead`` leads: without a delay, or with the fraction of a step."""
        return self.model if self._share == 1 else DelayedModel(self.model, self._share)

    @property
    def lead(self) -> int:
        """By how many steps ``ahead`` looks ahead; a reference begins as much later."""
        return self.pending if self._share == 1 else self.pending - 1

    def ahead(self, propagator: Any, belief: Gaussian, inputs: Any) -> Gaussian:
        """The belief over the state of ``remaining`` after the inputs that are on their way.

        Args:
            propagator: How the belief moves, with the process noise or without.
            belief: Over x now.
            inputs: u_{k-D} .. u_{k-1} (D, m), the oldest first.

        Raises:
            ShapeError: Another number of inputs.
        """
        queue, w = self._queue(belief, inputs), self._share
        for k in range(self.lead):
            acting = queue[k] if w == 1 else w * queue[k] + (1 - w) * queue[k + 1]
            belief = propagator(self.model, belief, acting)
        return belief if w == 1 else DelayedModel(self.model, w).augmented(belief, queue[-1:])

    def to(self, device: Any = None, dtype: torch.dtype | None = None) -> "DelayedModel":
        """Copies the model to another device or type."""
        inner: Any = self.model
        return DelayedModel(inner.to(device, dtype), self.delay)

    @property
    def _share(self) -> float:
        """The part of a step w in which the older of two inputs acts."""
        return self.delay - (self.pending - 1)

    def _queue(self, belief: Gaussian, inputs: Any) -> Tensor:
        given = np.asarray(inputs) if not isinstance(inputs, Tensor) else inputs
        queue = torch.as_tensor(given, dtype=belief.mean.dtype, device=belief.mean.device)
        if queue.shape != (self.pending, self.input_dim):
            raise ShapeError(
                f"a delay of {self.delay:g} steps needs the last inputs ({self.pending}, {self.input_dim}), the oldest "
                f"first; got {tuple(queue.shape)}"
            )
        return queue


def _padded_array(covariance: Array, size: int) -> Array:
    whole, n = np.zeros((len(covariance), size, size)), covariance.shape[-1]
    whole[:, :n, :n] = covariance
    return whole
