"""The quadratic programs of exported C end as those of Python do."""

import shutil

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.export.programs import CompiledPrograms

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
NONE = np.inf


@pytest.fixture(scope="module")
def compiled():
    return CompiledPrograms(2, 3)


@pytest.mark.parametrize("gap", [1e-6, 1e-8, 1e-10])
def test_a_row_without_bounds_hides_no_contradiction(compiled, gap):
    rows = [[1.0, 1.0], [1.0, 1.0], [0.0, 1.0]]
    lower = [-NONE, 1.0 + gap, -NONE]
    problem = QuadraticProgram(np.eye(2), [-10, -10], rows, lower, [1.0, NONE, NONE])
    assert DualActiveSet().solve(problem).status is Status.INFEASIBLE
    assert compiled.solve(problem).status is Status.INFEASIBLE


def test_a_zero_row_proves_infeasibility_beyond_rounding_only(compiled):
    rows = [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    for bound, status in ((-2.2e-16, Status.SOLVED), (-1e-12, Status.INFEASIBLE)):
        problem = QuadraticProgram(
            np.eye(2), [-1e-16, 0.0], rows, h_upper=[bound, 1.0, 1.0]
        )
        assert DualActiveSet().solve(problem).status is status
        assert compiled.solve(problem).status is status


def test_a_row_whose_squares_underflow_is_not_taken_as_satisfied(compiled):
    rows = [[1e-170, 2e-170], [1.0, 1.0], [0.0, 1.0]]
    for bound, satisfied in ((-1e-170, False), (1e-165, True)):
        problem = QuadraticProgram(
            np.eye(2), [1.0, -2.0], rows, h_upper=[bound, 9.0, 9.0]
        )
        assert DualActiveSet().solve(problem).status is Status.SOLVED
        assert compiled.solve(problem).status.solved is satisfied


PRICED_ROWS = [[1e7, 0.0], [0.0, 1e-6], [-1.0, -1.0]]


def test_a_row_at_a_price_contradicts_nothing(compiled, monkeypatch):
    """Two rows of sizes far apart bound x; the first may be violated for next to
    nothing."""

    def rescue(*arguments):
        raise AssertionError("solved again with doubled digits")

    monkeypatch.setattr("gpmpc.qp._dual_active_set.rescue", rescue)
    problem = QuadraticProgram(
        np.eye(2), [-10.0, -10.0], PRICED_ROWS, h_upper=[1e7, 1e-6, -3.0]
    )
    prices = np.array([1e-3, NONE, NONE])
    solution = DualActiveSet().solve(problem, prices=prices)
    prepared = DualActiveSet().prepare(problem.P, problem.G, prices)
    again = prepared.solve(problem.q, problem.lower, problem.upper)
    answer = compiled.solve(problem, prices)
    for result in (solution, again, answer):
        assert result.status is Status.SOLVED
        np.testing.assert_allclose(result.x, [2.0, 1.0], rtol=1e-9)
    hard = DualActiveSet().solve(problem)
    assert hard.status is Status.INFEASIBLE
    # Farkas' proof: the rows' sum says 0 < 0; without the priced one it says nothing
    np.testing.assert_allclose(hard.z @ problem.G, 0.0, atol=1e-12)
    assert (hard.z >= 0).all()
    assert hard.z @ problem.h_upper < 0
    assert hard.z[0] > 0
    assert compiled.solve(problem).status is Status.INFEASIBLE


def test_there_is_no_feedback_where_no_gain_can_be_told(compiled):
    """Where R + B'B, which gains are divided by, is zero or next to it."""
    n, m = compiled.rows, compiled.variables
    B = np.ones((n, m))
    gains = compiled.gains(np.eye(n), B, np.eye(m))
    expected = np.linalg.solve(np.eye(m) + B.T @ B, B.T)
    np.testing.assert_allclose(gains, expected, rtol=1e-12)
    assert (compiled.gains(np.eye(n), B, -B.T @ B) == 0.0).all()
