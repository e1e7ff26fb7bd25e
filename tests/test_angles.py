"""Differences of states leave whole turns out, to the last digit."""

import numpy as np
import torch

from gpmpc._angles import full_turns, state_difference, wrap


def test_differences_of_states_leave_whole_turns_out():
    one = np.array([[3.1, 5.0], [-9.0, 0.0]])
    other = np.array([[-3.1, -5.0]])
    for kind in (np.array, torch.tensor):
        difference = state_difference(kind(one), kind(other), [0])
        assert np.allclose(
            difference, [[6.2 - 2 * np.pi, 10.0], [-5.9 + 2 * np.pi, 5.0]]
        )
    assert np.array_equal(state_difference(one, other, []), one - other)
    assert np.allclose(full_turns(one - other, [0]), [[2 * np.pi, 0], [-2 * np.pi, 0]])
    small = np.array([1e-17, -1e-9, 3.14, -3.14, np.pi, -np.pi])
    assert np.array_equal(wrap(small), small)
    assert np.isnan(wrap(np.array([np.nan]))).all()
