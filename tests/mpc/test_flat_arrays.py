import numpy as np
import pytest
from numba import njit

from gpmpc.mpc.flat_arrays import Layout, flattened, part

SHAPES = [(3,), (2, 3, 4), (0,), (1, 0, 5), (9, 8)]


@njit
def copy_of(flat, table, number):
    return part(flat, table[number]).copy()


@pytest.mark.parametrize("number", range(len(SHAPES)))
def test_python_and_compiled_code_find_the_same_array(number, rng):
    arrays = [rng.normal(size=shape) for shape in SHAPES]
    flat, table = flattened(arrays)
    assert np.array_equal(Layout(SHAPES).parts(flat)[number], arrays[number])
    found = copy_of(flat, table, number)
    assert found.shape[1] == SHAPES[number][-1]
    assert np.array_equal(found.ravel(), arrays[number].ravel())


def test_no_two_arrays_share_a_cache_line_and_views_write_through():
    layout = Layout(SHAPES)
    flat = np.zeros(layout.size)
    for value, view in enumerate(layout.parts(flat)):
        view[:] = value + 1
    for value, view in enumerate(layout.parts(flat)):
        assert (view == value + 1).all()
    assert (layout.table[:, 0] % 8 == 0).all()
