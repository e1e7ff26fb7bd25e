"""A sweep's runs count by their folders, whatever becomes of the processes."""

import errno
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from gpmpc.cli import _flying
from gpmpc.cli._flying import Flying
from gpmpc.cli._launchers import Basic, Cause, ChunkEnd, Joblib
from gpmpc.exceptions import SettingError
from gpmpc.studies import _run_folder
from gpmpc.studies._run_folder import RunFolder, RunState
from tests.cli.launched import Chunk, fly, in_chunks, jobs_of


class Told(Basic):
    """A launcher that says of every chunk what the test wants."""

    def __init__(self, tree, *ends):
        super().__init__(tree)
        self.ends = list(ends)
        self.launched = []

    def launch(self, work, chunks):
        for chunk in chunks:
            self.launched.append(chunk)
            end = self.ends.pop(0) if self.ends else {}
            end.pop("before", lambda chunk: None)(chunk)
            if not end:
                work(chunk)
            yield ChunkEnd(chunk, **end)


def flown(launcher, jobs, size=1, retries=2, work=fly):
    settled = {}
    flying = Flying(
        launcher=launcher,
        work=work,
        chunked=in_chunks(size),
        on_settled=lambda job, state: settled.update({job.folder.path.name: state}),
        retries=retries,
    )
    flying.fly(jobs)
    assert len(settled) == len(jobs)
    return flying, {name: state.value for name, state in settled.items()}


def error_of(job):
    return json.loads((job.folder.path / "error.json").read_text())


def begins(chunk):
    chunk.folders[0].path.mkdir(parents=True)
    chunk.folders[0].begin("act: 1\n")


def begins_again(chunk):
    with chunk.folders[0].locked():
        chunk.folders[0].begin("act: 1\n")


def test_a_chunk_said_to_be_done_but_not_there_has_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(_flying, "_LATE", 0.0)
    jobs = jobs_of(tmp_path, "flies", "flies", "flies")
    launcher = Told(tmp_path, {}, {"host": "blind (10.0.0.7)"})
    _, states = flown(launcher, jobs)
    assert states == {"0-flies": "finished", "1-flies": "failed", "2-flies": "finished"}
    error = error_of(jobs[1])
    assert error["choices"] == ["act=flies"]
    assert error["host"] == "blind (10.0.0.7)"
    assert error["error"].startswith("blind (10.0.0.7) says that it flew this run, and")
    assert error["attempts"] == 0  # it never began


def test_a_run_that_nobody_can_write_down_has_failed(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise OSError(errno.ENOSPC, "disk full")

    jobs = jobs_of(tmp_path, "flies", "flies")
    monkeypatch.setattr(RunFolder, "end_from_outside", refuse)
    launcher = Told(tmp_path, {"cause": Cause.ERROR, "reason": "cannot write"})
    flying, states = flown(launcher, jobs)
    assert states == {"0-flies": "failed", "1-flies": "finished"}
    (reason,) = flying.reasons_not_kept.values()
    assert reason == "cannot write (its folder does not say so: disk full)"


def test_a_shared_file_system_may_show_a_run_late(tmp_path, monkeypatch):
    monkeypatch.setattr(_flying, "_LATE", 20.0)
    monkeypatch.setattr(_flying, "_LOOK_INTERVAL", 0.01)
    (job,) = jobs_of(tmp_path, "flies")
    looks = []

    def listed(folder):
        looks.append(folder)
        if len(looks) == 3:
            fly(Chunk((job,)))
        return []

    monkeypatch.setattr(_flying.os, "listdir", listed)
    _, states = flown(Told(tmp_path, {"host": "slow"}), [job])
    assert states == {"0-flies": "finished"}


@pytest.mark.parametrize("cause", [Cause.TIME, Cause.MEMORY])
def test_a_limit_fails_the_run_that_reached_it_alone(cause, tmp_path):
    jobs = jobs_of(tmp_path, "flies", "flies", "flies")
    end = {"cause": cause, "host": "n1", "reason": "too much", "before": begins}
    launcher = Told(tmp_path, end)
    flying, states = flown(launcher, jobs, size=3)
    assert states == {"0-flies": "failed", "1-flies": "finished", "2-flies": "finished"}
    error = error_of(jobs[0])
    assert (error["error"], error["kind"], error["host"]) == (
        "too much",
        cause.value,
        "n1",
    )
    assert not flying.flown_again_now
    assert len(launcher.launched) == 2


@pytest.mark.parametrize("cause", [Cause.CANCELLED, Cause.ERROR])
def test_a_failure_of_a_chunk_fails_all_that_is_left_of_it(cause, tmp_path):
    jobs = jobs_of(tmp_path, "flies", "flies", "flies", "flies")
    fly(Chunk((jobs[0],)))
    _, states = flown(Told(tmp_path, {"cause": cause, "reason": "no"}), jobs, size=2)
    assert states == {
        "0-flies": "finished",
        "1-flies": "failed",
        "2-flies": "failed",
        "3-flies": "finished",
    }
    assert error_of(jobs[2])["error"] == "no"
    # Those that never began may be flown again as often as anybody likes.
    assert error_of(jobs[2])["attempts"] == 0
    begun = {"cause": cause, "reason": "no", "before": begins_again}
    flown(Told(tmp_path, begun), jobs[2:3])
    assert error_of(jobs[2])["attempts"] == 1


@pytest.mark.parametrize("cause", [Cause.NODE, Cause.CRASH])
def test_a_run_whose_process_dies_is_flown_again(cause, tmp_path):
    jobs = jobs_of(tmp_path, "flies", "flies")

    def dies():
        return {"cause": cause, "reason": "gone", "before": begin_again}

    def begin_again(chunk):
        with chunk.folders[0].locked():
            chunk.folders[0].begin(f"act: {time.monotonic_ns()}\n")

    flying, states = flown(Told(tmp_path, dies(), dies()), jobs, size=2)
    assert set(states.values()) == {"finished"}
    assert flying.flown_again_now == {str(jobs[0].folder.path)}

    jobs = jobs_of(tmp_path / "other", "flies", "flies")
    launcher = Told(tmp_path, dies(), dies())
    _, states = flown(launcher, jobs, size=2, retries=1)
    assert states == {"0-flies": "failed", "1-flies": "finished"}
    assert error_of(jobs[0])["attempts"] == 2

    flying, states = flown(launcher, [jobs[0]], retries=1)
    assert states == {"0-flies": "failed"}
    assert flying.out_of_retries == {str(jobs[0].folder.path): 2}

    flying, states = flown(launcher, [jobs[0]], retries=2)
    assert states == {"0-flies": "finished"}
    assert flying.flown_again_from_before == [str(jobs[0].folder.path)]


def test_a_process_that_began_nothing_fails_its_whole_chunk(tmp_path):
    jobs = jobs_of(tmp_path, "flies", "flies")
    end = {"cause": Cause.CRASH, "reason": "gone"}
    _, states = flown(Told(tmp_path, end), jobs, size=2, retries=0)
    assert set(states.values()) == {"failed"}


def test_runs_that_a_chunk_left_fly_in_the_next_one(tmp_path):
    jobs = jobs_of(tmp_path, "flies", "flies", "flies")

    def only_the_first(chunk):
        return fly(Chunk(chunk.jobs[:1]))

    _, states = flown(Basic(tmp_path), jobs, size=3, work=only_the_first)
    assert set(states.values()) == {"finished"}


def test_a_run_in_the_hands_of_another_sweep_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(_flying, "_LOOK_INTERVAL", 0.01)
    jobs = jobs_of(tmp_path, "flies", "flies")
    looks = []
    with jobs[0].folder.locked():
        jobs[0].folder.begin("act: 1\n")
        usual = _run_folder.is_locked

        def looked(lock):
            if lock.parent == jobs[0].folder.path:
                looks.append(lock)
            if len(looks) == 3:
                jobs[0].folder.finish({"settings": {}})
            return usual(lock)

        monkeypatch.setattr(_run_folder, "is_locked", looked)
        launcher = Told(tmp_path)
        _, states = flown(launcher, jobs)
    assert states == {"0-flies": "finished", "1-flies": "finished"}
    assert [chunk.jobs for chunk in launcher.launched] == [(jobs[1],)]


def test_a_process_of_joblib_that_dies_takes_one_chunk_with_it(tmp_path):
    jobs = jobs_of(tmp_path, "dies", "flies", "dies once", "flies", "flies", "raises")
    launcher = Joblib(tmp_path, n_jobs=2)
    flying, states = flown(launcher, jobs, size=2, retries=1)
    (end,) = launcher.launch(ends_its_process, in_chunks(1)(jobs[:1]))
    assert (end.cause, end.reason) == (Cause.ERROR, "SystemExit: 2")
    # Those that wait may die as well, such as for want of memory.
    for executor in launcher._idle:
        (process,) = executor._processes.values()
        os.kill(process.pid, signal.SIGKILL)
        executor._executor_manager_thread.join(20)
    later = jobs_of(tmp_path / "later", "flies")
    assert flown(launcher, later)[1] == {"0-flies": "finished"}
    launcher.close()
    assert states == {
        "0-dies": "failed",
        "1-flies": "finished",
        "2-dies once": "finished",
        "3-flies": "finished",
        "4-flies": "finished",
        "5-raises": "failed",
    }
    error = error_of(jobs[0])
    assert error["attempts"] == 2
    assert "died (SIGKILL(-9))" in error["error"]
    assert error_of(jobs[5])["error"] == "ValueError: of nobody's making"
    assert flying.flown_again_now == {str(jobs[i].folder.path) for i in (0, 2)}


@pytest.mark.parametrize("wrong", [0, 1.5, "many"])
def test_a_number_of_processes_must_be_one(wrong, tmp_path):
    with pytest.raises(SettingError, match=r"hydra\.launcher\.n_jobs.* must be"):
        Joblib(tmp_path, n_jobs=wrong)


def ends_its_process(chunk):
    raise SystemExit(2)


DRIVER = """
import sys
from pathlib import Path
from gpmpc.cli._launchers import Joblib
from tests.cli.launched import fly, in_chunks, jobs_of
jobs = jobs_of(Path(sys.argv[1]), "sleeps", "sleeps")
print(*Joblib(Path(), n_jobs=2).launch(fly, in_chunks(1)(jobs)))
"""


def test_a_killed_parent_leaves_no_process_and_lost_runs(tmp_path):
    path = os.pathsep.join(filter(None, sys.path))
    parent = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(tmp_path)],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
    )
    folders = [job.folder for job in jobs_of(tmp_path, "sleeps", "sleeps")]
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if all(folder.state is RunState.RUNNING for folder in folders):
            break
        time.sleep(0.05)
    parent.send_signal(signal.SIGKILL)
    parent.communicate()  # ends when the last process that holds the pipe has ended
    assert [folder.state for folder in folders] == [
        RunState.ABANDONED,
        RunState.ABANDONED,
    ]
