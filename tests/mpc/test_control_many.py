"""Many questions at once get the answers that each gets alone, on any device."""

import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import backend
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, Unscented
from gpmpc.status import Status
from tests.mpc.small_models import FORMS
from tests.mpc.systems import HOVER, linear_gaussian, quadrotor_gp

H = 3
GP = quadrotor_gp(15)
REFERENCE = Reference(np.zeros((H + 1, 6)), np.tile(HOVER, (H, 1)))
MODES = [
    ("none", Linearization()),
    ("zero_order", Linearization(process_noise=True)),
    ("zero_order", MomentMatching()),
    ("diagonal", MomentMatching(diagonal=True)),
    ("full", Linearization()),
    ("full", MomentMatching()),
    ("full", Unscented()),
]


def controller(form, covariance, propagator, model=GP, feedback=True, **settings):
    box = {"inputs": Box([0, -0.4, -0.4], [15, 0.4, 0.4])}
    bounds = Box([-2] * 6, [2] * 6, probability=0.95, penalty=50.0)
    problem = Problem(Tracking([1] * 6, [0.1] * 3), constraints=[bounds], **box)
    return GPMPC(
        model,
        propagator,
        problem,
        H,
        HOVER,
        prediction=PredictionSettings(form, covariance, feedback),
        **settings,
    )


def beliefs(count, spread=0.05, seed=0):
    rng = np.random.default_rng(seed)
    roots = spread * rng.normal(size=(count, 6, 6))
    return [
        Gaussian(torch.tensor(rng.uniform(-0.5, 0.5, 6)), torch.tensor(root @ root.T))
        for root in roots
    ]


def assert_same(many, alone, tolerance=1e-9):
    for ours, theirs in zip(many, alone, strict=True):
        assert ours.status is theirs.status
        for key in ("input", "inputs", "means", "covariances"):
            assert np.allclose(
                getattr(ours, key),
                getattr(theirs, key),
                rtol=0,
                atol=tolerance,
                equal_nan=True,
            )


@pytest.mark.parametrize("choice", ["auto", "torch"])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("covariance", "propagator"),
    MODES,
    ids=lambda v: v if isinstance(v, str) else type(v).__name__,
)
def test_many_questions_get_the_answers_that_each_gets_alone(
    form, covariance, propagator, choice
):
    mpc = controller(form, covariance, propagator)
    with backend(choice):
        first = mpc.control_many(beliefs(4), [REFERENCE] * 4, [None] * 4)
        assert_same(first, [mpc.control(b, REFERENCE) for b in beliefs(4)])
        again = beliefs(4, seed=1)
        again[1] = Gaussian.certain(again[1].mean)  # measured
        again[2] = Gaussian.certain(np.full(6, np.nan))
        before = [*first[:3], None]
        second = mpc.control_many(again, [REFERENCE] * 4, before)
        assert_same(
            second,
            [mpc.control(b, REFERENCE, p) for b, p in zip(again, before, strict=True)],
        )
    assert second[2].status is Status.INVALID_MEASUREMENT
    assert all(second[t].status.solved for t in (0, 1, 3))


def test_without_feedback_and_with_another_model_too():
    open_loop = controller("trajectory", "zero_order", MomentMatching(), feedback=False)
    other = controller(
        "trajectory", "zero_order", Linearization(), linear_gaussian(6, 3)
    )
    for mpc in (open_loop, other):
        many = mpc.control_many(beliefs(3), [REFERENCE] * 3, [None] * 3)
        assert_same(many, [mpc.control(b, REFERENCE) for b in beliefs(3)])


def test_compiled_and_torch_answer_alike():
    for covariance, propagator in MODES:
        mpc = controller("trajectory", covariance, propagator)
        compiled = mpc.control_many(beliefs(3), [REFERENCE] * 3, [None] * 3)
        with backend("torch"):
            assert_same(
                mpc.control_many(beliefs(3), [REFERENCE] * 3, [None] * 3), compiled
            )


def test_one_that_cannot_be_answered_spoils_no_other():
    mpc = controller("velocity", "full", MomentMatching())
    questions = beliefs(3)
    questions[1] = Gaussian(questions[1].mean, -torch.eye(6))  # no covariance
    many = mpc.control_many(questions, [REFERENCE] * 3, [None] * 3)
    assert [d.status for d in many] == [
        Status.SOLVED,
        Status.NUMERICAL_TROUBLE,
        Status.SOLVED,
    ]
    assert_same(many, [mpc.control(b, REFERENCE) for b in questions])


def test_nobody_asks():
    assert (
        controller("trajectory", "full", MomentMatching()).control_many([], [], [])
        == []
    )


def test_each_question_may_take_its_own_number_of_programs():
    mpc = controller("trajectory", "none", Linearization(), iterations=30)
    many = mpc.control_many(beliefs(3), [REFERENCE] * 3, [None] * 3)
    assert_same(many, [mpc.control(b, REFERENCE) for b in beliefs(3)])
    assert all(decision.iterations > 1 for decision in many)


@pytest.mark.parametrize("covariance", ["none", "zero_order", "diagonal", "full"])
@pytest.mark.parametrize(
    "propagator",
    [Linearization(), MomentMatching(), MeanEquivalence(), Unscented()],
    ids=lambda p: f"{type(p).__name__}{sorted(vars(p).items())}",
)
def test_stages_stay_on_the_device_of_the_model(covariance, propagator):
    (belief,) = beliefs(1)
    mpc = controller("trajectory", covariance, propagator)
    # a tensor made without saying where lands there, and is noticed
    with torch.device("meta"), backend("torch"):
        decision = mpc.control(belief, REFERENCE)
    assert decision.status.solved
    assert np.isfinite(decision.covariances).all()
    assert np.isfinite(decision.means).all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("covariance", "propagator"),
    MODES,
    ids=lambda v: v if isinstance(v, str) else type(v).__name__,
)
def test_a_model_on_a_gpu_gives_the_same_answers(form, covariance, propagator):
    here = controller(form, covariance, propagator)
    there = controller(form, covariance, propagator, GP.to("cuda"))
    first = here.control_many(beliefs(4), [REFERENCE] * 4, [None] * 4)
    before = [None] * 4
    assert_same(there.control_many(beliefs(4), [REFERENCE] * 4, before), first)
    second = here.control_many(beliefs(4, seed=1), [REFERENCE] * 4, first)
    assert_same(there.control_many(beliefs(4, seed=1), [REFERENCE] * 4, first), second)
