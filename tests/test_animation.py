"""The animation of a flight shows what it draws."""

from dataclasses import replace

import numpy as np

from gpmpc.plotting._animation import draw_flight
from gpmpc.plotting._style import PLAN
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


def left_views(run):
    """Yields the limits of the view from above, and the plan drawn there, by step."""
    picture = draw_flight(run)
    above = picture.figure.axes[0]
    (plan,) = [line for line in above.lines if line.get_color() == PLAN]
    for k in range(STEPS):
        picture.draw(k)
        yield above.get_xlim(), above.get_ylim(), plan.get_xdata(), plan.get_ydata()


def test_every_plan_lies_in_the_left_view(tmp_path):
    for (left, right), (low, high), x, y in left_views(flight(tmp_path)):
        assert len(x) == HORIZON + 1
        assert left < x.min() <= x.max() < right
        assert low < y.min() <= y.max() < high


def test_a_failed_solves_plan_does_not_shrink_the_flight(tmp_path):
    for (left, right), *_ in left_views(flight(tmp_path, failed=[4])):
        assert right - left < 60  # [m], of a path of 36
