"""``gpmpc run -m``: many flights that may be stopped at any moment and go on later.

    choices -> jobs, one a combination -> checked -> chunks -> launched where not
    finished -> folders -> counted

What is kept, and whether it is finished, is in the runs' folders alone. So the same
command resumes a sweep: only failed and unfinished runs are launched again. Where a
finished run has other settings, the sweep is refused before anything is launched. Where
it was flown by other code it stays, and the sweep says how many such runs there are.
Several sweeps may share a tree: a run that another process works on is left to it, and
looked at again at the end.
"""

import hashlib
import itertools
import json
import shlex
import threading
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from hydra.core.hydra_config import HydraConfig
from rich.console import Console

from gpmpc.cli._chunks import Chunking, Job, fly_chunk
from gpmpc.cli._commands import Result
from gpmpc.cli._composing import Composer
from gpmpc.cli._examples import Examples, try_settings
from gpmpc.cli._flying import Flying
from gpmpc.cli._folders import folder_of, write_files
from gpmpc.cli._launchers import Refused, launcher_of
from gpmpc.cli._mlflow import check_tracker, track
from gpmpc.cli._overrides import choices, combinations
from gpmpc.cli._plain_settings import plain_settings
from gpmpc.cli._settings import config_source_options
from gpmpc.cli._terminal import print_error, progress_bar
from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.studies._index import RunIndex
from gpmpc.studies._run_folder import (
    METRICS,
    PLAN_PREFIX,
    RunFolder,
    RunState,
    folder_name,
    lock_held,
    of_other_code,
)
from gpmpc.studies._run_record import READ_ERRORS, warning_of
from gpmpc.studies._sweep_status import without_numbers

_MEASURED = 20  # finished runs whose times tell how long others take
_LOOKS = 1000  # at folders whenever the bar is drawn


class JobOutcome(NamedTuple):
    """How a job ended, as its folder tells."""

    folder: str
    error: str | None = None


class Sweep:
    """Runs of one tree: their settings, which are finished, and what flies the others.

    Args:
        name: Of the settings' file in ``conf/``.
        overrides: Of any one run; launcher and folder are those of all.
        console: Where it reports.
    """

    def __init__(self, name: str, overrides: Sequence[str], console: Console):
        self.config = hydra.compose(name, [*overrides], return_hydra_config=True)
        HydraConfig.instance().set_config(self.config)  # settings may ask Hydra
        check_tracker(self.config.get("tracker"))
        self.tree = folder_of(self.config.folder)
        self.console = console
        self._composer = Composer(name, self.config)
        self._examples = Examples()
        self._index = RunIndex(self.tree)
        check_number("retries", self.config.retries, least=0, whole=True)
        self._launcher = launcher_of(self.config, self.tree)
        self._chunking = Chunking(self.config.chunk, self._launcher.workers)
        #: folders of finished runs that other code flew, and what it was
        self.of_other_code: dict[Path, str] = {}
        #: folders of finished runs that were lost, or suspicious at their end, and why
        self.warnings: dict[Path, str] = {}
        #: folders of runs that were flown again, since their process was ended
        self.flown_again: set[str] = set()
        #: attempts of runs that were ended too often, by folder; they do not fly again
        self.out_of_retries: dict[str, int] = {}
        #: folders of finished runs that are none of this sweep: another process wrote
        #: a damaged result, or flew other settings
        self.unusable: set[Path] = set()
        self._compared: set[Path] = set()  # folders of runs that have the settings
        self._remarks: set[str] = set()  # that were printed, without their numbers

    def close(self) -> None:
        """Ends the processes that wait for more runs."""
        self._launcher.close()

    def job(self, overrides: Sequence[str]) -> Job:
        """Returns the run of these settings."""
        own_choices = choices(overrides)
        folder = RunFolder(self.tree / folder_name(own_choices))
        return Job(
            choices=own_choices,
            folder=folder,
            settings=self._composer.composed(overrides),
            failed_before=folder.failed_at,
        )

    def check(self, jobs: Sequence[Job]) -> None:
        """Finds mistakes in the settings before anything is launched.

        Finished runs must have these settings; their warnings, other code and times
        are noted, for what is said at the end and for how many runs a process flies.
        """
        finished = []
        waiting = []
        for job in jobs:
            if job.folder.finished:
                finished.append(job)
            else:
                waiting.append(job)
        examples = self._examples.of(waiting)
        if examples:
            self._launcher.call(try_settings, [job.settings for job in examples])
        with self.console.status(
            f"comparing the settings of {len(finished)} finished runs"
        ):
            for job in finished:
                try:
                    self._check_finished(job)
                except DataError:
                    if job.folder.finished:  # else it is gone since, and flown again
                        raise
        self._index.write()
        for job in finished[-_MEASURED:]:
            self._chunking.measure(job)

    def _check_finished(self, job: Job) -> None:
        """Compares a run's settings, once: the index says with what it was compared.

        Raises:
            SettingError: The run has other settings.
            DataError: Its result is damaged.
        """
        fingerprint = job.settings.fingerprint()
        path = job.folder.path / METRICS
        record = None
        if fingerprint is not None:
            record = self._index.record_with(path, fingerprint)
        if record is not None:
            warning = record.warning
            other_code = "" if record.is_of_this_code() else record.made_by
        else:
            config = job.settings.config()
            result = job.folder.result(plain_settings(config, job.settings.options))
            warning = warning_of(result)
            other_code = of_other_code(result)
            self._add_to_index(path, result, fingerprint)
        self._compared.add(job.folder.path)
        if warning:
            self.warnings[job.folder.path] = warning
        if other_code:
            self.of_other_code[job.folder.path] = other_code

    def _add_to_index(self, path: Path, result: Any, fingerprint: str | None) -> None:
        """Keeps what a report shows of a run, unless it is of an older version."""
        with suppress(*READ_ERRORS):
            self._index.add(path, result, fingerprint)

    def fly(self, jobs: Sequence[Job]) -> list[JobOutcome]:
        """Flies the runs that are not finished; returns the outcome of each of those.

        Those that another process works on are waited for at the end.
        """
        self._track_finished(jobs)
        outcomes: list[JobOutcome] = []

        def settle(job: Job, state: RunState) -> None:  # called by ``flying`` below
            self._chunking.measure(job)
            reason = flying.reasons_not_kept.get(str(job.folder.path))
            outcomes.append(self._outcome(job, state, reason))

        flying = Flying(
            launcher=self._launcher,
            work=fly_chunk,
            chunked=self._chunking.chunks,
            on_settled=settle,
            retries=self.config.retries,
        )
        to_fly = []
        for job in jobs:
            if not job.folder.finished:
                to_fly.append(job.with_absolute_path())
            elif job.folder.path not in self._compared:
                # Another process has finished it since ``check``.
                outcomes.append(self._outcome(job, RunState.FINISHED))
        flying.fly(to_fly)
        self.flown_again |= {*flying.flown_again_from_before, *flying.flown_again_now}
        self.out_of_retries |= flying.out_of_retries
        return outcomes

    def _track_finished(self, jobs: Sequence[Job]) -> None:
        """Writes finished runs to MLflow that are not there, if settings say so.

        Where it takes one of them not, it is not asked for the others.
        """
        if self.config.get("tracker") != "mlflow":
            return
        for job in jobs:
            folder = job.folder
            if folder.finished and not track(folder, folder.result()):
                return

    def _print_remarks(self, remarks: Sequence[str]) -> None:
        """Prints what a flight has to say, once for all that differ in numbers."""
        for remark in remarks:
            kind = without_numbers(remark)
            if kind not in self._remarks:
                self._remarks.add(kind)
                print_error(remark)

    def _outcome(
        self, job: Job, state: RunState, reason: str | None = None
    ) -> JobOutcome:
        """Reads how a run ended, for the index, too; its warning is noted.

        Args:
            job: The run.
            state: How it ended.
            reason: Why it failed, where its folder cannot say so.
        """
        folder = self.tree / job.folder.path.name
        if reason is not None:
            return JobOutcome(str(folder), reason)
        self._print_remarks(job.folder.remarks())
        if state is RunState.FAILED:
            return JobOutcome(str(folder), job.folder.error())
        try:
            result = job.folder.result()
            fingerprint = self._compared_fingerprint(job, result)
        except (DataError, SettingError) as error:
            self.unusable.add(folder)
            return JobOutcome(str(folder), str(error))
        self._add_to_index(folder / METRICS, result, fingerprint)
        self._index.write()
        warning = warning_of(result)
        if warning is not None:
            self.warnings[folder] = warning
        return JobOutcome(str(folder))

    def _compared_fingerprint(self, job: Job, result: Mapping[str, Any]) -> str | None:
        """Returns the fingerprint of a job's settings, which its finished run has.

        None where they have none.

        Raises:
            SettingError: The run has other settings: the file of a model was written
                anew while the sweep flew, or another sweep finished the run.
        """
        fingerprint = job.settings.fingerprint()
        flown = (result.get("provenance") or {}).get("settings_fingerprint")
        if fingerprint is None or fingerprint != flown:
            settings = plain_settings(job.settings.config(), job.settings.options)
            job.folder.result(settings)
        return fingerprint

    @contextmanager
    def progress(
        self, jobs: Sequence[Job], total: int
    ) -> Iterator[Callable[[str], None]]:
        """Shows one bar for many runs, which looks at their folders when it is drawn.

        Yields:
            A function that names the bar.
        """
        counter = _EndCounter(jobs)
        with progress_bar(self.console, counter.count) as bar:
            task = bar.add_task("flying", total=total)
            yield lambda text: bar.update(task, description=text)
            counter.look_at_all()

    def print_other_code(self) -> None:
        """Prints how many finished runs were flown by other code, where any was."""
        if not self.of_other_code:
            return
        codes = "; ".join(dict.fromkeys(self.of_other_code.values()))
        self.console.out(
            f"{len(self.of_other_code)} of the runs that were finished before were "
            f"flown by other code ({codes}): remove their folders, or choose another "
            "folder, to fly them with this code",
            highlight=False,
        )

    def print_attempts(self) -> None:
        """Prints how many runs were flown again, and how many will not be."""
        retries = self.config.retries
        if self.flown_again:
            self.console.out(
                f"{len(self.flown_again)} of the runs were flown again, since a "
                "cluster or a crash had ended them; "
                f"at most {retries} times each (retries)",
                highlight=False,
            )
        if self.out_of_retries:
            print_error(
                f"{len(self.out_of_retries)} of the runs were ended by a cluster or a "
                f"crash more than {retries} times, and are not flown again; "
                f"retries={max(self.out_of_retries.values())} flies them once more"
            )

    def print_warnings(self) -> None:
        """Prints the finished runs that were lost, or suspicious at their end."""
        for folder, warning in sorted(self.warnings.items()):
            print_error(f"{folder}: {warning}")


class _EndCounter:
    """Counts the runs that have ended, with a few looks at a time.

    The thread that draws the bar counts, too, while this one looks at all.

    Args:
        jobs: The runs: the caller's list, which may grow.
    """

    def __init__(self, jobs: Sequence[Job]):
        self._jobs = jobs
        self._taken = 0  # of the jobs
        self._open: deque[Job] = deque()
        self._ended = 0
        self._lock = threading.Lock()

    def count(self) -> int:
        """Returns how many are known to have ended; looks at some of the others."""
        with self._lock:
            self._look(_LOOKS)
            return self._ended

    def look_at_all(self) -> None:
        """Looks at every run that is not known to have ended."""
        with self._lock:
            self._look(len(self._jobs))

    def _look(self, most: int) -> None:
        """Looks at the next ``most`` open runs, in turn."""
        added = self._jobs[self._taken :]
        self._open.extend(added)
        self._taken += len(added)
        for _ in range(min(most, len(self._open))):
            job = self._open.popleft()
            if job.done:
                self._ended += 1
            else:
                self._open.append(job)


def sweep(arguments: Namespace) -> Result:
    """Runs every combination of the choices that is not finished.

    Returns:
        The runs; the exit code is 1 where some failed.
    """
    console = Console()
    every_run = combinations(arguments.overrides)
    first = next(every_run)
    with closing(Sweep(arguments.config_name, first, console)) as runs:
        jobs = _distinct(map(runs.job, itertools.chain([first], every_run)))
        finished_before = {job.folder.path for job in jobs if job.folder.finished}
        runs.check(jobs)
        plan = _write_plan(runs.tree, jobs, config_source_options(runs.config.hydra))
        try:
            # ``gpmpc status`` sees by the lock that the sweep is alive.
            with lock_held(plan), runs.progress(jobs, len(jobs)):
                outcomes = runs.fly(jobs)
        except OSError as error:
            place = error.filename or runs.tree
            return cannot_go_on(runs.tree, f"{place}: {error.strerror or error}")
        except Refused as error:
            if not error.has_launched:
                raise
            return cannot_go_on(runs.tree, str(error))
    end = _end_of(jobs, outcomes, finished_before, runs.unusable)
    text = f"{end.line()}{_count_warnings(runs.warnings)}; in {runs.tree}"
    console.out(text, highlight=False)
    runs.print_other_code()
    runs.print_attempts()
    runs.print_warnings()
    print_failed(end.failed)
    data = {
        "folder": str(runs.tree),
        "runs": [str(job.folder.path) for job in jobs],
        "of_other_code": [str(path) for path in runs.of_other_code],
        "warnings": {str(path): text for path, text in runs.warnings.items()},
        "failed": [outcome._asdict() for outcome in end.failed],
    }
    return Result(data, 1 if end.failed or end.gone else 0)


def print_failed(outcomes: Iterable[JobOutcome]) -> None:
    """Prints runs that failed, and why."""
    for outcome in outcomes:
        print_error(f"failed: {outcome.folder}: {outcome.error}")


def cannot_go_on(tree: Path, reason: str) -> Result:
    """Says that the command cannot go on, such as where a disk is full."""
    print_error(
        f"{reason}; not all runs were flown, and the same command goes on where it "
        "stopped"
    )
    return Result({"folder": str(tree), "error": reason}, 1)


def _distinct(jobs: Iterable[Job]) -> list[Job]:
    """Returns the jobs, of those with the same folder the last one."""
    by_folder = {job.folder.path: job for job in jobs}
    return [*by_folder.values()]


class _SweepEnd(NamedTuple):
    """How the runs of a sweep ended."""

    total: int
    finished_before: int
    finished_now: int
    failed: list[JobOutcome]

    @property
    def gone(self) -> int:
        """Number of runs that ended, and whose folders are not there any more."""
        return self.total - self.finished_before - self.finished_now - len(self.failed)

    def line(self) -> str:
        """Returns the counts in words."""
        runs = "1 run" if self.total == 1 else f"{self.total} runs"
        text = (
            f"{runs}: {self.finished_now} flown, "
            f"{self.finished_before} finished before, {len(self.failed)} failed"
        )
        if self.gone:
            text += f", {self.gone} gone"
        return text


def _end_of(
    jobs: Sequence[Job],
    outcomes: Sequence[JobOutcome],
    finished_before: Set[Path],
    unusable: Set[Path],
) -> _SweepEnd:
    """Counts what is there: another sweep may have flown what failed in this one."""
    finished = {job.folder.path for job in jobs if job.folder.finished} - unusable
    failed = [
        outcome
        for outcome in outcomes
        if outcome.error is not None and Path(outcome.folder) not in finished
    ]
    return _SweepEnd(
        total=len(jobs),
        finished_before=len(finished & finished_before),
        finished_now=len(finished - finished_before),
        failed=failed,
    )


def _write_plan(tree: Path, jobs: Sequence[Job], options: Sequence[str]) -> Path:
    """Writes what was asked for, so that a report knows what is missing.

    Equal sweeps write the same file, which is returned. ``options`` are those of the
    command by which its settings are found.
    """
    content: dict[str, Any] = {"runs": [[*job.choices] for job in jobs]}
    if options:
        content["search_options"] = shlex.join(options)
    plan = json.dumps(content, indent=1) + "\n"
    digest = hashlib.sha256(plan.encode()).hexdigest()
    name = f"{PLAN_PREFIX}{digest[:10]}.json"
    write_files(tree, {name: plan})
    return tree / name


def _count_warnings(warnings: Mapping[Path, str]) -> str:
    """Returns how many runs were lost or suspicious, as the end of a sentence."""
    lost_flights = sum(text.startswith("lost") for text in warnings.values())
    suspicious = len(warnings) - lost_flights
    text = ""
    if lost_flights:
        text += f", {lost_flights} lost"
    if suspicious:
        text += f", {suspicious} suspicious at their end"
    return text
