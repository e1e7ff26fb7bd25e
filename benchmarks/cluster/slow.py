"""Disturbances that change no number, and take time or memory: for acts of clusters."""

import os
import time
from dataclasses import dataclass

import numpy as np

from gpmpc.systems import System

SLOW = "GPMPC_SLOW"  # variable: seconds that every step takes


@dataclass(frozen=True)
class Slow:
    """Takes as long as the environment says, each step."""

    def disturb_plant(self, plant: System, time_of_step: float) -> System:
        """Returns the plant, later."""
        time.sleep(float(os.environ.get(SLOW, "0")))
        return plant

    def disturb_measurement(self, state: np.ndarray, time_of_step: float) -> np.ndarray:
        """Returns the state."""
        return state


@dataclass(frozen=True)
class Hungry(Slow):
    """Takes memory besides.

    Args:
        gigabytes: How much.
    """

    gigabytes: float = 3.0

    def disturb_plant(self, plant: System, time_of_step: float) -> System:
        """Returns the plant, after a while with much memory."""
        memory = np.ones(int(self.gigabytes * 2**27))
        time.sleep(20.0 * memory[-1])
        return plant


@dataclass(frozen=True)
class Stuck(Slow):
    """Takes ten minutes a step."""

    def disturb_plant(self, plant: System, time_of_step: float) -> System:
        """Returns the plant, much later."""
        time.sleep(600.0)
        return plant
