"""Known models x+ = f0(x, u): an affine one, functions that are written in CasADi, and any of them without a GP."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import (
    Array,
    Linearized,
    batched_jacobian,
    check_query,
    tensors_for,
    to_array,
)
from gpmpc._functions import call
from gpmpc.exceptions import ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.signals import UNKNOWN, Signals


@dataclass(frozen=True)
class Affine:
    """A nominal model x+ = A x + B u + c, through which uncertainty goes exactly.

    Raises:
        ShapeError: The shapes do not belong together.
        SettingError: One of the three is no tensor.
    """

    A: Tensor  #: (n, n)
    B: Tensor  #: (n, m)
    c: Tensor  #: (n,)

    def __post_init__(self) -> None:
        check_tensors(A=self.A, B=self.B, c=self.c)
        shapes = [tuple(part.shape) for part in (self.A, self.B, self.c)]
        n = self.c.numel()
        if shapes != [(n, n), (n, *shapes[1][1:2]), (n,)] or self.B.dim() != 2:
            raise ShapeError(
                f"A, B and c must be (n, n), (n, m) and (n,); got {', '.join(map(str, shapes))}"
            )

    @classmethod
    def identity(cls, state_dim: int, input_dim: int) -> "Affine":
        """The model x+ = x, whose residual is the difference of two states."""
        n = state_dim
        m = input_dim
        dtype = torch.float64
        return cls(
            torch.eye(n, dtype=dtype),
            torch.zeros(n, m, dtype=dtype),
            torch.zeros(n, dtype=dtype),
        )

    def __call__(self, state: Tensor, input: Tensor) -> Tensor:
        """The nominal next state (*batch, n)."""
        return state @ self.A.mT + input @ self.B.mT + self.c

    def linearize(self, states: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """The nominal next states (K, n) and their constant derivatives (K, n, n) and (K, n, m)."""
        (A, B, c), K = self._arrays, len(states)
        return (
            states @ A.T + inputs @ B.T + c,
            np.tile(A, (K, 1, 1)),
            np.tile(B, (K, 1, 1)),
        )

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array]:
        return to_array(self.A), to_array(self.B), to_array(self.c)


@dataclass(frozen=True)
class KnownModel:
    """A known function x+ = f0(x, u) as a model without uncertainty."""

    #: f0, from x (*batch, n) and u (*batch, m) to (*batch, n), such as ``CasadiFunction``
    function: Callable[[Tensor, Tensor], Tensor]
    state_dim: int  #: n
    input_dim: int  #: m
    signals: Signals = UNKNOWN  #: names and time step, where they are known

    dtype = torch.float64
    device = torch.device("cpu")

    @property
    def tape(self) -> Any:
        """The function as a tape of compiled loops; None where it has none."""
        return getattr(self.function, "tape", None)

    @property
    def output_dim(self) -> int:
        """Number of outputs, n: the next state."""
        return self.state_dim

    @property
    def noise_covariance(self) -> Tensor:
        """Zero (n, n)."""
        return torch.zeros(self.state_dim, self.state_dim, dtype=self.dtype)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state (*batch, n), with zero covariance."""
        check_query(self, state, input)
        mean = call("function", self.function, state, input)
        return Gaussian(mean, mean.new_zeros(*mean.shape, self.state_dim))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the function at K points (K, n), (K, m)."""
        function = self.function
        if not hasattr(function, "linearize"):
            function = partial(call, "function", function)
        mean, A, B = linearize_function(function, self, states, inputs)
        return Linearized(
            mean, A, B, np.zeros((*mean.shape, self.state_dim)) if covariance else None
        )


class CasadiFunction:
    """A function that is written in CasADi, linearised at all points in one call.

    Its operations are read once and run by compiled loops (``gpmpc._kernels.tape``), or by CasADi where it calls what
    is no expression. It serves as nominal model, (state (n,), input (m,)) to the next state (n,), and as effect B(x),
    state (n,) to (n, k). It is evaluated in double precision on the CPU, and torch cannot differentiate it.

    Raises:
        UnsupportedModel: It is no CasADi function, or has no argument, or more than one value.
    """

    def __init__(self, function: Any):
        from gpmpc.gp.casadi_ import tape_of  # loads CasADi

        if (
            not hasattr(function, "n_in")
            or function.n_out() != 1
            or not function.n_in()
        ):
            raise UnsupportedModel(
                f"CasadiFunction takes a CasADi function of one value; got {function!r}"
            )
        if any(function.size2_in(i) != 1 for i in range(function.n_in())):
            raise UnsupportedModel(
                f"a CasADi function takes vectors (column by column); got {function!r}"
            )
        self.function = function
        self.tape = tape_of(function)
        self._mapped: dict[int, Any] = {}
        self.shape = function.size1_out(0), function.size2_out(0)
        self.sizes = [function.size1_in(i) for i in range(function.n_in())]

    @cached_property
    def _expansion(self) -> Any:
        """Value and derivatives as a CasADi function."""
        names = self.function.name_in()
        value = self.function.name_out(0)
        return self.function.factory(
            "expansion", names, [value, *(f"jac:{value}:{name}" for name in names)]
        )

    def check_sizes(self, arguments: tuple[int, ...], value: tuple[int, int]) -> None:
        """Raises ``UnsupportedModel`` unless arguments and value have these sizes."""
        if (tuple(self.sizes), self.shape) != (arguments, value):
            rule = f"must map vectors of {arguments} entries to a matrix of {value}"
            raise UnsupportedModel(
                f"a CasADi function of this model {rule}; got {self.function}"
            )

    def __call__(self, *arguments: Tensor) -> Tensor:
        """The value (*batch, rows), or (*batch, rows, columns) of a matrix, at arguments (*batch, d_i)."""
        like = arguments[0]
        flat = (
            to_array(a).reshape(-1, size)
            for a, size in zip(arguments, self.sizes, strict=True)
        )
        value = torch.as_tensor(
            self.linearize(*flat)[0], dtype=like.dtype, device=like.device
        )
        return value.reshape(*like.shape[:-1], *value.shape[1:])

    def linearize(self, *arguments: Array) -> tuple[Array, ...]:
        """The values at K points, and their derivatives by each argument (K, rows, d_i) or (K, rows, columns, d_i)."""
        K, (rows, columns) = len(arguments[0]), self.shape
        size = rows * columns  # a matrix goes column by column
        if self.tape is not None:
            from gpmpc._kernels.tape import linearize_tape  # loads numba

            points = np.ascontiguousarray(np.hstack(arguments))
            values = np.empty((K, size))
            jacobians = np.empty((K, size, points.shape[1]))
            linearize_tape.unchecked(self.tape, points, values, jacobians)
            parts = [values, *np.split(jacobians, np.cumsum(self.sizes)[:-1], axis=2)]
        else:
            if K not in self._mapped:
                self._mapped[K] = self._expansion.map(K)
            value, *jacobians = (
                part.full() for part in self._mapped[K].call([a.T for a in arguments])
            )
            parts = [
                value.reshape(rows, K, columns).transpose(1, 2, 0).reshape(K, size)
            ]
            parts += [
                jacobian.reshape(size, K, -1).swapaxes(0, 1) for jacobian in jacobians
            ]
        if columns > 1:
            parts = [
                part.reshape(K, columns, rows, *part.shape[2:]).swapaxes(1, 2)
                for part in parts
            ]
        return tuple(np.ascontiguousarray(part) for part in parts)


def linearize_function(
    function: Callable[..., Tensor], model: Any, *arguments: Array
) -> tuple[Array, ...]:
    """Value and derivatives by each argument of a batched function at K points, arguments (K, d_i).

    By the function's own method ``linearize``; else by one batched call of torch autograd, with tensors of the model's
    type on its device: from (*batch, d_i) to (*batch, k) or (*batch, n, k).
    """
    if (method := getattr(function, "linearize", None)) is not None:
        return method(*arguments)
    if len(arguments[0]) == 1:
        # Of one row Python makes a number (float, math.sin), which has no derivative:
        # of two it fails.
        pairs = [np.repeat(argument, 2, axis=0) for argument in arguments]
        twice = linearize_function(function, model, *pairs)
        return tuple(part[:1] for part in twice)
    shape: list[torch.Size] = []

    def flat(*at: Tensor) -> tuple[Tensor]:
        value = function(*at)
        shape.append(value.shape[1:])
        return (value.flatten(1),)

    (value,), jacobians = batched_jacobian(flat, tensors_for(model, *arguments))
    parts = [
        value.unflatten(1, shape[0]),
        *(by.unflatten(1, shape[0]) for by in jacobians),
    ]
    return tuple(to_array(part) for part in parts)
