"""A measure that is zero in every run takes no column where there is little room."""

import pytest

from gpmpc.studies.report import read_report, terminal_table
from tests.studies.made_up import made_up_run, metrics_of, on_terminal, texts

SETTINGS = {
    "data": {"size": None},
    "horizon": 10,
    "seed": 0,
    "options": {"controller": "convex"},
}


@pytest.mark.parametrize("failing", [0, 2])
def test_failed_solves_have_a_column_if_any_run_has_some(failing, tmp_path):
    for seed in range(4):
        for controller in ("convex", "lqr"):
            settings = SETTINGS | {"seed": seed, "options": {"controller": controller}}
            some = failing if (controller, seed) == ("lqr", 3) else 0
            choices = [f"controller={controller}", f"seed={seed}"]
            made_up_run(
                tmp_path, choices, settings, result=metrics_of(0.1, failing=some)
            )
    report = read_report(tmp_path)
    header = " ".join(terminal_table(report).header)
    for words in (header, texts(report)["report.tex"]):
        assert ("failed" in words) == bool(failing)
        assert "RMSE" in words
        assert "outside" not in words
    assert "outside" in texts(report)["report.csv"]  # which has room for everything


def test_runs_that_differ_in_much_have_one_column_of_words(tmp_path):
    typed = [f"data.setting_{i}={i}" for i in range(12)]
    for i in range(12):
        values = {f"setting_{j}": j if i == j else 0.5 for j in range(12)}
        made_up_run(
            tmp_path, [typed[i]], SETTINGS | {"data": values}, result=metrics_of(0.1)
        )
    report = read_report(tmp_path)
    assert len(terminal_table(report).header) > 12
    shown = on_terminal(terminal_table(report, width=80), width=80).split()
    assert sorted(word for word in shown if "setting" in word) == sorted(typed)
    assert len(terminal_table(report, width=2000).header) > 12


def test_a_comparison_stands_in_the_page_and_in_the_text(tmp_path):
    for seed in range(2):
        choices = [f"seed={seed}"]
        settings = SETTINGS | {"seed": seed}
        made_up_run(tmp_path, choices, settings, result=metrics_of(0.1))
    report = read_report(tmp_path)
    lines = ["first line of it", "second line of it"]
    for name in ("report.md", "report.html"):
        with_it = texts(report, lines)[name]
        without = texts(report)[name]
        assert all(
            line in with_it and line not in without for line in [*lines, "Comparison"]
        )
