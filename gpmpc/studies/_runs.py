"""Reads a tree of runs: what was varied, the results, what failed or is missing.

A *cell* is one combination of the varied settings; its runs differ in their seed.
Missing is only what a sweep asked for, in the plans that it leaves in the tree. Runs
are read from their ``metrics.json`` and ``error.json`` alone. Those may be damaged, or
of any other origin: numbers are finite and texts are one printable line from here on,
and a run that cannot give them is skipped, with the reason.
"""

import json
import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from gpmpc._provenance import flattened
from gpmpc.exceptions import DataError
from gpmpc.studies._document import plain_text
from gpmpc.studies._run_folder import ERROR, METRICS, PLAN, describe_code, folder_name

SEED = "seed"
_DEFAULT = "default"  # value of a setting that nobody chose and no run tells
# Whatever the content of a damaged file may raise.
_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)

Choices = dict[str, str]
Result = Mapping[str, Any]  # content of metrics.json or error.json


class Measure(NamedTuple):
    """A number that runs are tabulated by."""

    #: with its unit; {unit} stands for that of the runs' positions or angles
    label: str
    #: takes it from the result of a run; None where the run has none
    of: Callable[[Result], float | None]


def _outside(result: Result) -> float | None:
    """Returns the steps outside the constraint that was broken most often [%]."""
    rates = [100 * violation["rate"] for violation in result["violations"].values()]
    return max(rates, default=None)


MEASURES: dict[str, Measure] = {
    "rmse": Measure("RMSE [{unit}]", lambda result: result["rmse"]["total"]),
    "outside": Measure("steps outside bounds [%]", _outside),
    "failed": Measure(
        "failed solves [%]",
        lambda result: 100 * sum(result["failures"].values()) / result["steps"],
    ),
    "decision": Measure(
        "decision, median [ms]",
        lambda result: 1e3 * result["times"]["total"]["median"],
    ),
    "training": Measure("training [s]", lambda result: result["times"]["training"]),
}


@dataclass(frozen=True)
class Report:
    """A tree of runs.

    ``runs`` has a row for every run that is there or was asked for, cell by cell and
    seed by seed. Its columns are

    - ``cell``, the position in ``cells``, and ``seed``, a text;
    - ``state``: "finished", "failed", "missing" (there is nothing of it) or "skipped"
      (it cannot be read);
    - the measures, NaN where the run has none;
    - ``lost``, ``suspicious`` (at its end) and ``error``: since when and why;
    - ``folder``; ``unit`` of the errors; ``settings`` by dotted key;
    - ``origin``: date, commit and machine; ``code``: names the code that made it, ""
      where there is none or it does not tell.
    """

    #: where it is
    tree: Path
    #: settings that were varied, without the seed
    variables: tuple[str, ...]
    #: what was asked for of all runs alike
    constants: Choices
    #: values of the variables, in order
    cells: tuple[tuple[str, ...], ...]
    #: see above
    runs: pd.DataFrame
    #: what could not be read of it, with the reason, one line each
    skipped: tuple[str, ...] = ()

    @cached_property
    def there(self) -> list[Any]:
        """Every run that finished or failed; columns are attributes."""
        return [*self.runs[self.runs.folder.notna()].itertuples()]

    @cached_property
    def measures(self) -> dict[str, str]:
        """Labels of the measures that any run has.

        They hold both units where runs are of both subsystems.
        """
        has_number = self.runs[[*MEASURES]].notna().any()
        unit = " or ".join(sorted({*self.runs.unit} - {""})) or "m"
        return {
            name: measure.label.format(unit=unit)
            for name, measure in MEASURES.items()
            if has_number[name]
        }

    def base_settings(self) -> list[str]:
        """Returns the settings that all runs share, one ``key: value`` each."""
        first, *others = self.there
        shared = [
            (key, value)
            for key, value in first.settings.items()
            if all((key, value) in run.settings.items() for run in others)
        ]
        return [plain_text(f"{key}: {json.dumps(value)}") for key, value in shared]

    def commands(self) -> list[str]:
        """Returns the commands that fly what is missing or failed, one a cell.

        Skipped runs are not among them: a run is not flown over what lies in its
        folder.
        """
        to_fly = self.runs[self.runs.state.isin(("missing", "failed"))]
        commands = []
        for cell, runs in to_fly.groupby("cell"):
            varied = dict(zip(self.variables, self.cells[cell], strict=True))
            choices = {
                key: value
                for key, value in (self.constants | varied).items()
                if value != _DEFAULT
            }
            words = ["gpmpc", "run", "-m", *_overrides(choices)]
            words += [f"{SEED}={','.join(runs.seed)}", f"folder={self.tree}"]
            commands.append(plain_text(shlex.join(words)))
        return commands


def read_report(tree: str | Path) -> Report:
    """Reads every run below a folder and puts them together.

    Raises:
        DataError: There is no such folder, or no run in it that can be read.
    """
    tree = Path(tree)
    if not tree.is_dir():
        raise DataError(f"{tree}: no such folder")
    files = _read_files(tree)
    if not files.runs:
        if files.skipped:
            raise DataError(files.skipped[0])
        raise DataError(f"{tree}: holds no run, finished or failed")
    return _put_together(tree, [*files.runs, *_not_there(files)], files.skipped)


@dataclass(frozen=True)
class _Run:
    """One run, there or not; see ``Report``."""

    choices: Choices
    state: str
    folder: Path | None = None
    unit: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    origin: Mapping[str, str] = field(default_factory=dict)
    code: str = ""
    lost: str = ""
    suspicious: str = ""
    error: str = ""
    measures: Mapping[str, float | None] = field(default_factory=dict)

    def setting(self, key: str) -> str:
        """Returns the value of a setting that was not chosen; empty if unknown."""
        value = self.settings.get(f"options.{key}")
        if value is None:
            value = self.settings.get(key, "")
        if isinstance(value, bool) or value is None:
            return json.dumps(value)
        if isinstance(value, int | float | str):
            return plain_text(str(value))
        return ""

    def row(self) -> dict[str, Any]:
        """Returns its columns in ``Report.runs`` but for cell and seed."""
        columns = dict(vars(self))
        del columns["choices"], columns["measures"]
        return columns | {name: self.measures.get(name) for name in MEASURES}


@dataclass
class _Files:
    """The files of a tree: runs, plans, and what cannot be read."""

    runs: list[_Run] = field(default_factory=list)
    plans: list[Choices] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)  # with the reason, a line each
    unread_folders: set[str] = field(default_factory=set)  # names


def _read_files(tree: Path) -> _Files:
    """Reads the results and the plans below a folder."""
    files = _Files()
    result_paths: dict[Path, Path] = {}  # by folder; metrics stand for an older error
    for name in (ERROR, METRICS):
        result_paths |= {path.parent: path for path in sorted(tree.rglob(name))}
    for path in result_paths.values():
        try:
            content = _read_json(path)
            files.runs.append(_read_run(path, content))
        except _DAMAGE as error:
            files.skipped.append(_why_skipped(path, "run", error))
            files.unread_folders.add(path.parent.name)
    for path in sorted(tree.rglob(f"{PLAN}*.json")):
        try:
            planned_runs = _read_json(path)["runs"]
            files.plans += [_parsed(choices) for choices in planned_runs]
        except _DAMAGE as error:
            files.skipped.append(_why_skipped(path, "sweep", error))
            files.unread_folders.add(path.parent.name)
    return files


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _why_skipped(path: Path, writer: str, error: Exception) -> str:
    reason = f"{type(error).__name__}: {error}"
    if isinstance(error, KeyError):
        reason = f"it lacks {error}; of an older version?"
    return plain_text(f"{path}: is not what a {writer} writes: {reason}")


def _not_there(files: _Files) -> list[_Run]:
    """Returns the runs that were planned and are missing or cannot be read."""
    there = {frozenset(run.choices.items()) for run in files.runs}
    absent = []
    for choices in files.plans:
        if frozenset(choices.items()) in there:
            continue
        name = folder_name(_overrides(choices))
        state = "skipped" if name in files.unread_folders else "missing"
        absent.append(_Run(choices, state))
    return absent


def _put_together(tree: Path, runs: Sequence[_Run], skipped: Sequence[str]) -> Report:
    """Finds what was varied, and sorts the runs by cell and seed."""
    all_choices = _completed_choices(runs)
    values: dict[str, set[str]] = {}
    for choices in all_choices:
        for key, value in choices.items():
            values.setdefault(key, set()).add(value)
    del values[SEED]
    variables = tuple(sorted(key for key in values if len(values[key]) > 1))
    constants: Choices = {}
    for key in values:
        if len(values[key]) == 1:
            (constants[key],) = values[key]
    constants = {key: value for key, value in constants.items() if value != _DEFAULT}

    by_place: dict[tuple[tuple[str, ...], str], _Run] = {}
    for choices, run in zip(all_choices, runs, strict=True):
        cell = tuple(choices[key] for key in variables)
        place = (cell, choices[SEED])
        if run.state == "finished" or place not in by_place:
            by_place[place] = run
    cells = tuple(sorted({cell for cell, _ in by_place}, key=_values_in_order))
    position = {cell: i for i, cell in enumerate(cells)}
    places = sorted(
        by_place, key=lambda place: (position[place[0]], in_order(place[1]))
    )
    rows = [
        by_place[cell, seed].row() | {"cell": position[cell], "seed": seed}
        for cell, seed in places
    ]
    types = dict.fromkeys(MEASURES, float) | {"cell": int}
    return Report(
        tree=tree,
        variables=variables,
        constants=constants,
        cells=cells,
        runs=pd.DataFrame(rows, dtype=object).astype(types),
        skipped=tuple(skipped),
    )


def _completed_choices(runs: Sequence[_Run]) -> list[Choices]:
    """Returns the choices of every run, with a value for each key that any run chose.

    A run that did not choose has its setting; one that is not there has that of the
    first other run that did not choose.
    """
    keys = dict.fromkeys([*(key for run in runs for key in run.choices), SEED])
    usual = {key: _usual_setting(runs, key) for key in keys}
    return [
        {
            key: run.choices.get(key) or run.setting(key) or usual[key] or _DEFAULT
            for key in keys
        }
        for run in runs
    ]


def _usual_setting(runs: Iterable[_Run], key: str) -> str:
    """Returns the setting of the first run that is there and did not choose."""
    for run in runs:
        if run.settings and key not in run.choices:
            return run.setting(key)
    return ""


def in_order(value: str) -> tuple[int, float, str]:
    """Returns a key that sorts numbers by their size, then words."""
    try:
        return 0, float(value), value
    except ValueError:
        return 1, 0.0, value


def _values_in_order(values: Sequence[str]) -> list[tuple[int, float, str]]:
    return [in_order(value) for value in values]


def _read_run(path: Path, content: Result) -> _Run:
    """Returns a run that finished or failed, from the content of its file."""
    choices = _parsed(content["choices"])
    settings = content["settings"]
    options = settings.get("options", {}) if isinstance(settings, Mapping) else None
    if not isinstance(options, Mapping):
        raise TypeError("settings and their options are not by name")
    origin = _origin(content)
    code = _code(content)
    if path.name == ERROR:
        return _Run(
            choices=choices,
            state="failed",
            folder=path.parent,
            settings=flattened(settings),
            origin=origin,
            code=code,
            error=plain_text(content["error"]),
        )
    measures = {name: measure.of(content) for name, measure in MEASURES.items()}
    for name, value in measures.items():
        if value is not None and not _is_finite_number(value):
            raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    lost = _loss(content)
    return _Run(
        choices=choices,
        state="finished",
        folder=path.parent,
        unit=plain_text(content["unit"]),
        settings=flattened(settings),
        origin=origin,
        code=code,
        lost=lost,
        suspicious="" if lost else _suspicion(content),
        measures=measures,
    )


def _is_finite_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _loss(content: Result) -> str:
    """Returns since when and why a run was lost; empty where it was not."""
    lost = content.get("lost") or ""
    if isinstance(lost, Mapping):
        lost = ", ".join(f"{key} {value}" for key, value in lost.items())
    return plain_text(str(lost))


def _suspicion(content: Result) -> str:
    """Returns since when and why a run was suspicious at its end, as it tells."""
    judgement = content.get("judgement") or {}
    if judgement.get("level") != "suspicious":
        return ""
    text = f"step {judgement.get('step')}, reason {judgement.get('reason')}"
    return plain_text(text)


def _origin(content: Result) -> dict[str, str]:
    """Returns date, commit and machine of a run, as far as it tells them."""
    provenance = content.get("provenance") or {}
    git = provenance.get("git") or {}
    if git:
        commit = git["commit"][:10]
        if git.get("dirty"):
            commit += ", changed"
    else:
        commit = (provenance.get("versions") or {}).get("gpmpc")
    machine = [
        f"{value} cores" if key == "cores" else str(value)
        for key, value in (provenance.get("machine") or {}).items()
    ]
    origin = {
        "date": provenance.get("created"),
        "commit": commit,
        "machine": ", ".join(machine),
    }
    return {key: plain_text(str(value)) for key, value in origin.items() if value}


def _code(content: Result) -> str:
    """Returns a text that differs where the code of two runs differs.

    Older runs tell only their commit or version.
    """
    provenance = content.get("provenance") or {}
    of_gpmpc = provenance.get("code") or describe_code(provenance)
    of_user = provenance.get("own_code") or {}
    return plain_text(json.dumps([of_gpmpc, of_user], sort_keys=True))


def _parsed(choices: Any) -> Choices:
    """Returns choices, ``key=value`` each, by key."""
    if not isinstance(choices, list):
        raise TypeError(f"choices must be a list; got {choices!r:.80}")
    parsed = {}
    for choice in choices:
        key, _, value = plain_text(choice).partition("=")
        parsed[key] = value
    return parsed


def _overrides(choices: Choices) -> list[str]:
    """Returns choices by key as ``key=value`` each."""
    return [f"{key}={value}" if value else key for key, value in choices.items()]
