"""Groups the runs of a sweep into chunks, each of about a minute of work.

    runs that are not settled -> first round: a few -> how long they take ->
    chunks -> processes

A process starts in seconds, and a short flight takes less. So a process flies one run
after another; it shares what was imported and compiled. How long a run takes is
measured: the first round flies two a process. Where the estimate was wrong, since the
first ones were short ones, a chunk ends early, and what it leaves is grouped again.
"""

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

from omegaconf.errors import OmegaConfBaseException

from gpmpc._provenance import provenance
from gpmpc.cli._composing import ComposedSettings
from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.studies._run_folder import Busy, RunFolder

_WORK = 60.0  # of a chunk [s]
_MOST_WORK = 120.0  # after which a chunk begins no other run [s]
_FIRST = 2  # runs a process in the first round; the first one loads what is compiled
_MOST_FIRST = 8  # processes in the first round
_MEASURED = 50  # runs, the last ones, that tell how long others take
_TURNS = 4  # chunks a process, at least, so that all of them end at about one time


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    #: what distinguishes it, ``key=value`` each
    choices: list[str]
    folder: RunFolder
    settings: ComposedSettings
    #: when an earlier attempt failed [ns]
    failed_before: int | None = None

    @property
    def done(self) -> bool:
        """Whether this sweep, or another one, has finished it or seen it fail."""
        return self.folder.outcome_since(self.failed_before) is not None

    def with_absolute_path(self) -> "Job":
        """Returns the run as a process in any working folder finds it."""
        return replace(self, folder=RunFolder(self.folder.path.absolute()))


@dataclass(frozen=True)
class Chunk:
    """Runs that one process flies, one after another; can be pickled."""

    jobs: tuple[Job, ...]
    #: after which it begins no other run [s]; None: it flies them all
    most_work: float | None

    @property
    def folders(self) -> list[RunFolder]:
        """Where they are kept, in the order of flight."""
        return [job.folder for job in self.jobs]


def fly_chunk(chunk: Chunk) -> None:
    """Flies the runs of a chunk, in whichever process a launcher started.

    Those that another process works on are left to it.

    Raises:
        GpmpcError: Runs could not be begun, for reasons that their folders cannot hold.
            They are all of the chunk without an end, but for those of another process.
    """
    began = time.monotonic()
    problems: dict[str, None] = {}
    for job in chunk.jobs:
        try:
            _fly_job(job)
        except Busy:
            continue
        except (GpmpcError, OmegaConfBaseException) as error:
            if not _fail(job, error):
                problems[" ".join(str(error).split())] = None
        work = time.monotonic() - began
        is_long = chunk.most_work is not None and work > chunk.most_work
        # With a problem, the caller fails every run without an end: all others fly
        # first.
        if is_long and not problems:
            break
    if problems:
        raise GpmpcError("; ".join(problems))


def _fly_job(job: Job) -> None:
    # Loads what flies, for seconds; who only hands out chunks does not need it.
    from gpmpc._compiling import report_compilation
    from gpmpc.cli._run import RunToFly, run_one

    to_fly = RunToFly(
        config=job.settings.config(),
        options=job.settings.options,
        choices=job.choices,
        command=job.settings.command(job.choices),
        folder=job.folder,
        fingerprint=job.settings.fingerprint(),
    )
    with report_compilation():
        run_one(to_fly, wait=False)


def _fail(job: Job, error: Exception) -> bool:
    """Keeps why a run could not be begun; returns whether its folder holds it."""
    about = {
        "schema": 1,
        "choices": job.choices,
        "settings": {},
        # The command of this process may be a worker's, which finds no settings.
        "provenance": provenance() | {"command": job.settings.command(job.choices)},
    }
    try:
        with job.folder.locked(wait=False):
            if not job.folder.finished:
                job.folder.fail(error, about)
    except Busy:  # what becomes of the run, the other process says
        return True
    except OSError:
        return False
    return True


class Chunking:
    """Groups runs into chunks.

    Args:
        size: Runs a chunk; "auto" makes them of about a minute of work.
        workers: Processes at the same time; None where that is not known.

    Raises:
        SettingError: The size is neither.
    """

    def __init__(self, size: int | str, workers: int | None):
        if size != "auto":
            if isinstance(size, str):
                raise SettingError(
                    "chunk", f"must be a number of runs, or auto; got {size!r}"
                )
            check_number("chunk", size, least=1, whole=True)
        self._size = None if isinstance(size, str) else size
        self._workers = workers
        # Of the last runs. The first one of each chunk, its leader, takes longer: it
        # loads and compiles. Who led once counts as a leader for ever, also where it
        # flies again in the midst of a chunk: that is rare, and leaders only count
        # where no other run has ended.
        self._seconds: deque[float] = deque(maxlen=_MEASURED)
        self._seconds_of_leaders: deque[float] = deque(maxlen=_MEASURED)
        self._leaders: set[RunFolder] = set()

    def measure(self, job: Job) -> None:
        """Takes the time of a run that has ended, as its folder tells."""
        seconds = job.folder.seconds
        if seconds is None:
            return
        if job.folder in self._leaders:
            self._seconds_of_leaders.append(seconds)
        else:
            self._seconds.append(seconds)

    def chunks(self, jobs: Sequence[Job]) -> list[Chunk]:
        """Returns chunks of the runs that are to be flown, or of the first of them."""
        if self._size is not None:
            return self._grouped(jobs, self._size, most_work=None)
        seconds = self._seconds or self._seconds_of_leaders
        if not seconds:
            processes = min(self._workers or 1, _MOST_FIRST)
            return self._grouped(jobs[: _FIRST * processes], _FIRST, most_work=_WORK)
        size = max(1, round(_WORK / max(median(seconds), 1e-3)))
        if self._workers is not None:
            size = min(size, max(1, len(jobs) // (_TURNS * self._workers)))
        return self._grouped(jobs, size, most_work=_MOST_WORK)

    def _grouped(
        self, jobs: Sequence[Job], size: int, most_work: float | None
    ) -> list[Chunk]:
        chunks = []
        for start in range(0, len(jobs), size):
            group = tuple(jobs[start : start + size])
            self._leaders.add(group[0].folder)
            chunks.append(Chunk(group, most_work))
        return chunks
