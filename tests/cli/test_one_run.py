"""One run in its folder: flown again to be watched, and files that cannot be read."""

from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig

from gpmpc.cli import _run
from gpmpc.cli._folders import writing
from gpmpc.cli._run import RunSettings, run_one
from gpmpc.cli._settings import compose, settings
from gpmpc.exceptions import SettingError
from gpmpc.studies._run_folder import RunFolder, RunState


def to_fly(tree, *overrides):
    with settings():
        config = compose("run", ["recorder=none", *overrides])
        options = HydraConfig.get().runtime.choices
    return RunSettings(
        config=config,
        options=options,
        choices=[],
        command="gpmpc run",
        folder=RunFolder(tree / "run"),
    )


def test_a_live_flight_again_is_finished_when_it_has_ended(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    during = []

    def flight(*_):
        during.append(folder.state)
        if len(during) == 3:
            raise KeyboardInterrupt
        if len(during) == 4:
            raise ArithmeticError("it ended early")
        return {"flight": len(during)}

    monkeypatch.setattr(_run, "_fly", flight)
    once = to_fly(tmp_path)
    live = to_fly(tmp_path, "live=true")
    assert run_one(once).result["flight"] == 1
    assert run_one(once).skipped
    assert run_one(live).result["flight"] == 2
    assert folder.result()["flight"] == 2
    with pytest.raises(SettingError, match="run of other settings .controller.horizon"):
        run_one(to_fly(tmp_path, "live=true", "horizon=3"))
    assert folder.state is RunState.FINISHED
    with pytest.raises(KeyboardInterrupt):
        run_one(live)
    assert folder.state is RunState.LOST
    assert "it ended early" in run_one(live).error
    assert folder.state is RunState.FAILED
    assert during == [RunState.RUNNING] * 4


def test_a_model_that_cannot_be_read_is_no_fault_of_the_folder(tmp_path):
    gone = tmp_path / "gone.safetensors"
    run = to_fly(tmp_path, "model=saved", f"model.path={gone}")
    with pytest.raises(SettingError, match=r"model\.path: cannot read .*gone\.safe"):
        run_one(run)
    assert not run.folder.path.exists()


def test_only_errors_of_a_folder_are_those_of_writing_to_it(tmp_path):
    folder = tmp_path / "file" / "results"
    (tmp_path / "file").touch()
    said = "folder: cannot write to .*results: Not a"
    with pytest.raises(SettingError, match=said), writing(folder):
        folder.mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match="data.csv"), writing(folder):
        Path(tmp_path / "data.csv").read_text()
