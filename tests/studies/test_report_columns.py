"""A measure that is zero in every run takes no column where there is little room."""

import pytest

from gpmpc.studies.report import read_report, terminal_table
from tests.studies.made_up import documents, made_up_run, metrics_of

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
    for words in (header, documents(report)["report.tex"]):
        assert ("failed" in words) == bool(failing)
        assert "RMSE" in words
        assert "outside" not in words
    assert "outside" in documents(report)["report.csv"]  # which has room for everything


def test_a_comparison_stands_in_the_page_and_in_the_text(tmp_path):
    for seed in range(2):
        choices = [f"seed={seed}"]
        settings = SETTINGS | {"seed": seed}
        made_up_run(tmp_path, choices, settings, result=metrics_of(0.1))
    report = read_report(tmp_path)
    lines = ["first line of it", "second line of it"]
    for name in ("report.md", "report.html"):
        with_it = documents(report, lines)[name]
        without = documents(report)[name]
        assert all(
            line in with_it and line not in without for line in [*lines, "Comparison"]
        )
