"""Starts the processes that fly a sweep's runs, and tells how each of them ended.

A launcher is handed chunks: runs that one process flies, one after another. It knows
nothing of a run but its folder, and says of a chunk only how its process ended. How far
its runs are is read from their folders, see ``_flying``.

``conf/launcher/`` lists them: in this process, in processes of this machine (here), as
jobs of Slurm (``_slurm``), and as tasks of Ray (``_ray``).
"""

import os
import re
import socket
from collections.abc import Callable, Generator, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from joblib import effective_n_jobs
from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.backend import resource_tracker
from omegaconf import DictConfig, OmegaConf

from gpmpc.cli._terminal import OutputEnded
from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.parallel import children_ignore_interrupts, end_with
from gpmpc.studies._run_folder import RunFolder


class Chunk(Protocol):
    """Runs that one process flies: what launchers ask of a ``_chunks.Chunk``.

    It can be pickled.
    """

    @property
    def folders(self) -> Sequence[RunFolder]:
        """Their folders, with absolute paths, in the order of flight."""
        ...


# Module of this room and class by name in the settings.
_CLASSES = {
    "basic": ("_launchers", "Basic"),
    "joblib": ("_launchers", "Joblib"),
    "slurm": ("_slurm", "Slurm"),
    "ray": ("_ray", "Ray"),
}
# Flies a chunk; of a module, so that it can be pickled.
Work = Callable[[Any], object]


class Cause(Enum):
    """Why a process did not fly its chunk to the end."""

    CANCELLED = "cancelled"
    TIME = "time"
    MEMORY = "memory"
    NODE = "node"
    #: the process died, and nobody knows why
    CRASH = "crash"
    #: it could not begin, an exception came out of it, or what it flew is not seen
    ERROR = "error"


@dataclass(frozen=True)
class ChunkEnd:
    """How the process of a chunk ended."""

    chunk: Any
    #: that it ran on, as far as known
    host: str = ""
    #: None where it says that it is done
    cause: Cause | None = None
    #: the cause in a line
    reason: str = ""
    #: when another call launched it, which this one found running [ns]; None where
    #: this one did
    adopted_from: int | None = None


class Refused(GpmpcError):
    """A launcher takes no process.

    Args:
        message: Why, in a line.
        has_launched: Whether it has taken others of this sweep before.
    """

    def __init__(self, message: str, has_launched: bool = False):
        super().__init__(message)
        self.has_launched = has_launched


class Launcher(Protocol):
    """Starts processes for chunks."""

    @property
    def workers(self) -> int | None:
        """Processes at the same time; None where that is the cluster's business."""
        ...

    def exclusive_launch(self) -> AbstractContextManager[object]:
        """Keeps other sweeps of this tree from launching inside."""
        ...

    def call(self, function: Work, argument: Any) -> None:
        """Calls a function that needs what flies, such as torch.

        A launcher whose processes wait for runs on this machine calls it in one of
        them, so that nothing is loaded here; the others call it here. Its exceptions
        come back as they are.
        """
        ...

    def adopt(self, paths: Set[str]) -> Sequence[Chunk]:
        """Adopts chunks of another call whose end nobody has seen yet.

        They are those with any of the folders ``paths``; ``launch`` tells their ends.
        """
        ...

    def launch(
        self, work: Work, chunks: Sequence[Chunk]
    ) -> Generator[ChunkEnd, None, None]:
        """Starts ``chunks``, and yields how they and the adopted ones end.

        Adopted are those that the last call of ``adopt`` returned.

        Some may be left for a later call, where there is no room for all.

        Raises:
            Refused: It takes none, and none is running.
        """
        ...

    def close(self) -> None:
        """Ends the processes that only wait for more."""
        ...


def launcher_of(config: DictConfig, tree: Path) -> Launcher:
    """Makes the launcher that the settings name.

    Args:
        config: The settings, with Hydra's own.
        tree: The sweep's folder.
    """
    node = config.hydra.launcher
    if node is None or "name" not in node:  # settings of the user's own, without one
        return Basic(tree.absolute())
    settings: Any = OmegaConf.to_container(node, resolve=True)
    name = settings.pop("name")
    if name not in _CLASSES:
        raise SettingError(
            "hydra.launcher.name", f"must be one of {', '.join(_CLASSES)}; got {name!r}"
        )
    module, class_name = _CLASSES[name]
    launcher = getattr(import_module(f"gpmpc.cli.{module}"), class_name)
    return launcher(tree=tree.absolute(), **settings)


class Basic:
    """Flies chunks in this process."""

    workers = 1

    def __init__(self, tree: Path):
        self.tree = tree

    def exclusive_launch(self) -> AbstractContextManager[object]:
        return nullcontext()

    def call(self, function: Work, argument: Any) -> None:
        function(argument)

    def adopt(self, paths: Set[str]) -> Sequence[Chunk]:
        return ()

    def launch(
        self, work: Work, chunks: Sequence[Chunk]
    ) -> Generator[ChunkEnd, None, None]:
        for chunk in chunks:
            try:
                work(chunk)
            except OutputEnded:  # the command ends, and no run has failed
                raise
            except (Exception, SystemExit) as error:
                yield _end_by(error, chunk)
            else:
                yield ChunkEnd(chunk, socket.gethostname())

    def close(self) -> None:
        pass


class Joblib:
    """Flies chunks in processes of this machine, by joblib's executors.

    Each process has an executor of its own: where one dies, the others go on.

    Args:
        tree: The sweep's folder.
        n_jobs: Processes; negative ones count from the number of cores, as in joblib.
    """

    def __init__(self, tree: Path, n_jobs: int = -1):
        self.tree = tree
        key = "hydra.launcher.n_jobs"
        check_number(key, n_jobs, whole=True)
        if n_jobs == 0:
            raise SettingError(key, "must be the number of processes, or -1; got 0")
        self.workers = effective_n_jobs(n_jobs)
        self._idle: list[ProcessPoolExecutor] = []

    def exclusive_launch(self) -> AbstractContextManager[object]:
        return nullcontext()

    def call(self, function: Work, argument: Any) -> None:
        """Calls it in a process that flies chunks later."""
        future, executor = self._submit(function, argument)
        self._idle.append(executor)  # already now: after a Ctrl-C it is closed as well
        try:
            future.result()
        except BrokenExecutor as error:
            self._idle.remove(executor)
            executor.shutdown(wait=False, kill_workers=True)
            raise GpmpcError(
                "a process that tried the settings died: by a crash, for want of "
                "memory, or by hand"
            ) from error

    def _submit(
        self, work: Work, argument: Any
    ) -> tuple[Future[Any], ProcessPoolExecutor]:
        """Hands work to a process that waits for more, or to a new one."""
        while self._idle:
            executor = self._idle.pop()
            try:
                with children_ignore_interrupts():
                    return executor.submit(work, argument), executor
            except BrokenExecutor:  # its process died while it waited
                executor.shutdown(wait=False, kill_workers=True)
        executor = _new_executor()
        with children_ignore_interrupts():
            return executor.submit(work, argument), executor

    def adopt(self, paths: Set[str]) -> Sequence[Chunk]:
        return ()

    def launch(
        self, work: Work, chunks: Sequence[Chunk]
    ) -> Generator[ChunkEnd, None, None]:
        waiting = list(reversed(chunks))
        flying: dict[Future[Any], tuple[Chunk, ProcessPoolExecutor]] = {}
        try:
            while waiting or flying:
                while waiting and len(flying) < self.workers:
                    chunk = waiting.pop()
                    future, executor = self._submit(work, chunk)
                    flying[future] = chunk, executor
                for future in wait(flying, return_when=FIRST_COMPLETED).done:
                    chunk, executor = flying.pop(future)
                    error = future.exception()
                    if isinstance(error, BrokenExecutor):
                        executor.shutdown(wait=False, kill_workers=True)
                    else:
                        self._idle.append(executor)
                    if error is not None:
                        yield _end_by(error, chunk)
                    else:
                        yield ChunkEnd(chunk, socket.gethostname())
        finally:
            for _, executor in flying.values():
                executor.shutdown(wait=False, kill_workers=True)

    def close(self) -> None:
        while self._idle:
            self._idle.pop().shutdown(kill_workers=True)


def _new_executor() -> ProcessPoolExecutor:
    """Returns an executor of one process, which ends with this one."""
    resource_tracker.ensure_running()  # as in ``children_ignore_interrupts``
    return ProcessPoolExecutor(1, initializer=end_with, initargs=(os.getpid(),))


def _end_by(error: BaseException, chunk: Chunk) -> ChunkEnd:
    """Returns how a chunk on this machine ended by an exception."""
    host = socket.gethostname()
    text = " ".join(str(error).split())
    if not isinstance(error, BrokenExecutor):
        reason = f"{type(error).__name__}: {text}"
        return ChunkEnd(chunk, host, Cause.ERROR, reason)
    codes = re.search(r"exit codes of the workers are \{(.*?)\}", text)
    how = f" ({codes[1]})" if codes else ""
    reason = (
        f"its process on {host} died{how}: by a crash, for want of memory, or by hand"
    )
    return ChunkEnd(chunk, host, Cause.CRASH, reason)
