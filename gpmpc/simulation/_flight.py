"""A closed loop under way: its steps so far, its last command, and what ended it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gpmpc._angles import state_difference
from gpmpc.exceptions import Diverged, SolverFailure
from gpmpc.mpc import FlightJudge, Judgement, Timing
from gpmpc.mpc._policy import Command
from gpmpc.simulation._rollout import Rollout
from gpmpc.simulation._simulator import Simulator, SystemState
from gpmpc.status import Status
from gpmpc.step import Step

Array = np.ndarray


@dataclass(frozen=True)
class StepSummary:
    """One step as a rollout needs it."""

    step: Step  # without its decision, which holds the quadratic program: for memory
    status: Status  # how the solve ended
    judgement: Judgement
    predicted_mean: Array  # of the next state (n,); NaN where no plan was applied
    predicted_covariance: Array  # (n, n)
    iterations: int  # of the solver
    timing: Timing
    far_from_data: bool  # whether the plan left the model's data behind

    @classmethod
    def of(cls, step: Step, far_from_data: bool) -> "StepSummary":
        """Returns the summary of a step, with what its decision predicted."""
        assert step.status is not None
        assert step.judgement is not None
        decision = step.decision
        predicted_mean = np.full_like(step.state, np.nan)
        predicted_covariance = np.full_like(step.belief_covariance, np.nan)
        if decision is not None and not step.failed:
            predicted_mean = np.array(decision.means[1])
            predicted_covariance = np.array(decision.covariances[1])
        return cls(
            step=replace(step, decision=None),
            status=step.status,
            judgement=step.judgement,
            predicted_mean=predicted_mean,
            predicted_covariance=predicted_covariance,
            iterations=0 if decision is None else decision.iterations,
            timing=Timing() if decision is None else decision.timing,
            far_from_data=far_from_data,
        )


class Flight:
    """One controller's flight.

    It sees the simulator's states ``own_states``: all, or in a cascade its half.

    Args:
        simulator: What is steered; the two loops of a cascade share one.
        time_step: Of the controller [s].
        judge: Says of every step whether the flight is healthy.
        on_step: Called with every step, outside of everything that is timed.
        own_states: The controller's states among those of the simulator.

    Attributes:
        steps: What was flown so far.
        last: Command of the last step; None before the first. Its ``plan`` is what the
            next step starts from, after a failure what is left of the last good one.
        error: What ended the flight; None while it goes on.
    """

    def __init__(
        self,
        simulator: Simulator,
        time_step: float,
        judge: FlightJudge,
        on_step: Callable[[Step], None] | None = None,
        own_states: slice = slice(None),
    ):
        self.steps: list[StepSummary] = []
        self._commands: list[Array] = []
        self.last: Command | None = None
        self.error: SolverFailure | Diverged | None = None
        self.simulator = simulator
        self.time_step = time_step
        self._own_states = own_states
        self._on_step = on_step
        self._judge = judge
        own_indices = range(len(simulator.mean))[own_states]
        self._angles = [i for i, j in enumerate(own_indices) if j in simulator.angles]

    def add(
        self,
        state: SystemState,
        measured_by_simulator: Array,
        command: Command,
        input: Array,
        reference: Array,
    ) -> None:
        """Adds a step.

        Args:
            state: Of the whole simulator, when the step began.
            measured_by_simulator: What was measured of it (N,), of all its states.
            command: What was decided on it.
            input: What was applied in the end (m,).
            reference: The reference states from this step on (H + 1, n).
        """
        own_state = state.part(self._own_states)
        measured = measured_by_simulator[self._own_states]
        decision = command.decision
        learned = None if decision is None else decision.learned
        # Measured here, outside of what is timed, for the judge to see.
        far_from_data = decision is not None and decision.far_from_data
        k = len(self.steps)
        step = Step(
            time=round(k * self.time_step, 9),
            k=k,
            reference=np.asarray(reference[0], dtype=float),
            state=own_state.mean,
            measured=measured,
            input=np.asarray(input, dtype=float),
            decision=decision,
            innovation=self._innovation(measured),
            belief_covariance=own_state.covariance,
            gp_size=0 if learned is None else learned.size,
            gp_version=0 if learned is None else learned.version,
            failed=command.failed,
            status=command.status,
            judgement=self._judge.judge(measured, reference, decision, input),
        )
        if self._on_step is not None:
            self._on_step(step)
        self.steps.append(StepSummary.of(step, far_from_data))
        self._commands.append(np.array(command.input, dtype=float))
        self.last = command

    def _innovation(self, measured: Array) -> Array:
        """Returns measured minus predicted (n,); NaN where nothing was predicted."""
        if not self.steps:
            return np.full_like(measured, np.nan)
        predicted = self.steps[-1].predicted_mean
        return state_difference(measured, predicted, self._angles)

    def rollout(self, last_reference: Array) -> Rollout:
        """Returns the arrays of all steps.

        ``last_reference`` (n,) belongs to the state that the last step led to.
        """
        summaries = self.steps
        steps = [summary.step for summary in summaries]
        end = self.simulator.state.part(self._own_states)
        states = [step.state for step in steps]
        covariances = [step.belief_covariance for step in steps]
        references = [step.reference for step in steps]
        predicted_covariances = [s.predicted_covariance for s in summaries]
        suboptimal = [
            s.step.k for s in summaries if not (s.step.failed or s.status.solved)
        ]
        return Rollout(
            states=np.array([*states, end.mean]),
            covariances=np.array([*covariances, end.covariance]),
            measured=np.array([step.measured for step in steps]),
            inputs=np.array([step.input for step in steps]),
            references=np.array([*references, last_reference], dtype=float),
            predicted_means=np.array([s.predicted_mean for s in summaries]),
            predicted_covariances=np.array(predicted_covariances),
            statuses=tuple(s.status for s in summaries),
            iterations=np.array([s.iterations for s in summaries]),
            timings=tuple(s.timing for s in summaries),
            time_step=self.time_step,
            suboptimal=tuple(suboptimal),
            far_from_data=tuple(s.step.k for s in summaries if s.far_from_data),
            judgements=tuple(s.judgement for s in summaries),
            commands=np.array(self._commands),
        )
