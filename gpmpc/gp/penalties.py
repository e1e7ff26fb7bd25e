"""Problem: keep hyperparameters where the data say little about them within what double precision can bear."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpmpc.exceptions import SettingError, check_number


class Penalty(Protocol):
    """What is added to an output's negative log marginal likelihood."""

    def __call__(self, theta: np.ndarray, log_spread: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and gradient (d + 2,) at theta, given log std of the inputs (d,)."""


@dataclass(frozen=True)
class SoftLimits:
    """Length-scales near the data's spread and a signal-to-noise ratio that double precision can bear, as soft walls.

    ((log l_d - log std(x~_d)) / log r)^p summed over d, and (log(sf / sn) / log s)^p; the penalties of PILCO
    (Deisenroth, 2010) and of the experiment of Cao, Lai and Alam (2017). Nearly flat inside, steep outside.

    Attributes:
        lengthscale_factor: r, how far a length-scale may be from the spread of its input.
        signal_to_noise: s, how large sf / sn may be.
        power: p, even.
    """

    lengthscale_factor: float = 100.0
    signal_to_noise: float = 1000.0
    power: int = 30

    def __post_init__(self) -> None:
        for key in ("lengthscale_factor", "signal_to_noise"):
            check_number(key, getattr(self, key), above=1)
        check_number("power", self.power, least=2, whole=True)
        if self.power % 2:
            raise SettingError("power", f"must be even; got {self.power}")

    def __call__(self, theta: np.ndarray, log_spread: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and gradient (d + 2,) at theta."""
        width = np.full(len(theta), np.log(self.lengthscale_factor))
        width[-1] = np.log(self.signal_to_noise)
        position = np.append(theta[:-2] - log_spread, [0.0, theta[-1]]) / width
        return (position**self.power).sum(), self.power * position ** (self.power - 1) / width
