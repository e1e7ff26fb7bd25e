"""A tree of runs becomes one table; what failed and what is missing is named."""

import csv
import io
import json
import re
import shlex
import time
import tracemalloc
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from gpmpc.exceptions import DataError, SettingError
from gpmpc.plotting import Series, over_variable
from gpmpc.studies import report as reporting
from gpmpc.studies.report import (
    compare,
    notes,
    read_report,
    report_document,
    sentences,
    terminal_table,
)
from tests.cli.command import called
from tests.studies.made_up import (
    SETTINGS,
    add,
    chosen,
    documents,
    folder_of,
    lose,
    made_up_run,
    metrics_of,
    plan,
    record_of,
    texts,
    undrawn,
)

CONF = Path(__file__).resolve().parents[2] / "conf"


def seeds(cell, state):
    return [*cell.seed[cell.state == state]]


def cells(report):
    return [cell for _, cell in report.runs.groupby("cell")]


@pytest.fixture
def tree(tmp_path):
    """Two controllers, eight seeds, of which one failed and one is missing."""
    rng = np.random.default_rng(3)
    for seed in range(8):
        luck = rng.uniform(0.5, 2.0)  # shared by both: that is what pairs are for
        add(tmp_path, "convex", seed, 0.010 * luck, failing=seed % 2)
        if seed < 6:
            add(tmp_path, "lqr", seed, 0.012 * luck)
    made_up_run(tmp_path, *chosen("lqr", 6), error="no start led\nanywhere")
    plan(tmp_path, [chosen(c, seed)[0] for c in ("convex", "lqr") for seed in range(8)])
    return tmp_path


def test_cells_are_made_of_what_was_varied_and_seeds_fill_them(tree):
    report = read_report(tree)
    assert report.variables == ("controller",)
    assert report.cells == (("convex",), ("lqr",))
    convex, lqr = cells(report)
    assert (
        seeds(convex, "finished") == [*convex.seed] == [str(seed) for seed in range(8)]
    )
    assert (seeds(lqr, "failed"), seeds(lqr, "missing")) == (["6"], ["7"])
    assert convex["failed"].mean() == pytest.approx(2.5)
    assert np.allclose(np.array(lqr.rmse[:6]) / convex.rmse[:6], 1.2)


def test_the_gaps_come_with_the_command_that_fills_them(tree):
    assert read_report(tree).commands() == [
        f"gpmpc run -m controller=lqr seed=6,7 folder={tree}"
    ]


def test_gaps_of_runs_without_a_seed_are_filled_without_one(tmp_path):
    for controller in ("convex", "lqr"):
        lose(tmp_path, [f"controller={controller}"])
    for _ in ("from the folders", "from the index"):
        report = read_report(tmp_path)
        assert report.commands() == [
            f"gpmpc run -m controller={controller} folder={tmp_path}"
            for controller in ("convex", "lqr")
        ]
        assert report.base_settings() == []


def test_gaps_are_filled_in_the_sweep_that_has_them(tmp_path):
    for name in ("first", "second"):
        lose(tmp_path / name, ["controller=lqr", f"horizon={len(name)}"])
    plan(tmp_path / "third", [["controller=lqr", "horizon=9"]])
    assert read_report(tmp_path).commands() == [
        f"gpmpc run -m controller=lqr horizon={horizon} folder={tmp_path / name}"
        for horizon, name in ((5, "first"), (6, "second"), (9, "third"))
    ]


def test_a_gap_that_a_run_of_another_sweep_stands_for_is_told(tmp_path):
    first = tmp_path / "first"
    second = tmp_path / "second"
    add(first, "lqr", 0, 0.1)
    plan(first, [chosen("lqr", 0)[0], chosen("lqr", 1)[0]])
    plan(second, [chosen("lqr", 0)[0], chosen("lqr", 1)[0]])
    report = read_report(tmp_path)
    assert seeds(cells(report)[0], "missing") == ["1"]
    assert report.repeated == (
        f"2 missing in {second}: runs of {first} have the same choices and seeds, and "
        f"are shown; gpmpc report {second} shows them",
    )


def test_a_failed_run_without_a_seed_flies_again_in_its_folder(tmp_path):
    choices = ["controller=lqr"]
    settings = SETTINGS | {"seed": 0, "options": {"controller": "lqr"}}
    made_up_run(tmp_path, choices, settings, error="killed")
    add(tmp_path, "convex", 0, 0.1)
    report = read_report(tmp_path)
    assert seeds(cells(report)[1], "failed") == ["0"]
    assert report.commands() == [f"gpmpc run -m controller=lqr folder={tmp_path}"]


def test_a_lost_run_leaves_the_settings_of_all_others_told(tree):
    shared = read_report(tree).base_settings()
    assert "horizon: 10" in shared
    lose(tree, chosen("lqr", 7)[0])
    assert read_report(tree).base_settings() == shared


def test_gaps_are_filled_with_the_settings_of_the_users_folder(tmp_path):
    add(tmp_path, "lqr", 0, 0.1)
    lose(
        tmp_path,
        chosen("lqr", 1)[0],
        "gpmpc run --config-dir 'my own' --config-name=mine controller=lqr seed=1",
    )
    runs = [chosen("lqr", seed)[0] for seed in (2, 3)]
    content = {"runs": runs, "search_options": "--config-dir own"}
    (tmp_path / "sweep-1.json").write_text(json.dumps(content))
    for _ in ("from the folders", "from the index"):
        assert read_report(tmp_path).commands() == [
            f"gpmpc run -m --config-dir 'my own' --config-name mine controller=lqr "
            f"seed=1 folder={tmp_path}",
            f"gpmpc run -m --config-dir own controller=lqr seed=2,3 folder={tmp_path}",
        ]


def test_without_a_sweep_nothing_is_missing(tmp_path):
    for horizon, (controller, seed) in enumerate(
        (("lqr", 0), ("lqr", 1), ("convex", 1), ("nmpc", 7)), 1
    ):
        choices = [f"controller={controller}", f"horizon={horizon}", f"seed={seed}"]
        settings = SETTINGS | {
            "seed": seed,
            "horizon": horizon,
            "options": {"controller": controller},
        }
        made_up_run(tmp_path, choices, settings, result=metrics_of(0.1))
    report = read_report(tmp_path)
    assert [[*cell.state] for cell in cells(report)] == [["finished"]] * 4
    assert report.commands() == []


def test_single_runs_beside_a_sweep_add_nothing_to_it(tmp_path):
    made_up_run(
        tmp_path,
        ["horizon=3", "seed=9"],
        SETTINGS | {"seed": 9, "horizon": 3},
        result=metrics_of(0.1),
    )
    for seed in range(3):
        add(tmp_path, "lqr", seed, 0.1)
    plan(
        tmp_path,
        [
            chosen(controller, seed)[0]
            for controller in ("lqr", "nmpc")
            for seed in range(4)
        ],
    )
    report = read_report(tmp_path)
    assert report.variables == ("controller", "horizon")
    gaps = {
        values: missing
        for values, cell in zip(report.cells, cells(report), strict=True)
        if (missing := seeds(cell, "missing"))
    }
    assert gaps == {("lqr", "10"): ["3"], ("nmpc", "10"): ["0", "1", "2", "3"]}


def test_a_run_counts_with_its_default_settings(tmp_path):
    made_up_run(tmp_path, ["seed=1"], SETTINGS | {"seed": 1}, result=metrics_of(0.1))
    made_up_run(
        tmp_path,
        ["horizon=5", "seed=1"],
        SETTINGS | {"seed": 1, "horizon": 5},
        result=metrics_of(0.1),
    )
    report = read_report(tmp_path)
    assert report.variables == ("horizon",)
    assert report.cells == (("5",), ("10",))  # numbers by their size


def test_documents_agree_and_the_page_needs_no_other_file(tree):
    report = read_report(tree)
    written = documents(report)
    rows = list(csv.DictReader(io.StringIO(written["report.csv"])))
    errors = cells(report)[0].rmse
    expected = np.median(errors)
    assert float(rows[0]["rmse_median [m]"]) == expected
    assert float(rows[0]["rmse_q25 [m]"]) == np.quantile(errors, 0.25)
    assert (rows[1]["failed"], rows[1]["missing"]) == ("1", "1")
    for name, seeds in (
        ("report.md", "6, 1 failed, 1 missing"),
        ("report.html", "6<small>1 failed</small>"),
    ):
        for text in (f"{expected:.3g}", "no start led anywhere", seeds, "gpmpc run -m"):
            assert text in written[name]
    assert f"{expected:.3g}" in written["report.tex"]
    assert written["rmse-over-controller.png"].startswith(b"\x89PNG")
    html = written["report.html"]
    assert "data:image/png;base64," in html
    assert not [
        mark for mark in ("http:", "https:", "<script", "<link") if mark in html
    ]
    assert len(terminal_table(report).rows) == 2


def test_an_unreadable_run_is_named_and_the_others_reported(tree):
    old = folder_of(tree, chosen("convex", 0)[0]) / "metrics.json"
    content = json.loads(old.read_text())
    del content["unit"]  # as an older version left it
    old.write_text(json.dumps(content))
    broken = folder_of(tree, chosen("lqr", 0)[0]) / "metrics.json"
    broken.write_text('{"choices": ')
    report = read_report(tree)
    assert [len(seeds(cell, "finished")) for cell in cells(report)] == [7, 5]
    assert len(report.skipped) == 2
    for path, reason in ((old, "it lacks 'unit'"), (broken, "JSONDecodeError")):
        assert any(
            line.startswith(f"{path}: is not what a run writes") and reason in line
            for line in report.skipped
        )
    written = texts(report)
    for name in ("report.md", "report.html"):
        assert "2 skipped" in written[name]
        assert str(old) in written[name]


def test_an_unreadable_run_is_not_missing_nor_flown_over(tmp_path):
    for controller in ("convex", "lqr"):
        for seed in range(4):
            if (controller, seed) != ("lqr", 3):
                add(tmp_path, controller, seed, 0.1)
    plan(
        tmp_path,
        [
            chosen(controller, seed)[0]
            for controller in ("convex", "lqr")
            for seed in range(4)
        ],
    )
    (folder_of(tmp_path, chosen("lqr", 1)[0]) / "metrics.json").write_text(
        '{"choices": '
    )
    report = read_report(tmp_path)
    convex, lqr = cells(report)
    assert {*convex.state} == {"finished"}
    assert [seeds(lqr, state) for state in ("finished", "skipped", "missing")] == [
        ["0", "2"],
        ["1"],
        ["3"],
    ]
    assert report.commands() == [
        f"gpmpc run -m controller=lqr seed=3 folder={tmp_path}"
    ]
    written = texts(report)
    assert (
        "6 finished in 2 cells, 0 failed, 1 missing, 1 skipped" in written["report.md"]
    )
    assert "2, 1 missing, 1 skipped" in written["report.md"]
    assert "2<small>1 missing</small><small>1 skipped</small>" in written["report.html"]
    assert list(csv.DictReader(io.StringIO(written["report.csv"])))[1]["skipped"] == "1"


def test_a_folder_that_belongs_to_no_cell_fills_none(tmp_path):
    for controller, seed in (("lqr", 0), ("lqr", 1), ("convex", 1)):
        add(tmp_path, controller, seed, 0.1)
    plan(
        tmp_path,
        [
            chosen(controller, seed)[0]
            for controller in ("convex", "lqr")
            for seed in range(2)
        ],
    )
    for name in ("elsewhere", "controller=convex,horizon=3,seed=0"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_text("")
    convex, _ = cells(read_report(tmp_path))
    assert (seeds(convex, "missing"), seeds(convex, "skipped")) == (["0"], [])


def test_a_line_of_the_latex_table_never_begins_with_a_bracket(tmp_path):
    for steps in ("[1,2]", "[1]"):
        choices, settings = chosen("lqr", 0, steps=steps)
        made_up_run(tmp_path, choices, settings, result=metrics_of(0.1))
    lines = texts(read_report(tmp_path))["report.tex"].splitlines()
    assert any(line.startswith("{}[1,2] &") for line in lines)
    assert not any(line.lstrip().startswith("[") for line in lines)


def test_pairs_show_what_means_alone_do_not(tree):
    by_measure = {
        c.measure: c
        for c in compare(read_report(tree), "controller=lqr", "controller=convex")
    }
    rmse = by_measure["rmse"]
    assert rmse.pairs == 6
    assert rmse.wilcoxon == pytest.approx(
        2 ** (1 - 6)
    )  # every pair in one direction: the smallest p there is
    assert rmse.verdict == "A is larger than B"
    assert rmse.rank_biserial == 1
    assert rmse.interval[0] < rmse.difference < rmse.interval[1]
    text = sentences(read_report(tree), [rmse], "controller=lqr", "controller=convex")[
        1
    ]
    for word in ("Wilcoxon signed-rank p = 0.0312", "t-test", "rank-biserial", "n = 6"):
        assert word in text


def test_seeds_average_over_the_same_runs_and_name_the_others(tmp_path):
    def fly(controller, horizon, seed):
        choices = [f"controller={controller}", f"horizon={horizon}", f"seed={seed}"]
        settings = SETTINGS | {
            "seed": seed,
            "horizon": horizon,
            "options": {"controller": controller},
        }
        made_up_run(
            tmp_path,
            choices,
            settings,
            result=metrics_of(0.1 * horizon + 0.01 * (controller == "lqr")),
        )

    for seed in range(8):
        for controller in ("lqr", "convex"):
            for horizon in (1, 5):
                if (controller, horizon, seed) != ("lqr", 5, 7):
                    fly(controller, horizon, seed)
        fly("convex", 10, seed)  # lqr has but one of them
    fly("lqr", 10, 0)
    report = read_report(tmp_path)
    rmse = compare(report, "controller=lqr", "controller=convex")[0]
    assert rmse.left_out == ("horizon=10", "seed=7")
    assert rmse.pairs == 7
    assert rmse.medians == pytest.approx(
        (0.31, 0.3)
    )  # of the horizons 1 and 5 for every seed
    assert (
        "lacks runs of it: horizon=10; seed=7."
        in sentences(report, [rmse], "a", "b")[0]
    )
    assert compare(report, "horizon=1", "horizon=5")[0].left_out == ("seed=7",)
    alone = compare(
        report, "controller=convex,horizon=1", "controller=convex,horizon=5"
    )[0]
    assert alone.left_out == ()
    assert "Left out" not in sentences(report, [alone], "a", "b")[0]


def test_errors_of_both_subsystems_stay_in_their_own_units(tmp_path):
    for seed in range(6):
        for subsystem, unit in (("translational", "m"), ("rotational", "rad")):
            for controller in ("lqr", "convex"):
                choices = [
                    f"controller={controller}",
                    f"seed={seed}",
                    f"subsystem={subsystem}",
                ]
                settings = SETTINGS | {
                    "seed": seed,
                    "options": {"controller": controller, "subsystem": subsystem},
                }
                made_up_run(
                    tmp_path,
                    choices,
                    settings,
                    result=metrics_of(0.1 + 0.01 * seed) | {"unit": unit},
                )
    report = read_report(tmp_path)
    assert "RMSE [m or rad]" in texts(report)["report.md"]
    with pytest.raises(
        SettingError,
        match="errors in m and in rad have no common mean; compare runs",
    ):
        compare(report, "controller=lqr", "controller=convex")
    groups = [f"controller={name},subsystem=rotational" for name in ("lqr", "convex")]
    assert compare(report, *groups)[0].pairs == 6


def test_equal_groups_and_few_pairs_show_nothing(tmp_path):
    for seed in range(7):
        for controller in ("lqr", "convex"):
            add(tmp_path, controller, seed, 0.1 + 0.01 * seed)
    assert (
        compare(read_report(tmp_path), "controller=lqr", "controller=convex")[0].verdict
        == "no difference shown"
    )
    copies = tmp_path / "copies"
    for seed in range(7):
        add(copies, "lqr", seed, 0.2)
        add(copies, "convex", seed, 0.1)
    comparisons = compare(read_report(copies), "controller=lqr", "controller=convex")
    assert comparisons[0].verdict.startswith("undecided: every seed gave the same")
    assert (
        "p ="
        not in sentences(
            read_report(copies), comparisons[:1], "controller=lqr", "controller=convex"
        )[1]
    )
    few = tmp_path / "few"
    for seed in range(5):
        add(few, "lqr", seed, 0.2)
        add(few, "convex", seed, 0.1)
    assert (
        "5 pairs"
        in compare(read_report(few), "controller=lqr", "controller=convex")[0].verdict
    )


@pytest.mark.parametrize(
    ("group", "message"),
    [
        ("controler=lqr", "must choose among what was varied, controller"),
        ("controller=x", "varied over convex, lqr"),
    ],
)
def test_a_group_that_is_none_is_refused(tree, group, message):
    with pytest.raises(SettingError, match=message):
        compare(read_report(tree), group, "controller=lqr")


def test_what_is_no_tree_of_runs_is_refused(tmp_path):
    with pytest.raises(DataError, match="no such folder"):
        read_report(tmp_path / "nowhere")
    with pytest.raises(DataError, match="holds no run"):
        read_report(tmp_path)
    (tmp_path / "metrics.json").write_text('{"choices": []')
    with pytest.raises(DataError, match=r"metrics.json: is not what a run writes"):
        read_report(tmp_path)


def test_a_thousand_runs_are_reported_in_little_time_and_memory(tmp_path):
    with initialize_config_dir(str(CONF), version_base="1.3"):  # as large as real ones
        settings = OmegaConf.to_container(compose("run"), resolve=True)
    content = record_of(settings | {"options": {}}) | metrics_of(0.1)
    for seed in range(50):
        for size in (10, 20, 50, 100, 189):
            for horizon in (1, 3, 5, 10):
                content["choices"] = [
                    f"data.size={size}",
                    f"horizon={horizon}",
                    f"seed={seed}",
                ]
                folder = folder_of(tmp_path, content["choices"])
                folder.mkdir()
                (folder / "metrics.json").write_text(json.dumps(content, indent=1))
    tracemalloc.start()
    start = time.process_time()
    report = read_report(tmp_path)
    documents(report)
    seconds, (_, peak) = time.process_time() - start, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert sum(len(seeds(cell, "finished")) for cell in cells(report)) == 1000
    assert len(report.cells) == 20
    assert seconds < 20
    assert peak < 1e9


def test_a_page_says_what_made_the_runs_and_links_them(tree):
    settings = SETTINGS | {"horizon": 5, "options": {"controller": "nmpc"}}
    made_up_run(
        tree, ["controller=nmpc", "horizon=5"], settings, result=metrics_of(0.1)
    )
    report = read_report(tree)
    html = texts(report)["report.html"]
    links = re.findall(r'href="([^"]*)"', html)
    assert len(links) == len(report.ended) == 16
    assert all((tree / "report" / unquote(link)).resolve().is_dir() for link in links)
    provenance = record_of({})["provenance"]
    for text in (
        provenance["created"][:10],
        provenance["machine"]["processor"],
        "Settings of all runs",
        "data.size: null",
    ):
        assert text in html
    assert "horizon: " not in "\n".join(report.base_settings())  # it was varied


@pytest.mark.parametrize(
    ("positions", "scale", "places"),
    [
        (["1", "5", "20"], "log", [1, 5, 20]),
        (["25", "50", "100"], "linear", [25, 50, 100]),
        (["0", "0.5"], "linear", [0, 0.5]),
        (["-1", "10"], "linear", [-1, 10]),
        (["convex", "lqr"], "linear", [0, 1]),
        (["5", "null"], "linear", [0, 1]),
        (["7"], "linear", [7]),
    ],
)
def test_an_axis_places_numbers_by_value_and_words_in_order(positions, scale, places):
    lines = [Series(name, [[1.0, 2.0]] * len(positions)) for name in ("a", "b")]
    (axis,) = over_variable("x", positions, "y", lines).axes
    assert axis.get_xscale() == scale
    assert axis.get_xticks() == pytest.approx(places)
    assert [label.get_text() for label in axis.get_xticklabels()] == positions
    low, high = axis.get_xlim()
    assert all(low < x < high for line in axis.lines for x in line.get_xdata())


def test_no_size_means_all_rows(tmp_path):
    for size in ("25", "null"):
        choices, settings = chosen("convex", 0, **{"data.size": size})
        settings["data"] = {"size": None if size == "null" else int(size)}
        made_up_run(tmp_path, choices, settings, result=metrics_of(0.1))
    report = read_report(tmp_path)
    assert report.variables == ("data.size",)
    html = texts(report)["report.html"]
    assert re.search(r"<td[^>]*>all</td>", html)
    assert not re.search(r"<td[^>]*>null</td>", html)


def test_runs_of_equal_choices_in_two_folders_are_named(tmp_path):
    for folder, error in (("a", 0.1), ("b", 0.2)):
        for seed in range(2):
            add(tmp_path / "out" / folder, "convex", seed, error)
    add(tmp_path / "out" / "a", "convex", 2, 0.1)
    report = read_report(tmp_path / "out")
    assert report.runs.rmse.round(6).nunique() == 2
    a, b = tmp_path / "out" / "a", tmp_path / "out" / "b"
    line = f"2 finished in {a}: runs of {b} have the same choices and seeds, "
    line += f"and are shown; gpmpc report {a} shows them"
    assert notes(report) == {"Repeated": [line]}
    assert notes(read_report(a)) == {}


def test_a_setting_that_is_left_out_is_a_choice(tmp_path):
    add(tmp_path / "tree", "convex", 0, 0.1)
    without = ["seed=0", "~noise"]
    made_up_run(tmp_path / "tree", without, SETTINGS, result=metrics_of(0.2))
    plan(tmp_path / "tree", [["seed=0", "~noise"], ["seed=1", "~noise"]])
    report = read_report(tmp_path / "tree")
    assert (report.runs.state == "finished").sum() == 2
    assert "left out" in undrawn(report).markdown()
    (command,) = report.commands()
    assert command.endswith(f"'~noise' seed=1 folder={tmp_path / 'tree'}")


def test_a_command_names_a_folder_as_hydra_reads_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parser = OverridesParser.create()
    whole = [tmp_path / name for name in ("a,b", "x(1)", "it's", "plain-1.5", "nul")]
    numbers_and_words = map(Path, ("1", "1e5", ".5", "true", "null", "inf"))
    for tree in (*whole, tmp_path / "ü", *numbers_and_words):
        plan(tree, [["seed=1"], ["seed=2"]])
        add(tree, "convex", 1, 0.1)
        (command,) = read_report(tree).commands()
        *_, word = shlex.split(command)
        folder = parser.parse_override(word).value()
        assert getattr(folder, "text", folder) == str(tree)


def fly(tree, choices, unit="m", error=0.1, command="gpmpc run", **settings):
    """Leaves a finished run whose settings hold what it chose."""
    settings = SETTINGS | settings
    result = metrics_of(error) | {"unit": unit}
    made_up_run(tree, choices, settings, result=result)
    path = folder_of(tree, choices) / "metrics.json"
    content = json.loads(path.read_text())
    content["provenance"]["command"] = command
    path.write_text(json.dumps(content))


def test_runs_of_one_cell_that_have_other_settings_are_told(tmp_path):
    for seed in range(5):
        choices = [f"seed={seed}"]
        own = {"seed": seed, "model": {"seed": seed, "rows": f"rows_{seed}.csv"}}
        own["model"]["restarts"] = 3  # which is a seed, too
        own["model"]["starts"] = [seed, 7]
        if seed > 2:
            own["offset"] = None  # as where it is absent
        steps = 200 if seed > 2 else 100
        fly(tmp_path / "mixed", choices, **own, steps=steps)
        fly(tmp_path / "alike", choices, **own)
    assert notes(read_report(tmp_path / "alike")) == {}
    report = read_report(tmp_path / "mixed")
    line = "runs of one cell differ in what nobody chose on the command line, and "
    line += "their median is of different studies: steps (100 of 3, 200 of 2)"
    assert notes(report) == {"Mixed settings": [line]}
    assert line in texts(report)["report.md"]


@pytest.mark.parametrize(
    "typed", ["gain=0", "++gain=0.0", "gain='0'", "gain=${zero}", "+gain=0e3"]
)
def test_one_value_is_one_cell_however_it_was_typed(typed, tmp_path):
    for seed in range(2):
        fly(tmp_path, [typed, f"seed={seed}"], seed=seed, gain=0)
        fly(tmp_path, ["gain=3e-1", f"seed={seed}"], seed=seed, gain=0.3)
    fly(tmp_path, ["seed=2"], seed=2, gain=0.0)
    fly(tmp_path, ["gain=0.30", "seed=2"], seed=2, gain=0.3)
    report = read_report(tmp_path)
    assert report.variables == ("gain",)
    assert report.cells == (("0",), ("0.3",))
    assert [len(cell) for cell in cells(report)] == [3, 3]
    assert compare(report, "gain=0.0", "gain=3e-1")[0].pairs == 3


def test_missing_runs_fly_with_the_settings_asked_for(tmp_path):
    for seed in range(2):
        fly(tmp_path, ["system=pendulum", f"seed={seed}"], seed=seed, horizon=30)
        choices = ["horizon=5", "system=pendulum", f"seed={seed}"]
        fly(tmp_path, choices, seed=seed, horizon=5)
    plan(tmp_path, [["seed=0", "system=acrobot"], ["seed=1", "system=acrobot"]])
    report = read_report(tmp_path)
    # An acrobot's own horizon is not known here: it is not that of a pendulum.
    assert ("default", "acrobot") in report.cells
    (command,) = report.commands()
    assert command == f"gpmpc run -m system=acrobot seed=0,1 folder={tmp_path}"


def test_errors_of_different_units_are_in_no_common_number(tmp_path, monkeypatch):
    for gain in range(2):
        for i, unit in enumerate(3 * ["rad", "mol/L", "m"]):
            system = f"system_{i}"
            choices = [f"gain={gain}", f"system={system}"]
            fly(tmp_path, choices, unit, gain=gain, options={"system": system})
            # An older version measured another state, and in another unit.
            fly(tmp_path, [*choices, "seed=1"], "m", seed=1, gain=gain)
    report = read_report(tmp_path)
    assert report.variables == ("gain", "system", "unit")
    assert all(len({*cell.unit}) == 1 for cell in cells(report))
    lines = undrawn(report).csv().splitlines()
    assert lines[0].startswith("gain,system,unit,finished")
    series = []
    monkeypatch.setattr(
        reporting, "over_variable", lambda *arguments: series.append(arguments[3])
    )
    monkeypatch.setattr(reporting, "png", lambda figure: b"")
    images = report_document(report).images
    assert not [name for name in images if "over-unit" in name]
    over_gain = [line.label for line in series[0]]
    assert {*over_gain} == {"unit=m", "unit=mol/L", "unit=rad"}


def test_options_that_are_no_words_of_a_command_are_told(tmp_path):
    add(tmp_path, "lqr", 0, 0.1)
    content = {"runs": [["seed=1"]], "search_options": "--config-dir 'x"}
    (tmp_path / "sweep-1.json").write_text(json.dumps(content))
    (line,) = read_report(tmp_path).skipped
    assert line.endswith("is not what a sweep writes: ValueError: No closing quotation")


def test_runs_behind_links_are_found_once(tmp_path):
    tree = tmp_path / "tree"
    for seed in range(2):
        add(tree, "lqr", seed, 0.1)
        (folder_of(tree, chosen("lqr", seed)[0]) / "run.mcap").touch()
    plan(tree, [chosen("lqr", seed)[0] for seed in range(2)])
    moved = folder_of(tree, chosen("lqr", 1)[0])
    moved.rename(tmp_path / "elsewhere")
    moved.symlink_to(tmp_path / "elsewhere")
    (tree / "a_best").symlink_to(folder_of(tree, chosen("lqr", 0)[0]))
    (tmp_path / "elsewhere" / "all").symlink_to(tmp_path)
    report = read_report(tree)
    assert [*report.runs.state] == ["finished", "finished"]
    assert report.repeated == ()
    judged = called("calibrate", "tree", cwd=tmp_path)
    assert judged.stderr.startswith("gpmpc: tree: holds 2 runs")
