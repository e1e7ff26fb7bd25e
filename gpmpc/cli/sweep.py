"""``gpmpc run -m``: many flights, on one machine or on a cluster, that may be stopped at any moment and go on later.

Hydra composes every run's settings and its launcher plugins start the runs; what is kept, and whether it is finished,
is in the runs' folders alone. So a sweep is resumed by the same command: finished runs are not launched again, failed
and unfinished ones are. A finished run passes for one that is asked for only if all its settings are the same; else the
sweep is refused before anything is launched. The parent only looks at the folders to show how far it is. Several sweeps
may share a tree: a run that another process works on is left to it, and looked at again at the end.
"""

import hashlib
import itertools
import json
import os
import sys
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, open_dict

from gpmpc.cli.arguments import folder_of, writing
from gpmpc.cli.run import choices, experiment_of, plain_settings, run_one
from gpmpc.cli.terminal import print_error, progress_bar
from gpmpc.compiling import report_compilation
from gpmpc.exceptions import GpmpcError, SettingError
from gpmpc.files import write_whole
from gpmpc.parallel import THREADS, children_ignore_interrupts, end_with
from gpmpc.studies.run_folder import PLAN, Busy, RunFolder, folder_name

LOOK = 0.5  # between two looks at the folders [s]


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    overrides: list[str]
    folder: RunFolder
    failed_before: int | None  # when an earlier attempt failed [ns]

    @property
    def done(self) -> bool:
        """Whether this sweep, or another one, has finished it or seen it fail."""
        return self.folder.finished or self.folder.failed_at not in (None, self.failed_before)


@dataclass(frozen=True)
class Composer:
    """Composes the settings of runs: Hydra's loader, and the settings of one run with those of the launcher."""

    context: HydraContext
    config: DictConfig

    def settings(self, job: Job) -> tuple[DictConfig, Mapping[str, Any]]:
        """Returns a run's settings, and the chosen option by group."""
        composed = self.context.config_loader.load_sweep_config(self.config, job.overrides)
        options = composed.hydra.runtime.choices
        with open_dict(composed):
            del composed["hydra"]
        return composed, options


class NoCallbacks:
    """Hydra calls these around every job; none are used here."""

    def on_job_start(self, **_: Any) -> None:
        """Does nothing."""

    def on_job_end(self, **_: Any) -> None:
        """Does nothing."""


def sweep(given: Namespace, conf: Path) -> None:
    """Runs every combination of the choices that is not finished; the command line after ``gpmpc run -m``.

    Exits with 1 where runs failed, and names them, and where the launcher broke down.

    Args:
        given: Hydra's options, and as ``overrides`` the settings, some with several values.
        conf: Folder of the configuration.

    Raises:
        GpmpcError: A mistake in the settings, before anything is launched.
    """
    from rich.console import Console

    for name in THREADS:  # before the libraries load, here and in the processes that are started from here
        os.environ[name] = "1"
    console, combinations = Console(), _combinations(given.overrides)
    conf = Path(given.config_path or conf).absolute()
    if given.config_dir is not None:
        _search_also(Path(given.config_dir))
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf)):
        composer = _composer(given, combinations[0])
        jobs = _jobs(combinations, folder_of(composer.config.folder))
        finished, waiting = ([job for job in jobs if job.folder.finished is state] for state in (True, False))
        with report_compilation():
            _check(waiting, composer)
        with console.status(f"comparing the settings of {len(finished)} finished runs"):
            for job in finished:
                job.folder.result(plain_settings(*composer.settings(job)))
        _keep_plan(jobs, Path(composer.config.folder))
        with _progress(jobs, console):
            outcomes = _launch(waiting, False, composer)
            busy = [job for job, outcome in zip(waiting, outcomes, strict=True) if "busy" in outcome]
            outcomes += _launch(busy, True, composer)
    failed = [outcome for outcome in outcomes if "error" in outcome]
    runs = "1 run" if len(jobs) == 1 else f"{len(jobs)} runs"
    text = f"{runs}: {len(waiting) - len(failed)} flown, {len(finished)} finished before, {len(failed)} failed"
    console.print(f"{text}; in {composer.config.folder}", soft_wrap=True, highlight=False, markup=False)
    for outcome in failed:
        print_error(f"failed: {outcome['folder']}: {outcome['error']}")
    if failed:
        sys.exit(1)


def run_job(config: DictConfig) -> dict[str, Any]:
    """Flies one run of a sweep, in whichever process a launcher started, unless another process works on it."""
    return _outcome(config, wait=False)


def run_job_after_others(config: DictConfig) -> dict[str, Any]:
    """Flies one run of a sweep, after the process that works on it."""
    return _outcome(config, wait=True)


@report_compilation()
def _outcome(config: DictConfig, wait: bool) -> dict[str, Any]:
    try:
        outcome = run_one(config, wait)
    except Busy:
        return {"busy": True}
    except GpmpcError as error:  # of this run; the others go on
        return {"error": str(error), "folder": config.folder}
    return {key: outcome[key] for key in ("folder", "error") if key in outcome}


def _combinations(overrides: Sequence[str]) -> list[list[str]]:
    """Returns the overrides of every run; of a key given twice, the last one counts."""
    values = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key, swept = override.get_key_element(), override.is_sweep_override()
        found = [f"{key}={value}" for value in override.sweep_string_iterator()] if swept else [override.input_line]
        if not found:
            raise SettingError(key, "holds no value to sweep over")
        values[key] = found
    return [list(combination) for combination in itertools.product(*values.values())]


def _search_also(folder: Path) -> None:
    """Lets Hydra look for settings in a folder of the user's, behind the package's own."""
    if not folder.is_dir():
        raise SettingError("--config-dir", f"{folder}: no such folder")

    class OwnFolder(SearchPathPlugin):
        def manipulate_search_path(self, search_path: Any) -> None:
            search_path.append("command-line", f"file://{folder.absolute()}")

    Plugins.instance().register(OwnFolder)


def _composer(given: Namespace, overrides: Sequence[str]) -> Composer:
    """Composes the first run with Hydra's own settings, which say what the launcher is."""
    config = hydra.compose(given.config_name or "run", [*overrides], return_hydra_config=True)
    config.hydra.mode = RunMode.MULTIRUN
    nothing: Any = NoCallbacks()
    return Composer(HydraContext(GlobalHydra.instance().config_loader(), nothing), config)


def _jobs(combinations: Sequence[list[str]], tree: Path) -> list[Job]:
    jobs = {}
    for combination in combinations:
        folder = RunFolder(tree / folder_name(choices(combination)))
        jobs[folder.path] = Job(combination, folder, folder.failed_at)
    return list(jobs.values())


def _check(jobs: Sequence[Job], composer: Composer) -> None:
    """Makes the objects once for every value that occurs: a mistake is found before anything is launched."""
    seen: set[str] = set()
    for job in jobs:
        if not seen.issuperset(job.overrides):
            experiment_of(composer.settings(job)[0])
            seen.update(job.overrides)


def _keep_plan(jobs: Sequence[Job], tree: Path) -> None:
    """Writes what was asked for, so that a report knows what is missing; equal sweeps write the same file."""
    text = json.dumps({"runs": [choices(job.overrides) for job in jobs]}, indent=1) + "\n"
    with writing(tree):
        tree.mkdir(parents=True, exist_ok=True)
        write_whole(tree / f"{PLAN}{hashlib.sha256(text.encode()).hexdigest()[:10]}.json", text)


def _launch(jobs: Sequence[Job], wait: bool, composer: Composer) -> list[dict[str, Any]]:
    """Runs jobs by the chosen launcher and returns the outcome of each."""
    if not jobs:
        return []
    task = run_job_after_others if wait else run_job
    launcher = Plugins.instance().instantiate_launcher(
        hydra_context=composer.context, task_function=task, config=composer.config
    )
    workers, quiet = getattr(launcher, "joblib", None), nullcontext()  # the joblib launcher has joblib's own arguments
    if workers is not None:
        workers |= {"initializer": end_with, "initargs": (os.getpid(),)}
        from joblib.externals.loky.backend import resource_tracker

        resource_tracker.ensure_running()  # as in ``children_ignore_interrupts``
        quiet = children_ignore_interrupts()  # the thread of the progress bar still receives Ctrl-C
    try:
        with quiet:
            returns = launcher.launch([job.overrides for job in jobs], initial_job_idx=0)
        return [each.return_value for each in returns]
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        print_error(f"the launcher broke down: {reason}; the same command goes on where it stopped")
        sys.exit(1)


@contextmanager
def _progress(jobs: Sequence[Job], console: Any) -> Iterator[None]:
    """Shows one bar for the whole sweep, drawn by a thread that looks at the folders."""
    with progress_bar(console) as bar:
        task, over, open_jobs = bar.add_task("flying", total=len(jobs)), Event(), list(jobs)

        def look() -> None:
            nonlocal open_jobs
            open_jobs = [job for job in open_jobs if not job.done]
            bar.update(task, completed=len(jobs) - len(open_jobs))

        def watch() -> None:
            while not over.wait(LOOK):
                look()

        watcher = Thread(target=watch, daemon=True)
        look()
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()
            look()
