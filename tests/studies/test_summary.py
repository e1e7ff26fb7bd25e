"""What a run says at its end are the numbers of its metrics."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gpmpc.exceptions import Diverged
from gpmpc.mpc import Box, FlightJudgement, Halfspaces, Inequality, Judgement, Timing
from gpmpc.simulation import Rollout
from gpmpc.status import Status
from gpmpc.studies.flight import Experiment, Flown, metrics, summary
from tests.studies.made_up import PLANT, metrics_of, on_terminal, record_of

OPTIONS = {
    "trajectory": "lorenz",
    "system": "translational",
    "data": "excited",
    "controller": "convex",
}


def said(result, **options):
    about = record_of({"seed": 0, "options": OPTIONS | options})
    text = on_terminal(summary(about | result), width=200)
    lines = [line.strip() for line in text.splitlines()]
    return {
        line.split("  ")[0]: line.partition("  ")[2].strip()
        for line in lines
        if "  " in line
    }


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
    assert lines["decision [ms]"].startswith(
        "median 3.1  (model 1, build 0.1, solve 2), 99 % below 3.1"
    )
    assert (
        said(result, trajectory="goal", system="pendulum")["flight"]
        == "20 steps of pendulum with convex"
    )


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
    assert (
        dict(summary(result | {"rmse": dict.fromkeys(result["rmse"])}).rows)["RMSE [m]"]
        == "none: it diverged"
    )
    bare = result | {
        "settings": {"options": OPTIONS},
        "training": None,
        "lost": None,
        "error_at_end": None,
    }
    bare |= {"episodes": [], "suboptimal": {}, "far_from_data": 0}
    names = ["flight", "RMSE [m]", "bounds of inputs", "failed solves", "decision [ms]"]
    unjudged = {key: bare[key] for key in bare if key != "judgement"}
    assert [name for name, _ in summary(unjudged).rows] == names


def test_one_plan_far_from_the_data_is_one():
    result = metrics_of(0.125) | {"far_from_data": 1}
    lines = dict(summary(result | {"settings": {"options": OPTIONS}}).rows)
    assert lines["far from the data"].startswith("the plan of 1 step: there")


@pytest.mark.parametrize(
    ("judgement", "line"),
    [
        (FlightJudgement(), "healthy"),
        (
            FlightJudgement(suspicious=3),
            "healthy at the end; 3 steps were suspicious",
        ),
        (
            FlightJudgement(suspicious=1),
            "healthy at the end; 1 step was suspicious",
        ),
        (
            FlightJudgement("suspicious", "why", 5, 15),
            "suspicious from step 5 on: why",
        ),
        (FlightJudgement("lost", "away", 5, 2, 13), None),  # which is said above
    ],
)
def test_how_a_flight_was_judged_is_said_in_a_line(judgement, line):
    lost = {"step": 5, "time": 1.0, "reason": "away"} if line is None else None
    result = metrics_of(0.125) | {"judgement": judgement._asdict(), "lost": lost}
    lines = dict(summary(result | {"settings": {"options": OPTIONS}}).rows)
    assert lines.get("judgement") == line


@pytest.mark.parametrize(
    ("error", "outside"), [(0.04, 0), (0.06, 20), (-1.5, 20), (-0.5, 0)]
)
def test_states_are_counted_outside_the_tightest_current_boxes(error, outside):
    narrow = np.full((2, 6), 9.0)
    narrow[:, 0] = 0.05, 0.01  # of the first stage, and of one later on
    boxes = Box(np.full(6, -1.0), np.full(6, 1.0)), Box(np.full((2, 6), -9.0), narrow)
    result = metrics_of(error, constraints=boxes)
    violations = result["violations"]
    beyond = max(error - 0.05, -1.0 - error)
    label = "x [m]" if beyond > 0 else None
    assert violations["states"]["worst_by_entry"] == (
        {label: pytest.approx(beyond)} if label else {}
    )
    by_how_much = f", by up to {beyond:.3g} in {label}" if label else " %)"
    assert said(result)["bounds of states"].endswith(by_how_much)
    assert (violations["states"]["violations"], violations["states"]["steps"]) == (
        outside,
        20,
    )
    assert violations["states"]["rate"] == outside / 20
    assert "states" not in metrics_of(error)["violations"]


@pytest.mark.parametrize(("error", "outside"), [(0.3, 0), (0.6, 20)])
def test_every_constraint_says_how_often_states_violated_it(error, outside):
    below = Halfspaces([[1.0, 0, 0, 0, 0, 0], [-1.0, 0, 0, 0, 0, 0]], [0.5, 9.0])
    near = Inequality(lambda x: x[:, 0].abs() - 0.25)
    later = Box(np.full(6, 1.0), np.full(6, 2.0), stages=[2])  # asks no first state
    result = metrics_of(error, constraints=[below, near, later, below])
    violations = result["violations"]
    assert list(violations) == [
        "inputs",
        "half-spaces 1",
        "half-spaces 2",
        "inequality",
    ]
    assert violations["half-spaces 1"] == violations["half-spaces 2"]
    assert violations["half-spaces 1"]["violations"] == outside
    assert violations["half-spaces 1"]["worst"] == pytest.approx(max(0.0, error - 0.5))
    assert violations["inequality"]["rate"] == 1.0
    assert violations["inequality"]["worst"] == pytest.approx(error - 0.25)
    lines = said(result)
    assert lines["inequality"].startswith("20 of 20 steps outside (95 %: ")
    assert lines["inequality"].endswith(f"by up to {error - 0.25:.3g}")


def test_a_constraint_of_nan_counts_as_violated():
    states = np.zeros((5, 6))
    states[:, 0] = 1.0, 4.0, -1.0, 9.0, -4.0  # the first is no result
    root = Inequality(lambda x: x[:, 0].sqrt() - 2.5)
    errors = (states - rollout_of(np.zeros((5, 3))).references)[:, ::2]
    rate = measured(rollout_of(errors), constraints=[root])["violations"]["inequality"]
    assert (rate["violations"], rate["steps"]) == (3, 4)
    assert rate["worst"] == pytest.approx(0.5)


def rollout_of(errors, **changes):
    """A flight of ``PLANT`` so far from its reference in x, y, z [m], a row a state."""
    errors = np.array(errors, dtype=float)
    n = 6
    steps = len(errors) - 1
    references = np.zeros((len(errors), n))
    references[:, 0] = 0.5 * np.arange(len(errors))
    states = references.copy()
    states[:, ::2] += errors
    timings = tuple(Timing(0.001 * (k + 1), 0.01, 0.1) for k in range(steps))
    nothing = np.full((steps, n, n), np.nan)
    return Rollout(
        **{
            "states": states,
            "covariances": np.zeros((steps + 1, n, n)),
            "measured": states[:-1],
            "inputs": np.linspace([1, 2, 3], [10, 11, 12], steps),
            "references": references,
            "predicted_means": nothing[..., 0],
            "predicted_covariances": nothing,
            "statuses": (Status.SOLVED,) * steps,
            "iterations": np.ones(steps, int),
            "timings": timings,
            "time_step": 0.2,
        }
        | changes
    )


def measured(
    rollout, training=None, diverged=None, before=(), system=PLANT, constraints=()
):
    problem = SimpleNamespace(
        inputs=Box(np.zeros(3), np.full(3, 10.0)), constraints=constraints
    )
    controller = SimpleNamespace(problem=problem, horizon=2)
    experiment = Experiment(
        None, None, system, None, lambda plant: None, steps=len(rollout.inputs)
    )
    flown = Flown(
        rollout,
        controller,
        training,
        diverged,
        tuple(Flown(each, controller, None) for each in before),
    )
    return metrics(experiment, flown)


def test_the_metrics_of_a_flight_are_written_out_in_full():
    statuses = (
        Status.SOLVED,
        Status.INFEASIBLE,
        Status.ITERATION_LIMIT,
        Status.INFEASIBLE,
    )
    odd = Judgement("suspicious", "odd")
    solves = {
        "statuses": statuses,
        "suboptimal": (2,),
        "far_from_data": (0, 3),
        "judgements": (odd, Judgement(), odd, odd),
        "iterations": np.array([1, 2, 3, 10]),
    }
    training = SimpleNamespace(
        posterior=range(7), evaluations=5, objective=np.array([1.5, 2.5]), seconds=0.25
    )
    errors = [[9, 9, 9], [3, 0, 0], [0, 0, 4], [0, 0, 0], [0, 6, 0]]
    episodes = (
        rollout_of([[0, 0, 0], [0, 3, 0], [4, 0, 0]]),
        rollout_of([[0, 0, 0], [np.inf, 0, 0]]),
    )
    result = measured(rollout_of(errors, **solves), training, before=episodes)
    quantiles = {
        name: result["times"].pop(name) for name in ("model", "build", "solve", "total")
    }
    violations = result.pop("violations")
    assert result == {
        "steps": 4,
        "unit": "m",
        "rmse": pytest.approx({"x": 1.5, "y": 3.0, "z": 2.0, "total": np.sqrt(61 / 4)}),
        "error_at_end": pytest.approx(6.0),
        "further_units": {},
        "judgement": {
            "level": "suspicious",
            "reason": "odd",
            "step": 2,
            "suspicious": 3,
            "lost": 0,
        },
        "lost": None,
        "outlook": {
            "spectral_radius": None,
            "shortest_horizon": None,
            "warnings": [],
        },
        "failures": {"INFEASIBLE": 2},
        "far_from_data": 2,
        "suboptimal": {"ITERATION_LIMIT": 1},
        "iterations": {"mean": 4.0, "largest": 10},
        "training": {"size": 7, "evaluations": 5, "objective": [1.5, 2.5]},
        "episodes": [pytest.approx(np.sqrt(12.5)), None],
        "times": {"training": 0.25},
    }
    assert quantiles["model"] == pytest.approx(
        {"median": 0.0025, "p95": 0.00385, "p99": 0.00397, "largest": 0.004}
    )
    assert {quantiles["build"]["median"], quantiles["solve"]["median"]} == {0.01, 0.1}
    assert quantiles["total"]["largest"] == pytest.approx(0.114)
    rate = violations["inputs"]
    assert (rate["violations"], rate["steps"], rate["rate"], rate["worst"]) == (
        1,
        4,
        0.25,
        2.0,
    )
    assert measured(rollout_of(errors))["training"] is None
    assert measured(rollout_of(errors))["times"]["training"] is None


def test_commands_and_decisions_are_measured_without_noise():
    """An actuator's noise breaks no bound; who was not asked took no time."""
    timings = (Timing(), Timing(), Timing(1e-3, 1e-3, 2e-3))
    rollout = rollout_of(
        np.zeros((4, 3)), timings=timings, commands=np.full((3, 3), 10.0)
    )
    result = measured(replace(rollout, inputs=np.full((3, 3), 10.1)))
    assert result["violations"]["inputs"]["violations"] == 0
    assert result["times"]["total"]["median"] == timings[-1].total


def test_a_loss_is_dated_by_its_first_step_beyond_the_limit():
    errors = [[0, 0, 0], [0, 0, 9], [0, 0, 12], [0, 40, 0]]
    far = "12 m from its reference, more than 10 m"
    assert measured(rollout_of(errors))["lost"] == {
        "step": 2,
        "time": 0.4,
        "reason": far,
    }
    assert measured(rollout_of(errors[:2]))["lost"] is None
    over = Diverged(7, "the plant's\n state is lost")
    both = {
        "step": 2,
        "time": 0.4,
        "reason": f"{far}; step 7: the plant's state is lost",
    }
    assert measured(rollout_of(errors), diverged=over)["lost"] == both
    alone = measured(rollout_of(errors[:2]), diverged=over)
    assert alone["lost"] == {
        "step": 7,
        "time": 1.4,
        "reason": "step 7: the plant's state is lost",
    }
    assert (alone["rmse"], alone["error_at_end"]) == (
        dict.fromkeys(["x", "y", "z", "total"]),
        None,
    )


def test_a_flight_is_lost_by_its_judge_or_by_divergence():
    gone = Judgement("lost", "ever faster away")
    near = [[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 2, 0]]
    result = measured(rollout_of(near, judgements=(Judgement(), gone, gone)))
    assert result["lost"] == {"step": 1, "time": 0.2, "reason": "ever faster away"}
    both = measured(
        rollout_of([*near, [0, 40, 0]], judgements=(Judgement(), gone, gone, gone))
    )
    assert both["lost"]["step"] == 1
    assert both["lost"]["reason"].startswith("ever faster away; 40 m from")
    diverged = measured(rollout_of(near), diverged=Diverged(3, "not finite any more"))
    assert diverged["judgement"]["level"] == "lost"
    assert diverged["judgement"]["step"] == 3


def test_tracked_states_of_several_units_are_told_unit_by_unit():
    system = replace(
        PLANT, tracked=("x", "z", "vx"), lost={"m": 10.0, "m/s": 0.5}, rates={"vx": "x"}
    )
    rollout = rollout_of(np.tile([3.0, 0.0, 4.0], (4, 1)))
    rollout.states[:, 1] += [0.0, 0.1, 0.1, 0.7]
    result = measured(rollout, system=system)
    assert result["unit"] == "m"
    assert result["rmse"]["total"] == pytest.approx(5.0)
    further = result["further_units"]["m/s"]
    assert further["states"] == ["vx"]
    assert further["rmse"] == pytest.approx(np.sqrt((0.01 + 0.01 + 0.49) / 3))
    assert further["error_at_end"] == pytest.approx(0.7)
    assert result["lost"]["step"] == 3
    assert "0.7 m/s from its reference, more than 0.5 m/s" in result["lost"]["reason"]
