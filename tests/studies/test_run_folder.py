"""Folders of runs have names of their own, and in what two runs were asked differently is said in words."""

from itertools import combinations

import pytest

from gpmpc.studies.run_folder import difference, folder_name


def test_other_choices_have_another_folder_even_where_capitals_count_for_nothing():
    many = [
        [], ["a=1"], ["a=1", "b=2"], ["a=1,b=2"], ["a=1,b", "2"], ["a=[1,2]"], ["a=[1, 2]"], ["a=1 2"], ["a=1_2"],
        ["A=1"], ["a=1/2"], ["a=1:2"], ["x=" + 300 * "y"], ["x=" + 301 * "y"], ["a=ä"], ["a=ö"],
    ]  # fmt: skip
    names = [folder_name(choices) for choices in many]
    assert len({name.lower() for name in names}) == len(many)
    assert all(len(name) < 200 and not set(name) & set('/\\:*?"<>| ') for name in names)
    assert folder_name(["b=2", "a=1"]) == folder_name(["a=1", "b=2"]) == "a=1,b=2"
    assert folder_name([]) == "default"


@pytest.mark.parametrize(
    ("then", "now", "words"),
    [
        ({"a": {"b": 1}}, {"a": {"b": 1}}, ""),
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}, "a.c: 2 then, 3 now"),
        ({"a": {"b": 1}}, {"a": None}, "a.b: 1 then, None now"),
        ({"a": 1}, {"a": {"b": 1}}, "a: 1 then, None now, a.b: None then, 1 now"),
        ({"a": 1}, {"b": 2}, "a: 1 then, None now, b: None then, 2 now"),
        ({"a": 0, "b": 0, "c": 0}, {"a": 1, "b": 1, "c": 1}, "a: 0 then, 1 now, b: 0 then, 1 now, c: 0 then, 1 now"),
        (
            {"a": 0, "b": 0, "c": 0, "d": 0, "e": 0},
            {"a": 1, "b": 1, "c": 1, "d": 1, "e": 1},
            "a: 0 then, 1 now, b: 0 then, 1 now, c: 0 then, 1 now, and 2 more",
        ),
    ],
)
def test_the_first_three_differences_are_named(then, now, words):
    assert difference(then, now) == words


def test_settings_differ_from_none_but_themselves():
    settings = [{"a": {"b": value}} for value in (None, 0, 1, "0", [0], {"c": 0})]
    assert all(difference(one, other) for one, other in combinations(settings, 2))
    assert not any(difference(one, one) for one in settings)
