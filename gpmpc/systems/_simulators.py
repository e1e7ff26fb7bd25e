"""Base of the systems of foreign simulators, which move on from where they stand."""

from importlib import import_module
from typing import Any

import numpy as np

from gpmpc.exceptions import SettingError

Array = np.ndarray


def library(name: str) -> Any:
    """Imports a library of the extra ``sim``.

    Raises:
        SettingError: It is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise SettingError(
            "system", f"needs {name}, which is not installed: pip install 'gpmpc[sim]'"
        ) from error


def numbers(x: Any, u: Any) -> tuple[Array, Array]:
    """Returns states and inputs as arrays.

    Raises:
        SettingError: They are no numbers.
    """
    try:
        return np.array(x, dtype=float), np.array(u, dtype=float)
    except (TypeError, ValueError, NotImplementedError) as error:
        remedy = "a simulator has no equations: take a controller on a learned model"
        raise SettingError("controller", remedy) from error


class Simulator:
    """Dynamics that a simulator steps from where it stands."""

    stateful = True  #: a step moves the simulator
    ended = False  #: whether the simulator has ended its episode
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()
    _now: Array | None = None

    def reset(self, seed: int) -> Array:
        """Starts an episode; returns its first state (n,)."""
        self._now = self._reset(seed)
        self.ended = False
        return self._now.copy()

    def successor(self, x: Any, u: Any) -> Array:
        """Returns the next state after a step from a state (n,) with an input (m,).

        ``SettingError`` where it does not stand in that state and cannot be set to it,
        or x and u are no numbers.
        """
        state, input = numbers(x, u)
        if state.ndim != 1:
            raise SettingError(
                "plant",
                "a simulator takes one step at a time; take closed_loop for each seed",
            )
        if (
            self._now is None or not np.array_equal(state, self._now)
        ) and not self._set(state):
            raise SettingError(
                "system",
                "this simulator cannot be set to a state: it takes no process noise "
                "and starts where it starts",
            )
        self._now, self.ended = self._step(input)
        return self._now.copy()

    def _reset(self, seed: int) -> Array:
        raise NotImplementedError

    def _step(self, input: Array) -> tuple[Array, bool]:
        """The next state, and whether the episode has ended."""
        raise NotImplementedError

    def _set(self, state: Array) -> bool:
        """Sets the simulator to a state; returns whether it can be."""
        return False
