"""Compares two groups of runs of a report, seed by seed.

Runs of one seed share their training rows and their noise. What else was varied is
averaged within a seed first, so that a seed counts once, and over the same for every
seed. The signed-rank test (Wilcoxon, 1945) decides, which asks only that the
differences are spread symmetrically; Student's t-test beside it asks for normal ones.
Wall times are not compared: one group is flown after the other, and what the machine
did meanwhile is no property of either.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from gpmpc.exceptions import DataError, SettingError
from gpmpc.studies._run_record import plain_value
from gpmpc.studies._runs import SEED, Report, in_order

# Between two choices, behind which the next KEY= begins: values may hold others.
_COMMA = re.compile(r",(?=[^\s,=\[\]{}'\"]+=)")
_WALL_TIMES = ("decision", "training")
_LEVEL = 0.05
# With n pairs the smallest two-sided p-value of the signed-rank test is 2^(1 - n).
_FEWEST_PAIRS = 6


@dataclass(frozen=True)
class Comparison:
    """Whether group A differs from group B in one measure.

    The p-values are NaN where all differences are equal; where there are fewer than two
    pairs, so is every other number.
    """

    measure: str
    #: of A and of B, over the pairs
    medians: tuple[float, float]
    #: of A - B over the pairs
    quartiles: tuple[float, float, float]
    #: mean of A - B over the pairs
    difference: float
    #: of that mean, 95 %, by Student's t
    interval: tuple[float, float]
    #: two-sided p-value of the signed-rank test
    wilcoxon: float
    #: two-sided p-value of the paired t-test
    t_test: float
    #: share of the signed ranks that are positive minus that of the negative (Kerby,
    #: 2014)
    rank_biserial: float
    #: mean over standard deviation of the differences (Cohen's d_z)
    standardised: float
    pairs: int
    #: seeds and other settings of which A or B lacks runs, or numbers
    left_out: tuple[str, ...] = ()
    #: flights of A and of B that were lost and have no number; not among the pairs
    lost: tuple[int, int] = (0, 0)

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        if self.pairs < _FEWEST_PAIRS:
            return (
                f"undecided: {self.pairs} pairs cannot show anything at 5 %; "
                f"fly {_FEWEST_PAIRS} seeds or more"
            )
        if self.difference != 0 and self.interval[0] == self.interval[1]:
            return (
                "undecided: every seed gave the same, so all are one; "
                "vary what the seed draws (data.size, noise)"
            )
        if not self.wilcoxon < _LEVEL:
            return "no difference shown"
        a_is_larger = self.rank_biserial > 0
        relation = "larger" if a_is_larger else "smaller"
        lost_of_a, lost_of_b = self.lost
        # Pairs are survivors: their numbers say nothing for who lost more flights.
        lost_more = lost_of_a < lost_of_b if a_is_larger else lost_of_a > lost_of_b
        if lost_more:
            return f"undecided: A is {relation} than B only where neither was lost"
        return f"A is {relation} than B"


def compare(report: Report, a: str, b: str) -> list[Comparison]:
    """Compares two groups of a report's runs, seed by seed, in every measure.

    Args:
        report: All runs.
        a: Choices that say what belongs to group A, such as ``controller=lqr`` or
            ``data.size=50,horizon=1``.
        b: Those of group B.

    Raises:
        SettingError: A choice that was not varied, a value that does not occur, or runs
            of both subsystems.
        DataError: The groups have no two seeds in common.
    """
    runs_of_a = _runs_of_group(report, "A", a)
    runs_of_b = _runs_of_group(report, "B", b)
    units = {*runs_of_a.unit, *runs_of_b.unit}
    if len(units) > 1:
        raise SettingError(
            "compare",
            f"errors in {' and in '.join(sorted(units))} have no common mean; "
            "compare runs of one system: add system=... to both groups",
        )
    comparisons = []
    for measure in report.measures:
        if measure in _WALL_TIMES:
            continue
        # A row a combination of the other settings, a column a seed.
        values_of_a = runs_of_a.pivot(index="others", columns="seed", values=measure)
        values_of_b = runs_of_b.pivot(index="others", columns="seed", values=measure)
        values_of_a, values_of_b = values_of_a.align(values_of_b)
        in_both = values_of_a.notna() & values_of_b.notna()
        complete = _complete_part(in_both)
        mean_of_a = _mean_by_seed(values_of_a, complete)
        mean_of_b = _mean_by_seed(values_of_b, complete)
        left_out = complete.left_out
        comparison = _untested(measure, len(mean_of_a), left_out)
        if len(mean_of_a) >= 2:
            comparison = _test(measure, mean_of_a, mean_of_b, left_out)
        lost_of_a = _lost_without(runs_of_a, measure)
        lost_of_b = _lost_without(runs_of_b, measure)
        comparisons.append(replace(comparison, lost=(lost_of_a, lost_of_b)))
    if all(comparison.pairs < 2 for comparison in comparisons):
        raise DataError(
            f"{report.tree}: runs of {a} and {b} have fewer than two seeds in common"
        )
    return comparisons


def _runs_of_group(report: Report, group: str, text: str) -> pd.DataFrame:
    """Returns the finished runs of a group.

    The column ``others`` says what else was varied, and ``seed`` is as it is chosen.
    """
    choices = {}
    for choice in _COMMA.split(text):
        key, value = _parse_choice(report, group, choice)
        choices[key] = value
    others = {}
    for cell, values in enumerate(report.cells):
        varied = dict(zip(report.variables, values, strict=True))
        if choices.items() <= varied.items():
            others[cell] = ", ".join(
                f"{key}={value}" for key, value in varied.items() if key not in choices
            )
    is_finished = report.runs.state == "finished"
    runs = report.runs[is_finished & report.runs.cell.isin(others)]
    return runs.assign(others=runs.cell.map(others), seed=f"{SEED}=" + runs.seed)


def _lost_without(runs: pd.DataFrame, measure: str) -> int:
    """Counts the lost flights that have no number of a measure: those that diverged."""
    return int((runs[measure].isna() & (runs.lost != "")).sum())


def _parse_choice(report: Report, group: str, choice: str) -> tuple[str, str]:
    """Returns key and value of one choice, both of which must occur in the report."""
    key, _, text = choice.partition("=")
    value = plain_value(text)
    if key not in report.variables:
        varied = ", ".join(report.variables) or "nothing"
        raise SettingError(
            f"compare {group}",
            f"must choose among what was varied, {varied}; got {choice!r}",
        )
    index = report.variables.index(key)
    values = dict.fromkeys(cell[index] for cell in report.cells)
    if value not in values:
        raise SettingError(
            f"compare {group}",
            f"{key} was varied over {', '.join(values)}; got {text!r}",
        )
    return key, value


class _CompletePart(NamedTuple):
    """Settings and seeds of which both groups have all runs."""

    settings: pd.Index
    seeds: pd.Index
    left_out: tuple[str, ...]  # names of the others


def _complete_part(in_both: pd.DataFrame) -> _CompletePart:
    """Leaves out settings and seeds until every run of the others is in both groups.

    What lacks the largest share of its runs goes first; of a seed and a setting that
    lack as much the seed does: a setting that is left out changes what is compared.

    Args:
        in_both: Whether a run is, a row a combination of settings, a column a seed.
    """
    left_out: list[str] = []
    while in_both.size and not in_both.to_numpy().all():
        gaps_by_setting = (~in_both).mean(axis=1)
        gaps_by_seed = (~in_both).mean(axis=0)
        if gaps_by_seed.max() >= gaps_by_setting.max():
            worst = gaps_by_seed.idxmax()
            in_both = in_both.drop(columns=worst)
        else:
            worst = gaps_by_setting.idxmax()
            in_both = in_both.drop(index=worst)
        left_out.append(str(worst))
    left_out.sort(key=_settings_before_seeds)
    return _CompletePart(in_both.index, in_both.columns, tuple(left_out))


def _settings_before_seeds(name: str) -> tuple[bool, tuple[int, float, str]]:
    is_seed = name.startswith(f"{SEED}=")
    return is_seed, in_order(name.removeprefix(f"{SEED}="))


def _mean_by_seed(values: pd.DataFrame, complete: _CompletePart) -> np.ndarray:
    """Returns the mean over the other settings, of every seed that is complete."""
    return values.loc[complete.settings, complete.seeds].mean(axis=0).to_numpy()


def _test(
    measure: str, a: np.ndarray, b: np.ndarray, left_out: tuple[str, ...]
) -> Comparison:
    """Compares paired values (n,)."""
    differences = a - b
    signed_ranks = _signed_ranks(differences)
    rank_biserial = 0.0
    if len(signed_ranks):
        rank_biserial = signed_ranks.sum() / np.abs(signed_ranks).sum()
    if np.ptp(differences) != 0:
        t = stats.ttest_rel(a, b)
        mean = differences.mean()
        interval = tuple(t.confidence_interval())
        wilcoxon = stats.wilcoxon(differences).pvalue
        t_test = t.pvalue
        standardised = t.statistic / np.sqrt(len(differences))
    else:  # all are equal, and so is their mean without rounding
        mean = differences[0]
        interval = (mean, mean)
        wilcoxon = np.nan
        t_test = np.nan
        standardised = np.copysign(np.inf, mean) if mean else 0.0
    return Comparison(
        measure=measure,
        medians=(float(np.median(a)), float(np.median(b))),
        quartiles=tuple(np.quantile(differences, [0.25, 0.5, 0.75])),
        difference=mean,
        interval=interval,
        wilcoxon=wilcoxon,
        t_test=t_test,
        rank_biserial=rank_biserial,
        standardised=standardised,
        pairs=len(differences),
        left_out=left_out,
    )


def _untested(measure: str, pairs: int, left_out: tuple[str, ...]) -> Comparison:
    """Returns what there is to say of a measure that fewer than two pairs have."""
    return Comparison(
        measure=measure,
        medians=(np.nan, np.nan),
        quartiles=(np.nan, np.nan, np.nan),
        difference=np.nan,
        interval=(np.nan, np.nan),
        wilcoxon=np.nan,
        t_test=np.nan,
        rank_biserial=np.nan,
        standardised=np.nan,
        pairs=pairs,
        left_out=left_out,
    )


def _signed_ranks(differences: np.ndarray) -> np.ndarray:
    """Returns the ranks of the sizes of all differences but zeros, with their signs."""
    nonzero = differences[differences != 0]
    return stats.rankdata(np.abs(nonzero)) * np.sign(nonzero)


def sentences(
    report: Report, comparisons: Sequence[Comparison], a: str, b: str
) -> list[str]:
    """Returns a line a measure, with everything that a reader needs to doubt it."""
    head = (
        f"A: {a}; B: {b}; pairs are seeds, what else was varied is averaged within a "
        "seed. Times are not compared."
    )
    left_out_of_all = [
        name
        for name in comparisons[0].left_out
        if all(name in comparison.left_out for comparison in comparisons)
    ]
    if left_out_of_all:
        names = "; ".join(left_out_of_all)
        head += f" Left out, since A or B lacks runs of it: {names}."
    lines = [head]
    for comparison in comparisons:
        line = _sentence(report.measures[comparison.measure], comparison)
        others = [name for name in comparison.left_out if name not in left_out_of_all]
        if others:
            line += f"; left out as well: {'; '.join(others)}"
        lines.append(line)
    return lines


def _sentence(label: str, comparison: Comparison) -> str:
    """Returns verdict, medians, differences and tests of one measure."""
    c = comparison
    low, median, high = c.quartiles
    clauses = [f"{label}: {c.verdict}"]
    if c.pairs >= 2:
        clauses = [
            f"{label}: {c.verdict}. Medians {c.medians[0]:.4g} and {c.medians[1]:.4g}",
            f"differences {median:.3g} [{low:.3g}, {high:.3g}]",
        ]
    if c.pairs >= 2 and c.interval[0] != c.interval[1]:
        clauses += [
            f"Wilcoxon signed-rank p = {c.wilcoxon:.3g}, "
            f"rank-biserial {c.rank_biserial:.2f}",
            f"mean difference {c.difference:.3g} "
            f"(95 %: {c.interval[0]:.3g} to {c.interval[1]:.3g}), "
            f"paired t-test p = {c.t_test:.3g}, d_z {c.standardised:.2f}",
        ]
    clauses.append(f"n = {c.pairs}")
    if any(c.lost):
        clauses.append(f"lost, without a number: {c.lost[0]} of A, {c.lost[1]} of B")
    return "; ".join(clauses)
