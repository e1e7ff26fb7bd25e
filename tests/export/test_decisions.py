"""The compiled C decides as Python does."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.export import CompiledController, CompiledLoop
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import (
    Affine,
    CasadiFunction,
    DelayedModel,
    DisturbedModel,
    KnownModel,
    ResidualModel,
)
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Halfspaces,
    Inequality,
    LeastSquares,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc._judgement import _learned_noise
from gpmpc.propagation import Linearization
from gpmpc.simulation import ModelLoop, closed_loop
from gpmpc.status import Status
from gpmpc.studies._outlook import outlook
from tests.mpc.small_models import pendulum_posterior

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
COMPILER = ("cc", "-O0", "-Wall", "-Wextra", "-Werror", "-pedantic")
GP = pendulum_posterior()
WEIGHTS = Tracking([1.0, 0.1], [0.05])
TORQUES = Box([-2.0], [2.0])


def gpmpc(problem, model=GP, horizon=6, propagator=None, **prediction):
    propagator = Linearization() if propagator is None else propagator
    return GPMPC(
        model,
        propagator,
        problem,
        horizon,
        np.zeros(model.input_dim),
        prediction=PredictionSettings(**prediction),
        iterations=1,
    )


def pendulum_with_features():
    """A residual on a nominal model, seen through sine and cosine of the angle."""
    generator = torch.Generator().manual_seed(0)
    states = (2 * torch.rand(30, 2, generator=generator) - 1) * 3.0
    torques = 2 * torch.rand(30, 1, generator=generator) - 1
    features = torch.cat(
        [states[:, :1].sin(), states[:, :1].cos(), states[:, 1:], torques], dim=1
    )
    residual = GPPosterior.from_hyperparameters(
        features,
        (-0.8 * features[:, :1] - 0.06 * features[:, 2:3]),
        lengthscales=torch.tensor([[1.5, 1.5, 6.0, 8.0]]),
        signal_variance=torch.tensor([1.0]),
        noise_variance=torch.tensor([1e-4]),
        input_dim=1,
        predicts="value",
    )
    return ResidualModel(
        nominal=Affine(
            torch.tensor([[1.0, 0.2], [0.0, 1.0]]),
            torch.tensor([[0.02], [0.2]]),
            torch.zeros(2),
        ),
        residual=residual,
        B=torch.tensor([[0.1], [1.0]]),
        states=[0, 1],
        inputs=[0],
        input_dim=1,
        angles=[0],
    )


def delayed():
    """Inputs that act one and a half steps late."""
    model = DelayedModel(pendulum_with_features(), 1.5)
    problem = Problem(Tracking([1.0, 0.1, 0.0, 0.0], [0.05], angles=[0]), TORQUES)
    return gpmpc(problem, model, disturbance_gain=0.3)


def disturbed():
    """A disturbance of the rate as a state."""
    model = DisturbedModel(GP, torch.tensor([[0.0], [1.0]]), [0.01], [0.9])
    problem = Problem(Tracking([1.0, 0.1, 0.0], [0.05]), TORQUES)
    return gpmpc(problem, model)


def by_stage():
    """Weights, bounds and rows that differ by stage."""
    stages = np.linspace(1.0, 2.0, 6)
    cost = Tracking(
        stages[:, None, None] * np.diag([1.0, 0.1]),
        stages[:, None, None] * [[0.05]],
        terminal=[5.0, 0.5],
        penalized="inputs",
    )
    inputs = Box(-stages[:, None], stages[:, None])
    rows = Box([-0.5, -1.0], [0.5, 1.0], stages=range(2, 5), penalty=3.0)
    return gpmpc(Problem(cost, inputs, constraints=[rows]), rolled_out=True)


def tube(penalty, unit=1.0, **prediction):
    """A plane that is kept with 90 %, under rates and process noise."""
    plane = Halfspaces(
        [[unit, 0.2 * unit]], [0.3 * unit], probability=0.9, penalty=penalty
    )
    problem = Problem(
        WEIGHTS, TORQUES, input_rates=Box([-0.8], [0.8]), constraints=[plane]
    )
    return gpmpc(problem, **prediction)


def two_lanes(unit, cost_unit):
    """Two planes that are narrower than their tubes, one in another unit."""
    place = Halfspaces([[unit, 0.2 * unit]], [0.3 * unit], kappa=3.0)
    speed = Halfspaces([[0.5, -1.0]], [0.2], kappa=3.0)
    cost = Tracking([cost_unit, 0.1 * cost_unit], [0.05 * cost_unit])
    return gpmpc(Problem(cost, TORQUES, constraints=[place, speed]))


def unweighed(unit):
    """A bound of states that nothing weighs but their energy, which gives way."""
    rail = Halfspaces([[unit, 0.0]], [0.05 * unit])
    x = casadi.SX.sym("x", 2)
    energy = LeastSquares(casadi.Function("y", [x], [casadi.sin(x[0])]), [0.3])
    cost = Tracking([0.0, 0.0], [0.05], penalized="inputs")
    return gpmpc(Problem(cost, TORQUES, constraints=[rail], outputs=[energy]))


def obstacle(penalty="elastic"):
    """A disc that moves in the plane of the states, and a cost of energy, in CasADi."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    p = casadi.SX.sym("p")
    distance = casadi.sqrt((x[0] - p) ** 2 + 0.2 * x[1] ** 2 + 1e-3)
    too_near = casadi.Function("h", [x, u, p], [0.3 - distance])
    apart = Inequality(too_near, probability=0.8, penalty=penalty)
    energy = casadi.vertcat(casadi.sin(x[0]) + 0.1 * u, x[1] * u)
    output = LeastSquares(casadi.Function("y", [x, u], [energy]), [0.3, 0.1])
    box = Box([-2.0, -np.inf], [2.0, np.inf])
    return gpmpc(Problem(WEIGHTS, TORQUES, constraints=[box, apart], outputs=[output]))


def narrow_lane():
    """A lane narrower than its tubes in the end, a bound of the input, one to keep."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    push = Inequality(casadi.Function("h", [x, u], [u + 0.1 * x[1] - 0.3]))
    lane = Box([-0.6, -np.inf], [0.6, np.inf], kappa=20.0)
    fast = Box([-np.inf, -2.0], [np.inf, 2.0])
    problem = Problem(WEIGHTS, TORQUES, constraints=[lane, push, fast])
    noisy = Linearization(process_noise=True)
    return gpmpc(problem, horizon=12, propagator=noisy, feedback=False)


def bound_that_ends(penalty):
    """A bound that has no number where the angle is beyond half a radian."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    value = 0.1 - casadi.sqrt(0.5 - x[0])
    bound = Inequality(casadi.Function("h", [x, u], [value]), penalty=penalty)
    return gpmpc(Problem(WEIGHTS, TORQUES, constraints=[bound]))


CONTROLLERS = {
    "inputs": lambda: gpmpc(Problem(Tracking([1.0, 0.1], [0.05], penalized="inputs"))),
    "deviations": lambda: gpmpc(
        Problem(Tracking([1.0, 0.1], [0.05], penalized="deviations"), TORQUES)
    ),
    "elastic tube": lambda: tube("elastic"),
    "exact tube": lambda: tube("exact"),
    "elastic tube in a large unit": lambda: tube("elastic", unit=1e-3),
    "exact tube in a large unit": lambda: tube("exact", unit=1e-3),
    "hard tube": lambda: tube(None, rolled_out=True),
    "two lanes": lambda: two_lanes(1.0, 1.0),
    "two lanes in unlike units": lambda: two_lanes(1e3, 1e-9),
    "narrow lane": narrow_lane,
    "states that nothing weighs, in a large unit": lambda: unweighed(2.0**-10),
    "obstacle and energy": obstacle,
    "hard obstacle": lambda: obstacle(None),
    "hard bound that ends": lambda: bound_that_ends(None),
    "elastic bound that ends": lambda: bound_that_ends("elastic"),
    "velocity form": lambda: gpmpc(Problem(WEIGHTS, TORQUES), form="velocity"),
    "delay, estimate, angles": delayed,
    "disturbance as a state": disturbed,
    "by stage, rolled out": by_stage,
    "long and unstable": lambda: gpmpc(
        Problem(Tracking([1.0, 0.1], [1e-8]), TORQUES), horizon=25, covariance="none"
    ),
}


LOST = (np.nan, 1e38)  # of a sensor that saw nothing
# by stage, of those that take some
PLACES = np.linspace(0.3, 0.7, 6)[:, None]
PARAMETERS = {"obstacle and energy": PLACES, "hard obstacle": PLACES}


def questions(controller, steps, seed=0):
    """Yields measured states of a rough walk, some of them lost, and references."""
    rng = np.random.default_rng(seed)
    n = controller.prediction.state_dim
    H = controller.horizon
    state = np.zeros(n)
    for k in range(steps):
        state = 0.9 * state + rng.normal(0, 0.3, n)
        is_lost = k % 9 in (1, 5, 6)
        measured = np.full(n, LOST[k % len(LOST)]) if is_lost else state
        path = np.zeros((H + 1, n))
        path[:, 0] = np.sin(0.1 * (k + np.arange(H + 1)))
        inputs = 0.2 * np.cos(0.1 * (k + np.arange(H)))[:, None]
        yield measured, Reference(path, inputs)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_decides_as_python(name):
    controller = CONTROLLERS[name]()
    python = ControlLoop(controller)
    compiled = CompiledLoop(controller, compiler=COMPILER)
    parameters = PARAMETERS.get(name)
    for measured, reference in questions(controller, 60):
        expected = python.input(measured, reference, parameters)
        got = compiled.input(measured, reference, parameters)
        assert np.abs(got - expected).max() < 1e-9
        assert python.last is not None
        assert (compiled.status, compiled.failed) == (
            python.last.status,
            python.last.failed,
        )


def test_every_status_is_met():
    """The rough walk is rough enough for the policy to be asked."""
    statuses = set()
    for name in ("elastic tube", "hard tube"):
        controller = CONTROLLERS[name]()
        loop = ControlLoop(controller)
        for measured, reference in questions(controller, 60):
            loop.input(measured, reference)
            assert loop.last is not None
            statuses.add(loop.last.status)
    assert {
        Status.SOLVED,
        Status.INFEASIBLE,
        Status.SOFT_BOUND_MISSED,
        Status.HARD_BOUND_MISSED,
        Status.INVALID_MEASUREMENT,
    } <= statuses


def test_holds_the_input_where_that_is_asked():
    """Plans that are rolled out miss the hard plane, and say so."""
    controller = tube(None, rolled_out=True)
    python = ControlLoop(controller, "hold")
    compiled = CompiledLoop(controller, on_failure="hold", compiler=COMPILER)
    missed = 0
    for measured, reference in questions(controller, 40):
        expected = python.input(measured, reference)
        assert np.abs(compiled.input(measured, reference) - expected).max() < 1e-9
        assert python.last is not None
        assert compiled.status is python.last.status
        decision = python.last.decision
        missed += decision is not None and decision.violation > 1e-5
    assert missed


def vessel():
    """A level that is to rise beyond a hard bound of some hundreds."""
    filling = Affine(torch.tensor([[0.97]]), torch.tensor([[1.0]]), torch.tensor([0.3]))
    problem = Problem(
        Tracking([1.0], [0.05], penalized="inputs"),
        Box([-20.0], [20.0]),
        constraints=[Box([-np.inf], [333.3], penalty=None)],
    )
    model = KnownModel(filling, 1, 1)
    return gpmpc(problem, model, covariance="none", rolled_out=True)


def test_float_differs_by_little():
    """By 1e-4 of the torques' range, and with the same statuses."""
    controller = tube("elastic")
    python = ControlLoop(controller)
    optimised = (*COMPILER, "-O1")  # which warns of more
    compiled = CompiledLoop(controller, precision="float", compiler=optimised)
    for measured, reference in questions(controller, 40):
        expected = python.input(measured, reference)
        assert np.abs(compiled.input(measured, reference) - expected).max() < 4e-4
        assert python.last is not None
        assert compiled.status is python.last.status


def test_float_rolls_out_under_the_same_feedback():
    """Here under none, though its program is condensed in feedback coordinates."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    rate = x[1] + 0.2 * (u - 0.3 * x[1] ** 3)
    slide = casadi.Function("f", [x, u], [casadi.vertcat(x[0] + 0.2 * x[1], rate)])
    controller = gpmpc(
        Problem(Tracking([1.0, 0.1], [1e-3]), TORQUES),
        KnownModel(CasadiFunction(slide), 2, 1),
        horizon=12,
        covariance="none",
        feedback=False,
        rolled_out=True,
    )
    compiled = CompiledController(controller, precision="float", compiler=COMPILER)
    belief = Gaussian.certain([1.5, -1.0])
    expected = controller.control(belief, Reference(np.zeros(2)))
    got = compiled.control(belief, Reference(np.zeros(2)))
    assert np.abs(got.inputs - expected.inputs).max() < 1e-4
    assert np.abs(got.means - expected.means).max() < 1e-4


def test_float_says_what_is_missed_not_what_is_rounded():
    controller = vessel()
    compiled = CompiledLoop(controller, precision="float", compiler=COMPILER)
    for level in np.linspace(300.0, 333.0, 30):
        compiled.input([level], np.array([400.0]))
        assert compiled.status is Status.SOLVED


def test_float_pays_no_price_for_a_bound_that_is_kept():
    """Of two exact bounds no input moves one: its price outweighs all else."""
    plant = Affine(
        torch.tensor([[1.0, 0, 0, 0.1], [0, 1, 0, -0.1], [0, 0, 1, 0], [0, 0, 0, 1]]),
        torch.tensor([[-0.107, -0.074], [0.216, 0.211], [-0.148, -0.110], [0, 0]]),
        torch.zeros(4),
    )
    problem = Problem(
        Tracking([9.0, 2.2, 11.0, 5.0], [0.009, 0.01], penalized="inputs"),
        Box([-1.1, -2.2], [2.0, 1.7]),
        constraints=[
            Box(
                [-np.inf, -np.inf, -0.93, -1.2],
                [np.inf, 0.44, np.inf, 0.3],
                penalty="exact",
            )
        ],
    )
    controller = gpmpc(problem, KnownModel(plant, 4, 2), horizon=1, covariance="none")
    python = ControlLoop(controller)
    compiled = CompiledLoop(controller, precision="float", compiler=COMPILER)
    rng = np.random.default_rng(0)
    for _ in range(200):
        measured = rng.normal(0, 0.5, 4)
        expected = python.input(measured, np.zeros(4))
        assert np.abs(compiled.input(measured, np.zeros(4)) - expected).max() < 1e-4


def test_answers_what_needs_doubled_digits():
    """A soft bound far out of reach of a plant that quadruples its state at each step.

    Sixteen digits do not tell which bounds hold: Python solves it in doubled ones.
    """
    plant = Affine(
        torch.tensor([[4.0, 1.0], [0.0, 2.0]]),
        torch.tensor([[0.0], [1.0]]),
        torch.zeros(2),
    )
    model = KnownModel(plant, state_dim=2, input_dim=1)
    ceiling = Box(upper=[1.0, np.inf])
    problem = Problem(
        Tracking([1.0, 0.1], [1e-3]),
        TORQUES,
        input_rates=Box([-0.5], [0.5]),
        constraints=[ceiling],
    )
    controller = gpmpc(problem, model, horizon=10, covariance="none")
    compiled = CompiledController(controller, compiler=COMPILER)
    for scale in (0.1, 1.0, 10.0, 100.0):
        for sign in (-1.0, 1.0):
            belief = Gaussian.certain(scale * np.array([1.0, sign]))
            expected = controller.control(belief, Reference(np.zeros(2)))
            got = compiled.control(belief, Reference(np.zeros(2)))
            assert got.status is expected.status
            assert np.abs(got.input - expected.input).max() < 1e-9
            assert expected.status is Status.SOFT_BOUND_MISSED


def test_flies_in_closed_loop():
    controller = gpmpc(Problem(WEIGHTS, TORQUES))
    compiled = CompiledController(controller, compiler=COMPILER)
    loop = ModelLoop(GP, Linearization(), time_step=0.2)
    flights = [
        closed_loop(loop, flown, [0.5, 0.0], Gaussian.certain(np.zeros(2)), 20)
        for flown in (controller, compiled)
    ]
    assert np.abs(flights[0].inputs - flights[1].inputs).max() < 1e-9


def test_a_failed_step_knows_no_violation():
    compiled = CompiledController(tube("exact"), compiler=COMPILER)
    origin = Reference(np.zeros(2))
    decision = compiled.control(Gaussian.certain([0.1, 0.0]), origin)
    assert decision.violation >= 0.0
    lost = Gaussian.certain(np.full(2, np.nan))
    failed = compiled.control(lost, origin, decision)
    assert failed.status is Status.INVALID_MEASUREMENT
    assert np.isnan(failed.violation)


def test_of_another_controllers_decision_the_input_counts():
    controller = gpmpc(Problem(WEIGHTS, TORQUES))
    compiled = CompiledController(controller, compiler=COMPILER)
    origin = Reference(np.zeros(2))
    belief = Gaussian.certain([0.3, -0.2])
    longer = gpmpc(Problem(WEIGHTS, TORQUES), horizon=9).control(belief, origin)
    own = compiled.control(belief, origin)
    of_other_bytes = replace(own, memory=b"")  # type: ignore[call-arg]
    for last in (longer, of_other_bytes):
        expected = controller.control(belief, origin, last)
        got = compiled.control(belief, origin, last)
        assert np.abs(got.inputs - expected.inputs).max() < 1e-9
        assert got.status is expected.status
    with pytest.raises(ShapeError, match="input of the last decision"):
        compiled.control(belief, origin, replace(own, input=np.zeros(2)))


def test_a_controller_serves_many_threads():
    """What is known of a flight with it is what is known of one by Python."""
    source = gpmpc(Problem(WEIGHTS, TORQUES))
    compiled = CompiledController(source, compiler=COMPILER)
    origin = Reference(np.zeros(2))
    assert outlook(compiled, GP, origin) == outlook(source, GP, origin)
    assert outlook(compiled, GP, origin).spectral_radius > 0
    # its decisions hold means alone, beside which the model's noise counts
    of_means = gpmpc(Problem(WEIGHTS, TORQUES), covariance="none")
    noise = _learned_noise(of_means)
    assert (_learned_noise(compiled) == noise).all()
    assert (noise > 0).all()
    beliefs = [Gaussian.certain([0.005 * k, -0.2]) for k in range(200)]

    def decide(belief):
        return compiled.control(belief, origin).inputs

    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(decide, beliefs))
    assert (np.array(together) == [decide(belief) for belief in beliefs]).all()


def test_states_of_another_size_are_refused():
    compiled = CompiledLoop(gpmpc(Problem(WEIGHTS, TORQUES)), compiler=COMPILER)
    short = Gaussian.certain(np.zeros(1))
    for measured, origin in (
        ([0.0], np.zeros(2)),
        (short, np.zeros(2)),
        (np.zeros(2), np.zeros(1)),
    ):
        with pytest.raises(ShapeError, match="must have the shape"):
            compiled.input(measured, origin)


def test_parameters_come_with_every_call():
    controller = obstacle()
    for loop in (ControlLoop(controller), CompiledLoop(controller, compiler=COMPILER)):
        with pytest.raises(SettingError, match="must come with every call"):
            loop.input(np.zeros(2), np.zeros(2))


def test_parameters_that_are_lost_cost_one_step():
    controller = obstacle()
    compiled = CompiledLoop(controller, compiler=COMPILER)
    python = ControlLoop(controller)
    known = np.asarray(PLACES, dtype=float)
    for parameters in (known, np.full_like(known, np.nan), known):
        expected = python.input([0.3, 0.0], np.zeros(2), parameters)
        got = compiled.input([0.3, 0.0], np.zeros(2), parameters)
        assert got == pytest.approx(expected)
        assert python.last is not None
        assert compiled.status is python.last.status
        is_lost = compiled.status is Status.INVALID_MEASUREMENT
        assert is_lost == np.isnan(parameters).any()


def test_references_are_refused_as_python_refuses_them():
    controller = gpmpc(
        Problem(Tracking([1.0, 0.1], [0.05], penalized="deviations"), TORQUES)
    )
    compiled = CompiledLoop(controller, compiler=COMPILER)
    lost = np.array([np.nan, 0.0])
    for loop in (ControlLoop(controller), compiled):
        with pytest.raises(ShapeError, match="needs reference inputs"):
            loop.input(np.zeros(2), np.zeros(2))
        with pytest.raises(DataError, match="must be finite"):
            loop.input(np.zeros(2), Reference(lost, np.zeros(1)))


def test_every_operation_of_casadi_is_written():
    """One state is driven by the sum of operations, which the plan linearises."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    a = x[0]
    b = 2.0 + casadi.sin(x[1])  # positive
    c = 0.4 * casadi.sin(a) + 0.1 * u  # between -1 and 1
    terms = [
        *(casadi.asin(c), casadi.acos(c), casadi.atanh(c), casadi.atan(a)),
        *(casadi.sinh(a), casadi.cosh(a), casadi.asinh(a), casadi.acosh(b)),
        *(casadi.tanh(u), casadi.tan(c), casadi.exp(c), casadi.expm1(c)),
        *(casadi.log(b), casadi.log1p(b), casadi.erf(a), casadi.sqrt(b)),
        *(casadi.floor(a), casadi.ceil(a), casadi.sign(a), casadi.fabs(a)),
        *(casadi.hypot(a, b), casadi.fmod(a, b), casadi.copysign(b, a), b**a),
        *(casadi.fmin(a, c), casadi.fmax(a, c), casadi.atan2(a, b), a / b),
        *(casadi.if_else(a < c, a, c), casadi.if_else(a <= c, c * u, b)),
        casadi.if_else(casadi.logic_or(a == b, casadi.logic_not(a > c)), u, a),
        casadi.if_else(casadi.logic_and(a != b, a > c), u, a),
        casadi.if_else(a > 10.0, casadi.log(a - 10.0), u),  # NaN, not chosen
    ]
    terms += [  # what is no number limits nothing
        *(casadi.fmax(0.2, casadi.log1p(a - 1.5)), casadi.fmin(casadi.atanh(b), c)),
        casadi.fmin(0.2, casadi.atanh(c - 1.0)),
    ]
    weighed = sum((0.01 + 0.001 * i) * term for i, term in enumerate(terms))
    after = casadi.vertcat(0.8 * a + 0.1 * weighed + u, 0.5 * x[1] + weighed)
    model = KnownModel(CasadiFunction(casadi.Function("f", [x, u], [after])), 2, 1)
    controller = gpmpc(Problem(WEIGHTS, TORQUES), model, covariance="none")
    python = ControlLoop(controller)
    compiled = CompiledLoop(controller, compiler=COMPILER)
    for measured, reference in questions(controller, 60):
        expected = python.input(measured, reference)
        assert np.abs(compiled.input(measured, reference) - expected).max() < 1e-9


def test_a_plan_that_the_model_contradicts_is_no_guess():
    """The last plan is wild; what its inputs lead to is linearised in its place."""
    controller = gpmpc(Problem(WEIGHTS, TORQUES), disturbance_gain=0.3)
    compiled = CompiledController(controller, compiler=COMPILER)
    belief = Gaussian.certain([0.3, -0.2])
    origin = Reference(np.zeros(2))
    last = controller.control(belief, origin)
    means = last.means.copy()
    means[3:, 0] += 1e3
    wild = replace(last, means=means)
    inputs = np.concatenate([last.inputs[1:], last.inputs[-1:]])
    motion = controller.control(belief, origin, wild, plan=inputs)
    for asked in (controller, compiled):
        got = asked.control(belief, origin, wild)
        assert np.abs(got.inputs - motion.inputs).max() < 1e-9
        assert np.abs(got.means - motion.means).max() < 1e-9


def test_an_estimate_stays_where_the_model_has_no_numbers():
    """The last plan began, as was predicted, at a level of less than nothing."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    level = x[0] + 0.2 * (u - casadi.sqrt(x[0]))
    tank = casadi.Function("f", [x, u], [casadi.vertcat(level, 0.9 * x[1])])
    model = KnownModel(CasadiFunction(tank), 2, 1)
    settings = {"covariance": "none", "disturbance_gain": 0.3}
    controller = gpmpc(Problem(WEIGHTS, TORQUES), model, **settings)
    compiled = CompiledController(controller, compiler=COMPILER)
    belief = Gaussian.certain([1.0, 0.0])
    goal = Reference(np.array([1.2, 0.0]))
    last = controller.control(belief, goal)
    means = last.means.copy()
    means[0, 0] = -0.01
    last = replace(last, means=means, disturbance=np.array([0.05, 0.0]))
    expected = controller.control(belief, goal, last)
    got = compiled.control(belief, goal, last)
    assert expected.disturbance is not None
    assert expected.disturbance[0] == 0.05
    assert got.status is expected.status is Status.SOLVED
    assert np.abs(got.inputs - expected.inputs).max() < 1e-9
    # Lost, the state says nothing: the estimate stays, also where a failed decision
    # is handed on.
    lost = Gaussian.certain([np.nan, 0.0])
    failed = [asked.control(lost, goal, last) for asked in (controller, compiled)]
    for asked, previous in zip((controller, compiled), failed, strict=True):
        assert previous.disturbance[0] == 0.05
        got = asked.control(belief, goal, previous)
        assert got.disturbance[0] == 0.05
        assert np.abs(got.inputs - expected.inputs).max() > 0.01
    # A first guess, on a line to below empty, is left for what its inputs lead to.
    empty = Reference(np.array([-5.0, 0.0]))
    expected = controller.control(belief, empty)
    got = compiled.control(belief, empty)
    assert got.status is expected.status is Status.SOLVED
    assert np.abs(got.inputs - expected.inputs).max() < 1e-9


def test_a_failed_step_hands_its_estimate_on():
    """Also one whose state was measured, and whose program has no solution."""
    keeps_away = Box([2.0, -np.inf], penalty=None)
    problem = Problem(WEIGHTS, TORQUES, constraints=[keeps_away])
    controller = gpmpc(problem, disturbance_gain=0.3)
    compiled = CompiledController(controller, compiler=COMPILER)
    origin = Reference(np.zeros(2))
    free = gpmpc(Problem(WEIGHTS, TORQUES), disturbance_gain=0.3)
    last = free.control(Gaussian.certain([0.3, -0.2]), origin)
    estimates = []
    for asked in (controller, compiled):
        failed = asked.control(Gaussian.certain([0.4, 0.1]), origin, last)
        assert failed.status is Status.INFEASIBLE
        again = asked.control(Gaussian.certain([0.4, 0.1]), origin, failed)
        estimates.append([failed.disturbance, again.disturbance])
    assert np.abs(estimates[0]).min() > 1e-3
    assert np.abs(np.diff(estimates, axis=0)).max() < 1e-9


def leaking_tank(level):
    """A model without a number below empty, and a bound by the logarithm of a level."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    after = casadi.vertcat(x[0] + 0.2 * (u - casadi.sqrt(x[0])), 0.9 * x[1])
    model = KnownModel(CasadiFunction(casadi.Function("f", [x, u], [after])), 2, 1)
    full = Inequality(casadi.Function("h", [x], [casadi.log(level(x)) - 2.0]))
    problem = Problem(WEIGHTS, TORQUES, constraints=[full])
    return gpmpc(problem, model, covariance="none")


def exploding():
    """Plans far from the origin, where roll-outs overflow, under a curved bound."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    after = 0.5 * x[0] + u + x[0] * (casadi.exp(x[0] ** 2) - 1.0)
    f = casadi.Function("f", [x, u], [casadi.vertcat(after, 0.5 * x[1])])
    near = casadi.Function("h", [x], [x[0] ** 2 - 100.0])
    problem = Problem(
        Tracking([1.0, 0.1], [0.05], penalized="inputs"), constraints=[Inequality(near)]
    )
    model = KnownModel(CasadiFunction(f), 2, 1)
    return gpmpc(problem, model, covariance="none", rolled_out=True)


def beside_a_standing_obstacle():
    """Farther away the faster it is, by the root of squares that are zero."""
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    p = casadi.SX.sym("p", 2)
    h = casadi.Function("h", [x, u, p], [x[0] - 1.2 + casadi.norm_2(p)])
    still = Affine(torch.eye(2), torch.tensor([[0.2], [0.0]]), torch.zeros(2))
    problem = Problem(WEIGHTS, TORQUES, constraints=[Inequality(h)])
    return gpmpc(problem, KnownModel(still, 2, 1), covariance="none")


# controller, first state, goal, parameters, and how a decision ends
BEYOND_NUMBERS = {
    "a bound at the guess": (
        leaking_tank(lambda x: x[0]),
        1.0,
        -5.0,
        None,
        Status.FUNCTION_NOT_FINITE,
    ),
    "no bound at the guess": (
        leaking_tank(lambda x: x[1] + 1.0),
        1.0,
        -5.0,
        None,
        Status.SOLVED,
    ),
    "a roll-out": (exploding(), 0.0, 40.0, None, Status.SOLVED),
    "a slope by parameters": (
        beside_a_standing_obstacle(),
        1.0,
        2.0,
        [0.0, 0.0],
        Status.SOLVED,
    ),
}


@pytest.mark.parametrize("name", BEYOND_NUMBERS)
def test_what_has_no_number_ends_as_in_python(name):
    controller, state, goal, parameters, status = BEYOND_NUMBERS[name]
    compiled = CompiledController(controller, compiler=COMPILER)
    belief = Gaussian.certain([state, 0.0])
    reference = Reference(np.array([goal, 0.0]))
    expected = controller.control(belief, reference, parameters=parameters)
    got = compiled.control(belief, reference, parameters=parameters)
    assert got.status is expected.status is status
    assert np.abs(got.inputs - expected.inputs).max() < 1e-9
