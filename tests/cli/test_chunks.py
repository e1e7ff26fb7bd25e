"""Runs of a sweep in chunks: how many a process flies, and which are tried before."""

import logging
import os

import hydra
import pytest

from gpmpc.cli import _run
from gpmpc.cli._chunks import Chunk, Chunking, Job, fly_chunk
from gpmpc.cli._composing import Composer
from gpmpc.cli._examples import Examples
from gpmpc.cli._overrides import choices, combinations
from gpmpc.cli._settings import settings
from gpmpc.exceptions import DataError, GpmpcError, SettingError
from gpmpc.studies._run_folder import Busy, RunFolder, RunState, folder_name


@pytest.fixture(scope="module", autouse=True)
def composing():
    with settings():
        yield


def jobs_of(tree, *words):
    composer = Composer("run", hydra.compose("run", [], return_hydra_config=True))
    return [
        Job(
            choices=choices(overrides),
            folder=RunFolder(tree / folder_name(choices(overrides))),
            settings=composer.settings(overrides),
        )
        for overrides in combinations(words)
    ]


def end(job, seconds):
    """Makes a folder look as if its run had taken some seconds."""
    job.folder.path.mkdir(parents=True, exist_ok=True)
    for name, time in (("config.yaml", 1000.0), ("metrics.json", 1000.0 + seconds)):
        (job.folder.path / name).touch()
        os.utime(job.folder.path / name, (time, time))


def sizes(chunks):
    return [len(chunk.jobs) for chunk in chunks]


def test_the_first_runs_tell_how_many_a_process_flies(tmp_path):
    jobs = jobs_of(tmp_path, "seed=range(100)")
    chunking = Chunking("auto", workers=None)  # as on a cluster
    assert sizes(chunking.chunks(jobs)) == [2]
    end(jobs[0], 30.0)  # has compiled
    end(jobs[1], 2.0)
    for job in jobs[:2]:
        chunking.measure(job)
    chunks = chunking.chunks(jobs[2:])
    assert sizes(chunks) == [30, 30, 30, 8]
    flown = [job for chunk in chunks for job in chunk.jobs]
    assert [job.choices for job in flown] == [job.choices for job in jobs[2:]]
    assert chunks[0].folders == [job.folder for job in jobs[2:32]]


def test_processes_of_one_machine_end_at_about_one_time(tmp_path):
    jobs = jobs_of(tmp_path, "seed=range(80)")
    chunking = Chunking("auto", workers=2)
    assert sizes(chunking.chunks(jobs)) == [2, 2]
    end(jobs[1], 0.1)
    chunking.measure(jobs[1])
    assert sizes(chunking.chunks(jobs)) == [10] * 8


def test_a_long_run_has_a_process_of_its_own(tmp_path):
    jobs = jobs_of(tmp_path, "seed=range(4)")
    chunking = Chunking("auto", workers=None)
    chunking.chunks(jobs)
    end(jobs[0], 500.0)
    chunking.measure(jobs[0])
    assert sizes(chunking.chunks(jobs[1:])) == [1, 1, 1]


def test_a_number_of_runs_is_kept(tmp_path):
    chunks = Chunking(3, workers=2).chunks(jobs_of(tmp_path, "seed=range(7)"))
    assert sizes(chunks) == [3, 3, 1]
    assert chunks[0].most_work is None


@pytest.mark.parametrize("size", ["many", 0, -1, 2.5, None])
def test_a_size_of_chunks_is_checked(size):
    with pytest.raises(SettingError, match="chunk"):
        Chunking(size, workers=1)


def test_a_chunk_goes_on_behind_what_cannot_be_flown(tmp_path, monkeypatch):
    jobs = jobs_of(tmp_path, "seed=range(5)")
    flown = []

    def run(settings, wait):
        assert not wait
        seed = settings.config.seed
        flown.append(seed)
        if seed == 1:
            raise Busy("another process works on this run")
        if seed in (2, 3):
            raise SettingError("folder", "cannot write")

    monkeypatch.setattr(_run, "run_one", run)
    with pytest.raises(GpmpcError) as told:
        fly_chunk(Chunk(tuple(jobs), None))
    assert flown == [0, 1, 2, 3, 4]
    assert str(told.value) == "folder: cannot write"
    flown.clear()
    fly_chunk(Chunk(tuple(jobs[:1]) + tuple(jobs[4:]), most_work=0.0))
    assert flown == [0]  # it always flies one


def test_remarks_stay_with_a_run_whatever_becomes_of_its_chunk(
    tmp_path, monkeypatch, capfd
):
    jobs = jobs_of(tmp_path, "seed=range(3)")
    log = logging.getLogger("gpmpc.gp")

    def flight(run, *_):
        log.info("trained")
        for _ in range(2):
            log.warning("few\nrows of %d", run.config.seed)
        if run.config.seed == 1:
            raise DataError("no rows")
        if run.config.seed == 2:
            raise SystemExit("as if the process died")
        return {}

    monkeypatch.setattr(_run, "_fly", flight)
    with pytest.raises(SystemExit):
        fly_chunk(Chunk(tuple(jobs), None))
    states = [job.folder.state for job in jobs]
    assert states == [RunState.FINISHED, RunState.FAILED, RunState.LOST]
    remarks = [job.folder.remarks() for job in jobs]
    assert remarks == [["few rows of 0"], ["few rows of 1"], []]
    assert capfd.readouterr() == ("", "")
    assert logging.getLogger("gpmpc").handlers == []


def test_every_choice_and_both_ends_are_tried(tmp_path):
    jobs = jobs_of(
        tmp_path, "controller=convex,lqr", "seed=range(300)", "noise.process=null,[1]"
    )
    examples = Examples()
    tried = [job.choices for job in examples.of(jobs)]
    assert 4 <= len(tried) < 40
    text = str(tried)
    for choice in ("controller=lqr", "seed=0'", "seed=299", "noise.process=[1]"):
        assert choice in text
    assert examples.of(jobs) == []
    later = jobs_of(tmp_path, "seed=300,7")
    assert [job.choices for job in Examples().of(later)] == [["seed=300"], ["seed=7"]]
