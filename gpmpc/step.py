"""One time step of a closed loop, as loops make it and recorders keep it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # recordings are read without torch
    from gpmpc.mpc.controller import Decision
    from gpmpc.status import Status


@dataclass(frozen=True, eq=False)
class Step:
    """One time step of a closed loop, n states and m inputs.

    Attributes:
        time: Time since the start of the run [s].
        k: Number of the step, from 0.
        reference: What the state was to be (n,).
        state: The plant's true state, or the mean of a model's belief (n,).
        measured: Its measurement, as the controller got it (n,).
        input: The input that was applied (m,); after a failure not the decision's.
        decision: What the controller decided, with its plan, status, timing and quadratic program; None where it was
            not called, or returned inputs of another shape.
        innovation: Measured minus predicted one step ago (n,); NaN at the first step.
        belief_covariance: Covariance of the belief of the state (n, n); zero with a plant in the loop.
        gp_size: Transitions that the model holds; 0 without a Gaussian process.
        gp_version: How often the model has changed since the start.
        failed: The decision was not applied; ``input`` comes from the policy for failures.
        status: How the solve ended; the decision's if omitted.
    """

    time: float  # [s]
    k: int
    reference: np.ndarray
    state: np.ndarray
    measured: np.ndarray
    input: np.ndarray
    decision: "Decision | None"
    innovation: np.ndarray
    belief_covariance: np.ndarray
    gp_size: int = 0
    gp_version: int = 0
    failed: bool = False
    status: "Status | None" = None
