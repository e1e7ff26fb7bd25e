"""``gpmpc run learning=...`` flies, learns and records what it did."""

import json

import numpy as np

from gpmpc.recording import read_run
from tests.cli.command import forked

TINY = ["model.restarts=0", "horizon=3", f"noise.process={[0.01] * 6}".replace(" ", "")]


def test_a_recorded_flight_shows_when_it_learned_and_repeats(tmp_path):
    gust = (
        "disturbances=[{_target_: gpmpc.simulation.Gust, rates: {vx: 0.5}, start: 10}]"
    )
    flights = []
    for tree in ("first", "second"):
        done = forked(
            "run",
            *TINY,
            gust,
            "learning=online",
            "steps=20",
            f"folder={tree}",
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stderr
        (folder,) = (tmp_path / tree).iterdir()
        run = read_run(folder / "run.mcap")
        assert not (run.gp_sizes[:10] > 189).any()
        assert (run.gp_sizes[12:] > 189).all()
        assert run.gp_versions[-1] > run.gp_versions[10] == 0
        flights.append(run.inputs)
    assert np.array_equal(*flights)


def test_the_flight_that_counts_has_the_best_episodes_model(tmp_path):
    done = forked(
        "run",
        *TINY,
        "learning=episodes",
        "data.size=25",
        "steps=40",
        "folder=tree",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "tree").iterdir()
    result = json.loads((folder / "metrics.json").read_text())
    assert {path.name for path in folder.glob("*.mcap")} == {
        "episode_1.mcap",
        "episode_2.mcap",
        "run.mcap",
    }
    first, second = result["episodes"]
    assert result["training"]["size"] == 25 + (39 if second < first else 0)
    assert result["rmse"]["total"] < 1.1 * first
    assert "episodes before" in done.stdout


def test_what_cannot_learn_is_refused_in_one_line(tmp_path):
    done = forked("run", "learning=online", "controller=nmpc", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "learning" in done.stderr
