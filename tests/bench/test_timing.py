import time

import numpy as np
import pytest

from gpmpc.bench.machine import machine
from gpmpc.bench.timing import Times, take_turns
from gpmpc.exceptions import SettingError


def busy(seconds):
    """Works for a while, by the clock that is measured with."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_contenders_take_turns():
    order = []
    times = take_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 1e-9, least=4)
    assert order[4:] == ["a", "b"] * 4  # after two calls each that are not counted
    assert {name: len(taken.seconds) for name, taken in times.items()} == {"a": 4, "b": 4}


def test_processor_time_is_counted_and_sleep_is_not():
    times = take_turns({"busy": lambda: busy(2e-3), "idle": lambda: time.sleep(2e-3)}, 1e-9, least=5)
    assert np.all(times["busy"].seconds > 1.9e-3)
    assert times["idle"].median < 1e-3


def test_rounds_end_when_the_time_is_spent():
    times = take_turns({"busy": lambda: busy(1e-3)}, 5e-3, least=1)
    assert 4 <= len(times["busy"].seconds) <= 6


def test_a_ratio_is_the_median_of_the_ratios_of_paired_calls():
    assert Times(np.array([2.0, 30.0, 8.0])).over(Times(np.array([1.0, 10.0, 2.0]))) == 3.0


def test_a_summary_is_in_milliseconds():
    summary = Times(np.linspace(0.0, 0.1, 101)).summary()
    assert summary == pytest.approx({"median": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0, "samples": 101})


@pytest.mark.parametrize("setting", [{"seconds": 0}, {"seconds": 1, "least": 0}])
def test_no_time_and_no_rounds_are_refused(setting):
    with pytest.raises(SettingError):
        take_turns({}, **setting)


def test_a_machine_says_what_it_is_and_can_do():
    here = machine()
    assert here["dgemm_gflops"] > 0.1
    assert here["memory_gb_per_s"] > 0.1
    assert here["processor"]
    assert here["threads"] >= 1
