"""Costs: weighed squares of the tracking error, of the inputs, and of outputs that are linearised along a plan.

Outputs are linearised in z = [x_i; u_{i-1}], y(z') + J (z - z'), so that a step is one of Gauss-Newton. To a stage
they add the square [z; 1]' Z [z; 1], where Z = [J, e]' W [J, e] and e = y(z') - J z' - c.
"""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch

from gpmpc._arrays import read_array
from gpmpc._functions import call
from gpmpc.exceptions import DataError, SettingError, ShapeError, check_choice
from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._nominal import linearize_function

Array = np.ndarray

Penalized = Literal["inputs", "deviations", "increments"]
PENALIZED = ("inputs", "deviations", "increments")


@dataclass(frozen=True)
class Tracking:
    """Costs of the distance to a reference and of the inputs.

    Raises:
        SettingError: A weight is not symmetric positive semidefinite, R is zero in a direction, or a length is wrong.
    """

    Q: Any  #: state weights, the diagonal (n,) or the matrix (n, n); matrices (H, n, n) by stage
    R: Any  #: input weights, likewise (m,), (m, m) or (H, m, m), positive definite
    terminal: Any = None  #: weight of the last predicted state, one like Q; Q itself (its last one) by default
    #: what R weighs: ``"inputs"``, ``"deviations"`` from the reference inputs, or ``"increments"``
    penalized: Penalized = "increments"
    #: indices of states whose error is modulo 2 pi: their references move by full turns towards the plan; None for none
    angles: Sequence[int] = ()

    def __post_init__(self) -> None:
        Q = _weight("Q", self.Q)
        R = _weight("R", self.R)
        lowest = np.linalg.eigvalsh(R).min()
        n = Q.shape[-1]
        if lowest <= 0:
            raise SettingError(
                "R",
                f"must be positive definite; its smallest eigenvalue is {lowest:.3g}",
            )
        terminal = (
            Q.reshape(-1, n, n)[-1]
            if self.terminal is None
            else _weight("terminal", self.terminal)
        )
        if terminal.shape != (n, n):
            raise SettingError(
                "terminal", f"must be a weight of {n} states; got {len(terminal)}"
            )
        check_choice("penalized", self.penalized, PENALIZED)
        angles = tuple(self.angles or ())
        if not all(isinstance(index, int) and 0 <= index < n for index in angles):
            raise SettingError(
                "angles", f"must be indices of {n} states; got {self.angles!r}"
            )
        for key, value in (
            ("Q", Q),
            ("R", R),
            ("terminal", terminal),
            ("angles", angles),
        ):
            object.__setattr__(self, key, value)

    def by_stage(self, horizon: int) -> tuple[Array, Array]:
        """Returns the weights of x_1 .. x_H (H, n, n), the last one the terminal one, and of v_0 .. v_{H-1} (H, m, m).

        Raises:
            SettingError: They are for another number of stages.
        """
        Q = by_stage("Q", self.Q, horizon, 2)
        R = by_stage("R", self.R, horizon, 2)
        return np.concatenate([Q[:-1], self.terminal[None]]), R


@dataclass(frozen=True)
class LeastSquares:
    """Costs of outputs y(x, u, p), weighed squares of how far they are from their references.

    Raises:
        SettingError: y is no function, the weight is not symmetric positive semidefinite, or a length is wrong.
    """

    #: a function of tensors, states (H, n), inputs (H, m) and, where the controller is handed ``parameters``, these (H,
    #: q), that gives (H, d), each row of its own stage; or a CasADi function of vectors. It may take fewer: the states,
    #: or states and inputs
    y: Any
    weight: Any  #: W, the diagonal (d,) or the matrix (d, d); matrices (H, d, d) by stage, zero where y costs nothing
    reference: Any = None  #: c (d,), or (H, d) by stage; zero by default

    def __post_init__(self) -> None:
        if not callable(self.y):
            raise SettingError("y", f"must be a function; got {type(self.y).__name__}")
        weight = _weight("weight", self.weight)
        reference = (
            np.zeros(weight.shape[-1])
            if self.reference is None
            else np.array(read_array("reference", self.reference))
        )
        fits = reference.ndim in (1, 2) and reference.shape[-1] == weight.shape[-1]
        if not (fits and np.isfinite(reference).all()):
            raise SettingError(
                "reference",
                f"must be {weight.shape[-1]} finite numbers, or these by stage",
            )
        object.__setattr__(self, "weight", weight)
        object.__setattr__(self, "reference", reference)

    def squares(self, states: Array, inputs: Array, parameters: Array | None) -> Array:
        """Returns the squares Z (H, n + m + 1, n + m + 1) along a plan x_1 .. x_H, u_0 .. u_{H-1}; see the module."""
        y, J, K = expand_function(
            "y", self.y, self.weight.shape[-1], states, inputs, parameters
        )
        e = (
            y
            - self.reference
            - np.einsum("kri,ki->kr", J, states)
            - np.einsum("kri,ki->kr", K, inputs)
        )
        rows = np.concatenate([J, K, e[..., None]], axis=2)
        return rows.mT @ self.weight @ rows


def by_stage(key: str, values: Array, horizon: int, dims: int) -> Array:
    """Returns values of every stage, given of every stage (H of them) or of one (whose array has ``dims`` axes)."""
    if values.ndim > dims and len(values) != horizon:
        raise SettingError(
            key, f"must be given for one stage or all {horizon}; got {len(values)}"
        )
    return np.ascontiguousarray(
        np.broadcast_to(values, (horizon, *values.shape[values.ndim - dims :]))
    )


class FunctionNotFinite(DataError):
    """A constraint, an output of the cost, or its gradient is not finite along a plan."""


def expand_function(
    name: str,
    function: Any,
    count: int,
    states: Array,
    inputs: Array,
    parameters: Array | None,
) -> tuple[Array, Array, Array]:
    """Returns a function's values (H, count) along a plan, and its derivatives (H, count, n) and (H, count, m).

    Raises ``FunctionNotFinite`` where one is not.
    """
    least, most = _arguments(function)
    arguments = [states, inputs] if parameters is None else [states, inputs, parameters]
    if len(arguments) < least:
        raise SettingError(
            "parameters", f"must come with every call: {name} is a function of them"
        )
    if hasattr(function, "n_in"):
        values, *jacobians = _casadi_function(function).linearize(*arguments[:most])
    else:
        known = [torch.as_tensor(argument) for argument in arguments[2:most]]

        def stacked(*at: torch.Tensor) -> torch.Tensor:
            rows = len(at[0])
            of_rows = [part.expand(rows, *part.shape[1:]) for part in known]
            value = call(name, function, *at, *of_rows)
            if not isinstance(value, torch.Tensor) or value.shape[:1] != (rows,):
                found = (
                    tuple(value.shape)
                    if isinstance(value, torch.Tensor)
                    else type(value).__name__
                )
                raise ShapeError(
                    f"{name} must give a tensor ({rows}, {count}); got {found}"
                )
            return value.unsqueeze(-1) if value.dim() == 1 else value

        values, *jacobians = linearize_function(
            stacked, _FLOAT64, *arguments[: min(most, 2)]
        )
    if values.shape != (len(states), count):
        raise ShapeError(
            f"{name} must give ({len(states)}, {count}); got {values.shape}"
        )
    by_state, by_input = [*jacobians, np.zeros((len(states), count, inputs.shape[1]))][
        :2
    ]
    found = values, by_state, by_input
    if not all(np.isfinite(part).all() for part in found):
        k = next(
            k
            for k in range(len(states))
            if not all(np.isfinite(part[k]).all() for part in found)
        )
        x, u = (
            np.array2string(row[k], precision=4, max_line_width=10**6)
            for row in (states, inputs)
        )
        raise FunctionNotFinite(
            f"{name} or its gradient is not finite at x = {x}, u = {u}"
        )
    return values, by_state, by_input


_FLOAT64 = torch.empty(0, dtype=torch.float64)
_casadi_function = lru_cache(maxsize=64)(CasadiFunction)


@lru_cache(maxsize=256)
def _arguments(function: Any) -> tuple[int, int]:
    """How many arguments a function takes at least and at most."""
    if hasattr(function, "n_in"):
        return function.n_in(), function.n_in()
    try:
        found = inspect.signature(function).parameters.values()
    except ValueError:  # such as torch.sin
        return 1, 1
    positional = [
        p for p in found if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
    ]
    most = 3 if any(p.kind is p.VAR_POSITIONAL for p in found) else len(positional)
    return sum(p.default is p.empty for p in positional), most


def _weight(key: str, value: Any) -> Array:
    """A weight from its diagonal or its matrix, or from those of all stages."""
    weight = read_numbers(key, value, "the diagonal of a weight or a square matrix")
    weight = np.diag(weight) if weight.ndim == 1 else weight
    if weight.ndim not in (2, 3) or weight.shape != weight.mT.shape:
        raise SettingError(
            key, f"must be the diagonal of a weight or a square matrix; got {value!r}"
        )
    if not np.isfinite(weight).all():
        raise SettingError(key, f"must be finite; got {value!r}")
    if not np.allclose(weight, weight.mT, rtol=1e-12, atol=0):
        raise SettingError(key, "must be symmetric")
    lowest = np.linalg.eigvalsh(weight).min()
    if lowest < -1e-12 * max(1.0, np.abs(weight).max()):
        raise SettingError(
            key,
            f"must be positive semidefinite; its smallest eigenvalue is {lowest:.3g}",
        )
    return weight


def read_numbers(
    key: str, value: Any, rule: str = "a list of numbers, infinite where unbounded"
) -> Array:
    """An array from a list."""
    try:
        array = np.array(read_array(key, value))
    except DataError:
        array = np.empty(())
    if not (array.ndim and array.size):
        raise SettingError(key, f"must be {rule}; got {value!r}")
    return array
