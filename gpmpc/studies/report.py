"""Shows a tree of runs: a row a cell, figures over what was varied, what failed or is missing, whether two differ.

Two groups of runs are compared seed by seed: runs of one seed share their training rows and their noise. What else was
varied is averaged within a seed first, so that a seed counts once, and over the same for every seed. The signed-rank
test (Wilcoxon, 1945) decides, which asks only that the differences are spread symmetrically; Student's t-test beside it
asks for normal ones. Wall times are not compared: one group is flown after the other, and what the machine did
meanwhile is no property of either.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from gpmpc._provenance import now
from gpmpc.exceptions import DataError, SettingError
from gpmpc.plotting import Series, over_variable, png
from gpmpc.studies._document import (
    MISSING,
    Document,
    Table,
    figure_label,
    plain_text,
    with_range,
)
from gpmpc.studies._run_folder import LONGEST_NAME
from gpmpc.studies._runs import SEED, Report, in_order, read_report

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

_DRAWN = {
    "rmse": True,
    "failed": False,
    "decision": True,
}  # a figure each, and whether it may be logarithmic
_WALL_TIMES = ("decision", "training")
_SHORT = {
    "rmse": "RMSE",
    "outside": "outside",
    "failed": "failed",
    "decision": "decision",
}  # in a terminal
_PARTS = ("q25", "median", "q75")
_MOST_LINES = 8  # in a figure; what is varied besides is pooled
_LEGEND = (
    "Median [first to third quartile] over the seeds. In figures, every run is a dot."
)
_LEVEL = 0.05
_FEWEST = 6  # pairs; with n of them the smallest two-sided p-value of the signed-rank test is 2^(1 - n)


def report_document(
    report: Report, comparison: Sequence[str] = (), folder: Path | None = None
) -> Document:
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
        [_table(report, [*report.measures])],
        _numbers(report),
        lead=f"{_counts(report)}."
        + (f" All of them: {constants}." if constants else ""),
        notes=[_LEGEND],
        lists={"Comparison": comparison, **notes(report), "Made": _made(report)},
        code={
            "To fill the gaps": report.commands(),
            "Settings of all runs": report.base_settings(),
        },
        images=_figures(report),
        links={
            plain_text(str(run.folder.relative_to(report.tree))): os.path.relpath(
                run.folder.resolve(), start
            )
            for run in report.there
        },
        latex=[_table(report, _telling(report))],
    )


def _made(report: Report) -> list[str]:
    """Returns when, from which source and on which machines the runs were made."""
    made = {
        key: sorted({run.origin[key] for run in report.there if key in run.origin})
        for key in ("date", "commit", "machine")
    }
    dates = " to ".join(dict.fromkeys([*made["date"][:1], *made["date"][-1:]]))
    shown = {
        "Runs made": dates,
        "Commit": "; ".join(made["commit"]),
        "Machine": "; ".join(made["machine"]),
    }
    shown |= {"Report made": now(), "Tree": str(report.tree.resolve())}
    return [f"{key}: {plain_text(value)}" for key, value in shown.items() if value]


def _states(report: Report) -> pd.DataFrame:
    """Returns how many runs of every cell finished, were lost or suspicious, failed, are missing and were skipped."""
    runs = report.runs
    counts = pd.crosstab(runs.cell, runs.state).reindex(
        columns=["finished", "failed", "missing", "skipped"], fill_value=0
    )
    counts.insert(1, "lost", (runs.lost != "").groupby(runs.cell).sum())
    suspicious = (runs.suspicious != "").groupby(runs.cell).sum()
    counts.insert(2, "suspicious", suspicious)
    return counts


def _counts(report: Report) -> str:
    """Returns how many runs there are, by how they ended."""
    count = _states(report).sum()
    text = f"{count.finished} finished in {len(report.cells)} cells, {count.failed} failed, {count.missing} missing"
    text += f", {len(report.skipped)} skipped" if report.skipped else ""
    judged = [
        f"{number} {word}"
        for number, word in ((count.lost, "lost"), (count.suspicious, "suspicious"))
        if number
    ]
    return text + (f"; of those finished, {', '.join(judged)}" if judged else "")


def terminal_table(report: Report) -> Table:
    """Returns the table with short headers: median, and the quartiles below it; what is zero everywhere is left out."""
    shown = [name for name in _telling(report) if name in _SHORT]
    header = [name.replace(".", ".\n") for name in report.variables or ("runs",)]
    header += [
        "seeds",
        *(
            f"{_SHORT[name]}\n[{report.measures[name].rpartition(' [')[2]}"
            for name in shown
        ),
    ]
    return Table(header, _table(report, shown).rows, _counts(report))


def notes(report: Report) -> dict[str, list[str]]:
    """Returns what has to be known of runs, by kind: their folders and the reasons."""
    found = {
        "Failed": [
            f"{plain_text(run.folder.name)}: {run.error}"
            for run in report.there
            if run.error
        ],
        "Lost": [
            f"{plain_text(run.folder.name)}: {run.lost}"
            for run in report.there
            if run.lost
        ],
        "Suspicious": [
            f"{plain_text(run.folder.name)}: {run.suspicious}"
            for run in report.there
            if run.suspicious
        ],
        "Skipped": list(report.skipped),
        "Mixed code": _mixed_code(report),
    }
    return {kind: lines for kind, lines in found.items() if lines}


def _mixed_code(report: Report) -> list[str]:
    """Returns a line where the finished runs were flown by different code."""
    counts: dict[str, int] = {}
    commits: dict[str, str] = {}
    dates: dict[str, str] = {}
    for run in report.there:
        if run.state != "finished":
            continue
        counts[run.code] = counts.get(run.code, 0) + 1
        commits[run.code] = run.origin.get("commit", "of unknown version")
        dates[run.code] = max(dates.get(run.code, ""), run.origin.get("date", ""))
    if len(counts) < 2:
        return []
    parts = [
        f"{counts[code]} of {commits[code]} (last {dates[code][:10] or MISSING})"
        for code in sorted(counts, key=lambda code: dates[code])
    ]
    line = "the finished runs are of different code, and may differ for that alone: "
    return [line + "; ".join(parts)]


def _quartiles(report: Report, measures: Sequence[str]) -> np.ndarray:
    """Returns first quartile, median and third (cells, measures, 3) over the seeds; NaN where no run has a number."""
    numbers = [
        runs[name].dropna()
        for _, runs in report.runs.groupby("cell")
        for name in measures
    ]
    found = [
        np.quantile(of, [0.25, 0.5, 0.75]) if len(of) else np.full(3, np.nan)
        for of in numbers
    ]
    return np.reshape(found, (len(report.cells), -1, 3))


def _table(report: Report, measures: Sequence[str]) -> Table:
    rows = []
    counts = _states(report).to_dict("records")
    for values, count, quartiles in zip(
        report.cells, counts, _quartiles(report, measures), strict=True
    ):
        seeds = [
            str(count.pop("finished")),
            *(f"{number} {word}" for word, number in count.items() if number),
        ]
        texts = [MISSING if np.isnan(of).any() else with_range(*of) for of in quartiles]
        rows.append([*(values or ("all",)), "\n".join(seeds), *texts])
    labels = [report.measures[name] for name in measures]
    return Table([*(report.variables or ("runs",)), "seeds", *labels], rows)


def _numbers(report: Report) -> pd.DataFrame:
    values = pd.DataFrame(report.cells, columns=[*report.variables], dtype=object)
    names = [
        f"{name}_{part} [{label.rpartition(' [')[2]}"
        for name, label in report.measures.items()
        for part in _PARTS
    ]
    quartiles = _quartiles(report, [*report.measures]).reshape(len(report.cells), -1)
    found = pd.concat(
        [values, _states(report), pd.DataFrame(quartiles, columns=names)], axis=1
    ).astype(object)
    return found.where(found.notna(), None)


def _telling(report: Report) -> list[str]:
    """Returns the measures that are not zero everywhere."""
    return [name for name in report.measures if report.runs[name].max() > 0]


def _figures(report: Report) -> dict[str, bytes]:
    """Draws one figure (PNG) a varied setting and measure, by file name."""
    drawn: dict[str, bytes] = {}
    for index, variable in enumerate(report.variables):
        positions = sorted({values[index] for values in report.cells}, key=in_order)
        at = report.runs.cell.map(lambda cell, i=index: report.cells[cell][i])
        lines = _lines(report, index)
        for name in (name for name in _telling(report) if name in _DRAWN):
            numbers = report.runs[name].dropna()
            series = []
            for label, cells in lines.items():
                of = numbers[report.runs.cell.isin(cells)]
                series.append(
                    Series(
                        figure_label(label),
                        [of[at == position].tolist() for position in positions],
                    )
                )
            title, label, *ticks = map(
                figure_label, (variable, report.measures[name], *positions)
            )
            figure = over_variable(title, ticks, label, series, _DRAWN[name])
            file = re.sub(
                r"[^\w.+-]",
                "-",
                f"{name}-over-{variable}"[:LONGEST_NAME],
                flags=re.ASCII,
            )
            drawn[
                f"{file}.png" if f"{file}.png" not in drawn else f"{file}-{index}.png"
            ] = png(figure)
    return drawn


def _lines(report: Report, index: int) -> dict[str, list[int]]:
    """Groups cells by what else was varied; by one setting only where all together were too many lines."""
    others = [i for i in range(len(report.variables)) if i != index]
    while (
        len({tuple(values[i] for i in others) for values in report.cells}) > _MOST_LINES
    ):
        others.remove(
            max(others, key=lambda i: len({values[i] for values in report.cells}))
        )
    lines: dict[str, list[int]] = {}
    for cell, values in enumerate(report.cells):
        label = ", ".join(f"{report.variables[i]}={values[i]}" for i in others)
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
    left_out: tuple[
        str, ...
    ] = ()  # seeds and other settings of which A or B lacks runs

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
    if len({*pd.concat(groups).unit}) > 1:
        raise SettingError(
            "compare",
            "errors in m and in rad have no common mean; add subsystem=... to both groups",
        )
    comparisons = []
    for measure in (name for name in report.measures if name not in _WALL_TIMES):
        first, second = (
            group.pivot(index="others", columns="seed", values=measure)
            for group in groups
        )
        first, second = first.align(
            second
        )  # a row a combination of the other settings, a column a seed
        left_out = []
        both = first.notna() & second.notna()
        while (
            both.size and not both.to_numpy().all()
        ):  # what lacks the largest share of its runs is left out
            lacking = [(~both).mean(axis=1), (~both).mean(axis=0)]
            axis = int(lacking[1].max() >= lacking[0].max())
            left_out.append(lacking[axis].idxmax())
            both = both.drop(left_out[-1], axis=axis)
        a_mean, b_mean = (
            side.loc[both.index, both.columns].mean(axis=0).to_numpy()
            for side in (first, second)
        )
        if len(a_mean) >= 2:
            left_out.sort(
                key=lambda name: (
                    name.startswith(f"{SEED}="),
                    in_order(name.removeprefix(f"{SEED}=")),
                )
            )
            comparisons.append(_test(measure, a_mean, b_mean, tuple(left_out)))
    if not comparisons:
        raise DataError(
            f"{report.tree}: runs of {a} and {b} have fewer than two seeds in common"
        )
    return comparisons


def _runs_of(report: Report, key: str, text: str) -> pd.DataFrame:
    """Returns the finished runs of a group, with ``others``, what else was varied, and seeds as they are chosen."""
    group = {}
    for choice in text.split(","):
        name, _, value = choice.partition("=")
        if name not in report.variables:
            varied = ", ".join(report.variables) or "nothing"
            raise SettingError(
                f"compare {key}",
                f"must choose among what was varied, {varied}; got {choice!r}",
            )
        known = dict.fromkeys(
            values[report.variables.index(name)] for values in report.cells
        )
        if value not in known:
            raise SettingError(
                f"compare {key}",
                f"{name} was varied over {', '.join(known)}; got {value!r}",
            )
        group[name] = value
    others = {}
    for cell, values in enumerate(report.cells):
        chosen = dict(zip(report.variables, values, strict=True))
        if group.items() <= chosen.items():
            others[cell] = ", ".join(
                f"{name}={value}" for name, value in chosen.items() if name not in group
            )
    runs = report.runs[
        (report.runs.state == "finished") & report.runs.cell.isin(others)
    ]
    return runs.assign(others=runs.cell.map(others), seed=f"{SEED}=" + runs.seed)


def _test(
    measure: str, a: np.ndarray, b: np.ndarray, left_out: tuple[str, ...]
) -> Comparison:
    """Compares paired values (n,)."""
    d = a - b
    signed = stats.rankdata(np.abs(d[d != 0])) * np.sign(d[d != 0])
    mean = d[0]
    interval = (d[0], d[0])
    wilcoxon = np.nan
    t_test = np.nan
    standardised = np.copysign(np.inf, mean) if mean else 0.0
    if np.ptp(d):  # else all are equal, and so is their mean without rounding
        t = stats.ttest_rel(a, b)
        mean = d.mean()
        wilcoxon = stats.wilcoxon(d).pvalue
        interval = tuple(t.confidence_interval())
        t_test = t.pvalue
        standardised = t.statistic / np.sqrt(len(d))
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


def sentences(
    report: Report, comparisons: Sequence[Comparison], a: str, b: str
) -> list[str]:
    """Returns a line a measure, with everything that a reader needs to doubt it."""
    head = f"A: {a}; B: {b}; pairs are seeds, what else was varied is averaged within a seed. Times are not compared."
    everywhere = [
        name
        for name in comparisons[0].left_out
        if all(name in c.left_out for c in comparisons)
    ]
    if everywhere:
        head += f" Left out, since A or B lacks runs of it: {'; '.join(everywhere)}."
    lines = [head]
    for c in comparisons:
        low, median, high = c.quartiles
        line = f"{report.measures[c.measure]}: {c.verdict}. Medians {c.medians[0]:.4g} and {c.medians[1]:.4g}; "
        line += f"differences {median:.3g} [{low:.3g}, {high:.3g}]"
        if c.interval[0] != c.interval[1]:
            line += f"; Wilcoxon signed-rank p = {c.wilcoxon:.3g}, rank-biserial {c.rank_biserial:.2f}; mean "
            line += f"difference {c.difference:.3g} (95 %: {c.interval[0]:.3g} to {c.interval[1]:.3g}), "
            line += f"paired t-test p = {c.t_test:.3g}, d_z {c.standardised:.2f}"
        others = "; ".join(name for name in c.left_out if name not in everywhere)
        lines.append(
            f"{line}; n = {c.pairs}"
            + (f"; left out as well: {others}" if others else "")
        )
    return lines
