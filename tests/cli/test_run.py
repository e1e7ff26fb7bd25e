"""One flight says that it was lost, that it compiles, and how well it was foreseen."""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from gpmpc import _provenance
from gpmpc._provenance import code_fingerprint
from gpmpc.cli import _calibrate, _export, _recorded, _run
from gpmpc.cli._plain_settings import plain_settings
from gpmpc.exceptions import SettingError
from gpmpc.plotting._recorded import expected
from gpmpc.recording import read_run
from tests.cli.command import forked, gpmpc
from tests.recording import runs

TINY = ["data.samples=25", "model.restarts=0", "horizon=2", "folder=tree"]
NOISY = f"noise.process={[0.01] * 6}".replace(" ", "")
GYROSCOPE = (
    "plant.gyroscopic"  # so strong a one that Runge and Kutta's step is unstable
)


@pytest.mark.parametrize(
    ("choices", "reason"),
    [
        (["plant.mass=100", "trajectory=hover"], "m from its reference"),
        (
            ["system=rotational", f"{GYROSCOPE}=[1e3,1e3]", "controller=lqr"],
            "state is not finite any more",
        ),
    ],
    ids=["falls", "diverges"],
)
def test_a_lost_flight_is_readable_and_has_its_own_exit_code(choices, reason, tmp_path):
    done = forked("run", *TINY, *choices, "steps=9", cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    assert "lost " in done.stdout
    (line,) = done.stderr.splitlines()
    assert line.startswith("gpmpc: lost: from step ")
    assert reason in line
    (folder,) = (tmp_path / "tree").iterdir()
    result = json.loads(
        (folder / "metrics.json").read_text(), parse_constant=pytest.fail
    )
    assert reason in result["lost"]["reason"]
    run = read_run(folder / "run.mcap")
    assert run.finished
    ended = "Diverged: " if "finite" in reason else "complete"
    assert run.metadata["end"]["outcome"].startswith(ended)
    assert len(run.times) == result["steps"]
    assert run.times[result["lost"]["step"]] == result["lost"]["time"]
    again = forked("run", *TINY, *choices, "steps=9", cwd=tmp_path)
    assert again.returncode == 3
    assert "finished before" in again.stdout
    assert forked("plot", str(folder), cwd=tmp_path).returncode == 0
    assert forked("report", "tree", cwd=tmp_path).returncode == 0


def test_a_sweep_names_lost_flights_and_those_flown_before(tmp_path):
    sweep = ["run", "-m", *TINY, "plant.mass=0.74,100", "trajectory=hover", "steps=9"]
    for before in (0, 2):
        done = forked(*sweep, "recorder=none", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        total = (
            f"2 runs: {2 - before} flown, {before} finished before, 0 failed, 1 lost;"
        )
        assert total in done.stdout
        (line,) = done.stderr.splitlines()
        assert "mass=100" in line
        assert ": lost: from step " in line


def test_a_flight_is_predicted_or_one_line_says_why_not(tmp_path, monkeypatch, capsys):
    """So is a flight filmed, or one line says why not."""
    once = ["steps=9", "controller.iterations=1"]  # so that it can be exported
    assert forked("run", *TINY, *once, cwd=tmp_path).returncode == 0
    done = forked("calibrate", "tree", "--steps", "12", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert [
        (row["step"], row["samples"]) for row in rows if row["state"] == "x [m]"
    ] == [(k, 9 - k) for k in range(1, 9)]
    assert all(
        0 <= row["coverage_0.5"] <= row["coverage_0.95"] <= 1 and row["width"] > 0
        for row in rows
    )
    (folder,) = (tmp_path / "tree").glob("*/calibration")
    assert {path.suffix for path in folder.iterdir()} == {".csv", ".md", ".png", ".tex"}
    assert "other code" not in done.stderr
    (recording,) = (tmp_path / "tree").glob("*/run.mcap")
    assert read_run(recording).metadata["run"]["code"] == code_fingerprint()
    # a flight of other code: the model is learned again, by this code
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_recorded, "is_of_this_code", lambda about, settings: False)
    arguments = {
        "run": Path("tree"),
        "to": None,
        "flights": [],
        "steps": 3,
        "trust": [],
    }
    _calibrate.calibrate(argparse.Namespace(**arguments))
    said = "was flown by other code: the model that is judged is what this code learns"
    assert said in capsys.readouterr().out
    (written,) = (tmp_path / "tree").glob("*/calibration/calibration.md")
    assert said in written.read_text()
    assert "Intervals hold the model's noise at every step." in written.read_text()
    # an exported controller is compared with the flight, not only with itself
    monkeypatch.setattr(shutil, "which", lambda name: None)
    arguments |= {"precision": "double", "points": None}
    arguments |= {"budget": None, "chip": None, "name": "gpmpc"}
    own = tmp_path / "notes"
    own.mkdir()
    (own / "points.md").write_text("mine")
    exported = _export.export(argparse.Namespace(**arguments | {"to": own}))
    for changed, said in ({"points": 9}, "points.md"), ({}, "replay.txt"):
        (own / said).write_text("mine")
        with pytest.raises(SettingError, match=f"{said} was not written by an export"):
            _export.export(argparse.Namespace(**arguments | {"to": own} | changed))
        assert (own / said).read_text() == "mine"
    assert 0 <= exported.data["difference_from_flight"] < 1e-6
    said = "was flown by other code: what is exported is what this code makes of"
    assert said in capsys.readouterr().out
    here = forked("run", *TINY, "steps=3", "launcher=joblib", cwd=tmp_path)
    assert here.returncode == 0
    assert "launcher=joblib is for sweeps (-m); this run flies here" in here.stderr
    runs.record_run(tmp_path / "foreign.mcap", steps=3)
    for words, said in (
        (["calibrate", "nowhere"], "nowhere: cannot be read"),
        (["calibrate", "tree"], "tree: holds 2 runs"),
        (
            ["calibrate", "tree", "--steps", "0"],
            "--steps: must be a whole number, 1 or more; got 0",
        ),
        (["calibrate", "foreign.mcap"], "foreign.mcap: holds no settings"),
        (
            ["plot", "--film", str(folder.parent)],
            "a film needs steps of a MuJoCo model",
        ),
    ):
        wrong = forked(*words, cwd=tmp_path)
        assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1), wrong.stderr
        assert said in wrong.stderr


def test_who_is_not_lost_is_not_called_so(tmp_path):
    done = forked(
        "run",
        "model.restarts=0",
        "plant.mass=0.888",
        "steps=9",
        "folder=tree",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert "lost" not in done.stdout
    (path,) = tmp_path.glob("tree/*/metrics.json")
    assert json.loads(path.read_text())["lost"] is None


@pytest.mark.parametrize("controller", ["convex", "nmpc"])
def test_the_figures_band_covers_two_standard_deviations(controller, tmp_path):
    choices = [
        "trajectory=lorenz",
        f"controller={controller}",
        "model.restarts=0",
        "horizon=2",
        NOISY,
    ]
    assert (
        forked("run", *choices, "steps=150", "folder=tree", cwd=tmp_path).returncode
        == 0
    )
    run = read_run(next(tmp_path.glob("tree/*/run.mcap")))
    mean, std = expected(run, [0, 2, 4])
    inside = np.abs(run.states[:, ::2] - mean)[1:] <= 2 * std[1:]
    # 447 draws of 95.45 % and four standard errors; the learned noise is uncertain by a
    # twentieth.
    assert 0.90 < inside.mean() < 0.99


def test_noise_that_the_plan_holds_already_is_not_counted_twice(tmp_path):
    stds = []
    for propagation in (
        [],
        ["propagation=linearization", "propagation.process_noise=true"],
    ):
        assert forked(
            "run", *TINY, *propagation, "steps=2", cwd=tmp_path
        ).returncode in (0, 3)
    for path in sorted(tmp_path.glob("tree/*/run.mcap")):
        stds.append(expected(read_run(path), [0, 2, 4])[1][1:])
    assert np.allclose(stds[0], stds[1], rtol=1e-9)


@pytest.mark.slow
def test_compiling_is_told_on_a_pipe_and_in_no_decision(tmp_path):
    cold, warm = (
        gpmpc(
            "run",
            f"seed={seed}",
            "steps=20",
            cwd=tmp_path,
            NUMBA_CACHE_DIR=str(tmp_path / "cache"),
        )
        for seed in range(2)
    )
    first, *lines = cold.stdout.splitlines()
    assert "compiling numerical kernels" in first
    assert any(line.startswith("compiled in ") for line in lines)
    assert "compil" not in warm.stdout
    for path in tmp_path.glob("outputs/run/*/metrics.json"):
        times = json.loads(path.read_text())["times"]
        assert times["total"]["largest"] < 1
        assert times["training"] < 10


def test_a_recording_tells_what_has_changed_since_its_flight(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    code, model = tmp_path / "my_arm.py", tmp_path / "model.safetensors"
    code.write_text("MASS = 1.0\n")
    model.write_bytes(b"1")
    config = {"system": {"_target_": "my_arm.make"}, "model": {"path": str(model)}}
    settings = plain_settings(OmegaConf.create(config), {})
    runs.record_run(tmp_path / "run.mcap", steps=1, metadata=_run._origin(settings))
    run = replace(read_run(tmp_path / "run.mcap"), config=json.dumps(config))
    assert _recorded.changes_since(run) == []
    model.write_bytes(b"2")
    (change,) = _recorded.changes_since(run)
    assert change == f"{model} has changed since {run.path} was flown"
    code.write_text("MASS = 1.5\n")
    _provenance._own_fingerprint.cache_clear()
    assert f"{run.path} was flown by other code" in _recorded.changes_since(run)
