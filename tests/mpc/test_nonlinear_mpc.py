"""The nonlinear problem against finite differences, autograd, quadratic programs and
random search."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.experiments.slsqp import SLSQP
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Box, NonlinearGPMPC, Problem, Reference, Request, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Unscented,
    rollout,
)
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.status import Status
from gpmpc.systems import System
from tests.mpc.small_models import double_integrator, pendulum_posterior

PROPAGATORS = {
    "mean equivalence": MeanEquivalence(),
    "linearisation": Linearization(),
    "moment matching": MomentMatching(),
    "unscented": Unscented(),
    "monte carlo": MonteCarlo(samples=40),
}
Q = np.array([[3.0, 0.4], [0.4, 0.5]])
R = np.array([0.2])
SPREAD = torch.tensor([[0.02, 0.005], [0.005, 0.03]])
KINDS = [NonlinearGPMPC, SLSQP]


def belief(state=(0.4, -0.3), covariance=SPREAD):
    return Gaussian(torch.tensor(state), covariance)


def swing(H, amplitude=1.0):
    t = 0.2 * np.arange(H + 1)
    return Reference(
        np.stack([amplitude * np.sin(2 * t), 2 * amplitude * np.cos(2 * t)], axis=1),
        np.full((H, 1), 0.5),
    )


def request_of(problem, H, at=None, last=0.3, reference=None):
    return Request.read(
        problem, H, np.array([last]), at or belief(), reference or swing(H), None
    )


@pytest.mark.parametrize("penalized", ["inputs", "deviations", "increments"])
@pytest.mark.parametrize("name", PROPAGATORS)
def test_the_adjoint_gradient_is_that_of_torch_and_differences(name, penalized, rng):
    H = 4
    propagator = PROPAGATORS[name]
    model = pendulum_posterior()
    problem = Problem(Tracking(Q, R, terminal=2 * Q, penalized=penalized))
    baseline = SLSQP(model, propagator, problem, H, [0.0])
    inputs = rng.normal(size=(H, 1))
    reference = swing(H)
    last = np.array([0.3])
    evaluation = baseline.evaluate(inputs, request_of(problem, H))

    def by_torch(u):
        beliefs = rollout(propagator, model, belief(), u)
        error = beliefs.mean - torch.tensor(reference.states[1:])
        W = torch.tensor(np.array([Q] * (H - 1) + [2 * Q]))
        held = {"inputs": 0 * u, "deviations": torch.tensor(reference.inputs)}
        v = u - held.get(penalized, torch.cat([torch.tensor(last)[None], u[:-1]]))
        return (
            torch.einsum("ia,iab,ib->", error, W, error)
            + (W * beliefs.covariance).sum()
            + 0.2 * v.square().sum()
        )

    u = torch.tensor(inputs, requires_grad=True)
    expected = by_torch(u)
    assert evaluation.cost == pytest.approx(float(expected.detach()), rel=1e-12)
    assert np.allclose(
        evaluation.gradient,
        torch.autograd.grad(expected, u)[0].ravel(),
        rtol=1e-9,
        atol=1e-10,
    )
    direction = rng.normal(size=H)
    step = 1e-5
    ends = [
        baseline.evaluate(inputs.ravel() + s * direction, request_of(problem, H)).cost
        for s in (step, -step)
    ]
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(
        float(evaluation.gradient @ direction), rel=1e-6
    )


@pytest.mark.parametrize(
    "name", ["mean equivalence", "linearisation", "moment matching"]
)
def test_margins_of_chance_constraints_and_their_jacobian(name, rng):
    H = 4
    limits = Box([-1.0, -np.inf], [0.8, 1.5], probability=0.95, kappa=2.0, penalty=None)
    problem = Problem(Tracking(Q, R, penalized="inputs"), constraints=[limits])
    baseline = SLSQP(pendulum_posterior(), PROPAGATORS[name], problem, H, [0.0])
    request = request_of(problem, H)
    plan = rng.normal(size=H)
    shot = baseline.evaluate(plan, request)
    deviation = np.sqrt(shot.covariances[1:].diagonal(axis1=1, axis2=2))
    mu = shot.means[1:]
    expected = [
        -1 - (mu[:, 0] - 2 * deviation[:, 0]),
        mu[:, 0] + 2 * deviation[:, 0] - 0.8,
        mu[:, 1] + 2 * deviation[:, 1] - 1.5,
    ]
    assert np.allclose(shot.margins, np.transpose(expected).ravel())
    direction = rng.normal(size=H)
    step = 1e-5
    ends = [baseline.evaluate(plan + s * direction, request) for s in (step, -step)]
    assert np.allclose(
        (ends[0].margins - ends[1].margins) / (2 * step),
        shot.margin_jacobian @ direction,
        atol=1e-7,
    )


def condensed(H, problem, state, reference, last):
    """The quadratic program of the double integrator with W = 0.01 I: P, q, rows and
    bounds."""
    A = np.array([[1.0, 0.5], [0.0, 1.0]])
    B = np.array([0.125, 0.5])
    free = np.array([np.linalg.matrix_power(A, i + 1) @ state for i in range(H)])
    response = np.zeros((H, 2, H))
    S = np.zeros((2, 2))
    spread = []
    for i in range(H):
        S = A @ S @ A.T + 0.01 * np.eye(2)
        spread.append(np.sqrt(S.diagonal()))
        for j in range(i + 1):
            response[i, :, j] = np.linalg.matrix_power(A, i - j) @ B
    D = (
        np.eye(H) - np.eye(H, k=-1)
        if problem.cost.penalized == "increments"
        else np.eye(H)
    )
    offset = (
        last * np.eye(H)[0] if problem.cost.penalized == "increments" else np.zeros(H)
    )
    P = (
        2 * np.einsum("iaj,ab,ibk->jk", response, problem.cost.Q, response)
        + 2 * problem.cost.R * D.T @ D
    )
    gap = free - reference[1:]
    q = (
        2 * np.einsum("iaj,ab,ib->j", response, problem.cost.Q, gap)
        - 2 * float(problem.cost.R[0, 0]) * D.T @ offset
    )
    rates = np.eye(H) - np.eye(H, k=-1)
    start = last * np.eye(H)[0]
    kappa = problem.constraints[0].standard_deviations()
    rows = np.concatenate([rates, response[:, 1]])
    upper = np.concatenate(
        [
            problem.input_rates.upper + start,
            0.35 - kappa * np.array(spread)[:, 1] - free[:, 1],
        ]
    )
    lower = np.concatenate([problem.input_rates.lower + start, np.full(H, -np.inf)])
    box = np.full(H, problem.inputs.lower[0]), np.full(H, problem.inputs.upper[0])
    return QuadraticProgram(P, q, rows, lower, upper, *box)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("penalized", ["inputs", "increments"])
def test_on_a_linear_model_the_optimum_is_the_quadratic_programs(kind, penalized):
    H = 6
    limits = Box(
        [-np.inf, -np.inf],
        [np.inf, 0.35],
        probability=0.95,
        kappa=0.5,
        penalty=None,
    )
    bounds = {"inputs": Box([-1.0], [0.3]), "input_rates": Box([-0.25], [0.25])}
    problem = Problem(
        Tracking(Q, R, penalized=penalized), constraints=[limits], **bounds
    )
    model = double_integrator(W=(0.01 * np.eye(2)).tolist())
    state = np.array([0.2, -0.4])
    reference = np.ones((7, 2))
    best = DualActiveSet().solve(condensed(H, problem, state, reference, 0.1))
    assert (best.active_set != 0).sum() >= 3
    controller = kind(model, Linearization(), problem, H, [0.1], tolerance=1e-8)
    decision = controller.control(Gaussian.certain(state), Reference(reference))
    assert decision.status is Status.SOLVED
    assert np.allclose(decision.inputs[:, 0], best.x, atol=1e-7)
    if kind is NonlinearGPMPC:
        assert decision.iterations <= 5


class DoubleIntegrator:
    state_names = ("x", "v")
    input_names = ("a",)

    def derivative(self, x, u):
        return [x[1], u[0]]


def test_on_a_certain_model_it_is_nonlinear_mpc_of_the_plant(rng):
    H = 5
    limits = Box([-np.inf, -0.4], [np.inf, 0.4], probability=0.95, penalty=None)
    problem = Problem(Tracking(Q, R), inputs=Box(None, [0.5]), constraints=[limits])
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    state = Gaussian.certain(np.array([0.1, 0.2]))
    reference = Reference(rng.normal(size=(H + 1, 2)))
    ours = NonlinearGPMPC(
        double_integrator(), MeanEquivalence(), problem, H, [0.1]
    ).control(state, reference)
    true = NMPC(plant, problem, H, [0.1]).control(state, reference)
    assert np.allclose(ours.inputs, true.inputs, atol=1e-6)
    assert np.allclose(ours.means, true.means, atol=1e-6)


def constrained(penalty=None):
    limits = Box(
        [-np.inf, -1.2], [0.75, np.inf], probability=0.95, kappa=1.0, penalty=penalty
    )
    bounds = {"inputs": Box([-3.0], [4.0]), "input_rates": Box([-1.5], [1.5])}
    return Problem(Tracking(Q, R), constraints=[limits], **bounds)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("mean equivalence", NonlinearGPMPC),
        ("linearisation", NonlinearGPMPC),
        ("moment matching", NonlinearGPMPC),
        ("mean equivalence", SLSQP),
        ("linearisation", SLSQP),
    ],
)
def test_bounds_are_kept_and_no_feasible_perturbation_is_cheaper(name, kind, rng):
    H = 4
    problem = constrained()
    model = pendulum_posterior()
    controller = kind(model, PROPAGATORS[name], problem, H, [0.3], tolerance=1e-6)
    at = belief((0.3, 0.8), SPREAD / 20)
    decision = controller.control(at, swing(H))
    assert decision.status is Status.SOLVED
    baseline = SLSQP(model, PROPAGATORS[name], problem, H, [0.3])
    request = request_of(problem, H, at)
    optimum = baseline.evaluate(decision.inputs, request)
    assert optimum.margins.max() < 1e-6
    assert np.abs(np.diff(decision.inputs[:, 0], prepend=0.3)).max() < 1.5 + 1e-7
    assert (
        optimum.margins.max() > -1e-5
    )  # a chance constraint is active: the case is not an idle one
    assert (decision.inputs >= -3).all()
    assert (decision.inputs <= 4).all()
    tried = 0
    for scale in np.repeat([1e-3, 1e-2, 0.1], 400):
        plan = (optimum.plan + scale * rng.normal(size=H)).clip(-3, 4)
        rates = np.diff(plan, prepend=0.3)
        if np.abs(rates).max() > 1.5:
            continue
        trial = baseline.evaluate(plan, request)
        if trial.margins.max() <= 0:
            tried += 1
            assert trial.cost > optimum.cost - 1e-7
        if tried == 50:
            break
    assert tried == 50


def test_a_generic_optimizer_finds_the_same_plan():
    H = 5
    decisions = []
    for kind in KINDS:
        controller = kind(
            pendulum_posterior(), MomentMatching(), constrained(), H, [0.3]
        )
        decisions.append(controller.control(belief((0.3, 0.8), SPREAD / 20), swing(H)))
    assert [d.status for d in decisions] == [Status.SOLVED] * 2
    assert np.allclose(decisions[0].inputs, decisions[1].inputs, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_a_warm_start_takes_fewer_iterations(kind):
    H = 6
    cold = 0
    warm = 0
    controller = kind(
        pendulum_posterior(),
        Linearization(),
        Problem(Tracking(Q, R, penalized="inputs")),
        H,
        [0.0],
    )
    previous = controller.control(Gaussian.certain(np.array([0.5, -1.0])), swing(H))
    for _ in range(3):
        at = Gaussian.certain(previous.means[1])
        cold += controller.control(at, swing(H)).iterations
        previous = controller.control(at, swing(H), previous)
        warm += previous.iterations
        assert previous.status is Status.SOLVED
    assert warm < cold


@pytest.mark.parametrize("price", [20.0, 50.0])
def test_soft_bounds_give_way_and_their_price_is_at_its_minimum(price, rng):
    H = 4
    problem = constrained(price)
    gp = pendulum_posterior()
    controller = NonlinearGPMPC(gp, Linearization(), problem, H, [0.3])
    hard = SLSQP(gp, Linearization(), constrained(), H, [0.3])
    # beyond its bound already
    at = belief((0.9, 0.5), SPREAD / 20)
    reference = swing(H, 1.3)
    decision = controller.control(at, reference)
    assert decision.status is Status.SOFT_BOUND_MISSED
    assert decision.means[1, 0] > 0.75
    request = request_of(problem, H, at, reference=reference)

    def objective(plan):
        evaluation = hard.evaluate(plan, request)
        over = evaluation.margins.clip(0)
        return evaluation.cost + price * over.sum()

    best = objective(decision.inputs)
    for scale in np.repeat([1e-4, 1e-2], 40):
        plan = (decision.inputs + scale * rng.normal(size=(H, 1))).clip(-3, 4)
        if np.abs(np.diff(plan[:, 0], prepend=0.3)).max() <= 1.5:
            assert objective(plan) > best - 1e-7


def test_an_exact_penalty_keeps_what_can_be_kept():
    H = 5
    at = belief((0.3, 0.8), SPREAD / 20)
    plans = [
        NonlinearGPMPC(
            pendulum_posterior(), Linearization(), constrained(penalty), H, [0.3]
        )
        .control(at, swing(H))
        .inputs
        for penalty in (None, 1e4, "exact")
    ]
    assert all(np.allclose(plan, plans[0], atol=1e-5) for plan in plans)


@pytest.mark.parametrize("kind", KINDS)
def test_contradicting_bounds_are_infeasible(kind):
    limits = Box([-np.inf, -np.inf], [-3.0, np.inf], probability=0.95, penalty=None)
    hopeless = Problem(
        Tracking(Q, R, penalized="inputs"),
        inputs=Box([-1.0], [1.0]),
        constraints=[limits],
    )
    controller = kind(pendulum_posterior(), Linearization(), hopeless, 3, [0.0])
    assert controller.control(belief(), swing(3)).status is Status.INFEASIBLE
    apart = Problem(
        Tracking(Q, R, penalized="inputs"),
        inputs=Box([5.0], [6.0]),
        input_rates=Box([-0.1], [0.1]),
    )
    controller = kind(pendulum_posterior(), Linearization(), apart, 3, [0.0])
    assert not controller.control(belief(), swing(3)).applicable


@pytest.mark.parametrize("kind", KINDS)
def test_too_few_iterations_are_said_so(kind):
    problem = Problem(Tracking(Q, R, penalized="inputs"))
    controller = kind(
        pendulum_posterior(),
        Linearization(),
        problem,
        6,
        [0.0],
        iterations=2,
        tolerance=1e-9,
    )
    decision = controller.control(belief((2.0, -2.0)), swing(6))
    assert decision.status is Status.ITERATION_LIMIT
    assert decision.iterations == 2


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_measurement_is_answered_by_the_shifted_plan(bad):
    controller = NonlinearGPMPC(
        pendulum_posterior(),
        Linearization(),
        Problem(Tracking(Q, R, penalized="inputs")),
        3,
        [0.2],
    )
    good = controller.control(belief(), swing(3))
    decision = controller.control(
        Gaussian.certain(np.array([0.1, bad])), swing(3), good
    )
    assert decision.status is Status.INVALID_MEASUREMENT
    assert np.array_equal(decision.inputs, good.inputs[[1, 2, 2]])
    first = controller.control(Gaussian.certain(np.array([0.1, bad])), swing(3))
    assert np.array_equal(first.inputs, np.full((3, 1), 0.2))


class Broken:
    """A model that answers with NaN."""

    def __init__(self):
        self.model = double_integrator()

    def __getattr__(self, name):
        return getattr(self.model, name)

    def predict(self, state, input=None):
        at = self.model.predict(state, input)
        return Gaussian(at.mean * np.nan, at.covariance)


def test_a_model_that_breaks_down_is_numerical_trouble():
    controller = NonlinearGPMPC(
        Broken(),
        MeanEquivalence(),
        Problem(Tracking(Q, R, penalized="inputs")),
        3,
        [0.2],
    )
    decision = controller.control(belief(), swing(3))
    assert decision.status is Status.NUMERICAL_TROUBLE
    assert np.isfinite(decision.inputs).all()


def test_a_plan_stopped_at_a_limit_is_a_warm_start_no_failed_one():
    problem = Problem(Tracking(Q, R, penalized="inputs"))
    impatient = NonlinearGPMPC(
        pendulum_posterior(),
        Linearization(),
        problem,
        4,
        [0.0],
        iterations=2,
        tolerance=1e-9,
    )
    stopped = impatient.control(belief((2.0, -2.0)), swing(4))
    request = Request.read(problem, 4, np.zeros(1), belief(), swing(4), stopped)
    assert np.array_equal(request.guessed_inputs, stopped.inputs[[1, 2, 3, 3]])
    failed = replace(stopped, suboptimal=False)
    request = Request.read(problem, 4, np.zeros(1), belief(), swing(4), failed)
    assert np.array_equal(request.guessed_inputs, request.constant_guess)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_question_has_the_same_answer(kind):
    controller = kind(
        pendulum_posterior(),
        MonteCarlo(samples=20),
        Problem(Tracking(Q, R, penalized="inputs")),
        3,
        [0.0],
    )
    first, second = (controller.control(belief(), swing(3)) for _ in range(2))
    assert np.array_equal(first.inputs, second.inputs)
    assert first.iterations == second.iterations


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, "horizon: must be a whole number, 1 or more; got 0"),
        (
            {"problem": Problem(Tracking([1.0] * 3, R, penalized="inputs"))},
            "must weigh 2 states and 1 inputs; got 3 and 1",
        ),
        ({"initial_input": [0.0, 0.0]}, "initial_input: must be a list of 1 numbers"),
        ({"tolerance": 0.0}, "tolerance: must be a number above 0"),
        ({"iterations": 0}, "iterations: must be a whole number, 1 or more"),
    ],
)
def test_misuse_is_refused_at_construction(arguments, message):
    good = {
        "problem": Problem(Tracking(Q, R, penalized="inputs")),
        "horizon": 3,
        "initial_input": [0.0],
    }
    with pytest.raises(SettingError, match=message):
        NonlinearGPMPC(pendulum_posterior(), Linearization(), **(good | arguments))


def test_a_question_that_does_not_fit_is_refused():
    controller = NonlinearGPMPC(
        pendulum_posterior(),
        Linearization(),
        Problem(Tracking(Q, R, penalized="inputs")),
        3,
        [0.0],
    )
    with pytest.raises(
        ShapeError, match=r"shapes \(2,\) and \(4, 2\); got \(2,\) and \(3, 2\)"
    ):
        controller.control(belief(), swing(2))
    with pytest.raises(
        ShapeError, match=r"reference inputs must have shape \(3, 1\); got \(3, 2\)"
    ):
        controller.control(belief(), Reference(np.zeros((4, 2)), np.zeros((3, 2))))
    with pytest.raises(DataError, match="reference states must be finite; got nan"):
        controller.control(belief(), Reference(np.full((4, 2), np.nan)))
