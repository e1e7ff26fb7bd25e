"""``gpmpc run -m``: many flights that may be stopped at any moment and go on later.

Hydra composes every run's settings and its launcher plugins start the runs; what is kept, and whether it is finished,
is in the runs' folders alone. So the same command resumes a sweep: only failed and unfinished runs are launched again.
Where a finished run has other settings, the sweep is refused before anything is launched. Where it was flown by other
code it stays, and the sweep says how many such runs there are. Several sweeps may share a tree: a run that another
process works on is left to it, and looked at again at the end.
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
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig
from rich.console import Console

from gpmpc._compiling import report_compilation
from gpmpc.cli._command import Result
from gpmpc.cli._run import choices, experiment_of, plain_settings, run_one, warning_of
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
    failed_before: int | None  # when an earlier attempt failed [ns]

    @property
    def done(self) -> bool:
        """Whether this sweep, or another one, has finished it or seen it fail."""
        return self.folder.finished or self.folder.failed_at not in (
            None,
            self.failed_before,
        )


class Sweep:
    """Runs of one tree: their settings, which are finished, and the launcher that flies the others."""

    def __init__(self, name: str, overrides: Sequence[str], console: Any):
        self.config = hydra.compose(name, [*overrides], return_hydra_config=True)
        self.config.hydra.mode = RunMode.MULTIRUN
        self.tree = folder_of(self.config.folder)
        self.console = console
        nothing: Any = SimpleNamespace(
            on_job_start=lambda **_: None, on_job_end=lambda **_: None
        )  # around every job
        self._context = HydraContext(GlobalHydra.instance().config_loader(), nothing)
        self._checked: set[str] = set()
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
        """Makes the objects once for every value that occurs: a mistake is found before anything is launched."""
        finished = [job for job in jobs if job.folder.finished]
        with report_compilation():
            for job in jobs:
                if job not in finished and not self._checked.issuperset(job.overrides):
                    experiment_of(self.settings(job)[0])
                    self._checked.update(job.overrides)
        with self.console.status(
            f"comparing the settings of {len(finished)} finished runs"
        ):
            for job in finished:
                result = job.folder.result(plain_settings(*self.settings(job)))
                warning = warning_of(result)
                if warning is not None:
                    self.warnings[job.folder.path] = warning
                other_code = of_other_code(result)
                if other_code:
                    self.of_other_code[job.folder.path] = other_code

    def tell_other_code(self) -> None:
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

    def tell_warnings(self) -> None:
        """Prints the finished runs that were lost, or suspicious at their end, a line each."""
        for folder, warning in sorted(self.warnings.items()):
            print_error(f"{folder}: {warning}")

    def fly(self, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        """Flies the runs that are not finished; returns the outcome of each of those."""
        waiting = [job for job in jobs if not job.folder.finished]
        outcomes = self._launch(waiting, partial(_fly_job, wait=False))
        busy = [
            job
            for job, outcome in zip(waiting, outcomes, strict=True)
            if "busy" in outcome
        ]
        return [o for o in outcomes if "busy" not in o] + self._launch(
            busy, partial(_fly_job, wait=True)
        )

    def _launch(
        self, jobs: Sequence[Job], task: Callable[[DictConfig], dict[str, Any]]
    ) -> list[dict[str, Any]]:
        if not jobs:
            return []
        launcher: Any = Plugins.instance().instantiate_launcher(
            hydra_context=self._context, task_function=task, config=self.config
        )
        # joblib's launcher has joblib's arguments
        workers = getattr(launcher, "joblib", None)
        quiet = nullcontext()
        if workers is not None:
            workers |= {"initializer": end_with, "initargs": (os.getpid(),)}
            from joblib.externals.loky.backend import resource_tracker

            resource_tracker.ensure_running()  # as in ``children_ignore_interrupts``
            quiet = (
                children_ignore_interrupts()
            )  # the thread of the progress bar still receives Ctrl-C
        try:
            with quiet:
                returns = launcher.launch(
                    [job.overrides for job in jobs], initial_job_idx=0
                )
            return [each.return_value for each in returns]
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            print_error(
                f"the launcher broke down: {reason}; the same command goes on where it stopped"
            )
            sys.exit(1)

    @contextmanager
    def progress(
        self, jobs: Sequence[Job], total: int
    ) -> Iterator[Callable[[str], None]]:
        """Shows one bar for many runs, which looks at their folders whenever it is drawn; yields what names it."""
        with progress_bar(
            self.console, lambda: sum(job.done for job in [*jobs])
        ) as bar:
            task = bar.add_task("flying", total=total)
            yield lambda text: bar.update(task, description=text)


def sweep(given: Namespace) -> Result:
    """Runs every combination of the choices that is not finished; the result's code is 1 where runs failed."""
    console = Console()
    combinations = _combinations(given.overrides)
    runs = Sweep(given.config_name, combinations[0], console)
    jobs = list({job.folder.path: job for job in map(runs.job, combinations)}.values())
    finished = sum(job.folder.finished for job in jobs)
    runs.check(jobs)
    # What was asked for, so that a report knows what is missing; equal sweeps write the same file.
    plan = (
        json.dumps({"runs": [choices(job.overrides) for job in jobs]}, indent=1) + "\n"
    )
    write_files(
        runs.tree,
        {f"{PLAN}{hashlib.sha256(plan.encode()).hexdigest()[:10]}.json": plan},
    )
    with runs.progress(jobs, len(jobs)):
        outcomes = runs.fly(jobs)
    failed = [outcome for outcome in outcomes if "error" in outcome]
    for outcome in outcomes:
        if outcome.get("warning"):
            runs.warnings[Path(outcome["folder"])] = outcome["warning"]
    total = "1 run" if len(jobs) == 1 else f"{len(jobs)} runs"
    text = f"{total}: {len(outcomes) - len(failed)} flown, {finished} finished before, {len(failed)} failed"
    text += _counted([*runs.warnings.values()])
    console.out(f"{text}; in {runs.tree}", highlight=False)
    runs.tell_other_code()
    runs.tell_warnings()
    for outcome in failed:
        print_error(f"failed: {outcome['folder']}: {outcome['error']}")
    data = {
        "folder": str(runs.tree),
        "runs": [str(job.folder.path) for job in jobs],
        "of_other_code": [str(path) for path in runs.of_other_code],
        "warnings": {str(path): text for path, text in runs.warnings.items()},
        "failed": failed,
    }
    return Result(data, 1 if failed else 0)


def _counted(warnings: Sequence[str]) -> str:
    """Returns how many runs were lost or suspicious, as the end of a sentence."""
    lost = sum(warning.startswith("lost") for warning in warnings)
    counts = [(lost, "lost"), (len(warnings) - lost, "suspicious at their end")]
    return "".join(f", {count} {what}" for count, what in counts if count)


@report_compilation()
def _fly_job(config: DictConfig, wait: bool) -> dict[str, Any]:
    """Flies one run of a sweep, in whichever process a launcher started; with ``wait`` after others that work on it."""
    try:
        outcome = run_one(config, wait)
    except Busy:
        return {"busy": True}
    except GpmpcError as error:  # of this run; the others go on
        return {"error": str(error), "folder": config.folder}
    found: dict[str, Any] = {
        key: outcome[key] for key in ("folder", "error") if key in outcome
    }
    if "result" in outcome:
        found["warning"] = warning_of(outcome["result"])
    return found


def _combinations(overrides: Sequence[str]) -> list[list[str]]:
    """Returns the overrides of every run; of a key given twice, the last one counts."""
    values: dict[str, Any] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.get_key_element()
        swept = override.is_sweep_override()
        found = (
            [f"{key}={value}" for value in override.sweep_string_iterator()]
            if swept
            else [override.input_line]
        )
        if not found:
            raise SettingError(key, "holds no value to sweep over")
        values[key] = found
    return [list(combination) for combination in itertools.product(*values.values())]
