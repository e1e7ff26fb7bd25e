"""Problem: a sweep needs hundreds of trainings: draws of the training set, sizes, seeds, each with six outputs.

What can run side by side is one output of one set, with all its restarts: the jobs are those, the largest first, on
every core, one thread each. Each is the same arithmetic as in a training alone on one thread, so the numbers are the
same, bit by bit. (The evaluations of 24 searches as one batch in torch were measured beside it: 14 instead of 31
microseconds each at N = 10, where the search around them takes another 37; 66 instead of 78 at 50; 1400 instead of 570
at 189. Processes gain a factor of the cores at any size.)

A job that trains and goes on to use what it found (``gpmpc.experiments.tables``) runs under the same
``gpmpc.parallel.in_processes`` as a whole.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial

import numpy as np

from gpmpc.exceptions import ShapeError, TrainingError, check_number
from gpmpc.gp.hyperparameter_search import Found, find_hyperparameters
from gpmpc.gp.training import Trainer, Training, check_memory, needed_memory
from gpmpc.gp.transitions import Transitions, check_transitions
from gpmpc.memory import GIB, available_memory
from gpmpc.parallel import cores, in_processes

PROCESS = 0.4 * GIB  # bytes that a worker takes before it has data: torch and its kin


def train_many(
    trainer: Trainer,
    sets: Sequence[Transitions],
    seeds: int | Sequence[int] = 0,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Training | TrainingError]:
    """Trains on many sets of transitions at once, on every core; as ``trainer(set, seed)`` one after another.

    A script calls it below ``if __name__ == "__main__":``, since every worker process imports the script.

    Args:
        trainer: Its settings; picklable.
        sets: Of any sizes and dimensions.
        seeds: One a set, or one for all.
        workers: Processes; None takes one a core, or fewer where memory asks for it. Starting them takes seconds: a few
            small trainings are faster alone.
        progress: Called with the number of outputs fitted so far, and of all.

    Returns:
        One training a set, in their order; the error instead where every start failed for one of its outputs.

    Raises:
        SettingError: A seed or the number of workers is out of range.
        ShapeError: There are not as many seeds as sets.
        DataError: The kernel matrices would not fit the memory that is available, those of all workers or all results.
    """
    if workers is not None:
        check_number("workers", workers, least=1, whole=True)
    seeds = [int(seeds)] * len(sets) if isinstance(seeds, int | np.integer) else list(seeds)
    for seed in seeds:
        check_number("seeds", seed, least=0, whole=True)
    if len(seeds) != len(sets):
        raise ShapeError(f"one seed a set is needed, or one for all; got {len(seeds)} for {len(sets)} sets")
    for one in sets:
        check_transitions(one)
    problems = [
        trainer.problem(one.features, one.targets(trainer.predicts), one.input_dim, trainer.predicts, seed)
        for one, seed in zip(sets, seeds, strict=True)
    ]
    places = [(s, a) for s, problem in enumerate(problems) for a in range(len(problem.tasks))]
    places.sort(key=lambda place: -len(sets[place[0]]))  # the last jobs to run are then short ones
    tasks = [problems[s].tasks[a] for s, a in places]
    if not tasks:
        return []
    shapes = [(len(one), one.state_dim) for one in sets]
    workers = min(workers, len(tasks)) if workers else _workers_that_fit(shapes, trainer.likelihood, len(tasks))
    check_memory(shapes, trainer.likelihood, workers)
    found: dict[tuple[int, int], Found] = {}
    with closing(in_processes(partial(find_hyperparameters, trainer=trainer), tasks, workers)) as finished:
        for index, result in finished:
            found[places[index]] = result
            if progress is not None:
                progress(len(found), len(tasks))
    trainings: list[Training | TrainingError] = []
    for s, problem in enumerate(problems):
        try:
            trainings.append(problem.solved([found[s, a] for a in range(len(problem.tasks))]))
        except TrainingError as error:  # of this set; the others stand
            trainings.append(error)
    return trainings


def _workers_that_fit(shapes: Sequence[tuple[int, int]], likelihood: str, tasks: int) -> int:
    free, workers = available_memory(), min(cores(), tasks)
    while free is not None and workers > 1:
        if needed_memory(shapes, likelihood, workers) + workers * PROCESS <= free:
            break
        workers -= 1
    return workers
