"""Flies many seeds at once.

All trials are measured, the controller decides for all at once (``control_many``, where it has that), and the plant
steps all at once. A trial's numbers are those of ``closed_loop`` with its seed, however many fly beside it. What grows
with their number is memory, so they fly in chunks, one after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc.exceptions import SettingError, SolverFailure, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.controller import Controller, Reference
from gpmpc.mpc.policy import Command, OnFailure, check_policy, commands
from gpmpc.simulation._disturbances import Disturbance
from gpmpc.simulation._loop import Flight, History, Rollout, check_references, fly, window
from gpmpc.simulation._simulator import ModelLoop, Noise, PlantSimulator
from gpmpc.systems import Plant

_MEMORY = 2**30  # [bytes] that the controller may take for all that fly at a time


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
    chunk: int | None = None,
) -> list[Trial]:
    """Flies a controller on a plant with many seeds at once.

    Args:
        plant: What is steered; its right-hand side is evaluated on arrays, an entry a trial.
        controller: Its feedback law, of all trials; a ``GPMPC`` decides for them together, any other one by one.
        references: Of all trials; see ``closed_loop``.
        initial: The state (n,), or the ``Gaussian`` that every trial's is drawn from.
        steps: K.
        seeds: One a trial; a number stands for 0 .. seeds - 1.
        noise: See ``closed_loop``.
        disturbances: Of all trials.
        on_failure: See ``closed_loop``; with ``"raise"`` a trial whose solve fails ends, and the others fly on.
        chunk: How many trials fly at a time; as many as the controller has a gigabyte for by default.

    Returns:
        One ``Trial`` a seed with its ``Rollout``, in the order of the seeds. Trials whose solve failed, by the policy,
        and whose plant diverged have an error instead.

    Raises:
        ShapeError: As for ``closed_loop``.
        SettingError: As for ``closed_loop``; no seeds or equal ones; a model loop, in which a seed changes nothing; or
            no ``chunk`` where the controller cannot say how much memory a trial takes.
    """
    if isinstance(plant, ModelLoop):
        raise SettingError("plant", "a model loop draws no random numbers, all seeds are one flight; take closed_loop")
    if getattr(plant.dynamics, "stateful", False):
        raise SettingError("plant", "a simulator flies one seed after another; take closed_loop")
    check_number("steps", steps, least=1, whole=True)
    check_policy(on_failure)
    seeds, horizon = _check_seeds(seeds), controller.horizon
    references = check_references(references, steps, horizon)
    size = chunk_size(controller, len(seeds), chunk=chunk)

    def decide(k: int, beliefs: Sequence[Gaussian], last: Sequence[Command | None]) -> list[Command | SolverFailure]:
        return commands(controller, beliefs, window(references, k, horizon), last, on_failure, k)

    finished: list[Trial] = []
    for start in range(0, len(seeds), size):
        some, flights, histories = seeds[start : start + size], [], []
        for seed in some:
            histories.append(History())
            simulator = PlantSimulator(plant, initial, disturbances, noise, seed)
            flights.append(Flight(simulator, histories[-1].recording(references)))
        fly(flights, decide, steps, plant.time_step)
        for seed, flight, history in zip(some, flights, histories, strict=True):
            rollout, error = None, flight.error
            if error is None:
                rollout = history.rollout(flight.simulator, references, plant.time_step)
            reason = None if error is None else f"{type(error).__name__}: {error}"
            finished.append(Trial(f"seed {seed}", seed, rollout, reason))
    return finished


def chunk_size(controller: Controller, trials: int, memory: int = _MEMORY, chunk: int | None = None) -> int:
    """Says how many trials fly at a time.

    Args:
        controller: It says what a question takes (``bytes_per_question``); one that decides one by one need not.
        trials: How many there are.
        memory: That may be taken for all that fly at a time [bytes].
        chunk: The result, where it is given.

    Raises:
        SettingError: A number below 1, or the controller cannot say what a question takes.
    """
    if chunk is not None:
        check_number("chunk", chunk, least=1, whole=True)
        return min(chunk, trials)
    if not hasattr(controller, "control_many"):
        return trials
    each = getattr(controller, "bytes_per_question", None)
    if each is None:
        raise SettingError("chunk", "the memory that this model takes is not known: say how many trials fly at a time")
    return min(trials, max(1, int(memory // each)))


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
