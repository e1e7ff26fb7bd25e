"""The scripts of the ten robots are as short as the gallery says, and make rows."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.robots.__main__ import FOLDER, ROBOTS, Simulated
from gpmpc.systems import pendulum, step_many

MOST_LINES = 30


def lines_of(script):
    """Lines of code beside imports and docstring."""
    code = script.partition('"""\n')[2]
    return [
        line
        for line in code.splitlines()
        if line.strip() and not line.startswith(("import ", "from "))
    ]


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_is_a_short_script_of_noisy_random_rows(robot, tmp_path, monkeypatch):
    if robot == "arm":
        pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [f"{robot}.py", "0"])
    script = Path(FOLDER / f"{robot}.py").read_text()
    assert len(lines_of(script)) <= MOST_LINES
    before_training = script[: script.index("\nmodel = train(")]
    names = {}
    exec(compile(before_training, robot, "exec"), names)
    rows = (
        names["data"] if "data" in names else names["rows"].transitions(names["plant"])
    )
    assert 300 <= len(rows) <= 500
    assert re.search(r"noise=(noise|\[)", script)


def test_a_simulator_is_differentiated_by_its_steps():
    plant = pendulum()
    states = np.array([[0.3, -1.0], [2.0, 3.0]])
    inputs = np.array([[0.5], [-1.0]])
    next_states, A, B = Simulated(plant).linearize(states, inputs)
    assert np.array_equal(next_states, step_many(plant, states, inputs))
    assert A.shape == (2, 2, 2)
    moved = step_many(plant, states + np.array([0.0, 1e-4]), inputs + 1e-4)
    assert np.allclose(moved - next_states, 1e-4 * (A[:, :, 1] + B[:, :, 0]), atol=1e-7)
