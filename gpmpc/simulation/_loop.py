"""The loop of simulations, of one seed or of many at once.

    measure -> decide (by the policy where the controller fails) -> step -> record

Many seeds are measured, decided for (``control_many``, where the controller has that)
and stepped together; a trial's numbers are those of ``closed_loop`` with its seed. What
grows with their number is memory, so they fly in chunks.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import to_array
from gpmpc.exceptions import (
    Diverged,
    GpmpcError,
    SettingError,
    SolverFailure,
    check_number,
)
from gpmpc.models._past import weighed_signals
from gpmpc.mpc import Controller, Reference
from gpmpc.mpc._controller import read_reference
from gpmpc.mpc._policy import Command, OnFailure, decide_many
from gpmpc.signals import Signals, signals_of
from gpmpc.simulation._disturbances import Disturbance, Replaced
from gpmpc.simulation._flight import Flight
from gpmpc.simulation._rollout import Rollout
from gpmpc.simulation._scenario import Scenario
from gpmpc.simulation._simulator import ModelLoop, Noise, SystemState, step_together
from gpmpc.step import Step
from gpmpc.systems import System

Array = np.ndarray


@explains_arguments
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
        controller: Its feedback law; it sees the next ``controller.horizon``
            references.
        references: Reference states r[0] .. (steps + horizon, n) or more, one a time
            step, or a set point (n,); as a ``Reference`` with the inputs that belong to
            them. Its ``kappas`` move along with a path, entry k + i for stage i of
            step k; those of a set point (horizon,) hold at every step.
        initial: The state (n,); None for a simulator, which starts an episode. A
            ``Gaussian`` is what a plant's state is drawn from, and the belief that a
            model loop starts from; a mean alone has the paper's deviation of 0.1 there.
        steps: K.
        noise: On a plant's states, measurements and inputs.
        disturbances: Gusts, other plants, dropouts: what the controller does not know
            of. Each changes what those before it in the list left.
        on_failure: What is applied where a solve fails: ``"previous_plan"``, ``"hold"``
            or ``"raise"``; see ``ControlLoop``.
        seed: Of all random numbers; equal seeds give equal numbers.
        on_step: Called after every step and outside of everything that is timed, such
            as a recorder's ``record``.

    Raises:
        ShapeError: Too few references for the steps and the horizon, a set point's
            kappas of another horizon, or a state or noise of the wrong length.
        DataError: References that are no numbers, or have other names.
        SettingError: An unknown policy, negative noise, noise in a model loop, kappas
            that the controller cannot use, or a controller of other names of states and
            inputs, or another time step, than the plant has.
        UnsupportedModel: A gust on a simulator.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was
            nothing to fall back on.
        Diverged: The system left the finite numbers; ``rollout`` holds the steps
            before, as does what ``on_step`` records: not the one that it failed in.

    See Also:
        ``closed_loops`` for many seeds; ``gpmpc.plotting.flight_figure``, which draws
        what it returns; ``gpmpc.mpc.ControlLoop`` for a plant of your own.
    """
    if not (on_step is None or callable(on_step)):
        raise SettingError(
            "on_step", f"must be a function of a Step, or None; got {on_step!r}"
        )
    scenario = Scenario(
        system=system,
        controller=controller,
        references=references,
        initial=initial,
        steps=steps,
        noise=noise,
        disturbances=disturbances,
        on_failure=on_failure,
        name=getattr(system, "name", "the model loop"),
        signals=_steered_signals(system, controller),
    )
    flight = scenario.flight(seed, on_step)
    _fly_together([flight], scenario)
    if isinstance(flight.error, Diverged) and flight.steps:
        flight.error.rollout = _rollout(flight, scenario)
    if flight.error is not None:
        raise flight.error
    return _rollout(flight, scenario)


def _steered_signals(system: System | ModelLoop, controller: Controller) -> Signals:
    """Returns the signals of a system; of a model with a past, of what is measured."""
    if not isinstance(system, ModelLoop):
        return signals_of(system)
    signals = weighed_signals(system.model, getattr(controller, "problem", None))
    return replace(signals, time_step=system.time_step)


@dataclass(frozen=True)
class Trial:
    """The result of one seed.

    See Also:
        ``closed_loops``, which returns one a seed.
    """

    seed: int
    result: Rollout | None  # None where it failed
    error: str | None  # kind and text of its error; None where it did not fail


@explains_arguments
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
    """Flies a controller on a plant with many seeds at once.

    The plant's right-hand side is evaluated on arrays, an entry a trial; a ``GPMPC``
    decides for all trials together, any other controller one by one.

    Args:
        plant: What is steered.
        controller: Its feedback law.
        references: As for ``closed_loop``.
        initial: As for ``closed_loop``.
        steps: K.
        seeds: One a trial; a number stands for 0 .. seeds - 1.
        noise: As for ``closed_loop``.
        disturbances: As for ``closed_loop``.
        on_failure: As for ``closed_loop``.
        chunk: Number of trials that fly at a time, which bounds the memory.

    Returns:
        One ``Trial`` a seed, in their order; those whose solve failed (with
        ``on_failure="raise"``) or whose plant diverged have an error instead of a
        ``Rollout``, and the others fly on.

    Raises:
        SettingError: No seeds or equal ones; a model loop, in which a seed changes
            nothing; a ``chunk`` below 1; and as in ``closed_loop``.
        ShapeError: As in ``closed_loop``.
        DataError: As in ``closed_loop``.

    See Also:
        ``closed_loop``, whose numbers a trial has.
    """
    _check_plant_of_trials(plant)
    if isinstance(disturbances, Sequence):
        for disturbance in disturbances:
            if isinstance(disturbance, Replaced):
                _check_plant_of_trials(disturbance.plant)
    scenario = Scenario(
        system=plant,
        controller=controller,
        references=references,
        initial=initial,
        steps=steps,
        noise=noise,
        disturbances=disturbances,
        on_failure=on_failure,
        name=getattr(plant, "name", "the plant"),
        signals=signals_of(plant),
    )
    seeds = _read_seeds(seeds)
    check_number("chunk", chunk, least=1, whole=True)
    trials: list[Trial] = []
    for start in range(0, len(seeds), chunk):
        chunk_seeds = seeds[start : start + chunk]
        flights = [scenario.flight(seed) for seed in chunk_seeds]
        _fly_together(flights, scenario)
        for seed, flight in zip(chunk_seeds, flights, strict=True):
            trials.append(_trial(seed, flight, scenario))
    return trials


@explains_arguments
def rehearse(
    system: System | ModelLoop,
    controller: Controller,
    references: Reference,
    initial: Any,
) -> None:
    """Flies the first two steps, without noise, and forgets them.

    A flight's times then hold no compiling and loading, but of kernels that few
    programs need, such as those of unstable plans: ``warm_up`` loads these, too. There
    are two steps, since the second one starts from a plan, or one where the references
    are of no more. What fails here is left to the flight to raise. What a
    controller of one's own remembers of them, such as a filter's belief, it has to
    forget by itself.

    See Also:
        ``closed_loop``; ``gpmpc.mpc.ControlLoop.warm_up``, without a plant.
    """
    with suppress(GpmpcError):
        states = read_reference(references).states
        steps = 2
        if np.ndim(states) == 2:
            steps = min(steps, max(1, len(states) - controller.horizon))
        closed_loop(
            system,
            controller,
            references,
            initial,
            steps,
            on_failure="previous_plan",
        )


class _DecidedStep(NamedTuple):
    """A flight's step that is decided and not applied yet."""

    flight: Flight
    state: SystemState
    measured: Array  # (n,)
    command: Command


def _fly_together(flights: Sequence[Flight], scenario: Scenario) -> None:
    """Flies all flights of one scenario, step by step.

    One that fails ends with its error, and the others go on.
    """
    for k in range(scenario.steps):
        flying = [flight for flight in flights if flight.error is None]
        if not flying:
            return
        time = round(k * scenario.system.time_step, 9)
        decided = _decide_step(flying, scenario, k, time)
        results = step_together(
            [decision.flight.simulator for decision in decided],
            time,
            [decision.command.input for decision in decided],
        )
        for decision, result in zip(decided, results, strict=True):
            if isinstance(result, Diverged):
                decision.flight.error = result
                continue
            decision.flight.add(
                state=decision.state,
                measured_by_simulator=decision.measured,
                command=decision.command,
                input=result.input,
                reference=scenario.reference_states_from(k),
            )


def _decide_step(
    flights: Sequence[Flight],
    scenario: Scenario,
    k: int,
    time: float,
) -> list[_DecidedStep]:
    """Measures and decides for step k of flights; those that fail end here."""
    beliefs = [flight.simulator.measure(time) for flight in flights]
    # What is recorded is no array that a controller may calculate in.
    measurements = [np.array(to_array(belief.mean)) for belief in beliefs]
    commands = decide_many(
        scenario.controller,
        beliefs,
        scenario.reference_from(k),
        last=[flight.last for flight in flights],
        on_failure=scenario.on_failure,
        step=k,
    )
    decided = []
    for flight, measured, command in zip(flights, measurements, commands, strict=True):
        if isinstance(command, SolverFailure):
            flight.error = command
        else:
            state = flight.simulator.state
            decided.append(_DecidedStep(flight, state, measured, command))
    return decided


def _rollout(flight: Flight, scenario: Scenario) -> Rollout:
    """Returns what was flown of a scenario."""
    return flight.rollout(scenario.reference_state(len(flight.steps)))


def _trial(seed: int, flight: Flight, scenario: Scenario) -> Trial:
    """Returns the result of a flight that has ended."""
    error = flight.error
    if error is not None:
        return Trial(seed, result=None, error=f"{type(error).__name__}: {error}")
    return Trial(seed, result=_rollout(flight, scenario), error=None)


def _check_plant_of_trials(plant: object) -> None:
    """Raises ``SettingError`` unless seeds make a difference, side by side."""
    if isinstance(plant, ModelLoop):
        raise SettingError(
            "plant",
            "a model loop draws no random numbers, all seeds are one flight; "
            "take closed_loop",
        )
    if isinstance(plant, System) and plant.stateful:
        raise SettingError(
            "plant", "a simulator flies one seed after another; take closed_loop"
        )


def _read_seeds(seeds: int | Sequence[int]) -> list[int]:
    """Returns the seeds one by one.

    Raises:
        SettingError: There are none, or equal ones, or other than whole numbers.
    """
    values = np.asarray(seeds).tolist()
    if not isinstance(values, list):
        check_number("seeds", values, least=1, whole=True)
        return list(range(values))
    for seed in values:
        check_number("seeds", seed, least=0, whole=True)
    if not values or len(set(values)) < len(values):
        raise SettingError(
            "seeds", f"must be one or more different whole numbers; got {values}"
        )
    return values
