"""Measurement models: what sensors show of a state, y = h(x) + v with v ~ N(0, R).

A measurement is a ``DynamicsModel`` without inputs whose outputs are what is measured, so every propagator gives its
moments: E[y], Cov[y] and Cov[x, y].
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array, Linearized, check_query
from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.models._nominal import linearize_function


@dataclass(frozen=True)
class Measurement:
    """A measurement model that is a function of the state.

    Raises:
        ShapeError: R is not square.
        SettingError: R is no tensor, or an angle is no entry of y.
    """

    state_dim: int  #: n, of the state
    noise_covariance: Tensor  #: R (p, p)
    function: Callable[[Tensor], Tensor]  #: h, from x (*batch, n) to y (*batch, p), in torch
    angles: Sequence[int] = ()  #: entries of y that are angles [rad]: their differences are wrapped to (-pi, pi]

    def __post_init__(self) -> None:
        check_number("state_dim", self.state_dim, least=1, whole=True)
        check_tensors(noise_covariance=self.noise_covariance)
        R = self.noise_covariance
        if R.dim() != 2 or len(R) != R.shape[1]:
            raise ShapeError(f"noise_covariance must be (p, p); got {tuple(R.shape)}")
        if not callable(self.function):
            raise SettingError("function", f"must be a function of the state; got {self.function!r}")
        if any(not 0 <= i < len(R) for i in self.angles):
            raise SettingError("angles", f"must be entries of y from 0 to {len(R) - 1}; got {list(self.angles)}")

    @classmethod
    def of_states(
        cls, state_dim: int, states: Sequence[int], std: Sequence[float], angles: Sequence[int] = ()
    ) -> "Measurement":
        """A measurement of some states, each with its own noise.

        Args:
            state_dim: n.
            states: Which are measured.
            std: Standard deviations of the noise, one a measured state.
            angles: Those of the measured states that sensors show modulo one turn, by their place among them.

        Raises:
            SettingError: A state is out of range, or a standard deviation is negative.
        """
        if any(not 0 <= i < state_dim for i in states) or not len(states):
            raise SettingError("states", f"must be indices from 0 to {state_dim - 1}; got {list(states)}")
        for value in std:
            check_number("std", value, least=0)
        if len(std) != len(states):
            raise SettingError("std", f"must be a number a measured state ({len(states)}); got {list(std)}")
        R = torch.diag(torch.tensor(list(std), dtype=torch.float64) ** 2)
        return cls(state_dim, R, _Selection(states, state_dim), angles)

    @property
    def input_dim(self) -> int:
        """Zero: a measurement depends on the state."""
        return 0

    @property
    def output_dim(self) -> int:
        """Number of measured values, p."""
        return len(self.noise_covariance)

    @property
    def dtype(self) -> torch.dtype:
        """Of the noise."""
        return self.noise_covariance.dtype

    @property
    def device(self) -> torch.device:
        """Of the noise."""
        return self.noise_covariance.device

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """What is measured at a certain state (*batch, p), without the noise."""
        check_query(self, state, state[..., :0] if input is None else input)
        value = self.function(state)
        if not isinstance(value, Tensor) or value.shape != (*state.shape[:-1], self.output_dim):
            got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise ShapeError(
                f"the measurement must give (*batch, {self.output_dim}) at {tuple(state.shape)}; got {got}"
            )
        return Gaussian(value, value.new_zeros(*value.shape, self.output_dim))

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises h at K points (K, n); ``inputs`` is (K, 0)."""
        value, A = linearize_function(self.function, self, states)
        K, p = value.shape
        return Linearized(value, A, np.zeros((K, p, 0)), np.zeros((K, p, p)) if covariance else None)


class _Selection:
    """h(x) = x[states], with its expansion."""

    def __init__(self, states: Sequence[int], state_dim: int):
        self.states, self.matrix = list(states), np.zeros((len(states), state_dim))
        self.matrix[range(len(states)), self.states] = 1.0

    def __call__(self, state: Tensor) -> Tensor:
        return state[..., self.states]

    def linearize(self, states: Array) -> tuple[Array, Array]:
        return np.ascontiguousarray(states[:, self.states]), np.tile(self.matrix, (len(states), 1, 1))
