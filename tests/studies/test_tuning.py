"""A search finds what costs least, says what mattered, and proposes the same again."""

import math

import pytest

pytest.importorskip("optuna")

from gpmpc.studies import tuning
from gpmpc.studies.tuning import Interval, Search
from tests.studies.made_up import shown_number

SPACE = {
    "weight": Interval(1e-3, 1e3, logarithmic=True),
    "horizon": Interval(1, 30, whole=True),
    "kind": ["a", "b"],
}


def cost(candidate):
    """Least at weight = 2; the horizon hardly matters, the kind not at all."""
    return math.log10(candidate["weight"] / 2) ** 2 + 1e-3 * candidate["horizon"] + 0.1


def searched(trials, batch=3, seed=0, of=cost):
    search = Search(SPACE, seed)
    while len(search.costs) < trials:
        search.tell([of(candidate) for candidate in search.ask(batch)])
    return search


def test_a_search_nears_the_least_cost_and_knows_what_mattered():
    search = searched(45)
    best = search.candidates[search.best]
    assert cost(best) < 0.15  # of 45 random candidates the best one has 0.11 to 0.2
    assert next(iter(search.importances())) == "weight"
    assert sum(search.importances().values()) == pytest.approx(1)
    document = search.document(cost({"weight": 1.0, "horizon": 10}), "gpmpc run")
    assert document.images["tuning.png"].startswith(b"\x89PNG")
    assert document.tables[0].rows[0][0] == str(search.best)
    assert len(document.data) == 45


def test_a_search_of_one_seed_repeats_and_resumes_equally():
    whole = searched(12)
    part = searched(6)
    assert part.candidates == whole.candidates[:6]
    assert searched(12).candidates == whole.candidates
    assert searched(12, seed=1).candidates != whole.candidates
    for candidate in whole.candidates:
        assert 1e-3 <= candidate["weight"] <= 1e3
        assert candidate["horizon"] in range(1, 31)
        assert candidate["kind"] in SPACE["kind"]


def test_lost_flights_count_as_the_worst_and_stop_nothing():
    search = searched(
        21,
        of=lambda candidate: math.inf if candidate["weight"] < 1 else cost(candidate),
    )
    assert search.candidates[search.best]["weight"] >= 1
    document = search.document(None, "gpmpc run")
    assert "lost or failed" in " ".join(
        cell for row in document.tables[0].rows for cell in row
    ) or len([c for c in search.costs if math.isfinite(c)]) >= len(
        document.tables[0].rows
    )
    assert document.images["tuning.png"]


@pytest.mark.parametrize(("finite", "told"), [(7, False), (8, True)])
def test_importances_are_told_from_eight_finite_costs_on(finite, told):
    search = Search(SPACE, 0)
    costs = [cost(candidate) for candidate in search.ask(10)]
    search.tell([*costs[:finite], *[math.inf] * (10 - finite)])
    assert bool(search.importances()) == told
    titles = [table.title for table in search.document(None, "gpmpc run").tables]
    assert titles == ["Best candidates", "What mattered"][: 1 + told]


@pytest.mark.parametrize(
    ("space", "costs"),
    [({"weight": Interval(0.0, 1.0)}, range(10)), (SPACE, [2.0] * 10)],
    ids=["one setting", "equal costs"],
)
def test_nothing_matters_where_there_is_nothing_to_tell_apart(space, costs):
    search = Search(space, 0)
    search.ask(10)
    search.tell([float(cost) for cost in costs])
    assert search.importances() == {}


def test_numbers_are_drawn_on_a_linear_or_logarithmic_scale():
    ranges = {
        "even": Interval(1.0, 1e4),
        "log": Interval(1.0, 1e4, logarithmic=True),
        "whole": Interval(1, 10**4, whole=True),
        "whole log": Interval(1, 10**4, logarithmic=True, whole=True),
    }
    search = Search(ranges, 0)
    for _ in range(40):
        search.ask(1)
    for name, interval in ranges.items():
        values = [candidate[name] for candidate in search.candidates]
        below = sum(value < 100 for value in values)
        assert 10 <= below <= 30 if interval.logarithmic else below < 5
        assert {type(value) for value in values} == {int if interval.whole else float}


def test_a_document_holds_the_ten_best_and_the_data_holds_all(monkeypatch):
    monkeypatch.setattr(tuning, "search_figure", lambda *arguments: arguments)
    monkeypatch.setattr(tuning, "png", lambda drawn: drawn)
    search = Search(
        {
            "w.$x": Interval(0.0, 1.0),
            "n": Interval(1, 3, whole=True),
            "kind": ["a\n", "a\n"],
        },
        0,
    )
    search.ask(5)
    search.tell([5.0, 2.0, math.inf, 2.0, 1234.5])
    assert len(search.ask(7)) == 7
    search.tell([6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0])
    assert search.best == 1
    monkeypatch.setattr(search, "importances", lambda: {"w.$x": 0.756, "n": 0.244})
    document = search.document(0.01234, "gpmpc run a=1")
    best, matter = document.tables
    assert (best.title, [*best.header]) == (
        "Best candidates",
        ["candidate", "cost", "w.$x", "n", "kind"],
    )
    shown = [(1, "2"), (3, "2"), (0, "5"), *((i, str(i + 1)) for i in range(5, 12))]
    of = search.candidates
    assert best.rows == [
        [str(i), cost, shown_number(of[i]["w.$x"]), str(of[i]["n"]), "a\\n"]
        for i, cost in shown
    ]
    assert (matter.title, matter.header) == ("What mattered", ["setting", "importance"])
    assert matter.rows == [["w.$x", "76 %"], ["n", "24 %"]]
    assert document.data.to_dict("records") == [
        {"candidate": i, "cost": search.costs[i], **of[i]} for i in range(12)
    ]
    assert (
        document.lead
        == "12 candidates; cost of the best 2, of the settings as they are 0.0123."
    )
    assert document.code == {"To fly the best one": ["gpmpc run a=1"]}
    assert document.images == {
        "tuning.png": (search.costs, {r"w.\$x": 0.756, "n": 0.244}, 0.01234)
    }
    monkeypatch.setattr(search, "importances", dict)
    search.costs[:] = [math.inf] * 12
    nothing = search.document(None, "")
    assert (
        nothing.lead
        == "12 candidates; cost of the best lost or failed, of the settings as they "
        "are —."
    )
    assert [table.title for table in nothing.tables] == ["Best candidates"]
    assert [row[:2] for row in nothing.tables[0].rows] == [
        [str(i), "lost or failed"] for i in range(10)
    ]
