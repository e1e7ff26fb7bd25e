"""The loop of every simulation, and the history of its steps.

    measure -> decide (by the policy where the controller fails) -> step -> record

One seed, many at once, and a cascade, which is a controller at the inner rate, differ in what decides.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc.exceptions import Diverged, ShapeError, SolverFailure, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Reference, Timing
from gpmpc.mpc._policy import Command
from gpmpc.simulation._simulator import Simulator, step_together
from gpmpc.status import Status
from gpmpc.step import Step

Array = np.ndarray


@dataclass(frozen=True)
class Rollout:
    """K steps of a closed loop."""

    states: Array  # (K + 1, n) x[0] .. x[K], or the means of the beliefs
    covariances: Array  # (K + 1, n, n) of the beliefs; zero with a plant in the loop
    measured: Array  # (K, n) measurements of x[0] .. x[K-1]
    inputs: Array  # (K, m) that were applied, u[0] .. u[K-1]
    references: Array  # (K + 1, n) r[0] .. r[K]; the last one is r[K-1] again where no r[K] was given
    predicted_means: Array  # (K, n) that the controller expected of x[1] .. x[K]; NaN where its plan was not applied
    predicted_covariances: Array  # (K, n, n)
    statuses: tuple[Status, ...]  # K, how every solve ended
    iterations: Array  # (K,) of the solver
    timings: tuple[Timing, ...]  # K, where the wall time of every decision went
    time_step: float  # [s]
    suboptimal: tuple[int, ...] = ()  # steps at which a plan was applied whose solve stopped short of its tolerance
    far_from_data: tuple[int, ...] = ()  # steps whose plan left the model's data behind

    @property
    def times(self) -> Array:
        """When x[0] .. x[K] were (K + 1,) [s]."""
        return self.time_step * np.arange(len(self.states))

    @property
    def seconds(self) -> Array:
        """Wall time of every decision (K,) [s]."""
        return np.array([timing.total for timing in self.timings])

    @property
    def failures(self) -> tuple[tuple[int, Status], ...]:
        """Every step at which the policy chose the input, with how the solve failed."""
        applied = set(self.suboptimal)
        return tuple((k, s) for k, s in enumerate(self.statuses) if not s.solved and k not in applied)


class Moment(NamedTuple):
    """Where a step began, and what was applied."""

    k: int
    time: float  # [s]
    state: Array  # (n,)
    covariance: Array  # (n, n)
    measured: Array  # (n,)
    input: Array  # (m,)


class Flight:
    """One simulator under way; ``record`` is called after every step with its ``Moment`` and what was decided."""

    def __init__(self, simulator: Simulator, record: Callable[[Moment, Any], None]):
        self.simulator, self.record = simulator, record
        self.last: Any = None
        self.error: SolverFailure | Diverged | None = None


def fly(
    flights: Sequence[Flight],
    decide: Callable[[int, Sequence[Gaussian], Sequence[Any]], Sequence[Any]],
    steps: int,
    time_step: float,
) -> None:
    """Runs the loop of all flights of one plant in step; one that fails ends with its error, and the others go on.

    ``decide`` is called with the number of the step, what is known of the states, and what was decided one step ago
    (None at the first); it returns what is to be applied, its ``input`` (m,), or a ``SolverFailure``.
    """
    for k in range(steps):
        time, moving = round(k * time_step, 9), []
        flying = [flight for flight in flights if flight.error is None]
        beliefs = [flight.simulator.measure(time) for flight in flying]
        decisions = decide(k, beliefs, [flight.last for flight in flying]) if flying else ()
        for flight, belief, decided in zip(flying, beliefs, decisions, strict=True):
            if isinstance(decided, SolverFailure):
                flight.error = decided
            else:
                moving.append((flight, belief, decided, flight.simulator.mean, flight.simulator.covariance))
        applied = step_together([flight.simulator for flight, *_ in moving], time, [each[2].input for each in moving])
        for (flight, belief, decided, state, covariance), input in zip(moving, applied, strict=True):
            if isinstance(input, Diverged):
                flight.error = input
            else:
                measured = belief.mean.cpu().numpy().astype(float)
                flight.last = decided
                flight.record(Moment(k, time, state, covariance, measured, input), decided)


class History:
    """Collects the steps of one loop, of some of the simulator's ``states``, for its ``Rollout``."""

    def __init__(
        self,
        simulator: Simulator,
        references: Reference,
        time_step: float,
        states: slice = slice(None),
        on_step: Callable[[Step], None] | None = None,
    ):
        # Of every step, without its decision and its quadratic program: mean and covariance expected of the next state,
        # NaN where no plan was applied; iterations, timing, and whether the plan left the data.
        self.rows: list[tuple[Step, Array, Array, int, Timing, bool]] = []
        self._simulator, self._references, self._time_step = simulator, references, time_step
        self._states, self._on_step = states, on_step

    def add(self, moment: Moment, decided: Command, reference: Array | None = None) -> None:
        """Adds a step; it was to be at the reference state (n,) of its number where no other is given."""
        decision, part = decided.decision, self._states
        reference = self._references.states[moment.k] if reference is None else reference
        learned = None if decision is None else decision.learned
        measured = moment.measured[part]
        step = Step(
            time=moment.time,
            k=moment.k,
            reference=np.asarray(reference, dtype=float),
            state=moment.state[part],
            measured=measured,
            input=np.asarray(moment.input, dtype=float),
            decision=decision,
            innovation=measured - (self.rows[-1][1] if self.rows else np.nan),
            belief_covariance=moment.covariance[part, part],
            gp_size=0 if learned is None else learned.size,
            gp_version=0 if learned is None else learned.version,
            failed=decided.failed,
            status=decided.status,
        )
        if self._on_step is not None:
            self._on_step(step)
        n = len(step.state)
        expected: Any = (np.full(n, np.nan), np.full((n, n), np.nan))
        if decision is not None and not decided.failed:
            expected = np.array(decision.means[1]), np.array(decision.covariances[1])
        spent: Any = (0, Timing(0.0, 0.0, 0.0), False)
        if decision is not None:
            spent = decision.iterations, decision.timing, decision.far_from_data
        self.rows.append((replace(step, decision=None), *expected, *spent))

    def rollout(self, last: Array | None = None) -> Rollout:
        """Makes the arrays of all steps; ``last`` is the reference state of the end, by default that of its number."""
        steps, means, covariances, iterations, timings, far = zip(*self.rows, strict=True)
        part, end = self._states, self._simulator
        if last is None:
            last = self._references.states[: len(steps) + 1][-1]
        return Rollout(
            states=np.array([*(step.state for step in steps), end.mean[part]]),
            covariances=np.array([*(step.belief_covariance for step in steps), end.covariance[part, part]]),
            measured=np.array([step.measured for step in steps]),
            inputs=np.array([step.input for step in steps]),
            references=np.array([*(step.reference for step in steps), last], dtype=float),
            predicted_means=np.array(means),
            predicted_covariances=np.array(covariances),
            statuses=tuple(step.status for step in steps if step.status is not None),
            iterations=np.array(iterations),
            timings=timings,
            time_step=self._time_step,
            suboptimal=tuple(s.k for s in steps if not (s.failed or s.status is None or s.status.solved)),
            far_from_data=tuple(s.k for s, left in zip(steps, far, strict=True) if left),
        )


def window(references: Reference, k: int, horizon: int) -> Reference:
    """Selects what a controller is to follow over its horizon from step k on."""
    inputs = None if references.inputs is None else references.inputs[k : k + horizon]
    return Reference(references.states[k : k + horizon + 1], inputs)


def check_references(references: Reference | Array | Sequence[float], steps: int, horizon: int) -> Reference:
    """Returns references for all steps, or raises ``ShapeError`` where they are too few or no table."""
    check_number("steps", steps, least=1, whole=True)
    references = references if isinstance(references, Reference) else Reference(np.asarray(references, dtype=float))
    references, needed = references.over(steps + horizon), steps + horizon
    if len(references.states) < needed:
        raise ShapeError(f"{steps} steps with horizon {horizon} need {needed} references; got {len(references.states)}")
    return references
