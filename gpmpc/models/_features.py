"""Features that a GP sees of a state and an input: selected columns, angles as sine and cosine, and lagged values."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc._arrays import names_of, read_array
from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError, ShapeError, check_number
from gpmpc.gp import Transitions
from gpmpc.models._nominal import Affine
from gpmpc.signals import Signals


@dataclass(frozen=True)
class Features:
    """Maps a state and an input to what a GP sees of them.

    Leaving a column out makes a model invariant to it; the sine and cosine of an angle make it periodic.

    Raises:
        SettingError: An index is out of range or stands there twice, or an angle is not selected.
    """

    states: Sequence[int]  #: selected states, in the order of the features
    inputs: Sequence[int]  #: selected inputs
    angles: Sequence[
        int
    ]  #: those of the selected states that are seen as (sine, cosine), at their place
    state_dim: int  #: n, of the state they are selected from
    input_dim: int  #: m

    def __post_init__(self) -> None:
        for key in ("states", "inputs", "angles"):
            indices = getattr(self, key)
            count = self.input_dim if key == "inputs" else self.state_dim
            whole = all(isinstance(i, int) and not isinstance(i, bool) for i in indices)
            if (
                not whole
                or any(not 0 <= i < count for i in indices)
                or len(set(indices)) != len(indices)
            ):
                raise SettingError(
                    key,
                    f"must be different indices from 0 to {count - 1}; got {list(indices)}",
                )
        if not set(self.angles) <= set(self.states):
            raise SettingError(
                "angles",
                f"must be some of the selected states {list(self.states)}; got {self.angles}",
            )

    @property
    def dim(self) -> int:
        """Number of features of the state, d."""
        return len(self.states) + len(self.angles)

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """The state that each feature is a function of (d,)."""
        return np.array(
            [i for i in self.states for _ in range(1 + (i in self.angles))],
            dtype=np.intp,
        )

    @cached_property
    def sines(self) -> NDArray[np.intp]:
        """Where the sines stand among the features, each before its cosine (a,)."""
        first = np.diff(self.columns, prepend=-1) != 0
        return np.flatnonzero(first & np.isin(self.columns, self.angles))

    @cached_property
    def _selected(self) -> NDArray[np.intp]:
        """The selected inputs (m_s,)."""
        return np.array(self.inputs, dtype=np.intp)

    @cached_property
    def _by_column(self) -> Array:
        """One in the column of each feature's state (d, n)."""
        return np.eye(self.state_dim)[self.columns]

    def __call__(self, state: Tensor, input: Tensor) -> tuple[Tensor, Tensor]:
        """The features (*batch, d) of a state (*batch, n), and the selected inputs (*batch, m_s)."""
        z = state[..., self.columns.tolist()]
        selected = input[..., list(self.inputs)]
        sines = self.sines.tolist()
        if not sines:
            return z, selected
        parts = [
            part.sin() if k in sines else part.cos() if k - 1 in sines else part
            for k, part in enumerate(z.unbind(-1))
        ]
        return torch.stack(parts, dim=-1), selected

    def linearize(
        self, states: Array, inputs: Array
    ) -> tuple[Array, Array, Array | None]:
        """Features (K, d), selected inputs (K, m_s), each feature's derivative (K, d) by its state, None for one."""
        z = states[:, self.columns]
        v = inputs[:, self._selected]
        sines = self.sines
        if not self.angles:
            return z, v, None
        sine = np.sin(z[:, sines])
        cosine = np.cos(z[:, sines])
        slope = np.ones_like(z)
        z[:, sines] = sine
        z[:, sines + 1] = cosine
        slope[:, sines] = cosine
        slope[:, sines + 1] = -sine
        return z, v, slope

    def chain(
        self, by_features: Array, by_inputs: Array, slope: Array | None
    ) -> tuple[Array, Array]:
        """Turns derivatives (K, k, d), (K, k, m_s) by features and selected inputs into those by x and u."""
        if slope is not None:
            by_features = by_features * slope[:, None, :]
        by_input = np.zeros((*by_inputs.shape[:-1], self.input_dim))
        by_input[..., self._selected] = by_inputs
        return by_features @ self._by_column, by_input


@dataclass(frozen=True)
class Lags:
    """The state of a model that remembers: (x_k, x_{k-1}, .., x_{k-p}, u_{k-1}, .., u_{k-q}).

    For systems of which one measurement does not say where they go: a velocity that is not measured, an actuator's lag.

    Raises:
        SettingError: One of them is no whole number of zero or more.
    """

    state_dim: int  #: n, of what is measured
    input_dim: int  #: m
    states: int = 1  #: p, how many earlier states are part of the state
    inputs: int = 0  #: q, how many earlier inputs are

    def __post_init__(self) -> None:
        for key, least in (
            ("state_dim", 1),
            ("input_dim", 0),
            ("states", 0),
            ("inputs", 0),
        ):
            check_number(key, getattr(self, key), least=least, whole=True)

    @property
    def dim(self) -> int:
        """Number of states with the earlier values."""
        return self.state_dim * (1 + self.states) + self.input_dim * self.inputs

    @cached_property
    def nominal(self) -> Affine:
        """The nominal model for ``ResidualModel``: x stays where it is, and earlier values move on by a place."""
        n = self.state_dim
        m = self.input_dim
        first = self.state_dim * (1 + self.states)
        A = torch.zeros(self.dim, self.dim, dtype=torch.float64)
        B = torch.zeros(self.dim, m, dtype=torch.float64)
        A[:n, :n] = torch.eye(n)
        A[n:first, : first - n] = torch.eye(first - n)
        if self.inputs:
            B[first : first + m] = torch.eye(m)
            A[first + m :, first : self.dim - m] = torch.eye(self.dim - first - m)
        return Affine(A, B, torch.zeros(self.dim, dtype=torch.float64))

    @cached_property
    def B(self) -> Tensor:
        """Where what is learned acts (dim, n): on x only."""
        return torch.eye(self.dim, self.state_dim, dtype=torch.float64)

    def augmented(self, states: Array, inputs: Array) -> Array:
        """States with their earlier values (T - l, dim) of a log; l = max(p, q) rows at its start have none.

        Of states x_0 .. x_{T-1} (T, n) and inputs (T - 1 or T, m), each applied from the time of its row on;
        ``ShapeError`` where the two do not belong together, or hold too few rows.
        """
        states = read_array("states", states)
        inputs = read_array("inputs", inputs)
        T = len(states)
        first = max(self.states, self.inputs)
        found = (np.shape(states), np.shape(inputs))
        shapes = [(k, self.input_dim) for k in (T - 1, T)]
        if found[0] != (T, self.state_dim) or found[1] not in shapes or first >= T:
            what = f"states (T, {self.state_dim}) and inputs (T or T - 1, {self.input_dim}) need T above {first}"
            raise ShapeError(f"{what}; got {found[0]} and {found[1]}")
        before = [states[first - lag : T - lag] for lag in range(self.states + 1)]
        before += [inputs[first - lag : T - lag] for lag in range(1, self.inputs + 1)]
        return np.concatenate(before, axis=1)

    def transitions(self, states: Array, inputs: Array) -> Transitions:
        """Transitions of the state with earlier values, from one log at equal time steps; see ``augmented``."""
        whole = self.augmented(states, inputs)
        first = max(self.states, self.inputs)
        applied = read_array("inputs", inputs)[first : len(states) - 1]
        signals = self._signals(names_of(states), names_of(inputs))
        return Transitions(whole[:-1], applied, whole[1:], signals)

    def _signals(self, states: Sequence[str], inputs: Sequence[str]) -> Signals:
        """The names of the state with earlier values, where all of its parts have some."""
        names = list(states)
        for lag in range(1, self.states + 1):
            names += [f"{name}[k-{lag}]" for name in states]
        for lag in range(1, self.inputs + 1):
            names += [f"{name}[k-{lag}]" for name in inputs]
        return Signals(names if len(names) == self.dim else (), inputs)
