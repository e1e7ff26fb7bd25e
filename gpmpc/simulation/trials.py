"""Runs many seeds: any trial in parallel processes, or closed loops together in one.

In processes, a trial is a callable of its seed that a fresh process can import: a function of a module, or a frozen
dataclass with ``__call__`` that builds its controller itself. Together, all trials are measured, the controller decides
for all at once (``control_many``, where it has that), and the plant steps all at once. A trial's numbers are those of
``closed_loop`` with its seed, however many fly beside it.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from gpmpc.exceptions import GpmpcError, SettingError, SolverFailure, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.controller import Controller, Reference
from gpmpc.mpc.policy import Command, OnFailure, check_policy, commands
from gpmpc.parallel import cores, in_processes
from gpmpc.simulation.disturbances import Disturbance
from gpmpc.simulation.loop import Flight, History, check_references, fly, window
from gpmpc.simulation.simulator import ModelLoop, Noise, PlantSimulator
from gpmpc.systems import Plant


@dataclass(frozen=True)
class Trial:
    """The result of one seed."""

    name: str  # such as "seed 3"
    seed: int
    result: Any  # what the trial returned; None where it failed
    error: str | None  # why it failed, with the kind of the error; None where it did not


def trials(
    trial: Callable[[int], Any],
    seeds: int | Sequence[int],
    *,
    workers: int | None = None,
    progress: bool = True,
    label: str = "flying",
) -> list[Trial]:
    """Runs a trial with many seeds.

    A script calls it below ``if __name__ == "__main__":``, since every worker process imports the script.

    Args:
        trial: From a seed to a result, such as a ``Rollout``; both can be pickled.
        seeds: The seeds; a number stands for 0 .. seeds - 1.
        workers: Processes of one thread each; None takes one a core, 1 runs in this process.
        progress: Shows one bar.
        label: What stands before the bar.

    Returns:
        One ``Trial`` a seed, in the order of the seeds, whichever finished first.

    Raises:
        SettingError: No seeds, a seed twice, or a worker count below 1.
        GpmpcError: A worker process died.
    """
    seeds = _check_seeds(seeds)
    if workers is not None:
        check_number("workers", workers, least=1, whole=True)
    run = partial(_run, trial)
    serial = (workers or cores()) == 1 or len(seeds) == 1
    found: dict[int, Trial] = {}
    with _progress_bar(label, len(seeds), progress) as advance:
        try:
            with closing(_here(run, seeds) if serial else in_processes(run, seeds, workers)) as finished:
                for index, outcome in finished:
                    found[index] = outcome
                    advance()
        except BrokenProcessPool as error:
            missing = ", ".join(f"seed {seed}" for index, seed in enumerate(seeds) if index not in found)
            raise GpmpcError(
                f"a worker process died (out of memory?) with these trials unfinished: {missing}"
            ) from error
    return [found[index] for index in range(len(seeds))]


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
        noise: On states, measurements and inputs; a trial's draws are those of ``closed_loop`` with its seed.
        disturbances: Of all trials.
        on_failure: What a trial applies where its solve fails; see ``closed_loop``. With ``"raise"`` that trial ends,
            and the others fly on.
        chunk: How many trials fly at a time; as many as the controller has a gigabyte for by default.

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
            if flight.error is not None:
                finished.append(_failed(seed, flight.error))
            else:
                rollout = history.rollout(flight.simulator, references, plant.time_step)
                finished.append(Trial(f"seed {seed}", seed, rollout, None))
    return finished


def chunk_size(controller: Controller, trials: int, memory: int = 2**30, chunk: int | None = None) -> int:
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
    each = controller.bytes_per_question
    if each is None:
        raise SettingError("chunk", "the memory that this model takes is not known: say how many trials fly at a time")
    return min(trials, max(1, int(memory // each)))


def _check_seeds(seeds: int | Sequence[int]) -> list[int]:
    """Returns the seeds one by one.

    Raises:
        SettingError: There are none, or one is there twice or is no whole number from 0 on.
    """
    if isinstance(seeds, int | np.integer):
        check_number("seeds", int(seeds), least=1, whole=True)
        seeds = range(int(seeds))
    seeds = [int(seed) if isinstance(seed, np.integer) else seed for seed in seeds]
    for seed in seeds:
        check_number("seeds", seed, least=0, whole=True)
    if not seeds or len(set(seeds)) < len(seeds):
        raise SettingError("seeds", f"must be one or more different whole numbers; got {seeds}")
    return seeds


def _failed(seed: int, error: Exception) -> Trial:
    """Makes the trial of a seed that failed."""
    return Trial(f"seed {seed}", seed, None, f"{type(error).__name__}: {error}")


def _run(trial: Callable[[int], Any], seed: int) -> Trial:
    """Runs one trial; its error is a result like any other, so that the others go on."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return Trial(f"seed {seed}", seed, trial(seed), None)
    except Exception as error:
        return _failed(seed, error)
    finally:
        torch.set_num_threads(threads)


def _here(run: Callable[[int], Trial], seeds: Sequence[int]) -> Iterator[tuple[int, Trial]]:
    for index, seed in enumerate(seeds):
        yield index, run(seed)


@contextmanager
def _progress_bar(label: str, total: int, shown: bool) -> Iterator[Callable[[], None]]:
    """Shows one progress bar, or none; yields the function to call after every trial."""
    if not shown:
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns) as progress:
        task = progress.add_task(label, total=total)
        yield lambda: progress.advance(task)
