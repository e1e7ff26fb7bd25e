"""``gpmpc tune``: searches settings for the least closed-loop cost of flights.

A search is written as a sweep, and has no memory but the folders of its runs: the same command proposes the same
candidates, and those that are finished are not flown again.
"""

import math
import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from typing import Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from rich.console import Console

from gpmpc.cli._command import Result
from gpmpc.cli._run import choices, experiment_of
from gpmpc.cli._settings import without_hydra, write_files
from gpmpc.cli._sweep import Job, Sweep
from gpmpc.exceptions import DataError, GpmpcError, SettingError, check_number
from gpmpc.metrics import tracking_cost
from gpmpc.recording import read_run
from gpmpc.studies._document import terminal
from gpmpc.studies._run_folder import RECORDING
from gpmpc.studies.tuning import Interval, Search


def tune(given: Namespace) -> Result:
    """Searches, and writes the candidates, a figure of what mattered and the command that flies the best one."""
    for key in ("trials", "batch", "seeds"):
        check_number(f"--{key}", getattr(given, key), least=1, whole=True)
    space, fixed = _space(given.overrides)
    console = Console()
    runs = Sweep(given.config_name, fixed, console)
    base = without_hydra(runs.config)
    first = runs.config.seed
    if base.recorder != "mcap":
        raise SettingError(
            "recorder",
            f"must be mcap: a flight's cost is read from it; got {base.recorder}",
        )
    if base.steps < 2:
        raise SettingError(
            "steps",
            f"must be 2 or more: the cost counts from the second state on; got {base.steps}",
        )
    search = Search(space, first)
    controller: Any = experiment_of(
        base
    ).controller  # whose weights the cost has, whatever is searched

    def jobs_of(candidate: Mapping[str, Any]) -> list[Job]:
        overrides = [*fixed, *_overrides(candidate, base)]
        return [runs.job([*overrides, f"seed={first + i}"]) for i in range(given.seeds)]

    def fly(candidates: Sequence[Mapping[str, Any]]) -> list[float]:
        groups = [jobs_of(candidate) for candidate in candidates]
        batch = {job.folder.path: job for group in groups for job in group}
        runs.check([*batch.values()])
        flying.extend(batch.values())
        runs.fly([*batch.values()])
        return [
            sum(_cost(job, controller.keywords) for job in group) / given.seeds
            for group in groups
        ]

    flying: list[Job] = []
    with runs.progress(flying, (given.trials + 1) * given.seeds) as describe:
        (unchanged,) = fly([{}])
        for start in range(0, given.trials, given.batch):
            search.tell(fly(search.ask(min(given.batch, given.trials - start))))
            describe(f"flying; least cost {search.costs[search.best]:.4g}")
    if not math.isfinite(search.costs[search.best]):
        raise GpmpcError(f"tune: every flight was lost or failed; see {runs.tree}")
    own = [] if given.config_name == "tune" else ["--config-name", given.config_name]
    own += ["--config-dir", given.config_dir] if given.config_dir else []
    best = choices([*fixed, *_overrides(search.candidates[search.best], base)])
    command = shlex.join(["gpmpc", "run", *own, *best, f"folder={runs.tree / 'best'}"])
    document = search.document(unchanged if math.isfinite(unchanged) else None, command)
    where = write_files(
        runs.tree, document.files("tuning") | {"tuning.html": document.html()}
    )
    console.print(terminal(document.tables, document.lead))
    console.out(f"to fly the best one: {command}", where, sep="\n", highlight=False)
    runs.tell_other_code()
    data = {
        "folder": str(runs.tree),
        "best": search.candidates[search.best],
        "cost": search.costs[search.best],
    }
    return Result(
        data
        | {
            "unchanged": unchanged,
            "of_other_code": [str(path) for path in runs.of_other_code],
            "importances": search.importances(),
            "command": command,
        }
    )


def _space(
    overrides: Sequence[str],
) -> tuple[dict[str, Interval | Sequence[str]], list[str]]:
    """Returns what is searched, by setting, and the settings that stay."""
    space: dict[str, Any] = {}
    fixed: list[Any] = []
    for override in OverridesParser.create().parse_overrides([*overrides]):
        key = override.get_key_element()
        value = cast(Any, override.value())
        if key in ("seed", "folder", "launcher") and override.is_sweep_override():
            raise SettingError(key, "cannot be searched; seeds are many by --seeds")
        if not override.is_sweep_override():
            fixed.append(override.input_line)
        elif override.is_interval_sweep():
            whole = isinstance(value.start, int)
            logarithmic = "log" in value.tags
            if not value.start < value.end or (logarithmic and value.start <= 0):
                raise SettingError(
                    key,
                    f"must rise{', from above 0' * logarithmic}; got {override.input_line}",
                )
            space[key] = Interval(value.start, value.end, logarithmic, whole)
        else:
            space[key] = [*override.sweep_string_iterator()]
            if not space[key]:
                raise SettingError(key, "holds no value to search")
    if not space:
        raise GpmpcError(
            "tune: names nothing to search, such as horizon=1,5,10 or 'horizon=int(interval(1,30))'"
        )
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
                raise SettingError(
                    key, f"{parent} is no list with such an entry; got {before}"
                )
            lists.setdefault(parent, list(before))[int(last)] = value
        else:
            plain.append(f"{key}={value}")
    return plain + [
        f"{key}=[{','.join(map(str, values))}]" for key, values in lists.items()
    ]


def _cost(job: Job, controller: Mapping[str, Any]) -> float:
    """Returns the cost of a run with the weights of a controller; infinite where it was lost or failed."""
    if not job.folder.finished or job.folder.result().get("lost"):
        return math.inf
    run = read_run(job.folder.path / RECORDING)
    cost = controller["problem"].cost
    if not run.whole:  # the cost of the steps that are left would be too low
        raise DataError(f"{run.path}: {'; '.join(flaw.text for flaw in run.flaws)}")
    return tracking_cost(
        cost.Q,
        cost.R,
        run.states,
        run.references,
        run.inputs[:-1],
        controller["initial_input"],
        cost.angles or (),
    )
