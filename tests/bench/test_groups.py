"""What was measured counts for the same measurement only, and for that one wherever it was stopped."""

import json

import pytest

from gpmpc.bench import groups
from gpmpc.bench.groups import Group, Kept, identity, incomplete

HERE = {"processor": "P", "cores": 2, "caches": {"L1": "48K"}, "threads": 1, "load": 0.5, "dgemm_gflops": 50.0}
SETTINGS = {"sizes": [6], "seconds": 0.5}


class Counting:
    """A part whose groups' results are their numbers."""

    def groups(self):
        return [Group(f"group {i}", lambda i=i: [{"number": i}]) for i in range(3)]

    def rows(self, records):
        return [row for record in records for row in record]


PLANNED = {"one": Counting(), "two": Counting()}


def kept(folder, settings=SETTINGS, machine=HERE, created="first"):
    return Kept(folder, identity(settings, machine), {"created": created})


@pytest.fixture
def half(tmp_path):
    """A folder with four of six groups, measured in two sittings."""
    for created, part, numbers in (("first", "one", range(3)), ("second", "two", range(1))):
        sitting = kept(tmp_path, created=created)
        for i in numbers:
            sitting.add((part, f"group {i}"), PLANNED[part].groups()[i].measure())
    return tmp_path


def test_what_was_kept_is_there_again(half):
    again = kept(half)
    assert (again.differs, len(again)) == ("", 4)
    assert again.counts(PLANNED) == {"one": (3, 3), "two": (1, 3)}
    assert again.rows(PLANNED) == [{"number": i} for i in (0, 1, 2, 0)]
    assert ("two", "group 0") in again
    assert ("two", "group 1") not in again
    assert again.sittings == [{"created": "first", "groups": 3}, {"created": "second", "groups": 1}]


def test_a_line_that_a_crash_cut_short_does_not_count(half):
    path = half / incomplete("bench.jsonl")
    path.write_text(path.read_text()[:-20])
    assert len(kept(half)) == 3


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"settings": SETTINGS | {"seconds": 1}}, "settings.seconds: 0.5 then, 1 now"),
        ({"machine": HERE | {"processor": "Q"}}, "machine.processor: 'P' then, 'Q' now"),
    ],
)
def test_of_other_settings_or_another_processor_nothing_counts_and_is_gone_with_the_first_result(changed, told, half):
    figure = half / incomplete("steps.png")
    figure.write_text("")
    other = kept(half, **changed)
    assert (other.differs, len(other), other.sittings) == (told, 0, [])
    assert len(kept(half)) == 4  # nothing was measured yet
    other.add(("one", "group 0"), 1)
    assert len(kept(half, **changed)) == 1
    assert kept(half).differs
    assert not figure.exists()


def test_of_another_commit_or_changed_code_nothing_counts(half, monkeypatch):
    monkeypatch.setattr(groups, "git_commit", lambda: {"commit": "abc", "dirty": False})
    assert kept(half).differs.startswith("commit: ")
    monkeypatch.undo()
    monkeypatch.setattr(groups, "_code", lambda: "changed")
    assert kept(half).differs.startswith("code: ")


def test_a_machine_that_is_busier_is_the_same_machine(half):
    assert len(kept(half, machine=HERE | {"load": 9.0, "dgemm_gflops": 30.0})) == 4


def test_a_complete_measurement_leaves_nothing_that_is_called_incomplete(half):
    (half / "bench.json").write_text(json.dumps({}))
    kept(half).forget()
    assert [path.name for path in half.iterdir()] == ["bench.json"]
