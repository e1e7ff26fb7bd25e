"""Problem: let a controller steer a system along references, and keep what happened.

    measure -> ask the controller -> fall back by the policy where it failed -> apply -> record

The loop knows neither file formats nor figures: who wants every step as it happens gives ``on_step``, which is called
after the step and outside of everything that is timed.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpmpc.exceptions import Diverged, GpmpcError, ShapeError, check_number
from gpmpc.mpc.controller import Controller, Reference, Timing
from gpmpc.mpc.supervision import Command, OnFailure, check_policy, command
from gpmpc.simulation.disturbances import Disturbance
from gpmpc.simulation.systems import ModelLoop, Noise, Running, RunningModel, RunningPlant
from gpmpc.status import Status
from gpmpc.systems import Plant


@dataclass(frozen=True)
class Step:
    """One step of a loop.

    Attributes:
        index: k.
        time: When it began [s].
        state: x[k], or the mean of the belief (n,).
        covariance: Of the belief (n, n); zero with a plant in the loop.
        measured: What the controller was told of it (n,).
        reference: What it was to follow.
        command: What it decided, and what came of it.
        input: What acted (m,).
        next_state: x[k+1] (n,).
    """

    index: int
    time: float  # [s]
    state: np.ndarray
    covariance: np.ndarray
    measured: np.ndarray
    reference: Reference
    command: Command
    input: np.ndarray
    next_state: np.ndarray


@dataclass(frozen=True)
class Rollout:
    """K steps of a closed loop.

    Attributes:
        states: x[0] .. x[K], or the means of the beliefs (K + 1, n).
        covariances: Of the beliefs (K + 1, n, n); zero with a plant in the loop.
        measured: What the controller was told of x[0] .. x[K-1] (K, n).
        inputs: What acted, u[0] .. u[K-1] (K, m).
        references: r[0] .. r[K] (K + 1, n); the last one is r[K-1] once more where no r[K] was given.
        predicted_means: What the controller expected of x[1] .. x[K] (K, n); NaN where its plan was not applied.
        predicted_covariances: The same (K, n, n).
        statuses: How every solve ended, K.
        iterations: Of the solver (K,).
        timings: Where the wall time of every decision went, K.
        time_step: Of one step [s].
        suboptimal: The steps at which a plan was applied whose solve had stopped short of its tolerance.
    """

    states: np.ndarray
    covariances: np.ndarray
    measured: np.ndarray
    inputs: np.ndarray
    references: np.ndarray
    predicted_means: np.ndarray
    predicted_covariances: np.ndarray
    statuses: tuple[Status, ...]
    iterations: np.ndarray
    timings: tuple[Timing, ...]
    time_step: float  # [s]
    suboptimal: tuple[int, ...] = ()

    @property
    def times(self) -> np.ndarray:
        """When x[0] .. x[K] were (K + 1,) [s]."""
        return self.time_step * np.arange(len(self.states))

    @property
    def seconds(self) -> np.ndarray:
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
    references: Reference | np.ndarray,
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
        references: Reference states r[0] .. (steps + horizon, n) or more, one a time step; as a ``Reference`` with the
            inputs that belong to them.
        initial: The state (n,). A ``Gaussian`` is the belief that a model loop starts from, and what a plant's state is
            drawn from.
        steps: K.
        noise: On a plant's states, measurements and inputs.
        disturbances: Gusts, other plants, dropouts: what the controller is not told of.
        on_failure: What is applied where a solve fails: ``"previous_plan"``, ``"hold"`` or ``"raise"``; see
            ``gpmpc.mpc.supervision``.
        seed: Of all random numbers; the same seed gives the same numbers.
        on_step: Called with every step.

    Raises:
        ShapeError: Too few references for the steps and the horizon, or a state of the wrong length.
        SettingError: An unknown policy, negative noise, or noise in a model loop.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was nothing to fall back on.
        Diverged: The system left the finite numbers; ``flown`` holds the steps before.
    """
    check_number("steps", steps, least=1, whole=True)
    check_policy(on_failure)
    references = checked_references(references, steps, controller.horizon)
    if isinstance(system, ModelLoop):
        running: Running = RunningModel(system, initial, disturbances, noise)
    else:
        running = RunningPlant(system, initial, disturbances, noise, seed)
    taken, last = [], None
    for k in range(steps):
        ahead = window(references, k, controller.horizon)
        try:
            step = one_step(running, controller, ahead, last, on_failure, k, round(k * system.time_step, 9))
        except Diverged as error:
            if taken:
                error.flown = rollout(taken, references, system.time_step, running.mean, running.covariance)
            raise
        taken.append(kept(step))
        last = step.command
        if on_step is not None:
            on_step(step)
    return rollout(taken, references, system.time_step, running.mean, running.covariance)


def rehearse(system: Plant | ModelLoop, controller: Controller, references: Reference, initial: Any) -> None:
    """Flies the first two steps, without noise, and forgets them: a flight's times then hold no compiling and loading.

    Two, since the second one starts from a plan. What fails here fails again in the flight, and is told there.
    """
    with suppress(GpmpcError):
        closed_loop(system, controller, references, initial, 2, on_failure="previous_plan")


def one_step(
    running: Running,
    controller: Controller,
    reference: Reference,
    last: Command | None,
    on_failure: OnFailure,
    k: int,
    time: float,
) -> Step:
    """Measures, asks, applies."""
    state, covariance, belief = running.mean, running.covariance, running.measure(time)
    asked = command(controller, belief, reference, last, on_failure, k)
    acted = running.apply(time, asked.input)
    measured = belief.mean.cpu().numpy().astype(float)
    return Step(k, time, state, covariance, measured, reference, asked, acted, running.mean)


class Kept(NamedTuple):
    """What a ``Rollout`` keeps of a step: none of its quadratic program, and one row of its plan."""

    state: np.ndarray
    covariance: np.ndarray
    measured: np.ndarray
    input: np.ndarray
    expected: np.ndarray  # mean of the next state; NaN where no plan was applied
    expected_covariance: np.ndarray
    status: Status
    failed: bool
    iterations: int
    timing: Timing


def kept(step: Step) -> Kept:
    """See ``Kept``."""
    decision, n = step.command.decision, len(step.state)
    expected, covariance = np.full(n, np.nan), np.full((n, n), np.nan)
    iterations, timing = 0, Timing(0.0, 0.0, 0.0)
    if decision is not None:
        iterations, timing = decision.iterations, decision.timing
        if not step.command.failed:
            expected, covariance = np.array(decision.means[1]), np.array(decision.covariances[1])
    taken = (step.state, step.covariance, step.measured, step.input, expected, covariance)
    return Kept(*taken, step.command.status, step.command.failed, iterations, timing)


def rollout(
    steps: Sequence[Kept],
    references: Reference,
    time_step: float,
    final: np.ndarray,
    final_covariance: np.ndarray | None = None,
) -> Rollout:
    """The arrays of all steps, and the last state (n,); its covariance (n, n) is zero by default."""
    n = len(final)
    final_covariance = np.zeros((n, n)) if final_covariance is None else final_covariance
    rows = references.states[: len(steps) + 1]
    if len(rows) == len(steps):
        rows = np.concatenate([rows, rows[-1:]])
    return Rollout(
        states=np.array([*(step.state for step in steps), final]),
        covariances=np.array([*(step.covariance for step in steps), final_covariance]),
        measured=np.array([step.measured for step in steps]),
        inputs=np.array([step.input for step in steps]),
        references=np.array(rows, dtype=float),
        predicted_means=np.array([step.expected for step in steps]),
        predicted_covariances=np.array([step.expected_covariance for step in steps]),
        statuses=tuple(step.status for step in steps),
        iterations=np.array([step.iterations for step in steps]),
        timings=tuple(step.timing for step in steps),
        time_step=time_step,
        suboptimal=tuple(k for k, step in enumerate(steps) if not (step.failed or step.status.solved)),
    )


def window(references: Reference, k: int, horizon: int) -> Reference:
    """What a controller is to follow over its horizon from step k on."""
    inputs = None if references.inputs is None else references.inputs[k : k + horizon]
    return Reference(references.states[k : k + horizon + 1], inputs)


def checked_references(references: Reference | np.ndarray, steps: int, horizon: int) -> Reference:
    """References for all steps.

    Raises:
        ShapeError: Too few, or no table.
    """
    references = references if isinstance(references, Reference) else Reference(np.asarray(references, dtype=float))
    needed = steps + horizon
    if len(references.states) < needed:
        raise ShapeError(f"{steps} steps with horizon {horizon} need {needed} references; got {len(references.states)}")
    return references
