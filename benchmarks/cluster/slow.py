"""Disturbances that change no number, and wait or take memory, for acts of clusters."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpmpc.systems import System

HOLD = "GPMPC_HOLD"  # variable: a file; while it is there, no step ends
_JOB = "SLURM_JOB_ID"  # variable that Slurm sets in a job


@dataclass(frozen=True)
class Slow:
    """Waits at each step while a file is there, which the environment names.

    (That of the driver names none: it looks at the disturbances, too.)
    """

    def disturb_plant(self, plant: System, time_of_step: float) -> System:
        """Returns the plant, later."""
        hold = os.environ.get(HOLD)
        while hold and Path(hold).exists():
            time.sleep(0.1)
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
