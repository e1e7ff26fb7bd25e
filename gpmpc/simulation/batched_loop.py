"""Problem: a thousand flights with a thousand seeds ask one Gaussian process a thousand questions at the same time.

``closed_loops`` flies many trials in step: all are measured, the controller answers all at once (``control_many``,
where it has that), the plant steps all at once. A trial's numbers are those of ``closed_loop`` with its seed, however
many fly beside it. What grows with their number is memory, so they fly in chunks, one after the other.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpmpc.exceptions import Diverged, SettingError, SolverFailure, check_number
from gpmpc.mpc.controller import Controller, Reference
from gpmpc.mpc.supervision import Command, OnFailure, check_policy, commands
from gpmpc.simulation.disturbances import Disturbance
from gpmpc.simulation.loop import Kept, Step, checked_references, kept, rollout, window
from gpmpc.simulation.systems import ModelLoop, Noise, RunningPlant
from gpmpc.simulation.trials import Trial, checked_seeds, failed, progress_bar
from gpmpc.systems import Plant, step_many

MEMORY = 2**30  # what the controller may take for all that fly at a time [bytes]


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
    memory: int = MEMORY,
    chunk: int | None = None,
    progress: bool = False,
) -> list[Trial]:
    """Flies a controller on a plant with many seeds at once.

    Args:
        plant: What is steered; its right-hand side is evaluated on arrays, an entry a trial.
        controller: Its feedback law, of all trials; a ``GPMPC`` answers them together, any other one by one.
        references: Of all trials; see ``closed_loop``.
        initial: The state (n,), or the ``Gaussian`` that every trial's is drawn from.
        steps: K.
        seeds: One a trial; a number stands for 0 .. seeds - 1.
        noise: On states, measurements and inputs; a trial's draws are those of ``closed_loop`` with its seed.
        disturbances: Of all trials.
        on_failure: What a trial applies where its solve fails; see ``closed_loop``. With ``"raise"`` that trial ends,
            and the others fly on.
        memory: How much the controller may take for all trials that fly at a time [bytes].
        chunk: How many trials fly at a time, whatever that takes.
        progress: Shows one bar.

    Returns:
        One ``Trial`` a seed with its ``Rollout``, in the order of the seeds. Trials whose solve failed, by the policy,
        and whose plant diverged have an error instead.

    Raises:
        ShapeError: As for ``closed_loop``.
        SettingError: As for ``closed_loop`` and ``trials``; a model loop, in which a seed changes nothing; or no
            ``chunk`` where the controller cannot say how much memory a trial takes.
    """
    if isinstance(plant, ModelLoop):
        raise SettingError("plant", "a model loop draws no random numbers, all seeds are one flight; take closed_loop")
    check_number("steps", steps, least=1, whole=True)
    check_policy(on_failure)
    seeds = checked_seeds(seeds)
    references = checked_references(references, steps, controller.horizon)
    size = chunk_size(controller, len(seeds), memory, chunk)
    finished: list[Trial] = []
    with progress_bar("flying", len(seeds), progress) as advance:
        for start in range(0, len(seeds), size):
            flights = [
                _Flight(RunningPlant(plant, initial, disturbances, noise, seed), seed)
                for seed in seeds[start : start + size]
            ]
            for k in range(steps):
                ahead, time = window(references, k, controller.horizon), round(k * plant.time_step, 9)
                _step(controller, [flight for flight in flights if flight.error is None], ahead, on_failure, k, time)
            for flight in flights:
                finished.append(flight.trial(references, plant.time_step))
                advance()
    return finished


def chunk_size(controller: Controller, trials: int, memory: int = MEMORY, chunk: int | None = None) -> int:
    """How many trials fly at a time.

    Args:
        controller: It says what a question takes (``bytes_per_question``); one that answers one by one need not.
        trials: How many there are.
        memory: That may be taken for all that fly at a time [bytes].
        chunk: The answer, where it is given.

    Raises:
        SettingError: A number below 1, or the controller cannot say what a question takes.
    """
    check_number("memory", memory, least=1, unit="[bytes]")
    if chunk is not None:
        check_number("chunk", chunk, least=1, whole=True)
        return min(chunk, trials)
    if not hasattr(controller, "control_many"):
        return trials
    each = controller.bytes_per_question
    if each is None:
        raise SettingError("chunk", "the memory that this model takes is not known: say how many trials fly at a time")
    return min(trials, max(1, int(memory // each)))


class _Flight:
    """One trial under way."""

    def __init__(self, running: RunningPlant, seed: int):
        self.running, self.seed = running, seed
        self.taken: list[Kept] = []
        self.last: Command | None = None
        self.error: Exception | None = None

    def trial(self, references: Reference, time_step: float) -> Trial:
        if self.error is not None:
            return failed(self.seed, self.error)
        return Trial(
            f"seed {self.seed}", self.seed, rollout(self.taken, references, time_step, self.running.mean), None
        )


def _step(
    controller: Controller, flights: list[_Flight], reference: Reference, on_failure: OnFailure, k: int, time: float
) -> None:
    """``gpmpc.simulation.loop.one_step`` for many."""
    beliefs = [flight.running.measure(time) for flight in flights]
    asked = commands(controller, beliefs, reference, [flight.last for flight in flights], on_failure, k)
    moving = []
    for flight, belief, command in zip(flights, beliefs, asked, strict=True):
        if isinstance(command, SolverFailure):
            flight.error = command
        else:
            moving.append((flight, belief, command, *flight.running.act(time, command.input)))
    if not moving:
        return
    plant = moving[0][3]  # disturbances look at the time, not at a trial
    with np.errstate(over="ignore", invalid="ignore"):
        states = step_many(plant, np.array([m[0].running.mean for m in moving]), np.array([m[4] for m in moving]))
    for (flight, belief, command, _, acted), state in zip(moving, states, strict=True):
        before, running = flight.running.mean, flight.running
        try:
            running.arrive(state, acted)
        except Diverged as error:
            flight.error = error
            continue
        measured = belief.mean.cpu().numpy().astype(float)
        step = Step(k, time, before, running.covariance, measured, reference, command, acted, running.mean)
        flight.taken.append(kept(step))
        flight.last = command
