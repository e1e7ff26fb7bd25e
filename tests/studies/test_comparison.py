"""Two groups of runs are compared by the statistics of independent implementations."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy import stats

from gpmpc.exceptions import DataError
from gpmpc.studies.report import compare, read_report, sentences
from tests.studies.made_up import chosen, made_up_run, metrics_of

SETTINGS = {
    "data": {"size": None},
    "horizon": 10,
    "seed": 0,
    "options": {"controller": "convex"},
}
GROUPS = "controller=lqr", "controller=convex"


def fly(tree, controller, seed, error, **more):
    choices = [
        f"controller={controller}",
        f"seed={seed}",
        *(f"{key}={value}" for key, value in more.items()),
    ]
    settings = SETTINGS | {"seed": seed, "options": {"controller": controller}} | more
    made_up_run(tree, choices, settings, result=metrics_of(error))


def compared(tree, first, second):
    """Compares the errors of LQR with those of the convex controller, a pair a seed."""
    for seed, errors in enumerate(zip(first, second, strict=True)):
        for controller, error in zip(("lqr", "convex"), errors, strict=True):
            fly(tree, controller, seed, error)
    return next(c for c in compare(read_report(tree), *GROUPS) if c.measure == "rmse")


@pytest.mark.parametrize("pairs", [6, 9, 15])
def test_paired_statistics_are_scipys_and_their_definitions(pairs, tmp_path, rng):
    a = rng.uniform(0.1, 0.2, pairs)
    b = a + 0.01 * rng.normal(0.3, 1.0, pairs)
    ours = compared(tmp_path, a, b)
    theirs = stats.ttest_rel(a, b)
    assert ours.pairs == pairs
    assert ours.medians == pytest.approx((np.median(a), np.median(b)))
    assert ours.difference == pytest.approx((a - b).mean())
    assert ours.interval == pytest.approx(tuple(theirs.confidence_interval(0.95)))
    assert ours.t_test == pytest.approx(theirs.pvalue)
    assert ours.standardised == pytest.approx(theirs.statistic / np.sqrt(pairs))
    # The exact null distribution of the signed ranks: every sign of every rank is as
    # likely as the other.
    ranks = 1 + np.argsort(np.argsort(np.abs(a - b)))
    signed = np.sign(a - b) @ ranks
    assert ours.rank_biserial == pytest.approx(signed / ranks.sum())
    signs = np.array(list(product([-1, 1], repeat=pairs)))
    assert ours.wilcoxon == pytest.approx((np.abs(signs @ ranks) >= abs(signed)).mean())


def test_swapped_groups_turn_the_signs_and_keep_the_tests(tmp_path, rng):
    a, b = rng.uniform(0.1, 0.2, size=(2, 8))
    ours = compared(tmp_path / "ab", a, b)
    turned = compared(tmp_path / "ba", b, a)
    assert turned.medians == ours.medians[::-1]
    assert (turned.wilcoxon, turned.t_test) == pytest.approx(
        (ours.wilcoxon, ours.t_test)
    )
    assert turned.interval == pytest.approx((-ours.interval[1], -ours.interval[0]))
    assert (
        turned.difference,
        turned.rank_biserial,
        turned.standardised,
    ) == pytest.approx((-ours.difference, -ours.rank_biserial, -ours.standardised))


def test_a_verdict_is_given_below_five_percent_and_not_above(tmp_path):
    """Of six pairs, p is 2 / 64 if all agree and 4 / 64 if the smallest differs."""
    sizes = np.array([1, 2, 3, 4, 5, 6]) * 1e-3
    comparison = compared(tmp_path / "agree", 0.2 + sizes, np.full(6, 0.2))
    assert (comparison.wilcoxon, comparison.verdict) == (
        pytest.approx(2 / 64),
        "A is larger than B",
    )
    comparison = compared(tmp_path / "turned", 0.2 - sizes, np.full(6, 0.2))
    assert (comparison.wilcoxon, comparison.verdict) == (
        pytest.approx(2 / 64),
        "A is smaller than B",
    )
    comparison = compared(
        tmp_path / "contradict", 0.2 + sizes * [-1, 1, 1, 1, 1, 1], np.full(6, 0.2)
    )
    assert (comparison.wilcoxon, comparison.verdict) == (
        pytest.approx(4 / 64),
        "no difference shown",
    )


def test_survivors_alone_make_no_group_the_better_one(tmp_path):
    for seed in range(10):
        lost = {"rmse": {"total": None}, "lost": {"step": 3}} if seed > 5 else {}
        smaller = metrics_of(0.1 + 1e-3 * seed) | lost
        made_up_run(tmp_path, *chosen("lqr", seed), result=smaller)
        fly(tmp_path, "convex", seed, 0.2)
    report = read_report(tmp_path)
    comparisons = compare(report, *GROUPS)
    rmse = next(c for c in comparisons if c.measure == "rmse")
    assert (rmse.pairs, rmse.lost) == (6, (4, 0))
    assert rmse.verdict == "undecided: A is smaller than B only where neither was lost"
    text = "\n".join(sentences(report, comparisons, *GROUPS))
    assert "lost, without a number: 4 of A, 0 of B" in text
    assert text.count("undecided") == 1
    turned = compare(report, *GROUPS[::-1])
    assert next(c for c in turned if c.measure == "rmse").verdict.startswith("undec")


def test_groups_without_two_seeds_in_common_are_refused(tmp_path):
    for controller, seed in (("lqr", 0), ("lqr", 1), ("convex", 1), ("convex", 2)):
        fly(tmp_path, controller, seed, 0.1)
    with pytest.raises(DataError, match="fewer than two seeds in common"):
        compare(read_report(tmp_path), *GROUPS)
    fly(tmp_path, "convex", 0, 0.1)
    assert compare(read_report(tmp_path), *GROUPS)[0].pairs == 2


def test_a_value_that_holds_commas_is_named_as_it_stands(tmp_path):
    for seed in range(2):
        for R in ("[1,1]", "[2,2]"):
            fly(tmp_path, "lqr", seed, 0.1, R=R)
            fly(tmp_path, "convex", seed, 0.1, R=R)
    groups = ("R=[1,1],controller=lqr", "controller=lqr,R=[2,2]")
    assert compare(read_report(tmp_path), *groups)[0].pairs == 2


def test_the_text_names_gaps_of_one_measure_and_gaps_of_all(tmp_path):
    for seed in range(8):
        fly(tmp_path, "lqr", seed, 0.1)
        if seed != 7:
            fly(tmp_path, "convex", seed, 0.2 + 1e-3 * seed)
    comparisons = compare(read_report(tmp_path), *GROUPS)
    lines = sentences(read_report(tmp_path), comparisons, *GROUPS)
    assert len(lines) == 1 + len(comparisons)
    assert lines[0].endswith("Left out, since A or B lacks runs of it: seed=7.")
    assert not any("seed=7" in line for line in lines[1:])
    also = [replace(comparisons[0], left_out=("seed=3", "seed=7")), *comparisons[1:]]
    lines = sentences(read_report(tmp_path), also, *GROUPS)
    assert lines[0].endswith("lacks runs of it: seed=7.")
    assert lines[1].endswith("left out as well: seed=3")
    assert not any("left out" in line for line in lines[2:])
