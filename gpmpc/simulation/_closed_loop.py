"""Closes the loop of one seed, or of many at once.

Many seeds are measured, decided for (``control_many``, where the controller has that) and stepped together; a trial's
numbers are those of ``closed_loop`` with its seed. What grows with their number is memory, so they fly in chunks.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc.exceptions import Diverged, GpmpcError, SettingError, SolverFailure, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Controller, Reference
from gpmpc.mpc._policy import Command, OnFailure, check_policy, command, commands
from gpmpc.simulation._loop import Flight, History, Rollout, check_references, fly, window
from gpmpc.simulation._simulator import Disturbance, ModelLoop, ModelSimulator, Noise, PlantSimulator, Simulator
from gpmpc.step import Step
from gpmpc.systems import Plant

Array = np.ndarray


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
            ``ControlLoop``.
        seed: Of all random numbers; equal seeds give equal numbers.
        on_step: Called after every step and outside of everything that is timed, such as a recorder's ``record``.

    Raises:
        ShapeError: Too few references for the steps and the horizon, or a state of the wrong length.
        SettingError: An unknown policy, negative noise, or noise in a model loop.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was nothing to fall back on.
        Diverged: The system left the finite numbers; ``flown`` holds the steps before.
    """
    check_policy(on_failure)
    references = check_references(references, steps, controller.horizon)
    if not isinstance(system, ModelLoop):
        simulator: Simulator = PlantSimulator(system, initial, disturbances, noise, seed)
    elif disturbances or noise is not None:
        raise SettingError("disturbances, noise", "need a plant in the loop; got a ModelLoop")
    else:
        simulator = ModelSimulator(system, initial)
    history = History(simulator, references, system.time_step, on_step=on_step)

    def decide(k: int, beliefs: Sequence[Gaussian], last: Sequence[Command | None]) -> list[Command]:
        return [command(controller, beliefs[0], window(references, k, controller.horizon), last[0], on_failure, k)]

    flight = Flight(simulator, history.add)
    fly([flight], decide, steps, system.time_step)
    if isinstance(flight.error, Diverged) and history.rows:
        flight.error.flown = history.rollout()
    if flight.error is not None:
        raise flight.error
    return history.rollout()


@dataclass(frozen=True)
class Trial:
    """The result of one seed."""

    name: str  # such as "seed 3"
    seed: int
    result: Rollout | None  # None where it failed
    error: str | None  # why it failed, with the kind of the error; None where it did not


def closed_loops(
    plant: Plant,
    controller: Controller,
    references: Reference | np.ndarray,
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
        raise SettingError("plant", "a model loop draws no random numbers, all seeds are one flight; take closed_loop")
    if getattr(plant.dynamics, "stateful", False):
        raise SettingError("plant", "a simulator flies one seed after another; take closed_loop")
    check_policy(on_failure)
    seeds, horizon = _check_seeds(seeds), controller.horizon
    references = check_references(references, steps, horizon)
    check_number("chunk", chunk, least=1, whole=True)

    def decide(k: int, beliefs: Sequence[Gaussian], last: Sequence[Command | None]) -> list[Command | SolverFailure]:
        return commands(controller, beliefs, window(references, k, horizon), last, on_failure, k)

    finished: list[Trial] = []
    for start in range(0, len(seeds), chunk):
        some = seeds[start : start + chunk]
        simulators = [PlantSimulator(plant, initial, disturbances, noise, seed) for seed in some]
        histories = [History(simulator, references, plant.time_step) for simulator in simulators]
        flights = [Flight(*each) for each in zip(simulators, (history.add for history in histories), strict=True)]
        fly(flights, decide, steps, plant.time_step)
        for seed, flight, history in zip(some, flights, histories, strict=True):
            error = flight.error
            reason = None if error is None else f"{type(error).__name__}: {error}"
            finished.append(Trial(f"seed {seed}", seed, history.rollout() if error is None else None, reason))
    return finished


def rehearse(system: Plant | ModelLoop, controller: Controller, references: Reference, initial: Any) -> None:
    """Flies the first two steps, without noise, and forgets them: a flight's times then hold no compiling and loading.

    Two, since the second one starts from a plan. What fails here fails again in the flight, and is raised there.
    """
    with suppress(GpmpcError):
        closed_loop(system, controller, references, initial, 2, on_failure="previous_plan")


def _check_seeds(seeds: int | Sequence[int]) -> list[int]:
    """Returns the seeds one by one."""
    if isinstance(seeds, int | np.integer):
        check_number("seeds", int(seeds), least=1, whole=True)
        seeds = range(int(seeds))
    seeds = [int(seed) if isinstance(seed, np.integer) else seed for seed in seeds]
    for seed in seeds:
        check_number("seeds", seed, least=0, whole=True)
    if not seeds or len(set(seeds)) < len(seeds):
        raise SettingError("seeds", f"must be one or more different whole numbers; got {seeds}")
    return seeds
