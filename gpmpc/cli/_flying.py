"""Flies the runs of a sweep until the folder of each says that it finished or failed.

    runs -> chunks -> launcher -> ends of processes -> folders looked at -> settled,
    or flown again

What a process says of its runs is not believed: a run counts by its own folder alone.
One that its process could not finish is a failed run with the reason in its
``error.json``, by the cause:

- cancelled, or an error outside of any run: all runs of the chunk that are not finished;
- wall time or memory: the run that was being flown. Those behind it fly again now;
- a node, or the process, died: likewise, and the run that was being flown flies again,
  too, until it has had ``retries`` attempts more than the first.
"""

import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from gpmpc._provenance import provenance
from gpmpc.cli._launchers import Cause, Chunk, ChunkEnd, Launcher, Work
from gpmpc.studies._run_folder import Busy, CellState, RunFolder

_LOOK_INTERVAL = 1.0  # between two looks at runs in other hands [s]
_LATE = 30.0  # after which a shared file system shows what another machine wrote [s]
_REPEATED = (Cause.NODE, Cause.CRASH)
_OF_THE_WHOLE_CHUNK = (Cause.CANCELLED, Cause.ERROR)


class Cell(Protocol):
    """One run of a sweep."""

    @property
    def folder(self) -> RunFolder:
        """Where it is kept, with an absolute path."""
        ...

    @property
    def choices(self) -> Sequence[str]:
        """What distinguishes it, ``key=value`` each."""
        ...


OnSettled = Callable[[Any, CellState], None]  # takes a cell; it finished or failed


@dataclass
class Flying:
    """The runs of a sweep in the hands of a launcher.

    Args:
        launcher: Starts the processes.
        work: Flies a chunk, there.
        chunked: Groups cells into chunks.
        on_settled: Called once for every cell, when it has finished or failed.
        retries: How often a run is flown again that was ended from outside.
    """

    launcher: Launcher
    work: Work
    chunked: Callable[[Sequence[Any]], Sequence[Chunk]]
    on_settled: OnSettled
    retries: int
    #: runs that fly again in this call, since their process or node died; paths
    repeated: set[str] = field(default_factory=set)
    _open: dict[str, Cell] = field(default_factory=dict)  # by path, not settled yet
    _failed_before: dict[str, int | None] = field(default_factory=dict)
    _begun_before: dict[str, int | None] = field(default_factory=dict)

    def fly(self, cells: Iterable[Any]) -> None:
        """Flies cells; returns when each is settled."""
        for cell in cells:
            self._open[str(cell.folder.path)] = cell
            self._failed_before[str(cell.folder.path)] = cell.folder.failed_at
        while self._open:
            if not self._fly_once():
                time.sleep(_LOOK_INTERVAL)

    def _fly_once(self) -> bool:
        """Flies the cells that nobody works on, and settles those that have ended.

        Returns:
            Whether any were flown. Others are in the hands of another sweep.
        """
        in_jobs = {
            str(folder.path)
            for chunk in self.launcher.running()
            for folder in chunk.folders
        }
        to_fly = []
        for path, cell in [*self._open.items()]:
            self._begun_before[path] = cell.folder.begun_at
            if self._settle(cell) or path in in_jobs:
                continue
            if cell.folder.state is not CellState.RUNNING:
                to_fly.append(cell)
        if not to_fly and not in_jobs:
            return False
        unseen: list[tuple[Cell, ChunkEnd]] = []
        chunks = self.chunked(to_fly) if to_fly else ()
        for end in self.launcher.launch(self.work, chunks):
            if end.cause is not None:
                self._end_early(end)
                continue
            left = self._unsettled(end.chunk)
            # A chunk may stop behind any of its runs, and leave the others.
            if len(left) == len(end.chunk.folders):
                unseen += [(cell, end) for cell in left]
        self._judge_unseen(unseen)
        return True

    def _unsettled(self, chunk: Chunk) -> list[Cell]:
        """Settles cells of a chunk; returns those that are not."""
        paths = [str(folder.path) for folder in chunk.folders]
        cells = [self._open[path] for path in paths if path in self._open]
        return [cell for cell in cells if not self._settle(cell)]

    def _settle(self, cell: Cell) -> bool:
        """Takes a cell off the list where it has finished, or failed in this call."""
        path = str(cell.folder.path)
        state = cell.folder.state
        if state is CellState.FAILED:
            if cell.folder.failed_at == self._failed_before[path]:
                return False
        elif state is not CellState.FINISHED:
            return False
        del self._open[path]
        self.on_settled(cell, state)
        return True

    def _end_early(self, end: ChunkEnd) -> None:
        """Settles what a process left behind that did not come to the end."""
        left = [
            cell
            for cell in self._unsettled(end.chunk)
            if cell.folder.state is not CellState.RUNNING
        ]
        begun = [cell for cell in left if self._begun_now(cell)]
        concerned = begun or left
        if end.cause in _OF_THE_WHOLE_CHUNK:
            concerned = left
        for cell in concerned:
            self._lose(cell, end)

    def _begun_now(self, cell: Cell) -> bool:
        """Whether an attempt was begun since the chunks were started."""
        return cell.folder.begun_at != self._begun_before[str(cell.folder.path)]

    def _lose(self, cell: Cell, end: ChunkEnd) -> None:
        """Makes a cell a failed one, or leaves it to be flown again."""
        cause = end.cause or Cause.ERROR
        about = {
            "schema": 1,
            "choices": [*cell.choices],
            "settings": {},
            "host": end.host,
            "provenance": provenance(),
        }
        try:
            cell.folder.lose(end.reason, cause.value, about)
        except Busy:  # another sweep works on it: its outcome counts
            return
        path = str(cell.folder.path)
        if cause in _REPEATED and cell.folder.lost_attempts <= self.retries:
            self.repeated.add(path)
            self._failed_before[path] = cell.folder.failed_at
            return
        self._settle(cell)

    def _judge_unseen(self, unseen: Sequence[tuple[Cell, ChunkEnd]]) -> None:
        """Fails the cells that a process said to be done, and that are not there."""
        deadline = time.monotonic() + _LATE
        while unseen and time.monotonic() < deadline:
            unseen = [
                (cell, end)
                for cell, end in unseen
                if not self._settle_late(cell) and not self._begun_now(cell)
            ]
            if unseen:
                time.sleep(_LOOK_INTERVAL)
        for cell, end in unseen:
            host = end.host or "the process that flew it"
            reason = f"{host} says that it flew this run, and it is not in the folder; "
            reason += f"does {host} see {cell.folder.path.parent}?"
            self._lose(cell, ChunkEnd(end.chunk, end.host, Cause.ERROR, reason))

    def _settle_late(self, cell: Cell) -> bool:
        """Settles a cell after its tree was listed, which shows what others wrote."""
        os.listdir(cell.folder.path.parent)
        return str(cell.folder.path) not in self._open or self._settle(cell)
