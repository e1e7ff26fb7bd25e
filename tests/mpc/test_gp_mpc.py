from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import backend
from gpmpc.mpc import (
    GPMPC,
    Box,
    PredictionSettings,
    Problem,
    Reference,
    Timing,
    Tracking,
    _control_step,
    gp_mpc,
)
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, rollout
from gpmpc.qp import CvxpySolver, DualActiveSet
from gpmpc.status import Status
from gpmpc.systems import step
from tests.mpc.small_models import COVARIANCES, FORMS
from tests.mpc.systems import (
    HOVER,
    QUADROTOR,
    LinearPlant,
    linear_gaussian,
    quadrotor_gp,
)

PAIRS = list(product(FORMS, COVARIANCES))
gp = lru_cache(quadrotor_gp)


def propagator(covariance):
    return MeanEquivalence() if covariance == "none" else Linearization()


def quadrotor_problem(**changes):
    settings = {
        "Q": [10.0, 1.0] * 3,
        "R": [0.1, 1.0, 1.0],
        "inputs": Box([4.0, -0.4, -0.4], [10.5, 0.4, 0.4]),
        "input_rates": Box([-2.0, -0.3, -0.3], [2.0, 0.3, 0.3]),
    }
    settings |= changes
    return Problem(
        Tracking(settings.pop("Q"), settings.pop("R"), penalized="deviations"),
        **settings,
    )


def at_origin(horizon):
    return Reference(np.zeros((horizon + 1, 6)), np.tile(HOVER, (horizon, 1)))


def fly(controller, start, reference, steps):
    """States, inputs and decisions of a closed loop on the true quadrotor."""
    states = [np.asarray(start, dtype=float)]
    decisions = []
    last = None
    for _ in range(steps):
        last = controller.control(Gaussian.certain(states[-1]), reference, last)
        assert last.status is Status.SOLVED
        decisions.append(last)
        states.append(step(QUADROTOR, states[-1], last.input))
    return np.array(states), np.array([d.input for d in decisions]), decisions


# On a linear model every form is the same problem.


@pytest.mark.parametrize("penalized", ["inputs", "deviations", "increments"])
def test_on_a_linear_model_all_forms_are_the_nonlinear_benchmark(penalized, rng):
    model = linear_gaussian(3, 2)
    H = 6
    bounds = Box(
        [-0.6, -np.inf, -0.6],
        [np.inf, 0.5, np.inf],
        probability=0.95,
        kappa=0.0,
        penalty=None,
    )
    cost = Tracking(
        [2.0, 1.0, 0.5], [0.3, 0.2], terminal=[5.0, 5.0, 1.0], penalized=penalized
    )
    box = Box([-0.7, -0.5], [0.7, 0.4])
    rates = Box([-0.5] * 2, [0.5] * 2)
    problem = Problem(cost, box, rates, [bounds])
    controllers = [
        GPMPC(
            model,
            propagator(c),
            problem,
            H,
            [0.0, 0.0],
            prediction=PredictionSettings(form=f, covariance=c),
        )
        for f, c in PAIRS
        if f != "velocity" or c != "full"
    ]
    benchmark = NMPC(LinearPlant(model), problem, H, [0.0, 0.0])
    state = np.array([0.4, -0.3, 0.2])
    last = None
    worked = 0
    for _ in range(5):
        reference = Reference(
            0.5 * rng.normal(size=(H + 1, 3)), 0.3 * rng.normal(size=(H, 2))
        )
        best = benchmark.control(Gaussian.certain(state), reference, last)
        assert best.status is Status.SOLVED
        for controller in controllers:
            decision = controller.control(Gaussian.certain(state), reference, last)
            assert decision.status is Status.SOLVED
            assert np.allclose(decision.inputs, best.inputs, atol=2e-7)
            assert np.allclose(decision.means, best.means, atol=1e-6)
            worked += int((decision.solution.multipliers != 0).sum())
        last = decision
        state = np.array(LinearPlant(model).successor(state, decision.input))
    assert worked > 100


def test_it_is_exact_least_squares_with_exact_covariances(rng):
    model = linear_gaussian(2, 1)
    H = 5
    problem = Problem(Tracking([3.0, 0.5], [0.2], penalized="inputs"))
    state = rng.normal(size=2)
    reference = Reference(rng.normal(size=(H + 1, 2)))
    A, B, c, V = (part.numpy() for part in (model.A, model.B, model.c, model.V))
    free = []
    gamma = np.zeros((H, 2, H))
    x = state
    for i in range(H):
        x = A @ x + c
        free.append(x)
        for j in range(i + 1):
            gamma[i, :, j] = np.linalg.matrix_power(A, i - j) @ B[:, 0]
    rows = (np.sqrt([3.0, 0.5])[None, :, None] * gamma).reshape(-1, H)
    right = (np.sqrt([3.0, 0.5]) * (reference.states[1:] - np.array(free))).ravel()
    best = np.linalg.lstsq(
        np.vstack([rows, np.sqrt(0.2) * np.eye(H)]),
        np.append(right, np.zeros(H)),
        rcond=None,
    )[0]
    S = np.zeros((2, 2))
    for _ in range(H):
        S = A @ S @ A.T + V
    for covariance in ("full", "zero_order"):
        controller = GPMPC(
            model,
            Linearization(),
            problem,
            H,
            [0.0],
            prediction=PredictionSettings(covariance=covariance, feedback=False),
        )
        decision = controller.control(Gaussian.certain(state), reference)
        assert np.allclose(decision.inputs[:, 0], best, atol=1e-9)
        assert np.allclose(decision.covariances[-1], S, atol=1e-12)
        assert decision.inputs.shape == (H, 1)
        assert np.array_equal(decision.input, decision.inputs[0])
        assert decision.problem.P.shape == (H, H)
        assert decision.timing.total > 0


# On a GP.


@pytest.mark.parametrize(("form", "covariance"), PAIRS)
def test_bounds_and_rates_are_kept_for_thirty_steps(form, covariance):
    problem = quadrotor_problem(input_rates=Box([-2, -0.1, -0.1], [2, 0.1, 0.1]))
    H = 4
    moves = propagator(covariance)
    if covariance in ("full", "diagonal") and form == "trajectory":
        moves = MeanEquivalence()  # half the time; the bounds do not care
    controller = GPMPC(
        gp(),
        moves,
        problem,
        H,
        HOVER,
        prediction=PredictionSettings(form=form, covariance=covariance),
    )
    steps = 30
    states, inputs, decisions = fly(
        controller, [0.8, 0.0, -0.6, 0.0, 0.5, 0.0], at_origin(H), steps
    )
    rates = np.diff(inputs, axis=0, prepend=HOVER[None])
    plans = np.concatenate([d.inputs for d in decisions])
    assert (plans >= problem.inputs.lower - 1e-8).all()
    assert (plans <= problem.inputs.upper + 1e-8).all()
    assert (rates >= problem.input_rates.lower - 1e-8).all()
    assert (rates <= problem.input_rates.upper + 1e-8).all()
    assert np.abs(rates[:, 1:]).max() > 0.1 - 1e-6  # they were needed
    assert np.abs(states[-5:, ::2]).max() < 0.1
    assert decisions[-1].means.shape == (H + 1, 6)
    assert decisions[-1].covariances.shape == (H + 1, 6, 6)
    assert np.linalg.eigvalsh(decisions[-1].covariances).min() > -1e-12


def expected_cost(problem, model, moves, state, inputs, reference, covariance):
    """The nonlinear problem's cost, chance margins (H, n) and inputs (H, m) with their
    graph."""
    u = torch.tensor(inputs, requires_grad=True)
    belief = Gaussian.certain(torch.tensor(state))
    Q = torch.tensor(problem.cost.Q)
    means = []
    variances = []
    cost = 0.0
    for k, control in enumerate(u):
        if covariance == "diagonal":
            belief = Gaussian(belief.mean, torch.diag_embed(belief.variance))
        belief = rollout(moves, model, belief, control[None])
        belief = Gaussian(belief.mean[0], belief.covariance[0])
        error = belief.mean - torch.tensor(reference.states[k + 1])
        cost = (
            cost
            + error @ Q @ error
            + (Q * belief.covariance).sum() * (covariance in ("full", "diagonal"))
        )
        change = control - torch.tensor(reference.inputs[k])
        cost = cost + change @ torch.tensor(problem.cost.R) @ change
        means.append(belief.mean)
        variances.append(belief.variance)
    return cost, torch.stack(means), torch.stack(variances), u


@pytest.mark.parametrize(
    ("covariance", "moves"),
    [
        ("full", Linearization()),
        ("diagonal", Linearization()),
        ("diagonal", MomentMatching(diagonal=True)),
        ("none", MeanEquivalence()),
    ],
    ids=["full", "diagonal", "moment matching", "none"],
)
def test_iterations_end_in_a_kkt_point_of_the_nonlinear_problem(covariance, moves):
    H = 3
    limits = Box([-np.inf, -0.35] * 3, [np.inf, 0.9] * 3, probability=0.9, penalty=None)
    problem = quadrotor_problem(constraints=[limits])
    reference = at_origin(H)
    state = np.array([0.8, -0.1, -0.4, 0.1, 0.3, 0.0])
    model = gp(20 if isinstance(moves, MomentMatching) else 60)

    settings = {"iterations": 40, "tolerance": 1e-8}
    controller = GPMPC(
        model,
        moves,
        problem,
        H,
        HOVER,
        prediction=PredictionSettings(form="trajectory", covariance=covariance),
        **settings,
    )
    kappa = 0.0 if covariance == "none" else limits.standard_deviations()

    def exact(inputs):
        cost, means, variances, u = expected_cost(
            problem, model, moves, state, inputs, reference, covariance
        )
        sd = variances.sqrt() if kappa else torch.zeros_like(means)
        rows = torch.cat(
            [(means + kappa * sd)[:, 1::2], (means - kappa * sd)[:, 1::2]], dim=1
        )  # the order of G
        outside = (rows[:, :3] - 0.9).clamp_min(0).sum() + (
            -0.35 - rows[:, 3:]
        ).clamp_min(0).sum()
        return cost, rows, outside, u, means

    decision = controller.control(Gaussian.certain(state), reference)
    assert decision.status is Status.SOLVED
    assert 2 < decision.iterations < 25
    cost, rows, outside, u, means = exact(decision.inputs)
    assert outside < 1e-6
    assert np.allclose(decision.means[1:], means.detach(), atol=1e-7)
    solution = decision.solution
    m = 3
    z_rates = solution.z[: H * m]
    z_states = solution.z[H * m :]
    assert np.abs(z_states).max() > 1e-3  # a chance constraint works
    total = cost + (rows.flatten() * torch.tensor(z_states)).sum()
    gradient = torch.autograd.grad(total, u)[0].numpy().ravel()
    D = np.eye(H * m) - np.eye(H * m, k=-m)
    residual = gradient + solution.z_box + D.T @ z_rates
    assert np.abs(residual).max() < 1e-5 * max(1.0, np.abs(gradient).max())


def test_zero_order_ends_where_its_own_tightening_holds():
    H = 4
    limits = Box([-np.inf, -0.5] * 3, [np.inf, 0.9] * 3, probability=0.9, penalty=None)
    problem = quadrotor_problem(constraints=[limits])
    state = np.array([0.8, -0.1, -0.4, 0.1, 0.3, 0.0])
    controller = GPMPC(
        gp(), Linearization(), problem, H, HOVER, iterations=30, tolerance=1e-7
    )
    decision = controller.control(Gaussian.certain(state), at_origin(H))
    assert decision.status is Status.SOLVED
    sd = np.sqrt(np.diagonal(decision.covariances[1:], axis1=1, axis2=2))
    margin = decision.means[1:, 1::2] - limits.standard_deviations() * sd[:, 1::2] + 0.5
    assert margin.min() == pytest.approx(0.0, abs=1e-6)


def test_too_few_iterations_say_so():
    controller = GPMPC(
        gp(),
        MeanEquivalence(),
        quadrotor_problem(),
        4,
        HOVER,
        prediction=PredictionSettings(form="trajectory", covariance="none"),
        iterations=2,
    )
    decision = controller.control(
        Gaussian.certain(np.array([0.8, 0, 0.8, 0, 0.8, 0])), at_origin(4)
    )
    assert decision.status is Status.ITERATION_LIMIT
    assert decision.iterations == 2


@pytest.mark.parametrize(
    ("form", "covariance"), [pair for pair in PAIRS if pair[1] != "none"]
)
def test_a_higher_confidence_keeps_further_from_the_bound(form, covariance):
    H = 3
    state = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    reference = Reference(
        np.tile([1.0, 1.0, 0, 0, 0, 0], (H + 1, 1)), np.tile(HOVER, (H, 1))
    )
    highest = []
    last = None
    for confidence in (0.6, 0.9, 0.99):
        limits = Box(
            [-np.inf] * 6,
            [0.9, np.inf, np.inf, np.inf, np.inf, np.inf],
            probability=confidence,
            penalty=None,
        )
        problem = quadrotor_problem(Q=[10.0, 10.0, 1, 1, 1, 1], constraints=[limits])
        count = 25 if form == "trajectory" else 1
        controller = GPMPC(
            gp(),
            propagator(covariance),
            problem,
            H,
            HOVER,
            prediction=PredictionSettings(form=form, covariance=covariance),
            iterations=count,
            tolerance=1e-5,
        )
        last = controller.control(Gaussian.certain(state), reference)
        assert last.status is Status.SOLVED
        highest.append(last.means[1:, 0].max())
        sd = np.sqrt(last.covariances[1:, 0, 0])
        assert (
            last.means[1:, 0] + limits.standard_deviations() * sd
        ).max() < 0.9 + 1e-4
    assert highest[0] > highest[1] + 1e-3 > highest[2] + 2e-3


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("price", [None, 100.0], ids=["hard", "soft"])
def test_a_horizon_of_fifty_with_state_bounds_stays_feasible(form, price):
    H = 50
    limits = Box([-1.5, -0.8] * 3, [1.5, 0.8] * 3, probability=0.95, penalty=price)
    covariance = "zero_order"
    controller = GPMPC(
        gp(),
        MeanEquivalence(),
        quadrotor_problem(constraints=[limits]),
        H,
        HOVER,
        prediction=PredictionSettings(form=form, covariance=covariance),
    )
    states, _, decisions = fly(
        controller, [0.8, 0.0, -0.6, 0.0, 0.5, 0.0], at_origin(H), 2
    )
    assert np.isfinite(states).all()
    assert decisions[-1].inputs.shape == (50, 3)


def test_a_long_horizon_is_feasible_with_feedback_only():
    model = linear_gaussian(2, 1)
    H = 50
    model = replace(
        model,
        A=torch.tensor([[1.0, 0.2], [0.0, 1.0]]),
        B=torch.tensor([[0.02], [0.2]]),
        c=torch.zeros(2),
    )
    problem = Problem(
        Tracking([1.0, 0.1], [0.1], penalized="inputs"),
        constraints=[Box([-1.5, -2.0], [1.5, 2.0], probability=0.95, penalty=None)],
    )
    belief = Gaussian.certain(np.array([0.3, 0.0]))
    reference = Reference(np.zeros((H + 1, 2)))
    closed, opened = (
        GPMPC(
            model,
            Linearization(),
            problem,
            H,
            [0.0],
            prediction=PredictionSettings(feedback=f),
        )
        for f in (True, False)
    )
    assert closed.control(belief, reference).status is Status.SOLVED
    decision = opened.control(belief, reference)
    assert decision.status is Status.INFEASIBLE
    assert "soften" in decision.status.advice
    priced = replace(
        problem, constraints=[replace(problem.constraints[0], penalty=10.0)]
    )
    softened = GPMPC(
        model,
        Linearization(),
        priced,
        H,
        [0.0],
        prediction=PredictionSettings(feedback=False),
    ).control(belief, reference)
    assert softened.status is Status.SOFT_BOUND_MISSED
    assert softened.violation > 1e-3


def test_soft_bounds_cost_what_they_are_said_to_cost():
    model = linear_gaussian(3, 2)
    H = 4
    limits = Box([-0.2] * 3, [0.2] * 3, probability=0.95, kappa=0.0, penalty=0.3)
    problem = Problem(
        Tracking([1.0] * 3, [0.3] * 2, penalized="inputs"),
        inputs=Box([-0.3] * 2, [0.3] * 2),
        constraints=[limits],
    )
    belief = Gaussian.certain(np.array([1.0, -0.5, 0.3]))
    reference = Reference(np.zeros((H + 1, 3)))
    convex = GPMPC(model, Linearization(), problem, H, [0.0] * 2).control(
        belief, reference
    )
    benchmark = NMPC(LinearPlant(model), problem, H, [0.0] * 2).control(
        belief, reference
    )
    assert np.abs(convex.means[1:]).max() > 0.25
    assert np.allclose(convex.inputs, benchmark.inputs, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_a_warm_start_changes_the_time_and_not_the_answer(form):
    limits = Box([-np.inf, -0.4] * 3, [np.inf, 0.4] * 3, probability=0.95, penalty=None)
    controller = GPMPC(
        gp(),
        MeanEquivalence(),
        quadrotor_problem(constraints=[limits]),
        6,
        HOVER,
        prediction=PredictionSettings(form=form, covariance="none"),
        solver=DualActiveSet(),
    )
    _, _, decisions = fly(controller, [0.8, 0, -0.6, 0, 0.5, 0], at_origin(6), 5)
    state = Gaussian.certain(decisions[-1].means[1])
    warm = controller.control(state, at_origin(6), decisions[-1])
    cold = controller.control(
        state, at_origin(6), replace(decisions[-1], solution=None)
    )
    other = controller.control(
        state, at_origin(6), replace(decisions[-1], solution=decisions[0].solution)
    )
    assert np.allclose(warm.inputs, cold.inputs, atol=1e-9)
    assert np.allclose(warm.inputs, other.inputs, atol=1e-9)


def test_a_decision_holds_the_problem_that_it_solves():
    controller = GPMPC(
        gp(), Linearization(), quadrotor_problem(), 3, HOVER, iterations=1
    )
    belief = Gaussian.certain(np.full(6, 0.3))
    decision = controller.control(belief, at_origin(3))
    program = decision.problem
    assert np.array_equal(program.P, program.P.T)
    assert np.allclose(
        DualActiveSet().solve(program).x, decision.inputs.ravel(), atol=1e-9
    )


# Failures.


@pytest.mark.parametrize("iterations", [1, 5])
def test_a_non_finite_measurement_never_reaches_the_solver(iterations):
    controller = GPMPC(
        gp(),
        MeanEquivalence(),
        quadrotor_problem(),
        3,
        HOVER,
        prediction=PredictionSettings(form="trajectory", covariance="none"),
        solver=None,
        iterations=iterations,
    )
    for bad in (np.nan, np.inf):
        decision = controller.control(
            Gaussian.certain(np.array([0, 0, bad, 0, 0, 0])), at_origin(3)
        )
        assert decision.status is Status.INVALID_MEASUREMENT
        assert decision.solution is None
        assert np.isfinite(decision.input).all()


def test_a_decision_that_was_not_solved_is_no_warm_start():
    controller = GPMPC(
        gp(),
        MeanEquivalence(),
        quadrotor_problem(),
        3,
        HOVER,
        prediction=PredictionSettings(form="trajectory", covariance="none"),
    )
    belief = Gaussian.certain(np.full(6, 0.3))
    fresh = controller.control(belief, at_origin(3))
    nothing = {
        "inputs": np.full((3, 3), np.nan),
        "status": Status.NUMERICAL_TROUBLE,
        "solution": None,
    }
    failed = replace(fresh, input=np.array(HOVER), **nothing)
    assert np.array_equal(
        controller.control(belief, at_origin(3), failed).inputs, fresh.inputs
    )


def test_increments_start_at_the_input_applied_after_a_failure():
    problem = quadrotor_problem(input_rates=Box([-0.05] * 3, [0.05] * 3))
    controller = GPMPC(
        gp(),
        MeanEquivalence(),
        problem,
        3,
        HOVER,
        prediction=PredictionSettings(form="trajectory", covariance="none"),
    )
    decision = controller.control(Gaussian.certain(np.full(6, 0.3)), at_origin(3))
    for _ in range(3):
        decision = controller.control(
            Gaussian.certain(np.full(6, 0.3)), at_origin(3), decision
        )
    blind = controller.control(
        Gaussian.certain(np.full(6, np.nan)), at_origin(3), decision
    )
    assert blind.status is Status.INVALID_MEASUREMENT
    following = controller.control(
        Gaussian.certain(np.full(6, 0.3)), at_origin(3), blind
    )
    assert np.abs(following.input - blind.input).max() <= 0.05 + 1e-8
    assert np.abs(blind.input - np.array(HOVER)).max() > 0.1


@pytest.mark.parametrize("iterations", [1, 10])
def test_bounds_that_cannot_be_kept_are_reported(iterations):
    limits = Box([-np.inf] * 6, [0.1] + [np.inf] * 5, probability=0.95, penalty=None)
    controller = GPMPC(
        gp(),
        MeanEquivalence(),
        quadrotor_problem(constraints=[limits]),
        3,
        HOVER,
        prediction=PredictionSettings(form="trajectory", covariance="none"),
        solver=None,
        iterations=iterations,
    )
    decision = controller.control(
        Gaussian.certain(np.array([0.8, 0.5, 0, 0, 0, 0])), at_origin(3)
    )
    assert decision.status is Status.INFEASIBLE
    assert decision.solution.status is Status.INFEASIBLE


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 0}, "horizon: must be a whole number, 1 or more; got 0"),
        (
            {"problem": Problem(Tracking([1.0] * 5, [1.0] * 3))},
            "must weigh 6 states and 3 inputs; got 5 and 3",
        ),
        ({"initial_input": [0.0]}, "initial_input: must be a list of 3 numbers"),
        (
            {"prediction": {"form": "ltv"}},
            "form: must be one of 'trajectory', 'velocity'; got 'ltv'",
        ),
        (
            {"prediction": {"covariance": "some"}},
            "one of 'full', 'diagonal', 'zero_order', 'none'; got 'some'",
        ),
        ({"iterations": 0}, "iterations: must be a whole number, 1 or more; got 0"),
        (
            {"iterations": 2, "prediction": {"form": "velocity"}},
            "velocity' is one quadratic program, so 1; got 2",
        ),
        ({"tolerance": 0.0}, "tolerance: must be a number above 0"),
        (
            {"prediction": {"feedback": "yes"}},
            "feedback: must be true or false; got 'yes'",
        ),
        (
            {
                "problem": quadrotor_problem(constraints=[Box([0] * 6, [1] * 6)]),
                "solver": CvxpySolver(),
            },
            "solver: soft constraints need DualActiveSet .*; got CvxpySolver",
        ),
    ],
)
def test_misuse_is_refused_at_construction(changes, message):
    good = {"problem": quadrotor_problem(), "horizon": 3, "initial_input": HOVER}

    def make(prediction=None, **settings):
        GPMPC(
            gp(),
            Linearization(),
            prediction=PredictionSettings(**prediction or {}),
            **settings,
        )

    with pytest.raises(SettingError, match=message):
        make(**(good | changes))


def test_a_reference_that_does_not_belong_is_refused():
    belief = Gaussian.certain(np.zeros(6))
    controller = GPMPC(gp(), Linearization(), quadrotor_problem(), 3, HOVER)
    with pytest.raises(
        ShapeError,
        match=r"penalized 'deviations' needs reference inputs \(3, 3\); got none",
    ):
        controller.control(belief, Reference(np.zeros((4, 6))))
    with pytest.raises(ShapeError, match=r"\(4, 6\); got \(6,\) and \(3, 6\)"):
        controller.control(belief, at_origin(2))
    with pytest.raises(ShapeError, match=r"got \(5,\) and \(4, 6\)"):
        controller.control(Gaussian.certain(np.zeros(5)), at_origin(3))


@pytest.mark.parametrize("process_noise", [False, True])
@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("covariance", ["zero_order", "none"])
def test_the_compiled_rollout_is_the_one_stage_by_stage(
    covariance, feedback, process_noise
):
    H = 6
    propagator = Linearization(process_noise=process_noise)
    settings = PredictionSettings(covariance=covariance, feedback=feedback)
    compiled, by_torch = (
        GPMPC(gp(), propagator, quadrotor_problem(), H, HOVER, settings)
        for _ in range(2)
    )
    belief = Gaussian(torch.full((6,), 0.2), 1e-3 * torch.eye(6))
    first = compiled.control(belief, at_origin(H))
    with backend("torch"):
        expected = by_torch.control(belief, at_origin(H), first)
    decision = compiled.control(belief, at_origin(H), first)
    assert np.allclose(decision.inputs, expected.inputs, atol=1e-9)
    assert np.allclose(decision.means, expected.means, atol=1e-10)
    assert np.allclose(decision.covariances, expected.covariances, atol=1e-12)


@pytest.mark.parametrize("evaluated", ["auto", "torch"])
@pytest.mark.parametrize(
    ("form", "covariance"), [pair for pair in PAIRS if pair[1] != "none"]
)
def test_observation_noise_widens_predictions_on_request(form, covariance, evaluated):
    state = Gaussian.certain(np.array([0.3, 0.0, -0.2, 0.1, 0.2, 0.0]))
    covariances = []
    for noise in (False, True):
        how = Linearization(process_noise=noise)
        controller = GPMPC(
            gp(),
            how,
            quadrotor_problem(),
            3,
            HOVER,
            prediction=PredictionSettings(
                form=form, covariance=covariance, feedback=False
            ),
        )
        with backend(evaluated):
            covariances.append(controller.control(state, at_origin(3)).covariances[1])
    assert np.allclose(
        covariances[1] - covariances[0], gp().noise_covariance, atol=1e-6
    )  # of 1e-4; the plans differ a little


def test_parts_of_a_decision_are_timed_and_share_the_model(monkeypatch):
    model = linear_gaussian(2, 1)
    H = 3
    problem = Problem(Tracking([1.0, 1.0], [0.1]))
    reference = Reference(np.zeros((H + 1, 2)), np.zeros((H, 1)))
    controller = GPMPC(model, Linearization(), problem, H, [0.0], iterations=1)
    at = Gaussian.certain(np.ones(2))
    looks = iter([0.0, 1.0, 11.0, 111.0, 1111.0])
    for module in (gp_mpc, _control_step):
        monkeypatch.setattr(module, "perf_counter", lambda: next(looks))
    assert controller.control(at, reference).timing == Timing(1.0 + 1000.0, 10.0, 100.0)
    looks = iter(
        [
            0.0,
            4.0,
            *(100.0 + k for k in (0, 1, 3, 7, 15)),
            *(200.0 + k for k in (0, 10, 30, 70, 150)),
        ]
    )
    first, second = controller.control_many([at, at], [reference] * 2, [None] * 2)
    assert first.timing == Timing(4.0 / 2 + 1.0 + 8.0, 2.0, 4.0)
    assert second.timing == Timing(4.0 / 2 + 10.0 + 80.0, 20.0, 40.0)
    looks = iter(range(20))
    again = GPMPC(model, Linearization(), problem, H, [0.0], iterations=5).control(
        at, reference
    )
    assert again.timing == Timing(
        again.iterations + 1.0, float(again.iterations), float(again.iterations)
    )
