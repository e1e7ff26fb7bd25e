"""The index of a tree of runs: it saves reading, and is never believed too much."""

import json
import os
import shutil

import pytest

from gpmpc.studies import _index
from gpmpc.studies._index import INDEX, RunIndex
from gpmpc.studies._run_folder import PLAN_PREFIX
from gpmpc.studies.report import read_report
from tests.studies.made_up import chosen, made_up_run, metrics_of, undrawn


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    tree = tmp_path_factory.mktemp("index") / "tree"
    for controller, error in (("convex", 0.1), ("lqr", 0.3)):
        for seed in range(3):
            result = metrics_of(error + 0.01 * seed)
            made_up_run(tree, *chosen(controller, seed), result=result)
    made_up_run(tree, *chosen("lqr", 7), error="data.size: must be at most 3")
    return tree


@pytest.fixture
def tree(template, tmp_path):
    shutil.copytree(template, tmp_path / "tree")
    return tmp_path / "tree"


def files(tree):
    document = undrawn(read_report(tree))
    made = [
        line for line in document.markdown().splitlines() if "Report made" not in line
    ]
    return made, document.csv()


@pytest.fixture
def reads(monkeypatch):
    """Paths of the results that were read."""
    paths = []
    original = _index.read_record
    monkeypatch.setattr(
        _index,
        "read_record",
        lambda path, content: paths.append(path) or original(path, content),
    )
    return paths


def lines(tree):
    return [json.loads(line) for line in (tree / INDEX).read_text().splitlines()]


def test_a_second_report_is_the_same_and_reads_no_result(tree, reads):
    first = files(tree)
    assert len(reads) == 7
    assert sum("run" in line for line in lines(tree)) == 7
    reads.clear()
    assert files(tree) == first
    assert reads == []
    (tree / INDEX).unlink()
    assert files(tree) == first
    assert len(reads) == 7


def test_what_has_changed_is_read_again(tree, reads):
    before = files(tree)
    folder = sorted(tree.glob("*/metrics.json"))[0].parent
    content = json.loads((folder / "metrics.json").read_text())
    content["rmse"]["total"] = 99.0
    (folder / "metrics.json").write_text(json.dumps(content))
    shutil.rmtree(sorted(tree.glob("*/metrics.json"))[1].parent)
    reads.clear()
    report = read_report(tree)
    assert [path.parent for path in reads] == [folder]
    assert 99.0 in report.runs.rmse.tolist()
    assert len(report.runs) == 6
    assert files(tree) != before
    assert len(lines(tree)) == 1 + 7 + 1  # settings, runs, the changed one


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace(
            '"measures": {', '"measures": {"rmse": 1e999, "x":', 1
        ),
        lambda text: text.replace('"training": ', '"lessons": '),
        lambda text: text.replace('"base"', '"bass"'),
        lambda text: "\x00\xff\n[]\n3\n{}\n" + text,
        lambda text: text.replace("finished", "\x1b[31m"),
        lambda text: "",
    ],
)
def test_a_damaged_index_changes_nothing(tree, damage):
    first = files(tree)
    text = (tree / INDEX).read_text()
    (tree / INDEX).write_text(damage(text), errors="surrogateescape")
    assert files(tree) == first
    assert files(tree) == first  # and what was added behind it is read


def test_texts_of_an_index_are_printable(tree):
    read_report(tree)
    text = (tree / INDEX).read_text()
    (tree / INDEX).write_text(text.replace("must be at most", r"\u001b[31m\n"))
    report = read_report(tree)
    assert all(error.isprintable() for error in report.runs.error)


def test_a_tree_that_cannot_be_written_is_read(tree, monkeypatch):
    def refuse(*arguments):
        raise PermissionError("read-only")

    first = files(tree)
    (tree / INDEX).unlink()
    monkeypatch.setattr(os, "pread", refuse)
    monkeypatch.setattr(_index, "lock_descriptor", refuse)
    assert files(tree) == first


def test_two_writers_add_their_lines(tree):
    one, two = RunIndex(tree), RunIndex(tree)
    paths = sorted(tree.glob("*/metrics.json"))
    for index, path in zip((one, two, one, two), paths, strict=False):
        index.add(path, fingerprint="x")
        index.write()
    third = RunIndex(tree)
    for path in paths[:4]:
        record = third.record_with(path, "x")
        assert record.folder == path.parent
    assert third.record_with(paths[3], "y") is None
    assert third.record_with(paths[4], "x") is None


def test_runs_below_several_folders_have_an_index_each(tree, reads):
    shutil.copytree(tree, tree / "below" / "sweep")
    (tree / "below" / "sweep" / f"{PLAN_PREFIX}1.json").write_text(
        '{"runs": [["seed=9"]]}'
    )
    first = files(tree)
    assert (tree / "below" / "sweep" / INDEX).exists()
    reads.clear()
    assert files(tree) == first
    assert reads == []
