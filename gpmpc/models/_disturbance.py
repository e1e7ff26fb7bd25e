"""Disturbance states: what a model does not explain, as part of the state that a filter estimates and a plan predicts.

    x[k+1] = f(x[k], u[k]) + E d[k],     d[k+1] = Phi d[k] + w[k],     w[k] ~ N(0, diag(q)^2)

With Phi = I a disturbance is constant until something says otherwise (a random walk), as for a changed mass; with
|Phi| < 1 it is an AR(1) process that fades, as wind does. Estimated beside the state by a Kalman filter and predicted
with it, it leaves no offset between reference and state (Pannocchia and Rawlings, 2003), and its uncertainty is part of
the tube. For a rigid body, columns of E of the velocities are a force over the mass, those of the rates a torque.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array, DynamicsModel, check_next_states, to_array
from gpmpc.exceptions import SettingError, ShapeError, check_numbers
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.models._wrapper import LinearWrapper, padded


@dataclass(frozen=True)
class DisturbedModel(LinearWrapper):
    """A model with disturbances as further states, (x, d).

    Raises:
        ShapeError: E has another number of rows than the model has states.
        SettingError: A standard deviation is negative, a decay not between -1 and 1, or the model does not predict next
            states.
    """

    model: DynamicsModel  #: without them, of n states
    effect: Tensor  #: E, by how much each moves the states within a step (n, q), in the model's type
    std: Sequence[float]  #: standard deviations of w, by how much each changes from step to step (q,)
    #: diagonal of Phi (q,): 1 for a constant, less than 1 in size for an AR(1) process
    decay: Sequence[float] | None = None

    def __post_init__(self) -> None:
        check_next_states(self.model)
        check_tensors(effect=self.effect)
        n, model = self.model.state_dim, self.model
        if self.effect.dim() != 2 or len(self.effect) != n:
            raise ShapeError(f"effect must be ({n}, q), a row a state; got {tuple(self.effect.shape)}")
        if self.effect.dtype != model.dtype or self.effect.device != model.device:
            got = f"{self.effect.dtype} on {self.effect.device}"
            raise SettingError("effect", f"must be {model.dtype} on {model.device} like the model; got {got}")
        check_numbers("std", self.std, self.disturbances, least=0)
        if self.decay is None:
            object.__setattr__(self, "decay", [1.0] * self.disturbances)
        check_numbers("decay", self._decays, self.disturbances)
        if any(abs(phi) > 1 for phi in self._decays):
            raise SettingError("decay", f"must lie between -1 and 1; got {list(self._decays)}")

    @property
    def disturbances(self) -> int:
        """Number of disturbances, q."""
        return self.effect.shape[1]

    @property
    def state_dim(self) -> int:
        """Number of states, n + q."""
        return self.model.state_dim + self.disturbances

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations, and of the disturbances' changes."""
        own = torch.as_tensor(list(self.std), dtype=self.dtype, device=self.device).square()
        return torch.block_diag(self.model.noise_covariance, torch.diag(own))

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Of ``LinearWrapper``: E d is added to f(x, u), and d moves on by Phi."""
        n, k, m = self.model.state_dim, self.state_dim, self.input_dim
        L = np.zeros((k, k))
        L[:n, n:], L[n:, n:] = to_array(self.effect), np.diag(self._decays)
        return np.zeros((m, k)), np.eye(m), L, np.zeros((k, m))

    def augmented(self, belief: Gaussian, std: Sequence[float] | None = None) -> Gaussian:
        """The belief over (x, d), from one over x (*batch, n), before anything was estimated: d is zero, independent.

        Prior standard deviations of d (q,) are by default those that an AR(1) process has in the long run. A constant
        has none: without them it raises ``SettingError``.
        """
        if std is None:
            if any(abs(phi) == 1 for phi in self._decays):
                raise SettingError("std", "must be given for disturbances with decay 1; got None")
            std = [q / (1 - phi**2) ** 0.5 for q, phi in zip(self.std, self._decays, strict=True)]
        check_numbers("std", std, self.disturbances, least=0)
        zero = belief.mean.new_zeros(*belief.mean.shape[:-1], self.disturbances)
        covariance = padded(belief.covariance, self.state_dim)
        own = torch.as_tensor([0.0] * self.model.state_dim + list(std), dtype=self.dtype, device=self.device).square()
        return Gaussian(torch.cat([belief.mean, zero], dim=-1), covariance + torch.diag(own))

    @property
    def _decays(self) -> Sequence[float]:
        return self.decay or ()
