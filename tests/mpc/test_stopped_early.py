"""A solve that stops at a limit with a plan that keeps its bounds steers all the same,
and is the next start."""

from dataclasses import replace

import casadi
import numpy as np
import pytest
import torch

from gpmpc.experiments.slsqp import SLSQP
from gpmpc.gaussian import Gaussian
from gpmpc.models import KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    NonlinearGPMPC,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc.baselines import NMPC, StateFormMPC
from gpmpc.propagation import Linearization
from gpmpc.qp import DualActiveSet, PrimalActiveSet
from gpmpc.simulation import closed_loop
from gpmpc.status import Status
from tests.mpc.systems import HOVER, QUADROTOR, quadrotor_gp

GP = quadrotor_gp(60)
H = 12
STEPS = 20
LOWER = np.array([3.0, -0.5, -0.5])
UPPER = np.array([12.0, 0.5, 0.5])
RATE = np.array([2.0, 0.3, 0.3])
PROBLEM = Problem(
    Tracking([10.0, 1.0] * 3, [0.1] * 3),
    inputs=Box(LOWER, UPPER),
    input_rates=Box(-RATE, RATE),
)
REFERENCES = Reference(np.zeros((STEPS + H, 6)), np.tile(HOVER, (STEPS + H - 1, 1)))
START = np.array([0.9, 0.0, -0.8, 0.2, 0.7, 0.0])


def convex(problem=PROBLEM, covariance="zero_order", **settings):
    return GPMPC(
        GP,
        Linearization(),
        problem,
        H,
        HOVER,
        PredictionSettings(covariance=covariance),
        **settings,
    )


def nmpc(monkeypatch):
    build = casadi.nlpsol
    with monkeypatch.context() as patch:

        def stopped_after_11(name, plugin, program, options):
            limited = options["ipopt"] | {"max_iter": 11}
            return build(name, plugin, program, options | {"ipopt": limited})

        patch.setattr(casadi, "nlpsol", stopped_after_11)
        return NMPC(QUADROTOR, PROBLEM, H, HOVER)


STOPPED = {
    "two programs": lambda _: convex(iterations=2, tolerance=1e-12),
    "five programs": lambda _: convex(iterations=5, tolerance=1e-12),
    "two, of the whole belief": lambda _: convex(
        iterations=2, tolerance=1e-12, covariance="diagonal"
    ),
    "two, of another solver": lambda _: convex(
        iterations=2, tolerance=1e-12, solver=PrimalActiveSet()
    ),
    "a primal solver": lambda _: convex(
        iterations=1, solver=PrimalActiveSet(iteration_limit=3)
    ),
    "a state form": lambda _: StateFormMPC(
        GP, Linearization(), PROBLEM, H, HOVER, options={"max_iter": 3}
    ),
    "nonlinear": lambda _: NonlinearGPMPC(
        GP, Linearization(), PROBLEM, H, HOVER, iterations=3, tolerance=1e-9
    ),
    "slsqp": lambda _: SLSQP(
        GP, Linearization(), PROBLEM, 4, HOVER, iterations=3, tolerance=1e-9
    ),
    "nmpc": nmpc,
}


@pytest.mark.parametrize("kind", STOPPED)
def test_a_vehicle_comes_home_with_suboptimal_plans(kind, monkeypatch):
    controller = STOPPED[kind](monkeypatch)
    references = (
        REFERENCES
        if controller.horizon == H
        else Reference(REFERENCES.states[:-8], REFERENCES.inputs[:-8])
    )
    flight = closed_loop(
        QUADROTOR, controller, references, START, STEPS, on_failure="raise"
    )
    assert flight.failures == ()
    assert flight.suboptimal
    assert {flight.statuses[k] for k in flight.suboptimal} <= {
        Status.ITERATION_LIMIT,
        Status.NUMERICAL_TROUBLE,
    }
    assert np.isfinite(flight.predicted_means).all()
    assert np.abs(flight.states[-1]).max() < 0.1
    assert (flight.inputs >= LOWER).all()
    assert (flight.inputs <= UPPER).all()
    assert (
        np.abs(np.diff(np.vstack([HOVER, flight.inputs]), axis=0)) <= RATE + 1e-12
    ).all()


@pytest.mark.parametrize("limit", [2, 4, 8])
def test_the_plan_at_a_limit_is_the_best_iterate(limit):
    """Its cost falls from limit to limit, down to the optimum, by an evaluation that is
    not the iteration's own."""

    def of_the_mean(plan):
        x = torch.tensor(START)
        before = HOVER
        total = 0.0
        for u in plan:
            x = GP.predict(x, torch.tensor(u)).mean
            total += x.numpy() @ PROBLEM.cost.Q @ x.numpy() + (
                u - before
            ) @ PROBLEM.cost.R @ (u - before)
            before = u
        return float(total)

    at = Gaussian.certain(START)
    reference = Reference(REFERENCES.states[: H + 1], REFERENCES.inputs[:H])

    def cost(count):
        controller = convex(covariance="none", iterations=count, tolerance=1e-14)
        decision = controller.control(at, reference)
        assert decision.applicable
        assert np.isfinite(decision.inputs).all()
        return of_the_mean(decision.inputs), decision

    value, decision = cost(limit)
    assert decision.suboptimal
    assert decision.status is Status.ITERATION_LIMIT
    assert cost(60)[0] <= value * (1 + 1e-9)
    assert value <= cost(limit // 2)[0] * (1 + 1e-9)


def test_a_plan_that_breaks_a_hard_bound_is_not_applied():
    """There is no time to stop before the bound, so none of the programs can be
    solved."""
    limits = Box([-np.inf] * 6, [0.95, *[np.inf] * 5], probability=0.95, penalty=None)
    problem = replace(PROBLEM, constraints=[limits])
    at = Gaussian.certain(np.array([0.9, 3.0, 0.0, 0.0, 0.0, 0.0]))
    reference = Reference(REFERENCES.states[: H + 1], REFERENCES.inputs[:H])
    for controller in (convex(problem, iterations=3), convex(problem)):
        decision = controller.control(at, reference)
        assert not decision.applicable
        assert not decision.suboptimal


def test_a_solver_that_stopped_outside_of_the_bounds_has_no_plan():
    controller = convex(
        replace(PROBLEM, input_rates=Box(-RATE, 0.1 * RATE)),
        solver=DualActiveSet(iteration_limit=1),
    )
    decision = controller.control(
        Gaussian.certain(START),
        Reference(REFERENCES.states[: H + 1], REFERENCES.inputs[:H]),
    )
    assert decision.status is Status.ITERATION_LIMIT
    assert not decision.applicable


def level(penalty, slope_at_edge, **settings):
    """A decision after a jump towards where the level's root ends, which is at 1.

    The program's plan leads beyond it when it is rolled out: there the model has a mean
    and, with such a slope at the edge, no derivative.
    """

    def leak(x, u):
        above = x - 1.0
        depth = 0.5 * (above + above.abs()) if slope_at_edge else torch.relu(above)
        return 0.9 * x + u + torch.sqrt(depth)

    problem = Problem(
        Tracking([1.0], [0.001], penalized="inputs"),
        Box([-60.0], [60.0]),
        constraints=[Box([1.1], [np.inf], penalty=penalty)],
    )
    prediction = PredictionSettings(covariance="none", rolled_out=True)
    model = KnownModel(leak, 1, 1)
    controller = GPMPC(model, Linearization(), problem, 6, [0.0], prediction)
    first = controller.control(Gaussian.certain([6.0]), Reference(np.array([6.0])))
    limited = GPMPC(model, Linearization(), problem, 6, [0.0], prediction, **settings)
    return limited.control(Gaussian.certain([3.0]), Reference(np.array([1.1])), first)


def test_a_plan_stays_where_the_next_program_has_no_numbers():
    decision = level("elastic", slope_at_edge=True)
    alone = level("elastic", slope_at_edge=True, iterations=1)
    assert alone.status is Status.SOFT_BOUND_MISSED
    assert (decision.applicable, decision.status) == (True, Status.NUMERICAL_TROUBLE)
    np.testing.assert_allclose(decision.inputs, alone.inputs)


def test_a_missed_hard_bound_ends_alike_with_and_without_time():
    alone = level(None, slope_at_edge=False, iterations=1)
    late = level(None, slope_at_edge=False, budget=1e-9)
    assert alone.violation > 1e-3
    for decision in (alone, late):
        assert decision.applicable
        assert decision.status is Status.HARD_BOUND_MISSED
    np.testing.assert_allclose(late.inputs, alone.inputs)
