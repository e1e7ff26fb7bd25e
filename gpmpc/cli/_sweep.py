"""``gpmpc run -m``: many flights that may be stopped at any moment and go on later.

    choices -> jobs, one a combination -> checked -> launched where not finished ->
    counted

Hydra composes every run's settings and its launcher plugins start the runs; what is
kept, and whether it is finished, is in the runs' folders alone. So the same command
resumes a sweep: only failed and unfinished runs are launched again. Where a finished
run has other settings, the sweep is refused before anything is launched. Where it was
flown by other code it stays, and the sweep says how many such runs there are. Several
sweeps may share a tree: a run that another process works on is left to it, and looked
at again at the end.
"""

import hashlib
import itertools
import json
import os
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig
from rich.console import Console

from gpmpc._compiling import report_compilation
from gpmpc.cli._commands import Result
from gpmpc.cli._experiment import experiment_of, plain_settings
from gpmpc.cli._run import choices, run_one, warning_of
from gpmpc.cli._settings import folder_of, without_hydra, write_files
from gpmpc.cli._terminal import print_error, progress_bar
from gpmpc.exceptions import GpmpcError, SettingError
from gpmpc.parallel import children_ignore_interrupts, end_with
from gpmpc.studies._run_folder import PLAN, Busy, RunFolder, folder_name, of_other_code


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    overrides: list[str]
    folder: RunFolder
    #: when an earlier attempt failed [ns]
    failed_before: int | None

    @property
    def done(self) -> bool:
        """Whether this sweep, or another one, has finished it or seen it fail."""
        if self.folder.finished:
            return True
        return self.folder.failed_at not in (None, self.failed_before)


class JobOutcome(NamedTuple):
    """How a job ended, as the process that flew it tells."""

    folder: str
    error: str | None = None
    #: that it was lost, or suspicious at its end
    warning: str | None = None
    #: whether another process works on it
    busy: bool = False


class Sweep:
    """Runs of one tree: their settings, which are finished, and what flies the others.

    Args:
        name: Of the settings' file in ``conf/``.
        overrides: Of any one run; launcher and folder are those of all.
        console: Where it reports.
    """

    def __init__(self, name: str, overrides: Sequence[str], console: Console):
        self.config = hydra.compose(name, [*overrides], return_hydra_config=True)
        self.config.hydra.mode = RunMode.MULTIRUN
        self.tree = folder_of(self.config.folder)
        self.console = console
        # Hydra calls these around every job.
        callbacks: Any = SimpleNamespace(
            on_job_start=lambda **_: None, on_job_end=lambda **_: None
        )
        self._context = HydraContext(GlobalHydra.instance().config_loader(), callbacks)
        self._checked: set[str] = set()  # overrides
        #: folders of finished runs that other code flew, and what it was
        self.of_other_code: dict[Path, str] = {}
        #: folders of finished runs that were lost, or suspicious at their end, and why
        self.warnings: dict[Path, str] = {}

    def job(self, overrides: Sequence[str]) -> Job:
        """Returns the run of these settings."""
        folder = RunFolder(self.tree / folder_name(choices(overrides)))
        return Job([*overrides], folder, folder.failed_at)

    def settings(self, job: Job) -> tuple[DictConfig, Mapping[str, Any]]:
        """Returns a run's settings, and the chosen option by group."""
        composed = self._context.config_loader.load_sweep_config(
            self.config, job.overrides
        )
        return without_hydra(composed), composed.hydra.runtime.choices

    def check(self, jobs: Sequence[Job]) -> None:
        """Finds mistakes in the settings before anything is launched.

        The objects of a run are made once for every value that occurs. Finished runs
        must have these settings; their warnings and other code are noted.
        """
        finished = [job for job in jobs if job.folder.finished]
        with report_compilation():
            for job in jobs:
                if job not in finished and not self._checked.issuperset(job.overrides):
                    config, _ = self.settings(job)
                    experiment_of(config)
                    self._checked.update(job.overrides)
        with self.console.status(
            f"comparing the settings of {len(finished)} finished runs"
        ):
            for job in finished:
                self._check_finished(job)

    def _check_finished(self, job: Job) -> None:
        config, options = self.settings(job)
        result = job.folder.result(plain_settings(config, options))
        warning = warning_of(result)
        if warning is not None:
            self.warnings[job.folder.path] = warning
        other_code = of_other_code(result)
        if other_code:
            self.of_other_code[job.folder.path] = other_code

    def fly(self, jobs: Sequence[Job]) -> list[JobOutcome]:
        """Flies the runs that are not finished; returns the outcome of each of those.

        Those that another process works on are waited for at the end.
        """
        waiting = [job for job in jobs if not job.folder.finished]
        outcomes = self._launch(waiting, partial(_fly_job, wait=False))
        busy = [
            job for job, outcome in zip(waiting, outcomes, strict=True) if outcome.busy
        ]
        flown = [outcome for outcome in outcomes if not outcome.busy]
        return flown + self._launch(busy, partial(_fly_job, wait=True))

    def _launch(
        self, jobs: Sequence[Job], task: Callable[[DictConfig], JobOutcome]
    ) -> list[JobOutcome]:
        """Hands jobs to the launcher; ends the command where it breaks down."""
        if not jobs:
            return []
        launcher: Any = Plugins.instance().instantiate_launcher(
            hydra_context=self._context, task_function=task, config=self.config
        )
        children = nullcontext()
        joblib_arguments = getattr(launcher, "joblib", None)  # of joblib's launcher
        if joblib_arguments is not None:
            joblib_arguments |= {"initializer": end_with, "initargs": (os.getpid(),)}
            from joblib.externals.loky.backend import resource_tracker

            resource_tracker.ensure_running()  # as in ``children_ignore_interrupts``
            # The thread of the progress bar still receives Ctrl-C.
            children = children_ignore_interrupts()
        overrides = [job.overrides for job in jobs]
        try:
            with children:
                returned = launcher.launch(overrides, initial_job_idx=0)
            return [job_return.return_value for job_return in returned]
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            print_error(
                f"the launcher broke down: {reason}; "
                "the same command goes on where it stopped"
            )
            sys.exit(1)

    @contextmanager
    def progress(
        self, jobs: Sequence[Job], total: int
    ) -> Iterator[Callable[[str], None]]:
        """Shows one bar for many runs, which looks at their folders when it is drawn.

        Yields:
            A function that names the bar.
        """
        with progress_bar(
            self.console, lambda: sum(job.done for job in [*jobs])
        ) as bar:
            task = bar.add_task("flying", total=total)
            yield lambda text: bar.update(task, description=text)

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

    def print_warnings(self) -> None:
        """Prints the finished runs that were lost, or suspicious at their end."""
        for folder, warning in sorted(self.warnings.items()):
            print_error(f"{folder}: {warning}")


def sweep(arguments: Namespace) -> Result:
    """Runs every combination of the choices that is not finished.

    Returns:
        The runs; the exit code is 1 where some failed.
    """
    console = Console()
    combinations = _combinations(arguments.overrides)
    runs = Sweep(arguments.config_name, combinations[0], console)
    by_folder = {job.folder.path: job for job in map(runs.job, combinations)}
    jobs = list(by_folder.values())
    finished = sum(job.folder.finished for job in jobs)
    runs.check(jobs)
    _write_plan(runs.tree, jobs)
    with runs.progress(jobs, len(jobs)):
        outcomes = runs.fly(jobs)
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    for outcome in outcomes:
        if outcome.warning:
            runs.warnings[Path(outcome.folder)] = outcome.warning
    total = "1 run" if len(jobs) == 1 else f"{len(jobs)} runs"
    console.out(
        f"{total}: {len(outcomes) - len(failed)} flown, {finished} finished before, "
        f"{len(failed)} failed{_count_warnings(runs.warnings)}; in {runs.tree}",
        highlight=False,
    )
    runs.print_other_code()
    runs.print_warnings()
    for outcome in failed:
        print_error(f"failed: {outcome.folder}: {outcome.error}")
    data = {
        "folder": str(runs.tree),
        "runs": [str(job.folder.path) for job in jobs],
        "of_other_code": [str(path) for path in runs.of_other_code],
        "warnings": {str(path): text for path, text in runs.warnings.items()},
        "failed": [
            {"folder": outcome.folder, "error": outcome.error} for outcome in failed
        ],
    }
    return Result(data, 1 if failed else 0)


def _combinations(overrides: Sequence[str]) -> list[list[str]]:
    """Returns the overrides of every run; of a key given twice, the last one counts."""
    by_key: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        if not override.is_sweep_override():
            by_key[key] = [str(override.input_line)]
            continue
        values = [*override.sweep_string_iterator()]
        if not values:
            raise SettingError(key, "holds no value to sweep over")
        by_key[key] = [f"{key}={value}" for value in values]
    return [list(combination) for combination in itertools.product(*by_key.values())]


def _write_plan(tree: Path, jobs: Sequence[Job]) -> None:
    """Writes what was asked for, so that a report knows what is missing.

    Equal sweeps write the same file.
    """
    runs = [choices(job.overrides) for job in jobs]
    plan = json.dumps({"runs": runs}, indent=1) + "\n"
    digest = hashlib.sha256(plan.encode()).hexdigest()
    write_files(tree, {f"{PLAN}{digest[:10]}.json": plan})


def _count_warnings(warnings: Mapping[Path, str]) -> str:
    """Returns how many runs were lost or suspicious, as the end of a sentence."""
    lost = sum(warning.startswith("lost") for warning in warnings.values())
    suspicious = len(warnings) - lost
    text = ""
    if lost:
        text += f", {lost} lost"
    if suspicious:
        text += f", {suspicious} suspicious at their end"
    return text


@report_compilation()
def _fly_job(config: DictConfig, wait: bool) -> JobOutcome:
    """Flies one run of a sweep, in whichever process a launcher started.

    With ``wait`` it flies after others that work on it.
    """
    try:
        outcome = run_one(config, wait)
    except Busy:
        return JobOutcome(config.folder, busy=True)
    except GpmpcError as error:  # of this run; the others go on
        return JobOutcome(config.folder, error=str(error))
    warning = None if outcome.result is None else warning_of(outcome.result)
    return JobOutcome(str(outcome.folder), error=outcome.error, warning=warning)
