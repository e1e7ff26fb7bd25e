"""Tests whether two groups of runs differ by more than luck.

Runs of one seed share their training rows and their noise, so they are compared in pairs: what else was varied is
averaged within a seed first, and a seed counts once. So that every seed is an average over the same, seeds and other
settings of which one of the groups lacks runs are left out, and named. The signed-rank test (Wilcoxon, 1945) decides:
it asks only that the differences are spread symmetrically; Student's t-test beside it asks for normal ones. With fewer
than six pairs nothing can make the first one significant at 5 %. Where the seed decides nothing (all rows, one start,
no noise) its runs are copies of one: a difference that never varies is undecided. Wall times are not compared: one
group is flown after the other, and what the machine did meanwhile is no property of either.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from gpmpc.exceptions import DataError, SettingError
from gpmpc.studies._runs import MEASURES, SEED, Report, in_order

_LEVEL = 0.05
_FEWEST = 6  # pairs; with n of them the smallest two-sided p-value of the signed-rank test is 2^(1 - n)


@dataclass(frozen=True)
class Comparison:
    """Whether group A differs from group B in one measure; the p-values are NaN where all differences are equal."""

    measure: str
    medians: tuple[float, float]  # of A and of B, over the pairs
    quartiles: tuple[float, float, float]  # of A - B over the pairs
    means: tuple[float, float]  # of A and of B
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
    for measure in (name for name in report.measures() if not MEASURES[name].wall_time):
        numbers = (
            {others: {seed: run.numbers[measure] for seed, run in runs.items()} for others, runs in group.items()}
            for group in groups
        )
        first, second = (pd.DataFrame.from_dict(each, orient="index", dtype=float) for each in numbers)
        first, second = first.align(second)  # a row a combination of the other settings, a column a seed
        left_out, both = [], first.notna() & second.notna()
        while both.size and not both.to_numpy().all():  # what lacks the largest share of its runs is left out
            lacking = [(~both).mean(axis=1), (~both).mean(axis=0)]
            axis = int(lacking[1].max() >= lacking[0].max())
            left_out.append(lacking[axis].idxmax())
            both = both.drop(left_out[-1], axis=axis)
        a_mean, b_mean = (side.loc[both.index, both.columns].mean(axis=0).to_numpy() for side in (first, second))
        if len(a_mean) >= 2:
            seeds = sorted((n for n in left_out if n.startswith(f"{SEED}=")), key=lambda name: in_order(name[5:]))
            comparisons.append(_test(measure, a_mean, b_mean, (*(n for n in left_out if n not in seeds), *seeds)))
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
            found[others] = {f"{SEED}={seed}": run for seed, run in cell.runs.items()}
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
        means=(a.mean(), b.mean()),
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
