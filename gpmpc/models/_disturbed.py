"""Models with disturbances as states."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel, check_next_states, to_array
from gpmpc.exceptions import SettingError, ShapeError, check_numbers
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.models._tensors import check_like
from gpmpc.models._wrapper import LinearPart, LinearWrapper
from gpmpc.signals import signals_of


@explains_arguments
@dataclass(frozen=True, eq=False)
class DisturbedModel(LinearWrapper):
    """A model with disturbances as further states (x, d) that a filter estimates.

        x[k+1] = f(x[k], u[k]) + E d[k],
        d[k+1] = Phi d[k] + w[k],     w[k] ~ N(0, diag(q)^2)

    A disturbance is what the model does not explain. With Phi = I it is constant until
    something says otherwise (a random walk), as for a changed mass; with |Phi| < 1 it
    is an AR(1) process that fades, as wind does. Predicted with the state it leaves no
    offset from a reference (Pannocchia and Rawlings, 2003), and its uncertainty is part
    of the tube. For a rigid body, columns of E of the velocities are a force over the
    mass, those of the rates a torque. Of a model with a past, such as a
    ``DelayedModel``, the filter estimates the past as well: a loop keeps it no longer.

    Raises:
        ShapeError: E has another number of rows than the model has states.
        SettingError: A standard deviation is negative, a decay not between -1 and 1, or
            the model does not predict next states.

    See Also:
        ``gpmpc.estimation.KalmanFilter``, which estimates the disturbances.
    """

    model: DynamicsModel  #: without them, of n states
    #: E, by how much each moves the states within a step (n, q), in the model's type
    effect: Tensor
    #: standard deviations of w, by how much each changes from step to step (q,)
    std: Sequence[float]
    #: diagonal of Phi (q,): by default 1, a constant; less in size for an AR(1) process
    decay: Sequence[float] = ()

    def __post_init__(self) -> None:
        n, _ = check_next_states(self.model)
        check_tensors(effect=self.effect)
        if self.effect.dim() != 2 or len(self.effect) != n:
            got = tuple(self.effect.shape)
            raise ShapeError(f"effect must be ({n}, q), a row a state; got {got}")
        check_like("effect", self.effect, self.model)
        q = self.effect.shape[1]
        check_numbers("std", self.std, q, least=0)
        if hasattr(self.decay, "__len__") and not len(self.decay):
            object.__setattr__(self, "decay", [1.0] * q)
        check_numbers("decay", self.decay, q)
        object.__setattr__(self, "decay", list(self.decay))
        if any(abs(phi) > 1 for phi in self.decay):
            raise SettingError("decay", f"must lie between -1 and 1; got {self.decay}")

    @property
    def state_dim(self) -> int:
        """Number of states, n + q."""
        return self.model.state_dim + self.effect.shape[1]

    @property
    def _further_names(self) -> list[str]:
        """Names of the disturbances."""
        return [f"disturbance{i + 1}" for i in range(self.effect.shape[1])]

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance of the model's noise, and of the disturbances' changes."""
        changes = self._diagonal_covariance(self.std)
        return torch.block_diag(self.model.noise_covariance, changes)

    @cached_property
    def linear_part(self) -> LinearPart:
        """Matrices by which E d is added to f(x, u), and d moves on by Phi."""
        n = self.model.state_dim
        k = self.state_dim
        m = self.input_dim
        L = np.zeros((k, k))
        L[:n, n:] = to_array(self.effect)
        L[n:, n:] = np.diag(self.decay)
        return LinearPart(Z=np.zeros((m, k)), W=np.eye(m), L=L, M=np.zeros((k, m)))

    def augmented(self, belief: Gaussian, std: Sequence[float]) -> Gaussian:
        """Returns the belief over (x, d) before anything was estimated.

        d is zero and independent of x.

        Args:
            belief: Over x (*batch, n).
            std: Prior standard deviations of d (q,).
        """
        q = self.effect.shape[1]
        check_numbers("std", std, q, least=0)
        belief = belief.in_order(signals_of(self.model).state_names)
        prior = self._diagonal_covariance([0.0] * self.model.state_dim + list(std))
        covariance = self._padded(belief.covariance) + prior
        return Gaussian(pad(belief.mean, (0, q)), covariance)

    def _diagonal_covariance(self, std: Sequence[float]) -> Tensor:
        """Returns the covariance of independent entries with standard deviations."""
        deviations = torch.as_tensor(list(std), dtype=self.dtype, device=self.device)
        return torch.diag(deviations.square())
