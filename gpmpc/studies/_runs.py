"""Puts a tree of runs together: what was varied, the results, what failed and what is missing.

A *cell* is one combination of the varied settings; its runs differ in their seed. Missing is only what a sweep asked
for, in the plans that it leaves in the tree. Runs are read from their ``metrics.json`` and ``error.json`` alone. Those
may be damaged, or of any other origin: numbers are finite and texts are one printable line from here on, and a run that
cannot give them is skipped, with the reason.
"""

import json
import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gpmpc._provenance import flattened
from gpmpc.exceptions import DataError
from gpmpc.studies._document import plain_text
from gpmpc.studies._run_folder import ERROR, METRICS, PLAN, folder_name

SEED = "seed"
STATES = ("finished", "failed", "missing", "skipped")
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError)  # of a file

Choices = dict[str, str]


# Label with its unit, where {unit} stands for that of the runs' positions or angles, and the number of a run's result.
MEASURES: dict[str, tuple[str, Callable[[Mapping[str, Any]], float | None]]] = {
    "rmse": ("RMSE [{unit}]", lambda r: r["rmse"]["total"]),
    "outside": (
        "steps outside bounds [%]",
        lambda r: max((100 * v["rate"] for v in r["violations"].values()), default=None),
    ),
    "failed": ("failed solves [%]", lambda r: 100 * sum(r["failures"].values()) / r["steps"]),
    "decision": ("decision, median [ms]", lambda r: 1e3 * r["times"]["total"]["median"]),
    "training": ("training [s]", lambda r: r["times"]["training"]),
}


@dataclass(frozen=True)
class Run:
    """One run of a tree, or one that a sweep asked for; what was not read is empty."""

    choices: Choices  #: what was asked for, by key
    state: str  #: "finished", "failed", "missing" (there is nothing of it) or "skipped" (it cannot be read)
    folder: Path = Path()  #: where it is
    settings: Mapping[str, Any] = field(default_factory=dict)  #: all of them, by dotted key
    numbers: Mapping[str, float | None] = field(default_factory=dict)  #: by measure, of a finished run
    unit: str = ""  #: of its errors
    lost: str | None = None  #: since when and why the flight was lost; None where it was not
    error: str = ""  #: why the run failed
    #: what made it: "date", "commit" and "machine", where it says so
    origin: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Cell:
    """All runs of one combination."""

    values: tuple[str, ...]  #: of the varied settings, in the order of ``Report.variables``
    runs: Mapping[str, Run]  #: by seed

    def of(self, *states: str) -> list[Run]:
        """Returns the runs of some states, by seed."""
        return [run for run in self.runs.values() if run.state in states]

    def seeds(self, *states: str) -> list[str]:
        """Returns the seeds of the runs of some states."""
        return [seed for seed, run in self.runs.items() if run.state in states]

    def numbers(self, measure: str) -> list[float]:
        """Returns one measure of all runs that have it, by seed."""
        return [value for run in self.runs.values() if (value := run.numbers.get(measure)) is not None]

    @property
    def lost(self) -> list[Run]:
        """Runs that finished, and whose flight was lost."""
        return [run for run in self.runs.values() if run.lost is not None]


@dataclass(frozen=True)
class Report:
    """A tree of runs."""

    tree: Path  #: where it is
    variables: tuple[str, ...]  #: settings that were varied, without the seed
    constants: Choices  #: what was asked for of all runs alike
    cells: tuple[Cell, ...]  #: in the order of their values
    skipped: tuple[str, ...] = ()  #: what could not be read of it, with the reason, one line each

    @property
    def runs(self) -> list[Run]:
        """Every run that finished or failed, cell by cell."""
        return [run for cell in self.cells for run in cell.of("finished", "failed")]

    def measures(self) -> list[str]:
        """Returns those of which any run has a number."""
        return [name for name in MEASURES if any(cell.numbers(name) for cell in self.cells)]

    def label(self, measure: str) -> str:
        """Returns a measure's name with its unit; with both units where the runs are of both subsystems."""
        units = {run.unit for run in self.runs if run.unit}
        return MEASURES[measure][0].format(unit=" or ".join(sorted(units)) or "m")

    def base_settings(self) -> list[str]:
        """Returns the settings that all runs share, one ``key: value`` each."""
        first, *others = self.runs
        shared = (item for item in first.settings.items() if all(item in run.settings.items() for run in others))
        return [plain_text(f"{key}: {json.dumps(value)}") for key, value in shared]

    def commands(self) -> list[str]:
        """Returns the commands that fill the cells in which runs are missing or failed, one a cell.

        Skipped runs are not among them: a run is not flown over what lies in its folder.
        """
        commands = []
        for cell in self.cells:
            if seeds := cell.seeds("missing", "failed"):
                chosen = [*self.constants.items(), *zip(self.variables, cell.values, strict=True)]
                settings = _spelled({key: value for key, value in chosen if value != "default"})
                sweep = [f"{SEED}={','.join(seeds)}", f"folder={self.tree}"]
                commands.append(plain_text(shlex.join(["gpmpc", "run", "-m", *settings, *sweep])))
        return commands


def read_report(tree: str | Path) -> Report:
    """Reads every run below a folder and puts them together.

    Raises:
        DataError: There is no such folder, or no run in it that can be read.
    """
    tree = Path(tree)
    if not tree.is_dir():
        raise DataError(f"{tree}: no such folder")
    runs, plans, unread, skipped = [], [], set(), []
    results = {path.parent: path for name in (ERROR, METRICS) for path in sorted(tree.rglob(name))}
    for path in [*results.values(), *sorted(tree.rglob(f"{PLAN}*.json"))]:
        planned = path.name.startswith(PLAN)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if planned:
                plans += [_parsed(choices) for choices in content["runs"]]
            else:
                runs.append(_run(path, content))
        except _DAMAGE as error:
            lacking = f"it lacks {error}; of an older version?"
            reason = lacking if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
            skipped.append(plain_text(f"{path}: is not what a {'sweep' if planned else 'run'} writes: {reason}"))
            unread.add(path.parent.name)
    if not runs:
        raise DataError(skipped[0] if skipped else f"{tree}: holds no run, finished or failed")
    there = {frozenset(run.choices.items()) for run in runs}
    absent = [plan for plan in plans if frozenset(plan.items()) not in there]
    states = ["skipped" if folder_name(_spelled(plan)) in unread else "missing" for plan in absent]
    variables, constants, cells = _cells([*runs, *map(Run, absent, states)])
    return Report(tree, variables, constants, cells, tuple(skipped))


def _cells(runs: list[Run]) -> tuple[tuple[str, ...], Choices, tuple[Cell, ...]]:
    """Returns what was varied, what was not, and the runs by what was varied; a run that is there comes first."""
    keys = dict.fromkeys([*(key for run in runs for key in run.choices), SEED])
    # A run that did not choose had a setting; of one that is not there it is that of the others.
    usual = {
        key: next((_setting(run, key) for run in runs if run.settings and key not in run.choices), "") for key in keys
    }
    filled = [
        {key: run.choices.get(key) or _setting(run, key) or usual[key] or "default" for key in keys} for run in runs
    ]
    values = {key: {choices[key] for choices in filled} for key in keys if key != SEED}
    variables = tuple(sorted(key for key in values if len(values[key]) > 1))
    cells: dict[tuple[str, ...], dict[str, Run]] = {}
    for choices, run in sorted(zip(filled, runs, strict=True), key=lambda each: in_order(each[0][SEED])):
        cell = cells.setdefault(tuple(choices[key] for key in variables), {})
        if run.state == "finished" or choices[SEED] not in cell:
            cell[choices[SEED]] = run
    rows = sorted(cells, key=lambda row: [in_order(value) for value in row])
    single = {key: value for key, those in values.items() if len(those) == 1 for value in those if value != "default"}
    return variables, single, tuple(Cell(row, cells[row]) for row in rows)


def in_order(value: str) -> tuple[int, float, str]:
    """Returns a key that sorts numbers by their size, then words."""
    try:
        return 0, float(value), value
    except ValueError:
        return 1, 0.0, value


def _run(path: Path, content: Mapping[str, Any]) -> Run:
    """Returns a run that finished or failed, from its result."""
    choices, settings, origin = _parsed(content["choices"]), content["settings"], _origin(content)
    if not isinstance(settings, Mapping) or not isinstance(settings.get("options", {}), Mapping):
        raise TypeError("settings and their options are not by name")
    about: Any = {"folder": path.parent, "settings": flattened(settings), "origin": origin}
    if path.name == ERROR:
        return Run(choices, "failed", **about, error=plain_text(content["error"]))
    numbers, lost = {name: of(content) for name, (_, of) in MEASURES.items()}, content.get("lost")
    for name, value in numbers.items():
        if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
            raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    if lost:
        lost = plain_text(", ".join(f"{k} {v}" for k, v in lost.items()) if isinstance(lost, Mapping) else str(lost))
    return Run(choices, "finished", **about, numbers=numbers, unit=plain_text(content["unit"]), lost=lost or None)


def _origin(content: Mapping[str, Any]) -> dict[str, str]:
    """Returns date, commit and machine of a run, as far as it tells them."""
    about = content.get("provenance") or {}
    git, machine, versions = about.get("git") or {}, about.get("machine") or {}, about.get("versions") or {}
    commit = f"{git['commit'][:10]}{', changed' if git.get('dirty') else ''}" if git else versions.get("gpmpc")
    made = ", ".join(f"{value} cores" if key == "cores" else str(value) for key, value in machine.items())
    named = {"date": about.get("created"), "commit": commit, "machine": made}
    return {key: plain_text(str(value)) for key, value in named.items() if value}


def _parsed(choices: Any) -> Choices:
    """Returns choices, ``key=value`` each, by key."""
    if not isinstance(choices, list):
        raise TypeError(f"choices must be a list; got {choices!r:.80}")
    return {key: value for key, _, value in (plain_text(choice).partition("=") for choice in choices)}


def _spelled(choices: Choices) -> list[str]:
    return [f"{key}={value}" if value else key for key, value in choices.items()]


def _setting(run: Run, key: str) -> str:
    """Returns the value that a run had which did not choose; empty where its settings do not tell."""
    value = run.settings.get(f"options.{key}")
    value = run.settings.get(key, "") if value is None else value
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return plain_text(str(value)) if isinstance(value, int | float | str) else ""
