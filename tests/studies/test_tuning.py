"""A search finds what costs least, says what mattered, and proposes the same again."""

import math

import pytest

pytest.importorskip("optuna")

from gpmpc.studies.tuning import Interval, Search

SPACE = {"weight": Interval(1e-3, 1e3, logarithmic=True), "horizon": Interval(1, 30, whole=True), "kind": ["a", "b"]}


def cost(candidate):
    """Least at weight = 2; the horizon hardly matters, the kind not at all."""
    return math.log10(candidate["weight"] / 2) ** 2 + 1e-3 * candidate["horizon"] + 0.1


def searched(trials, batch=3, seed=0, of=cost):
    search = Search(SPACE, seed)
    while len(search.costs) < trials:
        search.tell([of(candidate) for candidate in search.ask(batch)])
    return search


def test_a_search_comes_near_the_least_cost_and_knows_what_mattered():
    search = searched(45)
    best = search.candidates[search.best]
    assert cost(best) < 0.15  # of 45 random candidates the best one has 0.11 to 0.2
    assert next(iter(search.importances())) == "weight"
    assert sum(search.importances().values()) == pytest.approx(1)
    document = search.document(cost({"weight": 1.0, "horizon": 10}), "gpmpc run")
    assert document.images["tuning.png"].startswith(b"\x89PNG")
    assert document.tables[0].rows[0][0] == str(search.best)
    assert len(document.data) == 45


def test_a_search_of_one_seed_proposes_the_same_and_goes_on_as_if_it_had_never_stopped():
    whole, part = searched(12), searched(6)
    assert part.candidates == whole.candidates[:6]
    assert searched(12).candidates == whole.candidates
    assert searched(12, seed=1).candidates != whole.candidates
    for candidate in whole.candidates:
        assert 1e-3 <= candidate["weight"] <= 1e3
        assert candidate["horizon"] in range(1, 31)
        assert candidate["kind"] in SPACE["kind"]


def test_flights_that_were_lost_count_as_the_worst_and_stop_nothing():
    search = searched(21, of=lambda candidate: math.inf if candidate["weight"] < 1 else cost(candidate))
    assert search.candidates[search.best]["weight"] >= 1
    document = search.document(None, "gpmpc run")
    assert "lost or failed" in " ".join(cell for row in document.tables[0].rows for cell in row) or len(
        [c for c in search.costs if math.isfinite(c)]
    ) >= len(document.tables[0].rows)
    assert document.images["tuning.png"]


@pytest.mark.parametrize(("finite", "told"), [(7, False), (8, True)])
def test_importances_are_told_from_eight_finite_costs_on(finite, told):
    search = Search(SPACE, 0)
    costs = [cost(candidate) for candidate in search.ask(10)]
    search.tell([*costs[:finite], *[math.inf] * (10 - finite)])
    assert bool(search.importances()) == told
    titles = [table.title for table in search.document(None, "gpmpc run").tables]
    assert titles == ["Best candidates", "What mattered"][: 1 + told]
