"""Runs of a sweep in chunks: how many a process flies, and which are tried before."""

import errno
import json
import logging
import os
import re
import threading
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import hydra
import pytest
from rich.console import Console

from gpmpc.cli import _run, _sweep
from gpmpc.cli._chunks import Chunk, Chunking, Job, fly_chunk
from gpmpc.cli._composing import Composer
from gpmpc.cli._examples import Examples
from gpmpc.cli._overrides import choices, combinations
from gpmpc.cli._run import RunToFly
from gpmpc.cli._settings import model_file, settings_folders
from gpmpc.cli._sweep import JobOutcome, Sweep, _end_of, _EndCounter, _write_plan
from gpmpc.exceptions import DataError, GpmpcError, SettingError
from gpmpc.studies._index import RunIndex
from gpmpc.studies._run_folder import (
    Busy,
    RunFolder,
    RunState,
    folder_name,
    run_header,
)
from tests.studies.made_up import metrics_of


@pytest.fixture(scope="module", autouse=True)
def composing():
    with settings_folders():
        yield


def jobs_of(tree, *words):
    composer = Composer("run", hydra.compose("run", [], return_hydra_config=True))
    return [
        Job(
            choices=choices(overrides),
            folder=RunFolder(tree / folder_name(choices(overrides))),
            settings=composer.composed(overrides),
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
            raise SettingError("model.path", "cannot read m")

    monkeypatch.setattr(_run, "run_one", run)
    fly_chunk(Chunk(tuple(jobs), None))
    assert flown == [0, 1, 2, 3, 4]
    states = [job.folder.state for job in jobs]
    assert states == [RunState.NOT_BEGUN] * 2 + [RunState.FAILED] * 2 + states[:1]
    assert jobs[2].folder.error() == "model.path: cannot read m"
    assert jobs[2].folder.outside_attempts == 0
    about = json.loads((jobs[2].folder.path / "error.json").read_text())
    assert about["provenance"]["command"] == "gpmpc run seed=2"
    flown.clear()
    fly_chunk(Chunk(tuple(jobs[2:]), most_work=0.0))
    assert flown == [2]  # it always flies one

    def refuse(*arguments):
        raise OSError(errno.ENOSPC, "disk full")

    monkeypatch.setattr(RunFolder, "fail", refuse)
    with pytest.raises(GpmpcError, match=r"\Amodel.path: cannot read m\Z"):
        fly_chunk(Chunk(tuple(jobs), None))
    flown.clear()
    with pytest.raises(GpmpcError):  # which is said of all that have not ended
        fly_chunk(Chunk(tuple(jobs[2:]), most_work=0.0))
    assert flown == [2, 3, 4]


class Death(BaseException):
    """As if the process died."""


def test_a_flight_that_ends_its_process_has_failed(tmp_path, monkeypatch):
    jobs = jobs_of(tmp_path, "seed=range(2)")

    def flight(run, *_):
        if run.config.seed == 0:
            raise SystemExit(2)
        return {}

    monkeypatch.setattr(_run, "_fly_and_measure", flight)
    fly_chunk(Chunk(tuple(jobs), None))
    assert [job.folder.state for job in jobs] == [RunState.FAILED, RunState.FINISHED]
    assert jobs[0].folder.error() == "2"


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
            raise Death
        return {}

    monkeypatch.setattr(_run, "_fly_and_measure", flight)
    with pytest.raises(Death):
        fly_chunk(Chunk(tuple(jobs), None))
    states = [job.folder.state for job in jobs]
    assert states == [RunState.FINISHED, RunState.FAILED, RunState.ABANDONED]
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


@pytest.mark.parametrize("content", [b"1", b"2"], ids=["same", "changed"])
def test_a_sweep_remembers_only_the_settings_that_a_run_has(
    content, tmp_path, monkeypatch
):
    model = tmp_path / "model.safetensors"
    model.write_bytes(b"1")
    words = ["model=saved", f"model.path={model}", f"folder={tmp_path / 'tree'}"]

    def flight(*_):
        model.write_bytes(content)
        return metrics_of(0.1)

    monkeypatch.setattr(_run, "_fly_and_measure", flight)
    compared = []
    resolve = _sweep.plain_settings
    monkeypatch.setattr(
        _sweep, "plain_settings", lambda *what: compared.append(what) or resolve(*what)
    )
    runs = Sweep("run", words, Console(quiet=True))
    job = runs.job(words)
    (outcome,) = runs.fly([job])
    is_same = content == b"1"
    assert ("of other settings (model.sha256" in str(outcome.error)) == (not is_same)
    assert (outcome.error is None) == is_same
    assert runs.unusable == ({job.folder.path} if outcome.error else set())
    path = job.folder.path / "metrics.json"
    known = RunIndex(tmp_path / "tree").record_with(path, job.settings.fingerprint())
    assert (known is not None) == (content == b"1")
    assert len(compared) == (content == b"2")  # only where it is needed: it takes long


def test_the_bar_may_look_while_all_are_looked_at():
    def bar_looks():
        bar = threading.Thread(target=ends.count)
        bar.start()
        bar.join(0.1)
        return True

    class First:
        @property
        def done(self):
            return bar_looks()

    ends = _EndCounter(
        [First(), SimpleNamespace(done=True), SimpleNamespace(done=True)]
    )
    ends.look_at_all()
    assert ends.count() == 3


@pytest.mark.parametrize(
    "word", ["folder=a,b", "launcher=basic,joblib", "+hydra.job.x=1,2", "++chunk=1,2"]
)
def test_what_all_runs_share_has_one_value(word):
    key = re.escape(word.partition("=")[0])
    with pytest.raises(SettingError, match=rf"\A{key}: is one for all runs"):
        combinations(["seed=1,2", word])


def test_glob_is_every_option_of_its_group():
    solvers = [*combinations(["launcher=basic", "solver=glob(*)"])]
    assert len(solvers) > 1
    assert ["launcher=basic", "solver=clarabel"] in solvers


def test_what_is_gone_or_damaged_is_not_counted_as_flown(tmp_path):
    """A finished folder goes while others fly, and one holds half a result."""
    jobs = jobs_of(tmp_path, "seed=range(3)")
    gone, flown, damaged = (job.folder.path for job in jobs)
    for path in (flown, damaged):
        path.mkdir(parents=True)
        (path / "metrics.json").write_text("{}")
    outcomes = [JobOutcome(str(flown)), JobOutcome(str(damaged), "it is damaged")]
    end = _end_of(jobs, outcomes, finished_before={gone}, unusable={damaged})
    said = "3 runs: 1 flown, 0 finished before, 1 failed, 1 gone"
    assert end.line() == said


def test_a_model_s_file_is_known_by_its_ending():
    for name in ("arm.safetensors", "arm.npz", "'my arm.npz'"):
        assert model_file(f"model={name}") == ["model=saved", f"model.path={name}"]


@pytest.mark.parametrize("is_late", [True, False])
def test_a_run_flown_elsewhere_with_other_settings_has_failed(
    is_late, tmp_path, monkeypatch
):
    """Also where settings ask for what no text of theirs tells."""
    monkeypatch.setenv("GAIN", "0.5")
    words = ["disturbance_gain=${oc.env:GAIN}", f"folder={tmp_path / 'tree'}"]

    def flight(run, *_):
        other = run_header(run.choices, {"disturbance_gain": 0.1}, run.command)
        run.folder.path.mkdir(parents=True)
        run.folder.finish(other | metrics_of(0.1))
        raise Busy("another process works on this run")

    monkeypatch.setattr(_run, "run_one", lambda run, wait: flight(run))
    runs = Sweep("run", words, Console(quiet=True))
    job = runs.job(words)
    assert job.settings.fingerprint() is None
    if not is_late:  # but behind the check
        with suppress(Busy):
            flight(RunToFly({}, {}, job.choices, "gpmpc run", job.folder))
    (outcome,) = runs.fly([job])
    assert "holds a finished run of other settings" in outcome.error
    end = _end_of([job], [outcome], finished_before=set(), unusable=runs.unusable)
    assert (end.finished_now, end.failed) == (0, [outcome])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["b=1", "a=2"], ["a=2", "b=1"]),
        (["p={m:1}", "b=3", "p.m=2"], ["p={m:1}", "b=3", "p.m=2"]),
        (["p.m=2", "b=3", "p={m:1}"], ["p.m=2", "b=3", "p={m:1}"]),
        (["p.m=1", "p={m:1}", "p.m=2"], ["p={m:1}", "p.m=2"]),
        (["b=3", "++b=2"], ["b=3", "++b=2"]),
        (["p=null", "++p.m=2"], ["p=null", "++p.m=2"]),
        # A group's option needs no order: Hydra takes it first.
        (["p=lqr", "p.m=2"], ["p.m=2", "p=lqr"]),
        (["p.m=2", "p=lqr"], ["p.m=2", "p=lqr"]),
    ],
)
def test_choices_of_one_setting_keep_their_order(words, expected, tmp_path):
    assert choices(words) == expected
    assert choices(next(combinations(words))) == expected
    (job,) = jobs_of(tmp_path, "controller=lqr")
    plan = _write_plan(tmp_path, [replace(job, choices=expected)], [])
    assert json.loads(plan.read_text())["runs"] == [expected]
