"""A study keeps finished records and runs what is missing.

Its seeds and names follow from its settings.
"""

import json
import logging
import os
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info

from gpmpc.exceptions import GpmpcError, SettingError, TrainingError
from gpmpc.experiments.figures_tables import _pooled
from gpmpc.experiments.quality import _first_error
from gpmpc.gp import Trainer, Transitions
from gpmpc.studies import study as studied
from gpmpc.studies.study import (
    TrialSpec,
    TrialStore,
    derived_seed,
    fingerprint,
    is_failed,
    is_lost,
    one_thread,
    random_rows,
    read_model,
    run_study,
    trained_model,
)


def test_a_store_finds_records_behind_a_line_cut_short(tmp_path):
    path = tmp_path / "trials.jsonl"
    store = TrialStore(path)
    assert store.records == {}
    assert not path.exists()
    store.append("a", {"error": 1})
    store.append("b", {"error": 2})
    assert [
        json.loads(line)["fingerprint"] for line in path.read_text().splitlines()
    ] == ["a", "b"]
    for torn in ('{"fingerprint": "c", "rec', "[1, 2]\n", '{"record": {}}\n', "\n"):
        path.write_text(path.read_text() + torn)
    again = TrialStore(path)
    assert again.records == store.records == {"a": {"error": 1}, "b": {"error": 2}}
    path.write_text(path.read_text() + '{"fing')
    torn = TrialStore(path)
    torn.append("d", {"error": 4})
    torn.append("e", {"error": 5})
    assert [line[:6] for line in path.read_text().splitlines()][-3:] == ['{"fing'] * 3
    assert [*TrialStore(path).records] == [*torn.records] == ["a", "b", "d", "e"]


def test_a_store_is_of_one_process(tmp_path):
    path = tmp_path / "trials.jsonl"
    with TrialStore.held(path) as store:
        store.append("a", {})
        message = f"{path}: another process runs these trials; wait"
        with pytest.raises(GpmpcError, match=message), TrialStore.held(path):
            pass
    with TrialStore.held(path) as store:
        assert [*store.records] == ["a"]


def test_a_record_is_on_the_disk_when_it_is_kept(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(
        os, "fsync", lambda _: synced.append((tmp_path / "trials.jsonl").read_text())
    )
    TrialStore(tmp_path / "trials.jsonl").append("a", {})
    assert synced == ['{"fingerprint": "a", "record": {}}\n']


def fail(trial):
    if trial.condition == "bad":
        raise TrainingError([0], "no luck")
    if trial.condition == "without a library":
        raise SettingError("model", "needs a library")
    if trial.condition == "singular":
        raise torch.linalg.LinAlgError("not positive definite")
    return {"square": trial.seed**2, "threads": torch.get_num_threads()}


@pytest.fixture
def started(monkeypatch):
    """Returns the order of trials in this process; they finish in the opposite one."""
    started = []

    def in_processes(function, jobs, workers):
        started.extend((job.seed, workers) for job in jobs)
        yield from reversed([(index, function(job)) for index, job in enumerate(jobs)])

    monkeypatch.setattr(studied, "in_processes", in_processes)
    return started


def test_missing_trials_run_and_records_keep_their_order(tmp_path, started):
    conditions = {3: "good", 4: "bad", 5: "singular", 6: "good"}
    trials = [
        TrialSpec({"name": c}, c, seed, f"print{seed}")
        for seed, c in conditions.items()
    ]
    store = TrialStore(tmp_path / "trials.jsonl")
    progress = []
    store.append("print6", {"name": "of an older study", "seed": 6, "square": 36})
    records = run_study(fail, trials, store, 7, progress.append)
    assert started == [(3, 7), (4, 7), (5, 7)]
    assert records == [
        {"name": "good", "seed": 3, "square": 9, "threads": 1},
        {"name": "bad", "seed": 4, "error": "no luck"},
        {"name": "singular", "seed": 5, "error": "not positive definite"},
        {"name": "good", "seed": 6, "square": 36},
    ]
    assert [record["seed"] for record in progress] == [
        6,
        5,
        4,
        3,
    ]  # found, then as they finish
    assert [*TrialStore(store.path).records] == ["print6", "print5", "print4", "print3"]
    again = []
    assert (
        run_study(fail, trials, TrialStore(store.path), None, again.append) == records
    )
    assert [record["seed"] for record in again] == [3, 4, 5, 6]
    assert len(started) == 3


def test_what_trials_remark_is_said_once(tmp_path, started, caplog):
    def remark(trial):
        logging.getLogger("gpmpc.gp").warning("few rows")
        return {}

    trials = [TrialSpec({}, None, seed, f"print{seed}") for seed in range(3)]
    run_study(remark, trials, TrialStore(tmp_path / "trials.jsonl"))
    assert [record.getMessage() for record in caplog.records] == ["few rows"]


def test_a_trial_that_failed_by_its_surroundings_is_run_again(tmp_path, started):
    trials = [TrialSpec({}, "without a library", seed=0, fingerprint="a")]
    for _ in range(2):
        store = TrialStore(tmp_path / "trials.jsonl")
        (record,) = run_study(fail, trials, store, 1)
        assert "needs a library" in record["error"]
        assert is_failed(record)
        assert not is_lost(record)
        # No flight that was lost: a row of published figures counts none.
        row = _pooled([record, {"error": "diverged"}])
        assert (row["trials"], row["lost"]) == (0, 1)
        assert _first_error([record | {"trajectory": "lorenz"}]).startswith("failed: ")
    assert len(started) == 2


def test_other_errors_end_the_study_and_dead_workers_are_named(
    tmp_path, started, monkeypatch
):
    trials = [TrialSpec({}, None, seed=0, fingerprint="a")]
    with pytest.raises(ZeroDivisionError):
        run_study(lambda _: 1 / 0, trials, TrialStore(tmp_path / "trials.jsonl"))

    def die(*_):
        raise BrokenProcessPool
        yield

    monkeypatch.setattr(studied, "in_processes", die)
    with pytest.raises(GpmpcError, match="a worker process died"):
        run_study(fail, trials, TrialStore(tmp_path / "trials.jsonl"))


def test_rows_and_seeds_follow_from_the_seed_alone():
    assert random_rows(6, 6, 0) == list(range(6))
    assert random_rows(6, 0, 0) == []
    assert random_rows(100, 3, 5) == sorted(
        np.random.default_rng(5).permutation(100)[:3].tolist()
    )
    with pytest.raises(
        SettingError, match="data.size: must be at most 6, the rows of the data; got 7"
    ):
        random_rows(6, 7, 0, "data.size")
    seeds = [
        derived_seed(*parts)
        for parts in ((0, 0), (0, 1), (1, 0), (1, 1), (2**32 - 1, 0))
    ]
    assert len({*seeds}) == len(seeds)
    assert (
        derived_seed(1, 2, 3) == np.random.SeedSequence([1, 2, 3]).generate_state(2)[0]
    )


def test_a_fingerprint_is_of_settings_arrays_and_code_alone(tmp_path, monkeypatch):
    array = np.arange(6.0)
    cases = [
        ({"a": 1, "b": 2}, []),
        ({"a": 2, "b": 1}, []),
        ([1], []),
        ([1], [array]),
        ([1], [array + 1]),
        ([1], [array[:5]]),
        ([1], [array.reshape(2, 3)]),
        ([1], [array.astype(np.float32)]),
        ([1], [array[:2], array[2:]]),
        ([1], [None, array]),
        ([1], [array, None]),
    ]
    prints = [fingerprint(settings, arrays) for settings, arrays in cases]
    assert len({*prints}) == len(prints)
    assert {len(each) for each in prints} == {32}
    assert fingerprint({"b": 2, "a": 1}) == prints[0]
    assert fingerprint([1], [array[::-1][::-1]]) == prints[3]
    assert fingerprint([1], [torch.arange(6.0)]) == prints[3]
    assert fingerprint(tmp_path) == fingerprint(
        str(tmp_path)
    )  # what is no plain data counts by its text
    monkeypatch.setattr(studied, "code_fingerprint", lambda: "other code")
    assert prints[3] != fingerprint([1], [array])


def test_one_training_for_the_same_code_settings_data_and_seed(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    calls = []
    states = torch.from_numpy(rng.normal(size=(12, 1)))
    data = Transitions(states, torch.zeros(12, 1) + states**2, 0.5 * states)

    def train(data, seed):
        calls.append((len(data), seed, torch.get_num_threads()))
        return Trainer(restarts=0)(data, seed=seed)

    path = trained_model(train, {"a": 1}, data, 4, tmp_path)
    assert path == trained_model(train, {"a": 1}, data, 4, tmp_path)
    assert calls == [(12, 4, 1)]
    others = [({"a": 2}, data, 4), ({"a": 1}, data[:9], 4), ({"a": 1}, data, 5)]
    paths = {path, *(trained_model(train, *each, tmp_path) for each in others)}
    assert len(paths) == len(calls) == 4
    assert sorted(paths) == sorted((tmp_path / "models").iterdir())
    model = read_model(path)
    query = torch.zeros(1, 1)
    assert model is read_model(path)
    assert model.state_dim == model.input_dim == 1
    assert torch.isfinite(model.predict(query, query).mean).all()
    monkeypatch.setattr(studied, "code_fingerprint", lambda: "other code")
    assert trained_model(train, {"a": 1}, data, 4, tmp_path) not in paths
    assert len(calls) == 5


def test_one_thread_is_one_and_as_many_as_before_afterwards():
    torch.set_num_threads(2)
    try:
        with one_thread():
            assert torch.get_num_threads() == 1
            assert all(library["num_threads"] == 1 for library in threadpool_info())
        assert torch.get_num_threads() == 2
        with pytest.raises(ZeroDivisionError), one_thread():
            1 / 0  # noqa: B018
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
