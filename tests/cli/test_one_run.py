"""One run in its folder: flown again to be watched, and files that cannot be read."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra.core.hydra_config import HydraConfig

from gpmpc.cli import _run
from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._folders import writing
from gpmpc.cli._launchers import Basic
from gpmpc.cli._run import RunToFly, run_one
from gpmpc.cli._settings import compose, settings_folders
from gpmpc.cli._terminal import OutputEnded
from gpmpc.exceptions import SettingError
from gpmpc.mpc import Box
from gpmpc.recording import read_run
from gpmpc.step import Step
from gpmpc.studies import _run_folder
from gpmpc.studies._run_folder import RunFolder, RunState
from gpmpc.systems import System, translational


def to_fly(tree, *overrides):
    with settings_folders():
        config = compose("run", ["recorder=none", *overrides])
        options = HydraConfig.get().runtime.choices
    return RunToFly(
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

    monkeypatch.setattr(_run, "_fly_and_measure", flight)
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
    assert folder.state is RunState.ABANDONED
    assert "it ended early" in run_one(live).error
    assert folder.state is RunState.FAILED
    assert during == [RunState.RUNNING] * 4


def test_a_run_that_another_process_flies_is_waited_for_and_told(
    tmp_path, monkeypatch, capsys
):
    run = to_fly(tmp_path)
    monkeypatch.setattr(_run, "_fly_and_measure", lambda *_: {"times": {"run": 7.5}})
    monkeypatch.setattr(_run_folder, "is_locked", lambda _: True)
    run_one(run)
    assert "gpmpc: waiting for " in capsys.readouterr().err
    # what a copy of the folder keeps
    assert run.folder.seconds == 7.5
    # its numbers are there for who may not write
    monkeypatch.setattr(RunFolder, "locked", lambda *_: pytest.fail("it writes"))
    assert run_one(run).skipped


def test_a_reader_that_has_seen_enough_makes_no_failed_run(tmp_path, monkeypatch):
    def fly(*_):
        raise OutputEnded(1)

    monkeypatch.setattr(_run, "_fly_and_measure", fly)
    run = to_fly(tmp_path)
    with pytest.raises(OutputEnded):
        run_one(run)
    assert run.folder.state is RunState.ABANDONED
    # nor does a sweep in this process go on
    with pytest.raises(OutputEnded):
        [*Basic(tmp_path).launch(lambda _: run_one(run), [SimpleNamespace()])]
    assert run.folder.failed_at is None


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


def test_a_controller_that_names_its_solver_takes_no_other(tmp_path):
    config = to_fly(tmp_path, "controller=state_form", "solver=clarabel").config
    said = r"\Asolver: .* by its name, as controller.solver=CLARABEL"
    with pytest.raises(SettingError, match=said):
        experiment_of(config)


def test_a_recording_tells_how_many_points_a_saved_model_has(tmp_path):
    run = to_fly(tmp_path)
    plant = translational()
    experiment = SimpleNamespace(
        system=plant,
        model=range(7),
        learning=None,
        seed=0,
        unplanned_noise=lambda training, controller: np.zeros(6),
    )
    bounds = Box(np.zeros(3), np.ones(3))
    controller = SimpleNamespace(problem=SimpleNamespace(inputs=bounds), horizon=2)
    nothing = np.zeros(6)
    step = Step(
        time=0.0,
        k=0,
        reference=nothing,
        state=nothing,
        measured=nothing,
        input=np.zeros(3),
        decision=None,
        innovation=nothing,
        belief_covariance=np.zeros((6, 6)),
    )
    recordings = _run._Recordings(experiment, run, "")
    with recordings.open_next(controller, None) as on_step:
        on_step(step)
    recorded = read_run(tmp_path / "run" / "run.mcap")
    assert recorded.gp_sizes.tolist() == [7]


def test_names_no_recording_takes_are_refused_before_training(tmp_path, monkeypatch):
    class Leg:
        state_names = ("left/hip",)
        input_names = ("torque",)

        def derivative(self, x, u):
            return [u[0] - x[0]]

    def trained(*_):
        raise AssertionError("it was trained")

    experiment = SimpleNamespace(system=System(Leg(), 0.1), learning=None)
    monkeypatch.setattr(_run, "experiment_of", lambda config: experiment)
    monkeypatch.setattr(_run, "run_trial", trained)
    with pytest.raises(SettingError, match="a letter first; got 'left/hip'"):
        _run._fly_and_measure(to_fly(tmp_path, "recorder=mcap"), "", None)
