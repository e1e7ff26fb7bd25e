"""Problem: what one time step of a closed loop was like has to reach whoever keeps, counts or draws it.

A simulation makes one ``Step`` per time step and hands it to a recorder (any object with ``record(step)``). It stands
below ``simulation`` and above ``control``, so that the loop needs to know no file format, and a file format no loop.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # a recorder's writer needs this file without torch
    from gpmpc.mpc.controller import Decision


@dataclass(frozen=True, eq=False)
class Step:
    """One time step of a closed loop, n states and m inputs.

    Attributes:
        time: Time since the start of the run [s].
        k: Number of the step, from 0.
        reference: What the state was to be (n,).
        state: The plant's true state (n,).
        measured: What the controller was told of it (n,).
        input: The input that was applied (m,); after a failure not the decision's.
        decision: What the controller decided, with its plan, status, timing and quadratic program.
        innovation: Measured minus predicted one step ago (n,); NaN at the first step.
        belief_covariance: Covariance of the controller's belief of the state (n, n).
        gp_size: Transitions that the model holds; 0 without a Gaussian process.
        gp_version: How often the model has changed since the start.
        failed: The decision was not applied; ``input`` comes from the policy for failures.
    """

    time: float  # [s]
    k: int
    reference: np.ndarray
    state: np.ndarray
    measured: np.ndarray
    input: np.ndarray
    decision: "Decision"
    innovation: np.ndarray
    belief_covariance: np.ndarray
    gp_size: int = 0
    gp_version: int = 0
    failed: bool = False
