"""Who waits for a compiler is told, and nobody else."""

import re
import time

import numba
import pytest

from gpmpc._compiling import report_compilation


def test_compiling_is_announced_once_with_its_time(capsys):
    """A call of what is compiled already is not announced."""

    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return 2 * inner(x)

    began = time.perf_counter()
    with report_compilation():
        assert outer(1.0) == 4
        assert outer(1) == 4
    elapsed = time.perf_counter() - began
    first, last = capsys.readouterr().out.splitlines()
    assert "compiling" in first
    reported = float(re.fullmatch(r"compiled in ([\d.]+) s", last)[1])
    assert 0 <= reported <= elapsed + 0.05
    with report_compilation():
        outer(2.0)
    assert capsys.readouterr().out == ""


def test_an_error_meanwhile_is_passed_on(capsys):
    @numba.njit
    def kernel(x):
        return x

    with pytest.raises(KeyError), report_compilation():
        raise KeyError
    kernel(1.0)
    assert capsys.readouterr().out == ""  # nobody listens any more
