"""States with earlier values, for models that remember."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gpmpc._arrays import names_of, read_array
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.exceptions import ShapeError, check_number
from gpmpc.gp import Transitions
from gpmpc.models._nominal import Affine
from gpmpc.signals import Signals


@explains_arguments
@dataclass(frozen=True)
class Lags:
    """The state (x_k, x_{k-1}, .., x_{k-p}, u_{k-1}, .., u_{k-q}) of such a model.

    It serves systems of which one measurement does not say where they go: a velocity
    that is not measured, an actuator's lag.

    Raises:
        SettingError: One of the numbers is no whole number of zero or more.

    >>> lags = Lags(state_dim=2, input_dim=1, states=2, inputs=1)

    See Also:
        ``DelayedModel``, of which inputs are late; ``LogModel``, of which actuators may
        be slow; ``gpmpc.logs.learn``, which chooses all of these for a log.
    """

    state_dim: int  #: n, of what is measured
    input_dim: int  #: m
    states: int = 1  #: p, how many earlier states are part of the state
    inputs: int = 0  #: q, how many earlier inputs are

    def __post_init__(self) -> None:
        check_number("state_dim", self.state_dim, least=1, whole=True)
        check_number("input_dim", self.input_dim, least=0, whole=True)
        check_number("states", self.states, least=0, whole=True)
        check_number("inputs", self.inputs, least=0, whole=True)

    @property
    def dim(self) -> int:
        """Number of states with the earlier values."""
        return self.state_dim * (1 + self.states) + self.input_dim * self.inputs

    @property
    def longest(self) -> int:
        """Number of rows at the start of a log that have no earlier values."""
        return max(self.states, self.inputs)

    @cached_property
    def nominal(self) -> Affine:
        """Nominal model for ``ResidualModel``: x stays as it is.

        Earlier values move on by a place.
        """
        n = self.state_dim
        m = self.input_dim
        first_input = n * (1 + self.states)  # index of u_{k-1}
        A = torch.zeros(self.dim, self.dim, dtype=torch.float64)
        B = torch.zeros(self.dim, m, dtype=torch.float64)
        A[:n, :n] = torch.eye(n)
        A[n:first_input, : first_input - n] = torch.eye(first_input - n)
        if self.inputs:
            second_input = first_input + m
            B[first_input:second_input] = torch.eye(m)
            shift = torch.eye(self.dim - second_input)
            A[second_input:, first_input : self.dim - m] = shift
        return Affine(A, B, torch.zeros(self.dim, dtype=torch.float64))

    @cached_property
    def B(self) -> Tensor:
        """Effect of the GP of ``ResidualModel`` (dim, n): it acts on x only."""
        return torch.eye(self.dim, self.state_dim, dtype=torch.float64)

    def augmented(self, states: Array, inputs: Array) -> Array:
        """Returns the states with their earlier values (T - l, dim) of a log.

        The first l = max(p, q) rows have no earlier values.

        Args:
            states: x_0 .. x_{T-1} (T, n).
            inputs: (T - 1 or T, m), each applied from the time of its row on.

        Raises:
            ShapeError: The two do not belong together, or hold too few rows.
        """
        states = read_array("states", states)
        inputs = read_array("inputs", inputs)
        self._check_shapes(states, inputs)
        T = len(states)
        columns = []
        for lag in range(self.states + 1):
            columns.append(states[self.longest - lag : T - lag])
        for lag in range(1, self.inputs + 1):
            columns.append(inputs[self.longest - lag : T - lag])
        return np.concatenate(columns, axis=1)

    def _check_shapes(self, states: Array, inputs: Array) -> None:
        """Raises ``ShapeError`` unless states and inputs are rows of one log."""
        T = len(states)
        fits_states = np.shape(states) == (T, self.state_dim)
        fits_inputs = np.shape(inputs) in [(T - 1, self.input_dim), (T, self.input_dim)]
        if fits_states and fits_inputs and self.longest < T:
            return
        rule = (
            f"states (T, {self.state_dim}) and inputs (T or T - 1, {self.input_dim}) "
            f"need T above {self.longest}"
        )
        raise ShapeError(f"{rule}; got {np.shape(states)} and {np.shape(inputs)}")

    def transitions(self, states: Array, inputs: Array) -> Transitions:
        """Returns the transitions of the state with earlier values.

        Args:
            states: Of one log at equal time steps; see ``augmented``.
            inputs: Likewise.
        """
        augmented = self.augmented(states, inputs)
        rows = slice(self.longest, len(states) - 1)
        applied = read_array("inputs", inputs)[rows]
        signals = self._signals(names_of(states), names_of(inputs))
        return Transitions(augmented[:-1], applied, augmented[1:], signals)

    def _signals(self, states: Sequence[str], inputs: Sequence[str]) -> Signals:
        """Names the state with earlier values, where all of its parts have names."""
        names = list(states)
        for lag in range(1, self.states + 1):
            names += [f"{name}[k-{lag}]" for name in states]
        for lag in range(1, self.inputs + 1):
            names += [f"{name}[k-{lag}]" for name in inputs]
        return Signals(names if len(names) == self.dim else (), inputs)
