from functools import partial
from itertools import product

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.models import Affine, KnownModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.mpc.baselines import StateFormMPC
from gpmpc.propagation import Linearization, MeanEquivalence
from gpmpc.qp import CvxpySolver
from gpmpc.status import Status
from gpmpc.systems import step
from tests.mpc.small_models import COVARIANCES, FORMS
from tests.mpc.systems import HOVER, QUADROTOR, quadrotor_gp

H = 3
PENALIZED = {"velocity": "increments", "trajectory": "deviations"}
REFERENCE = Reference(np.zeros((H + 1, 6)), np.tile(HOVER, (H, 1)))


def problem(penalized="deviations", lower=-0.3, penalty=None):
    return Problem(
        Tracking(
            [10.0, 1.0] * 3,
            [0.1, 1.0, 1.0],
            terminal=[20.0, 1.0] * 3,
            penalized=penalized,
        ),
        inputs=Box([4.0, -0.4, -0.4], [10.5, 0.4, 0.4]),
        input_rates=Box([-2.0, -0.3, -0.3], [2.0, 0.3, 0.3]),
        constraints=[
            Box([-np.inf, lower] * 3, [2.0, 0.9] * 3, probability=0.75, penalty=penalty)
        ],
    )


@pytest.mark.parametrize(("form", "covariance"), list(product(FORMS, COVARIANCES)))
@pytest.mark.parametrize(
    "prices", [{}, {"lower": -0.05, "penalty": 3.0}], ids=["hard", "soft"]
)
def test_it_gives_the_inputs_of_the_condensed_program(form, covariance, prices):
    moves = MeanEquivalence() if covariance == "none" else Linearization()
    bounded = problem(PENALIZED[form], **prices)
    settings = {
        "horizon": H,
        "initial_input": HOVER,
        "prediction": PredictionSettings(form, covariance),
    }
    mpc = partial(GPMPC, quadrotor_gp(), moves, bounded, iterations=1, **settings)
    state_form = StateFormMPC(quadrotor_gp(), moves, bounded, **settings)
    controllers = [mpc(), state_form]
    if not prices:
        controllers.append(mpc(solver=CvxpySolver()))
    state = np.array([0.8, 0.2, -0.4, 0.1, 0.3, 0.0])
    last = None
    worked = 0
    for _ in range(3):
        decisions = [
            c.control(Gaussian.certain(state), REFERENCE, last) for c in controllers
        ]
        violation = decisions[0].violation
        ended = Status.SOFT_BOUND_MISSED if violation > 1e-5 else Status.SOLVED
        assert [d.status for d in decisions] == [ended] * len(decisions)
        for other in decisions[1:]:
            assert other.violation == pytest.approx(violation, abs=1e-6)
            assert other.cost == pytest.approx(decisions[0].cost, rel=1e-5)
            assert np.allclose(other.inputs, decisions[0].inputs, rtol=0, atol=1e-6)
            assert np.allclose(other.means, decisions[0].means, rtol=0, atol=1e-6)
        last = decisions[0]
        worked += int((np.abs(last.solution.z[3 * H :]) > 1e-6).sum())
        state = step(QUADROTOR, state, last.input)
    assert worked


def test_a_constraint_of_ones_own_takes_one_line():
    state_form = partial(
        StateFormMPC,
        quadrotor_gp(),
        MeanEquivalence(),
        problem(),
        horizon=H,
        initial_input=HOVER,
        prediction=PredictionSettings(covariance="none"),
    )
    belief = Gaussian.certain(np.array([0.5, 0.0, 0.5, 0.0, 0.0, 0.0]))
    free = state_form().control(belief, REFERENCE)
    bound = state_form(constraints=lambda s, u: [s[1:, 0] + s[1:, 2] >= 0.8]).control(
        belief, REFERENCE
    )
    assert (free.means[1:, 0] + free.means[1:, 2]).min() < 0.7
    assert (bound.means[1:, 0] + bound.means[1:, 2]).min() == pytest.approx(
        0.8, abs=1e-7
    )


def test_a_constraint_that_is_not_convex_is_refused():
    with pytest.raises(SettingError, match="constraints: must be convex"):
        StateFormMPC(
            quadrotor_gp(),
            MeanEquivalence(),
            problem(),
            H,
            HOVER,
            constraints=lambda s, u: [s[1:, 0] ** 2 >= 0.1],
        )


def test_what_cannot_be_solved_is_reported():
    state_form = partial(
        StateFormMPC,
        quadrotor_gp(),
        MeanEquivalence(),
        problem(),
        horizon=H,
        initial_input=HOVER,
        prediction=PredictionSettings(covariance="none"),
    )
    controller = state_form(constraints=lambda s, u: [u[0, 0] >= 100.0])
    assert (
        controller.control(Gaussian.certain(np.zeros(6)), REFERENCE).status
        is Status.INFEASIBLE
    )
    assert (
        controller.control(Gaussian.certain(np.full(6, np.nan)), REFERENCE).status
        is Status.INVALID_MEASUREMENT
    )


def test_a_bound_without_a_number_is_numerical_trouble():
    """A chance constraint whose covariance overflows is no bound of zero."""
    unstable = Affine(
        torch.diag(torch.tensor([1.0, 1e60], dtype=torch.float64)),
        torch.tensor([[1.0], [0.0]], dtype=torch.float64),
        torch.zeros(2, dtype=torch.float64),
    )
    controller = StateFormMPC(
        KnownModel(unstable, 2, 1),
        Linearization(),
        Problem(
            Tracking([1.0, 0.0], [1.0]),
            constraints=[Box(None, [np.inf, 1.0], probability=0.9)],
        ),
        horizon=6,
        initial_input=[0.0],
    )
    belief = Gaussian(torch.zeros(2).double(), torch.eye(2).double())
    decision = controller.control(belief, Reference(np.zeros((7, 2))))
    assert decision.status is Status.NUMERICAL_TROUBLE
