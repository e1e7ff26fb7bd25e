"""The history of a closed loop."""

from dataclasses import dataclass

import numpy as np

from gpmpc.mpc import FlightJudgement, Judgement, Timing, Tracking
from gpmpc.status import Status

Array = np.ndarray


@dataclass(frozen=True)
class Rollout:
    """K steps of a closed loop, n states and m inputs.

    See Also:
        ``closed_loop``, which returns it; ``gpmpc.plotting.flight_figure``,
        which draws it.
    """

    states: Array  # (K + 1, n) x[0] .. x[K], or the means of the beliefs
    covariances: Array  # (K + 1, n, n) of the beliefs; zero with a plant in the loop
    measured: Array  # (K, n) measurements of x[0] .. x[K-1]
    # (K, m) that reached the plant, u[0] .. u[K-1], an actuator's noise included
    inputs: Array
    # (K + 1, n) r[0] .. r[K]; the last one is r[K-1] again where no r[K] was given
    references: Array
    # (K, n) predictions of x[1] .. x[K]; NaN where the plan was not applied
    predicted_means: Array
    predicted_covariances: Array  # (K, n, n)
    statuses: tuple[Status, ...]  # K, how every solve ended
    iterations: Array  # (K,) of the solver
    timings: tuple[Timing, ...]  # K, where the wall time of every decision went
    time_step: float  # [s]
    # steps at which a plan was applied whose solve stopped short of its tolerance
    suboptimal: tuple[int, ...] = ()
    far_from_data: tuple[int, ...] = ()  # steps whose plan left the model's data behind
    judgements: tuple[Judgement, ...] = ()  # K, whether it was healthy at every step
    # (K, m) that were decided, before an actuator's noise; None where nobody tells
    commands: Array | None = None

    @property
    def times(self) -> Array:
        """Times of x[0] .. x[K] (K + 1,) [s]."""
        return self.time_step * np.arange(len(self.states))

    @property
    def seconds(self) -> Array:
        """Wall time of every decision (K,) [s]."""
        return np.array([timing.total for timing in self.timings])

    def paid(
        self,
        cost: Tracking,
        previous_input: Array,
        reference_inputs: Array | None = None,
    ) -> Array:
        """Computes what each step cost (K,); see ``Tracking.paid``.

        Args:
            cost: Of the controller, or another one to compare controllers by.
            previous_input: Before the first step (m,).
            reference_inputs: (K, m), where deviations from them are weighed.
        """
        return cost.paid(
            states=self.states,
            inputs=self.inputs,
            references=self.references,
            previous_input=previous_input,
            reference_inputs=reference_inputs,
        )

    @property
    def judgement(self) -> FlightJudgement:
        """Whether the flight is healthy, suspicious or lost, and why."""
        return FlightJudgement.of(self.judgements)

    @property
    def failures(self) -> tuple[tuple[int, Status], ...]:
        """Every step at which the policy chose the input, with how the solve failed."""
        suboptimal = set(self.suboptimal)
        return tuple(
            (k, status)
            for k, status in enumerate(self.statuses)
            if not status.solved and k not in suboptimal
        )
