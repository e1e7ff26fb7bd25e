"""Problem: one flight is an anecdote; an experiment has to be flown with many seeds, and none may stop the others.

Seeds are independent, so they run in parallel processes. A trial is a callable of its seed that a fresh process can
import: a function of a module, or a frozen dataclass with ``__call__`` that builds its controller itself. (A script
that calls ``trials`` does so under ``if __name__ == "__main__":``.)
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.parallel import cores, in_processes


@dataclass(frozen=True)
class Trial:
    """What came of one seed.

    Attributes:
        name: Of the trial, such as "seed 3".
        seed: Its seed.
        result: What it returned; None where it failed.
        error: Why it failed, with the kind of the error; None where it did not.
    """

    name: str
    seed: int
    result: Any
    error: str | None


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
    seeds = checked_seeds(seeds)
    if workers is not None:
        check_number("workers", workers, least=1, whole=True)
    run = partial(_run, trial)
    serial = (workers or cores()) == 1 or len(seeds) == 1
    found: dict[int, Trial] = {}
    with progress_bar(label, len(seeds), progress) as advance:
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


def checked_seeds(seeds: int | Sequence[int]) -> list[int]:
    """The seeds one by one.

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


def failed(seed: int, error: Exception) -> Trial:
    """The trial of a seed that came to nothing."""
    return Trial(f"seed {seed}", seed, None, f"{type(error).__name__}: {error}")


def _run(trial: Callable[[int], Any], seed: int) -> Trial:
    """One trial; its error is a result like any other, so that the others go on."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return Trial(f"seed {seed}", seed, trial(seed), None)
    except Exception as error:
        return failed(seed, error)
    finally:
        torch.set_num_threads(threads)


def _here(run: Callable[[int], Trial], seeds: Sequence[int]) -> Iterator[tuple[int, Trial]]:
    for index, seed in enumerate(seeds):
        yield index, run(seed)


@contextmanager
def progress_bar(label: str, total: int, shown: bool) -> Iterator[Callable[[], None]]:
    """One progress bar, or none; gives the function to call after every trial."""
    if not shown:
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns) as progress:
        task = progress.add_task(label, total=total)
        yield lambda: progress.advance(task)
