"""``gpmpc tune`` as a user meets it: the best command, resumption, clear mistakes."""

import errno
import json
import math
import re
import shlex
from argparse import Namespace
from types import SimpleNamespace

import hydra
import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from rich.console import Console

from gpmpc.cli import _tune
from gpmpc.cli._settings import settings_folders
from gpmpc.cli._sweep import JobOutcome, Sweep
from gpmpc.cli._tune import Tuning, _cost
from gpmpc.exceptions import DataError
from gpmpc.studies._document import json_text
from tests.cli.command import forked
from tests.recording import runs

pytest.importorskip("optuna")

TINY = ["data.samples=25", "model.restarts=0", "steps=4"]
SEARCHED = [
    "controller=convex,lqr",
    "controller.problem.cost.R.1=tag(log,interval(0.01,100))",
    "horizon=int(interval(1,4))",
]


def tune(folder, trials, cwd):
    done = forked(
        "tune",
        *TINY,
        *SEARCHED,
        "--trials",
        trials,
        "--batch",
        "2",
        f"folder={folder}",
        "--json",
        cwd=cwd,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_search_resumes_and_its_best_settings_fly(tmp_path):
    tune("tree", "2", tmp_path)
    flown = {
        path: path.stat().st_mtime_ns for path in tmp_path.glob("tree/*/metrics.json")
    }
    assert 2 <= len(flown) <= 3
    older = next(iter(flown))
    content = json.loads(older.read_text())
    content["provenance"]["code"] = "0" * 32
    older.write_text(json.dumps(content))
    flown[older] = older.stat().st_mtime_ns
    resumed = tune("tree", "4", tmp_path)
    assert resumed["of_other_code"] == [str(older.parent.relative_to(tmp_path))]
    assert all(path.stat().st_mtime_ns == before for path, before in flown.items())
    whole = tune("whole", "4", tmp_path)
    assert (tmp_path / "tree" / "tuning.csv").read_text() == (
        tmp_path / "whole" / "tuning.csv"
    ).read_text()
    assert (resumed["best"], resumed["cost"]) == (whole["best"], whole["cost"])
    assert (tmp_path / "tree" / "tuning.png").read_bytes().startswith(b"\x89PNG")
    program, *arguments = shlex.split(resumed["command"])
    assert program == "gpmpc"
    composed = json.loads(forked(*arguments, "--cfg", "--json", cwd=tmp_path).stdout)
    assert composed["steps"] == 4
    assert composed["horizon"] == resumed["best"]["horizon"]
    assert (
        composed["controller"]["problem"]["cost"]["R"][1]
        == resumed["best"]["controller.problem.cost.R.1"]
    )
    kind = {"convex": "GPMPC", "lqr": "LQR"}[resumed["best"]["controller"]]
    assert composed["controller"]["_target_"].endswith(f".{kind}")
    again = forked(*arguments, "--json", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    totals = [
        json.loads(path.read_text())["rmse"]["total"]
        for path in tmp_path.glob("tree/*/metrics.json")
    ]
    assert json.loads(again.stdout)["rmse"]["total"] in totals


@pytest.mark.parametrize("some_fly", [True, False])
def test_flights_that_failed_are_told_and_cost_no_number(
    some_fly, tmp_path, monkeypatch, capsys
):
    def fly(sweep, jobs):
        failing = [job for job in jobs if "horizon=1" in job.choices]
        return [JobOutcome(str(job.folder.path), "its process died") for job in failing]

    def cost(job, controller):
        return 1.0 if some_fly and "horizon=1" not in job.choices else math.inf

    monkeypatch.setattr(Sweep, "fly", fly)
    monkeypatch.setattr(_tune, "_cost", cost)
    arguments = Namespace(
        config_name="tune",
        overrides=[*TINY, "horizon=1", "horizon=2,3", f"folder={tmp_path}"],
        trials=2,
        batch=1,
        seeds=1,
    )
    with settings_folders():
        result = _tune.tune(arguments)
    (failed,) = result.data["failed"]
    said = capsys.readouterr().err.splitlines()
    assert said[0] == f"gpmpc: failed: {failed['folder']}: its process died"
    assert result.code == 1
    if not some_fly:
        assert said[1:] == [f"gpmpc: tune: {result.data['error']}"]
        return
    assert len(said) == 1
    told = json.loads(json_text(result.data), parse_constant=pytest.fail)
    assert (told["unchanged"], told["cost"]) == (None, 1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "tune: names nothing to search, such as horizon=1,5,10"),
        (
            ["horizon=1,2", "--trials", "0"],
            "--trials: must be a whole number, 1 or more; got 0",
        ),
        (["seed=1,2"], "seed: cannot be searched; seeds are many by --seeds"),
        (["horizon=1,2", "recorder=none"], "recorder: must be mcap"),
        (["horizon=1,2", "steps=1"], "steps: must be 2 or more"),
        (["steps=1,50"], "steps: must be 2 or more"),
        (["recorder=mcap,none"], "recorder: cannot be searched"),
        (["++recorder=mcap,none"], "recorder: cannot be searched"),
        (["++seed=1,2"], "seed: cannot be searched"),
        (
            ["controller.tolerance=interval(2,1)"],
            "controller.tolerance: must rise; got",
        ),
        (
            ["controller.tolerance=tag(log,interval(0,1))"],
            "controller.tolerance: must rise, from above 0; got",
        ),
        (
            ["controller.problem.cost.R.7=interval(1,2)"],
            "controller.problem.cost.R.7: controller.problem.cost.R is no list with",
        ),
        (["horizn=1,2"], "unknown setting 'horizn' (did you mean 'horizon'?)"),
        (
            ["horizon=0,1", "--trials", "3"],
            "horizon: must be a whole number, 1 or more; got 0",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_clear_line(arguments, message, tmp_path):
    done = forked("tune", *TINY, *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_flight_without_a_cost_is_told_and_ends_no_search(tmp_path, monkeypatch):
    with settings_folders():
        runs = Sweep("tune", [f"folder={tmp_path}"], Console(quiet=True))
        tuning = Tuning(runs, [f"folder={tmp_path}"], seeds=1)
        outcomes = []
        monkeypatch.setattr(runs, "check", lambda jobs: None)
        monkeypatch.setattr(
            runs, "fly", lambda jobs: [outcomes.pop(0)(job) for job in jobs]
        )

        def ends(error):
            return lambda job: JobOutcome(str(job.folder.path), error)

        def no_recording(job, controller):
            raise DataError("run.mcap: 5 of 20 steps are lost")

        monkeypatch.setattr(_tune, "_cost", lambda job, controller: 1.0)
        outcomes += [ends("its process died"), ends(None)]
        assert tuning.costs([{"horizon": 2}, {"horizon": 3}]) == [math.inf, 1.0]
        (failed,) = tuning.failed
        assert failed.error == "its process died"
        outcomes += [ends(None)]  # proposed again, and finished now
        assert tuning.costs([{"horizon": 2}]) == [1.0]
        assert tuning.failed == []
        monkeypatch.setattr(_tune, "_cost", no_recording)
        outcomes += [ends(None)]
        assert tuning.costs([{"horizon": 4}]) == [math.inf]
        (failed,) = tuning.failed
        assert "5 of 20 steps are lost; its folder has to be removed" in failed.error


def test_a_full_disk_ends_a_search_that_goes_on_later(tmp_path, monkeypatch, capsys):
    def fly(sweep, jobs):
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path))

    monkeypatch.setattr(Sweep, "fly", fly)
    arguments = Namespace(
        config_name="tune",
        overrides=[*TINY, "horizon=2,3", f"folder={tmp_path}"],
        trials=1,
        batch=1,
        seeds=1,
    )
    with settings_folders():
        assert _tune.tune(arguments).code == 1
    said = capsys.readouterr().err
    assert f"{tmp_path}: No space left on device; not all runs were flown" in said
    assert "the same command goes on where it stopped" in said


def test_the_help_of_tune_can_be_typed(tmp_path):
    shown = forked("help", "tune", cwd=tmp_path).stdout
    typed = re.findall(r"^  ('?[a-z][\w.]*=\S+)", shown, re.MULTILINE)
    assert len(typed) >= 5
    for override in OverridesParser.create().parse_overrides(
        [text.strip("'") for text in typed if "DIR" not in text]
    ):
        assert override.get_key_element()


def test_a_flight_of_which_steps_are_lost_has_no_cost(tmp_path):
    path = tmp_path / "run.mcap"
    runs.record_run(path, steps=20)
    folder = SimpleNamespace(finished=True, path=tmp_path, result=dict)
    cost = SimpleNamespace(Q=np.eye(6), R=np.eye(3), angle_indices=())
    controller = {"problem": SimpleNamespace(cost=cost), "initial_input": np.zeros(3)}
    assert _cost(SimpleNamespace(folder=folder), controller) > 0
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"5 of 20 steps are lost"):
        _cost(SimpleNamespace(folder=folder), controller)


def test_entries_of_a_list_are_set_in_the_candidates_system():
    Q = "controller.problem.cost.Q"
    with settings_folders():
        runs = Sweep("tune", ["system=cart_pole"], Console(quiet=True))
        candidate = {"system": "acrobot", f"{Q}.0": 7, "horizon": 3}
        overrides = Tuning(runs, ["system=cart_pole"], 1).overrides(candidate)
        of_acrobot = OmegaConf.select(hydra.compose("tune", ["system=acrobot"]), Q)
    assert overrides[:-1] == ["system=cart_pole", "system=acrobot", "horizon=3"]
    assert overrides[-1] == f"{Q}=[7,{','.join(map(str, of_acrobot[1:]))}]"
