"""Disturbances: wind, another payload, a sensor that drops out.

A disturbance says, step by step, which plant really acts and what is really measured.
Times are those at which a step begins: a window that opens within a step acts from the
next one on.

To add one: a subclass of ``_Window``, or of ``Disturbance`` where it has no window;
named in ``gpmpc.simulation`` and, for files of settings, in ``gpmpc._trust``. What acts
on the *input* has no method yet: it would be called in ``PlantSimulator._noisy_input``,
which would have to be told the time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel, check_number
from gpmpc.systems import System

_ROUNDING = 1e-9  # [s], to which a loop rounds its times


class Disturbance(Protocol):
    """Something that a controller does not know of.

    See Also:
        ``Gust``, ``Dropout`` and ``Replaced``, which are some.
    """

    def disturb_plant(self, plant: System, time: float) -> System:
        """Returns the plant that acts in the place of another, from a time [s] on.

        It acts for one step.
        """
        return plant

    def disturb_measurement(self, state: np.ndarray, time: float) -> np.ndarray:
        """Returns what is measured at a time [s] in the place of a state (n,)."""
        return state


class _Window(Disturbance):
    """A disturbance from ``start`` to ``stop`` [s]."""

    start: float
    stop: float

    def __post_init__(self) -> None:
        check_number("start", self.start, unit="[s]")
        if self.stop != inf:
            check_number("stop", self.stop, above=self.start, unit="[s]")

    def acts(self, time: float) -> bool:
        """Whether it acts in the step from a time [s] on, but for rounding."""
        return self.start - _ROUNDING <= time < self.stop - _ROUNDING


@explains_arguments
@dataclass(frozen=True)
class Gust(_Window):
    """A constant push on single states over a time window.

    The plant integrates it like any other force. Where the dynamics give the next
    state, rate times time step is added to that.

    >>> Gust({"vx": 0.5}, start=20.0, stop=40.0).rates
    {'vx': 0.5}
    """

    #: what is added to the derivative of a state, by its name: ``{"vx": 2.0}`` is an
    #: acceleration of 2 m/s^2, the force over the mass [unit of the state / s]
    rates: Mapping[str, float]
    start: float = 0.0  #: when it begins [s]
    stop: float = inf  #: when it ends [s]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.rates, Mapping) or not self.rates:
            rule = "must map names of states to numbers, like {'vx': 2.0}"
            raise SettingError("rates", f"{rule}; got {self.rates!r}")
        for name, rate in self.rates.items():
            check_number(f"rates.{name}", rate)

    def disturb_plant(self, plant: System, time: float) -> System:
        """Returns the plant with the push, inside the window.

        Raises:
            SettingError: The plant has no such state.
            UnsupportedModel: It has no equations.
        """
        for name in self.rates:
            if name not in plant.state_names:
                names = ", ".join(plant.state_names)
                raise SettingError(
                    "rates", f"must name states of the plant, {names}; got {name!r}"
                )
        if plant.stateful:
            raise UnsupportedModel(
                "a gust needs equations, which a simulator has not. "
                "Possible with any plant: Replaced"
            )
        if not self.acts(time):
            return plant
        rates = [float(self.rates.get(name, 0.0)) for name in plant.state_names]
        return _pushed(plant, tuple(rates))


@explains_arguments
@dataclass(frozen=True)
class Replaced(_Window):
    """Another plant over a time window: another mass, a broken arm.

    It takes the place of all that acts by then: gusts, and what else changes the plant,
    are to stand after it in the list of disturbances.

    >>> from gpmpc.systems import pendulum
    >>> heavier = Replaced(pendulum(mass=1.5), start=2.0)

    See Also:
        ``Gust`` and ``Dropout``; ``closed_loop(..., disturbances=[...])`` takes
        them.
    """

    plant: System  #: what acts then
    start: float = 0.0  #: when it begins [s]
    stop: float = inf  #: when it ends [s]

    def disturb_plant(self, plant: System, time: float) -> System:
        """Returns the other plant, inside the window.

        Raises:
            ShapeError: It has other states, inputs or another time step.
        """
        if plant.signals != self.plant.signals:
            raise ShapeError(
                "a plant must be replaced by one of the same states, inputs, step "
                f"{plant.signals}; got {self.plant.signals}"
            )
        return self.plant if self.acts(time) else plant


@explains_arguments
@dataclass(frozen=True)
class Dropout(_Window):
    """Nothing is measured over a time window: entries of the state are NaN.

    A controller is called with whole measurements alone: where any entry is missing the
    policy for failures decides, so a filter within a controller sees none of the step.

    >>> Dropout(start=1.0, stop=1.5, entries=[0]).entries
    (0,)

    See Also:
        ``Gust`` and ``Replaced``; ``closed_loop(..., disturbances=[...])``
        takes them.
    """

    start: float  #: when it begins [s]
    stop: float  #: when it ends [s]
    #: which ones, from 0; all by default. Without position, for one: 0 to 5 of a
    #: ``Coupled`` plant
    entries: Sequence[int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.entries is None:
            return
        entries = np.asarray(self.entries).tolist()
        if not isinstance(entries, list) or not entries:
            rule = "must be a list of indices of states, or None for all of them"
            raise SettingError("entries", f"{rule}; got {self.entries!r}")
        for entry in entries:
            check_number("entries", entry, least=0, whole=True)
        object.__setattr__(self, "entries", tuple(entries))

    def disturb_plant(self, plant: System, time: float) -> System:
        """Returns the plant.

        Raises:
            SettingError: It has no such entry.
        """
        n = len(plant.state_names)
        for entry in self.entries or ():
            if entry >= n:
                raise SettingError(
                    "entries", f"must be indices of states, 0 to {n - 1}; got {entry!r}"
                )
        return plant

    def disturb_measurement(self, state: np.ndarray, time: float) -> np.ndarray:
        """Returns NaN inside the window."""
        if not self.acts(time):
            return state
        measured = state.copy()
        if self.entries is None:
            measured[:] = np.nan
        else:
            measured[list(self.entries)] = np.nan
        return measured


@lru_cache(maxsize=8)
def _pushed(plant: System, rates: tuple[float, ...]) -> System:
    """Returns a plant with constant rates (n,) added to its equations.

    They are added to its right-hand side; over a time step to its next state.
    """
    dynamics = plant.dynamics
    method = "successor" if hasattr(dynamics, "successor") else "derivative"
    function = getattr(dynamics, method)
    duration = plant.time_step if method == "successor" else 1.0
    changes = [rate * duration for rate in rates]

    def pushed(x: Any, u: Any) -> list[Any]:
        entries = zip(function(x, u), changes, strict=True)
        return [entry + change for entry, change in entries]

    pushed_dynamics = SimpleNamespace(
        state_names=plant.state_names, input_names=plant.input_names
    )
    setattr(pushed_dynamics, method, pushed)
    return replace(plant, dynamics=pushed_dynamics)
