"""A time limit that is not reached changes neither iteration limit nor iterates."""

import numpy as np
import pytest

from gpmpc.qp import DualActiveSet
from gpmpc.status import Status
from tests.qp.problems import feasible_problem


@pytest.mark.parametrize("mode", ["prepared", "changing"])
@pytest.mark.parametrize("limit", [10, 40, 80])
def test_a_solve_stops_at_its_iteration_limit_with_time_left(mode, limit, rng):
    for _ in range(4):
        problem = feasible_problem(rng, 40, 80)
        solver = DualActiveSet(iteration_limit=limit, time_limit=60.0)
        if mode == "prepared":
            solution = solver.prepare(problem.P, problem.G).solve(
                problem.q, problem.lower, problem.upper
            )
        else:
            solution = solver.solve(problem)
        assert solution.status is Status.ITERATION_LIMIT
        assert (
            limit <= solution.iterations <= limit + 50
        )  # it looks at its count now and then
        residuals = solution.residuals()
        assert (
            residuals.dual < 1e-9
        )  # an iterate of a dual method is stationary, and outside its bounds
        assert residuals.primal > 1e-6
        assert solution.objective <= DualActiveSet().solve(problem).objective + 1e-9
        assert np.isfinite(solution.x).all()
