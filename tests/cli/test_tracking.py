"""Finished runs are written to MLflow, where one is installed."""

import contextlib
import json
import sys
import types
from dataclasses import replace
from importlib.util import find_spec

import pytest
from rich.console import Console

from gpmpc.cli import _mlflow, _run
from gpmpc.cli._experiment import experiment_of, experiment_of_file
from gpmpc.cli._mlflow import log_to_mlflow
from gpmpc.cli._plain_settings import plain_data
from gpmpc.cli._run import run_one
from gpmpc.cli._settings import compose, settings_folders
from gpmpc.cli._sweep import Sweep
from gpmpc.exceptions import SettingError
from gpmpc.studies._run_folder import RunFolder
from tests.cli.command import forked
from tests.cli.test_one_run import to_fly

TINY = ["steps=3", "data.samples=25", "model.restarts=0", "tracker=mlflow"]
RESULT = {
    "settings": {"R": [1.0], "data": {"note": "x" * 9000}},
    "rmse": {"total": 0.5, "x [m]": float("inf"), "n": 2},
}


class Store(types.ModuleType):
    """Stands in for MLflow, with the limits that MLflow documents."""

    def __init__(self):
        super().__init__("mlflow")
        self.__spec__ = types.SimpleNamespace(name="mlflow")
        self.seen = {}

    @contextlib.contextmanager
    def start_run(self, run_name):
        self.seen["name"] = run_name
        yield

    def set_experiment(self, name):
        self.seen["experiment"] = name

    def log_params(self, params):
        assert all(len(value) <= 6000 for value in params.values())
        self.seen["params"] = params

    def log_metrics(self, metrics):
        self.seen["metrics"] = metrics

    def log_artifacts(self, folder):
        self.seen["artifacts"] = folder


def test_settings_metrics_and_files_reach_the_tracker(monkeypatch, tmp_path):
    for name in ("MLFLOW_EXPERIMENT_NAME", "MLFLOW_EXPERIMENT_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setitem(sys.modules, "mlflow", store := Store())
    log_to_mlflow(tmp_path, RESULT)
    assert store.seen["params"] == {"R": "[1.0]", "data.note": "x" * 6000}
    assert store.seen["metrics"] == {"rmse.total": 0.5, "rmse.n": 2.0}
    assert (store.seen["experiment"], store.seen["name"]) == ("gpmpc", tmp_path.name)
    assert store.seen["artifacts"] == str(tmp_path)


def test_a_result_reaches_the_tracker_once_however_late(monkeypatch, tmp_path):
    """A run that was flown without it, or that it did not take, is taken later."""
    monkeypatch.setitem(sys.modules, "mlflow", store := Store())
    monkeypatch.setattr(_run, "_fly_and_measure", lambda *_: {"times": {"run": 1.0}})
    seed = ["seed=3"]
    run_one(to_fly(tmp_path, *seed, "folder=out"))
    assert not store.seen
    monkeypatch.setattr(store, "log_params", lambda params: 1 / 0)
    assert run_one(to_fly(tmp_path, *seed, "tracker=mlflow")).skipped
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "mlflow", store)
    for seen in ("run", None):
        store.seen.clear()
        assert run_one(to_fly(tmp_path, *seed, "tracker=mlflow")).skipped
        assert store.seen.get("name") == seen
    # so does one of a sweep, whose folder may ask Hydra for a name
    (tmp_path / "run/.mlflow").unlink()
    with settings_folders():
        folder = f"folder={tmp_path}/${{hydra:job.name}}"
        words = ["recorder=none", "tracker=mlflow", folder]
        sweep = Sweep("run", words, Console())
        assert sweep.tree == tmp_path / "run"
        job = replace(sweep.job([*words, *seed]), folder=RunFolder(sweep.tree))
        assert [outcome.error for outcome in sweep.fly([job])] == [None]
    assert store.seen["name"] == "run"


def test_what_is_not_flown_needs_no_tracker(monkeypatch):
    """A recording of a tracked flight is exported where there is none."""
    monkeypatch.setattr(_mlflow, "find_spec", lambda name: None)
    with settings_folders():
        config = compose("run", ["tracker=mlflow"])
    with pytest.raises(SettingError, match="tracker: needs MLflow"):
        experiment_of(config)
    assert experiment_of_file(plain_data(config), ()).seed == 0


def test_an_unknown_or_absent_tracker_is_named_before_a_flight(tmp_path):
    wrong = [("comet", "tracker: must be 'mlflow' or 'none'; got 'comet'")]
    if find_spec("mlflow") is None:
        wrong.append(("mlflow", "tracker: needs MLflow: pip install mlflow"))
    for tracker, message in wrong:
        done = forked("run", f"tracker={tracker}", cwd=tmp_path)
        assert (done.returncode, done.stderr) == (2, f"gpmpc: {message}\n")
        assert not list(tmp_path.iterdir())


def test_a_run_is_found_in_mlflow_with_its_numbers_and_files(tmp_path):
    mlflow = pytest.importorskip("mlflow")
    store = f"sqlite:///{tmp_path}/store.db"
    run = forked("run", *TINY, cwd=tmp_path, MLFLOW_TRACKING_URI=store)
    assert run.returncode == 0, run.stderr
    mlflow.set_tracking_uri(store)
    (found,) = mlflow.search_runs(experiment_names=["gpmpc"], output_format="list")
    (path,) = tmp_path.glob("outputs/run/*/metrics.json")
    assert (
        found.data.metrics["rmse.total"]
        == json.loads(path.read_text())["rmse"]["total"]
    )
    assert found.data.params["controller.horizon"] == "10"
    assert found.info.status == "FINISHED"


def test_a_failing_tracker_leaves_the_run_finished_and_says_so(tmp_path):
    pytest.importorskip("mlflow")
    run = forked("run", *TINY, cwd=tmp_path, MLFLOW_TRACKING_URI="nowhere://x")
    assert run.returncode == 0
    assert "is not in MLflow" in run.stderr
    assert list(tmp_path.glob("outputs/run/*/metrics.json"))
