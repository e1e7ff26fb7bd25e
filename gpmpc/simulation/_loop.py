"""Closes the loop: a controller steers a plant, or a learned model, along references.

    measure -> decide (by the policy where the controller fails) -> step -> record

``fly`` is the only loop; one flight, a cascade and many trials differ in what decides.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc.exceptions import Diverged, GpmpcError, SettingError, ShapeError, SolverFailure, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.controller import Controller, Reference, Timing
from gpmpc.mpc.policy import Command, OnFailure, check_policy, command
from gpmpc.simulation._disturbances import Disturbance
from gpmpc.simulation._simulator import ModelLoop, ModelSimulator, Noise, PlantSimulator, Simulator, step_together
from gpmpc.status import Status
from gpmpc.step import Step
from gpmpc.systems import Plant

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


def closed_loop(
    system: Plant | ModelLoop,
    controller: Controller,
    references: Reference | Array | Sequence[float],
    initial: Any,
    steps: int,
    *,
    noise: Noise | None = None,
    disturbances: Sequence[Disturbance] = (),
    on_failure: OnFailure = "raise",
    seed: int = 0,
    on_step: Callable[[Step], None] | None = None,
) -> Rollout:
    """Runs a controller on a plant, or on a learned model that is rolled on itself.

    Args:
        system: What is steered.
        controller: Its feedback law; it sees the next ``controller.horizon`` references.
        references: Reference states r[0] .. (steps + horizon, n) or more, one a time step, or a set point (n,); as a
            ``Reference`` with the inputs that belong to them.
        initial: The state (n,). A ``Gaussian`` is the belief that a model loop starts from, and what a plant's state is
            drawn from.
        steps: K.
        noise: On a plant's states, measurements and inputs.
        disturbances: Gusts, other plants, dropouts: what the controller does not know of.
        on_failure: What is applied where a solve fails: ``"previous_plan"``, ``"hold"`` or ``"raise"``; see
            ``gpmpc.mpc.policy``.
        seed: Of all random numbers; equal seeds give equal numbers.
        on_step: Called after every step and outside of everything that is timed, such as a recorder's ``record``.

    Raises:
        ShapeError: Too few references for the steps and the horizon, or a state of the wrong length.
        SettingError: An unknown policy, negative noise, or noise in a model loop.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was nothing to fall back on.
        Diverged: The system left the finite numbers; ``flown`` holds the steps before.
    """
    check_number("steps", steps, least=1, whole=True)
    check_policy(on_failure)
    references = check_references(references, steps, controller.horizon)
    if not isinstance(system, ModelLoop):
        simulator: Simulator = PlantSimulator(system, initial, disturbances, noise, seed)
    elif disturbances or noise is not None:
        raise SettingError("disturbances, noise", "need a plant in the loop; got a ModelLoop")
    else:
        simulator = ModelSimulator(system, initial)
    history = History(on_step)

    def decide(k: int, beliefs: Sequence[Gaussian], last: Sequence[Command | None]) -> list[Command]:
        return [command(controller, beliefs[0], window(references, k, controller.horizon), last[0], on_failure, k)]

    flight = Flight(simulator, history.recording(references))
    fly([flight], decide, steps, system.time_step)
    if isinstance(flight.error, Diverged) and history.rows:
        flight.error.flown = history.rollout(simulator, references, system.time_step)
    if flight.error is not None:
        raise flight.error
    return history.rollout(simulator, references, system.time_step)


def rehearse(system: Plant | ModelLoop, controller: Controller, references: Reference, initial: Any) -> None:
    """Flies the first two steps, without noise, and forgets them: a flight's times then hold no compiling and loading.

    Two, since the second one starts from a plan. What fails here fails again in the flight, and is raised there.
    """
    with suppress(GpmpcError):
        closed_loop(system, controller, references, initial, 2, on_failure="previous_plan")


class Moment(NamedTuple):
    """Where a step began, and what was applied."""

    k: int
    time: float  # [s]
    state: Array  # (n,)
    covariance: Array  # (n, n)
    measured: Array  # (n,)
    input: Array  # (m,)

    def part(self, k: int, states: slice, input: Array) -> "Moment":
        """Selects some states, of a step numbered k that applied an input."""
        covariance = self.covariance[states, states]
        return Moment(k, self.time, self.state[states], covariance, self.measured[states], input)


class Flight:
    """One simulator under way.

    Args:
        simulator: At its initial state.
        record: Called after every step with its ``Moment`` and what was decided.
    """

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
    """Runs the loop of all flights in step; one that fails ends with its error, and the others go on.

    Args:
        flights: Of one plant.
        decide: From the number of the step, what is known of the states, and what was decided one step ago (None at the
            first), to what is to be applied, its ``input`` (m,), or to a ``SolverFailure``.
        steps: K.
        time_step: [s].
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


class _Row(NamedTuple):
    """What a ``Rollout`` holds of a step: nothing of its quadratic program, and one row of its plan."""

    step: Step  # without its decision
    expected: Array  # mean of the next state; NaN where no plan was applied
    expected_covariance: Array
    iterations: int
    timing: Timing


class History:
    """Collects the steps of one loop for its ``Rollout``."""

    def __init__(self, on_step: Callable[[Step], None] | None = None):
        self.rows: list[_Row] = []
        self._on_step = on_step

    def recording(self, references: Reference) -> Callable[[Moment, Command], None]:
        """Makes the ``record`` of a flight along references."""
        return lambda moment, decided: self.add(moment, references.states[moment.k], decided)

    def add(self, moment: Moment, reference: Array, decided: Command) -> None:
        """Adds a step that was to be at a reference state (n,)."""
        decision, n = decided.decision, len(moment.state)
        learned = None if decision is None else decision.learned
        step = Step(
            time=moment.time,
            k=moment.k,
            reference=np.asarray(reference, dtype=float),
            state=moment.state,
            measured=moment.measured,
            input=np.asarray(moment.input, dtype=float),
            decision=decision,
            innovation=moment.measured - (self.rows[-1].expected if self.rows else np.nan),
            belief_covariance=moment.covariance,
            gp_size=0 if learned is None else learned.size,
            gp_version=0 if learned is None else learned.version,
            failed=decided.failed,
            status=decided.status,
        )
        if self._on_step is not None:
            self._on_step(step)
        expected: Any = (np.full(n, np.nan), np.full((n, n), np.nan))
        if decision is not None and not decided.failed:
            expected = np.array(decision.means[1]), np.array(decision.covariances[1])
        spent: Any = (0, Timing(0.0, 0.0, 0.0)) if decision is None else (decision.iterations, decision.timing)
        self.rows.append(_Row(replace(step, decision=None), *expected, *spent))

    def rollout(self, end: Simulator, references: Reference, time_step: float, states: slice = slice(None)) -> Rollout:
        """Makes the arrays of all steps.

        Args:
            end: Where the flight ended.
            references: The last reference state is the one of the end, where it has so many.
            time_step: [s].
            states: Which of the simulator's states these are.
        """
        rows, steps = self.rows, [row.step for row in self.rows]
        last = references.states[min(len(rows), len(references.states) - 1)]
        return Rollout(
            states=np.array([*(step.state for step in steps), end.mean[states]]),
            covariances=np.array([*(step.belief_covariance for step in steps), end.covariance[states, states]]),
            measured=np.array([step.measured for step in steps]),
            inputs=np.array([step.input for step in steps]),
            references=np.array([*(step.reference for step in steps), last], dtype=float),
            predicted_means=np.array([row.expected for row in rows]),
            predicted_covariances=np.array([row.expected_covariance for row in rows]),
            statuses=tuple(step.status for step in steps if step.status is not None),
            iterations=np.array([row.iterations for row in rows]),
            timings=tuple(row.timing for row in rows),
            time_step=time_step,
            suboptimal=tuple(s.k for s in steps if not (s.failed or s.status is None or s.status.solved)),
            far_from_data=tuple(s.k for s in steps if s.decision is not None and s.decision.far_from_data),
        )


def window(references: Reference, k: int, horizon: int) -> Reference:
    """Selects what a controller is to follow over its horizon from step k on."""
    inputs = None if references.inputs is None else references.inputs[k : k + horizon]
    return Reference(references.states[k : k + horizon + 1], inputs)


def check_references(references: Reference | Array | Sequence[float], steps: int, horizon: int) -> Reference:
    """Returns references for all steps.

    Raises:
        ShapeError: Too few, or no table.
    """
    references = references if isinstance(references, Reference) else Reference(np.asarray(references, dtype=float))
    references, needed = references.over(steps + horizon), steps + horizon
    if len(references.states) < needed:
        raise ShapeError(f"{steps} steps with horizon {horizon} need {needed} references; got {len(references.states)}")
    return references
