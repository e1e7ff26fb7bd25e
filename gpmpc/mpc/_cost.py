"""Costs: weighed squares of the tracking error, of the inputs, and of outputs.

Outputs are linearised along a plan in z = [x_i; u_{i-1}], y(z') + J (z - z'), so that a
step is one of Gauss-Newton. To a stage they add the square [z; 1]' Z [z; 1], where
Z = [J, e]' W [J, e] and e = y(z') - J z' - c.

A cost of the last state alone, of another form than ``Tracking.terminal``, is a
``LeastSquares`` whose weights by stage are zero but the last one. A new field would go
through ``StageCosts``, ``Problem.over``, ``_elastic``, ``StageMeter``, which leaves out
what the end costs, the judge of flights, which knows ``Tracking`` alone, and
``gpmpc/export/_problems.py``.
"""

import inspect
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from gpmpc._angles import state_difference
from gpmpc._arrays import read_array
from gpmpc._calls import explains_arguments
from gpmpc._functions import call
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_choice,
    check_indices,
)
from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._nominal import linearize_function

Array = np.ndarray

Penalized = Literal["inputs", "deviations", "increments"]
PENALIZED = ("inputs", "deviations", "increments")

_WEIGHT_RULE = "must be the diagonal of a weight or a square matrix"
_PRODUCT_ROUNDING = 1e-12  # of a weight that was computed, such as M.T @ Q @ M


class PaidParts(NamedTuple):
    """What each of K steps cost."""

    states: Array  # (K,)
    inputs: Array  # (K,)


@explains_arguments
@dataclass(frozen=True)
class Tracking:
    """Costs of the distance to a reference and of the inputs.

    Raises:
        SettingError: A weight is not symmetric positive semidefinite, R is zero in a
            direction, or a length is wrong.

    Over the horizon H, with v the inputs, their deviations or their increments::

        sum_(i=1..H) (x_i - r_i)' Q_i (x_i - r_i) + sum_(i=0..H-1) v_i' R_i v_i

    >>> cost = Tracking(Q=[10.0, 1.0], R=[0.1], penalized="inputs")
    >>> cost.Q.tolist()
    [[10.0, 0.0], [0.0, 1.0]]

    See Also:
        ``Problem``, which takes it; ``LeastSquares`` for functions of the states.
    """

    #: state weights, the diagonal (n,) or the matrix (n, n); matrices (H, n, n) by
    #: stage
    Q: Any
    #: input weights, likewise (m,), (m, m) or (H, m, m), positive definite
    R: Any
    #: weight of the last predicted state, one like Q; Q itself (its last one) by
    #: default
    terminal: Any = None
    #: what R weighs: ``"inputs"``, ``"deviations"`` from the reference inputs, or
    #: ``"increments"``
    penalized: Penalized = "increments"
    #: indices of states whose error is modulo 2 pi: their references move by full turns
    #: towards the plan. None: those that the controller's model knows as angles
    angles: Sequence[int] | None = None

    def __post_init__(self) -> None:
        Q = _weight("Q", self.Q)
        R = _weight("R", self.R)
        n = Q.shape[-1]
        lowest = np.linalg.eigvalsh(R).min()
        if lowest <= 0:
            rule = "must be positive definite"
            raise SettingError("R", f"{rule}; its smallest eigenvalue is {lowest:.3g}")
        terminal = Q.reshape(-1, n, n)[-1]
        if self.terminal is not None:
            terminal = _weight("terminal", self.terminal)
        if terminal.shape != (n, n):
            rule = f"must be a weight of {n} states"
            raise SettingError("terminal", f"{rule}; got {len(terminal)}")
        check_choice("penalized", self.penalized, PENALIZED)
        if self.angles is not None:
            angles = check_indices("angles", self.angles, n)
            object.__setattr__(self, "angles", angles)
        object.__setattr__(self, "Q", Q)
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "terminal", terminal)

    @cached_property
    def angle_indices(self) -> tuple[int, ...]:
        """The ``angles``; none where they are left to a controller's model."""
        return tuple(self.angles or ())

    def by_stage(self, horizon: int) -> tuple[Array, Array]:
        """Returns the weights of all stages.

        Returns:
            Those of x_1 .. x_H (H, n, n), the last one the terminal one, and of
            v_0 .. v_{H-1} (H, m, m).

        Raises:
            SettingError: They are for another number of stages.
        """
        Q = by_stage("Q", self.Q, horizon, 2)
        R = by_stage("R", self.R, horizon, 2)
        return np.concatenate([Q[:-1], self.terminal[None]]), R

    def paid(
        self,
        states: Array,
        inputs: Array,
        references: Array,
        previous_input: Array,
        reference_inputs: Array | None = None,
    ) -> Array:
        """Computes what each of K steps cost, that of x_{k+1} and u_k (K,).

        Weights are those of the first stage, wherever a step stands: what is flown has
        no end. Angles count within half a turn.

        Args:
            states: x_0 .. x_K (K + 1, n).
            inputs: u_0 .. u_{K-1} (K, m).
            references: r_0 .. r_K (K + 1, n).
            previous_input: u_{-1} (m,), from which the first increment counts.
            reference_inputs: (K, m), where deviations from them are weighed.

        Raises:
            SettingError: Deviations are weighed, and no reference inputs were handed
                over.
        """
        cost_parts = self.paid_parts(
            states, inputs, references, previous_input, reference_inputs
        )
        return cost_parts.states + cost_parts.inputs

    def paid_parts(
        self,
        states: Array,
        inputs: Array,
        references: Array,
        previous_input: Array,
        reference_inputs: Array | None = None,
    ) -> PaidParts:
        """Computes what K steps cost, apart for x_{k+1} and u_k; see ``paid``."""
        Q = self.Q.reshape(-1, *self.Q.shape[-2:])[0]
        R = self.R.reshape(-1, *self.R.shape[-2:])[0]
        error = state_difference(states[1:], references[1:], self.angle_indices)
        weighed = inputs
        if self.penalized == "increments":
            weighed = np.diff(inputs, axis=0, prepend=np.atleast_2d(previous_input))
        elif self.penalized == "deviations":
            if reference_inputs is None:
                rule = "must be handed over where deviations from them are weighed"
                raise SettingError("reference_inputs", f"{rule}; got None")
            weighed = inputs - reference_inputs
        return PaidParts(
            states=np.einsum("ki,ij,kj->k", error, Q, error),
            inputs=np.einsum("ki,ij,kj->k", weighed, R, weighed),
        )


@explains_arguments
@dataclass(frozen=True)
class LeastSquares:
    """Costs of outputs y(x, u, p): weighed squares of the distance to references.

    Raises:
        SettingError: y is no function, the weight is not symmetric positive
            semidefinite, or a length is wrong.

    >>> energy = LeastSquares(lambda x: x[:, :1] ** 2, weight=[1.0], reference=[4.0])
    >>> energy.weight.tolist()
    [[1.0]]

    See Also:
        ``Tracking`` for the states themselves; ``Problem``, which takes it.
    """

    #: a function of tensors, states (H, n), inputs (H, m) and, where the controller is
    #: handed ``parameters``, these (H, q), that gives (H, d), each row of its own
    #: stage; or a CasADi function of vectors. It may take fewer: the states, or states
    #: and inputs. Arguments with a default other than None are its own, and keep it
    y: Any
    #: W, the diagonal (d,) or the matrix (d, d); matrices (H, d, d) by stage, zero
    #: where y costs nothing
    weight: Any
    reference: Any = None  #: c (d,), or (H, d) by stage; zero by default

    def __post_init__(self) -> None:
        if not callable(self.y):
            raise SettingError("y", f"must be a function; got {type(self.y).__name__}")
        weight = _weight("weight", self.weight)
        d = weight.shape[-1]
        reference = np.zeros(d)
        if self.reference is not None:
            reference = np.array(read_array("reference", self.reference))
        fits = reference.ndim in (1, 2) and reference.shape[-1] == d
        if not (fits and np.isfinite(reference).all()):
            rule = f"must be {d} finite numbers, or these by stage"
            raise SettingError("reference", rule)
        object.__setattr__(self, "weight", weight)
        object.__setattr__(self, "reference", reference)

    def squares(self, states: Array, inputs: Array, parameters: Array | None) -> Array:
        """Returns the squares Z (H, n + m + 1, n + m + 1) along a plan.

        Args:
            states: x_1 .. x_H (H, n).
            inputs: u_0 .. u_{H-1} (H, m).
            parameters: By stage (H, q), where y takes some.

        Raises:
            FunctionNotFinite: y or a derivative is not finite.
        """
        y = expand_function(
            "y", self.y, self.weight.shape[-1], states, inputs, parameters
        )
        e = (
            y.values
            - self.reference
            - np.einsum("kri,ki->kr", y.by_state, states)
            - np.einsum("kri,ki->kr", y.by_input, inputs)
        )
        rows = np.concatenate([y.by_state, y.by_input, e[..., None]], axis=2)
        return rows.mT @ self.weight @ rows


def by_stage(key: str, values: Array, horizon: int, dims: int) -> Array:
    """Returns values of every stage.

    Args:
        key: What they are, for the message.
        values: Of every stage, H of them, or of one.
        horizon: H.
        dims: Number of axes of the values of one stage.

    Raises:
        SettingError: They are for another number of stages.
    """
    if values.ndim > dims and len(values) != horizon:
        rule = f"must be given for one stage or all {horizon}"
        raise SettingError(key, f"{rule}; got {len(values)}")
    shape = (horizon, *values.shape[values.ndim - dims :])
    return np.ascontiguousarray(np.broadcast_to(values, shape))


class FunctionNotFinite(DataError):
    """A constraint, an output of the cost, or its gradient is not finite on a plan."""


class Expansion(NamedTuple):
    """The values of a function along a plan, and its derivatives."""

    values: Array  # (H, count)
    by_state: Array  # (H, count, n)
    by_input: Array  # (H, count, m)


def expand_function(
    name: str,
    function: Any,
    count: int,
    states: Array,
    inputs: Array,
    parameters: Array | None,
) -> Expansion:
    """Returns the first-order expansion of a function along a plan.

    Args:
        name: Of the function, for messages.
        function: Of tensors, or a CasADi function; see ``LeastSquares``.
        count: Number of its values at a stage.
        states: x_1 .. x_H (H, n).
        inputs: u_0 .. u_{H-1} (H, m).
        parameters: By stage (H, q), or None.

    Raises:
        FunctionNotFinite: A value or a derivative is not finite.
        SettingError: The function takes parameters, and there are none.
        ShapeError: Its values have another shape, or it takes others of states, inputs
            or parameters.
    """
    least, most = _count_arguments(function)
    arguments = [states, inputs] if parameters is None else [states, inputs, parameters]
    if len(arguments) < least:
        rule = f"must come with every call: {name} is a function of them"
        raise SettingError("parameters", rule)
    if hasattr(function, "n_in"):
        try:
            values, *jacobians = _casadi_function(function).linearize(*arguments[:most])
        except ShapeError as error:
            raise ShapeError(f"{name}: {error}") from None
    else:
        tensors = [torch.as_tensor(argument) for argument in arguments[2:most]]
        checked = _CheckedFunction(name, function, count, tensors)
        differentiated = arguments[: min(most, 2)]
        values, *jacobians = linearize_function(checked, _FLOAT64, *differentiated)
    H = len(states)
    if values.shape != (H, count):
        raise ShapeError(f"{name} must give ({H}, {count}); got {values.shape}")
    by_input = np.zeros((H, count, inputs.shape[1]))
    if len(jacobians) > 1:
        by_input = jacobians[1]
    expansion = Expansion(values, jacobians[0], by_input)
    _check_finite(name, expansion, states, inputs)
    return expansion


def of_first_states(function: Any, n: int, states: int) -> Any:
    """Returns a function of more states that calls one of the first n of them.

    Args:
        function: Of tensors, or a CasADi function; see ``LeastSquares``.
        n: Number of states that it takes.
        states: Number of states that the new one takes.
    """
    if hasattr(function, "n_in"):
        return _casadi_function_of_first(function, n, states)
    return _FunctionOfFirst(function, n)


class _FunctionOfFirst:
    """A user's function of tensors of the first n states."""

    def __init__(self, function: Any, n: int):
        self._function = function
        self._n = n
        with suppress(ValueError):  # such as of torch.sin
            self.__signature__ = inspect.signature(function)

    def __call__(self, states: torch.Tensor, *others: torch.Tensor) -> Any:
        """Returns the function's values."""
        return self._function(states[:, : self._n], *others)


def _casadi_function_of_first(function: Any, n: int, states: int) -> Any:
    """Returns a CasADi function of more states that calls one of the first n."""
    import casadi

    state = casadi.MX.sym("state", states)
    others = [
        casadi.MX.sym(function.name_in(i), *function.size_in(i))
        for i in range(1, function.n_in())
    ]
    arguments = [state, *others]
    return casadi.Function(function.name(), arguments, [function(state[:n], *others)])


class _CheckedFunction:
    """A user's function of tensors, with parameters, whose values are checked."""

    def __init__(
        self,
        name: str,
        function: Any,
        count: int,
        parameters: Sequence[torch.Tensor],
    ):
        self._name = name
        self._function = function
        self._count = count
        self._parameters = parameters

    def __call__(self, *arguments: torch.Tensor) -> torch.Tensor:
        """Returns the values (rows, count)."""
        rows = len(arguments[0])
        parameters = [part.expand(rows, *part.shape[1:]) for part in self._parameters]
        value = call(self._name, self._function, *arguments, *parameters)
        is_tensor = isinstance(value, torch.Tensor)
        if not is_tensor or value.shape[:1] != (rows,):
            rule = f"{self._name} must give a tensor ({rows}, {self._count})"
            got = tuple(value.shape) if is_tensor else type(value).__name__
            raise ShapeError(f"{rule}; got {got}")
        if not value.is_floating_point():
            rule = f"{self._name} must give real numbers, below zero where it is kept"
            raise ShapeError(f"{rule}; got {value.dtype}")
        return value.unsqueeze(-1) if value.dim() == 1 else value


def _check_finite(
    name: str, expansion: Expansion, states: Array, inputs: Array
) -> None:
    """Raises ``FunctionNotFinite`` with the first point where a number is not."""
    if all(np.isfinite(part).all() for part in expansion):
        return
    for k in range(len(states)):
        if all(np.isfinite(part[k]).all() for part in expansion):
            continue
        x = np.array2string(states[k], precision=4, max_line_width=10**6)
        u = np.array2string(inputs[k], precision=4, max_line_width=10**6)
        rule = f"{name} or its gradient is not finite"
        raise FunctionNotFinite(f"{rule} at x = {x}, u = {u}")


_FLOAT64 = torch.empty(0, dtype=torch.float64)
_casadi_function = lru_cache(maxsize=64)(CasadiFunction)


def _count_arguments(function: Any) -> tuple[int, int]:
    """Returns how many arguments a function takes at least and at most."""
    try:
        return _count_once(function)
    except TypeError:  # such as of a callable dataclass, which has no hash
        return _count_once.__wrapped__(function)


@lru_cache(maxsize=256)
def _count_once(function: Any) -> tuple[int, int]:
    """Counts the arguments of a function that has a hash, once; see its caller."""
    if hasattr(function, "n_in"):
        return function.n_in(), function.n_in()
    if isinstance(function, torch.nn.Module):  # which by itself takes anything
        function = function.forward
    try:
        parameters = inspect.signature(function).parameters.values()
    except ValueError:  # such as torch.sin
        return 1, 1
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    positional = [p for p in parameters if p.kind in kinds]
    takes_any = any(p.kind is p.VAR_POSITIONAL for p in parameters)
    required = sum(p.default is p.empty for p in positional)
    if takes_any:
        return required, 3
    # A default other than None binds a constant, as in ``lambda x, c=c: x - c``: it
    # and those behind it are the function's own.
    is_own = [p.default is not p.empty and p.default is not None for p in positional]
    most = is_own.index(True) if True in is_own else len(positional)
    return required, most


def _weight(key: str, value: Any) -> Array:
    """Returns a weight from its diagonal or its matrix, or those of all stages."""
    weight = read_numbers(key, value, "the diagonal of a weight or a square matrix")
    if weight.ndim == 1:
        weight = np.diag(weight)
    if weight.ndim not in (2, 3) or weight.shape != weight.mT.shape:
        raise SettingError(key, f"{_WEIGHT_RULE}; got {value!r}")
    if not np.isfinite(weight).all():
        raise SettingError(key, f"must be finite; got {value!r}")
    largest = np.abs(weight).max(axis=(-2, -1), keepdims=True)
    sizes = np.sqrt(np.abs(np.diagonal(weight, axis1=-2, axis2=-1)))
    # No entry of a weight is larger than these, whatever the units of its states.
    largest_entries = sizes[..., :, None] * sizes[..., None, :]
    rounding = _PRODUCT_ROUNDING * largest_entries + np.finfo(float).eps * largest
    if (np.abs(weight - weight.mT) > rounding).any():
        raise SettingError(key, "must be symmetric")
    eigenvalues = np.linalg.eigvalsh(weight)
    lowest = eigenvalues.min()
    if (eigenvalues < -_PRODUCT_ROUNDING * largest[..., 0]).any():
        rule = "must be positive semidefinite"
        raise SettingError(key, f"{rule}; its smallest eigenvalue is {lowest:.3g}")
    return weight


def read_numbers(
    key: str, value: Any, rule: str = "a list of numbers, infinite where unbounded"
) -> Array:
    """Returns an array of its own from a list or an array that is not empty.

    Raises:
        SettingError: It is no list of numbers.
    """
    try:
        array = np.array(read_array(key, value), order="C")  # as kernels read them
    except DataError:
        array = np.empty(())
    if not (array.ndim and array.size):
        raise SettingError(key, f"must be {rule}; got {value!r}")
    return array
