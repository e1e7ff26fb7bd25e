"""A system with named parameters as the nominal model of a log.

    y = (successor(x, u) - x) / time step

so that ``Increments`` move a state exactly as the system does.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from inspect import Parameter, signature
from typing import Any

import numpy as np

from gpmpc._angles import wrap
from gpmpc._dynamics import Array
from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.models._namings import NO_NAMINGS, Namings, order_by_name
from gpmpc.systems import System

_TIME_STEP = "time_step"  # argument of factories that is no parameter
_SHORT_STEP = 0.01  # [s] of a substep of the integration, about
_MOST_SUBSTEPS = 10
_KEPT = 100  # systems, of the parameters that were tried last
_ALIKE = 1e-9  # between two ways to the same outputs
_DISPLACED = 0.07  # part of a parameter by which it moves where they are compared


@dataclass(frozen=True)
class FittedParameter:
    """A parameter that is fitted, and where.

    Raises:
        SettingError: ``start`` does not lie between the bounds, or these are one.
    """

    name: str
    start: float
    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self) -> None:
        if not self.low <= self.start <= self.high:
            raise SettingError(
                f"nominal.parameters.{self.name}",
                f"must start between {self.low:g} and {self.high:g}; "
                f"got {self.start:g}",
            )
        if self.low == self.high:
            raise SettingError(
                f"nominal.parameters.{self.name}",
                f"must have a low below its high, or stand under fixed; got "
                f"{self.low:g} twice",
            )


@dataclass(frozen=True, eq=False)
class SystemNominal:
    """The outputs of a system, as rates of change of the states of a log.

    Raises:
        SettingError: The system cannot be made, or has other states and inputs.
    """

    #: class or function that makes the dynamics, or a ``System``, of its parameters
    factory: Callable[..., Any]
    code: str  #: by which a file names it, such as "my_robot:Arm"
    fitted: tuple[FittedParameter, ...]
    time_step: float  #: of the log [s]
    state_names: tuple[str, ...]  #: of the log (n,)
    input_names: tuple[str, ...]  #: of the log (m,)
    fixed: Mapping[str, Any] = field(default_factory=dict)  #: its other arguments
    namings: Namings = NO_NAMINGS  #: other names of these states and inputs

    def __post_init__(self) -> None:
        for kind, own, names in (
            ("states", self._system.state_names, self.state_names),
            ("inputs", self._system.input_names, self.input_names),
        ):
            if len(own) != len(names):
                raise SettingError(
                    "nominal",
                    f"{self.code} has the {kind} {', '.join(own)}; "
                    f"the log has {', '.join(names)}",
                )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters (P,)."""
        return tuple(parameter.name for parameter in self.fitted)

    @property
    def start(self) -> Array:
        """Parameters at which a fit begins (P,)."""
        return np.array([parameter.start for parameter in self.fitted], dtype=float)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Smallest and largest parameters (P,), (P,)."""
        low = np.array([parameter.low for parameter in self.fitted], dtype=float)
        high = np.array([parameter.high for parameter in self.fitted], dtype=float)
        return low, high

    @property
    def settings(self) -> dict[str, Any]:
        """What a file holds of it; an infinite bound is None.

        The states and inputs of the log are called as the system calls them, so that
        what is read from the file takes them as the fit did.
        """
        finite = [
            [
                parameter.name,
                parameter.start,
                *(
                    v if np.isfinite(v) else None
                    for v in (parameter.low, parameter.high)
                ),
            ]
            for parameter in self.fitted
        ]
        return {
            "code": self.code,
            "fitted": finite,
            "fixed": dict(self.fixed),
            "states": _placed(self._system.state_names, self._state_order),
            "inputs": _placed(self._system.input_names, self._input_order),
        }

    def outputs(
        self, theta: Any, states: Array, inputs: Array, context: Array
    ) -> Array:
        """Computes the rates of change (..., n) at states (..., n)."""
        parameters = [np.asarray(value, dtype=float) for value in theta]
        if all(value.ndim == 0 for value in parameters):
            return self._rates_of_rows(self._system_of(parameters), states, inputs)
        if self._takes_arrays:
            return self._rates(self._with_arrays(parameters), states, inputs)
        return self._outputs_one_by_one(parameters, states, inputs)

    @cached_property
    def _system(self) -> System:
        return self._system_of(self.start.tolist())

    @cached_property
    def _state_order(self) -> list[int]:
        """Where each state of the system stands in the log."""
        namings = (self.state_names, *self.namings.states)
        return _order(self._system.state_names, namings)

    @cached_property
    def _input_order(self) -> list[int]:
        namings = (self.input_names, *self.namings.inputs)
        return _order(self._system.input_names, namings)

    def _system_of(self, values: Sequence[Any]) -> System:
        """Makes the system of parameters, by its factory; the last ones are kept."""
        key = tuple(map(float, values))
        if key not in self._systems:
            parameters = dict(zip(self.parameter_names, key, strict=True))
            arguments = {**self.fixed, **parameters}
            if len(self._systems) >= _KEPT:
                self._systems.clear()
            self._systems[key] = make_system(
                self.factory, self.code, arguments, self.time_step
            )
        return self._systems[key]

    @cached_property
    def _systems(self) -> dict[tuple[float, ...], System]:
        return {}

    def _with_arrays(self, values: Sequence[Array]) -> System:
        """Puts arrays into the place of the system's parameters."""
        dynamics = copy.copy(self._system.dynamics)
        for name, value in zip(self.parameter_names, values, strict=True):
            object.__setattr__(dynamics, name, value)
        system = copy.copy(self._system)
        object.__setattr__(system, "dynamics", dynamics)
        return system

    @cached_property
    def _takes_arrays(self) -> bool:
        """Whether the dynamics only use their parameters, and nothing derived of them.

        Otherwise, each vector of parameters makes a system of its own.
        """
        attributes = [hasattr(self._system.dynamics, n) for n in self.parameter_names]
        if not all(attributes):
            return False
        states = np.linspace(0.1, 0.7, len(self.state_names))[None, None]
        inputs = np.linspace(0.2, 0.5, len(self.input_names))[None, None]
        columns = [column[:, None] for column in self._displaced_one_by_one().T]
        try:
            together = self._rates(self._with_arrays(columns), states, inputs)
            by_factory = self._outputs_one_by_one(columns, states, inputs)
        except Exception:  # whatever dynamics raise that take one number only
            return False
        return np.allclose(together, by_factory, rtol=_ALIKE, atol=_ALIKE)

    def _displaced_one_by_one(self) -> Array:
        """Returns the start with one parameter moved in each row (P, P).

        Moved together, what is derived of two may stay: a ratio. Each moves away from
        a bound that it starts on.
        """
        low, high = self.bounds
        length = _DISPLACED * np.abs(self.start) + 1e-3
        above = np.minimum(self.start + length, high)
        below = np.maximum(self.start - length, low)
        is_room_above = high - self.start >= self.start - low
        rows = np.tile(self.start, (len(self.start), 1))
        np.fill_diagonal(rows, np.where(is_room_above, above, below))
        return rows

    def _outputs_one_by_one(
        self, parameters: Sequence[Array], states: Array, inputs: Array
    ) -> Array:
        """Computes the outputs for each entry of the parameters' first axis.

        They are NaN where the factory refuses the values.
        """
        shapes = [value.shape for value in parameters]
        batch = np.broadcast_shapes(*shapes, states.shape[:-1], inputs.shape[:-1])
        states = np.broadcast_to(states, (*batch, states.shape[-1]))
        inputs = np.broadcast_to(inputs, (*batch, inputs.shape[-1]))
        outputs = np.full(states.shape, np.nan)
        for row in range(batch[0]):
            values = [float(value[row].flat[0]) for value in parameters]
            try:
                system = self._system_of(values)
            except GpmpcError:
                continue
            outputs[row] = self._rates_of_rows(system, states[row], inputs[row])
        return outputs

    def _rates_of_rows(self, system: System, states: Array, inputs: Array) -> Array:
        """Computes the rates of change (..., n), of all rows in one table.

        A simulator steps a table (K, n), and no other batch.
        """
        inputs = np.broadcast_to(inputs, (*states.shape[:-1], inputs.shape[-1]))
        rows = self._rates(
            system,
            states.reshape(-1, states.shape[-1]),
            inputs.reshape(-1, inputs.shape[-1]),
        )
        return rows.reshape(states.shape)

    def _rates(self, system: System, states: Array, inputs: Array) -> Array:
        """Computes the rates of change (..., n) of a system."""
        x = [states[..., i] for i in self._state_order]
        u = [inputs[..., i] for i in self._input_order]
        after = system.successor(x, u)
        # a derivative does not wrap its angles; a user's successor may
        wraps = not hasattr(system.dynamics, "derivative")
        rates: list[Any] = [None] * len(x)
        for entry, (now, then) in enumerate(zip(x, after, strict=True)):
            change = then - now
            if wraps and entry in system.angle_indices:
                change = wrap(change)
            rates[self._state_order[entry]] = change / self.time_step
        return np.stack(np.broadcast_arrays(*rates), axis=-1)


def make_system(
    factory: Callable[..., Any],
    code: str,
    arguments: Mapping[str, Any],
    time_step: float,
) -> System:
    """Makes a system of the dynamics, or the ``System``, that a factory returns.

    Raises:
        SettingError: It does not return one, or refuses its arguments.
    """
    if _TIME_STEP in signature(factory).parameters:
        arguments = {**arguments, _TIME_STEP: time_step}
    try:
        product = factory(**arguments)
    except GpmpcError:
        raise
    except Exception as error:  # whatever a user's code raises
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise SettingError("nominal", f"{code} cannot be made ({reason})") from error
    if not isinstance(product, System):
        substeps = min(max(round(time_step / _SHORT_STEP), 1), _MOST_SUBSTEPS)
        return System(product, time_step, substeps)
    if product.stateful:
        raise SettingError("nominal", f"{code} is a simulator that moves on by itself")
    if not np.isclose(product.time_step, time_step, rtol=1e-6):
        raise SettingError(
            "nominal",
            f"{code} has a time step of {product.time_step:g} s, and the log one of "
            f"{time_step:g} s; give it an argument {_TIME_STEP}",
        )
    return product


def numeric_arguments(factory: Callable[..., Any], code: str) -> dict[str, float]:
    """Returns the arguments of a factory that have a number as default, with it.

    Of a function that hands on further keywords, also the numbers that its dynamics
    have as attributes.
    """
    parameters = signature(factory).parameters
    defaults = {
        name: float(parameter.default)
        for name, parameter in parameters.items()
        if name != _TIME_STEP and _is_number(parameter.default)
    }
    kinds = {parameter.kind for parameter in parameters.values()}
    if Parameter.VAR_KEYWORD in kinds:
        product = factory()
        dynamics = product.dynamics if isinstance(product, System) else product
        attributes = getattr(dynamics, "__dict__", {})
        numbers = {k: float(v) for k, v in attributes.items() if _is_number(v)}
        defaults |= numbers
    return defaults


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def usual_bounds(
    factory: Callable[..., Any],
    code: str,
    arguments: Mapping[str, Any],
    name: str,
    time_step: float,
) -> tuple[float, float]:
    """Returns bounds of a parameter: zero below, where a negative one is refused."""
    value = arguments[name]
    check_number(f"nominal.parameters.{name}", value)
    negative = -abs(value) if value else -1.0
    try:
        make_system(factory, code, {**arguments, name: negative}, time_step)
    except GpmpcError:
        return (1e-6 * abs(value), np.inf)
    return (-np.inf, np.inf)


def _order(own: Sequence[str], namings: Sequence[Sequence[str]]) -> list[int]:
    """Returns where each own name stands in the log: by name, or else as they stand."""
    order = order_by_name(own, namings)
    return list(range(len(own))) if order is None else order


def _placed(own: Sequence[str], order: Sequence[int]) -> list[str]:
    """Returns own names in the order of the log."""
    names = [""] * len(own)
    for name, place in zip(own, order, strict=True):
        names[place] = name
    return names
