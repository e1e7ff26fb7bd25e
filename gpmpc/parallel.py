"""Independent jobs in processes of their own, one thread each.

Jobs run in freshly started processes (spawn: it is safe with threads and the same on every system), one thread each. On
Ctrl-C, which reaches the whole process group, the parent alone answers: what is running is ended, nothing hangs. Where
the parent itself is killed, its workers end by themselves.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import active_children, get_context, resource_tracker
from typing import Any, TypeVar

J = TypeVar("J")
R = TypeVar("R")

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_LOOK = 0.5  # between two looks at whether the parent lives [s]


def in_processes(
    function: Callable[[J], R], jobs: Sequence[J], workers: int | None = None
) -> Generator[tuple[int, R], None, None]:
    """Yields (index of a job, its result), in the order in which they finish.

    Args:
        function: Of a job; it and its results can be pickled. Its exceptions end the whole run.
        jobs: Started in this order.
        workers: Processes; None takes one a core.

    Raises:
        BrokenProcessPool: A worker process died.
    """
    if not jobs:
        return
    cores = (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )
    workers = min(workers or cores, len(jobs))
    before = set(active_children())
    mine: dict[str, Any] = {"initializer": end_with, "initargs": (os.getpid(),)}
    with (
        _one_thread_each(),
        ProcessPoolExecutor(workers, get_context("spawn"), **mine) as pool,
    ):
        try:  # around the start as well: leaving the pool waits for what was begun
            with children_ignore_interrupts():
                running = {
                    pool.submit(function, job): index for index, job in enumerate(jobs)
                }
            for done in as_completed(running):
                yield running[done], done.result()
        except BaseException:  # a failed job, Ctrl-C, or a caller that wants no more
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(active_children()) - before:
                child.terminate()
            raise


def end_with(parent: int) -> None:
    """Ends this process soon after its parent, whose id the parent itself states: it may be gone before this call.

    An orphan would compute what nobody reads, or wait for jobs that do not come, and hold the terminal's pipe open.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def children_ignore_interrupts() -> Iterator[None]:
    """Processes started inside do not hear Ctrl-C, from their first moment on.

    This one hears it at the end of the block, or at once where it has another thread.
    """
    resource_tracker.ensure_running()  # whenever it starts, it unblocks what is blocked here
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Worker processes started inside use one thread each, whatever library asks."""
    before = {name: os.environ[name] for name in THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name in THREADS:
            del os.environ[name]
        os.environ.update(before)
