"""The kernels are called without numba's look at the arguments.

Whatever is given, no memory is misread.
"""

import pickle

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet, QuadraticProgram
from tests.qp.problems import feasible_problem, solve_stacked, worst_residual

ODD = {
    "every other entry": lambda a: np.repeat(a, 2, axis=-1)[..., ::2],
    "backwards": lambda a: np.ascontiguousarray(a[..., ::-1])[..., ::-1],
    "by columns": np.asfortranarray,
    "a list": lambda a: a.tolist(),
    "another byte order": lambda a: a.astype(a.dtype.newbyteorder()),
    "a dtype that was pickled": lambda a: pickle.loads(pickle.dumps(a)),
    "unaligned": lambda a: np.frombuffer(
        b"x" + a.tobytes(), dtype=float, offset=1
    ).reshape(a.shape),
    "read-only": lambda a: np.frombuffer(a.tobytes()).reshape(a.shape),
    "integers": lambda a: np.rint(a).astype(np.int64),
}


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
@pytest.mark.parametrize("position", range(5))
def test_an_odd_array_is_read_as_what_it_is(odd, position, rng):
    problem = feasible_problem(rng, 6, 9)
    arrays = [problem.P, problem.q, problem.G, problem.lower, problem.upper]
    if odd is ODD["integers"]:
        arrays = [np.rint(10 * a) if np.isfinite(a).all() else a for a in arrays]
        if not np.isfinite(arrays[position]).all() or position == 0:
            pytest.skip("has no integer form")
        if position >= 3:
            arrays[3] = np.full(15, -3.0)
            arrays[4] = np.full(15, 4.0)
    odd_arrays = list(arrays)
    odd_arrays[position] = odd(arrays[position])
    expected = solve_stacked(*arrays)
    solutions = [solve_stacked(*odd_arrays), solve_stacked(*odd_arrays, expected)]
    prepared = DualActiveSet().prepare(odd_arrays[0], odd_arrays[2])
    solutions += [
        prepared.solve(odd_arrays[1], *odd_arrays[3:]),
        prepared.solve(odd_arrays[1], *odd_arrays[3:], expected),
    ]
    for solution in solutions:
        assert solution.status is expected.status
        if expected.status.solved:
            assert worst_residual(solution) < 1e-9
            np.testing.assert_allclose(
                solution.x, expected.x, atol=1e-9 * max(1.0, np.abs(expected.x).max())
            )


@pytest.mark.parametrize("odd", ["read-only", "unaligned"])
def test_odd_arrays_are_looked_at_a_second_time_too(odd, rng):
    """Where the first look does not end as solved, the checked kernel takes over."""
    P = np.eye(40)
    q = 10 * rng.normal(size=40)
    G = rng.normal(size=(20, 40))
    lower = -np.ones(60)
    cold = DualActiveSet().solve(QuadraticProgram.from_stacked(P, q, G, lower, -lower))
    odd_record = cold._replace(record=ODD[odd](cold.record))
    arrays = [ODD[odd](array) for array in (P, q, G, lower, -lower)]
    solver = DualActiveSet(time_limit=9.0)  # looks at the clock after 25 iterations
    prepared = solver.prepare(P, G)
    solver.solve(QuadraticProgram.from_stacked(P, q, G, lower, -lower))
    for solution in (
        prepared.solve(arrays[1], *arrays[3:]),
        solver.solve(QuadraticProgram.unchecked(*arrays)),
        solver.solve(QuadraticProgram.unchecked(P[:, ::-1][:, ::-1], *arrays[1:])),
    ):
        assert solution.iterations > 25
        np.testing.assert_allclose(solution.x, cold.x, atol=1e-9)
    other = QuadraticProgram.unchecked(arrays[0], -q, *arrays[2:])
    warm = solver.solve(other, odd_record)
    assert warm.iterations > 25
    np.testing.assert_allclose(warm.x, DualActiveSet().solve(other).x, atol=1e-9)


def test_an_axis_of_length_one_may_have_any_stride():
    """NumPy calls such arrays contiguous whatever their strides.

    The solve then ended in memory never written to.
    """
    wide = np.arange(1.0, 10.0).reshape(3, 3)
    rows = np.array([[1.0, 2.0]])
    one = QuadraticProgram(wide[:1, :1], [-3.0], rows.T, [-9.0, -9.0], [1.0, 1.0])
    several = QuadraticProgram(
        np.eye(2), [-3.0, 0.0], np.ones((4, 2))[::2][:1], [-9.0], [1.0]
    )
    for problem, x in ((one, [0.5]), (several, [2.0, -1.0])):
        for array in (problem.P, problem.G):
            assert array.strides == np.empty(array.shape).strides
        solution = solve_stacked(
            problem.P, problem.q, problem.G, problem.lower, problem.upper
        )
        np.testing.assert_allclose(solution.x, x)
        assert solution.iterations <= 3


@pytest.mark.parametrize("kind", [np.float32, np.int64, np.uint64, "datetime64[s]"])
def test_eight_bytes_of_another_kind_are_not_taken_for_a_float(kind, rng):
    problem = feasible_problem(rng, 3, 4)
    rest = problem.lower, problem.upper
    q = np.arange(3).astype(kind)
    expected = solve_stacked(problem.P, np.arange(3.0), problem.G, *rest)
    prepared = DualActiveSet().prepare(problem.P, problem.G)
    for solution in (
        prepared.solve(q, *rest, expected),
        solve_stacked(problem.P, q, problem.G, *rest),
    ):
        np.testing.assert_allclose(solution.x, expected.x, atol=1e-9)


def test_a_record_with_gaps_is_a_warm_start_too(rng):
    problem = feasible_problem(rng, 6, 9)
    cold = DualActiveSet().solve(problem)
    gappy = cold._replace(record=np.repeat(cold.record, 2)[::2])
    prepared = DualActiveSet().prepare(problem.P, problem.G)
    for solution in (
        DualActiveSet().solve(problem, gappy),
        prepared.solve(problem.q, problem.lower, problem.upper, gappy),
    ):
        assert solution.status.solved
        np.testing.assert_allclose(solution.x, cold.x, atol=1e-9)
