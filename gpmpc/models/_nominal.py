"""Known models x+ = f0(x, u): an affine one, and any function without a GP."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import (
    Array,
    Linearized,
    batched_jacobian,
    check_query,
    tensors_for,
    to_array,
)
from gpmpc._functions import call
from gpmpc.exceptions import GpmpcError, SettingError, ShapeError, check_number
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.signals import UNKNOWN, Signals

# Steps of differences, besides a point's size, from the widest on: what is finer than
# the first two shows between the last two.
_WIDTHS = (2e-3, 1e-3, 2e-5, 1e-5)
_ROUNDING = 1.2e-7  # of a number in single precision, in which functions may compute


@explains_arguments
@dataclass(frozen=True, eq=False)
class Affine:
    """A nominal model x+ = A x + B u + c, through which uncertainty goes exactly.

    Raises:
        ShapeError: The shapes do not belong together.
        SettingError: One of the three is no tensor.

    >>> import torch
    >>> both = torch.tensor([[1.0], [1.0]], dtype=torch.float64)
    >>> f0 = Affine(torch.eye(2).double(), B=both, c=torch.zeros(2).double())
    >>> f0(torch.tensor([1.0, 2.0]).double(), torch.tensor([0.5]).double()).tolist()
    [1.5, 2.5]

    See Also:
        ``KnownModel`` for any function; ``ResidualModel``, which learns what it
        misses.
    """

    A: Tensor  #: (n, n)
    B: Tensor  #: (n, m)
    c: Tensor  #: (n,)

    def __post_init__(self) -> None:
        check_tensors(A=self.A, B=self.B, c=self.c)
        n = self.c.numel()
        fits_A = self.A.shape == (n, n)
        fits_B = self.B.dim() == 2 and len(self.B) == n
        fits_c = self.c.shape == (n,)
        if not (fits_A and fits_B and fits_c):
            shapes = [tuple(part.shape) for part in (self.A, self.B, self.c)]
            got = ", ".join(map(str, shapes))
            raise ShapeError(f"A, B and c must be (n, n), (n, m) and (n,); got {got}")

    @classmethod
    def identity(cls, state_dim: int, input_dim: int) -> "Affine":
        """Returns the model x+ = x, whose residual is the difference of two states."""
        n = state_dim
        m = input_dim
        dtype = torch.float64
        return cls(
            A=torch.eye(n, dtype=dtype),
            B=torch.zeros(n, m, dtype=dtype),
            c=torch.zeros(n, dtype=dtype),
        )

    def __call__(self, state: Tensor, input: Tensor) -> Tensor:
        """Computes the next state (*batch, n)."""
        return state @ self.A.mT + input @ self.B.mT + self.c

    def linearize(self, states: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """Computes next states and derivatives at K points (K, n), (K, m).

        Returns:
            The next states (K, n), and the constant derivatives (K, n, n), (K, n, m).
        """
        A, B, c = self._arrays
        K = len(states)
        mean = states @ A.T + inputs @ B.T + c
        return mean, np.tile(A, (K, 1, 1)), np.tile(B, (K, 1, 1))

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array]:
        """A, B and c as arrays."""
        return to_array(self.A), to_array(self.B), to_array(self.c)


@explains_arguments
@dataclass(frozen=True, eq=False)
class KnownModel:
    """A known function x+ = f0(x, u) as a model without uncertainty.

    Raises:
        SettingError: A number is no whole one, or the function fails at zero.
        ShapeError: It does not give next states of a batch.

    >>> import torch
    >>> model = KnownModel(lambda x, u: 0.9 * x + u, state_dim=1, input_dim=1)
    >>> state, input = torch.ones(1).double(), torch.zeros(1).double()
    >>> model.predict(state, input).mean.tolist()
    [0.9]

    See Also:
        ``Affine`` and ``CasadiFunction`` for functions; ``ResidualModel``.
    """

    #: f0, from x (*batch, n) and u (*batch, m) to (*batch, n), such as
    #: ``CasadiFunction``
    function: Callable[[Tensor, Tensor], Tensor]
    state_dim: int  #: n
    input_dim: int  #: m
    signals: Signals = UNKNOWN  #: names and time step, where they are known

    dtype = torch.float64
    device = torch.device("cpu")

    def __post_init__(self) -> None:
        check_number("state_dim", self.state_dim, least=1, whole=True)
        check_number("input_dim", self.input_dim, least=0, whole=True)
        self._check_function()

    def _check_function(self) -> None:
        """Raises unless the function gives next states of a batch of states.

        torch has to follow all of it.
        """
        n = self.state_dim
        m = self.input_dim
        rows = n + m + 1  # more than columns: a function of one state shows
        states = torch.zeros(rows, n, dtype=self.dtype)
        inputs = torch.zeros(rows, m, dtype=self.dtype)
        rule = f"must give next states (*batch, {n}) of states (*batch, {n}) and inputs"
        # torch has to follow it, unless it brings its derivatives.
        is_followed = not hasattr(self.function, "linearize")
        states.requires_grad_(is_followed)
        inputs.requires_grad_(is_followed)
        try:
            with torch.set_grad_enabled(is_followed):
                value = call("function", self.function, states, inputs)
        except GpmpcError:
            raise
        except Exception as error:
            got = f"{type(error).__name__}: {error}".partition("\n")[0]
            raise SettingError(
                "function", f"{rule} (*batch, {m}); got {got}"
            ) from error
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value)
        if shape != (rows, n):
            got = shape if isinstance(shape, tuple) else shape.__name__
            raise ShapeError(
                f"function {rule} (*batch, {m}); got {got} of {rows} states"
            )
        if is_followed:
            check_slopes("function", self.function, self, *points_near_zero(n, m))

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
        """Computes the next state (*batch, n), with zero covariance."""
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
        V = None
        if covariance:
            V = np.zeros((*mean.shape, self.state_dim))
        return Linearized(mean, A, B, V)


def linearize_function(
    function: Callable[..., Tensor], model: Any, *arguments: Array
) -> tuple[Array, ...]:
    """Computes value and derivatives of a batched function at K points.

    By the function's own method ``linearize``; else by one batched call of torch
    autograd.

    Args:
        function: From (*batch, d_i) each to (*batch, k) or (*batch, n, k), in torch.
        model: Has the type and the device of the tensors.
        arguments: (K, d_i) each.

    Returns:
        The values (K, k) or (K, n, k), and the derivatives by each argument, with a
        further dimension d_i.
    """
    method = getattr(function, "linearize", None)
    if method is not None:
        return method(*arguments)
    if len(arguments[0]) == 1:
        # Of one row Python makes a number (float, math.sin), which has no derivative:
        # of two it fails.
        pairs = [np.repeat(argument, 2, axis=0) for argument in arguments]
        doubled = linearize_function(function, model, *pairs)
        return tuple(array[:1] for array in doubled)
    shapes: list[torch.Size] = []

    def flat_function(*points: Tensor) -> tuple[Tensor]:
        value = function(*points)
        shapes.append(value.shape[1:])
        return (value.flatten(1),)

    tensors = tensors_for(model, *arguments)
    (value,), jacobians = batched_jacobian(flat_function, tensors)
    shape = shapes[0]
    arrays = [value.unflatten(1, shape)]
    arrays += [jacobian.unflatten(1, shape) for jacobian in jacobians]
    return tuple(to_array(array) for array in arrays)


def check_slopes(
    key: str,
    function: Callable[..., Tensor],
    model: Any,
    *arguments: Array,
    angles: Sequence[int] = (),
) -> None:
    """Raises ``SettingError`` where torch loses a part of a function's derivatives.

    Where the function is not defined nothing can be compared. ``key`` is what it is,
    for the message; other arguments are those of ``lost_derivative``.
    """
    try:
        lost = lost_derivative(function, model, *arguments, angles=angles)
    except GpmpcError:
        raise
    except Exception:
        return
    if lost is not None:
        raise SettingError(key, lost)


def lost_derivative(
    function: Callable[..., Tensor],
    model: Any,
    *arguments: Array,
    angles: Sequence[int] = (),
) -> str | None:
    """Says which derivative of a function torch loses; None where it loses none.

    A part that torch could not follow (``.detach()``, NumPy, ``torch.tensor``) is
    missing in its derivatives. Differences to both sides of a point, of four widths
    from 2e-3 to 1e-5, say what they should be, where they agree: at kinks, of what is
    finer than their widths, and of values that rounding takes away they do not. A
    difference that rounding of the values in single precision may make says nothing,
    nor does a value that stays the same, as of a straight-through estimator. Rather
    is a lost part missed than a right function refused. An entry counts where it is
    wrong at every point at which it is a number.

    Args:
        function: See ``linearize_function``.
        model: Has the type and the device of the tensors.
        arguments: Points (K, d_i) each.
        angles: Columns of the first argument that are angles: they may count turns,
            which change no slope.
    """
    values, *jacobians = linearize_function(function, model, *arguments)
    K = len(values)
    values = values.reshape(K, -1)
    v = values.shape[1]
    points = np.concatenate(arguments, axis=1)
    scale = 1.0 + np.abs(points)
    scale[:, list(angles)] = 1.0
    sizes = [argument.shape[1] for argument in arguments]
    values_at = partial(_values_at, function, model, sizes)
    flat = [
        part.reshape(K, v, size) for part, size in zip(jacobians, sizes, strict=True)
    ]
    slopes = np.concatenate(flat, axis=2)
    with np.errstate(invalid="ignore", over="ignore"):
        sided = [
            _one_sided_differences(values_at, points, values, side * width * scale)
            for width in _WIDTHS
            for side in (1.0, -1.0)
        ]
        differences = np.stack(sided)
        size = np.abs(differences).max(axis=0)
        spread = differences.max(axis=0) - differences.min(axis=0)
        excess = np.abs(differences - slopes).min(axis=0)
        rounding = _ROUNDING * np.abs(values)[:, :, None] / scale[:, None] / _WIDTHS[1]
        have_converged = (spread < 0.03 * size) & (spread < 0.3 * excess)
        is_clear = excess > 1e-3 + 0.01 * np.maximum(size, np.abs(slopes))
        is_off = have_converged & is_clear & (excess > 10.0 * rounding)
    is_number = np.isfinite(spread) & np.isfinite(excess)
    is_wrong = (is_off | ~is_number).all(axis=0) & is_number.any(axis=0)
    if not is_wrong.any():
        return None
    output, column = np.argwhere(is_wrong)[0]
    point = np.flatnonzero(is_number[:, output, column])[0]
    return (
        "must be followed by torch as a whole: the derivative of its entry "
        f"{output + 1} by column {column + 1} of (x, u) is "
        f"{differences[-1, point, output, column]:.3g}, and torch finds "
        f"{slopes[point, output, column]:.3g} (a part is lost by .detach(), numpy or "
        "torch.tensor); where that is meant, give it a method linearize"
    )


def points_near_zero(*sizes: int) -> list[Array]:
    """Returns three points (3, d_i) near zero of arguments of some sizes.

    They are no round numbers, where functions have their kinks.
    """
    generator = np.random.default_rng(0)
    return [generator.uniform(-1.0, 1.0, (3, size)) for size in sizes]


def _values_at(
    function: Callable[..., Tensor], model: Any, sizes: Sequence[int], points: Array
) -> Array:
    """Evaluates a function at joint arguments (K, d): its entries (K, v)."""
    arguments = np.split(points, np.cumsum(sizes)[:-1], axis=1)
    tensors = tensors_for(model, *map(np.ascontiguousarray, arguments))
    with torch.no_grad():
        return to_array(function(*tensors).flatten(1))


def _one_sided_differences(
    values_at: Callable[[Array], Array], points: Array, values: Array, steps: Array
) -> Array:
    """Differentiates entries (K, v) by points (K, d), to one side of each.

    Args:
        values_at: Of points (any, d).
        points: (K, d).
        values: There (K, v).
        steps: To where values are compared, with their signs (K, d).

    Returns:
        The differences (K, v, d).
    """
    K, d = points.shape
    moved = points[:, None] + steps[:, None] * np.eye(d)
    moved_values = values_at(moved.reshape(K * d, d)).reshape(K, d, values.shape[1])
    changes = moved_values - values[:, None]
    return (changes / steps[:, :, None]).swapaxes(1, 2)
