"""Quality over time: its cost, its front, and that its words choose what flies."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpmpc.exceptions import SettingError
from gpmpc.experiments.quality import (
    FAMILIES,
    TRUTH,
    Family,
    Quality,
    front_figure,
    pareto_front,
)
from gpmpc.metrics import tracking_cost
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.studies import study as studied
from gpmpc.studies.study import TrialStore, run_study
from gpmpc.trajectories import Elliptical
from tests.cli.command import in_this_process
from tests.systems.experiments import experiment

CONF = Path(__file__).resolve().parents[2] / "conf"
CHEAP = Family("trajectory", "controller=convex controller.prediction.covariance=none")

few = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12)


@given(few)
def test_nobody_on_the_front_is_dominated_and_everybody_else_is(points):
    def dominated(i):
        at_least = [
            (t, c) for t, c in points if t <= points[i][0] and c <= points[i][1]
        ]
        return any(other != points[i] for other in at_least)

    found = pareto_front([t for t, _ in points], [c for _, c in points])
    assert found == [not dominated(i) for i in range(len(points))]


@given(few, st.integers(1, 3))
def test_every_member_of_a_front_buys_something_with_its_time(points, least):
    times = [t for t, _ in points]
    costs = [c for _, c in points]
    found = pareto_front(times, costs, least)
    front = sorted(
        {point for point, member in zip(points, found, strict=True) if member}
    )
    assert all(after[1] < before[1] - least for before, after in pairwise(front))
    for (time, cost), member in zip(points, found, strict=True):
        assert member or any(t <= time and c <= cost + least for t, c in front)


def test_the_cost_is_the_sum_of_what_every_step_pays(rng):
    roots = rng.normal(size=(6, 6)), rng.normal(size=(3, 3))
    weights = Problem(Tracking(*(root @ root.T + np.eye(len(root)) for root in roots)))
    x = rng.normal(size=(8, 6))
    r = rng.normal(size=(8, 6))
    u = rng.normal(size=(7, 3))
    before = [1.0, -2.0, 0.5]
    paid = 0.0
    for k in range(7):
        e = x[k + 1] - r[k + 1]
        v = u[k] - (u[k - 1] if k else before)
        paid += e @ weights.cost.Q @ e + v @ weights.cost.R @ v
    assert tracking_cost(
        weights.cost.Q, weights.cost.R, x, r, u, before
    ) == pytest.approx(paid / 7, rel=1e-12)


def flight(family, **changes):
    words = [
        *family.words.split(),
        "model.restarts=0",
        "data.samples=60",
        f"noise.process={[0.01] * 6}",
    ]
    return replace(experiment(*words), **changes)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.words)
def test_the_words_of_a_family_are_settings_of_a_run(family):
    assert experiment(*family.words.split(), "horizon=2").loop == "plant"


def test_all_controllers_and_propagations_are_contenders():
    words = " ".join(family.words for family in FAMILIES)
    for controller in (CONF / "controller").glob("*.yaml"):
        if controller.stem != "compiled":  # it decides as the convex one does
            assert f"controller={controller.stem}" in words
    for propagation in (CONF / "propagation").glob("*.yaml"):
        assert f"propagation={propagation.stem}" in words


def astray(model, horizon):
    """Hardly ever moves an input."""
    problem = Problem(
        Tracking([1] * 6, [1e12] * 3), inputs=Box([0, -0.7, -0.7], [20, 0.7, 0.7])
    )
    return GPMPC(model, Linearization(), problem, horizon, [7.26, 0, 0])


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    torch.set_default_dtype(torch.float64)
    lost = Family("astray", "controller=convex")
    experiments = {
        TRUTH: flight(TRUTH),
        CHEAP: flight(CHEAP),
        lost: flight(lost, controller=astray),
    }
    study = Quality(
        experiments,
        {"elliptical": Elliptical()},
        None,
        horizons=[1, 2],
        steps=12,
        seeds=2,
    )
    folder = tmp_path_factory.mktemp("quality")
    trials = study.trials(folder)
    assert len({trial.fingerprint for trial in trials}) == len(trials) == 12
    with patch.object(studied, "in_processes", in_this_process):
        records = run_study(
            study.run_trial, trials, TrialStore(folder / "trials.jsonl")
        )
    # A lost flight is a result, which is kept like any other.
    assert len(TrialStore(folder / "trials.jsonl").records) == 12
    document = study.document(records)
    assert document.images["quality.png"].startswith(b"\x89PNG")
    assert "controller=convex horizon=2: elliptical, seed 0: " in document.markdown()
    return {(row["what"], row["H"]): row for row in study.rows(records)}


def test_a_flight_gives_finite_rows_in_the_order_of_the_cases(rows):
    words = (TRUTH.words, CHEAP.words, "controller=convex")
    assert sorted(rows) == sorted((what, H) for what in words for H in (1, 2))
    for key, row in rows.items():
        if key[0] != words[2]:
            assert row["lost"] is None
            assert all(
                np.isfinite(row[key]) and row[key] > 0
                for key in ("cost", "median", "p99", "rmse elliptical")
            )
            assert row["median"] <= row["p99"]
            assert (row["failed"], row["flights"], row["samples"]) == (0, 2, 24)


def test_nmpc_on_the_true_model_is_no_member_of_the_front(rows):
    assert rows[TRUTH.words, 2]["cost"] == pytest.approx(1, abs=1e-12)
    assert not rows[TRUTH.words, 2]["front"]
    assert any(row["front"] for row in rows.values())


def test_a_case_that_cannot_fly_is_reported_as_lost(rows):
    row = rows["controller=convex", 2]
    assert row["lost"].startswith("elliptical, seed 0: ")
    assert "cost" not in row
    assert not row["front"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizons": []}, "horizons: must be a list"),
        ({"horizons": [0]}, "horizons: must be a whole number"),
        ({"steps": 0}, "steps: must be a whole number"),
        ({"seeds": 0}, "seeds: must be a whole number"),
        ({"trajectories": {}}, "trajectory: choose at least one"),
        ({"experiments": {}}, "families: choose at least one"),
    ],
)
def test_a_setting_out_of_its_range_is_refused(settings, message):
    given = {
        "experiments": {TRUTH: None},
        "trajectories": {"elliptical": Elliptical()},
        "settings": None,
    }
    with pytest.raises(SettingError, match=message):
        Quality(**(given | settings))


def test_the_figure_names_the_front_and_counts_the_lost(rows):
    figure = front_figure(list(rows.values()))
    named = {
        text.get_text()[3:] for legend in figure.legends for text in legend.get_texts()
    }
    for row in rows.values():
        assert (f"{row['what']} horizon={row['H']}" in named) == row["front"]
    assert "lost: 2" in [text.get_text() for text in figure.axes[0].texts]
