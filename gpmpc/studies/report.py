"""Shows a tree of runs: a row per cell, figures over varied settings, missing runs.

Two groups of runs are compared seed by seed in ``_comparison``.
"""

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gpmpc._provenance import now
from gpmpc.plotting import Series, over_variable, png
from gpmpc.plotting._style import figure_label
from gpmpc.studies._comparison import Comparison, compare, sentences
from gpmpc.studies._document import (
    MISSING,
    Document,
    Table,
    least_width,
    plain_text,
    with_range,
)
from gpmpc.studies._run_folder import LONGEST_NAME, is_same
from gpmpc.studies._runs import (
    SEED,
    UNIT,
    Report,
    in_order,
    overrides_of,
    read_report,
)

__all__ = [
    "Comparison",
    "Report",
    "compare",
    "notes",
    "read_report",
    "report_document",
    "sentences",
    "terminal_table",
]

# Measures with a figure, and whether its axis may be logarithmic.
_FIGURES = {"rmse": True, "failed": False, "decision": True}
# Measures in a terminal, and what they are called there.
_SHORT_LABELS = {
    "rmse": "RMSE",
    "outside": "outside",
    "failed": "failed",
    "decision": "decision",
}
# What a value means, where a setting calls it otherwise.
_WORDS = {("data.size", "null"): "all"}
_QUARTILES = ("q25", "median", "q75")
_MOST_DIFFERENCES = 3  # that a note shows: settings, and values of each
_MOST_TERMINAL_ROWS = 500
_MOST_LINES = 8  # in a figure; what is varied besides is pooled
_LEGEND = (
    "Median [first to third quartile] over the seeds. In figures, every run is a dot."
)


def report_document(
    report: Report, comparison: Sequence[str] = (), folder: Path | None = None
) -> Document:
    """Returns everything that is written of a report.

    What is zero everywhere is left out of the LaTeX table.

    Args:
        report: All runs.
        comparison: Lines about two groups of them.
        folder: Where it goes, for the links to the runs; by default ``report`` in the
            tree.
    """
    folder = folder or report.tree / "report"
    return Document(
        title=plain_text(report.tree.resolve().name),
        tables=[_table(report, [*report.measures])],
        data=_numbers(report),
        lead=_lead(report),
        notes=[_LEGEND],
        lists={"Comparison": comparison, **notes(report), "Made": _origin(report)},
        code={
            "To fill the gaps": report.commands(),
            "Settings of all runs": report.base_settings(),
        },
        images=_figures(report),
        links=_links(report, folder.resolve()),
        latex=[_table(report, _measures_above_zero(report))],
    )


def terminal_table(report: Report, width: int | None = None) -> Table:
    """Returns the table with short headers: median, and the quartiles below it.

    What is zero everywhere is left out, and the end of a very long table. Where a
    column a setting is more than the width holds, one column says what was typed.

    Args:
        report: All runs.
        width: Of the terminal [characters]; by default as wide as the table is.
    """
    measures = [name for name in _measures_above_zero(report) if name in _SHORT_LABELS]
    header = [name.replace(".", ".\n") for name in _variables(report)]
    header.append("seeds")
    for name in measures:
        header.append(f"{_SHORT_LABELS[name]}\n[{_unit(report.measures[name])}")
    rows = _table(report, measures).rows
    title = _counts(report)
    if len(rows) > _MOST_TERMINAL_ROWS:
        title += f"; the first {_MOST_TERMINAL_ROWS} of {len(rows)} cells"
    table = Table(header, rows[:_MOST_TERMINAL_ROWS], title)
    if width is None or least_width(table) <= width or not report.variables:
        return table
    return _with_typed_choices(report, table)


def _with_typed_choices(report: Report, table: Table) -> Table:
    """Returns a table with one column of what was typed, where each setting had one.

    Of the settings the unit alone keeps its column.
    """
    typed = report.runs.groupby("cell").typed.first()
    width = len(report.variables)
    kept = [i for i, name in enumerate(report.variables) if name == UNIT]
    rows = []
    for cell, row in enumerate(table.rows):
        choices = plain_text(" ".join(typed[cell])) or "none"
        rows.append([choices, *(row[i] for i in kept), *row[width:]])
    header = ["choices", *(table.header[i] for i in kept), *table.header[width:]]
    return Table(header, rows, table.title)


def notes(report: Report) -> dict[str, list[str]]:
    """Returns what has to be known of runs, by kind: their folders and the reasons."""
    reasons: dict[str, list[str]] = {"Failed": [], "Lost": [], "Suspicious": []}
    for run in report.ended:
        folder = plain_text(run.folder.name)
        if run.error:
            reasons["Failed"].append(f"{folder}: {run.error}")
        if run.lost:
            reasons["Lost"].append(f"{folder}: {run.lost}")
        if run.suspicious:
            reasons["Suspicious"].append(f"{folder}: {run.suspicious}")
    reasons["Skipped"] = list(report.skipped)
    reasons["Repeated"] = list(report.repeated)
    reasons["Mixed settings"] = _mixed_settings(report)
    reasons["Mixed code"] = _mixed_code(report)
    return {kind: lines for kind, lines in reasons.items() if lines}


def _mixed_settings(report: Report) -> list[str]:
    """Returns a line where finished runs of one cell have different settings.

    Nobody typed the difference: files of settings, or of a model, are others.
    """
    runs_of_cells: dict[int, list[Any]] = {}
    for run in report.ended:
        if run.state == "finished" and run.settings:
            runs_of_cells.setdefault(run.cell, []).append(run)
    counts: dict[str, dict[str, int]] = {}  # by key and value
    for runs in runs_of_cells.values():
        for key in _differing_settings(runs):
            counts_of_key = counts.setdefault(key, {})
            for run in runs:
                value = json.dumps(run.settings.get(key))
                counts_of_key[value] = counts_of_key.get(value, 0) + 1
    if not counts:
        return []
    differences = []
    for key in [*counts][:_MOST_DIFFERENCES]:
        by_value = [f"{value} of {count}" for value, count in counts[key].items()]
        shown = by_value[:_MOST_DIFFERENCES]
        if len(by_value) > len(shown):
            shown.append(f"{len(by_value) - len(shown)} more")
        differences.append(f"{key} ({', '.join(shown)})")
    if len(counts) > len(differences):
        differences.append(f"{len(counts) - len(differences)} more settings")
    line = (
        "runs of one cell differ in what nobody chose on the command line, and their "
        f"median is of different studies: {'; '.join(differences)}"
    )
    return [plain_text(line)]


def _differing_settings(runs: Sequence[Any]) -> dict[str, None]:
    """Returns the settings in which runs differ, but for what follows from the seed."""
    first, *others = runs
    differing: dict[str, None] = {}
    for run in others:
        keys = dict.fromkeys([*first.settings, *run.settings])
        if run.settings.base is first.settings.base:
            keys = first.settings.changes | run.settings.changes
        for key in keys:
            if key != SEED and _differ(first, run, key):
                differing[key] = None
    return differing


def _differ(run: Any, other: Any, key: str) -> bool:
    """Whether two runs have other values of a setting, and not by their seeds alone."""
    # A setting that is absent is null, as where a sweep compares two runs.
    value = run.settings.get(key)
    other_value = other.settings.get(key)
    if is_same(value, other_value):
        return False
    return not is_same(
        _without_seed(value, run.seed), _without_seed(other_value, other.seed)
    )


def _without_seed(value: Any, seed: str) -> Any:
    """Returns a value with a mark where it is the seed, or names it."""
    if isinstance(value, list):
        return [_without_seed(element, seed) for element in value]
    if isinstance(value, str):
        return re.sub(rf"(?<!\d){re.escape(seed)}(?!\d)", MISSING, value)
    return MISSING if str(value) == seed else value


def _mixed_code(report: Report) -> list[str]:
    """Returns a line where the finished runs were flown by different code."""
    counts: dict[str, int] = {}
    commits: dict[str, str] = {}
    dates: dict[str, str] = {}
    for run in report.ended:
        if run.state != "finished":
            continue
        counts[run.code] = counts.get(run.code, 0) + 1
        commits[run.code] = run.origin.get("commit", "of unknown version")
        dates[run.code] = max(dates.get(run.code, ""), run.origin.get("date", ""))
    if len(counts) < 2:
        return []
    counts_by_code = [
        f"{counts[code]} of {commits[code]} (last {dates[code][:10] or MISSING})"
        for code in sorted(counts, key=lambda code: dates[code])
    ]
    line = "the finished runs are of different code, and may differ for that alone: "
    return [line + "; ".join(counts_by_code)]


def _lead(report: Report) -> str:
    """Returns how many runs there are and what all of them have in common."""
    lead = f"{_counts(report)}."
    if report.constants:
        choices = overrides_of(report.constants)
        lead += f" All of them: {', '.join(choices)}."
    return lead


def _origin(report: Report) -> list[str]:
    """Returns when, from which source and on which machines the runs were made."""
    dates = _origins(report, "date")
    first_and_last = dict.fromkeys([*dates[:1], *dates[-1:]])
    facts = {
        "Runs made": " to ".join(first_and_last),
        "Commit": "; ".join(_origins(report, "commit")),
        "Machine": "; ".join(_origins(report, "machine")),
        "Report made": now(),
        "Tree": str(report.tree.resolve()),
    }
    return [f"{key}: {plain_text(value)}" for key, value in facts.items() if value]


def _origins(report: Report, key: str) -> list[str]:
    """Returns what the runs tell of their origin under a key, each once and sorted."""
    return sorted({run.origin[key] for run in report.ended if key in run.origin})


def _links(report: Report, folder: Path) -> dict[str, str]:
    """Returns the runs as seen from ``folder``, by their name in the tree."""
    parents = {run.folder.parent for run in report.ended}
    relative = {each: os.path.relpath(each.resolve(), folder) for each in parents}
    return {
        plain_text(str(run.folder.relative_to(report.tree))): os.path.join(
            relative[run.folder.parent], run.folder.name
        )
        for run in report.ended
    }


def _states(report: Report) -> pd.DataFrame:
    """Counts the runs of every cell by how they ended.

    Columns are finished, lost, suspicious, failed, missing and skipped; lost and
    suspicious runs are finished ones.
    """
    runs = report.runs
    counts = pd.crosstab(runs.cell, runs.state).reindex(
        columns=["finished", "failed", "missing", "skipped"], fill_value=0
    )
    lost_runs = (runs.lost != "").groupby(runs.cell).sum()
    suspicious = (runs.suspicious != "").groupby(runs.cell).sum()
    counts.insert(1, "lost", lost_runs)
    counts.insert(2, "suspicious", suspicious)
    return counts


def _counts(report: Report) -> str:
    """Returns how many runs there are, by how they ended."""
    count = _states(report).sum()
    text = (
        f"{count.finished} finished in {len(report.cells)} cells, "
        f"{count.failed} failed, {count.missing} missing"
    )
    if report.skipped:
        text += f", {len(report.skipped)} skipped"
    judged = []
    if count.lost:
        judged.append(f"{count.lost} lost")
    if count.suspicious:
        judged.append(f"{count.suspicious} suspicious")
    if judged:
        text += f"; of those finished, {', '.join(judged)}"
    return text


def _quartiles(report: Report, measures: Sequence[str]) -> np.ndarray:
    """Returns first quartile, median and third (cells, measures, 3) over the seeds.

    NaN where no run has a number.
    """
    quartiles = np.full((len(report.cells), len(measures), 3), np.nan)
    for j, name in enumerate(measures):
        values = report.runs[name].dropna()
        cells = report.runs.cell[values.index].to_numpy()
        order = np.argsort(cells, kind="stable")
        sorted_values = values.to_numpy()[order]
        cells, starts, counts = np.unique(
            cells[order], return_index=True, return_counts=True
        )
        for count in np.unique(counts):  # cells with as many numbers are one array
            of_count = counts == count
            rows = starts[of_count, np.newaxis] + np.arange(count)
            quartiles[cells[of_count], j] = np.quantile(
                sorted_values[rows], [0.25, 0.5, 0.75], axis=1
            ).T
    return quartiles


def _table(report: Report, measures: Sequence[str]) -> Table:
    """Returns a row a cell: values of the variables, seeds, quartiles of measures."""
    counts = _states(report).to_dict("records")
    quartiles = _quartiles(report, measures)
    rows = []
    for cell, values in enumerate(report.cells):
        numbers = [
            MISSING if np.isnan(of_measure).any() else with_range(*of_measure)
            for of_measure in quartiles[cell]
        ]
        shown = _shown(report, values) or ("all",)
        rows.append([*shown, _seeds(counts[cell]), *numbers])
    labels = [report.measures[name] for name in measures]
    return Table([*_variables(report), "seeds", *labels], rows)


def _shown(report: Report, values: Sequence[Any]) -> tuple[str, ...]:
    """Returns the values of a cell's variables in words: no size means all rows."""
    pairs = zip(report.variables, values, strict=True)
    return tuple(_word(name, str(value)) for name, value in pairs)


def _word(name: str, value: str) -> str:
    """Returns the value of a setting as a reader calls it."""
    if name.startswith("~") and not value:
        return "left out"
    return _WORDS.get((name, value), value)


def _variables(report: Report) -> tuple[str, ...]:
    """Returns the headers of the columns that say what was varied."""
    return report.variables or ("runs",)


def _seeds(counts: dict) -> str:
    """Returns how many runs of a cell finished, and below it how many of each kind."""
    lines = [str(counts["finished"])]
    for state, count in counts.items():
        if state != "finished" and count:
            lines.append(f"{count} {state}")
    return "\n".join(lines)


def _numbers(report: Report) -> pd.DataFrame:
    """Returns the table as numbers, a row a cell; None where there is none."""
    variables = pd.DataFrame(report.cells, columns=[*report.variables], dtype=object)
    names = [
        f"{name}_{quartile} [{_unit(label)}"
        for name, label in report.measures.items()
        for quartile in _QUARTILES
    ]
    values = _quartiles(report, [*report.measures]).reshape(len(report.cells), -1)
    quartiles = pd.DataFrame(values, columns=names)
    table = pd.concat([variables, _states(report), quartiles], axis=1).astype(object)
    return table.where(table.notna(), None)


def _unit(label: str) -> str:
    """Returns the unit of a measure's label with its closing bracket."""
    return label.rpartition(" [")[2]


def _measures_above_zero(report: Report) -> list[str]:
    """Returns the measures that are not zero everywhere."""
    return [name for name in report.measures if report.runs[name].max() > 0]


def _figures(report: Report) -> dict[str, bytes]:
    """Draws one figure (PNG) a varied setting and measure, by file name."""
    figures: dict[str, bytes] = {}
    measures = [name for name in _measures_above_zero(report) if name in _FIGURES]
    for index, variable in enumerate(report.variables):
        if variable == UNIT:
            continue
        for measure in measures:
            name = f"{measure}-over-{variable}"[:LONGEST_NAME]
            stem = re.sub(r"[^\w.+-]", "-", name, flags=re.ASCII)
            if f"{stem}.png" in figures:
                stem = f"{stem}-{index}"
            figures[f"{stem}.png"] = _figure(report, index, measure)
    return figures


def _figure(report: Report, index: int, measure: str) -> bytes:
    """Draws a measure over the variable of an index."""
    positions = sorted({cell[index] for cell in report.cells}, key=in_order)
    values = report.runs[measure].dropna()
    values_of_cell = values.groupby(report.runs.cell[values.index]).apply(list)
    series = []
    for label, cells_of_line in _lines(report, index).items():
        by_position: dict[str, list[float]] = {position: [] for position in positions}
        for cell in cells_of_line:
            by_position[report.cells[cell][index]] += values_of_cell.get(cell, [])
        series.append(Series(figure_label(label), [*by_position.values()]))
    figure = over_variable(
        figure_label(report.variables[index]),
        [
            figure_label(_word(report.variables[index], position))
            for position in positions
        ],
        figure_label(report.measures[measure]),
        series,
        _FIGURES[measure],
    )
    return png(figure)


def _lines(report: Report, index: int) -> dict[str, list[int]]:
    """Groups cells by what was varied besides the variable of an index.

    Where these are too many lines, the settings with the most values are pooled, but
    never errors of different units.

    Returns:
        Positions of the cells of each line, by its label.
    """
    others = [i for i in range(len(report.variables)) if i != index]
    while _count_values(report, others) > _MOST_LINES:
        settings = [i for i in others if report.variables[i] != UNIT]
        others.remove(max(settings, key=lambda i: _count_values(report, [i])))
    lines: dict[str, list[int]] = {}
    for cell, values in enumerate(report.cells):
        shown = _shown(report, values)
        label = ", ".join(f"{report.variables[i]}={shown[i]}" for i in others)
        lines.setdefault(label or "all", []).append(cell)
    return lines


def _count_values(report: Report, variables: Sequence[int]) -> int:
    """Returns how many combinations of values some variables have."""
    return len({tuple(cell[i] for i in variables) for cell in report.cells})
