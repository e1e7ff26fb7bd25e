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

from gpmpc._dynamics import Array, DynamicsModel, check_next_states
from gpmpc.exceptions import ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.models._wrapper import LinearWrapper, padded


@dataclass(frozen=True)
class DelayedModel(LinearWrapper):
    """A model whose input acts late.

    Raises:
        SettingError: The delay is no positive number, or the model does not predict next states.
    """

    model: DynamicsModel  #: without the delay, of n states and m inputs
    delay: float  #: in steps, more than zero; a fraction is allowed

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

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Of ``LinearWrapper``: a mean of the two oldest inputs acts, and the others move on by a place."""
        (n, m), D, w = (self.model.state_dim, self.input_dim), self.pending, self._share
        every = np.eye((D + 1) * m)  # of the inputs on their way and the one before them
        acting, moved = w * every[:m] + (1 - w) * every[m : 2 * m], np.vstack([np.zeros((n, len(every))), every[m:]])
        Z, L = (np.hstack([np.zeros((len(part), n)), part[:, : D * m]]) for part in (acting, moved))
        return Z, acting[:, D * m :], L, moved[:, D * m :]

    def augmented(self, belief: Gaussian, inputs: Any) -> Gaussian:
        """The belief over z, from one over x (*batch, n) and the inputs u_{k-D} .. u_{k-1} (D, m), the oldest first.

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
        """The belief over the state of ``remaining`` after the inputs u_{k-D} .. u_{k-1} (D, m), the oldest first.

        The propagator moves the belief over x, which is that of now, with the process noise or without.

        Raises:
            ShapeError: Another number of inputs.
        """
        queue, w = self._queue(belief, inputs), self._share
        for k in range(self.lead):
            acting = queue[k] if w == 1 else w * queue[k] + (1 - w) * queue[k + 1]
            belief = propagator(self.model, belief, acting)
        return belief if w == 1 else DelayedModel(self.model, w).augmented(belief, queue[-1:])

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
