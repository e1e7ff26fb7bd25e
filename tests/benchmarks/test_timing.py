"""Times are those of the calls alone, taken in turns."""

import json
import time

import numpy as np
import pytest

from benchmarks import timing
from benchmarks.timing import (
    Times,
    machine,
    markdown_table,
    time_interleaved,
    write_results,
)
from gpmpc.exceptions import SettingError


def busy(seconds):
    """Works for a while, by the clock that is measured with."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_cases_alternate():
    order = []
    times = time_interleaved(
        {"a": lambda: order.append("a"), "b": lambda: order.append("b")},
        1e-9,
        min_rounds=4,
    )
    assert order[4:] == ["a", "b"] * 4  # after two calls each that are not counted
    assert {name: len(taken.seconds) for name, taken in times.items()} == {
        "a": 4,
        "b": 4,
    }


def test_the_first_call_of_a_turn_is_told_from_the_others():
    order = []
    cases = {"a": lambda: order.append("a"), "b": lambda: order.append("b")}
    times = time_interleaved(cases, 1e-9, min_rounds=2, in_a_row=3)
    assert order[4:] == ["a", "a", "a", "b", "b", "b"] * 2
    assert len(times["a"].seconds) == 6
    first, later = Times(np.arange(6.0)).split(3)
    assert (first.seconds.tolist(), later.seconds.tolist()) == (
        [0.0, 3.0],
        [1.0, 2.0, 4.0, 5.0],
    )


def test_processor_time_is_counted_and_sleep_is_not():
    times = time_interleaved(
        {"busy": lambda: busy(2e-3), "idle": lambda: time.sleep(2e-3)},
        1e-9,
        min_rounds=5,
    )
    assert np.all(times["busy"].seconds > 1.9e-3)
    assert times["idle"].median < 1e-3


def test_rounds_end_when_the_time_is_spent():
    times = time_interleaved({"busy": lambda: busy(1e-3)}, 5e-3, min_rounds=1)
    assert 4 <= len(times["busy"].seconds) <= 6


def test_a_ratio_is_the_median_of_the_ratios_of_paired_calls():
    assert (
        Times(np.array([2.0, 30.0, 8.0])).over(Times(np.array([1.0, 10.0, 2.0]))) == 3.0
    )


def test_a_summary_is_in_milliseconds():
    assert Times(np.linspace(0.0, 0.1, 101)).summary() == pytest.approx(
        {"median": 50.0, "p99": 99.0, "samples": 101}
    )


@pytest.mark.parametrize("setting", [{"seconds": 0}, {"seconds": 1, "min_rounds": 0}])
def test_no_time_and_no_rounds_are_refused(setting):
    with pytest.raises(SettingError):
        time_interleaved({}, **setting)


def test_results_are_written_with_their_origin_and_as_a_table(tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "RESULTS", tmp_path / "new")
    rows = [{"what": "a", "median": 1.23456}, {"what": "bc", "median": 789.0}]
    found = json.loads(write_results("x", rows, machine=machine()).read_text())
    assert found["results"] == rows
    assert found["meta"]["threads"] == 1
    assert found["meta"]["machine"]["dgemm_gflops"] > 0.1
    assert markdown_table(
        ["", "ms"], [list(row.values()) for row in rows]
    ).splitlines() == [
        "|    |   ms |",
        "| -- | ---: |",
        "| a  | 1.23 |",
        "| bc |  789 |",
    ]
