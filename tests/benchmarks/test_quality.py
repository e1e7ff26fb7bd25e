import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.quadrotor import HOVER, OUTER, problem
from benchmarks.quality import FAMILIES, TRUTH, Contender, Field, contenders, pareto_front, stage_cost
from gpmpc.cli.run import experiment_of
from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.mpc.gp_mpc import GPMPC
from gpmpc.mpc.problem import TrackingProblem
from gpmpc.plotting import png, quality
from gpmpc.propagation import Linearization
from gpmpc.systems import step
from gpmpc.trajectories import Elliptical, states_along

CONF = Path(__file__).resolve().parents[2] / "conf"
CHEAP = Contender("trajectory", "controller=convex controller.covariance=none", 2)

few = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12)


class Astray(Contender):
    """Hardly ever moves an input."""

    def controller(self, model):
        return GPMPC(model, Linearization(), replace(problem(), R=[1e12] * 3), self.horizon, HOVER)


def model(N=60):
    """GPs on transitions about the path that is flown; the hyperparameters are set, not trained."""
    rng = np.random.default_rng(0)
    along = states_along(Elliptical(), np.arange(float(N)))
    x, u = along + 0.3 * rng.normal(size=(N, 6)), [7.26, 0, 0] + rng.normal(size=(N, 3)) * [0.5, 0.1, 0.1]
    y = np.array([step(OUTER, a, b) for a, b in zip(x, u, strict=True)]) - x
    scales = torch.tensor([[60.0, 9.0, 60.0, 9.0, 60.0, 9.0, 9.0, 1.5, 1.5]] * 6)
    features, changes = torch.tensor(np.hstack([x, u])), torch.tensor(y)
    return GPPosterior.from_hyperparameters(
        features, changes, scales, torch.full((6,), 100.0), torch.full((6,), 1e-4), 3, "difference"
    )


@given(few)
def test_nobody_on_the_front_is_dominated_and_everybody_else_is(points):
    def dominated(i):
        at_least = [(t, c) for t, c in points if t <= points[i][0] and c <= points[i][1]]
        return any(other != points[i] for other in at_least)

    found = pareto_front([t for t, _ in points], [c for _, c in points])
    assert found == [not dominated(i) for i in range(len(points))]


@given(few, st.integers(1, 3))
def test_where_more_time_has_to_buy_something_every_member_does_and_nobody_else(points, least):
    times, costs = [t for t, _ in points], [c for _, c in points]
    found = pareto_front(times, costs, least)
    front = sorted({point for point, member in zip(points, found, strict=True) if member})
    assert all(after[1] < before[1] - least for before, after in pairwise(front))
    for (time, cost), member in zip(points, found, strict=True):
        assert member or any(t <= time and c <= cost + least for t, c in front)


def test_the_cost_is_the_sum_of_what_every_step_pays(rng):
    roots = rng.normal(size=(6, 6)), rng.normal(size=(3, 3))
    weights = TrackingProblem(*(root @ root.T + np.eye(len(root)) for root in roots), penalized="increments")
    x, r, u, before = rng.normal(size=(8, 6)), rng.normal(size=(8, 6)), rng.normal(size=(7, 3)), [1.0, -2.0, 0.5]
    paid = 0.0
    for k in range(7):
        e, v = x[k + 1] - r[k + 1], u[k] - (u[k - 1] if k else before)
        paid += e @ weights.Q @ e + v @ weights.R @ v
    assert stage_cost(weights, x, r, u, before) == pytest.approx(paid / 7, rel=1e-12)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.words)
def test_the_words_of_a_contender_compose_to_the_controller_that_it_flew(family):
    learned = model(12)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("run", overrides=[*family.words.split(), "horizon=2"])
    experiment = experiment_of(config)
    typed = experiment.controller(learned if experiment.learns else experiment.plant)
    flown = Contender(family.name, family.words, 2).controller(learned)
    assert said(typed) == said(flown)


def said(part):
    """Class and public settings of a controller and of its parts, comparable; the model apart."""
    if not type(part).__module__.startswith("gpmpc."):
        return str(part)
    public = {key: value for key, value in vars(part).items() if not key.startswith("_") and key != "model"}
    return {"class": type(part).__name__} | {key: said(value) for key, value in public.items()}


def test_every_controller_and_propagation_of_the_settings_is_among_the_contenders():
    words = " ".join(family.words for family in FAMILIES)
    for controller in (CONF / "controller").glob("*.yaml"):
        assert f"controller={controller.stem}" in words
    for propagation in (CONF / "propagation").glob("*.yaml"):
        assert f"propagation={propagation.stem}" in words


@pytest.fixture(scope="module")
def rows():
    torch.set_default_dtype(torch.float64)
    truth, astray = Contender(TRUTH.name, TRUTH.words, 2), Astray("astray", "controller=convex", 2)
    short = replace(CHEAP, horizon=1)
    field = Field([truth, CHEAP, short, astray], steps=12, seeds=2, trajectories=["elliptical"])
    records = [json.loads(json.dumps(record)) for record in field.fly({"elliptical": model()})]  # as they are kept
    assert len(records) == 8
    return field.rows(records)


def test_a_flight_gives_rows_of_finite_numbers_in_the_order_of_the_contenders(rows):
    assert [(row["what"], row["H"]) for row in rows[:3]] == [(TRUTH.words, 2), (CHEAP.words, 2), (CHEAP.words, 1)]
    for row in rows[:3]:
        assert row["lost"] is None
        assert all(np.isfinite(row[key]) and row[key] > 0 for key in ("cost", "median", "p99", "rmse elliptical"))
        assert row["median"] <= row["p99"]
        assert row["failed"] == 0


def test_nmpc_on_the_true_model_costs_one_and_is_no_member_of_the_front(rows):
    assert rows[0]["cost"] == pytest.approx(1, abs=1e-12)
    assert not rows[0]["front"]
    assert any(row["front"] for row in rows)


def test_everybody_flies_as_often(rows):
    assert [row["flights"] for row in rows[:3]] == [2, 2, 2]
    assert [row["samples"] for row in rows[:3]] == [24, 24, 24]


def test_who_cannot_fly_is_reported_as_lost(rows):
    assert rows[3]["lost"].startswith("elliptical, seed 0: ")
    assert "cost" not in rows[3]
    assert not rows[3]["front"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"steps": 0}, "steps"), ({"seeds": 0}, "seeds"), ({"trajectories": ["circle"]}, "circle")],
)
def test_a_field_that_cannot_fly_is_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        Field([CHEAP], **settings)


@pytest.mark.parametrize("horizons", [[], [0], 5, ["a"]])
def test_horizons_that_are_none_are_refused(horizons):
    with pytest.raises(SettingError, match="horizons"):
        contenders(horizons)


def test_the_figure_names_the_members_of_the_front_and_counts_the_lost(rows):
    figure = quality(rows)
    named = {text.get_text()[3:] for legend in figure.legends for text in legend.get_texts()}
    for row in rows:
        assert (f"{row['what']} horizon={row['H']}" in named) == row["front"]
    assert "lost: 1" in [text.get_text() for text in figure.axes[0].texts]
    assert png(figure, dpi=100).startswith(b"\x89PNG")
