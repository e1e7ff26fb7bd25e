"""``gpmpc run -m``: many flights that may be stopped at any moment and go on later; ``gpmpc tune``: a search by them.

Hydra composes every run's settings and its launcher plugins start the runs, on one machine or on a cluster; what is
kept, and whether it is finished, is in the runs' folders alone. So a sweep is resumed by the same command: finished
runs are not launched again, failed and unfinished ones are. A finished run passes for one that is asked for only if all
its settings are the same; else the sweep is refused before anything is launched. The parent only looks at the folders
to show how far it is. Several sweeps may share a tree: a run that another process works on is left to it, and looked at
again at the end.

A search for the least closed-loop cost is written as a sweep: settings with several values, or an interval, are
searched, all others stay. It has no memory but the folders of its runs: the same command proposes the same candidates,
and those that are finished are not flown again.
"""

import hashlib
import itertools
import json
import math
import os
import shlex
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf

from gpmpc._compiling import report_compilation
from gpmpc.cli._run import ASIDE, choices, experiment_of, plain_settings, run_one
from gpmpc.cli._settings import Command, Parser, Result, folder_of, group_options, without_hydra, write_files
from gpmpc.cli._terminal import print_error, progress_bar
from gpmpc.exceptions import GpmpcError, RecordingError, SettingError, check_number
from gpmpc.parallel import THREADS, children_ignore_interrupts, end_with
from gpmpc.studies._run_folder import PLAN, Busy, RunFolder, folder_name

if TYPE_CHECKING:
    from gpmpc.studies.tuning import Interval


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


class Sweep:
    """Runs of one tree: their settings, which are finished, and the launcher that flies the others."""

    def __init__(self, name: str, overrides: Sequence[str], console: Any):
        for thread_count in THREADS:  # before the libraries load, here and in the processes started from here
            os.environ[thread_count] = "1"
        self.config = hydra.compose(name, [*overrides], return_hydra_config=True)
        self.config.hydra.mode = RunMode.MULTIRUN
        self.tree, self.console = folder_of(self.config.folder), console
        nothing: Any = SimpleNamespace(on_job_start=lambda **_: None, on_job_end=lambda **_: None)  # around every job
        self._context = HydraContext(GlobalHydra.instance().config_loader(), nothing)
        self._checked: set[str] = set()

    def job(self, overrides: Sequence[str]) -> Job:
        """Returns the run of these settings."""
        folder = RunFolder(self.tree / folder_name(choices(overrides)))
        return Job([*overrides], folder, folder.failed_at)

    def settings(self, job: Job) -> tuple[DictConfig, Mapping[str, Any]]:
        """Returns a run's settings, and the chosen option by group."""
        composed = self._context.config_loader.load_sweep_config(self.config, job.overrides)
        return without_hydra(composed), composed.hydra.runtime.choices

    def check(self, jobs: Sequence[Job]) -> None:
        """Makes the objects once for every value that occurs: a mistake is found before anything is launched."""
        finished = [job for job in jobs if job.folder.finished]
        with report_compilation():
            for job in jobs:
                if job not in finished and not self._checked.issuperset(job.overrides):
                    experiment_of(self.settings(job)[0])
                    self._checked.update(job.overrides)
        with self.console.status(f"comparing the settings of {len(finished)} finished runs"):
            for job in finished:
                job.folder.result(plain_settings(*self.settings(job)))

    def fly(self, jobs: Sequence[Job]) -> list[dict[str, Any]]:
        """Flies the runs that are not finished; returns the outcome of each of those."""
        waiting = [job for job in jobs if not job.folder.finished]
        outcomes = self._launch(waiting, partial(_fly_job, wait=False))
        busy = [job for job, outcome in zip(waiting, outcomes, strict=True) if "busy" in outcome]
        return [o for o in outcomes if "busy" not in o] + self._launch(busy, partial(_fly_job, wait=True))

    def _launch(self, jobs: Sequence[Job], task: Callable[[DictConfig], dict[str, Any]]) -> list[dict[str, Any]]:
        if not jobs:
            return []
        launcher: Any = Plugins.instance().instantiate_launcher(
            hydra_context=self._context, task_function=task, config=self.config
        )
        workers, quiet = getattr(launcher, "joblib", None), nullcontext()  # joblib's launcher has joblib's arguments
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
    def progress(self, jobs: Sequence[Job], total: int) -> Iterator[Callable[[str], None]]:
        """Shows one bar for many runs, which looks at their folders whenever it is drawn; yields what names it."""
        done: set[int] = set()

        def completed() -> int:
            done.update(i for i, job in enumerate([*jobs]) if i not in done and job.done)
            return len(done)

        with progress_bar(self.console, completed) as bar:
            task = bar.add_task("flying", total=total)
            yield lambda text: bar.update(task, description=text)


def sweep(given: Namespace, name: str) -> Result:
    """Runs every combination of the choices that is not finished; the result's code is 1 where runs failed."""
    from rich.console import Console

    console, combinations = Console(), _combinations(given.overrides)
    runs = Sweep(name, combinations[0], console)
    jobs = list({job.folder.path: job for job in map(runs.job, combinations)}.values())
    finished = sum(job.folder.finished for job in jobs)
    runs.check(jobs)
    # What was asked for, so that a report knows what is missing; equal sweeps write the same file.
    plan = json.dumps({"runs": [choices(job.overrides) for job in jobs]}, indent=1) + "\n"
    write_files(runs.tree, {f"{PLAN}{hashlib.sha256(plan.encode()).hexdigest()[:10]}.json": plan})
    with runs.progress(jobs, len(jobs)):
        outcomes = runs.fly(jobs)
    failed = [outcome for outcome in outcomes if "error" in outcome]
    total = "1 run" if len(jobs) == 1 else f"{len(jobs)} runs"
    text = f"{total}: {len(outcomes) - len(failed)} flown, {finished} finished before, {len(failed)} failed"
    console.out(f"{text}; in {runs.tree}", highlight=False)
    for outcome in failed:
        print_error(f"failed: {outcome['folder']}: {outcome['error']}")
    data = {"folder": str(runs.tree), "runs": [str(job.folder.path) for job in jobs], "failed": failed}
    return Result(data, 1 if failed else 0)


@report_compilation()
def _fly_job(config: DictConfig, wait: bool) -> dict[str, Any]:
    """Flies one run of a sweep, in whichever process a launcher started; with ``wait`` after others that work on it."""
    try:
        outcome = run_one(config, wait)
    except Busy:
        return {"busy": True}
    except GpmpcError as error:  # of this run; the others go on
        return {"error": str(error), "folder": config.folder}
    return {key: outcome[key] for key in ("folder", "error") if key in outcome}


def _combinations(overrides: Sequence[str]) -> list[list[str]]:
    """Returns the overrides of every run; of a key given twice, the last one counts."""
    values: dict[str, Any] = {}
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key, swept = override.get_key_element(), override.is_sweep_override()
        found = [f"{key}={value}" for value in override.sweep_string_iterator()] if swept else [override.input_line]
        if not found:
            raise SettingError(key, "holds no value to sweep over")
        values[key] = found
    return [list(combination) for combination in itertools.product(*values.values())]


_BEST = "best.yaml"


def _add_arguments(parser: Parser) -> None:
    """Adds the options of the command; what they mean stands in ``conf/tune.yaml``."""
    for name, default in (("--trials", 40), ("--batch", 4), ("--seeds", 1)):
        parser.add_argument(name, type=int, default=default)


def tune(given: Namespace, name: str) -> Result:
    """Searches, and writes the candidates, a figure of what mattered and the best settings."""
    from rich.console import Console

    from gpmpc.studies._document import terminal
    from gpmpc.studies.tuning import Search

    for key in ("trials", "batch", "seeds"):
        check_number(f"--{key}", getattr(given, key), least=1, whole=True)
    space, fixed = _space(given.overrides)
    console, runs = Console(), Sweep(name, fixed, Console())
    if runs.config.recorder != "mcap":
        raise SettingError("recorder", f"must be mcap: a flight's cost is read from it; got {runs.config.recorder}")
    search, first = Search(space, runs.config.seed), runs.config.seed
    base = without_hydra(runs.config)
    if runs.config.steps < 2:
        raise SettingError("steps", f"must be 2 or more: the cost counts from the second state on; got {base.steps}")
    controller: Mapping[str, Any] = getattr(
        experiment_of(base).controller, "keywords", {}
    )  # whose weights the cost has, whatever is searched

    def jobs_of(candidate: Mapping[str, Any]) -> list[Job]:
        overrides = [*fixed, *_overrides(candidate, base)]
        return [runs.job([*overrides, f"seed={first + i}"]) for i in range(given.seeds)]

    def fly(candidates: Sequence[Mapping[str, Any]]) -> list[float]:
        groups = [jobs_of(candidate) for candidate in candidates]
        batch = {job.folder.path: job for group in groups for job in group}
        runs.check([*batch.values()])
        flying.extend(batch.values())
        runs.fly([*batch.values()])
        return [sum(_cost(job, controller) for job in group) / given.seeds for group in groups]

    flying: list[Job] = []
    with runs.progress(flying, (given.trials + 1) * given.seeds) as describe:
        (unchanged,) = fly([{}])
        for start in range(0, given.trials, given.batch):
            search.tell(fly(search.ask(min(given.batch, given.trials - start))))
            describe(f"flying; least cost {search.costs[search.best]:.4g}")
    if not math.isfinite(search.costs[search.best]):
        raise GpmpcError(f"tune: every flight was lost or failed; see {runs.tree}")
    best = [*fixed, *_overrides(search.candidates[search.best], base)]
    command = shlex.join(["gpmpc", "run", "--config-dir", str(runs.tree), "--config-name", _BEST.removesuffix(".yaml")])
    document = search.document(unchanged if math.isfinite(unchanged) else None, command)
    written = document.files("tuning") | {
        "tuning.html": document.html(),
        _BEST: _config(best, name, str(runs.tree / "best")),
    }
    where = write_files(runs.tree, written)
    console.print(terminal(document.tables, document.lead))
    console.out(f"to fly the best one: {command}", where, sep="\n", highlight=False)
    data = {"folder": str(runs.tree), "best": search.candidates[search.best], "cost": search.costs[search.best]}
    return Result(data | {"unchanged": unchanged, "importances": search.importances(), "command": command})


def _space(overrides: Sequence[str]) -> tuple[dict[str, "Interval | Sequence[str]"], list[str]]:
    """Returns what is searched, by setting, and the settings that stay."""
    from gpmpc.studies.tuning import Interval

    space: dict[str, Any] = {}
    fixed: list[Any] = []
    for override in OverridesParser.create().parse_overrides([*overrides]):
        key, value = override.get_key_element(), cast(Any, override.value())
        if key in ("seed", "folder", "launcher") and override.is_sweep_override():
            raise SettingError(key, "cannot be searched; seeds are many by --seeds")
        if override.is_delete():
            raise SettingError(key, "cannot be left out here; write a file of your own and give --config-name")
        if not override.is_sweep_override():
            fixed.append(override.input_line)
        elif override.is_interval_sweep():
            whole, logarithmic = isinstance(value.start, int), "log" in value.tags
            if not value.start < value.end or (logarithmic and value.start <= 0):
                raise SettingError(key, f"must rise{', from above 0' * logarithmic}; got {override.input_line}")
            space[key] = Interval(value.start, value.end, logarithmic, whole)
        else:
            space[key] = [*override.sweep_string_iterator()]
            if not space[key]:
                raise SettingError(key, "holds no value to search")
    if not space:
        raise GpmpcError("tune: names nothing to search, such as horizon=1,5,10 or 'horizon=int(interval(1,30))'")
    return space, fixed


def _overrides(candidate: Mapping[str, Any], base: Any) -> list[str]:
    """Returns the settings of a candidate; ``KEY.i`` is entry i of the list KEY, whose others stay."""
    lists: dict[str, list] = {}
    plain = []
    for key, value in candidate.items():
        parent, _, last = key.rpartition(".")
        if last.isdecimal():
            before = OmegaConf.select(base, parent)
            if not OmegaConf.is_list(before) or int(last) >= len(before):
                raise SettingError(key, f"{parent} is no list with such an entry; got {before}")
            lists.setdefault(parent, list(before))[int(last)] = value
        else:
            plain.append(f"{key}={value}")
    return plain + [f"{key}=[{','.join(map(str, values))}]" for key, values in lists.items()]


def _cost(job: Job, controller: Mapping[str, Any]) -> float:
    """Returns the cost of a run with the weights of a controller; infinite where it was lost or failed."""
    from gpmpc.metrics import tracking_cost
    from gpmpc.recording import read_run
    from gpmpc.studies._run_folder import RECORDING

    if not job.folder.finished or job.folder.result().get("lost"):
        return math.inf
    try:
        run = read_run(job.folder.path / RECORDING)
    except RecordingError:
        return math.inf
    Q, R, before = controller["problem"].cost.Q, controller["problem"].cost.R, controller["initial_input"]
    return tracking_cost(Q, R, run.states, run.references, run.inputs[:-1], before)


def _config(overrides: Sequence[str], name: str, folder: str) -> str:
    """Returns the settings as a file that ``gpmpc run --config-name`` takes; its runs go to ``folder``."""
    name = "run" if name == "tune" else name
    groups, own = group_options("run"), OmegaConf.create()
    defaults: list[Any] = [name, "_self_"]
    for override in OverridesParser.create().parse_overrides([*overrides]):
        key = override.get_key_element().lstrip("+")
        if key in groups and key not in ASIDE:
            defaults.append({f"override /{key}": override.value()})
        elif key not in (*ASIDE, "seed") and not key.startswith("hydra"):
            OmegaConf.update(own, key, override.value(), force_add=True)
    text = OmegaConf.to_yaml(OmegaConf.merge({"defaults": defaults}, own, {"folder": folder}))
    return f"# The best settings that gpmpc tune found.\n{text}"


TUNE = Command("Searches settings for the least closed-loop cost", lambda given: Result(), "tune", _add_arguments)
