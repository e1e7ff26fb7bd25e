import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError, TrainingError
from gpmpc.gp import Trainer, Transitions, standardize, train_many
from gpmpc.gp.training import _PROCESS, _workers_that_fit


def transitions(rows, n=2, seed=0):
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(rows, n)), rng.normal(size=(rows, 1))
    moved = np.sin(x) + 0.1 * u + 0.01 * rng.normal(size=x.shape)
    return Transitions(*map(torch.from_numpy, (x, u, moved)))


def test_many_trainings_at_once_have_the_numbers_of_each_alone():
    trainer = Trainer(predicts="difference", scaling=standardize, restarts=1, subset=40)
    hopeless = transitions(8)
    hopeless = Transitions(hopeless.states, hopeless.inputs, 1e200 * hopeless.next_states)
    sets, seeds, calls = [transitions(12), transitions(50, n=3, seed=1), hopeless], [5, 6, 7], []
    plain = Trainer(restarts=1)
    trainings = train_many(trainer, sets[:2], seeds[:2], workers=2, progress=lambda *done: calls.append(done))
    assert calls == [(done, 5) for done in range(1, 6)]
    for one, data, seed in zip(trainings, sets, seeds, strict=False):
        alone = trainer(data, seed)
        assert np.array_equal(one.theta, alone.theta)
        assert np.array_equal(one.objective, alone.objective)
        assert np.array_equal(one.explored, alone.explored)
        assert torch.equal(one.posterior.weights, alone.posterior.weights)
        assert one.evaluations == alone.evaluations
        assert one.seconds > 0
    failed, fine = train_many(plain, [hopeless, sets[0]], 3, workers=1)
    assert isinstance(failed, TrainingError)
    assert failed.outputs == [0, 1]
    assert np.array_equal(fine.theta, plain(sets[0], 3).theta)


def test_no_set_is_no_training():
    assert train_many(Trainer(), []) == []


def test_misuse_is_refused_before_any_work(monkeypatch):
    with pytest.raises(ShapeError, match="one seed a set is needed, or one for all; got 2 for 1 sets"):
        train_many(Trainer(), [transitions(5)], [1, 2])
    monkeypatch.setattr("gpmpc.gp.training.available_memory", lambda: 5 * 8 * 100**2)
    with pytest.raises(DataError, match="2 trainings of exact GPs of up to 100 points"):
        train_many(Trainer(), [transitions(100), transitions(100)])


def test_there_are_as_many_workers_as_memory_holds(monkeypatch):
    monkeypatch.setattr("gpmpc.gp.training.cores", lambda: 8)
    monkeypatch.setattr("gpmpc.gp.training.available_memory", lambda: 3.5 * _PROCESS)
    assert _workers_that_fit([(100, 6)], "closed_form", 6) == 3
    assert _workers_that_fit([(100, 2)], "closed_form", 2) == 2
    monkeypatch.setattr("gpmpc.gp.training.available_memory", lambda: None)
    assert _workers_that_fit([(100, 6)], "closed_form", 6) == 6


@pytest.mark.parametrize("setting", [{"workers": 0}, {"workers": 1.5}, {"seeds": "a"}, {"seeds": [-1]}])
def test_seeds_and_workers_out_of_range_are_refused(setting):
    with pytest.raises(SettingError, match=next(iter(setting))):
        train_many(Trainer(), [], **setting)
