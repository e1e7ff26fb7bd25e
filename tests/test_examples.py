"""The examples run as they stand, from the files that they ship with."""

import runpy
import sys
from pathlib import Path

import pytest
import torch

from gpmpc import plotting
from gpmpc.gp import Transitions, load_posterior

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_the_gp_example_leaves_a_recording_a_model_and_a_figure(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["reuse_gp.py", str(tmp_path)])
    names = runpy.run_path(str(EXAMPLES / "reuse_gp.py"), run_name="__main__")
    assert {path.name for path in tmp_path.iterdir()} == {
        "pendulum.csv",
        "pendulum.safetensors",
        "tube.png",
    }
    data = Transitions.from_csv(
        tmp_path / "pendulum.csv", states=["angle", "rate"], inputs=["torque"]
    )
    gp = load_posterior(tmp_path / "pendulum.safetensors")
    assert (
        float(
            (gp.predict(data.states, data.inputs).mean - data.next_states).abs().max()
        )
        < 0.1
    )
    assert names["forecast"].mean.shape == (20, 2)
    # The tube holds what happens: 15 runs of 20 steps, two states.
    runs = torch.tensor([run[1:].tolist() for run in names["runs"]])
    inside = (runs - names["forecast"].mean).abs() <= 1.96 * names[
        "forecast"
    ].variance.sqrt()
    assert 0.85 < float(inside.double().mean()) <= 1.0
    assert (tmp_path / "tube.png").stat().st_size > 10_000


def test_the_example_of_the_readme_swings_a_pendulum_up(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(EXAMPLES / "swing_up.py"), run_name="__main__")
    assert float(abs(names["flight"].states[-1]).max()) < 1e-2
    readme = (EXAMPLES.parent / "README.md").read_text()
    assert (EXAMPLES / "swing_up.py").read_text().partition('"""\n\n')[
        2
    ].strip() in readme
    printed = capsys.readouterr().out.strip()
    assert printed == "upright after 2.95 s"
    assert f"`{printed}`" in readme
    assert (tmp_path / "swing_up.png").exists()


def test_the_example_of_a_custom_system_follows_its_waypoints(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(sys, "argv", ["own_system.py", str(tmp_path)])
    names = runpy.run_path(str(EXAMPLES / "own_system.py"), run_name="__main__")
    assert names["result"]["rmse"]["total"] < 0.05
    assert names["result"]["lost"] is None
    assert float(names["calibration"].coverage[0, :, 2].min()) > 0.85
    assert "RMSE" in capsys.readouterr().out
    assert (tmp_path / "own_system.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_example_of_a_log_learns_and_leaves_a_figure(tmp_path, capsys):
    names = runpy.run_path(str(EXAMPLES / "own_log.py"))
    names["main"](tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        *(f"flight_{i}.csv" for i in (1, 2, 3)),
        "own_log.png",
    }
    printed = capsys.readouterr().out
    assert "gaps, up to 0.3" in printed
    assert "held value" in printed
    assert "motor torque" in printed
    assert (tmp_path / "own_log.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_mujoco_quadrotor_flies_better_by_logs_than_data_sheet(tmp_path):
    pytest.importorskip("mujoco")
    errors = runpy.run_path(str(EXAMPLES / "mujoco_flight.py"))["main"](tmp_path)
    assert (
        errors["learned, disturbance_gain 0"]
        < 0.3 * errors["data sheet, disturbance_gain 0"]
    )
    assert (
        errors["learned, disturbance_gain 0"]
        < 0.7 * errors["data sheet, disturbance_gain 0.3"]
    )


def test_the_example_of_a_payload_learns_and_corrects(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    whole_film = plotting.film

    def short_film(run, system, path, frames, enlarged):
        whole_film(run, system, path, frames=frames // 20, enlarged=enlarged)

    monkeypatch.setattr(plotting, "film", short_film)
    monkeypatch.setattr(sys, "argv", ["payload.py", str(tmp_path)])
    errors = [
        *runpy.run_path(str(EXAMPLES / "payload.py"), run_name="__main__")[
            "rmse"
        ].values()
    ]
    assert errors[2] < 0.05
    assert errors[2] < errors[1] / 3 < errors[0] / 3
    assert (tmp_path / "payload.png").stat().st_size > 10_000
    film = tmp_path / "payload.gif"  # where MuJoCo renders without a screen
    assert not film.exists() or film.stat().st_size > 20_000


def test_the_example_of_a_wall_keeps_its_promised_probability(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(sys, "argv", ["wall.py", str(tmp_path)])
    names = runpy.run_path(str(EXAMPLES / "wall.py"), run_name="__main__")
    beyond = [
        float((flight.states[1:, 0] > names["WALL"]).mean())
        for flight in names["flights"].values()
    ]
    assert beyond[1] <= 0.05 < beyond[0]
    assert "beyond the wall in 12.8% of the steps" in capsys.readouterr().out
    assert (tmp_path / "wall.png").stat().st_size > 10_000


def test_the_example_of_a_reactor_earns_more_and_stays_cool(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["reactor.py", str(tmp_path)])
    names = runpy.run_path(str(EXAMPLES / "reactor.py"), run_name="__main__")
    economic, held = (flight.states for flight in names["flights"].values())
    assert economic[100:, 0].mean() < held[100:, 0].mean() - 0.02
    assert (economic[1:, 1] > names["HOTTEST"]).mean() <= 0.05
    assert (tmp_path / "reactor.png").stat().st_size > 10_000


def test_the_example_of_moving_obstacles_touches_none(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["obstacles.py", str(tmp_path)])
    names = runpy.run_path(str(EXAMPLES / "obstacles.py"), run_name="__main__")
    assert names["away"] < 0.2
    assert names["nearest"] > 0.0
    assert names["loop"].failures == 0
    assert (tmp_path / "obstacles.png").stat().st_size > 10_000


def test_the_example_of_online_learning_finds_the_added_mass(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(sys, "argv", ["learning.py", str(tmp_path)])
    names = runpy.run_path(str(EXAMPLES / "learning.py"), run_name="__main__")
    away = {
        name: abs(f.states - f.references)[26:, [0, 2, 4]].max()
        for name, f in names["flights"].items()
    }
    assert away["online learning"] < 0.2 < 2.0 < away["as learned"]
    assert "online learning" in capsys.readouterr().out
    assert (tmp_path / "learning.png").stat().st_size > 10_000
