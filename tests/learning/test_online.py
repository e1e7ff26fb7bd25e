"""Online learning makes no flight worse, finds changes, and repeats to the bit."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.learning import (
    ChangedModel,
    LearningController,
    LearningState,
    OnlineLearning,
    learn_from_step,
)
from gpmpc.learning._continuations import continuations, forecast
from gpmpc.learning._innovation import LearningStep
from gpmpc.learning._step import _noise_variance
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.propagation import Linearization
from gpmpc.testing import check_model

STEP = 0.1
NOISE = np.array([1e-3, 1e-2])
PROBLEM = Problem(Tracking([10.0, 1.0], [0.01]), Box([-5.0], [5.0]))


def cart(x, u, gain=1.0, wind=0.0):
    """Position [m] and velocity [m/s] a step later."""
    rate = x[1] + STEP * (2.0 * gain * np.tanh(u[0] / 2.0) - 0.3 * x[1] + wind)
    return np.array([x[0] + STEP * rate, rate])


def training_data():
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, (60, 2))
    u = rng.uniform(-4, 4, (60, 1))
    after = np.array(
        [cart(a, b) + rng.normal(0, NOISE) for a, b in zip(x, u, strict=True)]
    )
    return Transitions(x, u, after)


DATA = training_data()
MODEL = Trainer(predicts="difference", restarts=0)(DATA).posterior


def flown(learning, changed=None, steps=120, seed=0, sensor=0.0):
    """Errors of the position and decisions of a flight along a sine.

    ``changed`` acts from step 40 on.
    """
    controller = GPMPC(MODEL, Linearization(), PROBLEM, 8, [0.0])
    loop = ControlLoop(
        controller if learning is None else LearningController(controller, learning)
    )
    time = STEP * np.arange(steps + 9)
    rng = np.random.default_rng(seed)
    reference = np.stack([np.sin(time), np.cos(time)], axis=1)
    x = reference[0].copy()
    errors = []
    decisions = []
    for k in range(steps):
        u = loop.input(x + sensor * rng.normal(size=2), reference[k : k + 9])
        x = cart(x, u, **(changed or {}) if k >= 40 else {}) + rng.normal(0, NOISE)
        errors.append(x[0] - reference[k + 1, 0])
        decisions.append(loop.last.decision)
    return np.array(errors), decisions


def rms(errors):
    return float(np.sqrt(np.mean(errors**2)))


@pytest.mark.parametrize("sensor", [0.0, 0.03])
def test_an_unchanged_plant_is_flown_as_without_learning(sensor):
    for seed in range(2):
        plain, learning = (
            flown(way, seed=seed, sensor=sensor)[0] for way in (None, OnlineLearning())
        )
        assert rms(learning) <= 1.02 * rms(plain)


@pytest.mark.parametrize(
    "changed", [{"gain": 0.7}, {"wind": 0.6}], ids=["actuator", "wind"]
)
def test_a_plant_that_changes_is_followed_again_within_seconds(changed):
    unchanged, unlearned, learning = (
        rms(np.array([flown(way, acting, seed=seed)[0][60:] for seed in range(3)]))
        for way, acting in ((None, None), (None, changed), (OnlineLearning(), changed))
    )
    assert learning < 1.5 * unchanged < 0.5 * unlearned


def test_learning_is_switched_off_where_the_old_plant_returns():
    steps = []
    learning = OnlineLearning()
    learned = LearningState.begin(ChangedModel(MODEL), np.zeros(2))
    rng = np.random.default_rng(1)
    x = np.zeros(2)
    for k in range(150):
        u = rng.uniform(-3, 3, 1)
        x = cart(x, u, wind=0.6 if 40 <= k < 80 else 0.0) + rng.normal(0, NOISE)
        learned = learn_from_step(learned, u, x)
        steps.append(learned.active)
    assert not any(steps[:40])
    assert all(steps[45:80])
    assert not any(steps[-30:])
    assert 0.8 * learning.points <= len(learned.model) <= learning.points


def test_equal_seeds_give_equal_bits_with_one_controller():
    one, again = (flown(OnlineLearning(), {"wind": 0.6}) for _ in range(2))
    assert np.array_equal(one[0], again[0])
    assert [d.learned.version for d in one[1]] == [d.learned.version for d in again[1]]
    controller = LearningController(GPMPC(MODEL, Linearization(), PROBLEM, 8, [0.0]))
    x = Gaussian.certain(np.array([0.5, 0.0]))
    reference = Reference(np.zeros(2)).over(8)
    first = controller.control(x, reference)
    second = controller.control(x, reference, first)
    controller.control(x, reference, second)
    assert np.array_equal(controller.control(x, reference).inputs, first.inputs)
    assert np.array_equal(controller.control(x, reference, first).inputs, second.inputs)


def test_a_decision_that_was_not_applied_is_no_point():
    _, decisions = flown(OnlineLearning(), {"wind": 0.6}, steps=60)
    before = decisions[-1]
    assert before.learned.active
    controller = LearningController(GPMPC(MODEL, Linearization(), PROBLEM, 8, [0.0]))
    shifted = replace(
        before, means=np.concatenate([before.means[1:], before.means[-1:]])
    )
    state = Gaussian.certain(before.means[2])
    reference = Reference(before.means)
    after = controller.control(state, reference, shifted).learned
    assert after.active
    assert after.model.change is before.learned.model.change
    applied = Gaussian.certain(before.means[1])
    assert (
        controller.control(applied, reference, before).learned.model.change
        is not before.learned.model.change
    )


def changed_residual():
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, (40, 2))
    u = rng.uniform(-2, 2, (40, 1))
    after = np.array([cart(a, b) for a, b in zip(x, u, strict=True)]) + rng.normal(
        0, NOISE, (40, 2)
    )
    B = torch.tensor([[0.1], [1.0]], dtype=torch.float64)
    rows = Transitions(x, u, after)
    model = ResidualModel.train(
        Affine.identity(2, 1), rows, B, angles=[0], trainer=Trainer(restarts=0)
    )
    return ChangedModel(model)


@pytest.mark.parametrize(
    "changed", [ChangedModel(MODEL), changed_residual()], ids=["posterior", "residual"]
)
def test_a_changed_model_is_a_model_with_a_last_innovation(changed):
    rng = np.random.default_rng(2)
    x = rng.uniform(-1, 1, (12, 2))
    u = rng.uniform(-1, 1, (12, 1))
    after = np.array([cart(a, b, gain=0.8) for a, b in zip(x, u, strict=True)])
    seen = [changed.observe(*row) for row in zip(x, u, after, strict=True)]
    noise = np.full(len(seen[0].value), 1e-6)
    model = changed
    for point, error, _ in seen[:-1]:
        model = model.with_point(point, error, noise)
    model = model.later(1.0)
    check_model(model, torch.from_numpy(x), torch.from_numpy(u))
    point, error, _ = model.observe(x[-1], u[-1], after[-1])
    larger = model.with_point(point, error, noise)
    innovation = larger.last_innovation()
    query = torch.from_numpy(point[None])
    d = model.posterior.predict(
        query[:, : -model.gp.input_dim - 1], query[:, -model.gp.input_dim - 1 :]
    )
    np.testing.assert_allclose(innovation.error, error - d.mean.numpy()[0], atol=1e-8)
    np.testing.assert_allclose(
        innovation.variance, d.variance.numpy()[0] + 1e-6, rtol=1e-6
    )
    alone, later = (
        abs((after - one.linearize(x, u).mean) @ changed.B_inverse.T).max()
        for one in (changed, larger)
    )
    assert later < 0.2 * alone


def taught(model, points, rng):
    """The models after each of so many points of a change."""
    models = [model]
    for _ in range(points):
        noise = rng.uniform(0.5, 2.0) * model.gp_noise
        point = np.append(rng.normal(size=3), models[-1].time)
        models.append(
            models[-1].with_point(point, rng.normal(size=2), noise).later(1.0)
        )
    return models


def check_exact(model):
    """The factor, the weights and predictions are those of a GP on the same points."""
    gp = model.posterior
    size = len(model)
    now = model.change.current
    difference = (gp.features[:, None] - gp.features) / gp.lengthscales[:, None, None]
    K = gp.signal_variance[:, None, None] * torch.exp(
        -0.5 * difference.square().sum(-1)
    )
    L = torch.linalg.cholesky(
        K + torch.diag_embed(torch.from_numpy(now.data[6:8, :size].copy()))
    )
    weights = torch.cholesky_solve(gp.targets.mT[..., None], L)[..., 0]
    np.testing.assert_allclose(gp.cholesky, L, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(gp.weights, weights, rtol=1e-7, atol=1e-8)
    x = np.random.default_rng(0).normal(size=(2, 2))
    u = np.zeros((2, 1))
    z = torch.from_numpy(np.column_stack([x, u, np.full(2, model.time)]))
    k = gp.signal_variance[:, None, None] * torch.exp(
        -0.5
        * ((z[:, None] - gp.features) / gp.lengthscales[:, None, None]).square().sum(-1)
    )
    with_change = model.linearize(x, u)
    without = model.model.linearize(x, u)
    np.testing.assert_allclose(
        with_change.mean - without.mean,
        (k @ weights[..., None])[..., 0].mT,
        rtol=1e-8,
        atol=1e-10,
    )
    reduced = torch.linalg.solve_triangular(L, k.mT, upper=False).square().sum(1)
    variance = np.diagonal(
        with_change.covariance - without.covariance, axis1=1, axis2=2
    ).T
    np.testing.assert_allclose(
        variance, gp.signal_variance[:, None] - reduced, rtol=1e-7, atol=1e-12
    )


@pytest.mark.parametrize("rule", ["oldest", "least_informative"])
@pytest.mark.parametrize("most", [1, 2, 9, 50])
def test_a_change_is_the_exact_gp_of_its_latest_points(most, rule):
    models = taught(
        ChangedModel(MODEL, OnlineLearning(points=most, remove=rule)),
        2 * most + 20,
        np.random.default_rng(3),
    )
    for before, after in pairwise(models):
        check_exact(after)
        assert (
            0.8 * most <= len(after) <= most
            if len(before) == most
            else len(after) == len(before) + 1
        )
        times = after.posterior.features[:, -1].numpy()
        assert (np.diff(times) > 0).all()
        assert times[-1] == before.time
        assert rule != "oldest" or times[0] == before.time - len(after) + 1


def test_an_older_change_stays_and_can_go_another_way():
    models = taught(
        ChangedModel(MODEL, OnlineLearning(points=30)), 60, np.random.default_rng(4)
    )
    copies = [
        [
            array.copy()
            for array in (m.posterior.cholesky.numpy(), m.posterior.weights.numpy())
        ]
        for m in models[1:]
    ]
    for k in (20, 29, 30, 47, 59):
        again, other = (
            taught(models[k], 12, np.random.default_rng(seed))[-1] for seed in (5, 6)
        )
        same = taught(models[k], 12, np.random.default_rng(5))[-1]
        check_exact(other)
        assert torch.equal(again.posterior.weights, same.posterior.weights)
    for model, (cholesky, weights) in zip(models[1:], copies, strict=True):
        assert np.array_equal(model.posterior.cholesky, cholesky)
        assert np.array_equal(model.posterior.weights, weights)


def test_a_step_is_expected_with_noise_of_states_without_gps():
    effect = torch.tensor([[0.05], [1.0]])
    gp = ResidualModel.train(
        Affine.identity(2, 1), DATA, effect, trainer=Trainer(restarts=0)
    )
    noise = gp.noise_covariance + torch.diag(torch.tensor([0.3, 0.0]))
    changed = ChangedModel(replace(gp, noise=noise))
    explanation = LearningState.begin(changed, np.zeros(2)).heaviest
    step = LearningStep(
        state=np.zeros(2),
        input=np.zeros(1),
        next_state=np.zeros(2),
        point=np.zeros(4),
        observed_change=np.zeros(1),
        unexplained=np.zeros(2),
        latent_variance=np.zeros(1),
        noise_variance=changed.gp_noise,
        further_noise=changed.further_noise,
        follows_gap=False,
    )
    predicted = forecast(explanation, step.input)
    expected = continuations(explanation, predicted, step)[0].expected
    latent = gp.predict(torch.zeros(2), torch.zeros(1)).covariance
    assert np.allclose(expected.covariance, (latent + noise).numpy())


def kinematic_model():
    """The position follows from its rate, and has noise of its own but no GP."""

    def moved(x, u):
        return torch.stack([x[..., 0] + STEP * x[..., 1], x[..., 1]], dim=-1)

    effect = torch.tensor([[STEP], [1.0]], dtype=torch.float64)
    model = ResidualModel.train(moved, DATA, effect, trainer=Trainer(restarts=0))
    further = torch.diag(torch.tensor([NOISE[0] ** 2, 0.0]))
    return replace(model, noise=model.noise_covariance + further)


def doubts(offsets, noise=NOISE[0], steps=100):
    """Sensors in doubt (steps, 2) where what follows from a rate is measured.

    Args:
        offsets: Of the sensors (2,), by their steps.
        noise: Standard deviation of the position's sensor.
        steps: Of the flight.
    """
    random = np.random.default_rng(0)
    state = np.zeros(2)
    learned = LearningState.begin(ChangedModel(kinematic_model()), state)
    in_doubt = []
    for k in range(steps):
        input = random.uniform(-1, 1, 1)
        state = cart(state, input) + random.normal(0, [0.0, NOISE[1]])
        sensor = random.normal(0, [noise, 0.0]) + offsets.get(k, np.zeros(2))
        learned = learn_from_step(learned, input, state + sensor)
        in_doubt.append(learned.sensors_in_doubt)
    return np.array(in_doubt)


@pytest.mark.parametrize("entry", [0, 1])
def test_a_glitch_is_doubted_whether_its_sensor_has_a_gp_or_not(entry):
    glitches = (1, 12, 20, 22, 26, 30, 32)  # the first before anything is doubted
    glitch = np.zeros(2)
    glitch[entry] = [0.1, 0.5][entry]
    offsets = dict.fromkeys(glitches, glitch)
    in_doubt = doubts(offsets, steps=40)
    expected = np.zeros((40, 2), dtype=bool)
    expected[glitches[1:], entry] = True
    assert np.array_equal(in_doubt, expected)


def test_a_sensor_without_a_gp_may_be_noisier_than_in_the_data():
    in_doubt = doubts({}, noise=10.0 * NOISE[0])
    assert np.count_nonzero(in_doubt[20:]) <= 1


def test_a_sensor_of_unknown_noise_is_never_in_doubt():
    effect = torch.tensor([[0.0], [1.0]])  # no noise is known of the position
    model = ResidualModel.train(
        Affine.identity(2, 1), DATA, effect, trainer=Trainer(restarts=0)
    )
    learned = LearningState.begin(ChangedModel(model), np.zeros(2))
    random = np.random.default_rng(0)
    state = np.zeros(2)
    for k in range(20):
        input = random.uniform(-1, 1, 1)
        state = cart(state, input) + 0.01 * random.normal(size=2)
        glitch = np.array([0.0, 5.0 * (k == 15)])
        learned = learn_from_step(learned, input, state + glitch)
        weights = [one.log_weight for one in learned.explanations]
        assert np.isfinite(weights).all()
        assert not learned.sensors_in_doubt[0]
    assert learned.assumed is None


def test_what_cannot_be_learned_is_refused():
    with pytest.raises(SettingError, match="with_model"):
        LearningController(object())
    with pytest.raises(SettingError, match="memory"):
        OnlineLearning(memory=0.0)
    with pytest.raises(UnsupportedModel, match="in host memory; got object"):
        ChangedModel(object())
    settings = PredictionSettings(disturbance_gain=0.3)
    both = GPMPC(MODEL, Linearization(), PROBLEM, 8, [0.0], settings)
    with pytest.raises(SettingError, match=r"disturbance_gain: must be 0 .*; got 0.3"):
        LearningController(both)


def test_a_state_of_another_length_is_refused_at_any_step():
    steering = LearningController(GPMPC(MODEL, Linearization(), PROBLEM, 8, [0.0]))
    origin = Reference(np.zeros(2))
    last = steering.control(Gaussian.certain([0.0, 0.0]), origin)
    for length in (1, 4):
        with pytest.raises(ShapeError, match=r"state must have shape \(2,\)"):
            steering.control(Gaussian.certain(np.zeros(length)), origin, last)


def test_a_single_precision_model_is_changed_as_well():
    single = ChangedModel(MODEL.to(dtype=torch.float32))
    double = ChangedModel(MODEL)
    point = np.array([0.1, -0.2, 0.5, 0.0])
    target = np.full(MODEL.output_dim, 0.05)
    noise = MODEL.noise_variance.numpy()
    x = torch.tensor([0.1, -0.2], dtype=torch.float64)
    u = torch.tensor([0.5], dtype=torch.float64)
    expected = double.with_point(point, target, noise).predict(x, u)
    belief = single.with_point(point, target, noise).predict(x.float(), u.float())
    assert belief.mean.dtype == belief.covariance.dtype == torch.float32
    assert torch.allclose(belief.mean.double(), expected.mean, atol=1e-3)
    assert torch.allclose(belief.covariance.double(), expected.covariance, atol=1e-4)
    assert not torch.allclose(belief.mean, single.predict(x.float(), u.float()).mean)


def taught_along(states, inputs, learned=None):
    """What is known after each step of a flight."""
    if learned is None:
        learned = LearningState.begin(ChangedModel(MODEL), states[0])
    steps = []
    for state, input in zip(states[1:], inputs, strict=True):
        learned = learn_from_step(learned, input, state)
        steps.append(learned)
    return steps


def excited(steps, wind_from=None, seed=1):
    random = np.random.default_rng(seed)
    inputs = random.uniform(-3, 3, (steps, 1))
    states = [np.zeros(2)]
    for k, input in enumerate(inputs):
        blows = wind_from is not None and k >= wind_from
        state = cart(states[-1], input, wind=0.8 if blows else 0.0)
        states.append(state + random.normal(0, NOISE))
    return np.array(states), inputs


def test_a_sensor_that_is_wrong_now_and_then_is_not_noisy():
    states, inputs = excited(40)
    states[4:40:8, 1] += 1.0  # so is every fourth difference
    last = taught_along(states, inputs)[-1]
    noise = _noise_variance(last.noise_ratios, last.heaviest)
    assert (noise < 3.0 * last.model.gp_noise).all()
