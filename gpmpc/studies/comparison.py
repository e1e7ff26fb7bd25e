"""Tests whether two groups of runs differ by more than luck.

Runs of one seed share their training rows and their noise, so they are compared in pairs: what else was varied is
averaged within a seed first, and a seed counts once. So that every seed is an average over the same, seeds and other
settings of which one of the groups lacks runs are left out, and named. Two paired tests are stated. The signed-rank
test (Wilcoxon, 1945) decides: it asks only that the differences are spread symmetrically. Student's t-test beside it
asks for normal ones. With fewer than six pairs nothing can make the first one significant at 5 %. Where the seed
decides nothing (all rows, one start, no noise) its runs are copies of one, and no test may count them: a difference
that never varies is undecided. Wall times are not compared: one group is flown after the other, and what the machine
did meanwhile is no property of either.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from gpmpc.exceptions import DataError, SettingError
from gpmpc.studies.report import MEASURES, SEED, Cell, Report, in_order

_LEVEL = 0.05
_FEWEST = 6  # pairs; with n of them the smallest two-sided p-value of the signed-rank test is 2^(1 - n)


@dataclass(frozen=True)
class Comparison:
    """Whether group A differs from group B in one measure.

    Attributes:
        measure: Name of the measure.
        medians: Of A and of B, over the pairs.
        quartiles: Of A - B over the pairs: first, median, third.
        means: Of A and of B.
        difference: Mean of A - B over the pairs.
        interval: Of that mean, 95 %, by Student's t.
        wilcoxon: Two-sided p-value of the signed-rank test.
        t_test: Two-sided p-value of the paired t-test.
        rank_biserial: Share of the signed ranks that are positive minus that of the negative (Kerby, 2014): +-1 where
            every pair differs in the same direction.
        standardised: Mean over standard deviation of the differences (Cohen's d_z).
        pairs: Their number, n.
        left_out: Seeds and other settings that do not count, since A or B lacks runs of them.
    """

    measure: str
    medians: tuple[float, float]
    quartiles: tuple[float, float, float]
    means: tuple[float, float]
    difference: float
    interval: tuple[float, float]
    wilcoxon: float
    t_test: float
    rank_biserial: float
    standardised: float
    pairs: int
    left_out: tuple[str, ...] = ()

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
        b: The same of group B.

    Raises:
        SettingError: A choice that was not varied, a value that does not occur, or runs of both subsystems.
        DataError: The groups have no two seeds in common.
    """
    groups = [_group(report, key, text) for key, text in (("A", a), ("B", b))]
    units = {run.unit for group in groups for cell in _cells(report, group) for run in cell.runs.values()}
    if len(units) > 1:
        raise SettingError("compare", "errors in m and in rad have no common mean; add subsystem=... to both groups")
    comparisons = []
    for measure in (name for name in report.measures() if not MEASURES[name].wall_time):
        first, second = (_by_seed(report, group, measure) for group in groups)
        first, second = first.align(second)
        left_out, both = [], first.notna() & second.notna()
        while both.size and not both.to_numpy().all():  # what lacks the largest share of its runs is left out
            lacking = [(~both).mean(axis=1), (~both).mean(axis=0)]
            axis = int(lacking[1].max() >= lacking[0].max())
            name = lacking[axis].idxmax()
            left_out.append(name)
            both = both.drop(name, axis=axis)
        pairs = [side.loc[both.index, both.columns].mean(axis=0).to_numpy() for side in (first, second)]
        if len(pairs[0]) >= 2:
            seeds = sorted((n for n in left_out if n.startswith(f"{SEED}=")), key=lambda name: in_order(name[5:]))
            names = (*(n for n in left_out if n not in seeds), *seeds)
            comparisons.append(_test(measure, pairs[0], pairs[1], names))
    if not comparisons:
        raise DataError(f"{report.tree}: runs of {a} and {b} have fewer than two seeds in common")
    return comparisons


def _group(report: Report, key: str, text: str) -> dict[str, str]:
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
    return group


def _cells(report: Report, group: Mapping[str, str]) -> list[Cell]:
    """Returns those of a group."""
    return [
        cell for cell in report.cells if group.items() <= dict(zip(report.variables, cell.values, strict=True)).items()
    ]


def _by_seed(report: Report, group: Mapping[str, str], measure: str) -> pd.DataFrame:
    """Returns the values of a group, a row a combination of the other settings and a column a seed."""
    rows = {}
    for cell in _cells(report, group):
        others = zip(report.variables, cell.values, strict=True)
        name = ", ".join(f"{key}={value}" for key, value in others if key not in group)
        rows[name] = {f"{SEED}={seed}": run.numbers[measure] for seed, run in cell.runs.items()}
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def _test(measure: str, a: np.ndarray, b: np.ndarray, left_out: tuple[str, ...]) -> Comparison:
    """Compares paired values (n,)."""
    differences = a - b
    n, mean, deviation = len(differences), float(differences.mean()), float(differences.std(ddof=1))
    if not np.ptp(differences):  # not even by rounding
        mean, deviation = float(differences[0]), 0.0
    nothing = not differences.any()
    half = float(stats.t.ppf(0.975, n - 1)) * deviation / np.sqrt(n)
    ranks = stats.rankdata(np.abs(differences[differences != 0]))
    signed = float((ranks * np.sign(differences[differences != 0])).sum())
    return Comparison(
        measure=measure,
        medians=(float(np.median(a)), float(np.median(b))),
        quartiles=tuple(np.quantile(differences, [0.25, 0.5, 0.75]).tolist()),
        means=(float(a.mean()), float(b.mean())),
        difference=mean,
        interval=(mean - half, mean + half),
        wilcoxon=1.0 if nothing else float(stats.wilcoxon(differences).pvalue),
        t_test=1.0 if nothing else 0.0 if deviation == 0 else float(stats.ttest_rel(a, b).pvalue),
        rank_biserial=signed / float(ranks.sum()) if len(ranks) else 0.0,
        standardised=mean / deviation if deviation > 0 else 0.0 if mean == 0 else float(np.copysign(np.inf, mean)),
        pairs=n,
        left_out=left_out,
    )


def sentences(report: Report, comparisons: Sequence[Comparison], a: str, b: str) -> list[str]:
    """Returns a line a measure, with everything that a reader needs to doubt it."""
    lines = [
        f"A: {a}; B: {b}; pairs are seeds, what else was varied is averaged within a seed. Times are not compared."
    ]
    everywhere = set.intersection(*(set(c.left_out) for c in comparisons))
    if everywhere:
        names = "; ".join(name for name in comparisons[0].left_out if name in everywhere)
        lines[0] += f" Left out, since A or B lacks runs of it: {names}."
    for c in comparisons:
        others = "; ".join(name for name in c.left_out if name not in everywhere)
        low, median, high = c.quartiles
        tests = (
            f"; Wilcoxon signed-rank p = {c.wilcoxon:.3g}, rank-biserial {c.rank_biserial:.2f}; mean difference "
            f"{c.difference:.3g} (95 %: {c.interval[0]:.3g} to {c.interval[1]:.3g}), paired t-test p = {c.t_test:.3g}, "
            f"d_z {c.standardised:.2f}"
        )
        lines.append(
            f"{report.label(c.measure)}: {c.verdict}. Medians {c.medians[0]:.4g} and {c.medians[1]:.4g}; differences "
            f"{median:.3g} [{low:.3g}, {high:.3g}]{tests if c.interval[0] != c.interval[1] else ''}; n = {c.pairs}"
            + (f"; left out as well: {others}" if others else "")
        )
    return lines
