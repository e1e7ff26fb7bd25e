"""The examples run as they stand, from the files that they ship with."""

import runpy
import sys
from pathlib import Path

import torch

from gpmpc.gp import Transitions, load_posterior

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_the_gp_example_leaves_a_recording_a_model_and_a_figure(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["reuse_gp.py", str(tmp_path)])
    names = runpy.run_path(str(EXAMPLES / "reuse_gp.py"), run_name="__main__")
    assert {path.name for path in tmp_path.iterdir()} == {"pendulum.csv", "pendulum.safetensors", "tube.png"}
    data = Transitions.from_csv(tmp_path / "pendulum.csv", states=["angle", "rate"], inputs=["torque"])
    gp = load_posterior(tmp_path / "pendulum.safetensors")
    assert float((gp.predict(data.states, data.inputs).mean - data.next_states).abs().max()) < 0.1
    assert names["forecast"].mean.shape == (20, 2)
    # The tube holds what happens: 15 runs of 20 steps, two states.
    runs = torch.tensor([run[1:].tolist() for run in names["runs"]])
    inside = (runs - names["forecast"].mean).abs() <= 1.96 * names["forecast"].variance.sqrt()
    assert 0.85 < float(inside.double().mean()) <= 1.0
    assert (tmp_path / "tube.png").stat().st_size > 10_000
