from dataclasses import replace
from functools import partial
from time import perf_counter

import casadi
import numpy as np
import pytest
import torch

from benchmarks.kkt import Instance, kkt_residual
from benchmarks.pendulums import pendulum_gp
from gpmpc.exceptions import DataError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, backend
from gpmpc.models import CasadiFunction, KnownModel, Linearized
from gpmpc.mpc import (
    GPMPC,
    Box,
    Decision,
    PredictionSettings,
    Problem,
    Reference,
    Timing,
    Tracking,
    _sqp,
)
from gpmpc.mpc._guess import initial_guess, read_request
from gpmpc.mpc._roll_out import roll_out
from gpmpc.mpc._sqp import Progress
from gpmpc.propagation import Linearization
from gpmpc.qp import DualActiveSet
from gpmpc.status import Status
from tests.mpc.systems import HOVER, linear_gaussian, quadrotor_gp

BOX = {"inputs": Box([0.0, -0.7, -0.7], [20.0, 0.7, 0.7])}


@pytest.fixture(scope="module")
def quadrotor():
    return quadrotor_gp(40)


@pytest.fixture(scope="module")
def reachable(quadrotor):
    """A reference that the model follows exactly, at no cost: its own rollout."""
    inputs = HOVER + 0.05 * np.random.default_rng(0).normal(size=(5, 3))
    states = [np.zeros(6)]
    for u in inputs:
        states.append(
            quadrotor.predict(torch.tensor(states[-1]), torch.tensor(u)).mean.numpy()
        )
    return Reference(np.array(states), inputs)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-9, 1e-300])
def test_a_reference_that_can_be_reached_at_no_cost_is_reached(
    quadrotor, reachable, tolerance
):
    """1e-300 asks for more than there is: it ends where every step is lost in
    round-off."""
    problem = Problem(
        Tracking([10.0, 1.0] * 3, [0.1] * 3, penalized="deviations"), **BOX
    )
    controller = GPMPC(
        quadrotor,
        Linearization(),
        problem,
        5,
        HOVER,
        prediction=PredictionSettings(covariance="none"),
        iterations=40,
        tolerance=tolerance,
    )
    decision = controller.control(Gaussian.certain(np.zeros(6)), reachable)
    assert decision.status is Status.SOLVED
    assert np.abs(decision.inputs - reachable.inputs).max() < max(
        1e-2 * tolerance, 1e-9
    )
    assert decision.iterations < (12 if tolerance >= 1e-6 else 40)


@pytest.mark.parametrize("penalized", ["inputs", "increments"])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-7])
def test_a_regulator_at_its_origin_has_no_trouble(penalized, tolerance):
    """Data and their mirror image: the origin is an equilibrium of the mean, to which
    all cost vanishes."""
    half = pendulum_gp(2, 40)
    features, targets = (
        torch.cat([part, -part]) for part in (half.features, half.targets)
    )
    parts = half.lengthscales, half.signal_variance, half.noise_variance
    model = GPPosterior.from_hyperparameters(
        features, targets, *parts, 1, predicts="difference"
    )
    problem = Problem(
        Tracking([10.0, 1.0], [0.1], penalized=penalized), inputs=Box([-6.0], [6.0])
    )
    controller = GPMPC(
        model,
        Linearization(),
        problem,
        8,
        [0.0],
        prediction=PredictionSettings(covariance="none"),
        iterations=20,
        tolerance=tolerance,
    )
    state = np.array([0.8, 0.0])
    last = None
    for _ in range(120):
        last = controller.control(
            Gaussian.certain(state), Reference(np.zeros((9, 2))), last
        )
        assert last.status is Status.SOLVED
        state = model.predict(
            torch.tensor(state), torch.tensor(last.input)
        ).mean.numpy()
    assert np.abs(state).max() < 1e-9


def test_the_residual_vanishes_with_distance_as_the_cost_does(quadrotor):
    """The cosine alone would not: the root of the cost is as small as the gradient."""
    inputs = np.tile(HOVER, (3, 1))
    states = [np.zeros(6)]
    for u in inputs:
        states.append(
            quadrotor.predict(torch.tensor(states[-1]), torch.tensor(u)).mean.numpy()
        )
    problem = Problem(Tracking([10.0, 1.0] * 3, [0.1] * 3), **BOX)
    question = Instance(
        Gaussian.certain(np.zeros(6)), Reference(np.array(states)), HOVER
    )
    far, near, nearer = (
        kkt_residual(quadrotor, problem, question, inputs + d)
        for d in (1e-1, 1e-6, 1e-8)
    )
    assert far > 0.1
    assert near < 1e-2
    assert nearer == pytest.approx(1e-2 * near, rel=1e-3)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_what_is_called_solved_is_within_ten_times_the_tolerance(quadrotor, tolerance):
    """The stop estimates the residual of a plan that it has not rolled out; here
    another measures it."""
    problem = Problem(Tracking([10.0, 1.0] * 3, [0.1] * 3), **BOX)
    controller = GPMPC(
        quadrotor,
        Linearization(),
        problem,
        5,
        HOVER,
        prediction=PredictionSettings(covariance="none"),
        iterations=80,
        tolerance=tolerance,
    )
    random = np.random.default_rng(1)
    last = None
    before = HOVER
    for _ in range(20):
        belief = Gaussian.certain(0.5 * random.uniform(-1, 1, 6))
        reference = Reference(np.tile(0.5 * random.uniform(-1, 1, 6), (6, 1)))
        last = controller.control(belief, reference, last)
        assert last.status is Status.SOLVED
        residual = kkt_residual(
            quadrotor, problem, Instance(belief, reference, before), last.inputs
        )
        assert residual < 10 * tolerance
        before = last.input


@pytest.mark.parametrize(
    ("scale", "bound"), [(1.0, 0.01), (1e6, 1.0), (1e6, 1e4), (1e9, 1e7)]
)
def test_plans_keep_their_rates_in_any_unit_of_the_inputs(scale, bound):
    model = linear_gaussian(2, 1)
    model = replace(model, B=model.B / scale)
    problem = Problem(
        Tracking([10.0, 1.0], [0.1 / scale**2]), input_rates=Box([-bound], [bound])
    )
    controller = GPMPC(
        model,
        Linearization(),
        problem,
        8,
        [1.234567 * scale],
        prediction=PredictionSettings(covariance="none"),
        iterations=10,
    )
    state = np.array([0.8, 0.0])
    last = None
    before = np.array([1.234567 * scale])
    bitten = 0
    for _ in range(20):
        last = controller.control(
            Gaussian.certain(state), Reference(np.zeros((9, 2))), last
        )
        assert last.status is Status.SOLVED
        rates = np.diff(last.inputs, axis=0, prepend=before[None])
        assert np.abs(rates).max() <= bound + 1e-9 * max(1.0, np.abs(last.inputs).max())
        bitten += int((np.abs(np.diff(last.inputs[:, 0])) > 0.999 * bound).sum())
        state = model.predict(
            torch.tensor(state), torch.tensor(last.input)
        ).mean.numpy()
        before = last.input
    assert bitten > 10


class Other:
    """A solver of somebody else's."""

    def solve(self, problem, warm_start=None):
        return DualActiveSet().solve(problem, warm_start)


BOUNDS = Box([-np.inf, -0.3] * 3, [np.inf, 0.3] * 3, probability=0.95, penalty=20.0)


@pytest.mark.parametrize("covariance", ["zero_order", "none"])
@pytest.mark.parametrize(
    "limits",
    [
        {},
        {"input_rates": Box([-0.5, -0.05, -0.05], [0.5, 0.05, 0.05])},
        {"constraints": [BOUNDS]},
    ],
    ids=["box", "rates", "soft states"],
)
def test_compiled_and_torch_and_another_solver_iterate_alike(
    quadrotor, covariance, limits
):
    problem = Problem(Tracking([10.0, 1.0] * 3, [0.1] * 3), **BOX, **limits)
    mpc = partial(
        GPMPC,
        quadrotor,
        Linearization(),
        problem,
        horizon=5,
        initial_input=HOVER,
        prediction=PredictionSettings(covariance=covariance),
        iterations=60,
        tolerance=1e-7,
    )
    ours = mpc()
    # Prices need our own solver.
    other = mpc() if "constraints" in limits else mpc(solver=Other())
    random = np.random.default_rng(2)
    last = None
    before = None
    programs = 0
    for _ in range(8):
        belief = Gaussian(
            torch.tensor(0.4 * random.uniform(-1, 1, 6)), 1e-4 * torch.eye(6)
        )
        reference = Reference(np.tile(0.5 * random.uniform(-1, 1, 6), (6, 1)))
        last = ours.control(belief, reference, last)
        with backend("torch"):
            before = other.control(belief, reference, before)
        assert last.status is before.status
        assert last.iterations == before.iterations
        for name in ("inputs", "means", "covariances"):
            assert np.allclose(
                getattr(last, name),
                getattr(before, name),
                rtol=0,
                atol=1e-9,
                equal_nan=True,
            )
        programs += last.iterations * last.status.solved
    assert programs > 16


def test_the_order_in_memory_of_what_is_asked_changes_nothing(quadrotor):
    problem = Problem(
        Tracking([10.0, 1.0] * 3, [0.1] * 3, penalized="deviations"), **BOX
    )
    controller = GPMPC(quadrotor, Linearization(), problem, 5, HOVER, iterations=30)
    random = np.random.default_rng(3)
    states = 0.3 * random.uniform(-1, 1, (6, 6))
    inputs = HOVER + 0.1 * random.uniform(-1, 1, (5, 3))
    S = torch.tensor(np.cov(random.normal(size=(6, 40)))) * 1e-3
    plain = controller.control(
        Gaussian(torch.tensor(states[0]), S), Reference(states, inputs)
    )
    mean = torch.tensor(np.repeat(states[0], 2))[::2]
    strided = Reference(np.asfortranarray(states), np.repeat(inputs, 2, axis=0)[::2])
    other = controller.control(Gaussian(mean, S.mT), strided)
    assert plain.status is Status.SOLVED
    assert np.array_equal(plain.inputs, other.inputs)
    assert np.array_equal(plain.covariances, other.covariances)


def test_the_parts_of_the_time_are_within_what_the_step_took(quadrotor, reachable):
    problem = Problem(
        Tracking([10.0, 1.0] * 3, [0.1] * 3, penalized="deviations"), **BOX
    )
    controller = GPMPC(
        quadrotor,
        Linearization(),
        problem,
        5,
        HOVER,
        prediction=PredictionSettings(covariance="none"),
        iterations=30,
    )
    began = perf_counter()
    timing = controller.control(Gaussian.certain(np.zeros(6)), reachable).timing
    assert timing.total <= perf_counter() - began
    assert min(timing.model, timing.build, timing.solve) > 0


@pytest.mark.parametrize("start", ["reference", "hover"])
@pytest.mark.parametrize("horizon", [10, 30, 60])
def test_without_a_plan_few_programs_reach_a_kkt_point(quadrotor, horizon, start):
    problem = Problem(Tracking([1.0] * 6, [1.0] * 3), **BOX)
    controller = GPMPC(
        quadrotor,
        Linearization(),
        problem,
        horizon,
        HOVER,
        prediction=PredictionSettings(covariance="none"),
        iterations=8,
    )
    time = 0.5 * np.arange(horizon + 1)[:, None]
    references = np.hstack(
        [
            part
            for axis in range(3)
            for part in (0.3 * np.sin(time + axis), 0.3 * np.cos(time + axis))
        ]
    )
    belief = Gaussian.certain(references[0])
    previous = None
    if start == "hover":
        zeros = np.zeros((horizon + 1, 6, 6))
        plan = (
            np.tile(HOVER, (horizon, 1)),
            np.tile(references[0], (horizon + 1, 1)),
            zeros,
        )
        previous = Decision(HOVER, *plan, Status.SOLVED, 1, Timing(0.0, 0.0, 0.0))
    decision = controller.control(belief, Reference(references), previous)
    assert decision.status is Status.SOLVED
    residual = kkt_residual(
        quadrotor,
        problem,
        Instance(belief, Reference(references), HOVER),
        decision.inputs,
    )
    assert residual < 1e-5


class Table:
    """A pendulum-like model that is known for |x_i| <= 6 only."""

    state_dim = 2
    input_dim = 1
    output_dim = 2
    dtype = torch.float64
    device = torch.device("cpu")
    noise_covariance = torch.zeros(2, 2, dtype=torch.float64)

    def predict(self, state, input):
        raise NotImplementedError

    def linearize(self, states, inputs, covariance=True):
        if (np.abs(states) > 6).any():
            raise DataError("beyond the table")
        x, v = states.T
        mean = np.stack(
            [x + 0.1 * v, v + 0.1 * (3 * np.sin(x) * v + inputs[:, 0])], axis=1
        )
        A = np.tile(np.eye(2), (len(x), 1, 1))
        B = np.tile([[0.0], [0.1]], (len(x), 1, 1))
        A[:, 0, 1] = 0.1
        A[:, 1, 0] = 0.3 * np.cos(x) * v
        A[:, 1, 1] = 1 + 0.3 * np.sin(x)
        return Linearized(mean, A, B, np.zeros((len(x), 2, 2)) if covariance else None)


@pytest.mark.parametrize("start", [[-3.0, 2.0], [1.0, 5.0], [4.0, 4.0]])
def test_a_step_to_where_the_model_is_not_finite_is_shortened(start):
    problem = Problem(Tracking([10.0, 0.1], [0.01]), inputs=Box([-20.0], [20.0]))
    controller = GPMPC(
        Table(),
        Linearization(),
        problem,
        20,
        [0.0],
        PredictionSettings(covariance="none"),
        iterations=15,
    )
    decision = controller.control(
        Gaussian.certain(np.array(start)), Reference(np.zeros((21, 2)))
    )
    assert decision.applicable
    assert decision.iterations > 4


def test_the_first_step_of_a_warm_start_needs_no_roll_out(quadrotor, monkeypatch):
    problem = Problem(Tracking([1.0] * 6, [1.0] * 3), **BOX)
    settings = PredictionSettings(covariance="none")
    controller = GPMPC(
        quadrotor, Linearization(), problem, 10, HOVER, settings, iterations=20
    )
    rolled = []

    def counted_roll_out(*arguments):
        rolled.append(1)
        return roll_out(*arguments)

    monkeypatch.setattr(_sqp, "roll_out", counted_roll_out)
    reference = Reference(np.tile([0.5, 0.0] * 3, (11, 1)))
    pushed = Gaussian.certain(np.array([-0.3, 0.2] * 3))
    last = controller.control(Gaussian.certain(np.zeros(6)), reference)
    assert rolled
    rolled.clear()
    near = Gaussian.certain(last.means[1] + 1e-3)
    assert controller.control(near, reference, last).status is Status.SOLVED
    assert not rolled
    warm = controller.control(pushed, reference, last)
    rolled.clear()
    from_plan = controller.control(
        pushed, reference, last, plan=(last.inputs, last.means)
    )
    assert rolled
    assert (last.status, warm.status, from_plan.status) == (Status.SOLVED,) * 3
    assert np.allclose(warm.inputs, from_plan.inputs, atol=1e-4)


def test_a_guess_rests_at_the_state_where_its_inputs_overflow():
    x = casadi.SX.sym("x")
    u = casadi.SX.sym("u")
    runaway = KnownModel(
        CasadiFunction(casadi.Function("f", [x, u], [x + 0.1 * (x**3 + u)])), 1, 1
    )
    problem = Problem(
        Tracking([1.0], [1.0], penalized="inputs"), inputs=Box([-99.0], [99.0])
    )
    settings = PredictionSettings(covariance="none")
    controller = GPMPC(
        runaway, Linearization(), problem, 12, [0.0], settings, iterations=30
    )
    belief = Gaussian.certain(np.array([0.5]))
    reference = Reference(np.zeros((13, 1)))
    last = controller.control(belief, reference)
    request = read_request(
        controller.prediction, belief, reference, last, plan=np.full((12, 1), 50.0)
    )
    assert request.guessed_states is not None
    guess = initial_guess(controller.prediction, request)
    assert guess.states.ravel().tolist() == [0.5] * 13
    decision = controller.control(belief, reference, last, plan=np.full((12, 1), 50.0))
    assert decision.status is Status.SOLVED
    assert np.allclose(decision.inputs, last.inputs, atol=1e-4)


def test_a_stall_needs_two_rates_that_were_seen():
    """A first step says nothing of what rounding leaves, however small it is."""
    progress = Progress()
    for steps in (1, 2):
        progress = progress.after(9e-6)
        assert progress.steps == steps
        assert not progress.is_converged(tolerance=1e-8)
    assert progress.after(9e-6).is_converged(tolerance=1e-8)
