"""Shows a tree of runs: a row a cell, figures over what was varied, what failed and what is missing."""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gpmpc.plotting import Series, over_variable, png
from gpmpc.provenance import now
from gpmpc.studies._comparison import Comparison, compare, sentences
from gpmpc.studies._runs import MEASURES, Cell, Report, Run, in_order, read_report
from gpmpc.studies.document import MISSING, Document, Table, figure_label, plain_text, with_range
from gpmpc.studies.run_folder import LONGEST_NAME

__all__ = [
    "Cell",
    "Comparison",
    "Report",
    "Run",
    "compare",
    "notes",
    "read_report",
    "report_document",
    "sentences",
    "terminal_table",
]

_DRAWN = ("rmse", "failed", "decision")  # a figure each
_SHORT = {"rmse": "RMSE", "outside": "outside", "failed": "failed", "decision": "decision"}  # in a terminal
_PARTS = ("q25", "median", "q75")
_MOST_LINES = 8  # in a figure; what is varied besides is pooled
_LEGEND = "Median [first to third quartile] over the seeds. In figures, every run is a dot."


def report_document(
    report: Report,
    comparison: Sequence[str] = (),
    folder: Path | None = None,
    images: Mapping[str, bytes] | None = None,
) -> Document:
    """Returns everything that is written of a report; what is zero everywhere is left out of the LaTeX table.

    Args:
        report: All runs.
        comparison: Lines about two groups of them.
        folder: Where it goes, for the links to the runs; by default ``report`` in the tree.
        images: Figures by file name; by default they are drawn.
    """
    constants = ", ".join(f"{key}={value}" for key, value in report.constants.items())
    lists = {"Comparison": list(comparison), **notes(report), "Made": _made(report)}
    code = {"To fill the gaps": report.commands(), "Settings of all runs": report.base_settings()}
    start = (folder or report.tree / "report").resolve()
    return Document(
        plain_text(report.tree.resolve().name),
        [_table(report, report.measures())],
        _numbers(report),
        lead=f"{_counts(report)}." + (f" All of them: {constants}." if constants else ""),
        notes=[_LEGEND],
        lists={heading: items for heading, items in lists.items() if items},
        code={heading: lines for heading, lines in code.items() if lines},
        images=_figures(report) if images is None else images,
        links={
            plain_text(str(run.folder.relative_to(report.tree))): os.path.relpath(run.folder.resolve(), start)
            for run in report.runs
        },
        latex=[_table(report, _telling(report))],
    )


def _made(report: Report) -> list[str]:
    """Returns when, from which source and on which machines the runs were made."""

    def every(key: str) -> list[str]:
        return sorted({run.origin[key] for run in report.runs if key in run.origin})

    dates = " to ".join(dict.fromkeys([*every("date")[:1], *every("date")[-1:]]))
    shown = {"Runs made": dates, "Commit": "; ".join(every("commit")), "Machine": "; ".join(every("machine"))}
    shown |= {"Report made": now(), "Tree": str(report.tree.resolve())}
    return [f"{key}: {plain_text(value)}" for key, value in shown.items() if value]


def _counts(report: Report) -> str:
    """Returns how many runs there are, by how they ended."""
    finished, lost, failed, missing = (
        sum(len(getattr(cell, kind)) for cell in report.cells) for kind in ("runs", "lost", "failed", "missing")
    )
    text = f"{finished} finished in {len(report.cells)} cells, {failed} failed, {missing} missing"
    text += f", {len(report.skipped)} skipped" if report.skipped else ""
    return text + (f"; of those finished, {lost} lost" if lost else "")


def terminal_table(report: Report) -> Table:
    """Returns the table with short headers: median, and the quartiles below it; what is zero everywhere is left out."""
    shown = {name: short for name, short in _SHORT.items() if name in _telling(report)}
    units = (report.label(name).rpartition(" [")[2] for name in shown)
    header = [name.replace(".", ".\n") for name in report.variables or ("runs",)]
    header += ["seeds", *(f"{short}\n[{unit}" for short, unit in zip(shown.values(), units, strict=True))]
    return Table(header, _table(report, shown).rows, _counts(report))


def notes(report: Report) -> dict[str, list[str]]:
    """Returns what has to be known of single runs, by kind: their folders and the reasons."""
    found = {
        "Failed": [(run.folder.name, run.error) for cell in report.cells for run in cell.failed.values()],
        "Lost": [(run.folder.name, run.lost) for cell in report.cells for run in cell.lost],
    }
    each = {kind: [f"{plain_text(folder)}: {why}" for folder, why in runs] for kind, runs in found.items()}
    return {kind: lines for kind, lines in (each | {"Skipped": list(report.skipped)}).items() if lines}


def _table(report: Report, measures: Iterable[str]) -> Table:
    rows, header = [], [*(report.variables or ("runs",)), "seeds"]
    for cell in report.cells:
        named = {"lost": cell.lost, "failed": cell.failed, "missing": cell.missing, "skipped": cell.skipped}
        seeds = [str(len(cell.runs)), *(f"{len(group)} {word}" for word, group in named.items() if group)]
        quartiles = [_quartiles(cell.numbers(name)) for name in measures]
        texts = [MISSING if of is None else with_range(*of) for of in quartiles]
        rows.append([*(cell.values if report.variables else ("all",)), "\n".join(seeds), *texts])
    return Table([*header, *map(report.label, measures)], rows)


def _numbers(report: Report) -> pd.DataFrame:
    rows = []
    for cell in report.cells:
        row: dict[str, Any] = dict(zip(report.variables, cell.values, strict=True))
        for word in ("finished", "lost", "failed", "missing", "skipped"):
            row[word] = len(cell.runs if word == "finished" else getattr(cell, word))
        for measure in report.measures():
            names = [f"{measure}_{part} [{report.label(measure).rpartition(' [')[2]}" for part in _PARTS]
            row |= dict.fromkeys(names) | dict(zip(names, _quartiles(cell.numbers(measure)) or (), strict=False))
        rows.append(row)
    return pd.DataFrame(rows, dtype=object)


def _quartiles(values: Sequence[float]) -> list[float] | None:
    return np.quantile(values, [0.25, 0.5, 0.75]).tolist() if values else None


def _telling(report: Report) -> list[str]:
    """Returns the measures that are not zero everywhere."""
    return [name for name in report.measures() if any(any(cell.numbers(name)) for cell in report.cells)]


def _figures(report: Report) -> dict[str, bytes]:
    """Draws one figure (PNG) a varied setting and measure, by file name."""
    drawn: dict[str, bytes] = {}
    for index, variable in enumerate(report.variables):
        positions = sorted({cell.values[index] for cell in report.cells}, key=in_order)
        lines = _lines(report, index)
        for name in (name for name in _DRAWN if name in _telling(report)):
            series = []
            for label, cells in lines.items():
                at: dict[str, list[float]] = {position: [] for position in positions}
                for cell in cells:
                    at[cell.values[index]] += cell.numbers(name)
                series.append(Series(figure_label(label), [*at.values()]))
            title, label, *ticks = map(figure_label, (variable, report.label(name), *positions))
            figure = over_variable(title, ticks, label, series, MEASURES[name].logarithmic)
            file = re.sub(r"[^\w.+-]", "-", f"{name}-over-{variable}"[:LONGEST_NAME], flags=re.ASCII)
            drawn[f"{file}.png" if f"{file}.png" not in drawn else f"{file}-{index}.png"] = png(figure)
    return drawn


def _lines(report: Report, index: int) -> dict[str, list[Cell]]:
    """Groups cells by what else was varied; by one setting only where all together were too many lines."""
    others = [i for i in range(len(report.variables)) if i != index]
    distinct = {i: {cell.values[i] for cell in report.cells} for i in others}
    while len({tuple(cell.values[i] for i in others) for cell in report.cells}) > _MOST_LINES:
        others.remove(max(others, key=lambda i: len(distinct[i])))
    lines: dict[str, list[Cell]] = {}
    for cell in report.cells:
        label = ", ".join(f"{report.variables[i]}={cell.values[i]}" for i in others)
        lines.setdefault(label or "all", []).append(cell)
    return lines
