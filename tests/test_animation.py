"""The animation of a flight shows what it draws."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.animation import PillowWriter

from gpmpc.plotting import animate
from gpmpc.recording import read_run
from tests.recording.runs import record_run

STEPS = 8
HORIZON = 5


def flight(folder, failed=()):
    """Records a flight along x and back in y, with plans of five steps.

    The plan of a failed solve is anywhere.
    """
    record_run(folder / "run.mcap", STEPS)
    run = read_run(folder / "run.mcap")
    along = np.zeros((STEPS + HORIZON, len(run.state_names)))
    along[:, 0] = 3.0 * np.arange(STEPS + HORIZON)
    along[:, 2] = -np.arange(STEPS + HORIZON)
    plans = np.stack([along[k : k + HORIZON + 1] for k in range(STEPS)])
    plans[list(failed)] = 1e6
    astray = np.isin(np.arange(STEPS), failed)
    return replace(
        run,
        states=along[:STEPS],
        references=along[:STEPS],
        plan_means=plans,
        failed=astray,
    )


@pytest.fixture
def frames_of(tmp_path, monkeypatch):
    """What ``animate`` draws: limits of the left view, and its lines, step by step."""
    frames = []

    def look(writer, **settings):
        above, height = writer.fig.axes[:2]
        lines = [
            [np.array(line.get_xydata()) for line in a.lines] for a in (above, height)
        ]
        frames.append((above.get_xlim(), above.get_ylim(), *lines))

    def finish(writer):
        Path(writer.outfile).write_bytes(b"no picture")

    monkeypatch.setattr(PillowWriter, "grab_frame", look)
    monkeypatch.setattr(PillowWriter, "finish", finish)

    def drawn(run):
        animate(run, tmp_path / "flight.gif")
        return frames

    return drawn


def test_every_plan_lies_in_the_left_view(tmp_path, frames_of):
    run = flight(tmp_path)
    frames = frames_of(run)
    assert len(frames) == STEPS
    for plan, ((left, right), (low, high), above, _) in zip(
        run.plan_means[:, :, [0, 2]], frames, strict=True
    ):
        assert any(np.array_equal(line, plan) for line in above)
        x, y = plan.T
        assert left < x.min() <= x.max() < right
        assert low < y.min() <= y.max() < high


def test_a_failed_solves_plan_does_not_shrink_the_flight(tmp_path, frames_of):
    for (left, right), *_ in frames_of(flight(tmp_path, failed=[4])):
        assert right - left < 60  # [m], of a path of 36


def test_no_path_is_drawn_across_lost_steps(tmp_path, frames_of):
    run = flight(tmp_path)
    rows = np.array([0, 1, 2, 3, 6, 7])
    per_step = ("steps", "times", "references", "states", "inputs", "timings")
    per_step += ("plan_means", "plan_covariances", "failed", "judgements")
    parts = {name: getattr(run, name)[rows] for name in per_step}
    *_, above, height = frames_of(replace(run, **parts))[-1]
    for lines in (above, height):
        flown = lines[1]
        assert np.flatnonzero(np.isnan(flown).any(axis=1)).tolist() == [4]
