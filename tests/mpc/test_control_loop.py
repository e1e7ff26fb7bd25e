from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError, SolverFailure
from gpmpc.gaussian import Gaussian
from gpmpc.models import DelayedModel, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    FlightJudge,
    Inequality,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
    _control_step,
)
from gpmpc.mpc.baselines import LQR
from gpmpc.propagation import Linearization
from gpmpc.qp import CvxpySolver, PrimalActiveSet
from gpmpc.simulation import closed_loop
from gpmpc.status import Status
from gpmpc.systems import double_integrator
from tests.mpc.small_models import double_integrator as model

BOX = Box([-1.0], [0.8])
RATES = Box([-0.3], [0.2])
PROBLEM = Problem(Tracking([1.0, 0.1], [0.05]), BOX, RATES)
GOAL = np.array([1.0, 0.0])


def controller(problem=PROBLEM, **settings):
    return GPMPC(model(), Linearization(), problem, 10, [0.0], **settings)


def next_state(x, u):
    return np.array([x[0] + 0.5 * x[1] + 0.125 * u[0], x[1] + 0.5 * u[0]])


def test_five_lines_steer_somebody_elses_plant_to_a_set_point():
    loop = ControlLoop(controller())
    x = np.zeros(2)
    loop.warm_up(x, GOAL)
    assert loop.last is None
    for _ in range(60):
        x = next_state(x, loop.input(x, GOAL))
    assert np.allclose(x, GOAL, atol=1e-3)
    assert loop.failures == 0


def test_a_warm_up_loads_the_kernel_of_unstable_plans(monkeypatch):
    loads = []
    kernel = SimpleNamespace(unchecked=lambda *_: loads.append("kernel"))
    monkeypatch.setattr(_control_step, "condense_with_feedback", kernel)
    loop = ControlLoop(controller())
    loop.warm_up(np.zeros(2), GOAL)
    assert loads
    loads.clear()
    loop.input(np.zeros(2), GOAL)
    assert not loads


@pytest.mark.parametrize("on_failure", ["previous_plan", "hold"])
def test_an_input_is_always_finite_and_within_bounds_and_rates(on_failure, rng):
    hard = Problem(PROBLEM.cost, BOX, RATES, [Box(None, [np.inf, 0.1], penalty=None)])
    loop = ControlLoop(controller(hard), on_failure)
    x = np.zeros(2)
    last = np.zeros(1)
    for k in range(60):
        measured = x + 0.3 * rng.normal(size=2) if k % 3 else np.array([np.nan, 0.0])
        u = loop.input(measured, GOAL)
        assert np.isfinite(u).all()
        assert BOX.lower[0] - 1e-9 <= u[0] <= BOX.upper[0] + 1e-9
        assert -0.3 - 1e-9 <= u[0] - last[0] <= 0.2 + 1e-9
        x = next_state(x, u)
        last = u
    assert 20 < loop.failures < 60
    assert loop.last.status is not None


def test_its_inputs_are_those_of_the_simulation():
    plant = double_integrator()
    steering = controller()
    flown = closed_loop(plant, steering, np.tile(GOAL, (25, 1)), np.zeros(2), 12)
    loop = ControlLoop(steering)
    inputs = [
        loop.input(x, Reference(np.tile(GOAL, (11, 1)))) for x in flown.states[:12]
    ]
    assert np.array_equal(inputs, flown.inputs)


@pytest.mark.parametrize(
    "solver",
    [CvxpySolver(), PrimalActiveSet()],
    ids=lambda solver: type(solver).__name__,
)
def test_another_solver_steers_alike_from_step_to_step(solver):
    loops = [ControlLoop(controller()), ControlLoop(controller(solver=solver))]
    x = np.zeros(2)
    for _ in range(8):
        ours, theirs = (loop.input(x, GOAL) for loop in loops)
        assert np.allclose(theirs, ours, atol=1e-6)
        x = next_state(x, ours)
    assert [loop.failures for loop in loops] == [0, 0]


def test_a_loop_that_may_not_go_on_says_so():
    with pytest.raises(SettingError, match="on_failure"):
        ControlLoop(controller(), "hope")
    with pytest.raises(SolverFailure):
        ControlLoop(controller(), "raise").input([np.nan, 0.0], GOAL)
    assert ControlLoop(controller()).input([np.nan, 0.0], GOAL) == pytest.approx([0.0])
    assert Status.INVALID_MEASUREMENT.advice


def test_a_late_decision_goes_on_along_the_plan_within_rates():
    model = KnownModel(lambda x, u: x + u, state_dim=1, input_dim=1)
    problem = Problem(
        Tracking([1.0], [1e-3], penalized="inputs"),
        inputs=Box([-1.0], [1.0]),
        input_rates=Box([-0.1], [0.1]),
    )
    loop = ControlLoop(GPMPC(model, Linearization(), problem, 6, [0.0]))
    loop.input(np.zeros(1), np.array([5.0]))
    plan = loop.last.plan
    assert plan.inputs[:3, 0] == pytest.approx([0.1, 0.2, 0.3])
    assert loop.input_between(plan.means[2], 2.0) == pytest.approx([0.3])
    behind = loop.input_between(plan.means[2] - 1.0, 2.0)
    assert behind == pytest.approx([0.3])  # by its rate, from the planned one before


def test_a_controller_that_takes_no_plan_says_so():
    loop = ControlLoop(LQR(model(), PROBLEM, 10, [0.0]))
    for key in ("plan", "parameters"):
        with pytest.raises(SettingError, match=f"{key}: is nothing that LQR.control"):
            loop.input(np.zeros(2), GOAL, **{key: np.zeros((10, 1))})


@pytest.mark.parametrize("form", ["trajectory", "velocity"])
@pytest.mark.parametrize("mark", [np.inf, 3.4e38, -1.7e308])
def test_a_sensors_mark_of_nothing_costs_one_step(form, mark):
    settings = PredictionSettings(form=form, covariance="none")
    loop = ControlLoop(controller(prediction=settings))
    x = np.zeros(2)
    for k in range(12):
        u = loop.input([mark, 0.0] if k == 6 else x, GOAL)
        x = next_state(x, u)
    assert loop.failures == 1
    assert loop.judgement.level == "healthy"


@pytest.mark.parametrize("on_failure", ["previous_plan", "hold"])
def test_what_is_held_stays_held_between_decisions(on_failure):
    loop = ControlLoop(controller(), on_failure)
    x = np.zeros(2)
    for _ in range(3):
        x = next_state(x, loop.input(x, GOAL))
    held = loop.input([np.nan, 0.0], GOAL)
    assert loop.last.failed
    plan = loop.last.plan
    behind = plan.means[1] - 0.2
    between = np.ravel([loop.input_between(behind, k) for k in (0.5, 1.0, 2.5)])
    if on_failure == "hold":
        assert between == pytest.approx(held[0])
    else:
        assert np.ptp(between) > 0.01
    loop.input(x, GOAL)
    planned = loop.last.plan.means[0]
    assert loop.input_between(planned, 0.0) == pytest.approx(loop.last.input)
    assert not np.allclose(loop.input_between(planned - 0.2, 0.0), loop.last.input)


def test_a_policys_plan_has_no_known_cost_or_violation():
    loop = ControlLoop(controller())
    loop.input(np.zeros(2), GOAL)
    solved = loop.last.plan
    assert len(solved.stage_costs) == 10
    assert np.isfinite(solved.violation)
    loop.input([np.nan, 0.0], GOAL)
    assert len(loop.last.plan.stage_costs) == 0
    assert np.isnan(loop.last.plan.violation)


@pytest.mark.parametrize("gains", [np.nan, None])
def test_without_gains_the_plan_is_flown_between_decisions(gains):
    class WithoutGains(GPMPC):
        def gains(self, decision, parameters=None):
            if gains is None:
                raise np.linalg.LinAlgError("singular")
            return np.full((10, 1, 2), gains)

    loop = ControlLoop(WithoutGains(model(), Linearization(), PROBLEM, 10, [0.0]))
    loop.input(np.zeros(2), GOAL)
    between = loop.input_between(np.array([0.1, 0.0]), 0.5)
    assert between == pytest.approx(loop.last.plan.inputs[0])


def test_a_reference_may_be_a_tensor_of_a_graph():
    loops = [ControlLoop(controller()), ControlLoop(controller())]
    goal = torch.tensor(GOAL, requires_grad=True)
    along = torch.tensor(np.tile(GOAL, (11, 1)), requires_grad=True)
    for of_graph, plain in ((goal, GOAL), (along, np.tile(GOAL, (11, 1)))):
        ours = loops[0].input(np.zeros(2), Reference(of_graph))
        assert ours == pytest.approx(loops[1].input(np.zeros(2), plain))
        assert loops[0].judgement == loops[1].judgement


def test_an_error_of_the_numbers_of_the_estimate_costs_no_input():
    class Fails:
        """Fails at states that were flown through."""

        dtype = torch.float64
        device = torch.device("cpu")
        state_dim = output_dim = 2
        input_dim = 1
        noise_covariance = torch.zeros(2, 2)

        def __init__(self):
            self.inner = model()
            self.is_broken = False

        def predict(self, state, input=None):
            if self.is_broken and len(state) == 1:
                raise torch.linalg.LinAlgError("singular")
            return self.inner.predict(state, input)

    fails = Fails()
    settings = PredictionSettings(disturbance_gain=0.5)
    steering = GPMPC(fails, Linearization(), PROBLEM, 10, [0.0], settings)
    loop = ControlLoop(steering)
    x = np.zeros(2)
    for _ in range(3):
        x = next_state(x, loop.input(x, GOAL)) + np.array([0.0, 0.05])
    estimate = loop.last.decision.disturbance
    assert np.abs(estimate).max() > 0.01
    fails.is_broken = True
    loop.input(x, GOAL)
    assert loop.failures == 0
    assert loop.last.decision.disturbance == pytest.approx(estimate)
    loop.input(x, GOAL, plan=np.zeros((10, 1)))
    assert loop.failures == 0


def test_parameters_that_are_not_finite_cost_one_step():
    """An obstacle that its tracker has lost for a step."""

    def outside(x, p):
        return 0.1 - (x[:, 0] - p[:, 0]) ** 2

    problem = Problem(PROBLEM.cost, BOX, RATES, [Inequality(outside, penalty=1.0)])
    loop = ControlLoop(controller(problem))
    loop.input(np.zeros(2), GOAL, parameters=[3.0])
    planned = loop.last.plan.inputs[1]
    applied = loop.input(np.zeros(2), GOAL, parameters=[np.nan])
    assert loop.last.status is Status.INVALID_MEASUREMENT
    assert applied == pytest.approx(planned)
    loop.input(np.zeros(2), GOAL, parameters=[3.0])
    assert loop.failures == 1


class Filtered:
    """Is told the first state, guesses the second, and shows the problem of both."""

    def __init__(self, inner):
        self.inner = inner
        self.problem = inner.problem
        self.horizon = inner.horizon
        self.initial_input = inner.initial_input

        self.last = None

    def control(self, belief, reference, previous=None):
        states = np.pad(reference.states, ((0, 0), (0, 1)))
        guess = 0.0 if self.last is None else self.last.means[1, 1]
        both = Gaussian.certain(np.array([float(belief.mean[0]), guess]))
        self.last = self.inner.control(both, Reference(states), self.last)
        means = self.last.means[:, :1]
        return replace(self.last, means=means, covariances=np.zeros((11, 1, 1)))


def test_a_controller_that_estimates_more_states_is_judged():
    loop = ControlLoop(Filtered(controller()))
    x = np.zeros(2)
    for _ in range(30):
        x = next_state(x, loop.input(x[:1], GOAL[:1]))
    assert loop.failures == 0
    assert loop.judgement.level == "healthy"
    for _ in range(30):  # nothing answers
        loop.input(x[:1], 5.0 * GOAL[:1])
    assert loop.judgement.level == "suspicious"


def test_a_controller_around_others_has_the_innermost_model():
    class Around:
        horizon = 6
        initial_input = np.zeros(1)

        def __init__(self, inner):
            self.controller = inner

        def control(self, *arguments):
            return self.controller.control(*arguments)

    problem = Problem(Tracking([1.0, 0.1], [0.1]))
    delayed = DelayedModel(model(), 1)
    inner = GPMPC(delayed, Linearization(), problem, 6, [0.0])
    loops = [ControlLoop(inner), ControlLoop(Around(Around(inner)))]
    x = np.zeros(2)
    for _ in range(4):  # of a model whose state holds more than what is measured
        applied, same = (loop.input(x, GOAL) for loop in loops)
        assert applied.tolist() == same.tolist()
        x = next_state(x, applied)
    assert loops[1].failures == 0
    inner.model = np.eye(2)  # which is neither true nor false
    FlightJudge.of(Around(inner), state_dim=2, input_dim=1)
