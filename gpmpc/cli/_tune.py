"""``gpmpc tune``: searches settings for the least closed-loop cost of flights.

    choices -> space -> batches of candidates -> flights with every seed -> costs ->
    search

A search is written as a sweep, and has no memory but the folders of its runs: the same
command proposes the same candidates, and those that are finished are not flown again.
"""

import math
from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from typing import Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from gpmpc.cli._chunks import Job
from gpmpc.cli._commands import Result
from gpmpc.cli._composing import ComposedSettings
from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._folders import write_files
from gpmpc.cli._launchers import Refused
from gpmpc.cli._overrides import choices, is_shared
from gpmpc.cli._settings import config_source_options, run_command, without_hydra
from gpmpc.cli._sweep import JobOutcome, Sweep, cannot_go_on, print_failed
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import (
    DataError,
    GpmpcError,
    RecordingError,
    SettingError,
    check_number,
)
from gpmpc.metrics import tracking_cost
from gpmpc.recording import read_run
from gpmpc.studies._document import terminal
from gpmpc.studies._run_folder import RECORDING, folder_override
from gpmpc.studies.tuning import Interval, Search

Candidate = Mapping[str, Any]  # values by setting


class Tuning:
    """The flights of a search, and their costs.

    Args:
        runs: The folders that the flights are kept in.
        fixed: Overrides of every flight.
        seeds: Flights a candidate.
    """

    def __init__(self, runs: Sweep, fixed: Sequence[str], seeds: int):
        self.runs = runs
        self.fixed = fixed
        self.seeds = seeds
        self.base = without_hydra(runs.config)
        #: all that were flown, or are being flown
        self.jobs: list[Job] = []
        #: flights of this call that failed, and why, by folder
        self.failures: dict[str, JobOutcome] = {}
        _check_base(self.base)
        # The cost has the weights of this controller, whatever is searched.
        self._controller: Any = experiment_of(self.base).controller

    def overrides(self, candidate: Candidate) -> list[str]:
        """Returns the overrides of the flights of a candidate, without the seed.

        ``KEY.i`` is entry i of the list KEY, whose others stay as what the candidate
        chooses besides, such as its system, has them.
        """
        entries = {}
        overrides = [*self.fixed]
        for key, value in candidate.items():
            if key.rpartition(".")[2].isdecimal():
                entries[key] = value
            else:
                overrides.append(f"{key}={value}")
        if entries:
            settings = self.runs.job(overrides).settings
            overrides += _overrides_of_lists(entries, settings)
        return overrides

    def costs(self, candidates: Sequence[Candidate]) -> list[float]:
        """Flies candidates with every seed; returns the mean cost of each."""
        jobs_of_candidates = [self._jobs(candidate) for candidate in candidates]
        by_folder = {
            job.folder.path: job for jobs in jobs_of_candidates for job in jobs
        }
        batch = [*by_folder.values()]
        self.runs.check(batch)
        self.jobs.extend(batch)
        for outcome in self.runs.fly(batch):
            # A candidate may come twice, and fly again where it failed.
            self.failures.pop(outcome.folder, None)
            if outcome.error is not None:
                self.failures[outcome.folder] = outcome
        cost_of = {path: self._cost(job) for path, job in by_folder.items()}
        return [
            sum(cost_of[job.folder.path] for job in jobs) / self.seeds
            for jobs in jobs_of_candidates
        ]

    @property
    def failed(self) -> list[JobOutcome]:
        """The flights of this call that failed, and why."""
        return [*self.failures.values()]

    def _cost(self, job: Job) -> float:
        """Returns the cost of a flight, infinite where it was lost or failed.

        One whose recording is gone or damaged has failed: who removes its folder has it
        flown again.
        """
        folder = str(job.folder.path)
        if folder in self.failures:
            return math.inf
        try:
            return _cost(job, self._controller.keywords)
        except (DataError, RecordingError) as error:
            reason = f"{error}; its folder has to be removed to fly it again"
            self.failures[folder] = JobOutcome(folder, reason)
            return math.inf

    def _jobs(self, candidate: Candidate) -> list[Job]:
        """Returns the flights of a candidate, one a seed."""
        overrides = self.overrides(candidate)
        first_seed = self.base.seed
        return [
            self.runs.job([*overrides, f"seed={first_seed + i}"])
            for i in range(self.seeds)
        ]


def tune(arguments: Namespace) -> Result:
    """Searches, and writes the candidates, what mattered and how the best one flies.

    Returns:
        The best candidate; the exit code is 1 where flights failed, whose cost is
        infinite, or where no candidate has a finite cost.
    """
    for key in ("trials", "batch", "seeds"):
        check_number(f"--{key}", getattr(arguments, key), least=1, whole=True)
    space, fixed = _space(arguments.overrides)
    console = Console()
    runs = Sweep(arguments.config_name, fixed, console)
    tuning = Tuning(runs, fixed, arguments.seeds)
    search = Search(space, runs.config.seed)
    total = (arguments.trials + 1) * arguments.seeds
    try:
        with closing(runs), runs.progress(tuning.jobs, total) as describe:
            (unchanged_cost,) = tuning.costs([{}])
            for start in range(0, arguments.trials, arguments.batch):
                candidates = search.ask(min(arguments.batch, arguments.trials - start))
                search.tell(tuning.costs(candidates))
                describe(f"flying; least cost {search.costs[search.best]:.4g}")
    except OSError as error:
        place = error.filename or runs.tree
        return cannot_go_on(runs.tree, f"{place}: {error.strerror or error}")
    except Refused as error:
        is_first_batch = len(tuning.jobs) <= tuning.seeds
        if is_first_batch and not error.has_launched:
            raise
        return cannot_go_on(runs.tree, str(error))
    print_failed(tuning.failed)
    best = search.candidates[search.best]
    least_cost = search.costs[search.best]
    if not math.isfinite(least_cost):
        reason = f"every candidate was lost or failed; see {runs.tree}"
        print_error(f"tune: {reason}")
        failed = [each._asdict() for each in tuning.failed]
        data = {"folder": str(runs.tree), "error": reason, "failed": failed}
        return Result(data, 1)
    best_choices = [
        *choices(tuning.overrides(best)),
        folder_override(runs.tree / "best"),
    ]
    command = run_command(config_source_options(runs.config.hydra), best_choices)
    base_cost = unchanged_cost if math.isfinite(unchanged_cost) else None
    document = search.document(base_cost, command)
    files = document.files("tuning") | {"tuning.html": document.html()}
    written = write_files(runs.tree, files)
    console.print(terminal(document.tables, document.lead))
    console.out(f"to fly the best one: {command}", written, sep="\n", highlight=False)
    runs.print_other_code()
    runs.print_attempts()
    data = {
        "folder": str(runs.tree),
        "best": best,
        "cost": least_cost,
        "unchanged": base_cost,
        "of_other_code": [str(path) for path in runs.of_other_code],
        "failed": [each._asdict() for each in tuning.failed],
        "importances": search.importances(),
        "command": command,
    }
    return Result(data, 1 if tuning.failed else 0)


def _check_base(base: DictConfig) -> None:
    """Raises where flights would have no cost."""
    if base.recorder != "mcap":
        raise SettingError(
            "recorder",
            f"must be mcap: a flight's cost is read from it; got {base.recorder}",
        )
    _check_least_steps("steps", [base.steps])


def _check_least_steps(key: str, values: Sequence[Any]) -> None:
    """Raises where a flight of some number of steps would have no cost."""
    if key.lstrip("+") != "steps":
        return
    for value in values:
        steps = math.inf
        with suppress(ValueError, TypeError):  # what is no number, a flight refuses
            steps = float(value)
        if steps < 2:
            raise SettingError(
                "steps",
                "must be 2 or more: the cost counts from the second state on; "
                f"got {value}",
            )


def _space(
    overrides: Sequence[str],
) -> tuple[dict[str, Interval | Sequence[str]], list[str]]:
    """Returns what is searched, by setting, and the settings that stay."""
    space: dict[str, Interval | Sequence[str]] = {}
    fixed: list[str] = []
    for override in OverridesParser.create().parse_overrides([*overrides]):
        key = override.get_key_element()
        if not override.is_sweep_override():
            fixed.append(str(override.input_line))
            continue
        name = key.lstrip("+")
        if name == "recorder":
            raise SettingError(
                name, "cannot be searched: a flight's cost is read from its recording"
            )
        if name == "seed" or is_shared(key):
            raise SettingError(name, "cannot be searched; seeds are many by --seeds")
        if override.is_interval_sweep():
            interval = _interval(key, override)
            _check_least_steps(key, [interval.low])
            space[key] = interval
            continue
        values = [*override.sweep_string_iterator()]
        if not values:
            raise SettingError(key, "holds no value to search")
        _check_least_steps(key, values)
        space[key] = values
    if not space:
        raise GpmpcError(
            "tune: names nothing to search, such as horizon=1,5,10 or "
            "'horizon=int(interval(1,30))'"
        )
    return space, fixed


def _interval(key: str, override: Override) -> Interval:
    """Returns the interval of an override ``KEY=interval(LOW,HIGH)``."""
    interval = cast(Any, override.value())
    logarithmic = "log" in interval.tags
    if not interval.start < interval.end or (logarithmic and interval.start <= 0):
        condition = "must rise, from above 0" if logarithmic else "must rise"
        raise SettingError(key, f"{condition}; got {override.input_line}")
    return Interval(
        low=interval.start,
        high=interval.end,
        logarithmic=logarithmic,
        whole=isinstance(interval.start, int),
    )


def _overrides_of_lists(entries: Candidate, settings: ComposedSettings) -> list[str]:
    """Returns whole lists with new entries, ``KEY.i`` each; others are as set before.

    Raises:
        SettingError: There is no such list, or entry.
    """
    config = settings.config()
    lists: dict[str, list] = {}
    for key, value in entries.items():
        parent, _, index = key.rpartition(".")
        before: Any = OmegaConf.select(config, parent)
        if not OmegaConf.is_list(before) or int(index) >= len(before):
            raise SettingError(
                key, f"{parent} is no list with such an entry; got {before}"
            )
        lists.setdefault(parent, list(before))[int(index)] = value
    return [f"{key}=[{','.join(map(str, values))}]" for key, values in lists.items()]


def _cost(job: Job, controller: Mapping[str, Any]) -> float:
    """Returns the cost of a run with the weights of a controller.

    Infinite where the run was lost or failed.
    """
    if not job.folder.finished or job.folder.result().get("lost"):
        return math.inf
    run = read_run(job.folder.path / RECORDING)
    if not run.whole:  # the cost of the steps that are left would be too low
        raise DataError(f"{run.path}: {'; '.join(flaw.text for flaw in run.flaws)}")
    cost = controller["problem"].cost
    return tracking_cost(
        cost.Q,
        cost.R,
        run.states,
        run.references,
        run.inputs[:-1],
        controller["initial_input"],
        cost.angle_indices,
    )
