"""Disturbances that change no number, and take time or memory: for acts of clusters."""

import os
import time
from dataclasses import dataclass

import numpy as np

from gpmpc.systems import System

SLOW = "GPMPC_SLOW"  # variable: seconds that every step takes
_JOB = "SLURM_JOB_ID"  # variable that Slurm sets in a job


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
    """Takes memory besides, in a job.

    (Before a sweep is launched, its driver looks at the disturbances.)

    Args:
        gigabytes: How much.
    """

    gigabytes: float = 3.0

    def disturb_plant(self, plant: System, time_of_step: float) -> System:
        """Returns the plant, after a while with much memory."""
        if _JOB not in os.environ:
            return plant
        memory = np.ones(int(self.gigabytes * 2**27))
        time.sleep(20.0 * memory[-1])
        return plant


@dataclass(frozen=True)
class Stuck(Slow):
    """Takes ten minutes a step, in a job."""

    def disturb_plant(self, plant: System, time_of_step: float) -> System:
        """Returns the plant, much later."""
        time.sleep(600.0 if _JOB in os.environ else 0.0)
        return plant
