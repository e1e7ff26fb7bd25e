"""Problem: many flights at once, on one machine or on a cluster, that may be stopped at any moment and go on later.

Hydra composes every run's settings and its launcher plugins start the runs; what is kept, and whether it is finished,
is in the runs' folders alone. So a sweep is resumed by the same command: finished runs are not launched again, failed
and unfinished ones are. A finished run passes for one that is asked for only if all its settings are the same; else the
sweep is refused before anything is launched. The parent only looks at the folders to show how far it is. Several sweeps
may share a tree: a run that another process works on is left to it, and looked at again at the end.
"""

import hashlib
import json
import os
import sys
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from threading import Event, Thread
from typing import Any

from hydra import version
from hydra._internal.callbacks import Callbacks
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, open_dict

from gpmpc.cli.run import check_same, checked_folder, choices, experiment_of, fly_one, plain_settings
from gpmpc.cli.screen import progress_bar
from gpmpc.compiling import tell_of_compiling
from gpmpc.exceptions import GpmpcError, SettingError
from gpmpc.experiments.run_folder import PLAN, Busy, RunFolder, folder_name
from gpmpc.files import write_whole
from gpmpc.parallel import THREADS, children_ignore_interrupts, end_with

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
    console = Console()
    try:
        context, config = _composed(given, conf)
        jobs = _jobs(given.overrides, config)
        waiting, finished = [], []
        for job in jobs:
            (finished if job.folder.finished else waiting).append(job)
        with tell_of_compiling():
            _check(waiting, context, config)
        with console.status(f"comparing the settings of {len(finished)} finished runs"):
            _check_finished(finished, context, config)
        _keep_plan(jobs, Path(config.folder))
        with _progress(jobs, console):
            outcomes = _launch(waiting, False, context, config)
            left = [job for job, outcome in zip(waiting, outcomes, strict=True) if "busy" in outcome]
            again = _launch(left, True, context, config)
    finally:
        GlobalHydra.instance().clear()
    failed = [outcome for outcome in chain(outcomes, again) if "error" in outcome]
    runs = "1 run" if len(jobs) == 1 else f"{len(jobs)} runs"
    text = f"{runs}: {len(waiting) - len(failed)} flown, {len(finished)} finished before"
    console.print(f"{text}, {len(failed)} failed; in {config.folder}", soft_wrap=True, highlight=False, markup=False)
    for outcome in failed:
        print(f"gpmpc: failed: {outcome['folder']}: {outcome['error']}", file=sys.stderr)
    if failed:
        sys.exit(1)


def fly(config: DictConfig) -> dict[str, Any]:
    """One run of a sweep, in whichever process a launcher started; leaves alone what another process works on."""
    return _outcome(config, wait=False)


def fly_after_others(config: DictConfig) -> dict[str, Any]:
    """The same, after the process that worked on it."""
    return _outcome(config, wait=True)


@tell_of_compiling()
def _outcome(config: DictConfig, wait: bool) -> dict[str, Any]:
    try:
        outcome = fly_one(config, wait)
    except Busy:
        return {"busy": True}
    except GpmpcError as error:  # of this run; the others go on
        return {"error": str(error), "folder": config.folder}
    return {key: outcome[key] for key in ("folder", "error") if key in outcome}


def _composed(given: Namespace, conf: Path) -> tuple[HydraContext, DictConfig]:
    """What ``hydra.main`` makes before it sweeps."""
    version.setbase("1.3")
    folders = create_config_search_path(given.config_path or str(conf))
    if given.config_dir is not None:
        if not Path(given.config_dir).is_dir():
            raise SettingError("--config-dir", f"{given.config_dir}: no such folder")
        own = f"file://{Path(given.config_dir).absolute()}"
        folders.prepend(provider="command-line", path=own, anchor=SearchPathQuery(provider="schema"))
    hydra = Hydra.create_main_hydra2("run", folders)
    name, overrides = given.config_name or "run", list(given.overrides)
    config = hydra.compose_config(name, overrides, run_mode=RunMode.MULTIRUN, with_log_configuration=False)
    config.hydra.mode = RunMode.MULTIRUN
    return HydraContext(config_loader=hydra.config_loader, callbacks=Callbacks(config)), config


def _jobs(overrides: Sequence[str], config: DictConfig) -> list[Job]:
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    for override in parsed:
        if override.is_sweep_override() and not list(override.sweep_iterator()):
            raise SettingError(override.get_key_element(), "holds no value to sweep over")
    ((*combinations,),) = BasicSweeper.split_arguments(parsed, None)
    tree, jobs = Path(checked_folder(config)), {}
    for combination in combinations:
        folder = RunFolder(tree / folder_name(choices(combination)))
        jobs[folder.path] = Job(combination, folder, folder.failed_at)
    return list(jobs.values())


def _check(jobs: Sequence[Job], context: HydraContext, config: DictConfig) -> None:
    """Makes the objects once for every value that occurs: a mistake is found before anything is launched."""
    seen: set[str] = set()
    for job in jobs:
        if not seen.issuperset(job.overrides):
            experiment_of(_settings(job, context, config)[0])
            seen.update(job.overrides)


def _check_finished(jobs: Sequence[Job], context: HydraContext, config: DictConfig) -> None:
    """Raises where a finished run is another one than is asked for now."""
    for job in jobs:
        check_same(job.folder, plain_settings(*_settings(job, context, config)))


def _settings(job: Job, context: HydraContext, config: DictConfig) -> tuple[DictConfig, Mapping[str, Any]]:
    """A run's composed settings, and the chosen option by group."""
    composed = context.config_loader.load_sweep_config(config, job.overrides)
    options = composed.hydra.runtime.choices
    with open_dict(composed):
        del composed["hydra"]
    return composed, options


def _keep_plan(jobs: Sequence[Job], tree: Path) -> None:
    """Writes what was asked for, so that a report knows what is missing; equal sweeps write the same file."""
    plan = [choices(job.overrides) for job in jobs]
    text = json.dumps({"runs": plan}, indent=1) + "\n"
    try:
        tree.mkdir(parents=True, exist_ok=True)
        write_whole(tree / f"{PLAN}{hashlib.sha256(text.encode()).hexdigest()[:10]}.json", text)
    except OSError as error:
        raise SettingError("folder", f"cannot write to {tree}: {error.strerror or error}") from error


def _launch(jobs: Sequence[Job], wait: bool, context: HydraContext, config: DictConfig) -> list[dict[str, Any]]:
    """What came of every job."""
    if not jobs:
        return []
    launcher = Plugins.instance().instantiate_launcher(
        hydra_context=context, task_function=fly_after_others if wait else fly, config=config
    )
    workers, quiet = getattr(launcher, "joblib", None), nullcontext()  # the joblib launcher has joblib's own arguments
    if workers is not None:
        workers |= {"initializer": end_with, "initargs": (os.getpid(),)}
        from joblib.externals.loky.backend import resource_tracker

        resource_tracker.ensure_running()  # as in ``children_ignore_interrupts``
        quiet = children_ignore_interrupts()  # the thread of the progress bar still hears Ctrl-C
    try:
        with quiet:
            returns = launcher.launch([job.overrides for job in jobs], initial_job_idx=0)
        return [each.return_value for each in returns]
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        print(f"gpmpc: the launcher broke down: {reason}; the same command goes on where it stopped", file=sys.stderr)
        sys.exit(1)


@contextmanager
def _progress(jobs: Sequence[Job], console: Any) -> Iterator[None]:
    """One bar for the whole sweep, drawn by a thread that looks at the folders."""
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
