"""What a run says at its end are the numbers of its metrics."""

import io

import numpy as np
import pytest
from rich.console import Console

from gpmpc.mpc.problem import Box
from gpmpc.studies.document import terminal
from gpmpc.studies.flight import summary
from gpmpc.studies.run_folder import record
from tests.studies.made_up import metrics_of

OPTIONS = {"trajectory": "lorenz", "system": "translational", "data": "excited", "controller": "convex"}


def said(result, **options):
    stream = io.StringIO()
    about = record([], {"seed": 0, "options": OPTIONS | options}, "gpmpc run")
    Console(file=stream, width=200).print(terminal([summary(about | result)]))
    lines = [line.strip() for line in stream.getvalue().splitlines()]
    return {line.split("  ")[0]: line.partition("  ")[2].strip() for line in lines if "  " in line}


@pytest.mark.parametrize("failing", [0, 3])
def test_a_summary_has_a_line_for_each_thing_that_is_measured(failing):
    result = metrics_of(0.125, steps=20, failing=failing)
    lines = said(result)
    assert lines["flight"] == "20 steps of translational along lorenz with convex"
    assert lines["RMSE [m]"].startswith("0.125  (x 0.125, y 0, z 0)")
    assert lines["failed solves"] == (f"INFEASIBLE {failing}" if failing else "none")
    assert result["violations"]
    for name, rate in result["violations"].items():
        assert lines[f"bounds of {name}"].startswith(
            f"{rate['violations']} of {rate['steps']} steps outside (95 %: 0 to"
        )
    assert lines["decision [ms]"].startswith("median 3.1  (model 1, build 0.1, solve 2), 99 % below 3.1")
    assert said(result, trajectory="goal", system="pendulum")["flight"] == "20 steps of pendulum with convex"


def test_everything_that_a_result_may_hold_has_its_line():
    result = metrics_of(0.125, steps=20)
    result |= {
        "settings": {
            "options": OPTIONS,
            "system": {"mass": 1.0, "arm": 0.2},
            "plant": {"mass": 1.5, "arm": 0.2},
            "model": {"path": "model.safetensors"},
            "nominal": {"mass": 0.9},
        },
        "training": {"size": 40},
        "times": result["times"] | {"training": 1.234},
        "lost": {"step": 3, "time": 0.3, "reason": "away"},
        "error_at_end": 0.5,
        "episodes": [0.25, None],
        "suboptimal": {"ITERATION_LIMIT": 2, "TIME_LIMIT": 1},
        "far_from_data": 7,
    }
    lines = dict(summary(result).rows)
    assert lines["flown with"] == "mass 1.5 (learned: 1.0)"
    assert lines["model"] == "model.safetensors"
    assert lines["learned from"] == "40 rows of excited data, in 1.23 s"
    assert lines["known before"] == "mass 0.9"
    assert lines["lost"] == "from step 3 (0.3 s) on: away"
    assert lines["at the end [m]"] == "0.5"
    assert lines["episodes before"] == "0.25, diverged"
    assert lines["stopped early"].startswith("ITERATION_LIMIT 2, TIME_LIMIT 1: ")
    assert lines["far from the data"].startswith("the plans of 7 steps: ")
    assert dict(summary(result | {"rmse": dict.fromkeys(result["rmse"])}).rows)["RMSE [m]"] == "none: it diverged"
    bare = result | {"settings": {"options": OPTIONS}, "training": None, "lost": None, "error_at_end": None}
    bare |= {"episodes": [], "suboptimal": {}, "far_from_data": 0}
    names = ["flight", "RMSE [m]", "bounds of inputs", "failed solves", "decision [ms]"]
    assert [name for name, _ in summary(bare).rows] == names


@pytest.mark.parametrize(("error", "outside"), [(0.04, 0), (0.06, 20), (-1.5, 20), (-0.5, 0)])
def test_states_are_counted_outside_the_tightest_bounds_that_all_boxes_have_now(error, outside):
    narrow = np.full((2, 6), 9.0)
    narrow[:, 0] = 0.05, 0.01  # of the first stage, and of one later on
    boxes = Box(np.full(6, -1.0), np.full(6, 1.0)), Box(np.full((2, 6), -9.0), narrow)
    found = metrics_of(error, constraints=boxes)["violations"]
    assert (found["states"]["violations"], found["states"]["steps"]) == (outside, 20)
    assert found["states"]["rate"] == outside / 20
    assert "states" not in metrics_of(error)["violations"]
