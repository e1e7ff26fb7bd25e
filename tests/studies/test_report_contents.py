"""Damaged runs, lost flights and odd texts: every document is written, none obeys."""

import csv
import io
import json
import re
from itertools import product

import numpy as np
import pytest

from gpmpc.studies import report as reporting
from gpmpc.studies.report import (
    compare,
    read_report,
    sentences,
    terminal_table,
)
from tests.studies.made_up import (
    SETTINGS,
    add,
    chosen,
    documents,
    folder_of,
    made_up_run,
    metrics_of,
    on_terminal,
    plan,
    undrawn,
)

RESULT = (
    "rmse",
    "steps",
    "failures",
    "violations",
    "times",
    "unit",
)  # what a failed run need not have


def states(report, state):
    return (report.runs.state == state).sum()


def written_of(report):
    """Markdown, HTML, CSV and LaTeX without the figures, which take their time."""
    document = undrawn(report)
    return {
        "md": document.markdown(),
        "html": document.html(),
        "csv": document.csv(),
        "tex": document.tex(),
    }


def shown(report):
    """The table as a terminal shows it."""
    return on_terminal(terminal_table(report), width=100)


DAMAGE = {
    "RMSE infinite": {"rmse": {"total": float("inf")}},
    "RMSE NaN": {"rmse": {"total": float("nan")}},
    "RMSE a text": {"rmse": {"total": "0.1"}},
    "RMSE a truth": {"rmse": {"total": True}},
    "RMSE too large for any number": {"rmse": {"total": 10**400}},
    "RMSE a list": {"rmse": [0.1]},
    "no RMSE": {"rmse": None},
    "no step": {"steps": 0},
    "steps a text": {"steps": "100"},
    "steps NaN": {"steps": float("nan")},
    "failures a list": {"failures": [1]},
    "failures of texts": {"failures": {"INFEASIBLE": "3"}},
    "violations of nothing": {"violations": {"inputs": {}}},
    "violations a number": {"violations": 3},
    "times missing": {"times": {}},
    "times of texts": {"times": {"total": {"median": "fast"}, "training": 1}},
    "training infinite": {
        "times": {"total": {"median": 1.0}, "training": float("inf")}
    },
    "unit a number": {"unit": 1},
    "choices a text": {"choices": "controller=nmpc"},
    "choices of numbers": {"choices": [1, 2]},
    "choices nothing": {"choices": None},
    "settings a list": {"settings": []},
    "options a list": {"settings": {"options": ["x"]}},
}
WHOLE = {
    "empty": b"",
    "cut": b'{"choices": ["controller=nmpc"], "sett',
    "no object": b"[1, 2]",
    "a number": b"1",
    "no UTF-8": b'{"choices": ["\xff"]}',
    "nested beyond all measure": b"[" * 100_000,
    "other keys": b'{"a": 1}',
}


@pytest.mark.parametrize("name", ["metrics.json", "error.json"])
@pytest.mark.parametrize("damage", [*DAMAGE, *WHOLE])
def test_one_damaged_run_alone_is_skipped_with_its_reason(damage, name, tmp_path):
    for seed in range(2):
        add(tmp_path, "lqr", seed, 0.1)
    made_up_run(
        tmp_path, *chosen("nmpc", 0), result=metrics_of(0.1) | {"error": "none"}
    )
    folder = folder_of(tmp_path, chosen("nmpc", 0)[0])
    content = json.loads((folder / "metrics.json").read_text()) | DAMAGE.get(damage, {})
    (folder / "metrics.json").unlink()
    (folder / name).write_bytes(
        WHOLE.get(damage) if damage in WHOLE else json.dumps(content).encode()
    )
    report = read_report(tmp_path)
    reads_it = name == "error.json" and set(DAMAGE.get(damage, ())) & {*RESULT}
    assert len(report.skipped) == (0 if reads_it else 1)
    assert all(
        line.startswith(f"{folder / name}: is not what a run writes: ")
        for line in report.skipped
    )
    assert states(report, "finished") == 2
    for text in (*written_of(report).values(), shown(report)):
        assert "0.1" in text


def test_a_plan_that_cannot_be_read_is_skipped(tmp_path):
    tree = tmp_path
    for seed in range(6):
        add(tree, "lqr", seed, 0.1)
    plan(tree, [chosen("lqr", seed)[0] for seed in range(8)])
    for i, text in enumerate(
        (
            "",
            "{}",
            '{"runs": 3}',
            '{"runs": [3]}',
            '{"runs": [[1]]}',
            '{"runs": ["ab"]}',
        )
    ):
        (tree / f"sweep-damaged{i}.json").write_text(text)
    report = read_report(tree)
    assert len(report.skipped) == 6
    assert all("is not what a sweep writes" in line for line in report.skipped)
    assert report.commands() == [f"gpmpc run -m controller=lqr seed=6,7 folder={tree}"]


NASTY = [
    "[/nope]",
    "[red]x",
    r"\input{/etc/passwd}",
    "\\",
    "<script>alert(1)</script>",
    "<img src=x onerror=y>",
    "&amp;",
    "a|b",
    "=1+1",
    "@SUM(A1)",
    "+cmd|'/C calc'!A0",
    "-2+3",
    "`rm`",
    "[x](javascript:y)",
    "$x$",
    r"$\frac",
    "%",
    "a_b^c~d#{}",
    "*b*",
    "\x1b[31mred",
    "two\nlines",
    "tab\there",
    "\u202eleft",
    "\ud800",
    "nul\x00",
    "x" * 400,
    "ünïcödé 漢字",
    "{unit}",
    "../../up",
]


@pytest.mark.parametrize("nasty", NASTY, ids=ascii)
def test_what_a_user_chose_is_text_in_every_document(nasty, tmp_path):
    for seed in range(2):
        add(tmp_path, "lqr", seed, 0.1)
    settings = SETTINGS | {"options": {"controller": nasty}}
    lost = metrics_of(0.2) | {"lost": {"why": nasty}}
    made_up_run(tmp_path, [f"controller={nasty}", "seed=0"], settings, result=lost)
    made_up_run(tmp_path, [f"controller={nasty}", "seed=1"], settings, error=nasty)
    report = read_report(tmp_path)
    written = written_of(report)
    for text in (*written.values(), shown(report)):
        text.encode()
        assert not set(text) & set("\x00\x1b\t\u202e")
    text = re.sub(
        r"\n```\n.*?\n```\n", "", written["md"], flags=re.DOTALL
    )  # code is no markup
    assert not re.search(r"<script|<img|\]\(java", text)
    assert not re.search(r"<script|<img (?!alt)", written["html"])
    commands = set(re.findall(r"\\[a-zA-Z]+", written["tex"]))
    ours = (
        "begin end toprule midrule bottomrule footnotesize usepackage "
        "textbackslash textasciitilde textasciicircum"
    )
    assert commands <= {
        f"\\{name}" for name in (*ours.split(), "textless", "textgreater", "textbar")
    }
    rows = list(csv.reader(io.StringIO(written["csv"])))
    assert {len(row) for row in rows} == {len(rows[0])}
    for value in (
        value for row in rows for value in row if value.startswith(("=", "+", "-", "@"))
    ):
        float(value)
    table = [line for line in written["md"].splitlines() if line.startswith("|")]
    assert len(table) == 4
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in table} == {
        len(re.findall(r"\|", table[1]))
    }


def test_figures_take_every_text(tmp_path):
    for nasty in ("[/nope]", r"$\frac", "x" * 400, "a/b", "ünï", r"\input"):
        choices = [f"controller={nasty}", f"+{nasty}=1", "seed=0"]
        made_up_run(
            tmp_path,
            choices,
            SETTINGS | {"options": {"controller": nasty}},
            result=metrics_of(0.2),
        )
    written = documents(read_report(tmp_path))
    assert len({name.lower() for name in written}) == len(written) == 4 + 2 * 7
    for name in written:
        assert re.fullmatch(r"[\w.+-]{1,200}", name)


def test_a_flight_that_was_lost_is_called_so(tmp_path):
    for seed in range(6):
        add(tmp_path, "convex", seed, 0.1)
        lost = (
            {"lost": {"step": 12 + seed, "reason": "14600 m away"}}
            if seed < 2
            else {"lost": None}
        )
        result = metrics_of(0.2) | lost
        if seed == 0:  # it diverged
            result["rmse"] = dict.fromkeys(result["rmse"])
        made_up_run(tmp_path, *chosen("lqr", seed), result=result)
    report = read_report(tmp_path)
    assert [(cell.lost != "").sum() for _, cell in report.runs.groupby("cell")] == [
        0,
        2,
    ]
    assert [*report.runs.groupby("cell").rmse.count()] == [6, 5]
    written = written_of(report)
    for text in (written["md"], written["html"]):
        for words in (
            "of those finished, 2 lost",
            "2 lost",
            "step 13, reason 14600 m away",
        ):
            assert words in text
    assert "2 lost" in shown(report)
    assert "2 lost" in written["tex"]
    assert [
        row["lost"] for row in csv.DictReader(io.StringIO(written_of(report)["csv"]))
    ] == ["0", "2"]


@pytest.mark.parametrize("outlier", [1.0, 1e3, 1e150])
def test_what_stands_before_quartiles_lies_between_them(outlier, tmp_path):
    for seed, error in enumerate([0.1, 0.11, 0.12, 0.13, 0.14, outlier]):
        add(tmp_path, "lqr", seed, error)
    report = read_report(tmp_path)
    (row,) = csv.DictReader(io.StringIO(written_of(report)["csv"]))
    low, median, high = (
        float(row[f"rmse_{part} [m]"]) for part in ("q25", "median", "q75")
    )
    assert low <= median <= high <= 0.14
    assert not any("mean" in name for name in row)
    for text in (
        *(written_of(report)[name] for name in ("md", "tex", "html")),
        shown(report),
    ):
        assert "0.125" in text
        assert "Mean" not in text


def test_wall_times_are_not_compared(tmp_path):
    tree = tmp_path
    for seed in range(6):
        for controller in ("lqr", "convex"):
            add(tree, controller, seed, 0.1 * (1 + seed) + 0.01 * len(controller))
    for path in tree.glob("*/metrics.json"):
        content = json.loads(path.read_text())
        content["times"]["training"] = content["times"]["total"]["median"] = 1.0 + (
            "lqr" in path.parent.name
        )
        path.write_text(json.dumps(content))
    report = read_report(tree)
    assert {"decision", "training"} <= set(report.measures)
    compared = compare(report, "controller=lqr", "controller=convex")
    assert not {"decision", "training"} & {each.measure for each in compared}
    assert "Times are not compared" in sentences(report, compared, "a", "b")[0]


def test_a_report_says_of_every_run_what_became_of_it(tmp_path):
    tree = tmp_path / "tree"
    odd = {"level": "suspicious", "step": 7, "reason": "innovations"}
    for seed, error in enumerate([0.1, 0.2, 0.4]):
        made_up_run(
            tree,
            *chosen("convex", seed, horizon=10),
            result=metrics_of(error, failing=2 * (seed == 2))
            | ({"judgement": odd} if seed == 1 else {}),
        )
    lost = {"lost": {"step": 3, "reason": "away"}}
    made_up_run(tree, *chosen("lqr", 0, horizon=10), result=metrics_of(0.5) | lost)
    made_up_run(tree, *chosen("lqr", 1, horizon=10), error="no\nluck")
    made_up_run(tree, *chosen("lqr", 2, horizon=10), result=metrics_of(0.5))
    damaged = folder_of(tree, chosen("lqr", 2, horizon=10)[0]) / "metrics.json"
    damaged.write_text("{")
    plan(
        tree,
        [
            chosen(controller, seed, horizon=10)[0]
            for controller in ("convex", "lqr")
            for seed in range(4)
        ],
    )
    report = read_report(tree)
    document = undrawn(report, ["a line"])
    head, made, tail = re.split(
        r"## Made\n\n(.*?)(?=## To)", document.markdown(), flags=re.DOTALL
    )
    assert head == (
        "# tree\n\n4 finished in 2 cells, 1 failed, 2 missing, 1 skipped; of those "
        "finished, 1 lost, 1 suspicious."
        " All of them: horizon=10.\n\n"
        "| controller | seeds | RMSE [m] | steps outside bounds [%] | failed solves "
        "[%] | decision, median [ms] |\n"
        "| --- | --- | --- | --- | --- | --- |\n"
        "| convex | 3, 1 suspicious, 1 missing | 0.2 [0.15, 0.3] | 0 | 0 [0, 5] | 3.1 "
        "|\n"
        "| lqr | 1, 1 lost, 1 failed, 1 missing, 1 skipped | 0.5 | 0 | 0 | 3.1 |\n\n"
        "Median [first to third quartile] over the seeds. In figures, every run is a "
        "dot.\n\n"
        "## Comparison\n\n- a line\n\n"
        "## Failed\n\n- controller=lqr,horizon=10,seed=1: no luck\n\n"
        "## Lost\n\n- controller=lqr,horizon=10,seed=0: step 3, reason away\n\n"
        "## Suspicious\n\n- controller=convex,horizon=10,seed=1: step 7, reason "
        "innovations\n\n"
        f"## Skipped\n\n- {damaged}: is not what a run writes: JSONDecodeError: "
        f"Expecting property name enclosed in"
        " double quotes: line 1 column 2 (char 1)\n\n"
    )
    assert tail == (
        f"## To fill the gaps\n\n```\ngpmpc run -m horizon=10 controller=convex "
        f"seed=3 folder={tree}\n"
        f"gpmpc run -m horizon=10 controller=lqr seed=1,3 folder={tree}\n```\n\n"
        "## Settings of all runs\n\n```\ndata.size: null\nhorizon: 10\n```\n"
    )
    origins = [run.origin for run in report.ended]
    dates = sorted({origin["date"] for origin in origins})
    lines = [line.removeprefix("- ") for line in made.splitlines()]
    assert lines[0] == "Runs made: " + " to ".join(dict.fromkeys([dates[0], dates[-1]]))
    assert f"Machine: {origins[0]['machine']}" in lines
    assert lines[-2] == f"Tree: {tree}"
    assert origins[0]["machine"].endswith(" cores")
    header, convex, lqr = document.csv().splitlines()
    assert header.startswith(
        "controller,finished,lost,suspicious,failed,missing,skipped,"
        "rmse_q25 [m],rmse_median [m],rmse_q75 [m]"
    )
    assert "failed_q25 [%],failed_median [%],failed_q75 [%],decision_q25 [ms]" in header
    assert convex.split(",")[:7] == ["convex", "3", "0", "1", "0", "1", "0"]
    assert lqr.split(",")[:7] == ["lqr", "1", "1", "0", "1", "1", "1"]
    assert [float(value) for value in convex.split(",")[7:10]] == pytest.approx(
        [0.15, 0.2, 0.3]
    )
    assert "outside" not in document.tex()
    short = terminal_table(report)
    assert short.header == [
        "controller",
        "seeds",
        "RMSE\n[m]",
        "failed\n[%]",
        "decision\n[ms]",
    ]
    assert short.rows[0] == [
        "convex",
        "3\n1 suspicious\n1 missing",
        "0.2\n[0.15, 0.3]",
        "0\n[0, 5]",
        "3.1",
    ]
    assert (
        short.title
        == "4 finished in 2 cells, 1 failed, 2 missing, 1 skipped; of those finished, "
        "1 lost, 1 suspicious"
    )
    assert (
        document.links["controller=lqr,horizon=10,seed=1"]
        == "../controller=lqr,horizon=10,seed=1"
    )
    assert len(document.links) == 5


@pytest.mark.parametrize(
    ("provenance", "origin"),
    [
        (None, {}),
        ({}, {}),
        (
            {"git": {"commit": "0123456789abcdef"}, "created": "now"},
            {"date": "now", "commit": "0123456789"},
        ),
        (
            {"git": {"commit": "0123456789abcdef", "dirty": True}},
            {"commit": "0123456789, changed"},
        ),
        ({"git": None, "versions": {"gpmpc": "1.2"}}, {"commit": "1.2"}),
        ({"machine": {"system": "Linux", "cores": 2}}, {"machine": "Linux, 2 cores"}),
    ],
)
def test_where_a_run_comes_from_is_told_as_far_as_it_says_so(
    provenance, origin, tmp_path
):
    made_up_run(
        tmp_path, *chosen("lqr", 0), result=metrics_of(0.1) | {"provenance": provenance}
    )
    (run,) = read_report(tmp_path).ended
    assert run.origin == origin


def test_a_figure_has_a_curve_for_each_other_varied_setting(tmp_path, monkeypatch):
    """Fewer settings make curves where all of them would make too many."""
    monkeypatch.setattr(reporting, "over_variable", lambda *arguments: arguments)
    monkeypatch.setattr(reporting, "png", lambda drawn: drawn)
    errors = {}
    for i, (horizon, size, gain) in enumerate(
        product((1, 5, 10, 20), (50, 100, 200), ("high", "low"))
    ):
        errors[horizon, size, gain] = 0.25 * (i + 1)
        choices = [f"gain={gain}", f"horizon={horizon}", "seed=0", f"size={size}"]
        made_up_run(
            tmp_path,
            choices,
            SETTINGS,
            result=metrics_of(errors[horizon, size, gain], failing=i == 3),
        )
    drawn = reporting.report_document(read_report(tmp_path)).images
    measures = {
        "rmse": "RMSE [m]",
        "failed": "failed solves [%]",
        "decision": "decision, median [ms]",
    }
    assert {*drawn} == {
        f"{name}-over-{key}.png"
        for name in measures
        for key in ("horizon", "size", "gain")
    }
    for name, label in measures.items():
        for key, ticks in (
            ("horizon", ["1", "5", "10", "20"]),
            ("size", ["50", "100", "200"]),
        ):
            title, report, axis, _, logarithmic = drawn[f"{name}-over-{key}.png"]
            assert (title, report, axis, logarithmic) == (
                key,
                ticks,
                label,
                name != "failed",
            )
    series = drawn["rmse-over-horizon.png"][3]  # 6 curves
    assert [line.label for line in series] == [
        f"gain={g}, size={s}" for g in ("high", "low") for s in (50, 100, 200)
    ]
    for line, (gain, size) in zip(
        series, product(("high", "low"), (50, 100, 200)), strict=True
    ):
        assert line.values == [
            [pytest.approx(errors[horizon, size, gain])] for horizon in (1, 5, 10, 20)
        ]
    series = drawn["rmse-over-size.png"][3]  # 8 curves: as many as there may be
    assert [line.label for line in series] == [
        f"gain={g}, horizon={h}" for g in ("high", "low") for h in (1, 5, 10, 20)
    ]
    series = drawn["rmse-over-gain.png"][
        3
    ]  # 12 were too many: without the horizon, of which there are most
    assert [line.label for line in series] == ["size=50", "size=100", "size=200"]
    for line, size in zip(series, (50, 100, 200), strict=True):
        pooled = [
            [errors[horizon, size, gain] for horizon in (1, 5, 10, 20)]
            for gain in ("high", "low")
        ]
        assert line.values == [pytest.approx(values) for values in pooled]
    failed = drawn["failed-over-horizon.png"][3]
    assert sorted(
        value for line in failed for values in line.values for value in values
    ) == [0] * 23 + [5]


def test_figures_of_one_setting_have_one_curve_and_own_names(tmp_path, monkeypatch):
    """A name that would be an existing file gets a number."""
    monkeypatch.setattr(reporting, "over_variable", lambda *arguments: arguments)
    monkeypatch.setattr(reporting, "png", lambda drawn: drawn)
    for value in (1, 2):
        made_up_run(
            tmp_path / "one",
            [f"a/b={value}", "seed=0"],
            SETTINGS,
            result=metrics_of(0.1 * value),
        )
        for other in (1, 2):
            choices = [f"a/b={value}", f"a:b={other}", "seed=0"]
            made_up_run(
                tmp_path / "two", choices, SETTINGS, result=metrics_of(0.1 * value)
            )
    one, two = (
        reporting.report_document(read_report(tmp_path / tree)).images
        for tree in ("one", "two")
    )
    assert [*one] == ["rmse-over-a-b.png", "decision-over-a-b.png"]
    (line,) = one["rmse-over-a-b.png"][3]
    assert (line.label, line.values) == (
        "all",
        [[pytest.approx(0.1)], [pytest.approx(0.2)]],
    )
    assert [*two] == [
        "rmse-over-a-b.png",
        "decision-over-a-b.png",
        "rmse-over-a-b-1.png",
        "decision-over-a-b-1.png",
    ]


def test_a_comparison_is_told_with_every_number(tmp_path):
    for seed, (first, second) in enumerate(
        zip([3, 5, 7, 8, 9, 6, 5], [2, 3, 4, 4, 4, 7.5, 4.5], strict=True)
    ):
        add(tmp_path, "lqr", seed, float(first))
        add(tmp_path, "convex", seed, float(second), failing=2)
    report = read_report(tmp_path)
    compared = compare(report, "controller=lqr", "controller=convex")
    rmse, outside, failed = compared
    assert [each.measure for each in compared] == ["rmse", "outside", "failed"]
    assert (rmse.medians, rmse.quartiles, rmse.difference) == (
        (6.0, 4.0),
        (0.75, 2.0, 3.5),
        2,
    )
    assert rmse.rank_biserial == pytest.approx(
        (28 - 2 * 3) / 28
    )  # -1.5 has the third rank of 1 to 7
    assert (
        outside.difference,
        outside.standardised,
        outside.rank_biserial,
        outside.interval,
    ) == (0, 0, 0, (0, 0))
    assert (failed.difference, failed.interval, failed.standardised) == (
        -10,
        (-10, -10),
        -np.inf,
    )
    assert failed.rank_biserial == -1
    assert np.isnan([failed.wilcoxon, failed.t_test]).all()
    assert sentences(report, compared, "a", "b") == [
        "A: a; B: b; pairs are seeds, what else was varied is averaged within a seed. "
        "Times are not compared.",
        "RMSE [m]: no difference shown. Medians 6 and 4; differences 2 [0.75, 3.5]; "
        "Wilcoxon signed-rank p = 0.0781, "
        "rank-biserial 0.79; mean difference 2 (95 %: -0.0507 to 4.05), paired t-test "
        "p = 0.0543, d_z 0.90; n = 7",
        "steps outside bounds [%]: no difference shown. Medians 0 and 0; differences "
        "0 [0, 0]; n = 7",
        "failed solves [%]: undecided: every seed gave the same, so all are one; vary "
        "what the seed draws (data.size, "
        "noise). Medians 0 and 10; differences -10 [-10, -10]; n = 7",
    ]
