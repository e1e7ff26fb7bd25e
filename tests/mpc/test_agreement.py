"""Roads to one answer meet, on a few steps; ``benchmarks/agreement.py`` has the
hundreds."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.experiments.slsqp import SLSQP
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import (
    GPMPC,
    Box,
    PredictionSettings,
    Problem,
    Reference,
    Request,
    Tracking,
)
from gpmpc.mpc.baselines import StateFormMPC
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.qp import PrimalActiveSet
from tests.mpc.systems import HOVER, quadrotor_gp

H = 4


def problem(tilt):
    box = {"inputs": Box([0.0, -tilt, -tilt], [15.0, tilt, tilt])}
    return Problem(Tracking([1] * 6, [1] * 3), **box)


def questions(count, std):
    rng = np.random.default_rng(1)
    for _ in range(count):
        start = rng.uniform(-0.5, 0.5, 6)
        belief = Gaussian(torch.tensor(start), std**2 * torch.eye(6))
        yield (
            belief,
            Reference(
                start + np.linspace(0, 1, H + 1)[:, None] * rng.uniform(-0.4, 0.4, 6)
            ),
        )


@pytest.mark.parametrize(
    "propagator",
    [Linearization(), MomentMatching()],
    ids=["linearisation", "moment matching"],
)
def test_iterated_programs_reach_the_nonlinear_optimum(propagator):
    gp = quadrotor_gp()
    convex = GPMPC(
        gp,
        propagator,
        problem(0.5),
        H,
        HOVER,
        prediction=PredictionSettings(covariance="full"),
        iterations=100,
        tolerance=1e-7,
    )
    generic = SLSQP(gp, propagator, problem(0.5), H, HOVER, tolerance=1e-6)
    for belief, reference in questions(4, 0.05):
        plans = [
            controller.control(belief, reference) for controller in (convex, generic)
        ]
        assert all(plan.status.solved for plan in plans)
        request = Request.read(problem(0.5), H, HOVER, belief, reference, None)
        reached, least = (generic.evaluate(plan.inputs, request).cost for plan in plans)
        assert reached <= least * (1 + 1e-4)


def test_dual_primal_and_state_form_give_the_same_inputs():
    gp = quadrotor_gp()
    active = 0
    bounded = problem(0.02)
    ours = GPMPC(gp, Linearization(), bounded, H, HOVER)
    primal = GPMPC(gp, Linearization(), bounded, H, HOVER, solver=PrimalActiveSet())
    state_form = StateFormMPC(gp, Linearization(), bounded, H, HOVER)
    for belief, reference in questions(5, 0.0):
        plan = ours.control(belief, reference)
        active += len(plan.solution.active_set)
        for other in (primal, state_form):
            assert np.allclose(
                other.control(belief, reference).inputs, plan.inputs, atol=1e-6
            )
    assert active


def test_only_iterated_programs_keep_a_bound_after_a_large_step():
    """Thrust and tilt multiply: where both have to change at once, one linearisation at
    the last inputs is far off."""
    gp = quadrotor_gp(150)
    limit = 0.05
    sides = np.full(6, np.inf)
    sides[0] = limit
    bounded = replace(
        problem(0.5), constraints=[Box(None, sides, probability=0.99, penalty=100)]
    )
    start = np.array([0.0, 0.4, 0.0, 0.0, 0.0, -0.5])
    belief = Gaussian.certain(start)
    reference = Reference(np.stack([start, [0.2, 0.4, 0.0, 0.0, 0.3, 0.5]]))
    propagator = Linearization(process_noise=True)
    reached = []
    for iterations in (1, 30):
        mpc = GPMPC(
            gp,
            propagator,
            bounded,
            horizon=1,
            initial_input=HOVER,
            iterations=iterations,
            tolerance=1e-6,
        )
        plan = mpc.control(belief, reference)
        assert plan.status.solved
        after = propagator(gp, belief, torch.tensor(plan.input))
        reached.append(
            float(
                after.mean[0]
                + bounded.constraints[0].standard_deviations()
                * after.covariance[0, 0].sqrt()
            )
            - limit
        )
    assert abs(reached[0]) > 0.01  # [m]
    assert abs(reached[1]) < 1e-5
