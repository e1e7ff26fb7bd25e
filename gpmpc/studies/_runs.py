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

from gpmpc._provenance import flattened
from gpmpc.exceptions import DataError
from gpmpc.studies._document import plain_text
from gpmpc.studies._run_folder import ERROR, METRICS, PLAN, folder_name

SEED = "seed"
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError)  # of a file

Choices = dict[str, str]


class _Measure(NamedTuple):
    """One number of a run."""

    label: str  #: with its unit; ``{unit}`` stands for that of the runs' positions or angles
    of: Callable[[Mapping[str, Any]], float | None]  #: from a run's result to the number; None where the run has none
    logarithmic: bool = True  #: how it is drawn
    wall_time: bool = False  #: whether it depends on what else the machine did meanwhile


MEASURES = {
    "rmse": _Measure("RMSE [{unit}]", lambda r: r["rmse"]["total"]),
    "outside": _Measure(
        "steps outside bounds [%]",
        lambda r: max((100 * v["rate"] for v in r["violations"].values()), default=None),
        False,
    ),
    "failed": _Measure("failed solves [%]", lambda r: 100 * sum(r["failures"].values()) / r["steps"], False),
    "decision": _Measure("decision, median [ms]", lambda r: 1e3 * r["times"]["total"]["median"], wall_time=True),
    "training": _Measure("training [s]", lambda r: r["times"]["training"], wall_time=True),
}


@dataclass(frozen=True)
class Run:
    """One run of a tree."""

    folder: Path  #: where it is
    choices: Choices  #: what was asked for, by key
    settings: Mapping[str, Any]  #: all of them, by dotted key
    numbers: Mapping[str, float | None] = field(default_factory=dict)  #: by measure; empty where the run failed
    unit: str = ""  #: of its errors
    lost: str | None = None  #: since when and why the flight was lost; None where it was not
    error: str | None = None  #: why the run failed; None where it did not
    #: what made it: "date", "commit" and "machine", where it says so
    origin: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Cell:
    """All runs of one combination."""

    values: tuple[str, ...]  #: of the varied settings, in the order of ``Report.variables``
    runs: dict[str, Run] = field(default_factory=dict)  #: those that finished, by seed
    failed: dict[str, Run] = field(default_factory=dict)  #: those that failed, by seed
    missing: tuple[str, ...] = ()  #: seeds asked for of which there is nothing
    skipped: tuple[str, ...] = ()  #: seeds asked for of which there is something that cannot be read

    def numbers(self, measure: str) -> list[float]:
        """Returns one measure of all runs that have it, by seed."""
        return [value for run in self.runs.values() if (value := run.numbers[measure]) is not None]

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
        return [run for cell in self.cells for run in (*cell.runs.values(), *cell.failed.values())]

    def measures(self) -> list[str]:
        """Returns those of which any run has a number."""
        return [name for name in MEASURES if any(cell.numbers(name) for cell in self.cells)]

    def label(self, measure: str) -> str:
        """Returns a measure's name with its unit; with both units where the runs are of both subsystems."""
        units = {run.unit for cell in self.cells for run in cell.runs.values()}
        return MEASURES[measure].label.format(unit=" or ".join(sorted(units)) or "m")

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
            if seeds := sorted([*cell.missing, *cell.failed], key=in_order):
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
    runs, plans, unread, skipped = _read(tree)
    keys = list(dict.fromkeys([*(key for chosen in [*(run.choices for run in runs), *plans] for key in chosen), SEED]))
    filled = [{key: run.choices.get(key) or _setting(run.settings, key) for key in keys} for run in runs]
    found = {frozenset(run.choices.items()): choices for run, choices in zip(runs, filled, strict=True)}
    planned = [found.get(frozenset(plan.items())) or _as_others(plan, keys, runs) for plan in plans]
    values = {key: {choices[key] for choices in [*filled, *planned]} for key in keys if key != SEED}
    varied = tuple(sorted(key for key in values if len(values[key]) > 1))
    cells: dict[tuple[str, ...], Cell] = {}
    names = [folder_name(_spelled(plan)) for plan in plans]
    kinds = ["skipped" if name in unread else "missing" for name in names]
    flown = [(choices, run, "") for choices, run in zip(filled, runs, strict=True)]
    asked = [(choices, None, kind) for choices, kind in zip(planned, kinds, strict=True)]
    for choices, run, kind in sorted([*flown, *asked], key=lambda each: in_order(each[0][SEED])):
        where, seed = tuple(choices[key] for key in varied), choices[SEED]
        cell = cells.setdefault(where, Cell(where))
        if run is not None:
            (cell.runs if run.error is None else cell.failed)[seed] = run
        elif seed not in (*cell.runs, *cell.failed, *cell.skipped, *cell.missing):  # runs of a seed come before plans
            setattr(cell, kind, (*getattr(cell, kind), seed))
    rows = sorted(cells, key=lambda values: [in_order(value) for value in values])
    single = {key: value for key, those in values.items() if len(those) == 1 for value in those if value != "default"}
    return Report(tree, varied, single, tuple(cells[row] for row in rows), tuple(skipped))


def in_order(value: str) -> tuple[int, float, str]:
    """Returns a key that sorts numbers by their size, then words."""
    try:
        return 0, float(value), value
    except ValueError:
        return 1, 0.0, value


def _read(tree: Path) -> tuple[list[Run], list[Choices], set[str], list[str]]:
    """Returns every run, finished or failed, what sweeps asked for, names of unread folders, and the reasons."""
    if not tree.is_dir():
        raise DataError(f"{tree}: no such folder")
    results = {path.parent: path for name in (ERROR, METRICS) for path in sorted(tree.rglob(name))}
    runs, plans, unread, skipped = [], [], set(), []
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
    return runs, plans, unread, skipped


def _run(path: Path, content: Mapping[str, Any]) -> Run:
    choices, settings, origin = _parsed(content["choices"]), content["settings"], _origin(content)
    if not isinstance(settings, Mapping) or not isinstance(settings.get("options", {}), Mapping):
        raise TypeError("settings and their options are not by name")
    settings = flattened(settings)
    if path.name == ERROR:
        return Run(path.parent, choices, settings, error=plain_text(content["error"]), origin=origin)
    numbers, lost = {name: _number(name, content) for name in MEASURES}, content.get("lost")
    if lost:
        lost = plain_text(", ".join(f"{k} {v}" for k, v in lost.items()) if isinstance(lost, Mapping) else str(lost))
    return Run(path.parent, choices, settings, numbers, plain_text(content["unit"]), lost or None, origin=origin)


def _number(name: str, content: Mapping[str, Any]) -> float | None:
    try:
        value = MEASURES[name].of(content)
    except (TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{name}: {error}") from error
    if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
        raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    return None if value is None else float(value)


def _origin(content: Mapping[str, Any]) -> dict[str, str]:
    """Returns date, commit and machine of a run, as far as it tells them."""
    about = content.get("provenance") or {}
    git, machine, versions = about.get("git") or {}, about.get("machine") or {}, about.get("versions") or {}
    commit = f"{git['commit'][:10]}{', changed' if git.get('dirty') else ''}" if git else versions.get("gpmpc")
    named = {"date": about.get("created"), "commit": commit}
    named["machine"] = ", ".join(f"{value} cores" if key == "cores" else str(value) for key, value in machine.items())
    return {key: plain_text(str(value)) for key, value in named.items() if value}


def _parsed(choices: Any) -> Choices:
    """Returns choices, ``key=value`` each, by key."""
    if not isinstance(choices, list):
        raise TypeError(f"choices must be a list; got {choices!r:.80}")
    return {key: value for key, _, value in (plain_text(choice).partition("=") for choice in choices)}


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
    value = settings.get(f"options.{key}")
    value = settings.get(key, "default") if value is None else value
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return plain_text(str(value)) if isinstance(value, int | float | str) else "default"
