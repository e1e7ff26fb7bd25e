"""One time step of a closed loop, as loops make it and recorders keep it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # recordings are read without torch
    from gpmpc.mpc import Decision, Judgement
    from gpmpc.status import Status


@dataclass(frozen=True, eq=False)
class Step:
    """One time step of a closed loop, n states and m inputs.

    See Also:
        ``closed_loop(..., on_step=...)``, which hands it on; ``Rollout``.
    """

    time: float  # time since the start of the run [s]
    k: int  # number of the step, from 0
    reference: np.ndarray  # what the state was to be (n,)
    state: np.ndarray  # the plant's true state, or the mean of a model's belief (n,)
    measured: np.ndarray  # its measurement, as the controller got it (n,)
    # the input that was applied (m,); after a failure not the decision's
    input: np.ndarray
    # what the controller decided, with its plan, status, timing and quadratic program;
    # None where it was not called, or returned inputs of another shape
    decision: "Decision | None"
    # measured minus predicted one step ago (n,); NaN at the first step, after one whose
    # decision was not applied, and where nothing was measured
    innovation: np.ndarray
    # covariance of the belief of the state (n, n); zero with a plant in the loop
    belief_covariance: np.ndarray
    gp_size: int = 0  # transitions that the model holds; 0 without a Gaussian process
    gp_version: int = 0  # how often the model has changed since the start
    # the decision was not applied; ``input`` comes from the policy for failures
    failed: bool = False
    status: "Status | None" = None  # how the solve ended; the decision's if omitted
    # whether the flight is healthy, suspicious or lost so far, and why; None where
    # nobody judged it
    judgement: "Judgement | None" = None
