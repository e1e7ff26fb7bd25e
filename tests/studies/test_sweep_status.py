"""How far a sweep is: states, reasons and speed, from its folders alone."""

import json
import os
import time
from argparse import Namespace

import pytest

from gpmpc.cli._status import status
from gpmpc.exceptions import DataError
from gpmpc.studies._run_folder import PLAN_PREFIX, RunFolder, RunState, lock_held
from gpmpc.studies._sweep_status import SweepStatus, SweepWatch
from tests.studies.made_up import plan


def run(tree, name, *names, error=None, ended=None):
    """Makes a folder with some files."""
    folder = tree / name
    folder.mkdir(parents=True)
    for file in names:
        content = {"error": error} if file == "error.json" else {}
        (folder / file).write_text(json.dumps(content))
        if ended is not None:
            os.utime(folder / file, (ended, ended))
    return RunFolder(folder)


@pytest.fixture
def tree(tmp_path):
    tree = tmp_path / "sweep"
    plan(tree, [[f"seed={seed}"] for seed in range(12)])
    for seed in range(4):
        ended = time.time() - 40 + 10 * seed
        run(tree, f"seed={seed}", "config.yaml", "metrics.json", ended=ended)
    errors = ["size must be at most 25; got 99", "size must be at most 25; got 98", "x"]
    for seed, error in enumerate(errors, start=4):
        run(tree, f"seed={seed}", "config.yaml", "error.json", error=error, ended=9.0)
    run(tree, "seed=7", "config.yaml")
    (tree / "report").mkdir()
    (tree / ".slurm").mkdir()
    return tree


def test_runs_are_counted_by_their_state(tree):
    with RunFolder(tree / "seed=8").locked():
        status = SweepWatch(tree).look()
    assert status.counts == {
        RunState.FINISHED: 4,
        RunState.FAILED: 3,
        RunState.RUNNING: 1,
        RunState.ABANDONED: 1,
        RunState.NOT_BEGUN: 3,
    }
    assert status.total == 12
    assert status.left == 5
    assert status.failures == {"size must be at most 25; got 98": 2, "x": 1}
    assert status.rate == pytest.approx(3 / 40, rel=0.05)
    assert status.seconds_left == pytest.approx(5 / status.rate)
    assert status.line() == (
        "12 runs: 4 finished, 3 failed, 1 running, 1 abandoned, 3 to fly; "
        f"{60 * status.rate:.3g} a minute, 0:01:07 left; "
        "2 failed: size must be at most 25; got 98; 1 failed: x"
    )


def test_reasons_of_equal_counts_stand_in_the_order_of_runs(tmp_path):
    reasons = [f"reason {letter}" for letter in "hgfedcba"]
    for i, reason in enumerate(reasons):
        run(tmp_path, f"seed={i}", "config.yaml", "error.json", error=reason)
    assert [*SweepWatch(tmp_path).look().failures] == reasons


def test_each_look_sees_what_has_changed(tree):
    watch = SweepWatch(tree)
    assert watch.look().counts[RunState.FAILED] == 3
    (tree / "seed=4" / "error.json").write_text('{"error": "another"}')
    os.rename(tree / "seed=7" / "config.yaml", tree / "seed=7" / "metrics.json")
    (tree / f"{PLAN_PREFIX}1.json").write_text('{"runs": [["seed=99"], ["seed=1"]]}')
    status = watch.look()
    assert status.total == 13
    assert status.counts[RunState.FINISHED] == 5
    assert set(status.failures) == {"another", "size must be at most 25; got 98", "x"}
    assert status.active


@pytest.mark.parametrize("ago", [300, -7200], ids=["then", "by a clock ahead"])
def test_nobody_works_on_a_sweep_that_was_stopped(ago, tmp_path):
    plan(tmp_path, [["seed=0"], ["seed=1"]])
    run(tmp_path, "seed=0", "metrics.json", ended=time.time() - ago)
    status = SweepWatch(tmp_path).look()
    assert not status.active
    assert status.seconds_left is None
    assert (
        status.line() == "2 runs: 1 finished, 0 failed, 1 to fly; nobody works on them"
    )
    assert SweepWatch(tmp_path, has_jobs=lambda _: True).look().active
    with lock_held(tmp_path / f"{PLAN_PREFIX}0.json"):
        assert SweepWatch(tmp_path).look().active


def test_who_asks_for_data_does_not_wait_for_the_end(tree, monkeypatch):
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("it waits"))
    result = status(Namespace(tree=tree, as_json=True))
    assert result.data["running"] == 0


def test_sweeps_below_a_folder_are_counted_together(tree):
    plan(tree.parent / "other", [["seed=0"], ["seed=1"]])
    (tree.parent / "other" / f"{PLAN_PREFIX}damaged.json").write_text("{")
    # a sweep below another, as of the best candidate of a search
    run(tree / "best", "default", "config.yaml", "metrics.json", ended=time.time())
    (tree.parent / f"{PLAN_PREFIX}notes.txt").touch()
    assert SweepWatch(tree.parent).look().total == 15


def test_a_folder_without_runs_is_a_mistake(tmp_path):
    for folder, message in (
        ("", "holds no sweep, and no run"),
        ("x", "no such folder"),
    ):
        with pytest.raises(DataError, match=message):
            SweepWatch(tmp_path / folder).look()


@pytest.mark.parametrize(
    ("rate", "left", "text"),
    [
        (2.0, 7200, "2 a second, 1:00:00 left"),
        (0.1, 6, "6 a minute, 0:01:00 left"),
        (1 / 1800, 2, "2 an hour, 1:00:00 left"),
        (None, 2, "no run has ended yet"),
    ],
)
def test_the_speed_is_told_in_a_unit_that_fits(rate, left, text):
    counts = dict.fromkeys(RunState, 0) | {RunState.NOT_BEGUN: left}
    assert SweepStatus(counts, {}, rate, active=True).speed() == text
