"""Flies chunks as tasks of a cluster of Ray."""

import logging
import os
import socket
from collections.abc import Generator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

from gpmpc.cli._folders import find_modules_here
from gpmpc.cli._launchers import Cause, Chunk, ChunkEnd, Work
from gpmpc.exceptions import GpmpcError, SettingError

_CAUSES = {
    "OutOfMemoryError": Cause.MEMORY,
    "TaskCancelledError": Cause.CANCELLED,
    "NodeDiedError": Cause.NODE,
    "LocalRayletDiedError": Cause.NODE,
    "OwnerDiedError": Cause.NODE,
    "ObjectLostError": Cause.NODE,
    "NodeAffinityError": Cause.NODE,
    "WorkerCrashedError": Cause.CRASH,
}
_REASONS = {
    Cause.MEMORY: "its node ran out of memory; more for each by "
    "hydra.launcher.ray.remote.memory=BYTES",
    Cause.CANCELLED: "its task was cancelled",
    Cause.NODE: "its node failed",
    Cause.CRASH: "its process died, and nobody says why",
}


class Ray:
    """Flies chunks as tasks of Ray.

    Args:
        tree: The sweep's folder, on a file system that all nodes see.
        ray: ``init`` and ``remote`` hold arguments of ``ray.init`` and ``ray.remote``.
    """

    workers = None

    def __init__(self, tree: Path, ray: Mapping[str, Any]):
        self.tree = tree
        try:
            self._ray: Any = import_module("ray")
        except ImportError as error:
            raise SettingError(
                "launcher", "this one is not installed: pip install 'gpmpc[ray]'"
            ) from error
        self._init = dict(ray["init"])
        # A run that died is flown again by the sweep, which counts how often.
        self._remote = dict(ray["remote"]) | {"max_retries": 0}

    def exclusive_launch(self) -> AbstractContextManager[object]:
        return nullcontext()

    def call(self, function: Work, argument: Any) -> None:
        function(argument)

    def adopt(self, paths: Set[str]) -> Sequence[Chunk]:
        """Returns none: Ray ends the tasks of a sweep that is killed."""
        return ()

    def launch(
        self, work: Work, chunks: Sequence[Chunk]
    ) -> Generator[ChunkEnd, None, None]:
        """Submits chunks; yields how they end.

        Raises:
            GpmpcError: There is no such cluster.
        """
        if not self._ray.is_initialized():
            try:
                self._ray.init(logging_level=logging.ERROR, **self._init)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise GpmpcError(
                    f"Ray: {' '.join(str(error).split())}; see docs/launchers.md"
                ) from error
        fly = self._ray.remote(**self._remote)(_fly)
        flying = {fly.remote(work, chunk, os.getcwd()): chunk for chunk in chunks}
        try:
            while flying:
                (task,), _ = self._ray.wait([*flying], num_returns=1)
                yield self._end(flying.pop(task), task)
        finally:
            for task in flying:
                self._ray.cancel(task, force=True)

    def close(self) -> None:
        self._ray.shutdown()

    def _end(self, chunk: Chunk, task: Any) -> ChunkEnd:
        """Returns how a task ended."""
        try:
            host = self._ray.get(task)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause or error
            reason = f"{type(cause).__name__}: {' '.join(str(cause).split())}"
            return ChunkEnd(chunk, "", Cause.ERROR, reason[-500:])
        except self._ray.exceptions.RayError as error:
            kind = type(error).__name__
            cause = _CAUSES.get(kind, Cause.ERROR)
            message = f"Ray could not fly it: {' '.join(str(error).split())[:300]}"
            reason = f"{_REASONS.get(cause, message)} ({kind})"
            return ChunkEnd(chunk, "", cause, reason)
        return ChunkEnd(chunk, host)


def _fly(work: Work, chunk: Chunk, folder: str) -> str:
    """Flies a chunk on a node; returns the node's name."""
    if os.path.isdir(folder):  # where relative paths start, such as of a model's file
        os.chdir(folder)
    find_modules_here()
    work(chunk)
    address = import_module("ray").util.get_node_ip_address()
    return f"{socket.gethostname()} ({address})"
