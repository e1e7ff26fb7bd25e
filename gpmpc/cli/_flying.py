"""Flies the runs of a sweep until the folder of each says that it finished or failed.

    runs -> chunks -> launcher -> ends of processes -> folders looked at -> settled,
    or flown again

What a process says of its runs is not believed: a run counts by its own folder alone.
One that its process could not finish is a failed run with the reason in its
``error.json``, by the cause:

- cancelled, or an error outside of any run: all unfinished runs of the chunk;
- wall time or memory: the run that was being flown. Those behind it fly again now;
- a node, or the process, died: likewise, and the run that was being flown flies again,
  too, until it has had ``retries`` attempts more than the first.
"""

import os
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

from gpmpc._provenance import provenance
from gpmpc.cli._launchers import Cause, Chunk, ChunkEnd, Launcher, Refused, Work
from gpmpc.studies._run_folder import Busy, RunFolder, RunState

_LOOK_INTERVAL = 1.0  # between two looks at runs in other hands [s]
_LATE = 30.0  # after which a shared file system shows what another machine wrote [s]
_REPEATED = (Cause.NODE, Cause.CRASH)
_OF_THE_WHOLE_CHUNK = (Cause.CANCELLED, Cause.ERROR)


class Job(Protocol):
    """One run of a sweep: what is asked of a ``_chunks.Job`` here."""

    @property
    def folder(self) -> RunFolder:
        """Where it is kept, with an absolute path."""
        ...

    @property
    def choices(self) -> Sequence[str]:
        """What distinguishes it, ``key=value`` each."""
        ...


@dataclass
class _OpenJob:
    """A job that is not settled yet."""

    job: Job
    #: when the attempt failed whose failure does not count [ns]; None: every one does
    failure_to_ignore: int | None
    #: when the last attempt before the launch began [ns]; None: there was none, or an
    #: adopted chunk has the job, and when that began it is not known
    begun_before_launch: int | None = None

    @property
    def path(self) -> str:
        """Where it is kept."""
        return str(self.job.folder.path)

    @property
    def begun_since_launch(self) -> bool:
        """Whether an attempt was begun since the chunks were started."""
        return self.job.folder.begun_at != self.begun_before_launch


OnSettled = Callable[[Any, RunState], None]  # takes a job, which finished or failed


@dataclass
class Flying:
    """The runs of a sweep in the hands of a launcher.

    Args:
        launcher: Starts the processes.
        work: Flies a chunk, there.
        chunked: Groups jobs into chunks.
        on_settled: Called once for every job, when it has finished or failed.
        retries: How often a run is flown again that was ended from outside.
    """

    launcher: Launcher
    work: Work
    chunked: Callable[[Sequence[Any]], Sequence[Chunk]]
    on_settled: OnSettled
    retries: int
    #: runs that flew again in this call, since their process or node died; paths
    flown_again_now: set[str] = field(default_factory=set)
    #: runs that were ended from outside before, and fly once more; paths
    flown_again_from_before: list[str] = field(default_factory=list)
    #: runs that were ended from outside too often, and do not fly; attempts by path
    out_of_retries: dict[str, int] = field(default_factory=dict)
    #: why runs failed whose folders cannot be written, such as on a full disk, by path
    reasons_not_kept: dict[str, str] = field(default_factory=dict)
    _has_launched: bool = False
    _open: dict[str, _OpenJob] = field(default_factory=dict)  # by path

    def fly(self, jobs: Iterable[Any]) -> None:
        """Flies jobs; returns when each is settled."""
        for job in jobs:
            self._add(job)
        while self._open:
            if not self._fly_once():
                time.sleep(_LOOK_INTERVAL)

    def _add(self, job: Job) -> None:
        """Takes a job on, unless it was ended from outside too often."""
        path = str(job.folder.path)
        failed_at = job.folder.failed_at
        attempts = 0 if failed_at is None else job.folder.outside_attempts
        if attempts > self.retries:
            self.out_of_retries[path] = attempts
            self.on_settled(job, RunState.FAILED)
            return
        if attempts:
            self.flown_again_from_before.append(path)
        self._open[path] = _OpenJob(job, failure_to_ignore=failed_at)

    def _fly_once(self) -> bool:
        """Flies the jobs that nobody works on, and settles those that have ended.

        Returns:
            Whether any were flown; else all of them are in the hands of other sweeps.
        """
        with self.launcher.exclusive_launch():
            running = self.launcher.adopt({*self._open})
            ends = self._launch(running)
        if ends is None:
            return False
        unseen: list[tuple[_OpenJob, ChunkEnd]] = []
        with closing(ends):  # at once where an interrupt comes
            for end in ends:
                if end.adopted_from is not None:
                    self._count_failures_since(end.adopted_from, end.chunk)
                if end.cause is not None:
                    self._settle_dead_chunk(end)
                    continue
                unsettled = self._unsettled(end.chunk)
                # A chunk flies at least one run, and may stop after any, and leave the
                # others: only where none has ended, something is wrong.
                if len(unsettled) == len(end.chunk.folders):
                    unseen += [(open_job, end) for open_job in unsettled]
        self._judge_unseen(unseen)
        return True

    def _count_failures_since(self, launched: int, chunk: Chunk) -> None:
        """Lets failures of an adopted chunk count, also those before this sweep looked.

        Args:
            launched: When the chunk was launched [ns]; what failed before is of an
                earlier call.
            chunk: Whose runs they are.
        """
        for open_job in self._open_jobs(chunk):
            failed_at = open_job.job.folder.failed_at
            if failed_at is not None and failed_at > launched:
                open_job.failure_to_ignore = None

    def _launch(
        self, running: Sequence[Chunk]
    ) -> Generator[ChunkEnd, None, None] | None:
        """Launches the jobs that nobody works on; None where there is none."""
        in_hand = {path for chunk in running for path in _paths(chunk)}
        to_fly = []
        for path, open_job in [*self._open.items()]:
            open_job.begun_before_launch = None
            if path in in_hand:
                continue
            folder = open_job.job.folder
            open_job.begun_before_launch = folder.begun_at
            state = folder.state
            if not self._settle(open_job) and state is not RunState.RUNNING:
                to_fly.append(open_job.job)
        if not to_fly and not in_hand:
            return None
        chunks = self.chunked(to_fly) if to_fly else ()
        try:
            ends = self.launcher.launch(self.work, chunks)
        except Refused as error:
            raise Refused(str(error), self._has_launched) from error
        self._has_launched = True
        return ends

    def _open_jobs(self, chunk: Chunk) -> list[_OpenJob]:
        """Returns the jobs of a chunk that are not known to be settled."""
        return [self._open[path] for path in _paths(chunk) if path in self._open]

    def _unsettled(self, chunk: Chunk) -> list[_OpenJob]:
        """Settles jobs of a chunk; returns those that are not."""
        return [one for one in self._open_jobs(chunk) if not self._settle(one)]

    def _settle(self, open_job: _OpenJob) -> bool:
        """Takes a job off the list where it has finished, or failed in this call."""
        job = open_job.job
        state = job.folder.outcome_since(open_job.failure_to_ignore)
        if state is None:
            return False
        del self._open[open_job.path]
        self.on_settled(job, state)
        return True

    def _settle_dead_chunk(self, end: ChunkEnd) -> None:
        """Settles what a process left that died, or was ended, before its chunk."""
        _list_folders(end.chunk)
        abandoned = [
            open_job
            for open_job in self._unsettled(end.chunk)
            if open_job.job.folder.state is not RunState.RUNNING
        ]
        if end.cause not in _OF_THE_WHOLE_CHUNK:
            # Only runs begun since the launch count; if none had begun, the process
            # died while starting, and all of the chunk count.
            begun = [one for one in abandoned if one.begun_since_launch]
            abandoned = begun or abandoned
        for open_job in abandoned:
            self._end_from_outside(open_job, end)

    def _end_from_outside(self, open_job: _OpenJob, end: ChunkEnd) -> None:
        """Makes a job a failed one, or leaves it to be flown again."""
        job = open_job.job
        cause = end.cause or Cause.ERROR
        # What ends a whole chunk says nothing of runs that were not begun.
        is_attempt = cause not in _OF_THE_WHOLE_CHUNK or open_job.begun_since_launch
        about = {
            "schema": 1,
            "choices": [*job.choices],
            "settings": {},
            "host": end.host or job.folder.last_worker,
            "provenance": self._provenance,
        }
        try:
            job.folder.end_from_outside(end.reason, cause.value, about, is_attempt)
        except Busy:  # another sweep works on it: its outcome counts
            return
        except OSError as error:
            problem = error.strerror or error
            reason = f"{end.reason} (its folder does not say so: {problem})"
            self._settle_without_file(open_job, reason)
            return
        if cause in _REPEATED and job.folder.outside_attempts <= self.retries:
            self.flown_again_now.add(open_job.path)
            open_job.failure_to_ignore = job.folder.failed_at
            return
        self._settle(open_job)

    def _settle_without_file(self, open_job: _OpenJob, reason: str) -> None:
        """Takes a job off the list that failed, and whose folder cannot say so."""
        self.reasons_not_kept[open_job.path] = reason
        del self._open[open_job.path]
        self.on_settled(open_job.job, RunState.FAILED)

    @cached_property
    def _provenance(self) -> dict[str, Any]:
        """Of all failures that this process writes."""
        return provenance()

    def _judge_unseen(self, unseen: Sequence[tuple[_OpenJob, ChunkEnd]]) -> None:
        """Fails the jobs that a process said to be done, and that are not there."""
        deadline = time.monotonic() + _LATE
        while unseen and time.monotonic() < deadline:
            unseen = [
                (open_job, end)
                for open_job, end in unseen
                if not self._settle_late(open_job) and not open_job.begun_since_launch
            ]
            if unseen:
                time.sleep(_LOOK_INTERVAL)
        for open_job, end in unseen:
            host = end.host or "the process that flew it"
            tree = open_job.job.folder.path.parent
            reason = (
                f"{host} says that it flew this run, and it is not in the folder; "
                f"does {host} see {tree}?"
            )
            unseen_end = ChunkEnd(end.chunk, end.host, Cause.ERROR, reason)
            self._end_from_outside(open_job, unseen_end)

    def _settle_late(self, open_job: _OpenJob) -> bool:
        """Settles a job after its tree was listed, which shows what others wrote."""
        os.listdir(open_job.job.folder.path.parent)
        if open_job.path not in self._open:
            return True
        return self._settle(open_job)


def _list_folders(chunk: Chunk) -> None:
    """Lists a chunk's folders: a shared file system shows then what others wrote."""
    for folder in chunk.folders:
        with suppress(OSError):
            os.listdir(folder.path.parent)
            os.listdir(folder.path)


def _paths(chunk: Chunk) -> list[str]:
    """Returns the paths of a chunk's folders."""
    return [str(folder.path) for folder in chunk.folders]
