"""Data, models and files carry names and time step; what disagrees is refused."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from gpmpc.calibration import Recording, calibrate
from gpmpc.estimation import with_process_noise
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gp import (
    KernelPosterior,
    SlidingWindow,
    SparseTrainer,
    Trainer,
    Transitions,
    append_transitions,
    from_gpytorch,
    load_posterior,
    remove_points,
    save_posterior,
    to_gpytorch,
    train,
)
from gpmpc.learning import ChangedModel
from gpmpc.models import (
    Affine,
    DelayedModel,
    DisturbedModel,
    Lags,
    NoisyModel,
    ResidualModel,
    load_model,
    save_model,
)
from gpmpc.signals import Signals, signals_of
from tests.gp.model_files import write_npz

KNOWN = Signals(("angle", "rate"), ("torque",), 0.1)
rng = np.random.default_rng(0)
STATES = pd.DataFrame(rng.normal(size=(20, 2)), columns=["angle", "rate"])
INPUTS = pd.DataFrame(rng.normal(size=(20, 1)), columns=["torque"])
AFTER = 0.9 * STATES + 0.1 * INPUTS.to_numpy()
SWAPPED = ["rate", "angle"]


def data(signals=KNOWN):
    arrays = (table.to_numpy() for table in (STATES, INPUTS, AFTER))
    states, inputs, after = arrays
    return Transitions(states, inputs, after, signals)


@pytest.fixture(scope="module")
def posterior():
    return train(data(), restarts=0).posterior


def residual():
    return ResidualModel.train(
        Affine.identity(2, 1), data(), trainer=Trainer(restarts=0)
    )


@pytest.mark.parametrize(
    "after",
    [
        AFTER[SWAPPED],
        AFTER[SWAPPED].add_prefix("next_"),
        AFTER[SWAPPED].add_suffix("+"),
        AFTER[SWAPPED].add_prefix("x/").add_suffix("[k+1]"),
    ],
    ids=lambda table: ", ".join(table.columns),
)
def test_next_states_are_sorted_like_the_states(after):
    read = Transitions(STATES, INPUTS, after)
    assert torch.equal(read.next_states, data().next_states)
    assert read.signals == replace(KNOWN, time_step=None)


def test_columns_of_numbers_or_pairs_are_sorted_but_no_names():
    for labels in ([0, 1], [("a", 0), ("a", 1)]):
        states = STATES.set_axis(pd.Index(labels), axis=1)
        after = AFTER.set_axis(states.columns, axis=1).iloc[:, [1, 0]]
        read = Transitions(states, INPUTS, after)
        assert torch.equal(read.next_states, data().next_states)
        assert read.signals.state_names == ()


def test_columns_of_one_name_are_no_names():
    same = STATES.set_axis(["x", "x"], axis=1)
    read = Transitions(same, INPUTS, AFTER.set_axis(["x", "x"], axis=1))
    assert read.signals.state_names == ()
    assert torch.equal(read.next_states, data().next_states)


def test_columns_of_recordings_have_the_names_of_their_system():
    measured = STATES.add_prefix("measured.")
    applied = INPUTS.add_prefix("input.")
    read = Transitions(measured, applied, measured.shift(-1, fill_value=0.0))
    assert read.signals == replace(KNOWN, time_step=None)
    both = ["state.angle", "measured.angle"]
    assert Signals(both).state_names == tuple(both)


def test_columns_are_sorted_by_the_names_that_are_given():
    names = Signals(SWAPPED, ["torque"])
    read = Transitions(STATES, INPUTS, AFTER, names)
    assert torch.equal(read.states, data().states[:, [1, 0]])
    assert torch.equal(read.next_states, data().next_states[:, [1, 0]])
    again = replace(data(), states=STATES[SWAPPED])
    assert torch.equal(again.states, data().states)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"next_states": AFTER.rename(columns={"rate": "speed"})},
            "next_states must have the columns of the states.*angle, speed, states a",
        ),
        (
            {"next_states": AFTER.set_axis(["a", "b"], axis=1)},
            "next_states must have the columns of the states.*a, b, states angle, rate",
        ),
        (
            {"states": STATES.set_axis(["a", "b"], axis=1)},
            "states must have the names angle, rate; got a, b",
        ),
        (
            {"inputs": INPUTS.set_axis(["push"], axis=1)},
            "inputs must have the names torque; got push",
        ),
    ],
)
def test_tables_of_other_columns_are_refused_by_name(changed, message):
    tables = {"states": STATES, "inputs": INPUTS, "next_states": AFTER}
    signals = KNOWN if "states" in changed or "inputs" in changed else Signals()
    with pytest.raises(DataError, match=message):
        Transitions(**tables | changed, signals=signals)


@pytest.mark.parametrize(
    ("signals", "error", "message"),
    [
        (Signals(["angle"]), ShapeError, "2 states need as many names; got angle"),
        (Signals((), ["a", "b"]), ShapeError, "1 inputs need as many names; got a, b"),
        (
            {"time_step": 0.1},
            SettingError,
            r"signals: must be Signals\(...\); got dict",
        ),
        (None, SettingError, r"signals: must be Signals\(...\); got NoneType"),
    ],
)
def test_names_that_do_not_fit_the_data_are_refused(signals, error, message):
    with pytest.raises(error, match=message):
        data(signals)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"state_names": "angle"}, "state_names: must be a list of different names"),
        ({"state_names": ["a", "a"]}, "state_names: must be a list of different names"),
        ({"input_names": [1]}, "input_names: must be a list of different names"),
        ({"time_step": 0}, r"time_step: must be a number above 0 \[s\]; got 0"),
        ({"time_step": "0.1"}, "time_step: must be a number above 0"),
    ],
)
def test_names_are_different_texts_and_time_steps_positive(settings, message):
    with pytest.raises(SettingError, match=message):
        Signals(**settings)


def test_a_csv_file_names_its_columns_and_sorts_next_states(tmp_path):
    table = pd.concat([STATES, INPUTS, AFTER.add_prefix("next_")], axis=1)
    table.to_csv(tmp_path / "log.csv", index=False)
    read = Transitions.from_csv(
        tmp_path / "log.csv",
        states=["angle", "rate"],
        inputs=["torque"],
        next_states=["next_rate", "next_angle"],
        time_step=0.1,
    )
    assert read.signals == KNOWN
    assert torch.allclose(read.next_states, data().next_states, rtol=0, atol=1e-15)


def test_names_outlast_rows_files_copies_and_processes(tmp_path):
    named = data()
    named.save(tmp_path / "data.npz")
    for other in (
        named[2:5],
        named[[1, 3]],
        replace(named, inputs=named.inputs + 1),
        pickle.loads(pickle.dumps(named)),
        Transitions.load(tmp_path / "data.npz"),
        *Recording.chained(named),
    ):
        assert other.signals == KNOWN


def test_files_without_names_are_read_and_wrong_ones_are_named(tmp_path):
    arrays = {
        name: getattr(data(), name).numpy()
        for name in ("states", "inputs", "next_states")
    }
    header = {"format": "gpmpc transitions", "format_version": 1}
    for said, good in (
        ({}, True),
        ({"signals": {}}, True),
        ({"signals": {"state_names": ["a"]}}, False),
        ({"signals": {"state_names": 3}}, False),
        ({"signals": {"names": ["a", "b"]}}, False),
        ({"signals": ["a", "b"]}, False),
    ):
        path = tmp_path / "data.npz"
        write_npz(path, header | said, arrays)
        if good:
            assert Transitions.load(path).signals == Signals()
            continue
        with pytest.raises(DataError, match=r"data.npz: "):
            Transitions.load(path)
    np.savez(tmp_path / "data.npz", **arrays)
    assert Transitions.load(tmp_path / "data.npz").signals == Signals()


def test_what_is_made_of_a_model_carries_its_names(posterior):
    gpytorch = to_gpytorch(posterior)
    values = train(data(), restarts=0, predicts="difference").posterior
    log_noise = replace(values, predicts="value")
    for model in (
        posterior,
        posterior.to(dtype=torch.float32),
        pickle.loads(pickle.dumps(posterior)),
        append_transitions(posterior, data()),
        remove_points(posterior, [0, 3]),
        SlidingWindow(10)(posterior, data()[:3]),
        Trainer(restarts=0).refit(posterior, data()[:3]).posterior,
        SparseTrainer(inducing=5, iterations=1)(data()).posterior,
        from_gpytorch(gpytorch, input_dim=1),
        from_gpytorch(gpytorch.train(), input_dim=1, signals=KNOWN),
        KernelPosterior.from_gpytorch(gpytorch, input_dim=1),
        with_process_noise(posterior, posterior.noise_variance),
        NoisyModel(posterior, log_noise, [0, 1]),
        ChangedModel(posterior),
        residual(),
        residual().append(data()[:2]),
        residual().to(dtype=torch.float64),
    ):
        assert model.signals == KNOWN


def test_further_states_of_a_model_have_names_of_their_own(posterior):
    delayed = DelayedModel(posterior, 1.5)
    later = ("torque[k-2]", "torque[k-1]")
    assert delayed.signals.state_names == (*KNOWN.state_names, *later)
    effect = torch.eye(2, dtype=torch.float64)
    disturbed = DisturbedModel(posterior, effect, [0.1, 0.1])
    added = ("disturbance1", "disturbance2")
    assert disturbed.signals.state_names == (*KNOWN.state_names, *added)
    assert DelayedModel(delayed, 1).signals.state_names == ()  # two of one name
    remembered = Lags(2, 1, states=1, inputs=1).transitions(STATES, INPUTS)
    assert remembered.signals.state_names == (
        *KNOWN.state_names,
        "angle[k-1]",
        "rate[k-1]",
        "torque[k-1]",
    )


def test_saved_models_carry_names_and_files_without_are_read(tmp_path, posterior):
    path = tmp_path / "model.safetensors"
    for model in (posterior, residual(), DelayedModel(residual(), 2)):
        save_model(model, path)
        assert load_model(path).signals == model.signals
    save_posterior(posterior, path)
    assert load_posterior(path).signals == KNOWN
    save_posterior(replace(posterior, signals=Signals()), path)
    assert load_posterior(path).signals == Signals()


def test_a_model_file_of_wrong_names_is_refused(tmp_path, posterior):
    path = tmp_path / "model.safetensors"
    with pytest.raises(
        SettingError, match=r"signals: must be Signals\(...\); got dict"
    ):
        save_posterior(replace(posterior, signals={}), path)
    for signals in (Signals(["angle"]), Signals((), ["a", "b"])):
        with pytest.raises((DataError, ShapeError), match="need as many names"):
            save_posterior(replace(posterior, signals=signals), path)


@pytest.mark.parametrize(
    ("signals", "message"),
    [
        (
            Signals(SWAPPED),
            "has the states angle, rate; transitions has rate, angle, the same in",
        ),
        (Signals((), ["push"]), "has the inputs torque; transitions has push"),
        (Signals(time_step=0.5), "has time steps of 0.1 s; transitions has 0.5 s"),
    ],
)
def test_data_of_other_names_or_time_step_join_no_model(posterior, signals, message):
    other = data(signals)
    for join in (
        lambda: append_transitions(posterior, other),
        lambda: SlidingWindow(30)(posterior, other),
        lambda: Trainer(restarts=0).refit(posterior, other),
        lambda: residual().append(other),
    ):
        with pytest.raises(SettingError, match=message):
            join()
    with pytest.raises(SettingError, match=message.replace("transitions", "the rec.*")):
        calibrate(posterior, Recording.chained(other), horizon=1)


def test_an_attribute_of_that_name_but_another_kind_is_ignored():
    class Machine:
        signals = ("SIGINT", "SIGTERM")

    assert signals_of(Machine()) == Signals()


def test_what_is_not_known_is_checked_against_nothing(posterior):
    for signals in (Signals(), Signals(KNOWN.state_names), Signals(time_step=0.1)):
        assert append_transitions(posterior, data(signals)).signals == KNOWN
        calibration = calibrate(posterior, Recording.chained(data(signals)), horizon=1)
        assert calibration.names == KNOWN.state_names
    unknown = replace(posterior, signals=Signals())
    assert len(append_transitions(unknown, data())) == 40


def test_a_time_step_measured_from_stamps_is_the_same_one():
    KNOWN.check("the model", Signals(time_step=0.10005), "the log")
    with pytest.raises(SettingError, match="time steps of 0.1 s"):
        KNOWN.check("the model", Signals(time_step=0.1005), "the log")


def test_names_are_plain_data_in_a_file(tmp_path):
    assert json.loads(json.dumps(KNOWN.to_header())) == {
        "state_names": ["angle", "rate"],
        "input_names": ["torque"],
        "time_step": 0.1,
    }
    assert Signals.from_header(KNOWN.to_header()) == KNOWN
