"""The loop of simulations, of one seed or of many at once, and the history of its steps.

    measure -> decide (by the policy where the controller fails) -> step -> record

Many seeds are measured, decided for (``control_many``, where the controller has that) and stepped together; a trial's
numbers are those of ``closed_loop`` with its seed. What grows with their number is memory, so they fly in chunks.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gpmpc._angles import state_difference
from gpmpc.exceptions import (
    Diverged,
    GpmpcError,
    SettingError,
    ShapeError,
    SolverFailure,
    check_number,
)
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Controller, Reference, Timing
from gpmpc.mpc._controller import read_reference
from gpmpc.mpc._judgement import FlightJudge, FlightJudgement, Judgement
from gpmpc.mpc._policy import Command, OnFailure, check_policy, command, commands
from gpmpc.signals import Signals, signals_of
from gpmpc.simulation._disturbances import Disturbance
from gpmpc.simulation._simulator import (
    ModelLoop,
    ModelSimulator,
    Noise,
    PlantSimulator,
    Simulator,
    step_together,
)
from gpmpc.status import Status
from gpmpc.step import Step
from gpmpc.systems import System

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
    suboptimal: tuple[
        int, ...
    ] = ()  # steps at which a plan was applied whose solve stopped short of its tolerance
    far_from_data: tuple[int, ...] = ()  # steps whose plan left the model's data behind
    judgements: tuple[Judgement, ...] = ()  # K, whether it was healthy at every step

    @property
    def times(self) -> Array:
        """When x[0] .. x[K] were (K + 1,) [s]."""
        return self.time_step * np.arange(len(self.states))

    @property
    def seconds(self) -> Array:
        """Wall time of every decision (K,) [s]."""
        return np.array([timing.total for timing in self.timings])

    @property
    def judgement(self) -> FlightJudgement:
        """Whether the flight is healthy, suspicious or lost, and why."""
        return FlightJudgement.of(self.judgements)

    @property
    def failures(self) -> tuple[tuple[int, Status], ...]:
        """Every step at which the policy chose the input, with how the solve failed."""
        applied = set(self.suboptimal)
        return tuple(
            (k, s)
            for k, s in enumerate(self.statuses)
            if not s.solved and k not in applied
        )


class Flight:
    """The loop of some of a simulator's ``states`` under way: its steps so far, its last command, and what ended it."""

    def __init__(
        self,
        simulator: Simulator,
        references: Reference,
        time_step: float,
        judge: FlightJudge,
        on_step: Callable[[Step], None] | None = None,
        states: slice = slice(None),
    ):
        # Of every step, without its decision and its quadratic program: mean and covariance expected of the next state,
        # NaN where no plan was applied; iterations, timing, and whether the plan left the data.
        self.rows: list[tuple[Step, Array, Array, int, Timing, bool]] = []
        self.last: Command | None = None
        self.error: SolverFailure | Diverged | None = None
        self.simulator = simulator
        self._references = references
        self.time_step = time_step
        self._states = states
        self._on_step = on_step
        self._judge = judge
        own = range(len(simulator.mean))[states]
        self._angles = [i for i, j in enumerate(own) if j in simulator.angles]

    def add(
        self,
        state: tuple[Array, Array],
        belief: Gaussian,
        input: Array,
        last: Command,
        ahead: Array,
    ) -> None:
        """Adds a step: mean and covariance where it began, what was measured, what was applied, the command.

        ``ahead`` are the reference states from this step on (H + 1, n).
        """
        part = self._states
        k = len(self.rows)
        decision = last.decision
        learned = None if decision is None else decision.learned
        measured = belief.mean.cpu().numpy().astype(float)[part]
        expected_now = self.rows[-1][1] if self.rows else np.full_like(measured, np.nan)
        # Measured here, outside of what is timed, for the judge to see.
        far_from_data = decision is not None and decision.far_from_data
        step = Step(
            time=round(k * self.time_step, 9),
            k=k,
            reference=np.asarray(ahead[0], dtype=float),
            state=state[0][part],
            measured=measured,
            input=np.asarray(input, dtype=float),
            decision=decision,
            innovation=state_difference(measured, expected_now, self._angles),
            belief_covariance=state[1][part, part],
            gp_size=0 if learned is None else learned.size,
            gp_version=0 if learned is None else learned.version,
            failed=last.failed,
            status=last.status,
            judgement=self._judge.judge(measured, ahead, decision),
        )
        if self._on_step is not None:
            self._on_step(step)
        expected: Any = (
            np.full_like(step.state, np.nan),
            np.full_like(step.belief_covariance, np.nan),
        )
        if decision is not None and not last.failed:
            expected = np.array(decision.means[1]), np.array(decision.covariances[1])
        spent: Any = (0, Timing(), False)
        if decision is not None:
            spent = decision.iterations, decision.timing, far_from_data
        self.rows.append((replace(step, decision=None), *expected, *spent))
        self.last = last

    def rollout(self, last: Array | None = None) -> Rollout:
        """Makes the arrays of all steps; ``last`` is the reference state of the end, by default that of its number."""
        steps, means, covariances, iterations, timings, far = zip(
            *self.rows, strict=True
        )
        part = self._states
        end = self.simulator
        if last is None:
            last = self._references.states[: len(steps) + 1][-1]
        return Rollout(
            states=np.array([*(step.state for step in steps), end.mean[part]]),
            covariances=np.array(
                [
                    *(step.belief_covariance for step in steps),
                    end.covariance[part, part],
                ]
            ),
            measured=np.array([step.measured for step in steps]),
            inputs=np.array([step.input for step in steps]),
            references=np.array(
                [*(step.reference for step in steps), last], dtype=float
            ),
            predicted_means=np.array(means),
            predicted_covariances=np.array(covariances),
            statuses=tuple(step.status for step in steps),
            iterations=np.array(iterations),
            timings=timings,
            time_step=self.time_step,
            suboptimal=tuple(
                step.k for step in steps if not (step.failed or step.status.solved)
            ),
            far_from_data=tuple(
                step.k for step, left in zip(steps, far, strict=True) if left
            ),
            judgements=tuple(step.judgement for step in steps),
        )


def window(references: Reference, k: int, horizon: int) -> Reference:
    """Selects what a controller is to follow over its horizon from step k on."""
    inputs = None if references.inputs is None else references.inputs[k : k + horizon]
    return Reference(references.states[k : k + horizon + 1], inputs)


def check_references(
    references: Reference | Array | Sequence[float],
    steps: int,
    horizon: int,
    signals: Signals,
) -> Reference:
    """Returns references for all steps, their columns in the order of names.

    Raises:
        ShapeError: They are too few, or no table.
        DataError: They are no numbers, or have other names.
    """
    check_number("steps", steps, least=1, whole=True)
    needed = steps + horizon
    references = read_reference(references).in_order(signals).over(needed)
    if len(references.states) < needed:
        raise ShapeError(
            f"{steps} steps with horizon {horizon} need {needed} references; got {len(references.states)}"
        )
    return references


def check_belongs(controller: Controller, signals: Signals, plant: str) -> None:
    """Raises ``SettingError`` where a controller is of something else than the plant.

    That is, of other names of states and inputs, or another time step.
    """
    signals_of(controller).check("the controller", signals, plant, "system")


def closed_loop(
    system: System | ModelLoop,
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
            ``ControlLoop``.
        seed: Of all random numbers; equal seeds give equal numbers.
        on_step: Called after every step and outside of everything that is timed, such as a recorder's ``record``.

    Raises:
        ShapeError: Too few references for the steps and the horizon, or a state of the wrong length.
        SettingError: An unknown policy, negative noise, noise in a model loop, or a
            controller of other names of states and inputs, or another time step, than
            the plant has.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was nothing to fall back on.
        Diverged: The system left the finite numbers; ``flown`` holds the steps before.
    """
    check_policy(on_failure)
    signals = signals_of(system)
    check_belongs(controller, signals, getattr(system, "name", "the model loop"))
    references = check_references(references, steps, controller.horizon, signals)
    if not isinstance(system, ModelLoop):
        simulator: Simulator = PlantSimulator(
            system, initial, disturbances, noise, seed
        )
    elif disturbances or noise is not None:
        raise SettingError(
            "disturbances, noise", "need a plant in the loop; got a ModelLoop"
        )
    else:
        simulator = ModelSimulator(system, initial)
    judge = _judge_of(controller, system)
    flight = Flight(simulator, references, system.time_step, judge, on_step)
    _fly([flight], controller, references, steps, on_failure)
    if isinstance(flight.error, Diverged) and flight.rows:
        flight.error.flown = flight.rollout()
    if flight.error is not None:
        raise flight.error
    return flight.rollout()


@dataclass(frozen=True)
class Trial:
    """The result of one seed."""

    seed: int
    result: Rollout | None  # None where it failed
    error: (
        str | None
    )  # why it failed, with the kind of the error; None where it did not


def closed_loops(
    plant: System,
    controller: Controller,
    references: Reference | Array,
    initial: Any,
    steps: int,
    seeds: int | Sequence[int],
    *,
    noise: Noise | None = None,
    disturbances: Sequence[Disturbance] = (),
    on_failure: OnFailure = "raise",
    chunk: int = 200,
) -> list[Trial]:
    """Flies a controller on a plant with many seeds at once; arguments are those of ``closed_loop``, and two more.

    ``seeds`` are one a trial; a number stands for 0 .. seeds - 1. ``chunk`` trials fly at a time, which bounds the
    memory. The plant's right-hand side is evaluated on arrays, an entry a trial; a ``GPMPC`` decides for all trials
    together, any other controller one by one.

    Returns:
        One ``Trial`` a seed, in their order; those whose solve failed (with ``on_failure="raise"``) or whose plant
        diverged have an error instead of a ``Rollout``, and the others fly on.

    Raises:
        SettingError: No seeds or equal ones; a model loop, in which a seed changes nothing; or a ``chunk`` below 1.
    """
    if isinstance(plant, ModelLoop):
        raise SettingError(
            "plant",
            "a model loop draws no random numbers, all seeds are one flight; take closed_loop",
        )
    if isinstance(plant, System) and plant.stateful:
        raise SettingError(
            "plant", "a simulator flies one seed after another; take closed_loop"
        )
    check_policy(on_failure)
    seeds = _check_seeds(seeds)
    signals = signals_of(plant)
    check_belongs(controller, signals, getattr(plant, "name", "the plant"))
    references = check_references(references, steps, controller.horizon, signals)
    check_number("chunk", chunk, least=1, whole=True)
    finished: list[Trial] = []
    for start in range(0, len(seeds), chunk):
        some = seeds[start : start + chunk]
        simulators = [
            PlantSimulator(plant, initial, disturbances, noise, seed) for seed in some
        ]
        flights = [
            Flight(
                simulator,
                references,
                plant.time_step,
                _judge_of(controller, plant),
            )
            for simulator in simulators
        ]
        _fly(flights, controller, references, steps, on_failure)
        for seed, flight in zip(some, flights, strict=True):
            if (error := flight.error) is None:
                finished.append(Trial(seed, flight.rollout(), None))
            else:
                finished.append(Trial(seed, None, f"{type(error).__name__}: {error}"))
    return finished


def _judge_of(controller: Controller, system: System | ModelLoop) -> FlightJudge:
    """Makes the judge of one flight."""
    if isinstance(system, ModelLoop):
        model = system.model
        return FlightJudge.of(controller, model.state_dim, model.input_dim)
    names = system.state_names, system.input_names
    return FlightJudge.of(controller, len(names[0]), len(names[1]), names)


def _fly(
    flights: Sequence[Flight],
    controller: Controller,
    references: Reference,
    steps: int,
    on_failure: OnFailure,
) -> None:
    """Runs the loop of all flights of one plant in step; one that fails ends with its error, and the others go on."""
    for k in range(steps):
        if not (flying := [flight for flight in flights if flight.error is None]):
            return
        time = round(k * flights[0].time_step, 9)
        moving = []
        beliefs = [flight.simulator.measure(time) for flight in flying]
        ahead = window(references, k, controller.horizon)
        decided = _decide(
            controller,
            beliefs,
            ahead,
            [flight.last for flight in flying],
            on_failure,
            k,
        )
        for flight, belief, outcome in zip(flying, beliefs, decided, strict=True):
            if isinstance(outcome, SolverFailure):
                flight.error = outcome
            else:
                moving.append(
                    (
                        flight,
                        (flight.simulator.mean, flight.simulator.covariance),
                        belief,
                        outcome,
                    )
                )
        applied = step_together(
            [flight.simulator for flight, *_ in moving],
            time,
            [each[3].input for each in moving],
        )
        for (flight, state, belief, outcome), input in zip(
            moving, applied, strict=True
        ):
            if isinstance(input, Diverged):
                flight.error = input
            else:
                flight.add(state, belief, input, outcome, ahead.states)


def _decide(
    controller: Controller, beliefs: Sequence[Gaussian], *rest: Any
) -> list[Command | SolverFailure]:
    """``commands``, where one belief alone takes the controller's method for one."""
    if len(beliefs) > 1:
        return commands(controller, beliefs, *rest)
    ahead, (last,), *policy = rest
    try:
        return [command(controller, beliefs[0], ahead, last, *policy)]
    except SolverFailure as failure:
        return [failure]


def rehearse(
    system: System | ModelLoop,
    controller: Controller,
    references: Reference,
    initial: Any,
) -> None:
    """Flies the first two steps, without noise, and forgets them: a flight's times then hold no compiling and loading.

    Two, since the second one starts from a plan. What fails here fails again in the flight, and is raised there.
    """
    with suppress(GpmpcError):
        closed_loop(
            system, controller, references, initial, 2, on_failure="previous_plan"
        )


def _check_seeds(seeds: int | Sequence[int]) -> list[int]:
    """Returns the seeds one by one."""
    listed: Any = np.asarray(seeds).tolist()
    if not isinstance(listed, list):
        check_number("seeds", listed, least=1, whole=True)
        listed = list(range(listed))
    for seed in listed:
        check_number("seeds", seed, least=0, whole=True)
    if not listed or len(set(listed)) < len(listed):
        raise SettingError(
            "seeds", f"must be one or more different whole numbers; got {listed}"
        )
    return listed
