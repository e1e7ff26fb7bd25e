"""What a model of a log remembers of the rows before the present one.

An actuator, a filter or an estimator lies between an input and what is measured of its
effect, so that one row does not say where a system goes. A memory is a linear filter of
the past features z and outputs y of a model: features of the last rows, and exponential
means of features and of outputs,

    s[k] = (z[k-1], .., z[k-p], e[k]),     e[k+1] = a e[k] + (1 - a) (z or y)[k],

a filter bank of fixed poles (Heuberger, Van den Hof and Wahlberg, 2005). All of it is
known from what was measured, so that nothing has to be estimated; in a rollout it is
filled with what is predicted. Means of outputs are what a disturbance is estimated by.
"""

from dataclasses import dataclass

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError, check_number


@dataclass(frozen=True)
class Memory:
    """A filter bank over d features and o outputs.

    Raises:
        SettingError: A number of rows is negative, or a decay is not within [0, 1).
    """

    rows: int = 0  #: p, of which the features are remembered as they were
    #: a of each exponential mean of the features; a mean reaches over 1 / (1 - a) rows
    decays: tuple[float, ...] = ()
    output_decays: tuple[float, ...] = ()  #: likewise of the outputs

    def __post_init__(self) -> None:
        check_number("rows", self.rows, least=0, whole=True)
        for decay in (*self.decays, *self.output_decays):
            if not 0 <= decay < 1:
                raise SettingError("decays", f"must be within [0, 1); got {decay}")

    @property
    def copies(self) -> int:
        """Number of copies of the features that are remembered."""
        return self.rows + len(self.decays)

    @property
    def empty(self) -> bool:
        """Whether nothing is remembered."""
        return not self.copies and not self.output_decays

    @property
    def reach(self) -> int:
        """Number of rows from which it is filled; older ones hardly count."""
        if self.empty:
            return 0
        slowest = max((*self.decays, *self.output_decays, 0.0))
        return max(self.rows, round(2 / (1 - slowest)))

    def dim(self, features: int, outputs: int) -> int:
        """Returns the number of remembered numbers, for d features and o outputs."""
        return self.copies * features + len(self.output_decays) * outputs

    def regressor_dim(self, features: int, outputs: int) -> int:
        """Returns the number of regressors (see ``regressors``)."""
        return features + self.dim(features, outputs) + 1

    def begin(self, features: Array, outputs: Array) -> Array:
        """Fills the memory with measured rows; means begin at the first one.

        Args:
            features: Of the rows before the present one (..., P, d), P of one or more.
            outputs: Likewise (..., P, o).

        Returns:
            What is remembered at the row after them (..., s).
        """
        P = features.shape[-2]
        parts = []
        for row in range(1, self.rows + 1):
            parts.append(features[..., max(P - row, 0), :])
        for decay in self.decays:
            parts.append(_exponential_mean(features, decay))
        for decay in self.output_decays:
            parts.append(_exponential_mean(outputs, decay))
        batch = features.shape[:-2]
        return np.concatenate(parts or [np.empty((*batch, 0))], axis=-1)

    def step(self, memory: Array, features: Array, outputs: Array) -> Array:
        """Returns what is remembered a row later (..., s).

        Args:
            memory: What is remembered now (..., s).
            features: Of the present row (..., d).
            outputs: Likewise (..., o).
        """
        d = features.shape[-1]
        o = outputs.shape[-1]
        end = 0
        parts = []
        if self.rows:
            end = self.rows * d
            parts += [features, memory[..., : end - d]]
        for decay in self.decays:
            mean = memory[..., end : end + d]
            parts.append(decay * mean + (1 - decay) * features)
            end += d
        for decay in self.output_decays:
            mean = memory[..., end : end + o]
            parts.append(decay * mean + (1 - decay) * outputs)
            end += o
        if not parts:
            return memory
        return np.concatenate(parts, axis=-1)

    def regressors(self, features: Array, memory: Array) -> Array:
        """Returns the regressors (..., r) of a linear term.

        They are the features, their differences from those that are remembered, the
        means of the outputs, and one.
        """
        d = features.shape[-1]
        copies = memory[..., : self.copies * d]
        copies = copies.reshape(*memory.shape[:-1], self.copies, d)
        differences = features[..., None, :] - copies
        flat = differences.reshape(*memory.shape[:-1], self.copies * d)
        output_means = memory[..., self.copies * d :]
        one = np.ones((*memory.shape[:-1], 1))
        return np.concatenate([features, flat, output_means, one], axis=-1)


def _exponential_mean(rows: Array, decay: float) -> Array:
    """Computes the exponential mean (..., d) of rows (..., P, d) after the last one."""
    P = rows.shape[-2]
    weights = (1 - decay) * decay ** np.arange(P - 1, -1, -1.0)
    weights[0] += decay**P  # the mean begins at the first row
    return np.einsum("p,...pd->...d", weights, rows)


NO_MEMORY = Memory()
