"""Puts a tree of runs together: what was varied, the results, what failed and what is missing.

A *cell* is one combination of the varied settings; its runs differ in their seed. Missing is only what a sweep asked
for, in the plans that it leaves in the tree. Runs are read from their ``metrics.json`` and ``error.json`` alone. Those
may be damaged, or of any other origin: numbers are finite and texts are one printable line from here on, and a run that
cannot give them is skipped, with the reason.
"""

import json
import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from gpmpc.exceptions import DataError
from gpmpc.studies.document import plain_text
from gpmpc.studies.run_folder import ERROR, METRICS, PLAN, folder_name

SEED = "seed"
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError)  # of a file

Choices = dict[str, str]


class Measure(NamedTuple):
    """One number of a run.

    Attributes:
        label: With its unit; ``{unit}`` stands for that of the runs' positions or angles.
        of: From a run's result to the number; None where the run has none.
        logarithmic: How it is drawn.
        wall_time: Whether it depends on what else the machine did meanwhile.
    """

    label: str
    of: Callable[[Mapping[str, Any]], float | None]
    logarithmic: bool = True
    wall_time: bool = False


def _outside(result: Mapping[str, Any]) -> float | None:
    return max((100 * rate["rate"] for rate in result["violations"].values()), default=None)


def _decision(result: Mapping[str, Any]) -> float | None:
    median = result["times"]["total"]["median"]
    return None if median is None else 1e3 * median


MEASURES = {
    "rmse": Measure("RMSE [{unit}]", lambda r: r["rmse"]["total"]),
    "outside": Measure("steps outside bounds [%]", _outside, logarithmic=False),
    "failed": Measure("failed solves [%]", lambda r: 100 * sum(r["failures"].values()) / r["steps"], logarithmic=False),
    "decision": Measure("decision, median [ms]", _decision, wall_time=True),
    "training": Measure("training [s]", lambda r: r["times"]["training"], wall_time=True),
}


@dataclass(frozen=True)
class Run:
    """One run of a tree.

    Attributes:
        folder: Where it is.
        choices: What was asked for, by key.
        settings: All of them.
        numbers: By measure; empty where the run failed.
        unit: Of its errors.
        lost: Since when and why the flight was lost; None where it was not.
        error: Why the run failed; None where it did not.
    """

    folder: Path
    choices: Choices
    settings: Mapping[str, Any]
    numbers: Mapping[str, float | None] = field(default_factory=dict)
    unit: str = ""
    lost: str | None = None
    error: str | None = None


@dataclass
class Cell:
    """All runs of one combination.

    Attributes:
        values: Of the varied settings, in the order of ``Report.variables``.
        runs: Those that finished, by seed.
        failed: Those that failed, by seed.
        missing: Seeds asked for of which there is nothing.
        skipped: Seeds of which there is something that cannot be read.
    """

    values: tuple[str, ...]
    runs: dict[str, Run] = field(default_factory=dict)
    failed: dict[str, Run] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()

    def numbers(self, measure: str) -> list[float]:
        """Returns one measure of all runs that have it, by seed."""
        return [value for run in self.runs.values() if (value := run.numbers[measure]) is not None]

    @property
    def lost(self) -> list[Run]:
        """Runs that finished, and whose flight was lost."""
        return [run for run in self.runs.values() if run.lost is not None]


@dataclass(frozen=True)
class Report:
    """A tree of runs.

    Attributes:
        tree: Where it is.
        variables: Settings that were varied, without the seed.
        constants: What was asked for of all runs alike.
        cells: In the order of their values.
        skipped: What could not be read of it, with the reason, one line each.
    """

    tree: Path
    variables: tuple[str, ...]
    constants: Choices
    cells: tuple[Cell, ...]
    skipped: tuple[str, ...] = ()

    def measures(self) -> list[str]:
        """Returns those of which any run has a number."""
        return [name for name in MEASURES if any(cell.numbers(name) for cell in self.cells)]

    def label(self, measure: str) -> str:
        """Returns a measure's name with its unit; with both units where the runs are of both subsystems."""
        units = {run.unit for cell in self.cells for run in cell.runs.values()}
        return MEASURES[measure].label.format(unit=" or ".join(sorted(units)) or "m")

    def commands(self) -> list[str]:
        """Returns the commands that fill the cells in which runs are missing or failed, one a cell.

        Skipped runs are not among them: a run is not flown over what lies in its folder.
        """
        commands = []
        for cell in self.cells:
            seeds = sorted([*cell.missing, *cell.failed], key=in_order)
            if seeds:
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
    runs, unread, skipped = _read_runs(tree)
    plans, unread_plans = _read_plans(tree)
    keys = list(dict.fromkeys([*(key for chosen in [*(run.choices for run in runs), *plans] for key in chosen), SEED]))
    filled = [{key: run.choices.get(key) or _setting(run.settings, key) for key in keys} for run in runs]
    found = {frozenset(run.choices.items()): choices for run, choices in zip(runs, filled, strict=True)}
    planned = [found.get(frozenset(plan.items())) or _as_others(plan, keys, runs) for plan in plans]
    values = {key: set() for key in keys}
    for key, value in (item for choices in [*filled, *planned] for item in choices.items()):
        values[key].add(value)
    varied = tuple(sorted(key for key in keys if len(values[key]) > 1 and key != SEED))
    constants = {key: next(iter(values[key])) for key in keys if len(values[key]) == 1 and key != SEED}

    def place(choices: Choices) -> tuple[tuple[str, ...], str]:
        return tuple(choices[key] for key in varied), choices[SEED]

    cells: dict[tuple[str, ...], Cell] = {}
    for run, choices in zip(runs, filled, strict=True):
        where, seed = place(choices)
        cell = cells.setdefault(where, Cell(where))
        (cell.runs if run.error is None else cell.failed)[seed] = run
    by_name = {folder_name(_spelled(plan)): plan for plan in plans}
    named = [_choices_of(folder, by_name) for folder in unread]
    damaged = [_as_others(choices, keys, runs) for choices in named if choices and set(choices) <= set(keys)]
    damaged = [choices for choices in damaged if constants.items() <= choices.items()]
    for attribute, those in (("skipped", damaged), ("missing", planned)):
        for where, seed in sorted(set(map(place, those)), key=lambda place: in_order(place[1])):
            cell = cells.setdefault(where, Cell(where))
            if seed not in (*cell.runs, *cell.failed, *cell.skipped):
                setattr(cell, attribute, (*getattr(cell, attribute), seed))
    for cell in cells.values():
        cell.runs, cell.failed = ({s: of[s] for s in sorted(of, key=in_order)} for of in (cell.runs, cell.failed))
    rows = sorted(cells, key=lambda values: [in_order(value) for value in values])
    constants = {key: value for key, value in constants.items() if value != "default"}
    return Report(tree, varied, constants, tuple(cells[row] for row in rows), (*skipped, *unread_plans))


def in_order(value: str) -> tuple[int, float, str]:
    """Returns a key that sorts numbers by their size, then words."""
    try:
        return 0, float(value), value
    except ValueError:
        return 1, 0.0, value


def _read_runs(tree: Path) -> tuple[list[Run], list[Path], list[str]]:
    """Returns every run, finished or failed; the folders of those that cannot be read, and the reasons."""
    if not tree.is_dir():
        raise DataError(f"{tree}: no such folder")
    results = {path.parent: path for name in (ERROR, METRICS) for path in sorted(tree.rglob(name))}
    runs, unread, skipped = [], [], []
    for path in results.values():
        try:
            runs.append(_read_run(path))
        except _DAMAGE as error:
            lacking = f"it lacks {error}; of an older version?"
            reason = lacking if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
            skipped.append(_skipping(path, reason))
            unread.append(path.parent)
    if not runs:
        raise DataError(skipped[0] if skipped else f"{tree}: holds no run, finished or failed")
    return runs, unread, skipped


def _read_run(path: Path) -> Run:
    content = json.loads(path.read_text(encoding="utf-8"))
    choices, settings = _parsed(content["choices"]), content["settings"]
    if not isinstance(settings, Mapping) or not isinstance(settings.get("options", {}), Mapping):
        raise TypeError("settings and their options are not by name")
    if path.name == ERROR:
        return Run(path.parent, choices, settings, error=plain_text(content["error"]))
    numbers, lost = {name: _number(name, content) for name in MEASURES}, content.get("lost")
    if lost:
        lost = plain_text(", ".join(f"{k} {v}" for k, v in lost.items()) if isinstance(lost, Mapping) else str(lost))
    return Run(path.parent, choices, settings, numbers, plain_text(content["unit"]), lost or None)


def _number(name: str, content: Mapping[str, Any]) -> float | None:
    try:
        value = MEASURES[name].of(content)
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{name}: {error}") from error
    if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
        raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    return None if value is None else float(value)


def _parsed(choices: Any) -> Choices:
    """Returns choices, ``key=value`` each, by key."""
    if not isinstance(choices, list):
        raise TypeError(f"choices must be a list; got {choices!r:.80}")
    return {key: value for key, _, value in (plain_text(choice).partition("=") for choice in choices)}


def _skipping(path: Path, reason: str) -> str:
    return plain_text(f"{path}: is not what a {'sweep' if path.name.startswith(PLAN) else 'run'} writes: {reason}")


def _read_plans(tree: Path) -> tuple[list[Choices], list[str]]:
    """Returns what sweeps asked for, and which of their plans cannot be read."""
    planned, skipped = [], []
    for path in sorted(tree.rglob(f"{PLAN}*.json")):
        try:
            planned += [_parsed(choices) for choices in json.loads(path.read_text(encoding="utf-8"))["runs"]]
        except _DAMAGE as error:
            skipped.append(_skipping(path, f"{type(error).__name__}: {error}"))
    return planned, skipped


def _choices_of(folder: Path, planned: Mapping[str, Choices]) -> Choices:
    """Returns what was asked for of a run that cannot be read, by its folder's name; empty where that does not tell."""
    if folder.name in planned:
        return planned[folder.name]
    choices = {key: value for key, _, value in (choice.partition("=") for choice in folder.name.split(","))}
    return choices if folder_name(_spelled(choices)) == folder.name else {}


def _spelled(choices: Choices) -> list[str]:
    return [f"{key}={value}" if value else key for key, value in choices.items()]


def _as_others(choices: Choices, keys: Iterable[str], runs: Sequence[Run]) -> Choices:
    """Fills up the choices of a run that is not there from the most alike run that did not choose a key either."""
    filled = {}
    for key in keys:
        others = [run for run in runs if key not in run.choices]
        alike = max(others, key=lambda run: len(choices.items() & run.choices.items()), default=None)
        filled[key] = choices.get(key) or ("default" if alike is None else _setting(alike.settings, key))
    return filled


def _setting(settings: Mapping[str, Any], key: str) -> str:
    """Returns the value that a run had which did not choose; "default" where the settings do not tell."""
    value = settings.get("options", {}).get(key)
    if value is None:
        value = settings
        for part in key.split("."):
            if not isinstance(value, Mapping) or part not in value:
                return "default"
            value = value[part]
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return plain_text(str(value)) if isinstance(value, int | float | str) else "default"
