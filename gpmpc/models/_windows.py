"""Windows of measured data: rollouts begin in them and are compared with them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.models._state_space import StateSpace


@dataclass(frozen=True, eq=False)
class Windows:
    """W windows of a log: the measured past and what came after it.

    Row k of ``states`` goes with row k of ``inputs``.
    """

    space: StateSpace  #: of the states
    time_step: float  #: [s]
    past: int  #: rows before the start of each; the start is row ``past``
    stride: int  #: rows from one start to the next
    states: Array  #: (W, past + ahead + 1, n)
    inputs: Array  #: (W, past + ahead + 1, m)
    context: Array  #: up to the start, held through a prediction (W, past + 1, c)
    runs: np.ndarray  #: number of the run that each is from (W,)
    times: Array  #: of the starts (W,) [s]

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, rows: Any) -> "Windows":
        return replace(
            self,
            states=self.states[rows],
            inputs=self.inputs[rows],
            context=self.context[rows],
            runs=self.runs[rows],
            times=self.times[rows],
        )

    @property
    def ahead(self) -> int:
        """Number of rows after the start."""
        return self.states.shape[1] - self.past - 1

    def errors(
        self, predicted: Array, steps: Sequence[int] | np.ndarray | None = None
    ) -> Array:
        """Computes the errors (..., W, steps, e) of predicted states.

        Args:
            predicted: States after the start (..., W, K, n).
            steps: Those that count, from 1; all K by default.
        """
        if steps is None:
            steps = np.arange(1, predicted.shape[-2] + 1)
        steps = np.asarray(steps)
        measured = self.states[:, self.past + steps]
        return self.space.difference(predicted[..., steps - 1, :], measured)
