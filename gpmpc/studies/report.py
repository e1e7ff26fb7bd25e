"""Shows a tree of runs: a row a cell, figures over what was varied, what failed or is missing, whether two differ.

Two groups of runs are compared seed by seed: runs of one seed share their training rows and their noise. What else was
varied is averaged within a seed first, so that a seed counts once, and over the same for every seed. The signed-rank
test (Wilcoxon, 1945) decides, which asks only that the differences are spread symmetrically; Student's t-test beside it
asks for normal ones. Wall times are not compared: one group is flown after the other, and what the machine did
meanwhile is no property of either.
"""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from gpmpc._provenance import now
from gpmpc.exceptions import DataError, SettingError
from gpmpc.plotting import Series, over_variable, png
from gpmpc.studies._document import MISSING, Document, Table, figure_label, plain_text, with_range
from gpmpc.studies._run_folder import LONGEST_NAME
from gpmpc.studies._runs import SEED, STATES, Cell, Report, in_order, read_report

__all__ = ["Comparison", "Report", "compare", "notes", "read_report", "report_document", "sentences", "terminal_table"]

_DRAWN = {"rmse": True, "failed": False, "decision": True}  # a figure each, and whether it may be logarithmic
_WALL_TIMES = ("decision", "training")
_SHORT = {"rmse": "RMSE", "outside": "outside", "failed": "failed", "decision": "decision"}  # in a terminal
_MOST_LINES = 8  # in a figure; what is varied besides is pooled
_LEGEND = "Median [first to third quartile] over the seeds. In figures, every run is a dot."
_LEVEL = 0.05
_FEWEST = 6  # pairs; with n of them the smallest two-sided p-value of the signed-rank test is 2^(1 - n)


def report_document(report: Report, comparison: Sequence[str] = (), folder: Path | None = None) -> Document:
    """Returns everything that is written of a report; what is zero everywhere is left out of the LaTeX table.

    Args:
        report: All runs.
        comparison: Lines about two groups of them.
        folder: Where it goes, for the links to the runs; by default ``report`` in the tree.
    """
    constants = ", ".join(f"{key}={value}" for key, value in report.constants.items())
    start = (folder or report.tree / "report").resolve()
    return Document(
        plain_text(report.tree.resolve().name),
        [_table(report, report.measures())],
        _numbers(report),
        lead=f"{_counts(report)}." + (f" All of them: {constants}." if constants else ""),
        notes=[_LEGEND],
        lists={"Comparison": comparison, **notes(report), "Made": _made(report)},
        code={"To fill the gaps": report.commands(), "Settings of all runs": report.base_settings()},
        images=_figures(report),
        links={
            plain_text(str(run.folder.relative_to(report.tree))): os.path.relpath(run.folder.resolve(), start)
            for run in report.runs
        },
        latex=[_table(report, _telling(report))],
    )


def _made(report: Report) -> list[str]:
    """Returns when, from which source and on which machines the runs were made."""
    made = {
        key: sorted({run.origin[key] for run in report.runs if key in run.origin})
        for key in ("date", "commit", "machine")
    }
    dates = " to ".join(dict.fromkeys([*made["date"][:1], *made["date"][-1:]]))
    shown = {"Runs made": dates, "Commit": "; ".join(made["commit"]), "Machine": "; ".join(made["machine"])}
    shown |= {"Report made": now(), "Tree": str(report.tree.resolve())}
    return [f"{key}: {plain_text(value)}" for key, value in shown.items() if value]


def _counts(report: Report) -> str:
    """Returns how many runs there are, by how they ended."""
    finished, failed, missing = (sum(len(cell.of(state)) for cell in report.cells) for state in STATES[:3])
    lost = sum(len(cell.lost) for cell in report.cells)
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
    failed, lost = (
        [run for run in report.runs if run.state == "failed"],
        [run for cell in report.cells for run in cell.lost],
    )
    found = {
        "Failed": [f"{plain_text(run.folder.name)}: {run.error}" for run in failed],
        "Lost": [f"{plain_text(run.folder.name)}: {run.lost}" for run in lost],
        "Skipped": list(report.skipped),
    }
    return {kind: lines for kind, lines in found.items() if lines}


def _table(report: Report, measures: Iterable[str]) -> Table:
    rows, header = [], [*(report.variables or ("runs",)), "seeds"]
    for cell in report.cells:
        counts = {"lost": cell.lost} | {state: cell.of(state) for state in STATES[1:]}
        seeds = [str(len(cell.of("finished"))), *(f"{len(runs)} {word}" for word, runs in counts.items() if runs)]
        quartiles = [_quartiles(cell.numbers(name)) for name in measures]
        texts = [with_range(*of) if of else MISSING for of in quartiles]
        rows.append([*(cell.values or ("all",)), "\n".join(seeds), *texts])
    return Table([*header, *map(report.label, measures)], rows)


def _numbers(report: Report) -> pd.DataFrame:
    rows = []
    for cell in report.cells:
        counts = {state: len(cell.of(state)) for state in STATES}
        row: dict[str, Any] = dict(zip(report.variables, cell.values, strict=True))
        row |= {"finished": counts.pop("finished"), "lost": len(cell.lost)} | counts
        for measure in report.measures():
            unit = report.label(measure).rpartition(" [")[2]
            quartiles = _quartiles(cell.numbers(measure)) or [None] * 3
            row |= {f"{measure}_{part} [{unit}": q for part, q in zip(("q25", "median", "q75"), quartiles, strict=True)}
        rows.append(row)
    return pd.DataFrame(rows, dtype=object)


def _quartiles(values: Sequence[float]) -> list[float]:
    return np.quantile(values, [0.25, 0.5, 0.75]).tolist() if values else []


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
            figure = over_variable(title, ticks, label, series, _DRAWN[name])
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


@dataclass(frozen=True)
class Comparison:
    """Whether group A differs from group B in one measure; the p-values are NaN where all differences are equal."""

    measure: str
    medians: tuple[float, float]  # of A and of B, over the pairs
    quartiles: tuple[float, float, float]  # of A - B over the pairs
    difference: float  # mean of A - B over the pairs
    interval: tuple[float, float]  # of that mean, 95 %, by Student's t
    wilcoxon: float  # two-sided p-value of the signed-rank test
    t_test: float  # two-sided p-value of the paired t-test
    rank_biserial: float  # share of the signed ranks that are positive minus that of the negative (Kerby, 2014)
    standardised: float  # mean over standard deviation of the differences (Cohen's d_z)
    pairs: int
    left_out: tuple[str, ...] = ()  # seeds and other settings of which A or B lacks runs

    @property
    def verdict(self) -> str:
        """In words."""
        if self.pairs < _FEWEST:
            return f"undecided: {self.pairs} pairs cannot show anything at 5 %; fly {_FEWEST} seeds or more"
        if self.difference != 0 and self.interval[0] == self.interval[1]:
            return "undecided: every seed gave the same, so all are one; vary what the seed draws (data.size, noise)"
        if self.wilcoxon < _LEVEL:
            return f"A is {'larger' if self.rank_biserial > 0 else 'smaller'} than B"
        return "no difference shown"


def compare(report: Report, a: str, b: str) -> list[Comparison]:
    """Compares two groups of a report's runs, seed by seed, in every measure.

    Args:
        report: All runs.
        a: Choices that say what belongs to group A, such as ``controller=lqr`` or ``data.size=50,horizon=1``.
        b: Those of group B.

    Raises:
        SettingError: A choice that was not varied, a value that does not occur, or runs of both subsystems.
        DataError: The groups have no two seeds in common.
    """
    groups = [_runs_of(report, key, text) for key, text in (("A", a), ("B", b))]
    if len({run.unit for group in groups for runs in group.values() for run in runs.values()}) > 1:
        raise SettingError("compare", "errors in m and in rad have no common mean; add subsystem=... to both groups")
    comparisons = []
    for measure in (name for name in report.measures() if name not in _WALL_TIMES):
        first, second = (
            pd.DataFrame(
                {others: {seed: run.numbers[measure] for seed, run in runs.items()} for others, runs in group.items()},
                dtype=float,
            ).T
            for group in groups
        )
        first, second = first.align(second)  # a row a combination of the other settings, a column a seed
        left_out, both = [], first.notna() & second.notna()
        while both.size and not both.to_numpy().all():  # what lacks the largest share of its runs is left out
            lacking = [(~both).mean(axis=1), (~both).mean(axis=0)]
            axis = int(lacking[1].max() >= lacking[0].max())
            left_out.append(lacking[axis].idxmax())
            both = both.drop(left_out[-1], axis=axis)
        a_mean, b_mean = (side.loc[both.index, both.columns].mean(axis=0).to_numpy() for side in (first, second))
        if len(a_mean) >= 2:
            left_out.sort(key=lambda name: (name.startswith(f"{SEED}="), in_order(name.removeprefix(f"{SEED}="))))
            comparisons.append(_test(measure, a_mean, b_mean, tuple(left_out)))
    if not comparisons:
        raise DataError(f"{report.tree}: runs of {a} and {b} have fewer than two seeds in common")
    return comparisons


def _runs_of(report: Report, key: str, text: str) -> dict[str, Mapping]:
    """Returns the runs of a group by its other settings, and in each by seed."""
    group = {}
    for choice in text.split(","):
        name, _, value = choice.partition("=")
        if name not in report.variables:
            varied = ", ".join(report.variables) or "nothing"
            raise SettingError(f"compare {key}", f"must choose among what was varied, {varied}; got {choice!r}")
        values = dict.fromkeys(cell.values[report.variables.index(name)] for cell in report.cells)
        if value not in values:
            raise SettingError(f"compare {key}", f"{name} was varied over {', '.join(values)}; got {value!r}")
        group[name] = value
    found: dict[str, Mapping] = {}
    for cell in report.cells:
        chosen = dict(zip(report.variables, cell.values, strict=True))
        if group.items() <= chosen.items():
            others = ", ".join(f"{name}={value}" for name, value in chosen.items() if name not in group)
            found[others] = {f"{SEED}={seed}": run for seed, run in cell.runs.items() if run.state == "finished"}
    return found


def _test(measure: str, a: np.ndarray, b: np.ndarray, left_out: tuple[str, ...]) -> Comparison:
    """Compares paired values (n,)."""
    d = a - b
    signed = stats.rankdata(np.abs(d[d != 0])) * np.sign(d[d != 0])
    mean, interval, wilcoxon, t_test = d[0], (d[0], d[0]), np.nan, np.nan
    standardised = np.copysign(np.inf, mean) if mean else 0.0
    if np.ptp(d):  # else all are equal, and so is their mean without rounding
        t, mean, wilcoxon = stats.ttest_rel(a, b), d.mean(), stats.wilcoxon(d).pvalue
        interval, t_test, standardised = tuple(t.confidence_interval()), t.pvalue, t.statistic / np.sqrt(len(d))
    return Comparison(
        measure=measure,
        medians=(float(np.median(a)), float(np.median(b))),
        quartiles=tuple(np.quantile(d, [0.25, 0.5, 0.75])),
        difference=mean,
        interval=interval,
        wilcoxon=wilcoxon,
        t_test=t_test,
        rank_biserial=signed.sum() / np.abs(signed).sum() if len(signed) else 0.0,
        standardised=standardised,
        pairs=len(d),
        left_out=left_out,
    )


def sentences(report: Report, comparisons: Sequence[Comparison], a: str, b: str) -> list[str]:
    """Returns a line a measure, with everything that a reader needs to doubt it."""
    head = f"A: {a}; B: {b}; pairs are seeds, what else was varied is averaged within a seed. Times are not compared."
    everywhere = [name for name in comparisons[0].left_out if all(name in c.left_out for c in comparisons)]
    if everywhere:
        head += f" Left out, since A or B lacks runs of it: {'; '.join(everywhere)}."
    lines = [head]
    for c in comparisons:
        low, median, high = c.quartiles
        line = f"{report.label(c.measure)}: {c.verdict}. Medians {c.medians[0]:.4g} and {c.medians[1]:.4g}; "
        line += f"differences {median:.3g} [{low:.3g}, {high:.3g}]"
        if c.interval[0] != c.interval[1]:
            line += f"; Wilcoxon signed-rank p = {c.wilcoxon:.3g}, rank-biserial {c.rank_biserial:.2f}; mean "
            line += f"difference {c.difference:.3g} (95 %: {c.interval[0]:.3g} to {c.interval[1]:.3g}), "
            line += f"paired t-test p = {c.t_test:.3g}, d_z {c.standardised:.2f}"
        others = "; ".join(name for name in c.left_out if name not in everywhere)
        lines.append(f"{line}; n = {c.pairs}" + (f"; left out as well: {others}" if others else ""))
    return lines
