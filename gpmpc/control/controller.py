"""Problem: everything that turns a state and a reference into an input, behind one call.

A controller keeps nothing between calls: what it wants to remember (its last plan) is part of the ``Decision`` that it
returns, and comes back to it as ``previous``.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpmpc.status import Status


@dataclass(frozen=True)
class Decision:
    """What a controller decided at one step.

    Attributes:
        input: The input to apply now (m,).
        inputs: The planned inputs (H, m); the first row is ``input``.
        states: The predicted states (H, n), from the current state on.
        status: How the solve ended. Inputs of a solve that did not succeed are a failed iterate: do not apply them.
        iterations: Iterations of the solver.
        seconds: Wall time of the solve [s].
    """

    input: np.ndarray
    inputs: np.ndarray
    states: np.ndarray
    status: Status
    iterations: int
    seconds: float  # [s]


class Controller(Protocol):
    """A feedback law with a look-ahead."""

    @property
    def horizon(self) -> int:
        """Number of reference samples that ``control`` looks at."""

    def control(self, state: np.ndarray, reference: np.ndarray, previous: Decision | None = None) -> Decision:
        """Decides the input for one step.

        Args:
            state: Measured state (n,).
            reference: Reference states (H, n), from the current time on.
            previous: The last decision, to warm-start from; None at the first step.
        """
