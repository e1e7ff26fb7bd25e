"""The guard calls a call slower where it is, and not where times only scatter."""

import numpy as np

from benchmarks.guard import Comparison


def comparison(factor, seed=0, turns=100):
    random = np.random.default_rng(seed)
    minutes = random.uniform(1.0, 2.0, turns)  # a machine that is slow now and then
    here = factor * minutes * random.normal(1.0, 0.05, turns)
    base = minutes * random.normal(1.0, 0.05, turns)
    return Comparison(here=here, base=base)


def test_the_same_times_are_not_slower():
    assert not any(comparison(1.0, seed).slower for seed in range(200))


def test_a_tenth_more_time_is_slower():
    assert all(comparison(1.1, seed).slower for seed in range(200))


def test_the_interval_holds_the_ratio_as_often_as_it_says():
    intervals = [comparison(1.1, seed).interval for seed in range(500)]
    inside = [lower <= 1.1 <= upper for lower, upper in intervals]
    # The median of a ratio of two noisy times lies at the ratio of the medians.
    assert 0.92 < np.mean(inside) <= 1.0
