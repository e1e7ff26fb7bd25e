"""Independent jobs in processes of their own, one thread each.

Jobs run in freshly started processes (spawn: it is safe with threads and the same on
every system), one thread each. On Ctrl-C, which reaches the whole process group, the
parent alone answers: running jobs are ended, nothing hangs. Where the parent itself is
killed, its workers end by themselves.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import active_children, get_context, resource_tracker
from typing import TypeVar

__all__ = ["in_processes"]

J = TypeVar("J")
R = TypeVar("R")

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PARENT_CHECK_INTERVAL = 0.5  # between two checks whether the parent lives [s]


def in_processes(
    function: Callable[[J], R], jobs: Sequence[J], workers: int | None = None
) -> Generator[tuple[int, R], None, None]:
    """Yields (index of a job, its result), in the order in which they finish.

    Args:
        function: Returns the result of a job; it and its results can be pickled. Its
            exceptions end the whole run.
        jobs: The jobs, started in this order.
        workers: Number of processes; None takes one per core.

    Raises:
        BrokenProcessPool: A worker process died.
    """
    if not jobs:
        return
    workers = min(workers or _count_cores(), len(jobs))
    children_before = set(active_children())
    with (
        _one_thread_each(),
        ProcessPoolExecutor(
            workers,
            get_context("spawn"),
            initializer=end_with,
            initargs=(os.getpid(),),
        ) as pool,
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
            for child in set(active_children()) - children_before:
                child.terminate()
            raise


def _count_cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def end_with(parent: int) -> None:
    """Ends this process soon after its parent.

    The parent itself states its id: it may be gone before this call. An orphan would
    compute results that nobody reads, or wait for jobs that do not come, and hold the
    terminal's pipe open.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_CHECK_INTERVAL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def children_ignore_interrupts() -> Iterator[None]:
    """Keeps Ctrl-C from processes started inside, from their first moment on.

    This process gets it at the end of the block, or at once where it has another
    thread.
    """
    # whenever the tracker starts, it unblocks the signal that is blocked here
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Gives worker processes started inside one thread each, in every library."""
    before = {name: os.environ[name] for name in THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name in THREADS:
            del os.environ[name]
        os.environ.update(before)
