"""Nominal models x+ = f0(x, u): an affine one, and one that is written in CasADi."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc.dynamics import Array, to_array
from gpmpc.exceptions import ShapeError, UnsupportedModel
from gpmpc.gaussian import check_tensors


@dataclass(frozen=True)
class Affine:
    """A nominal model x+ = A x + B u + c, through which uncertainty goes exactly.

    Attributes:
        A: (n, n).
        B: (n, m).
        c: (n,).

    Raises:
        ShapeError: The shapes do not belong together.
        SettingError: One of the three is no tensor.
    """

    A: Tensor
    B: Tensor
    c: Tensor

    def __post_init__(self) -> None:
        check_tensors(A=self.A, B=self.B, c=self.c)
        shapes = [tuple(part.shape) for part in (self.A, self.B, self.c)]
        n = len(self.A) if self.A.dim() else 0
        if shapes[0] != (n, n) or self.B.dim() != 2 or len(self.B) != n or shapes[2] != (n,):
            raise ShapeError(f"A, B and c must be (n, n), (n, m) and (n,); got {', '.join(map(str, shapes))}")

    def __call__(self, state: Tensor, input: Tensor) -> Tensor:
        """The nominal next state (*batch, n)."""
        return state @ self.A.mT + input @ self.B.mT + self.c

    def linearize(self, states: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """The nominal next states (K, n) and their constant derivatives (K, n, n) and (K, n, m)."""
        A, B, c = self._arrays
        K = len(states)
        return states @ A.T + inputs @ B.T + c, np.tile(A, (K, 1, 1)), np.tile(B, (K, 1, 1))

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array]:
        return to_array(self.A), to_array(self.B), to_array(self.c)


class CasadiNominal:
    """A nominal model that is a CasADi function, linearised by CasADi's derivatives for all points in one call.

    It is evaluated in double precision on the CPU, and torch cannot differentiate it.

    Args:
        function: From (state (n,), input (m,)) to the next state (n,).

    Raises:
        UnsupportedModel: The function has other arguments.
    """

    def __init__(self, function: Any):
        if (function.n_in(), function.n_out()) != (2, 1) or function.size1_in(0) != function.size1_out(0):
            raise UnsupportedModel(f"a nominal CasADi function maps (state, input) to the next state; got {function}")
        x, u, y = function.name_in(0), function.name_in(1), function.name_out(0)
        self.function = function
        self._expansion = function.factory("expansion", [x, u], [y, f"jac:{y}:{x}", f"jac:{y}:{u}"])
        self._mapped: dict[int, Any] = {}

    def __call__(self, state: Tensor, input: Tensor) -> Tensor:
        """The nominal next state (*batch, n)."""
        n, m = self.function.size1_in(0), self.function.size1_in(1)
        x, u = to_array(state).reshape(-1, n), to_array(input).reshape(-1, m)
        moved = self.function.map(len(x))(x.T, u.T).full().T
        return torch.as_tensor(moved, dtype=state.dtype, device=state.device).reshape(state.shape)

    def linearize(self, states: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """The nominal next states (K, n) and their derivatives (K, n, n) and (K, n, m)."""
        K, n = states.shape
        if K not in self._mapped:
            self._mapped[K] = self._expansion.map(K)
        mean, A, B = (part.full() for part in self._mapped[K](states.T, inputs.T))
        A, B = (part.reshape(n, K, -1).transpose(1, 0, 2) for part in (A, B))
        return np.ascontiguousarray(mean.T), np.ascontiguousarray(A), np.ascontiguousarray(B)
