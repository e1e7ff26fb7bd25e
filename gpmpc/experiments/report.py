"""Problem: a tree of runs has to become one table: what was varied, what came of it, what failed and what is missing.

A *cell* is one combination of the varied settings; its runs differ in their seed. Missing is only what a sweep asked
for, in the plans that it leaves in the tree. Runs are read from their ``metrics.json`` and ``error.json`` alone. What
stands there may be damaged, or of any other origin: numbers are finite and texts are one printable line from here on,
and a run that cannot give them is skipped, with the reason.
"""

import json
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpmpc.exceptions import DataError
from gpmpc.experiments.escapes import in_plain_text
from gpmpc.experiments.run_folder import ERROR, METRICS, PLAN, folder_name

SEED = "seed"
WRONG = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError)  # of a file


@dataclass(frozen=True)
class Measure:
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


MEASURES = {
    "rmse": Measure("RMSE [{unit}]", lambda r: r["rmse"]["total"]),
    "outside": Measure("steps outside bounds [%]", lambda r: _outside(r), logarithmic=False),
    "failed": Measure("failed solves [%]", lambda r: 100 * sum(r["failures"].values()) / r["steps"], logarithmic=False),
    "decision": Measure("decision, median [ms]", lambda r: _times(1e3, r["times"]["total"]["median"]), wall_time=True),
    "training": Measure("training [s]", lambda r: r["times"]["training"], wall_time=True),
}


@dataclass(frozen=True)
class RunRecord:
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
    choices: Mapping[str, str]
    settings: Mapping[str, Any]
    numbers: Mapping[str, float | None]
    unit: str = ""
    lost: str | None = None
    error: str | None = None


@dataclass(frozen=True)
class Unread:
    """A run that cannot be read.

    Attributes:
        folder: Where it is.
        reason: Why it cannot, in one line.
    """

    folder: Path
    reason: str


@dataclass(frozen=True)
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
    runs: Mapping[str, RunRecord]
    failed: Mapping[str, RunRecord]
    missing: tuple[str, ...]
    skipped: tuple[str, ...] = ()

    def numbers(self, measure: str) -> list[float]:
        """One measure of all runs that have it, by seed."""
        return [value for run in self.runs.values() if (value := run.numbers[measure]) is not None]

    @property
    def lost(self) -> list[RunRecord]:
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
    constants: Mapping[str, str]
    cells: tuple[Cell, ...]
    skipped: tuple[str, ...] = ()

    def measures(self) -> list[str]:
        """Those of which any run has a number."""
        return [name for name in MEASURES if any(cell.numbers(name) for cell in self.cells)]

    def label(self, measure: str) -> str:
        """Of a measure, with its unit; with both where the runs are of both subsystems."""
        units = {run.unit for cell in self.cells for run in cell.runs.values()}
        return MEASURES[measure].label.format(unit=" or ".join(sorted(units)) or "m")

    def commands(self) -> list[str]:
        """What would fill the cells in which runs are missing or failed, one a cell.

        Those that were skipped are not among them: a run is not flown over what lies in its folder.
        """
        commands = []
        for cell in self.cells:
            seeds = sorted([*cell.missing, *cell.failed], key=in_order)
            if seeds:
                chosen = [*self.constants.items(), *zip(self.variables, cell.values, strict=True)]
                settings = _spelled({key: value for key, value in chosen if value != "default"})
                sweep = [f"{SEED}={','.join(seeds)}", f"folder={self.tree}"]
                commands.append(in_plain_text(shlex.join(["gpmpc", "run", "-m", *settings, *sweep])))
        return commands


def read_runs(tree: str | Path) -> tuple[list[RunRecord], list[Unread]]:
    """Every run below a folder, finished or failed, and what could not be read.

    Raises:
        DataError: There is no such folder, or no run in it that can be read.
    """
    tree = Path(tree)
    if not tree.is_dir():
        raise DataError(f"{tree}: no such folder")
    results = {path.parent: path for name in (ERROR, METRICS) for path in sorted(tree.rglob(name))}
    found, skipped = [], []
    for path in results.values():
        try:
            found.append(_read(path))
        except DataError as error:
            skipped.append(Unread(path.parent, str(error)))
    if not found:
        raise DataError(skipped[0].reason if skipped else f"{tree}: holds no run, finished or failed")
    return found, skipped


def report(tree: str | Path) -> Report:
    """Puts a tree together.

    Raises:
        DataError: As ``read_runs``.
    """
    tree = Path(tree)
    runs, skipped = read_runs(tree)
    asked, unplanned = _planned(tree)
    chosen = [*(run.choices for run in runs), *asked]
    keys = list(dict.fromkeys([*(key for choices in chosen for key in choices), SEED]))
    filled = [_filled(run.choices, keys, run.settings) for run in runs]
    there = {frozenset(run.choices.items()): choices for run, choices in zip(runs, filled, strict=True)}
    planned = [there.get(frozenset(choices.items())) or _as_others(choices, keys, runs) for choices in asked]
    values: dict[str, dict[str, None]] = {}
    for choices in [*filled, *planned]:
        for key, value in choices.items():
            values.setdefault(key, {})[value] = None
    varied = tuple(sorted(key for key, seen in values.items() if len(seen) > 1 and key != SEED))
    constants = {key: next(iter(seen)) for key, seen in values.items() if len(seen) == 1 and key != SEED}
    cells: dict[tuple[str, ...], tuple[dict, dict]] = {}
    for run, choices in zip(runs, filled, strict=True):
        kept = cells.setdefault(tuple(choices[key] for key in varied), ({}, {}))
        kept[run.error is not None][choices[SEED]] = run
    expected = {(tuple(choices[key] for key in varied), choices[SEED]) for choices in planned}
    named = {folder_name(_spelled(choices)): choices for choices in asked}
    unread = [_choices(each.folder, named) for each in skipped]
    unread = [_as_others(choices, keys, runs) for choices in unread if choices and set(choices) <= set(keys)]
    skipped_cells = {
        (tuple(choices[key] for key in varied), choices[SEED])
        for choices in unread
        if all(choices[key] == value for key, value in constants.items())
    }
    missing: dict[tuple[str, ...], list[str]] = {}
    unreadable: dict[tuple[str, ...], list[str]] = {}
    for key, seed in sorted(expected | skipped_cells, key=lambda each: in_order(each[1])):
        done, failed = cells.setdefault(key, ({}, {}))
        if seed not in done and seed not in failed:
            (unreadable if (key, seed) in skipped_cells else missing).setdefault(key, []).append(seed)
    in_rows = sorted(cells, key=lambda values: [in_order(value) for value in values])
    return Report(
        tree,
        varied,
        {key: value for key, value in constants.items() if value != "default"},
        tuple(
            Cell(key, *map(_by_seed, cells[key]), *(tuple(seeds.get(key, ())) for seeds in (missing, unreadable)))
            for key in in_rows
        ),
        (*(each.reason for each in skipped), *unplanned),
    )


def in_order(value: str) -> tuple[int, float, str]:
    """Numbers by their size, then words."""
    try:
        return 0, float(value), value
    except ValueError:
        return 1, 0.0, value


def _by_seed(runs: Mapping[str, RunRecord]) -> dict[str, RunRecord]:
    return {seed: runs[seed] for seed in sorted(runs, key=in_order)}


def _read(path: Path) -> RunRecord:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        asked = {"choices": _chosen(content["choices"]), "settings": content["settings"]}
        if not isinstance(asked["settings"], Mapping) or not isinstance(asked["settings"].get("options", {}), Mapping):
            raise TypeError("settings and their options are not by name")
        if path.name == ERROR:
            return RunRecord(path.parent, **asked, numbers={}, error=in_plain_text(content["error"]))
        numbers = {name: _number(name, content) for name in MEASURES}
        return RunRecord(
            path.parent, **asked, numbers=numbers, unit=in_plain_text(content["unit"]), lost=_lost(content)
        )
    except KeyError as reason:
        raise DataError(_skipping(path, f"it lacks {reason}; of an older version?")) from reason
    except WRONG as reason:
        raise DataError(_skipping(path, f"{type(reason).__name__}: {reason}")) from reason


def _number(name: str, content: Mapping[str, Any]) -> float | None:
    try:
        value = MEASURES[name].of(content)
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{name}: {error}") from error
    if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
        raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    return None if value is None else float(value)


def _lost(content: Mapping[str, Any]) -> str | None:
    """A flight's loss in words, whatever of it is stated."""
    lost = content.get("lost")
    if not lost:
        return None
    return in_plain_text(", ".join(f"{k} {v}" for k, v in lost.items()) if isinstance(lost, Mapping) else str(lost))


def _chosen(choices: Any) -> dict[str, str]:
    """Choices, ``key=value`` each, by key."""
    if not isinstance(choices, list):
        raise TypeError(f"choices must be a list; got {choices!r:.80}")
    return {key: value for key, _, value in (in_plain_text(choice).partition("=") for choice in choices)}


def _skipping(path: Path, reason: str) -> str:
    return in_plain_text(f"{path}: is not what a {'sweep' if path.name.startswith(PLAN) else 'run'} writes: {reason}")


def _planned(tree: Path) -> tuple[list[dict[str, str]], list[str]]:
    """What sweeps asked for, and which of their plans cannot be read."""
    planned, skipped = [], []
    for path in sorted(tree.rglob(f"{PLAN}*.json")):
        try:
            planned += [_chosen(choices) for choices in json.loads(path.read_text(encoding="utf-8"))["runs"]]
        except WRONG as error:
            skipped.append(_skipping(path, f"{type(error).__name__}: {error}"))
    return planned, skipped


def _choices(folder: Path, planned: Mapping[str, Mapping[str, str]]) -> Mapping[str, str]:
    """What was asked for of a run that cannot be read, by its folder's name; empty where that does not tell."""
    if folder.name in planned:
        return planned[folder.name]
    choices = {key: value for key, _, value in (choice.partition("=") for choice in folder.name.split(","))}
    return choices if folder_name(_spelled(choices)) == folder.name else {}


def _spelled(choices: Mapping[str, str]) -> list[str]:
    return [f"{key}={value}" if value else key for key, value in choices.items()]


def _filled(choices: Mapping[str, str], keys: Sequence[str], settings: Mapping[str, Any]) -> dict[str, str]:
    """Choices, and for what only others chose the settings that held all the same."""
    return {key: choices.get(key) or _setting(settings, key) for key in keys}


def _as_others(choices: Mapping[str, str], keys: Sequence[str], runs: Sequence[RunRecord]) -> dict[str, str]:
    """Choices of a run that is not there; for the rest, what the run most alike had that did not choose it either."""
    filled = {}
    for key in keys:
        others = [run for run in runs if key not in run.choices]
        alike = max(others, key=lambda run: len(choices.items() & run.choices.items()), default=None)
        filled[key] = choices.get(key) or ("default" if alike is None else _setting(alike.settings, key))
    return filled


def _setting(settings: Mapping[str, Any], key: str) -> str:
    """The value that a run had which did not choose; "default" where the settings do not tell."""
    option = settings.get("options", {}).get(key)
    if option is not None:
        return in_plain_text(str(option))
    value: Any = settings
    for part in key.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return "default"
        value = value[part]
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return in_plain_text(str(value)) if isinstance(value, int | float | str) else "default"


def _outside(result: Mapping[str, Any]) -> float | None:
    return max((100 * rate["rate"] for rate in result["violations"].values()), default=None)


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value
