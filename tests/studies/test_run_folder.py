"""Folders of runs have own names, and two runs' different settings are put in words."""

import errno
import json
import os
import socket
from itertools import combinations

import pytest

from gpmpc.exceptions import DataError, SettingError
from gpmpc.studies._run_folder import (
    ERROR,
    LONGEST_NAME,
    METRICS,
    Busy,
    RunFolder,
    RunState,
    difference,
    folder_name,
    of_other_code,
    run_header,
)


def test_other_choices_have_another_folder_ignoring_case():
    many = [
        [],
        ["a=1"],
        ["a=1", "b=2"],
        ["a=1,b=2"],
        ["a=1,b", "2"],
        ["a=[1,2]"],
        ["a=[1, 2]"],
        ["a=1 2"],
        ["a=1_2"],
        ["A=1"],
        ["a=1/2"],
        ["a=1:2"],
        ["x=" + 300 * "y"],
        ["x=" + 301 * "y"],
        ["a=ä"],
        ["a=ö"],
    ]
    names = [folder_name(choices) for choices in many]
    assert len({name.lower() for name in names}) == len(many)
    assert all(len(name) < 200 and not set(name) & set('/\\:*?"<>| ') for name in names)
    assert folder_name(["b=2", "a=1"]) == folder_name(["a=1", "b=2"]) == "a=1,b=2"
    assert folder_name([]) == "default"


@pytest.mark.parametrize(
    ("then", "now", "words"),
    [
        ({"a": {"b": 1}}, {"a": {"b": 1}}, ""),
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}, "a.c: 2 then, 3 now"),
        ({"a": {"b": 1}}, {"a": None}, "a.b: 1 then, None now"),
        ({"a": 1}, {"a": {"b": 1}}, "a: 1 then, None now, a.b: None then, 1 now"),
        ({"a": 1}, {"b": 2}, "a: 1 then, None now, b: None then, 2 now"),
        (
            {"a": 0, "b": 0, "c": 0},
            {"a": 1, "b": 1, "c": 1},
            "a: 0 then, 1 now, b: 0 then, 1 now, c: 0 then, 1 now",
        ),
        (
            {"a": 0, "b": 0, "c": 0, "d": 0, "e": 0},
            {"a": 1, "b": 1, "c": 1, "d": 1, "e": 1},
            "a: 0 then, 1 now, b: 0 then, 1 now, c: 0 then, 1 now, and 2 more",
        ),
    ],
)
def test_the_first_three_differences_are_named(then, now, words):
    assert difference(then, now) == words


def test_settings_differ_from_none_but_themselves():
    settings = [{"a": {"b": value}} for value in (None, 0, 1, "0", [0], {"c": 0})]
    assert all(difference(one, other) for one, other in combinations(settings, 2))
    assert not any(difference(one, one) for one in settings)


def test_a_failure_is_kept_with_its_kind_and_where_it_was_raised(tmp_path):
    folder = RunFolder(tmp_path / "runs" / "one")
    assert folder.failed_at is None
    folder.path.mkdir(parents=True)
    half_written = folder.path / ".metrics.json.7.partial"
    half_written.touch()
    with folder.locked():
        assert not half_written.exists()
        try:
            raise ZeroDivisionError("too\n  bad")
        except ZeroDivisionError as error:
            folder.fail(error, {"seed": 3})
    content = json.loads((folder.path / ERROR).read_text())
    assert (content["seed"], content["error"], content["kind"]) == (
        3,
        "too bad",
        "ZeroDivisionError",
    )
    assert content["traceback"].startswith("Traceback (most recent call last)")
    assert content["traceback"].endswith("ZeroDivisionError: too\n  bad\n")
    assert folder.failed_at == (folder.path / ERROR).stat().st_mtime_ns
    folder.fail(ValueError(), {})
    assert json.loads((folder.path / ERROR).read_text())["error"] == "ValueError"
    folder.begin("steps: 1\n")
    assert (folder.path / "config.yaml").read_text() == "steps: 1\n"
    assert not (folder.path / ERROR).exists()


def test_a_result_of_other_settings_or_none_is_refused(tmp_path):
    folder = RunFolder(tmp_path)
    about = run_header(["b=2", "a=1"], {"seed": 7, "steps": 3}, "gpmpc run")
    folder.finish(about)
    assert (
        folder.result()
        == folder.result({"seed": 7, "steps": 3})
        == json.loads(json.dumps(about))
    )
    assert (about["choices"], about["seed"], about["schema"]) == (["b=2", "a=1"], 7, 1)
    assert about["provenance"]["command"] == "gpmpc run"
    with pytest.raises(
        SettingError,
        match=r"finished run of other settings \(steps: 3 then, 4 now\); choose "
        r"another",
    ):
        folder.result({"seed": 7, "steps": 4})
    for text in ("", "[]", "{}", '{"settings": '):
        (tmp_path / METRICS).write_text(text)
        with pytest.raises(
            DataError, match=r"metrics\.json: is not what a run writes: \w+: "
        ):
            folder.result()
    (tmp_path / METRICS).unlink()
    with pytest.raises(DataError, match="FileNotFoundError"):
        folder.result()


def test_what_flew_a_run_is_told_as_far_as_it_says_so():
    settings = {"seed": 7}
    about = run_header([], settings, "gpmpc run")
    assert of_other_code(about) == ""
    said = {
        "gpmpc 1.2": {"versions": {"gpmpc": "1.2"}},
        "gpmpc 1.2, commit 0123456789, changed": {
            "versions": {"gpmpc": "1.2"},
            "git": {"commit": "0123456789abcdef", "dirty": True},
        },
        "a gpmpc that did not say which": {"code": "0" * 32, "git": None},
    }
    for words, made in said.items():
        assert of_other_code({"settings": settings, "provenance": made}) == words
    for damaged in (None, 5, [], {"versions": 1, "git": "x"}, {"own_code": 3}):
        content = {"settings": settings, "provenance": damaged}
        assert of_other_code(content) == "a gpmpc that did not say which"
    assert of_other_code({}) == "a gpmpc that did not say which"


def test_a_name_is_the_choices_as_long_as_it_is_short_and_plain():
    assert folder_name(["a=" + "x" * (LONGEST_NAME - 2)]) == "a=" + "x" * (
        LONGEST_NAME - 2
    )
    longer = folder_name(["a=" + "x" * (LONGEST_NAME - 1)])
    assert len(longer) == LONGEST_NAME + 11
    assert longer.startswith("a=" + "x" * (LONGEST_NAME - 2) + "-")
    assert folder_name(["a=[1]+2-3.5@b"]) == "a=[1]+2-3.5@b"


def test_a_folder_alone_tells_how_far_its_run_is(tmp_path):
    folder = RunFolder(tmp_path / "run")
    assert folder.state is RunState.NOT_BEGUN
    assert (folder.begun_at, folder.last_worker) == (None, "")
    with folder.locked():
        assert folder.state is RunState.RUNNING
        folder.begin("steps: 1\n")
        assert folder.state is RunState.RUNNING
        assert folder.last_worker == f"process {os.getpid()} on {socket.gethostname()}"
        with pytest.raises(Busy):
            folder.end_from_outside("the node failed", "node", {})
    assert folder.state is RunState.ABANDONED  # left as by a process that was killed
    assert folder.begun_at == (folder.path / "config.yaml").stat().st_mtime_ns
    with folder.locked():
        folder.fail(ValueError("no"), {})
    assert folder.state is RunState.FAILED
    for name in ("run.mcap", "episode_1.mcap", "mine.mcap"):
        (folder.path / name).touch()
    with folder.locked():
        folder.begin("steps: 1\n")
        assert [path.name for path in folder.path.glob("*.mcap")] == ["mine.mcap"]
        assert folder.state is RunState.RUNNING
        folder.finish({"settings": {}})
    assert folder.state is RunState.FINISHED
    folder.end_from_outside("too late", "time", {})
    assert folder.state is RunState.FINISHED
    assert not (folder.path / ERROR).exists()


def test_who_may_only_read_a_run_sees_whether_it_flies(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    opened = os.open

    def read_only(path, flags, *rest):
        if flags & os.O_RDWR:
            raise OSError(errno.EROFS, "read-only")
        return opened(path, flags, *rest)

    with folder.locked():
        folder.begin("steps: 1\n")
        monkeypatch.setattr(os, "open", read_only)
        assert folder.state is RunState.RUNNING
    assert folder.state is RunState.ABANDONED


def test_attempts_that_were_ended_from_outside_are_counted(tmp_path):
    folder = RunFolder(tmp_path / "run")
    for count in (1, 2):
        folder.end_from_outside("over its memory", "memory", {"choices": ["a=1"]})
        content = json.loads((folder.path / ERROR).read_text())
        assert content["choices"] == ["a=1"]
        assert (content["error"], content["kind"]) == ("over its memory", "memory")
        assert content["attempts"] == folder.outside_attempts == count
        with folder.locked():
            folder.begin("steps: 1\n")
        assert folder.outside_attempts == count
    with folder.locked():
        folder.fail(ValueError("of its own"), {})
    assert folder.outside_attempts == 0
    with folder.locked():
        folder.begin("steps: 1\n")
        folder.finish({"settings": {}})
    assert folder.outside_attempts == 0


def test_settings_of_nan_do_not_differ_from_themselves():
    def settings(bias):
        return {"noise": {"std": float("nan")}, "gains": [{"a": float("nan")}, bias]}

    assert difference(settings(2.0), settings(2)) == ""
    assert difference(settings(2.0), settings(3)).startswith(
        "gains: [{'a': nan}, 2.0] "
    )


def test_one_process_works_on_a_folder_until_it_has_metrics(tmp_path):
    folder = RunFolder(tmp_path / "run")
    with folder.locked():
        with pytest.raises(Busy), RunFolder(tmp_path / "run").locked(wait=False):
            pass
        folder.fail(ValueError("no\nluck"), {})
        assert not folder.finished
        assert folder.failed_at
        folder.begin("steps: 1")
        assert folder.failed_at is None
        folder.finish({"rmse": 1, "settings": {}})
    assert folder.finished
    assert folder.result() == {"rmse": 1, "settings": {}}
    with folder.locked(wait=False):
        pass
    assert sorted(path.name for path in folder.path.iterdir()) == [
        ".lock",
        "config.yaml",
        "metrics.json",
    ]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (["a=x/y"], ["a=x_y"]),
        (["a=X"], ["a=x"]),
        (["a=" + "1" * 300], ["a=" + "1" * 301]),
        (["a=1", "b=2"], ["a=1,b=2"]),
    ],
    ids=["characters", "case", "length", "commas"],
)
def test_folders_of_different_choices_never_collide(one, other):
    names = [folder_name(choices) for choices in (one, other)]
    assert names[0].lower() != names[1].lower()
    assert all(len(name) < 200 and "/" not in name for name in names)


def test_the_order_of_choices_does_not_matter_for_the_name():
    assert folder_name(["b=2", "a=1"]) == folder_name(["a=1", "b=2"]) == "a=1,b=2"
