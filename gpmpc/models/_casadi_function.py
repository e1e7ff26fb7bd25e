"""Functions that are written in CasADi, as parts of models."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import TURN
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array, to_array
from gpmpc.exceptions import ShapeError, UnsupportedModel

_POINTS = 8  # of each range at which a function shows whether it wraps an angle
_RANGES = ((-1.0, 1.0), (0.1, 2.0))  # roots and logarithms need positive numbers
_KEPT = 20  # maps over points, of the numbers of points that were asked for last
_TURN_IS_LOST = 1e-6  # [rad] that a value moves by at most for a turn of its angle


@explains_arguments
class CasadiFunction:
    """A function that is written in CasADi, linearised at all points in one call.

    Its operations are read once and run by compiled loops (``gpmpc._kernels.tape``), or
    by CasADi where it calls what is no expression. It serves as nominal model, (state
    (n,), input (m,)) to the next state (n,), and as effect B(x), state (n,) to (n, k).
    It is evaluated in double precision on the CPU. Derivatives are CasADi's, those that
    torch asks for too, of any order.

    Raises:
        UnsupportedModel: It is no CasADi function, or has no argument, or more than one
            value.

    >>> import numpy as np
    >>> import casadi
    >>> x, u = casadi.SX.sym("x", 2), casadi.SX.sym("u", 1)
    >>> f = CasadiFunction(casadi.Function("f", [x, u], [casadi.vertcat(x[1], u[0])]))
    >>> next_states, A, B = f.linearize(np.zeros((1, 2)), np.ones((1, 1)))
    >>> A[0].tolist()
    [[0.0, 1.0], [0.0, 0.0]]

    See Also:
        ``gpmpc.gp.casadi_.successor_function``, which makes one of a system.
    """

    def __init__(self, function: Any):
        from gpmpc.gp.casadi_ import tape_of  # loads CasADi

        is_function = hasattr(function, "n_in")
        if not is_function or function.n_out() != 1 or not function.n_in():
            rule = "CasadiFunction takes a CasADi function of one value"
            raise UnsupportedModel(f"{rule}; got {function!r}")
        if any(function.size2_in(i) != 1 for i in range(function.n_in())):
            rule = "a CasADi function takes vectors (column by column)"
            raise UnsupportedModel(f"{rule}; got {function!r}")
        self.function = function
        self.tape = tape_of(function)
        self.shape = function.size1_out(0), function.size2_out(0)
        self.sizes = [function.size1_in(i) for i in range(function.n_in())]
        self._mapped_expansions: dict[int, Any] = {}  # by the number of points
        self._counting: dict[tuple[int, ...], CasadiFunction] = {}  # by the angles

    @cached_property
    def _expansion(self) -> Any:
        """Value and derivatives as a CasADi function."""
        arguments = self.function.name_in()
        value = self.function.name_out(0)
        jacobians = [f"jac:{value}:{argument}" for argument in arguments]
        return self.function.factory("expansion", arguments, [value, *jacobians])

    @cached_property
    def jacobian(self) -> "CasadiFunction":
        """Derivatives of the value, column by column, by all arguments side by side.

        They can be differentiated again, which those of ``_expansion`` cannot.
        """
        from gpmpc.gp.casadi_ import jacobian_of  # loads CasADi

        return CasadiFunction(jacobian_of(self.function))

    def check_sizes(self, arguments: tuple[int, ...], value: tuple[int, int]) -> None:
        """Raises ``UnsupportedModel`` unless arguments and value have these sizes."""
        if (tuple(self.sizes), self.shape) != (arguments, value):
            rule = f"must map vectors of {arguments} entries to a matrix of {value}"
            raise UnsupportedModel(
                f"a CasADi function of this model {rule}; got {self.function}"
            )

    def _check_widths(self, arguments: Sequence[Any]) -> None:
        """Raises ``ShapeError`` unless arguments (.., d_i) have the function's sizes.

        The compiled loops would read behind shorter ones.
        """
        widths = [argument.shape[-1] for argument in arguments]
        if widths != self.sizes:
            takes = ", ".join(f"({size},)" for size in self.sizes)
            got = ", ".join(f"({width},)" for width in widths)
            raise ShapeError(f"{self.function.name()} takes {takes}; got {got}")

    def __call__(self, *arguments: Tensor) -> Tensor:
        """Computes the value (*batch, rows), or (*batch, rows, columns) of a matrix.

        Args:
            arguments: (*batch, d_i) each.

        Raises:
            ShapeError: They have other sizes than the function's arguments.
        """
        self._check_widths(arguments)
        return _Evaluation.apply(self, *arguments)

    def evaluate(self, *arguments: Tensor) -> Tensor:
        """Computes what a call does, as numbers that torch does not follow."""
        like = arguments[0]
        count = like.shape[:-1].numel()
        points = [
            to_array(argument).reshape(count, size)
            for argument, size in zip(arguments, self.sizes, strict=True)
        ]
        values, *_ = self.linearize(*points)
        value = torch.as_tensor(values, dtype=like.dtype, device=like.device)
        return value.reshape(*like.shape[:-1], *value.shape[1:])

    def counting_turns(self, angles: tuple[int, ...]) -> "CasadiFunction":
        """Returns the function of next states, with angles that count turns.

        It is the function itself, unless it wraps an angle: then its angles are those
        within half a turn of the state's.

        Args:
            angles: Indices of the states, and so of the value, that are angles [rad].
        """
        from gpmpc.gp.casadi_ import without_turns  # loads CasADi

        if angles not in self._counting:
            wrapped = [i for i in angles if self._wraps(i)]
            counting = self
            if wrapped:
                counting = CasadiFunction(without_turns(self.function, wrapped))
            self._counting[angles] = counting
        return self._counting[angles]

    def _wraps(self, angle: int) -> bool:
        """Returns whether a turn more of an angle is none of its next value.

        One point where it is lost is enough: a function may wrap on one branch alone.
        Where no point has a value, the function counts as one that wraps: its angles
        are then within half a turn of the state's, as those of any other are.
        """
        rng = np.random.default_rng(0)
        points = [
            np.concatenate([rng.uniform(*ends, (_POINTS, size)) for ends in _RANGES])
            for size in self.sizes
        ]
        before, *_ = self.linearize(*points)
        points[0][:, angle] += TURN
        after, *_ = self.linearize(*points)
        change = (after - before)[:, angle]
        change = change[np.isfinite(change)]
        return not change.size or bool((np.abs(change) < _TURN_IS_LOST).any())

    def linearize(self, *arguments: Array) -> tuple[Array, ...]:
        """Computes values and derivatives at K points.

        Args:
            arguments: (K, d_i) each.

        Returns:
            The values (K, rows) and their derivatives by each argument (K, rows, d_i);
            of a matrix (K, rows, columns) and (K, rows, columns, d_i).

        Raises:
            ShapeError: They have other sizes than the function's arguments.
        """
        self._check_widths(arguments)
        has_tape = self.tape is not None
        linearize = self._linearize_tape if has_tape else self._linearize_by_casadi
        parts = linearize(*arguments)
        rows, columns = self.shape
        if columns > 1:  # a matrix goes column by column
            K = len(arguments[0])
            parts = [
                part.reshape(K, columns, rows, *part.shape[2:]).swapaxes(1, 2)
                for part in parts
            ]
        return tuple(np.ascontiguousarray(part) for part in parts)

    def _linearize_tape(self, *arguments: Array) -> list[Array]:
        """Linearises by compiled loops: (K, size), and (K, size, d_i) each."""
        from gpmpc._kernels.tape import linearize_tape  # loads numba

        K = len(arguments[0])
        rows, columns = self.shape
        # the kernel takes any array for one of doubles
        points = np.ascontiguousarray(np.hstack(arguments), dtype=np.float64)
        values = np.empty((K, rows * columns))
        jacobian = np.empty((K, rows * columns, points.shape[1]))
        linearize_tape.unchecked(self.tape, points, values, jacobian)
        ends = np.cumsum(self.sizes)[:-1]
        by_arguments = np.split(jacobian, ends, axis=2)
        if not np.isfinite(jacobian).all() and np.isfinite(values).all():
            return [values, *self._known_derivatives(by_arguments, arguments)]
        return [values, *by_arguments]

    def _known_derivatives(
        self, by_arguments: list[Array], arguments: tuple[Array, ...]
    ) -> list[Array]:
        """Returns derivatives of loops, those of CasADi where they are not finite.

        The loops multiply the endless slope of sqrt(p) at zero with the zero by which p
        depends on x, which is no number; CasADi knows what does not depend on x.
        """
        _, *of_casadi = self._linearize_by_casadi(*arguments)
        return [
            np.where(np.isfinite(own), own, other)
            for own, other in zip(by_arguments, of_casadi, strict=True)
        ]

    def _linearize_by_casadi(self, *arguments: Array) -> list[Array]:
        """Linearises by CasADi: (K, size), and (K, size, d_i) each."""
        K = len(arguments[0])
        rows, columns = self.shape
        size = rows * columns
        if K not in self._mapped_expansions:
            if len(self._mapped_expansions) >= _KEPT:
                self._mapped_expansions.clear()
            self._mapped_expansions[K] = self._expansion.map(K)
        expansion = self._mapped_expansions[K]
        value, *jacobians = [
            part.full() for part in expansion.call([a.T for a in arguments])
        ]
        values = value.reshape(rows, K, columns).transpose(1, 2, 0).reshape(K, size)
        by_arguments = [
            jacobian.reshape(size, K, -1).swapaxes(0, 1) for jacobian in jacobians
        ]
        return [values, *by_arguments]


class _Evaluation(torch.autograd.Function):
    """A call of a ``CasadiFunction``, whose derivatives are those of CasADi."""

    @staticmethod
    def forward(function: CasadiFunction, *arguments: Tensor) -> Tensor:
        """Computes the value (*batch, rows), or (*batch, rows, columns)."""
        return function.evaluate(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Keeps what derivatives are taken of."""
        ctx.function, *arguments = inputs
        ctx.save_for_backward(*arguments)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        """Multiplies the value's gradient by the Jacobian, which has derivatives too.

        A value that torch differentiates again is a call of another function.
        """
        (gradient,) = grad_outputs
        function = ctx.function
        arguments = ctx.saved_tensors
        batch = arguments[0].shape[:-1]
        rows, columns = function.shape
        jacobian = function.jacobian(*arguments)
        jacobian = jacobian.reshape(*batch, rows * columns, sum(function.sizes))
        if columns > 1:  # the Jacobian's rows go column by column
            gradient = gradient.mT.flatten(-2)
        product = (gradient[..., None, :] @ jacobian)[..., 0, :]
        return None, *product.split(function.sizes, dim=-1)
