"""Whether a loop settles, known before it runs: against the loop itself."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.horizons import TANK_GOAL, VOLTAGES, quadruple_tank, true_model
from gpmpc.exceptions import DataError, SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.models import (
    Affine,
    DelayedModel,
    DisturbedModel,
    KnownModel,
    NoisyModel,
    linearize,
)
from gpmpc.mpc import (
    GPMPC,
    Box,
    LeastSquares,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc._linear_loop import LinearLoop
from gpmpc.mpc._rest_points import rest_points
from gpmpc.propagation import Linearization
from gpmpc.systems import double_integrator, step

TANK = true_model(quadruple_tank())
LEVELS = [12.4, 13.2, 0.0, 0.0]  # of the upper tanks nothing is asked
LATE = 3  # steps after which inputs act


def linear(A, B):
    A, B = (torch.tensor(part, dtype=torch.float64) for part in (A, B))
    constant = torch.zeros(len(A), dtype=torch.float64)
    return KnownModel(Affine(A, B, constant), *B.shape)


INTEGRATOR = linear([[1.0]], [[0.1]])


def loop_of(model, cost, horizon, initial_input, outputs=(), bounds=None, **prediction):
    settings = PredictionSettings(**{"covariance": "none"} | prediction)
    problem = Problem(cost, outputs=outputs, inputs=bounds)
    return GPMPC(model, Linearization(), problem, horizon, initial_input, settings)


def tank_loop(horizon, model=TANK, further=0, terminal=None, **changes):
    """The tanks with what they weigh, and as many further states."""
    none = [0.0] * further
    outputs = changes.pop("outputs", ())
    penalized = changes.pop("penalized", "increments")
    cost = Tracking(
        [1.0, 1.0, 0.0, 0.0, *none],
        [0.1, 0.1],
        terminal=None if terminal is None else [*terminal, *none],
        penalized=penalized,
    )
    return loop_of(model, cost, horizon, VOLTAGES, outputs, **changes)


def late_integrator(disturbance_gain, cost=1e-4, bounds=None):
    """An integrator whose inputs act late, as it is planned with."""
    weights = Tracking([1.0] + [0.0] * LATE, [cost])
    delayed = DelayedModel(INTEGRATOR, LATE)
    settings = {"disturbance_gain": disturbance_gain, "bounds": bounds}
    return loop_of(delayed, weights, 20, [0.0], **settings)


def products(states, inputs):
    """Outputs that bend."""
    return torch.stack([states[:, 0] * states[:, 1] / 10, inputs[:, 0] ** 2], dim=1)


LOOPS = {
    "increments": {},
    "increments, estimate": {"disturbance_gain": 0.4},
    "inputs": {"penalized": "inputs", "terminal": [5.0, 5.0, 0.0, 0.0]},
    "deviations": {"penalized": "deviations", "disturbance_gain": 0.4},
    "velocity": {"form": "velocity"},
    "outputs": {"outputs": [LeastSquares(products, [0.3, 0.1], [16.0, 9.0])]},
    "delayed": {
        "model": DelayedModel(TANK, 1.5),
        "further": 4,
        "disturbance_gain": 0.4,
    },
}


def steps_from(controller, reference, state, plan, count):
    """The states of a flight of the model itself, and its last decision."""
    states = []
    for _ in range(count):
        plan = controller.control(Gaussian.certain(state), reference, plan)
        model = controller.prediction.model
        next_states = linearize(model, state[None], plan.input[None], covariance=False)
        state = next_states.mean[0]
        states.append(state)
    return np.array(states), plan


@pytest.mark.parametrize("changes", LOOPS.values(), ids=LOOPS)
def test_the_linear_loop_is_the_controller_near_its_rest(changes):
    controller = tank_loop(40, **changes)
    prediction = controller.prediction
    further = prediction.problem.state_dim - 4
    reference = Reference(np.array(LEVELS + [0.0] * further), np.array(VOLTAGES))
    (point,) = rest_points(prediction, reference, None)
    loop = LinearLoop(prediction, point, None, None).matrix(40)
    settled, plan = steps_from(controller, reference, point.state, None, 300)
    rest = settled[-1]
    apart = 1e-5 * np.random.default_rng(0).normal(size=len(rest))
    flights = [
        steps_from(controller, reference, state, plan, 5)[0]
        for state in (rest, rest + apart)
    ]
    deviation = np.zeros(len(loop))
    deviation[: len(rest)] = apart
    # the inputs on their way stand there twice: as the plant's states, and as told
    deviation[len(rest) : len(rest) + further] = apart[4:]
    expected = []
    for _ in range(5):
        deviation = loop @ deviation
        expected.append(deviation[: len(rest)])
    error = np.abs(flights[1] - flights[0] - np.array(expected)).max()
    assert error < 5e-3 * np.abs(flights[1] - flights[0]).max()


def test_too_short_a_horizon_for_an_inverse_response_is_named():
    system = quadruple_tank()
    stability = tank_loop(10).stability(TANK_GOAL)
    assert not stability.stable
    assert stability.spectral_radius == pytest.approx(1.135, abs=5e-3)
    shortest = stability.shortest_horizon
    (line,) = stability.warnings
    assert line.startswith("horizon 10: ")
    assert line.endswith(f"it settles with {shortest} steps or more")
    ends = {}
    for horizon in (round(0.9 * shortest), round(1.1 * shortest)):
        controller = tank_loop(horizon, bounds=Box([0.0, 0.0], [10.0, 10.0]))
        judged = controller.stability(TANK_GOAL)
        assert judged.stable == (horizon >= shortest)
        assert bool(judged.warnings) == (horizon < shortest)
        state = np.array(TANK_GOAL)
        plan = None
        for _ in range(300):
            reference = Reference(np.array(TANK_GOAL))
            plan = controller.control(Gaussian.certain(state), reference, plan)
            assert plan.status.solved
            state = step(system, state, plan.input)
        ends[horizon] = np.abs(state - TANK_GOAL)[:2].max()
    lost, held = ends.values()
    assert lost > 0.05
    assert held < 1e-3
    assert tank_loop(60).stability(LEVELS).shortest_horizon == shortest


def test_too_quick_an_estimate_for_a_delay_is_named():
    def swing(disturbance_gain):
        bounds = Box([-20.0], [20.0])
        controller = late_integrator(disturbance_gain, bounds=bounds)
        stability = controller.stability(np.zeros(1 + LATE))
        on_their_way = deque([np.zeros(1)] * LATE, LATE)
        state = np.zeros(1)
        plan = None
        positions = []
        goal = Reference(np.array([1.0] + [0.0] * LATE))
        for _ in range(150):
            belief = np.concatenate([state, *on_their_way])
            plan = controller.control(Gaussian.certain(belief), goal, plan)
            state = state + 0.7 * 0.1 * on_their_way[0]  # it does less than believed
            on_their_way.append(plan.input)
            positions.append(state[0])
        return stability, np.ptp(positions[-50:])

    quick, circling = swing(0.7)
    assert circling > 1.0
    assert quick.stable  # with the model's own gain
    assert 0.7 < quick.gain_range[0] < 0.9
    (line,) = quick.warnings
    assert line.startswith("disturbance_gain 0.7 is too large")
    assert line.endswith(f"{quick.safe_disturbance_gain:.2g} is safe")
    for disturbance_gain in (0.0, 0.1, quick.safe_disturbance_gain):
        stability, circling = swing(disturbance_gain)
        assert not stability.warnings
        assert circling < 0.05


def test_form_velocity_is_judged_as_the_quickest_estimate():
    model = DelayedModel(INTEGRATOR, LATE)
    weights = Tracking([1.0] + [0.0] * LATE, [1e-4])
    goal = np.zeros(1 + LATE)
    held, estimated = (
        loop_of(model, weights, 20, [0.0], **settings).stability(goal)
        for settings in ({"form": "velocity"}, {"disturbance_gain": 1.0})
    )
    assert held.disturbance_gain == 1.0
    assert held.spectral_radius == pytest.approx(estimated.spectral_radius, abs=1e-6)
    assert held.safe_disturbance_gain == estimated.safe_disturbance_gain < 1.0
    assert held.warnings == estimated.warnings != []


def test_plants_settle_exactly_within_the_range_of_gains():
    controller = late_integrator(0.7)
    low, high = controller.stability(np.zeros(1 + LATE)).gain_range
    for gain, settles in (
        (low + 0.01, True),
        (low - 0.01, False),
        (high - 0.01, True),
        (high + 0.01, False),
    ):
        plant = DelayedModel(linear([[1.0]], [[0.1 * gain]]), LATE)
        stability = controller.stability(np.zeros(1 + LATE), plant=plant)
        assert stability.stable == settles


@pytest.mark.parametrize("delay", [1.0, 1.6, 3.0])
def test_a_delay_that_is_bridged_and_one_that_is_ignored(delay):
    late = DelayedModel(INTEGRATOR, delay)
    remaining = late.remaining
    further = remaining.state_dim - 1
    cost = Tracking([1.0] + [0.0] * further, [1e-3])
    controller = loop_of(remaining, cost, 20, [0.0])
    goal = np.zeros(1 + further)
    bridged = controller.stability(goal, ahead=late)
    assert bridged.spectral_radius == pytest.approx(
        controller.stability(goal).spectral_radius, abs=1e-6
    )
    ignorant = loop_of(INTEGRATOR, Tracking([1.0], [1e-3]), 20, [0.0])
    stability = ignorant.stability([0.0], plant=late)
    assert stability.spectral_radius > bridged.spectral_radius + 0.1
    assert stability.stable == (delay < 1.5)


def test_what_nothing_weighs_may_stand_still():
    cart = linear([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]])
    for penalized in ("inputs", "increments"):
        cost = Tracking([0.0, 1.0], [0.1], penalized=penalized)
        stability = loop_of(cart, cost, 10, [0.0]).stability([0.0, 0.0])
        assert stability.spectral_radius == pytest.approx(1.0, abs=1e-6)
        assert stability.stable
        assert not stability.warnings
    effect = torch.tensor([[0.0], [0.1]], dtype=torch.float64)
    pushed = DisturbedModel(cart, effect, [0.01])
    cost = Tracking([1.0, 0.1, 0.0], [0.1])
    assert loop_of(pushed, cost, 20, [0.0]).stability([0.0] * 3).stable


def test_of_learned_integrators_a_little_growth_does_not_count():
    system = double_integrator()
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (60, 2))
    inputs = rng.uniform(-1, 1, (60, 1))
    after = np.array([step(system, x, u) for x, u in zip(states, inputs, strict=True)])
    after += rng.normal(0, 1e-3, after.shape)
    gp = Trainer(restarts=0)(Transitions(states, inputs, after), seed=0).posterior
    stability = loop_of(gp, Tracking([0.0, 1.0], [0.1]), 10, [0.0]).stability(
        [0.0, 0.0]
    )
    assert stability.judged
    assert abs(stability.spectral_radius - 1.0) < 1e-3
    assert not stability.warnings
    noisy = NoisyModel(gp, replace(gp, predicts="value"), [0, 1])
    judged = loop_of(noisy, Tracking([0.0, 1.0], [0.1]), 10, [0.0]).stability([0.0] * 2)
    assert judged.spectral_radius == pytest.approx(stability.spectral_radius)
    assert judged.stable == stability.stable


def test_a_mode_that_no_horizon_holds_is_said_to_be_one():
    lost = linear([[1.1, 0.0], [0.0, 0.5]], [[0.0], [1.0]])  # the input reaches nothing
    stability = loop_of(lost, Tracking([1.0, 1.0], [0.1]), 5, [0.0]).stability(
        [0.0, 0.0]
    )
    assert stability.shortest_horizon is None
    assert stability.horizons == 100
    assert stability.warnings[0].endswith(
        "so it does with any up to 100: change the weights"
    )


def test_a_state_that_no_input_reaches_rests_where_it_fades():
    fading = linear([[0.9, 0.1], [0.0, 0.5]], [[1.0], [0.0]])
    cost = Tracking([1.0, 0.1], [0.1])
    bounded = loop_of(fading, cost, 10, [0.0], bounds=Box([-2.0], [2.0]))
    assert bounded.stability([1.0, 0.0]).judged


def test_a_plants_further_states_are_judged_where_they_rest():
    """An actuator that stands at 9.81; its gain grows with it."""

    def next_state(x, u):
        position, actuator = x.unbind(-1)
        actuator = actuator + 0.5 * (9.81 - actuator)
        pushed = position + 0.1 * actuator * u[..., 0]
        return torch.stack([pushed, actuator], dim=-1)

    alone = linear([[1.0]], [[0.981]])
    controller = loop_of(alone, Tracking([1.0], [0.1]), 10, [0.0])
    at_rest = controller.stability([0.0], plant=KnownModel(next_state, 2, 1))
    expected = controller.stability([0.0]).spectral_radius
    assert at_rest.spectral_radius == pytest.approx(max(0.5, expected))


def test_a_reference_at_which_nothing_can_rest_is_not_judged():
    stable = linear([[0.5]], [[1.0]])
    bounded = loop_of(stable, Tracking([1.0], [0.1]), 5, [0.0], bounds=Box([-1], [1]))
    stability = bounded.stability([10.0])  # it would take an input of 5
    assert not stability.judged
    assert not stability.stable
    assert np.isnan(stability.spectral_radius)
    assert not stability.warnings
    assert bounded.stability([1.0]).judged


def test_some_points_of_a_trajectory_are_judged_with_its_inputs():
    cart = linear([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]])
    controller = loop_of(cart, Tracking([1.0, 0.1], [0.1]), 20, [0.0])
    times = 0.1 * np.arange(200)
    moving = np.column_stack([np.sin(times), np.cos(times)])
    stability = controller.stability(Reference(moving))
    assert len(stability.states) == 10
    off = np.linalg.norm(stability.states[:, None] - moving, axis=2).min(axis=1)
    assert off.max() < 1e-2
    at_one_point = controller.stability([0.0, 0.0])
    assert len(at_one_point.states) == 1
    assert stability.spectral_radius == pytest.approx(at_one_point.spectral_radius)
    assert stability.shortest_horizon == at_one_point.shortest_horizon


def test_weights_by_stage_have_one_horizon():
    weights = np.tile(np.eye(4) * [1.0, 1.0, 0.0, 0.0], (10, 1, 1))
    weights[3] *= 2.0
    controller = loop_of(TANK, Tracking(weights, [0.1, 0.1]), 10, VOLTAGES)
    stability = controller.stability(TANK_GOAL)
    assert not stability.stable
    assert stability.shortest_horizon is None
    assert stability.warnings[0].endswith("try a longer one")
    same = replace(controller.problem.cost, Q=np.tile(weights[0], (10, 1, 1)))
    alike = loop_of(TANK, same, 10, VOLTAGES).stability(TANK_GOAL)
    assert alike.shortest_horizon == tank_loop(10).stability(TANK_GOAL).shortest_horizon


def test_a_plant_or_a_delay_of_something_else_is_refused():
    controller = late_integrator(0.3)
    goal = np.zeros(1 + LATE)
    with pytest.raises(SettingError, match=r"plant.* 1 states and 1 inputs"):
        controller.stability(goal, plant=TANK)
    with pytest.raises(SettingError, match=r"ahead.*DelayedModel"):
        controller.stability(goal, ahead=INTEGRATOR)
    with pytest.raises(SettingError, match=r"ahead.*4 states"):
        controller.stability(goal, ahead=DelayedModel(INTEGRATOR, 2))


@pytest.mark.parametrize("creep", [0.0, 0.1])
@pytest.mark.parametrize("micrometre", [1e-6, 1.0])
def test_what_moves_on_is_no_rest_in_any_unit(micrometre, creep):
    """A stage that an input moves by a micrometre a step, and a load that creeps.

    In metres its steps are none beside 1.
    """

    def next_state(x, u):
        position, load = x.unbind(-1)
        position = position + micrometre * u[..., 0]
        return torch.stack([position, load + creep * micrometre], dim=-1)

    model = KnownModel(next_state, 2, 1)
    cost = Tracking([1.0 / micrometre**2, 0.0], [1.0])
    controller = loop_of(model, cost, 10, [0.0], bounds=Box([-1.0], [1.0]))
    assert controller.stability(np.zeros(2)).judged == (creep == 0.0)


@pytest.mark.parametrize("micrometre", [1e-6, 1.0, 1e6])
def test_a_loop_rests_at_its_goal_in_any_unit(micrometre):
    """A stage on a spring that hardens, 0.8 micrometres from where it is slack."""

    def next_state(x, u):
        place, speed = x.unbind(-1)
        spring = 40.0 * place + 2.0 * place**3 / micrometre**2
        force = 2.0 * micrometre * u[..., 0] - spring - 4.0 * speed
        return torch.stack([place + 0.05 * speed, speed + 0.05 * force], dim=-1)

    cost = Tracking([1.0 / micrometre**2, 1e-3 / micrometre**2], [1e-4])
    model = KnownModel(next_state, 2, 1)
    controller = loop_of(model, cost, 25, [0.0], bounds=Box([-30.0], [30.0]))
    known = controller.stability([0.8 * micrometre, 0.0])
    assert known.states[0] / micrometre == pytest.approx([0.8, 0.0], abs=1e-3)
    assert known.inputs[0] == pytest.approx([16.512], abs=1e-2)
    assert known.spectral_radius == pytest.approx(0.6425, abs=1e-3)


@pytest.mark.parametrize("penalized", ["increments", "inputs"])
def test_a_locked_input_is_held_and_the_loop_is_judged(penalized):
    cost = Tracking([1.0], [0.1], penalized=penalized)
    two = Tracking([1.0], [0.1, 0.1], penalized=penalized)
    alone = loop_of(linear([[1.3]], [[1.0]]), cost, 1, [0.0]).stability([0.0])
    locked = Box([-1.0, 0.3], [1.0, 0.3])
    beside = linear([[1.3]], [[1.0, 0.5]])
    held = loop_of(beside, two, 1, [0.0, 0.3], bounds=locked).stability([0.0])
    assert held.inputs[0] == pytest.approx([-0.15, 0.3], abs=1e-2)
    radius = max(alone.spectral_radius, 1.0 if penalized == "increments" else 0.0)
    assert held.spectral_radius == pytest.approx(radius)
    assert held.stable == alone.stable


def test_inputs_rest_within_their_bounds_where_others_can_hold():
    pushed = Affine(
        torch.ones(1, 1, dtype=torch.float64),
        torch.ones(1, 2, dtype=torch.float64),
        torch.tensor([-1.0], dtype=torch.float64),
    )
    weak = Box([-0.1, -2.0], [0.1, 2.0])
    cost = Tracking([1.0], [0.1, 0.1])
    loop = loop_of(KnownModel(pushed, 1, 2), cost, 5, [0.0, 0.0], bounds=weak)
    stability = loop.stability([0.0])
    assert stability.inputs[0] == pytest.approx([0.1, 0.9], abs=1e-2)
    assert stability.stable


def test_beyond_a_constraint_of_the_states_nothing_is_judged():
    cost = Tracking([1.0], [0.1])
    walled = Problem(cost, constraints=[Box(upper=[1.0])])
    settings = PredictionSettings(covariance="none")
    loop = GPMPC(INTEGRATOR, Linearization(), walled, 5, [0.0], settings)
    assert loop.stability([0.5]).judged
    assert not loop.stability([2.0]).judged


def test_a_drift_is_no_rest_wherever_the_origin_is():
    """Nothing holds the current, 2 a step."""

    def drift(x, u):
        return torch.stack([x[:, 0] + 2.0, 0.5 * x[:, 1] + u[:, 0]], dim=1)

    cost = Tracking([1.0, 1.0], [0.1])
    loop = loop_of(KnownModel(drift, 2, 1), cost, 5, [0.0])
    assert not loop.stability([0.0, 0.0]).judged
    assert not loop.stability([5.5e6, 0.0]).judged


def test_points_at_which_a_model_has_no_numbers_are_left_out():
    def implicit(x, u):  # its matrix is singular at 1
        matrix = (x - 1.0)[..., None]
        return torch.linalg.solve(matrix, (x - 1.0) * (0.5 * x + u))

    loop = loop_of(KnownModel(implicit, 1, 1), Tracking([1.0], [0.1]), 5, [0.0])
    assert not loop.stability([1.0]).judged
    path = loop.stability(np.array([[0.0], [1.0], [1.0], [0.2], [0.2]]))
    assert path.states[:, 0].max() < 1.0


@pytest.mark.parametrize(
    ("states", "error", "rule"),
    [
        ([np.nan, 0.0], DataError, "must be finite"),
        ([0.0, 0.0, 0.0], ShapeError, r"must be \(2,\) or \(K, 2\); got \(3,\)"),
    ],
)
def test_a_reference_of_something_else_is_refused(states, error, rule):
    model = linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])
    loop = loop_of(model, Tracking([1.0, 0.1], [0.1]), 5, [0.0])
    with pytest.raises(error, match=rule):
        loop.stability(states)


def test_noise_that_depends_on_the_state_is_noise():
    class Rough(KnownModel):
        @property
        def noise_covariance(self):
            raise UnsupportedModel("it depends on the state")

    known = Rough(lambda x, u: 1.0005 * x, 1, 1)
    problem = Problem(Tracking([0.0], [0.1]))
    settings = PredictionSettings(covariance="none")
    propagator = Linearization(process_noise=False)
    loop = GPMPC(known, propagator, problem, 3, [0.0], settings)
    assert loop.stability([0.0]).stable
