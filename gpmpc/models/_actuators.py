"""Inputs that act late: by whole rows, and through first-order lags.

v[k] = u[k - D],    a' = (v - a) / T,    mean of a over a step = what acts in it
"""

from typing import Any, NamedTuple

import numpy as np

from gpmpc._dynamics import Array


class FirstOrderLags(NamedTuple):
    """First-order lags that are discretised exactly for inputs that are held."""

    decay: Array  # of the distance to the input in a step (m,)
    mean: Array  # weight of the input in the mean over a step (m,)

    @classmethod
    def of(cls, time_constants: Any, time_step: float) -> "FirstOrderLags":
        """Discretises lags of time constants [s] (..., m); zero is no lag."""
        ratio = time_step / np.maximum(np.asarray(time_constants), 1e-6 * time_step)
        decay = np.exp(-ratio)
        return cls(decay, 1 - (1 - decay) / ratio)

    def acting(self, lagged: Array, inputs: Array) -> Array:
        """Returns the mean (..., m) over the step in which inputs are held."""
        return lagged + self.mean * (inputs - lagged)

    def after(self, lagged: Array, inputs: Array) -> Array:
        """Returns a[k+1] (..., m)."""
        return inputs + self.decay * (lagged - inputs)

    def filter(self, inputs: Array) -> tuple[Array, Array]:
        """Runs along rows of inputs, from rest at the first one.

        Args:
            inputs: (..., P, m).

        Returns:
            What acts in each row (..., P, m), and a after the last one (..., m).
        """
        lagged = inputs[..., 0, :]
        acting = []
        for k in range(inputs.shape[-2]):
            command = inputs[..., k, :]
            acting.append(self.acting(lagged, command))
            lagged = self.after(lagged, command)
        if not acting:
            return inputs, lagged
        return np.stack(acting, axis=-2), lagged
