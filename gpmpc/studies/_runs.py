"""Reads a tree of runs: what was varied, the results, what failed or is missing.

A *cell* is one combination of the varied settings; its runs differ in their seed.
Missing is only what a sweep asked for, in the plans that it leaves in the tree. Runs
are read from their ``metrics.json`` and ``error.json`` alone. Those may be damaged, or
of any other origin: numbers are finite and texts are one printable line from here on,
and a run that cannot give them is skipped, with the reason.
"""

import json
import os
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from gpmpc._files import folders_below
from gpmpc.exceptions import DataError
from gpmpc.studies._document import plain_text
from gpmpc.studies._index import RunIndex
from gpmpc.studies._run_folder import (
    ERROR,
    METRICS,
    PLAN_PREFIX,
    folder_name,
    folder_override,
)
from gpmpc.studies._run_record import (
    MEASURES,
    READ_ERRORS,
    Choices,
    RunRecord,
    checked_options,
    parsed,
    plain_value,
)

SEED = "seed"
UNIT = "unit"  # the variable that keeps errors of different units apart
_UNKNOWN = "unknown"  # unit of a run without a result, where no other tells
_SYSTEM = "system"  # the one group whose files set what is outside of the group
_DEFAULT = "default"  # value of a setting that nobody chose and no run tells


@dataclass(frozen=True)
class Report:
    """A tree of runs.

    ``runs`` has a row for every run that is there or was asked for, cell by cell and
    seed by seed. Its columns are

    - ``cell``, the position in ``cells``, and ``seed``, a text; ``names_seed``, whether
      the run chose it;
    - ``state``: "finished", "failed", "missing" (there is nothing of it) or "skipped"
      (it cannot be read);
    - the measures, NaN where the run has none;
    - ``lost``, ``suspicious`` (at its end) and ``error``: since when and why;
    - ``folder``, and ``sweep``, which it is in, or would be; ``unit`` of the errors;
      ``settings`` by dotted key;
    - ``origin``: date, commit and machine; ``code``: names the code that made it, ""
      where there is none or it does not tell;
    - ``search_options``: those of the command by which its settings were found;
      ``typed``, its own choices as they were typed, but for the seed.

    Where errors are in several units, ``unit`` is a variable, too.
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
    #: runs that others with the same choices and seed stand for, a line for each pair
    #: of folders and what became of them
    repeated: tuple[str, ...] = ()

    @cached_property
    def ended(self) -> list[Any]:
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
        """Returns the settings that all runs share, one ``key: value`` each.

        Runs whose process could not say what they were do not count.
        """
        settings_of_runs = [run.settings for run in self.ended if run.settings]
        if not settings_of_runs:
            return []
        first, *others = settings_of_runs
        shared = dict(first)
        for settings in others:
            keys = [*shared]
            if settings.base is first.base:
                keys = [*first.changes, *settings.changes]
            for key in keys:
                if key in shared and (key, shared[key]) not in settings.items():
                    del shared[key]
        return [plain_text(f"{key}: {json.dumps(shared[key])}") for key in shared]

    def commands(self) -> list[str]:
        """Returns the commands that fly what is missing or failed, one a cell.

        Each run flies as it was typed, into the folder that it is in, or was asked for
        in: what it left alone is as its settings have it, which its cell need not know.
        There are more of a cell whose runs are of several folders, whose settings were
        found or typed in several ways, or where some runs name their seed and some have
        the usual one. Skipped runs are not among them: a run is not flown over what
        lies in its folder.
        """
        to_fly = self.runs[self.runs.state.isin(("missing", "failed"))]
        commands = []
        groups = to_fly.groupby(
            ["cell", "sweep", "search_options", "typed", "names_seed"]
        )
        for (_, sweep, options, overrides, names_seed), runs in groups:
            words = self._varied_last(overrides)
            command = ["gpmpc", "run", "-m", *shlex.split(options), *words]
            # Only where all of them name it is the column the seeds that were typed.
            if names_seed:
                command.append(f"{SEED}={','.join(runs.seed)}")
            command.append(folder_override(sweep))
            commands.append(plain_text(shlex.join(command)))
        return commands

    def _varied_last(self, overrides: Sequence[str]) -> Sequence[str]:
        """Returns overrides with what all runs share first, unless their order counts.

        They are sorted where it does not.
        """
        if [*overrides] != sorted(overrides):
            return overrides
        return sorted(
            overrides,
            key=lambda word: word.partition("=")[0].lstrip("+") in self.variables,
        )


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


@dataclass
class _Files:
    """The files of a tree: runs, plans, and what cannot be read."""

    runs: list[RunRecord] = field(default_factory=list)
    planned: list[RunRecord] = field(default_factory=list)  # as if all were missing
    skipped: list[str] = field(default_factory=list)  # with the reason, a line each
    unread_folders: set[Path] = field(default_factory=set)


def _read_files(tree: Path) -> _Files:
    """Reads the results and the plans below a folder.

    What an index has is not read again; what it lacks is added.
    """
    files = _Files()
    indices: dict[Path, RunIndex] = {}  # by the folder that runs are in
    paths = _Paths.below(tree)
    for path in paths.results:
        runs = path.parent.parent
        if runs not in indices:
            indices[runs] = RunIndex(runs)
        try:
            files.runs.append(indices[runs].record(path))
        except READ_ERRORS as error:
            files.skipped.append(_why_skipped(path, "run", error))
            files.unread_folders.add(path.parent)
    for index in indices.values():
        index.write()
    for path in paths.plans:
        try:
            files.planned += _planned_runs(_read_json(path), path.parent)
        except READ_ERRORS as error:
            files.skipped.append(_why_skipped(path, "sweep", error))
            files.unread_folders.add(path.parent)
    return files


@dataclass
class _Paths:
    """Where the files of a tree are."""

    results: list[Path]
    plans: list[Path]

    @classmethod
    def below(cls, tree: Path) -> "_Paths":
        """Looks for them; the metrics of a run stand for an older error."""
        results: dict[str, list[str]] = {ERROR: [], METRICS: []}  # folders
        plans: list[Path] = []
        for folder, files in folders_below(tree):
            for name, folders in results.items():
                if name in files:
                    folders.append(folder)
            plans += [
                Path(folder, file)
                for file in files
                if file.startswith(PLAN_PREFIX) and file.endswith(".json")
            ]
        names: dict[str, str] = {}  # of the result, by folder
        for name, folders in results.items():
            folders.sort(key=lambda folder: folder.split(os.sep))
            names |= dict.fromkeys(folders, name)
        return cls(
            [Path(folder, name) for folder, name in names.items()], sorted(plans)
        )


def _planned_runs(plan: Any, folder: Path) -> list[RunRecord]:
    """Returns the runs that a sweep asked for, from the content of its plan."""
    options = checked_options(plan.get("search_options", ""))
    return [
        RunRecord(parsed(choices), "missing", search_options=options, planned_in=folder)
        for choices in plan["runs"]
    ]


def _read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _why_skipped(path: Path, writer: str, error: Exception) -> str:
    reason = f"{type(error).__name__}: {error}"
    if isinstance(error, KeyError):
        reason = f"it lacks {error}; of an older version?"
    return plain_text(f"{path}: is not what a {writer} writes: {reason}")


def _not_there(files: _Files) -> list[RunRecord]:
    """Returns the runs that were planned and are missing or cannot be read.

    A run of another folder with the same choices is another run.
    """
    present = {(run.sweep, _name_of(run.choices)) for run in files.runs}
    absent = []
    for run in files.planned:
        name = _name_of(run.choices)
        assert run.sweep is not None
        if run.sweep / name in files.unread_folders:
            run = replace(run, state="skipped")
        if (run.sweep, name) not in present:
            absent.append(run)
    return absent


def _name_of(choices: Choices) -> str:
    """Returns the name of the folder of a run; other choices have another one."""
    return folder_name(overrides_of(choices))


def _put_together(
    tree: Path, runs: Sequence[RunRecord], skipped: Sequence[str]
) -> Report:
    """Finds what was varied, and sorts the runs by cell and seed.

    Of the runs ``controller=lqr seed=3`` and ``seed=3``, the second one with the
    settings' own controller, convex: ``controller`` is the variable, ("convex",) and
    ("lqr",) are the cells, and the place of each run is seed "3" of its cell.
    """
    all_choices = _with_units(_completed_choices(runs), runs)
    values = _values_by_setting(all_choices)
    variables = tuple(sorted(key for key in values if len(values[key]) > 1))
    constants: Choices = {}
    for key in values:
        if key not in variables:
            (constants[key],) = values[key]
    places = [
        _Place(tuple(choices[key] for key in variables), choices[SEED])
        for choices in all_choices
    ]
    by_place: dict[_Place, RunRecord] = {}
    for place, run in zip(places, runs, strict=True):
        if run.state == "finished" or place not in by_place:
            by_place[place] = run
    cells = tuple(sorted({place.cell for place in by_place}, key=_values_in_order))
    return Report(
        tree=tree,
        variables=variables,
        constants={k: v for k, v in constants.items() if v != _DEFAULT},
        cells=cells,
        runs=_table_of(by_place, cells),
        skipped=tuple(skipped),
        repeated=tuple(_repeated(runs, [by_place[place] for place in places])),
    )


def _repeated(
    runs: Iterable[RunRecord], runs_of_report: Iterable[RunRecord]
) -> Iterator[str]:
    """Yields how many runs of a folder are left out, and what is shown for them.

    Those that cannot be read are named elsewhere.

    Args:
        runs: All that were read or planned.
        runs_of_report: Of each of them the run that the report has at its place.
    """
    counts: Counter[tuple[str, Path, Path]] = Counter()
    for run, shown in zip(runs, runs_of_report, strict=True):
        # Two sweeps of one folder may have planned the same missing run.
        is_same_gap = run.state != "finished" and run.sweep == shown.sweep
        if run is shown or run.state == "skipped" or is_same_gap:
            continue
        assert run.sweep is not None
        assert shown.sweep is not None
        counts[run.state, run.sweep, shown.sweep] += 1
    for (state, folder, shown_folder), count in counts.items():
        others = "others there"
        advice = ""
        if folder != shown_folder:
            others = f"runs of {shown_folder}"
        if not shown_folder.is_relative_to(folder):
            advice = f"; gpmpc report {folder} shows them"
        yield plain_text(
            f"{count} {state} in {folder}: {others} have the same choices and seeds, "
            f"and are shown{advice}"
        )


class _Place(NamedTuple):
    """Where a run stands in a report."""

    #: values of the variables
    cell: tuple[str, ...]
    seed: str


def _values_by_setting(all_choices: Iterable[Choices]) -> dict[str, set[str]]:
    """Returns the values that runs chose of each setting but the seed."""
    values: dict[str, set[str]] = {}
    for choices in all_choices:
        for key, value in choices.items():
            values.setdefault(key, set()).add(value)
    del values[SEED]
    return values


def _table_of(
    by_place: Mapping[_Place, RunRecord], cells: Sequence[tuple[str, ...]]
) -> pd.DataFrame:
    """Returns a row for every run, cell by cell and seed by seed."""
    position = {cell: i for i, cell in enumerate(cells)}
    places = sorted(
        by_place, key=lambda place: (position[place.cell], in_order(place.seed))
    )
    columns: dict[str, list[Any]] = {}
    for place in places:
        row = by_place[place].row()
        row["cell"] = position[place.cell]
        row["seed"] = place.seed
        typed = dict(by_place[place].choices)
        row["names_seed"] = typed.pop(SEED, None) is not None
        row["typed"] = (*overrides_of(typed),)
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    types = dict.fromkeys(MEASURES, float) | {"cell": int}
    return pd.DataFrame(columns, dtype=object).astype(types)


def _completed_choices(runs: Sequence[RunRecord]) -> list[Choices]:
    """Returns the value of every run for each setting that any run chose, and the seed.

    It is what the run chose, or else what its own settings have. A run without a file
    takes that of the first run that left the setting alone, where it must have the
    same. One value has one spelling, however it was typed.
    """
    all_chosen = [
        {key.lstrip("+"): _chosen_value(run, key) for key in run.choices}
        for run in runs
    ]
    keys = dict.fromkeys([*(key for chosen in all_chosen for key in chosen), SEED])
    usual: dict[tuple[str, ...], str] = {}
    for run, chosen in zip(runs, all_chosen, strict=True):
        if run.settings:
            for key in keys:
                if key not in chosen:
                    usual.setdefault(_decides(key, run), run.setting(key))
    completed = []
    for run, chosen in zip(runs, all_chosen, strict=True):
        others = {
            key: run.setting(key) or usual.get(_decides(key, run)) or _DEFAULT
            for key in keys
            if key not in chosen
        }
        completed.append(chosen | others if others else chosen)
    return completed


def _chosen_value(run: RunRecord, key: str) -> str:
    """Returns what a run chose, as the report names it."""
    text = run.choices[key]
    if "${" in text:  # refers to other settings
        return run.setting(key.lstrip("+")) or text
    return plain_value(text)


def _decides(key: str, run: RunRecord) -> tuple[str, ...]:
    """Returns what decides which value a setting has that a run left alone.

    The files that its command found, its system's, which sets others, and that of the
    group which the setting is in.
    """
    group = key.partition(".")[0]
    choices = run.choices
    return key, run.search_options, choices.get(_SYSTEM, ""), choices.get(group, "")


def _with_units(
    all_choices: Sequence[Choices], runs: Sequence[RunRecord]
) -> list[Choices]:
    """Makes the unit of the errors a choice where there are several.

    So no number is made of errors in two of them. A run without a result has that of
    the others of its cell.
    """
    if len({run.unit for run in runs} - {""}) < 2:
        return [*all_choices]
    cells = [
        frozenset(item for item in choices.items() if item[0] != SEED)
        for choices in all_choices
    ]
    units: dict[frozenset[tuple[str, str]], set[str]] = {}
    for cell, run in zip(cells, runs, strict=True):
        if run.unit:
            units.setdefault(cell, set()).add(run.unit)
    with_units = []
    for choices, cell, run in zip(all_choices, cells, runs, strict=True):
        unit = run.unit
        units_of_cell = units.get(cell, set())
        if not unit and len(units_of_cell) == 1:
            (unit,) = units_of_cell
        with_units.append(choices | {UNIT: unit or _UNKNOWN})
    return with_units


def in_order(value: str) -> tuple[int, float, str]:
    """Returns a key that sorts numbers by their size, then words."""
    try:
        return 0, float(value), value
    except ValueError:
        return 1, 0.0, value


def _values_in_order(values: Sequence[str]) -> list[tuple[int, float, str]]:
    return [in_order(value) for value in values]


def overrides_of(choices: Choices) -> list[str]:
    """Returns choices by key as ``key=value`` each, or ``~key`` of a deletion."""
    return [
        key if key.startswith("~") else f"{key}={value}"
        for key, value in choices.items()
    ]
