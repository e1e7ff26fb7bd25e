"""The check itself: it passes the honest solvers and finds out each kind of liar."""

import numpy as np
import pytest

from gpmpc.exceptions import ProblemError
from gpmpc.qp import (
    CvxpySolver,
    DualActiveSet,
    PrimalActiveSet,
    QuadraticProgram,
    make_solution,
)
from gpmpc.status import Status
from gpmpc.testing import check_qp_solver

HONEST = DualActiveSet()


@pytest.mark.parametrize(
    "solver",
    [DualActiveSet(), PrimalActiveSet(), CvxpySolver()],
    ids=lambda s: type(s).__name__,
)
def test_the_packages_own_solvers_pass(solver):
    check_qp_solver(solver)


def test_our_solvers_pass_at_a_thousandth_of_the_tolerance():
    check_qp_solver(DualActiveSet(), tolerance=1e-9)
    check_qp_solver(PrimalActiveSet(), tolerance=1e-9)


class Liar:
    """An honest solver with one flaw."""

    def __init__(self, flaw):
        self.flaw = flaw
        self.shared = np.zeros(100)
        self.shared_record = np.zeros(1000)

    def solve(self, problem, warm_start=None):
        return self.flaw(self, problem, warm_start)


def multipliers_of_the_other_sign(_, problem, warm_start):
    solution = HONEST.solve(problem, warm_start)
    return make_solution(problem, solution.status, solution.x, -solution.multipliers)


def slightly_off(_, problem, warm_start):
    solution = HONEST.solve(problem, warm_start)
    return make_solution(
        problem, solution.status, solution.x + 1e-4, solution.multipliers
    )


def everything_is_solved(_, problem, warm_start):
    solution = HONEST.solve(problem, warm_start)
    return make_solution(problem, Status.SOLVED, solution.x, solution.multipliers)


def nothing_is_feasible(_, problem, warm_start):
    solution = HONEST.solve(problem, warm_start)
    return make_solution(problem, Status.INFEASIBLE, solution.x, solution.multipliers)


def scribbles_on_the_input(_, problem, warm_start):
    problem.q[0] += 1e-12
    return HONEST.solve(problem, warm_start)


def believes_its_warm_start(_, problem, warm_start):
    if isinstance(warm_start, np.ndarray) and (warm_start > 0).all():
        return make_solution(
            problem,
            Status.SOLVED,
            np.minimum(problem.ub, 1.0),
            np.zeros(len(problem.lower)),
        )
    return HONEST.solve(problem, warm_start)


def reuses_its_memory(self, problem, warm_start):
    solution = HONEST.solve(problem, warm_start)
    x = self.shared[: len(solution.x)]
    x[:] = solution.x
    record = self.shared_record[: len(solution.record)]
    record[:] = solution.record
    return solution._replace(x=x, record=record)


@pytest.mark.parametrize(
    ("flaw", "message"),
    [
        (multipliers_of_the_other_sign, "should be"),
        (slightly_off, "x is"),
        (everything_is_solved, "expected INFEASIBLE"),
        (nothing_is_feasible, "expected SOLVED"),
        (scribbles_on_the_input, "modified q"),
        (believes_its_warm_start, "warm-started from everything at the upper bounds"),
        (reuses_its_memory, "a later solve changed"),
    ],
)
def test_each_kind_of_liar_is_found_out(flaw, message):
    with pytest.raises(AssertionError, match=message):
        check_qp_solver(Liar(flaw))


def test_a_solver_ends_with_any_status_but_the_controllers_own():
    problem = QuadraticProgram(np.eye(1), [1.0])
    for status in Status:
        if status not in {
            Status.INVALID_MEASUREMENT,
            Status.FUNCTION_NOT_FINITE,
            Status.SOFT_BOUND_MISSED,
            Status.HARD_BOUND_MISSED,
            Status.STALLED,
        }:
            assert make_solution(problem, status, [-1.0], [0.0]).status is status
            continue
        with pytest.raises(ProblemError, match="status must be one of SOLVED, "):
            make_solution(problem, status, [-1.0], [0.0])
