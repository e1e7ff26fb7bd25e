"""Logs and model files say what their states and inputs are."""

import numpy as np
import pytest

from gpmpc.datasets import RandomData
from gpmpc.exceptions import SettingError
from gpmpc.gp import Transitions, train
from gpmpc.logs import load_flyable, read_log
from gpmpc.models import save_model
from gpmpc.signals import Signals
from gpmpc.systems import System, pendulum

PENDULUM = {
    "time": "t",
    "states": {"angle": ["state.angle"], "rate": ["state.rate"]},
    "inputs": {"torque": ["input.torque"]},
}
ROWS = np.random.default_rng(0).normal(size=(40, 4))
ROWS[:, 0] = 0.05 * np.arange(40)


class Swapped:
    state_names = ("rate", "angle")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [x[1] + u[0], x[0]]


def log(path, header="t,state.angle,state.rate,input.torque", mapping=PENDULUM):
    np.savetxt(path, ROWS, delimiter=",", header=header, comments="")
    return read_log(path, mapping)


def test_transitions_and_episodes_carry_names_and_rate(tmp_path):
    read = log(tmp_path / "log.csv")
    assert read.signals.state_names == ("angle", "rate")
    assert read.signals.time_step == pytest.approx(0.05)
    for rows in (read.transitions(), *read.episodes()):
        pendulum(0.05).signals.check("the plant", rows.signals, "the log")
        assert rows.signals == read.signals


def test_a_recording_is_read_with_the_names_of_its_system(tmp_path):
    log(tmp_path / "log.csv")
    names = {"states": ["state.angle", "state.rate"], "inputs": ["input.torque"]}
    read = Transitions.from_csv(tmp_path / "log.csv", **names)
    assert read.signals == Signals(["angle", "rate"], ["torque"])


def test_columns_of_one_name_in_a_log_are_no_names(tmp_path):
    read = log(tmp_path / "log.csv")
    group = read.space.groups[0]
    twice = type(read.space)((group, group))
    signals = [
        type(read)(
            mapping=type("Mapping", (), {"space": twice, "of": read.mapping.of})(),
            time_step=0.05,
            runs=read.runs,
        ).signals
    ]
    assert signals == [Signals((), ["torque"], 0.05)]


@pytest.mark.parametrize("said", ["signals", "metadata"])
def test_a_model_file_flies_only_the_system_that_it_names(tmp_path, said):
    data = RandomData(samples=10).transitions(pendulum(0.1))
    path = tmp_path / "model.safetensors"
    metadata = None
    if said == "metadata":  # as before models carried names
        data = Transitions(data.states, data.inputs, data.next_states)
        metadata = {"states": ["angle", "rate"], "inputs": ["torque"], "time_step": 0.1}
    save_model(train(data, restarts=0).posterior, path, metadata)
    saved = load_flyable(path)
    saved.check(pendulum(0.1))
    with pytest.raises(SettingError, match=r"states angle, rate; Swapped has rate"):
        saved.check(System(Swapped(), 0.1))
    with pytest.raises(SettingError, match=r"time steps of 0.1 s; pendulum has 0.05 s"):
        saved.check(pendulum(0.05))
